"""What is known before the new runs enters every information matrix: against the mean over all rows."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations, product
from types import MappingProxyType, SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from doe import DesignProblem, score_plan, solve
from doe.advise import advise
from doe.bounds.column_generation import relax
from doe.discrimination.t_optimal import RivalPredictions, discriminate
from doe.plan.accuracy import ExpectedDeviations, TipErrors, robust_problem
from doe.problem.constraints import Expression
from doe.problem.model import REQUIRED
from doe.problem.problem import grid, listed_candidates
from identification import Array, InputError, Measurements, Parameter, ParameterSet, diagnose, estimate, vectorize
from tests.doe.arms import ECCENTRICITY, FOUR, OFFSET, problem


def test_information_with_measured_postures_is_the_information_of_all_runs() -> None:
    """k kept and m new runs: M of the weighted plan equals the mean over all k + m rows."""
    kept, new = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (2, 5, 4))
    case = problem(FOUR, OFFSET, ECCENTRICITY, kept=kept)
    prior = case.prior.per_new_run(10)
    weights = np.array([0.1, 0.2, 0.3, 0.3, 0.1])  # ten runs: 1, 2, 3, 3, 1
    rows = np.concatenate([kept, np.repeat(new, [1, 2, 3, 3, 1], axis=0)])
    expected = problem(FOUR, OFFSET, ECCENTRICITY).information(rows)
    information = prior.mixture(case.scaled_jacobians(new), weights)
    assert information == pytest.approx(expected, rel=1e-12, abs=1e-12)
    gradient = np.linalg.inv(information)
    jacobians = case.scaled_jacobians(new)
    g = prior.sensitivities(jacobians, gradient)
    assert weights @ g == pytest.approx(case.parameters, abs=1e-9)  # tr(G M) = p
    assert g == pytest.approx(
        [np.sum(gradient * f) for f in prior.information(np.swapaxes(jacobians, 1, 2) @ jacobians)], rel=1e-12
    )


def test_rows_measured_already_count_by_their_own_scatter() -> None:
    """Generalized least squares: cov^-1 = sum J^T J / sigma_i^2 over new and kept rows, each with its own sigma_i."""
    plan, kept = np.random.default_rng(3).uniform(FOUR.lower, FOUR.upper, (2, 6, 4))
    sigma, own = 0.1, np.array([0.02, 0.1, 0.2, 0.5, 1.0, 3.0])
    case = problem(replace(FOUR, sigma=sigma), kept=kept, kept_excess=own**2 - sigma**2)
    weighted = [(case.model.jacobian(q[None])[0], s) for q, s in zip([*plan, *kept], [sigma] * 6 + [*own], strict=True)]
    deviations = np.sqrt(np.diag(np.linalg.inv(sum(j.T @ j / s**2 for j, s in weighted))))
    expected = ExpectedDeviations.of(case, plan)
    assert expected is not None
    assert expected.values == pytest.approx(deviations, rel=1e-9)
    scaled = case.model.parameters.scales * deviations / sigma  # of S (sum J^T J) S, 12 runs
    assert np.diag(np.linalg.inv(case.information(plan))) / 12 == pytest.approx(scaled**2, rel=1e-9)


def test_measured_postures_need_the_number_of_runs() -> None:
    case = problem(FOUR, kept=np.zeros((2, 4)))
    for runs in (None, 0):
        with pytest.raises(InputError, match="runs"):
            case.prior.per_new_run(runs)


# -- grids and lists ---------------------------------------------------------------------------------------------------
def above(least: float) -> Expression:
    """q_3 >= least."""
    return Expression(lambda q: q[2] - least, 4)


def test_grid_is_the_product_of_its_axes() -> None:
    made = grid(problem(FOUR), 3)
    axes = [np.linspace(a, b, 3) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True)]
    np.testing.assert_array_equal(made[:, 1:], list(product(*axes)))
    assert np.all(made[:, 0] == 0.0)  # q_1 plays no part
    every = grid(problem(FOUR, OFFSET), 5)
    assert len(every) == 5**4  # with a base offset q_1 matters
    for bound in (FOUR.lower, FOUR.upper):
        assert np.any(np.all(every == bound, axis=1))


def test_constraints_and_limits_drop_candidates() -> None:
    case = problem(FOUR, constraints=(above(0.1),))
    full = grid(problem(FOUR, OFFSET), 6)
    np.testing.assert_array_equal(grid(case, 6), full[full[:, 2] >= 0.1])  # all joints: constraints tie them
    listed = np.array([[0.0, 1.0, 0.5, 1.0], [0.0, 1.0, -0.5, 1.0], [0.0, 2.2, 0.5, 1.0]])
    np.testing.assert_array_equal(listed_candidates(case, listed), listed[:1])


def test_a_list_from_a_file_in_degrees_may_touch_the_limits() -> None:
    made = listed_candidates(problem(FOUR), [[0.0, FOUR.upper[1] + 4e-10, 0.0, FOUR.lower[3] - 4e-10]])
    assert len(made) == 1
    assert np.all((made >= FOUR.lower) & (made <= FOUR.upper))


def test_bad_input() -> None:
    case = problem(FOUR)
    with pytest.raises(InputError, match=r"^criterion: 'A', allowed: an object with value\(\)"):
        replace(case, criterion="A")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="at least 2"):
        grid(case, 1)
    with pytest.raises(InputError, match="2 to 256, which are 16,777,216 candidates at most"):
        grid(case, 500)
    with pytest.raises(InputError, match=r"allowed: \(N, 4\)"):
        listed_candidates(case, np.zeros((3, 5)))
    with pytest.raises(InputError, match="row 2"):
        listed_candidates(case, np.array([[0.0] * 4, [np.nan] * 4]))
    with pytest.raises(InputError, match="0 of 2"):
        listed_candidates(case, np.full((2, 4), 3.1))
    with pytest.raises(InputError, match="0 of "):
        grid(problem(FOUR, constraints=(above(9.0),)), 3)


# -- models that are no arm --------------------------------------------------------------------------------------------
class Sine:
    """y = a sin(q + b) + c q, of one joint; c is there for `terms` = 3 only."""

    dimension, joint_types, sigma = 1, ("revolute",), 0.5
    lower, upper = np.array([-1.0]), np.array([2.0])
    prior: Mapping[str, float] = MappingProxyType({})

    def __init__(self, terms: int = 2) -> None:
        every = [Parameter("a", "mm", kind="size"), Parameter("b", "rad", scale=100.0, kind="phase")]
        every.append(Parameter("c", "mm/session"))
        self.parameters, self.values = ParameterSet(every[:terms]), np.array([100.0, 0.2, 0.0])[:terms]

    def symbolic_position(self, q: ca.SX, p: ca.SX) -> ca.SX:
        return p[0] * ca.sin(q + p[1]) + (p[2] * q if p.numel() > 2 else 0.0)


SINE = DesignProblem.of(Sine(), minimum_distance=0.0)
FINE = np.linspace(-1.0, 2.0, 3001)


def rows(q: Array, terms: int = 2) -> Array:
    """(m, terms) sensitivities per mm at the tip, by hand."""
    return np.stack([np.sin(q + 0.2), np.cos(q + 0.2), q], axis=-1)[..., :terms]


def log_det(q: Array) -> float:
    return float(np.linalg.slogdet(rows(q).T @ rows(q) / len(q))[1])


def test_a_plan_of_a_sine_is_the_best_of_all_pairs() -> None:
    """Points whose double angles sum to zero, such as two a quarter of a turn apart: log det = -2 log 2."""
    design = solve(SINE, 4, seed=1)
    assert design.certified_optimal
    assert design.value == pytest.approx(-2.0 * np.log(2.0), abs=1e-9)
    assert design.value == pytest.approx(log_det(design.plan.postures[:, 0]), abs=1e-9)
    assert max(log_det(np.array(pair)) for pair in combinations(FINE[::20], 2)) <= design.value + 1e-9
    assert design.to_json()["table_1_max_residual"] is None
    np.testing.assert_allclose(design.deviations.values * [1.0, 100.0], 0.5 / np.sqrt(2.0), rtol=1e-6)


def test_relaxation_advice_and_score_of_a_sine() -> None:
    assert relax(SINE, FINE[:, None]).value == pytest.approx(-2.0 * np.log(2.0), abs=1e-6)
    advice = advise(SINE, [2, 3, 4, 8], target=0.3)
    assert advice.efficient_runs() == (2, 3, 4, 8)  # three points 60 degrees apart are as good
    assert len(advice.smallest.plan) == 8  # 0.5 sqrt(2 / 4) = 0.35, 0.5 sqrt(2 / 8) = 0.25
    scored = score_plan(SINE, np.array([[0.0], [0.1]]))
    assert scored.efficiency == pytest.approx(np.exp((log_det(np.array([0.0, 0.1])) + 2.0 * np.log(2.0)) / 2.0))


def test_the_next_posture_tells_a_sine_from_one_with_a_slope() -> None:
    """Both fitted to five postures near zero; the noncentrality of a posture by a refit of the rival with it."""
    first = np.linspace(-0.3, 0.3, 5)
    line = Sine(3)
    line.values = np.array([100.0, 0.2, 1.5])
    problems = DesignProblem.of(Sine()), DesignProblem.of(line)
    scales = [np.array([1.0, 100.0]), np.array([1.0, 100.0, 1.0])]
    covariances = [
        0.25 * np.linalg.inv(rows(first, p).T @ rows(first, p)) / np.outer(s, s)
        for p, s in zip((2, 3), scales, strict=True)
    ]
    candidates = [SimpleNamespace(effects=(name,), delta_bic=0.0, probability=0.5) for name in ("sine", "slope")]

    def predictions(q: Array, *_: object) -> list[tuple[Array, ...]]:
        shown = [problem.scaled_jacobians(q) * s for problem, s in zip(problems, scales, strict=True)]
        return list(zip((0.0 * q, 1.5 * q), shown, covariances, scales, strict=True))

    diagnosis: Any = SimpleNamespace(candidates=candidates, predictions=predictions, sigma=0.5, needs=frozenset())
    rivals = RivalPredictions.of(diagnosis, FINE[:, None], None, np.ones((len(FINE), 1)))
    delta = 1.5 * FINE
    spread = 0.25 + np.einsum("kp,pq,kq->k", rows(FINE), covariances[0] * np.outer(scales[0], scales[0]), rows(FINE))
    np.testing.assert_allclose(rivals.noncentrality([])[1][1, 0], delta**2 / spread, rtol=1e-9)
    (chosen,) = discriminate(Sine(), diagnosis, 1).plan.postures[:, 0]
    assert abs(chosen - FINE[rivals.best_beside([])]) < 0.02  # of 1,500 postures at random
    assert abs(chosen) > 0.5


def test_a_member_that_is_missing_is_named() -> None:
    for name in REQUIRED:
        members = {each: getattr(Sine(), each) for each in REQUIRED if each != name}
        with pytest.raises(InputError, match=rf"^model: Less, allowed: one with {name} and all of"):
            DesignProblem.of(type("Less", (), members)())
    with pytest.raises(InputError, match=r"^robust: Sine has no missing_effects"):
        robust_problem(SINE)
    with pytest.raises(InputError, match=r"^constraints: Walled has no space"):
        DesignProblem.of(type("Walled", (Sine,), {"constraints": ["a wall"]})())
    assert TipErrors.of(SINE) is None


class FiveBar:
    """Two motors at (0, 0) and (BASE, 0) turn links of 200 mm; two links of 300 mm join their ends at the tip, which is
    measured. Errors of the four lengths and of the two encoders are to be found."""

    dimension, joint_types, sigma, base = 2, ("revolute",) * 2, 0.05, 150.0
    lengths = np.array([200.0, 200.0, 300.0, 300.0])
    lower, upper = np.radians([100.0, 0.0]), np.radians([180.0, 80.0])
    prior: Mapping[str, float] = MappingProxyType({})
    parameters = ParameterSet(
        [Parameter(f"length_error:{k}", "mm", kind="length") for k in range(1, 5)]
        + [Parameter(f"joint_offset:{k}", "rad", scale=200.0, kind="joint_offset", joint=k) for k in (1, 2)]
    )
    values = np.zeros(6)

    def symbolic_position(self, q: ca.SX, p: ca.SX) -> ca.SX:
        lengths, angles = ca.DM(self.lengths) + p[:4], q + p[4:]
        left = lengths[0] * ca.vertcat(ca.cos(angles[0]), ca.sin(angles[0]))
        right = lengths[1] * ca.vertcat(ca.cos(angles[1]), ca.sin(angles[1])) + ca.DM([self.base, 0.0])
        across, gap = right - left, ca.norm_2(right - left)
        along = (lengths[2] ** 2 - lengths[3] ** 2 + gap**2) / (2.0 * gap)
        height = ca.sqrt(lengths[2] ** 2 - along**2)
        unit = across / gap
        return left + along * unit + height * ca.vertcat(-unit[1], unit[0])

    # what a fit asks for besides
    names, scales, joints, reach, closed_form, effects = parameters.names, parameters.scales, 2, 500.0, None, ()

    def linearize(
        self, postures: Array, parameters: Array | None = None, conditions: object = None
    ) -> tuple[Array, Array]:
        q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 6)
        tip = self.symbolic_position(q, p)
        values = self.values if parameters is None else np.asarray(parameters, dtype=float)
        evaluated = vectorize(ca.Function("five_bar", [q, p], [tip, ca.jacobian(tip, p)]))(
            postures, values[..., None, :]
        )
        return evaluated[0][..., 0], evaluated[1]

    def position(self, postures: Array, parameters: Array | None = None, conditions: object = None) -> Array:
        return self.linearize(postures, parameters)[0]

    def jacobian(self, postures: Array, parameters: Array | None = None, conditions: object = None) -> Array:
        return self.linearize(postures, parameters)[1]


def five_bar_tip(q: Array, values: Array) -> Array:
    """(m, 2) by rotating the triangle of the two long links about the left elbow, law of cosines."""
    a, b, c, d = np.array(FiveBar.lengths) + values[:4]
    left = a * np.exp(1j * (q[:, 0] + values[4]))
    right = FiveBar.base + b * np.exp(1j * (q[:, 1] + values[5]))
    gap = np.abs(right - left)
    tip = left + c * np.exp(1j * (np.angle(right - left) + np.arccos((c**2 + gap**2 - d**2) / (2.0 * c * gap))))
    return np.stack([tip.real, tip.imag], axis=1)


def test_a_five_bar_linkage_is_designed_identified_and_refused_a_diagnosis() -> None:
    problem, generator = DesignProblem.of(FiveBar()), np.random.default_rng(0)
    design = solve(problem, 8, seed=0, starts=20)
    at_random = generator.uniform(problem.lower, problem.upper, (200, 8, 2))
    step = 1e-5 / FiveBar.scales
    columns = [
        (five_bar_tip(design.plan.postures, s) - five_bar_tip(design.plan.postures, -s)).ravel() / 2e-5
        for s in np.diag(step)
    ]
    information = np.array(columns) @ np.array(columns).T / 8.0
    assert design.value == pytest.approx(np.linalg.slogdet(information)[1], abs=1e-4)
    assert design.value > max(problem.objective(plan) for plan in at_random)
    assert design.bound.value >= design.value
    truth = np.array([0.5, -0.3, 0.4, 0.2, 0.003, -0.002])
    exact = five_bar_tip(design.plan.postures, truth)
    data = Measurements(design.plan.postures, exact + 0.05 * generator.standard_normal(exact.shape))
    fit = estimate(FiveBar(), data)  # type: ignore[arg-type]
    assert np.all(np.abs(fit.parameters - truth) < 4.0 * design.deviations.values)
    with pytest.raises(InputError, match=r"FiveBar, allowed: a Model, as in Model\(arm\), or one with reach$"):
        estimate(type("FiveBar", (), {name: value for name, value in vars(FiveBar).items() if name != "reach"})(), data)
    with pytest.raises(InputError, match=r"^arm: FiveBar, allowed: an Arm"):
        diagnose(FiveBar(), data)  # type: ignore[arg-type]
