"""Meta-World's tasks as a multi-task VecEnv; must not know the algorithms, loads Meta-World on first use."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from sb3_ars.envs.rendering import DEFAULT_CAMERA, MujocoCamera, camera_index, select_gl_backend
from sb3_ars.errors import ConfigError, nearest

if TYPE_CHECKING:
    from sb3_ars.envs.vec_env import MultiTaskVecEnv

__all__ = ["MetaworldTask", "make_metaworld_env", "metaworld_task_names", "task_names_of_classes"]

Goals = Literal["random", "stored", "ordered"]

_BENCHMARKS = ("MT10", "MT25", "MT50")


class MetaworldTask(gym.Env[npt.NDArray[np.float64], npt.NDArray[np.float32]]):
    """One Meta-World task, goal visible, with goals that obey the seed.

    Observation ``(39,)`` float64, action ``(4,)`` in [-1, 1], reward per ``reward_version``; never
    terminates, is truncated after ``max_episode_steps``; ``info["success"]`` is 0.0 or 1.0 in each step.

    Deviation: the stock ``reset(seed=...)`` ignores the seed, and the stock random goals come from NumPy's
    global generator; here both come from the env's own.

    :param task: "reach-v3" or "reach"
    :param goals: "random": a new goal and object position in each episode; "stored": each episode picks one
        of ``n_goals`` at random; "ordered": they come one after another, from the first again after a seeded
        reset
    :param max_episode_steps: the horizon
    :param reward_version: "v2" (0 to 10) or "v1"
    :param n_goals: how many stored goals there are
    :param goal_seed: what the stored goals come from: they equal ``metaworld.MT1(task, seed=goal_seed)``'s
    :param first_goal: "ordered" starts at this goal
    :param goal_stride: "ordered" goes on by this many goals
    :param render_mode: None, "rgb_array", "human" or "depth_array"
    :param fast: step through `fast_metaworld`, which gives the same numbers sooner; False is the stock env
    :param render_size: width and height of rendered arrays in pixels
    :param camera: "front", or one of the model's, such as "corner2" or "gripperPOV"
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]  # Gymnasium's is not a ClassVar
        "render_modes": ["human", "rgb_array", "depth_array"],
        "render_fps": 80,
    }

    def __init__(
        self,
        task: str,
        goals: Goals = "random",
        max_episode_steps: int = 500,
        reward_version: str = "v2",
        n_goals: int = 50,
        goal_seed: int = 0,
        first_goal: int = 0,
        goal_stride: int = 1,
        render_mode: str | None = None,
        fast: bool = True,
        render_size: int = 480,
        camera: str = DEFAULT_CAMERA,
    ) -> None:
        self.task = task if task.endswith("-v3") else f"{task}-v3"
        self.goals = goals
        self.max_episode_steps = max_episode_steps
        self.render_mode = render_mode
        self._render_size, self._camera_name = render_size, camera
        self._camera: MujocoCamera | None = None
        self._stored = None if goals == "random" else _stored_goals(self.task, n_goals, goal_seed)
        self._first_goal, self._stride = first_goal, goal_stride
        self._next_goal = first_goal
        self.sawyer: Any = _new_sawyer(
            self.task, fast, reward_function_version=reward_version, render_mode=render_mode
        )
        """The stock env, or the fast subclass of it."""
        camera_index(self.sawyer.model, camera)  # an unknown one is refused now, not when it is to draw
        self.sawyer._partially_observable = False
        # Cached while the goal was still hidden.
        del self.sawyer.sawyer_observation_space
        self.sawyer.max_path_length = max_episode_steps
        self._draw = self.sawyer.place if fast else self.sawyer.reset_model
        if fast:
            self.sawyer.remember = self._stored is not None
        self.observation_space = self.sawyer.sawyer_observation_space
        self.action_space = self.sawyer.action_space

    @property
    def rand_vec(self) -> npt.NDArray[np.float64]:
        """The vector that the running episode's goal and object positions come from."""
        return np.array(self.sawyer._last_rand_vec)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float64], dict[str, Any]]:
        """Start an episode with the next goal; return (observation, info).

        :param seed: seeds every draw from here on, and restarts the order of the goals
        :param options: unused
        """
        super().reset(seed=seed)
        if seed is not None:
            self._next_goal = self._first_goal
        sawyer = self.sawyer
        if self._stored is None:
            # The env must draw for itself: it rejects some vectors, and would loop for ever on a frozen one.
            sawyer.np_random = self.np_random
            sawyer._freeze_rand_vec = False
            self._draw()
            vector = sawyer._last_rand_vec
        else:
            vector = self._stored[self._pick(len(self._stored))]
        # Frozen: an unfrozen reset() draws twice, and in a dozen tasks the first observation shows objects where
        # the first draw put them.
        sawyer._freeze_rand_vec = True
        sawyer._last_rand_vec = vector.copy()
        obs, info = sawyer.reset()
        return obs, info

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Step the simulator; return (observation, reward, False, truncated, info)."""
        obs, reward, terminated, truncated, info = self.sawyer.step(action)
        return obs, float(reward), terminated, truncated, info

    def render(self) -> Any:
        """Return the frame that ``render_mode`` asks for, or show it."""
        if self.render_mode not in ("rgb_array", "depth_array"):
            return self.sawyer.render()
        if self._camera is None:
            sawyer = self.sawyer
            self._camera = MujocoCamera(sawyer.model, sawyer.data, self._camera_name, self._render_size)
        return self._camera.draw(self.render_mode)

    def close(self) -> None:
        """Close the simulator and its windows."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        self.sawyer.close()

    def _pick(self, n_goals: int) -> int:
        if self.goals == "stored":
            return int(self.np_random.integers(n_goals))
        goal = self._next_goal % n_goals
        self._next_goal += self._stride
        return goal


