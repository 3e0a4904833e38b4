"""Which joints get a curve: projections, cross-validation and the choice, against dense linear algebra."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec, Gravity
from identification.effects import build
from identification.gap.curves.curve_choice import (
    FOLDS,
    STRETCHES,
    CurveChoice,
    System,
    choose_curves,
    folds,
    is_function_of,
)
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import HypothesisSet, hypotheses
from identification.gap.selection.search import HypothesisSearch
from identification.measurements import Measurements
from identification.model import Model

ARM = Arm([300.0, 200.0])
LOGS = np.log([1e-3, 0.4])


def _irregular(q: np.ndarray) -> np.ndarray:
    """An error [rad] that no name fits."""
    return 6e-4 * np.sin(3.3 * q + np.sin(2.0 * q)) * np.exp(-0.2 * q**2)


@cache
def _data(m: int) -> Measurements:
    rng = np.random.default_rng(4)
    q = rng.uniform(-1.5, 1.5, (m, 2))
    real = q + np.column_stack([5e-4 * np.cos(12.0 * q[:, 0]), _irregular(q[:, 1])])
    return Measurements(q, Model(ARM).position(real) + 0.05 * rng.normal(size=(m, 2)))


@cache
def _system(m: int, *labels: str) -> System:
    library: HypothesisSet = hypotheses(ARM, frozenset())
    members = {h.label: h for h in library.members}
    named = tuple(members[label] for label in labels)
    search = HypothesisSearch(library, Rows.of(_data(m)))
    return System(search.fit(named), search.rows, named, search.fit(()).rank)


RIPPLES = ("transmission_ripple:1[k=12]", "transmission_ripple:2[k=3]")


def _columns(system: System, joint: int) -> np.ndarray:
    """(2 m, K) of one joint's curve."""
    basis = next(b for b in system.bases if b.joint == joint)
    rows = system.rows
    levers = system.found.model.joint_levers(rows.postures, system.found.values)[:, :, joint]
    return (levers[:, :, None] * basis.at(rows.postures[:, joint])[:, None, :]).reshape(len(system.found.residual), -1)


@pytest.mark.parametrize("m", [40, 200])
def test_penalized_is_projected_off_what_stays(m: int) -> None:
    """The ripple of joint 2 is taken out and its residuals are back; few and many rows give the same products."""
    system = _system(m, *RIPPLES)
    kept = system.named[:1]
    found = system.penalized(kept, (1,))
    dropped = np.array([name.startswith("transmission_ripple:2") for name in system.found.model.names])
    jacobian, values = system.found.jacobian, system.found.values
    basis = np.linalg.qr(jacobian[:, ~dropped])[0]
    residual = system.found.residual + jacobian[:, dropped] @ values[dropped]
    residual -= basis @ (basis.T @ residual)
    columns = _columns(system, 1)
    columns = columns - basis @ (basis.T @ columns)
    np.testing.assert_allclose(found.gram, columns.T @ columns, rtol=1e-6, atol=1e-6 * np.max(columns**2))
    np.testing.assert_allclose(found.right, columns.T @ residual, atol=1e-6 * np.max(np.abs(columns.T @ residual)))
    assert found.residual @ found.residual == pytest.approx(residual @ residual, rel=1e-8)
    assert found.freedom == 2 * m - 4


def test_cross_validation_predicts_each_fold_from_the_others() -> None:
    system = _system(200, *RIPPLES)
    chosen = CurveChoice(system.named[:1], (1,), 0.0, LOGS)
    dropped = np.array([name.startswith("transmission_ripple:2") for name in system.found.model.names])
    jacobian, values = system.found.jacobian, system.found.values
    residual = system.found.residual + jacobian[:, dropped] @ values[dropped]
    every = np.concatenate([jacobian[:, ~dropped], _columns(system, 1)], axis=1)
    basis = next(b for b in system.bases if b.joint == 1)
    penalty = np.diag(np.r_[np.zeros((~dropped).sum()), 1.0 / basis.variances(*np.exp(LOGS))[0]])
    fold, error = np.repeat(folds(system.rows.posture_numbers), 2), 0.0
    for k in range(FOLDS):
        there = fold != k
        scaled = every[there]
        solved = np.linalg.solve(scaled.T @ scaled + penalty, scaled.T @ residual[there])
        error += float(np.sum((residual[~there] - every[~there] @ solved) ** 2))
    assert system.cross_validated(chosen) == pytest.approx(error, rel=1e-5)


