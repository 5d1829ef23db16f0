"""A run that was interrupted and resumed is the run that was not: to the bit, in a new process too."""

import enum
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from torch import nn

from sb3_ars import (
    ARSSAC,
    ARSTQC,
    CheckpointError,
    ConfigError,
    DivergedError,
    RunCheckpoint,
    SMTConfig,
    TaskEvalCallback,
    TaskScheduleCallback,
    make_metaworld_env,
    make_multitask_env,
    make_toy_env,
)
from sb3_ars.algorithms.checkpoint import write_checkpoint
from sb3_ars.algorithms.run_state import _SESSION, COUNTERS, REBUILT, _option_names
from sb3_ars.checkpoints import CheckpointFolder, lock
from sb3_ars.evaluation import EvaluationProtocol

pytestmark = pytest.mark.filterwarnings("ignore:.*leaves no updates")
TOTAL = 1200
OPTIONS = {
    "n_reset": 2,
    "batch_size": 16,
    "buffer_size": 130,  # the rings turn over
    "updates_after_reset": 3,
    "learning_starts": 200,
    "policy_kwargs": {"net_arch": [16, 16]},
    "seed": 0,
}


class Stop(BaseCallback):
    """Ends training in the middle of a rollout, as a crash would: what came since the checkpoint is lost."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def _on_step(self):
        return self.num_timesteps < self.at


def toy(n_workers=0, **options):
    return make_toy_env(seed=0, n_workers=n_workers, **options)


def metaworld(n_workers=0):
    return make_metaworld_env(["reach", "push"], seed=0, n_workers=n_workers, max_episode_steps=60)


def make(algorithm=ARSSAC, env=toy, **options):
    return algorithm("MlpPolicy", env(), **{**OPTIONS, **options})


def short(folder, steps=250, algorithm=ARSSAC, **options):
    """A run of few steps that leaves a checkpoint."""
    return make(algorithm, **{"n_reset": 0, **options}).learn(steps, callback=checkpoints(folder))


def checkpoints(folder, every=100, **options):
    return RunCheckpoint(folder, every=every, every_minutes=None, **options)


def everything(model):
    """Whatever could differ, as a dictionary of plain things and arrays; draws from every generator."""
    buffer, temperatures = model.replay_buffer, model.log_ent_coef
    rows = [buffer._plain_rows(task, slice(0, int(n))).numpy() for task, n in enumerate(buffer.task_size)]
    states = [optimizer.state_dict()["state"] for optimizer in model._optimizers()]
    return {
        "parameters": np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()]),
        "moments": np.concatenate(
            [t.numpy().ravel() for state in states for entry in state.values() for t in entry.values()]
        ),
        "temperatures": None if temperatures is None else temperatures.detach().tolist(),
        "scale": model.reward_scale.scale.numpy(),
        "buffer": np.concatenate(rows),
        "next batch": model.replay_buffer.sample(8).rewards.numpy(),
        "counters": {
            name: getattr(model, name)
            for name in COUNTERS
            if not name.startswith(("ep_info", "_last", "_num"))
        },
        "observation": model._last_obs,
        "random": [
            random.random(),
            np.random.rand(),
            th.rand(1).item(),
            model.action_space.sample().tolist(),
        ],
        "recorded": {k: v for k, v in model.logger.name_to_value.items() if not k.startswith("time/")},
    }


def assert_same(a, b):
    assert a.keys() == b.keys()
    for key, value in a.items():
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, b[key]), key
        else:
            assert value == b[key], key


def seed_all(seed):
    random.seed(seed)
    np.random.seed(seed)
    th.manual_seed(seed)


def run_whole(make_model, callback=None):
    """The run without interruption, and all that it came to."""
    seed_all(1)
    model = make_model().learn(TOTAL, callback=callback)
    return model, everything(model)


def run_in_two(make_model, folder, algorithm=ARSSAC, env=toy, callbacks=(list, list), stop=1003, **options):
    seed_all(1)
    make_model().learn(TOTAL, callback=[*callbacks[0](), checkpoints(folder), Stop(stop)])
    seed_all(2)  # nothing of this process's may matter
    model = algorithm.resume(folder, env(), **options)
    assert stop - 120 <= model.num_timesteps <= stop
    assert model.remaining_timesteps == TOTAL - model.num_timesteps
    model.learn(model.remaining_timesteps, callback=callbacks[1](), reset_num_timesteps=False)
    return model, everything(model)


# ---------------------------------------------------------------------- to the bit


@pytest.mark.parametrize("overlap", [False, True])
@pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
def test_a_resumed_run_is_the_whole_run(algorithm, overlap, tmp_path):
    make_model = partial(make, algorithm, overlap=overlap)
    model, whole = run_whole(make_model)
    _, parts = run_in_two(make_model, tmp_path, algorithm)
    assert model.n_resets == 2
    assert_same(whole, parts)


@pytest.mark.parametrize("stop", [300, 430, 850])  # before, between and after the resets at 400 and 800
def test_it_is_so_wherever_the_run_ended(stop, tmp_path):
    assert_same(run_whole(make)[1], run_in_two(make, tmp_path, stop=stop)[1])


@pytest.mark.metaworld
@pytest.mark.parametrize(("algorithm", "overlap"), [(ARSSAC, False), (ARSTQC, True)])
def test_metaworld_goes_on_in_the_middle_of_an_episode(algorithm, overlap, tmp_path):
    make_model = partial(make, algorithm, metaworld, overlap=overlap)
    _, whole = run_whole(make_model)
    _, parts = run_in_two(make_model, tmp_path, algorithm, partial(metaworld, n_workers=2))
    assert (1000 // 2) % 60 not in (0, 59)  # of 60 steps
    assert_same(whole, parts)


VARIANTS = {
    "frames stored once": ({"optimize_memory_usage": True}, {}),
    "larger buffer": ({"buffer_size": 1000}, {}),
    "several envs a task": ({}, {"n_envs_per_task": 3}),
    "train_freq": ({"train_freq": 3, "gradient_steps": 2}, {}),
    "by episode": (
        {"train_freq": (1, "episode"), "gradient_steps": 5, "reward_scaling": "none"},
        {"tasks": ["point-east"]},
    ),
    "lora": ({"lora": {"rank": 4, "start": 0.5, "min_success": 0}}, {}),
    "body": ({"policy_kwargs": {"net_arch": [16], "body": {"name": "paco"}}, "max_task_loss": 5.0}, {}),
    "popart": (
        {"policy_kwargs": {"net_arch": [16], "critic_body": {"name": "popart"}}, "reward_scaling": "none"},
        {},
    ),
    "layer norm": (
        {"policy_kwargs": {"net_arch": [16], "critic_layer_norm": True, "activation_fn": nn.Tanh}},
        {},
    ),
    "sgd": ({"policy_kwargs": {"net_arch": [16], "optimizer_class": th.optim.SGD}}, {}),
    "eager": ({"execution": "eager"}, {}),
    "pcgrad": ({"gradient": "pcgrad"}, {}),
    "fixed temperature": ({"ent_coef": 0.1}, {}),
    "auto start": ({"learning_starts": "auto"}, {}),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_part_of_a_model_comes_back(variant, tmp_path):
    options, env_options = VARIANTS[variant]
    make_env = partial(toy, max_episode_steps=17, **env_options)
    make_model = partial(make, ARSSAC, make_env, **options)
    assert_same(run_whole(make_model)[1], run_in_two(make_model, tmp_path, env=make_env)[1])


def test_a_schedule_an_evaluation_and_action_noise_go_on(tmp_path):
    made = []

    def noise():
        return VectorizedActionNoise(OrnsteinUhlenbeckActionNoise(np.zeros(2), 0.1 * np.ones(2)), 4)

    def callbacks():
        schedule = TaskScheduleCallback(SMTConfig(pool_size=2, interval=100, window=2))
        protocol = EvaluationProtocol("toy", 2, 50, goals=None)
        made.append([schedule, TaskEvalCallback(make_toy_env(seed=5), 300, protocol)])
        return made[-1]

    _, whole = run_whole(lambda: make(action_noise=noise()), callbacks())
    options = {"callbacks": (callbacks, callbacks), "action_noise": noise()}
    _, parts = run_in_two(lambda: make(action_noise=noise()), tmp_path, **options)
    assert_same(whole, parts)
    evaluations = made[0][1], made[2][1]
    histories = [[(step, r.returns.tolist()) for step, r in found.history] for found in evaluations]
    assert histories[0] == histories[1] and len(histories[0]) == 4
    assert evaluations[0].best_score == evaluations[1].best_score


@pytest.mark.filterwarnings("ignore:The environment is already wrapped with a `Monitor`")
def test_normalised_observations_and_monitors_go_on(tmp_path):
    def make_env():
        return VecNormalize(VecMonitor(toy()), norm_reward=False)

    make_model = partial(make, ARSSAC, make_env)
    (a, whole), (b, parts) = run_whole(make_model), run_in_two(make_model, tmp_path, env=make_env)
    assert_same(whole, parts)
    assert np.array_equal(a.env.obs_rms.mean, b.env.obs_rms.mean)
    assert np.array_equal(a.env.venv.episode_returns, b.env.venv.episode_returns)


SCRIPT = """
import sys
from tests.test_resume import *
algorithm, env = {"ARSSAC": ARSSAC, "ARSTQC": ARSTQC}[sys.argv[2]], {"toy": toy, "metaworld": metaworld}[sys.argv[3]]
model = algorithm.resume(sys.argv[1], env())
model.learn(model.remaining_timesteps, reset_num_timesteps=False)
np.savez(sys.argv[1] + "/end.npz", **{k: v for k, v in everything(model).items() if isinstance(v, np.ndarray)})
"""


@pytest.mark.metaworld
@pytest.mark.parametrize(("algorithm", "env"), [(ARSSAC, toy), (ARSTQC, metaworld)])
def test_a_new_process_goes_on_to_the_bit(algorithm, env, tmp_path):
    make_model = partial(make, algorithm, env)
    _, whole = run_whole(make_model)
    seed_all(1)
    make_model().learn(TOTAL, callback=[checkpoints(tmp_path), Stop(1003)])
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, str(tmp_path), algorithm.__name__, env.__name__]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[1], env={**os.environ, "PYTHONPATH": "."})
    with np.load(tmp_path / "end.npz") as found:
        for key, value in found.items():
            assert np.array_equal(value, whole[key]), key
        assert set(found) >= {"parameters", "moments", "buffer", "scale", "observation"}


def test_resuming_twice_and_a_checkpoint_of_a_resumed_run(tmp_path):
    _, whole = run_whole(make)
    seed_all(1)
    make().learn(TOTAL, callback=[checkpoints(tmp_path), Stop(300)])
    for stop in (450, 460, 900, TOTAL + 1):  # 460: nothing new was written, so the same one again
        seed_all(stop)
        model = ARSSAC.resume(tmp_path, toy())
        model.learn(
            model.remaining_timesteps, callback=[checkpoints(tmp_path), Stop(stop)], reset_num_timesteps=False
        )
    assert_same(whole, everything(model))


def test_writing_checkpoints_changes_nothing(tmp_path):
    assert_same(run_whole(make)[1], run_whole(make, checkpoints(tmp_path, every=4))[1])


def test_every_attribute_of_a_model_is_saved_or_made_anew():
    """Fails once SB3, or we, add one that nobody thought of."""
    for algorithm in (ARSSAC, ARSTQC):
        model = make(algorithm, n_reset=0).learn(400)
        known = {*COUNTERS, *REBUILT, *_SESSION, *_option_names(algorithm)}
        assert set(vars(model)) - known == set()


# ---------------------------------------------------------------------- what cannot be exact


def test_a_plain_environment_begins_new_episodes_and_says_so(tmp_path):
    options = {
        "batch_size": 16,
        "buffer_size": 500,
        "learning_starts": 50,
        "policy_kwargs": {"net_arch": [8]},
    }
    model = ARSSAC("MlpPolicy", "Pendulum-v1", seed=0, **options)
    with pytest.warns(UserWarning, match="DummyVecEnv cannot be brought back to the middle of an episode"):
        model.learn(250, callback=checkpoints(tmp_path))
    with pytest.warns(UserWarning, match="does not go on to the bit"):
        resumed = ARSSAC.resume(tmp_path, "Pendulum-v1")
    stored = model.replay_buffer.observations[:200]
    assert resumed.num_timesteps == 200 and np.array_equal(resumed.replay_buffer.observations[:200], stored)
    assert resumed._n_updates == 150
    resumed.learn(50, reset_num_timesteps=False)


class Calm(gym.Env):
    """Draws from its own generator."""

    observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def draw(self):
        return self.np_random.random(3).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.draw(), {}

    def step(self, action):
        return self.draw(), 1.0, False, False, {}


class Restless(Calm):
    """Draws from the process's global generator, which nobody can put back for one env alone."""

    def draw(self):
        return np.random.rand(3).astype(np.float32)


