"""95 % confidence intervals of estimates, from standard deviations."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri, stdtrit

from identification.arrays import Array
from identification.kinematics.parameters import ParameterSet


def quantile_95(dof: int | None) -> float:
    """Half the width of a 95 % interval in standard deviations.

    dof : None where sigma is known: of the normal distribution; else of Student's t with the degrees of freedom from
        which sigma is estimated, not a number if there are none
    """
    if dof is None:
        return float(ndtri(0.975))
    return float(stdtrit(dof, 0.975)) if dof > 0 else float("nan")


def limits_95(parameters: ParameterSet, values: Array, deviations: Array, dof: int | None) -> Array:
    """(p, 2) confidence limits, cut at the physical bounds;  values, deviations : (p,);  dof : see `quantile_95`."""
    limits = values[:, None] + quantile_95(dof) * deviations[:, None] * np.array([-1.0, 1.0])
    return np.clip(limits, parameters.lower[:, None], parameters.upper[:, None])
