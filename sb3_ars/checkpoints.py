"""What a checkpoint is on disk: written whole or not at all, checked, found again; knows nothing of models.

A folder of checkpoints holds one folder for each, and the rows of the replay buffer, which they share::

    checkpoints/
        step-000000120000/
            manifest.json        format, step, notes, and bytes and SHA-256 of every file it needs
            state.pt             tensors and plain values; torch.load(weights_only=True) reads it
        rows/
            3f9a0c-….bin         rows that came since the checkpoint before
        .lock                    held by the process that writes

What is under a final name is whole: files are written under another name, flushed to the disk, then renamed.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO

from sb3_ars.errors import CheckpointError

__all__ = [
    "Checkpoint",
    "CheckpointFolder",
    "FileRecord",
    "HashingFile",
    "checkpoint_folders",
    "latest_checkpoint",
    "lock",
]

FORMAT = 1
"""Version of the layout; a change that an older reader would misread raises it."""

MANIFEST = "manifest.json"
ROWS = "rows"
_TEMPORARY = ".writing"
_CHUNK_BYTES = 2**22


@dataclass(frozen=True)
class FileRecord:
    """What a file must be.

    :param path: relative to the folder of checkpoints
    :param bytes: its size
    :param sha256: of its content, hexadecimal
    """

    path: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint on disk, its manifest read.

    :param folder: of its own
    :param step: environment steps at which it was taken
    :param number: how many were written into the folder before it; a run that went back to an earlier step counts on
    :param files: every file it needs, the shared rows among them
    :param notes: plain values its writer left
    """

    folder: Path
    step: int
    number: int
    files: list[FileRecord]
    notes: dict[str, Any]

    @property
    def root(self) -> Path:
        """The folder of checkpoints it lies in."""
        return self.folder.parent

    def verify(self) -> None:
        """Raise unless every file is there, whole and unchanged.

        :raises CheckpointError: naming the file and what is wrong with it
        """
        for record in self.files:
            path = self.root / record.path
            try:
                size = path.stat().st_size
                if size != record.bytes:
                    raise CheckpointError(f"{path} has {size:,} bytes instead of {record.bytes:,}")
                with path.open("rb") as file:
                    digest = hashlib.sha256()
                    while chunk := file.read(_CHUNK_BYTES):
                        digest.update(chunk)
            except OSError as error:
                raise CheckpointError(f"{path} cannot be read ({error.strerror})") from error
            if digest.hexdigest() != record.sha256:
                raise CheckpointError(f"{path} is damaged: its checksum differs")


