"""`doe` on a model it has never seen: a chain in space (`tests.doe.spatial`), d = 3, p = 12 or 30, one prismatic joint.

Every figure is checked against the oracle's numpy chain with finite differences, brute force, or a theorem.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations, permutations

import casadi as ca
import numpy as np
import pytest
from scipy.stats import norm

from doe.advise import advise
from doe.bounds.approximate_design import ApproximateDesign
from doe.bounds.column_generation import continuous_design
from doe.bounds.planar_theorem import closed_form_bound
from doe.bounds.relaxation import relax
from doe.design import score_plan
from doe.discrimination.design import discrimination_design
from doe.discrimination.misidentification import EffectLibrary
from doe.discrimination.swaps import CLOUD, pool_of
from doe.discrimination.t_optimal import RivalPredictions, t_optimal
from doe.plan.order import ordered, travel
from doe.plan.replicate_spacing import too_near
from doe.problem.bayesian import deviated_draws, ensemble_problem
from doe.problem.constraints import Expression, InsideBox, OutsideSphere
from doe.report.design import accuracy, design_document
from doe.report.figures import certificate_figure
from doe.solvers import solve
from doe.studies.comparison import Comparison, compare, evaluated
from identification.arrays import Array
from identification.document import Sheet
from identification.estimation import estimate
from tests.doe.spatial import (
    LARGE_MODEL,
    SMALL,
    SpatialModel,
    difference_information,
    difference_jacobian,
    measured,
    random_postures,
    spatial,
    tip_positions,
    with_values,
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


def test_fedorov_finds_the_best_of_all_choices() -> None:
    """Every choice of 5 out of 10 postures, 252 of them, by the oracle."""
    few = candidates()[:10]
    blocks = difference_jacobian(SpatialModel(), few) / SpatialModel().parameters.scales
    each = np.einsum("mdp,mdq->mpq", blocks, blocks) / 5.0
    best = max(log_det(each[list(chosen)].sum(axis=0)) for chosen in combinations(range(10), 5))
    design = solve(spatial(choices=few), 5, "fedorov")
    assert design.value == pytest.approx(best, abs=1e-5)
    assert design.efficiency is not None
    assert design.efficiency <= 1.0


def test_constraints_in_space() -> None:
    """A box for the tip, a sphere no link may touch, and a user's own; judged by points along the oracle's links."""
    model = SpatialModel()
    box = InsideBox(model, (-600.0, -600.0, 100.0), (600.0, 600.0, 650.0))
    sphere = OutsideSphere(model, (350.0, 0.0, 300.0), 120.0)
    short = Expression(lambda q: 300.0 - q[2], 4, "stroke")
    problem = spatial(constraints=(box, sphere, short))
    design = solve(problem, RUNS, "exchange", starts=3, bound=continuous().bound)
    assert np.isfinite(design.value)
    for chain in model.points(design.plan.postures):
        assert np.all((chain[-1] >= [-600.0, -600.0, 100.0]) & (chain[-1] <= [600.0, 600.0, 650.0]))
        along = np.linspace(0.0, 1.0, 200)[:, None, None]
        links = chain[:-1] + along * np.diff(chain, axis=0)
        assert np.linalg.norm(links - [350.0, 0.0, 300.0], axis=-1).min() >= 120.0
    assert design.plan.postures[:, 2].max() <= 300.0
    assert not design.outside
    q = ca.SX.sym("q", 4)
    postures = random_postures(model, 300, 2)
    for constraint in (box, sphere):
        symbolic = np.asarray(ca.Function("f", [q], [constraint.symbolic(q)])(postures.T)).T
        numeric = constraint.margin(postures)
        assert symbolic.shape == numeric.shape
        clear = np.abs(numeric) > 1e-6
        np.testing.assert_array_equal((symbolic >= 0.0)[clear], (numeric >= 0.0)[clear])


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


@pytest.mark.parametrize("solver", ["clarabel", "column_generation"])
def test_relaxation_over_a_grid(solver: str) -> None:
    problem, model = spatial(), SpatialModel()
    found = relax(problem, 3, solver)
    assert found.candidates == 3**3  # the first joint plays no part
    axes = [np.linspace(problem.lower[j], problem.upper[j], 3) for j in (1, 2, 3)]
    grid = np.stack([np.zeros(27), *(axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))], axis=1)
    information = difference_information(model, found.plan.postures, found.plan.shares)
    assert sensitivities(model, information, grid).max() <= 12.0 + 1e-3
    assert found.efficiency_lower_bound > 0.9999


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


def test_the_picture_of_a_certificate() -> None:
    """A panel for each joint that plays a part, in its unit and over its range."""
    figure = certificate_figure(spatial(), continuous().plan.postures, samples=64)
    assert [axes.get_xlabel() for axes in figure.axes] == ["$q_2$ [deg]", "$q_3$ [mm]", "$q_4$ [deg]"]
    np.testing.assert_allclose(figure.axes[1].lines[0].get_xdata()[[0, -1]], [0.0, 400.0], atol=1e-9)


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


def test_solvers_compared_in_processes_of_their_own() -> None:
    problem = spatial(choices=candidates()[:10])
    rows = compare(Comparison((), [5], ["fedorov"], repeats=2, seconds=30.0, problems={"spatial": problem}))
    best = solve(problem, 5, "fedorov").value
    assert rows["arm"].to_list() == ["spatial"] * 2
    assert rows["correct"].to_list() == [True] * 2
    np.testing.assert_allclose(rows["value"].to_numpy(), best)


def test_postures_in_the_units_of_their_joints() -> None:
    design = score_plan(spatial(choices=candidates()), candidates()[:5])
    data = design.to_json()
    expected = candidates()[:5] * [180.0 / np.pi, 180.0 / np.pi, 1.0, 180.0 / np.pi]
    np.testing.assert_allclose(data["postures"], expected)
    assert data["joint_units"] == ["deg", "deg", "mm", "deg"]
    assert "postures_deg" not in data
    assert "q3 [mm]" in design._repr_html_()
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
    assert found.after == pytest.approx(best)
    assert sorted(map(tuple, found.plan.postures)) == sorted(map(tuple, design.plan.postures))


def test_kept_postures_count() -> None:
    model, kept = SpatialModel(), candidates()[:3]
    problem = spatial(kept=kept)
    assert problem.fewest_runs == 1
    design = solve(problem, 5, "exchange", starts=3, bound=continuous().bound)
    together = np.vstack([design.plan.postures, kept])
    assert design.value == pytest.approx(log_det(difference_information(model, together)), abs=1e-5)
    beside = [np.vstack([random_postures(model, 5, seed), kept]) for seed in range(50)]
    assert design.value > max(log_det(difference_information(model, plan)) for plan in beside)


# -- identification --------------------------------------------------------------------------------------------------
def truth(model: SpatialModel, seed: int) -> Array:
    """(p,) errors of about a millimetre and a third of a degree."""
    return deviated_draws(model, 1, np.random.default_rng(seed), 1.0, np.radians(0.3), 200.0)[0]


@pytest.mark.parametrize("model", [SpatialModel(), LARGE_MODEL], ids=["p = 12", "p = 30"])
def test_the_measured_plan_gives_the_true_parameters(model: SpatialModel) -> None:
    """Without noise to rounding; with it inside the errors that the oracle's covariance predicts."""
    postures, true = random_postures(model, 40, 6), truth(model, 7)
    exact = estimate(model, measured(model, true, postures, 0.0, 1), sigma=0.1)  # type: ignore[arg-type]
    assert exact.status.succeeded
    np.testing.assert_allclose(exact.parameters * model.scales, true * model.scales, atol=1e-6)  # mm at the tip
    noisy = estimate(model, measured(model, true, postures, 0.1, 1), sigma="given")  # type: ignore[arg-type]
    jacobian = difference_jacobian(model, postures, true).reshape(120, -1)
    covariance = 0.1**2 * np.linalg.inv(jacobian.T @ jacobian)
    size = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(noisy.covariance / size, covariance / size, atol=0.01)  # that at the estimate
    error = noisy.parameters - true
    # chi2 of p degrees of freedom: fails 5 standard deviations sqrt(2 p) above its mean p
    assert error @ np.linalg.solve(covariance, error) < len(true) + 5.0 * np.sqrt(2.0 * len(true))
    assert noisy.dof == 120 - len(true)
    assert noisy.residuals_after.shape == (40, 3)
    assert noisy.rms_after < 0.1 * np.sqrt(3.0) * 1.3 < noisy.rms_before


