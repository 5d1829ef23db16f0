"""SB3's callbacks and logger work on our models, with ARSCallback installed exactly once and SB3's keys all present."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.logger import KVWriter, Logger, configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_ars import ARSSAC, ARSTQC, ARSCallback, make_toy_env
from sb3_ars.errors import ConfigError

BOTH = pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
PAIRS = [pytest.param(ARSSAC, SAC, id="sac"), pytest.param(ARSTQC, TQC, id="tqc")]
SMALL = {"net_arch": [16], "activation_fn": nn.ReLU}


class Noisy(IdentityEnvBox):
    """SB3's one-dimensional env, seeded by ``reset``."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.observation_space.seed(seed)
        return super().reset(seed=seed, options=options)


def env(n_envs=1):
    return DummyVecEnv([lambda: Monitor(TimeLimit(Noisy(ep_length=100), 5))] * n_envs)


def make(algorithm, environment=None, **options):
    settings = {"buffer_size": 200, "learning_starts": 10, "batch_size": 4, "seed": 5, "policy_kwargs": SMALL}
    return algorithm("MlpPolicy", env() if environment is None else environment, **(settings | options))


def make_toy(algorithm=ARSSAC, n_tasks=2, **options):
    environment = make_toy_env(seed=0, reward_scales=(10.0, 0.1, 1.0)[:n_tasks], max_episode_steps=5)
    settings = {"n_reset": 0, "updates_after_reset": 2, "learning_starts": 4 * n_tasks}
    return make(algorithm, environment, **(settings | options))


class Recorder(KVWriter):
    """Keeps what was logged, by step."""

    def __init__(self):
        self.dumps = []

    def write(self, key_values, key_excluded, step=0):
        self.dumps.append((step, dict(key_values)))

    def close(self):
        pass


def recorded(model, steps, **options):
    recorder = Recorder()
    model.set_logger(Logger(None, [recorder]))
    model.learn(steps, **options)
    return recorder.dumps


class Count(BaseCallback):
    """Counts every hook."""

    def __init__(self, stop_after=None):
        super().__init__()
        self.hooks = {"start": 0, "rollout": 0, "step": 0, "rollout_end": 0, "end": 0}
        self.stop_after = stop_after

    def _on_training_start(self):
        self.hooks["start"] += 1

    def _on_rollout_start(self):
        self.hooks["rollout"] += 1

    def _on_step(self):
        self.hooks["step"] += 1
        return self.stop_after is None or self.hooks["step"] < self.stop_after

    def _on_rollout_end(self):
        self.hooks["rollout_end"] += 1

    def _on_training_end(self):
        self.hooks["end"] += 1


# ---------------------------------------------------------------- callbacks


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_every_hook_is_called_as_often_as_by_sb3(ours, theirs):
    counts = []
    for algorithm in (ours, theirs):
        callback = Count()
        make(algorithm, train_freq=3).learn(30, callback)
        counts.append(callback)
    assert (
        counts[0].hooks
        == counts[1].hooks
        == {"start": 1, "rollout": 10, "step": 30, "rollout_end": 10, "end": 1}
    )
    assert counts[0].n_calls == counts[1].n_calls == 30
    assert {"new_obs", "rewards", "dones", "infos", "actions", "total_timesteps"} <= counts[0].locals.keys()


@BOTH
def test_a_callback_that_returns_false_stops_training(algorithm):
    for callback, steps in ((Count(stop_after=7), 7), (lambda local, _: local["self"].num_timesteps < 9, 9)):
        model = make(algorithm)
        model.learn(30, callback)
        assert model.num_timesteps == steps


@BOTH
def test_a_function_a_list_and_a_callback_list_are_called(algorithm):
    seen = []

    def function(local, _):
        seen.append(local["self"].num_timesteps)
        return True

    make(algorithm).learn(6, function)
    assert seen == [1, 2, 3, 4, 5, 6]
    for wrap in (list, CallbackList):
        callbacks = [Count(), Count()]
        make(algorithm).learn(6, wrap(callbacks))
        assert [callback.hooks["step"] for callback in callbacks] == [6, 6]


