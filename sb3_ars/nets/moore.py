"""MOORE: a mixture of experts made orthonormal for every row; knows no losses."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch as th
from torch import nn

from sb3_ars.nets.layers import Body, BodyShape, StackedLayerNorm, StackedLinear, StackedMLP, TaskLinear

__all__ = ["MOORE", "orthonormal", "orthonormal_coefficients"]

# of a residual's length to its expert's: float32 leaves 1e-7 where 0 is meant, which must not be blown up to 1
_RELATIVE_FLOOR = 1e-4
_ABSOLUTE_FLOOR = 1e-6  # of any length, for experts that give zero

_ROWS_AT_ONCE = 1000  # on a CPU: the experts' outputs for more rows leave its caches


class MOORE(Body):
    """y = W_i tanh(V w_i) + b_i, where V holds the experts' outputs after Gram-Schmidt.

    :param shape: ``hidden`` is one expert, whose last layer has no activation
    :param n_experts: K
    :param task_in_input: whether the experts see the one-hot

    Source: Hendawy et al. 2024, section 4. The one-hot in the experts' input is the ARS authors' code's; the original
    has none. Deviation: floors under the lengths in :func:`orthonormal`, where the original divides by zero.
    """

    fused: bool = False  # see :class:`~sb3_ars.nets.mlp.MLP`

    def __init__(
        self,
        shape: BodyShape,
        n_experts: int = 4,
        task_in_input: bool = True,
    ) -> None:
        super().__init__(task_in_input)
        in_features, out_features, n_tasks, hidden, activation, layer_norm = shape
        in_features += n_tasks * task_in_input
        layers: list[nn.Module] = [nn.LayerNorm(in_features)] if layer_norm else []
        widths = [in_features, *hidden]
        for width, next_width in pairwise(widths[:-1]):
            layers.append(StackedLinear(n_experts, width, next_width))
            layers += [StackedLayerNorm(n_experts, next_width)] if layer_norm else []
            layers.append(activation())
        layers.append(StackedLinear(n_experts, widths[-2], widths[-1]))
        self.experts = StackedMLP(*layers)
        self.mixture = nn.Linear(n_tasks, n_experts, bias=False)  # w_i is its column i
        nn.init.xavier_normal_(self.mixture.weight)
        self.heads = TaskLinear(widths[-1], out_features, n_tasks)

    def compute(self, x: th.Tensor, task: th.Tensor, task_major: bool) -> th.Tensor:
        """Return ``(rows, out_features)``; see :meth:`Body.compute`."""
        size = _ROWS_AT_ONCE if self.fused else len(x)
        parts = zip(th.split(x, size), th.split(task, size), strict=True)
        features = [self._features(*part) for part in parts]
        out: th.Tensor = self.heads(th.cat(features), task, task_major)
        return out

    def _features(self, x: th.Tensor, task: th.Tensor) -> th.Tensor:
        vectors = self.experts(x)
        # V w = U (T^t w): the basis itself is not needed
        weights = self.mixture(task).double().unsqueeze(1) @ orthonormal_coefficients(vectors)
        return th.tanh((vectors * weights.float().permute(2, 0, 1)).sum(dim=0))


def orthonormal(vectors: th.Tensor) -> th.Tensor:
    """Return an orthonormal basis of each row's vectors by Gram-Schmidt, float32, same shape; gradients pass.

    Where a vector depends on those before it, its place holds (nearly) zero instead of NaN.

    :param vectors: ``(n_vectors, rows, width)``

    Source: Hendawy et al. 2024, Eq. 4.
    """
    return th.einsum("rkm,mrd->krd", orthonormal_coefficients(vectors).float(), vectors.float())


def orthonormal_coefficients(vectors: th.Tensor) -> th.Tensor:
    """Return T, ``(rows, n_vectors, n_vectors)``, float64: the k-th basis vector is sum_m T_km u_m.

    Gram-Schmidt on the products u_k.u_m alone, so that long vectors are read once and not once per pair; in float64,
    because the products of similar vectors hold what distinguishes them in their last digits.

    :param vectors: ``(n_vectors, rows, width)``
    """
    gram: th.Tensor = _Gram.apply(vectors)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    eye = th.eye(len(vectors), dtype=gram.dtype, device=gram.device)
    basis: list[th.Tensor] = []
    for k, own in enumerate(eye):
        rest = own.expand(len(gram), -1)
        if basis:
            earlier = th.stack(basis, dim=1)
            overlap = earlier @ gram[:, k, :, None]  # u_k.v_m for m < k
            rest = rest - (overlap * earlier).sum(dim=1)
        # v = r / sqrt(|r|^2 + floor^2)
        square = (rest * (gram @ rest.unsqueeze(2)).squeeze(2)).sum(dim=1, keepdim=True)
        floor = _RELATIVE_FLOOR**2 * gram[:, k, k, None] + _ABSOLUTE_FLOOR**2
        basis.append(rest * (square + floor).rsqrt())
    return th.stack(basis, dim=1)


class _Gram(th.autograd.Function):
    """u_k.u_m for every row, ``(rows, n_vectors, n_vectors)``, float64; one product back, where autograd does two."""

    @staticmethod
    def forward(ctx: Any, vectors: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(vectors)
        by_row = vectors.transpose(0, 1).double()
        return by_row @ by_row.transpose(1, 2)

    @staticmethod
    def backward(ctx: Any, grad: th.Tensor) -> th.Tensor:
        (vectors,) = ctx.saved_tensors
        # dU = (G + G^t) U; a gradient needs no more than float32
        of_rows: th.Tensor = (grad + grad.transpose(1, 2)).to(vectors.dtype) @ vectors.transpose(0, 1)
        return of_rows.transpose(0, 1).contiguous()
