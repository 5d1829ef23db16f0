"""What a study found: a summary, figures, a table and the best configuration as files; trains nothing."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import optuna
import optuna.visualization.matplotlib as figures
import pandas as pd
import yaml
from matplotlib.ticker import MaxNLocator
from optuna.exceptions import ExperimentalWarning
from optuna.trial import FrozenTrial, TrialState

from sb3_ars.errors import ConfigError
from sb3_ars.files import write_whole
from sb3_ars.tuning.liveness import counts, is_dead, why_failed
from sb3_ars.tuning.study import DEFINITION

__all__ = ["Tried", "TuningSummary", "summarise", "unused_seed", "write_results"]

N_RESET = "ars.n_reset"

_SUCCESS = (-0.03, 1.03)  # limits of an axis


@dataclass(frozen=True)
class Tried:
    """Options that were tried, all complete trials of them together.

    :param params: by dotted name, as Optuna stores them
    :param trials: numbers of the trials
    :param values: mean success of each run, over all seeds
    """

    params: dict[str, Any]
    trials: tuple[int, ...]
    values: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean success over runs."""
        return float(np.mean(self.values))

    @property
    def std(self) -> float:
        """Standard deviation over runs (n - 1), NaN for a single one."""
        return float(np.std(self.values, ddof=1)) if len(self.values) > 1 else float("nan")


@dataclass(frozen=True)
class TuningSummary:
    """What a study came to.

    :param study: its name
    :param tried: options of complete trials, best first
    :param states: how many trials ended how: complete, pruned, failed, running elsewhere
    :param spread: standard deviation of mean success over the seeds of the same options, pooled; NaN with one seed
    :param verdict: whether the best options beat the worst and the second by more than that, in sentences
    :param failures: number of each trial that failed by its own options, and why
    """

    study: str
    tried: tuple[Tried, ...]
    states: dict[str, int]
    spread: float
    verdict: str
    failures: dict[int, str]


def summarise(study: optuna.Study) -> TuningSummary:
    """Return what a study has come to.

    :param study: whose trials an objective of :func:`~sb3_ars.tuning.make_objective` ran
    """
    trials = study.get_trials(deepcopy=False)
    groups: dict[str, list[FrozenTrial]] = {}
    for trial in trials:
        if trial.state is TrialState.COMPLETE:
            groups.setdefault(json.dumps(trial.params, sort_keys=True), []).append(trial)
    tried = [
        Tried(
            same[0].params,
            tuple(trial.number for trial in same),
            tuple(value for trial in same for value in trial.user_attrs.get("values", [trial.value])),
        )
        for same in groups.values()
    ]
    tried.sort(key=lambda options: options.mean, reverse=True)
    failed = [trial for trial in trials if trial.state is TrialState.FAIL]
    states = {
        "complete": sum(trial.state is TrialState.COMPLETE for trial in trials),
        "pruned": sum(trial.state is TrialState.PRUNED for trial in trials),
        "failed by their options": sum(map(counts, failed)),
        "interrupted or killed, and tried again": sum(not counts(trial) for trial in failed),
        "running elsewhere": sum(
            trial.state is TrialState.RUNNING and not is_dead(trial) for trial in trials
        ),
    }
    spread = _pooled_std([options.values for options in tried])
    failures = {trial.number: why_failed(trial) for trial in failed if counts(trial)}
    return TuningSummary(study.study_name, tuple(tried), states, spread, _verdict(tried, spread), failures)


def write_results(study: optuna.Study, folder: Path | str) -> tuple[list[Path], list[str]]:
    """Write figures (PNG and SVG), ``trials.csv`` and ``best.yaml``; return the files and what was left out, and why.

    :param study: with or without trials
    :param folder: made if missing
    :raises ConfigError: if it cannot be written
    """
    folder = Path(folder)
    summary = summarise(study)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = [_write_text(folder / "trials.csv", trials_table(study).to_csv(index=False))]
        if summary.tried:
            best = yaml.safe_dump(_best_config(study, summary.tried[0]), sort_keys=False)
            written.append(_write_text(folder / "best.yaml", best))
        drawn, left_out = _draw(study, summary, folder)
    except OSError as error:
        raise ConfigError(
            f"{folder} cannot be written ({error.strerror}); choose another --output."
        ) from error
    return [*written, *drawn], left_out


def trials_table(study: optuna.Study) -> pd.DataFrame:
    """Return one row per trial: state, value, options, each run's mean success, each task's mean over runs.

    :param study: with or without trials
    """
    rows = []
    for trial in study.get_trials(deepcopy=False):
        attributes = trial.user_attrs
        failed = trial.state is TrialState.FAIL
        rows.append(
            {
                "trial": trial.number,
                "state": trial.state.name,
                "value": trial.value if trial.state is TrialState.COMPLETE else None,
                **trial.params,
                **{
                    f"seed {s}": v
                    for s, v in zip(attributes.get("seeds", []), attributes.get("values", []), strict=False)
                },
                **{f"success/{t}": _mean_or_none(v) for t, v in attributes.get("success", {}).items()},
                "seconds": attributes.get("seconds"),
                "retry of": attributes.get("retry_of"),
                "why": why_failed(trial) if failed else None,
            }
        )
    return pd.DataFrame(rows)


def unused_seed(study: optuna.Study) -> int | None:
    """Return a seed that no trial has trained, the one after all of theirs; ``None`` if there are none.

    A run with it is the first that did not take part in choosing the best options.

    :param study: with or without trials
    """
    used = [seed for trial in study.get_trials(deepcopy=False) for seed in trial.user_attrs.get("seeds", [])]
    return max(used) + 1 if used else None


