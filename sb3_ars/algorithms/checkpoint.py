"""Writes a model's checkpoints, and makes models of them; what they hold is in ``run_state``, how on disk elsewhere."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_ars.algorithms.run_state import capture, constructor_arguments, restore
from sb3_ars.buffers import TaskReplayBuffer
from sb3_ars.checkpoints import Checkpoint, CheckpointFolder, FileRecord, latest_checkpoint
from sb3_ars.errors import CheckpointError, ConfigError, DivergedError, EnvContractError, WorkerError

if TYPE_CHECKING:
    from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm

__all__ = ["RowsOnDisk", "load_checkpoint", "model_of_checkpoint", "write_checkpoint"]

STATE = "state.pt"

Model = TypeVar("Model", bound="MultiTaskOffPolicyAlgorithm")


@dataclass(frozen=True)
class RowsOnDisk:
    """Which transitions of a task buffer lie in files already, so that the next checkpoint adds only what is new.

    :param root: folder of checkpoints
    :param history: of the buffer, which changes where its transitions are not those in the files
    :param parts: the files, oldest first: record, and per task the number of the first transition and of the one behind
        the last
    """

    root: Path
    history: str
    parts: list[tuple[FileRecord, list[int], list[int]]]


def write_checkpoint(
    model: MultiTaskOffPolicyAlgorithm,
    folder: CheckpointFolder,
    callback: BaseCallback | None = None,
    notes: Mapping[str, Any] | None = None,
    files: Sequence[Path] = (),
) -> Path:
    """Write a checkpoint of a model between two rollouts, remove the oldest ones, and return its folder.

    Of a task buffer only the transitions since the last checkpoint in this folder are written.

    :param model: whose ``learn()`` is at ``on_rollout_start``, or has ended
    :param folder: where to
    :param callback: of ``learn()``, whose state goes along
    :param notes: plain values for the manifest
    :param files: to keep a copy of, where they exist
    :raises DivergedError: if a parameter is NaN or infinite; nothing is written
    :raises OSError: if the disk is full or cannot be written; the checkpoints there were stay
    """
    if not all(
        th.isfinite(tensor).all()
        for tensor in model.policy.state_dict().values()
        if tensor.is_floating_point()
    ):
        raise DivergedError(
            f"The networks hold NaN or infinity at step {model.num_timesteps}; no checkpoint was written of them."
        )
    rows = _write_rows(model, folder)
    parts = [] if rows is None else rows.parts
    kept_notes = {
        **(notes or {}),
        "algorithm": type(model).__name__,
        "total_timesteps": model._total_timesteps,
        "rows": [{"file": asdict(record), "first": first, "stop": stop} for record, first, stop in parts],
    }
    with folder.write(model.num_timesteps, [record for record, _, _ in parts], kept_notes) as opened:
        with opened(STATE) as file:
            th.save(capture(model, callback), file)
        for path in files:
            if path.is_file():
                with path.open("rb") as source, opened(path.name) as file:
                    shutil.copyfileobj(source, file)
    model.rows_on_disk = rows
    folder.prune()
    return folder.folder_of(model.num_timesteps)


def _write_rows(model: MultiTaskOffPolicyAlgorithm, folder: CheckpointFolder) -> RowsOnDisk | None:
    """Write the transitions that no file holds yet."""
    buffer = model.replay_buffer
    if not isinstance(buffer, TaskReplayBuffer):
        return None
    oldest, stop = buffer.oldest(), buffer.task_total.tolist()
    before = model.rows_on_disk
    parts = []
    if before is not None and (before.root, before.history) == (folder.root, buffer.history):
        parts = [
            part for part in before.parts if any(end > old for end, old in zip(part[2], oldest, strict=True))
        ]
    first = [max(pair) for pair in zip(oldest, parts[-1][2] if parts else oldest, strict=True)]
    if first != stop:
        with folder.write_shared(f"{buffer.history}-{model.num_timesteps:012d}.bin") as (file, record):
            buffer.write_rows(file, first)
        parts.append((record[0], first, stop))
    return RowsOnDisk(folder.root, buffer.history, parts)


def load_checkpoint(
    model: MultiTaskOffPolicyAlgorithm, path: str | Path | Checkpoint, state: Mapping[str, Any] | None = None
) -> Checkpoint:
    """Make a model, built with the options and the environment of a run, what it was at its checkpoint.

    :param model: not trained yet
    :param path: of a run, of its checkpoints, or of one of them; or a checkpoint, verified
    :param state: of the checkpoint, if it was read already
    :raises CheckpointError: if there is none that is whole, or it does not fit the model
    """
    checkpoint = path if isinstance(path, Checkpoint) else latest_checkpoint(Path(path))
    state = _read_state(checkpoint) if state is None else state
    buffer = model.replay_buffer
    try:
        if isinstance(buffer, TaskReplayBuffer):
            model.rows_on_disk = _read_rows(buffer, checkpoint, state["replay"])
        restore(model, state)
    except (ConfigError, EnvContractError, WorkerError):
        raise
    except Exception as error:  # whatever values that do not fit make of the buffer
        raise _damaged(checkpoint, error) from error
    model.last_checkpoint = checkpoint.folder
    return checkpoint


def model_of_checkpoint(cls: type[Model], path: str | Path, env: Any, options: Mapping[str, Any]) -> Model:
    """Return a model as it was at a checkpoint, ready to learn on.

    :param cls: ARSSAC or ARSTQC
    :param path: see :func:`load_checkpoint`
    :param env: made like the run's
    :param options: of the constructor, in the place of those that were saved
    :raises CheckpointError: see :func:`load_checkpoint`
    """
    checkpoint = latest_checkpoint(Path(path))
    state = _read_state(checkpoint)
    if state.get("algorithm") != cls.__name__:
        raise CheckpointError(
            f"{checkpoint.folder} is of {state.get('algorithm')}; use {state.get('algorithm')}.resume(...)."
        )
    try:
        arguments = constructor_arguments(state["options"], options)
        model = cls(env=env, **arguments)
    except (ConfigError, EnvContractError, WorkerError):
        raise
    except Exception as error:  # a name that is no option, a class that is none, a size below zero
        raise _damaged(checkpoint, error) from error
    load_checkpoint(model, checkpoint, state)
    return model


def _damaged(checkpoint: Checkpoint, error: Exception) -> CheckpointError:
    return CheckpointError(
        f"{checkpoint.folder} is damaged, or of other versions ({type(error).__name__}: {error})."
    )


def _read_state(checkpoint: Checkpoint) -> dict[str, Any]:
    path = checkpoint.folder / STATE
    try:
        state = th.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # torch.load has many for a file that is none of its own
        words = (str(error) or type(error).__name__).splitlines()[0]
        raise CheckpointError(f"{path} cannot be read: {words}") from error
    if not isinstance(state, dict):
        raise CheckpointError(f"{path} is no state of a run.")
    return state


def _read_rows(buffer: TaskReplayBuffer, checkpoint: Checkpoint, state: Mapping[str, Any]) -> RowsOnDisk:
    parts = [
        (FileRecord(**part["file"]), list(part["first"]), list(part["stop"]))
        for part in checkpoint.notes["rows"]
    ]
    with ExitStack() as stack:
        files = (
            (stack.enter_context((checkpoint.root / record.path).open("rb")), first, stop)
            for record, first, stop in parts
        )
        buffer.restore_checkpoint_state(state, files)
    return RowsOnDisk(checkpoint.root, buffer.history, parts)
