"""Set-up of every test process."""

import os
import signal

# Two processes with an OpenMP thread per core each spin on two cores without getting anywhere.
os.environ["OMP_NUM_THREADS"] = "1"

import matplotlib
import pytest
import torch as th

matplotlib.use("Agg")
th.set_num_threads(1)
# A shell starts background jobs with SIGINT ignored, which Python and its children would keep.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished toy run, of few steps."""
    from sb3_ars.experiments.config import load_preset, with_options
    from sb3_ars.experiments.runner import train

    options = {
        "algorithm": {"total_timesteps": 400},
        "ars": {"param_resets": [300], "updates_after_reset": 2},
        "policy": {"net_arch": [8]},
        "evaluation": {"n_episodes": 1},
    }
    folder = tmp_path_factory.mktemp("runs") / "toy"
    train(with_options(load_preset("toy"), options, "test"), "toy", progress_bar=False, folder=folder)
    return folder
