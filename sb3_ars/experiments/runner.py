"""Turns a configuration into a finished run folder: config, versions, log, policy, tables, figure."""

from __future__ import annotations

import dataclasses
import shutil
import time
import warnings
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_ars.algorithms.checkpoint import load_checkpoint
from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm
from sb3_ars.algorithms.sac import ARSSAC
from sb3_ars.algorithms.tqc import ARSTQC
from sb3_ars.callbacks.checkpoint import RunCheckpoint
from sb3_ars.callbacks.evaluation import TaskEvalCallback
from sb3_ars.callbacks.schedule import TaskScheduleCallback
from sb3_ars.checkpoints import Checkpoint, checkpoint_folders, latest_checkpoint, lock
from sb3_ars.envs import make_metaworld_env, make_toy_env
from sb3_ars.errors import ConfigError
from sb3_ars.evaluation import (
    EvaluationProtocol,
    TaskEvaluation,
    evaluate_tasks,
    get_protocol,
    make_evaluation_env,
)
from sb3_ars.experiments.config import Activation, BodyOptions, RunConfig, load_config, save_config
from sb3_ars.experiments.logs import PROGRESS, continued_logger, new_logger
from sb3_ars.experiments.plots import plot_training
from sb3_ars.experiments.run_folder import CHECKPOINTS, FORMAT, RESULT, is_finished, read_run, write_json
from sb3_ars.policy_file import export_policy
from sb3_ars.profiling import PartTimer
from sb3_ars.versions import run_versions

__all__ = [
    "RunResult",
    "build_model",
    "evaluate_run",
    "final_table",
    "load_model",
    "make_env",
    "method_callbacks",
    "resume",
    "train",
]

_ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}
_ALGORITHMS: dict[str, type[MultiTaskOffPolicyAlgorithm]] = {"ARSSAC": ARSSAC, "ARSTQC": ARSTQC}


@dataclass(frozen=True)
class RunResult:
    """What a run leaves behind.

    :param folder: of the run
    :param table: one row per task: success, success_sampled, return, c_i; the final evaluation
    :param protocol: the final evaluation's protocol in one line
    :param seconds: training time
    :param seconds_by_part: the same by part, where the run was profiled
    """

    folder: Path
    table: pd.DataFrame
    protocol: str
    seconds: float
    seconds_by_part: dict[str, float] | None = None


def train(
    config: RunConfig,
    name: str,
    progress_bar: bool = True,
    folder: Path | None = None,
    after_evaluation: BaseCallback | None = None,
) -> RunResult:
    """Train as configured, evaluate, and write the run's folder.

    An interrupt (Ctrl-C) ends training early; what was learned is evaluated and saved like a finished run. SIGTERM ends
    it at once. Both leave a checkpoint, from which :func:`resume` goes on.

    :param config: of the run
    :param name: of the preset, for the folder's name
    :param progress_bar: whether to show one
    :param folder: of the run, new or empty; ``None`` makes one in ``config.output``, named after preset and seed
    :param after_evaluation: called after each evaluation during training, which is its ``parent``; where its
        ``on_step`` returns ``False`` training ends early
    :raises ConfigError: before training, if an option cannot work or the folder cannot be written
    """
    folder = _make_folder(
        _free_folder(config.output / f"{name}-seed{config.seed}") if folder is None else folder
    )
    with ExitStack() as stack:
        stack.callback(_remove_if_unused, folder)
        return _run(config, name, folder, None, progress_bar, after_evaluation)


def resume(folder: Path, progress_bar: bool = True) -> RunResult:
    """Go on with a run that was killed, stopped or interrupted, from its newest whole checkpoint, to its end.

    :param folder: of the run
    :param progress_bar: whether to show one
    :raises ConfigError: if it has finished, holds no checkpoint, or was trained with another configuration
    """
    config = load_config(folder / "config.yaml")
    if is_finished(folder) and not read_run(folder).result.get("interrupted"):
        raise ConfigError(f"The run in {folder} has finished; there is nothing to resume. Train a new one.")
    with lock(folder / CHECKPOINTS):
        checkpoint = latest_checkpoint(folder / CHECKPOINTS)
        name = str(checkpoint.notes.get("name", folder.name))
        return _run(config, name, folder, checkpoint, progress_bar, None)


