"""Multi-layer perceptrons: plain torch, or the same layers in fewer and faster calls, in float32 or bfloat16."""

from __future__ import annotations

from typing import Any, Literal

import torch as th
from torch import nn
from torch.autograd.function import FunctionCtx, once_differentiable

__all__ = ["MLP", "fused_layers_are_available", "set_arithmetic", "with_layer_norm", "xavier_"]

Precision = Literal["fp32", "bf16"]
_Fusable = Literal["none", "relu", "tanh"]

_FUSABLE: dict[type[nn.Module], _Fusable] = {nn.ReLU: "relu", nn.Tanh: "tanh"}


class MLP(nn.Sequential):
    """``nn.Sequential`` of linear layers, layer norms and activations, with a choice of how it is computed.

    As built it is ``nn.Sequential``, to the bit. :func:`set_arithmetic` changes two things:

    ``fused``: a linear layer and its ReLU or Tanh are one oneDNN call, forward and backward; CPU only. Same
    float32 arithmetic in another order.

    ``precision="bf16"``: the products between hidden layers have bfloat16 operands and float32 sums. What carries
    meaning at fine resolution stays float32: the input layer, the output layer, the parameters, layer norms.
    """

    fused: bool = False
    precision: Precision = "fp32"

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Return the last layer's output, float32, ``(rows, out_features)``.

        :param x: ``(rows, in_features)``, float32
        """
        if not self.fused and self.precision == "fp32":
            out: th.Tensor = super().forward(x)  # type: ignore[no-untyped-call]  # torch leaves it untyped
            return out
        layers = list(self)
        linears = [index for index, layer in enumerate(layers) if isinstance(layer, nn.Linear)]
        hidden = linears[1:] if linears and linears[-1] < len(layers) - 1 else linears[1:-1]
        skip = False
        for index, layer in enumerate(layers):
            if skip:
                skip = False
            elif isinstance(layer, nn.Linear):
                following: nn.Module = layers[index + 1] if index + 1 < len(layers) else layer
                activation: _Fusable = _FUSABLE.get(type(following), "none")
                half = self.precision == "bf16" and index in hidden
                x = self._linear(x.bfloat16() if half else x.float(), layer, activation)
                skip = activation != "none"
            elif isinstance(layer, nn.Tanh) and self.fused:
                x = _Tanh.apply(x)  # type: ignore[no-untyped-call]  # torch leaves apply untyped
            else:
                x = layer(x.float())
        return x.float()

    def _linear(self, x: th.Tensor, layer: nn.Linear, activation: _Fusable) -> th.Tensor:
        if self.fused:
            fused: th.Tensor = _Linear.apply(x, layer.weight, layer.bias, activation)  # type: ignore[no-untyped-call]
            return fused
        bias = None if layer.bias is None else layer.bias.to(x.dtype)
        out = nn.functional.linear(x, layer.weight.to(x.dtype), bias)
        return out if activation == "none" else getattr(th, activation)(out)


def set_arithmetic(module: nn.Module, fused: bool, precision: Precision) -> None:
    """Choose how every :class:`MLP` inside ``module``, and every other layer with these attributes, is computed.

    :param module: actor, critics or a whole policy
    :param fused: see :class:`MLP`
    :param precision: see :class:`MLP`
    """
    for layer in module.modules():
        for attribute, value in (("fused", fused), ("precision", precision)):
            if hasattr(layer, attribute):
                setattr(layer, attribute, value)


def fused_layers_are_available() -> bool:
    """Return whether this build of torch has oneDNN's linear layers (x86 and Arm Linux builds do)."""
    has_onednn = bool(th.backends.mkldnn.is_available())  # type: ignore[no-untyped-call]  # torch leaves it untyped
    return has_onednn and hasattr(th.ops.mkldnn, "_linear_pointwise")


class _Linear(th.autograd.Function):
    """activation(x W^T + b) and its gradients, each product one oneDNN call, in the type of x.

    torch's own float32 product goes through MKL, which takes a slow path on AMD: half of oneDNN's speed there.
    """

    @staticmethod
    def forward(
        ctx: Any, x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, activation: _Fusable
    ) -> th.Tensor:
        weight = weight.to(x.dtype)
        out = _product(x, weight, None if bias is None else bias.to(x.dtype), activation)
        ctx.activation = activation
        ctx.save_for_backward(x, weight, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
        x, weight, out = ctx.saved_tensors
        of_x, of_weight, of_bias, _ = ctx.needs_input_grad
        grad = _through_activation(grad, out, ctx.activation)
        return (
            _product(grad, weight.t()) if of_x else None,
            _weight_gradient(grad, x) if of_weight else None,
            grad.sum(0, dtype=th.float32) if of_bias else None,
            None,
        )


class _Tanh(th.autograd.Function):
    """tanh(x) = 2 sigmoid(2x) - 1, for which torch's CPU kernel is five times as fast; 1e-7 off at most."""

    @staticmethod
    def forward(ctx: FunctionCtx, x: th.Tensor) -> th.Tensor:
        out = x.float().mul(2).sigmoid_().mul_(2).sub_(1).to(x.dtype)
        ctx.save_for_backward(out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: th.Tensor) -> th.Tensor:
        (out,) = ctx.saved_tensors
        gradient: th.Tensor = th.ops.aten.tanh_backward(grad, out)
        return gradient


def _through_activation(grad: th.Tensor, out: th.Tensor, activation: _Fusable) -> th.Tensor:
    """Return the gradient before the activation, from the one after it and its output."""
    if activation == "relu":
        grad = th.ops.aten.threshold_backward(grad, out, 0)
    elif activation == "tanh":
        grad = th.ops.aten.tanh_backward(grad, out)
    return grad


def _product(
    x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None, activation: _Fusable = "none"
) -> th.Tensor:
    # transposed views go in as they are; copying them first would take as long as the product
    out: th.Tensor = th.ops.mkldnn._linear_pointwise(x, weight, bias, activation, [], "")
    return out


def _weight_gradient(grad: th.Tensor, x: th.Tensor) -> th.Tensor:
    """Return grad^T x, float32; in bfloat16 torch's own product is oneDNN's and the faster call for this shape."""
    return (grad.t() @ x).float() if x.dtype == th.bfloat16 else _product(grad.t(), x.t())


def with_layer_norm(net: nn.Sequential) -> MLP:
    """Return the same layers with LayerNorm on the input and on every hidden layer before its activation.

    The linear layers are reused, so for one seed the weights are those of the plain network.

    :param net: ``Linear, activation, Linear, activation, ..., Linear``

    Source: paper, section 4.3 (ARS-LN); the authors' code normalises the concatenated input and each pre-activation.
    """
    linears = [layer for layer in net if isinstance(layer, nn.Linear)]
    layers: list[nn.Module] = [nn.LayerNorm(linears[0].in_features)]
    for layer in net:
        layers.append(layer)
        if isinstance(layer, nn.Linear) and layer is not linears[-1]:
            layers.append(nn.LayerNorm(layer.out_features))
    return MLP(*layers)


def xavier_(module: nn.Module) -> None:
    """Give every linear layer Xavier-normal weights and zero bias, in place.

    Source: the authors' code; the paper does not say.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_normal_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        elif callable(own := getattr(layer, "xavier_", None)):
            own()
