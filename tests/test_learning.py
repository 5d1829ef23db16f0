"""Seeded learning on the toy tasks: ARS learns every task, and ARS is why."""

import numpy as np
import pytest

from benchmarks.toy_methods import train_arm

SEEDS = range(5)


@pytest.fixture(scope="module")
def success():
    """(arm, seed) -> success of each task, loudest first; one seed of each arm takes about a minute."""
    results = {}

    def of(arm, seed):
        if (arm, seed) not in results:
            results[arm, seed] = train_arm(arm, seed)["success"]
        return results[arm, seed]

    return of


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_ars_learns_every_toy_task(success, seed):
    assert min(success("ars", seed)) >= 0.9, success("ars", seed)


@pytest.mark.slow
def test_bf16_learns_every_toy_task_as_well(success):
    exact, rounded = (np.mean([success(arm, seed) for seed in SEEDS], axis=0) for arm in ("ars", "ars-bf16"))
    assert (rounded >= exact - 0.05).all(), (exact, rounded)


@pytest.mark.slow
def test_without_scaling_and_resets_the_quiet_tasks_stay_under_half_of_that(success):
    loud, quiet = np.split(np.mean([success("sac", seed) for seed in SEEDS], axis=0), 2)
    assert max(quiet) < 0.45 and min(loud) > 0.8, (loud, quiet)
