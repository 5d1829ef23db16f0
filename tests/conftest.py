"""Set-up of every test process."""

import os
import signal

# Two processes with an OpenMP thread per core each spin on two cores without getting anywhere.
os.environ["OMP_NUM_THREADS"] = "1"

import matplotlib
import torch as th

matplotlib.use("Agg")
th.set_num_threads(1)
# A shell starts background jobs with SIGINT ignored, which Python and its children would keep.
signal.signal(signal.SIGINT, signal.default_int_handler)
