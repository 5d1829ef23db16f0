"""The paper's methods inside the algorithms: every one trains, resets, saves, loads, predicts, and composes."""

from itertools import pairwise

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import VecNormalize
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_ars import ARSSAC, ARSTQC, ConfigError, make_multitask_env, make_toy_env
from sb3_ars.callbacks.ars import ARSCallback
from sb3_ars.core.gradients import MeanGradient, PCGrad
from sb3_ars.core.temperature import temperature_weight
from sb3_ars.envs.toy import PointTask
from sb3_ars.experiments.config import load_preset
from sb3_ars.experiments.runner import build_model
from sb3_ars.nets.layers import ByTask, TaskLinear
from sb3_ars.nets.lora import LoRALinear

BODIES = {
    "multi_head": {"name": "multi_head"},
    "soft_modules": {
        "name": "soft_modules",
        "n_layers": 2,
        "n_modules": 2,
        "module_width": 8,
        "gate_width": 8,
    },
    "moore": {"name": "moore", "n_experts": 3},
    "paco": {"name": "paco", "n_parameter_sets": 2},
}
OPTIONS = {
    "batch_size": 8,
    "buffer_size": 500,
    "n_reset": 1,
    "updates_after_reset": 3,
    "seed": 0,
    "device": "cpu",
}
ALGORITHMS = pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
EVERY_BODY = pytest.mark.parametrize("body", BODIES)


def make(
    algorithm=ARSSAC, body=None, env=None, critic_body="same", layer_norm=False, more_policy=None, **options
):
    policy = {"net_arch": [12, 12], "critic_layer_norm": layer_norm}
    policy |= {"body": BODIES[body] if isinstance(body, str) else body, "critic_body": critic_body}
    policy |= more_policy or {}
    env = make_toy_env(seed=0) if env is None else env
    return algorithm("MlpPolicy", env, policy_kwargs=policy, **{**OPTIONS, **options})


def filled(algorithm=ARSSAC, callback=None, **options):
    """A model with a batch of every task and no update done yet."""
    model = make(algorithm, learning_starts=64, **{"n_reset": 0, **options})
    with pytest.warns(UserWarning, match="leaves no updates"):
        return model.learn(64, callback=callback)


EXECUTED = {
    "plain": {},
    "pcgrad": {"gradient": "pcgrad"},
    **{body: {"body": body} for body in BODIES},
    "popart": {"critic_body": {"name": "popart", "rate": 0.1}, "reward_scaling": "none"},
    "paco-left-out": {"body": "paco", "max_task_loss": 0.3},
    "weighting": {"body": "soft_modules", "task_weighting": "temperature"},
    "lora": {"lora": {"rank": 3}, "n_reset": 1},
}


def ready(method, algorithm=ARSSAC, **options):
    """A model of a method with a batch of every task, its adapters enabled."""
    model = filled(algorithm, callback=NoResets(), **EXECUTED[method], **options)
    if method == "lora":
        model.enable_lora()
    return model


class NoResets(ARSCallback):
    """For runs that end before any reset is due."""

    def reset_is_due(self):
        return False

    def _check_reset_times(self):
        pass


def parameters(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


@ALGORITHMS
@pytest.mark.parametrize("gradient", ["mean", "pcgrad"])
@pytest.mark.parametrize("body", [None, *BODIES])
def test_every_method_trains_resets_saves_loads_predicts_and_goes_on(algorithm, gradient, body, tmp_path):
    model = make(algorithm, body, gradient=gradient, layer_norm=True).learn(600)
    assert model.n_resets == 1 and model._n_updates > 100 and th.isfinite(parameters(model)).all()
    obs = model.env.reset()
    actions, _ = model.predict(obs, deterministic=True)
    alone = [model.predict(row, deterministic=True)[0] for row in obs]
    assert np.allclose(actions, alone, atol=1e-5)  # rows in any number
    assert np.allclose(actions[::-1], model.predict(obs[::-1].copy(), deterministic=True)[0], atol=1e-5)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=make_toy_env(seed=0))
    assert np.allclose(loaded.predict(obs, deterministic=True)[0], actions, atol=1e-6)
    assert type(loaded._combiner) is (PCGrad if gradient == "pcgrad" else MeanGradient)
    loaded.replay_buffer = model.replay_buffer
    before = parameters(loaded)
    loaded.learn(200, reset_num_timesteps=False)
    assert not th.equal(parameters(loaded), before)
    model.policy.save(tmp_path / "policy.pt")
    policy = type(model.policy).load(tmp_path / "policy.pt")
    assert np.allclose(policy.predict(obs, deterministic=True)[0], actions, atol=1e-5)


