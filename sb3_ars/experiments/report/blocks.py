"""What a section of a report is made of, beside tables and figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeAlias

from sb3_ars.experiments.report.figures import Drawing
from sb3_ars.experiments.report.tables import Table

__all__ = ["Block", "Film", "Films", "Listing", "Section"]


@dataclass(frozen=True)
class Listing:
    """A list of sentences under a heading; ``warning`` sets it apart."""

    kind: ClassVar[str] = "listing"
    title: str
    items: tuple[str, ...]
    warning: bool = False


@dataclass(frozen=True)
class Film:
    """A small video in the page: what it shows, its media type, base64 data."""

    label: str
    type: str
    data: str


@dataclass(frozen=True)
class Films:
    """Videos side by side."""

    kind: ClassVar[str] = "films"
    films: tuple[Film, ...]


Block: TypeAlias = str | Table | Drawing | Listing | Films


@dataclass(frozen=True)
class Section:
    """A part of the page.

    :param name: its anchor, behind ``section-``
    :param title: in the contents too
    :param blocks: from top to bottom
    """

    name: str
    title: str
    blocks: tuple[Block, ...]
