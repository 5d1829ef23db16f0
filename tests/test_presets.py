"""The presets: which there are, what the paper reports of them, what each changes, and `sb3-ars list`."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml

from sb3_ars import make_multitask_env
from sb3_ars.cli import main
from sb3_ars.envs.toy import PointTask
from sb3_ars.errors import ConfigError
from sb3_ars.experiments import PRESETS, find_presets, preset_info, preset_names
from sb3_ars.experiments.catalogue import preset_values
from sb3_ars.experiments.config import load_config, load_preset, save_config
from sb3_ars.experiments.runner import build_model, protocol_of

BENCHES = {"mt10": 10, "mt50": 50}
HARD_TASKS = ("push", "pick-place", "shelf-place", "basketball")
# the paper's rows: Table 1 (MT10) and Table 2 (MT50, k = 50) side by side, then what is on one benchmark only
MAIN_TABLES = {
    "sac": ("69.4 ± 0.8", "47.6 ± 2.0"),
    "mh": ("77.2 ± 11.9", "47.2 ± 1.7"),
    "soft-modules": ("74.4 ± 10.5", "54.1 ± 7.6"),
    "pcgrad": ("74.8 ± 13.7", "51.9 ± 8.5"),
    "paco": ("82.4 ± 14.2", "55.6 ± 9.1"),
    "moore": ("86.0 ± 4.8", "64.2 ± 3.1"),
    "smt": ("86.8 ± 8.6", "56.0 ± 8.0"),
    "ars": ("97.3 ± 2.1", "65.9 ± 2.9"),
    "ars-ln": ("98.6 ± 1.5", "78.3 ± 3.7"),
    "ars-lora": ("99.5 ± 0.8", "83.2 ± 1.8"),
    "ars-lora-paper": ("99.5 ± 0.8", "83.2 ± 1.8"),
}
OTHER_TABLES = {
    "3": {
        "mt10-pcgrad-ars": "95.9 ± 2.6", "mt10-soft-modules-ars": "98.8 ± 1.3", "mt10-moore-ars": "98.0 ± 0.4",
        "mt50-pcgrad-ars": "72.4 ± 2.6", "mt50-soft-modules-ars": "75.5 ± 3.6", "mt50-moore-ars": "84.6 ± 1.6",
    },
    "4": {"mt10-ablation-no-reset": "69.8 ± 8.1", "mt10-ablation-no-scaling": "70.3 ± 0.5"},
    "5": {"mt10-ablation-normalization": "82.4 ± 27.9", "mt10-ablation-std": "94.3 ± 7.1"},
    "6": {
        "mt50-ars-ln-512": "84.2 ± 1.7", "mt50-ars-ln-800": "88.0 ± 2.9", "mt50-ars-ln-1024": "88.9 ± 2.6",
        "mt50-ars-512": "73.6 ± 4.4", "mt50-ars-800": "75.1 ± 3.8", "mt50-ars-1024": "78.7 ± 2.9",
        "mt50-sac-512": "48.8 ± 2.6", "mt50-sac-800": "47.2 ± 1.7", "mt50-sac-1024": "45.5 ± 2.4",
    },
    "9": {"mt10-ablation-critic-only": "96.3 ± 2.3"},
    "10": {
        "mt10-popart-1": "67.1 ± 12.8", "mt10-popart-10": "73.3 ± 7.6",
        "mt10-popart-100": "75.0 ± 6.3", "mt10-popart-500": "71.5 ± 7.8",
    },
    "11": {
        "mt10-ars-ln-h150": "98.4 ± 1.5", "mt10-paco-h150": "85.4 ± 4.5", "mt10-moore-h150": "88.7 ± 5.6",
        "mt50-ars-ln-h150": "83.3 ± 4.3", "mt50-ars-ln-800-h150": "89.8 ± 1.6", "mt50-ars-ln-1024-h150": "91.0 ± 2.4",
        "mt50-paco-h150": "57.3 ± 1.3", "mt50-moore-h150": "72.9 ± 3.3",
    },
    "Fig. 1": {f"single-{task}-scale-{scale}": None for task in HARD_TASKS for scale in (1, 100)},
    "Fig. 2": {"mt10-ablation-fixed-100": None, "mt10-ablation-fixed-100-hard": None},
    "Fig. 11": {f"mt10-ablation-n-reset-{n}": None for n in range(1, 10)},
}  # fmt: skip
PAPER = {
    f"{bench}-{method}": (table, numbers[column])
    for method, numbers in MAIN_TABLES.items()
    for column, (bench, table) in enumerate((("mt10", "1"), ("mt50", "2")))
} | {name: (table, success) for table, rows in OTHER_TABLES.items() for name, success in rows.items()}
NOT_IN_THE_PAPER = {"toy", "demo"} | {
    f"{bench}-{method}"
    for bench in BENCHES
    for method in (
        "mh-ars",
        "paco-ars",
        "tqc",
        "tqc-ars",
        *(f"soft-modules-{variant}{ars}" for variant in ("reweighted", "2x2") for ars in ("", "-ars")),
        *((f"popart-{period}" for period in (1, 10, 100, 500)) if bench == "mt50" else ()),
    )
}


def test_there_is_a_preset_for_every_cell_of_the_papers_tables_and_no_other():
    names = preset_names()
    assert len(names) == len(set(names)) and set(names) == PAPER.keys() | NOT_IN_THE_PAPER


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_loads_survives_being_written_and_says_what_it_is(name, tmp_path):
    config = load_preset(name)
    save_config(config, tmp_path / "config.yaml")
    assert load_config(tmp_path / "config.yaml") == config
    info = preset_info(name)
    assert info.name == name and 10 < len(info.description) < 50 and "\n" not in info.description
    assert info.total_timesteps == config.algorithm.total_timesteps
    assert (info.table, info.success) == PAPER.get(name, (None, None))


def test_a_preset_inherits_options_but_neither_description_nor_the_papers_number():
    assert load_preset("mt10-ablation-n-reset-4") == load_preset("mt10-ars")
    own, parent = preset_info("mt10-ablation-n-reset-4"), preset_info("mt10-ars")
    assert own.description != parent.description and own.success is None and parent.success
    child = yaml.safe_load((PRESETS / "mt50-popart-1.yaml").read_text())
    assert (
        child["extends"] == "mt50-sac"
        and preset_info("mt50-sac").table
        and preset_info("mt50-popart-1").table is None
    )


def test_values_of_a_preset_are_the_callers_own():
    preset_values("mt10-ars")["ars"]["n_reset"] = 99
    assert load_preset("mt10-ars").ars.n_reset == load_preset("mt10-moore-ars").ars.n_reset == 4


def test_paper_presets_have_the_papers_numbers():
    # paper, Tables 7 and 8
    for bench, steps, resets, buffer in (
        ("mt10", 20_000_000, 4, 1_000_000),
        ("mt50", 100_000_000, 6, 500_000),
    ):
        config = load_preset(f"{bench}-ars-ln")
        algorithm = config.algorithm
        assert (algorithm.total_timesteps, config.ars.n_reset, algorithm.buffer_size) == (
            steps,
            resets,
            buffer,
        )
        assert (algorithm.batch_size, algorithm.learning_rate, algorithm.gamma, algorithm.tau) == (
            100,
            3e-4,
            0.99,
            0.005,
        )
        assert config.policy.net_arch == (400,) * 4 and config.policy.critic_layer_norm
        assert (config.policy.actor_activation, config.policy.critic_activation) == ("relu", "tanh")
        assert config.env.tasks == bench.upper() and config.env.max_episode_steps == 500
        assert protocol_of(config).name == "paper"


def flat(value, prefix=""):
    if not dataclasses.is_dataclass(value):
        return {prefix: value}
    parts = (
        flat(getattr(value, f.name), f"{prefix}.{f.name}".lstrip(".")) for f in dataclasses.fields(value)
    )
    return {key: item for part in parts for key, item in part.items()}


def difference(name, parent):
    """Return the options in which a preset differs from another, with the preset's values."""
    ours, theirs = flat(load_preset(name)), flat(load_preset(parent))
    return {key: value for key, value in ours.items() if value != theirs[key]}


