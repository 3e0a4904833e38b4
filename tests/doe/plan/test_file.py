"""Plan files: rows in the order of measurement, weights of approximate designs, exact round trips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from doe.plan.plan import Plan, load_plan, plan_text
from identification.errors import InputError


def load(tmp_path: Path, text: str, links: int | None = None) -> Plan:
    (tmp_path / "plan.csv").write_text(text)
    return load_plan(tmp_path / "plan.csv", links)


def test_text_is_as_documented() -> None:
    assert plan_text(Plan(np.radians([[30, -60], [90, 0]]))) == "run,q1_deg,q2_deg\n1,30.0,-60.0\n2,90.0,0.0\n"
    assert plan_text(Plan([[0.0], [np.pi]], [0.25, 0.75])) == "run,q1_deg,weight\n1,0.0,0.25\n2,180.0,0.75\n"


def test_reading(tmp_path: Path) -> None:
    plan = load(tmp_path, "run,q1_deg,q2_deg\n1,30,-60\n2,400,0\n", links=2)
    np.testing.assert_allclose(plan.postures, np.radians([[30, -60], [400, 0]]))  # nothing is clipped
    assert plan.weights is None
    plan = load(tmp_path, "q1_rad,weight\n3,0\n1.5,1\n")
    np.testing.assert_array_equal(plan.postures, [[3], [1.5]])
    np.testing.assert_array_equal(plan.weights, [0, 1])


def test_unknown_columns_are_named_once(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"plan.csv: columns are not used: 'wieght' \(did you mean 'weight'\?\), 'z'$"):
        assert load(tmp_path, "q1_deg,wieght,z\n1,1,1\n").weights is None


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


def test_number_of_links_must_fit(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"plan.csv: column 'q2_deg' is missing"):
        load(tmp_path, "q1_deg\n1\n", links=2)
    with pytest.raises(InputError, match=r"plan.csv: found column q2_deg, but the arm has 1 links"):
        load(tmp_path, "q1_deg,q2_deg\n1,1\n", links=1)


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
    path.write_text(plan_text(plan))
    again = load_plan(path, plan.links)
    np.testing.assert_allclose(again.postures, plan.postures, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(again.shares, plan.shares)
    assert (again.weights is None) == (plan.weights is None)
