"""What stands in a report, section by section: chooses tables and figures for the runs found; writes nothing."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from sb3_ars.errors import ConfigError
from sb3_ars.experiments.report.blocks import Block, Film, Films, Listing, Section
from sb3_ars.experiments.report.drawings import (
    FEW_SEEDS,
    SHOWN,
    THRESHOLDS,
    bars_drawing,
    curves_drawing,
    estr_drawing,
    estr_numbers,
    intervals_drawing,
    parts_blocks,
    q_drawing,
    scales_drawing,
    task_curves_drawing,
)
from sb3_ars.experiments.report.figures import Drawing
from sb3_ars.experiments.report.forms import sweep_section
from sb3_ars.experiments.report.gather import Arm, Gathered, differences
from sb3_ars.experiments.report.tables import (
    MISSING,
    Column,
    Row,
    Table,
    bottom_k_table,
    summary_table,
    task_table,
)
from sb3_ars.experiments.report.words import (
    by_tasks,
    counted,
    environment_differences,
    environment_of,
    labels_of,
    noted,
)
from sb3_ars.experiments.scaling import load_scale
from sb3_ars.experiments.sweeps import Sweep

__all__ = ["all_numbers", "sections"]

_FILM_BYTES = 3_000_000
_FILM_TYPES = {".mp4": "video/mp4", ".webm": "video/webm", ".gif": "image/gif"}


def sections(found: Gathered, sweeps: Sequence[Sweep], videos: bool) -> list[Section]:
    """Return everything that stands in the report.

    :param found: the runs
    :param sweeps: tables and figures of the paper to show in their form
    :param videos: whether to put the runs' videos in
    """
    labels = labels_of(found, sweeps)
    scales = list(dict.fromkeys([arm.scale for arm in found.arms] + [scale for scale, _ in found.expected]))
    made = [_overview(found)]
    for scale in scales:
        arms = [arm for arm in found.arms if arm.scale == scale]
        made.append(_scale_section(scale, arms, labels))
        for sweep in sweeps:
            here = {arm.preset for arm in arms} | {
                preset for there, preset in found.expected if there == scale
            }
            if here & set(sweep.presets) or len(scales) == 1:
                made.append(sweep_section(sweep, scale, found))
        for suffix, tasks, same in by_tasks({labels[id(arm)]: arm for arm in arms}):
            made.append(_arms_section(scale, suffix, tasks, same, found))
    if videos:
        made.append(_films_section(found, labels))
    return [*made, _environment_section(found), _runs_section(found), _reading_section()]


def all_numbers(found: Gathered) -> Table:
    """Return the final numbers of every run and task, unrounded, one row each."""
    columns = ["scale", "preset", "difference", "seed", "task", "success", "success_sampled", "return", "c"]
    rows = [
        (
            arm.scale,
            arm.preset,
            arm.difference,
            str(run.seed),
            task,
            *("" if values.get(key) is None else str(values[key]) for key in columns[5:]),
            run.result["protocol"],
            str(run.folder),
        )
        for arm in found.arms
        for run in arm.runs
        for task, values in run.result["tasks"].items()
    ]
    names = (*columns, "protocol", "folder")
    return Table("all-numbers", "Final numbers of every run", tuple(map(Column, names)), tuple(rows))


# ---------------------------------------------------------------------- all runs of a scale


def _overview(found: Gathered) -> Section:
    scales = list(dict.fromkeys(arm.scale for arm in found.arms))
    seeds = sorted({run.seed for run in found.runs})
    early = tuple(
        f"{arm.scale}/{arm.preset}, seed {run.seed}: stopped at step {arm.stopped} of "
        f"{run.config.algorithm.total_timesteps:,} ({run.folder})"
        for arm in found.arms
        if arm.stopped
        for run in arm.runs
    )
    presets = {arm.preset for arm in found.arms}
    blocks: list[Block] = [
        f"{len(found.runs) - len(early)} finished runs"
        + (f" and {len(early)} that ended early" if early else "")
        + f" of {len(presets)} preset{'s' if len(presets) > 1 else ''}, seeds {', '.join(map(str, seeds))}; "
        f"scale{'s' if len(scales) > 1 else ''} {', '.join(scales)}."
    ]
    if early:
        title = "Ended before their time, by an interrupt or by what was called after an evaluation"
        blocks.append(Listing(f"{title}; they stand in rows of their own", early, warning=True))
    if found.missing:
        names = tuple(f"{scale}/{preset}, seed {seed}" for scale, preset, seed in found.missing)
        title = f"Missing: {len(names)} runs that should be here, trained to their end, and are not"
        blocks.append(Listing(title, names, warning=True))
    if found.warnings:
        blocks.append(Listing("Left out of this report", found.warnings, warning=True))
    differ = environment_differences(found.runs)
    if differ:
        blocks.append(
            Listing(
                "The runs were not all made in the same environment; they differ in", differ, warning=True
            )
        )
    return Section("overview", "What was found", tuple(blocks))


def _scale_section(scale: str, arms: Sequence[Arm], labels: Mapping[int, str]) -> Section:
    blocks: list[Block] = []
    try:
        description = load_scale(scale).description
    except ConfigError:
        description = ""
    if scale == "full":
        blocks.append(
            "Runs of the presets as they are. Options of the method that were changed are listed here."
        )
    else:
        about = f"{description[:1].upper()}{description[1:].rstrip('.')}. " if description else ""
        blocks.append(
            f"{about}The presets' methods at another size. Listed is every option of the method that differs from the "
            "preset, and so from the paper's experiment."
        )
    unknown = tuple(labels[id(arm)] for arm in arms if differences(arm) is None)
    if unknown:
        blocks.append(Listing("Not compared, since no preset has this name:", unknown))
    rows = _difference_rows(arms, labels)
    if rows:
        columns = (Column("option"), *(Column(name, text=True) for name in ("preset", "these runs", "of")))
        title = f"Scale {scale}: what differs from the presets"
        blocks.append(Table(f"differences-{scale}", title, columns, rows))
    elif arms and not unknown:
        blocks.append("No option differs from the presets.")
    return Section(f"scale-{scale}", f"Scale {scale}", tuple(blocks))


def _difference_rows(arms: Sequence[Arm], labels: Mapping[int, str]) -> tuple[tuple[str, ...], ...]:
    """Return option, preset's value, value here, and the methods it holds for."""
    compared = [(labels[id(arm)], changed) for arm in arms if (changed := differences(arm)) is not None]
    held: dict[tuple[str, str, str], list[str]] = {}
    for label, changed in compared:
        for option, (before, after) in changed.items():
            held.setdefault((option, before, after), []).append(label)
    order = {option: index for index, (option, _, _) in enumerate(held)}
    return tuple(
        (*key, "all" if len(of) == len(compared) else ", ".join(of))
        for key, of in sorted(held.items(), key=lambda item: order[item[0][0]])
    )


