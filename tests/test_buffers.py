"""The per-task rings: they hold what was added, draw what was written, and take no memory before that."""

import io
import pickle

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_ars import TaskReplayBuffer
from sb3_ars.errors import ConfigError, EnvContractError

OBS_DIM, ACTION_DIM = 3, 2


def make_buffer(task_of_env=(0, 1), buffer_size=5, **kwargs):
    n_tasks = max(task_of_env) + 1
    return TaskReplayBuffer(
        buffer_size,
        spaces.Box(-np.inf, np.inf, (OBS_DIM + n_tasks,), np.float32),
        spaces.Box(-1, 1, (ACTION_DIM,), np.float32),
        "cpu",
        n_envs=len(task_of_env),
        task_of_env=task_of_env,
        task_names=[f"task{i}" for i in range(n_tasks)],
        **{"seed": 0, **kwargs},
    )


def transition(buffer, value):
    """One transition of every env whose numbers all tell the env and the value."""
    tags = value + 100.0 * np.arange(buffer.n_envs, dtype=np.float32)
    one_hot = np.eye(buffer.n_tasks, dtype=np.float32)[buffer.task_of_env]
    obs = np.hstack((np.repeat(tags[:, None], OBS_DIM, axis=1), one_hot))
    infos = [{"terminal_observation": o} for o in obs]
    return (
        obs,
        obs + np.float32(0.5),
        np.zeros((buffer.n_envs, ACTION_DIM)),
        tags,
        np.zeros(buffer.n_envs, bool),
        infos,
    )


def fill(buffer, n, start=0):
    for value in range(start, start + n):
        buffer.add(*transition(buffer, value))
    return buffer


def test_it_is_a_replay_buffer_of_sb3():
    assert isinstance(make_buffer(), ReplayBuffer)


def test_nothing_is_allocated_before_the_first_transition(capsys):
    buffer = make_buffer(buffer_size=10**12, verbose=1)  # 80 TB
    assert buffer.size() == 0 and capsys.readouterr().out == ""


def test_the_size_is_printed_before_allocating(capsys):
    fill(make_buffer(buffer_size=1000, verbose=1), 1)
    assert "2 tasks x 1,000 transitions, 0.00 GB, on cpu" in capsys.readouterr().out


