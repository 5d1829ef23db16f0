"""Policies as files to share: they predict what the model did, and nothing that a file holds is run or believed."""

import base64
import copy
import dataclasses
import io
import json
import math
import os
import pickle
import random
import re
import subprocess
import sys
import zipfile
from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

import sb3_ars
from sb3_ars import ARSSAC, ARSTQC, ConfigError, LoadedPolicy, export_policy, load_policy, make_toy_env
from sb3_ars.evaluation import evaluate_tasks
from sb3_ars.experiments import preset_names
from sb3_ars.experiments.config import load_preset
from sb3_ars.experiments.runner import build_model
from sb3_ars.policies import ARSSACPolicy

ROOT = Path(sb3_ars.__file__).parents[1]
TASKS = ["point-east", "point-north", "point-west", "point-south"]
KINDS = {
    "plain": {},
    "multi_head": {"body": {"name": "multi_head", "task_in_input": False}},
    "soft_modules": {
        "body": {"name": "soft_modules", "n_layers": 2, "n_modules": 3, "module_width": 5, "gate_width": 7}
    },
    "moore": {"body": {"name": "moore", "n_experts": np.int64(3)}, "critic_body": None},
    "paco": {"body": {"name": "paco"}, "critic_layer_norm": True},
    "popart": {"critic_body": {"name": "popart", "update_period": 100}},
    "layer norm": {
        "critic_layer_norm": True,
        "std": "softplus",
        "weight_init": "xavier",
        "activation_fn": nn.ELU,
    },
    "no hidden layer": {"net_arch": []},
    "two architectures": {"net_arch": {"pi": [8], "qf": [16, np.int64(4)]}, "critic_activation_fn": nn.Mish},
}


def toy_model(algorithm=ARSSAC, kind="plain", env=None, policy_kwargs=None, **options):
    policy_kwargs = {"net_arch": [16, 16], **KINDS[kind], **(policy_kwargs or {})}
    scaling = "none" if kind == "popart" else "mean"
    env = make_toy_env(seed=0) if env is None else env
    model = algorithm(
        "MlpPolicy", env, policy_kwargs=policy_kwargs, batch_size=8, seed=0, device="cpu", reward_scaling=scaling,
        **options,
    )  # fmt: skip
    moved(model)
    return model


@th.no_grad()
def moved(model):
    """Move every parameter, so that biases, heads, layer norms and adapters do something."""
    for parameter in model.policy.parameters():
        parameter.add_(0.1 * th.randn_like(parameter))


def observations(rows=9):
    obs = np.random.default_rng(0).uniform(-1, 1, (rows, 10)).astype(np.float32)
    obs[:, 6:] = np.eye(4)[np.arange(rows) % 4]
    return obs


def assert_same_actions(policy, model, obs):
    for rows in (obs, obs[:1], obs[0]):
        actions, state = policy.predict(rows, deterministic=True)
        assert state is None
        np.testing.assert_array_equal(actions, model.predict(rows, deterministic=True)[0])
        sampled = []
        for one in (policy, model):
            th.manual_seed(3)
            sampled.append(one.predict(rows)[0])
        np.testing.assert_array_equal(*sampled)
        assert not np.array_equal(sampled[0], actions)


# ---------------------------------------------------------------- what goes out comes back


@pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
@pytest.mark.parametrize("kind", KINDS)
def test_a_loaded_policy_predicts_what_the_model_did_to_the_bit(algorithm, kind, tmp_path):
    model = toy_model(algorithm, kind)
    policy = load_policy(export_policy(model, tmp_path / "toy"))
    assert isinstance(policy, LoadedPolicy) and isinstance(policy.actor, BasePolicy)
    assert_same_actions(policy, model, observations())
    assert np.ptp(policy.predict(observations(), deterministic=True)[0], axis=0).min() > 1e-3
    assert (policy.algorithm, policy.task_names) == (algorithm.__name__, TASKS)
    assert policy.observation_space == model.observation_space and policy.action_space == model.action_space
    assert policy.critic is None and policy.device == th.device("cpu")
    assert [path.name for path in tmp_path.iterdir()] == ["toy.safetensors"]
    own = {name: tensor.shape for name, tensor in model.actor.state_dict().items()}
    assert {name: tensor.shape for name, tensor in policy.actor.state_dict().items()} == own


@pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
@pytest.mark.parametrize("kind", KINDS)
def test_critics_go_with_it_where_asked(algorithm, kind, tmp_path):
    model = toy_model(algorithm, kind)
    policy = load_policy(export_policy(model, tmp_path / "toy.safetensors", with_critics=True))
    obs, actions = th.from_numpy(observations()), 2 * th.rand(9, 2) - 1
    expected = model.critic.q_values(obs, actions)
    assert expected.std() > 1e-3 and th.equal(policy.critic.q_values(obs, actions), expected)
    assert_same_actions(policy, model, observations())


@pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
@pytest.mark.parametrize("lora", [{"rank": 2}, {"rank": 3, "per_task": False, "layers": "hidden"}])
def test_adapters_go_with_it_once_they_are_there(algorithm, lora, tmp_path):
    model = toy_model(algorithm, lora=lora)
    before = load_policy(export_policy(model, tmp_path / "before"))
    assert not any("lora" in name for name, _ in before.actor.named_parameters())
    model.enable_lora()
    moved(model)
    model.critic.value_scale.copy_(th.tensor([1.0, 2.0, 3.0, 4.0]))
    policy = load_policy(export_policy(model, tmp_path / "after", with_critics=True))
    assert_same_actions(policy, model, observations())
    obs, actions = th.from_numpy(observations()), th.zeros(9, 2)
    assert th.equal(policy.critic.q_values(obs, actions), model.critic.q_values(obs, actions))
    assert not np.array_equal(*(p.predict(observations(), deterministic=True)[0] for p in (before, policy)))


