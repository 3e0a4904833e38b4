"""Column generation against closed forms, textbooks, brute force and the equivalence theorem."""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial, legendre

from doe.bounds import column_generation as module
from doe.bounds.column_generation import column_generation, continuous_design
from doe.criteria import A, Criterion, D, Ds, E, I
from doe.problem.postures import PostureList, grid, listed_candidates
from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.errors import JobError
from identification.running import Status
from identification.workspace import WorkspaceBox
from tests.doe.arms import ECCENTRICITY, FOUR, OFFSET, problem, random_box
from tests.doe.regression import regression


def closed_form(lower: Array, upper: Array, offset: bool = False) -> float:
    """4 sum_j log sin(min(Delta_j / 2, pi / 2)), j = 2..n; with a base offset j = 1 too.

    doe/README.md, "Planar theorem".
    """
    half = np.minimum((upper - lower) / 2.0, np.pi / 2.0)
    return float(4.0 * np.sum(np.log(np.sin(half[0 if offset else 1 :]))))


# -- the continuous box ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("links", range(1, 9))
def test_continuous_box_equals_the_closed_form(links: int) -> None:
    generator = np.random.default_rng(links)
    for _ in range(2):
        arm = random_box(generator, links)
        design = continuous_design(problem(arm))
        expected = closed_form(arm.lower, arm.upper)
        assert design.log_det == pytest.approx(expected, abs=1e-9)
        assert design.bound is not None
        assert design.bound.rigorous
        assert design.bound.source == "continuous"
        assert expected - 1e-12 <= design.bound.value <= expected + 1e-8
        assert len(design.plan) <= 2 * links * (2 * links + 1) // 2 + 1
        assert design.plan.shares.sum() == pytest.approx(1.0, abs=1e-12)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), links=st.integers(1, 4))
def test_with_a_base_offset_too(seed: int, links: int) -> None:
    """The base is a link 0 with orientation 0: joint 1 counts as the others do."""
    arm = random_box(np.random.default_rng(seed), links)
    design = continuous_design(problem(arm, OFFSET))
    assert design.log_det == pytest.approx(closed_form(arm.lower, arm.upper, offset=True), abs=1e-9)
    assert design.bound is not None
    assert design.bound.rigorous


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
def test_polynomial_regression(degree: int) -> None:
    """D-optimal on [-1, 1]: equal weights on the roots of (1 - x^2) P_k'(x) (Guest 1958, Hoel 1958)."""
    roots = legendre.Legendre.basis(degree).deriv().convert(kind=Polynomial).roots().real
    expected = np.sort(np.concatenate([[-1.0, 1.0], roots]))
    design = continuous_design(regression(degree))
    order = np.argsort(design.plan.postures[:, 0])
    points, weights = design.plan.postures[order, 0], design.plan.shares[order]
    merged = [weights[np.abs(points - x) < 1e-3].sum() for x in expected]
    assert merged == pytest.approx(np.full(degree + 1, 1.0 / (degree + 1)), abs=1e-6)
    assert design.status is Status.converged
    assert design.bound is not None
    assert not design.bound.rigorous  # no trigonometric polynomial: a multistart, and it says so


@pytest.mark.parametrize(("criterion", "ends"), [(A(), 1 / 4), (E(), 1 / 5), (Ds((2,)), 1 / 4)], ids=["A", "E", "Ds"])
def test_quadratic_regression_by_other_criteria(criterion: Criterion, ends: float) -> None:
    """Pukelsheim (2006), exhibit 9.9: support -1, 0, 1."""
    design = continuous_design(regression(2, criterion=criterion))
    x, weights = design.plan.postures[:, 0], design.plan.shares
    assert weights[np.abs(x + 1.0) < 1e-2].sum() == pytest.approx(ends, abs=2e-3 if criterion.name == "E" else 1e-6)
    assert weights[np.abs(x) < 1e-2].sum() == pytest.approx(1 - 2 * ends, abs=4e-3 if criterion.name == "E" else 1e-6)


