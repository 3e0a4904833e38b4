"""Column generation against closed forms, textbooks, brute force and the equivalence theorem."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial, legendre
from scipy.optimize import minimize

from doe.bounds import column_generation as module
from doe.bounds import weights as programs
from doe.bounds.column_generation import (
    LARGEST,
    CandidateSet,
    ContinuousSet,
    best_design,
    column_generation,
    continuous_design,
    generate_columns,
    relax,
)
from doe.bounds.planar_theorem import closed_form_bound
from doe.criteria import A, Criterion, D, Ds, E, I
from doe.problem.problem import PriorInformation, grid, listed_candidates, random_postures
from identification import Arm, Array, EffectSpec, InputError, JobError, Status
from identification.workspace import KeepOut, WorkspaceBox
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, problem, random_box, regression
from tests.doe.problem.test_constraints import ARM as WALLED
from tests.doe.problem.test_constraints import BOX


# -- the continuous box ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("links", [1, 2, 4, 7])
def test_continuous_box_equals_the_closed_form(links: int) -> None:
    # the base is a link 0 with orientation 0: joint 1 counts as the others do
    case = problem(random_box(np.random.default_rng(links), links), *[OFFSET] * (links % 2))
    design, expected = continuous_design(case), closed_form_bound(case).value
    assert design.log_det == pytest.approx(expected, abs=1e-9)
    assert design.bound.rigorous
    assert design.bound.source == "continuous"
    assert expected - 1e-12 <= design.bound.value <= expected + 1e-8
    assert design.plan.shares.sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("degree", [1, 2, 5])
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
    assert not design.bound.rigorous  # no trigonometric polynomial: a multistart, and it says so


EFFECTS = {
    "two harmonics": (OFFSET, ECCENTRICITY, EffectSpec("encoder_second_harmonic", 3)),
    "gear ratio": (OFFSET, EffectSpec("gear_ratio", 2), ECCENTRICITY),
}


@pytest.mark.parametrize(
    ("name", "links"), [("gear ratio", 3), *(pytest.param(name, 4, marks=pytest.mark.slow) for name in EFFECTS)]
)
def test_effects_in_the_model(name: str, links: int) -> None:
    """No random posture violates the equivalence theorem, and a fine grid has nothing better."""
    case = problem(Arm(FOUR.lengths[:links], FOUR.lower[:links], FOUR.upper[:links]), *EFFECTS[name])
    design = continuous_design(case, tolerance=1e-8, proof=0.0)
    assert design.gap <= 1e-6
    information = case.information(design.plan.postures, design.plan.shares)
    jacobians = case.scaled_jacobians(np.random.default_rng(9).uniform(case.lower, case.upper, (10_000, links)))
    d = np.einsum("kda,ab,kdb->k", jacobians, np.linalg.inv(information), jacobians, optimize=True)
    assert d.max() <= case.parameters + 1e-6
    assert column_generation(case, grid(case, 9)).value <= design.bound.value + 1e-9


def test_what_the_multistart_misses_the_proof_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a search blind to large q_3 the loop ends early; branch and bound returns the posture that was missed."""
    case = problem(Arm(FOUR.lengths[:3], FOUR.lower[:3], FOUR.upper[:3]))
    real = module.ContinuousSet.best

    def blind(self, gradient, near, *rest):  # type: ignore[no-untyped-def]
        postures = np.clip(real(self, gradient, near, *rest)[0], -0.5, 0.5, where=np.eye(3, dtype=bool)[2])
        values = self.sensitivities(postures, gradient)
        return postures[np.argsort(-values)], -np.sort(-values)

    starts = np.random.default_rng(0).uniform(case.lower, case.upper, (500, 3)) * [1.0, 1.0, 0.3]
    monkeypatch.setattr(module.ContinuousSet, "starts", starts)
    monkeypatch.setattr(module.ContinuousSet, "best", blind)
    design = continuous_design(case, tolerance=1e-8)
    expected = closed_form_bound(case).value
    if design.bound is None:  # it may give up, but it must not claim
        assert design.status is Status.almost_solved
    else:
        assert design.bound.value >= expected - 1e-9
    blinder = continuous_design(case, tolerance=1e-8, proof=0.0)
    assert blinder.log_det < expected - 0.1  # the oracle's trap works: without the proof the answer is wrong


