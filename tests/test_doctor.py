"""The doctor: every condition it can find, faked, with what it says and advises; and what it reads of the machine."""

import errno
import importlib.metadata
import json
import os
import subprocess
import sys
import types

import psutil
import pytest
import torch as th

from sb3_ars import doctor, machine
from sb3_ars.buffers import TaskReplayBuffer
from sb3_ars.cli import main
from sb3_ars.doctor import Check
from sb3_ars.errors import ConfigError

GB = 10**9


@pytest.fixture
def versions(monkeypatch):
    """A function that lets packages have other versions, None for a missing one."""

    def set_versions(**others):
        real = importlib.metadata.version

        def version(name):
            found = others.get(name.replace("-", "_"), real(name) if name != "sb3-ars" else "0.1.0")
            if found is None:
                raise importlib.metadata.PackageNotFoundError(name)
            return found

        monkeypatch.setattr(importlib.metadata, "version", version)

    return set_versions


# ---------------------------------------------------------------------- packages


def test_packages_within_their_ranges_are_ok(versions):
    versions()
    check = doctor._packages()
    assert check.status == "ok" and "required packages are as tested" in check.found and not check.remedy


@pytest.mark.parametrize(
    ("others", "status", "found", "remedy"),
    [
        ({"mujoco": "3.7.0"}, "failure", "mujoco is 3.7.0, and should be <3.5,>=3.3.0 (rewards and physics", "mujoco<"),
        ({"metaworld": "2.0.0"}, "failure", "metaworld is 2.0.0, and should be <4,>=3.1.1 (rewards", "metaworld<4,"),
        ({"optuna": None}, "failure", "optuna is missing, and should be >=5", '"optuna>=5"'),
        ({"torch": "2.1.0+cpu"}, "failure", "torch is 2.1.0+cpu, and should be >=2.8", '"torch>=2.8"'),
        ({"stable_baselines3": "3.0.0"}, "warning", "stable-baselines3 is 3.0.0, and should be <3", "baselines3<3"),
    ],
)  # fmt: skip
def test_packages_outside_their_ranges_are_named_with_the_command_that_helps(
    versions, others, status, found, remedy
):
    versions(**others)
    check = doctor._packages()
    assert check.status == status and found in check.found
    assert check.remedy.startswith("pip install ") and remedy in check.remedy


def test_the_ranges_are_those_of_the_source_tree_or_else_of_the_installed_package(monkeypatch, tmp_path):
    in_tree = {str(requirement) for requirement in doctor._requirements()}
    monkeypatch.setattr(doctor, "__file__", str(tmp_path / "sb3_ars" / "doctor.py"))
    monkeypatch.setattr(
        importlib.metadata, "requires", lambda name: ["mujoco<3.5,>=3.3.0", 'ray>=2; extra == "ray"']
    )
    assert {str(requirement) for requirement in doctor._requirements()} == {"mujoco<3.5,>=3.3.0"} < in_tree
    assert len(in_tree) > 15


def test_a_source_tree_that_is_not_installed_is_a_warning(versions):
    versions(sb3_ars=None)
    check = doctor._packages()
    assert check.status == "warning" and "source tree" in check.found and "pip install -e ." in check.remedy


def test_a_package_the_doctor_itself_needs_is_named_if_it_is_missing(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "sb3_ars.doctor", None)
    assert main(["doctor"]) == 1
    error = capsys.readouterr().err
    assert "sb3_ars.doctor" in error and "pip install --upgrade sb3-ars" in error


# ---------------------------------------------------------------------- processors, threads, memory, disk


@pytest.fixture
def cgroup(monkeypatch, tmp_path):
    """A function that writes the files of a control group: version, the group's path, and the files by name."""

    def write(version, own, files):
        for name, text in files.items():
            file = tmp_path / "cgroup" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
        lines = f"0::{own}\n" if version == 2 else f"4:memory:{own}\n3:cpu,cpuacct:{own}\n0::/\n"
        (tmp_path / "self").write_text(lines)
        monkeypatch.setattr(machine, "_CGROUPS", tmp_path / "cgroup")
        monkeypatch.setattr(machine, "_OWN_CGROUPS", tmp_path / "self")

    return write


V2 = {
    "memory.max": f"{8 * GB}\n",
    "memory.current": f"{5 * GB}\n",
    "memory.stat": f"anon 1\ninactive_file {GB}\n",
}
V1 = {
    "memory/memory.limit_in_bytes": f"{8 * GB}\n",
    "memory/memory.usage_in_bytes": f"{5 * GB}\n",
    "memory/memory.stat": f"inactive_file 5\ntotal_inactive_file {GB}\n",
}