@pytest.mark.parametrize("options", [{"execution": "eager"}, {"execution": "fused"}, {"precision": "bf16"}])
def test_its_arithmetic_is_the_models(options, tmp_path):
    model = toy_model(policy_kwargs={"net_arch": [64, 64, 64]}, **options)
    policy = load_policy(export_policy(model, tmp_path / "toy"))
    for own, loaded in zip(model.actor.modules(), policy.actor.modules(), strict=True):
        for attribute in ("fused", "precision"):
            assert getattr(own, attribute, None) == getattr(loaded, attribute, None)
    assert_same_actions(policy, model, observations())


def test_a_plain_environment_has_no_tasks(tmp_path):
    env = gym.make("Pendulum-v1")
    model = toy_model(env=env)
    policy = load_policy(export_policy(model, tmp_path / "pendulum"))
    assert policy.task_names is None and policy.action_space == model.action_space
    obs = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    assert_same_actions(policy, model, obs)
    assert abs(policy.predict(obs, deterministic=True)[0]).max() > 0.05
    with pytest.raises(ConfigError, match=r"task=0 is not one of this model's tasks: \[\]"):
        policy.predict(obs, task=0)
    _, lengths = evaluate_policy(policy, model.get_env(), n_eval_episodes=1, return_episode_rewards=True)
    assert lengths == [200]


def test_unbounded_observations_and_64_bits_come_back_exactly(tmp_path):
    class Odd(gym.Env):
        observation_space = spaces.Box(
            np.array([-np.inf, -1 / 3, 0]), np.array([np.inf, 1e300, np.pi]), dtype=np.float64
        )
        action_space = spaces.Box(np.float32(-0.1), np.float32(2.3), (2,), np.float32)

        def reset(self, *, seed=None, options=None):
            return np.zeros(3), {}

    model = toy_model(env=Odd())
    policy = load_policy(export_policy(model, tmp_path / "odd"))
    for own, loaded in (
        (Odd.observation_space, policy.observation_space),
        (Odd.action_space, policy.action_space),
    ):
        assert own.dtype == loaded.dtype
        np.testing.assert_array_equal(own.low, loaded.low)
        np.testing.assert_array_equal(own.high, loaded.high)
    assert_same_actions(policy, model, np.random.default_rng(0).normal(size=(4, 3)))


def test_the_task_is_named_where_observations_lack_it(tmp_path):
    policy = load_policy(export_policy(toy_model(), tmp_path / "toy"))
    obs = observations()
    for task, name in enumerate(TASKS):
        with_id = np.hstack([obs[:, :6], np.tile(np.eye(4)[task], (9, 1))]).astype(np.float32)
        expected = policy.predict(with_id, deterministic=True)[0]
        for given in (task, name):
            np.testing.assert_array_equal(
                policy.predict(obs[:, :6], deterministic=True, task=given)[0], expected
            )
    with pytest.raises(ConfigError, match="say which task it is from with task="):
        policy.predict(obs[:, :6])
    with pytest.raises(ConfigError, match=r"task='point-up' is not one of this model's tasks"):
        policy.predict(obs[:, :6], task="point-up")


def test_it_is_evaluated_as_the_model_is(tmp_path):
    model = toy_model()
    policy = load_policy(export_policy(model, tmp_path / "toy"))
    env = make_toy_env(seed=1, max_episode_steps=10)
    tables = [evaluate_tasks(one, env, "env", deterministic=False).table() for one in (model, policy)]
    assert tables[0].equals(tables[1]) and len(tables[0]["return"].unique()) == 4
    other = make_toy_env(seed=1, tasks=["point-east", "point-north"])
    with pytest.raises(ConfigError, match="was trained on"):
        evaluate_tasks(policy, other, "env")
    env.seed(0)
    by_sb3 = evaluate_policy(policy, env, n_eval_episodes=4, warn=False)
    env.seed(0)
    assert evaluate_policy(model, env, n_eval_episodes=4, warn=False) == by_sb3


def test_loading_leaves_the_random_numbers_and_the_gradients_as_they_were(tmp_path):
    model = toy_model(kind="moore")
    path = export_policy(model, tmp_path / "toy", with_critics=True)
    before = th.get_rng_state(), np.random.get_state()[1].copy()
    policy = load_policy(path)
    assert th.equal(th.get_rng_state(), before[0]) and np.array_equal(np.random.get_state()[1], before[1])
    assert not any(tensor.is_meta for tensor in [*policy.actor.parameters(), *policy.critic.buffers()])
    assert all(parameter.requires_grad for parameter in policy.actor.parameters())


def test_the_same_policy_gives_the_same_bytes(tmp_path):
    model = toy_model()
    one, two = (export_policy(model, tmp_path / name).read_bytes() for name in "ab")
    assert one == two


FRESH = """
import sys
import numpy as np
from sb3_ars import load_policy
load_policy(sys.argv[1])  # what is imported on first use is
events = set()
sys.addaudithook(lambda event, _: events.add(event))
policy = load_policy(sys.argv[1])
found = sorted(events & {"pickle.find_class", "exec", "compile", "import", "os.system", "subprocess.Popen",
                         "socket.connect", "marshal.loads", "os.exec"})
print(found, "open" in events, policy.task_names)
np.save(sys.argv[3], policy.predict(np.load(sys.argv[2]), deterministic=True)[0])
"""


