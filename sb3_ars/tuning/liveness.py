"""Which trials still have a process behind them, and which count; knows nothing of what a trial does.

Optuna's own heartbeat exists for databases only. This one is two attributes of the trial, so every storage has it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import optuna
from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError
from optuna.trial import FrozenTrial, TrialState

from sb3_ars.experiments.owner import host, lives, this_process

__all__ = [
    "HEARTBEAT_LIMIT",
    "claim",
    "counts",
    "fail_dead_trials",
    "is_dead",
    "kept_alive",
    "retry",
    "why_failed",
]

HEARTBEAT_LIMIT = 600.0
"""Seconds without a sign of life after which a trial of another machine counts as dead."""

_INTERVAL = 30.0  # seconds between two heartbeats
_DEATHS_ALLOWED = 1  # the options of a trial that died oftener may be what kills the process


@contextmanager
def kept_alive(trial: optuna.Trial) -> Iterator[None]:
    """Record which process runs the trial, and that it lives, until the end of the block.

    :param trial: that this process runs
    """
    trial.set_user_attr("owner", this_process())
    trial.set_user_attr("heartbeat", time.time())
    done = threading.Event()
    thread = threading.Thread(target=_beat, args=(trial, done), name=f"heartbeat-{trial.number}", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def is_dead(trial: FrozenTrial, now: float | None = None) -> bool:
    """Return whether a running trial's process is gone.

    On the machine (and in the container) that runs it the process decides, elsewhere the latest heartbeat.

    :param trial: a running one
    :param now: seconds since the epoch; ``None`` asks the clock
    """
    owner = trial.user_attrs.get("owner")
    if owner is not None and owner["host"] == host():
        living = lives(owner["pid"], owner["started"])
        if living is not None:
            return not living
    started = trial.datetime_start.timestamp() if trial.datetime_start is not None else 0.0
    latest = float(trial.user_attrs.get("heartbeat", started))
    return (time.time() if now is None else now) - latest > HEARTBEAT_LIMIT


def fail_dead_trials(study: optuna.Study) -> list[int]:
    """Mark running trials whose process is gone as failed, queue their parameters again, return their numbers.

    Parameters whose second try dies too are not tried a third time.

    :param study: whose trials an objective of :func:`~sb3_ars.tuning.make_objective` runs
    """
    failed = []
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        if not is_dead(trial):
            continue
        try:
            study.tell(trial.number, state=TrialState.FAIL)
        except (ValueError, UpdateFinishedTrialError):
            continue  # another process was faster
        if _deaths(trial) < _DEATHS_ALLOWED:
            retry(study, trial, deaths=_deaths(trial) + 1)
        failed.append(trial.number)
    return failed


def retry(study: optuna.Study, trial: FrozenTrial | optuna.Trial, deaths: int | None = None) -> None:
    """Queue a trial's parameters for another trial.

    :param study: of the trial
    :param trial: that did not come to its end; where it had no parameters yet there is nothing to queue
    :param deaths: how many processes these parameters have outlived; ``None`` is as many as before
    """
    if trial.params:
        attributes = {"retry_of": trial.number, "deaths": _deaths(trial) if deaths is None else deaths}
        study.enqueue_trial(trial.params, user_attrs=attributes)


def why_failed(trial: FrozenTrial) -> str:
    """Return why a failed trial failed, in words.

    :param trial: a failed one
    """
    owner = trial.user_attrs.get("owner")
    died = "its process died" if owner is None else f"its process {owner['pid']} on {owner['host']} died"
    return str(trial.user_attrs.get("failure", died))


def counts(trial: FrozenTrial) -> bool:
    """Return whether a trial's options have been tried.

    Finished and pruned trials count, and those that failed by their own options, for trying them again would fail
    again. A trial that was interrupted or whose process died says nothing of its options.

    :param trial: of any state
    """
    if trial.state is not TrialState.FAIL:
        return trial.state in (TrialState.COMPLETE, TrialState.PRUNED)
    died = "failed_by" not in trial.user_attrs
    return trial.user_attrs.get("failed_by") == "options" or (died and _deaths(trial) >= _DEATHS_ALLOWED)


def claim(trial: optuna.Trial, n_trials: int, poll: float = 0.05) -> bool:
    """Return whether the trial is still one of the study's ``n_trials``, whatever other processes do meanwhile.

    Each process first makes its trial known as running, then looks at the others. Of two that start at once at least
    one sees the other, and neither claims the last place while the other has not decided; then the higher number
    gives way.

    :param trial: running, made known by :func:`kept_alive`
    :param n_trials: how many may count
    :param poll: seconds between two looks at the others
    """
    while True:
        taken, deciding = 0, []
        for other in trial.study.get_trials(deepcopy=False):
            if other.number == trial.number:
                continue
            running = other.state is TrialState.RUNNING and not is_dead(other)
            taken += counts(other) or (running and "claimed" in other.user_attrs)
            if running and "claimed" not in other.user_attrs:
                deciding.append(other.number)
        if taken >= n_trials:
            return False
        if taken + len(deciding) < n_trials:
            trial.set_user_attr("claimed", True)
            return True
        if trial.number > max(deciding):
            return False
        time.sleep(poll)


def _deaths(trial: FrozenTrial | optuna.Trial) -> int:
    return int(trial.user_attrs.get("deaths", 0))


def _beat(trial: optuna.Trial, done: threading.Event) -> None:
    while not done.wait(_INTERVAL):
        try:
            trial.set_user_attr("heartbeat", time.time())
        except StorageInternalError:
            continue  # a database that does not answer for a while; the next beat may reach it
        except UpdateFinishedTrialError:
            return  # another machine took this process for dead
