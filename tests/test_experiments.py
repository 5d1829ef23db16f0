"""Presets, the command, the run folder, the figure."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml

from sb3_ars import ARSSAC, load_policy
from sb3_ars.cli import main
from sb3_ars.errors import ConfigError, WorkerError
from sb3_ars.experiments import runner
from sb3_ars.experiments.config import RunConfig, ScheduleConfig, load_config, load_preset, save_config
from sb3_ars.experiments.run_folder import write_json
from sb3_ars.experiments.runner import build_model, train
from sb3_ars.files import write_whole


def tiny_toy(**algorithm):
    preset = load_preset("toy")
    changes = {"total_timesteps": 800, "batch_size": 8, **algorithm}
    return dataclasses.replace(
        preset,
        algorithm=dataclasses.replace(preset.algorithm, **changes),
        evaluation=dataclasses.replace(preset.evaluation, n_episodes=2, every=400),
        ars=dataclasses.replace(preset.ars, param_resets=(400,), updates_after_reset=3),
        policy=dataclasses.replace(preset.policy, net_arch=(8,)),
    )


@pytest.mark.parametrize("algorithm", ["ARSSAC", "ARSTQC"])
def test_a_run_leaves_a_complete_folder(algorithm, tmp_path, capsys):
    config = dataclasses.replace(tiny_toy(algorithm=algorithm), output=tmp_path)
    result = train(config, "toy", progress_bar=False)
    assert result.folder == tmp_path / "toy-seed0"
    files = {path.name.split(".vm")[0] for path in result.folder.iterdir()}
    for name in (
        "config.yaml",
        "versions.json",
        "progress.csv",
        "policy.zip",
        "policy.safetensors",
        "best_model.zip",
        "evaluations.npz",
        "evaluation.csv",
        "result.json",
        "training.png",
    ):
        assert name in files, name
    summary = json.loads((result.folder / "result.json").read_text())
    assert summary["timesteps"] == 800 and summary["resets"] == 1 and not summary["interrupted"]
    assert list(summary["tasks"]) == ["point-east", "point-north", "point-west", "point-south"]
    assert summary["protocol"] == "protocol toy: 2 episodes per task, horizon 50"
    assert load_config(result.folder / "config.yaml") == config
    log = pd.read_csv(result.folder / "progress.csv")
    for key in ("success", "return", "reward_scale", "mean_reward", "q_value", "ent_coef"):
        assert f"{key}/point-west" in log, key
    assert json.loads((result.folder / "versions.json").read_text())["packages"]["torch"]


def test_a_run_leaves_its_policy_as_a_file_to_share(run):
    policy, model = load_policy(run / "policy.safetensors"), ARSSAC.load(run / "policy.zip")
    obs = np.random.default_rng(0).uniform(-1, 1, (8, 6))
    for task in model.task_names:
        expected, _ = model.predict(obs, deterministic=True, task=task)
        np.testing.assert_array_equal(policy.predict(obs, deterministic=True, task=task)[0], expected)


def test_a_run_whose_policy_cannot_be_shared_is_kept_all_the_same(tmp_path, monkeypatch):
    def refuse(model, path):
        raise ConfigError("it cannot be said without code.")

    monkeypatch.setattr(runner, "export_policy", refuse)
    config = dataclasses.replace(tiny_toy(), output=tmp_path)
    with pytest.warns(UserWarning, match=r"has no policy\.safetensors: it cannot be said without code\."):
        result = train(config, "toy", progress_bar=False)
    files = {path.name for path in result.folder.iterdir()}
    assert "policy.safetensors" not in files and files >= {"policy.zip", "result.json"}


def test_a_second_run_gets_a_folder_of_its_own(tmp_path):
    config = dataclasses.replace(tiny_toy(total_timesteps=600), output=tmp_path)
    assert [train(config, "toy", progress_bar=False).folder.name for _ in range(2)] == [
        "toy-seed0",
        "toy-seed0-2",
    ]


def stopped_by(error, at, monkeypatch):
    """Make training raise once it has come to a step."""
    original = ARSSAC.train

    def train_until(self, *args, **kwargs):
        if self.num_timesteps >= at:
            raise error
        original(self, *args, **kwargs)

    monkeypatch.setattr(ARSSAC, "train", train_until)


def test_an_interrupted_run_is_kept(tmp_path, monkeypatch):
    stopped_by(KeyboardInterrupt(), 500, monkeypatch)
    folder = train(dataclasses.replace(tiny_toy(), output=tmp_path), "toy", progress_bar=False).folder
    summary = json.loads((folder / "result.json").read_text())
    assert summary["interrupted"] and summary["timesteps"] == 500 and (folder / "policy.zip").is_file()


def test_a_run_that_fails_keeps_what_was_learned(tmp_path, monkeypatch, capsys):
    stopped_by(WorkerError("the env died"), 500, monkeypatch)
    with pytest.raises(WorkerError):
        train(dataclasses.replace(tiny_toy(), output=tmp_path), "toy", progress_bar=False)
    assert "failed at step 500" in capsys.readouterr().out
    assert ARSSAC.load(tmp_path / "toy-seed0" / "policy.zip").num_timesteps == 500


def test_a_run_that_never_began_leaves_no_folder(tmp_path):
    config = tiny_toy()
    config = dataclasses.replace(
        config, output=tmp_path, ars=dataclasses.replace(config.ars, param_resets=(5,))
    )
    with pytest.raises(ConfigError, match="param_resets"):
        train(config, "toy", progress_bar=False)
    assert list(tmp_path.iterdir()) == []


# one for each kind of default: None, mappings, numbers by task, a schedule
KINDS = (
    "toy",
    "mt10-ars",
    "mt10-ars-lora",
    "mt10-ablation-fixed-100-hard",
    "mt50-moore-ars",
    "mt10-popart-10",
    "mt10-smt",
)


@pytest.mark.parametrize("name", KINDS)
def test_presets_have_readable_help(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    with pytest.raises(SystemExit) as exit_:
        main(["train", name, "--help"])
    out = capsys.readouterr().out
    assert exit_.value.code == 0 and "subcommands" not in out
    for option in (
        "ars.reward-scaling",
        "ars.lora",
        "ars.max-task-loss",
        "schedule.name",
        "policy.body-options",
    ):
        assert f"--{option} " in out, option


@pytest.mark.parametrize(
    ("name", "arguments", "changes"),
    [
        ("mt10-ars", "--ars.max-task-loss 3000", {"ars": {"max_task_loss": 3000.0}}),
        ("mt10-ars", "--ars.task-weighting temperature", {"ars": {"task_weighting": "temperature"}}),
        ("mt10-ars", "--ars.lora rank 4 per_task False start 0.5 scale paper", {
            "ars": {"lora": {"rank": 4, "per_task": False, "start": 0.5, "scale": "paper"}},
        }),
        ("mt10-ars-lora", "--ars.lora None", {"ars": {"lora": None}}),
        ("mt10-ars", "--ars.reward-scaling push-v3 100 reach-v3 2", {
            "ars": {"reward_scaling": {"push-v3": 100.0, "reach-v3": 2.0}},
        }),
        ("mt10-ablation-fixed-100-hard", "--ars.reward-scaling 7", {"ars": {"reward_scaling": 7.0}}),
        ("mt10-moore", "--policy.body-options n_experts 6 task_in_input False", {
            "policy": {"body_options": {"n_experts": 6, "task_in_input": False}},
        }),
        ("mt10-sac", "--policy.critic-body popart --policy.critic-body-options update_period 7 rate 1e-3", {
            "policy": {"critic_body": "popart", "critic_body_options": {"update_period": 7, "rate": 0.001}},
        }),
        ("mt10-sac", "--schedule.name smt --schedule.pool-size 4 --algorithm.train-freq 2", {
            "schedule": {"name": "smt", "pool_size": 4}, "algorithm": {"train_freq": 2},
        }),
    ],
)  # fmt: skip
def test_the_command_line_builds_the_same_configuration_as_a_file(
    name, arguments, changes, tmp_path, monkeypatch
):
    built = []
    monkeypatch.setattr(runner, "train", lambda config, name: built.append(config) or stop())
    with pytest.raises(StopIteration):
        main(["train", name, *arguments.split()])
    save_config(load_preset(name), tmp_path / "config.yaml")
    values = yaml.safe_load((tmp_path / "config.yaml").read_text())
    for part, options in changes.items():
        values[part] |= options
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(values))
    assert built == [load_config(tmp_path / "config.yaml")]


def stop():
    raise StopIteration


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path, asked = tmp_path / "policy.zip", []

    def torn(temporary):
        asked.append(temporary)
        temporary.write_text("half")
        raise KeyboardInterrupt

    write_whole(path, lambda temporary: temporary.write_text("whole") and None)
    with pytest.raises(KeyboardInterrupt):
        write_whole(path, torn)
    assert path.read_text() == "whole" and list(tmp_path.iterdir()) == [path]
    # writers such as torch, matplotlib and imageio go by the suffix
    assert asked[0].suffix == ".zip" and asked[0].parent == tmp_path and asked[0] != path


def test_a_folder_is_written_whole_or_not_at_all(tmp_path):
    def torn(temporary):
        temporary.mkdir()
        (temporary / "half").write_text("")
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="full"):
        write_whole(tmp_path / "folder", torn)
    assert not list(tmp_path.iterdir())
    write_whole(tmp_path / "folder", lambda temporary: temporary.mkdir())
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_json_that_cannot_be_written_leaves_the_old_file(tmp_path):
    write_json(tmp_path / "result.json", {"seed": 1})
    with pytest.raises(TypeError):
        write_json(tmp_path / "result.json", {"seed": object()})
    assert json.loads((tmp_path / "result.json").read_text()) == {"seed": 1}
    assert len(list(tmp_path.iterdir())) == 1


def test_broken_run_folders_are_refused_by_name(tmp_path, capsys):
    (tmp_path / "config.yaml").write_text("env: [")
    assert main(["evaluate", str(tmp_path)]) == 2 and "not valid YAML" in capsys.readouterr().err
    (tmp_path / "config.yaml").write_text("env: 3")
    assert main(["evaluate", str(tmp_path)]) == 2 and "must be a mapping" in capsys.readouterr().err
    save_config(tiny_toy(), tmp_path / "config.yaml")
    assert main(["evaluate", str(tmp_path)]) == 2 and "policy.zip" in capsys.readouterr().err
    (tmp_path / "policy.zip").write_text("no zip")
    assert main(["evaluate", str(tmp_path)]) == 2 and "cannot be read as ARSSAC" in capsys.readouterr().err
    assert main(["evaluate", str(tmp_path), "--n-episodes", "0"]) == 2
    assert "n_episodes=0" in capsys.readouterr().err


@pytest.mark.skipif(th.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_missing_gpu_is_refused_not_replaced(capsys):
    assert main(["train", "toy", "--algorithm.device", "cuda"]) == 2
    assert "torch finds no GPU" in capsys.readouterr().err


def test_the_command_trains_and_evaluates(tmp_path, capsys):
    arguments = [
        "train",
        "toy",
        "--output",
        str(tmp_path),
        "--algorithm.total-timesteps",
        "800",
        "--ars.param-resets",
        "400",
    ]
    assert (
        main([*arguments, "--policy.net-arch", "8", "8", "--evaluation.n-episodes", "1", "--seed", "3"]) == 0
    )
    folder = tmp_path / "toy-seed3"
    out = capsys.readouterr().out
    assert "point-south" in out and "c_i" in out
    assert "training.png" in out and "policy.zip" in out
    assert load_config(folder / "config.yaml").policy.net_arch == (8, 8)
    assert main(["evaluate", str(folder), "--n-episodes", "2"]) == 0
    assert "protocol toy: 2 episodes per task" in capsys.readouterr().out
    assert (folder / "evaluation-toy.csv").is_file()


def test_help_is_instant_readable_and_loads_no_torch():
    script = "import sys; from sb3_ars.cli import main; code = main(['--help']); print(code, 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "sb3-ars train PRESET" in done.stdout and "sb3-ars list" in done.stdout
    assert done.stdout.strip().endswith("0 False")


def test_doctor_reports_and_its_exit_status_says_whether_all_is_well(capsys):
    status = main(["doctor"])
    out = capsys.readouterr().out
    assert "Meta-World" in out and "mujoco" in out and "rendering" in out
    assert status == (1 if "failure " in out else 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["trian"], "There is no command 'trian'"),
        (["train", "mt10-asr"], "Did you mean 'mt10-ars'?"),
        (["evaluate", "nowhere"], "does not exist"),
    ],
)
def test_a_mistake_on_the_command_line_is_one_line_that_names_it(arguments, message, capsys):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err and "Traceback" not in captured.err


def test_an_option_the_method_refuses_is_refused_on_the_command_line_too(capsys):
    assert main(["train", "mt10-ars", "--ars.n-reset", "-1"]) == 2
    assert "n_reset=-1 must be an integer of at least 0" in capsys.readouterr().err


def test_an_unwritable_folder_is_refused_before_training(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["train", "toy", "--output", str(tmp_path / "file")]) == 2
    assert "choose another --output" in capsys.readouterr().err


def test_an_unknown_key_in_a_configuration_is_refused(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump({"ars": {"n_rest": 3}}))
    with pytest.raises(ConfigError, match=r"'n_rest' is no option of ARSConfig.*Did you mean 'n_reset'"):
        load_config(path)


def test_a_configuration_reaches_the_model():
    from sb3_ars import make_toy_env

    config = RunConfig(
        policy=dataclasses.replace(RunConfig().policy, net_arch=(8,), critic_layer_norm=True, std="softplus"),
        algorithm=dataclasses.replace(
            RunConfig().algorithm, precision="bf16", execution="fused", overlap=True
        ),
    )
    model = build_model(config, make_toy_env(seed=0))
    assert type(model.critic.qf0[0]).__name__ == "LayerNorm" and model.policy.std == "softplus"
    assert model._plan.execution == "fused" and model._plan.bf16 and model._plan.overlap
    assert (
        model.actor.optimizer.param_groups[0]["fused"]
        and model.batch_size == 100
        and model.actor_value == "all"
    )


@pytest.mark.parametrize(
    ("part", "options", "message"),
    [
        ("algorithm", {"train_freq": 0}, "algorithm.train_freq=0 must be an integer of at least 1"),
        ("policy", {"body_options": {"n_experts": 3}}, "policy.body is plain; name one, such as moore"),
        (
            "policy",
            {"critic_body_options": {"rate": 0.1}},
            "policy.critic_body is same; name one, such as popart",
        ),
        ("schedule", {"name": "smt", "pool_size": 0}, "pool_size=0 must be an integer of at least 1"),
        ("ars", {"lora": {"rnk": 3}}, "lora has no option 'rnk'.*Did you mean 'rank'"),
    ],
)
def test_options_that_cannot_work_are_refused_when_the_configuration_is_read(
    part, options, message, tmp_path
):
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({part: options}))
    with pytest.raises(ConfigError, match=message):
        load_config(tmp_path / "config.yaml")


def test_a_critic_body_gets_its_own_options_and_not_the_actors():
    from sb3_ars import make_toy_env

    policy = dataclasses.replace(
        tiny_toy().policy,
        body="moore",
        body_options={"n_experts": 2},
        critic_body="multi_head",
        critic_body_options={"task_in_input": False},
    )
    model = build_model(dataclasses.replace(tiny_toy(), policy=policy), make_toy_env(seed=0))
    assert model.policy.body == {"name": "moore", "n_experts": 2}
    assert model.policy.critic_body == {"name": "multi_head", "task_in_input": False}


def test_a_scheduled_run_collects_from_the_pool_and_updates_every_train_freq_steps(tmp_path):
    config = tiny_toy(total_timesteps=2_000, learning_starts=400, train_freq=2)
    config = dataclasses.replace(
        config,
        log_interval=1,
        schedule=ScheduleConfig(name="smt", pool_size=1, first_stage=1.0, interval=100, window=2),
        ars=dataclasses.replace(config.ars, param_resets=None, n_reset=0, updates_after_reset=0),
        output=tmp_path,
    )
    result = train(config, "toy", progress_bar=False)
    summary = json.loads((result.folder / "result.json").read_text())
    log = pd.read_csv(result.folder / "progress.csv")
    assert set(log["schedule/n_training"].dropna()) == {1} and summary["timesteps"] == 2_000
    # one task steps at a time, so 2 environment steps between updates after the random phase
    assert summary["updates"] == pytest.approx((2_000 - 400) / 2, abs=4)
    assert load_config(result.folder / "config.yaml").schedule == config.schedule


def test_a_schedule_that_cannot_work_is_refused_before_training(tmp_path):
    config = dataclasses.replace(
        tiny_toy(), schedule=ScheduleConfig(name="smt", pool_size=4), output=tmp_path
    )
    with pytest.raises(ConfigError, match="pool_size=4 holds all 4 tasks"):
        train(config, "toy", progress_bar=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"schedule": {"name": "SMT"}}, "name='SMT' is unknown; choose one of none, smt"),
        (
            {"schedule": {"pool_size": 2}},
            "schedule.pool_size=2 goes with a schedule, but schedule.name is none",
        ),
        (
            {"policy": {"body": "moore", "body_options": {"name": "paco"}}},
            "body_options=.* its name not among them",
        ),
        ({"policy": {"body": "moore", "body_options": [4]}}, "body_options=.* must be a mapping"),
        ({"policy": {"net_arch": [8, 0]}}, "policy.net_arch entry=0 must be an integer of at least 1"),
        ({"policy": {"net_arch": 8}}, "policy.net_arch=8 must be a list of widths"),
        (
            {"policy": {"actor_activation": "gelu"}},
            "actor_activation='gelu' is unknown; choose one of relu, tanh",
        ),
        ({"algorithm": {"algorithm": "SAC"}}, "algorithm='SAC' is unknown.*Did you mean 'ARSSAC'"),
    ],
)
def test_values_a_file_cannot_have_are_refused_by_name(values, message, tmp_path):
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match=message):
        load_config(tmp_path / "config.yaml")
