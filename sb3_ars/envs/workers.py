"""Steps Gymnasium envs into NumPy arrays, here or in processes; must not know torch, SB3 or the learner."""

from __future__ import annotations

import contextlib
import errno
import itertools
import math
import mmap
import multiprocessing
import os
import pickle
import signal
import socket
import struct
import sys
import tempfile
import time
import traceback
import warnings
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Literal, NamedTuple, NoReturn, Protocol

import cloudpickle
import gymnasium as gym
import numpy as np
import numpy.typing as npt
import psutil

from sb3_ars.envs.replay import LONGEST_REPLAY, Episode, SavedEpisode, layers, remember_start, restore_start
from sb3_ars.envs.restarts import MAX_IN_A_ROW, RESTARTED, Restarts
from sb3_ars.errors import ConfigError, EnvContractError, WorkerError

__all__ = [
    "Ended",
    "EnvFactory",
    "EnvFacts",
    "EnvRunner",
    "StepArrays",
    "StepLayout",
    "TaskEnvs",
    "TimeLimited",
    "WorkerPool",
]

EnvFactory = Callable[[], "gym.Env[Any, Any]"]
StartMethod = Literal["spawn", "fork", "forkserver"]

START_TIMEOUT = 120.0
"""Seconds that building the envs may take at least, whatever ``worker_timeout`` is."""

REWARD_NORMALIZERS = ("NormalizeReward", "NormalizeRewardsExponential")
"""Class names of the wrappers (Gymnasium's, Meta-World's) that hide the raw reward."""


class EnvFacts(NamedTuple):
    """What must be known of a built env before the arrays can be allocated."""

    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    goal_hidden: bool
    reward_normalizer: str | None
    max_episode_steps: int | None


class Ended(NamedTuple):
    """An episode's end: which env, its own info of the last step, and its info of the reset that followed."""

    env: int
    last_info: dict[str, Any]
    reset_info: dict[str, Any]


