"""Real data: are 20 chosen postures of the 2,773 of a UR10 worth more than 20 random ones?"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from doe.criteria import criterion
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from identification.arm import Arm, EffectSpec
from identification.measurements import Measurements, load_measurements
from identification.model import Model

DATA = Path(__file__).parents[3] / "shared/data/ur10_planar/measurements.csv"
ARM = Arm(np.array([612.0, 572.3, 115.7]), effects=(EffectSpec("base_offset"),))
RUNS, DRAWS = 20, 1000


def estimates(postures: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """(p,) least squares for u_j = (l_j + dl_j) exp(i dtheta_j) and base (identification/README.md, "Closed form"), as
    numbers of one unit [mm]: real and imaginary parts."""
    columns = np.hstack([np.exp(1j * np.cumsum(postures, axis=1)), np.ones((len(postures), 1))])
    u = np.linalg.lstsq(columns, positions[:, 0] + 1j * positions[:, 1], rcond=None)[0]
    return np.concatenate([u.real, u.imag])


def tip_error(postures: np.ndarray, found: np.ndarray, true: np.ndarray) -> float:
    """RMS over all postures of the tip's distance between two fits [mm]."""
    half = len(found) // 2
    columns = np.hstack([np.exp(1j * np.cumsum(postures, axis=1)), np.ones((len(postures), 1))])
    moved = columns @ ((found - true)[:half] + 1j * (found - true)[half:])
    return float(np.sqrt(np.mean(np.abs(moved) ** 2)))


def share_if_the_model_were_right(
    data: Measurements, full: np.ndarray, rows: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """(100,) shares of 50 random choices beaten, with white noise of the residuals' size on the full fit."""
    half = len(full) // 2
    columns = np.hstack([np.exp(1j * np.cumsum(data.postures, axis=1)), np.ones((len(data), 1))])
    exact = columns @ (full[:half] + 1j * full[half:])
    exact = np.column_stack([exact.real, exact.imag])
    sigma = np.std(data.positions - exact)
    picks = [generator.choice(len(data), RUNS, replace=False) for _ in range(50)]

    def errors(choices: list[np.ndarray], positions: np.ndarray) -> np.ndarray:
        return np.array([np.linalg.norm(estimates(data.postures[k], positions[k]) - full) for k in choices])

    drawn = (exact + sigma * generator.standard_normal(exact.shape) for _ in range(100))
    return np.array([np.mean(errors(picks, positions) > errors([rows], positions)) for positions in drawn])


@pytest.mark.benchmark
@pytest.mark.skipif(not DATA.exists(), reason="the UR10 measurements are not beside the checkout")
def test_chosen_postures_against_random_ones() -> None:
    data = load_measurements(DATA, 3)
    full = estimates(data.postures, data.positions)
    generator = np.random.default_rng(0)
    picks = (generator.choice(len(data), RUNS, replace=False) for _ in range(DRAWS))
    random = [estimates(data.postures[k], data.positions[k]) for k in picks]
    errors = np.linalg.norm(np.array(random) - full, axis=1)
    at_tip = np.array([tip_error(data.postures, found, full) for found in random])
    print(f"\n20 of 2,773 UR10 postures; error of a random choice: median {np.median(errors):.3f} mm (bar: 95 %)")
    plain = DesignProblem.of(Model(ARM), choices=data.postures)
    for name in ("D", "A", "I"):
        chosen = criterion(name, test_jacobians=plain.scaled_jacobians(data.postures[::10]))
        design = solve(DesignProblem.of(Model(ARM), choices=data.postures, criterion=chosen), RUNS)
        distance = np.abs(data.postures[:, None] - design.plan.postures).max(axis=-1)
        rows = distance.argmin(axis=0)
        assert len(set(rows.tolist())) == RUNS
        assert distance[rows, np.arange(RUNS)].max() < 1e-9  # it chose from the list
        found = estimates(data.postures[rows], data.positions[rows])
        error = float(np.linalg.norm(found - full))
        nearer, nearer_tip = np.mean(errors > error), np.mean(at_tip > tip_error(data.postures, found, full))
        ideal = share_if_the_model_were_right(data, full, rows, generator)
        print(f"{name}-optimal: error {error:.3f} mm, nearer to the full fit than {nearer:.0%} of {DRAWS} random")
        print(
            f"   by the error of the tip {nearer_tip:.0%}; if the model were right and the noise white, a share of",
            end="",
        )
        print(f" {ideal.mean():.0%} would be expected, less than {np.quantile(ideal, 0.1):.0%} in one case of ten")
