"""A family of point-mass tasks with unequal rewards, solved in minutes; must not know the algorithms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from sb3_ars.errors import ConfigError

if TYPE_CHECKING:
    from sb3_ars.envs.vec_env import MultiTaskVecEnv

__all__ = ["PointTask", "make_toy_env"]

_FOUR_NAMES = ("point-east", "point-north", "point-west", "point-south")


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
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}  # type: ignore[misc]  # Gymnasium's is no ClassVar

    def __init__(self, angle: float = 0.0, reward_scale: float = 1.0, max_episode_steps: int = 50) -> None:
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.reward_scale = float(reward_scale)
        self.max_episode_steps = max_episode_steps
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


def make_toy_env(
    seed: int | None = None,
    n_envs_per_task: int = 1,
    n_workers: int | str = 0,
    reward_scales: Sequence[float] = (10.0, 1.0, 0.1, 0.1),
    max_episode_steps: int = 50,
    start_method: str = "spawn",
    worker_timeout: float = 30.0,
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
    :raises ConfigError: if an option cannot work; the message names it
    """
    from sb3_ars.envs import checks
    from sb3_ars.envs.vec_env import MultiTaskVecEnv

    scales = _check_scales(reward_scales)
    steps = checks.check_count("max_episode_steps", max_episode_steps)
    names = (
        _FOUR_NAMES
        if len(scales) == 4
        else tuple(f"point-{360 * i // len(scales)}" for i in range(len(scales)))
    )
    factories = {
        name: partial(PointTask, 2 * math.pi * index / len(scales), scale, steps)
        for index, (name, scale) in enumerate(zip(names, scales, strict=True))
    }
    return MultiTaskVecEnv(
        factories,
        n_envs_per_task=n_envs_per_task,
        seed=seed,
        n_workers=n_workers,
        start_method=start_method,
        worker_timeout=worker_timeout,
    )


def _move(position: float, speed: float) -> tuple[float, float]:
    moved = position + 0.1 * speed
    if -1.0 <= moved <= 1.0:
        return moved, speed
    return math.copysign(1.0, moved), 0.0


def _check_scales(reward_scales: Sequence[float]) -> list[float]:
    if not isinstance(reward_scales, Sequence):
        raise ConfigError(
            f"reward_scales={reward_scales!r} must be a list of positive numbers, one per task."
        )
    scales = list(reward_scales)
    if not 1 <= len(scales) <= 360 or any(not (math.isfinite(scale) and scale > 0) for scale in scales):
        raise ConfigError(
            f"reward_scales must hold 1 to 360 positive numbers, one per task, got {reward_scales!r}."
        )
    return [float(scale) for scale in scales]
