"""With one task, c = 1 and no reset, ours is SB3's SAC and sb3-contrib's TQC, to the bit."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_ars import ARSSAC, ARSTQC, TaskReplayBuffer, make_multitask_env
from sb3_ars.envs.toy import PointTask

OPTIONS = {
    "policy_kwargs": {"net_arch": [32, 32], "activation_fn": nn.ReLU},
    "seed": 5,
    "batch_size": 32,
    "buffer_size": 1000,
    "device": "cpu",
}
PAIRS = pytest.mark.parametrize(("theirs", "ours"), [(SAC, ARSSAC), (TQC, ARSTQC)])


def assert_same_learner(a, b):
    for (name, p), q in zip(a.policy.named_parameters(), b.policy.parameters(), strict=True):
        assert th.equal(p, q), f"{name} differs by {(p - q).abs().max()}"
    assert th.equal(a.log_ent_coef, b.log_ent_coef)
    for optimizer in ("actor", "critic"):
        theirs = getattr(a, optimizer).optimizer.state_dict()["state"]
        ours = getattr(b, optimizer).optimizer.state_dict()["state"]
        assert theirs.keys() == ours.keys()
        assert all(th.equal(theirs[i][k], ours[i][k]) for i in theirs for k in theirs[i])


def fill(buffer, rng, n=200):
    for _ in range(n):
        obs, next_obs = rng.normal(size=(2, 1, 3)).astype(np.float32)
        action = rng.uniform(-1, 1, size=(1, 1)).astype(np.float32)
        buffer.add(obs, next_obs, action, rng.normal(size=1), np.array([rng.random() < 0.1]), [{}])


@PAIRS
def test_updates_on_the_same_batches_and_noise_are_equal_to_the_bit(theirs, ours):
    a, b = theirs("MlpPolicy", "Pendulum-v1", **OPTIONS), ours("MlpPolicy", "Pendulum-v1", **OPTIONS)
    for model in (a, b):
        fill(model.replay_buffer, np.random.default_rng(0))
        model.set_logger(Logger(None, []))
        np.random.seed(1)  # SB3's buffer samples from the global generator
        th.manual_seed(2)
        model.train(gradient_steps=5, batch_size=32)
    assert_same_learner(a, b)


@PAIRS
def test_a_short_learn_is_equal_to_the_bit(theirs, ours):
    options = {**OPTIONS, "learning_starts": 50}
    a = theirs("MlpPolicy", "Pendulum-v1", **options).learn(250)
    b = ours("MlpPolicy", "Pendulum-v1", **options).learn(250)
    assert a._n_updates == b._n_updates == 200
    assert_same_learner(a, b)
    assert np.array_equal(a.replay_buffer.observations, b.replay_buffer.observations)


class SB3Sampler(TaskReplayBuffer):
    """Our buffer of one task, drawing slots as SB3's buffer draws them."""

    def draw_slots(self, batch_size):
        slots = np.random.randint(0, self.size(), size=batch_size)
        np.random.randint(0, high=1, size=batch_size)  # the env index
        return th.as_tensor(slots)[None]


@PAIRS
def test_the_task_buffer_gives_the_same_learner_with_sb3s_sampler_swapped_in(theirs, ours):
    def env():
        return make_multitask_env({"point": PointTask}, seed=3, n_workers=0)

    options = {**OPTIONS, "learning_starts": 50}
    a = theirs("MlpPolicy", env(), **options).learn(250)
    options["execution"] = "eager"
    b = ours("MlpPolicy", env(), replay_buffer_class=SB3Sampler, n_reset=0, **options).learn(250)
    assert isinstance(a.replay_buffer, ReplayBuffer) and isinstance(b.replay_buffer, SB3Sampler)
    assert_same_learner(a, b)


def test_the_task_buffer_returns_what_sb3s_buffer_returns_for_the_same_slots():
    space, action_space = spaces.Box(-9, 9, (3,), np.float32), spaces.Box(-1, 1, (1,), np.float32)
    theirs = ReplayBuffer(300, space, action_space, "cpu")
    ours = TaskReplayBuffer(300, spaces.Box(-9, 9, (4,), np.float32), action_space, "cpu")
    rng = np.random.default_rng(0)
    one = np.ones((1, 1), np.float32)
    for _ in range(400):  # round the ring once
        obs, next_obs = rng.normal(size=(2, 1, 3)).astype(np.float32)
        action, reward, done = rng.uniform(-1, 1, size=(1, 1)), rng.normal(size=1), rng.random(1) < 0.2
        infos = [{"TimeLimit.truncated": bool(rng.random() < 0.5), "terminal_observation": next_obs[0]}]
        theirs.add(obs, next_obs, action, reward, done, infos)
        ours.add(np.hstack((obs, one)), np.hstack((next_obs, one)), action, reward, done, infos)
    slots = rng.integers(0, 300, size=64)
    a, b = theirs._get_samples(slots), ours.gather(th.as_tensor(slots)[None])
    assert th.equal(a.observations, b.observations[:, :3]) and (b.observations[:, 3] == 1).all()
    assert th.equal(a.next_observations, b.next_observations[:, :3])
    for name in ("actions", "rewards", "dones"):
        assert th.equal(getattr(a, name), getattr(b, name)), name


@PAIRS
def test_a_scale_of_one_hundred_is_the_learner_of_rewards_times_one_hundred(theirs, ours):
    a, b = (
        theirs("MlpPolicy", "Pendulum-v1", **OPTIONS),
        ours("MlpPolicy", "Pendulum-v1", reward_scaling=128, **OPTIONS),
    )
    for model, factor in ((a, 128), (b, 1)):  # a power of two, so that scaling does not round
        fill(model.replay_buffer, np.random.default_rng(0))
        model.replay_buffer.rewards *= factor
        model.set_logger(Logger(None, []))
    b.update_reward_scale()
    for model in (a, b):
        np.random.seed(1)
        th.manual_seed(2)
        model.train(gradient_steps=3, batch_size=32)
    assert_same_learner(a, b)
