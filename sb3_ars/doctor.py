"""Checks that this machine can run the package, and says what to do where it cannot; changes nothing."""

from __future__ import annotations

import configparser
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import psutil
import torch as th
from gymnasium.spaces import Box
from packaging.requirements import Requirement

from sb3_ars.buffers import TaskReplayBuffer
from sb3_ars.envs import make_metaworld_env, make_toy_env
from sb3_ars.envs.rendering import find_gl_backend
from sb3_ars.errors import ConfigError
from sb3_ars.experiments.config import RunConfig, load_preset
from sb3_ars.machine import (
    available_cpus,
    available_memory,
    cpu_quota,
    memory_limit,
    schedulable_cpus,
    shared_memory,
)
from sb3_ars.versions import PACKAGES

__all__ = ["Check", "run_checks"]

Status = Literal["ok", "warning", "failure"]


@dataclass(frozen=True)
class Check:
    """One finding.

    :param name: what was checked
    :param status: "failure" keeps runs from working, or their numbers from being comparable; "warning" does not
    :param found: what was found
    :param remedy: what to do where it is not ok
    """

    name: str
    status: Status
    found: str
    remedy: str = ""


def run_checks() -> list[Check]:
    """Return every check's finding; a check that raises is a finding, too."""
    checks: dict[str, Callable[[], Check]] = {
        "packages": _packages,
        "processors": _processors,
        "threads": _threads,
        "memory": _memory,
        "shared memory": _shared_memory,
        "workers": _workers,
        "GPU": _gpu,
        "Meta-World": _metaworld,
        "rendering": _rendering,
        "disk": _disk,
    }
    return [_guarded(name, check) for name, check in checks.items()]


def _guarded(name: str, check: Callable[[], Check]) -> Check:
    try:
        return check()
    except Exception as error:
        return Check(
            name, "failure", f"{type(error).__name__}: {error}", "Mend what the message names, and ask again."
        )


# ---------------------------------------------------------------------- packages

_DECISIVE = ("metaworld", "mujoco")
"""Packages that rewards and physics come from: with another version, numbers are not comparable."""


def _packages() -> Check:
    required = _requirements()
    installed = {requirement.name: _version(requirement.name) for requirement in required}
    wrong = [r for r in required if not _fits(r, installed[r.name])]
    shown = [f"{name} {version}" for name in PACKAGES if (version := installed.get(name) or _version(name))]
    found = ", ".join([f"python {platform.python_version()}", *shown])
    if not wrong:
        if _version("sb3-ars") is None:
            return Check(
                "packages",
                "warning",
                f"{found}; sb3-ars itself runs from a source tree",
                "pip install -e . installs it, and the command sb3-ars.",
            )
        return Check("packages", "ok", f"{found}; all {len(required)} required packages are as tested")
    said = [
        f"{r.name} is {installed[r.name] or 'missing'}, and should be {r.specifier or 'any version'}"
        + (" (rewards and physics depend on it)" if r.name in _DECISIVE and installed[r.name] else "")
        for r in wrong
    ]
    is_fatal = any(installed[r.name] is None or r.name in _DECISIVE or _is_too_old(r) for r in wrong)
    return Check(
        "packages",
        "failure" if is_fatal else "warning",
        f"{'; '.join(said)}. Found: {found}",
        "pip install " + " ".join(f'"{r.name}{r.specifier}"' for r in wrong),
    )


def _requirements() -> list[Requirement]:
    """Return what the package needs without extras: what its source tree says, or what was installed with it."""
    setup = Path(__file__).parents[1] / "setup.cfg"
    parser = configparser.ConfigParser()
    parser.read(setup, encoding="utf-8")
    if parser.get("metadata", "name", fallback=None) == "sb3-ars":
        lines = parser["options"]["install_requires"].split("\n")
    else:
        lines = importlib.metadata.requires("sb3-ars") or []
    requirements = [Requirement(line) for line in lines if line.strip()]
    return [r for r in requirements if r.marker is None or r.marker.evaluate({"extra": ""})]


def _fits(requirement: Requirement, version: str | None) -> bool:
    return version is not None and requirement.specifier.contains(version, prereleases=True)


def _is_too_old(requirement: Requirement) -> bool:
    version = _version(requirement.name)
    lower = [bound for bound in requirement.specifier if bound.operator in (">=", ">", "==", "~=")]
    return version is not None and any(not bound.contains(version, prereleases=True) for bound in lower)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


# ---------------------------------------------------------------------- the machine


def _processors() -> Check:
    cpus, there, quota = available_cpus(), psutil.cpu_count() or 1, cpu_quota()
    lent = [f"{schedulable_cpus()} may run this process"] if schedulable_cpus() < there else []
    lent += [f"a container's quota is the time of {quota:g}"] if quota is not None else []
    found = f"{cpus} of the machine's {there}" + (f" ({', '.join(lent)})" if lent else "")
    if cpus < 2:
        return Check(
            "processors",
            "warning",
            found,
            "Environments and updates take turns on one processor: lend the container or job more (docker run --cpus, "
            "taskset, --cpus-per-task), and let envs step in the process itself (n_workers=0).",
        )
    return Check("processors", "ok", found)