# -- finite sets -------------------------------------------------------------------------------------------------------
@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), links=st.integers(2, 4))
def test_equivalence_theorem_on_every_candidate(seed: int, links: int) -> None:
    generator = np.random.default_rng(seed)
    case = problem(random_box(generator, links))
    candidates = listed_candidates(case, generator.uniform(case.lower, case.upper, (400, links)))
    design = column_generation(case, candidates)
    jacobians = case.scaled_jacobians(candidates)
    inverse = np.linalg.inv(case.information(design.plan.postures, design.plan.shares))
    d = np.array([np.trace(b @ inverse @ b.T) for b in jacobians])
    assert d.max() <= 2 * links + 1e-7
    assert design.gap == pytest.approx(d.max() - 2 * links, abs=1e-10)
    carried = design.plan.postures[design.plan.shares > 1e-6]  # w (p - d) vanishes, so d = p only where w does not
    at_support = np.array([np.trace(b @ inverse @ b.T) for b in case.scaled_jacobians(carried)])
    assert at_support == pytest.approx(2.0 * links, abs=1e-5)


def test_sampling_first_gives_the_same_answer() -> None:
    """Of more than 80,000 candidates a random part of them is priced first; the end is judged on all of them."""
    case = problem(FOUR, ECCENTRICITY)
    axes = [np.linspace(a, b, 45) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True)]
    q = np.stack([np.zeros(45**3), *(a.ravel() for a in np.meshgrid(*axes))], axis=1)
    large = column_generation(case, q)
    inverse = np.linalg.inv(case.information(large.plan.postures, large.plan.shares))
    rows = case.scaled_jacobians(q) @ np.linalg.cholesky(inverse)
    assert np.square(rows).sum(axis=(1, 2)).max() <= case.parameters + 1e-7


@pytest.mark.parametrize("criterion", [D(), A()])
@pytest.mark.parametrize("deviations", [{}, {"encoder_eccentricity:2.a": 5e-4, "encoder_eccentricity:2.b": 5e-4}])
def test_a_rough_answer_is_within_its_gap_of_the_optimum(criterion: Criterion, deviations: dict[str, float]) -> None:
    """Its value is below the optimum and its bound above, both within the gap that it stops at; also from few."""
    case = problem(FOUR, ECCENTRICITY, deviations=deviations, criterion=criterion)
    candidates = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (3000, 4))
    found, exact = (column_generation(case, candidates, runs=20, tolerance=gap) for gap in (0.01, 1e-9))
    assert found.value <= exact.value + 1e-9
    assert exact.value <= exact.bound.value <= found.bound.value + 1e-9
    assert 0.97 < found.efficiency_lower_bound <= 1.0
    every = CandidateSet(case, candidates, case.prior.per_new_run(20))
    few, gap = generate_columns(case, every.prior, candidates[:40], [every.price], 0.02, 0.01)
    assert (few.value <= exact.value + 1e-9, gap <= 0.02 * abs(few.level)) == (True, True)


# -- the loop, with a pricing that is written out: all postures of a short list ----------------------------------------
POSTURES = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (200, 4))


