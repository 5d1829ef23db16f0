"""Writes checkpoints while a model learns, also when the process is told to end; what they hold is not known here."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, cast

from stable_baselines3.common.callbacks import BaseCallback

from sb3_ars.algorithms.checkpoint import write_checkpoint
from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm
from sb3_ars.algorithms.run_state import check_can_be_captured
from sb3_ars.checkpoints import CheckpointFolder, checkpoint_folders, lock
from sb3_ars.config import CheckpointConfig
from sb3_ars.errors import ConfigError, check_flag, check_path, check_verbose

__all__ = ["RunCheckpoint"]


class RunCheckpoint(BaseCallback):
    """Write exact checkpoints, from which ``ARSSAC.resume`` goes on as if nothing had happened.

    One is written whenever ``every`` environment steps or ``every_minutes`` have passed since the last, and when the
    process gets SIGTERM or Ctrl-C: then training stops between two steps, the checkpoint is written, and SystemExit or
    KeyboardInterrupt is raised; a second Ctrl-C does not wait. Writing changes nothing that is learned. Each is written
    whole or not at all, and adds only the transitions that are new.

    A disk that is full or gone is a warning, and training goes on; the checkpoints there were stay.

    :param folder: for the checkpoints, such as ``runs/mine/checkpoints``
    :param every: environment steps, summed over environments, between two checkpoints; ``None`` does not count them
    :param every_minutes: minutes of training between two checkpoints; ``None`` does not look at the clock
    :param keep: newest checkpoints that stay
    :param handle_signals: whether SIGTERM and Ctrl-C end training with a checkpoint
    :param notes: plain values to write into each manifest
    :param files: of the run, such as its log: each checkpoint keeps a copy of those there are
    :param verbose: 1 prints each checkpoint
    :raises ConfigError: if an option cannot work, or both intervals are ``None`` and signals are not handled
    """

    def __init__(
        self,
        folder: str | Path,
        every: int | None = None,
        every_minutes: float | None = 10.0,
        keep: int = 2,
        handle_signals: bool = True,
        notes: Mapping[str, Any] | None = None,
        files: Sequence[str | Path] = (),
        verbose: int = 0,
    ) -> None:
        super().__init__(check_verbose("verbose", verbose))
        self.options = CheckpointConfig(every, every_minutes, keep)
        self.handle_signals = check_flag("handle_signals", handle_signals)
        if every is None and every_minutes is None and not handle_signals:
            raise ConfigError(
                "every=None, every_minutes=None and handle_signals=False would never write a checkpoint."
            )
        try:
            dict(notes or {}), json.dumps(notes, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"notes={notes!r} must be a mapping of plain values, or None: {error}."
            ) from error
        if isinstance(files, str) or not isinstance(files, Sequence):
            raise ConfigError(f"files={files!r} must be a list of paths.")
        self.folder = check_path("folder", folder)
        self.notes, self.files = dict(notes or {}), [check_path("files entry", file) for file in files]
        names = [file.name for file in self.files]
        taken = {"state.pt", "manifest.json"} & set(names)
        if taken or len(set(names)) < len(names):
            raise ConfigError(
                f"files: {', '.join(names)} must have different names, none of them state.pt or manifest.json."
            )
        self.seconds = 0.0
        """Time spent in training, written into each manifest; set it to go on counting after a resume."""
        self._folder = CheckpointFolder(self.folder, keep)
        self._told: signal.Signals | None = None
        self._next_step: float = 0
        self._next_time = self._counted_at = 0.0

    @property
    def algorithm(self) -> MultiTaskOffPolicyAlgorithm:
        """The model, typed."""
        return cast("MultiTaskOffPolicyAlgorithm", self.model)

    def _init_callback(self) -> None:
        if not isinstance(self.model, MultiTaskOffPolicyAlgorithm):
            raise ConfigError(
                f"RunCheckpoint knows the state of ARSSAC and ARSTQC, not of {type(self.model).__name__}; use SB3's "
                "CheckpointCallback."
            )
        if (
            self.parent is not None
        ):  # SB3 2.9.2 (callbacks.py) forwards no rollout hooks to an event's children
            raise ConfigError(
                "A RunCheckpoint inside an event callback is never told of rollouts, so it would never write; pass it "
                "to learn() directly or in a list."
            )
        check_can_be_captured(self.model)
        last = self.model.last_checkpoint
        if checkpoint_folders(self.folder) and (last is None or last.parent != self._folder.root):
            raise ConfigError(
                f"{self.folder} holds checkpoints of another run, which this one's would replace; go on with that run "
                f"by {type(self.model).__name__}.resume, or choose another folder."
            )
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(
                f"The folder of checkpoints {self.folder} cannot be made ({error.strerror}); choose another."
            ) from error

    def _count_seconds(self) -> None:
        now = time.monotonic()
        self.seconds += now - self._counted_at
        self._counted_at = now

    def _on_training_start(self) -> None:
        self._told = None
        self._counted_at = time.monotonic()
        self.algorithm.after_learn(self._count_seconds)
        self.algorithm.after_learn(lock(self._folder.root).close)
        self._wait_again()
        if self.handle_signals and threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                before = signal.getsignal(number)
                if before is not signal.SIG_IGN:  # as nohup, and whoever else wants it ignored
                    signal.signal(number, self._on_signal)
                    # None: of a program that has embedded Python
                    self.algorithm.after_learn(signal.signal, number, before or signal.SIG_DFL)

    def _on_rollout_start(self) -> None:
        is_due = self.num_timesteps >= self._next_step or time.monotonic() >= self._next_time
        if is_due or self._told is not None:
            self.write()
        self._end_if_told()

    def _on_training_end(self) -> None:
        if self._told is not None:  # in the last rollout
            self.write()
        self._end_if_told()

    def _end_if_told(self) -> None:
        if self._told is signal.SIGINT:
            raise KeyboardInterrupt
        if self._told is not None:
            raise SystemExit(128 + self._told)

    def _on_step(self) -> bool:
        return True

    def write(self) -> None:
        """Write a checkpoint now, between two rollouts or after the last; a failure is a warning."""
        self._wait_again()
        started = time.monotonic()
        try:
            self._count_seconds()
            notes = {**self.notes, "seconds": self.seconds}
            path = write_checkpoint(
                self.algorithm, self._folder, self.locals.get("callback"), notes, self.files
            )
        except (OSError, TypeError) as error:
            last = self.algorithm.last_checkpoint
            then = (
                "Training goes on, and the next one is tried when it is due"
                if self._told is None
                else "Training ends"
            )
            warnings.warn(
                f"The checkpoint at step {self.num_timesteps:,} could not be written to {self.folder} "
                f"({getattr(error, 'strerror', None) or error}). {then}; "
                + (f"the last good one is {last}." if last else "there is none yet."),
                stacklevel=2,
            )
            return
        self.algorithm.last_checkpoint = path
        if self.verbose >= 1:
            print(f"Step {self.num_timesteps:,}: checkpoint in {path} ({time.monotonic() - started:.1f} s)")

    def _wait_again(self) -> None:
        never, every, minutes = float("inf"), self.options.every, self.options.every_minutes
        self._next_step = never if every is None else self.num_timesteps + every
        self._next_time = never if minutes is None else time.monotonic() + 60.0 * minutes

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        told = signal.Signals(number)
        if self._told is signal.SIGINT and told is signal.SIGINT:
            raise KeyboardInterrupt
        self._told = told
        # not print: the signal may have come in the middle of one
        os.write(2, f"\n{told.name}: a checkpoint is written as soon as this step is done.\n".encode())
