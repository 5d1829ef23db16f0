"""Tables and figures as data, their cells, and the local launcher."""

import errno
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import yaml

from sb3_ars.callbacks.checkpoint import RunCheckpoint
from sb3_ars.cli import main
from sb3_ars.errors import ConfigError
from sb3_ars.experiments import cells as disk
from sb3_ars.experiments import find_presets, preset_info, preset_names
from sb3_ars.experiments.cells import cell_state, claim, clean, plan, release, run_folder_of
from sb3_ars.experiments.config import load_preset
from sb3_ars.experiments.launchers import LocalLauncher
from sb3_ars.experiments.owner import this_process
from sb3_ars.experiments.run_folder import find_runs, is_finished, read_run
from sb3_ars.experiments.runner import train
from sb3_ars.experiments.sweeps import KINDS, load_sweep, sweep_names

# ---------------------------------------------------------------------- the paper's tables


def rows():
    return [(sweep.name, row) for sweep in map(load_sweep, sweep_names()) for row in sweep.rows]


def mean_of(row):
    return row.paper.get("mean", row.paper.get("bottom_k", {}).get(50))


def numbers(printed):
    mean, deviation = printed.split(" ± ")
    return float(mean), float(deviation)


def test_every_table_and_figure_is_there():
    tables = [f"table{n}" for n in (1, 2, 3, 4, 5, 6, 9, 10, 11)]
    assert sweep_names() == [*tables, *(f"fig{n}" for n in range(1, 12))]
    assert all(mean_of(row) for name, row in rows() if name.startswith("table"))
    assert not any(row.paper for name, row in rows() if name.startswith("fig"))


@pytest.mark.parametrize(("name", "row"), rows())
def test_a_rows_numbers_are_the_presets(name, row):
    if row.paper and preset_info(row.preset).success is not None:
        assert mean_of(row) == preset_info(row.preset).success, row.preset
    for printed in [mean_of(row), *row.paper.get("tasks", []), *row.paper.get("bottom_k", {}).values()]:
        if printed is not None:
            assert 0 <= numbers(printed)[0] <= 100 and 0 <= numbers(printed)[1] < 50


@pytest.mark.parametrize("row", load_sweep("table1").rows, ids=lambda row: row.preset)
def test_table_1s_means_are_their_tasks(row):
    values = [numbers(printed)[0] for printed in row.paper["tasks"]]
    assert sum(values) / len(values) == pytest.approx(numbers(row.paper["mean"])[0], abs=0.1)  # no exception
    assert len(values) == 10


@pytest.mark.parametrize("row", load_sweep("table2").rows, ids=lambda row: row.preset)
def test_table_2s_worst_tasks_are_worse_than_more_of_them(row):
    values = [numbers(row.paper["bottom_k"][k])[0] for k in load_sweep("table2").options["ks"]]
    assert values == sorted(values) and len(values) == 5


@pytest.mark.parametrize("name", ["table4", "table5"])
def test_the_task_sets_means_make_the_whole(name):
    for row in load_sweep(name).rows:
        easy, difficult = numbers(row.paper["easy"])[0], numbers(row.paper["difficult"])[0]
        assert 0.7 * easy + 0.3 * difficult == pytest.approx(numbers(row.paper["mean"])[0], abs=0.25)


def test_figure_11_shows_single_tasks():
    assert load_sweep("fig11").kind == "task_bars"


def test_every_preset_that_the_paper_reports_is_in_the_table_it_names():
    for name in preset_names():
        table = preset_info(name).table
        if table is None:
            continue
        sweep = load_sweep(table.lower().replace("fig. ", "fig") if "Fig" in table else f"table{table}")
        # mt10-ablation-n-reset-4 is mt10-ars, which other tables train already
        assert any(load_preset(preset) == load_preset(name) for preset in sweep.presets), name


def test_no_two_rows_of_a_sweep_look_the_same():
    for sweep in map(load_sweep, sweep_names()):
        headings = [(row.label, row.column) for row in sweep.rows]
        assert len(set(headings)) == len(headings) and len(sweep.presets) == len(headings), sweep.name


def with_paper(**printed):
    return {"preset": "mt10-ars", "label": "ARS", "paper": printed}


