"""Faults injected into the environments' workers, most of them in the middle of training: what is reported, and left.

The times are bounds that keep a hang from blocking the tests, nothing that is measured.
"""

import contextlib
import errno
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from functools import partial
from pathlib import Path

import cloudpickle
import numpy as np
import psutil
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ars import ARSSAC
from sb3_ars.envs import MultiTaskVecEnv, make_multitask_env, make_toy_env, workers
from sb3_ars.envs.toy import PointTask
from sb3_ars.errors import ConfigError, EnvContractError, WorkerError

# Else each worker would import this module, and SB3 and torch with it.
cloudpickle.register_pickle_by_value(sys.modules[__name__])

ROOT = Path(__file__).parents[1]
TOO_LONG = 30.0  # seconds
IDLE = np.zeros((2, 2), np.float32)


class Unreadable:
    """Can be pickled, but not read back."""

    def __reduce__(self):
        return int, ("no number",)


def fail(how):
    """Do to this process what a broken env might."""
    if how == "raise":
        raise KeyError("the gripper fell off")
    if how == "exit":
        os._exit(7)
    if how == "sys.exit":
        sys.exit(0)
    if how == "interrupt":
        raise KeyboardInterrupt
    if how == "hang":
        time.sleep(600)
    if how in ("kill", "stop"):
        os.kill(os.getpid(), {"kill": signal.SIGKILL, "stop": signal.SIGSTOP}[how])


class Faulty(PointTask):
    """A toy task that fails as ``how`` says, in ``where``, the ``at``-th time it gets there."""

    def __init__(self, how, where="step", at=20):
        self.how, self.where, self.left = how, where, at
        super().__init__(max_episode_steps=5)
        self._meet("build")

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed)
        return self._spoil("reset", obs, info)

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        obs, info = self._spoil("step", obs, info)
        return obs, reward, terminated, truncated, info

    def close(self):
        self._meet("close")

    def big(self):
        return bytes(10_000_000)

    def pid(self):
        return os.getpid()

    def _spoil(self, where, obs, info):
        if not self._meet(where):
            return obs, info
        if self.how == "nan":
            return obs * np.nan, info
        if self.how == "unpicklable":
            return obs, {**info, "lock": threading.Lock()}
        return obs, {**info, "odd": Unreadable()} if self.how == "unreadable" else info

    def _meet(self, where):
        if where != self.where:
            return False
        self.left -= 1
        if self.left == 0:
            fail(self.how)
        return self.left <= 0


def build(how="", where="step", at=20, **options):
    """Two tasks in a worker each; the second one fails."""
    tasks = {"calm": partial(Faulty, ""), "wild": partial(Faulty, how, where, at)}
    return MultiTaskVecEnv(tasks, **{"n_workers": 2, "seed": 0, **options})


class At(BaseCallback):
    """Do something at one step of a run."""

    def __init__(self, step, action):
        super().__init__()
        self.step, self.action = step, action

    def _on_step(self):
        if self.num_timesteps == self.step:
            self.action()
        return True


def train(env, callback=None, steps=200, **options):
    small = {
        "batch_size": 4,
        "learning_starts": 20,
        "n_reset": 0,
        "seed": 0,
        "policy_kwargs": {"net_arch": [8]},
    }
    return ARSSAC("MlpPolicy", env, **{**small, **options}).learn(steps, callback=callback)


@contextlib.contextmanager
def reported_in_time():
    """Whatever happens within must end soon, and leave no process."""
    before = {process.pid for process in psutil.Process().children(recursive=True)}
    begin = time.monotonic()
    yield
    assert time.monotonic() - begin < TOO_LONG
    left = [process for process in psutil.Process().children(recursive=True) if process.pid not in before]
    # multiprocessing's own, which serves the whole test process
    assert [process for process in left if "resource_tracker" not in " ".join(process.cmdline())] == []
    assert not multiprocessing.active_children()


