"""The paper's tables and figures, each kind in its form, of our runs; writes nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sb3_ars.errors import ConfigError
from sb3_ars.experiments.curves import Curves, common_source, success_curves
from sb3_ars.experiments.plots import curve_panels, plot_mean_success, short
from sb3_ars.experiments.report.blocks import Block, Listing, Section
from sb3_ars.experiments.report.drawings import (
    BAND,
    THRESHOLDS,
    bars_drawing,
    curves_drawing,
    estr_drawing,
    estr_numbers,
    q_drawing,
    scales_drawing,
    success_drawings,
)
from sb3_ars.experiments.report.figures import draw
from sb3_ars.experiments.report.gather import Arm, Gathered
from sb3_ars.experiments.report.tables import (
    Row,
    Table,
    bottom_k_table,
    mean_table,
    paper_tasks_table,
    pivot_table,
    task_sets_table,
    task_table,
)
from sb3_ars.experiments.report.words import noted, row_label, runs_of, seeds_text
from sb3_ars.experiments.scaling import load_scale
from sb3_ars.experiments.sweeps import Sweep, SweepRow

__all__ = ["sweep_section"]


def sweep_section(sweep: Sweep, scale: str, found: Gathered) -> Section:
    """Return the section of a table or figure of the paper: our runs of a scale in its form, its numbers beside."""
    name = f"{sweep.name}-{scale}"
    rows = [row for one in sweep.rows for row in _sweep_rows(one, scale, found)]
    arms = {row_label(row): row.arm for row in rows if row.arm is not None}
    blocks: list[Block] = [_sizes_differ(scale)] if any(row.paper for row in rows) and scale != "full" else []
    if any(row.arm is None for row in rows):
        absent = ", ".join(row_label(row) for row in rows if row.arm is None)
        blocks.append(Listing("No finished run of", (absent,), warning=True))
    blocks += _FORMS[sweep.kind](name, sweep, rows, arms)
    if "note" in sweep.options:
        blocks.append(str(sweep.options["note"]))
    blocks = [noted(block, arms.values()) if isinstance(block, Table) else block for block in blocks]
    return Section(name, f"{sweep.source}, “{sweep.title}”: our runs of scale {scale}", tuple(blocks))


def _sweep_rows(row: SweepRow, scale: str, found: Gathered) -> list[Row]:
    """Return the table's rows of a method: one for each arm of its preset, an empty one where there is none."""
    arms = [arm for arm in found.arms if (arm.scale, arm.preset) == (scale, row.preset)]
    expected = found.expected.get((scale, row.preset), 0)
    named: list[tuple[str, Arm | None]] = [(arm.named(row.label), arm) for arm in arms]
    named = named or [(row.label, None)]
    return [
        Row(label, arm, row.column or "", row.paper, found.n_expected(arm) if arm else expected)
        for label, arm in named
    ]


def _sizes_differ(scale: str) -> str:
    return (
        f"These runs are of scale “{scale}”, not of the paper's size; what that changed stands under “Scale {scale}”. "
        "The paper's numbers stand beside ours for orientation. They are of other tasks, networks or lengths, and the "
        "two cannot be compared."
    )


