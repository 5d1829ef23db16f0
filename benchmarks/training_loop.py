"""Environment steps per second of the whole training loop on MT10: ours beside SB3's SAC on stock Meta-World.

    python -m benchmarks.training_loop

The paper's sizes: ten environments, random goals, horizon 500; one update of 1,000 rows after each joint step. The peer
is SB3's SAC on SB3's SubprocVecEnv, each environment stock Meta-World with its goal visible and the task's one-hot
appended. All contestants have the same networks, [400]*4 with Tanh (see benchmarks/update.py). What is timed lies
behind the random phase and within an episode; every 500th joint step also resets all environments.
"""

from __future__ import annotations

import argparse
import inspect
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from queue import SimpleQueue
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.env_steps import stock_task, task_names
from benchmarks.harness import Contestant, Work, compare, goal, interleave, machine, run_alone, write_result
from benchmarks.update import BATCH_SIZE, NET_ARCH

TASKS = "MT10"
HORIZON = 500
STORED = 10_000  # transitions per task
LOG_INTERVAL = 10  # episodes
PARTS_STEPS = 510  # joint steps for the time by part: an episode's end, resets and log within them
OUTSIDE = ("act", "store", "log", "other")  # parts that are neither stepping nor the update
BASELINE = "sb3"


class StockTask(gym.Env[np.ndarray, np.ndarray]):
    """Stock Meta-World as an SB3 user would wrap it: goal visible, a new goal each episode, one-hot appended."""

    def __init__(self, name: str, task: int, n_tasks: int) -> None:
        self.stock: Any = stock_task(name, skipped=0).unwrapped
        self.one_hot = np.eye(n_tasks, dtype=np.float32)[task]
        width = self.stock.observation_space.shape[0] + n_tasks
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, self.stock.action_space.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        obs, info = self.stock.reset()
        return self._with_task(obs), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.stock.step(action)
        return self._with_task(obs), float(reward), terminated, truncated, info

    def _with_task(self, obs: np.ndarray) -> np.ndarray:
        return np.concatenate([obs, self.one_hot], dtype=np.float32)


# ---------------------------------------------------------------------- the contestants


def make_ours(
    tasks: str | Sequence[str] = TASKS,
    batch_size: int = BATCH_SIZE,
    net_arch: Sequence[int] = NET_ARCH,
    **options: Any,
) -> Work:
    """Return the work of ``ARSSAC`` on our environments.

    :param options: ``precision``, ``execution``, ``overlap``
    """
    return paced(_our_model(tasks, batch_size, net_arch, options), batch_size)


def parts(
    units: int,
    tasks: str | Sequence[str] = TASKS,
    batch_size: int = BATCH_SIZE,
    net_arch: Sequence[int] = NET_ARCH,
    **options: Any,
) -> dict[str, float]:
    """Return the seconds that each part of our loop takes in so many joint steps.

    :param units: joint steps behind the random phase
    :param options: ``precision``, ``execution``, ``overlap``
    """
    from sb3_ars.profiling import PartTimer

    model = _our_model(tasks, batch_size, net_arch, options)
    work = paced(model, batch_size)
    model.timer = timer = PartTimer()
    work(units)
    return timer.seconds()


def _our_model(
    tasks: str | Sequence[str], batch_size: int, net_arch: Sequence[int], options: dict[str, Any]
) -> Any:
    from torch import nn

    from sb3_ars import ARSSAC, make_metaworld_env

    env = make_metaworld_env(tasks, seed=0, max_episode_steps=HORIZON)
    return ARSSAC(
        "MlpPolicy",
        env,
        learning_starts=batch_size * env.n_tasks,
        batch_size=batch_size,
        buffer_size=STORED,
        n_reset=0,
        policy_kwargs={"net_arch": list(net_arch), "activation_fn": nn.Tanh},
        seed=0,
        device="cpu",
        **options,
    )


def make_sb3(
    tasks: str | Sequence[str] = TASKS, batch_size: int = BATCH_SIZE, net_arch: Sequence[int] = NET_ARCH
) -> Work:
    """Return the work of SB3's SAC on its SubprocVecEnv."""
    from stable_baselines3 import SAC
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import SubprocVecEnv
    from torch import nn

    names = task_names(tasks)
    env = SubprocVecEnv([partial(_monitored, Monitor, name, i, len(names)) for i, name in enumerate(names)])
    model = SAC(
        "MlpPolicy",
        env,
        learning_starts=batch_size * len(names),
        batch_size=batch_size * len(names),
        buffer_size=STORED * len(names),
        train_freq=1,
        gradient_steps=1,
        policy_kwargs={"net_arch": list(net_arch), "activation_fn": nn.Tanh},
        seed=0,
        device="cpu",
    )
    return paced(model, batch_size)


def _monitored(monitor: Callable[[gym.Env[Any, Any]], Any], name: str, task: int, n_tasks: int) -> Any:
    return monitor(StockTask(name, task, n_tasks))