REPORTED = {  # what the env does -> what is raised
    "raise": (WorkerError, r"task 'wild' raised an exception while stepping[\s\S]*the gripper fell off"),
    "exit": (WorkerError, r"worker 1 \(task 'wild'\) exited with 7 while stepping"),
    "sys.exit": (WorkerError, r"task 'wild' raised an exception while stepping[\s\S]*SystemExit: 0"),
    "interrupt": (WorkerError, r"task 'wild' raised an exception while stepping[\s\S]*KeyboardInterrupt"),
    "kill": (WorkerError, r"worker 1 \(task 'wild'\) was killed by SIGKILL while stepping.*Out of memory"),
    "stop": (
        WorkerError,
        r"\(task 'wild'\) did not answer within 0.5 s while stepping.*A signal has stopped it",
    ),
    "hang": (
        WorkerError,
        r"\(task 'wild'\) did not answer within 0.5 s while stepping.*n_workers=0 to see where",
    ),
    "nan": (EnvContractError, r"'wild': step\(\) returned NaN or infinity"),
    "unpicklable": (
        EnvContractError,
        r"Task 'wild': info\['lock'\] of its step\(\) is of type lock, which cannot be",
    ),
    "unreadable": (
        WorkerError,
        r"\(task 'wild'\) sent an info or an answer that cannot be read .*n_workers=0",
    ),
}


@pytest.mark.parametrize("how", REPORTED)
def test_a_fault_in_the_middle_of_training_is_reported_with_its_task_and_leaves_no_process(how):
    error, message = REPORTED[how]
    with reported_in_time():
        env = build(how, worker_timeout=0.5)
        with pytest.raises(error, match=message):
            train(env)


def test_training_goes_on_with_another_env_after_a_fault():
    with reported_in_time():
        env = build("kill", at=50)
        model = ARSSAC(
            "MlpPolicy", env, batch_size=4, learning_starts=20, n_reset=0, policy_kwargs={"net_arch": [8]}
        )
        with pytest.raises(WorkerError):
            model.learn(200)
        reached = model.num_timesteps
        assert reached == 98 and model.replay_buffer.task_size.tolist() == [49, 49]
        other = build()
        model.set_env(other)
        model.learn(200, reset_num_timesteps=False)
        other.close()
    assert model.num_timesteps == reached + 200 and model.replay_buffer.task_size.tolist() == [149, 149]


@pytest.mark.parametrize("how", REPORTED)
def test_a_fault_in_a_reset_is_reported_with_its_task_and_leaves_no_process(how):
    error, message = REPORTED[how]
    message = message.replace("stepping", "resetting its envs").replace(r"step\(", r"reset\(")
    with reported_in_time():
        env = build(how, "reset", 1, worker_timeout=0.5)
        with pytest.raises(error, match=message):
            env.reset()


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("raise", "factory of task 'wild' raised KeyError"),
        ("exit", r"\(task 'wild'\) exited with 7 while building"),
        ("sys.exit", r"task 'wild' raised an exception while building[\s\S]*SystemExit"),
        ("kill", r"\(task 'wild'\) was killed by SIGKILL while building"),
        (
            "stop",
            r"\(task 'wild'\) did not answer within .* while building its envs. A signal has stopped it",
        ),
    ],
)
def test_a_fault_while_envs_are_built_is_reported_with_its_task_and_leaves_no_process(how, message):
    with reported_in_time(), pytest.raises((ConfigError, WorkerError), match=message):
        build(how, "build", 1, worker_timeout=2.0)


@pytest.mark.parametrize(
    "how",
    [
        "raise",
        "exit",
        "sys.exit",
        "kill",
        *(pytest.param(how, marks=pytest.mark.slow) for how in ("stop", "hang")),
    ],
)
def test_a_fault_while_closing_holds_nobody_up_and_leaves_no_process(how):
    with reported_in_time():
        env = build(how, "close", 1)
        env.reset()
        env.close()


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGSTOP])
def test_a_signal_from_outside_ends_training_with_the_tasks_names(sent):
    with reported_in_time():
        env = make_toy_env(seed=0, n_workers=2, worker_timeout=0.5)
        pid = env._runner.pids[0]
        with pytest.raises(WorkerError, match=r"worker 0 \(tasks 'point-east', 'point-north'\)"):
            train(env, At(120, lambda: os.kill(pid, sent)), overlap=True)