class HashingFile:
    """A file open for writing that keeps count and checksum of what passes through.

    :param file: open for writing bytes
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.error: OSError | None = None
        """What the disk said, whatever the writer makes of it."""
        self.bytes = 0
        self.digest = hashlib.sha256()

    def write(self, data: Any) -> int:
        """Write bytes, or anything that holds some."""
        view = memoryview(data).cast("B")
        try:
            self._file.write(view)
        except OSError as error:
            self.error = error
            raise
        self.digest.update(view)
        self.bytes += len(view)
        return len(view)

    def flush(self) -> None:
        """Flush the file."""
        self._file.flush()


class CheckpointFolder:
    """Writes checkpoints into a folder, and removes the oldest.

    :param root: the folder; made when the first is written
    :param keep: newest checkpoints that stay
    """

    def __init__(self, root: Path, keep: int = 2) -> None:
        self.root, self.keep = root.resolve(), keep  # the process may change its folder
        self.last: Path | None = None
        """The newest checkpoint that was written here."""

    @contextlib.contextmanager
    def write(
        self, step: int, shared: list[FileRecord], notes: Mapping[str, Any]
    ) -> Iterator[Callable[[str], Any]]:
        """Write a checkpoint: inside the context, a function opens its files; at the end it gets its name, ``last``.

        An exception leaves nothing behind, and the checkpoints there were stay.

        :param step: environment steps
        :param shared: files outside its own folder that it needs, on the disk already
        :param notes: plain values
        :raises OSError: if the disk is full or cannot be written
        """
        number = max((checkpoint.number + 1 for checkpoint in checkpoints_in(self.root)), default=0)
        final = self.root / f"step-{step:012d}"
        if final.exists():  # the same step again, of a run that went back
            final = final.with_name(f"{final.name}-{number}")
        temporary = final.with_name(final.name + _TEMPORARY)
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        records = list(shared)

        @contextlib.contextmanager
        def opened(name: str) -> Iterator[HashingFile]:
            with (temporary / name).open("wb") as file:
                hashing = HashingFile(file)
                try:
                    yield hashing
                except RuntimeError as error:  # torch.save's word for whatever happened while it wrote
                    raise hashing.error or error from error
                file.flush()
                os.fsync(file.fileno())
            path = (final / name).relative_to(self.root).as_posix()
            records.append(FileRecord(path, hashing.bytes, hashing.digest.hexdigest()))

        try:
            yield opened
            manifest = {
                "format": FORMAT,
                "step": step,
                "number": number,
                "files": [asdict(record) for record in records],
                "notes": dict(notes),
            }
            with (temporary / MANIFEST).open("w", encoding="utf-8") as file:
                json.dump(manifest, file, indent=1)
                file.flush()
                os.fsync(file.fileno())
            sync_folder(temporary)
            temporary.rename(final)
            sync_folder(self.root)
            self.last = final
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise

    @contextlib.contextmanager
    def write_shared(self, name: str) -> Iterator[tuple[HashingFile, list[FileRecord]]]:
        """Write a file that several checkpoints share; its record is in the list once the context has ended.

        :param name: of the file, under ``rows/``
        :raises OSError: if the disk is full or cannot be written
        """
        folder = self.root / ROWS
        folder.mkdir(parents=True, exist_ok=True)
        temporary = folder / (name + _TEMPORARY)
        record: list[FileRecord] = []
        try:
            with temporary.open("wb") as file:
                hashing = HashingFile(file)
                yield hashing, record
                file.flush()
                os.fsync(file.fileno())
            if (folder / name).exists():
                raise FileExistsError(
                    errno.EEXIST, "what another checkpoint needs lies there", str(folder / name)
                )
            temporary.rename(folder / name)
            sync_folder(folder)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        record.append(FileRecord(f"{ROWS}/{name}", hashing.bytes, hashing.digest.hexdigest()))

    def holds(self, record: FileRecord) -> bool:
        """Return whether a file that was written is still there in its size; its content is not looked at.

        :param record: of the file
        """
        path = self.root / record.path
        return path.is_file() and path.stat().st_size == record.bytes

    def remove(self, record: FileRecord) -> None:
        """Remove a shared file that no checkpoint came to need.

        :param record: of the file
        """
        (self.root / record.path).unlink(missing_ok=True)

    def prune(self) -> None:
        """Remove all but the newest checkpoints, and what nothing needs any more, half-written files included."""
        kept = checkpoints_in(self.root)[: self.keep]
        needed = {record.path for checkpoint in kept for record in checkpoint.files}
        for path in self.root.glob("step-*"):  # those that were never finished too
            if path not in [checkpoint.folder for checkpoint in kept]:
                shutil.rmtree(path, ignore_errors=True)
        for path in (self.root / ROWS).glob("*"):
            if f"{ROWS}/{path.name}" not in needed:
                path.unlink(missing_ok=True)


def checkpoint_folders(root: Path) -> list[Path]:
    """Return the folders that bear the name of a checkpoint, and so were written whole, in no order.

    :param root: folder of checkpoints; need not exist
    """
    return [folder for folder in root.glob("step-*") if folder.suffix != _TEMPORARY]


def lock(root: Path) -> IO[str]:
    """Let no other process write checkpoints into a folder until the file that is returned is closed, or this one ends.

    :param root: folder of checkpoints; made if need be
    :raises CheckpointError: if another process writes there, or nobody can
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        file = (root / ".lock").open("a", encoding="utf-8")
    except OSError as error:
        raise CheckpointError(
            f"Nothing can be written to the folder of checkpoints {root} ({error.strerror}); choose another."
        ) from error
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # of the process: taking it twice is no conflict
    except OSError as error:
        file.close()
        if error.errno not in (errno.EACCES, errno.EAGAIN):  # a file system without locks
            return (root / ".lock").open("a", encoding="utf-8")
        raise CheckpointError(
            f"Another process is training the run whose checkpoints are in {root}; wait for it, or end it first."
        ) from error
    return file