@pytest.mark.parametrize("criterion", [D(), A(), E()], ids=["D", "A", "E"])
def test_without_time_equal_weights_prove_a_bound(criterion: Criterion) -> None:
    """No weights on the list are better than what the gradient at equal ones allows: none of 200 random mixtures."""
    case, prior = problem(FOUR, criterion=criterion), PriorInformation()
    jacobians = case.scaled_jacobians(POSTURES)
    found, _ = generate_columns(case, prior, POSTURES[:40], [], 1e-9, 1e-9, lambda: True)
    assert sum(found.plan.shares) == pytest.approx(1.0)
    np.testing.assert_allclose(found.information, np.einsum("kda,kdb->ab", *[jacobians[:40]] * 2) / 40.0, atol=1e-12)
    bound = criterion.upper_bound(found.information, max(float(np.trace(found.gradient @ b.T @ b)) for b in jacobians))
    mixtures = np.random.default_rng(1).dirichlet(np.full(200, 0.05), 200)
    assert criterion.value(np.einsum("wk,kda,kdb->wab", mixtures, jacobians, jacobians)).max() <= bound


# -- relax: independent solvers, and what is believed of them ----------------------------------------------------------
TEST_JACOBIANS = problem(FOUR).scaled_jacobians(np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (8, 4)))
SOLVERS = ("clarabel", "scs", "column_generation")
CRITERIA: dict[str, Criterion] = {"D": D(), "A": A(), "I": I(TEST_JACOBIANS), "E": E()}
# what an interior point of cvxpy's default accuracy (1e-8 on the program) leaves of the gap
GAPS = {"clarabel": 1e-3, "scs": 1e-5, "column_generation": 1e-6}


@pytest.mark.parametrize("criterion", CRITERIA.values(), ids=CRITERIA)
def test_independent_solvers_agree(criterion: Criterion) -> None:
    case = problem(FOUR, criterion=criterion)
    found = {solver: relax(case, 5, solver) for solver in SOLVERS}
    exact = found["column_generation"]
    for solver, design in found.items():
        assert design.candidates == 125
        assert design.status is Status.converged
        assert design.gap <= GAPS[solver] * max(1.0, abs(exact.value))
        assert design.value == pytest.approx(exact.value, rel=1e-4, abs=1e-5)
        assert design.value <= exact.bound.value + 1e-9
        assert design.bound.value >= exact.value - 1e-9
        assert design.bound.source == "grid"
        assert design.efficiency_lower_bound >= 1.0 - 1e-3
        assert design.plan.shares.sum() == pytest.approx(1.0, abs=1e-12)
        assert design.plan.shares.min() > 0.0


