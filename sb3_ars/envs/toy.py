"""A family of point-mass tasks with unequal rewards, solved in minutes; must not know the algorithms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from sb3_ars.errors import ConfigError, nearest

if TYPE_CHECKING:
    from sb3_ars.envs.vec_env import MultiTaskVecEnv

__all__ = ["TOY_TASKS", "PointTask", "make_toy_env", "toy_task"]

TOY_TASKS = ("point-east", "point-north", "point-west", "point-south")
"""Names of the tasks where there are four of them, loudest first."""

_SCALES = (10.0, 1.0, 0.1, 0.1)


class PointTask(gym.Env[npt.NDArray[np.float32], npt.NDArray[np.float32]]):
    """A point on the square [-1, 1]² is pushed to a goal; the task turns the push by a fixed angle.

    Observation, ``(6,)`` float32 in [-1, 1]: position, velocity, goal. Action, ``(2,)`` in [-1, 1]: the push.
    With the turned action u, per step::

        velocity = 0.7 * velocity + 0.3 * u
        position = clip(position + 0.1 * velocity, -1, 1)      (a wall stops the point)
        reward   = reward_scale * (1 - tanh(3 * distance))     in [0, reward_scale]

    ``info["success"]`` is 1.0 while the distance is below 0.05. An episode never terminates; it is
    truncated after ``max_episode_steps``. Start and goal are uniform in [-0.5, 0.5]².

    :param angle: turn of the action, radians, anticlockwise
    :param reward_scale: factor of the reward, positive
    :param max_episode_steps: the horizon
    :param render_mode: None or "rgb_array": the square seen from above, with the goal in green, the point in blue, its
        way so far, and in the corner where the action (1, 0) pushes
    :param render_size: width and height of a frame in pixels
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]  # Gymnasium's is no ClassVar
        "render_modes": ["rgb_array"],
        "render_fps": 20,
    }

    def __init__(
        self,
        angle: float = 0.0,
        reward_scale: float = 1.0,
        max_episode_steps: int = 50,
        render_mode: str | None = None,
        render_size: int = 320,
    ) -> None:
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.reward_scale = float(reward_scale)
        self.max_episode_steps = max_episode_steps
        self.render_mode, self._render_size = render_mode, render_size
        self._way: list[tuple[float, float]] = []
        # Rounded, so that quarter turns are exact.
        self._cos, self._sin = round(math.cos(angle), 12), round(math.sin(angle), 12)
        self._state = (0.0,) * 6
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Put the point and the goal somewhere new, at rest; return (observation, info)."""
        super().reset(seed=seed)
        x, y, goal_x, goal_y = self.np_random.uniform(-0.5, 0.5, 4).tolist()
        self._state = (x, y, 0.0, 0.0, goal_x, goal_y)
        self._steps = 0
        self._way = [(x, y)]
        return np.array(self._state, np.float32), {}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Push the point; return (observation, reward, False, truncated, {"success": 0.0 or 1.0})."""
        # Plain floats: a step costs a few microseconds, where arrays of two numbers would cost tens.
        east, north = action.tolist()
        east, north = min(max(east, -1.0), 1.0), min(max(north, -1.0), 1.0)
        x, y, speed_x, speed_y, goal_x, goal_y = self._state
        x, speed_x = _move(x, 0.7 * speed_x + 0.3 * min(max(self._cos * east - self._sin * north, -1.0), 1.0))
        y, speed_y = _move(y, 0.7 * speed_y + 0.3 * min(max(self._sin * east + self._cos * north, -1.0), 1.0))
        self._state = (x, y, speed_x, speed_y, goal_x, goal_y)
        self._steps += 1
        if self.render_mode is not None:
            self._way.append((x, y))
        distance = math.hypot(x - goal_x, y - goal_y)
        reward = self.reward_scale * (1.0 - math.tanh(3.0 * distance))
        success = 1.0 if distance < 0.05 else 0.0
        return (
            np.array(self._state, np.float32),
            reward,
            False,
            self._steps >= self.max_episode_steps,
            {"success": success},
        )

    def render(self) -> npt.NDArray[np.uint8] | None:
        """Return the frame, ``(render_size, render_size, 3)`` uint8, or None without a ``render_mode``."""
        if self.render_mode is None:
            return None
        _, _, _, _, goal_x, goal_y = self._state
        return _frame(self._way, (goal_x, goal_y), (self._cos, self._sin), self._render_size)


def toy_task(name: str, max_episode_steps: int = 50, render_mode: str | None = None) -> PointTask:
    """Return one of the four tasks, as `make_toy_env` has them, on its own.

    :param name: one of `TOY_TASKS`
    :param max_episode_steps: the horizon
    :param render_mode: see `PointTask`
    """
    index = TOY_TASKS.index(_check_tasks([name], TOY_TASKS)[0])
    return PointTask(2 * math.pi * index / len(TOY_TASKS), _SCALES[index], max_episode_steps, render_mode)


