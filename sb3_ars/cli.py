"""The ``sb3-ars`` command: reads arguments, calls the package, prints; no logic of its own."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.table import Table

from sb3_ars.errors import ConfigError, DivergedError, EnvContractError, WorkerError

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["main"]

_USAGE = """sb3-ars: multi-task reinforcement learning with adaptive reward scaling on Stable-Baselines3

  sb3-ars list [WORD ...]            show the presets, or those with every word in their names
  sb3-ars train PRESET [OPTIONS]     train and evaluate
  sb3-ars evaluate RUN [OPTIONS]     evaluate a run's policy again
  sb3-ars doctor                     check this machine and its packages

Add --help behind a preset or a command for its options."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status.

    :param argv: arguments; ``None`` takes the process's
    """
    # torch's OpenMP threads wait for work by spinning, which takes the cores from the environments' workers; this lets
    # them sleep after some microseconds. Read when torch loads, so it stands before anything that imports it.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    arguments = list(sys.argv[1:] if argv is None else argv)
    commands: dict[str, Callable[[list[str]], int]] = {
        "list": _list,
        "train": _train,
        "evaluate": _evaluate,
        "doctor": _doctor,
    }
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_USAGE)
        return 0 if arguments else 2
    name, *rest = arguments
    try:
        if name not in commands:
            raise ConfigError(f"There is no command {name!r}; there are {', '.join(commands)}.")
        return commands[name](rest)
    except (ConfigError, DivergedError, EnvContractError, WorkerError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _list(arguments: list[str]) -> int:
    if any(argument.startswith("-") for argument in arguments):
        print("sb3-ars list [WORD ...] shows the presets, or those with every word in their names.")
        return 0 if arguments[0] in ("-h", "--help") else 2
    from sb3_ars.experiments import find_presets, preset_group, preset_info

    table = Table(box=None, padding=(0, 1, 0, 0))
    table.add_column("preset", no_wrap=True)
    table.add_column("what it is")
    table.add_column("steps", justify="right")
    table.add_column("table", no_wrap=True)
    table.add_column("success", no_wrap=True)
    names = find_presets(arguments)
    for name, before in zip(names, [None, *names], strict=False):
        if before is not None and preset_group(before) != preset_group(name):
            table.add_row()
        info = preset_info(name)
        table.add_row(name, info.description, _short(info.total_timesteps), info.table, info.success)
    # in a pipe there is nothing to wrap lines for, and one line per preset can be searched
    Console(highlight=False, width=None if sys.stdout.isatty() else 120).print(table)
    print(
        "\nsteps: of the environments, all tasks together; table and success: the paper's, in %, over 8 seeds."
    )
    return 0


def _short(steps: int) -> str:
    return f"{steps // 10**6}M" if steps >= 10**6 else f"{steps // 1000}k"


def _train(arguments: list[str]) -> int:
    from sb3_ars.experiments.config import load_preset

    if not arguments or arguments[0].startswith("-"):
        print(_USAGE)
        return 0 if arguments and arguments[0] in ("-h", "--help") else 2
    name, *rest = arguments
    config = tyro.cli(
        type(preset := load_preset(name)),
        prog=f"sb3-ars train {name}",
        description=f"Train the preset {name}; the defaults shown are the preset's.",
        default=preset,
        args=rest,
    )
    from sb3_ars.experiments.runner import train

    print(
        f"Training {name}: {config.algorithm.total_timesteps:,} environment steps. Ctrl-C ends it early and keeps it."
    )
    result = train(config, name)
    _print_table(result.table, result.protocol)
    if result.seconds_by_part is not None:
        _print_profile(result.seconds_by_part)
    print(f"Trained in {result.seconds / 60:.1f} minutes.")
    for label, file in (("policy", "policy.zip"), ("picture", "training.png"), ("log", "progress.csv")):
        print(f"  {label:8} {result.folder / file}")
    print(f"  evaluate it again with: sb3-ars evaluate {result.folder}")
    return 0


@dataclass(frozen=True)
class _EvaluateArguments:
    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, which holds config.yaml and policy.zip."""
    protocol: str | None = None
    """Named protocol: paper, metaworld or h150; None is the run's own."""
    n_episodes: int | None = None
    """Episodes per task, instead of the protocol's."""


def _evaluate(arguments: list[str]) -> int:
    options = tyro.cli(_EvaluateArguments, prog="sb3-ars evaluate", args=arguments)
    from sb3_ars.experiments.runner import evaluate_run

    result = evaluate_run(options.run, options.protocol, options.n_episodes)
    _print_table(result.table, result.protocol)
    return 0


def _doctor(arguments: list[str]) -> int:
    if arguments:
        print(
            "sb3-ars doctor takes no options; it checks versions, processors, GPU, rendering and Meta-World."
        )
        return 0 if arguments[0] in ("-h", "--help") else 2
    from sb3_ars.doctor import run_checks

    checks = run_checks()
    table = Table("", "check", "found", box=None)
    for check in checks:
        table.add_row("ok" if check.ok else "[bold red]!![/]", check.name, check.found)
    Console().print(table)
    return 0 if all(check.ok for check in checks) else 1


def _print_table(frame: pd.DataFrame, protocol: str) -> None:
    table = Table(title=protocol, title_justify="left")
    table.add_column("task")
    for heading in ("success", "success, sampled", "at the end", "return", "c_i"):
        table.add_column(heading, justify="right")
    columns = ("success", "success_sampled", "success_at_end", "return", "c")
    formats = ("{:.2f}", "{:.2f}", "{:.2f}", "{:,.1f}", "{:.3g}")
    for name, row in frame.iterrows():
        table.add_row(str(name), *(f.format(row[c]) for f, c in zip(formats, columns, strict=True)))
    table.add_section()
    means = [f.format(frame[c].mean()) for f, c in zip(formats[:3], columns[:3], strict=True)]
    table.add_row("mean", *means, "", "")
    Console().print(table)


def _print_profile(seconds_by_part: dict[str, float]) -> None:
    from sb3_ars.profiling import PARTS

    total = sum(seconds_by_part.values())
    table = Table("part", "what it is", box=None, title="Where the training time went", title_justify="left")
    table.add_column("seconds", justify="right")
    table.add_column("share", justify="right")
    for part, seconds in seconds_by_part.items():
        table.add_row(part, PARTS[part], f"{seconds:,.1f}", f"{seconds / total:.1%}")
    Console().print(table)


if __name__ == "__main__":
    sys.exit(main())
