"""PopArt: an output layer per task that learns normalised values and keeps its outputs when the scale moves."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from torch import nn

from sb3_ars.nets.layers import TaskLinear

__all__ = ["PopArt", "update_statistics"]

_STD_MIN, _STD_MAX = 1e-4, 1e6


class PopArt(nn.Module):
    """Q = sigma_i n_i(h) + mu_i, where n_i is task i's own row of the last linear layer.

    A row of its own for every task is what lets the layer absorb a change of the task's mu and sigma; one row for all
    could not.

    :param in_features: width of the input
    :param n_tasks: number of tasks
    :param n_outputs: values per task, 1 for SAC, the quantiles for TQC

    Buffers, ``(n_tasks,)``, in units of the target: ``mean`` (mu) and ``std`` (sigma) in use, ``running_mean`` and
    ``running_variance`` (nu - mu^2) of the targets so far. They start at mu = 0, sigma = 1.

    Source: van Hasselt et al. 2016; per task as in Hessel et al. 2019.
    """

    mean: th.Tensor
    std: th.Tensor
    running_mean: th.Tensor
    running_variance: th.Tensor

    def __init__(self, in_features: int, n_tasks: int, n_outputs: int = 1) -> None:
        super().__init__()
        self.n_tasks = n_tasks
        self.linear = TaskLinear(in_features, n_outputs, n_tasks)
        for name, start in (("mean", 0.0), ("std", 1.0), ("running_mean", 0.0), ("running_variance", 1.0)):
            self.register_buffer(name, th.full((n_tasks,), start))

    def forward(self, features: th.Tensor, task: th.Tensor, task_major: bool = False) -> th.Tensor:
        """Return Q, in units of the target, ``(rows, n_outputs)``; arguments as in :meth:`normalized`."""
        return self.denormalize(self.normalized(features, task, task_major), task)

    def normalized(self, features: th.Tensor, task: th.Tensor, task_major: bool = False) -> th.Tensor:
        """Return n, ``(rows, n_outputs)``.

        :param features: ``(rows, in_features)``
        :param task: one-hot, ``(rows, n_tasks)``
        :param task_major: whether the rows are known to be task-major with equal counts
        """
        out: th.Tensor = self.linear(features, task, task_major)
        return out

    def denormalize(self, values: th.Tensor, task: th.Tensor) -> th.Tensor:
        """Return sigma_i n + mu_i, same shape.

        :param values: ``(rows, m)``, normalised
        :param task: one-hot, ``(rows, n_tasks)``
        """
        return values * self._of_row(self.std, task) + self._of_row(self.mean, task)

    def normalize(self, values: th.Tensor, task: th.Tensor) -> th.Tensor:
        """Return (y - mu_i) / sigma_i, same shape.

        :param values: ``(rows, m)``, in units of the target
        :param task: one-hot, ``(rows, n_tasks)``
        """
        return (values - self._of_row(self.mean, task)) / self._of_row(self.std, task)

    @staticmethod
    def _of_row(per_task: th.Tensor, task: th.Tensor) -> th.Tensor:
        """Return ``(rows, 1)``; a sum of one number and zeros, and so exact where a product in TF32 would not be."""
        return (task * per_task).sum(dim=1, keepdim=True)


@th.no_grad()
def update_statistics(
    layers: Sequence[PopArt], targets: th.Tensor, rate: float, refresh: bool | th.Tensor = True
) -> None:
    """Move the running statistics to the targets and, where told to, put them to use with every output preserved.

    All in place, the same for all layers: both critics and both target critics share their mu and sigma.

    :param layers: with equal statistics
    :param targets: ``(n_tasks * batch, m)``, task-major
    :param rate: beta, weight of the new batch, in (0, 1]
    :param refresh: whether mu and sigma follow in this step: every k-th for update period k; a bool, or a scalar float
        tensor of 1 or 0 where a captured graph has to be told

    Source: van Hasselt et al. 2016, Eq. 4 and 5. Deviation: where statistics are put to use every k-th step, they
    are still tracked at every one. The variance is tracked in place of the second moment: the same numbers without
    cancellation.
    """
    first = layers[0]
    batch = targets.reshape(first.n_tasks, -1)
    batch_variance, batch_mean = th.var_mean(batch, dim=1, correction=0)
    # mu' = mu + beta d, nu' - mu'^2 = (1 - beta) (var + beta d^2) + beta var_b, d = mean_b y - mu
    distance = batch_mean - first.running_mean
    running_mean = first.running_mean + rate * distance
    running_variance = (1 - rate) * (first.running_variance + rate * distance**2) + rate * batch_variance
    weight = refresh if isinstance(refresh, th.Tensor) else float(refresh)
    mean = first.mean.lerp(running_mean, weight)
    std = first.std.lerp(running_variance.sqrt().clamp(_STD_MIN, _STD_MAX), weight)
    ratio, shift = first.std / std, (first.mean - mean) / std
    for layer in layers:
        # W <- (sigma / sigma') W, b <- (sigma b + mu - mu') / sigma', for each task's own rows
        layer.linear.weight.view(layer.n_tasks, -1).mul_(ratio.unsqueeze(1))
        layer.linear.bias.view(layer.n_tasks, -1).mul_(ratio.unsqueeze(1)).add_(shift.unsqueeze(1))
        for buffer, value in (
            (layer.mean, mean),
            (layer.std, std),
            (layer.running_mean, running_mean),
            (layer.running_variance, running_variance),
        ):
            buffer.copy_(value)
