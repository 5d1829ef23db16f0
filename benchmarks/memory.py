"""Memory of the replay buffer and of a training process: ours beside SB3's, measured the same way.

    python -m benchmarks.memory

Bytes per transition come from what the buffers really hold at a small size: every array, tensor and table reachable
from them, ours filled with episodes of Meta-World's horizon, since with ``optimize_memory_usage`` it is the ends of
episodes that take room. Processes are measured whole: each builds a model, fills its buffer, saves it and trains; a
second one loads. Peaks are the kernel's (``VmHWM``), so this runs on Linux alone.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer

from benchmarks.harness import ROOT, goal, machine, markdown_table, threads_environment
from benchmarks.update import ACTION_DIM, NET_ARCH, OBS_DIM, Nothing
from sb3_ars import ARSSAC, TaskReplayBuffer, make_multitask_env

HORIZON = 500
SMALL = 10 * HORIZON  # transitions per task from which bytes per transition are computed
PAPER = {"MT10": (10, 1_000_000), "MT50": (50, 500_000)}  # tasks, and transitions of each
LABELS = {"sb3": "SB3 ReplayBuffer", "ours": "sb3_ars", "optimized": "sb3_ars, optimize_memory_usage"}
BASELINE = "sb3"
AT_MOST = {"MT10": {"ours": 0.82, "optimized": 0.48}, "MT50": {"ours": 0.48, "optimized": 0.28}}
PROCESS_TASKS, PROCESS_ROWS = 10, 200_000
ENVS_PER_TASK = 5  # in the processes, whose buffers are so filled faster
BATCH_SIZE = 100  # rows per task


# ---------------------------------------------------------------------- what a buffer holds


def make_buffer(name: str, n_tasks: int, rows: int) -> ReplayBuffer:
    observation_space = spaces.Box(-np.inf, np.inf, (OBS_DIM + n_tasks,), np.float32)
    action_space = spaces.Box(-1, 1, (ACTION_DIM,), np.float32)
    if name == "sb3":
        return ReplayBuffer(rows * n_tasks, observation_space, action_space, "cpu", n_envs=n_tasks)
    return TaskReplayBuffer(
        rows,
        observation_space,
        action_space,
        "cpu",
        n_envs=n_tasks,
        optimize_memory_usage=name == "optimized",
        task_of_env=range(n_tasks),
        task_names=[f"task-{task}" for task in range(n_tasks)],
    )


def fill(buffer: ReplayBuffer, n_tasks: int, rows: int) -> None:
    """Store so many transitions of each task: episodes of the horizon, each over the same random frames."""
    rng, n = np.random.default_rng(0), buffer.n_envs
    frames = rng.normal(size=(HORIZON + 1, n, OBS_DIM + n_tasks)).astype(np.float32)
    frames[:, :, OBS_DIM:] = np.eye(n_tasks).repeat(n // n_tasks, axis=0)
    actions = rng.uniform(-1, 1, size=(n, ACTION_DIM)).astype(np.float32)
    rewards = rng.uniform(0.1, 1, size=n)
    going_on, over = np.zeros(n, dtype=bool), np.ones(n, dtype=bool)
    infos: list[dict[str, Any]] = [{} for _ in range(n)]
    ends = [{"terminal_observation": frame, "TimeLimit.truncated": True} for frame in frames[-1]]
    for row in range(rows * n_tasks // n):
        step = row % HORIZON
        done, info = (over, ends) if step == HORIZON - 1 else (going_on, infos)
        buffer.add(frames[step], frames[step + 1], actions, rewards, done, info)


def held_bytes(buffer: Any) -> int:
    """Return the bytes of all arrays, tensors, numbers and containers of them that an object's attributes lead to."""
    held: dict[int, int] = {}
    waiting = list(vars(buffer).values())
    while waiting:
        value = waiting.pop()
        if isinstance(value, th.Tensor):
            held[value.untyped_storage().data_ptr()] = value.untyped_storage().nbytes()
        elif isinstance(value, np.ndarray) and isinstance(value.base, np.ndarray):
            waiting.append(value.base)
        elif isinstance(value, np.ndarray):
            held[value.__array_interface__["data"][0]] = value.nbytes
        elif isinstance(value, dict | list | tuple | int):
            held[id(value)] = sys.getsizeof(value)
            waiting += [] if isinstance(value, int) else value
            waiting += value.values() if isinstance(value, dict) else []
        elif type(value).__module__ == type(buffer).__module__:
            waiting += vars(value).values()
    return sum(held.values())


