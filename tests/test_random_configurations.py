"""Random configurations either train or are refused by a ConfigError; nothing else comes out.

Values are drawn from what an option may be, and some from what it may not. What is trained is tiny: one to four toy
tasks, networks of one layer, up to 200 steps.
"""

import dataclasses
import io
import math
import re
import warnings
from collections import Counter

import numpy as np
import pytest
import torch as th
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ars import ARSSAC, ARSTQC, make_toy_env
from sb3_ars.envs.toy import TOY_TASKS, PointTask
from sb3_ars.errors import ConfigError, DivergedError
from sb3_ars.experiments.config import RunConfig, build, plain_values

EXPECTED = (  # warnings a run may give: ours, and one of SB3's
    r"^learning_starts=\d+ leaves no updates in \d+ steps",
    r"^param_resets=.* reaches beyond this call's \d+ steps",
    r"^The reset due at step \d+ is left out",
    r"^The adapters of lora are due at step \d+",
    r"^The reward scales stay as they were",
    r"^(execution|precision|overlap)=.* (runs|needs|is|has)",
    r"^`n_steps=3` is ignored because a custom `replay_buffer_class` \(`NStepReplayBuffer`\)",  # SB3's, of load()
)

numbers = st.sampled_from([0, 1, -1, 3, 0.5, -0.5, 1e30, 10**30, math.nan, math.inf, True, np.float32(0.5)])
nonsense = st.one_of(
    numbers,
    st.none(),
    st.sampled_from(["", "auto", "mean", "fast", "1"]),
    st.sampled_from([[], [1], ["a"], {}, {"name": "moore"}, {"rank": 0}, (1, "step"), object, b"x"]),
)

BODIES = [
    None,
    {"name": "multi_head"},
    {"name": "multi_head", "task_in_input": False},
    {"name": "moore", "n_experts": 2},
    {"name": "paco", "n_parameter_sets": 2},
    {"name": "soft_modules", "n_layers": 2, "n_modules": 2, "module_width": 4, "gate_width": 4},
    {"name": "popart", "update_period": 2},
]

policy_options = st.fixed_dictionaries(
    {"net_arch": st.sampled_from([[4], [4, 4], [], {"pi": [4], "qf": [6]}])},
    optional={
        "critic_layer_norm": st.booleans(),
        "std": st.sampled_from(["exp", "softplus"]),
        "weight_init": st.sampled_from(["torch", "xavier"]),
        "activation_fn": st.sampled_from([th.nn.ReLU, th.nn.Tanh, None]),
        "critic_activation_fn": st.sampled_from([th.nn.ELU, None]),
        "n_critics": st.integers(1, 3),
        "body": st.sampled_from(BODIES),
        "critic_body": st.sampled_from([*BODIES, "same"]),
    },
)

ALLOWED = {
    "learning_rate": st.sampled_from([1e-3, 0, lambda progress: 1e-3 * progress]),
    "buffer_size": st.sampled_from([8, 30, 1000]),
    "learning_starts": st.sampled_from(["auto", 0, 40, 150]),
    "batch_size": st.sampled_from([1, 4, 8]),
    "tau": st.sampled_from([0.005, 1, 0.0]),
    "gamma": st.sampled_from([0.9, 0, 1.0]),
    "train_freq": st.sampled_from([1, 3, (2, "step"), (1, "episode")]),
    "gradient_steps": st.sampled_from([1, 2, -1, 0]),
    "action_noise": st.sampled_from([None, NormalActionNoise(np.zeros(2), np.ones(2))]),
    "replay_buffer_kwargs": st.sampled_from([None, {"handle_timeout_termination": False}]),
    "optimize_memory_usage": st.booleans(),
    "n_steps": st.sampled_from([1, 1, 1, 3]),
    "ent_coef": st.sampled_from(["auto", "auto_0.1", 0.1, 0]),
    "target_update_interval": st.sampled_from([1, 3]),
    "target_entropy": st.sampled_from(["auto", -1.0, 0]),
    "stats_window_size": st.sampled_from([1, 10]),
    "policy_kwargs": policy_options,
    "seed": st.sampled_from([None, 0, np.int64(7)]),
    "n_reset": st.sampled_from([None, 0, 1, 2]),
    "param_resets": st.sampled_from([None, None, [100], [60, 110], (90, 1000), []]),
    "reward_scaling": st.sampled_from(
        ["mean", "std", "normalization", "none", None, 2.0, [1.0, 2.0], [1.0, 2.0, 3.0, 4.0], {"point-north": 3}]
    ),
    "reward_floor": st.sampled_from([0.01, 1, 1e-9]),
    "reset": st.sampled_from(["actor_critic", "critic", "none", None]),
    "updates_after_reset": st.sampled_from([0, 2]),
    "actor_value": st.sampled_from(["all", "first"]),
    "precision": st.sampled_from(["auto", "fp32", "bf16"]),
    "execution": st.sampled_from(["auto", "eager", "fused"]),
    "overlap": st.sampled_from([None, False, True]),
    "gradient": st.sampled_from(["mean", "pcgrad"]),
    "task_weighting": st.sampled_from(["equal", "temperature"]),
    "max_task_loss": st.sampled_from([None, 0.5, 100]),
    "lora": st.sampled_from([None, None, {"rank": 1, "start": 0.2, "min_success": 0}, {"rank": 4}]),
}  # fmt: skip


