"""Environment steps per second on MT10 and MT50: ours beside the usual ways of stepping stock Meta-World.

    python -m benchmarks.env_steps

All get the same random actions, goals that are visible and drawn anew in each episode, horizon 500 and automatic
resets. In training all episodes are equally long and so reset together, every 500th step. Here a fifth of the
environments do so every 100th step, and a round is a multiple of that: each round has its share of the resets.
The peers step bare stock environments: no Monitor, no one-hot, which ours append.
The floor is MuJoCo alone: a loop around ``mj_step`` (five substeps) on the same models along the same way of the hand,
in as many processes as there are processors, without observations, rewards, resets or anybody to wait for.
"""

from __future__ import annotations

import argparse
import gc
import inspect
import statistics
from collections.abc import Callable
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
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

HORIZON = 500
WARM_UP = 3  # joint steps before each timing
GROUPS = 5  # environments that reset together
UNITS = {"MT10": 500, "MT50": 200}  # joint steps timed in each round: multiples of HORIZON / GROUPS
N_GOALS = 50
PEERS = {
    "sb3-subproc": "SB3 SubprocVecEnv",
    "sb3-dummy": "SB3 DummyVecEnv",
    "gym-async": "Gymnasium AsyncVectorEnv",
    "gym-sync": "Gymnasium SyncVectorEnv",
}
OURS = {
    "ours": ("sb3_ars, workers", {"n_workers": "auto"}),
    "ours-stored": ("sb3_ars, workers, stored goals", {"n_workers": "auto", "goals": "ordered"}),
    "ours-in-process": ("sb3_ars, in process", {"n_workers": 0}),
}
FLOOR = "floor"


class MidEpisode(gym.Wrapper[Any, Any, Any, Any]):
    """Starts its first episode some steps from the beginning, as far as the horizon is concerned."""

    def __init__(self, env: gym.Env[Any, Any], skipped: int) -> None:
        super().__init__(env)
        self.skipped = skipped

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        result = self.env.reset(seed=seed, options=options)
        inner: Any = self.env.unwrapped
        getattr(inner, "sawyer", inner).curr_path_length = self.skipped
        self.skipped = 0
        return result

    def visit_goals(self, n_goals: int) -> None:
        """Reset to so many goals."""
        for _ in range(n_goals):
            self.env.reset()


def stock_task(name: str, skipped: int) -> gym.Env[Any, Any]:
    """Return a stock environment with its goal visible and random."""
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

    env = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{name}-goal-observable"]()
    env._freeze_rand_vec = False
    return MidEpisode(env, skipped)


def our_task(name: str, skipped: int, goals: str) -> gym.Env[Any, Any]:
    """Return one of ours."""
    from sb3_ars.envs.metaworld import MetaworldTask

    env = MetaworldTask(name, goals=goals, n_goals=N_GOALS, max_episode_steps=HORIZON)  # type: ignore[arg-type]
    return MidEpisode(env, skipped)


def task_names(tasks: str) -> tuple[str, ...]:
    """Return the benchmark's tasks."""
    from sb3_ars.envs import metaworld_task_names

    return metaworld_task_names(tasks)


# ---------------------------------------------------------------------- the contestants


def make_peer(tasks: str, peer: str) -> Work:
    """Return the work of stepping a vector environment of SB3 or Gymnasium.

    :param tasks: "MT10" or "MT50"
    :param peer: a key of ``PEERS``
    """
    names = task_names(tasks)  # loads Meta-World before the processes are forked, so that they share it
    gc.freeze()  # else each would copy what the collector touches
    functions: list[Any] = [partial(stock_task, name, _skipped(i)) for i, name in enumerate(names)]
    if peer.startswith("sb3"):
        from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

        # fork, here and below: the same steps, and fifty processes that share what they import
        env: Any = (
            DummyVecEnv(functions) if peer == "sb3-dummy" else SubprocVecEnv(functions, start_method="fork")
        )
    elif peer == "gym-sync":
        env = gym.vector.SyncVectorEnv(functions, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)
    else:
        mode = gym.vector.AutoresetMode.SAME_STEP
        env = gym.vector.AsyncVectorEnv(functions, context="fork", autoreset_mode=mode)
    return _stepping(env, len(names))


