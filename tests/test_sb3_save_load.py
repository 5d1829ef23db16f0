"""A plain environment's model saves, loads, copies parameters and continues the ways SB3's SAC and TQC do."""

import io
import pathlib
import warnings
import zipfile

import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from sb3_contrib import TQC
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv, IdentityEnvBox
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_ars import ARSSAC, ARSTQC, make_toy_env
from sb3_ars.errors import ConfigError
from sb3_ars.policies import ARSSACPolicy, ARSTQCPolicy

BOTH = pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
SMALL = {"net_arch": [16], "activation_fn": nn.ReLU}
OBSERVATIONS = np.linspace(-1, 1, 6, dtype=np.float32).reshape(6, 1)


class Noisy(IdentityEnvBox):
    """SB3's one-dimensional env, seeded by ``reset``."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.observation_space.seed(seed)
        return super().reset(seed=seed, options=options)


def env():
    return TimeLimit(Noisy(ep_length=100), 6)


def make(algorithm, environment=None, **options):
    settings = {"buffer_size": 200, "learning_starts": 12, "batch_size": 8, "seed": 5, "policy_kwargs": SMALL}
    return algorithm("MlpPolicy", env() if environment is None else environment, **(settings | options))


def actions(model):
    return model.predict(OBSERVATIONS, deterministic=True)[0]


def assert_same_parameters(first, second):
    for name, values in first.policy.state_dict().items():
        assert th.equal(values, second.policy.state_dict()[name]), name
    for name in ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer"):
        mine, other = first.get_parameters()[name]["state"], second.get_parameters()[name]["state"]
        assert mine.keys() == other.keys() and mine
        for key, state in mine.items():
            assert all(th.equal(value, other[key][entry]) for entry, value in state.items()), name
    assert th.equal(first.log_ent_coef, second.log_ent_coef)


@pytest.fixture(scope="module", params=[ARSSAC, ARSTQC])
def trained(request):
    """A trained model that tests must not change."""
    return make(request.param).learn(40)


@pytest.mark.parametrize("kind", ["str", "str_with_zip", "pathlib", "bytes", "file"])
@pytest.mark.parametrize("with_env", [False, True])
def test_every_kind_of_path_gives_the_same_model(trained, tmp_path, kind, with_env):
    algorithm, environment = type(trained), env() if with_env else None
    if kind == "bytes":
        buffer = io.BytesIO()
        trained.save(buffer)
        buffer.seek(0)
        loaded = algorithm.load(buffer, env=environment)
        assert not buffer.closed
    elif kind == "file":
        with open(tmp_path / "model", "wb") as file:
            trained.save(file)
        with open(tmp_path / "model", "rb") as file:
            loaded = algorithm.load(file, env=environment)
            assert not file.closed
    else:
        name = "model.zip" if kind == "str_with_zip" else "model"
        path = tmp_path / name if kind == "pathlib" else str(tmp_path / name)
        trained.save(path)
        assert (tmp_path / "model.zip").is_file()
        loaded = algorithm.load(path, env=environment)
    assert type(loaded) is algorithm
    assert_same_parameters(trained, loaded)
    np.testing.assert_array_equal(actions(trained), actions(loaded))
    assert loaded.num_timesteps == 40 and loaded._n_updates == trained._n_updates
    assert (loaded.get_env() is None) is not with_env


def test_a_missing_folder_is_made(trained, tmp_path):
    with pytest.warns(UserWarning, match="Will create it"):
        trained.save(tmp_path / "new" / "model")
    assert (tmp_path / "new" / "model.zip").is_file()


@BOTH
def test_a_missing_file_is_named(algorithm, tmp_path):
    for environment in (None, env()):
        with pytest.raises(FileNotFoundError, match="nowhere"):
            algorithm.load(tmp_path / "nowhere", env=environment)


def test_a_loaded_model_shares_no_memory_with_the_first(trained):
    buffer = io.BytesIO()
    trained.save(buffer)
    loaded, before = type(trained).load(buffer, env=env()), actions(trained)
    loaded.learn(40)
    np.testing.assert_array_equal(before, actions(trained))
    assert not np.array_equal(before, actions(loaded))


def test_saving_twice_writes_the_same_parameters(trained, tmp_path):
    for name in ("first", "second"):
        trained.save(tmp_path / name)
    assert_same_parameters(*(type(trained).load(tmp_path / name) for name in ("first", "second")))
    entries = [set(zipfile.ZipFile(tmp_path / f"{name}.zip").namelist()) for name in ("first", "second")]
    assert entries[0] == entries[1]


def test_the_file_holds_no_buffer_and_no_environment(trained, tmp_path):
    trained.save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        assert {"policy.pth", "actor.optimizer.pth", "critic.optimizer.pth", "ent_coef_optimizer.pth"} <= set(
            archive.namelist()
        )
        data = archive.read("data").decode()
    assert '"replay_buffer":' not in data and '"env":' not in data and '"num_timesteps": 40' in data


@BOTH
def test_excluded_attributes_return_to_their_defaults_and_included_ones_are_kept(algorithm, tmp_path):
    model = make(algorithm, learning_rate=1e-2, n_reset=2)
    model.note = "kept"
    model.save(tmp_path / "model", exclude=["n_reset", "gamma"])
    loaded = algorithm.load(tmp_path / "model")
    assert loaded.n_reset is None and loaded.gamma == 0.99
    assert loaded.learning_rate == 1e-2 and loaded.note == "kept"
    model.save(tmp_path / "model", exclude=["learning_rate", "note"], include=["learning_rate"])
    loaded = algorithm.load(tmp_path / "model")
    assert loaded.learning_rate == 1e-2 and not hasattr(loaded, "note")


def test_options_given_to_load_replace_saved_ones(trained, tmp_path):
    trained.save(tmp_path / "model")
    loaded = type(trained).load(
        tmp_path / "model",
        env=env(),
        learning_rate=7e-3,
        learning_starts=0,
        n_reset=3,
        updates_after_reset=1,
        batch_size=4,
        tensorboard_log=None,
        verbose=0,
    )
    assert (loaded.learning_starts, loaded.n_reset, loaded.batch_size) == (0, 3, 4)
    loaded.learn(40)
    assert loaded.n_resets == 3
    for optimizer in (loaded.actor.optimizer, loaded.critic.optimizer, loaded.ent_coef_optimizer):
        assert optimizer.param_groups[0]["lr"] == 7e-3


@BOTH
def test_auto_learning_starts_can_be_given_to_load(algorithm, tmp_path):
    make(algorithm).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env(), learning_starts="auto")
    loaded.learn(40)
    assert loaded.learning_starts == 8 and loaded._n_updates == 32


def test_invalid_options_given_to_load_are_refused(trained, tmp_path):
    trained.save(tmp_path / "model")
    for options in ({"n_reset": -1}, {"reset": "everything"}, {"use_sde": True}, {"batch_size": 0}):
        with pytest.raises(ConfigError, match=next(iter(options))):
            type(trained).load(tmp_path / "model", **options)


def test_other_policy_kwargs_at_load_are_refused(trained, tmp_path):
    trained.save(tmp_path / "model")
    with pytest.raises(ValueError, match="policy kwargs"):
        type(trained).load(tmp_path / "model", policy_kwargs={"net_arch": [7]})


def break_attribute(path, name):
    """Make one saved attribute impossible to unpickle, as a class that has moved would."""
    with zipfile.ZipFile(path) as archive:
        contents = {entry: archive.read(entry) for entry in archive.namelist()}
    data = contents["data"].decode()
    start = data.index('":serialized:": "', data.index(f'"{name}": {{')) + len('":serialized:": "')
    contents["data"] = (data[:start] + "gAWV" + "AAAA" * 4 + data[data.index('"', start) :]).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for entry, content in contents.items():
            archive.writestr(entry, content)


@pytest.mark.parametrize("with_env", [False, True])
@BOTH
def test_custom_objects_replace_what_cannot_be_unpickled(algorithm, tmp_path, with_env):
    make(algorithm, learning_rate=lambda remaining: 1e-2 * remaining).save(tmp_path / "model")
    break_attribute(tmp_path / "model.zip", "learning_rate")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = algorithm.load(
            tmp_path / "model",
            env=env() if with_env else None,
            custom_objects={"learning_rate": 1e-3, "lr_schedule": lambda _: 1e-3},
        )
    assert loaded.learning_rate == 1e-3 and loaded.lr_schedule(0.5) == 1e-3


def test_the_device_may_be_named(trained, tmp_path):
    trained.save(tmp_path / "model")
    for device in ("cpu", th.device("cpu")):
        loaded = type(trained).load(tmp_path / "model", device=device)
        assert loaded.device == loaded.policy.device == th.device("cpu")
        assert loaded.reward_scale.scale.device == th.device("cpu")


def test_loading_prints_system_information_when_asked(trained, tmp_path, capsys):
    trained.save(tmp_path / "model")
    type(trained).load(tmp_path / "model", env=env(), print_system_info=True)
    printed = capsys.readouterr().out
    assert "CURRENT SYSTEM INFO" in printed and "SAVED MODEL SYSTEM INFO" in printed


@pytest.mark.parametrize(
    "options", [{}, {"ent_coef": 0.3}, {"ent_coef": "auto_0.2"}, {"n_steps": 3}], ids=str
)
@pytest.mark.parametrize(("ours", "theirs"), [(ARSSAC, SAC), (ARSTQC, TQC)])
def test_training_after_a_load_is_sb3_s_to_the_bit(ours, theirs, options, tmp_path):
    models = []
    for algorithm in (ours, theirs):
        make(algorithm, **options).learn(30).save(tmp_path / "model")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model = algorithm.load(tmp_path / "model", env=env())
        model.learn(30, reset_num_timesteps=False)
        models.append((model, [str(warning.message) for warning in caught]))
    (mine, my_warnings), (other, other_warnings) = models
    assert my_warnings == other_warnings
    assert mine.num_timesteps == 60 and mine._n_updates == other._n_updates > 30
    for name, values in other.policy.state_dict().items():
        assert th.equal(values, mine.policy.state_dict()[name]), name


@BOTH
def test_the_last_observation_is_dropped_unless_no_reset_is_forced(algorithm, tmp_path):
    model = make(algorithm).learn(15)
    model.save(tmp_path / "model")
    assert algorithm.load(tmp_path / "model", env=env())._last_obs is None
    kept = algorithm.load(tmp_path / "model", env=env(), force_reset=False)
    np.testing.assert_array_equal(kept._last_obs, model._last_obs)
    assert model._last_obs is not None
    model.set_env(DummyVecEnv([env]), force_reset=False)
    assert model._last_obs is not None
    model.set_env(DummyVecEnv([env]))
    assert model._last_obs is None


@BOTH
def test_another_number_of_envs_is_for_load_not_for_set_env(algorithm, tmp_path):
    model = make(algorithm).learn(15)
    two = DummyVecEnv([env] * 2)
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(two)
    assert model.n_envs == 1 and model.task_of_env == [0]
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=two)
    assert loaded.n_envs == 2 and loaded.task_of_env == [0, 0]
    loaded.learn(30)
    assert loaded.replay_buffer.n_envs == 2 and loaded.num_timesteps == 30


@BOTH
def test_a_model_loaded_for_prediction_learns_once_it_has_an_env(algorithm, tmp_path):
    make(algorithm).learn(15).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    with pytest.raises(AssertionError, match="set the environment"):
        loaded.learn(10)
    loaded.set_env(env())
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps == 35


@BOTH
def test_another_space_is_refused(algorithm, tmp_path):
    model = make(algorithm)
    model.save(tmp_path / "model")
    other = DummyVecEnv([lambda: IdentityEnvBox(low=-3, high=3)])
    with pytest.raises(ValueError, match="spaces do not match"):
        model.set_env(other)
    with pytest.raises(ValueError, match="spaces do not match"):
        algorithm.load(tmp_path / "model", env=other)


class OneTaskTwin(IdentityEnvBox):
    """A plain env with the spaces of the toy env's single task."""

    def __init__(self):
        super().__init__()
        toy = make_toy_env(reward_scales=(1.0,))
        self.observation_space, self.action_space = toy.observation_space, toy.action_space


