"""Checks that this machine can run the package: versions, processors, GPU, rendering, Meta-World; changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import psutil
import torch as th

from sb3_ars.envs.rendering import find_gl_backend
from sb3_ars.errors import ConfigError
from sb3_ars.versions import available_cpus, run_versions

__all__ = ["Check", "run_checks"]


@dataclass(frozen=True)
class Check:
    """One finding.

    :param name: what was checked
    :param ok: whether it is as it should be
    :param found: what was found, and the remedy where it is not ok
    """

    name: str
    ok: bool
    found: str


def run_checks() -> list[Check]:
    """Return every check's finding; a check that raises is a finding, too."""
    checks = [_versions, _processors, _gpu, _metaworld, _rendering]
    return [_guarded(check) for check in checks]


def _guarded(check: Callable[[], Check]) -> Check:
    try:
        return check()
    except Exception as error:
        return Check(check.__name__.strip("_"), False, f"{type(error).__name__}: {error}")


def _versions() -> Check:
    versions = run_versions()
    packages = versions["packages"]
    missing = [name for name, version in packages.items() if version is None]
    text = ", ".join(
        [f"python {versions['python']}", *(f"{n} {v}" for n, v in packages.items() if v is not None)]
    )
    if missing:
        text += f"; missing: {', '.join(missing)} (pip install {' '.join(missing)})"
    return Check("versions", not missing, text)


def _processors() -> Check:
    memory = psutil.virtual_memory().available / 1e9
    return Check(
        "processors",
        True,
        f"{available_cpus()} CPUs, {memory:.1f} GB of memory free, {th.get_num_threads()} torch threads",
    )


def _gpu() -> Check:
    if not th.cuda.is_available():
        return Check("GPU", True, "none that torch can use; training runs on the CPU")
    squared = (th.ones(2, 2, device="cuda") @ th.ones(2, 2, device="cuda")).sum().item()
    return Check("GPU", squared == 8.0, f"{th.cuda.get_device_name()}, CUDA {th.version.cuda}")


def _metaworld() -> Check:
    from sb3_ars.envs import make_metaworld_env

    env = make_metaworld_env("reach", seed=0, n_workers=0)
    env.reset()
    stepped, rewards, _, _ = env.step(np.zeros((1, 4), np.float32))
    obs = np.asarray(stepped)
    env.close()
    ok = bool(np.isfinite(obs).all()) and 0.0 <= float(rewards[0]) <= 10.0 and bool(obs[0, 36:39].any())
    return Check(
        "Meta-World",
        ok,
        f"reach-v3 steps; reward {rewards[0]:.2f} of 0 to 10, goal visible: {obs[0, 36:39].any()}",
    )


def _rendering() -> Check:
    try:
        return Check("rendering", True, f"works (MUJOCO_GL={find_gl_backend()})")
    except ConfigError as error:
        return Check("rendering", True, f"not available; training needs none. {error}")
