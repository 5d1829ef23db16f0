"""Evaluate a policy task by task under a named protocol; knows models only through ``predict``."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pandas as pd
import torch as th
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization, unwrap_vec_normalize
from tqdm.auto import tqdm

from sb3_ars.envs import make_metaworld_env
from sb3_ars.envs.metaworld import Goals
from sb3_ars.errors import ConfigError, WorkerError, check_count, check_flag, nearest
from sb3_ars.metrics import mean_success, success_rates

__all__ = [
    "PROTOCOLS",
    "EvaluationProtocol",
    "TaskEvaluation",
    "check_evaluation_env",
    "evaluate_tasks",
    "get_protocol",
    "make_evaluation_env",
    "prepare_evaluation_env",
]

Array = npt.NDArray[np.float64]


class Policy(Protocol):
    """Anything with SB3's ``predict``."""

    def predict(self, observation: Any, *, deterministic: bool = False) -> tuple[np.ndarray, Any]:
        """Return actions for a batch of observations."""


@dataclass(frozen=True)
class EvaluationProtocol:
    """What makes two success rates comparable.

    :param name: how reports call it
    :param n_episodes: episodes per task
    :param max_episode_steps: horizon in steps; ``None`` leaves the environment's own
    :param goals: "ordered" goes through the stored goals one by one, so each episode has another goal; ``None`` where
        the tasks are not Meta-World's
    """

    name: str
    n_episodes: int = 10
    max_episode_steps: int | None = 500
    goals: Goals | None = "ordered"

    def describe(self) -> str:
        """Return the protocol in one line, to stand beside every number."""
        horizon = (
            "the env's horizon" if self.max_episode_steps is None else f"horizon {self.max_episode_steps}"
        )
        goals = "" if self.goals is None else f", {self.goals} goals"
        return f"protocol {self.name}: {self.n_episodes} episodes per task, {horizon}{goals}"


PROTOCOLS = {
    "paper": EvaluationProtocol("paper", n_episodes=10, max_episode_steps=500),
    "metaworld": EvaluationProtocol("metaworld", n_episodes=50, max_episode_steps=500),
    "h150": EvaluationProtocol("h150", n_episodes=10, max_episode_steps=150),
    "env": EvaluationProtocol("env", n_episodes=10, max_episode_steps=None, goals=None),
}
"""``paper``: ARS, section 5; ``metaworld``: Meta-World+'s 50 goals; ``h150``: ARS, appendix E.4; ``env``:
tasks that are not Meta-World's, as their environment has them."""


@dataclass(frozen=True)
class TaskEvaluation:
    """Episodes of one policy on every task, arrays of shape ``(n_tasks, n_episodes)``.

    ``success_once``: success at any step; ``success_at_end``: at the last step; both NaN where a task reports none.
    """

    protocol: EvaluationProtocol
    task_names: tuple[str, ...]
    deterministic: bool
    success_once: Array
    success_at_end: Array
    returns: Array
    lengths: Array

    @property
    def success(self) -> Array:
        """``(n_tasks,)`` success rates, at least once, in [0, 1]."""
        return success_rates(self.success_once)

    @property
    def mean_success(self) -> float:
        """Mean success rate of the tasks that report success, NaN if none does."""
        return mean_success(self.success)

    def table(self) -> pd.DataFrame:
        """Return one row per task: success, success at the end, return, length."""
        return pd.DataFrame(
            {
                "success": self.success,
                "success_at_end": self.success_at_end.mean(axis=1),
                "return": self.returns.mean(axis=1),
                "length": self.lengths.mean(axis=1),
            },
            index=pd.Index(self.task_names, name="task"),
        )


def get_protocol(protocol: str | EvaluationProtocol) -> EvaluationProtocol:
    """Return the protocol of that name, or the one given.

    :raises ConfigError: if the name is unknown, or the number of episodes is not positive
    """
    if isinstance(protocol, str):
        if protocol not in PROTOCOLS:
            raise ConfigError(
                f"Unknown evaluation protocol {protocol!r}; choose one of {sorted(PROTOCOLS)}."
                + nearest(protocol, PROTOCOLS)
            )
        return PROTOCOLS[protocol]
    if not isinstance(protocol, EvaluationProtocol):
        raise ConfigError(
            f"protocol={protocol!r} must be one of {sorted(PROTOCOLS)}, or an EvaluationProtocol."
        )
    check_count(f"protocol {protocol.name!r}: n_episodes", protocol.n_episodes)
    if protocol.max_episode_steps is not None:
        check_count(f"protocol {protocol.name!r}: max_episode_steps", protocol.max_episode_steps)
    return protocol


