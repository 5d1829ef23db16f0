"""Gathers finished runs of the preset ``demo`` into one file, which the README quotes.

for seed in 0 1; do sb3-ars train demo --seed $seed; done
python benchmarks/demo.py runs/demo-seed0 runs/demo-seed1
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import yaml

RESULTS = Path(__file__).parent / "results" / "demo.json"


def main() -> None:
    folders = [Path(argument) for argument in sys.argv[1:]]
    if not folders:
        sys.exit(__doc__)
    runs = [
        {
            "seed": yaml.safe_load((folder / "config.yaml").read_text())["seed"],
            **json.loads((folder / "result.json").read_text()),
            "versions": json.loads((folder / "versions.json").read_text()),
        }
        for folder in folders
    ]
    RESULTS.write_text(json.dumps({"runs": runs}, indent=2) + "\n", encoding="utf-8")
    for run in runs:
        print(
            f"seed {run['seed']}: mean success {run['mean_success']:.2f}, {run['training_seconds'] / 60:.1f} minutes"
        )


if __name__ == "__main__":
    main()
