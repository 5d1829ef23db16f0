"""Several tasks in one model: scale, resets, schedule, logging, saving; on the toy tasks."""

import pickle
import warnings

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from sb3_ars import (
    ARSSAC,
    ARSTQC,
    ARSCallback,
    ConfigError,
    DivergedError,
    EnvContractError,
    make_multitask_env,
    make_toy_env,
)
from sb3_ars.envs.toy import PointTask

SMALL = {
    "policy_kwargs": {"net_arch": [16, 16]},
    "batch_size": 8,
    "buffer_size": 2000,
    "updates_after_reset": 5,
    "seed": 0,
}
BOTH = pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])


def toy_model(algorithm=ARSSAC, **kwargs):
    return algorithm("MlpPolicy", make_toy_env(seed=0), **{**SMALL, **kwargs})


class Recorder(ARSCallback):
    """Notes when the scale is set and when networks are reset."""

    def __init__(self):
        super().__init__()
        self.resets = []

    def reset(self):
        super().reset()
        self.resets.append(self.num_timesteps)


@BOTH
def test_scale_is_set_after_the_random_phase_and_at_each_reset_only(algorithm):
    model, recorder = toy_model(algorithm, n_reset=4), Recorder()
    model.learn(1000, callback=recorder)
    assert recorder.resets == [200, 400, 600, 800]
    assert [step for step, _ in model.reward_scale_history] == [36, 200, 400, 600, 800]
    assert model.n_resets == 4


def test_scale_is_eq_6_of_the_whole_buffers():
    model = toy_model(n_reset=0, reward_floor=1e-6)
    model.learn(400)
    model.update_reward_scale()
    means = model.replay_buffer.rewards[:, : model.replay_buffer.size(), 0].double().mean(dim=1)
    assert model.reward_scale.scale.tolist() == pytest.approx((means.max() / means).tolist())


def test_param_resets_set_the_times():
    recorder = Recorder()
    toy_model(param_resets=[300, 700]).learn(1000, callback=recorder)
    assert recorder.resets == [300, 700]


@BOTH
def test_continuing_a_finished_run_does_not_reset_it(algorithm):
    model = toy_model(algorithm, n_reset=4).learn(1000)
    assert model.n_resets == 4
    before = [p.detach().clone() for p in model.actor.parameters()]
    model.gradient_steps = 0
    model.learn(8, reset_num_timesteps=False)  # the times of 1,008 steps all lie in the past
    assert model.n_resets == 4
    assert all(th.equal(p, q) for p, q in zip(before, model.actor.parameters(), strict=True))


def test_another_scaling_given_to_a_loaded_model_acts_before_the_next_reset(tmp_path):
    toy_model(n_reset=0).learn(400).save(tmp_path / "model")
    model = ARSSAC.load(tmp_path / "model", env=make_toy_env(seed=0), reward_scaling=[1, 2, 3, 4])
    with pytest.warns(UserWarning, match="Updates wait"):
        model.learn(100, reset_num_timesteps=False)
    assert model.reward_scale.scale.tolist() == [1, 2, 3, 4]


def test_a_mean_that_turns_negative_keeps_the_scales_and_the_run():
    class Souring(PointTask):
        total = 0

        def step(self, action):
            obs, reward, *rest = super().step(action)
            Souring.total += 1
            return obs, reward if Souring.total < 100 else -50.0, *rest

    env = make_multitask_env({"good": PointTask, "sour": Souring}, seed=0, n_workers=0)
    model = ARSSAC("MlpPolicy", env, n_reset=1, **SMALL)
    with pytest.warns(UserWarning, match="scales stay as they were.*sour"):
        model.learn(400)
    assert model.n_resets == 1 and len(model.reward_scale_history) == 1


@pytest.mark.parametrize("validates", [True, False])
def test_losses_that_are_not_finite_stop_training(monkeypatch, validates):
    model = toy_model(n_reset=0).learn(100)
    with th.no_grad():
        model.critic.qf0[0].weight[0, 0] = float("nan")
    # the actor follows; torch.compile turns this check of torch's off for the whole process
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", validates)
    with pytest.raises(DivergedError, match="NaN or infini"):
        model.learn(400, reset_num_timesteps=False)


