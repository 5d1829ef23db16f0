"""``sb3-ars bench``: trains the cells of tables and figures, each once, and reports them."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Table

from sb3_ars.commands.arguments import read_arguments
from sb3_ars.errors import ConfigError
from sb3_ars.experiments.cells import Cell, CellState, cell_state, clean, failed_folder, plan
from sb3_ars.experiments.launchers import Launcher, LocalLauncher, Monitor, Outcome, RayLauncher
from sb3_ars.experiments.run_folder import is_finished, read_run
from sb3_ars.experiments.scaling import load_scale, scale_names
from sb3_ars.experiments.sweeps import load_sweep, sweep_names

__all__ = ["main"]


@dataclass(frozen=True)
class _BenchArguments:
    """Train the paper's tables and figures, and report them.

    A cell is one preset at one scale with one seed; each is trained once, however many tables show it.
    """

    tables: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(help_behavior_hint="")] = ()
    """Tables and figures, such as table1 fig11, or paths of YAML files; sb3-ars bench alone lists them."""
    scale: tuple[str, ...] = ("full",)
    """Sizes to train at: full is the paper's; or paths of YAML files."""
    seeds: int = 8
    """Number of seeds: 3 means seeds 0, 1 and 2."""
    only: Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="(default: all)")] = ()
    """Presets to train, of those that the tables have."""
    output: Path = Path("sweep")
    """Folder that holds the sweep's runs; finished ones in it are not trained again."""
    launcher: Literal["local", "ray"] = "local"
    """Where cells run: processes of this machine, or a Ray cluster that is there already."""
    processes: int | None = None
    """Cells at a time (local); None is as many as there are cores for."""
    cpus_per_cell: int = 1
    """Cores, and threads, of each cell."""
    gpus_per_cell: float | None = None
    """GPUs, or share of one, of each cell (ray); local shares all GPUs out in turn."""
    ray_address: str | None = None
    """Address of the Ray cluster; None finds the one of this machine."""
    retries: int | None = None
    """Times that a cell starts again after its node died (ray); None is 3."""
    dry_run: bool = False
    """Print the cells and their state, and train nothing."""


def main(arguments: list[str]) -> int:
    """Run the command; return its exit status: 1 if a cell is not finished at the end.

    :param arguments: behind the command's name
    """
    if not arguments:
        _print_catalogue()
        return 0
    options = read_arguments(_BenchArguments, "sb3-ars bench", arguments)
    if not options.tables:
        raise ConfigError(f"Name the tables or figures to train: {', '.join(sweep_names())}.")
    sweeps = [load_sweep(name) for name in options.tables]
    cells = plan(sweeps, options.scale, options.seeds, options.only)
    launcher = _launcher(options)
    if options.dry_run:
        _check_folder(options.output)
        _print_cells(cells, options.output, {})
        return 0
    _clean_all(cells, options.output)
    waiting = [cell for cell in cells if cell_state(cell, options.output) in ("missing", "failed")]
    steps = sum(cell.config.algorithm.total_timesteps for cell in waiting)
    announcement = (
        f"{_cells(len(cells))} in {options.output}, {len(waiting)} to train: {steps:,} environment steps.\n"
        "Ctrl-C ends it; the same command goes on where it stopped."
    )
    with _monitor(len(waiting), announcement) as monitor:
        outcomes = launcher.run(waiting, options.output, monitor)
    states = _print_cells(cells, options.output, {outcome.cell: outcome for outcome in outcomes})
    _report(cells, options)
    return 0 if set(states) == {"finished"} else 1


def _launcher(options: _BenchArguments) -> Launcher:
    ray = {"gpus_per_cell": options.gpus_per_cell, "retries": options.retries, "address": options.ray_address}
    if options.launcher == "ray":
        if options.processes is not None:
            raise ConfigError(
                "--processes goes with --launcher local; a Ray cluster runs what it has room for."
            )
        given: dict[str, Any] = {name: value for name, value in ray.items() if value is not None}
        return RayLauncher(cpus_per_cell=options.cpus_per_cell, **given)
    for name, value in ray.items():
        if value is not None:
            option = "ray-address" if name == "address" else name.replace("_", "-")
            raise ConfigError(f"--{option} goes with --launcher ray; drop it, or name that launcher.")
    return LocalLauncher(options.processes, options.cpus_per_cell)


def _check_folder(output: Path) -> None:
    there = next(path for path in (output, *output.parents) if path.exists())
    if not there.is_dir():
        raise ConfigError(f"{there} is no folder; choose another --output.")


def _clean_all(cells: Sequence[Cell], output: Path) -> None:
    """Clear away what processes that are no more left, which shows that the folder can be written."""
    _check_folder(output)
    try:
        output.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=output).close()
        for cell in cells:
            clean(cell, output)
    except OSError as error:
        raise ConfigError(
            f"Nothing can be written to {output} ({error.strerror}); choose another --output."
        ) from error


def _report(cells: Sequence[Cell], options: _BenchArguments) -> None:
    from sb3_ars.experiments.report import write_report  # loads matplotlib and pandas

    folders = [cell.folder(options.output) for cell in cells if is_finished(cell.folder(options.output))]
    failed = [failed_folder(cell, options.output) for cell in cells]
    if not folders:
        print("No cell is finished, so there is nothing to report.")
        return
    expected = [(cell.scale, cell.preset, cell.seed) for cell in cells]
    folders += [folder for folder in failed if folder.exists()]
    page = write_report(folders, options.output / "report", sweeps=options.tables, expected=expected)
    print(f"report: {page}")


