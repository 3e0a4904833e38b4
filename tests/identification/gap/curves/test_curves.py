"""Error curves as a result: what `diagnose` makes of a joint that no name fits."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from identification.arm import Arm, Calibration, EffectSpec
from identification.estimation import estimate
from identification.files.arm_text import dump_arm
from identification.gap.confirmation.cross_validation import cross_validate
from identification.gap.curves.curve import curves_text
from identification.gap.curves.curves import Curves, _least_plausible, curve_candidate, find_curves
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.notes import curve_notes
from identification.gap.outside.unmodelled import Unknown
from identification.gap.selection.search import HypothesisSearch
from identification.gap.workflow import Findings
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.validate import validate

ARM, SIGMA = Arm([300.0, 200.0]), 0.05
TRUTH = np.array([0.4, -0.3, 1e-3, -2e-3])


def _error(q: np.ndarray) -> np.ndarray:
    """[rad] of joint 1: two waves that fade."""
    return 8e-4 * np.sin(9.0 * q) * np.exp(-0.5 * q**2) + 4e-4 * np.cos(2.3 * q)


@cache
def _data(seed: int, m: int = 150) -> Measurements:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, (m, 2))
    real = q + np.column_stack([_error(q[:, 0]), np.zeros(m)])
    return Measurements(q, Model(ARM).position(real, TRUTH) + SIGMA * rng.normal(size=(m, 2)))


def _found(data: Measurements, place: str | None = "joint:1") -> Findings:
    search = HypothesisSearch(hypotheses(ARM, frozenset()), Rows.of(data))
    return Findings(search, None, Unknown(1e-3, place, None, (), 0.0), (), np.zeros(len(data), dtype=bool))  # type: ignore[arg-type]


@cache
def _curves(seed: int = 1) -> Curves:
    found = find_curves(_found(_data(seed)), _data(seed))
    assert found is not None
    return found


def test_where_curves_hold_is_said() -> None:
    (note,) = curve_notes(_curves().curves)
    low, high = np.degrees([_data(1).postures[:, 0].min(), _data(1).postures[:, 0].max()])
    assert f"(joint 1 {low:.0f} to {high:.0f} deg); where a joint is beyond them, the model is without curves" in note
    assert curve_notes(()) == []


def test_the_curve_is_that_of_the_joint() -> None:
    """Beside a constant, which is the joint's offset; some 95 % of it is in the band, waves being neighbors."""
    (curve,) = _curves().curves
    assert curve.joint == 1
    gap = curve.error - _error(curve.angles)
    assert np.mean(np.abs(gap - np.mean(gap)) < 1.96 * curve.std) > 0.85
    assert np.std(gap) < 0.2 * np.std(_error(curve.angles))


def test_fresh_rows_are_left_with_what_was_predicted() -> None:
    fit, fresh = _curves().fit, _data(99, 400)
    left = np.mean(np.sum(fit.position_residuals(fresh, Conditions()) ** 2, axis=1))
    columns, covariance = fit.uncertain(fresh.postures, Conditions())
    predicted = 2.0 * fit.sigma**2 + np.mean(np.einsum("mip,pq,miq->m", columns, covariance, columns))
    assert fit.sigma == pytest.approx(SIGMA, rel=0.15)  # 250 degrees of freedom: standard error 0.045
    assert left == pytest.approx(predicted, rel=0.25)
    base = Model(ARM)
    plain = fresh.positions - base.position(fresh.postures, TRUTH)
    assert left < 0.3 * np.mean(np.sum(plain**2, axis=1))


def test_estimates_scatter_as_their_covariance_says() -> None:
    """Of lengths and one offset over 6 data sets: squared errors in units of the covariance, 3 on average."""
    sizes = []
    for seed in range(1, 7):
        fit = _curves(seed).fit
        error = (fit.values - TRUTH)[[0, 1, 3]]  # the first offset is shared with the curve's mean
        sizes.append(error @ np.linalg.solve(fit.covariance()[np.ix_([0, 1, 3], [0, 1, 3])], error))
    assert 0.25 * 3.0 < np.mean(sizes) < 2.0 * 3.0


