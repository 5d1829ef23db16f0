"""The figures of a report, each with its title and a caption that says how to read it; chooses no runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sb3_ars.experiments.curves import common_source
from sb3_ars.experiments.plots import (
    plot_curves,
    plot_estr,
    plot_intervals,
    plot_parts,
    plot_q_values,
    plot_scales,
    plot_task_curves,
    plot_task_success,
)
from sb3_ars.experiments.report.blocks import Block
from sb3_ars.experiments.report.figures import Drawing, draw
from sb3_ars.experiments.report.gather import Arm
from sb3_ars.experiments.report.tables import Column, Row, Table, estr_table, iqm_of
from sb3_ars.experiments.report.words import (
    by_tasks,
    numbers_of,
    protocol_text,
    resets_text,
    runs_of,
    seeds_text,
    source_text,
)
from sb3_ars.profiling import PARTS

__all__ = [
    "BAND",
    "FEW_SEEDS",
    "SHOWN",
    "THRESHOLDS",
    "bars_drawing",
    "curves_drawing",
    "estr_drawing",
    "estr_numbers",
    "intervals_drawing",
    "parts_blocks",
    "q_drawing",
    "scales_drawing",
    "success_drawings",
    "task_curves_drawing",
]

THRESHOLDS = (0.1, 0.3, 0.5, 0.7)
SHOWN = 12  # more methods than this cannot be told apart in one figure
BAND = "Line: mean over seeds; band: one standard deviation (n - 1) around it"
FEW_SEEDS = "With fewer than 5 seeds the interval is too narrow: a bootstrap knows no seed that was not run."


def success_drawings(name: str, arms: Mapping[str, Arm]) -> list[Block]:
    """Return the figures that go with a table of success: IQM with intervals, and success over training."""
    few = dict(list(arms.items())[:SHOWN])
    return [*intervals_drawing(name, arms), *curves_drawing(name, few)]


def curves_drawing(name: str, arms: Mapping[str, Arm], each_seed: bool = False) -> list[Block]:
    """Return mean success over training; nothing where no task reports success."""
    if not arms or not _reports_success(arms):
        return []
    source = common_source([run for arm in arms.values() for run in arm.runs])
    caption = "Every line is a seed." if each_seed else f"{BAND}."
    return [
        draw(
            f"{name}-curves",
            "Mean success over training",
            f"{caption} {seeds_text(arms.values())} {source_text(source, arms)} {resets_text(arms)}",
            lambda width: plot_curves(runs_of(arms), source, each_seed, width, numbers_of(arms)),
        )
    ]


def task_curves_drawing(name: str, arms: Mapping[str, Arm]) -> list[Block]:
    """Return each task's success over training, a figure for each set of tasks that report success."""

    def drawing(name: str, tasks: str, arms: Mapping[str, Arm]) -> Drawing:
        source = common_source([run for arm in arms.values() for run in arm.runs])
        return draw(
            name,
            _titled("Success of each task over training", tasks),
            f"{BAND}. {seeds_text(arms.values())} {source_text(source, arms)} {resets_text(arms)}",
            lambda width: plot_task_curves(runs_of(arms), source, width, numbers_of(arms)),
        )

    return [
        drawing(f"{name}-task-curves{suffix}", tasks, same)
        for suffix, tasks, same in by_tasks(arms)
        if _reports_success(same)
    ]


def bars_drawing(name: str, arms: Mapping[str, Arm]) -> list[Block]:
    """Return each task's final success, a figure for each set of tasks that report success."""

    def drawing(name: str, tasks: str, arms: Mapping[str, Arm]) -> Drawing:
        return draw(
            name,
            _titled("Final success of each task", tasks),
            f"Mean over seeds; small dots: seeds. {seeds_text(arms.values())} {protocol_text(arms.values())}",
            lambda width: plot_task_success(runs_of(arms), width, numbers_of(arms)),
        )

    return [
        drawing(f"{name}-task-bars{suffix}", tasks, same)
        for suffix, tasks, same in by_tasks(arms)
        if _reports_success(same)
    ]


def estr_drawing(name: str, arms: Mapping[str, Arm], thresholds: Sequence[float]) -> list[Block]:
    """Return the share of tasks solved over the threshold, of the methods whose tasks all report success."""
    known = {label: arm for label, arm in arms.items() if not np.isnan(arm.scores()).any()}
    if not known:
        return []
    caption = (
        "Share of tasks whose final success is at or above the threshold (ESTR, Eq. 8 of the paper), mean over seeds; "
        f"the points are the paper's thresholds. {seeds_text(known.values())} {protocol_text(known.values())}"
    )
    title = "Share of tasks solved, by what counts as solved"
    return [
        draw(
            f"{name}-estr-curve",
            title,
            caption,
            lambda width: plot_estr(runs_of(known), thresholds, width, numbers_of(known)),
        )
    ]


