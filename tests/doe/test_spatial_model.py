"""`doe` on a model it has never seen: a chain in space (`tests.doe.spatial`), d = 3, p = 12 or 30, one prismatic joint.

Every figure is checked against the oracle's numpy chain with finite differences, brute force, or a theorem.
"""

from __future__ import annotations

from functools import cache, partial
from itertools import permutations

import numpy as np
import pytest

from doe.advise import advise
from doe.bounds.certificate import ApproximateDesign
from doe.bounds.column_generation import continuous_design, relax
from doe.bounds.planar_theorem import closed_form_bound
from doe.design import score_plan
from doe.plan.plan import ordered, travel
from doe.plan.spacing import too_near
from doe.problem.constraints import Expression, inside_box, outside_sphere
from doe.report.design import accuracy, design_document
from doe.solvers import solve
from doe.studies.comparison import evaluated
from identification.arrays import Array
from identification.document import Sheet
from identification.workspace import KeepOutCircle, WorkspaceBox
from tests.doe.spatial import (
    LARGE_MODEL,
    SMALL,
    SpatialModel,
    difference_information,
    difference_jacobian,
    random_postures,
    spatial,
)

RUNS = 8
# central differences of a chain of 1 m with a step of 1e-5: truncation 1e-10 and rounding 1e-16 / 1e-5 of the size
DIFFERENCES = 1e-7


def log_det(information: Array) -> float:
    return float(np.linalg.slogdet(information)[1])


def sensitivities(model: SpatialModel, information: Array, postures: Array) -> Array:
    """(m,) tr(M^-1 B^T B) of each posture, from finite differences."""
    blocks = difference_jacobian(model, postures) / model.parameters.scales
    return np.einsum("mdp,pq,mdq->m", blocks, np.linalg.inv(information), blocks)


@cache
def continuous() -> ApproximateDesign:
    """The best weights over the whole design space, which bound every plan."""
    return continuous_design(spatial())


@cache
def candidates() -> Array:
    return random_postures(SpatialModel(), 40, 3)


