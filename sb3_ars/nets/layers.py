"""What the multi-task bodies are made of: stacked layers, per-task layers and the contract; knows no method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_ars.nets.mlp import (
    _FUSABLE,
    MLP,
    Precision,
    _Fusable,
    _product,
    _through_activation,
    _weight_gradient,
)

__all__ = [
    "Body",
    "BodyShape",
    "ByTask",
    "StackedLayerNorm",
    "StackedLinear",
    "StackedMLP",
    "TaskLinear",
    "stacked_product",
    "trunk",
]


class BodyShape(NamedTuple):
    """What every body is built from, beside its own options.

    :param in_features: width of the input, without the one-hot
    :param out_features: width of the output
    :param n_tasks: number of tasks
    :param hidden: widths of the hidden layers; each body says what it makes of them
    :param activation: class of the activation of hidden layers
    :param layer_norm: LayerNorm on the input and before every activation on the way to the output
    """

    in_features: int
    out_features: int
    n_tasks: int
    hidden: Sequence[int]
    activation: type[nn.Module]
    layer_norm: bool = False


class Body(nn.Module, ABC):
    """A network whose output depends on the task of each row.

    Two forms of input, told apart by their number of dimensions, so that nothing depends on data:

    - ``x (rows, in_features)``, ``task (rows, n_tasks)``: any tasks in any order;
    - ``x (n_tasks, batch, in_features)``, ``task (n_tasks, batch, n_tasks)``: task i's rows at index i, as in every
      training batch. The same function in other products: those with one task's own parameters cost as much per row
      at 50 tasks as at one.

    :param task_in_input: whether the one-hot is appended to ``x``
    """

    def __init__(self, task_in_input: bool) -> None:
        super().__init__()
        self.task_in_input = task_in_input

    def forward(self, x: th.Tensor, task: th.Tensor) -> th.Tensor:
        """Return ``(..., out_features)``, float32.

        :param x: observation, for critics with the action behind it, without the one-hot
        :param task: one-hot, float32
        """
        flat, flat_task = x.flatten(0, -2).float(), task.flatten(0, -2)
        if self.task_in_input:
            flat = th.cat([flat, flat_task], dim=1)
        return self.compute(flat, flat_task, task_major=x.dim() == 3).view(*x.shape[:-1], -1)

    @abstractmethod
    def compute(self, x: th.Tensor, task: th.Tensor, task_major: bool) -> th.Tensor:
        """Return ``(rows, out_features)``.

        :param x: ``(rows, in_features)``, with the one-hot where ``task_in_input``
        :param task: ``(rows, n_tasks)``
        :param task_major: whether the rows are known to be task-major with equal counts
        """


class ByTask(nn.Module):
    """A body in the place of a plain network: takes the one-hot out of its input.

    :param body: the network
    :param obs_dim: width of what stands before the one-hot
    :param n_tasks: width of the one-hot; what follows it, for critics the action, belongs to the input
    """

    def __init__(self, body: Body, obs_dim: int, n_tasks: int) -> None:
        super().__init__()
        self.body, self.obs_dim, self.n_tasks = body, obs_dim, n_tasks

    def forward(self, x: th.Tensor, task_major: bool = False) -> th.Tensor:
        """Return ``(rows, out_features)``.

        :param x: ``(rows, obs_dim + n_tasks + rest)``
        :param task_major: whether the rows are known to be task-major with equal counts
        """
        obs, task, rest = th.tensor_split(x, (self.obs_dim, self.obs_dim + self.n_tasks), dim=1)
        x = th.cat([obs, rest], dim=1)
        if task_major:
            x, task = (rows.reshape(self.n_tasks, -1, rows.shape[1]) for rows in (x, task))
        out: th.Tensor = self.body(x, task)
        return out.flatten(0, -2)


class TaskLinear(nn.Linear):
    """One linear layer per task, held as one wide layer; each row passes through its own task's.

    :param in_features: width of the input
    :param out_features: width of one task's output
    :param n_tasks: number of tasks

    Deviation: Xavier's scale, where asked for, is that of the wide layer, as in the authors' code.
    """

    def __init__(self, in_features: int, out_features: int, n_tasks: int) -> None:
        super().__init__(in_features, n_tasks * out_features)
        self.n_tasks = n_tasks

    def forward(self, x: th.Tensor, task: th.Tensor, task_major: bool) -> th.Tensor:  # type: ignore[override]  # a row's task is needed
        """Return ``(rows, out_features)``; arguments as in :meth:`Body.compute`."""
        if not task_major:
            of_all = super().forward(x).view(len(x), self.n_tasks, -1)
            return (of_all * task.unsqueeze(2)).sum(dim=1)
        weight = self.weight.view(self.n_tasks, -1, self.in_features)
        bias = self.bias.view(self.n_tasks, -1)
        return stacked_product(x.view(self.n_tasks, -1, self.in_features), weight, bias).flatten(0, 1)


class StackedLinear(nn.Module):
    """Several linear layers of one shape, each with its own input or all with the same one.

    With one input for all it is one wide layer. ``fused`` and ``precision`` mean what they mean in
    :class:`~sb3_ars.nets.mlp.MLP`; a shared input is the network's own and stays float32.

    :param n_copies: how many
    :param in_features: width of each input
    :param out_features: width of each output
    :param identical: whether the copies start equal
    """

    fused: bool = False
    precision: Precision = "fp32"

    def __init__(self, n_copies: int, in_features: int, out_features: int, identical: bool = False) -> None:
        super().__init__()
        self.identical = identical
        layers = [nn.Linear(in_features, out_features) for _ in range(1 if identical else n_copies)]
        layers *= n_copies // len(layers)
        self.weight = nn.Parameter(th.stack([layer.weight.detach() for layer in layers]))
        self.bias = nn.Parameter(th.stack([layer.bias.detach() for layer in layers]))

    @th.no_grad()
    def xavier_(self) -> None:
        """Give every copy Xavier-normal weights and zero bias, in place; equal copies stay equal."""
        for copy in self.weight:
            nn.init.xavier_normal_(copy)
        if self.identical:
            self.weight.copy_(self.weight[0].clone())
        nn.init.zeros_(self.bias)

    def forward(self, x: th.Tensor, activation: _Fusable = "none") -> th.Tensor:
        """Return ``(n_copies, rows, out_features)``, float32.

        :param x: ``(rows, in_features)`` for all copies, or ``(n_copies, rows, in_features)``
        :param activation: done in the same call; only where ``fused``
        """
        if x.dim() == 3:
            return stacked_product(x, self.weight, self.bias, self.fused, self.precision, activation)
        if self.fused:
            x = x.expand(len(self.weight), *x.shape)
            return stacked_product(x, self.weight, self.bias, fused=True, activation=activation)
        wide = nn.functional.linear(x, self.weight.flatten(0, 1), self.bias.flatten())
        return wide.view(-1, *self.bias.shape).transpose(0, 1)


class StackedMLP(nn.Sequential):
    """``nn.Sequential`` of stacked layers and activations; where ``fused``, a layer and its activation are one call."""

    fused: bool = False

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Return ``(n_copies, rows, out_features)``, float32.

        :param x: ``(rows, in_features)``
        """
        layers = list(self)
        skip = False
        for layer, following in zip(layers, [*layers[1:], layers[-1]], strict=True):
            activation = _FUSABLE.get(type(following), "none")
            if skip:
                skip = False
            elif self.fused and isinstance(layer, StackedLinear):
                x, skip = layer(x, activation), activation != "none"
            else:
                x = layer(x)
        return x


