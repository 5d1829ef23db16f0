"""Reads a command's arguments into its dataclass; a mistake is one line, as every error of the command is."""

from __future__ import annotations

import io
from contextlib import redirect_stderr
from typing import Any, TypeVar

import tyro

from sb3_ars.errors import ConfigError

__all__ = ["read_arguments"]

Arguments = TypeVar("Arguments")


def read_arguments(cls: type[Arguments], prog: str, arguments: list[str], **options: Any) -> Arguments:
    """Return the dataclass that the arguments ask for; ``--help`` prints and exits, as ever.

    :param cls: the dataclass
    :param prog: what the command is called
    :param arguments: behind its name
    :param options: tyro's, such as ``default`` and ``description``
    :raises ConfigError: in one line, for an unknown option or a value that cannot work
    """
    printed = io.StringIO()
    try:
        with redirect_stderr(printed):
            read: Arguments = tyro.cli(cls, prog=prog, args=arguments, **options)
            return read
    except SystemExit as exit_:
        if not exit_.code:
            raise
        raise ConfigError(_in_one_line(printed.getvalue())) from None


def _in_one_line(message: str) -> str:
    """Return tyro's message without its frame and title; its rules, drawn in ASCII where need be, end sentences."""
    lines = [line.strip(" │") for line in message.splitlines()]
    inside = [line for line in lines if not line.startswith(("╭", "╰"))]
    blocks = " ".join(line if line.strip("─-") else "\n" for line in inside if line).split("\n")
    if len(inside) == len(lines):  # no frame: the title is a block of its own
        blocks = blocks[1:]
    sentences = [" ".join(block.split()).rstrip(".:") for block in blocks]
    return ". ".join(sentence for sentence in sentences if sentence) + "."
