"""What no plan can do is said before a search, or after it with the reason."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from doe.solvers import solve
from identification.arm import Arm, EffectSpec
from identification.errors import InputError, JobError
from identification.running import Status
from tests.doe.arms import FOUR, problem


def test_what_no_posture_tells_apart_is_named() -> None:
    lost = {
        "base_rotation": r"joint_offset:1 \+ base_rotation.angle",
        "base_drift": "base_drift.vx; base_drift.vy",
    }
    for name, combination in lost.items():
        with pytest.raises(JobError, match=f"no posture distinguishes: {combination}"):
            solve(problem(FOUR, EffectSpec(name)), 12, "random")


def test_candidates_that_cannot_identify_are_no_plan() -> None:
    """One posture gives two equations; det M is 0 but for rounding, whatever the angles."""
    for posture in ([0.0, 0.0, 0.0, 0.0], [0.3, 0.7, -0.5, 0.2]):
        case = problem(FOUR, choices=np.array([posture]), minimum_distance=0.0)
        with pytest.raises(JobError, match="1 candidates cannot identify all 8 parameters"):
            solve(case, 8, starts=5)
    assert solve(case, 8, starts=5, throw=False).status is Status.not_identifiable


def test_no_information_is_never_a_bound_reached() -> None:
    """Links of a metre's millionth between links of a kilometre: their offsets drown in rounding."""
    case = problem(Arm([1e6, 1e-3, 1e6, 1e-3]))
    design = solve(case, 8, throw=False)
    assert (design.value, design.status) == (-np.inf, Status.not_identifiable)


@pytest.mark.parametrize("runs", [8.0, "8", None, True, np.float64(8.0)])
def test_runs_are_a_whole_number(runs: Any) -> None:
    with pytest.raises(InputError, match=r"runs: .*allowed: a whole number"):
        solve(problem(FOUR), runs)
