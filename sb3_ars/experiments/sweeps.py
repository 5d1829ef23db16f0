"""The paper's tables and figures as data: which presets each compares, and what the paper prints; trains nothing."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from sb3_ars.errors import ConfigError, check_path, nearest
from sb3_ars.experiments.catalogue import preset_names
from sb3_ars.experiments.config import read_yaml

__all__ = ["KINDS", "Sweep", "SweepRow", "load_sweep", "sweep_names"]

SWEEPS = resources.files("sb3_ars.experiments") / "sweeps"
"""Folder of the sweeps that ship with the package, one YAML file each."""

KINDS = {
    "per_task": "success of every task, and the mean",
    "bottom_k": "mean success of the k worst tasks; option ks",
    "mean": "mean success, methods down and conditions across",
    "task_sets": "mean success of the best tasks and of the rest; option n_easy",
    "task_curves": "success of single tasks over the run",
    "task_bars": "success of every task as bars",
    "q_values": "predicted values of each task over the run; option tasks",
    "estr": "share of the tasks whose success reaches a threshold; option thresholds",
    "scales": "reward scales c_i over the run",
    "curves": "mean success over the run; option each_seed draws a line for every seed",
    "bars": "mean success as bars",
}
"""What a report draws of a sweep's runs."""

_OPTIONS = {
    "bottom_k": ("ks",),
    "estr": ("thresholds",),
    "task_sets": ("n_easy",),
    "q_values": ("tasks",),
    "curves": ("each_seed",),
}
_PAPER = ("mean", "tasks", "bottom_k", "easy", "difficult")


@dataclass(frozen=True)
class SweepRow:
    """One method of a table or figure.

    :param preset: that trains it
    :param label: the paper's name of it, or of the row it stands in
    :param column: second heading, where the paper's table has two
    :param paper: what the paper prints, in %: ``mean``, ``easy`` and ``difficult`` such as "97.3 ± 2.1", ``tasks`` one
        such string per task, ``bottom_k`` one by k
    """

    preset: str
    label: str
    column: str | None = None
    paper: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Sweep:
    """One table or figure.

    :param name: such as "table1"
    :param title: what it compares
    :param source: the paper's number of it, such as "Table 1"
    :param kind: one of :data:`KINDS`
    :param rows: the methods, in the paper's order
    :param options: of the kind, and ``note``: a sentence to print below
    """

    name: str
    title: str
    source: str
    kind: str
    rows: tuple[SweepRow, ...]
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def presets(self) -> tuple[str, ...]:
        """The presets of the rows, each once."""
        return tuple(dict.fromkeys(row.preset for row in self.rows))


def sweep_names() -> list[str]:
    """Return the names of the paper's tables, then of its figures."""
    names = (path.name for path in SWEEPS.iterdir())
    found = [name.removesuffix(".yaml") for name in names if name.endswith(".yaml")]
    return sorted(found, key=lambda name: (name.startswith("fig"), int(re.sub(r"\D", "", name))))


def load_sweep(name: str) -> Sweep:
    """Return a table or figure.

    :param name: one of :func:`sweep_names`, or the path of a YAML file of your own
    :raises ConfigError: if there is none of that name, or its file has an unknown or missing key, kind or preset
    """
    path = check_path("table or figure", name)
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return _sweep(path.stem, path, str(path))
    names = sweep_names()
    if name not in names:
        raise ConfigError(
            f"There is no table or figure {name!r}; there are {', '.join(names)}, or give the path of a YAML file of "
            "your own." + nearest(name, names)
        )
    return _sweep(name, (SWEEPS / f"{name}.yaml").read_text(encoding="utf-8"), f"sweep {name!r}")


def _sweep(name: str, file: Path | str, where: str) -> Sweep:
    values = read_yaml(file, where)
    _check_keys(values, where, ("title", "source", "kind", "rows"), ("options",))
    kind, options = values["kind"], values.get("options") or {}
    if not isinstance(kind, str) or kind not in KINDS:
        raise ConfigError(
            f"{where}: kind={kind!r} is unknown; choose one of {', '.join(KINDS)}.{nearest(str(kind), KINDS)}"
        )
    _check_keys(options, f"{where}: options", (), (*_OPTIONS.get(kind, ()), "note"))
    for option, value in options.items():
        allowed, fits = _TYPES[option]
        if not fits(value):
            raise ConfigError(f"{where}: option {option}={value!r} must be {allowed}.")
    if not isinstance(values["rows"], list) or not values["rows"]:
        raise ConfigError(
            f"{where}: rows={values['rows']!r} must be a list of rows, each with preset and label."
        )
    rows = tuple(_row(row, f"{where}: row {number}") for number, row in enumerate(values["rows"], start=1))
    title, source = (_text(values[key], f"{where}: {key}") for key in ("title", "source"))
    return Sweep(name, title, source, kind, rows, options)


def _row(values: Any, where: str) -> SweepRow:
    _check_keys(values, where, ("preset", "label"), ("column", "paper"))
    presets = preset_names()
    if values["preset"] not in presets:
        raise ConfigError(
            f"{where}: there is no preset {values['preset']!r}.{nearest(str(values['preset']), presets)} "
            "'sb3-ars list' shows all."
        )
    label = _text(values["label"], f"{where}: label")
    column = values.get("column")
    column = None if column is None else _text(column, f"{where}: column")
    return SweepRow(values["preset"], label, column, _paper(values.get("paper") or {}, f"{where}: paper"))


def _paper(values: Any, where: str) -> dict[str, Any]:
    _check_keys(values, where, (), _PAPER)
    paper: dict[str, Any] = {}
    for key, value in values.items():
        here = f"{where}: {key}"
        if key == "tasks":
            if not isinstance(value, list):
                raise ConfigError(
                    f"{here}={value!r} must be a list with a number such as '97.3 ± 2.1' per task."
                )
            paper[key] = [_text(printed, here) for printed in value]
        elif key == "bottom_k":
            if not isinstance(value, Mapping) or not all(map(_is_count, value)):
                raise ConfigError(f"{here}={value!r} must be a mapping such as {{10: '0.0 ± 0.0'}}.")
            paper[key] = {k: _text(printed, here) for k, printed in value.items()}
        else:
            paper[key] = _text(value, here)
    return paper


def _text(value: Any, where: str) -> str:
    """Return what a file gives as text; YAML reads one that looks like a number as a number."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ConfigError(f"{where}={value!r} must be text.")
    return str(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


def _is_share(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= 1


def _is_list_of(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and len(value) > 0 and all(map(fits, value))


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


_TYPES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "ks": ("a list of integers of at least 1, such as [10, 20]", _is_list_of(_is_count)),
    "thresholds": ("a list of shares from 0 to 1, such as [0.5, 0.9]", _is_list_of(_is_share)),
    "n_easy": ("an integer of at least 1", _is_count),
    "tasks": ("a list of tasks' names", _is_list_of(_is_text)),
    "each_seed": ("true or false", lambda value: isinstance(value, bool)),
    "note": ("a sentence", _is_text),
}


def _check_keys(values: Any, where: str, needed: Iterable[str], others: Iterable[str]) -> None:
    allowed = [*needed, *others]
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where} must be a mapping with the keys {', '.join(allowed)}, not {values!r}.")
    for key in values:
        if key not in allowed:
            raise ConfigError(
                f"{where}: {key!r} is no key here; there are {', '.join(allowed)}.{nearest(str(key), allowed)}"
            )
    missing = [key for key in needed if key not in values]
    if missing:
        raise ConfigError(f"{where} lacks {', '.join(missing)}; add it.")
