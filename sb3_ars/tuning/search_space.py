"""A search space as data: options of a run and the values to try; trains nothing."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_type_hints

import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from sb3_ars.errors import ConfigError, check_flag, check_path, nearest
from sb3_ars.experiments.config import RunConfig, admits, describe, read_yaml

__all__ = ["SearchSpace", "TunedOption", "load_search_space", "search_space_names"]

_SPACES = resources.files("sb3_ars.experiments") / "search_spaces"
_MEASURING = (
    "seed",
    "output",
    "log_interval",
    "verbose",
    "profile",
    "scale",
    "env.tasks",
    "env.max_episode_steps",
)
"""Options, beside those of evaluation, that say what is measured or written, not how well it is learned."""
_DISPLACES = {"ars.n_reset": "ars.param_resets", "ars.param_resets": "ars.n_reset"}
"""Option -> the one that says the same in another way, and so is None where the first is tuned."""


@dataclass(frozen=True)
class TunedOption:
    """One option and the values to try.

    :param name: dotted, such as "ars.n_reset"
    :param type: "int", "float" or "categorical"
    :param low: smallest value of a number
    :param high: largest value of a number
    :param step: distance between values of a number; ``None`` is 1 for integers, any value between for floats
    :param log: whether the values of a number are spread evenly over its logarithm
    :param choices: of a categorical option: any values YAML has, lists and mappings among them
    :raises ConfigError: if these do not go together
    """

    name: str
    type: Literal["int", "float", "categorical"]
    low: float | None = None
    high: float | None = None
    step: float | None = None
    log: bool = False
    choices: tuple[Any, ...] = ()
    distribution: BaseDistribution = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "distribution", self._distribution())

    def suggest(self, trial: optuna.Trial) -> Any:
        """Return the trial's value of the option.

        :param trial: that asks
        """
        distribution = self.distribution
        if isinstance(distribution, CategoricalDistribution):
            return self.value(trial.suggest_categorical(self.name, distribution.choices))
        if isinstance(distribution, IntDistribution):
            low, high, step = distribution.low, distribution.high, distribution.step
            return trial.suggest_int(self.name, low, high, step=step, log=self.log)
        assert isinstance(distribution, FloatDistribution)
        return trial.suggest_float(
            self.name, distribution.low, distribution.high, step=distribution.step, log=self.log
        )

    def value(self, param: Any) -> Any:
        """Return the option's value for what Optuna stores, which for a list is its JSON text.

        :param param: of a trial
        """
        # compared as text, for True == 1
        return next((choice for choice in self.choices if repr(_label(choice)) == repr(param)), param)

    def plain(self) -> dict[str, Any]:
        """Return what a file says of the option."""
        fields = ("type", "low", "high", "step", "log", "choices")
        given = {name: getattr(self, name) for name in fields}
        given = {name: value for name, value in given.items() if value is not None and value is not False}
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in given.items()
            if value != ()
        }

    def _distribution(self) -> BaseDistribution:
        if self.type == "categorical":
            return self._categorical()
        if self.type not in ("int", "float"):
            raise ConfigError(
                f"{self.name}: type={self.type!r} is unknown; choose int, float or categorical."
                + nearest(str(self.type), ("int", "float", "categorical"))
            )
        if self.choices:
            raise ConfigError(f"{self.name}: choices go with type categorical, not with {self.type}.")
        for bound in ("low", "high", *(("step",) if self.step is not None else ())):
            self._check_number(bound, getattr(self, bound))
        check_flag(f"{self.name}: log", self.log)
        if self.step is not None and self.step <= 0:
            raise ConfigError(f"{self.name}: step={self.step!r} must be above 0.")
        assert self.low is not None and self.high is not None
        try:
            if self.type == "int":
                step = 1 if self.step is None else int(self.step)
                if (self.high - self.low) % step:
                    raise ValueError(f"high - low = {self.high - self.low} is no multiple of step {step}")
                return IntDistribution(int(self.low), int(self.high), log=self.log, step=step)
            return FloatDistribution(float(self.low), float(self.high), log=self.log, step=self.step)
        except ValueError as error:
            raise ConfigError(f"{self.name}: low={self.low}, high={self.high} cannot be: {error}") from error

    def _categorical(self) -> BaseDistribution:
        given = [name for name in ("low", "high", "step") if getattr(self, name) is not None]
        if given or self.log:
            raise ConfigError(
                f"{self.name}: {(given or ['log'])[0]} goes with int or float, not with categorical."
            )
        labels = [_label(choice) for choice in self.choices]
        if len({repr(label) for label in labels}) < max(len(labels), 2):
            raise ConfigError(
                f"{self.name}: choices={list(self.choices)} must be two or more different values."
            )
        return CategoricalDistribution(labels)

    def _check_number(self, bound: str, value: Any) -> None:
        kind = int if self.type == "int" else (int, float)
        if isinstance(value, bool) or not isinstance(value, kind) or not math.isfinite(value):
            what = "an integer" if self.type == "int" else "a finite number"
            hint = " (YAML reads 1e-4 as text; write 1.0e-4)" if isinstance(value, str) else ""
            raise ConfigError(f"{self.name}: {bound}={value!r} must be {what}{hint}.")


@dataclass(frozen=True)
class SearchSpace:
    """Options of :class:`~sb3_ars.experiments.config.RunConfig`, and the values to try of each.

    :param name: in the study's name
    :param options: one or more
    :raises ConfigError: if an option does not exist, is not one to tune, or cannot have the values
    """

    name: str
    options: tuple[TunedOption, ...]

    def __post_init__(self) -> None:
        if not self.options:
            raise ConfigError(f"The search space {self.name!r} has no options.")
        for option in self.options:
            _check_option(option)
        names = self.names
        for name in names:
            if _DISPLACES.get(name) in names:
                raise ConfigError(f"{name} and {_DISPLACES[name]} both say when to reset; tune one of them.")

    @property
    def names(self) -> tuple[str, ...]:
        """Dotted names of the options."""
        return tuple(option.name for option in self.options)

    def check(self, config: RunConfig) -> None:
        """Raise if an option would change nothing in runs of this configuration.

        :param config: that the trials change
        :raises ConfigError: if resets are tuned of a method that never resets
        """
        tuned = [name for name in self.names if name in ("ars.n_reset", "ars.updates_after_reset")]
        if tuned and "ars.reset" not in self.names and not config.ars.resets():
            raise ConfigError(
                f"{tuned[0]} changes nothing where ars.reset={config.ars.reset!r}; choose a preset that resets, such "
                "as mt10-ars, or another search space."
            )

    def suggest(self, trial: optuna.Trial) -> dict[str, Any]:
        """Return the trial's value of each option, by dotted name.

        :param trial: that asks
        """
        return {option.name: option.suggest(trial) for option in self.options}

    def values(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Return the value of each option for what Optuna stores of a trial.

        :param params: of the trial
        """
        return {option.name: option.value(params[option.name]) for option in self.options}

    def apply(self, config: RunConfig, values: Mapping[str, Any]) -> RunConfig:
        """Return the configuration with these values; an option that says the same in another way becomes None.

        :param config: to change
        :param values: by dotted name
        :raises ConfigError: if the configuration does not allow them
        """
        changes = {_DISPLACES[name]: None for name in values if name in _DISPLACES} | dict(values)
        by_section: dict[str, dict[str, Any]] = {}
        for name, value in changes.items():
            section, _, option = name.rpartition(".")
            by_section.setdefault(section, {})[option] = tuple(value) if isinstance(value, list) else value
        sections: dict[str, Any] = {
            section: dataclasses.replace(getattr(config, section), **options)
            for section, options in by_section.items()
            if section
        }
        return dataclasses.replace(config, **sections, **by_section.get("", {}))

    def plain(self) -> dict[str, Any]:
        """Return what a file of the space says."""
        return {option.name: option.plain() for option in self.options}


