"""Reports: the numbers in every format, what is left out and said so, bad input, a page that needs nothing else."""

import csv
import dataclasses
import io
import json
import os
import platform
import re
import subprocess
import sys
from collections import Counter
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from sb3_ars.cli import main
from sb3_ars.errors import ConfigError
from sb3_ars.evaluation import EvaluationProtocol
from sb3_ars.experiments import curves, plots, runner
from sb3_ars.experiments.config import load_preset, save_config
from sb3_ars.experiments.report import drawings, figures, forms, page, tables, write_report
from sb3_ars.experiments.report.blocks import Listing
from sb3_ars.experiments.report.gather import differences, gather
from sb3_ars.experiments.report.sections import sections
from sb3_ars.experiments.report.tables import Row, mean_std
from sb3_ars.experiments.run_folder import read_run, write_json
from sb3_ars.experiments.runner import train
from sb3_ars.experiments.scaling import load_scale, scaled
from sb3_ars.experiments.sweeps import SweepRow, load_sweep, sweep_names

ARS = ([1, 0.8, 0.6, 0.4], [1, 0.6, 0.6, 0.2], [1, 1, 0.6, 0.6])
SAC = ([1, 1, 0, 0], [1, 1, 0, 0])
VERSIONS = {"python": "3.11", "gpu": None, "packages": {"torch": "2.8"}}


def write_run(folder, preset, success, seed=0, scale="toy", versions=VERSIONS, evaluations=True, **result):
    """Write what a run of a preset at a scale leaves, with final success given, and c_i doubled at a reset."""
    config = dataclasses.replace(scaled(load_preset(preset), load_scale(scale)), seed=seed)
    return write_config_run(folder, preset, config, success, versions, evaluations, **result)


