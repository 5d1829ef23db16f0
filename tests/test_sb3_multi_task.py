"""Several tasks through SB3's life cycle: learning, saving, loading, resetting, resuming, and what is refused."""

import io
import warnings

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_ars import ARSSAC, ARSTQC, TaskReplayBuffer, make_multitask_env, make_toy_env
from sb3_ars.envs.toy import PointTask
from sb3_ars.errors import ConfigError

BOTH = pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
SMALL = {"net_arch": [16], "activation_fn": nn.ReLU}
NAMES = ["point-0", "point-180"]


def toy(seed=0, **options):
    settings = {"reward_scales": (10.0, 0.1), "max_episode_steps": 5}
    return make_toy_env(seed=seed, **(settings | options))


def named(*names):
    return make_multitask_env({name: PointTask for name in names}, seed=0, max_episode_steps=5, n_workers=0)


def make(algorithm, environment=None, **options):
    settings = {
        "buffer_size": 100,
        "learning_starts": 10,
        "batch_size": 4,
        "seed": 5,
        "policy_kwargs": SMALL,
        "n_reset": 2,
        "updates_after_reset": 3,
    }
    return algorithm("MlpPolicy", toy() if environment is None else environment, **(settings | options))


def observations(n_tasks=2):
    rows = np.random.default_rng(0).uniform(-0.5, 0.5, (n_tasks, 6)).astype(np.float32)
    return np.concatenate([rows, np.eye(n_tasks, dtype=np.float32)], axis=1)


def weights(model):
    return {name: values.clone() for name, values in model.policy.state_dict().items()}


def live_tensors(model):
    """Every tensor the update touches, by name."""
    tensors = {f"policy/{name}": values for name, values in model.policy.state_dict().items()}
    optimizers = {
        "actor": model.actor.optimizer,
        "critic": model.critic.optimizer,
        "alpha": model.ent_coef_optimizer,
    }
    for name, optimizer in optimizers.items():
        for index, state in enumerate(optimizer.state.values()):
            tensors |= {f"{name}/{index}/{key}": value for key, value in state.items()}
    return tensors | {"log_ent_coef": model.log_ent_coef, "reward_scale": model.reward_scale.scale}


def buffer_columns(model):
    written = model.replay_buffer.size()
    return {
        name: getattr(model.replay_buffer, name)[:, :written].clone()
        for name in ("observations", "next_observations", "actions", "rewards", "dones")
    }


# ---------------------------------------------------------------- saving, loading, resuming


@BOTH
@pytest.mark.parametrize("with_env", [False, True])
def test_tasks_scale_and_resets_survive_saving(algorithm, tmp_path, with_env):
    model = make(algorithm).learn(60)
    assert model.n_resets == 2 and len(model.reward_scale_history) == 3
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=toy() if with_env else None)
    for name in (
        "task_names",
        "n_resets",
        "resets_looked_for_until",
        "n_reset",
        "updates_after_reset",
        "is_multi_task",
    ):
        assert getattr(loaded, name) == getattr(model, name), name
    assert loaded.task_names == NAMES and loaded.task_of_env == [0, 1]
    assert [list(entry) for entry in loaded.reward_scale_history] == [
        list(entry) for entry in model.reward_scale_history
    ]
    assert th.equal(loaded.reward_scale.scale, model.reward_scale.scale)
    assert loaded.reward_scale.scale[1] > 1 and loaded.scaled_by == model.scaled_by
    assert th.equal(loaded.log_ent_coef, model.log_ent_coef) and loaded.log_ent_coef.shape == (2,)
    np.testing.assert_array_equal(
        *(m.predict(observations(), deterministic=True)[0] for m in (model, loaded))
    )


