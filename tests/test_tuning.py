"""Studies: search spaces, trials, pruning, several processes, what dies and what is found."""

import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import optuna
import pandas as pd
import psutil
import pytest
import yaml
from optuna.trial import TrialState

from sb3_ars.cli import main
from sb3_ars.errors import ConfigError, DivergedError
from sb3_ars.experiments import runner
from sb3_ars.experiments.config import load_config, load_preset
from sb3_ars.experiments.run_folder import RESULT, find_runs
from sb3_ars.experiments.runner import RunResult
from sb3_ars.tuning import (
    NumberedTPESampler,
    TrialFailed,
    liveness,
    load_search_space,
    make_objective,
    make_pruner,
    objective,
    search_space_names,
    summarise,
    tune,
    write_results,
)
from sb3_ars.tuning.storage import open_storage
from sb3_ars.tuning.study import load_study

ROOT = Path(__file__).parent.parent
RESETS = {"ars.n_reset": {"type": "int", "low": 0, "high": 9}}
TASKS = ("point-east", "point-north", "point-west", "point-south")


def tiny_toy(**algorithm):
    toy = load_preset("toy")
    return dataclasses.replace(
        toy,
        algorithm=dataclasses.replace(
            toy.algorithm, **{"total_timesteps": 800, "batch_size": 8, **algorithm}
        ),
        evaluation=dataclasses.replace(toy.evaluation, n_episodes=1),
        ars=dataclasses.replace(toy.ars, updates_after_reset=3),
        policy=dataclasses.replace(toy.policy, net_arch=(8,)),
    )


def fake_train(monkeypatch, success, curve=(), error=None):
    """Have trials train nothing; success is a function of the configuration, curve what evaluations give."""
    trained = []

    def train(config, name, progress_bar, folder, after_evaluation):
        folder.mkdir(parents=True)
        trained.append(config)
        report = after_evaluation.report
        for number, share in enumerate(curve, start=1):
            report.after_evaluation(number, share * float(np.mean(success(config))))
        if error is not None:
            raise error
        values = np.broadcast_to(np.asarray(success(config), dtype=float), (4,))
        table = pd.DataFrame({"success": values}, index=pd.Index(TASKS, name="task"))
        return RunResult(folder, table, "protocol toy", 0.0)

    monkeypatch.setattr(objective, "train", train)
    return trained


def load_yaml(path):
    return yaml.safe_load(path.read_text())


def by_resets(config):
    """Best with 4 resets; seeds differ a little."""
    return 0.9 - 0.1 * abs(config.ars.n_reset - 4) + 0.01 * (config.seed % 2)


# ---------------------------------------------------------------------- search spaces


@pytest.mark.parametrize("name", search_space_names())
def test_the_spaces_of_the_package_tune_n_reset_of_the_papers_preset(name):
    space = load_search_space(name)
    assert space.names[0] == "ars.n_reset"
    study = optuna.create_study(sampler=NumberedTPESampler(), direction="maximize")
    values = space.suggest(study.ask())
    config = space.apply(load_preset("mt10-ars"), values)
    assert config.ars.n_reset == values["ars.n_reset"]


