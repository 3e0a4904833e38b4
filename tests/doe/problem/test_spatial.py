"""Designs of spatial arms: the prior of machining, the minimal set, measured points that are not known."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from doe import DesignProblem, solve
from doe.bounds.column_generation import continuous_design
from doe.plan.moves import drive
from doe.plan.spacing import too_near
from identification import PRISMATIC, Arm, ArmModel, Array, DHRow, InputError, Model, chain_of, with_points
from identification.instruments import Distance, Sphere
from identification.kinematics.frames import pose
from identification.model.placed import minimal
from tests.doe.arms import FOUR
from tests.doe.six_axis import CHAIN, REFLECTOR, SIX_AXIS, STEP, difference_information, difference_jacobian, six_axis
from tests.identification.kinematics.test_spatial import tip_by_exponentials

POSTURES = np.random.default_rng(0).uniform(SIX_AXIS.lower, SIX_AXIS.upper, (20, 6))


def test_with_a_sigma_the_prior_of_machining_counts() -> None:
    problem = six_axis()
    assert (problem.parameters, len(problem.deviations), problem.fewest_runs) == (39, 30, 3)
    expected = difference_information(problem, Model(SIX_AXIS), POSTURES)
    np.testing.assert_allclose(problem.information(POSTURES), expected, atol=1e-8 * np.abs(expected).max())
    assert problem.objective(POSTURES) == pytest.approx(np.linalg.slogdet(expected)[1], abs=1e-3)


def test_a_user_may_design_for_a_minimal_set_or_without_a_prior() -> None:
    assert (six_axis().parameters, DesignProblem.of(minimal(Model(SIX_AXIS))).parameters) == (39, 27)
    assert six_axis(deviations={}).objective(POSTURES) < -100.0  # nearly singular, and not held
    assert not DesignProblem.of(Model(FOUR)).deviations


def test_points_that_are_not_known_lie_beside_the_last_axis() -> None:
    three = replace(CHAIN, tools={name: np.zeros(3) for name in "abc"})
    with pytest.warns(UserWarning, match="a, b, c is not known; 100 mm beside the last axis"):
        places = np.array([tool[:3, 3] for tool in with_points(three).tools.values()])
    np.testing.assert_allclose(np.linalg.norm(places[:, :2], axis=1), 100.0)  # the last axis is z of the tip
    np.testing.assert_allclose(places.sum(axis=0), 0.0, atol=1e-9)
    assert with_points(CHAIN) is CHAIN
    known = replace(three, settled=frozenset({"tool"}))
    assert with_points(known) is known


def test_every_point_is_measured_at_every_posture() -> None:
    tools = {"1": REFLECTOR, "2": np.array([-50.0, 20.0, 80.0])}
    problem = six_axis(Arm(replace(CHAIN, tools=tools), sigma=0.05))
    assert isinstance(problem.model, ArmModel)
    assert problem.model.dimension == 6
    blocks = problem.scaled_jacobians(POSTURES[:3]) * problem.model.parameters.scales
    np.testing.assert_allclose(problem.model.tip_jacobian(POSTURES[:3]).reshape(blocks.shape), blocks)
    own = [k for k, name in enumerate(problem.model.parameters.names) if not name.startswith("tool")]
    shared = [k for k, name in enumerate(Model(SIX_AXIS).names) if not name.startswith("tool")]
    for rows, tool in ((slice(0, 3), tools["1"]), (slice(3, 6), tools["2"])):
        expected = difference_jacobian(Model(SIX_AXIS), POSTURES[:3], tool)[..., shared]
        np.testing.assert_allclose(blocks[:, rows][..., own], expected, atol=1e-4)


def bar(**changes: Any) -> Arm:
    chain = replace(CHAIN, instrument=Distance(), **changes)
    return Arm(chain, sigma=0.01, lower=np.full(6, -2.0), upper=np.full(6, 2.0))


def test_distances_have_one_coordinate() -> None:
    """Information against distances of products of exponentials, by differences."""
    base = pose([-700.0, 200.0, -300.0])
    problem = DesignProblem.of(Model(bar(base=base)))
    assert problem.model.dimension == 1
    model = Model(bar(base=base))

    def read(q: Array, name: str, step: float) -> float:
        return float(np.linalg.norm(tip_by_exponentials(model.arm.chain, q, {name: step}, REFLECTOR)))

    rows = [[read(q, name, STEP) - read(q, name, -STEP) for name in model.names] for q in POSTURES[:5]]
    scaled = np.array(rows) / (2.0 * STEP) / model.scales
    sizes = np.array([problem.deviations.get(name, np.inf) for name in model.names])
    expected = (scaled.T @ scaled + np.diag((0.01 / (model.scales * sizes)) ** 2)) / 5.0
    np.testing.assert_allclose(problem.information(POSTURES[:5]), expected, atol=1e-6)


def test_a_center_is_assumed_before_the_base() -> None:
    chain = bar().chain
    with pytest.warns(UserWarning, match=r"the center is not known; a point \d+ mm in front of the base"):
        there = with_points(chain)
    np.testing.assert_allclose(there.base, pose([-0.5 * chain.reach, 0.0, 0.0]))
    placed = replace(chain, base=pose([-700.0, 0.0, 0.0]))
    np.testing.assert_array_equal(with_points(placed).base, placed.base)
    np.testing.assert_array_equal(with_points(CHAIN).base, CHAIN.base)


def test_contacts_at_an_unknown_place_have_no_plans() -> None:
    arm = Arm(replace(CHAIN, instrument=Sphere(20.0)))
    with pytest.raises(InputError, match="kind sphere without center_mm: the place of contact is not known"):
        DesignProblem.of(Model(arm))


# -- a joint that slides -----------------------------------------------------------------------------------------------
ROWS = [DHRow(40.0, np.pi / 2, 300.0), DHRow(0.0, np.pi / 2, 200.0), DHRow(0.0, 0.0, 150.0), DHRow(30.0, 0.0, 50.0)]
ROWS = [replace(row, limits=(-2.0, 1.5)) for row in ROWS]
ROWS[2] = replace(ROWS[2], type=PRISMATIC, limits=(0.0, 400.0))
SLIDE = Arm(replace(chain_of(ROWS), tools={"1": REFLECTOR}, settled=frozenset({"base"})), sigma=0.1)
SLIDING = DesignProblem.of(minimal(Model(SLIDE)), deviations={})


def sensitivities(postures: Array, best: Array) -> Array:
    """(m,) tr(M^-1 B^T B) of each posture, by differences."""
    blocks = difference_jacobian(SLIDING.model, postures) / SLIDING.model.parameters.scales  # type: ignore[arg-type]
    return np.einsum("mdp,pq,mdq->m", blocks, np.linalg.inv(best), blocks)


def test_plans_of_a_joint_that_slides() -> None:
    """The equivalence theorem of Kiefer and Wolfowitz over all postures, and a plan below that bound; postures are kept
    apart in the unit of each joint: one degree is 1/360 of the range of the one that slides."""
    p, generator = SLIDING.parameters, np.random.default_rng(7)
    best = continuous_design(SLIDING)
    matrix = difference_information(SLIDING, SLIDING.model, best.plan.postures, best.plan.shares)  # type: ignore[arg-type]
    assert best.value == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-5)
    np.testing.assert_allclose(sensitivities(best.plan.postures, matrix), p, atol=1e-3)
    assert sensitivities(generator.uniform(SLIDING.lower, SLIDING.upper, (50, 4)), matrix).max() <= p + 1e-4
    assert not best.bound.rigorous  # a sliding joint's positions are no trigonometric polynomial
    design = solve(SLIDING, 8, "exchange", starts=3, seed=1, bound=best.bound)
    assert not len(too_near(SLIDING, design.plan.postures))
    assert "deg (360 deg: the range of a prismatic joint) (" in drive(SLIDING, design.plan, "given").lines[0]
    plans = generator.uniform(SLIDING.lower, SLIDING.upper, (100, 8, 4))
    assert max(map(SLIDING.objective, plans)) < design.value < best.bound.value
    base = 0.5 * (SLIDING.lower + SLIDING.upper)
    for share, near in ((0.9, True), (1.1, False)):
        other = base + share * 400.0 / 360.0 * np.eye(4)[2]
        assert bool(len(too_near(SLIDING, np.array([base, other])))) is near
