"""What a result says, once: a document of paragraphs, tables, pictures and sections, of which terminal, notebook and
page (doe/report/page.py) are renderings; and numbers as people read them.

A paragraph is a string. Everything is ready text, taken to the letter: `[mm]` is no markup, `<b>` no element.
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


SYMBOLS = {r"\bchi2\b": "χ²", r"\bsigma\b": "σ", "->": "→", r"\+-": "±"}
FINEST = 1e-3  # standard deviation whose third significant digit is the fifth decimal
NUMBER = re.compile(r"[<>]? ?[-+–]?([\d.,]+(e[-+]?\d+)?)?( \*|%)?", re.IGNORECASE)  # or a dash in place of one


# -- the tree ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Sheet:
    """Headings and rows of ready text; without headings names and what is to be said of each.

    most : rows that a terminal shows;  where : all of them are, said where there are more
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    most: int | None = None
    where: str = "--out writes all"

    @classmethod
    def facts(cls, facts: Mapping[str, str | None]) -> Self:
        """Names and what is to be said of each, without those of which nothing is."""
        return cls((), [(name, text) for name, text in facts.items() if text])

    def cut(self, most: int | None) -> tuple[Sequence[Sequence[str]], str]:
        """The first rows, and a line that says so if these are not all."""
        if self.most is None or most is None or len(self.rows) <= most:
            return self.rows, ""
        return self.rows[:most], f"first {most} of {len(self.rows)}; {self.where}"

    def html(self, name: str) -> str:
        """A table, and what it leaves out;  name : of the section around it"""
        lines, rest = self.cut(200)  # where the text of the table says that there may be more
        if self.headings:
            # texts, which may be broken, begin at the left
            kinds = [' class="text"' * any(len(line[k]) > 24 for line in lines) for k in range(len(self.headings))]
            heads = "".join(
                f'<th scope="col"{k}>{escape(text)}</th>' for text, k in zip(self.headings, kinds, strict=True)
            )
            rows = [
                "".join(f"<td{kind}>{escape(text)}</td>" for text, kind in zip(line, kinds, strict=True))
                for line in lines
            ]
        else:
            heads, left = "", 'style="text-align: left"'
            pairs = ([escape(in_symbols(text)) for text in line] for line in lines)
            rows = [f'<th scope="row" {left}>{fact}</th><td {left}>{text}</td>' for fact, text in pairs]
        head = f"<thead><tr>{heads}</tr></thead>\n" * bool(heads)
        table = f"<table>\n{head}<tbody>\n{''.join(f'<tr>{row}</tr>' + chr(10) for row in rows)}</tbody>\n</table>"
        title = f"<h3>{escape(self.title)}</h3>\n" * bool(self.title)
        label = escape(f"{name}, table".removeprefix(", "))
        return f'{title}<div class="scroll" tabindex="0" role="region" aria-label="{label}">{table}</div>\n{html(rest)}'


@dataclass(frozen=True)
class Pictures:
    """Figures and paragraphs on how they are read, made where a rendering shows them, which no terminal does."""

    draw: Callable[[], Sequence[Figure | str]]


