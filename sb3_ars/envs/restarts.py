"""What is known of the episodes of workers that may be started anew, and how such an episode ends; starts nothing."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from sb3_ars.envs.workers import StepArrays

__all__ = ["MAX_IN_A_ROW", "RESTARTED", "Restarts"]

MAX_IN_A_ROW = 3
"""How often a worker is started anew without a step of its envs that worked in between."""

RESTARTED = "worker_restarted"
"""Entry in the info of a step that has no outcome, because its worker failed: nothing may be learned from it."""


class Restarts:
    """Counts the restarts of each worker, and follows the episodes of its envs from outside.

    A worker that dies takes the returns of its episodes along, and may have written half a step.

    :param chunks: the envs of each worker
    """

    def __init__(self, chunks: Sequence[range]) -> None:
        n_envs = chunks[-1].stop
        self._chunks = chunks
        self._seeds: list[int | None] = [None] * n_envs
        self._n_restarts = [0] * len(chunks)
        self._in_a_row = [0] * len(chunks)
        self._obs: npt.NDArray[np.float32] = np.empty(0, np.float32)
        self._returns = np.zeros(n_envs)
        self._lengths = np.zeros(n_envs, np.int64)

    def count(self, worker: int) -> int:
        """Count one more restart of a worker and return how many there were, it included; 0 if that is too many."""
        self._in_a_row[worker] += 1
        if self._in_a_row[worker] > MAX_IN_A_ROW:
            return 0
        self._n_restarts[worker] += 1
        return self._n_restarts[worker]

    def seeds(self, worker: int) -> list[int | None]:
        """Return a seed for each env of a worker, from the one it was given and the number of the worker's restarts."""
        n_restarts = self._n_restarts[worker]
        return [
            None if seed is None else int(np.random.SeedSequence([seed, n_restarts]).generate_state(1)[0])
            for seed in (self._seeds[env] for env in self._chunks[worker])
        ]

    def begin_episodes(self, seeds: Sequence[int | None]) -> None:
        """Note that every env is reset.

        :param seeds: one per env, None leaves the env's generator as it is
        """
        self._seeds = [
            before if seed is None else seed for before, seed in zip(self._seeds, seeds, strict=True)
        ]
        self._returns[:], self._lengths[:] = 0.0, 0

    def checkpoint_state(self) -> dict[str, Any]:
        """Return what it remembers between two steps."""
        return {
            "seeds": list(self._seeds),
            "n_restarts": list(self._n_restarts),
            "returns": self._returns.copy(),
            "lengths": self._lengths.copy(),
        }

    def restore_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Go on from what `checkpoint_state` returned; with other numbers of workers, restarts are counted anew.

        :param state: see there
        """
        self._seeds = list(state["seeds"])
        if len(state["n_restarts"]) == len(self._n_restarts):
            self._n_restarts = list(state["n_restarts"])
        self._returns[:], self._lengths[:] = state["returns"], state["lengths"]

    def begin_step(self, arrays: StepArrays) -> None:
        """Keep what the actions answer to, before workers write over it."""
        self._obs = arrays.obs.copy()

    def break_off(self, worker: int, arrays: StepArrays) -> None:
        """Let the episodes of a worker's envs end as truncated where they were last seen, with reward 0."""
        rows = slice(self._chunks[worker].start, self._chunks[worker].stop)
        arrays.terminal_obs[rows] = self._obs[rows]
        arrays.rewards[rows], arrays.terminated[rows], arrays.truncated[rows] = 0.0, False, True
        arrays.success[rows] = arrays.success_once[rows] = np.nan
        arrays.episode_return[rows], arrays.episode_length[rows] = self._returns[rows], self._lengths[rows]

    def end_step(self, arrays: StepArrays, workers: Collection[int]) -> None:
        """Add up the step.

        :param arrays: what it gave
        :param workers: those that stepped
        """
        for worker in workers:
            self._in_a_row[worker] = 0
        over = arrays.terminated | arrays.truncated
        self._returns = np.where(over, 0.0, self._returns + arrays.rewards)
        self._lengths = np.where(over, 0, self._lengths + arrays.active)