def test_an_environment_that_cannot_be_played_again_is_named_and_begins_anew(tmp_path):
    tasks = {"calm": Calm, "restless": Restless}
    make_env = partial(make_multitask_env, tasks, seed=0, n_workers=0)
    model = ARSSAC("MlpPolicy", make_env(), **{**OPTIONS, "n_reset": 0, "reward_scaling": "none"})
    model.learn(301, callback=checkpoints(tmp_path))
    with pytest.warns(UserWarning, match="Env 1 of task 'restless' begins a new episode.*went another way"):
        resumed = ARSSAC.resume(tmp_path, make_env())
    resumed.learn(100, reset_num_timesteps=False)


def test_options_that_are_objects_are_asked_for(tmp_path):
    def schedule(progress):
        return 1e-3 * progress

    short(tmp_path, learning_rate=schedule)
    with pytest.raises(CheckpointError, match=r"learning_rate of this run is an object.*give it to resume"):
        ARSSAC.resume(tmp_path, toy())
    assert ARSSAC.resume(tmp_path, toy(), learning_rate=schedule).lr_schedule(0.5) == 5e-4


def test_options_given_anew_stay_and_a_smaller_buffer_holds_the_newest(tmp_path):
    model = short(tmp_path, steps=400)
    resumed = ARSSAC.resume(tmp_path, toy(), buffer_size=20, batch_size=4, learning_starts=999)
    assert (resumed.batch_size, resumed.learning_starts, resumed.replay_buffer.buffer_size) == (4, 999, 20)
    newest = model.replay_buffer.rewards[:, (300 // 4 - 20) : 300 // 4]
    found = th.roll(resumed.replay_buffer.rewards, -(75 % 20), dims=1)
    assert th.equal(found, newest)
    resumed.learn(40, reset_num_timesteps=False)


def test_a_run_that_goes_back_overwrites_nothing(tmp_path):
    model = make(n_reset=0)
    for _ in range(2):  # learn() counts anew
        model.learn(500, callback=checkpoints(tmp_path))
    assert ARSSAC.resume(tmp_path, toy()).num_timesteps == 400
    resumed = ARSSAC.resume(tmp_path, toy())
    with pytest.warns(
        UserWarning, match=r"begins a new run with what was resumed.*reset_num_timesteps=False"
    ):
        resumed.learn(500, callback=checkpoints(tmp_path))
    assert ARSSAC.resume(tmp_path, toy()).num_timesteps == 400


class Mode(enum.IntEnum):
    """What pickle would store with its class."""

    A = 1


class Remembering(Calm):
    """Keeps numbers of several kinds from one episode to the next, and what is not plain."""

    def __init__(self):
        self.mode, self.episodes, self.count = Mode.A, np.zeros(1, np.int64), np.int64(0)
        self.seen = [0.0]

    def reset(self, *, seed=None, options=None):
        self.episodes += 1
        self.count += 1
        self.seen.append(float(self.count))
        return super().reset(seed=seed)

    def step(self, action):
        obs, _, *rest = super().step(action)
        return obs, float(self.episodes[0] + self.count + sum(self.seen)), *rest


def test_what_an_env_remembers_from_episode_to_episode_comes_back(tmp_path):
    def env():
        tasks = {"a": Remembering, "b": Calm}
        return make_multitask_env(tasks, seed=0, n_workers=0, max_episode_steps=17)

    make_model = partial(make, ARSSAC, env, reward_scaling="none")
    assert_same(run_whole(make_model)[1], run_in_two(make_model, tmp_path, env=env)[1])


class Counting(ARSSAC):
    """A user's own algorithm, with something of its own."""

    def __init__(self, *args, **kwargs):
        self.counted = 0
        super().__init__(*args, **kwargs)


def test_what_a_subclass_adds_is_named_as_lost(tmp_path):
    with pytest.warns(UserWarning, match="counted of Counting is not saved"):
        short(tmp_path, algorithm=Counting)
    assert Counting.resume(tmp_path, toy()).num_timesteps == 200


def test_other_versions_are_told(tmp_path):
    short(tmp_path)
    for path in tmp_path.glob("*/manifest.json"):
        values = json.loads(path.read_text())
        values["notes"]["versions"]["torch"] = "1.0"
        path.write_text(json.dumps(values))
    with pytest.warns(UserWarning, match=r"other versions \(torch 1.0 to .*perhaps not to the bit"):
        ARSSAC.resume(tmp_path, toy())


@pytest.mark.filterwarnings("ignore:Checkpoints of this run are not exact", "ignore:This run does not go on")
def test_a_plain_buffer_that_stores_each_frame_once_keeps_the_newest(tmp_path):
    options = {
        "batch_size": 16,
        "buffer_size": 500,
        "learning_starts": 50,
        "policy_kwargs": {"net_arch": [8]},
    }
    options |= {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    model = ARSSAC("MlpPolicy", "Pendulum-v1", seed=0, **options)
    model.learn(190, callback=checkpoints(tmp_path, every=90))  # within an episode
    resumed = ARSSAC.resume(tmp_path, "Pendulum-v1")
    assert resumed.num_timesteps == 180
    assert np.array_equal(resumed.replay_buffer.observations[:181], model.replay_buffer.observations[:181])


# ---------------------------------------------------------------------- signals


@pytest.mark.parametrize(
    ("number", "raised"), [(signal.SIGTERM, SystemExit), (signal.SIGINT, KeyboardInterrupt)]
)
def test_a_signal_ends_training_with_a_checkpoint(number, raised, tmp_path, capfd):
    class Tell(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 500:
                os.kill(os.getpid(), number)
            return True

    _, whole = run_whole(make)
    seed_all(1)
    before = signal.getsignal(number)
    with pytest.raises(raised) as error:
        make().learn(TOTAL, callback=[RunCheckpoint(tmp_path), Tell()])
    assert signal.getsignal(number) is before and "checkpoint is written" in capfd.readouterr().err
    assert number is signal.SIGINT or error.value.code == 143
    model = ARSSAC.resume(tmp_path, toy())
    assert model.num_timesteps == 500
    model.learn(model.remaining_timesteps, reset_num_timesteps=False)
    assert_same(whole, everything(model))


def test_a_signal_in_the_last_rollout_is_no_less_heard(tmp_path):
    class Tell(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == TOTAL:
                signal.raise_signal(signal.SIGTERM)
            return True

    with pytest.raises(SystemExit):
        make().learn(TOTAL, callback=[RunCheckpoint(tmp_path), Tell()])
    model = ARSSAC.resume(tmp_path, toy())
    assert model.num_timesteps == TOTAL and model.remaining_timesteps == 0


GROUP = """
import sys
from tests.test_resume import *

class Tell(BaseCallback):
    def _on_step(self):
        if self.num_timesteps == 500:
            os.killpg(0, signal.SIGTERM)
        return True

make(env=lambda: toy(n_workers=2)).learn(TOTAL, callback=[RunCheckpoint(sys.argv[1]), Tell()])
"""


def test_a_sigterm_to_all_processes_ends_with_a_checkpoint(tmp_path):
    command = [sys.executable, "-W", "ignore", "-c", GROUP, str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": "."}
    done = subprocess.run(command, cwd=Path(__file__).parents[1], env=environment, start_new_session=True)
    assert done.returncode == 143 and ARSSAC.resume(tmp_path, toy()).num_timesteps == 500


def test_a_second_interrupt_does_not_wait(tmp_path):
    class Twice(BaseCallback):
        def _on_step(self):
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            raise AssertionError("went on")

    with pytest.raises(KeyboardInterrupt):
        ARSSAC("MlpPolicy", toy(), **OPTIONS).learn(TOTAL, callback=[RunCheckpoint(tmp_path), Twice()])
    assert not list(tmp_path.glob("step-*"))


def test_signals_are_left_alone_outside_the_main_thread(tmp_path):
    before, errors = signal.getsignal(signal.SIGTERM), []

    def work():
        try:
            short(tmp_path)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert not errors and signal.getsignal(signal.SIGTERM) is before and list(tmp_path.glob("step-*"))


# ---------------------------------------------------------------------- divergence


def test_diverged_networks_are_not_saved_and_the_last_good_checkpoint_is_named(tmp_path):
    class Poison(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 480:
                with th.no_grad():
                    next(self.model.critic.parameters()).fill_(float("nan"))
            return True

    with pytest.raises(DivergedError, match=r"step 480.*The last good checkpoint is .*step-000000000400"):
        ARSSAC("MlpPolicy", toy(), **OPTIONS).learn(
            TOTAL, callback=[checkpoints(tmp_path), Poison()], log_interval=1000
        )
    assert ARSSAC.resume(tmp_path, toy()).num_timesteps == 400


def test_a_temperature_of_nan_is_no_good_checkpoint(tmp_path):
    model = make()
    with th.no_grad():
        model.log_ent_coef.fill_(float("nan"))
    model.env.reset()
    with pytest.raises(DivergedError, match="hold NaN"):
        write_checkpoint(model, CheckpointFolder(tmp_path))


# ---------------------------------------------------------------------- refused


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every": 0}, "every=0 must be an integer of at least 1"),
        ({"every": 2.5}, "every=2.5 must be an integer"),
        ({"every_minutes": 0}, "every_minutes=0 must be a positive number"),
        ({"every_minutes": True}, "every_minutes=True must be a positive number"),
        ({"keep": 0}, "keep=0 must be an integer of at least 1"),
        ({"every_minutes": None, "handle_signals": False}, "would never write a checkpoint"),
        ({"files": ["a/state.pt"]}, "must have different names, none of them state.pt"),
        ({"files": ["a/log", "b/log"]}, "must have different names"),
    ],
)
def test_wrong_options_are_refused(options, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        RunCheckpoint(tmp_path, **options)


def test_it_is_refused_where_it_would_not_work(tmp_path):
    model = ARSSAC("MlpPolicy", toy(), **OPTIONS)
    with pytest.raises(ConfigError, match="inside an event callback is never told of rollouts"):
        model.learn(100, callback=EveryNTimesteps(10, RunCheckpoint(tmp_path)))
    with pytest.raises(ConfigError, match="not of SAC; use SB3's CheckpointCallback"):
        SAC("MlpPolicy", "Pendulum-v1").learn(10, callback=RunCheckpoint(tmp_path))
    short(tmp_path / "other")
    with pytest.raises(
        ConfigError, match=r"holds checkpoints of another run.*by ARSSAC.resume, or choose another"
    ):
        model.learn(100, callback=RunCheckpoint(tmp_path / "other"))
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be made"):
        model.learn(100, callback=RunCheckpoint(tmp_path / "file" / "below"))


def test_another_algorithm_other_tasks_or_sizes_are_refused(tmp_path):
    short(tmp_path)
    with pytest.raises(CheckpointError, match=r"use ARSSAC.resume"):
        ARSTQC.resume(tmp_path, toy())
    with pytest.raises(CheckpointError, match="is of the tasks"):
        ARSSAC.resume(tmp_path, toy(tasks=["point-west", "point-east", "point-north", "point-south"]))
    with pytest.raises(ConfigError, match="made with 4 envs, this env has 8"):
        ARSSAC.resume(tmp_path, toy(n_envs_per_task=2))
    with pytest.raises(CheckpointError, match="does not fit this model"):
        ARSSAC.resume(tmp_path, toy(), policy_kwargs={"net_arch": [8]})
    with pytest.raises(ConfigError, match="buffer_size=1_000 is more than the run's 130"):
        ARSSAC.resume(tmp_path, toy(), buffer_size=1000)
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        ARSSAC.resume(tmp_path / "nowhere", toy())


def test_a_checkpoint_names_no_code(tmp_path):
    short(tmp_path)
    state = max(tmp_path.glob("step-*")) / "state.pt"
    saved = th.load(state, weights_only=True)
    saved["options"]["policy_kwargs"]["activation_fn"] = {"__class__": "os:system"}
    th.save(saved, state)
    manifest = state.with_name("manifest.json")
    values = json.loads(manifest.read_text())
    for record in values["files"]:
        if record["path"].endswith("state.pt"):
            record["bytes"] = state.stat().st_size
            record["sha256"] = hashlib.sha256(state.read_bytes()).hexdigest()
    manifest.write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match="names a class of 'os'"):
        ARSSAC.resume(tmp_path, toy())


def test_two_processes_do_not_write_into_one_folder(tmp_path):
    script = "import sys, time; from pathlib import Path; from sb3_ars.checkpoints import lock\n"
    script += "file = lock(Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"
    command = [sys.executable, "-c", script, str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": "."}
    other = subprocess.Popen(command, cwd=Path(__file__).parents[1], env=environment, stdout=subprocess.PIPE)
    try:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(CheckpointError, match="Another process is training the run"):
            short(tmp_path)
    finally:
        other.kill()
        other.communicate()
    with lock(tmp_path):
        short(tmp_path)  # this process may


@pytest.mark.metaworld
def test_every_metaworld_task_goes_on_in_the_middle_of_an_episode():
    before, after = (
        make_metaworld_env("MT50", seed=0, n_workers=workers, max_episode_steps=40) for workers in (0, 2)
    )
    actions = np.random.default_rng(0).uniform(-1, 1, (110, 50, 4)).astype(np.float32)
    before.reset()
    for action in actions[:65]:  # 25 steps into the second episode
        obs = before.step(action)[0]
    assert np.array_equal(after.restore_checkpoint_state(before.checkpoint_state()), obs)
    for action in actions[65:]:
        for a, b in zip(before.step(action)[:3], after.step(action)[:3], strict=True):
            assert np.array_equal(a, b)
    for env in (before, after):
        env.close()
