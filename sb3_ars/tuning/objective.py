"""One trial of a study: trains a configuration over several seeds, reports as it goes, returns its mean success."""

from __future__ import annotations

import dataclasses
import gc
import importlib.metadata
import json
import shutil
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import optuna
import torch as th
from optuna.pruners import WilcoxonPruner
from optuna.study import StudyDirection
from optuna.trial import TrialState
from stable_baselines3.common.callbacks import BaseCallback

from sb3_ars.errors import ConfigError, DivergedError, EnvContractError, WorkerError, check_count
from sb3_ars.experiments.config import RunConfig, load_preset
from sb3_ars.experiments.run_folder import CHECKPOINTS, RESULT, write_json
from sb3_ars.experiments.runner import RunResult, train
from sb3_ars.experiments.scaling import load_scale, scaled
from sb3_ars.tuning.liveness import claim, counts, kept_alive, retry
from sb3_ars.tuning.search_space import SearchSpace, load_search_space
from sb3_ars.versions import run_versions

__all__ = ["Objective", "TrialFailed", "make_objective", "plain_config"]

Space = str | Path | Mapping[str, Any] | SearchSpace


class TrialFailed(RuntimeError):
    """A trial that failed by its own options, or was not needed; the study goes on."""


def make_objective(
    preset: str | RunConfig,
    space: Space = "n_reset",
    *,
    n_seeds: int = 3,
    n_evaluations: int = 4,
    output: Path | str = "studies",
    scale: str = "full",
) -> Callable[[optuna.Trial], float]:
    """Return an objective for a study of your own: the mean success over tasks and seeds, to be maximised.

    Each trial trains ``n_seeds`` runs, one after another, in ``<output>/<study>/trial<k>/seed<s>``. What it reports to
    the pruner depends on the pruner of its study: a :class:`~optuna.pruners.WilcoxonPruner` gets each task's success
    after each run, any other the mean success so far, at each evaluation. A trial whose options a run cannot have fails
    with :class:`TrialFailed`: give ``catch=(TrialFailed,)`` to ``study.optimize``.

    :param preset: name of a preset, or the configuration that trials change
    :param space: name of a search space, path of a YAML file, or what such a file holds
    :param n_seeds: runs of each trial, whose seeds are the configuration's and those after it
    :param n_evaluations: evaluations during each run, evenly spaced; none is 0
    :param output: folder of studies
    :param scale: size of the runs, such as "toy"; see :mod:`sb3_ars.experiments.scaling`
    :raises ConfigError: if any of these cannot work
    """
    return Objective(preset, space, n_seeds=n_seeds, n_evaluations=n_evaluations, output=output, scale=scale)


