"""The per-task rings: they hold what was added, draw what was written, and take no memory before that."""

import copy
import io
import json
import pickle
import random

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_ars import ARSSAC, TaskReplayBuffer, make_toy_env
from sb3_ars.errors import ConfigError, EnvContractError

OBS_DIM, ACTION_DIM = 3, 2


def make_buffer(task_of_env=(0, 1), buffer_size=5, **kwargs):
    n_tasks = max(task_of_env) + 1
    return TaskReplayBuffer(
        buffer_size,
        spaces.Box(-np.inf, np.inf, (OBS_DIM + n_tasks,), np.float32),
        spaces.Box(-1, 1, (ACTION_DIM,), np.float32),
        n_envs=len(task_of_env),
        task_of_env=task_of_env,
        task_names=[f"task{i}" for i in range(n_tasks)],
        **{"seed": 0, "device": "cpu", **kwargs},
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
    again = pickle.loads(pickle.dumps(buffer))
    for both in (buffer, again):
        fill(both, 3, start=20)
    assert th.equal(buffer.rewards, again.rewards)
    assert th.equal(buffer.sample(6).observations, again.sample(6).observations)


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


def test_only_rows_of_active_tasks_are_stored_and_read():
    buffer = fill(make_buffer(task_of_env=(0, 1, 2, 0)), 1)
    buffer.set_active_tasks([2, 0])
    rows = transition(buffer, 1)
    done = np.array([False, True, False, False])  # without a terminal observation: nobody asks for it
    buffer.add(*rows[:4], done, [rows[5][0], {}, *rows[5][2:]])
    assert buffer.task_size.tolist() == [4, 1, 2]
    assert buffer.rewards[0, :4, 0].tolist() == [0, 300, 1, 301] and buffer.rewards[2, :2, 0].tolist() == [
        200,
        201,
    ]
    with pytest.raises(EnvContractError, match=r"task2.*terminal_observation"):
        buffer.add(*rows[:4], ~done, [rows[5][0], {}, {}, rows[5][3]])
    buffer.set_active_tasks(None)
    assert fill(buffer, 1).task_size.tolist() == [5, 2, 3]


def test_other_envs_make_all_tasks_active_again():
    buffer = make_buffer()
    buffer.set_active_tasks([1])
    buffer.set_task_of_env([0, 1, 1])
    assert fill(buffer, 1).task_size.tolist() == [1, 2]


@pytest.mark.parametrize("tasks", [[], [2], [-1], ["task0"]])
def test_active_tasks_that_are_none_of_the_buffers_are_refused(tasks):
    with pytest.raises(ConfigError, match="must be None or some of the task indices 0 to 1"):
        make_buffer().set_active_tasks(tasks)


# ---------------------------------------------------------------- one row per transition, ready for a CUDA graph


def test_the_columns_are_views_of_one_tensor_and_stay_at_their_addresses():
    buffer = fill(make_buffer(), 1)
    columns = [buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards, buffer.dones]
    storage = columns[0].untyped_storage().data_ptr()
    assert {column.untyped_storage().data_ptr() for column in columns} == {storage}
    assert sum(column.shape[2] for column in columns) * 4 * 2 * 5 == buffer.memory_bytes()
    version = buffer.storage_version
    fill(buffer, 20).reset()
    fill(buffer, 5).set_task_of_env([0, 0, 1])
    assert buffer.observations.untyped_storage().data_ptr() == storage and buffer.storage_version == version


def test_draws_are_those_of_float64_uniforms_times_the_sizes():
    buffer = fill(make_buffer(task_of_env=(0, 0, 1), buffer_size=1000), 300)
    generator = th.Generator().manual_seed(buffer.seed)
    for size in (7, 7, 100):
        uniform = th.rand((2, size), generator=generator, dtype=th.float64)
        assert th.equal(buffer.draw_slots(size), (uniform * th.tensor([[600.0], [300.0]])).long())


def test_sampling_reads_sizes_from_a_tensor_that_is_filled_in_place():
    buffer = fill(make_buffer(buffer_size=50), 3)
    sizes = buffer._sizes
    fill(buffer, 30)
    assert buffer._sizes is sizes and sizes.flatten().tolist() == buffer.task_size.tolist() == [33, 33]
    buffer.reset()
    assert buffer._sizes is sizes and sizes.flatten().tolist() == [0, 0]


def test_the_one_hot_rows_are_made_once_per_batch_size():
    buffer = fill(make_buffer(), 5)
    batch = buffer.sample(3)
    kept = buffer._one_hot(3)
    batch.observations[:] = 7.0
    assert buffer._one_hot(3) is kept and th.equal(kept, th.eye(2).repeat_interleave(3, dim=0))


def test_a_batch_holds_no_view_of_the_rings():
    buffer = fill(make_buffer(), 5)
    batch = buffer.sample(5)
    before = buffer._storage.clone()
    for values in batch[:5]:
        values.fill_(9.0)
    assert th.equal(buffer._storage, before)


def test_what_float32_cannot_hold_is_refused_and_not_stored():
    buffer = fill(make_buffer(), 2)
    obs, next_obs, action, reward, done, infos = transition(buffer, 2)
    with pytest.raises(EnvContractError, match=r"task1.*NaN or infinity in rewards"):
        buffer.add(obs, next_obs, action, np.array([0.0, 1e39]), done, infos)
    assert buffer.task_size.tolist() == [2, 2] and buffer.task_pos.tolist() == [2, 2]
    next_obs[0, 0] = np.nan
    with pytest.raises(EnvContractError, match=r"task0.*NaN or infinity in next observations"):
        buffer.add(obs, next_obs, action, reward, done, infos)


def test_more_envs_of_a_task_than_its_ring_has_slots_are_refused():
    with pytest.raises(ConfigError, match="buffer_size=5 must be an integer of at least 6"):
        make_buffer(buffer_size=5).set_task_of_env([0] * 6 + [1])


# ---------------------------------------------------------------- optimize_memory_usage: each frame once, exactly


class Twins:
    """The same transitions in a buffer of each kind, and in plain lists."""

    def __init__(self, task_of_env, buffer_size):
        self.buffers = [
            make_buffer(task_of_env, buffer_size, optimize_memory_usage=optimize)
            for optimize in (False, True)
        ]
        self.last = None  # what each env saw last, as a well-behaved loop gives it to the next add
        self.active = None
        self.rings = [[None] * buffer_size for _ in range(max(task_of_env) + 1)]
        self.pos = [0] * len(self.rings)

    def set_active(self, tasks):
        self.active = tasks
        for buffer in self.buffers:
            buffer.set_active_tasks(tasks)

    def step(self, rng, strange):
        plain = self.buffers[0]
        waits = np.zeros(plain.n_envs, bool)
        if self.active is not None:
            waits = ~np.isin(plain.task_of_env, self.active)
        n, one_hot = plain.n_envs, np.eye(plain.n_tasks, dtype=np.float32)[plain.task_of_env]
        # few values, so that frames are often equal by chance, and -0.0, which equals 0.0 with other bits
        frames = rng.choice(np.array([0.0, -0.0, 1.0], np.float32), size=(3, n, OBS_DIM))
        obs = frames[0] if self.last is None else np.where(rng.random((n, 1)) < strange, frames[0], self.last)
        done = rng.random(n) < rng.choice([0.0, 0.3, 1.0])
        infos = [
            {"terminal_observation": 1, "TimeLimit.truncated": bool(rng.random() < 0.5)} for _ in range(n)
        ]
        infos = [{} if wait else info for wait, info in zip(waits, infos, strict=True)]
        reward, action = rng.normal(size=n), rng.uniform(-1, 1, (n, ACTION_DIM))
        for buffer in self.buffers:
            full = [np.hstack((f, one_hot)) for f in (obs, frames[1])]
            buffer.add(*full, action, reward, done, infos)
        self.last = np.where(waits[:, None], obs, np.where(done[:, None], frames[2], frames[1]))
        for env, task in enumerate(plain.task_of_env):
            if waits[env]:
                continue
            dones = float(done[env] and not infos[env]["TimeLimit.truncated"])
            row = np.hstack(
                (obs[env], one_hot[env], frames[1][env], one_hot[env], action[env], reward[env], dones)
            )
            ring = self.rings[task]
            ring[self.pos[task]] = row.astype(np.float32)
            self.pos[task] = (self.pos[task] + 1) % len(ring)

    def check(self):
        plain, optimized = self.buffers
        assert plain.task_size.tolist() == optimized.task_size.tolist()
        if plain.size() == 0:
            return
        for batches in (
            [b.sample(min(4, plain.size())) for b in self.buffers],
            [all_rows(b) for b in self.buffers],
        ):
            for ours, theirs in zip(*(batch[:5] for batch in batches), strict=True):
                assert th.equal(ours.contiguous().view(th.int32), theirs.contiguous().view(th.int32))
        batch, rings = all_rows(optimized), list(zip(self.rings, plain.task_size, strict=True))
        held = th.cat((batch[0], batch[2], batch[1], batch[4], batch[3]), dim=1).numpy()
        lists = np.stack(
            [ring[min(slot, size - 1)] for ring, size in rings for slot in range(plain.task_size.max())]
        )
        assert (held.view(np.int32) == lists.view(np.int32)).all()


def all_rows(buffer):
    """What each ring holds, slot by slot; a shorter one's newest slot is repeated."""
    sizes = th.from_numpy(buffer.task_size).unsqueeze(1)
    return buffer.gather(th.minimum(th.arange(int(sizes.max())).expand(buffer.n_tasks, -1), sizes - 1))


def through_a_file(buffer):
    file = io.BytesIO()
    buffer.write_to(file)
    file.seek(0)
    fresh = make_buffer(
        tuple(buffer.task_of_env.tolist()),
        buffer.buffer_size,
        optimize_memory_usage=buffer.optimize_memory_usage,
        seed=5,
    )
    fresh.read_from(file)
    fresh.set_active_tasks(buffer.task_of_env[buffer._env_of_row])  # a file holds rows, not who collects them
    return fresh


ENVS = [[0, 1], [0, 0, 1], [1, 0, 1, 1, 0], [1, 0], [0, 1, 1]]


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    capacity=st.integers(3, 11),
    first_envs=st.sampled_from(ENVS),
    operations=st.lists(
        st.sampled_from(["steps", "strange steps", "reset", "envs", "active", "pickle", "deepcopy", "file"]),
        max_size=12,
    ),
)
def test_storing_each_frame_once_gives_the_same_batches_to_the_bit(seed, capacity, first_envs, operations):
    rng = np.random.default_rng(seed)
    twins = Twins(first_envs, capacity)
    for operation in ["steps", *operations]:
        if operation == "reset":
            for buffer in twins.buffers:
                buffer.reset()
            twins.pos = [0] * len(twins.rings)
        elif operation == "envs":
            task_of_env = ENVS[rng.integers(len(ENVS))]
            for buffer in twins.buffers:
                buffer.set_task_of_env(task_of_env)
            twins.active = None
            if twins.last is not None and (rng.random() < 0.5 or len(task_of_env) != len(twins.last)):
                twins.last = (
                    None  # the new envs were reset; else their frames go on where the old ones' ended
                )
        elif operation == "active":
            twins.set_active([None, [0], [1], [1, 0]][rng.integers(4)])
        elif operation in ("steps", "strange steps"):
            for _ in range(rng.integers(1, 9)):
                twins.step(rng, strange=0.3 if operation == "strange steps" else 0.0)
                twins.check()
        else:
            again = {
                "pickle": lambda b: pickle.loads(pickle.dumps(b)),
                "deepcopy": copy.deepcopy,
                "file": through_a_file,
            }[operation]
            twins.buffers = [again(buffer) for buffer in twins.buffers]
        twins.check()