@BOTH
def test_training_after_a_load_moves_the_loaded_temperatures_and_uses_the_loaded_scale(algorithm, tmp_path):
    model = make(algorithm).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    updated = []
    for one in (model, algorithm.load(tmp_path / "model", env=toy())):
        one.load_replay_buffer(tmp_path / "buffer")  # both samplers start from the saved generator state
        one.set_logger(Logger(None, []))
        th.manual_seed(0)
        one.train(3, batch_size=4)
        updated.append(one)
    first, second = updated
    for name, values in first.policy.state_dict().items():
        assert th.equal(values, second.policy.state_dict()[name]), name
    assert th.equal(first.log_ent_coef, second.log_ent_coef)


@pytest.mark.parametrize("in_memory", [False, True])
@BOTH
def test_the_task_buffer_survives_saving(algorithm, tmp_path, in_memory):
    model = make(algorithm).learn(40)
    path = io.BytesIO() if in_memory else tmp_path / "buffer"
    model.save_replay_buffer(path)
    if in_memory:
        path.seek(0)
    fresh = make(algorithm)
    fresh.load_replay_buffer(path)
    assert isinstance(fresh.replay_buffer, TaskReplayBuffer) and fresh.replay_buffer.size() == 20
    for name, values in buffer_columns(model).items():
        assert th.equal(getattr(fresh.replay_buffer, name)[:, :20], values), name
    assert th.equal(fresh.replay_buffer.draw_slots(4), model.replay_buffer.draw_slots(4))


@BOTH
def test_a_buffer_of_other_tasks_is_refused_and_the_model_keeps_its_own(algorithm, tmp_path):
    make(algorithm, named("south", "north"), n_reset=0).learn(20).save_replay_buffer(tmp_path / "buffer")
    model = make(algorithm)
    kept = model.replay_buffer
    with pytest.raises(ConfigError, match="south"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is kept


@BOTH
def test_a_run_resumed_with_its_buffer_counts_on(algorithm, tmp_path):
    model = make(algorithm, n_reset=None, param_resets=[40, 80])
    with pytest.warns(UserWarning, match=r"param_resets=\[40, 80\] reaches beyond"):
        model.learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", env=toy(seed=3))
    loaded.load_replay_buffer(tmp_path / "buffer")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded.learn(60, reset_num_timesteps=False)
    assert loaded.num_timesteps == 120 and loaded.n_resets == 2
    # one update per vector step, and three after the second reset
    assert loaded._n_updates == model._n_updates + 30 + 3
    assert [step for step, _ in loaded.reward_scale_history] == [12, 40, 80]
    assert loaded.replay_buffer.size() == 60


@BOTH
def test_a_run_resumed_without_its_buffer_waits_with_one_warning(algorithm, tmp_path):
    model = make(algorithm, n_reset=0).learn(40)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=toy())
    with pytest.warns(UserWarning, match="Updates wait until every task holds batch_size=4") as caught:
        loaded.learn(40, reset_num_timesteps=False)
    assert len(caught) == 1
    assert loaded.replay_buffer.size() == 20
    assert loaded._n_updates == model._n_updates + 17  # 20 vector steps, the first three of them too early


@BOTH
def test_a_reset_due_right_after_loading_without_a_buffer_is_left_out(algorithm, tmp_path):
    model = make(algorithm, n_reset=None, param_resets=[40])
    with pytest.warns(UserWarning, match="reaches beyond"):
        model.learn(40)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=toy())
    actor = weights(loaded)
    with (
        pytest.warns(UserWarning, match="Updates wait"),
        pytest.warns(UserWarning, match="reset due at step 40 is left out"),
    ):
        loaded.learn(2, reset_num_timesteps=False)
    assert loaded.n_resets == 0 and all(
        th.equal(actor[name], values) for name, values in weights(loaded).items()
    )
    assert th.equal(loaded.reward_scale.scale, model.reward_scale.scale)


@BOTH
def test_more_envs_per_task_may_be_given_at_load(algorithm, tmp_path):
    model = make(algorithm).learn(40)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", env=toy(n_envs_per_task=2))
    assert loaded.n_envs == 4 and loaded.task_of_env == [0, 0, 1, 1]
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded.replay_buffer.task_size.tolist() == [40, 40]