@dataclass(frozen=True)
class Section:
    """A part with a title;  folded : closed until a reader opens it, as no terminal does"""

    title: str
    parts: Sequence[Part]
    folded: bool = False

    def html(self, picture: Callable[[Figure], str]) -> str:
        """As a page has it;  picture : a figure as HTML"""
        return html(self, picture)


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

    def __str__(self) -> str:
        return as_text(self)

    def _repr_html_(self) -> str:
        return html(self)

    def __rich_console__(self, _: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        return rendered(self, options.max_width)


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


# -- HTML, everything escaped ------------------------------------------------------------------------------------------
def html_image(figure: Figure) -> str:
    """A figure as an image of a notebook."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">\n'


def html(part: Part, picture: Callable[[Figure], str] | None = html_image, name: str = "") -> str:
    """A part as HTML.

    picture : a figure as HTML, None: pictures are left out;  name : of the section around it, for those who hear it
    """
    if isinstance(part, str):
        return f"<p>{escape(in_symbols(part))}</p>\n" if part else ""
    if isinstance(part, Sheet):
        return part.html(name) if part.rows else ""
    if isinstance(part, Pictures):
        drawn = part.draw() if picture else ()
        shown = "".join(picture(one) for one in drawn if picture and not isinstance(one, str))
        box = f'<div class="pictures">{shown}</div>\n' if shown else ""
        return "".join(html(one) for one in drawn if isinstance(one, str)) + box
    inside = "".join(html(one, picture, part.title if isinstance(part, Section) else "") for one in part.parts)
    if isinstance(part, Section):
        head = f"<h2>{escape(part.title)}</h2>\n"
        return f"<details>\n<summary>{head}</summary>\n{inside}</details>\n" if part.folded else head + inside
    first = "".join(f"<p><b>{escape(in_symbols(line))}</b></p>\n" for line in (*part.warnings, *part.verdict))
    steps = "".join(f"<p>{escape(f'{text} {command}'.strip())}</p>\n" for text, command in part.actions)
    return first + inside + steps


def in_symbols(text: str) -> str:
    """As books print it: `chi2` as χ², `->` as an arrow."""
    for plain, symbol in SYMBOLS.items():
        text = re.sub(plain, symbol, text)
    return text


# -- the terminal ------------------------------------------------------------------------------------------------------
def as_text(part: Part, width: int = 100) -> str:
    """A part as a terminal of this many characters shows it."""
    from rich.console import Console

    plain: dict[str, Any] = {"force_terminal": False, "force_jupyter": False, "color_system": None}
    console = Console(file=(text := io.StringIO()), width=width, highlight=False, markup=False, **plain)
    console.print(part if isinstance(part, Document) else Document(parts=[part]))
    return "".join(f"{line.rstrip()}\n" for line in text.getvalue().splitlines())


def rendered(part: Any, width: int) -> Iterator[RenderableType]:
    """What a terminal of this many characters shows of a part (rich), or of what rich itself can show, from the top."""
    from rich.text import Text

    if isinstance(part, str):
        yield Text(part)
    elif isinstance(part, Sheet) and part.rows:
        rows, rest = part.cut(part.most)
        yield from [Text(part.title, "italic")] if part.title else []
        yield terminal_table(part.headings, rows, width)
        yield from [Text(rest)] if rest else []
    elif isinstance(part, Section) and not part.folded:
        shown: list[Part] = [one for one in part.parts if not isinstance(one, Pictures)]
        yield from [Text(f"\n{part.title}", "bold italic")] if shown else []
        for one in shown:
            yield from rendered(one, width)
    elif isinstance(part, Document):
        yield from (Text(sentence, "bold") for sentence in (*part.warnings, *part.verdict) if sentence)
        for one in part.parts:
            yield from rendered(one, width)
        for text, command in part.actions:
            yield Text(f"next: {text}" + (f"\n      {command}" if command else ""))
    elif not isinstance(part, Sheet | Section | Pictures):
        yield part


def terminal_table(headings: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> RenderableType:
    """Figures end at the right and are never broken; where it would be too wide, columns stand closer together."""
    from rich import box
    from rich.console import Console
    from rich.measure import Measurement
    from rich.table import Table
    from rich.text import Text

    shown = Table(box=box.SIMPLE_HEAD) if headings else Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for k, heading in enumerate(headings):
        cells = [row[k].strip() for row in rows if row[k].strip()]
        figures = 2 * sum(bool(NUMBER.fullmatch(cell)) for cell in cells) > len(cells)
        shown.add_column(Text(heading), justify="right" if figures else "left", overflow="fold", no_wrap=figures)
    for row in rows:
        shown.add_row(*map(Text, row))
    free = Console(width=10_000, force_jupyter=False)
    for shown.padding in ((0, 0, 0, 1), 0) if headings else ():
        if Measurement.get(free, free.options, shown).maximum <= width:
            return shown
    for column in shown.columns:
        column.no_wrap = False  # a figure in two lines is better than one that is cut off
    return shown


# -- numbers as people read them ---------------------------------------------------------------------------------------
def number(value: float | None, digits: int = 4) -> str:
    """A number formatted for a table; a dash for None."""
    return "-" if value is None or not math.isfinite(value) else f"{value:z.{digits}f}"  # no -0.0000


def estimate_text(value: float | None, std: float | None, unit: str) -> str:
    """A parameter or a limit of its interval: three significant digits of the standard deviation, in mm and deg no more
    than five decimals."""
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


def unit_or_dash(unit: str) -> str:
    """For a column of units: a dash where there is none."""
    return "–" if unit == "1" else unit


def as_sentence(clause: str) -> str:
    """With a full stop, and a capital unless it begins with a name such as `base_drift`."""
    first = clause[:1] if "_" in clause.split(" ", 1)[0] else clause[:1].upper()
    return f"{first}{clause[1:].rstrip('.')}."


def of_joints(joints: Sequence[int]) -> str:
    """`joint 2`, `joints 1 and 3`, `joints 1 to 5`."""
    if len(joints) == 1:
        return f"joint {joints[0]}"
    if len(joints) > 2 and list(joints) == list(range(joints[0], joints[-1] + 1)):
        return f"joints {joints[0]} to {joints[-1]}"
    return f"joints {', '.join(map(str, joints[:-1]))} and {joints[-1]}"
