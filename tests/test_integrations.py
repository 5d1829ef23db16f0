"""RL Zoo, the hub, ONNX and W&B, used as their users use them."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ars import ARSSAC, ARSTQC, LoadedPolicy, make_toy_env
from sb3_ars.errors import ConfigError
from sb3_ars.experiments.config import load_preset
from sb3_ars.integrations.gymnasium_env import TaskSet

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "integrations.md").read_text()
BODIES = {
    "plain": {},
    "multi_head": {"policy_kwargs": {"body": {"name": "multi_head"}}},
    "soft_modules": {"policy_kwargs": {"body": {"name": "soft_modules", "n_layers": 2, "n_modules": 2}}},
    "moore": {"policy_kwargs": {"body": {"name": "moore", "n_experts": 3}}},
    "paco": {"policy_kwargs": {"body": {"name": "paco"}}},
    "lora": {"lora": {"rank": 2}},
}


def examples(language, heading):
    """The code blocks of one section of the page."""
    section = PAGE.split(f"## {heading}\n")[1].split("\n## ")[0]
    return [block.split("```")[0] for block in section.split(f"```{language}\n")[1:]]


def python(script, folder, **environment):
    """Run a script in a process of its own, as warnings of other people's packages are not ours to fix."""
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **environment},
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


# ---------------------------------------------------------------- ONNX


def toy_model(algorithm=ARSSAC, env=None, policy_kwargs=None, **options):
    policy_kwargs = {"net_arch": [16, 16], **(policy_kwargs or {})}
    env = make_toy_env(seed=0) if env is None else env
    return algorithm(
        "MlpPolicy", env, policy_kwargs=policy_kwargs, batch_size=8, seed=0, device="cpu", **options
    )


def observations(rows):
    obs = np.random.default_rng(0).uniform(-1, 1, (rows, 10)).astype(np.float32)
    obs[:, 6:] = np.eye(4)[np.arange(rows) % 4]
    return obs


def onnx_session(path):
    onnxruntime = pytest.importorskip("onnxruntime", reason="extra 'onnx' is missing")
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


@pytest.mark.parametrize(("algorithm", "body"), [*((ARSSAC, body) for body in BODIES), (ARSTQC, "plain")])
def test_an_onnx_file_acts_as_the_model_does(algorithm, body, tmp_path):
    pytest.importorskip("onnxscript", reason="extra 'onnx' is missing")
    from sb3_ars.integrations.onnx import export_onnx

    model = toy_model(algorithm, **BODIES[body])
    if body == "lora":
        model.enable_lora()
    with th.no_grad():
        for parameter in model.actor.parameters():  # so that adapters, biases and heads do something
            parameter.add_(0.1 * th.randn_like(parameter))
    before = {name: value.clone() for name, value in model.actor.state_dict().items()}
    session = onnx_session(export_onnx(model, tmp_path / "policy.onnx"))
    for rows in (1, 2, 7):
        (action,) = session.run(None, {"observation": observations(rows)})
        expected, _ = model.predict(observations(rows), deterministic=True)
        np.testing.assert_allclose(action, expected, atol=1e-5)
    assert np.ptp(expected, axis=0).min() > 1e-3  # seven different actions
    metadata = session.get_modelmeta().custom_metadata_map
    assert json.loads(metadata["task_names"]) == list(model.task_names)
    assert metadata["algorithm"] == algorithm.__name__
    assert [path.name for path in tmp_path.iterdir()] == ["policy.onnx"]
    for name, value in model.actor.state_dict().items():
        assert th.equal(value, before[name])


def test_onnx_holds_the_statistics_of_vecnormalize(tmp_path):
    pytest.importorskip("onnxscript", reason="extra 'onnx' is missing")
    from sb3_ars.integrations.onnx import export_onnx

    env = VecNormalize(make_toy_env(seed=0), norm_reward=False, clip_obs=2.0)
    model = toy_model(env=env)
    env.reset()
    for _ in range(30):
        env.step(np.ones((4, 2), np.float32))
    env.training = False
    session = onnx_session(export_onnx(model, tmp_path / "policy.onnx"))
    (action,) = session.run(None, {"observation": observations(9)})
    expected, _ = model.predict(env.normalize_obs(observations(9)), deterministic=True)
    np.testing.assert_allclose(action, expected, atol=1e-5)
    plain, _ = model.predict(observations(9), deterministic=True)
    assert np.abs(plain - expected).max() > 1e-3


def test_onnx_refuses_images_and_folders_that_are_not_there(tmp_path):
    pytest.importorskip("onnxscript", reason="extra 'onnx' is missing")
    from sb3_ars.integrations.onnx import export_onnx

    model = toy_model()
    with pytest.raises(ConfigError, match="cannot be written"):
        export_onnx(model, tmp_path / "missing" / "policy.onnx")
    model.observation_space = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)
    with pytest.raises(ConfigError, match="for observations that are vectors"):
        export_onnx(model, tmp_path / "policy.onnx")