@BOTH
def test_a_plain_model_refuses_a_multi_task_env_with_the_same_spaces(algorithm, tmp_path):
    model = make(algorithm, OneTaskTwin())
    model.save(tmp_path / "model")
    with pytest.raises(ConfigError, match="one plain environment"):
        algorithm.load(tmp_path / "model", env=make_toy_env(reward_scales=(1.0,)))
    with pytest.raises(ConfigError, match="plain environment"):
        model.set_env(make_toy_env(reward_scales=(1.0,)))
    assert not model.is_multi_task


# ---------------------------------------------------------------- parameters


def randomized(parameters):
    """Parameters of the same shapes, drawn anew for the policy."""
    policy = {name: th.rand_like(values) for name, values in parameters["policy"].items()}
    return {**parameters, "policy": policy}


@BOTH
def test_set_parameters_takes_what_get_parameters_gives(algorithm):
    model, before = make(algorithm).learn(20), None
    before = actions(model)
    parameters = randomized(model.get_parameters())
    model.set_parameters(parameters)
    for name, values in model.get_parameters()["policy"].items():
        assert th.equal(values, parameters["policy"][name])
    assert not np.array_equal(before, actions(model))


@BOTH
def test_set_parameters_reads_a_saved_model(algorithm, trained, tmp_path):
    trained.save(tmp_path / "model")
    other = make(type(trained))
    other.set_parameters(tmp_path / "model")
    np.testing.assert_array_equal(actions(other), actions(trained))


