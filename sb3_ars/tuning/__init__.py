"""Searches for options with Optuna: a study over ``n_reset``, or any other option of a run."""

from sb3_ars.tuning.liveness import fail_dead_trials
from sb3_ars.tuning.objective import TrialFailed, make_objective
from sb3_ars.tuning.results import TuningSummary, summarise, unused_seed, write_results
from sb3_ars.tuning.sampler import NumberedTPESampler
from sb3_ars.tuning.search_space import SearchSpace, TunedOption, load_search_space, search_space_names
from sb3_ars.tuning.study import make_pruner, tune

__all__ = [
    "NumberedTPESampler",
    "SearchSpace",
    "TrialFailed",
    "TunedOption",
    "TuningSummary",
    "fail_dead_trials",
    "load_search_space",
    "make_objective",
    "make_pruner",
    "search_space_names",
    "summarise",
    "tune",
    "unused_seed",
    "write_results",
]