def long_run(horizon, n_steps, buffer_size, restarts=()):
    """An optimizing buffer of two tasks fed by well-behaved episodes of one length."""
    buffer = make_buffer(buffer_size=buffer_size, optimize_memory_usage=True)
    one_hot, zeros = np.eye(2, dtype=np.float32), np.zeros((2, ACTION_DIM))
    rng = np.random.default_rng(0)
    obs = rng.normal(size=(2, OBS_DIM))
    for step in range(n_steps):
        if step in restarts:
            obs = rng.normal(size=(2, OBS_DIM))
        next_obs, done = rng.normal(size=(2, OBS_DIM)), np.full(2, (step + 1) % horizon == 0)
        rows = [np.hstack((frame, one_hot)) for frame in (obs, next_obs)]
        buffer.add(*rows, zeros, np.zeros(2), done, [{"terminal_observation": next_obs[0]}] * 2)
        obs = rng.normal(size=(2, OBS_DIM)) if done[0] else next_obs
    return buffer


def test_only_ends_of_episodes_and_the_newest_frames_take_rows_of_the_table():
    buffer = long_run(horizon=10, n_steps=95, buffer_size=1000)
    assert buffer._frames.n_used() == 2 * 9 + 2
    assert long_run(10, 95, 1000, restarts=(13, 57))._frames.n_used() == 2 * (9 + 2) + 2