def _arms_section(scale: str, suffix: str, tasks: str, arms: Mapping[str, Arm], found: Gathered) -> Section:
    """Return the section of the methods of a scale that train on the same tasks, by label."""
    name = f"all-{scale}{suffix}"
    rows = [Row(label, arm, n_expected=found.n_expected(arm)) for label, arm in arms.items()]
    n_tasks = len(rows[0].arm.task_names) if rows[0].arm else 0
    shown = dict(list(arms.items())[:SHOWN])
    tables: list[Block] = [
        summary_table(f"{name}-summary", "Every method: success, mean ± std over seeds", rows, FEW_SEEDS),
        *intervals_drawing(name, arms),
    ]
    blocks: list[Block] = [*tables]
    if len(shown) < len(arms):
        blocks.append(
            f"The figures below show the first {SHOWN} of {len(arms)} methods; write a report of fewer runs to "
            "see the others."
        )
    blocks += [
        *curves_drawing(name, shown),
        task_table(f"{name}-tasks", "Success of each task (%), mean ± std over seeds", rows),
        *bars_drawing(name, shown),
        *task_curves_drawing(name, shown),
        bottom_k_table(
            f"{name}-bottom-k", "Success of the k worst tasks of each seed (%), mean ± std over seeds", rows
        ),
        *estr_drawing(name, shown, THRESHOLDS),
        estr_numbers(f"{name}-estr", rows, THRESHOLDS),
        *scales_drawing(name, shown),
        *q_drawing(name, shown),
        *parts_blocks(name, arms),
    ]
    if n_tasks == 1:  # worst tasks, shares of tasks and tasks side by side say nothing of one
        blocks = [block for block in blocks if not _of_several_tasks(block)]
    with_notes = [noted(block, arms.values()) if isinstance(block, Table) else block for block in blocks]
    return Section(name, f"All runs (scale {scale}{tasks and f', {tasks}'})", tuple(with_notes))