def test_a_space_is_also_a_file_or_a_mapping(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("ars.n_reset: {type: int, low: 0, high: 9}\n")
    assert load_search_space(path).options == load_search_space(RESETS).options
    assert load_search_space(path).name == "mine" and load_search_space(RESETS).name == "custom"
    assert load_search_space(path).plain() == RESETS


def test_n_reset_takes_the_place_of_the_presets_reset_times():
    config = load_search_space(RESETS).apply(load_preset("toy"), {"ars.n_reset": 3})
    assert config.ars.n_reset == 3 and config.ars.param_resets is None
    assert config.ars.reset_times(48_000, 4) == [12_000, 24_000, 36_000]


def test_lists_are_choices_too():
    space = load_search_space({"policy.net_arch": {"type": "categorical", "choices": [[8], [8, 8]]}})
    study = optuna.create_study(direction="maximize")
    study.enqueue_trial({"policy.net_arch": "[8, 8]"})
    values = space.suggest(study.ask())
    assert values == {"policy.net_arch": [8, 8]}
    assert space.apply(load_preset("toy"), values).policy.net_arch == (8, 8)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"n_reset": RESETS["ars.n_reset"]}, "'n_reset' is no option of a run. Did you mean 'ars.n_reset'"),
        ({"ars.n_resets": RESETS["ars.n_reset"]}, "Did you mean 'ars.n_reset'"),
        ({"ars.n_reset": {"type": "integer", "low": 0, "high": 9}}, "type='integer' is unknown.*'int'"),
        ({"ars.n_reset": {"type": "int", "low": 0, "hihg": 9}}, "has no 'hihg'.*Did you mean 'high'"),
        ({"ars.n_reset": {"type": "int", "low": 0}}, "high=None must be an integer"),
        ({"ars.n_reset": {"type": "int", "low": 0, "high": 2.5}}, "high=2.5 must be an integer"),
        ({"ars.n_reset": {"type": "int", "low": 9, "high": 0}}, "low=9, high=0 cannot be"),
        ({"ars.n_reset": {"type": "int", "low": 0, "high": 9, "step": 2}}, "no multiple of step 2"),
        ({"ars.n_reset": {"type": "int", "low": 0, "high": 9, "choices": [1]}}, "choices go with"),
        ({"ars.n_reset": {"type": "float", "low": 0.0, "high": 9.0}}, "cannot be 0.0 .*it takes int | None"),
        ({"ars.n_reset": {"low": 0, "high": 9}}, "must be a mapping with type"),
        ({"algorithm.tau": {"type": "float", "low": "1e-4", "high": 0.1}}, "write 1.0e-4"),
        ({"ars.reset": {"type": "categorical", "choices": ["critics", "none"]}}, "cannot be 'critics'"),
        ({"ars.reset": {"type": "categorical", "choices": ["critic"]}}, "two or more different"),
        ({"ars.reset": {"type": "categorical", "choices": ["critic", "none"], "low": 1}}, "low goes with"),
        ({"policy.net_arch": {"type": "categorical", "choices": [[8], ["a"]]}}, r"cannot be \['a'\]"),
        ({"seed": {"type": "int", "low": 0, "high": 9}}, "says what is measured"),
        ({"evaluation.n_episodes": {"type": "int", "low": 1, "high": 9}}, "says what is measured"),
        (
            {**RESETS, "ars.param_resets": {"type": "categorical", "choices": [[1], [2]]}},
            "both say when to reset",
        ),
        ({}, "has no options"),
        ("n_rest", "no search space 'n_rest'. Did you mean 'n_reset'"),
        ("missing.yaml", "cannot be read .No such file"),
    ],
)
def test_a_wrong_space_is_refused_by_name(space, message):
    with pytest.raises(ConfigError, match=message):
        load_search_space(space)


