"""Wrong inputs over the whole public surface: each has its own error, before an environment is stepped.

A message names the option, task or file, and says what is allowed or what to do. On the command line it is one line.
"""

# ruff: noqa: E501  # a row of the table is a line
import functools
import json
import math
import re
import shutil
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EveryNTimesteps
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ars import (
    ARSSAC,
    ARSTQC,
    ARSCallback,
    RunCheckpoint,
    SMTConfig,
    TaskEvalCallback,
    TaskScheduleCallback,
    evaluate_tasks,
    export_policy,
    load_policy,
    make_metaworld_env,
    make_multitask_env,
    make_toy_env,
)
from sb3_ars.cli import main
from sb3_ars.envs.toy import PointTask, toy_task
from sb3_ars.envs.vec_env import MultiTaskVecEnv
from sb3_ars.errors import CheckpointError, ConfigError
from sb3_ars.evaluation import EvaluationProtocol, make_evaluation_env
from sb3_ars.experiments.config import RunConfig, build, load_config, load_preset
from sb3_ars.experiments.scaling import load_scale
from sb3_ars.experiments.sweeps import load_sweep
from sb3_ars.tuning import load_search_space, tune
from sb3_ars.tuning.storage import open_storage
from sb3_ars.video import record

NAN, INF = math.nan, math.inf
TINY = {"batch_size": 4, "buffer_size": 100, "policy_kwargs": {"net_arch": [4]}}
PLAIN = "Pendulum-v1"


class Row(NamedTuple):
    """One bad input.

    :param name: what is wrong
    :param call: does it, given the files that ``ground`` made
    :param message: regular expression that the error's text must match
    :param error: its class
    """

    name: str
    call: Callable[[Any], object]
    message: str
    error: type[Exception] = ConfigError


def sac(message, algorithm=ARSSAC, env=None, **options):
    """A row of an option of the constructor, on the toy tasks."""
    given = ", ".join(f"{name}={value!r}" for name, value in options.items())
    return Row(
        f"{algorithm.__name__}({given})"[:90],
        lambda g: algorithm("MlpPolicy", env or make_toy_env(), **{**TINY, **options}),
        message,
    )


def policy(message, algorithm=ARSSAC, **options):
    """A row of ``policy_kwargs``."""
    return sac(message, algorithm, policy_kwargs={"net_arch": [4], **options})


def learn(name, message, error=ConfigError, model=None, **options):
    """A row of ``learn()``."""
    total = options.pop("total_timesteps", 400)
    make = functools.partial(ARSSAC, "MlpPolicy", **{**TINY, **(model or {})})
    return Row(name, lambda g: make(env=make_toy_env()).learn(total, **options), message, error)


