"""Update time and memory of every method, in the networks of the paper's presets, beside SAC-MT's in the same run.

    python -m benchmarks.methods                      # all; about 20 minutes on two cores
    python -m benchmarks.methods --only moore pcgrad  # these alone, without writing the file

An update is what a user gets by default on a CPU: float32, fused layers, 100 rows of each task, drawing the batch
included. Each method takes turns with SAC-MT at 10 and at 50 tasks. Cost per row compares the network of the method's
MT10 preset at 10 and at 50 tasks; where its MT50 preset has another network, that is measured too.

Memory is what an update takes beyond libraries and replay buffer: the peak of the process (the kernel's ``VmHWM``, so
Linux alone), minus what it held before the model was built, minus the buffer. So networks, targets, gradients,
optimizers, activations and PCGrad's matrix of gradients count.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
from collections.abc import Sequence
from functools import partial
from typing import Any

from benchmarks.harness import (
    Contestant,
    Work,
    goal,
    interleave,
    machine,
    run_alone,
    speedup,
    stopwatch,
    write_result,
)
from benchmarks.memory import held_bytes, resident
from benchmarks.update import Nothing, prepare
from sb3_ars.experiments.config import RunConfig, load_preset

BASELINE = "sac"
LABELS = {
    "sac": "SAC-MT",
    "ars-ln": "ARS-LN",
    "ars-lora": "ARS-LoRA, adapters per task",
    "ars-lora-paper": "ARS-LoRA, shared adapters",
    "mh": "SAC-MT-MH",
    "soft-modules": "Soft Modularization, 4 x 4 x 128",
    "soft-modules-2x2": "Soft Modularization, 2 x 2 x 256",
    "pcgrad": "PCGrad",
    "paco": "PaCo",
    "moore": "MOORE",
    "popart-10": "PopArt",
    "tqc": "TQC",
}
"""Preset without its benchmark -> in tables. ARS and SMT are left out: their update is SAC-MT's."""

CASES = {"mt10": ("mt10", 10), "mt10-at-50": ("mt10", 50), "mt50": ("mt50", 50)}
"""Case -> whose preset, and at how many tasks."""

UPDATES = {10: 5, 50: 2}  # timed in each round
STORED = 2000  # transitions per task
AT_MOST = {  # times SAC-MT's time
    "ars-ln": 1.3,
    "ars-lora": 2.0,
    "ars-lora-paper": 2.0,
    "soft-modules": 5.0,
    "soft-modules-2x2": 5.0,
    "moore": 5.0,
    "pcgrad": 6.0,
}
GROWS = ("pcgrad",)  # its arithmetic per row grows with the number of tasks
ROW_AT_MOST = 1.2


# ---------------------------------------------------------------------- the contestants


def make_model(config: RunConfig, n_tasks: int, stored: int = STORED) -> Any:
    """Return a preset's model of so many tasks in which nothing happens, ready to update; adapters are enabled.

    :param config: of the preset
    :param n_tasks: tasks, whatever the preset's
    :param stored: transitions per task
    """
    from sb3_ars import make_multitask_env
    from sb3_ars.experiments.runner import build_model

    algorithm = dataclasses.replace(config.algorithm, buffer_size=stored, device="cpu")
    env = make_multitask_env({f"task-{task}": Nothing for task in range(n_tasks)}, seed=0, n_workers=0)
    model = build_model(dataclasses.replace(config, algorithm=algorithm), env)
    prepare(model, n_tasks, stored)
    model.update_reward_scale()
    if config.ars.lora is not None:
        model.enable_lora()
    return model


def make_update(config: RunConfig, n_tasks: int, stored: int = STORED) -> Work:
    """Return the work of a preset's update; see :func:`make_model`."""
    model = make_model(config, n_tasks, stored)
    return stopwatch(lambda: model.train(gradient_steps=1, batch_size=model.batch_size))


def memory_of(config: RunConfig, n_tasks: int, stored: int) -> dict[str, int]:
    """Return what updating takes in this process, in bytes, and how many numbers are learned; see :func:`make_model`.

    :param config: of the preset
    :param n_tasks: tasks
    :param stored: transitions per task
    """
    sac = load_preset(f"mt10-{BASELINE}")
    small = dataclasses.replace(sac, policy=dataclasses.replace(sac.policy, net_arch=(8, 8)))
    make_update(small, n_tasks, stored)(2)  # libraries do what they do at first use
    before = resident("VmRSS")
    model = make_model(config, n_tasks, stored)
    for _ in range(3):
        model.train(gradient_steps=1, batch_size=model.batch_size)
    learned = [p for network in (model.actor, model.critic) for p in network.parameters() if p.requires_grad]
    return {
        "peak_bytes": resident("VmHWM") - before - held_bytes(model.replay_buffer),
        "learned_parameters": sum(p.numel() for p in learned),
        "parameters": sum(p.numel() for network in (model.actor, model.critic) for p in network.parameters()),
    }


def configs_of(name: str) -> dict[str, RunConfig]:
    """Return the configuration of each case; without "mt50" where that is "mt10-at-50".

    :param name: of ``LABELS``
    """
    configs = {case: load_preset(f"{benchmark}-{name}") for case, (benchmark, _) in CASES.items()}
    if _network(configs["mt50"]) == _network(configs["mt10"]):
        del configs["mt50"]
    return configs


def _network(config: RunConfig) -> tuple[Any, ...]:
    """Return what of a configuration an update's time depends on."""
    return config.policy, config.algorithm.algorithm, (config.ars.lora or {}).get("rank")


# ---------------------------------------------------------------------- the benchmark