def test_an_env_that_fills_the_standard_streams_is_no_fault(capfd):
    class Loud(Faulty):
        def step(self, action):
            print("o" * 30_000)
            print("e" * 30_000, file=sys.stderr)
            return super().step(action)

    with reported_in_time():
        env = MultiTaskVecEnv({"calm": partial(Faulty, ""), "loud": partial(Loud, "")}, n_workers=2)
        assert train(env).num_timesteps == 200
        env.close()
    written = capfd.readouterr()
    assert min(written.out.count("o"), written.err.count("e")) >= 100 * 30_000


def test_a_stopped_worker_is_not_waited_for_with_a_long_message_to_it():
    with reported_in_time():
        env = build(worker_timeout=0.5)
        os.kill(env._runner.pids[1], signal.SIGSTOP)
        with pytest.raises(
            WorkerError, match=r"'wild'\) did not answer within 0.5 s while being sent 'call'"
        ):
            env.set_attr("weights", bytes(10_000_000))


def test_a_worker_stopped_in_the_middle_of_a_long_message_is_not_waited_for():
    with reported_in_time():
        env = build(worker_timeout=0.5)
        pool = env._runner
        pool._send(1, ("call", ("env_method", [0], "big", (), {})))
        pool._lines[1].conn.poll(TOO_LONG)  # it has begun to answer, and waits until it is read
        os.kill(pool.pids[1], signal.SIGSTOP)
        with pytest.raises(WorkerError, match=r"'wild'\) did not answer within 0.5 s"):
            pool._collect(0.5, "answering")


# ---------------------------------------------------------------------- what the system refuses


def no_room(*args, **kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


class FullFile:
    """A file on a full disk."""

    def __init__(self, file):
        self.file = file

    def write(self, data):
        no_room()

    def close(self):
        self.file.close()


def test_shared_arrays_are_on_disk_where_shared_memory_has_no_room(monkeypatch):
    make, asked = tempfile.NamedTemporaryFile, []

    def file_in(dir=None, **options):
        asked.append(dir)
        file = make(dir=dir, **options)
        return FullFile(file) if dir == "/dev/shm" else file

    monkeypatch.setattr(tempfile, "NamedTemporaryFile", file_in)
    with reported_in_time():
        env = build()
        assert np.isfinite(env.reset()).all() and np.isfinite(env.step(IDLE)[0]).all()
        env.close()
    assert asked == ["/dev/shm", None]


def test_no_room_for_shared_arrays_is_refused_with_the_remedy(monkeypatch):
    monkeypatch.setattr(tempfile, "NamedTemporaryFile", no_room)
    with (
        reported_in_time(),
        pytest.raises(ConfigError, match=r"room neither in /dev/shm .*--shm-size=256m, or use n_"),
    ):
        build()


def test_too_many_open_files_name_the_worker_and_the_limit():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    taken = []
    with reported_in_time():
        try:
            resource.setrlimit(
                resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + 20, hard)
            )
            with contextlib.suppress(OSError):
                while True:
                    taken.append(os.dup(0))
            for _ in range(7):  # of which the first worker's pipes take all
                os.close(taken.pop())
            with pytest.raises(
                ConfigError, match=r"worker \d \(task '\w+'\) could not be started .*ulimit -n"
            ):
                build()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
            for descriptor in taken:
                os.close(descriptor)