@EVERY_BODY
@pytest.mark.parametrize(
    ("gradient", "execution"), [("mean", "fused"), ("pcgrad", "fused"), ("mean", "compile")]
)
@pytest.mark.filterwarnings("ignore")  # torch.compile's about torch
def test_every_method_gives_the_same_update_in_every_execution(body, gradient, execution):
    results = []
    # not Adam, which makes full steps of gradients that are nothing but rounding
    sgd = {"optimizer_class": th.optim.SGD}
    for how in ("eager", execution):
        options = {"execution": how, "n_reset": 0, "learning_starts": 64, "learning_rate": 0.01}
        model = make(body=body, gradient=gradient, more_policy=sgd, **options)
        model.learn(64)
        th.manual_seed(1)
        before = parameters(model)
        model.train(gradient_steps=10, batch_size=8)
        results.append(parameters(model))
    assert (results[0] - results[1]).norm() < 2e-3 * (results[0] - before).norm()


@EVERY_BODY
def test_rows_known_to_be_task_major_give_what_rows_in_any_order_give(body):
    model = make(body=body, n_reset=0).learn(64)
    obs = th.as_tensor(model.replay_buffer.sample(8).observations)
    shuffle = th.randperm(len(obs))
    for part in range(2):
        known = model.actor.action_distribution(obs, task_major=True)[part]
        any_order = model.actor.action_distribution(obs[shuffle])[part]
        assert th.allclose(known[shuffle], any_order, atol=1e-5)
    actions = th.rand(len(obs), 2)
    known = model.critic.q_values(obs, actions, task_major=True)
    assert th.allclose(known[shuffle], model.critic.q_values(obs[shuffle], actions[shuffle]), atol=1e-5)


def test_a_task_left_out_is_not_learned_and_starts_from_a_mixture_of_others():
    model = filled(body="paco", max_task_loss=1e6, reward_scaling="none")
    weights = [body.task_weights for body in model._update_state.mixtures]
    assert len(weights) == 5  # actor, two critics, two targets
    before = [w.clone() for w in weights]
    model.replay_buffer.rewards[2] = 1e9  # one task's loss explodes
    model.train(1, 8)
    assert model._task_log._sums.left_out.tolist() == [0, 0, 1, 0]
    for w, old in zip(weights, before, strict=True):
        others = w[[0, 1, 3]]  # after the step of those that learned
        low, high = others.min(dim=0).values, others.max(dim=0).values
        assert ((w[2] >= low - 1e-6) & (w[2] <= high + 1e-6)).all() and not th.equal(w[2], old[2])
        assert th.allclose(w[[0, 1, 3]], old[[0, 1, 3]], atol=0.01)  # Adam's step of 3e-4, not of 1e9
    model.train(20, 8)
    assert th.isfinite(parameters(model)).all()


@pytest.mark.parametrize("gradient", ["mean", "pcgrad"])
def test_a_task_left_out_gives_exactly_no_gradient(gradient):
    results = []
    for wrong in (1e9, 2e9):
        model = filled(body="multi_head", max_task_loss=1e6, gradient=gradient)
        model.replay_buffer.rewards[1] = wrong
        th.manual_seed(1)
        model.train(1, 8)
        results.append(parameters(model))
    assert th.equal(*results)  # how wrong it is makes no difference


def test_weights_by_temperature_are_one_where_temperatures_agree():
    equal, weighted = (filled(task_weighting=weighting) for weighting in ("equal", "temperature"))
    for model in (equal, weighted):
        th.manual_seed(1)
        model.train(1, 8)
    assert th.allclose(parameters(equal), parameters(weighted), atol=1e-6)
    ent_coef = th.tensor([0.5, 1.0, 2.0, 4.0])
    weight = temperature_weight(ent_coef)
    assert weight.tolist() == pytest.approx([4 * x / 3.75 for x in (2, 1, 0.5, 0.25)])


def test_a_task_with_a_high_temperature_moves_the_networks_less():
    moved = []
    for weighting in ("equal", "temperature"):
        sgd = {"optimizer_class": th.optim.SGD}
        model = filled(body="multi_head", more_policy=sgd, learning_rate=0.01, task_weighting=weighting)
        with th.no_grad():
            model.log_ent_coef.copy_(th.tensor([3.0, 0.0, 0.0, 0.0]))
        heads = next(module for module in model.actor.modules() if isinstance(module, TaskLinear))
        before = heads.weight.detach().clone().view(4, -1)
        model.train(1, 8)
        moved.append((heads.weight.detach().view(4, -1) - before).norm(dim=1))
    ratio = moved[1] / moved[0]
    assert ratio[0] < 0.1 < 1 < ratio[1:].min()