@BOTH
def test_a_model_loaded_for_prediction_allocates_no_buffer(algorithm, tmp_path):
    make(algorithm).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", buffer_size=10**12)
    assert loaded.predict(observations())[0].shape == (2, 2)


@BOTH
def test_a_task_name_stands_for_its_one_hot(algorithm):
    model = make(algorithm)
    full = observations()
    for task, name in enumerate(NAMES):
        expected = model.predict(full[task], deterministic=True)[0]
        for given in (name, task):
            actual = model.predict(full[task, :6], deterministic=True, task=given)[0]
            np.testing.assert_array_equal(actual, expected)
    assert model.predict(full[:, :6], task="point-180")[0].shape == (2, 2)
    for wrong in ("point-90", 2, -1):
        with pytest.raises(ConfigError, match=r"point-0.*point-180"):
            model.predict(full[0, :6], task=wrong)


@BOTH
def test_the_same_seed_gives_the_same_run(algorithm):
    runs = [make(algorithm, seed=seed).learn(60) for seed in (5, 5, 6)]
    for name, values in weights(runs[0]).items():
        assert th.equal(values, runs[1].policy.state_dict()[name]), name
    assert not th.equal(weights(runs[0])["actor.mu.weight"], weights(runs[2])["actor.mu.weight"])
    assert th.equal(runs[0].replay_buffer.rewards[:, :30], runs[1].replay_buffer.rewards[:, :30])


# ---------------------------------------------------------------- reset


@BOTH
def test_a_reset_fills_live_tensors_in_place(algorithm):
    model = make(algorithm, n_reset=0).learn(40)
    addresses = {name: tensor.data_ptr() for name, tensor in live_tensors(model).items()}
    before, columns, counters = weights(model), buffer_columns(model), (model.num_timesteps, model._n_updates)
    assert len(model.actor.optimizer.state) and len(model.critic.optimizer.state)
    model.reset_networks()
    assert {name: tensor.data_ptr() for name, tensor in live_tensors(model).items()} == addresses
    for name, values in weights(model).items():
        assert not th.equal(values, before[name]), name
    for optimizer in (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer):
        assert all(not value.any() for state in optimizer.state.values() for value in state.values())
    assert model.log_ent_coef.tolist() == [0.0, 0.0]
    assert all(th.equal(values, columns[name]) for name, values in buffer_columns(model).items())
    assert (model.num_timesteps, model._n_updates) == counters and model.n_resets == 1


@BOTH
def test_training_after_a_reset_moves_the_networks_that_predict(algorithm):
    model = make(algorithm, n_reset=0).learn(40)
    model.reset_networks()
    before = weights(model)
    model.train(1, batch_size=4)
    for net in ("actor.", "critic.", "critic_target."):
        assert any(
            not th.equal(values, before[name])
            for name, values in weights(model).items()
            if name.startswith(net)
        )
    for optimizer in (model.actor.optimizer, model.critic.optimizer):
        assert {int(state["step"]) for state in optimizer.state.values()} == {1}


@BOTH
def test_weights_are_fresh_and_different_at_each_reset_and_targets_equal_critics(algorithm):
    model = make(algorithm)
    seen = [weights(model)]
    for _ in range(2):
        model.reset_networks()
        seen.append(weights(model))
    for name in seen[0]:
        assert not any(th.equal(seen[i][name], seen[j][name]) for i, j in ((0, 1), (0, 2), (1, 2))), name
    for values, target in zip(model.critic.parameters(), model.critic_target.parameters(), strict=True):
        assert th.equal(values, target)
    again = make(algorithm)
    again.reset_networks()
    assert th.equal(weights(again)["actor.mu.weight"], seen[1]["actor.mu.weight"])


@BOTH
def test_a_reset_leaves_the_global_generators_alone(algorithm):
    model = make(algorithm)
    torch_state, numpy_state = th.get_rng_state(), np.random.get_state()[1].copy()
    model.reset_networks()
    assert th.equal(torch_state, th.get_rng_state())
    np.testing.assert_array_equal(numpy_state, np.random.get_state()[1])


