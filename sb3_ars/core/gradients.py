"""How the tasks' losses become one gradient: their mean, or PCGrad's projections; knows no networks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Protocol

import torch as th

from sb3_ars.errors import ConfigError, nearest

__all__ = ["Aggregate", "GradientCombiner", "MeanGradient", "PCGrad", "projected_weights"]

Aggregate = Literal["mean", "sum"]


class GradientCombiner(Protocol):
    """Turns the losses of groups of rows into one gradient.

    The caller computes whatever needs a gradient once for every group of :meth:`rows`, from those rows alone, so that
    each group's backward pass costs what its rows cost.
    """

    def rows(self, n_rows: int, n_tasks: int) -> list[slice]:
        """Return the groups, in order and without gaps.

        :param n_rows: rows of the batch, task-major with equal counts per task
        :param n_tasks: number of tasks
        """

    def combine(
        self, losses: Sequence[th.Tensor], parameters: Sequence[th.Tensor], order: th.Tensor | None = None
    ) -> list[th.Tensor | None]:
        """Return each parameter's gradient.

        :param losses: one scalar per group, the mean over its rows; no two share a graph
        :param parameters: of one network, or of several that are projected as one vector
        :param order: ``(n_tasks, n_tasks)``, from U(0, 1); read only by combiners that need randomness
        """


class MeanGradient:
    """The gradient of the mean over all rows, in one backward pass."""

    def rows(self, n_rows: int, n_tasks: int) -> list[slice]:
        """Return one group of all rows."""
        return [slice(0, n_rows)]

    def combine(
        self, losses: Sequence[th.Tensor], parameters: Sequence[th.Tensor], order: th.Tensor | None = None
    ) -> list[th.Tensor | None]:
        """Return autograd's gradients, ``None`` where the loss does not reach; see :class:`GradientCombiner`."""
        (loss,) = losses
        return list(th.autograd.grad(loss, parameters, allow_unused=True))


class PCGrad:
    """Each task's gradient loses its components against the others', then they are averaged.

    For each task i: v = g_i; for the other tasks j in a random order of i's own: if v.g_j < 0, then
    v -= (v.g_j / g_j.g_j) g_j with the original g_j. The result is the mean of all v.

    :param aggregate: ``"mean"``, or the publication's ``"sum"``, which differs by the factor n_tasks
    :raises ConfigError: for any other aggregate

    Source: Yu et al. 2020, algorithm 1. Deviation: the mean, as in every multi-task SAC; Adam hides the factor.
    """

    def __init__(self, aggregate: Aggregate = "mean") -> None:
        allowed = ("mean", "sum")
        if aggregate not in allowed:
            raise ConfigError(
                f"PCGrad's aggregate={aggregate!r} is unknown; choose one of {list(allowed)}."
                + nearest(str(aggregate), allowed)
            )
        self.aggregate = aggregate

    def rows(self, n_rows: int, n_tasks: int) -> list[slice]:
        """Return one group per task.

        :raises ConfigError: with one task, which has no other to conflict with
        """
        if n_tasks < 2:
            raise ConfigError(
                "PCGrad needs at least two tasks: it projects one's gradient on another's. "
                "With one task, use the mean gradient."
            )
        batch = n_rows // n_tasks
        return [slice(task * batch, (task + 1) * batch) for task in range(n_tasks)]

    def combine(
        self, losses: Sequence[th.Tensor], parameters: Sequence[th.Tensor], order: th.Tensor | None = None
    ) -> list[th.Tensor | None]:
        """Return the projected gradients, zero where no loss reaches; see :class:`GradientCombiner`."""
        assert order is not None
        sizes = [parameter.numel() for parameter in parameters]
        # (n_tasks, all parameters), float32: the only large tensor, 100 MB for 50 tasks and the paper's actor
        gradients = losses[0].new_empty(len(losses), sum(sizes))
        for task, loss in enumerate(losses):
            of_task = th.autograd.grad(loss, parameters, materialize_grads=True)
            gradients[task] = th.cat([gradient.flatten() for gradient in of_task])
        weights = projected_weights(_gram(gradients), order).sum(dim=0)
        if self.aggregate == "mean":
            weights = weights / len(losses)
        flat = th.mv(gradients.t(), weights.to(gradients.dtype))
        pieces = th.split(flat, sizes)
        return [piece.view_as(parameter) for piece, parameter in zip(pieces, parameters, strict=True)]


def _gram(gradients: th.Tensor) -> th.Tensor:
    """Return g_i.g_j, ``(n_tasks, n_tasks)``, in float64: neither cancellation nor TF32 decides what is a conflict.

    Summed over pieces that fit in a cache: two to four times as fast as one copy in float64, and without its memory.
    """
    gram = gradients.new_zeros(len(gradients), len(gradients), dtype=th.float64)
    for piece in th.split(gradients, 2**15, dim=1):
        exact = piece.double()
        gram += exact @ exact.t()
    return gram


def projected_weights(gram: th.Tensor, order: th.Tensor) -> th.Tensor:
    """Return C, ``(n_tasks, n_tasks)``: task i's projected gradient is sum_j C_ij g_j.

    All tasks take their s-th projection at once, on numbers of this size alone.

    :param gram: ``(n_tasks, n_tasks)``, g_i.g_j
    :param order: ``(n_tasks, n_tasks)``, from U(0, 1); task i visits the others by rising value in row i
    """
    n_tasks = gram.shape[0]
    eye = th.eye(n_tasks, dtype=gram.dtype, device=gram.device)
    visits = (order + 2 * eye).argsort(dim=1)  # itself comes last, and is left out
    length = gram.diagonal()
    weights = eye.clone()
    for step in range(n_tasks - 1):
        other = visits[:, step]
        dot = (weights * gram[other]).sum(dim=1)  # v_i.g_j = sum_k C_ik g_k.g_j
        # a gradient of zero has no dot product below zero
        move = th.where(dot < 0, dot / length[other], 0.0)
        weights = weights.scatter_add(1, other.unsqueeze(1), -move.unsqueeze(1))
    return weights
