"""Positions of arms that are measured by lengths: what rigid motions make up for is no error of the tip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm, Calibration
from identification.errors import InputError
from identification.instruments import Distance
from identification.instruments.search import registered
from identification.kinematics.frames import pose
from identification.model import Model
from identification.model.placed import in_own_frame, of_positions, tip_jacobian
from tests.doe.six_axis import CHAIN

BAR = Arm(replace(CHAIN, instrument=Distance(), base=pose([-700.0, 200.0, -300.0])), sigma=0.01)
POSTURES = np.random.default_rng(0).uniform(-2.0, 2.0, (30, 6))


def test_the_same_parameters() -> None:
    model = Model(BAR)
    whole = of_positions(model)
    assert whole.names == model.names
    np.testing.assert_allclose(
        np.linalg.norm(whole.position(POSTURES), axis=1), model.position(POSTURES)[:, 0], rtol=1e-14
    )
    assert of_positions(whole) is whole


def test_what_is_left_after_registration() -> None:
    """Of a small change of each parameter: the RMS that the best rigid motion of the points leaves, found by Kabsch."""
    model = Model(BAR)
    found, whole = tip_jacobian(model, POSTURES), of_positions(model)
    before, step = whole.position(POSTURES), 1e-3
    for k, scale in enumerate(model.scales):
        change = np.zeros(len(model.names))
        change[k] = step / scale
        after = whole.position(POSTURES, change)
        motion = registered(before, after)
        left = after - before @ motion[:3, :3].T - motion[:3, 3]
        expected = np.sqrt(np.mean(np.sum(left**2, axis=1))) / change[k]
        assert np.sqrt(np.mean(np.sum(found[..., k] ** 2, axis=1))) == pytest.approx(expected, abs=1e-5 * scale)
    with pytest.raises(InputError, match="3 for the error of the tip from lengths, allowed: at least 4"):
        tip_jacobian(model, POSTURES[:3])


def test_of_a_tracker_as_it_is() -> None:
    model = Model(Arm(CHAIN))
    np.testing.assert_array_equal(tip_jacobian(model, POSTURES), model.jacobian(POSTURES))
    assert in_own_frame(model.arm) is model.arm


def test_in_the_frame_of_the_base() -> None:
    """The base drops out, the rest of the calibration stays."""
    values = {"base.x": 3.0, "translation_x:3": 0.5, "tool[1].z": 1.0}
    own = in_own_frame(replace(BAR, calibration=Calibration(values)))
    bare = Arm(CHAIN, calibration=Calibration({"translation_x:3": 0.5, "tool[1].z": 1.0}))
    np.testing.assert_allclose(Model(own).position(POSTURES), Model(bare).position(POSTURES), atol=1e-9)
