"""``sb3-ars doctor``: checks this machine and its packages."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from sb3_ars.doctor import run_checks

__all__ = ["main"]


def main(arguments: list[str]) -> int:
    """Run the command; return its exit status.

    :param arguments: behind the command's name
    """
    if arguments:
        print(
            "sb3-ars doctor takes no options; it checks versions, processors, GPU, rendering and Meta-World."
        )
        return 0 if arguments[0] in ("-h", "--help") else 2
    checks = run_checks()
    table = Table("", "check", "found", box=None)
    for check in checks:
        table.add_row("ok" if check.ok else "[bold red]!![/]", check.name, check.found)
    Console().print(table)
    return 0 if all(check.ok for check in checks) else 1
