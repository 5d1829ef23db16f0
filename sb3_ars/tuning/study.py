"""A study from its start to its end, by one process or several; what a trial does is the objective's business."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, get_args

import optuna
from optuna.exceptions import ExperimentalWarning, UpdateFinishedTrialError
from optuna.pruners import BasePruner, MedianPruner, NopPruner, WilcoxonPruner
from optuna.trial import FrozenTrial, TrialState

from sb3_ars.errors import ConfigError, check_count, check_path, nearest
from sb3_ars.experiments.config import RunConfig
from sb3_ars.tuning.liveness import counts, fail_dead_trials, is_dead
from sb3_ars.tuning.objective import Objective, Space, TrialFailed, plain_config
from sb3_ars.tuning.sampler import NumberedTPESampler
from sb3_ars.tuning.search_space import load_search_space
from sb3_ars.tuning.storage import describe_storage, open_storage

__all__ = ["DEFINITION", "Pruner", "load_study", "make_pruner", "study_name", "tune"]

Pruner = Literal["median", "wilcoxon", "none"]
Callback = Callable[[optuna.Study, FrozenTrial], None]

DEFINITION = "definition"
"""Attribute of a study: everything that a process must agree on to take part in it."""

_STARTUP_TRIALS = 4  # complete ones before any is pruned
_WILCOXON_P = 0.1  # four tasks, all worse: p = 1/16


def tune(
    preset: str | RunConfig,
    space: Space = "n_reset",
    *,
    n_trials: int = 20,
    timeout: float | None = None,
    n_seeds: int = 3,
    n_evaluations: int = 4,
    pruner: Pruner = "median",
    storage: str | Path | None = None,
    name: str | None = None,
    output: Path | str = "studies",
    scale: str = "full",
    seed: int = 0,
    callbacks: Sequence[Callback] = (),
    before_first_trial: Callable[[optuna.Study], None] | None = None,
) -> optuna.Study:
    """Run a study until it has its trials, or go on with one, and return it.

    Any number of processes may call this with the same arguments: together they run ``n_trials``. Trials whose process
    died are marked as failed and tried once more. Ctrl-C ends the running trial, which the next call tries again.

    :param preset: name of a preset, or the configuration that trials change
    :param space: name of a search space, path of a YAML file, or what such a file holds
    :param n_trials: how many trials, all processes together: finished, pruned, or failed by their own options
    :param timeout: seconds after which this process starts no further trial
    :param n_seeds: runs of each trial
    :param n_evaluations: evaluations during each run, evenly spaced
    :param pruner: "median", "wilcoxon" (by task, after each run) or "none"
    :param storage: path of a journal file or URL of a database; ``None`` is ``<output>/<study>/journal.log``
    :param name: of the study; ``None`` is made of preset, space and scale
    :param output: folder of studies
    :param scale: size of the runs, such as "toy"
    :param seed: of the sampler
    :param callbacks: called with the study and each trial this process ended
    :param before_first_trial: called with the study once everything is checked, before anything is trained
    :raises ConfigError: before anything is trained, if an option cannot work, the storage cannot be reached, or the
        study was started with other options
    """
    n_trials = check_count("n_trials (--n-trials)", n_trials)
    is_number = isinstance(timeout, int | float) and not isinstance(timeout, bool)
    if timeout is not None and not (is_number and timeout > 0):
        raise ConfigError(
            f"timeout (--timeout) is {f'{timeout:g}' if is_number else repr(timeout)} s, but must be more than 0."
        )
    if name is not None and not (isinstance(name, str) and name and name == Path(name).name):
        raise ConfigError(
            f"name (--study)={name!r} must be the name of a folder in --output, without slashes."
        )
    output = check_path("output (--output)", output)
    if not isinstance(callbacks, list | tuple):
        raise ConfigError(f"callbacks={callbacks!r} must be a list of functions of study and trial.")
    space = load_search_space(space)
    objective = Objective(
        preset,
        space,
        n_seeds=n_seeds,
        n_evaluations=n_evaluations,
        output=output,
        scale=scale,
        n_trials=n_trials,
    )
    name = name or study_name(objective.preset, space.name, scale)
    definition = {
        "preset": objective.preset,
        "scale": scale,
        "config": plain_config(objective.config),
        "space": space.plain(),
        "seeds": n_seeds,
        "evaluations": n_evaluations,
        "pruner": pruner,
        "sampler_seed": seed,
    }
    chosen = make_pruner(pruner, n_seeds, n_evaluations)
    sampler = NumberedTPESampler(seed)
    folder = Path(output) / name
    where = folder / "journal.log" if storage is None else storage
    ends = math.inf if timeout is None else time.monotonic() + timeout
    with _quiet():
        study = optuna.create_study(
            storage=open_storage(where),
            sampler=sampler,
            pruner=chosen,
            study_name=name,
            direction="maximize",
            load_if_exists=True,
        )
        _agree(study, definition, folder, describe_storage(where))
        if before_first_trial is not None:
            before_first_trial(study)
        while True:
            fail_dead_trials(study)
            if time.monotonic() > ends or _are_enough(study, n_trials):
                return study
            try:
                study.optimize(
                    objective, 1, callbacks=list(callbacks), catch=(TrialFailed,), gc_after_trial=True
                )
            except UpdateFinishedTrialError:
                continue  # another machine took this trial for dead, and queued it again


def load_study(name: str, storage: str | Path | None = None, output: Path | str = "studies") -> optuna.Study:
    """Return a study to look at.

    :param name: of the study
    :param storage: as in :func:`tune`
    :param output: as in :func:`tune`
    :raises ConfigError: if there is none
    """
    where = Path(output) / name / "journal.log" if storage is None else storage
    if "://" not in str(where) and not Path(where).is_file():
        raise ConfigError(
            f"There is no journal {where}; give --study, --output or --storage as when it was tuned."
        )
    try:
        return optuna.load_study(study_name=name, storage=open_storage(where))
    except KeyError as error:
        raise ConfigError(f"There is no study {name!r} in {describe_storage(where)}.") from error


def study_name(preset: str, space: str, scale: str = "full") -> str:
    """Return the name of a study that is given none.

    :param preset: name
    :param space: name
    :param scale: name or path
    """
    return f"{preset}-{space}" + (f"-{Path(scale).stem}" if scale != "full" else "")


def make_pruner(name: Pruner, n_seeds: int = 3, n_evaluations: int = 4) -> BasePruner:
    """Return a pruner that suits what :func:`~sb3_ars.tuning.make_objective` reports.

    The median pruner waits for the second half of the first run: until then a trial's best evaluation says more of when
    its resets are than of how good they are.

    :param name: "median", "wilcoxon" or "none"
    :param n_seeds: of each trial
    :param n_evaluations: during each run
    :raises ConfigError: if the name is unknown, or the pruner could never prune
    """
    if name not in get_args(Pruner):
        raise ConfigError(
            f"pruner={name!r} is unknown; choose one of {', '.join(get_args(Pruner))}."
            + nearest(str(name), get_args(Pruner))
        )
    if name == "none":
        return NopPruner()
    if name == "median":
        if n_seeds == 1 and n_evaluations == 0:
            raise ConfigError(
                "The median pruner has nothing to look at: give --evaluations 1, --seeds 2, or --pruner none."
            )
        return MedianPruner(
            n_startup_trials=_STARTUP_TRIALS, n_warmup_steps=math.ceil((n_evaluations + 1) / 2)
        )
    if n_seeds == 1:
        raise ConfigError(
            "The Wilcoxon pruner looks at finished runs, so with --seeds 1 it can never prune; give more."
        )
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", ExperimentalWarning
        )  # its interface may change; it is used as documented
        return WilcoxonPruner(p_threshold=_WILCOXON_P)


def _agree(study: optuna.Study, definition: dict[str, Any], folder: Path, where: str) -> None:
    """Leave what the study is in it if it is new; raise if it is another one."""
    before = study.user_attrs.get(DEFINITION)
    if before is None:
        trials = sorted(folder.glob("trial*")) if folder.is_dir() else []
        if trials and not study.get_trials(deepcopy=False):
            raise ConfigError(
                f"{folder} holds runs of an earlier study, {trials[0].name} for one, of which {where} knows nothing; "
                "delete the folder, or give another --study."
            )
        study.set_user_attr(DEFINITION, definition)
        return
    differences = list(_differences(before, definition))
    if differences:
        more = f"; and {len(differences) - 5} more" if len(differences) > 5 else ""
        raise ConfigError(
            f"Study {study.study_name!r} in {where} was started with other options: {'; '.join(differences[:5])}{more}."
            " Give the same ones to go on with it, or another --study to start one."
        )


def _differences(before: Any, now: Any, name: str = "") -> Iterator[str]:
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for key in {**before, **now}:
            yield from _differences(before.get(key), now.get(key), f"{name}.{key}".removeprefix("."))
    elif before != now:
        yield f"{name} was {before!r}, is {now!r}"


def _are_enough(study: optuna.Study, n_trials: int) -> bool:
    """Return whether the trials that count, and those that other processes are running, are as many as wanted."""
    trials = study.get_trials(deepcopy=False)
    running = sum(t.state is TrialState.RUNNING and not is_dead(t) for t in trials)
    return sum(map(counts, trials)) + running >= n_trials


@contextmanager
def _quiet() -> Iterator[None]:
    """Have Optuna log errors only: what trials come to is for the callbacks to say."""
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        yield
    finally:
        optuna.logging.set_verbosity(before)