def test_a_fresh_process_predicts_the_same_and_runs_nothing_while_it_loads(tmp_path):
    model = toy_model(ARSTQC, "soft_modules")
    path = export_policy(model, tmp_path / "toy")
    np.save(tmp_path / "obs.npy", observations())
    out = python(FRESH, str(path), str(tmp_path / "obs.npy"), str(tmp_path / "actions.npy"))
    assert out.strip() == f"[] True {TASKS}"
    expected = model.predict(observations(), deterministic=True)[0]
    np.testing.assert_array_equal(np.load(tmp_path / "actions.npy"), expected)


def test_the_policy_of_every_preset_can_be_such_a_file(tmp_path):
    env, seen = make_toy_env(seed=0), []
    for name in preset_names():
        config = load_preset(name)
        small = dataclasses.replace(config.policy, net_arch=tuple(8 for _ in config.policy.net_arch))
        algorithm = dataclasses.replace(config.algorithm, total_timesteps=48_000, device="cpu")
        kind = (small, algorithm.algorithm, algorithm.execution, algorithm.precision, config.ars.lora is None)
        if kind in seen:
            continue
        seen.append(kind)
        model = build_model(dataclasses.replace(config, policy=small, algorithm=algorithm), env)
        if model.lora is not None:
            model.enable_lora()
        policy = load_policy(export_policy(model, tmp_path / name))
        np.testing.assert_array_equal(
            *(one.predict(observations(), deterministic=True)[0] for one in (policy, model))
        )
    assert len(seen) > 10


def python(script, *arguments):
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


# ---------------------------------------------------------------- what a file cannot hold


class OwnExtractor(FlattenExtractor):
    pass


class OwnActivation(nn.ReLU):
    pass


class OwnPolicy(ARSSACPolicy):
    pass


class Images(gym.Env):
    observation_space = spaces.Box(0, 255, (36, 36, 1), np.uint8)
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros((36, 36, 1), np.uint8), {}


def with_a_layer_of_its_own():
    model = toy_model()
    model.actor.latent_pi.append(nn.Linear(16, 16))
    return model


def with_nan():
    model = toy_model()
    with th.no_grad():
        model.actor.mu.bias[0] = np.nan
    return model


CANNOT = {
    "features extractor": (
        lambda: toy_model(policy_kwargs={"features_extractor_class": OwnExtractor}),
        r"features_extractor_class=OwnExtractor is code.*wrapper of the environment",
    ),
    "activation": (
        lambda: toy_model(policy_kwargs={"activation_fn": OwnActivation}),
        r"activation_fn=OwnActivation is none of the activations.*'ReLU', 'Tanh'.*or save\(\)",
    ),
    "policy class": (
        lambda: ARSSAC(OwnPolicy, make_toy_env(seed=0), device="cpu"),
        r"policy=OwnPolicy is a class of its own.*Save it with save\(\)",
    ),
    "images": (
        lambda: ARSSAC("CnnPolicy", Images(), device="cpu", buffer_size=100),
        r"observations that are vectors of floating-point numbers, but this model's are Box",
    ),
    "VecNormalize": (
        lambda: toy_model(env=VecNormalize(make_toy_env(seed=0), norm_reward=False)),
        r"VecNormalize\(norm_obs=True\) has statistics.*norm_obs=False.*export_onnx",
    ),
    "another algorithm": (lambda: SAC("MlpPolicy", "Pendulum-v1", device="cpu"), "not SAC"),
    "a layer of its own": (with_a_layer_of_its_own, r"not those of its options .*latent_pi\.4\.weight.*save\(\)"),
    "NaN": (with_nan, r"'actor\.mu\.bias' holds NaN or infinity, so the policy is lost"),
    "a name with a command": (
        lambda: toy_model(env=make_named_env("\x1b[2J")),
        r"task_names=\['\\x1b\[2J'.* must be texts that can be printed",
    ),
}  # fmt: skip


def make_named_env(name):
    env = make_toy_env(seed=0)
    env.task_names = [name, *list(env.task_names)[1:]]
    return env


@pytest.mark.parametrize("what", CANNOT)
def test_what_needs_code_is_refused_with_the_option_and_the_remedy(what, tmp_path):
    make, message = CANNOT[what]
    model = make()
    with pytest.raises(ConfigError, match=message):
        export_policy(model, tmp_path / "policy")
    assert list(tmp_path.iterdir()) == []


def test_critics_that_need_code_stay_behind_and_the_policy_goes(tmp_path):
    model = toy_model(policy_kwargs={"critic_activation_fn": OwnActivation})
    assert_same_actions(load_policy(export_policy(model, tmp_path / "toy")), model, observations())
    with pytest.raises(ConfigError, match="critic_activation_fn=OwnActivation is none of the activations"):
        export_policy(model, tmp_path / "other", with_critics=True)
    assert [path.name for path in tmp_path.iterdir()] == ["toy.safetensors"]


def test_an_unwritable_path_or_another_suffix_is_refused_and_leaves_nothing(tmp_path):
    model = toy_model()
    with pytest.raises(ConfigError, match=r"named \*\.safetensors, not to policy\.zip"):
        export_policy(model, tmp_path / "policy.zip")
    with pytest.raises(ConfigError, match="cannot be written"):
        export_policy(model, tmp_path / "nowhere" / "policy")
    (tmp_path / "policy.safetensors").mkdir()
    with pytest.raises(ConfigError, match="cannot be written"):
        export_policy(model, tmp_path / "policy")
    assert [path.name for path in tmp_path.iterdir()] == ["policy.safetensors"]


