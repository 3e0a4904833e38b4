"""Columns of instruments that measure no positions: distances, and the surfaces that are touched."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from identification.arm import LARGEST_LENGTH
from identification.arrays import Array
from identification.errors import InputError
from identification.files.csv import Table

if TYPE_CHECKING:
    from identification.kinematics.instrument import Instrument

SURFACE = "surface"  # name of the one that is touched


def unit_of(table: Table, name: str) -> tuple[str, float]:
    """Unit of the column of a length, `x_mm` or `x_m`, and the factor from it to millimetres."""
    if f"{name}_mm" in table and f"{name}_m" in table:
        raise InputError(f"{table.path}: found both {name}_mm and {name}_m, allowed: one of them")
    return ("m", 1000.0) if f"{name}_m" in table else ("mm", 1.0)


def lengths_of(instrument: Instrument) -> tuple[str, ...]:
    """Names of the lengths that an instrument reads."""
    return () if instrument.contact else ("distance",)


def read_lengths(table: Table, instrument: Instrument) -> Array:
    """(m, 1) distances of the measured point from the center, those of a sphere's surface, heights above a plane."""
    if instrument.contact:
        return np.full((len(table), 1), instrument.radius or 0.0)
    (unit, factor), largest = unit_of(table, "distance"), LARGEST_LENGTH
    allowed = f"a number > 0 [{unit}], up to {largest / factor:g}"
    values = table.floats(f"distance_{unit}", allowed, lambda v: (v > 0.0) & (v * factor <= largest))
    return values[:, None] * factor


def session_of_rows(table: Table, instrument: Instrument | None) -> NDArray[np.str_] | None:
    """(m,) names of the sessions; each surface that is touched has a place of its own, as each session has."""
    columns = ["session", SURFACE] if instrument is not None and instrument.contact else ["session"]
    found = [table.texts(column) for column in columns if column in table]
    return np.array(["/".join(names) for names in zip(*found, strict=True)]) if found else None