def script(text, *prefix, **options):
    """Run a script that knows of ``pool(...)``, two toy tasks in two workers, and return what it printed."""
    done = subprocess.run(
        [*prefix, sys.executable, "-c", PREPARED + textwrap.dedent(text)],
        **{"capture_output": True, "text": True, "timeout": TOO_LONG, "cwd": ROOT, "check": False, **options},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


PREPARED = """
import os, sys
import numpy as np
from sb3_ars.envs.toy import PointTask
from sb3_ars.envs.workers import StepLayout, WorkerPool
from sb3_ars.errors import ConfigError, WorkerError

def pool(start_method="spawn"):
    made = WorkerPool([PointTask, PointTask], ["calm", "wild"], 2, start_method)
    made.build()
    made.allocate(StepLayout(2, 6, 2, "float32"))
    made.reset([0, 1], [{}, {}])
    return made
"""


def test_too_many_processes_name_the_worker_and_the_limit():
    printed = script(
        """
        import multiprocessing.popen_fork, resource  # the former while it can still be read
        if os.getuid() == 0:
            os.setresuid(65534, 65534, 65534)  # no limit holds for root
        resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
        try:
            pool("fork")
        except ConfigError as error:
            print(error)
        """
    )
    assert "Env worker 0 (task 'calm') could not be started" in printed
    assert "The limit on processes (ulimit -u" in printed


@pytest.mark.parametrize("size", ["4k", "12k"])
def test_really_too_little_shared_memory_is_refused_not_fatal(size):
    """A file system of that size in the place of /dev/shm: one page per semaphore, so the second worker finds none."""
    prefix = ["unshare", "-m", "sh", "-c", f'mount -t tmpfs -o size={size} none /dev/shm && exec "$@"', "sh"]
    if subprocess.run([*prefix, "true"], capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount")
    printed = script(
        """
        try:
            pool()
        except ConfigError as error:
            print(error)
        """,
        *prefix,
    )
    assert "could not be started ([Errno 28] No space left on device)" in printed
    assert "--shm-size=256m, or use n_workers=0" in printed


def test_a_child_that_dies_before_it_runs_is_named_however_much_it_was_to_be_given(tmp_path, monkeypatch):
    dying = tmp_path / "python"
    dying.write_text(f'#!/bin/sh\ncase "$*" in *spawn_main*) exit 3;; esac\nexec {sys.executable} "$@"\n')
    dying.chmod(0o755)
    weights = np.random.default_rng(0).random(100_000)
    spawn = multiprocessing.get_context("spawn")
    before = multiprocessing.spawn.get_executable()
    spawn.set_executable(str(dying))
    try:
        with reported_in_time(), pytest.raises(WorkerError, match=r"worker 0 \(task 'calm'\) exited with 3"):
            tasks = {name: lambda: Faulty(str(weights.sum())) for name in ("calm", "wild")}
            MultiTaskVecEnv(tasks, n_workers=2)
    finally:
        spawn.set_executable(before)


@pytest.mark.parametrize("start_method", ["spawn", "fork", "forkserver"])
def test_workers_end_by_themselves_when_training_is_killed(start_method):
    text = textwrap.dedent(
        f"""
        workers = pool("{start_method}")
        workers.arrays.actions[:] = 0
        workers.step_async()
        print(*workers.pids, flush=True)
        while True:
            workers.step_wait()
            workers.step_async()
        """
    )
    with subprocess.Popen(
        [sys.executable, "-c", PREPARED + text], stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as parent:
        pids = [int(pid) for pid in parent.stdout.readline().split()]
        assert len(pids) == 2
        parent.kill()
    deadline = time.monotonic() + TOO_LONG
    while any(map(is_running, pids)):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def is_running(pid):
    # an orphan that nobody waits for stays as a zombie in a container without an init
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_a_fork_of_the_parent_is_refused_and_harms_nobody():
    printed = script(
        """
        workers = pool()
        workers.arrays.actions[:] = 0
        workers.step_async()
        child = os.fork()
        if child == 0:
            for use in (workers.step_wait, workers.step_async, workers.close):
                try:
                    use()
                except WorkerError as error:
                    print(error, flush=True)
            del workers
            os._exit(0)
        os.waitpid(child, 0)
        workers.step_wait()
        workers.step_async()
        workers.step_wait()
        print("alive", len(workers.pids))
        """
    )
    *refusals, last = printed.strip().splitlines()
    assert len(refusals) == 2 and last == "alive 2"
    for refusal in refusals:
        assert (
            "The env workers of 'calm', 'wild' belong to process" in refusal
            and "Build the env anew" in refusal
        )


def test_the_default_timeout_reports_a_hang_within_half_a_minute():
    env = make_toy_env(n_workers=1)
    assert env._runner._timeout + 2 * workers._LOOK_AROUND + 3 < TOO_LONG
    env.close()


# ---------------------------------------------------------------------- restart_workers


class Marked(Faulty):
    """Fails in the first process it is built in alone, and knows its seed."""

    def __init__(self, how="", at=10**9, where="step", mark=None):
        # a file, for it must outlive the process: only the first env that is built fails
        self.mark = mark
        is_first = mark is None or not Path(mark).exists()
        if mark is not None:
            Path(mark).touch()
        super().__init__(how if is_first else "", where, at)
        self.max_episode_steps = 50

    def reset(self, *, seed=None, options=None):
        self.given_seed = seed if seed is not None else getattr(self, "given_seed", -1)
        return super().reset(seed=seed)


def restarting(how, tmp_path, at=20, n_envs_per_task=1, where="step", once=True, **options):
    """Three tasks in two workers; the one of the second worker's two that is called wild fails, once."""
    mark = str(tmp_path / "built") if once else None
    tasks = {
        "calm": [Marked] * n_envs_per_task,
        "near": [Marked] * n_envs_per_task,
        "wild": [partial(Marked, how, at, where, mark=mark), *[Marked] * (n_envs_per_task - 1)],
    }
    options = {"n_workers": 2, "seed": 0, "worker_timeout": 0.5, "restart_workers": True, **options}
    return MultiTaskVecEnv(tasks, n_envs_per_task=n_envs_per_task, **options)


LOST = {
    "raise": r"env of task 'wild' raised \"KeyError: 'the gripper fell off'\" while stepping",
    "exit": "exited with 7 while stepping",
    "sys.exit": "env of task 'wild' raised 'SystemExit: 0' while stepping",
    "kill": "was killed by SIGKILL while stepping",
    "stop": r"did not answer within 0.5 s while stepping.*A signal has stopped it",
    "hang": "did not answer within 0.5 s while stepping",
}


@pytest.mark.parametrize(
    "how", [*(how for how in LOST if how != "hang"), pytest.param("hang", marks=pytest.mark.slow)]
)
def test_a_lost_worker_is_started_anew_and_its_episodes_end_as_truncated(how, tmp_path):
    actions = np.random.default_rng(1).uniform(-1, 1, (30, 3, 2)).astype(np.float32)
    undisturbed = restarting("", tmp_path, n_workers=0, restart_workers=False)
    with reported_in_time():
        (tmp_path / "built").unlink()
        env = restarting(how, tmp_path, at=20)
        assert env._runner._worker_of == [0, 1, 1]
        last, expected = env.reset(), undisturbed.reset()
        np.testing.assert_array_equal(last, expected)
        returns, pids = np.zeros(3), env._runner.pids
        for step in range(30):
            fails = step == 19
            with pytest.warns(UserWarning, match=LOST[how]) if fails else contextlib.nullcontext() as caught:
                obs, rewards, dones, infos = env.step(actions[step])
            expected, *others = undisturbed.step(actions[step])
            # the other worker's env notices nothing
            np.testing.assert_array_equal(obs[0], expected[0])
            assert (rewards[0], dones[0], infos[0]) == (others[0][0], others[1][0], others[2][0])
            if step < 19:
                np.testing.assert_array_equal(obs, expected)
                returns += rewards
            if not fails:
                assert not dones.any() and not any("worker_restarted" in info for info in infos)
                last = obs
                continue
            assert "(tasks 'near', 'wild') was started anew, restart 1 of this worker" in str(
                caught[0].message
            )
            assert dones.tolist() == [False, True, True] and rewards[1:].tolist() == [0.0, 0.0]
            for row in (1, 2):
                np.testing.assert_array_equal(infos[row].pop("terminal_observation"), last[row])
                episode = infos[row].pop("episode")
                assert episode["l"] == 19 and episode["r"] == pytest.approx(returns[row], rel=1e-6)
                assert infos[row] == {"worker_restarted": True, "TimeLimit.truncated": True}
            assert env._runner.pids[0] == pids[0] and env._runner.pids[1] != pids[1]
            seeds = [int(np.random.SeedSequence([seed, 1]).generate_state(1)[0]) for seed in (1, 2)]
            assert env.get_attr("given_seed") == [0, *seeds]
            for row, seed in zip((1, 2), seeds, strict=True):
                np.testing.assert_array_equal(obs[row, :6], Marked().reset(seed=seed)[0])
        env.close()


@pytest.mark.parametrize("how", ["raise", "kill", pytest.param("hang", marks=pytest.mark.slow)])
def test_a_worker_lost_in_a_reset_is_started_anew_and_reset(how, tmp_path):
    with reported_in_time():
        env = restarting(how, tmp_path, at=1, where="reset")
        with pytest.warns(
            UserWarning, match=r"'wild'.* while resetting its envs[\s\S]*restart 1 of this worker"
        ):
            first = env.reset()
        seed = int(np.random.SeedSequence([2, 1]).generate_state(1)[0])
        np.testing.assert_array_equal(first[2, :6], Marked().reset(seed=seed)[0])
        np.testing.assert_array_equal(first[0, :6], Marked().reset(seed=0)[0])
        assert not env.step(np.zeros((3, 2), np.float32))[2].any()
        env.close()


@pytest.mark.parametrize(
    ("how", "where", "at"),
    [("kill", "step", 1), ("raise", "step", 1), ("raise", "build", 2), ("kill", "build", 2)],
)
@pytest.mark.filterwarnings("ignore:[\\s\\S]*was started anew")
def test_a_worker_that_fails_again_and_again_is_given_up(how, where, at, tmp_path):
    class Builds(Marked):
        """Counts across processes how often it was built."""

        def _meet(self, met):
            if met == "build" and self.mark is not None:
                with open(self.mark + "s", "a") as file:
                    file.write("x")
                if where == "build" and len(Path(self.mark + "s").read_text()) >= at:
                    fail(how)
            return super()._meet(met)

    with reported_in_time():
        trouble = ("kill", 1) if where == "build" else (how, at)
        tasks = {"calm": Marked, "wild": partial(Builds, *trouble, mark=str(tmp_path / "built"))}
        if where == "step":
            tasks["wild"] = partial(Faulty, how, "step", at)
        env = MultiTaskVecEnv(tasks, n_workers=2, restart_workers=True, seed=0)
        env.reset()
        with pytest.raises(
            WorkerError, match=r"'wild'[\s\S]* started anew 3 times in a row, and no step worked"
        ):
            for _ in range(5):
                env.step(IDLE)
    if where == "build":
        assert (tmp_path / "builts").read_text() == "x" * 4


def test_restarts_that_are_not_in_a_row_are_not_limited(tmp_path):
    with reported_in_time():
        env = MultiTaskVecEnv(
            {"calm": Marked, "wild": partial(Faulty, "raise", at=3)},
            n_workers=2,
            restart_workers=True,
            seed=0,
        )
        env.reset()
        ended = []
        with pytest.warns(UserWarning) as caught:
            for _ in range(12):
                ended.append(bool(env.step(IDLE)[2][1]))
        assert ended == [False, False, True] * 4
        assert [str(w.message).count(f"restart {n} of") for n, w in enumerate(caught, 1)] == [1] * 4
        env.close()


def test_nan_from_an_env_ends_the_run_even_where_workers_are_restarted(tmp_path):
    with reported_in_time():
        env = restarting("nan", tmp_path)
        env.reset()
        with pytest.raises(EnvContractError, match=r"Task 'wild'.*NaN or infinity"):
            for _ in range(20):
                env.step(np.zeros((3, 2), np.float32))


def test_a_restart_touches_inactive_tasks_of_the_same_worker_only(tmp_path):
    with reported_in_time():
        env = restarting("kill", tmp_path, at=3, n_envs_per_task=2)
        assert env._runner._worker_of == [0, 0, 0, 1, 1, 1]
        env.reset()
        env.set_active_tasks([2])
        for _ in range(2):
            env.step(np.zeros((6, 2), np.float32))
        with pytest.warns(UserWarning, match=r"tasks 'near', 'wild'"):
            *_, dones, infos = env.step(np.zeros((6, 2), np.float32))
        # the waiting episode of the lost env of task 'near' is gone as well, and so is reported
        assert dones.tolist() == [False] * 3 + [True] * 3
        assert [info.get("episode", {}).get("l") for info in infos[3:]] == [0, 2, 2]
        assert not env.step(np.zeros((6, 2), np.float32))[2].any()
        env.close()


@pytest.mark.parametrize("optimize_memory_usage", [False, True])
@pytest.mark.parametrize("overlap", [False, True])
def test_a_run_goes_on_and_its_buffer_holds_no_invented_transition(tmp_path, overlap, optimize_memory_usage):
    """Each stored transition is one that the toy task's own arithmetic gives."""
    with reported_in_time():
        env = restarting("kill", tmp_path, at=30, n_envs_per_task=2)
        options = {"overlap": overlap, "optimize_memory_usage": optimize_memory_usage, "gradient_steps": 1}
        with pytest.warns(UserWarning, match="restart 1 of this worker"):
            model = ARSSAC(
                "MlpPolicy", env, batch_size=4, learning_starts=48, n_reset=0, seed=0, policy_kwargs={"net_arch": [8]},
                **options,
            ).learn(480)  # fmt: skip
        env.close()
    buffer = model.replay_buffer
    assert model.num_timesteps == 480
    # 80 steps of two envs each; of near's, the second is in the lost worker, of wild's both are
    assert buffer.task_size.tolist() == [160, 159, 158]
    for task in range(3):
        slots = np.tile(np.arange(buffer.task_size[task]), (3, 1))
        rows = buffer.gather(th.from_numpy(slots))
        start = task * slots.shape[1]
        part = slice(start, start + slots.shape[1])
        columns = (rows.observations, rows.actions, rows.next_observations, rows.rewards, rows.dones)
        for obs, action, following, reward, done in zip(*(c[part].numpy() for c in columns), strict=True):
            toy = PointTask()
            toy.reset(seed=0)
            toy._state = tuple(obs[:6].tolist())
            expected, expected_reward, *_ = toy.step(action)
            np.testing.assert_allclose(following[:6], expected, atol=1e-6)
            assert reward[0] == pytest.approx(expected_reward, abs=1e-6) and done[0] == 0.0
    # an episode that broke off counts in no task's averages
    assert len(model.task_episodes[0]) == 2
    assert all(episode["return"] > 0 for episodes in model.task_episodes for episode in episodes)


def test_the_buffer_leaves_out_a_joint_step_of_which_nothing_is_known(tmp_path):
    with reported_in_time():
        env = restarting("kill", tmp_path, at=30, n_workers=1)
        with pytest.warns(UserWarning, match="restart 1 of this worker"):
            model = train(env, steps=150)
        env.close()
    assert model.replay_buffer.task_size.tolist() == [49] * 3


def test_a_schedule_takes_no_account_of_an_episode_that_broke_off():
    from sb3_ars.callbacks.schedule import TaskScheduleCallback
    from sb3_ars.core.schedule import SMTConfig

    with reported_in_time():
        env = make_toy_env(seed=0, n_workers=2, restart_workers=True)
        kill = At(120, partial(os.kill, env._runner.pids[1], signal.SIGKILL))
        schedule = TaskScheduleCallback(SMTConfig(pool_size=1, interval=40))
        with pytest.warns(UserWarning, match="restart 1 of this worker"):
            model = train(env, [schedule, kill], steps=1000, learning_starts=400)
        env.close()
    assert model.schedule_state is not None and model.num_timesteps >= 1000


def test_evaluation_does_not_count_an_episode_that_broke_off(tmp_path):
    from sb3_ars.evaluation import evaluate_tasks

    with reported_in_time():
        model = train(restarting("", tmp_path, n_workers=0, restart_workers=False), steps=60)
        (tmp_path / "built").unlink()
        env = restarting("kill", tmp_path, at=30)
        with (
            pytest.warns(UserWarning, match="restart 1"),
            pytest.raises(WorkerError, match=r"task '\w+' was built anew in the middle of the evaluation"),
        ):
            evaluate_tasks(model, env, "env")
        env.close()


def test_restarting_is_refused_where_there_is_no_worker():
    with pytest.raises(
        ConfigError, match=r"restart_workers=True with n_workers=0: .*Give n_workers=1 or more"
    ):
        make_toy_env(restart_workers=True)
    with pytest.raises(ConfigError, match="restart_workers='yes' must be True or False"):
        make_toy_env(restart_workers="yes")
    with pytest.raises(
        ConfigError, match="restart_workers=True cannot change a DummyVecEnv that is already built"
    ):
        make_multitask_env(DummyVecEnv([PointTask]), restart_workers=True)


def test_automatic_workers_are_at_least_one_where_they_are_to_be_restarted():
    env = make_toy_env(n_workers="auto", restart_workers=True, tasks=["point-west"])
    assert len(env._runner.pids) == 1
    env.close()


def test_a_preset_s_run_restarts_its_workers_where_that_is_asked_for():
    from sb3_ars.experiments.config import load_preset, with_options
    from sb3_ars.experiments.runner import make_env

    config = with_options(load_preset("toy"), {"env": {"n_workers": 1, "restart_workers": True}}, "test")
    env = make_env(config)
    assert env._runner.restarts is not None
    env.close()
