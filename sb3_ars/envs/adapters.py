"""Adapters that give ready-made vector envs (SB3's, Gymnasium's) task ids; must not know the algorithms."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn, SupportsIndex

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv, VectorWrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from sb3_ars.envs import checks
from sb3_ars.envs.metaworld import task_names_of_classes
from sb3_ars.envs.workers import REWARD_NORMALIZERS, EnvFacts
from sb3_ars.errors import ConfigError, EnvContractError

__all__ = ["GymVectorTaskEnv", "TaskIdWrapper", "VecEnvIndices", "task_id_space"]

VecEnvIndices = int | Iterable[int] | None
StepReturn = tuple[
    npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]
]


def task_id_space(
    low: npt.NDArray[np.float32], high: npt.NDArray[np.float32], n_tasks: int
) -> gym.spaces.Box:
    """Return the float32 Box of an observation with ``n_tasks`` one-hot entries behind it."""
    zeros, ones = np.zeros(n_tasks, np.float32), np.ones(n_tasks, np.float32)
    return gym.spaces.Box(np.concatenate([low, zeros]), np.concatenate([high, ones]), dtype=np.float32)


class TaskIdWrapper(VecEnvWrapper):
    """An SB3 VecEnv with the one-hot task id behind each observation and ``terminal_observation``.

    Infos are the inner env's; an episode's last one gains ``is_success`` (at least once in the episode, if
    the env reports ``success`` or ``is_success``), ``success_at_end``, and ``episode`` if no Monitor inside
    made one.

    :param venv: the VecEnv
    :param task_of_env: the task index of each env
    :param task_names: one name per task; None takes Meta-World's names, or "task-0", "task-1", ...
    :raises ConfigError: if a task cannot work; the message names it
    """

    def __init__(
        self, venv: VecEnv, task_of_env: Sequence[int] | None = None, task_names: Sequence[str] | None = None
    ) -> None:
        if task_of_env is None:
            raise ConfigError(
                f"task_of_env is missing: a {type(venv).__name__} does not say which env belongs to which "
                f"task. Give a task index for each of its {venv.num_envs} envs, such as task_of_env=[0, 0, "
                "1, 1]."
            )
        _check_no_normalizer(venv)
        facts = _Peek(
            has=lambda name: venv.env_method("has_wrapper_attr", name),
            get=venv.get_attr,
            reset=venv.reset,
            observation_space=venv.observation_space,
            action_space=venv.action_space,
            n_envs=venv.num_envs,
        )
        self._ids = _TaskIds(facts, task_of_env, task_names)
        self.task_names, self.task_of_env = self._ids.task_names, self._ids.task_of_env
        self.n_tasks = len(self.task_names)
        self.max_episode_steps = self._ids.max_episode_steps
        self._episodes = _Episodes(venv.num_envs)
        super().__init__(venv, observation_space=self._ids.observation_space)

    def reset(self) -> npt.NDArray[np.float32]:
        """Start a new episode in every env and return the first observations, with task ids."""
        observations: Any = self.venv.reset()
        self.reset_infos = self.venv.reset_infos
        self._episodes.start(range(self.num_envs))
        return self._ids.append(observations)

    def step_wait(self) -> StepReturn:
        """Return (observations, rewards, dones, infos) of the step begun by `step_async`."""
        observations: Any
        observations, rewards, dones, inner_infos = self.venv.step_wait()
        infos = [dict(info) for info in inner_infos]
        self._episodes.add(rewards, infos)
        for index in map(int, np.flatnonzero(dones)):
            info = infos[index]
            terminal = info.get("terminal_observation")
            if terminal is None:
                raise EnvContractError(
                    f"task {self._ids.name_of(index)!r}: the VecEnv ended an episode without infos[{index}]"
                    "['terminal_observation'], so the last transition would lead into the next episode."
                )
            info["terminal_observation"] = self._ids.append_one(terminal, index)
            ours = self._episodes.finish(index)
            ours["episode"] = info.get("episode", ours["episode"])
            info.update(ours)
        return self._ids.append(observations), np.asarray(rewards, np.float32), np.asarray(dones), infos

    def set_active_tasks(self, tasks: Sequence[int] | None) -> NoReturn:
        """Refuse: this vector env always steps all of its envs.

        :raises ConfigError: always, saying which env can
        """
        _refuse_active_tasks(self.venv)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return for each env whether such a wrapper is around it; for SB3's Monitor always true.

        Deviation: so `evaluate_policy` does not warn, for the ``episode`` entry it looks for is there.
        """
        if wrapper_class is Monitor:
            return [True for _ in self._get_indices(indices)]
        return self.venv.env_is_wrapped(wrapper_class, indices=indices)


