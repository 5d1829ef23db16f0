"""A study in a real PostgreSQL server, by several processes, one of which is killed."""

import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from glob import glob
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState
from test_tuning import by_resets, ended_well, fake_train, wait_for, worker

from sb3_ars.errors import ConfigError
from sb3_ars.tuning import tune
from sb3_ars.tuning.storage import open_storage

pytest.importorskip("psycopg", reason='the driver is missing: pip install "sb3-ars[postgres]"')

BINARIES = [shutil.which("initdb"), *sorted(glob("/usr/lib/postgresql/*/bin/initdb"), reverse=True)]
BINARIES = [Path(path).parent for path in BINARIES if path]
pytestmark = [
    pytest.mark.services,
    pytest.mark.skipif(not BINARIES, reason="PostgreSQL is not installed (Debian: apt install postgresql)"),
]


def as_server(folder):
    """Return what stands before a command of the server: it refuses to run as root."""
    if os.name != "posix" or os.geteuid() != 0:
        return []
    user = "postgres" if subprocess.run(["id", "postgres"], capture_output=True).returncode == 0 else "nobody"
    if shutil.which("setpriv") is None:
        pytest.skip("PostgreSQL refuses to run as root, and setpriv is missing")
    shutil.chown(folder, user)
    return ["setpriv", f"--reuid={user}", f"--regid={_group(user)}", "--clear-groups"]


def _group(user):
    return subprocess.run(["id", "-g", user], capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture(scope="module")
def server():
    """URL of a new server's database, for this module only."""
    # not pytest's folder, which the server's user may not enter
    folder = Path(tempfile.mkdtemp(prefix="pg-", dir="/tmp"))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    before, binaries, password = as_server(folder), BINARIES[0], folder / "password"
    password.write_text("hush\n")
    if before:
        password.chmod(0o644)
    options = f"-p {port} -c listen_addresses=127.0.0.1 -c unix_socket_directories={folder} -c fsync=off"
    control = [*before, str(binaries / "pg_ctl"), "-D", str(folder / "data"), "-w", "-t", "60"]
    run = {"check": True, "cwd": folder, "stdout": subprocess.DEVNULL, "timeout": 120}
    try:
        subprocess.run(
            [
                *(*before, str(binaries / "initdb"), "-D", str(folder / "data"), "-U", "tuner", "-E", "UTF8"),
                *("--auth=scram-sha-256", f"--pwfile={password}", "--no-sync"),
            ],
            **run,
        )
        subprocess.run([*control, "-l", str(folder / "log"), "-o", options, "start"], **run)
        yield f"postgresql+psycopg://tuner:hush@127.0.0.1:{port}/postgres"
    finally:
        if (folder / "data" / "postmaster.pid").exists():
            subprocess.run([*control, "-m", "immediate", "stop"], **run)
        shutil.rmtree(folder, ignore_errors=True)


def test_two_processes_one_of_them_killed_finish_a_study_together(server, tmp_path):
    # each on an empty database at once, each with folders of its own, like two machines
    killed, other = worker(tmp_path / "a", 8, 600, server), worker(tmp_path / "b", 8, 0.3, server)
    wait_for(lambda: list((tmp_path / "a").glob("s/trial*/started")))
    wait_for(lambda: list((tmp_path / "b").glob("s/trial*/started")))
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    ended_well(other)
    ended_well(worker(tmp_path / "b", 8, 0.1, server))  # should the other have ended before the kill
    trials = optuna.load_study(study_name="s", storage=open_storage(server)).trials
    complete = [trial for trial in trials if trial.state is TrialState.COMPLETE]
    assert len(complete) == 8
    (dead,) = [t for t in trials if t.state is TrialState.FAIL and t.user_attrs.get("failed_by") != "surplus"]
    assert dead.user_attrs["owner"]["pid"] == killed.pid
    (again,) = [trial for trial in complete if trial.user_attrs.get("retry_of") == dead.number]
    assert again.params == dead.params
    assert {trial.state for trial in trials} == {TrialState.COMPLETE, TrialState.FAIL}


def test_a_study_goes_on_in_the_database(server, tmp_path, monkeypatch):
    fake_train(monkeypatch, by_resets)
    common = {"n_seeds": 1, "output": tmp_path, "name": "resumed", "storage": server}
    tune("toy", n_trials=2, **common)
    study = tune("toy", n_trials=5, **common)
    assert len(study.trials) == 5
    with pytest.raises(ConfigError, match=r"tuner:\*\*\*@127.0.0.1.*preset was 'toy', is 'mt10-ars'"):
        tune("mt10-ars", n_trials=5, **common)


def test_a_wrong_password_is_told_without_it(server, tmp_path):
    started = time.monotonic()
    with pytest.raises(ConfigError, match=r"cannot be reached.*password authentication failed") as raised:
        tune("toy", output=tmp_path, storage=server.replace("hush", "psst"))
    assert "psst" not in str(raised.value) and time.monotonic() - started < 15