CONSTRUCTOR = [
    sac("learning_rate='fast' must be a finite number of at least 0, or a schedule", learning_rate="fast"),
    sac("learning_rate=nan must be a finite number", learning_rate=NAN),
    sac("learning_rate=inf must be a finite number", learning_rate=INF),
    sac("learning_rate=None must be a finite number", learning_rate=None),
    sac("learning_rate=True must be a finite number", learning_rate=True),
    sac("buffer_size='1000' must be an integer of at least 1", buffer_size="1000"),
    sac(r"buffer_size=1000\.0 must be an integer of at least 1", buffer_size=1000.0),
    sac("buffer_size=10+ must be an integer of at most", buffer_size=10**30),
    sac("batch_size=True must be an integer of at least 1", batch_size=True),
    sac(r"batch_size=\[4\] must be an integer of at least 1", batch_size=[4]),
    sac("batch_size=-4 must be an integer of at least 1", batch_size=-4),
    sac("batch_size=101 rows per task is more than buffer_size=100", batch_size=101),
    sac("learning_starts='soon' must be 'auto' or a number", learning_starts="soon"),
    sac("learning_starts=None must be an integer", learning_starts=None),
    sac("tau=nan must be a finite number between 0 and 1", tau=NAN),
    sac("tau='small' must be a finite number between 0 and 1", tau="small"),
    sac("gamma=None must be a finite number between 0 and 1", gamma=None),
    sac(r"gamma=1\.01 must be a finite number between 0 and 1", gamma=1.01),
    sac(r"gamma=np.float32\(0.5\) must be a finite number between 0 and 1", gamma=np.float32(0.5)),
    sac("train_freq=0 must be an integer of at least 1, or a pair such as", train_freq=0),
    sac(r"train_freq=\(1, 'week'\) must be .* units are step, episode", train_freq=(1, "week")),
    sac(r"train_freq=\[1, 'step'\] must be", train_freq=[1, "step"]),
    sac("train_freq='1' must be", train_freq="1"),
    sac("gradient_steps=-2 must be an integer of at least 0, or -1", gradient_steps=-2),
    sac(r"gradient_steps=1\.5 must be an integer", gradient_steps=1.5),
    sac("action_noise=0.1 must be None or an ActionNoise", action_noise=0.1),
    sac("replay_buffer_class='TaskReplayBuffer' must be None or a subclass", replay_buffer_class="TaskReplayBuffer"),
    sac("replay_buffer_kwargs=3 must be None or a mapping", replay_buffer_kwargs=3),
    sac("replay_buffer_kwargs=.*do not fit TaskReplayBuffer: .*'size'", replay_buffer_kwargs={"size": 3}),
    sac("replay_buffer_kwargs sets seed, which ARSSAC does itself", replay_buffer_kwargs={"seed": 3}),
    sac("optimize_memory_usage='yes' must be True or False", optimize_memory_usage="yes"),
    sac("n_steps=0 must be an integer of at least 1", n_steps=0),
    sac("n_steps=3 is not available with several tasks; use n_steps=1", n_steps=3),
    sac("ent_coef='auto_' must be 'auto', 'auto_' and a first value above 0", ent_coef="auto_"),
    sac("ent_coef='auto_0' must be", ent_coef="auto_0"),
    sac("ent_coef='auto_nan' must be", ent_coef="auto_nan"),
    sac("ent_coef=None must be", ent_coef=None),
    sac("ent_coef=inf must be", ent_coef=INF),
    sac("target_update_interval=0 must be an integer of at least 1", target_update_interval=0),
    sac("target_entropy='low' must be 'auto' or a finite number", target_entropy="low"),
    sac("target_entropy=nan must be 'auto' or a finite number", target_entropy=NAN),
    sac("use_sde=1 must be True or False", use_sde=1),
    sac(r"use_sde=True \(gSDE\) is not supported.*Use False", use_sde=True),
    sac("stats_window_size=10+ must be an integer of at most", stats_window_size=10**30),
    sac("tensorboard_log=3 must be None or the path of a folder", tensorboard_log=3),
    sac(r"policy_kwargs=\[4\] must be None or a mapping of options by name", policy_kwargs=[4]),
    sac("verbose='yes' must be 0 .silent., 1", verbose="yes"),
    sac("seed=-1 must be None or an int from 0 to 4294967295", seed=-1),
    sac("seed=4294967296 must be None or an int from 0", seed=2**32),
    sac(r"seed=np.int64\(0\) must be None or an int from 0", seed=np.int64(0)),
    sac("seed='0' must be None or an int from 0", seed="0"),
    sac("device='gpu7' is no device of torch's; give 'auto', 'cpu', 'cuda'", device="gpu7"),
    sac("device=None is no device of torch's", device=None),
    sac(r"n_reset=np.float64\(2.0\) must be an integer of at least 0", n_reset=np.float64(2)),
    sac("n_reset=1 and param_resets=5 both say when to reset; give one", n_reset=1, param_resets=5),
    sac("param_resets=5 must be a list of environment steps", param_resets=5),
    sac("param_resets entry=nan must be an integer", param_resets=[NAN]),
    sac("reward_scaling=.maen. is unknown; choose one of .*Did you mean 'mean'", reward_scaling="maen"),
    sac("reward_scaling for task 'point-east' is 'x'; it must be a positive number", reward_scaling=["x"] * 4),
    sac("reward_scaling for task 'point-east' is nan", reward_scaling=NAN),
    sac("reward_scaling for task 'point-east' is True", reward_scaling=True),
    sac("reward_scaling names the task 'point-est', .*Did you mean 'point-", reward_scaling={"point-est": 2.0}),
    sac("reward_floor=nan must be a positive number", reward_floor=NAN),
    sac("reset=True is unknown; choose one of", reset=True),
    sac("reset=.*is unknown; choose one of", reset=np.array(["critic", "none"])),
    sac("updates_after_reset=None must be an integer of at least 0", updates_after_reset=None),
    sac("gradient='pcgard' is unknown.*Did you mean 'pcgrad'", gradient="pcgard"),
    sac("task_weighting=1 is unknown; choose one of", task_weighting=1),
    sac("task_weighting='temperature' .*needs several tasks and ent_coef='auto'", task_weighting="temperature", ent_coef=0.1),
    sac("max_task_loss=inf must be a positive number", max_task_loss=INF),
    sac("precision='fp16' is unknown; choose one of", precision="fp16"),
    sac("execution='gpu' is unknown; choose one of", execution="gpu"),
    sac("overlap=1 must be True, False or None", overlap=1),
    sac("overlap=True needs train_freq in steps", env=make_toy_env(tasks=["point-east"]), overlap=True, train_freq=(1, "episode")),
    sac("train_freq=.1, 'episode'. needs a single environment, and here are 4", train_freq=(1, "episode")),
    sac("top_quantiles_to_drop_per_net=25 must be less than n_quantiles=25", ARSTQC, top_quantiles_to_drop_per_net=25),
    sac("top_quantiles_to_drop_per_net=None must be an integer", ARSTQC, top_quantiles_to_drop_per_net=None),
    Row("an unknown policy", lambda g: ARSSAC("MlpPolcy", make_toy_env()), "policy='MlpPolcy' .*Did you mean 'MlpPolicy'"),
    Row("a policy that is an instance", lambda g: ARSSAC(3, make_toy_env()), "policy=3 is unknown; choose one of"),
    Row("an unknown environment", lambda g: ARSSAC("MlpPolicy", "Reach-v9"), "env='Reach-v9' is no environment that Gymnasium"),
    Row("an environment not made yet", lambda g: ARSSAC("MlpPolicy", make_toy_env), "env=<function .*Call it"),
    Row("an environment that is a list", lambda g: ARSSAC("MlpPolicy", ["push"]), r"env=\['push'\] must be an environment"),
    sac("gradient needs an environment with named tasks; make it with", env=PLAIN, gradient="pcgrad"),
    sac("gradient='pcgrad' .*with one task use 'mean'", env=make_toy_env(tasks=["point-east"]), gradient="pcgrad"),
    Row(
        "rewards normalised over all tasks",
        lambda g: ARSSAC("MlpPolicy", VecNormalize(make_toy_env()), **TINY),
        r"norm_reward=True.*Use VecNormalize\(norm_reward=False\)",
    ),
]  # fmt: skip

