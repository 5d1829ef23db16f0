"""SMT's schedule: its rules under random successes, and a model that collects as it says."""

import csv
import dataclasses
import json
from functools import partial
from itertools import chain, pairwise

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EveryNTimesteps
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ars import ARSSAC, make_multitask_env, make_toy_env
from sb3_ars.callbacks.schedule import TaskScheduleCallback
from sb3_ars.core.schedule import POOLS, SMTConfig, SMTSchedule
from sb3_ars.errors import ConfigError, EnvContractError

MOVES = {
    "main": {"training"},
    "training": {"main", "solved", "unsolvable"},
    "solved": set(),
    "unsolvable": set(),
}


@dataclasses.dataclass
class Step:
    """One vector step: what was decided before it, and who made how many environment steps in it."""

    at: int
    stage: int
    pools: dict[str, list[int]]
    new: list[int] | None  # in training; None without a decision
    budgets: list[float]
    active: list[int]
    size: int


class Run:
    """A schedule under random successes: the tasks' chances, the options and the horizon come from the seed."""

    def __init__(self, seed, through_json=False, **options):
        rng = np.random.default_rng(seed)
        self.n_tasks = int(rng.integers(2, 9))
        self.n_envs = int(rng.integers(1, 4))  # of each task
        self.start = 7 * self.n_tasks * self.n_envs
        self.total = self.start + int(rng.integers(200, 4000))
        drawn = {
            "pool_size": int(rng.integers(1, self.n_tasks)),
            "first_stage": float(rng.uniform(0.3, 1)),
            "budget_share": float(rng.uniform(0.05, 1)),
            "window": int(rng.integers(1, 8)),
            "interval": int(rng.integers(1, 200)),
        }
        self.config = SMTConfig(**(drawn | options))
        chance = rng.choice([0.0, 0.5, 0.97, 1.0], self.n_tasks)
        self.schedule = schedule = self.make(seed)
        self.first = {pool: schedule.tasks(pool) for pool in POOLS}
        self.steps, at = [], self.start
        while at < self.total:
            if through_json and at % 5 == 0:
                state = json.loads(json.dumps(schedule.state()))
                schedule = self.make(None)
                schedule.restore(state)
            new = schedule.decide(at) if schedule.is_due(at) else None
            active = schedule.active
            pools = {pool: schedule.tasks(pool) for pool in POOLS}
            budgets = schedule.state()["budget"]
            self.steps.append(Step(at, schedule.stage, pools, new, budgets, active, self.n_envs))
            at += self.n_envs * len(active)
            for task in active:
                if rng.random() < 0.1:  # an episode ends
                    schedule.add_episode(task, rng.random() < chance[task])
        self.end = at

    def make(self, seed):
        return SMTSchedule(self.config, self.n_tasks, self.start, self.total, seed=seed)

    @property
    def budget_end(self):
        """B1, counted from the start of the run."""
        return self.start + round(self.config.first_stage * (self.total - self.start))

    def of_stage(self, stage):
        return [step for step in self.steps if step.stage == stage]


@pytest.fixture(scope="module")
def runs():
    return [Run(seed) for seed in range(100)]


def test_the_pools_hold_every_task_once_and_tasks_move_only_as_the_method_says(runs):
    seen = set()
    for run in runs:
        where = {task: pool for pool, tasks in run.first.items() for task in tasks}
        for step in run.steps:
            assert sorted(chain.from_iterable(step.pools.values())) == list(range(run.n_tasks))
            now = {task: pool for pool, tasks in step.pools.items() for task in tasks}
            moved = [task for task in now if now[task] != where[task]]
            assert all(now[task] in MOVES[where[task]] for task in moved)
            assert not moved or step.new is not None
            assert (step.new or []) == [] or set(step.new) == {t for t in moved if now[t] == "training"}
            seen |= {(where[task], now[task]) for task in moved}
            where = now
    assert {(a, b) for a in MOVES for b in MOVES[a]} <= seen  # else this test would show little


