"""How Sphinx builds the site from these pages, the docstrings and the repository's own documents."""

import os
import re
from pathlib import Path

import sb3_ars

ROOT = Path(__file__).parents[1]
HOME = {  # documents of the repository that a page of the site includes
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "benchmarks/README.md": "benchmarks.md",
}

project = "sb3_ars"
release = sb3_ars.__version__
author = "the sb3_ars authors"
copyright = "the sb3_ars authors, MIT licence"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = f"sb3_ars {release}"
html_show_sphinx = False

default_role = (
    "py:obj"  # docstrings write `name` for a name, which becomes a link where this site documents it
)
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the text says what a parameter is; the source, one click away, has the types
autodoc_default_options = {"show-inheritance": True}
toc_object_entries_show_parents = "hide"
html_copy_source = False


def link_within_the_site(text: str, document: Path, page: Path) -> str:
    """Return the Markdown with relative links that hold on the site.

    The documents are read in the repository first, where a link may lead to any file. On the site a link to a document
    that a page includes leads to that page, and a link to any other file outside is left as its text.

    :param text: of the document
    :param document: where it stands in the repository
    :param page: the page that shows it
    """

    def replaced(match: re.Match[str]) -> str:
        label, path, anchor = match[1], match[2], match[3] or ""
        target = Path(os.path.normpath(document.parent / path))
        if not target.exists():
            return match[0]
        target = ROOT / "docs" / HOME.get(target.relative_to(ROOT).as_posix(), target)
        if target.is_relative_to(ROOT / "docs") and target.is_file():
            return f"[{label}]({os.path.relpath(target, page.parent)}{anchor})"
        return label

    return re.sub(r"(?<!!)\[([^\]]*)\]\(([\w./-]+)(#[\w-]+)?\)", replaced, text)


def on_source_read(app, docname, source):
    """Make the links of a page hold."""
    page = Path(app.env.doc2path(docname))
    source[0] = link_within_the_site(source[0], page, page)


def on_include_read(app, relative_path, parent_docname, content):
    """Make the links of a document that a page includes hold."""
    page = Path(app.env.doc2path(parent_docname))
    content[0] = link_within_the_site(content[0], (ROOT / "docs" / relative_path).resolve(), page)


def setup(app):
    """Have Sphinx call the two."""
    app.connect("source-read", on_source_read)
    app.connect("include-read", on_include_read)