class Objective:
    """What :func:`make_objective` returns; see there.

    :param n_trials: how many trials of the study may count, all processes together; ``None`` is any number
    """

    def __init__(
        self,
        preset: str | RunConfig,
        space: Space,
        *,
        n_seeds: int,
        n_evaluations: int,
        output: Path | str,
        scale: str,
        n_trials: int | None = None,
    ) -> None:
        if not isinstance(preset, str | RunConfig):
            raise ConfigError(f"preset={preset!r} must be a preset's name, or a RunConfig.")
        self.preset = preset if isinstance(preset, str) else "custom"
        self.config = scaled(load_preset(preset) if isinstance(preset, str) else preset, load_scale(scale))
        self.space = load_search_space(space)
        self.space.check(self.config)
        self.n_seeds = check_count("n_seeds (--seeds)", n_seeds)
        self.n_evaluations = check_count("n_evaluations (--evaluations)", n_evaluations, minimum=0)
        if self.n_evaluations >= self.config.algorithm.total_timesteps:
            raise ConfigError(
                f"n_evaluations (--evaluations)={n_evaluations} must be fewer than the run's "
                f"{self.config.algorithm.total_timesteps} steps."
            )
        self.output = Path(output)
        self.n_trials = n_trials

    def __call__(self, trial: optuna.Trial) -> float:
        """Return the trial's mean success.

        :param trial: of a study that maximises
        :raises TrialFailed: if its options cannot work, or training them failed
        :raises optuna.TrialPruned: if the study's pruner says so
        """
        if trial.study.direction is not StudyDirection.MAXIMIZE:
            raise ConfigError('The value is a success rate: create the study with direction="maximize".')
        with kept_alive(trial):
            if self.n_trials is not None and not claim(trial, self.n_trials):
                self._give_way(trial)
            folder = self.output / trial.study.study_name / f"trial{trial.number}"
            state = TrialState.FAIL
            try:
                value = self._value(trial, folder)
                state = TrialState.COMPLETE
                return value
            except optuna.TrialPruned:
                state = TrialState.PRUNED
                raise
            except KeyboardInterrupt:
                trial.set_user_attr("failed_by", "interrupt")
                trial.set_user_attr("failure", "interrupted by the user")
                retry(trial.study, trial)
                raise
            except Exception as error:
                trial.set_user_attr("failed_by", "options")
                trial.set_user_attr("failure", f"{type(error).__name__}: {error}")
                if isinstance(error, _OF_A_TRIAL) and not isinstance(error, _NoSuccess):
                    raise TrialFailed(
                        str(error)
                    ) from None  # from None: the traceback holds networks and buffers
                raise
            finally:
                _write_state(trial, state, folder)
                _free_memory()

    def _give_way(self, trial: optuna.Trial) -> None:
        trial.set_user_attr("failed_by", "surplus")
        trial.set_user_attr("failure", "not needed: other processes were at the last trials already")
        if "retry_of" in trial.user_attrs:  # it came from the queue, and goes back to it
            self.space.suggest(trial)
            retry(trial.study, trial)
        raise TrialFailed("not needed")

    def _value(self, trial: optuna.Trial, folder: Path) -> float:
        started = time.monotonic()
        values = self.space.suggest(trial)
        config = self._evaluated(self.space.apply(self.config, values))
        seeds = self._seeds(trial)
        for key, attribute in (
            ("config", plain_config(config)),
            ("seeds", seeds),
            ("runs", [str(folder / f"seed{seed}") for seed in seeds]),
            ("versions", {**run_versions(), "optuna": importlib.metadata.version("optuna")}),
        ):
            trial.set_user_attr(key, attribute)
        report = _reporting(trial, [seed - self.config.seed for seed in seeds], self.n_evaluations)
        results: list[dict[str, float]] = []
        for seed in seeds:
            result = self._run(dataclasses.replace(config, seed=seed), folder, report)
            success = {str(task): float(value) for task, value in result.table["success"].items()}
            if np.isnan(list(success.values())).all():
                raise _NoSuccess(
                    f"No task of {self.preset} reports success ({', '.join(success)}), so there is nothing to "
                    'maximise; tune tasks whose info has "success" or "is_success".'
                )
            results.append(success)
            by_task = {task: [None if np.isnan(r[task]) else r[task] for r in results] for task in success}
            trial.set_user_attr("success", by_task)
            trial.set_user_attr("values", [_mean(r) for r in results])
            trial.set_user_attr("seconds", round(time.monotonic() - started, 1))
            report.after_run(success)
            _free_memory()
        return float(np.mean([_mean(r) for r in results]))

    def _run(self, config: RunConfig, trial_folder: Path, report: _Reporting) -> RunResult:
        """Train one seed, its output in a file beside its folder."""
        folder = trial_folder / f"seed{config.seed}"
        trial_folder.mkdir(parents=True, exist_ok=True)
        log = trial_folder / f"seed{config.seed}.log"
        with log.open("w", encoding="utf-8") as file, redirect_stdout(file):
            callback = _AfterEvaluation(report)
            try:
                result = train(config, self.preset, False, folder=folder, after_evaluation=callback)
            finally:
                shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)  # a trial does not go on
        _raise_if_interrupted(folder)
        return result

    def _evaluated(self, config: RunConfig) -> RunConfig:
        """Return the configuration with its evaluations during training."""
        if not self.n_evaluations:
            return config
        every = -(-config.algorithm.total_timesteps // (self.n_evaluations + 1))
        return dataclasses.replace(config, evaluation=dataclasses.replace(config.evaluation, every=every))

    def _seeds(self, trial: optuna.Trial) -> list[int]:
        """Return the same seeds for all trials, but where the same options were tried before the next ones.

        Trained again with the same seeds, the same options would only repeat themselves.
        """
        before = sum(
            other.params == trial.params and (counts(other) or other.state is TrialState.RUNNING)
            for other in trial.study.get_trials(deepcopy=False)
            if other.number < trial.number
        )
        first = self.config.seed + before * self.n_seeds
        return list(range(first, first + self.n_seeds))


class _NoSuccess(ConfigError):
    """Nothing to maximise, in any trial."""


_OF_A_TRIAL = (ConfigError, DivergedError, EnvContractError, WorkerError)
"""Errors of one trial; others are mistakes in code, and end the study."""


class _Reporting(Protocol):
    """What a pruner is told, and when it is asked."""

    def after_evaluation(self, number: int, mean_success: float) -> None:
        """Report the evaluation of that number, from 1, of the current run."""

    def after_run(self, success: dict[str, float]) -> None:
        """Report the final evaluation of the current run."""


class _ByProgress:
    """Reports the mean success so far, over the runs so far, at each evaluation; a step is an evaluation.

    A reset makes success drop for a while, at other times in other trials. So the current run counts with its best
    evaluation so far: a trial is compared by what it has reached, not by where in its schedule it stands.
    """

    def __init__(self, trial: optuna.Trial, n_seeds: int, n_evaluations: int) -> None:
        self.trial, self.n_seeds, self.n_evaluations = trial, n_seeds, n_evaluations
        self.finished: list[float] = []
        self.best = 0.0

    def after_evaluation(self, number: int, mean_success: float) -> None:
        if number > self.n_evaluations:
            return  # at the very end of the run; the final evaluation follows
        self.best = max(self.best, 0.0 if np.isnan(mean_success) else mean_success)
        self._report(number, [*self.finished, self.best])

    def after_run(self, success: dict[str, float]) -> None:
        earlier = self.finished
        self.finished, self.best = [*earlier, _mean(success)], 0.0
        self._report(self.n_evaluations + 1, self.finished, run=len(earlier))

    def _report(self, number: int, values: list[float], run: int | None = None) -> None:
        run = len(self.finished) if run is None else run
        self.trial.report(float(np.mean(values)), run * (self.n_evaluations + 1) + number)
        if len(self.finished) < self.n_seeds and self.trial.should_prune():
            raise optuna.TrialPruned()


class _ByInstance:
    """Reports each task's success after each run; a step is an instance, which is a task and a seed.

    Only finished runs are compared, so resets within them play no part. Options that are tried again have other seeds,
    which have no partner in most trials; only those that have one are tested.

    :param trial: to report to
    :param seeds: of its runs, counted from the study's first
    """

    def __init__(self, trial: optuna.Trial, seeds: list[int]) -> None:
        self.trial, self.left = trial, list(seeds)

    def after_evaluation(self, number: int, mean_success: float) -> None:
        """Nothing: values of an instance must be final."""

    def after_run(self, success: dict[str, float]) -> None:
        seed = self.left.pop(0)
        for task, value in enumerate(success.values()):
            if not np.isnan(value):
                self.trial.report(value, seed * len(success) + task)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "WilcoxonPruner finds steps existing in the current trial")
            if self.left and self.trial.should_prune():
                raise optuna.TrialPruned()