def test_rows_of_the_table_are_used_again_once_their_slots_are_overwritten():
    buffer = long_run(horizon=10, n_steps=5000, buffer_size=100)
    assert buffer._frames.n_used() <= 2 * 11 + 2


def test_a_table_that_grows_says_so_and_keeps_its_frames():
    buffer = make_buffer(buffer_size=1000, optimize_memory_usage=True)
    fill(buffer, 1)
    held, version = len(buffer._frames.table), buffer.storage_version
    fill(
        buffer, held // 2 - 1, start=1
    )  # each transition of fill's is an end: its next frame is nobody's observation
    assert buffer.storage_version == version and len(buffer._frames.table) == held
    fill(buffer, 1, start=held // 2)
    assert buffer.storage_version == version + 1 and len(buffer._frames.table) == 2 * held
    batch = all_rows(buffer)
    assert th.equal(batch.next_observations[:, :OBS_DIM], batch.observations[:, :OBS_DIM] + 0.5)


def test_an_optimizing_buffer_reports_what_it_takes():
    buffer = long_run(horizon=10, n_steps=10, buffer_size=1000)
    tensors = [buffer._storage, buffer._frames.table]
    assert buffer.memory_bytes() == sum(tensor.nbytes for tensor in tensors)
    assert make_buffer(buffer_size=1000, optimize_memory_usage=True).memory_bytes() == buffer.memory_bytes()
    assert not hasattr(buffer, "next_observations")


# ---------------------------------------------------------------- files


def saved(buffer):
    file = io.BytesIO()
    buffer.write_to(file)
    return file.getvalue()


KINDS = pytest.mark.parametrize("optimize", [False, True])


@KINDS
def test_a_buffer_read_from_a_file_continues_as_the_original(optimize):
    buffer = fill(
        make_buffer(buffer_size=8, optimize_memory_usage=optimize, handle_timeout_termination=False), 11
    )
    buffer.sample(3)
    again = make_buffer(buffer_size=8, optimize_memory_usage=optimize, seed=9)
    again.read_from(io.BytesIO(saved(buffer)))
    for both in (buffer, again):
        fill(both, 3, start=20)
    assert again.seed == buffer.seed and not again.handle_timeout_termination
    for a, b in zip(buffer.sample(6)[:5], again.sample(6)[:5], strict=True):
        assert th.equal(a, b)


@KINDS
def test_a_file_holds_a_header_and_the_written_rows_alone(optimize):
    buffer = fill(make_buffer(buffer_size=1_000_000, optimize_memory_usage=optimize), 10)
    header = len(saved(make_buffer(buffer_size=1_000_000, optimize_memory_usage=optimize)))
    frames = 2 * 10 * 4 * OBS_DIM if optimize else 0
    assert 0 <= len(saved(buffer)) - header - 2 * 10 * 4 * buffer._row_width - frames < 10


def test_reading_into_a_buffer_of_the_same_size_moves_nothing():
    buffer = fill(make_buffer(), 3)
    address, version = buffer._storage.data_ptr(), buffer.storage_version
    buffer.read_from(io.BytesIO(saved(fill(make_buffer(seed=3), 9))))
    assert (buffer._storage.data_ptr(), buffer.storage_version) == (address, version)
    assert buffer.task_size.tolist() == buffer._sizes.flatten().tolist() == [5, 5]


def test_a_file_of_another_buffer_size_brings_its_own():
    buffer = fill(make_buffer(), 3)
    version = buffer.storage_version
    buffer.read_from(io.BytesIO(saved(fill(make_buffer(buffer_size=7), 9))))
    assert (
        buffer.buffer_size == 7 and buffer.task_size.tolist() == [7, 7] and buffer.storage_version > version
    )
    fill(buffer, 7, start=40)
    assert sorted(buffer.rewards[0, :, 0].tolist()) == [40, 41, 42, 43, 44, 45, 46]


def refused_file(change):
    """Bytes that a buffer of two tasks, holding three rows each, must refuse."""
    good = saved(fill(make_buffer(), 3))
    return {
        "empty": lambda: b"",
        "text": lambda: b"hello, this is text and nothing else",
        "pickle": lambda: pickle.dumps({"not": "a buffer"}),
        "header cut off": lambda: good[:60],
        "rows cut off": lambda: good[:-1],
        "header damaged": lambda: good.replace(b'"task_size": [3, 3]', b'"task_size": [9, 3]'),
        "other tasks": lambda: good.replace(b"task1", b"taskA"),
        "other shapes": lambda: good.replace(b'"observation_shape": [5]', b'"observation_shape": [6]'),
        "other mode": lambda: saved(fill(make_buffer(optimize_memory_usage=True), 3)),
    }[change]()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("empty", "is no replay buffer"),
        ("text", "is no replay buffer"),
        ("pickle", "is a pickle, as SB3's own replay buffer and earlier versions"),
        ("header cut off", "cut off or damaged within its first lines"),
        ("rows cut off", "was cut off: 1 bytes are missing at its end"),
        ("header damaged", r"\[9, 3\] of 5 slots"),
        ("other tasks", r"holds the tasks \['task0', 'taskA'\], this model has \['task0', 'task1'\]"),
        ("other shapes", r"shapes \(\(6,\), \(2,\)\), this model has \(5,\) and \(2,\)"),
        ("other mode", "saved with optimize_memory_usage=True, this model has False"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_and_nothing_is_lost(change, message):
    buffer = fill(make_buffer(seed=1), 4)
    before = pickle.dumps(buffer)
    with pytest.raises(ConfigError, match=message):
        buffer.read_from(io.BytesIO(refused_file(change)))
    assert pickle.dumps(buffer) == before


def with_header(content, **changes):
    """A saved buffer with something else in its header; what is no mapping takes the header's place."""
    start = content.index(b"\n") + 1
    end = start + 8 + int.from_bytes(content[start : start + 8], "little")
    header = json.loads(content[start + 8 : end]) | changes
    text = json.dumps(changes.get("instead", header)).encode()
    return content[:start] + len(text).to_bytes(8, "little") + text + content[end:]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"instead": []}, "damaged within its first lines"),
        ({"instead": "text"}, "damaged within its first lines"),
        ({"more": 1}, "damaged within its first lines .*unexpected keyword argument 'more'"),
        ({"task_names": 2}, r"task_names is no list\[str\]"),
        ({"observation_shape": 5}, r"observation_shape is no list\[int\]"),
        ({"action_shape": [2.0]}, r"action_shape is no list\[int\]"),
        ({"task_size": [True, 3]}, r"task_size is no list\[int\]"),
        ({"task_size": [3]}, "damaged within its first lines"),
        ({"task_pos": [3, 4]}, r"\[3, 3\] of 5 slots, at \[3, 4\]"),
        ({"task_pos": [3, -1]}, r"at \[3, -1\]"),
        ({"optimize_memory_usage": 0}, "optimize_memory_usage is no bool"),
        ({"handle_timeout_termination": "no"}, "handle_timeout_termination is no bool"),
        ({"buffer_size": 5.0}, "buffer_size is no int"),
        ({"buffer_size": None}, "buffer_size is no int"),
        (
            {"buffer_size": 10**15},
            r"has buffer_size=1_000_000_000_000_000, which takes .* GB, but the device has",
        ),
        ({"n_frames": -1}, "-1 frames"),
        ({"n_frames": 1}, "1 frames"),
        ({"seed": "1"}, "seed is no int"),
        ({"seed": 2**64}, "a seed of 18446744073709551616"),
        ({"seed": -1}, "a seed of -1"),
        ({"generator_device": 0}, "generator_device is no str"),
        ({"generator_state": [1, 2]}, "generator_state is no str"),
        ({"generator_state": "x"}, "is damaged: generator_state is none of a generator"),
        ({"generator_state": "\u2603"}, "is damaged: generator_state is none of a generator"),
        ({"generator_state": "AAAA"}, "is damaged: generator_state is none of a generator"),
        ({"generator_state": "A" * 6744}, "is damaged: generator_state is none of a generator"),
        (
            {"generator_state": "A" * 6742 + "=="},
            "is damaged: generator_state is none .*nvalid mt19937 state",
        ),
    ],
)
def test_a_header_that_lies_is_refused_and_nothing_is_lost(changes, message):
    buffer = fill(make_buffer(seed=1), 4)
    before = pickle.dumps(buffer)
    for kind in (io.BytesIO, Pipe):
        with pytest.raises(ConfigError, match=message):
            buffer.read_from(kind(with_header(saved(fill(make_buffer(), 3)), **changes)))
        assert pickle.dumps(buffer) == before