def test_what_is_not_estimable_in_space_is_named() -> None:
    """A first joint that never moves: where its frame and its encoder are off, the second joint's frame is off."""
    model = replace(SpatialModel(), names=(*SMALL, "rotation_z:1", "rotation_x:1", "encoder_cos:1", "encoder_sin:1"))
    still = random_postures(model, 40, 2)
    still[:, 0] = 0.4
    found = estimate(model, measured(model, np.zeros(16), still, 0.1, 3))  # type: ignore[arg-type]
    columns = difference_jacobian(model, still).reshape(120, 16) / model.scales
    assert len(found.not_identifiable) == 16 - np.linalg.matrix_rank(columns, tol=1e-5) == 4
    named = " ".join(found.not_identifiable)
    assert all(name in named for name in ("rotation_z:1", "rotation_x:1", "encoder_cos:1", "encoder_sin:1"))
    null = np.linalg.svd(columns)[2][12:]
    lost = np.abs(null).max(axis=0) > 1e-3
    np.testing.assert_array_equal(found.identifiable, ~lost)


# -- an arm that is not known well, effects that may be missing --------------------------------------------------------
@pytest.mark.parametrize("kind", ["average", "worst"])
def test_designs_over_a_prior(kind: str) -> None:
    model = SpatialModel()
    draws = deviated_draws(model, 3, np.random.default_rng(1), 20.0, np.radians(5.0), 200.0)
    design = solve(ensemble_problem(spatial(choices=candidates()), draws, kind), 6, "fedorov")
    each = [log_det(difference_information(with_values(model, draw), design.plan.postures)) for draw in draws]
    assert design.log_det == pytest.approx(sum(each), abs=1e-4)
    assert design.value == pytest.approx(sum(each) if kind == "average" else min(each), abs=1e-4)
    assert design.efficiency is not None
    assert design.efficiency <= 1.0
    nominal = solve(spatial(choices=candidates()), 6, "fedorov").plan.postures
    others = [log_det(difference_information(with_values(model, draw), nominal)) for draw in draws]
    assert design.value >= (sum(others) if kind == "average" else min(others)) - 1e-4
    assert design.deviations_per_draw is not None
    assert len(design.deviations_per_draw) == 3


