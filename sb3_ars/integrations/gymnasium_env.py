"""Several tasks behind one Gymnasium id, for tools that know environments by id; must not know the algorithms.

Importing this module registers ``sb3_ars/toy-v0``, ``sb3_ars/MT10-v0``, ``sb3_ars/MT25-v0`` and ``sb3_ars/MT50-v0``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from sb3_ars.envs.metaworld import MetaworldTask, metaworld_task_names
from sb3_ars.envs.toy import TOY_TASKS, toy_task
from sb3_ars.errors import ConfigError, nearest

__all__ = ["ENV_IDS", "TaskSet", "task_names"]


class TaskSet(gym.Env[npt.NDArray[np.float32], npt.NDArray[np.float32]]):
    """One of several tasks, with the one-hot task id behind the observation.

    :param tasks: "toy", or what :func:`~sb3_ars.envs.metaworld_task_names` takes
    :param task: name of the task, long or short; None draws one at the start of each episode
    :param horizon: steps of an episode; None is the tasks' own: 50 for the toy, 500 for Meta-World
    :param goals: of Meta-World's tasks: "random", "stored" or "ordered"
    :param render_mode: None or "rgb_array"
    :raises ConfigError: for an unknown name
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]  # Gymnasium's is no ClassVar
        "render_modes": ["rgb_array"],
        "render_fps": 30,
    }

    def __init__(
        self,
        tasks: str | Sequence[str] = "toy",
        task: str | None = None,
        horizon: int | None = None,
        goals: str = "random",
        render_mode: str | None = None,
    ) -> None:
        self.task_names = task_names(tasks)
        self._is_toy = tasks == "toy"
        self.max_episode_steps = horizon or (50 if self._is_toy else 500)
        self._goals, self.render_mode = goals, render_mode
        self._made: dict[int, gym.Env[Any, Any]] = {}
        self._seeded: set[int] = set()
        self._fixed = None if task is None else _index_of(task, self.task_names)
        self._now = self._fixed or 0
        self._success = False
        low, high, self.action_space = _spaces(self.task_names, self._is_toy)
        ends = np.zeros(len(self.task_names), np.float32), np.ones(len(self.task_names), np.float32)
        self.observation_space = gym.spaces.Box(
            np.concatenate([low, ends[0]]), np.concatenate([high, ends[1]]), dtype=np.float32
        )

    @property
    def one_hot(self) -> npt.NDArray[np.float32]:
        """The running episode's task id, ``(n_tasks,)``."""
        one_hot = np.zeros(len(self.task_names), np.float32)
        one_hot[self._now] = 1.0
        return one_hot

    def set_task(self, task: int) -> None:
        """Stay with one task from the next episode on.

        :param task: index
        """
        self._fixed = self._now = task

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start an episode; return (observation, info)."""
        super().reset(seed=seed)
        self._now = int(self.np_random.integers(len(self.task_names))) if self._fixed is None else self._fixed
        if seed is not None:
            self._seeded.clear()
        elif self._now not in self._seeded:  # each task's generator follows from this env's
            seed = int(self.np_random.integers(2**31))
        self._seeded.add(self._now)
        self._success = False
        obs, info = self._env().reset(seed=seed, options=options)
        return self._with_id(obs), info

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Step the task; return (observation, reward, terminated, truncated, info).

        ``info["success"]`` is this step's; at the end ``info["is_success"]`` says whether there was any.
        """
        obs, reward, terminated, truncated, info = self._env().step(action)
        self._success = self._success or bool(info.get("success"))
        if terminated or truncated:
            info = {**info, "is_success": self._success}
        return self._with_id(obs), float(reward), terminated, truncated, info

    def render(self) -> Any:
        """Return the frame, uint8."""
        return self._env().render()

    def close(self) -> None:
        """Close the simulators."""
        for env in self._made.values():
            env.close()

    def _env(self) -> gym.Env[Any, Any]:
        if self._now not in self._made:
            name = self.task_names[self._now]
            self._made[self._now] = _make(
                name, self._is_toy, self.max_episode_steps, self._goals, self.render_mode
            )
        return self._made[self._now]

    def _with_id(self, obs: Any) -> npt.NDArray[np.float32]:
        return np.concatenate([np.asarray(obs, np.float32), self.one_hot])


def task_names(tasks: str | Sequence[str]) -> tuple[str, ...]:
    """Return the full names of the tasks, in order.

    :param tasks: "toy", or what :func:`~sb3_ars.envs.metaworld_task_names` takes
    :raises ConfigError: for an unknown name
    """
    return TOY_TASKS if tasks == "toy" else metaworld_task_names(tasks)


def _make(
    name: str, is_toy: bool, max_episode_steps: int, goals: Any, render_mode: str | None
) -> gym.Env[Any, Any]:
    if is_toy:
        return toy_task(name, max_episode_steps=max_episode_steps, render_mode=render_mode)
    return MetaworldTask(name, goals=goals, max_episode_steps=max_episode_steps, render_mode=render_mode)


@cache
def _spaces(
    names: tuple[str, ...], is_toy: bool
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], Any]:
    """Return the bounds that hold for all tasks, and their action space; every copy of the env asks for the same."""
    envs = [_make(name, is_toy, 1, "random", None) for name in names]
    boxes: list[Any] = [env.observation_space for env in envs]
    for env in envs:
        env.close()
    low, high = np.min([box.low for box in boxes], axis=0), np.max([box.high for box in boxes], axis=0)
    return low.astype(np.float32), high.astype(np.float32), envs[0].action_space


def _index_of(task: str, names: Sequence[str]) -> int:
    for name in (task, f"{task}-v3"):
        if name in names:
            return list(names).index(name)
    raise ConfigError(f"There is no task {task!r}; there are {', '.join(names)}.{nearest(task, names)}")


ENV_IDS = {"sb3_ars/toy-v0": "toy", **{f"sb3_ars/{name}-v0": name for name in ("MT10", "MT25", "MT50")}}
"""Gymnasium id -> tasks."""

for _id, _tasks in ENV_IDS.items():
    gym.register(_id, entry_point=f"{__name__}:TaskSet", kwargs={"tasks": _tasks}, disable_env_checker=True)
