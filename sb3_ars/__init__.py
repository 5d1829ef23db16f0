"""Adaptive Reward Scaling for multi-task reinforcement learning on Stable-Baselines3 (not Augmented Random Search).

Names load on first use: worker processes import ``sb3_ars.envs`` without torch, and ``sb3-ars --help`` answers at once.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_ars.algorithms.sac import ARSSAC
    from sb3_ars.algorithms.tqc import ARSTQC
    from sb3_ars.buffers import TaskReplayBuffer
    from sb3_ars.callbacks.ars import ARSCallback
    from sb3_ars.callbacks.checkpoint import RunCheckpoint
    from sb3_ars.callbacks.evaluation import TaskEvalCallback
    from sb3_ars.callbacks.schedule import TaskScheduleCallback
    from sb3_ars.config import ARSConfig
    from sb3_ars.core.schedule import SMTConfig
    from sb3_ars.envs import make_metaworld_env, make_multitask_env, make_toy_env
    from sb3_ars.errors import CheckpointError, ConfigError, DivergedError, EnvContractError, WorkerError
    from sb3_ars.evaluation import evaluate_tasks
    from sb3_ars.policy_file import LoadedPolicy, export_policy, load_policy

__version__ = "0.1.0"

_MODULE_OF = {
    "ARSSAC": "algorithms.sac",
    "ARSTQC": "algorithms.tqc",
    "TaskReplayBuffer": "buffers",
    "ARSCallback": "callbacks.ars",
    "RunCheckpoint": "callbacks.checkpoint",
    "TaskEvalCallback": "callbacks.evaluation",
    "TaskScheduleCallback": "callbacks.schedule",
    "ARSConfig": "config",
    "SMTConfig": "core.schedule",
    "make_metaworld_env": "envs",
    "make_multitask_env": "envs",
    "make_toy_env": "envs",
    "CheckpointError": "errors",
    "ConfigError": "errors",
    "DivergedError": "errors",
    "EnvContractError": "errors",
    "WorkerError": "errors",
    "evaluate_tasks": "evaluation",
    "LoadedPolicy": "policy_file",
    "export_policy": "policy_file",
    "load_policy": "policy_file",
}

__all__ = [
    "ARSSAC",
    "ARSTQC",
    "ARSCallback",
    "ARSConfig",
    "CheckpointError",
    "ConfigError",
    "DivergedError",
    "EnvContractError",
    "LoadedPolicy",
    "RunCheckpoint",
    "SMTConfig",
    "TaskEvalCallback",
    "TaskReplayBuffer",
    "TaskScheduleCallback",
    "WorkerError",
    "evaluate_tasks",
    "export_policy",
    "load_policy",
    "make_metaworld_env",
    "make_multitask_env",
    "make_toy_env",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'sb3_ars' has no attribute {name!r}")
    return getattr(importlib.import_module(f"sb3_ars.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
