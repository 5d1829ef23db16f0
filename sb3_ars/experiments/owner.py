"""Which process something on the disk or in a database belongs to, and whether it lives; knows not what it is for."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import psutil

__all__ = ["host", "lives", "this_process"]

_CLOCK_DRIFT = 60.0  # seconds by which a system's clock may have been set since a process started


def this_process() -> dict[str, Any]:
    """Return what tells this process from all others: ``host``, ``pid``, and ``started`` in seconds since the epoch."""
    process = psutil.Process()
    return {"host": host(), "pid": process.pid, "started": process.create_time()}


def host() -> str:
    """Return this machine's name and, on Linux, the namespace its process numbers are valid in."""
    namespace = Path("/proc/self/ns/pid")
    return f"{platform.node()} {os.readlink(namespace)}" if namespace.is_symlink() else platform.node()


def lives(pid: int, started: float) -> bool | None:
    """Return whether a process of this :func:`host` lives; ``None`` if one of that number does, but may be another.

    :param pid: its number
    :param started: when, in seconds since the epoch; the clock may have been set since, by a minute at most
    """
    try:
        process = psutil.Process(pid)
        if process.status() == psutil.STATUS_ZOMBIE:
            return False
        return True if abs(process.create_time() - started) < _CLOCK_DRIFT else None
    except psutil.NoSuchProcess:
        return False
    except psutil.AccessDenied:
        return None
