"""Reads the runs a report is about and sorts them into arms; computes no summary numbers, draws and writes nothing."""

from __future__ import annotations

import dataclasses
import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_ars.errors import ConfigError
from sb3_ars.experiments.catalogue import preset_names
from sb3_ars.experiments.config import NO_PART_OF_A_METHOD, RunConfig, load_preset
from sb3_ars.experiments.run_folder import RESULT, Run, find_runs, is_finished, read_run
from sb3_ars.experiments.scaling import load_scale, scaled

__all__ = ["Arm", "Cell", "Gathered", "differences", "gather"]

Cell = tuple[str, str, int]
"""What a sweep trains once: scale, preset, seed."""

_NAMED = 3  # differing options a label names


@dataclass(frozen=True)
class Arm:
    """Runs that differ in nothing but their seed.

    :param scale: name of the scale that sized them
    :param preset: name they were trained under
    :param difference: from other runs of the same scale and preset, in words; empty where there are none
    :param runs: a seed each, in their order
    :param number: its place among those of its scale, which gives it one colour in all figures
    :param stopped: the step at which its runs ended early, as text; empty where they came to their end
    """

    scale: str
    preset: str
    difference: str
    runs: tuple[Run, ...]
    number: int
    stopped: str = ""

    @property
    def label(self) -> str:
        """Preset and difference."""
        return self.named(self.preset)

    @property
    def task_names(self) -> tuple[str, ...]:
        """The tasks, in order."""
        return self.runs[0].task_names

    @property
    def protocols(self) -> list[str]:
        """The protocols of the final evaluations, each in one line."""
        return list(dict.fromkeys(run.result["protocol"] for run in self.runs))

    def named(self, name: str) -> str:
        """Return a label that starts with a name, such as the paper's, and tells the arm from others of its preset."""
        return f"{name} ({self.difference})" if self.difference else name

    def scores(self, sampled: bool = False) -> npt.NDArray[np.float64]:
        """Return final success in [0, 1], ``(n_seeds, n_tasks)``, NaN for a task that reports none."""
        return np.array([run.success(sampled) for run in self.runs])


@dataclass(frozen=True)
class Gathered:
    """All that was found.

    :param arms: in the order of the presets
    :param warnings: what was left out, and why
    :param missing: cells that were expected, and of which no run came to its end
    :param expected: number of seeds expected, by scale and preset
    """

    arms: tuple[Arm, ...]
    warnings: tuple[str, ...]
    missing: tuple[Cell, ...]
    expected: Mapping[tuple[str, str], int]

    @property
    def runs(self) -> list[Run]:
        """All runs that are used."""
        return [run for arm in self.arms for run in arm.runs]

    def n_expected(self, arm: Arm) -> int:
        """Return how many seeds of a method were expected, 0 where that is not known or its runs ended early."""
        return 0 if arm.stopped else self.expected.get((arm.scale, arm.preset), 0)


def gather(folders: Sequence[Path], expected: Iterable[Cell] = ()) -> Gathered:
    """Return the finished runs in folders and below them, by arm; of a seed that is there twice, the newer run.

    :param folders: runs, or folders that hold runs
    :param expected: cells that should be among them
    :raises ConfigError: if a folder does not exist, or none holds a finished run that can be read
    """
    if not folders:
        raise ConfigError("A report needs a run; give the folder of one, or a folder that holds runs.")
    runs, warnings = _read_all(folders)
    if not runs:
        raise ConfigError(
            f"No finished run in {', '.join(map(str, folders))}; a finished run's folder holds {RESULT}."
            + "".join(f" {warning}" for warning in warnings)
        )
    arms = _arms(_newest(runs, warnings))
    found = {(run.config.scale, run.name, run.seed) for run in runs if not _stop(run)}
    cells = list(dict.fromkeys((str(scale), str(preset), int(seed)) for scale, preset, seed in expected))
    counts: defaultdict[tuple[str, str], int] = defaultdict(int)
    for scale, preset, _ in cells:
        counts[scale, preset] += 1
    missing = tuple(cell for cell in cells if cell not in found)
    return Gathered(tuple(arms), tuple(warnings), missing, dict(counts))


def differences(arm: Arm) -> dict[str, tuple[str, str]] | None:
    """Return in what an arm's configuration differs from its preset as the package ships it.

    :param arm: of a report
    :return: option -> (the preset's value, the arm's); ``None`` where there is no preset of that name
    """
    if arm.preset not in preset_names():
        return None
    before, after = _options(load_preset(arm.preset)), _options(arm.runs[0].config)
    changed = {key: (before[key], after[key]) for key in before if before[key] != after[key]}
    return changed | ({_STOPPED: ("the end", arm.stopped)} if arm.stopped else {})


_STOPPED = "stopped at step"


