"""Evaluates per task during training and keeps the best model by mean success; must not touch the training env."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EventCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_ars.errors import ConfigError, check_count, check_flag, check_path, check_verbose
from sb3_ars.evaluation import (
    EvaluationProtocol,
    TaskEvaluation,
    check_evaluation_env,
    evaluate_tasks,
    get_protocol,
)

__all__ = ["TaskEvalCallback"]


class TaskEvalCallback(EventCallback):
    """Evaluate every ``eval_freq`` environment steps; log per task; keep the best model by mean success over tasks.

    Where no task reports success, the best model is the one with the highest mean return.

    SB3's ``EvalCallback`` picks the best model by mean reward, which the loudest task decides.

    :param eval_env: multi-task environment made for evaluation
    :param eval_freq: environment steps, summed over environments, between evaluations
    :param protocol: name or protocol
    :param deterministic: mean actions, or samples
    :param best_model_save_path: folder for ``best_model.zip``; ``None`` saves none
    :param log_path: folder for ``evaluations.npz``; ``None`` writes none
    :param callback_on_new_best: SB3's
    :param callback_after_eval: SB3's
    :param verbose: 1 prints each evaluation's mean success
    :raises ConfigError: if an option cannot work, such as an unknown protocol
    """

    def __init__(
        self,
        eval_env: VecEnv,
        eval_freq: int,
        protocol: str | EvaluationProtocol = "paper",
        deterministic: bool = True,
        best_model_save_path: str | Path | None = None,
        log_path: str | Path | None = None,
        callback_on_new_best: BaseCallback | None = None,
        callback_after_eval: BaseCallback | None = None,
        verbose: int = 0,
    ) -> None:
        for option, callback in (
            ("callback_on_new_best", callback_on_new_best),
            ("callback_after_eval", callback_after_eval),
        ):
            if callback is not None and not isinstance(callback, BaseCallback):
                raise ConfigError(f"{option}={callback!r} must be a callback of SB3's, or None.")
        super().__init__(callback_after_eval, verbose=check_verbose("verbose", verbose))
        if not isinstance(eval_env, VecEnv):
            raise ConfigError(
                f"eval_env={eval_env!r} must be an environment with tasks, such as make_metaworld_env's."
            )
        self.eval_env = eval_env
        self.eval_freq = check_count("eval_freq", eval_freq)
        self.protocol = get_protocol(protocol)
        self.deterministic = check_flag("deterministic", deterministic)
        self.best_model_save_path = (
            None if best_model_save_path is None else check_path("best_model_save_path", best_model_save_path)
        )
        self.log_path = None if log_path is None else check_path("log_path", log_path)
        self.callback_on_new_best = callback_on_new_best
        self.best_score = -np.inf
        self.history: list[tuple[int, TaskEvaluation]] = []
        self._next_at = eval_freq

    def checkpoint_state(self) -> dict[str, Any]:
        """Return what it remembers, for a checkpoint of the run."""
        columns = [
            f.name for f in dataclasses.fields(TaskEvaluation) if f.name not in ("protocol", "task_names")
        ]
        return {
            "best_score": float(self.best_score),
            "history": [
                {"step": step, **{name: getattr(result, name) for name in columns}}
                for step, result in self.history
            ],
        }

    def restore_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Go on from what `checkpoint_state` returned.

        :param state: see there
        """
        self.best_score = state["best_score"]
        names = tuple(cast("Any", self.eval_env).task_names)
        self.history = []
        for entry in state["history"]:
            columns = {name: value for name, value in entry.items() if name != "step"}
            self.history.append((entry["step"], TaskEvaluation(self.protocol, names, **columns)))

    def _init_callback(self) -> None:
        check_evaluation_env(self.model, self.eval_env, self.protocol)  # now, not hours later
        for folder in (self.best_model_save_path, self.log_path):
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.init_callback(self.model)

    def _on_training_start(self) -> None:
        # counted from where the run stands, so that a resumed run neither repeats nor skips an evaluation
        self._next_at = (self.num_timesteps // self.eval_freq + 1) * self.eval_freq

    def _on_step(self) -> bool:
        if self.num_timesteps < self._next_at:
            return True
        self._next_at = (self.num_timesteps // self.eval_freq + 1) * self.eval_freq
        result = evaluate_tasks(self.model, self.eval_env, self.protocol, self.deterministic)
        self.history.append((self.num_timesteps, result))
        self._record(result)
        keep_on = True
        score = result.mean_success
        if np.isnan(score):  # no task reports success
            score = float(result.returns.mean())
        if score > self.best_score:
            self.best_score = score
            if self.best_model_save_path is not None:
                self.model.save(self.best_model_save_path / "best_model")
            if self.callback_on_new_best is not None:
                keep_on = self.callback_on_new_best.on_step()
        return keep_on and self._on_event()

    def _record(self, result: TaskEvaluation) -> None:
        if self.verbose >= 1:
            print(
                f"Step {self.num_timesteps:,}: mean success {result.mean_success:.2f} ({self.protocol.describe()})"
            )
        self.logger.record("eval/mean_success", result.mean_success)
        self.logger.record("eval/mean_reward", float(result.returns.mean()))
        self.logger.record("eval/mean_ep_length", float(result.lengths.mean()))
        for name, success in zip(result.task_names, result.success, strict=True):
            self.logger.record(f"eval_success/{name}", float(success), exclude="stdout")
        if self.log_path is not None:
            steps, results = zip(*self.history, strict=True)
            stacked: dict[str, Any] = {
                "results": np.stack([r.returns for r in results]),
                "ep_lengths": np.stack([r.lengths for r in results]),
                "successes": np.stack([r.success_once for r in results]),
                "successes_at_end": np.stack([r.success_at_end for r in results]),
            }
            np.savez(
                self.log_path / "evaluations.npz",
                timesteps=np.array(steps),
                task_names=np.array(self.history[-1][1].task_names),
                **stacked,
            )