# ---------------------------------------------------------------------- PopArt


@ALGORITHMS
@pytest.mark.parametrize("period", [1, 7])
def test_popart_critics_train_reset_save_and_load(algorithm, period, tmp_path):
    popart = {"name": "popart", "update_period": period, "rate": 0.05}
    model = make(algorithm, critic_body=popart, reward_scaling="none").learn(600)
    layers = [net.body.popart for net in (*model.critic.q_networks, *model.critic_target.q_networks)]
    assert model.n_resets == 1 and th.isfinite(parameters(model)).all()
    assert (layers[0].mean != 0).all() and all(th.equal(layer.std, layers[0].std) for layer in layers)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=make_toy_env(seed=0))
    assert th.equal(loaded.critic.qf0.body.popart.running_mean, layers[0].running_mean)
    obs = model.env.reset()
    assert np.allclose(*(m.predict(obs, deterministic=True)[0] for m in (model, loaded)))
    model.reset_networks()
    assert (layers[0].mean == 0).all() and (layers[0].std == 1).all()


def test_popart_refreshes_every_so_many_updates_and_preserves_values():
    popart = {"name": "popart", "update_period": 5, "rate": 0.5}
    model = filled(critic_body=popart, reward_scaling="none")
    layer = model.critic.qf0.body.popart
    means = []
    for _ in range(12):
        model.train(1, 8)
        means.append(layer.mean.clone())
    changed = [not th.equal(a, b) for a, b in pairwise(means)]
    assert sum(changed) == 2 and [i for i, c in enumerate(changed) if c][1] - changed.index(True) == 5


def test_popart_learns_in_normalised_units():
    popart = {"name": "popart", "rate": 1.0}
    losses = {}
    for name, critic_body in (("popart", popart), ("plain", None)):
        model = filled(critic_body=critic_body, reward_scaling="none")
        model.replay_buffer.rewards[:] = 5 + 100 * th.randn_like(model.replay_buffer.rewards)
        model.train(1, 8)
        losses[name] = model._task_log._sums.critic_loss.item()
    assert losses["popart"] < 10 < 1000 < losses["plain"]


# ---------------------------------------------------------------------- LoRA


@ALGORITHMS
@pytest.mark.parametrize(
    "lora", [{"rank": 3}, {"rank": 3, "per_task": False, "layers": "hidden", "scale": "paper"}]
)
def test_adapters_come_late_in_the_run_and_stay(algorithm, lora, tmp_path, capsys):
    lora = {**lora, "start": 0.5, "min_success": 0}
    model = make(algorithm, lora=lora, n_reset=4, layer_norm=True, verbose=1).learn(
        1000
    )  # resets at 200, ... 800
    printed = capsys.readouterr().out
    assert [printed.count(e) for e in ("reset 1", "reset 2", "adapters added", "adapters renewed")] == [1] * 4
    assert model.lora_is_enabled and model.n_resets == 4
    base = [p.clone() for p in model.critic.parameters() if not p.requires_grad]
    learned = [p.clone() for p in model.critic.parameters() if p.requires_grad]
    model.learn(200, reset_num_timesteps=False)
    assert all(map(th.equal, base, (p for p in model.critic.parameters() if not p.requires_grad)))
    assert not any(map(th.equal, learned, (p for p in model.critic.parameters() if p.requires_grad)))
    obs = model.env.reset()
    actions, _ = model.predict(obs, deterministic=True)
    alone = [model.predict(row, deterministic=True)[0] for row in obs]
    assert np.allclose(actions, alone, atol=1e-5)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=make_toy_env(seed=0))
    assert np.allclose(loaded.predict(obs, deterministic=True)[0], actions, atol=1e-6)
    loaded.replay_buffer = model.replay_buffer
    state = model.critic.optimizer.state_dict()["state"]
    assert state.keys() == loaded.critic.optimizer.state_dict()["state"].keys() and len(state) == len(learned)
    loaded.learn(200, reset_num_timesteps=False)
    model.policy.save(tmp_path / "policy.pt")
    policy = type(model.policy).load(tmp_path / "policy.pt")
    assert np.allclose(policy.predict(obs, deterministic=True)[0], actions, atol=1e-5)


