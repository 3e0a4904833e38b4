"""Data frames for notebooks: polars, or pandas where it is installed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from identification.errors import InputError

KINDS = ("polars", "pandas")


def frame_of_columns(columns: Mapping[str, Any], kind: str = "polars") -> Any:
    """A frame of columns of one length;  kind : `polars` or `pandas`. Raises `InputError` for another, or no pandas."""
    if kind not in KINDS:
        raise InputError(f"frame: unknown kind {kind!r}, allowed: {' or '.join(KINDS)}")
    lists = {name: values.tolist() if hasattr(values, "tolist") else list(values) for name, values in columns.items()}
    if kind == "polars":
        import polars as pl  # takes longer to load than numpy: nothing else needs it to design or to fit

        return pl.DataFrame(lists, strict=False)
    try:
        import pandas as pd  # an optional one
    except ImportError:
        raise InputError("frame: pandas is not installed, allowed: kind='polars', or pip install pandas") from None
    return pd.DataFrame(lists)


def frame_of_rows(rows: Sequence[Mapping[str, Any]], kind: str = "polars") -> Any:
    """A frame of rows that have the same keys; what is None is null."""
    names = list(rows[0]) if rows else []
    return frame_of_columns({name: [row[name] for row in rows] for name in names}, kind)