def _of_several_tasks(block: Block) -> bool:
    ends = ("-bottom-k", "-estr", "-tasks", "-task-bars", "-task-curves", "-estr-curve")
    return isinstance(block, Table | Drawing) and block.name.endswith(ends)


# ---------------------------------------------------------------------- videos, environment, runs, how to read


def _films_section(found: Gathered, labels: Mapping[int, str]) -> Section:
    films, skipped = [], []
    for arm in found.arms:
        for run in arm.runs:
            folder = run.folder / "videos"
            for path in sorted(folder.iterdir()) if folder.is_dir() else ():
                if path.suffix not in _FILM_TYPES or path.name.startswith(".") or not path.is_file():
                    continue  # a hidden one is still being written
                if path.stat().st_size > _FILM_BYTES:
                    skipped.append(f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
                    continue
                label = f"{labels[id(arm)]}, seed {run.seed}: {path.stem}"
                data = base64.b64encode(path.read_bytes()).decode("ascii")
                films.append(Film(label, _FILM_TYPES[path.suffix], data))
    blocks: list[Block] = [Films(tuple(films))] if films else []
    if not films:
        blocks.append("No run holds a video; record one with 'sb3-ars video RUN --task TASK'.")
    if skipped:
        limit = f"Too large to put into the page (more than {_FILM_BYTES // 10**6} MB):"
        blocks.append(Listing(limit, tuple(skipped)))
    return Section("videos", "What the policies do", tuple(blocks))


def _environment_section(found: Gathered) -> Section:
    by_run = [environment_of(run) for run in found.runs]
    rows = []
    for key in dict.fromkeys(key for environment in by_run for key in environment):
        values = [environment.get(key, "unknown") for environment in by_run]
        counts = {value: values.count(value) for value in dict.fromkeys(values)}
        rows.append((key, *([*counts] if len(counts) == 1 else [counted(counts)])))
    table = Table(
        "environment",
        "Versions and hardware of the runs",
        (Column("what"), Column("value", text=True)),
        tuple(rows),
    )
    return Section("environment", "Versions and hardware", (table,))


def _runs_section(found: Gathered) -> Section:
    root = Path(os.path.commonpath([run.folder.parent for run in found.runs]))
    rows = tuple(
        (
            str(run.folder.relative_to(root)),
            arm.scale,
            arm.label,
            str(run.seed),
            f"{100 * run.result['mean_success']:.1f}" if run.result["mean_success"] is not None else MISSING,
            f"{run.result['timesteps']:,}",
            f"{run.result['updates']:,}",
            str(run.result["resets"]),
            f"{run.result['training_seconds'] / 60:.1f}",
        )
        for arm in found.arms
        for run in arm.runs
    )
    names = (
        "folder",
        "scale",
        "preset",
        "seed",
        "mean success (%)",
        "env steps",
        "updates",
        "resets",
        "time (min)",
    )
    title = f"Runs in {root}"
    columns = tuple(Column(name, text=name in ("scale", "preset")) for name in names)
    table = Table("runs", title, columns, rows)
    return Section("runs", "The runs", (noted(table, list(found.arms)),))


def _reading_section() -> Section:
    return Section(
        "reading",
        "How the numbers are made",
        (
            "Success is the share of the final evaluation's episodes in which the task succeeded at any step, with "
            "mean actions unless a column says that actions were sampled. A method's number is the mean over its "
            "seeds of each seed's mean over tasks.",
            "The number behind ± is the standard deviation over seeds with n - 1. The paper does not say which it "
            "prints; of its figures, 98.8 ± 3.5 over 8 seeds is what seven seeds at 100 and one at 90 give with n - 1 "
            "(with n it would be 3.3). One seed has no ±.",
            "The interquartile mean (IQM) and its interval are those of Agarwal et al. (2021): whole scores are cut, a "
            f"quarter at each end; 2,000 resamples, seeds within each task, percentiles 2.5 and 97.5. {FEW_SEEDS}",
            "The paper's figures need not all come from one protocol: means over 8 seeds of 10 episodes are multiples "
            "of 1.25, and some of its baselines' figures for single tasks, such as 98 and 62, are not. Those were made "
            "with another number of seeds or of episodes.",
            "The success of the k worst tasks and the share of tasks solved are computed for each seed, then averaged "
            "over seeds. Every table is in the folder tables/ as CSV and Markdown; tables/all-numbers.csv has every "
            "run's numbers unrounded.",
        ),
    )
