"""Reference gaps: those of the true model, of the whole library at once, of a Gaussian process."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec

import numpy as np

from doe.studies.blind.cells import DataSet
from identification.arm import Arm, Calibration, EffectSpec
from identification.arrays import Array
from identification.estimation.intervals import freedom_of, quantile_95
from identification.gap.fit import Rows, fit
from identification.gap.hypotheses import hypotheses
from identification.measurements import rms_distance
from identification.model import Model
from identification.model.minimal import practical

LENGTHS = (0.5, 8.0)  # of the process's kernel; two postures are at most 2 sqrt(n) apart
RATIOS = (1e-6, 1e6)  # of the kernel's parts to the mean square residual


def true_arm(data: DataSet) -> Arm:
    """The arm with the true model, fitted to the rows that are not outliers."""
    return fitted_arm(data, data.specs)


def fitted_arm(data: DataSet, specs: Sequence[EffectSpec] = ()) -> Arm:
    """The arm with these effects added, none: its geometry only, fitted to the rows that are not outliers."""
    arm = practical(data.arm, data.measurements)
    model = Model(arm.with_effects(*arm.effects, *specs))
    kept = np.ones(len(data.measurements), dtype=bool)
    kept[[row - 1 for row in data.wrong_rows]] = False
    found = fit(model, Rows.of(data.measurements).pick(kept))
    return replace(model.arm, calibration=Calibration(found.by_name))


def true_gap(data: DataSet) -> float:
    """Held-out gap [mm] of the true model."""
    assert data.holdout is not None
    return rms_distance(data.holdout.positions - _computed(true_arm(data), data))


def error(arm: Arm, data: DataSet) -> float | None:
    """RMS distance [mm] of a calibrated arm from the hold-out without its noise; None where that is not known."""
    return None if data.exact is None else rms_distance(data.exact - _computed(arm, data))


def share_inside_tip(arm: Arm, data: DataSet) -> float | None:
    """Share of the hold-out's coordinates without noise that are inside the 95 % intervals which the covariance of the
    arm's calibration gives there; None where they are not known."""
    found = arm.calibration
    if data.exact is None or data.holdout is None or found is None or found.covariance is None:
        return None
    model = Model(arm)
    place = [model.names.index(name) for name in found.parameter_names]
    computed, jacobian = model.linearize(data.holdout.postures, model.values, data.holdout.conditions)
    columns = jacobian[..., place] * quantile_95(freedom_of(found))
    half = np.sqrt(np.einsum("mdp,pq,mdq->md", columns, found.covariance, columns, optimize=True))
    return float(np.mean(np.abs(data.exact - computed) <= half))


def _computed(arm: Arm, data: DataSet) -> Array:
    """(200, 2) positions at the postures of the hold-out."""
    assert data.holdout is not None
    model = Model(arm)
    return np.asarray(model.position(data.holdout.postures, model.values, data.holdout.conditions))


def library_gap(data: DataSet) -> float:
    """Held-out gap [mm] of the model with every effect of the library; orders of ripple and single joints left out."""
    assert data.holdout is not None
    library = hypotheses(data.arm, data.measurements.given)
    specs = (
        h.spec
        for h in library.members
        if not h.scanned and library.acts(h) and not h.key.startswith("joint_compliance:")
    )
    return rms_distance(_missed(data, Model(data.arm.with_effects(*specs)))[1])


def has_processes() -> bool:
    """Whether scikit-learn is installed: `pip install 'armcal[studies]'`."""
    return find_spec("sklearn") is not None


def process_gap(data: DataSet) -> float | None:
    """Held-out gap [mm] of the base model corrected by a Gaussian process of its residuals; None if there is none."""
    assert data.holdout is not None
    if not has_processes():
        return None
    residual, fresh = _missed(data, Model(data.arm))
    guess = gaussian_process(data.measurements.postures, residual, data.holdout.postures)
    return rms_distance(fresh - guess)


def _missed(data: DataSet, model: Model) -> tuple[Array, Array]:
    """Residuals of a fitted model on the data and on the hold-out."""
    assert data.holdout is not None
    rows, fresh = Rows.of(data.measurements), Rows.of(data.holdout)
    values = fit(model, rows).values
    here = rows.positions - model.position(rows.postures, values, rows.conditions)
    return np.asarray(here), np.asarray(fresh.positions - model.position(fresh.postures, values, fresh.conditions))


def gaussian_process(postures: Array, residual: Array, fresh: Array) -> Array:
    """(k, d) mean prediction at fresh postures (k, n) from residuals (m, d) at postures (m, n) of revolute joints.

    Squared exponential kernel on (cos q, sin q) and white noise, their sizes and length by the likelihood.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    size = float(np.std(residual))
    kernel = ConstantKernel(1.0, RATIOS) * RBF(2.0, LENGTHS) + WhiteKernel(1.0, RATIOS)
    process = GaussianProcessRegressor(kernel, n_restarts_optimizer=2, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a length or a ratio at its bound: noise only, or no noise at all
        process.fit(_on_circles(postures), residual / size)
    return np.asarray(size * process.predict(_on_circles(fresh)))


def _on_circles(postures: Array) -> Array:
    return np.hstack([np.cos(postures), np.sin(postures)])