def _threads() -> Check:
    threads, cpus = th.get_num_threads(), available_cpus()
    spins, policy = os.environ.get("GOMP_SPINCOUNT"), os.environ.get("OMP_WAIT_POLICY", "")
    found = f"{threads} torch threads, GOMP_SPINCOUNT={spins or 'not set'}"
    if threads > cpus:
        return Check(
            "threads",
            "warning",
            f"{found}, but {cpus} processors: the threads wait for one another",
            f"Set OMP_NUM_THREADS={cpus} before the start.",
        )
    is_active = policy.lower() == "active"
    if is_active or spins is None or not spins.isdigit() or int(spins) > 100_000:
        what = f"OMP_WAIT_POLICY={policy}" if is_active else f"GOMP_SPINCOUNT={spins or 'not set'}"
        return Check(
            "threads",
            "warning",
            f"{found}; with {what} torch's threads wait by spinning, and take the processors from the envs' workers",
            "Set GOMP_SPINCOUNT=1000 before the start, and leave OMP_WAIT_POLICY unset.",
        )
    return Check("threads", "ok", f"{found} (the command sets it; for scripts of your own set it yourself)")


def _memory() -> Check:
    limit, uses_gpu = memory_limit(), th.cuda.is_available()
    free = available_memory()
    total = psutil.virtual_memory().total if limit is None else limit.limit
    found = f"{_size(free)} free of {_size(total)}" + (" that the container may use" if limit else "")
    room = th.cuda.mem_get_info()[0] if uses_gpu else free
    needs = {name: _buffer_bytes(name) for name in ("mt10-ars", "mt50-ars")}
    found += "; replay buffers take " + ", ".join(f"{_size(n)} in {name}" for name, n in needs.items())
    found += f", of the GPU's {_size(room)}" if uses_gpu else ""
    if free < 1e9:
        return Check(
            "memory", "failure", found, "Free some, or raise the container's limit (docker run --memory)."
        )
    short = [
        f"--algorithm.buffer-size {int(load_preset(name).algorithm.buffer_size * 0.8 * room / n)} for {name}"
        for name, n in needs.items()
        if n > 0.9 * room
    ]
    if short:
        return Check(
            "memory",
            "warning",
            found,
            f"Use {' and '.join(short)}; --algorithm.optimize-memory-usage nearly halves what a buffer takes. In a "
            "container, raise its limit (docker run --memory).",
        )
    return Check("memory", "ok", found)


def _buffer_bytes(preset: str) -> int:
    """Return what the replay buffer of a Meta-World benchmark's preset takes."""
    config = load_preset(preset)
    n_tasks = int(str(config.env.tasks).removeprefix("MT"))
    buffer = TaskReplayBuffer(
        config.algorithm.buffer_size,
        Box(-1, 1, (39 + n_tasks,)),
        Box(-1, 1, (4,)),
        device="cpu",
        n_envs=n_tasks,
        task_of_env=range(n_tasks),
        task_names=[str(task) for task in range(n_tasks)],
    )
    return buffer.memory_bytes()


def _shared_memory() -> Check:
    found = shared_memory()
    remedy = "Start the container with --shm-size=256m (docker run), or use n_workers=0."
    if found is None:
        return Check(
            "shared memory", "failure", "/dev/shm is missing or not writable: no worker can start", remedy
        )
    size, free = found
    text = f"/dev/shm: {_size(free)} free of {_size(size)}"
    if free < 16e6:
        status: Status = "failure" if free < 1e6 else "warning"
        return Check("shared memory", status, f"{text}, too little for workers beside others", remedy)
    return Check("shared memory", "ok", text)


def _disk() -> Check:
    folder = RunConfig().output.absolute()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(there).free
    found = f"{_size(free)} free where runs go ({folder})"
    remedy = (
        "Give another folder with --output, or free some space: a run takes tens of MB, a saved replay buffer of MT10 "
        f"up to {_size(_buffer_bytes('mt10-ars'))}."
    )
    if not os.access(there, os.W_OK):
        return Check(
            "disk", "failure", f"{there} is not writable, where runs go", "Give another folder with --output."
        )
    if free < 5e9:
        return Check("disk", "failure" if free < 1e8 else "warning", found, remedy)
    return Check("disk", "ok", found)


def _size(n_bytes: float) -> str:
    return f"{n_bytes / 1e9:.1f} GB" if n_bytes >= 1e8 else f"{n_bytes / 1e6:.1f} MB"


# ---------------------------------------------------------------------- the GPU


