"""Where a study is kept: a journal file or a database, checked before anything is trained."""

from __future__ import annotations

import json
import time
import warnings
from pathlib import Path
from typing import Any

from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from sqlalchemy import create_engine
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError
from sqlalchemy.pool import NullPool

from sb3_ars.errors import ConfigError

__all__ = ["describe_storage", "open_storage"]

_CONNECT_TIMEOUT = 5  # seconds
_ATTEMPTS = 3  # two processes that make the tables of an empty database at once get into each other's way


def open_storage(storage: str | Path) -> BaseStorage:
    """Return the storage of a study.

    :param storage: path of a journal file, or URL of a database such as ``postgresql+psycopg://user@host/name``
    :raises ConfigError: if it cannot be reached or written, or its driver is missing
    """
    if "://" in str(storage):
        return _database(_url(str(storage)))
    path = Path(storage)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab"):
            pass
        # a lock by opening works on every system; Optuna's default, a symbolic link, needs rights on Windows
        lock = JournalFileOpenLock(str(path))
        _check_journal(path, lock)
        return JournalStorage(JournalFileBackend(str(path), lock))
    except OSError as error:
        raise ConfigError(
            f"The study's journal {path} cannot be written ({error.strerror}); choose another --storage or --output."
        ) from error
    except (ValueError, KeyError) as error:
        raise ConfigError(
            f"{path} is no journal of Optuna's, or a damaged one ({error}); give another --storage, or mend the file."
        ) from error


def describe_storage(storage: str | Path) -> str:
    """Return the storage without its password, for messages.

    :param storage: path or URL
    """
    return _url(str(storage)).render_as_string(hide_password=True) if "://" in str(storage) else str(storage)


def _check_journal(path: Path, lock: JournalFileOpenLock) -> None:
    """Raise ``ValueError`` if a line is none of a journal's; Optuna itself would look past a bad last one at first."""
    lock.acquire()  # else the last line may be one that another process is writing
    try:
        content = path.read_bytes()
    finally:
        lock.release()
    for number, line in enumerate(content.splitlines(keepends=True), start=1):
        try:
            whole = line.endswith(b"\n") and isinstance(json.loads(line.decode()), dict)
        except ValueError:
            whole = False
        if not whole:
            raise ValueError(f"line {number}")


def _url(storage: str) -> URL:
    try:
        return make_url(storage)
    except (ArgumentError, ValueError):
        # not shown: what cannot be parsed may hold a password anywhere
        raise ConfigError(
            "--storage is no valid URL of a database; give a path, or one such as "
            "postgresql+psycopg://user:password@host:5432/name."
        ) from None


def _database(url: URL) -> BaseStorage:
    shown = url.render_as_string(hide_password=True)
    sqlite = url.get_backend_name() == "sqlite"
    if sqlite:
        warnings.warn(
            f"{shown}: SQLite is not made for several processes; use the journal file (the default) or PostgreSQL.",
            stacklevel=4,
        )
    # no pool: a trial asks the storage a few times in hours, and nothing is left open behind it
    options: dict[str, Any] = {"poolclass": NullPool}
    if not sqlite:
        options["connect_args"] = {"connect_timeout": _CONNECT_TIMEOUT}
    try:
        create_engine(url, **options).connect().close()  # once: the attempts below are for another fault
        return _with_tables(url, options)
    except ImportError as error:
        raise ConfigError(_missing_driver(url, shown)) from error
    except (SQLAlchemyError, RuntimeError) as error:  # the latter: tables of another version of Optuna
        raise _unreachable(url, shown, error) from None  # its text and frames may hold the password


def _with_tables(url: URL, options: dict[str, Any]) -> RDBStorage:
    for attempt in range(1, _ATTEMPTS):
        try:
            return RDBStorage(url.render_as_string(hide_password=False), engine_kwargs=options)
        except DBAPIError:
            time.sleep(0.2 * attempt)
    return RDBStorage(url.render_as_string(hide_password=False), engine_kwargs=options)


def _missing_driver(url: URL, shown: str) -> str:
    if url.drivername.startswith("postgresql"):
        driver = (
            "" if url.drivername == "postgresql+psycopg" else ", and write postgresql+psycopg:// in the URL"
        )
        return f'{shown} needs PostgreSQL\'s driver: pip install "sb3-ars[postgres]"{driver}.'
    return (
        f"{shown} needs a driver that is not installed: the one that SQLAlchemy names for {url.drivername}."
    )


def _unreachable(url: URL, shown: str, error: Exception) -> ConfigError:
    cause = str(getattr(error, "orig", None) or error).strip().splitlines()[0]
    if url.password:
        cause = cause.replace(str(url.password), "***")
    return ConfigError(f"The storage {shown} cannot be reached: {cause}")
