"""A six-axis arm with gravity and three reflectors: what is hidden in it is named, and the posture's own error found."""

from __future__ import annotations

import numpy as np

from identification.gap.diagnose import diagnose
from tests.small_arm import OTHERS, drawn_arm, measured, random_postures, small_arm


def test_effects_of_an_arm_that_sags_with_three_reflectors_at_each_posture() -> None:
    """Compliance, two encoders and play beside 0.02 mm of noise of each row and 0.03 mm of each posture."""
    rng = np.random.default_rng(5)
    data = measured(small_arm(rng, *OTHERS), random_postures(100, rng), rng)
    found = diagnose(drawn_arm(), data)
    hidden = {"joint_compliance", *(f"{name}:{joint}" for name, joint, _ in OTHERS)}
    assert set(found.named.keys) == hidden
    assert found.verdict == "named"
    assert [finding.name for finding in found.scatter] == ["repeats"]
    # three reads of a posture tell its error from that of a row: 0.03^2 / 0.02^2 = 2.25 on a grid of factors of 4
    assert 0.5 < found.scatter[0].size < 9.0
