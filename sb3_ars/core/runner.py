"""How a step of computation is executed: eagerly, or captured once as a CUDA graph and replayed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Hashable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any, Generic, TypeVar

import torch as th

__all__ = ["CapturedCalls", "compiled", "prepare_optimizer_", "tf32"]

Result = TypeVar("Result")

_EAGER_CALLS = (
    3  # before capture, so that optimizers, cuBLAS and autograd have made what they make on first use
)


class CapturedCalls(Generic[Result]):
    """Calls a function of no arguments, from the fourth call with the same key on as a replayed CUDA graph.

    The function may read and change only tensors whose addresses stay, must not wait for the device, and returns
    tensors, which every replay overwrites. The first calls run it eagerly; they count like all others, so nothing
    has to be undone before capture, which itself executes nothing.
    """

    def __init__(self) -> None:
        self._key: Hashable = None
        self._calls = 0
        self._captured: dict[Hashable, tuple[th.cuda.CUDAGraph, Result]] = {}

    def __call__(
        self,
        function: Callable[[], Result],
        variant: Hashable,
        key: Hashable = None,
        generators: Sequence[th.Generator] = (),
    ) -> Result:
        """Return the function's result.

        :param function: what to run
        :param variant: which of several functions it is; each gets a graph of its own
        :param key: whatever else was frozen at capture; when it changes, all graphs are captured anew
        :param generators: random generators the function draws from, besides the device's default one
        """
        if key != self._key:
            self._key, self._calls = key, 0
            self._captured.clear()
        if variant in self._captured:
            graph, result = self._captured[variant]
            graph.replay()
            return result
        if self._calls < _EAGER_CALLS:
            self._calls += 1
            return self._run_aside(function)
        graph = th.cuda.CUDAGraph()
        for generator in generators:
            graph.register_generator_state(generator)
        th.cuda.synchronize()
        with th.cuda.graph(graph):
            result = function()
        # Beginning a capture sets the generators' offset on the device to 0, on the capture's own stream (torch 2.11,
        # CUDAGeneratorImpl.cpp). On a busy GPU that came after what the replay sets here, so that the first replay drew
        # random numbers anew: one in two runs differed.
        th.cuda.synchronize()
        self._captured[variant] = graph, result
        graph.replay()
        return result

    @staticmethod
    def _run_aside(function: Callable[[], Result]) -> Result:
        """Run on a side stream, where warm-up before capture has to happen."""
        stream = th.cuda.Stream()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        stream.wait_stream(th.cuda.current_stream())
        with th.cuda.stream(stream):
            result = function()
        th.cuda.current_stream().wait_stream(stream)
        return result


def compiled(network: th.nn.Module, method: str) -> Any:
    """Return a stand-in for a network, with one method compiled; parameters are shared.

    Not the whole update: torch.compile cannot trace ``autograd.grad`` between two parts of it (torch 2.13).

    :param network: actor or critics
    :param method: the method the update calls
    """
    return SimpleNamespace(**{method: th.compile(getattr(network, method))}, parameters=network.parameters)


def prepare_optimizer_(optimizer: th.optim.Optimizer, fused: bool, capturable: bool) -> None:
    """Let torch's Adam step all parameters in one kernel, and inside a CUDA graph; other optimizers stay as they are.

    :param optimizer: before or after its first step; loading a state dict undoes this
    :param fused: one kernel; equal up to rounding. False is what the optimizer was made with
    :param capturable: step counts and learning rates live on the device
    """
    if not isinstance(optimizer, th.optim.Adam):  # AdamW is one
        return
    for group in optimizer.param_groups:
        device = group["params"][0].device
        group["fused"] = True if fused else optimizer.defaults["fused"]
        group["foreach"] = False if fused else optimizer.defaults["foreach"]
        group["capturable"] = capturable
        lr = float(group["lr"])
        group["lr"] = th.tensor(lr, device=device) if capturable else lr
        for parameter in group["params"]:
            state = optimizer.state.get(parameter)
            if state:
                state["step"] = state["step"].to(
                    device if capturable or group["fused"] else "cpu", th.float32
                )


@contextlib.contextmanager
def tf32(allowed: bool) -> Iterator[None]:
    """Allow float32 products on CUDA to round their operands to TF32 inside the context.

    :param allowed: False changes nothing
    """
    if not allowed:
        yield
        return
    before = th.get_float32_matmul_precision()
    th.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        th.set_float32_matmul_precision(before)
