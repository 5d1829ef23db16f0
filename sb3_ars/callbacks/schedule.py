"""Lets SMT's schedule say which tasks collect; its rules are core's, how tasks stand still is the model's business."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_ars.callbacks.ars import update_scale_and_networks
from sb3_ars.core.schedule import POOLS, SMTConfig, SMTSchedule
from sb3_ars.errors import ConfigError, EnvContractError, check_verbose

if TYPE_CHECKING:
    from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm

__all__ = ["TaskScheduleCallback"]


class TaskScheduleCallback(BaseCallback):
    """SMT, "hard tasks first" (see `sb3_ars.core.schedule`): a pool of few tasks collects at a time, with budgets.

    The random phase (``learning_starts``) collects every task equally, so that every task has a batch; updates always
    draw equally from all tasks' buffers. From then on the schedule decides between two rollouts. Whenever other tasks
    enter the pool, the networks begin anew as the model's ``reset`` says, with ``updates_after_reset`` gradient steps
    on the kept buffers; resets of the model's own (``n_reset``) come on top. What it remembers is in
    ``model.schedule_state``, so it survives saving; a run continued over a longer total has its first stage stretched,
    unless that has ended. After the run all tasks are active again.

    A reconstruction: beside the choices listed in `sb3_ars.core.schedule`, that random phase, the reset of actor,
    critics, temperatures and optimizers, and the missing reset before the second stage are ours.

    Logged: ``schedule/n_training``, ``schedule/n_main``, ``schedule/n_solved``, ``schedule/n_unsolvable``, the sizes of
    the pools.

    :param config: the options; None is the defaults
    :param verbose: 1 prints who changes pools
    """

    def __init__(self, config: SMTConfig | None = None, verbose: int = 0) -> None:
        super().__init__(check_verbose("verbose", verbose))
        if config is not None and not isinstance(config, SMTConfig):
            raise ConfigError(f"config={config!r} must be an SMTConfig, such as SMTConfig(pool_size=3).")
        self.config = config or SMTConfig()
        self.schedule: SMTSchedule | None = None
        """None in the random phase."""

    @property
    def algorithm(self) -> MultiTaskOffPolicyAlgorithm:
        """The model, typed."""
        return cast("MultiTaskOffPolicyAlgorithm", self.model)

    def _init_callback(self) -> None:
        if not hasattr(self.model, "schedule_state"):
            raise ConfigError(
                f"TaskScheduleCallback chooses among the tasks of ARSSAC and ARSTQC; a {type(self.model).__name__} has "
                "none. Leave it out, or train one of those."
            )

    def _on_training_start(self) -> None:
        if (
            self.parent is not None
        ):  # SB3 2.9.2 (callbacks.py) forwards no rollout hooks to an event's children
            raise ConfigError(
                "A TaskScheduleCallback inside an event callback is never told of rollouts, so it would never decide; "
                "pass it to learn() directly or in a list."
            )
        model = self.algorithm
        self.verbose = max(self.verbose, model.verbose)
        self.config.check_tasks(model.n_tasks)
        self.config.check_length(model._total_timesteps - model.learning_starts)
        if model.num_timesteps == 0:
            model.schedule_state = None
        self.schedule = None
        if model.schedule_state is not None:
            self._check_batch()
            self.schedule = self._make_schedule()
            self.schedule.restore(model.schedule_state)
        # also where all tasks are active: an environment that cannot do this refuses now
        model.set_active_tasks(range(model.n_tasks) if self.schedule is None else self.schedule.active)

    def _on_rollout_start(self) -> None:
        model, schedule = self.algorithm, self.schedule
        if schedule is None:
            if model.num_timesteps >= model.learning_starts and model.has_batch():
                self.schedule = self._make_schedule()
                self._apply(self.schedule, {})
        elif schedule.is_due(model.num_timesteps):
            before = {pool: schedule.tasks(pool) for pool in POOLS}
            new = schedule.decide(model.num_timesteps)
            self._apply(schedule, before)
            if new:
                model.reset_networks()
                update_scale_and_networks(model)

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        # an episode that broke off with its worker says nothing about the task
        ended = [
            env for env in np.flatnonzero(self.locals["dones"]) if not infos[env].get("worker_restarted")
        ]
        if not len(ended):
            return True
        successes = [self._success(int(env)) for env in ended]  # in the random phase too: it may be missing
        if self.schedule is not None:
            for env, success in zip(ended, successes, strict=True):
                self.schedule.add_episode(self.algorithm.task_of_env[env], success)
            self.algorithm.schedule_state = self.schedule.state()
            self._record(self.schedule)  # now, because rows are written where episodes end
        return True

    def _on_training_end(self) -> None:
        if self.schedule is not None:
            self._record(self.schedule)

    def _check_batch(self) -> None:
        model = self.algorithm
        if not model.has_batch():
            raise ConfigError(
                f"The replay buffer lacks batch_size={model.batch_size} rows of some task, and tasks that the schedule "
                "lets wait will not bring them, so nothing would be learned. Use load_replay_buffer to continue a run."
            )

    def _make_schedule(self) -> SMTSchedule:
        model = self.algorithm
        return SMTSchedule(
            self.config, model.n_tasks, model.num_timesteps, model._total_timesteps, seed=model.seed
        )

    def _success(self, env: int) -> float:
        info = self.locals["infos"][env]
        if "is_success" not in info:
            raise EnvContractError(
                f"Task {self._name(self.algorithm.task_of_env[env])!r} ended an episode without is_success, but SMT "
                "ranks the tasks by their success. Let the env report info['success'], or leave the schedule out."
            )
        return float(info["is_success"])

    def _apply(self, schedule: SMTSchedule, before: dict[str, list[int]]) -> None:
        """Let the scheduled tasks collect, remember why, and say what changed."""
        model = self.algorithm
        model.set_active_tasks(schedule.active)
        model.schedule_state = schedule.state()
        if self.verbose < 1:
            return
        changes = []
        for pool in POOLS:
            new = [self._name(task) for task in schedule.tasks(pool) if task not in before.get(pool, [])]
            changes += [f"{pool}: {', '.join(new)}"] * bool(new)
        if changes:
            print(f"Step {model.num_timesteps:,}, schedule stage {schedule.stage}, now {'; '.join(changes)}")

    def _record(self, schedule: SMTSchedule) -> None:
        for pool in POOLS:
            self.logger.record(f"schedule/n_{pool}", len(schedule.tasks(pool)))

    def _name(self, task: int) -> str:
        return (self.algorithm.task_names or [])[task]
