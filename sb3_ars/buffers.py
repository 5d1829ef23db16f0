"""The replay buffer: one ring per task, torch tensors on the training device; knows nothing of scales or resets."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
from sb3_ars.errors import ConfigError, EnvContractError, check_count, check_flag
from sb3_ars.machine import available_memory

__all__ = ["TaskReplayBuffer"]

_COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones")
_REBUILT = (  # attributes made anew from the rest when a pickle is loaded
    *_COLUMNS,
    *(
        "task_pos",
        "task_size",
        "task_total",
        "history",
        "_layout",
        "_row_width",
        "_generator",
        "_sizes",
        "_first_slots",
        "_one_hots",
    ),
    *("_storage", "_frames", "_flat", "_pointers", "_flat_observations", "_staging"),
)
_MAGIC = b"\xa5sb3_ars task buffer 1\n"  # its first byte is no pickle's
_PICKLE = b"\x80"  # a pickle's first byte
_MAX_HEADER = 2**20  # bytes of a file's header, which has a few thousand beside the names of the tasks
_CHUNK_BYTES = 2**24  # what passes through host memory at once when a buffer on a GPU is saved or loaded
_SLOTS_PER_FRAME = 256  # a table that starts this large holds the ends of episodes at least this long


class TaskReplayBuffer(ReplayBuffer):
    """One ring of raw transitions per task; a batch holds equally many rows of each.

    The rings are one tensor ``(n_tasks, buffer_size, row_width)``, float32, on ``device``, of which ``observations``,
    ``next_observations``, ``actions``, ``rewards`` and ``dones`` are views. The one-hot task id at the end of each
    observation is not stored but put back when sampling. Memory is taken at the first :meth:`add`, so a model
    loaded for prediction alone costs nothing.

    :param buffer_size: transitions *per task*
    :param observation_space: flat ``Box`` whose last ``n_tasks`` entries are the one-hot task id
    :param action_space: flat ``Box``
    :param device: where the tensors live
    :param n_envs: number of environments
    :param optimize_memory_usage: whether each frame is stored once, which nearly halves the memory; batches are the
        same to the bit, terminal observations included. There is then no ``next_observations``.
    :param handle_timeout_termination: whether an episode cut by its time limit is stored as not terminated
    :param task_of_env: the task of each environment, ``(n_envs,)``
    :param task_names: the tasks, in order
    :param seed: seed of the buffer's own generator; ``None`` draws one
    :param verbose: 1 prints the size before allocating
    :raises ConfigError: on spaces it cannot store

    ``storage_version`` rises whenever a tensor that sampling reads moves to another address, or when the rings get
    another size; a CUDA graph captured before that is void.

    Source: paper, section 2.2 and Algorithm 1.
    """

    _storage: th.Tensor | None = None  # (n_tasks, buffer_size, row_width), once there is a transition
    _frames: _FrameTable | None = None  # with optimize_memory_usage

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
        _check_spaces(observation_space, action_space, len(task_names))
        # ReplayBuffer.__init__ would allocate NumPy arrays at once (SB3 2.9.2, common/buffers.py)
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.optimize_memory_usage = check_flag("optimize_memory_usage", optimize_memory_usage)
        self.handle_timeout_termination = handle_timeout_termination
        self.task_names = task_names
        self.n_tasks = len(task_names)
        self.verbose = verbose
        self.seed = int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] >> 1)
        self.storage_version = 0
        if len(task_of_env) != n_envs:
            raise ConfigError(f"task_of_env={task_of_env} must name the task of each of the {n_envs} envs.")
        self.set_task_of_env(task_of_env)
        self._start_empty()

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
        """Store one transition of every environment in its task's ring, but for tasks that are not active.

        An environment whose info has ``worker_restarted`` is left out as well: what its action led to is unknown.

        On a GPU this is one asynchronous transfer and waits for nothing.

        :param obs: ``(n_envs, obs_dim)``, one-hot included
        :param next_obs: the same, the terminal observation where an episode ended
        :param action: ``(n_envs, action_dim)``, in [-1, 1]
        :param reward: ``(n_envs,)``, raw
        :param done: ``(n_envs,)``
        :param infos: ``TimeLimit.truncated`` is read from them
        :raises EnvContractError: if a value is NaN or infinite, or a terminal observation is missing
        """
        self._allocate()
        unknown = [env for env in np.flatnonzero(done) if infos[env].get("worker_restarted")]
        if not unknown:
            self._add_rows(obs, next_obs, action, reward, done, infos)
            return
        chosen = self._env_of_row
        self._choose_rows(np.setdiff1d(chosen, unknown))
        if len(self._env_of_row):
            self._add_rows(obs, next_obs, action, reward, done, infos)
        self._choose_rows(chosen)

    def _add_rows(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        host, rows = self._staging.begin(), self._rows
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinity, which is refused below
            host["observations"][:] = np.asarray(obs)[rows, : self.obs_dim]
            host["next_observations"][:] = np.asarray(next_obs)[rows, : self.obs_dim]
            host["actions"][:] = np.asarray(action).reshape(self.n_envs, self.action_dim)[rows]
            host["rewards"][:] = np.asarray(reward).reshape(self.n_envs, 1)[rows]
            host["dones"][:] = np.asarray(done).reshape(self.n_envs, 1)[rows]
        for row in map(int, np.flatnonzero(np.asarray(done)[rows])):
            info = infos[self._env_of_row[row]]
            if info.get("terminal_observation") is None:
                raise EnvContractError(
                    f"Task {self._name_of_row(row)!r} ended an episode without infos['terminal_observation']: the next "
                    "episode's first observation would be learned as its outcome. Use an SB3 VecEnv, which sets it."
                )
            if self.handle_timeout_termination and info.get("TimeLimit.truncated", False):
                host["dones"][row] = 0.0
        self._check_finite(host)
        slots = (self.task_pos[self._task_of_row] + self._rank_in_task) % self.buffer_size
        host["slots"][:] = slots + self._task_of_row * self.buffer_size
        self.task_pos[:] = (self.task_pos + self._rows_of_task) % self.buffer_size
        self.task_size[:] = np.minimum(self.task_size + self._rows_of_task, self.buffer_size)
        self.task_total += self._rows_of_task
        self._count_as_sb3()
        host["sizes"][:, 0] = self.task_size
        has_previous = self._frames is not None and self._link_frames(self._frames, host)
        sent = self._staging.send()
        if has_previous:  # before the rows, which may overwrite these slots
            self._pointers.index_copy_(0, sent["previous_slots"], sent["previous_pointers"])
        self._flat.index_copy_(0, sent["slots"], sent["rows"])
        if self._frames is not None:
            self._frames.table.index_copy_(0, sent["frame_rows"], sent["next_observations"])
        self._write_sizes(sent["sizes"])

    def reset(self) -> None:
        """Forget every transition; the memory stays allocated."""
        super().reset()
        self.task_pos[:] = 0
        self.task_size[:] = 0
        self._begin_history(self.task_size)
        self._write_sizes(th.from_numpy(self.task_size).unsqueeze(1))
        if self._frames is not None:
            self._frames.clear()

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
        self.check_filled(batch_size)
        return self.gather(self.draw_slots(batch_size), env)

    def check_filled(self, batch_size: int) -> None:
        """Raise unless every task holds a batch; reads the host's counters alone.

        :param batch_size: rows *per task*
        :raises ConfigError: if a task holds fewer rows than asked for
        """
        if self.task_size.min() >= batch_size:
            return
        short = np.flatnonzero(self.task_size < batch_size)
        held = ", ".join(f"{self.task_names[task]} ({self.task_size[task]})" for task in short)
        raise ConfigError(
            f"batch_size={batch_size} rows per task, but these tasks hold fewer: {held}. "
            "Collect longer before the first update (learning_starts) or use a smaller batch_size."
        )

    def draw_slots(self, batch_size: int) -> th.Tensor:
        """Return written slots, ``(n_tasks, batch_size)`` int64 on the buffer's device.

        Reads nothing but device tensors, as :meth:`gather` does, so that a CUDA graph can hold both; register
        :attr:`generator` with it. Addresses change with :attr:`storage_version` alone.
        """
        # float64: with float32's 24 bits, slots of a large ring would not be equally likely
        uniform = th.rand(
            (self.n_tasks, batch_size), generator=self._generator, device=self._device, dtype=th.float64
        )
        return (uniform * self._sizes).long()

    def gather(self, slots: th.Tensor, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Return the transitions in the given slots as flat task-major rows.

        :param slots: ``(n_tasks, batch)`` int64
        :param env: normalises observations
        """
        rows = self._flat.index_select(0, (slots + self._first_slots).reshape(-1))
        column = {name: rows[:, where] for name, where in self._layout.items()}
        if self._frames is not None:
            pointers = rows.view(th.int32)[:, -1]
            column["next_observations"] = self._next_frames(self._frames, slots, self._first_slots, pointers)
        one_hot = self._one_hot(slots.shape[1])

        def observations(name: str) -> th.Tensor:
            obs = th.cat((column[name], one_hot), dim=1)
            if env is None:
                return obs
            normalized = env.normalize_obs(obs.cpu().numpy())
            return th.as_tensor(normalized, dtype=th.float32, device=self._device)

        return ReplayBufferSamples(
            observations=observations("observations"),
            actions=column["actions"],
            next_observations=observations("next_observations"),
            dones=column["dones"],
            rewards=column["rewards"],
        )

    def reward_statistics(self) -> RewardStatistics:
        """Return mean and standard deviation of each task's raw rewards, over everything its ring holds.

        :raises ConfigError: if a task holds no reward yet

        Source: paper, section 4.1, the mean of Eq. 6.
        """
        empty = [self.task_names[task] for task in np.flatnonzero(self.task_size == 0)]
        if empty:
            raise ConfigError(f"No transition stored yet for {', '.join(empty)}: its mean reward is unknown.")
        column: Any = self.rewards  # SB3 annotates these attributes as NumPy arrays
        rewards = [column[task, : self.task_size[task]].double() for task in range(self.n_tasks)]
        return RewardStatistics(
            mean=th.stack([r.mean() for r in rewards]),
            std=th.stack([r.std(correction=0) for r in rewards]),
            task_names=self.task_names,
        )

    @property
    def generator(self) -> th.Generator:
        """What :meth:`draw_slots` draws from."""
        return self._generator

    # ------------------------------------------------------------------ memory and device

    def memory_bytes(self) -> int:
        """Return how many bytes of the device the rings take, or will take once allocated."""
        n_frames = 0
        if self.optimize_memory_usage:
            n_frames = self._first_n_frames() if self._frames is None else len(self._frames.table)
        return 4 * (self.n_tasks * self.buffer_size * self._row_width + n_frames * self.obs_dim)

    def check_memory(self) -> None:
        """Raise unless the rings fit in what the device has free.

        :raises ConfigError: naming the largest ``buffer_size`` that fits
        """
        if self._storage is not None:
            return
        if th.device(self.device).type == "cuda":
            available, _ = th.cuda.mem_get_info(self.device)
        else:
            available = available_memory()
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
        moved_from = getattr(self, "_device", None)
        self._device = get_device(device)
        if moved_from is None or moved_from == self._device:
            return
        if moved_from.type != self._device.type:
            self._generator = self._make_generator()
        self._place_counters()
        if self._storage is not None:
            frames = None if self._frames is None else self._frames.to(self._device)
            self._use_storage(self._storage.to(self._device), frames)

    def set_task_of_env(self, task_of_env: Sequence[int]) -> None:
        """Accept transitions of another number or order of environments from now on; what is stored stays.

        All tasks are active then.

        :param task_of_env: ``(n_envs,)``
        :raises ConfigError: if a task has no environment, or more than its ring has slots
        """
        task_of_env = [int(task) for task in task_of_env]
        _check_task_of_env(task_of_env, self.n_tasks, self.buffer_size)
        self.n_envs = len(task_of_env)
        self.task_of_env = np.asarray(task_of_env, dtype=np.int64)
        self.set_active_tasks(None)

    def set_active_tasks(self, tasks: Sequence[int] | None) -> None:
        """Let :meth:`add` store transitions of these tasks alone from now on; what is stored stays.

        :param tasks: indices; None is all
        :raises ConfigError: if there is none among them, or an unknown one
        """
        active = set(range(self.n_tasks) if tasks is None else tasks)
        if not active or not active <= set(range(self.n_tasks)):
            raise ConfigError(
                f"tasks={tasks} must be None or some of the task indices 0 to {self.n_tasks - 1}."
            )
        self._choose_rows(np.flatnonzero(np.isin(self.task_of_env, list(active))))

    def _choose_rows(self, envs: np.ndarray) -> None:
        """Let the transitions of these environments be stored, and no others.

        :param envs: indices, ascending
        """
        self._env_of_row = envs
        # a slice where it can be: then no step copies its arrays once more
        self._rows = slice(None) if len(envs) == self.n_envs else envs
        self._task_of_row = self.task_of_env[self._rows]
        self._rows_of_task = np.bincount(self._task_of_row, minlength=self.n_tasks)
        of_row = self._task_of_row.tolist()
        self._rank_in_task = np.array([of_row[:row].count(task) for row, task in enumerate(of_row)], np.int64)
        if self._storage is not None:
            self._staging = self._make_staging()
        if self._frames is not None:
            self._frames.forget_envs()

    # ------------------------------------------------------------------ files and pickles

    def write_to(self, file: Any) -> None:
        """Write what is stored, and the generator's state, straight from memory.

        :param file: open for writing bytes
        """
        header = self._header()
        encoded = json.dumps(dataclasses.asdict(header)).encode()
        file.write(_MAGIC + len(encoded).to_bytes(8, "little") + encoded)
        for part in self._parts(header.n_frames):
            for chunk in _chunks(part):
                file.write(chunk.cpu().numpy().data.cast("B"))

    def read_from(self, file: Any) -> None:
        """Replace what is stored by what :meth:`write_to` wrote, read straight into place.

        Takes over ``buffer_size``, ``handle_timeout_termination``, seed and generator as well; the environments
        stay this buffer's. A buffer of the same size stays where it is in memory.

        :param file: open for reading bytes
        :raises ConfigError: if the file is no such buffer, was cut off or damaged, or holds other tasks or shapes; this
            buffer is then as it was. If reading fails half-way or meets NaN or infinity, it is empty.
        """
        source = getattr(file, "name", "the given file")
        header = _read_header(file, source)
        self._check_header(header, source)
        self._check_length(file, header, source)
        try:
            self._adopt(header)
            for part in self._parts(header.n_frames):
                for chunk in _chunks(part):
                    host = chunk if chunk.device.type == "cpu" else th.empty_like(chunk, device="cpu")
                    _read_exactly(file, host.numpy().data.cast("B"), source)
                    if part.shape[1] == self._row_width:  # of frames, unused ones may be anything
                        _check_numbers(host[:, : self._row_width - self.optimize_memory_usage], source)
                    chunk.copy_(host)
            self._restore_frames(header, source)
        except BaseException as error:
            self.reset()
            if isinstance(error, MemoryError | RuntimeError):  # torch has one of the latter where memory ends
                raise ConfigError(
                    f"The replay buffer in {source} cannot be held ({error}); this one is now empty."
                ) from error
            raise

    # ------------------------------------------------------------------ checkpoints

    def checkpoint_state(self) -> dict[str, Any]:
        """Return what a checkpoint keeps beside the rows, as plain values and tensors."""
        return {
            "history": self.history,
            "task_total": self.task_total.tolist(),
            "buffer_size": int(self.buffer_size),
            "seed": self.seed,
            "generator_device": self._device.type,
            "generator_state": self._generator.get_state(),
        }

    def oldest(self) -> list[int]:
        """Return the number of each task's oldest stored transition, counted over all it ever had."""
        ages: list[int] = (self.task_total - self.task_size).tolist()
        return ages

    def write_rows(self, file: Any, first: Sequence[int]) -> None:
        """Write the newest transitions of every task, from the ``first``-th it ever had on; task by task.

        The form is the same whatever the layout in memory: float32, ``(obs, next_obs, action, reward, done)``.

        :param file: open for writing bytes
        :param first: one number per task, at least those of :meth:`oldest`
        """
        for task, (start, stop) in enumerate(zip(first, self.task_total.tolist(), strict=True)):
            for slots in self._runs_of_slots(start, stop):
                file.write(self._plain_rows(task, slots).cpu().numpy().data.cast("B"))

    def restore_checkpoint_state(
        self,
        state: Mapping[str, Any],
        parts: Iterable[tuple[Any, Sequence[int], Sequence[int]]],
        keep_size: bool = False,
    ) -> None:
        """Replace what is stored by what a checkpoint kept: the same transitions in the same slots.

        :param state: of :meth:`checkpoint_state`
        :param parts: files of :meth:`write_rows`, oldest first, open for reading bytes, each with the number of every
            task's first transition in it and the one behind its last
        :param keep_size: whether this buffer's size stays, with the newest transitions that it has room for
        :raises ConfigError: if a file ends too early, or the parts leave a gap, or this buffer is to stay larger than
            the other was; it is then empty
        """
        check_count("buffer_size", state["buffer_size"])
        self._check_counts(state["task_total"])
        self.reset()
        if keep_size and self.buffer_size > state["buffer_size"]:
            raise ConfigError(
                f"buffer_size={self.buffer_size:_} is more than the run's {state['buffer_size']:_}; resume with that "
                "or less."
            )
        if not keep_size and state["buffer_size"] != self.buffer_size:
            self._release_storage()
            self.buffer_size = state["buffer_size"]
            self._place_counters()
        total = np.asarray(state["task_total"], dtype=np.int64)
        self.task_size[:], self.task_pos[:] = np.minimum(total, self.buffer_size), total % self.buffer_size
        self.task_total, self.history = total, state["history"]
        if total.any():
            self.check_memory()
            self._allocate()
        try:
            self._read_parts(parts)
        except BaseException:
            self.reset()
            raise
        self._count_as_sb3()
        self._write_sizes(th.from_numpy(self.task_size).unsqueeze(1))
        self.seed = state["seed"]
        self._generator.manual_seed(self.seed)
        if state["generator_device"] == self._device.type:
            self._generator.set_state(state["generator_state"])

    def _read_parts(self, parts: Iterable[tuple[Any, Sequence[int], Sequence[int]]]) -> None:
        expected = np.asarray(self.oldest())
        width = 4 * self._plain_width
        linkers = [
            _Linker(self._frames, task, self.buffer_size, int(n_envs))
            for task, n_envs in enumerate(np.bincount(self.task_of_env, minlength=self.n_tasks))
            if self._frames is not None
        ]
        for file, first, stop in parts:
            for numbers in (first, stop):
                self._check_counts(numbers)
            source = getattr(file, "name", "the given file")
            for task, (start, end) in enumerate(zip(first, stop, strict=True)):
                wanted = min(max(start, int(expected[task])), end)
                file.seek((wanted - start) * width, io.SEEK_CUR)
                if wanted > expected[task] and wanted < end:
                    raise ConfigError(
                        f"{source} leaves a gap: rows of task {self.task_names[task]!r} are missing."
                    )
                for slots in self._runs_of_slots(wanted, end):
                    rows = np.empty((slots.stop - slots.start, self._plain_width), np.float32)
                    _read_exactly(file, rows.data.cast("B"), source)
                    self._put_rows(task, slots, th.from_numpy(rows), linkers)
                expected[task] = max(expected[task], end)
        for linker in linkers:
            linker.finish(self._pointers)
        missing = [self.task_names[task] for task in np.flatnonzero(expected != self.task_total)]
        if missing:
            raise ConfigError(f"The checkpoint lacks the newest transitions of {', '.join(missing)}.")

    def _check_counts(self, numbers: Sequence[int]) -> None:
        if len(numbers) != self.n_tasks:
            raise ConfigError(
                f"The checkpoint counts transitions of {len(numbers)} tasks, not of {self.n_tasks}."
            )
        for number in numbers:
            check_count("number of a transition", number, minimum=0)

    def _put_rows(self, task: int, slots: slice, rows: th.Tensor, linkers: Sequence[_Linker]) -> None:
        """Store transitions in the plain form in consecutive slots."""
        assert self._storage is not None
        if not linkers:
            self._storage[task, slots].copy_(rows)
            return
        obs, next_obs, rest = th.split(rows, [self.obs_dim, self.obs_dim, self.action_dim + 2], dim=1)
        self._storage[task, slots, :-1] = th.cat((obs, rest), dim=1).to(self._device)
        linkers[task].link(self._pointers, slots, obs.numpy(), next_obs.numpy())
        self.storage_version += 1  # the table of frames may have grown

    def _plain_rows(self, task: int, slots: slice) -> th.Tensor:
        """Return the transitions in consecutive slots in the plain form, ``(n, width)`` float32, contiguous."""
        assert self._storage is not None
        rows = self._storage[task, slots]
        if self._frames is None:
            return rows
        numbers = th.arange(slots.start, slots.stop, device=self._device)
        first_slots = self._first_slots[task]
        next_obs = self._next_frames(self._frames, numbers, first_slots, rows.view(th.int32)[:, -1])
        return th.cat((rows[:, : self.obs_dim], next_obs, rows[:, self.obs_dim : -1]), dim=1)

    @property
    def _plain_width(self) -> int:
        return 2 * self.obs_dim + self.action_dim + 2

    def _runs_of_slots(self, start: int, stop: int) -> Iterator[slice]:
        """Yield where the transitions from one number to another lie, in runs that are not too long for a copy."""
        longest = max(1, _CHUNK_BYTES // (4 * self._plain_width))
        while start < stop:
            slot = start % self.buffer_size
            n = min(stop - start, self.buffer_size - slot, longest)
            yield slice(slot, slot + n)
            start += n

    def _begin_history(self, task_size: np.ndarray) -> None:
        """Count transitions anew: what is stored is not what an earlier checkpoint has rows of."""
        # as if nothing had been stored before the oldest but what brings ``task_pos`` where it is
        self.task_total = np.where(task_size < self.buffer_size, task_size, self.buffer_size + self.task_pos)
        self.history = secrets.token_hex(6)

    # ------------------------------------------------------------------ pickles

    def __getstate__(self) -> dict[str, Any]:
        """Return everything but unwritten slots; tensors as NumPy arrays, which pickle without a second copy."""
        header = self._header()
        state = {name: value for name, value in self.__dict__.items() if name not in _REBUILT}
        state["_device"] = str(self._device)
        return state | {"_stored": (header, [part.cpu().numpy() for part in self._parts(header.n_frames)])}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore; a device that this machine lacks becomes the CPU."""
        if "_stored" not in state:
            raise ConfigError(
                "This pickled TaskReplayBuffer is of an earlier version, whose layout is no longer read. Load it with "
                "that version, or collect anew."
            )
        header, parts = state.pop("_stored")
        device = th.device(state.pop("_device"))
        self.__dict__.update(state)
        self._device = device if device.type != "cuda" or th.cuda.is_available() else th.device("cpu")
        self._start_empty()
        self._adopt(header)
        for part, values in zip(self._parts(header.n_frames), parts, strict=True):
            part.copy_(th.from_numpy(values))
        self._restore_frames(header, "the pickle")

    def _header(self) -> _Header:
        return _Header(
            task_names=list(self.task_names),
            observation_shape=list(self.observation_space.shape or ()),
            action_shape=list(self.action_space.shape or ()),
            optimize_memory_usage=self.optimize_memory_usage,
            handle_timeout_termination=bool(self.handle_timeout_termination),
            buffer_size=int(self.buffer_size),
            task_size=self.task_size.tolist(),
            task_pos=self.task_pos.tolist(),
            n_frames=0 if self._frames is None else self._frames.n_used(),
            seed=self.seed,
            generator_device=self._device.type,
            generator_state=base64.b64encode(self._generator.get_state().numpy().tobytes()).decode(),
        )

    def _parts(self, n_frames: int) -> Iterator[th.Tensor]:
        """Yield what a file holds after its header: contiguous ``(rows, width)`` each, none without rows."""
        if self._storage is not None:
            for task in np.flatnonzero(self.task_size):
                yield self._storage[task, : self.task_size[task]]
        if self._frames is not None and n_frames:
            yield self._frames.table[:n_frames]

    def _check_header(self, header: _Header, source: str) -> None:
        """Raise unless what follows the header can be stored here."""
        if header.task_names != list(self.task_names):
            raise ConfigError(
                f"The replay buffer in {source} holds the tasks {header.task_names}, this model has "
                f"{list(self.task_names)}."
            )
        shapes = (tuple(header.observation_shape), tuple(header.action_shape))
        if shapes != (self.observation_space.shape, self.action_space.shape):
            raise ConfigError(
                f"The replay buffer in {source} holds observations and actions of shapes {shapes}, this model has "
                f"{self.observation_space.shape} and {self.action_space.shape}."
            )
        if header.optimize_memory_usage != self.optimize_memory_usage:
            raise ConfigError(
                f"The replay buffer in {source} was saved with optimize_memory_usage={header.optimize_memory_usage}, "
                f"this model has {self.optimize_memory_usage}, and the two lay out memory differently. Make or load "
                f"the model with optimize_memory_usage={header.optimize_memory_usage}."
            )
        _check_task_of_env(self.task_of_env.tolist(), self.n_tasks, header.buffer_size)
        total, needed = self._total_memory(), 4 * self.n_tasks * header.buffer_size * self._row_width
        if needed > total:
            raise ConfigError(
                f"The replay buffer in {source} has buffer_size={header.buffer_size:_}, which takes "
                f"{needed / 1e9:.2f} GB, but the device has {total / 1e9:.2f} GB."
            )
        if header.generator_device == self._device.type:
            try:
                self._make_generator().set_state(header.random_state())
            except (ValueError, TypeError, RuntimeError) as error:
                raise ConfigError(
                    f"{source} is damaged: generator_state is none of a generator ({error}). Use another save."
                ) from error

    def _total_memory(self) -> int:
        if self._device.type == "cuda":
            return int(th.cuda.mem_get_info(self._device)[1])
        return int(psutil.virtual_memory().total)

    def _check_length(self, file: Any, header: _Header, source: str) -> None:
        """Raise if a file is shorter than its header says, before anything here is overwritten."""
        if not file.seekable():
            return
        start, end = file.tell(), file.seek(0, io.SEEK_END)
        file.seek(start)
        missing = 4 * (sum(header.task_size) * self._row_width + header.n_frames * self.obs_dim) - (
            end - start
        )
        if missing > 0:
            raise ConfigError(
                f"{source} was cut off: {missing:,} bytes are missing at its end. Use another save."
            )

    def _adopt(self, header: _Header) -> None:
        """Take over what a header says, and make room for what follows it."""
        self.reset()
        if header.buffer_size != self.buffer_size:
            self._release_storage()  # first, so that old and new never stand side by side
            self.buffer_size = header.buffer_size
            self._place_counters()
        self.handle_timeout_termination = header.handle_timeout_termination
        self.task_size[:], self.task_pos[:] = header.task_size, header.task_pos
        self._begin_history(self.task_size)
        self._count_as_sb3()
        self._write_sizes(th.from_numpy(self.task_size).unsqueeze(1))
        self.seed = header.seed
        self._generator.manual_seed(self.seed)
        if header.generator_device == self._device.type:
            self._generator.set_state(header.random_state())
        if self.task_size.any():
            self._allocate()
        if self._frames is not None and self._frames.reserve(header.n_frames):
            self.storage_version += 1

    def _restore_frames(self, header: _Header, source: str) -> None:
        """Note which slots own a row of the frame table, as their pointers say."""
        if self._frames is None:
            return
        rings = (
            self._pointers[task * self.buffer_size :][:size].cpu().numpy()
            for task, size in enumerate(header.task_size)
        )
        if not self._frames.restore(rings, self.buffer_size, header.n_frames):
            raise ConfigError(f"{source} is damaged: a frame it points to is not there. Use another save.")
        _check_numbers(self._frames.table[self._frames.kept_rows()], source)

    # ------------------------------------------------------------------ private: memory

    def _start_empty(self) -> None:
        self.task_pos = np.zeros(self.n_tasks, dtype=np.int64)
        self.task_size = np.zeros(self.n_tasks, dtype=np.int64)
        self._begin_history(self.task_size)
        self._layout, self._row_width = self._lay_out()
        self._generator = self._make_generator()
        self._place_counters()

    def _lay_out(self) -> tuple[dict[str, slice], int]:
        """Return where each column is in a row, and the row's width; a pointer to the next frame comes last."""
        widths = dict(zip(_COLUMNS, (self.obs_dim, self.obs_dim, self.action_dim, 1, 1), strict=True))
        if self.optimize_memory_usage:
            del widths["next_observations"]
        ends = np.cumsum([0, *widths.values()]).tolist()
        layout = {name: slice(*ends[i : i + 2]) for i, name in enumerate(widths)}
        return layout, ends[-1] + int(self.optimize_memory_usage)

    def _place_counters(self) -> None:
        """Put on the device what sampling reads beside the rings."""
        sizes = th.from_numpy(self.task_size).unsqueeze(1)
        self._sizes = sizes.to(self._device)  # on the CPU this is task_size's own memory
        self._first_slots = (th.arange(self.n_tasks, device=self._device) * self.buffer_size).unsqueeze(1)
        self._one_hots: dict[int, th.Tensor] = {}
        self.storage_version += 1

    def _write_sizes(self, sizes: th.Tensor) -> None:
        if self._device.type != "cpu":
            self._sizes.copy_(sizes)

    def _allocate(self) -> None:
        if self._storage is not None:
            return
        if self.verbose >= 1:
            print(f"Replay buffer: {self._describe_size()} on {self._device}")
        frames = None
        if self.optimize_memory_usage:
            frames = _FrameTable(self._first_n_frames(), self.obs_dim, self._device)
        # empty, not zeros: memory is then taken as slots are written, and unwritten slots are never sampled
        shape = (self.n_tasks, self.buffer_size, self._row_width)
        self._use_storage(th.empty(shape, device=self._device), frames)

    def _use_storage(self, storage: th.Tensor, frames: _FrameTable | None) -> None:
        self._storage, self._frames = storage, frames
        self._flat = storage.view(-1, self._row_width)
        # the last column's bits are an int32; as floats some are NaN, so nothing may calculate with them
        self._pointers = self._flat.view(th.int32)[:, -1]
        self._flat_observations = self._flat[:, self._layout["observations"]]
        for name, where in self._layout.items():
            setattr(self, name, storage[..., where])
        self._staging = self._make_staging()
        self.storage_version += 1

    def _release_storage(self) -> None:
        for name in (*_COLUMNS, "_storage", "_frames", "_flat", "_pointers", "_flat_observations"):
            self.__dict__.pop(name, None)

    def _make_staging(self) -> _Staging:
        n, integer, real = len(self._env_of_row), th.int64, th.float32
        fields = {"slots": ((n,), integer), "sizes": ((self.n_tasks, 1), integer)}
        if self.optimize_memory_usage:
            fields |= {"previous_slots": ((n,), integer), "frame_rows": ((n,), integer)}
            fields |= {"next_observations": ((n, self.obs_dim), real), "previous_pointers": ((n,), th.int32)}
        return _Staging(fields | {"rows": ((n, self._row_width), real)}, self._layout, self._device)

    def _make_generator(self) -> th.Generator:
        return th.Generator(device=self._device).manual_seed(self.seed)

    def _first_n_frames(self) -> int:
        return max(2 * self.n_envs, self.n_tasks * self.buffer_size // _SLOTS_PER_FRAME)

    # ------------------------------------------------------------------ private: the rest

    def _link_frames(self, frames: _FrameTable, host: dict[str, np.ndarray]) -> bool:
        """Say where the next frames of this step's and the previous step's transitions are; was there a previous?"""
        has_previous, has_grown = frames.link(host, self.buffer_size)
        self.storage_version += has_grown
        return has_previous

    def _next_frames(
        self, frames: _FrameTable, slots: th.Tensor, first_slots: th.Tensor, pointers: th.Tensor
    ) -> th.Tensor:
        """Return next observations, one per pointer: rows of the table, or later slots' observations."""
        ahead = pointers.clamp(max=0).view_as(slots)
        later = ((slots - ahead) % self.buffer_size + first_slots).reshape(-1)
        return th.where(
            (pointers >= 0).unsqueeze(1),
            frames.table.index_select(0, pointers.clamp(min=0)),
            self._flat_observations.index_select(0, later),
        )

    def _one_hot(self, batch_size: int) -> th.Tensor:
        """Return the task ids of a batch; each size is made once and kept, since graphs hold its address."""
        if batch_size not in self._one_hots:
            one_hot = th.eye(self.n_tasks, device=self._device)
            self._one_hots[batch_size] = one_hot.repeat_interleave(batch_size, dim=0)
        return self._one_hots[batch_size]

    def _count_as_sb3(self) -> None:
        # With optimize_memory_usage SB3 2.9.2 (off_policy_algorithm.py, _setup_learn) marks dones[pos] of a buffer that
        # is not empty, as its own loses the newest frame when an env is reset. Ours does not, so it passes as empty.
        if not self.optimize_memory_usage:
            self.pos, self.full = int(self.task_pos.max()), bool(self.task_size.min() == self.buffer_size)

    def _check_finite(self, host: dict[str, np.ndarray]) -> None:
        if np.isfinite(host["rows"]).all() and np.isfinite(host["next_observations"]).all():
            return
        for name in _COLUMNS:
            for row in map(int, np.flatnonzero(~np.isfinite(host[name]).all(axis=1))):
                raise EnvContractError(
                    f"Task {self._name_of_row(row)!r} gave NaN or infinity in {name.replace('_', ' ')}: "
                    f"{host[name][row]}. It was not stored; what was learned so far is intact."
                )

    def _name_of_row(self, row: int) -> str:
        return str(self.task_names[self._task_of_row[row]])

    def _describe_size(self) -> str:
        return f"{self.n_tasks} tasks x {self.buffer_size:,} transitions, {self.memory_bytes() / 1e9:.2f} GB,"

    @property
    def obs_dim(self) -> int:
        """Width of a stored observation, the one-hot left out."""
        return int(self.obs_shape[0]) - self.n_tasks


class _Staging:
    """Host memory through which one step's values reach the device, in one transfer that nobody waits for.

    On a GPU it is pinned, and there are two by turns: the copy of one step may still be under way when the next is
    written. On the CPU nothing is copied.

    :param fields: shape and dtype of each value, the widest dtypes first, so that all are aligned
    :param columns: names for parts of the field ``rows``
    :param device: where the values go
    """

    def __init__(
        self,
        fields: dict[str, tuple[tuple[int, ...], th.dtype]],
        columns: dict[str, slice],
        device: th.device,
    ) -> None:
        self._fields, self._device = fields, device
        self._is_cuda = device.type == "cuda"
        n_bytes = sum(int(np.prod(shape)) * dtype.itemsize for shape, dtype in fields.values())
        self._memory = [
            th.zeros(n_bytes, dtype=th.uint8, pin_memory=self._is_cuda)
            for _ in range(2 if self._is_cuda else 1)
        ]
        self._views = [self._split(memory) for memory in self._memory]
        self._host = [{name: view.numpy() for name, view in views.items()} for views in self._views]
        for host in self._host:
            host |= {name: host["rows"][:, where] for name, where in columns.items()}
        self._copied = [
            th.cuda.Event() if self._is_cuda else None  # type: ignore[no-untyped-call]  # torch's
            for _ in self._memory
        ]
        self._turn = 0

    def begin(self) -> dict[str, np.ndarray]:
        """Return the arrays to fill for this step."""
        self._turn = (self._turn + 1) % len(self._memory)
        copied = self._copied[self._turn]
        if copied is not None:
            copied.synchronize()  # of the step before last: long since done, unless the GPU is far behind
        return self._host[self._turn]

    def send(self) -> dict[str, th.Tensor]:
        """Return the fields as tensors on the device."""
        copied = self._copied[self._turn]
        if copied is None:
            return self._views[self._turn]
        sent = self._memory[self._turn].to(self._device, non_blocking=True)
        copied.record(th.cuda.current_stream(self._device))
        return self._split(sent)

    def _split(self, memory: th.Tensor) -> dict[str, th.Tensor]:
        views, start = {}, 0
        for name, (shape, dtype) in self._fields.items():
            end = start + int(np.prod(shape)) * dtype.itemsize
            views[name] = memory[start:end].view(dtype).view(shape)
            start = end
        return views


class _FrameTable:
    """Next observations that no slot holds as its observation, and who owns them.

    Each transition has a pointer. From 0 on, it is the row of this table that holds its next observation: so it is for
    the newest transition of every env, and for an episode's last. Below 0, its next observation is the observation that
    many slots later in the ring. That is said only when the later slot is written with the same bits, whatever ``done``
    says, so nothing depends on how episodes end, or on who resets or exchanges environments.

    :param n_rows: rows at first; the table doubles when it is full
    :param obs_dim: width of a frame
    :param device: where the table lives
    """

    def __init__(self, n_rows: int, obs_dim: int, device: th.device) -> None:
        self.table = th.empty((n_rows, obs_dim), device=device)
        self.clear()

    def clear(self) -> None:
        """Forget every frame."""
        self._free = list(
            reversed(range(len(self.table)))
        )  # low rows first, so that a file holds few unused ones
        self._row_of_slot: dict[
            int, int
        ] = {}  # of transitions that keep their row until they are overwritten
        self._slot_of_env: np.ndarray | None = (
            None  # each env's newest transition, its row and its next observation
        )
        self._row_of_env = np.empty(0, dtype=np.int64)
        self._frame_of_env = np.empty(0, dtype=np.float32)

    def link(self, host: dict[str, np.ndarray], buffer_size: int) -> tuple[bool, bool]:
        """Point the newest transition of each env at a row, and the one before it at where its next observation now is.

        :param host: the staged step; filled in are ``previous_slots``, ``previous_pointers``, ``frame_rows`` and the
            pointers of ``rows``
        :param buffer_size: slots of a ring
        :return: whether there was a step before this one, and whether the table has grown
        """
        slots, previous = host["slots"], self._slot_of_env
        follows = np.zeros(len(slots), dtype=bool)
        if previous is None:
            self._row_of_env = np.empty(len(slots), dtype=np.int64)
        else:
            # bits, not values: what is read back must be what was given
            frames, seen = self._frame_of_env.view(np.int32), host["observations"].view(np.int32)
            follows = (frames == seen).all(axis=1)
            host["previous_slots"][:] = previous
            host["previous_pointers"][:] = np.where(
                follows, -((slots - previous) % buffer_size), self._row_of_env
            )
            self._keep_rows(~follows)
        for slot in slots.tolist():
            if (row := self._row_of_slot.pop(slot, None)) is not None:
                self._free.append(row)
        fresh = np.flatnonzero(~follows)
        has_grown = self.reserve(len(self.table) - len(self._free) + len(fresh))
        for env in fresh:
            self._row_of_env[env] = self._free.pop()
        host["rows"].view(np.int32)[:, -1] = host["frame_rows"][:] = self._row_of_env
        self._slot_of_env, self._frame_of_env = slots.copy(), host["next_observations"].copy()
        return previous is not None, has_grown

    def forget_envs(self) -> None:
        """Let the newest transitions keep their rows: what is stored next follows nothing."""
        if self._slot_of_env is not None:
            self._keep_rows(np.ones(len(self._slot_of_env), dtype=bool))
        self._slot_of_env = None

    def reserve(self, n_rows: int) -> bool:
        """Double the table until it has so many rows; return whether it had to grow.

        :param n_rows: rows wanted in all
        """
        held = len(self.table)
        if n_rows <= held:
            return False
        capacity = held
        while capacity < n_rows:
            capacity *= 2
        grown = self.table.new_empty((capacity, self.table.shape[1]))
        grown[:held] = self.table
        self.table = grown
        self._free[:0] = reversed(range(held, capacity))
        return True

    def n_used(self) -> int:
        """Return how many rows, from the first on, hold all frames."""
        rows = [
            *self._row_of_slot.values(),
            *([] if self._slot_of_env is None else self._row_of_env.tolist()),
        ]
        return max(rows, default=-1) + 1

    def restore(self, rings: Iterable[np.ndarray], buffer_size: int, n_rows: int) -> bool:
        """Take over the rows that pointers own; return whether all point to something stored.

        :param rings: the pointers of each ring's written slots, ``(size,)`` int32
        :param buffer_size: slots of a ring
        :param n_rows: rows of the table that hold frames
        """
        self.clear()
        for ring, pointers in enumerate(rings):
            owners = np.flatnonzero(pointers >= 0)
            later = (np.arange(len(pointers)) - np.minimum(pointers, 0)) % buffer_size
            if (pointers >= n_rows).any() or (later >= len(pointers)).any():
                return False
            slots = owners + ring * buffer_size
            self._row_of_slot |= zip(slots.tolist(), pointers[owners].tolist(), strict=True)
        taken = set(self._row_of_slot.values())
        self._free = [row for row in self._free if row not in taken]
        return len(taken) == len(self._row_of_slot)

    def keep(self, slots: Sequence[int], frames: np.ndarray) -> np.ndarray:
        """Give transitions rows of their own, and return which.

        :param slots: of the transitions, over all rings
        :param frames: their next observations, ``(n, obs_dim)``
        """
        self.reserve(len(self.table) - len(self._free) + len(slots))
        rows = [self._free.pop() for _ in slots]
        self._row_of_slot |= zip(slots, rows, strict=True)
        self.table[th.tensor(rows, dtype=th.int64, device=self.table.device)] = th.from_numpy(frames).to(
            self.table.device
        )
        return np.array(rows, dtype=np.int32)

    def kept_rows(self) -> list[int]:
        """Return the rows of transitions that keep theirs until they are overwritten."""
        return [*self._row_of_slot.values()]

    def to(self, device: th.device) -> _FrameTable:
        """Move the table and return it.

        :param device: where to
        """
        self.table = self.table.to(device)
        return self

    def _keep_rows(self, envs: np.ndarray) -> None:
        """Let the newest transitions of some envs keep their rows."""
        assert self._slot_of_env is not None
        slots, rows = self._slot_of_env[envs].tolist(), self._row_of_env[envs].tolist()
        self._row_of_slot |= zip(slots, rows, strict=True)


class _Linker:
    """Points the transitions of one ring, read one run after another, at their next observations.

    :param frames: the table
    :param task: whose ring it is
    :param buffer_size: slots of a ring
    :param n_envs: of the task: the next transition of the same env is so many later
    """

    def __init__(self, frames: _FrameTable, task: int, buffer_size: int, n_envs: int) -> None:
        self._frames, self._first_slot, self._buffer_size = frames, task * buffer_size, buffer_size
        self._ahead = n_envs
        self._slots = np.empty(0, dtype=np.int64)  # of transitions whose next one is not here yet
        self._next_obs = np.empty((0, 0), dtype=np.float32)

    def link(self, pointers: th.Tensor, slots: slice, obs: np.ndarray, next_obs: np.ndarray) -> None:
        """Take in transitions that follow those before.

        :param pointers: of all rings, ``(n_tasks * buffer_size,)`` int32, written
        :param slots: in the ring
        :param obs: ``(n, obs_dim)``
        :param next_obs: the same
        """
        if len(self._slots):
            next_obs = np.concatenate((self._next_obs, next_obs))
        here = np.concatenate((self._slots, np.arange(slots.start, slots.stop))).astype(np.int64)
        n_before = len(self._slots)
        n_known = max(0, len(here) - self._ahead)  # those whose next transition is among ``obs``
        later = np.arange(n_known) + self._ahead - n_before
        follows = np.zeros(n_known, dtype=bool)
        inside = later >= 0
        seen = obs[later[inside]].view(np.int32)
        follows[inside] = (next_obs[:n_known][inside].view(np.int32) == seen).all(axis=1)
        self._point(pointers, here[:n_known][follows], np.int32(-self._ahead))
        self._keep(pointers, here[:n_known][~follows], next_obs[:n_known][~follows])
        self._slots, self._next_obs = here[n_known:], next_obs[n_known:]

    def finish(self, pointers: th.Tensor) -> None:
        """Let the newest transitions keep their next observations.

        :param pointers: see :meth:`link`
        """
        self._keep(pointers, self._slots, self._next_obs)

    def _keep(self, pointers: th.Tensor, slots: np.ndarray, frames: np.ndarray) -> None:
        if len(slots):
            self._point(
                pointers,
                slots,
                self._frames.keep((slots + self._first_slot).tolist(), np.ascontiguousarray(frames)),
            )

    def _point(self, pointers: th.Tensor, slots: np.ndarray, where: Any) -> None:
        values = np.broadcast_to(np.asarray(where, dtype=np.int32), slots.shape).copy()
        index = th.from_numpy(slots + self._first_slot).to(pointers.device)
        pointers[index] = th.from_numpy(values).to(pointers.device)


@dataclasses.dataclass(frozen=True)
class _Header:
    """What a saved buffer holds beside its rows."""

    task_names: list[str]
    observation_shape: list[int]
    action_shape: list[int]
    optimize_memory_usage: bool
    handle_timeout_termination: bool
    buffer_size: int
    task_size: list[int]
    task_pos: list[int]
    n_frames: int
    seed: int
    generator_device: str
    generator_state: str

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value, kind = getattr(self, field.name), str(field.type)
            values = value if kind.startswith("list") else [value]
            wanted = {"str": str, "int": int, "bool": bool}[kind.removeprefix("list[").removesuffix("]")]
            if not isinstance(values, list) or any(
                not isinstance(one, wanted) or (wanted is int and isinstance(one, bool)) for one in values
            ):
                raise TypeError(f"{field.name} is no {kind}")
        n_tasks, slots = len(self.task_names), self.buffer_size
        counts = all(
            0 <= size <= slots and 0 <= pos < slots and (size == slots or pos == size)
            for size, pos in zip(self.task_size, self.task_pos, strict=True)
        )
        if not counts or len(self.task_size) != n_tasks:
            raise ValueError(f"{self.task_size} of {slots} slots, at {self.task_pos}, for {n_tasks} tasks")
        # every slot and, twice, every environment may have a frame; there are no more environments than slots
        if not 0 <= self.n_frames <= 3 * n_tasks * slots * self.optimize_memory_usage:
            raise ValueError(f"{self.n_frames} frames of {n_tasks} tasks with {slots} slots")
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"a seed of {self.seed}")

    def random_state(self) -> th.Tensor:
        """Return the generator's state."""
        return th.from_numpy(np.frombuffer(base64.b64decode(self.generator_state), np.uint8).copy())


def _read_header(file: Any, source: str) -> _Header:
    start = file.read(len(_MAGIC))
    if start != _MAGIC:
        what = "is no replay buffer that save_replay_buffer wrote for several tasks"
        if start[:1] == _PICKLE:
            what = "is a pickle, as SB3's own replay buffer and earlier versions of TaskReplayBuffer write"
        raise ConfigError(
            f"{source} {what}. Load it with the model and version that saved it, or collect anew."
        )
    length = int.from_bytes(file.read(8), "little")
    try:
        if length > _MAX_HEADER:
            raise ValueError(f"a header of {length:,} bytes")
        return _Header(**json.loads(file.read(length)))
    except (TypeError, ValueError, RecursionError) as error:
        raise ConfigError(
            f"{source} was cut off or damaged within its first lines ({error}). Use another save."
        ) from error


def _check_numbers(rows: th.Tensor, source: str) -> None:
    if not th.isfinite(rows).all():
        raise ConfigError(
            f"{source} is damaged: it holds NaN or infinity, which no buffer stores. The replay buffer is now empty. "
            "Use another save."
        )


def _read_exactly(file: Any, memory: memoryview, source: str) -> None:
    while len(memory):
        n_read = file.readinto(memory)
        if not n_read:
            raise ConfigError(f"{source} ended too early; the replay buffer is now empty. Use another save.")
        memory = memory[n_read:]


def _chunks(part: th.Tensor) -> Iterator[th.Tensor]:
    """Yield the rows of a tensor, some at a time."""
    n_rows = max(1, _CHUNK_BYTES // (part.shape[1] * part.element_size()))
    for start in range(0, len(part), n_rows):
        yield part[start : start + n_rows]


def _check_spaces(
    observation_space: spaces.Space[Any], action_space: spaces.Space[Any], n_tasks: int
) -> None:
    for role, space in (("observation", observation_space), ("action", action_space)):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ConfigError(
                f"Per-task buffers store flat Box {role}s, not {space}. Flatten it in the env, for instance with "
                "gymnasium.wrappers.FlattenObservation."
            )
    if observation_space.shape is None or observation_space.shape[0] <= n_tasks:
        raise ConfigError(
            f"Observations of shape {observation_space.shape} cannot end in a one-hot id of {n_tasks} tasks. "
            "Make the env with make_metaworld_env or make_multitask_env, which append it."
        )


def _check_task_of_env(task_of_env: list[int], n_tasks: int, buffer_size: int) -> None:
    if set(task_of_env) != set(range(n_tasks)):
        raise ConfigError(
            f"task_of_env={task_of_env} must give each env one of the tasks 0 to {n_tasks - 1}, and each task at least "
            "one env."
        )
    per_task = max(map(task_of_env.count, range(n_tasks)))
    check_count("buffer_size", buffer_size, minimum=per_task)  # the envs of a task store at the same time