@dataclass(frozen=True)
class StepLayout:
    """Sizes of the arrays that one step fills."""

    n_envs: int
    obs_dim: int
    action_dim: int
    action_dtype: str

    def fields(self) -> list[tuple[str, str, tuple[int, ...]]]:
        """Return (name, dtype, shape) of each array, in storage order."""
        n = self.n_envs
        return [
            ("active", "bool", (n,)),
            ("actions", self.action_dtype, (n, self.action_dim)),
            ("obs", "float32", (n, self.obs_dim)),
            ("terminal_obs", "float32", (n, self.obs_dim)),
            ("rewards", "float32", (n,)),
            ("terminated", "bool", (n,)),
            ("truncated", "bool", (n,)),
            ("success", "float32", (n,)),
            ("success_once", "float32", (n,)),
            ("episode_return", "float64", (n,)),
            ("episode_length", "int64", (n,)),
        ]

    def offsets(self) -> list[int]:
        """Return each array's first byte, 64-byte aligned, and the total size last."""
        offsets = [0]
        for _, dtype, shape in self.fields():
            size = np.dtype(dtype).itemsize * int(np.prod(shape))
            offsets.append(offsets[-1] + -(-size // 64) * 64)
        return offsets


class StepArrays:
    """Views into one buffer: what goes into a step (``active``, ``actions``) and what comes out of it.

    ``active``: which envs step; the others keep their observation, with reward 0, no end and no success.
    ``obs``: ``(n_envs, obs_dim)``, the observation to act on next, so the new episode's first one after an
    end.
    ``terminal_obs``, ``episode_return`` (float64 sum of raw rewards), ``episode_length``, ``success_once``
    (0, 1): valid in the rows that ended in this step. ``success``: this step's, NaN where the env reports
    none.

    :param layout: sizes
    :param buffer: memory of at least ``layout.offsets()[-1]`` bytes; None allocates it in this process
    """

    active: npt.NDArray[np.bool_]
    actions: npt.NDArray[Any]
    obs: npt.NDArray[np.float32]
    terminal_obs: npt.NDArray[np.float32]
    rewards: npt.NDArray[np.float32]
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]
    success: npt.NDArray[np.float32]
    success_once: npt.NDArray[np.float32]
    episode_return: npt.NDArray[np.float64]
    episode_length: npt.NDArray[np.int64]

    def __init__(self, layout: StepLayout, buffer: bytearray | mmap.mmap | None = None) -> None:
        offsets = layout.offsets()
        memory = bytearray(offsets[-1]) if buffer is None else buffer
        for (name, dtype, shape), offset in zip(layout.fields(), offsets, strict=False):
            flat = np.frombuffer(memory, dtype, int(np.prod(shape)), offset)
            setattr(self, name, flat.reshape(shape))

    def activate(self, active: npt.NDArray[np.bool_]) -> None:
        """Let these envs step, and leave nothing of the others' latest step behind.

        :param active: ``(n_envs,)``
        """
        self.active[:] = active
        for column, value in zip(
            (self.rewards, self.terminated, self.truncated, self.success), _WAITED, strict=True
        ):
            column[~active] = value

    def rows(self, start: int, stop: int) -> StepArrays:
        """Return the same memory, seen by the envs ``start`` to ``stop - 1`` only."""
        part = object.__new__(StepArrays)
        for name, array in vars(self).items():
            setattr(part, name, array[start:stop])
        return part


class EnvRunner(Protocol):
    """What `TaskEnvs` (in this process) and `WorkerPool` (in others) have in common."""

    arrays: StepArrays

    def build(self) -> list[EnvFacts]:
        """Build the envs and return what they are."""

    def allocate(self, layout: StepLayout) -> None:
        """Allocate ``arrays``; all envs are active."""

    def activate(self, active: npt.NDArray[np.bool_]) -> None:
        """Let only these envs step from now on, ``(n_envs,)``; the others' episodes go on later where they stood."""

    def reset(
        self, seeds: Sequence[int | None], options: Sequence[Mapping[str, Any]]
    ) -> list[dict[str, Any]]:
        """Start a new episode in every env, first observations in ``arrays.obs``; return the infos."""

    def step_async(self) -> None:
        """Begin the step of ``arrays.actions``, in the active envs."""

    def step_wait(self) -> list[Ended]:
        """Finish it; the results are in ``arrays``."""

    def episodes(self) -> list[SavedEpisode]:
        """Return the running episode of every env, between two steps."""

    def play_again(self, episodes: Sequence[SavedEpisode]) -> list[str | None]:
        """Bring every env to where its episode was; return why not, for those that now begin a new one."""

    @property
    def restarts(self) -> Restarts | None:
        """What is known of workers that may be started anew."""

    def call(self, command: str, indices: Sequence[int], *args: Any) -> list[Any]:
        """Return the answers of the named envs to a command of `TaskEnvs`."""

    def close(self) -> None:
        """Close the envs."""


class TaskEnvs:
    """Gymnasium envs stepped one after the other, with automatic reset and episode statistics.

    :param factories: one per env
    :param tasks: the task name of each env, for messages
    """

    arrays: StepArrays
    restarts: Restarts | None = None

    def __init__(self, factories: Sequence[EnvFactory], tasks: Sequence[str]) -> None:
        self._factories = factories
        self._tasks = list(tasks)
        self._envs: list[gym.Env[Any, Any]] = []
        self._returns = [0.0] * len(tasks)
        self._lengths = [0] * len(tasks)
        self._once = [float("nan")] * len(tasks)
        self._episodes: list[Episode | None] = [None] * len(tasks)
        self.current = 0
        """Index of the env that was touched last: the one to blame for an exception."""

    def build(self, factories: Sequence[EnvFactory] | None = None) -> list[EnvFacts]:
        """Build the envs and return what they are.

        :param factories: one per env, where they were not given at first: a worker hears of them once it runs
        :raises ConfigError: if a factory raises or does not return a ``gymnasium.Env``
        """
        self._factories = self._factories if factories is None else factories
        facts = []
        for index, factory in enumerate(self._factories):
            self.current = index
            try:
                env = factory()
            except Exception as error:
                raise ConfigError(
                    f"The factory of task {self._tasks[self.current]!r} raised {type(error).__name__}: "
                    f"{error}"
                ) from error
            if not isinstance(env, gym.Env):
                raise ConfigError(
                    f"The factory of task {self._tasks[self.current]!r} returned {type(env).__name__}, "
                    "not a gymnasium.Env. Give a function that takes no argument and returns a new env."
                )
            if any(env.unwrapped is other.unwrapped for other in self._envs):
                raise ConfigError(
                    f"The factory of task {self._tasks[self.current]!r} returned an env that is in use already; "
                    "each env of each task must be a new one, or their episodes would run into each other."
                )
            self._envs.append(env)
            facts.append(_facts(env))
        return facts

    def allocate(self, layout: StepLayout) -> None:
        """Allocate the arrays in this process."""
        self.arrays = StepArrays(layout)
        self.activate(np.ones(layout.n_envs, bool))

    def activate(self, active: npt.NDArray[np.bool_]) -> None:
        """Let only these envs step from now on, ``(n_envs,)``."""
        self.arrays.activate(active)

    def attach(self, path: str, layout: StepLayout, start: int, stop: int) -> None:
        """Use rows ``start`` to ``stop - 1`` of the arrays that live in the file at ``path``."""
        with open(path, "r+b") as file:
            memory = mmap.mmap(file.fileno(), layout.offsets()[-1])
        self.arrays = StepArrays(layout, memory).rows(start, stop)

    def reset(
        self, seeds: Sequence[int | None], options: Sequence[Mapping[str, Any]]
    ) -> list[dict[str, Any]]:
        """Start a new episode in every env, first observations in ``arrays.obs``; return the infos.

        :param seeds: one per env, None leaves the env's generator as it is
        :param options: one per env, empty means none
        """
        infos = []
        for index, (seed, option) in enumerate(zip(seeds, options, strict=True)):
            infos.append(self._reset_env(index, seed, dict(option) or None))
        self._check_finite([], "reset")
        return infos

    def step_async(self) -> None:
        """Do nothing: in this process a step runs in `step_wait`."""

    def step_wait(self) -> list[Ended]:
        """Step every active env with its row of ``arrays.actions``; return the episodes that ended."""
        arrays = self.arrays
        # A copy, because the next step overwrites the rows and an env may keep its last action.
        actions = arrays.actions.copy()
        # written at once: an assignment to one element of an array costs as much as to all
        outcomes = [_WAITED] * len(self._envs)
        ended: list[Ended] = []
        for index, env in itertools.compress(enumerate(self._envs), arrays.active.tolist()):
            self.current = index
            obs, reward, terminated, truncated, info = env.step(actions[index])
            reward = float(reward)
            success = self._note_step(index, actions[index], reward, info)
            outcomes[index] = (reward, terminated, truncated, success)
            if terminated or truncated:
                ended.append(Ended(index, dict(info), self._end_episode(index, obs)))
            else:
                self._store(arrays.obs, index, obs, "step")
        columns = zip(*outcomes, strict=True)
        arrays.rewards[:], arrays.terminated[:], arrays.truncated[:], arrays.success[:] = columns
        self._check_finite([end.env for end in ended], "step")
        return ended

    def episodes(self) -> list[SavedEpisode]:
        """Return the running episode of every env, between two steps."""
        rows = zip(self._episodes, self.arrays.obs.copy(), self._returns, strict=True)
        return [episode.saved(obs, total) for episode, obs, total in rows if episode is not None]

    def play_again(self, episodes: Sequence[SavedEpisode]) -> list[str | None]:
        """Bring every env to where its episode was; return why not, for those that now begin a new one.

        :param episodes: one per env, of :meth:`episodes`
        """
        problems = [self._play_again(index, episode) for index, episode in enumerate(episodes)]
        for index, problem in enumerate(problems):
            if problem is not None:
                self._reset_env(index, None, None)
        self._check_finite([], "reset")
        return problems

    def _play_again(self, index: int, saved: SavedEpisode) -> str | None:
        self.current = index
        start, actions = saved.start, saved.actions
        try:
            restore_start(self._envs[index], start)
            self._reset_env(index, start.seed, start.options)
            if actions is None:
                return f"its episode was longer than {LONGEST_REPLAY:,} steps"
            for action in actions:
                obs, reward, terminated, truncated, info = self._envs[index].step(action)
                self._note_step(index, action, float(reward), info)
                self._store(self.arrays.obs, index, obs, "step")
                if terminated or truncated:
                    return "its episode now ends earlier"
        except Exception as error:  # an env of somebody else's, in a state it was never asked to be in
            return f"it raised {type(error).__name__} when its episode was played again: {error}"
        same = (
            np.array_equal(self.arrays.obs[index], saved.obs) and self._returns[index] == saved.episode_return
        )
        return None if same else "its episode, played again, went another way"

    def call(self, command: str, indices: Sequence[int], *args: Any) -> list[Any]:
        """Return the answers of the envs at ``indices`` to a command: a method below, without underscore."""
        answer = getattr(self, f"_{command}")
        answers = []
        for index in indices:
            self.current = index
            answers.append(answer(self._envs[index], *args))
        return answers

    def close(self) -> None:
        """Close every env; an env that fails to close does not keep the others open."""
        while self._envs:
            with contextlib.suppress(Exception):
                self._envs.pop().close()

    def blame(self) -> str:
        """Return the task of the env that was touched last."""
        return self._tasks[self.current]

    def _reset_env(self, index: int, seed: int | None, options: dict[str, Any] | None) -> dict[str, Any]:
        self.current = index
        episode = Episode(remember_start(self._envs[index], seed, options))
        obs, info = self._envs[index].reset(seed=seed, options=options)
        self._episodes[index] = episode
        self._returns[index], self._lengths[index], self._once[index] = 0.0, 0, float("nan")
        self._store(self.arrays.obs, index, obs, "reset")
        return dict(info)

    def _end_episode(self, index: int, terminal_obs: Any) -> dict[str, Any]:
        arrays = self.arrays
        self._store(arrays.terminal_obs, index, terminal_obs, "step")
        arrays.episode_return[index] = self._returns[index]
        arrays.episode_length[index] = self._lengths[index]
        arrays.success_once[index] = self._once[index]
        return self._reset_env(index, None, None)

    def _note_step(
        self, index: int, action: npt.NDArray[Any], reward: float, info: Mapping[str, Any]
    ) -> float:
        episode = self._episodes[index]
        if episode is not None:
            episode.add(action)
        self._returns[index] += reward
        self._lengths[index] += 1
        return self._note_success(index, info)

    def _note_success(self, index: int, info: Mapping[str, Any]) -> float:
        value = info.get("success", info.get("is_success"))
        if value is None:
            return math.nan
        success = float(value)
        if success > 0.0:
            self._once[index] = 1.0
        elif self._once[index] != 1.0:
            self._once[index] = 0.0
        return success

    def _store(self, into: npt.NDArray[np.float32], index: int, obs: Any, where: str) -> None:
        # Assignment would broadcast a scalar or a length of 1 without a word.
        shape = obs.shape if type(obs) is np.ndarray else np.shape(obs)
        if shape != into.shape[1:]:
            raise EnvContractError(
                f"Task {self._tasks[index]!r}: {where}() returned an observation of shape {shape}, "
                f"but its observation_space has shape {into.shape[1:]}. Make the env return what it declares."
            )
        into[index] = obs

    def _check_finite(self, ended: Sequence[int], where: str) -> None:
        arrays = self.arrays
        finite = np.isfinite(arrays.obs)
        rewards = np.isfinite(arrays.rewards) if where == "step" else np.ones(len(finite), bool)
        last = np.isfinite(arrays.terminal_obs[ended])
        if finite.all() and rewards.all() and last.all():
            return
        good = finite.all(axis=1) & rewards
        good[ended] &= last.all(axis=1)
        bad = sorted({self._tasks[index] for index in np.flatnonzero(~good)})
        raise EnvContractError(
            f"Task {', '.join(map(repr, bad))}: {where}() returned NaN or infinity in the observation "
            "or the reward. One such number spoils the networks of all tasks; end the episode before "
            "it arises."
        )

    @staticmethod
    def _get_attr(env: gym.Env[Any, Any], name: str) -> Any:
        return env.get_wrapper_attr(name)

    @staticmethod
    def _has_attr(env: gym.Env[Any, Any], name: str) -> bool:
        return env.has_wrapper_attr(name)

    @staticmethod
    def _set_attr(env: gym.Env[Any, Any], name: str, value: Any) -> None:
        env.set_wrapper_attr(name, value)

    @staticmethod
    def _env_method(env: gym.Env[Any, Any], name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        return env.get_wrapper_attr(name)(*args, **kwargs)

    @staticmethod
    def _is_wrapped(env: gym.Env[Any, Any], wrapper_class: type[Any]) -> bool:
        return any(
            isinstance(layer, wrapper_class) for layer in layers(env) if isinstance(layer, gym.Wrapper)
        )

    @staticmethod
    def _render(env: gym.Env[Any, Any]) -> Any:
        return env.render()


class WorkerPool:
    """The same as `TaskEnvs`, in ``n_workers`` processes that each own a contiguous run of the envs.

    A step goes through shared memory and two semaphores per worker; nothing is pickled but the infos of episodes
    that ended. Everybody sleeps who has nothing to do: the processors are the learner's too.

    A dead, raising or hanging worker becomes a `WorkerError` that names its tasks, and ends all the others; with
    ``restart`` it is replaced where that happens in a step or a reset, see `MultiTaskVecEnv`.

    :param factories: one per env; they travel by cloudpickle, so lambdas and classes of a notebook will do
    :param tasks: the task name of each env
    :param n_workers: number of processes, 1 to the number of envs
    :param start_method: "spawn", "fork" or "forkserver"
    :param timeout: seconds a worker may take to answer, except for building its envs
    :param restart: whether a worker that fails is started anew
    """

    arrays: StepArrays

    def __init__(
        self,
        factories: Sequence[EnvFactory],
        tasks: Sequence[str],
        n_workers: int,
        start_method: StartMethod = "spawn",
        timeout: float = 25.0,
        restart: bool = False,
    ) -> None:
        self._tasks = list(tasks)
        self._timeout = timeout
        bounds = [len(tasks) * worker // n_workers for worker in range(n_workers + 1)]
        self._chunks = [range(start, stop) for start, stop in itertools.pairwise(bounds)]
        self._worker_of = [worker for worker, chunk in enumerate(self._chunks) for _ in chunk]
        self._stepping: list[int] = []
        self._awaiting: set[int] = set()
        self._replies: dict[int, bytes] = {}
        self._processes: list[BaseProcess] = []
        self._lines: list[_Line] = []
        self._context: Any = multiprocessing.get_context(start_method)
        self.restarts = Restarts(self._chunks) if restart else None
        self._may_lose = False  # whether a worker that fails now is started anew
        self._lost: dict[int, str] = {}  # those, and what became of them
        self._factories = _pickle_factories(factories, tasks)
        self._owner = os.getpid()
        # Both a finalizer (the pool was dropped) and an exit handler (the script ended).
        self._end = weakref.finalize(self, _end_workers, self._processes, self._lines, self._owner)
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def build(self) -> list[EnvFacts]:
        """Build the envs, each in its worker, and return what they are.

        :raises ConfigError: as `TaskEnvs.build`; its cause holds the worker's traceback
        """
        patience = max(START_TIMEOUT, self._timeout)
        self._send_all([("build", (self._factories[c.start : c.stop],)) for c in self._chunks], patience)
        self._collect(patience, "building its envs")
        return self._take_lists()

    def allocate(self, layout: StepLayout) -> None:
        """Allocate the arrays in a file in memory that every worker maps."""
        # Not a multiprocessing.RawArray: that can be given to a process only when it starts, and the sizes
        # are known only once the envs are built there. The file loses its name at once, so that nothing is
        # left over.
        self._layout = layout
        with _shared_file(layout.offsets()[-1]) as file:
            self.arrays = StepArrays(layout, mmap.mmap(file.fileno(), layout.offsets()[-1]))
            self.activate(np.ones(layout.n_envs, bool))
            self._command(
                [("attach", (file.name, layout, c.start, c.stop)) for c in self._chunks], "attaching memory"
            )
            if self.restarts is not None:  # workers that start later find it among this process's open files
                descriptor = os.dup(file.fileno())
                weakref.finalize(self, os.close, descriptor)
                self._memory = f"/proc/{self._owner}/fd/{descriptor}"

    def activate(self, active: npt.NDArray[np.bool_]) -> None:
        """Let only these envs step from now on, ``(n_envs,)``; a worker without any of them is not woken."""
        self._settle()
        self.arrays.activate(active)
        self._stepping = [worker for worker, c in enumerate(self._chunks) if active[c.start : c.stop].any()]

    def reset(
        self, seeds: Sequence[int | None], options: Sequence[Mapping[str, Any]]
    ) -> list[dict[str, Any]]:
        """Start a new episode in every env, first observations in ``arrays.obs``; return the infos."""
        self._settle()
        seeds, options = list(seeds), list(options)
        if self.restarts is not None:
            self.restarts.begin_episodes(seeds)
        with self._losing():
            for worker, c in enumerate(self._chunks):
                self._send(worker, ("reset", (seeds[c.start : c.stop], options[c.start : c.stop])))
            self._collect(self._timeout, "resetting its envs")
            self._start_lost_anew(options)
        return self._take_lists()

    def episodes(self) -> list[SavedEpisode]:
        """Return the running episode of every env, between two steps."""
        self._command([("episodes", ())] * len(self._chunks), "telling where its episodes are")
        return self._take_lists()

    def play_again(self, episodes: Sequence[SavedEpisode]) -> list[str | None]:
        """Bring every env to where its episode was; return why not, for those that now begin a new one."""
        parts = [(episodes[c.start : c.stop],) for c in self._chunks]
        self._send_all([("play_again", part) for part in parts])
        # up to LONGEST_REPLAY steps of each env, one env after the other
        self._collect(10 * max(START_TIMEOUT, self._timeout), "playing its episodes again")
        return self._take_lists()

    def step_async(self) -> None:
        """Begin the step of ``arrays.actions``, in the active envs."""
        self._settle()
        if self.restarts is not None:
            self.restarts.begin_step(self.arrays)
        for worker in self._stepping:
            self._lines[worker].ask(_STEP)
            self._awaiting.add(worker)

    def step_wait(self) -> list[Ended]:
        """Wait for the step; return the episodes that ended, env indices over the whole pool."""
        with self._losing():
            self._collect(self._timeout, "stepping its envs")
            anew = self._start_lost_anew([{}] * len(self._tasks))
        ended: list[Ended] = []
        for worker, reply in sorted(self._replies.items()):
            start = self._chunks[worker].start
            if worker in anew:
                infos = enumerate(self._loads(worker, reply), start)
                ended += [Ended(env, {RESTARTED: True}, info) for env, info in infos]
            else:
                ended += [end._replace(env=end.env + start) for end in self._loads(worker, reply)]
        self._replies.clear()
        if self.restarts is not None:
            for worker in anew:
                self.restarts.break_off(worker, self.arrays)
            self.restarts.end_step(self.arrays, [worker for worker in self._stepping if worker not in anew])
        return ended

    def call(self, command: str, indices: Sequence[int], *args: Any) -> list[Any]:
        """Return the answers of the named envs to a command of `TaskEnvs`; an env's exception is raised here.

        The workers live on after it, as envs in this process would.
        """
        self._settle()
        chunks = self._chunks
        wanted = {w: [i for i in indices if i in chunks[w]] for w in {self._worker_of[i] for i in indices}}
        for worker, chosen in wanted.items():
            local = [index - chunks[worker].start for index in chosen]
            self._send(worker, ("call", (command, local, *args)))
        self._collect(self._timeout, f"answering {command}", fatal=False)
        answers: dict[int, Any] = {}
        replies = {worker: self._replies.pop(worker) for worker in wanted}
        for worker, chosen in wanted.items():
            if replies[worker][:1] == _ERROR:
                self._raise_original(replies[worker])
            answers.update(zip(chosen, self._loads(worker, replies[worker]), strict=True))
        return [answers[index] for index in indices]

    def close(self) -> None:
        """End the workers, gently at first; never hangs, may be called twice."""
        self._end()

    @property
    def pids(self) -> list[int]:
        """Return the process ids of the workers that have not been ended."""
        return [process.pid for process in self._processes if process.pid is not None]

    def _start(self) -> None:
        with _hidden_main(), _single_threaded():
            for worker in range(len(self._chunks)):
                try:
                    line, process = self._start_one(worker)
                except (OSError, EOFError) as error:
                    raise ConfigError(self._not_started(worker, error)) from error
                self._lines.append(line)
                self._processes.append(process)

    def _start_one(self, worker: int) -> tuple[_Line, BaseProcess]:
        chunk, context = self._chunks[worker], self._context
        ours, theirs = context.Pipe()
        line = _Line(ours, context.Semaphore(0), context.Semaphore(0), context.RawArray("B", 2))
        # A forked child holds copies of the other pipes and would keep them open after the parent died.
        stale = [line.conn for line in self._lines] + [ours] if context.get_start_method() == "fork" else []
        # The factories follow through our own pipe: a child that dies before it has read what it is started
        # with would let multiprocessing wait for ever, once that is longer than a pipe holds.
        envs = TaskEnvs((), self._tasks[chunk.start : chunk.stop])
        process = context.Process(
            target=_work,
            args=(replace(line, conn=theirs), stale, envs),
            name=f"sb3_ars-envs-{worker}",
            daemon=True,
        )
        process.start()
        # Else a dead worker's pipe would never reach its end here.
        theirs.close()
        return line, process

    def _not_started(self, worker: int, error: OSError | EOFError) -> str:
        return (
            f"{self._name(worker)} could not be started ({error or type(error).__name__}). {_remedy(error)}"
        )

    @contextlib.contextmanager
    def _losing(self) -> Iterator[None]:
        """Let workers that fail meanwhile be lost, where they may be started anew."""
        self._may_lose = self.restarts is not None
        try:
            yield
        finally:
            self._may_lose = False
            self._lost.clear()

    def _lose(self, workers: Sequence[int], message: str) -> None:
        """Note that workers failed, and why; end all and raise where none may be started anew."""
        if not self._may_lose:
            self._fail(message)
        for worker in workers:
            self._lost[worker] = message
            self._awaiting.discard(worker)
            self._replies.pop(worker, None)

    def _start_lost_anew(self, options: Sequence[Mapping[str, Any]]) -> list[int]:
        """Put new processes in the place of lost ones; their replies are then those of a reset.

        :param options: of the reset, one per env
        :return: which workers are new
        """
        said, anew = [], set()
        while self._lost and self.restarts is not None:
            worker, reason = min(self._lost.items())
            del self._lost[worker]
            number = self.restarts.count(worker)
            if not number:
                self._fail(
                    f"{reason} It was started anew {MAX_IN_A_ROW} times in a row, and no step worked since."
                )
            said.append(
                f"{reason} {self._name(worker)} was started anew, restart {number} of this worker: the running "
                "episodes of its envs end as truncated, and what their actions led to is not learned."
            )
            anew.add(worker)
            c = self._chunks[worker]
            self._start_anew(worker, (self.restarts.seeds(worker), options[c.start : c.stop]))
        for message in said:
            warnings.warn(message, stacklevel=4)
        return sorted(anew)

    def _start_anew(self, worker: int, reset: tuple[Any, ...]) -> None:
        """Replace a worker's process, and build and reset its envs; if that fails it is lost once more."""
        _end_workers([self._processes[worker]], [self._lines[worker]], self._owner, grace=1.0)
        try:
            with _hidden_main(), _single_threaded():
                self._lines[worker], self._processes[worker] = self._start_one(worker)
        except (OSError, EOFError) as error:
            self._lose([worker], self._not_started(worker, error))
            return
        c = self._chunks[worker]
        for doing, message in (
            ("building its envs anew", ("build", (self._factories[c.start : c.stop],))),
            ("attaching memory", ("attach", (self._memory, self._layout, c.start, c.stop))),
            ("resetting its envs", ("reset", reset)),
        ):
            self._replies.pop(worker, None)
            patience = max(START_TIMEOUT, self._timeout) if message[0] == "build" else self._timeout
            self._send(worker, message, patience)
            self._collect(patience, doing)
            if worker in self._lost:
                return

    def _command(self, messages: Sequence[tuple[str, tuple[Any, ...]]], doing: str) -> None:
        self._send_all(messages)
        self._collect(self._timeout, doing)

    def _send_all(
        self, messages: Sequence[tuple[str, tuple[Any, ...]]], patience: float | None = None
    ) -> None:
        self._settle()
        for worker, message in enumerate(messages):
            self._send(worker, message, patience)

    def _settle(self) -> None:
        """Throw away answers of a command that was interrupted (Ctrl-C) between sending and receiving."""
        self._check_owner()
        if self._awaiting:
            self._collect(self._timeout, "finishing an interrupted command", fatal=False)
        self._replies.clear()

    def _send(self, worker: int, message: tuple[str, tuple[Any, ...]], patience: float | None = None) -> None:
        line, data = self._lines[worker], _dumps(message)
        # In this order, because a long message is taken only while it is read.
        line.ask(_COMMAND)
        self._awaiting.add(worker)
        seconds = self._timeout if patience is None else patience
        try:
            _limit_waiting(line.conn, seconds)
            line.conn.send_bytes(data)
        except BlockingIOError:
            self._lose_hung(seconds, f"being sent {message[0]!r}", [worker])
        except OSError:
            self._lose_dead(worker, "before it could be asked")

    def _collect(self, timeout: float, doing: str, fatal: bool = True) -> None:
        self._check_owner()
        begin = time.monotonic()
        while self._awaiting:
            first, *others = sorted(self._awaiting)
            if self._lines[first].done.acquire(timeout=_LOOK_AROUND):
                self._receive(first, doing, fatal)
                continue
            dead = {worker for worker in self._awaiting if not self._processes[worker].is_alive()}
            for worker in [first, *others]:
                if self._lines[worker].done.acquire(block=False):
                    self._receive(worker, doing, fatal)
                elif worker in dead:
                    self._lose_dead(worker, f"while {doing}")
            waited = time.monotonic() - begin
            # building may take longer than a step, but not while the process is stopped
            hung = sorted(self._awaiting) if waited > timeout else []
            hung = hung or (self._stopped() if waited > self._timeout else [])
            if hung:
                self._lose_hung(min(waited, timeout), doing, hung)

    def _stopped(self) -> list[int]:
        """Return which of the awaited workers a signal has stopped, so that they cannot answer."""
        return [worker for worker in sorted(self._awaiting) if _is_stopped(self._processes[worker])]

    def _check_owner(self) -> None:
        if os.getpid() != self._owner:
            tasks = ", ".join(map(repr, dict.fromkeys(self._tasks)))
            raise WorkerError(
                f"The env workers of {tasks} belong to process {self._owner}, of which this one is a fork: they cannot "
                "serve two. Build the env anew in this process."
            )

    def _receive(self, worker: int, doing: str, fatal: bool) -> None:
        line = self._lines[worker]
        if line.words[_ANSWER] == _REPLY:
            try:
                if not line.conn.poll(self._timeout):  # stopped between its wake-up and its message
                    raise BlockingIOError
                self._replies[worker] = line.conn.recv_bytes()
            except BlockingIOError:  # stopped in the middle of its message
                self._lose_hung(self._timeout, doing, [worker])
            except (EOFError, OSError):
                self._lose_dead(worker, f"while {doing}")
        self._awaiting.discard(worker)
        if fatal and self._replies.get(worker, b"")[:1] == _ERROR:
            self._lose_raising(worker, self._replies[worker], doing)

    def _take_lists(self) -> list[Any]:
        parts = [self._loads(worker, self._replies.pop(worker)) for worker in range(len(self._chunks))]
        return [item for part in parts for item in part]

    def _loads(self, worker: int, reply: bytes) -> Any:
        try:
            return pickle.loads(reply[1:])
        except Exception as error:
            self._fail(
                f"{self._name(worker)} sent an info or an answer that cannot be read outside its process "
                f"({type(error).__name__}: {error}). Use plain numbers, strings and arrays in it, or n_workers=0."
            )

    def _name(self, worker: int) -> str:
        chunk = self._chunks[worker]
        tasks = dict.fromkeys(self._tasks[chunk.start : chunk.stop])
        return f"Env worker {worker} (task{'s' * (len(tasks) > 1)} {', '.join(map(repr, tasks))})"

    def _lose_dead(self, worker: int, when: str) -> None:
        process = self._processes[worker]
        process.join(1.0)
        code = process.exitcode
        how = (
            f"was killed by {signal.Signals(-code).name}"
            if code is not None and code < 0
            else f"exited with {code}"
        )
        hint = {
            -signal.SIGKILL: " Out of memory is the usual reason for SIGKILL: use fewer envs or workers.",
            # Python's multiprocessing then ends what it takes for children of its own
            -signal.SIGTERM: " So it is when a child of os.fork() ends, unless by os._exit().",
        }.get(code or 0, "")
        self._lose(
            [worker],
            f"{self._name(worker)} {how} {when}.{hint} Its last words, if any, are on the error output.",
        )

    def _lose_hung(self, timeout: float, doing: str, workers: Sequence[int]) -> None:
        names = "; ".join(self._name(worker) for worker in workers)
        stopped = any(_is_stopped(self._processes[worker]) for worker in workers)
        why = (
            "A signal has stopped it (SIGSTOP, or Ctrl-Z in its terminal)."
            if stopped
            else "If the env is only slow, raise worker_timeout; if it hangs, try n_workers=0 to see where."
        )
        self._lose(workers, f"{names} did not answer within {timeout:g} s while {doing}. {why}")

    def _lose_raising(self, worker: int, reply: bytes, doing: str) -> None:
        task, trace, error = _read_error(reply)
        if self._may_lose and not isinstance(error, EnvContractError):
            last = trace.strip().splitlines()[-1]
            self._lose([worker], f"The env of task {task!r} raised {last!r} while {doing}.")
            return
        self.close()
        if isinstance(error, ConfigError | EnvContractError):
            raise error from WorkerError(f"in the worker:\n\n{trace}")
        raise WorkerError(
            f"The env of task {task!r} raised an exception while {doing}. All env workers were ended. "
            f"The worker's traceback:\n\n{trace}"
        ) from error

    def _raise_original(self, reply: bytes) -> NoReturn:
        task, trace, error = _read_error(reply)
        reason = WorkerError(f"The env of task {task!r} raised, in its worker:\n\n{trace}")
        if error is None:
            raise reason
        raise error from reason

    def _fail(self, message: str) -> NoReturn:
        # Ended without asking: one of them is known not to answer.
        _end_workers(self._processes, self._lines, os.getpid(), grace=0.0)
        raise WorkerError(f"{message} All env workers were ended; build the env again.")


class TimeLimited:
    """A factory whose envs are truncated after ``max_episode_steps``; here, so that workers load no SB3.

    :param factory: makes the env inside
    :param max_episode_steps: the horizon
    """

    def __init__(self, factory: EnvFactory, max_episode_steps: int) -> None:
        self.factory = factory
        self.max_episode_steps = max_episode_steps

    def __call__(self) -> gym.Env[Any, Any]:
        """Return a new env."""
        return gym.wrappers.TimeLimit(self.factory(), self.max_episode_steps)


_WAITED = (
    0.0,
    False,
    False,
    math.nan,
)  # reward, terminated, truncated and success of an env that did not step

_STEP, _COMMAND, _CLOSE = 1, 2, 3  # what is asked
_DONE, _REPLY = 1, 2  # what is answered: nothing to add, or something in the pipe
_RESULT, _ERROR = b"r", b"e"  # what that begins with
_QUESTION, _ANSWER = 0, 1  # who writes which of a line's words

_LAST_PATIENCE = 30
"""Seconds that a worker which got SIGTERM waits for another question."""

_LOOK_AROUND = 0.1
"""Seconds between two looks at whether the other side still lives, while waiting for it."""


@dataclass(frozen=True)
class _Line:
    """What the parent and one worker meet through: wake-ups, a word each way, and a pipe for what is longer."""

    conn: Connection
    go: Any
    done: Any
    words: Any

    def ask(self, question: int) -> None:
        """Wake the worker."""
        self.words[_QUESTION] = question
        self.go.release()

    def answer(self, reply: bytes) -> None:
        """Wake the parent."""
        self.words[_ANSWER] = _REPLY if reply else _DONE
        self.done.release()
        if reply:
            self.conn.send_bytes(reply)


class _PickledFactory:
    """A factory as cloudpickle's bytes: nothing of it is loaded until it is called, in the worker."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def __call__(self) -> gym.Env[Any, Any]:
        """Return a new env."""
        env: gym.Env[Any, Any] = pickle.loads(self.data)()
        return env


def _pickle_factories(factories: Sequence[EnvFactory], tasks: Sequence[str]) -> list[_PickledFactory]:
    pickled = []
    for factory, task in zip(factories, tasks, strict=True):
        try:
            pickled.append(_PickledFactory(_dumps(factory)))
        except Exception as error:
            raise ConfigError(
                f"The factory of task {task!r} cannot be sent to a worker process ({error}). Build "
                "everything the env needs inside the factory, or use n_workers=0."
            ) from error
    return pickled


def _dumps(value: Any) -> bytes:
    data: bytes = cloudpickle.dumps(value)
    return data


def _facts(env: gym.Env[Any, Any]) -> EnvFacts:
    # by name, so that nothing need be imported; a user's own kind of a normaliser is one too
    classes = (cls.__name__ for layer in layers(env) for cls in type(layer).__mro__)
    normalizers = [name for name in classes if name in REWARD_NORMALIZERS]
    return EnvFacts(
        env.observation_space,
        env.action_space,
        _goal_hidden(env),
        normalizers[0] if normalizers else None,
        _max_episode_steps(env),
    )


def _goal_hidden(env: gym.Env[Any, Any]) -> bool:
    inner = env.unwrapped
    if getattr(inner, "_partially_observable", False) is not True:
        return False
    # Meta-World's own stacks decide in their first reset; before it each env says that its goal is hidden.
    try:
        env.reset()
    except Exception:
        return True
    return getattr(inner, "_partially_observable", False) is True


def _max_episode_steps(env: gym.Env[Any, Any]) -> int | None:
    for name in ("_max_episode_steps", "max_episode_steps"):
        if env.has_wrapper_attr(name):
            value = env.get_wrapper_attr(name)
            return int(value) if isinstance(value, int | np.integer) else None
    return env.spec.max_episode_steps if env.spec is not None else None


def _work(line: _Line, stale: Sequence[Connection], envs: TaskEnvs) -> None:
    """Serve one chunk of envs until told to stop or until the parent is gone."""
    # Ctrl-C and a cluster's SIGTERM reach the whole process group; the parent decides what happens then, and may need
    # these envs for what it does. Should it ask nothing more, this process ends after a while.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    told: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: told.append(number))
    for other in stale:
        other.close()
    torch = sys.modules.get("torch")  # present only in a forked worker, with the parent's number of threads
    if torch is not None:
        torch.set_num_threads(1)
    # A pipe at its end or broken means that the parent is gone: nobody is left to tell.
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while (question := _next_question(line, told)) != _CLOSE:
            message = line.conn.recv_bytes() if question == _COMMAND else None
            line.answer(_answer(envs, message))
    envs.close()


def _next_question(line: _Line, told: Sequence[int]) -> int:
    parent, waited = multiprocessing.parent_process(), 0
    while not line.go.acquire(timeout=_LOOK_AROUND * 10):
        waited += 1
        if parent is not None and not parent.is_alive():
            return _CLOSE
        if told and waited >= _LAST_PATIENCE:
            return _CLOSE
    return int(line.words[_QUESTION])


def _answer(envs: TaskEnvs, message: bytes | None) -> bytes:
    """Return what is to be told beyond the arrays, nothing after most steps; a step has no message."""
    # BaseException: an env that calls sys.exit() would end the worker with status 0 and without a word.
    try:
        if message is None:
            ended = envs.step_wait()
            return _pack(envs, "step", ended) if ended else b""
        method, args = pickle.loads(message)
        return _pack(envs, method, getattr(envs, method)(*args))
    except BaseException as error:
        return _ERROR + _dumps((envs.blame(), traceback.format_exc(), _portable(error)))


def _pack(envs: TaskEnvs, method: str, answer: Any) -> bytes:
    """Return an answer as bytes.

    :raises EnvContractError: naming the task and the entry, for an info that cannot be pickled
    """
    try:
        return _RESULT + _dumps(answer)
    except Exception as error:
        for index, item in enumerate(answer if method in ("step", "reset") else ()):
            envs.current, infos = (item.env, item[1:]) if isinstance(item, Ended) else (index, (item,))
            entries = [(key, value) for info in infos for key, value in info.items()]
            for key, value in entries:
                if _is_portable(value):
                    continue
                raise EnvContractError(
                    f"Task {envs.blame()!r}: info[{key!r}] of its {method}() is of type {type(value).__name__}, which "
                    f"cannot be sent from a worker process ({error}). Leave it out of the info, or use n_workers=0."
                ) from error
        raise


def _is_portable(value: Any) -> bool:
    try:
        _dumps(value)
    except Exception:
        return False
    return True


def _portable(error: BaseException) -> bytes | None:
    """Return the exception pickled; None if it does not survive the journey, or would end the process it arrives in."""
    if not isinstance(error, Exception):
        return None
    try:
        data = _dumps(error)
        pickle.loads(data)
    except Exception:
        return None
    return data


def _read_error(reply: bytes) -> tuple[str, str, Exception | None]:
    task, trace, data = pickle.loads(reply[1:])
    try:
        return task, trace, None if data is None else pickle.loads(data)
    except Exception:
        return task, trace, None


def _shared_file(size: int) -> Any:
    """Return an open file of zeros that processes can map by its name: in memory where there is room, else on disk.

    :param size: bytes
    :raises ConfigError: if there is room nowhere
    """
    said: list[OSError] = []
    for folder in ("/dev/shm", None):
        try:
            file = tempfile.NamedTemporaryFile(prefix="sb3_ars_", dir=folder)  # the caller closes it
        except OSError as error:
            said.append(error)
            continue
        # Written, not only made as long: whoever touches a mapped page that finds no room is killed by SIGBUS.
        try:
            file.write(bytes(size))
            file.flush()
            return file
        except OSError as error:
            said.append(error)
            with contextlib.suppress(OSError):  # it tries to write once more
                file.close()
    raise ConfigError(
        f"The {size:,} bytes that workers share find room neither in /dev/shm ({said[0]}) nor in the folder for "
        f"temporary files ({said[1]}). {_remedy(said[0])}"
    ) from said[0]


def _remedy(error: OSError | EOFError) -> str:
    """Return what to do about an error of the system while workers start."""
    code = getattr(error, "errno", None)
    if code in (errno.EMFILE, errno.ENFILE):
        return "Let this process open more files (ulimit -n), or use fewer workers (n_workers)."
    if code in (errno.EAGAIN, errno.ENOMEM):
        return (
            "The limit on processes (ulimit -u, a container's --pids-limit) or the memory is used up: raise it, or "
            "use fewer workers (n_workers)."
        )
    if code in (errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EPERM):
        return (
            "Processes meet through /dev/shm, which must be writable and have room: start a container with "
            "--shm-size=256m, or use n_workers=0."
        )
    return "Use n_workers=0 to step the envs in this process."


def _limit_waiting(conn: Connection, seconds: float) -> None:
    """Let a message to or from a process that is stopped in the middle of it fail with BlockingIOError.

    A Connection has no timeout of its own, but its socket has.
    """
    span = struct.pack("@ll", int(seconds), int(seconds % 1 * 1e6))
    end = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM, fileno=os.dup(conn.fileno()))
    with end:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, span)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, span)
    os.set_blocking(conn.fileno(), True)  # the wrapper may have changed it: socket.setdefaulttimeout()


def _is_stopped(process: BaseProcess) -> bool:
    try:
        return bool(psutil.Process(process.pid).status() == psutil.STATUS_STOPPED)
    except psutil.Error:
        return False


def _end_workers(processes: list[BaseProcess], lines: list[_Line], owner: int, grace: float = 3.0) -> None:
    if os.getpid() != owner:  # a forked copy of the parent must not end the parent's workers
        return
    for line in lines:
        line.ask(_CLOSE)
        line.conn.close()
    for process in processes:  # a stopped one can neither close its envs nor be terminated
        _wake(process)
    _join(processes, grace)
    for process in processes:
        process.terminate()
        _wake(process)
    _join(processes, 1.0)
    for process in processes:
        process.kill()
    _join(processes, 1.0)
    processes.clear()
    lines.clear()


def _wake(process: BaseProcess) -> None:
    if process.pid is not None and _is_stopped(process):
        os.kill(process.pid, signal.SIGCONT)


def _join(processes: Sequence[BaseProcess], seconds: float) -> None:
    deadline = time.monotonic() + seconds
    for process in processes:
        process.join(max(0.0, deadline - time.monotonic()))


@contextlib.contextmanager
def _hidden_main() -> Iterator[None]:
    """Hide where ``__main__`` came from while processes start.

    multiprocessing makes each spawned child run the parent's main script again, to find what it defines; a
    script without ``if __name__ == "__main__"`` would then start workers in its workers. We need nothing from
    there, since cloudpickle carries what ``__main__`` defines by value.
    """
    main = sys.modules["__main__"]
    missing = object()
    kept = {name: getattr(main, name, missing) for name in ("__file__", "__spec__")}
    try:
        main.__spec__ = None
        if kept["__file__"] is not missing:
            del main.__file__
        yield
    finally:
        for name, value in kept.items():
            if value is not missing:
                setattr(main, name, value)


@contextlib.contextmanager
def _single_threaded() -> Iterator[None]:
    """Let processes started meanwhile use one thread per numeric library: each worker has one core.

    Through the environment, because these libraries read it once, when they load.
    """
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
    kept = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in kept.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
