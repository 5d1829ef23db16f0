"""Tests that the fast Meta-World envs give the stock envs' numbers, and leave the stock ones alone."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest

from sb3_ars.envs import make_metaworld_env
from sb3_ars.envs.metaworld import MetaworldTask

pytestmark = pytest.mark.metaworld

metaworld = pytest.importorskip("metaworld")
mujoco = pytest.importorskip("mujoco")
from metaworld.policies import ENV_POLICY_MAP  # noqa: E402
from metaworld.utils import reward_utils  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from sb3_ars.envs import fast_metaworld  # noqa: E402

ALL = metaworld.ALL_V3_ENVIRONMENTS


def stock_env(task, version="v2"):
    return ALL[task](reward_function_version=version)


def set_goal(env, task, rand_vec):
    """Set a stock env to one goal, as the MT benchmarks set it."""
    data = {"rand_vec": rand_vec, "env_cls": ALL[task], "partially_observable": False}
    env.set_task(metaworld._encode_task(task, data))


def model_bytes(model):
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def grasping_actions(task, observations, rng):
    """Yield the scripted policy's actions with some noise, so that hand and objects really touch."""
    policy = ENV_POLICY_MAP[task]()
    while True:
        action = policy.get_action(observations[-1]) + rng.normal(0, 0.1, 4)
        yield np.clip(action, -1, 1).astype(np.float32)


def assert_same_episode(fast, stock, task, n_steps, seed):
    """Reset both, step them with the same actions, and compare all they say and where they end."""
    observations = [fast.reset()[0]]
    set_goal(stock, task, fast.rand_vec)
    np.testing.assert_array_equal(observations[0], stock.reset()[0])
    for action in itertools.islice(
        grasping_actions(task, observations, np.random.default_rng(seed)), n_steps
    ):
        obs, reward, terminated, truncated, info = fast.step(action)
        expected = stock.step(action)
        observations.append(obs)
        np.testing.assert_array_equal(obs, expected[0])
        assert reward == pytest.approx(expected[1], rel=1e-12, abs=1e-12)
        assert (terminated, truncated) == expected[2:4]
        assert info == pytest.approx(expected[4], rel=1e-12, abs=1e-12)
    for name in ("qpos", "qvel", "qacc_warmstart", "mocap_pos", "xpos", "site_xpos"):
        np.testing.assert_array_equal(getattr(fast.sawyer.data, name), getattr(stock.data, name))


@pytest.mark.filterwarnings("ignore:Constant")  # the scripted policies'
@pytest.mark.parametrize("task", list(ALL))
def test_every_task_equals_the_stock_env_while_grasping_and_where_a_reset_is_restored(task):
    fast, stock = MetaworldTask(task, goals="ordered", n_goals=2), stock_env(task)
    for episode in range(3):  # the third goes back to the first goal
        assert_same_episode(fast, stock, task, 90, seed=episode)
        if episode == 1:
            assert len(fast.sawyer._outcomes) == 2
    fast.reset()
    set_goal(stock, task, fast.rand_vec)
    stock.reset()
    fast.reset()
    set_goal(stock, task, fast.rand_vec)
    stock.reset()
    assert len(fast.sawyer._outcomes) == 2
    assert model_bytes(fast.sawyer.model) == model_bytes(stock.model)
    for name in type(fast.sawyer)._assigned & set(vars(stock)):
        np.testing.assert_equal(getattr(fast.sawyer, name), getattr(stock, name), err_msg=name)
    fast.close()
    stock.close()


@pytest.mark.parametrize("task", list(ALL))
def test_every_task_equals_the_stock_env_over_an_episode_of_random_actions_to_a_stored_goal(task):
    fast, stock = (
        MetaworldTask(task, goals="ordered", n_goals=2, first_goal=1, fast=fast) for fast in (True, False)
    )
    np.testing.assert_array_equal(fast.reset(seed=0)[0], stock.reset(seed=0)[0])
    rng = np.random.default_rng(0)
    for _ in range(500):
        action = rng.uniform(-1, 1, 4).astype(np.float32)
        (obs, reward, *_, truncated, info), (same, expected, *_, end, told) = (
            fast.step(action),
            stock.step(action),
        )
        np.testing.assert_allclose(obs, same, rtol=0, atol=1e-9)
        assert reward == pytest.approx(expected, rel=0, abs=1e-9) and info["success"] == told["success"]
    assert truncated and end


