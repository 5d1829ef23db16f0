"""Summary numbers against hand-worked ones and an independent calculation."""

import json
from pathlib import Path

import numpy as np
import pytest

from sb3_ars.errors import ConfigError
from sb3_ars.metrics import bottom_k, estr, iqm, iqm_interval, mean_success, success_rates


def test_bottom_k_is_the_mean_of_the_k_worst():
    success = [1.0, 0.2, 0.9, 0.0, 0.4]
    assert bottom_k(success, 2) == pytest.approx(0.1)
    assert bottom_k(success, 3) == pytest.approx(0.2)
    assert bottom_k(success, 5) == pytest.approx(0.5)


def test_estr_counts_tasks_at_or_above_the_threshold():
    success = [0.0, 0.1, 0.3, 0.69, 1.0]
    assert [estr(success, d) for d in (0.1, 0.3, 0.5, 0.7)] == pytest.approx([0.8, 0.6, 0.4, 0.2])


def test_iqm_drops_the_lowest_and_highest_quarter():
    assert iqm([[0, 1], [2, 3], [4, 5], [6, 100]]) == pytest.approx((2 + 3 + 4 + 5) / 4)


def test_iqm_interval_agrees_with_a_plain_stratified_bootstrap():
    scores = np.random.default_rng(1).uniform(size=(6, 4))
    interval = iqm_interval(scores, n_resamples=4000)
    rng = np.random.default_rng(2)
    resampled = []
    for _ in range(4000):
        rows = rng.integers(0, 6, size=(6, 4))
        values = np.sort(np.take_along_axis(scores, rows, axis=0).ravel())
        resampled.append(values[6:-6].mean())
    low, high = np.percentile(resampled, [2.5, 97.5])
    assert interval.estimate == pytest.approx(np.sort(scores.ravel())[6:-6].mean())
    assert interval.low == pytest.approx(low, abs=0.01) and interval.high == pytest.approx(high, abs=0.01)


def test_success_rates_and_their_mean_leave_out_tasks_that_report_none():
    rates = success_rates([[1, 0, 1, 1], [0, 0, 0, 1], [np.nan] * 4])
    assert rates[:2].tolist() == [0.75, 0.25] and np.isnan(rates[2])
    assert mean_success(rates) == 0.5 and np.isnan(mean_success([np.nan]))


def test_shares_and_levels_outside_their_range_are_refused():
    with pytest.raises(ConfigError, match="threshold=90"):
        estr([0.5], 90)
    with pytest.raises(ConfigError, match="confidence=95"):
        iqm_interval([[0.5], [0.6]], confidence=95)


@pytest.mark.parametrize("k", [0, 6, 1.5])
def test_bottom_k_refuses_a_k_that_no_tasks_fit(k):
    with pytest.raises(ConfigError, match="between 1 and the number of tasks, 5"):
        bottom_k([0.0] * 5, k)


@pytest.mark.parametrize("scores", [[], [[1.0, float("nan")]], [1.0, 2.0]])
def test_scores_that_are_no_finite_table_are_refused(scores):
    with pytest.raises(ConfigError):
        iqm_interval(scores)


def test_an_interval_needs_two_seeds():
    with pytest.raises(ConfigError, match="two seeds"):
        iqm_interval([[0.1, 0.2]])


def test_iqm_cuts_whole_scores_only():
    # a quarter of six scores is one and a half: one is cut at each end
    assert iqm([5, 0, 1, 2, 3, 100]) == pytest.approx((1 + 2 + 3 + 5) / 4)


RLIABLE = json.loads((Path(__file__).parent / "data" / "rliable.json").read_text())


@pytest.mark.parametrize("case", RLIABLE["cases"])
def test_iqm_and_its_interval_agree_with_rliable(case):
    """Stored by tests/data/make_rliable.py, which says how to run it."""
    theirs = RLIABLE["cases"][case]
    scores = np.array(theirs["scores"])
    ours = iqm_interval(scores, confidence=RLIABLE["confidence"], n_resamples=RLIABLE["n_resamples"], seed=3)
    assert iqm(scores) == pytest.approx(theirs["iqm"], abs=1e-12)
    assert ours.estimate == iqm(scores)
    # what rates of ten episodes can move the mean by when one score inside the middle half changes by a step
    step = 0.1 / (scores.size - 2 * int(0.25 * scores.size))
    assert ours.low == pytest.approx(theirs["low"], abs=step + 1e-9)
    assert ours.high == pytest.approx(theirs["high"], abs=step + 1e-9)
    assert ours.low < ours.estimate < ours.high