def test_a_model_of_another_algorithm_is_refused(tmp_path):
    toy_model(ARSTQC).save(tmp_path / "tqc")
    with pytest.raises(ConfigError, match="ARSTQCPolicy is not one of ARSSAC's"):
        ARSSAC.load(tmp_path / "tqc")
    SAC("MlpPolicy", "Pendulum-v1").save(tmp_path / "sac")
    with pytest.raises(ConfigError, match="SACPolicy is not one of ARSSAC's"):
        ARSSAC.load(tmp_path / "sac")


def test_a_file_that_is_no_buffer_leaves_the_models_own(tmp_path):
    model = toy_model()
    kept = model.replay_buffer
    (tmp_path / "buffer.pkl").write_bytes(pickle.dumps({"not": "a buffer"}))
    with pytest.raises(ConfigError, match="is a pickle"):
        model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert model.replay_buffer is kept


def test_a_garbage_file_is_refused_by_name(tmp_path):
    (tmp_path / "model.zip").write_text("garbage")
    with pytest.raises(ConfigError, match="is not a saved model"):
        ARSSAC.load(tmp_path / "model.zip", env=make_toy_env())


def test_reset_times_follow_the_whole_run_when_it_is_learned_in_pieces():
    model, recorder = toy_model(param_resets=[300, 700]), Recorder()
    with pytest.warns(UserWarning, match="reaches beyond"):
        model.learn(500, callback=recorder)
    model.learn(500, callback=recorder, reset_num_timesteps=False)
    assert recorder.resets == [300, 700]


def tensors_of(model):
    tensors = {f"policy.{k}": v for k, v in model.policy.state_dict().items()}
    for name, optimizer in (("actor", model.actor.optimizer), ("critic", model.critic.optimizer)):
        for index, state in optimizer.state_dict()["state"].items():
            tensors |= {f"{name}.{index}.{key}": value for key, value in state.items()}
    return tensors | {"log_ent_coef": model.log_ent_coef}


@BOTH
def test_reset_fills_live_tensors_and_keeps_buffer_counters_and_scale(algorithm):
    model = toy_model(algorithm, n_reset=0).learn(400)
    before = {k: (v.data_ptr(), v.detach().clone()) for k, v in tensors_of(model).items()}
    buffer, scale, updates = (
        model.replay_buffer.rewards.clone(),
        model.reward_scale.scale.clone(),
        model._n_updates,
    )
    generator = th.get_rng_state()
    model.reset_networks()
    for name, tensor in tensors_of(model).items():
        address, old = before[name]
        assert tensor.data_ptr() == address, name
        if ".bias" not in name:
            assert not th.equal(tensor, old), name
    assert th.equal(model.log_ent_coef.detach(), th.zeros(4))
    assert all(not v.any() for k, v in tensors_of(model).items() if "exp_avg" in k or k.endswith("step"))
    assert th.equal(model.replay_buffer.rewards[:, :100], buffer[:, :100])
    assert th.equal(model.reward_scale.scale, scale) and model._n_updates == updates
    assert th.equal(th.get_rng_state(), generator)


def test_each_reset_draws_fresh_weights_and_targets_equal_the_critics():
    model, seen = toy_model(), []
    for _ in range(3):
        model.reset_networks()
        seen.append(th.cat([p.detach().flatten() for p in model.actor.parameters()]))
        for a, b in zip(model.critic.parameters(), model.critic_target.parameters(), strict=True):
            assert th.equal(a, b)
    assert not th.equal(seen[0], seen[1]) and not th.equal(seen[1], seen[2])


def test_resets_of_two_models_with_one_seed_are_equal():
    a, b = toy_model(), toy_model()
    th.rand(7)
    for model in (a, b):
        model.reset_networks()
    assert all(th.equal(p, q) for p, q in zip(a.policy.parameters(), b.policy.parameters(), strict=True))


def test_reset_of_the_critic_leaves_actor_and_temperatures():
    model = toy_model(n_reset=0, reset="critic").learn(300)
    actor = [p.detach().clone() for p in model.actor.parameters()]
    critic = [p.detach().clone() for p in model.critic.parameters()]
    temperature = model.log_ent_coef.detach().clone()
    model.reset_networks()
    assert all(th.equal(a, b) for a, b in zip(actor, model.actor.parameters(), strict=True))
    assert not any(th.equal(a, b) for a, b in zip(critic, model.critic.parameters(), strict=True))
    assert th.equal(model.log_ent_coef.detach(), temperature) and temperature.any()