def buffers_of(benchmark: str, small: int) -> dict[str, dict[str, float]]:
    """Return each contestant's bytes per transition, gigabytes at the paper's size, and share of the baseline's."""
    n_tasks, rows = PAPER[benchmark]
    per_transition = {}
    for name in LABELS:
        buffer = make_buffer(name, n_tasks, small)
        fill(buffer, n_tasks, small)
        per_transition[name] = held_bytes(buffer) / (n_tasks * small)
    return {
        name: {
            "bytes_per_transition": held,
            "total_gb": held * n_tasks * rows / 1e9,
            "share_of_sb3": held / per_transition[BASELINE],
        }
        for name, held in per_transition.items()
    }


# ---------------------------------------------------------------------- what a process takes


def make_model(name: str, rows: int) -> Any:
    tasks = {f"task-{task}": Nothing for task in range(PROCESS_TASKS)}
    env = make_multitask_env(tasks, seed=0, n_envs_per_task=ENVS_PER_TASK, n_workers=0)
    options: dict[str, Any] = {"device": "cpu", "policy_kwargs": {"net_arch": list(NET_ARCH)}}
    if name == "sb3":
        options |= {"buffer_size": rows * PROCESS_TASKS, "batch_size": BATCH_SIZE * PROCESS_TASKS}
        return SAC("MlpPolicy", env, **options)
    options |= {"buffer_size": rows, "batch_size": BATCH_SIZE, "optimize_memory_usage": name == "optimized"}
    return ARSSAC("MlpPolicy", env, n_reset=0, **options)


def resident(key: str) -> int:
    """Return this process's ``VmRSS`` (now) or ``VmHWM`` (at most so far), in bytes."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(f"{key}:"))) * 1024


def fill_save_train(name: str, rows: int, path: str) -> dict[str, int]:
    """Do so in this process, and return its memory in bytes."""
    model = make_model(name, rows)
    model.learn(1)  # makes the logger; networks and libraries do what they do at first use
    libraries = resident("VmRSS")
    fill(model.replay_buffer, PROCESS_TASKS, rows)
    filled = resident("VmHWM")
    model.save_replay_buffer(path)
    saved = resident("VmHWM")
    model.train(gradient_steps=3, batch_size=model.batch_size)
    return {
        "buffer": held_bytes(model.replay_buffer),
        "libraries": libraries,
        "peak": resident("VmHWM"),
        "extra_while_saving": saved - filled,
    }


def load(name: str, rows: int, path: str) -> dict[str, int]:
    """Load a saved buffer into a new model in this process, and return what that took beyond the buffer, in bytes."""
    model = make_model(name, rows)
    before = resident("VmRSS")
    model.load_replay_buffer(path)
    assert model.replay_buffer.size() >= rows / ENVS_PER_TASK  # SB3 counts steps of all its environments
    return {"extra_while_loading": resident("VmHWM") - before - held_bytes(model.replay_buffer)}


PARTS = {"fill_save_train": fill_save_train, "load": load}


def measure_process(rows: int, folder: str, name: str) -> dict[str, float]:
    """Return what the two processes of a contestant took, in bytes, and the peak's ratio to what it must hold."""
    path = str(Path(folder) / f"{name}.pkl")
    taken: dict[str, float] = {}
    for part in PARTS:
        command = [sys.executable, "-m", "benchmarks.memory", "--part", part, name, str(rows), path]
        environment = {**os.environ, **threads_environment(1)}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{name}, {part}: exit code {done.returncode}\n{done.stderr}")
        taken |= json.loads(done.stdout.splitlines()[-1])
    os.remove(path)
    return {**taken, "peak_over_buffer_and_libraries": taken["peak"] / (taken["buffer"] + taken["libraries"])}