def make_metaworld_env(
    tasks: str | Sequence[str],
    seed: int | None = None,
    n_envs_per_task: int = 1,
    goals: Goals = "random",
    max_episode_steps: int = 500,
    reward_version: str = "v2",
    n_workers: int | str = "auto",
    n_goals: int = 50,
    goal_seed: int = 0,
    start_method: str = "spawn",
    worker_timeout: float = 25.0,
    render_mode: str | None = None,
    fast: bool = True,
    render_size: int = 480,
    camera: str = DEFAULT_CAMERA,
    restart_workers: bool = False,
) -> MultiTaskVecEnv:
    """Return a VecEnv of Meta-World tasks: goals visible, rewards raw, one-hot task id in the observation.

    :param tasks: "MT10", "MT25", "MT50", one task's name or a list of names, with or without "-v3"
    :param seed: see `MultiTaskVecEnv`
    :param n_envs_per_task: see `MultiTaskVecEnv`
    :param goals: "random", "stored" or "ordered", see `MetaworldTask`; with "ordered" and k envs per task,
        env r of a task takes the goals r, r + k, r + 2k, ...
    :param max_episode_steps: the horizon
    :param reward_version: "v2" or "v1"
    :param n_workers: see `MultiTaskVecEnv`
    :param n_goals: how many stored goals each task has
    :param goal_seed: what the stored goals come from, beside the task and ``n_goals``
    :param start_method: see `MultiTaskVecEnv`
    :param worker_timeout: see `MultiTaskVecEnv`
    :param render_mode: None, "rgb_array", "human" or "depth_array"
    :param fast: see `MetaworldTask`
    :param render_size: see `MetaworldTask`
    :param camera: see `MetaworldTask`
    :param restart_workers: see `MultiTaskVecEnv`
    :raises ConfigError: if an option or a name cannot work, or nothing can draw what is to be rendered; the message
        names it
    :raises ImportError: if Meta-World is not installed
    """
    # Here and not above: a worker imports this module, and needs neither SB3 nor torch.
    from sb3_ars.envs import checks
    from sb3_ars.envs.vec_env import MultiTaskVecEnv

    checks.check_choice("goals", goals, ("random", "stored", "ordered"))
    checks.check_choice("reward_version", reward_version, ("v2", "v1"))
    if not isinstance(fast, bool):
        raise ConfigError(f"fast={fast!r} must be True or False.")
    per_task = checks.check_count("n_envs_per_task", n_envs_per_task)
    checks.check_count("n_goals", n_goals)
    if checks.check_seed(goal_seed, "goal_seed") is None or goal_seed >= 2**32:
        raise ConfigError(f"goal_seed must be an integer from 0 to 2**32 - 1, got {goal_seed!r}.")
    if render_mode is not None:
        checks.check_choice("render_mode", render_mode, MetaworldTask.metadata["render_modes"])
    checks.check_count("render_size", render_size, minimum=16)
    make = partial(
        MetaworldTask,
        goals=goals,
        max_episode_steps=checks.check_count("max_episode_steps", max_episode_steps),
        reward_version=reward_version,
        n_goals=n_goals,
        goal_seed=goal_seed,
        goal_stride=per_task,
        render_mode=render_mode,
        fast=fast,
        render_size=render_size,
        camera=camera,
    )
    names = metaworld_task_names(tasks)
    if render_mode in ("rgb_array", "depth_array"):
        select_gl_backend()
    env = MultiTaskVecEnv(
        [(name, [partial(make, name, first_goal=replica) for replica in range(per_task)]) for name in names],
        n_envs_per_task=per_task,
        seed=seed,
        n_workers=n_workers,
        start_method=start_method,
        worker_timeout=worker_timeout,
        restart_workers=restart_workers,
    )
    env.goals, env.n_goals = goals, n_goals
    return env