@BOTH
def test_missing_parameters_are_refused_unless_the_match_is_partial(algorithm):
    model = make(algorithm)
    parameters = randomized(model.get_parameters())
    without_optimizer = {key: value for key, value in parameters.items() if key != "actor.optimizer"}
    with pytest.raises(ValueError, match=r"actor\.optimizer"):
        model.set_parameters(without_optimizer)
    model.set_parameters(without_optimizer, exact_match=False)
    name = "actor.mu.weight"
    assert th.equal(model.policy.state_dict()[name], parameters["policy"][name])
    part = {"policy": {name: th.zeros_like(parameters["policy"][name])}}
    with pytest.raises(RuntimeError, match="Missing key"):
        model.set_parameters(part)
    model.set_parameters(part, exact_match=False)
    assert not model.policy.state_dict()[name].any()
    assert th.equal(model.policy.state_dict()["actor.mu.bias"], parameters["policy"]["actor.mu.bias"])


@BOTH
def test_unknown_parameter_names_are_refused(algorithm):
    model = make(algorithm)
    parameters = model.get_parameters()
    for exact_match in (True, False):
        with pytest.raises(ValueError, match="invalid object name"):
            model.set_parameters({**parameters, "no_such_net": {}}, exact_match=exact_match)
    with pytest.raises(RuntimeError, match="Unexpected key"):
        model.set_parameters({**parameters, "policy": {**parameters["policy"], "extra": th.zeros(1)}})