@ALGORITHMS
def test_enabling_adapters_changes_no_output(algorithm):
    lora = {"rank": 3, "rescale_critic": False}
    model = make(algorithm, lora=lora, layer_norm=True).learn(600, callback=NoResets())
    batch = model.replay_buffer.sample(8)
    networks = (model.critic, model.critic_target)

    def outputs():
        values = [network.q_values(batch.observations, batch.actions, True) for network in networks]
        return [*model.actor.action_distribution(batch.observations, True), *values]

    before = outputs()
    draws = th.random.get_rng_state()
    model.enable_lora()
    assert th.equal(draws, th.random.get_rng_state())  # the run's own random numbers go on
    assert all(th.allclose(a, b, atol=1e-5) for a, b in zip(before, outputs(), strict=True))
    model.train(5, 8)
    assert not th.allclose(before[0], outputs()[0], atol=1e-5)
    model.renew_lora()
    # the actor is its base again; the critics' layer norms keep what they learned
    assert all(th.allclose(a, b, atol=1e-5) for a, b in zip(before[:2], outputs()[:2], strict=True))
    with pytest.raises(ConfigError, match=r"enable_lora\(\) needs the option lora, once"):
        model.enable_lora()


def test_a_frozen_critics_values_follow_the_reward_scale():
    model = make(lora={"rank": 3}).learn(600, callback=NoResets())
    batch = model.replay_buffer.sample(8)
    before = model.critic.q_values(batch.observations, batch.actions)
    model.enable_lora()
    old = model.reward_scale.scale.clone()
    model.replay_buffer.rewards[1] *= 7
    model.update_reward_scale()
    after = model.critic.q_values(batch.observations, batch.actions)
    ratio = (model.reward_scale.scale / old).repeat_interleave(8).view(-1, 1, 1)
    assert not th.allclose(ratio, th.ones_like(ratio), rtol=0.1)
    assert th.allclose(after, before * ratio, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "execution", ["fused", pytest.param("compile", marks=pytest.mark.filterwarnings("ignore"))]
)
@pytest.mark.parametrize("method", ["lora", "popart", "paco-left-out", "weighting"])
def test_the_same_update_in_every_execution(method, execution):
    results = []
    for how in ("eager", execution):
        model = ready(
            method, execution=how, more_policy={"optimizer_class": th.optim.SGD}, learning_rate=0.01
        )
        th.manual_seed(1)
        before = parameters(model)
        model.train(gradient_steps=10, batch_size=8)
        results.append(parameters(model))
    assert (results[0] - results[1]).norm() < 2e-3 * (results[0] - before).norm()


def test_fused_adam_steps_adapters_as_the_plain_one_does():
    # autograd hands out their gradients transposed; an epsilon this large keeps Adam from blowing up rounding
    results = []
    for how in ("eager", "fused"):
        model = ready("lora", execution=how, more_policy={"optimizer_kwargs": {"eps": 1e-3}})
        th.manual_seed(1)
        before = parameters(model)
        model.train(gradient_steps=10, batch_size=8)
        results.append(parameters(model))
    assert (results[0] - results[1]).norm() < 2e-3 * (results[0] - before).norm()


