"""Writes rliable.json: IQMs and their bootstrap intervals as rliable computes them, for tests/test_metrics.py.

rliable does not install beside pandas 3, so it runs in an environment of its own:

    python3.11 -m venv rliable
    rliable/bin/pip install "setuptools<70" wheel "arch<7" "numpy<2" "pandas<2.2" "scipy<1.12" absl-py seaborn
    rliable/bin/pip install --no-build-isolation --no-deps rliable
    rliable/bin/python tests/data/make_rliable.py
"""

import importlib.metadata
import json
import platform
from pathlib import Path

import numpy as np
from rliable import library, metrics

RESAMPLES = 20_000
CONFIDENCE = 0.95
SHAPES = {  # seeds, tasks; 25 % of all scores is a whole number in the first and last only
    "8 seeds, 10 tasks": (8, 10),
    "3 seeds, 10 tasks": (3, 10),
    "5 seeds, 50 tasks": (5, 50),
    "2 seeds, 4 tasks": (2, 4),
}


def main():
    rng = np.random.default_rng(0)
    cases = {}
    for name, (n_seeds, n_tasks) in SHAPES.items():
        # rates of ten episodes on tasks from easy to hard, as evaluations give them
        scores = rng.binomial(10, rng.uniform(size=n_tasks), size=(n_seeds, n_tasks)) / 10
        estimate, interval = library.get_interval_estimates(
            {"scores": scores},
            lambda x: np.array([metrics.aggregate_iqm(x)]),
            reps=RESAMPLES,
            confidence_interval_size=CONFIDENCE,
            random_state=np.random.RandomState(1),
        )
        low, high = interval["scores"][:, 0]
        cases[name] = {
            "scores": scores.tolist(),
            "iqm": float(estimate["scores"][0]),
            "low": float(low),
            "high": float(high),
        }
    versions = {name: importlib.metadata.version(name) for name in ("rliable", "arch", "numpy", "scipy")}
    stored = {
        "versions": {"python": platform.python_version(), **versions},
        "n_resamples": RESAMPLES,
        "confidence": CONFIDENCE,
        "cases": cases,
    }
    Path(__file__).with_name("rliable.json").write_text(json.dumps(stored) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
