"""Relaxation, IPOPT and closed form give one answer, each on its own way."""

from __future__ import annotations

import numpy as np
import pytest

from doe import DesignProblem
from doe.bounds.column_generation import relax
from doe.cross_check import cross_check
from identification import Arm, EffectSpec, Model
from tests.doe.arms import ECCENTRICITY, FIVE, problem

# doe/README.md, "Planar theorem": only joint 3 with 160 deg is too narrow, 2 log(sin 80 deg) for each of its two links
EXPECTED = 4.0 * np.log(np.sin(np.radians(80.0)))


def test_three_answers_agree() -> None:
    lower, upper = np.radians([-180, -120, -100, -90]), np.radians([180, 120, 60, 90])
    case = DesignProblem.of(Model(Arm([260.0, 180.0, 120.0, 100.0], lower=lower, upper=upper)))
    relaxed = relax(case, 5, "clarabel")
    found = cross_check(case, relaxed, 8)
    methods = ["relaxation, clarabel", "column generation, column_generation", "exact plan, exchange", "closed form"]
    assert [row["method"] for row in found] == methods
    for row, tolerance in zip(found, (1e-4, 1e-8, 1e-7, 1e-12), strict=True):
        assert row["value"] == pytest.approx(EXPECTED, abs=tolerance)


def test_what_time_cut_is_said_to_be() -> None:
    """Bounds as well as plans."""
    case = problem(FIVE, ECCENTRICITY, EffectSpec("gear_ratio", 3))
    found = cross_check(case, relax(case, 3, stop=lambda: True), 12, seconds=0.05)
    assert all(", bound cut" in row["method"] for row in found)