def write_config_run(folder, name, config, success, versions=VERSIONS, evaluations=True, **result):
    folder.mkdir(parents=True)
    save_config(config, folder / "config.yaml")
    write_json(folder / "versions.json", versions)
    tasks, total = config.env.task_names, config.algorithm.total_timesteps
    steps = np.linspace(total / 4, total, 4).astype(int)
    share = np.linspace(0.25, 1, 4)[:, None] * np.array(success, dtype=float)
    log = {"time/total_timesteps": steps}
    log |= {f"success/{task}": share[:, i] for i, task in enumerate(tasks)}
    log |= {f"q_value/{task}": 10 * share[:, i] for i, task in enumerate(tasks)}
    pd.DataFrame(log).to_csv(folder / "progress.csv", index=False)
    if evaluations:
        np.savez(
            folder / "evaluations.npz",
            timesteps=steps,
            successes=share[..., None],
            task_names=np.array(tasks),
        )
    scales = [float(10**i) for i in range(len(tasks))] if len(tasks) < 5 else [2.0] * len(tasks)
    table = pd.DataFrame(
        {"success": success, "success_sampled": success, "return": 1.0, "c": scales}, index=tasks, dtype=float
    )
    model = SimpleNamespace(
        num_timesteps=total,
        _n_updates=1000,
        n_resets=1,
        reward_scale_history=[[100, scales], [total // 2, [2 * c for c in scales]]],
    )
    protocol = EvaluationProtocol("toy", 50, 50, goals=None)
    by_part = {"act": 20.0, "critic": 40.0}
    written = runner._result(name, config, table, protocol, model, 60.0, by_part, False)
    write_json(folder / "result.json", written | result)
    return folder


def write_cells(output, evaluations=True):
    for seed, success in enumerate(ARS):
        write_run(
            output / "toy" / "mt10-ars" / f"seed{seed}", "mt10-ars", success, seed, evaluations=evaluations
        )
    for seed, success in enumerate(SAC):
        write_run(output / "toy" / "mt10-sac" / f"seed{seed}", "mt10-sac", success, seed)
    failed = output / "toy" / "mt10-sac" / "seed2.failed"
    failed.mkdir()
    (failed / "error.txt").write_text("Traceback ...\nWorkerError: the env <died>\n")
    return output


EXPECTED = [("toy", preset, seed) for preset in ("mt10-ars", "mt10-sac", "mt10-ars-ln") for seed in range(3)]


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    return write_cells(tmp_path_factory.mktemp("cells"))


@pytest.fixture(scope="module")
def report(cells, tmp_path_factory):
    output = tmp_path_factory.mktemp("reports") / "report"
    sweeps = ("table1", "table3", "table4", "fig5")
    videos = cells / "toy" / "mt10-ars" / "seed0" / "videos"
    videos.mkdir()
    (videos / "point-east.gif").write_bytes(b"GIF89a")
    (videos / "notes.txt").write_text("no video")
    return write_report([cells], output, sweeps, videos=True, expected=EXPECTED).parent


def table_of(report, name):
    """Row label -> heading -> cell of a table's CSV."""
    lines = list(csv.reader(io.StringIO((report / "tables" / f"{name}.csv").read_text())))
    return {line[0]: dict(zip(lines[0], line, strict=True)) for line in lines[1:]}


def text_of(html):
    return unescape(html)


class Page(HTMLParser):
    """What a page holds: tags with their attributes, ids, the cells of its tables."""

    def __init__(self, text):
        super().__init__()
        self.opened, self.ids, self.tables, self._open, self._cell = [], [], {}, [], None
        self.feed(text)
        self.close()
        assert not self._open, self._open

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.opened.append((tag, attrs))
        if "id" in attrs:
            self.ids.append(attrs["id"])
        if tag not in ("meta", "link", "img", "wbr"):
            self._open.append(tag)
        if tag == "table":
            self.rows = self.tables[attrs["id"]] = []
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self._cell = ""

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_data(self, data):
        if self._cell is not None:
            self._cell += data

    def handle_endtag(self, tag):
        assert self._open.pop() == tag
        if tag in ("td", "th"):
            self.rows[-1].append(self._cell)
            self._cell = None


@pytest.fixture(scope="module")
def html(report):
    return (report / "index.html").read_text()


@pytest.fixture(scope="module")
def parsed(html):
    return Page(html)


# ------------------------------------------------------------------ numbers


def test_mean_and_spread_over_seeds_are_the_hand_worked_ones():
    # 60, 70, 80: the squared distances 100, 0, 100 over n - 1 = 2 give 10
    assert mean_std([0.6, 0.7, 0.8]) == "70.0 ± 10.0"
    assert (
        mean_std([0.7]) == "70.0"
        and mean_std([]) == tables.MISSING
        and mean_std([0.5, np.nan]) == tables.MISSING
    )
    # the paper's 98.8 ± 3.5 over 8 seeds: seven at 100 and one at 90
    assert mean_std([1.0] * 7 + [0.9]) == "98.8 ± 3.5"


def test_table_1_has_our_numbers_and_the_papers(report):
    table = table_of(report, "table1-toy")
    assert list(table["ARS"].values())[:7] == [
        "ARS", "3 of 3", "100.0 ± 0.0", "80.0 ± 20.0", "60.0 ± 0.0", "40.0 ± 20.0", "70.0 ± 10.0",
    ]  # fmt: skip
    assert table["ARS"][f"{tables.PAPER}: mean"] == "97.3 ± 2.1"
    assert table["SAC-MT"]["mean"] == "50.0 ± 0.0" and table["SAC-MT"]["seeds"] == "2 of 3"
    assert table["ARS-LN"]["seeds"] == "0 of 3" and table["ARS-LN"]["mean"] == tables.MISSING
    assert table["MOORE"]["seeds"] == "0" and table["MOORE"][f"{tables.PAPER}: mean"] == "86.0 ± 4.8"
    paper = table_of(report, "table1-toy-paper")
    assert paper["ARS"][f"{tables.PAPER}: pick-place"] == "86.3 ± 15.1"


def test_table_2_takes_the_same_shares_of_fewer_tasks(cells, report):
    found = gather([cells])
    ars = next(arm for arm in found.arms if arm.preset == "mt10-ars")
    rows = [Row("ARS", ars, paper={"bottom_k": {10: "9.1 ± 6.6", 50: "65.9 ± 2.9"}})]
    table = tables.bottom_k_table("t", "t", rows, ks=(10, 20, 30, 40, 50))
    # a fifth, two, three, four fifths and all of four tasks; 2 of 3 fifths is k = 2 both times
    assert [column.name for column in table.columns] == [
        "method", "seeds", "k = 1", "k = 2", "k = 3", "k = 4", "k = 10", "k = 50",
    ]  # fmt: skip
    assert table.rows[0] == (
        "ARS", "3", "40.0 ± 20.0", "50.0 ± 10.0", "60.0 ± 13.3", "70.0 ± 10.0", "9.1 ± 6.6", "65.9 ± 2.9",
    )  # fmt: skip
    assert table.notes == (
        "The paper's k of 50 tasks, and ours of 4, rounded: 10 → 1, 20 → 2, 30 → 2, 40 → 3, 50 → 4.",
    )
    assert table_of(report, "all-toy-bottom-k")["ARS"]["k = 3"] == "60.0 ± 13.3"
    section = forms.sweep_section(load_sweep("table2"), "toy", found)
    assert section.title == "Table 2, “Success of the k worst MT50 tasks”: our runs of scale toy"
    titles = [block.title for block in section.blocks if isinstance(block, tables.Table)]
    assert titles == ["Success of the k worst tasks of each seed (%), mean ± std over seeds"]


def test_table_3_puts_second_headings_across(report):
    table = table_of(report, "table3-toy")
    assert table["MT10 with ARS"]["SAC-MT"] == "70.0 ± 10.0 (3 of 3)"
    assert table["MT10 without ARS"]["SAC-MT"] == "50.0 ± 0.0 (2 of 3)"
    assert table["MT10 with ARS"]["PCGrad"] == "- (0)"
    assert table["MT10 with ARS"][f"{tables.PAPER}: MOORE"] == "98.0 ± 0.4"


def test_table_4_parts_the_tasks_by_each_methods_own_mean(report):
    table = table_of(report, "table4-toy")
    # seven tenths of four tasks are three: 0.8, 0.733, 0.867 on the first three
    assert table["ARS"]["easy"] == "80.0 ± 6.7" and table["ARS"]["difficult"] == "40.0 ± 20.0"
    assert table["ARS"][f"{tables.PAPER}: difficult"] == "91.7 ± 7.3"


def test_the_papers_table_4_follows_from_its_table_1():
    """Means over seeds of ARS's row of Table 1; its Table 4 prints 99.6, 91.7 and 97.3."""
    scores = np.array([[92.5, 98.75, 86.25, 98.75, 100, 100, 100, 96.25, 100, 100]]) / 100
    easy, difficult = tables._task_sets(scores, 7)
    assert 100 * easy[0] == pytest.approx(99.6, abs=0.05) and 100 * difficult[0] == pytest.approx(
        91.7, abs=0.05
    )


def test_shares_of_tasks_and_iqm_are_the_hand_worked_ones(report):
    shares = table_of(report, "all-toy-estr")["ARS"]
    # at or above 50 %: 3, 3 and 4 of four tasks
    assert shares["from 50 %"] == "83.3 ± 14.4" and shares["from 10 %"] == "100.0 ± 0.0"
    summary = table_of(report, "all-toy-summary")
    # the middle six of twelve scores: 0.6 four times, 0.8 and 1
    assert summary["ARS"]["IQM (%)"] == "70.0"
    low, high = map(float, summary["ARS"]["95 % interval"].split(" to "))
    assert low < 70 < high
    assert summary["SAC-MT"]["training time (min)"] == "1.0 ± 0.0" and summary["ARS"]["resets"] == "1"


def test_every_table_is_the_same_in_csv_markdown_and_html(report, parsed):
    files = sorted((report / "tables").glob("*.csv"))
    assert len(files) > 10
    for file in files:
        if file.stem == "all-numbers":
            continue
        lines = list(csv.reader(io.StringIO(file.read_text())))
        shown = [row for row in parsed.tables[file.stem] if len(row) == len(lines[0])]
        assert shown[-len(lines[1:]) :] == lines[1:], file.stem
        markdown = file.with_suffix(".md").read_text()
        for line in lines[1:]:
            assert "| " + " | ".join(line) + " |" in markdown, line
    assert set(parsed.tables) == {file.stem for file in files} - {"all-numbers"}


def test_all_numbers_are_there_unrounded(report):
    numbers = pd.read_csv(report / "tables" / "all-numbers.csv")
    assert len(numbers) == 5 * 4
    one = numbers[(numbers.preset == "mt10-ars") & (numbers.seed == 1) & (numbers.task == "point-north")]
    assert one.success.item() == 0.6 and one.c.item() == 10.0 and one.scale.item() == "toy"


# ------------------------------------------------------------------ what is said


def test_missing_and_failed_cells_are_named(html):
    assert "Missing: 4 runs" in html and "toy/mt10-ars-ln, seed 2" in html and "toy/mt10-sac, seed 2" in html
    assert "seed2.failed failed: WorkerError: the env &lt;died&gt;" in html


def test_the_scale_is_said_with_what_it_changed(html, parsed):
    assert "the two cannot be compared" in html
    rows = {row[0]: row[1:] for row in parsed.tables["differences-toy"]}
    assert rows["algorithm.total_timesteps"] == ["20,000,000", "24,000", "all"]
    assert rows["env.tasks"] == ["MT10", "toy", "all"]
    assert "protocol toy: 50 episodes per task, horizon 50" in html.lower()
    assert html.count("3 seeds each") > 0 and "2 to 3 seeds" in html


def test_what_the_numbers_cannot_say_is_said(html):
    assert text_of(html).count(drawings.FEW_SEEDS) >= 3  # the figure, the summary's table, how to read
    assert (
        "gives the row of ARS in its Table 4; of the other rows the paper prints no single tasks"
        in text_of(html)
    )
    assert "such as 98 and 62, are not" in text_of(html)


def test_the_papers_98_and_62_are_no_means_over_8_seeds_of_10_episodes():
    possible = {round(100 * successes / 80, 6) for successes in range(81)}
    assert not possible & {98, 62} and {98.75, 86.25} <= possible
    printed = [task.split()[0] for row in load_sweep("table1").rows for task in row.paper.get("tasks", ())]
    assert {"98", "62"} <= set(printed)


def test_a_run_as_its_preset_is_has_no_differences(tmp_path):
    config = load_preset("toy")
    write_config_run(tmp_path / "run", "toy", config, ARS[0])
    (arm,) = gather([tmp_path]).arms
    assert differences(arm) == {} and arm.label == "toy"


def test_runs_with_other_options_are_rows_of_their_own(tmp_path):
    config = load_preset("toy")
    changed = dataclasses.replace(config, ars=dataclasses.replace(config.ars, reward_scaling="none"))
    looked = dataclasses.replace(
        changed, seed=1, evaluation=dataclasses.replace(config.evaluation, every=500)
    )
    write_config_run(tmp_path / "a", "toy", config, ARS[0])
    write_config_run(tmp_path / "b", "toy", changed, SAC[0])
    write_config_run(tmp_path / "c", "toy", looked, SAC[0])
    write_config_run(tmp_path / "d", "toy", config, ARS[1], timesteps=20_000, interrupted=True)
    labels = {arm.label: len(arm.runs) for arm in gather([tmp_path]).arms}
    assert labels == {"toy": 1, "toy (reward_scaling none)": 2, "toy (stopped at step 20,000)": 1}


def test_a_run_that_ended_early_says_so_and_is_no_finished_cell(tmp_path):
    write_run(tmp_path / "a", "mt10-ars", ARS[0], timesteps=20_000, interrupted=True)
    cell = ("toy", "mt10-ars", 0)
    found = gather([tmp_path], [cell])
    (arm,) = found.arms
    assert arm.label == "mt10-ars (stopped at step 20,000)"  # though there is no other to tell it from
    assert found.missing == (cell,) and found.n_expected(arm) == 0
    overview = sections(found, [], videos=False)[0].blocks
    assert overview[0].startswith("0 finished runs and 1 that ended early of 1 preset,")
    assert (
        overview[1].warning
        and "toy/mt10-ars, seed 0: stopped at step 20,000 of 24,000" in overview[1].items[0]
    )
    rows = forms.sweep_section(load_sweep("table1"), "toy", found).blocks[2].rows
    assert ("ARS (stopped at step 20,000)", "1") in {row[:2] for row in rows}
    write_run(tmp_path / "b", "mt10-ars", ARS[0])
    assert gather([tmp_path], [cell]).missing == ()


def test_where_a_run_stopped_is_in_a_label_of_many_differences(tmp_path):
    config = load_preset("toy")
    changed = dataclasses.replace(
        config,
        algorithm=dataclasses.replace(config.algorithm, batch_size=7, learning_rate=0.1, tau=0.1, gamma=0.5),
    )
    write_config_run(tmp_path / "a", "toy", config, ARS[0])
    write_config_run(tmp_path / "b", "toy", changed, ARS[0], timesteps=20_000)
    label = gather([tmp_path]).arms[1].label
    assert "stopped at step 20,000;" in label and label.endswith("; 2 more)")


def test_of_a_seed_found_twice_the_newer_run_is_used(tmp_path):
    old = write_run(tmp_path / "z-old", "mt10-ars", ARS[0])
    new = write_run(tmp_path / "a-new", "mt10-ars", ARS[1])
    os.utime(old / "result.json", (1, 1))
    found = gather([tmp_path, new])
    assert [run.folder for run in found.runs] == [new.resolve()]
    assert found.warnings == (
        f"{old.resolve()} is an older run of mt10-ars with seed 0 than {new.resolve()}, which is used.",
    )


def test_other_environments_within_a_table_are_said(tmp_path, monkeypatch):
    monkeypatch.setattr(drawings, "draw", lambda *about: figures.Drawing(*about[:3], "", ""))  # takes seconds
    write_run(tmp_path / "a", "mt10-ars", ARS[0])
    write_run(tmp_path / "b", "mt10-ars", ARS[1], seed=1, versions={**VERSIONS, "packages": {"torch": "2.9"}})
    text = write_report([tmp_path], tmp_path / "report").read_text()
    assert "The runs of this table differ in torch (2.8, 2.9)." in text
    assert "2.8 (1 run); 2.9 (1 run)" in text


def test_videos_are_put_in_on_request(html):
    assert 'src="data:image/gif;base64,R0lGODlh"' in html and "ARS, seed 0: point-east" in html


# ------------------------------------------------------------------ the page


def test_the_page_needs_nothing_else(html, parsed):
    assert not re.findall(r"https?:", html)
    for tag, attrs in parsed.opened:
        assert tag not in ("script", "iframe")
        for name in ("src", "href"):
            assert attrs.get(name, "#").startswith(("#", "data:")), attrs
    assert not re.findall(r"url\((?!#)", html) and "@import" not in html


def test_ids_are_unique_and_every_reference_has_one(html, parsed):
    twice = [name for name, count in Counter(parsed.ids).items() if count > 1]
    assert not twice
    used = set(re.findall(r'href="#([^"]+)"', html)) | set(re.findall(r"url\(#([^)]+)\)", html))
    assert used and used <= set(parsed.ids)


def test_figures_take_their_colours_from_the_page_in_light_and_dark(html):
    assert "prefers-color-scheme: dark" in html and "@media print" in html
    style, body = html.split("</style>", 1)
    svgs = re.findall(r"<svg.*?</svg>", body, flags=re.DOTALL)
    assert len(svgs) > 20 and len(svgs) % 2 == 0  # wide and narrow
    for svg in svgs:
        assert not re.findall(r"#[0-9a-fA-F]{3,8}[;\"]", svg) and "font-family" not in svg
        assert {name for name in re.findall(r"var\(--([\w-]+)\)", svg)} <= {
            name for name, _, _ in figures.COLORS
        }
    for name, light, dark in figures.COLORS:
        assert f"--{name}: {light};" in style and f"--{name}: {dark};" in style


def luminance(color):
    channels = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


def contrast(a, b):
    low, high = sorted((luminance(a), luminance(b)))
    return (high + 0.05) / (low + 0.05)


def test_colours_stand_out_from_both_backgrounds(html):
    light, dark = re.findall(r"--background: (#\w+);", html)
    for name, on_light, on_dark in figures.COLORS:
        least = 1 if name == "grid" else 4.5 if name in ("ink", "muted") else 3
        assert contrast(on_light, light) >= least and contrast(on_dark, dark) >= least, name


# ------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: [], "needs a run"),
        (lambda path: [path / "nowhere"], "no folder"),
        (lambda path: [path], "No finished run in"),
    ],
)
def test_without_a_finished_run_there_is_no_report(make, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        write_report(make(tmp_path), tmp_path / "report")
    assert not (tmp_path / "report").exists()


def respell(run, **changes):
    """Change entries of a run's result; ``...`` drops one."""
    result = json.loads((run / "result.json").read_text()) | changes
    write_json(run / "result.json", {key: value for key, value in result.items() if value is not ...})


def cut(path, size):
    path.write_bytes(path.read_bytes()[:size])


BROKEN = {
    "no result": (lambda run: (run / "result.json").unlink(), "did not finish"),
    "another format": (lambda run: write_json(run / "result.json", {"format": 99}), "run format 99"),
    "no JSON": (lambda run: (run / "result.json").write_text("{"), "cannot be read"),
    "no tasks": (lambda run: respell(run, tasks={}), "lacks tasks"),
    "a list of tasks": (lambda run: respell(run, tasks=[1]), r"tasks is \[1\], but must be success"),
    "no success": (lambda run: respell(run, tasks={"reach": {}}), "tasks is .* but must be success"),
    "no scale history": (
        lambda run: respell(run, reward_scale_history="x"),
        "reward_scale_history is 'x', but must be a list",
    ),
    "scales of no task": (
        lambda run: respell(run, reward_scale_history=[[100, 1.0]]),
        "reward_scale_history is .* but must be a list",
    ),
    "no time": (lambda run: respell(run, training_seconds=...), "lacks training_seconds"),
    "no number of steps": (lambda run: respell(run, timesteps="many"), "timesteps is 'many', but must be"),
    "no updates": (lambda run: respell(run, updates=...), "lacks updates"),
    "no configuration": (lambda run: (run / "config.yaml").unlink(), "config.yaml does not exist"),
    "no log": (lambda run: (run / "progress.csv").unlink(), "progress.csv cannot be read"),
    "torn evaluations": (lambda run: cut(run / "evaluations.npz", 2), "evaluations.npz cannot be read"),
    "evaluations cut in the middle": (
        lambda run: cut(run / "evaluations.npz", 200),
        "evaluations.npz cannot be read",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_run_is_an_error_alone_and_a_warning_among_others(kind, tmp_path):
    spoil, message = BROKEN[kind]
    spoil(write_run(tmp_path / "broken", "mt10-ars", ARS[0]))
    with pytest.raises(ConfigError, match=f"No finished run(.|\n)*{message}"):
        gather([tmp_path])
    write_run(tmp_path / "whole", "mt10-ars", ARS[1], seed=1)
    found = gather([tmp_path])
    assert [run.seed for run in found.runs] == [1]
    assert len(found.warnings) == 1 and re.search(message, found.warnings[0])


def test_what_cannot_be_read_is_not_blamed_on_the_output(tmp_path, monkeypatch):
    write_run(tmp_path / "run", "mt10-ars", ARS[0])
    (tmp_path / "other" / "error.txt").mkdir(parents=True)  # a folder of that name is no word of a failure
    assert gather([tmp_path]).warnings == ()

    def refused(*_):
        raise PermissionError(13, "Permission denied", "secret")

    monkeypatch.setattr(page, "gather", refused)
    with pytest.raises(ConfigError, match=r"runs cannot be read: .*secret") as raised:
        write_report([tmp_path / "run"], tmp_path / "report")
    assert "--output" not in str(raised.value)


def test_an_unknown_table_is_refused_with_the_nearest_name(cells, tmp_path):
    with pytest.raises(ConfigError, match="Did you mean 'table1"):
        write_report([cells], tmp_path / "report", ["tabel1"])
    assert not (tmp_path / "report").exists()


def test_an_output_folder_that_cannot_be_written_is_refused_before_work(cells, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "gather", lambda *_: pytest.fail("work was begun"))
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        write_report([cells], tmp_path / "file" / "report")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("precious")
    with pytest.raises(ConfigError, match="holds something else than a report"):
        write_report([cells], tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.tex"]


def test_a_report_is_replaced_whole_and_a_torn_one_has_no_page(tmp_path, monkeypatch):
    write_run(tmp_path / "run", "mt10-ars", ARS[0])
    monkeypatch.setattr(page, "sections", lambda *_: [])  # an empty page is written fast
    output = tmp_path / "report"
    index = write_report([tmp_path / "run"], output)
    (output / "tables" / "stale.csv").write_text("")
    assert (
        write_report([tmp_path / "run"], output) == index and not (output / "tables" / "stale.csv").exists()
    )
    before = index.read_text()

    def torn(*_):
        raise RuntimeError("power cut")

    monkeypatch.setattr(page, "_html", torn)
    with pytest.raises(RuntimeError):
        write_report([tmp_path / "run"], output)
    assert index.read_text() == before and {path.name for path in output.iterdir()} == {
        "index.html",
        "tables",
    }
    with pytest.raises(RuntimeError):
        write_report([tmp_path / "run"], tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_drafts_of_killed_reports_are_removed_and_those_of_live_ones_kept(tmp_path, monkeypatch):
    write_run(tmp_path / "run", "mt10-ars", ARS[0])
    monkeypatch.setattr(page, "sections", lambda *_: [])
    killed = subprocess.Popen([sys.executable, "-c", ""])
    killed.wait()
    drafts = {
        pid: tmp_path / "report" / f".draft-{platform.node()}-{pid}" for pid in (killed.pid, os.getppid())
    }
    elsewhere = tmp_path / "report" / f".draft-another-{killed.pid}"
    for draft in (*drafts.values(), elsewhere):
        (draft / "tables").mkdir(parents=True)
    write_report([tmp_path / "run"], tmp_path / "report")
    assert not drafts[killed.pid].exists()
    assert drafts[os.getppid()].is_dir() and elsewhere.is_dir()


def test_a_report_written_at_the_same_time_does_not_stop_this_one(tmp_path, monkeypatch):
    write_run(tmp_path / "run", "mt10-ars", ARS[0])
    monkeypatch.setattr(page, "sections", lambda *_: [])
    output = tmp_path / "report"
    write_report([tmp_path / "run"], output)
    replace, others = Path.replace, [output / "tables"]

    def replace_beside_another(path, target):
        if target in others:  # just now, and once, the other puts its tables there
            others.remove(target)
            target.mkdir()
            (target / "others.csv").write_text("")
        replace(path, target)

    monkeypatch.setattr(Path, "replace", replace_beside_another)
    index = write_report([tmp_path / "run"], output)
    assert not others
    assert index.is_file() and [path.name for path in (output / "tables").iterdir()] == ["all-numbers.csv"]
    assert {path.name for path in output.iterdir()} == {"index.html", "tables"}


# ------------------------------------------------------------------ real runs, many tasks, curves, plots


def test_the_command_reports_a_real_run(tmp_path, capsys):
    config = load_preset("toy")
    config = dataclasses.replace(
        config,
        algorithm=dataclasses.replace(config.algorithm, total_timesteps=800, batch_size=8),
        evaluation=dataclasses.replace(config.evaluation, n_episodes=2, every=400),
        ars=dataclasses.replace(config.ars, param_resets=(400,), updates_after_reset=3),
        policy=dataclasses.replace(config.policy, net_arch=(8,)),
        profile=True,
    )
    run = train(config, "toy", progress_bar=False, folder=tmp_path / "run")
    capsys.readouterr()
    assert main(["report", str(tmp_path), "--output", str(tmp_path / "report")]) == 0
    assert f"Report: {tmp_path / 'report' / 'index.html'}" in capsys.readouterr().out
    table = table_of(tmp_path / "report", "all-full-tasks")["toy"]
    for task, success in run.table.success.items():
        assert table[task] == f"{100 * success:.1f}"
    assert "One seed each, so no spread." in (tmp_path / "report" / "index.html").read_text()
    assert float(table_of(tmp_path / "report", "all-full-seconds")["toy"]["critic"]) >= 0


def test_the_command_says_what_is_wrong(tmp_path, capsys):
    assert main(["report", str(tmp_path)]) == 2
    assert "No finished run" in capsys.readouterr().err


def test_the_commands_help_says_what_it_does_and_what_happens_without_options(capsys):
    with pytest.raises(SystemExit):
        main(["report", "--help"])
    out = " ".join(capsys.readouterr().out.split())
    assert "Write tables and figures of runs as one HTML page" in out
    assert "(default: what fits the runs)" in out and "(default: )" not in out


def test_with_many_tasks_they_stand_in_rows_and_legends_stay_short(tmp_path):
    success = [round(task / 49, 2) for task in range(50)]
    write_run(tmp_path / "a", "mt50-ars", success, scale="full", evaluations=False)
    found = gather([tmp_path])
    (arm,) = found.arms
    table = tables.task_table("t", "t", [Row("ARS", arm, paper={"mean": "65.9 ± 2.9"})])
    assert len(table.rows) == 50 + 3 and table.rows[-1] == ("the paper's mean", "65.9 ± 2.9")
    assert table.rows[0] == ("seeds", "1") and table.rows[1][1] == "0.0"
    for plot in (plots.plot_scales, plots.plot_q_values):
        (legend,) = plot({"ARS": arm.runs}).legends
        labels = [text.get_text() for text in legend.get_texts()]
        assert len(labels) == 7 and labels[5] == "the other 45"
    assert plots.plot_q_values({"ARS": arm.runs}, ["reach-v3"]).axes[0].lines[0].get_label() == "reach"


def test_a_run_without_any_success_is_valid_json_and_can_be_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(drawings, "draw", lambda *about: figures.Drawing(*about[:3], "", ""))
    run = write_run(tmp_path / "run", "mt10-ars", [None] * 4, evaluations=False)

    def no_number(text):
        raise ValueError(text)

    result = json.loads((run / "result.json").read_text(), parse_constant=no_number)
    assert result["mean_success"] is None and result["tasks"]["point-north"]["success"] is None
    index = write_report([run], tmp_path / "report")
    assert table_of(index.parent, "all-toy-summary")["mt10-ars"]["mean success (%)"] == tables.MISSING
    assert set(pd.read_csv(index.parent / "tables" / "all-numbers.csv").success.isna()) == {True}


def test_numbers_are_written_in_full_precision(tmp_path):
    run = read_run(write_run(tmp_path / "run", "mt10-ars", [1 / 3, 0, 0, 0]))
    assert run.success()[0] == 1 / 3 and run.result["mean_success"] == 1 / 12


def test_tasks_without_success_leave_a_dash(tmp_path):
    write_run(tmp_path / "a", "mt10-ars", [0.5, None, 0.5, None], evaluations=False)
    (arm,) = gather([tmp_path]).arms
    row = Row("ARS", arm)
    assert tables.task_table("t", "t", [row]).rows[0] == ("ARS", "1", "50.0", "-", "50.0", "-", "50.0")
    assert tables.bottom_k_table("t", "t", [row]).rows[0][2:] == ("-",) * 4
    assert tables.iqm_of(arm).estimate == 0.5


def test_seeds_logged_at_other_steps_are_brought_together(tmp_path):
    runs = [read_run(write_run(tmp_path / str(seed), "mt10-ars", ARS[seed], seed)) for seed in (0, 1)]
    same = curves.success_curves(runs, "evaluation")
    assert same.steps.tolist() == [6000, 12000, 18000, 24000] and same.values.shape == (2, 4, 4)
    log = pd.read_csv(runs[1].folder / "progress.csv")
    log["time/total_timesteps"] = [5000, 10000, 15000, 20000]
    log.to_csv(runs[1].folder / "progress.csv", index=False)
    found = curves.success_curves(runs, "training")
    assert (found.steps[0], found.steps[-1]) == (6000, 20000)  # where both seeds have numbers
    # at step 20,000 seed 0 is a third of the way from 18,000 (0.75) to 24,000 (1)
    assert found.values[0, -1, 0] == pytest.approx(0.75 + 0.25 / 3) and found.values[1, -1, 0] == 1
    assert curves.logged_curves(runs, "nothing").values.shape == (2, 0, 4)


def test_figures_use_evaluations_only_where_all_runs_have_them(tmp_path):
    one = read_run(write_run(tmp_path / "a", "mt10-ars", ARS[0]))
    other = read_run(write_run(tmp_path / "b", "mt10-sac", SAC[0], evaluations=False))
    assert curves.common_source([one]) == "evaluation" and curves.common_source([one, other]) == "training"
    with pytest.raises(ConfigError, match="no evaluations"):
        curves.success_curves([other], "evaluation")
    assert (
        "latest training episodes" in plots.plot_curves({"ARS": [one], "SAC": [other]}).axes[0].get_ylabel()
    )


def test_scales_hold_from_one_reset_to_the_next(tmp_path):
    runs = [read_run(write_run(tmp_path / str(seed), "mt10-ars", ARS[seed], seed)) for seed in (0, 1)]
    found = curves.scale_curves(runs)
    assert found.steps.tolist() == [100, 12000, 24000]
    assert found.values[0, :, 1].tolist() == [10, 20, 20]
    assert curves.reset_times(runs) == (12000,)


def test_plots_are_figures_that_pyplot_does_not_hold(tmp_path):
    runs = [read_run(write_run(tmp_path / str(seed), "mt10-ars", ARS[seed], seed)) for seed in (0, 1)]
    arms, before = {"ARS": runs}, plt.rcParams["axes.edgecolor"]
    drawn = [plot(arms) for plot in (plots.plot_curves, plots.plot_task_curves, plots.plot_task_success)]
    drawn += [plots.plot_scales(arms), plots.plot_mean_success(arms), plots.plot_estr(arms, (0.5,))]
    assert all(isinstance(figure, Figure) for figure in drawn) and not plt.get_fignums()
    axis = drawn[0].axes[0]
    assert (
        axis.get_xlabel() == "environment steps, all tasks together (thousand)" and "(%)" in axis.get_ylabel()
    )
    np.testing.assert_allclose(axis.lines[0].get_ydata(), 65 * np.linspace(0.25, 1, 4))  # means 0.7 and 0.6
    assert drawn[3].axes[0].get_yscale() == "log" and len(drawn[1].axes) == 4
    with plots.style():
        assert plt.rcParams["axes.edgecolor"] == plots.MUTED
    assert plt.rcParams["axes.edgecolor"] == before


def test_no_two_series_look_alike():
    looks = [plots.series_style(index) for index in range(40)]
    assert len({(look["color"], str(look["linestyle"])) for look in looks}) == 40


def test_every_table_and_figure_of_the_paper_has_its_form(tmp_path, monkeypatch):
    drawn = {}

    def draw(name, title, caption, plot):
        drawn[name] = plot(figures.NARROW)  # neither laid out nor written, which takes most of the time
        return figures.Drawing(name, title, caption, "", "")

    for module in (drawings, forms):
        monkeypatch.setattr(module, "draw", draw)
    chosen = [load_sweep(name) for name in sweep_names()]
    for preset in dict.fromkeys(preset for sweep in chosen for preset in sweep.presets):
        n_tasks = 1 if preset.startswith("single") else 4
        write_run(tmp_path / preset, preset, [0.5] * n_tasks)
    found = gather([tmp_path])
    for sweep in chosen:
        blocks = forms.sweep_section(sweep, "toy", found).blocks
        shown = [block for block in blocks if isinstance(block, tables.Table)]
        assert shown and any(isinstance(block, figures.Drawing) for block in blocks), sweep.name
        assert "50.0" in str(shown[0].rows) or sweep.kind == "estr", sweep.name
        assert not any(isinstance(block, Listing) for block in blocks), sweep.name  # none is missing
        assert sweep.options.get("note", blocks[0]) in blocks, sweep.name
    assert len(drawn["fig1-toy-curves"].axes) == 4 and len(drawn["fig1-toy-curves"].axes[0].lines) == 3
    assert len(drawn["fig11-toy-task-bars"].axes[0].patches) == 9 * 4
    forms.sweep_section(dataclasses.replace(load_sweep("fig11"), kind="bars"), "toy", found)
    assert len(drawn["fig11-toy-bars"].axes[0].patches) == 9
    # the tasks that stand for the two the paper shows
    stands_for, (legend,) = load_scale("toy").stands_for, drawn["fig3-toy-q"].legends
    shown = [text.get_text() for text in legend.get_texts()]
    assert set(shown) == {stands_for["push-v3"], stands_for["pick-place-v3"], "reset"}
    assert len(drawn["fig10-toy-curves"].axes[0].lines) == 8 + 1  # a line each, and the reset
    assert len(drawn["fig2-toy-task-bars"].axes[0].patches) == 3 * 4
    # in one colour in every figure
    colors = {
        drawn[name].axes[0].lines[row].get_color()
        for name, row in (("fig7-toy-curves", 2), ("fig8-toy-curves", 2))
    }
    assert len(colors) == 1


def test_methods_of_other_tasks_stand_in_figures_of_their_own(tmp_path, monkeypatch):
    drawn = {}

    def draw(name, title, caption, plot):
        drawn[name] = (title, plot(figures.NARROW))
        return figures.Drawing(name, title, caption, "", "")

    monkeypatch.setattr(drawings, "draw", draw)
    config = scaled(load_preset("mt10-ars"), load_scale("toy"))
    names = config.env.task_names
    for label, tasks in (("all", names), ("first", names[:2]), ("last", names[2:]), ("alone", names[1:2])):
        other = dataclasses.replace(config, env=dataclasses.replace(config.env, tasks=tasks))
        write_config_run(tmp_path / label, "mt10-ars", other, [0.5] * len(tasks))
    found = gather([tmp_path])
    sweep = dataclasses.replace(load_sweep("fig5"), rows=(SweepRow("mt10-ars", "ARS"),), options={})
    for kind, ending in (("scales", "scales"), ("q_values", "q"), ("task_bars", "task-bars")):
        drawn.clear()
        forms.sweep_section(dataclasses.replace(sweep, kind=kind), "toy", found)
        assert list(drawn) == [f"fig5-toy-{ending}-{number}" for number in (1, 2, 3, 4)]
        titles = [title for title, _ in drawn.values()]
        assert {
            f"({len(t)} tasks, {t[0]} to {t[-1]})" in str(titles) for t in (names, names[:2], names[2:])
        } == {True}
        assert any(title.endswith(f"(task {names[1]})") for title in titles)
    labels = {tick.get_text() for _, figure in drawn.values() for tick in figure.axes[0].get_yticklabels()}
    assert labels == set(names)
    made = sections(found, [], videos=False)
    assert len({section.name for section in made}) == len(made)
    for plot in (plots.plot_scales, plots.plot_q_values, plots.plot_task_success, plots.plot_task_curves):
        with pytest.raises(ConfigError, match="Draw a figure for each"):
            plot({arm.label: arm.runs for arm in found.arms})


def test_a_task_alone_has_no_tables_of_worst_tasks(tmp_path, monkeypatch):
    monkeypatch.setattr(drawings, "draw", lambda *about: figures.Drawing(*about[:3], "", ""))
    write_run(tmp_path / "a", "single-push-scale-1", [0.5])
    made = {section.name: section for section in sections(gather([tmp_path]), [], videos=False)}
    names = [getattr(block, "name", "") for block in made["all-toy"].blocks]
    assert "all-toy-summary" in names and not any(
        name.endswith(("-estr", "-bottom-k", "-tasks")) for name in names
    )
