"""The benchmarks' own arithmetic, files and contestants, at toy size; nothing here looks at how fast anything is."""

import dataclasses
import functools
import itertools
import json
import os
import re
import time
import types

import numpy as np
import pytest

from benchmarks import gpu_mt10, harness, methods, report, toy_methods, training_loop, update
from sb3_ars import ARSSAC, make_toy_env
from sb3_ars.errors import ConfigError
from sb3_ars.experiments import preset_names
from sb3_ars.experiments.config import load_preset

TINY = {"batch_size": 4, "net_arch": [8], "stored": 10}
RESULTS = report.read_results()


# ---------------------------------------------------------------------- arithmetic


def test_the_figure_is_the_median_over_rounds_of_each_rounds_ratio():
    seconds = {"peer": [2.0, 6.0, 4.0], "ours": [1.0, 2.0, 4.0]}  # ratios 2, 3, 1
    row = harness.compare(seconds, "peer")["ours"]
    assert row["speedup"] == 2.0
    assert (row["speedup_low"], row["speedup_high"]) == (1.5, 2.5)
    assert row["speedup_of_bests"] == 2.0 / 1.0
    assert row["speedup_of_medians"] == 4.0 / 2.0
    assert (row["best_seconds"], row["median_seconds"]) == (1.0, 2.0)
    assert harness.compare(seconds, "peer")["peer"]["speedup"] == 1.0


def test_a_round_that_slows_everybody_leaves_the_figure_alone():
    calm = harness.speedup([3.0, 3.0, 3.0], [1.0, 1.0, 1.0])
    noisy = harness.speedup([3.0, 30.0, 3.0], [1.0, 10.0, 1.0])
    assert calm == noisy == {"speedup": 3.0, "speedup_low": 3.0, "speedup_high": 3.0}


def test_a_goal_is_reached_on_the_right_side():
    assert harness.goal("speed", 1.6, at_least=1.6)["reached"]
    assert not harness.goal("speed", 1.59, at_least=1.6)["reached"]
    assert harness.goal("cost", 1.0, at_most=1.0)["reached"]
    assert not harness.goal("cost", 1.01, at_most=1.0)["reached"]
    with pytest.raises(ValueError, match="at_least and at_most"):
        harness.goal("both", 1.0, at_least=1.0, at_most=1.0)


def test_the_updates_goals_compare_what_they_say():
    ten = {"sb3": [160.0], "sbx": [50.0], "eager": [150.0], "fp32": [80.0], "bf16": [40.0]}
    fifty = {name: [5.5 * s[0]] for name, s in ten.items()}
    measured = {"10": harness.compare(ten, "sb3"), "50": harness.compare(fifty, "sb3")}
    found = {entry["goal"]: entry["measured"] for entry in update.goals(measured)}
    assert list(found.values()) == pytest.approx([2.0, 4.0, 1.25, 1.1, 1.1])


def test_of_overlap_on_and_off_the_faster_counts():
    seconds = {"sb3": [6.0], "fp32": [4.0], "fp32-overlap": [3.0], "bf16": [1.5], "bf16-overlap": [2.0]}
    found = training_loop.goals(harness.compare(seconds, "sb3"))
    assert [entry["measured"] for entry in found] == [4.0, 2.0]


# ---------------------------------------------------------------------- timing in turns


def test_contestants_work_in_turns_in_processes_of_their_own_and_errors_come_back():
    sleep = functools.partial(harness.stopwatch, functools.partial(time.sleep, 0.01))
    broken = functools.partial(harness.stopwatch, None)
    contestants = [harness.Contestant("a", "A", sleep, units=2), harness.Contestant("b", "B", broken)]
    with pytest.raises(RuntimeError, match=r"(?s)b failed.*not callable"):
        harness.interleave(contestants, rounds=1)
    seconds = harness.interleave(contestants[:1], rounds=3)
    assert len(seconds["a"]) == 3 and all(0.01 <= s < 1.0 for s in seconds["a"])