POLICY = [
    policy("policy_kwargs=.*make no policy: .*'net_arhc'", net_arhc=[4]),
    policy("policy option net_arch='4' must be a list of widths", net_arch="4"),
    policy("policy option net_arch=4 must be a list of widths", net_arch=4),
    policy("policy option net_arch entry=0 must be an integer", net_arch=[4, 0]),
    policy("policy option net_arch entry='4' must be an integer", net_arch=["4"]),
    policy("policy option net_arch=.* must have the keys 'pi' and 'qf'", net_arch={"pi": [4], "vf": [4]}),
    policy("policy option activation_fn='relu' must be a class of torch.nn", activation_fn="relu"),
    policy("policy option critic_activation_fn=ReLU.* must be a class of torch.nn", critic_activation_fn=th.nn.ReLU()),
    policy("policy option n_critics=0 must be an integer of at least 1", n_critics=0),
    policy("policy option n_quantiles='25' must be an integer", ARSTQC, n_quantiles="25"),
    policy("policy option std='sigmoid' is unknown; choose one of", std="sigmoid"),
    policy("policy option critic_layer_norm=1 must be True or False", critic_layer_norm=1),
    policy("policy_kwargs=.*make no policy: .*'speed'", optimizer_kwargs={"speed": 1}),
    policy("lora belongs to ARSSAC's own arguments, not to policy_kwargs", lora={"rank": 2}),
    policy("body='moore' must be a mapping of options, such as", body="moore"),
    policy("body name='more' is unknown.*Did you mean 'moore'", body={"name": "more"}),
    policy("body name=None is unknown; choose one of", body={"n_experts": 2}),
    policy("body 'moore' has no option 'n_expert'.*Did you mean 'n_experts'", body={"name": "moore", "n_expert": 2}),
    policy("body 'moore', option n_experts=0 must be an integer", body={"name": "moore", "n_experts": 0}),
    policy("option n_experts=5 exceeds the last width.*Use fewer experts", body={"name": "moore", "n_experts": 5}),
    policy("body 'paco', option n_parameter_sets=True must be", body={"name": "paco", "n_parameter_sets": True}),
    policy("body='popart' is an output layer of critics; give it as critic_body", body={"name": "popart"}),
    policy("critic_body='popart' .*Use reward_scaling='none'", critic_body={"name": "popart"}),
    sac("body 'popart', option rate=2 must be above 0", reward_scaling="none", policy_kwargs={"net_arch": [4], "critic_body": {"name": "popart", "rate": 2}}),
    policy("body=3 must be a mapping", critic_body=3),
    sac("lora='yes' must be a mapping of options, such as", lora="yes"),
    sac("lora has no option 'rnak'.*Did you mean 'rank'", lora={"rnak": 2}),
    sac("lora option rank=0 must be an integer", lora={"rank": 0}),
    sac("lora option start=2 must be between 0 and 1", lora={"start": 2}),
    sac("lora option scale=1 is unknown; choose one of", lora={"scale": 1}),
    sac("rank=5 .*(width|wide)", lora={"rank": 5}),
    sac("lora takes the place of resets.*use reset='actor_critic'", lora={"rank": 1}, reset="none"),
    sac("lora adapts the plain network; leave body.* out", lora={"rank": 1}, policy_kwargs={"net_arch": [4], "body": {"name": "multi_head"}}),
]  # fmt: skip

LEARN = [
    learn("a total in words", "total_timesteps='many' must be a whole number", total_timesteps="many"),
    learn("a total with a fraction", r"total_timesteps=0\.5 must be a whole number", total_timesteps=0.5),
    learn("an endless total", "total_timesteps=inf must be a whole number", total_timesteps=INF),
    learn("log_interval=0", "log_interval=0 must be an integer of at least 1", log_interval=0),
    learn("a callback that is a number", "callback=5 must be a callback of SB3's, a list", callback=5),
    learn("a callback class", "callback=<class .*Call the class", callback=ARSCallback),
    learn("a list with no callback in it", "callback=3 must be a callback", callback=[ARSCallback(), 3]),
    learn("tb_log_name=3", "tb_log_name=3 must be the name", tb_log_name=3),
    learn("reset_num_timesteps=None", "reset_num_timesteps=None must be True or False", reset_num_timesteps=None),
    learn("progress_bar='yes'", "progress_bar='yes' must be True or False", progress_bar="yes"),
    learn("more resets than steps", r"n_reset asks for 10+ resets in 400 steps; .*n_reset=0", model={"n_reset": 10**12}),
    learn("a reset in the random phase", "param_resets asks for 1 resets.*set learning_starts", model={"param_resets": [3]}),
    learn("too short a random phase", "learning_starts=3 .*use learning_starts=16 or more", model={"learning_starts": 3}),
    learn("a buffer larger than memory", "do not fit", model={"buffer_size": 10**12}),
    learn("adapters after the last reset", r"lora adds its adapters.*Lower start", model={"lora": {"rank": 1, "start": 1.0}}),
    learn("ARSCallback in an event", "ARSCallback inside an event callback.*pass it to learn", callback=EveryNTimesteps(9, ARSCallback())),
]  # fmt: skip

CALLBACKS = [
    Row("RunCheckpoint(None)", lambda g: RunCheckpoint(None), "folder=None must be a path"),
    Row("verbose='x'", lambda g: RunCheckpoint("c", verbose="x"), "verbose='x' must be 0 .silent., 1"),
    Row("notes of an object", lambda g: RunCheckpoint("c", notes={"a": object()}), "notes=.*must be a mapping of plain values"),
    Row("files of numbers", lambda g: RunCheckpoint("c", files=[3]), "files entry=3 must be a path"),
    Row("a schedule's verbose", lambda g: TaskScheduleCallback(verbose=None), "verbose=None must be 0"),
    Row("RunCheckpoint(3)", lambda g: RunCheckpoint(3), "folder=3 must be a path"),
    Row("every=0.5", lambda g: RunCheckpoint("c", every=0.5), r"every=0\.5 must be an integer of at least 1"),
    Row("every_minutes=nan", lambda g: RunCheckpoint("c", every_minutes=NAN), "every_minutes=nan must be a positive number"),
    Row("every_minutes='5'", lambda g: RunCheckpoint("c", every_minutes="5"), "every_minutes='5' must be a positive number"),
    Row("keep=0", lambda g: RunCheckpoint("c", keep=0), "keep=0 must be an integer of at least 1"),
    Row("handle_signals=2", lambda g: RunCheckpoint("c", handle_signals=2), "handle_signals=2 must be True or False"),
    Row("notes='x'", lambda g: RunCheckpoint("c", notes="x"), "notes='x' must be a mapping"),
    Row("files='x'", lambda g: RunCheckpoint("c", files="progress.csv"), "files='progress.csv' must be a list of paths"),
    Row("no interval", lambda g: RunCheckpoint("c", None, None, handle_signals=False), "would never write a checkpoint"),
    learn("a folder that is a file", "folder of checkpoints .*choose another", callback=RunCheckpoint("/dev/null/x")),
    learn("RunCheckpoint in an event", "pass it to learn", callback=EveryNTimesteps(9, RunCheckpoint("c"))),
    Row("RunCheckpoint for SAC", lambda g: SAC("MlpPolicy", PLAIN).learn(9, RunCheckpoint("c")), "not of SAC; use SB3's"),
    Row("ARSCallback for SAC", lambda g: SAC("MlpPolicy", PLAIN).learn(9, ARSCallback()), "ARSCallback is the bookkeeping of.*Leave it out"),
    Row("schedule for SAC", lambda g: SAC("MlpPolicy", PLAIN).learn(9, TaskScheduleCallback()), "a SAC has none. Leave it out"),
    Row("eval_env that is a name", lambda g: TaskEvalCallback("MT10", 100), "eval_env='MT10' must be an environment with tasks"),
    Row("eval_freq=0", lambda g: TaskEvalCallback(make_toy_env(), 0), "eval_freq=0 must be an integer of at least 1"),
    Row("eval protocol", lambda g: TaskEvalCallback(make_toy_env(), 9, "papre"), "protocol 'papre'.*Did you mean 'paper'"),
    Row("eval deterministic", lambda g: TaskEvalCallback(make_toy_env(), 9, deterministic=None), "deterministic=None must be True"),
    Row("eval path", lambda g: TaskEvalCallback(make_toy_env(), 9, log_path=1), "log_path=1 must be a path"),
    Row("eval callback", lambda g: TaskEvalCallback(make_toy_env(), 9, callback_after_eval=print), "callback_after_eval=.*must be a callback"),
    learn("evaluation without tasks", "evaluation environment has no tasks; make it with", callback=TaskEvalCallback(DummyVecEnv([PointTask]), 9, "env")),
    learn("evaluation of other tasks", "trained on .*but the evaluation environment has", callback=TaskEvalCallback(make_toy_env(tasks=["point-east"]), 9, "env")),
    learn("evaluation at another horizon", "max_episode_steps is 50. Make it with", callback=TaskEvalCallback(make_toy_env(), 9, "paper")),
    Row("schedule config", lambda g: TaskScheduleCallback({"pool_size": 2}), "must be an SMTConfig, such as"),
    Row("SMT pool", lambda g: SMTConfig(pool_size="3"), "pool_size='3' must be an integer"),
    Row("SMT share", lambda g: SMTConfig(solved=NAN), "solved=nan must be"),
    learn("SMT with every task in the pool", "pool_size=4 holds all 4 tasks.*use pool_size=3 or less", callback=TaskScheduleCallback(SMTConfig(pool_size=4))),
    learn("SMT with a long interval", "use a smaller interval", callback=TaskScheduleCallback(SMTConfig(pool_size=2))),
    learn("SMT in an event", "pass it to learn", callback=EveryNTimesteps(9, TaskScheduleCallback())),
]  # fmt: skip


