"""A run that is killed at random moments, checkpoint writing included, and resumed each time: does it end the same?

    python -m benchmarks.soak --kills 100

The toy tasks, two resets, a checkpoint every 60 environment steps, so that much of the time goes into writing them.
Each life is a process of its own (forked, so that Python's start does not count), killed with SIGKILL a random while
after it began to train; the next goes on from the newest checkpoint. Once it has been killed so often, the run is left
to end. It must then equal the run that nobody killed, to the bit, and no life may have found a checkpoint that it could
not use.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import random
import signal
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.harness import machine, write_result
from sb3_ars import ARSSAC, RunCheckpoint, make_toy_env

EVERY = 60
OPTIONS: dict[str, Any] = {
    "n_reset": 2,
    "batch_size": 16,
    "buffer_size": 600,
    "updates_after_reset": 20,
    "learning_starts": 400,
    "policy_kwargs": {"net_arch": [16, 16]},
    "seed": 0,
}


class Tell(BaseCallback):
    """Says when training begins, and at which steps checkpoints may be under way."""

    def __init__(self, connection: Any) -> None:
        super().__init__()
        self.connection = connection

    def _on_training_start(self) -> None:
        if self.connection is not None:
            self.connection.send(self.num_timesteps)

    def _on_step(self) -> bool:
        return True


def live(folder: Path, total: int, connection: Any = None) -> None:
    """Train from the newest checkpoint, or from the beginning, to the end; then write what it came to.

    :param folder: of the run
    :param total: environment steps of the whole run
    :param connection: told the step at which training begins
    """
    th.set_num_threads(1)
    warnings.simplefilter("error")  # a checkpoint that is named as damaged is a failure here
    env = make_toy_env(seed=0)
    checkpoints = folder / "checkpoints"
    callback = [RunCheckpoint(checkpoints, every=EVERY, every_minutes=None), Tell(connection)]
    if any(checkpoints.glob("step-*[0-9]")):
        model = ARSSAC.resume(checkpoints, env)
    else:
        model = ARSSAC("MlpPolicy", env, **OPTIONS)
    steps = model.num_timesteps
    model.learn(total - steps, callback=callback, reset_num_timesteps=steps == 0)
    buffer: Any = model.replay_buffer
    np.savez(
        folder / "end.npz",
        parameters=th.cat([p.detach().flatten() for p in model.policy.parameters()]).numpy(),
        rewards=buffer.rewards.numpy(),
        observations=buffer.observations.numpy(),
        scale=model.reward_scale.scale.numpy(),
        temperatures=model.log_ent_coef.detach().numpy() if model.log_ent_coef is not None else np.zeros(0),
        counts=np.array([model.num_timesteps, model._n_updates, model.n_resets]),
    )


def soak(n_kills: int, total: int, folder: Path, seed: int = 0, longest: float = 0.6) -> dict[str, Any]:
    """Kill a run so often and let it end; return what was seen.

    :param n_kills: lives that are ended
    :param total: environment steps of the run; it must last longer than the lives together
    :param folder: for the run and its uninterrupted twin
    :param seed: of the moments
    :param longest: seconds that a life trains for at most
    """
    rng = random.Random(seed)
    context = multiprocessing.get_context("fork")
    whole, killed = folder / "whole", folder / "killed"
    for run in (whole, killed):
        run.mkdir(parents=True)
    _run(context, whole, total)
    lives: list[dict[str, Any]] = []
    for number in range(n_kills):
        here, there = context.Pipe()
        process = context.Process(target=live, args=(killed, total, there))
        process.start()
        there.close()
        if not here.poll(120):
            raise RuntimeError(f"Life {number} did not begin to train within two minutes.")
        try:
            step = here.recv()
        except EOFError:
            process.join()
            raise RuntimeError(
                f"Life {number} could not go on: exit code {process.exitcode}; its traceback is on the error output."
            ) from None
        process.join(rng.uniform(0.0, longest))
        if not process.is_alive():
            raise RuntimeError(f"The run ended in life {number}, before all kills; give it a larger total.")
        process.kill()
        process.join()
        writing = list(killed.rglob("*.writing"))
        lives.append({"began_at": step, "while_writing": bool(writing)})
        print(f"\r{number + 1} of {n_kills} kills, at step {step:,} of {total:,}", end="", file=sys.stderr)
    print(file=sys.stderr)
    _run(context, killed, total)
    with np.load(whole / "end.npz") as a, np.load(killed / "end.npz") as b:
        differing = [key for key in a.files if not np.array_equal(a[key], b[key])]
        counts = a["counts"].tolist()
    return {
        "kills": n_kills,
        "kills_while_a_file_was_written": sum(found["while_writing"] for found in lives),
        "lives_that_found_no_usable_checkpoint": sum(
            before["began_at"] > found["began_at"] for before, found in itertools.pairwise(lives)
        ),
        "steps": counts[0],
        "updates": counts[1],
        "resets": counts[2],
        "checkpoint_every": EVERY,
        "differing": differing,
        "lives": lives,
    }


def _run(context: Any, folder: Path, total: int) -> None:
    process = context.Process(target=live, args=(folder, total))
    process.start()
    process.join()
    if process.exitcode != 0:
        raise RuntimeError(f"The run in {folder} ended with exit code {process.exitcode}.")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--steps", type=int, default=40_000, help="environment steps of the run")
    options = parser.parse_args()
    th.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        result = soak(options.kills, options.steps, Path(folder))
    result |= {"seconds": time.monotonic() - started, "machine": machine()}
    write_result("soak", result)
    print(
        json.dumps({key: value for key, value in result.items() if key not in ("lives", "machine")}, indent=2)
    )
    if result["differing"] or result["lives_that_found_no_usable_checkpoint"]:
        sys.exit("The killed run is not the whole run.")


if __name__ == "__main__":
    main()
