"""Records what a trained policy does on a task: frames for notebooks, MP4 and GIF files; trains and scores nothing."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
import torch as th
from matplotlib import get_data_path
from PIL import Image, ImageDraw, ImageFont
from stable_baselines3.common.vec_env import VecEnv

from sb3_ars.envs import make_metaworld_env, make_toy_env
from sb3_ars.envs.metaworld import metaworld_task_names
from sb3_ars.envs.rendering import DEFAULT_CAMERA
from sb3_ars.envs.toy import TOY_TASKS
from sb3_ars.errors import ConfigError, check_count, nearest
from sb3_ars.evaluation import EvaluationProtocol, Policy, make_evaluation_env, prepare_evaluation_env
from sb3_ars.experiments.run_folder import read_run
from sb3_ars.experiments.runner import load_model, protocol_of
from sb3_ars.files import write_whole

__all__ = ["Recording", "VideoFormat", "record", "record_episodes", "record_run", "write_video"]

Frames = npt.NDArray[np.uint8]
VideoFormat = Literal["mp4", "gif"]

_NO_EXTRA = 'MP4 files need imageio and imageio-ffmpeg: pip install "sb3-ars[video]". GIF files need neither.'
_TEXT, _SUCCESS, _BAND = (235, 235, 235), (140, 220, 140), (30, 30, 30)


@dataclass(frozen=True)
class Recording:
    """What a policy did on one task.

    :param task: its name
    :param frames: ``(n, size, size, 3)`` uint8, all episodes one behind the other
    :param fps: frames per second at which time runs as in the environment
    :param successes: of each episode, at least once, as in an evaluation; NaN where the task reports none
    :param returns: of each episode, sum of raw rewards
    """

    task: str
    frames: Frames
    fps: float
    successes: tuple[float, ...]
    returns: tuple[float, ...]


def record(model: Policy, task: str | int, env: VecEnv | None = None, **options: Any) -> Frames:
    """Return the frames of a policy at work on a task, ``(n, size, size, 3)`` uint8.

    :param model: a trained model
    :param task: name, with or without Meta-World's "-v3", or index
    :param env: see :func:`record_episodes`
    :param options: see :func:`record_episodes`
    """
    return record_episodes(model, task, env, **options).frames


def record_episodes(
    model: Policy,
    task: str | int,
    env: VecEnv | None = None,
    n_episodes: int = 1,
    deterministic: bool = True,
    seed: int = 0,
    size: int = 320,
    camera: str = DEFAULT_CAMERA,
    fps: int = 30,
    caption: bool = True,
) -> Recording:
    """Run a policy on a task and record it.

    The episodes are those of :func:`~sb3_ars.evaluation.evaluate_tasks` with the same seed and environment.

    :param model: a trained model
    :param task: name, with or without Meta-World's "-v3", or index
    :param env: a multi-task environment made for evaluation with ``render_mode="rgb_array"``, whose size and camera
        then count; ``None`` makes the toy's or Meta-World's from the model's task names, as protocol "paper" has it
    :param n_episodes: how many
    :param deterministic: mean actions, or samples
    :param seed: of the sampled actions and of the environment's first reset
    :param size: width and height of the frames in pixels
    :param camera: "front", or one of Meta-World's: "corner", "corner2", "corner3", "corner4", "topview",
        "behindGripper", "gripperPOV"
    :param fps: at most so many frames per second of the environment's time; steps in between are left out
    :param caption: whether the frames say task, step and success
    :raises ConfigError: for an unknown task, an environment that does not render, or a machine that cannot draw
    """
    if env is not None and not isinstance(env, VecEnv):
        raise ConfigError(f"env={env!r} must be an environment with tasks, such as make_toy_env's, or None.")
    if env is not None:
        return _record(model, task, env, n_episodes, deterministic, seed, fps, caption)
    names = getattr(model, "task_names", None)
    if names is None:
        raise ConfigError("This model has no task names; give record an environment of its tasks.")
    _task_index(task, names)  # before an environment is built
    with closing(_make_env(names, n_episodes, size, camera)) as own:
        return _record(model, task, own, n_episodes, deterministic, seed, fps, caption)


def record_run(
    folder: Path,
    task: str,
    format: VideoFormat | None = None,
    output: Path | None = None,
    n_episodes: int = 1,
    deterministic: bool = True,
    seed: int = 0,
    size: int = 320,
    camera: str = DEFAULT_CAMERA,
    fps: int = 30,
    after_task: Callable[[Path, Recording], None] | None = None,
) -> list[Path]:
    """Record a finished run's policy under the run's own protocol, and write a file per task.

    :param folder: of the run
    :param task: name, or "all"
    :param format: "mp4" or "gif"; ``None`` is the output's suffix, or MP4
    :param output: file; for "all", folder. ``None`` is ``videos/<task>.<format>`` in the run's folder
    :param n_episodes: see :func:`record_episodes`, as the following
    :param deterministic: mean actions, or samples
    :param seed: of actions and environment
    :param size: in pixels
    :param camera: of Meta-World; the toy tasks have one view only
    :param fps: at most so many frames per second of the environment's time
    :param after_task: told of each file as soon as it is written
    :return: the files
    :raises ConfigError: if the folder holds no finished run, for an unknown task, or where a file cannot be written
    """
    run = read_run(folder)
    names = run.task_names
    chosen = names if task == "all" else [names[_task_index(task, names)]]
    suffix = _format_of(format, output if task != "all" else None)
    files = [_file_of(name, suffix, folder, output, task == "all") for name in chosen]
    protocol = protocol_of(run.config)
    rendering: dict[str, Any] = {"render_mode": "rgb_array", "render_size": _check_size(size)}
    config = run.config.env
    if config.is_toy:
        _check_toy_camera(camera)
        env: VecEnv = make_toy_env(
            run.seed, max_episode_steps=config.max_episode_steps, tasks=config.task_names, **rendering
        )
    else:
        rendering["camera"] = camera
        env = make_evaluation_env(list(names), protocol, n_workers=0, **rendering)
    with closing(env):
        model = load_model(folder / "policy.zip", run.config)
        for name, file in zip(chosen, files, strict=True):
            recording = _record(model, name, env, n_episodes, deterministic, seed, fps, caption=True)
            write_video(file, recording.frames, recording.fps)
            if after_task is not None:
                after_task(file, recording)
    return files


def write_video(path: Path | str, frames: Frames, fps: float) -> Path:
    """Write frames as MP4 or GIF, whole or not at all; return the path.

    :param path: file to write; its suffix decides
    :param frames: ``(n, height, width, 3)`` uint8
    :param fps: frames per second
    :raises ConfigError: for another suffix, frames of another form, a missing package or an unwritable folder
    """
    path = Path(path)
    _format_of(None, path)
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8 or not len(frames):
        raise ConfigError(
            f"frames must be (n, height, width, 3) uint8, at least one, got {frames.shape} {frames.dtype}."
        )
    write = _write_gif if path.suffix == ".gif" else _write_mp4
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, lambda temporary: write(temporary, frames, fps))
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from error
    return path


def _record(
    model: Policy,
    task: str | int,
    env: VecEnv,
    n_episodes: int,
    deterministic: bool,
    seed: int,
    fps: int,
    caption: bool,
) -> Recording:
    if env.render_mode != "rgb_array":
        raise ConfigError(
            f"The environment has render_mode={env.render_mode!r}; make it with render_mode='rgb_array' to record it."
        )
    for option, value in (("n_episodes (--episodes)", n_episodes), ("fps", fps)):
        check_count(option, value)
    tasks: Any = env
    horizon, goals = getattr(env, "max_episode_steps", None), getattr(env, "goals", None)
    # the protocol that is the environment's own: whoever made it knew which
    prepare_evaluation_env(model, env, EvaluationProtocol("recording", 1, horizon, goals))
    index = _task_index(task, tasks.task_names)
    name = str(tasks.task_names[index])
    row = int(np.flatnonzero(np.asarray(tasks.task_of_env) == index)[0])
    metadata: dict[str, Any] = env.metadata
    steps_per_second = float(metadata.get("render_fps", 30))
    every = math.ceil(steps_per_second / fps)
    frames: list[Frames] = []
    ends: list[dict[str, Any]] = []
    with _seeded(seed):
        env.seed(seed)
        obs = env.reset()
        for episode in range(n_episodes):
            success, step, done = math.nan, 0, False
            while not done:
                picture = env.env_method("render", indices=[row])[0] if step % every == 0 else None
                # all tasks act, as in an evaluation, so that sampled actions are the same
                actions, _ = model.predict(obs, deterministic=deterministic)
                obs, _, dones, infos = env.step(actions)
                step, done = step + 1, bool(dones[row])
                success = np.fmax(success, float(infos[row].get("success", np.nan)))
                if picture is not None:
                    frames.append(picture)
                if caption and (done or step % every == 0):
                    which = f"episode {episode + 1}, " if n_episodes > 1 else ""
                    frames[-1] = _captioned(frames[-1], name, f"{which}step {step}", success > 0)
            ends.append(infos[row])
    successes = tuple(float(end.get("is_success", math.nan)) for end in ends)
    returns = tuple(float(end["episode"]["r"]) for end in ends)
    return Recording(name, np.stack(frames), steps_per_second / every, successes, returns)


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Draw from a generator of its own, as an evaluation does; torch's global one goes on as if nothing was drawn."""
    with th.random.fork_rng():
        th.manual_seed(seed)
        yield