# ---------------------------------------------------------------------- the benchmark


def measure(process_rows: int = PROCESS_ROWS, small: int = SMALL) -> dict[str, Any]:
    """Return bytes per transition and in all, the processes' peaks, and the goals.

    :param process_rows: transitions of each of ten tasks that the processes fill
    :param small: transitions per task from which bytes per transition are computed
    """
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        processes = dict(
            zip(LABELS, pool.map(partial(measure_process, process_rows, folder), LABELS), strict=True)
        )
    buffers = {benchmark: buffers_of(benchmark, small) for benchmark in PAPER}
    return {
        "what": f"observations of {OBS_DIM}, actions of {ACTION_DIM}, float32, episodes of {HORIZON} steps",
        "unit": "bytes",
        "sizes": {
            "paper": PAPER,
            "measured_rows": small,
            "process_tasks": PROCESS_TASKS,
            "process_rows": process_rows,
        },
        "baseline": BASELINE,
        "labels": LABELS,
        "buffers": buffers,
        "processes": processes,
        "goals": goals(buffers, processes),
        "machine": machine(),
    }


def goals(
    buffers: dict[str, dict[str, dict[str, float]]], processes: dict[str, dict[str, float]]
) -> list[dict[str, Any]]:
    """Return the goals with what was measured.

    :param buffers: benchmark -> what :func:`buffers_of` returned
    :param processes: contestant -> what :func:`measure_process` returned
    """
    found = [
        goal(
            f"buffer, {benchmark}: {LABELS[name]}, share of SB3's bytes",
            buffers[benchmark][name]["share_of_sb3"],
            at_most=share,
        )
        for benchmark, shares in AT_MOST.items()
        for name, share in shares.items()
    ]
    for name in ("ours", "optimized"):
        taken = processes[name]
        peak = taken["peak_over_buffer_and_libraries"]
        found.append(goal(f"training: {LABELS[name]}, peak over buffer and libraries", peak, at_most=1.2))
        for when in ("saving", "loading"):
            extra = taken[f"extra_while_{when}"] / taken["buffer"]
            found.append(
                goal(f"{when}: {LABELS[name]}, memory beyond the buffer, share of it", extra, at_most=0.05)
            )
    return found


def tables(result: dict[str, Any]) -> str:
    """Return the result as Markdown tables."""
    labels = result["labels"]
    rows = [
        (
            f"{benchmark}: {labels[name]}",
            f"{held['bytes_per_transition']:.1f}",
            f"{held['total_gb']:.2f} GB",
            f"{held['share_of_sb3']:.3f}",
        )
        for benchmark, contestants in result["buffers"].items()
        for name, held in contestants.items()
    ]
    sizes = markdown_table(("buffer", "bytes per transition", "paper's size", "share of SB3's"), rows)
    columns = ("buffer", "libraries", "peak", "extra_while_saving", "extra_while_loading")
    rows = [
        (
            labels[name],
            *(f"{taken[column] / 1e6:.0f} MB" for column in columns),
            f"{taken['peak_over_buffer_and_libraries']:.2f}",
        )
        for name, taken in result["processes"].items()
    ]
    headings = ("process", *(column.replace("_", " ") for column in columns), "peak / (buffer + libraries)")
    return f"{sizes}\n\n{markdown_table(headings, rows)}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--part", nargs=4, metavar=("PART", "NAME", "ROWS", "PATH"), help="used by the processes it starts"
    )
    arguments = parser.parse_args()
    if arguments.part:
        part, name, rows, path = arguments.part
        print(json.dumps(PARTS[part](name, int(rows), path)))
        return
    result = measure()
    print(tables(result))
    for entry in result["goals"]:
        print(f"{'reached' if entry['reached'] else 'NOT REACHED'}: {entry['goal']}: {entry['measured']:.3f}")


if __name__ == "__main__":
    main()