@pytest.mark.parametrize(
    ("version", "own", "files"),
    [
        (2, "/", V2),  # in a container with a namespace of its own
        (2, "/docker/0123", V2),  # without: the path is the host's, the mount the container's
        (2, "/../../job", V2),
        (
            2,
            "/job/step",
            {f"job/{name}": text for name, text in V2.items()} | {"job/step/memory.max": "max\n"},
        ),
        (1, "/docker/0123", V1),
    ],
)
def test_memory_is_the_container_s_where_that_is_less(cgroup, monkeypatch, version, own, files):
    cgroup(version, own, files)
    assert machine.memory_limit() == (8 * GB, 4 * GB)  # what is cached and not in use can be had
    monkeypatch.setattr(
        psutil, "virtual_memory", lambda: types.SimpleNamespace(available=6 * GB, total=16 * GB)
    )
    assert machine.available_memory() == 4 * GB
    monkeypatch.setattr(
        psutil, "virtual_memory", lambda: types.SimpleNamespace(available=3 * GB, total=16 * GB)
    )
    assert machine.available_memory() == 3 * GB


@pytest.mark.parametrize(
    ("version", "files"),
    [
        (2, {"memory.max": "max\n", "memory.current": "5\n", "cpu.max": "max 100000\n"}),
        (1, {"memory/memory.limit_in_bytes": "9223372036854771712\n", "memory/memory.usage_in_bytes": "5\n"}),
        (2, {}),
    ],
)
def test_there_need_be_no_limit(cgroup, version, files):
    cgroup(version, "/", {"x": "", **files})
    assert machine.memory_limit() is None and machine.cpu_quota() is None


