"""armcal against what people use instead, as Markdown tables: `pytest -m benchmark -s tests/benchmarks/test_peers.py`.

`pip install -e '.[tests,peers]'` brings the peers that live with numpy 2; pybotics and robotkinecal want numpy 1, in an
environment of their own, whose Python is named by ARMCAL_PEERS (several with a colon between). What is not installed
is said. Values are ours, computed from plans, weights and axes that a tool returns (peers/arms.py); times are
processor times of one core without imports, peaks those of a whole process. A process ends after
ARMCAL_PEERS_SECONDS (600). Rows of a UR10: all of series A and C where they are in ../shared/data/ur10 or in the folder
ARMCAL_UR10, else the samples in tests/data/ur10. Without `-m benchmark` what judges the answers is tested.
"""

import os
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from doe import DesignProblem
from doe.bounds.column_generation import continuous_design
from identification import Model, load_arm, load_measurements
from tests.benchmarks.peers.arms import ARMS, AXES, FOUR, Planar, Screws
from tests.benchmarks.peers.fits import placed
from tests.benchmarks.peers.plans import described, symbolic_rows
from tests.benchmarks.peers.table import Answer, answer_of, compared
from tests.benchmarks.test_ur10 import halves, rms
from tests.doe.six_axis import REFLECTOR, SIX_AXIS

SAMPLE = Path(__file__).parents[1] / "data/ur10"
SHARED = Path(os.environ.get("ARMCAL_UR10", Path(__file__).parents[3] / "shared/data/ur10"))
MARGIN = 0.01  # nobody is better than that
BUDGET = 5.0  # [s] of random starts


def bound_of(name: str, runs: int) -> float:
    """What no plan exceeds: by theory in the plane, in space by column generation, in the units of arms.py, where
    parameters are others, which adds a constant for all plans."""
    arm, case = ARMS[name], DesignProblem.of(described(ARMS[name]))
    plans = [arm.random(runs, np.random.default_rng(seed)) for seed in range(3)]
    constant, *others = (arm.log_det(plan) - case.objective(plan) for plan in plans)
    np.testing.assert_allclose(others, constant, atol=1e-9)
    if isinstance(arm, Planar):
        return arm.bound + constant
    return continuous_design(case, runs=runs, tolerance=1e-3, proof=1e-3).bound.value + constant


def nobody_better(errors: list[float], margin: float) -> None:
    """armcal's comes first; the smaller the better."""
    assert np.isfinite(errors[0])
    assert min(errors) >= errors[0] - margin


@pytest.mark.benchmark
@pytest.mark.parametrize(
    ("name", "runs", "left_out"), [("4 links", 20, ()), ("6 links", 20, ("Pyomo.DoE",)), ("6 axes", 30, ("Pyomo.DoE",))]
)
def test_exact_plan(name: str, runs: int, left_out: tuple[str, ...], tmp_path: Path) -> None:
    arm, bound = ARMS[name], bound_of(name, runs)

    def judged(answer: Answer) -> tuple[float, str, str]:
        value = arm.log_det(answer["plan"])
        efficiency = float(np.exp((value - bound) / arm.parameters))
        time = f"{answer['seconds']:.2f} s, the best of {answer['starts']}"  # when it was found
        return -efficiency, f"{max(bound - value, 0.0):.1e} below the bound, efficiency {efficiency:.6f}", time

    title = f"Exact plan, {name}, m = {runs}, random starts for {BUDGET:g} s"
    errors = compared(tmp_path, title, "plans.EXACT", judged, left_out, arm_name=name, runs=runs, budget=BUDGET)
    nobody_better(errors, MARGIN)


@pytest.mark.benchmark
@pytest.mark.parametrize("levels", [22, 100])
def test_approximate_design(levels: int, tmp_path: Path) -> None:
    candidates = FOUR.grid(levels)

    def judged(answer: Answer) -> tuple[float, str, str]:
        gap, value = FOUR.gap(candidates, answer["weights"]), FOUR.log_det(candidates, answer["weights"])
        return -value, f"log det {value:.7f}, gap {gap:.1e}", f"{answer['seconds']:.2f} s"

    title = f"Weights on {len(candidates):,} candidates, 4 links"
    nobody_better(compared(tmp_path, title, "plans.WEIGHTS", judged, levels=levels), MARGIN * FOUR.parameters)


@pytest.mark.benchmark
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("series", ["C", "A"])
def test_identification(series: str, tmp_path: Path) -> None:
    folder = SHARED if SHARED.exists() else SAMPLE
    data = load_measurements(folder / f"series_{series}.csv", load_arm(SAMPLE / "ur10.toml"))
    fitted, held = halves(data)
    np.savez(tmp_path / "rows.npz", q=fitted.postures, x=fitted.positions)

    def judged(answer: Answer) -> tuple[float, str, str]:
        chain = Screws(answer["axes"], answer["points"], answer["tip"], np.zeros(0), np.zeros(0))
        left = rms(chain.positions(held.postures) - held.positions)
        return left, f"{left:.4f} mm held out", f"{answer['seconds']:.2f} s, the first {answer['first']:.2f} s"

    title = f"UR10, series {series}: {len(fitted)} rows fitted, {len(held)} held out"
    errors = compared(tmp_path, title, "fits.SPACE", judged, rows=str(tmp_path / "rows.npz"))
    nobody_better(errors, MARGIN * errors[0])


# -- what judges agrees with the package -------------------------------------------------------------------------------
def test_judges() -> None:
    """Rows for IPOPT and SLSQP are those that judge them; max d - p by the definition; positions in space, and base and
    reflector of exact rows."""
    for arm in ARMS.values():
        q, symbol = arm.random(30, np.random.default_rng(0)), ca.SX.sym("q", len(arm.lower))
        rows = ca.Function("rows", [symbol], [symbolic_rows(arm, symbol)])
        np.testing.assert_allclose([rows(one).full() for one in q], arm.rows(q), atol=1e-9)
    table = FOUR.rows(q := FOUR.grid(3))
    information = sum(row.T @ row for row in table) / len(q)
    largest = max(np.trace(row @ np.linalg.solve(information, row.T)) for row in table)
    assert FOUR.gap(q, np.full(len(q), 1.0 / len(q))) == pytest.approx(largest - 8.0, abs=1e-9)
    q, model, base = AXES.random(40, np.random.default_rng(3)), Model(SIX_AXIS), np.eye(4)
    np.testing.assert_allclose(AXES.positions(q), model.position(q, model.values), atol=1e-9)
    base[:3] = [[0.0, -1.0, 0.0, 2000.0], [0.6, 0.0, -0.8, -300.0], [0.8, 0.0, 0.6, 500.0]]
    pose, tool = placed(q, AXES.positions(q) @ base[:3, :3].T + base[:3, 3])
    np.testing.assert_allclose(pose, base, atol=1e-6)
    np.testing.assert_allclose(tool, REFLECTOR, atol=1e-6)


def test_a_process_and_an_absent_tool(tmp_path: Path) -> None:
    job = {"arm_name": "4 links", "runs": 8, "budget": 0.0}
    answer = answer_of(tmp_path, "plans.EXACT", "armcal", ("doe.solvers",), **job)
    assert isinstance(answer, dict)
    assert FOUR.log_det(answer["plan"]) == pytest.approx(bound_of("4 links", 8), abs=1e-6)
    assert answer_of(tmp_path, "plans.EXACT", "armcal", ("no_such_tool",), **job) == "not installed"
