"""95 % confidence intervals of estimates, from standard deviations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri, stdtrit

from identification.arrays import Array
from identification.kinematics.parameters import ParameterSet


def quantile_95(freedom: ArrayLike) -> Array:
    """Half the width of a 95 % interval in standard deviations, of the shape of `freedom`.

    freedom : degrees of freedom of Student's t, from which a variance is estimated: infinite where it is known (the
        normal distribution), not a number where there are none
    """
    dof = np.asarray(freedom, dtype=float)
    student = stdtrit(np.where(np.isfinite(dof) & (dof > 0.0), dof, 1.0), 0.975)
    return np.where(np.isposinf(dof), ndtri(0.975), np.where(dof > 0.0, student, np.nan))


def limits_95(parameters: ParameterSet, values: Array, deviations: Array, freedom: ArrayLike) -> Array:
    """(p, 2) confidence limits, cut at the physical bounds;  values, deviations, freedom : (p,), see `quantile_95`."""
    half = quantile_95(freedom) * deviations
    limits = values[:, None] + half[:, None] * np.array([-1.0, 1.0])
    return np.clip(limits, parameters.lower[:, None], parameters.upper[:, None])
