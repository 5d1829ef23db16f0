"""The SB3 VecEnv of many tasks, and the one door for anything a user has; must not know the algorithms."""

from __future__ import annotations

import contextlib
import dataclasses
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NoReturn, SupportsIndex

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from sb3_ars.envs import checks
from sb3_ars.envs.adapters import GymVectorTaskEnv, TaskIdWrapper, VecEnvIndices, task_id_space
from sb3_ars.envs.checks import TaskSpecs
from sb3_ars.envs.replay import SavedEpisode
from sb3_ars.envs.workers import Ended, EnvFactory, EnvRunner, StepLayout, TaskEnvs, TimeLimited, WorkerPool
from sb3_ars.errors import ConfigError, EnvContractError, WorkerError

__all__ = ["MultiTaskVecEnv", "make_multitask_env"]


class MultiTaskVecEnv(VecEnv):
    """Envs of several tasks, here or in workers, with the task's one-hot id behind each observation.

    Env order is task-major: first all envs of task 0. Observations are float32 ``(n_envs, obs_dim +
    n_tasks)``, a new array each step; rewards are raw. With the same seed, trajectories are equal to the bit
    for any ``n_workers``.

    An info is empty, or holds the step's ``success``, except on an episode's last step: there it is the env's
    own info and ``terminal_observation`` (with the one-hot), ``TimeLimit.truncated``, ``episode`` as SB3's
    Monitor writes it (``r`` raw return, ``l`` steps, ``t`` seconds since the start), and, if the task reports
    success, ``is_success`` (at least once in the episode) and ``success_at_end``.

    :param tasks: name -> function that returns a new Gymnasium env, in the order of the one-hot id; a list of
        ``n_envs_per_task`` functions gives each env of the task its own
    :param n_envs_per_task: envs of each task
    :param seed: env i starts from ``seed + i``; None is unpredictable
    :param n_workers: worker processes; 0 steps the envs here, "auto" uses the available CPUs
    :param start_method: "spawn", "fork" or "forkserver"; any works without ``if __name__ == "__main__"``
    :param worker_timeout: seconds a worker may take to answer before it counts as hung
    :param restart_workers: whether a worker that dies, hangs or whose env raises in a step or a reset is started anew,
        with a warning, three times in a row at most: its envs are built again, with seeds that follow from theirs, and
        their episodes end as truncated, with ``worker_restarted`` in the info of that step, which has no outcome. Needs
        workers and Linux
    :raises ConfigError: if an option or a task cannot work; the message names it
    """

    def __init__(
        self,
        tasks: TaskSpecs,
        *,
        n_envs_per_task: int = 1,
        seed: int | None = None,
        n_workers: int | str = "auto",
        start_method: str = "spawn",
        worker_timeout: float = 25.0,
        restart_workers: bool = False,
    ) -> None:
        self._closed_because: str | None = "it was never completely built"
        per_task = checks.check_count("n_envs_per_task", n_envs_per_task)
        self.task_names, factories = checks.pairs_of_tasks(tasks, per_task)
        self.n_tasks = len(self.task_names)
        """How many tasks there are."""
        self.task_of_env: npt.NDArray[np.int64] = np.repeat(np.arange(self.n_tasks, dtype=np.int64), per_task)
        """The task index of each env."""
        self.goals: str | None = None
        """How Meta-World's goals are chosen, where the tasks are Meta-World's."""
        self.n_goals: int | None = None
        """How many stored goals each task has, where the tasks are Meta-World's."""
        n_envs = len(factories)
        processes = checks.check_n_workers(n_workers, n_envs)
        restart, processes = checks.check_restart_workers(restart_workers, n_workers, processes)
        method: Any = checks.check_start_method(start_method)
        timeout = checks.check_timeout(worker_timeout)
        checks.check_seed(seed)

        self._start = time.time()
        self._stepping = False
        names = [self.task_names[task] for task in self.task_of_env]
        self._runner: EnvRunner = (
            WorkerPool(factories, names, processes, method, timeout, restart)
            if processes
            else TaskEnvs(factories, names)
        )
        self._closed_because = None
        try:
            self._build(n_envs, names)
        except BaseException:
            self.close()
            raise
        self.seed(seed) if seed is not None else None

    def reset(self) -> npt.NDArray[np.float32]:
        """Start new episodes and return the first observations, ``(n_envs, obs_dim + n_tasks)``."""
        self._check_idle("reset")
        with self._guarded("resetting its envs"):
            self.reset_infos = self._runner.reset(self._seeds, self._options)
        self._reset_seeds()
        self._reset_options()
        return self._observations()

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Begin a step; until `step_wait` no other call is allowed.

        :param actions: ``(n_envs, action_dim)`` within the bounds of the action space
        """
        self._check_idle("step_async")
        arrays = self._runner.arrays
        if np.shape(actions) != arrays.actions.shape:
            raise ValueError(f"actions must have shape {arrays.actions.shape}, got {np.shape(actions)}.")
        arrays.actions[:] = actions
        with self._guarded():
            self._runner.step_async()
        self._stepping = True

    def step_wait(
        self,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Return (observations, raw rewards, dones, infos) of the step begun by `step_async`."""
        if not self._stepping:
            self._check_idle("step_wait")
            raise RuntimeError("step_wait() without step_async(): no step is under way.")
        with self._guarded("stepping its envs"):
            ended = self._runner.step_wait()
        arrays = self._runner.arrays
        infos: list[dict[str, Any]] = [
            {} if success != success else {"success": success} for success in arrays.success.tolist()
        ]
        for end in ended:
            infos[end.env] = self._last_info(end)
            self.reset_infos[end.env] = end.reset_info
        return self._observations(), arrays.rewards.copy(), arrays.terminated | arrays.truncated, infos

    def set_active_tasks(self, tasks: Sequence[int] | None) -> None:
        """Let only the envs of these tasks step from now on; the others cost nothing.

        They keep their observation, with reward 0, no end of an episode and an empty info, and go on where they stood
        once they are active again. `reset` starts a new episode in every env all the same.

        :param tasks: task indices; None is all
        :raises ConfigError: if there is none among them, or an unknown one
        """
        self._check_idle("set_active_tasks")
        active = set(range(self.n_tasks) if tasks is None else tasks)
        if not active or not active <= set(range(self.n_tasks)):
            raise ConfigError(
                f"tasks={tasks} must be None or some of the task indices 0 to {self.n_tasks - 1}."
            )
        with self._guarded():
            self._runner.activate(np.isin(self.task_of_env, list(active)))

    def checkpoint_state(self) -> dict[str, Any]:
        """Return what `restore_checkpoint_state` of an env made like this one needs, as plain values and arrays.

        :raises RuntimeError: before the first `reset`, or while a step is under way
        """
        self._check_idle("checkpoint_state")
        with self._guarded():
            episodes = self._runner.episodes()
        if len(episodes) < self.num_envs:
            raise RuntimeError("checkpoint_state() before reset(): no episode has begun.")
        restarts = self._runner.restarts
        return {
            "episodes": [dataclasses.asdict(episode) for episode in episodes],
            "seeds": self._seeds,  # of a reset that is asked for but not made yet
            "options": self._options,
            "restarts": None if restarts is None else restarts.checkpoint_state(),
        }

    def restore_checkpoint_state(self, state: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        """Bring every env to the middle of the episode it was in; return the observations, as `reset` does.

        Each episode is played again: exact for envs that draw from NumPy generators of their own and keep no other
        memory than plain values from one episode to the next. Others are found out by their last observation, and
        begin a new episode, with a warning.

        :param state: of `checkpoint_state`, of an env made with the same arguments; ``n_workers`` may differ
        :raises ConfigError: if it is of another number of envs
        """
        self._check_idle("restore_checkpoint_state")
        if len(state["episodes"]) != self.num_envs:
            raise ConfigError(
                f"The checkpoint was made with {len(state['episodes'])} envs, this env has {self.num_envs}; make it "
                "with the same tasks and n_envs_per_task."
            )
        with self._guarded("playing its episodes again"):
            problems = self._runner.play_again([SavedEpisode.of(episode) for episode in state["episodes"]])
        self.reset_infos = [{} for _ in range(self.num_envs)]
        if self._runner.restarts is not None and state["restarts"] is not None:
            self._runner.restarts.restore_checkpoint_state(state["restarts"])
        self._seeds, self._options = list(state["seeds"]), list(state["options"])
        for index, problem in enumerate(problems):
            if problem is not None:
                warnings.warn(
                    f"Env {index} of task {self.task_names[self.task_of_env[index]]!r} begins a new episode instead of "
                    f"going on: {problem}. So this run will differ from one that was not interrupted.",
                    stacklevel=2,
                )
        return self._observations()

    def close(self) -> None:
        """Close the envs and end the workers; may be called twice."""
        if self._closed_because is None:
            self._closed_because = "close() was called"
            self._stepping = False
            self._runner.close()

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Give env i the seed ``seed + i`` at the next `reset`; None draws an unpredictable one.

        :param seed: a non-negative integer or None
        """
        # Deviation: SB3 draws the missing seed from NumPy's global generator; we leave that one alone.
        start = checks.check_seed(seed)
        if start is None:
            start = int(np.random.SeedSequence().generate_state(1)[0])
        self._seeds = [start + index for index in range(self.num_envs)]
        return list(self._seeds)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each env, looked up through its wrappers."""
        return self._call("get_attr", indices, attr_name)

    def has_attr(self, attr_name: str) -> bool:
        """Return whether every env has the attribute."""
        return all(self._call("has_attr", None, attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of each env: where it exists among the wrappers, else on the outermost."""
        self._call("set_attr", indices, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of each env and return the answers."""
        return self._call("env_method", indices, method_name, args, kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return for each env whether such a wrapper is around it; for SB3's Monitor always true.

        Deviation: so `evaluate_policy` does not warn, for the ``episode`` entry it looks for is there.
        """
        if wrapper_class is Monitor:
            return [True for _ in self._get_indices(indices)]
        return self._call("is_wrapped", indices, wrapper_class)

    def get_images(self) -> list[npt.NDArray[np.uint8] | None]:
        """Return an RGB image of each env, None without ``render_mode="rgb_array"``."""
        if self.render_mode != "rgb_array":
            return [None] * self.num_envs
        return self._call("render", None)

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise TypeError(
            "A MultiTaskVecEnv cannot be pickled or copied: it owns simulators and worker processes. "
            "Build another one with the same arguments and seed."
        )

    def _build(self, n_envs: int, names: list[str]) -> None:
        facts = self._runner.build()
        spaces = checks.check_common_spaces(names, facts)
        obs_dim, action_dim = len(spaces.low), spaces.action_space.shape[0]
        self._runner.allocate(StepLayout(n_envs, obs_dim, action_dim, str(spaces.action_space.dtype)))
        horizons = {fact.max_episode_steps for fact in facts}
        self.max_episode_steps = horizons.pop() if len(horizons) == 1 else None
        """The horizon, if all envs have the same known one."""
        self._obs_dim = obs_dim
        self._with_task_id = np.zeros((n_envs, obs_dim + self.n_tasks), np.float32)
        self._with_task_id[np.arange(n_envs), obs_dim + self.task_of_env] = 1.0
        super().__init__(n_envs, task_id_space(spaces.low, spaces.high, self.n_tasks), spaces.action_space)
        if self.render_mode is not None:
            self.metadata["render_fps"] = self.get_attr("metadata", 0)[0].get("render_fps", 30)

    def _observations(self) -> npt.NDArray[np.float32]:
        observations: npt.NDArray[np.float32] = self._with_task_id.copy()
        observations[:, : self._obs_dim] = self._runner.arrays.obs
        return observations

    def _last_info(self, end: Ended) -> dict[str, Any]:
        arrays, env = self._runner.arrays, end.env
        terminal = self._with_task_id[env].copy()
        terminal[: self._obs_dim] = arrays.terminal_obs[env]
        info = dict(end.last_info)
        info["terminal_observation"] = terminal
        info["TimeLimit.truncated"] = bool(arrays.truncated[env] and not arrays.terminated[env])
        info["episode"] = {
            "r": round(float(arrays.episode_return[env]), 6),
            "l": int(arrays.episode_length[env]),
            "t": round(time.time() - self._start, 6),
        }
        if not np.isnan(arrays.success_once[env]):
            info["success"] = float(arrays.success[env])
            info["is_success"] = bool(arrays.success_once[env] > 0)
            info["success_at_end"] = bool(arrays.success[env] > 0)
        return info

    def _call(self, command: str, indices: VecEnvIndices, *args: Any) -> list[Any]:
        self._check_idle(command)
        chosen: Iterable[int] = self._get_indices(indices)
        with self._guarded():
            return self._runner.call(command, [range(self.num_envs)[index] for index in chosen], *args)

    @contextlib.contextmanager
    def _guarded(self, doing: str | None = None) -> Iterator[None]:
        """Leave no step under way whatever happens, and close the envs once they have failed.

        :param doing: what an exception of an env in this process interrupted; None lets it through as it is
        """
        try:
            yield
        except (WorkerError, EnvContractError) as error:
            self.close()
            self._closed_because = f"it failed with {type(error).__name__}"
            raise
        except Exception as error:
            if doing is None or not isinstance(self._runner, TaskEnvs):
                raise
            self.close()
            self._closed_because = f"it failed with {type(error).__name__}"
            raise WorkerError(
                f"The env of task {self._runner.blame()!r} raised {type(error).__name__} while {doing}: {error}. "
                "All envs were closed."
            ) from error
        finally:
            self._stepping = False

    def _check_idle(self, wanted: str) -> None:
        if self._closed_because is not None:
            raise RuntimeError(
                f"{wanted}() on a closed MultiTaskVecEnv ({self._closed_because}): build it again."
            )
        if self._stepping:
            raise RuntimeError(f"{wanted}() while a step is under way: call step_wait() first.")


def make_multitask_env(
    tasks: TaskSpecs | VecEnv | VectorEnv[Any, Any, Any],
    *,
    seed: int | None = None,
    n_envs_per_task: int = 1,
    max_episode_steps: int | None = None,
    n_workers: int | str = "auto",
    start_method: str = "spawn",
    worker_timeout: float = 25.0,
    restart_workers: bool = False,
    task_names: Sequence[str] | None = None,
    task_of_env: Sequence[int] | None = None,
) -> VecEnv:
    """Return an SB3 VecEnv with the one-hot task id behind each observation, from whatever holds the tasks.

    :param tasks: either name -> function that returns a new Gymnasium env (see `MultiTaskVecEnv`), or an SB3
        VecEnv together with ``task_of_env``, or a ``gymnasium.vector.VectorEnv`` such as
        ``gym.make_vec("Meta-World/MT10")`` (one task per sub-env unless ``task_of_env`` says otherwise)
    :param seed: env i starts from ``seed + i`` at the next reset
    :param n_envs_per_task: envs of each task; functions only
    :param max_episode_steps: truncates each episode there; functions only
    :param n_workers: see `MultiTaskVecEnv`; functions only, as are the next two
    :param start_method: see `MultiTaskVecEnv`
    :param worker_timeout: see `MultiTaskVecEnv`
    :param restart_workers: see `MultiTaskVecEnv`; functions only
    :param task_names: names for the tasks of a ready-made vector env
    :param task_of_env: the task index of each env of a ready-made vector env
    :raises ConfigError: if an option or a task cannot work; the message names it
    """
    checks.check_seed(seed)
    ready_made = isinstance(tasks, VecEnv | VectorEnv)
    building = {
        "n_envs_per_task": (n_envs_per_task, 1),
        "max_episode_steps": (max_episode_steps, None),
        "n_workers": (n_workers, "auto"),
        "start_method": (start_method, "spawn"),
        "worker_timeout": (worker_timeout, 25.0),
        "restart_workers": (restart_workers, False),
    }
    if ready_made:
        for option, (given, default) in building.items():
            if given != default:
                raise ConfigError(
                    f"{option}={given!r} cannot change a {type(tasks).__name__} that is already built: "
                    "set it where that one is made, or give functions that return single envs."
                )
    elif task_names is not None or task_of_env is not None:
        raise ConfigError(
            "task_names and task_of_env are for vector envs that are already built; for functions the "
            "names are the keys of tasks, and n_envs_per_task says how many envs each gets."
        )
    if isinstance(tasks, VecEnv):
        env: VecEnv = TaskIdWrapper(tasks, task_of_env, task_names)
    elif isinstance(tasks, VectorEnv):
        env = GymVectorTaskEnv(tasks, task_of_env, task_names)
    else:
        return _from_functions(
            tasks,
            max_episode_steps,
            n_envs_per_task=n_envs_per_task,
            seed=seed,
            n_workers=n_workers,
            start_method=start_method,
            worker_timeout=worker_timeout,
            restart_workers=restart_workers,
        )
    if seed is not None:
        env.seed(seed)
    return env


def _from_functions(tasks: TaskSpecs, max_episode_steps: int | None, **options: Any) -> MultiTaskVecEnv:
    if max_episode_steps is None:
        return MultiTaskVecEnv(tasks, **options)
    steps = checks.check_count("max_episode_steps", max_episode_steps)
    per_task = checks.check_count("n_envs_per_task", options["n_envs_per_task"])
    names, factories = checks.pairs_of_tasks(tasks, per_task)
    limited: list[EnvFactory] = [TimeLimited(factory, steps) for factory in factories]
    pairs = [(name, limited[i * per_task : (i + 1) * per_task]) for i, name in enumerate(names)]
    return MultiTaskVecEnv(pairs, **options)
