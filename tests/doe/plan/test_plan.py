"""Plan files: rows in the order of measurement, weights of approximate designs, exact round trips."""

from __future__ import annotations

from itertools import combinations, pairwise, permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from doe.plan.plan import shortest_path
from identification import InputError, Plan


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
    with pytest.raises(InputError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert "\n" not in message
    missing = [part for part in ["plan.csv: ", *parts] if part not in message]
    assert not missing, f"{missing} not in {message!r}"


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