@pytest.mark.parametrize("length", [2**20 + 1, 2**40, 2**63 - 1, 2**64 - 1])
def test_a_header_that_would_be_huge_is_not_read(length):
    content = saved(fill(make_buffer(), 3))
    start = content.index(b"\n") + 1
    file = io.BytesIO(content[:start] + length.to_bytes(8, "little") + b"[" * 2**21)
    with pytest.raises(ConfigError, match=f"a header of {length:,} bytes"):
        make_buffer().read_from(file)
    assert file.tell() == start + 8


def test_a_header_nested_without_end_is_refused():
    start = saved(make_buffer()).index(b"\n") + 1
    content = saved(make_buffer())[:start] + (10**5).to_bytes(8, "little") + b"[" * 10**5
    with pytest.raises(ConfigError, match="damaged within its first lines"):
        make_buffer().read_from(io.BytesIO(content))


@KINDS
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_numbers_that_no_buffer_stores_are_not_read(optimize, value):
    good = saved(fill(make_buffer(optimize_memory_usage=optimize), 3))
    row = 4 * make_buffer(optimize_memory_usage=optimize)._row_width
    first_row = len(good) - 2 * 3 * row - (2 * 3 * 4 * OBS_DIM if optimize else 0)
    places = [first_row, first_row + row + 4, *([len(good) - 4] if optimize else [])]  # the last is a frame's
    for place in places:
        bad = bytearray(good)
        bad[place : place + 4] = np.float32(value).tobytes()
        buffer = fill(make_buffer(optimize_memory_usage=optimize), 4)
        with pytest.raises(ConfigError, match="is damaged: it holds NaN or infinity"):
            buffer.read_from(io.BytesIO(bad))
        assert buffer.task_size.tolist() == [0, 0]
        assert fill(buffer, 2).task_size.tolist() == [2, 2]