def make_ours(tasks: str, n_workers: int | str, goals: str = "random") -> Work:
    """Return the work of stepping our vector environment.

    :param tasks: "MT10" or "MT50"
    :param n_workers: 0 is in process
    :param goals: "ordered" takes 50 stored goals in turn, each visited before, as most are in a long training
    """
    from sb3_ars import make_multitask_env

    names = task_names(tasks)
    functions = {name: partial(our_task, name, _skipped(i), goals) for i, name in enumerate(names)}
    env = make_multitask_env(functions, seed=0, n_workers=n_workers)
    if goals == "ordered":
        env.env_method("visit_goals", N_GOALS)
    return _stepping(env, len(names))


def _skipped(index: int) -> int:
    return HORIZON * (index % GROUPS) // GROUPS


def _stepping(env: Any, n_envs: int) -> Work:
    actions = iter(_Actions(n_envs))
    env.reset()
    return stopwatch(lambda: env.step(next(actions)))


class _Actions:
    """The same random actions for everybody, without end: a horizon's worth again and again."""

    def __init__(self, n_envs: int) -> None:
        self.all = np.random.default_rng(0).uniform(-1, 1, (HORIZON, n_envs, 4)).astype(np.float32)

    def __iter__(self) -> Any:
        while True:
            yield from self.all


# ---------------------------------------------------------------------- the floor


def make_floor(tasks: str, cpus: int) -> Work:
    """Return the work of MuJoCo alone, the environments dealt out to one process per processor."""
    context = get_context("spawn")
    names = task_names(tasks)
    pipes = []
    for process in range(cpus):
        here, there = context.Pipe()
        context.Process(target=_serve_physics, args=(there, names, process, cpus), daemon=True).start()
        pipes.append(here)
    for pipe in pipes:
        pipe.recv()

    def joint(units: int) -> None:
        for pipe in pipes:
            pipe.send(units)
        for pipe in pipes:
            pipe.recv()

    return lambda units: stopwatch(partial(joint, units))(1)


def _serve_physics(pipe: Connection, names: tuple[str, ...], process: int, processes: int) -> None:
    import mujoco

    from sb3_ars.envs.metaworld import MetaworldTask

    actions = _Actions(len(names)).all
    ways = []
    for index in range(process, len(names), processes):
        env = MetaworldTask(names[index])
        env.reset(seed=index)
        sawyer = env.sawyer
        hand = [sawyer.data.mocap_pos[0].copy()]
        for action in actions[:, index, :3]:
            hand.append(np.clip(hand[-1] + action * sawyer.action_scale, sawyer.mocap_low, sawyer.mocap_high))
        effort = actions[:, index, 3:].astype(np.float64) * [1.0, -1.0]
        ways.append((sawyer.model, sawyer.data, sawyer.data.mocap_pos[0], hand[1:], sawyer.data.ctrl, effort))
    pipe.send(None)
    done = 0
    while True:
        units = pipe.recv()
        for step in range(done, done + units):
            at = step % HORIZON
            for model, data, mocap_pos, hand, ctrl, effort in ways:
                mocap_pos[:] = hand[at]
                ctrl[:] = effort[at]
                mujoco.mj_step(model, data, 5)
        done += units
        pipe.send(None)


# ---------------------------------------------------------------------- the benchmark