def test_what_a_solver_says_of_its_weights_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gap of the weights decides whether there is a bound."""
    exact, optimal = relax(problem(FOUR), 3), programs.solve_program
    monkeypatch.setattr(module, "solve_program", lambda *request: (optimal(*request)[0], "unknown_to_us", None))
    found = relax(problem(FOUR), 3, "clarabel")
    assert (found.status, found.to_json()["solver_status"]) == (Status.converged, "unknown_to_us")
    assert found.bound.value == pytest.approx(exact.bound.value, abs=1e-3)
    monkeypatch.setattr(module, "solve_program", lambda *_: (np.full(27, 1.0 / 27.0), "optimal", None))
    found = relax(problem(FOUR), 3, "clarabel")
    assert (found.status, found.bound, found.to_json()["bound"]) == (Status.almost_solved, None, None)
    assert 0.0 < found.efficiency_lower_bound < 0.99


def test_no_weights_is_a_job_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "solve_program", lambda *_: (None, "solver_error", None))
    with pytest.raises(JobError, match=r"solver_error on 27 candidates.*column_generation"):
        relax(problem(FOUR), 3, "clarabel")


def test_bad_input() -> None:
    with pytest.raises(InputError, match="did you mean 'clarabel'"):
        relax(problem(FOUR), 3, "clarabell")
    with pytest.raises(InputError, match="Ds has no program"):
        relax(problem(FOUR, criterion=Ds((0,))), 3, "clarabel")
    with pytest.raises(InputError, match=f"{LARGEST['clarabel']}.*column_generation"):
        relax(problem(FOUR), 60, "clarabel")
    with pytest.raises(JobError, match="identify"):
        relax(problem(FOUR), np.zeros((3, 4)), "clarabel")


# -- the climb ---------------------------------------------------------------------------------------------------------
CASES = {
    "base": problem(FOUR),
    "five links, effects": problem(FIVE, OFFSET, EffectSpec("gear_ratio", 3)),
    "walls": problem(WALLED, OFFSET, ECCENTRICITY),
}


def some_gradient(case, generator: np.random.Generator) -> Array:  # type: ignore[no-untyped-def]
    """M^-1 of a random design."""
    postures = generator.uniform(case.lower, case.upper, (3 * case.parameters, case.joints))
    return np.linalg.inv(case.information(postures))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_slopes_by_finite_differences(case) -> None:  # type: ignore[no-untyped-def]
    generator = np.random.default_rng(0)
    everything = ContinuousSet(case, PriorInformation(np.eye(case.parameters), 0.4))
    gradient = some_gradient(case, generator)
    q = generator.uniform(case.lower, case.upper, (5, case.joints))
    slope, hessian = everything.slopes(q, gradient)
    h = 1e-5
    for joint, e in enumerate(np.eye(case.joints)):
        up, down = (everything.sensitivities(q + s * h * e, gradient) for s in (1, -1))
        assert slope[:, joint] == pytest.approx((up - down) / (2 * h), rel=1e-6, abs=1e-6 * np.abs(slope).max())
        up, down = (everything.slopes(q + s * h * e, gradient)[0] for s in (1, -1))
        assert hessian[:, joint] == pytest.approx((up - down) / (2 * h), rel=1e-6, abs=1e-6 * np.abs(hessian).max())


def test_nothing_higher_within_walls_by_scipy() -> None:
    """Nor does SLSQP under the constraints."""
    case = problem(replace(FOUR, constraints=(BOX,)), OFFSET, ECCENTRICITY)
    generator = np.random.default_rng(3)
    everything, gradient = ContinuousSet(case, PriorInformation()), some_gradient(case, generator)
    best = everything.best(gradient, np.empty((0, 4)), generator)[1][0]
    walls = {"type": "ineq", "fun": lambda q: case.constraints[0].margin(q[None])[0] / 100.0}
    for start in random_postures(case, 40, generator):
        found = minimize(
            lambda q: -everything.sensitivities(q[None], gradient)[0],
            start, jac=lambda q: -everything.slopes(q[None], gradient)[0][0], method="SLSQP",
            bounds=list(zip(case.lower, case.upper, strict=True)), constraints=[walls],
        )  # fmt: skip
        if case.constraints[0].margin(case.clip(found.x)[None]).min() >= 0.0:
            assert everything.sensitivities(case.clip(found.x)[None], gradient)[0] <= best + 1e-6


def test_a_corner_between_walls_and_limits_is_not_missed() -> None:
    """The best posture is where a wall cuts three lower limits, of which random postures come within no degree; no
    weights on a list of postures with joints at limits exceed the bound (by 0.7 where it is missed)."""
    lower, upper = np.radians([[-10.0, -153.0, 1.0, -26.0], [49.0, 65.0, 90.0, 108.0]])
    walls = WorkspaceBox((-333.0, 351.0), (-204.0, 624.0)), KeepOut((320.0, -181.0), 49.0)
    arm = Arm([192.0, 154.0, 141.0, 137.0], lower, upper, constraints=walls)
    case = problem(arm, EffectSpec("gear_ratio", 4), EffectSpec("encoder_second_harmonic", 4))
    anywhere = np.random.default_rng(0).uniform(lower, upper, (4_000, 4))
    on_faces = np.choose(np.random.default_rng(1).integers(0, 3, anywhere.shape), [lower, upper, anywhere])
    listed = relax(case, on_faces[case.feasible(on_faces)])
    assert listed.value <= best_design(case, 12).bound.value <= listed.value + 0.05
