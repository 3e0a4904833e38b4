"""Reference gaps: those of the true model, of the whole library at once, of a Gaussian process."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec

import numpy as np

from doe.studies.blind.cells import DataSet
from identification import (
    Arm,
    Array,
    Calibration,
    EffectSpec,
    Measurements,
    Model,
    freedom_of,
    practical,
    quantile_95,
    rms_distance,
)
from identification.gap.blocks import hypotheses
from identification.gap.fit import Rows, fit

LENGTHS = (0.5, 8.0)  # of the process's kernel; two postures are at most 2 sqrt(n) apart
RATIOS = (1e-6, 1e6)  # of the kernel's parts to the mean square residual


def fitted_arm(data: DataSet, specs: Sequence[EffectSpec] = ()) -> Arm:
    """The arm with these effects added, none: its geometry only, fitted to the rows that are not outliers."""
    arm = practical(data.arm, data.measurements)
    model = Model(arm.with_effects(*arm.effects, *specs))
    kept = ~np.isin(np.arange(len(data.measurements)) + 1, data.wrong_rows)
    values = fit(model, Rows.of(data.measurements).pick(kept)).by_name
    return replace(model.arm, calibration=Calibration(values))


def true_arm(data: DataSet) -> Arm:
    """The arm with the true model, fitted."""
    return fitted_arm(data, data.specs)


def gap(arm: Arm, data: DataSet, positions: Array | None) -> float | None:
    """RMS distance [mm] of a calibrated arm from positions at the hold-out's postures; None where there are none."""
    if positions is None or data.holdout is None:
        return None
    return rms_distance(positions - Model(arm).position(data.holdout.postures, conditions=data.holdout.conditions))


def error(arm: Arm, data: DataSet) -> float | None:
    """RMS distance [mm] of a calibrated arm from the hold-out without its noise; None where that is not known."""
    return gap(arm, data, data.exact)


def share_inside_tip(arm: Arm, data: DataSet) -> float | None:
    """Share of the hold-out's coordinates without noise that are inside the 95 % intervals which the covariance of the
    arm's calibration gives there; None where they are not known."""
    calibration = arm.calibration
    if data.exact is None or data.holdout is None or calibration is None or calibration.covariance is None:
        return None
    model = Model(arm)
    place = [model.names.index(name) for name in calibration.parameter_names]
    computed, jacobian = model.linearize(data.holdout.postures, model.values, data.holdout.conditions)
    columns = jacobian[..., place] * quantile_95(freedom_of(calibration))
    half = np.sqrt(np.einsum("mdp,pq,mdq->md", columns, calibration.covariance, columns, optimize=True))
    return float(np.mean(np.abs(data.exact - computed) <= half))


def library_gap(data: DataSet) -> float:
    """Held-out gap [mm] of the model with every effect of the library; orders of ripple and single joints left out."""
    library = hypotheses(data.arm, data.measurements.optional_columns)
    specs = (b.spec for b in library.members if b.plain and b.spec and not b.key.startswith("joint_compliance:"))
    return rms_distance(_residuals(data, data.arm.with_effects(*specs))[1])


def has_processes() -> bool:
    """Whether scikit-learn is installed: `pip install 'armcal[studies]'`."""
    return find_spec("sklearn") is not None


def process_gap(data: DataSet) -> float | None:
    """Held-out gap [mm] of the base model corrected by a Gaussian process of its residuals; None if there is none."""
    if not has_processes() or data.holdout is None:
        return None
    residual, fresh = _residuals(data, data.arm)
    return rms_distance(fresh - gaussian_process(data.measurements.postures, residual, data.holdout.postures))


def _residuals(data: DataSet, arm: Arm) -> tuple[Array, Array]:
    """Residuals of an arm's model, fitted, on the data and on the hold-out."""
    assert data.holdout is not None
    model = Model(arm)
    values = fit(model, Rows.of(data.measurements)).values

    def left(rows: Measurements) -> Array:
        return np.asarray(rows.positions - model.position(rows.postures, values, rows.conditions))

    return left(data.measurements), left(data.holdout)


def gaussian_process(postures: Array, residual: Array, fresh: Array) -> Array:
    """(k, d) mean prediction at fresh postures (k, n) from residuals (m, d) at postures (m, n) of revolute joints.

    Squared exponential kernel on (cos q, sin q) and white noise, their sizes and length by the likelihood.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    size = float(np.std(residual))
    kernel = ConstantKernel(1.0, RATIOS) * RBF(2.0, LENGTHS) + WhiteKernel(1.0, RATIOS)
    process = GaussianProcessRegressor(kernel, n_restarts_optimizer=2, random_state=0)
    on_circles, at = (np.hstack([np.cos(angles), np.sin(angles)]) for angles in (postures, fresh))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a length or a ratio at its bound: noise only, or no noise at all
        process.fit(on_circles, residual / size)
    return np.asarray(size * process.predict(at))