def _run(
    config: RunConfig,
    name: str,
    folder: Path,
    checkpoint: Checkpoint | None,
    progress_bar: bool,
    after_evaluation: BaseCallback | None,
) -> RunResult:
    """Train, from the beginning or from a checkpoint, evaluate, and write the folder."""
    protocol = protocol_of(config)
    if config.algorithm.device.startswith("cuda") and not th.cuda.is_available():
        raise ConfigError(
            f"algorithm.device={config.algorithm.device!r}, but torch finds no GPU here; use 'auto' or 'cpu'."
        )
    with ExitStack() as stack:
        env = stack.enter_context(closing(make_env(config)))
        model = build_model(config, env, verbose=1)
        evaluation_env = stack.enter_context(closing(_make_evaluation_env(config, protocol)))
        to_screen = bool(config.verbose)
        if checkpoint is None:
            save_config(config, folder / "config.yaml")
            write_json(folder / "versions.json", run_versions())
            model.set_logger(new_logger(folder, to_screen))
        else:
            load_checkpoint(model, checkpoint)
            (folder / RESULT).unlink(missing_ok=True)  # of the run as it was when it was interrupted
            print(f"Going on at step {model.num_timesteps:,}, from {checkpoint.folder}.")
            model.set_logger(
                continued_logger(folder, to_screen, checkpoint.folder / PROGRESS, model.num_timesteps)
            )
        stack.callback(model.logger.close)
        timer = PartTimer(model.device) if config.profile else None
        model.timer = timer or model.timer
        checkpoints = RunCheckpoint(
            folder / CHECKPOINTS,
            **dataclasses.asdict(config.checkpoint),
            notes={"name": name},
            files=[folder / PROGRESS],
        )
        checkpoints.seconds = 0.0 if checkpoint is None else float(checkpoint.notes["seconds"])
        interrupted = _learn(
            model, config, evaluation_env, protocol, folder, checkpoints, progress_bar, after_evaluation
        )
        seconds = checkpoints.seconds
        by_part = timer.seconds() if timer else None
        model.save(folder / "policy")
        _export(model, folder)
        evaluations = _evaluate_both(model, evaluation_env, protocol, progress_bar)
        table = final_table(evaluations, model.reward_scale.scale.tolist())
        names = list(evaluations[True].task_names)
        plot_training(folder / PROGRESS, names, model.reward_scale_history, folder / "training.png")
        table.to_csv(folder / "evaluation.csv")
        write_json(
            folder / RESULT, _result(name, config, table, protocol, model, seconds, by_part, interrupted)
        )
    if not interrupted:
        shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)  # gigabytes that nothing needs any more
    return RunResult(folder, table, protocol.describe(), seconds, by_part)


def evaluate_run(
    folder: Path, protocol: str | None = None, n_episodes: int | None = None, progress_bar: bool = True
) -> RunResult:
    """Evaluate a finished run's policy again, and write the table beside it.

    :param folder: of the run
    :param protocol: name; ``None`` is the run's own
    :param n_episodes: episodes per task, instead of the protocol's
    :param progress_bar: whether to show one
    :raises ConfigError: if the folder holds no run
    """
    config = load_config(folder / "config.yaml")
    if n_episodes is None and protocol is None:
        n_episodes = config.evaluation.n_episodes
    evaluation = dataclasses.replace(
        config.evaluation, protocol=protocol or config.evaluation.protocol, n_episodes=n_episodes
    )
    config = dataclasses.replace(config, evaluation=evaluation)
    chosen = protocol_of(config, own_horizon=protocol is None)
    model = load_model(folder / "policy.zip", config)
    started = time.monotonic()
    with closing(_make_evaluation_env(config, chosen)) as env:
        evaluations = _evaluate_both(model, env, chosen, progress_bar)
    table = final_table(evaluations, model.reward_scale.scale.tolist())
    table.to_csv(folder / f"evaluation-{chosen.name}.csv")
    return RunResult(folder, table, chosen.describe(), time.monotonic() - started)


def load_model(path: Path, config: RunConfig, device: str = "auto") -> MultiTaskOffPolicyAlgorithm:
    """Return the model that a run saved. The file is a pickle's home: load it only from people you trust.

    :param path: its ``policy.zip``
    :param config: of the run
    :param device: to load it to
    :raises ConfigError: if it is missing or is not what the configuration trains
    """
    algorithm = config.algorithm.algorithm
    if not path.is_file():
        raise ConfigError(f"{path.parent} holds no {path.name}; the run did not finish.")
    try:
        return _ALGORITHMS[algorithm].load(path, device=device)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise ConfigError(f"{path} cannot be read as {algorithm}: {error}") from error


