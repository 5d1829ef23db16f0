"""Tests of the Meta-World envs against the stock ones."""

import sys

import gymnasium as gym
import numpy as np
import pytest

from sb3_ars.envs import make_metaworld_env, make_multitask_env, metaworld_task_names
from sb3_ars.envs.metaworld import MetaworldTask
from sb3_ars.errors import ConfigError

pytestmark = pytest.mark.metaworld

metaworld = pytest.importorskip("metaworld")
ALL = metaworld.ALL_V3_ENVIRONMENTS


def stock_env(task, rand_vec):
    """Return the stock env set to one goal, as the MT benchmarks set it."""
    env = ALL[task]()
    data = {"rand_vec": rand_vec, "env_cls": ALL[task], "partially_observable": False}
    env.set_task(metaworld._encode_task(task, data))
    return env


def rollout(env, n_steps, seed=0):
    rng = np.random.default_rng(seed)
    seen = [env.reset()]
    for _ in range(n_steps):
        seen += env.step(rng.uniform(-1, 1, (env.num_envs, 4)).astype(np.float32))[:3]
    return seen


def vectors(env, n_episodes, seed=None):
    """Return the goal vectors of one env's next episodes."""
    found = []
    for episode in range(n_episodes):
        env.reset(seed=seed if episode == 0 else None)
        found.append(env.rand_vec.tolist())
    return found


@pytest.mark.parametrize("task", list(ALL))
def test_every_task_equals_the_stock_env_to_the_bit(task):
    np.random.seed(3)
    global_state = np.random.get_state()[1].copy()
    ours = make_metaworld_env(task, seed=1, n_workers=0, max_episode_steps=500)
    stock = MetaworldTask(task, fast=False)
    for seed in (1, None):  # the second episode: what the first one leaves behind would show
        observations, expected = ours.reset(), stock.reset(seed=seed)[0]
        ours.step(np.ones((1, 4)))
        stock.step(np.ones(4, np.float32))
    np.testing.assert_array_equal(ours.get_attr("rand_vec")[0], stock.rand_vec)
    assert expected[-3:].any(), "the goal is hidden"
    rng = np.random.default_rng(0)
    for step in range(1, 500):
        np.testing.assert_array_equal(observations[0, :39], expected.astype(np.float32))
        action = rng.uniform(-1, 1, 4).astype(np.float32)
        observations, rewards, dones, infos = ours.step(action[None])
        expected, reward, _, truncated, info = stock.step(action)
        assert rewards[0] == pytest.approx(reward, 1e-7) and infos[0]["success"] == info["success"]
        assert dones[0] == truncated == (step == 499)
        if step == 499:
            np.testing.assert_array_equal(infos[0]["terminal_observation"][:39], expected.astype(np.float32))
    np.testing.assert_array_equal(np.random.get_state()[1], global_state)
    ours.close()
    stock.close()


def test_the_stock_path_equals_meta_world_set_to_the_goal():
    ours = MetaworldTask("push", fast=False)
    observations = [ours.reset(seed=1)[0]]
    stock = stock_env("push-v3", ours.rand_vec)
    expected = [stock.reset()[0]]
    for _ in range(30):
        observations.append(ours.step(np.ones(4, np.float32))[0])
        expected.append(stock.step(np.ones(4, np.float32))[0])
    np.testing.assert_array_equal(observations, expected)


