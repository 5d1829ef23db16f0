"""The log files of a run: made anew, or gone on with where a checkpoint left them; knows not what is logged."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
    configure,
)
from torch.utils.tensorboard.writer import SummaryWriter

from sb3_ars.files import write_whole

__all__ = ["PROGRESS", "continued_logger", "new_logger"]

PROGRESS = "progress.csv"


def new_logger(folder: Path, to_screen: bool) -> Logger:
    """Return a logger that writes CSV and TensorBoard files.

    :param folder: for the files
    :param to_screen: whether it prints SB3's table too
    """
    return configure(str(folder), ["csv", "tensorboard", *(["stdout"] if to_screen else [])])


def continued_logger(folder: Path, to_screen: bool, progress: Path, step: int) -> Logger:
    """Return a logger that goes on with a run's files: rows behind the checkpoint's are dropped.

    :param folder: of the files
    :param to_screen: whether it prints SB3's table too
    :param progress: the CSV file as it was at the checkpoint; need not exist, if no row was written before
    :param step: environment steps at the checkpoint
    """
    formats: list[KVWriter] = [CSVOutputFormat(str(folder / PROGRESS))] if not progress.is_file() else []
    if progress.is_file():
        write_whole(folder / PROGRESS, lambda path: shutil.copyfile(progress, path))
        formats.append(_ContinuedCSV(folder / PROGRESS))
    formats.append(_ContinuedTensorBoard(folder, step))
    if to_screen:
        formats.append(HumanOutputFormat(sys.stdout))
    return Logger(str(folder), formats)


class _ContinuedCSV(CSVOutputFormat):
    """SB3's, appending: SB3 2.9.2 (logger.py) empties the file it is given."""

    def __init__(self, path: Path) -> None:
        self.file = path.open("r+", encoding="utf-8")
        self.keys = self.file.readline().rstrip("\n").split(",")
        self.file.seek(0, 2)
        self.separator, self.quotechar = ",", '"'


class _ContinuedTensorBoard(TensorBoardOutputFormat):
    """SB3's, with what an earlier process wrote behind the checkpoint hidden."""

    def __init__(self, folder: Path, step: int) -> None:
        self.writer = SummaryWriter(log_dir=str(folder), purge_step=step)
        self._is_closed = False