SMT = {"algorithm.train_freq": 3, "ars.reset": "actor_critic", "schedule.name": "smt"}


def on_both(bench, buffer, n_experts, n_sets, n_reset, rank, start, min_success):
    """Yield the presets both benchmarks have: name, the one it is a variant of, what its name says and nothing else."""
    yield (
        f"{bench}-sac",
        f"{bench}-ars",
        {"ars.n_reset": 0, "ars.reward_scaling": "none", "ars.reset": "none"},
    )
    yield f"{bench}-ars-ln", f"{bench}-ars", {"policy.critic_layer_norm": True}
    lora = {"rank": rank, "start": start, "min_success": min_success}
    shared = {
        "per_task": False,
        "scale": "paper",
        "layers": "hidden",
        "min_success": 0,
        "rescale_critic": False,
    }
    yield f"{bench}-ars-lora", f"{bench}-ars-ln", {"ars.lora": lora}
    yield (
        f"{bench}-ars-lora-paper",
        f"{bench}-ars-ln",
        {"ars.lora": {**lora, **shared}, "ars.n_reset": n_reset},
    )
    for period in (1, 10, 100, 500):
        popart = {"policy.critic_body": "popart", "policy.critic_body_options": {"update_period": period}}
        yield f"{bench}-popart-{period}", f"{bench}-sac", popart
    for ars, parent, max_task_loss in (("", f"{bench}-sac", 1e5), ("-ars", f"{bench}-ars", 1e9)):
        yield f"{bench}-mh{ars}", parent, {"policy.body": "multi_head", "policy.critic_body": "plain"}
        yield f"{bench}-pcgrad{ars}", parent, {"ars.gradient": "pcgrad"}
        yield f"{bench}-tqc{ars}", parent, {"algorithm.algorithm": "ARSTQC", "ars.actor_value": "all"}
        moore = {"policy.net_arch": (400,) * 3, "policy.body_options": {"n_experts": n_experts}}
        moore |= {"policy.std": "exp", "ars.actor_value": "all"}
        yield f"{bench}-moore{ars}", parent, {"policy.body": "moore", **moore}
        paco = {"policy.body_options": {"n_parameter_sets": n_sets}, "ars.max_task_loss": max_task_loss}
        yield f"{bench}-paco{ars}", parent, {"policy.body": "paco", **paco}
        modules = {"policy.body_options": {"n_layers": 4, "n_modules": 4, "module_width": 128}}
        soft = f"{bench}-soft-modules"
        yield (
            f"{soft}{ars}",
            parent,
            {"policy.body": "soft_modules", "policy.net_arch": (400, 400), **modules},
        )
        modules = {"policy.body_options": {"n_layers": 2, "n_modules": 2, "module_width": 256}}
        yield f"{soft}-2x2{ars}", f"{soft}{ars}", modules
        yield f"{soft}-reweighted{ars}", f"{soft}{ars}", {"ars.task_weighting": "temperature"}
    h150 = {"env.max_episode_steps": 150, "algorithm.buffer_size": buffer, "evaluation.protocol": "h150"}
    yield f"{bench}-moore-h150", f"{bench}-moore", h150
    yield f"{bench}-paco-h150", f"{bench}-paco", {**h150, "ars.max_task_loss": 3e3}
    resets = {"ars.n_reset": 9} if bench == "mt50" else {}
    yield f"{bench}-ars-ln-h150", f"{bench}-ars-ln", {**h150, **resets}


