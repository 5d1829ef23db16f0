"""``sb3-ars doctor``: checks this machine and its packages."""

from __future__ import annotations

import dataclasses
import json
import sys
from typing import Any

from sb3_ars.errors import ConfigError

__all__ = ["main"]

_USAGE = """sb3-ars doctor [--json]

Checks packages, processors, threads, memory, shared memory, workers, GPU,
Meta-World, rendering and disk, and says what to do where something is wrong.
The exit status is 0 unless a check fails; warnings do not count.

  --json   print {"status": ..., "checks": [{"name": ..., "status": ...,
           "found": ..., "remedy": ...}, ...]} instead of a table"""

_STYLES = {"ok": "green", "warning": "bold yellow", "failure": "bold red"}


def main(arguments: list[str]) -> int:
    """Run the command; return its exit status.

    :param arguments: behind the command's name
    """
    if arguments[:1] in (["-h"], ["--help"]):
        print(_USAGE)
        return 0
    if arguments not in ([], ["--json"]):
        raise ConfigError(f"sb3-ars doctor takes --json or nothing, not {' '.join(arguments)!r}.")
    # Not above: whichever package is missing, this is the command that is asked about it.
    try:
        from rich.console import Console

        from sb3_ars.doctor import run_checks
    except ImportError as error:
        print(
            f"failure: {error}. pip install --upgrade sb3-ars, or pip install -e . in a source tree, brings what is "
            "missing.",
            file=sys.stderr,
        )
        return 1
    checks = run_checks()
    found = {check.status for check in checks}
    worst = next(status for status in ("failure", "warning", "ok") if status in found)
    if arguments:
        print(json.dumps({"status": worst, "checks": [dataclasses.asdict(c) for c in checks]}, indent=2))
    else:
        Console().print(_table(checks))
    return 1 if worst == "failure" else 0


def _table(checks: list[Any]) -> Any:
    from rich.table import Table
    from rich.text import Text

    table = Table("", "check", "found", box=None, pad_edge=False)
    for check in checks:
        # Text, because brackets, as in "[Errno 28]", are markup in a plain string
        found = Text(check.found)
        if check.remedy:
            found.append(f"\n-> {check.remedy}", style="bold")
        table.add_row(Text(check.status, style=_STYLES[check.status]), Text(check.name), found)
    return table
