"""Figures of a run, from its log; trains and evaluates nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.ticker import FuncFormatter, NullFormatter

from sb3_ars.algorithms.task_log import log_names

__all__ = ["plot_training"]

_PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
_LABELLED_TASKS = 10  # more labels than this cannot be told apart


def plot_training(
    progress: Path,
    task_names: Sequence[str],
    reward_scale_history: Sequence[tuple[int, Sequence[float]]],
    path: Path,
) -> None:
    """Draw success and c_i of every task over training, resets marked, into a PNG.

    :param progress: the run's ``progress.csv``
    :param task_names: in order
    :param reward_scale_history: ``(environment steps, c_i of every task)`` at each change; the first is the end of the
        random phase, the others are resets
    :param path: PNG to write
    """
    log = pd.read_csv(progress)
    steps = log["time/total_timesteps"].to_numpy()
    last = float(steps[-1]) if len(steps) else 1.0
    unit, divisor = ("million ", 1e6) if last >= 1e6 else ("thousand ", 1e3)
    figure, (success_axis, scale_axis) = plt.subplots(
        2, 1, figsize=(9, 7), sharex=True, layout="constrained", height_ratios=(3, 2)
    )
    colors = matplotlib.colormaps["tab10" if len(task_names) <= _LABELLED_TASKS else "turbo"]
    for task, (name, key) in enumerate(zip(task_names, log_names(task_names), strict=True)):
        color = colors(task if len(task_names) <= _LABELLED_TASKS else task / len(task_names))
        label = name if len(task_names) <= _LABELLED_TASKS else None
        if f"success/{key}" in log:
            success_axis.plot(steps / divisor, log[f"success/{key}"], color=color, label=label, lw=1.6)
        _draw_scale(scale_axis, reward_scale_history, task, last, divisor, color)
    _mark_resets((success_axis, scale_axis), reward_scale_history, divisor)
    success_axis.set(ylabel="success, latest training episodes", ylim=(-0.03, 1.03))
    success_axis.set_title("Success and reward scale of each task", loc="left")
    scale_axis.set(
        xlabel=f"environment steps, all tasks together ({unit.strip()})",
        ylabel="reward scale c_i",
        yscale="log",
    )
    scale_axis.set_xlim(0, last / divisor)
    scale_axis.yaxis.set_major_formatter(_PLAIN)
    scale_axis.yaxis.set_minor_formatter(_PLAIN if _decades(reward_scale_history) < 1 else NullFormatter())
    if len(task_names) <= _LABELLED_TASKS:
        figure.legend(*success_axis.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    for axis in (success_axis, scale_axis):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _draw_scale(
    axis: Any,
    history: Sequence[tuple[int, Sequence[float]]],
    task: int,
    last: float,
    divisor: float,
    color: Any,
) -> None:
    if not history:
        return
    times = np.array([time for time, _ in history] + [last]) / divisor
    values = [scale[task] for _, scale in history]
    axis.step(times, [*values, values[-1]], where="post", color=color, lw=1.6)


def _mark_resets(axes: Sequence[Any], history: Sequence[tuple[int, Sequence[float]]], divisor: float) -> None:
    for index, (time, _) in enumerate(history[1:]):
        for axis in axes:
            axis.axvline(time / divisor, color="black", lw=0.8, ls=":")
        axes[0].annotate(
            "reset" if index == 0 else "",
            (time / divisor, 0.0),
            xytext=(3, 2),
            textcoords="offset points",
            fontsize=8,
        )


def _decades(history: Sequence[tuple[int, Sequence[float]]]) -> float:
    """Return how many powers of ten the scales span."""
    values = [scale for _, scales in history for scale in scales] or [1.0]
    return float(np.log10(max(values) / min(values)))