GOOD = {"title": "t", "source": "s", "kind": "mean", "rows": [{"preset": "mt10-ars", "label": "ARS"}]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "means"}, "kind='means' is unknown; choose one of per_task, .*Did you mean 'mean'"),
        ({"kind": None}, "mine.yaml lacks kind; add it"),
        ({"tittle": 1}, "'tittle' is no key here.*Did you mean 'title'"),
        ({"options": {"ks": [1]}}, "options: 'ks' is no key here; there are note"),
        ({"rows": []}, r"rows=\[\] must be a list of rows"),
        ({"rows": [{"label": "ARS"}]}, "row 1 lacks preset"),
        ({"rows": [{"preset": "mt10-asr", "label": "a"}]}, "row 1: there is no preset 'mt10-asr'.*'mt10-ars'"),
        ({"rows": [{"preset": "mt10-ars", "label": "a", "paper": {"men": 1}}]}, "row 1: paper: 'men' is no key"),
        ({"rows": ["mt10-ars"]}, "row 1 must be a mapping with the keys preset, label, column, paper"),
        ({"rows": [{"preset": "mt10-ars", "label": None}]}, "row 1: label=None must be text"),
        ({"rows": [with_paper(tasks="1 ± 2")]}, "row 1: paper: tasks='1 ± 2' must be a list"),
        ({"rows": [with_paper(bottom_k=[1])]}, r"row 1: paper: bottom_k=\[1\] must be a mapping"),
        ({"rows": [with_paper(mean=[1])]}, r"row 1: paper: mean=\[1\] must be text"),
        ({"options": 3}, "mine.yaml: options must be a mapping"),
        ({"kind": "bottom_k", "options": {"ks": "foo"}}, "option ks='foo' must be a list of integers"),
        ({"kind": "bottom_k", "options": {"ks": [0]}}, r"option ks=\[0\] must be a list of integers of at least 1"),
        ({"kind": "estr", "options": {"thresholds": [5]}}, r"option thresholds=\[5\] must be a list of shares"),
        ({"kind": "task_sets", "options": {"n_easy": "many"}}, "option n_easy='many' must be an integer"),
        ({"kind": "q_values", "options": {"tasks": "push-v3"}}, "option tasks='push-v3' must be a list of tasks"),
        ({"kind": "curves", "options": {"each_seed": 1}}, "option each_seed=1 must be true or false"),
        ({"options": {"note": 1}}, "option note=1 must be a sentence"),
    ],
)  # fmt: skip
def test_a_sweep_that_cannot_work_is_refused_by_name(changes, message, tmp_path):
    values = {key: value for key, value in {**GOOD, **changes}.items() if value is not None}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match=message):
        load_sweep(str(tmp_path / "mine.yaml"))


def test_a_sweep_of_ones_own_is_a_file_and_a_wrong_name_is_refused(tmp_path):
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(GOOD))
    assert load_sweep(str(tmp_path / "mine.yaml")).presets == ("mt10-ars",)
    numbers = {
        "title": 5,
        "source": 7,
        "rows": [{**with_paper(mean=5, bottom_k={10: 1}), "label": 3, "column": 1}],
    }
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({**GOOD, **numbers}))
    sweep = load_sweep(str(tmp_path / "mine.yaml"))
    (row,) = sweep.rows
    assert (sweep.title, sweep.source, row.label, row.column) == ("5", "7", "3", "1")
    assert row.paper == {"mean": "5", "bottom_k": {10: "1"}}
    with pytest.raises(ConfigError, match=r"no table or figure 'tabel1'.*Did you mean 'table1'"):
        load_sweep("tabel1")


# ---------------------------------------------------------------------- cells

TINY = {
    "description": "a few hundred steps",
    "tasks": "toy",
    "stands_for": {"push-v3": "point-west", "pick-place-v3": "point-south", "peg-insert-side-v3": "point-south"},
    "steps_per_task": 100,
    "random_steps": 10,
    "resets_at": [0.5],
    "updates_after_reset": 2,
    "evaluations": 2,
    "log_episodes": 1,
    "at_most": {"hidden_width": 8, "hidden_layers": 1, "max_episode_steps": 20},
    "options": {
        "env": {"n_workers": 0},
        "algorithm": {"batch_size": 8, "buffer_size": 200, "execution": "eager"},
        "evaluation": {"n_episodes": 1},
    },
}  # fmt: skip


