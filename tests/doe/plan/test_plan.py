"""Plan files: rows in the order of measurement, weights of approximate designs, exact round trips."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise, permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from doe import solve
from doe.plan.plan import shortest_path
from doe.plan.spacing import distance_to_keep, separated, spread_free_joints, too_near, with_additions
from identification import Arm, Array, Plan
from tests.doe.arms import FOUR, OFFSET, problem
from tests.refusals import refused


def load(tmp_path: Path, text: str, links: int | None = None) -> Plan:
    (tmp_path / "plan.csv").write_text(text)
    return Plan.load(tmp_path / "plan.csv", links)


def test_postures_in_the_units_that_are_displayed() -> None:
    types, postures = ("revolute", "prismatic"), np.array([[np.pi, 250.0]])
    plan = Plan(postures, joint_types=types)
    np.testing.assert_array_equal(plan.displayed, [[180.0, 250.0]])
    np.testing.assert_array_equal(Plan.of_displayed(plan.displayed, types).postures, postures)


def test_text_is_as_documented() -> None:
    assert Plan(np.radians([[30, -60], [90, 0]])).text() == "run,q1_deg,q2_deg\n1,30.0,-60.0\n2,90.0,0.0\n"
    assert Plan([[0.0], [np.pi]], [0.25, 0.75]).text() == "run,q1_deg,weight\n1,0.0,0.25\n2,180.0,0.75\n"


def test_reading(tmp_path: Path) -> None:
    plan = load(tmp_path, "run,q1_deg,q2_deg\n1,30,-60\n2,400,0\n", links=2)
    np.testing.assert_allclose(plan.postures, np.radians([[30, -60], [400, 0]]))  # nothing is clipped
    assert plan.weights is None
    plan = load(tmp_path, "q1_rad,weight\n3,0\n1.5,1\n")
    np.testing.assert_array_equal(plan.postures, [[3], [1.5]])
    np.testing.assert_array_equal(plan.weights, [0, 1])


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("run,q1_deg\n", ["no rows"]),
        ("run,weight\n1,1\n", ["'q1_deg' is missing"]),
        ("run,q1_deg\n1,1\n2,nan\n", ["row 2 (line 3), column q1_deg", "found 'nan'", "allowed: a finite angle"]),
        ("q1_deg,weight\n1,1.5\n2,-0.5\n", ["row 2 (line 3), column weight", "found '-0.5'", "allowed: a number >= 0"]),
        ("q1_deg,weight\n1,0.5\n2,0.4\n", ["column weight", "found a sum of 0.9", "allowed: 1 (within 1e-06)"]),
        ("q1_deg,weight\n1,0.5\n2,0.500002\n", ["column weight", "found a sum of 1.000002", "allowed: 1"]),
        ("q1_deg;weight\n1,5;0,5\n2;0,4\n", ["column weight", "found a sum of 0.9"]),
    ],
)
def test_bad_input_gets_one_line(tmp_path: Path, text: str, parts: list[str]) -> None:
    refused(load, tmp_path, text, names=["plan.csv: ", *parts])


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Exact and approximate plans."""
    m, n = draw(st.integers(1, 6)), draw(st.integers(1, 4))
    weights = draw(st.none() | arrays(float, m, elements=st.floats(0.0, 1.0)))
    if weights is not None and weights.sum() > 0.1:
        weights = weights / weights.sum()
    elif weights is not None:
        weights = np.eye(m)[0]
    return Plan(draw(arrays(float, (m, n), elements=st.floats(-10, 10))), weights)