def test_a_ring_that_memory_has_no_room_for_leaves_an_empty_buffer(monkeypatch):
    monkeypatch.setattr(
        TaskReplayBuffer, "_total_memory", lambda _: 10**30
    )  # as it would be on a larger machine
    buffer = fill(make_buffer(), 4)
    with pytest.raises(ConfigError, match=r"cannot be held .*; this one is now empty"):
        buffer.read_from(io.BytesIO(with_header(saved(fill(make_buffer(), 3)), buffer_size=10**15)))
    assert buffer.task_size.tolist() == [0, 0]


HOSTILE = (
    None,
    True,
    -1,
    0,
    1,
    3,
    2**31,
    10**12,
    2**63,
    0.5,
    "",
    "A",
    "\ud800",
    [],
    {},
    [1],
    [3, 3],
    ["a"],
    [[3]],
)


def mutated(content, draw):
    """A saved buffer with some bits, bytes or parts of its header changed."""
    start = content.index(b"\n") + 1
    end = start + 8 + int.from_bytes(content[start : start + 8], "little")
    at, how = (
        draw.choice((draw.randrange(len(content)), draw.randrange(end, len(content)))),
        draw.randrange(8),
    )
    if how == 0:
        return content[:at]
    if how == 1:
        return content[:at] + draw.randbytes(draw.choice((1, 8, 300))) + content[at:]
    if how == 2:
        return content[:start] + draw.randbytes(8) + content[start + 8 :]
    if how <= 4:
        changed = bytearray(content)
        for _ in range(draw.choice((1, 2, 30))):
            changed[draw.randrange(end) if how == 3 else draw.randrange(end, len(content))] ^= (
                1 << draw.randrange(8)
            )
        return bytes(changed)
    if how == 5:  # what read as a number is NaN
        return content[:at] + b"\xff" * 8 + content[at + 8 :]
    header = json.loads(content[start + 8 : end])
    return with_header(content, **{draw.choice([*header]): draw.choice(HOSTILE)})


