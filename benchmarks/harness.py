"""What the benchmarks share: contestants timed in turns, ratios with their spread, goals, results as JSON.

Every contestant lives in a process of its own, which does nothing until it is told to work: thread pools of two
libraries in one process, or two processes at work at once, would slow each other down and spoil the comparison.
"""

from __future__ import annotations

import gc
import json
import multiprocessing
import os
import statistics
import subprocess
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sb3_ars.versions import available_cpus, cpu_info, run_versions

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
PEERS = ("sbx-rl", "jax", "jaxlib", "flax", "optax")
CPU_FLAGS = ("avx2", "avx512f", "avx512_bf16", "amx_bf16", "amx_tile")

Work = Callable[[int], float]
"""Does so many units of work and returns the seconds they took."""


@dataclass(frozen=True)
class Contestant:
    """One thing to time.

    :param name: key in the results
    :param label: in tables and charts
    :param make: a module's function (it is pickled) that builds the contestant and returns its ``Work``; what it
        leaves open ends with its process
    :param units: units of work timed in each round
    :param warm_up: units of work done at the start of each round, untimed, to wake threads and fill caches
    """

    name: str
    label: str
    make: Callable[[], Work]
    units: int = 1
    warm_up: int = 1


# ---------------------------------------------------------------------- timing in turns


def interleave(contestants: Sequence[Contestant], rounds: int, cpus: int = 2) -> dict[str, list[float]]:
    """Return each contestant's seconds per unit of work, one number per round.

    All are built first, one after another; then each round times every one of them once, starting with another one
    each round. A contestant that fails raises here, with its traceback.

    :param contestants: with different names
    :param rounds: how often each is timed
    :param cpus: processors, and so torch threads, that each may use
    """
    seconds: dict[str, list[float]] = {c.name: [] for c in contestants}
    with ExitStack() as stack:
        processes = [stack.enter_context(_running(c.name, c.make, cpus)) for c in contestants]
        for turn in range(rounds):
            for index in range(len(contestants)):
                which = (index + turn) % len(contestants)
                contestant = contestants[which]
                elapsed = processes[which].work(contestant.warm_up, contestant.units)
                seconds[contestant.name].append(elapsed / contestant.units)
    return seconds


def threads_environment(cpus: int) -> dict[str, str]:
    """Return the variables that give a process so many threads, which sleep soon instead of spinning."""
    return {"OMP_NUM_THREADS": str(cpus), "MKL_NUM_THREADS": str(cpus), "GOMP_SPINCOUNT": "1000"}


def run_alone(function: Callable[[], Any], cpus: int = 2) -> Any:
    """Return what a function returns in a process of its own, which has so many processors.

    :param function: a module's function (it is pickled)
    :param cpus: processors, and so torch threads
    """
    with _running("benchmark", function, cpus) as process:
        return process.built


class _Process:
    """The near end of a contestant's process; ``built`` is what its function returned, if that is no ``Work``."""

    def __init__(self, name: str, process: Any, connection: Connection) -> None:
        self.name, self.process, self.connection = name, process, connection
        self.built = self._answer()

    def work(self, warm_up: int, units: int) -> float:
        self.connection.send((warm_up, units))
        return float(self._answer())

    def _answer(self) -> Any:
        try:
            succeeded, value = self.connection.recv()
        except EOFError:
            self.process.join()
            raise RuntimeError(
                f"The process of {self.name} died, exit code {self.process.exitcode}."
            ) from None
        if not succeeded:
            raise RuntimeError(f"{self.name} failed:\n{value}")
        return value


@contextmanager
def _running(name: str, make: Callable[[], Any], cpus: int) -> Iterator[_Process]:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    # not daemonic: contestants have worker processes of their own
    process = context.Process(target=_serve, args=(make, cpus, there), name=name)
    # OpenMP's are read when torch loads, so they are set before the process starts. The last is for multiprocessing's
    # resource tracker, which complains of the semaphores that processes ended at once leave to it, and removes them.
    variables = {
        **threads_environment(cpus),
        "PYTHONWARNINGS": "ignore::UserWarning:multiprocessing.resource_tracker",
    }
    with _environment(variables):
        process.start()
    there.close()
    try:
        yield _Process(name, process, here)
    finally:
        here.close()  # its recv() ends, and so does the process
        process.join(timeout=20)
        if process.is_alive():
            process.terminate()
            process.join()


def _serve(make: Callable[[], Any], cpus: int, connection: Connection) -> None:
    """A contestant's process: build it, then work when told to, until the other side closes."""
    try:
        limit_cpus(cpus)
        work = make()
        connection.send((True, None if callable(work) else work))
        for warm_up, units in _orders(connection):
            gc.collect()
            if warm_up:
                work(warm_up)
            connection.send((True, work(units)))
    except BaseException:
        connection.send((False, traceback.format_exc()))
    finally:
        connection.close()
        _end_children()
        os._exit(0)  # some peers' threads and workers outlive an ordinary exit, and keep the process


