"""Designs for arms whose model may lack effects: prior and criterion against the mathematics, written again."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from doe import DesignProblem, score, solve
from doe.bounds.column_generation import ContinuousSet, best_known_bound, column_generation, continuous_design
from doe.criteria import A, D
from doe.plan.accuracy import missing_effects, robust_problem, with_choices, workspace
from identification import Arm, Array, Conditions, InputError, Model, chain_of
from identification.instruments import Tracker
from identification.workspace import KeepOut
from tests.doe.plan.test_accuracy import ARM, PLAIN, POSTURES
from tests.doe.plan.test_accuracy import WIDE as CASE
from tests.identification.test_sessions import TABLE_ROWS

LENGTHS = ARM.lengths
DEVIATIONS = np.array([1.0, 1.0, *[5e-4] * 4, *[1e-4] * 2])  # base x, y; a, b of joint 1, then 2; e of 1 and 2
FOURS = list(combinations(range(8), 4))


def tip(q: Array, x: Array) -> complex:
    """Position, in the order dl, dq, base, eccentricities, gear ratios: written again from the mathematics."""
    angles = q + x[2:4] + x[6:10:2] * np.cos(q) + x[7:10:2] * np.sin(q) + x[10:12] * q
    return complex((LENGTHS + x[:2]) @ np.exp(1j * np.cumsum(angles)) + x[4] + 1j * x[5])


def columns(postures: Array) -> Array:
    """(m, 2, 12) central differences."""
    steps = np.diag([1e-2, 1e-2, *[1e-5] * 2, 1e-2, 1e-2, *[1e-5] * 6])
    made = [[(tip(q, step) - tip(q, -step)) / (2.0 * step.max()) for step in steps] for q in postures]
    return np.stack([np.real(made), np.imag(made)], axis=1)


def posterior(postures: Array) -> Array:
    """(12, 12) covariance of all parameters, inverse of information / sigma^2 + prior precision."""
    rows = columns(postures).reshape(-1, 12)
    return np.linalg.inv(rows.T @ rows / 0.1**2 + np.diag(np.r_[np.zeros(4), DEVIATIONS**-2.0]))


def in_my_order() -> list[int]:
    names = ["length_error:1", "length_error:2", "joint_offset:1", "joint_offset:2", "base_offset.x0", "base_offset.y0"]
    names += [f"encoder_eccentricity:{j}.{s}" for j in (1, 2) for s in "ab"] + ["gear_ratio:1.e", "gear_ratio:2.e"]
    assert set(names) == set(CASE.model.parameters.names)
    return [CASE.model.parameters.index(name) for name in names]


def test_d_is_the_determinant_of_the_joint_posterior() -> None:
    scales = CASE.model.parameters.scales[in_my_order()]
    expected = (
        -np.linalg.slogdet(posterior(POSTURES))[1] + 12 * np.log(0.1**2 / len(POSTURES)) - 2 * np.log(scales).sum()
    )
    design = score(replace(CASE, criterion=D()), POSTURES)
    assert design.value == pytest.approx(expected, abs=1e-6)
    assert design.log_det == design.value
    assert CASE.fewest_runs == 2  # four lengths and offsets; eight more of which something is known


def test_a_and_the_expected_deviations_are_those_of_the_posterior() -> None:
    order, covariance = in_my_order(), posterior(POSTURES)
    design = score(replace(CASE, criterion=A()), POSTURES)
    scaled = np.diag(covariance) * CASE.model.parameters.scales[order] ** 2
    assert design.value == pytest.approx(-scaled.sum() * len(POSTURES) / 0.1**2, rel=1e-6)
    assert design.deviations.values[order] == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-6)


@pytest.mark.parametrize("criterion", [None, D()])
def test_sensitivity_is_below_the_bound_at_the_optimum(criterion: D | None) -> None:
    """Optimal weights over all postures, and tr(G F) by its own formula on a grid of 2 or 3 degrees."""
    case = CASE if criterion is None else replace(CASE, criterion=criterion)
    runs = 12
    found = continuous_design(case, runs=runs)
    jacobians, known = case.scaled_jacobians(found.plan.postures), np.diag(case.precisions)
    information = np.einsum("k,kda,kdb->ab", found.plan.shares, jacobians, jacobians) + known / runs
    gradient = case.criterion.gradient(information)
    fine = np.stack(np.meshgrid(*np.linspace(case.lower, case.upper, 109).T), axis=-1).reshape(-1, 2)
    moved = case.scaled_jacobians(fine)
    sensitivity = np.einsum("kda,ab,kdb->k", moved, gradient, moved) + np.sum(gradient * known) / runs
    level = np.sum(gradient * information)
    on_grid = np.einsum("kda,ab,kdb->k", jacobians, gradient, jacobians) + np.sum(gradient * known) / runs
    assert on_grid.max() <= level * (1.0 + 1e-6)  # equality on the support
    assert sensitivity.max() <= level * (1.0 + 1e-8)
    assert sensitivity.max() > level * 0.99  # the grid is not far from the support
    exact = solve(case, runs, solver="exchange", starts=3)
    assert exact.value <= exact.bound.value
    assert exact.bound.value == pytest.approx(found.value, rel=1e-6)


def test_bad_input_is_said() -> None:
    with pytest.raises(InputError, match="deviations: joint_offset:1 has 0"):
        replace(PLAIN, deviations={"joint_offset:1": 0.0})
    with pytest.raises(InputError, match="unknown name 'nothing'"):
        replace(PLAIN, deviations={"nothing": 1.0})
    with pytest.raises(InputError, match=r"^a prior needs the instrument's scatter"):
        DesignProblem.of(Model(Arm(LENGTHS)), deviations={"joint_offset:1": 1.0})


def test_the_best_of_all_plans_of_several_points() -> None:
    """Two reflectors, and two frames with their orientations, on three joints, parallel ones too: every plan of 4 of 8
    postures, by central differences of positions that are compared with those of the arm itself."""
    generator = np.random.default_rng(8)
    tools = {"a": np.array([40.0, 30.0, 20.0]), "b": np.array([-50.0, 10.0, 60.0])}
    parallel, settled = [replace(row, alpha=0.0) for row in TABLE_ROWS], frozenset({"tool"})
    for rows, angle_scale, each in ((TABLE_ROWS, None, 3), (TABLE_ROWS, 200.0, 6), (parallel, 200.0, 6)):
        chain = replace(chain_of(rows), tools=tools, settled=settled, instrument=Tracker(angle_scale))
        choices = generator.uniform(-2.0, 2.0, (8, 3))
        problem = DesignProblem.of(Model(Arm(chain, sigma=0.05)), choices=choices)
        case = robust_problem(problem, missing_effects(problem, ["encoder_eccentricity", "gear_ratio"]))
        model = case.model
        assert case.model.dimension == 2 * each
        sides = [np.repeat(choices, 2, axis=0), Conditions(marker=np.tile([0.0, 1.0], 8))]
        if angle_scale is not None:
            sides[1] = replace(sides[1], orientation=model.orientations(*sides))
        step = 1e-4 / model.scales
        moved = [[model.position(sides[0], s * np.diag(step)[k], sides[1]) for k in range(len(step))] for s in (1, -1)]
        columns = np.moveaxis((np.array(moved[0]) - np.array(moved[1])) / 2e-4, 0, -1).reshape(8, 2 * each, -1)
        known = [case.deviations.get(name, np.inf) for name in model.names]
        prior = np.diag((0.05 / (model.scales * known)) ** 2)
        of_each = np.einsum("mdp,mdq->mpq", columns, columns)
        points = columns.reshape(8, 2, each, -1)[:, :, :3]  # I: of their positions, over the list, the workspace
        poses = np.einsum("mkdp,mkdq->pq", points, points) / 8
        every = [np.trace(np.linalg.solve(of_each[list(four)].sum(axis=0) + prior, poses)) for four in FOURS]
        found = solve(case, 4, starts=20)
        assert -found.value / 4 == pytest.approx(min(every), rel=1e-5)
        error = (found.expected_error or {})["plan"]  # of one of the two points: orientations are no distance
        assert error == pytest.approx(0.05 * np.sqrt(min(every) / 2), rel=1e-5)


def test_the_bound_of_a_random_list_holds_for_all_postures() -> None:
    """Weights on postures climbed from the list beat every bound over the list, and not this one."""
    some = replace(CASE, choices=np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (40, 2)))
    sampled = replace(some, sampled=True)
    assert (with_choices(CASE).sampled, with_choices(some, POSTURES[:1]).sampled) == (True, False)
    listed, everywhere = best_known_bound(some, 12), best_known_bound(sampled, 12)
    assert (listed.source, listed.rigorous, listed.candidates) == ("grid", True, 40)
    assert (everywhere.source, everywhere.rigorous, everywhere.candidates) == ("continuous", False, None)
    effort = {"runs": 12, "tolerance": 1e-3}
    found = column_generation(some, some.choices, **effort)
    climbed = ContinuousSet(CASE, found.prior).best(found.gradient, found.plan.postures)[0]
    better = column_generation(CASE, np.concatenate([some.choices, climbed]), **effort)
    value = float(CASE.criterion.value(better.information))
    assert listed.value < value - 1e-3 * abs(value)  # what was called a bound of all plans
    assert value < everywhere.value
    # and against another set of postures altogether, a fine grid with its exact bound
    grid = np.stack(np.meshgrid(*np.linspace(ARM.lower, ARM.upper, 25).T), axis=-1).reshape(-1, 2)
    assert float(CASE.criterion.value(column_generation(CASE, grid, **effort).information)) < everywhere.value


def test_the_workspace_is_on_one_side_of_what_no_move_passes() -> None:
    """A post beside the base, which the first link would hit within 32 degrees; and the list that is chosen from."""
    case = DesignProblem.of(Model(replace(ARM, constraints=(KeepOut((150.0, 0.0), 80.0),))))
    for postures in (workspace(case), with_choices(case).choices):
        assert np.abs(np.sign(postures[:, 0]).sum()) == len(postures) > 200
        assert np.abs(postures[:, 0]).min() > np.arcsin(80.0 / 150.0)
