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
from pathlib import Path
from typing import TYPE_CHECKING, Any

from identification.document import Document, Pictures, Section, Sheet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    versions = ", ".join(f"{name} {version(name)}" for name in ("armcal", "numpy", "scipy", "casadi"))
    facts = {"command": command, "seed": str(seed), "versions": f"{versions}, Python {platform.python_version()}"}
    rows = [[name, str(size), digest] for name, size, digest in hashes(paths)]
    return Section("Where this page comes from", [Sheet(("file", "bytes", "SHA-256"), rows), Sheet.facts(facts)])


def hashes(paths: Iterable[Path]) -> list[tuple[str, int, str]]:
    """Name, size and SHA-256 of each file."""
    contents = ((path, path.read_bytes()) for path in paths)
    return [(str(path), len(content), hashlib.sha256(content).hexdigest()) for path, content in contents]


def page(document: Document) -> str:
    """The page of a document of sections as text; it needs no other file and no network."""
    from jinja2 import Environment, PackageLoader

    environment = Environment(loader=PackageLoader("doe.report", "."), autoescape=True, trim_blocks=True)
    sections: list[Any] = [*document.parts]
    steps = {k: part for k, s in enumerate(sections, 1) for part in s.parts if isinstance(part, PlanSteps)}
    names = ["three.min.js", "scene.js"] if any("scene" in part.data for part in steps.values()) else []
    read = files("doe.report").joinpath
    style, *scripts = (read(name).read_text("utf-8") for name in ("page.css", *names, "page.js"))

    def picture(figure: Figure) -> str:
        """As SVG that scales with the page, in its colours; a wide one scrolls where the page is narrower. Equal
        figures give equal text."""
        import matplotlib  # deferred: tables need no pictures

        buffer, width = io.StringIO(), 72.0 * figure.get_figwidth()
        with matplotlib.rc_context({"svg.hashsalt": "armcal", "svg.fonttype": "path"}):
            figure.savefig(buffer, format="svg", dpi=200, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
        drawn = buffer.getvalue()
        drawn = re.sub(r'width="[^"]*pt"', 'width="100%"', drawn[drawn.index("<svg") :], count=1)
        drawn = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", drawn)
        drawn = re.sub("|".join(COLORS), lambda color: COLORS[color[0]], drawn)
        return f'<div class="{"wide" if width > 430.0 else "panel"}" style="--width: {width:.0f}pt">\n{drawn}</div>\n'

    environment.filters["sha256"] = lambda text: base64.b64encode(hashlib.sha256(str(text).encode()).digest()).decode()
    return environment.get_template("page.html.j2").render(
        document=document,
        verdict=[sentence for sentence in document.verdict if sentence],
        sections=sections,
        steps=steps,
        html=lambda section: section.html(picture),
        style=style,
        scripts=scripts,
    )