@pytest.mark.parametrize("make", [update.make_sb3, update.make_ours])
def test_an_update_can_be_timed(make):
    assert make(2, **TINY)(2) > 0.0


def test_every_contestant_of_ours_trains():
    for _, options in update.OURS.values():
        assert update.make_ours(2, **TINY, **options)(1) > 0.0


def test_pacing_stands_still_between_orders_and_passes_errors_on():
    model = ARSSAC(
        "MlpPolicy",
        make_toy_env(seed=0),
        learning_starts=16,
        batch_size=4,
        buffer_size=200,
        n_reset=0,
        policy_kwargs={"net_arch": [8]},
    )
    work = training_loop.paced(model, random_steps=4)
    before = model.num_timesteps
    assert work(3) > 0.0
    assert model.num_timesteps == before + 3 * 4 and model._n_updates == 1 + 3

    def fail(**_):
        raise ZeroDivisionError

    model.train = fail
    with pytest.raises(ZeroDivisionError):
        work(2)


@pytest.mark.metaworld
def test_the_peers_environment_shows_the_goal_and_draws_a_new_one_each_episode():
    env = training_loop.StockTask("reach-v3", task=1, n_tasks=3)
    first, second = env.reset()[0], env.reset()[0]
    assert first.dtype == np.float32 and first.shape == (42,) and list(first[-3:]) == [0, 1, 0]
    assert first[36:39].any() and not np.array_equal(first[36:39], second[36:39])
    for step in range(training_loop.HORIZON):
        _, _, terminated, truncated, _ = env.step(np.zeros(4))
        assert not terminated and truncated == (step == training_loop.HORIZON - 1)


# ---------------------------------------------------------------------- results and documents


def fake_results(tmp_path):
    """Results of made-up seconds, as they look after a round trip through their files."""
    seconds = {"sb3": [3.0, 4.0, 5.0], "fp32": [1.5, 2.5, 2.0], "bf16": [1.0, 1.0, 1.0]}
    tasks = {n: harness.compare(seconds, "sb3") for n in ("10", "50")}
    labels = {"sb3": "SB3 SAC", "fp32": "sb3_ars, fp32", "bf16": "sb3_ars, bf16"}
    result = {
        "labels": labels,
        "baseline": "sb3",
        "tasks": tasks,
        "goals": update.goals(tasks),
        "machine": harness.machine(2),
    }
    harness.write_result("update", result, tmp_path)
    return report.read_results(tmp_path)


def test_a_result_says_where_it_was_measured(tmp_path):
    machine = fake_results(tmp_path)["update"]["machine"]
    for key in (
        "cpu_model",
        "cpus",
        "cpus_used",
        "memory_gb",
        "gpu",
        "packages",
        "commit",
        "tree_is_dirty",
        "date",
    ):
        assert key in machine, key
    assert machine["packages"]["stable-baselines3"] and machine["cpu_model"]