@pytest.mark.parametrize("goals", ["random", "stored"])
def test_transitions_are_the_same_in_any_number_of_workers(goals):
    tasks, seen = ["reach", "drawer-open"], []
    for n_workers in (0, 1, 2):
        env = make_metaworld_env(
            tasks,
            seed=4,
            goals=goals,
            n_goals=5,
            max_episode_steps=40,
            n_workers=n_workers,
            n_envs_per_task=1,
        )
        seen.append(rollout(env, 100))
        env.close()
    for other in seen[1:]:
        for a, b in zip(seen[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_stored_goals_equal_those_of_meta_world_s_mt1():
    env = MetaworldTask("push", goals="ordered", goal_seed=7)
    # Read as Meta-World's own set_task would set them.
    stock, theirs = ALL["push-v3"](), []
    for task in metaworld.MT1("push-v3", seed=7).train_tasks:
        stock.set_task(task)
        theirs.append(stock._last_rand_vec.tolist())
    assert vectors(env, 50) == theirs


def test_stored_goals_depend_on_goal_seed_only_and_are_few():
    first = vectors(MetaworldTask("reach", goals="stored", n_goals=3), 12, seed=0)
    second = vectors(MetaworldTask("reach", goals="stored", n_goals=3), 12, seed=1)
    other = vectors(MetaworldTask("reach", goals="stored", n_goals=3, goal_seed=1), 12, seed=0)
    as_set = {tuple(v) for v in first}
    assert len(as_set) == 3 and {tuple(v) for v in second} == as_set and first != second
    assert not as_set & {tuple(v) for v in other}


def test_ordered_goals_are_dealt_out_to_the_envs_of_a_task():
    env = make_metaworld_env("reach", goals="ordered", n_goals=5, n_envs_per_task=2, n_workers=0, seed=0)
    stored = vectors(MetaworldTask("reach", goals="ordered", n_goals=5), 5)
    dealt = []
    for _ in range(3):
        env.reset()
        dealt.append([stored.index(v.tolist()) for v in env.get_attr("rand_vec")])
    assert dealt == [[0, 1], [2, 3], [4, 0]]
    env.seed(0)
    env.reset()
    assert [stored.index(v.tolist()) for v in env.get_attr("rand_vec")] == [0, 1]
    env.close()


def test_random_goals_obey_the_seed_and_change_with_each_episode():
    env = MetaworldTask("reach")
    first, again, other = vectors(env, 4, seed=5), vectors(env, 4, seed=5), vectors(env, 4, seed=6)
    assert first == again and first != other
    assert len({tuple(v) for v in first}) == 4


def test_the_horizon_is_the_env_s_own_truncation():
    env = make_metaworld_env("reach", max_episode_steps=3, n_workers=0)
    assert env.max_episode_steps == 3
    env.reset()
    for step in range(6):
        _, _, dones, infos = env.step(np.zeros((1, 4)))
        assert dones[0] == (step % 3 == 2)
    assert infos[0]["TimeLimit.truncated"] is True and infos[0]["episode"]["l"] == 3
    env.close()


def test_reward_version_reaches_the_simulator():
    rewards = []
    for version in ("v1", "v2"):
        env = make_metaworld_env("reach", seed=0, reward_version=version, n_workers=0)
        env.reset()
        rewards.append([env.step(np.ones((1, 4)))[1][0] for _ in range(8)][-1])
        env.close()
    assert rewards[0] > 20  # v1 counts centimetres, v2 stays within 10
    assert 0 < rewards[1] <= 10


def test_the_goal_is_within_the_observation_space():
    env = make_metaworld_env("reach", n_workers=0)
    assert (env.observation_space.high[36:39] > env.observation_space.low[36:39]).all()
    assert env.observation_space.shape == (40,)
    env.close()


def test_names_come_in_meta_world_s_order_with_or_without_version():
    mt10 = "reach push pick-place door-open drawer-open drawer-close button-press-topdown peg-insert-side "
    mt10 += "window-open window-close"
    assert metaworld_task_names("MT10") == tuple(f"{name}-v3" for name in mt10.split())
    assert len(metaworld_task_names("MT25")) == 25 and len(metaworld_task_names("MT50")) == 50
    assert metaworld_task_names(["push", "reach-v3"]) == ("push-v3", "reach-v3")
    assert metaworld_task_names("door-open") == ("door-open-v3",)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: make_metaworld_env("raech"), "'raech' is not a Meta-World task.*Did you mean 'reach'"),
        (lambda: make_metaworld_env("MT11"), "Did you mean 'MT10'"),
        (lambda: make_metaworld_env(["reach", 3]), "3 is not a Meta-World task"),
        (lambda: make_metaworld_env(["reach", "reach-v3"]), "'reach-v3' given more than once"),
        (lambda: make_metaworld_env([]), "tasks is empty"),
        (
            lambda: make_metaworld_env("reach", goals="fixed"),
            "goals must be one of 'random', 'stored', 'ordered'",
        ),
        (lambda: make_metaworld_env("reach", reward_version="v3"), "reward_version must be one of"),
        (lambda: make_metaworld_env("reach", fast="no"), "fast='no' must be True or False"),
        (
            lambda: make_metaworld_env("reach", max_episode_steps=0),
            "max_episode_steps=.* must be .* at least 1",
        ),
        (lambda: make_metaworld_env("reach", n_goals=0), "n_goals=.* must be"),
        (lambda: make_metaworld_env("reach", goal_seed=-1), "goal_seed must be"),
        (lambda: make_metaworld_env("reach", goal_seed=None), "goal_seed must be"),
        (lambda: make_metaworld_env("reach", goal_seed=2**32), "goal_seed must be"),
        (lambda: make_metaworld_env("reach", render_mode="ascii"), "render_mode must be one of"),
        (
            lambda: make_multitask_env({"r": lambda: metaworld.ML1("reach-v3").train_classes["reach-v3"]()}),
            "'r': this Meta-World env hides the goal",
        ),
    ],
)
def test_what_cannot_work_is_refused_by_name(build, words):
    with pytest.raises(ConfigError, match=words):
        build()


