"""What is recorded is what an evaluation sees, right side up, in files that are whole."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from sb3_ars import ARSSAC, make_metaworld_env, make_multitask_env, make_toy_env
from sb3_ars.cli import main
from sb3_ars.envs import rendering
from sb3_ars.envs.toy import PointTask
from sb3_ars.errors import ConfigError
from sb3_ars.evaluation import EvaluationProtocol, evaluate_tasks, make_evaluation_env
from sb3_ars.video import record, record_episodes, write_video

TINY = {"batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "seed": 3, "device": "cpu"}
NO_ENV = {"goals": None, "max_episode_steps": None}


@pytest.fixture(scope="module")
def gl():
    """Skip where MuJoCo cannot draw."""
    try:
        return rendering.select_gl_backend()
    except ConfigError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def toy_model():
    return ARSSAC("MlpPolicy", make_toy_env(seed=0), **TINY)


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_recording_shows_the_episodes_of_an_evaluation(toy_model, deterministic):
    protocol = EvaluationProtocol("env", 3, **NO_ENV)
    evaluated = evaluate_tasks(toy_model, make_toy_env(seed=9), protocol, deterministic, seed=5)
    for task in ("point-west", 3):
        env = make_toy_env(seed=9, render_mode="rgb_array", render_size=64)
        recording = record_episodes(toy_model, task, env, 3, deterministic, seed=5)
        index = evaluated.task_names.index(recording.task)
        assert recording.returns == tuple(evaluated.returns[index])
        assert recording.successes == tuple(evaluated.success_once[index])
        assert recording.frames.shape == (150, 64, 64, 3) and recording.frames.dtype == np.uint8
        assert recording.fps == 20


def test_frames_are_left_out_and_time_runs_on(toy_model):
    every = record(toy_model, "point-east", size=64, caption=False)
    third = record_episodes(toy_model, "point-east", size=64, caption=False, fps=7)
    np.testing.assert_array_equal(third.frames, every[::3])
    assert third.fps == pytest.approx(20 / 3)


class Scripted(gym.Env):
    """A task of a user's own: three steps, success in the second; each frame is as grey as the step's number."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space, action_space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (1,))
    render_mode = "rgb_array"

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(2, np.float32), 1.0, False, self.steps == 3, {"success": float(self.steps == 2)}

    def render(self):
        return np.full((100, 200, 3), self.steps, np.uint8)


def test_a_task_of_one_s_own_is_recorded_and_the_caption_says_success_only_after_it():
    env = make_multitask_env({"left": Scripted, "right": Scripted}, n_workers=0)
    model = ARSSAC(
        "MlpPolicy", make_multitask_env({"left": Scripted, "right": Scripted}, n_workers=0), **TINY
    )
    recording = record_episodes(model, "right", env, n_episodes=2)
    assert recording.frames.shape == (6, 100, 200, 3) and recording.fps == 10
    assert (recording.successes, recording.returns) == ((1.0, 1.0), (3.0, 3.0))
    assert recording.frames[:, 0, 0, 0].tolist() == [0, 1, 2, 0, 1, 2]  # what the policy acted on
    assert (recording.frames[:, -1, 0] == 30).all()  # the band
    says_success = (recording.frames == (140, 220, 140)).all(axis=3).any(axis=(1, 2))
    assert says_success.tolist() == [False, True, True, False, True, True]


def test_the_toy_is_drawn_right_side_up_and_to_scale():
    env = PointTask(render_mode="rgb_array", render_size=200)
    env.reset(seed=0)
    env._state = (0.5, 0.5, 0.0, 0.0, -0.5, -0.5)
    env._way = [(0.5, 0.5)]
    frame = env.render().astype(int)
    blue = np.argwhere(frame[:, :, 2] - frame[:, :, 0] > 80).mean(axis=0)
    green = np.argwhere(frame[:, :, 1] - np.maximum(frame[:, :, 0], frame[:, :, 2]) > 60)
    np.testing.assert_allclose(blue, (100 - 46, 100 + 46), atol=1.5)  # row, column: up is up
    np.testing.assert_allclose(green.mean(axis=0), (100 + 46, 100 - 46), atol=1.5)
    assert np.ptp(green[:, 0]) == pytest.approx(2 * 0.05 * 92, abs=2)  # the disc is as large as success is


