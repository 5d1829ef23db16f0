"""Checkpoints on a disk that fails, is full, or was tampered with; writers that are killed."""

import errno
import json
import os
import random
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th

from sb3_ars import ARSSAC, CheckpointError, ConfigError, make_toy_env
from sb3_ars.checkpoints import CheckpointFolder, HashingFile, latest_checkpoint
from sb3_ars.plain import pack, unpack
from tests.test_resume import (
    Stop,
    assert_same,
    checkpoints,
    everything,
    make,
    run_whole,
    seed_all,
    short,
)

pytestmark = pytest.mark.filterwarnings("ignore:.*leaves no updates")


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A run's folder with the checkpoints of steps 100 and 200; to be copied."""
    folder = tmp_path_factory.mktemp("run") / "checkpoints"
    short(folder)
    return folder


@pytest.fixture
def folder(saved, tmp_path):
    return Path(shutil.copytree(saved, tmp_path / "checkpoints"))


def resumed_step(folder):
    return ARSSAC.resume(folder, make_toy_env(seed=0)).num_timesteps


# ---------------------------------------------------------------------- plain values


def test_values_survive_packing():
    from collections import deque

    value = {
        "a": [1, 2.5, None, True, "text", 2**127],
        "b": (1, (2, [3])),
        "c": deque([{"x": 1.0}], maxlen=3),
        "d": {dtype: np.arange(6, dtype=dtype).reshape(2, 3) for dtype in ("f4", "f8", "i8", "u4", "u1")},
        "e": np.array([[True], [False]]),
        "f": np.float32(0.5),
        "g": np.empty((0, 3)),
        0: th.arange(3),
    }
    found = unpack(pack(value))
    assert found["a"] == value["a"] and found["b"] == value["b"] and found["c"] == value["c"]
    assert found["c"].maxlen == 3 and found["f"] == 0.5 and th.equal(found[0], value[0])
    for dtype, array in [*value["d"].items(), ("e", value["e"]), ("g", value["g"])]:
        other = found["d"][dtype] if dtype in found["d"] else found[dtype]
        assert other.dtype == array.dtype and np.array_equal(other, array)


def test_what_cannot_be_packed_is_named():
    with pytest.raises(TypeError, match=r"state\['a'\]\[1\] is a function"):
        pack({"a": [1, lambda: None]}, "state")


def test_packing_does_not_copy_arrays():
    array = np.zeros(1000, np.float32)
    assert pack(array)["bytes"].data_ptr() == array.ctypes.data


# ---------------------------------------------------------------------- what lies where


def test_only_new_rows_are_written_and_what_is_not_needed_goes(tmp_path):
    make().learn(1200, callback=checkpoints(tmp_path, keep=2))
    assert sorted(path.name for path in tmp_path.glob("step-*")) == ["step-000000001000", "step-000000001100"]
    files = {path.name: path.stat().st_size for path in (tmp_path / "rows").iterdir()}
    row = 4 * (2 * 6 + 2 + 2)
    assert set(files.values()) == {100 * row}  # 25 steps of 4 tasks each
    # rings of 130 hold the last 520 steps; the checkpoint of step 1000 needs those from 480 on
    assert sorted(int(name.split("-")[1]) for name in files) == list(range(500, 1200, 100))
    manifest = json.loads((tmp_path / "step-000000001100" / "manifest.json").read_text())
    assert manifest["step"] == 1100 and manifest["format"] == 1 and manifest["number"] == 10


def test_a_run_that_goes_back_writes_beside_what_it_left(tmp_path):
    make().learn(1200, callback=[checkpoints(tmp_path, keep=5), Stop(801)])
    for step in (600, 700, 800):  # as if the disk had lost them
        (tmp_path / f"step-{step:012d}" / "state.pt").write_bytes(b"")
    with pytest.warns(UserWarning, match="step-000000000800.*state.pt has 0 bytes instead of"):
        model = ARSSAC.resume(tmp_path, make_toy_env(seed=0))
    assert model.num_timesteps == 500
    model.learn(
        model.remaining_timesteps,
        callback=[checkpoints(tmp_path, keep=1), Stop(601)],
        reset_num_timesteps=False,
    )
    (kept,) = tmp_path.glob("step-*")
    assert kept.name == "step-000000000600-8" and resumed_step(tmp_path) == 600