def contestants(tasks: str, cpus: int, units: int) -> list[Contestant]:
    """Return who is timed on a benchmark.

    On MT50 without our variants: fifty simulators take a gigabyte.

    :param tasks: "MT10" or "MT50"
    :param cpus: processors for each
    :param units: joint steps timed in each round
    """
    makes: dict[str, tuple[str, Callable[[], Work]]] = {
        name: (label, partial(make_peer, tasks, name)) for name, label in PEERS.items()
    }
    ours = OURS if tasks == "MT10" else {"ours": OURS["ours"]}
    makes |= {name: (label, partial(make_ours, tasks, **options)) for name, (label, options) in ours.items()}
    makes[FLOOR] = ("MuJoCo alone", partial(make_floor, tasks, cpus))
    return [Contestant(name, label, make, units, WARM_UP) for name, (label, make) in makes.items()]


def measure(rounds: int = 7, cpus: int = 2, units: dict[str, int] | None = None) -> dict[str, Any]:
    """Return environment steps per second, ratios to the best peer and to the floor, and the goals.

    :param rounds: how often each contestant is timed
    :param cpus: processors for each, its environments' processes included
    :param units: joint steps timed in each round, per benchmark
    """
    units = units or UNITS
    measured, baselines, cost_ratio = {}, {}, {}
    for tasks in units:
        entered = contestants(tasks, cpus, units[tasks])
        # Ten tasks beside fifty, in the same rounds, to compare the cost of a step.
        ten = Contestant("ten", "", partial(make_ours, "MT10", **OURS["ours"][1]), units["MT10"], WARM_UP)
        seconds = interleave([*entered, ten], rounds, cpus)
        n_envs = len(task_names(tasks))
        own = {c.name: [second / n_envs for second in seconds[c.name]] for c in entered}
        cost_ratio[tasks] = speedup(own["ours"], [s / len(task_names("MT10")) for s in seconds["ten"]])
        baselines[tasks] = _best_peer(own)
        measured[tasks] = compare(own, baselines[tasks])
        for name, row in measured[tasks].items():
            row["env_steps_per_second"] = 1 / row["median_seconds"]
            row["share_of_floor"] = speedup(own[FLOOR], own[name])["speedup"]
    return {
        "what": f"stepping Meta-World, horizon {HORIZON}, random goals unless said otherwise, random actions",
        "unit": "seconds per environment step",
        "baselines": baselines,
        "labels": {**PEERS, **{name: label for name, (label, _) in OURS.items()}, FLOOR: "MuJoCo alone"},
        "tasks": measured,
        "cost_beside_mt10": cost_ratio,
        "goals": goals(measured, cost_ratio),
        "machine": machine(cpus),
    }


def _best_peer(seconds: dict[str, list[float]]) -> str:
    return min((name for name in seconds if name in PEERS), key=lambda peer: statistics.median(seconds[peer]))


def goals(
    measured: dict[str, dict[str, Any]], cost_beside_mt10: dict[str, dict[str, float]]
) -> list[dict[str, Any]]:
    """Return the issue's goals with what was measured.

    :param measured: benchmark -> what :func:`~benchmarks.harness.compare` returned
    :param cost_beside_mt10: benchmark -> our cost of an environment step over that on MT10
    """
    found = [
        goal(f"stepping {tasks}: times the best peer", rows["ours"]["speedup"], at_least=3.5)
        for tasks, rows in measured.items()
    ]
    what = "stepping MT50: cost of an environment step over that on MT10"
    return [*found, goal(what, cost_beside_mt10["MT50"]["speedup"], at_most=1.15)]


def main() -> None:
    """Measure, write the file and print the rates."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for option in ("rounds", "cpus"):
        default = inspect.signature(measure).parameters[option].default
        parser.add_argument(f"--{option}", type=int, default=default)
    result = measure(**vars(parser.parse_args()))
    for tasks, rows in result["tasks"].items():
        for name, row in rows.items():
            print(
                f"{tasks}  {result['labels'][name]:32s} {row['env_steps_per_second']:8.0f} steps/s  "
                f"{row['speedup']:5.2f} x best peer  {row['share_of_floor']:5.2f} of the floor"
            )
    print(write_result("env_steps", result))


if __name__ == "__main__":
    main()
