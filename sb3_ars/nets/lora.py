"""Low-rank adapters on linear layers, for each task or shared, added to a trained network; knows no algorithms."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import torch as th
from torch import nn

from sb3_ars.errors import ConfigError, check_count, nearest
from sb3_ars.nets.mlp import _Linear

__all__ = [
    "LoRAConfig",
    "LoRALinear",
    "TaskOfRows",
    "adapters",
    "add_adapters",
    "layers_to_adapt",
    "merge_adapters",
    "renew_adapters",
]

Scale = Literal["released", "paper"]
AdaptedLayers = Literal["all", "hidden"]


@dataclass(frozen=True)
class LoRAConfig:
    """Options of the adapters; the defaults are the authors' code's, whose paper differs in all but the rank.

    :raises ConfigError: naming the option, what was given and what is allowed
    """

    rank: int = 8
    """Width of the bottleneck, r: 8 for MT10, 16 for MT50."""
    per_task: bool = True
    """Whether every task has its own adapters (the authors' code) or all share one (the paper)."""
    scale: Scale = "released"
    """Factor on B A: "released" is 1/r, "paper" is 1."""
    layers: AdaptedLayers = "all"
    """"all": output layers too (the authors' code); "hidden": the input and hidden layers (the paper)."""
    start: float = 0.75
    """Share of the run after which the next reset adds adapters instead: 0.75 for MT10, 0.833 for MT50."""
    min_success: float = 0.8
    """Mean training success below which networks are reset as before: the authors' 0.8, MT50 0.65; 0 is the paper's."""
    rescale_critic: bool = True
    """Whether the frozen critics' values follow c_i, times new over old (the authors' code; not in the paper)."""

    def __post_init__(self) -> None:
        check_count("lora option rank", self.rank)
        for option in ("per_task", "rescale_critic"):
            if not isinstance(getattr(self, option), bool):
                raise ConfigError(f"lora option {option}={getattr(self, option)!r} must be True or False.")
        for option in ("start", "min_success"):
            value = getattr(self, option)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
                raise ConfigError(f"lora option {option}={value!r} must be between 0 and 1.")
        for option, allowed in (("scale", get_args(Scale)), ("layers", get_args(AdaptedLayers))):
            value = getattr(self, option)
            if value not in allowed:
                raise ConfigError(
                    f"lora option {option}={value!r} is unknown; choose one of {list(allowed)}."
                    + nearest(str(value), allowed)
                )

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> LoRAConfig:
        """Return the checked options.

        :param options: fields by name; those not given have the authors' code's value for MT10
        :raises ConfigError: for an unknown option, or a value that cannot work
        """
        if not isinstance(options, Mapping):
            raise ConfigError(
                f"lora={options!r} must be a mapping of options, such as {{'rank': 8}}, or None."
            )
        allowed = [field.name for field in fields(cls)]
        for option in options:
            if option not in allowed:
                raise ConfigError(
                    f"lora has no option {option!r}; it has {allowed}." + nearest(str(option), allowed)
                )
        return cls(**options)

    @property
    def factor(self) -> float:
        """The number on B A."""
        return 1 / self.rank if self.scale == "released" else 1.0


class TaskOfRows:
    """Tells the adapters of one network which task each row belongs to.

    Layers inside a network see features, not tasks. Unless told otherwise, rows are task-major with equal counts, as in
    every training batch, which is also the cheap case.
    """

    def __init__(self) -> None:
        self.task: th.Tensor | None = None

    @contextlib.contextmanager
    def rows(self, task: th.Tensor) -> Iterator[None]:
        """For rows in any order.

        :param task: one-hot, ``(rows, n_tasks)``
        """
        self.task = task
        try:
            yield
        finally:
            self.task = None


class LoRALinear(nn.Module):
    """h = W x + b + factor * B_i A_i x, with W and b frozen.

    It is no ``nn.Linear``, so that nothing takes its ``weight`` for the whole layer; ``weight`` and ``bias`` keep the
    names they had.

    :param base: the trained layer, whose parameters become this one's
    :param config: rank and factor
    :param n_adapters: number of tasks, or 1 for all
    :param tasks: shared by the adapters of one network
    :param fused: whether W x is one oneDNN call

    Source: Hu et al. 2022, Eq. 3.
    """

    def __init__(
        self, base: nn.Linear, config: LoRAConfig, n_adapters: int, tasks: TaskOfRows, fused: bool = False
    ) -> None:
        super().__init__()
        self.weight, self.bias = base.weight, base.bias
        self.factor, self.tasks, self.fused = config.factor, tasks, fused
        out_features, in_features = base.weight.shape
        self.lora_a = nn.Parameter(base.weight.new_empty(n_adapters, config.rank, in_features))
        self.lora_b = nn.Parameter(base.weight.new_empty(n_adapters, out_features, config.rank))
        self.renew_()

    @th.no_grad()
    def renew_(self) -> None:
        """Draw A anew and set B to zero, in place: the layer is its base, and B, not A, has a gradient.

        Source: Hu et al. 2022, section 4.1. The paper of ARS says A = B = 0, whose gradients are zero for ever.
        """
        nn.init.normal_(self.lora_a, std=1 / math.sqrt(self.lora_a.shape[2]))
        nn.init.zeros_(self.lora_b)

    def delta(self) -> th.Tensor:
        """Return factor * B A, ``(n_adapters, out_features, in_features)``."""
        return self.factor * self.lora_b @ self.lora_a

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Return ``(rows, out_features)``, float32.

        :param x: ``(rows, in_features)``
        """
        x = x.float()
        if self.fused:
            base: th.Tensor = _Linear.apply(x, self.weight, self.bias, "none")  # type: ignore[no-untyped-call]  # torch's
        else:
            base = nn.functional.linear(x, self.weight, self.bias)
        return base + self.factor * self._adapted(x)

    def _adapted(self, x: th.Tensor) -> th.Tensor:
        n_adapters, rank, _ = self.lora_a.shape
        if n_adapters == 1:
            return x @ self.lora_a[0].t() @ self.lora_b[0].t()
        task = self.tasks.task
        if task is None:
            of_task = x.view(n_adapters, -1, x.shape[1])
            return (of_task @ self.lora_a.transpose(1, 2) @ self.lora_b.transpose(1, 2)).flatten(0, 1)
        # every task's A on every row, then all but the row's own set to zero
        inner = (x @ self.lora_a.flatten(0, 1).t()).view(len(x), n_adapters, rank) * task.unsqueeze(2)
        return inner.flatten(1) @ self.lora_b.transpose(1, 2).flatten(0, 1)


def add_adapters(network: nn.Module, config: LoRAConfig, n_tasks: int) -> TaskOfRows:
    """Replace linear layers by adapted ones and freeze everything but adapters and layer norms; outputs stay.

    Optimizers have to be given :func:`adapters` instead of what they hold.

    :param network: actor or critics, changed in place; names in its ``state_dict`` stay, the adapters' are added
    :param config: options
    :param n_tasks: number of tasks
    :return: to be told each row's task where rows are not task-major
    :raises ConfigError: if there is no layer to adapt, adapters are there already, or the rank exceeds a layer's width

    Source: the authors' code for what is frozen; the paper does not mention layer norms.
    """
    layers = layers_to_adapt(network, config)
    for parameter in network.parameters():
        parameter.requires_grad_(False)
    for module in network.modules():
        if isinstance(module, nn.LayerNorm):
            module.requires_grad_(True)
    tasks = TaskOfRows()
    n_adapters = n_tasks if config.per_task else 1
    for parent, name, layer in layers:
        fused = bool(getattr(parent, "fused", False))
        setattr(parent, name, LoRALinear(layer, config, n_adapters, tasks, fused))
    return tasks


def adapters(network: nn.Module) -> list[nn.Parameter]:
    """Return what learns once adapters are there: theirs and the layer norms' parameters."""
    return [parameter for parameter in network.parameters() if parameter.requires_grad]


def renew_adapters(network: nn.Module) -> None:
    """Give every adapter fresh values in place: the network is its frozen base again."""
    for module in network.modules():
        if isinstance(module, LoRALinear):
            module.renew_()


@th.no_grad()
def merge_adapters(network: nn.Module) -> None:
    """Add shared adapters to the weights they adapt and put plain linear layers back; everything learns again.

    :param network: changed in place
    :raises ConfigError: with adapters per task, which no single weight can hold
    """
    for parent in list(network.modules()):
        for name, layer in list(parent.named_children()):
            if not isinstance(layer, LoRALinear):
                continue
            if layer.lora_a.shape[0] > 1:
                raise ConfigError(
                    "adapters per task cannot be merged into one weight; use per_task=False to merge."
                )
            merged = nn.Linear(layer.weight.shape[1], layer.weight.shape[0], device="meta")
            merged.weight, merged.bias = layer.weight, layer.bias
            merged.weight.add_(layer.delta()[0])
            setattr(parent, name, merged)
    network.requires_grad_(True)


def layers_to_adapt(network: nn.Module, config: LoRAConfig) -> list[tuple[nn.Module, str, nn.Linear]]:
    """Return each layer that :func:`add_adapters` would replace, with its parent and its name there.

    :param network: actor or critics
    :param config: options
    :raises ConfigError: see :func:`add_adapters`
    """
    if any(isinstance(module, LoRALinear) for module in network.modules()):
        raise ConfigError("this network has adapters already; renew or merge them instead of adding more.")
    layers = [
        (parent, name, layer)
        for parent in network.modules()
        for name, layer in parent.named_children()
        if type(layer) is nn.Linear and not (config.layers == "hidden" and _is_output(parent, layer))
    ]
    if not layers:
        raise ConfigError(
            "LoRA finds no plain linear layer in this network; use it with the plain MLP policy."
        )
    for parent, _, layer in layers:
        width = layer.in_features if _is_output(parent, layer) else min(layer.in_features, layer.out_features)
        if config.rank > width:
            raise ConfigError(
                f"lora option rank={config.rank} exceeds the width of a layer from {layer.in_features} to "
                f"{layer.out_features}, which it would not compress; use at most {width}."
            )
    return layers


def _is_output(parent: nn.Module, layer: nn.Linear) -> bool:
    """Return whether nothing follows the layer inside its parent: SB3's heads, and the last layer of a critic."""
    return not isinstance(parent, nn.Sequential) or parent[-1] is layer