def test_in_the_first_stage_the_training_pool_collects_and_is_full_while_tasks_wait(runs):
    for run in runs:
        for step in run.of_stage(1):
            training = step.pools["training"]
            assert step.active == training and 0 < len(training) <= run.config.pool_size
            assert len(training) == run.config.pool_size or not step.pools["main"]


def test_no_task_exceeds_its_budget_by_more_than_an_interval_or_leaves_unsolved_before(runs):
    n_left = n_renewed = 0
    for run in runs:
        used, training = np.zeros(run.n_tasks), []
        budgets = np.zeros(run.n_tasks)
        for number, step in enumerate(run.steps):
            if number == 0 or step.new is not None:
                left = set(training) - set(step.pools["training"]) - set(step.pools["solved"])
                assert all(used[task] >= budgets[task] - 1e-9 for task in left)
                fresh = [
                    task
                    for task in step.pools["training"]
                    if task not in training or used[task] >= budgets[task]
                ]
                n_left, n_renewed = n_left + len(left), n_renewed + len(set(fresh) & set(training))
                used[fresh] = 0
                budgets[fresh] = run.config.budget_share * (run.budget_end - step.at) / run.config.pool_size
                training = step.pools["training"]
            assert step.budgets == budgets.tolist()
            for task in training:
                used[task] += step.size
                assert (
                    used[task] <= budgets[task] + run.config.interval + step.size
                )  # decisions lie between steps
    assert n_left > 100 and n_renewed > 10


def test_the_stages_have_exactly_their_samples(runs):
    early = 0
    for run in runs:
        first, second = run.of_stage(1), run.of_stage(2)
        collected = [sum(step.size * len(step.active) for step in stage) for stage in (first, second)]
        largest = run.n_envs * run.n_tasks
        assert run.start + sum(collected) == run.end and run.total <= run.end < run.total + largest
        if second:
            started = second[0]
            has_nobody_left = not started.pools["main"] and started.at < run.budget_end
            # less than one vector step too many; none where one environment steps at a time
            assert has_nobody_left or 0 <= started.at - run.budget_end < run.n_envs * run.config.pool_size
            early += has_nobody_left
    assert early > 5


def test_the_second_stage_collects_nothing_from_solved_tasks(runs):
    kinds = set()
    for run in runs:
        for step in run.of_stage(2):
            pools = step.pools
            assert not pools["training"]
            expected = pools["unsolvable"] or pools["main"] or list(range(run.n_tasks))
            assert step.active == expected
            if len(pools["solved"]) < run.n_tasks:
                assert not set(step.active) & set(pools["solved"])
            kinds.add("unsolvable" if pools["unsolvable"] else "main" if pools["main"] else "all")
    assert kinds == {"unsolvable", "main", "all"}


@pytest.mark.parametrize("seed", range(12))
def test_a_schedule_restored_from_json_decides_as_the_original(seed):
    run, again = Run(seed), Run(seed, through_json=True)
    assert run.steps == again.steps and any(step.new for step in run.steps)


def test_a_schedule_continued_over_a_shorter_run_ends_its_first_stage_there():
    config = SMTConfig(pool_size=2, interval=100)
    state = SMTSchedule(config, n_tasks=3, start=0, total=100_000).state()
    schedule = SMTSchedule(config, n_tasks=3, start=90, total=1000)
    schedule.restore(state)
    assert schedule.first_stage_end == 850 and schedule.decide(100) == []
    assert schedule.decide(850) == [] and schedule.stage == 2 and schedule.tasks("main") == [0, 1, 2]


