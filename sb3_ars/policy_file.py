"""A trained policy as one file to share: tensors and JSON, loading which executes nothing; knows no environments.

The file is safetensors: eight bytes with the length of a JSON header, the header, the tensors. The header's metadata
hold one text, ``sb3_ars``, which is JSON again: what the networks are built from, a
:class:`~sb3_ars.policy_description.PolicyDescription`. Nothing of a file is believed. Every key is known and there
once, every value checked; networks are laid out without memory first, and what the file holds is read only where its
tensors are theirs by name, shape and type. So what loading takes is bounded by what the file has.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import safetensors.torch
import torch as th
from gymnasium import spaces
from safetensors import SafetensorError
from stable_baselines3.common.torch_layers import FlattenExtractor, get_actor_critic_arch
from stable_baselines3.common.utils import get_device
from torch import nn

from sb3_ars import __version__
from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm
from sb3_ars.algorithms.sac import ARSSAC
from sb3_ars.algorithms.sb3_options import check_sb3_options
from sb3_ars.algorithms.tqc import ARSTQC
from sb3_ars.errors import ConfigError, check_path
from sb3_ars.files import write_whole
from sb3_ars.nets.bodies import body_config
from sb3_ars.nets.lora import LoRAConfig
from sb3_ars.nets.mlp import fused_layers_are_available, set_arithmetic
from sb3_ars.policies import ARSSACPolicy, ARSTQCPolicy
from sb3_ars.policy_description import (
    ACTIVATIONS,
    FORMAT,
    ActorDescription,
    CriticDescription,
    PolicyDescription,
    SpaceDescription,
    one_line,
    parsed_json,
    shown,
)
from sb3_ars.task_id import with_task_id

__all__ = ["LoadedPolicy", "export_policy", "load_policy"]

SUFFIX = ".safetensors"

_KEY = "sb3_ars"  # of the description, among safetensors' metadata
_MAX_HEADER = 2**20  # bytes: observations of 20,000 numbers have room, and a header takes a moment to read
_MAX_COPIES = 10_000  # layers that all copies in a body come to; the paper's largest is 20 sets of 4 layers
_ALGORITHMS: dict[str, type[MultiTaskOffPolicyAlgorithm]] = {"ARSSAC": ARSSAC, "ARSTQC": ARSTQC}


@dataclass(frozen=True, eq=False)
class LoadedPolicy:
    """What :func:`load_policy` returns: a policy that predicts as the model did, and knows its tasks and spaces.

    :param actor: SB3's policy inside, a :class:`~stable_baselines3.common.policies.BasePolicy`
    :param critic: the critics, where the file has them
    :param algorithm: "ARSSAC" or "ARSTQC"
    :param task_names: the tasks in the order of the one-hot, ``None`` for a plain environment
    :param observation_space: of observations with the one-hot
    :param action_space: of the actions
    """

    actor: Any
    critic: Any
    algorithm: str
    task_names: list[str] | None
    observation_space: spaces.Box
    action_space: spaces.Box

    @property
    def device(self) -> th.device:
        """Where the networks are."""
        device: th.device = self.actor.device
        return device

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        task: str | int | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return actions as the model's ``predict`` does; ``task`` appends the one-hot id to observations without it.

        :param observation: ``(obs_dim,)`` or ``(n, obs_dim)``
        :param state: unused by these policies
        :param episode_start: unused by these policies
        :param deterministic: mean action instead of a sample
        :param task: name or index of the task all rows belong to
        :raises ConfigError: if the policy has no such task, or the one-hot is missing and ``task`` is not given
        """
        observation = with_task_id(observation, task, self.task_names, self.observation_space)
        actions: tuple[np.ndarray, tuple[np.ndarray, ...] | None] = self.actor.predict(
            observation, state, episode_start, deterministic
        )
        return actions