@pytest.mark.parametrize(
    ("content", "message"), [(b"\xff: 1\n", "no text in UTF-8"), (b"a: [1\nb: 2\n", "not valid YAML")]
)
def test_a_space_s_file_that_cannot_be_read_is_refused_in_one_line(content, message, tmp_path):
    (tmp_path / "mine.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=rf"mine\.yaml is {message}") as raised:
        load_search_space(tmp_path / "mine.yaml")
    assert len(str(raised.value).splitlines()) == 1


def test_a_preset_that_never_resets_has_no_n_reset_to_tune(tmp_path):
    with pytest.raises(ConfigError, match=r"ars.n_reset changes nothing where ars.reset='none'"):
        tune("mt10-sac", output=tmp_path)
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------------- trials that train


def test_a_study_trains_reports_and_leaves_everything_behind(tmp_path):
    space = {
        "ars.n_reset": {"type": "int", "low": 0, "high": 3},
        "policy.net_arch": {"type": "categorical", "choices": [[8], [8, 8]]},
    }
    study = tune(tiny_toy(), space, n_trials=2, n_seeds=2, n_evaluations=2, output=tmp_path, name="s")
    assert [trial.state for trial in study.trials] == [TrialState.COMPLETE] * 2
    for trial in study.trials:
        attributes = trial.user_attrs
        assert trial.value == pytest.approx(np.mean(attributes["values"]))
        assert list(attributes["success"]) == list(TASKS)
        assert attributes["versions"]["packages"]["torch"] and attributes["versions"]["optuna"]
        # steps: two evaluations and the end of each of two runs
        assert sorted(trial.intermediate_values) == [1, 2, 3, 4, 5, 6]
        assert trial.intermediate_values[6] == pytest.approx(trial.value)
        folder = tmp_path / "s" / f"trial{trial.number}"
        assert json.loads((folder / "trial.json").read_text())["state"] == "COMPLETE"
        for seed in (0, 1):
            config = load_config(folder / f"seed{seed}" / "config.yaml")
            assert config.seed == seed and config.ars.n_reset == trial.params["ars.n_reset"]
            assert config.ars.param_resets is None and config.evaluation.every == 267
            result = json.loads((folder / f"seed{seed}" / RESULT).read_text())
            assert result["mean_success"] == attributes["values"][seed]
            assert "Step" in (folder / f"seed{seed}.log").read_text()  # what the run printed
    assert len(find_runs(tmp_path)) == 4


def test_a_pruned_trial_closes_its_environments_and_does_not_pass_for_finished(tmp_path, monkeypatch):
    closed = []
    original = runner.make_env

    def make_env(config):
        env = original(config)
        close = env.close
        env.close = lambda: (closed.append(config), close())
        return env

    monkeypatch.setattr(runner, "make_env", make_env)
    study = optuna.create_study(direction="maximize", study_name="s", pruner=AlwaysPrune())
    study.optimize(make_objective(tiny_toy(), RESETS, n_seeds=2, output=tmp_path), n_trials=1)
    assert study.trials[0].state is TrialState.PRUNED and len(closed) == 1
    folder = tmp_path / "s" / "trial0"
    assert json.loads((folder / "trial.json").read_text())["state"] == "PRUNED"
    assert (folder / "seed0" / "policy.zip").is_file() and find_runs(tmp_path) == []


class AlwaysPrune(optuna.pruners.BasePruner):
    def prune(self, study, trial):
        return True


def test_options_that_a_run_cannot_have_fail_their_trial_only(tmp_path):
    # 90 resets in 800 steps begin within the random phase, which ends at step 32
    space = {"ars.n_reset": {"type": "categorical", "choices": [1, 90]}}
    study = tune(
        tiny_toy(), space, n_trials=3, n_seeds=1, n_evaluations=0, output=tmp_path, name="s", pruner="none"
    )
    states = {trial.params["ars.n_reset"]: trial for trial in study.trials}
    assert states[90].state is TrialState.FAIL and states[1].state is TrialState.COMPLETE
    assert "n_reset asks for 90 resets" in states[90].user_attrs["failure"]
    assert len(study.trials) == 3
    assert "n_reset asks for 90 resets" in summarise(study).failures[states[90].number]


# ---------------------------------------------------------------------- trials that do not


def test_a_trial_that_diverges_fails_and_a_bug_ends_the_study(tmp_path, monkeypatch):
    fake_train(monkeypatch, by_resets, error=DivergedError("loss is NaN"))
    study = tune("toy", n_trials=2, n_seeds=1, output=tmp_path)
    assert [trial.state for trial in study.trials] == [TrialState.FAIL] * 2
    assert study.trials[0].user_attrs["failure"] == "DivergedError: loss is NaN"
    fake_train(monkeypatch, by_resets, error=ZeroDivisionError("a bug"))
    with pytest.raises(ZeroDivisionError):
        tune("toy", n_trials=3, n_seeds=1, output=tmp_path)


def test_tasks_without_success_are_refused(tmp_path, monkeypatch):
    fake_train(monkeypatch, lambda config: np.nan)
    with pytest.raises(ConfigError, match="No task of toy reports success"):
        tune("toy", n_trials=3, n_seeds=1, output=tmp_path)
    assert [trial.state for trial in load_study("toy-n_reset", output=tmp_path).trials] == [TrialState.FAIL]


def test_only_studies_that_maximise_are_run(tmp_path):
    with pytest.raises(ConfigError, match='direction="maximize"'):
        optuna.create_study().optimize(make_objective("toy", output=tmp_path), n_trials=1)


def test_the_same_options_again_get_the_next_seeds_and_are_pooled(tmp_path, monkeypatch):
    trained = fake_train(monkeypatch, by_resets)
    space = {"ars.n_reset": {"type": "categorical", "choices": [4, 5]}}
    study = tune("toy", space, n_trials=6, n_seeds=2, output=tmp_path, name="s", pruner="none")
    for n_reset in (4, 5):
        seeds = [config.seed for config in trained if config.ars.n_reset == n_reset]
        assert seeds == list(range(len(seeds))) and len(seeds) >= 2
    best, other = summarise(study).tried
    assert best.params == {"ars.n_reset": 4} and len(best.values) + len(other.values) == 12
    assert best.mean == pytest.approx(0.905) and other.mean == pytest.approx(0.805)


def test_alone_a_study_is_reproducible_also_when_it_was_stopped_between(tmp_path, monkeypatch):
    fake_train(monkeypatch, by_resets)
    whole = tune("toy", n_trials=9, n_seeds=1, output=tmp_path / "a")
    tune("toy", n_trials=4, n_seeds=1, output=tmp_path / "b")
    parts = tune("toy", n_trials=9, n_seeds=1, output=tmp_path / "b")
    other = tune("toy", n_trials=9, n_seeds=1, output=tmp_path / "c", seed=1)
    params = [[trial.params["ars.n_reset"] for trial in study.trials] for study in (whole, parts, other)]
    assert params[0] == params[1] != params[2] and len(params[0]) == 9


def test_going_on_with_another_study_is_refused_with_what_differs(tmp_path, monkeypatch):
    fake_train(monkeypatch, by_resets)
    tune("toy", n_trials=1, n_seeds=1, output=tmp_path, name="s")
    for changes, message in (
        ({"preset": "mt10-ars"}, "preset was 'toy', is 'mt10-ars'"),
        ({"scale": "toy"}, "scale was 'full', is 'toy'"),
        (
            {"space": {"ars.n_reset": {"type": "int", "low": 0, "high": 5}}},
            "space.ars.n_reset.high was 9, is 5",
        ),
        ({"n_seeds": 2}, "seeds was 1, is 2"),
        ({"pruner": "none"}, "pruner was 'median', is 'none'"),
    ):
        arguments = {"preset": "toy", "n_trials": 2, "n_seeds": 1, "output": tmp_path, "name": "s", **changes}
        with pytest.raises(ConfigError, match=message):
            tune(**arguments)


def test_runs_of_a_study_that_the_storage_does_not_know_are_not_mixed_with(tmp_path, monkeypatch):
    fake_train(monkeypatch, by_resets)
    tune("toy", n_trials=1, n_seeds=1, output=tmp_path, name="s")
    with pytest.raises(ConfigError, match="trial0 for one"):
        tune("toy", n_trials=1, n_seeds=1, output=tmp_path, name="s", storage=tmp_path / "other.log")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_trials": 0}, r"n_trials \(--n-trials\)=0"),
        ({"n_seeds": 0}, r"n_seeds \(--seeds\)=0"),
        ({"n_evaluations": -1}, r"n_evaluations \(--evaluations\)=-1"),
        ({"n_evaluations": 60_000}, r"\(--evaluations\)=60000 must be fewer than the run's 48000 steps"),
        ({"timeout": -1.0}, r"timeout \(--timeout\) is -1 s"),
        ({"seed": -1}, r"seed \(--sampler-seed\)=-1"),
        ({"pruner": "medain"}, "Did you mean 'median'"),
        ({"pruner": "wilcoxon", "n_seeds": 1}, "can never prune"),
        ({"preset": "toi"}, "Did you mean 'toy'"),
        ({"scale": "toyy"}, "Did you mean 'toy'"),
        (
            {"storage": "postgresql+psycopg://me:hush@127.0.0.1:1/x"},
            r"me:\*\*\*@127.0.0.1:1/x cannot be reached",
        ),
        ({"storage": "nodb://x"}, "nodb"),
        ({"storage": "postgresql+nodriver://me:hush@h/x"}, "cannot|driver"),
        ({"storage": "/proc/nowhere/journal.log"}, "cannot be written"),
    ],
)
def test_mistakes_are_refused_before_training(options, message, tmp_path):
    started = time.monotonic()
    with pytest.raises(ConfigError, match=message) as raised:
        tune(**{"preset": "toy", "output": tmp_path, **options})
    assert "hush" not in str(raised.value) and time.monotonic() - started < 20


