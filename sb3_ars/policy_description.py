"""What a policy file says of its networks: options as JSON, every one checked; knows no files and no tensors."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from gymnasium import spaces
from torch import nn

from sb3_ars.errors import ConfigError, nearest
from sb3_ars.nets.bodies import body_config
from sb3_ars.nets.lora import LoRAConfig

__all__ = [
    "ACTIVATIONS",
    "FORMAT",
    "ActorDescription",
    "CriticDescription",
    "PolicyDescription",
    "SpaceDescription",
    "one_line",
    "parsed_json",
    "shown",
]

FORMAT = 1
"""Version of the description; a change that an older reader would misread raises it."""

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "elu": nn.ELU,
    "gelu": nn.GELU,
    "leaky_relu": nn.LeakyReLU,
    "mish": nn.Mish,
    "selu": nn.SELU,
    "sigmoid": nn.Sigmoid,
    "silu": nn.SiLU,
    "softplus": nn.Softplus,
}
_ALGORITHMS = ("ARSSAC", "ARSTQC")
_DTYPES = ("float32", "float64")
_INFINITIES = {"inf": math.inf, "-inf": -math.inf}  # JSON has none

_T = TypeVar("_T")


@dataclass(frozen=True)
class SpaceDescription:
    """A ``Box`` of one dimension.

    :param shape: ``[n]``
    :param dtype: of ``_DTYPES``
    :param low: n numbers, or "-inf"
    :param high: n numbers, or "inf"
    """

    shape: list[int]
    dtype: str
    low: list[float | str]
    high: list[float | str]

    def __post_init__(self) -> None:
        _check_choice("dtype", self.dtype, _DTYPES)
        self.box()

    @classmethod
    def of(cls, space: Any, role: str) -> SpaceDescription:
        """Return what there is to say of a space.

        :param space: any
        :param role: what the message calls it
        :raises ConfigError: if it is no vector of floating-point numbers
        """
        if not isinstance(space, spaces.Box) or len(space.shape) != 1 or space.dtype.name not in _DTYPES:
            raise ConfigError(
                f"A policy file is for {role}s that are vectors of floating-point numbers, but this model's are "
                f"{space}. Wrap the environment so that they are, or use save()."
            )
        low, high = (
            [value if math.isfinite(value) else str(value) for value in bound.tolist()]
            for bound in (space.low, space.high)
        )
        return cls(list(space.shape), space.dtype.name, low, high)

    def box(self) -> spaces.Box:
        """Return the space.

        :raises ConfigError: if its bounds are none
        """
        low, high = (self._bound(name) for name in ("low", "high"))
        if not len(low) or self.shape != [len(low)] or len(low) != len(high) or (low > high).any():
            raise ConfigError(
                f"shape={shown(self.shape)} does not go with its {len(low)} bounds low and {len(high)} bounds high, "
                "of which none may be above the other"
            )
        return spaces.Box(low, high, dtype=low.dtype.type)

    def _bound(self, name: str) -> np.ndarray:
        values = getattr(self, name)
        _check_list(name, values)
        numbers = [_INFINITIES.get(value) if isinstance(value, str) else value for value in values]
        if not all(_is_number(number) for number in numbers):
            raise ConfigError(f'{name}={shown(values)} must be numbers, "inf" or "-inf"')
        exact = np.array(numbers, dtype=np.float64)
        with np.errstate(over="ignore"):
            bound = exact.astype(self.dtype)
        if not (bound == exact).all():
            raise ConfigError(f"{name}={shown(values)} holds numbers that are none of {self.dtype}")
        return bound


@dataclass(frozen=True)
class _NetworkDescription:
    """What actor and critics are built from alike.

    :param net_arch: widths of the hidden layers
    :param activation: of ``ACTIVATIONS``
    :param body: a body's name and all its options, ``None`` for a plain network
    """

    net_arch: list[int]
    activation: str
    body: dict[str, Any] | None

    def __post_init__(self) -> None:
        _check_list("net_arch", self.net_arch)
        for width in self.net_arch:
            _check_count("net_arch", width)
        _check_choice("activation", self.activation, ACTIVATIONS)
        if self.body is not None:
            body_config(self.body)


@dataclass(frozen=True)
class ActorDescription(_NetworkDescription):
    """The actor.

    :param std: "exp" or "softplus"
    """

    std: str

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_choice("std", self.std, ("exp", "softplus"))


@dataclass(frozen=True)
class CriticDescription(_NetworkDescription):
    """The critics, where a file has them.

    :param layer_norm: whether they have layer norms
    :param n_critics: how many
    :param n_quantiles: values of each, ``None`` for SAC
    """

    layer_norm: bool
    n_critics: int
    n_quantiles: int | None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_choice("layer_norm", self.layer_norm, (False, True))
        _check_count("n_critics", self.n_critics)
        if self.n_quantiles is not None:
            _check_count("n_quantiles", self.n_quantiles)


@dataclass(frozen=True)
class PolicyDescription:
    """Everything in a file but its tensors.

    :param format: ``FORMAT``
    :param sb3_ars: version that wrote it
    :param algorithm: "ARSSAC" or "ARSTQC"
    :param task_names: in the order of the one-hot, ``None`` for a plain environment
    :param observation_space: one-hot included
    :param action_space: bounded
    :param actor: its options
    :param critic: its options, ``None`` without critics
    :param lora: options of the adapters, ``None`` without
    :param fused: whether the model's layers were fused, where the processor can
    :param precision: "fp32" or "bf16"
    """

    format: int
    sb3_ars: str
    algorithm: str
    task_names: list[str] | None
    observation_space: SpaceDescription
    action_space: SpaceDescription
    actor: ActorDescription
    critic: CriticDescription | None
    lora: dict[str, Any] | None
    fused: bool
    precision: str

    def __post_init__(self) -> None:
        _check_choice("format", self.format, (FORMAT,))
        if not isinstance(self.sb3_ars, str):
            raise ConfigError(f"sb3_ars={shown(self.sb3_ars)} must be a version")
        _check_choice("algorithm", self.algorithm, _ALGORITHMS)
        _check_choice("fused", self.fused, (False, True))
        _check_choice("precision", self.precision, ("fp32", "bf16"))
        _check_names(self.task_names)
        if len(self.task_names or []) >= self.observation_space.shape[0]:
            raise ConfigError(
                f"observations of shape {self.observation_space.shape} cannot end in a one-hot of "
                f"{len(self.task_names or [])} tasks"
            )
        actions = self.action_space.box()
        if not actions.is_bounded("both"):
            raise ConfigError("action_space has no bounds, to which actions could be scaled")
        if self.critic is not None and (self.critic.n_quantiles is None) != (self.algorithm == "ARSSAC"):
            raise ConfigError(f"n_quantiles={self.critic.n_quantiles} is not {self.algorithm}'s")
        has_body = any(
            network is not None and network.body is not None for network in (self.actor, self.critic)
        )
        if self.lora is not None:
            LoRAConfig.of(self.lora)
            if has_body:
                raise ConfigError("lora adapts the plain network, but there is a body")
        if self.task_names is None and (self.lora is not None or has_body):
            raise ConfigError("body and lora need task_names")

    @classmethod
    def of_json(cls, text: str) -> PolicyDescription:
        """Return what a file's text says.

        :raises ConfigError: for anything that :func:`export_policy` would not write
        """
        given = parsed_json(text, "its description")
        version = given.get("format") if isinstance(given, dict) else None
        if isinstance(version, int) and version != FORMAT:
            raise ConfigError(
                f"it has format {shown(version)}, but this version of sb3_ars reads format {FORMAT}; load it with the "
                f"version that wrote it, {shown(given.get('sb3_ars'))}"
            )
        critic = given.get("critic") if isinstance(given, dict) else None
        parts: dict[str, type[Any]] = {
            "observation_space": SpaceDescription,
            "action_space": SpaceDescription,
            "actor": ActorDescription,
        }
        return _of(cls, given, parts | ({} if critic is None else {"critic": CriticDescription}))


def _of(kind: type[_T], given: Any, parts: Mapping[str, type[Any]] | None = None, name: str = "") -> _T:
    """Return a dataclass whose fields are what a JSON object holds, all of them and no others."""
    named = f"{name}: " if name else ""
    if not isinstance(given, dict):
        raise ConfigError(f"{named}{shown(given)} is no mapping")
    allowed = [field.name for field in fields(kind)]  # type: ignore[arg-type]  # every kind is a dataclass
    for key in given:
        if key not in allowed:
            raise ConfigError(f"{named}{shown(key)} is none of {allowed}.{nearest(key, allowed)}")
    missing = [key for key in allowed if key not in given]
    if missing:
        raise ConfigError(f"{named}{', '.join(missing)} not there")
    inner = {key: _of(part, given[key], name=key) for key, part in (parts or {}).items()}
    try:
        return kind(**{**given, **inner})
    except ConfigError as error:
        raise ConfigError(f"{named}{error}") from error


def parsed_json(text: str, what: str) -> Any:
    """Return the value of a JSON text in which no key is there twice and every number is finite."""

    def refuse(number: str) -> Any:
        raise ValueError(f"the number {one_line(number, 40)}")

    def finite(number: str) -> float:
        value = float(number)
        return value if math.isfinite(value) else refuse(number)

    try:
        return json.loads(text, object_pairs_hook=_distinct, parse_constant=refuse, parse_float=finite)
    except (ValueError, RecursionError) as error:
        raise ConfigError(
            f"{what} is not the JSON that export_policy writes: {one_line(str(error), 120)}"
        ) from error


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"the name {shown(name)} is there twice")
        found[name] = value
    return found


def shown(value: Any) -> str:
    """Return a value as a message shows it: printable, on one line and not long."""
    if type(value) is int and abs(value) > 10**30:
        return "a number of more than 30 digits"
    try:
        return one_line(ascii(value), 80)
    except (RecursionError, ValueError):
        return f"a {type(value).__name__}"


def one_line(text: str, length: int) -> str:
    """Return the beginning of a text without what cannot be printed, and without a full stop at its end."""
    text = "".join(character if character.isprintable() else " " for character in text[:length])
    return text.rstrip(".") if len(text) < length else f"{text}..."


def _check_choice(what: str, value: Any, allowed: Iterable[Any]) -> None:
    choices = [*allowed]
    if not any(type(value) is type(choice) and value == choice for choice in choices):
        raise ConfigError(f"{what}={shown(value)} is none of {choices}")


def _check_count(what: str, value: Any) -> None:
    if type(value) is not int or value < 1:
        raise ConfigError(f"{what}={shown(value)} must be an integer of at least 1")


def _check_list(what: str, value: Any) -> None:
    if not isinstance(value, list):
        raise ConfigError(f"{what}={shown(value)} must be a list")


def _check_names(names: Any) -> None:
    if names is None:
        return
    _check_list("task_names", names)
    # what is printed must not hold commands for the terminal
    if not names or not all(isinstance(name, str) and name and name.isprintable() for name in names):
        raise ConfigError(f"task_names={shown(names)} must be texts that can be printed")
    if len(set(names)) < len(names):
        raise ConfigError(f"task_names={shown(names)} has a name twice")


def _is_number(value: Any) -> bool:
    return type(value) is float or (type(value) is int and abs(value) <= 2**53)
