"""Tables and paragraphs in HTML, everything escaped: of notebooks and of the page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape

LONG = 24  # characters, from which a cell is text that may be broken
SYMBOLS = {r"\bchi2\b": "χ²", r"\bsigma\b": "σ", "->": "→", r"\+-": "±"}
PHONE = 38  # characters of a row, a space on both sides of each cell, that a phone shows


def html_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Headings and rows of ready text; of class `wide` where a phone shows the cells of a row below each other, each
    beside its heading."""
    lines = [list(row) for row in rows]
    wide = ' class="wide"' if len(headings) > 2 and width(headings, lines) > PHONE else ""
    kinds = [' class="text"' if any(len(row[k]) > LONG for row in lines) else "" for k in range(len(headings))]
    pairs = [(kind, escape(heading)) for kind, heading in zip(kinds, headings, strict=True)]
    head = "".join(f'<th scope="col"{kind}>{heading}</th>' for kind, heading in pairs)
    kinds = [f'{kind} data-heading="{heading}"' if wide else kind for kind, heading in pairs]
    cells = ((f"<td{kind}>{escape(text)}</td>" for text, kind in zip(row, kinds, strict=True)) for row in lines)
    body = "".join(f"<tr>{''.join(row)}</tr>\n" for row in cells)
    return f"<table{wide}>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody>\n</table>"


def width(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> int:
    """Characters that a row needs: of words where a cell may be broken, which headings, first cells and texts may."""
    characters = 0
    for k, heading in enumerate(headings):
        cells = [row[k] for row in rows]
        firm = [] if k == 0 else [len(cell) for cell in cells if len(cell) <= LONG]
        words = [len(word) for text in (heading, *cells) for word in text.split()]
        characters += 2 + max([*firm, *words], default=0)
    return characters


def html_lines(lines: Iterable[str], *, strong: bool = False) -> str:
    """A paragraph for each line."""
    text = (f"<b>{escape(line)}</b>" if strong else escape(line) for line in lines)
    return "".join(f"<p>{line}</p>\n" for line in text)


def html_facts(rows: Iterable[tuple[str, str]]) -> str:
    """Names and what is to be said of each, one below the other."""
    style = 'style="text-align: left"'
    pairs = ((escape(name), escape(text)) for name, text in rows)
    lines = "".join(f'<tr><th scope="row" {style}>{name}</th><td {style}>{text}</td></tr>\n' for name, text in pairs)
    return f"<table>\n<tbody>\n{lines}</tbody>\n</table>"


def html_folded(summary: str, content: str) -> str:
    """HTML that is shown when a reader opens it; nothing where there is none."""
    return f"<details><summary>{escape(summary)}</summary>\n{content}</details>" if content else ""


def in_symbols(text: str) -> str:
    """As books print it: `chi2` as χ², `->` as an arrow."""
    for plain, symbol in SYMBOLS.items():
        text = re.sub(plain, symbol, text)
    return text
