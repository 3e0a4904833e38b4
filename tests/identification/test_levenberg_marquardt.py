"""The one least-squares engine against scipy, brute force, and one problem at a time; on functions of our own."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from identification import Array, Status
from identification.levenberg_marquardt import (
    GRADIENT_TOLERANCE,
    ITERATIONS,
    PATIENCE,
    Index,
    Linearize,
    Solution,
    compressed,
    damped_steps,
    levenberg_marquardt,
    newton_ascent,
)

INF = np.inf
TIMES = np.linspace(0.0, 3.0, 12)


def minima(linearize: Linearize, starts: np.ndarray, **changes: Any) -> Solution:
    count, p = starts.shape
    return levenberg_marquardt(linearize, starts, **{"scales": np.ones(p), "rounding": np.zeros(count), **changes})


def decays(measured: np.ndarray) -> Linearize:
    """y = a exp(-b t) + c for data (K, 12); measured less computed, and the derivative of what is computed."""

    def linearize(x: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b, c = (x[:, k, None] for k in range(3))
        fall = np.exp(-b * TIMES)
        jacobian = np.stack([fall, -a * TIMES * fall, np.ones_like(fall)], axis=-1)
        return measured[index] - a * fall - c, jacobian

    return linearize


def measured_decays(count: int, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    a, b, c = generator.uniform([1.0, 0.3, -1.0], [5.0, 2.0, 1.0], (count, 3)).T[:, :, None]
    return a * np.exp(-b * TIMES) + c + 0.05 * generator.standard_normal((count, len(TIMES)))


def test_many_at_once_are_those_one_by_one() -> None:
    data, low = measured_decays(30, seed=2), np.array([0.0, 0.0, 0.0])
    data[7] = np.nan
    together = minima(decays(data), np.ones((30, 3)), lower=low)
    for k in range(30):
        alone = minima(decays(data[k : k + 1]), np.ones((1, 3)), lower=low)
        assert alone.status[0] is together.status[k]
        assert alone.iterations[0] == together.iterations[k]
        np.testing.assert_allclose(alone.parameters[0], together.parameters[k], rtol=1e-12)
    assert together.status[7] is Status.solver_failed


def linear(matrix: np.ndarray, right: np.ndarray) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """(N, p) x = (K, N)."""

    def linearize(x: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return right[index] - x @ matrix.T, np.broadcast_to(matrix, (len(index), *matrix.shape)).copy()

    return linearize


@pytest.mark.parametrize("seed", range(60))
def test_from_every_corner_to_the_best_of_all_sets_of_active_bounds(seed: int) -> None:
    """Linear problems in a box, some of whose columns nearly depend on each other: from each corner of the box to the
    least sum of squares, which the best of the 81 choices of what is at its lower bound, at its upper one, or free
    has; and where bounds are active the gradient leads out of the box."""
    generator, p = np.random.default_rng(seed), 4
    matrix = generator.standard_normal((6, p)) @ (np.eye(p) + generator.uniform(-1.0, 1.0) * np.ones((p, p)))
    right, lower = 3.0 * generator.standard_normal(6), np.zeros(p)
    upper = generator.choice([0.5, 2.0, INF], p)
    ends = np.where(np.isfinite(upper), upper, 5.0)
    starts = np.array([np.where(at, ends, lower) for at in np.ndindex(*[2] * p)])
    fits = minima(linear(matrix, np.tile(right, (16, 1))), starts, lower=lower, upper=upper)
    best = INF
    for at in np.ndindex(*[3] * p):
        x, free = np.where(np.array(at) == 1, upper, lower), np.array(at) == 2
        if np.all(np.isfinite(x[~free])):
            x[free] = np.linalg.lstsq(matrix[:, free], right - matrix[:, ~free] @ x[~free])[0]
            inside = np.all((x >= lower) & (x <= upper))
            best = min(best, float(np.sum((right - matrix @ x) ** 2))) if inside else best
    assert set(fits.status) == {Status.converged}
    assert np.all((fits.parameters >= lower) & (fits.parameters <= upper))
    np.testing.assert_allclose(fits.rss, best, rtol=1e-9)
    pull = (right - fits.parameters @ matrix.T) @ matrix
    assert np.all(
        np.where(fits.active, pull * np.where(fits.parameters <= lower, -1.0, 1.0), 1e-6 - np.abs(pull)) > 0.0
    )


def test_what_is_not_determined_stays_where_it_was() -> None:
    """Two equal columns: only their sum moves, by the shortest step; and a column of zeros."""
    generator = np.random.default_rng(6)
    matrix, right = generator.standard_normal((20, 4)), generator.standard_normal((1, 20))
    matrix[:, 2], matrix[:, 3] = matrix[:, 1], 0.0
    found = minima(linear(matrix, right), np.array([[0.0, 0.3, 0.1, 7.0]]))
    expected = np.linalg.lstsq(matrix[:, :2], right[0], rcond=None)[0]
    assert found.status[0] is Status.converged
    x = found.parameters[0]
    np.testing.assert_allclose([x[0], x[1] + x[2], x[1] - x[2], x[3]], [*expected, 0.2, 7.0], rtol=0, atol=1e-8)


def test_the_metric_decides_which_step_is_the_shortest() -> None:
    """One equation, three unknowns: with weights w the shortest solution is W^-2 a (a' W^-2 a)^-1 b."""
    a, weights = np.array([[1.0, 2.0, -1.0]]), np.array([1.0, 3.0, 0.5])
    found = minima(linear(a, np.array([[4.0]])), np.zeros((1, 3)), metric=weights, rounding=np.array([1e-12]))
    expected = a[0] / weights**2 / np.sum(a[0] ** 2 / weights**2) * 4.0
    np.testing.assert_allclose(found.parameters[0], expected, rtol=1e-12)


@pytest.mark.parametrize("shape", [(12, 4), (3, 4)], ids=["tall", "wide"])
@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_damped_steps_by_either_route(shape: tuple[int, int], damping: float) -> None:
    """Normal matrix for a good condition, singular values for a bad one: both minimise |E s - r|^2 + damping |s|^2."""
    generator = np.random.default_rng(7)
    good = generator.standard_normal((2, *shape))
    bad = good.copy()
    bad[1, :, 3] = bad[1, :, 0] + 1e-6 * bad[1, :, 3]  # condition 1e6: a normal matrix would lose twelve digits
    residuals, held = generator.standard_normal((2, shape[0])), np.zeros((2, 4), dtype=bool)
    held[:, 1] = True
    for columns in (good, bad):
        steps, gradient, stiffness = damped_steps(columns, residuals, held, np.full(2, damping), 1e-9)
        for k in range(2):
            free = columns[k] * ~held[k]
            tall = np.vstack([free, np.sqrt(damping) * np.eye(4)])
            expected = np.linalg.lstsq(tall, np.r_[residuals[k], np.zeros(4)], rcond=1e-12)[0]
            np.testing.assert_allclose(steps[k], expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
            np.testing.assert_allclose(gradient[k], free.T @ residuals[k], rtol=0, atol=1e-9)
            softer = np.linalg.pinv(free.T @ free + damping * np.diag(~held[k]), rcond=1e-14) @ expected
            assert stiffness[k] == pytest.approx(expected @ expected / (expected @ softer), rel=1e-3)
        assert np.all(steps[:, 1] == 0.0)


def rosenbrock(steepness: float) -> Linearize:
    """His function, whose minimum is at (1, 1), with such walls."""

    def linearize(x: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        residual = np.stack([-steepness * (x[:, 1] - x[:, 0] ** 2), 1.0 - x[:, 0]], axis=1)
        jacobian = np.zeros((len(x), 2, 2))
        jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0] = -2.0 * steepness * x[:, 0], steepness, 1.0
        return residual, jacobian

    return linearize


def test_statuses_say_how_it_ended() -> None:
    cut = minima(rosenbrock(10.0), np.array([[-1.2, 1.0]]), rounding=np.array([1e-12]), iterations=2)
    assert cut.status[0] is Status.iteration_limit
    assert cut.iterations[0] == 2
    assert minima(rosenbrock(10.0), np.array([[np.inf, 1.0]])).status[0] is Status.solver_failed


@pytest.mark.parametrize("steepness", [1e1, 1e3, 1e5, 1e6])
@pytest.mark.parametrize("bend", [-1.5, -4.0, -20.0])
def test_a_valley_takes_as_few_steps_however_flat(steepness: float, bend: float) -> None:
    """x + 1 and bend x^2 + x - 1 (K. Madsen, H. B. Nielsen, O. Tingleff, 2004): the least sum of squares is 2 at
    x = 0, from which each undamped step leads |bend| times as far away. Across x the valley is steeper by far."""

    def linearize(values: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, across = values[:, 0] - values[:, 1], values[:, 0] + values[:, 1]
        residual = np.stack([steepness * across, x + 1.0, bend * x**2 + x - 1.0], axis=1)
        slope = np.stack([np.zeros_like(x), np.ones_like(x), 2.0 * bend * x + 1.0], axis=1)
        wall = np.array([steepness, 0.0, 0.0])
        return -residual, np.stack([wall + slope, wall - slope], axis=2)

    found = minima(linearize, np.array([[0.3, -0.2]]))
    assert found.status[0] is Status.converged
    assert found.iterations[0] <= 8
    x = found.parameters[0, 0] - found.parameters[0, 1]
    # a cosine of 1e-9 with the residuals, of length sqrt(2), counts in unit columns, which are `steepness` long
    assert abs(x) <= 2.0 * GRADIENT_TOLERANCE * np.sqrt(2.0) * steepness


@pytest.mark.parametrize("steepness", [1e1, 1e3, 1e5, 1e7])
def test_a_curved_valley_takes_as_few_steps_however_steep(steepness: float) -> None:
    """Rosenbrock's function, with steeper walls: a step along the valley climbs them by far more than it gains, and
    damped ones that do not are as short as the walls are steep."""
    found = minima(rosenbrock(steepness), np.array([[-1.2, 1.0]]), rounding=np.array([1e-12]))
    assert found.status[0] is Status.converged
    assert found.iterations[0] <= PATIENCE + 5
    np.testing.assert_allclose(found.parameters, 1.0, rtol=1e-9)


def test_a_wrong_derivative_ends_unconverged() -> None:
    """With a Jacobian of the wrong sign a small step always ascends: damping runs to its limit, nothing is claimed."""
    right = decays(measured_decays(3))

    def wrong(x: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        residual, jacobian = right(x, index)
        return residual, -jacobian

    found = minima(wrong, np.ones((3, 3)))
    assert not np.any(found.status == Status.converged)
    assert np.all(found.iterations < ITERATIONS)
    assert np.all(found.rss <= np.sum(right(np.ones((3, 3)), np.arange(3))[0] ** 2, axis=1) * (1.0 + 1e-12))


@pytest.mark.parametrize("rows", [150, 4099])
def test_a_tall_problem_is_its_triangle(rows: int) -> None:
    """Sums of products stay, and with them the solution, here by the normal equations."""
    generator = np.random.default_rng(2)
    jacobian, residual = generator.standard_normal((1, rows, 4)), generator.standard_normal((1, rows))
    short_residual, short = compressed(residual, jacobian)
    assert short.shape == (1, 5, 4)
    table, triangle = (np.column_stack([j[0], r[0]]) for j, r in ((jacobian, residual), (short, short_residual)))
    np.testing.assert_allclose(triangle.T @ triangle, table.T @ table, rtol=0, atol=1e-13 * rows)
    expected = np.linalg.solve(jacobian[0].T @ jacobian[0], jacobian[0].T @ residual[0])
    np.testing.assert_allclose(np.linalg.lstsq(short[0], short_residual[0])[0], expected, atol=1e-13)
    few = jacobian[:, :90], residual[:, :90]
    assert compressed(few[1], few[0])[1] is few[0]


def test_a_normal_matrix_with_a_pivot_that_is_exactly_zero() -> None:
    """Two equal columns: the shortest of the steps that end at the residuals, whatever the ridge."""
    columns, free = np.full((1, 2, 2), 100.0), np.zeros((1, 2), dtype=bool)
    steps, gradient, _ = damped_steps(columns, np.ones((1, 2)), free, np.zeros(1), 1e-9)
    np.testing.assert_allclose(steps, [[0.005, 0.005]])
    np.testing.assert_allclose(gradient, [[200.0, 200.0]])


# -- maxima in a box ---------------------------------------------------------------------------------------------------
WAVES = np.array([[1.0, 0.3], [-0.4, 1.2], [0.7, -0.9]])
PHASES, SIZES, UNITS = np.array([0.2, 1.0, -0.5]), np.array([1.0, 2.0, 0.5]), np.array([1.0, 0.5])
LIMITS = np.array([-2.0, -1.0]), np.array([2.5, 1.5])


def height(q: Array, rows: Index) -> Array:
    """A sum of waves."""
    return np.cos(q @ WAVES.T + PHASES) @ SIZES


def slopes(q: Array, rows: Index) -> tuple[Array, Array]:
    angle = q @ WAVES.T + PHASES
    bend = -np.einsum("kw,wi,wj->kij", SIZES * np.cos(angle), WAVES, WAVES)
    return -(SIZES * np.sin(angle)) @ WAVES, bend


def test_ends_are_maxima_within_the_box() -> None:
    starts = np.random.default_rng(0).uniform(*LIMITS, (40, 2))
    ends = newton_ascent(starts, height, slopes, LIMITS, UNITS)
    rows = np.arange(40)
    assert np.all(height(ends, rows) >= height(starts, rows))
    assert np.all((ends >= LIMITS[0]) & (ends <= LIMITS[1]))
    again = [
        minimize(lambda q: -height(q[None], rows)[0], end, bounds=np.transpose(LIMITS), options={"ftol": 1e-15})
        for end in ends
    ]
    np.testing.assert_allclose(height(ends, rows), [-end.fun for end in again], atol=1e-12)
    assert len(np.unique(np.round(ends, 4), axis=0)) < 5


def test_a_saddle_is_left_and_a_wall_is_not_crossed() -> None:
    """cos x - cos y between the walls |y| <= 2 and below x = 0.5, where climbs from the right may not go."""

    def walled(q: Array, rows: Index) -> Array:
        return np.where(q[:, 0] <= 0.5, np.cos(q[:, 0]) - np.cos(q[:, 1]), -np.inf)

    def bend(q: Array, rows: Index) -> tuple[Array, Array]:
        second = np.stack([-np.cos(q[:, 0]), np.cos(q[:, 1])], axis=1)
        return np.stack([-np.sin(q[:, 0]), np.sin(q[:, 1])], axis=1), second[:, :, None] * np.eye(2)

    starts, box = np.array([[0.3, 0.01], [0.4, -0.5], [2.0, 1.0]]), (np.full(2, -2.0), np.full(2, 2.0))
    ends = newton_ascent(starts, walled, bend, box, np.ones(2))
    np.testing.assert_allclose(ends, [[0.0, 2.0], [0.0, -2.0], [2.0, 1.0]], atol=1e-7)
    np.testing.assert_array_equal(newton_ascent(starts, walled, bend, box, np.ones(2), stop=lambda: True), starts)
