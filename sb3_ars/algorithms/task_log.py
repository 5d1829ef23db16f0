"""Per-task numbers for SB3's logger: episodes as they end, updates as tensors, read only when a log is written."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger

from sb3_ars.core.update import Metrics
from sb3_ars.errors import DivergedError

__all__ = ["TaskLog", "log_names"]

_STDOUT_WIDTH = 32  # SB3's table cuts keys to 36 characters, indentation included, and refuses two equal ones
_STDOUT_TASKS = 10  # with more tasks, per-task rows go to CSV and TensorBoard alone


class TaskLog:
    """Collects what happened per task since the last log entry.

    :param task_names: the tasks; empty for a plain environment, which gets SB3's keys alone
    :param episodes: the latest episodes of each task, which averages run over; filled here, kept by the model
    """

    def __init__(self, task_names: Sequence[str], episodes: Sequence[deque[dict[str, float]]]) -> None:
        self.task_names = log_names(task_names)
        self._episodes = episodes
        self._sums: Metrics | None = None
        self._n_updates = 0

    def add_episode(self, task: int, info: dict[str, Any]) -> None:
        """Keep the return, length and success of an episode that ended.

        :param task: index
        :param info: of the episode's last step
        """
        episode = {"return": info["episode"]["r"]} if "episode" in info else {}
        if "is_success" in info:
            episode["success"] = float(info["is_success"])
        self._episodes[task].append(episode)

    def successes(self, task: int) -> list[float]:
        """Return the success, 0 or 1, of the task's latest training episodes, oldest first.

        :param task: index
        """
        return [episode["success"] for episode in self._episodes[task] if "success" in episode]

    def mean_success(self) -> float:
        """Return the mean over tasks of the latest training episodes' success; NaN while a task has none."""
        means = [np.mean(self.successes(task) or [np.nan]) for task in range(len(self._episodes))]
        return float(np.mean(means)) if means else float("nan")

    def add_update(self, metrics: Metrics) -> None:
        """Add one update's metrics to the running sums, on the device."""
        if self._sums is None:  # a copy: a captured update writes into the same tensors again
            self._sums = Metrics(*(metric.clone() for metric in metrics))
        else:
            th._foreach_add_(self._sums, metrics)
        self._n_updates += 1

    def checkpoint_state(self) -> dict[str, Any]:
        """Return what was added since the last row; the tensors are not copied."""
        return {"sums": None if self._sums is None else list(self._sums), "n_updates": self._n_updates}

    def restore_checkpoint_state(self, state: Mapping[str, Any], device: th.device) -> None:
        """Go on from what :meth:`checkpoint_state` returned.

        :param state: see there
        :param device: of the model
        """
        sums = state["sums"]
        self._sums = None if sums is None else Metrics(*(tensor.to(device, copy=True) for tensor in sums))
        self._n_updates = state["n_updates"]

    def record(
        self, logger: Logger, n_updates: int, temperature_is_learned: bool, tasks_are_left_out: bool = False
    ) -> None:
        """Write means since the last call under SB3's keys and, per task, ours.

        :param logger: SB3's
        :param n_updates: gradient steps of the whole run
        :param temperature_is_learned: whether there is a temperature loss to report
        :param tasks_are_left_out: whether a task may be left out of an update
        :raises DivergedError: if a loss is NaN or infinite
        """
        for key, values in self._episode_means().items():
            self._record_tasks(logger, key, values)
            if key == "success":
                logger.record("rollout/mean_success", float(np.nanmean(values)))
        if self._sums is None:
            return
        actor_loss, critic_loss, ent_coef_loss, ent_coef, q_value, left_out = (
            (tensor / self._n_updates).tolist() for tensor in self._sums
        )
        if not np.isfinite([actor_loss, critic_loss]).all():
            raise DivergedError(
                f"The losses became NaN or infinite by update {n_updates} (actor {actor_loss}, critic {critic_loss}). "
                "Continue from an earlier save with a smaller learning_rate or smaller rewards."
            )
        logger.record("train/n_updates", n_updates, exclude="tensorboard")
        logger.record("train/ent_coef", float(np.mean(ent_coef)))
        logger.record("train/actor_loss", actor_loss)
        logger.record("train/critic_loss", critic_loss)
        if temperature_is_learned:
            logger.record("train/ent_coef_loss", ent_coef_loss)
        if self.task_names:
            self._record_tasks(logger, "q_value", q_value)
            self._record_tasks(logger, "ent_coef", np.broadcast_to(ent_coef, len(self.task_names)).tolist())
            if tasks_are_left_out:
                self._record_tasks(logger, "left_out", left_out)
        self._sums, self._n_updates = None, 0

    def record_scale(self, logger: Logger, reward_scale: th.Tensor, mean_reward: th.Tensor) -> None:
        """Write c_i and the mean raw reward in each task's buffer.

        :param logger: SB3's
        :param reward_scale: ``(n_tasks,)``
        :param mean_reward: ``(n_tasks,)``
        """
        self._record_tasks(logger, "reward_scale", reward_scale.tolist())
        self._record_tasks(logger, "mean_reward", mean_reward.tolist())

    def _episode_means(self) -> dict[str, list[float]]:
        means = {}
        for key in ("success", "return"):
            values = [[e[key] for e in episodes if key in e] for episodes in self._episodes]
            if any(values):
                means[key] = [float(np.mean(v)) if v else float("nan") for v in values]
        return means

    def _record_tasks(self, logger: Logger, key: str, values: Sequence[float]) -> None:
        exclude = "stdout" if len(self.task_names) > _STDOUT_TASKS else None
        for name, value in zip(self.task_names, values, strict=True):
            if not np.isnan(value):
                logger.record(f"{key}/{name}", value, exclude=exclude)


def log_names(task_names: Sequence[str]) -> list[str]:
    """Return the names the log uses: the tasks' own, cut and numbered where SB3's table could not tell them apart."""
    if all(len(name) <= _STDOUT_WIDTH for name in task_names):
        return list(task_names)
    return [f"{index}:{name}"[:_STDOUT_WIDTH] for index, name in enumerate(task_names)]
