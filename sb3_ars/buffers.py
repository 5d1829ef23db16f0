"""The replay buffer: one ring per task, torch tensors on the training device; knows nothing of scales or resets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import psutil
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ars.core.reward_scale import RewardStatistics
from sb3_ars.errors import ConfigError, EnvContractError, check_count

__all__ = ["TaskReplayBuffer"]

_COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones")


class TaskReplayBuffer(ReplayBuffer):
    """One ring of raw transitions per task; a batch holds equally many rows of each.

    Tensors have shape ``(n_tasks, buffer_size, width)``, float32, on ``device``; the one-hot task id at the end of each
    observation is not stored but put back when sampling. They are allocated at the first :meth:`add`, so a
    model loaded for prediction alone costs nothing.

    :param buffer_size: transitions *per task*
    :param observation_space: flat ``Box`` whose last ``n_tasks`` entries are the one-hot task id
    :param action_space: flat ``Box``
    :param device: where the tensors live
    :param n_envs: number of environments
    :param optimize_memory_usage: not available here; refused
    :param handle_timeout_termination: whether an episode cut by its time limit is stored as not terminated
    :param task_of_env: the task of each environment, ``(n_envs,)``
    :param task_names: the tasks, in order
    :param seed: seed of the buffer's own generator; ``None`` draws one
    :param verbose: 1 prints the size before allocating
    :raises ConfigError: on spaces it cannot store

    Source: paper, section 2.2 and Algorithm 1.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        *,
        task_of_env: Sequence[int] | None = None,
        task_names: Sequence[str] | None = None,
        seed: int | None = None,
        verbose: int = 0,
    ) -> None:
        task_of_env = [0] * n_envs if task_of_env is None else [int(task) for task in task_of_env]
        task_names = ("task",) if task_names is None else tuple(task_names)
        _check_arguments(
            buffer_size,
            observation_space,
            action_space,
            n_envs,
            optimize_memory_usage,
            task_of_env,
            task_names,
        )
        # ReplayBuffer.__init__ would allocate NumPy arrays at once (SB3 2.9.2, common/buffers.py)
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.task_names = task_names
        self.n_tasks = len(task_names)
        self.verbose = verbose
        self.seed = int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] >> 1)
        self._set_task_of_env(task_of_env)
        self.task_pos = np.zeros(self.n_tasks, dtype=np.int64)
        self.task_size = np.zeros(self.n_tasks, dtype=np.int64)
        self._allocated = False
        self._generator = self._make_generator()

    # ------------------------------------------------------------------ writing

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one transition of every environment in its task's ring.

        :param obs: ``(n_envs, obs_dim)``, one-hot included
        :param next_obs: the same, the terminal observation where an episode ended
        :param action: ``(n_envs, action_dim)``, in [-1, 1]
        :param reward: ``(n_envs,)``, raw
        :param done: ``(n_envs,)``
        :param infos: ``TimeLimit.truncated`` is read from them
        :raises EnvContractError: if a value is NaN or infinite, or a terminal observation is missing
        """
        for env in map(int, np.flatnonzero(done)):
            if infos[env].get("terminal_observation") is None:
                raise EnvContractError(
                    f"Task {self._name_of_env(env)!r} ended an episode without infos['terminal_observation']: the next "
                    "episode's first observation would be learned as its outcome. Use an SB3 VecEnv, which sets it."
                )
        terminated = np.asarray(done, dtype=np.float32)
        if self.handle_timeout_termination:
            truncated = [bool(info.get("TimeLimit.truncated", False)) for info in infos]
            terminated = terminated * (1.0 - np.asarray(truncated, dtype=np.float32))
        rows = {
            "observations": np.asarray(obs)[:, : self.obs_dim],
            "next_observations": np.asarray(next_obs)[:, : self.obs_dim],
            "actions": np.asarray(action).reshape(self.n_envs, self.action_dim),
            "rewards": np.asarray(reward).reshape(self.n_envs, 1),
            "dones": terminated.reshape(self.n_envs, 1),
        }
        self._check_finite(rows)
        self._allocate()
        slots = (self.task_pos[self.task_of_env] + self._rank_in_task) % self.buffer_size
        where = (th.from_numpy(self.task_of_env), th.from_numpy(slots))
        for name, values in rows.items():
            getattr(self, name)[where] = th.as_tensor(values, dtype=th.float32, device=self.device)
        self.task_pos = (self.task_pos + self._envs_of_task) % self.buffer_size
        self.task_size = np.minimum(self.task_size + self._envs_of_task, self.buffer_size)
        self.pos, self.full = int(self.task_pos.max()), bool(self.task_size.min() == self.buffer_size)

    def reset(self) -> None:
        """Forget every transition; the memory stays allocated."""
        super().reset()
        self.task_pos[:] = 0
        self.task_size[:] = 0

    # ------------------------------------------------------------------ reading

    def size(self) -> int:
        """Return how many transitions the emptiest task holds."""
        return int(self.task_size.min())

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Return ``batch_size`` rows of each task, drawn uniformly, with replacement, independently per task.

        :param batch_size: rows *per task*
        :param env: normalises observations, as SB3's buffer does
        :return: ``n_tasks * batch_size`` rows, task-major, one-hot appended to the observations
        :raises ConfigError: if a task holds fewer rows than asked for
        """
        short = np.flatnonzero(self.task_size < batch_size)
        if short.size:
            held = ", ".join(f"{self.task_names[task]} ({self.task_size[task]})" for task in short)
            raise ConfigError(
                f"batch_size={batch_size} rows per task, but these tasks hold fewer: {held}. "
                "Collect longer before the first update (learning_starts) or use a smaller batch_size."
            )
        return self.gather(self.draw_slots(batch_size), env)

    def draw_slots(self, batch_size: int) -> th.Tensor:
        """Return written slots, ``(n_tasks, batch_size)`` int64 on the buffer's device."""
        size = th.as_tensor(self.task_size, device=self.device).unsqueeze(1)
        # float64: with float32's 24 bits, slots of a large ring would not be equally likely
        uniform = th.rand(
            (self.n_tasks, batch_size), generator=self._generator, device=self.device, dtype=th.float64
        )
        return (uniform * size).long()

    def gather(self, slots: th.Tensor, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Return the transitions in the given slots as flat task-major rows.

        :param slots: ``(n_tasks, batch)`` int64
        :param env: normalises observations
        """
        task = th.arange(self.n_tasks, device=self.device).unsqueeze(1).expand_as(slots)
        one_hot = th.nn.functional.one_hot(task.reshape(-1), self.n_tasks).float()

        def rows(name: str) -> th.Tensor:
            taken: th.Tensor = getattr(self, name)[task, slots]
            return taken.flatten(0, 1)

        def observations(name: str) -> th.Tensor:
            obs = th.cat((rows(name), one_hot), dim=1)
            if env is None:
                return obs
            normalized = env.normalize_obs(obs.cpu().numpy())
            return th.as_tensor(normalized, dtype=th.float32, device=self.device)

        return ReplayBufferSamples(
            observations=observations("observations"),
            actions=rows("actions"),
            next_observations=observations("next_observations"),
            dones=rows("dones"),
            rewards=rows("rewards"),
        )

    def reward_statistics(self) -> RewardStatistics:
        """Return mean and standard deviation of each task's raw rewards, over everything its ring holds.

        :raises ConfigError: if a task holds no reward yet

        Source: paper, section 4.1, the mean of Eq. 6.
        """
        empty = [self.task_names[task] for task in np.flatnonzero(self.task_size == 0)]
        if empty:
            raise ConfigError(f"No transition stored yet for {', '.join(empty)}: its mean reward is unknown.")
        rewards = [self._written("rewards", task).double() for task in range(self.n_tasks)]
        return RewardStatistics(
            mean=th.stack([r.mean() for r in rewards]),
            std=th.stack([r.std(correction=0) for r in rewards]),
            task_names=self.task_names,
        )

    # ------------------------------------------------------------------ memory, device, pickling

    def memory_bytes(self) -> int:
        """Return how many bytes the allocated rings take."""
        width = 2 * self.obs_dim + self.action_dim + 2
        return self.n_tasks * self.buffer_size * width * 4

    def check_memory(self) -> None:
        """Raise unless the rings fit in what the device has free.

        :raises ConfigError: naming the largest ``buffer_size`` that fits
        """
        if self._allocated:
            return
        if th.device(self.device).type == "cuda":
            available, _ = th.cuda.mem_get_info(self.device)
        else:
            available = psutil.virtual_memory().available
        if self.memory_bytes() > available:
            fits = int(self.buffer_size * available / self.memory_bytes() * 0.9)
            raise ConfigError(
                f"{self._describe_size()} do not fit: {available / 1e9:.2f} GB are free. "
                f"Use buffer_size={fits:_} (per task) or less."
            )

    @property
    def device(self) -> th.device:
        """Device of the tensors; assigning another moves them."""
        return self._device

    @device.setter
    def device(self, device: th.device | str) -> None:
        # SB3's load_replay_buffer assigns .device and expects the data to follow (2.9.2, off_policy_algorithm.py)
        self._device = get_device(device)
        if not getattr(self, "_allocated", False):
            return
        for name in _COLUMNS:
            setattr(self, name, getattr(self, name).to(self._device))
        if self._generator.device.type != self._device.type:
            self._generator = self._make_generator()

    def __getstate__(self) -> dict[str, Any]:
        """Return everything but unwritten slots; tensors as NumPy arrays, which pickle without a second copy."""
        state = self.__dict__.copy()
        written = int(self.task_size.max())
        for name in _COLUMNS:
            if self._allocated:
                state[name] = getattr(self, name)[:, :written].cpu().numpy()
        state["_device"] = str(self._device)
        state["_generator"] = self._generator.get_state().numpy()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore; a device that this machine lacks becomes the CPU."""
        columns = {name: state.pop(name) for name in _COLUMNS if name in state}
        device, generator_state = th.device(state.pop("_device")), state.pop("_generator")
        self.__dict__.update(state)
        same_device = device.type != "cuda" or th.cuda.is_available()
        self._device = device if same_device else th.device("cpu")
        self._generator = self._make_generator()
        if same_device:
            self._generator.set_state(th.from_numpy(generator_state))
        self._allocated = False
        if columns:
            self._allocate()
            for name, values in columns.items():
                getattr(self, name)[:, : values.shape[1]] = th.from_numpy(values).to(self._device)

    def set_task_of_env(self, task_of_env: Sequence[int]) -> None:
        """Accept transitions of another number or order of environments from now on; what is stored stays.

        :param task_of_env: ``(n_envs,)``
        """
        self.n_envs = len(task_of_env)
        self._set_task_of_env([int(task) for task in task_of_env])

    # ------------------------------------------------------------------ private

    def _set_task_of_env(self, task_of_env: Sequence[int]) -> None:
        self.task_of_env = np.asarray(task_of_env, dtype=np.int64)
        self._envs_of_task = np.bincount(self.task_of_env, minlength=self.n_tasks)
        earlier = [int((self.task_of_env[:env] == task).sum()) for env, task in enumerate(self.task_of_env)]
        self._rank_in_task = np.asarray(earlier, dtype=np.int64)

    def _allocate(self) -> None:
        if self._allocated:
            return
        if self.verbose >= 1:
            print(f"Replay buffer: {self._describe_size()} on {self._device}")
        widths = (self.obs_dim, self.obs_dim, self.action_dim, 1, 1)
        for name, width in zip(_COLUMNS, widths, strict=True):
            # empty, not zeros: memory is then taken as slots are written, and unwritten slots are never sampled
            setattr(self, name, th.empty((self.n_tasks, self.buffer_size, width), device=self._device))
        self._allocated = True

    def _make_generator(self) -> th.Generator:
        return th.Generator(device=self._device).manual_seed(self.seed)

    def _check_finite(self, rows: dict[str, np.ndarray]) -> None:
        for name, values in rows.items():
            # one reduction first: the sum of finite float64 values this size cannot overflow
            if not np.isfinite(values.sum(dtype=np.float64)):
                env = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
                raise EnvContractError(
                    f"Task {self._name_of_env(env)!r} gave NaN or infinity in {name.replace('_', ' ')}: "
                    f"{values[env]}. It was not stored; what was learned so far is intact."
                )

    def _written(self, name: str, task: int) -> th.Tensor:
        """Return what a task's ring holds of one column, ``(size, width)``."""
        column: th.Tensor = getattr(self, name)  # SB3 annotates these attributes as NumPy arrays
        return column[task, : self.task_size[task]]

    def _name_of_env(self, env: int) -> str:
        return str(self.task_names[self.task_of_env[env]])

    def _describe_size(self) -> str:
        return f"{self.n_tasks} tasks x {self.buffer_size:,} transitions, {self.memory_bytes() / 1e9:.2f} GB,"

    @property
    def obs_dim(self) -> int:
        """Width of a stored observation, the one-hot left out."""
        return int(self.obs_shape[0]) - self.n_tasks


def _check_arguments(
    buffer_size: int,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    n_envs: int,
    optimize_memory_usage: bool,
    task_of_env: Sequence[int],
    task_names: Sequence[str],
) -> None:
    if optimize_memory_usage:
        raise ConfigError("optimize_memory_usage is not available with per-task buffers; leave it False.")
    for role, space in (("observation", observation_space), ("action", action_space)):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ConfigError(
                f"Per-task buffers store flat Box {role}s, not {space}. Flatten it in the env, for instance with "
                "gymnasium.wrappers.FlattenObservation."
            )
    if observation_space.shape is None or observation_space.shape[0] <= len(task_names):
        raise ConfigError(
            f"Observations of shape {observation_space.shape} cannot end in a one-hot id of {len(task_names)} tasks. "
            "Make the env with make_metaworld_env or make_multitask_env, which append it."
        )
    if len(task_of_env) != n_envs or set(task_of_env) != set(range(len(task_names))):
        raise ConfigError(
            f"task_of_env={list(task_of_env)} must give each of the {n_envs} envs one of the tasks 0 to "
            f"{len(task_names) - 1}, and each task at least one env."
        )
    per_task = max(list(task_of_env).count(task) for task in set(task_of_env))
    check_count("buffer_size", buffer_size, minimum=per_task)  # the envs of a task store at the same time