A = "mt10-ablation-"
ONE_CHANGE = [  # as on_both yields them
    ("mt50-ars", "mt10-ars", {
        "env.tasks": "MT50", "algorithm.total_timesteps": 100_000_000, "algorithm.buffer_size": 500_000,
        "ars.n_reset": 6, "evaluation.every": 5_000_000,
    }),
    (A + "no-reset", "mt10-ars", {"ars.n_reset": 0}),
    (A + "no-scaling", "mt10-ars", {"ars.reward_scaling": "none"}),
    (A + "critic-only", "mt10-ars", {"ars.reset": "critic"}),
    (A + "std", "mt10-ars", {"ars.reward_scaling": "std"}),
    (A + "normalization", "mt10-ars", {"ars.reward_scaling": "normalization"}),
    (A + "fixed-100", "mt10-sac", {"ars.reward_scaling": 100.0}),
    (A + "fixed-100-hard", "mt10-sac", {
        "ars.reward_scaling": {"push-v3": 100.0, "pick-place-v3": 100.0, "peg-insert-side-v3": 100.0},
    }),
    *((f"{A}n-reset-{n}", "mt10-ars", {"ars.n_reset": n}) for n in range(1, 10) if n != 4),
    *(
        (f"single-{task}-scale-1", "mt10-sac", {
            "env.tasks": task, "algorithm.total_timesteps": 2_000_000, "ars.reward_scaling": 1.0,
            "evaluation.every": 100_000,
        })
        for task in HARD_TASKS
    ),
    *((f"single-{task}-scale-100", f"single-{task}-scale-1", {"ars.reward_scaling": 100.0}) for task in HARD_TASKS),
    *(
        (f"mt50-{method}-{width}", f"mt50-{method}", {"policy.net_arch": (width,) * 4})
        for method in ("sac", "ars", "ars-ln")
        for width in (512, 800, 1024)
    ),
    *((f"mt50-ars-ln-{w}-h150", "mt50-ars-ln-h150", {"policy.net_arch": (w,) * 4}) for w in (800, 1024)),
    *on_both("mt10", 500_000, n_experts=4, n_sets=5, n_reset=3, rank=8, start=0.75, min_success=0.8),
    *on_both("mt50", 200_000, n_experts=6, n_sets=20, n_reset=5, rank=16, start=0.833, min_success=0.65),
    ("mt10-smt", "mt10-sac", SMT),
    ("mt50-smt", "mt50-sac", {**SMT, "schedule.pool_size": 15, "schedule.interval": 75_000}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "parent", "expected"), ONE_CHANGE, ids=[name for name, *_ in ONE_CHANGE])