def _best_config(study: optuna.Study, best: Tried) -> dict[str, Any]:
    """Return the best options' configuration, with the preset's evaluations and a seed that did not choose them."""
    config: dict[str, Any] = study.get_trials()[best.trials[0]].user_attrs["config"]
    seed = unused_seed(study)
    if seed is not None:
        config["seed"] = seed
    definition = study.user_attrs.get(DEFINITION)
    if definition is not None:
        config["evaluation"] = definition["config"]["evaluation"]
    return config


def _pooled_std(groups: list[tuple[float, ...]]) -> float:
    several = [values for values in groups if len(values) > 1]
    freedom = sum(len(values) - 1 for values in several)
    if not freedom:
        return float("nan")
    return float(np.sqrt(sum(np.var(values) * len(values) for values in several) / freedom))


def _verdict(tried: list[Tried], spread: float) -> str:
    if not tried:
        return "No trial came to its end, so there is no best one."
    if len(tried) == 1:
        return f"Only {_name(tried[0])} came to its end, so there is nothing to compare it with."
    best, second, worst = tried[0], tried[1], tried[-1]
    if np.isnan(spread):
        return (
            f"Best is {_name(best)} ({best.mean:.3f}), worst {_name(worst)} ({worst.mean:.3f}). With one seed nobody "
            "can say whether that is more than chance; give --seeds 2 or more."
        )
    sentences = [
        f"Mean success varies by {spread:.3f} (standard deviation) between seeds of the same options."
    ]
    others = [("worst", worst), ("second", second)] if len(tried) > 2 else [("other", second)]
    for rank, other in others:
        difference = best.mean - other.mean
        beats = "beats" if difference > spread else "does not beat"
        sentences.append(
            f"The best, {_name(best)} ({best.mean:.3f}), {beats} the {rank}, {_name(other)} ({other.mean:.3f}), by "
            f"more than that: the difference is {difference:.3f}."
        )
    return " ".join(sentences)


def _name(options: Tried) -> str:
    return ", ".join(f"{name.rpartition('.')[2]}={_short(value)}" for name, value in options.params.items())


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


# ---------------------------------------------------------------------- figures


def _draw(study: optuna.Study, summary: TuningSummary, folder: Path) -> tuple[list[Path], list[str]]:
    complete = summary.states["complete"]
    options = sorted({name for trial in study.get_trials(deepcopy=False) for name in trial.params})
    differ = len({options.mean for options in summary.tried}) > 1
    several = "it needs two complete trials" if complete < 2 else None
    plots: dict[str, tuple[Callable[[], Any], str | None]] = {
        "history": (lambda: _history(study), several),
        "slice": (
            lambda: _slice(study, summary),
            several or (None if N_RESET in options else f"{N_RESET} was not tuned"),
        ),
        "importance": (
            lambda: _importance(study),
            several
            or ("it needs two options" if len(options) < 2 else None)
            or (None if differ else "all trials have the same value"),
        ),
        "parallel": (
            lambda: _parallel(study),
            several or ("it needs two options" if len(options) < 2 else None),
        ),
    }
    written, left_out = [], []
    for name, (draw, reason) in plots.items():
        if reason is not None:
            left_out.append(f"The figure {name} is left out: {reason}.")
            continue
        # Optuna changes matplotlib's style for good, and calls its matplotlib figures experimental
        with matplotlib.rc_context(), warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            axes = draw()
            figure = axes.figure
            for suffix in ("png", "svg"):
                path = folder / f"{name}.{suffix}"
                write_whole(path, partial(figure.savefig, dpi=130, bbox_inches="tight"))
                written.append(path)
            plt.close(figure)
    return written, left_out


def _history(study: optuna.Study) -> Any:
    axes = figures.plot_optimization_history(study, target_name="mean success")
    axes.set(title=f"{study.study_name}: value of each trial", ylim=_SUCCESS)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return axes


def _importance(study: optuna.Study) -> Any:
    axes: Any = figures.plot_param_importances(study, target_name="mean success")
    axes.set_title(f"{study.study_name}: importance of options", loc="left")  # where Optuna puts its own
    axes.get_legend().remove()  # of a single colour
    return axes


def _slice(study: optuna.Study, summary: TuningSummary) -> Any:
    axes: Any = figures.plot_slice(study, params=[N_RESET], target_name="mean success")
    _recolor(axes)
    resets = [options.params[N_RESET] for options in summary.tried for _ in options.values]
    runs = [value for options in summary.tried for value in options.values]
    marks = axes.scatter(resets, runs, color="black", marker="_", s=90, zorder=3, label="each run")
    axes.set(title=f"{study.study_name}: number of resets", xlabel="n_reset", ylim=_SUCCESS)
    axes.legend(handles=[marks], loc="upper left", bbox_to_anchor=(0, -0.12), frameon=False)
    for axis in (axes.xaxis, axes.figure.axes[-1].yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    return axes


def _parallel(study: optuna.Study) -> Any:
    axes: Any = figures.plot_parallel_coordinate(study, target_name="mean success")
    _recolor(axes)
    axes.set_title(f"{study.study_name}: options of each trial")
    for other in axes.figure.axes[1:]:
        low, high = other.get_ylim()
        if low == int(low) and high == int(high) and high - low > 1 and not other.get_label() == "<colorbar>":
            other.yaxis.set_major_locator(MaxNLocator(integer=True))
    return axes


def _recolor(axes: Any) -> None:
    """Take Optuna's colours, of which the lowest is white on white, for ones that can all be seen."""
    for collection in axes.collections:
        if collection.get_array() is not None:
            collection.set_cmap("viridis_r")


def _mean_or_none(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _write_text(path: Path, text: str) -> Path:
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return path
