"""`diagnose` and `estimate` state the same numbers for the same model and rows."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from identification.arm import EffectSpec
from identification.estimation import Identification, estimate
from identification.estimation.levenberg_marquardt import LeastSquares
from identification.gap.diagnose import diagnose
from identification.gap.fit import Rows, fit
from identification.gap.result import Diagnosis
from identification.measurements import Measurements
from identification.model import Model
from tests.identification.estimation.cases import arm, data, plan
from tests.identification.gap.test_diagnose import ARM, diagnosed, measured

# Both end where no column of the Jacobian has a cosine above 1e-9 with the residuals: within 1e-9 sqrt(N) of a standard
# deviation of each other. Figures that do not depend on the estimates in first order agree to rounding.
DEVIATIONS = 1e-7
SAME = {"rel": 1e-9}


def compared(found: Diagnosis, other: Identification, auto: Identification) -> None:
    """Everything that both state;  auto : with the intervals that `identify` gives without --sigma."""
    calibration = found.named.calibration
    assert calibration.parameter_names == other.names
    values = other.model.parameters.vector(dict(calibration.values))
    np.testing.assert_allclose((values - other.parameters) / other.std, 0.0, atol=DEVIATIONS)
    correlations = auto.covariance / np.outer(auto.std, auto.std)
    np.testing.assert_allclose(calibration.covariance / np.outer(auto.std, auto.std), correlations, atol=1e-7)
    assert found.sigma == pytest.approx(other.sigma, **SAME)
    rows = {row["name"]: row for row in auto.to_json()["parameters"]}
    assert found.named.intervals == auto.uncertainty.kind
    for shown in found.named.parameters:
        row = rows[shown.name]
        for key in ("value", "low_95", "high_95"):
            assert abs(getattr(shown, key) - row[key]) <= DEVIATIONS * row["std"]
        assert shown.std == pytest.approx(row["std"], rel=1e-7)
        assert shown.unit == row["unit"]


def test_nothing_missing() -> None:
    found, model = diagnosed(None), Model(ARM)
    other = estimate(model, measured(None), sigma="estimated")
    assert found.verdict == "none"
    assert found.outlier_rows == ()
    assert found.scatter == ()
    compared(found, other, estimate(model, measured(None)))
    assert found.gap.rms_before == pytest.approx(other.rms_after, **SAME)
    assert found.detectability.freedom == other.dof


@pytest.mark.parametrize("name", ["encoder_eccentricity", "backlash", "link_bending", "transmission_ripple"])
def test_one_effect_named(name: str) -> None:
    found = diagnosed(name)
    assert found.outlier_rows == ()
    assert found.scatter == ()
    without = replace(found.extended_arm(found.named), calibration=None)
    other = estimate(Model(without), measured(name), sigma="estimated")
    compared(found, other, estimate(Model(without), measured(name)))
    # and from the calibration that the extended arm carries
    again = estimate(Model(found.extended_arm(found.named)), measured(name), sigma="estimated")
    compared(found, again, estimate(Model(found.extended_arm(found.named)), measured(name)))
    assert again.rms_before == pytest.approx(again.rms_after, **SAME)


def test_sigma_per_row_is_a_relative_weight() -> None:
    """Weights 1 / relative sigma^2, relative to the geometric mean, and one scale estimated from the residuals."""
    sigma = np.random.default_rng(3).uniform(0.05, 0.3, 40)
    rows = replace(data(Model(arm()), plan(40)), sigma=sigma)
    relative = sigma / np.exp(np.mean(np.log(sigma)))
    other = estimate(Model(arm()), rows, sigma="estimated", weights=relative**-2.0)
    found = fit(Model(arm()), Rows.of(rows))
    np.testing.assert_allclose((found.values - other.parameters) / other.std, 0.0, atol=DEVIATIONS)
    assert (found.sigma, found.freedom) == (pytest.approx(other.sigma, **SAME), other.dof)
    deviations = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(deviations, other.std, rtol=1e-7)


def test_an_active_bound() -> None:
    """Links that rise under their load: the flexibility ends at its bound, in both with the interval behind it."""
    model = Model(arm(EffectSpec("link_bending")))
    true = np.zeros(9)
    true[-1] = -2e-5
    exact = model.position(plan(40), true)
    noise = 0.1 * np.random.default_rng(8).standard_normal(exact.shape)
    rows = Measurements(plan(40), exact + noise)
    other = estimate(model, rows, sigma="estimated")
    found = fit(model, Rows.of(rows))
    assert other.parameters[-1] == found.values[-1] == 0.0
    np.testing.assert_array_equal(found.free, np.r_[np.ones(8, dtype=bool), False])
    np.testing.assert_allclose((found.values - other.parameters) / other.std, 0.0, atol=DEVIATIONS)
    without = replace(found, free=np.ones(9, dtype=bool)).covariance
    np.testing.assert_allclose(np.sqrt(np.diag(without)), other.std, rtol=1e-7)
    assert np.all(found.covariance[-1] == 0.0)


def test_a_fit_that_does_not_converge_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not any("did not converge" in note for note in diagnosed(None).notes)
    monkeypatch.setattr("identification.estimation.problem.LeastSquares", partial(LeastSquares, iterations=0))
    found = diagnose(ARM, measured(None))
    assert any("did not converge: " in note for note in found.notes)
