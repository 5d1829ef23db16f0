"""A night in small: thousands of short learn() calls with save, load, evaluation and close; what stays behind?

    python -m benchmarks.lifecycle --calls 2000

Counts processes, open files, shared-memory segments and resident memory of this process. After the first fifth of the
calls, in which libraries fill their caches, none of them may grow.
"""

from __future__ import annotations

import argparse
import gc
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch as th

from benchmarks.harness import machine, write_result
from sb3_ars import ARSSAC, RunCheckpoint, evaluate_tasks, make_toy_env
from sb3_ars.evaluation import EvaluationProtocol

OPTIONS: dict[str, Any] = {
    "n_reset": 0,
    "batch_size": 8,
    "buffer_size": 200,
    "learning_starts": 32,
    "policy_kwargs": {"net_arch": [16]},
    "seed": 0,
}
PROTOCOL = EvaluationProtocol("short", 1, 10, goals=None)
WORKERS_EVERY = 50
"""Every so many calls the environments live in two workers."""


def one_call(number: int, folder: Path) -> None:
    """Make environments, resume or load a model, learn, save, evaluate and close everything.

    :param number: of the call; it decides what is done
    :param folder: of the files
    """
    env = make_toy_env(seed=number, n_workers=2 if number % WORKERS_EVERY == 1 else 0, max_episode_steps=10)
    evaluation_env = make_toy_env(seed=1, max_episode_steps=10)
    if number == 0:
        model = ARSSAC("MlpPolicy", env, **OPTIONS)
    elif number % 2:
        model = ARSSAC.load(folder / "model", env=env)
        model.load_replay_buffer(folder / "buffer")
        shutil.rmtree(folder / "checkpoints")
    else:
        model = ARSSAC.resume(folder / "checkpoints", env)
    checkpoint = RunCheckpoint(folder / "checkpoints", every=20, every_minutes=None)
    model.learn(64, callback=checkpoint, reset_num_timesteps=number == 0)
    model.save(folder / "model")
    model.save_replay_buffer(folder / "buffer")
    evaluate_tasks(model, evaluation_env, PROTOCOL)
    for opened in (env, evaluation_env):
        opened.close()


def look() -> dict[str, float]:
    """Return what this process holds now."""
    gc.collect()
    process = psutil.Process()
    shared = [
        path for path in Path("/dev/shm").iterdir() if path.name.startswith(("sb3_ars", "sem.mp", "torch_"))
    ]
    return {
        "processes": len(process.children(recursive=True)),
        "open_files": process.num_fds(),
        "shared_memory_segments": len(shared),
        "resident_mb": process.memory_info().rss / 1e6,
    }


def lifecycle(n_calls: int, folder: Path, looks: int = 20) -> list[dict[str, float]]:
    """Make so many calls and return what was held in between.

    :param n_calls: how many
    :param folder: for files
    :param looks: how often it is looked
    """
    found = []
    every = max(1, n_calls // looks)
    for number in range(n_calls):
        one_call(number, folder)
        if (number + 1) % every == 0:
            found.append({"calls": number + 1, **look()})
            print(f"\r{number + 1} of {n_calls} calls", end="", file=sys.stderr)
    print(file=sys.stderr)
    return found


def growth(looks: list[dict[str, float]]) -> dict[str, float]:
    """Return how much each grew from the end of the first fifth of the calls to the last look; memory by its trend.

    :param looks: of :func:`lifecycle`
    """
    settled = looks[len(looks) // 5 :]
    grown = {
        key: settled[-1][key] - settled[0][key]
        for key in ("processes", "open_files", "shared_memory_segments")
    }
    calls = [entry["calls"] for entry in settled]
    slope = float(np.polyfit(calls, [entry["resident_mb"] for entry in settled], 1)[0])
    return {**grown, "resident_mb_per_1000_calls": 1000 * slope}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--calls", type=int, default=2000)
    options = parser.parse_args()
    th.set_num_threads(1)
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        looks = lifecycle(options.calls, Path(folder))
    result = {"calls": options.calls, "growth": growth(looks), "seconds": time.monotonic() - started}
    write_result("lifecycle", {**result, "looks": looks, "machine": machine()})
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
