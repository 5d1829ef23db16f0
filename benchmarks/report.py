"""Writes what the documents say of speed, memory and success, from the benchmarks' JSON files; measures nothing.

    python -m benchmarks.report

Tables stand in the pages between ``<!-- begin: NAME -->`` and ``<!-- end: NAME -->``; a test compares them with the
files. A method's page has ``toy-PAGE``, its success on the toy tasks, and ``cost-PAGE``, its updates' time and memory.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import memory, methods
from benchmarks.harness import RESULTS, ROOT, markdown_table
from benchmarks.toy_methods import ARMS, summary

PERFORMANCE, METHODS_PAGE, TUNING, CHECKPOINTS = (
    ROOT / "docs" / f"{name}.md" for name in ("performance", "methods", "tuning", "checkpoints")
)
METHOD_PAGES = METHODS_PAGE.with_suffix("")  # a folder
PAGES = (PERFORMANCE, METHODS_PAGE, TUNING, CHECKPOINTS, *sorted(METHOD_PAGES.glob("*.md")))
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


@dataclass(frozen=True)
class Method:
    """One line of the table of methods; ``None`` where there is nothing to measure.

    :param label: in tables
    :param page: in docs/methods, without ``.md``
    :param alone: arm of the toy tasks without ARS
    :param with_ars: arm with it
    :param cost: name in ``methods.json``
    """

    label: str
    page: str
    alone: str | None
    with_ars: str | None
    cost: str | None


METHODS = (
    Method("SAC-MT", "sac-mt", "sac", None, "sac"),
    Method("ARS", "ars", None, "ars", "sac"),
    Method("ARS in bfloat16", "ars", None, "ars-bf16", None),
    Method("ARS-LN", "ars", None, "ars-ln", "ars-ln"),
    Method("ARS-LoRA, adapters per task", "lora", None, "ars-lora", "ars-lora"),
    Method("ARS-LoRA, shared adapters", "lora", None, "ars-lora-paper", "ars-lora-paper"),
    Method("SAC-MT-MH", "multi-head", "mh", "mh-ars", "mh"),
    Method("Soft Modularization", "soft-modules", "soft-modules", "soft-modules-ars", "soft-modules"),
    Method("Soft Modularization, 2 x 2 x 256", "soft-modules", None, None, "soft-modules-2x2"),
    Method(
        "Soft Modularization, reweighted",
        "soft-modules",
        "soft-modules-reweighted",
        "soft-modules-reweighted-ars",
        None,
    ),
    Method("PCGrad", "pcgrad", "pcgrad", "pcgrad-ars", "pcgrad"),
    Method("PaCo", "paco", "paco", "paco-ars", "paco"),
    Method("MOORE", "moore", "moore", "moore-ars", "moore"),
    Method("PopArt", "popart", "popart", None, "popart-10"),
    Method("SMT", "smt", "smt", None, "sac"),
    Method("TQC", "tqc", "tqc", "tqc-ars", "tqc"),
)

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

    :param name: of ``BLOCKS``, ``METHOD_BLOCKS``, ``TUNING_BLOCKS`` or ``CHECKPOINT_BLOCKS``, a benchmark's, or "toy-"
        or "cost-" and a method's page
    :param results: name of a benchmark -> its JSON file
    """
    blocks = BLOCKS | METHOD_BLOCKS | TUNING_BLOCKS | CHECKPOINT_BLOCKS
    if name in blocks:
        return blocks[name](results)
    kind, _, page = name.partition("-")
    pages = dict.fromkeys(method.page for method in METHODS)
    if kind in PAGE_BLOCKS and page in pages:
        return PAGE_BLOCKS[kind](results, page)
    if name not in PANELS:
        names = [*blocks, *PANELS, *(f"{kind}-PAGE" for kind in PAGE_BLOCKS)]
        raise KeyError(
            f"no block {name!r}; there are {', '.join(names)}, with PAGE one of {', '.join(pages)}"
        )
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


def goals_table(results: Results, names: Iterable[str]) -> str:
    """Return every goal of some benchmarks, what was measured, and whether it was reached.

    :param results: name of a benchmark -> its JSON file
    :param names: of the benchmarks
    """
    found = [entry for name in names for entry in results.get(name, {}).get("goals", [])]
    if not found:
        return UNMEASURED
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


def _machine_block(results: Results, names: Iterable[str]) -> str:
    """Name machine, versions and commit of each file; where they agree, once."""
    files: dict[str, list[str]] = {}
    for name in (name for name in names if name in results):
        for machine in results[name].get("machines", [results[name].get("machine")]):
            if machine is not None:
                files.setdefault(_machine_line(machine), []).append(f"`{name}.json`")
    if not files:
        return UNMEASURED
    return "\n".join(f"- {', '.join(named)}: {line}" for line, named in files.items())


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


# ---------------------------------------------------------------------- the methods


