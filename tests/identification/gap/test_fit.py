"""Rows made white, and the same numbers as `estimate` states."""

from dataclasses import replace
from functools import partialmethod

import numpy as np
import pytest
from scipy.linalg import block_diag

from identification import Diagnosis, Identification, Measurements, Model, diagnose, estimate
from identification.estimation.problem import Problem
from identification.gap.fit import Rows, fit
from tests.identification.estimation.cases import arm, data, plan
from tests.identification.gap.test_diagnose import ARM, diagnosed, measured

DRAWN = np.random.default_rng(8)


@pytest.mark.parametrize("d", [2, 3])
def test_a_covariance_of_every_row_and_a_memory_become_white(d: int) -> None:
    """Rows e_i = S_i a_i with a_i = rho a_(i-1) + sqrt(1 - rho^2) new have covariance S_i rho^|i-k| S_k.

    For one memory of all rows the whitener undoes the spreads first, then the memory: L C L^T = I.
    """
    m, rho = 6, 0.6
    half = DRAWN.normal(size=(m, d, d))
    spread = half @ half.transpose(0, 2, 1) + np.eye(d)
    rows = Rows.of(Measurements(DRAWN.uniform(-1, 1, (m, 2)), DRAWN.normal(size=(m, d))))
    rows = replace(rows, spread=spread, correlation=rho)
    memory = np.kron(rho ** np.abs(np.subtract.outer(np.arange(m), np.arange(m))), np.eye(d))
    covariance = block_diag(*spread) @ memory @ block_diag(*spread)
    whitener = rows.whiten(np.eye(m * d).reshape(m, d, m * d))
    np.testing.assert_allclose(whitener @ covariance @ whitener.T, np.eye(m * d), atol=1e-10)
    assert rows.dimension == d
    assert rows.log_determinant == pytest.approx(np.linalg.slogdet(covariance)[1], rel=1e-12)


# -- the same numbers for the same model and rows ----------------------------------------------------------------------
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
    assert found.named.uncertainty.kind == auto.uncertainty.kind
    for shown in found.named.parameters:
        row = rows[shown.name]
        for key in ("value", "low_95", "high_95"):
            assert abs(getattr(shown, key) - row[key]) <= DEVIATIONS * row["std"]
        assert shown.std == pytest.approx(row["std"], rel=1e-7)
        assert shown.unit == row["unit"]


@pytest.mark.parametrize("name", [None, "link_bending", "transmission_ripple"])
def test_what_is_named_has_the_figures_of_identify(name: str | None) -> None:
    found, data = diagnosed(name), measured(name)
    assert (found.outlier_rows, found.scatter) == ((), ())
    extended = found.extended_arm(found.named)
    without = Model(replace(extended, calibration=None))
    other = estimate(without, data, sigma="estimated")
    compared(found, other, estimate(without, data))
    if name is None:
        assert found.verdict == "none"
        assert found.gap.rms_before == pytest.approx(other.rms_after, **SAME)
        assert found.detectability.freedom == other.dof
    else:  # and from the calibration that the extended arm carries
        again = estimate(Model(extended), data, sigma="estimated")
        assert again.rms_before == pytest.approx(again.rms_after, **SAME)


def test_sigma_per_row_is_a_relative_weight() -> None:
    """Weights 1 / relative sigma^2, relative to the geometric mean, and one scale estimated from the residuals."""
    sigma = np.random.default_rng(3).uniform(0.05, 0.3, 40)
    rows = replace(data(Model(arm()), plan(40)), sigma=sigma)
    other = estimate(Model(arm()), rows, sigma=sigma / np.exp(np.mean(np.log(sigma))))
    scale = np.sqrt(other.chi2 / other.dof)
    found = fit(Model(arm()), Rows.of(rows))
    np.testing.assert_allclose((found.values - other.parameters) / (scale * other.std), 0.0, atol=DEVIATIONS)
    assert (found.sigma, found.freedom) == (pytest.approx(scale, **SAME), other.dof)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), scale * other.std, rtol=1e-7)


def test_a_fit_that_does_not_converge_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not any("did not converge" in note for note in diagnosed(None).notes)
    monkeypatch.setattr(Problem, "minimized", partialmethod(Problem.minimized, iterations=0))
    found = diagnose(ARM, measured(None))
    assert any("did not converge: " in note for note in found.notes)
