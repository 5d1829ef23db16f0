"""The paper's MT10 run on one GPU, timed as a whole: 20 million steps, 2 million updates, evaluation included.

    python -m benchmarks.gpu_mt10 --time-budget 1500
    python -m benchmarks.gpu_mt10 --time-budget 540 --run /tmp/run    # again and again: it goes on where it stood
    python -m benchmarks.gpu_mt10 --preset toy --device cpu           # the same script in a minute, without a GPU

Options that --help does not list are those of ``sb3-ars train PRESET --help``. Under --run the run keeps what it needs
to go on, the whole replay buffer (gigabytes) included; --output receives only what is worth keeping: figures (JSON),
success curve (CSV), picture (PNG), and the policy without its critics, a few MB.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import shutil
import statistics
import subprocess
import sys
import threading
import zipfile
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from time import monotonic
from typing import Any

import pandas as pd
import torch as th
import tyro
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat, Logger
from stable_baselines3.common.vec_env import VecEnv

import sb3_ars
from benchmarks.harness import RESULTS, goal, machine, write_result
from sb3_ars.callbacks.evaluation import TaskEvalCallback
from sb3_ars.envs import make_toy_env
from sb3_ars.errors import ConfigError
from sb3_ars.evaluation import EvaluationProtocol, evaluate_tasks, make_evaluation_env
from sb3_ars.experiments.config import RunConfig, load_preset, save_config
from sb3_ars.experiments.plots import plot_training
from sb3_ars.experiments.runner import build_model, final_table, make_env, protocol_of

IDLE_HOW = (
    "1 - mean of nvidia-smi's utilization.gpu, sampled once a second during training and its evaluations: the share "
    "of time in which no kernel ran"
)


@dataclasses.dataclass
class Progress:
    """What a run has measured so far; kept in ``progress.json`` so that a later part goes on with it."""

    parts: int = 0
    seconds: float = 0.0
    random_seconds: float = 0.0
    """Of them, before the first update."""
    rates: list[tuple[float, int, int]] = dataclasses.field(default_factory=list)
    """(seconds, environment steps, updates), every few seconds."""
    curve: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    """One row per evaluation during training."""
    gpu_busy: list[float] = dataclasses.field(default_factory=list)
    """Samples of nvidia-smi's utilization, 0 to 100."""
    gpu_memory_mb: float = 0.0

    @classmethod
    def read(cls, folder: Path) -> Progress:
        path = folder / "progress.json"
        return cls(**json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else cls()

    def write(self, folder: Path) -> None:
        (folder / "progress.json").write_text(json.dumps(dataclasses.asdict(self)), encoding="utf-8")


class Watch(BaseCallback):
    """Notes rates and evaluations, saves the policy often, and ends training when the time is up.

    :param folder: for the checkpoints
    :param progress: written to
    :param evaluation: whose results are noted
    :param time_budget: seconds for this part of the run; ``None`` is no limit
    :param checkpoint_every: seconds between two checkpoints of the policy
    """

    def __init__(
        self,
        folder: Path,
        progress: Progress,
        evaluation: TaskEvalCallback | None,
        time_budget: float | None,
        checkpoint_every: float,
    ) -> None:
        super().__init__()
        self.folder, self.progress, self.evaluation = folder, progress, evaluation
        self.time_budget, self.checkpoint_every = time_budget, checkpoint_every
        self.before = progress.seconds
        self.evaluations_seen = 0

    def _on_training_start(self) -> None:
        self.started = monotonic()
        self.next_rate = self.next_checkpoint = 0.0

    def _on_rollout_start(self) -> None:  # nothing is under way between two rollouts
        elapsed = monotonic() - self.started
        self.progress.seconds = self.before + elapsed
        if self.model._n_updates == 0:
            self.progress.random_seconds = self.progress.seconds
        if elapsed >= self.next_rate:
            self.next_rate = elapsed + 5.0
            self.progress.rates.append((self.progress.seconds, self.num_timesteps, self.model._n_updates))
        if elapsed >= self.next_checkpoint:
            self.next_checkpoint = elapsed + self.checkpoint_every
            self.model.save(self.folder / "policy")
            self.progress.write(self.folder)

    def _on_step(self) -> bool:
        elapsed = monotonic() - self.started
        if self.evaluation is not None:
            for timesteps, result in self.evaluation.history[self.evaluations_seen :]:
                success = dict(zip(result.task_names, map(float, result.success), strict=True))
                row = {
                    "timesteps": timesteps,
                    "seconds": self.before + elapsed,
                    "mean_success": result.mean_success,
                }
                self.progress.curve.append({**row, **success})
            self.evaluations_seen = len(self.evaluation.history)
        return self.time_budget is None or elapsed < self.time_budget


class GpuSampler:
    """Samples one GPU's utilization and memory through ``nvidia-smi`` while a ``with`` block runs.

    :param progress: written to
    :param device: of the model; without CUDA, or without the command, nothing is sampled
    """

    def __init__(self, progress: Progress, device: th.device) -> None:
        self.progress, self.device = progress, device

    def __enter__(self) -> GpuSampler:
        self.process = None
        if self.device.type == "cuda" and shutil.which("nvidia-smi") is not None:
            gpu = f"GPU-{th.cuda.get_device_properties(self.device).uuid}"
            query = ["--query-gpu=utilization.gpu,memory.used", "--format=csv,noheader,nounits", "-l", "1"]
            self.process = subprocess.Popen(
                ["nvidia-smi", "-i", gpu, *query], stdout=subprocess.PIPE, text=True
            )
            self.thread = threading.Thread(target=self._read, args=(self.process,), daemon=True)
            self.thread.start()
        return self

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            try:
                busy, memory = (float(value) for value in line.split(","))
            except ValueError:  # a GPU divided by MIG says [N/A]
                continue
            self.progress.gpu_busy.append(busy)
            self.progress.gpu_memory_mb = max(self.progress.gpu_memory_mb, memory)

    def __exit__(self, *error: object) -> None:
        if self.process is not None:
            self.process.terminate()
            self.process.wait()
            self.thread.join()
            assert self.process.stdout is not None
            self.process.stdout.close()


# ---------------------------------------------------------------------- the run


def run(
    config: RunConfig,
    preset: str,
    folder: Path,
    output: Path = RESULTS,
    time_budget: float | None = None,
    checkpoint_every: float = 60.0,
) -> dict[str, Any]:
    """Train a part of the run, or all of it, evaluate, and write what is worth keeping; return the figures.

    :param config: of the run
    :param preset: its name
    :param folder: of the run; where it holds an unfinished run, that goes on
    :param output: for figures, curve, picture and policy
    :param time_budget: seconds of training in this call, evaluation during training included; ``None`` is no limit
    :param checkpoint_every: seconds between two checkpoints of the policy
    """
    if config.algorithm.device.startswith("cuda") and not th.cuda.is_available():
        raise ConfigError("device=cuda, but torch finds no GPU here; give --device cpu and a small preset.")
    folder.mkdir(parents=True, exist_ok=True)
    output.mkdir(parents=True, exist_ok=True)
    protocol = protocol_of(config)
    progress = Progress.read(folder)
    with ExitStack() as stack:
        env = stack.enter_context(closing(make_env(config)))
        evaluation_env = stack.enter_context(closing(_evaluation_env(config, protocol)))
        model = _resume(config, env, folder) if progress.parts else build_model(config, env)
        save_config(config, folder / "config.yaml")
        log = CSVOutputFormat(str(folder / f"progress-{progress.parts}.csv"))
        progress.parts += 1
        model.set_logger(Logger(str(folder), [log]))
        stack.callback(model.logger.close)
        _train(model, config, protocol, evaluation_env, folder, progress, time_budget, checkpoint_every)
        model.dump_logs()
        model.save(folder / "policy")
        finished = model.num_timesteps >= config.algorithm.total_timesteps
        if not finished:
            model.save_replay_buffer(folder / "replay_buffer")
        progress.write(folder)
        evaluations = {
            deterministic: evaluate_tasks(model, evaluation_env, protocol, deterministic)
            for deterministic in (True, False)
        }
    table = final_table(evaluations, model.reward_scale.scale.tolist())
    result = {
        "preset": preset,
        "finished": finished,
        "protocol": protocol.describe(),
        "mean_success": float(table["success"].mean()),
        "mean_success_sampled": float(table["success_sampled"].mean()),
        "tasks": json.loads(table.to_json(orient="index")),
        **figures(progress, model, config),
        "resets": model.n_resets,
        "reward_scale_history": model.reward_scale_history,
        "curve": progress.curve,
        "config": json.loads(json.dumps(dataclasses.asdict(config), default=str)),
        "machine": machine(),
    }
    result["goals"] = goals(result)
    write_result("gpu_mt10", result, output)
    _write_curve(progress.curve, output / "gpu_mt10_curve.csv")
    parts = [pd.read_csv(folder / f"progress-{part}.csv") for part in range(progress.parts)]
    pd.concat(parts).to_csv(folder / "progress.csv", index=False)
    names = list(evaluations[True].task_names)
    plot_training(folder / "progress.csv", names, model.reward_scale_history, output / "gpu_mt10.png")
    keep_policy(config.algorithm.algorithm, folder / "policy.zip", output / "gpu_mt10_policy.zip")
    return result


def _train(
    model: Any,
    config: RunConfig,
    protocol: EvaluationProtocol,
    evaluation_env: VecEnv,
    folder: Path,
    progress: Progress,
    time_budget: float | None,
    checkpoint_every: float,
) -> None:
    every = config.evaluation.every
    evaluation = None if every is None else TaskEvalCallback(evaluation_env, every, protocol)
    watch = Watch(folder, progress, evaluation, time_budget, checkpoint_every)
    remaining = config.algorithm.total_timesteps - model.num_timesteps
    if remaining <= 0:
        raise ConfigError(f"{folder} holds a finished run; give another --run.")
    with GpuSampler(progress, model.device):
        started = monotonic()
        model.learn(
            remaining,
            callback=[watch] if evaluation is None else [evaluation, watch],
            log_interval=config.log_interval,
            reset_num_timesteps=model.num_timesteps == 0,
        )
        if model.device.type == "cuda":
            th.cuda.synchronize(model.device)
        progress.seconds = watch.before + monotonic() - started
    progress.rates.append((progress.seconds, model.num_timesteps, model._n_updates))


def _resume(config: RunConfig, env: VecEnv, folder: Path) -> Any:
    """Load what an earlier call left."""
    if not (folder / "replay_buffer.pkl").is_file():
        raise ConfigError(
            f"The run in {folder} ended without its replay buffer (finished, or killed); give another --run."
        )
    algorithm: Any = getattr(sb3_ars, config.algorithm.algorithm)
    model = algorithm.load(folder / "policy", env=env, device=config.algorithm.device)
    model.load_replay_buffer(folder / "replay_buffer")
    (
        folder / "replay_buffer.pkl"
    ).unlink()  # it belongs to this policy.zip, which the next checkpoint replaces
    return model


def _evaluation_env(config: RunConfig, protocol: EvaluationProtocol) -> VecEnv:
    tasks = config.env.tasks
    if tasks == "toy":
        return make_toy_env(seed=config.seed, max_episode_steps=config.env.max_episode_steps)
    tasks = tasks if isinstance(tasks, str) else list(tasks)
    return make_evaluation_env(tasks, protocol, n_workers=config.env.n_workers)


# ---------------------------------------------------------------------- the figures


def figures(progress: Progress, model: Any, config: RunConfig) -> dict[str, Any]:
    """Return how fast the run went.

    ``steps_per_second`` counts everything, evaluation too; ``updates_per_second`` everything behind the random phase.
    """
    total, steps = config.algorithm.total_timesteps, model.num_timesteps
    busy = statistics.mean(progress.gpu_busy) / 100 if progress.gpu_busy else None
    return {
        "timesteps": steps,
        "updates": model._n_updates,
        "training_seconds": progress.seconds,
        "parts": progress.parts,
        "steps_per_second": steps / progress.seconds,
        "updates_per_second": model._n_updates / (progress.seconds - progress.random_seconds),
        "minutes_for_the_whole_run": progress.seconds / steps * total / 60,
        "gpu_idle_share": None if busy is None else 1.0 - busy,
        "gpu_idle_how": IDLE_HOW,
        "gpu_memory_gb": progress.gpu_memory_mb / 1000 or None,
        "rates": progress.rates[:: max(1, len(progress.rates) // 200)],
    }


def goals(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the issue's bar, for the preset it speaks of.

    :param result: of :func:`run`; an unfinished run's minutes are extrapolated and say so, its success is no result yet
    """
    if result["preset"] != "mt10-ars-ln":
        return []
    how = "measured" if result["finished"] else f"extrapolated from {result['timesteps']:,} steps"
    minutes = goal(
        f"GPU, MT10: minutes for 20M steps, {how}", result["minutes_for_the_whole_run"], at_most=25.0
    )
    if not result["finished"]:
        return [minutes]
    success = result["mean_success"]
    return [
        minutes,
        goal("GPU, MT10: mean success, the paper's less its deviation", success, at_least=0.971),
    ]


def keep_policy(algorithm: str, source: Path, target: Path) -> None:
    """Write a saved model again, small: critics emptied, optimizers forgotten, compressed. It predicts as before.

    :param algorithm: name of its class
    :param source: zip of ``model.save``
    :param target: zip that ``load`` reads, to predict and to evaluate; not to train on
    """
    model: Any = getattr(sb3_ars, algorithm).load(source, device="cpu")
    with th.no_grad():
        for parameter in (*model.critic.parameters(), *model.critic_target.parameters()):
            parameter.zero_()
    for optimizer in (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer):
        if optimizer is not None:
            optimizer.state.clear()
    model.save(target)
    with zipfile.ZipFile(target) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(target, "w", compression=zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def _write_curve(curve: list[dict[str, Any]], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(curve[0]) if curve else ["timesteps", "seconds", "mean_success"])
        writer.writeheader()
        writer.writerows(curve)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", default="mt10-ars-ln")
    parser.add_argument("--device", default="cuda")
    parser.add_argument(
        "--time-budget", type=float, help="seconds of training in this call; default: no limit"
    )
    parser.add_argument("--checkpoint-every", type=float, default=60.0, help="seconds between checkpoints")
    parser.add_argument("--run", type=Path, default=Path("runs/gpu_mt10"), help="folder of the run")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder for what is worth keeping")
    own, rest = parser.parse_known_args(arguments)
    preset = load_preset(own.preset)
    preset = dataclasses.replace(preset, algorithm=dataclasses.replace(preset.algorithm, device=own.device))
    config = tyro.cli(RunConfig, default=preset, args=rest)
    try:
        result = run(config, own.preset, own.run, own.output, own.time_budget, own.checkpoint_every)
    except ConfigError as error:
        sys.exit(f"error: {error}")
    for key in ("timesteps", "steps_per_second", "updates_per_second", "gpu_idle_share", "mean_success"):
        print(f"{key}: {result[key]}")
    for found in result["goals"]:
        reached = "reached" if found["reached"] else "NOT reached"
        print(f"{reached}: {found['goal']}: {found['measured']:.3g} (wanted {found['wanted']:.3g})")


if __name__ == "__main__":
    main()