class StackedLayerNorm(nn.Module):
    """Several layer norms of one width, each on its own input.

    :param n_copies: how many
    :param width: width of each input
    """

    def __init__(self, n_copies: int, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(th.ones(n_copies, 1, width))
        self.bias = nn.Parameter(th.zeros(n_copies, 1, width))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Return the same shape as ``x``, ``(n_copies, rows, width)``."""
        return nn.functional.layer_norm(x, x.shape[-1:]) * self.weight + self.bias


def trunk(
    in_features: int, hidden: Sequence[int], activation: type[nn.Module], layer_norm: bool = False
) -> MLP:
    """Return hidden layers, each followed by its activation.

    :param in_features: width of the input
    :param hidden: widths of the layers
    :param activation: class of the activation
    :param layer_norm: LayerNorm on the input and before every activation
    """
    layers: list[nn.Module] = [nn.LayerNorm(in_features)] if layer_norm else []
    for width in hidden:
        layers.append(nn.Linear(in_features, width))
        layers += [nn.LayerNorm(width)] if layer_norm else []
        layers.append(activation())
        in_features = width
    return MLP(*layers)


def stacked_product(
    x: th.Tensor,
    weight: th.Tensor,
    bias: th.Tensor,
    fused: bool = False,
    precision: Precision = "fp32",
    activation: _Fusable = "none",
) -> th.Tensor:
    """Return activation(x_k W_k^T + b_k) for every k, float32, ``(n, rows, out_features)``.

    :param x: ``(n, rows, in_features)``
    :param weight: ``(n, out_features, in_features)``
    :param bias: ``(n, out_features)``
    :param fused: one oneDNN call for each k, CPU only
    :param precision: of the operands
    :param activation: only where ``fused``
    """
    dtype = th.bfloat16 if precision == "bf16" else th.float32
    x, weight, bias = x.to(dtype), weight.to(dtype), bias.to(dtype)
    if not fused:
        return th.baddbmm(bias.unsqueeze(1), x, weight.transpose(1, 2)).float()
    out: th.Tensor = _StackedProduct.apply(x, weight, bias, activation)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    return out.float()


class _StackedProduct(th.autograd.Function):
    """activation(x_k W_k^T + b_k) and its gradients in oneDNN calls.

    Rows are made contiguous first: for rows of a strided view, as mixing leaves them, oneDNN takes a path that is a
    hundred times slower.
    """

    @staticmethod
    def forward(
        ctx: Any, x: th.Tensor, weight: th.Tensor, bias: th.Tensor, activation: _Fusable
    ) -> th.Tensor:
        if x.stride(0) > 0:  # one input for all copies is one already
            x = x.contiguous()
        out = th.stack([_product(*one, activation) for one in zip(x, weight, bias, strict=True)])
        ctx.activation = activation
        ctx.save_for_backward(x, weight, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
        x, weight, out = ctx.saved_tensors
        grad = _through_activation(grad.contiguous(), out, ctx.activation)
        of_x, of_weight, of_bias, _ = ctx.needs_input_grad
        return (
            th.stack([_product(g, w.t()) for g, w in zip(grad, weight, strict=True)]) if of_x else None,
            th.stack([_weight_gradient(g, i) for g, i in zip(grad, x, strict=True)]) if of_weight else None,
            grad.sum(1, dtype=th.float32) if of_bias else None,
            None,
        )