EFFECTS = (("encoder_cos:2", "encoder_sin:2"), ("encoder_cos:4", "encoder_sin:4"), ("scale:3",))


def spatial_effects() -> EffectLibrary:
    """Eccentric encoders of joints 2 and 4, and a wrong scale of the prismatic joint."""
    model = replace(SpatialModel(), names=(*SMALL, *(name for effect in EFFECTS for name in effect)))
    bases = [np.eye(5)[:, columns] for columns in ([0, 1], [2, 3], [4])]
    return EffectLibrary(12, model, tuple(bases), np.ones(3))


def test_a_plan_that_tells_missing_effects_apart() -> None:
    problem, library = spatial(), spatial_effects()
    found = discrimination_design(problem, library, 12, starts=2, seconds=20.0)
    assert found.relative_efficiency >= 0.95 - 1e-9
    assert found.wrong < found.best_wrong
    assert found.sees is None
    q = found.design.plan.postures
    assert np.all((q >= problem.lower) & (q <= problem.upper))
    lost = log_det(difference_information(problem.model, found.best.plan.postures)) - log_det(
        difference_information(problem.model, q)
    )
    assert lost <= -12.0 * np.log(0.95) + 1e-4
    cloud = pool_of(problem, CLOUD, np.random.default_rng(0))
    assert found.wrong == pytest.approx(wrong_names(library.shown_by_postures, q, cloud), rel=1e-4)


