"""The SB3 shell that ARSSAC and ARSTQC share: tasks, buffers, the update, resets, saving and loading.

Arithmetic lives in ``sb3_ars.core``; what happens when is ``ARSCallback``'s to say.
"""

from __future__ import annotations

import inspect
import io
import json
import pathlib
import pickle
import warnings
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, EventCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import (
    GymEnv,
    MaybeCallback,
    RolloutReturn,
    Schedule,
    TrainFreq,
    TrainFrequencyUnit,
)
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_ars.algorithms.checkpoint import RowsOnDisk, model_of_checkpoint
from sb3_ars.algorithms.execution import CapturedActor, ExecutionPlan, WorkWhileStepping, plan_execution
from sb3_ars.algorithms.run_state import restore_pending
from sb3_ars.algorithms.sb3_options import check_env, check_policy, check_sb3_options
from sb3_ars.algorithms.task_log import TaskLog
from sb3_ars.buffers import TaskReplayBuffer
from sb3_ars.callbacks.ars import ARSCallback
from sb3_ars.config import (
    ARSConfig,
    Execution,
    ExecutionConfig,
    Gradient,
    Precision,
    ResetScope,
    RewardScaling,
    TaskWeighting,
)
from sb3_ars.core.gradients import MeanGradient, PCGrad
from sb3_ars.core.objectives import ActorValue, Objective
from sb3_ars.core.reset import reset_module_, reset_optimizer_
from sb3_ars.core.reward_scale import RewardScale, RewardStatistics, parse_reward_scaling
from sb3_ars.core.runner import CapturedCalls, compiled, prepare_optimizer_, tf32
from sb3_ars.core.update import Hyperparameters, Metrics, Noise, Timer, UpdateState, update
from sb3_ars.envs import make_multitask_env
from sb3_ars.errors import (
    ConfigError,
    DivergedError,
    EnvContractError,
    check_count,
    check_flag,
    check_path,
    nearest,
)
from sb3_ars.nets.layers import ByTask
from sb3_ars.nets.lora import LoRAConfig, layers_to_adapt
from sb3_ars.nets.mlp import set_arithmetic
from sb3_ars.nets.paco import PaCo
from sb3_ars.nets.popart import PopArtNetwork, PopArtNormalizer
from sb3_ars.task_id import task_index, with_task_id

__all__ = ["MultiTaskOffPolicyAlgorithm"]

Self = TypeVar("Self", bound="MultiTaskOffPolicyAlgorithm")

_RANDOM_PHASE = 0.0125  # of the run: 25,000 of 2 million steps a task in the authors' code


