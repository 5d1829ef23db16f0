"""A run's folder on disk: what it holds and how a finished one is read; trains and draws nothing."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from sb3_ars.errors import ConfigError
from sb3_ars.experiments.config import RunConfig, load_config
from sb3_ars.files import write_whole

__all__ = [
    "CHECKPOINTS",
    "FORMAT",
    "RESULT",
    "Run",
    "find_runs",
    "is_finished",
    "read_run",
    "write_json",
]

FORMAT = 1
"""Version of the folder's layout; a change that an older reader would misread raises it."""

RESULT = "result.json"
"""Written last and whole: a folder with it holds a finished run."""


CHECKPOINTS = "checkpoints"
"""Folder of a run that is not finished, which resuming starts from."""


@dataclass(frozen=True)
class Run:
    """A finished run, read from its folder.

    :param folder: that it was read from
    :param name: of the preset
    :param config: the effective configuration
    :param result: what ``result.json`` holds: ``mean_success``, ``tasks`` by name, ``reward_scale_history`` and more
    :param versions: of the packages and the hardware it ran on
    """

    folder: Path
    name: str
    config: RunConfig
    result: dict[str, Any]
    versions: dict[str, Any]

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.config.seed

    @property
    def task_names(self) -> tuple[str, ...]:
        """The tasks, in order."""
        return tuple(self.result["tasks"])

    def success(self, sampled: bool = False) -> npt.NDArray[np.float64]:
        """Return each task's final success rate, ``(n_tasks,)`` in [0, 1], NaN for a task that reports none.

        :param sampled: of sampled instead of mean actions
        """
        key = "success_sampled" if sampled else "success"
        values = [task[key] for task in self.result["tasks"].values()]
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)

    def progress(self) -> pd.DataFrame:
        """Return the log, one row per write; the columns are the logger's keys.

        :raises ConfigError: if ``progress.csv`` is missing, no table, or holds text among its numbers
        """
        try:
            progress = pd.read_csv(self.folder / "progress.csv")
        except (OSError, ValueError) as error:
            raise ConfigError(f"{self.folder / 'progress.csv'} cannot be read: {error}") from error
        for column, kind in progress.dtypes.items():
            if not pd.api.types.is_numeric_dtype(kind):
                raise ConfigError(
                    f"{self.folder / 'progress.csv'} holds text among the numbers of {column!r}; train the run again."
                )
        return progress

    def evaluations(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]] | None:
        """Return the evaluations during training, or ``None`` if the run made none.

        :return: environment steps ``(n_evaluations,)`` and success rates ``(n_evaluations, n_tasks)`` in [0, 1]
        """
        path = self.folder / "evaluations.npz"
        if not path.is_file():
            return None
        try:
            with path.open("rb") as file, np.load(file) as arrays:  # numpy leaves open what it cannot read
                return arrays["timesteps"].astype(np.int64), arrays["successes"].mean(axis=2)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ConfigError(f"{path} cannot be read: {error}") from error


def is_finished(folder: Path) -> bool:
    """Return whether the folder holds a run that came to its end.

    :param folder: of a run, which need not exist
    """
    return (folder / RESULT).is_file()


def find_runs(folder: Path) -> list[Path]:
    """Return the folders of all finished runs in a folder and below it, sorted; itself if it is one.

    Runs that a sweep is still training are left out.

    :param folder: where to look
    :raises ConfigError: if it does not exist
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder} is no folder; give the folder of a run, or one that holds runs.")
    found = [path.parent for path in folder.rglob(RESULT)]
    # a sweep renames the folder that a run is written in once the run is whole
    return sorted(run for run in found if not any(part.endswith(".running") for part in run.parts))


def read_run(folder: Path) -> Run:
    """Return a finished run.

    :param folder: of the run
    :raises ConfigError: if the run did not finish, its files cannot be read, or another version of sb3_ars wrote it in
        a form that this one does not know
    """
    if not is_finished(folder):
        raise ConfigError(f"{folder} holds no finished run: there is no {RESULT}.")
    result = _read_json(folder / RESULT)
    if result.get("format") != FORMAT:
        raise ConfigError(
            f"{folder} has run format {result.get('format')!r}, but this version of sb3_ars reads format {FORMAT}; "
            "read it with the version in its versions.json, or train it again."
        )
    _check_result(folder / RESULT, result)
    config = load_config(folder / "config.yaml")
    return Run(folder, result["name"], config, result, _read_json(folder / "versions.json"))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file whole or not at all.

    :param path: file to write
    :param value: anything JSON holds
    """
    text = json.dumps(value, indent=2) + "\n"
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from error
    if not isinstance(value, dict):
        raise ConfigError(f"{path} is not what a run writes: it holds no mapping.")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_rate(value: Any) -> bool:
    return value is None or _is_number(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _are_tasks(value: Any) -> bool:
    rates = ("success", "success_sampled")
    return isinstance(value, dict) and all(
        isinstance(task, dict) and all(rate in task and _is_rate(task[rate]) for rate in rates)
        for task in value.values()
    )


def _is_scale_history(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(entry, list)
        and len(entry) == 2
        and _is_number(entry[0])
        and isinstance(entry[1], list)
        and all(map(_is_number, entry[1]))
        for entry in value
    )


def _are_seconds(value: Any) -> bool:
    return value is None or (isinstance(value, dict) and all(map(_is_number, value.values())))


_FORM: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "name": (lambda value: isinstance(value, str), "a text"),
    "mean_success": (_is_rate, "a number, or null where no task reports success"),
    "tasks": (_are_tasks, "success and success_sampled, a number or null, of each task by name"),
    "reward_scale_history": (_is_scale_history, "a list of [environment steps, [c_i of every task]]"),
    "timesteps": (_is_count, "a whole number"),
    "training_seconds": (_is_number, "a number"),
    "protocol": (lambda value: isinstance(value, str), "a text"),
    "updates": (_is_count, "a whole number"),
    "resets": (_is_count, "a whole number"),
    "seconds_by_part": (_are_seconds, "seconds by name of the part, or null"),
}
"""What ``result.json`` holds, beside what nobody reads back."""

_NEEDED = ("name", "mean_success", "tasks", "reward_scale_history", "timesteps", "training_seconds")


def _check_result(path: Path, result: Mapping[str, Any]) -> None:
    missing = [key for key in _NEEDED if key not in result]
    if missing:
        raise ConfigError(f"{path} lacks {', '.join(missing)}; train the run again.")
    for key, (holds, what) in _FORM.items():
        if key in result and not holds(result[key]):
            raise ConfigError(
                f"{path}: {key} is {repr(result[key])[:60]}, but must be {what}; train the run again."
            )