@BOTH
def test_a_critic_reset_leaves_the_actor_alone(algorithm):
    model = make(algorithm, n_reset=0, reset="critic").learn(40)
    before = {name: tensor.clone() for name, tensor in live_tensors(model).items()}
    model.reset_networks()
    for name, tensor in live_tensors(model).items():
        renewed = name.startswith(("policy/critic", "critic/"))
        assert th.equal(tensor, before[name]) is not renewed, name


class Layer(nn.Module):
    """A features extractor with weights, which the actor and the critics may share."""

    def __init__(self, observation_space):
        super().__init__()
        self.features_dim = 5
        self._observation_space = observation_space
        self.linear = nn.Linear(observation_space.shape[0], 5)

    def forward(self, observations):
        return self.linear(observations)


@BOTH
def test_a_critic_reset_leaves_an_actor_that_shares_its_features_alone(algorithm):
    kwargs = SMALL | {"features_extractor_class": Layer, "share_features_extractor": True}
    model = make(algorithm, n_reset=0, reset="critic", policy_kwargs=kwargs).learn(40)
    expected = model.predict(observations(), deterministic=True)[0]
    model.reset_networks()
    np.testing.assert_array_equal(model.predict(observations(), deterministic=True)[0], expected)


@BOTH
def test_no_reset_changes_nothing(algorithm):
    model = make(algorithm, reset="none").learn(40)
    assert model.n_resets == 0 and len(model.reward_scale_history) == 1
    before = weights(model)
    model.reset_networks()
    assert all(th.equal(values, before[name]) for name, values in weights(model).items())


@BOTH
def test_resets_come_evenly_and_each_does_its_extra_updates(algorithm):
    model = make(algorithm, n_reset=3, updates_after_reset=7).learn(80)
    assert [step for step, _ in model.reward_scale_history] == [12, 20, 40, 60]
    assert model.n_resets == 3
    assert model._n_updates == 35 + 3 * 7  # 40 vector steps, the first five within learning_starts=10


@BOTH
def test_a_reset_starts_alpha_at_its_configured_value(algorithm):
    model = make(algorithm, n_reset=0, ent_coef="auto_0.1").learn(40)
    assert model.log_ent_coef.exp().tolist() != pytest.approx([0.1, 0.1], rel=1e-6)
    model.reset_networks()
    assert model.log_ent_coef.exp().tolist() == pytest.approx([0.1, 0.1])
    fixed = make(algorithm, ent_coef=0.2).learn(60)
    assert fixed.n_resets == 2 and fixed.ent_coef_tensor.item() == pytest.approx(0.2)


# ---------------------------------------------------------------- normalised observations


@BOTH
def test_normalised_observations_train_save_load_and_predict(algorithm, tmp_path):
    env = VecNormalize(toy(), norm_reward=False)
    model = make(algorithm, env).learn(60)
    assert model.is_multi_task and model.n_resets == 2
    assert model.get_vec_normalize_env() is env
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "normalize.pkl"))
    restored = VecNormalize.load(str(tmp_path / "normalize.pkl"), toy())
    loaded = algorithm.load(tmp_path / "model", env=restored)
    rows = observations()
    np.testing.assert_array_equal(env.normalize_obs(rows), restored.normalize_obs(rows))
    actions = [m.predict(env.normalize_obs(rows), deterministic=True)[0] for m in (model, loaded)]
    np.testing.assert_array_equal(*actions)
    loaded.learn(60)
    assert loaded.n_resets == 4
    batch = model.replay_buffer.sample(8, env=env)
    raw = model.replay_buffer.observations[:, :30]
    assert raw.abs().max() <= 1 < batch.observations[:, :6].abs().max()