def test_a_missing_driver_is_named_with_its_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(ConfigError, match=r'pip install "sb3-ars\[postgres\]"'):
        tune("toy", output=tmp_path, storage="postgresql+psycopg://me:hush@127.0.0.1/x")


def test_a_database_that_never_answers_is_asked_once(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_ars.tuning.storage._CONNECT_TIMEOUT", 2)  # the least the driver takes
    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        mute.settimeout(0)
        url = f"postgresql+psycopg://me@127.0.0.1:{mute.getsockname()[1]}/x"
        with pytest.raises(ConfigError, match=r"cannot be reached.*timeout"):
            tune("toy", output=tmp_path, storage=url)
        mute.accept()[0].close()
        with pytest.raises(BlockingIOError):  # nobody else called
            mute.accept()


def test_the_command_warns_of_sqlite_in_one_line(tmp_path, monkeypatch, capsys):
    fake_train(monkeypatch, by_resets)
    where = f"sqlite:///{tmp_path}/s.db"
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        main(["tune", "toy", "--n-trials", "1", "--output", str(tmp_path), "--storage", where])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warning: {where}: SQLite is not made for several processes")


def test_sqlite_works_with_a_warning(tmp_path, monkeypatch):
    fake_train(monkeypatch, by_resets)
    with pytest.warns(UserWarning, match="not made for several processes"):
        study = tune("toy", n_trials=2, n_seeds=1, output=tmp_path, storage=f"sqlite:///{tmp_path}/s.db")
    assert len(study.trials) == 2


def test_the_timeout_starts_no_further_trial(tmp_path, monkeypatch):
    fake_train(monkeypatch, lambda config: time.sleep(0.3) or 0.5)
    study = tune("toy", n_trials=50, n_seeds=1, output=tmp_path, timeout=0.5)
    assert 1 <= len(study.trials) <= 3


# ---------------------------------------------------------------------- pruning


def test_the_median_pruner_ends_a_bad_trial_in_the_second_half_of_its_first_run(tmp_path, monkeypatch):
    trained = fake_train(monkeypatch, by_resets, curve=(0.1, 0.2, 0.3, 0.4))
    study = tune("toy", n_trials=4, n_seeds=2, output=tmp_path)
    trained.clear()
    study.enqueue_trial({"ars.n_reset": 9})  # the worst there is
    trial = tune("toy", n_trials=5, n_seeds=2, output=tmp_path).trials[4]
    assert trial.state is TrialState.PRUNED
    assert max(trial.intermediate_values) == 3  # of 4 evaluations; not before the middle
    assert [config.seed for config in trained if config.ars.n_reset == 9] == trial.user_attrs["seeds"][:1]


def test_a_drop_at_a_reset_does_not_count_against_a_trial(tmp_path, monkeypatch):
    fake_train(monkeypatch, by_resets, curve=(0.9, 0.9, 0.0, 0.0))
    study = tune("toy", n_trials=1, n_seeds=1, output=tmp_path)
    values = study.trials[0].intermediate_values
    assert values[1] == values[2] == values[3] == values[4] > 0


def test_the_wilcoxon_pruner_pairs_equal_seeds_only(tmp_path, monkeypatch):
    # runs of seeds 1 and 2 are worse than that of seed 0, by luck alone
    trained = fake_train(monkeypatch, lambda config: np.array([0.9, 0.8, 0.7, 0.6]) - 0.1 * (config.seed > 0))
    study = optuna.create_study(direction="maximize", pruner=make_pruner("wilcoxon", n_seeds=2))
    for n_reset in (4, 4, 5):
        study.enqueue_trial({"ars.n_reset": n_reset})
    study.optimize(make_objective("toy", n_seeds=2, output=tmp_path), n_trials=3, catch=(TrialFailed,))
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 3
    assert [config.seed for config in trained] == [0, 1, 2, 3, 0, 1]
    steps = [sorted(trial.intermediate_values) for trial in study.trials]
    assert steps == [list(range(8)), list(range(8, 16)), list(range(8))]  # 4 tasks a seed


def test_the_wilcoxon_pruner_ends_a_trial_after_its_first_run_by_its_tasks(tmp_path, monkeypatch):
    def success(config):
        return np.array([0.9, 0.8, 0.7, 0.6]) - 0.05 * abs(config.ars.n_reset - 4)

    trained = fake_train(monkeypatch, success)
    study = optuna.create_study(direction="maximize", pruner=make_pruner("wilcoxon", n_seeds=2))
    for n_reset in (4, 8, 4):
        study.enqueue_trial({"ars.n_reset": n_reset})
    study.optimize(make_objective("toy", n_seeds=2, output=tmp_path), n_trials=3, catch=(TrialFailed,))
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "PRUNED", "COMPLETE"]
    # instances of the first run, a task each
    assert study.trials[1].intermediate_values == pytest.approx(dict(enumerate([0.7, 0.6, 0.5, 0.4])))
    assert sorted(study.trials[0].intermediate_values) == list(range(8))
    assert [config.ars.n_reset for config in trained] == [4, 4, 8, 4, 4]


