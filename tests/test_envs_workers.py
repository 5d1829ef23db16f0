"""Tests of the worker processes: equality with stepping in process, failures, and what is left behind."""

import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from functools import partial
from pathlib import Path

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest

from sb3_ars.envs import MultiTaskVecEnv, make_toy_env, workers
from sb3_ars.errors import ConfigError, EnvContractError, WorkerError

# Else each worker would import this module, and SB3 and torch with it.
cloudpickle.register_pickle_by_value(sys.modules[__name__])

ROOT = Path(__file__).parents[1]


class Small(gym.Env):
    """Obs: seeded noise. Raises, hangs or misbehaves in the step that ``trouble`` names."""

    def __init__(self, trouble: str = "", at_step: int = 3):
        self.observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.trouble, self.at_step = trouble, at_step
        self.calls = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._obs(), {"options": options}

    def step(self, action):
        self.calls += 1
        if self.calls == self.at_step:
            if self.trouble == "raise":
                raise KeyError("the gripper fell off")
            if self.trouble == "hang":
                time.sleep(60)
            if self.trouble == "exit":
                os._exit(7)
            if self.trouble == "nan":
                return self._obs() * np.nan, 0.0, False, False, {}
            if self.trouble == "shape":
                return np.zeros(1, np.float32), 0.0, False, False, {}
        return self._obs(), float(action.sum()), False, self.calls % 5 == 0, {}

    def fail(self):
        raise LookupError("nothing here")

    def pid(self):
        return os.getpid()

    def threads(self):
        return os.environ.get("OMP_NUM_THREADS")

    def modules(self):
        return sorted(sys.modules)

    def _obs(self):
        return self.np_random.uniform(-1, 1, 3).astype(np.float32)


def rollout(env, n_steps):
    first = env.reset()
    seen, infos = go_on(env, n_steps)
    return [first, *seen, env.reset()], infos


def go_on(env, n_steps):
    rng = np.random.default_rng(7)
    seen, infos = [], []
    for _ in range(n_steps):
        observations, rewards, dones, step_infos = env.step(
            rng.uniform(-1, 1, (env.num_envs, 2)).astype("f4")
        )
        seen += [observations, rewards, dones]
        infos += [
            {k: v for k, v in info.items() if k != "episode"} | {"r": info.get("episode", {}).get("r")}
            for info in step_infos
        ]
    return seen, infos


