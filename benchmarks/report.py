"""Writes what the documents say of speed and memory, from the benchmarks' JSON files alone; measures nothing.

    python -m benchmarks.report

Tables stand in the pages between ``<!-- begin: NAME -->`` and ``<!-- end: NAME -->``; a test compares them with the
files.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import memory
from benchmarks.harness import RESULTS, ROOT, markdown_table

PAGES = (ROOT / "docs" / "performance.md",)
CHART = "performance.png"
UNMEASURED = "Not measured yet."
_BLOCK = re.compile(r"(<!-- begin: (?P<name>[\w-]+) -->\n).*?(<!-- end: (?P=name) -->)", re.DOTALL)


@dataclass(frozen=True)
class Row:
    """One bar: a contestant, what was measured, and how it compares with the panel's baseline."""

    label: str
    value: str
    ratio: float
    low: float
    high: float
    ours: bool


@dataclass(frozen=True)
class Panel:
    """One comparison; ``ratio`` says what the rows' ratios are, such as "times SB3's speed"."""

    title: str
    unit: str
    ratio: str
    rows: tuple[Row, ...]


Results = dict[str, Any]

# ---------------------------------------------------------------------- from JSON to panels


def panels_of(results: Results) -> dict[str, list[Panel]]:
    """Return the panels of each benchmark that has a result.

    :param results: name of a benchmark -> its JSON file
    """
    return {name: PANELS[name](results[name]) for name in PANELS if name in results}


def _env_steps_panels(result: dict[str, Any]) -> list[Panel]:
    def value(row: dict[str, Any]) -> str:
        return f"{row['env_steps_per_second']:,.0f}"

    return [
        _timed(
            rows,
            result["labels"],
            result["baselines"][tasks],
            f"Stepping {tasks}",
            "env steps per second",
            value,
        )
        for tasks, rows in result["tasks"].items()
    ]


def _update_panels(result: dict[str, Any]) -> list[Panel]:
    def value(row: dict[str, Any]) -> str:
        return f"{row['median_seconds'] * 1000:.1f} ms"

    return [
        _timed(
            rows,
            result["labels"],
            result["baseline"],
            f"One update, {n_tasks} tasks",
            "time per update",
            value,
        )
        for n_tasks, rows in result["tasks"].items()
    ]


def _training_loop_panels(result: dict[str, Any]) -> list[Panel]:
    def value(row: dict[str, Any]) -> str:
        return f"{row['env_steps_per_second']:,.0f}"

    rows, title = result["contestants"], "Training loop, MT10"
    return [_timed(rows, result["labels"], result["baseline"], title, "env steps per second", value)]


def _timed(
    measured: dict[str, dict[str, Any]],
    labels: dict[str, str],
    baseline: str,
    title: str,
    unit: str,
    value: Callable[[dict[str, Any]], str],
) -> Panel:
    """Return the panel of what :func:`~benchmarks.harness.compare` returned."""
    rows = (
        Row(
            labels[name],
            value(row),
            row["speedup"],
            row["speedup_low"],
            row["speedup_high"],
            labels[name].startswith("sb3_ars"),
        )
        for name, row in measured.items()
    )
    return Panel(title, unit, f"times as fast as {labels[baseline]}", tuple(rows))


def _memory_panels(result: dict[str, Any]) -> list[Panel]:
    labels = result["labels"]
    return [
        Panel(
            f"Replay buffer, {benchmark}",
            "the paper's size",
            f"share of the bytes of {labels[result['baseline']]}: less is better",
            tuple(
                Row(
                    labels[name],
                    f"{held['total_gb']:.2f} GB",
                    *[held["share_of_sb3"]] * 3,
                    ours=name != "sb3",
                )
                for name, held in contestants.items()
            ),
        )
        for benchmark, contestants in result["buffers"].items()
    ]


PANELS: dict[str, Callable[[dict[str, Any]], list[Panel]]] = {
    "env_steps": _env_steps_panels,
    "update": _update_panels,
    "training_loop": _training_loop_panels,
    "memory": _memory_panels,
}


# ---------------------------------------------------------------------- from panels to text


