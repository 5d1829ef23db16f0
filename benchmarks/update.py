"""One gradient update at the paper's sizes: ours beside SB3's SAC and SBX's SAC, same rows, same networks.

    python -m benchmarks.update

Everything of an update counts: drawing the batch, critics, actor, temperatures, targets. SB3's and SBX's policies have
one activation for actor and critics, so all contestants have Tanh in both (the paper's actor has ReLU). The peers
sample 1,000 rows from one buffer and have one temperature; ours draws 100 rows of each of ten tasks and has ten
temperatures.
"""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.harness import (
    Contestant,
    Work,
    compare,
    goal,
    interleave,
    machine,
    speedup,
    stopwatch,
    write_result,
)

OBS_DIM, ACTION_DIM = 39, 4
NET_ARCH = (400, 400, 400, 400)
BATCH_SIZE = 100  # rows per task
STORED = 5000  # transitions per task: enough that the rings are larger than the processor's caches
BASELINE = "sb3"


class Nothing(gym.Env[np.ndarray, np.ndarray]):
    """An environment of Meta-World's shapes in which nothing happens; only its spaces matter here."""

    def __init__(self, obs_dim: int = OBS_DIM) -> None:
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (obs_dim,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        return np.zeros(self.observation_space.shape, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return np.zeros(self.observation_space.shape, np.float32), 0.0, False, False, {}


# ---------------------------------------------------------------------- the contestants


def make_ours(
    n_tasks: int,
    batch_size: int = BATCH_SIZE,
    net_arch: Sequence[int] = NET_ARCH,
    stored: int = STORED,
    **options: Any,
) -> Work:
    """Return the work of ``ARSSAC``'s update.

    :param options: ``precision``, ``execution``
    """
    from torch import nn

    from sb3_ars import ARSSAC, make_multitask_env

    env = make_multitask_env({f"task-{task}": Nothing for task in range(n_tasks)}, seed=0, n_workers=0)
    model = ARSSAC(
        "MlpPolicy",
        env,
        batch_size=batch_size,
        buffer_size=stored,
        policy_kwargs={"net_arch": list(net_arch), "activation_fn": nn.Tanh},
        seed=0,
        device="cpu",
        **options,
    )
    prepare(model, n_tasks, stored)
    model.update_reward_scale()
    return stopwatch(lambda: model.train(gradient_steps=1, batch_size=batch_size))


def make_sb3(
    n_tasks: int, batch_size: int = BATCH_SIZE, net_arch: Sequence[int] = NET_ARCH, stored: int = STORED
) -> Work:
    """Return the work of SB3's SAC's update."""
    from stable_baselines3 import SAC
    from torch import nn

    policy_kwargs = {"net_arch": list(net_arch), "activation_fn": nn.Tanh}
    model = SAC(
        "MlpPolicy",
        _plain_env(n_tasks),
        buffer_size=stored * n_tasks,
        policy_kwargs=policy_kwargs,
        seed=0,
        device="cpu",
    )
    prepare(model, n_tasks, stored)
    return stopwatch(lambda: model.train(gradient_steps=1, batch_size=batch_size * n_tasks))


def make_sbx(
    n_tasks: int, batch_size: int = BATCH_SIZE, net_arch: Sequence[int] = NET_ARCH, stored: int = STORED
) -> Work:
    """Return the work of SBX's SAC's update, waited for: JAX hands work out and returns at once."""
    import jax
    from flax import linen
    from sbx import SAC

    policy_kwargs = {"net_arch": list(net_arch), "activation_fn": linen.tanh}
    model = SAC(
        "MlpPolicy", _plain_env(n_tasks), buffer_size=stored * n_tasks, policy_kwargs=policy_kwargs, seed=0
    )
    prepare(model, n_tasks, stored)

    def update() -> None:
        model.train(gradient_steps=1, batch_size=batch_size * n_tasks)
        policy = model.policy
        jax.block_until_ready((policy.qf_state, policy.actor_state, model.ent_coef_state))

    update()  # compiles
    return stopwatch(update)


def _plain_env(n_tasks: int) -> Any:
    """Return as many environments as tasks, the one-hot part of the observation as one task knows it."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    return DummyVecEnv([partial(Nothing, OBS_DIM + n_tasks)] * n_tasks)


def prepare(model: Any, n_tasks: int, stored: int) -> None:
    """Fill the buffer with noise, and give the model the logger that ``learn`` would."""
    from stable_baselines3.common.logger import configure

    model.set_logger(configure(None, []))
    rng = np.random.default_rng(0)
    one_hot = np.eye(n_tasks, dtype=np.float32)
    for _ in range(stored):
        obs, next_obs = (
            np.hstack([rng.standard_normal((n_tasks, OBS_DIM), np.float32), one_hot]) for _ in range(2)
        )
        action = rng.uniform(-1.0, 1.0, (n_tasks, ACTION_DIM)).astype(np.float32)
        reward = rng.uniform(0.0, 10.0, n_tasks).astype(np.float32)
        model.replay_buffer.add(obs, next_obs, action, reward, np.zeros(n_tasks, bool), [{}] * n_tasks)


OURS = {
    "eager": ("sb3_ars, eager fp32", {"precision": "fp32", "execution": "eager"}),
    "fp32": ("sb3_ars, fp32", {"precision": "fp32", "execution": "fused"}),
    "bf16": ("sb3_ars, bf16", {"precision": "bf16", "execution": "fused"}),
}
PEERS: dict[str, tuple[str, Callable[..., Work]]] = {
    "sb3": ("SB3 SAC", make_sb3),
    "sbx": ("SBX SAC (JAX)", make_sbx),
}


def contestants(n_tasks: int, units: int, sizes: dict[str, Any] | None = None) -> list[Contestant]:
    """Return the peers that are installed, and ours.

    :param n_tasks: tasks, and so hundreds of rows
    :param units: updates timed in each round
    :param sizes: smaller ``batch_size``, ``net_arch``, ``stored``, for tests
    """
    makes = {
        **PEERS,
        **{name: (label, partial(make_ours, **options)) for name, (label, options) in OURS.items()},
    }
    if find_spec("sbx") is None:
        print("SBX is left out: pip install -e '.[benchmarks]' brings it.")
        del makes["sbx"]
    return [
        Contestant(f"{name}-{n_tasks}", label, partial(make, n_tasks, **(sizes or {})), units=units)
        for name, (label, make) in makes.items()
    ]


# ---------------------------------------------------------------------- the benchmark


def measure(rounds: int = 9, cpus: int = 2, sizes: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return times and ratios at 10 and at 50 tasks, and the goals.

    :param rounds: how often each contestant is timed
    :param cpus: processors for each
    :param sizes: see :func:`contestants`
    """
    entered = {10: contestants(10, 5, sizes), 50: contestants(50, 2, sizes)}
    seconds = interleave([c for chosen in entered.values() for c in chosen], rounds, cpus)
    measured = {
        str(n_tasks): compare({c.name.removesuffix(f"-{n_tasks}"): seconds[c.name] for c in chosen}, BASELINE)
        for n_tasks, chosen in entered.items()
    }
    return {
        "what": f"one update, {BATCH_SIZE} rows a task, networks {list(NET_ARCH)}, Tanh",
        "unit": "seconds per update",
        "sizes": sizes or {"batch_size": BATCH_SIZE, "net_arch": NET_ARCH, "stored": STORED},
        "baseline": BASELINE,
        "labels": {c.name.removesuffix("-10"): c.label for c in entered[10]},
        "tasks": measured,
        "goals": goals(measured),
        "machine": machine(cpus),
    }


def goals(measured: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the issue's goals with what was measured.

    :param measured: tasks -> what :func:`~benchmarks.harness.compare` returned
    """
    ten, fifty = measured["10"], measured["50"]
    found = [
        goal("update, 10 tasks: fp32, times as fast as SB3", ten["fp32"]["speedup"], at_least=1.6),
        goal("update, 10 tasks: bf16, times as fast as SB3", ten["bf16"]["speedup"], at_least=2.7),
    ]
    if "sbx" in ten:
        ratio = speedup(ten["sbx"]["seconds"], ten["bf16"]["seconds"])["speedup"]
        found.append(goal("update, 10 tasks: bf16, times as fast as SBX", ratio, at_least=1.0))
    for name in ("fp32", "bf16"):
        ratio = speedup(fifty[name]["seconds"], ten[name]["seconds"])["speedup"] / 5
        found.append(goal(f"update: {name}, cost per row at 50 tasks over that at 10", ratio, at_most=1.0))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=inspect.signature(measure).parameters["rounds"].default)
    parser.add_argument("--cpus", type=int, default=2)
    arguments = parser.parse_args()
    result = measure(arguments.rounds, arguments.cpus)
    print(write_result("update", result))


if __name__ == "__main__":
    main()