@pytest.fixture
def tiny(tmp_path):
    return scale_file(tmp_path)


def scale_file(tmp_path, **changes):
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump({**TINY, **changes}))
    return str(path)


def cells_of(tiny, *tables, seeds=1, only=()):
    return plan([load_sweep(name) for name in tables], [tiny], seeds, only)


def test_a_cell_that_two_tables_share_is_trained_once(tiny):
    both = [cell.name for cell in cells_of(tiny, "table4", "table5", seeds=2)]
    assert len(both) == len(set(both)) == 2 * 5 and both.count("tiny/mt10-ars/seed1") == 1
    assert [name[-1] for name in both] == ["0"] * 5 + ["1"] * 5  # all methods before the second seed
    kept = cells_of(tiny, "table4", "table5", only=["mt10-ars"])
    assert [cell.name for cell in kept] == ["tiny/mt10-ars/seed0"] and kept[0].config.scale == "tiny"


def test_what_cannot_be_planned_is_refused_by_name(tiny):
    with pytest.raises(ConfigError, match="--seeds=0 must be an integer of at least 1"):
        cells_of(tiny, "table4", seeds=0)
    with pytest.raises(
        ConfigError, match=r"'mt10-asr' is in none of table4; they have .*Did you mean 'mt10-ars'"
    ):
        cells_of(tiny, "table4", only=["mt10-asr"])
    with pytest.raises(ConfigError, match="tiny, tiny are not all different"):
        plan([load_sweep("table4")], [tiny, tiny], 1)


FAKE = """
import json, os, pathlib, signal, sys, time
spec = json.loads(pathlib.Path(sys.argv[1]).read_text())
folder = pathlib.Path(sys.argv[1]).parent
with open(os.environ["STARTED"], "a") as file:
    print(spec["name"], os.getpid(), os.environ["OMP_NUM_THREADS"], os.environ.get("CUDA_VISIBLE_DEVICES"), file=file)
print("said something")
act = os.environ.get("ACT_" + spec["preset"].replace("-", "_"))
if act == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
if act == "raises":
    raise ValueError("no such luck")
if act == "sleeps":
    time.sleep(60)
run = folder / "run"
run.mkdir()
(run / "config.yaml").write_text(json.dumps(spec["config"]))
(run / "versions.json").write_text("{}")
result = {"format": 1, "name": spec["preset"], "mean_success": 1.0, "tasks": {}, "reward_scale_history": [],
          "timesteps": 1, "training_seconds": 1.0, "interrupted": act == "interrupted"}
(run / "result.json").write_text(json.dumps(result))
if act == "dies after":
    os.kill(os.getpid(), signal.SIGSEGV)
if act == "sleeps after":
    time.sleep(60)
"""  # as a cell's process, but trains nothing


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """Cells whose processes train nothing and do as told; returns what was started: (name, pid, threads, GPUs)."""
    (tmp_path / "fake.py").write_text(FAKE)
    monkeypatch.setenv("STARTED", str(tmp_path / "started"))
    monkeypatch.setattr(
        disk,
        "command",
        lambda working: [sys.executable, str(tmp_path / "fake.py"), str(working / "spec.json")],
    )

    def started():
        path = tmp_path / "started"
        return [tuple(line.split()) for line in path.read_text().splitlines()] if path.exists() else []

    return started


class Silent:
    def ready(self):
        pass

    def started(self, cell):
        pass

    def progressed(self, cell, steps):
        pass

    def ended(self, outcome):
        pass


def launch(cells, output, monitor=None, processes=2):
    outcomes = LocalLauncher(processes).run(cells, output, monitor or Silent())
    return {outcome.cell.name.split("/", 1)[1]: outcome for outcome in outcomes}


