"""A data set with a hidden effect, for studies of the gap workflow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.gap.fit import fit, links_start
from identification.gap.holdout import rms_distance
from identification.gap.whitening import Rows
from identification.measurements import Measurements
from identification.model import Model


@dataclass(frozen=True)
class Case:
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

    def true_gap(self) -> float:
        """Held-out gap [mm] of the true model, fitted to the rows that are not outliers."""
        assert self.holdout is not None
        model = Model(self.arm.with_effects(*self.arm.effects, *self.specs))
        kept = np.ones(len(self.measurements), dtype=bool)
        kept[[row - 1 for row in self.wrong_rows]] = False
        rows, fresh = Rows.of(self.measurements).pick(kept), Rows.of(self.holdout)
        values = fit(model, rows, links_start(model, rows)).values
        return rms_distance(fresh.positions - model.position(fresh.postures, values, fresh.conditions))