def test_no_reset_scope_means_no_resets():
    recorder = Recorder()
    model = toy_model(reset="none", n_reset=4).learn(600, callback=recorder)
    assert recorder.resets == [] and model.n_resets == 0


def test_extra_updates_follow_each_reset():
    with_extra, without = (
        toy_model(n_reset=2, updates_after_reset=7),
        toy_model(n_reset=2, updates_after_reset=0),
    )
    assert with_extra.learn(600)._n_updates - without.learn(600)._n_updates == 14


def test_every_task_has_its_own_temperature():
    model = toy_model(n_reset=0).learn(600)
    assert model.log_ent_coef.shape == (4,) and len(set(model.log_ent_coef.tolist())) == 4


def test_task_order_permutes_the_scale_and_nothing_else():
    names, factors = ["a", "b", "c"], {"a": 10.0, "b": 1.0, "c": 0.1}

    def scales(order):
        env = make_multitask_env(
            {n: lambda n=n: PointTask(reward_scale=factors[n]) for n in order}, seed=None, n_workers=0
        )
        model = ARSSAC("MlpPolicy", env, **SMALL)
        for index, name in enumerate(order):
            model.replay_buffer._allocate()
            model.replay_buffer.rewards[index, :10] = factors[name]
        model.replay_buffer.task_size[:] = 10
        model.update_reward_scale()
        return dict(zip(order, model.reward_scale.scale.tolist(), strict=True))

    for order in (names, names[::-1]):
        assert scales(order) == pytest.approx({"a": 1, "b": 10, "c": 100})


@BOTH
def test_scales_and_schedule_survive_saving(algorithm, tmp_path):
    model = toy_model(algorithm, n_reset=3).learn(800)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=make_toy_env(seed=0))
    assert th.equal(loaded.reward_scale.scale, model.reward_scale.scale)
    assert (
        loaded.n_resets == 3
        and loaded.resets_looked_for_until == model.resets_looked_for_until
        and loaded.scaled_by == "'mean'"
    )
    assert loaded.task_names == ["point-east", "point-north", "point-west", "point-south"]
    assert th.equal(loaded.log_ent_coef, model.log_ent_coef)
    obs = model.env.reset()
    assert np.array_equal(
        loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
    )


def test_a_model_loaded_for_other_tasks_is_refused_by_name(tmp_path):
    toy_model().save(tmp_path / "model")
    other = make_multitask_env({f"other{i}": PointTask for i in range(4)}, seed=0, n_workers=0)
    for env in (other, make_toy_env(reward_scales=(1.0, 2.0))):
        with pytest.raises(
            ConfigError, match=r"trained on the tasks \['point-east'.*but the environment has"
        ):
            ARSSAC.load(tmp_path / "model", env=env)
    with pytest.raises(ConfigError, match="in its order"):
        toy_model().set_env(other)


def test_predict_takes_a_task_for_observations_without_the_id():
    model = toy_model()
    obs = model.env.reset()[2]
    expected, _ = model.predict(obs, deterministic=True)
    for task in ("point-west", 2):
        assert np.array_equal(model.predict(obs[:6], deterministic=True, task=task)[0], expected)
    for wrong in ("point-wset", 7, 1.5):
        with pytest.raises(ConfigError, match="point-west"):
            model.predict(obs[:6], task=wrong)
    with pytest.raises(ConfigError, match="lacks the one-hot task id"):
        model.predict(obs[:6])


def test_the_same_seed_gives_the_same_model():
    a, b = (toy_model(n_reset=1).learn(500) for _ in range(2))
    assert all(th.equal(p, q) for p, q in zip(a.policy.parameters(), b.policy.parameters(), strict=True))


def test_metrics_stay_on_the_device_until_the_log_is_written(monkeypatch):
    model = toy_model(n_reset=0).learn(100)
    reads = []
    for name in ("item", "tolist", "cpu", "numpy", "__float__", "__bool__"):
        original = getattr(th.Tensor, name)
        monkeypatch.setattr(
            th.Tensor, name, lambda *a, _o=original, _n=name, **k: (reads.append(_n), _o(*a, **k))[1]
        )
    optimizers = [model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer]
    for optimizer in optimizers:  # Adam on the CPU reads its own step counts
        optimizer.step = lambda: None
    model.train(gradient_steps=3, batch_size=8)
    assert reads == []


