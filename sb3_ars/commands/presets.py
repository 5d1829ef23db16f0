"""``sb3-ars list``: the presets, with what the paper reports of them."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.table import Table

from sb3_ars.errors import ConfigError
from sb3_ars.experiments import find_presets, preset_group, preset_info

__all__ = ["main"]


def main(arguments: list[str]) -> int:
    """Run the command; return its exit status.

    :param arguments: behind the command's name
    """
    if arguments[:1] in (["-h"], ["--help"]):
        print("sb3-ars list [WORD ...] shows the presets, or those with every word in their names.")
        return 0
    options = [argument for argument in arguments if argument.startswith("-")]
    if options:
        raise ConfigError(f"sb3-ars list takes words, not {options[0]!r}, such as 'sb3-ars list mt50 moore'.")
    table = Table(box=None, padding=(0, 1, 0, 0))
    table.add_column("preset", no_wrap=True)
    table.add_column("what it is")
    table.add_column("steps", justify="right")
    table.add_column("table", no_wrap=True)
    table.add_column("success", no_wrap=True)
    names = find_presets(arguments)
    for name, before in zip(names, [None, *names], strict=False):
        if before is not None and preset_group(before) != preset_group(name):
            table.add_row()
        info = preset_info(name)
        table.add_row(name, info.description, _short(info.total_timesteps), info.table, info.success)
    # in a pipe there is nothing to wrap lines for, and one line per preset can be searched
    Console(highlight=False, width=None if sys.stdout.isatty() else 120).print(table)
    print(
        "\nsteps: of the environments, all tasks together; table and success: the paper's, in %, over 8 seeds."
    )
    return 0


def _short(steps: int) -> str:
    return f"{steps // 10**6}M" if steps >= 10**6 else f"{steps // 1000}k"
