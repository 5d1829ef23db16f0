"""Figures of runs, for reports, run folders and notebooks; trains and evaluates nothing, writes no page.

Every ``plot_`` function of runs returns a matplotlib ``Figure`` that no pyplot state holds on to: in a notebook with
``%matplotlib inline`` it shows as the last expression of a cell, elsewhere ``figure.savefig(path)`` writes it.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
import pandas as pd
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, NullFormatter

from sb3_ars.algorithms.task_log import log_names
from sb3_ars.errors import ConfigError
from sb3_ars.experiments.curves import (
    Curves,
    Source,
    common_source,
    logged_curves,
    reset_times,
    scale_curves,
    success_curves,
)
from sb3_ars.experiments.run_folder import Run
from sb3_ars.metrics import Interval, estr

__all__ = [
    "GRID",
    "INK",
    "LABELLED_TASKS",
    "MUTED",
    "PALETTE",
    "curve_panels",
    "plot_curves",
    "plot_estr",
    "plot_intervals",
    "plot_mean_success",
    "plot_parts",
    "plot_q_values",
    "plot_scales",
    "plot_task_curves",
    "plot_task_success",
    "plot_training",
    "series_style",
    "style",
]

Array = npt.NDArray[np.float64]
Arms = Mapping[str, Sequence[Run]]
"""Label -> the runs of one method, a seed each."""

INK, MUTED, GRID = "#1c2127", "#5b6570", "#d5dae0"
"""Text and axes; what stands back; grid lines."""

PALETTE = (
    "#0b6bb5",
    "#d4540a",
    "#0a8a66",
    "#b23f8a",
    "#8f6c0c",
    "#1596ad",
    "#c5303c",
    "#7a57b5",
    "#6b8e23",
    "#86573f",
)
"""Series colours. Each has a contrast of at least 3 to white; the first five differ for every kind of colour vision."""

LABELLED_TASKS = 10
"""More tasks than this cannot be told apart in one plot: the others are drawn grey."""

_EXTREMES = 5  # of more tasks than that, so many are labelled
_DASHES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (6, 1.5, 1, 1.5)))
_BARS = 60  # more bars than this become dots
_STEPS = "environment steps, all tasks together"
_WIDE = 9.0
_PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
_RC: Any = {
    "figure.facecolor": "white",
    "axes.facecolor": "none",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.labelsize": 9.5,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=PALETTE),
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "lines.linewidth": 1.7,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    "font.size": 9.5,
    "svg.fonttype": "none",
}


@contextmanager
def style() -> Iterator[None]:
    """Give matplotlib, inside the context, the look of the reports: colours, grid, sizes."""
    with matplotlib.rc_context(_RC):
        yield


def series_style(index: int) -> dict[str, Any]:
    """Return colour and dashes of a series: no two of the first 40 look alike, and neighbours differ in both.

    :param index: of the series
    """
    return {
        "color": PALETTE[index % len(PALETTE)],
        "linestyle": _DASHES[(index + index // 20) % len(_DASHES)],
    }


def plot_curves(
    arms: Arms,
    source: Source | None = None,
    each_seed: bool = False,
    width: float = _WIDE,
    numbers: Mapping[str, int] | None = None,
) -> Figure:
    """Draw mean success over training: the mean over seeds, and one standard deviation around it as a band.

    :param arms: label -> runs of one method
    :param source: "evaluation" or "training"; ``None`` is evaluations where all runs have them
    :param each_seed: draw every seed's curve instead of mean and band
    :param width: in inches
    :param numbers: label -> index of its :func:`series_style`; ``None`` counts them
    """
    source = source or common_source(_all_runs(arms))
    panel = {}
    for label, runs in arms.items():
        curves = success_curves(runs, source)
        panel[label] = Curves(curves.steps, _mean(curves.values, axis=2)[..., None])
    return curve_panels(
        {"": panel}, arms, source, each_seed=each_seed, width=width, height=3.4, numbers=numbers
    )


def plot_task_curves(
    arms: Arms, source: Source | None = None, width: float = _WIDE, numbers: Mapping[str, int] | None = None
) -> Figure:
    """Draw each task's success over training in a panel of its own.

    :param arms: label -> runs of one method, all on the same tasks
    :param source: "evaluation" or "training"; ``None`` is evaluations where all runs have them
    :param width: in inches
    :param numbers: label -> index of its :func:`series_style`; ``None`` counts them
    """
    source = source or common_source(_all_runs(arms))
    found = {label: success_curves(runs, source) for label, runs in arms.items()}
    names = _task_names(arms)
    panels = {
        short(name): {label: Curves(c.steps, c.values[..., [task]]) for label, c in found.items()}
        for task, name in enumerate(names)
    }
    return curve_panels(panels, arms, source, width=width, height=1.75, numbers=numbers)


def curve_panels(
    panels: Mapping[str, Mapping[str, Curves]],
    arms: Arms,
    source: Source,
    each_seed: bool = False,
    width: float = _WIDE,
    height: float = 2.0,
    numbers: Mapping[str, int] | None = None,
) -> Figure:
    """Draw success over training, a panel for each title, a curve for each label.

    :param panels: title -> label -> success in [0, 1], ``(n_seeds, n_points, 1)``
    :param arms: label -> runs, whose resets are marked
    :param source: of the success
    :param each_seed: draw every seed's curve instead of mean and band
    :param width: in inches
    :param height: of a panel, in inches
    :param numbers: label -> index of its :func:`series_style`; ``None`` counts them
    """
    numbers = numbers or _counted(label for panel in panels.values() for label in panel)
    with style():
        figure, axes = _panels(list(panels), width, height)
        labels = list(dict.fromkeys(label for panel in panels.values() for label in panel))
        last = max((c.steps[-1] for p in panels.values() for c in p.values() if len(c.steps)), default=1.0)
        unit, divisor = _step_unit(last)
        for axis, panel in zip(axes, panels.values(), strict=True):
            for label, curves in panel.items():
                _draw_band(axis, curves, divisor, each_seed, series_style(numbers[label]))
            axis.set(ylim=(-3, 103), xlim=(0, last / divisor))
        marks = _mark_resets(axes, [reset_times(arms[label]) for label in labels if label in arms], divisor)
        where = "evaluations" if source == "evaluation" else "latest training episodes"
        _name_axes(figure, axes, f"{_STEPS}{unit}", f"success (%)\n{where}")
        handles = [Line2D([], [], **series_style(index)) for index in map(numbers.__getitem__, labels)]
        _legend(figure, [*handles, *marks], [*labels, *(["reset"] if marks else [])], width)
    return figure


def plot_scales(arms: Arms, width: float = _WIDE) -> Figure:
    """Draw c_i of every task over training on a log scale: the geometric mean over seeds, and their range as a band.

    :param arms: label -> runs of one method, all on the same tasks
    :param width: in inches
    """
    found = {label: scale_curves(runs) for label, runs in arms.items()}
    return _task_panels(found, arms, "reward scale c_i", width, log=True)


def plot_q_values(arms: Arms, tasks: Sequence[str] | None = None, width: float = _WIDE) -> Figure:
    """Draw the critics' mean value of every task over training: the mean over seeds, one standard deviation as a band.

    :param arms: label -> runs of one method, all on the same tasks
    :param tasks: to show; ``None`` shows all
    :param width: in inches
    """
    found = {label: logged_curves(runs, "q_value") for label, runs in arms.items()}
    return _task_panels(found, arms, "mean critic value\n(scaled reward)", width, shown=tasks)


def plot_task_success(arms: Arms, width: float = _WIDE, numbers: Mapping[str, int] | None = None) -> Figure:
    """Draw each task's final success: bars for the mean over seeds (dots where they are many), a small dot per seed.

    :param arms: label -> runs of one method, all on the same tasks
    :param width: in inches
    :param numbers: label -> index of its :func:`series_style`; ``None`` counts them
    """
    numbers = numbers or _counted(arms)
    names = [short(name) for name in _task_names(arms)]
    scores = {label: 100 * _scores(runs) for label, runs in arms.items()}
    bars = len(names) * len(arms) <= _BARS
    pitch = max(0.3, 0.13 * len(arms) + 0.1) if bars else 0.22
    with style():
        figure = Figure(figsize=(width, 1.0 + pitch * len(names)), layout="constrained")
        axis = figure.subplots()
        thickness = 0.8 / len(arms)
        rows = np.arange(len(names), dtype=np.float64)
        handles: list[Any] = []
        for place, (label, values) in enumerate(scores.items()):
            color, mean = series_style(numbers[label])["color"], _mean(values, axis=0)
            if bars:
                handles.append(Patch(color=color))
                at = rows - 0.4 + thickness * (place + 0.5)
                axis.barh(at, mean, height=0.88 * thickness, color=color)
                for seed in values if len(values) > 1 else ():
                    axis.plot(seed, at, "o", ms=2.6, mfc=GRID, mec=INK, mew=0.6, clip_on=False)
            else:
                marker = "oDs^v"[numbers[label] % 5]
                handles += axis.plot(mean, rows, marker, ms=4.5, color=color, alpha=0.85, clip_on=False)
        axis.set(xlim=(0, 100), ylim=(len(names) - 0.4, -0.6), xlabel="final success (%)")
        axis.set_yticks(rows, names)
        axis.grid(bars is False, axis="y")
        _legend(figure, handles, list(scores), width)
    return figure


def plot_mean_success(arms: Arms, width: float = _WIDE) -> Figure:
    """Draw final success averaged over tasks: a bar for the mean over seeds, one standard deviation, a dot per seed.

    :param arms: label -> runs of one method
    :param width: in inches
    """
    with style():
        figure, axis = _one_axis(width, 0.9 + _rows_height(list(arms), width))
        for row, runs in enumerate(arms.values()):
            seeds = 100 * _mean(_scores(runs), axis=1)
            error = seeds.std(ddof=1) if len(seeds) > 1 else None
            axis.barh(
                row, _mean(seeds, axis=0), height=0.62, color=PALETTE[0], xerr=error,
                error_kw={"ecolor": INK, "elinewidth": 1.1, "capsize": 3},
            )  # fmt: skip
            if len(seeds) > 1:
                axis.plot(
                    seeds, np.full(len(seeds), row), "o", ms=3, mfc=GRID, mec=INK, mew=0.6, clip_on=False
                )
        axis.set(xlim=(0, 100), xlabel="final success, mean over tasks (%)")
        _name_rows(axis, list(arms), width)
    return figure


def plot_estr(
    arms: Arms, thresholds: Sequence[float], width: float = _WIDE, numbers: Mapping[str, int] | None = None
) -> Figure:
    """Draw the share of tasks solved over the threshold from which a task counts as solved (Eq. 8), mean over seeds.

    :param arms: label -> runs of one method, whose tasks all report success
    :param thresholds: marked by a point, in [0, 1]
    :param width: in inches
    :param numbers: label -> index of its :func:`series_style`; ``None`` counts them
    """
    numbers = numbers or _counted(arms)
    grid = np.round(np.linspace(0, 1, 101), 10)
    with style():
        figure, axis = _one_axis(width, 3.4)
        for label, runs in arms.items():
            scores = _scores(runs)
            shares = [100 * np.mean([estr(seed, threshold) for seed in scores]) for threshold in grid]
            look = series_style(numbers[label])
            # a share holds from just above the grid's last threshold up to its own
            axis.step(100 * grid, shares, where="pre", **look)
            marked = [100 * np.mean([estr(seed, threshold) for seed in scores]) for threshold in thresholds]
            axis.plot(100 * np.asarray(thresholds), marked, "o", ms=5, color=look["color"], clip_on=False)
        axis.set(
            xlim=(0, 100), ylim=(-3, 103), xlabel="threshold: success from which a task counts (%)",
            ylabel="tasks at or above it (%)",
        )  # fmt: skip
        handles = [Line2D([], [], **series_style(numbers[label])) for label in arms]
        _legend(figure, handles, list(arms), width)
    return figure


def plot_intervals(intervals: Mapping[str, Interval], xlabel: str, width: float = _WIDE) -> Figure:
    """Draw point estimates with their confidence intervals, one row each.

    :param intervals: label -> estimate and bounds, in [0, 1]; NaN bounds where there is no interval
    :param xlabel: what is estimated
    :param width: in inches
    """
    with style():
        figure, axis = _one_axis(width, 0.9 + _rows_height(list(intervals), width))
        for row, interval in enumerate(intervals.values()):
            estimate, low, high = (100 * value for value in interval)
            axis.plot([low, high], [row, row], color=PALETTE[0], lw=7, alpha=0.35, solid_capstyle="butt")
            axis.plot([estimate], [row], "o", ms=6, color=PALETTE[0], clip_on=False)
        axis.set(xlim=(-2, 102), xlabel=xlabel)
        _name_rows(axis, list(intervals), width)
    return figure


def plot_parts(seconds: Mapping[str, Mapping[str, float]], width: float = _WIDE) -> Figure:
    """Draw where training time went, a bar of parts for each method.

    :param seconds: label -> part -> seconds
    :param width: in inches
    """
    parts = list(dict.fromkeys(part for by_part in seconds.values() for part in by_part))
    with style():
        figure, axis = _one_axis(width, 1.5 + _rows_height(list(seconds), width))
        unit, divisor = (
            ("minutes", 60.0) if max(sum(s.values()) for s in seconds.values()) > 600 else ("seconds", 1.0)
        )
        for row, by_part in enumerate(seconds.values()):
            left = 0.0
            for index, part in enumerate(parts):
                value = by_part.get(part, 0.0) / divisor
                axis.barh(row, value, left=left, height=0.62, color=PALETTE[index], edgecolor=GRID, lw=0.5)
                left += value
        axis.set_xlabel(f"training time ({unit})")
        _name_rows(axis, list(seconds), width)
        _legend(figure, [Patch(color=PALETTE[index]) for index in range(len(parts))], parts, width)
    return figure


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
    steps = log["time/total_timesteps"].to_numpy(dtype=np.float64)
    last = float(steps[-1]) if len(steps) else 1.0
    unit, divisor = _step_unit(last)
    success = log.reindex(columns=[f"success/{key}" for key in log_names(task_names)]).to_numpy(
        dtype=np.float64
    )
    times = np.array([time for time, _ in reward_scale_history] + [last])
    scales = np.array([c for _, c in reward_scale_history] + [c for _, c in reward_scale_history[-1:]])
    looks = _task_looks(task_names, scales[-1] if len(scales) else np.ones(len(task_names)))
    with style():
        figure = Figure(figsize=(9, 7), layout="constrained")
        axes = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for task, look in enumerate(looks):
            axes[0].plot(steps / divisor, 100 * success[:, task], **look)
            if len(scales):
                axes[1].step(times / divisor, scales[:, task], where="post", **look)
        marks = _mark_resets(axes, [tuple(int(time) for time, _ in reward_scale_history[1:])], divisor)
        axes[0].set(ylabel="success (%), latest training episodes", ylim=(-3, 103))
        axes[1].set(xlabel=f"{_STEPS}{unit}", ylabel="reward scale c_i", xlim=(0, last / divisor))
        _log_axis(axes[1], scales)
        _task_legend(figure, looks, marks, 9)
        figure.savefig(path, dpi=130)


def short(name: str) -> str:
    """Return a task's name without Meta-World's version, for a figure."""
    return name.removesuffix("-v3")


def _task_panels(
    found: Mapping[str, Curves],
    arms: Arms,
    ylabel: str,
    width: float,
    log: bool = False,
    shown: Sequence[str] | None = None,
) -> Figure:
    """Draw a panel for each method, with a curve for each task."""
    names = _task_names(arms)
    last = max((curves.steps[-1] for curves in found.values() if len(curves.steps)), default=1.0)
    unit, divisor = _step_unit(last)
    tasks = [task for task, name in enumerate(names) if shown is None or name in shown]
    ends = [_mean(curves.values[:, -1], axis=0) for curves in found.values() if len(curves.steps)]
    ranking = np.nan_to_num(np.max(ends, axis=0)[tasks]) if ends else np.ones(len(tasks))
    looks = _task_looks([names[task] for task in tasks], ranking)
    with style():
        figure, axes = _panels(list(found) if len(found) > 1 else [""], width, 2.6, sharey=log)
        marks: list[Any] = []
        for axis, (label, curves) in zip(axes, found.items(), strict=True):
            for task, look in zip(tasks, looks, strict=True):
                one = Curves(curves.steps, curves.values[..., [task]])
                (_draw_steps if log else _draw_raw_band)(axis, one, divisor, look)
            axis.set_xlim(0, last / divisor)
            if log:
                _log_axis(axis, np.concatenate([curves.values.ravel() for curves in found.values()]))
            marks = _mark_resets([axis], [reset_times(arms[label])], divisor) or marks
        _name_axes(figure, axes, f"{_STEPS}{unit}", ylabel)
        _task_legend(figure, looks, marks, width)
    return figure


def _task_looks(names: Sequence[str], ranking: Array) -> list[dict[str, Any]]:
    """Return how each task is drawn: labelled if they are few, else those that rank highest, and the others grey."""
    if len(names) <= LABELLED_TASKS:
        return [{**series_style(task), "label": short(name)} for task, name in enumerate(names)]
    first = list(np.argsort(-ranking, kind="stable")[:_EXTREMES])
    grey = {"color": MUTED, "linewidth": 0.7, "alpha": 0.45}
    return [
        {**series_style(first.index(task)), "label": short(name), "zorder": 3} if task in first else grey
        for task, name in enumerate(names)
    ]


def _task_legend(figure: Figure, looks: Sequence[dict[str, Any]], marks: list[Any], width: float) -> None:
    handles = [Line2D([], [], **look) for look in looks if "label" in look]
    labels = [look["label"] for look in looks if "label" in look]
    if len(labels) < len(looks):
        handles.append(Line2D([], [], color=MUTED, linewidth=0.7, alpha=0.45))
        labels.append(f"the other {len(looks) - len(labels)}")
    _legend(figure, [*handles, *marks], [*labels, *(["reset"] if marks else [])], width)


def _draw_band(axis: Axes, curves: Curves, divisor: float, each_seed: bool, look: dict[str, Any]) -> None:
    """Draw success in %, one task: mean and standard deviation over seeds, or every seed."""
    values = 100 * curves.values[..., 0]
    if each_seed:
        for seed in values:
            axis.plot(curves.steps / divisor, seed, **{**look, "linewidth": 1.1, "alpha": 0.8})
    else:
        _draw_raw_band(axis, Curves(curves.steps, values[..., None]), divisor, look, (0, 100))


def _draw_raw_band(
    axis: Axes,
    curves: Curves,
    divisor: float,
    look: dict[str, Any],
    limits: tuple[float, float] = (-np.inf, np.inf),
) -> None:
    values = curves.values[..., 0]
    mean = _mean(values, axis=0)
    single: dict[str, Any] = {"marker": "o", "ms": 4} if len(mean) == 1 else {}  # a line needs two points
    axis.plot(curves.steps / divisor, mean, **look, **single)
    if len(values) > 1:
        spread = np.ma.masked_invalid(values).std(axis=0, ddof=1).filled(np.nan)
        low, high = np.clip([mean - spread, mean + spread], *limits)
        axis.fill_between(curves.steps / divisor, low, high, color=look["color"], alpha=0.16, lw=0)


def _draw_steps(axis: Axes, curves: Curves, divisor: float, look: dict[str, Any]) -> None:
    values = curves.values[..., 0]
    if values.size == 0:
        return
    middle = np.exp(np.log(values).mean(axis=0))
    axis.step(curves.steps / divisor, middle, where="post", **look)
    if len(values) > 1:
        axis.fill_between(
            curves.steps / divisor, values.min(axis=0), values.max(axis=0), step="post",
            color=look["color"], alpha=0.16, lw=0,
        )  # fmt: skip


def _mark_resets(axes: Sequence[Axes], times: Sequence[tuple[int, ...]], divisor: float) -> list[Any]:
    """Draw a line at every reset; return a legend's handles for it, none where nothing was reset."""
    every = sorted({time for one in times for time in one})
    for axis in axes:
        for time in every:
            axis.axvline(time / divisor, color=MUTED, lw=1.0, ls=(0, (1, 2)), zorder=1)
    return [Line2D([], [], color=MUTED, lw=1.0, ls=(0, (1, 2)))] if every else []


