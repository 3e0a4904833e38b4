"""A document as one self-contained HTML page: verdict, what to do next, sections, where it comes from (jinja2, SVG).

Everything that a user wrote is escaped; scripts are known to the browser by their hashes, so that no other could run;
the page asks for nothing on the network. Those that draw in three dimensions (three.js, scene.js) are in it where there
is something in space to show.
"""

from __future__ import annotations

import base64
import hashlib
import io
import platform
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from identification.document import Document, Pictures, Section, Sheet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NARROW = 430.0  # [pt] width of a figure that a phone shows as it is; columns of wider ones stand below each other
# colours of figures -> those of the page, light or dark
COLORS = {"#000000": "var(--ink)", "#ffffff": "none", "#c44e52": "var(--before)", "#2a6f97": "var(--after)"}


@dataclass(frozen=True)
class PlanSteps(Pictures):
    """A plan to be stepped through (page.js): its data as the script reads them, and in its place a caption."""

    data: Mapping[str, Any] = field(default_factory=dict)


def origin(command: str, seed: int, read: Sequence[Path]) -> Section:
    """Where a page comes from, its last part: files that were read with their hashes, URDF files that arm files name
    too, versions, the command as it was typed."""
    paths = dict.fromkeys(read)
    for path in read:
        urdf = tomllib.loads(path.read_text("utf-8-sig")).get("urdf") if path.suffix == ".toml" else None
        if isinstance(urdf, str) and not urdf.lstrip().startswith("<"):
            paths[path.parent / urdf] = None
    versions = [f"{name} {version(name)}" for name in ("armcal", "numpy", "scipy", "casadi")]
    facts = [["command", command], ["seed", str(seed)]]
    facts.append(["versions", ", ".join([*versions, f"Python {platform.python_version()}"])])
    rows = [[name, str(size), digest] for name, size, digest in hashes(paths)]
    tables = [Sheet(("file", "bytes", "SHA-256"), rows), Sheet(("", ""), facts)]
    return Section("Where this page comes from", tables)


def hashes(paths: Iterable[Path]) -> list[tuple[str, int, str]]:
    """Name, size and SHA-256 of each file."""
    contents = ((path, path.read_bytes()) for path in paths)
    return [(str(path), len(content), hashlib.sha256(content).hexdigest()) for path, content in contents]


def page(document: Document, *more: Section) -> str:
    """The page as text, with more sections at its end; it needs no other file and no network."""
    from jinja2 import Environment, PackageLoader

    environment = Environment(loader=PackageLoader("doe.report", "."), autoescape=True, trim_blocks=True)
    loose = [part for part in document.parts if not isinstance(part, Section)]
    sections = [Section("In short", loose)] if loose else []
    sections += [*(part for part in document.parts if isinstance(part, Section)), *more]
    steps = {k: part for k, s in enumerate(sections, 1) for part in s.parts if isinstance(part, PlanSteps)}
    names = ["three.min.js", "scene.js"] if any("scene" in part.data for part in steps.values()) else []
    style, *scripts = (
        files("doe.report").joinpath(name).read_text("utf-8") for name in ("page.css", *names, "page.js")
    )
    environment.filters["sha256"] = lambda text: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return environment.get_template("page.html.j2").render(
        document=document,
        verdict=[sentence for sentence in document.verdict if sentence],
        sections=sections,
        steps=steps,
        html=lambda section: section.html(page_picture),
        style=style,
        scripts=scripts,
    )


def page_picture(figure: Figure) -> str:
    """A figure as the page has it: SVG in the page's colours; where it is too wide for a phone, the strips too that
    stand below each other there, or, without strips, in a box that scrolls."""
    drawn = re.sub("|".join(COLORS), lambda color: COLORS[color[0]], svg(figure))
    width, height = 72.0 * figure.get_figwidth(), 72.0 * figure.get_figheight()
    parts = strips(figure) if width > NARROW else []
    kind = "panel" if width <= NARROW else "wide stacked" if parts else "wide pan"
    name = f"picture-{hashlib.sha256(drawn.encode()).hexdigest()[:12]}"
    drawn = drawn.replace("<svg", f'<svg id="{name}"', 1)
    shown = "".join(
        f'<svg class="strip" aria-hidden="true" viewBox="{left} 0 {across} {height}">'
        f'<use href="#{name}" width="{width}" height="{height}"/></svg>\n'
        for left, across in parts
    )
    return f'<div class="{kind}" style="--width: {width:.0f}pt">\n<div class="whole">{drawn}</div>\n{shown}</div>\n'


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
    parts = [(round(a, 2), round(b - a, 2)) for a, b in pairwise(ends)]
    return parts if len(parts) > 1 and max(width for _, width in parts) <= NARROW else []


def svg(figure: Figure) -> str:
    """The figure as an SVG element that scales with the page; equal figures give equal text."""
    import matplotlib  # deferred: tables need no pictures

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "armcal", "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", dpi=200, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = buffer.getvalue()
    element = text[text.index("<svg") :]
    return re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", re.sub(r'width="[^"]*pt"', 'width="100%"', element, count=1))
