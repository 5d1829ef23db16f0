"""Writes a model's checkpoints, and makes models of them; what they hold is in ``run_state``, how on disk elsewhere."""

from __future__ import annotations

import secrets
import shutil
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_ars.algorithms.run_state import capture, check_same_options, constructor_arguments, restore
from sb3_ars.buffers import TaskReplayBuffer
from sb3_ars.checkpoints import Checkpoint, CheckpointFolder, FileRecord, latest_checkpoint
from sb3_ars.errors import CheckpointError, ConfigError, DivergedError, EnvContractError, WorkerError
from sb3_ars.versions import run_versions

if TYPE_CHECKING:
    from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm

__all__ = ["RowsOnDisk", "load_checkpoint", "model_of_checkpoint", "write_checkpoint"]

STATE = "state.pt"

Part = tuple[FileRecord, list[int], list[int]]
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
    parts: list[Part]


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
    :raises DivergedError: if what is learned holds NaN or infinity; nothing is written
    :raises OSError: if the disk is full or cannot be written; the checkpoints there were stay
    :raises TypeError: if a callback, a log or an environment gives what no checkpoint can hold; likewise
    """
    state = capture(model, callback)
    if not all(map(_is_finite, (state["networks"], state["optimizers"], state["log_ent_coef"]))):
        raise DivergedError(
            f"The networks hold NaN or infinity at step {model.num_timesteps}; no checkpoint was written of them."
        )
    rows, new = _write_rows(model, folder)
    parts = [] if rows is None else rows.parts
    kept_notes = {
        **(notes or {}),
        "algorithm": type(model).__name__,
        "total_timesteps": model._total_timesteps,
        "versions": run_versions()["packages"],
        "rows": [{"file": record.path, "first": first, "stop": stop} for record, first, stop in parts],
    }
    try:
        with folder.write(model.num_timesteps, [record for record, _, _ in parts], kept_notes) as opened:
            with opened(STATE) as file:
                th.save(state, file)
            for path in files:
                if path.is_file():
                    with path.open("rb") as source, opened(path.name) as file:
                        shutil.copyfileobj(source, file)
    except BaseException:
        if new is not None:  # or a disk that is full would become fuller with every attempt
            folder.remove(new)
        raise
    model.rows_on_disk = rows
    folder.prune()
    assert folder.last is not None
    return folder.last


def _write_rows(
    model: MultiTaskOffPolicyAlgorithm, folder: CheckpointFolder
) -> tuple[RowsOnDisk | None, FileRecord | None]:
    """Write the transitions that no file holds yet; return all files that are needed, and the new one."""
    buffer = model.replay_buffer
    if not isinstance(buffer, TaskReplayBuffer):
        return None, None
    oldest, stop = buffer.oldest(), buffer.task_total.tolist()
    before = model.rows_on_disk
    parts: list[Part] = []
    if before is not None and (before.root, before.history) == (folder.root, buffer.history):
        parts = [
            part for part in before.parts if any(end > old for end, old in zip(part[2], oldest, strict=True))
        ]
        if not all(folder.holds(record) for record, _, _ in parts):
            parts = []  # somebody cleared the folder: all is written again
    first = [max(pair) for pair in zip(oldest, parts[-1][2] if parts else oldest, strict=True)]
    if first == stop:
        return RowsOnDisk(folder.root, buffer.history, parts), None
    # a run that goes back comes to the same step again, with other transitions
    name = f"{buffer.history}-{model.num_timesteps:012d}-{secrets.token_hex(4)}.bin"
    with folder.write_shared(name) as (file, record):
        buffer.write_rows(file, first)
    return RowsOnDisk(folder.root, buffer.history, [*parts, (record[0], first, stop)]), record[0]


def _is_finite(value: Any) -> bool:
    if isinstance(value, th.Tensor):
        return not value.is_floating_point() or bool(th.isfinite(value).all())
    parts = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    return all(map(_is_finite, parts))


def load_checkpoint(model: MultiTaskOffPolicyAlgorithm, checkpoint: Checkpoint) -> None:
    """Make a model, built with the options and the environment of a run, what it was at its checkpoint.

    :param model: not trained yet
    :param checkpoint: of :func:`~sb3_ars.checkpoints.latest_checkpoint`
    :raises CheckpointError: if it does not fit the model, or was made with other options
    """
    state = _read_state(checkpoint)
    try:
        check_same_options(model, state["options"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _damaged(checkpoint, error) from error
    _load(model, checkpoint, state, ())


def model_of_checkpoint(cls: type[Model], path: str | Path, env: Any, options: Mapping[str, Any]) -> Model:
    """Return a model as it was at a checkpoint, ready to learn on.

    :param cls: ARSSAC or ARSTQC
    :param path: of a run, of its checkpoints, or of one of them
    :param env: made like the run's
    :param options: of the constructor, in the place of those that were saved
    :raises CheckpointError: if there is none that is whole, or it does not fit
    """
    checkpoint = latest_checkpoint(Path(path))
    state = _read_state(checkpoint)
    if state.get("algorithm") != cls.__name__:
        raise CheckpointError(
            f"{checkpoint.folder} is of {state.get('algorithm')}; use {state.get('algorithm')}.resume(...)."
        )
    try:
        model = cls(env=env, **constructor_arguments(state["options"], options))
    except (ConfigError, EnvContractError, WorkerError):
        raise
    except Exception as error:  # a name that is no option, a class that is none, a size below zero
        raise _damaged(checkpoint, error) from error
    _load(model, checkpoint, state, options)
    return model


def _load(
    model: MultiTaskOffPolicyAlgorithm,
    checkpoint: Checkpoint,
    state: Mapping[str, Any],
    given: Collection[str],
) -> None:
    """Fill a model.

    :param given: options of the constructor that stay as they are
    """
    _compare_versions(checkpoint)
    buffer = model.replay_buffer
    try:
        if isinstance(buffer, TaskReplayBuffer):
            model.rows_on_disk = _read_rows(buffer, checkpoint, state["replay"], "buffer_size" in given)
        restore(model, state, given)
    except (ConfigError, EnvContractError, WorkerError):
        raise
    except Exception as error:  # whatever values that do not fit make of the buffer
        raise _damaged(checkpoint, error) from error
    model.last_checkpoint = checkpoint.folder


def _compare_versions(checkpoint: Checkpoint) -> None:
    saved = checkpoint.notes.get("versions")
    now = run_versions()["packages"]
    if not isinstance(saved, Mapping):
        return
    changed = [f"{name} {saved[name]} to {now.get(name)}" for name in saved if saved[name] != now.get(name)]
    if changed:
        warnings.warn(
            f"The run began with other versions ({', '.join(changed)}); it goes on, but perhaps not to the bit.",
            stacklevel=5,
        )


def _damaged(checkpoint: Checkpoint, error: Exception) -> CheckpointError:
    return CheckpointError(
        f"{checkpoint.folder} is damaged, of other versions, or lacks an option that resume() has to be given "
        f"({type(error).__name__}: {error})."
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


def _read_rows(
    buffer: TaskReplayBuffer, checkpoint: Checkpoint, state: Mapping[str, Any], keep_size: bool
) -> RowsOnDisk:
    records = {record.path: record for record in checkpoint.files}  # whose checksums were looked at
    parts = [
        (records[part["file"]], list(part["first"]), list(part["stop"])) for part in checkpoint.notes["rows"]
    ]

    def opened() -> Iterator[tuple[Any, list[int], list[int]]]:
        for record, first, stop in parts:
            with (checkpoint.root / record.path).open("rb") as file:
                yield file, first, stop

    buffer.restore_checkpoint_state(state, opened(), keep_size)
    return RowsOnDisk(checkpoint.root, buffer.history, parts)
