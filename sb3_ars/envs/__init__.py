"""Multi-task environments; must not know the algorithms.

The names below load on first use (PEP 562): a worker process imports ``sb3_ars.envs.workers`` and its env
only, and must not pay seconds and hundreds of megabytes for the torch that SB3's VecEnv brings along.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_ars.envs.metaworld import make_metaworld_env, metaworld_task_names
    from sb3_ars.envs.toy import make_toy_env
    from sb3_ars.envs.vec_env import MultiTaskVecEnv, make_multitask_env

__all__ = [
    "MultiTaskVecEnv",
    "make_metaworld_env",
    "make_multitask_env",
    "make_toy_env",
    "metaworld_task_names",
]

_HOME = {
    "MultiTaskVecEnv": "vec_env",
    "make_metaworld_env": "metaworld",
    "make_multitask_env": "vec_env",
    "make_toy_env": "toy",
    "metaworld_task_names": "metaworld",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
