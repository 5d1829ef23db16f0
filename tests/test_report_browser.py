"""A report in a real browser: no errors, nothing wider than the screen, something to see; light, dark, phone, paper."""

import os
import re
import shutil
import subprocess

import matplotlib.image
import numpy as np
import pytest
from test_report import EXPECTED, write_cells

from sb3_ars.experiments.report import write_report

CHROME = os.environ.get("CHROME") or shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROME is None, reason="needs Chromium; install it, or name one in CHROME")

FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--force-device-scale-factor=1")
DARK, LIGHT = 0, 1
PROBE = """<script>
const shown = [...document.querySelectorAll("svg")].filter(svg => svg.getBoundingClientRect().width > 0);
const texts = shown.flatMap(svg => [...svg.querySelectorAll("text")]);
const small = texts.filter(text => text.getBoundingClientRect().height < 7);
parent.postMessage([
  innerWidth, document.documentElement.scrollWidth, matchMedia("(prefers-color-scheme: dark)").matches,
  shown.length, document.querySelectorAll("svg").length, small.length,
].join(" "), "*");
</script></body>"""


def browse(page, *flags):
    """Open a page; return what the browser wrote and what it complained of."""
    command = [CHROME, *FLAGS, f"--user-data-dir={page.parent / 'profile'}", *flags, page.as_uri()]
    done = subprocess.run(
        [*command, "--enable-logging=stderr", "--v=0"],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return done.stdout, [line for line in done.stderr.splitlines() if ":CONSOLE" in line]


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    # a table far wider than a phone, figures of every kind
    page = write_report([write_cells(folder / "cells")], folder / "report", ["table1"], expected=EXPECTED)
    probed = page.with_name("probed.html")
    probed.write_text(page.read_text().replace("</body>", PROBE))
    return page


def framed(report, width, height):
    """Return a page that shows the report in a frame: the browser's own window is never as narrow as a phone."""
    frame = report.with_name(f"frame-{width}.html")
    frame.write_text(
        "<body style='margin:0'><script>onmessage = event => document.title = event.data</script>"
        f"<iframe src='probed.html' style='border:0;width:{width}px;height:{height}px'></iframe></body>"
    )
    return frame


@pytest.mark.parametrize("scheme", [LIGHT, DARK], ids=["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280], ids=["phone", "desktop"])
def test_the_page_fits_the_screen_without_errors(report, width, scheme):
    flags = (f"--blink-settings=preferredColorScheme={scheme}", f"--window-size={width + 100},900")
    dom, complaints = browse(framed(report, width, 900), *flags, "--virtual-time-budget=3000", "--dump-dom")
    assert not complaints
    inner, scrolled, dark, shown, drawn, small = re.search(r"<title>(.*)</title>", dom)[1].split()
    assert int(inner) == width and int(scrolled) <= width
    assert dark == str(scheme == DARK).lower()
    assert int(shown) > 5 and 2 * int(shown) == int(drawn)  # of each figure the one that fits
    assert int(small) == 0


@pytest.mark.parametrize("scheme", [LIGHT, DARK], ids=["light", "dark"])
def test_the_page_is_drawn_in_its_scheme(report, scheme):
    picture = report.with_name(f"{scheme}.png")
    flags = (f"--blink-settings=preferredColorScheme={scheme}", "--window-size=1280,3000")
    _, complaints = browse(report, *flags, f"--screenshot={picture}")
    assert not complaints
    pixels = matplotlib.image.imread(picture)[..., :3]
    background = pixels[3, 3]
    assert (background > 0.9).all() if scheme == LIGHT else (background < 0.15).all()
    drawn = np.abs(pixels - background).max(axis=2) > 0.2
    assert 0.01 < drawn.mean() < 0.5
    # colours of curves, which text and rules do not have
    assert (pixels.max(axis=2) - pixels.min(axis=2) > 0.3).mean() > 0.001


def test_the_page_prints(report):
    paper = report.with_name("report.pdf")
    browse(report, f"--print-to-pdf={paper}", "--no-pdf-header-footer")
    content = paper.read_bytes()
    assert (
        content.startswith(b"%PDF") and content.count(b"/Type /Page\n") + content.count(b"/Type /Page ") > 2
    )
