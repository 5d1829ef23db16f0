"""SMT's schedule, "hard tasks first": which tasks collect data, and until when; must not know SB3 or the networks.

Source: Cho et al. 2024, "Hard Tasks First: Multi-Task Reinforcement Learning Through Task Scheduling" (ICML). This is a
reconstruction from descriptions of the method, and these are our choices:

- How well a task does is the mean success of its latest training episodes since it entered the pool: no further
  evaluations. A task counts as solved only after a whole ``window`` of episodes.
- A budget is the task's part, one in ``pool_size``, of ``budget_share`` of what is left of the first stage. Without
  the division, a full pool could not spend its budgets unless ``budget_share * pool_size < 1``.
- A task that spends its budget without being solved or unsolvable goes back to the main pool, from where it may come
  again; if it does so at once, it goes on with a new budget, as if it had never left.
- The first pool, and ties, follow one random order of the tasks.
- The end of the first stage ends every budget; so it does, early, when no task is left to train.
- Which networks begin anew when tasks enter the pool is the caller's business.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_ars.errors import ConfigError, check_count

__all__ = ["POOLS", "SMTConfig", "SMTSchedule"]

POOLS = ("main", "training", "solved", "unsolvable")
"""Where a task can be: waiting, collecting, done, or given up until the second stage."""


@dataclass(frozen=True)
class SMTConfig:
    """Options of SMT's schedule.

    :raises ConfigError: naming the option, what was given and what is allowed
    """

    pool_size: int = 3
    """Tasks that collect at the same time in the first stage (K); fewer than there are tasks."""
    first_stage: float = 0.85
    """Share of the environment steps after the random phase that the first stage has (B1), above 0 and at most 1."""
    budget_share: float = 0.8
    """Share of the rest of the first stage that the tasks in the pool may spend (kappa), above 0 and at most 1."""
    solved: float = 0.9
    """Mean success from which a task is solved and collects no more (M_i), above 0 and at most 1."""
    unsolvable: float = 0.1
    """Mean success up to which a task that spent its budget waits for the second stage (m_i); less than solved."""
    window: int = 30
    """Latest training episodes of a task that its mean success runs over."""
    interval: int = 15_000
    """Environment steps, summed over environments, between two decisions (3 tasks play 10 episodes of 500 steps)."""

    def __post_init__(self) -> None:
        for option in ("pool_size", "window", "interval"):
            check_count(option, getattr(self, option))
        for option in ("first_stage", "budget_share", "solved"):
            _check_share(option, getattr(self, option))
        _check_share("unsolvable", self.unsolvable, or_zero=True)
        if self.unsolvable >= self.solved:
            raise ConfigError(
                f"unsolvable={self.unsolvable} must be less than solved={self.solved}: a task cannot be both."
            )

    def check_tasks(self, n_tasks: int) -> None:
        """Raise unless so many tasks can be scheduled.

        :param n_tasks: how many there are
        :raises ConfigError: if there is one only, or all fit in the pool
        """
        if n_tasks < 2:
            raise ConfigError("SMT chooses among tasks, and here is only one: leave the schedule out.")
        if self.pool_size >= n_tasks:
            raise ConfigError(
                f"pool_size={self.pool_size} holds all {n_tasks} tasks, so there would be nothing to choose; use "
                f"pool_size={n_tasks - 1} or less, or leave the schedule out."
            )

    def check_length(self, timesteps: int) -> None:
        """Raise unless the first stage has room for a decision.

        :param timesteps: environment steps after the random phase
        :raises ConfigError: if ``interval`` is longer than the first stage
        """
        if self.interval >= self.first_stage * timesteps:
            raise ConfigError(
                f"interval={self.interval} environment steps is as long as SMT's first stage, first_stage="
                f"{self.first_stage} of {timesteps} steps, so its pool would never change; use a smaller interval."
            )


class SMTSchedule:
    """Who collects, from the end of the random phase on.

    First stage: the tasks in the training pool collect. Every ``interval`` steps each is judged: it is solved; or, its
    budget spent, unsolvable or back in the main pool; or it stays. The free places go to the hardest tasks of the main
    pool, those with the lowest mean success, never seen ones before all others. Second stage: the unsolvable tasks
    collect; if there are none, those of the main pool; if that is empty too, all. Nobody is judged then.

    :param config: the options
    :param n_tasks: how many tasks there are
    :param start: environment steps of the random phase
    :param total: environment steps of the whole run
    :param seed: of the random order; None draws one
    :raises ConfigError: if so many tasks cannot be scheduled
    """

    def __init__(
        self, config: SMTConfig, n_tasks: int, start: int, total: int, seed: int | None = None
    ) -> None:
        config.check_tasks(n_tasks)
        self.config, self.n_tasks, self.total = config, n_tasks, total
        self.start = start
        self.stage = 1
        self._order = np.random.default_rng(seed).permutation(n_tasks).tolist()
        self._pool = ["main"] * n_tasks
        self._success: list[float | None] = [None] * n_tasks
        self._budget = [0.0] * n_tasks
        self._used = [0] * n_tasks
        self._episodes: list[deque[float]] = [deque(maxlen=config.window) for _ in range(n_tasks)]
        self._decided_at = start
        self._fill_pool([])

    @property
    def first_stage_end(self) -> int:
        """The environment step at which the first stage ends at the latest."""
        return self.start + round(self.config.first_stage * (self.total - self.start))

    @property
    def active(self) -> list[int]:
        """The tasks that collect now."""
        if self.stage == 1:
            return self.tasks("training")
        return self.tasks("unsolvable") or self.tasks("main") or list(range(self.n_tasks))

    def tasks(self, pool: str) -> list[int]:
        """Return the tasks in one of `POOLS`.

        :param pool: its name
        """
        return [task for task, where in enumerate(self._pool) if where == pool]

    def add_episode(self, task: int, success: float) -> None:
        """Note how an episode ended.

        :param task: index
        :param success: 0 or 1
        """
        self._episodes[task].append(float(success))

    def is_due(self, timesteps: int) -> bool:
        """Return whether it is time to decide.

        :param timesteps: environment steps the run has made
        """
        return self.stage == 1 and timesteps >= min(
            self._decided_at + self.config.interval, self.first_stage_end
        )

    def decide(self, timesteps: int) -> list[int]:
        """Judge the tasks in the training pool and fill it up; return the tasks that are new in it.

        :param timesteps: environment steps the run has made
        """
        training = self.tasks("training")
        spent = (timesteps - self._decided_at) // len(training)
        self._decided_at = timesteps
        is_over = timesteps >= self.first_stage_end
        for task in training:
            self._used[task] += spent
            self._pool[task] = self._judge(task, is_over)
        if is_over:
            self.stage = 2
            return []
        return self._fill_pool(training)

    def state(self) -> dict[str, Any]:
        """Return all it remembers, as JSON-like values."""
        return {
            "start": self.start,
            "stage": self.stage,
            "decided_at": self._decided_at,
            "order": list(self._order),
            "pool": list(self._pool),
            "success": list(self._success),
            "budget": list(self._budget),
            "used": list(self._used),
            "episodes": [list(episodes) for episodes in self._episodes],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state` returned; the options and ``total`` are this schedule's.

        :param state: of a schedule of as many tasks
        :raises ConfigError: if the number of tasks differs
        """
        if len(state["pool"]) != self.n_tasks:
            raise ConfigError(
                f"The saved schedule has {len(state['pool'])} tasks, this run has {self.n_tasks}; continue it with the "
                "tasks it was made for."
            )
        self.start, self.stage, self._decided_at = state["start"], state["stage"], state["decided_at"]
        self._order, self._pool = list(state["order"]), list(state["pool"])
        self._success, self._budget, self._used = (list(state[key]) for key in ("success", "budget", "used"))
        self._episodes = [deque(episodes, self.config.window) for episodes in state["episodes"]]

    def _judge(self, task: int, is_over: bool) -> str:
        """Return the pool a task in training belongs to now."""
        episodes = self._episodes[task]
        if episodes:
            self._success[task] = float(np.mean(episodes))
        success = self._success[task]
        if success is not None and success >= self.config.solved and len(episodes) == self.config.window:
            return "solved"
        if not is_over and self._used[task] < self._budget[task]:
            return "training"
        return "unsolvable" if success is not None and success <= self.config.unsolvable else "main"

    def _fill_pool(self, before: list[int]) -> list[int]:
        """Give free places to the hardest waiting tasks, each with a budget; return those that are not from before."""
        free = self.config.pool_size - len(self.tasks("training"))
        hardest = sorted(self.tasks("main"), key=self._rank)[:free]
        rest = self.first_stage_end - self._decided_at
        for task in hardest:
            self._pool[task] = "training"
            self._budget[task] = self.config.budget_share * rest / self.config.pool_size
            self._used[task] = 0
        new = [task for task in hardest if task not in before]
        for task in new:
            self._episodes[task].clear()
        if not self.tasks("training"):
            self.stage = 2
        return new

    def _rank(self, task: int) -> tuple[float, int]:
        success = self._success[task]
        return (-math.inf if success is None else success, self._order.index(task))


def _check_share(option: str, value: Any, or_zero: bool = False) -> None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not (0 < value <= 1 or (or_zero and value == 0)):
        lowest = "from 0" if or_zero else "above 0"
        raise ConfigError(f"{option}={value!r} must be a number {lowest} and at most 1.")
