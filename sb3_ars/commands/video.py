"""``sb3-ars video``: what a run's policy does on a task, as MP4 or GIF."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sb3_ars.commands.arguments import read_arguments

if TYPE_CHECKING:
    from sb3_ars.video import Recording

__all__ = ["main"]

_DESCRIPTION = """Record what a finished run's policy does on a task, as an MP4 or GIF file. The episodes are the
first ones of an evaluation with the same seed."""


@dataclass(frozen=True)
class _VideoArguments:
    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a finished run."""
    task: str
    """Task to record, such as push; all records every task of the run, a file each."""
    format: Literal["mp4", "gif"] | None = None
    """None is the suffix of --output, or mp4."""
    episodes: int = 1
    """Episodes, one behind the other; the first is the first of an evaluation."""
    output: Path | None = None
    """File to write, with --task all a folder; None is videos/TASK.FORMAT in the run's folder."""
    size: int = 320
    """Width and height in pixels."""
    fps: int = 30
    """At most so many frames per second of simulated time; fewer make a smaller file, not a faster video."""
    sampled: bool = False
    """Sample actions instead of taking the mean ones."""
    seed: int = 0
    """Seed of sampled actions and of the environment."""
    camera: str = "front"
    """Meta-World: front, corner, corner2, corner3, corner4, topview, behindGripper or gripperPOV."""


def main(arguments: list[str]) -> int:
    """Run the command; return its exit status.

    :param arguments: behind the command's name
    """
    options = read_arguments(_VideoArguments, "sb3-ars video", arguments, description=_DESCRIPTION)
    # after the options are read: it loads torch
    from sb3_ars.video import record_run

    record_run(
        options.run,
        options.task,
        options.format,
        options.output,
        options.episodes,
        not options.sampled,
        options.seed,
        options.size,
        options.camera,
        options.fps,
        after_task=_print,
    )
    return 0


def _print(file: Path, recording: Recording) -> None:
    seconds = len(recording.frames) / recording.fps
    reported = [success > 0 for success in recording.successes if success == success]
    success = f", success in {sum(reported)} of {len(reported)}" if reported else ""
    print(f"{file}: {recording.task}, {_episodes(len(recording.successes))}, {seconds:.1f} s{success}")


def _episodes(count: int) -> str:
    return f"{count} episode{'s' if count > 1 else ''}"
