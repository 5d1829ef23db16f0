"""The errors this package raises. Knows nothing else of the package.

Each message names the option or the task, says what was given and what to do instead.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

import numpy as np

__all__ = [
    "CheckpointError",
    "ConfigError",
    "DivergedError",
    "EnvContractError",
    "WorkerError",
    "check_count",
    "nearest",
]


class ConfigError(ValueError):
    """An option, or a combination of options, that cannot work; raised before time is spent."""


class CheckpointError(ConfigError):
    """A checkpoint that is missing, damaged, or does not fit the model or the environment."""


class DivergedError(RuntimeError):
    """Training produced NaN or infinity in its losses; the networks are lost, what was saved before is not."""


class EnvContractError(RuntimeError):
    """An environment broke the contract between it and the algorithm (NaN, missing terminal observation)."""


class WorkerError(RuntimeError):
    """A worker process died, hung or raised; the message names its tasks and holds its traceback or exit code."""


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return ``" Did you mean 'x'?"`` for the valid name closest to ``name``, or an empty string.

    :param name: what was given
    :param valid: the names that would have been accepted
    """
    matches = difflib.get_close_matches(name, list(valid), n=1)
    return f" Did you mean {matches[0]!r}?" if matches else ""


def check_count(option: str, value: Any, minimum: int = 1) -> int:
    """Return ``value`` as an int if it is an integer of at least ``minimum``; a bool is none.

    :param option: what the message calls it
    :param value: what was given
    :param minimum: smallest value allowed
    :raises ConfigError: otherwise
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < minimum:
        raise ConfigError(f"{option}={value!r} must be an integer of at least {minimum}.")
    return int(value)
