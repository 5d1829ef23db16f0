"""Tables of a report: success by task, by method, in the paper's forms; text in, text out, knows no HTML."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from sb3_ars.experiments.report.gather import Arm
from sb3_ars.metrics import Interval, bottom_k, estr, iqm, iqm_interval, mean_success

__all__ = [
    "MISSING",
    "PAPER",
    "Column",
    "Row",
    "Table",
    "bottom_k_table",
    "estr_table",
    "iqm_of",
    "mean_std",
    "mean_table",
    "paper_tasks_table",
    "pivot_table",
    "summary_table",
    "task_sets_table",
    "task_table",
]

Array = npt.NDArray[np.float64]

MISSING = "-"
"""What stands in a cell that no run fills."""

PAPER = "the paper's, full size"
"""Heading above the columns that hold the paper's numbers."""

_PAPER_TASKS = (  # the paper, appendix A
    "reach", "push", "pick-place", "door-open", "drawer-open", "drawer-close", "button-press-topdown",
    "peg-insert-side", "window-open", "window-close",
)  # fmt: skip
_TASK_COLUMNS = 10  # with more tasks, they stand in rows


@dataclass(frozen=True)
class Column:
    """A column's heading, the group of columns it belongs to, and whether it holds words rather than numbers."""

    name: str
    group: str = ""
    text: bool = False


@dataclass(frozen=True)
class Table:
    """A table as every format shows it.

    :param name: of its files
    :param title: what it shows, with units
    :param columns: the first names the rows
    :param rows: cells as text
    :param notes: sentences below
    """

    kind: ClassVar[str] = "table"
    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def to_csv(self) -> str:
        """Return the table as CSV, groups in front of the headings."""
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(self._headings())
        writer.writerows(self.rows)
        return file.getvalue()

    def to_markdown(self) -> str:
        """Return the table as Markdown, title above and notes below."""
        rules = ["---" if index == 0 or c.text else "---:" for index, c in enumerate(self.columns)]
        lines = [self._headings(), rules, *self.rows]
        table = "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
        )
        notes = "".join(f"\n{note}\n" for note in self.notes)
        return f"**{self.title}**\n\n{table}\n{notes}"

    def _headings(self) -> list[str]:
        return [f"{c.group}: {c.name}" if c.group else c.name for c in self.columns]


@dataclass(frozen=True)
class Row:
    """A method's place in a table.

    :param label: its name there
    :param arm: its runs; ``None`` where there are none
    :param column: second heading
    :param paper: what the paper prints of it
    :param n_expected: seeds that should be there, 0 where that is not known
    """

    label: str
    arm: Arm | None
    column: str = ""
    paper: Mapping[str, Any] = field(default_factory=dict)
    n_expected: int = 0

    @property
    def seeds(self) -> str:
        """How many seeds there are, and of how many."""
        n = len(self.arm.runs) if self.arm else 0
        return f"{n} of {self.n_expected}" if self.n_expected else str(n)

    @property
    def means(self) -> Array:
        """Mean success over tasks, ``(n_seeds,)`` in [0, 1]."""
        return np.array(
            [mean_success(seed) for seed in self.arm.scores()] if self.arm else [], dtype=np.float64
        )


def mean_std(values: Sequence[float] | Array) -> str:
    """Return mean and sample standard deviation (n - 1) in %, the mean alone for one value, a dash for none.

    :param values: one per seed, in [0, 1]
    """
    known = 100 * np.asarray(values, dtype=np.float64)
    if known.size == 0 or np.isnan(known).any():
        return MISSING
    return f"{known.mean():.1f}" + (f" ± {known.std(ddof=1):.1f}" if known.size > 1 else "")


def iqm_of(arm: Arm) -> Interval | None:
    """Return the interquartile mean over seeds and tasks with its 95 % interval, whose bounds are NaN for one seed.

    :param arm: whose tasks that report no success are left out
    :return: ``None`` if no task reports success
    """
    scores = arm.scores()
    scores = scores[:, ~np.isnan(scores).any(axis=0)]
    if scores.size == 0:
        return None
    return iqm_interval(scores) if len(scores) > 1 else Interval(iqm(scores), float("nan"), float("nan"))


def summary_table(name: str, title: str, rows: Sequence[Row], *notes: str) -> Table:
    """Return one row per method: seeds, success, IQM, length and duration."""
    columns = ["method", "seeds", "mean success (%)", "with sampled actions (%)", "IQM (%)", "95 % interval"]
    columns += ["env steps", "resets", "training time (min)"]
    return Table(name, title, _columns(columns), tuple(_summary_row(row) for row in rows), notes)


