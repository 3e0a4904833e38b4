"""95 % confidence intervals of estimates, from standard deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri, stdtrit

from identification.arm import Calibration
from identification.arrays import Array
from identification.kinematics.parameters import ParameterSet

FREEDOM = "interval_dof"  # key of a calibration's provenance


def quantile_95(freedom: ArrayLike) -> Array:
    """Half the width of a 95 % interval in standard deviations, of the shape of `freedom`.

    freedom : degrees of freedom of Student's t, from which a variance is estimated: infinite where it is known (the
        normal distribution), not a number where there are none
    """
    dof = np.asarray(freedom, dtype=float)
    student = stdtrit(np.where(np.isfinite(dof) & (dof > 0.0), dof, 1.0), 0.975)
    return np.where(np.isposinf(dof), ndtri(0.975), np.where(dof > 0.0, student, np.nan))


def freedom_kept(names: Sequence[str], freedom: Array) -> dict[str, Any]:
    """What a calibration's provenance keeps of the degrees of freedom (p,) of its variances: nothing where all are
    infinite, a number where they are equal, else one for each of the parameters `names`."""
    if np.all(np.isinf(freedom)):
        return {}
    values = [float(f"{value:.6g}") for value in freedom]
    return {FREEDOM: values[0] if len(set(values)) == 1 else dict(zip(names, values, strict=True))}


def freedom_of(calibration: Calibration) -> Array:
    """(p,) degrees of freedom of the variances of its `parameter_names`; infinite where it does not say."""
    kept = calibration.provenance.get(FREEDOM)
    stated = [kept.get(name) if isinstance(kept, Mapping) else kept for name in calibration.parameter_names]
    return np.array([x if isinstance(x, int | float) and x > 0.0 else np.inf for x in stated], dtype=float)


def limits_95(parameters: ParameterSet, values: Array, deviations: Array, freedom: ArrayLike) -> Array:
    """(p, 2) confidence limits, cut at the physical bounds;  values, deviations, freedom : (p,), see `quantile_95`."""
    half = quantile_95(freedom) * deviations
    limits = values[:, None] + half[:, None] * np.array([-1.0, 1.0])
    return np.clip(limits, parameters.lower[:, None], parameters.upper[:, None])
