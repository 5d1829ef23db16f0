"""``sb3-ars evaluate``: a finished run's policy, evaluated again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sb3_ars.commands.arguments import read_arguments
from sb3_ars.commands.tables import print_evaluation

__all__ = ["main"]


@dataclass(frozen=True)
class _EvaluateArguments:
    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, which holds config.yaml and policy.zip."""
    protocol: str | None = None
    """Named protocol: paper, metaworld or h150; None is the run's own."""
    n_episodes: int | None = None
    """Episodes per task, instead of the protocol's."""


def main(arguments: list[str]) -> int:
    """Run the command; return its exit status.

    :param arguments: behind the command's name
    """
    options = read_arguments(_EvaluateArguments, "sb3-ars evaluate", arguments)
    # after the options are read: it loads torch
    from sb3_ars.experiments.runner import evaluate_run

    result = evaluate_run(options.run, options.protocol, options.n_episodes)
    print_evaluation(result.table, result.protocol)
    return 0