@BOTH
def test_evaluation_writes_its_results_the_best_model_and_calls_its_callbacks(algorithm, tmp_path):
    new_best, after = Count(), Count()
    callback = EvalCallback(
        env(),
        callback_on_new_best=new_best,
        callback_after_eval=after,
        n_eval_episodes=2,
        eval_freq=10,
        best_model_save_path=str(tmp_path / "best"),
        log_path=str(tmp_path / "log"),
        verbose=0,
    )
    dumps = recorded(make(algorithm), 30, callback=callback)
    results = np.load(tmp_path / "log" / "evaluations.npz")
    assert results["timesteps"].tolist() == [10, 20, 30]
    assert results["results"].shape == (3, 2) and (results["ep_lengths"] == 5).all()
    assert after.hooks["step"] == 3 and new_best.hooks["step"] >= 1
    best = algorithm.load(tmp_path / "best" / "best_model")
    assert best.num_timesteps in (10, 20, 30)
    assert callback.best_mean_reward == results["results"].mean(axis=1).max()
    assert any("eval/mean_reward" in values for _, values in dumps)


@BOTH
def test_training_stops_at_a_reward_threshold(algorithm):
    model = make(algorithm)
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1000.0)
    model.learn(
        60, EvalCallback(env(), callback_on_new_best=stop, eval_freq=20, n_eval_episodes=1, verbose=0)
    )
    assert model.num_timesteps == 20


@BOTH
def test_training_stops_without_improvement_and_at_a_number_of_episodes(algorithm):
    model = make(algorithm)
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=0, min_evals=0)
    model.learn(
        100, EvalCallback(env(), callback_after_eval=stop, eval_freq=10, n_eval_episodes=1, verbose=0)
    )
    assert 10 <= model.num_timesteps < 100
    model = make(algorithm)
    model.learn(100, StopTrainingOnMaxEpisodes(max_episodes=3))
    assert model.num_timesteps == 15


@BOTH
def test_checkpoints_hold_model_buffer_and_normalisation(algorithm, tmp_path):
    model = make(algorithm, VecNormalize(env(2)))
    callback = CheckpointCallback(
        10, str(tmp_path), name_prefix="run", save_replay_buffer=True, save_vecnormalize=True
    )
    model.learn(40, callback)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [
        "run_20_steps.zip",
        "run_40_steps.zip",
        "run_replay_buffer_20_steps.pkl",
        "run_replay_buffer_40_steps.pkl",
        "run_vecnormalize_20_steps.pkl",
        "run_vecnormalize_40_steps.pkl",
    ]
    normalize = VecNormalize.load(str(tmp_path / "run_vecnormalize_20_steps.pkl"), env(2))
    loaded = algorithm.load(tmp_path / "run_20_steps", env=normalize)
    loaded.load_replay_buffer(tmp_path / "run_replay_buffer_20_steps")
    assert loaded.num_timesteps == 20
    assert loaded.replay_buffer.size() == 9  # SB3 calls on_step before the newest transition is stored
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps == 40


@BOTH
def test_every_n_timesteps_calls_its_callback_that_often(algorithm):
    inner = Count()
    make(algorithm, env(2)).learn(40, EveryNTimesteps(10, inner))
    assert inner.hooks["step"] == 4


@pytest.mark.filterwarnings("ignore:rich is experimental")  # tqdm's own, at each use of tqdm.rich
@BOTH
def test_the_progress_bar_counts_to_the_end(algorithm, monkeypatch):
    bars = []

    class Kept(ProgressBarCallback):
        def _on_training_end(self):
            bars.append((self.pbar.n, self.pbar.total))
            super()._on_training_end()

    monkeypatch.setattr("stable_baselines3.common.base_class.ProgressBarCallback", Kept)
    make(algorithm).learn(12, Count(), progress_bar=True)
    assert bars == [(12, 12)]


def children(callback):
    """Every callback in a tree of callbacks."""
    inner = [*getattr(callback, "callbacks", []), getattr(callback, "callback", None)]
    return [callback] + [
        found for child in inner if isinstance(child, BaseCallback) for found in children(child)
    ]