def test_a_preset_differs_from_what_it_varies_in_what_its_name_says(name, parent, expected):
    assert difference(name, parent) == expected


def test_every_preset_but_the_roots_is_held_to_its_difference():
    roots = {"toy", "demo", "mt10-ars", "mt10-ablation-n-reset-4"}
    assert {name for name, *_ in ONE_CHANGE} | roots == set(preset_names())


@pytest.mark.parametrize(("bench", "share"), [("mt10", 3 / 4), ("mt50", 5 / 6)])
def test_lora_begins_at_the_papers_share_of_the_run(bench, share):
    for name, n_before in ((f"{bench}-ars-lora", None), (f"{bench}-ars-lora-paper", share)):
        config = load_preset(name)
        total = config.algorithm.total_timesteps
        late = [
            t for t in config.ars.reset_times(total, BENCHES[bench]) if t >= config.ars.lora["start"] * total
        ]
        assert len(late) == 1, "adapters begin at one reset, and none renews them"
        assert n_before is None or late[0] == pytest.approx(n_before * total, abs=1)


@pytest.mark.parametrize("bench", BENCHES)
def test_smt_updates_about_as_often_per_environment_step_as_the_others(bench):
    config = load_preset(f"{bench}-smt")
    steps_per_update = (
        config.schedule.pool_size * config.algorithm.train_freq / config.algorithm.gradient_steps
    )
    assert steps_per_update == pytest.approx(BENCHES[bench], rel=0.11)


# ---------------------------------------------------------------------------------------------------- models


class WidePointTask(PointTask):
    """A toy task as wide as Meta-World's."""

    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (39,), np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (4,), np.float32)


@pytest.fixture(scope="module")
def envs():
    """An environment of 1, 10 and 50 tasks, three of them named as the hard ones."""
    names = ["push-v3", "pick-place-v3", "peg-insert-side-v3", *(f"task {i}" for i in range(47))]
    made = {
        n: make_multitask_env(dict.fromkeys(names[:n], WidePointTask), seed=0, n_workers=0)
        for n in (1, 10, 50)
    }
    yield made
    for env in made.values():
        env.close()


def n_tasks(config):
    return {"MT10": 10, "MT50": 50}.get(config.env.tasks, 1)


ACTOR_PARAMETERS = {  # from the layers' shapes
    "mt10-ars": 504_408, "mt50-ars": 520_408,
    "mt50-ars-512": 838_152, "mt50-ars-800": 2_000_808, "mt50-ars-1024": 3_249_160,
    "mt10-mh": 533_280, "mt50-mh-ars": 677_600,
    "mt10-soft-modules": 792_444, "mt50-soft-modules-ars": 808_444, "mt10-soft-modules-2x2": 691_022,
    "mt10-moore": 1_395_320, "mt50-moore-ars": 2_301_500,
    # K sets of 39-400-400-400-400-8, and w
    "mt10-paco": 5 * (40 * 400 + 3 * 401 * 400 + 401 * 8) + 10 * 5,
    "mt50-paco": 20 * (40 * 400 + 3 * 401 * 400 + 401 * 8) + 50 * 20,
    "mt10-popart-10": 504_408, "mt10-tqc": 504_408, "mt10-smt": 504_408, "mt10-ars-lora": 504_408,
}  # fmt: skip