def make_evaluation_env(
    tasks: str | Sequence[str], protocol: str | EvaluationProtocol = "paper", **kwargs: Any
) -> VecEnv:
    """Return Meta-World environments as the protocol wants them: its horizon, its goals.

    :param tasks: what ``make_metaworld_env`` takes
    :param protocol: name or protocol
    :param kwargs: further arguments of ``make_metaworld_env``
    """
    chosen = get_protocol(protocol)
    return make_metaworld_env(
        tasks,
        goals=chosen.goals or "ordered",
        n_goals=max(chosen.n_episodes, kwargs.get("n_envs_per_task", 1)),
        max_episode_steps=chosen.max_episode_steps or 500,
        **{"seed": 0, **kwargs},
    )


def evaluate_tasks(
    model: Policy,
    env: VecEnv | str | Sequence[str],
    protocol: str | EvaluationProtocol = "paper",
    deterministic: bool = True,
    seed: int = 0,
    progress_bar: bool = False,
) -> TaskEvaluation:
    """Run the protocol's episodes on every task and return their outcomes.

    Neither the training environment nor the global torch generator is touched.

    :param model: a trained model
    :param env: a multi-task environment made for evaluation, or what ``make_metaworld_env`` takes
    :param protocol: name or protocol
    :param deterministic: mean actions, or samples
    :param seed: of the sampled actions and of the environment's first reset
    :param progress_bar: whether to show one
    :raises ConfigError: if the environment is the model's own, has no tasks, other tasks than the model, or another
        horizon than the protocol
    """
    chosen = get_protocol(protocol)
    if not callable(getattr(model, "predict", None)):
        raise ConfigError(f"model={model!r} has no predict(); give a trained model or a loaded policy.")
    for option, flag in (("deterministic", deterministic), ("progress_bar", progress_bar)):
        check_flag(option, flag)
    if check_count("seed", seed, minimum=0) > _MAX_SEED:
        raise ConfigError(f"seed={seed!r} must be an integer of at most {_MAX_SEED}.")
    if isinstance(env, gym.Env | gym.vector.VectorEnv):
        raise ConfigError(
            f"env={env!r} has no tasks; make the environment with make_multitask_env or make_metaworld_env, or give "
            "the names of Meta-World tasks."
        )
    if isinstance(env, VecEnv):
        return _evaluate(model, env, chosen, deterministic, seed, progress_bar)
    with closing(make_evaluation_env(env, chosen)) as own:
        return _evaluate(model, own, chosen, deterministic, seed, progress_bar)


def _evaluate(
    model: Policy,
    env: VecEnv,
    protocol: EvaluationProtocol,
    deterministic: bool,
    seed: int,
    progress_bar: bool,
) -> TaskEvaluation:
    prepare_evaluation_env(model, env, protocol)
    tasks: Any = env
    task_names, task_of_env = list(tasks.task_names), np.asarray(tasks.task_of_env)
    wanted = _episodes_of_env(task_of_env, len(task_names), protocol.n_episodes)
    episodes: list[list[dict[str, float]]] = [[] for _ in range(env.num_envs)]
    env.seed(seed)
    obs = env.reset()
    with (
        th.random.fork_rng(),
        tqdm(total=int(wanted.sum()), desc="evaluating", unit="episode", disable=not progress_bar) as bar,
    ):
        th.manual_seed(seed)
        while any(len(done) < n for done, n in zip(episodes, wanted, strict=True)):
            actions, _ = model.predict(obs, deterministic=deterministic)
            obs, _, dones, infos = env.step(actions)
            for index in np.flatnonzero(dones):
                if infos[index].get("worker_restarted"):
                    raise WorkerError(
                        f"The env of task {task_names[task_of_env[index]]!r} was built anew in the middle of the "
                        "evaluation, whose episodes are then not the protocol's. Evaluate again."
                    )
                if len(episodes[index]) < wanted[index]:
                    episodes[index].append(_outcome(infos[index]))
                    bar.update()
    by_task = [
        [e for index in np.flatnonzero(task_of_env == task) for e in episodes[index]]
        for task in range(len(task_names))
    ]
    columns = {key: np.array([[e[key] for e in task] for task in by_task]) for key in _OUTCOMES}
    return TaskEvaluation(protocol, tuple(task_names), deterministic, **columns)