def task_table(name: str, title: str, rows: Sequence[Row]) -> Table:
    """Return success of every task: methods down and tasks across, or the other way where the tasks are many."""
    tasks = list(dict.fromkeys(task for row in rows if row.arm for task in row.arm.task_names))
    lines = [
        (row.label, row.seeds, *(_task_cell(row.arm, task) for task in tasks), mean_std(row.means))
        for row in rows
    ]
    if len(tasks) > _TASK_COLUMNS:
        across = list(zip(*lines, strict=True))
        heads = ["seeds", *tasks, "mean"]
        turned = tuple((head, *cells) for head, cells in zip(heads, across[1:], strict=True))
        printed = [row.paper.get("mean", MISSING) for row in rows]
        if any("mean" in row.paper for row in rows):
            turned += (("the paper's mean", *printed),)
        return Table(name, title, _columns(["task", *across[0]]), turned)
    return _with_paper(name, title, ["method", "seeds", *tasks, "mean"], lines, rows, {"mean": "mean"})


def paper_tasks_table(name: str, rows: Sequence[Row]) -> Table | None:
    """Return the paper's own per-task numbers as it prints them, ``None`` where it gives none."""
    printed = [row for row in rows if "tasks" in row.paper]
    if not printed:
        return None
    columns = [
        "method",
        *(_PAPER_TASKS if len(printed[0].paper["tasks"]) == len(_PAPER_TASKS) else ()),
        "mean",
    ]
    lines = tuple((row.label, *map(str, row.paper["tasks"]), str(row.paper["mean"])) for row in printed)
    return Table(
        name,
        "The paper's numbers for the same rows (%), 8 seeds of 20 million steps on MT10",
        tuple(Column(column, PAPER if index else "") for index, column in enumerate(columns)),
        lines,
        ("Its protocol: 10 episodes per task with different goals, horizon 500; success at any step.",),
    )


def bottom_k_table(name: str, title: str, rows: Sequence[Row], ks: Sequence[int] = ()) -> Table:
    """Return mean success of the k worst tasks of each seed.

    :param ks: the paper's; where there are fewer tasks, about the same shares of them, each once
    """
    n_tasks = max((len(row.arm.task_names) for row in rows if row.arm), default=max(ks, default=1))
    shares = [k / max(ks) for k in ks] or [0.2, 0.4, 0.6, 0.8, 1.0]
    each = [max(1, round(share * n_tasks)) for share in shares]
    fitting = list(dict.fromkeys(each))
    lines = [(row.label, row.seeds, *(_per_seed(row, _worst, k) for k in fitting)) for row in rows]
    headings = ["method", "seeds", *(f"k = {k}" for k in fitting)]
    flat = [_flat(row, "bottom_k") for row in rows]
    table = _with_paper(name, title, headings, lines, flat, {str(k): f"k = {k}" for k in ks})
    if not ks or n_tasks == max(ks):
        return table
    pairs = ", ".join(f"{k} → {own}" for k, own in zip(ks, each, strict=True))
    return replace(
        table, notes=(f"The paper's k of {max(ks)} tasks, and ours of {n_tasks}, rounded: {pairs}.",)
    )


def estr_table(name: str, title: str, rows: Sequence[Row], thresholds: Sequence[float]) -> Table:
    """Return the share of tasks whose success reaches each threshold, per seed."""
    headings = ["method", "seeds", *(f"from {100 * threshold:g} %" for threshold in thresholds)]
    lines = tuple((row.label, row.seeds, *(_per_seed(row, estr, d) for d in thresholds)) for row in rows)
    return Table(name, title, _columns(headings), lines)


def mean_table(name: str, title: str, rows: Sequence[Row]) -> Table:
    """Return mean success over tasks, a row per method."""
    lines = [(_full_label(row), row.seeds, mean_std(row.means)) for row in rows]
    return _with_paper(name, title, ["method", "seeds", "mean"], lines, rows, {"mean": "mean"})


