"""Numbers as people read them in a terminal, in notebooks, and on pages."""

from __future__ import annotations

import numpy as np

FINEST = 1e-3  # standard deviation whose third significant digit is the fifth decimal


def number(value: float | None, digits: int = 4) -> str:
    """A number formatted for a table; a dash for None."""
    return "-" if value is None or not np.isfinite(value) else f"{value:z.{digits}f}"  # no -0.0000


def to_significant_digits(value: float | None, std: float | None) -> str:
    """Rounded to the third significant digit of the standard deviation."""
    if value is None:
        return "-"
    if not std:
        return f"{value:.5g}"
    digits = int(np.clip(2 - np.floor(np.log10(abs(std))), 0, 12))
    return f"{value:z.{digits}f}" if abs(value) < 1e6 else f"{value:.5g}"


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


def in_a_sentence(value: float | None) -> str:
    """A length to three significant digits, as people say it: `0.110`, `1.42`, `34`; a dash for None."""
    if value is None or not np.isfinite(value):
        return "-"
    if value == 0.0:
        return "0"
    digits = int(np.clip(2 - np.floor(np.log10(abs(value))), 0, 6))
    return f"{value:z.{digits}f}"


def unit_or_dash(unit: str) -> str:
    """For a column of units: a dash where there is none."""
    return "–" if unit == "1" else unit


def as_sentence(clause: str) -> str:
    """With a capital and a full stop."""
    return f"{clause[:1].upper()}{clause[1:].rstrip('.')}."