@pytest.mark.parametrize(
    ("version", "files", "quota"),
    [
        (2, {"cpu.max": "150000 100000\n"}, 1.5),
        (1, {"cpu/cpu.cfs_quota_us": "50000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 0.5),
        (1, {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, None),
    ],
)
def test_processors_are_the_container_s_where_those_are_fewer(cgroup, monkeypatch, version, files, quota):
    cgroup(version, "/", files)
    monkeypatch.setattr(machine, "schedulable_cpus", lambda: 8)
    assert machine.cpu_quota() == quota
    assert machine.available_cpus() == {1.5: 2, 0.5: 1, None: 8}[quota]


def test_a_buffer_is_checked_against_the_container_s_memory(cgroup):
    cgroup(2, "/", {"memory.max": "20000000\n", "memory.current": "10000000\n"})
    buffer = TaskReplayBuffer(10**6, doctor.Box(-1, 1, (3,)), doctor.Box(-1, 1, (1,)), device="cpu")
    with pytest.raises(
        ConfigError, match=r"0.01 GB are free. Use buffer_size=\d\d\d_\d\d\d \(per task\) or less"
    ):
        buffer.check_memory()


def test_one_processor_is_a_warning_that_says_who_lends_it(monkeypatch):
    monkeypatch.setattr(psutil, "cpu_count", lambda: 64)
    monkeypatch.setattr(doctor, "schedulable_cpus", lambda: 8)
    monkeypatch.setattr(doctor, "cpu_quota", lambda: 0.5)
    monkeypatch.setattr(doctor, "available_cpus", lambda: 1)
    check = doctor._processors()
    assert check.status == "warning"
    assert (
        check.found
        == "1 of the machine's 64 (8 may run this process, a container's quota is the time of 0.5)"
    )
    assert "docker run --cpus" in check.remedy and "n_workers=0" in check.remedy
    monkeypatch.setattr(doctor, "available_cpus", lambda: 8)
    assert doctor._processors().status == "ok"


@pytest.mark.parametrize(
    ("environment", "threads", "found", "remedy"),
    [
        ({"GOMP_SPINCOUNT": "1000"}, 16, "16 torch threads, GOMP_SPINCOUNT=1000, but 2", "OMP_NUM_THREADS=2"),
        ({}, 2, "with GOMP_SPINCOUNT=not set torch's threads wait by spinning", "Set GOMP_SPINCOUNT=1000"),
        ({"GOMP_SPINCOUNT": "INFINITY"}, 2, "with GOMP_SPINCOUNT=INFINITY torch's", "Set GOMP_SPINCOUNT=1000"),
        ({"GOMP_SPINCOUNT": "1000", "OMP_WAIT_POLICY": "ACTIVE"}, 2, "with OMP_WAIT_POLICY=ACTIVE", "leave OMP_WAIT"),
        ({"GOMP_SPINCOUNT": "1000"}, 2, "the command sets it", ""),
    ],
)  # fmt: skip
def test_threads_that_spin_or_are_too_many_are_found(monkeypatch, environment, threads, found, remedy):
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(th, "get_num_threads", lambda: threads)
    monkeypatch.setattr(doctor, "available_cpus", lambda: 2)
    check = doctor._threads()
    assert found in check.found and remedy in check.remedy
    assert check.status == ("warning" if remedy else "ok")


@pytest.mark.parametrize(
    ("free", "status", "remedy"),
    [
        (20 * GB, "ok", ""),
        (5 * GB, "warning", "Use --algorithm.buffer-size 238095 for mt50-ars; --algorithm.optimize-memory-usage"),
        (2 * GB, "warning", "476190 for mt10-ars and --algorithm.buffer-size 95238 for mt50-ars; --"),
        (GB // 2, "failure", "docker run --memory"),
    ],
)  # fmt: skip
def test_memory_is_compared_with_the_buffers_of_the_presets(monkeypatch, free, status, remedy):
    monkeypatch.setattr(doctor, "memory_limit", lambda: machine.MemoryLimit(32 * GB, free))
    monkeypatch.setattr(doctor, "available_memory", lambda: free)
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)
    check = doctor._memory()
    assert check.status == status and remedy in check.remedy
    assert f"{doctor._size(free)} free of 32.0 GB that the container may use" in check.found
    assert "replay buffers take 3.4 GB in mt10-ars, 8.4 GB in mt50-ars" in check.found


@pytest.mark.parametrize(
    ("shared", "status", "found"),
    [
        (None, "failure", "/dev/shm is missing or not writable"),
        ((64_000_000, 500_000), "failure", "/dev/shm: 0.5 MB free of 64.0 MB"),
        ((64_000_000, 9_000_000), "warning", "/dev/shm: 9.0 MB free of 64.0 MB, too little"),
        ((64_000_000, 64_000_000), "ok", "/dev/shm: 64.0 MB free of 64.0 MB"),
    ],
)
def test_too_little_shared_memory_is_found(monkeypatch, shared, status, found):
    monkeypatch.setattr(doctor, "shared_memory", lambda: shared)
    check = doctor._shared_memory()
    assert check.status == status and found in check.found
    assert ("--shm-size=256m (docker run), or use n_workers=0" in check.remedy) == (status != "ok")


def test_shared_memory_is_measured(monkeypatch, tmp_path):
    monkeypatch.setattr(machine, "_SHARED_MEMORY", tmp_path)
    size, free = machine.shared_memory()
    assert 0 < free <= size
    monkeypatch.setattr(machine, "_SHARED_MEMORY", tmp_path / "nowhere")
    assert machine.shared_memory() is None


@pytest.mark.parametrize(
    ("free", "is_writable", "status"),
    [(50 * GB, True, "ok"), (GB, True, "warning"), (10**7, True, "failure"), (50 * GB, False, "failure")],
)
def test_a_full_or_unwritable_disk_is_found(monkeypatch, tmp_path, free, is_writable, status):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: types.SimpleNamespace(free=free))
    monkeypatch.setattr(os, "access", lambda path, mode: is_writable)
    check = doctor._disk()
    assert check.status == status and str(tmp_path) in check.found
    assert ("--output" in check.remedy) == (status != "ok")


# ---------------------------------------------------------------------- GPU, environments, rendering


@pytest.fixture
def card(monkeypatch):
    """A machine with a card that torch finds no use for."""
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)
    monkeypatch.setattr(doctor, "_nvidia_cards", lambda: ["NVIDIA H100"])
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)


def test_no_gpu_is_no_fault(card, monkeypatch):
    monkeypatch.setattr(doctor, "_nvidia_cards", lambda: [])
    assert doctor._gpu() == Check("GPU", "ok", "none; training runs on the CPU")


def test_a_gpu_beside_a_torch_without_cuda_is_found(card, monkeypatch):
    monkeypatch.setattr(th.version, "cuda", None)
    check = doctor._gpu()
    assert check.status == "warning" and "NVIDIA H100, which torch cannot use" in check.found
    assert "is built without CUDA" in check.found and "pytorch.org/get-started/locally" in check.remedy


def test_a_driver_that_is_too_old_is_found(card, monkeypatch):
    def init():
        raise RuntimeError(
            "The NVIDIA driver on your system is too old (found version 11040).\nPlease update"
        )

    monkeypatch.setattr(th.version, "cuda", "12.8")
    monkeypatch.setattr(th.cuda, "init", init)
    check = doctor._gpu()
    assert (
        check.status == "warning"
        and "(The NVIDIA driver on your system is too old (found version 11040).)" in check.found
    )
    assert "Update NVIDIA's driver to one for CUDA 12.8" in check.remedy