def toy(message, **options):
    """A row of ``make_toy_env``."""
    return Row(f"make_toy_env({options})"[:90], lambda g: make_toy_env(**options), message)


def world(message, tasks="reach", **options):
    """A row of ``make_metaworld_env``."""
    name = f"make_metaworld_env({tasks!r}, {options})"[:90]
    return Row(name, lambda g: make_metaworld_env(tasks, **options), message)


def tasks(message, given, **options):
    """A row of ``make_multitask_env``."""
    name = f"make_multitask_env({type(given).__name__}, {options}): {message}"[:90]  # no addresses, for xdist
    return Row(name, lambda g: make_multitask_env(given, **options), message)


def boxed(observations=6, actions=2, low=-1.0):
    """Return a function that makes an environment with such spaces."""

    class Boxed(PointTask):
        def __init__(self):
            super().__init__()
            self.observation_space = gym.spaces.Box(-1, 1, (observations,), np.float32)
            self.action_space = gym.spaces.Box(low, 1, (actions,), np.float32)

    return Boxed


TWO = {"a": PointTask, "b": PointTask}
ENVS = [
    toy("tasks='point-west' must be a list of toy tasks' names", tasks="point-west"),
    toy("tasks=3 must be a list", tasks=3),
    toy("tasks: 'push' is no toy task; there are point-east", tasks=["push"]),
    toy(r"tasks=\[\] must name at least one toy task", tasks=[]),
    toy("must name at least one toy task, and each once", tasks=["point-east", "point-east"]),
    toy("reward_scales must hold 1 to 360 positive numbers", reward_scales=["1", "2"]),
    toy("reward_scales must hold 1 to 360 positive numbers", reward_scales=[1.0, NAN]),
    toy("reward_scales='1234' must be a list", reward_scales="1234"),
    toy("max_episode_steps=0 must be an integer", max_episode_steps=0),
    toy("n_envs_per_task='2' must be an integer", n_envs_per_task="2"),
    toy("seed must be None or an integer of at least 0, got -1", seed=-1),
    toy("seed must be None or an integer of at least 0, got 1.5", seed=1.5),
    toy("n_workers=9 is more than the 4 env.*give at most 4", n_workers=9),
    toy("n_workers must be 'auto' or an integer of at least 0, got 'all'", n_workers="all"),
    toy("n_workers must be 'auto' or an integer of at least 0, got True", n_workers=True),
    toy("start_method must be one of .*got 'thread'", start_method="thread"),
    toy("worker_timeout must be a positive finite number of seconds, got inf", worker_timeout=INF),
    toy("worker_timeout must be a positive finite number of seconds, got '5'", worker_timeout="5"),
    toy("restart_workers='yes' must be True or False", restart_workers="yes"),
    toy("restart_workers=True with n_workers=0.*Give n_workers=1 or more", restart_workers=True),
    toy("render_mode must be one of 'rgb_array', got 'human'", render_mode="human"),
    toy("render_size=8 must be an integer of at least 16", render_mode="rgb_array", render_size=8),
    Row("toy_task", lambda g: toy_task("west"), "'west' is no toy task; there are point-east"),
    world("'raech' is not a Meta-World task.*Did you mean 'reach", "raech"),
    world("'MT11' is not a Meta-World task.*Give 'MT10'", "MT11"),
    world("tasks is empty: give 'MT10'", []),
    world("'push-v3' given more than once; for several envs of one task use", ["push", "push-v3"]),
    world("tasks=3 must be 'MT10'", 3),
    world("tasks: 3 is not a Meta-World task", [3]),
    world("goals must be one of .*got 'fixed'", goals="fixed"),
    world("reward_version must be one of 'v2', 'v1', got 'v3'", reward_version="v3"),
    world("max_episode_steps='500' must be an integer", max_episode_steps="500"),
    world("n_goals=0 must be an integer", n_goals=0),
    world("goal_seed must be an integer from 0", goal_seed=None),
    world("fast=1 must be True or False", fast=1),
    world("render_mode must be one of", render_mode="mp4"),
    world("camera.*'top'.*topview", render_mode="rgb_array", camera="top"),
    tasks("tasks is empty: give at least one task", {}),
    tasks("tasks must be a mapping .*got str", "MT10"),
    tasks("each item of the list must be a pair", [PointTask]),
    tasks("task 'a' is given more than once.*use n_envs_per_task", [("a", PointTask), ("a", PointTask)]),
    tasks("task names must be non-empty strings, got 3", {3: PointTask}),
    tasks("task 'a': expected a function .*Give a function that makes a new one", {"a": PointTask()}),
    tasks("task 'a'.*(str|env)", {"a": lambda: "env"}, n_workers=0),
    tasks("task 'a' has 1 factories, but n_envs_per_task=2: give as many", {"a": [PointTask]}, n_envs_per_task=2),
    tasks("'a' and 'b' have observations of different shapes.*pad the shorter", {"a": PointTask, "b": boxed(5)}, n_workers=0),
    tasks("'a' and 'b' have different action spaces.*RescaleAction", {"a": PointTask, "b": boxed(actions=3)}, n_workers=0),
    tasks("action bounds must be finite.*Give bounds", {"a": boxed(low=-INF)}, n_workers=0),
    tasks("task 'a': the action space must be a Box of floats", {"a": lambda: gym.make("CartPole-v1")}, n_workers=0),
    tasks("max_episode_steps=-1 must be an integer", TWO, max_episode_steps=-1),
    tasks("task_names and task_of_env are for vector envs that are already built", TWO, task_names=["a", "b"]),
    tasks("task_of_env is missing.*Give a task index for each", DummyVecEnv([PointTask])),
    tasks("task_of_env must hold one integer", DummyVecEnv([PointTask]), task_of_env=[[0], [0, 1]]),
    tasks("task_of_env must number the tasks 0, 1, 2", DummyVecEnv([PointTask]), task_of_env=[1]),
    tasks("task_names has 2 names for 1 tasks", DummyVecEnv([PointTask]), task_of_env=[0], task_names=["a", "b"]),
    tasks("n_workers=2 cannot change a DummyVecEnv", DummyVecEnv([PointTask]), task_of_env=[0], n_workers=2),
    tasks("worker_timeout=1 cannot change a DummyVecEnv", DummyVecEnv([PointTask]), task_of_env=[0], worker_timeout=1),
]  # fmt: skip