def _per_task(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    blocks: list[Block | None] = [task_table(name, "Success of each task (%), mean ± std over seeds", rows)]
    blocks.append(paper_tasks_table(f"{name}-paper", rows))
    return [block for block in [*blocks, *success_drawings(name, arms)] if block is not None]


def _bottom_k(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    title = "Success of the k worst tasks of each seed (%), mean ± std over seeds"
    return [bottom_k_table(name, title, rows, sweep.options.get("ks", ())), *success_drawings(name, arms)]


def _mean(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    return [
        pivot_table(name, f"{sweep.title}: success (%), mean ± std over seeds", rows),
        *success_drawings(name, arms),
    ]


def _task_sets(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    n_easy = int(sweep.options.get("n_easy", 7))
    table = task_sets_table(name, f"{sweep.title}: success (%), mean ± std over seeds", rows, n_easy)
    note = (
        f"Easy: each method's {n_easy} best of 10 tasks by their mean over seeds, or the same share of another number; "
        "difficult: the rest. With that reading the paper's Table 1 gives the row of ARS in its Table 4; of the other "
        "rows the paper prints no single tasks."
    )
    return [replace(table, notes=(note,)), *success_drawings(name, arms)]


def _curves(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    drawing = curves_drawing(name, arms, each_seed=bool(sweep.options.get("each_seed")))
    return [*drawing, mean_table(name, "Final success, mean over tasks (%), mean ± std over seeds", rows)]


def _task_curves(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    blocks: list[Block] = [
        mean_table(name, "Final success, mean over tasks (%), mean ± std over seeds", rows)
    ]
    filled = [row for row in rows if row.arm]
    if filled:
        source = common_source([run for row in filled if row.arm for run in row.arm.runs])
        panels: dict[str, dict[str, Curves]] = {}
        for row in filled:
            assert row.arm is not None
            curves = success_curves(row.arm.runs, source)
            mean = np.ma.masked_invalid(curves.values).mean(axis=2, keepdims=True).filled(np.nan)
            panels.setdefault(row.column, {})[row.label] = Curves(curves.steps, mean)
        resets = {row.label: row.arm.runs for row in filled if row.arm}
        blocks[:0] = [
            draw(
                f"{name}-curves",
                f"{sweep.title}: success over training",
                f"{BAND}. {seeds_text(arms.values())}",
                lambda width: curve_panels(panels, resets, source, width=width),
            )
        ]
    return blocks


def _task_bars(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    table = task_table(name, f"{sweep.title}: success (%), mean ± std over seeds", rows)
    return [*bars_drawing(name, arms), table]


def _bars(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    blocks: list[Block] = []
    if arms:
        title = f"{sweep.title}: final success, mean over tasks"
        caption = (
            f"Bar: mean over seeds; whisker: one standard deviation; dots: seeds. {seeds_text(arms.values())}"
        )
        blocks.append(
            draw(f"{name}-bars", title, caption, lambda width: plot_mean_success(runs_of(arms), width))
        )
    return [*blocks, mean_table(name, "Final success, mean over tasks (%), mean ± std over seeds", rows)]


def _q_values(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    printed: list[str] = sweep.options.get("tasks", [])
    wanted = [_stand_ins(rows).get(task, task) for task in printed]
    present = {task for arm in arms.values() for task in arm.task_names}
    blocks: list[Block] = []
    if wanted and not present & set(wanted):
        blocks.append(
            f"The paper shows {' and '.join(map(short, printed))}; these runs do not have them, so all tasks are shown."
        )
        wanted = []
    elif wanted != printed:
        pairs = (f"{ours} for {short(task)}" for task, ours in zip(printed, wanted, strict=True))
        blocks.append(f"At this scale other tasks stand for those the paper shows: {', '.join(pairs)}.")
    return [
        *blocks,
        *q_drawing(name, arms, wanted or None),
        mean_table(name, "Final success, mean over tasks (%)", rows),
    ]


def _stand_ins(rows: Sequence[Row]) -> Mapping[str, str]:
    """Return the task that takes the place of each of the paper's at the runs' scale, where the scale is known."""
    for scale in {row.arm.scale for row in rows if row.arm}:
        try:
            return load_scale(scale).stands_for
        except ConfigError:  # a scale of the user's own, known by its name alone
            return {}
    return {}


def _estr(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    thresholds = sweep.options.get("thresholds", THRESHOLDS)
    return [*estr_drawing(name, arms, thresholds), estr_numbers(name, rows, thresholds)]


def _scales(name: str, sweep: Sweep, rows: Sequence[Row], arms: Mapping[str, Arm]) -> list[Block]:
    return [*scales_drawing(name, arms), mean_table(name, "Final success, mean over tasks (%)", rows)]


_FORMS: dict[str, Callable[[str, Sweep, Sequence[Row], Mapping[str, Arm]], list[Block]]] = {
    "per_task": _per_task,
    "bottom_k": _bottom_k,
    "mean": _mean,
    "task_sets": _task_sets,
    "task_curves": _task_curves,
    "task_bars": _task_bars,
    "q_values": _q_values,
    "estr": _estr,
    "scales": _scales,
    "curves": _curves,
    "bars": _bars,
}
"""A sweep's kind -> what stands in its section."""
