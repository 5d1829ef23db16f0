"""The multi-task bodies by name, their options and the paper's values; knows no policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar

from torch import nn

from sb3_ars.errors import ConfigError, check_count, nearest
from sb3_ars.nets.layers import Body, BodyShape
from sb3_ars.nets.moore import MOORE
from sb3_ars.nets.multi_head import MultiHead
from sb3_ars.nets.paco import PaCo
from sb3_ars.nets.popart import PopArtNetwork
from sb3_ars.nets.soft_modules import SoftModules

__all__ = [
    "BODIES",
    "BodyConfig",
    "MOOREConfig",
    "MultiHeadConfig",
    "PaCoConfig",
    "PopArtConfig",
    "SoftModulesConfig",
    "body_config",
    "build_body",
]


@dataclass(frozen=True)
class BodyConfig:
    """Options every body has.

    :raises ConfigError: naming the option, what was given and what is allowed
    """

    name: ClassVar[str]
    body_class: ClassVar[type[Body]]
    net_arch: ClassVar[tuple[int, ...]]  # the method's own hidden layers, for users who give none
    min_layers: ClassVar[int] = 0

    def __post_init__(self) -> None:
        for field in fields(self):
            value, option = getattr(self, field.name), f"body {self.name!r}, option {field.name}"
            if isinstance(field.default, bool):
                if not isinstance(value, bool):
                    raise ConfigError(f"{option}={value!r} must be True or False.")
            elif isinstance(field.default, float):
                if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= 1:
                    raise ConfigError(f"{option}={value!r} must be above 0 and at most 1.")
            else:
                check_count(option, value)

    def check(self, hidden: Sequence[int]) -> None:
        """Refuse hidden layers the body cannot be built from.

        :param hidden: their widths
        :raises ConfigError: if there are too few
        """
        if len(hidden) < self.min_layers:
            raise ConfigError(
                f"body {self.name!r} needs at least {self.min_layers} hidden layers, but net_arch={list(hidden)}; "
                f"the method's own is {list(self.net_arch)}."
            )


@dataclass(frozen=True)
class MultiHeadConfig(BodyConfig):
    """One output layer per task on a shared trunk (SAC-MT-MH)."""

    name = "multi_head"
    net_arch = (400, 400, 400, 400)
    body_class = MultiHead

    task_in_input: bool = True
    """Whether the trunk sees the one-hot besides choosing the head by it."""


@dataclass(frozen=True)
class SoftModulesConfig(BodyConfig):
    """Layers of modules mixed by a routing network (Soft Modularization); net_arch is the embedding."""

    name = "soft_modules"
    net_arch = (400, 400)
    min_layers = 1
    body_class = SoftModules

    n_layers: int = 4
    """Layers of modules, L."""
    n_modules: int = 4
    """Modules in a layer, n."""
    module_width: int = 128
    """Width of each module's output, d."""
    gate_width: int = 256
    """Width of the routing network, g."""
    task_in_input: bool = False
    """Whether the modules' input sees the one-hot besides the routing."""


@dataclass(frozen=True)
class MOOREConfig(BodyConfig):
    """Orthogonal experts with one output layer per task (MOORE); net_arch is one expert."""

    name = "moore"
    net_arch = (400, 400, 400)
    min_layers = 1
    body_class = MOORE

    n_experts: int = 4
    """Experts, K: 4 for MT10, 6 for MT50."""
    task_in_input: bool = True
    """Whether the experts see the one-hot (the ARS authors' code) or the observation alone (the original)."""

    def check(self, hidden: Sequence[int]) -> None:
        """See :meth:`BodyConfig.check`."""
        super().check(hidden)
        if self.n_experts > hidden[-1]:
            raise ConfigError(
                f"body 'moore', option n_experts={self.n_experts} exceeds the last width of net_arch={list(hidden)}: "
                f"no more than {hidden[-1]} vectors of that width are orthogonal. Use fewer experts."
            )


@dataclass(frozen=True)
class PaCoConfig(BodyConfig):
    """Parameters that are each task's mixture of shared sets (PaCo)."""

    name = "paco"
    net_arch = (400, 400, 400)
    body_class = PaCo

    n_parameter_sets: int = 5
    """Parameter sets, K: 5 for MT10, 20 for MT50."""
    task_in_input: bool = False
    """Whether the input sees the one-hot besides the mixture."""


@dataclass(frozen=True)
class PopArtConfig(BodyConfig):
    """A plain network with a normalised output per task (PopArt); for critics alone."""

    name = "popart"
    net_arch = (400, 400, 400, 400)
    body_class = PopArtNetwork

    update_period: int = 1
    """Updates from one refresh of the normalisation to the next: 1, 10, 100 or 500 in the paper."""
    rate: float = 3e-4
    """Weight of each batch in the running mean and variance of the targets, beta."""
    task_in_input: bool = True
    """Whether the network sees the one-hot besides choosing the output by it."""


BODIES: dict[str, type[BodyConfig]] = {
    config.name: config
    for config in (MultiHeadConfig, SoftModulesConfig, MOOREConfig, PaCoConfig, PopArtConfig)
}


def body_config(options: Mapping[str, Any]) -> BodyConfig:
    """Return the checked options of one body.

    :param options: ``{"name": "moore", "n_experts": 6}``; options not given have the paper's MT10 value
    :raises ConfigError: for an unknown name or option, or a value that cannot work
    """
    if not isinstance(options, Mapping):
        raise ConfigError(
            f"body={options!r} must be a mapping of options, such as {{'name': 'moore'}}, or None."
            + nearest(str(options), BODIES)
        )
    given = dict(options)
    name = given.pop("name", None)
    if not isinstance(name, str) or name not in BODIES:
        raise ConfigError(
            f"body name={name!r} is unknown; choose one of {list(BODIES)}." + nearest(str(name), BODIES)
        )
    allowed = [field.name for field in fields(BODIES[name])]
    for option in given:
        if option not in allowed:
            raise ConfigError(
                f"body {name!r} has no option {option!r}; it has {allowed}." + nearest(str(option), allowed)
            )
    return BODIES[name](**given)


def build_body(
    options: Mapping[str, Any],
    in_features: int,
    out_features: int,
    n_tasks: int,
    hidden: Sequence[int],
    activation: type[nn.Module],
    layer_norm: bool = False,
) -> Body:
    """Return a new body.

    :param options: see :func:`body_config`
    :param in_features: width of the input, without the one-hot
    :param out_features: width of the output
    :param n_tasks: number of tasks
    :param hidden: SB3's ``net_arch``: trunk, embedding, one expert or the mixed network; the method's own is
        ``body_config(options).net_arch``
    :param activation: class of the activation of hidden layers
    :param layer_norm: LayerNorm on the input and before every activation on the way to the output
    :raises ConfigError: see :func:`body_config`; also for hidden layers the body cannot be built from
    """
    config = body_config(options)
    config.check(hidden)
    body_class: Any = config.body_class  # its constructor takes what its config has
    shape = BodyShape(in_features, out_features, n_tasks, hidden, activation, layer_norm)
    body: Body = body_class(shape, **asdict(config))
    return body
