"""Checks options and spaces before time is spent; must not know SB3 or a particular env."""

from __future__ import annotations

import math
import multiprocessing
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from sb3_ars.envs.workers import EnvFactory, EnvFacts
from sb3_ars.errors import ConfigError, check_count, nearest
from sb3_ars.machine import available_cpus

__all__ = [
    "CommonSpaces",
    "TaskSpecs",
    "check_choice",
    "check_common_spaces",
    "check_count",
    "check_equal_spaces",
    "check_n_workers",
    "check_raw_rewards",
    "check_restart_workers",
    "check_seed",
    "check_start_method",
    "check_task_names",
    "check_task_of_env",
    "check_timeout",
    "check_visible_goal",
    "pairs_of_tasks",
]


TaskSpecs = (
    Mapping[str, EnvFactory | Sequence[EnvFactory]] | Sequence[tuple[str, EnvFactory | Sequence[EnvFactory]]]
)
"""Task name -> function that returns a new env (or one function per env of the task), in one-hot order."""


class CommonSpaces(NamedTuple):
    """What all tasks share: outer bounds of the observations (float32), and the one action space."""

    low: npt.NDArray[np.float32]
    high: npt.NDArray[np.float32]
    action_space: gym.spaces.Box


def check_seed(value: object, option: str = "seed") -> int | None:
    """Return ``value`` if it is None or a non-negative integer.

    :raises ConfigError: otherwise
    """
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise ConfigError(f"{option} must be None or an integer of at least 0, got {value!r}.")
    return int(value)


def check_choice(option: str, value: object, valid: Sequence[str]) -> str:
    """Return ``value`` if it is one of ``valid``.

    :raises ConfigError: otherwise, with the nearest valid name
    """
    if not isinstance(value, str) or value not in valid:
        hint = nearest(value, valid) if isinstance(value, str) else ""
        raise ConfigError(f"{option} must be one of {', '.join(map(repr, valid))}, got {value!r}.{hint}")
    return value


def check_start_method(value: object) -> str:
    """Return ``value`` if this platform can start processes that way.

    :raises ConfigError: otherwise
    """
    return check_choice("start_method", value, sorted(multiprocessing.get_all_start_methods(), reverse=True))


def check_timeout(value: object) -> float:
    """Return ``value`` if it is a positive finite number of seconds.

    :raises ConfigError: otherwise
    """
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < math.inf:
        return float(value)
    raise ConfigError(f"worker_timeout must be a positive finite number of seconds, got {value!r}.")


def check_n_workers(value: object, n_envs: int) -> int:
    """Return the number of worker processes, 0 meaning none; "auto" asks the machine.

    "auto" is 0 for one env, on one CPU and inside a process that may not have children of its own (a daemonic
    one, such as a ``multiprocessing.Pool``'s); else one per available CPU, but no more than envs.

    :raises ConfigError: if it is neither "auto" nor an integer from 0 to ``n_envs``
    """
    daemonic = multiprocessing.current_process().daemon
    if value == "auto":
        n_cpus = available_cpus()
        return 0 if min(n_envs, n_cpus) == 1 or daemonic else min(n_envs, n_cpus)
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise ConfigError(f"n_workers must be 'auto' or an integer of at least 0, got {value!r}.")
    if value > n_envs:
        raise ConfigError(
            f"n_workers={value} is more than the {n_envs} env(s) there are to step: give at most {n_envs}, "
            "or 'auto'."
        )
    if value and daemonic:
        raise ConfigError(
            f"n_workers={value}: this process is daemonic and may not start others. Use n_workers=0."
        )
    return int(value)


def check_restart_workers(value: object, n_workers: object, processes: int) -> tuple[bool, int]:
    """Return whether workers are started anew, and how many there are: "auto" then is one at least.

    :param value: of the option
    :param n_workers: what was asked for
    :param processes: what `check_n_workers` made of it
    :raises ConfigError: if there are no workers, or no way to give a late one the arrays
    """
    if not isinstance(value, bool):
        raise ConfigError(f"restart_workers={value!r} must be True or False.")
    if not value:
        return False, processes
    if not sys.platform.startswith("linux"):
        raise ConfigError(
            "restart_workers=True needs Linux, whose /proc gives a new worker the shared arrays."
        )
    if n_workers == "auto" and not multiprocessing.current_process().daemon:
        processes = max(processes, 1)
    if not processes:
        raise ConfigError(
            f"restart_workers=True with n_workers={n_workers!r}: the envs are stepped in this process, which cannot be "
            "started anew. Give n_workers=1 or more, or leave restart_workers out."
        )
    return True, processes


