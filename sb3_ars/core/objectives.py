"""What SAC and TQC do not share: the next value, the critic's loss and the value the actor climbs.

Critic outputs have shape ``(rows, n_critics, n_outputs)``; rows are task-major, ``n_outputs`` is 1 for SAC.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch as th
from torch.autograd.function import once_differentiable

__all__ = ["ActorValue", "Objective", "SACObjective", "TQCObjective", "quantile_huber_loss"]

ActorValue = Literal["all", "first"]
"""Which critics the actor's loss reads: all, reduced as SB3 and sb3-contrib do, or the first alone."""


class Objective(Protocol):
    """The three places where algorithms differ."""

    def next_value(self, q: th.Tensor) -> th.Tensor:
        """Return ``(rows, m)`` from the target critics' ``(rows, n_critics, n_outputs)``."""

    def loss(self, q: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Return a tensor with rows first whose mean over all elements is the critics' loss.

        :param q: ``(rows, n_critics, n_outputs)``
        :param target: ``(rows, m)``, as :meth:`next_value` gave it
        """

    def actor_value(self, q: th.Tensor) -> th.Tensor:
        """Return ``(rows, 1)``, what the actor maximises, from ``(rows, n_critics, n_outputs)``."""


@dataclass(frozen=True)
class SACObjective:
    """Clipped double Q-learning.

    :param actor_value_of: the minimum over ``"all"`` critics (SB3) or the ``"first"`` alone (the authors' code)

    Source: SAC (Haarnoja et al. 2018), with SB3's factor 1/2 on the loss.
    """

    actor_value_of: ActorValue = "all"

    def next_value(self, q: th.Tensor) -> th.Tensor:
        """Return the minimum over the critics, ``(rows, 1)``."""
        return q.min(dim=1).values

    def loss(self, q: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Return 1/2 sum_j (Q_j - y)^2 for each row, ``(rows, 1)``."""
        return 0.5 * (q - target.unsqueeze(1)).pow(2).sum(dim=1)

    def actor_value(self, q: th.Tensor) -> th.Tensor:
        """Return the minimum over the critics, or the first, ``(rows, 1)``."""
        return q.min(dim=1).values if self.actor_value_of == "all" else q[:, 0]


@dataclass(frozen=True)
class TQCObjective:
    """Truncated mixture of quantile critics.

    :param n_quantiles_to_drop: how many of the largest pooled target quantiles are dropped, over all critics
    :param actor_value_of: the mean over ``"all"`` critics and quantiles, or over the ``"first"`` critic's
    :param fused: compute the loss with its gradient, some rows at a time: the same up to rounding, and faster on a CPU

    Source: TQC (Kuznetsov et al. 2020), reductions as in sb3-contrib.
    """

    n_quantiles_to_drop: int
    actor_value_of: ActorValue = "all"
    fused: bool = False

    def next_value(self, q: th.Tensor) -> th.Tensor:
        """Return the smallest pooled quantiles, sorted, ``(rows, kept)``."""
        pooled, _ = th.sort(q.reshape(q.shape[0], -1))
        return pooled[:, : pooled.shape[1] - self.n_quantiles_to_drop]

    def loss(self, q: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Return the quantile Huber loss, ``(rows, n_critics, n_quantiles, kept)``; where ``fused``, rows' means."""
        if not self.fused:
            return quantile_huber_loss(q, target)
        loss: th.Tensor = _RowQuantileHuberLoss.apply(q, target)  # type: ignore[no-untyped-call]  # torch leaves it untyped
        return loss

    def actor_value(self, q: th.Tensor) -> th.Tensor:
        """Return the mean over quantiles and critics, or over the first critic's quantiles, ``(rows, 1)``."""
        per_critic = q.mean(dim=2)
        return per_critic.mean(dim=1, keepdim=True) if self.actor_value_of == "all" else per_critic[:, :1]


def quantile_huber_loss(quantiles: th.Tensor, target: th.Tensor) -> th.Tensor:
    """Return |tau_k - 1{y_m < q_k}| * huber(y_m - q_k) for every pair, unreduced.

    :param quantiles: ``(rows, n_critics, n_quantiles)``
    :param target: ``(rows, m)``
    :return: ``(rows, n_critics, n_quantiles, m)``

    Source: Dabney et al. 2018, Eq. 9 and 10, with kappa = 1 and midpoints tau_k = (k + 1/2) / n_quantiles.
    """
    n_quantiles = quantiles.shape[-1]
    midpoint = (th.arange(n_quantiles, device=quantiles.device, dtype=th.float) + 0.5) / n_quantiles
    error = target[:, None, None, :] - quantiles.unsqueeze(-1)
    magnitude = error.abs()
    huber = th.where(magnitude > 1, magnitude - 0.5, error**2 * 0.5)
    return (midpoint[:, None] - (error.detach() < 0).float()).abs() * huber


class _RowQuantileHuberLoss(th.autograd.Function):
    """Each row's mean of :func:`quantile_huber_loss`, ``(rows, 1)``.

    All pairs of thousands of rows leave a processor's caches, and each of autograd's steps would pass over them again.
    """

    _ROWS_AT_ONCE = 200

    @staticmethod
    def forward(ctx: Any, quantiles: th.Tensor, target: th.Tensor) -> th.Tensor:
        size, n_quantiles = _RowQuantileHuberLoss._ROWS_AT_ONCE, quantiles.shape[2]
        midpoint = (th.arange(n_quantiles, device=quantiles.device).unsqueeze(1) + 0.5) / n_quantiles
        losses, gradients = [], []
        for q, y in zip(th.split(quantiles, size), th.split(target, size), strict=True):
            error = y[:, None, None, :] - q.unsqueeze(3)
            clipped = error.clamp(-1, 1)
            slope = (midpoint - (error < 0).float()).abs_().mul_(clipped)
            # huber(e) = clip(e) (e - clip(e) / 2), whose derivative is clip(e)
            losses.append((slope * error.sub_(clipped, alpha=0.5)).mean(dim=(1, 2, 3)))
            gradients.append(slope.sum(dim=3) / -slope[0].numel())
        ctx.save_for_backward(th.cat(gradients))
        return th.cat(losses).unsqueeze(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * grad.unsqueeze(2), None
