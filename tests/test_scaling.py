"""Scales: the paper's presets at other sizes."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks.toy_methods import toy_config
from sb3_ars import make_toy_env
from sb3_ars.envs.toy import TOY_TASKS
from sb3_ars.errors import ConfigError
from sb3_ars.experiments import preset_names
from sb3_ars.experiments.config import EnvConfig, load_config, load_preset, with_options
from sb3_ars.experiments.runner import build_model, make_env, protocol_of
from sb3_ars.experiments.scaling import Scale, load_scale, scale_names, scaled
from sb3_ars.experiments.sweeps import load_sweep

PAPERS = [name for name in preset_names() if name not in ("toy", "demo")]
SMALLER = [name for name in scale_names() if name != "full"]


def at(preset, scale):
    return scaled(load_preset(preset), load_scale(scale))


def resets(config):
    return config.ars.reset_times(config.algorithm.total_timesteps, len(config.env.task_names))


@pytest.mark.parametrize("preset", PAPERS)
def test_full_changes_nothing(preset):
    assert at(preset, "full") == load_preset(preset)


@pytest.mark.parametrize("scale", SMALLER)
@pytest.mark.parametrize("preset", PAPERS)
def test_every_preset_keeps_its_method_and_has_room_for_it(preset, scale):
    before, after = load_preset(preset), at(preset, scale)
    assert after.scale == scale and after.algorithm.total_timesteps < 1_000_000
    kept = ("algorithm.algorithm", "policy.body", "policy.critic_body", "policy.critic_layer_norm", "ars.reset",
            "ars.gradient", "ars.task_weighting", "ars.max_task_loss", "schedule.name")  # fmt: skip
    for option in kept:
        part, name = option.split(".")
        assert getattr(getattr(after, part), name) == getattr(getattr(before, part), name), option
    # as many resets as at full size, none in the random phase; one more where adapters come after the last
    times, n_tasks = resets(after), len(after.env.task_names)
    late = before.ars.lora is not None and times[-1] > 0.5 * after.algorithm.total_timesteps
    assert len(times) == len(resets(before)) + late
    starts = after.algorithm.learning_starts
    starts = after.algorithm.total_timesteps / 80 if starts == "auto" else starts
    starts = max(starts, n_tasks * after.algorithm.batch_size)
    assert all(time > starts for time in times) and len(set(times)) == len(times)
    # each has time to act before the next: as many joint steps as an episode is long, and its own updates
    between = np.diff([*times, after.algorithm.total_timesteps]) / n_tasks
    assert all(steps >= after.env.max_episode_steps for steps in between)
    if after.schedule.name == "smt":
        after.schedule.check_tasks(n_tasks)
        after.schedule.check_length(after.algorithm.total_timesteps - starts)


@pytest.mark.parametrize("scale", SMALLER)
def test_the_numbers_of_resets_stay_apart(scale):
    names = [f"mt10-ablation-n-reset-{k}" for k in range(1, 10)]
    configs = [at(name, scale) for name in names]
    assert [len(resets(config)) for config in configs] == list(range(1, 10))
    assert configs[3] == at("mt10-ars", scale)
    until = load_scale(scale).resets_until * configs[0].algorithm.total_timesteps
    for count, config in enumerate(configs, start=1):
        expected = [int(until * k / (count + 1)) for k in range(1, count + 1)]
        assert resets(config) == pytest.approx(expected, abs=1)


@pytest.mark.parametrize("scale", SMALLER)
def test_a_task_alone_stays_alone_and_hard_tasks_stay_hard(scale):
    hard = set(load_scale(scale).stands_for.values())
    for task, factor in itertools.product(("push", "pick-place", "shelf-place", "basketball"), (1, 100)):
        alone = at(f"single-{task}-scale-{factor}", scale)
        assert alone.env.task_names == (load_scale(scale).stands_for[f"{task}-v3"],)
        assert alone.ars.reward_scaling == factor
        together = at("mt10-sac", scale)
        ratio = together.algorithm.total_timesteps / alone.algorithm.total_timesteps
        assert ratio == len(together.env.task_names)  # as many steps of the task as among others
    scaling = at("mt10-ablation-fixed-100-hard", scale).ars.reward_scaling
    assert scaling == dict.fromkeys(hard, 100.0)


def test_the_toy_scale_is_the_toy_table_but_for_its_resets():
    table, sweep = toy_config("mt10-ars", 0), at("mt10-ars", "toy")
    assert table.ars.param_resets == [6000] and sweep.ars.param_resets == [2400, 4800, 7200, 9600]
    assert (table.evaluation.every, sweep.evaluation.every) == (None, 2000)
    same = dataclasses.replace(sweep, ars=table.ars, evaluation=table.evaluation)
    assert same == table


def test_a_length_changes_what_counts_steps_in_proportion():
    scale = load_scale("toy")
    twice = scale.lasting(2 * scale.steps_per_task)
    assert twice.updates_after_reset == 2 * scale.updates_after_reset
    assert resets(scaled(load_preset("mt10-ars"), twice)) == [4800, 9600, 14_400, 19_200]
    with pytest.raises(ConfigError, match="scale full has no steps_per_task"):
        load_scale("full").lasting(100)


def own(tmp_path, **values):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(values))
    return str(path)


def test_a_scale_of_ones_own_is_a_file(tmp_path):
    scale = load_scale(
        own(
            tmp_path,
            tasks="toy",
            steps_per_task=200,
            random_steps=20,
            resets_at=[0.5],
            updates_after_reset=3,
            evaluations=4,
            log_episodes=2,
            at_most={"hidden_width": 8, "hidden_layers": 1, "max_episode_steps": 20, "n_experts": 2},
            options={"env": {"n_workers": 0}, "algorithm": {"batch_size": 8}},
        )
    )
    assert scale.name == "mine"
    config = scaled(load_preset("mt50-moore-ars"), scale)
    assert (config.scale, config.policy.net_arch, config.env.max_episode_steps) == ("mine", (8,), 20)
    assert config.policy.body_options["n_experts"] == 2 and resets(config) == [400]
    assert (config.algorithm.total_timesteps, config.algorithm.learning_starts) == (800, 80)
    assert (config.evaluation.every, config.log_interval, config.ars.updates_after_reset) == (200, 8, 3)
    assert config.algorithm.learning_rate == load_preset("mt50-moore-ars").algorithm.learning_rate
    model = build_model(config, make_env(config))
    model.learn(config.algorithm.total_timesteps)
    assert model.n_resets == 1 and model.num_timesteps == 800


def test_horizons_shorter_than_the_scales_stay(tmp_path):
    scale = load_scale(own(tmp_path, at_most={"max_episode_steps": 200}))
    assert scaled(load_preset("mt10-ars-ln-h150"), scale).env.max_episode_steps == 150
    assert scaled(load_preset("mt10-ars-ln"), scale).env.max_episode_steps == 200


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"steps_per_tsk": 3}, "'steps_per_tsk' is no option of Scale.*Did you mean 'steps_per_task'"),
        ({"steps_per_task": 0}, "scale mine: steps_per_task=0 must be an integer of at least 1"),
        ({"tasks": ["reech"]}, "'reech' is not a Meta-World task. Did you mean 'reach'"),
        ({"tasks": "toy", "stands_for": {"push-v3": "point-up"}}, "stands_for 'push-v3' is 'point-up', which is not"),
        ({"stands_for": {"push-v3": "reach-v3"}}, "stands_for goes with tasks"),
        ({"resets_at": [0.5, 0.2]}, r"resets_at=\(0.5, 0.2\) must be a list of increasing shares"),
        ({"resets_at": [1.5]}, "resets_at entry=1.5 must be a share of the run"),
        ({"resets_until": 0}, "resets_until=0 must be a share of the run"),
        ({"at_most": {"hidden_widht": 3}}, "at_most has no cap 'hidden_widht'.*Did you mean 'hidden_width'"),
        ({"at_most": {"rank": -1}}, "at_most rank=-1 must be an integer of at least 1"),
        ({"options": {"algorithm": {"lerning_rate": 1}}}, "'lerning_rate' is no option of AlgorithmConfig"),
        ({"options": {"ars": {"n_reset": 2}}}, "ars.n_reset is no scale's to set"),
        ({"options": {"seed": 2}}, "seed is no scale's to set"),
        ({"options": {"env": 2}}, "EnvConfig must be a mapping"),
        ({"options": 3}, r"options=3 must be a mapping, such as \{env: "),
        ({"at_most": 3}, r"at_most=3 must be a mapping, such as \{hidden_width: 64\}"),
        ({"at_most": None}, "at_most=None must be a mapping"),
        ({"tasks": "toy", "stands_for": ["push-v3"]}, r"stands_for=\('push-v3',\) must be a mapping"),
        ({"tasks": 3}, "tasks=3 must be a benchmark's name or a list of tasks"),
        ({"tasks": [3]}, r"tasks=\(3,\) must be a benchmark's name or a list of tasks"),
        ({"description": 3}, "description=3 must be a line of text"),
    ],
)  # fmt: skip
def test_a_scale_that_cannot_work_is_refused_by_name(values, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        load_scale(own(tmp_path, **values))


def test_a_file_that_is_no_scale_is_refused(tmp_path):
    assert load_scale(own(tmp_path, options={"env": None})).options == {
        "env": None
    }  # a part with nothing in it
    path = tmp_path / "mine.yaml"
    for load in (load_scale, load_sweep, lambda name: load_config(Path(name))):
        path.write_text("tasks: [")
        with pytest.raises(ConfigError, match=r"mine.yaml is not valid YAML: .*line 1") as caught:
            load(str(path))
        assert "\n" not in str(caught.value)
        path.write_bytes(b"\xff\xfe")
        with pytest.raises(ConfigError, match=r"mine.yaml is no text in UTF-8; save it as that"):
            load(str(path))
    (tmp_path / "mine.yaml").write_text("- toy")
    with pytest.raises(ConfigError, match="must be a mapping of a scale's options"):
        load_scale(str(tmp_path / "mine.yaml"))
    with pytest.raises(ConfigError, match=r"There is no scale 'smal'.*Did you mean 'small'"):
        load_scale("smal")


def test_a_task_that_nothing_stands_for_is_refused(tmp_path):
    scale = load_scale(own(tmp_path, tasks="toy", stands_for={"push-v3": "point-west"}))
    assert scaled(load_preset("single-push-scale-1"), scale).env.tasks == "point-west"
    with pytest.raises(ConfigError, match="stands_for has no task for 'basketball-v3'"):
        scaled(load_preset("single-basketball-scale-1"), scale)


def test_descriptions_hold_no_times():
    for name in scale_names():
        assert "minute" not in load_scale(name).description


def test_every_option_of_a_scale_is_documented():
    page = (Path(__file__).parent.parent / "docs" / "sweeps.md").read_text()
    for option in dataclasses.fields(Scale):
        if option.name != "name":
            assert f"| `{option.name}` |" in page, option.name


# ---------------------------------------------------------------------- toy tasks by name


def test_toy_tasks_by_name_are_the_same_tasks():
    all_of_them, one = make_toy_env(seed=0), make_toy_env(seed=0, tasks=["point-west"])
    assert one.task_names == ("point-west",) and all_of_them.task_names == TOY_TASKS
    position = TOY_TASKS.index("point-west")
    for env, index in ((all_of_them, position), (one, 0)):
        assert env.get_attr("reward_scale", [index]) == [0.1]
        assert env.get_attr("_cos", [index]) == [-1.0]  # its push is turned by half a circle


def test_toy_tasks_by_name_are_a_configuration():
    env = EnvConfig(tasks="point-west", max_episode_steps=30)
    assert env.is_toy and env.task_names == ("point-west",)
    assert EnvConfig(tasks="toy").task_names == TOY_TASKS and not EnvConfig().is_toy
    config = dataclasses.replace(load_preset("toy"), env=env)
    assert make_env(config).task_names == ("point-west",)
    assert protocol_of(config).describe() == "protocol toy: 20 episodes per task, horizon 30"
    mixed = dataclasses.replace(config, env=EnvConfig(tasks=("point-west", "reach")))
    with pytest.raises(ConfigError, match="'reach' is no toy task"):
        make_env(mixed)
    twice = dataclasses.replace(config, env=EnvConfig(tasks=("point-west", "point-west")))
    with pytest.raises(ConfigError, match="must name at least one toy task, and each once"):
        make_env(twice)


def test_options_are_laid_over_a_configuration():
    config = with_options(load_preset("toy"), {"log_interval": 3, "policy": {"net_arch": [4, 4]}}, "here")
    assert config.log_interval == 3 and config.policy.net_arch == (4, 4)
    assert config.algorithm == load_preset("toy").algorithm
    with pytest.raises(ConfigError, match="here: 'policies' is no option of RunConfig"):
        with_options(config, {"policies": {}}, "here")