def make_env(config: RunConfig) -> VecEnv:
    """Return the training environments of a configuration."""
    env = config.env
    common: dict[str, Any] = {
        "seed": config.seed,
        "n_envs_per_task": env.n_envs_per_task,
        "max_episode_steps": env.max_episode_steps,
        "n_workers": env.n_workers,
        "restart_workers": env.restart_workers,
    }
    if env.is_toy:
        return make_toy_env(tasks=env.task_names, **common)
    return make_metaworld_env(_task_list(env.tasks), goals=env.goals, **common)


def build_model(config: RunConfig, env: VecEnv, verbose: int = 0) -> MultiTaskOffPolicyAlgorithm:
    """Return the untrained model of a configuration.

    :param config: of the run
    :param env: its training environments
    :param verbose: 1 prints the buffer's size and each reset with its scales
    """
    options = dataclasses.asdict(config.algorithm)
    algorithm = _ALGORITHMS[options.pop("algorithm")]
    del options["total_timesteps"]
    policy = config.policy
    return algorithm(
        "MlpPolicy",
        env,
        policy_kwargs={
            "net_arch": list(policy.net_arch),
            "activation_fn": _ACTIVATIONS[policy.actor_activation],
            "critic_activation_fn": _ACTIVATIONS[policy.critic_activation],
            "critic_layer_norm": policy.critic_layer_norm,
            "std": policy.std,
            "weight_init": policy.weight_init,
            "body": _body(policy.body, policy.body_options),
            "critic_body": "same"
            if policy.critic_body == "same"
            else _body(policy.critic_body, policy.critic_body_options),
        },
        seed=config.seed,
        verbose=verbose,
        **options,
        **{f.name: getattr(config.ars, f.name) for f in dataclasses.fields(config.ars)},
    )


def method_callbacks(config: RunConfig) -> list[BaseCallback]:
    """Return the callbacks that are part of a configuration's method.

    :param config: of the run
    """
    return [TaskScheduleCallback(config.schedule)] if config.schedule.name == "smt" else []


def _body(name: str, options: BodyOptions | None) -> dict[str, Any] | None:
    return None if name == "plain" else {"name": name, **(options or {})}


def protocol_of(config: RunConfig, own_horizon: bool = True) -> EvaluationProtocol:
    """Return the evaluation protocol of a configuration.

    :param own_horizon: take the training horizon where it differs from the protocol's, and say so in the name
    """
    protocol = get_protocol(config.evaluation.protocol)
    n_episodes = config.evaluation.n_episodes or protocol.n_episodes
    if config.env.is_toy:
        return EvaluationProtocol("toy", n_episodes, config.env.max_episode_steps, goals=None)
    horizon = config.env.max_episode_steps if own_horizon else protocol.max_episode_steps
    changed = (n_episodes, horizon) != (protocol.n_episodes, protocol.max_episode_steps)
    name = f"{protocol.name}-adapted" if changed else protocol.name
    return dataclasses.replace(protocol, name=name, n_episodes=n_episodes, max_episode_steps=horizon)


def final_table(evaluations: dict[bool, TaskEvaluation], reward_scale: list[float]) -> pd.DataFrame:
    """Return one row per task from the deterministic and the sampled evaluation.

    :param evaluations: keyed by ``deterministic``
    :param reward_scale: c_i, ``(n_tasks,)``
    """
    table = evaluations[True].table()
    table.insert(1, "success_sampled", evaluations[False].success)
    table["c"] = reward_scale
    return table


