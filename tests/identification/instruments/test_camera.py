"""A camera that stands anywhere, as someone would add it who has read "How to add an instrument": one class."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from identification import Arm, Calibration, EffectSpec, Model, Status, diagnose, estimate
from identification.document import in_a_sentence
from identification.documents.pictures import gap_figure
from identification.instruments import Coordinate, Instrument
from identification.kinematics.frames import from_angles, pose
from identification.simulate import simulate
from identification.validate import validate
from tests.doe.six_axis import CHAIN


@dataclass(frozen=True)
class Camera(Instrument):
    """A pinhole camera, its z axis the line of sight: two coordinates [px] of a point's picture.

    focal : length [px]
    """

    focal: float = 2000.0
    coordinates = (Coordinate("u", "pixel"), Coordinate("v", "pixel"))
    size_is_open = "pictures of one camera", "only [machining] tells"  # of an arm twice as large, twice as far away

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return self.focal * point[:2] / point[2]


BASE = pose([100.0, -200.0, 3000.0], from_angles((1.2, -0.4, 2.0)))
SIGMA = 0.1  # [px], some 0.15 mm


def test_a_camera_with_unknown_base() -> None:
    generator = np.random.default_rng(1)
    q = generator.uniform(-2.0, 2.0, (80, 6))
    errors = {f"joint_offset:{j}": 3e-3 for j in range(2, 6)} | {"translation_x:3": 0.8, "rotation_y:4": 2e-3}
    eccentric = EffectSpec("encoder_eccentricity", 3, {"a": 1e-3, "b": 5e-4})
    chain = replace(CHAIN, instrument=Camera(), base=BASE)
    truth = Arm(chain, sigma=SIGMA, effects=(eccentric,), calibration=Calibration(errors))
    data = simulate(truth, q, generator)
    arm = Arm(replace(CHAIN, instrument=Camera(), base=np.eye(4), tools={"1": np.zeros(3)}), sigma=SIGMA)
    found = estimate(Model(arm.with_effects(EffectSpec("encoder_eccentricity", 3))), data)
    assert found.status is Status.converged
    fitted = f"from {in_a_sentence(found.rms_before)} px (drawing, after fitting where the arm stands) to"
    assert f"{fitted} {in_a_sentence(found.rms_after)} px" in " ".join(str(found).split())
    assert found.chi2 is not None
    assert abs(found.chi2 - found.dof) < 4.0 * np.sqrt(2.0 * found.dof)
    diagnosis = diagnose(arm, data)
    assert diagnosis.named.effects == ("encoder_eccentricity:3",)
    assert all(" px" in gap_figure(diagnosis).axes[k].get_title() for k in (0, 1))
    assert "On the data, with the geometry fitted, the RMS error goes from" in (
        text := " ".join(str(diagnosis).split())
    )
    assert f"to {in_a_sentence(diagnosis.gap.rms_after)} px;" in text
    judged = validate(found.calibrated_arm(), data)
    assert f"to {judged.model.rms:.3f} px" in " ".join(str(judged).split())
