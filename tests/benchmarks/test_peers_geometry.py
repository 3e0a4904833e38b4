"""What judges the peers' answers agrees with the package: log det and positions, and one tool in its process."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from doe.problem.problem import DesignProblem
from identification.model import Model
from identification.model.minimal import minimal
from tests.benchmarks.peers.approximate import grid
from tests.benchmarks.peers.exact import symbolic_rows
from tests.benchmarks.peers.geometry import ARMS, Screws
from tests.benchmarks.peers.identification import placed
from tests.benchmarks.peers.table import answer_of
from tests.doe.arms import FOUR, SIX, problem
from tests.doe.six_axis import REFLECTOR, SIX_AXIS


@pytest.mark.parametrize("name", list(ARMS))
def test_log_det_but_for_a_constant(name: str) -> None:
    """In space the parameters are others, and so their units: the constant is the same for all plans."""
    arm, generator = ARMS[name], np.random.default_rng(0)
    case = {"4 links": lambda: problem(FOUR), "6 links": lambda: problem(SIX)}.get(
        name, lambda: DesignProblem.of(minimal(Model(SIX_AXIS)))
    )()
    plans = [arm.random(30, generator) for _ in range(3)]
    apart = np.array([arm.log_det(plan) - case.objective(plan) for plan in plans])
    np.testing.assert_allclose(apart, apart[0] if isinstance(arm, Screws) else 0.0, atol=1e-9)


def test_positions() -> None:
    arm = ARMS["6 axes"]
    assert isinstance(arm, Screws)
    q, model = arm.random(20, np.random.default_rng(1)), Model(SIX_AXIS)
    np.testing.assert_allclose(arm.positions(q), model.position(q, model.values), atol=1e-9)


@pytest.mark.parametrize("name", list(ARMS))
def test_rows_that_casadi_differentiates(name: str) -> None:
    import casadi as ca

    arm = ARMS[name]
    q = arm.random(2, np.random.default_rng(2))
    symbol = ca.SX.sym("q", q.shape[1])
    rows = ca.Function("rows", [symbol], [symbolic_rows(arm, symbol)])
    np.testing.assert_allclose([rows(one).full() for one in q], arm.rows(q), atol=1e-9)


def test_gap_of_uniform_weights() -> None:
    """Of candidates that span the limits, max d - p by the definition."""
    arm = ARMS["4 links"]
    q = grid(arm, 3)  # type: ignore[arg-type]
    weights = np.full(len(q), 1.0 / len(q))
    rows = arm.rows(q)
    information = sum(row.T @ row for row in rows) / len(q)
    largest = max(np.trace(row @ np.linalg.solve(information, row.T)) for row in rows)
    assert arm.gap(q, weights) == pytest.approx(largest - 8.0, abs=1e-9)


def test_base_and_reflector_of_exact_rows() -> None:
    arm, base = ARMS["6 axes"], np.eye(4)
    assert isinstance(arm, Screws)
    base[:3, :3] = [[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]]
    base[:3, 3] = [2000.0, -300.0, 500.0]
    q = arm.random(40, np.random.default_rng(3))
    found, tool = placed(q, arm.positions(q) @ base[:3, :3].T + base[:3, 3])
    np.testing.assert_allclose(found, base, atol=1e-6)
    np.testing.assert_allclose(tool, REFLECTOR, atol=1e-6)


def test_a_process_and_an_absent_tool(tmp_path: Path) -> None:
    job = {"arm_name": "4 links", "runs": 8, "budget": 0.0}
    found = answer_of(tmp_path, "exact", "armcal", ("doe.solvers",), **job)
    assert isinstance(found, dict)
    assert ARMS["4 links"].log_det(found["plan"]) == pytest.approx(ARMS["4 links"].bound, abs=1e-6)  # type: ignore[union-attr]
    assert answer_of(tmp_path, "exact", "armcal", ("no_such_tool",), **job) == "not installed"