def estr_numbers(name: str, rows: Sequence[Row], thresholds: Sequence[float]) -> Table:
    """Return the table of what the figure of shares shows."""
    title = "Share of tasks at or above a success threshold (%), mean ± std over seeds"
    return estr_table(name, title, rows, thresholds)


def intervals_drawing(name: str, arms: Mapping[str, Arm]) -> list[Block]:
    """Return the interquartile means with their intervals."""
    intervals = {label: found for label, arm in arms.items() if (found := iqm_of(arm))}
    if not intervals:
        return []
    caption = (
        "Point: mean of the middle half of all scores, seeds and tasks pooled. Bar: 95 % interval of a bootstrap that "
        f"resamples seeds within each task; one seed has none. {FEW_SEEDS} "
        f"{seeds_text(arms.values())} {protocol_text(arms.values())}"
    )
    title = "Interquartile mean of final success, with its uncertainty"
    return [
        draw(
            f"{name}-iqm",
            title,
            caption,
            lambda width: plot_intervals(intervals, "IQM of final success (%)", width),
        )
    ]


def scales_drawing(name: str, arms: Mapping[str, Arm]) -> list[Block]:
    """Return c_i over training, a figure for each set of tasks, or a sentence where no run scales rewards."""
    scaled = {label: arm for label, arm in arms.items() if _is_scaled(arm)}
    others = [label for label in arms if label not in scaled]
    if not scaled:
        return ["No reward scales are shown: c_i stays 1 in all of these runs."] if arms else []

    def drawing(name: str, tasks: str, arms: Mapping[str, Arm]) -> Drawing:
        caption = (
            "Line: geometric mean over seeds; band: lowest to highest seed. c_i multiplies the task's reward in the "
            "critic's target; it is set after the random phase and anew when the networks are reset, or would be. "
            f"{seeds_text(arms.values())} "
            + (f"Not shown, since c_i stays 1: {', '.join(others)}." if others else "")
        )
        title = _titled("Reward scale c_i of each task over training", tasks)
        return draw(name, title, caption, lambda width: plot_scales(runs_of(arms), width))

    return [drawing(f"{name}-scales{suffix}", tasks, same) for suffix, tasks, same in by_tasks(scaled)]


def q_drawing(name: str, arms: Mapping[str, Arm], shown: Sequence[str] | None = None) -> list[Block]:
    """Return the critics' values over training, of the methods that log them, a figure for each set of tasks."""
    known = {label: arm for label, arm in arms.items() if _logs(arm, "q_value")}

    def drawing(name: str, tasks: str, arms: Mapping[str, Arm]) -> Drawing:
        caption = (
            f"{BAND}. Mean value the critics give to the task's sampled rows, in reward scaled by c_i; each method has "
            f"an axis of its own. {seeds_text(arms.values())}"
        )
        title = _titled("Critic values of each task over training", tasks)
        return draw(name, title, caption, lambda width: plot_q_values(runs_of(arms), shown, width))

    return [
        drawing(f"{name}-q{suffix}", tasks, same)
        for suffix, tasks, same in by_tasks(known)
        if shown is None or set(shown) & set(next(iter(same.values())).task_names)
    ]


def parts_blocks(name: str, arms: Mapping[str, Arm]) -> list[Block]:
    """Return where time went, for the methods of which runs were profiled."""
    seconds = {}
    for label, arm in arms.items():
        profiled = [run.result["seconds_by_part"] for run in arm.runs if run.result.get("seconds_by_part")]
        if profiled:
            mean = {part: float(np.mean([one.get(part, 0.0) for one in profiled])) for part in PARTS}
            seconds[label] = {part: value for part, value in mean.items() if value > 0}
    if not seconds:
        return []
    parts = [part for part in PARTS if any(part in by_part for by_part in seconds.values())]
    caption = (
        "Of the runs that were profiled, mean over seeds. "
        + "; ".join(f"{p}: {PARTS[p]}" for p in parts)
        + "."
    )
    drawing = draw(
        f"{name}-parts", "Where training time went", caption, lambda width: plot_parts(seconds, width)
    )
    rows = tuple(
        (label, *(f"{by_part.get(part, 0.0):,.1f}" for part in parts), f"{sum(by_part.values()):,.1f}")
        for label, by_part in seconds.items()
    )
    columns = tuple(map(Column, ("method", *parts, "all")))
    return [drawing, Table(f"{name}-seconds", "Training time by part (seconds)", columns, rows)]


def _titled(title: str, tasks: str) -> str:
    return f"{title} ({tasks})" if tasks else title


def _reports_success(arms: Mapping[str, Arm]) -> bool:
    return any(not np.isnan(arm.scores()).all() for arm in arms.values())


def _is_scaled(arm: Arm) -> bool:
    return any(c != 1 for run in arm.runs for _, scales in run.result["reward_scale_history"] for c in scales)


def _logs(arm: Arm, key: str) -> bool:
    return all(
        any(str(column).startswith(f"{key}/") for column in run.progress().columns) for run in arm.runs
    )
