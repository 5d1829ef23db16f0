"""The ``sb3-ars`` command: finds the module of a command, runs it, and turns errors into one line."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from sb3_ars.errors import ConfigError, DivergedError, EnvContractError, WorkerError, nearest

__all__ = ["main"]

_COMMANDS = {
    "list": "presets",
    "train": "train",
    "evaluate": "evaluate",
    "bench": "bench",
    "tune": "tune",
    "report": "report",
    "video": "video",
    "doctor": "doctor",
}
"""Command -> module of ``sb3_ars.commands``."""

_USAGE = """sb3-ars: multi-task reinforcement learning with adaptive reward scaling on Stable-Baselines3

  sb3-ars list [WORD ...]            show the presets, or those with every word in their names
  sb3-ars train PRESET [OPTIONS]     train and evaluate
  sb3-ars train --resume RUN         go on with a run that was interrupted
  sb3-ars evaluate RUN [OPTIONS]     evaluate a run's policy again
  sb3-ars bench TABLE ... [OPTIONS]  train the cells of the paper's tables and figures, and report them
  sb3-ars tune PRESET [OPTIONS]      search for n_reset, or any other option, with Optuna
  sb3-ars report RUNS ... [OPTIONS]  write tables and figures of runs as one HTML page
  sb3-ars video RUN --task TASK      record what a run's policy does
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
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_USAGE)
        return 0 if arguments else 2
    name, *rest = arguments
    try:
        if name not in _COMMANDS:
            raise ConfigError(
                f"There is no command {name!r}; there are {', '.join(_COMMANDS)}." + nearest(name, _COMMANDS)
            )
        status: int = importlib.import_module(f"sb3_ars.commands.{_COMMANDS[name]}").main(rest)
        return status
    except (ConfigError, DivergedError, EnvContractError, WorkerError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