def search_space_names() -> list[str]:
    """Return the names of the search spaces that come with the package."""
    return sorted(
        path.name.removesuffix(".yaml") for path in _SPACES.iterdir() if path.name.endswith(".yaml")
    )


def load_search_space(space: str | Path | Mapping[str, Any] | SearchSpace) -> SearchSpace:
    """Return a search space by name, from a YAML file, or from what such a file holds.

    :param space: one of :func:`search_space_names`, a path that ends in .yaml, or a mapping from dotted option names to
        the fields of :class:`TunedOption`
    :raises ConfigError: if there is none of that name, or it is none
    """
    if isinstance(space, SearchSpace):
        return space
    if isinstance(space, Mapping):
        return _build(space, "search space", "custom")
    check_path("space", space)
    if str(space) in search_space_names():
        text = (_SPACES / f"{space}.yaml").read_text(encoding="utf-8")
        return _build(read_yaml(text, str(space)), str(space), str(space))
    path = Path(space)
    if path.suffix not in (".yaml", ".yml"):
        names = search_space_names()
        raise ConfigError(
            f"There is no search space {str(space)!r}.{nearest(str(space), names)} There are {', '.join(names)}; "
            "or give the path of your own .yaml file."
        )
    return _build(read_yaml(path, f"The search space {path}"), str(path), path.stem)


