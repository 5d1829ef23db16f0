"""Writes a report to its folder, whole or not at all; what stands in it is the other modules' business."""

from __future__ import annotations

import errno
import glob
import os
import platform
import re
import shutil
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import datetime
from importlib import resources
from itertools import count, groupby
from pathlib import Path
from typing import NamedTuple

import jinja2
import psutil
from markupsafe import Markup, escape

from sb3_ars.errors import ConfigError
from sb3_ars.experiments.report.blocks import Section
from sb3_ars.experiments.report.figures import COLORS
from sb3_ars.experiments.report.gather import Cell, gather
from sb3_ars.experiments.report.sections import all_numbers, sections
from sb3_ars.experiments.report.tables import Column, Table
from sb3_ars.experiments.sweeps import Sweep, load_sweep
from sb3_ars.versions import run_versions

__all__ = ["PAGE", "TABLES", "write_report"]

PAGE, TABLES = "index.html", "tables"
"""What a report's folder holds: the page, and its tables as CSV and Markdown."""

_GENERATOR = "sb3-ars report"
_DRAFT = ".draft-"


class _Group(NamedTuple):
    """Neighbouring columns under one heading."""

    name: str
    size: int


def write_report(
    folders: Sequence[Path],
    output: Path,
    sweeps: Sequence[str] = (),
    videos: bool = False,
    expected: Iterable[Cell] = (),
) -> Path:
    """Write a report of runs: one HTML page that needs nothing else, and its tables as CSV and Markdown.

    The page is written last, so a folder with an ``index.html`` holds a whole report. A report that is there already
    is replaced.

    :param folders: runs, or folders that hold runs
    :param output: the report's folder
    :param sweeps: tables and figures of the paper to show in their form, such as "table1"
    :param videos: whether to put the runs' videos into the page
    :param expected: cells that should be there, as ``(scale, preset, seed)``; those that are not are listed
    :return: the page
    :raises ConfigError: if there is no finished run, a sweep is unknown, or the output folder cannot be written or
        holds something else
    """
    chosen = [load_sweep(name) for name in dict.fromkeys(sweeps)]
    draft = _make_draft(output)
    try:
        try:
            found = gather(folders, expected)
            made = sections(found, chosen, videos)
        except OSError as error:
            raise ConfigError(f"The runs cannot be read: {error}") from error
        tables = [block for section in made for block in section.blocks if isinstance(block, Table)]
        _write_draft(draft, tables, all_numbers(found), _html(made, _title(chosen)))
        _swap(draft, output)
    except OSError as error:
        raise ConfigError(
            f"The report cannot be written to {output} ({error.strerror}); choose another --output."
        ) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        with suppress(OSError):  # not empty, or another report has just done so
            output.rmdir()
    return output / PAGE


def _write_draft(draft: Path, tables: Sequence[Table], numbers: Table, page: str) -> None:
    (draft / TABLES).mkdir()
    for table in tables:
        (draft / TABLES / f"{table.name}.csv").write_text(table.to_csv(), encoding="utf-8")
        (draft / TABLES / f"{table.name}.md").write_text(table.to_markdown(), encoding="utf-8")
    (draft / TABLES / f"{numbers.name}.csv").write_text(numbers.to_csv(), encoding="utf-8")
    (draft / PAGE).write_text(page, encoding="utf-8")


def _swap(draft: Path, output: Path) -> None:
    """Put a whole draft in the place of the report that is there; of two at a time, the later one stays."""
    (output / PAGE).unlink(missing_ok=True)
    for attempt in count():
        with suppress(FileNotFoundError):
            (output / TABLES).replace(draft / f"old-{attempt}")
        try:
            (draft / TABLES).replace(output / TABLES)
            break
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):  # another report's, put there just now
                raise
    (draft / PAGE).replace(output / PAGE)


def _make_draft(output: Path) -> Path:
    """Return a new folder inside the report's, before any work is done for it."""
    draft = output / f"{_DRAFT}{platform.node()}-{os.getpid()}"
    try:
        if output.is_dir() and any(output.iterdir()) and not _is_report(output):
            raise ConfigError(
                f"{output} holds something else than a report; choose another --output, new or empty."
            )
        _remove_dead_drafts(output)
        draft.mkdir(parents=True)
    except OSError as error:
        raise ConfigError(
            f"The report's folder {output} cannot be written ({error.strerror}); choose another --output."
        ) from error
    return draft


def _remove_dead_drafts(output: Path) -> None:
    """Remove what reports left here that were killed; those of another machine cannot be told from live ones."""
    for draft in output.glob(f"{_DRAFT}{glob.escape(platform.node())}-*"):
        pid = draft.name.rpartition("-")[2]
        if pid.isdigit() and (int(pid) == os.getpid() or not psutil.pid_exists(int(pid))):
            shutil.rmtree(draft, ignore_errors=True)


def _is_report(folder: Path) -> bool:
    """Return whether the folder holds a report, or what an interrupted one left."""
    page = folder / PAGE
    if page.is_file():
        with page.open(encoding="utf-8", errors="replace") as file:
            return f'content="{_GENERATOR}' in file.read(2000)
    return all(path.name == TABLES or path.name.startswith(_DRAFT) for path in folder.iterdir())


def _title(sweeps: Sequence[Sweep]) -> str:
    if not sweeps:
        return "Runs of multi-task reinforcement learning"
    return f"{', '.join(sweep.source for sweep in sweeps)} of the ARS paper: our runs"


def _html(made: Sequence[Section], title: str) -> str:
    files = resources.files("sb3_ars.experiments.report")
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: (files / name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    environment.filters |= {"groups": _groups, "kind": _kind, "breakable": _breakable}
    version = run_versions()["packages"]["sb3-ars"] or "development version"
    return environment.get_template("page.html.j2").render(
        title=title,
        subtitle=f"Written by sb3-ars report ({version}) on {datetime.now():%Y-%m-%d %H:%M}.",
        generator=f"{_GENERATOR} {version}",
        colors=COLORS,
        sections=made,
    )


def _breakable(text: str) -> Markup:
    """Return a name that a narrow screen may break behind dots, underscores and slashes."""
    return Markup(re.sub(r"([._/])", r"\1<wbr>", str(escape(text))))


def _kind(column: Column) -> Markup:
    """Return the attribute of a column's cells that the style sheet goes by."""
    return Markup(' class="paper"' if column.group else ' class="text"' if column.text else "")


def _groups(columns: Sequence[Column]) -> list[_Group]:
    return [_Group(name, len(list(same))) for name, same in groupby(column.group for column in columns)]