def test_nothing_is_looked_for_where_nothing_was_found() -> None:
    assert find_curves(_found(_data(1), None), _data(1)) is None


def test_noise_alone_gives_no_curve() -> None:
    rng = np.random.default_rng(3)
    q = rng.uniform(-1.5, 1.5, (100, 2))
    data = Measurements(q, Model(ARM).position(q, TRUTH) + SIGMA * rng.normal(size=(100, 2)))
    assert find_curves(_found(data), data) is None


def test_candidate_extends_the_arm() -> None:
    found = _curves()
    candidate = curve_candidate(found)
    assert candidate.effects == ("joint_error_curve:1",)
    assert candidate.specs[0].curve == found.curves[0].table
    assert candidate.p_adjusted < 1e-6
    arm = Arm(ARM.lengths, effects=candidate.specs, calibration=candidate.calibration)
    left = _data(1).positions - Model(arm).position(_data(1).postures)
    np.testing.assert_allclose(left, found.fit.position_residuals(_data(1), Conditions()), atol=1e-9)
    assert "values_deg = [" in dump_arm(arm)


def test_correction_brings_the_joint_where_it_should_be() -> None:
    (curve,) = _curves().curves
    reached = curve.angles + curve.correction + curve.table.at(curve.angles + curve.correction)
    np.testing.assert_allclose(reached, curve.angles, atol=1e-9)


def test_table_and_json() -> None:
    (curve,) = _curves().curves
    lines = curves_text([curve]).splitlines()
    assert lines[0] == "joint,angle_deg,correction_deg,std_deg,error_deg"
    assert len(lines) == 1 + len(curve.angles)
    first = [float(cell) for cell in lines[1].split(",")]
    expected = [1.0, *np.degrees([curve.angles[0], curve.correction[0], curve.std[0], curve.error[0]])]
    np.testing.assert_allclose(first, expected, atol=6e-8)
    said = json.loads(json.dumps(curve.to_json()))
    assert (said["joint"], said["angle_deg"][0]) == (1, first[1])
    assert said["from_deg"] == pytest.approx(np.degrees(curve.angles[0]))
    assert len(said["correction_deg"]) == len(curve.angles)


def test_cross_validation_fits_the_curves_again() -> None:
    """Each part predicted by ridge regression of the other parts, at the prior that was found; written out."""
    fit, data = _curves().fit, _data(1)
    folds = np.arange(150) % 4
    jacobian = fit.model.jacobian(data.postures, fit.values)
    levers = fit.model.joint_levers(data.postures, fit.values)[:, :, 0]
    columns = np.concatenate([jacobian, levers[:, :, None] * fit.bases[0].at(data.postures[:, 0])[:, None]], axis=2)
    target = fit.position_residuals(data, Conditions()) + columns[:, :, 4:] @ fit.evidence.coefficients
    penalty = np.diag(np.r_[np.zeros(4), 1.0 / fit.evidence.variances])
    found = cross_validate(fit, folds)
    for k in range(4):
        a, r = columns[folds != k].reshape(-1, columns.shape[2]), target[folds != k].ravel()
        solved = np.linalg.solve(a.T @ a + penalty, a.T @ r)
        left = target[folds == k] - columns[folds == k] @ solved
        np.testing.assert_allclose(found.residual[folds == k], left, atol=2e-4)  # tables are written to 1e-7 deg
    assert np.mean(found.residual**2) * 2.0 == pytest.approx(np.mean(found.predicted), rel=0.2)


def test_an_effect_far_beyond_its_typical_size_is_implausible() -> None:
    """The farthest first: 20 typical sizes (5e-5) before 6 (5e-4); 3 are plausible."""
    arm = Arm([300.0, 200.0])
    library = {h.effect.label: h for h in hypotheses(arm, frozenset()).members}
    kept = tuple(library[name] for name in ("axes_skew", "encoder_eccentricity:1", "gear_ratio:2"))
    model = Model(arm.with_effects(*(h.spec for h in kept)))
    sizes = {"axes_skew.a": 1e-3, "encoder_eccentricity:1.b": -3e-3, "gear_ratio:2.e": 3e-4}
    fitted = SimpleNamespace(model=model, by_name=dict.fromkeys(model.names, 0.0) | sizes)
    assert _least_plausible(fitted, kept) is kept[0]
    assert _least_plausible(fitted, kept[1:]) is kept[1]
    assert _least_plausible(fitted, kept[2:]) is None
    assert _least_plausible(fitted, ()) is None


