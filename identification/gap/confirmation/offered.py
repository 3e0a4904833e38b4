"""`Offered`: whether a model that is offered for use predicts what it has not seen better than the geometry alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from identification.arrays import Array
from identification.gap.confirmation.confirmation import LEVEL, Confirmation, mean_of
from identification.gap.confirmation.holdout import groups_of
from identification.measurements import Measurements, distances


@dataclass(frozen=True)
class Offered:
    """Distances [mm] that the model offered and the geometry alone leave, each as `identify` and `validate` have it.

    by : `holdout` or `cross-validation` (each posture by a fit to others);  rows : how many
    rms, largest : of the model;  rms_geometry, largest_geometry : of the geometry, identified on the same rows
    p_value : one-sided, of no gain
    """

    by: str
    rows: int
    rms: float
    largest: float
    rms_geometry: float
    largest_geometry: float
    p_value: float

    @classmethod
    def of(cls, by: str, geometry: Array, model: Array, measurements: Measurements) -> Offered:
        """From residuals (m, d) [mm] of the same rows."""
        before, after = distances(geometry), distances(model)
        gained = mean_of(before**2 - after**2, groups_of(measurements, np.ones(len(before), dtype=bool)))
        rms, rms_geometry = (float(np.sqrt(np.mean(each**2))) for each in (after, before))
        return cls(by, len(after), rms, float(after.max()), rms_geometry, float(before.max()), gained.p_above())

    @classmethod
    def of_test(cls, test: Confirmation) -> Offered:
        """From a test of a model against the base model."""
        figures = (test.after, test.largest_after, test.before, test.largest_before)
        return cls(test.by, test.rows, *figures, 1.0 if test.p_shrinks is None else test.p_shrinks)

    @property
    def better(self) -> bool:
        """Whether the model predicts better beyond chance, as `validate` judges it."""
        return self.rms < self.rms_geometry and self.p_value <= LEVEL / 2.0

    @property
    def figures(self) -> str:
        """What both leave, in words."""
        which = "held-out rows" if self.by == "holdout" else "rows, each predicted by a fit to other postures"
        own, geometry = f"{self.rms:.3g} mm RMS (largest {self.largest:.3g})", f"{self.rms_geometry:.3g} mm"
        return f"{own} against {geometry} (largest {self.largest_geometry:.3g}) in {self.rows} {which}"

    @property
    def sentence(self) -> str:
        """How the model compares with the geometry."""
        if self.better:
            return f"better than the geometry alone: {self.figures}"
        if self.rms >= self.rms_geometry:
            return f"no better than the geometry alone: {self.figures}"
        return f"better than the geometry alone only within chance: {self.figures}, p = {self.p_value:.2g}"

    def to_json(self) -> dict[str, Any]:
        """Key `offered` (identification/files/README.md, "JSON keys")."""
        return {
            "by": self.by,
            "rows": self.rows,
            "rms_mm": self.rms,
            "max_mm": self.largest,
            "rms_geometry_mm": self.rms_geometry,
            "max_geometry_mm": self.largest_geometry,
            "p_value": self.p_value,
            "better": self.better,
        }