def checkpoints_in(root: Path) -> list[Checkpoint]:
    """Return the checkpoints whose manifest can be read, newest first.

    :param root: folder of checkpoints
    """
    found = []
    for folder in checkpoint_folders(root):
        with contextlib.suppress(CheckpointError):
            found.append(read_manifest(folder))
    return sorted(found, key=lambda checkpoint: checkpoint.number, reverse=True)


def read_manifest(folder: Path) -> Checkpoint:
    """Return the checkpoint in a folder; its files are not looked at.

    :param folder: of one checkpoint
    :raises CheckpointError: if there is no manifest that this version reads
    """
    path = folder / MANIFEST
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if values["format"] != FORMAT:
            raise CheckpointError(
                f"{path} has format {values['format']!r}, this version of sb3_ars reads format {FORMAT}; resume with "
                "the version that wrote it"
            )
        records = [_checked(FileRecord(**record)) for record in values["files"]]
        step, number, notes = values["step"], values["number"], values["notes"]
        if type(step) is not int or type(number) is not int or not isinstance(notes, dict):
            raise ValueError("step, number or notes are of the wrong kind")
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read ({error.strerror})") from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise CheckpointError(f"{path} is damaged ({type(error).__name__}: {error})") from error
    return Checkpoint(folder, step, number, records, notes)


def _checked(record: FileRecord) -> FileRecord:
    parts = Path(record.path).parts
    if Path(record.path).is_absolute() or ".." in parts:
        raise ValueError(f"it names a file outside the folder, {record.path!r}")
    if type(record.bytes) is not int or not isinstance(record.sha256, str):
        raise ValueError(f"it says nothing sensible of {record.path!r}")
    return record


def latest_checkpoint(path: Path) -> Checkpoint:
    """Return the newest checkpoint that is whole; a damaged one is named in a warning, and the one before it taken.

    :param path: folder of checkpoints, of a run that has one, or of a single checkpoint
    :raises CheckpointError: if there is none, or none is whole
    """
    path = path.resolve()
    if (path / MANIFEST).exists():
        folders = [path]
    else:
        folders = checkpoint_folders(path) or checkpoint_folders(path / "checkpoints")
    if not folders:
        raise CheckpointError(
            f"{path} holds no checkpoint. Give the folder of a run that wrote some, its checkpoints/, or one of them."
        )
    found, problems = [], []
    for folder in folders:
        try:
            found.append(read_manifest(folder))
        except CheckpointError as error:
            problems.append(str(error))
    for checkpoint in sorted(found, key=lambda checkpoint: checkpoint.number, reverse=True):
        try:
            checkpoint.verify()
        except CheckpointError as error:
            problems.append(str(error))
            continue
        if problems:
            warnings.warn(
                f"{'; '.join(problems)}. The checkpoint of step {checkpoint.step:,} is used instead.",
                stacklevel=2,
            )
        return checkpoint
    raise CheckpointError(f"No checkpoint in {path} is whole: {'; '.join(problems)}. Train again.")


def sync_folder(folder: Path) -> None:
    """Flush a folder's list of names to the disk.

    :param folder: whose files were renamed
    """
    if not hasattr(os, "O_DIRECTORY"):  # Windows has no such thing
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