def _learn(
    model: MultiTaskOffPolicyAlgorithm,
    config: RunConfig,
    evaluation_env: VecEnv,
    protocol: EvaluationProtocol,
    folder: Path,
    checkpoints: RunCheckpoint,
    progress_bar: bool,
    after_evaluation: BaseCallback | None,
) -> bool:
    """Train, or go on; return whether the user interrupted."""
    bar = ProgressBarCallback()
    callbacks = [*([bar] if progress_bar else []), *method_callbacks(config), checkpoints]
    if config.evaluation.every is not None:
        callbacks.append(
            TaskEvalCallback(
                evaluation_env,
                config.evaluation.every,
                protocol,
                best_model_save_path=folder,
                log_path=folder,
                callback_after_eval=after_evaluation,
            )
        )
    interrupted = False
    try:
        model.learn(
            config.algorithm.total_timesteps - model.num_timesteps,
            callback=callbacks,
            log_interval=config.log_interval,
            reset_num_timesteps=model.last_checkpoint is None,
        )
    except KeyboardInterrupt:
        if model.replay_buffer is None or model.replay_buffer.size() == 0:
            raise
        interrupted = True
        print(
            f"\nInterrupted at step {model.num_timesteps:,}; evaluating and saving what was learned. "
            f"Go on with: sb3-ars train --resume {folder}"
        )
    except SystemExit:  # told to end, and at once
        if not checkpoint_folders(folder / CHECKPOINTS):  # it could not be written
            model.save(folder / "policy")
            print(f"\nNo checkpoint could be written; what was learned is in {folder / 'policy.zip'}")
            raise
        print(f"\nStopped at step {model.num_timesteps:,}. Go on with: sb3-ars train --resume {folder}")
        raise
    except Exception:
        if model.num_timesteps > 0:
            model.save(folder / "policy")
            print(
                f"\nTraining failed at step {model.num_timesteps:,}; what was learned is in {folder / 'policy.zip'}"
            )
        raise
    finally:
        if hasattr(bar, "pbar"):
            bar.pbar.close()
    model.dump_logs()  # so that the log's last row is the run's last step
    if not interrupted:
        checkpoints.write()  # the evaluation that follows may take long
    return interrupted


def _export(model: MultiTaskOffPolicyAlgorithm, folder: Path) -> None:
    """Write the policy as a file to share, where it can be one; the run is finished without it too."""
    try:
        export_policy(model, folder / "policy")
    except ConfigError as error:
        warnings.warn(f"{folder} has no policy.safetensors: {error}", stacklevel=3)


def _remove_if_unused(folder: Path) -> None:
    """Leave no folder behind where nothing was learned or logged yet."""
    log = folder / PROGRESS
    has_log = log.is_file() and log.stat().st_size > 0
    if not (has_log or (folder / "policy.zip").exists() or checkpoint_folders(folder / CHECKPOINTS)):
        shutil.rmtree(folder, ignore_errors=True)


def _make_evaluation_env(config: RunConfig, protocol: EvaluationProtocol) -> VecEnv:
    env = config.env
    if env.is_toy:
        return make_toy_env(config.seed, max_episode_steps=env.max_episode_steps, tasks=env.task_names)
    return make_evaluation_env(_task_list(env.tasks), protocol, n_workers=env.n_workers)


def _evaluate_both(
    model: MultiTaskOffPolicyAlgorithm, env: VecEnv, protocol: EvaluationProtocol, progress_bar: bool
) -> dict[bool, TaskEvaluation]:
    return {
        deterministic: evaluate_tasks(model, env, protocol, deterministic, progress_bar=progress_bar)
        for deterministic in (True, False)
    }


def _result(
    name: str,
    config: RunConfig,
    table: pd.DataFrame,
    protocol: EvaluationProtocol,
    model: MultiTaskOffPolicyAlgorithm,
    seconds: float,
    seconds_by_part: dict[str, float] | None,
    interrupted: bool,
) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "name": name,
        "seed": config.seed,
        "mean_success": _json_number(table["success"].mean()),
        "mean_success_sampled": _json_number(table["success_sampled"].mean()),
        "tasks": {
            str(task): {str(column): _json_number(value) for column, value in values.items()}
            for task, values in table.iterrows()
        },
        "protocol": protocol.describe(),
        "timesteps": model.num_timesteps,
        "updates": model._n_updates,
        "resets": model.n_resets,
        "reward_scale_history": model.reward_scale_history,
        "training_seconds": round(seconds, 1),
        "seconds_by_part": seconds_by_part,
        "interrupted": interrupted,
    }


def _json_number(value: float) -> float | None:
    """Return a number as JSON can hold it, in full precision; ``None`` for NaN, a success that no task reports."""
    return None if pd.isna(value) else float(value)


def _free_folder(stem: Path) -> Path:
    """Return the path, or the first of it with a number behind that does not exist."""
    folder, number = stem, 2
    while folder.exists():
        folder, number = stem.with_name(f"{stem.name}-{number}"), number + 1
    return folder


def _make_folder(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupied = any(folder.iterdir())
    except OSError as error:
        raise ConfigError(
            f"The run's folder {folder} cannot be made ({error.strerror}); choose another --output."
        ) from error
    if occupied:
        raise ConfigError(f"The run's folder {folder} is not empty; choose another, or delete it.")
    return folder


def _task_list(tasks: str | tuple[str, ...]) -> str | list[str]:
    return tasks if isinstance(tasks, str) else list(tasks)