@pytest.mark.filterwarnings("ignore:Constant")
@pytest.mark.parametrize(
    "task", ["assembly-v3", "pick-place-v3", "hammer-v3", "lever-pull-v3", "stick-pull-v3"]
)
def test_the_old_rewards_equal_the_stock_ones(task):
    fast = MetaworldTask(task, reward_version="v1")
    fast.reset(seed=0)
    assert_same_episode(fast, stock_env(task, "v1"), task, 120, seed=0)


@pytest.mark.filterwarnings("ignore:Constant")
def test_something_was_really_grasped():
    fast = MetaworldTask("pick-place")
    observations = [fast.reset(seed=0)[0]]
    grasped = []
    for action in itertools.islice(
        grasping_actions("pick-place-v3", observations, np.random.default_rng(0)), 90
    ):
        obs, _, _, _, info = fast.step(action)
        observations.append(obs)
        grasped.append((info["grasp_success"], fast.sawyer.touching_main_object))
    assert (1.0, True) in grasped and (0.0, False) in grasped


@pytest.mark.parametrize("goals", ["random", "ordered"])
def test_what_happens_to_the_data_between_steps_is_noticed(goals):
    envs = [MetaworldTask("push", goals=goals, n_goals=1, fast=fast) for fast in (True, False)]
    seen = []
    for env in envs:
        env.reset(seed=0)
        env.step(np.ones(4, np.float32))
        env.sawyer.data.qpos[9:12] += [0.03, 0.02, 0.05]
        seen.append([env.step(np.ones(4, np.float32))[0] for _ in range(3)])
    np.testing.assert_array_equal(*seen)


def test_an_action_out_of_bounds_or_in_double_precision_moves_the_hand_as_in_the_stock_env():
    envs = [MetaworldTask("reach", fast=fast) for fast in (True, False)]
    for env in envs:
        env.reset(seed=0)
    for action in (np.array([3, -2, 0.3, 1], np.float32), np.array([0.1, 0.7, -0.3, -1])):
        np.testing.assert_array_equal(*[env.step(action)[0] for env in envs])


def test_a_step_too_many_and_an_action_of_another_size_are_refused():
    env = MetaworldTask("reach", max_episode_steps=1)
    env.reset()
    with pytest.raises(ValueError, match="must have 4 elements, got 3"):
        env.step(np.zeros(3, np.float32))
    assert env.step(np.zeros(4, np.float32))[3]
    with pytest.raises(ValueError, match=r"call reset\(\) first"):
        env.step(np.zeros(4, np.float32))


def test_fast_is_the_default_and_can_be_declined():
    for options, is_stock in (({}, False), ({"fast": False}, True)):
        env = make_metaworld_env("reach", n_workers=0, **options)
        sawyer = env.get_attr("sawyer")[0]
        assert (type(sawyer) is ALL["reach-v3"]) == is_stock
        assert isinstance(sawyer, ALL["reach-v3"]) and type(sawyer).__name__ == ALL["reach-v3"].__name__
        env.close()


def test_meta_world_and_numpy_are_unchanged_for_everybody_else():
    spaces = [vars(cls) for cls in ALL["shelf-place-v3"].__mro__] + [
        vars(np),
        vars(np.linalg),
        vars(reward_utils),
        vars(Rotation),
        vars(metaworld.sawyer_xyz_env),
        vars(gym.envs.mujoco.MujocoEnv),
        vars(mujoco.MjData),
    ]
    before = [dict(space) for space in spaces]
    env = MetaworldTask("shelf-place")
    env.reset()
    env.step(np.zeros(4, np.float32))
    for space, kept in zip(spaces, before, strict=True):
        assert {n: v for n, v in space.items() if n in kept} == kept
    seen = ALL["shelf-place-v3"].compute_reward.__globals__
    assert seen["np"] is np and seen["reward_utils"] is reward_utils