def render(name: str, results: Results) -> str:
    """Return the text of a block.

    :param name: "machine", "goals", "chart", or a benchmark's
    :param results: name of a benchmark -> its JSON file
    """
    if name in BLOCKS:
        return BLOCKS[name](results)
    if name not in PANELS:
        raise KeyError(f"no block {name!r}; there are {', '.join([*BLOCKS, *PANELS])}")
    return tables(name, results[name]) if name in results else UNMEASURED


def tables(name: str, result: dict[str, Any]) -> str:
    """Return a benchmark's tables.

    :param name: of the benchmark
    :param result: its JSON file
    """
    if name == "memory":
        return memory.tables(result)
    found = [panel_table(panel) for panel in PANELS[name](result)]
    if name == "env_steps":
        found.append(_floor_table(result))
    if name == "training_loop":
        found.append(_parts_table(result["seconds_by_part"]))
    return "\n\n".join(found)


def _floor_table(result: dict[str, Any]) -> str:
    """Return each contestant's speed as a share of MuJoCo's alone, a column per benchmark."""
    columns = result["tasks"]
    rows = [
        (
            label,
            *(f"{rows[name]['share_of_floor']:.2f}" if name in rows else "-" for rows in columns.values()),
        )
        for name, label in result["labels"].items()
    ]
    return markdown_table(("share of MuJoCo's speed alone", *columns), rows)


def _parts_table(seconds_by_part: dict[str, dict[str, float]]) -> str:
    """Return each part's share of the time, a column per contestant."""
    parts = list(dict.fromkeys(part for seconds in seconds_by_part.values() for part in seconds))
    rows = [
        (part, *(f"{100 * s.get(part, 0.0) / sum(s.values()):.1f} %" for s in seconds_by_part.values()))
        for part in parts
    ]
    return markdown_table(("share of the time", *seconds_by_part), rows)


def panel_table(panel: Panel) -> str:
    """Return one comparison as a Markdown table."""
    rows = [(row.label, row.value, f"{row.ratio:.2f}", _spread(row)) for row in panel.rows]
    return markdown_table((panel.title, panel.unit, panel.ratio, "quartiles over rounds"), rows)


def _spread(row: Row) -> str:
    return f"{row.low:.2f} to {row.high:.2f}" if row.low != row.high else "-"


def _goals_block(results: Results) -> str:
    found = [entry for name in (*PANELS, "gpu_mt10") for entry in results.get(name, {}).get("goals", [])]
    return goals_table(found) if found else UNMEASURED


def goals_table(found: list[dict[str, Any]]) -> str:
    """Return every goal, what was measured, and whether it was reached."""
    rows = [
        (
            entry["goal"],
            f"{'at least' if entry['better'] == 'more' else 'at most'} {entry['wanted']:g}",
            f"{entry['measured']:.3g}",
            "reached" if entry["reached"] else "**not reached**",
        )
        for entry in found
    ]
    return markdown_table(("goal", "wanted", "measured", ""), rows)


def _machine_block(results: Results) -> str:
    """Name machine, versions and commit of each file; where they agree, once."""
    names: dict[str, list[str]] = {}
    for name, result in results.items():
        if "machine" in result:
            names.setdefault(_machine_line(result["machine"]), []).append(f"`{name}.json`")
    if not names:
        return UNMEASURED
    return "\n".join(f"- {', '.join(files)}: {line}" for line, files in names.items())


def _machine_line(machine: dict[str, Any]) -> str:
    packages = ", ".join(f"{name} {number}" for name, number in machine["packages"].items() if number)
    commit = (machine["commit"] or "unknown").rstrip("+")[:10]
    dirty = " with changes" if machine["tree_is_dirty"] else ""
    gpu = f", {machine['gpu']}" if machine["gpu"] else ""
    return (
        f"{machine['cpu_model']} ({', '.join(machine['cpu_flags'])}), {machine['cpus_used']} of {machine['cpus']} "
        f"processors used, {machine['memory_gb']:.0f} GB{gpu}; Python {machine['python']}, {packages}; "
        f"commit {commit}{dirty}"
    )


