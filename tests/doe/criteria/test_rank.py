"""One rank rule: what is singular, and what is not, does not depend on the criterion, on units, or on rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from doe.bounds.certificate import ApproximateDesign
from doe.criteria import (
    A,
    Average,
    Criterion,
    D,
    Ds,
    DStar,
    E,
    I,
    PowerMean,
    SoftWorst,
    Worst,
    inverses,
    log_determinants,
)
from doe.plan.plan import Plan
from doe.problem.problem import DesignProblem
from identification.arm import Arm
from identification.information import information_matrix, spectrum
from identification.model import Model

HALF = 1e-6  # a share of the largest singular value that its square, in double precision, still shows


def criteria(p: int) -> dict[str, Criterion]:
    halves = (tuple(range(p // 2)), tuple(range(p // 2, p)))
    poses = np.random.default_rng(7).normal(size=(5, 2, p))
    return {"D": D(), "A": A(), "E": E(), "I": I(poses), "Ds": Ds((0,)), "Dstar": DStar(halves), "mean": PowerMean(8.0)}


@st.composite
def sizes(draw: st.DrawFn) -> tuple[int, int, int, np.random.Generator]:
    """p parameters, m postures of d coordinates, and a generator."""
    p, d = draw(st.integers(2, 40)), draw(st.integers(1, 3))
    return p, d, draw(st.integers(1, 60)), np.random.default_rng(draw(st.integers(0, 2**32)))


def scaled(rows: np.ndarray, d: int, generator: np.random.Generator, together: float) -> np.ndarray:
    """(m, d, p) with columns of other units, all of another size."""
    return (rows * 10.0 ** generator.uniform(-3.0, 3.0, rows.shape[1]) * together).reshape(-1, d, rows.shape[1])


@settings(max_examples=300, deadline=None)
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
    assert np.isinf(inverses(information)).all()


@settings(max_examples=300, deadline=None)
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


def test_a_column_that_is_rounding_beside_the_others_is_none() -> None:
    """Its own direction apart: cos 90 deg is 6e-17 of the column that it stands in."""
    rows = np.random.default_rng(0).normal(size=(20, 4))
    rows[:, 2] *= 6e-17
    assert D().value(rows.T @ rows) == -np.inf


def test_of_several_arms_one_that_is_not_identified_is_enough() -> None:
    generator = np.random.default_rng(0)
    good, bad = generator.normal(size=(12, 4)), generator.normal(size=(12, 3)) @ generator.normal(size=(3, 4))
    both = np.zeros((8, 8))
    both[:4, :4], both[4:, 4:] = good.T @ good, bad.T @ bad
    for phi in (Average(2), SoftWorst(2), Worst(2)):
        assert phi.value(both) == -np.inf
    both[4:, 4:] = good.T @ good
    for phi in (Average(2), SoftWorst(2), Worst(2)):
        assert np.isfinite(phi.value(both))


def test_a_plan_of_too_few_runs_or_of_one_posture_again_and_again_has_no_value() -> None:
    generator = np.random.default_rng(0)
    for links in (2, 3, 4, 6):
        arm = Arm(generator.uniform(50.0, 500.0, links))
        problem = DesignProblem.of(Model(arm), minimum_distance=0.0)
        for name, phi in criteria(problem.parameters).items():
            judged = replace(problem, criterion=phi)
            few = generator.uniform(-np.pi, np.pi, (links - 1, links))
            again = np.repeat(generator.uniform(-np.pi, np.pi, (links - 1, links)), 5, axis=0)
            assert judged.objective(few) == judged.objective(again) == -np.inf, (links, name)
            enough = generator.uniform(-np.pi, np.pi, (4 * links, links))
            assert np.isfinite(judged.objective(enough)), (links, name)


@pytest.mark.parametrize("phi", criteria(8).values(), ids=criteria(8))
def test_a_singular_plan_proves_no_bound(phi: Criterion) -> None:
    problem = DesignProblem.of(Model(Arm(np.full(4, 100.0))), criterion=phi)
    postures = np.random.default_rng(0).uniform(-2.0, 2.0, (3, 4))
    found = ApproximateDesign(problem, problem.prior, Plan(postures), largest=10.0)
    assert found.value == -np.inf
    assert found.upper == found.gap == np.inf
    assert found.efficiency_lower_bound == 0.0


def test_batches_are_judged_one_by_one() -> None:
    generator = np.random.default_rng(3)
    rows = generator.normal(size=(4, 6, 30, 5))
    rows[1, 2, :, 4] = rows[1, 2, :, 0] - rows[1, 2, :, 3]
    rows[3, 0, 0, 0] = np.nan
    found = log_determinants(np.swapaxes(rows, -1, -2) @ rows)
    assert np.argwhere(~np.isfinite(found)).tolist() == [[1, 2], [3, 0]]
    each = [[float(log_determinants(r.T @ r)) for r in some] for some in rows]
    np.testing.assert_allclose(found, each, rtol=1e-12)