class GymVectorTaskEnv(VecEnv):
    """A ``gymnasium.vector.VectorEnv`` as an SB3 VecEnv with the one-hot task id behind each observation.

    An observation that already ends in Meta-World's one-hot is left as it is. Infos are as
    `MultiTaskVecEnv`'s.

    :param venv: the vector env; its autoreset mode must be SAME_STEP
    :param task_of_env: the task index of each sub-env; None makes each a task of its own
    :param task_names: one name per task; None takes Meta-World's names, or "task-0", "task-1", ...
    :raises ConfigError: if a task cannot work; the message names it
    """

    def __init__(
        self,
        venv: VectorEnv[Any, Any, Any],
        task_of_env: Sequence[int] | None = None,
        task_names: Sequence[str] | None = None,
    ) -> None:
        _check_same_step(venv)
        _check_no_vector_normalizer(venv)
        self.venv = venv
        n_envs = venv.num_envs
        peek = _Peek(
            has=lambda name: list(_inner(venv).call("has_wrapper_attr", name)),
            get=lambda name: list(_inner(venv).get_attr(name)),
            reset=venv.reset,
            observation_space=venv.single_observation_space,
            action_space=venv.single_action_space,
            n_envs=n_envs,
        )
        self._ids = _TaskIds(peek, task_of_env, task_names)
        self.task_names, self.task_of_env = self._ids.task_names, self._ids.task_of_env
        self.n_tasks = len(self.task_names)
        self.max_episode_steps = self._ids.max_episode_steps
        self._episodes = _Episodes(n_envs)
        self._actions: npt.NDArray[Any] | None = None
        self._closed = False
        super().__init__(n_envs, self._ids.observation_space, venv.single_action_space)

    def reset(self) -> npt.NDArray[np.float32]:
        """Start a new episode in every env and return the first observations, with task ids."""
        self._check_idle("reset")
        options = self._options[0] or None
        if any((other or None) != options for other in self._options):
            raise ValueError(
                "A gymnasium VectorEnv takes the same reset options for all envs: give one dict."
            )
        seeds: Any = None if self._seeds[0] is None else self._seeds
        observations, infos = self.venv.reset(seed=seeds, options=options)
        self.reset_infos = [_info_of(infos, index) for index in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        self._episodes.start(range(self.num_envs))
        return self._ids.append(observations)

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Begin a step; an ``AsyncVectorEnv`` goes on by itself, any other steps in `step_wait`."""
        self._check_idle("step_async")
        if isinstance(self.venv, AsyncVectorEnv):
            self.venv.step_async(actions)
        self._actions = actions

    def step_wait(self) -> StepReturn:
        """Return (observations, rewards, dones, infos) of the step begun by `step_async`."""
        if self._actions is None:
            raise RuntimeError("step_wait() without step_async(): no step is under way.")
        actions, self._actions = self._actions, None
        inner: Any = self.venv
        step = inner.step_wait() if isinstance(inner, AsyncVectorEnv) else inner.step(actions)
        observations, rewards, terminated, truncated, batch = step
        dones = np.asarray(terminated) | np.asarray(truncated)
        ended = [int(index) for index in np.flatnonzero(dones)]
        if ended and not {"final_obs", "final_info"} <= batch.keys():
            raise EnvContractError(
                "The VectorEnv ended an episode without final_obs and final_info in infos."
            )
        reports = [
            _info_of(batch["final_info"] if dones[index] else batch, index) for index in range(self.num_envs)
        ]
        self._episodes.add(rewards, reports)
        infos = [_success_only(report) for report in reports]
        for index in ended:
            infos[index] = {
                **reports[index],
                **self._episodes.finish(index),
                "terminal_observation": self._ids.append_one(batch["final_obs"][index], index),
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
            }
            reset_info = _info_of(batch, index)
            self.reset_infos[index] = {k: v for k, v in reset_info.items() if not k.startswith("final_")}
        return self._ids.append(observations), np.asarray(rewards, np.float32), dones, infos

    def set_active_tasks(self, tasks: Sequence[int] | None) -> NoReturn:
        """Refuse: this vector env always steps all of its envs.

        :raises ConfigError: always, saying which env can
        """
        _refuse_active_tasks(self.venv)

    def close(self) -> None:
        """Close the vector env; may be called twice."""
        if not self._closed:
            self._closed = True
            self.venv.close()

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Give sub-env i the seed ``seed + i`` at the next `reset`; None draws an unpredictable one.

        Meta-World's own envs ignore this seed: give ``seed=`` to ``gym.make_vec``.
        """
        start = checks.check_seed(seed)
        if start is None:
            start = int(np.random.SeedSequence().generate_state(1)[0])
        self._seeds = [start + index for index in range(self.num_envs)]
        return list(self._seeds)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each env, looked up through its wrappers."""
        # Asked first, because an AsyncVectorEnv loses the worker whose env lacks the attribute.
        if not self.has_attr(attr_name):
            raise AttributeError(f"not every env has an attribute {attr_name!r}")
        values = list(_inner(self.venv).get_attr(attr_name))
        return [values[index] for index in self._get_indices(indices)]

    def has_attr(self, attr_name: str) -> bool:
        """Return whether every env has the attribute."""
        self._check_idle("has_attr")
        return all(_inner(self.venv).call("has_wrapper_attr", attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the envs."""
        self._check_idle("set_attr")
        chosen = set(self._get_indices(indices))
        if len(chosen) == self.num_envs:
            values = [value] * self.num_envs
        else:
            values = [value if i in chosen else old for i, old in enumerate(self.get_attr(attr_name))]
        _inner(self.venv).set_attr(attr_name, values)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the envs and return the answers.

        :raises ValueError: for some of the envs only, where Gymnasium can only call all (``AsyncVectorEnv``)
        """
        self._check_idle("env_method")
        chosen = list(self._get_indices(indices))
        envs = getattr(self.venv.unwrapped, "envs", None)
        if envs is not None:
            return [envs[index].get_wrapper_attr(method_name)(*args, **kwargs) for index in chosen]
        if chosen != list(range(self.num_envs)):
            raise ValueError(
                f"env_method({method_name!r}): this VectorEnv can only call all envs; leave out indices."
            )
        return list(_inner(self.venv).call(method_name, *args, **kwargs))

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return for each env whether such a wrapper is around it; for SB3's Monitor always true.

        Deviation: so `evaluate_policy` does not warn, for the ``episode`` entry it looks for is there. Always
        false for other wrappers in an ``AsyncVectorEnv``, which does not let us look.
        """
        chosen = list(self._get_indices(indices))
        if wrapper_class is Monitor:
            return [True for _ in chosen]
        envs = getattr(self.venv.unwrapped, "envs", None)
        return [envs is not None and _is_wrapped(envs[index], wrapper_class) for index in chosen]

    def get_images(self) -> list[npt.NDArray[np.uint8] | None]:
        """Return an RGB image of each env, None without ``render_mode="rgb_array"``."""
        if self.render_mode != "rgb_array":
            return [None] * self.num_envs
        return list(_inner(self.venv).call("render"))

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise TypeError(
            "A GymVectorTaskEnv cannot be pickled or copied: build another one with the same arguments."
        )

    def _check_idle(self, wanted: str) -> None:
        if self._closed:
            raise RuntimeError(f"{wanted}() on a closed GymVectorTaskEnv: build it again.")
        if self._actions is not None:
            raise RuntimeError(f"{wanted}() while a step is under way: call step_wait() first.")


class _Peek(NamedTuple):
    """How to look into the envs of a ready-made vector env without harm."""

    has: Callable[[str], list[bool]]
    get: Callable[[str], list[Any]]
    reset: Callable[[], Any]
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    n_envs: int

    def values(self, name: str) -> list[Any] | None:
        """Return the attribute of all envs, or None if one lacks it (asking for it could kill its worker)."""
        try:
            return self.get(name) if all(self.has(name)) else None
        except (AttributeError, NotImplementedError):  # a VecEnv that does not let us look
            return None

    def any_has(self, name: str) -> list[bool]:
        """Return for each env whether it has the attribute."""
        try:
            return list(self.has(name))
        except (AttributeError, NotImplementedError):
            return [False] * self.n_envs


class _TaskIds:
    """Names and one-hot ids of the tasks of a vector env, and the checks that its tasks fit together."""

    def __init__(
        self, peek: _Peek, task_of_env: Sequence[int] | None, task_names: Sequence[str] | None
    ) -> None:
        given = range(peek.n_envs) if task_of_env is None else task_of_env
        self.task_of_env = checks.check_task_of_env(given, peek.n_envs)
        known = _metaworld_names(peek)
        # what the tasks are called is worked out after this: a hidden goal explains more than a repeated name
        _check_goals_and_rewards(peek, known or [f"task-{task}" for task in self.task_of_env])
        if task_of_env is None and task_names is None and known is None:
            raise ConfigError(
                "This VectorEnv does not say what its tasks are. If its envs are different tasks, give "
                f"make_multitask_env(venv, task_names=[...]) {peek.n_envs} names; if they are copies of one task, "
                f"task_of_env={[0] * peek.n_envs}, or use SB3's make_vec_env."
            )
        self.task_names = _names(known, self.task_of_env, task_names)
        names = [self.task_names[task] for task in self.task_of_env]
        _check_inner_spaces(peek, names)
        whole = EnvFacts(peek.observation_space, peek.action_space, False, None, None)
        low, high, _ = checks.check_common_spaces(names, [whole] * peek.n_envs)
        self._present = _has_task_id(peek, self.task_of_env, len(self.task_names))
        self.observation_space = task_id_space(low, high, 0 if self._present else len(self.task_names))
        self.max_episode_steps = _horizon(peek)
        self._one_hot = np.eye(len(self.task_names), dtype=np.float32)[self.task_of_env]

    def name_of(self, env: int) -> str:
        """Return the task name of an env."""
        return self.task_names[int(self.task_of_env[env])]

    def append(self, observations: Any) -> npt.NDArray[np.float32]:
        """Return a new float32 array of the observations with their task ids."""
        if self._present:
            return np.array(observations, np.float32)
        return np.concatenate([np.asarray(observations, np.float32), self._one_hot], axis=1)

    def append_one(self, observation: Any, env: int) -> npt.NDArray[np.float32]:
        """Return one env's observation with its task id."""
        if self._present:
            return np.array(observation, np.float32)
        return np.concatenate([np.asarray(observation, np.float32), self._one_hot[env]])


class _Episodes:
    """Running return, length and success of each env."""

    def __init__(self, n_envs: int) -> None:
        self._since = time.time()
        self._returns = np.zeros(n_envs)
        self._lengths = np.zeros(n_envs, np.int64)
        self._once: list[bool | None] = [None] * n_envs
        self._last: list[bool | None] = [None] * n_envs

    def start(self, envs: Iterable[int]) -> None:
        """Forget the episodes of these envs."""
        for env in envs:
            self._returns[env], self._lengths[env] = 0.0, 0
            self._once[env] = self._last[env] = None

    def add(self, rewards: Any, infos: Sequence[Mapping[str, Any]]) -> None:
        """Count one step of every env."""
        self._returns += rewards
        self._lengths += 1
        for env, info in enumerate(infos):
            success = info.get("success", info.get("is_success"))
            self._last[env] = None if success is None else bool(success)
            if success is not None:
                self._once[env] = bool(self._once[env]) or bool(success)

    def finish(self, env: int) -> dict[str, Any]:
        """Return the entries of an episode's last info, and start the next."""
        entries: dict[str, Any] = {
            "episode": {
                "r": round(float(self._returns[env]), 6),
                "l": int(self._lengths[env]),
                "t": round(time.time() - self._since, 6),
            }
        }
        if self._once[env] is not None:
            entries.update(is_success=self._once[env], success_at_end=bool(self._last[env]))
        self.start([env])
        return entries


def _check_no_normalizer(venv: VecEnv) -> None:
    layer = venv
    while isinstance(layer, VecEnvWrapper):
        if isinstance(layer, VecNormalize) and layer.norm_reward:
            raise ConfigError(
                "VecNormalize normalises the rewards, but adaptive reward scaling needs raw ones. "
                "Build it with norm_reward=False."
            )
        layer = layer.venv
    if hasattr(venv, "task_of_env"):
        raise ConfigError(f"This {type(venv).__name__} has task ids already: use it as it is.")


def _check_no_vector_normalizer(venv: VectorEnv[Any, Any, Any]) -> None:
    layer = venv
    while isinstance(layer, VectorWrapper):
        if type(layer).__name__ in REWARD_NORMALIZERS:
            raise ConfigError(
                f"The VectorEnv is wrapped in {type(layer).__name__}, but adaptive reward scaling needs raw "
                "rewards. Remove the wrapper."
            )
        layer = layer.env


def _check_same_step(venv: VectorEnv[Any, Any, Any]) -> None:
    mode = venv.metadata.get("autoreset_mode")
    if mode != AutoresetMode.SAME_STEP:
        name = mode.name if isinstance(mode, AutoresetMode) else repr(mode)
        raise ConfigError(
            f"The gymnasium VectorEnv has autoreset mode {name}; SB3 needs SAME_STEP, where the step that "
            "ends an episode also starts the next. Build it with "
            "autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP "
            '(gym.make_vec: as it is for Meta-World, vector_kwargs={"autoreset_mode": ...} for others), or give '
            "functions that return single envs to make_multitask_env."
        )


def _check_goals_and_rewards(peek: _Peek, names: Sequence[str]) -> None:
    for attribute, wrapper in zip(("return_rms", "_reward_alpha"), REWARD_NORMALIZERS, strict=True):
        for name, wrapped in zip(names, peek.any_has(attribute), strict=True):
            checks.check_raw_rewards(name, wrapper if wrapped else None)
    hidden = peek.values("_partially_observable")
    if hidden is not None and any(hidden):
        # Meta-World's own stacks decide in their first reset; before it each env says that its goal is
        # hidden.
        peek.reset()
        hidden = peek.values("_partially_observable")
    for name, is_hidden in zip(names, hidden or [False] * len(names), strict=True):
        checks.check_visible_goal(name, is_hidden is True)


def _check_inner_spaces(peek: _Peek, names: Sequence[str]) -> None:
    # DummyVecEnv and SubprocVecEnv take the spaces of env 0 for all, whatever the others have.
    observation_spaces, action_spaces = peek.values("observation_space"), peek.values("action_space")
    if observation_spaces is not None and action_spaces is not None:
        facts = [
            EnvFacts(o, a, False, None, None) for o, a in zip(observation_spaces, action_spaces, strict=True)
        ]
        checks.check_equal_spaces(names, facts)


def _has_task_id(peek: _Peek, task_of_env: npt.NDArray[np.int64], n_tasks: int) -> bool:
    present = peek.values("one_hot")  # the attribute of Meta-World's OneHotWrapper
    if present is None:
        return False
    if any(peek.any_has("obs_rms")):
        raise ConfigError(
            "The envs normalise their observations outside Meta-World's one-hot task id, and so normalise "
            "the id. Use use_one_hot=False: the id is appended here."
        )
    if [np.shape(one_hot) for one_hot in present] != [(n_tasks,)] * len(present) or not np.array_equal(
        np.stack(present), np.eye(n_tasks)[task_of_env]
    ):
        raise ConfigError(
            "The observations end in a one-hot task id that does not fit "
            f"task_of_env={task_of_env.tolist()}. Use use_one_hot=False: the id is appended here."
        )
    return True


def _metaworld_names(peek: _Peek) -> list[str] | None:
    """Return each env's Meta-World task, or None where the envs are not Meta-World's."""
    classes = peek.values("task_name")  # each Meta-World env holds its class name
    known = task_names_of_classes() if classes else {}
    names = [known[name] for name in classes or () if name in known]
    return names if len(names) == peek.n_envs else None


def _names(
    known: Sequence[str] | None, task_of_env: npt.NDArray[np.int64], given: Sequence[str] | None
) -> tuple[str, ...]:
    n_tasks = int(task_of_env.max()) + 1
    if given is not None:
        return checks.check_task_names(list(given), n_tasks)
    if known is None:
        return tuple(f"task-{task}" for task in range(n_tasks))
    names = tuple(known[int(np.argmax(task_of_env == task))] for task in range(n_tasks))
    if len(set(names)) < n_tasks:
        raise ConfigError(
            f"Several envs have the same Meta-World task ({', '.join(names)}) but are to be different tasks. Say "
            "which env belongs to which task with task_of_env=[...], or name the tasks with task_names=[...]."
        )
    return names


def _horizon(peek: _Peek) -> int | None:
    for attribute in ("_max_episode_steps", "max_episode_steps", "max_path_length"):
        values = peek.values(attribute)
        if values is not None:
            return int(values[0]) if values[0] is not None and len(set(values)) == 1 else None
    return None


def _info_of(batch: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Return one sub-env's info from Gymnasium's infos, whose array ``_key`` says which envs set ``key``."""
    info: dict[str, Any] = {}
    for key, value in batch.items():
        who = batch.get(f"_{key}")
        if who is None or not who[index]:
            continue
        info[key] = _info_of(value, index) if isinstance(value, dict) else value[index]
    return info


def _success_only(report: Mapping[str, Any]) -> dict[str, Any]:
    success = report.get("success", report.get("is_success"))
    return {} if success is None else {"success": float(success)}


def _is_wrapped(env: gym.Env[Any, Any], wrapper_class: type[Any]) -> bool:
    while isinstance(env, gym.Wrapper):
        if isinstance(env, wrapper_class):
            return True
        env = env.env
    return False


def _refuse_active_tasks(venv: Any) -> NoReturn:
    raise ConfigError(
        f"A {type(venv).__name__} always steps all of its envs, so tasks cannot be made inactive. Give functions that "
        "return single envs to make_multitask_env: the MultiTaskVecEnv it then builds can."
    )


def _inner(venv: VectorEnv[Any, Any, Any]) -> Any:
    """Return the vector env under its wrappers: only that one can call its sub-envs."""
    return venv.unwrapped