def _gpu_block(results: Results) -> str:
    if "gpu_mt10" not in results:
        return UNMEASURED
    result = results["gpu_mt10"]
    idle = "-" if result["gpu_idle_share"] is None else f"{result['gpu_idle_share'] * 100:.0f} %"
    rows = [
        ("environment steps", f"{result['timesteps']:,}"),
        ("updates", f"{result['updates']:,}"),
        ("minutes of training, evaluation included", f"{result['training_seconds'] / 60:.1f}"),
        ("environment steps per second", f"{result['steps_per_second']:.0f}"),
        ("updates per second", f"{result['updates_per_second']:.0f}"),
        ("idle share of the GPU", idle),
        ("mean success, deterministic", f"{result['mean_success']:.3f}"),
        ("mean success, sampled", f"{result['mean_success_sampled']:.3f}"),
    ]
    return markdown_table((f"preset {result['preset']}", ""), rows)


BLOCKS: dict[str, Callable[[Results], str]] = {
    "machine": _machine_block,
    "goals": _goals_block,
    "gpu_mt10": _gpu_block,
}


# ---------------------------------------------------------------------- pages and picture


def read_results(folder: Path = RESULTS) -> Results:
    """Return the JSON files of the benchmarks this page is about.

    :param folder: where they are
    """
    paths = {name: folder / f"{name}.json" for name in (*PANELS, "gpu_mt10")}
    return {
        name: json.loads(path.read_text(encoding="utf-8")) for name, path in paths.items() if path.is_file()
    }


def filled(page: str, results: Results) -> str:
    """Return a page with its blocks as the results have them.

    :param page: Markdown
    :param results: of :func:`read_results`
    """
    return _BLOCK.sub(lambda block: f"{block[1]}{render(block['name'], results)}\n{block[3]}", page)


def outside_blocks(page: str) -> str:
    """Return a page without its blocks."""
    return _BLOCK.sub("", page)


def draw(panels: list[Panel], path: Path) -> None:
    """Draw one horizontal bar per contestant, a panel per comparison, into a picture.

    :param panels: at least one
    :param path: PNG or SVG to write
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    heights = [len(panel.rows) + 1.6 for panel in panels]
    figure, axes = plt.subplots(
        len(panels),
        1,
        figsize=(9, 0.36 * sum(heights)),
        height_ratios=heights,
        layout="constrained",
        squeeze=False,
    )
    for axis, panel in zip(axes[:, 0], panels, strict=True):
        ratios = [row.ratio for row in panel.rows]
        spread = [[row.ratio - row.low for row in panel.rows], [row.high - row.ratio for row in panel.rows]]
        colors = ["#2a6f97" if row.ours else "#b8bec6" for row in panel.rows]
        bars = axis.barh(
            [row.label for row in panel.rows],
            ratios,
            xerr=spread,
            color=colors,
            ecolor="#333333",
            height=0.72,
        )
        labels = [f"{row.ratio:.2f}x   ({row.value})" for row in panel.rows]
        axis.bar_label(
            bars, labels, padding=6, fontsize=9, bbox={"facecolor": "white", "edgecolor": "none", "pad": 1}
        )
        axis.axvline(1.0, color="black", lw=0.8, ls=":")
        axis.set_title(f"{panel.title} ({panel.unit} in brackets)", loc="left", fontsize=10)
        axis.set_xlabel(panel.ratio, fontsize=9)
        axis.set_xlim(0, max(1.0, *(row.high for row in panel.rows)) * 1.3)
        axis.invert_yaxis()
        axis.tick_params(labelsize=9, left=False)
        axis.grid(axis="x", alpha=0.25)
        axis.set_axisbelow(True)
        axis.spines[["top", "right", "left"]].set_visible(False)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def write_pages(folder: Path = RESULTS) -> list[Path]:
    """Fill the pages' blocks and draw the chart; return the files that were written.

    :param folder: where the results are
    """
    results = read_results(folder)
    written = []
    for path in PAGES:
        page = path.read_text(encoding="utf-8")
        if (new := filled(page, results)) != page:
            path.write_text(new, encoding="utf-8")
            written.append(path)
    panels = [panel for group in panels_of(results).values() for panel in group]
    if panels:
        draw(panels, folder / CHART)
        written.append(folder / CHART)
    return written


if __name__ == "__main__":
    print(*write_pages(), sep="\n")
