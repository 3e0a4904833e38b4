"""Frames, bases and lengths that are not as the arm file says: each with its size, and nothing of data that are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification import Arm, Measurements
from identification.inspection.inspection import other_frame
from identification.inspection.readings import read_differently
from identification.kinematics.chain import BASE
from identification.kinematics.frames import rotation_about
from tests.identification.exponentials import Exponentials, drawing


def frame_note(arm: Arm, data: Measurements) -> list[str]:
    return other_frame(arm, read_differently(arm, data).written)


def test_a_base_that_stands_elsewhere() -> None:
    """Known to stand somewhere, found 60 degrees and 500 mm from there; a base that is left out is nowhere wrong."""
    generator = np.random.default_rng(2)
    truth, q = Exponentials(generator), generator.uniform(-2.0, 2.0, (60, 6))
    data = Measurements(q, truth.poses(q)[:, :3, 3] + 0.05 * generator.standard_normal((60, 3)))
    away = truth.base.copy()
    away[:3, :3] = rotation_about([0.0, 1.0, 0.0], np.radians(60.0)) @ away[:3, :3]
    away[2, 3] += 500.0
    chain = replace(drawing(), base=away, settled=frozenset({BASE}))
    (said,) = frame_note(Arm(chain), data)
    assert "another frame than [base] says: turned by " in said
    turn, shift = (float(said.split(word)[1].split()[0]) for word in ("turned by ", "deg and "))
    assert turn == pytest.approx(60.0, abs=0.5)
    assert shift == pytest.approx(500.0, abs=5.0)
    assert "zero of joint 1" not in said
    assert frame_note(Arm(replace(chain, base=truth.base)), data) == []
    assert frame_note(Arm(drawing()), data) == []
