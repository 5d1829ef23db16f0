"""The errors this package raises. Knows nothing else of the package.

Each message names the option or the task, says what was given and what to do instead.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

__all__ = [
    "MAX_COUNT",
    "CheckpointError",
    "ConfigError",
    "DivergedError",
    "EnvContractError",
    "WorkerError",
    "check_count",
    "check_flag",
    "check_number",
    "check_path",
    "check_verbose",
    "nearest",
]


MAX_COUNT = 2**63 - 1
"""Largest count that arrays, tensors and queues take."""


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
    matches = difflib.get_close_matches(str(name), list(valid), n=1)
    return f" Did you mean {matches[0]!r}?" if matches else ""


def check_count(option: str, value: Any, minimum: int = 1) -> int:
    """Return ``value`` as an int if it is an integer of at least ``minimum`` and no absurd size; a bool is none.

    :param option: what the message calls it
    :param value: what was given
    :param minimum: smallest value allowed
    :raises ConfigError: otherwise
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < minimum:
        raise ConfigError(f"{option}={value!r} must be an integer of at least {minimum}.")
    if value > MAX_COUNT:
        raise ConfigError(f"{option}={value!r} must be an integer of at most {MAX_COUNT}.")
    return int(value)


def check_number(option: str, value: Any, minimum: float = 0.0, maximum: float = math.inf) -> float:
    """Return ``value`` if it is a finite int or float within bounds; a bool is none, nor is text.

    :param option: what the message calls it
    :param value: what was given
    :param minimum: smallest value allowed
    :param maximum: largest value allowed
    :raises ConfigError: otherwise
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not minimum <= value <= maximum or math.isinf(value):
        allowed = (
            f"of at least {minimum:g}" if math.isinf(maximum) else f"between {minimum:g} and {maximum:g}"
        )
        raise ConfigError(f"{option}={value!r} must be a finite number {allowed}.")
    number: float = value
    return number


def check_flag(option: str, value: Any) -> bool:
    """Return ``value`` if it is True or False.

    :param option: what the message calls it
    :param value: what was given
    :raises ConfigError: otherwise
    """
    if not isinstance(value, bool):
        raise ConfigError(f"{option}={value!r} must be True or False.")
    return value


def check_path(option: str, value: Any) -> Path:
    """Return ``value`` as a path if it is one, or the text of one.

    :param option: what the message calls it
    :param value: what was given
    :raises ConfigError: otherwise
    """
    if not isinstance(value, str | PathLike):
        raise ConfigError(f"{option}={value!r} must be a path.")
    return Path(value)


def check_verbose(option: str, value: Any) -> int:
    """Return ``value`` if it is a level of SB3's ``verbose``; True is 1, as in its examples.

    :param option: what the message calls it
    :param value: what was given
    :raises ConfigError: otherwise
    """
    if not isinstance(value, int) or value < 0:
        raise ConfigError(f"{option}={value!r} must be 0 (silent), 1 (messages) or 2 (everything).")
    return value
