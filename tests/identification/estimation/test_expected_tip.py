"""How far the tip may be off: against complex exponentials written out, against repeated experiments, and said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm
from identification.estimation import estimate, estimate_batch
from identification.estimation.expected_tip import expected_tip, size_left_open, working_postures
from identification.kinematics.instrument import Instrument
from identification.kinematics.joint_range import joint_range
from identification.measurements import Measurements
from identification.model import Model
from tests.doe.six_axis import CHAIN
from tests.identification.estimation.cases import LENGTHS, SIGMA, arm, data, plan, truth


def limited(sigma: float | None = SIGMA) -> Arm:
    return replace(arm(sigma=sigma), lower=np.full(4, -2.0), upper=np.full(4, 2.0))


def test_the_covariance_is_carried_to_the_tip() -> None:
    """Oracle: of z = sum l_j exp(i theta_j) the derivative is exp(i theta_j) by l_j, i sum_(k>=j) l_k exp(i theta_k) by
    q_j; the variance of both coordinates is the sum over p, q of C_pq Re(conj(d_p) d_q)."""
    model, rng = Model(limited()), np.random.default_rng(4)
    postures, root = plan(7, seed=3), rng.normal(size=(8, 8)) * np.r_[np.full(4, 0.1), np.full(4, 1e-3)][:, None]
    errors = truth(model)
    covariance, total = root @ root.T, 0.0
    lengths = np.array(LENGTHS) + errors[:4]
    for q in postures + errors[4:]:
        unit = np.exp(1j * np.cumsum(q))
        slopes = np.r_[unit, [1j * np.sum((lengths * unit)[j:]) for j in range(4)]]
        total += sum(covariance[a, b] * (slopes[a].conj() * slopes[b]).real for a in range(8) for b in range(8))
    assert expected_tip(model, errors, covariance, postures) == pytest.approx(np.sqrt(total / 7.0), rel=1e-10)


def test_it_is_the_error_that_repeated_experiments_show() -> None:
    """400 data sets of 12 rows, each fitted; the mean square of 400 x 200 distances is within 4 standard errors of it.

    The distances of one data set go together, so their mean square is one draw: relative standard error
    sqrt(2 / 400 / effective), with 8 parameters no more than sqrt(2 / 400) = 0.07 of the mean square.
    """
    model = Model(limited())
    found = estimate(model, data(model, plan(12)), sigma=SIGMA)
    where = np.random.default_rng(11).uniform(-2.0, 2.0, (200, 4))
    positions = np.array([data(model, plan(12), seed=s).positions for s in range(400)])
    fits = estimate_batch(model, plan(12), positions).parameters
    squares = np.sum((model.position(where, fits) - model.position(where, truth(model))) ** 2, axis=-1)
    assert found.expected_tip**2 == pytest.approx(np.mean(squares), rel=4.0 * np.sqrt(2.0 / 400.0))


def test_few_measurements_are_said_and_many_are_not() -> None:
    model = Model(limited())
    near = np.random.default_rng(5).normal(0.0, 0.1, (5, 4))  # five postures, nearly the same
    alike, many = (estimate(model, data(model, postures), sigma=SIGMA) for postures in (near, plan(30)))
    assert alike.expected_tip > 10.0 * many.expected_tip
    assert [said.partition(" the tip may be ")[0] for said in alike.warnings] == ["outside the angles measured"]
    again = estimate(Model(many.calibrated_arm()), data(model, plan(6)), sigma=SIGMA)
    assert again.expected_tip_measured > 0.5 * again.rms_before
    assert again.warnings == ()  # the arm was right before: what it was off is noise
    few = estimate(model, data(model, plan(4)), sigma=60.0 * SIGMA)
    assert [said.partition(":")[0] for said in few.warnings] == ["too few measurements"]
    assert many.warnings == ()
    assert many.to_json()["expected_tip_mm"] == many.expected_tip
    assert f"{many.expected_tip:.4g} mm over the joint limits" in str(many)
    assert many.to_json()["expected_tip_measured_mm"] == pytest.approx(many.expected_tip, rel=0.2)  # nearly all angles


def test_a_joint_without_limits_counts_where_it_was_measured() -> None:
    one = replace(arm(), lower=np.array([-np.pi, -1.0, -np.pi, -np.pi]), upper=np.array([np.pi, 0.5, np.pi, np.pi]))
    rows = Measurements(plan(20) * 0.5, np.zeros((20, 2)))
    postures = working_postures(one, joint_range(rows.postures, one.joint_types), measured=False)
    low, high = rows.postures.min(axis=0), rows.postures.max(axis=0)
    low[1], high[1] = -1.0, 0.5
    np.testing.assert_allclose(postures.min(axis=0), low, atol=0.02)
    np.testing.assert_allclose(postures.max(axis=0), high, atol=0.02)
    inside = working_postures(one, joint_range(rows.postures, one.joint_types), measured=True)
    assert np.all((inside >= rows.postures.min(axis=0)) & (inside <= rows.postures.max(axis=0)))


def test_what_is_not_identifiable_has_no_expected_error() -> None:
    model = Model(limited())
    found = estimate(model, data(model, np.tile(plan(1), (6, 1))))
    assert found.not_identifiable
    assert (found.expected_tip, found.to_json()["expected_tip_mm"]) == (None, None)


@pytest.mark.parametrize(
    ("instrument", "said"),
    [
        (Instrument("distance"), ""),
        (Instrument("sphere", 15.0), ""),
        (Instrument("sphere"), "give radius_mm"),
        (Instrument("plane"), "only [machining] tells"),
    ],
)
def test_where_more_postures_do_not_show_the_size(instrument: Instrument, said: str) -> None:
    """An arm twice as large touches planes, and spheres twice as large, at the same postures."""
    found = size_left_open(Arm.of_chain(replace(CHAIN, instrument=instrument)))
    assert found.endswith(said)
    assert bool(found) == bool(said)
    assert size_left_open(limited()) == ""