def test_batches_are_task_major_with_equal_rows_and_the_one_hot_put_back():
    batch = fill(make_buffer(task_of_env=(0, 1, 2)), 5).sample(4)
    assert batch.observations.shape == (12, OBS_DIM + 3) and batch.observations.dtype == th.float32
    assert th.equal(batch.observations[:, OBS_DIM:], th.eye(3).repeat_interleave(4, dim=0))
    assert (batch.rewards.flatten() // 100).tolist() == [0] * 4 + [1] * 4 + [2] * 4
    assert th.equal(batch.next_observations[:, :OBS_DIM], batch.observations[:, :OBS_DIM] + 0.5)
    assert batch.rewards.shape == batch.dones.shape == (12, 1)


def test_the_one_hot_is_not_stored():
    buffer = fill(make_buffer(task_of_env=tuple(range(10))), 1)
    assert buffer.observations.shape == (10, 5, OBS_DIM)
    assert buffer.memory_bytes() == 10 * 5 * 4 * (2 * OBS_DIM + ACTION_DIM + 2)


def test_rows_are_drawn_independently_per_task():
    slots = fill(make_buffer(buffer_size=1000), 1000).draw_slots(100)
    assert not th.equal(slots[0], slots[1])


def test_every_written_slot_is_drawn_about_equally_often():
    buffer = fill(make_buffer(buffer_size=50), 30)
    counts = th.bincount(buffer.draw_slots(30_000)[1], minlength=50)
    assert (counts[30:] == 0).all()
    # 30,000 draws over 30 slots: mean 1,000, standard deviation 31
    assert counts[:30].min() > 850 and counts[:30].max() < 1150


@settings(max_examples=40, deadline=None)
@given(
    task_of_env=st.permutations([0, 0, 1, 2, 2, 2]),
    capacity=st.integers(3, 9),
    n_steps=st.integers(1, 25),
)
def test_rings_hold_what_a_list_would_hold(task_of_env, capacity, n_steps):
    buffer = make_buffer(task_of_env=tuple(task_of_env), buffer_size=capacity)
    lists = {0: [], 1: [], 2: []}
    for value in range(n_steps):
        rows = transition(buffer, value)
        buffer.add(*rows)
        for env, task in enumerate(task_of_env):
            lists[task] = [*lists[task], float(rows[3][env])][-capacity:]
    for task, expected in lists.items():
        held = buffer.rewards[task, : buffer.task_size[task], 0]
        assert sorted(held.tolist()) == sorted(expected)
    assert buffer.size() == min(len(held) for held in lists.values())


def test_too_few_rows_are_refused_by_task_name():
    buffer = fill(make_buffer(task_of_env=(0, 0, 1)), 2)
    with pytest.raises(ConfigError, match=r"batch_size=3 .* task1 \(2\)"):
        buffer.sample(3)


def test_a_time_limit_is_not_stored_as_termination():
    buffer = make_buffer(task_of_env=(0, 1, 2))
    obs, next_obs, action, reward, _, infos = transition(buffer, 0)
    infos[1]["TimeLimit.truncated"] = True
    buffer.add(obs, next_obs, action, reward, np.array([False, True, True]), infos)
    assert buffer.dones[:, 0, 0].tolist() == [0.0, 0.0, 1.0]


def test_a_missing_terminal_observation_is_an_error_that_names_the_task():
    buffer = make_buffer()
    rows = transition(buffer, 0)
    with pytest.raises(EnvContractError, match=r"task1.*terminal_observation"):
        buffer.add(*rows[:4], np.array([False, True]), [{}, {}])
    assert buffer.size() == 0


def test_reward_statistics_by_hand():
    buffer = make_buffer()
    for value in (1.0, 2.0, 6.0):
        buffer.add(*transition(buffer, value))
    statistics = buffer.reward_statistics()
    assert statistics.mean.tolist() == [3.0, 103.0]
    assert statistics.std.tolist() == pytest.approx([np.std([1, 2, 6])] * 2)


def test_reward_statistics_of_a_long_ring_do_not_lose_precision():
    buffer = make_buffer(buffer_size=200_000)
    fill(buffer, 1)
    buffer.task_size[:] = 200_000
    buffer.rewards.fill_(0.1)
    assert buffer.reward_statistics().mean.tolist() == pytest.approx([float(np.float32(0.1))] * 2, rel=1e-12)


def test_a_pickled_buffer_continues_as_the_original():
    buffer = fill(make_buffer(buffer_size=8), 11)
    copy = pickle.loads(pickle.dumps(buffer))
    for both in (buffer, copy):
        fill(both, 3, start=20)
    assert th.equal(buffer.rewards, copy.rewards)
    assert th.equal(buffer.sample(6).observations, copy.sample(6).observations)


def test_only_written_rows_are_pickled():
    stream = io.BytesIO()
    pickle.dump(fill(make_buffer(buffer_size=1_000_000), 10), stream)
    assert stream.tell() < 20_000


def test_the_same_seed_draws_the_same_rows_and_leaves_global_generators_alone():
    before = th.get_rng_state(), np.random.get_state()[1].copy()
    first, second = (fill(make_buffer(seed=4), 5).sample(3).rewards for _ in range(2))
    assert th.equal(first, second)
    assert th.equal(before[0], th.get_rng_state()) and (before[1] == np.random.get_state()[1]).all()


def test_a_buffer_that_does_not_fit_is_refused_with_a_size_that_does():
    buffer = make_buffer(buffer_size=10**12)
    with pytest.raises(ConfigError, match=r"do not fit: .* GB are free. Use buffer_size=[\d_]+ "):
        buffer.check_memory()


def test_another_number_of_envs_keeps_what_is_stored():
    buffer = fill(make_buffer(buffer_size=6), 4)
    buffer.set_task_of_env([0, 0, 1, 1])
    buffer.add(*transition(buffer, 7))
    assert sorted(buffer.rewards[0, :6, 0].tolist()) == [0, 1, 2, 3, 7, 107]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"optimize_memory_usage": True}, "optimize_memory_usage"),
        ({"buffer_size": 0}, "buffer_size=0"),
        ({"buffer_size": True}, "buffer_size=True"),
        ({"task_of_env": (0, 2)}, "task_of_env"),
    ],
)
def test_bad_arguments_are_refused_by_name(change, named):
    with pytest.raises(ConfigError, match=named):
        make_buffer(**change)


@pytest.mark.parametrize(
    "space", [spaces.Discrete(4), spaces.Box(0, 255, (4, 4), np.uint8), spaces.Dict(a=spaces.Discrete(2))]
)
def test_spaces_that_are_no_flat_box_are_refused(space):
    with pytest.raises(ConfigError, match="flat Box"):
        TaskReplayBuffer(10, space, spaces.Box(-1, 1, (2,), np.float32))