def test_the_onnx_example_runs(run, tmp_path, monkeypatch):
    pytest.importorskip("onnxscript", reason="extra 'onnx' is missing")
    monkeypatch.chdir(tmp_path)
    (block,) = examples("python", "ONNX")
    names = {}
    exec(block.replace("runs/mt10-ars-seed0", str(run)), names)
    assert names["action"].shape == (1, 2)


# ---------------------------------------------------------------- Hugging Face hub


class Hub:
    """The hub as a folder: what is uploaded can be downloaded."""

    def __init__(self, folder, monkeypatch):
        huggingface_hub = pytest.importorskip("huggingface_hub", reason="extra 'hub' is missing")
        self.folder, self.commits = folder, []
        monkeypatch.setattr(huggingface_hub.HfApi, "create_repo", self.create_repo)
        monkeypatch.setattr(huggingface_hub.HfApi, "upload_folder", self.upload_folder)
        monkeypatch.setattr(huggingface_hub, "hf_hub_download", self.download)
        monkeypatch.delenv("TRUST_REMOTE_CODE", raising=False)

    def create_repo(self, repo_id, private, exist_ok):
        assert exist_ok and not private
        return f"https://hub.test/{repo_id}"

    def upload_folder(self, repo_id, folder_path, commit_message):
        for path in Path(folder_path).rglob("*"):
            if path.is_file():
                target = self.folder / repo_id / path.relative_to(folder_path)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(path.read_bytes())
        self.commits.append(commit_message)

    def download(self, repo_id, filename, revision=None, **kwargs):
        path = self.folder / repo_id / filename
        if not path.is_file():
            raise FileNotFoundError(f"no {filename} in {repo_id}")
        return str(path)


@pytest.fixture
def hub(tmp_path, monkeypatch):
    return Hub(tmp_path / "hub", monkeypatch)


def test_a_run_goes_to_the_hub_and_comes_back(run, hub, monkeypatch):
    (block,) = examples("python", "Hugging Face hub")
    names = {}
    exec(block.replace("runs/mt10-ars-seed0", str(run)), names)
    saved = ARSSAC.load(run / "policy.zip")
    for loaded, kind in (("policy", LoadedPolicy), ("model", ARSSAC)):
        assert isinstance(names[loaded], kind)
        np.testing.assert_array_equal(
            names[loaded].predict(observations(4), deterministic=True)[0],
            saved.predict(observations(4), deterministic=True)[0],
        )
    files = {path.name for path in (hub.folder / "me" / "mt10-ars").iterdir()}
    assert files >= {
        "README.md",
        "policy.safetensors",
        "policy.zip",
        "config.yaml",
        "result.json",
        "versions.json",
        "training.png",
    }
    assert hub.commits == ["Upload a run of sb3_ars"]
    huggingface_sb3 = pytest.importorskip("huggingface_sb3", reason="extra 'zoo' is missing")
    monkeypatch.setenv("TRUST_REMOTE_CODE", "1")
    theirs = ARSSAC.load(huggingface_sb3.load_from_hub("me/mt10-ars", "policy.zip"))
    assert theirs.task_names == saved.task_names


def test_the_card_says_what_was_measured_and_how_long_it_was_trained(run, hub):
    from huggingface_hub import ModelCard

    from sb3_ars.integrations.hub import push_run

    assert push_run(run, "me/toy") == "https://hub.test/me/toy"
    card = ModelCard.load(hub.folder / "me" / "toy" / "README.md")
    result = json.loads((run / "result.json").read_text())
    assert card.data.library_name == "stable-baselines3" and "sb3-ars" in card.data.tags
    assert card.data.eval_results[0].metric_value == result["mean_success"]
    text = " ".join(card.text.split())
    assert (
        "400 environment steps of 400 planned, summed over tasks; the preset's own length is 48,000" in text
    )
    assert "one seed, so take the numbers as one sample" in text and "hidden layers [8]" in text
    assert result["protocol"] in text and "stable-baselines3 " in text and 'load_from_hub("me/toy"' in text
    for name, task in result["tasks"].items():
        assert f"| {name} | {task['success']:.1%} |" in text