# ---------------------------------------------------------------------- several processes, and their deaths


WORKER = """
import sys, time
from pathlib import Path
import numpy as np, pandas as pd
from sb3_ars.experiments.runner import RunResult
from sb3_ars.tuning import objective, tune

folder, storage, n_trials, seconds = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), float(sys.argv[4])

def train(config, name, progress_bar, folder, after_evaluation):
    folder.mkdir(parents=True)
    (folder.parent / "started").touch()
    try:
        time.sleep(seconds)
    except KeyboardInterrupt:
        (folder / "result.json").write_text('{"interrupted": true}')
    values = [0.9 - 0.1 * abs(config.ars.n_reset - 4)] * 2
    return RunResult(folder, pd.DataFrame({"success": values}, index=["a", "b"]), "", 0.0)

objective.train = train
tune("toy", n_trials=n_trials, n_seeds=1, output=folder, name="s", pruner="none",
     storage=None if storage == "-" else storage)
"""


def worker(folder, n_trials, seconds, storage="-"):
    """Start a process that takes part in a study whose runs only sleep."""
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", WORKER, str(folder), storage, str(n_trials), str(seconds)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def ended_well(*processes):
    for process in processes:
        _, errors = process.communicate(timeout=90)
        assert process.returncode == 0, errors


def test_two_processes_share_a_study_and_one_more_finds_it_done(tmp_path):
    ended_well(*[worker(tmp_path, 7, 0.05) for _ in range(2)])
    trials = load_study("s", output=tmp_path).trials
    assert sum(trial.state is TrialState.COMPLETE for trial in trials) == 7
    assert {trial.state for trial in trials} <= {TrialState.COMPLETE, TrialState.FAIL}
    for trial in trials:  # a place that was taken already was given back before anything was trained
        if trial.state is TrialState.FAIL:
            assert trial.user_attrs["failed_by"] == "surplus" and "seeds" not in trial.user_attrs
    assert len({trial.user_attrs["owner"]["pid"] for trial in trials}) == 2
    ended_well(worker(tmp_path, 7, 0.05))
    assert len(load_study("s", output=tmp_path).trials) == len(trials)


