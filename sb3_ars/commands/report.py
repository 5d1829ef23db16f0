"""``sb3-ars report``: tables and figures of runs as one HTML page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sb3_ars.commands.arguments import read_arguments

__all__ = ["main"]


@dataclass(frozen=True)
class _ReportArguments:
    """Write tables and figures of runs as one HTML page, and the tables as CSV and Markdown."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(help_behavior_hint="")]
    """Folders of runs, or folders that hold runs."""
    output: Path = Path("report")
    """Folder of the report: index.html, and its tables as CSV and Markdown."""
    sweeps: Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="(default: what fits the runs)")] = ()
    """Tables and figures of the paper to show in their form, such as table1 fig5, or paths of YAML files."""
    videos: bool = False
    """Put the runs' videos into the page."""


def main(arguments: list[str]) -> int:
    """Run the command; return its exit status.

    :param arguments: behind the command's name
    """
    options = read_arguments(_ReportArguments, "sb3-ars report", arguments)
    from sb3_ars.experiments.report import write_report  # after the options are read: it loads much

    page = write_report(options.runs, options.output, options.sweeps, options.videos)
    print(f"Report: {page}")
    return 0
