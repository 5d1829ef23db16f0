"""The errors this package raises. Knows nothing else of the package.

Each message names the option or the task, says what was given and what to do instead.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = ["ConfigError", "EnvContractError", "WorkerError", "nearest"]


class ConfigError(ValueError):
    """An option, or a combination of options, that cannot work; raised before time is spent."""


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