def test_a_killed_processs_trial_is_marked_failed_and_tried_once_more(tmp_path, monkeypatch):
    killed = worker(tmp_path, 3, 600)
    wait_for((tmp_path / "s" / "trial0" / "started").exists)
    killed.send_signal(signal.SIGKILL)
    # not waited for by its parent: a zombie is dead too
    wait_for(lambda: psutil.Process(killed.pid).status() == psutil.STATUS_ZOMBIE)
    fake_train(monkeypatch, by_resets)
    study = tune("toy", n_trials=3, n_seeds=1, output=tmp_path, name="s", pruner="none")
    killed.communicate()
    assert [trial.state.name for trial in study.trials] == ["FAIL", "COMPLETE", "COMPLETE", "COMPLETE"]
    dead, again = study.trials[:2]
    assert again.params == dead.params and again.user_attrs["retry_of"] == 0
    assert again.user_attrs["seeds"] == dead.user_attrs["seeds"]
    assert liveness.why_failed(dead).startswith(f"its process {killed.pid} on ")
    assert summarise(study).states["interrupted or killed, and tried again"] == 1


def test_what_kills_its_process_twice_is_not_tried_a_third_time(tmp_path, monkeypatch):
    for number in range(2):
        process = worker(tmp_path, 3, 600)
        wait_for((tmp_path / "s" / f"trial{number}" / "started").exists)
        process.kill()
        process.communicate()
    fake_train(monkeypatch, by_resets)
    study = tune("toy", n_trials=3, n_seeds=1, output=tmp_path, name="s", pruner="none")
    assert [trial.state.name for trial in study.trials] == ["FAIL", "FAIL", "COMPLETE", "COMPLETE"]
    assert study.trials[0].params == study.trials[1].params


def test_ctrl_c_ends_the_trial_which_is_tried_again(tmp_path, monkeypatch):
    process = worker(tmp_path, 2, 600)
    wait_for((tmp_path / "s" / "trial0" / "started").exists)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode != 0 and "KeyboardInterrupt" in errors
    (interrupted,) = [t for t in load_study("s", output=tmp_path).trials if t.state is TrialState.FAIL]
    assert interrupted.user_attrs["failure"] == "interrupted by the user"
    assert find_runs(tmp_path) == [] and (tmp_path / "s/trial0/seed0/interrupted.json").is_file()
    fake_train(monkeypatch, by_resets)
    study = tune("toy", n_trials=2, n_seeds=1, output=tmp_path, name="s", pruner="none")
    assert [trial.state.name for trial in study.trials] == ["FAIL", "COMPLETE", "COMPLETE"]
    assert study.trials[1].params == study.trials[0].params


def test_trials_of_other_machines_are_dead_without_a_heartbeat_only():
    study = optuna.create_study()
    trial = study.ask()
    trial.set_user_attr("owner", {"host": "elsewhere", "pid": os.getpid(), "started": 0.0})
    trial.set_user_attr("heartbeat", 1000.0)
    frozen = study.trials[0]
    assert not liveness.is_dead(frozen, now=1000.0 + liveness.HEARTBEAT_LIMIT - 1)
    assert liveness.is_dead(frozen, now=1000.0 + liveness.HEARTBEAT_LIMIT + 1)


