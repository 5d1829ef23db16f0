"""Tests of the multi-task VecEnv, of the adapters for ready-made vector envs, and of every refusal."""

import copy
import pickle
import sys
import warnings

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor, VecNormalize

from sb3_ars.envs import MultiTaskVecEnv, checks, make_multitask_env, make_toy_env
from sb3_ars.envs.toy import PointTask
from sb3_ars.errors import ConfigError, EnvContractError

# Else each worker would import this module, and SB3 and torch with it.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


class Script(gym.Env):
    """Plays ``steps``: (reward, success or None, terminated, truncated); observation [step, 10]."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, steps, key="success", low=-np.inf, high=np.inf, render_mode=None):
        self.observation_space = gym.spaces.Box(low, high, (2,), np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.steps, self.key, self.render_mode = steps, key, render_mode
        self.at, self.resets = 0, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets.append((seed, options))
        self.at = 0
        return np.array([0.0, 10.0]), {"fresh": len(self.resets)}

    def step(self, action):
        reward, success, terminated, truncated = self.steps[self.at]
        self.at += 1
        info = {} if success is None else {self.key: success}
        return np.array([self.at, 10.0]), reward, terminated, truncated, {**info, "at": self.at}

    def render(self):
        return np.full((4, 4, 3), self.at, np.uint8)

    def double(self, number, plus=0):
        return 2 * number + plus


ONCE = [(1.0, 0.0, False, False), (2.5, 1.0, False, False), (4.0, 0.0, False, True)]
ENDS = [(0.1, 0.0, False, False), (0.2, 0.0, False, False), (0.7, True, True, True)]
MUTE = [(-1.0, None, False, False), (-1.0, None, False, False), (-1.0, None, True, False)]


def script_env(n_workers=0, **options):
    tasks = {
        "once": lambda: Script(ONCE),
        "ends": lambda: Script(ENDS, "is_success"),
        "mute": lambda: Script(MUTE),
    }
    return MultiTaskVecEnv(tasks, n_workers=n_workers, **options)


def ready_made(kind):
    makers = [lambda: Script(ONCE), lambda: Script(ENDS, "is_success"), lambda: Script(MUTE)]
    if kind == "gymnasium":
        return make_multitask_env(
            SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP),
            task_names=["task-0", "task-1", "task-2"],
        )
    if kind == "sb3":
        return make_multitask_env(DummyVecEnv(makers), task_of_env=[0, 1, 2])
    if kind == "subproc":
        return make_multitask_env(SubprocVecEnv(makers, start_method="fork"), task_of_env=[0, 1, 2])
    return script_env(int(kind))


ALL_KINDS = ["0", "2", "sb3", "subproc", "gymnasium"]
ZERO = np.zeros((3, 1), np.float32)


@pytest.fixture(params=ALL_KINDS)
def any_env(request):
    env = ready_made(request.param)
    yield env
    env.close()


def test_the_one_hot_task_id_is_behind_every_observation(any_env):
    assert isinstance(any_env, VecEnv)
    assert any_env.observation_space.shape == (5,) and any_env.observation_space.dtype == np.float32
    assert any_env.n_tasks == 3 and any_env.task_of_env.tolist() == [0, 1, 2]
    first = any_env.reset()
    assert first.dtype == np.float32
    np.testing.assert_array_equal(first, [[0, 10, 1, 0, 0], [0, 10, 0, 1, 0], [0, 10, 0, 0, 1]])
    second = any_env.step(ZERO)[0]
    np.testing.assert_array_equal(second, [[1, 10, 1, 0, 0], [1, 10, 0, 1, 0], [1, 10, 0, 0, 1]])
    np.testing.assert_array_equal(first[:, 0], 0)  # a fresh array each step


def test_the_last_info_of_an_episode_is_complete(any_env):
    any_env.reset()
    for _ in range(2):
        _, _, dones, infos = any_env.step(ZERO)
        assert not dones.any() and not any("episode" in info for info in infos)
    observations, rewards, dones, infos = any_env.step(ZERO)
    assert dones.tolist() == [True] * 3 and dones.dtype == np.bool_
    np.testing.assert_allclose(rewards, [4.0, 0.7, -1.0], rtol=1e-6)
    assert rewards.dtype == np.float32
    np.testing.assert_array_equal(observations[:, 0], 0)
    np.testing.assert_array_equal(
        [info["terminal_observation"] for info in infos], [[3, 10, *row] for row in np.eye(3)]
    )
    assert [info["TimeLimit.truncated"] for info in infos] == [True, False, False]
    assert [info["episode"]["r"] for info in infos] == [7.5, 1.0, -3.0]
    assert [info["episode"]["l"] for info in infos] == [3, 3, 3]
    assert [info.get("is_success") for info in infos] == [True, True, None]
    assert [info.get("success_at_end") for info in infos] == [False, True, None]
    assert [info["at"] for info in infos] == [3, 3, 3]
    assert [info.get("fresh") for info in any_env.reset_infos] == [2, 2, 2] or not hasattr(any_env, "_runner")


def test_success_and_return_start_anew_with_each_episode(any_env):
    any_env.reset()
    for _ in range(2):
        any_env.step(ZERO)
    any_env.reset()
    for _ in range(6):
        infos = any_env.step(ZERO)[3]
    assert infos[0]["episode"]["r"] == 7.5 and infos[0]["episode"]["l"] == 3
    env = script_env()
    env.set_attr("steps", [(0.0, 0.0, False, True)], indices=0)
    env.reset()
    assert env.step(ZERO)[3][0]["is_success"] is False


@pytest.mark.parametrize("kind", ["0", "2", "gymnasium"])
def test_infos_between_ends_hold_the_step_s_success_only(kind):
    env = ready_made(kind)
    env.reset()
    assert env.step(ZERO)[3] == [{"success": 0.0}, {"success": 0.0}, {}]
    assert env.step(ZERO)[3][0] == {"success": 1.0}
    env.close()


def test_the_inner_monitor_s_episode_entry_is_kept():
    inner = VecMonitor(DummyVecEnv([lambda: Script(ONCE)] * 2))
    env = make_multitask_env(inner, task_of_env=[0, 1])
    env.reset()
    for _ in range(3):
        infos = env.step(ZERO[:2])[3]
    assert infos[0]["episode"]["r"] == 7.5 and infos[0]["is_success"] is True


@pytest.mark.parametrize("n_workers", [0, 2])
def test_it_equals_dummy_vec_env_on_the_same_envs(n_workers):
    scales = (1.0, 0.1)
    ours = make_toy_env(
        seed=3, reward_scales=scales, n_envs_per_task=2, max_episode_steps=7, n_workers=n_workers
    )
    theirs = DummyVecEnv([lambda i=i: PointTask(np.pi * (i // 2), scales[i // 2], 7) for i in range(4)])
    theirs.seed(3)
    first, expected = ours.reset(), theirs.reset()
    rng = np.random.default_rng(0)
    for step in range(30):
        np.testing.assert_array_equal(first[:, :6], expected)
        actions = rng.uniform(-1, 1, (4, 2)).astype(np.float32)
        first, rewards, dones, infos = ours.step(actions)
        expected, their_rewards, their_dones, their_infos = theirs.step(actions)
        np.testing.assert_array_equal(rewards, their_rewards)
        np.testing.assert_array_equal(dones, their_dones)
        assert dones.all() == (step % 7 == 6)
        for info, their_info in zip(infos, their_infos, strict=True):
            if "terminal_observation" in their_info:
                np.testing.assert_array_equal(
                    info["terminal_observation"][:6], their_info["terminal_observation"]
                )
                assert info["TimeLimit.truncated"] == their_info["TimeLimit.truncated"]
    ours.close()


@pytest.mark.parametrize("n_workers", [0, 2])
def test_seeds_and_options_reach_the_next_reset_only(n_workers):
    env = script_env(n_workers, seed=4, n_envs_per_task=2)
    env.set_options({"goal": 1})
    env.reset()
    env.reset()
    resets = env.get_attr("resets")
    assert [r[0] for r in resets] == [(4 + i, {"goal": 1}) for i in range(6)]
    assert [r[1] for r in resets] == [(None, None)] * 6
    assert env.seed(9) == [9, 10, 11, 12, 13, 14]
    assert [info["fresh"] for info in env.reset_infos] == [2] * 6
    env.close()


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_attributes_methods_and_wrappers_are_reached_by_index(kind):
    env = ready_made(kind)
    assert env.env_method("double", 4, plus=1) == [9, 9, 9]
    env.set_attr("at", 5, indices=[1])
    assert env.get_attr("at") == [0, 5, 0]
    assert env.get_attr("at", indices=1) == [5]
    assert env.has_attr("at") and not env.has_attr("no_such_thing")
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [False] * 3
    assert env.env_is_wrapped(Monitor, indices=[0, 2]) == [True, True]
    if kind in ("0", "2", "gymnasium"):
        with pytest.raises(AttributeError):
            env.get_attr("no_such_thing")
    env.close()


@pytest.mark.parametrize("n_workers", [0, 2])
def test_images_come_from_the_envs(n_workers):
    tasks = {name: lambda: Script(ONCE, render_mode="rgb_array") for name in "abc"}
    env = MultiTaskVecEnv(tasks, n_workers=n_workers)
    env.reset()
    env.step(ZERO)
    assert [int(image.max()) for image in env.get_images()] == [1, 1, 1]
    assert env.render().shape == (8, 8, 3)
    assert env.env_method("double", 1, indices=[-1]) == [2]
    env.close()
    silent = script_env()
    assert silent.get_images() == [None] * 3


def test_env_order_is_task_major():
    env = script_env(n_envs_per_task=2)
    assert env.task_of_env.tolist() == [0, 0, 1, 1, 2, 2] and env.task_of_env.dtype == np.int64
    assert env.task_names == ("once", "ends", "mute")


def test_observation_bounds_enclose_all_tasks():
    env = MultiTaskVecEnv(
        {"a": lambda: Script(ONCE, low=-2, high=11), "b": lambda: Script(ONCE, low=-1, high=20)}
    )
    assert env.observation_space.low.tolist() == [-2, -2, 0, 0]
    assert env.observation_space.high.tolist() == [20, 20, 1, 1]


def test_max_episode_steps_is_known_if_common():
    assert make_toy_env(max_episode_steps=12).max_episode_steps == 12
    assert script_env().max_episode_steps is None
    env = make_multitask_env({"a": lambda: Script(ONCE)}, max_episode_steps=2)
    assert env.max_episode_steps == 2
    env.reset()
    env.step(ZERO[:1])
    _, _, dones, infos = env.step(ZERO[:1])
    assert dones[0] and infos[0]["TimeLimit.truncated"] is True


@pytest.mark.parametrize("n_workers", [0, 2])
def test_calls_out_of_order_raise(n_workers):
    env = script_env(n_workers)
    env.reset()
    with pytest.raises(RuntimeError, match="without step_async"):
        env.step_wait()
    env.step_async(ZERO)
    for call in (
        env.reset,
        lambda: env.step_async(ZERO),
        lambda: env.get_attr("at"),
        lambda: env.has_attr("at"),
        lambda: env.set_active_tasks([0]),
    ):
        with pytest.raises(RuntimeError, match="while a step is under way"):
            call()
    assert env.step_wait()[0].shape == (3, 5)
    with pytest.raises(ValueError, match=r"shape \(3, 1\), got \(1, 1\)"):
        env.step(ZERO[:1])
    env.close()
    for call in (env.reset, lambda: env.step(ZERO), env.step_wait, lambda: env.get_attr("at")):
        with pytest.raises(RuntimeError, match="closed"):
            call()


@pytest.mark.parametrize("n_workers", [0, 2])
def test_inactive_tasks_stand_still_and_go_on_where_they_stood(n_workers):
    env = script_env(n_workers)
    env.reset()
    env.step(ZERO)
    env.set_active_tasks([1])
    for step in (2, 3):
        observations, rewards, dones, infos = env.step(ZERO)
        assert observations[:, 0].tolist() == [1, step % 3, 1] and rewards[0] == rewards[2] == 0
        assert dones.tolist() == [False, step == 3, False] and infos[0] == infos[2] == {}
    assert "episode" in infos[1]
    env.set_active_tasks((2, 0))
    observations, rewards, dones, infos = env.step(ZERO)
    assert observations[:, 0].tolist() == [2, 0, 2] and rewards.tolist() == [2.5, 0, -1]
    assert not dones.any() and infos == [{"success": 1.0}, {}, {}]
    env.set_active_tasks(None)
    observations, _, dones, infos = env.step(ZERO)
    assert observations[:, 0].tolist() == [0, 1, 0] and dones.tolist() == [True, False, True]
    assert [infos[i]["episode"]["l"] for i in (0, 2)] == [3, 3] and infos[0]["episode"]["r"] == 7.5
    env.close()


@pytest.mark.parametrize("n_workers", [0, 2])
def test_a_reset_starts_episodes_in_inactive_envs_too_and_they_stay_inactive(n_workers):
    env = script_env(n_workers)
    env.reset()
    env.step(ZERO)
    env.set_active_tasks([0])
    assert env.reset()[:, 0].tolist() == [0, 0, 0]
    assert env.step(ZERO)[0][:, 0].tolist() == [1, 0, 0]
    env.close()


@pytest.mark.parametrize("tasks", [[], [3], [-1], ["once"]])
def test_active_tasks_that_are_none_of_the_envs_are_refused(tasks):
    with pytest.raises(ConfigError, match="must be None or some of the task indices 0 to 2"):
        script_env().set_active_tasks(tasks)


@pytest.mark.parametrize("kind", ["sb3", "gymnasium"])
def test_a_ready_made_vector_env_says_which_env_can_leave_tasks_out(kind):
    with pytest.raises(ConfigError, match=r"VectorEnv|VecEnv always steps all .* MultiTaskVecEnv"):
        ready_made(kind).set_active_tasks([0])


def test_pickling_and_copying_are_refused():
    env = script_env()
    for how in (pickle.dumps, copy.copy, copy.deepcopy):
        with pytest.raises(TypeError, match="cannot be pickled or copied"):
            how(env)


def test_evaluate_policy_neither_warns_nor_miscounts():
    class Still:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return np.zeros((len(observation), 1), np.float32), None

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        returns, lengths = evaluate_policy(
            Still(), script_env(), n_eval_episodes=3, return_episode_rewards=True
        )
    assert sorted(returns) == [-3.0, 1.0, 7.5] and lengths == [3, 3, 3]


def toy(**options):
    return make_toy_env(**options)


def boxed(observation=None, action=None):
    def make():
        env = Script(ONCE)
        env.observation_space = observation or env.observation_space
        env.action_space = action or env.action_space
        return env

    return make


def hidden():
    env = Script(ONCE)
    env._partially_observable = True
    return env


OK = boxed()
BOX = gym.spaces.Box(-1, 1, (1,))


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: MultiTaskVecEnv({}), "tasks is empty"),
        (lambda: MultiTaskVecEnv([("a", OK), ("a", OK)]), "task 'a' is given more than once"),
        (lambda: MultiTaskVecEnv([("a", OK), OK]), "must be a pair"),
        (lambda: MultiTaskVecEnv({"": OK}), "non-empty strings"),
        (lambda: MultiTaskVecEnv("MT10"), "must be a mapping"),
        (lambda: MultiTaskVecEnv({"a": "reach"}), "task 'a': expected a function .* type str"),
        (lambda: MultiTaskVecEnv({"a": Script(ONCE)}), "a new one at each call"),
        (lambda: MultiTaskVecEnv({"a": lambda: 3}), "task 'a' returned int, not a gymnasium.Env"),
        (lambda: MultiTaskVecEnv({"a": lambda: 1 / 0}), "task 'a' raised ZeroDivisionError"),
        (lambda: MultiTaskVecEnv({"a": [OK, OK]}), "2 factories, but n_envs_per_task=1"),
        (
            lambda: MultiTaskVecEnv({"a": OK, "b": boxed(gym.spaces.Box(-1, 1, (7,)))}),
            r"'a' and 'b' have observations of different shapes, \(2,\) and \(7,\)",
        ),
        (
            lambda: MultiTaskVecEnv({"a": OK, "b": boxed(action=gym.spaces.Box(-2, 2, (1,)))}),
            "'a' and 'b' have different action spaces",
        ),
        (
            lambda: MultiTaskVecEnv({"a": boxed(gym.spaces.Discrete(3))}),
            "'a': the observation space must be a Box",
        ),
        (lambda: MultiTaskVecEnv({"a": boxed(gym.spaces.Dict(x=BOX))}), "FlattenObservation"),
        (lambda: MultiTaskVecEnv({"a": boxed(gym.spaces.MultiDiscrete([2]))}), "FlattenObservation"),
        (lambda: MultiTaskVecEnv({"a": boxed(gym.spaces.Box(0, 255, (8, 8, 3), np.uint8))}), "one dimension"),
        (
            lambda: MultiTaskVecEnv({"a": boxed(action=gym.spaces.Discrete(3))}),
            "'a': the action space .* continuous",
        ),
        (lambda: MultiTaskVecEnv({"a": boxed(action=gym.spaces.Box(0, 3, (1,), np.int64))}), "Box of floats"),
        (
            lambda: MultiTaskVecEnv({"a": boxed(action=gym.spaces.Box(-np.inf, 1, (1,)))}),
            "bounds must be finite",
        ),
        (lambda: MultiTaskVecEnv({"a": hidden}), "'a'.*Use MT1/make_metaworld_env, ML1 hides the goal"),
        (
            lambda: MultiTaskVecEnv({"a": lambda: gym.wrappers.NormalizeReward(Script(ONCE))}),
            "needs raw rewards",
        ),
        (
            lambda: MultiTaskVecEnv(
                {"a": lambda: type("Mine", (gym.wrappers.NormalizeReward,), {})(Script(ONCE))}
            ),
            "NormalizeReward.*needs raw rewards",
        ),
        (lambda: toy(n_envs_per_task=0), "n_envs_per_task=0 must be an integer of at least 1"),
        (lambda: toy(n_envs_per_task=1.0), "n_envs_per_task=.*must be an integer"),
        (lambda: toy(n_envs_per_task=True), "n_envs_per_task=.*must be an integer"),
        (lambda: toy(n_workers=-1), "n_workers must be 'auto' or an integer of at least 0, got -1"),
        (lambda: toy(n_workers=1.5), "n_workers must be 'auto'"),
        (lambda: toy(n_workers="all"), "n_workers must be 'auto'.*'all'"),
        (lambda: toy(n_workers=True), "n_workers must be 'auto'.*True"),
        (lambda: toy(n_workers=5), "n_workers=5 is more than the 4"),
        (lambda: toy(start_method="spwan"), "start_method must be one of .*Did you mean 'spawn'"),
        (lambda: toy(worker_timeout=0), "worker_timeout must be a positive"),
        (lambda: toy(worker_timeout=float("nan")), "worker_timeout must be a positive"),
        (lambda: toy(seed=-1), "seed must be None or an integer of at least 0, got -1"),
        (lambda: toy(seed=0.5), "seed must be None or an integer"),
        (lambda: toy(seed=True), "seed must be None or an integer"),
        (lambda: toy().seed(-3), "seed must be None"),
        (lambda: toy(max_episode_steps=0), "max_episode_steps=0 must be an integer of at least 1"),
        (lambda: make_multitask_env({"a": OK}, max_episode_steps=0), "max_episode_steps=.* must be"),
        (lambda: make_multitask_env({"a": OK}, task_names=["b"]), "vector envs that are already built"),
        (lambda: make_multitask_env({"a": OK}, seed=-1), "seed must be"),
    ],
)
def test_what_cannot_work_is_refused_by_name(build, words):
    with pytest.raises(ConfigError, match=words):
        build()


def dummy(*factories):
    return DummyVecEnv(list(factories) or [OK, OK])


def vector(*factories, mode=AutoresetMode.SAME_STEP):
    return SyncVectorEnv(list(factories) or [OK, OK], autoreset_mode=mode)


def typo_of(venv):
    return make_multitask_env(venv, task_of_env=[0, 1])


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: make_multitask_env(dummy()), "task_of_env is missing.* its 2 envs"),
        (lambda: make_multitask_env(dummy(), task_of_env=[0]), "one integer .* for each of the 2 envs"),
        (lambda: make_multitask_env(dummy(), task_of_env=[0, 2]), r"no env for task \[1\]"),
        (lambda: make_multitask_env(dummy(), task_of_env=[0, -1]), "without a gap"),
        (lambda: make_multitask_env(dummy(), task_of_env=[0, 1], task_names=["a"]), "1 names for 2 tasks"),
        (lambda: make_multitask_env(dummy(), task_of_env=[0, 1], task_names=["a", "a"]), "more than once"),
        (lambda: make_multitask_env(dummy(), task_of_env=[0, 1], n_workers=2), "n_workers=2 cannot change"),
        (lambda: make_multitask_env(dummy(), task_of_env=[0, 1], max_episode_steps=5), "already built"),
        (lambda: typo_of(VecNormalize(dummy())), "VecNormalize normalises the rewards.*norm_reward=False"),
        (lambda: typo_of(toy(reward_scales=(1, 2))), "has task ids already"),
        (
            lambda: typo_of(dummy(OK, lambda: gym.wrappers.NormalizeReward(Script(ONCE)))),
            "'task-1'.*raw rewards",
        ),
        (lambda: typo_of(dummy(OK, boxed(action=gym.spaces.Box(-2, 2, (1,))))), "different action spaces"),
        (lambda: typo_of(dummy(hidden, hidden)), "ML1 hides the goal"),
        (
            lambda: make_multitask_env(vector(mode=AutoresetMode.NEXT_STEP)),
            "autoreset mode NEXT_STEP.*SAME_STEP",
        ),
        (lambda: make_multitask_env(vector(mode=AutoresetMode.DISABLED)), "autoreset mode DISABLED"),
        (
            lambda: make_multitask_env(gym.wrappers.vector.NormalizeReward(vector())),
            "NormalizeReward.*raw rewards",
        ),
        (lambda: make_multitask_env(vector(hidden, hidden)), "ML1 hides the goal"),
        (
            lambda: make_multitask_env(vector(OK, lambda: gym.wrappers.NormalizeReward(Script(ONCE)))),
            "raw rewards",
        ),
    ],
)
def test_a_ready_made_vector_env_that_cannot_work_is_refused(build, words):
    with pytest.raises(ConfigError, match=words):
        build()


def test_several_envs_of_a_ready_made_vector_env_may_share_a_task():
    env = make_multitask_env(vector(OK, OK, OK), task_of_env=[0, 1, 0], task_names=["x", "y"])
    assert env.task_names == ("x", "y")
    np.testing.assert_array_equal(env.reset()[:, 2:], [[1, 0], [0, 1], [1, 0]])


def test_a_vec_env_without_terminal_observation_is_an_error():
    class Forgetful(DummyVecEnv):
        def step_wait(self):
            observations, rewards, dones, infos = super().step_wait()
            return observations, rewards, dones, [{} for _ in infos]

    env = make_multitask_env(Forgetful([OK, OK]), task_of_env=[0, 1], task_names=["x", "y"])
    env.reset()
    with pytest.raises(EnvContractError, match=r"task 'x'.*terminal_observation"):
        for _ in range(3):
            env.step(ZERO[:2])


@pytest.mark.parametrize(("n_envs", "n_cpus", "expected"), [(1, 8, 0), (4, 1, 0), (4, 2, 2), (4, 8, 4)])
def test_auto_takes_a_worker_per_cpu_but_none_for_one(monkeypatch, n_envs, n_cpus, expected):
    monkeypatch.setattr(checks, "available_cpus", lambda: n_cpus)
    assert checks.check_n_workers("auto", n_envs) == expected
