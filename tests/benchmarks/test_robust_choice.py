"""Real data: do postures chosen for what a model may lack predict the others better than random ones?

20, 30 and 50 of 1,387 of the 2,773 postures of series C, and of 1,500 of the 11,911 of series A, against 100 random
choices of all, each fitted in the same way: geometry and base offset free, all effects of the library with their prior,
the noise estimated. Plans of six starts each, as plans of nearly the same criterion differ on one robot. Numbers that
are used of the robot: nominal links, and 0.1 mm, the repeatability of its data sheet. Run it with -s; table in
doe/README.md, "Robust designs".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from doe.bounds.certificate import Bound
from doe.plan.accuracy import tip_beside_random
from doe.problem.problem import DesignProblem
from doe.problem.uncertain import robust_problem
from doe.solvers import solve
from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.estimation import estimate, estimate_with_prior
from identification.gap.library_prior import library_prior
from identification.measurements import Measurements, load_measurements
from identification.model import Model

DATA = Path(__file__).parents[3] / "shared/data/ur10_planar"
ARM = Arm(np.array([612.0, 572.3, 115.7]), effects=(EffectSpec("base_offset"),), sigma=0.1)
CASES = [(file, runs) for file in ("measurements.csv", "series_A.csv") for runs in (20, 30, 50)]
DRAWS = 100
STARTS = 6
OFFERED = 3000  # rows of which every other is there to choose
NOISES = np.geomspace(1.0, 30.0, 300) * 0.1  # [mm] tried for the noise, the data sheet's and more


@dataclass(frozen=True)
class LinearFits:
    """Fits of some rows, linear about the fit of all rows without effects: positions = J (free, effects) + noise.

    residual : (N, 2) of that fit [mm];  free : (N, 2, p) and effects : (N, 2, e) Jacobian, effects times their sizes
    """

    residual: Array
    free: Array
    effects: Array

    @classmethod
    def of(cls, data: Measurements, *, prior: bool = True) -> LinearFits:
        plain = estimate(Model(ARM), data)
        wide = library_prior(ARM, given_by(data))
        deviations = wide.model.parameters.vector(wide.prior.deviations)
        values = wide.model.parameters.vector(plain.model.parameters.mapping(plain.parameters))
        jacobian = wide.model.jacobian(data.postures, values, data.conditions)
        known = deviations > 0.0
        sizes = deviations[known] if prior else np.zeros(0)
        return cls(plain.residuals_after, jacobian[..., ~known], jacobian[..., known][..., : len(sizes)] * sizes)

    @cached_property
    def rows(self) -> Array:
        """(2 N, p + e)."""
        return np.concatenate([self.free, self.effects], axis=2).reshape(2 * len(self.residual), -1)

    def fitted(self, chosen: NDArray[np.intp]) -> Array:
        """(p + e,) the mode of the posterior with the noise of the largest marginal likelihood (restricted, REML)."""
        y, p = self.residual[chosen].ravel(), self.free.shape[2]
        x, z = self.free[chosen].reshape(len(y), p), self.effects[chosen].reshape(len(y), -1)
        if not z.shape[1]:
            return np.linalg.lstsq(x, y, rcond=None)[0]
        beside = np.linalg.svd(x)[0][:, p:]  # what the free parameters cannot explain
        values, vectors = np.linalg.eigh(beside.T @ z @ z.T @ beside)
        seen = (vectors.T @ beside.T @ y) ** 2
        variance = np.maximum(values, 0.0) + NOISES[:, None] ** 2
        best = np.argmin(np.sum(np.log(variance) + seen / variance, axis=1))
        covariance = z @ z.T + NOISES[best] ** 2 * np.eye(len(y))
        whitened = np.linalg.solve(covariance, x)
        free = np.linalg.solve(x.T @ whitened, whitened.T @ y)
        return np.r_[free, z.T @ np.linalg.solve(covariance, y - x @ free)]

    def errors(self, choices: list[NDArray[np.intp]]) -> Array:
        """(c,) RMS distance on the rows that are not chosen [mm]."""
        found = []
        for some in np.array_split(np.arange(len(choices)), -(-len(choices) // 100)):
            fits = np.stack([self.fitted(choices[k]) for k in some], axis=1)
            missed = (self.residual.reshape(-1, 1) - self.rows @ fits) ** 2
            squares = missed.reshape(len(self.residual), 2, -1).sum(axis=1)
            for place, k in enumerate(some):
                rest = np.delete(squares[:, place], choices[k])
                found.append(np.sqrt(rest.mean()))
        return np.array(found)


def given_by(data: Measurements) -> frozenset[str]:
    return frozenset({"time", "directions"} | ({"temperature"} if data.temperature is not None else set()))


def rows_of(data: Measurements, postures: Array) -> NDArray[np.intp]:
    """The first rows with these postures."""
    rows = np.array([int(np.abs(data.postures - posture).max(axis=1).argmin()) for posture in postures])
    assert np.abs(data.postures[rows] - postures).max() < 1e-9
    assert len(set(rows.tolist())) == len(postures)
    return rows


def offered(data: Measurements) -> Array:
    """(N, n) postures to choose from."""
    return data.postures[np.sort(np.random.default_rng(4).permutation(len(data))[:OFFERED])[::2]]


@pytest.mark.benchmark
@pytest.mark.skipif(not DATA.exists(), reason="the UR10 measurements are not beside the checkout")
def test_linear_fits_are_those_of_identify() -> None:
    """`estimate_with_prior` on three random choices: the same error on the other rows to a thousandth."""
    data = load_measurements(DATA / "measurements.csv", 3)
    library, fits, generator = library_prior(ARM, given_by(data)), LinearFits.of(data), np.random.default_rng(0)
    for _ in range(3):
        chosen = generator.choice(len(data), 20, replace=False)
        found = estimate_with_prior(library.model, data.rows(chosen), library.prior)
        missed = data.positions - library.model.position(data.postures, found.parameters, data.conditions)
        error = np.sqrt(np.delete(np.sum(missed**2, axis=1), chosen).mean())
        assert error == pytest.approx(fits.errors([chosen])[0], rel=1e-3)


@pytest.mark.benchmark
@pytest.mark.skipif(not DATA.exists(), reason="the UR10 measurements are not beside the checkout")
@pytest.mark.parametrize(("file", "runs"), CASES)
def test_chosen_with_the_library_in_mind(file: str, runs: int) -> None:
    data = load_measurements(DATA / file, 3)
    generator, fits = np.random.default_rng(0), (LinearFits.of(data), LinearFits.of(data, prior=False))
    random = [generator.choice(len(data), runs, replace=False) for _ in range(DRAWS)]
    errors = [fit.errors(random) for fit in fits]
    held, least = (float(np.median(each)) for each in errors)
    print(f"\n{file}, {runs} of {len(data)}: random with the prior {held:.3f}, by least squares {least:.3f} mm", end="")
    plain = DesignProblem.of(Model(ARM), choices=offered(data))
    for name, case in (("robust", robust_problem(plain)), ("D", plain)):
        nothing = Bound(np.inf, "continuous")  # none is computed
        plans = [solve(case, runs, seed=seed, starts=1, bound=nothing).plan.postures for seed in range(STARTS)]
        promised = [expected.plan for plan in plans if (expected := tip_beside_random(case, plan))]
        reached = fits[0 if case.fit else 1].errors([rows_of(data, plan) for plan in plans])
        better = [float(np.mean(errors[0 if case.fit else 1] > error)) for error in reached]
        print(f"; {name} {reached.mean():.3f} mm, better than {np.mean(better):.2f}", end="")
        print(f" ({min(better):.2f} to {max(better):.2f}), promised {np.mean(promised):.3f}", end="")
    print()
