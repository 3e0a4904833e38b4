"""One self-contained HTML page: verdict, what to do next, sections of text, tables and pictures (jinja2, inline SVG).

Everything that a user wrote is escaped by jinja2; the one script is known to the browser by its hash, so that no other
could run; the page asks for nothing on the network.
"""

from __future__ import annotations

import base64
import hashlib
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from identification.errors import InputError
from identification.html_tables import html_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NO_METADATA = ("Date", "Creator", "Format", "Type")
NARROW = 430.0  # [pt] width of a figure that a phone shows as it is; columns of wider ones stand below each other
# colours of figures -> those of the page, light or dark
COLORS = {"#000000": "var(--ink)", "#ffffff": "none", "#c44e52": "var(--before)", "#2a6f97": "var(--after)"}


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
    """A part of a page: what it says, then its tables and pictures.

    lead : a paragraph, or several
    steps : a plan to be stepped through (`doe.report.plan_steps`);  folded : closed until a reader opens it
    """

    title: str
    lead: str | Sequence[str]
    sheets: Sequence[Sheet] = ()
    figures: Sequence[Figure] = ()
    steps: Mapping[str, Any] | None = None
    folded: bool = False


@dataclass(frozen=True)
class Action:
    """What to do next, in words, and the command for it where there is one."""

    text: str
    command: str = ""


def page(
    title: str,
    verdict: str | Sequence[str],
    sections: Sequence[Section],
    actions: Sequence[Action] = (),
    warnings: Sequence[str] = (),
) -> str:
    """The page as text; it needs no other file and no network.

    verdict : sentences, the first of them in bold
    """
    from jinja2 import Environment, PackageLoader

    environment = Environment(loader=PackageLoader("doe.report", "."), autoescape=True, trim_blocks=True)
    drawn = [vars(s) | {"lead": paragraphs(s.lead), "pictures": [page_picture(f) for f in s.figures]} for s in sections]
    style, script = (files("doe.report").joinpath(name).read_text("utf-8") for name in ("page.css", "page.js"))
    return environment.get_template("page.html.j2").render(
        html_table=html_table,
        title=title,
        verdict=paragraphs(verdict),
        sections=drawn,
        actions=actions,
        warnings=warnings,
        style=style,
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )


def paragraphs(text: str | Sequence[str]) -> list[str]:
    """One paragraph or several, without empty ones."""
    return [one for one in ([text] if isinstance(text, str) else text) if one]


def page_picture(figure: Figure) -> dict[str, Any]:
    """A figure as the page has it: SVG in the page's colours, its size, whether it is too wide for a phone, and of one
    that is the strips (left end, width) that stand below each other there."""
    text = re.sub("|".join(COLORS), lambda found: COLORS[found[0]], svg(figure))
    width, height = 72.0 * figure.get_figwidth(), 72.0 * figure.get_figheight()
    wide = width > NARROW
    return {"svg": text, "width": width, "height": height, "wide": wide, "strips": strips(figure) if wide else []}


def strips(figure: Figure) -> list[tuple[float, float]]:
    """Left end and width [pt] of each column of pictures of a figure that has been drawn; none where one of them is as
    wide as before."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    scale, renderer = 72.0 / figure.dpi, FigureCanvasAgg(figure).get_renderer()
    boxes = (axis.get_tightbbox(renderer) for axis in figure.axes if axis.get_visible())
    columns: list[list[float]] = []
    for low, high in sorted((box.x0 * scale, box.x1 * scale) for box in boxes if box is not None):
        if columns and low < columns[-1][1]:
            columns[-1][1] = max(columns[-1][1], high)
        else:
            columns.append([low, high])
    ends = [0.0, *((a[1] + b[0]) / 2.0 for a, b in pairwise(columns)), 72.0 * figure.get_figwidth()]
    found = [(round(a, 2), round(b - a, 2)) for a, b in pairwise(ends)]
    return found if len(found) > 1 and max(width for _, width in found) <= NARROW else []


def svg(figure: Figure) -> str:
    """The figure as an SVG element that scales with the page; equal figures give equal text."""
    import matplotlib  # deferred: tables need no pictures

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "armcal", "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", dpi=200, metadata=dict.fromkeys(NO_METADATA))
    text = buffer.getvalue()
    element = text[text.index("<svg") :]
    return re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", re.sub(r'width="[^"]*pt"', 'width="100%"', element, count=1))