def test_a_parameter_that_moves_nothing_changes_nothing() -> None:
    """An error of the payload on links that nothing bends: its column is zero in every row."""
    gravity = Gravity(np.array([0.0, -9.81]), np.ones(2), np.full(2, 0.5), 1.0)
    arm = Arm(ARM.lengths, gravity=gravity, effects=(EffectSpec("payload_error"),))
    search = HypothesisSearch(hypotheses(arm, frozenset()), Rows.of(_data(40)))
    system, plain = System(search.fit(()), search.rows, (), search.fit(()).rank), _system(40)
    assert len(system.found.model.names) == len(plain.found.model.names) + 1
    chosen = CurveChoice((), (1,), 0.0, LOGS)
    assert system.cross_validated(chosen) == pytest.approx(plain.cross_validated(chosen), rel=1e-9)


def test_stretches_of_time_are_predicted_from_the_others() -> None:
    """Fitted as correlated rows, tested as they were measured: differences of successive rows by hand."""
    plain, rho = _system(200, *RIPPLES), 0.6
    system = plain.with_correlation(rho)
    chosen = CurveChoice(system.named, (1,), 0.0, LOGS)
    every = np.concatenate([plain.found.jacobian, _columns(plain, 1)], axis=1).reshape(200, 2, -1)
    residual = plain.found.residual.reshape(200, 2)
    before = [np.concatenate([v[:1], (v[1:] - rho * v[:-1]) / np.sqrt(1.0 - rho**2)]) for v in (every, residual)]
    basis = next(b for b in system.bases if b.joint == 1)
    penalty = np.diag(np.r_[np.zeros(8), 1.0 / basis.variances(*np.exp(LOGS))[0]])
    stretch, error = np.arange(200) * STRETCHES // 200, 0.0
    for k in range(STRETCHES):
        a, r = (v[stretch != k].reshape(2 * int(np.sum(stretch != k)), -1) for v in before)
        solved = np.linalg.solve(a.T @ a + penalty, a.T @ r)[:, 0]
        error += float(np.sum((residual[stretch == k] - every[stretch == k] @ solved) ** 2))
    assert system.left_in_time(chosen) == pytest.approx(error, rel=1e-5)


def test_rows_of_one_posture_share_a_fold() -> None:
    found = folds(np.repeat(np.random.default_rng(1).permutation(30), 4)).reshape(30, 4)
    assert np.all(found == found[:, :1])
    assert set(found.ravel()) == set(range(FOLDS))


def test_a_name_stays_and_a_curve_takes_the_place_of_a_wrong_one() -> None:
    """A ripple of 12 per turn in joint 1 is what it is; in joint 2 no ripple fits."""
    found = choose_curves(_system(200, *RIPPLES), 6.0)
    assert [h.label for h in found.kept] == ["transmission_ripple:1[k=12]"]
    assert found.joints == (1,)


def test_model_response_is_that_of_a_refit() -> None:
    system = _system(200, *RIPPLES)
    chosen = CurveChoice(system.named, (1,), 0.0, LOGS)
    other = np.linalg.lstsq(system.found.jacobian, _columns(system, 1), rcond=None)[0]
    np.testing.assert_allclose(system.model_response(chosen), -other, atol=1e-5 * np.max(np.abs(other)))


@pytest.mark.parametrize(
    ("name", "joint", "own"),
    [
        ("encoder_eccentricity", 2, True),
        ("gear_ratio", 2, True),
        ("joint_coupling", 2, False),
        ("backlash", 2, False),
        ("encoder_eccentricity", 1, False),
        ("base_offset", None, False),
    ],
)
def test_functions_of_one_angle(name: str, joint: int | None, own: bool) -> None:
    assert is_function_of(build(EffectSpec(name, joint), 2), 1, Model(ARM)) == own