def test_tables_chart_and_pages_come_from_the_files_alone(tmp_path):
    results = fake_results(tmp_path)
    page = "# Page\n<!-- begin: update -->\nold\n<!-- end: update -->\nend\n"
    filled = report.filled(page, results)
    assert "| sb3_ars, bf16 | 1000.0 ms | 4.00 | 3.50 to 4.50 |" in filled and "old" not in filled
    assert report.filled(filled, results) == filled and report.outside_blocks(filled) == "# Page\n\nend\n"
    assert report.UNMEASURED in report.filled(page, {})
    assert "reached" in report.render("goals", results) and "processors used" in report.render(
        "machine", results
    )
    with pytest.raises(KeyError, match="no block 'updates'"):
        report.filled(page.replace("update", "updates"), results)
    panels = report.panels_of(results)["update"]
    assert [panel.title for panel in panels] == ["One update, 10 tasks", "One update, 50 tasks"]
    report.draw(panels, tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 5000


@pytest.mark.parametrize("path", report.PAGES, ids=lambda path: path.name)
def test_the_pages_tables_are_the_benchmarks(path):
    page = path.read_text()
    assert report.filled(page, RESULTS) == page, "run: python -m benchmarks.report"


def test_the_page_on_performance_has_every_table_and_no_number_beside_them():
    page = report.PAGES[0].read_text()
    for name in (*report.BLOCKS, *report.PANELS):
        assert f"<!-- begin: {name} -->" in page, name
    assert numbers_in_prose(page) == []


def numbers_in_prose(page):
    prose = re.sub(r"`[^`]*`|\]\([^)]*\)", "", report.outside_blocks(page))
    return re.findall(r"(?<![\w*])\d[\d.,]*(?!\w)", prose)


def test_the_methods_pages_have_their_tables():
    overview = report.METHODS_PAGE.read_text()
    for name in report.METHOD_BLOCKS:
        assert f"<!-- begin: {name} -->" in overview, name
    assert numbers_in_prose(overview) == []
    for method in report.METHODS:
        page = (report.METHOD_PAGES / f"{method.page}.md").read_text()
        kinds = {"toy": method.alone or method.with_ars, "cost": method.cost}
        for kind in (kind for kind, measured in kinds.items() if measured):
            assert f"<!-- begin: {kind}-{method.page} -->" in page, (kind, method.page)


@pytest.mark.parametrize(
    ("page", "blocks"),
    [(report.TUNING, report.TUNING_BLOCKS), (report.CHECKPOINTS, report.CHECKPOINT_BLOCKS)],
    ids=["tuning", "checkpoints"],
)
def test_a_page_has_its_blocks(page, blocks):
    for name in blocks:
        assert f"<!-- begin: {name} -->" in page.read_text(), name


def test_checkpoints_kills_and_calls_are_told_with_what_they_left():
    entry = {"seconds": 2.0, "rows_gb": 1.5, "rest_mb": 20.0, "extra_memory_mb": 30.0, "share": 0.01}
    grown = {"processes": 0, "open_files": 1, "shared_memory_segments": 0, "resident_mb_per_1000_calls": 0.25}
    results = {
        "checkpoints": {"buffer_gb": 3.36, "ten minutes, CPU": entry, "goals": []},
        "soak": {
            "steps": 40_000,
            "kills": 100,
            "kills_while_a_file_was_written": 40,
            "lives_that_found_no_usable_checkpoint": 0,
            "differing": [],
        },
        "lifecycle": {"calls": 2000, "growth": grown},
    }
    table = report.render("checkpoints", results)
    assert "| ten minutes, CPU | 2.0 s | 1.50 GB | 1.00% | 30 MB |" in table
    told = report.render("soak", results)
    assert "40,000 steps was killed 100 times" in told and "to the bit" in told and "open files by 1" in told
    results["soak"]["differing"] = ["rewards"]
    assert "another run" in report.render("soak", results)


def test_a_study_is_told_with_its_kill_and_its_verdict():
    study = {
        "preset": "mt10-ars", "scale": "toy", "steps": 24_000, "seeds": 2, "pruner": "none", "verdict": "No more.",
        "space": {"ars.n_reset": {"type": "int", "low": 0, "high": 9}},
        "story": {"processes": 2, "killed_trial": 5, "seconds": 660.0},
        "states": {"complete": 12},
        "tried": [
            {"params": {"ars.n_reset": 4}, "mean": 0.9, "std": 0.14142, "values": [0.8, 1.0]},
            {"params": {"ars.n_reset": 0}, "mean": 0.25, "std": None, "values": [0.25]},
        ],
        "trials": [{"number": 5, "retry_of": None}, {"number": 8, "retry_of": 5}],
    }  # fmt: skip
    told = report.render("tuning", {"tune_toy": study})
    assert (
        "24,000 environment steps a run, 2 runs a trial" in told
        and "12 trials to their end in 11 minutes" in told
    )
    assert "| 4 | 0.900 | 0.141 | 2 |" in told and "| 0 | 0.250 | - | 1 |" in told
    assert "trial 5 was killed in the middle; its options were tried again in trial 8." in told
    assert told.endswith("\n\nNo more.")
    study["story"]["killed_trial"] = None
    assert "killed" not in report.render("tuning", {"tune_toy": study})
    assert report.render("tuning", {}) == report.UNMEASURED


def test_the_table_of_methods_has_every_arm_and_every_timed_network_once():
    arms = [arm for method in report.METHODS for arm in (method.alone, method.with_ars) if arm]
    assert sorted(arms) == sorted(toy_methods.ARMS)
    assert {method.cost for method in report.METHODS if method.cost} == set(methods.LABELS)
    presets = preset_names()
    for name in methods.LABELS:
        assert {f"mt10-{name}", f"mt50-{name}"} <= set(presets)
    assert set(toy_methods.ARMS.values()) <= set(presets)


@pytest.mark.parametrize("name", ["env_steps", "update", "training_loop"])
def test_the_stored_figures_follow_from_the_stored_seconds(name):
    result = RESULTS[name]
    for group, rows in result.get("tasks", {"MT10": result.get("contestants")}).items():
        baseline = result["baselines"][group] if name == "env_steps" else result["baseline"]
        again = harness.compare({key: row["seconds"] for key, row in rows.items()}, baseline)
        for key, row in rows.items():
            assert row["speedup"] == pytest.approx(again[key]["speedup"], rel=1e-3)
            assert row["median_seconds"] == pytest.approx(again[key]["median_seconds"], rel=1e-3)


# ---------------------------------------------------------------------- the methods, timed


def test_a_methods_figures_compare_what_they_say():
    seconds = {"sac-mt10": [1.0, 2.0, 1.0], "sac-mt10-at-50": [4.0, 8.0, 4.0]}
    seconds |= {
        "moore-mt10": [3.0, 6.0, 3.0],
        "moore-mt10-at-50": [18.0, 36.0, 18.0],
        "moore-mt50": [24.0, 40.0, 24.0],
    }
    found = methods.compared("moore", seconds)
    assert {case: row["times"] for case, row in found["cases"].items()} == {
        "mt10": 3.0, "mt10-at-50": 4.5, "mt50": 6.0,
    }  # fmt: skip
    assert (found["cases"]["mt50"]["times_low"], found["row_cost"]["times"]) == (5.5, pytest.approx(1.2))
    measured = {"moore": found, "pcgrad": methods.compared("sac", seconds)}
    reached = {entry["goal"]: entry["reached"] for entry in methods.goals(measured)}
    assert reached == {
        "update, 10 tasks: MOORE, times SAC-MT's time": True,
        "update, 50 tasks: MOORE, times SAC-MT's time": False,  # its MT50 network, not MT10's
        "update, 10 tasks: PCGrad, times SAC-MT's time": True,
        "update: MOORE, cost per row at 50 tasks over that at 10": True,
    }


def test_only_networks_that_differ_are_timed_again_at_fifty_tasks():
    again = {name for name in methods.LABELS if "mt50" in methods.configs_of(name)}
    assert again == {"moore", "paco", "ars-lora", "ars-lora-paper"}


@pytest.mark.parametrize("name", methods.LABELS)
def test_every_methods_update_can_be_timed_at_any_number_of_tasks(name):
    small = toy_methods.toy_config(f"mt10-{name}", 0)
    small = dataclasses.replace(small, algorithm=dataclasses.replace(small.algorithm, batch_size=4))
    model = methods.make_model(small, n_tasks=3, stored=10)
    assert model.n_tasks == 3 and model.lora_is_enabled == ("lora" in name)
    before = [parameter.clone() for parameter in model.actor.parameters()]
    assert methods.make_update(small, n_tasks=3, stored=10)(1) > 0.0
    model.train(gradient_steps=1, batch_size=4)
    changed = [not (new == old).all() for new, old in zip(model.actor.parameters(), before, strict=True)]
    assert any(changed) and all(changed) == ("lora" not in name)


def test_an_updates_memory_holds_networks_targets_gradients_and_moments():
    config = load_preset("mt10-sac")
    found = harness.run_alone(functools.partial(methods.memory_of, config, 2, 100), cpus=1)
    assert found["parameters"] == found["learned_parameters"] > 1_000_000
    assert 4.5 < found["peak_bytes"] / (4 * found["parameters"]) < 40  # 4 and the targets; and activations


def test_the_methods_stored_figures_follow_from_the_stored_seconds():
    result = RESULTS["methods"]
    assert set(result["methods"]) == set(methods.LABELS)
    for name, found in result["methods"].items():
        seconds = {f"{name}-{case}": row["seconds"] for case, row in found["cases"].items()}
        bases = ("mt10", "mt10-at-50")
        seconds |= {f"sac-{case}": found["cases"][case]["baseline_seconds"] for case in bases}
        again = methods.compared(name, seconds)
        assert found["row_cost"]["times"] == pytest.approx(again["row_cost"]["times"], rel=1e-3)
        for case, row in found["cases"].items():
            assert row["times"] == pytest.approx(again["cases"][case]["times"], rel=1e-3)


# ---------------------------------------------------------------------- the methods on the toy tasks


def test_an_arm_is_its_presets_method_in_the_toys_sizes():
    config, toy = toy_methods.toy_config("mt50-moore-ars", 3), load_preset("toy")
    assert config.policy.net_arch == (64, 64) and config.policy.body_options["n_experts"] == 6
    assert config.ars.param_resets == [6000] and config.ars.reward_scaling == "mean"
    assert (config.seed, config.env, config.algorithm.batch_size) == (3, toy.env, toy.algorithm.batch_size)
    soft = toy_methods.toy_config("mt10-soft-modules", 0).policy.body_options
    assert (soft["n_layers"], soft["n_modules"], soft["module_width"], soft["gate_width"]) == (2, 4, 32, 64)
    adapters = toy_methods.toy_config("mt10-ars-lora", 0).ars
    assert adapters.lora["rank"] == 4 and adapters.param_resets == [6000, 18_000]
    smt = toy_methods.toy_config("mt10-smt", 0)
    assert (smt.schedule.name, smt.schedule.pool_size, smt.algorithm.train_freq) == ("smt", 2, 2)
    assert smt.ars.reset == "actor_critic" and smt.ars.reset_times(24_000, 4) == []
    hard = toy_methods.toy_config("mt10-ablation-fixed-100-hard", 0).ars
    assert hard.reward_scaling == {"point-west": 100.0, "point-south": 100.0}
    assert toy_methods.toy_config("mt10-tqc", 0).algorithm.algorithm == "ARSTQC"
    assert toy_methods.toy_config("mt10-pcgrad", 0).ars.gradient == "pcgrad"
    assert toy_methods.toy_config("mt10-popart-100", 0).policy.critic_body_options["update_period"] == 100


def test_no_two_arms_are_the_same_and_all_have_the_same_budget():
    configs = [toy_methods.arm_config(arm, 0) for arm in toy_methods.ARMS]
    assert len({repr(config) for config in configs}) == len(configs)
    assert {
        (c.algorithm.total_timesteps, c.algorithm.learning_rate, c.algorithm.batch_size) for c in configs
    } == {(toy_methods.TOTAL_TIMESTEPS, toy_methods.LEARNING_RATE, 64)}


def test_the_toy_table_goes_on_where_it_stopped_and_keeps_what_succeeded(tmp_path, capsys):
    # a reset at a quarter of so few steps falls in the random phase, which is refused; without resets they are enough
    run = functools.partial(
        toy_methods.measure, seeds=1, processes=1, folder=tmp_path, fresh=False, total_timesteps=400
    )
    assert run(["sac", "ars"]) == ["ars, seed 0"]
    assert "param_resets asks for 1 resets" in capsys.readouterr().err
    path = tmp_path / "toy_methods.json"
    written = path.read_text()
    (stored,) = json.loads(written)["runs"]["sac"].values()
    assert len(stored["success"]) == 4 and stored["updates"] == 36 and stored["seconds"] > 0
    assert run(["sac"]) == [] and "1 runs, 1 of them are in the file already" in capsys.readouterr().out
    assert path.read_text() == written
    with pytest.raises(SystemExit, match="--fresh"):
        run(["sac"], total_timesteps=800)


def fake_toy_results():
    runs = {
        "0": {"success": [1.0, 1.0, 0.5, 0.1], "seconds": 2.0},
        "1": {"success": [1.0, 0.8, 0.5, 0.3], "seconds": 4.0},
    }
    return {"runs": {"sac": runs, "moore-ars": runs}, "reward_scales": [10, 1, 0.1, 0.1]}


def test_the_methods_tables_come_from_the_files_alone():
    seconds = {"sac-mt10": [1.0], "sac-mt10-at-50": [4.0], "moore-mt10": [3.0], "moore-mt10-at-50": [18.0]}
    cost = methods.compared("moore", seconds)
    for row in cost["cases"].values():
        row |= {"peak_bytes": 2e6, "times_baseline_bytes": 1.5, "learned_parameters": 1234}
    results = {"toy_methods": fake_toy_results(), "methods": {"methods": {"moore": cost}}}
    overview = report.render("methods", results)
    assert "| [MOORE](methods/moore.md) | ? | 0.65 (0.20) | 3.00 | 1.50 | 4.50 | 1.50 |" in overview
    assert "| [SMT](methods/smt.md) | ? | - | ? | ? | ? | ? |" in overview
    of_page = report.render("toy-moore", results).splitlines()[2:]
    assert of_page == [
        "| SAC-MT | 1.00 | 0.90 | 0.50 | 0.20 | 0.65 | 0.10 | 2 |",
        "| ARS + MOORE | 1.00 | 0.90 | 0.50 | 0.20 | 0.65 | 0.10 | 2 |",
    ]
    assert (
        "| MOORE, 10 tasks, same network | 3000 ms | 3.00 | 3.00 to 3.00 | 2 MB | 1.50 | 1,234 |"
        in report.render("cost-moore", results)
    )
    assert report.render("toy-moore", {}) == report.render("cost-moore", {}) == report.UNMEASURED
    with pytest.raises(KeyError, match=r"no block 'toy-more'.*PAGE one of .*moore"):
        report.render("toy-more", results)


# ---------------------------------------------------------------------- the run on a GPU, on the CPU


def toy_config():
    preset = load_preset("toy")
    return dataclasses.replace(
        preset,
        algorithm=dataclasses.replace(
            preset.algorithm, device="cpu", total_timesteps=800, batch_size=8, stats_window_size=5
        ),
        ars=dataclasses.replace(preset.ars, param_resets=[400], updates_after_reset=3),
        policy=dataclasses.replace(preset.policy, net_arch=(8, 8)),
        evaluation=dataclasses.replace(preset.evaluation, n_episodes=1, every=400),
    )


def test_the_gpu_run_stops_at_its_budget_goes_on_and_leaves_small_files(tmp_path, monkeypatch):
    run, output = tmp_path / "run", tmp_path / "output"
    clock = itertools.count()
    monkeypatch.setattr(gpu_mt10, "monotonic", lambda: float(next(clock)))  # a second passes at every look
    part = gpu_mt10.run(toy_config(), "toy", run, output, time_budget=100.0)
    assert not part["finished"] and part["timesteps"] < 800 and (run / "replay_buffer.pkl").is_file()
    whole = gpu_mt10.run(toy_config(), "toy", run, output, checkpoint_every=0.0)
    assert whole["finished"] and whole["timesteps"] == 800 and whole["parts"] == 2 and whole["resets"] == 1
    assert [row["timesteps"] for row in whole["curve"]] == [400, 800]
    assert whole["steps_per_second"] == pytest.approx(800 / whole["training_seconds"])
    assert whole["updates_per_second"] > 0 and whole["gpu_idle_share"] is None
    assert [steps for steps, _ in whole["reward_scale_history"]][-1] == 400
    names = {"gpu_mt10.json", "gpu_mt10_curve.csv", "gpu_mt10.png", "gpu_mt10_policy.zip"}
    assert {path.name for path in output.iterdir()} == names
    assert len((output / "gpu_mt10_curve.csv").read_text().splitlines()) == 3
    assert report.render("gpu_mt10", report.read_results(output)).count("\n") == 9
    with pytest.raises(ConfigError, match="finished"):
        gpu_mt10.run(toy_config(), "toy", run, output)


def test_the_gpus_idle_share_comes_from_what_nvidia_smi_says(tmp_path, monkeypatch):
    command = tmp_path / "nvidia-smi"
    command.write_text("#!/bin/sh\necho '90, 5000'\necho '[N/A], [N/A]'\necho '50, 4000'\nexec sleep 60\n")
    command.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(
        gpu_mt10.th.cuda, "get_device_properties", lambda device: types.SimpleNamespace(uuid="0123")
    )
    progress = gpu_mt10.Progress(seconds=10.0)
    with gpu_mt10.GpuSampler(progress, gpu_mt10.th.device("cuda")):
        deadline = time.monotonic() + 10
        while len(progress.gpu_busy) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
    assert progress.gpu_busy == [90.0, 50.0] and progress.gpu_memory_mb == 5000.0
    model = types.SimpleNamespace(num_timesteps=1000, _n_updates=90)
    found = gpu_mt10.figures(progress, model, toy_config())
    assert found["gpu_idle_share"] == pytest.approx(0.3) and found["steps_per_second"] == 100.0


def test_the_kept_policy_predicts_as_the_whole_one_and_is_small(tmp_path):
    model = ARSSAC(
        "MlpPolicy", env := make_toy_env(seed=0), policy_kwargs={"net_arch": [64, 64]}, batch_size=8
    )
    model.save(tmp_path / "whole")
    gpu_mt10.keep_policy("ARSSAC", tmp_path / "whole.zip", tmp_path / "kept.zip")
    kept = ARSSAC.load(tmp_path / "kept", device="cpu")
    obs = env.reset()
    assert np.array_equal(kept.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    assert (tmp_path / "kept.zip").stat().st_size < 0.5 * (tmp_path / "whole.zip").stat().st_size


def test_the_gpu_run_names_the_remedy_without_a_gpu(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_mt10.th.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match="--device cpu"):
        gpu_mt10.main(
            ["--preset", "toy", "--run", str(tmp_path / "run"), "--output", str(tmp_path / "output")]
        )


def test_the_bar_is_held_against_the_papers_preset_alone():
    result = {
        "preset": "toy",
        "finished": True,
        "timesteps": 1,
        "minutes_for_the_whole_run": 30.0,
        "mean_success": 0.98,
    }
    assert gpu_mt10.goals(result) == []
    minutes, success = gpu_mt10.goals({**result, "preset": "mt10-ars-ln"})
    assert not minutes["reached"] and "measured" in minutes["goal"] and success["reached"]
    (minutes,) = gpu_mt10.goals({**result, "preset": "mt10-ars-ln", "finished": False})
    assert "extrapolated" in minutes["goal"]
    assert json.dumps([minutes, success])
