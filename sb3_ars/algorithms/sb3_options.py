"""What SB3's own options may be, checked before anything is built; knows neither tasks nor our options.

SB3 checks few of them: most wrong values end as another library's error, some hours later, some never.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from os import PathLike
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_ars.errors import (
    MAX_COUNT,
    ConfigError,
    check_count,
    check_flag,
    check_number,
    check_verbose,
    nearest,
)

__all__ = ["check_env", "check_policy", "check_sb3_options"]

_MAX_SEED = 2**32 - 1  # NumPy's global generator takes no larger one


def check_sb3_options(options: Mapping[str, Any]) -> None:
    """Raise for a value that SB3 could not work with.

    :param options: of the constructor, by name; those without a check here are left alone
    :raises ConfigError: naming the option, what was given and what is allowed
    """
    for option, value in options.items():
        if option in _CHECKS:
            _CHECKS[option](option, value)


def check_policy(policy: object, aliases: Mapping[str, type[BasePolicy]]) -> None:
    """Raise unless the policy is a name that the algorithm knows, or a class of policies.

    :param policy: what was given
    :param aliases: the algorithm's names
    :raises ConfigError: otherwise, with the nearest name
    """
    is_class = isinstance(policy, type) and issubclass(policy, BasePolicy)
    if not is_class and not (isinstance(policy, str) and policy in aliases):
        raise ConfigError(
            f"policy={policy!r} is unknown; choose one of {', '.join(map(repr, aliases))}, or give a subclass of "
            f"{aliases['MlpPolicy'].__name__}.{nearest(str(policy), aliases)}"
        )


def check_env(env: object) -> None:
    """Raise unless SB3 can step it, or make it.

    :param env: what was given; None is SB3's way to load without one
    :raises ConfigError: otherwise
    """
    if isinstance(env, str):
        try:
            gym.spec(env)
        except (gym.error.Error, ImportError) as error:
            raise ConfigError(f"env={env!r} is no environment that Gymnasium knows: {error}") from error
    elif env is not None and (isinstance(env, type) or not (hasattr(env, "step") and hasattr(env, "reset"))):
        hint = " Call it: give the environment it returns." if callable(env) else ""
        raise ConfigError(
            f"env={env!r} must be an environment of Gymnasium, a VecEnv such as make_metaworld_env's, or the name of a "
            f"registered one.{hint}"
        )


def _check_share(option: str, value: Any) -> None:
    check_number(option, value, maximum=1)


def _check_learning_rate(option: str, value: Any) -> None:
    if not callable(value):
        try:
            check_number(option, value)
        except ConfigError:
            raise ConfigError(
                f"{option}={value!r} must be a finite number of at least 0, or a schedule."
            ) from None


def _check_train_freq(option: str, value: Any) -> None:
    frequency, unit = value if isinstance(value, tuple) and len(value) == 2 else (value, "step")
    is_count = isinstance(frequency, int) and not isinstance(frequency, bool) and 1 <= frequency <= MAX_COUNT
    known = [unit.value for unit in TrainFrequencyUnit]
    if not isinstance(value, TrainFreq) and not (is_count and unit in known):
        raise ConfigError(
            f"{option}={value!r} must be an integer of at least 1, or a pair such as (1, 'episode'); units are "
            f"{', '.join(known)}."
        )


def _check_gradient_steps(option: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not -1 <= value <= MAX_COUNT:
        raise ConfigError(
            f"{option}={value!r} must be an integer of at least 0, or -1 for as many as there were steps."
        )


def _check_ent_coef(option: str, value: Any) -> None:
    is_text = isinstance(value, str)
    number: Any = value
    if is_text:
        auto, separator, first = value.partition("_")
        number = 1.0 if auto == "auto" and not separator else _parsed(first) if auto == "auto" else None
    try:
        check_number(option, number, minimum=math.ulp(0.0) if is_text else 0.0)
    except ConfigError:
        raise ConfigError(
            f"{option}={value!r} must be 'auto', 'auto_' and a first value above 0, or a finite number of at least 0."
        ) from None


def _check_target_entropy(option: str, value: Any) -> None:
    # contrib's TQC replaces "auto" by one of NumPy's
    is_number = (
        isinstance(value, int | float | np.floating) and not isinstance(value, bool) and math.isfinite(value)
    )
    if not is_number and not (isinstance(value, str) and value == "auto"):
        raise ConfigError(f"{option}={value!r} must be 'auto' or a finite number.")


def _check_seed(option: str, value: Any) -> None:
    is_int = isinstance(value, int) and not isinstance(value, bool)  # Python's random takes no NumPy integer
    if value is not None and not (is_int and 0 <= value <= _MAX_SEED):
        raise ConfigError(f"{option}={value!r} must be None or an int from 0 to {_MAX_SEED}.")


def _check_device(option: str, value: Any) -> None:
    if isinstance(value, str) and value == "auto":
        return
    try:
        th.device(value)
    except (RuntimeError, TypeError) as error:
        raise ConfigError(
            f"{option}={value!r} is no device of torch's; give 'auto', 'cpu', 'cuda' or one such as 'cuda:1'."
        ) from error


def _check_noise(option: str, value: Any) -> None:
    if value is not None and not isinstance(value, ActionNoise):
        raise ConfigError(
            f"{option}={value!r} must be None or an ActionNoise of stable_baselines3.common.noise."
        )


def _check_buffer_class(option: str, value: Any) -> None:
    if value is not None and not (isinstance(value, type) and issubclass(value, ReplayBuffer)):
        raise ConfigError(
            f"{option}={value!r} must be None or a subclass of stable_baselines3.common.buffers.ReplayBuffer."
        )


def _check_mapping(option: str, value: Any) -> None:
    if value is not None and not (
        isinstance(value, Mapping) and all(isinstance(name, str) for name in value)
    ):
        raise ConfigError(f"{option}={value!r} must be None or a mapping of options by name.")


def _check_folder(option: str, value: Any) -> None:
    if value is not None and not isinstance(value, str | PathLike):
        raise ConfigError(f"{option}={value!r} must be None or the path of a folder.")


def _parsed(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


_CHECKS: dict[str, Callable[[str, Any], object]] = {
    "learning_rate": _check_learning_rate,
    "buffer_size": check_count,
    "batch_size": check_count,
    "tau": _check_share,
    "gamma": _check_share,
    "train_freq": _check_train_freq,
    "gradient_steps": _check_gradient_steps,
    "action_noise": _check_noise,
    "replay_buffer_class": _check_buffer_class,
    "replay_buffer_kwargs": _check_mapping,
    "optimize_memory_usage": check_flag,
    "n_steps": check_count,
    "ent_coef": _check_ent_coef,
    "target_update_interval": check_count,
    "target_entropy": _check_target_entropy,
    "use_sde": check_flag,
    "use_sde_at_warmup": check_flag,
    "stats_window_size": check_count,
    "tensorboard_log": _check_folder,
    "policy_kwargs": _check_mapping,
    "verbose": check_verbose,
    "seed": _check_seed,
    "device": _check_device,
}