EVALUATION = [
    Row("no model", lambda g: evaluate_tasks(None, make_toy_env(), "env"), r"model=None has no predict\(\); give a trained model"),
    Row("a path for a model", lambda g: evaluate_tasks("model.zip", make_toy_env(), "env"), "model='model.zip' has no predict"),
    Row("a plain environment", lambda g: evaluate_tasks(g.model, PointTask(), "env"), "has no tasks; make the environment"),
    Row("no environment", lambda g: evaluate_tasks(g.model, None, "env"), "tasks=None must be 'MT10'"),
    Row("its own environment", lambda g: evaluate_tasks(g.model, g.model.env, "env"), "make a separate one"),
    Row("a protocol that is a number", lambda g: evaluate_tasks(g.model, make_toy_env(), 5), "protocol=5 must be one of"),
    Row("no episodes", lambda g: evaluate_tasks(g.model, make_toy_env(), EvaluationProtocol("x", 0)), "protocol 'x': n_episodes=0 must be"),
    Row("half an episode", lambda g: evaluate_tasks(g.model, make_toy_env(), EvaluationProtocol("x", 0.5)), r"n_episodes=0\.5 must be"),
    Row("a negative seed", lambda g: evaluate_tasks(g.model, make_toy_env(), "env", seed=-1), "seed=-1 must be an integer of at least 0"),
    Row("deterministic='no'", lambda g: evaluate_tasks(g.model, make_toy_env(), "env", deterministic="no"), "deterministic='no' must be True"),
    Row("make_evaluation_env", lambda g: make_evaluation_env("MT10", "h15"), "protocol 'h15'.*Did you mean 'h150'"),
    Row("predict for no task", lambda g: g.model.predict(np.zeros(6), task="east"), "task='east' is not one of this model's tasks"),
    Row("predict without the task", lambda g: g.model.predict(np.zeros(6)), "lacks the one-hot task id; say which task"),
    Row("no task active", lambda g: g.model.set_active_tasks([]), r"set_active_tasks\(\[\]\) would collect nothing; name at least one"),
    Row("an unknown task active", lambda g: g.model.set_active_tasks(["push"]), "task='push' is not one of this model's tasks"),
    Row("one name for a list", lambda g: g.model.set_active_tasks("point-east"), "tasks='point-east' must be a list"),
    Row("a number for a list", lambda g: g.model.set_active_tasks(3), "tasks=3 must be a list of tasks"),
    Row("set_env to nothing", lambda g: g.model.set_env(None), "env=None: set_env needs an environment"),
    Row("set_env to a number", lambda g: g.model.set_env(3), "env=3 must be an environment"),
    Row("record on a number", lambda g: record(g.model, "point-east", env=3), "env=3 must be an environment with tasks"),
    Row("record no episode", lambda g: record(g.model, "point-east", n_episodes=0), "n_episodes .--episodes.=0 must be an integer"),
    Row("record without pictures", lambda g: record(g.model, "point-east", env=make_toy_env()), "render_mode"),
    Row("another task list", lambda g: g.model.set_env(make_toy_env(tasks=["point-west"])), "Make the environment with the model's task list"),
    Row("no adapters asked for", lambda g: g.model.enable_lora(), "needs the option lora"),
]  # fmt: skip