def test_a_missing_meta_world_names_the_pip_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "metaworld", None)
    with pytest.raises(ImportError, match="pip install metaworld"):
        make_metaworld_env("reach")


@pytest.fixture
def few_goals(monkeypatch):
    # Not num_goals=...: Meta-World keeps that for the rest of the process.
    monkeypatch.setattr(metaworld, "_N_GOALS", 2)


def mt10(**options):
    return gym.make_vec("Meta-World/MT10", vector_strategy="sync", seed=1, **options)


@pytest.mark.filterwarnings("ignore:.*precision lowered:UserWarning")  # Meta-World's one-hot space
@pytest.mark.usefixtures("few_goals")
@pytest.mark.parametrize("use_one_hot", [False, True])
def test_make_vec_is_accepted_and_equals_stepping_it_directly(use_one_hot):
    options = {"max_episode_steps": 20}
    env, theirs = make_multitask_env(mt10(use_one_hot=use_one_hot, **options)), mt10(**options)
    assert env.task_names == metaworld_task_names("MT10") and env.max_episode_steps == 20
    assert env.observation_space.shape == (49,)
    theirs.reset()  # the adapter resets once, to see whether the goal is hidden
    observations, expected = env.reset(), theirs.reset()[0]
    rng = np.random.default_rng(0)
    for step in range(45):
        np.testing.assert_array_equal(observations[:, :39], expected.astype(np.float32))
        np.testing.assert_array_equal(observations[:, 39:], np.eye(10))
        actions = rng.uniform(-1, 1, (10, 4)).astype(np.float32)
        observations, rewards, dones, infos = env.step(actions)
        expected, their_rewards, _, truncated, their_infos = theirs.step(actions)
        np.testing.assert_array_equal(rewards, their_rewards.astype(np.float32))
        np.testing.assert_array_equal(dones, truncated)
        assert dones.all() == (step % 20 == 19)
        if dones.all():
            for index, info in enumerate(infos):
                last = their_infos["final_obs"][index].astype(np.float32)
                np.testing.assert_array_equal(info["terminal_observation"], [*last, *np.eye(10)[index]])
                assert info["episode"]["l"] == 20 and info["TimeLimit.truncated"] is True
                assert isinstance(info["is_success"], bool)
                assert info["episode"]["r"] == pytest.approx(
                    their_infos["final_info"]["episode"]["r"][index], 1e-5
                )
        else:
            assert [info["success"] for info in infos] == their_infos["success"].tolist()
    env.close()
    theirs.close()


@pytest.mark.usefixtures("few_goals")
def test_async_make_vec_is_accepted():
    envs = ["reach-v3", "push-v3"]
    venv = gym.make_vec("Meta-World/custom-mt-envs", vector_strategy="async", envs_list=envs, seed=1)
    env = make_multitask_env(venv)
    assert env.task_names == ("reach-v3", "push-v3")
    env.reset()
    assert env.step(np.zeros((2, 4), np.float32))[0].shape == (2, 41)
    with pytest.raises(AttributeError):
        env.get_attr("no_such_thing")
    assert env.get_attr("max_path_length") == [500, 500]
    env.close()


@pytest.mark.filterwarnings("ignore:.*precision lowered:UserWarning")
@pytest.mark.usefixtures("few_goals")
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"reward_normalization_method": "exponential"},
            "'reach-v3'.*NormalizeRewardsExponential.*raw rewards",
        ),
        ({"reward_normalization_method": "gymnasium"}, "'reach-v3'.*NormalizeReward.*raw rewards"),
        ({"use_one_hot": True, "normalize_observations": True}, "use_one_hot=False"),
        ({"autoreset_mode": gym.vector.AutoresetMode.NEXT_STEP}, "NEXT_STEP.*SAME_STEP"),
    ],
)
def test_make_vec_with_options_that_spoil_the_method_is_refused(options, words):
    envs = ["reach-v3", "push-v3"]
    venv = gym.make_vec("Meta-World/custom-mt-envs", vector_strategy="sync", envs_list=envs, **options)
    with pytest.raises(ConfigError, match=words):
        make_multitask_env(venv)
    venv.close()


@pytest.mark.usefixtures("few_goals")
def test_make_vec_with_hidden_goals_is_refused():
    venv = gym.make_vec(
        "Meta-World/custom-ml-envs",
        vector_strategy="sync",
        train_envs=["reach-v3"],
        test_envs=["push-v3"],
        meta_batch_size=1,
    )
    with pytest.raises(ConfigError, match="ML1 hides the goal"):
        make_multitask_env(venv)
    venv.close()
