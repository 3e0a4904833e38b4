"""What keeps 30 robust runs of a six-axis arm from their bound: figures that doe/README.md, "Spatial arms" quotes.

Run it with -s; two minutes of one core. Exchanges, weights and errors are computed here from Jacobians alone, in numpy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.linalg import eigh

from doe.problem.problem import DesignProblem
from doe.problem.robust import average_error, robust_problem, with_choices
from doe.problem.spatial import of_one_arm
from identification.arrays import Array
from identification.gap.library.library_prior import library_prior
from tests.doe.six_axis import SIX_AXIS, six_axis

pytestmark = pytest.mark.benchmark
RUNS, SIGMA, RIPPLE = 30, 0.05, "transmission_ripple"
TEST = np.random.default_rng(77).uniform(-np.pi, np.pi, (600, 6))
STEP = 1e-6


@dataclass(frozen=True)
class Case:
    """jacobians : of postures (k, 6) -> (k, 3, p);  prior : (p, p) its information;  weight : (p, p) of criterion I
    floor : mean squared error [mm^2] that no run can lower"""

    jacobians: Callable[[Array], Array]
    prior: Array
    weight: Array
    floor: float = 0.0

    def error(self, information: Array) -> float:
        """RMS error of the tip [mm] after runs with this information."""
        return float(np.sqrt(SIGMA**2 * np.trace(np.linalg.solve(self.prior + information, self.weight)) + self.floor))

    def of(self, postures: Array) -> float:
        """The same of a plan."""
        rows = self.jacobians(postures).reshape(-1, len(self.prior))
        return self.error(rows.T @ rows)

    def gains(self, kept: Array, offered: Array) -> Array:
        """(k,) fall of tr(W M^-1) by one more run, one of those offered (k, 3, p), beside those kept (r, 3, p)."""
        rows = kept.reshape(-1, len(self.prior))
        inverse = np.linalg.inv(self.prior + rows.T @ rows)
        seen = offered @ inverse
        inner = np.eye(3) + seen @ offered.transpose(0, 2, 1)
        return np.trace(np.linalg.solve(inner, seen @ self.weight @ seen.transpose(0, 2, 1)), axis1=1, axis2=2)


def case(orders: int | None) -> Case:
    """So many orders stand for those of a ripple, None: all 62."""
    found = robust_problem(six_axis(), library_prior(SIX_AXIS, most_settings=orders))
    return Case(found.scaled_jacobians, *matrices(found))


def matrices(found: DesignProblem) -> tuple[Array, Array]:
    p = found.parameters
    prior = RUNS * found.prior.per_new_run(RUNS).information(np.zeros((p, p)))
    return prior + 1e-9 * np.eye(p), average_error(found, TEST).weight(p)


def as_noise() -> Case:
    """Ripples as what they are at postures far apart: a noise of each run, which its repetition elsewhere averages."""
    names = {spec.name for spec in library_prior(SIX_AXIS).added} - {RIPPLE}
    found = robust_problem(six_axis(), library_prior(SIX_AXIS, names=sorted(names)))
    model, typical = of_one_arm(found.model), 1e-4  # [rad], identification/README.md, "Typical sizes"
    assert model is not None

    def levers(q: Array) -> Array:
        steps = STEP * np.eye(6)
        sides = ([model.position(q + sign * step) for step in steps] for sign in (1.0, -1.0))
        return np.stack([up - down for up, down in zip(*sides, strict=True)], axis=2) / (2.0 * STEP)

    def whitened(q: Array) -> Array:
        lever = levers(q)
        noise = SIGMA**2 * np.eye(3) + typical**2 * lever @ lever.transpose(0, 2, 1)
        return SIGMA * np.linalg.solve(np.linalg.cholesky(noise), found.scaled_jacobians(q))

    return Case(whitened, *matrices(found), floor=typical**2 * float(np.mean(np.sum(levers(TEST) ** 2, axis=(1, 2)))))


def bound(case: Case, offered: Array) -> float:
    """RMS error that no plan of the list beats: weights by the multiplicative algorithm, and the tangent there."""
    k, _, p = offered.shape
    rows, weights = offered.reshape(-1, p), np.full(k, 1.0 / k)
    for _ in range(300):
        inverse = np.linalg.inv(case.prior + RUNS * (rows * np.repeat(weights, 3)[:, None]).T @ rows)
        gradient = inverse @ case.weight @ inverse
        own = np.einsum("ia,ia->i", rows @ gradient, rows).reshape(k, 3).sum(axis=1)
        tangent = np.trace(case.weight @ inverse) - RUNS * (own.max() - weights @ own)
        weights = weights * np.sqrt(own) / np.sum(weights * np.sqrt(own))
    return float(np.sqrt(SIGMA**2 * tangent + case.floor))


def exchanged(case: Case, postures: Array, offers: Callable[[Array], Array], sweeps: int) -> Array:
    """(m, 6) each run in turn replaced by the best on offer for it, until nothing is better."""
    found = postures.copy()
    for _ in range(sweeps):
        before = found.copy()
        for run in range(len(found)):
            kept = case.jacobians(np.delete(found, run, axis=0))
            offered = np.concatenate([found[[run]], offers(found[run])])
            found[run] = offered[np.argmax(case.gains(kept, case.jacobians(offered)))]
        if np.array_equal(before, found):
            break
    return found


def test_what_keeps_robust_runs_from_their_bound() -> None:
    few, every, noise = case(4), case(None), as_noise()
    listed = with_choices(robust_problem(six_axis())).choices
    assert listed is not None
    sizes = eigh(few.weight, few.prior, eigvals_only=True)  # of the errors' variances before any run
    tail = SIGMA * np.sqrt(np.sum(sizes[: -3 * RUNS]))
    print(f"\n4 orders: bound {bound(few, few.jacobians(listed)):.3f}, best of any 90 equations {tail:.3f} mm", end="")
    print(f"; ripples as noise: bound {bound(noise, noise.jacobians(listed)):.3f} mm", end="")
    for seed in range(2):
        rng = np.random.default_rng(seed)
        start = listed[rng.choice(len(listed), RUNS, replace=False)]

        def near(q: Array, rng: np.random.Generator = rng) -> Array:
            steps = np.radians(rng.choice([20.0, 5.0, 2.0], (300, 1))) * rng.normal(size=(300, 6))
            return np.clip(q + steps * (rng.random((300, 6)) < 0.5), -np.pi, np.pi)

        plan = exchanged(few, start, lambda _: listed, 20)
        moved, other = exchanged(few, plan, near, 10), exchanged(noise, start, lambda _: listed, 20)
        for name, found in (("random", start), ("list", plan), ("moved", moved), ("ripples as noise", other)):
            print(f"\n{name}: 4 orders {few.of(found):.3f}, as noise {noise.of(found):.3f}", end="")
            print(f", all orders {every.of(found):.3f} mm", end="")
        assert every.of(other) < every.of(plan) < every.of(start)
