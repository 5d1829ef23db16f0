"""Protocols, evaluation per task, the callback that keeps the best model."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ars import ARSSAC, ConfigError, TaskEvalCallback, evaluate_tasks, make_multitask_env, make_toy_env
from sb3_ars.envs.toy import PointTask
from sb3_ars.evaluation import PROTOCOLS, EvaluationProtocol, _episodes_of_env, make_evaluation_env

SHORT = EvaluationProtocol("short", n_episodes=3, max_episode_steps=None, goals=None)


class Scripted(PointTask):
    """Succeeds at the third step of every second episode, and ends somewhere else."""

    def __init__(self):
        super().__init__(max_episode_steps=5)
        self.episode = -1

    def reset(self, *, seed=None, options=None):
        self.episode = 0 if seed is not None else self.episode + 1
        return super().reset(seed=seed, options=options)

    def step(self, action):
        obs, _, terminated, truncated, _ = super().step(action)
        return obs, 2.0, terminated, truncated, {"success": float(self.episode % 2 == 0 and self._steps == 3)}


class Still:
    """A policy that does nothing, to see what evaluation asks of one."""

    def __init__(self):
        self.calls = []

    def predict(self, observation, deterministic=False):
        self.calls.append(deterministic)
        return np.zeros((len(observation), 2), np.float32), None


def scripted_env(n_envs_per_task=1):
    return make_multitask_env(
        {"hit": Scripted, "point": PointTask},
        n_envs_per_task=n_envs_per_task,
        max_episode_steps=None,
        seed=0,
        n_workers=0,
    )


def test_success_once_and_at_the_end_are_told_apart():
    policy = Still()
    result = evaluate_tasks(policy, scripted_env(), SHORT, deterministic=False)
    assert result.task_names == ("hit", "point")
    assert result.success_once[0].tolist() == [1, 0, 1] and result.success_at_end[0].tolist() == [0, 0, 0]
    assert result.returns[0].tolist() == [10, 10, 10] and result.lengths[0].tolist() == [5, 5, 5]
    assert result.success[0] == pytest.approx(2 / 3) and set(policy.calls) == {False}
    table = result.table()
    assert table.loc["hit"].tolist() == pytest.approx([2 / 3, 0, 10, 5])


def test_episodes_are_shared_among_a_tasks_envs_beforehand():
    assert _episodes_of_env(np.array([0, 0, 0, 1]), 2, 10).tolist() == [4, 3, 3, 10]
    assert evaluate_tasks(Still(), scripted_env(2), SHORT).returns.shape == (2, 3)


@pytest.mark.parametrize(
    ("name", "episodes", "horizon"), [("paper", 10, 500), ("metaworld", 50, 500), ("h150", 10, 150)]
)
def test_named_protocols_say_what_they_are(name, episodes, horizon):
    protocol = PROTOCOLS[name]
    assert (protocol.n_episodes, protocol.max_episode_steps) == (episodes, horizon)
    assert f"protocol {name}: {episodes} episodes per task, horizon {horizon}" in protocol.describe()


def test_evaluation_leaves_the_global_generator_and_training_env_alone():
    model = ARSSAC("MlpPolicy", make_toy_env(seed=0), policy_kwargs={"net_arch": [8]}, seed=0)
    before = th.get_rng_state()
    first = evaluate_tasks(model, make_toy_env(seed=3), SHORT, deterministic=False)
    second = evaluate_tasks(model, make_toy_env(seed=9), SHORT, deterministic=False)
    assert np.array_equal(first.returns, second.returns)  # the evaluation's own seed rules
    assert th.equal(before, th.get_rng_state())
    with pytest.raises(ConfigError, match="training environment"):
        evaluate_tasks(model, model.env, SHORT)


def test_observation_statistics_of_training_are_used_in_evaluation():
    venv = VecNormalize(make_toy_env(seed=0), norm_reward=False)
    model = ARSSAC("MlpPolicy", venv, policy_kwargs={"net_arch": [8]}, batch_size=8, n_reset=0, seed=0).learn(
        200
    )
    evaluation = VecNormalize(make_toy_env(seed=1), norm_reward=False)
    evaluate_tasks(model, evaluation, SHORT)
    assert np.array_equal(evaluation.obs_rms.mean, venv.obs_rms.mean) and not evaluation.training


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"protocol": "papper"}, "Did you mean 'paper'"),
        ({"protocol": EvaluationProtocol("none", n_episodes=0)}, "n_episodes=0"),
        ({"protocol": "paper"}, "max_episode_steps is 50"),
        ({"env": DummyVecEnv([PointTask])}, "has no tasks"),
        ({"env": scripted_env()}, r"trained on \['point-east'"),
    ],
)
def test_a_wrong_evaluation_is_refused(change, message):
    model = ARSSAC("MlpPolicy", make_toy_env(seed=0), policy_kwargs={"net_arch": [8]})
    with pytest.raises(ConfigError, match=message):
        evaluate_tasks(**{"model": model, "env": make_toy_env(), "protocol": SHORT, **change})


def test_the_callback_keeps_the_best_model_by_mean_success_and_every_evaluation(tmp_path, monkeypatch):
    scores = iter([0.2, 0.8, 0.5])
    saved = []

    def fake(model, env, protocol, deterministic):
        result = evaluate_tasks(model, env, protocol, deterministic)
        result.success_once[:] = next(scores)
        return result

    monkeypatch.setattr("sb3_ars.callbacks.evaluation.evaluate_tasks", fake)
    model = ARSSAC(
        "MlpPolicy", make_toy_env(seed=0), policy_kwargs={"net_arch": [8]}, batch_size=8, n_reset=0, seed=0
    )
    monkeypatch.setattr(model, "save", lambda path: saved.append((path.name, model.num_timesteps)))
    callback = TaskEvalCallback(
        make_toy_env(seed=1), 100, SHORT, best_model_save_path=tmp_path, log_path=tmp_path
    )
    model.learn(320, callback=callback)
    assert saved == [
        ("best_model", 100),
        ("best_model", 200),
    ] and callback.best_score == pytest.approx(0.8)
    with np.load(tmp_path / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [100, 200, 300]
        assert evaluations["successes"].shape == evaluations["results"].shape == (3, 4, 3)
        assert evaluations["task_names"].tolist() == list(model.task_names)


def test_evaluation_does_not_change_training():
    def weights(callback):
        model = ARSSAC(
            "MlpPolicy",
            make_toy_env(seed=0),
            policy_kwargs={"net_arch": [8]},
            batch_size=8,
            n_reset=0,
            seed=0,
        )
        model.learn(300, callback=callback)
        return list(model.policy.parameters())

    callback = TaskEvalCallback(make_toy_env(seed=1), 100, SHORT, deterministic=False)
    assert all(th.equal(a, b) for a, b in zip(weights(None), weights(callback), strict=True))
    assert len(callback.history) == 3


def test_statistics_of_observations_in_training_or_evaluation_alone_are_refused():
    model = ARSSAC(
        "MlpPolicy", VecNormalize(make_toy_env(seed=0), norm_reward=False), policy_kwargs={"net_arch": [8]}
    )
    with pytest.raises(ConfigError, match="normalised in training"):
        evaluate_tasks(model, make_toy_env(), "env")


def test_a_protocol_whose_goals_the_env_does_not_have_is_refused():
    with pytest.raises(ConfigError, match="environment has its own goals"):
        evaluate_tasks(Still(), make_toy_env(max_episode_steps=500), "paper")


def test_the_callback_checks_its_environment_before_training():
    model = ARSSAC("MlpPolicy", make_toy_env(seed=0), policy_kwargs={"net_arch": [8]}, n_reset=0)
    with pytest.raises(ConfigError, match="max_episode_steps is 50"):
        model.learn(1000, callback=TaskEvalCallback(make_toy_env(), 500))
    assert model.num_timesteps == 0


@pytest.mark.parametrize("eval_freq", [0, -1, 2.5, True])
def test_a_bad_evaluation_frequency_is_refused(eval_freq):
    with pytest.raises(ConfigError, match="eval_freq"):
        TaskEvalCallback(make_toy_env(), eval_freq)


@pytest.mark.metaworld
def test_the_papers_protocol_goes_through_ten_stored_goals_in_order():
    env = make_evaluation_env(
        "reach", EvaluationProtocol("p", n_episodes=3, max_episode_steps=5), n_workers=0
    )
    seen = []
    obs = env.reset()
    for _ in range(4 * 5):
        seen.append(tuple(obs[0, 36:39]))
        obs, *_ = env.step(np.zeros((1, 4), np.float32))
    goals = seen[::5]
    assert len(set(goals)) == 3 and goals[3] == goals[0]
    env.close()
