"""RL Zoo (rl_zoo3) with ARSSAC and ARSTQC, and with several tasks behind one id; needs ``sb3-ars[zoo]``.

``python -m sb3_ars.integrations.rl_zoo train --algo arssac --env sb3_ars/toy-v0`` is RL Zoo's own command, with all its
options; so is ``enjoy``, and ``tune`` is ``train -optimize``.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm
from sb3_ars.algorithms.sac import ARSSAC
from sb3_ars.algorithms.tqc import ARSTQC
from sb3_ars.envs.adapters import StepReturn, TaskIdWrapper
from sb3_ars.errors import ConfigError, nearest
from sb3_ars.integrations import gymnasium_env  # registers the ids

try:
    import rl_zoo3.enjoy
    import rl_zoo3.train
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER, convert_offpolicy_params
    from rl_zoo3.utils import ALGOS
except ImportError as error:
    raise ConfigError(f'RL Zoo is missing ({error}): pip install "sb3-ars[zoo]"') from error

if TYPE_CHECKING:
    import optuna

__all__ = ["ALGORITHMS", "MultiTaskExperimentManager", "main", "sample_options"]

ALGORITHMS: dict[str, type[MultiTaskOffPolicyAlgorithm]] = {"arssac": ARSSAC, "arstqc": ARSTQC}
"""RL Zoo's name -> class. Plain ``ars`` is sb3-contrib's Augmented Random Search, and stays so."""


class MultiTaskExperimentManager(ExperimentManager):  # type: ignore[misc]  # RL Zoo's types are not followed
    """RL Zoo's manager, which makes n copies of one id: for an id of several tasks each copy gets a task of its own.

    With several tasks ``n_envs`` is a multiple of their number, one copy each unless given, and in a study the value of
    a trial is the mean success rate, for a mean of unequally scaled rewards says little.
    """

    vec_env_class: Any

    def __init__(self, args: Any, algo: str, env_id: str, *positional: Any, **options: Any) -> None:
        if algo in ALGORITHMS and options.get("config") is None:
            options["config"] = str(Path(__file__).with_name(f"{algo}.yml"))
        super().__init__(args, algo, env_id, *positional, **options)

    @property
    def n_tasks(self) -> int:
        """How many tasks the id stands for; 1 for any other."""
        tasks = gymnasium_env.ENV_IDS.get(self.env_name.gym_id)
        return 1 if tasks is None else len(gymnasium_env.task_names(self.env_kwargs.get("tasks", tasks)))

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return RL Zoo's options twice, to use and to save, with one copy of each task unless ``n_envs`` says more.

        :raises ConfigError: if ``n_envs`` does not give every task as many copies
        """
        options, saved = super().read_hyperparameters()
        if self.n_tasks > 1:
            n_envs = options.setdefault("n_envs", self.n_tasks)
            saved["n_envs"] = n_envs
            if n_envs % self.n_tasks:
                raise ConfigError(
                    f"n_envs={n_envs} cannot be shared out evenly among the {self.n_tasks} tasks of "
                    f"{self.env_name.gym_id}; use {self.n_tasks} or a multiple of it."
                )
        return options, saved

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """Return RL Zoo's environments; with several tasks as many copies, rounded up, as give each task the same.

        :param n_envs: how many
        :param eval_env: whether for evaluation
        :param no_log: whether Monitor writes nothing
        """
        plain: Any = self.vec_env_class
        if self.n_tasks > 1:
            n_envs += -n_envs % self.n_tasks
            self.vec_env_class = partial(_one_task_each, plain, eval_env and self.optimize_hyperparameters)
        try:
            env: VecEnv = super().create_envs(n_envs, eval_env, no_log)
        finally:
            self.vec_env_class = plain
        return env

    def hyperparameters_optimization(self) -> None:
        """Run RL Zoo's study.

        :raises ConfigError: if none of its trials came to its end
        """
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if "No trials are completed yet" not in str(
                error
            ):  # Optuna's words, when RL Zoo asks for the best one
                raise
            raise ConfigError(
                "No trial of the study came to its end: each was pruned or failed, and said why above. Give more "
                "--n-trials, or other options."
            ) from None


class _Tasks(TaskIdWrapper):
    """Several tasks in a VecEnv of RL Zoo's.

    :param venv: whose copies have their tasks
    :param task_of_env: index of each
    :param task_names: one per task
    :param scores_success: report success instead of an episode's return
    """

    def __init__(
        self, venv: VecEnv, task_of_env: list[int], task_names: tuple[str, ...], scores_success: bool
    ) -> None:
        super().__init__(venv, task_of_env, task_names)
        self.scores_success = scores_success

    def step_wait(self) -> StepReturn:
        obs, rewards, dones, infos = super().step_wait()
        if self.scores_success:
            for index in dones.nonzero()[0]:
                infos[index]["episode"] = {**infos[index]["episode"], "r": float(infos[index]["is_success"])}
        return obs, rewards, dones, infos


def sample_options(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """Return options for a trial: the number of resets first, then what RL Zoo varies of SAC.

    :param trial: Optuna's
    :param n_actions: RL Zoo passes it; unused
    :param n_envs: RL Zoo passes it; unused
    :param additional_args: RL Zoo passes it; unused
    """
    sampled = {
        "n_reset": trial.suggest_int("n_reset", 0, 9),
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 2e-3, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 8),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.003, 0.05, log=True),
        "tau": trial.suggest_float("tau", 0.002, 0.02, log=True),
        "net_arch": trial.suggest_categorical("net_arch", ["small", "medium"]),
    }
    options: dict[str, Any] = convert_offpolicy_params(sampled)
    return options


def main() -> None:
    """Run RL Zoo's ``train`` or ``enjoy``; ``tune`` stands for ``train -optimize``.

    :raises ConfigError: for another command
    """
    commands = {"train": rl_zoo3.train.train, "tune": rl_zoo3.train.train, "enjoy": rl_zoo3.enjoy.enjoy}
    name = sys.argv.pop(1) if len(sys.argv) > 1 else ""
    if name not in commands:
        raise ConfigError(
            f"{name!r} is none of {', '.join(commands)}; RL Zoo's other commands do not depend on the algorithm, so "
            "use them as they are." + nearest(name, commands)
        )
    if name == "tune":
        sys.argv.append("--optimize-hyperparameters")
    commands[name]()


def _one_task_each(plain: Any, scores_success: bool, env_fns: list[Any], **options: Any) -> VecEnv:
    """Return a VecEnv of the functions' environments, task after task."""
    venv: VecEnv = plain(env_fns, **options)
    names = tuple(venv.get_attr("task_names", 0)[0])
    # task by task, as everywhere in this package
    task_of_env = [index * len(names) // venv.num_envs for index in range(venv.num_envs)]
    for index, task in enumerate(task_of_env):
        venv.env_method("set_task", task, indices=[index])
    return _Tasks(venv, task_of_env, names, scores_success)


for _name, _algorithm in ALGORITHMS.items():
    ALGOS[_name] = _algorithm
    HYPERPARAMS_SAMPLER[_name] = sample_options
    HYPERPARAMS_CONVERTER[_name] = convert_offpolicy_params
rl_zoo3.train.ExperimentManager = MultiTaskExperimentManager

if __name__ == "__main__":
    try:
        main()
    except ConfigError as _error:
        print(f"error: {_error}", file=sys.stderr)
        sys.exit(2)
