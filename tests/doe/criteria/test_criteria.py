"""What every criterion must be: its formula, exact derivatives, concave, with bounds that hold and are tight."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from doe import D, DesignProblem
from doe.bounds.certificate import ApproximateDesign
from doe.criteria import NAMES, A, Criterion, Ds, DStar, E, I, PowerMean, information_matrix, inverses, log_determinants
from identification import Arm, Model, Plan, spectrum

P = 6
POSES = np.random.default_rng(42).normal(size=(5, 2, P))
ALL: dict[str, Criterion] = {
    "D": D(), "A": A(), "E": E(), "I": I(POSES), "Ds": Ds((0, 3)), "Dstar": DStar(((0, 1, 2), (3, 4, 5))),
    "mean 3": PowerMean(3), "mean 8": PowerMean(8), "mean 32": PowerMean(32),
}  # fmt: skip
SMOOTH = {name: c.smooth for name, c in ALL.items() if name != "E"}
each = pytest.mark.parametrize("phi", ALL.values(), ids=ALL)
each_smooth = pytest.mark.parametrize("phi", SMOOTH.values(), ids=SMOOTH)


def random_information(generator: np.random.Generator) -> np.ndarray:
    root = generator.normal(size=(10, P))
    return root.T @ root / 10


def random_direction(generator: np.random.Generator) -> np.ndarray:
    root = generator.normal(size=(P, P))
    return root + root.T


def test_formulas() -> None:
    information = random_information(np.random.default_rng(0))
    covariance = np.linalg.inv(information)
    expected = {
        "D": -np.log(np.linalg.det(covariance)),
        "A": -np.trace(covariance),
        "E": 1.0 / np.linalg.norm(covariance, 2),
        "I": -np.mean([np.trace(j @ covariance @ j.T) for j in POSES]),
        "Ds": -np.log(np.linalg.det(covariance[np.ix_([0, 3], [0, 3])])),
        "Dstar": np.log(np.linalg.det(information[:3, :3])) + np.log(np.linalg.det(information[3:, 3:])),
        "mean 3": np.mean(np.linalg.eigvalsh(information) ** -3.0) ** (-1 / 3),
        "mean 8": np.mean(np.linalg.eigvalsh(information) ** -8.0) ** (-1 / 8),
        "mean 32": np.mean(np.linalg.eigvalsh(information) ** -32.0) ** (-1 / 32),
    }
    assert {phi.name for phi in ALL.values()} == {*NAMES, PowerMean.name}
    for name, phi in ALL.items():
        assert float(phi.value(information)) == pytest.approx(expected[name]), name


@each
def test_a_singular_matrix_is_worth_minus_infinity_in_a_batch_too(phi: Criterion) -> None:
    good = random_information(np.random.default_rng(0))
    values = phi.value(np.array([good, np.diag([1.0, 1, 1, 1, 1, 0])]))
    assert values[0] == pytest.approx(float(phi.value(good)))
    assert (values[1], phi.efficiency(-np.inf, float(values[0]), P)) == (-np.inf, 0.0)
    assert phi.efficiency(float(values[0]), np.inf, P) == 0.0  # of a bound that was not computed


@each
@pytest.mark.parametrize("seed", range(3))
def test_gradient(phi: Criterion, seed: int) -> None:
    generator = np.random.default_rng(seed)
    information = random_information(generator)
    gradient = phi.gradient(information)
    for _ in range(3):
        direction, step = random_direction(generator), 1e-6
        change = (phi.value(information + step * direction) - phi.value(information - step * direction)) / (2 * step)
        # rounding 1e-16 * 1e2 / 1e-6; truncation grows with the conditioning of the random matrix
        assert np.sum(gradient * direction) == pytest.approx(float(change), rel=1e-5, abs=1e-6)


@each_smooth
@pytest.mark.parametrize("seed", range(3))
def test_curvature(phi: Criterion, seed: int) -> None:
    generator = np.random.default_rng(seed)
    information = random_information(generator) if seed else np.eye(P)  # where all eigenvalues meet
    directions = np.array([random_direction(generator) for _ in range(4)])
    step = 1e-6
    changes = [
        (phi.gradient(information + step * x) - phi.gradient(information - step * x)) / (2 * step) for x in directions
    ]
    expected = [[np.sum(change * y) for y in directions] for change in changes]
    found = phi.curvature(information, directions)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


@settings(max_examples=40)
@given(st.sampled_from(sorted(ALL)), st.integers(0, 2**32 - 1), st.floats(0.05, 0.95))
def test_concave_and_below_its_bound(name: str, seed: int, share: float) -> None:
    phi, generator = ALL[name], np.random.default_rng(seed)
    one, other = random_information(generator), random_information(generator)
    mixed = float(phi.value(share * one + (1 - share) * other))
    slack = 1e-9 * (1.0 + abs(mixed))
    assert mixed >= share * float(phi.value(one)) + (1 - share) * float(phi.value(other)) - slack
    largest = float(np.sum(phi.gradient(one) * other))  # the only other design there is
    assert float(phi.value(other)) <= phi.upper_bound(one, largest) + slack


@each
def test_bound_is_tight_at_itself_and_for_more_runs(phi: Criterion) -> None:
    """N = c M is judged exactly: the bounds use all of the homogeneity that there is."""
    information = random_information(np.random.default_rng(5))
    for factor in (0.5, 1.0, 3.0):
        largest = float(np.sum(phi.gradient(information) * factor * information))
        assert phi.upper_bound(information, largest) == pytest.approx(float(phi.value(factor * information)))


@each
def test_efficiency_is_a_share_of_the_runs(phi: Criterion) -> None:
    information = random_information(np.random.default_rng(6))
    value, halved = float(phi.value(information)), float(phi.value(0.5 * information))
    assert (phi.efficiency(halved, value, P), phi.efficiency(value, value, P)) == pytest.approx((0.5, 1.0))


@each
def test_gain_of_adding_a_block(phi: Criterion) -> None:
    generator = np.random.default_rng(8)
    information = np.array([random_information(generator) for _ in range(3)])
    jacobians = generator.normal(size=(3, 7, 2, P))
    gains = phi.values_after_adding(information, jacobians)
    direct = phi.value(information[:, None] + np.swapaxes(jacobians, -1, -2) @ jacobians)
    apart = np.asarray(direct) - gains  # may depend on the start only
    np.testing.assert_allclose(apart, np.repeat(apart[:, :1], 7, axis=1), rtol=1e-6, atol=1e-6)


@each
def test_ranking_through_exchanges(phi: Criterion) -> None:
    """By few columns, as afresh: what candidates are worth in the place of a run, before runs are exchanged and after;
    of as many runs as identify all parameters too."""
    jacobians = np.random.default_rng(9).normal(size=(40, 2, P))
    for runs in (3, 8) if phi.name in "AI" else (8,):
        ranking, plan = phi.ranking(information_matrix(jacobians[:runs]), jacobians), list(range(runs))
        for run, new in ((0, 20), (2, 30), (0, 35)):
            others = information_matrix(jacobians[np.delete(plan, run)])[None]
            afresh = phi.values_after_adding(others, jacobians[None])[0]
            order = np.argsort(ranking.instead_of(jacobians[plan[run]]))
            np.testing.assert_array_equal(order[-3:], np.argsort(afresh)[-3:])
            ranking.exchange(jacobians[plan[run]], jacobians[new])
            plan[run] = new


def test_stand_ins_of_criteria_without_derivatives() -> None:
    """Searches climb Phi_32 instead of E; a smooth criterion stands for itself."""
    assert (E().smooth, D().smooth) == (PowerMean(32), D())


# -- one rank rule -----------------------------------------------------------------------------------------------------
HALF = 1e-6  # a share of the largest singular value that its square, in double precision, still shows


def criteria(p: int) -> dict[str, Criterion]:
    halves = (tuple(range(p // 2)), tuple(range(p // 2, p)))
    poses = np.random.default_rng(7).normal(size=(5, 2, p))
    return {"D": D(), "A": A(), "E": E(), "I": I(poses), "Ds": Ds((0,)), "Dstar": DStar(halves), "mean": PowerMean(8)}


@st.composite
def sizes(draw: st.DrawFn) -> tuple[int, int, int, np.random.Generator]:
    """p parameters, m postures of d coordinates, and a generator."""
    p, d = draw(st.integers(2, 40)), draw(st.integers(1, 3))
    return p, d, draw(st.integers(1, 60)), np.random.default_rng(draw(st.integers(0, 2**32)))


def scaled(rows: np.ndarray, d: int, generator: np.random.Generator, together: float) -> np.ndarray:
    """(m, d, p) with columns of other units, all of another size."""
    return (rows * 10.0 ** generator.uniform(-3.0, 3.0, rows.shape[1]) * together).reshape(-1, d, rows.shape[1])


@settings(max_examples=100, deadline=None)
@given(sizes(), st.sampled_from([1e-6, 1.0, 1e6]), st.booleans())
def test_what_lacks_a_rank_is_worth_minus_infinity(
    drawn: tuple[int, int, int, np.random.Generator], together: float, one_short: bool
) -> None:
    p, d, m, generator = drawn
    rank = p - 1 if one_short else int(generator.integers(1, p))
    rows = generator.normal(size=(m * d, rank)) @ generator.normal(size=(rank, p))
    jacobian = scaled(rows, d, generator, together)
    assert spectrum(jacobian, np.ones(p)).rank < p
    information = information_matrix(jacobian) / m
    for name, phi in criteria(p).items():
        assert phi.value(information) == -np.inf, name
    assert inverses(information)[1].all()


@settings(max_examples=100, deadline=None)
@given(sizes(), st.sampled_from([1e-6, 1.0, 1e6]))
def test_what_has_full_rank_never_is(drawn: tuple[int, int, int, np.random.Generator], together: float) -> None:
    """Singular values of unit columns down to `HALF`, against log det by the singular values themselves."""
    p, d, m, generator = drawn
    m += p
    left, right = (np.linalg.qr(generator.normal(size=(k, p)))[0] for k in (m * d, p))
    values = np.geomspace(1.0, 10.0 ** generator.uniform(np.log10(HALF), 0.0), p)
    jacobian = scaled(left * values @ right.T, d, generator, together)
    lengths = np.linalg.norm(jacobian.reshape(-1, p), axis=0)
    singular_values = np.linalg.svd(jacobian.reshape(-1, p) / lengths, compute_uv=False)
    assume(singular_values[-1] > HALF * singular_values[0] and lengths.min() > HALF * lengths.max())
    information = information_matrix(jacobian)
    expected = 2.0 * np.sum(np.log(singular_values)) + 2.0 * np.sum(np.log(lengths))
    worst = p * np.finfo(float).eps / (singular_values[-1] / singular_values[0]) ** 2  # of one eigenvalue
    assert float(D().value(information)) == pytest.approx(expected, abs=1e-9 + 10.0 * worst)
    for name, phi in criteria(p).items():
        assert np.isfinite(phi.value(information)), name


@pytest.mark.parametrize("phi", criteria(8).values(), ids=criteria(8))
def test_a_singular_plan_proves_no_bound(phi: Criterion) -> None:
    """But of D*, whose two blocks of 4 are regular at 3 postures of 2 coordinates, while M of 8 is not."""
    problem = DesignProblem.of(Model(Arm(np.full(4, 100.0))), criterion=phi)
    postures = np.random.default_rng(0).uniform(-2.0, 2.0, (3, 4))
    found = ApproximateDesign(problem, Plan(postures), problem.prior, largest=10.0)
    assert found.value == -np.inf
    assert np.isfinite([found.upper, found.gap]).tolist() == [isinstance(phi, DStar)] * 2
    assert found.efficiency_lower_bound == 0.0


def test_batches_are_judged_one_by_one() -> None:
    rows = np.random.default_rng(3).normal(size=(4, 6, 30, 5))
    rows[1, 2, :, 4] = rows[1, 2, :, 0] - rows[1, 2, :, 3]
    rows[3, 0, 0, 0] = np.nan
    found = log_determinants(np.swapaxes(rows, -1, -2) @ rows)
    assert np.argwhere(~np.isfinite(found)).tolist() == [[1, 2], [3, 0]]
    np.testing.assert_allclose(found, [[float(log_determinants(r.T @ r)) for r in some] for some in rows], rtol=1e-12)
