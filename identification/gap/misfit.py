"""Misfit: do the residuals of the named model exceed the given noise? A finding of its own beside the verdict.

It decides no name: a sigma from a data sheet may be too small (identification/README.md, "Lessons").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from identification.arrays import Array
from identification.gap.noise import LEVEL
from identification.measurements import Measurements


@dataclass(frozen=True)
class Misfit:
    """chi2 : sum of the squared residuals in units of the given sigma;  dof : its degrees of freedom"""

    chi2: float
    dof: int

    @property
    def ratio(self) -> float:
        """Scatter of the residuals over the given sigma."""
        return float(np.sqrt(self.chi2 / self.dof))

    @property
    def p_value(self) -> float:
        """Probability of a chi2 at least this large if model and sigma are right."""
        return float(chdtrc(self.dof, self.chi2))

    @property
    def significant(self) -> bool:
        """More than noise of the given sigma leaves."""
        return self.p_value <= LEVEL

    def to_json(self) -> dict[str, float]:
        """Keys of `misfit` (identification/files/README.md, "JSON keys")."""
        return {"chi2": self.chi2, "dof": self.dof, "p_value": self.p_value, "ratio": self.ratio}


def misfit(
    residual: Array, rank: int, measurements: Measurements, sigma: float | None, kept: NDArray[np.bool_]
) -> Misfit | None:
    """Of residuals (m, d) [mm] of a model of this rank; None where no sigma is given, by row or by the arm file."""
    given = sigma if measurements.sigma is None else measurements.sigma[kept, None]
    left = residual[kept]
    if given is None or left.size <= rank:
        return None
    return Misfit(float(np.sum((left / given) ** 2)), left.size - rank)