def test_a_killed_or_failed_cell_is_reported_and_the_others_go_on(tiny, fake, tmp_path, monkeypatch):
    monkeypatch.setenv("ACT_mt10_ars", "killed")
    monkeypatch.setenv("ACT_mt10_ablation_no_reset", "raises")
    output, cells = tmp_path / "out", cells_of(tiny, "table4")
    outcomes = launch(cells, output)
    assert {name: outcome.status for name, outcome in outcomes.items()} == {
        "mt10-ars/seed0": "failed",
        "mt10-ablation-no-reset/seed0": "failed",
        "mt10-ablation-no-scaling/seed0": "finished",
    }
    killed, raised = outcomes["mt10-ars/seed0"], outcomes["mt10-ablation-no-reset/seed0"]
    assert killed.error.startswith("the process was killed by SIGKILL; out of memory?")
    assert raised.error.endswith("the last line of its log: ValueError: no such luck")
    folder = output / "tiny" / "mt10-ablation-no-reset" / "seed0.failed"
    assert "no such luck" in (folder / "log.txt").read_text() and (folder / "error.txt").is_file()
    assert [path.parent.name for path in find_runs(output)] == ["mt10-ablation-no-scaling"]
    assert not list(output.rglob("*.running"))


def test_only_what_is_not_finished_is_trained_again(tiny, fake, tmp_path, monkeypatch):
    monkeypatch.setenv("ACT_mt10_ars", "killed")
    output, cells = tmp_path / "out", cells_of(tiny, "table4")
    launch(cells, output)
    assert [cell_state(cell, output) for cell in cells] == ["finished", "finished", "failed"]
    result = cells[0].folder(output) / "result.json"
    before = result.stat().st_mtime_ns
    monkeypatch.delenv("ACT_mt10_ars")
    outcomes = launch([cell for cell in cells if cell_state(cell, output) != "finished"], output)
    assert [outcome.status for outcome in outcomes.values()] == ["finished"]
    names = [name for name, *_ in fake()]
    assert len(names) == 4 and names.count(cells[0].name) == 1 and names.count("tiny/mt10-ars/seed0") == 2
    assert result.stat().st_mtime_ns == before
    assert all(cell_state(cell, output) == "finished" for cell in cells) and len(find_runs(output)) == 3
    assert not list(output.rglob("*.failed")) and (cells[2].folder(output) / "log.txt").is_file()
    # one that is finished is not claimed either
    assert claim(cells[0], output) is None


def test_a_run_that_was_ended_early_is_not_finished(tiny, fake, tmp_path, monkeypatch):
    monkeypatch.setenv("ACT_mt10_ars", "interrupted")
    (cell,) = cells_of(tiny, "table4", only=["mt10-ars"])
    assert launch([cell], tmp_path)["mt10-ars/seed0"].status == "failed"
    assert cell_state(cell, tmp_path) == "failed" and find_runs(tmp_path) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_sweep_ends_its_processes_and_keeps_what_is_finished(
    number, tiny, fake, tmp_path, monkeypatch
):
    monkeypatch.setenv("ACT_mt10_ars", "sleeps")
    output, cells = tmp_path / "out", cells_of(tiny, "table4")

    def interrupt():
        while len(fake()) < 3 or sum(is_finished(cell.folder(output)) for cell in cells) < 2:
            time.sleep(0.05)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=interrupt)
    thread.start()
    handler = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt):
        launch(cells, output)
    thread.join()
    assert signal.getsignal(number) == handler
    assert not any(psutil.pid_exists(int(pid)) for _, pid, *_ in fake())
    assert [cell_state(cell, output) for cell in cells] == ["finished", "finished", "missing"]
    assert not list(output.rglob("*.running"))


