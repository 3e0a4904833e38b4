"""A data set of the blind study: what a user has, and what is hidden in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.measurements import Measurements


@dataclass(frozen=True)
class DataSet:
    """Arm and measurements as a user has them, and what is hidden in them.

    effects : keys of the hidden effects that the library has;  place : where an effect outside the library sits
    specs : the hidden effects as an arm file has them, to fit the true model
    wrong_rows : outliers, counted from 1
    more : (postures, payload or None, directions or None, number) -> the data with further measurements at their end
    """

    arm: Arm
    measurements: Measurements
    holdout: Measurements | None
    effects: tuple[str, ...]
    place: str | None = None
    specs: tuple[EffectSpec, ...] = ()
    wrong_rows: tuple[int, ...] = ()
    more: Callable[[Array, Array | None, Array | None, int], Measurements] | None = None
