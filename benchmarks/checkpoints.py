"""What a checkpoint costs at the paper's size: time, disk, and memory beyond the buffer's own.

    python -m benchmarks.checkpoints

A model of MT10's size whose buffer holds a million transitions of each of ten tasks: 3.4 GB. The first checkpoint
writes all of them, each later one those that came in ten minutes, at the speed of the CPU and of the GPU that the other
benchmarks' files name. Peaks are the kernel's (VmHWM), so this runs on Linux alone.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from benchmarks.harness import RESULTS, goal, machine, run_alone, write_result
from benchmarks.update import ACTION_DIM, OBS_DIM, Nothing
from sb3_ars import ARSSAC, make_multitask_env
from sb3_ars.algorithms.checkpoint import write_checkpoint
from sb3_ars.checkpoints import CheckpointFolder

N_TASKS, ROWS, MINUTES = 10, 1_000_000, 10.0
SHARE = 0.03
"""Of training time that checkpoints may take, at most."""


def _model(rows: int) -> Any:
    env = make_multitask_env({f"task-{i}": Nothing for i in range(N_TASKS)}, seed=0, n_workers=0)
    options: dict[str, Any] = {"n_reset": 0, "batch_size": 100, "buffer_size": rows, "learning_starts": 1000}
    options["reward_scaling"] = "none"  # these environments pay nothing
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # these few steps leave no updates
        return ARSSAC("MlpPolicy", env, seed=0, **options).learn(1200)


def _fill(model: Any, rows: int) -> None:
    """Let every task's ring take in so many transitions, as if they had been collected."""
    buffer = model.replay_buffer
    for start in range(0, rows, 50_000):
        n = min(50_000, rows - start)
        slots = (buffer.task_pos[0] + np.arange(n)) % buffer.buffer_size
        buffer._storage[:, th.from_numpy(slots)] = th.rand(N_TASKS, n, buffer._storage.shape[2])
        buffer.task_pos[:] = (buffer.task_pos + n) % buffer.buffer_size
        buffer.task_size[:] = np.minimum(buffer.task_size + n, buffer.buffer_size)
        buffer.task_total += n


def _status(key: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{key}:"))


def _measured(model: Any, folder: CheckpointFolder) -> dict[str, float]:
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak counts from here
    before, started = _status("VmRSS"), time.monotonic()
    path = write_checkpoint(model, folder)
    seconds = time.monotonic() - started
    new = max((folder.root / "rows").iterdir(), key=lambda file: file.stat().st_mtime)
    return {
        "seconds": seconds,
        "rows_gb": new.stat().st_size / 1e9,
        "rest_mb": sum(file.stat().st_size for file in path.iterdir()) / 1e6,
        "extra_memory_mb": max(0, _status("VmHWM") - before) / 1e6,
    }


def cost() -> dict[str, Any]:
    """Return what writing and reading cost, in this process."""
    rates = _joint_steps_per_second()
    model = _model(ROWS)
    _fill(model, ROWS)
    with tempfile.TemporaryDirectory(dir=".") as root:
        folder = CheckpointFolder(Path(root))
        found: dict[str, Any] = {"whole": _measured(model, folder)}
        for device, rate in rates.items():
            rows = min(ROWS, round(rate * 60 * MINUTES))
            _fill(model, rows)
            model.num_timesteps += N_TASKS * rows
            entry = _measured(model, folder)
            found[f"ten minutes, {device}"] = {**entry, "share": entry["seconds"] / (60 * MINUTES)}
        env = model.env
        buffer_bytes = model.replay_buffer.memory_bytes()
        del model
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        before, started = _status("VmRSS"), time.monotonic()
        ARSSAC.resume(root, env)
        found["resume"] = {
            "seconds": time.monotonic() - started,
            "extra_memory_mb": max(0, _status("VmHWM") - before - buffer_bytes) / 1e6,
        }
    return {"observation": OBS_DIM, "action": ACTION_DIM, "buffer_gb": buffer_bytes / 1e9, **found}


def _joint_steps_per_second() -> dict[str, float]:
    """Return how often MT10's ten environments step together, one update after each, from what was measured."""
    loop = json.loads((RESULTS / "training_loop.json").read_text(encoding="utf-8"))
    gpu = json.loads((RESULTS / "gpu_mt10.json").read_text(encoding="utf-8"))
    return {"CPU": 1 / loop["contestants"]["fp32"]["median_seconds"], "GPU": gpu["updates_per_second"]}


def main() -> None:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    result = run_alone(cost)
    result["goals"] = [
        goal(f"checkpoints: {name}, share of the time", entry["share"], at_most=SHARE)
        for name, entry in result.items()
        if isinstance(entry, dict) and "share" in entry
    ]
    write_result("checkpoints", {**result, "machine": machine()})
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
