"""Runs the CPU benchmarks one after another, writes their JSON, the chart and the documents' tables, prints the goals.

python -m benchmarks.run_all                    # what ``make bench`` runs; under 15 minutes on two cores
python -m benchmarks.run_all --only methods     # ``make bench-methods``; about as long
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import env_steps, memory, methods, report, training_loop, update
from benchmarks.harness import RESULTS, write_result

BENCHMARKS: dict[str, Callable[[], dict[str, Any]]] = {
    "env_steps": env_steps.measure,
    "update": update.measure,
    "training_loop": training_loop.measure,
    "memory": memory.measure,
    "methods": methods.measure,
}
USUAL = tuple(report.PANELS)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=BENCHMARKS, default=USUAL, help="these alone")
    parser.add_argument(
        "--output", type=Path, default=RESULTS, help="another folder leaves the documents as they are"
    )
    arguments = parser.parse_args()
    failed = [name for name in arguments.only if not _ran(name, arguments.output)]
    results = report.read_results(arguments.output)
    measured = {name: results[name] for name in arguments.only if name in results}
    for name in measured:
        print("", report.render(name, results), sep="\n")
    print("", report.goals_table(measured, measured), sep="\n")
    if arguments.output == RESULTS:
        print("", "written:", *report.write_pages(), sep="\n")
    else:
        report.draw_chart(measured, arguments.output)
    if failed:
        print("failed:", *failed, file=sys.stderr)
    return 1 if failed else 0


def _ran(name: str, output: Path) -> bool:
    """Run one benchmark; one that fails must not lose what the others measured."""
    started = time.monotonic()
    print(f"{name} ...", flush=True)
    try:
        path = write_result(name, BENCHMARKS[name](), output)
    except Exception:
        traceback.print_exc()
        return False
    print(f"  {path}, {time.monotonic() - started:.0f} s", flush=True)
    return True


if __name__ == "__main__":
    sys.exit(main())
