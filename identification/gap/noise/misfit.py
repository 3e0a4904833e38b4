"""Chi-square test of the residuals of the named model against the given sigma.

It has no influence on the verdict: a sigma from a data sheet may be too small (identification/README.md, "Lessons").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from identification.arrays import Array
from identification.measurements import Measurements

LEVEL = 0.01  # convention: of misfit that is said


@dataclass(frozen=True)
class Misfit:
    """chi2 : sum of squares of the residuals in units of the given sigma;  dof : its degrees of freedom"""

    chi2: float
    dof: int

    @property
    def ratio(self) -> float:
        """Ratio of the residuals' standard deviation to the given sigma."""
        return float(np.sqrt(self.chi2 / self.dof))

    @property
    def p_value(self) -> float:
        """Probability of a chi2 at least this large if model and sigma are right."""
        return float(chdtrc(self.dof, self.chi2))

    @property
    def significant(self) -> bool:
        """True if the residuals are larger than noise of the given sigma explains, at `LEVEL`."""
        return self.p_value <= LEVEL

    def to_json(self) -> dict[str, float]:
        """Keys of `misfit` (identification/files/README.md, "JSON keys")."""
        return {"chi2": self.chi2, "dof": self.dof, "p_value": self.p_value, "ratio": self.ratio}


def misfit(
    residual: Array, rank: int, measurements: Measurements, sigma: float | None, kept: NDArray[np.bool_]
) -> Misfit | None:
    """Test residuals (m, d) [mm] of a model of this rank; None where neither the rows nor the arm file give a sigma.

    sigma : of the arm file [mm];  kept : (m,) rows that are no outliers
    """
    given = sigma if measurements.sigma is None else measurements.sigma[kept, None]
    left = residual[kept]
    if given is None or left.size <= rank:
        return None
    return Misfit(float(np.sum((left / given) ** 2)), left.size - rank)