@pytest.mark.metaworld
def test_a_metaworld_recording_is_the_evaluation_s_and_right_side_up(gl):
    tasks, protocol = ["reach", "drawer-open"], EvaluationProtocol("short", 2, 12)
    model = ARSSAC("MlpPolicy", make_metaworld_env(tasks, seed=0, n_workers=0), **TINY)
    with_frames = {"render_mode": "rgb_array", "render_size": 64}
    env = make_evaluation_env(tasks, protocol, n_workers=0, **with_frames)
    recording = record_episodes(model, "drawer-open", env, n_episodes=2, caption=False)
    evaluated = evaluate_tasks(model, make_evaluation_env(tasks, protocol, n_workers=0), protocol)
    assert recording.returns == tuple(evaluated.returns[1])
    assert recording.frames.shape == (8, 64, 64, 3) and recording.fps == pytest.approx(80 / 3)
    assert (recording.frames[0] != recording.frames[3]).any()
    # each env draws itself, though all share a process
    first, second = env.get_images()
    alone = make_evaluation_env(tasks[:1], protocol, n_workers=0, **with_frames)
    alone.seed(0), alone.reset(), env.seed(0), env.reset()
    np.testing.assert_array_equal(alone.get_images()[0], env.get_images()[0])
    assert (first != second).any()
    for one in (env, alone):
        one.close()


@pytest.mark.metaworld
@pytest.mark.parametrize("camera", ["front", "corner", "corner2", "corner4"])
def test_the_empty_background_is_above_the_table(gl, camera):
    env = make_metaworld_env(
        "reach", seed=0, n_workers=0, render_mode="rgb_array", render_size=96, camera=camera
    )
    env.reset()
    background = (env.render() == (127, 126, 122)).all(axis=2)
    env.close()
    assert background[:8].mean() > 0.9 and not background[-8:].any()


def test_files_hold_the_frames_and_a_failure_leaves_the_old_file(tmp_path, toy_model, monkeypatch):
    frames = record(toy_model, "point-east", size=64)
    with Image.open(write_video(tmp_path / "new" / "a.gif", frames, fps=20)) as gif:
        assert (gif.n_frames, gif.size, gif.info["duration"], gif.info["loop"]) == (50, (64, 64), 50, 0)
    before = (tmp_path / "new" / "a.gif").read_bytes()

    def fail(path, frames, fps):
        path.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr("sb3_ars.video._write_gif", fail)
    with pytest.raises(ConfigError, match="disk full"):
        write_video(tmp_path / "new" / "a.gif", frames, fps=20)
    assert (tmp_path / "new" / "a.gif").read_bytes() == before
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.gif"]


