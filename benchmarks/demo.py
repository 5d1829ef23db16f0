"""The preset ``demo``, which ``make demo`` runs, over several seeds: does it learn in minutes?

GOMP_SPINCOUNT=1000 python benchmarks/demo.py --seeds 3
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from pathlib import Path

from sb3_ars.experiments.config import load_preset
from sb3_ars.experiments.runner import train
from sb3_ars.versions import run_versions

RESULTS = Path(__file__).parent / "results" / "demo.json"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    runs = []
    for seed in range(arguments.seeds):
        with tempfile.TemporaryDirectory() as folder:
            config = dataclasses.replace(load_preset("demo"), seed=seed, output=Path(folder))
            result = train(config, "demo")
            runs.append({"seed": seed, **json.loads((result.folder / "result.json").read_text())})
        summary = {key: runs[-1][key] for key in ("seed", "mean_success", "training_seconds")}
        print(summary, flush=True)
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(
            json.dumps({"runs": runs, "versions": run_versions()}, indent=2) + "\n", encoding="utf-8"
        )
    print(f"written to {RESULTS}")


if __name__ == "__main__":
    main()
