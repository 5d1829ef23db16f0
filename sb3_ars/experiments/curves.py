"""Numbers over training, of several seeds on common steps, from the folders of runs; draws nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_ars.algorithms.task_log import log_names
from sb3_ars.errors import ConfigError
from sb3_ars.experiments.run_folder import Run

__all__ = [
    "Curves",
    "Source",
    "common_source",
    "logged_curves",
    "reset_times",
    "scale_curves",
    "success_curves",
]

Array = npt.NDArray[np.float64]
Source = Literal["evaluation", "training"]
"""Where success over training comes from: evaluations in between, or the training episodes themselves."""

_POINTS = 150  # more than a figure can show


class Curves(NamedTuple):
    """One quantity over training.

    :param steps: of the environments, all tasks together, ``(n_points,)``
    :param values: ``(n_seeds, n_points, n_tasks)``; NaN where a seed has no number of a task
    """

    steps: Array
    values: Array


def common_source(runs: Sequence[Run]) -> Source:
    """Return where all of the runs' success over training can come from, so that one figure has one kind of number.

    :param runs: that a figure shows
    """
    return "evaluation" if all(run.evaluations() is not None for run in runs) else "training"


def success_curves(runs: Sequence[Run], source: Source) -> Curves:
    """Return the tasks' success in [0, 1] over training.

    :param runs: seeds of one method
    :param source: "evaluation", which every run must have, or "training": the latest episodes of each task
    :raises ConfigError: if a run has no evaluations, or its files cannot be read
    """
    if source == "training":
        return logged_curves(runs, "success")
    series = []
    for run in runs:
        found = run.evaluations()
        if found is None:
            raise ConfigError(f"{run.folder} has no evaluations during training; take source='training'.")
        series.append((found[0].astype(np.float64), found[1]))
    return _on_common_steps(series)


def logged_curves(runs: Sequence[Run], key: str) -> Curves:
    """Return a per-task number of the log over training.

    :param runs: seeds of one method
    :param key: such as "q_value"; the columns are ``q_value/<task>``
    :raises ConfigError: if a log cannot be read
    """
    return _on_common_steps([_logged(run, key) for run in runs])


def scale_curves(runs: Sequence[Run]) -> Curves:
    """Return c_i of every task, constant from each point to the next; the last point is the end of the run.

    :param runs: seeds of one method
    """
    histories = [run.result["reward_scale_history"] for run in runs]
    if not all(histories):
        return Curves(np.empty(0), np.empty((len(runs), 0, len(runs[0].task_names))))
    starts = sorted({time for history in histories for time, _ in history})
    first = max(history[0][0] for history in histories)
    end = max(run.result["timesteps"] for run in runs)
    steps = np.array([*(time for time in starts if first <= time < end), end], dtype=np.float64)
    values = np.array([[_latest(history, step) for step in steps] for history in histories], dtype=np.float64)
    return Curves(steps, values)


def reset_times(runs: Sequence[Run]) -> tuple[int, ...]:
    """Return the environment steps at which the first of the runs reset its networks.

    :param runs: seeds of one method, which reset at the same steps
    """
    history = runs[0].result["reward_scale_history"]
    return tuple(int(time) for time, _ in history[1:]) if runs[0].result.get("resets") else ()


def _logged(run: Run, key: str) -> tuple[Array, Array]:
    log = run.progress()
    columns = [f"{key}/{name}" for name in log_names(run.task_names)]
    values = log.reindex(columns=columns).to_numpy(dtype=np.float64)
    steps = log.reindex(columns=["time/total_timesteps"]).to_numpy(dtype=np.float64)[:, 0]
    written = ~np.isnan(values).all(axis=1) & ~np.isnan(steps)
    return steps[written], values[written]


def _latest(history: Sequence[tuple[int, Sequence[float]]], step: float) -> Sequence[float]:
    return [scale for time, scale in history if time <= step][-1]


def _on_common_steps(series: Sequence[tuple[Array, Array]]) -> Curves:
    """Bring the seeds' curves onto the same steps: their own where they agree and are few, else evenly spaced ones."""
    n_tasks = series[0][1].shape[1]
    if any(len(steps) == 0 for steps, _ in series):
        return Curves(np.empty(0), np.empty((len(series), 0, n_tasks)))
    own = series[0][0]
    if len(own) <= _POINTS and all(np.array_equal(steps, own) for steps, _ in series):
        return Curves(own, np.stack([values for _, values in series]))
    low, high = max(steps[0] for steps, _ in series), min(steps[-1] for steps, _ in series)
    common = np.linspace(low, max(low, high), _POINTS if high > low else 1)
    columns = [[_interpolated(common, steps, column) for column in values.T] for steps, values in series]
    return Curves(common, np.array(columns).transpose(0, 2, 1))


def _interpolated(at: Array, steps: Array, values: Array) -> Array:
    known = ~np.isnan(values)
    if not known.any():
        return np.full(len(at), np.nan)
    interpolated: Array = np.interp(at, steps[known], values[known], left=np.nan)
    return interpolated
