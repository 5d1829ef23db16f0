"""Where cells of a sweep are trained: processes of this machine, or a Ray cluster; knows no tables and no reports."""

from __future__ import annotations

import contextlib
import csv
import io
import os
import signal
import socket
import subprocess
import tarfile
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from sb3_ars.errors import ConfigError, check_count
from sb3_ars.experiments import cells as disk
from sb3_ars.experiments.cells import Cell
from sb3_ars.machine import available_cpus

__all__ = ["Launcher", "LocalLauncher", "Monitor", "Outcome", "RayLauncher"]

_POLL = 0.2  # seconds between two looks at the processes
_PATIENCE = 5.0  # seconds that a process has to end after it was asked to


@dataclass(frozen=True)
class Outcome:
    """What became of a cell.

    :param cell: of the sweep
    :param status: "finished"; "failed"; or "elsewhere" if another process works on it or has finished it meanwhile
    :param seconds: it took
    :param error: last line of the error of a failed one
    """

    cell: Cell
    status: Literal["finished", "failed", "elsewhere"]
    seconds: float = 0.0
    error: str = ""


class Monitor(Protocol):
    """Is told how a sweep goes on."""

    def ready(self) -> None:
        """Take note that what trains the cells is there."""

    def started(self, cell: Cell) -> None:
        """Take note that a cell is being trained; a cluster does not tell, and so it is not called."""

    def progressed(self, cell: Cell, steps: int) -> None:
        """Take note of the environment steps that a started cell has made."""

    def ended(self, outcome: Outcome) -> None:
        """Take note of what became of a cell."""


class Launcher(Protocol):
    """Trains cells somewhere."""

    def run(self, cells: Sequence[Cell], output: Path, monitor: Monitor) -> list[Outcome]:
        """Train cells; return what became of each. One that fails does not stop the others.

        :param cells: unfinished ones
        :param output: folder of the sweep
        :param monitor: told about each
        :raises KeyboardInterrupt: on Ctrl-C or SIGTERM, once everything it started has ended
        """