def test_nothing_is_unpickled_without_trust(run, hub, monkeypatch, tmp_path):
    from sb3_ars.integrations.hub import load_from_hub, package_run, push_run

    push_run(run, "me/toy")
    uploaded = hub.folder / "me" / "toy"
    zipped = (uploaded / "policy.zip").read_bytes()
    (uploaded / "policy.zip").write_bytes(b"nothing reads this")
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")  # huggingface_sb3's; here only the argument counts
    policy = load_from_hub("me/toy")
    assert isinstance(policy, LoadedPolicy) and policy.task_names[0] == "point-east"
    (uploaded / "policy.safetensors").write_bytes(zipped)
    with pytest.raises(ConfigError, match="it is a zip"):
        load_from_hub("me/toy")
    (uploaded / "policy.safetensors").unlink()
    with pytest.raises(ConfigError, match=r"policy\.safetensors cannot be had.*can run any code.*trust=True"):
        load_from_hub("me/toy")
    (uploaded / "policy.zip").write_bytes(zipped)
    assert load_from_hub("me/toy", trust=True).n_resets == 1
    with pytest.raises(ConfigError, match="me/other cannot be downloaded as a run of sb3_ars"):
        load_from_hub("me/other", trust=True)
    with pytest.raises(ConfigError, match="choose a new folder"):
        package_run(run, run, "me/toy")


# ---------------------------------------------------------------- Gymnasium ids and RL Zoo


def test_a_task_set_is_an_ordinary_env_that_draws_a_task_for_each_episode():
    env = gym.make("sb3_ars/toy-v0")
    check_env(env.unwrapped, skip_render_check=True)
    seen = set()
    for seed in range(12):
        obs, _ = env.reset(seed=seed)
        assert obs[6:].sum() == 1 and env.observation_space.contains(obs)
        seen.add(int(obs[6:].argmax()))
    assert seen == {0, 1, 2, 3}
    env = gym.make("sb3_ars/toy-v0", task="point-west", horizon=3, render_mode="rgb_array")
    obs, _ = env.reset(seed=0)
    steps = [env.step(np.zeros(2, np.float32)) for _ in range(3)]
    assert obs[6:].tolist() == steps[-1][0][6:].tolist() == [0, 0, 1, 0] and steps[-1][3]
    assert steps[-1][4]["is_success"] is False and "is_success" not in steps[0][4]
    assert env.render().shape == (320, 320, 3)
    with pytest.raises(ConfigError, match="Did you mean 'point-west'"):
        TaskSet(task="point-wets")


@pytest.mark.metaworld
def test_a_task_set_of_metaworld_has_the_space_of_all_its_tasks():
    env = gym.make("sb3_ars/MT10-v0", tasks=("reach", "drawer-open"), task="drawer-open", horizon=2)
    obs, _ = env.reset(seed=0)
    assert obs.shape == (41,) and obs[39:].tolist() == [0, 1]
    assert env.step(env.action_space.sample())[1] >= 0
    from sb3_ars import make_metaworld_env

    both = make_metaworld_env(["reach", "drawer-open"], seed=0, n_workers=0)
    assert env.observation_space == both.observation_space
    for one in (env, both):
        one.close()


ZOO = """
import shlex, sys
import sb3_ars.integrations.rl_zoo as zoo
from rl_zoo3.utils import ALGOS
import sb3_contrib
assert ALGOS["ars"] is sb3_contrib.ARS
for words in {commands!r}:
    sys.argv = words
    print("RUN", " ".join(words[1:]), flush=True)
    try:
        zoo.main()
    except zoo.ConfigError as error:
        print("REFUSED", error)
"""