def test_a_scenario_by_hand():
    config = SMTConfig(
        pool_size=2, first_stage=0.5, budget_share=0.5, solved=0.9, unsolvable=0.1, window=2, interval=100
    )
    schedule = SMTSchedule(config, n_tasks=4, start=400, total=2400, seed=0)  # the first stage ends at 1400
    a, b = sorted(schedule.tasks("training"))  # each has a budget of 0.5 * 1000 / 2 = 250 steps
    assert schedule.first_stage_end == 1400 and schedule.state()["budget"][a] == 250
    schedule.add_episode(a, 1)
    assert not schedule.is_due(499) and schedule.is_due(500)
    assert schedule.decide(500) == []  # one success is no whole window
    schedule.add_episode(a, 1)
    schedule.add_episode(b, 0)
    (c,) = schedule.decide(600)  # a is solved; b has used 100
    assert schedule.tasks("solved") == [a] and schedule.tasks("training") == sorted([b, c])
    assert schedule.state()["budget"][c] == 0.5 * 800 / 2
    assert schedule.decide(700) == [] and schedule.decide(800) == []
    (d,) = schedule.decide(900)  # b has used 250 without success
    assert schedule.tasks("unsolvable") == [b] and schedule.tasks("training") == sorted([c, d])
    schedule.add_episode(d, 1)
    schedule.add_episode(d, 0)
    schedule.add_episode(c, 0)
    schedule.add_episode(c, 1)
    assert schedule.decide(1000) == []  # c's 200 are spent, it is neither, and nobody else waits: it goes on
    assert schedule.state()["budget"][c] == 0.5 * 400 / 2 and schedule.state()["episodes"][c] == [0, 1]
    for task, success in ((c, 0), (c, 0), (d, 1), (d, 1)):
        schedule.add_episode(task, success)
    assert schedule.is_due(1400) and schedule.decide(1400) == [] and schedule.stage == 2
    assert schedule.tasks("solved") == sorted([a, d]) and schedule.tasks("unsolvable") == sorted([b, c])
    assert schedule.active == sorted([b, c]) and not schedule.is_due(2000)


def test_the_hardest_waiting_task_comes_next_and_unseen_ones_before_all():
    schedule = SMTSchedule(SMTConfig(pool_size=1, interval=10), n_tasks=3, start=0, total=10_000, seed=1)
    schedule.restore(schedule.state() | {"success": [0.3, 0.2, None], "pool": ["training", "main", "main"]})
    schedule._budget[0] = 1
    assert schedule.decide(10) == [2]
    schedule._budget[2] = 1
    schedule.add_episode(2, 0)
    schedule.add_episode(2, 1)
    assert schedule.decide(20) == [1] and schedule.state()["success"] == [0.3, 0.2, 0.5]


def test_the_seed_decides_who_comes_first():
    def first(seed):
        return tuple(SMTSchedule(SMTConfig(), 10, 0, 1000, seed).tasks("training"))

    assert first(4) == first(4) and len({first(seed) for seed in range(50)}) > 20


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"pool_size": 0}, "pool_size=0 must be an integer of at least 1"),
        ({"window": 2.5}, "window=2.5"),
        ({"interval": True}, "interval=True"),
        ({"first_stage": 0}, "first_stage=0 must be a number above 0 and at most 1"),
        ({"budget_share": 1.2}, "budget_share=1.2"),
        ({"solved": "0.9"}, "solved='0.9'"),
        ({"unsolvable": -0.1}, "unsolvable=-0.1"),
        ({"unsolvable": 0.9}, "unsolvable=0.9 must be less than solved=0.9"),
    ],
)
def test_options_that_cannot_work_are_refused_by_name(options, named):
    with pytest.raises(ConfigError, match=named):
        SMTConfig(**options)


@pytest.mark.parametrize(
    ("n_tasks", "named"), [(1, "here is only one"), (3, "pool_size=3 holds all 3 tasks")]
)
def test_too_few_tasks_are_refused(n_tasks, named):
    with pytest.raises(ConfigError, match=named):
        SMTSchedule(SMTConfig(), n_tasks, 0, 1000)


def test_a_schedule_of_other_tasks_is_refused():
    state = SMTSchedule(SMTConfig(), 5, 0, 1000).state()
    with pytest.raises(ConfigError, match="saved schedule has 5 tasks, this run has 4"):
        SMTSchedule(SMTConfig(), 4, 0, 1000).restore(state)


# ---------------------------------------------------------------- a model that collects as the schedule says


