"""Numbers and tables for a terminal (rich): every table is made here."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import islice
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from identification.numbers_in_text import number, to_significant_digits

FINEST = 1e-3  # standard deviation whose third significant digit is the fifth decimal
NEAR = 0.9  # of the bound, which a plan of whole runs should reach where it determines every parameter
STYLE: dict[str, Any] = {"box": SIMPLE_HEAD, "padding": (0, 0, 0, 1)}  # of every table: one line, below the head


def in_a_sentence(value: float | None) -> str:
    """A length to three significant digits, as people say it: `0.110`, `1.42`, `34`; a dash for None."""
    if value is None or not np.isfinite(value):
        return "-"
    if value == 0.0:
        return "0"
    digits = int(np.clip(2 - np.floor(np.log10(abs(value))), 0, 6))
    return f"{value:z.{digits}f}"


def judged_by_mm(efficiency: float | None) -> str:
    """What the efficiency by criterion I is worth, where the error that it stands for is known in mm."""
    hope = "Do not expect it near 1: the" if efficiency is not None and efficiency < NEAR else "The"
    return f"{hope} bound allows fractions of a run. Judge by the mm."


def unit_or_dash(unit: str) -> str:
    """For a column of units: a dash where there is none."""
    return "–" if unit == "1" else unit


def estimate_text(value: float | None, std: float | None, unit: str) -> str:
    """A parameter or a limit of its interval: three significant digits of the standard deviation, in mm and deg no more
    than five decimals."""
    if value == 0.0:
        return "0"
    if not std:
        return number(value)
    if std < FINEST and unit not in ("mm", "deg"):
        return "-" if value is None else f"{value:.3g}"
    return to_significant_digits(value, max(std, FINEST))


def table(
    headings: Sequence[str],
    rows: Iterable[Iterable[str | Text]],
    title: str | None = None,
    *,
    left: Collection[str] = (),
    no_wrap: Collection[str] = (),
    most: int | None = None,
    caption: str | None = None,
    **style: Any,
) -> Table:
    """Headings and rows of ready text, taken to the letter ([mm] is no markup); `Text` cells keep their style.

    left : headings of the columns that start at the left; the others are figures and end at the right
    no_wrap : headings of columns that are never broken
    most : number of rows shown;  caption : the line below when there are more
    style : what is other than `STYLE`, as `rich.table.Table` takes it
    """
    found = Table(title=title, title_justify="left", **STYLE | style)
    for heading in headings:
        justify: Any = "left" if heading in left else "right"
        found.add_column(Text(heading), justify=justify, overflow="fold", no_wrap=heading in no_wrap)
    remaining = iter(rows)
    for row in islice(remaining, most):
        found.add_row(*(cell if isinstance(cell, Text) else Text(cell) for cell in row))
    if most is not None and next(remaining, None) is not None:
        found.caption = caption
    return found


def facts(rows: Iterable[tuple[str, str]]) -> Table:
    """Names and values, one below the other, without lines."""
    found = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for row in rows:
        found.add_row(*map(Text, row))
    return found
