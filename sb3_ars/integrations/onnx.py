"""Exports a trained policy's mean action as an ONNX file, to run where there is no torch; needs ``sb3-ars[onnx]``."""

from __future__ import annotations

import copy
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm
from sb3_ars.errors import ConfigError
from sb3_ars.files import write_whole
from sb3_ars.nets.mlp import set_arithmetic
from sb3_ars.nets.moore import MOORE

__all__ = ["export_onnx"]


def export_onnx(
    model: MultiTaskOffPolicyAlgorithm, path: str | Path, normalizer: VecNormalize | None = None
) -> Path:
    """Write the policy's deterministic action as ONNX, whole or not at all; return the path.

    Input ``observation``, ``(batch, obs_dim + n_tasks)`` float32, the one-hot task id behind the observation; output
    ``action``, ``(batch, action_dim)`` float32 within the action space's bounds. The file's metadata hold
    ``task_names`` (JSON, in the order of the one-hot), ``algorithm``, ``action_low`` and ``action_high``.

    :param model: trained, any body, with or without adapters
    :param path: file to write
    :param normalizer: whose statistics became part of what the policy knows: the file then takes raw observations.
        ``None`` is the training environment's, if the model has it and it normalises
    :raises ConfigError: if a package is missing, the observations are no vectors, or the file cannot be written
    """
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401  # torch's exporter is made of it
    except ImportError as error:
        raise ConfigError(
            f'ONNX export needs more packages ({error}): pip install "sb3-ars[onnx]"'
        ) from error
    space = model.observation_space
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or space.dtype == np.uint8:
        raise ConfigError(f"ONNX export is for observations that are vectors, but this model's are {space}.")
    normalizer = normalizer or model.get_vec_normalize_env()
    network = _MeanAction(
        model, normalizer if normalizer is not None and normalizer.norm_obs else None
    ).eval()
    rows = th.zeros(2, *space.shape)
    with th.no_grad(), _quiet():
        # strict, because Python's len() of a tensor would fix the number of rows otherwise
        program = th.export.export(
            network, (rows,), dynamic_shapes=({0: th.export.Dim("batch")},), strict=True
        )
        exported: Any = th.onnx.export(
            program, input_names=["observation"], output_names=["action"], dynamo=True, verbose=False
        )
    proto = exported.model_proto
    actions: Any = model.action_space
    described = {
        "task_names": list(model.task_names or []),
        "algorithm": type(model).__name__,
        "action_low": actions.low.tolist(),
        "action_high": actions.high.tolist(),
    }
    for key, value in described.items():
        proto.metadata_props.add(key=key, value=value if isinstance(value, str) else json.dumps(value))
    return _write(Path(path), proto.SerializeToString())


class _MeanAction(nn.Module):
    """Raw observation to mean action in the environment's bounds, on the CPU, in plain layers."""

    low: th.Tensor
    high: th.Tensor
    mean: th.Tensor
    scale: th.Tensor

    def __init__(self, model: MultiTaskOffPolicyAlgorithm, normalizer: VecNormalize | None) -> None:
        super().__init__()
        actions: Any = model.action_space
        self.actor: Any = copy.deepcopy(model.actor).cpu()
        self.actor.set_training_mode(False)
        set_arithmetic(self.actor, fused=False, precision="fp32")
        for module in self.actor.modules():
            if isinstance(module, MOORE):
                module.__class__ = _MOOREInOnePiece
        self.register_buffer("low", th.as_tensor(actions.low))
        self.register_buffer("high", th.as_tensor(actions.high))
        self.clip = None if normalizer is None else float(normalizer.clip_obs)
        if normalizer is not None:
            statistics: Any = normalizer.obs_rms
            scale = 1 / np.sqrt(statistics.var + normalizer.epsilon)
            self.register_buffer("mean", th.as_tensor(statistics.mean, dtype=th.float32))
            self.register_buffer("scale", th.as_tensor(scale, dtype=th.float32))

    def forward(self, observation: th.Tensor) -> th.Tensor:
        if self.clip is not None:
            observation = ((observation - self.mean) * self.scale).clamp(-self.clip, self.clip)
        mean, _ = self.actor.action_distribution(observation)
        # tanh(mean) in [-1, 1], then to the bounds
        return self.low + 0.5 * (th.tanh(mean) + 1.0) * (self.high - self.low)


class _MOOREInOnePiece(MOORE):
    """MOORE without cutting the batch into pieces, whose number an exported graph would have to know."""

    def compute(self, x: th.Tensor, task: th.Tensor, task_major: bool) -> th.Tensor:
        out: th.Tensor = self.heads(self._features(x, task), task, task_major)
        return out


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep back what torch's exporter says about itself on every call."""
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")  # torchvision is not installed
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "`isinstance.treespec, LeafSpec.` is deprecated", FutureWarning)
            # what tracing does to the autograd function in MOORE
            warnings.filterwarnings("ignore", ".*should not be instantiated", DeprecationWarning)
            # the adapters are told of each row's task for the time of a call
            warnings.filterwarnings("ignore", "While compiling, we found certain side effects", UserWarning)
            yield
    finally:
        logger.setLevel(level)


def _write(path: Path, content: bytes) -> Path:
    try:
        write_whole(path, lambda temporary: temporary.write_bytes(content))
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from error
    return path
