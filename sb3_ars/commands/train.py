"""``sb3-ars train``: one run of a preset, or of a configuration's file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from sb3_ars.commands.arguments import read_arguments
from sb3_ars.commands.tables import print_evaluation
from sb3_ars.errors import ConfigError
from sb3_ars.experiments.config import RunConfig, load_config, load_preset
from sb3_ars.profiling import PARTS

if TYPE_CHECKING:
    from sb3_ars.experiments.runner import RunResult

__all__ = ["main"]

_USAGE = """sb3-ars train PRESET [OPTIONS] trains a preset and evaluates it; 'sb3-ars list' shows the presets, and
'sb3-ars train PRESET --help' a preset's options. A run's config.yaml, or a study's best.yaml, may stand for PRESET.

sb3-ars train --resume RUN goes on with a run that was killed, stopped or interrupted, given by its folder."""


def main(arguments: list[str]) -> int:
    """Run the command; return its exit status.

    :param arguments: behind the command's name
    """
    if arguments and arguments[0] == "--resume":
        return _resume(arguments[1:])
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_USAGE)
        return 0 if arguments else 2
    if arguments[0].startswith("-"):
        raise ConfigError(
            f"sb3-ars train takes a PRESET before {arguments[0]}, such as toy; 'sb3-ars list' shows the presets."
        )
    given, *rest = arguments
    path = Path(given)
    is_file = path.suffix in (".yaml", ".yml")
    name = path.stem if is_file else given
    config = read_arguments(
        RunConfig,
        f"sb3-ars train {given}",
        rest,
        description=f"Train {given}; the defaults shown are its own.",
        default=load_config(path) if is_file else load_preset(name),
    )
    # after the options are read: it loads torch, and a mistake or --help should not wait for that
    from sb3_ars.experiments.runner import train

    print(
        f"Training {name}: {config.algorithm.total_timesteps:,} environment steps. Ctrl-C ends it early and keeps it."
    )
    _show(train(config, name))
    return 0


def _resume(arguments: list[str]) -> int:
    usage = "sb3-ars train --resume takes one argument, the folder of a run; its options are those in its config.yaml."
    if arguments in (["-h"], ["--help"]):
        print(usage)
        return 0
    if len(arguments) != 1 or arguments[0].startswith("-"):
        raise ConfigError(usage)
    from sb3_ars.experiments.runner import resume  # loads torch

    _show(resume(Path(arguments[0])))
    return 0


def _show(result: RunResult) -> None:
    """Print what a finished run came to, and where it lies."""
    print_evaluation(result.table, result.protocol)
    if result.seconds_by_part is not None:
        _print_profile(result.seconds_by_part)
    print(f"Trained in {result.seconds / 60:.1f} minutes.")
    for label, file in (("policy", "policy.zip"), ("picture", "training.png"), ("log", "progress.csv")):
        print(f"  {label:8} {result.folder / file}")
    print(f"  evaluate it again with: sb3-ars evaluate {result.folder}")


def _print_profile(seconds_by_part: dict[str, float]) -> None:
    total = sum(seconds_by_part.values())
    table = Table("part", "what it is", box=None, title="Where the training time went", title_justify="left")
    table.add_column("seconds", justify="right")
    table.add_column("share", justify="right")
    for part, seconds in seconds_by_part.items():
        table.add_row(part, PARTS[part], f"{seconds:,.1f}", f"{seconds / total:.1%}")
    Console().print(table)