def test_a_living_process_is_not_dead_however_old_its_heartbeat():
    study = optuna.create_study()
    trial = study.ask()
    with liveness.kept_alive(trial):
        frozen = study.trials[0]
        assert not liveness.is_dead(frozen, now=time.time() + 10 * liveness.HEARTBEAT_LIMIT)
        # another process of that number: the heartbeat decides
        frozen.user_attrs["owner"]["started"] -= 1000
        assert not liveness.is_dead(frozen)
        assert liveness.is_dead(frozen, now=time.time() + 10 * liveness.HEARTBEAT_LIMIT)


def test_the_heartbeat_beats_while_a_trial_runs(monkeypatch):
    monkeypatch.setattr(liveness, "_INTERVAL", 0.01)
    study = optuna.create_study()
    trial = study.ask()
    with liveness.kept_alive(trial):
        first = study.trials[0].user_attrs["heartbeat"]
        wait_for(lambda: study.trials[0].user_attrs["heartbeat"] > first, 10)


def test_of_two_trials_that_want_the_last_place_one_gets_it():
    study = optuna.create_study()
    first, second = study.ask(), study.ask()
    for trial in (first, second):
        trial.set_user_attr("heartbeat", time.time())
    assert not liveness.claim(second, n_trials=1)  # sees the first, which has not decided
    study.tell(second, state=TrialState.FAIL)
    assert liveness.claim(first, n_trials=1)
    third = study.ask()
    assert not liveness.claim(third, n_trials=1) and liveness.claim(third, n_trials=2)


# ---------------------------------------------------------------------- what is found


def added(values_of, **more):
    study = optuna.create_study(direction="maximize", study_name="s")
    distributions = {"ars.n_reset": optuna.distributions.IntDistribution(0, 9)}
    for n_reset, values in values_of:
        study.add_trial(
            optuna.trial.create_trial(
                params={"ars.n_reset": n_reset},
                distributions=distributions,
                value=float(np.mean(values)),
                user_attrs={"values": values, "config": {"evaluation": {}}, **more},
            )
        )
    return study


def test_the_summary_compares_with_the_seeds_spread():
    # by hand: variances (n - 1) 0.02, 0.02, 0.02, so the spread is sqrt(0.02) = 0.1414
    summary = summarise(added([(4, [0.8, 1.0]), (5, [0.7, 0.9]), (0, [0.1, 0.3])]))
    assert summary.spread == pytest.approx(np.sqrt(0.02))
    assert [tried.params["ars.n_reset"] for tried in summary.tried] == [4, 5, 0]
    assert "n_reset=4 (0.900), beats the worst, n_reset=0 (0.200), by more than that" in summary.verdict
    assert "does not beat the second, n_reset=5 (0.800)" in summary.verdict
    assert "varies by 0.141" in summary.verdict


def test_the_summary_does_not_claim_what_it_cannot_know():
    assert "nobody can say" in summarise(added([(4, [0.9]), (5, [0.1])])).verdict
    assert "nothing to compare" in summarise(added([(4, [0.9, 0.8])])).verdict
    assert "no best one" in summarise(added([])).verdict
    equal = summarise(added([(4, [0.9, 0.9]), (5, [0.9, 0.9])])).verdict
    assert "does not beat the other" in equal and "difference is 0.000" in equal


def test_figures_that_need_more_are_left_out_with_a_sentence(tmp_path):
    files, left_out = write_results(added([(4, [0.9, 0.8])]), tmp_path)
    assert [file.name for file in files] == ["trials.csv", "best.yaml"]
    assert "The figure history is left out: it needs two complete trials." in left_out and len(left_out) == 4
    files, left_out = write_results(added([(4, [0.9, 0.8]), (5, [0.1, 0.2])]), tmp_path)
    assert {file.name for file in files} > {"history.png", "history.svg", "slice.png"}
    assert left_out == [
        "The figure importance is left out: it needs two options.",
        "The figure parallel is left out: it needs two options.",
    ]
    names = {"trials.csv", "best.yaml", "history.png", "history.svg", "slice.png", "slice.svg"}
    assert {file.name for file in tmp_path.iterdir()} == names