class MultiTaskOffPolicyAlgorithm(OffPolicyAlgorithm):
    """SB3's off-policy algorithm with one replay buffer per task, scaled critic targets and resets.

    An environment with ``task_names`` and ``task_of_env`` (``make_metaworld_env``, ``make_multitask_env``) is
    multi-task; any other is one task and is treated as SB3 treats it, buffer included.

    SB3's arguments come first and mean what they mean in ``stable_baselines3.SAC``, but for:

    :param policy: ``"MlpPolicy"`` has the paper's networks by default; its options are ``ARSSACPolicy``'s
    :param env: SB3 environment, ``VecEnv``, or Gymnasium ``VectorEnv``
    :param buffer_size: transitions per task
    :param learning_starts: environment steps, summed over environments, before the first update; ``"auto"`` is 1.25 %
        of the run and at least one batch per task
    :param batch_size: rows per task in each update
    :param ent_coef: with several tasks there is one temperature per task
    :param use_sde: refused; so is ``n_steps > 1`` with several tasks

    Ours are the fields of :class:`sb3_ars.config.ARSConfig`:

    :param n_reset: number of resets, evenly spaced; ``None`` is 4 with several tasks, 0 with one
    :param param_resets: environment steps at which to reset, instead of ``n_reset``
    :param reward_scaling: ``"mean"`` (Eq. 6), ``"std"``, ``"normalization"``, ``"none"`` or numbers
    :param reward_floor: mean rewards below it count as this much in Eq. 6
    :param reset: ``"actor_critic"``, ``"critic"`` or ``"none"``
    :param updates_after_reset: gradient steps right after a reset
    :param actor_value: critics the actor's loss reads: ``"all"`` (SB3's reduction) or ``"first"``
    :param gradient: ``"mean"`` of the tasks' losses, or ``"pcgrad"``
    :param task_weighting: ``"equal"``, or by ``"temperature"``
    :param max_task_loss: critic loss above which a task is left out of an update
    :param lora: low-rank adapters late in the run, such as ``{"rank": 8}``

    and of :class:`sb3_ars.config.ExecutionConfig`, which change speed and rounding:

    :param precision: ``"auto"``, ``"fp32"``, ``"tf32"`` (CUDA) or ``"bf16"``
    :param execution: ``"auto"``, ``"eager"`` (SB3's arithmetic to the bit), ``"fused"`` (CPU), ``"compile"`` or
        ``"cudagraph"``
    :param overlap: whether updates run while the environments step; ``None`` is yes on CUDA
    :raises ConfigError: if options contradict each other or the environment
    """

    actor: Any
    critic: Any
    critic_target: Any

    # SAC's and TQC's, set by their constructors and _setup_model
    log_ent_coef: th.Tensor | None
    ent_coef_optimizer: th.optim.Adam | None
    ent_coef_tensor: th.Tensor
    target_entropy: Any
    target_update_interval: int

    # ARSConfig's fields, kept as plain attributes, which SB3 saves, loads and lets ``load(..., option=)`` replace
    n_reset: int | None
    param_resets: list[int] | tuple[int, ...] | None
    reward_scaling: RewardScaling | None
    reward_floor: float
    reset: ResetScope | None
    updates_after_reset: int
    actor_value: ActorValue
    gradient: Gradient
    task_weighting: TaskWeighting
    max_task_loss: float | None
    lora: dict[str, Any] | None

    # ExecutionConfig's, likewise
    precision: Precision
    execution: Execution
    overlap: bool | None

    _update_state: UpdateState
    timer: Timer
    """Measures the parts of a run; assign a :class:`~sb3_ars.profiling.PartTimer` to profile."""

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int | str = "auto",
        batch_size: int = 100,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        n_reset: int | None = None,
        param_resets: list[int] | tuple[int, ...] | None = None,
        reward_scaling: RewardScaling | None = "mean",
        reward_floor: float = 0.01,
        reset: ResetScope | None = "actor_critic",
        updates_after_reset: int = 1000,
        actor_value: ActorValue = "all",
        precision: Precision = "auto",
        execution: Execution = "auto",
        overlap: bool | None = None,
        gradient: Gradient = "mean",
        task_weighting: TaskWeighting = "equal",
        max_task_loss: float | None = None,
        lora: dict[str, Any] | None = None,
    ) -> None:
        check_policy(policy, self.policy_aliases)
        check_env(env)
        options: dict[str, Any] = {
            "learning_rate": learning_rate,
            "buffer_size": buffer_size,
            "batch_size": batch_size,
            "tau": tau,
            "gamma": gamma,
            "train_freq": train_freq,
            "gradient_steps": gradient_steps,
            "action_noise": action_noise,
            "replay_buffer_class": replay_buffer_class,
            "replay_buffer_kwargs": replay_buffer_kwargs,
            "optimize_memory_usage": optimize_memory_usage,
            "n_steps": n_steps,
            "ent_coef": ent_coef,
            "target_update_interval": target_update_interval,
            "target_entropy": target_entropy,
            "use_sde": use_sde,
            "sde_sample_freq": sde_sample_freq,
            "use_sde_at_warmup": use_sde_at_warmup,
            "stats_window_size": stats_window_size,
            "tensorboard_log": tensorboard_log,
            "policy_kwargs": policy_kwargs,
            "verbose": verbose,
            "seed": seed,
            "device": device,
        }
        check_sb3_options(options)
        # SB3 2.9.2 writes into the caller's (off_policy_algorithm.py)
        options |= {name: dict(options[name] or {}) for name in ("replay_buffer_kwargs", "policy_kwargs")}
        if "lora" in options["policy_kwargs"]:
            raise ConfigError(
                f"lora belongs to {type(self).__name__}'s own arguments, not to policy_kwargs: there it would freeze "
                "networks that have learned nothing."
            )
        config = ARSConfig(
            n_reset,
            param_resets,
            reward_scaling,
            reward_floor,
            reset,
            updates_after_reset,
            actor_value,
            gradient,
            task_weighting,
            max_task_loss,
            lora,
        )
        execution_config = ExecutionConfig(precision, execution, overlap)
        is_auto = _is_auto(learning_starts)
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]  # None is SB3's way to load without an environment
            learning_starts=0 if is_auto else learning_starts,  # type: ignore[arg-type]  # _is_auto leaves an integer
            **options,
            _init_setup_model=False,  # type: ignore[call-arg]  # SAC or TQC comes next in the order of classes
        )
        self.__dict__.update(vars(config), **vars(execution_config))
        self.timer = nullcontext
        self._auto_learning_starts = 0 if is_auto else None  # what "auto" last came to
        self.task_names: list[str] | None = None
        self.task_of_env: list[int] = []
        self.is_multi_task = False
        self.n_resets = 0
        self.resets_looked_for_until = 0
        self.task_episodes: list[deque[dict[str, float]]] = []  # the latest of each task; TaskLog's
        self.active_tasks: list[int] | None = None  # None is all
        self.schedule_state: dict[str, Any] | None = None  # TaskScheduleCallback's
        self.last_checkpoint: pathlib.Path | None = None
        """The newest checkpoint that this process wrote or was resumed from."""
        self.rows_on_disk: RowsOnDisk | None = None  # where checkpoints go on from
        self._to_restore: dict[str, Any] | None = None  # what learn() makes anew when it begins
        self._after_learn: list[Callable[[], object]] = []
        self._stepping_env: WorkWhileStepping | None = None
        self._is_stepping = False  # from a rollout's first action to its end
        self.scaled_by: str | None = None  # the reward_scaling that c_i comes from
        self.reward_scale_history: list[tuple[int, list[float]]] = []
        if _init_setup_model:
            self._setup_model()

    # ------------------------------------------------------------------ construction

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        if isinstance(env, gym.vector.VectorEnv):  # such as gym.make_vec("Meta-World/MT10")
            env = make_multitask_env(env)
        return OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)

    def _setup_model(self) -> None:
        self.config, self.execution_config  # noqa: B018  # validate: load() replaces attributes after __init__'s check
        if _is_auto(self.learning_starts):  # given to load()
            self.learning_starts = self._auto_learning_starts = 0
        self._check_options()
        self._read_tasks(self.env)
        if self._bodies() or self.lora is not None:
            self.policy_kwargs["n_tasks"] = self.n_tasks
        if self.is_multi_task and self._uses_task_buffer():
            self.replay_buffer_class = self.replay_buffer_class or TaskReplayBuffer
            if self.replay_buffer is None:
                self.replay_buffer = self._make_task_buffer(self.replay_buffer_class)
        super()._setup_model()
        self._check_lora()
        if self.log_ent_coef is not None and self.n_tasks > 1:
            self._make_temperature_per_task(self.log_ent_coef)
        self.reward_scale = RewardScale(self.n_tasks, self.device)
        if len(self.task_episodes) != len(self.task_names or []):  # else loaded
            self.task_episodes = [deque(maxlen=self._stats_window_size) for _ in self.task_names or []]
        self._task_log = TaskLog(self.task_names or [], self.task_episodes)
        self._warned_of_waiting = False
        self._updates_are_done = False
        self._combiner = MeanGradient() if self.gradient == "mean" else PCGrad()
        self._prepare_execution()

    @property
    def config(self) -> ARSConfig:
        """The options as the validated dataclass."""
        return ARSConfig(**{name: getattr(self, name) for name in ARSConfig.__dataclass_fields__})

    @property
    def execution_config(self) -> ExecutionConfig:
        """The options of execution as the validated dataclass."""
        return ExecutionConfig(self.precision, self.execution, self.overlap)

    @property
    def n_tasks(self) -> int:
        """Number of tasks."""
        return len(self.task_names) if self.task_names else 1

    def _check_options(self) -> None:
        # again, for load() replaces attributes
        check_sb3_options({**vars(self), "stats_window_size": self._stats_window_size})
        if self.use_sde:
            raise ConfigError(
                "use_sde=True (gSDE) is not supported: the update draws plain Gaussian noise. Use False."
            )
        if not issubclass(self.policy_class, self.policy_aliases["MlpPolicy"]):
            raise ConfigError(
                f"policy={self.policy_class.__name__} is not one of {type(self).__name__}'s; give 'MlpPolicy', or a "
                f"subclass of {self.policy_aliases['MlpPolicy'].__name__}. A model saved by another algorithm loads "
                "with that algorithm."
            )

    def _read_tasks(self, env: VecEnv | None) -> None:
        """Take names and order of the tasks from the environment; load() and set_env() see to it that they agree."""
        if env is None:
            return
        names = task_names_of(env)
        self._check_tasks(env, names)
        self.is_multi_task = names is not None
        self.task_names = names
        self.task_of_env = (
            [0] * env.num_envs if names is None else [int(task) for task in env.task_of_env]  # type: ignore[attr-defined]
        )

    def _check_tasks(self, env: VecEnv, names: list[str] | None) -> None:
        """Raise if options or wrappers do not go with these tasks; change nothing."""
        if names is None:
            self._check_one_task()
            return
        if self.n_steps > 1:
            raise ConfigError(f"n_steps={self.n_steps} is not available with several tasks; use n_steps=1.")
        if len(names) > 1 and not self._uses_task_buffer():
            raise ConfigError(
                f"replay_buffer_class={self.replay_buffer_class!r} mixes the tasks; leave it None, which gives "
                "TaskReplayBuffer, or pass a subclass of that."
            )
        normalizer = unwrap_vec_normalize(env)
        if normalizer is not None and normalizer.norm_reward:
            raise ConfigError(
                "VecNormalize(norm_reward=True) normalises rewards with one statistic for all tasks; the reward scale "
                "needs raw rewards. Use VecNormalize(norm_reward=False) and choose reward_scaling instead."
            )
        if normalizer is not None and normalizer.norm_obs and (self._bodies() or self.lora is not None):
            raise ConfigError(
                "VecNormalize(norm_obs=True) changes the one-hot task id, which body, critic_body and lora read. Use "
                "norm_obs=False, or the plain network."
            )
        parse_reward_scaling(self.reward_scaling, names)
        self._check_methods(len(names))
        if self.batch_size > self.buffer_size:
            raise ConfigError(
                f"batch_size={self.batch_size} rows per task is more than buffer_size={self.buffer_size} per task "
                "can ever hold; raise buffer_size or lower batch_size."
            )

    def _check_methods(self, n_tasks: int) -> None:
        """Raise where methods exclude each other or need several tasks."""
        if self.gradient != "mean" and n_tasks < 2:
            raise ConfigError(
                f"gradient={self.gradient!r} projects one task's gradient on another's; with one task use 'mean'."
            )
        is_learned = isinstance(self.ent_coef, str)  # type: ignore[attr-defined]  # SAC's and TQC's
        if self.task_weighting != "equal" and (n_tasks < 2 or not is_learned):
            raise ConfigError(
                f"task_weighting={self.task_weighting!r} compares the tasks' learned temperatures, so it needs several "
                "tasks and ent_coef='auto'; use task_weighting='equal'."
            )
        critic_body = self.policy_kwargs.get("critic_body")
        is_popart = isinstance(critic_body, Mapping) and critic_body.get("name") == "popart"
        if is_popart and self.reward_scaling not in (None, "none"):
            raise ConfigError(
                f"critic_body='popart' normalises each task's values, and reward_scaling={self.reward_scaling!r} would "
                "scale the same rewards again. Use reward_scaling='none' with PopArt, or another critic_body."
            )

    def _check_lora(self) -> None:
        """Raise now, not when the adapters are due, if the networks cannot have them."""
        built = self.policy_kwargs.get("lora")
        if built is not None and (self.lora is None or LoRAConfig.of(built) != LoRAConfig.of(self.lora)):
            raise ConfigError(
                f"This model's adapters were made with lora={built}, so it cannot go on with lora={self.lora}; leave "
                "lora out when loading."
            )
        if self.lora is None:
            return
        if self.reset != "actor_critic":
            raise ConfigError(
                f"lora takes the place of resets of actor and critic, late in the run, but reset={self.reset!r}; use "
                "reset='actor_critic'."
            )
        if self._bodies():
            raise ConfigError(f"lora adapts the plain network; leave {' and '.join(self._bodies())} out.")
        if not self.lora_is_enabled:
            for network in (self.actor, self.critic):
                layers_to_adapt(network, LoRAConfig.of(self.lora))

    def _bodies(self) -> list[str]:
        """Return the policy options that ask for a network which sees the task."""
        options = ("body", "critic_body")
        return [name for name in options if self.policy_kwargs.get(name) not in (None, "same")]

    def _check_one_task(self) -> None:
        """Refuse, for a plain environment, what needs to know the tasks."""
        wanted = [f"policy_kwargs[{name!r}]" for name in self._bodies()]
        wanted += ["gradient"] if self.gradient != "mean" else []
        wanted += ["task_weighting"] if self.task_weighting != "equal" else []
        wanted += ["max_task_loss"] if self.max_task_loss is not None else []
        wanted += ["lora"] if self.lora is not None else []
        keeps_timeouts = self.replay_buffer_kwargs.get("handle_timeout_termination", True)
        if self.optimize_memory_usage and keeps_timeouts and self.replay_buffer_class is None:
            raise ConfigError(
                "optimize_memory_usage=True with a plain environment is SB3's, which needs "
                "replay_buffer_kwargs={'handle_timeout_termination': False}; give that, or an environment with named "
                "tasks."
            )
        if wanted:
            raise ConfigError(
                f"{wanted[0]} needs an environment with named tasks; make it with make_multitask_env or "
                "make_metaworld_env."
            )

    def _uses_task_buffer(self) -> bool:
        return self.replay_buffer_class is None or issubclass(self.replay_buffer_class, TaskReplayBuffer)

    def _make_task_buffer(self, buffer_class: Any) -> ReplayBuffer:
        make = partial(
            buffer_class,
            self.buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            task_of_env=self.task_of_env,
            task_names=self.task_names,
            seed=self.seed,
            verbose=self.verbose,
        )
        ours = [name for name in self.replay_buffer_kwargs if name in make.keywords]
        if ours:
            raise ConfigError(
                f"replay_buffer_kwargs sets {', '.join(ours)}, which {type(self).__name__} does itself; leave it out."
            )
        try:
            buffer: ReplayBuffer = make(**self.replay_buffer_kwargs)
        except TypeError as error:
            raise ConfigError(
                f"replay_buffer_kwargs={self.replay_buffer_kwargs!r} do not fit {buffer_class.__name__}: {error}."
            ) from error
        return buffer

    def _make_temperature_per_task(self, log_ent_coef: th.Tensor) -> None:
        """Replace SB3's single temperature by one per task, started at the same value."""
        self.log_ent_coef = log_ent_coef.detach().repeat(self.n_tasks).requires_grad_(True)
        self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=self.lr_schedule(1))

    def _make_update_state(self) -> UpdateState:
        actor, critic, critic_target = self.actor, self.critic, self.critic_target
        bodies = [
            module.body
            for network in (actor, critic, critic_target)
            for module in network.modules()
            if isinstance(module, ByTask)
        ]
        popart = [body for body in bodies if isinstance(body, PopArtNetwork)]
        if self._plan.execution == "compile":
            actor = compiled(actor, "action_distribution")
            critic, critic_target = compiled(critic, "q_values"), compiled(critic_target, "q_values")
        return UpdateState(
            actor=actor,
            critic=critic,
            critic_target=critic_target,
            actor_optimizer=self.actor.optimizer,
            critic_optimizer=self.critic.optimizer,
            log_ent_coef=self.log_ent_coef,
            ent_coef=None if self.log_ent_coef is not None else self.ent_coef_tensor,
            ent_coef_optimizer=self.ent_coef_optimizer,
            norm_statistics=self.batch_norm_stats,  # type: ignore[attr-defined]  # SAC's and TQC's
            norm_statistics_target=self.batch_norm_stats_target,  # type: ignore[attr-defined]
            normalizer=PopArtNormalizer(popart) if popart else None,
            mixtures=[body for body in bodies if isinstance(body, PaCo)],
        )

    def _optimizers(self) -> list[th.optim.Optimizer]:
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        return optimizers if self.ent_coef_optimizer is None else [*optimizers, self.ent_coef_optimizer]

    def _prepare_execution(self) -> None:
        """Make networks and optimizers ready for how updates are executed; again after anything replaced them."""
        train_freq: Any = self.train_freq  # a TrainFreq since SB3's _setup_model
        by_step = train_freq.unit == TrainFrequencyUnit.STEP
        if not by_step and self.n_envs > 1:
            raise ConfigError(
                f"train_freq=({train_freq.frequency}, 'episode') needs a single environment, and here are "
                f"{self.n_envs}, whose episodes end apart; give it in steps."
            )
        if self.overlap and not by_step:
            raise ConfigError(
                "overlap=True needs train_freq in steps: how many updates an episode is worth is known when it ends."
            )
        self._plan: ExecutionPlan = plan_execution(
            self.execution_config,
            self.device,
            tasks_are_named=self.is_multi_task,
            can_capture=self._uses_task_buffer() and self._vec_normalize_env is None,
            can_overlap=by_step,
        )
        execution = self._plan.execution
        set_arithmetic(self.policy, execution == "fused", "bf16" if self._plan.bf16 else "fp32")
        for optimizer in self._optimizers():
            prepare_optimizer_(optimizer, execution != "eager", capturable=execution == "cudagraph")
        self._update_state = self._make_update_state()
        self._captured_updates: CapturedCalls[Metrics] = CapturedCalls()
        self._captured_actor: CapturedActor | None = None

    def _make_objective(self) -> Objective:
        """Return SAC's or TQC's objective."""
        raise AssertionError("a subclass names its objective")

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Replace the environment, as SB3 does; it must have the model's tasks in the model's order.

        :param env: the new environment
        :param force_reset: whether the next ``learn`` resets it first
        :raises ConfigError: if its tasks differ
        """
        if env is None:
            raise ConfigError("env=None: set_env needs an environment with the model's tasks.")
        check_env(env)
        wrapped = self._wrap_env(env, self.verbose)
        if task_names_of(wrapped) != self.task_names:
            raise ConfigError(
                f"This model was made for {_describe(self.task_names)}, but the environment has "
                f"{_describe(task_names_of(wrapped))}. Make the environment with the model's task list, in its order."
            )
        self._check_tasks(wrapped, self.task_names)
        super().set_env(wrapped, force_reset)
        self._read_tasks(self.env)
        self._prepare_execution()
        if isinstance(self.replay_buffer, TaskReplayBuffer):
            self.replay_buffer.set_task_of_env(self.task_of_env)

    def set_active_tasks(self, tasks: Sequence[str | int] | None) -> None:
        """Collect from these tasks only, from the next step on; updates go on over all tasks' buffers.

        An inactive task's episode waits, and goes on where it stood. Environment steps count what is collected. To be
        called between two rollouts (``on_rollout_start``).

        :param tasks: names or indices; ``None`` is all
        :raises ConfigError: for an unknown task, none at all, or an environment that can only step as a whole
        """
        if tasks is not None and (isinstance(tasks, str) or not isinstance(tasks, Sequence)):
            raise ConfigError(
                f"tasks={tasks!r} must be a list of tasks, such as [{tasks!r}], or None for all."
            )
        indices = None if tasks is None else sorted({task_index(task, self.task_names) for task in tasks})
        if indices == []:
            raise ConfigError(
                "set_active_tasks([]) would collect nothing; name at least one task, or None for all."
            )
        if self._is_stepping:
            raise ConfigError(
                "set_active_tasks() in the middle of a rollout: steps already made would be lost. Call it between two, "
                "in a callback's _on_rollout_start."
            )
        normalizer = self._vec_normalize_env
        if normalizer is not None and normalizer.norm_obs:
            raise ConfigError(
                "VecNormalize(norm_obs=True) would count the observation of a waiting task at every step; use "
                "norm_obs=False with set_active_tasks and schedules."
            )
        env: Any = self.env
        buffer = self.replay_buffer
        if not isinstance(buffer, TaskReplayBuffer) or not hasattr(env, "set_active_tasks"):
            raise ConfigError(
                "set_active_tasks needs the environment of make_multitask_env(functions), make_metaworld_env or "
                "make_toy_env, whose tasks can be stepped one without the others."
            )
        env.set_active_tasks(indices)
        buffer.set_active_tasks(indices)
        self.active_tasks = indices
        # SB3 calls on_rollout_start with the rollout's environment in hand
        if self._stepping_env is not None:
            self._stepping_env.num_envs = self._n_active_envs()

    def _n_active_envs(self) -> int:
        """Return how many environments a vector step steps."""
        if self.active_tasks is None:
            return self.n_envs
        return sum(self.task_of_env.count(task) for task in self.active_tasks)

    # ------------------------------------------------------------------ learning

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for ``total_timesteps`` environment steps, summed over environments; SB3's ``learn``.

        :param total_timesteps: environment steps; the reset times follow from it
        :param callback: SB3 callbacks; ``ARSCallback`` is put before them unless one is among them
        :param log_interval: episodes between two log entries
        :param tb_log_name: name of the TensorBoard run; ``None`` is the class's name
        :param reset_num_timesteps: whether the step counter starts at 0
        :param progress_bar: whether to show one
        :raises ConfigError: before the first step, if the options do not fit the run
        """
        _check_learn(total_timesteps, log_interval)
        _check_callback(callback)
        for option, flag in (("reset_num_timesteps", reset_num_timesteps), ("progress_bar", progress_bar)):
            check_flag(option, flag)
        if not isinstance(tb_log_name, str | None):
            raise ConfigError(f"tb_log_name={tb_log_name!r} must be the name of a TensorBoard run, or None.")
        try:
            super().learn(
                total_timesteps=int(total_timesteps),
                callback=callback,
                log_interval=log_interval,
                tb_log_name=type(self).__name__ if tb_log_name is None else tb_log_name,
                reset_num_timesteps=reset_num_timesteps,
                progress_bar=progress_bar,
            )
        except DivergedError as error:
            if self.last_checkpoint is None:
                raise
            raise DivergedError(f"{error} The last good checkpoint is {self.last_checkpoint}.") from error
        finally:
            self._updates_are_done = False  # a train() of the user's own is not learn()'s
            self._leave_schedule()
            while self._after_learn:
                self._after_learn.pop()()
        return self

    def after_learn(self, function: Callable[..., object], *arguments: Any) -> None:
        """Have a function called once when the running ``learn()`` ends, however it ends; the last one first.

        :param function: what to call
        :param arguments: its arguments
        """
        self._after_learn.append(partial(function, *arguments))

    @property
    def remaining_timesteps(self) -> int:
        """Environment steps that the run whose checkpoint this is had left: what to call ``learn`` with."""
        return max(0, self._total_timesteps - self.num_timesteps)

    def _leave_schedule(self) -> None:
        """Let all tasks collect where a schedule chose some: it goes on from its own state."""
        if self.schedule_state is None or self.active_tasks is None:
            return
        with suppress(RuntimeError):  # an environment that the error which ended learn() has closed
            self.set_active_tasks(None)
        self.active_tasks = None

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        self._last_dump_at = -1
        starts_afresh = reset_num_timesteps or self.num_timesteps == 0
        self._resolve_learning_starts(total_timesteps, starts_afresh)
        if isinstance(self.replay_buffer, TaskReplayBuffer):
            self.replay_buffer.check_memory()
        self._leave_schedule()
        if self.active_tasks is not None:  # a loaded model's environment and buffer know nothing of it
            self.set_active_tasks(self.active_tasks)
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        restore_pending(self, callback)
        return total_timesteps, callback

    def _resolve_learning_starts(self, total_timesteps: int, starts_afresh: bool) -> None:
        """Turn ``"auto"`` into a number of steps, and check that it fills one batch per task."""
        rows_per_step = (
            min(self.task_of_env.count(task) for task in set(self.task_of_env)) if self.task_of_env else 1
        )
        one_batch = -(-self.batch_size // rows_per_step) * self.n_envs
        is_auto = (
            self._auto_learning_starts is not None and self.learning_starts == self._auto_learning_starts
        )
        if is_auto and starts_afresh:  # a value assigned since, or given to load(), is not auto's and stays
            self.learning_starts = max(int(_RANDOM_PHASE * total_timesteps), one_batch)
            self._auto_learning_starts = self.learning_starts
        if self.is_multi_task and starts_afresh and self.learning_starts >= total_timesteps:
            warnings.warn(
                f"learning_starts={self.learning_starts} leaves no updates in {total_timesteps} steps.",
                stacklevel=4,
            )
        if self.is_multi_task and starts_afresh and self.learning_starts < one_batch:
            raise ConfigError(
                f"learning_starts={self.learning_starts} steps in all give some task fewer rows than "
                f"batch_size={self.batch_size}; use learning_starts={one_batch} or more, or a smaller batch_size."
            )

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        given = CallbackList(callback) if isinstance(callback, list) else callback
        if any(isinstance(found, ARSCallback) for found in _inside_events(given)):
            raise ConfigError(
                "An ARSCallback inside an event callback is never told of rollouts, so it would never reset; pass it "
                "to learn() directly or in a list."
            )
        if not any(isinstance(found, ARSCallback) for found in _walk(given)):
            # before the others, so that a checkpoint or evaluation in the same step sees the networks after a reset
            others = (
                []
                if given is None
                else [given if isinstance(given, BaseCallback) else ConvertCallback(given)]
            )
            given = CallbackList([ARSCallback(), *others])
        return super()._init_callback(given, progress_bar)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """Collect as SB3 does; with ``overlap``, the updates that the data so far is worth run in the first step.

        So every call begins and ends with all updates done and no step under way. Beside serial execution the newest
        transition is seen one update later, and the last one of ``learn()`` is not trained on.

        :param env: to step
        :param callback: SB3's
        :param train_freq: SB3's
        :param replay_buffer: to write
        :param action_noise: SB3's
        :param learning_starts: SB3's
        :param log_interval: SB3's
        """
        if self._stepping_env is None or self._stepping_env.venv is not env:
            self._stepping_env = WorkWhileStepping(env)
        self._stepping_env.timer = self.timer
        self._stepping_env.num_envs = self._n_active_envs()  # what a step counts as
        self._stepping_env.work = partial(self._train_for, train_freq) if self._plan.overlap else None
        self._updates_are_done = False
        try:
            rollout = super().collect_rollouts(
                self._stepping_env,
                callback,
                train_freq,
                replay_buffer,
                action_noise,
                learning_starts,
                log_interval,
            )
        finally:
            self._is_stepping = False
        self._updates_are_done = self._plan.overlap and rollout.continue_training
        return rollout

    def _train_for(self, train_freq: TrainFreq) -> None:
        """Do the updates that one rollout is worth."""
        gradient_steps = (
            self.gradient_steps if self.gradient_steps >= 0 else train_freq.frequency * self._n_active_envs()
        )
        if self.num_timesteps > self.learning_starts and gradient_steps > 0:
            self.train(gradient_steps, self.batch_size)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        self._is_stepping = True
        try:
            with self.timer("act"):
                # SB3 2.9.2 (off_policy_algorithm.py) asks for as many actions as it counts steps
                actions, buffer_actions = super()._sample_action(learning_starts, action_noise, self.n_envs)
                # torch's Normal refuses a mean of NaN, unless something in the process has used torch.compile
                if not np.isfinite(buffer_actions).all():
                    raise ValueError("the actor gave NaN or infinity")
        except ValueError as error:
            if all(th.isfinite(parameter).all() for parameter in self.actor.parameters()):
                raise
            raise DivergedError(
                f"The policy holds NaN or infinity at step {self.num_timesteps}. Continue from an earlier save with a "
                "smaller learning_rate or smaller rewards."
            ) from error
        return actions, buffer_actions

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        with self.timer("store"):
            self._check_finite("observation", new_obs)
            self._check_finite("reward", reward)
            super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _check_finite(self, what: str, values: np.ndarray | dict[str, np.ndarray]) -> None:
        """Raise before a NaN or an infinity reaches the buffer."""
        for array in values.values() if isinstance(values, dict) else (values,):
            if np.isfinite(array.sum(dtype=np.float64)):
                continue
            finite = np.isfinite(array.reshape(len(array), -1)).all(axis=1)
            if not finite.all():
                env = int(np.flatnonzero(~finite)[0])
                names = self.task_names or ["environment"]
                raise EnvContractError(
                    f"Task {names[self.task_of_env[env]]!r} (env {env}) gave NaN or infinity as {what} at step "
                    f"{self.num_timesteps}: {array[env]}. It was not stored, and the model is as it was before."
                )

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        if self.is_multi_task and dones is not None:
            for env in np.flatnonzero(dones):
                if infos[env].get("worker_restarted"):  # it broke off, so its return and success are unknown
                    continue
                self._task_log.add_episode(self.task_of_env[env], infos[env])

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Do gradient steps on batches of ``batch_size`` rows per task.

        :param gradient_steps: how many
        :param batch_size: rows per task
        """
        if self._updates_are_done:  # learn() asks after each rollout
            self._updates_are_done = False
            return
        if not self.has_batch():
            self._warn_of_waiting()
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self._optimizers())
        hyperparameters = Hyperparameters(
            self.gamma,
            self.tau,
            float(self.target_entropy),
            self._make_objective(),
            self._combiner,
            self.task_weighting == "temperature",
            self.max_task_loss,
        )
        normalizer = self._update_state.normalizer
        refresh_period = 1 if normalizer is None else normalizer.update_period
        with tf32(self._plan.tf32):
            for _ in range(gradient_steps):
                # counted over the whole run; SB3 2.9.2 counts within one train() call (sac.py), so 1 step never waits
                variant = (
                    self._n_updates % self.target_update_interval == 0,
                    self._n_updates % refresh_period == 0,
                )
                metrics = self._execute(hyperparameters, batch_size, variant)
                self._n_updates += 1
                with self.timer("log"):
                    self._task_log.add_update(metrics)

    def _execute(
        self, hyperparameters: Hyperparameters, batch_size: int, variant: tuple[bool, bool]
    ) -> Metrics:
        """Run one update as planned.

        :param variant: whether the target critics move, and whether the normalizer does
        """
        if self._plan.execution != "cudagraph":
            return self._sample_and_update(hyperparameters, batch_size, variant, self.timer)
        step = partial(self._sample_and_update, hyperparameters, batch_size, variant, nullcontext)
        buffer: Any = self.replay_buffer
        frozen = (hyperparameters, batch_size, id(buffer), buffer.storage_version)
        with self.timer("update"):
            return self._captured_updates(step, variant, frozen, [buffer.generator])

    def _sample_and_update(
        self, hyperparameters: Hyperparameters, batch_size: int, variant: tuple[bool, bool], timer: Timer
    ) -> Metrics:
        assert self.replay_buffer is not None
        with timer("sample"):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
        noise = self._draw_noise(batch.actions)
        return update(self._update_state, batch, noise, self.reward_scale, hyperparameters, *variant, timer)

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        """Set the learning rate, as SB3 does, but in place where it lives on the device."""
        learning_rate = self.lr_schedule(self._current_progress_remaining)
        self.logger.record("train/learning_rate", learning_rate)
        for optimizer in optimizers if isinstance(optimizers, list) else [optimizers]:
            for group in optimizer.param_groups:
                if isinstance(group["lr"], th.Tensor):
                    group["lr"].fill_(learning_rate)
                else:
                    group["lr"] = learning_rate

    def _draw_noise(self, actions: th.Tensor) -> Noise:
        """Return what is random in one update, the actions' noise first and in the order SB3 draws it."""
        noise = th.randn_like(actions), th.randn_like(actions)
        uniform = partial(th.rand, self.n_tasks, self.n_tasks, device=self.device)
        projects, mixes = self.gradient != "mean", bool(self._update_state.mixtures)
        return Noise(
            *noise,
            critic_order=uniform() if projects else None,
            actor_order=uniform() if projects else None,
            mixture=uniform() if mixes and self.max_task_loss is not None else None,
        )

    def has_batch(self) -> bool:
        """Return whether the buffer holds a batch of every task; a run resumed without its buffer does not at first."""
        assert self.replay_buffer is not None
        wanted = self.batch_size if isinstance(self.replay_buffer, TaskReplayBuffer) else 1
        return self.replay_buffer.size() >= wanted

    def _warn_of_waiting(self) -> None:
        if not self._warned_of_waiting:
            self._warned_of_waiting = True
            warnings.warn(
                f"Updates wait until every task holds batch_size={self.batch_size} rows; the replay buffer was not "
                "loaded or is new. Use load_replay_buffer to continue a run exactly.",
                stacklevel=3,
            )

    # ------------------------------------------------------------------ the method's two actions

    def update_reward_scale(self) -> None:
        """Recompute c_i from the rewards each task's buffer holds now (Eq. 6).

        With a plain single-task environment there is nothing to compare with: c = 1, or the number given.

        :raises ConfigError: if the rule is undefined for the rewards seen; networks and buffers are untouched
        """
        rule = parse_reward_scaling(self.reward_scaling, self.task_names or ["environment"])
        before = self.reward_scale.scale.clone()
        self.reward_scale.update_(*rule(self._reward_statistics(), self.reward_floor))
        for critic in (self.critic, self.critic_target):
            if critic.value_scale is not None:  # a frozen base goes on in the units it learned
                critic.value_scale.mul_(self.reward_scale.scale / before)
        self.scaled_by = repr(self.reward_scaling)
        self.reward_scale_history.append((self.num_timesteps, self.reward_scale.scale.tolist()))

    def reset_networks(self) -> None:
        """Give the networks fresh weights in place, as ``reset`` says; buffers, counters and c_i stay.

        ``"actor_critic"`` renews actor, critics, target critics, their optimizers and the temperatures; ``"critic"``
        the critics, target critics and their optimizer. The global random generators are not touched.

        With adapters, they alone are renewed: see :meth:`renew_lora`.

        Source: paper, Algorithm 1, line 16. Deviation: fresh weights at each reset, where the authors' code returns to
        the same initial ones.
        """
        if self.reset in (None, "none"):
            return
        if self.lora_is_enabled:  # fresh weights would stay as they are drawn, for the base does not learn
            self.renew_lora()
            return
        self.n_resets += 1
        with self._seeded_by(self.n_resets):
            fresh: Any = self.policy_class(
                self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs
            ).to(self.device)
        if self.reset == "critic" and self.critic.share_features_extractor:
            for critic in (fresh.critic, fresh.critic_target):  # the features are the actor's, which stays
                reset_module_(critic.features_extractor, self.actor.features_extractor)
        reset_module_(self.critic, fresh.critic)
        reset_module_(self.critic_target, fresh.critic_target)
        reset_optimizer_(self.critic.optimizer)
        if self.reset == "actor_critic":
            reset_module_(self.actor, fresh.actor)
            reset_optimizer_(self.actor.optimizer)
            self._reset_temperature()

    @contextmanager
    def _seeded_by(self, number: int) -> Iterator[None]:
        """Draw from a stream of the model's seed and a number; torch's global one goes on as if nothing was drawn."""
        entropy = np.random.SeedSequence(None if self.seed is None else [self.seed, number])
        with th.random.fork_rng(devices=[self.device] if self.device.type == "cuda" else []):
            th.manual_seed(int(entropy.generate_state(1)[0]))
            yield

    def mean_success(self) -> float:
        """Return the mean over tasks of the latest training episodes' success; NaN while a task has none."""
        return self._task_log.mean_success()

    @property
    def lora_is_enabled(self) -> bool:
        """Whether the networks are frozen but for their adapters."""
        return self.policy_kwargs.get("lora") is not None

    def enable_lora(self) -> None:
        """Freeze the networks and add the adapters that ``lora`` asks for; outputs stay as they are.

        Everything saved from now on loads with them.

        :raises ConfigError: without ``lora``, or if adapters are there already
        """
        if self.lora is None or self.lora_is_enabled:
            raise ConfigError(f"enable_lora() needs the option lora, once: lora={self.lora!r}.")
        policy: Any = self.policy
        with self._seeded_by(self.n_resets + 1):
            policy.enable_lora(self.lora)
        self.policy_kwargs["lora"] = dict(self.lora)
        self.n_resets += 1
        self._prepare_execution()

    def renew_lora(self) -> None:
        """Start the adapters afresh on their frozen base, with new moments in their optimizers; layer norms stay."""
        policy: Any = self.policy
        with self._seeded_by(self.n_resets + 1):
            policy.renew_lora()
        for optimizer in (self.actor.optimizer, self.critic.optimizer):
            reset_optimizer_(optimizer)
        self.n_resets += 1

    def _reset_temperature(self) -> None:
        if self.log_ent_coef is None or self.ent_coef_optimizer is None:
            return
        ent_coef = str(self.ent_coef)  # type: ignore[attr-defined]  # SAC's and TQC's: "auto" or "auto_0.1"
        initial = float(ent_coef.split("_")[1]) if "_" in ent_coef else 1.0
        with th.no_grad():
            self.log_ent_coef.fill_(float(np.log(initial)))
        reset_optimizer_(self.ent_coef_optimizer)

    def _reward_statistics(self) -> RewardStatistics:
        if isinstance(self.replay_buffer, TaskReplayBuffer):
            return self.replay_buffer.reward_statistics()
        return _plain_statistics(self.replay_buffer)

    # ------------------------------------------------------------------ logging

    def dump_logs(self) -> None:
        """Write log data, at most once per environment step; this is where metrics leave the device."""
        if self.num_timesteps == self._last_dump_at:
            return  # SB3 asks once per ended episode, and the horizons of several tasks end together
        self._last_dump_at = self.num_timesteps
        with self.timer("log"):
            self._task_log.record(
                self.logger, self._n_updates, self.log_ent_coef is not None, self.max_task_loss is not None
            )
            if self.is_multi_task:
                assert isinstance(self.replay_buffer, TaskReplayBuffer)
                self._task_log.record_scale(
                    self.logger, self.reward_scale.scale, self.replay_buffer.reward_statistics().mean
                )
            super().dump_logs()

    # ------------------------------------------------------------------ prediction, saving, loading

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        task: str | int | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return actions, as SB3 does; ``task`` appends the one-hot id to observations that lack it.

        :param observation: ``(obs_dim,)`` or ``(n, obs_dim)``
        :param state: unused by these policies
        :param episode_start: unused by these policies
        :param deterministic: mean action instead of a sample
        :param task: name or index of the task all rows belong to
        :raises ConfigError: if the model has no such task
        """
        observation = with_task_id(observation, task, self.task_names, self.observation_space)
        if self._plan.execution == "cudagraph" and _same_shape(observation, self._last_obs):
            return self._predict_captured(observation, deterministic), state
        return super().predict(observation, state, episode_start, deterministic)

    def _predict_captured(self, observation: Any, deterministic: bool) -> np.ndarray:
        """Return actions for one observation of each environment through the captured actor.

        In a rollout the updates that overlap with its first step are queued before the actions are awaited: the device
        would have nothing to do while they are sent to the environments.
        """
        if self._captured_actor is None:
            shape = (*observation.shape, *(self.action_space.shape or ()))
            self._captured_actor = CapturedActor(self.actor, shape, self.device)
        self.policy.set_training_mode(False)
        meanwhile = (
            self._stepping_env.do_work if self._is_stepping and self._stepping_env is not None else None
        )
        with tf32(self._plan.tf32):
            return self.policy.unscale_action(self._captured_actor(observation, deterministic, meanwhile))

    def set_parameters(
        self,
        load_path_or_dict: str | dict[str, Any],
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """Load parameters, as SB3 does.

        :param load_path_or_dict: SB3's
        :param exact_match: SB3's
        :param device: SB3's
        """
        super().set_parameters(load_path_or_dict, exact_match, device)
        self._prepare_execution()  # the optimizers took over options of the machine that saved them

    @classmethod
    def load(  # type: ignore[override]  # SB3 annotates self-typed class methods per class
        cls: type[Self],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        **kwargs: Any,
    ) -> Self:
        """Load a model, as SB3 does.

        :param path: what ``save`` wrote
        :param env: an environment with the same tasks in the same order, or ``None`` for prediction alone
        :param kwargs: SB3's further arguments, or options to replace
        :raises ConfigError: if the environment has other tasks, the file holds no model, or there is no such option
        """
        _check_option_names(cls, kwargs)
        check_env(env)
        if not hasattr(path, "read"):
            check_path("path", path)
        saved = _saved_task_names(path)
        if env is not None:
            env = cls._wrap_env(env)
            _check_saved_tasks(path, saved, task_names_of(env))
        return super().load(path, env=env, **kwargs)

    @classmethod
    def resume(cls: type[Self], path: str | pathlib.Path, env: GymEnv, **options: Any) -> Self:
        """Return the model of a run as it was at its newest whole checkpoint, to go on to the bit.

        ::

            model = ARSSAC.resume("runs/mine/checkpoints", env)
            model.learn(model.remaining_timesteps, callback=..., reset_num_timesteps=False)

        Nothing is unpickled: options that are objects (a learning rate schedule, a class of your own) are given anew.

        :param path: of a run, of its checkpoints (see `RunCheckpoint`), or of one of them
        :param env: made with the same arguments as the run's; ``n_workers`` may differ
        :param options: of the constructor, in the place of those that were saved, such as ``device``
        :raises CheckpointError: if no checkpoint is whole, it is another algorithm's, or other tasks'
        :raises ConfigError: if there is no such option, or it cannot work
        """
        if env is None:
            raise ConfigError("env=None: a run goes on in an environment; make it as the run's was.")
        check_env(env)
        _check_option_names(cls, options)
        return model_of_checkpoint(cls, check_path("path", path), env, options)

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Save the replay buffer, as SB3 does; with several tasks straight from memory, without a second copy.

        :param path: where to; without a suffix it gets ``.pkl``
        """
        if not isinstance(self.replay_buffer, TaskReplayBuffer):
            super().save_replay_buffer(path)
            return
        with _opened(path, "w", self.verbose) as file:
            self.replay_buffer.write_to(file)

    def load_replay_buffer(
        self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True
    ) -> None:
        """Load a replay buffer, as SB3 does; it must hold the model's tasks. With several, it is read into place.

        :param path: what ``save_replay_buffer`` wrote
        :param truncate_last_traj: SB3's, for hindsight buffers
        :raises ConfigError: if its tasks differ, or it was cut off; the model keeps the buffer it had
        """
        kept = self.replay_buffer
        with _opened(path, "r", self.verbose) as file:
            if isinstance(kept, TaskReplayBuffer):
                kept.read_from(file)
                return
            try:
                super().load_replay_buffer(file, truncate_last_traj)
                self._check_loaded_buffer(path)
            except pickle.UnpicklingError as error:
                raise ConfigError(
                    f"{path} is no pickled replay buffer of a plain environment ({error}). A buffer of several tasks "
                    "loads into a model of those tasks."
                ) from error
            except Exception:
                self.replay_buffer = kept
                raise

    def _check_loaded_buffer(self, path: Any) -> None:
        buffer = self.replay_buffer
        assert buffer is not None
        spaces = (buffer.observation_space.shape, buffer.action_space.shape)
        if spaces != (self.observation_space.shape, self.action_space.shape):
            raise ConfigError(
                f"The replay buffer in {path} holds observations and actions of shapes {spaces}, this model has "
                f"{self.observation_space.shape} and {self.action_space.shape}."
            )

    def _excluded_save_params(self) -> list[str]:
        ours = ["_update_state", "_task_log", "reward_scale", "timer", "_plan", "_combiner"]
        captured = ["_captured_updates", "_captured_actor", "_stepping_env"]
        resumed = ["last_checkpoint", "rows_on_disk", "_to_restore", "_after_learn"]
        return [*super()._excluded_save_params(), *ours, *captured, *resumed]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return state_dicts, [*tensors, "reward_scale.scale", "reward_scale.shift"]


def _check_learn(total_timesteps: Any, log_interval: Any) -> None:
    is_number = isinstance(total_timesteps, int | float | np.number) and not isinstance(total_timesteps, bool)
    if not is_number or not 0 <= total_timesteps < float("inf") or total_timesteps != int(total_timesteps):
        raise ConfigError(f"total_timesteps={total_timesteps!r} must be a whole number of environment steps.")
    if log_interval is not None:
        check_count("log_interval", log_interval)


def _check_callback(callback: Any) -> None:
    """Refuse what SB3 would find out to be no callback at the first step."""
    is_function = callable(callback) and not isinstance(callback, type)
    if callback is None or is_function:
        return
    for each in callback if isinstance(callback, list) else [callback]:
        if not isinstance(each, BaseCallback):
            hint = " Call the class: give what it returns." if isinstance(each, type) else ""
            raise ConfigError(
                f"callback={each!r} must be a callback of SB3's, a list of them, a function or None.{hint}"
            )


def task_names_of(env: GymEnv) -> list[str] | None:
    """Return the names of a multi-task environment's tasks, ``None`` for a plain one."""
    names = getattr(env, "task_names", None)
    return None if names is None else list(names)


@contextmanager
def _opened(path: str | pathlib.Path | io.BufferedIOBase, mode: str, verbose: int) -> Iterator[Any]:
    """Open a replay buffer's file as SB3 does, and close it unless the caller opened it."""
    file = open_path(path, mode, verbose=verbose, suffix="pkl")
    try:
        yield file
    finally:
        if file is not path:
            file.close()


def _check_option_names(cls: type[Any], options: Mapping[str, Any]) -> None:
    """Refuse a misspelt option, which SB3 would keep as an attribute that nobody reads."""
    known = [name for c in (cls, MultiTaskOffPolicyAlgorithm) for name in inspect.signature(c).parameters]
    known = [name for name in known if name not in ("args", "kwargs")]
    for name in options:
        if name not in (*known, "custom_objects", "print_system_info", "force_reset"):
            raise ConfigError(f"{name!r} is no option of {cls.__name__}.{nearest(name, known)}")


def _saved_task_names(path: str | pathlib.Path | io.BufferedIOBase) -> list[str] | None:
    """Return the tasks of a saved model, ``None`` for one of a plain environment."""
    file = open_path(path, "r", verbose=0, suffix="zip")
    start = file.tell()
    try:
        with zipfile.ZipFile(file) as archive:
            names: list[str] | None = json.loads(archive.read("data")).get("task_names")
            return names
    except (zipfile.BadZipFile, KeyError, ValueError, AttributeError) as error:
        raise ConfigError(f"{path} is not a saved model ({error}).") from error
    finally:
        if file is path:
            file.seek(start)
        else:
            file.close()


def _check_saved_tasks(path: Any, saved: list[str] | None, names: list[str] | None) -> None:
    """Name the tasks before SB3 compares spaces, whose error shows two boxes of numbers."""
    if saved != names:
        raise ConfigError(
            f"{path} was trained on {_describe(saved)}, but the environment has {_describe(names)}. Make the "
            "environment with the model's task list, in its order, or load without env to predict."
        )


def _same_shape(a: object, b: object) -> bool:
    return isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and a.shape == b.shape


def _describe(names: list[str] | None) -> str:
    return "one plain environment" if names is None else f"the tasks {names}"


def _plain_statistics(replay_buffer: ReplayBuffer | None) -> RewardStatistics:
    assert replay_buffer is not None
    rewards = th.as_tensor(replay_buffer.rewards[: replay_buffer.size()], dtype=th.float64)
    return RewardStatistics(rewards.mean().reshape(1), rewards.std(correction=0).reshape(1), ("environment",))


def _walk(callback: Any) -> Iterator[Any]:
    """Yield a callback and, of a list, those in it."""
    yield callback
    if isinstance(callback, CallbackList):
        for child in callback.callbacks:
            yield from _walk(child)


def _inside_events(callback: Any) -> Iterator[Any]:
    """Yield the callbacks inside event callbacks, to which SB3 2.9.2 (callbacks.py) forwards no rollout hooks."""
    for found in _walk(callback):
        if isinstance(found, EventCallback):
            for child in (found.callback, getattr(found, "callback_on_new_best", None)):
                yield from _walk(child)
                yield from _inside_events(child)


def _is_auto(learning_starts: object) -> bool:
    if learning_starts == "auto":
        return True
    if isinstance(learning_starts, str):
        raise ConfigError(
            f"learning_starts={learning_starts!r} must be 'auto' or a number of environment steps."
        )
    check_count("learning_starts", learning_starts, minimum=0)
    return False