def _methods_block(results: Results) -> str:
    """Return one line per method: success on the toy tasks, time and memory of an update."""
    headings = (
        "method",
        "toy tasks, without ARS",
        "with ARS",
        *(f"update, {n} tasks: {what}" for n in (10, 50) for what in ("time", "memory")),
    )
    rows = [
        (
            f"[{method.label}]({METHOD_PAGES.name}/{method.page}.md)",
            *(_success(results, arm) for arm in (method.alone, method.with_ars)),
            *_times_baseline(results, method.cost),
        )
        for method in METHODS
    ]
    return markdown_table(headings, rows)


def _success(results: Results, arm: str | None) -> str:
    """Return an arm's mean success, and in brackets its lowest task's; see :func:`~benchmarks.toy_methods.summary`."""
    if arm is None:
        return "-"
    runs = results.get("toy_methods", {}).get("runs", {})
    if arm not in runs:
        return "?"
    found = summary(runs[arm])
    return f"{found['mean']:.2f} ({found['lowest_task']:.2f})"


def _times_baseline(results: Results, cost: str | None) -> list[str]:
    """Return time and memory at 10 and at 50 tasks as multiples of SAC-MT's."""
    measured = results.get("methods", {}).get("methods", {})
    if cost is None or cost not in measured:
        return ["-" if cost is None else "?"] * 4
    cases = methods.shown_cases(measured[cost]["cases"]).values()
    return [f"{row[key]:.2f}" for row in cases for key in ("times", "times_baseline_bytes")]


def _toy_block(results: Results, page: str) -> str:
    """Return the success of a page's arms, below that of SAC-MT and ARS."""
    runs = results.get("toy_methods", {}).get("runs", {})
    arms: dict[str | None, str] = {"sac": "SAC-MT", "ars": "ARS"}
    for method in (method for method in METHODS if method.page == page):
        joined = method.label if method.alone is None else f"ARS + {method.label}"
        arms = {method.alone: method.label, method.with_ars: joined} | arms
    rows = []
    for arm in (arm for arm in ARMS if arm in arms and arm in runs):
        found = summary(runs[arm])
        numbers = (*found["tasks"], found["mean"], found["lowest"])
        rows.append((arms[arm], *(f"{number:.2f}" for number in numbers), f"{found['seeds']}"))
    scales = results["toy_methods"]["reward_scales"] if rows else ()
    tasks = (f"rewards to {scale:g}" for scale in scales)
    headings = (
        "success on the toy tasks",
        *tasks,
        "mean",
        "lowest of any task and seed",
        "seeds",
    )
    return markdown_table(headings, rows) if rows else UNMEASURED


def _cost_block(results: Results, page: str) -> str:
    """Return time and memory of a page's methods."""
    measured = results.get("methods", {}).get("methods", {})
    costs = (method.cost for method in METHODS if method.page == page and method.cost is not None)
    names = dict.fromkeys(name for name in costs if name in measured)
    rows = []
    for name in names:
        for case, row in measured[name]["cases"].items():
            _, n_tasks = methods.CASES[case]
            network = "MT50's network" if case == "mt50" else "MT10's network"
            if "mt50" not in measured[name]["cases"]:
                network = "same network"
            rows.append(
                (
                    f"{methods.LABELS[name]}, {n_tasks} tasks, {network}",
                    f"{row['median_seconds'] * 1000:.0f} ms",
                    f"{row['times']:.2f}",
                    f"{row['times_low']:.2f} to {row['times_high']:.2f}",
                    f"{row['peak_bytes'] / 1e6:.0f} MB",
                    f"{row['times_baseline_bytes']:.2f}",
                    f"{row['learned_parameters']:,}",
                )
            )
    headings = (
        "one update",
        "time",
        "times SAC-MT's",
        "quartiles over rounds",
        "memory",
        "times SAC-MT's",
        "parameters that learn",
    )
    return markdown_table(headings, rows) if rows else UNMEASURED


# ---------------------------------------------------------------------- the study


def _tuning_block(results: Results) -> str:
    """Return what a study found of each options, its verdict, and what happened while it ran."""
    if "tune_toy" not in results:
        return UNMEASURED
    result = results["tune_toy"]
    names = list(result["space"])
    rows = [
        (
            *(str(tried["params"][name]) for name in names),
            f"{tried['mean']:.3f}",
            f"{tried['std']:.3f}" if len(tried["values"]) > 1 else "-",
            str(len(tried["values"])),
        )
        for tried in result["tried"]
    ]
    headings = (*(name.rpartition(".")[2] for name in names), "mean success", "std over runs", "runs")
    story, killed = result["story"], result["story"]["killed_trial"]
    told = (
        f"Preset `{result['preset']}` at scale `{result['scale']}`, {result['steps']:,} environment steps a run, "
        f"{result['seeds']} runs a trial, pruner `{result['pruner']}`. {story['processes']} processes brought "
        f"{result['states']['complete']} trials to their end in {story['seconds'] / 60:.0f} minutes."
    )
    if killed is not None:
        again = [str(trial["number"]) for trial in result["trials"] if trial["retry_of"] == killed]
        tried_again = (
            f"its options were tried again in trial {again[0]}"
            if again
            else "its options were not tried again"
        )
        told += f" The process that ran trial {killed} was killed in the middle; {tried_again}."
    return "\n\n".join((told, markdown_table(headings, rows), result["verdict"]))