def paced(model: Any, random_steps: int) -> Work:
    """Return the work of one endless ``learn()``: so many joint steps at a time, standing still in between.

    :param model: of SB3 or ours
    :param random_steps: joint steps before the first update, left behind here
    """
    orders: SimpleQueue[int] = SimpleQueue()
    answers: SimpleQueue[float | BaseException] = SimpleQueue()

    def learn() -> None:
        try:
            model.learn(10**9, callback=_pacing(orders, answers), log_interval=LOG_INTERVAL)
        except BaseException as error:
            answers.put(error)

    thread = threading.Thread(target=learn, daemon=True)
    thread.start()

    def work(units: int) -> float:
        orders.put(units)
        answer = answers.get()
        if isinstance(answer, BaseException):
            raise answer
        return answer

    work(random_steps + 2)
    return work


def _pacing(orders: SimpleQueue[int], answers: SimpleQueue[float | BaseException]) -> Any:
    """Return a callback that waits for an order, lets so many joint steps pass, and answers with the seconds."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Pacing(BaseCallback):
        remaining = 0
        started = 0.0

        def _wait(self) -> None:
            self.remaining = orders.get()
            self.started = time.perf_counter()

        def _on_training_start(self) -> None:
            self._wait()

        def _on_step(self) -> bool:
            self.remaining -= 1
            if self.remaining == 0:
                answers.put(time.perf_counter() - self.started)
                self._wait()
            return True

    return Pacing()


OURS = {
    "fp32": ("sb3_ars, fp32", {"precision": "fp32", "overlap": False}),
    "fp32-overlap": ("sb3_ars, fp32, overlapped", {"precision": "fp32", "overlap": True}),
    "bf16": ("sb3_ars, bf16", {"precision": "bf16", "overlap": False}),
    "bf16-overlap": ("sb3_ars, bf16, overlapped", {"precision": "bf16", "overlap": True}),
}


def contestants(units: int, sizes: dict[str, Any] | None = None) -> list[Contestant]:
    """Return SB3's loop and ours.

    :param units: joint steps timed in each round
    :param sizes: smaller ``tasks``, ``batch_size``, ``net_arch``, for tests
    """
    makes: dict[str, tuple[str, Callable[..., Work]]] = {BASELINE: ("SB3 SAC, SubprocVecEnv", make_sb3)}
    makes |= {name: (label, partial(make_ours, **options)) for name, (label, options) in OURS.items()}
    return [
        Contestant(name, label, partial(make, **(sizes or {})), units=units, warm_up=3)
        for name, (label, make) in makes.items()
    ]


# ---------------------------------------------------------------------- the benchmark


def measure(
    rounds: int = 9,
    units: int = 20,
    cpus: int = 2,
    parts_units: int = PARTS_STEPS,
    sizes: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return environment steps per second and ratios, and the goals.

    :param rounds: how often each contestant is timed
    :param units: joint steps in each round
    :param cpus: processors for each, its environments' processes included
    :param parts_units: joint steps over which the time by part is summed
    :param sizes: see :func:`contestants`
    """
    entered = contestants(units, sizes)
    measured = compare(interleave(entered, rounds, cpus), BASELINE)
    seconds_by_part = {
        name: run_alone(partial(parts, parts_units, **(sizes or {}), **OURS[name][1]), cpus)
        for name in ("fp32", "bf16")
    }
    n_envs = len(task_names((sizes or {}).get("tasks", TASKS)))
    for row in measured.values():
        row["env_steps_per_second"] = n_envs / row["median_seconds"]
    return {
        "what": f"training loop on {TASKS}, {BATCH_SIZE} rows a task, one update per joint step, "
        f"networks {list(NET_ARCH)}, horizon {HORIZON}, random goals",
        "unit": "seconds per joint step of all environments",
        "sizes": sizes or {"tasks": TASKS, "batch_size": BATCH_SIZE, "net_arch": NET_ARCH},
        "baseline": BASELINE,
        "labels": {c.name: c.label for c in entered},
        "contestants": measured,
        "seconds_by_part": seconds_by_part,
        "goals": [*goals(measured), *parts_goals(seconds_by_part)],
        "machine": machine(cpus),
    }


def goals(measured: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the issue's goals with what was measured; of overlap on and off the faster counts.

    :param measured: what :func:`~benchmarks.harness.compare` returned
    """
    found = []
    for precision, wanted in (("bf16", 2.5), ("fp32", 1.5)):
        best = max(measured[name]["speedup"] for name in measured if name.startswith(precision))
        what = f"training loop, MT10: {precision}, times SB3's env steps per second"
        found.append(goal(what, best, at_least=wanted))
    return found


def parts_goals(seconds_by_part: dict[str, dict[str, float]]) -> list[dict[str, Any]]:
    """Return the issue's goal for what is neither stepping nor the update.

    :param seconds_by_part: contestant -> part -> seconds
    """
    found = []
    for name, seconds in seconds_by_part.items():
        share = 100 * sum(seconds.get(part, 0.0) for part in OUTSIDE) / sum(seconds.values())
        what = f"training loop, MT10: {name}, % of the time outside stepping and the update"
        found.append(goal(what, share, at_most=10.0))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    defaults = inspect.signature(measure).parameters
    for option in ("rounds", "units", "cpus"):
        parser.add_argument(f"--{option}", type=int, default=defaults[option].default)
    print(write_result("training_loop", measure(**vars(parser.parse_args()))))


if __name__ == "__main__":
    main()