CALLBACKS = {
    "none": lambda: None,
    "function": lambda: lambda *_: True,
    "one": Count,
    "list": lambda: [Count(), Count()],
    "event": lambda: EveryNTimesteps(5, Count()),
    "ours": ARSCallback,
    "ours_in_a_list": lambda: [Count(), ARSCallback()],
    "ours_in_nested_lists": lambda: CallbackList([Count(), CallbackList([ARSCallback()])]),
}
IN_EVENTS = {
    "event": lambda: EveryNTimesteps(5, ARSCallback()),
    "event_in_a_list": lambda: [Count(), EveryNTimesteps(5, ARSCallback())],
    "list_in_an_event": lambda: EveryNTimesteps(5, CallbackList([Count(), ARSCallback()])),
    "after_evaluation": lambda: EvalCallback(env(), callback_after_eval=ARSCallback()),
    "on_new_best": lambda: EvalCallback(env(), callback_on_new_best=ARSCallback()),
}


@pytest.mark.parametrize("callback", CALLBACKS.values(), ids=CALLBACKS.keys())
def test_resets_happen_exactly_once_whatever_callback_is_passed(callback):
    model = make(ARSSAC, param_resets=[15, 25], updates_after_reset=3)
    calls, train = [], model.train

    def counted(gradient_steps, batch_size):
        calls.append((model.num_timesteps, gradient_steps))
        train(gradient_steps, batch_size)

    model.train = counted
    model.learn(30, callback())
    assert model.n_resets == 2
    assert [call for call in calls if call[1] == 3] == [(15, 3), (25, 3)]
    assert len(model.reward_scale_history) == 3


@pytest.mark.parametrize("callback", CALLBACKS.values(), ids=CALLBACKS.keys())
@pytest.mark.parametrize("progress_bar", [False, True])
def test_exactly_one_ars_callback_is_installed(callback, progress_bar):
    installed = make(ARSSAC)._init_callback(callback(), progress_bar)
    assert sum(isinstance(found, ARSCallback) for found in children(installed)) == 1


@pytest.mark.parametrize("callback", IN_EVENTS.values(), ids=IN_EVENTS.keys())
def test_an_ars_callback_that_no_rollout_would_reach_is_refused(callback):
    """SB3 2.9.2 (common/callbacks.py): an event callback tells those inside it of steps, not of rollouts."""
    model = make(ARSSAC)
    with pytest.raises(ConfigError, match="ARSCallback inside an event callback"):
        model.learn(30, callback())
    assert model.num_timesteps == 0


def test_event_callbacks_still_tell_those_inside_of_steps_only():
    """Once SB3 forwards rollouts, an ARSCallback inside need no longer be refused."""
    inner = Count()
    make(SAC).learn(20, EveryNTimesteps(5, inner))
    assert inner.hooks["step"] == 4 and inner.hooks["rollout"] == inner.hooks["rollout_end"] == 0


def test_a_subclass_of_ars_callback_takes_the_place_of_ours():
    class Never(ARSCallback):
        def reset_is_due(self):
            return False

    model = make(ARSSAC, param_resets=[15])
    model.learn(30, [Never()])
    assert model.n_resets == 0


def test_a_checkpoint_in_the_step_of_a_reset_comes_after_it():
    seen = []

    class Look(BaseCallback):
        def _on_rollout_start(self):
            seen.append((self.model.num_timesteps, self.model.n_resets))

        def _on_step(self):
            return True

    make(ARSSAC, param_resets=[15], updates_after_reset=1).learn(20, Look())
    assert dict(seen)[14] == 0 and dict(seen)[15] == 1


# ---------------------------------------------------------------- logging