@BOTH
def test_parameters_set_on_the_model_are_the_ones_trained(algorithm):
    """The update holds references; it must go on with the weights that were set."""
    model = make(algorithm).learn(20)
    model.set_parameters(randomized(model.get_parameters()))
    before = {name: values.clone() for name, values in model.policy.state_dict().items()}
    model.train(1, batch_size=8)
    for net in ("actor.", "critic.", "critic_target."):
        names = [name for name in before if name.startswith(net) and "weight" in name]
        assert all(not th.equal(before[name], model.policy.state_dict()[name]) for name in names)
        change = max((before[name] - model.policy.state_dict()[name]).abs().max() for name in names)
        assert change < 0.05  # one step from where they were put


# ---------------------------------------------------------------- replay buffer


@pytest.mark.parametrize("kind", ["str", "pathlib", "bytes"])
@BOTH
def test_the_buffer_survives_saving(algorithm, tmp_path, kind):
    model = make(algorithm).learn(30)
    path = {"str": str(tmp_path / "buffer"), "pathlib": tmp_path / "buffer", "bytes": io.BytesIO()}[kind]
    model.save_replay_buffer(path)
    if kind == "bytes":
        path.seek(0)
    fresh = make(algorithm)
    fresh.load_replay_buffer(path)
    assert fresh.replay_buffer.size() == 30
    for column in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(
            getattr(fresh.replay_buffer, column), getattr(model.replay_buffer, column)
        )
    fresh.set_logger(Logger(None, []))
    fresh.train(2, batch_size=8)
    assert fresh._n_updates == 2