def pairs_of_tasks(
    tasks: TaskSpecs,
    n_envs_per_task: int,
) -> tuple[tuple[str, ...], list[EnvFactory]]:
    """Return the task names and one factory per env, task-major.

    :param tasks: name -> factory, or a list of such pairs; a list of ``n_envs_per_task`` factories gives each
        env its own
    :param n_envs_per_task: how many envs each task gets
    :raises ConfigError: for no task, a repeated or odd name, something that is not callable
    """
    if not isinstance(tasks, Mapping | list | tuple):
        raise ConfigError(
            "tasks must be a mapping (or a list of pairs) from task name to a function that returns a new "
            f"env, got {type(tasks).__name__}."
        )
    pairs = list(tasks.items() if isinstance(tasks, Mapping) else tasks)
    if any(not isinstance(pair, tuple | list) or len(pair) != 2 for pair in pairs):
        raise ConfigError(
            "tasks: each item of the list must be a pair (task name, function that returns a new env), "
            "such as ('reach', make_reach)."
        )
    names = check_task_names([name for name, _ in pairs])
    factories: list[EnvFactory] = []
    for name, given in pairs:
        factories += _factories_of(name, given, n_envs_per_task)
    return names, factories


def check_task_names(names: Sequence[object], n_tasks: int | None = None) -> tuple[str, ...]:
    """Return the names as a tuple if they are different, non-empty strings.

    :raises ConfigError: otherwise, or if there are not ``n_tasks`` of them
    """
    if not names:
        raise ConfigError("tasks is empty: give at least one task.")
    for name in names:
        if not isinstance(name, str) or not name:
            raise ConfigError(f"task names must be non-empty strings, got {name!r}.")
    repeated = sorted({str(name) for name in names if names.count(name) > 1})
    if repeated:
        raise ConfigError(
            f"task {', '.join(map(repr, repeated))} is given more than once. Each name must be a task of "
            "its own; for several envs of one task use n_envs_per_task."
        )
    if n_tasks is not None and len(names) != n_tasks:
        raise ConfigError(f"task_names has {len(names)} names for {n_tasks} tasks.")
    return tuple(str(name) for name in names)


def check_task_of_env(value: Sequence[int] | npt.NDArray[np.int64], n_envs: int) -> npt.NDArray[np.int64]:
    """Return the task index of each env, ``(n_envs,)`` int64.

    :raises ConfigError: unless there is one index per env and every task from 0 on has an env
    """
    try:
        array = np.asarray(value)
    except ValueError:  # lists of unequal lengths
        array = np.empty(0)
    if array.shape != (n_envs,) or not np.issubdtype(array.dtype, np.integer):
        raise ConfigError(
            f"task_of_env must hold one integer (a task index) for each of the {n_envs} envs, got {value!r}."
        )
    missing = sorted(set(range(int(array.max()) + 1)) - set(array.tolist()))
    if missing or array.min() < 0:
        raise ConfigError(
            f"task_of_env must number the tasks 0, 1, 2, ... without a gap, got {array.tolist()}"
            + (f" (no env for task {missing})." if missing else ".")
        )
    return array.astype(np.int64)


def check_raw_rewards(task: str, normalizer: str | None) -> None:
    """Raise if a wrapper around the task's env normalises the rewards.

    :raises ConfigError: naming the task and the wrapper
    """
    if normalizer is not None:
        raise ConfigError(
            f"task {task!r}: its env is wrapped in {normalizer}, but adaptive reward scaling needs raw "
            "rewards: its scales are ratios of mean rewards, and drifting normalised ones spoil the replay "
            "buffer. Remove the wrapper (in Meta-World: reward_normalization_method=None)."
        )


