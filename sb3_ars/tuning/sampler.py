"""The sampler of a study: TPE, its arguments stated, its random numbers decided by the trial's number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler, TPESampler
from optuna.trial import FrozenTrial, TrialState

from sb3_ars.errors import check_count

__all__ = ["NumberedTPESampler"]


class NumberedTPESampler(BaseSampler):
    """TPE that starts its generator afresh for each trial, from the seed and the trial's number.

    Numbers are the storage's, so two processes on one study never draw the same, and a study continued by another
    process goes on exactly as it would have.

    :param seed: of the study
    :param n_startup_trials: trials drawn at random before TPE looks at their values
    :raises ConfigError: if the seed is negative
    """

    def __init__(self, seed: int = 0, n_startup_trials: int = 5) -> None:
        self.seed = check_count("seed (--sampler-seed)", seed, minimum=0)
        self.n_startup_trials = n_startup_trials
        self._of_trial: BaseSampler = self._make(0)

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Start the generator of this trial."""
        self._of_trial = self._make(trial.number)
        self._of_trial.before_trial(study, trial)

    def infer_relative_search_space(
        self, study: optuna.Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """Return TPE's."""
        return self._of_trial.infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Return TPE's."""
        return self._of_trial.sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """Return TPE's."""
        return self._of_trial.sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: optuna.Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        """Do what TPE does."""
        self._of_trial.after_trial(study, trial, state, values)

    def _make(self, number: int) -> TPESampler:
        # constant_liar keeps processes from trying what others are trying; stated since Optuna 5 changed both defaults
        return TPESampler(
            seed=int(np.random.SeedSequence([self.seed, number]).generate_state(1)[0]),
            n_startup_trials=self.n_startup_trials,
            n_ei_candidates=24,
            multivariate=True,
            constant_liar=True,
        )
