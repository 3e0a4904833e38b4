"""Tables and paragraphs in HTML, everything escaped: of notebooks and of the page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

LONG = 24  # characters, from which a cell is text that may be broken


def html_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Headings and rows of ready text."""
    head = "".join(f'<th scope="col">{escape(heading)}</th>' for heading in headings)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>\n" for row in rows)
    return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody>\n</table>"


def html_lines(lines: Iterable[str], *, strong: bool = False) -> str:
    """A paragraph for each line."""
    text = (f"<b>{escape(line)}</b>" if strong else escape(line) for line in lines)
    return "".join(f"<p>{line}</p>\n" for line in text)


def _cell(text: str) -> str:
    return f'<td class="text">{escape(text)}</td>' if len(text) > LONG else f"<td>{escape(text)}</td>"
