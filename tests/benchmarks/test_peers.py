"""armcal against what people use instead, as Markdown tables: `pytest -m benchmark -s tests/benchmarks/test_peers.py`.

`pip install -e '.[tests,peers]'` brings the peers that live with numpy 2; pybotics and robotkinecal want numpy 1, in an
environment of their own, whose Python is named by ARMCAL_PEERS (several with a colon between). What is not installed
is said. Values are ours, computed from plans, weights and axes that a tool returns (peers/geometry.py); times are
processor times of one core without imports, peaks those of a whole process. A process ends after
ARMCAL_PEERS_SECONDS (600). Rows of a UR10: all of series A and C where they are in ../shared/data/ur10 or in the folder
ARMCAL_UR10, else the samples in tests/data/ur10.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doe.bounds.column_generation import continuous_design
from doe.problem.problem import DesignProblem
from identification.files.arm import load_arm
from identification.gap.confirmation import split
from identification.measurements import load_measurements
from identification.model import Model
from identification.model.minimal import minimal
from tests.benchmarks.peers.approximate import grid
from tests.benchmarks.peers.geometry import ARMS, Planar, Screws
from tests.benchmarks.peers.planar_identification import TRUTH, positions
from tests.benchmarks.peers.table import Row, compared
from tests.doe.six_axis import SIX_AXIS

pytestmark = [pytest.mark.benchmark, pytest.mark.filterwarnings("ignore")]

SAMPLE = Path(__file__).parents[1] / "data/ur10"
SHARED = Path(os.environ.get("ARMCAL_UR10", Path(__file__).parents[3] / "shared/data/ur10"))
MARGIN = 0.01  # nobody is better than that
BUDGET = 5.0  # [s] of random starts


def bound_of(name: str, runs: int) -> float:
    """What no plan exceeds: by theory in the plane, in space by column generation, in the units of geometry.py."""
    arm = ARMS[name]
    if isinstance(arm, Planar):
        return arm.bound
    problem = DesignProblem.of(minimal(Model(SIX_AXIS)))
    plan = arm.random(runs, np.random.default_rng(0))
    constant = arm.log_det(plan) - problem.objective(plan)
    return continuous_design(problem, runs=runs, tolerance=1e-3, proof=1e-3).bound.value + constant


@pytest.mark.parametrize(
    ("name", "runs", "left_out"),
    [
        ("4 links", 20, ("figaroh SOCP",)),
        ("6 links", 20, ("figaroh SOCP", "Pyomo.DoE")),
        ("6 axes", 30, ("Pyomo.DoE",)),
    ],
)
def test_exact_plan(name: str, runs: int, left_out: tuple[str, ...], tmp_path: Path) -> None:
    arm, bound = ARMS[name], bound_of(name, runs)

    def judged(found: dict[str, Any]) -> tuple[float, str, str]:
        value = arm.log_det(found["plan"])
        efficiency = float(np.exp((value - bound) / arm.parameters))
        time = f"{found['seconds']:.2f} s, the best of {found['starts']}"  # when it was found
        return efficiency, f"{max(bound - value, 0.0):.1e} below the bound, efficiency {efficiency:.6f}", time

    title = f"Exact plan, {name}, m = {runs}, random starts for {BUDGET:g} s"
    rows = compared(tmp_path, title, "exact", judged, arm_name=name, runs=runs, budget=BUDGET, left_out=left_out)
    nobody_better([-1.0 if row.value is None else -row.value for row in rows])


@pytest.mark.parametrize("levels", [22, 47, 100])
def test_approximate_design(levels: int, tmp_path: Path) -> None:
    arm = ARMS["4 links"]
    candidates = grid(arm, levels)

    def judged(found: dict[str, Any]) -> tuple[float, str, str]:
        gap = arm.gap(candidates, found["weights"])
        value = arm.log_det(candidates, found["weights"])
        return value, f"log det {value:.7f}, gap {gap:.1e}", f"{found['seconds']:.2f} s"

    title = f"Weights on {len(candidates):,} candidates, 4 links"
    rows = compared(tmp_path, title, "approximate", judged, arm_name="4 links", levels=levels)
    best = max(row.value for row in rows if row.value is not None)
    assert rows[0].value is not None
    assert rows[0].value >= best - MARGIN * arm.parameters


def test_planar_identification(tmp_path: Path) -> None:
    """RMS over fresh postures and data sets of the distance to the true arm."""
    postures = ARMS["4 links"].random(200, np.random.default_rng(2))
    exact = positions(TRUTH, postures)

    def judged(found: dict[str, Any]) -> tuple[float, str, str]:
        missed = np.array([positions(values, postures) - exact for values in found["parameters"]])
        left = rms(missed.reshape(-1, 2))
        return left, f"{left:.5f} mm left", f"{found['seconds']:.3f} s"

    rows = compared(tmp_path, "1,000 data sets of 20 rows, 4 links", "planar_identification", judged, sets=1000)
    nobody_better(values_of(rows))


@pytest.mark.parametrize("series", ["C", "A"])
def test_identification(series: str, tmp_path: Path) -> None:
    folder = SHARED if SHARED.exists() else SAMPLE
    arm = load_arm(SAMPLE / "ur10.toml")
    fitted, held = split(load_measurements(folder / f"series_{series}.csv", arm), 0.5, np.random.default_rng(0))
    np.savez(tmp_path / "rows.npz", q=fitted.postures, x=fitted.positions)

    def judged(found: dict[str, Any]) -> tuple[float, str, str]:
        chain = Screws(found["axes"], found["points"], found["tip"], np.zeros(0), np.zeros(0))
        left = rms(chain.positions(held.postures) - held.positions)
        return left, f"{left:.4f} mm held out", f"{found['seconds']:.2f} s, the first {found['first']:.2f} s"

    title = f"UR10, series {series}: {len(fitted)} rows fitted, {len(held)} held out"
    rows = compared(tmp_path, title, "identification", judged, rows=str(tmp_path / "rows.npz"))
    nobody_better(values_of(rows))


def rms(missed: np.ndarray) -> float:
    """Of distances."""
    return float(np.sqrt(np.mean(np.sum(missed**2, axis=1))))


def values_of(rows: list[Row]) -> list[float]:
    """Errors left; infinite where a tool gave none."""
    return [np.inf if row.value is None else row.value for row in rows]


def nobody_better(errors: list[float]) -> None:
    """armcal's comes first; the smaller the better."""
    assert np.isfinite(errors[0])
    assert min(errors) >= errors[0] - MARGIN * abs(errors[0])
