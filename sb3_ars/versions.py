"""The versions and the hardware that numbers depend on."""

from __future__ import annotations

import importlib.metadata
import platform
import subprocess
from pathlib import Path
from typing import Any

import psutil
import torch as th

from sb3_ars.machine import available_cpus

__all__ = ["PACKAGES", "available_cpus", "cpu_info", "run_versions"]

PACKAGES = (
    "sb3-ars",
    "stable-baselines3",
    "sb3-contrib",
    "torch",
    "gymnasium",
    "metaworld",
    "mujoco",
    "numpy",
)


def run_versions() -> dict[str, Any]:
    """Return Python, platform, processors, memory (GB), GPU, package versions, commit; ``None`` if missing."""
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": cpu_info("model name") or platform.processor() or platform.machine(),
        "cpus": available_cpus(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
        "packages": {name: _version(name) for name in PACKAGES},
        "commit": _commit(),
    }


def cpu_info(key: str) -> str | None:
    """Return what Linux says of the first processor, ``None`` elsewhere.

    :param key: such as "model name" or "flags"
    """
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), None)


def _commit() -> str | None:
    """Return the commit of the checkout this file is tracked in, with a plus where the package differs, or ``None``."""
    file = Path(__file__)

    def git(*arguments: str) -> str:
        command = ["git", *arguments]
        done = subprocess.run(
            command, cwd=file.parent, capture_output=True, text=True, timeout=10, check=True
        )
        return done.stdout.strip()

    try:
        git(
            "ls-files", "--error-unmatch", file.name
        )  # fails where the package is installed inside another checkout
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--", ".") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
