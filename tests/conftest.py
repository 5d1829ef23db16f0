"""Set-up of every test process."""

import os

# Two processes with an OpenMP thread per core each spin on two cores without getting anywhere.
os.environ["OMP_NUM_THREADS"] = "1"

import matplotlib
import torch as th

matplotlib.use("Agg")
th.set_num_threads(1)
