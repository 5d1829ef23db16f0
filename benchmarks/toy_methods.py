"""Every method with and without ARS on the toy tasks, several seeds: what does each learn, and what does ARS add?

    python -m benchmarks.toy_methods --seeds 5 --processes 2      # goes on where it stopped; --fresh starts over

An arm is a preset of the paper's ten tasks brought to the four toy tasks (:func:`toy_config`): its method at small
sizes, everything else as in the preset ``toy``, the same budget for all. Success is the share of 50 deterministic
episodes per task that touch the goal, on environments of their own.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import json
import os
import sys
import tempfile
import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import redirect_stdout
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import RESULTS, machine, threads_environment, write_result
from sb3_ars.envs import make_toy_env
from sb3_ars.envs.toy import TOY_TASKS
from sb3_ars.experiments import preset_names
from sb3_ars.experiments.config import RunConfig, load_preset
from sb3_ars.experiments.scaling import load_scale, scaled

SCALE = load_scale("toy")
TOTAL_TIMESTEPS = len(TOY_TASKS) * (SCALE.steps_per_task or 0)
LEARNING_RATE = SCALE.options["algorithm"]["learning_rate"]
EPISODES = SCALE.options["evaluation"]["n_episodes"]

ARMS = {
    "sac": "mt10-sac",
    "ars": "mt10-ars",
    "ars-bf16": "mt10-ars",
    "ars-ln": "mt10-ars-ln",
    "ars-lora": "mt10-ars-lora",
    "ars-lora-paper": "mt10-ars-lora-paper",
    **{
        f"{method}{ars}": f"mt10-{method}{ars}"
        for method in ("mh", "soft-modules", "soft-modules-reweighted", "pcgrad", "paco", "moore", "tqc")
        for ars in ("", "-ars")
    },
    "popart": "mt10-popart-10",
    "smt": "mt10-smt",
}
"""Arm -> the preset its method is taken from; ``ars-bf16`` is ``ars`` with ``precision="bf16"``."""


# ---------------------------------------------------------------------- from a preset to the toy tasks


def toy_config(preset: str, seed: int, total_timesteps: int = TOTAL_TIMESTEPS) -> RunConfig:
    """Return a preset's method on the toy tasks: at the scale ``toy``, but with one reset for all that reset.

    It is at a quarter of the run, as in the preset ``toy``, with another where adapters start. Nothing is evaluated
    during training.

    :param preset: any of :func:`~sb3_ars.experiments.preset_names`
    :param seed: of the run
    :param total_timesteps: environment steps, all four tasks together; with batches of the toy's size 1,600 or more
    """
    scale = dataclasses.replace(SCALE, resets_at=(0.25,), evaluations=0)
    config = scaled(load_preset(preset), scale.lasting(total_timesteps // len(TOY_TASKS)))
    return dataclasses.replace(config, seed=seed)


# ---------------------------------------------------------------------- one run


def arm_config(arm: str, seed: int, total_timesteps: int = TOTAL_TIMESTEPS) -> RunConfig:
    """Return the configuration of an arm.

    :param arm: of ``ARMS``
    :param seed: of the run
    :param total_timesteps: see :func:`toy_config`
    """
    config = toy_config(ARMS[arm], seed, total_timesteps)
    if arm == "ars-bf16":  # in the layers that users of bf16 get
        algorithm = dataclasses.replace(config.algorithm, precision="bf16", execution="auto")
        config = dataclasses.replace(config, algorithm=algorithm)
    return config


def train_arm(arm: str, seed: int, total_timesteps: int = TOTAL_TIMESTEPS) -> dict[str, Any]:
    """Train one arm with one seed on one core; return each task's success, loudest task first, and what it took.

    :param arm: of ``ARMS``
    :param seed: of the run
    :param total_timesteps: see :func:`toy_config`
    """
    import torch as th

    from sb3_ars.experiments.runner import train

    th.set_num_threads(1)
    with (
        tempfile.TemporaryDirectory() as folder,
        Path(os.devnull).open("w") as nowhere,
        redirect_stdout(nowhere),
    ):
        config = dataclasses.replace(arm_config(arm, seed, total_timesteps), output=Path(folder))
        run = train(config, arm, progress_bar=False)
        written = json.loads((run.folder / "result.json").read_text(encoding="utf-8"))
    return {
        "success": run.table["success"].tolist(),
        "success_sampled": run.table["success_sampled"].tolist(),
        "seconds": run.seconds,
        **{name: written[name] for name in ("updates", "resets", "reward_scale_history")},
    }


# ---------------------------------------------------------------------- all runs


def measure(
    arms: list[str],
    seeds: int,
    processes: int,
    folder: Path,
    fresh: bool,
    total_timesteps: int = TOTAL_TIMESTEPS,
) -> list[str]:
    """Train what is not in the file yet, and write the file after every run; return the runs that failed.

    :param arms: of ``ARMS``
    :param seeds: 0 to this, without it
    :param processes: runs at a time, a core each
    :param folder: of ``toy_methods.json``
    :param fresh: start over instead of going on
    :param total_timesteps: see :func:`toy_config`
    :raises SystemExit: if the file is of another budget
    """
    result = _started(folder, total_timesteps, fresh)
    number = _machine_number(result["machines"], machine(processes))
    jobs = [(arm, seed) for seed in range(seeds) for arm in _available(arms)]
    waiting = [(arm, seed) for arm, seed in jobs if str(seed) not in result["runs"].get(arm, {})]
    print(f"{len(jobs)} runs, {len(jobs) - len(waiting)} of them are in the file already", flush=True)
    os.environ.update(threads_environment(1))  # read when torch loads, in the processes
    failed, started = [], time.monotonic()
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(train_arm, arm, seed, total_timesteps): (arm, seed) for arm, seed in waiting}
        for count, future in enumerate(as_completed(futures), start=1):
            arm, seed = futures[future]
            name = f"[{count}/{len(waiting)}] {arm}, seed {seed}"
            try:
                run = future.result()
            except Exception:  # one arm that fails must not lose the others
                failed.append(f"{arm}, seed {seed}")
                print(f"{name}: FAILED", traceback.format_exc(), sep="\n", file=sys.stderr, flush=True)
                continue
            result["runs"].setdefault(arm, {})[str(seed)] = {**run, "machine": number}
            write_result("toy_methods", result, folder)
            left = (time.monotonic() - started) / count * (len(waiting) - count) / 60
            success = " ".join(f"{value:.2f}" for value in run["success"])
            print(f"{name}: {success}, {run['seconds']:.0f} s; about {left:.0f} minutes left", flush=True)
    return failed


def _available(arms: list[str]) -> list[str]:
    names = preset_names()
    for arm in arms:
        if ARMS[arm] not in names:
            print(f"{arm} is left out: there is no preset {ARMS[arm]}")
    return [arm for arm in arms if ARMS[arm] in names]


def _started(folder: Path, total_timesteps: int, fresh: bool) -> dict[str, Any]:
    """Return the result so far."""
    path = folder / "toy_methods.json"
    settings = {"total_timesteps": total_timesteps, "learning_rate": LEARNING_RATE, "episodes": EPISODES}
    if fresh or not path.is_file():
        return {
            "what": "success of each toy task, loudest first, at the end of training; deterministic policy",
            "reward_scales": inspect.signature(make_toy_env).parameters["reward_scales"].default,
            "settings": settings,
            "ars": dataclasses.asdict(toy_config(ARMS["ars"], 0, total_timesteps)) | {"output": None},
            "arms": ARMS,
            "machines": [],
            "runs": {},
        }
    result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    if result["settings"] != settings:
        sys.exit(f"{path} holds runs with {result['settings']}, not {settings}; --fresh starts over.")
    return {**result, "arms": ARMS}


def _machine_number(machines: list[dict[str, Any]], own: dict[str, Any]) -> int:
    """Return the index of this machine, with these versions and this commit, in the list; append it if it is new."""
    own = {key: value for key, value in own.items() if key != "date"}
    rounded = json.loads(json.dumps(own))
    if rounded not in machines:
        machines.append(rounded)
    return machines.index(rounded)


def summary(runs: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return an arm's success: mean of each task over seeds, of all tasks, lowest of any task and seed.

    :param runs: seed -> what :func:`train_arm` returned
    """
    success = np.array([run["success"] for run in runs.values()])
    return {
        "seeds": len(success),
        "tasks": success.mean(axis=0).tolist(),
        "mean": float(success.mean()),
        "lowest": float(success.min()),
        "lowest_task": float(success.mean(axis=0).min()),
    }


def main(arguments: list[str] | None = None) -> int:
    defaults = inspect.signature(measure).parameters
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--processes", type=int, default=2, help="a core each")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS), help="these alone")
    parser.add_argument("--fresh", action="store_true", help="start over")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the file")
    parser.add_argument("--timesteps", type=int, default=defaults["total_timesteps"].default)
    given = parser.parse_args(arguments)
    failed = measure(given.arms, given.seeds, given.processes, given.output, given.fresh, given.timesteps)
    if failed:
        print("failed:", *failed, sep="\n  ", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
