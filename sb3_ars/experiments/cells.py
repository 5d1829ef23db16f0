"""One preset at one scale with one seed: where its run lies, in what state it is, and how it is trained exactly once.

A cell is trained in a folder beside its final one, which is renamed when the run is whole. So whatever has the final
name is finished, however the process that trained it ended::

    <output>/<scale>/<preset>/seed0             finished: exactly a run's folder
    <output>/<scale>/<preset>/seed1.running     in work, or left behind by a process that was killed
    <output>/<scale>/<preset>/seed2.failed      error.txt, log.txt and what the run had written; tried again next time
    <output>/.lock                              held while one of these is made, renamed or removed
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
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

from sb3_ars.checkpoints import checkpoint_folders
from sb3_ars.errors import ConfigError, check_count, nearest
from sb3_ars.experiments.config import (
    NO_PART_OF_A_METHOD,
    RunConfig,
    build,
    load_config,
    load_preset,
    plain_values,
)
from sb3_ars.experiments.owner import host, lives, this_process
from sb3_ars.experiments.run_folder import CHECKPOINTS, RESULT, Run, read_run, write_json
from sb3_ars.experiments.scaling import Scale, load_scale, scaled
from sb3_ars.experiments.sweeps import Sweep

__all__ = [
    "Cell",
    "CellState",
    "cell_state",
    "claim",
    "clean",
    "command",
    "fail",
    "failed_folder",
    "log_file",
    "plan",
    "publish",
    "release",
    "run_folder_of",
]

CellState = Literal["missing", "finished", "failed", "running"]

_OWNER, _SPEC, _RUN, _LOG, _ERROR = "owner.json", "spec.json", "run", "log.txt", "error.txt"
_LOCK = ".lock"


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
    :raises ConfigError: if what lies in its place is no finished run of it, or one with another configuration
    """
    folder, working = cell.folder(output), _working(cell, output)
    if folder.exists():
        if not _is_whole(folder):
            raise ConfigError(
                f"{folder} exists but holds no finished run, or one that was ended early, so {cell.name} cannot go "
                "there; move it away, or choose another --output."
            )
        _check_same(cell, read_run(folder))
        return "finished"
    if working.exists() and not working.is_dir():
        raise ConfigError(
            f"{working} is no folder, so {cell.name} cannot be trained there; move it away, or choose another --output."
        )
    if _in_work(working):
        return "running"
    return "failed" if failed_folder(cell, output).exists() else "missing"


def failed_folder(cell: Cell, output: Path) -> Path:
    """Return the folder that keeps what a failed cell left; it exists while the cell's latest try is one that failed.

    :param cell: of the sweep
    :param output: folder of the sweep
    """
    folder = cell.folder(output)
    return folder.with_name(f"{folder.name}.failed")


def claim(cell: Cell, output: Path, cpus: int = 1) -> Path | None:
    """Make the folder that a cell is trained in, with what its process needs; return it.

    Leftovers of a process that was killed are removed first, but for a run with a checkpoint, which goes on.

    :param cell: of the sweep
    :param output: folder of the sweep
    :param cpus: cores of the cell; where the number of workers is auto, it is theirs, not the machine's
    :return: ``None`` if the cell is finished, or another process works on it
    """
    working = _working(cell, output)
    with _locked(output):
        _clean(cell, output)
        if cell.folder(output).exists() or _in_work(working):
            return None
        if working.exists() and not _is_of(cell, working / _RUN):
            _remove(working)
        working.mkdir(parents=True, exist_ok=True)
        try:
            write_json(working / _OWNER, this_process())
            config = plain_values(_with_workers(cell.config, cpus))
            write_json(working / _SPEC, {"name": cell.name, "preset": cell.preset, "config": config})
        except OSError:
            _remove(working)
            raise
    return working


def clean(cell: Cell, output: Path) -> None:
    """Remove what a process that is no more left of a cell; a run that it had finished, or that can go on, is kept.

    :param cell: of the sweep
    :param output: folder of the sweep
    """
    with _locked(output):
        _clean(cell, output)


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
    with _locked(output):
        return _publish(cell, output)


def release(cell: Cell, output: Path) -> None:
    """Give up a folder that this process claimed: a run in it that is whole, or can go on, is kept, all else removed.

    :param cell: of the sweep
    :param output: folder of the sweep
    """
    with _locked(output):
        owner, me = _owner(_working(cell, output)), this_process()
        if owner is not None and (owner["host"], owner["pid"]) == (me["host"], me["pid"]):
            _release(cell, output)


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
    error = _last_line(working / _ERROR)
    with _locked(output):
        (working / _RUN / RESULT).unlink(missing_ok=True)  # nobody is to read it as finished
        (working / _OWNER).unlink(missing_ok=True)
        _remove(failed)
        working.rename(failed)
    return error


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
        from sb3_ars.experiments.runner import resume, train  # loads torch and the environments

        if _can_go_on(working / _RUN):
            resume(working / _RUN, progress_bar=False)
            return 0
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


