"""What a result says, once: a document of paragraphs, tables, pictures and sections, of which terminal, notebook and
page (doe/report/page.py) are renderings; and numbers as people read them.

A paragraph is a string. Everything is ready text, taken to the letter: `[mm]` is no markup, `<b>` no element. Each part
has `html(picture)` for notebook and page and `__rich_console__` for a terminal.
"""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeAlias

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console, ConsoleOptions, RenderableType


FINEST = 1e-3  # standard deviation whose third significant digit is the fifth decimal
NUMBER = re.compile(r"[<>]? ?[-+–]?([\d.,]+(e[-+]?\d+)?)?( \*|%)?", re.IGNORECASE)  # or a dash in place of one


def to_the_letter(part: Part, style: str = "") -> RenderableType:
    """A part for a terminal, a paragraph without characters that it would obey, which names in files may have."""
    from rich.text import Text

    if not isinstance(part, str):
        return part
    return Text(re.sub(r"[^\n]", lambda char: char[0] if char[0].isprintable() else "?", part), style)


# -- the tree ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Sheet:
    """Headings and rows of ready text; without headings names and what is to be said of each.

    most : rows that a terminal shows
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    most: int | None = None

    @classmethod
    def facts(cls, facts: Mapping[str, str | None]) -> Self:
        """Names and what is to be said of each, without those of which nothing is."""
        return cls((), [(name, text) for name, text in facts.items() if text])

    def cut(self, most: int | None) -> tuple[Sequence[Sequence[str]], str]:
        """The first rows, and a line that says so if these are not all."""
        if self.most is None or most is None or len(self.rows) <= most:
            return self.rows, ""
        return self.rows[:most], f"first {most} of {len(self.rows)}; --json has all"

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        """Figures end at the right and are never broken; where it would be too wide, columns stand closer together."""
        from rich import box
        from rich.measure import Measurement
        from rich.table import Table

        rows, rest = self.cut(self.most)
        table = Table(box=box.SIMPLE_HEAD) if self.headings else Table.grid(padding=(0, 2, 0, 0))
        for k, heading in enumerate(self.headings):
            cells = [row[k].strip() for row in rows if row[k].strip()]
            figures = 2 * sum(bool(NUMBER.fullmatch(cell)) for cell in cells) > len(cells)
            table.add_column(
                to_the_letter(heading), justify="right" if figures else "left", overflow="fold", no_wrap=figures
            )
        for row in rows:
            table.add_row(*map(to_the_letter, row))
        for table.padding in ((0, 0, 0, 1), 0) if self.headings else ():
            if Measurement.get(console, options.update(max_width=10_000), table).maximum <= options.max_width:
                break
        else:
            for column in table.columns:
                column.no_wrap = False  # a figure in two lines is better than one that is cut off
        if rows:
            yield from [to_the_letter(self.title, "italic")] if self.title else []
            yield table
            yield from [rest] if rest else []

    def html(self, picture: Picture) -> str:
        """A table, and what it leaves out."""
        lines, rest = self.cut(200)  # where the text of the table says that there may be more
        # texts, which may be broken, begin at the left
        kinds = [' class="text"' * any(len(line[k]) > 24 for line in lines) for k in range(len(self.headings))]
        heads = zip(self.headings, kinds, strict=True)
        head = "".join(f'<th scope="col"{kind}>{escape(text)}</th>' for text, kind in heads)
        head = f"<thead><tr>{head}</tr></thead>\n" * bool(head)
        rows = (
            "".join(f"<td{kind}>{escape(text)}</td>" for text, kind in zip(line, kinds or ("", ""), strict=True))
            for line in lines
        )
        table = f"<table>\n{head}<tbody>\n{''.join(f'<tr>{row}</tr>' + chr(10) for row in rows)}</tbody>\n</table>"
        title = f"<h3>{escape(self.title)}</h3>\n" * bool(self.title)
        name = escape(self.title or "table")  # a region that keys scroll is announced by it
        region = f'<div class="scroll" tabindex="0" role="region" aria-label="{name}">{table}</div>'
        return f"{title}{region}\n{html(rest)}" * bool(lines)


@dataclass(frozen=True)
class Pictures:
    """Figures and paragraphs on how they are read, made where a rendering shows them, which no terminal does."""

    draw: Callable[[], Figure | Sequence[Figure | str]]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        yield from ()

    def html(self, picture: Picture) -> str:
        """The paragraphs, and then the figures."""
        made = self.draw() if picture else ()
        drawn = made if isinstance(made, Sequence) else [made]
        shown = "".join(picture(one) for one in drawn if picture and not isinstance(one, str))
        box = f'<div class="pictures">{shown}</div>\n' if shown else ""
        return "".join(html(one) for one in drawn if isinstance(one, str)) + box


@dataclass(frozen=True)
class Section:
    """A part with a title;  folded : closed until a reader opens it, as no terminal does"""

    title: str
    parts: Sequence[Part]
    folded: bool = False

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        shown = [part for part in self.parts if not (self.folded or isinstance(part, Pictures))]
        yield from [to_the_letter(f"\n{self.title}", "bold italic")] if shown else []
        yield from map(to_the_letter, shown)

    def html(self, picture: Picture) -> str:
        """Its title and what is in it."""
        inside = "".join(html(part, picture) for part in self.parts)
        head = f"<h2>{escape(self.title)}</h2>\n"
        return f"<details>\n<summary>{head}</summary>\n{inside}</details>\n" if self.folded else head + inside


class Action(NamedTuple):
    """What to do next, in words, and the command for it where there is one."""

    text: str
    command: str = ""


@dataclass(frozen=True)
class Document:
    """All that is said of a result.

    verdict : sentences, the first of them the most important
    """

    title: str = ""
    verdict: Sequence[str] = ()
    parts: Sequence[Part] = ()
    actions: Sequence[tuple[str, str]] = ()
    warnings: Sequence[str] = ()

    def plus(self, *parts: Part) -> Document:
        """The same with more at the end, before what to do next."""
        return replace(self, parts=[*self.parts, *parts])

    def text(self, width: int = 100) -> str:
        """As a terminal of this many characters shows it."""
        from rich.console import Console

        plain: dict[str, Any] = {"force_terminal": False, "force_jupyter": False, "color_system": None}
        Console(file=(shown := io.StringIO()), width=width, highlight=False, markup=False, **plain).print(self)
        return "".join(f"{line.rstrip()}\n" for line in shown.getvalue().splitlines())

    def __str__(self) -> str:
        return self.text()

    def _repr_html_(self) -> str:
        return html(self)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        yield from (to_the_letter(sentence, "bold") for sentence in (*self.warnings, *self.verdict) if sentence)
        yield from map(to_the_letter, self.parts)
        for text, command in self.actions:
            yield to_the_letter(f"next: {text}" + (f"\n      {command}" if command else ""))

    def html(self, picture: Picture) -> str:
        """All of it but the title."""
        first = "".join(f"<p><b>{escape(line)}</b></p>\n" for line in (*self.warnings, *self.verdict) if line)
        steps = "".join(html(f"{text} {command}".strip()) for text, command in self.actions)
        return first + "".join(html(part, picture) for part in self.parts) + steps


class Documented:
    """A result that prints as its document, in a terminal and in a notebook."""

    def document(self) -> Document:
        """All that is said of it."""
        raise NotImplementedError

    def __str__(self) -> str:
        return str(self.document())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html(self.document())


Part: TypeAlias = str | Sheet | Pictures | Section | Document
Picture: TypeAlias = "Callable[[Figure], str] | None"  # a figure as HTML, None: pictures are left out
Files: TypeAlias = dict[Path | None, tuple[str, Any]]  # path, None: not asked for -> what it is, and its content


@dataclass
class Answer:
    """What a command answers.

    data : the object of --json;  document : for people;  result : what both are of, for Python
    exit_code : 0 done, 1 the job failed
    warnings : doubts that `document` has too, for those who read `data`
    files : to be written: what each is, and its content
    """

    data: dict[str, Any]
    document: Document = Document()
    result: Any = None
    exit_code: int = 0
    warnings: Sequence[str] = ()
    files: Files = field(default_factory=dict)


def html_image(figure: Figure) -> str:
    """A figure as an image of a notebook."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">\n'