class NoWaiting(TorchDispatchMode):
    """Fails on operations whose outcome Python has to wait for, which a CUDA graph cannot hold."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.name().split("::")[1].split(".")[0]
        assert name not in (
            "_local_scalar_dense",
            "nonzero",
            "is_nonzero",
            "masked_select",
            "equal",
            "unique",
        ), name
        if name in ("index", "index_put_"):
            assert all(i is None or i.dtype != th.bool for i in args[1])
        return func(*args, **(kwargs or {}))


@ALGORITHMS
@pytest.mark.parametrize("method", EXECUTED)
def test_no_update_waits_for_the_device_or_depends_on_data(algorithm, method):
    model = ready(method, algorithm, execution="fused")
    model.train(1, 8)
    step = model._sample_and_update
    hyperparameters = []
    model._sample_and_update = lambda *args: hyperparameters.append(args) or step(*args)
    model.train(1, 8)
    with NoWaiting():
        step(*hyperparameters[0])
    with pytest.raises(AssertionError, match="_local_scalar_dense"), NoWaiting():
        th.ones(1).item()


def test_the_critics_body_may_differ_from_the_actors():
    model = make(body="multi_head", critic_body=None)
    assert isinstance(model.actor.latent_pi, ByTask) and not isinstance(model.critic.qf0, ByTask)
    model = make(critic_body=BODIES["moore"])
    assert not isinstance(model.actor.latent_pi, ByTask) and isinstance(model.critic.qf0, ByTask)


def test_pcgrad_changes_the_update_only_where_tasks_conflict():
    mean, projected = (make(gradient=gradient, n_reset=0).learn(400) for gradient in ("mean", "pcgrad"))
    assert mean._n_updates == projected._n_updates
    assert not th.allclose(parameters(mean), parameters(projected), atol=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"body": {"name": "more"}}, "body name='more' is unknown.*Did you mean 'moore'"),
        ({"body": {"name": "moore", "n_experts": 0}}, "option n_experts=0 must be an integer of at least 1"),
        ({"body": {"name": "moore", "n_experts": 13}}, "n_experts=13 exceeds the last width"),
        ({"body": {"name": "paco", "k": 3}}, "body 'paco' has no option 'k'"),
        ({"gradient": "pcgrd"}, "gradient='pcgrd' is unknown.*Did you mean 'pcgrad'"),
        ({"body": {"name": "popart"}}, "body='popart' is an output layer of critics"),
        ({"critic_body": {"name": "popart"}}, "critic_body='popart' normalises each task's values"),
        (
            {"critic_body": {"name": "popart", "update_period": 0}, "reward_scaling": "none"},
            "option update_period=0 must be an integer",
        ),
        (
            {"critic_body": {"name": "popart", "rate": 2.0}, "reward_scaling": "none"},
            "option rate=2.0 must be above 0",
        ),
        ({"lora": {"rank": 13}}, "rank=13 exceeds the width of a layer"),
        ({"lora": {"rank": 0}}, "lora option rank=0 must be an integer of at least 1"),
        ({"lora": {"ranks": 4}}, "lora has no option 'ranks'.*Did you mean 'rank'"),
        ({"lora": {"rank": 4}, "body": "moore"}, "lora adapts the plain network; leave body out"),
        ({"lora": {"rank": 4}, "reset": "none"}, "lora takes the place of resets.*but reset='none'"),
        ({"lora": {"rank": 4}, "reset": "critic"}, "lora takes the place of resets.*but reset='critic'"),
        ({"more_policy": {"lora": {"rank": 4}}}, "lora belongs to ARSSAC's own arguments"),
        ({"more_policy": {"body": "moore"}}, "body='moore' must be a mapping of options"),
        ({"critic_body": "popart"}, "body='popart' must be a mapping of options"),
        ({"body": {"name": ["moore"]}}, "body name=.'moore'. is unknown"),
        ({"lora": {"rank": 4, "start": 75}}, "lora option start=75 must be between 0 and 1"),
        ({"max_task_loss": 0}, "max_task_loss=0 must be a positive number"),
        (
            {"task_weighting": "temperatur"},
            "task_weighting='temperatur' is unknown.*Did you mean 'temperature'",
        ),
        ({"task_weighting": "temperature", "ent_coef": 0.1}, "task_weighting='temperature' compares"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        make(**options)


def test_what_needs_several_tasks_is_refused_with_one():
    one = {"point": PointTask}
    with pytest.raises(ConfigError, match="gradient='pcgrad' projects one task's gradient on another's"):
        make(env=make_multitask_env(one, seed=0, n_workers=0), gradient="pcgrad")
    with pytest.raises(ConfigError, match="task_weighting='temperature' compares the tasks"):
        make(env=make_multitask_env(one, seed=0, n_workers=0), task_weighting="temperature")
    with pytest.raises(ConfigError, match="lora needs an environment with named tasks"):
        make(env="Pendulum-v1", lora={"rank": 4})
    with pytest.raises(ConfigError, match="gradient needs an environment with named tasks"):
        make(env="Pendulum-v1", gradient="pcgrad")
    with pytest.raises(ConfigError, match=r"policy_kwargs\['body'\] needs an environment with named tasks"):
        make(env="Pendulum-v1", body="moore")


@pytest.mark.parametrize("bench", ["mt10", "mt50"])
@pytest.mark.parametrize("method", ["mh", "soft-modules", "moore", "pcgrad"])
@pytest.mark.parametrize("with_ars", [False, True])
def test_presets_are_the_papers_networks_and_compose_with_ars(bench, method, with_ars):
    n_tasks = int(bench[2:])
    config = load_preset(f"{bench}-{method}{'-ars' if with_ars else ''}")
    assert config.env.tasks == bench.upper() and config.ars.resets() is with_ars
    assert config.ars.reward_scaling == ("mean" if with_ars else "none")
    env = make_multitask_env({f"task {i}": WidePointTask for i in range(n_tasks)}, seed=0, n_workers=0)
    model = build_model(config, env)
    expected = {  # of the actor, from the sizes of the paper's tables
        ("mh", 10): 533_280,
        ("mh", 50): 677_600,
        ("soft-modules", 10): 792_444,
        ("soft-modules", 50): 808_444,
        ("moore", 10): 1_395_320,
        ("moore", 50): 2_301_500,
        ("pcgrad", 10): 504_408,
        ("pcgrad", 50): 520_408,
    }
    assert sum(p.numel() for p in model.actor.parameters()) == expected[method, n_tasks]
    assert (model.gradient == "pcgrad") is (method == "pcgrad")


class WidePointTask(PointTask):
    """A toy task as wide as Meta-World's."""

    def __init__(self):
        super().__init__()
        import gymnasium as gym

        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (39,), np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (4,), np.float32)


