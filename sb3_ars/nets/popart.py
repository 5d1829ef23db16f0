"""PopArt: an output layer per task that learns normalised values and keeps its outputs when the scale moves."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from torch import nn

from sb3_ars.nets.layers import Body, BodyShape, TaskLinear, trunk

__all__ = ["PopArt", "PopArtNetwork", "PopArtNormalizer", "update_statistics"]

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


class PopArtNetwork(Body):
    """A plain network whose last layer is PopArt's, for critics.

    :param shape: ``hidden`` is the network before the last layer
    :param update_period: updates from one refresh of mu and sigma to the next
    :param rate: beta, weight of a batch in the running statistics
    :param task_in_input: whether the network sees the one-hot besides choosing the output by it

    Source: ARS paper, appendix E.3, which integrates Hessel et al. 2019 into SAC-MT. Deviation: an output row per task,
    without which outputs could not be preserved; the paper does not say.
    """

    def __init__(
        self, shape: BodyShape, update_period: int = 1, rate: float = 3e-4, task_in_input: bool = True
    ) -> None:
        super().__init__(task_in_input)
        in_features, out_features, n_tasks, hidden, activation, layer_norm = shape
        self.update_period, self.rate = update_period, rate
        in_features += n_tasks * task_in_input
        self.trunk = trunk(in_features, hidden, activation, layer_norm)
        self.popart = PopArt(hidden[-1] if hidden else in_features, n_tasks, out_features)

    def compute(self, x: th.Tensor, task: th.Tensor, task_major: bool) -> th.Tensor:
        """Return ``(rows, out_features)``, in units of the target; see :meth:`Body.compute`."""
        out: th.Tensor = self.popart(self.trunk(x), task, task_major)
        return out


class PopArtNormalizer:
    """The statistics that several PopArt layers share.

    :param networks: critics and target critics
    """

    def __init__(self, networks: Sequence[PopArtNetwork]) -> None:
        self._layers = [network.popart for network in networks]
        self._rate = networks[0].rate
        self.update_period = networks[0].update_period

    @property
    def mean(self) -> th.Tensor:
        """mu, ``(n_tasks,)``, in units of the target."""
        return self._layers[0].mean

    @property
    def std(self) -> th.Tensor:
        """sigma, ``(n_tasks,)``."""
        return self._layers[0].std

    def update_(self, target: th.Tensor, refresh: bool) -> None:
        """Track the targets, and every ``update_period``-th time put the statistics to use.

        :param target: ``(n_tasks * batch, m)``, task-major
        :param refresh: whether this is such a time
        """
        update_statistics(self._layers, target, self._rate, refresh)


@th.no_grad()
def update_statistics(
    layers: Sequence[PopArt], targets: th.Tensor, rate: float, refresh: bool = True
) -> None:
    """Move the running statistics to the targets and, where told to, put them to use with every output preserved.

    All in place, the same for all layers: both critics and both target critics share their mu and sigma.

    :param layers: with equal statistics
    :param targets: ``(n_tasks * batch, m)``, task-major
    :param rate: beta, weight of the new batch, in (0, 1]
    :param refresh: whether mu and sigma follow in this step: every k-th for update period k

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
    for layer in layers:
        layer.running_mean.copy_(running_mean)
        layer.running_variance.copy_(running_variance)
    if not refresh:
        return
    std = running_variance.sqrt().clamp(_STD_MIN, _STD_MAX)
    ratio, shift = first.std / std, (first.mean - running_mean) / std
    for layer in layers:
        # W <- (sigma / sigma') W, b <- (sigma b + mu - mu') / sigma', for each task's own rows
        layer.linear.weight.view(layer.n_tasks, -1).mul_(ratio.unsqueeze(1))
        layer.linear.bias.view(layer.n_tasks, -1).mul_(ratio.unsqueeze(1)).add_(shift.unsqueeze(1))
        layer.mean.copy_(running_mean)
        layer.std.copy_(std)
