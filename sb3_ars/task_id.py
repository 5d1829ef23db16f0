"""The one-hot task id at the end of an observation, put there where it lacks; knows no models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_ars.errors import ConfigError

__all__ = ["task_index", "with_task_id"]


def task_index(task: str | int, task_names: Sequence[str] | None) -> int:
    """Return the index of a task.

    :param task: name or index
    :param task_names: the tasks, in order; ``None`` for a plain environment, which has none
    :raises ConfigError: if there is no such task
    """
    names = list(task_names or [])
    index: Any = names.index(task) if task in names else task
    if isinstance(index, bool) or not isinstance(index, int | np.integer) or not 0 <= index < len(names):
        raise ConfigError(f"task={task!r} is not one of this model's tasks: {names}.")
    return int(index)


def with_task_id(
    observation: Any, task: str | int | None, task_names: Sequence[str] | None, space: spaces.Space[Any]
) -> Any:
    """Return observations as the networks read them, with the one-hot id of their task.

    :param observation: ``(obs_dim,)`` or ``(n, obs_dim)``
    :param task: name or index of the task that all rows belong to; ``None`` where they have the one-hot
    :param task_names: the tasks, in order; ``None`` for a plain environment
    :param space: of observations with the one-hot
    :raises ConfigError: if there is no such task, or the one-hot is missing and ``task`` is not given
    """
    n_tasks = len(task_names or [])
    if task is not None:
        one_hot = np.eye(n_tasks, dtype=np.float32)[task_index(task, task_names)]
        observation = np.asarray(observation)
        return np.concatenate(
            (observation, np.broadcast_to(one_hot, (*observation.shape[:-1], n_tasks))), axis=-1
        )
    width = space.shape
    if task_names is not None and width is not None and np.shape(observation)[-1:] == (width[0] - n_tasks,):
        raise ConfigError("The observation lacks the one-hot task id; say which task it is from with task=.")
    return observation
