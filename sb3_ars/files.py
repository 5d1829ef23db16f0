"""Files that are whole or not there at all; knows nothing of what they hold."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

__all__ = ["write_whole"]


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file or folder whole or not at all: a reader never meets half of it, and a failure leaves nothing.

    :param path: to write; what is there already is replaced
    :param write: writes it under the path it is given, a hidden one beside it with the same suffix
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        write(temporary)
        if temporary.is_file():
            with temporary.open("rb") as file:
                os.fsync(file.fileno())  # else a power cut could leave the name with nothing behind it
        temporary.replace(path)
    except BaseException:  # an interrupt too
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)
        raise
