"""Sentences about runs that stand beside their numbers: protocol, seeds, resets, environment; computes no results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sb3_ars.experiments.report.gather import Arm, Gathered
from sb3_ars.experiments.report.tables import Row, Table
from sb3_ars.experiments.run_folder import Run
from sb3_ars.experiments.sweeps import Sweep

__all__ = [
    "by_tasks",
    "counted",
    "environment_differences",
    "environment_of",
    "labels_of",
    "noted",
    "numbers_of",
    "protocol_text",
    "resets_text",
    "row_label",
    "runs_of",
    "seeds_text",
    "source_text",
]


def labels_of(found: Gathered, sweeps: Sequence[Sweep]) -> dict[int, str]:
    """Return each arm's label: the paper's name of its preset, where the sweeps give one that is no other's."""
    names: dict[str, str] = {}
    for sweep in sweeps:
        if sweep.kind in ("per_task", "bottom_k", "task_sets", "curves", "estr"):
            for row in sweep.rows:
                if row.column is None:
                    names.setdefault(row.preset, row.label)
    presets = {arm.preset for arm in found.arms}
    used = [names[preset] for preset in presets if preset in names]
    return {
        id(arm): arm.named(names[arm.preset]) if used.count(names.get(arm.preset, "")) == 1 else arm.label
        for arm in found.arms
    }


def row_label(row: Row) -> str:
    """Return the name of a table's row that stands alone."""
    return f"{row.column}, {row.label}" if row.column else row.label


def by_tasks(arms: Mapping[str, Arm]) -> list[tuple[str, str, dict[str, Arm]]]:
    """Part methods by the tasks they train on, since tasks are drawn side by side.

    :param arms: by label
    :return: suffix for names, the tasks in words, and the methods of each part; the suffix is empty where all train on
        the same tasks, and so are the words where these are several
    """
    parts: dict[tuple[str, ...], dict[str, Arm]] = {}
    for label, arm in arms.items():
        parts.setdefault(arm.task_names, {})[label] = arm
    several = len(parts) > 1
    return [
        (f"-{number}" if several else "", _tasks_text(tasks) if several or len(tasks) == 1 else "", same)
        for number, (tasks, same) in enumerate(parts.items(), start=1)
    ]


def _tasks_text(tasks: Sequence[str]) -> str:
    return f"task {tasks[0]}" if len(tasks) == 1 else f"{len(tasks)} tasks, {tasks[0]} to {tasks[-1]}"


def runs_of(arms: Mapping[str, Arm]) -> dict[str, Sequence[Run]]:
    """Return what the plots take: label -> runs."""
    return {label: arm.runs for label, arm in arms.items()}


def noted(table: Table, arms: Iterable[Arm | None]) -> Table:
    """Put beneath a table the protocol of its numbers, and in what its runs' environments differ."""
    filled = [arm for arm in arms if arm]
    if not filled or table.name.endswith(("-seconds", "-paper")):
        return table
    notes = [*table.notes, protocol_text(filled)]
    differ = environment_differences([run for arm in filled for run in arm.runs])
    if differ:
        notes.append(f"The runs of this table differ in {'; '.join(differ)}.")
    return replace(table, notes=tuple(notes))


def numbers_of(arms: Mapping[str, Arm]) -> dict[str, int]:
    """Return what gives a method the same colour in every figure: label -> number."""
    return {label: arm.number for label, arm in arms.items()}


def protocol_text(arms: Iterable[Arm]) -> str:
    """Return the protocol of final numbers in a sentence, with its methods where there are several."""
    by_protocol: dict[str, list[str]] = {}
    for arm in arms:
        for protocol in arm.protocols:
            by_protocol.setdefault(protocol, []).append(arm.label)
    if len(by_protocol) == 1:
        return f"{_capital(next(iter(by_protocol)))}; mean actions."
    parts = [f"{protocol} ({', '.join(labels)})" for protocol, labels in by_protocol.items()]
    return f"Evaluated under several protocols, which cannot be compared: {'; '.join(parts)}; mean actions."


def source_text(source: str, arms: Mapping[str, Arm]) -> str:
    """Return where success over training comes from, in a sentence."""
    if source == "evaluation":
        return (
            f"From the evaluations during training: {protocol_text(arms.values())[0].lower()}"
            + protocol_text(arms.values())[1:]
        )
    return "From the training episodes, whose actions are sampled: the latest of each task."


def seeds_text(arms: Iterable[Arm]) -> str:
    """Return how many seeds there are, in a sentence."""
    counts = sorted({len(arm.runs) for arm in arms})
    if counts == [1]:
        return "One seed each, so no spread."
    return f"{counts[0]} seeds each." if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds."


def resets_text(arms: Mapping[str, Arm]) -> str:
    """Return which methods reset, in a sentence."""
    resetting = [label for label, arm in arms.items() if any(run.result["resets"] for run in arm.runs)]
    if not resetting:
        return "No resets."
    return f"Dotted: resets of {'all methods' if len(resetting) == len(arms) else ', '.join(resetting)}."


def environment_of(run: Run) -> dict[str, str]:
    """Return versions and hardware of a run: name -> text."""
    flat: dict[str, Any] = {key: value for key, value in run.versions.items() if key != "packages"}
    flat |= run.versions.get("packages") or {}
    return {key: "none" if value is None else str(value) for key, value in flat.items()}


def environment_differences(runs: Sequence[Run]) -> tuple[str, ...]:
    """Return in what the environments of runs differ, each with its values; empty where they are the same."""
    environments = [environment_of(run) for run in runs]
    keys = dict.fromkeys(key for environment in environments for key in environment)
    found = {key: dict.fromkeys(e.get(key, "unknown") for e in environments) for key in keys}
    return tuple(f"{key} ({', '.join(values)})" for key, values in found.items() if len(values) > 1)


def counted(counts: Mapping[str, int]) -> str:
    """Return values with the number of runs behind each."""
    return "; ".join(f"{value} ({count} run{'s' if count > 1 else ''})" for value, count in counts.items())


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
