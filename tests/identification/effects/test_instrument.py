"""A constant in all measured distances: its derivative and what it moves by hand, and that fits find it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification import Arm, Calibration, EffectSpec, InputError, Measurements, Model, diagnose, estimate
from identification.instruments import TRACKER, Distance, Sphere
from identification.kinematics.frames import pose
from identification.model.placed import in_own_frame, tip_jacobian
from tests.doe.six_axis import CHAIN, REFLECTOR
from tests.identification.exponentials import Exponentials, drawing
from tests.identification.kinematics.test_spatial import tip_by_exponentials

OFFSET, C = EffectSpec("length_offset"), "length_offset.c"
BASE = pose([-700.0, 200.0, -300.0])
BAR = Arm(replace(CHAIN, instrument=Distance(), base=BASE), sigma=0.01)
Q = np.random.default_rng(0).uniform(-2.0, 2.0, (40, 6))


@pytest.mark.parametrize("more", [(), (EffectSpec("encoder_eccentricity", 2),)], ids=["alone", "beside another"])
def test_every_distance_is_longer_by_it(more: tuple[EffectSpec, ...]) -> None:
    """d = |p| + c: against products of exponentials, and its derivative is 1."""
    model = Model(BAR.with_effects(OFFSET, *more))
    read, jacobian = model.linearize(Q, model.parameters.vector({C: 2.5}))
    places = [tip_by_exponentials(replace(CHAIN, base=BASE), posture, {}, REFLECTOR) for posture in Q]
    np.testing.assert_allclose(read[:, 0], np.linalg.norm(places, axis=1) + 2.5, rtol=1e-12)
    np.testing.assert_allclose(jacobian[:, 0, model.names.index(C)], 1.0, rtol=1e-12)


def test_no_point_is_moved_by_it() -> None:
    """Neither errors of the tip nor positions in the arm's own frame depend on how a length is read."""
    model = Model(BAR.with_effects(OFFSET))
    moved, plain = tip_jacobian(model, Q, model.parameters.vector({C: 5.0})), tip_jacobian(Model(BAR), Q)
    assert not moved[..., model.names.index(C)].any()
    np.testing.assert_array_equal(np.delete(moved, model.names.index(C), axis=-1), plain)
    calibrated = replace(BAR.with_effects(OFFSET), calibration=Calibration({C: 5.0}))
    own = Model(in_own_frame(calibrated)).position(Q)
    np.testing.assert_array_equal(own, Model(in_own_frame(BAR)).position(Q))


def test_it_is_estimated_and_named() -> None:
    """Distances of an independent simulator, all 0.6 mm too long: the estimate is within four of its deviations, with a
    fit that leaves the noise; `diagnose` finds it without being told."""
    generator = np.random.default_rng(5)
    truth, q = Exponentials(generator), generator.uniform(-2.0, 2.0, (150, 6))
    center = truth.base[:3, :3] @ np.array([600.0, -200.0, 300.0]) + truth.base[:3, 3]
    read = np.linalg.norm(truth.poses(q)[:, :3, 3] - center, axis=1) + 0.6 + 0.02 * generator.standard_normal(150)
    data = Measurements(q, read[:, None])
    arm = Arm(replace(drawing(), instrument=Distance()), sigma=0.02)
    found = estimate(Model(arm.with_effects(OFFSET)), data)
    k = found.names.index(C)
    deviation = float(np.sqrt(found.covariance[k, k]))
    assert abs(found.parameters[k] - 0.6) < 4.0 * deviation < 0.2
    assert found.rms_after < 0.022
    assert diagnose(arm, data).named.effects == ("length_offset",)


def test_it_is_refused_where_no_distances_are_measured() -> None:
    for instrument, width in ((Sphere(30.0), 1), (TRACKER, 3)):
        arm = Arm(replace(CHAIN, instrument=instrument), effects=(OFFSET,))
        with pytest.raises(InputError, match="length_offset needs measured distances, allowed: an arm file with"):
            estimate(Model(arm), Measurements(Q, np.ones((40, width))))
    with pytest.raises(InputError, match="length_offset is of spatial arms"):
        _ = Model(Arm(np.array([300.0, 200.0]), effects=(OFFSET,))).effects