class Poisoned(PointTask):
    """Gives one bad value at its seventh step."""

    def __init__(self, where, value):
        super().__init__()
        self.where, self.value = where, value

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        if self._steps == 7:
            obs = obs * self.value if self.where == "observation" else obs
            reward = reward * self.value if self.where == "reward" else reward
        return obs, reward, terminated, truncated, info


@pytest.mark.parametrize("where", ["observation", "reward"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_nan_and_infinity_are_refused_by_task_and_nothing_is_stored(where, value):
    env = make_multitask_env({"good": PointTask, "bad": lambda: Poisoned(where, value)}, seed=0, n_workers=0)
    model = ARSSAC("MlpPolicy", env, n_reset=0, **SMALL)
    with pytest.raises(EnvContractError, match=rf"bad.*{where}"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        model.learn(200)
    assert model.replay_buffer.task_size.tolist() == [6, 6]
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


def test_negative_mean_rewards_stop_before_the_first_update():
    class Negative(PointTask):
        def step(self, action):
            obs, _, *rest = super().step(action)
            return obs, -1.0, *rest

    env = make_multitask_env({"good": PointTask, "sad": Negative}, seed=0, n_workers=0)
    model = ARSSAC("MlpPolicy", env, n_reset=0, **SMALL)
    with pytest.raises(ConfigError, match=r"negative: sad \(-1\)"):
        model.learn(200)
    assert model._n_updates == 0 and model.replay_buffer.size() > 0


BAD_OPTIONS = [
    ({"n_reset": -1}, "n_reset=-1"),
    ({"n_reset": 2.0}, r"n_reset=2\.0"),
    ({"n_reset": True}, "n_reset=True"),
    ({"n_reset": 2, "param_resets": [5]}, "n_reset=2 and param_resets"),
    ({"param_resets": [5, 3]}, "param_resets"),
    ({"param_resets": "soon"}, "param_resets"),
    ({"param_resets": [0]}, "param_resets entry=0"),
    ({"reward_scaling": "maen"}, "Did you mean 'mean'"),
    ({"reward_scaling": [1.0]}, "1 numbers for 4 tasks"),
    ({"reward_scaling": {"point-est": 2.0}}, "Did you mean 'point-"),
    ({"reward_floor": 0}, "reward_floor=0"),
    ({"reward_floor": "x"}, "reward_floor='x'"),
    ({"reset": "actor"}, "reset='actor'"),
    ({"updates_after_reset": -5}, "updates_after_reset=-5"),
    ({"actor_value": "max"}, "actor_value='max'"),
    ({"learning_starts": -1}, "learning_starts=-1"),
    ({"learning_starts": "soon"}, "learning_starts='soon'"),
    ({"batch_size": 0}, "batch_size=0"),
    ({"batch_size": 3000}, "batch_size=3000 rows per task is more than buffer_size=2000"),
    ({"buffer_size": 0}, "buffer_size=0"),
    ({"use_sde": True}, "use_sde"),
    ({"gamma": 2}, "gamma=2"),
    ({"tau": -0.1}, "tau=-0.1"),
    ({"ent_coef": "atuo"}, "ent_coef='atuo'"),
    ({"ent_coef": -1}, "ent_coef=-1"),
    ({"target_update_interval": 0}, "target_update_interval=0"),
    ({"stats_window_size": 0}, "stats_window_size=0"),
    ({"learning_rate": -1}, "learning_rate=-1"),
    ({"n_steps": 3}, "n_steps=3"),
    ({"policy_kwargs": {"std": "sigmoid"}}, "std='sigmoid'"),
    ({"policy_kwargs": {"weight_init": "he"}}, "weight_init='he'"),
    ({"policy_kwargs": {"critic_layer_norm": "yes"}}, "critic_layer_norm='yes'"),
]


@BOTH
@pytest.mark.parametrize(("options", "message"), BAD_OPTIONS, ids=[str(o) for o, _ in BAD_OPTIONS])
def test_a_bad_option_is_refused_at_construction_by_name(algorithm, options, message):
    with pytest.raises(ConfigError, match=message):
        toy_model(algorithm, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_reset": 100}, "n_reset asks for 100 resets in 400 steps"),
        ({"param_resets": [10]}, "param_resets asks for 1 resets"),
        ({"learning_starts": 4}, r"learning_starts=4 .* use learning_starts=32 or more"),
        ({"buffer_size": 10**12}, "do not fit"),
    ],
)
def test_an_option_that_does_not_fit_the_run_is_refused_before_its_first_step(options, message):
    model = toy_model(**options)
    with pytest.raises(ConfigError, match=message):
        model.learn(400)
    assert model.num_timesteps == 0


@pytest.mark.parametrize("total", ["100", None, -5, float("nan"), True])
def test_a_total_that_is_no_number_of_steps_is_refused(total):
    with pytest.raises(ConfigError, match="total_timesteps"):
        toy_model(n_reset=0).learn(total)


@pytest.mark.parametrize("n_drop", [25, 30, -1, 1.5])
def test_dropping_all_quantiles_is_refused(n_drop):
    with pytest.raises(ConfigError, match="top_quantiles_to_drop_per_net"):
        toy_model(ARSTQC, top_quantiles_to_drop_per_net=n_drop)


class Stop(BaseCallback):
    def _on_step(self):
        return self.num_timesteps < 200


def test_an_error_in_the_environment_loses_nothing_that_was_learned(tmp_path):
    model = toy_model(n_reset=0).learn(400)
    model.env.close()
    weights = [p.detach().clone() for p in model.policy.parameters()]
    with pytest.raises(RuntimeError):
        model.learn(100, reset_num_timesteps=False)
    model.save(tmp_path / "kept")
    model.save_replay_buffer(tmp_path / "buffer")
    again = ARSSAC.load(tmp_path / "kept", env=make_toy_env(seed=1))
    again.load_replay_buffer(tmp_path / "buffer")
    assert again.replay_buffer.size() == 100
    assert all(th.equal(p, q) for p, q in zip(weights, again.policy.parameters(), strict=True))
    again.learn(100, reset_num_timesteps=False)


def test_learning_starts_auto_is_a_share_of_the_run_and_at_least_one_batch():
    model = toy_model(n_reset=0)
    model.learn(400, callback=Stop())
    assert model.learning_starts == 32
    model.learn(100_000, callback=Stop())
    assert model.learning_starts == 1250
    model.learning_starts = 60  # set by hand since: stays
    model.learn(400, callback=Stop())
    assert model.learning_starts == 60


def test_layer_norm_xavier_and_softplus_build_the_networks_asked_for():
    options = {"net_arch": [16, 16], "critic_layer_norm": True, "weight_init": "xavier", "std": "softplus"}
    model = toy_model(policy_kwargs=options)
    layers = [type(layer).__name__ for layer in model.critic.qf0]
    assert layers == ["LayerNorm", "Linear", "LayerNorm", "Tanh", "Linear", "LayerNorm", "Tanh", "Linear"]
    assert model.critic.qf0[0].normalized_shape == (12,)  # 6 + 4 tasks + 2 actions
    assert all(not layer.bias.any() for layer in model.actor.modules() if isinstance(layer, th.nn.Linear))
    obs = th.as_tensor(model.env.reset())
    _, log_std, _ = model.actor.get_action_dist_params(obs)
    rho = model.actor.log_std(model.actor.latent_pi(obs))
    assert th.allclose(log_std.exp(), th.nn.functional.softplus(rho) + 1e-5, rtol=1e-5)


@pytest.mark.parametrize("n_tasks", [10, 50])
def test_paper_networks_have_the_papers_parameter_counts(n_tasks):
    # 39 observations, a one-hot, 4 actions, four layers of 400; counts worked out in the issue of each size
    env = make_toy_env(reward_scales=[1.0] * n_tasks)
    model = ARSSAC("MlpPolicy", env, seed=0)
    obs_dim, action_dim, width = 6 + n_tasks, 2, 400
    hidden = 3 * (width * width + width)
    actor = (obs_dim * width + width) + hidden + 2 * (width * action_dim + action_dim)
    critic = ((obs_dim + action_dim) * width + width) + hidden + (width + 1)
    assert sum(p.numel() for p in model.actor.parameters()) == actor
    assert sum(p.numel() for p in model.critic.parameters()) == 2 * critic
    activations = {type(m).__name__ for m in model.critic.modules()} & {"Tanh", "ReLU"}
    assert activations == {"Tanh"} and any(isinstance(m, th.nn.ReLU) for m in model.actor.modules())