# ---------------------------------------------------------------------- checkpoints


def _checkpoints_block(results: Results) -> str:
    """Return what writing and reading a checkpoint costs at the paper's size."""
    if "checkpoints" not in results:
        return UNMEASURED
    result = results["checkpoints"]
    rows = [
        (
            name,
            f"{entry['seconds']:.1f} s",
            f"{entry['rows_gb']:.2f} GB" if "rows_gb" in entry else "-",
            f"{entry['share']:.2%}" if "share" in entry else "-",
            f"{entry['extra_memory_mb']:.0f} MB",
        )
        for name, entry in result.items()
        if isinstance(entry, dict) and "seconds" in entry
    ]
    headings = ("", "time", "new rows", "share of the time", "memory beside the buffer")
    return markdown_table((f"MT10, buffer of {result['buffer_gb']:.2f} GB", *headings[1:]), rows)


def _soak_block(results: Results) -> str:
    """Return what came of killing a run many times, and of thousands of calls."""
    lines = []
    if "soak" in results:
        found = results["soak"]
        same = "to the bit the run that nobody killed" if not found["differing"] else "**another run**"
        lines.append(
            f"- A run of {found['steps']:,} steps was killed {found['kills']} times at random moments, "
            f"{found['kills_while_a_file_was_written']} of them while a checkpoint was being written. It ended as "
            f"{same}; {found['lives_that_found_no_usable_checkpoint']} lives found no usable checkpoint."
        )
    if "lifecycle" in results:
        found = results["lifecycle"]
        grown = found["growth"]
        lines.append(
            f"- {found['calls']:,} short `learn` calls with resume or load, save, evaluation and close grew the number "
            f"of processes by {grown['processes']:.0f}, of open files by {grown['open_files']:.0f}, of shared-memory "
            f"segments by {grown['shared_memory_segments']:.0f}, and resident memory by "
            f"{grown['resident_mb_per_1000_calls']:.1f} MB in 1,000 calls."
        )
    return "\n".join(lines) or UNMEASURED


SPEED = (*PANELS, "gpu_mt10")
ROBUST = ("checkpoints", "soak", "lifecycle")
COMPARED = ("toy_methods", "methods")
STUDIES = ("tune_toy",)

BLOCKS: dict[str, Callable[[Results], str]] = {
    "machine": partial(_machine_block, names=SPEED),
    "goals": partial(goals_table, names=SPEED),
    "gpu_mt10": _gpu_block,
}
"""Of the page on performance, beside ``PANELS``."""

METHOD_BLOCKS: dict[str, Callable[[Results], str]] = {
    "methods": _methods_block,
    "methods-goals": partial(goals_table, names=COMPARED),
    "methods-machine": partial(_machine_block, names=COMPARED),
}
"""Of the page that compares the methods."""

TUNING_BLOCKS: dict[str, Callable[[Results], str]] = {
    "tuning": _tuning_block,
    "tuning-machine": partial(_machine_block, names=STUDIES),
}
"""Of the page on tuning."""

CHECKPOINT_BLOCKS: dict[str, Callable[[Results], str]] = {
    "checkpoints": _checkpoints_block,
    "soak": _soak_block,
    "robust-machine": partial(_machine_block, names=ROBUST),
}
"""Of the page on checkpoints."""

PAGE_BLOCKS: dict[str, Callable[[Results, str], str]] = {"toy": _toy_block, "cost": _cost_block}
"""Of the methods' own pages."""


# ---------------------------------------------------------------------- pages and picture


def read_results(folder: Path = RESULTS) -> Results:
    """Return the JSON files of the benchmarks the pages are about.

    :param folder: where they are
    """
    paths = {name: folder / f"{name}.json" for name in (*SPEED, *COMPARED, *STUDIES, *ROBUST)}
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
    return written + draw_chart(results, folder)


def draw_chart(results: Results, folder: Path) -> list[Path]:
    """Draw the chart of all panels there are, and return its path; of none, draw none.

    :param results: of :func:`read_results`
    :param folder: for the picture
    """
    panels = [panel for group in panels_of(results).values() for panel in group]
    if not panels:
        return []
    draw(panels, folder / CHART)
    return [folder / CHART]


if __name__ == "__main__":
    print(*write_pages(), sep="\n")