def _panels(
    titles: Sequence[str], width: float, height: float, sharey: bool = True
) -> tuple[Figure, list[Axes]]:
    """Return a figure with an axis for each title, in as many columns as fit."""
    n_columns = min(len(titles), max(1, int(width / 2.0)), 4)
    if len(titles) == 4:
        n_columns = min(n_columns, 2 if width < _WIDE else 4)
    n_rows = -(-len(titles) // n_columns)
    figure = Figure(figsize=(width, height * n_rows + 0.9), layout="constrained")
    grid = figure.subplots(n_rows, n_columns, sharex=True, sharey=sharey, squeeze=False)
    axes = list(grid.ravel())
    for axis in axes[len(titles) :]:
        axis.remove()
    for index, (axis, title) in enumerate(zip(axes, titles, strict=False)):
        axis.set_title(textwrap.fill(title, int(11 * width / n_columns)))
        axis.tick_params(labelbottom=index + n_columns >= len(titles))
    return figure, axes[: len(titles)]


def _one_axis(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def _name_axes(figure: Figure, axes: Sequence[Axes], xlabel: str, ylabel: str) -> None:
    if len(axes) == 1:
        axes[0].set(xlabel=xlabel, ylabel=ylabel)
    else:
        figure.supxlabel(xlabel, fontsize=9.5)
        figure.supylabel(ylabel, fontsize=9.5)


def _row_labels(labels: Sequence[str], width: float) -> list[str]:
    return [textwrap.fill(label, max(20, int(4.5 * width))) for label in labels]


def _rows_height(labels: Sequence[str], width: float) -> float:
    """Return the height in inches of rows that the labels fit beside."""
    lines = max((label.count("\n") + 1 for label in _row_labels(labels, width)), default=1)
    return len(labels) * max(0.32, 0.1 + 0.15 * lines)


def _name_rows(axis: Axes, labels: Sequence[str], width: float) -> None:
    axis.set_yticks(range(len(labels)), _row_labels(labels, width))
    axis.set_ylim(len(labels) - 0.4, -0.6)
    axis.grid(False, axis="y")


def _legend(figure: Figure, handles: Sequence[Any], labels: Sequence[str], width: float) -> None:
    """Put the legend above the axes, outside of them, in as many columns as fit."""
    if len(labels) < 2:
        return
    wrapped = [textwrap.fill(label, int(12 * width)) for label in labels]
    longest = max(len(line) for label in wrapped for line in label.splitlines())
    n_columns = min(len(labels), max(1, int(width / (0.55 + 0.075 * longest))))
    figure.legend(
        handles, wrapped, loc="outside upper left", ncols=n_columns, columnspacing=1.4, handlelength=2.2
    )


def _log_axis(axis: Axes, values: Array) -> None:
    axis.set_yscale("log")
    decades = np.log10(values.max() / values.min()) if values.size else 0.0
    axis.yaxis.set_major_formatter(_PLAIN)
    axis.yaxis.set_minor_formatter(_PLAIN if decades < 1 else NullFormatter())


def _step_unit(last: float) -> tuple[str, float]:
    """Return how the axis names its unit, and what to divide by."""
    return (" (million)", 1e6) if last >= 1e6 else (" (thousand)", 1e3)


def _counted(labels: Iterable[str]) -> dict[str, int]:
    return {label: index for index, label in enumerate(dict.fromkeys(labels))}


def _all_runs(arms: Arms) -> list[Run]:
    return [run for runs in arms.values() for run in runs]


def _task_names(arms: Arms) -> tuple[str, ...]:
    """Return the tasks that all of the runs have."""
    names = list(dict.fromkeys(run.task_names for run in _all_runs(arms)))
    if len(names) > 1:
        raise ConfigError(
            f"Runs of other tasks cannot stand in one figure of tasks: {'; '.join(map(', '.join, names))}. Draw a "
            "figure for each."
        )
    return names[0]


def _scores(runs: Sequence[Run]) -> Array:
    return np.array([run.success() for run in runs])


def _mean(values: Array, axis: int) -> Any:
    """Return the mean of what is no NaN; NaN where nothing is."""
    return np.ma.filled(np.ma.masked_invalid(values).mean(axis=axis), np.nan)
