"""When and where a hold-out was measured: on points moved in plain numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.gap.confirmation import Placed, held_out_conditions, point_names, set_up_of, split, transfer_of
from identification.measurements import Measurements
from tests.identification.gap.test_confirmation import DATA

ROWS, NOISE = 60, 0.1
SHIFT, TURN = np.array([300.0, -80.0, 40.0]), Rotation.from_rotvec([0.2, -1.1, 0.5]).as_matrix()
OTHER = np.array([25.0, -60.0, 10.0])  # from one point to the other, in the tip's frame


def predicted(seed: int, base: bool, points: dict[str, np.ndarray], dimension: int = 3) -> Placed:
    """Rows of points A and B in turns; measured with another base, or with points moved by so much."""
    generator = np.random.default_rng(seed)
    axes = Rotation.random(ROWS, random_state=generator).as_matrix()
    own = generator.uniform(-1000.0, 1000.0, (ROWS, dimension))
    names = np.tile(["A", "B"], ROWS // 2)
    tips = own + 0.0
    if dimension == 3:
        tips += np.array([turn @ points.get(name, np.zeros(3)) for turn, name in zip(axes, names, strict=True)])
    if base and dimension == 3:
        tips = tips @ TURN.T + SHIFT
    if base and dimension == 2:
        tips = tips @ Rotation.from_euler("z", 2.0).as_matrix()[:2, :2].T + SHIFT[:2]
    measured = tips + NOISE * generator.standard_normal(tips.shape)
    return Placed(own, axes if dimension == 3 else None, measured, names)


SetUp = tuple[bool, tuple[str, ...]]
NOTHING: SetUp = (False, ())
CASES: tuple[tuple[bool, dict[str, np.ndarray], SetUp], ...] = (
    (False, {}, NOTHING),
    (True, {}, (True, ())),
    (False, {"A": OTHER, "B": OTHER}, (False, ("A", "B"))),
    (True, {"A": OTHER, "B": -OTHER}, (True, ("A", "B"))),
)


@pytest.mark.parametrize(("base", "points", "expected"), CASES)
def test_the_least_that_explains_it_is_refitted(base: bool, points: dict[str, np.ndarray], expected: SetUp) -> None:
    rows = predicted(1, base, points)
    found = set_up_of(rows, (), elsewhere=True)
    assert found == expected
    left = rows.refitted(*found)[1]
    # of 180 coordinates: 5 % is the standard deviation of such an estimate; the values fitted cost nothing
    assert np.sqrt(np.mean(left**2)) == pytest.approx(NOISE, rel=0.15)
    assert set_up_of(rows, (), elsewhere=False) == NOTHING


@pytest.mark.parametrize("base", [False, True])
def test_a_point_of_another_name_is_refitted(base: bool) -> None:
    rows = predicted(2, base, {"B": OTHER})
    found = set_up_of(rows, ("B",), elsewhere=False)
    assert found == (base, ("B",))
    assert np.sqrt(np.mean(rows.refitted(*found)[1] ** 2)) == pytest.approx(NOISE, rel=0.15)


@pytest.mark.parametrize("base", [False, True])
def test_in_a_plane_only_the_base(base: bool) -> None:
    rows = predicted(3, base, {}, dimension=2)
    found = set_up_of(rows, (), elsewhere=True)
    assert found == (base, ())
    assert np.sqrt(np.mean(rows.refitted(*found)[1] ** 2)) == pytest.approx(NOISE, rel=0.2)


def test_residuals_do_not_shrink_by_what_is_fitted() -> None:
    """Fits of 6 + 6 values to 180 coordinates take a part of the noise, which is given back: on average over 200 sets
    the mean square is that of the noise, to 3 of its standard deviations."""
    both = (True, ("A", "B"))
    means = [float(np.mean(predicted(seed, True, {"A": OTHER}).refitted(*both)[1] ** 2)) for seed in range(200)]
    error = NOISE**2 * np.sqrt(2.0 / (3 * ROWS - 12) / 200)
    assert np.mean(means) == pytest.approx(NOISE**2, abs=3.0 * error)


def test_points_have_the_numbers_of_the_data() -> None:
    generator = np.random.default_rng(4)
    q, y = generator.uniform(-1.0, 1.0, (4, 6)), generator.uniform(-1.0, 1.0, (4, 3))
    data = Measurements(q, y, marker=np.array(["A", "B", "C", "A"]))
    held = replace(data, marker=np.array(["C", "D", "B", "C"]), marker_names=())
    numbers, fresh = point_names(data, held)
    assert numbers is not None
    assert (numbers.tolist(), fresh) == ([2.0, 0.0, 1.0, 2.0], ("D",))
    one, other = (replace(data, marker=np.full(4, name), marker_names=()) for name in ("A", "D"))
    numbers, fresh = point_names(one, other)
    assert numbers is not None
    assert (numbers.tolist(), fresh) == ([0.0] * 4, ())
    assert point_names(data, replace(data, marker=None, marker_names=())) == (None, ())


def test_the_order_of_measurement_says_what_is_tested() -> None:
    first, second = DATA.rows(np.arange(60)), DATA.rows(np.arange(60, 100))
    assert transfer_of(first, second) == "a later time"
    assert transfer_of(second, first) == "an earlier time"
    assert transfer_of(*split(DATA, 0.4, np.random.default_rng(0))) == "other postures"
    assert transfer_of(first, first) == "another session"  # numbers start again
    assert transfer_of(first, replace(second, order=second.order + 100.0)) == "another session"  # a long pause
    assert transfer_of(first, replace(second, order=None)) == "other rows"


def test_time_goes_on_within_a_session_and_starts_again_in_another() -> None:
    first, second = DATA.rows(np.arange(51)), DATA.rows(np.arange(51, 100))
    time = held_out_conditions(first, second).time
    np.testing.assert_allclose(time, np.arange(51, 100) / 50.0 - 0.5)
    apart = held_out_conditions(first, replace(second, order=np.arange(49.0))).time
    np.testing.assert_allclose(apart, np.linspace(-0.5, 0.5, 49))


def test_temperature_is_counted_from_the_mean_of_the_data() -> None:
    first, second = DATA.rows(np.arange(50)), DATA.rows(np.arange(50, 100))
    there = held_out_conditions(first, second)
    np.testing.assert_allclose(there.temperature, second.temperature - first.temperature.mean())