def _orders(connection: Connection) -> Iterator[tuple[int, int]]:
    while True:
        try:
            yield connection.recv()
        except EOFError:
            return


def limit_cpus(cpus: int) -> None:
    """Let this process and its children use the first so many of its processors, where the system can do that."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cpus])


def _end_children() -> None:
    import psutil

    children = psutil.Process().children(recursive=True)
    for child in children:
        child.terminate()
    _, alive = psutil.wait_procs(children, timeout=3)
    for child in alive:
        child.kill()


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def stopwatch(function: Callable[[], object]) -> Work:
    """Return the ``Work`` of calling a function again and again."""

    def work(units: int) -> float:
        started = time.perf_counter()
        for _ in range(units):
            function()
        return time.perf_counter() - started

    return work


# ---------------------------------------------------------------------- arithmetic


def compare(seconds: dict[str, list[float]], baseline: str) -> dict[str, dict[str, Any]]:
    """Return, per contestant, seconds per unit and how many times as fast as the baseline it is.

    ``speedup`` is the figure to quote: the median over rounds of the baseline's time divided by the contestant's in the
    same round, so that what slows the whole machine for a while slows both. ``speedup_low`` and ``speedup_high`` are
    its quartiles over rounds.

    :param seconds: of :func:`interleave`
    :param baseline: name of the contestant whose speed-up is 1
    """
    return {
        name: {
            "best_seconds": min(own),
            "median_seconds": statistics.median(own),
            **speedup(seconds[baseline], own),
            "speedup_of_bests": min(seconds[baseline]) / min(own),
            "speedup_of_medians": statistics.median(seconds[baseline]) / statistics.median(own),
            "seconds": own,
        }
        for name, own in seconds.items()
    }


def speedup(base: Sequence[float], own: Sequence[float]) -> dict[str, float]:
    """Return how many times as fast as another a contestant is, and the quartiles over rounds; see :func:`compare`.

    :param base: the other's seconds, round by round
    :param own: the contestant's seconds in the same rounds
    """
    ratios = [b / o for b, o in zip(base, own, strict=True)]
    low, high = quartiles(ratios)
    return {"speedup": statistics.median(ratios), "speedup_low": low, "speedup_high": high}


def quartiles(values: Sequence[float]) -> tuple[float, float]:
    """Return the lower and the upper quartile; of a single value, that value twice."""
    if len(values) < 2:
        return values[0], values[0]
    low, _, high = statistics.quantiles(values, n=4, method="inclusive")
    return low, high


def goal(
    what: str, measured: float, at_least: float | None = None, at_most: float | None = None
) -> dict[str, Any]:
    """Return one goal and whether it is reached.

    :param what: in words, unit included
    :param measured: the figure
    :param at_least: the figure wanted, where more is better
    :param at_most: the figure wanted, where less is better
    """
    if (at_least is None) == (at_most is None):
        raise ValueError(f"goal {what!r}: give one of at_least and at_most")
    reached = measured >= at_least if at_least is not None else measured <= at_most  # type: ignore[operator]
    return {
        "goal": what,
        "wanted": at_least if at_least is not None else at_most,
        "better": "more" if at_least is not None else "less",
        "measured": measured,
        "reached": bool(reached),
    }


# ---------------------------------------------------------------------- results


def machine(cpus: int | None = None) -> dict[str, Any]:
    """Return hardware, versions and commit, to stand beside every figure.

    :param cpus: how many of the processors the contestants were given; ``None`` is all
    """
    versions = run_versions()
    versions["packages"].update({name: _version(name) for name in PEERS})
    return {
        **versions,
        "cpu_model": versions["processor"],
        "cpu_flags": _cpu_flags(),
        "cpus_used": min(cpus or available_cpus(), available_cpus()),
        "tree_is_dirty": _tree_is_dirty(),
        "date": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
    }


def write_result(name: str, result: dict[str, Any], folder: Path = RESULTS) -> Path:
    """Write ``<folder>/<name>.json``, whole or not at all, and return its path; floats keep five significant digits.

    :param name: of the benchmark
    :param result: plain values
    :param folder: made if missing
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_text(json.dumps(_rounded(result), indent=2) + "\n", encoding="utf-8")
    unfinished.replace(path)
    return path


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table, its first column to the left and the others to the right."""
    rule = ["---"] + ["---:"] * (len(headings) - 1)
    return "\n".join("| " + " | ".join(row) + " |" for row in (headings, rule, *rows))


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, dict):
        return {str(key): _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return value


def _cpu_flags() -> list[str]:
    """Return what of the processor decides how fast a matrix product can be."""
    flags = (cpu_info("flags") or "").split()
    return [flag for flag in CPU_FLAGS if flag in flags]


def _tree_is_dirty() -> bool | None:
    """Return whether files differ from the commit, those that benchmarks write left out; ``None`` without git."""
    paths = [".", ":!benchmarks/results", ":!docs/performance.md", ":!docs/methods.md", ":!docs/methods"]
    try:
        done = subprocess.run(
            ["git", "status", "--porcelain", "--", *paths],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return bool(done.stdout.strip())


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