def read_frames(path, size):
    """The frames of an MP4 of square ones, and what ffmpeg says of it."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="extra 'video' is missing")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, size, size, 3), done.stderr


def test_an_mp4_holds_the_frames(tmp_path, toy_model):
    frames = record(toy_model, "point-east", size=64, caption=False)
    read, said = read_frames(write_video(tmp_path / "a.mp4", frames, fps=20), 64)
    assert read.shape == frames.shape and b" 20 fps" in said
    assert np.abs(read.astype(int) - frames).mean() < 5


def test_the_command_writes_into_the_run_s_folder(run, capsys, tmp_path):
    assert main(["video", str(run), "--task", "point-east", "--format", "gif", "--size", "64"]) == 0
    assert (run / "videos" / "point-east.gif").is_file()
    said = capsys.readouterr().out
    assert "point-east, 1 episode, 2.5 s, success in " in said
    arguments = ["--task", "all", "--output", str(tmp_path / "v"), "--format", "gif", "--size", "64"]
    assert main(["video", str(run), *arguments, "--sampled", "--episodes", "2"]) == 0
    names = sorted(path.name for path in (tmp_path / "v").iterdir())
    assert names == ["point-east.gif", "point-north.gif", "point-south.gif", "point-west.gif"]
    assert capsys.readouterr().out.count("2 episodes, 5.0 s") == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "point-eats"], "Did you mean 'point-east'?"),
        (["--task", "point-east", "--output", "a.avi"], "not as 'avi'"),
        (["--task", "point-east", "--output", "a.gif", "--format", "mp4"], "not as 'gif' for a.gif"),
        (["--task", "point-east", "--format", "gif", "--size", "65"], "must be even"),
        (["--task", "point-east", "--format", "gif", "--episodes", "0"], "n_episodes (--episodes)=0"),
        (
            ["--task", "point-east", "--format", "gif", "--output", "sweep"],
            "sweep needs a suffix, .mp4 or .gif",
        ),
        (
            ["--task", "point-east", "--format", "gif", "--camera", "nosuch"],
            "camera='nosuch' is for Meta-World",
        ),
        (["--task", "point-east", "--output", "/proc/a.gif"], "/proc/a.gif cannot be written"),
    ],
)
def test_mistakes_are_named(run, arguments, message, capsys):
    assert main(["video", str(run), *arguments]) == 2
    assert message in capsys.readouterr().err


def test_the_command_s_help_begins_with_a_sentence(capsys):
    with pytest.raises(SystemExit):
        main(["video", "--help"])
    out = capsys.readouterr().out
    assert "Record what a finished run's policy does" in out.partition("positional arguments")[0]


def test_a_folder_without_a_finished_run_is_refused(tmp_path, capsys):
    assert main(["video", str(tmp_path), "--task", "push"]) == 2
    assert "holds no finished run" in capsys.readouterr().err


def test_an_env_that_does_not_render_and_a_model_without_tasks_are_refused(toy_model):
    with pytest.raises(ConfigError, match="render_mode='rgb_array'"):
        record(toy_model, "point-east", make_toy_env(seed=0))
    with pytest.raises(ConfigError, match="no task names"):
        record(object(), "push")
    with pytest.raises(ConfigError, match="give record an environment"):
        record(type("Mine", (), {"task_names": ["left", "right"]})(), "left")


def test_without_imageio_the_error_names_the_extra_before_anything_is_recorded(run, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main(["video", str(run), "--task", "point-east"]) == 2
    assert 'pip install "sb3-ars[video]"' in capsys.readouterr().err


def test_egl_comes_before_osmesa_and_what_the_user_set_before_both(monkeypatch):
    works = {"osmesa"}
    asked = []

    def complain(backend):
        asked.append(backend)
        return "" if backend in works else f"no {backend} here"

    monkeypatch.setattr(rendering, "_complaint", complain)
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MUJOCO_GL", "")  # so that what is set below goes away again
    assert rendering.select_gl_backend() == "osmesa" and asked == ["egl", "osmesa"]
    assert rendering.find_gl_backend() == "osmesa" and asked[2:] == ["osmesa"]
    works.clear()
    monkeypatch.setenv("MUJOCO_GL", "")
    with pytest.raises(
        ConfigError, match=r"libegl1.*libosmesa6.*MUJOCO_GL=egl.*egl: no egl here; osmesa: no"
    ):
        make_metaworld_env("reach", render_mode="rgb_array")
    monkeypatch.setenv("DISPLAY", ":0")
    works.add("glfw")
    assert rendering.find_gl_backend() == "glfw"


def test_the_probe_says_what_is_wrong():
    assert "invalid value for environment variable MUJOCO_GL: nonsense" in rendering._complaint("nonsense")


def test_sb3_s_recorder_shows_all_tasks_side_by_side(tmp_path):
    pytest.importorskip("moviepy", minversion="2", reason="SB3 records with moviepy 2")
    from stable_baselines3.common.vec_env import VecVideoRecorder

    env = make_toy_env(seed=0, render_mode="rgb_array", render_size=64)
    recorder = VecVideoRecorder(env, str(tmp_path), lambda step: step == 0, video_length=3)
    recorder.reset()
    first = env.render()
    for _ in range(3):
        recorder.step(np.zeros((4, 2), np.float32))
    recorder.close()
    (file,) = tmp_path.glob("*.mp4")
    read, said = read_frames(file, 128)
    assert b" 20 fps" in said and np.abs(read[0].astype(int) - first).mean() < 8
