"""What must hold over a night: kills at random moments, thousands of calls, thousands of damaged files."""

import shutil

import pytest

from benchmarks.lifecycle import growth, lifecycle
from benchmarks.soak import soak
from tests.test_checkpoints import fuzz, saved  # noqa: F401  # a fixture

pytestmark = pytest.mark.filterwarnings("ignore:.*leaves no updates")


@pytest.mark.parametrize(("n_kills", "total"), [(2, 3000), pytest.param(100, 40_000, marks=pytest.mark.slow)])
def test_a_run_killed_at_random_moments_ends_as_if_nothing_had_happened(n_kills, total, tmp_path):
    found = soak(n_kills, total, tmp_path)
    assert found["differing"] == [] and found["steps"] == total and found["resets"] == 2
    assert found["lives_that_found_no_usable_checkpoint"] == 0 and len(found["lives"]) == n_kills
    assert n_kills < 10 or found["kills_while_a_file_was_written"] > 0


@pytest.mark.slow
def test_thousands_of_calls_leave_nothing_behind(tmp_path):
    grown = growth(lifecycle(2000, tmp_path))
    memory = grown.pop("resident_mb_per_1000_calls")
    assert grown == {"processes": 0, "open_files": 0, "shared_memory_segments": 0}
    assert memory < 5  # of about 500 MB; a leaked model of this size alone would be 200


def test_a_few_calls_leave_no_process_file_or_segment(tmp_path):
    looks = lifecycle(6, tmp_path, looks=3)
    for key in ("processes", "open_files", "shared_memory_segments"):
        assert looks[-1][key] == looks[-2][key], key


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_ten_thousand_fuzzed_checkpoints_give_our_errors_alone(saved, tmp_path):  # noqa: F811
    outcomes = fuzz(shutil.copytree(saved, tmp_path / "checkpoints"), 10_000, seed=1)
    assert sum(outcomes.values()) == 10_000 and outcomes["refused"] > 5000