@pytest.mark.parametrize("options", [{}, {"ent_coef": 0.2}], ids=["auto", "fixed"])
@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_a_plain_env_logs_sb3_s_keys_and_no_others(ours, theirs, options):
    mine, other = (recorded(make(algorithm, **options), 40, log_interval=2) for algorithm in (ours, theirs))
    assert [step for step, _ in mine] == [step for step, _ in other] == [10, 20, 30, 40]
    for (_, values), (_, reference) in zip(mine, other, strict=True):
        assert values.keys() == reference.keys()
        for key in ("rollout/ep_rew_mean", "rollout/ep_len_mean", "time/episodes", "time/total_timesteps"):
            assert values[key] == reference[key]
    assert {
        "train/actor_loss",
        "train/critic_loss",
        "train/ent_coef",
        "train/learning_rate",
        "train/n_updates",
        "time/fps",
        "time/time_elapsed",
    } <= mine[-1][1].keys()
    assert ("train/ent_coef_loss" in mine[-1][1]) is not bool(options)


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_train_metrics_are_the_mean_over_the_updates_since_the_last_entry(ours, theirs):
    # with one rollout, and so one call of train, between two entries SB3's mean runs over the same updates
    options = {"train_freq": 10, "gradient_steps": 10, "learning_starts": 9}
    mine, other = (recorded(make(algorithm, **options), 60, log_interval=2) for algorithm in (ours, theirs))
    for (_, values), (_, reference) in zip(mine[1:], other[1:], strict=True):
        for key in ("actor_loss", "critic_loss", "ent_coef", "ent_coef_loss", "learning_rate", "n_updates"):
            assert values[f"train/{key}"] == pytest.approx(reference[f"train/{key}"], rel=1e-5), key


@BOTH
def test_envs_that_end_together_are_logged_once_per_step(algorithm):
    dumps = recorded(make(algorithm, env(3)), 60, log_interval=1)
    assert [step for step, _ in dumps] == [15, 30, 45, 60]


@BOTH
def test_a_second_learn_logs_at_the_same_steps_as_the_first(algorithm):
    model = make(algorithm)
    for _ in range(2):
        assert [step for step, _ in recorded(model, 5, log_interval=1)] == [5]


@BOTH
def test_no_log_interval_means_no_entries(algorithm):
    assert recorded(make(algorithm), 20, log_interval=None) == []


def test_all_formats_are_written(tmp_path, capsys):
    model = make_toy()
    model.set_logger(configure(str(tmp_path), ["stdout", "csv", "json", "log", "tensorboard"]))
    model.learn(60, log_interval=2)
    model.logger.close()
    keys = {"rollout/ep_rew_mean", "train/critic_loss", "reward_scale/point-0", "q_value/point-180"}
    with open(tmp_path / "progress.csv") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["time/total_timesteps"]) for row in rows] == [10, 20, 30, 40, 50, 60]
    assert keys <= rows[-1].keys() and all(math.isfinite(float(rows[-1][key])) for key in keys)
    entries = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert keys <= entries[-1].keys() and len(entries) == 6
    printed = capsys.readouterr().out
    for text in (printed, (tmp_path / "log.txt").read_text()):
        assert "reward_scale/" in text and "point-180" in text and "critic_loss" in text
    assert list(tmp_path.glob("events.out.tfevents.*"))