def test_another_buffer_is_written_whole(tmp_path):
    model = make(n_reset=0).learn(300, callback=checkpoints(tmp_path))
    model.save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer")  # the same rows, but nobody can know that
    model.learn(150, callback=checkpoints(tmp_path, keep=1), reset_num_timesteps=False)
    (rows,) = (tmp_path / "rows").iterdir()
    assert rows.stat().st_size == 400 * 4 * (2 * 6 + 2 + 2) and resumed_step(tmp_path) == 400


# ---------------------------------------------------------------------- damage


@pytest.mark.parametrize("name", ["state.pt", "manifest.json"])
@pytest.mark.parametrize("damage", ["truncated", "emptied", "removed", "one bit"])
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_used(folder, name, damage):
    path = folder / "step-000000000200" / name
    data = bytearray(path.read_bytes())
    if damage == "removed":
        path.unlink()
    else:
        data[len(data) // 2] ^= 4
        path.write_bytes({"truncated": data[: len(data) // 2], "emptied": b"", "one bit": data}[damage])
    if name == "manifest.json" and damage == "one bit":
        path.write_bytes(path.read_bytes().replace(b'"step": 200', b'"step": 2x0'))
    with pytest.warns(UserWarning, match=rf"step-000000000200.*{name}.*step 100 is used instead"):
        assert resumed_step(folder) == 100


def test_damaged_newest_rows_are_named_and_the_checkpoint_before_them_used(folder):
    newest = max((folder / "rows").iterdir(), key=lambda path: path.name.split("-")[1])
    newest.write_bytes(newest.read_bytes()[:-1])
    with pytest.warns(
        UserWarning, match=rf"{newest.name} has .* bytes instead of .*step 100 is used instead"
    ):
        assert resumed_step(folder) == 100


def test_if_none_is_whole_the_error_says_what_is_wrong_with_each(folder):
    for path in folder.glob("*/state.pt"):
        path.write_bytes(b"x" * path.stat().st_size)
    with pytest.raises(
        CheckpointError, match=r"No checkpoint in .* is whole: .*000200.*checksum differs.*000100"
    ):
        resumed_step(folder)


def test_a_later_format_is_refused_with_the_remedy(folder):
    for path in folder.glob("*/manifest.json"):
        path.write_text(path.read_text().replace('"format": 1', '"format": 9'))
    with pytest.raises(
        CheckpointError, match="has format 9, this version of sb3_ars reads format 1; resume with"
    ):
        resumed_step(folder)


def test_a_manifest_cannot_name_files_elsewhere(folder):
    for path in folder.glob("*/manifest.json"):
        path.write_text(path.read_text().replace('"rows/', '"../../rows/'))
    with pytest.raises(CheckpointError, match=r"names a file outside the folder"):
        resumed_step(folder)


def mutated(rng, data):
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 8])):
        kind, at = rng.randrange(4), rng.randrange(len(data) + 1)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            data[at : at + rng.randrange(1, 64)] = b""
        elif kind == 2:
            data[at:at] = rng.randbytes(rng.randrange(1, 16))
        else:
            del data[max(at, 1) :]
        data = data or bytearray(b"{")
    return bytes(data)


WORDS = [
    None,
    True,
    -1,
    0,
    1,
    2**70,
    1e308,
    float("nan"),
    "",
    "x",
    "../x",
    [],
    {},
    [[]],
    {"__array__": "O"},
    [{}],
]


def mutated_value(rng, value):
    """Exchange one part of a nested value."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        changed = dict(value)
        if rng.random() < 0.15:
            del changed[key]
        else:
            changed[key] = mutated_value(rng, value[key])
        return changed
    if isinstance(value, list) and value and rng.random() < 0.8:
        index = rng.randrange(len(value))
        return [*value[:index], mutated_value(rng, value[index]), *value[index + 1 :]]
    return rng.choice([*WORDS, th.zeros(3), th.zeros(2, dtype=th.uint8)])


def rehash(folder, name):
    """Make the manifest agree with a file, as somebody who means harm would."""
    import hashlib

    manifest = folder / "manifest.json"
    values = json.loads(manifest.read_text())
    for record in values["files"]:
        if record["path"].endswith(name):
            data = (folder / name).read_bytes()
            record["bytes"], record["sha256"] = len(data), hashlib.sha256(data).hexdigest()
    manifest.write_text(json.dumps(values))


def fuzz(folder, n, seed=0):
    """Resume from so many damaged checkpoints; return how many were refused and how many could be used."""
    rng = random.Random(seed)
    shutil.rmtree(folder / "step-000000000100")
    checkpoint = folder / "step-000000000200"
    good = {name: (checkpoint / name).read_bytes() for name in ("manifest.json", "state.pt")}
    state = th.load(checkpoint / "state.pt", weights_only=True)
    env, outcomes = make_toy_env(seed=0), {"refused": 0, "used": 0}
    for _ in range(n):
        for name, data in good.items():
            (checkpoint / name).write_bytes(data)
        kind = rng.randrange(4)
        if kind == 0:
            (checkpoint / "manifest.json").write_bytes(mutated(rng, good["manifest.json"]))
        elif kind == 1:
            values = mutated_value(rng, json.loads(good["manifest.json"]))
            (checkpoint / "manifest.json").write_text(json.dumps(values, default=str))
        elif kind == 2:
            (checkpoint / "state.pt").write_bytes(mutated(rng, good["state.pt"]))
            rehash(checkpoint, "state.pt")
        else:
            th.save(mutated_value(rng, state), checkpoint / "state.pt")
            rehash(checkpoint, "state.pt")
        try:
            ARSSAC.resume(folder, env)
            outcomes["used"] += 1
        except ConfigError:
            outcomes["refused"] += 1
    return outcomes


@pytest.mark.filterwarnings("ignore")
def test_fuzzed_checkpoints_give_our_errors_alone(folder):
    outcomes = fuzz(folder, 150)
    assert sum(outcomes.values()) == 150 and outcomes["refused"] > 75


def test_rows_outside_the_checksums_are_not_read(folder):
    manifest = folder / "step-000000000200" / "manifest.json"
    values = json.loads(manifest.read_text())
    values["notes"]["rows"][0]["file"] = "../elsewhere.bin"
    manifest.write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=r"is damaged.*elsewhere"):
        resumed_step(folder)


def test_a_checkpoint_that_was_not_finished_counts_for_nothing(folder):
    half = folder / "step-000000000300.writing"
    shutil.copytree(folder / "step-000000000200", half)
    assert resumed_step(folder) == 200
    CheckpointFolder(folder, keep=1).prune()
    assert [path.name for path in folder.glob("step-*")] == ["step-000000000200"] and resumed_step(
        folder
    ) == 200
    shutil.rmtree(folder / "step-000000000200")
    half.mkdir()
    short(folder)  # a half-written first one keeps nobody from beginning
    assert resumed_step(folder) == 200


# ---------------------------------------------------------------------- disks


class FullDisk:
    """A file on a disk that has room for so many bytes, of all files together."""

    room = 0

    def __init__(self, file):
        self.file = file

    def write(self, data):
        FullDisk.room -= len(data)
        if FullDisk.room < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.file.write(data)

    def flush(self):
        self.file.flush()


@pytest.mark.parametrize("room", [0, 100, 7000, 20_000])  # in the rows, or in the state
def test_a_full_disk_is_a_warning_and_the_checkpoint_before_stays(tmp_path, monkeypatch, room):
    model = make(n_reset=0).learn(250, callback=checkpoints(tmp_path))
    before = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*"))
    monkeypatch.setattr("sb3_ars.checkpoints.HashingFile", lambda file: HashingFile(FullDisk(file)))
    FullDisk.room = room
    with pytest.warns(
        UserWarning, match=r"step 352 could not be written.*No space left.*the last good one is .*0200"
    ):
        model.learn(150, callback=checkpoints(tmp_path), reset_num_timesteps=False)
    monkeypatch.undo()
    assert sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*")) == before
    assert resumed_step(tmp_path) == 200
    model.learn(150, callback=checkpoints(tmp_path), reset_num_timesteps=False)  # with room again
    assert resumed_step(tmp_path) == 504


def test_a_limit_on_file_sizes_is_reported_too(tmp_path):
    model = make(n_reset=0)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.warns(UserWarning, match="could not be written.*File too large.*there is none yet"):
            model.learn(250, callback=checkpoints(tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_folder_that_vanished_is_made_again(tmp_path):
    model = make(n_reset=0).learn(250, callback=checkpoints(tmp_path / "run"))
    shutil.rmtree(tmp_path / "run")
    with pytest.warns(UserWarning, match="could not be written"):
        model.learn(
            150, callback=[Vanish(tmp_path / "run"), checkpoints(tmp_path / "run")], reset_num_timesteps=False
        )


class Clear(Stop):
    """Removes all checkpoints in the middle of a run, as a cluster does with what is old."""

    def __init__(self, folder):
        super().__init__(10**9)
        self.folder = folder

    def _on_step(self):
        if self.num_timesteps == 248:
            for path in self.folder.glob("[sr]*"):
                shutil.rmtree(path)
        return True


def test_rows_that_were_cleared_away_are_written_again(tmp_path):
    make(n_reset=0).learn(500, callback=[checkpoints(tmp_path), Clear(tmp_path)])
    assert resumed_step(tmp_path) == 400


def test_many_files_of_rows_need_few_descriptors(tmp_path):
    make(n_reset=0, buffer_size=2000).learn(500, callback=checkpoints(tmp_path, every=4))
    assert len(list((tmp_path / "rows").iterdir())) > 100
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (64 + len(os.listdir("/proc/self/fd")), hard))
    try:
        assert resumed_step(tmp_path) == 496
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


class Vanish(Stop):
    """Puts a file where the folder of checkpoints was."""

    def __init__(self, folder):
        super().__init__(10**9)
        self.folder = folder

    def _on_rollout_start(self):
        if self.folder.is_dir():
            shutil.rmtree(self.folder)
            self.folder.touch()


def test_what_no_checkpoint_can_hold_is_a_warning(tmp_path):
    class Odd(Stop):
        def checkpoint_state(self):
            return {"here": object()}

        def restore_checkpoint_state(self, state):
            raise AssertionError("never")

    with pytest.warns(
        UserWarning, match=r"could not be written.*\['Odd-0'\]\['here'\] is a object.*Training goes on"
    ):
        make(n_reset=0).learn(250, callback=[checkpoints(tmp_path), Odd(10**9)])


# ---------------------------------------------------------------------- killed writers

KILLED = """
import os, signal, sys
from tests.test_checkpoints import *
n = [int(sys.argv[2])]
def dying(event, arguments):  # at the n-th file system operation under the folder
    if event in ("open", "os.rename", "os.mkdir", "os.remove", "shutil.rmtree") and sys.argv[1] in str(arguments[0]):
        n[0] -= 1
        if n[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
seed_all(1)
model = make()
sys.addaudithook(dying)
model.learn(1200, callback=[checkpoints(sys.argv[1], every=200), Stop(700)])
"""


@pytest.mark.parametrize("operation", [1, 4, 7, 9, 12, 14, 17, 20, 23])
def test_a_writer_killed_anywhere_leaves_nothing_unusable(tmp_path, operation):
    command = [sys.executable, "-W", "ignore", "-c", KILLED, str(tmp_path / "c"), str(operation)]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], env={**os.environ, "PYTHONPATH": "."})
    assert done.returncode == -9
    if list((tmp_path / "c").glob("step-*[0-9]")):
        checkpoint = latest_checkpoint(tmp_path / "c")  # whole, without a warning
        model = ARSSAC.resume(tmp_path / "c", make_toy_env(seed=0))
        assert model.num_timesteps == checkpoint.step
    else:
        seed_all(1)
        model = make()
    model.learn(
        1200 - model.num_timesteps,
        callback=checkpoints(tmp_path / "c"),
        reset_num_timesteps=model.num_timesteps == 0,
    )
    if operation in (9, 20):
        found = everything(model)
        assert_same(run_whole(make)[1], found)
    assert not list((tmp_path / "c").rglob("*.writing"))