def metaworld_task_names(tasks: str | Sequence[str]) -> tuple[str, ...]:
    """Return the canonical names, such as "reach-v3", of a benchmark (in Meta-World's order) or of a list.

    :param tasks: "MT10", "MT25", "MT50", one task's name or a list of names, with or without "-v3"
    :raises ConfigError: for an unknown or repeated name
    :raises ImportError: if Meta-World is not installed
    """
    env_dict = _env_dict()
    known = list(env_dict.ALL_V3_ENVIRONMENTS)
    if isinstance(tasks, str) and tasks in _BENCHMARKS:
        return tuple(getattr(env_dict, f"{tasks}_V3"))
    if not isinstance(tasks, str | Sequence):
        raise ConfigError(
            f"tasks={tasks!r} must be 'MT10', 'MT25', 'MT50', a task's name or a list of names."
        )
    given = [tasks] if isinstance(tasks, str) else list(tasks)
    names = [_canonical(name, known) for name in given]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if not names or repeated:
        raise ConfigError(
            f"tasks: {', '.join(map(repr, repeated))} given more than once; for several envs of one task use "
            "n_envs_per_task."
            if repeated
            else "tasks is empty: give 'MT10', 'MT25', 'MT50' or at least one task name."
        )
    return tuple(names)


def task_names_of_classes() -> dict[str, str]:
    """Return the task name of each stock env class, such as ``{"SawyerReachEnvV3": "reach-v3"}``."""
    return {cls.__name__: name for name, cls in _env_dict().ALL_V3_ENVIRONMENTS.items()}


def _canonical(name: object, known: Sequence[str]) -> str:
    if isinstance(name, str):
        full = name if name.endswith("-v3") else f"{name}-v3"
        if full in known:
            return full
    hint = nearest(str(name), [*_BENCHMARKS, *known, *(full.removesuffix("-v3") for full in known)])
    raise ConfigError(
        f"tasks: {name!r} is not a Meta-World task.{hint} Give 'MT10', 'MT25', 'MT50', or names such as "
        "'reach-v3'; metaworld_task_names('MT50') lists all of them."
    )


def _env_dict() -> Any:
    try:
        from metaworld import env_dict
    except ImportError as error:
        raise ImportError(f"Meta-World is needed for this: pip install metaworld ({error})") from error
    return env_dict


def _new_sawyer(task: str, fast: bool, **options: Any) -> Any:
    env_class = _env_dict().ALL_V3_ENVIRONMENTS[task]
    if fast:
        from sb3_ars.envs.fast_metaworld import fast_class  # needs Meta-World

        env_class = fast_class(env_class)
    sawyer = env_class(**options)
    # What set_task does for a task without settings of its own; none of the fifty has any.
    sawyer._set_task_called = True
    sawyer._set_task_inner()
    sawyer._freeze_rand_vec = False
    sawyer.seeded_rand_vec = True
    return sawyer


@cache
def _stored_goals(task: str, n_goals: int, goal_seed: int) -> npt.NDArray[np.float64]:
    """Return ``(n_goals, width)`` reset vectors, the first of ``metaworld.MT1(task, seed=goal_seed)``'s 50.

    Cached per process: the envs of one task share them.
    """
    sawyer = _new_sawyer(task, fast=True)
    # Meta-World seeds NumPy's global generator and draws from that; this one gives the same numbers.
    sawyer.np_random = np.random.RandomState(goal_seed)
    vectors = []
    for _ in range(n_goals):
        # Meta-World keeps the second draw of a reset.
        sawyer.place()
        sawyer.place()
        vectors.append(np.array(sawyer._last_rand_vec, dtype=np.float64))
    sawyer.close()
    stored = np.array(vectors)
    if len(np.unique(stored, axis=0)) != n_goals:
        raise ConfigError(f"task {task!r}: n_goals={n_goals} gave repeated goals with goal_seed={goal_seed}.")
    stored.flags.writeable = False
    return stored
