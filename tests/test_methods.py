"""The paper's methods inside the algorithms: every one trains, resets, saves, loads, predicts, and composes."""

import numpy as np
import pytest
import torch as th

from sb3_ars import ARSSAC, ARSTQC, ConfigError, make_multitask_env, make_toy_env
from sb3_ars.core.gradients import MeanGradient, PCGrad
from sb3_ars.envs.toy import PointTask
from sb3_ars.experiments.config import load_preset
from sb3_ars.experiments.runner import build_model
from sb3_ars.nets.layers import ByTask

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
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        make(**options)


def test_what_needs_several_tasks_is_refused_with_one():
    one = {"point": PointTask}
    with pytest.raises(ConfigError, match="gradient='pcgrad' projects one task's gradient on another's"):
        make(env=make_multitask_env(one, seed=0, n_workers=0), gradient="pcgrad")
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
