"""Tests of the point-mass tasks against their published dynamics."""

import math
import timeit

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sb3_ars.envs import make_toy_env
from sb3_ars.envs.toy import PointTask
from sb3_ars.errors import ConfigError


def put(env, x, y, goal_x, goal_y):
    env.reset(seed=0)
    env._state = (x, y, 0.0, 0.0, goal_x, goal_y)


@pytest.mark.parametrize(("quarter", "push"), [(0, (1, 0)), (1, (0, 1)), (2, (-1, 0)), (3, (0, -1))])
def test_the_task_turns_the_push_by_quarter_turns(quarter, push):
    env = PointTask(quarter * math.pi / 2, reward_scale=0.5)
    put(env, 0.0, 0.0, 0.3, 0.4)
    obs, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0], np.float32))
    np.testing.assert_allclose(
        obs, [0.03 * push[0], 0.03 * push[1], 0.3 * push[0], 0.3 * push[1], 0.3, 0.4], atol=1e-7
    )
    distance = math.hypot(0.03 * push[0] - 0.3, 0.03 * push[1] - 0.4)
    assert reward == pytest.approx(0.5 * (1 - math.tanh(3 * distance)))
    assert (terminated, truncated, info) == (False, False, {"success": 0.0})


def test_velocity_is_damped_and_walls_stop_it():
    env = PointTask()
    put(env, 0.98, 0.0, 0.0, 0.0)
    obs = env.step(np.array([1.0, 1.0], np.float32))[0]
    np.testing.assert_allclose(obs[:4], [1.0, 0.03, 0.0, 0.3], atol=1e-7)
    obs = env.step(np.array([0.0, 0.0], np.float32))[0]
    np.testing.assert_allclose(obs[:4], [1.0, 0.051, 0.0, 0.21], atol=1e-7)


def test_success_is_a_distance_below_five_hundredths():
    env = PointTask()
    put(env, 0.0, 0.0, 0.049, 0.0)
    assert env.step(np.zeros(2, np.float32))[4]["success"] == 1.0
    put(env, 0.0, 0.0, 0.051, 0.0)
    assert env.step(np.zeros(2, np.float32))[4]["success"] == 0.0


def test_an_episode_is_truncated_at_the_horizon_and_never_terminates():
    env = PointTask(max_episode_steps=3)
    env.reset(seed=1)
    ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_gymnasium_s_own_checker_accepts_the_env():
    check_env(PointTask(), skip_render_check=True)


def test_a_simple_controller_solves_every_task():
    env = make_toy_env(seed=0, n_envs_per_task=5)
    obs = env.reset()
    turns = 2 * np.pi * env.task_of_env / 4
    for _ in range(50):
        wanted = 4 * (obs[:, 4:6] - obs[:, :2]) - obs[:, 2:4]
        wanted /= np.maximum(1, np.abs(wanted).max(axis=1, keepdims=True))
        cos, sin = np.cos(turns), np.sin(turns)
        actions = np.stack(
            [cos * wanted[:, 0] + sin * wanted[:, 1], cos * wanted[:, 1] - sin * wanted[:, 0]], axis=1
        )
        obs, _, dones, infos = env.step(actions)
    assert dones.all() and all(info["is_success"] and info["success_at_end"] for info in infos)


def test_rewards_scale_with_reward_scales_and_nothing_else():
    rewards = {}
    for scales in [(1.0, 1.0), (10.0, 0.5)]:
        env = make_toy_env(seed=0, reward_scales=scales)
        env.reset()
        rewards[scales] = env.step(np.full((2, 2), 0.5))[1]
    np.testing.assert_allclose(rewards[10.0, 0.5], rewards[1.0, 1.0] * [10.0, 0.5], rtol=1e-6)


def test_tasks_are_named_by_direction_or_angle():
    assert make_toy_env().task_names == ("point-east", "point-north", "point-west", "point-south")
    assert make_toy_env(reward_scales=[1] * 6).task_names[:3] == ("point-0", "point-60", "point-120")


@pytest.mark.parametrize("scales", [(), (1.0, 0.0), (1.0, -1.0), (float("nan"),)])
def test_reward_scales_that_are_not_positive_are_refused(scales):
    with pytest.raises(ConfigError, match="reward_scales must hold"):
        make_toy_env(reward_scales=scales)


def test_a_step_takes_microseconds():
    env = PointTask(max_episode_steps=10**9)
    env.reset(seed=0)
    action = np.array([0.3, -0.2], np.float32)
    assert min(timeit.repeat(lambda: env.step(action), number=1000, repeat=5)) / 1000 < 50e-6