class Known(gym.Env):
    """Episodes of 5 steps whose successes are given, over and over; none where there are none."""

    def __init__(self, successes):
        self.observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.successes, self.episode, self.at = successes, -1, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.at = self.episode + 1, 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.at += 1
        info = {"success": self.successes[self.episode % len(self.successes)]} if self.successes else {}
        return np.full(2, self.at / 5, np.float32), 1.0, False, self.at == 5, info


SUCCESSES = {"easy": (1,), "hard": (0,), "easy too": (1,), "half": (0, 1)}
CONFIG = SMTConfig(pool_size=2, first_stage=0.7, budget_share=0.3, window=4, interval=40)
RANDOM, TOTAL = 96, 800


def known_env(successes=SUCCESSES, **options):
    return make_multitask_env(
        {name: partial(Known, s) for name, s in successes.items()}, n_workers=0, **options
    )


def model_of(env, **options):
    options = {
        "n_reset": 0,
        "updates_after_reset": 3,
        "learning_starts": RANDOM,
        "reward_scaling": "none",
    } | options
    options = {"train_freq": 4, "gradient_steps": 0} | options  # what is learned does not matter here
    return ARSSAC("MlpPolicy", env, batch_size=8, seed=0, policy_kwargs={"net_arch": [8]}, **options)


class Watch(BaseCallback):
    """Notes what the schedule before it in the list decided, and what was collected until then."""

    def __init__(self, saves=None):
        super().__init__()
        self.seen, self.saves = [], dict(saves or {})  # from which step on to save where

    def _on_rollout_start(self):
        model = self.model
        for at, path in self.saves.items():
            if model.num_timesteps >= at and not path.exists():
                model.save(path)
                model.save_replay_buffer(path.with_suffix(".buffer"))
        state = model.schedule_state
        self.seen.append(
            (
                model.num_timesteps,
                model.replay_buffer.task_size.tolist(),
                model.n_resets,
                state and dict(state),
            )
        )

    def _on_step(self):
        return True


@pytest.fixture(scope="module", params=[1, 2])
def trained(request, tmp_path_factory):
    model = model_of(known_env(n_envs_per_task=request.param), gradient_steps=1)
    folder = tmp_path_factory.mktemp("saved")
    watch = Watch({at: folder / f"{at}.zip" for at in (40, 300, 700)})
    schedule = TaskScheduleCallback(CONFIG)
    return model.learn(TOTAL, callback=[schedule, watch]), watch, schedule


def test_the_run_makes_exactly_its_steps_and_stores_each(trained):
    model, watch, _ = trained
    assert TOTAL <= model.num_timesteps < TOTAL + 4 * model.n_envs // 2  # the last rollout may overshoot
    assert model.replay_buffer.task_size.sum() == model.num_timesteps
    for at, sizes, _, _ in watch.seen:
        assert sum(sizes) == at


