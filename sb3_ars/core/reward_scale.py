"""The reward scale c_i of each task (Eq. 6) and the paper's alternatives; knows nothing of who stores rewards."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch as th

from sb3_ars.errors import ConfigError, nearest

__all__ = ["RewardScale", "RewardStatistics", "mean_reward_scale", "parse_reward_scaling"]


@dataclass(frozen=True)
class RewardStatistics:
    """Statistics of the raw rewards in each task's whole buffer.

    :param mean: ``(n_tasks,)`` float64, in units of reward
    :param std: ``(n_tasks,)`` float64, population standard deviation
    :param task_names: the tasks' names, for error messages
    """

    mean: th.Tensor
    std: th.Tensor
    task_names: tuple[str, ...]


class RewardScale:
    """What each task's raw rewards go through in the critic's target: ``(r - shift_i) * scale_i``.

    The two tensors are filled in place by :meth:`update_`, so whoever holds them (a captured graph, say)
    sees the new values. Before the first update the scale is 1 and the shift 0.

    :param n_tasks: number of tasks
    :param device: device of the tensors
    """

    def __init__(self, n_tasks: int, device: th.device | str = "cpu") -> None:
        self.scale = th.ones(n_tasks, device=device)
        self.shift = th.zeros(n_tasks, device=device)

    def update_(self, scale: th.Tensor, shift: th.Tensor | None = None) -> None:
        """Fill in new values, in place.

        :param scale: ``(n_tasks,)``, positive
        :param shift: ``(n_tasks,)``, subtracted before scaling; ``None`` means 0
        """
        self.scale.copy_(scale)
        if shift is None:
            self.shift.zero_()
        else:
            self.shift.copy_(shift)

    def __call__(self, reward: th.Tensor) -> th.Tensor:
        """Return the scaled rewards.

        :param reward: ``(n_tasks * batch, 1)``, task-major, raw
        :return: same shape
        """
        n_tasks = self.scale.shape[0]
        per_task = reward.view(n_tasks, -1)
        return ((per_task - self.shift[:, None]) * self.scale[:, None]).view(-1, 1)


ScalingRule = Callable[[RewardStatistics, float], tuple[th.Tensor, th.Tensor]]
"""Statistics and reward floor in, ``(scale, shift)`` out, each ``(n_tasks,)``."""


def mean_reward_scale(mean: th.Tensor, reward_floor: float = 0.01) -> th.Tensor:
    """Return c_i = max_j mean_j / max(mean_i, reward_floor).

    :param mean: ``(n_tasks,)`` mean raw reward of each task's buffer
    :param reward_floor: means below it count as this much, which bounds c_i
    :return: ``(n_tasks,)``, at least 1 for every task at or above the floor

    Source: paper, section 4.1, Eq. 6. Deviation: the floor, which the authors' code has and Eq. 6 has not.
    """
    # c_i = max_j mean_j / mean_i
    return mean.max() / mean.clamp(min=reward_floor)


def parse_reward_scaling(
    reward_scaling: str | float | Sequence[float] | Mapping[str, float] | None,
    task_names: Sequence[str],
) -> ScalingRule:
    """Return the rule that turns reward statistics into scale and shift.

    :param reward_scaling: ``"mean"`` (Eq. 6), ``"std"`` or ``"normalization"`` (Table 5), ``None`` or ``"none"``,
        one positive number for all tasks, or one per task as a sequence or a ``{task name: number}`` mapping
        (tasks left out of a mapping keep 1)
    :param task_names: the tasks, in order
    :raises ConfigError: if the name is unknown, a number is not positive, or a task is missing or unknown
    """
    if reward_scaling is None:
        return _none
    if isinstance(reward_scaling, str):
        if reward_scaling not in _RULES:
            raise ConfigError(
                f"reward_scaling={reward_scaling!r} is unknown; choose one of {sorted(_RULES)}, or give numbers."
                + nearest(reward_scaling, _RULES)
            )
        return _RULES[reward_scaling]
    return _fixed(_numbers_per_task(reward_scaling, task_names))


def _numbers_per_task(
    given: float | Sequence[float] | Mapping[str, float], task_names: Sequence[str]
) -> list[float]:
    if isinstance(given, Mapping):
        for name in given:
            if name not in task_names:
                raise ConfigError(
                    f"reward_scaling names the task {name!r}, which this env does not have; its tasks are "
                    f"{', '.join(task_names)}." + nearest(str(name), task_names)
                )
        numbers = [given.get(name, 1.0) for name in task_names]
    elif isinstance(given, Sequence):
        numbers = list(given)
        if len(numbers) != len(task_names):
            raise ConfigError(
                f"reward_scaling holds {len(numbers)} numbers for {len(task_names)} tasks "
                f"({', '.join(task_names)}); give one per task, or a {{task name: number}} mapping."
            )
    else:
        numbers = [given] * len(task_names)
    for name, number in zip(task_names, numbers, strict=True):
        is_number = isinstance(number, int | float) and not isinstance(number, bool)
        if not (is_number and 0 < number < float("inf")):
            raise ConfigError(
                f"reward_scaling for task {name!r} is {number!r}; it must be a positive number."
            )
    return numbers


def _none(statistics: RewardStatistics, reward_floor: float) -> tuple[th.Tensor, th.Tensor]:
    return th.ones_like(statistics.mean), th.zeros_like(statistics.mean)


def _mean(statistics: RewardStatistics, reward_floor: float) -> tuple[th.Tensor, th.Tensor]:
    mean = statistics.mean
    if mean.shape[0] == 1:  # one task is on its own scale, whatever the sign of its rewards
        return _none(statistics, reward_floor)
    # a mean of exactly 0 is met: pick-place-wall pays nothing to random actions; the floor gives such a task its c_i
    refused = [
        f"{n} ({m:.3g})" for n, m in zip(statistics.task_names, mean.tolist(), strict=True) if not m >= 0
    ]
    if refused:
        raise ConfigError(
            f"reward_scaling='mean' (Eq. 6) has no meaning for tasks whose mean reward is negative: "
            f"{', '.join(refused)}. Shift their rewards to be positive in the env, or use reward_scaling='std'."
        )
    if mean.max() < reward_floor:
        raise ConfigError(
            f"Every task's mean reward is below reward_floor={reward_floor} (the largest is {mean.max():.3g}), so all "
            "would get the same scale. Lower reward_floor, or make the rewards larger in the env."
        )
    return mean_reward_scale(mean, reward_floor), th.zeros_like(mean)


def _std(statistics: RewardStatistics, reward_floor: float) -> tuple[th.Tensor, th.Tensor]:
    # r / sigma(r_i)                                                       Source: paper, section 5.4, Table 5
    return 1.0 / _positive_std(statistics), th.zeros_like(statistics.mean)


def _normalization(statistics: RewardStatistics, reward_floor: float) -> tuple[th.Tensor, th.Tensor]:
    # (r - mean_i) / sigma(r_i)                                            Source: paper, section 5.4, Table 5
    return 1.0 / _positive_std(statistics), statistics.mean


def _positive_std(statistics: RewardStatistics) -> th.Tensor:
    constant = [
        name for name, std in zip(statistics.task_names, statistics.std.tolist(), strict=True) if not std > 0
    ]
    if constant:
        raise ConfigError(
            f"reward_scaling by standard deviation is undefined for tasks whose rewards never varied so far: "
            f"{', '.join(constant)}. Collect longer before the first update (learning_starts), or use "
            "reward_scaling='mean'."
        )
    return statistics.std


def _fixed(numbers: list[float]) -> ScalingRule:
    def rule(statistics: RewardStatistics, reward_floor: float) -> tuple[th.Tensor, th.Tensor]:
        return statistics.mean.new_tensor(numbers), th.zeros_like(statistics.mean)

    return rule


_RULES: dict[str, ScalingRule] = {"mean": _mean, "std": _std, "normalization": _normalization, "none": _none}