# ---------------------------------------------------------------- files that are damaged or lie


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """A small file whose bytes depend on no version and no random numbers."""
    return small_file(toy_model(policy_kwargs={"net_arch": [4]}), tmp_path_factory)


@pytest.fixture(scope="module")
def contents(content, tmp_path_factory):
    """That file, one with a body and critics, and one with adapters."""
    with_body = toy_model(
        ARSTQC, policy_kwargs={"net_arch": [4], "body": {"name": "moore"}, "n_quantiles": 3}
    )
    with_adapters = toy_model(policy_kwargs={"net_arch": [4], "critic_layer_norm": True}, lora={"rank": 1})
    with_adapters.enable_lora()
    others = (small_file(model, tmp_path_factory, critics=True) for model in (with_body, with_adapters))
    return [content, *others]


def small_file(model, tmp_path_factory, critics=False):
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.copy_(th.linspace(-0.5, 0.75, parameter.numel()).view_as(parameter))
    path = export_policy(model, tmp_path_factory.mktemp("file") / "p", critics)
    header, data = unpacked(path.read_bytes())
    description = json.loads(header["__metadata__"]["sb3_ars"])
    return packed(header, data, description | {"sb3_ars": "0.0.0"})


def unpacked(content):
    length = int.from_bytes(content[:8], "little")
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def packed(header, data, description=None):
    """A file's bytes; a text is taken as it is."""
    if description is not None:
        text = description if isinstance(description, str) else json.dumps(description)
        header = header | {"__metadata__": {"sb3_ars": text}}
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def described(content, **changes):
    """The file with something else in its description; dots lead inwards, ``...`` deletes."""
    header, data = unpacked(content)
    description = json.loads(header["__metadata__"]["sb3_ars"])
    for where, value in changes.items():
        *outer, last = where.split("__")
        inner = description
        for key in outer:
            inner = inner[key]
        if value is ...:
            del inner[last]
        else:
            inner[last] = value
    return packed(header, data, description)


def in_header(content, name, **changes):
    header, data = unpacked(content)
    return packed(header | {name: header[name] | changes}, data)


def with_text(content, old, new):
    """The file with another text in its description."""
    header, data = unpacked(content)
    text = header["__metadata__"]["sb3_ars"]
    assert old in text
    return packed(header, data, text.replace(old, new, 1))


def with_number(content, value):
    return content[:-4] + np.float32(value).tobytes()


def refusal(content, folder):
    """What load_policy says of these bytes; it must refuse them."""
    path = folder / "policy.safetensors"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_policy(path)
    said = str(caught.value)
    assert said.startswith(f"{path} cannot be loaded as a policy: ") and said.endswith(".")
    assert len(said) < 1000 and said.isprintable()
    return said


def pickled_model():
    file = io.BytesIO()
    toy_model().save(file)
    return file.getvalue()