def measure(rounds: int = 5, cpus: int = 2, names: Sequence[str] = tuple(LABELS)) -> dict[str, Any]:
    """Return times, memory and ratios of each method, and the goals.

    :param rounds: how often each contestant is timed
    :param cpus: processors for each
    :param names: of ``LABELS``
    """
    measured = {}
    for name in (BASELINE, *(name for name in names if name != BASELINE)):
        print(f"  {LABELS[name]} ...", flush=True)
        measured[name] = measure_one(name, rounds, cpus)
    return result_of(measured, cpus)


def result_of(measured: dict[str, dict[str, Any]], cpus: int) -> dict[str, Any]:
    """Return what goes into the file.

    :param measured: method -> what :func:`measure_one` returned, SAC-MT among them
    :param cpus: processors that each had
    """
    for found in measured.values():
        for case, row in found["cases"].items():
            base = measured[BASELINE]["cases"]["mt10" if CASES[case][1] == 10 else "mt10-at-50"]
            row["times_baseline_bytes"] = row["peak_bytes"] / base["peak_bytes"]
    return {
        "what": "one update in the networks of the presets, 100 rows a task, float32, fused layers",
        "unit": "seconds per update; bytes beyond libraries and buffer while updating",
        "cases": {case: {"preset": f"{benchmark}-...", "tasks": n} for case, (benchmark, n) in CASES.items()},
        "baseline": BASELINE,
        "labels": {name: LABELS[name] for name in measured},
        "methods": measured,
        "goals": goals(measured),
        "machine": machine(cpus),
    }


def measure_one(name: str, rounds: int, cpus: int) -> dict[str, Any]:
    """Return a method's cases, timed in turns with SAC-MT's, and its cost per row; see :func:`compared`."""
    configs = configs_of(name)
    entered = {f"{name}-{case}": (config, CASES[case][1]) for case, config in configs.items()}
    entered |= {
        f"{BASELINE}-{case}": (load_preset(f"mt10-{BASELINE}"), CASES[case][1])
        for case in ("mt10", "mt10-at-50")
    }
    contestants = [
        Contestant(key, key, partial(make_update, config, n_tasks), units=UPDATES[n_tasks])
        for key, (config, n_tasks) in entered.items()
    ]
    found = compared(name, interleave(contestants, rounds, cpus))
    for case, row in found["cases"].items():
        row |= run_alone(partial(memory_of, configs[case], CASES[case][1], stored=500), cpus)
    return found


def compared(name: str, seconds: dict[str, list[float]]) -> dict[str, Any]:
    """Return, per case, a method's time as a multiple of SAC-MT's; and its time per row at 50 tasks over that at 10.

    Both are medians over rounds of the ratio within a round, with their quartiles.

    :param name: of the method
    :param seconds: ``<method>-<case>`` -> seconds per update, round by round
    """
    cases = {}
    for case in (case for case in CASES if f"{name}-{case}" in seconds):
        own = seconds[f"{name}-{case}"]
        base = seconds[f"{BASELINE}-{'mt10' if CASES[case][1] == 10 else 'mt10-at-50'}"]
        cases[case] = {
            "median_seconds": statistics.median(own),
            "best_seconds": min(own),
            **_times(own, base),
            "seconds": own,
            "baseline_seconds": base,
        }
    per_row = {
        n: [s / n for s in seconds[f"{name}-{case}"]] for case, n in (("mt10", 10), ("mt10-at-50", 50))
    }
    return {"cases": cases, "row_cost": _times(per_row[50], per_row[10])}


def _times(own: Sequence[float], base: Sequence[float]) -> dict[str, float]:
    return {name.replace("speedup", "times"): value for name, value in speedup(own, base).items()}


def goals(measured: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the goals with what was measured.

    :param measured: method -> what :func:`compared` returned
    """
    found = []
    for name in (name for name in AT_MOST if name in measured):
        for case, row in shown_cases(measured[name]["cases"]).items():
            n_tasks = CASES[case][1]
            if n_tasks == 10 or name not in GROWS:
                what = f"update, {n_tasks} tasks: {LABELS[name]}, times SAC-MT's time"
                found.append(goal(what, row["times"], at_most=AT_MOST[name]))
    for name in (name for name in measured if name not in GROWS):
        what = f"update: {LABELS[name]}, cost per row at 50 tasks over that at 10"
        found.append(goal(what, measured[name]["row_cost"]["times"], at_most=ROW_AT_MOST))
    return found


def shown_cases(cases: dict[str, Any]) -> dict[str, Any]:
    """Return the two cases that tables show: the presets of MT10 and MT50 at their own number of tasks.

    :param cases: case -> anything
    """
    fifty = "mt50" if "mt50" in cases else "mt10-at-50"
    return {case: cases[case] for case in ("mt10", fifty)}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cpus", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=LABELS, help="these alone, without writing the file")
    given = parser.parse_args()
    result = measure(given.rounds, given.cpus, given.only or tuple(LABELS))
    for name, found in result["methods"].items():
        for case, row in found["cases"].items():
            print(
                f"{LABELS[name]:40} {case:12} {row['median_seconds'] * 1000:8.1f} ms {row['times']:6.2f} x "
                f"[{row['times_low']:.2f}, {row['times_high']:.2f}] {row['peak_bytes'] / 1e6:7.0f} MB "
                f"{row['times_baseline_bytes']:6.2f} x"
            )
    for entry in result["goals"]:
        print(f"{'reached' if entry['reached'] else 'NOT REACHED'}: {entry['goal']}: {entry['measured']:.3f}")
    if not given.only:
        print(write_result("methods", result))


if __name__ == "__main__":
    main()