def test_what_reads_the_task_id_is_refused_beneath_a_normaliser_of_observations():
    env = VecNormalize(make_toy_env(seed=0), norm_reward=False)
    with pytest.raises(ConfigError, match=r"norm_obs=True\) changes the one-hot task id"):
        make(env=env, body="moore")


def test_adapters_that_would_never_come_are_refused_before_training():
    model = make(lora={"rank": 3, "start": 0.9}, n_reset=1)
    with pytest.raises(ConfigError, match="lora adds its adapters at the first reset from step 900"):
        model.learn(1000)


def test_a_reset_of_an_adapted_model_renews_the_adapters_alone():
    model = make(lora={"rank": 3}).learn(600, callback=NoResets())
    model.enable_lora()
    model.train(3, 8)
    base = [p.clone() for p in model.critic.parameters() if not p.requires_grad]
    model.reset_networks()
    assert all(map(th.equal, base, (p for p in model.critic.parameters() if not p.requires_grad)))
    assert all((layer.lora_b == 0).all() for layer in model.critic.modules() if isinstance(layer, LoRALinear))


def test_adapters_that_success_does_not_allow_are_reported():
    model = make(lora={"rank": 3, "start": 0.5, "min_success": 1.0})
    with pytest.warns(
        UserWarning, match=r"due at step 300, but the mean training success is .* no reset is left"
    ):
        model.learn(600)
    assert not model.lora_is_enabled and model.n_resets == 1
    model = make(lora={"rank": 3, "start": 0.5, "min_success": 1.0}, n_reset=2)
    with pytest.warns(UserWarning, match="the networks are reset instead|no reset is left"):
        model.learn(900)


def test_adapters_may_start_exactly_at_a_reset_time():
    lora = {"rank": 3, "start": 0.8, "min_success": 0}
    assert (
        make(lora=lora, n_reset=4).learn(1004).lora_is_enabled
    )  # the last reset is at step 803, and so is 0.8 T


def test_the_success_that_adapters_wait_for_survives_saving(tmp_path):
    model = make(n_reset=0).learn(800)
    for episodes in model.task_episodes:
        episodes.append({"success": 1.0})
    model.save(tmp_path / "model")
    loaded = ARSSAC.load(tmp_path / "model", env=make_toy_env(seed=0))
    assert loaded.mean_success() == model.mean_success() > 0
    assert [list(e) for e in loaded.task_episodes] == [list(e) for e in model.task_episodes]


def test_adapters_cannot_change_when_a_model_is_loaded(tmp_path):
    model = make(lora={"rank": 3}).learn(600, callback=NoResets())
    model.enable_lora()
    model.save(tmp_path / "model")
    for lora in ({"rank": 4}, None):
        with pytest.raises(
            ConfigError, match=r"adapters were made with lora=.'rank': 3., so it cannot go on"
        ):
            ARSSAC.load(tmp_path / "model", lora=lora)


def test_the_tasks_cannot_change_in_the_middle_of_a_rollout():
    model = make(n_reset=0)

    def change(locals_, globals_):
        model.set_active_tasks([0])

    with pytest.raises(ConfigError, match="in the middle of a rollout"):
        model.learn(400, callback=change)
    model.set_active_tasks(["point-east"])  # between two
    assert model.learn(10, reset_num_timesteps=False)._n_active_envs() == 1