def assert_same(left, right):
    for a, b in zip(left[0], right[0], strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    for a, b in zip(left[1], right[1], strict=True):
        np.testing.assert_equal(a, b)


def children_are_gone(pids):
    return not multiprocessing.active_children() and not any(_alive(pid) for pid in pids)


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def build(trouble="", n_workers=2, **options):
    tasks = {"calm": Small, "wild": partial(Small, trouble)}
    return MultiTaskVecEnv(tasks, n_workers=n_workers, seed=0, **options)


@pytest.fixture(scope="module")
def toy_in_process():
    env = make_toy_env(seed=5, n_envs_per_task=2, max_episode_steps=9)
    yield rollout(env, 40)
    env.close()


@pytest.mark.parametrize(
    ("n_workers", "start_method"), [(1, "spawn"), (2, "spawn"), (3, "spawn"), (2, "fork"), (2, "forkserver")]
)
def test_transitions_are_the_same_in_any_number_of_workers(toy_in_process, n_workers, start_method):
    env = make_toy_env(
        seed=5, n_envs_per_task=2, max_episode_steps=9, n_workers=n_workers, start_method=start_method
    )
    assert_same(rollout(env, 40), toy_in_process)
    env.close()


def changing_rollout(n_workers):
    """Transitions of toy tasks of which others are active every 7 steps."""
    env = make_toy_env(seed=5, n_envs_per_task=2, max_episode_steps=9, n_workers=n_workers)
    left, right = [], []
    for tasks in (None, [0], [3], [1, 2], None, [0, 3]):
        env.set_active_tasks(tasks)
        seen, infos = rollout(env, 7) if tasks is None else go_on(env, 7)
        left, right = left + seen, right + infos
    env.close()
    return left, right


@pytest.mark.parametrize("n_workers", [1, 2, 3])
def test_transitions_of_active_tasks_are_the_same_in_any_number_of_workers(n_workers):
    assert_same(changing_rollout(n_workers), changing_rollout(0))


def test_a_worker_without_active_tasks_is_not_even_woken():
    env = build(worker_timeout=0.5)
    env.reset()
    pid = env.env_method("pid", indices=0)[0]
    os.kill(pid, signal.SIGSTOP)
    env.set_active_tasks([1])
    first = env.step(np.ones((2, 2)))
    assert first[1].tolist() == [0.0, 2.0]
    os.kill(pid, signal.SIGCONT)
    env.set_active_tasks(None)
    assert env.step(np.ones((2, 2)))[1].tolist() == [2.0, 2.0]
    env.close()


def test_another_seed_gives_other_transitions(toy_in_process):
    env = make_toy_env(seed=6, n_envs_per_task=2, max_episode_steps=9)
    assert not np.array_equal(rollout(env, 1)[0][0], toy_in_process[0][0])


def test_global_numpy_randomness_is_neither_used_nor_changed():
    np.random.seed(1)
    before = np.random.get_state()[1].copy()
    env = make_toy_env(seed=None)
    first = env.reset()
    env.seed(None)
    np.testing.assert_array_equal(np.random.get_state()[1], before)
    np.random.seed(1)
    other = make_toy_env(seed=None)
    assert not np.array_equal(first, other.reset())


def test_a_worker_loads_neither_torch_nor_sb3():
    env = build()
    modules = env.env_method("modules", indices=0)[0]
    env.close()
    assert "sb3_ars.envs.workers" in modules
    assert not {"torch", "stable_baselines3", "metaworld"} & set(modules)


def test_each_worker_is_another_process_with_one_thread():
    env = build()
    pids = env.env_method("pid")
    assert len({os.getpid(), *pids}) == 3
    assert env.env_method("threads") == ["1", "1"]
    env.close()
    assert children_are_gone(pids)


def test_starting_workers_leaves_the_environment_and_main_as_they_were():
    before = dict(os.environ), vars(sys.modules["__main__"]).get("__file__"), sys.modules["__main__"].__spec__
    build().close()
    after = dict(os.environ), vars(sys.modules["__main__"]).get("__file__"), sys.modules["__main__"].__spec__
    assert before == after


@pytest.mark.parametrize("start_method", ["spawn", "fork", "forkserver"])
def test_a_killed_worker_is_named_with_its_signal_and_the_others_end(start_method):
    env = build(start_method=start_method)
    env.reset()
    pids = env.env_method("pid")
    os.kill(pids[0], signal.SIGKILL)
    start = time.monotonic()
    with pytest.raises(WorkerError, match=r"worker 0 \(task 'calm'\) was killed by SIGKILL"):
        for _ in range(2):
            env.step(np.zeros((2, 2)))
    assert time.monotonic() - start < 5
    assert children_are_gone(pids)
    with pytest.raises(RuntimeError, match="closed MultiTaskVecEnv"):
        env.reset()
    env.close()


def test_a_worker_that_exits_is_named_with_its_exit_code():
    env = build("exit")
    env.reset()
    with pytest.raises(WorkerError, match=r"worker 1 \(task 'wild'\) exited with 7 while stepping"):
        for _ in range(3):
            env.step(np.zeros((2, 2)))
    assert children_are_gone([])


def test_a_stopped_worker_counts_as_hung_after_the_timeout():
    env = build(worker_timeout=0.5)
    env.reset()
    pids = env.env_method("pid")
    os.kill(pids[1], signal.SIGSTOP)
    start = time.monotonic()
    with pytest.raises(WorkerError, match=r"task 'wild'.* did not answer within 0.5 s while stepping"):
        env.step(np.zeros((2, 2)))
    assert time.monotonic() - start < 6
    assert children_are_gone(pids)


def test_an_exception_in_a_worker_arrives_with_its_task_and_traceback():
    env = build("raise")
    env.reset()
    pids = env.env_method("pid")
    with pytest.raises(WorkerError, match="task 'wild'") as caught:
        for _ in range(3):
            env.step(np.zeros((2, 2)))
    assert "the gripper fell off" in str(caught.value) and "in step" in str(caught.value)
    assert isinstance(caught.value.__cause__, KeyError)
    assert children_are_gone(pids)


def test_an_exception_in_process_names_the_task_and_keeps_its_cause():
    env = build("raise", n_workers=0)
    env.reset()
    with pytest.raises(WorkerError, match=r"'wild' raised KeyError while stepping.*gripper") as caught:
        for _ in range(3):
            env.step(np.zeros((2, 2)))
    assert isinstance(caught.value.__cause__, KeyError)


def test_one_env_returned_twice_is_refused():
    shared = Small()
    with pytest.raises(ConfigError, match="'b' returned an env that is in use already"):
        MultiTaskVecEnv({"a": lambda: shared, "b": lambda: shared}, n_workers=0)


@pytest.mark.parametrize("n_workers", [0, 2])
@pytest.mark.parametrize(("trouble", "words"), [("nan", "NaN or infinity"), ("shape", r"shape \(1,\)")])
def test_a_bad_observation_is_refused_with_the_task_s_name(n_workers, trouble, words):
    env = build(trouble, n_workers)
    env.reset()
    with pytest.raises(EnvContractError, match=f"'wild'.*{words}"):
        for _ in range(3):
            env.step(np.zeros((2, 2)))
    assert children_are_gone([])


@pytest.mark.parametrize("n_workers", [0, 2])
def test_an_exception_in_a_called_method_is_the_original_and_harmless(n_workers):
    env = build(n_workers=n_workers)
    first = env.reset()
    with pytest.raises(LookupError, match="nothing here"):
        env.env_method("fail")
    with pytest.raises(AttributeError):
        env.get_attr("no_such_thing")
    assert env.step(np.zeros((2, 2)))[0].shape == first.shape
    env.close()


def _broken_factory():
    raise OSError("no such mesh")


@pytest.mark.parametrize("n_workers", [0, 2])
def test_a_factory_that_raises_is_named_and_nothing_is_left(n_workers):
    with pytest.raises(ConfigError, match="factory of task 'broken' raised OSError: no such mesh") as caught:
        MultiTaskVecEnv({"calm": Small, "broken": _broken_factory}, n_workers=n_workers)
    assert "_broken_factory" in str(caught.value.__cause__) or isinstance(caught.value.__cause__, OSError)
    assert children_are_gone([])


def test_a_factory_that_cannot_travel_is_named():
    lock = threading.Lock()
    with pytest.raises(ConfigError, match=r"task 'locked' cannot be sent .* n_workers=0"):
        MultiTaskVecEnv({"a": Small, "locked": lambda: lock and Small()}, n_workers=1)


def test_close_is_idempotent_and_ends_a_worker_in_the_middle_of_a_step():
    env = build("hang")
    env.reset()
    pids = env.env_method("pid")
    for _ in range(2):
        env.step(np.zeros((2, 2)))
    env.step_async(np.zeros((2, 2)))
    start = time.monotonic()
    env.close()
    env.close()
    assert time.monotonic() - start < 8
    assert children_are_gone(pids)


def test_a_dropped_env_ends_its_workers():
    env = build()
    pids = env.env_method("pid")
    del env
    assert children_are_gone(pids)


def test_an_interrupted_step_leaves_the_env_usable():
    env = build()
    expected = env.reset()
    pids = env.env_method("pid")
    os.kill(pids[0], signal.SIGSTOP)  # so that the step is under way when the interrupt comes
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        env.step(np.zeros((2, 2)))
    os.kill(pids[0], signal.SIGCONT)
    env.seed(0)
    np.testing.assert_array_equal(env.reset(), expected)
    env.close()


def test_workers_end_when_the_parent_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        textwrap.dedent("""
        import os, time
        from sb3_ars.envs import make_toy_env
        env = make_toy_env(n_workers=2, start_method="fork")
        print(*[p.pid for p in __import__("multiprocessing").active_children()], flush=True)
        time.sleep(60)
        """)
    )
    with subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, text=True, cwd=ROOT, env=_env()
    ) as parent:
        pids = [int(pid) for pid in parent.stdout.readline().split()]
        assert len(pids) == 2
        parent.kill()
    deadline = time.monotonic() + 5
    while any(_running(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(_running(pid) for pid in pids)


def _running(pid):
    # An orphan that nobody waits for stays as a zombie in a container without an init.
    stat = Path(f"/proc/{pid}/stat")
    try:
        return stat.read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def _env():
    return {**os.environ, "PYTHONPATH": str(ROOT)}


@pytest.mark.parametrize("start_method", ["spawn", "forkserver"])
def test_a_script_without_a_main_guard_runs_once_and_may_define_its_env(tmp_path, start_method):
    script = tmp_path / "unguarded.py"
    script.write_text(
        textwrap.dedent(f"""
        import os
        import gymnasium as gym
        import numpy as np
        from sb3_ars.envs import make_multitask_env

        print("started")

        class Mine(gym.Env):
            observation_space = gym.spaces.Box(-1, 1, (1,))
            action_space = gym.spaces.Box(-1, 1, (1,))

            def reset(self, *, seed=None, options=None):
                super().reset(seed=seed)
                return np.zeros(1, np.float32), {{}}

            def step(self, action):
                return np.zeros(1, np.float32), float(os.getpid()), False, False, {{}}

        tasks = {{"a": Mine, "b": lambda: Mine()}}
        env = make_multitask_env(tasks, n_workers=2, start_method="{start_method}")
        env.reset()
        pids = set(env.step(np.zeros((2, 1)))[1].tolist())
        assert len(pids | {{float(os.getpid())}}) == 3
        print("finished")
        """)
    )
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, cwd=ROOT, env=_env(), timeout=60
    )
    assert done.stdout.split() == ["started", "finished"], done.stderr
    assert done.stderr == ""


def test_a_worker_that_stops_between_its_wake_up_and_its_message_is_not_waited_for_without_end():
    env = build(worker_timeout=0.5)
    pool = env._runner
    line = pool._lines[1]
    line.words[workers._ANSWER] = workers._REPLY  # as if it had been stopped right after announcing a message
    line.done.release()
    pool._awaiting.add(1)
    with pytest.raises(
        WorkerError, match=r"Env worker 1 .* did not answer within 0.5 s while stepping its envs"
    ):
        pool.step_wait()
    env.close()
