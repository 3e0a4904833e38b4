"""The next postures of an ambiguous diagnosis in space: where rivals stand apart, seen from the base that was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from doe.discrimination.t_optimal import discriminate
from identification.arm import Arm
from identification.gap.diagnose import diagnose
from identification.kinematics.chain import DHRow, chain_of
from identification.kinematics.frames import from_roll_pitch_yaw, pose
from identification.measurements import Measurements, rms_distance
from identification.model import Model

ROWS = [DHRow(0.0, np.pi / 2.0, 300.0), DHRow(400.0, 0.1, 20.0), DHRow(350.0, -1.0, 10.0)]
CHAIN = chain_of(ROWS)
STANDS = replace(
    CHAIN, tools={"1": np.array([40.0, 30.0, 20.0])}, base=pose((2e3, 5.0, -1.0), from_roll_pitch_yaw(0.1, 0.2, 2))
)
SIGMA = 0.1


def test_rivals_are_told_apart_where_they_differ() -> None:
    """Joints that move by 46 degrees to either side: an eccentric encoder looks like a wrong gear ratio there."""
    generator = np.random.default_rng(2)
    postures = generator.uniform(-0.8, 0.8, (16, 3))
    real = postures + np.eye(3)[1] * 2e-3 * np.cos(postures[:, 1:2] - 1.2)
    exact = Model(Arm(STANDS)).position(real)
    data = Measurements(postures, exact + SIGMA * generator.standard_normal((16, 3)))
    found = diagnose(Arm(CHAIN, sigma=SIGMA), data)
    assert found.verdict == "ambiguous"
    chosen = discriminate(found.arm, found, data, 4, seed=0)
    rivals = [Model(found.extended_arm(candidate)) for candidate in found.candidates]
    for rival in rivals:  # each stands where the data say, and fits them as well as the noise lets it
        assert rms_distance(rival.position(postures) - data.positions) < SIGMA * np.sqrt(3.0)
    first, second = (rival.position(chosen.plan.postures) for rival in rivals[:2])
    anywhere = generator.uniform(-np.pi, np.pi, (200, 3))
    usual = rivals[0].position(anywhere) - rivals[1].position(anywhere)
    assert rms_distance(first - second) > rms_distance(usual)
    assert all(size > 0.0 for size in chosen.pairs.values())
    assert list(chosen.columns) == ["run", "q1_deg", "q2_deg", "q3_deg"]
    assert np.shape(chosen.to_json()["postures_deg"]) == (4, 3)
    sliding = replace(chosen, plan=replace(chosen.plan, joint_types=("revolute", "prismatic", "revolute")))
    assert list(sliding.columns) == ["run", "q1_deg", "q2_mm", "q3_deg"]
