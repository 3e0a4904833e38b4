"""Numbers as tables have them, in a terminal, in notebooks, and on pages."""

from __future__ import annotations

import numpy as np


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
