"""What this machine, or the container it is, lends this process: processors, memory, shared memory; loads no torch."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import psutil

__all__ = [
    "MemoryLimit",
    "available_cpus",
    "available_memory",
    "cpu_quota",
    "memory_limit",
    "schedulable_cpus",
    "shared_memory",
]

_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")
_SHARED_MEMORY = Path("/dev/shm")
_NO_LIMIT = 2**60  # cgroup v1 has no word for it, only a number near 2**63


class MemoryLimit(NamedTuple):
    """What a container or a job may use, in bytes."""

    limit: int
    free: int


def available_cpus() -> int:
    """Return how many processors this process may keep busy: those it may run on, within its container's quota."""
    quota = cpu_quota()
    cpus = schedulable_cpus()
    return cpus if quota is None else max(1, min(cpus, math.ceil(quota)))


def schedulable_cpus() -> int:
    """Return how many processors this process may run on: a job scheduler or a container may lend only some."""
    if hasattr(os, "process_cpu_count"):  # from Python 3.13 on; PYTHON_CPU_COUNT overrides it
        return os.process_cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cpu_quota() -> float | None:
    """Return how many processors' time the control group (a container's, a job's) may take, ``None`` without limit."""
    quotas = []
    for folder in _folders("cpu"):
        quota, period = [*_numbers(folder / "cpu.max"), None, None][:2]  # v2: "max 100000" without limit
        if not (folder / "cpu.max").exists():
            quota, period = (_number(folder / f"cpu.cfs_{name}_us") for name in ("quota", "period"))
        if quota is not None and period and quota > 0:
            quotas.append(quota / period)
    return min(quotas, default=None)


def available_memory() -> int:
    """Return how many bytes this process can still take: the machine's, within its container's limit."""
    limit = memory_limit()
    free = int(psutil.virtual_memory().available)
    return free if limit is None else min(free, limit.free)


def memory_limit() -> MemoryLimit | None:
    """Return what the control group (a container's, a job's) may use and has left, ``None`` without limit.

    Files that are cached but not in use count as free: the system drops them first.
    """
    limits = []
    for folder in _folders("memory"):
        is_v2 = (folder / "memory.max").exists()
        limit = _number(folder / ("memory.max" if is_v2 else "memory.limit_in_bytes"))
        used = _number(folder / ("memory.current" if is_v2 else "memory.usage_in_bytes"))
        if limit is not None and used is not None and limit < _NO_LIMIT:
            cached = _statistic(folder / "memory.stat", "inactive_file" if is_v2 else "total_inactive_file")
            limits.append(MemoryLimit(limit, max(0, limit - used + cached)))
    return min(limits, key=lambda limit: limit.free, default=None)


def shared_memory() -> tuple[int, int] | None:
    """Return size and free bytes of ``/dev/shm``, where processes meet; ``None`` if it is missing or not writable."""
    if not os.access(_SHARED_MEMORY, os.W_OK):
        return None
    found = os.statvfs(_SHARED_MEMORY)
    return found.f_blocks * found.f_frsize, found.f_bavail * found.f_frsize


def _folders(controller: str) -> Iterator[Path]:
    """Yield the folders of this process's control group and of those around it, whose limits hold as well."""
    for line in _lines(_OWN_CGROUPS):
        number, controllers, path = line.split(":", 2)
        if number != "0" and controller not in controllers.split(","):
            continue
        base = _CGROUPS if number == "0" else _CGROUPS / controller  # version 2, or 1
        # In a container the path may be the host's; what is mounted at the base is then the container's own.
        inner = Path() if ".." in path else Path(path.lstrip("/"))
        for part in (inner, *inner.parents):
            if (base / part).is_dir():
                yield base / part


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def _numbers(path: Path) -> list[int | None]:
    return [
        int(word) if word.lstrip("-").isdigit() else None for line in _lines(path) for word in line.split()
    ]


def _number(path: Path) -> int | None:
    return next(iter(_numbers(path)), None)


def _statistic(path: Path, name: str) -> int:
    words = (line.split() for line in _lines(path))
    return next((int(pair[1]) for pair in words if len(pair) == 2 and pair[0] == name), 0)
