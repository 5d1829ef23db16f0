"""ARS beside plain multi-task SAC on the toy tasks, several seeds: does every task learn, and is ARS why?

All arms are the preset ``toy`` with the same budget: ``ars``, the same with ``precision="bf16"``, and ``sac`` without
scaling and reset. Success is the share of 50 deterministic episodes per task that touch the goal, on environments of
their own.

    python benchmarks/toy_learning.py --seeds 5
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch as th

from sb3_ars.evaluation import evaluate_tasks
from sb3_ars.experiments.config import RunConfig, load_preset
from sb3_ars.experiments.runner import build_model, make_env, protocol_of
from sb3_ars.versions import run_versions

ARMS = ("ars", "ars-bf16", "sac")
RESULTS = Path(__file__).parent / "results" / "toy_learning.json"


def config_of(arm: str, seed: int) -> RunConfig:
    config = dataclasses.replace(load_preset("toy"), seed=seed)
    evaluation = dataclasses.replace(config.evaluation, n_episodes=50)
    if arm == "sac":
        ars = dataclasses.replace(config.ars, param_resets=None, reward_scaling="none", reset="none")
        config = dataclasses.replace(config, ars=ars)
    if arm == "ars-bf16":
        algorithm = dataclasses.replace(config.algorithm, precision="bf16")
        config = dataclasses.replace(config, algorithm=algorithm)
    return dataclasses.replace(config, evaluation=evaluation)


def final_success(arm: str, seed: int) -> list[float]:
    """Train one arm with one seed and return each task's success, loudest task first."""
    th.set_num_threads(1)
    config = config_of(arm, seed)
    model = build_model(config, make_env(config))
    model.learn(config.algorithm.total_timesteps)
    evaluation_env = make_env(dataclasses.replace(config, seed=1000 + seed))
    return evaluate_tasks(model, evaluation_env, protocol_of(config)).success.tolist()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    jobs = [(arm, seed) for seed in range(arguments.seeds) for arm in ARMS]
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        rows = []
        for job, success in zip(jobs, pool.map(final_success, *zip(*jobs, strict=True)), strict=True):
            rows.append(success)
            print(*job, [round(s, 2) for s in success], flush=True)
    success = {arm: [s for (a, _), s in zip(jobs, rows, strict=True) if a == arm] for arm in ARMS}
    result = {
        "config": dataclasses.asdict(config_of("ars", 0)),
        "seeds": arguments.seeds,
        "success": success,
        "lowest_over_seeds_and_tasks": {arm: float(np.min(success[arm])) for arm in ARMS},
        "mean_per_task": {arm: np.mean(success[arm], axis=0).round(3).tolist() for arm in ARMS},
        "versions": run_versions(),
    }
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(result, indent=2, default=str) + "\n", encoding="utf-8")
    print("  task" + "".join(f"{arm:>10}" for arm in ARMS))
    for task, means in enumerate(zip(*(result["mean_per_task"][arm] for arm in ARMS), strict=True)):
        print(f"{task:>6}" + "".join(f"{mean:10.2f}" for mean in means))
    print(f"written to {RESULTS}")


if __name__ == "__main__":
    main()