def _reporting(trial: optuna.Trial, seeds: list[int], n_evaluations: int) -> _Reporting:
    if isinstance(trial.study.pruner, WilcoxonPruner):
        return _ByInstance(trial, seeds)
    return _ByProgress(trial, len(seeds), n_evaluations)


class _AfterEvaluation(BaseCallback):
    """Hands each evaluation during training on."""

    parent: Any

    def __init__(self, report: _Reporting) -> None:
        super().__init__()
        self.report = report

    def _on_step(self) -> bool:
        history = self.parent.history
        self.report.after_evaluation(len(history), history[-1][1].mean_success)
        return True


def plain_config(config: RunConfig) -> dict[str, Any]:
    """Return the configuration as plain values, as it comes back from JSON; without the folder it writes to.

    :param config: of a run
    """
    values: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    del values["output"]
    return values


def _mean(success: Mapping[str, float]) -> float:
    return float(np.nanmean(list(success.values())))


def _raise_if_interrupted(folder: Path) -> None:
    """Raise for a run that Ctrl-C ended early, which its runner keeps as finished; take that mark off it."""
    result = folder / RESULT
    if result.is_file() and json.loads(result.read_text(encoding="utf-8"))["interrupted"]:
        result.rename(folder / "interrupted.json")
        raise KeyboardInterrupt


def _write_state(trial: optuna.Trial, state: TrialState, folder: Path) -> None:
    """Write beside a trial's runs what became of them; the last is unfinished where the trial is not complete."""
    folder.mkdir(parents=True, exist_ok=True)
    attributes = {
        key: trial.user_attrs.get(key)
        for key in ("failure", "seeds", "values", "success", "seconds", "retry_of")
    }
    content = {"number": trial.number, "state": state.name, "params": trial.params, **attributes}
    write_json(folder / "trial.json", content)


def _free_memory() -> None:
    gc.collect()
    if th.cuda.is_available():
        th.cuda.empty_cache()
