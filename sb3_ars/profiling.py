"""Measures where a run's time goes, part by part; knows neither algorithms nor environments."""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Iterator

import torch as th

__all__ = ["PARTS", "PartTimer"]

PARTS = {
    "act": "choosing actions",
    "step": "stepping the environments, or waiting for them",
    "store": "writing transitions to the replay buffer",
    "sample": "drawing batches",
    "critic": "critics: target, loss, gradient, step",
    "actor": "actor and temperatures: loss, gradient, step",
    "targets": "moving the target critics",
    "update": "the whole update, where it is one captured CUDA graph",
    "log": "writing the log",
    "other": "SB3's loop, callbacks, evaluation",
}
"""The parts, and what each of them is."""


class PartTimer:
    """Sums wall-clock seconds by part; a part inside another is taken off the outer one.

    :param device: on CUDA every part waits for the device, so a profiled run is slower than it would be
    """

    def __init__(self, device: th.device | str = "cpu") -> None:
        self._waits = th.device(device).type == "cuda"
        self._stack: list[str] = []
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._since = time.perf_counter()

    @contextlib.contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        """Count the time inside the context towards ``part``, one of :data:`PARTS`."""
        self._switch()
        self._stack.append(part)
        try:
            yield
        finally:
            self._switch()
            self._stack.pop()

    def seconds(self) -> dict[str, float]:
        """Return the seconds of each part that took any, in the order of :data:`PARTS`; they sum to all time so far."""
        self._switch()
        return {part: self._seconds[part] for part in PARTS if self._seconds[part] > 0}

    def _switch(self) -> None:
        if self._waits:
            th.cuda.synchronize()
        now = time.perf_counter()
        self._seconds[self._stack[-1] if self._stack else "other"] += now - self._since
        self._since = now