@given(plans())
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, plan: Plan) -> None:
    path = tmp_path_factory.mktemp("plan") / "plan.csv"
    path.write_text(plan.text())
    again = Plan.load(path, plan.links)
    np.testing.assert_allclose(again.postures, plan.postures, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(again.shares, plan.shares)
    assert (again.weights is None) == (plan.weights is None)


# -- order of measurement ----------------------------------------------------------------------------------------------
def costs(postures: np.ndarray) -> np.ndarray:
    return np.abs(postures[:, None] - postures).max(axis=-1)


def by_hand(postures: np.ndarray) -> float:
    return float(sum(max(abs(a - b) for a, b in zip(p, q, strict=True)) for p, q in pairwise(postures)))


@pytest.mark.parametrize("seed", range(5))
def test_shortest_of_all_permutations(seed: int) -> None:
    postures = np.random.default_rng(seed).uniform(-2, 2, (7, 3))
    best = min(by_hand(postures[list(p)]) for p in permutations(range(7)))
    path = shortest_path(costs(postures))
    assert sorted(path) == list(range(7))
    assert by_hand(postures[path]) == pytest.approx(best)


def test_long_plans_have_no_exchange_left_and_gain() -> None:
    postures = np.random.default_rng(3).uniform(-2, 2, (60, 4))
    found = postures[shortest_path(costs(postures))]
    assert by_hand(found) < 0.7 * by_hand(postures)
    for i, k in combinations(range(1, 60), 2):
        other = np.vstack([found[:i], found[i:k][::-1], found[k:]])
        assert by_hand(other) >= by_hand(found) - 1e-9


# -- postures apart ----------------------------------------------------------------------------------------------------
NARROW = Arm([200.0, 150.0], np.radians([-40, -50]), np.radians([40, 60]))


def smallest_gap(postures: np.ndarray) -> float:
    return min(np.abs(a - b).max() for k, a in enumerate(postures) for b in postures[:k])


def test_repeats_are_moved_apart_at_little_loss() -> None:
    case = problem(NARROW, OFFSET)
    corners = np.array([[a, b] for a in (NARROW.lower[0], NARROW.upper[0]) for b in (NARROW.lower[1], NARROW.upper[1])])
    plan = np.vstack([corners, corners])
    assert len(too_near(case, plan)) == 4
    apart = separated(case, plan)
    assert smallest_gap(apart) >= np.radians(1.0) * (1 - 1e-9)
    assert np.all((apart >= case.lower) & (apart <= case.upper))
    assert case.objective(plan) > case.objective(apart) > case.objective(plan) - 0.1
    np.testing.assert_array_equal(separated(case, apart), apart)


@pytest.mark.parametrize("solver", ["exchange", "ipopt"])
def test_plans_have_repeats_only_when_asked_for(solver: str) -> None:
    """On two joints, eight runs want the four corners twice."""
    apart = solve(problem(NARROW, OFFSET), 8, solver, starts=10)
    assert smallest_gap(apart.plan.postures) >= np.radians(1.0) * (1 - 1e-9)
    repeated = solve(problem(NARROW, OFFSET, minimum_distance=0.0), 8, solver, starts=10)
    assert repeated.value > apart.value
    wide = solve(problem(NARROW, OFFSET, minimum_distance=np.radians(25.0)), 8, solver, starts=10)
    assert smallest_gap(wide.plan.postures) >= np.radians(25.0) * (1 - 1e-9)
    assert wide.value < apart.value


def test_a_free_joint_sets_postures_apart() -> None:
    case = problem(FOUR)
    assert distance_to_keep(case) == 0.0
    tied = problem(NARROW, OFFSET)  # a base offset: every joint plays a part
    assert distance_to_keep(tied) == tied.minimum_distance
    design = solve(case, 16)
    assert smallest_gap(design.plan.postures) >= np.radians(360 / 16) * (1 - 1e-9)


def test_a_free_joint_has_no_more_places_than_fit_at_the_minimum_distance() -> None:
    """Joint 1 turns by 3.5 deg: three alike postures may stay, the others are moved in the joints that matter."""
    arm = Arm(FOUR.lengths, np.r_[0.0, FOUR.lower[1:]], np.r_[np.radians(3.5), FOUR.upper[1:]])
    case = problem(arm)
    spread = spread_free_joints(case, np.tile((arm.lower + arm.upper) / 2, (5, 1)), np.random.default_rng(0))
    assert too_near(case, spread).tolist() == [3, 4]
    apart = separated(case, spread)
    assert smallest_gap(apart) >= np.radians(1.0) * (1 - 1e-9)
    assert np.all((apart >= arm.lower) & (apart <= arm.upper))


def test_measured_postures_are_not_repeated() -> None:
    kept = np.array([[a, b] for a in (NARROW.lower[0], NARROW.upper[0]) for b in (NARROW.lower[1], NARROW.upper[1])])
    design = solve(problem(NARROW, OFFSET, kept=kept), 4, starts=10)
    assert smallest_gap(np.vstack([design.plan.postures, kept])) >= np.radians(1.0) * (1 - 1e-9)


@pytest.mark.parametrize("rows", [150, 400])
def test_repeats_are_those_of_all_pairs(rows: int) -> None:
    case = problem(NARROW, OFFSET, kept=np.zeros((3, 2)))
    plan = np.random.default_rng(0).uniform(case.lower, case.upper, (rows, 2))
    plan[5] = 0.0
    every = np.concatenate([case.kept, plan])
    near = [k for k in range(rows) if np.abs(every[: 3 + k] - plan[k]).max(axis=1).min() < np.radians(1.0)]
    assert too_near(case, plan).tolist() == near


# -- additions ---------------------------------------------------------------------------------------------------------
def whole_information(lengths: Array, postures: Array) -> Array:
    """(2n, 2n) sum of B^T B: a link moves the tip by exp(i theta), a joint all links from it on across themselves."""
    links = np.exp(1j * np.cumsum(postures, axis=1))
    levers = 1j * np.cumsum((links * lengths)[:, ::-1], axis=1)[:, ::-1] / lengths
    columns = np.concatenate([links, levers], axis=1)
    return (columns.conj().T @ columns).real


def test_the_posture_that_adds_most() -> None:
    """log det gains log det(I + B M^-1 B^T): no posture of a fine grid gains more."""
    case = problem(FOUR)
    generator = np.random.default_rng(1)
    plan = generator.uniform(FOUR.lower, FOUR.upper, (6, 4))
    longer = with_additions(case, plan, 1, generator)
    assert np.array_equal(longer[:6], plan)
    grid = np.stack(np.meshgrid(*(np.linspace(a, b, 25) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True))))
    places = np.column_stack([np.zeros(25**3), grid.reshape(3, -1).T])
    now = np.linalg.slogdet(whole_information(np.array(FOUR.lengths), longer))[1]
    best = max(
        np.linalg.slogdet(whole_information(np.array(FOUR.lengths), np.vstack([plan, one])))[1] for one in places[::3]
    )
    assert now >= best - 1e-3


def test_of_a_list_each_posture_once() -> None:
    choices = np.random.default_rng(2).uniform(FOUR.lower, FOUR.upper, (8, 4))
    case = problem(FOUR, choices=choices)
    generator = np.random.default_rng(0)
    longer = with_additions(case, choices[:6], 2, generator)
    assert len(np.unique(longer, axis=0)) == 8
    assert with_additions(case, choices[:6], 3, generator) is None
    assert with_additions(replace(case, minimum_distance=0.0), choices[:6], 3, generator) is not None