def make_toy_env(
    seed: int | None = None,
    n_envs_per_task: int = 1,
    n_workers: int | str = 0,
    reward_scales: Sequence[float] = _SCALES,
    max_episode_steps: int = 50,
    start_method: str = "spawn",
    worker_timeout: float = 25.0,
    tasks: Sequence[str] | None = None,
    render_mode: str | None = None,
    render_size: int = 320,
    restart_workers: bool = False,
) -> MultiTaskVecEnv:
    """Return a VecEnv of point-mass tasks (`PointTask`) whose rewards differ by orders of magnitude.

    Without reward scaling a shared policy learns the loud tasks and neglects the quiet ones.

    :param seed: see `MultiTaskVecEnv`
    :param n_envs_per_task: see `MultiTaskVecEnv`
    :param n_workers: see `MultiTaskVecEnv`; here none by default, since a step is cheaper than a message
    :param reward_scales: one positive factor per task; the tasks' angles are spaced evenly
    :param max_episode_steps: the horizon
    :param start_method: see `MultiTaskVecEnv`
    :param worker_timeout: see `MultiTaskVecEnv`
    :param tasks: names of those wanted, such as "point-west"; all by default
    :param render_mode: see `PointTask`
    :param render_size: see `PointTask`
    :param restart_workers: see `MultiTaskVecEnv`
    :raises ConfigError: if an option cannot work; the message names it
    """
    from sb3_ars.envs import checks
    from sb3_ars.envs.vec_env import MultiTaskVecEnv

    scales = _check_scales(reward_scales)
    steps = checks.check_count("max_episode_steps", max_episode_steps)
    if render_mode is not None:
        checks.check_choice("render_mode", render_mode, PointTask.metadata["render_modes"])
    size = checks.check_count("render_size", render_size, minimum=16)
    names = (
        TOY_TASKS
        if len(scales) == 4
        else tuple(f"point-{360 * i // len(scales)}" for i in range(len(scales)))
    )
    factories = {
        name: partial(PointTask, 2 * math.pi * index / len(scales), scale, steps, render_mode, size)
        for index, (name, scale) in enumerate(zip(names, scales, strict=True))
    }
    return MultiTaskVecEnv(
        {name: factories[name] for name in _check_tasks(names if tasks is None else tasks, names)},
        n_envs_per_task=n_envs_per_task,
        seed=seed,
        n_workers=n_workers,
        start_method=start_method,
        worker_timeout=worker_timeout,
        restart_workers=restart_workers,
    )


def _move(position: float, speed: float) -> tuple[float, float]:
    moved = position + 0.1 * speed
    if -1.0 <= moved <= 1.0:
        return moved, speed
    return math.copysign(1.0, moved), 0.0


def _frame(
    way: Sequence[tuple[float, float]], goal: tuple[float, float], push: tuple[float, float], size: int
) -> npt.NDArray[np.uint8]:
    """Draw the square from above, y upwards."""
    from PIL import Image, ImageDraw  # a worker that does not draw need not load it

    scale = 2 * size  # drawn twice as large and shrunk, which smooths the edges

    def at(x: float, y: float) -> tuple[float, float]:
        return scale * (0.5 + 0.46 * x), scale * (0.5 - 0.46 * y)

    def disc(x: float, y: float, radius: float, colour: str) -> None:
        (left, top), (right, bottom) = at(x - radius, y + radius), at(x + radius, y - radius)
        draw.ellipse((left, top, right, bottom), fill=colour)

    image = Image.new("RGB", (scale, scale), "#f4f4f2")
    draw = ImageDraw.Draw(image)
    draw.rectangle((*at(-1, 1), *at(1, -1)), fill="white", outline="#8a8a8a", width=scale // 160)
    disc(*goal, 0.05, "#5aae61")  # as large as success is
    if len(way) > 1:
        draw.line([at(*point) for point in way], fill="#9ecae1", width=scale // 100, joint="curve")
    disc(*way[-1], 0.025, "#08519c")
    # a compass: a point, and a line from it to where (1, 0) pushes
    centre, length = (-0.8, 0.8), 0.12
    tip = (centre[0] + length * push[0], centre[1] + length * push[1])
    draw.line([at(*centre), at(*tip)], fill="#d94801", width=scale // 80)
    disc(*tip, 0.025, "#d94801")
    return np.asarray(image.resize((size, size), Image.Resampling.LANCZOS))


def _check_tasks(tasks: Any, names: Sequence[str]) -> Sequence[str]:
    if isinstance(tasks, str) or not isinstance(tasks, Sequence):
        raise ConfigError(f"tasks={tasks!r} must be a list of toy tasks' names, such as {list(names[:1])}.")
    for name in tasks:
        if name not in names:
            raise ConfigError(
                f"tasks: {name!r} is no toy task; there are {', '.join(names)}.{nearest(str(name), names)}"
            )
    if not tasks or len(set(tasks)) < len(tasks):
        raise ConfigError(f"tasks={list(tasks)!r} must name at least one toy task, and each once.")
    return tasks


def _is_positive(value: Any) -> bool:
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0
    )


def _check_scales(reward_scales: Any) -> list[float]:
    if isinstance(reward_scales, str) or not isinstance(reward_scales, Sequence):
        raise ConfigError(
            f"reward_scales={reward_scales!r} must be a list of positive numbers, one per task."
        )
    scales = list(reward_scales)
    if not 1 <= len(scales) <= 360 or not all(map(_is_positive, scales)):
        raise ConfigError(
            f"reward_scales must hold 1 to 360 positive numbers, one per task, got {reward_scales!r}."
        )
    return [float(scale) for scale in scales]
