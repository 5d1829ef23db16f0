"""Presets, the command, the run folder, the figure."""

import dataclasses
import json
import subprocess
import sys

import pandas as pd
import pytest
import torch as th
import yaml

from sb3_ars import ARSSAC
from sb3_ars.cli import main
from sb3_ars.errors import ConfigError, WorkerError
from sb3_ars.experiments import preset_names
from sb3_ars.experiments.config import RunConfig, load_config, load_preset, save_config
from sb3_ars.experiments.runner import build_model, protocol_of, train


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


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_loads_and_survives_being_written(name, tmp_path):
    config = load_preset(name)
    save_config(config, tmp_path / "config.yaml")
    assert load_config(tmp_path / "config.yaml") == config


def test_the_presets_that_must_exist_do():
    assert {
        "demo",
        "toy",
        "mt10-sac",
        "mt10-ars",
        "mt10-ars-ln",
        "mt50-sac",
        "mt50-ars",
        "mt50-ars-ln",
    } <= set(preset_names())


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
        plain = load_preset(f"{bench}-sac").ars
        assert (plain.n_reset, plain.reward_scaling, plain.reset) == (0, "none", "none")
        assert not load_preset(f"{bench}-ars").policy.critic_layer_norm


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


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_has_readable_help(name, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["train", name, "--help"])
    assert exit_.value.code == 0 and "--ars.reward-scaling" in capsys.readouterr().out


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
    assert "sb3-ars train PRESET" in done.stdout and "mt10-ars-ln" in done.stdout
    assert done.stdout.strip().endswith("0 False")


def test_doctor_reports_and_its_exit_status_says_whether_all_is_well(capsys):
    status = main(["doctor"])
    out = capsys.readouterr().out
    assert "Meta-World" in out and "mujoco" in out and "rendering" in out
    assert status == (1 if "!!" in out else 0)


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
    with pytest.raises(SystemExit) as exit_:
        main(["train", "mt10-ars", "--ars.n-reset", "-1"])
    assert exit_.value.code == 2
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
