"""Prediction, observation and action spaces: ours take what SB3's SAC and TQC take, and refuse what they refuse."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_ars import ARSSAC, ARSTQC
from sb3_ars.errors import ConfigError, EnvContractError

BOTH = pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
PAIRS = [pytest.param(ARSSAC, SAC, id="sac"), pytest.param(ARSTQC, TQC, id="tqc")]
SMALL = {"net_arch": [16], "activation_fn": nn.ReLU}
UNEVEN = spaces.Box(-2.0, 5.0, (2,))


class Sampled(gym.Env):
    """Observations drawn from any space; remembers the actions it was given."""

    def __init__(self, observation_space=None, action_space=UNEVEN):
        self.observation_space = (
            spaces.Box(-1.0, 1.0, (3,)) if observation_space is None else observation_space
        )
        self.action_space = action_space
        self.received = []
        self.poison = None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        self.received.append(action)
        observation, reward = self.observation_space.sample(), float(np.sum(action))
        if self.poison == "observation":
            observation = np.full_like(observation, np.nan)
        return observation, np.inf if self.poison == "reward" else reward, False, False, {}


def make(algorithm, environment=None, policy="MlpPolicy", **options):
    settings = {"buffer_size": 100, "learning_starts": 10, "batch_size": 8, "seed": 2, "policy_kwargs": SMALL}
    environment = TimeLimit(Sampled(), 5) if environment is None else environment
    return algorithm(policy, environment, **(settings | options))


# ---------------------------------------------------------------- prediction


@BOTH
def test_one_observation_gives_one_action_and_a_batch_a_batch(algorithm):
    model = make(algorithm).learn(20)
    batch = np.random.default_rng(0).uniform(-1, 1, (4, 3)).astype(np.float32)
    actions, state = model.predict(batch, deterministic=True)
    assert actions.shape == (4, 2) and state is None
    single, state = model.predict(batch[1], deterministic=True)
    assert single.shape == (2,) and state is None
    np.testing.assert_allclose(single, actions[1], rtol=1e-5)


@BOTH
def test_deterministic_actions_repeat_and_sampled_ones_do_not(algorithm):
    model, observation = make(algorithm), np.zeros(3, np.float32)
    deterministic = [model.predict(observation, deterministic=True)[0] for _ in range(2)]
    np.testing.assert_array_equal(*deterministic)
    sampled = np.stack([model.predict(observation)[0] for _ in range(200)])
    assert len(np.unique(sampled, axis=0)) == 200
    median = np.median(sampled, axis=0)  # tanh keeps the order, so the median is the mean action's image
    assert np.abs(median - deterministic[0]).max() < 0.6


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_predictions_equal_sb3_s_to_the_bit(ours, theirs):
    models = [make(algorithm) for algorithm in (ours, theirs)]
    batch = np.random.default_rng(1).uniform(-1, 1, (6, 3)).astype(np.float32)
    for deterministic in (True, False):
        results = []
        for model in models:
            th.manual_seed(0)
            results.append(model.predict(batch, deterministic=deterministic)[0])
        np.testing.assert_array_equal(*results)
        assert results[0].dtype == np.float32


@BOTH
def test_observations_of_the_vec_env_can_be_predicted(algorithm):
    env = DummyVecEnv([Sampled] * 3)
    model = make(algorithm, env)
    assert model.get_env() is env and model.get_vec_normalize_env() is None
    actions, _ = model.predict(env.reset())
    assert actions.shape == (3, 2)
    env.step(actions)


@pytest.mark.parametrize("shape", [(4,), (2, 4), (2, 2, 3), ()])
@BOTH
def test_observations_of_a_wrong_shape_are_refused(algorithm, shape):
    with pytest.raises(ValueError, match="observation shape"):
        make(algorithm).predict(np.zeros(shape, np.float32))


@BOTH
def test_a_gymnasium_reset_passed_whole_is_refused(algorithm):
    model = make(algorithm)
    with pytest.raises(ValueError, match="tuple"):
        model.predict(Sampled().reset())


@BOTH
def test_a_plain_model_has_no_tasks_to_predict_for(algorithm):
    with pytest.raises(ConfigError, match="task='push'"):
        make(algorithm).predict(np.zeros(3, np.float32), task="push")


@BOTH
def test_actions_fill_uneven_bounds_and_are_stored_scaled(algorithm):
    env = Sampled()
    model = make(algorithm, TimeLimit(env, 5), learning_starts=10).learn(40)
    received = np.stack(env.received)
    assert received.min() >= -2 and received.max() <= 5
    assert received[:10].max() > 3  # random actions come from the whole space
    stored = model.replay_buffer.actions[:40, 0]
    np.testing.assert_allclose(-2 + (stored + 1) * 3.5, received, rtol=1e-4, atol=1e-4)
    assert np.abs(stored).max() <= 1
    with th.no_grad():
        model.actor.mu.bias.fill_(100.0)
        model.actor.mu.weight.zero_()
    np.testing.assert_allclose(model.predict(np.zeros(3, np.float32), deterministic=True)[0], [5.0, 5.0])


@BOTH
def test_vec_normalize_is_found_and_applied_when_updating(algorithm):
    env = VecNormalize(DummyVecEnv([lambda: TimeLimit(Sampled(spaces.Box(50.0, 60.0, (3,))), 5)]))
    model = make(algorithm, env).learn(30)
    assert model.get_vec_normalize_env() is env
    assert model.replay_buffer.observations[:30].min() >= 50  # stored raw
    batch = model.replay_buffer.sample(64, env=env)
    assert batch.observations.abs().max() <= 10 < 50
    other = VecNormalize(DummyVecEnv([lambda: TimeLimit(Sampled(spaces.Box(50.0, 60.0, (3,))), 5)]))
    model.set_env(other)
    assert model.get_vec_normalize_env() is other


@BOTH
def test_sb3_s_evaluation_runs_on_the_model_and_on_its_policy(algorithm):
    model = make(algorithm)
    env = DummyVecEnv([lambda: gym.wrappers.RecordEpisodeStatistics(TimeLimit(Sampled(), 5))])
    with pytest.warns(UserWarning, match="Monitor"):
        rewards, lengths = evaluate_policy(model, env, n_eval_episodes=3, return_episode_rewards=True)
    assert lengths == [5, 5, 5] and len(rewards) == 3
    mean, deviation = evaluate_policy(model, model.get_env(), n_eval_episodes=2)
    assert -20 <= mean <= 50 and deviation >= 0


# ---------------------------------------------------------------- spaces


OBSERVATION_SPACES = {
    "vector": spaces.Box(-1.0, 1.0, (3,)),
    "matrix": spaces.Box(-1.0, 1.0, (2, 3)),
    "cube": spaces.Box(-1.0, 1.0, (2, 2, 2)),
    "unbounded": spaces.Box(-np.inf, np.inf, (3,)),
    "float64": spaces.Box(-1.0, 1.0, (3,), np.float64),
    "integers": spaces.Box(0, 9, (3,), np.int64),
    "discrete": spaces.Discrete(5),
    "multi_discrete": spaces.MultiDiscrete([4, 3]),
    "multi_binary": spaces.MultiBinary(3),
    "flattened_image": spaces.Box(0, 255, (36, 36, 1), np.uint8),
}


@pytest.mark.parametrize("space", OBSERVATION_SPACES.values(), ids=OBSERVATION_SPACES.keys())
@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_every_observation_space_of_sb3_s_trains_as_there(ours, theirs, space):
    models = [make(algorithm, TimeLimit(Sampled(space), 5)).learn(20) for algorithm in (ours, theirs)]
    assert models[0]._n_updates == models[1]._n_updates == 10
    for name, values in models[1].policy.state_dict().items():
        assert th.equal(values, models[0].policy.state_dict()[name]), name
    action, _ = models[0].predict(space.sample(), deterministic=True)
    assert UNEVEN.contains(action)


ACTION_SPACES = {
    "many": spaces.Box(-1.0, 1.0, (7,)),
    "matrix": spaces.Box(-2.0, 3.0, (2, 2)),
    "float64": spaces.Box(-1.0, 1.0, (2,), np.float64),
    "per_entry": spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([0.5, 9.0], np.float32)),
}


@pytest.mark.parametrize("space", ACTION_SPACES.values(), ids=ACTION_SPACES.keys())
@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_every_action_space_of_sb3_s_trains_as_there(ours, theirs, space):
    models = [
        make(algorithm, TimeLimit(Sampled(action_space=space), 5)).learn(20) for algorithm in (ours, theirs)
    ]
    for name, values in models[1].policy.state_dict().items():
        assert th.equal(values, models[0].policy.state_dict()[name]), name
    action = models[0].predict(np.zeros(3, np.float32))[0]
    assert action.shape == space.shape and space.contains(action.astype(space.dtype))
    assert models[0].target_entropy == models[1].target_entropy == -np.prod(space.shape)


@pytest.mark.parametrize(
    "space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(4)], ids=str
)
@BOTH
def test_actions_that_are_not_continuous_are_refused(algorithm, space):
    with pytest.raises(AssertionError, match="only supports"):
        make(algorithm, Sampled(action_space=space))


@BOTH
def test_infinite_action_bounds_are_refused(algorithm):
    with pytest.raises(AssertionError, match="finite lower and upper bound"):
        make(algorithm, Sampled(action_space=spaces.Box(-np.inf, np.inf, (2,))))


@BOTH
def test_policies_that_do_not_fit_the_observations_are_refused(algorithm):
    dictionary = spaces.Dict({"a": spaces.Box(-1.0, 1.0, (3,))})
    for policy in ("MlpPolicy", "CnnPolicy"):
        with pytest.raises(ValueError, match="MultiInputPolicy"):
            make(algorithm, Sampled(dictionary), policy=policy)
    with pytest.raises(AssertionError, match="NatureCNN"):
        make(algorithm, policy="CnnPolicy")
    with pytest.raises(ValueError, match="unknown"):
        make(algorithm, policy="NoSuchPolicy")
    nested = spaces.Dict({"a": dictionary})
    with pytest.raises(NotImplementedError, match="ested"):
        make(algorithm, Sampled(nested), policy="MultiInputPolicy")


@BOTH
def test_options_that_sb3_refuses_are_refused(algorithm):
    for options, message in (
        ({"train_freq": (1, "epoch")}, "train_freq"),
        ({"train_freq": (1.5, "step")}, "train_freq"),
        ({"ent_coef": "automatic_0"}, "ent_coef='automatic_0'"),
        ({"ent_coef": "never"}, "ent_coef='never'"),
        ({"target_entropy": "high"}, "target_entropy='high'"),
        ({"use_sde": True}, "use_sde"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage"),
    ):
        with pytest.raises((ValueError, AssertionError), match=message):
            make(algorithm, **options)
    with pytest.raises(ConfigError, match="needs a single environment, and here are"):
        make(algorithm, DummyVecEnv([Sampled] * 2), train_freq=(1, "episode")).learn(10)


@BOTH
def test_gsde_is_refused_with_a_way_out(algorithm):
    with pytest.raises(ConfigError, match=r"use_sde=True \(gSDE\) is not supported.*Use False"):
        make(algorithm, use_sde=True)


@pytest.mark.parametrize("kind", ["observation", "reward"])
@BOTH
def test_nan_and_infinity_stop_training_before_they_are_stored(algorithm, kind):
    env = Sampled()
    model = make(algorithm, TimeLimit(env, 50)).learn(15)
    env.poison = kind
    before = {name: values.clone() for name, values in model.policy.state_dict().items()}
    with pytest.raises(EnvContractError, match=f"NaN or infinity as {kind}"):
        model.learn(5, reset_num_timesteps=False)
    assert model.replay_buffer.size() == 15
    assert all(th.equal(values, before[name]) for name, values in model.policy.state_dict().items())


@BOTH
def test_the_default_network_is_the_paper_s(algorithm):
    model = algorithm("MlpPolicy", Sampled(), buffer_size=10)
    widths = [layer.out_features for layer in model.actor.latent_pi if isinstance(layer, nn.Linear)]
    assert widths == [400, 400, 400, 400]
    assert [type(m) for m in model.actor.latent_pi if not isinstance(m, nn.Linear)] == [nn.ReLU] * 4
    assert [type(m) for m in model.critic.q_networks[0] if not isinstance(m, nn.Linear)] == [nn.Tanh] * 4


@BOTH
def test_a_policy_class_may_be_passed_instead_of_its_name(algorithm):
    named = make(algorithm)
    passed = make(algorithm, policy=type(named.policy))
    for name, values in named.policy.state_dict().items():
        assert th.equal(values, passed.policy.state_dict()[name])
