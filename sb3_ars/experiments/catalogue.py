"""The presets as files: their names, values and what the paper reports of them; builds no configuration."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import yaml

from sb3_ars.errors import ConfigError, nearest

__all__ = [
    "PRESETS",
    "PresetInfo",
    "find_presets",
    "preset_group",
    "preset_info",
    "preset_names",
    "preset_values",
]

PRESETS = resources.files("sb3_ars.experiments") / "presets"
"""Folder of the presets that ship with the package, one YAML file each."""

_GROUPS = ("toy", "demo", "mt10", "mt10-ablation", "single", "mt50")
_METADATA = ("extends", "description", "paper")


@dataclass(frozen=True)
class PresetInfo:
    """What a preset is, and what the paper reports of it.

    :param name: of the preset
    :param description: one line
    :param total_timesteps: length of the run in environment steps, summed over tasks
    :param table: of the paper, such as "3" or "Fig. 2"; ``None`` where the paper does not have this run
    :param success: the paper's mean and standard deviation over 8 seeds in %, such as "97.3 ± 2.1"; ``None`` where it
        gives no number
    """

    name: str
    description: str
    total_timesteps: int
    table: str | None = None
    success: str | None = None


def preset_names() -> list[str]:
    """Return the names of the presets: the small ones, MT10, its ablations, single tasks, MT50."""
    names = (path.name for path in PRESETS.iterdir())
    return sorted((name.removesuffix(".yaml") for name in names if name.endswith(".yaml")), key=_order)


def preset_group(name: str) -> str:
    """Return the part of the catalogue a preset is in, such as "mt10-ablation".

    :param name: of a preset
    """
    return max((group for group in _GROUPS if name.startswith(group)), key=len)


def find_presets(words: Iterable[str]) -> list[str]:
    """Return the presets whose names contain every one of the words, in order.

    :param words: such as "mt50" and "moore"; none finds all presets
    :raises ConfigError: if there is no such preset
    """
    names, found = preset_names(), preset_names()
    for word in map(str.lower, words):
        fitting = [name for name in found if word in name]
        if not fitting:
            parts = sorted({part for name in found for part in name.split("-")})
            among = "" if found == names else f" among the {len(found)} that fit the words before it"
            raise ConfigError(
                f"No preset has {word!r} in its name{among}.{nearest(word, [*parts, *found])} "
                "'sb3-ars list' shows all."
            )
        found = fitting
    return found


def preset_info(name: str) -> PresetInfo:
    """Return what a preset is; nothing of it is inherited from the preset it extends but the length of the run.

    :param name: one of :func:`preset_names`
    :raises ConfigError: if there is none of that name
    """
    own = _read(name)
    steps: int = preset_values(name)["algorithm"]["total_timesteps"]
    return PresetInfo(name, own["description"], steps, **own.get("paper", {}))


def preset_values(name: str) -> dict[str, Any]:
    """Return the options a preset sets, those of the preset it extends included.

    :param name: one of :func:`preset_names`
    :raises ConfigError: if there is none of that name
    """
    own = _read(name)
    values = {key: value for key, value in own.items() if key not in _METADATA}
    return copy.deepcopy(_merged(preset_values(own["extends"]), values) if "extends" in own else values)


@cache
def _read(name: str) -> dict[str, Any]:
    names = preset_names()
    if name not in names:
        raise ConfigError(
            f"There is no preset {name!r}.{nearest(name, names)} 'sb3-ars list' shows all {len(names)}."
        )
    values: dict[str, Any] = yaml.safe_load((PRESETS / f"{name}.yaml").read_text(encoding="utf-8"))
    return values


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        both = isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        merged[key] = _merged(base[key], value) if both else value
    return merged


def _order(name: str) -> tuple[int, list[tuple[int, str]]]:
    """Sort by group, then by the name's parts with numbers as numbers."""
    parts = re.split(r"-", name)
    return _GROUPS.index(preset_group(name)), [(int(p) if p.isdigit() else 0, p) for p in parts]