def _build(values: Any, where: str, name: str) -> SearchSpace:
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where} must map options, such as ars.n_reset, to the values to try.")
    allowed = [f.name for f in dataclasses.fields(TunedOption) if f.init and f.name != "name"]
    options = []
    for option, fields in values.items():
        if not isinstance(fields, Mapping) or "type" not in fields:
            raise ConfigError(
                f"{where}: {option} must be a mapping with type and bounds, such as {{type: int, low: 0, high: 9}}, "
                f"not {fields!r}."
            )
        for key in fields:
            if key not in allowed:
                raise ConfigError(
                    f"{where}: {option} has no {key!r}; it has {', '.join(allowed)}."
                    + nearest(str(key), allowed)
                )
        choices = fields.get("choices", ())
        if isinstance(choices, str) or not isinstance(choices, Sequence):
            raise ConfigError(f"{where}: {option}: choices={choices!r} must be a list.")
        options.append(TunedOption(**{"name": str(option), **fields, "choices": tuple(choices)}))
    return SearchSpace(name, tuple(options))


def _check_option(option: TunedOption) -> None:
    hints = _option_hints(RunConfig)
    if option.name not in hints:
        by_end = [name for name in hints if name.rpartition(".")[2] == option.name]
        suggestion = f" Did you mean {by_end[0]!r}?" if by_end else nearest(option.name, hints)
        raise ConfigError(
            f"{option.name!r} is no option of a run.{suggestion} 'sb3-ars train toy --help' shows all."
        )
    if option.name in _MEASURING or option.name.startswith("evaluation."):
        raise ConfigError(
            f"{option.name} says what is measured, not how well it is learned: trials that differ in it cannot be "
            "compared. Leave it out of the search space."
        )
    hint = hints[option.name]
    number = {"int": int, "float": float}.get(option.type)
    values = option.choices if number is None else (number(option.low or 0), number(option.high or 0))
    for value in values:
        if not admits(hint, value):
            raise ConfigError(
                f"{option.name} cannot be {value!r} (type {option.type}): it takes {describe(hint)}."
            )


def _option_hints(cls: Any, prefix: str = "") -> dict[str, Any]:
    """Return the type of every option, by dotted name."""
    hints: dict[str, Any] = {}
    for name, hint in get_type_hints(cls).items():
        if dataclasses.is_dataclass(hint):
            hints |= _option_hints(hint, f"{prefix}{name}.")
        else:
            hints[prefix + name] = hint
    return hints


def _label(choice: Any) -> Any:
    """Return what Optuna can store of a choice: itself, or JSON text where it is a list or mapping."""
    return choice if choice is None or isinstance(choice, bool | int | float | str) else json.dumps(choice)