DAMAGED = {
    "empty": (lambda c: b"", "it is empty"),
    "text": (lambda c: b"hello, this is no policy", "it is no safetensors file"),
    "a zip": (lambda c: pickled_model(), r"it is a zip, as save\(\) writes.*can run any code.*ARSSAC\.load"),
    "a pickle": (lambda c: pickle.dumps({"a": np.zeros(9)}), "it looks like a pickle, which can run any code"),
    "shorter than its length": (lambda c: c[:5], "it is no safetensors file"),
    "cut off in the header": (lambda c: c[:200], "was cut off in its header"),
    "cut off": (lambda c: c[:-3], "it was cut off: 3 bytes are missing at its end"),
    "more than it says": (lambda c: c + b"more", "it has 4 bytes more than its header says"),
    "a header of no JSON": (lambda c: packed(b"{]", b""), "its header is not the JSON that export_policy writes"),
    "a header of no UTF-8": (lambda c: packed(b"\xff\xfe", b""), "its header is no UTF-8"),
    "a header of another kind": (lambda c: packed(b"[]", b""), "its header is no mapping"),
    "deep": (lambda c: packed(b"[" * 100_000, b""), "its header is not the JSON"),
    "no metadata": (lambda c: packed({}, b""), "it has no description of a policy"),
    "other metadata": (
        lambda c: packed({"__metadata__": {"sb3_ars": "{}", "format": "pt"}}, b""),
        "it has no description of a policy, and nothing else",
    ),
    "a name twice": (
        lambda c: packed(b'{"a":{"dtype":"F32"},"a":{}}', b""), "the name 'a' is there twice",
    ),
    "a key twice": (
        lambda c: with_text(c, '"fused": true', '"fused": true, "fused": false'), "the name 'fused' is there twice",
    ),
    "another type of tensor": (
        lambda c: in_header(c, "actor.mu.bias", dtype="F16"), "tensor 'actor.mu.bias' is of type 'F16', not F32",
    ),
    "another shape": (
        lambda c: in_header(c, "actor.mu.weight", shape=[4, 2]),
        r"tensor 'actor.mu.weight' has shape \[4, 2\], but the network's has \[2, 4\]",
    ),
    "a negative shape": (lambda c: in_header(c, "actor.mu.bias", shape=[-2]), r"has shape \[-2\]"),
    "a huge shape": (lambda c: in_header(c, "actor.mu.bias", shape=[10**18]), r"has shape \[1000000000000000000\]"),
    "offsets that lie": (
        lambda c: in_header(c, "actor.mu.bias", data_offsets=[0, 8]), "its tensors cannot be read",
    ),
    "an entry of another kind": (
        lambda c: in_header(c, "actor.mu.bias", more=1), "'actor.mu.bias' is not described as safetensors does",
    ),
    "NaN": (lambda c: with_number(c, np.nan), "holds NaN or infinity"),
    "infinity": (lambda c: with_number(c, -np.inf), "holds NaN or infinity"),
    "a later format": (
        lambda c: described(c, format=2, sb3_ars="9.9", more=1),
        "it has format 2, but this version of sb3_ars reads format 1.*wrote it, '9.9'",
    ),
    "a format of another kind": (lambda c: described(c, format=True), r"format=True is none of \[1\]"),
    "a description of another kind": (lambda c: packed(unpacked(c)[0], unpacked(c)[1], []), r"\[\] is no mapping"),
    "an unknown key": (lambda c: described(c, actor__layers=[4]), "actor: 'layers' is none of"),
    "a key nearly right": (lambda c: described(c, fuse=True), "'fuse' is none of .*Did you mean 'fused'"),
    "a missing key": (lambda c: described(c, precision=...), "precision not there"),
    "algorithm": (lambda c: described(c, algorithm="SAC"), r"algorithm='SAC' is none of \['ARSSAC', 'ARSTQC'\]"),
    "algorithm of another kind": (lambda c: described(c, algorithm=["ARSSAC"]), r"algorithm=\['ARSSAC'\] is none"),
    "a version of another kind": (lambda c: described(c, sb3_ars=1), "sb3_ars=1 must be a version"),
    "fused": (lambda c: described(c, fused=1), r"fused=1 is none of \[False, True\]"),
    "precision": (lambda c: described(c, precision="fp8"), "precision='fp8' is none of"),
    "no tasks": (lambda c: described(c, task_names=[]), "must be texts that can be printed"),
    "a task that is no text": (lambda c: described(c, task_names=["a", 1]), "must be texts that can be printed"),
    "a task's half of a character": (
        lambda c: described(c, task_names=["a\ud800"]), "must be texts that can be printed",
    ),
    "tasks of another kind": (lambda c: described(c, task_names="abcd"), "task_names='abcd' must be a list"),
    "a task twice": (lambda c: described(c, task_names=["a", "b", "a"]), "has a name twice"),
    "too many tasks": (
        lambda c: described(c, task_names=[f"t{i}" for i in range(10)]), "cannot end in a one-hot of 10 tasks",
    ),
    "a space of another kind": (lambda c: described(c, action_space=[-1, 1]), "action_space: .*is no mapping"),
    "bounds of another kind": (
        lambda c: described(c, action_space__low=["0", "0"]), 'low=.* must be numbers, "inf" or "-inf"',
    ),
    "bounds the wrong way round": (
        lambda c: described(c, action_space__low=[2, 2]), "none may be above the other",
    ),
    "bounds that are no list": (lambda c: described(c, action_space__low=-1), "action_space: low=-1 must be a list"),
    "too few bounds": (lambda c: described(c, observation_space__low=[0]), r"does not go with its 1 bounds low"),
    "a shape that lies": (lambda c: described(c, observation_space__shape=[10**9]), r"shape=\[1000000000\] does not"),
    "unbounded actions": (
        lambda c: described(c, action_space__high=["inf", 1]), "action_space has no bounds",
    ),
    "bounds that do not fit": (
        lambda c: described(c, action_space__high=[1e300, 1]), "holds numbers that are none of float32",
    ),
    "a number beyond all types": (
        lambda c: described(c, action_space__high=[10**400, 1]), "must be numbers",
    ),
    "a number of too many digits": (
        lambda c: with_text(c, '"high": [1.0', f'"high": [{"1" * 5000}'), "its description is not the JSON",
    ),
    "Infinity": (lambda c: with_text(c, '"high": [1.0', '"high": [Infinity'), "the number Infinity"),
    "1e999": (lambda c: with_text(c, '"high": [1.0', '"high": [1e999'), "the number 1e999"),
    "NaN in JSON": (lambda c: with_text(c, '"high": [1.0', '"high": [NaN'), "the number NaN"),
    "dtype": (lambda c: described(c, observation_space__dtype="object"), "dtype='object' is none of"),
    "net_arch": (lambda c: described(c, actor__net_arch=[0]), "actor: net_arch=0 must be an integer of at least 1"),
    "net_arch of fractions": (lambda c: described(c, actor__net_arch=[4.0]), "net_arch=4.0 must be an integer"),
    "net_arch of another kind": (lambda c: described(c, actor__net_arch={"pi": [4]}), "must be a list"),
    "another net_arch": (lambda c: described(c, actor__net_arch=[3]), "shape .*, but the network's has .3, 10"),
    "a layer too many": (lambda c: described(c, actor__net_arch=[4, 4]), "latent_pi.2.weight' is not there"),
    "a layer too few": (lambda c: described(c, actor__net_arch=[]), r"'actor.mu.weight' has shape \[2, 4\], but"),
    "activation": (lambda c: described(c, actor__activation="os.system"), "activation='os.system' is none of"),
    "std": (lambda c: described(c, actor__std="log"), "std='log' is none of"),
    "an unknown body": (lambda c: described(c, actor__body={"name": "moor"}), "unknown.*Did you mean 'moore'"),
    "a body of another kind": (lambda c: described(c, actor__body=["moore"]), "must be a mapping of options"),
    "a body's option": (lambda c: described(c, actor__body={"name": "moore", "k": 1}), "has no option 'k'"),
    "a body that is not there": (lambda c: described(c, actor__body={"name": "multi_head"}), "is not there"),
    "popart as body": (lambda c: described(c, actor__body={"name": "popart"}), "output layer of critics"),
    "a body without tasks": (
        lambda c: described(c, actor__body={"name": "multi_head"}, task_names=None), "body and lora need task_names",
    ),
    "critics that are not there": (
        lambda c: described(c, critic={"net_arch": [], "activation": "relu", "body": None, "layer_norm": False,
                                       "n_critics": 1, "n_quantiles": None}),
        "tensor 'critic.qf0.0.weight' is not there",
    ),
    "quantiles of the wrong algorithm": (
        lambda c: described(c, critic={"net_arch": [], "activation": "relu", "body": None, "layer_norm": False,
                                       "n_critics": 1, "n_quantiles": 5}),
        "n_quantiles=5 is not ARSSAC's",
    ),
    "critics of another kind": (lambda c: described(c, critic=True), "critic: True is no mapping"),
    "lora": (lambda c: described(c, lora={"ranks": 2}), "lora has no option 'ranks'"),
    "lora with a body": (
        lambda c: described(c, lora={}, actor__body={"name": "paco"}), "lora adapts the plain network",
    ),
    "adapters that are not there": (lambda c: described(c, lora={"rank": 1}), "lora_a' is not there"),
}  # fmt: skip


