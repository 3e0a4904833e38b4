"""Real data: are 20 chosen postures of the 2,773 of a UR10 worth more than 20 random ones?"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from doe.criteria import criterion
from doe.problem import DesignProblem
from doe.solvers import solve
from identification.arm import Arm, EffectSpec
from identification.measurement_file import load_measurements
from identification.model import Model

DATA = Path(__file__).parents[3] / "shared/data/ur10_planar/measurements.csv"
ARM = Arm(np.array([612.0, 572.3, 115.7]), effects=(EffectSpec("base_offset"),))
RUNS, DRAWS = 20, 1000


def estimates(postures: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """(p,) linear least squares for u_j = (l_j + dl_j) exp(i dtheta_j) and the base (THEORY.md section 2), as numbers
    of one unit [mm]: real and imaginary parts."""
    columns = np.hstack([np.exp(1j * np.cumsum(postures, axis=1)), np.ones((len(postures), 1))])
    u = np.linalg.lstsq(columns, positions[:, 0] + 1j * positions[:, 1], rcond=None)[0]
    return np.concatenate([u.real, u.imag])


@pytest.mark.benchmark
@pytest.mark.skipif(not DATA.exists(), reason="the UR10 measurements are not beside the checkout")
def test_chosen_postures_against_random_ones() -> None:
    data = load_measurements(DATA, 3)
    full = estimates(data.postures, data.positions)
    generator = np.random.default_rng(0)
    picks = (generator.choice(len(data), RUNS, replace=False) for _ in range(DRAWS))
    errors = np.array([np.linalg.norm(estimates(data.postures[k], data.positions[k]) - full) for k in picks])
    print(f"\n20 of 2,773 UR10 postures; error of a random choice: median {np.median(errors):.3f} mm (bar: 95 %)")
    plain = DesignProblem.of(Model(ARM), choices=data.postures)
    for name in ("D", "A", "I"):
        chosen = criterion(name, test_blocks=plain.blocks(data.postures[::10]))
        design = solve(DesignProblem.of(Model(ARM), choices=data.postures, criterion=chosen), RUNS)
        distance = np.abs(data.postures[:, None] - design.plan.postures).max(axis=-1)
        rows = distance.argmin(axis=0)
        assert len(set(rows.tolist())) == RUNS
        assert distance[rows, np.arange(RUNS)].max() < 1e-9  # it chose from the list
        error = float(np.linalg.norm(estimates(data.postures[rows], data.positions[rows]) - full))
        nearer = float(np.mean(errors > error))
        print(f"{name}-optimal: error {error:.3f} mm, nearer to the full fit than {nearer:.0%} of {DRAWS} random")