def export_policy(model: MultiTaskOffPolicyAlgorithm, path: str | Path, with_critics: bool = False) -> Path:
    """Write a model's policy as one file that :func:`load_policy` reads, whole or not at all; return its path.

    :param model: trained, any body, with or without adapters
    :param path: file to write, ``*.safetensors``; without a suffix it gets this one
    :param with_critics: whether the critics go with it; to predict, none are needed
    :raises ConfigError: for a policy that tensors and JSON cannot express, one that holds NaN or infinity, or if the
        file cannot be written
    """
    path = check_path("path", path)
    path = path if path.suffix else path.with_name(path.name + SUFFIX)
    if path.suffix != SUFFIX:
        raise ConfigError(f"A policy is exported to a file named *{SUFFIX}, not to {path.name}.")
    description = _describe(model, with_critics)
    networks = {"actor": model.actor, **({"critic": model.critic} if with_critics else {})}
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in _tensors(networks).items()}
    _check_finite(tensors)
    text = json.dumps(dataclasses.asdict(description), allow_nan=False)
    shapes = {name: list(tensor.shape) for name, tensor in tensors.items()}
    try:
        _check_sizes(description, shapes)
        _check_shapes(_tensors(_laid_out(description)), shapes)
    except ConfigError as error:
        raise ConfigError(
            f"The policy's networks are not those of its options ({error}), so a file could not say how to build them. "
            "Save it with save(), and share the code that builds it."
        ) from error
    content = safetensors.torch.save(tensors, {_KEY: text})
    if int.from_bytes(content[:8], "little") > _MAX_HEADER:
        raise ConfigError(
            f"The description of this policy is longer than the {_MAX_HEADER:,} bytes that a file may have for it; "
            f"observations of {description.observation_space.shape} numbers are too wide. Save it with save()."
        )
    try:
        write_whole(path, lambda temporary: temporary.write_bytes(content))
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from error
    return path