@dataclass(frozen=True)
class LocalLauncher:
    """A process for each cell on this machine, with its own log and cores; GPUs are shared out in turn.

    :raises ConfigError: for counts that cannot work
    """

    processes: int | None = None
    """Cells at a time; None is as many as there are cores for."""
    cpus_per_cell: int = 1
    """Cores of each cell, which are its threads too."""

    def __post_init__(self) -> None:
        check_count("--cpus-per-cell", self.cpus_per_cell)
        if self.processes is not None:
            check_count("--processes", self.processes)

    def run(self, cells: Sequence[Cell], output: Path, monitor: Monitor) -> list[Outcome]:
        """Train cells; see :class:`Launcher`."""
        free = deque(range(self.processes or max(1, available_cpus() // self.cpus_per_cell)))
        gpus, waiting = _visible_gpus(), deque(cells)
        working, outcomes = dict[_Process, tuple[Cell, int]](), list[Outcome]()

        def end(outcome: Outcome) -> None:
            outcomes.append(outcome)
            monitor.ended(outcome)

        def start(cell: Cell) -> None:
            folder = disk.claim(cell, output, self.cpus_per_cell)
            if folder is None:
                return end(Outcome(cell, "elsewhere"))
            variables = _threads(self.cpus_per_cell) | _gpu(gpus, free[0])
            working[_Process(folder, variables)] = (cell, free.popleft())
            monitor.started(cell)

        monitor.ready()
        with _sigterm_interrupts():
            try:
                while waiting or working:
                    while waiting and free:
                        cell = waiting.popleft()
                        try:
                            start(cell)
                        except OSError as error:
                            end(_unwritten(error, cell, output))
                    time.sleep(_POLL)
                    for process in [process for process in working if process.ended()]:
                        cell, place = working.pop(process)
                        free.append(place)
                        end(_named(process.ending(), cell, output))
                    for process, (cell, _) in working.items():
                        monitor.progressed(cell, _steps(process.folder))
            finally:
                for process, (cell, _) in working.items():  # of a sweep that was interrupted
                    process.stop()
                    _given_up(cell, output)
        return outcomes


@dataclass(frozen=True)
class RayLauncher:
    """A task for each cell on a Ray cluster that is there already; finished runs are gathered here.

    Every node needs sb3_ars. A cell whose node or process dies starts again elsewhere.

    :raises ConfigError: for counts that cannot work
    """

    address: str = "auto"
    """Of the cluster; auto finds the one of this machine."""
    cpus_per_cell: int = 1
    """Cores of each cell, which are its threads too."""
    gpus_per_cell: float = 0.0
    """Share of a GPU, or number of them, of each cell."""
    retries: int = 3
    """Times that a cell starts again after its node or process died; an error of its own is final."""

    def __post_init__(self) -> None:
        check_count("--cpus-per-cell", self.cpus_per_cell)
        check_count("--retries", self.retries, minimum=0)
        if self.gpus_per_cell < 0:
            raise ConfigError(f"--gpus-per-cell={self.gpus_per_cell!r} must be at least 0.")

    def run(self, cells: Sequence[Cell], output: Path, monitor: Monitor) -> list[Outcome]:
        """Train cells; see :class:`Launcher`."""
        ray = _ray()
        outcomes, waiting = list[Outcome](), dict[Any, tuple[Cell, Path]]()

        def end(outcome: Outcome) -> None:
            outcomes.append(outcome)
            monitor.ended(outcome)

        with _connected(ray, self.address), _sigterm_interrupts():
            _check_resources(ray, self.cpus_per_cell, self.gpus_per_cell)
            task = ray.remote(_train_on_node).options(
                num_cpus=self.cpus_per_cell,
                num_gpus=self.gpus_per_cell,
                max_retries=self.retries,
                scheduling_strategy="SPREAD",
            )

            def gather(timeout: float) -> None:
                done, _ = ray.wait(list(waiting), num_returns=len(waiting), timeout=timeout)
                for reference in done:
                    end(_gathered(ray, reference, *waiting.pop(reference), output))

            monitor.ready()
            try:
                for cell in cells:
                    try:
                        folder = disk.claim(cell, output, self.cpus_per_cell)
                        if folder is None:
                            end(Outcome(cell, "elsewhere"))
                            continue
                        waiting[task.remote(_packed(folder), self.cpus_per_cell)] = (cell, folder)
                    except OSError as error:
                        end(_unwritten(error, cell, output))
                while waiting:
                    gather(timeout=1.0)
            finally:
                if waiting:  # of a sweep that was interrupted
                    gather(timeout=0.0)
                for reference, (cell, _) in waiting.items():
                    ray.cancel(reference, force=True)
                    _given_up(cell, output)
        return outcomes


# ---------------------------------------------------------------------- processes


@dataclass(frozen=True)
class _Ending:
    """How the process of a cell ended.

    :param reason: why there is no finished run, if there is none
    :param seconds: it took
    """

    reason: str
    seconds: float


class _Process:
    """The process of one cell on this machine.

    :param folder: what was claimed
    :param variables: of its environment, beside those of this process
    """

    def __init__(self, folder: Path, variables: Mapping[str, str]) -> None:
        self.folder = folder
        self._began = time.monotonic()
        with disk.log_file(folder).open("wb") as log:
            # a session of its own: Ctrl-C is the parent's to hear, and its workers can be ended with it
            self._process = subprocess.Popen(
                disk.command(folder),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **variables},
                start_new_session=True,
            )

    def ended(self) -> bool:
        return self._process.poll() is not None

    def ending(self) -> _Ending:
        """Wait for the end; return how it came."""
        code = self._process.wait()
        seconds = time.monotonic() - self._began
        self.stop()  # workers that outlived a process that was killed
        if code >= 0:
            return _Ending(f"the process ended with status {code} and left no finished run", seconds)
        name = signal.Signals(-code).name
        hint = "; out of memory?" if name == "SIGKILL" else ""
        return _Ending(f"the process was killed by {name}{hint}", seconds)

    def stop(self) -> None:
        """End the process and those it started."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_PATIENCE)


def _named(ending: _Ending, cell: Cell, output: Path) -> Outcome:
    """Name a cell's folder after what became of it; return that."""
    try:
        if disk.publish(cell, output):  # whatever its process died of after that
            return Outcome(cell, "finished", ending.seconds)
        return Outcome(cell, "failed", ending.seconds, disk.fail(cell, output, ending.reason))
    except OSError as error:
        return _unwritten(error, cell, output, ending.seconds)


def _unwritten(error: OSError, cell: Cell, output: Path, seconds: float = 0.0) -> Outcome:
    """Return what became of a cell whose folder cannot be written or is gone."""
    _given_up(cell, output)
    return Outcome(cell, "failed", seconds, f"{type(error).__name__}: {error}")


def _given_up(cell: Cell, output: Path) -> None:
    with contextlib.suppress(OSError):  # of a full disk, and it is cleared away next time
        disk.release(cell, output)


def _threads(count: int) -> dict[str, str]:
    return {"OMP_NUM_THREADS": str(count), "MKL_NUM_THREADS": str(count), "PYTHONUNBUFFERED": "1"}


def _visible_gpus() -> list[str]:
    """Return the names by which CUDA's variable selects this machine's GPUs."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is not None:
        return [name for name in given.split(",") if name]
    import torch as th  # what loads here is loaded already, unless a user of the launcher alone comes this way

    return [str(index) for index in range(th.cuda.device_count())]


def _gpu(gpus: Sequence[str], place: int) -> dict[str, str]:
    return {"CUDA_VISIBLE_DEVICES": gpus[place % len(gpus)]} if gpus else {}


def _steps(working: Path) -> int:
    """Return the environment steps in the log of a run, 0 before its first row."""
    path = disk.run_folder_of(working) / "progress.csv"
    try:
        *_, last = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")))
        return int(float(last["time/total_timesteps"]))
    except (OSError, ValueError, KeyError, TypeError):  # not there yet, or half written
        return 0


@contextlib.contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """Let SIGTERM do what Ctrl-C does, so that neither leaves processes behind."""
    if threading.current_thread() is not threading.main_thread():  # Python handles signals there alone
        yield
        return

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


# ---------------------------------------------------------------------- Ray


def _ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise ConfigError('--launcher ray needs Ray: pip install "sb3-ars[ray]".') from error
    return ray


@contextlib.contextmanager
def _connected(ray: Any, address: str) -> Iterator[None]:
    if ray.is_initialized():
        yield
        return
    try:
        host, _, port = address.rpartition(":")
        if host and "/" not in host:  # Ray itself tries for minutes
            socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", configure_logging=False)
    except (OSError, RuntimeError, ValueError) as error:
        raise ConfigError(
            f"There is no Ray cluster at --ray-address={address!r} ({str(error).splitlines()[0]}). 'ray start --head' "
            "starts one here; --launcher local needs none."
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


def _check_resources(ray: Any, cpus: int, gpus: float) -> None:
    """Raise if no node is large enough: Ray would wait for one for ever."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(node.get("CPU", 0) >= cpus and node.get("GPU", 0) >= gpus for node in nodes):
        sizes = ", ".join(f"{node.get('CPU', 0):g} CPUs and {node.get('GPU', 0):g} GPUs" for node in nodes)
        raise ConfigError(
            f"No node of the Ray cluster has --cpus-per-cell={cpus} and --gpus-per-cell={gpus:g}; its nodes have "
            f"{sizes or 'nothing'}."
        )


def _train_on_node(files: bytes, cpus: int) -> tuple[_Ending, bytes]:
    """Train a cell in a process of this node; return how that ended, and the cell's folder."""
    with tempfile.TemporaryDirectory(prefix="sb3-ars-") as place:
        folder = Path(place)
        _unpack(files, folder)
        ending = _Process(folder, _threads(cpus)).ending()
        return ending, _packed(folder)


def _gathered(ray: Any, reference: Any, cell: Cell, working: Path, output: Path) -> Outcome:
    """Unpack what a node sent; return what became of the cell."""
    try:
        ending, files = ray.get(reference)
    except ray.exceptions.RayError as error:
        lines = str(error).strip().splitlines() or [""]
        return _named(_Ending(f"{type(error).__name__}: {lines[0]}", 0.0), cell, output)
    try:
        _unpack(files, working)
    except OSError as error:
        return _unwritten(error, cell, output, ending.seconds)
    return _named(ending, cell, output)


def _packed(folder: Path) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz", compresslevel=1) as archive:
        archive.add(folder, arcname=".")
    return buffer.getvalue()


def _unpack(files: bytes, folder: Path) -> None:
    with tarfile.open(fileobj=io.BytesIO(files), mode="r:gz") as archive:
        archive.extractall(folder, filter="data")