FILES = [
    Row("load nothing", lambda g: ARSSAC.load(g.path / "none"), "none", FileNotFoundError),
    Row("load a number", lambda g: ARSSAC.load(3), "path=3 must be a path"),
    Row("load text", lambda g: ARSSAC.load(g.text), "text.zip is not a saved model"),
    Row("load text with an environment", lambda g: ARSSAC.load(g.text, make_toy_env()), "text.zip is not a saved model"),
    Row("load another zip", lambda g: ARSSAC.load(g.foreign), "foreign.zip is not a saved model"),
    Row("load as TQC", lambda g: ARSTQC.load(g.saved), "A model saved by another algorithm loads with that algorithm"),
    Row("load for other tasks", lambda g: ARSSAC.load(g.saved, make_toy_env(tasks=["point-east"])), "was trained on .*Make the environment"),
    Row("load with a misspelt option", lambda g: ARSSAC.load(g.saved, n_rest=2), "'n_rest' is no option of ARSSAC. Did you mean 'n_reset'"),
    Row("load with a wrong option", lambda g: ARSSAC.load(g.saved, tau="x"), "tau='x' must be a finite number between 0 and 1"),
    Row("load with no environment", lambda g: ARSSAC.load(g.saved, env=3), "env=3 must be an environment"),
    Row("load a buffer of nothing", lambda g: g.model.load_replay_buffer(g.text), "text.zip"),
    Row("resume nothing", lambda g: ARSSAC.resume(g.path / "none", make_toy_env()), "holds no checkpoint. Give the folder", CheckpointError),
    Row("resume a number", lambda g: ARSSAC.resume(3, make_toy_env()), "path=3 must be a path"),
    Row("resume a file", lambda g: ARSSAC.resume(g.text, make_toy_env()), "holds no checkpoint", CheckpointError),
    Row("resume as TQC", lambda g: ARSTQC.resume(g.checkpoints, make_toy_env()), r"is of ARSSAC; use ARSSAC.resume", CheckpointError),
    Row("resume with other tasks", lambda g: ARSSAC.resume(g.checkpoints, make_toy_env(tasks=["point-east"])), "tasks"),
    Row("resume without an environment", lambda g: ARSSAC.resume(g.checkpoints, None), "env=None"),
    Row("resume with a misspelt option", lambda g: ARSSAC.resume(g.checkpoints, make_toy_env(), devise="cpu"), "'devise' is no option .*'device'"),
    Row("resume with a wrong option", lambda g: ARSSAC.resume(g.checkpoints, make_toy_env(), gamma=2), "gamma=2 must be a finite number"),
    Row("resume a damaged one", lambda g: ARSSAC.resume(g.damaged, make_toy_env()), "No checkpoint in .* is whole: .*manifest.json is damaged", CheckpointError),
    Row("resume a later format", lambda g: ARSSAC.resume(g.later, make_toy_env()), "has format 99.*resume with the version that wrote it", CheckpointError),
    Row("export no model", lambda g: export_policy("model.zip", g.path / "p"), "export_policy takes an ARSSAC or ARSTQC model, not str"),
    Row("export SB3's SAC", lambda g: export_policy(SAC("MlpPolicy", PLAIN), g.path / "p"), "ARSSAC or ARSTQC"),
    Row("export to a number", lambda g: export_policy(g.model, 3), "path=3 must be a path"),
    Row("load_policy of nothing", lambda g: load_policy(g.path / "none.safetensors"), "none.safetensors cannot be loaded as a policy: there is no such file"),
    Row("load_policy of a zip", lambda g: load_policy(g.saved), "model.zip cannot be loaded as a policy: it is a zip.*load it with ARSSAC.load"),
    Row("load_policy of text", lambda g: load_policy(g.text), "text.zip cannot be loaded as a policy"),
    Row("load_policy of a number", lambda g: load_policy(3), "path=3 must be a path"),
    Row("load_policy on no device", lambda g: load_policy(g.policy, device="gpu7"), "device='gpu7' is no device"),
]  # fmt: skip


def config(message, load=lambda values: build(RunConfig, values, "mine"), **values):
    """A row of a configuration's file."""
    return Row(f"config {values}"[:90], lambda g: load(values), message)


def scale(message, **values):
    """A row of a scale's file."""

    def load(g):
        (g.path / "mine.yaml").write_text(yaml.safe_dump(values))
        return load_scale(str(g.path / "mine.yaml"))

    return Row(f"scale {values}"[:90], load, message)


def space(message, **options):
    """A row of a search space."""
    return Row(f"space {options}"[:90], lambda g: load_search_space({"ars.n_reset": options}), message)


