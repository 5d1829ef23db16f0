"""Turns the execution options into a plan for this machine, and runs the policy on a GPU without waiting twice."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_ars.config import ExecutionConfig
from sb3_ars.core.runner import CapturedCalls
from sb3_ars.core.update import Timer, squashed_gaussian
from sb3_ars.nets.mlp import fused_layers_are_available

__all__ = ["CapturedActor", "ExecutionPlan", "WorkWhileStepping", "plan_execution"]


@dataclass(frozen=True)
class ExecutionPlan:
    """What the options come to on this machine.

    :param execution: how the update runs
    :param bf16: whether products between hidden layers are in bfloat16
    :param tf32: whether float32 products on CUDA may round to TF32
    :param overlap: whether the update runs while the environments step
    """

    execution: Literal["eager", "fused", "compile", "cudagraph"]
    bf16: bool
    tf32: bool
    overlap: bool


def plan_execution(
    options: ExecutionConfig, device: th.device, tasks_are_named: bool, can_capture: bool, can_overlap: bool
) -> ExecutionPlan:
    """Return the plan; warn where an explicit wish cannot be met and eager execution takes its place.

    :param options: as the user gave them
    :param device: of the networks
    :param tasks_are_named: whether this is a multi-task environment; "auto" leaves a plain one SB3's arithmetic
    :param can_capture: whether batches are drawn on the device, as a CUDA graph needs
    :param can_overlap: whether updates come after single vector steps
    """
    on_cuda = device.type == "cuda"
    execution = options.execution
    if execution == "auto":
        if not tasks_are_named:
            execution = "eager"
        elif on_cuda:
            execution = "cudagraph" if can_capture else "eager"
        else:
            execution = "fused" if fused_layers_are_available() else "eager"
    refusal = _refusal(execution, on_cuda, can_capture)
    if refusal is not None:
        warnings.warn(f"execution={execution!r} {refusal}; updates run eagerly.", stacklevel=4)
        execution = "eager"
    if options.precision == "tf32" and not on_cuda:
        warnings.warn("precision='tf32' is CUDA's; on this device it is 'fp32'.", stacklevel=4)
    if options.precision == "bf16" and not on_cuda and not th.ops.mkldnn._is_mkldnn_bf16_supported():
        warnings.warn(
            "precision='bf16' is slow on this processor, which has no AVX-512; use 'fp32'.", stacklevel=4
        )
    return ExecutionPlan(
        execution,
        bf16=options.precision == "bf16",
        tf32=on_cuda and options.precision in ("auto", "tf32"),
        overlap=on_cuda and tasks_are_named and can_overlap if options.overlap is None else options.overlap,
    )


def _refusal(execution: str, on_cuda: bool, can_capture: bool) -> str | None:
    if execution == "cudagraph" and not on_cuda:
        return "needs a CUDA device"
    if execution == "cudagraph" and not can_capture:
        return "needs TaskReplayBuffer without VecNormalize, for the batch is drawn inside the graph"
    if execution == "fused" and (on_cuda or not fused_layers_are_available()):
        return "needs a CPU and a torch build with oneDNN"
    if execution == "compile":
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # torch's about itself
                th.compile(_plus_one)(th.zeros(2))
        except Exception as error:  # a missing compiler, Python.h or Triton: torch has many exceptions for it
            return f"needs what torch.compile needs ({str(error).splitlines()[0]})"
    return None


def _plus_one(x: th.Tensor) -> th.Tensor:
    return x + 1


class CapturedActor:
    """Samples actions on CUDA: one captured graph with one copy each way, and one wait, for the actions alone.

    :param actor: the policy's actor
    :param shape: rows, width of an observation, width of an action
    :param device: of the actor
    """

    def __init__(self, actor: Any, shape: tuple[int, int, int], device: th.device) -> None:
        self._actor = actor
        n_envs, obs_dim, action_dim = shape
        pinned = device.type == "cuda"
        self._host_obs = th.empty((n_envs, obs_dim), pin_memory=pinned)
        self._obs = th.empty((n_envs, obs_dim), device=device)
        self._noise = th.empty((n_envs, action_dim), device=device)
        self._host_actions = th.empty((n_envs, action_dim), pin_memory=pinned)
        self._acted = th.cuda.Event()  # type: ignore[no-untyped-call]  # torch's
        self._calls: CapturedCalls[None] = CapturedCalls()

    def __call__(
        self, obs: np.ndarray, deterministic: bool, meanwhile: Callable[[], None] | None = None
    ) -> np.ndarray:
        """Return actions in [-1, 1], ``(n_envs, action_dim)`` float32.

        :param obs: ``(n_envs, obs_dim)``
        :param deterministic: means instead of samples
        :param meanwhile: gives the device more to do, which it does after choosing actions and nobody waits for
        """
        self._host_obs.copy_(th.from_numpy(np.ascontiguousarray(obs)))
        self._calls(partial(self._forward, deterministic), variant=deterministic)
        self._acted.record()
        if meanwhile is not None:
            meanwhile()
        self._acted.synchronize()
        actions: np.ndarray = self._host_actions.numpy().copy()
        return actions

    @th.no_grad()
    def _forward(self, deterministic: bool) -> None:
        self._obs.copy_(self._host_obs, non_blocking=True)
        self._noise.zero_() if deterministic else self._noise.normal_()
        mean, log_std = self._actor.action_distribution(self._obs)
        actions, _ = squashed_gaussian(mean, log_std, self._noise)
        self._host_actions.copy_(actions, non_blocking=True)


class WorkWhileStepping(VecEnvWrapper):
    """An environment whose next ``step`` does some work between sending the actions and awaiting the outcome.

    Work that a GPU does by itself is better begun before: see :meth:`do_work`.

    :param venv: the environment
    """

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.work: Callable[[], None] | None = None
        """Done once, at the latest in the next step; if it raises there, the step is finished first."""
        self.timer: Timer = nullcontext

    def reset(self) -> Any:
        """Reset the environment."""
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """Send the actions."""
        with self.timer("step"):
            self.venv.step_async(actions)

    def do_work(self) -> None:
        """Do the work now, unless it is done."""
        work, self.work = self.work, None
        if work is not None:
            work()

    def step_wait(self) -> VecEnvStepReturn:
        """Do the work unless it is done, then return what the step gave."""
        try:
            self.do_work()
        finally:
            with self.timer("step"):
                outcome = self.venv.step_wait()
        return outcome
