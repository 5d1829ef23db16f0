"""The paper's tables and figures as data: which presets each compares, and what the paper prints; trains nothing."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from sb3_ars.errors import ConfigError, nearest
from sb3_ars.experiments.catalogue import preset_names

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
    path = Path(name)
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return _sweep(path.stem, path.read_text(encoding="utf-8"), str(path))
    names = sweep_names()
    if name not in names:
        raise ConfigError(
            f"There is no table or figure {name!r}; there are {', '.join(names)}, or give the path of a YAML file of "
            "your own." + nearest(name, names)
        )
    return _sweep(name, (SWEEPS / f"{name}.yaml").read_text(encoding="utf-8"), f"sweep {name!r}")


def _sweep(name: str, text: str, where: str) -> Sweep:
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{where} is not valid YAML: {error}") from error
    _check_keys(values, where, ("title", "source", "kind", "rows"), ("options",))
    kind, options = values["kind"], values.get("options") or {}
    if kind not in KINDS:
        raise ConfigError(
            f"{where}: kind={kind!r} is unknown; choose one of {', '.join(KINDS)}.{nearest(str(kind), KINDS)}"
        )
    _check_keys(options, f"{where}: options", (), (*_OPTIONS.get(kind, ()), "note"))
    if not isinstance(values["rows"], list) or not values["rows"]:
        raise ConfigError(
            f"{where}: rows={values['rows']!r} must be a list of rows, each with preset and label."
        )
    rows = tuple(_row(row, f"{where}: row {number}") for number, row in enumerate(values["rows"], start=1))
    return Sweep(name, values["title"], values["source"], kind, rows, options)


def _row(values: Any, where: str) -> SweepRow:
    _check_keys(values, where, ("preset", "label"), ("column", "paper"))
    presets = preset_names()
    if values["preset"] not in presets:
        raise ConfigError(
            f"{where}: there is no preset {values['preset']!r}.{nearest(str(values['preset']), presets)} "
            "'sb3-ars list' shows all."
        )
    _check_keys(values.get("paper", {}), f"{where}: paper", (), _PAPER)
    return SweepRow(**values)


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
