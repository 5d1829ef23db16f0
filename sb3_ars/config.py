"""The method's own options, checked once; the API, the command and the presets build the same dataclass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from sb3_ars.core.objectives import ActorValue
from sb3_ars.core.reward_scale import parse_reward_scaling
from sb3_ars.errors import ConfigError, check_count, nearest
from sb3_ars.nets.lora import LoRAConfig

__all__ = [
    "ARSConfig",
    "CheckpointConfig",
    "Execution",
    "ExecutionConfig",
    "Gradient",
    "Precision",
    "ResetScope",
    "RewardScaling",
    "TaskWeighting",
]

ResetScope = Literal["actor_critic", "critic", "none"]
RewardScaling = Literal["mean", "std", "normalization", "none"] | float | tuple[float, ...] | dict[str, float]
Gradient = Literal["mean", "pcgrad"]
TaskWeighting = Literal["equal", "temperature"]
Precision = Literal["auto", "fp32", "tf32", "bf16"]
Execution = Literal["auto", "eager", "fused", "compile", "cudagraph"]


@dataclass(frozen=True)
class ARSConfig:
    """Options of adaptive reward scaling and resets.

    :raises ConfigError: naming the option, what was given and what is allowed
    """

    n_reset: int | None = None
    """Number of resets, evenly spaced over the run; None is 4 with several tasks (the paper's MT10), 0 with one."""
    param_resets: list[int] | tuple[int, ...] | None = None
    """Environment steps at which to reset, instead of n_reset (SBX's name)."""
    reward_scaling: RewardScaling | None = "mean"
    """"mean" (Eq. 6), "std", "normalization" (Table 5), "none", one number, or one per task (list or {name: c})."""
    reward_floor: float = 0.01
    """Mean rewards below this count as this much in Eq. 6, in units of reward."""
    reset: ResetScope | None = "actor_critic"
    """What a reset renews: "actor_critic" (temperatures too), "critic", or "none"."""
    updates_after_reset: int = 1000
    """Gradient steps on the kept buffers right after a reset."""
    actor_value: ActorValue = "all"
    """Critics the actor's loss reads: "all" (SB3's reduction) or "first" (the authors' code)."""
    gradient: Gradient = "mean"
    """How the tasks' losses become one gradient: their "mean", or "pcgrad" (conflicting gradients projected)."""
    task_weighting: TaskWeighting = "equal"
    """Weight of a task's losses: "equal", or n_tasks softmax(-log alpha_i) by "temperature" (Soft Modularization)."""
    max_task_loss: float | None = None
    """Leave a task out of an update when its critic loss exceeds this, and mix its PaCo parameters anew; None never."""
    lora: dict[str, int | float | bool | str] | None = None
    """Low-rank adapters late in the run: fields of sb3_ars.nets.lora.LoRAConfig, such as {"rank": 8}; None is none."""

    def __post_init__(self) -> None:
        if self.n_reset is not None:
            check_count("n_reset", self.n_reset, minimum=0)
        if self.n_reset is not None and self.param_resets is not None:
            raise ConfigError(
                f"n_reset={self.n_reset} and param_resets={self.param_resets!r} both say when to reset; "
                "give one and set the other to None."
            )
        check_count("updates_after_reset", self.updates_after_reset, minimum=0)
        _check_positive("reward_floor", self.reward_floor)
        _check_choice("reset", self.reset, (*get_args(ResetScope), None))
        _check_choice("actor_value", self.actor_value, get_args(ActorValue))
        _check_choice("gradient", self.gradient, get_args(Gradient))
        _check_choice("task_weighting", self.task_weighting, get_args(TaskWeighting))
        if self.max_task_loss is not None:
            _check_positive("max_task_loss", self.max_task_loss)
        if self.lora is not None:
            LoRAConfig.of(self.lora)
        if self.param_resets is not None:
            _check_param_resets(self.param_resets)
        if isinstance(self.reward_scaling, str):  # numbers are checked once the tasks are known
            parse_reward_scaling(self.reward_scaling, ())

    def resets(self) -> bool:
        """Return whether resets renew anything."""
        return self.reset not in (None, "none")

    def reset_times(self, total_timesteps: int, n_tasks: int) -> list[int]:
        """Return the environment steps, summed over environments, at which resets are due.

        :param total_timesteps: length of the whole run in environment steps
        :param n_tasks: number of tasks
        :raises ConfigError: for as many resets as steps

        Source: paper, Algorithm 1; the spacing T / (n_reset + 1) is the authors' code's.
        """
        if not self.resets():
            return []
        if self.param_resets is not None:
            return [int(step) for step in self.param_resets]
        n_reset = self.n_reset
        if n_reset is None:
            n_reset = 4 if n_tasks > 1 else 0
        if n_reset >= max(total_timesteps, 1):
            raise ConfigError(
                f"n_reset asks for {n_reset} resets in {total_timesteps} steps; train longer, or reset less often "
                "(n_reset=0 for never)."
            )
        return [total_timesteps * (k + 1) // (n_reset + 1) for k in range(n_reset)]


@dataclass(frozen=True)
class ExecutionConfig:
    """Options of how the arithmetic is done; none of them changes what is computed, beyond rounding.

    :raises ConfigError: naming the option, what was given and what is allowed
    """

    precision: Precision = "auto"
    """"fp32"; "bf16": bfloat16 operands between hidden layers; "tf32" (CUDA); auto is fp32 on CPU, tf32 on CUDA."""
    execution: Execution = "auto"
    """"eager": SB3's arithmetic to the bit; "fused": oneDNN layers (CPU); "compile": torch.compile; "cudagraph"."""
    overlap: bool | None = None
    """Whether updates run while the environments step, on data one step older; None is yes on CUDA, no on CPU."""

    def __post_init__(self) -> None:
        _check_choice("precision", self.precision, get_args(Precision))
        _check_choice("execution", self.execution, get_args(Execution))
        if self.overlap is not None and not isinstance(self.overlap, bool):
            raise ConfigError(f"overlap={self.overlap!r} must be True, False or None.")


@dataclass(frozen=True)
class CheckpointConfig:
    """When a run is saved, so that it can go on exactly.

    :raises ConfigError: naming the option, what was given and what is allowed
    """

    every: int | None = None
    """Environment steps, summed over environments, between two checkpoints; None does not count them."""
    every_minutes: float | None = 10.0
    """Minutes of training between two checkpoints; None does not look at the clock."""
    keep: int = 2
    """Newest checkpoints that stay; those of a run that has finished are removed."""

    def __post_init__(self) -> None:
        if self.every is not None:
            check_count("every", self.every)
        if self.every_minutes is not None:
            _check_positive("every_minutes", self.every_minutes)
        check_count("keep", self.keep)


def _check_positive(option: str, value: object) -> None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (is_number and 0 < value < float("inf")):  # type: ignore[operator]  # checked on the line above
        raise ConfigError(f"{option}={value!r} must be a positive number.")


def _check_choice(option: str, value: object, allowed: Sequence[str | None]) -> None:
    if not isinstance(value, str | None) or value not in allowed:
        names = [name for name in allowed if name is not None]
        raise ConfigError(
            f"{option}={value!r} is unknown; choose one of {names}." + nearest(str(value), names)
        )


def _check_param_resets(param_resets: object) -> None:
    if isinstance(param_resets, str) or not isinstance(param_resets, Sequence):
        raise ConfigError(f"param_resets={param_resets!r} must be a list of environment steps.")
    for step in param_resets:
        check_count("param_resets entry", step, minimum=1)
    if list(param_resets) != sorted(set(param_resets)):
        raise ConfigError(f"param_resets={list(param_resets)} must increase from entry to entry.")