@pytest.mark.parametrize("what", DAMAGED)
def test_a_damaged_file_is_refused_and_the_message_says_what_is_wrong(what, content, tmp_path):
    change, message = DAMAGED[what]
    said = refusal(change(content), tmp_path)
    assert re.search(message, said), said


def test_the_file_that_those_are_made_of_loads(content, tmp_path):
    (tmp_path / "policy.safetensors").write_bytes(content)
    assert load_policy(tmp_path / "policy.safetensors").task_names == TASKS
    (tmp_path / "same.safetensors").write_bytes(described(content, task_names=["a", "b", "c", "d"]))
    assert load_policy(tmp_path / "same.safetensors").task_names == ["a", "b", "c", "d"]


def test_what_is_no_file_is_refused(tmp_path):
    with pytest.raises(
        ConfigError, match=r"none\.safetensors cannot be loaded as a policy: there is no such file"
    ):
        load_policy(tmp_path / "none.safetensors")
    with pytest.raises(ConfigError, match="it is a folder"):
        load_policy(tmp_path)
    with pytest.raises(ConfigError, match="cannot be loaded as a policy"):
        load_policy(tmp_path / ("x" * 5000))
    os.mkfifo(tmp_path / "pipe")  # reading it would wait for ever
    with pytest.raises(ConfigError, match="there is no such file"):
        load_policy(tmp_path / "pipe")


def test_every_truncation_is_refused(content, tmp_path):
    for length in range(0, len(content), 7):
        refusal(content[:length], tmp_path)


HUGE = """
import resource, signal, sys
from pathlib import Path
from sb3_ars import ConfigError, load_policy
load_policy(sys.argv[1])
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, used + 2**28))
signal.alarm(120)  # for a loop that does not end
for path in sorted(Path(sys.argv[2]).iterdir()):
    try:
        load_policy(path)
    except ConfigError as error:
        print(path.stem, "REFUSED", error)
    else:
        print(path.stem, "LOADED")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits the address space as Linux does")
def test_a_file_that_asks_for_a_huge_network_is_refused_before_it_is_built(content, tmp_path):
    (tmp_path / "good").mkdir()
    (tmp_path / "good" / "p.safetensors").write_bytes(content)
    huge = 10**9
    layers = {"name": "soft_modules", "n_layers": huge}
    critic = {
        "net_arch": [], "activation": "relu", "body": None, "layer_norm": False, "n_critics": 1, "n_quantiles": None,
    }  # fmt: skip
    header, data = unpacked(content)
    # a tensor that has room for a million of everything, so that each number alone is none too many
    wide = header | {
        "wide": {"dtype": "F32", "shape": [1, 10**6], "data_offsets": [len(data), len(data) + 4 * 10**6]}
    }
    wide = packed(wide, data + bytes(4 * 10**6))
    million = {"net_arch": [10**6], "body": {"name": "moore", "n_experts": 10**6}}
    files = {
        "width": described(content, actor__net_arch=[huge]),
        "depth": described(content, actor__net_arch=[1] * 100_000),
        "experts": described(
            content, actor__body={"name": "moore", "n_experts": huge}, actor__net_arch=[huge]
        ),
        "sets": described(content, actor__body={"name": "paco", "n_parameter_sets": huge}),
        "layers": described(content, actor__body=layers),
        "modules": described(content, actor__body={"name": "soft_modules", "n_modules": huge}),
        "gate": described(content, actor__body={"name": "soft_modules", "n_layers": 1, "gate_width": huge}),
        "rank": described(content, lora={"rank": huge}),
        "critics": described(content, critic=critic | {"n_critics": huge}),
        "critic-width": described(content, critic=critic | {"net_arch": [huge]}),
        "quantiles": described(content, algorithm="ARSTQC", critic=critic | {"n_quantiles": huge}),
        "shape": described(content, observation_space__shape=[huge]),
        "copies": described(wide, actor=json.loads(header["__metadata__"]["sb3_ars"])["actor"] | million),
        "wide": described(wide, actor__net_arch=[10**6, 10**6]),
        "header": (2**40).to_bytes(8, "little") + content[8:],
    }
    (tmp_path / "bad").mkdir()
    for name, changed in files.items():
        (tmp_path / "bad" / f"{name}.safetensors").write_bytes(changed)
    lines = python(HUGE, str(tmp_path / "good" / "p.safetensors"), str(tmp_path / "bad")).splitlines()
    assert [line.split()[:2] for line in lines] == [[name, "REFUSED"] for name in sorted(files)]
    said = {line.split()[0]: line for line in lines}
    for name in (
        "width",
        "depth",
        "experts",
        "sets",
        "layers",
        "modules",
        "gate",
        "rank",
        "critics",
        "copies",
    ):
        assert "more than its tensors have room for" in said[name], said[name]


# ---------------------------------------------------------------- files that attack


class Payload:
    """A pickle of it writes a file where it is loaded."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def attacks(marker, content):
    payload = pickle.dumps(Payload(marker))
    serialized = {":type:": "<class 'dict'>", ":serialized:": base64.b64encode(payload).decode()}
    archive, weights = io.BytesIO(), io.BytesIO()
    th.save({"a": Payload(marker)}, weights)
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("data", json.dumps({"policy_class": serialized}))
        file.writestr("policy.pth", weights.getvalue())
        file.writestr("data.pkl", payload)
    command = f"!!python/object/apply:os.system ['touch {marker}']"
    yield "pickle", payload
    yield "old pickle", pickle.dumps(Payload(marker), protocol=0)
    yield "torch's zip", weights.getvalue()
    yield "SB3's zip", archive.getvalue()
    yield "pickle in the place of a header", packed(payload, b"")
    yield "pickle in the place of a description", packed(*unpacked(content), payload.decode("latin-1"))
    for key in ("algorithm", "actor__activation", "actor__std", "precision", "observation_space__dtype"):
        yield key, described(content, **{key: command})
        yield f"{key} as SB3 would", described(content, **{key: serialized})
    yield "body", described(content, actor__body={"name": command})
    yield "YAML", packed(*unpacked(content), command)
    yield (
        "a class",
        described(content, actor__activation=f"__import__('pathlib').Path({str(marker)!r}).touch()"),
    )