@contextlib.contextmanager
def _locked(output: Path) -> Iterator[None]:
    """Let no other process change what lies in a sweep's folder: looking and acting are to be one step."""
    output.mkdir(parents=True, exist_ok=True)
    with (output / _LOCK).open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield  # the lock ends with the file, however this process ends


def _owner(working: Path) -> Mapping[str, Any] | None:
    """Return what tells the process that made the folder, ``None`` if it was killed before it had written it."""
    try:
        owner = json.loads((working / _OWNER).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    whole = isinstance(owner, Mapping) and {"host", "pid", "started"} <= owner.keys()
    return owner if whole else None


def _in_work(working: Path) -> bool:
    """Return whether the process that made the folder may still work on it."""
    owner = _owner(working)
    if owner is None:
        return False
    # of another machine's process nobody here can know
    return owner["host"] != host() or lives(owner["pid"], owner["started"]) is True


def _clean(cell: Cell, output: Path) -> None:
    if not _in_work(_working(cell, output)):
        _release(cell, output)


def _release(cell: Cell, output: Path) -> None:
    working = _working(cell, output)
    if _publish(cell, output):
        return
    if _can_go_on(working / _RUN):
        (working / _OWNER).unlink(missing_ok=True)
    else:
        _remove(working)


def _can_go_on(run: Path) -> bool:
    """Return whether a run that did not come to its end left a checkpoint."""
    return bool(checkpoint_folders(run / CHECKPOINTS))


def _is_of(cell: Cell, run: Path) -> bool:
    """Return whether an unfinished run was begun as the cell is to be."""
    try:
        config = load_config(run / "config.yaml")
    except ConfigError:
        return False
    return not list(_differences(plain_values(config), plain_values(cell.config)))


def _publish(cell: Cell, output: Path) -> bool:
    working, folder = _working(cell, output), cell.folder(output)
    if not _is_whole(working / _RUN) or folder.exists():
        return False
    if log_file(working).exists():
        log_file(working).replace(working / _RUN / _LOG)
    (working / _RUN).rename(folder)
    _remove(failed_folder(cell, output))
    _remove(working)
    return True


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)


def _with_workers(config: RunConfig, cpus: int) -> RunConfig:
    """Return the configuration with as many workers as a cell has cores for, where it leaves their number open."""
    if config.env.n_workers != "auto":
        return config
    workers = min(cpus, len(config.env.task_names))
    return replace(config, env=replace(config.env, n_workers=workers if workers > 1 else 0))


def _last_line(path: Path) -> str:
    if not path.exists():
        return ""
    lines = path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1].strip() if lines else ""


def _is_whole(run: Path) -> bool:
    """Return whether a run came to its end, and was not ended early."""
    try:
        result = json.loads((run / RESULT).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return False
    return isinstance(result, Mapping) and not result.get("interrupted")


def _check_same(cell: Cell, run: Run) -> None:
    """Raise if the run is not what the cell is to be."""
    remedy = "delete the folder to train it anew, or choose another --output."
    if (run.config.scale, run.name, run.seed) != (cell.scale, cell.preset, cell.seed):
        raise ConfigError(
            f"{run.folder} holds a run of {run.config.scale}/{run.name}/seed{run.seed}, not of {cell.name}; {remedy}"
        )
    differences = list(_differences(plain_values(run.config), plain_values(cell.config)))
    if differences:
        option, there, wanted = differences[0]
        others = f" (differing options in all: {len(differences)})" if len(differences) > 1 else ""
        raise ConfigError(
            f"{run.folder} holds a run with {option}={there!r}, but {cell.name} is now to have {wanted!r}{others}; "
            + remedy
        )


def _differences(
    there: Mapping[str, Any], wanted: Mapping[str, Any], part: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    for key in dict.fromkeys([*there, *wanted]):
        before, now = there.get(key), wanted.get(key)
        if f"{part}{key}" in NO_PART_OF_A_METHOD:
            continue
        if isinstance(before, Mapping) and isinstance(now, Mapping):
            yield from _differences(before, now, f"{part}{key}.")
        elif before != now:
            yield f"{part}{key}", before, now


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