def test_a_hidden_gpu_is_no_fault(card, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert doctor._gpu() == Check("GPU", "ok", "NVIDIA H100, hidden by CUDA_VISIBLE_DEVICES=''")


def test_a_card_that_torch_has_no_code_for_is_found(monkeypatch):
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "get_device_name", lambda: "NVIDIA B200")
    monkeypatch.setattr(th.cuda, "get_device_capability", lambda: (10, 0))
    monkeypatch.setattr(th.cuda, "get_arch_list", lambda: ["sm_80", "sm_90"])
    monkeypatch.setattr(th.version, "cuda", "12.4")
    check = doctor._gpu()
    assert check.status == "failure" and "compute capability 10.0" in check.found
    assert "built for sm_80, sm_90 only" in check.found and "--algorithm.device cpu" in check.remedy


@pytest.mark.parametrize(
    ("arch", "capability", "runs"),
    [
        ("sm_80", (8, 6), True), ("sm_86", (8, 0), False), ("sm_80", (9, 0), False), ("compute_90", (10, 0), True),
        ("compute_120", (10, 0), False), ("sm_120", (12, 0), True), ("sm_90a", (9, 0), True), ("gfx90a", (9, 0), False),
    ],
)  # fmt: skip
def test_code_runs_on_later_cards_of_its_generation_or_is_compiled_for_them(arch, capability, runs):
    assert doctor._runs_on(arch, *capability) is runs


def test_cards_are_listed_by_nvidia_smi(monkeypatch):
    said = "GPU 0: NVIDIA H100 80GB HBM3 (UUID: GPU-1)\nGPU 1: NVIDIA H100 80GB HBM3 (UUID: GPU-2)\n"
    monkeypatch.setattr(doctor.shutil, "which", lambda name: "/usr/bin/nvidia-smi")
    done = subprocess.CompletedProcess([], 0, said, "")
    monkeypatch.setattr(doctor.subprocess, "run", lambda *args, **kwargs: done)
    assert doctor._nvidia_cards() == ["NVIDIA H100 80GB HBM3"] * 2


def test_no_opengl_is_a_warning(monkeypatch):
    def refuse():
        raise ConfigError("MuJoCo finds no OpenGL to draw with. Tried egl: no library; osmesa: no library")

    monkeypatch.setattr(doctor, "find_gl_backend", refuse)
    check = doctor._rendering()
    assert check.status == "warning" and check.found.endswith("Tried egl: no library; osmesa: no library")
    assert "libegl1" in check.remedy and "libosmesa6" in check.remedy


def test_workers_that_cannot_start_are_found_with_their_remedy(monkeypatch):
    def refuse(*args):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("sb3_ars.envs.workers.WorkerPool._start_one", refuse)
    check = doctor._workers()
    assert (
        check.status == "failure" and "could not be started ([Errno 24] Too many open files)" in check.found
    )
    assert "ulimit -n" in check.remedy


def test_a_check_that_raises_is_a_finding(monkeypatch):
    def refuse(*args, **kwargs):
        raise ImportError("Meta-World is needed for this: pip install metaworld")

    monkeypatch.setattr(doctor, "make_metaworld_env", refuse)
    check = doctor._guarded("Meta-World", doctor._metaworld)
    assert check.status == "failure" and check.found.startswith("ImportError: Meta-World is needed")


# ---------------------------------------------------------------------- the command

FINDINGS = [
    Check("packages", "ok", "python 3.11"),
    Check("workers", "warning", "[Errno 28] " + "no room " * 20, "Start it with --shm-size=256m."),
]


@pytest.mark.parametrize(
    ("more", "status", "code"), [([], "warning", 0), ([Check("disk", "failure", "x")], "failure", 1)]
)
def test_json_and_the_exit_status_say_how_bad_it_is(monkeypatch, capsys, more, status, code):
    monkeypatch.setattr(doctor, "run_checks", lambda: [*FINDINGS, *more])
    assert main(["doctor", "--json"]) == code
    printed = json.loads(capsys.readouterr().out)
    assert printed["status"] == status
    assert printed["checks"][0] == {"name": "packages", "status": "ok", "found": "python 3.11", "remedy": ""}


def test_the_table_fits_80_columns_and_keeps_brackets(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "run_checks", lambda: FINDINGS)
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "warning  workers   [Errno 28] no room" in lines[2] and lines[-1].strip().startswith(
        "-> Start it with"
    )


def test_the_command_explains_itself_and_refuses_other_options(capsys):
    assert main(["doctor", "--help"]) == 0 and main(["doctor", "--jsno"]) == 2
    assert "exit status is 0 unless a check fails" in capsys.readouterr().out