@st.composite
def configurations(draw):
    """Draw an environment, an algorithm, its options, and how long to train."""
    names = list(ALLOWED)
    chosen = draw(st.lists(st.sampled_from(names), max_size=8, unique=True))
    options = {
        "policy_kwargs": {"net_arch": [4]},
        "batch_size": 4,
        "buffer_size": 100,
        "updates_after_reset": 2,
    }
    options |= {name: draw(ALLOWED[name]) for name in chosen}
    if draw(st.integers(0, 3)) == 0:
        options[draw(st.sampled_from(names))] = draw(nonsense)
    tasks = draw(st.sampled_from([None, *(list(TOY_TASKS[:n]) for n in (1, 2, 2, 3, 4))]))
    n_envs = draw(st.sampled_from([1, 1, 2]))
    return draw(st.sampled_from([ARSSAC, ARSTQC])), tasks, n_envs, options, draw(st.integers(120, 200))


def make_env(tasks, n_envs):
    if tasks is None:
        return DummyVecEnv([lambda: PointTask(max_episode_steps=10)] * n_envs)
    return make_toy_env(seed=0, tasks=tasks, n_envs_per_task=n_envs, max_episode_steps=10)


def is_large(value, limit=0.5):
    return isinstance(value, int | float) and value >= limit


def is_huge(value):
    return is_large(value, 1e20)


def trains(algorithm, tasks, n_envs, options, steps):
    """Train, save, load and predict; return whether it was done or refused, None where huge numbers diverged."""
    env = make_env(tasks, n_envs)
    try:
        model = algorithm("MlpPolicy", env, **options).learn(steps)
    except ConfigError as error:
        assert str(error) and "Traceback" not in str(error)
        return False
    except DivergedError:
        assert any(is_huge(options.get(name)) for name in ALLOWED) or is_large(options.get("learning_rate"))
        return None
    assert model.num_timesteps >= steps
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())
    observations = env.reset()
    actions, _ = model.predict(observations, deterministic=True)
    assert actions.shape == (env.num_envs, 2) and np.isfinite(actions).all()
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    again, _ = algorithm.load(file).predict(observations, deterministic=True)
    np.testing.assert_array_equal(actions, again)
    return True


def trains_or_is_refused(n_examples, derandomize):
    outcomes = Counter()

    @settings(
        max_examples=n_examples,
        derandomize=derandomize,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(configurations())
    def check(configuration):
        with warnings.catch_warnings(record=True) as given_warnings:
            warnings.simplefilter("always")
            outcomes[trains(*configuration)] += 1
        for warning in given_warnings:
            assert any(re.search(expected, str(warning.message)) for expected in EXPECTED), warning

    check()
    return outcomes


def test_a_random_configuration_trains_or_is_refused():
    outcomes = trains_or_is_refused(40, derandomize=True)
    assert outcomes[True] > 10 and outcomes[False] > 10  # so that both are tested


@pytest.mark.slow
def test_many_random_configurations_train_or_are_refused():
    trains_or_is_refused(1500, derandomize=False)


plain = st.recursive(
    st.one_of(nonsense, st.text(max_size=4)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.sampled_from(["name", "rank", "x", 3]), inner, max_size=2),
    ),
    max_leaves=3,
)


def right_or_wrong(cls):
    """Values for each field of a dataclass: its default, mostly, or anything."""
    values = {}
    for field in dataclasses.fields(cls):
        default = field.default if field.default is not dataclasses.MISSING else field.default_factory()
        if dataclasses.is_dataclass(default):
            values[field.name] = st.one_of(
                right_or_wrong(type(default)), right_or_wrong(type(default)), plain
            )
        else:
            values[field.name] = st.one_of(st.just(default), st.just(default), plain)
    known = st.fixed_dictionaries({}, optional=values)
    unknown = st.dictionaries(st.sampled_from([*values, "sede", 3]), plain, max_size=1)
    return st.one_of(known, known, known, st.tuples(known, unknown).map(lambda both: {**both[0], **both[1]}))


def builds_or_is_refused(n_examples, derandomize):
    outcomes = Counter()

    @settings(
        max_examples=n_examples,
        derandomize=derandomize,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(right_or_wrong(RunConfig))
    def check(values):
        try:
            config = build(RunConfig, values, "mine.yaml")
        except ConfigError as error:
            assert str(error)
            outcomes[False] += 1
        else:
            assert build(RunConfig, plain_values(config), "again") == config
            outcomes[True] += 1

    check()
    return outcomes


def test_random_mappings_build_a_configuration_or_are_refused():
    outcomes = builds_or_is_refused(200, derandomize=True)
    assert outcomes[True] > 10 and outcomes[False] > 50


@pytest.mark.slow
def test_many_random_mappings_build_a_configuration_or_are_refused():
    builds_or_is_refused(20_000, derandomize=False)