def test_two_processes_that_end_a_study_at_once_write_whole_files(tmp_path, monkeypatch):
    study = added([(4, [0.9, 0.8]), (5, [0.1, 0.2])], seeds=[0, 1])
    replace, is_the_other = Path.replace, False

    def replace_after_the_other(path, target):
        nonlocal is_the_other
        if not is_the_other:
            is_the_other = True
            with monkeypatch.context() as of_the_other:  # it comes in between, and ends first
                of_the_other.setattr(os, "getpid", lambda: -1)
                write_results(study, tmp_path)
            is_the_other = False
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", replace_after_the_other)
    files, _ = write_results(study, tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {file.name for file in files}
    assert load_yaml(tmp_path / "best.yaml")["seed"] == 2 and len(pd.read_csv(tmp_path / "trials.csv")) == 2


def test_the_command_tunes_tells_and_hands_over_the_best(tmp_path, monkeypatch, capsys):
    fake_train(
        monkeypatch, lambda config: by_resets(config) - 100 * abs(config.algorithm.learning_rate - 1e-3)
    )
    monkeypatch.setenv("COLUMNS", "150")
    arguments = ["tune", "toy", "--space", "learning", "--scale", "toy", "--seeds", "2", "--n-trials", "6"]
    assert main([*arguments, "--output", str(tmp_path), "--pruner", "none"]) == 0
    out = capsys.readouterr().out
    assert "toy-learning-toy: 6 complete" in out and "Mean success varies by" in out
    folder = tmp_path / "toy-learning-toy"
    for figure in ("history", "slice", "importance", "parallel"):
        assert (folder / f"{figure}.png").stat().st_size > 5000 and (folder / f"{figure}.svg").is_file()
    table = pd.read_csv(folder / "trials.csv")
    assert len(table) == 6 and {"ars.n_reset", "seed 0", "success/point-west"} <= set(table.columns)
    best = load_config(folder / "best.yaml")
    study = load_study("toy-learning-toy", output=tmp_path)
    assert best.ars.n_reset == study.best_params["ars.n_reset"] and best.ars.param_resets is None
    seeds = [seed for trial in study.trials for seed in trial.user_attrs["seeds"]]
    assert best.scale == "toy" and best.seed == max(seeds) + 1 and best.seed not in seeds
    assert f"a seed that no trial used, {best.seed} " in out
    # and the very same command again finds nothing to do
    assert main([*arguments, "--output", str(tmp_path), "--pruner", "none"]) == 0
    assert "6 complete" in capsys.readouterr().out


def test_the_command_that_trains_the_best_works(tmp_path, monkeypatch):
    from sb3_ars.experiments.config import save_config

    config = tiny_toy(total_timesteps=400)
    config = dataclasses.replace(config, ars=dataclasses.replace(config.ars, param_resets=None, n_reset=1))
    save_config(config, tmp_path / "best.yaml")
    monkeypatch.chdir(tmp_path)
    assert main(["train", "best.yaml"]) == 0
    assert (tmp_path / "runs" / "best-seed0" / RESULT).is_file()


def test_the_command_fails_where_no_trial_came_to_its_end(tmp_path, monkeypatch, capsys):
    fake_train(monkeypatch, by_resets, error=ConfigError("nothing works"))
    assert main(["tune", "toy", "--n-trials", "1", "--output", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert "Trial 0 failed: ConfigError: nothing works" in out and "no best one" in out


def test_the_command_has_readable_help(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    with pytest.raises(SystemExit) as raised:
        main(["tune", "--help"])
    out = capsys.readouterr().out
    assert raised.value.code == 0
    for option in ("--space", "--n-trials", "--timeout", "--pruner", "--storage"):
        assert option in out
    for name in search_space_names():
        assert name in out


def test_the_command_announces_nothing_before_everything_is_checked(tmp_path, capsys):
    assert main(["tune", "nosuch", "--output", str(tmp_path)]) == 2
    assert main(["tune", "toy", "--seeds", "0", "--output", str(tmp_path)]) == 2
    read = capsys.readouterr()
    assert read.out == "" and "nosuch" in read.err


@pytest.mark.parametrize(
    "content",
    [
        b"this is no journal\nat all\n",
        b"one bad line\n",
        b"half a line",
        b"\n",
        b"\0\n",
        b"1\n",
        b"\xff\n",
        b"{}\n",
    ],
)
def test_a_journal_that_is_none_is_refused(content, tmp_path):
    path = tmp_path / "journal.log"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"no journal of Optuna's.*give another --storage"):
        open_storage(path)
    assert path.read_bytes() == content


def test_a_journal_with_a_damaged_last_line_is_refused(tmp_path, monkeypatch):
    fake_train(monkeypatch, by_resets)
    tune("toy", n_trials=1, n_seeds=1, output=tmp_path, name="s")
    path = tmp_path / "s" / "journal.log"
    open_storage(path)
    lines = path.read_bytes().count(b"\n")
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ConfigError, match=f"line {lines}"):
        tune("toy", n_trials=2, n_seeds=1, output=tmp_path, name="s")