# ---------------------------------------------------------------- refused on purpose


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"use_sde": True}, "use_sde=True"),
        ({"n_steps": 3}, "n_steps=3 is not available with several tasks"),
        ({"replay_buffer_class": ReplayBuffer}, "mixes the tasks"),
        ({"batch_size": 101}, "batch_size=101"),
        ({"reward_scaling": [1.0]}, "reward_scaling holds 1 numbers for 2 tasks"),
        ({"reward_scaling": {"point-90": 2.0}}, "point-90"),
        ({"n_reset": 1, "param_resets": [30]}, "n_reset=1 and param_resets"),
        ({"reset": "actors"}, "reset='actors' is unknown"),
        ({"learning_starts": "soon"}, "learning_starts='soon'"),
    ],
    ids=lambda value: str(value)[:30],
)
@BOTH
def test_what_several_tasks_cannot_have_is_refused_when_built(algorithm, options, message):
    with pytest.raises(ConfigError, match=message):
        make(algorithm, **options)


@BOTH
def test_normalised_rewards_are_refused_when_built_and_when_set(algorithm):
    with pytest.raises(ConfigError, match="norm_reward=True"):
        make(algorithm, VecNormalize(toy()))
    model = make(algorithm)
    before = model.get_env()
    with pytest.raises(ConfigError, match="norm_reward=True"):
        model.set_env(VecNormalize(toy()))
    assert model.get_env() is before and model.get_vec_normalize_env() is None


@BOTH
def test_a_random_phase_shorter_than_a_batch_is_refused_before_the_first_step(algorithm):
    model = make(algorithm, learning_starts=7)
    with pytest.raises(ConfigError, match="learning_starts=8 or more"):
        model.learn(40)
    assert model.num_timesteps == 0


@BOTH
def test_resets_within_the_random_phase_are_refused(algorithm):
    with pytest.raises(ConfigError, match="n_reset asks for 2 resets in 24 steps"):
        make(algorithm).learn(24)


OTHER_TASKS = {
    "another_list": (lambda: named("north", "west"), "west"),
    "another_order": (lambda: named("south", "north"), "'south', 'north'"),
    "fewer": (lambda: named("north"), "'north'"),
    "plain": (PointTask, "plain environment"),
}


@pytest.mark.parametrize(("other", "message"), OTHER_TASKS.values(), ids=OTHER_TASKS.keys())
@BOTH
def test_other_tasks_are_refused_by_load_and_set_env(algorithm, other, message, tmp_path):
    model = make(algorithm, named("north", "south"))
    model.save(tmp_path / "model")
    before = model.get_env()
    with pytest.raises(ConfigError, match=message):
        algorithm.load(tmp_path / "model", env=other())
    with pytest.raises(ConfigError, match=message):
        model.set_env(other())
    assert model.get_env() is before and model.task_names == ["north", "south"]
    file = io.BytesIO()
    model.save(file)
    with pytest.raises(ConfigError, match=message):
        algorithm.load(file, env=other())


@BOTH
def test_a_plain_model_s_file_refuses_a_multi_task_env(algorithm, tmp_path):
    make(algorithm, PointTask(), n_reset=0).save(tmp_path / "model")
    with pytest.raises(ConfigError, match="one plain environment"):
        algorithm.load(tmp_path / "model", env=toy())


@BOTH
def test_a_subclass_of_the_task_buffer_may_be_passed(algorithm):
    class Counted(TaskReplayBuffer):
        """Counts its samples."""

        n_samples = 0

        def sample(self, batch_size, env=None):
            self.n_samples += 1
            return super().sample(batch_size, env)

    model = make(algorithm, replay_buffer_class=Counted).learn(60)
    assert model.replay_buffer.n_samples == model._n_updates > 0


@BOTH
def test_one_task_named_by_its_env_is_a_multi_task_model_with_scale_one(algorithm):
    model = make(algorithm, toy(reward_scales=(10.0,)), n_reset=0).learn(40)
    assert model.is_multi_task and model.n_tasks == 1
    assert model.reward_scale.scale.tolist() == [1.0] and model.log_ent_coef.shape == (1,)
    assert isinstance(model.replay_buffer, TaskReplayBuffer)