@KINDS
def test_mutated_files_are_refused_or_read_and_leave_a_whole_buffer(optimize):
    content = saved(fill(make_buffer(optimize_memory_usage=optimize), 4))
    refused = emptied = 0
    for index in range(1000):
        draw = random.Random(index)
        buffer = fill(make_buffer(optimize_memory_usage=optimize, seed=1), 3)
        before = pickle.dumps(buffer)
        kind = draw.choice((io.BytesIO, Pipe))
        try:
            buffer.read_from(kind(mutated(content, draw)))
        except ConfigError:
            refused += 1
            if pickle.dumps(buffer) != before:
                assert buffer.task_size.tolist() == [0, 0], index
                emptied += 1
        except BaseException as error:
            raise AssertionError(f"file {index}: {type(error).__name__} {error}") from error
        fill(buffer, 2)
        assert all(th.isfinite(part).all() for part in buffer.sample(2)[:5]), index
    assert 600 < refused < 950 and 50 < emptied < 400, (refused, emptied)


class Pipe(io.BytesIO):
    """Bytes whose end is not known in advance."""

    def seekable(self):
        return False


def test_a_stream_that_ends_too_early_leaves_an_empty_buffer_not_a_mixed_one():
    buffer = fill(make_buffer(), 4)
    with pytest.raises(ConfigError, match="ended too early; the replay buffer is now empty"):
        buffer.read_from(Pipe(refused_file("rows cut off")))
    assert buffer.task_size.tolist() == [0, 0]
    buffer.read_from(Pipe(saved(fill(make_buffer(), 3))))
    assert buffer.task_size.tolist() == [3, 3]


def test_a_file_with_pointers_to_nowhere_is_refused():
    good = bytearray(saved(fill(make_buffer(optimize_memory_usage=True), 3)))
    width = 4 * (OBS_DIM + ACTION_DIM + 3)
    first_pointer = len(good) - 2 * 3 * 4 * OBS_DIM - 2 * 3 * width + width - 4
    assert int.from_bytes(good[first_pointer : first_pointer + 4], "little") == 0
    for pointer in (6, -3):  # six frames; two slots after the first one
        good[first_pointer : first_pointer + 4] = pointer.to_bytes(4, "little", signed=True)
        buffer = make_buffer(optimize_memory_usage=True)
        with pytest.raises(ConfigError, match="is damaged: a frame it points to is not there"):
            buffer.read_from(io.BytesIO(good))
        assert buffer.size() == 0