@BOTH
def test_tensorboard_runs_are_named_after_the_class_and_numbered(algorithm, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    model = make(algorithm, tensorboard_log=str(tmp_path))
    model.learn(20, log_interval=1)
    model.learn(20, log_interval=1)
    model.learn(5, log_interval=1, tb_log_name="named")
    model.learn(5, log_interval=1, reset_num_timesteps=False)
    name = algorithm.__name__
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{name}_1", f"{name}_2", "named_1"]
    events = EventAccumulator(str(tmp_path / f"{name}_1")).Reload()
    assert {"rollout/ep_rew_mean", "train/critic_loss", "train/learning_rate"} <= set(
        events.Tags()["scalars"]
    )
    assert [event.step for event in events.Scalars("train/critic_loss")] == [15, 20]


@BOTH
def test_verbose_one_prints_the_table_and_verbose_zero_nothing(algorithm, capsys):
    make(algorithm).learn(20, log_interval=1)
    assert capsys.readouterr().out == ""
    make(algorithm, verbose=1).learn(20, log_interval=1)
    printed = capsys.readouterr().out
    assert "Using cpu device" in printed or "Using cuda device" in printed
    assert "ep_rew_mean" in printed and "critic_loss" in printed


@BOTH
def test_each_task_s_numbers_are_logged(algorithm):
    dumps = recorded(make_toy(algorithm, n_tasks=3), 90, log_interval=3)
    last = dumps[-1][1]
    names = ["point-0", "point-120", "point-240"]
    for key in ("success", "return", "reward_scale", "mean_reward", "q_value", "ent_coef"):
        assert [name for name in last if name.startswith(f"{key}/")] == [f"{key}/{name}" for name in names]
    assert {"rollout/mean_success", "rollout/success_rate", "rollout/ep_rew_mean"} <= last.keys()
    assert {
        "train/ent_coef_loss",
        "train/actor_loss",
        "train/learning_rate",
        "train/n_updates",
    } <= last.keys()
    assert last["train/ent_coef"] == pytest.approx(np.mean([last[f"ent_coef/{name}"] for name in names]))


def test_returns_and_mean_rewards_are_logged_unscaled():
    model = make_toy()
    last = recorded(model, 100, log_interval=2)[-1][1]
    # rewards are below 10 and 0.1, episodes 5 steps long
    assert 0.5 < last["return/point-0"] < 50 and 0.005 < last["return/point-180"] < 0.5
    assert last["rollout/ep_rew_mean"] == pytest.approx(
        (last["return/point-0"] + last["return/point-180"]) / 2, rel=1e-4
    )
    for task, name in enumerate(model.task_names):
        rewards = model.replay_buffer.rewards[task, : model.replay_buffer.task_size[task]]
        assert last[f"mean_reward/{name}"] == pytest.approx(rewards.mean().item(), rel=1e-5)
        assert last[f"reward_scale/{name}"] == pytest.approx(model.reward_scale.scale[task].item())
    # Eq. 6 after the random phase: five rows per task, and the loudest task keeps c = 1
    first = model.replay_buffer.rewards[:, :5, 0].mean(dim=1)
    assert model.reward_scale.scale.tolist() == pytest.approx([1.0, (first[0] / first[1]).item()])


@pytest.mark.parametrize("log_interval", [1, 2, 3])
def test_tasks_that_end_together_are_logged_at_most_once_per_step(log_interval):
    steps = [step for step, _ in recorded(make_toy(n_tasks=3), 90, log_interval=log_interval)]
    assert steps == [15, 30, 45, 60, 75, 90]


def test_sb3_s_evaluation_callback_runs_on_several_tasks(tmp_path):
    environment = make_toy_env(seed=1, reward_scales=(10.0, 0.1), max_episode_steps=5)
    callback = EvalCallback(environment, n_eval_episodes=4, eval_freq=10, log_path=str(tmp_path), verbose=0)
    make_toy().learn(40, callback)
    results = np.load(tmp_path / "evaluations.npz")
    assert results["timesteps"].tolist() == [20, 40] and results["results"].shape == (2, 4)
    assert results["successes"].shape == (2, 4)


def test_monitor_files_hold_raw_returns(tmp_path):
    environment = Monitor(TimeLimit(Noisy(ep_length=100), 5), str(tmp_path / "run"))
    model = make(ARSSAC, environment, reward_scaling=3.0)
    model.learn(20)
    environment.close()
    rows = Path(tmp_path / "run.monitor.csv").read_text().splitlines()[2:]
    returns = [float(row.split(",")[0]) for row in rows]
    rewards = model.replay_buffer.rewards[:20, 0].reshape(4, 5).sum(axis=1)
    np.testing.assert_allclose(returns, rewards, atol=1e-4)
    assert model.reward_scale.scale.tolist() == [3.0]


def test_scaling_reaches_the_update_but_not_the_buffer():
    runs = [make(ARSSAC, reward_scaling=scaling) for scaling in (1.0, 3.0)]
    for run in runs:
        run.learn(11)
    np.testing.assert_array_equal(runs[0].replay_buffer.rewards, runs[1].replay_buffer.rewards)
    weights = [run.policy.state_dict()["critic.qf0.0.weight"] for run in runs]
    assert not th.equal(*weights)