@BOTH
def test_a_file_that_is_no_buffer_is_refused(algorithm, tmp_path):
    from stable_baselines3.common.save_util import save_to_pkl

    save_to_pkl(tmp_path / "buffer.pkl", {"not": "a buffer"})
    with pytest.raises(AssertionError, match="ReplayBuffer"):
        make(algorithm).load_replay_buffer(tmp_path / "buffer.pkl")


@BOTH
def test_an_n_step_buffer_is_used_and_survives_saving(algorithm, tmp_path):
    model = make(algorithm, n_steps=3, gamma=0.9).learn(30)
    assert isinstance(model.replay_buffer, NStepReplayBuffer)
    model.save_replay_buffer(tmp_path / "buffer")
    fresh = make(algorithm, n_steps=3, gamma=0.9)
    fresh.load_replay_buffer(tmp_path / "buffer")
    assert (fresh.replay_buffer.n_steps, fresh.replay_buffer.gamma) == (3, 0.9)


@BOTH
def test_a_hindsight_model_loads_with_its_env_only(algorithm, tmp_path):
    def goals():
        return BitFlippingEnv(n_bits=3, continuous=True)

    model = algorithm(
        "MultiInputPolicy",
        goals(),
        replay_buffer_class=HerReplayBuffer,
        learning_starts=12,
        batch_size=8,
        buffer_size=200,
        policy_kwargs=SMALL,
    ).learn(30)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    with pytest.raises(AssertionError, match="pass an environment"):
        algorithm.load(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=goals())
    loaded.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    assert loaded.replay_buffer.size() == 30
    loaded.learn(10, reset_num_timesteps=False)
    assert loaded.num_timesteps == 40 and loaded._n_updates == model._n_updates + 10


# ---------------------------------------------------------------- policy


def test_the_policy_saves_and_loads_alone(trained, tmp_path):
    trained.policy.save(tmp_path / "policy")
    policy = (ARSSACPolicy if isinstance(trained, ARSSAC) else ARSTQCPolicy).load(tmp_path / "policy")
    np.testing.assert_array_equal(policy.predict(OBSERVATIONS, deterministic=True)[0], actions(trained))
    for name, values in trained.policy.state_dict().items():
        assert th.equal(values, policy.state_dict()[name]), name