def test_the_random_phase_collects_all_tasks_equally(trained):
    _, watch, _ = trained
    at, sizes, _, state = next(row for row in watch.seen if row[3] is not None)
    assert at == RANDOM == state["start"] and sizes == [RANDOM // 4] * 4
    assert all(row[3] is None and len(set(row[1])) == 1 for row in watch.seen if row[0] < RANDOM)


def test_only_scheduled_tasks_collect(trained):
    _, watch, _ = trained
    for (_, before, _, state), (_, after, _, _) in pairwise(watch.seen):
        grown = [task for task in range(4) if after[task] > before[task]]
        if state is None:
            assert grown == [0, 1, 2, 3]
        elif state["stage"] == 1:
            assert grown == [task for task in range(4) if state["pool"][task] == "training"]
        else:
            assert grown == [1]  # the hard one


def test_tasks_end_where_their_successes_belong(trained):
    model, _, schedule = trained
    assert model.schedule_state["pool"] == ["solved", "unsolvable", "solved", "main"]
    assert model.schedule_state == schedule.schedule.state()
    json.dumps(model.schedule_state)


def test_the_networks_begin_anew_whenever_tasks_enter_the_pool(trained):
    model, watch, _ = trained
    rows = [row for row in watch.seen if row[3] is not None]
    n_entries = 0
    for (_, _, resets, state), (_, _, resets_after, after) in pairwise(rows):
        has_new = any(new == "training" != old for new, old in zip(after["pool"], state["pool"], strict=True))
        assert resets_after - resets == has_new
        n_entries += has_new
    assert model.n_resets == n_entries >= 1
    n_rollouts = sum(at > RANDOM for at, *_ in watch.seen[1:]) + 1
    assert model._n_updates == n_rollouts + 3 * n_entries


def test_all_tasks_are_active_again_after_the_run(trained):
    model, _, _ = trained
    env = model.get_env()
    env.reset()
    assert (env.step(np.zeros((model.n_envs, 1)))[1] == 1).all() and model.active_tasks is None


def test_the_pools_are_logged_in_every_row_after_the_random_phase(tmp_path):
    model = model_of(known_env())
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(TOTAL, callback=TaskScheduleCallback(CONFIG), log_interval=1)
    model.dump_logs()
    model.logger.close()
    rows = list(csv.DictReader((tmp_path / "progress.csv").read_text().splitlines()))
    sizes = [[row[f"schedule/n_{pool}"] for pool in POOLS] for row in rows]
    n_before = sum(int(row["time/total_timesteps"]) <= RANDOM for row in rows)
    assert all(size == [""] * 4 for size in sizes[:n_before])
    assert all(sum(map(int, size)) == 4 for size in sizes[n_before:]) and len(sizes) > n_before + 20
    assert sizes[-1] == ["1", "0", "2", "1"]


def test_moves_between_pools_are_printed(capsys):
    model_of(known_env()).learn(TOTAL, callback=TaskScheduleCallback(CONFIG, verbose=1))
    lines = [line for line in capsys.readouterr().out.splitlines() if "schedule stage" in line]
    assert lines[0].startswith("Step 96, schedule stage 1, now main: ") and "; training: " in lines[0]
    assert "schedule stage 2" in lines[-1] and any("solved: easy" in line for line in lines)


@pytest.mark.parametrize("stop_at", [40, 300, 700])
def test_a_run_saved_between_two_rollouts_goes_on_with_its_pools(trained, stop_at):
    whole, watch, _ = trained
    model = ARSSAC.load(watch.saves[stop_at], env=known_env(n_envs_per_task=whole.n_envs // 4))
    model.load_replay_buffer(watch.saves[stop_at].with_suffix(".buffer"))
    again = Watch()
    model.learn(
        TOTAL - model.num_timesteps, callback=[TaskScheduleCallback(CONFIG), again], reset_num_timesteps=False
    )
    at, sizes, _, state = next(row for row in watch.seen if row[0] >= stop_at)
    assert again.seen[0][:2] == (at, sizes) and again.seen[0][3] == state
    assert model.num_timesteps == whole.num_timesteps == model.replay_buffer.task_size.sum()
    assert model.schedule_state["pool"] == whole.schedule_state["pool"]
    if stop_at == 700:
        solved = np.array(sizes) == model.replay_buffer.task_size
        assert solved.tolist() == [True, False, True, True]


def test_a_new_run_of_the_same_model_starts_a_new_schedule():
    model = model_of(known_env())
    for _ in range(2):
        watch = Watch()
        model.learn(TOTAL, callback=[TaskScheduleCallback(CONFIG), watch])
        assert watch.seen[0][3] is None and model.schedule_state["start"] == RANDOM


def test_without_the_buffer_a_scheduled_run_is_refused_since_waiting_tasks_would_never_bring_a_batch(trained):
    _, watch, _ = trained
    model = ARSSAC.load(watch.saves[300], env=known_env())
    with pytest.raises(ConfigError, match=r"batch_size=8 rows of some task.* load_replay_buffer"):
        model.learn(400, callback=TaskScheduleCallback(CONFIG), reset_num_timesteps=False)


def test_without_the_buffer_a_run_in_its_random_phase_collects_a_batch_of_every_task_first(trained):
    _, watch, _ = trained
    model = ARSSAC.load(watch.saves[40], env=known_env(), learning_starts=48)
    again = Watch()
    with pytest.warns(UserWarning, match="Updates wait until every task holds batch_size=8 rows"):
        model.learn(400, callback=[TaskScheduleCallback(CONFIG), again], reset_num_timesteps=False)
    _, sizes, _, state = next(row for row in again.seen if row[3] is not None)
    assert sizes == [8] * 4 and state["start"] == again.seen[0][0] + 32 > 48


def test_it_learns_on_the_toy_tasks_as_on_any():
    model = model_of(
        make_toy_env(seed=0, max_episode_steps=5), reward_scaling="mean", train_freq=1, gradient_steps=1
    )
    model.learn(601, callback=TaskScheduleCallback(CONFIG))
    assert model.replay_buffer.task_size.sum() == model.num_timesteps and 601 <= model.num_timesteps < 605
    assert model.schedule_state["stage"] == 2


def ready_made_env():
    return make_multitask_env(
        DummyVecEnv([partial(Known, s) for s in SUCCESSES.values()]), task_of_env=[0, 1, 2, 3], seed=0
    )


@pytest.mark.parametrize(
    ("env", "callback", "error", "words"),
    [
        (lambda: known_env({"a": (1,)}), TaskScheduleCallback(CONFIG), ConfigError, "here is only one"),
        (partial(Known, (1,)), TaskScheduleCallback(CONFIG), ConfigError, "here is only one"),
        (
            lambda: known_env({"a": (1,), "b": (1,), "c": (0,)}),
            TaskScheduleCallback(),
            ConfigError,
            "pool_size=3 holds all 3",
        ),
        (ready_made_env, TaskScheduleCallback(CONFIG), ConfigError, r"DummyVecEnv .* MultiTaskVecEnv"),
        (known_env, TaskScheduleCallback(), ConfigError, "interval=15000 .* would never change"),
        (
            lambda: VecNormalize(known_env(), norm_reward=False),
            TaskScheduleCallback(CONFIG),
            ConfigError,
            "would count the observation of a waiting task",
        ),
        (
            known_env,
            EveryNTimesteps(10, CallbackList([TaskScheduleCallback(CONFIG)])),
            ConfigError,
            "inside an event callback",
        ),
    ],
)
def test_what_cannot_be_scheduled_is_refused_before_the_first_step(env, callback, error, words):
    model = model_of(env())
    with pytest.raises(error, match=words):
        model.learn(TOTAL, callback=callback)
    assert model.num_timesteps == 0


def test_a_task_that_reports_no_success_is_an_error_at_its_first_episodes_end():
    model = model_of(known_env(SUCCESSES | {"mute": ()}), learning_starts=100)
    with pytest.raises(EnvContractError, match=r"Task 'mute' ended an episode without is_success"):
        model.learn(TOTAL, callback=TaskScheduleCallback(CONFIG))
    assert model.num_timesteps == 25


def test_an_interrupted_run_leaves_all_tasks_active_and_goes_on_with_its_pools(tmp_path):
    class Interrupt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps > 400:
                raise KeyboardInterrupt
            return True

    model = model_of(known_env())
    with pytest.raises(KeyboardInterrupt):
        model.learn(TOTAL, callback=[TaskScheduleCallback(CONFIG), Interrupt()])
    assert model.active_tasks is None
    before = model.replay_buffer.task_size.copy()
    model.learn(48, reset_num_timesteps=False)  # without the schedule
    assert (model.replay_buffer.task_size - before).tolist() == [12] * 4


def test_resets_of_the_schedule_recompute_the_reward_scale():
    model = model_of(known_env(), reward_scaling="mean", gradient_steps=1)
    model.learn(TOTAL, callback=TaskScheduleCallback(CONFIG))
    times = [step for step, _ in model.reward_scale_history]
    assert model.n_resets > 0 and len(times) == model.n_resets + 1


def test_options_that_are_no_config_are_refused():
    with pytest.raises(ConfigError, match=r"must be an SMTConfig, such as SMTConfig\(pool_size=3\)"):
        TaskScheduleCallback({"pool_size": 2})