# ---------------------------------------------------------------------- tables


def _print_catalogue() -> None:
    tables = Table("name", "in the paper", "what it compares", box=None, padding=(0, 1, 0, 0))
    tables.add_column("presets", justify="right")
    for name in sweep_names():
        sweep = load_sweep(name)
        tables.add_row(name, sweep.source, sweep.title, str(len(sweep.presets)))
    scales = Table("scale", "what it is", box=None, padding=(0, 1, 0, 0))
    for name in scale_names():
        scales.add_row(name, load_scale(name).description)
    console = _console()
    console.print(tables)
    console.print()
    console.print(scales)
    print("\nsb3-ars bench table1 table4 --scale toy small --seeds 3; --help shows the options.")


def _print_cells(cells: Sequence[Cell], output: Path, outcomes: Mapping[Cell, Outcome]) -> list[CellState]:
    """Print a row for each cell; return their states."""
    table = Table("cell", "state", box=None, padding=(0, 1, 0, 0))
    table.add_column("minutes", justify="right")
    table.add_column("success", justify="right")
    table.add_column("error", overflow="fold")
    states = [cell_state(cell, output) for cell in cells]
    for cell, state in zip(cells, states, strict=True):
        minutes = success = ""
        if state == "finished":
            result = read_run(cell.folder(output)).result
            minutes = f"{result['training_seconds'] / 60:.1f}"
            success = "" if result["mean_success"] is None else f"{result['mean_success']:.2f}"
        error = outcomes[cell].error if cell in outcomes else ""
        table.add_row(cell.name, _COLOURS[state], minutes, success, escape(error))
    _console().print(table)
    counts = ", ".join(f"{states.count(state)} {state}" for state in _COLOURS if state in states)
    print(f"{_cells(len(cells))}: {counts}")
    return states


_COLOURS = {
    "finished": "finished",
    "failed": "[bold red]failed[/]",
    "running": "[yellow]running[/]",
    "missing": "[dim]missing[/]",
}


def _console() -> Console:
    # in a pipe there is nothing to wrap lines for, and a cell a line can be searched
    return Console(highlight=False, width=None if sys.stdout.isatty() else 160)


# ---------------------------------------------------------------------- progress


@contextmanager
def _monitor(total: int, announcement: str) -> Iterator[Monitor]:
    """Show how a sweep goes on: bars on a terminal, a line for each cell that ended elsewhere."""
    console = Console(highlight=False)
    if not console.is_terminal:
        yield _Lines(total, announcement)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"))
    with Progress(*columns, console=console) as progress:
        yield _Bars(total, announcement, progress)


class _Lines:
    """A line for each cell that ended.

    :param total: number of cells
    :param announcement: to print before the first
    """

    def __init__(self, total: int, announcement: str) -> None:
        self._total, self._ended, self._began = total, 0, time.monotonic()
        self._announcement = announcement

    def ready(self) -> None:
        self.line(self._announcement)

    def started(self, cell: Cell) -> None:
        pass

    def progressed(self, cell: Cell, steps: int) -> None:
        pass

    def ended(self, outcome: Outcome) -> None:
        self._ended += 1
        left = (time.monotonic() - self._began) / self._ended * (self._total - self._ended)
        self.line(f"[{self._ended}/{self._total}] {_ending(outcome)}; about {_minutes(left)} left")

    def line(self, text: str) -> None:
        print(text, flush=True)


class _Bars(_Lines):
    """A bar for the sweep and one for each cell at work, above them a line for each that ended.

    :param total: number of cells
    :param announcement: to print above them
    :param progress: that draws them
    """

    def __init__(self, total: int, announcement: str, progress: Progress) -> None:
        super().__init__(total, announcement)
        self._progress = progress
        self._sweep = progress.add_task("sweep", total=total, state=f"0 of {_cells(total)}")
        self._tasks: dict[Cell, tuple[TaskID, float]] = {}

    def started(self, cell: Cell) -> None:
        total = cell.config.algorithm.total_timesteps
        self._tasks[cell] = self._progress.add_task(cell.name, total=total, state=""), time.monotonic()

    def progressed(self, cell: Cell, steps: int) -> None:
        (task, began), total = self._tasks[cell], cell.config.algorithm.total_timesteps
        state = f"{min(steps, total):,} of {total:,} steps"
        if steps:
            state += f", {_minutes((time.monotonic() - began) / steps * max(0, total - steps))} left"
        self._progress.update(task, completed=steps, state=state)

    def ended(self, outcome: Outcome) -> None:
        super().ended(outcome)
        if outcome.cell in self._tasks:
            self._progress.remove_task(self._tasks.pop(outcome.cell)[0])
        self._progress.update(
            self._sweep, completed=self._ended, state=f"{self._ended} of {_cells(self._total)}"
        )

    def line(self, text: str) -> None:
        self._progress.console.print(escape(text))


def _ending(outcome: Outcome) -> str:
    name = outcome.cell.name
    if outcome.status == "elsewhere":
        return f"{name}: another process has it"
    return f"{name}: {outcome.status} after {_minutes(outcome.seconds)}" + (
        f": {outcome.error}" if outcome.error else ""
    )


def _cells(count: int) -> str:
    return "1 cell" if count == 1 else f"{count} cells"


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.1f} minutes"
