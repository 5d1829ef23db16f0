"""ARSSAC beside SB3's SAC, and ARSTQC beside sb3-contrib's TQC: the same seed and options give the same bits."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from sb3_contrib import TQC
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import (
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from torch import nn

from sb3_ars import ARSSAC, ARSTQC

PAIRS = [pytest.param(ARSSAC, SAC, id="sac"), pytest.param(ARSTQC, TQC, id="tqc")]
SMALL = {"net_arch": [16], "activation_fn": nn.ReLU}


class Drift(gym.Env):
    """Random observations of any space; the reward grows with the action; it ends by chance or by the time limit."""

    def __init__(self, observation_space, action_space=None):
        self.observation_space = observation_space
        self.action_space = spaces.Box(-2.0, 5.0, (2,)) if action_space is None else action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        reward = float(np.sum(action)) + self.np_random.normal()
        return self.observation_space.sample(), reward, bool(self.np_random.random() < 0.1), False, {}


def drift(observation_space=None, limit=7):
    return TimeLimit(
        Drift(spaces.Box(-1.0, 3.0, (3,)) if observation_space is None else observation_space), limit
    )


def drifts(n_envs):
    return DummyVecEnv([drift] * n_envs)


def bit_flipping():
    env = BitFlippingEnv(n_bits=3, continuous=True)
    env.seed(0)  # SB3 2.9.2: its reset(seed) reaches no generator but the observation's
    return env


def make(algorithm, env, policy="MlpPolicy", **options):
    settings = {"buffer_size": 300, "learning_starts": 12, "batch_size": 8, "seed": 3, "policy_kwargs": SMALL}
    return algorithm(policy, env, **(settings | options))


def flat(value, name=""):
    """Every tensor and number in nested dictionaries and lists, by path."""
    if isinstance(value, dict):
        return {k: v for key, inner in value.items() for k, v in flat(inner, f"{name}/{key}").items()}
    if isinstance(value, list | tuple):
        return {k: v for key, inner in enumerate(value) for k, v in flat(inner, f"{name}/{key}").items()}
    return {name: value}


def assert_same(ours, theirs):
    """Networks, targets, optimizers, temperature, counters and buffer are equal to the bit."""
    mine, other = flat(ours.get_parameters()), flat(theirs.get_parameters())
    assert mine.keys() == other.keys()
    different = [
        key
        for key, value in mine.items()
        if not (th.equal(value, other[key]) if isinstance(value, th.Tensor) else value == other[key])
    ]
    assert different == []
    if theirs.log_ent_coef is None:
        assert ours.log_ent_coef is None and th.equal(ours.ent_coef_tensor, theirs.ent_coef_tensor)
    else:
        assert th.equal(ours.log_ent_coef, theirs.log_ent_coef)
    for counter in ("num_timesteps", "_n_updates", "_episode_num"):
        assert getattr(ours, counter) == getattr(theirs, counter), counter
    assert type(ours.replay_buffer) is type(theirs.replay_buffer)
    np.testing.assert_array_equal(ours.replay_buffer.actions, theirs.replay_buffer.actions)
    np.testing.assert_array_equal(ours.replay_buffer.rewards, theirs.replay_buffer.rewards)


def learn_both(ours, theirs, make_env, steps=60, **options):
    """Train one after the other, so that each has the global generators to itself, and compare."""
    models = []
    for algorithm in (ours, theirs):
        env = make_env()
        models.append(make(algorithm, env, **options).learn(steps))
        models[-1].get_env().close()
    before = make(theirs, make_env(), **options).policy.state_dict()
    assert models[1]._n_updates > 0
    trained = models[1].policy.state_dict()
    assert any(not th.equal(trained[key], before[key]) for key in before), "the reference did not learn"
    assert_same(*models)
    return models


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_pendulum_by_name_learns_to_the_bit(ours, theirs):
    learn_both(ours, theirs, lambda: "Pendulum-v1", steps=100)


OPTIONS = {
    "gradient_steps_2": {"gradient_steps": 2},
    "train_every_3_steps": {"train_freq": 3, "gradient_steps": 3},
    "train_every_episode": {"train_freq": (1, "episode"), "gradient_steps": -1},
    "train_every_2_episodes": {"train_freq": (2, "episode"), "gradient_steps": 2},
    "no_gradient_steps_until_asked": {"train_freq": (4, "step"), "gradient_steps": -1},
    "fixed_ent_coef": {"ent_coef": 0.2},
    "ent_coef_from_a_tenth": {"ent_coef": "auto_0.1"},
    "target_entropy": {"target_entropy": -0.5},
    "n_steps_3": {"n_steps": 3},
    "gamma_and_tau": {"gamma": 0.9, "tau": 0.05},
    "schedule_object": {"learning_rate": LinearSchedule(1e-2, 1e-4, 0.7)},
    "schedule_function": {"learning_rate": lambda remaining: 1e-2 * remaining},
    "small_buffer_wraps": {"buffer_size": 20},
    "memory_saving_buffer": {
        "optimize_memory_usage": True,
        "replay_buffer_kwargs": {"handle_timeout_termination": False},
    },
    "optimizer": {
        "policy_kwargs": SMALL | {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"eps": 1e-5}}
    },
    "separate_arch": {"policy_kwargs": SMALL | {"net_arch": {"pi": [8], "qf": [12, 8]}, "n_critics": 3}},
    "tanh": {"policy_kwargs": {"net_arch": [16], "activation_fn": nn.Tanh}},
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_each_option_learns_to_the_bit(ours, theirs, options):
    learn_both(ours, theirs, drift, **options)


def test_quantiles_dropped_learn_to_the_bit():
    options = {
        "policy_kwargs": SMALL | {"n_quantiles": 7, "n_critics": 3},
        "top_quantiles_to_drop_per_net": 1,
    }
    learn_both(ARSTQC, TQC, drift, **options)


@pytest.mark.parametrize("gradient_steps", [1, -1])
@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_two_envs_learn_to_the_bit(ours, theirs, gradient_steps):
    mine, _ = learn_both(ours, theirs, lambda: drifts(2), gradient_steps=gradient_steps)
    assert mine.task_of_env == [0, 0] and not mine.is_multi_task


def test_envs_in_processes_learn_to_the_bit():
    learn_both(ARSSAC, SAC, lambda: SubprocVecEnv([drift] * 2, start_method="fork"))


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("noise", ["normal", "correlated", "vectorized"])
def test_action_noise_learns_to_the_bit(noise, n_envs):
    def action_noise():
        mean, sigma = np.zeros(2), np.full(2, 0.2)
        kind = OrnsteinUhlenbeckActionNoise if noise == "correlated" else NormalActionNoise
        return (
            VectorizedActionNoise(kind(mean, sigma), n_envs) if noise == "vectorized" else kind(mean, sigma)
        )

    models = [
        make(algorithm, drifts(n_envs), action_noise=action_noise()).learn(60) for algorithm in (ARSSAC, SAC)
    ]
    without = make(SAC, drifts(n_envs)).learn(60)
    assert not np.array_equal(models[1].replay_buffer.actions, without.replay_buffer.actions)
    assert_same(*models)
    assert type(models[0].action_noise) is type(models[1].action_noise)


@pytest.mark.parametrize("norm_reward", [False, True])
@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_vec_normalize_learns_to_the_bit(ours, theirs, norm_reward):
    mine, other = learn_both(ours, theirs, lambda: VecNormalize(drifts(2), norm_reward=norm_reward))
    assert mine.get_vec_normalize_env() is mine.get_env()
    np.testing.assert_array_equal(mine.get_env().obs_rms.mean, other.get_env().obs_rms.mean)


DICT_SPACE = spaces.Dict(
    {
        "vector": spaces.Box(-1.0, 1.0, (3,)),
        "digit": spaces.Discrete(4),
        "image": spaces.Box(0, 255, (36, 36, 1), np.uint8),
    }
)


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_dict_observations_learn_to_the_bit(ours, theirs):
    kwargs = SMALL | {"features_extractor_kwargs": {"cnn_output_dim": 8}}
    learn_both(
        ours, theirs, lambda: drift(DICT_SPACE), steps=20, policy="MultiInputPolicy", policy_kwargs=kwargs
    )


@pytest.mark.parametrize("share", [False, True])
@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_images_learn_to_the_bit(ours, theirs, share):
    kwargs = SMALL | {
        "features_extractor_kwargs": {"features_dim": 8},
        "share_features_extractor": share,
    }
    image = spaces.Box(0, 255, (36, 36, 1), np.uint8)
    mine, _ = learn_both(
        ours, theirs, lambda: drift(image), steps=18, policy="CnnPolicy", policy_kwargs=kwargs
    )
    assert mine.observation_space.shape == (1, 36, 36)


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_hindsight_learns_to_the_bit(ours, theirs):
    learn_both(
        ours,
        theirs,
        bit_flipping,
        policy="MultiInputPolicy",
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 2, "goal_selection_strategy": "future"},
    )


class NormedFeatures(BaseFeaturesExtractor):
    """Batch norm and dropout, which behave differently in training and evaluation."""

    def __init__(self, observation_space, dropout=0.0):
        super().__init__(observation_space, features_dim=6)
        self.body = nn.Sequential(nn.Linear(3, 6), nn.BatchNorm1d(6))
        if dropout:
            self.body.append(nn.Dropout(dropout))

    def forward(self, observations):
        return self.body(observations)


@pytest.mark.parametrize("share", [False, True])
@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_batch_norm_learns_to_the_bit(ours, theirs, share):
    kwargs = SMALL | {"features_extractor_class": NormedFeatures, "share_features_extractor": share}
    mine, _ = learn_both(ours, theirs, drift, policy_kwargs=kwargs)
    statistics = mine.policy.critic_target.state_dict()["features_extractor.body.1.running_mean"]
    assert th.equal(statistics, mine.policy.critic.state_dict()["features_extractor.body.1.running_mean"])
    assert statistics.abs().sum() > 0


@pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
def test_training_updates_running_statistics_and_prediction_does_not(algorithm):
    kwargs = {"features_extractor_class": NormedFeatures, "features_extractor_kwargs": {"dropout": 0.5}}
    model = make(algorithm, drift(), policy_kwargs=SMALL | kwargs)
    observations = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    model.learn(20)
    model.policy.set_training_mode(True)
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    first = model.predict(observations, deterministic=True)[0]
    assert not model.actor.training
    np.testing.assert_array_equal(first, model.predict(observations, deterministic=True)[0])
    assert all(th.equal(value, before[key]) for key, value in model.policy.state_dict().items())
    model.train(1, batch_size=8)
    assert model.actor.training and model.critic.training
    assert not model.critic_target.training
    after = model.policy.state_dict()
    for net in ("actor", "critic"):
        key = f"{net}.features_extractor.body.1.running_mean"
        assert not th.equal(before[key], after[key])


class KeptInEvaluation(nn.BatchNorm1d):
    """A layer whose statistics are frozen in the usual way."""

    def train(self, mode=True):
        return super().train(False)


class OwnModes(NormedFeatures):
    """Modules that answer train() each in a way of its own."""

    def __init__(self, observation_space):
        super().__init__(observation_space, dropout=0.5)
        frozen = nn.BatchNorm1d(6)
        frozen.train = lambda mode=True: frozen
        self.body.extend([nn.Sequential(KeptInEvaluation(6), nn.Dropout()), frozen, nn.Sequential()])
        self.twice = self.body[0]
        self.none = None
        self.register_module("missing", None)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's about torch.jit
            self.scripted = th.jit.script(nn.Sequential(nn.Linear(1, 1), nn.Dropout()))


def modes(model):
    return {name: module.training for name, module in model.policy.named_modules()}


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_every_module_is_in_the_mode_that_sb3_puts_it_in(ours, theirs):
    kwargs = SMALL | {"features_extractor_class": OwnModes}
    mine, other = (make(algorithm, drift(), policy_kwargs=kwargs) for algorithm in (ours, theirs))
    for mode in (True, True, False, False, True):
        for model in (mine, other):
            model.policy.set_training_mode(mode)
        # our layers stand in the place of SB3's, so the names are the same
        assert modes(mine) == modes(other)
        assert modes(mine)["actor.features_extractor.body.2"] == modes(mine)["critic"] == mode
        assert not modes(mine)["actor.features_extractor.body.3.0"] and not modes(mine)["critic_target"]
        dropped_out = mine.actor.features_extractor.scripted(th.ones(64, 1)) == 0
        assert dropped_out.any() == mode


def test_modules_put_in_between_two_calls_follow_the_next_one():
    model = make(ARSSAC, drift())
    for mode in (False, False, True, True):
        model.policy.set_training_mode(mode)
        model.actor.latent_pi[0] = nn.Sequential(nn.Dropout(), model.actor.latent_pi[0]).train(not mode)
        model.policy.set_training_mode(mode)
        assert {module.training for net in (model.actor, model.critic) for module in net.modules()} == {mode}


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_a_second_learn_and_a_continued_one_stay_equal(ours, theirs):
    models = []
    for algorithm in (ours, theirs):
        model = make(algorithm, drift(), learning_rate=lambda remaining: 1e-2 * remaining)
        model.learn(40).learn(30, reset_num_timesteps=False).learn(25)
        models.append(model)
    assert models[0].num_timesteps == 25
    assert_same(*models)


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_unlearned_networks_are_equal(ours, theirs):
    mine, other = make(ours, drift()), make(theirs, drift())
    assert_same(mine, other)
    assert [name for name, _ in mine.policy.named_parameters()] == [
        name for name, _ in other.policy.named_parameters()
    ]


def target_moves(model):
    """Do one update and return whether the target critics moved."""
    before = [parameter.clone() for parameter in model.critic_target.parameters()]
    model.train(1, batch_size=8)
    after = model.critic_target.parameters()
    return not all(th.equal(old, new) for old, new in zip(before, after, strict=True))


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_target_update_interval_counts_over_the_run(ours, theirs):
    mine = make(ours, drift(), target_update_interval=3, gradient_steps=0).learn(20)
    mine.set_logger(Logger(None, []))
    assert [target_moves(mine) for _ in range(7)] == [True, False, False, True, False, False, True]
    # SB3 counts within one call of train, so that single steps always move the target; within one call both agree
    learn_both(ours, theirs, drift, target_update_interval=3, train_freq=6, gradient_steps=6)