_MAX_SEED = 2**63 - 1  # torch takes no larger one
_OUTCOMES = ("success_once", "success_at_end", "returns", "lengths")


def _outcome(info: dict[str, Any]) -> dict[str, float]:
    return {
        "success_once": float(info.get("is_success", np.nan)),
        "success_at_end": float(info.get("success_at_end", np.nan)),
        "returns": float(info["episode"]["r"]),
        "lengths": float(info["episode"]["l"]),
    }


def prepare_evaluation_env(model: Any, env: VecEnv, protocol: EvaluationProtocol) -> None:
    """Check an evaluation environment, and let it normalise observations as the training environment does now.

    :param model: trained model
    :param env: evaluation environment
    :param protocol: its horizon and goals must be the environment's
    :raises ConfigError: naming what does not fit and the remedy
    """
    check_evaluation_env(model, env, protocol)
    normalizer = unwrap_vec_normalize(env)
    if normalizer is not None:
        normalizer.training = False
        training_env: Any = getattr(model, "env", None)
        if training_env is not None:
            sync_envs_normalization(training_env, env)


def check_evaluation_env(model: Any, env: VecEnv, protocol: EvaluationProtocol) -> None:
    """Raise if the environment is not one to evaluate this model on under this protocol.

    :param model: trained model
    :param env: evaluation environment
    :param protocol: its horizon and goals must be the environment's
    :raises ConfigError: naming what does not fit and the remedy
    """
    if not isinstance(env, VecEnv):
        raise ConfigError(
            f"The evaluation environment {env!r} has no tasks; make it with make_metaworld_env or make_multitask_env."
        )
    training_env: Any = getattr(model, "env", None)
    if training_env is not None and env.unwrapped is training_env.unwrapped:
        raise ConfigError(
            "Evaluation would tear the running episodes of the model's training environment; make a separate one, or "
            "pass the task list and let evaluate_tasks make it."
        )
    if not hasattr(env, "task_names"):
        raise ConfigError(
            "The evaluation environment has no tasks; make it with make_metaworld_env or make_multitask_env."
        )
    trained_on = getattr(model, "task_names", None)
    if trained_on is not None and list(trained_on) != list(env.task_names):
        raise ConfigError(
            f"The model was trained on {list(trained_on)}, but the evaluation environment has {list(env.task_names)}."
        )
    if training_env is not None:
        normalized = [unwrap_vec_normalize(e) is not None for e in (training_env, env)]
        if normalized[0] != normalized[1]:
            raise ConfigError(
                f"Observations were {'' if normalized[0] else 'not '}normalised in training; wrap the evaluation "
                f"environment in VecNormalize(norm_reward=False) {'too' if normalized[0] else 'in neither or both'}."
            )
    _check_protocol(env, protocol)


def _check_protocol(env: Any, protocol: EvaluationProtocol) -> None:
    """Raise if the protocol's words would not be true of the environment."""
    horizon = getattr(env, "max_episode_steps", None)
    if protocol.max_episode_steps is not None and horizon not in (None, protocol.max_episode_steps):
        raise ConfigError(
            f"{protocol.describe()}, but the environment's max_episode_steps is {horizon}. Make it with "
            f"max_episode_steps={protocol.max_episode_steps}, or evaluate under protocol 'env', which takes the "
            "environment's own."
        )
    goals, n_goals = getattr(env, "goals", None), getattr(env, "n_goals", None)
    enough = protocol.goals != "ordered" or (n_goals or 0) >= protocol.n_episodes
    if protocol.goals is not None and (goals != protocol.goals or not enough):
        raise ConfigError(
            f"{protocol.describe()}, but the environment has {goals or 'its own'} goals"
            f"{f', {n_goals} of them' if goals else ''}. Make it with make_evaluation_env(tasks, protocol), or "
            "evaluate under protocol 'env'."
        )


def _episodes_of_env(
    task_of_env: npt.NDArray[np.int64], n_tasks: int, n_episodes: int
) -> npt.NDArray[np.int64]:
    """Share each task's episodes among its environments beforehand: taking the first to end would favour short ones."""
    wanted = np.zeros(len(task_of_env), dtype=np.int64)
    for task in range(n_tasks):
        envs = np.flatnonzero(task_of_env == task)
        wanted[envs] = n_episodes // len(envs)
        wanted[envs[: n_episodes % len(envs)]] += 1
    return wanted
