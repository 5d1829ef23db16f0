"""Changes to plain multi-layer perceptrons: layer normalisation and Xavier weights."""

from __future__ import annotations

from torch import nn

__all__ = ["with_layer_norm", "xavier_"]


def with_layer_norm(net: nn.Sequential) -> nn.Sequential:
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
    return nn.Sequential(*layers)


def xavier_(module: nn.Module) -> None:
    """Give every linear layer Xavier-normal weights and zero bias, in place.

    Source: the authors' code; the paper does not say.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_normal_(layer.weight)
            nn.init.zeros_(layer.bias)