def _read_all(folders: Sequence[Path]) -> tuple[list[Run], list[str]]:
    runs, warnings = [], []
    for folder in dict.fromkeys(path.resolve() for given in folders for path in find_runs(given)):
        try:
            run = read_run(folder)
            run.progress()
            run.evaluations()
            _check_complete(run)
            runs.append(run)
        except ConfigError as error:
            warnings.append(str(error))
    return runs, [*warnings, *_unfinished(folders)]


def _unfinished(folders: Sequence[Path]) -> list[str]:
    """Say which runs failed, and which were begun and are neither finished nor failed."""
    failed = {
        path.parent.resolve(): path
        for given in folders
        for path in given.rglob("error.txt")
        if path.is_file()
    }
    begun = {path.parent.resolve() for given in folders for path in given.rglob("config.yaml")}
    lines = []
    for folder, path in sorted(failed.items()):
        last = path.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
        lines.append(f"{folder} failed: {''.join(last) or 'no error was written'}")
    unfinished = (f for f in sorted(begun) if not is_finished(f) and not {f, *f.parents} & failed.keys())
    return lines + [f"{folder} did not finish." for folder in unfinished]


def _check_complete(run: Run) -> None:
    """Refuse what can be read but is too little for a report."""
    missing = [key for key in ("protocol", "updates", "resets") if key not in run.result]
    missing += [] if run.task_names else ["tasks"]
    if missing:
        raise ConfigError(f"{run.folder / RESULT} lacks {', '.join(missing)}; train the run again.")


def _newest(runs: Sequence[Run], warnings: list[str]) -> list[Run]:
    """Keep one run of each configuration and seed, and say which were dropped."""
    kept: dict[Any, Run] = {}
    for run in sorted(runs, key=lambda run: (run.folder / RESULT).stat().st_mtime):
        key = (run.config.scale, run.name, run.seed, _identity(run))
        if key in kept:
            warnings.append(
                f"{kept[key].folder} is an older run of {run.name} with seed {run.seed} than {run.folder}, "
                "which is used."
            )
        kept[key] = run
    return list(kept.values())


def _arms(runs: Sequence[Run]) -> list[Arm]:
    groups: defaultdict[tuple[str, str], defaultdict[str, list[Run]]] = defaultdict(lambda: defaultdict(list))
    for run in sorted(runs, key=lambda run: (run.seed, str(run.folder))):
        groups[run.config.scale, run.name][_identity(run)].append(run)
    order = {name: index for index, name in enumerate(preset_names())}
    arms: list[Arm] = []
    for scale, preset in sorted(
        groups, key=lambda key: (key[0] != "full", key[0], order.get(key[1], -1), key[1])
    ):
        alike = list(groups[scale, preset].values())
        words = _differences_in_words([_method(same[0]) for same in alike], _reference(scale, preset))
        for word, same in zip(words, alike, strict=True):
            number = sum(arm.scale == scale for arm in arms)
            arms.append(Arm(scale, preset, word, tuple(same), number, _stop(same[0])))
    return arms


def _identity(run: Run) -> str:
    return json.dumps(_method(run), sort_keys=True)


def _method(run: Run) -> dict[str, str]:
    """Return all that tells a run from others of its preset, but for the seed."""
    return {_STOPPED: _stop(run)} | _options(run.config)  # first, so that a label always has room for it


def _reference(scale: str, preset: str) -> dict[str, str]:
    """Return the options of a preset at a scale, none where this version does not know them."""
    try:
        return _options(scaled(load_preset(preset), load_scale(scale)))
    except ConfigError:
        return {}


def _stop(run: Run) -> str:
    """Return where the run ended before its time, empty if it did not."""
    steps = run.result["timesteps"]
    return f"{steps:,}" if steps < run.config.algorithm.total_timesteps else ""


def _options(config: RunConfig) -> dict[str, str]:
    """Return every option that is part of a method, as text."""
    flat: dict[str, str] = {}
    for key, value in dataclasses.asdict(config).items():
        if isinstance(value, dict):
            flat |= {f"{key}.{name}": _shown(item) for name, item in value.items()}
        else:
            flat[key] = _shown(value)
    return {key: value for key, value in flat.items() if key not in NO_PART_OF_A_METHOD}


def _shown(value: Any) -> str:
    if value is None:
        return "unset"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_shown(item)}" for key, item in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(map(_shown, value)) or "empty"
    return str(value)


def _differences_in_words(alike: Sequence[Mapping[str, str]], reference: Mapping[str, str]) -> list[str]:
    """Say of each set of options in what it differs from the others and from the preset, and that it ended early."""
    keys = [key for key in alike[0] if key == _STOPPED or len({options[key] for options in alike}) > 1]
    words: list[str] = []
    for options in alike:
        named = [
            f"{key.split('.')[-1]} {options[key]}" for key in keys if options[key] != reference.get(key, "")
        ]
        text = "; ".join(named[:_NAMED]) + (f"; {len(named) - _NAMED} more" if len(named) > _NAMED else "")
        words.append(text if text not in words else f"{text}; variant {len(words) + 1}")
    return words