def pivot_table(name: str, title: str, rows: Sequence[Row]) -> Table:
    """Return mean success over tasks, labels down and second headings across; seeds stand behind each number."""
    if not any(row.column for row in rows):
        return mean_table(name, title, rows)
    labels = list(dict.fromkeys(row.label for row in rows))
    columns = list(dict.fromkeys(row.column for row in rows))
    cells = {(row.label, row.column): row for row in rows}

    def line(label: str) -> tuple[str, ...]:
        found = [cells.get((label, column)) for column in columns]
        ours = [f"{mean_std(row.means)} ({row.seeds})" if row else MISSING for row in found]
        return (label, *ours, *(str(row.paper.get("mean", MISSING)) if row else MISSING for row in found))

    heads = [Column(""), *(Column(c) for c in columns), *(Column(c, PAPER) for c in columns)]
    notes = ("In brackets: the number of seeds.",)
    return Table(name, title, tuple(heads), tuple(line(label) for label in labels), notes)


def task_sets_table(name: str, title: str, rows: Sequence[Row], n_easy: int) -> Table:
    """Return mean success of each method's own best tasks, of the rest, and of all.

    :param n_easy: of ten tasks; the same share of another number
    """
    lines = []
    for row in rows:
        easy, difficult = _task_sets(row.arm.scores(), n_easy) if row.arm else (np.empty(0), np.empty(0))
        lines.append((row.label, row.seeds, mean_std(easy), mean_std(difficult), mean_std(row.means)))
    headings = ["method", "seeds", "easy", "difficult", "all"]
    paper = {"easy": "easy", "difficult": "difficult", "mean": "all"}
    return _with_paper(name, title, headings, lines, rows, paper)


def _task_sets(scores: Array, n_easy: int) -> tuple[Array, Array]:
    """Return each seed's mean success on the best tasks and on the rest; which they are, the mean over seeds says."""
    n_tasks = scores.shape[1]
    count = min(max(1, round(n_easy * n_tasks / 10)), n_tasks - 1) if n_tasks > 1 else 1
    order = np.argsort(-scores.mean(axis=0), kind="stable")
    rest = scores[:, order[count:]]
    return scores[:, order[:count]].mean(axis=1), rest.mean(axis=1) if rest.size else np.empty(0)


def _summary_row(row: Row) -> tuple[str, ...]:
    if row.arm is None:
        return (row.label, row.seeds, *[MISSING] * 7)
    found, results = iqm_of(row.arm), [run.result for run in row.arm.runs]
    low_high = (
        MISSING
        if found is None or np.isnan(found.low)
        else f"{100 * found.low:.1f} to {100 * found.high:.1f}"
    )
    minutes = np.array([result["training_seconds"] for result in results]) / 60
    return (
        row.label,
        row.seeds,
        mean_std(row.means),
        mean_std([mean_success(seed) for seed in row.arm.scores(sampled=True)]),
        MISSING if found is None else f"{100 * found.estimate:.1f}",
        low_high,
        _range([result["timesteps"] for result in results]),
        _range([result["resets"] for result in results]),
        f"{minutes.mean():.1f}" + (f" ± {minutes.std(ddof=1):.1f}" if len(minutes) > 1 else ""),
    )


def _task_cell(arm: Arm | None, task: str) -> str:
    if arm is None or task not in arm.task_names:
        return MISSING
    return mean_std(arm.scores()[:, arm.task_names.index(task)])


def _per_seed(row: Row, number: Callable[[Array, Any], float], argument: float) -> str:
    """Return a number of each seed's task successes, as mean and spread; a dash where a task reports no success."""
    if row.arm is None or np.isnan(row.arm.scores()).any():
        return MISSING
    return mean_std([number(seed, argument) for seed in row.arm.scores()])


def _worst(success: Array, k: int) -> float:
    return bottom_k(success, min(k, len(success)))


def _with_paper(
    name: str,
    title: str,
    headings: Sequence[str],
    lines: Sequence[tuple[str, ...]],
    rows: Sequence[Row],
    paper: Mapping[str, str],
) -> Table:
    """Return a table with what the paper prints in columns of their own behind ours, where it prints any of it."""
    keys = [key for key in paper if any(key in row.paper for row in rows)]
    columns = (*_columns(headings), *(Column(paper[key], PAPER) for key in keys))
    printed = [tuple(str(row.paper.get(key, MISSING)) for key in keys) for row in rows]
    return Table(
        name, title, columns, tuple((*ours, *theirs) for ours, theirs in zip(lines, printed, strict=True))
    )


def _flat(row: Row, key: str) -> Row:
    return Row(row.label, row.arm, paper={str(k): value for k, value in row.paper.get(key, {}).items()})


def _full_label(row: Row) -> str:
    return f"{row.column}, {row.label}" if row.column else row.label


def _columns(names: Sequence[str]) -> tuple[Column, ...]:
    return tuple(map(Column, names))


def _range(values: Sequence[int]) -> str:
    low, high = min(values), max(values)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"