CONFIGURATIONS = [
    config("mine: 'sede' is no option of RunConfig.*Did you mean 'seed'", sede=3),
    config("mine: seed='3' must be int", seed="3"),
    config("mine: seed=True must be int", seed=True),
    config("mine: output=3 must be Path", output=3),
    config("mine: EnvConfig must be a mapping of options, not 'MT10'", env="MT10"),
    config("mine: AlgorithmConfig must be a mapping of options, not 0", algorithm=0),
    config("mine: tasks=7 must be str | tuple", env={"tasks": 7}),
    config("mine: n_workers='all' must be int | Literal\\['auto'\\]", env={"n_workers": "all"}),
    config("mine: goals='fixed' is unknown; choose one of random, stored", env={"goals": "fixed"}),
    config("mine: learning_rate='1e-4' must be float .YAML reads 1e-4 as text", algorithm={"learning_rate": "1e-4"}),
    config("mine: total_timesteps=1.5 must be int", algorithm={"total_timesteps": 1.5}),
    config("mine: overlap=1 must be bool | None", algorithm={"overlap": 1}),
    config("algorithm.train_freq=0 must be an integer", algorithm={"train_freq": 0}),
    config("policy.net_arch='400' must be a list of widths", policy={"net_arch": "400"}),
    config("mine: body='moor' is unknown.*Did you mean 'moore'", policy={"body": "moor"}),
    config("policy.body_options=.* go with a body", policy={"body_options": {"n_experts": 2}}),
    config("evaluation.every=0 must be an integer", evaluation={"every": 0}),
    config("every_minutes=-1 must be a positive number", checkpoint={"every_minutes": -1}),
    config("schedule.pool_size=2 goes with a schedule", schedule={"pool_size": 2}),
    config("mine: reward_scaling=.*must be", ars={"reward_scaling": {3: 1.0}}),
    Row("an unknown preset", lambda g: load_preset("mt10-asr"), "There is no preset 'mt10-asr'.*Did you mean 'mt10-ars'"),
    Row("a preset that is no name", lambda g: load_preset(3), "There is no preset 3"),
    Row("no configuration there", lambda g: load_config(g.path / "none.yaml"), "none.yaml does not exist; the folder of a run"),
    Row("a configuration that is a number", lambda g: load_config(3), "path=3 must be a path"),
    Row("a scale that is a number", lambda g: load_scale(3), "scale=3 must be a path"),
    Row("a sweep that is a number", lambda g: load_sweep(3), "table or figure=3 must be a path"),
    Row("tune for no time", lambda g: tune("toy", timeout="1"), "timeout .--timeout. is '1' s, but must be"),
    Row("tune a number", lambda g: tune(3), "preset=3 must be a preset's name, or a RunConfig"),
    Row("tune by a folder's path", lambda g: tune("toy", name="../x"), "name .--study.='../x' must be the name of a folder"),
    Row("tune with half a seed", lambda g: tune("toy", n_seeds=1.5), "n_seeds .--seeds.=1.5 must be an integer"),
    Row("tune with no list", lambda g: tune("toy", callbacks=print), "callbacks=.*must be a list"),
    Row("an unknown scale", lambda g: load_scale("smal"), "There is no scale 'smal'.*Did you mean 'small'"),
    Row("an unknown sweep", lambda g: load_sweep("table0"), "There is no table or figure 'table0'.*give the path"),
    scale("scale mine: n_workers='all' must be", options={"env": {"n_workers": "all"}}),
    scale("scale mine: profile=1 must be bool", options={"profile": 1}),
    scale("scale mine: verbose='no' must be int", options={"verbose": "no"}),
    scale("scale mine: device=0 must be str", options={"algorithm": {"device": 0}}),
    scale("keep=0 must be an integer", options={"checkpoint": {"keep": 0}}),
    scale("scale mine: tasks is no scale's to set|tasks is no scale's to set", options={"env": {"tasks": "MT10"}}),
    scale("scale mine: options=3 must be a mapping", options=3),
    scale("scale mine: steps_per_task='100' must be an integer", steps_per_task="100"),
    scale("scale mine: at_most hidden_width='8' must be an integer of at least 1", at_most={"hidden_width": "8"}),
    scale("at_most hidden_width=.*must be", at_most={"hidden_width": 8.5}),
    scale("at_most hidden_width=.*must be", at_most={"hidden_width": NAN}),
    scale("resets_until=nan must be a share of the run", resets_until=NAN),
    scale("resets_at=.*must be a list of increasing shares", resets_at=[0.5, "x"]),
    scale("'step_per_task' is no option of Scale.*Did you mean 'steps_per_task'", step_per_task=3),
    space("type='integer' is unknown; choose int, float", type="integer", low=0, high=9),
    space("low='0' must be an integer", type="int", low="0", high=9),
    space("ars.n_reset: high=None must be an integer", type="int", low=0),
    space("ars.n_reset: low=9, high=0 cannot be", type="int", low=9, high=0),
    space("log='yes' must be True or False", type="int", low=1, high=9, log="yes"),
    space("step=0 .*(positive|above 0|at least 1)", type="int", low=0, high=9, step=0),
    Row("a search space from NaN", lambda g: load_search_space({"algorithm.tau": {"type": "float", "low": NAN, "high": 1.0}}), "tau: low=nan must be a finite number"),
    space("ars.n_reset has no 'hihg'.*Did you mean 'high'", type="int", low=0, hihg=9),
    Row("an unknown search space", lambda g: load_search_space("reset"), "no search space 'reset'.*Did you mean 'resets'"),
    Row("a search space that is a number", lambda g: load_search_space(3), "space=3 must be a path"),
    Row("a journal that is a folder", lambda g: open_storage(g.path), "journal .* cannot be written .Is a directory.; choose another"),
    Row("a journal of text", lambda g: open_storage(g.text), "text.zip is no journal of Optuna's"),
    Row("a URL that is none", lambda g: open_storage("postgres://:::"), "--storage is no valid URL"),
    Row("an unknown database", lambda g: open_storage("nosuchdb://host/name"), "nosuchdb"),
]  # fmt: skip


def cli(message, *arguments):
    """A row of the command line; ``{name}`` in an argument is a file that ``ground`` made."""
    return Row(" ".join(arguments)[:90], lambda g: [a.format(**vars(g)) for a in arguments], message)