# ---------------------------------------------------------------------- the stand-ins


@pytest.mark.parametrize("sigmoid", list(fast_metaworld._SIGMOIDS))
@pytest.mark.parametrize("value", [0.1, 0.35])
def test_tolerance_equals_meta_world_s(sigmoid, value):
    for x in (-1.2, -0.4, 0.0, 0.05, 0.1, 0.11, 0.3, 0.5, 2.0):
        for bounds, margin in (((0, 0.1), 0.4), ((0.1, 0.1), 0.0), ((-math.inf, 0.1), 0.2), ((0, 0.1), 0.01)):
            expected = reward_utils.tolerance(x, bounds, margin, sigmoid, value)
            assert fast_metaworld._tolerance(x, bounds, margin, sigmoid, value) == pytest.approx(
                expected, 1e-14
            )


@pytest.mark.parametrize(
    "arguments",
    [
        (0.3, (0.2, 0.1), 0.1),
        (0.3, (0.0, 0.1), -0.1),
        (0.3, (0.0, 0.1), 0.1, "steep"),
        (0.3, (0.0, 0.1), 0.1, "gaussian", 0.0),
        (0.3, (0.0, 0.1), 0.1, "linear", 1.0),
    ],
)
def test_tolerance_refuses_what_meta_world_s_refuses(arguments):
    for function in (reward_utils.tolerance, fast_metaworld._tolerance):
        with pytest.raises(ValueError):
            function(*arguments)


def test_products_and_prisms_equal_meta_world_s():
    for a, b in itertools.product((0.0, 0.2, 0.97, 1.0), repeat=2):
        expected = reward_utils.hamacher_product(a, b)
        assert fast_metaworld._hamacher_product(a, b) == pytest.approx(expected, 1e-15)
    with pytest.raises(ValueError, match="within"):
        fast_metaworld._hamacher_product(1.2, 0.5)
    zero, one = np.array([0.0, 1.0, 2.0]), np.array([1.0, 0.5, 3.0])
    for point in ([0.5, 0.75, 2.5], [0.5, 1.5, 2.5], [0.0, 1.0, 2.0], [1.0, 0.5, 3.0], [2.0, 0.7, 2.2]):
        expected = reward_utils.rect_prism_tolerance(np.array(point), zero, one)
        assert fast_metaworld._rect_prism_tolerance(np.array(point), zero, one) == pytest.approx(
            expected, 1e-14
        )


def test_quaternions_have_scipy_s_sign():
    turns = [Rotation.random(rng=np.random.default_rng(seed)) for seed in range(300)]
    turns += [
        Rotation.from_euler(axis, angle, degrees=True) for axis in "xyz" for angle in (-179, -90, 0, 90, 180)
    ]
    for turn in turns:
        matrix = turn.as_matrix()
        expected = Rotation.from_matrix(matrix).as_quat()
        np.testing.assert_allclose(
            fast_metaworld._Rotation.from_matrix(matrix).as_quat(), expected, atol=1e-14
        )


def test_norms_and_clips_equal_numpy_s():
    x = np.array([0.3, -0.4, 1.2])
    seen, numpy = fast_metaworld._stand_ins()[id(np)], np
    for arguments in ((x,), (x, 2), (x, 1), (x.astype(np.float32),), (np.outer(x, x),)):
        result, expected = seen.linalg.norm(*arguments), numpy.linalg.norm(*arguments)
        assert result == expected and type(result) is type(expected)
    for value in (-0.5, 0.5, 1.5, np.float32(0.3)):
        assert seen.clip(value, 0.0, 1.0) == numpy.clip(value, 0.0, 1.0)
    np.testing.assert_array_equal(seen.clip(x, a_min=0.0, a_max=1.0), np.clip(x, 0.0, 1.0))