EFFECTS = {
    "two harmonics": (OFFSET, ECCENTRICITY, EffectSpec("encoder_second_harmonic", 3)),
    "gear ratio": (OFFSET, EffectSpec("gear_ratio", 2), ECCENTRICITY),
}


@pytest.mark.parametrize(
    ("name", "links"),
    [("gear ratio", 3), *(pytest.param(name, 4, marks=pytest.mark.slow) for name in EFFECTS)],
)
def test_effects_in_the_model(name: str, links: int) -> None:
    """No random posture violates the equivalence theorem, and a fine grid has nothing better."""
    arm = Arm(FOUR.lengths[:links], FOUR.lower[:links], FOUR.upper[:links])
    case = problem(arm, *EFFECTS[name])
    design = continuous_design(case, tolerance=1e-8, proof=0.0)
    assert design.gap <= 1e-6
    assert design.bound is not None
    information = case.information(design.plan.postures, design.plan.shares)
    jacobians = case.scaled_jacobians(np.random.default_rng(9).uniform(case.lower, case.upper, (50_000, links)))
    d = np.einsum("kda,ab,kdb->k", jacobians, np.linalg.inv(information), jacobians, optimize=True)
    assert d.max() <= case.parameters + 1e-6
    coarse = column_generation(case, grid(case, 9))
    assert coarse.value <= design.bound.value + 1e-9