def test_cores_and_gpus_are_shared_out(tiny, fake, tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    for preset in find_presets(["mt10-ablation"]):
        monkeypatch.setenv(f"ACT_{preset.replace('-', '_')}", "")
    LocalLauncher(processes=4, cpus_per_cell=3).run(cells_of(tiny, "table4", seeds=2), tmp_path, Silent())
    assert {threads for _, _, threads, _ in fake()} == {"3"}
    assert sorted({gpus for *_, gpus in fake()[:4]}) == ["3", "5"]
    for options in ({"processes": 0}, {"cpus_per_cell": 0}):
        with pytest.raises(ConfigError, match="=0 must be an integer of at least 1"):
            LocalLauncher(**options)


def ended_process():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_run_that_is_whole_is_kept_however_its_process_or_the_sweep_ends(tiny, fake, tmp_path, monkeypatch):
    monkeypatch.setenv("ACT_mt10_ars", "dies after")
    (cell,) = cells_of(tiny, "table4", only=["mt10-ars"])
    assert launch([cell], tmp_path)["mt10-ars/seed0"].status == "finished"
    assert cell_state(cell, tmp_path) == "finished"
    monkeypatch.setenv("ACT_mt10_ars", "sleeps after")

    class Interrupting(Silent):
        def progressed(self, cell, steps):
            if list((tmp_path / "other").rglob("result.json")):
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        launch([cell], tmp_path / "other", Interrupting())
    assert cell_state(cell, tmp_path / "other") == "finished"
    assert not list(tmp_path.rglob("*.running"))


def test_a_cell_that_was_interrupted_goes_on_from_its_checkpoint(tiny, tmp_path, monkeypatch):
    (cell,) = cells_of(tiny, "table4", only=["mt10-ars"])
    whole = tmp_path / "whole"
    train(cell.config, cell.preset, progress_bar=False, folder=whole)
    working = claim(cell, tmp_path)
    with monkeypatch.context() as patch:

        def stop(self):
            if self.num_timesteps >= 200:
                signal.raise_signal(signal.SIGTERM)
            return True

        patch.setattr(RunCheckpoint, "_on_step", stop)
        with pytest.raises(SystemExit):
            train(cell.config, cell.preset, progress_bar=False, folder=run_folder_of(working))
    release(cell, tmp_path)
    assert cell_state(cell, tmp_path) == "missing" and working.exists()
    assert launch([cell], tmp_path)["mt10-ars/seed0"].status == "finished"
    assert "Going on at step 200" in (cell.folder(tmp_path) / "log.txt").read_text()
    results = [read_run(folder).result for folder in (whole, cell.folder(tmp_path))]
    for key in ("tasks", "timesteps", "updates", "reward_scale_history"):
        assert results[0][key] == results[1][key], key
    assert not list(tmp_path.rglob("*.running"))
    # begun with another configuration, it does not go on
    shutil.rmtree(cell.folder(tmp_path))
    working = claim(cell, tmp_path)
    shutil.copytree(whole, run_folder_of(working))
    (run_folder_of(working) / "result.json").unlink()
    (run_folder_of(working) / "checkpoints" / "step-1").mkdir(parents=True)
    config = run_folder_of(working) / "config.yaml"
    config.write_text(config.read_text().replace("gamma: 0.99", "gamma: 0.9"))
    release(cell, tmp_path)
    assert run_folder_of(working).exists()
    assert claim(cell, tmp_path) == working and not run_folder_of(working).exists()


def test_a_cell_whose_folder_cannot_be_written_fails_and_the_others_go_on(tiny, fake, tmp_path, monkeypatch):
    output, cells = tmp_path / "out", cells_of(tiny, "table4")
    (gone,) = (cell for cell in cells if cell.preset == "mt10-ars")
    monkeypatch.setenv("ACT_mt10_ars", "raises")

    class Removing(Silent):
        def started(self, cell):
            if cell == gone:
                shutil.rmtree(disk._working(cell, output))

    outcomes = launch(cells, output, Removing())
    assert outcomes["mt10-ars/seed0"].error.startswith("FileNotFoundError: ")
    assert [cell_state(cell, output) for cell in cells if cell != gone] == ["finished", "finished"]

    write = disk.write_json

    def full(path, value):
        write(path, value)
        if value.get("preset") == "mt10-ars":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(disk, "write_json", full)
    outcomes = launch(cells, tmp_path / "full")
    assert outcomes["mt10-ars/seed0"].error == "OSError: [Errno 28] No space left on device"
    assert sorted(outcome.status for outcome in outcomes.values()) == ["failed", "finished", "finished"]
    assert not list((tmp_path / "full").rglob("*.running"))


CLAIM = """
import os, sys, time
from pathlib import Path
from sb3_ars.experiments import cells
from sb3_ars.experiments.sweeps import load_sweep
(cell,) = cells.plan([load_sweep("table4")], [sys.argv[1]], 1, ["mt10-ars"])
for turn in range(int(sys.argv[3])):
    print("ready", flush=True)
    sys.stdin.readline()
    try:
        print(cells.claim(cell, Path(sys.argv[2]) / str(turn)) is not None, flush=True)
    except Exception as error:
        print(type(error).__name__, flush=True)
sys.stdin.readline()
"""


def test_of_two_sweeps_that_start_at_once_over_leftovers_one_gets_the_cell(tiny, tmp_path):
    (cell,) = cells_of(tiny, "table4", only=["mt10-ars"])
    turns, dead = 20, json.dumps({**this_process(), "pid": ended_process()})
    for turn in range(turns):
        working = disk._working(cell, tmp_path / str(turn))
        (working / "run").mkdir(parents=True)
        (working / "owner.json").write_text(dead)
        for number in range(200):  # takes a while to remove
            (working / "run" / str(number)).touch()
    command = [sys.executable, "-c", CLAIM, tiny, str(tmp_path), str(turns)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as one, subprocess.Popen(command, **pipes) as other:
        for _ in range(turns):
            for process in (one, other):
                assert process.stdout.readline() == "ready\n"
            for process in (one, other):
                process.stdin.write("go\n")
                process.stdin.flush()
            said = sorted(process.stdout.readline().strip() for process in (one, other))
            assert said == ["False", "True"]
        for turn in range(turns):  # of the one that got it nothing was removed
            working = disk._working(cell, tmp_path / str(turn))
            assert sorted(path.name for path in working.iterdir()) == ["owner.json", "spec.json"]
        for process in (one, other):
            process.stdin.close()


def test_a_workers_number_that_is_left_open_is_the_cells_share_of_the_cores(tmp_path):
    (cell,) = plan([load_sweep("table4")], ["full"], 1, ["mt10-ars"])
    assert cell.config.env.n_workers == "auto"
    workers = []
    for cpus in (1, 3, 64):
        spec = json.loads((claim(cell, tmp_path / str(cpus), cpus) / "spec.json").read_text())
        workers.append(spec["config"]["env"]["n_workers"])
    assert workers == [0, 3, 10]  # none beside the cell's own process, and no more than tasks


def test_what_a_killed_sweep_left_is_cleared_away_but_not_what_is_in_work(tiny, fake, tmp_path):
    (cell,) = cells_of(tiny, "table4", only=["mt10-ars"])
    working = claim(cell, tmp_path)
    assert cell_state(cell, tmp_path) == "running" and claim(cell, tmp_path) is None
    assert launch([cell], tmp_path)["mt10-ars/seed0"].status == "elsewhere" and fake() == []
    owner = json.loads((working / "owner.json").read_text())
    (working / "owner.json").write_text(json.dumps({**owner, "host": "another"}))
    assert cell_state(cell, tmp_path) == "running"  # nobody here can know
    # the clock was set since
    (working / "owner.json").write_text(json.dumps({**owner, "started": owner["started"] - 3}))
    assert cell_state(cell, tmp_path) == "running"
    # the pid lives, but in another container of this machine
    (working / "owner.json").write_text(json.dumps({**owner, "host": f"{platform.node()} pid:[1]"}))
    assert cell_state(cell, tmp_path) == "running"
    # the pid lives, but it is another process's
    (working / "owner.json").write_text(json.dumps({**owner, "started": owner["started"] - 100}))
    assert cell_state(cell, tmp_path) == "missing"
    (working / "owner.json").write_text(json.dumps({**owner, "pid": ended_process()}))
    assert cell_state(cell, tmp_path) == "missing"
    clean(cell, tmp_path)
    assert not working.exists()
    # one killed while it wrote its name, or its result
    for name in ("owner.json", "run/result.json"):
        (working / "run").mkdir(parents=True)
        (working / name).write_text("{")
        assert cell_state(cell, tmp_path) == "missing"
        clean(cell, tmp_path)
        assert not working.exists()
    assert launch([cell], tmp_path)["mt10-ars/seed0"].status == "finished"


def test_a_run_that_was_whole_when_its_sweep_was_killed_is_kept(tiny, fake, tmp_path):
    (cell,) = cells_of(tiny, "table4", only=["mt10-ars"])
    working = claim(cell, tmp_path)
    subprocess.run(disk.command(working), env={**os.environ, "OMP_NUM_THREADS": "1"}, check=True)
    owner = json.loads((working / "owner.json").read_text())
    (working / "owner.json").write_text(json.dumps({**owner, "pid": ended_process()}))
    clean(cell, tmp_path)
    assert cell_state(cell, tmp_path) == "finished" and not working.exists()


def test_a_finished_cell_of_another_configuration_is_refused(tiny, fake, tmp_path):
    (cell,) = cells_of(tiny, "table4", only=["mt10-ars"])
    launch([cell], tmp_path)
    (changed,) = cells_of(scale_file(tmp_path, steps_per_task=200), "table4", only=["mt10-ars"])
    message = (
        "seed0 holds a run with algorithm.total_timesteps=400, but tiny/mt10-ars/seed0 is now to have 800 "
        r"\(differing options in all: 2\); delete the folder"
    )
    with pytest.raises(ConfigError, match=message):
        cell_state(changed, tmp_path)
    changed.folder(tmp_path / "other").mkdir(parents=True)
    with pytest.raises(ConfigError, match="exists but holds no finished run"):
        cell_state(changed, tmp_path / "other")
    # what changes nothing that is learned does not matter
    (looked_at,) = cells_of(scale_file(tmp_path, evaluations=4, log_episodes=3), "table4", only=["mt10-ars"])
    assert cell_state(looked_at, tmp_path) == "finished"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"interrupted": True}, "seed0 exists but holds no finished run, or one that was ended early"),
        ({"name": "mine"}, "holds a run of tiny/mine/seed0, not of tiny/mt10-ars/seed0; delete the folder"),
    ],
)
def test_a_finished_folder_that_is_no_run_of_the_cell_is_refused(changes, message, tiny, fake, tmp_path):
    (cell,) = cells_of(tiny, "table4", only=["mt10-ars"])
    launch([cell], tmp_path)
    result = cell.folder(tmp_path) / "result.json"
    result.write_text(json.dumps({**json.loads(result.read_text()), **changes}))
    with pytest.raises(ConfigError, match=message):
        cell_state(cell, tmp_path)