def test_beyond_the_angles_of_a_curve_the_geometry_is_that_of_least_squares_alone() -> None:
    """The linear model written in complex numbers: tip = (l_1 + dl_1) e^(i (q_1 + dq_1)) + ...; its estimates without
    any curve. The part that belongs to the curve is linear, and its squares are some (1e-3)^2 x 500 mm."""
    found, data = _curves(), _data(1)
    turns = np.exp(1j * np.cumsum(data.postures, axis=1))
    tip = data.positions[:, 0] + 1j * data.positions[:, 1]
    factors = np.linalg.lstsq(turns, tip, rcond=None)[0]  # (l_j + dl_j) e^(i (dq_1 + .. + dq_j)): linear in complex
    far = np.random.default_rng(5).uniform([2.0, -1.4], [4.0, 1.4], (50, 2))
    plain = np.exp(1j * np.cumsum(far, axis=1)) @ factors
    expected = np.column_stack([plain.real, plain.imag])
    np.testing.assert_allclose(found.fit.model.position(far, found.fit.values), expected, atol=2e-3)
    tied = replace(found.curves[0].table, geometry={})
    bare = Model(Arm(ARM.lengths, effects=(replace(found.curves[0].spec, curve=tied),)))
    assert np.abs(bare.position(far, found.fit.values) - expected).max() > 0.05
    inside = data.postures[:20]
    np.testing.assert_array_equal(
        bare.position(inside, found.fit.values), found.fit.model.position(inside, found.fit.values)
    )


def test_another_session_is_never_left_with_more_than_by_plain_geometry() -> None:
    """Eight arms simulated in complex numbers: eccentricity, ripples and a sag that no curve can be, sessions whose
    ranges of joint 1 do not meet; bases anew. Curves with their geometry left there do harm in some of these."""
    worse = []
    for seed in range(8):
        rng = np.random.default_rng([31, seed])
        waves = [(k, *(a * rng.normal(size=2))) for k, a in ((1, 3e-4), (2, 2e-4), (7, 2e-4))]
        lengths, offsets = 300.0 + rng.normal(size=2), 2e-3 * rng.normal(size=2)

        def measured(q: np.ndarray, rng: np.random.Generator, waves=waves, lengths=lengths, offsets=offsets):  # type: ignore[no-untyped-def]
            error = sum(a * np.cos(k * q) + b * np.sin(k * q) for k, a, b in waves) + offsets
            error[:, 1] += 1e-3 * np.cos(q[:, 0] + q[:, 1])
            z = np.exp(1j * np.cumsum(q + error, axis=1)) @ lengths + 5.0 * rng.normal() + 5j * rng.normal()
            return Measurements(q, np.column_stack([z.real, z.imag]) + SIGMA * rng.normal(size=q.shape))

        arm = Arm([300.0, 300.0], effects=(EffectSpec("base_offset"),))
        here = measured(rng.uniform([-2.0, -2.0], [0.0, 1.0], (150, 2)), rng)
        there = measured(rng.uniform([1.0, -2.0], [3.0, 1.0], (150, 2)), rng)
        search = HypothesisSearch(hypotheses(arm, frozenset()), Rows.of(here))
        curves = find_curves(replace(_found(here), search=search), here)
        if curves is None:
            continue
        extended = replace(
            curves.fit.model.arm, calibration=Calibration.of(*np.split(curves.fit.values[:4], 2), curves.fit.by_name)
        )
        plain = estimate(Model(arm), here).calibrated_arm()
        worse.append(validate(extended, there).model.rms / validate(plain, there).model.rms)
    assert len(worse) > 3
    assert max(worse) < 1.0 + 1e-3
