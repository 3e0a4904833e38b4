"""The exact-design table of issues 2 and 3: values only; times are in `tests/benchmarks/test_design_speed.py`."""

from __future__ import annotations

import pytest

from doe.solvers import solve
from identification.arm import Arm
from tests.doe.arms import FIVE, FOUR, SIX, problem
from tests.doe.bounds.test_planar_theorem import complex_log_det


@pytest.mark.parametrize("runs", [4, 8, 12, 16, 20])
def test_four_links_where_the_bound_is_attained(runs: int) -> None:
    design = solve(problem(FOUR), runs)
    assert complex_log_det(design.plan.postures) == pytest.approx(-0.0612353259, abs=1e-9)
    assert design.certified_optimal


@pytest.mark.parametrize(
    ("arm", "runs", "value", "starts"),
    [
        (FOUR, 5, -0.28087, None), (FOUR, 6, -0.29680, None), (FOUR, 7, -0.19865, None), (FOUR, 9, -0.13103, None),
        (FOUR, 10, -0.14288, None), (FOUR, 14, -0.10247, None), (FOUR, 18, -0.08608, None),
        (FIVE, 5, -1.358410, None), (FIVE, 8, -0.704661, 100), (FIVE, 11, -0.830502, None), (FIVE, 16, -0.704178, None),
        (SIX, 12, -1.433950, 250), (SIX, 20, -1.3515, 200), (SIX, 32, -1.2994579, None),
    ],
)  # fmt: skip
def test_best_known_values(arm: Arm, runs: int, value: float, starts: int | None) -> None:
    """At least the best value known, to the digits it is printed with (doe/README.md, "Exact plans").

    `starts` smaller than the default keep this quick where the default spends seconds to make sure.
    """
    digits = 1e-5 if arm is FOUR else 1e-6
    assert complex_log_det(solve(problem(arm), runs, starts=starts).plan.postures) >= value - digits


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_six_links_eight_runs(seed: int) -> None:
    """The hardest of the table: few of the starts lead there."""
    assert complex_log_det(solve(problem(SIX), 8, seed=seed).plan.postures) >= -1.624468
