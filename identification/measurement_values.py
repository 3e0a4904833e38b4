"""What the arrays of `Measurements` may hold: shapes and values, with errors that name the row."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, readonly
from identification.errors import InputError

_Test = Callable[[Array], NDArray[np.bool_]]
DIMENSIONS = (2, 3, 6, 1)  # coordinates that an instrument may measure; 1: a length
OPTIONAL = ("order", "payload", "temperature", "directions", "sigma", "repeats", "orientations", "commanded", "gaps")


def _is_rotation(matrices: Array) -> NDArray[np.bool_]:
    """(m, 3, 3) True in rows that turn and do not mirror."""
    square = np.swapaxes(matrices, 1, 2) @ matrices
    good = np.all(np.abs(square - np.eye(3)) < 1e-6, axis=(1, 2)) & (np.linalg.det(matrices) > 0.0)
    return np.broadcast_to(good[:, None, None], matrices.shape)


# columns, sentence and test of what is allowed, for every field of `Measurements`
VALUES: dict[str, tuple[str, str, _Test]] = {
    "postures": ("joints", "finite angles [rad]", np.isfinite),
    "positions": ("coordinates", "finite coordinates [mm]", np.isfinite),
    "order": ("one", "finite numbers", np.isfinite),
    "payload": ("one", "numbers >= 0 [kg]", lambda v: np.isfinite(v) & (v >= 0.0)),
    "temperature": ("one", "numbers >= -273.15 [deg C]", lambda v: np.isfinite(v) & (v >= -273.15)),
    "directions": ("joints", "+1 or -1, NaN: unknown", lambda v: (np.abs(v) == 1.0) | np.isnan(v)),
    "gaps": ("one", "0 or 1", lambda v: np.isin(v, (0.0, 1.0))),
    "sigma": ("one", "numbers > 0 [mm]", lambda v: np.isfinite(v) & (v > 0.0)),
    "repeats": ("one", "whole numbers", lambda v: np.isfinite(v) & (v == np.round(v))),
    "commanded": ("joints", "finite angles [rad]", np.isfinite),
    "orientations": ("axes", "rotation matrices", _is_rotation),
}


def numbers(name: str, values: Any) -> Array:
    """A read-only float copy; raises `InputError` for what are no numbers, or rows of different lengths."""
    try:
        return readonly(values)
    except (TypeError, ValueError):
        raise InputError(f"measurements.{name}: not an array of numbers, allowed: real numbers") from None


def with_rotations(positions: Array) -> Array:
    """(m, 6) of points (m, 3): the orientations are as measured."""
    return positions if positions.shape[1:] != (3,) else np.pad(positions, ((0, 0), (0, 3)))


def names(name: str, values: Any, m: int) -> NDArray[np.str_]:
    """(m,) read-only texts; raises `InputError` for another shape or an empty one."""
    array = np.array(values, dtype=np.str_)
    if array.shape != (m,):
        raise InputError(f"measurements.{name}: shape {array.shape} for {m} postures, allowed: ({m},)")
    check_values(name, array, array != "", "a name")
    array.setflags(write=False)
    return array


def check_values(name: str, array: NDArray[Any], good: NDArray[np.bool_], allowed: str) -> None:
    """Raises `InputError` naming the first row that is not good."""
    if not good.all():
        row = int(np.argmin(np.all(good.reshape(len(good), -1), axis=1)))
        raise InputError(f"measurements.{name}: row {row + 1} has {array[row].tolist()!r}, allowed: {allowed}")
