"""The order of measurement in tables: `order` that counts, `time_s`, and the gaps where measurements are left out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.conditions import gaps_of
from identification.errors import InputError
from identification.files.csv import Table

if TYPE_CHECKING:
    from identification.measurements import Measurements


def read_order(table: Table) -> Array | None:
    """(m,) `time_s` or `order`; of both, the time says more, if it says the same."""
    order, time = (table.floats(c) if c in table else None for c in ("order", "time_s"))
    if order is None or time is None:
        return time if order is None else order
    by_order, by_time = np.argsort(order, kind="stable"), np.argsort(time, kind="stable")
    if np.array_equal(by_order, by_time):
        return time
    row = int(by_time[np.argmax(by_order != by_time)])
    place = table.place(row, "time_s")
    raise InputError(
        f"{place}: order and time_s put the rows in different orders, allowed: the same order, or one column"
    )


def read_gaps(table: Table, session: NDArray[np.str_] | None) -> NDArray[np.bool_] | None:
    """(m,) True where whole numbers of `order` are left out, in each session; None where nothing is, or nothing
    counts."""
    order = table.floats("order")
    if not np.all(order == np.round(order)):
        return None
    found = np.zeros(len(order), dtype=bool)
    for name in (None,) if session is None else np.unique(session):
        rows = np.ones(len(order), dtype=bool) if name is None else session == name
        found[rows] = gaps_of(order[rows])
    return found if found.any() else None


def order_columns(measurements: Measurements) -> dict[str, NDArray[np.generic]]:
    """`order` or `time_s`; both where the order, read again, would not have the same gaps."""
    if (order := measurements.order) is None:
        return {}
    gaps = np.zeros(len(order)) if measurements.gaps is None else measurements.gaps
    found, counts = np.zeros(len(order), dtype=bool), np.empty(len(order))
    for rows in measurements.session_rows:
        found[rows] = gaps_of(order[rows])
        sequence = rows[np.argsort(order[rows], kind="stable")]
        counts[sequence] = np.arange(len(rows)) + np.cumsum(gaps[sequence])
    whole = bool(np.all(order == np.round(order)))
    if whole and np.array_equal(found, gaps > 0.0):
        return {"order": order}
    columns: dict[str, NDArray[np.generic]] = {"time_s": order}
    return columns | ({"order": counts} if gaps.any() else {})