def test_what_the_multistart_misses_the_proof_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a search blind to large q_3 the loop ends early; branch and bound returns the posture that was missed."""
    arm = Arm(FOUR.lengths[:3], FOUR.lower[:3], FOUR.upper[:3])
    case = problem(arm)
    real = module.ContinuousSet.best

    def blind(self, gradient, near, *rest):  # type: ignore[no-untyped-def]
        postures = np.clip(real(self, gradient, near, *rest)[0], -0.5, 0.5, where=np.eye(3, dtype=bool)[2])
        values = self.sensitivities(postures, gradient)
        return postures[np.argsort(-values)], -np.sort(-values)

    starts = np.random.default_rng(0).uniform(case.lower, case.upper, (500, 3)) * [1.0, 1.0, 0.3]
    monkeypatch.setattr(module.ContinuousSet, "starts", starts)
    monkeypatch.setattr(module.ContinuousSet, "best", blind)
    design = continuous_design(case, tolerance=1e-8)
    expected = closed_form(arm.lower, arm.upper)
    if design.bound is None:  # it may give up, but it must not claim
        assert design.status is Status.almost_solved
    else:
        assert design.bound.value >= expected - 1e-9
    blinder = continuous_design(case, tolerance=1e-8, proof=0.0)
    assert blinder.log_det < expected - 0.1  # the oracle's trap works: without the proof the answer is wrong


def test_walls() -> None:
    """Constrained: every posture allowed, never above the box, never below a grid."""
    box = WorkspaceBox((250.0, 350.0), (250.0, 350.0))
    case = problem(Arm(FOUR.lengths[:3], FOUR.lower[:3], FOUR.upper[:3], 0.1, constraints=(box,)))
    design = continuous_design(case, tolerance=1e-8)
    assert case.feasible(design.plan.postures).all()
    assert design.bound is not None
    assert not design.bound.rigorous
    assert design.value <= closed_form(FOUR.lower[:3], FOUR.upper[:3])
    assert column_generation(case, grid(case, 25)).value <= design.bound.value + 1e-9


# -- finite sets -------------------------------------------------------------------------------------------------------
@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), links=st.integers(2, 4))
def test_equivalence_theorem_on_every_candidate(seed: int, links: int) -> None:
    generator = np.random.default_rng(seed)
    case = problem(random_box(generator, links))
    candidates = listed_candidates(case, generator.uniform(case.lower, case.upper, (400, links)))
    design = column_generation(case, candidates)
    jacobians = case.scaled_jacobians(candidates.postures)
    inverse = np.linalg.inv(case.information(design.plan.postures, design.plan.shares))
    d = np.array([np.trace(b @ inverse @ b.T) for b in jacobians])
    assert d.max() <= 2 * links + 1e-7
    assert design.gap == pytest.approx(d.max() - 2 * links, abs=1e-10)
    carried = design.plan.postures[design.plan.shares > 1e-6]  # w (p - d) vanishes, so d = p only where w does not
    at_support = np.array([np.trace(b @ inverse @ b.T) for b in case.scaled_jacobians(carried)])
    assert at_support == pytest.approx(2.0 * links, abs=1e-5)


def test_brute_force_over_all_exact_plans() -> None:
    """Every exact plan of 3 new runs out of 6 candidates, around 4 measured ones, is below the bound."""
    generator = np.random.default_rng(1)
    kept, choices = generator.uniform(FOUR.lower, FOUR.upper, (10, 4))[:4], None
    choices = generator.uniform(FOUR.lower, FOUR.upper, (6, 4))
    case = problem(FOUR, kept=kept)
    design = column_generation(case, PostureList(choices), runs=3)
    assert design.bound is not None
    values = [case.objective(choices[list(rows)]) for rows in combinations_with_replacement(range(6), 3)]
    assert max(values) <= design.bound.value + 1e-9
    assert design.bound.value <= max(values) + 1.0  # and the bound is not idle


def test_sampling_first_gives_the_same_answer() -> None:
    """Above 4 * SAMPLE candidates a random part of them is priced first; the end is judged on all of them."""
    case = problem(FOUR, ECCENTRICITY)
    axes = [np.linspace(a, b, 45) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True)]
    q = np.stack([np.zeros(45**3), *(a.ravel() for a in np.meshgrid(*axes))], axis=1)
    large = column_generation(case, PostureList(q))
    assert len(q) > 4 * module.SAMPLE
    inverse = np.linalg.inv(case.information(large.plan.postures, large.plan.shares))
    rows = case.scaled_jacobians(q) @ np.linalg.cholesky(inverse)
    assert np.square(rows).sum(axis=(1, 2)).max() <= case.parameters + 1e-7


@pytest.mark.parametrize("name", ["A", "I", "Ds", "E"])
def test_other_criteria_have_no_better_neighbor(name: str) -> None:
    """Directional derivatives of Phi towards every candidate are <= 0, by differences of Phi itself."""
    generator = np.random.default_rng(2)
    base = problem(FOUR)
    tests = base.scaled_jacobians(generator.uniform(FOUR.lower, FOUR.upper, (10, 4)))
    criterion: Criterion = {"A": A(), "I": I(tests), "Ds": Ds((0, 1)), "E": E()}[name]
    case = problem(FOUR, criterion=criterion)
    candidates = grid(case, 5)
    design = column_generation(case, candidates)
    best = case.information(design.plan.postures, design.plan.shares)
    assert design.value == pytest.approx(float(criterion.value(best)), rel=1e-12)
    assert design.bound is not None
    assert design.value <= design.bound.value + 1e-9
    everything = candidates.take(np.arange(len(candidates)))
    for _ in range(300):
        rows = generator.integers(len(everything), size=generator.integers(1, 12))
        other = case.information(everything[rows], generator.dirichlet(np.ones(len(rows))))
        value = float(criterion.value(0.99 * best + 0.01 * other))
        assert value <= design.bound.value + 1e-9
        assert float(criterion.value(other)) <= design.bound.value + 1e-9


def test_not_identifiable() -> None:
    with pytest.raises(JobError, match="identified"):
        column_generation(problem(FOUR), PostureList(np.zeros((3, 4))))
    with pytest.raises(JobError, match="identified"):  # without a drift in time, a drift cannot be told from nothing
        continuous_design(problem(FOUR, EffectSpec("base_rotation")))


def test_d_is_the_default_and_units_do_not_matter() -> None:
    """D-optimal weights are the same for links in other units (invariance); the value is scaled away by S."""
    metres = Arm(FOUR.lengths / 1000.0, FOUR.lower, FOUR.upper)
    assert problem(FOUR).criterion == D()
    assert continuous_design(problem(metres)).log_det == pytest.approx(closed_form(FOUR.lower, FOUR.upper), abs=1e-9)
