"""``sb3-ars tune``: a study of a preset's options."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from sb3_ars.commands.arguments import read_arguments

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

    from sb3_ars.tuning import TuningSummary

__all__ = ["main"]

_DESCRIPTION = """Search for the best values of a preset's options, n_reset first of all. A trial trains several seeds;
its value is their mean success over tasks. Started again, the same command goes on where it stopped; started twice, the
two processes share the trials."""


@dataclass(frozen=True)
class _TuneArguments:
    preset: Annotated[str, tyro.conf.Positional]
    """Preset whose options are tuned; 'sb3-ars list' shows them."""
    space: str = "n_reset"
    """Search space: n_reset, resets, learning, networks, or the path of your own .yaml file."""
    scale: str = "full"
    """Size of the runs: full, small, toy, or the path of your own .yaml file."""
    n_trials: int = 20
    """Trials of the study, all processes together."""
    timeout: float | None = None
    """Minutes after which this process starts no further trial."""
    seeds: int = 3
    """Runs of each trial."""
    evaluations: int = 4
    """Evaluations during each run, evenly spaced."""
    pruner: Literal["median", "wilcoxon", "none"] = "median"
    """Ends bad trials early: by the median of the others at each evaluation, by a Wilcoxon test over tasks after each
    run, or not at all."""
    storage: str | None = None
    """Journal file, or a database such as postgresql+psycopg://user:password@host/name; None is a journal file in the
    study's folder."""
    study: str | None = None
    """Name of the study; None makes one of preset, space and scale."""
    output: Path = Path("studies")
    """Folder in which the study makes its own folder."""
    sampler_seed: int = 0
    """Seed of the values to try."""


def main(arguments: list[str]) -> int:
    """Run the command; return its exit status.

    :param arguments: behind the command's name
    """
    options = read_arguments(_TuneArguments, "sb3-ars tune", arguments, description=_DESCRIPTION)
    # after the options are read: it loads torch
    from sb3_ars.tuning import summarise, tune, unused_seed, write_results

    def announce(study: optuna.Study) -> None:
        print(
            f"Tuning {options.preset}, study {study.study_name}: {options.n_trials} trials of {options.seeds} seeds. "
            "Ctrl-C ends the running trial; the same command goes on.",
            flush=True,
        )

    with warnings.catch_warnings():
        warnings.showwarning = _print_warning
        study = tune(
            options.preset,
            options.space,
            n_trials=options.n_trials,
            timeout=None if options.timeout is None else 60 * options.timeout,
            n_seeds=options.seeds,
            n_evaluations=options.evaluations,
            pruner=options.pruner,
            storage=options.storage,
            name=options.study,
            output=options.output,
            scale=options.scale,
            seed=options.sampler_seed,
            callbacks=[_print_trial],
            before_first_trial=announce,
        )
    folder = options.output / study.study_name
    summary = summarise(study)
    files, left_out = write_results(study, folder)
    print_summary(summary, study.user_attrs["definition"]["seeds"])
    print(f"Written to {folder}: {', '.join(file.name for file in files)}.")
    for sentence in left_out:
        print(sentence)
    if not summary.tried:
        return 1
    print(
        f"Train the best one with a seed that no trial used, {unused_seed(study)} (for further runs add --seed with "
        f"higher ones):\n  sb3-ars train {folder / 'best.yaml'}"
    )
    return 0


def print_summary(summary: TuningSummary, n_seeds: int, n_best: int = 10) -> None:
    """Print the best options and how sure that is.

    :param summary: of the study
    :param n_seeds: runs of each trial
    :param n_best: rows of the table
    """
    ended = ", ".join(f"{number} {state}" for state, number in summary.states.items() if number)
    table = Table(title=f"{summary.study}: {ended or 'no trials'}", title_justify="left")
    for name in summary.tried[0].params if summary.tried else ():
        table.add_column(name, justify="right")
    for heading in ("mean success", "std over runs", "runs", "trials"):
        table.add_column(heading, justify="right")
    for tried in summary.tried[:n_best]:
        values = [
            f"{value:.4g}" if isinstance(value, float) else str(value) for value in tried.params.values()
        ]
        std = f"{tried.std:.3f}" if len(tried.values) > 1 else "-"
        trials = ", ".join(map(str, tried.trials))
        table.add_row(*values, f"{tried.mean:.3f}", std, str(len(tried.values)), trials)
    if summary.tried:
        Console(highlight=False).print(table)
    for number, why in summary.failures.items():
        print(f"Trial {number} failed: {why}")
    print(summary.verdict)


def _print_warning(message: Warning | str, *where: Any, **more: Any) -> None:
    print(f"warning: {message}", file=sys.stderr)


def _print_trial(study: optuna.Study, trial: FrozenTrial) -> None:
    from sb3_ars.tuning.liveness import why_failed

    options = ", ".join(f"{name}={value}" for name, value in trial.params.items())
    values = trial.user_attrs.get("values", [])
    by_seed = f" ({', '.join(f'{value:.3f}' for value in values)})" if len(values) > 1 else ""
    outcomes: dict[str, Callable[[], str]] = {
        "COMPLETE": lambda: f"mean success {trial.value:.3f}{by_seed}, {trial.user_attrs['seconds']:.0f} s",
        "PRUNED": lambda: f"pruned at {_value(trial.value)}",
        "FAIL": lambda: f"failed: {why_failed(trial)}",
    }
    print(f"Trial {trial.number}: {options}: {outcomes[trial.state.name]()}", flush=True)


def _value(value: Any) -> str:
    return "no value" if value is None else f"{value:.3f}"
