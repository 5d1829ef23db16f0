"""Figures of a report as inline SVG whose colours and fonts are the page's; draws them with the package's plots."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import ClassVar

import matplotlib
from matplotlib.figure import Figure

from sb3_ars.experiments.plots import GRID, INK, MUTED, PALETTE

__all__ = ["COLORS", "NARROW", "WIDE", "Drawing", "draw", "to_svg"]

WIDE, NARROW = 9.0, 4.2
"""Widths of a figure on a screen or paper and on a phone, in inches."""

_DARK_SERIES = (
    "#5fb0f2", "#ff9857", "#45c79d", "#ea8bc8", "#d6b04a", "#4fcbe0", "#ff8087", "#b7a0f0", "#a9cc5f", "#cda287",
)  # fmt: skip

COLORS = (
    ("ink", INK, "#e6eaee"),
    ("muted", MUTED, "#9ca7b3"),
    ("grid", GRID, "#363e47"),
    *(
        (f"series-{index}", light, dark)
        for index, (light, dark) in enumerate(zip(PALETTE, _DARK_SERIES, strict=True))
    ),
)
"""The page's colours: name of the variable, value on a light page (which is the plots' own), value on a dark one."""

_VARIABLES = {light: name for name, light, _ in COLORS}


@dataclass(frozen=True)
class Drawing:
    """A figure on the page, in two widths of which one is shown.

    :param name: unique in the report
    :param title: what it shows
    :param caption: how to read it
    :param wide: SVG for a screen or paper
    :param narrow: SVG for a phone
    """

    kind: ClassVar[str] = "drawing"
    name: str
    title: str
    caption: str
    wide: str
    narrow: str


def draw(name: str, title: str, caption: str, plot: Callable[[float], Figure]) -> Drawing:
    """Return a figure drawn in both widths.

    :param name: unique in the report
    :param title: what it shows
    :param caption: how to read it
    :param plot: returns the figure for a width in inches
    """
    wide, narrow = (
        to_svg(plot(width), f"{name}-{suffix}", title)
        for width, suffix in ((WIDE, "wide"), (NARROW, "narrow"))
    )
    return Drawing(name, title, caption, wide, narrow)


def to_svg(figure: Figure, name: str, label: str) -> str:
    """Return a figure as an ``<svg>`` element for an HTML page: no declarations, metadata, fonts or colours of its own.

    :param figure: to convert
    :param name: of the element, which its ids start with so that they are unique in the page
    :param label: what a screen reader says
    """
    file = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    text = file.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)
    view_box = re.search(r'viewBox="([^"]*)"', text)
    assert view_box is not None, "matplotlib writes a viewBox"
    text = re.sub(
        r"<svg[^>]*>", f'<svg viewBox="{view_box[1]}" role="img" aria-label="{escape(label)}">', text, count=1
    )
    text = re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL)  # would be the whole page's
    text = _own_ids(text.replace("xlink:href", "href"), name)
    text = re.sub(r"font-family: [^;\"]*; ?", "", text)
    text = re.sub(r"#[0-9a-f]{6}\b", _variable, text)
    text = re.sub(r"(\d\.\d{2})\d+", r"\1", text)  # a hundredth of a point is not to be seen
    return re.sub(r"\s*\n\s*", "\n", text).strip()


def _own_ids(text: str, name: str) -> str:
    """Give the ids that something refers to the figure's name, and drop the others, which repeat in every figure."""
    used = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', text))
    text = re.sub(r' id="([^"]+)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in used else "", text)
    return re.sub(r'(url\(#|href="#)([^)"]+)', rf"\g<1>{name}-\g<2>", text)


def _variable(color: re.Match[str]) -> str:
    name = _VARIABLES.get(color[0])
    return f"var(--{name})" if name else color[0]
