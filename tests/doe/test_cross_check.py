"""Relaxation, IPOPT and closed form give one answer, each on its own way."""

from __future__ import annotations

import numpy as np
import pytest

from doe.bounds.column_generation import relax
from doe.cross_check import cross_check
from doe.problem.problem import DesignProblem
from identification.arm import Arm
from identification.model import Model
from identification.running import Status

# doe/README.md, "Planar theorem": only joint 3 with 160 deg is too narrow, 2 log(sin 80 deg) for each of its two links
EXPECTED = 4.0 * np.log(np.sin(np.radians(80.0)))


def test_three_answers_agree() -> None:
    lower, upper = np.radians([-180, -120, -100, -90]), np.radians([180, 120, 60, 90])
    problem = DesignProblem.of(Model(Arm([260.0, 180.0, 120.0, 100.0], lower=lower, upper=upper)))
    relaxed = relax(problem, 5, "clarabel")
    found = cross_check(problem, relaxed, 8)
    assert found.exact.solver == "exchange_ipopt"
    for value in (relaxed.value, found.exact.value, found.closed_form):
        assert value == pytest.approx(EXPECTED, abs=1e-4)
    assert found.continuous is not None
    assert found.continuous.value == pytest.approx(EXPECTED, abs=1e-8)
    assert found.exact.value == pytest.approx(EXPECTED, abs=1e-7)
    assert len(found.rows()) == 4
    assert found.truncation_note == ""


def test_a_long_search_is_cut_and_says_so() -> None:
    """Seven runs cannot reach the bound (an odd number), so that the search would use all its starts."""
    lower, upper = np.radians([-180, -120, -100, -90]), np.radians([180, 120, 60, 90])
    problem = DesignProblem.of(Model(Arm([260.0, 180.0, 120.0, 100.0], lower=lower, upper=upper)))
    found = cross_check(problem, relax(problem, 5, "clarabel"), 7, seconds=0.01)
    assert found.exact.status is Status.time_limit
    assert found.rows()[2]["method"] == "exact plan, exchange_ipopt, cut at 0 s"