def test_a_pickle_of_an_earlier_version_is_refused_by_name():
    buffer = fill(make_buffer(), 3)
    state = {"task_names": buffer.task_names, "observations": buffer.observations.numpy(), "_device": "cpu"}
    with pytest.raises(ConfigError, match="earlier version"):
        TaskReplayBuffer.__new__(TaskReplayBuffer).__setstate__(state)


class Shouting(io.BytesIO):
    """Notes the largest piece it is given."""

    largest = 0

    def write(self, data):
        self.largest = max(self.largest, len(data))
        return super().write(data)


def test_writing_takes_the_rows_from_memory_in_pieces(monkeypatch):
    monkeypatch.setattr("sb3_ars.buffers._CHUNK_BYTES", 1000)
    buffer = fill(make_buffer(buffer_size=500), 400)
    file = Shouting()
    buffer.write_to(file)
    assert file.largest < 8000  # the header
    file.seek(0)
    again = make_buffer(buffer_size=500)
    again.read_from(file)
    assert th.equal(again.observations[:, :400], buffer.observations[:, :400])


# ---------------------------------------------------------------- in a model


def toy_model(env=None, **options):
    small = {"policy_kwargs": {"net_arch": [16]}, "batch_size": 8, "buffer_size": 40, "n_reset": 0, "seed": 0}
    return ARSSAC("MlpPolicy", env or make_toy_env(seed=0), **{**small, **options})


def test_a_model_learns_the_same_to_the_bit_with_each_frame_stored_once():
    # 100 steps of each env: two episodes, twice round the ring; the second call resets the envs in mid-episode
    models = [toy_model(optimize_memory_usage=optimize).learn(280).learn(120) for optimize in (False, True)]
    plain, optimized = (model.policy.state_dict() for model in models)
    assert all(th.equal(values, optimized[name]) for name, values in plain.items())
    assert models[1].replay_buffer.optimize_memory_usage and models[1]._n_updates > 0


def test_sb3_itself_warns_of_its_memory_saving_buffer_and_changes_it():
    # once it does not, TaskReplayBuffer._count_as_sb3 need not pass as empty
    model = SAC(
        "MlpPolicy",
        "Pendulum-v1",
        optimize_memory_usage=True,
        replay_buffer_kwargs={"handle_timeout_termination": False},
        buffer_size=100,
        device="cpu",
    ).learn(5)
    with pytest.warns(UserWarning, match="last trajectory in the replay buffer will be truncated"):
        model.learn(1)


@KINDS
def test_a_models_buffer_is_read_into_place(optimize, tmp_path):
    model = toy_model(optimize_memory_usage=optimize).learn(280)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    assert (tmp_path / "buffer.pkl").exists()
    loaded = ARSSAC.load(tmp_path / "model", env=make_toy_env(seed=0, n_envs_per_task=2))
    buffer = loaded.replay_buffer
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer is buffer and buffer.n_envs == 8
    for a, b in zip(model.replay_buffer.sample(20)[:5], buffer.sample(20)[:5], strict=True):
        assert th.equal(a, b)
    loaded.learn(80, reset_num_timesteps=False)
    assert buffer.task_size.tolist() == [40] * 4


def test_an_empty_buffer_can_be_saved_and_loaded(tmp_path):
    toy_model().save_replay_buffer(tmp_path / "buffer")
    model = toy_model()
    model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.size() == 0 and model.replay_buffer._storage is None


def test_a_buffer_of_tasks_and_one_of_a_plain_environment_are_not_mistaken_for_each_other(tmp_path):
    tasks, plain = toy_model().learn(40), toy_model("Pendulum-v1").learn(40)
    tasks.save_replay_buffer(tmp_path / "tasks")
    plain.save_replay_buffer(tmp_path / "plain")
    for model, file, message in (
        (tasks, "plain", "plain.pkl is a pickle, as SB3's own replay buffer"),
        (plain, "tasks", "tasks is no pickled replay buffer of a plain environment"),
    ):
        kept = model.replay_buffer
        with pytest.raises(ConfigError, match=message):
            model.load_replay_buffer(tmp_path / file)
        assert model.replay_buffer is kept and kept.size() == (10 if model is tasks else 40)


