"""Splines of an error curve against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from identification.error_curve import ErrorCurve, all_hold, spline
from identification.errors import InputError

VALUES = 1e-3 * np.random.default_rng(3).normal(size=12)
CURVE = ErrorCurve(-0.5, 1.7, VALUES)


def test_agrees_with_scipy_and_is_zero_beyond_two_nodes() -> None:
    """scipy's B-splines on the same nodes, whose values at the nodes are solved for densely."""
    h = 2.2 / 11
    knots = -0.5 + h * np.arange(-2, 15)  # of the 12 B-splines centered on the nodes, and of one beyond
    nodes = np.linspace(-0.5, 1.7, 12)
    design = np.column_stack([BSpline.basis_element(knots[k : k + 5], extrapolate=False)(nodes) for k in range(12)])
    coefficients = np.linalg.solve(np.nan_to_num(design), VALUES)
    q = np.linspace(-1.5, 2.7, 999)
    each = [BSpline.basis_element(knots[k : k + 5], extrapolate=False)(q) for k in range(12)]
    np.testing.assert_allclose(CURVE.at(q), np.nan_to_num(np.array(each)).T @ coefficients, atol=1e-15)
    outside = (q < -0.5 - 2 * h) | (q > 1.7 + 2 * h)
    assert np.all(CURVE.at(q[outside]) == 0.0)
    np.testing.assert_allclose(CURVE.at(nodes), VALUES, atol=1e-16)


def test_keeps_the_shape_of_the_angles() -> None:
    q = np.linspace(-3.0, 3.0, 24).reshape(2, 3, 4)
    np.testing.assert_array_equal(CURVE.at(q).ravel(), CURVE.at(q.ravel()))
    assert CURVE.at(0.3).shape == ()


def test_splines_sum_to_one() -> None:
    x = np.linspace(0.0, 1.0, 50)
    np.testing.assert_allclose(sum(spline(x - k) for k in range(-2, 4)), 1.0, atol=1e-15)


@pytest.mark.parametrize(
    ("start", "stop", "values", "message"),
    [
        (1.0, 1.0, VALUES, "from_deg, to_deg: found 57.2958 to 57.2958"),
        (0.0, np.inf, VALUES, "from_deg, to_deg"),
        (0.0, 1.0, VALUES[:3], "values_deg: found 3 values"),
        (0.0, 1.0, [0.0, np.nan, 0.0, 0.0], "values_deg"),
    ],
)
def test_bad_input(start: float, stop: float, values: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        ErrorCurve(start, stop, values)


def test_equal_by_value() -> None:
    assert ErrorCurve(-0.5, 1.7, VALUES.copy()) == CURVE
    assert ErrorCurve(-0.5, 1.8, VALUES) != CURVE


def test_whole_turns_away_it_is_the_same() -> None:
    """Also for angles that lie a turn from where they were measured; between the ends and there it is zero."""
    curve = ErrorCurve(-1.0, 1.5, np.random.default_rng(2).standard_normal(20))
    angles = np.linspace(-1.0, 1.5, 33)
    for turns in (-2, 1):
        np.testing.assert_allclose(curve.at(angles + 2.0 * np.pi * turns), curve.at(angles), atol=1e-12)
    np.testing.assert_array_equal(curve.at([2.5, -2.5, 2.5 + 2.0 * np.pi]), 0.0)


def test_holds_between_its_ends_and_not_beyond() -> None:
    h = 2.2 / 11
    assert CURVE.holds([-0.5, 0.3, 1.7, 0.3 + 2.0 * np.pi, 1.7 - 4.0 * np.pi]) == pytest.approx(1.0)
    assert CURVE.holds([-0.5 - 2.0 * h, 1.7 + 2.0 * h, 3.0, 3.0 - 2.0 * np.pi]) == pytest.approx(0.0)
    assert CURVE.holds([-0.5 - h, 1.7 + h]) == pytest.approx(0.5)  # halfway
    q = np.linspace(1.7, 1.7 + 2.0 * h, 2001)
    assert np.abs(np.diff(CURVE.holds(q), 2)).max() < 2e-6  # no bend: 6 / 2000^2 at most
    assert ErrorCurve(-4.0, 4.0, VALUES).holds(np.linspace(-9.0, 9.0, 50)) == pytest.approx(1.0)


def test_all_hold_where_each_does() -> None:
    q = np.array([[[0.0, 0.3, 0.0], [3.0, 0.3, 0.0]], [[3.0, 0.3, 3.0], [3.0, 3.0, 0.0]]])
    np.testing.assert_allclose(all_hold([(1, CURVE), (2, CURVE)], q), [[1.0, 1.0], [0.0, 0.0]])
    np.testing.assert_array_equal(all_hold([], q), np.ones((2, 2)))


def test_equal_curves_have_the_same_geometry() -> None:
    assert ErrorCurve(-0.5, 1.7, VALUES, {"joint_offset:1": 1e-3}) != CURVE
    assert ErrorCurve(-0.5, 1.7, VALUES, {}) == CURVE