def load_policy(path: str | Path, device: th.device | str = "auto") -> LoadedPolicy:
    """Return the policy of a file that :func:`export_policy` wrote; nothing in the file is executed.

    Its actions are the model's, to the bit on the same kind of processor. torch's random numbers are left alone.

    :param path: file to read
    :param device: SB3's
    :raises ConfigError: if it is missing, is no such file, or is damaged, saying what is wrong with it
    """
    path = check_path("path", path)
    check_sb3_options({"device": device})
    device = get_device(device)
    try:
        if not path.is_file():  # a pipe has no end
            raise ConfigError("it is a folder" if path.is_dir() else "there is no such file")
        with path.open("rb") as file:
            description, networks, tensors = _read(file)
    except (ConfigError, OSError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be loaded as a policy: {one_line(str(error), 600)}.") from error
    for name, network in networks.items():
        own = {key: tensor.to(device, copy=True) for key, tensor in _below(name, tensors)}
        network.load_state_dict(own, assign=True)
        network.set_training_mode(False)
    fused = description.fused and device.type == "cpu" and fused_layers_are_available()
    for network in networks.values():
        set_arithmetic(network, fused, "bf16" if description.precision == "bf16" else "fp32")
    return LoadedPolicy(
        networks["actor"],
        networks.get("critic"),
        description.algorithm,
        description.task_names,
        description.observation_space.box(),
        description.action_space.box(),
    )


# ---------------------------------------------------------------------- what a file says of the networks


def _describe(model: MultiTaskOffPolicyAlgorithm, with_critics: bool) -> PolicyDescription:
    """Return what a file has to say of a model.

    :raises ConfigError: naming what cannot be said without code
    """
    algorithm = next((name for name, kind in _ALGORITHMS.items() if isinstance(model, kind)), None)
    if algorithm is None:
        raise ConfigError(f"export_policy takes an ARSSAC or ARSTQC model, not {type(model).__name__}.")
    observation_space, action_space = (
        SpaceDescription.of(space, role)
        for space, role in ((model.observation_space, "observation"), (model.action_space, "action"))
    )
    policy: Any = model.policy
    _check_without_code(model, policy, algorithm)
    actor_arch, critic_arch = (
        [int(width) for width in arch] for arch in get_actor_critic_arch(policy.net_arch)
    )
    critic = (
        None
        if not with_critics
        else CriticDescription(
            critic_arch,
            _name_of_activation("critic_activation_fn", policy._critic_activation_fn),
            _options(policy.critic_body),
            bool(policy.critic_layer_norm),
            int(policy.critic.n_critics),
            int(policy.critic.n_quantiles) if algorithm == "ARSTQC" else None,
        )
    )
    return PolicyDescription(
        FORMAT,
        __version__,
        algorithm,
        None if model.task_names is None else list(model.task_names),
        observation_space,
        action_space,
        ActorDescription(
            actor_arch,
            _name_of_activation("activation_fn", policy.activation_fn),
            _options(policy.body),
            policy.std,
        ),
        critic,
        None if policy.lora is None else _plain(asdict(LoRAConfig.of(policy.lora))),
        # where the model's device is a GPU, what "auto" would be on a processor
        model.execution == "fused" or (model.execution == "auto" and model.is_multi_task),
        "bf16" if model.precision == "bf16" else "fp32",
    )


def _check_without_code(model: MultiTaskOffPolicyAlgorithm, policy: Any, algorithm: str) -> None:
    """Raise if the policy is made of classes or statistics that a file without code cannot hold."""
    remedy = "Save it with save(), and share the code and the file with people who trust you."
    if type(policy) is not _ALGORITHMS[algorithm].policy_aliases["MlpPolicy"]:
        raise ConfigError(
            f"policy={type(policy).__name__} is a class of its own, which a policy file cannot hold; 'MlpPolicy' it "
            f"can. {remedy}"
        )
    extractor = policy.features_extractor_class
    if extractor is not FlattenExtractor or policy.features_extractor_kwargs:
        raise ConfigError(
            f"features_extractor_class={extractor.__name__} is code, which a policy file cannot hold; leave the option "
            f"out and compute the features in a wrapper of the environment. {remedy}"
        )
    normalizer = model.get_vec_normalize_env()
    if normalizer is not None and normalizer.norm_obs:
        raise ConfigError(
            "VecNormalize(norm_obs=True) has statistics without which the policy's actions mean nothing, and a policy "
            "file does not hold them. Train with norm_obs=False, write an ONNX file (export_onnx), which takes them "
            "in, or share save()'s file together with VecNormalize.save()'s."
        )


def _name_of_activation(option: str, kind: type[nn.Module]) -> str:
    for name, known in ACTIVATIONS.items():
        if kind is known:
            return name
    raise ConfigError(
        f"{option}={getattr(kind, '__name__', kind)} is none of the activations that a policy file can name: "
        f"{[known.__name__ for known in ACTIVATIONS.values()]}. Use one of them, or save()."
    )


def _options(body: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return a body's name and all its options, those left to their defaults too."""
    return None if body is None else {"name": body["name"], **_plain(asdict(body_config(body)))}


def _plain(options: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in options.items()}


# ---------------------------------------------------------------------- networks


class _Unbuilt:
    """Mixin for a policy that makes its networks when asked, and without memory."""

    device = th.device("meta")

    def _build(self, lr_schedule: Any) -> None:
        pass


class _UnbuiltSAC(_Unbuilt, ARSSACPolicy):
    pass


class _UnbuiltTQC(_Unbuilt, ARSTQCPolicy):
    pass


def _laid_out(description: PolicyDescription) -> dict[str, Any]:
    """Return the described networks with their names, shapes and types but no memory.

    :param description: whose sizes were checked
    :raises ConfigError: if they cannot be built
    """
    actor, critic = description.actor, description.critic
    n_tasks = len(description.task_names or []) or 1
    options: dict[str, Any] = {
        "net_arch": {"pi": actor.net_arch, "qf": actor.net_arch if critic is None else critic.net_arch},
        "activation_fn": ACTIVATIONS[actor.activation],
        "std": actor.std,
        "body": actor.body,
        "critic_body": None,
        "n_tasks": n_tasks,
    }
    if critic is not None:
        options |= {
            "critic_activation_fn": ACTIVATIONS[critic.activation],
            "critic_layer_norm": critic.layer_norm,
            "critic_body": critic.body,
            "n_critics": critic.n_critics,
            **({} if critic.n_quantiles is None else {"n_quantiles": critic.n_quantiles}),
        }
    kind: Any = {"ARSSAC": _UnbuiltSAC, "ARSTQC": _UnbuiltTQC}[description.algorithm]
    spaces_of = (description.observation_space.box(), description.action_space.box())
    try:
        with th.device("meta"):
            policy = kind(*spaces_of, lambda _: 0.0, **options)
            networks = {"actor": policy.make_actor()}
            if critic is not None:
                networks["critic"] = policy.make_critic()
            if description.lora is not None:
                _add_adapters(networks, LoRAConfig.of(description.lora), n_tasks)
    except (RuntimeError, TypeError, OverflowError) as error:  # torch, of sizes beyond 64 bits
        raise ConfigError(f"its networks cannot be built ({one_line(str(error), 120)})") from error
    return networks


def _add_adapters(networks: Mapping[str, Any], config: LoRAConfig, n_tasks: int) -> None:
    for network in networks.values():
        network.add_adapters(config, n_tasks)
    if "critic" in networks and config.rescale_critic:
        networks["critic"].value_scale = th.ones(n_tasks)


def _tensors(networks: Mapping[str, nn.Module]) -> dict[str, th.Tensor]:
    return {
        f"{name}.{key}": tensor
        for name, network in networks.items()
        for key, tensor in network.state_dict().items()
    }


def _below(name: str, tensors: Mapping[str, th.Tensor]) -> Iterator[tuple[str, th.Tensor]]:
    for key, tensor in tensors.items():
        if key.startswith(f"{name}."):
            yield key.removeprefix(f"{name}."), tensor


def _check_finite(tensors: Mapping[str, th.Tensor]) -> None:
    for name, tensor in tensors.items():
        if not th.isfinite(tensor).all():
            raise ConfigError(
                f"tensor {name!r} holds NaN or infinity, so the policy is lost; use an earlier save"
            )


def _check_shapes(expected: Mapping[str, th.Tensor], shapes: Mapping[str, list[int]]) -> None:
    """Raise unless the tensors of a file are those of the networks."""
    for name, tensor in expected.items():
        if name not in shapes:
            raise ConfigError(f"tensor {name!r} is not there")
        if shapes[name] != list(tensor.shape) or tensor.dtype != th.float32:
            raise ConfigError(
                f"tensor {name!r} has shape {shapes[name]}, but the network's has {list(tensor.shape)}"
            )
    for name in shapes:
        if name not in expected:
            raise ConfigError(f"tensor {shown(name)} belongs to no layer of the network")


def _check_sizes(description: PolicyDescription, shapes: Mapping[str, list[int]]) -> None:
    """Raise if the networks have more layers or wider ones than there are tensors for, before they are laid out."""
    largest, n_tensors = max((size for shape in shapes.values() for size in shape), default=0), len(shapes)
    if description.lora is not None:
        _check_at_most("rank", LoRAConfig.of(description.lora).rank, largest)
    if description.critic is not None:
        critic = description.critic
        _check_at_most("n_critics", critic.n_critics, n_tensors)
        _check_at_most("layers of all critics", critic.n_critics * len(critic.net_arch), n_tensors)
        _check_at_most("n_quantiles", critic.n_quantiles or 0, largest)
    for network in (description.actor, description.critic):
        if network is None:
            continue
        _check_at_most("layers", len(network.net_arch), n_tensors)
        _check_at_most("net_arch", max(network.net_arch, default=0), largest)
        body = None if network.body is None else asdict(body_config(network.body))
        n_layers = len(network.net_arch) + 1
        for option, value in (body or {}).items():
            if option == "n_layers":
                _check_at_most(option, value, n_tensors)
                n_layers += value
            elif option in _COPIES or option in ("module_width", "gate_width"):
                _check_at_most(option, value, largest)
        n_copies = max((value for option, value in (body or {}).items() if option in _COPIES), default=1)
        n_networks = network.n_critics if isinstance(network, CriticDescription) else 1
        _check_at_most("layers of all copies", n_networks * n_copies * n_layers if body else 0, _MAX_COPIES)


_COPIES = ("n_experts", "n_parameter_sets", "n_modules")


def _check_at_most(what: str, value: int, most: int) -> None:
    if value > most:
        raise ConfigError(f"{what}={shown(value)} is more than its tensors have room for, {most:,}")


# ---------------------------------------------------------------------- the file's bytes


def _read(file: BinaryIO) -> tuple[PolicyDescription, dict[str, Any], dict[str, th.Tensor]]:
    """Return description, networks without memory, and tensors of an open file, the tensors read last."""
    size = os.fstat(file.fileno()).st_size
    start = file.read(8)
    length = int.from_bytes(start, "little")
    if not 2 <= length <= min(size - 8, _MAX_HEADER):
        raise ConfigError(_what_it_is(start))
    header = parsed_json(_decoded(file.read(length)), "its header")
    if not isinstance(header, dict):
        raise ConfigError("its header is no mapping")
    metadata = header.pop("__metadata__", None)
    if not isinstance(metadata, dict) or [*metadata] != [_KEY] or not isinstance(metadata[_KEY], str):
        raise ConfigError(
            f"it has no description of a policy, and nothing else, in its metadata under {_KEY!r}"
        )
    shapes = {name: _shape_of(name, entry, size) for name, entry in header.items()}
    missing = 8 + length + 4 * sum(math.prod(shape) for shape in shapes.values()) - size
    if missing:
        raise ConfigError(
            f"it was cut off: {shown(missing)} bytes are missing at its end"
            if missing > 0
            else f"it has {-missing:,} bytes more than its header says"
        )
    description = PolicyDescription.of_json(metadata[_KEY])
    _check_sizes(description, shapes)
    networks = _laid_out(description)
    _check_shapes(_tensors(networks), shapes)
    file.seek(0)
    try:
        tensors = safetensors.torch.load(file.read(size))
    except SafetensorError as error:
        raise ConfigError(f"its tensors cannot be read ({error})") from error
    _check_finite(tensors)
    return description, networks, tensors


def _what_it_is(start: bytes) -> str:
    """Return what is wrong with a file that does not begin as safetensors does."""
    if not start:
        return "it is empty"
    if start.startswith(b"PK"):
        return (
            "it is a zip, as save() writes. Such a file can run any code when it is loaded: if you trust its author, "
            "load it with ARSSAC.load or ARSTQC.load"
        )
    if start.startswith(b"\x80"):
        return (
            "it looks like a pickle, which can run any code when it is loaded, and which is not loaded here"
        )
    return "it is no safetensors file, or was cut off in its header"


def _decoded(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError("its header is no UTF-8") from error


def _shape_of(name: str, entry: Any, size: int) -> list[int]:
    """Return the shape that a header gives a tensor; offsets are safetensors' to check."""
    if not isinstance(entry, dict) or sorted(entry) != ["data_offsets", "dtype", "shape"]:
        raise ConfigError(f"tensor {shown(name)} is not described as safetensors does")
    shape, dtype = entry["shape"], entry["dtype"]
    if dtype != "F32":
        raise ConfigError(f"tensor {shown(name)} is of type {shown(dtype)}, not F32")
    if not isinstance(shape, list) or not all(type(n) is int and 0 <= n <= size for n in shape):
        raise ConfigError(f"tensor {shown(name)} has shape {shown(shape)}")
    return shape