def test_a_file_in_the_place_of_a_cells_folder_is_refused(tiny, tmp_path):
    (cell,) = cells_of(tiny, "table4", only=["mt10-ars"])
    cell.folder(tmp_path).parent.mkdir(parents=True)
    disk._working(cell, tmp_path).write_text("")
    with pytest.raises(ConfigError, match=r"seed0.running is no folder, .*; move it away"):
        cell_state(cell, tmp_path)


def test_a_cells_process_ends_with_the_one_that_started_it(tiny, tmp_path):
    (cell,) = cells_of(scale_file(tmp_path, steps_per_task=10**6), "table4", only=["mt10-ars"])
    working = claim(cell, tmp_path)
    # a process that starts the cell's and is killed at once
    script = "import subprocess, sys, os; print(subprocess.Popen([*sys.argv[1:], str(os.getpid())]).pid, flush=True)"
    arguments = disk.command(working)[:-1]
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=True
    )
    process = psutil.Process(int(done.stdout))
    process.wait(timeout=60)
    assert not (working / "run" / "policy.zip").exists()


# ---------------------------------------------------------------------- the command


@pytest.fixture
def reported(monkeypatch):
    """What the report was asked for, in its place."""
    calls = []

    def write_report(folders, output, sweeps=(), videos=False, expected=()):
        calls.append((list(folders), output, tuple(sweeps), list(expected)))
        return output / "index.html"

    module = SimpleNamespace(write_report=write_report)
    monkeypatch.setitem(sys.modules, "sb3_ars.experiments.report", module)
    return calls