COMMANDS = [
    cli("There is no command 'trian'.*Did you mean 'train'", "trian"),
    cli("'mt10-asr'.*Did you mean 'mt10-ars'", "train", "mt10-asr"),
    cli("Unrecognized options: --sede", "train", "toy", "--sede", "3"),
    cli("--seed: invalid literal for int.*'x'", "train", "toy", "--seed", "x"),
    cli("n_reset=-1 must be an integer of at least 0", "train", "toy", "--ars.param-resets", "None", "--ars.n-reset", "-1"),
    cli("gamma=2.0 must be a finite number between 0 and 1", "train", "toy", "--algorithm.gamma", "2", "--output", "{path}/o"),
    cli("seed must be None or an integer of at least 0, got -1", "train", "toy", "--seed", "-1", "--output", "{path}/o"),
    cli("total_timesteps=-5 must be", "train", "toy", "--algorithm.total-timesteps", "-5", "--output", "{path}/o"),
    cli("device='gpu7' is no device", "train", "toy", "--algorithm.device", "gpu7", "--output", "{path}/o"),
    cli("'pusch' is no(t a Meta-World| toy) task", "train", "mt10-ars", "--env.tasks", "pusch", "--output", "{path}/o"),
    cli("protocol 'papr'.*Did you mean 'paper'", "train", "toy", "--evaluation.protocol", "papr", "--output", "{path}/o"),
    cli("log_interval=0 must be an integer", "train", "toy", "--log-interval", "0", "--output", "{path}/o"),
    cli("choose another --output", "train", "toy", "--output", "{text}"),
    cli("none.yaml does not exist", "train", "none.yaml"),
    cli("wrong.yaml is not the configuration of a run", "train", "{wrong}"),
    cli("torn.yaml is not valid YAML", "train", "{torn}"),
    cli("PRESET.*'sb3-ars list' shows", "train", "--seed", "3"),
    cli("none/config.yaml does not exist; the folder of a run", "train", "--resume", "{path}/none"),
    cli("has finished; there is nothing to resume", "train", "--resume", "{run}"),
    cli("config.yaml does not exist", "train", "--resume", "{checkpoints}"),
    cli("holds no checkpoint", "train", "--resume", "{begun}"),
    cli("--resume takes one argument, the folder of a run", "train", "--resume", "{run}", "--seed", "3"),
    cli("none/config.yaml does not exist", "evaluate", "{path}/none"),
    cli("holds no policy.zip; the run did not finish", "evaluate", "{begun}"),
    cli("protocol 'h15'.*Did you mean 'h150'", "evaluate", "{run}", "--protocol", "h15"),
    cli("n_episodes=0 must be an integer", "evaluate", "{run}", "--n-episodes", "0"),
    cli("Missing from sb3-ars evaluate: .*Folder of a run", "evaluate"),
    cli("There is no table or figure 'table0'", "bench", "table0"),
    cli("There is no scale 'smal'.*Did you mean 'small'", "bench", "table1", "--scale", "smal"),
    cli("--seeds=0 must be an integer", "bench", "table1", "--seeds", "0"),
    cli("invalid choice 'slurm'.*'ray'", "bench", "table1", "--launcher", "slurm"),
    cli("--only: 'mt10' is in none of table1", "bench", "table1", "--only", "mt10"),
    cli("--retries goes with --launcher ray; drop it", "bench", "table1", "--retries", "2"),
    cli("=0 must be an integer of at least 1", "bench", "table1", "--processes", "0"),
    cli("text.zip is no folder; choose another --output", "bench", "table1", "--output", "{text}", "--dry-run"),
    cli("wrong.yaml", "bench", "{wrong}"),
    cli("There is no preset 'toyy'.*Did you mean 'toy'", "tune", "toyy"),
    cli("n_trials .--n-trials.=0 must be an integer", "tune", "toy", "--n-trials", "0"),
    cli("timeout .--timeout. .*more than 0", "tune", "toy", "--timeout", "nan"),
    cli("timeout .--timeout. is -60 s, but must be more than 0", "tune", "toy", "--timeout", "-1"),
    cli("invalid choice 'best'.*'median'", "tune", "toy", "--pruner", "best"),
    cli("no search space 'reset'.*Did you mean 'resets'", "tune", "toy", "--space", "reset"),
    cli("text.zip is no journal of Optuna's.*--storage", "tune", "toy", "--storage", "{text}"),
    cli("name .--study.='a/b' must be the name of a folder", "tune", "toy", "--study", "a/b"),
    cli("wrong.yaml must map options", "tune", "toy", "--space", "{wrong}"),
    cli("seed .--sampler-seed.=-1 must be an integer of at least 0", "tune", "toy", "--sampler-seed", "-1", "--output", "{path}/s"),
    cli("No finished run in .*a finished run's folder holds result.json", "report", "{begun}"),
    cli("none is no folder; give the folder of a run", "report", "{path}/none"),
    cli("no table or figure 'table0'", "report", "{run}", "--sweeps", "table0"),
    cli("progress.csv holds text among the numbers of 'time/total_timesteps'", "report", "{spoilt}"),
    cli("text.zip.*--output", "report", "{run}", "--output", "{text}"),
    cli("'push'.*point-east", "video", "{run}", "--task", "push"),
    cli("invalid choice 'avi' for argument '--format'. Expected one of .*'mp4'", "video", "{run}", "--task", "point-east", "--format", "avi"),
    cli("size=4 must be an integer", "video", "{run}", "--task", "point-east", "--size", "4", "--format", "gif"),
    cli("fps=0 must be an integer", "video", "{run}", "--task", "point-east", "--fps", "0", "--format", "gif"),
    cli("holds no finished run", "video", "{begun}", "--task", "push"),
    cli("doctor takes --json or nothing, not '--jsno'", "doctor", "--jsno"),
    cli("list takes words, not '--filter'", "list", "--filter"),
    cli("No preset has 'mt11' in its name.*'sb3-ars list' shows all", "list", "mt11"),
]  # fmt: skip

ROWS = [*CONSTRUCTOR, *POLICY, *LEARN, *CALLBACKS, *ENVS, *EVALUATION, *FILES, *CONFIGURATIONS]


@pytest.fixture(scope="module")
def ground(run, tmp_path_factory):
    """Files and a model to make mistakes with."""
    path = tmp_path_factory.mktemp("ground")
    model = ARSSAC("MlpPolicy", make_toy_env(seed=0), n_reset=0, **TINY)
    model.learn(40, callback=RunCheckpoint(path / "checkpoints", every=20))
    model.save(path / "model.zip")
    export_policy(model, path / "policy.safetensors")
    (path / "text.zip").write_text("no zip")
    (path / "wrong.yaml").write_text("- 1\n- 2\n")
    (path / "torn.yaml").write_text("env: [")
    shutil.make_archive(str(path / "foreign"), "zip", path, "torn.yaml")
    for name, change in (("damaged", lambda text: text[:40]), ("later", with_format_99)):
        shutil.copytree(path / "checkpoints", path / name)
        for manifest in (path / name).glob("step-*/manifest.json"):
            manifest.write_text(change(manifest.read_text()))
    (path / "begun").mkdir()
    shutil.copy(run / "config.yaml", path / "begun")
    shutil.copytree(run, path / "spoilt")
    log = path / "spoilt" / "progress.csv"
    lines = log.read_text().splitlines()
    column = lines[0].split(",").index("time/total_timesteps")
    row = lines[1].split(",")
    log.write_text("\n".join([lines[0], ",".join([*row[:column], "soon", *row[column + 1 :]]), *lines[2:]]))
    return SimpleNamespace(
        path=path,
        model=model,
        run=run,
        saved=path / "model.zip",
        policy=path / "policy.safetensors",
        **{name: path / name for name in ("checkpoints", "damaged", "later", "begun", "spoilt")},
        **{name: path / f"{name}.yaml" for name in ("wrong", "torn")},
        **{name: path / f"{name}.zip" for name in ("text", "foreign")},
    )


def with_format_99(text):
    return json.dumps({**json.loads(text), "format": 99})


@pytest.fixture
def no_step(ground, monkeypatch):
    """Let no environment of the toy's step any more."""

    def refuse(*args):
        raise AssertionError("an environment was stepped before the error")

    monkeypatch.setattr(MultiTaskVecEnv, "step_async", refuse)
    monkeypatch.setattr(DummyVecEnv, "step_async", refuse)


@pytest.mark.parametrize("row", ROWS, ids=[row.name for row in ROWS])
def test_a_bad_input_has_its_own_error_before_anything_is_stepped(row, ground, no_step):
    with pytest.raises(row.error, match=f"(?s){row.message}") as caught:
        row.call(ground)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("row", COMMANDS, ids=[row.name for row in COMMANDS])
def test_a_bad_command_is_one_line_of_error(row, ground, no_step, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(row.call(ground)) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and re.search(row.message, error), error
    assert error.endswith("\n") and error.count("\n") == 1