def _captioned(frame: Frames, task: str, status: str, success: bool) -> Frames:
    """Return the frame with a band at its lower edge: task, step, and whether there was success so far."""
    height = max(len(frame) // 14, 12)
    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image)
    font = ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", round(0.62 * height))
    top, middle = image.height - height, image.height - height / 2
    draw.rectangle((0, top, image.width, image.height), fill=_BAND)
    draw.text((height / 3, middle), task, fill=_TEXT, font=font, anchor="lm")
    text = f"{status}, success" if success else status
    draw.text(
        (image.width - height / 3, middle), text, fill=_SUCCESS if success else _TEXT, font=font, anchor="rm"
    )
    return np.asarray(image)


def _write_gif(path: Path, frames: Frames, fps: float) -> None:
    # one palette for all frames, from the first, the middle and the last: a palette each would flicker, and be large
    sample = Image.fromarray(np.concatenate(frames[[0, len(frames) // 2, -1]]))
    palette = sample.quantize(256)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    # in hundredths of a second; browsers slow down what is faster than 50 frames per second
    duration = max(round(100 / fps), 2) * 10
    images[0].save(path, save_all=True, append_images=images[1:], duration=duration, loop=0)


def _write_mp4(path: Path, frames: Frames, fps: float) -> None:
    imageio = _imageio()
    even = frames[:, : frames.shape[1] // 2 * 2, : frames.shape[2] // 2 * 2]  # which the pixel format demands
    options = {"codec": "libx264", "pixelformat": "yuv420p", "macro_block_size": 2}
    with imageio.get_writer(path, format="FFMPEG", fps=fps, **options) as writer:
        for frame in even:
            writer.append_data(frame)


def _imageio() -> Any:
    try:
        import imageio.v2

        importlib.import_module("imageio_ffmpeg")  # imageio's plug-in for MP4
    except ImportError as error:
        raise ConfigError(_NO_EXTRA) from error
    return imageio.v2


def _format_of(given: VideoFormat | None, output: Path | None) -> VideoFormat:
    """Return the format; raise while nothing is recorded yet if it cannot be written."""
    suffix = None if output is None else output.suffix.removeprefix(".")
    if suffix == "":
        raise ConfigError(
            f"{output} needs a suffix, .mp4 or .gif: it is the file of one task (--task all takes a folder)."
        )
    chosen: Any = given or suffix or "mp4"
    if chosen not in get_args(VideoFormat) or suffix not in (None, chosen):
        where = "" if output is None else f" for {output}"
        raise ConfigError(
            f"Videos are written as .mp4 or .gif, not as {suffix or chosen!r}{where}"
            f"{f' with format {given!r}' if given and suffix else ''}."
        )
    if chosen == "mp4":
        _imageio()
    format: VideoFormat = chosen
    return format


def _file_of(task: str, suffix: str, folder: Path, output: Path | None, is_folder: bool) -> Path:
    if output is None:
        return folder / "videos" / f"{task}.{suffix}"
    return output / f"{task}.{suffix}" if is_folder else output


def _task_index(task: str | int, names: Sequence[str]) -> int:
    """Return the index of a task by its name, long or short, or by its index."""
    if isinstance(task, int | np.integer) and not isinstance(task, bool) and 0 <= task < len(names):
        return int(task)
    for name in (task, f"{task}-v3"):
        if name in names:
            return list(names).index(str(name))
    short = [name.removesuffix("-v3") for name in names]
    hint = nearest(str(task).removesuffix("-v3"), short)
    raise ConfigError(f"There is no task {task!r} here; there are {', '.join(short)}.{hint}")


def _make_env(names: Sequence[str], n_episodes: int, size: int, camera: str) -> VecEnv:
    rendering: dict[str, Any] = {"render_mode": "rgb_array", "render_size": _check_size(size)}
    if set(names) <= set(TOY_TASKS):
        _check_toy_camera(camera)
        return make_toy_env(seed=0, tasks=list(names), **rendering)
    known = metaworld_task_names("MT50")
    if not set(names) <= set(known):
        raise ConfigError(
            f"The tasks {', '.join(names)} are not all the toy's or Meta-World's; give record an environment of them, "
            "made with render_mode='rgb_array'."
        )
    rendering["camera"] = camera
    return make_metaworld_env(list(names), seed=0, goals="ordered", n_workers=0, **rendering)


def _check_toy_camera(camera: str) -> None:
    if camera != DEFAULT_CAMERA:
        raise ConfigError(
            f"camera={camera!r} is for Meta-World; the toy tasks are drawn from one side only, so leave --camera out."
        )


def _check_size(size: int) -> int:
    check_count("size", size, minimum=64)
    if size % 2:
        raise ConfigError(f"size={size} must be even, for MP4 files hold colours in blocks of two pixels.")
    return size