def test_rl_zoo_trains_tunes_and_watches(tmp_path):
    pytest.importorskip("rl_zoo3", reason="extra 'zoo' is missing")
    (block,) = examples("sh", "RL Zoo")
    short = {
        "train": "-n 800 --eval-freq 400 -params updates_after_reset:2 --seed 1",
        "enjoy": "-n 120 --exp-id 1",
        "tune": "-n 1200 --n-trials 2 --n-evaluations 1 --eval-episodes 4 --no-optim-plots --n-startup-trials 1 "
        "-params updates_after_reset:2 --seed 1 --storage study.log --study-name toy",
    }
    given = [shlex.split(line) for line in block.strip().splitlines()]
    assert [words[:3] for words in given] == [["python", "-m", "sb3_ars.integrations.rl_zoo"]] * 3
    commands = [[*words[2:], *shlex.split(short[words[3]])] for words in given]
    toy = ["zoo", "train", "--env", "sb3_ars/toy-v0", "-n", "800", "--eval-freq", "-1", "--algo"]
    commands += [
        [*toy, "arstqc", "-params", "updates_after_reset:2"],
        [*toy, "arssac", "-params", "n_envs:6"],
        [*toy, "arssac", "-params", "normalize:True"],
        [
            "zoo",
            "tune",
            *toy[2:4],
            "-n",
            "120",
            "--algo",
            "arssac",
            "--n-trials",
            "1",
            "--no-optim-plots",
            "--seed",
            "1",
        ],
        ["zoo", "trian"],
    ]
    out = python(ZOO.format(commands=commands), tmp_path)
    trained, watched, tuned, of_tqc, refused, normalized, none, unknown = out.split("RUN ")[1:]
    assert "REFUSED" not in trained + watched + tuned + of_tqc
    assert "Success rate: " in trained and "'n_envs', 4" in trained
    assert "Success rate: " in watched and "Episodes" in watched
    assert "n_envs=6 cannot be shared out evenly among the 4 tasks" in refused
    assert "REFUSED No trial of the study came to its end" in none
    assert "VecNormalize(norm_reward=True)" in normalized and "Did you mean 'train'?" in unknown
    folder = tmp_path / "logs" / "arssac" / "sb3_ars-toy-v0_1"
    assert (folder / "best_model.zip").is_file() and (folder / "evaluations.npz").is_file()
    for task in range(4):
        rows = (folder / f"{task}.monitor.csv").read_text().splitlines()
        assert len(rows) == 2 + 4 and rows[2].split(",")[1] == "50"  # 200 steps a task
    model = ARSSAC.load(folder / "sb3_ars-toy-v0.zip")
    assert model.task_names == ["point-east", "point-north", "point-west", "point-south"]
    assert model.num_timesteps == 800 and model.n_resets == 1
    assert model.predict(observations(4))[0].shape == (4, 2)
    assert ARSTQC.load(tmp_path / "logs" / "arstqc" / "sb3_ars-toy-v0_1" / "sb3_ars-toy-v0.zip").n_resets == 1

    import optuna
    from optuna.storages.journal import JournalFileBackend

    storage = optuna.storages.JournalStorage(JournalFileBackend(str(tmp_path / "study.log")))
    trials = optuna.load_study(study_name="toy", storage=storage).trials
    assert [trial.state.name for trial in trials] == ["COMPLETE"] * 2
    for trial in trials:
        assert 0 <= trial.value <= 1 and "n_reset" in trial.params  # success, not a return


def test_rl_zoo_s_command_exits_as_ours_do():
    pytest.importorskip("rl_zoo3", reason="extra 'zoo' is missing")
    command = [sys.executable, "-m", "sb3_ars.integrations.rl_zoo", "trian"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith("error: 'trian' is none of train")


def test_the_shipped_hyperparameters_are_those_of_the_registered_ids():
    import yaml

    from sb3_ars.integrations.gymnasium_env import ENV_IDS, task_names

    for name in ("arssac", "arstqc"):
        values = yaml.safe_load((ROOT / "sb3_ars" / "integrations" / f"{name}.yml").read_text())
        assert set(values) == {*ENV_IDS, "default"}
        for env_id, tasks in ENV_IDS.items():
            assert values[env_id]["n_envs"] == len(task_names(tasks))
        for benchmark in ("MT10", "MT50"):
            preset = load_preset(f"{benchmark.lower()}-ars").algorithm
            of_zoo = values[f"sb3_ars/{benchmark}-v0"]
            assert of_zoo["n_timesteps"] == preset.total_timesteps
            assert of_zoo.get("buffer_size", 1_000_000) == preset.buffer_size


# ---------------------------------------------------------------- Weights & Biases


def test_the_wandb_example_trains_saves_and_logs_each_task(tmp_path):
    pytest.importorskip("wandb", reason="extra 'wandb' is missing")
    (block,) = examples("python", "Weights & Biases")
    for old, new in (
        ('make_metaworld_env("MT10", seed=0)', "make_toy_env(seed=0)"),
        ("make_metaworld_env", "make_toy_env"),
        ("n_reset=4", 'n_reset=1, batch_size=8, updates_after_reset=2, policy_kwargs={"net_arch": [8]}'),
        ("20_000_000", "800"),
    ):
        assert old in block, old
        block = block.replace(old, new)
    script = f"{block}\nprint('RUN', run.id, model.num_timesteps)"
    environment = {"WANDB_MODE": "offline", "WANDB_DIR": str(tmp_path), "WANDB_SILENT": "true"}
    said, run_id, steps = python(script, tmp_path, **environment).split()[-3:]
    assert (said, steps) == ("RUN", "800")
    assert ARSSAC.load(tmp_path / "models" / run_id / "model.zip").n_resets == 1
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    (folder,) = (tmp_path / "runs" / run_id).iterdir()
    log = EventAccumulator(str(folder)).Reload()
    keys = set(log.Tags()["scalars"])
    for task in ("point-east", "point-south"):
        assert {f"{part}/{task}" for part in ("success", "reward_scale")} <= keys, keys
    assert list(tmp_path.glob("wandb/offline-run-*/*.wandb"))
