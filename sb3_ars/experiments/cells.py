"""One preset at one scale with one seed: where its run lies, in what state it is, and how it is trained exactly once.

A cell is trained in a folder beside its final one, which is renamed when the run is whole. So whatever has the final
name is finished, however the process that trained it ended::

    <output>/<scale>/<preset>/seed0             finished: exactly a run's folder
    <output>/<scale>/<preset>/seed1.running     in work, or left behind by a process that was killed
    <output>/<scale>/<preset>/seed2.failed      error.txt, log.txt and what the run had written; tried again next time
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import psutil

from sb3_ars.errors import ConfigError, check_count, nearest
from sb3_ars.experiments.config import RunConfig, build, load_preset, plain_values
from sb3_ars.experiments.run_folder import RESULT, Run, is_finished, read_run, write_json
from sb3_ars.experiments.scaling import Scale, load_scale, scaled
from sb3_ars.experiments.sweeps import Sweep

__all__ = [
    "Cell",
    "CellState",
    "cell_state",
    "claim",
    "clean",
    "command",
    "discard",
    "fail",
    "failed_folder",
    "log_file",
    "plan",
    "publish",
    "run_folder_of",
]

CellState = Literal["missing", "finished", "failed", "running"]

_UNCOMPARED = ("output", "verbose", "profile")  # they change nothing that a run learns
_OWNER, _SPEC, _RUN, _LOG, _ERROR = "owner.json", "spec.json", "run", "log.txt", "error.txt"
_YOUNG = (
    30.0  # seconds in which a folder may lack its owner's name: it is written right after the folder is made
)


@dataclass(frozen=True)
class Cell:
    """One run of a sweep.

    :param scale: name of the scale
    :param preset: its name
    :param seed: of the run
    :param config: what the run is to be
    """

    scale: str
    preset: str
    seed: int
    config: RunConfig = field(repr=False, compare=False)

    @property
    def name(self) -> str:
        """What lists and messages call it."""
        return f"{self.scale}/{self.preset}/seed{self.seed}"

    def folder(self, output: Path) -> Path:
        """Return where the finished run is to be.

        :param output: folder of the sweep
        """
        return output / self.scale / self.preset / f"seed{self.seed}"


def plan(
    sweeps: Sequence[Sweep], scales: Sequence[str], seeds: int, only: Sequence[str] = ()
) -> tuple[Cell, ...]:
    """Return the cells of tables and figures, each once however many of them show it.

    All methods have their first seed before any has its second, so an early look compares something.

    :param sweeps: tables and figures
    :param scales: names of scales, or paths of YAML files
    :param seeds: how many: 0 to this, without it
    :param only: presets to keep; none keeps all
    :raises ConfigError: for no seeds, an unknown scale or preset, or a preset that none of the sweeps has
    """
    check_count("--seeds", seeds)
    if not scales:
        raise ConfigError("--scale names no size to train at; leave it out for the paper's own.")
    found = [load_scale(name) for name in scales]
    names = [scale.name for scale in found]
    if len(set(names)) < len(names):
        raise ConfigError(
            f"--scale: {', '.join(names)} are not all different; a scale's folder is named after it."
        )
    presets = list(dict.fromkeys(preset for sweep in sweeps for preset in sweep.presets))
    for name in only:
        if name not in presets:
            raise ConfigError(
                f"--only: {name!r} is in none of {', '.join(sweep.name for sweep in sweeps)}; they have "
                f"{', '.join(presets)}.{nearest(name, presets)}"
            )
    kept = [preset for preset in presets if not only or preset in only]
    return tuple(
        Cell(scale.name, preset, seed, _config(preset, scale, seed))
        for scale in found
        for seed in range(seeds)
        for preset in kept
    )


def cell_state(cell: Cell, output: Path) -> CellState:
    """Return the state of a cell.

    :param cell: of the sweep
    :param output: folder of the sweep
    :raises ConfigError: if it is finished, but with another configuration
    """
    folder = cell.folder(output)
    if is_finished(folder):
        _check_same(cell, read_run(folder))
        return "finished"
    if folder.exists():
        raise ConfigError(
            f"{folder} exists but holds no finished run, so {cell.name} cannot go there; move it away, or choose "
            "another --output."
        )
    if _in_work(_working(cell, output)):
        return "running"
    return "failed" if failed_folder(cell, output).exists() else "missing"


def failed_folder(cell: Cell, output: Path) -> Path:
    """Return the folder that keeps what a failed cell left; it exists while the cell's latest try is one that failed.

    :param cell: of the sweep
    :param output: folder of the sweep
    """
    folder = cell.folder(output)
    return folder.with_name(f"{folder.name}.failed")


def claim(cell: Cell, output: Path) -> Path | None:
    """Make the folder that a cell is trained in, with what its process needs; return it.

    Leftovers of a process that was killed are removed first.

    :param cell: of the sweep
    :param output: folder of the sweep
    :return: ``None`` if the cell is finished, or another process works on it
    """
    folder = _working(cell, output)
    clean(cell, output)
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        return None
    if is_finished(cell.folder(output)):  # another process was quicker
        discard(folder)
        return None
    write_json(folder / _OWNER, _owner())
    spec = {"name": cell.name, "preset": cell.preset, "config": plain_values(cell.config)}
    write_json(folder / _SPEC, spec)
    return folder


def clean(cell: Cell, output: Path) -> None:
    """Remove what a process that is no more left of a cell; a run that it had finished is kept.

    :param cell: of the sweep
    :param output: folder of the sweep
    """
    folder = _working(cell, output)
    if folder.exists() and not _in_work(folder):
        if _is_whole(folder / _RUN):
            publish(cell, output)
        discard(folder)


def command(working: Path) -> list[str]:
    """Return the command that trains the cell of a claimed folder, in a process that ends when this one does.

    :param working: what :func:`claim` returned
    """
    return [sys.executable, "-m", "sb3_ars.experiments.cells", str(working / _SPEC), str(os.getpid())]


def log_file(working: Path) -> Path:
    """Return the file that the output of a cell's process goes to.

    :param working: what :func:`claim` returned
    """
    return working / _LOG


def run_folder_of(working: Path) -> Path:
    """Return the folder that a cell's process writes the run to.

    :param working: what :func:`claim` returned
    """
    return working / _RUN


def publish(cell: Cell, output: Path) -> bool:
    """Give the run in a claimed folder its final name; return whether it was whole.

    :param cell: of the sweep
    :param output: folder of the sweep
    """
    working, folder = _working(cell, output), cell.folder(output)
    if not _is_whole(working / _RUN):
        return False
    if log_file(working).exists():
        log_file(working).replace(working / _RUN / _LOG)
    (working / _RUN).rename(folder)
    shutil.rmtree(failed_folder(cell, output), ignore_errors=True)
    discard(working)
    return True


def fail(cell: Cell, output: Path, reason: str) -> str:
    """Keep what a cell's process left as failed; return the last line of its error.

    :param cell: of the sweep
    :param output: folder of the sweep
    :param reason: to keep if the process did not write its own, as one that was killed does not
    """
    working, failed = _working(cell, output), failed_folder(cell, output)
    if not (working / _ERROR).exists():
        said = _last_line(log_file(working))
        text = f"{reason}; the last line of its log: {said}" if said else reason
        (working / _ERROR).write_text(f"{text}\n", encoding="utf-8")
    (working / _RUN / RESULT).unlink(missing_ok=True)  # nobody is to read it as finished
    (working / _OWNER).unlink(missing_ok=True)
    shutil.rmtree(failed, ignore_errors=True)
    working.rename(failed)
    return _last_line(failed / _ERROR)


def discard(working: Path) -> None:
    """Remove a claimed folder.

    :param working: what :func:`claim` returned
    """
    shutil.rmtree(working, ignore_errors=True)


# ---------------------------------------------------------------------- the process of a cell


def main(arguments: Sequence[str]) -> int:
    """Train the cell that a file describes; return the exit status.

    Its output is the cell's log.

    :param arguments: path of the file that :func:`claim` wrote, and the process that started this one
    """
    spec_path, parent = Path(arguments[0]), int(arguments[1])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # else training would end early and look finished
    threading.Thread(target=_end_with_parent, args=(parent,), daemon=True).start()
    working = spec_path.parent
    try:
        from sb3_ars.experiments.runner import train  # loads torch and the environments

        spec = json.loads(spec_path.read_text(encoding="utf-8"))
        config = build(RunConfig, spec["config"], str(spec_path))
        train(config, spec["preset"], progress_bar=False, folder=working / _RUN)
    except Exception as error:
        # a mistake in options needs no traceback
        text = f"ConfigError: {error}" if isinstance(error, ConfigError) else traceback.format_exc()
        (working / _ERROR).write_text(text, encoding="utf-8")
        print(text, file=sys.stderr)
        return 1
    return 0


def _end_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


# ---------------------------------------------------------------------- what is on the disk


def _config(preset: str, scale: Scale, seed: int) -> RunConfig:
    return replace(scaled(load_preset(preset), scale), seed=seed)


def _working(cell: Cell, output: Path) -> Path:
    folder = cell.folder(output)
    return folder.with_name(f"{folder.name}.running")


def _owner() -> dict[str, Any]:
    return {
        "host": platform.node(),
        "pid": os.getpid(),
        "started": psutil.Process().create_time(),
    }


def _in_work(working: Path) -> bool:
    """Return whether the process that made the folder may still work on it."""
    try:
        owner = json.loads((working / _OWNER).read_text(encoding="utf-8"))
    except FileNotFoundError:
        with contextlib.suppress(FileNotFoundError):
            return time.time() - working.stat().st_mtime < _YOUNG
        return False
    if owner["host"] != platform.node():
        return True  # nobody here can know
    try:
        return bool(abs(psutil.Process(owner["pid"]).create_time() - owner["started"]) < 1.0)
    except psutil.NoSuchProcess:
        return False


def _last_line(path: Path) -> str:
    if not path.exists():
        return ""
    lines = path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1].strip() if lines else ""


def _is_whole(run: Path) -> bool:
    """Return whether a run came to its end, and was not ended early."""
    if not is_finished(run):
        return False
    result = json.loads((run / RESULT).read_text(encoding="utf-8"))
    return not bool(result.get("interrupted"))


def _check_same(cell: Cell, run: Run) -> None:
    """Raise if the run is not what the cell is to be."""
    differences = list(_differences(plain_values(run.config), plain_values(cell.config)))
    if differences:
        option, there, wanted = differences[0]
        others = f" and {len(differences) - 1} more options differ" if len(differences) > 1 else ""
        raise ConfigError(
            f"{run.folder} holds a run with {option}={there!r}, but {cell.name} is now to have {wanted!r}{others}; "
            "delete the folder to train it anew, or choose another --output."
        )


def _differences(
    there: Mapping[str, Any], wanted: Mapping[str, Any], part: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    for key in dict.fromkeys([*there, *wanted]):
        before, now = there.get(key), wanted.get(key)
        if not part and key in _UNCOMPARED:
            continue
        if isinstance(before, Mapping) and isinstance(now, Mapping):
            yield from _differences(before, now, f"{part}{key}.")
        elif before != now:
            yield f"{part}{key}", before, now


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