def test_no_file_runs_code(content, tmp_path):
    marker = tmp_path / "marker"
    pickle.loads(pickle.dumps(Payload(marker)))
    assert marker.exists()  # so would any of these, where it is unpickled
    marker.unlink()
    names = []
    for name, attack in attacks(marker, content):
        refusal(attack, tmp_path)
        assert not marker.exists(), name
        names.append(name)
    assert len(names) == 19
    (tmp_path / "policy.safetensors").write_bytes(
        described(content, task_names=["a", f"!!python/object/apply:os.system ['touch {marker}']"])
    )
    assert len(load_policy(tmp_path / "policy.safetensors").task_names) == 2 and not marker.exists()


# ---------------------------------------------------------------- fuzzing


def deep(levels):
    value = []
    for _ in range(levels):
        value = [value]
    return value


VALUES = [
    None, True, False, -1, 0, 1, 2, 4, 10, 10**9, 2**31, 2**63, 10**18, 10**300, -(10**18), 0.5, 1e-320, 1e308, -0.0,
    "", "relu", "inf", "-inf", "nan", "ARSTQC", "float64", "float16", "bf16", "moore", "popart", "\x00", "\x1b[2J",
    "\ud800", "\u202eabc", "\U0001f9ff", "a" * 5000, "../../etc/passwd", "!!python/object/apply:os.system [true]",
    [], {}, [1], [4], [4, 4], [1.5], [[4]], ["inf"], [None] * 300, [10**9] * 3, deep(60), {"": {}},
    {"name": "moore"}, {"name": "soft_modules", "n_layers": 10**8}, {"name": "popart"}, {"rank": 1}, {"rank": 10**9},
    {"py/object": "os.system"}, {"shape": [1], "dtype": "float32", "low": [0], "high": [1]},
]  # fmt: skip


def nodes(value, found=None):
    """Every container inside a JSON value with each of its keys."""
    found = [] if found is None else found
    for key in value if isinstance(value, dict) else range(len(value)):
        found.append((value, key))
        if isinstance(value[key], dict | list):
            nodes(value[key], found)
    return found


def mutated_json(value, draw):
    """A JSON value with one to three of its parts replaced, renamed, removed, doubled or exchanged."""
    value = copy.deepcopy(value)
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        places = nodes(value)
        if not places:
            break
        inner, key = draw.choice(places)
        how = draw.randrange(6)
        if how <= 2:
            inner[key] = copy.deepcopy(draw.choice(VALUES))
        elif how == 3:
            del inner[key]
        elif how == 4 and isinstance(inner, dict):
            inner[draw.choice(("more", "", "actor", "name", "\ud800", "a" * 2000))] = inner[key]
        elif how == 4:
            inner.insert(key, copy.deepcopy(draw.choice(VALUES)))
        else:
            other, other_key = draw.choice(places)
            if other is not inner and isinstance(other, type(inner)):
                continue
            inner[key], other[other_key] = copy.deepcopy(other[other_key]), copy.deepcopy(inner[key])
    return value


def flipped(content, draw):
    changed = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 8, 64))):
        changed[draw.randrange(len(changed))] ^= 1 << draw.randrange(8)
    return bytes(changed)


def truncated(content, draw):
    return content[: draw.randrange(len(content))]