def _gpu() -> Check:
    with warnings.catch_warnings():  # torch's, about what is found here
        warnings.simplefilter("ignore")
        is_available = th.cuda.is_available()
    if is_available:
        return _usable_gpu()
    cards = _nvidia_cards()
    if not cards:
        return Check("GPU", "ok", "none; training runs on the CPU")
    found = f"{', '.join(cards)}, which torch cannot use, so training runs on the CPU"
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES")
    if hidden is not None and hidden.strip() in ("", "-1"):
        return Check("GPU", "ok", f"{', '.join(cards)}, hidden by CUDA_VISIBLE_DEVICES={hidden!r}")
    if th.version.cuda is None:
        return Check(
            "GPU",
            "warning",
            f"{found}: torch {th.__version__} is built without CUDA",
            "Install a CUDA build of torch: https://pytorch.org/get-started/locally has the command.",
        )
    reason = _why_not()
    remedy = (
        f"Update NVIDIA's driver to one for CUDA {th.version.cuda}, or install a torch build for an older CUDA."
        if "driver" in reason.lower()
        else "See the reason; in a container, start it with the GPU (docker run --gpus all)."
    )
    return Check("GPU", "warning", f"{found} ({reason})", remedy)


def _usable_gpu() -> Check:
    name, (major, minor) = th.cuda.get_device_name(), th.cuda.get_device_capability()
    built_for = th.cuda.get_arch_list()
    found = f"{name}, compute capability {major}.{minor}, CUDA {th.version.cuda}"
    remedy = "Install a torch build for it (https://pytorch.org/get-started/locally), or use --algorithm.device cpu."
    if th.version.cuda is not None and not any(_runs_on(arch, major, minor) for arch in built_for):
        return Check(
            "GPU", "failure", f"{found}; this torch is built for {', '.join(built_for)} only", remedy
        )
    try:
        right = (th.ones(2, 2, device="cuda") @ th.ones(2, 2, device="cuda")).sum().item() == 8.0
        reason = "" if right else "a product of two matrices came out wrong"
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
    return Check("GPU", "failure", f"{found}; {reason}", remedy) if reason else Check("GPU", "ok", found)


def _runs_on(arch: str, major: int, minor: int) -> bool:
    """Return whether code for an architecture, such as sm_86 or compute_90, runs on a card of this capability."""
    found = re.fullmatch(r"(sm|compute)_(\d+)(\d)[a-z]?", arch)
    if found is None:
        return False
    built = int(found[2]), int(found[3])
    # machine code runs on later cards of its generation, the intermediate code on all later ones
    return built <= (major, minor) and (found[1] == "compute" or built[0] == major)


def _nvidia_cards() -> list[str]:
    """Return the names of NVIDIA's cards in this machine, whatever torch says."""
    if shutil.which("nvidia-smi"):
        try:
            done = subprocess.run(
                ["nvidia-smi", "-L"], capture_output=True, text=True, timeout=20, check=False
            )
            if done.returncode == 0:
                return [
                    line.split(": ", 1)[-1].split(" (UUID")[0] for line in done.stdout.splitlines() if line
                ]
        except (OSError, subprocess.TimeoutExpired):
            pass
    return [f"a card at {path}" for path in sorted(Path("/dev").glob("nvidia[0-9]*"))]


def _why_not() -> str:
    """Return torch's reason for not using CUDA."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            th.cuda.init()  # type: ignore[no-untyped-call]  # torch's
    except (RuntimeError, AssertionError) as error:
        return str(error).splitlines()[0]
    return "torch gives no reason"


# ---------------------------------------------------------------------- environments


def _workers() -> Check:
    n_workers = 2
    try:
        env = make_toy_env(seed=0, n_workers=n_workers)
    except ConfigError as error:
        return Check("workers", "failure", str(error).split(". ")[0], ". ".join(str(error).split(". ")[1:]))
    env.reset()
    env.step(np.zeros((env.num_envs, 2), np.float32))
    env.close()
    return Check("workers", "ok", f"{n_workers} processes start, step the toy tasks and end")


def _metaworld() -> Check:
    env = make_metaworld_env("reach", seed=0, n_workers=0)
    env.reset()
    stepped, rewards, _, _ = env.step(np.zeros((1, 4), np.float32))
    obs = np.asarray(stepped)
    env.close()
    ok = bool(np.isfinite(obs).all()) and 0.0 <= float(rewards[0]) <= 10.0 and bool(obs[0, 36:39].any())
    return Check(
        "Meta-World",
        "ok" if ok else "failure",
        f"reach-v3 steps; reward {rewards[0]:.2f} of 0 to 10, goal visible: {obs[0, 36:39].any()}",
        ""
        if ok
        else 'pip install --force-reinstall "metaworld" "mujoco", in the versions that "packages" names.',
    )


def _rendering() -> Check:
    try:
        return Check("rendering", "ok", f"works (MUJOCO_GL={find_gl_backend()})")
    except ConfigError as error:
        reason = str(error).rpartition("Tried ")[2]
        return Check(
            "rendering",
            "warning",
            f"no OpenGL to draw with, so no videos; training needs none. Tried {reason}",
            "Install libegl1 (with a GPU's driver or Mesa's) or libosmesa6, and leave MUJOCO_GL unset or set it to egl "
            "or osmesa.",
        )