def html(part: Part, picture: Picture = html_image) -> str:
    """A part as HTML, everything escaped."""
    return f"<p>{escape(part)}</p>\n" * bool(part) if isinstance(part, str) else part.html(picture)


# -- numbers as people read them ---------------------------------------------------------------------------------------
def number(value: float | None, digits: int = 4) -> str:
    """A number formatted for a table; a dash for None."""
    return "-" if value is None or not math.isfinite(value) else f"{value:z.{digits}f}"  # no -0.0000


def estimate_text(value: float | None, std: float | None, unit: str) -> str:
    """A parameter or limit: three significant digits of the standard deviation, in mm and deg at most five decimals."""
    if not value or not std or math.isnan(std):
        return "0" if value == 0.0 else number(value)
    std = max(std, FINEST) if unit in ("mm", "deg") else std
    if std < FINEST:
        return f"{value:.3g}"
    return f"{value:z.{max(2 - math.floor(math.log10(std)), 0)}f}" if abs(value) < 1e6 else f"{value:.5g}"


def in_a_sentence(value: float | None) -> str:
    """A length to three significant digits, as people say it: `0.110`, `1.42`, `34`; a dash for None."""
    if not value or not math.isfinite(value):
        return "0" if value == 0.0 else "-"
    return number(value, min(max(2 - math.floor(math.log10(abs(value))), 0), 6))


def count_of(many: int, noun: str) -> str:
    """`1 run`, `20 runs`."""
    return f"{many} {noun}{'s' * (many != 1)}"


def unit_or_dash(unit: str) -> str:
    """For a column of units: a dash where there is none."""
    return "–" if unit == "1" else unit


def as_sentence(clause: str) -> str:
    """With a full stop, and a capital unless it begins with a name such as `base_drift`."""
    return f"{clause[:1] if '_' in clause.split(' ', 1)[0] else clause[:1].upper()}{clause[1:].rstrip('.')}."


def of_joints(joints: Sequence[int]) -> str:
    """`joint 2`, `joints 1 and 3`, `joints 1 to 5`."""
    if len(joints) == 1:
        return f"joint {joints[0]}"
    if len(joints) > 2 and list(joints) == list(range(joints[0], joints[-1] + 1)):
        return f"joints {joints[0]} to {joints[-1]}"
    return f"joints {', '.join(map(str, joints[:-1]))} and {joints[-1]}"
