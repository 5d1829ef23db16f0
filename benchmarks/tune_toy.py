"""A study of n_reset on the toy tasks by two processes, one of which is killed in the middle and started again.

    python -m benchmarks.tune_toy --folder /tmp/tune_toy     # a quarter of an hour on two cores

Every process is the command that a user would type. Nobody tells the study of the kill: the trial that it cost is
found, marked as failed and tried again by whichever process next looks.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import TrialState

from benchmarks.harness import RESULTS, ROOT, machine, threads_environment, write_result
from sb3_ars.errors import ConfigError
from sb3_ars.tuning import summarise
from sb3_ars.tuning.liveness import why_failed
from sb3_ars.tuning.study import load_study, study_name

PRESET, SPACE, SCALE = "mt10-ars", "n_reset", "toy"
KILL_AFTER = 1 / 3  # of the trials are complete


def command(folder: Path, trials: int, seeds: int, pruner: str) -> list[str]:
    """Return what starts the study, and what goes on with it."""
    return [
        *(sys.executable, "-m", "sb3_ars.cli", "tune", PRESET, "--space", SPACE),
        *("--scale", SCALE, "--evaluations", "0"),
        *("--n-trials", str(trials), "--seeds", str(seeds), "--pruner", pruner, "--output", str(folder)),
    ]


def start(arguments: list[str], log: Path) -> subprocess.Popen[bytes]:
    """Start a process of the study on a thread of its own, its output behind what the file holds."""
    environment = {**os.environ, **threads_environment(1), "MPLBACKEND": "Agg"}
    with log.open("ab") as file:
        return subprocess.Popen(arguments, cwd=ROOT, env=environment, stdout=file, stderr=subprocess.STDOUT)


def running_trial(study: optuna.Study, pid: int, at_least: float) -> int | None:
    """Return the trial that a process has been running for so many seconds."""
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        owner = trial.user_attrs.get("owner")
        if owner and owner["pid"] == pid and time.time() - trial.datetime_start.timestamp() > at_least:
            return trial.number
    return None


def run(folder: Path, trials: int, seeds: int, pruner: str, kill: bool, patience: float) -> dict[str, Any]:
    """Run the study to its end; return what happened."""
    folder.mkdir(parents=True, exist_ok=True)
    arguments = command(folder, trials, seeds, pruner)
    started = time.monotonic()
    processes = [start(arguments, folder / f"process{i}.log") for i in range(2)]
    story: dict[str, Any] = {"processes": 2, "killed_trial": None}
    try:
        while any(process.poll() is None for process in processes):
            if time.monotonic() - started > patience:
                raise RuntimeError(f"The study did not end in {patience:.0f} s; see {folder}/process*.log.")
            time.sleep(2)
            if kill and story["killed_trial"] is None and processes[0].poll() is None:
                victim = _victim(folder, processes[0].pid, trials)
                if victim is not None:
                    processes[0].send_signal(signal.SIGKILL)
                    processes[0].wait()
                    story |= {"killed_trial": victim, "killed_after_seconds": time.monotonic() - started}
                    processes[0] = start(arguments, folder / "process0.log")
    finally:
        for process in processes:
            if process.poll() is None:
                process.kill()
                process.wait()
    return {**story, "seconds": time.monotonic() - started, "exit_codes": [p.returncode for p in processes]}


def _victim(folder: Path, pid: int, trials: int) -> int | None:
    try:
        study = load_study(study_name(PRESET, SPACE, SCALE), output=folder)
    except ConfigError:
        return None  # the processes have not made it yet
    complete = len(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED)))
    return running_trial(study, pid, at_least=10) if complete >= KILL_AFTER * trials else None


def result(folder: Path, story: dict[str, Any], seeds: int, pruner: str) -> dict[str, Any]:
    """Return what the study found, to be written down."""
    study = load_study(study_name(PRESET, SPACE, SCALE), output=folder)
    summary = summarise(study)
    return {
        "machine": machine(2),
        "preset": PRESET,
        "scale": SCALE,
        "steps": study.user_attrs["definition"]["config"]["algorithm"]["total_timesteps"],
        "space": study.user_attrs["definition"]["space"],
        "seeds": seeds,
        "pruner": pruner,
        "story": story,
        "states": summary.states,
        "tried": [
            {
                "params": t.params,
                "mean": t.mean,
                "std": t.std,
                "values": list(t.values),
                "trials": list(t.trials),
            }
            for t in summary.tried
        ],
        "spread": summary.spread,
        "verdict": summary.verdict,
        "trials": [
            {
                "number": trial.number,
                "state": trial.state.name,
                "params": trial.params,
                "value": trial.value,
                "values": trial.user_attrs.get("values"),
                "seeds": trial.user_attrs.get("seeds"),
                "seconds": trial.user_attrs.get("seconds"),
                "retry_of": trial.user_attrs.get("retry_of"),
                "why": why_failed(trial) if trial.state is TrialState.FAIL else None,
            }
            for trial in study.get_trials(deepcopy=False)
        ],
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="where the study and its runs are kept")
    parser.add_argument("--trials", type=int, default=12)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--pruner", default="none", choices=("median", "wilcoxon", "none"))
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--no-kill", action="store_true")
    parser.add_argument("--patience", type=float, default=3600, help="seconds after which it is given up")
    options = parser.parse_args()
    story = run(
        options.folder.resolve(),
        options.trials,
        options.seeds,
        options.pruner,
        not options.no_kill,
        options.patience,
    )
    found = result(options.folder.resolve(), story, options.seeds, options.pruner)
    path = write_result("tune_toy", found, options.results)
    print(found["verdict"])
    print(f"{found['states']}; trial {story['killed_trial']} was killed. Written to {path}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