@pytest.mark.parametrize("name", [name for name in preset_names() if name not in ("toy", "demo")])
def test_every_preset_builds_its_model(name, envs):
    config = load_preset(name)
    small = dataclasses.replace(config.algorithm, buffer_size=200, device="cpu", execution="eager")
    model = build_model(dataclasses.replace(config, algorithm=small), envs[n_tasks(config)])
    assert type(model).__name__ == config.algorithm.algorithm
    assert {key: getattr(model, key) for key in vars(config.ars)} == vars(config.ars)
    if name in ACTOR_PARAMETERS:
        assert sum(p.numel() for p in model.actor.parameters()) == ACTOR_PARAMETERS[name]


# ------------------------------------------------------------------------------------------------- sb3-ars list


def test_the_order_is_small_runs_mt10_its_ablations_single_tasks_mt50_with_numbers_as_numbers():
    names = preset_names()
    assert names[:3] == ["toy", "demo", "mt10-ars"]
    firsts = [
        names.index(name) for name in ("mt10-ars", "mt10-ablation-critic-only", "single-basketball-scale-1")
    ]
    assert firsts == sorted(firsts) and names.index("mt50-ars") > max(firsts)
    widths = [name for name in names if name in ("mt50-sac-512", "mt50-sac-800", "mt50-sac-1024")]
    assert widths == ["mt50-sac-512", "mt50-sac-800", "mt50-sac-1024"]


def test_list_shows_every_preset_on_a_line_with_its_length_and_the_papers_number(capsys):
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out, "no colour in a pipe"
    lines = {line.split()[0]: line for line in out.splitlines() if line.strip()}
    for name in preset_names():
        info = preset_info(name)
        for shown in (info.description, info.table or "", info.success or ""):
            assert shown in lines[name], (name, shown)
    assert lines["mt50-moore-ars"].split()[-5:] == ["100M", "3", "84.6", "±", "1.6"]
    assert " 48k" in lines["toy"] and " 2M " in lines["single-push-scale-1"]


def test_list_finds_presets_by_the_words_of_their_names(capsys):
    assert main(["list", "moore", "mt50"]) == 0
    found = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line.startswith("mt")]
    assert found == ["mt50-moore", "mt50-moore-ars", "mt50-moore-h150"] == find_presets(["mt50", "moore"])
    assert main(["list", "--help"]) == 0 and "WORD" in capsys.readouterr().out
    assert main(["list", "--filter"]) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["mooore"], r"No preset has 'mooore' in its name\. Did you mean 'moore'\?"),
        (["mt10-mooore"], r"Did you mean 'mt10-moore'\?"),
        (
            ["popart", "mt20"],
            r"'mt20' in its name among the 8 that fit the words before it\. Did you mean 'mt\d0'\?",
        ),
    ],
)
def test_a_word_no_preset_has_is_refused_with_the_nearest(words, message, capsys):
    with pytest.raises(ConfigError, match=message):
        find_presets(words)
    assert main(["list", *words]) == 2 and "error: No preset has" in capsys.readouterr().err


@pytest.mark.parametrize("width", [80, 100])
def test_list_fits_the_terminal(width, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr(type(sys.stdout), "isatty", lambda self: True, raising=False)
    assert main(["list", "mt10"]) == 0
    out = re.sub(r"\x1b\[\d*m", "", capsys.readouterr().out)
    lines = [line.rstrip() for line in out.splitlines()]
    table = lines[: lines.index("", 1)]
    assert max(map(len, table)) <= width
    rows = [line.split()[0] for line in lines if line.startswith("mt10-")]
    assert rows == find_presets(["mt10"]), "names are never broken"
    assert width == 80 or len(table) == 1 + sum("ablation" not in name for name in rows), (
        "nor are lines at 100"
    )


def test_list_loads_no_torch_and_needs_no_preset_names_in_the_usage():
    script = "import sys; from sb3_ars.cli import main; main(['list', 'toy']); main([]); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "sb3-ars list" in done.stdout and "mt10-ars" not in done.stdout
    assert done.stdout.strip().endswith("False")


def test_every_file_in_the_folder_is_a_preset_that_ships():
    files = {path.name for path in PRESETS.iterdir()}
    assert files == {f"{name}.yaml" for name in preset_names()}
    assert "experiments/presets/*.yaml" in (Path(__file__).parent.parent / "setup.cfg").read_text()