def test_the_command_trains_reports_and_names_what_failed(tiny, reported, tmp_path, capsys):
    # SMT's decisions are farther apart than this run is long, which is found when its process begins
    output = tmp_path / "out"
    arguments = ["bench", "table1", "--scale", tiny, "--seeds", "1", "--only", "mt10-ars", "mt10-smt"]
    arguments += ["--output", str(output), "--processes", "2"]
    assert main(arguments) == 1
    out = capsys.readouterr().out
    assert "2 cells" in out and "2 to train: 800 environment steps" in out
    assert "tiny/mt10-ars/seed0: finished after" in out and "[2/2]" in out
    assert "2 cells: 1 finished, 1 failed" in out and "ConfigError: interval=15000 environment steps" in out
    assert f"report: {output / 'report' / 'index.html'}" in out
    folder = output / "tiny" / "mt10-ars" / "seed0"
    expected = [("tiny", "mt10-smt", 0), ("tiny", "mt10-ars", 0)]
    failed = output / "tiny" / "mt10-smt" / "seed0.failed"  # of which the report prints the error
    assert reported == [([folder, failed], output / "report", ("table1",), expected)]
    run = read_run(folder)
    assert run.result["timesteps"] == 400 and run.result["resets"] == 1 and run.config.scale == "tiny"
    assert (folder / "log.txt").is_file()
    # the same again: what is finished stays
    before = (folder / "result.json").stat().st_mtime_ns
    assert main([*arguments, "--dry-run"]) == 0
    out = capsys.readouterr().out
    assert "tiny/mt10-ars/seed0 finished" in out and "tiny/mt10-smt/seed0 failed" in out
    # a cell that another process works on is not finished either
    assert claim(cells_of(tiny, "table1", only=["mt10-smt"])[0], output) is not None
    assert main(arguments) == 1 and "1 finished, 1 running" in capsys.readouterr().out
    assert main([a for a in arguments if a != "mt10-smt"]) == 0
    assert "1 cell:" in capsys.readouterr().out and (folder / "result.json").stat().st_mtime_ns == before
    assert len(reported) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tabel1"], "There is no table or figure 'tabel1'"),
        (["table1", "--scale", "smal"], "There is no scale 'smal'"),
        (["table1", "--only", "mt10-asr"], "Did you mean 'mt10-ars'"),
        (["table1", "--seeds", "0"], "--seeds=0 must be an integer of at least 1"),
        (["table1", "--scale"], "--scale names no size to train at"),
        (["--seeds", "1"], "Name the tables or figures to train: table1, "),
        (["table1", "--processes", "0"], "--processes=0 must be"),
        (["table1", "--launcher", "ray", "--processes", "2"], "--processes goes with --launcher local"),
        (["table1", "--ray-address", "auto"], "--ray-address goes with --launcher ray"),
        (["table1", "--gpus-per-cell", "1"], "--gpus-per-cell goes with --launcher ray"),
        (["table4", "--scale", "toy", "--output", "{file}"], "choose another --output"),
        (
            ["table4", "--scale", "toy", "--output", "{file}/a", "--dry-run"],
            "file is no folder; choose another",
        ),
    ],
)
def test_a_mistake_is_named_before_anything_is_trained(arguments, message, fake, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    arguments = [argument.format(file=tmp_path / "file") for argument in arguments]
    assert main(["bench", *arguments]) == 2
    assert message in capsys.readouterr().err and fake() == []


def test_without_tables_the_command_lists_them_and_the_scales(capsys):
    assert main(["bench"]) == 0
    out = capsys.readouterr().out
    for name in (*sweep_names(), "full", "small", "toy"):
        assert f"\n{name} " in f"\n{out}", name
    assert load_sweep("fig11").title in out


def test_a_terminal_shows_bars(tiny, fake, tmp_path, monkeypatch):
    from io import StringIO

    from rich.console import Console

    from sb3_ars.commands import bench

    terminal = StringIO()
    monkeypatch.setattr(bench, "Console", lambda **_: Console(file=terminal, force_terminal=True, width=120))
    cells = cells_of(tiny, "table4")
    with bench._monitor(len(cells), "3 to train") as monitor:
        monitor.ready()
        monitor.started(cells[0])
        monitor.progressed(cells[0], 100)
        launch(cells[1:], tmp_path, monitor)
    shown = terminal.getvalue()
    assert (
        "to train" in shown
        and cells[0].name in shown
        and "100 of 400 steps" in shown
        and "2 of 3 cells" in shown
    )


def test_steps_are_read_from_the_log(tmp_path):
    from sb3_ars.experiments.launchers import _steps

    (tmp_path / "run").mkdir()
    assert _steps(tmp_path) == 0
    (tmp_path / "run" / "progress.csv").write_text("success/a,time/total_timesteps\n1.0,40\n0.5,80\n")
    assert _steps(tmp_path) == 80
    (tmp_path / "run" / "progress.csv").write_text("success/a,time/total_timesteps\n1.0,")
    assert _steps(tmp_path) == 0


def test_the_pages_table_can_be_loaded_and_names_every_kind(tmp_path):
    page = (Path(__file__).parent.parent / "docs" / "sweeps.md").read_text()
    (table,) = [block.split("```")[0] for block in page.split("```yaml\n")[1:]]
    (tmp_path / "mine.yaml").write_text(table)
    assert len(load_sweep(str(tmp_path / "mine.yaml")).rows) == 2
    assert all(f"`{kind}`" in page for kind in KINDS)