def inserted(content, draw):
    at = draw.randrange(len(content) + 1)
    return content[:at] + draw.randbytes(draw.choice((1, 4, 8, 100, 5000))) + content[at:]


def removed(content, draw):
    at = draw.randrange(len(content))
    return content[:at] + content[at + draw.choice((1, 4, 8, 100)) :]


def relengthened(content, draw):
    length = int.from_bytes(content[:8], "little")
    length = draw.choice(
        (0, 1, 2, length - 1, length + 1, length + 8, len(content) - 8, len(content), 2**20, 2**31, 2**63, 2**64 - 1,
         draw.randrange(2**16))
    )  # fmt: skip
    return length.to_bytes(8, "little") + content[8:]


def of_header(content, draw):
    header, data = unpacked(content)
    return packed(mutated_json(header, draw), data)


def of_description(content, draw):
    header, data = unpacked(content)
    return packed(header, data, mutated_json(json.loads(header["__metadata__"]["sb3_ars"]), draw))


def of_text(content, draw):
    """Something else that JSON readers may or may not take, at any place of the description."""
    header, data = unpacked(content)
    text = header["__metadata__"]["sb3_ars"]
    at = draw.randrange(len(text))
    new = draw.choice(
        ("NaN", "Infinity", "-Infinity", "1e999", "9" * 5000, "[" * 5000, '{"a":' * 5000, "[" * 900 + "]" * 900,
         "//", ",",         "\\u0000", "\\ud800", "null", '"', "\ufeff", "\u2028", "1" * 40, '"format": 1, ')
    )  # fmt: skip
    return packed(header, data, text[:at] + new + text[at + draw.choice((0, 0, 1, 4)) :])


def of_numbers(content, draw):
    header, data = unpacked(content)
    changed = bytearray(data)
    at = 4 * draw.randrange(len(data) // 4)
    changed[at : at + 4] = np.float32(
        draw.choice((math.nan, math.inf, -math.inf, 3e38, 1e-45, 0.0))
    ).tobytes()
    return packed(header, bytes(changed))


MUTATIONS = (
    flipped, truncated, inserted, removed, relengthened, of_header, of_header, of_description, of_description,
    of_description, of_text, of_numbers,
)  # fmt: skip


def state_of(policy):
    critic = {} if policy.critic is None else policy.critic.state_dict()
    return policy.actor.state_dict() | {f"critic.{key}": value for key, value in critic.items()}


def fuzz(contents, n_files, folder):
    """Load mutated files; return how often each kind of mutation was refused and loaded. Only those may happen."""
    path, outcomes = folder / "policy.safetensors", Counter()
    own = []
    for content in contents:
        path.write_bytes(content)
        own.append(state_of(load_policy(path)))
    for index in range(n_files):
        draw = random.Random(index)
        mutate, original = draw.choice(MUTATIONS), own[index % len(own)]
        path.write_bytes(mutate(contents[index % len(own)], draw))
        try:
            policy = load_policy(path)
        except ConfigError as error:
            said = str(error)
            assert said.startswith(str(path)) and said.isprintable() and len(said) < 1000, (index, said)
            outcomes["refused", mutate.__name__] += 1
            continue
        except BaseException as error:
            raise AssertionError(
                f"file {index}, {mutate.__name__}: {type(error).__name__} {error}"
            ) from error
        outcomes["loaded", mutate.__name__] += 1
        state = state_of(policy)
        assert {key: value.shape for key, value in state.items()} == {
            key: value.shape for key, value in original.items()
        }
        assert all(th.isfinite(value).all() for value in state.values()), index
        names = policy.task_names
        assert names is None or all(isinstance(name, str) and name.isprintable() for name in names)
        if all(th.equal(state[key], original[key]) for key in original):
            actions = policy.predict(observations(3), deterministic=True)[0]
            assert actions.shape == (3, 2) and policy.action_space.contains(actions[0])
    return outcomes


def counts(outcomes):
    return {
        what: sum(n for (kind, _), n in outcomes.items() if kind == what) for what in ("refused", "loaded")
    }


def test_a_few_hundred_mutated_files_are_refused_or_load(contents, tmp_path):
    outcomes = fuzz(contents, 400, tmp_path)
    assert {name for _, name in outcomes} == {mutate.__name__ for mutate in MUTATIONS}
    found = counts(outcomes)
    assert found["refused"] + found["loaded"] == 400 and found["refused"] > 300 and found["loaded"] > 10


@pytest.mark.slow
def test_ten_thousand_mutated_files_are_refused_or_load(contents, tmp_path):
    outcomes = fuzz(contents, 10_000, tmp_path)
    assert counts(outcomes) == {"refused": 9048, "loaded": 952}, outcomes


@pytest.mark.gpu
@pytest.mark.parametrize("kind", ["plain", "moore"])
def test_a_policy_goes_to_a_gpu_and_back(kind, tmp_path):
    model = ARSSAC(
        "MlpPolicy", make_toy_env(seed=0), policy_kwargs={"net_arch": [16, 16], **KINDS[kind]}, device="cuda"
    )
    path = export_policy(model, tmp_path / "toy", with_critics=True)
    for device, tolerance in (("cuda", 0), ("cpu", 1e-5)):
        policy = load_policy(path, device=device)
        assert policy.device.type == device
        actions, _ = policy.predict(observations(), deterministic=True)
        expected, _ = model.predict(observations(), deterministic=True)
        np.testing.assert_allclose(actions, expected, rtol=0, atol=tolerance)