def wrong_names(model: SpatialModel, postures: Array, reference: Array) -> float:
    """Mean probability of a wrong name for effects of length 8 on the reference, by projections of the columns.

    An effect with two parameters is as likely to be one of them, their sum or their difference.
    """
    here, there = (scaled_columns(model, plan) for plan in (postures, reference))
    effects = [np.eye(5)[:, columns] for columns in ([0, 1], [2, 3], [4])]
    total = 0.0
    for number, effect in enumerate(effects):
        one, two = effect[:, 0], effect[:, -1]
        directions = [one] if effect.shape[1] == 1 else [one, two, one + two, one - two]
        for direction in directions:
            column, base = here[:, 12:] @ direction, here[:, :12]
            size = 8.0 / distance(there[:, 12:] @ direction, there[:, :12])
            rivals = [np.hstack([base, here[:, 12:] @ rival]) for k, rival in enumerate(effects) if k != number]
            lengths = [size * distance(column, explained) for explained in (base, *rivals)]
            total += sum(norm.cdf(-0.5 * length) for length in lengths) / len(directions) / len(effects)
    return float(total)


def scaled_columns(model: SpatialModel, postures: Array) -> Array:
    """(3 m, p) columns per run: divided by sqrt(m)."""
    return (difference_jacobian(model, postures) / model.parameters.scales).reshape(3 * len(postures), -1) / np.sqrt(
        len(postures)
    )


def distance(column: Array, others: Array) -> float:
    """Length of what least squares on the other columns leaves of a column."""
    return float(np.linalg.norm(column - others @ np.linalg.lstsq(others, column, rcond=None)[0]))


def test_the_postures_that_settle_between_two_models() -> None:
    """Two rivals of which each knows its parameters to 1 mm or so: of all pairs of 12 postures the most telling one.

    lambda^2 = delta^T (I + J J^T)^-1 delta by a direct solve; the greedy choice with exchange may stop at a pair that
    no single exchange improves.
    """
    model, pool = SpatialModel(), candidates()[:12]
    other = with_values(model, deviated_draws(model, 1, np.random.default_rng(2), 1.0, np.radians(0.2), 200.0)[0])
    sigma = 0.1
    positions = np.array([tip_positions(m, pool) / sigma for m in (model, other)])
    known = np.diag(1.0 / model.parameters.scales)
    jacobians = [difference_jacobian(m, pool) @ known / sigma for m in (model, other)]
    rivals = RivalPredictions(np.array([0.5, 0.5]), np.zeros((2, 2)), positions, jacobians)

    def settled(rows: tuple[int, ...], rival: int) -> float:
        delta = (positions[0] - positions[1])[list(rows)].ravel()
        jacobian = jacobians[rival][list(rows)].reshape(-1, 12)
        return float(delta @ np.linalg.solve(np.eye(delta.size) + jacobian @ jacobian.T, delta))

    def merit(rows: tuple[int, ...]) -> float:
        return settled(rows, 0) + settled(rows, 1)

    chosen = tuple(t_optimal(rivals, 2))
    neighbors = [(row, chosen[1]) for row in range(12)] + [(chosen[0], row) for row in range(12)]
    assert merit(chosen) >= 0.98 * max(merit(rows) for rows in neighbors)
    assert merit(chosen) > np.median([merit(rows) for rows in combinations(range(12), 2)])


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