# -- the model and its information -------------------------------------------------------------------------------------
@pytest.mark.parametrize("model", [SpatialModel(), LARGE_MODEL], ids=["p = 12", "p = 30"])
def test_information_is_that_of_finite_differences(model: SpatialModel) -> None:
    postures, problem = random_postures(model, 15, 1), spatial(model)
    assert (model.dimension, problem.parameters) == (3, len(model.names))
    expected = difference_information(model, postures)
    np.testing.assert_allclose(problem.information(postures), expected, rtol=0.0, atol=DIFFERENCES * expected.max())
    assert problem.objective(postures) == pytest.approx(log_det(expected), abs=1e-5)
    assert np.linalg.matrix_rank(expected) == problem.parameters
    assert problem.fewest_runs == -(-problem.parameters // 3)
    assert closed_form_bound(problem) is None


def test_the_first_joint_plays_no_part_where_the_base_is_known() -> None:
    """It turns all positions about the base: no information is gained or lost."""
    assert spatial().active_joints == (1, 2, 3)
    assert spatial(LARGE_MODEL).active_joints == tuple(range(7))


# -- exact plans -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("solver", ["exchange", "exchange_ipopt", "ipopt", "relaxation_rounding", "random"])
def test_solvers(solver: str) -> None:
    problem = spatial()
    design = solve(problem, RUNS, solver, starts=3, seed=1, bound=continuous().bound)
    q = design.plan.postures
    assert q.shape == (RUNS, 4)
    assert np.all((q >= problem.lower) & (q <= problem.upper))
    assert design.value == pytest.approx(log_det(difference_information(problem.model, q)), abs=1e-5)
    assert design.bound is not None
    assert design.bound.source == "continuous"
    assert design.efficiency is not None
    assert design.efficiency <= 1.0
    if solver != "random":
        best = max(problem.objective(random_postures(problem.model, RUNS, seed)) for seed in range(200))
        assert design.value > best
    assert not len(too_near(problem, q))
    assert design.table_1_max_residual is None


def test_ipopt_ends_where_no_joint_gains_anything() -> None:
    """The gradient, by finite differences of the oracle's log det, is zero but where a limit holds a joint."""
    problem = spatial()
    q = np.array(solve(problem, RUNS, "exchange_ipopt", starts=2, bound=continuous().bound).plan.postures)
    for run in range(RUNS):
        for joint in problem.active_joints:
            step = 1e-4 * problem.joint_units[joint]
            moved = np.repeat(q[None], 2, axis=0)
            moved[:, run, joint] += [step, -step]
            up, down = (log_det(difference_information(problem.model, plan)) for plan in moved)
            slope = (up - down) / 2e-4  # per radian, or per turn / 2 pi of the prismatic joint's range
            if q[run, joint] >= problem.upper[joint]:
                assert slope > -1e-4
            elif q[run, joint] <= problem.lower[joint]:
                assert slope < 1e-4
            else:
                assert abs(slope) < 1e-4


def test_constraints_in_space() -> None:
    """A box for the tip, a sphere no link may touch, and a user's own; judged by points along the oracle's links."""
    model = SpatialModel()
    box = WorkspaceBox((-600.0, 600.0), (-600.0, 600.0), (100.0, 650.0))
    inside = Expression(partial(inside_box, model, box), 4)
    outside = Expression(partial(outside_sphere, model, KeepOutCircle((350.0, 0.0, 300.0), 120.0)), 4)
    problem = spatial(constraints=(inside, outside, Expression(lambda q: 300.0 - q[2], 4, "stroke")))
    design = solve(problem, RUNS, "exchange", starts=3, bound=continuous().bound)
    assert np.isfinite(design.value)
    for chain in model.points(design.plan.postures):
        assert np.all((chain[-1] >= [-600.0, -600.0, 100.0]) & (chain[-1] <= [600.0, 600.0, 650.0]))
        along = np.linspace(0.0, 1.0, 200)[:, None, None]
        links = chain[:-1] + along * np.diff(chain, axis=0)
        assert np.linalg.norm(links - [350.0, 0.0, 300.0], axis=-1).min() >= 120.0
    assert design.plan.postures[:, 2].max() <= 300.0
    assert not design.outside


def test_postures_are_kept_apart_in_the_unit_of_each_joint() -> None:
    """One degree is 1/360 of the prismatic joint's range; the same three postures are near, or not, by that alone."""
    problem = spatial(choices=None, minimum_distance=np.radians(1.0))
    everywhere = spatial(LARGE_MODEL)
    base = 0.5 * (everywhere.lower + everywhere.upper)
    stroke = everywhere.upper[3] - everywhere.lower[3]
    assert stroke == 250.0
    for share, near in ((0.9, True), (1.1, False)):
        other = base.copy()
        other[3] += share * stroke / 360.0
        assert bool(len(too_near(everywhere, np.array([base, other])))) is near
    np.testing.assert_allclose(problem.comparable(problem.upper - problem.lower)[2], 2.0 * np.pi)


# -- approximate designs: the equivalence theorem of Kiefer and Wolfowitz ----------------------------------------------
@pytest.mark.parametrize("solver", ["clarabel", "column_generation"])
def test_relaxation_over_a_list(solver: str) -> None:
    model = SpatialModel()
    found = relax(spatial(), candidates(), solver)
    information = difference_information(model, found.plan.postures, found.plan.shares)
    assert found.value == pytest.approx(log_det(information), abs=1e-5)
    assert sensitivities(model, information, candidates()).max() <= 12.0 + 1e-3
    np.testing.assert_allclose(
        sensitivities(model, information, found.plan.postures)[found.plan.shares > 1e-3], 12.0, atol=0.02
    )
    assert found.bound is not None
    assert found.value <= found.bound.value <= found.value + 1e-3
    for seed in range(20):  # no other weights are better
        weights = np.random.default_rng(seed).dirichlet(np.ones(len(candidates())))
        assert log_det(difference_information(model, candidates(), weights)) < found.value


def test_continuous_optimum_and_bound() -> None:
    model, found = SpatialModel(), continuous()
    information = difference_information(model, found.plan.postures, found.plan.shares)
    assert found.value == pytest.approx(log_det(information), abs=1e-5)
    np.testing.assert_allclose(sensitivities(model, information, found.plan.postures), 12.0, atol=1e-3)
    assert sensitivities(model, information, random_postures(model, 400, 7)).max() <= 12.0 + 1e-4
    assert found.bound is not None
    assert not found.bound.rigorous  # a prismatic joint's positions are no trigonometric polynomial of its angle
    assert found.bound.value == pytest.approx(found.value, abs=1e-6)
    assert relax(spatial(), 3).value < found.value


# -- what to measure, and how often ------------------------------------------------------------------------------------
def test_expected_deviations_and_advice() -> None:
    """Of plans from a list, whose search ends by itself: what a second finds depends on the machine."""
    problem, model = spatial(choices=candidates()), SpatialModel()
    advice = advise(problem, [6, 9], target=1.0)
    for design in advice.designs:
        q = design.plan.postures
        jacobian = difference_jacobian(model, q).reshape(-1, 12)
        covariance = 0.1**2 * np.linalg.inv(jacobian.T @ jacobian)
        expected = np.sqrt(np.diag(covariance))
        assert design.deviations is not None
        np.testing.assert_allclose(design.deviations.values, expected, rtol=1e-4)
        lengths = [k for k, name in enumerate(SMALL) if name.startswith(("translation", "tool"))]
        assert advice.accuracy(design) == pytest.approx(expected[lengths].max(), rel=1e-4)
        shown = design.to_json()["std"]["parameters"]
        assert list(shown) == list(SMALL)
        assert shown["rotation_x:2"] == [pytest.approx(np.degrees(expected[2]), rel=1e-4), "deg"]
        assert shown["tool.z"] == [pytest.approx(expected[-1], rel=1e-4), "mm"]
        assert design.efficiency is not None
        assert design.efficiency <= 1.0
    assert advice.accuracy(advice.designs[1]) < advice.accuracy(advice.designs[0])
    assert advice.smallest is not None


def test_a_plan_is_scored_and_compared_as_the_oracle_does() -> None:
    problem = spatial(choices=candidates())
    plan = candidates()[[1, 4, 9, 16, 25, 36]]
    scored = score_plan(problem, plan)
    assert scored.value == pytest.approx(log_det(difference_information(SpatialModel(), plan)), abs=1e-5)
    assert scored.efficiency is not None
    assert 0.0 < scored.efficiency < 1.0
    row = evaluated(problem, 6, scored)
    assert row["correct"]
    assert row["violation"] == 0.0
    assert row["efficiency"] == scored.efficiency


def test_postures_in_the_units_of_their_joints() -> None:
    design = score_plan(spatial(choices=candidates()), candidates()[:5])
    data = design.to_json()
    expected = candidates()[:5] * [180.0 / np.pi, 180.0 / np.pi, 1.0, 180.0 / np.pi]
    np.testing.assert_allclose(data["postures"], expected)
    assert data["joint_units"] == ["deg", "deg", "mm", "deg"]
    assert "postures_deg" not in data
    assert "q3_mm" in design._repr_html_()
    shown = accuracy(design)[0]
    assert isinstance(shown, Sheet)
    names = [row[0] for row in shown.rows]
    assert names[:3] == ["translation_x:2 [mm]", "translation_z:2 [mm]", "rotation_x:2 [deg]"]
    assert names[0] in str(design_document(design))
    weighted = relax(spatial(), candidates()[:8])
    row = weighted.to_json()["support"][0]
    np.testing.assert_allclose(row["posture"], weighted.plan.postures[0] * [180 / np.pi, 180 / np.pi, 1, 180 / np.pi])


def test_the_shortest_travel() -> None:
    """All 720 orders of six postures; a prismatic joint's stroke counts as a turn of a joint."""
    problem = spatial(choices=candidates())
    design = score_plan(problem, candidates()[:6])
    found = ordered(design.plan, "travel", speeds=problem.joint_units)
    best = min(travel(design.plan.postures[list(path)], problem.joint_units) for path in permutations(range(6)))
    assert travel(found.postures, problem.joint_units) == pytest.approx(best)
    assert sorted(map(tuple, found.postures)) == sorted(map(tuple, design.plan.postures))


def test_kept_postures_count() -> None:
    model, kept = SpatialModel(), candidates()[:3]
    problem = spatial(kept=kept)
    assert problem.fewest_runs == 1
    design = solve(problem, 5, "exchange", starts=3, bound=continuous().bound)
    together = np.vstack([design.plan.postures, kept])
    assert design.value == pytest.approx(log_det(difference_information(model, together)), abs=1e-5)
    beside = [np.vstack([random_postures(model, 5, seed), kept]) for seed in range(50)]
    assert design.value > max(log_det(difference_information(model, plan)) for plan in beside)


# -- thirty parameters -------------------------------------------------------------------------------------------------
def test_thirty_parameters() -> None:
    problem = spatial(LARGE_MODEL, choices=random_postures(LARGE_MODEL, 150, 4))
    assert problem.parameters == 30
    design = solve(problem, 20, starts=3)
    assert design.value == pytest.approx(log_det(difference_information(LARGE_MODEL, design.plan.postures)), abs=1e-4)
    assert design.bound is not None
    assert design.bound.rigorous
    assert design.efficiency is not None
    assert 0.9 < design.efficiency <= 1.0
    assert problem.choices is not None
    relaxed = relax(problem, problem.choices)
    information = difference_information(LARGE_MODEL, relaxed.plan.postures, relaxed.plan.shares)
    assert sensitivities(LARGE_MODEL, information, problem.choices).max() <= 30.0 + 1e-3