@BOTH
def test_the_paper_s_policy_options_survive_saving(algorithm, tmp_path):
    kwargs = {"net_arch": [8], "critic_layer_norm": True, "std": "softplus", "weight_init": "xavier"}
    model = make(algorithm, policy_kwargs=kwargs).learn(20)
    model.policy.save(tmp_path / "policy")
    model.save(tmp_path / "model")
    for policy in (
        type(model.policy).load(tmp_path / "policy"),
        algorithm.load(tmp_path / "model").policy,
    ):
        assert policy.actor.std == "softplus" and policy.critic_layer_norm
        assert any(isinstance(module, nn.LayerNorm) for module in policy.critic.modules())
        assert isinstance(policy.critic.q_networks[0][-2], nn.Tanh)
        np.testing.assert_array_equal(policy.predict(OBSERVATIONS, deterministic=True)[0], actions(model))


# ---------------------------------------------------------------- counters, seeds


@BOTH
def test_continuing_counts_on_and_starting_again_counts_from_zero(algorithm):
    model = make(algorithm, learning_rate=lambda remaining: remaining)
    model.learn(20)
    assert (model.num_timesteps, model._n_updates) == (20, 8)
    model.learn(20, reset_num_timesteps=False)
    assert (model.num_timesteps, model._total_timesteps, model._n_updates) == (40, 40, 28)
    assert model._episode_num == 6
    # the last update runs with the schedule at the end of all 40 steps
    assert model.actor.optimizer.param_groups[0]["lr"] == pytest.approx(0.0)
    model.learn(20)
    assert (model.num_timesteps, model._n_updates, model._episode_num) == (20, 36, 3)


@BOTH
def test_the_learning_rate_follows_the_schedule(algorithm):
    rates = []

    def read(local, _):
        rates.append(local["self"].critic.optimizer.param_groups[0]["lr"])
        return True

    make(algorithm, learning_rate=lambda remaining: remaining, learning_starts=9).learn(20, read)
    np.testing.assert_allclose(rates[10:], [1 - step / 20 for step in range(10, 20)])


@BOTH
def test_the_same_seed_gives_the_same_run_and_another_seed_another(algorithm):
    runs = [make(algorithm, seed=seed).learn(30) for seed in (1, 1, 2)]
    weights = [run.policy.state_dict()["actor.mu.weight"] for run in runs]
    assert th.equal(weights[0], weights[1]) and not th.equal(weights[0], weights[2])
    np.testing.assert_array_equal(runs[0].replay_buffer.actions, runs[1].replay_buffer.actions)
    samples = []
    for run in (*runs[:2], runs[1]):
        if len(samples) < 2:
            run.set_random_seed(0)
        samples.append(run.predict(OBSERVATIONS)[0])
    np.testing.assert_array_equal(samples[0], samples[1])
    assert not np.array_equal(samples[1], samples[2])


@BOTH
def test_set_random_seed_reaches_torch_numpy_env_and_action_space(algorithm):
    model = make(algorithm)
    draws = []
    for _ in range(2):
        model.set_random_seed(9)
        draws.append(
            (th.rand(1).item(), np.random.rand(), *model.action_space.sample(), *model.get_env().reset()[0])
        )
    assert draws[0] == draws[1]
    assert make(algorithm, seed=None).seed is None


def test_options_of_the_caller_are_not_changed():
    kwargs, buffer_kwargs = dict(SMALL), {"handle_timeout_termination": True}
    make(ARSSAC, policy_kwargs=kwargs, replay_buffer_kwargs=buffer_kwargs, n_steps=2)
    assert kwargs == SMALL and buffer_kwargs == {"handle_timeout_termination": True}


def test_relative_strings_and_paths_mean_the_same_file(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trained.save("model")
    np.testing.assert_array_equal(actions(type(trained).load(pathlib.Path("model"))), actions(trained))


@BOTH
def test_a_reset_due_right_after_loading_without_a_buffer_does_not_crash(algorithm, tmp_path):
    model = make(algorithm, param_resets=[20], updates_after_reset=2)
    with pytest.warns(UserWarning, match="reaches beyond"):
        model.learn(20)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it may say that updates wait
        loaded.learn(20, reset_num_timesteps=False)
    assert loaded.n_resets == 0 and loaded.num_timesteps == 40
    assert loaded.reward_scale.scale.tolist() == [1.0]
