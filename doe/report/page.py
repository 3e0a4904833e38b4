"""One self-contained HTML page from sections of text, tables and pictures (jinja2; pictures as inline SVG)."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from identification.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def check_picture(path: Path) -> None:
    """Raises `InputError` for the name of a picture file whose ending is no format."""
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError(f"{path}: ending {path.suffix!r}, allowed: .png, .svg, .pdf")


@dataclass(frozen=True)
class Sheet:
    """A table of a page: headings and rows of ready text."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Section:
    """A part of a page: what it says in one paragraph, then its tables and pictures."""

    title: str
    lead: str
    sheets: Sequence[Sheet] = ()
    figures: Sequence[Figure] = ()


def page(title: str, verdict: str, sections: Sequence[Section]) -> str:
    """The page as text; it needs no other file and no network."""
    from jinja2 import Environment, PackageLoader

    environment = Environment(loader=PackageLoader("doe.report", "."), autoescape=True, trim_blocks=True)
    drawn = [
        {"title": s.title, "lead": s.lead, "sheets": s.sheets, "pictures": [svg(f) for f in s.figures]}
        for s in sections
    ]
    return environment.get_template("page.html.j2").render(title=title, verdict=verdict, sections=drawn)


def svg(figure: Figure) -> str:
    """The figure as an SVG element that scales with the page; equal figures give equal text."""
    import matplotlib  # deferred: tables need no pictures

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "armcal", "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    element = text[text.index("<svg") :]
    return re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", re.sub(r'width="[^"]*pt"', 'width="100%"', element, count=1))