def check_visible_goal(task: str, goal_hidden: bool) -> None:
    """Raise if a Meta-World env hides its goal.

    :raises ConfigError: naming the task
    """
    if goal_hidden:
        raise ConfigError(
            f"task {task!r}: this Meta-World env hides the goal (the last three observations are 0), so "
            "the task cannot be solved by a policy that sees one observation. Use MT1/make_metaworld_env, "
            "ML1 hides the goal."
        )


def check_common_spaces(tasks: Sequence[str], facts: Sequence[EnvFacts]) -> CommonSpaces:
    """Return what the envs share, if one network can serve them all.

    :param tasks: the task name of each env
    :param facts: what each env is
    :raises ConfigError: naming the task, or the two tasks, and the remedy
    """
    for task, fact in zip(tasks, facts, strict=True):
        check_visible_goal(task, fact.goal_hidden)
        check_raw_rewards(task, fact.reward_normalizer)
        _check_observation_space(task, fact.observation_space)
        _check_action_space(task, fact.action_space)
    check_equal_spaces(tasks, facts)
    boxes = [_box(fact.observation_space) for fact in facts]
    low = np.min([box.low for box in boxes], axis=0).astype(np.float32)
    high = np.max([box.high for box in boxes], axis=0).astype(np.float32)
    return CommonSpaces(low, high, _box(facts[0].action_space))


def check_equal_spaces(tasks: Sequence[str], facts: Sequence[EnvFacts]) -> None:
    """Raise if two envs differ in the shape of their observations or in their actions.

    :raises ConfigError: naming both tasks
    """
    first = facts[0]
    for task, fact in zip(tasks, facts, strict=True):
        if fact.observation_space.shape != first.observation_space.shape:
            raise ConfigError(
                f"tasks {tasks[0]!r} and {task!r} have observations of different shapes, "
                f"{first.observation_space.shape} and {fact.observation_space.shape}. One policy serves "
                "all tasks: pad the shorter observation with zeros, for example in a "
                "gymnasium.ObservationWrapper."
            )
        if fact.action_space != first.action_space:
            raise ConfigError(
                f"tasks {tasks[0]!r} and {task!r} have different action spaces, {first.action_space} and "
                f"{fact.action_space}. Rescale one, for example with gymnasium.wrappers.RescaleAction."
            )


def _factories_of(
    name: str, given: EnvFactory | Sequence[EnvFactory], n_envs_per_task: int
) -> Sequence[EnvFactory]:
    if isinstance(given, list | tuple):
        if len(given) != n_envs_per_task:
            raise ConfigError(
                f"task {name!r} has {len(given)} factories, but n_envs_per_task={n_envs_per_task}: give as "
                "many, or one."
            )
        factories: Sequence[Any] = given
    else:
        factories = [given] * n_envs_per_task
    for factory in factories:
        if not callable(factory):
            hint = (
                " Give a function that makes a new one at each call, such as the env's class."
                if isinstance(factory, gym.Env)
                else ""
            )
            raise ConfigError(
                f"task {name!r}: expected a function that takes no argument and returns a new env, got an "
                f"object of type {type(factory).__name__}.{hint}"
            )
    return factories


def _check_observation_space(task: str, space: gym.Space[Any]) -> None:
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise ConfigError(
            f"task {task!r}: the observation space must be a Box with one dimension, got {space}. "
            "Flatten it, for example with gymnasium.wrappers.FlattenObservation (images: extract features first)."
        )


def _check_action_space(task: str, space: gym.Space[Any]) -> None:
    if (
        not isinstance(space, gym.spaces.Box)
        or len(space.shape) != 1
        or not np.issubdtype(space.dtype, np.floating)
    ):
        raise ConfigError(
            f"task {task!r}: the action space must be a Box of floats with one dimension, got {space}. "
            "SAC and TQC need continuous actions."
        )
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise ConfigError(
            f"task {task!r}: the action bounds must be finite, got {space}. Give bounds, for example with "
            "gymnasium.wrappers.RescaleAction or TransformAction."
        )


def _box(space: gym.Space[Any]) -> gym.spaces.Box:
    assert isinstance(space, gym.spaces.Box)
    return space