def test_a_cut_off_file_leaves_the_models_buffer_as_it_was(tmp_path):
    model = toy_model().learn(80)
    model.save_replay_buffer(tmp_path / "buffer")
    whole = (tmp_path / "buffer.pkl").read_bytes()
    (tmp_path / "buffer.pkl").write_bytes(whole[:-100])
    before = pickle.dumps(model.replay_buffer)
    with pytest.raises(ConfigError, match=r"buffer\.pkl was cut off: 100 bytes are missing"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert pickle.dumps(model.replay_buffer) == before


@pytest.mark.parametrize("benchmark", ["MT10", "MT50"])
def test_the_memory_is_the_share_of_sb3s_that_was_promised(benchmark):
    from benchmarks import memory

    measured = memory.buffers_of(benchmark, small=2 * memory.HORIZON)
    for name, share in memory.AT_MOST[benchmark].items():
        assert measured[name]["share_of_sb3"] <= share
    n_tasks, rows = memory.PAPER[benchmark]
    for name in ("ours", "optimized"):
        planned = memory.make_buffer(name, n_tasks, rows).memory_bytes() / 1e9
        assert measured[name]["total_gb"] == pytest.approx(planned, rel=0.02)


# ---------------------------------------------------------------- on a GPU


def random_steps(buffers, n_steps, seed=0):
    """Add the same episodes of 7 steps to each buffer, without waiting for a device."""
    rng = np.random.default_rng(seed)
    n, one_hot = buffers[0].n_envs, np.eye(buffers[0].n_tasks)[buffers[0].task_of_env]
    obs = rng.normal(size=(n, OBS_DIM))
    for step in range(n_steps):
        next_obs, done = rng.normal(size=(n, OBS_DIM)), np.full(n, step % 7 == 6)
        rows = [np.hstack((frame, one_hot)) for frame in (obs, next_obs)]
        action, reward = rng.uniform(-1, 1, (n, ACTION_DIM)), rng.normal(size=n)
        for buffer in buffers:
            buffer.add(*rows, action, reward, done, [{"terminal_observation": next_obs[0]}] * n)
        obs = rng.normal(size=(n, OBS_DIM)) if done[0] else next_obs


def assert_equal_rows(a, b):
    for ours, theirs in zip(all_rows_on(a), all_rows_on(b), strict=True):
        assert th.equal(ours, theirs)


def all_rows_on(buffer):
    slots = th.arange(buffer.size(), device=buffer.device).expand(buffer.n_tasks, -1)
    return [values.cpu() for values in buffer.gather(slots)[:5]]


@pytest.mark.gpu
@KINDS
def test_a_gpu_busy_with_other_work_stores_what_the_cpu_stores(optimize):
    cpu, cuda = (
        make_buffer((0, 1, 1), 60, optimize_memory_usage=optimize, device=device)
        for device in ("cpu", "cuda")
    )
    work = th.rand(4000, 4000, device="cuda")
    for round_, tasks in enumerate([None, [1], [0], None, [0, 1]]):
        for buffer in (cpu, cuda):
            buffer.set_active_tasks(tasks)
        for _ in range(20):  # keeps the stream far behind the host, so that copies are late
            work = work @ work / work.norm()
        random_steps([cpu, cuda], 30, seed=round_)
    assert cuda._sizes.flatten().tolist() == cpu.task_size.tolist()
    assert_equal_rows(cpu, cuda)


@pytest.mark.gpu
@KINDS
def test_a_captured_sample_sees_new_rows_and_sizes_until_the_storage_moves(optimize):
    buffer = make_buffer((0, 1), 20_000, optimize_memory_usage=optimize, device="cuda")
    random_steps([buffer], 20)
    version = buffer.storage_version
    for _ in range(3):
        buffer.sample(64)
    graph = th.cuda.CUDAGraph()
    graph.register_generator_state(buffer.generator)
    th.cuda.synchronize()
    with th.cuda.graph(graph):
        slots = buffer.draw_slots(64)
        batch = buffer.gather(slots)
    for _ in range(10):
        random_steps([buffer], 13)
        assert buffer.storage_version == version  # the table has room for so few ends
        graph.replay()
        assert slots.max() < buffer.size()
        for captured, eager in zip(batch[:5], buffer.gather(slots)[:5], strict=True):
            assert th.equal(captured, eager)
    assert slots.max() > 20


@pytest.mark.gpu
@KINDS
def test_a_gpus_buffer_goes_through_files_pickles_and_other_devices(optimize, monkeypatch):
    monkeypatch.setattr("sb3_ars.buffers._CHUNK_BYTES", 500)
    cuda = make_buffer((0, 1), 60, optimize_memory_usage=optimize, device="cuda")
    random_steps([cuda], 80)
    file = saved(cuda)
    for device in ("cpu", "cuda"):
        read = make_buffer((0, 1), 60, optimize_memory_usage=optimize, device=device)
        read.read_from(io.BytesIO(file))
        assert_equal_rows(cuda, read)
    assert th.equal(cuda.draw_slots(8), read.draw_slots(8))
    moved = pickle.loads(pickle.dumps(cuda))
    assert_equal_rows(cuda, moved)
    version, moved.device = moved.storage_version, "cpu"
    assert moved.storage_version > version and moved.observations.device.type == "cpu"
    assert_equal_rows(cuda, moved)
    random_steps([cuda, moved], 30)
    assert_equal_rows(cuda, moved)
