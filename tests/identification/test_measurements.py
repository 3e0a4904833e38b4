"""Directions and time that follow from the order of measurement."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.measurements import (
    BYTES,
    KEPT,
    REMEMBERED,
    Measurements,
    condition_columns,
    digests_in,
    digests_text,
    directions_from_order,
    past_from_order,
    row_digests,
)
from tests.refusals import refused


@given(st.integers(0, 2**32), st.integers(1, 15), st.booleans())
@settings(max_examples=60)
def test_directions_are_the_last_motion(seed: int, m: int, shuffled: bool) -> None:
    """First row +1, then the sign of the change, no change: as before (identification/README.md, "Effects")."""
    generator = np.random.default_rng(seed)
    postures = generator.integers(0, 3, (m, 3)).astype(float)  # few values, so that joints often rest
    order = generator.permutation(m).astype(float) * 7.0 if shuffled else None
    found = np.asarray(Measurements(postures, np.zeros((m, 2)), order).conditions.directions)
    sequence = range(m) if order is None else np.argsort(order)
    last, before = np.ones(3), None
    for row in sequence:
        if before is not None:
            for j in range(3):
                if postures[row, j] != before[j]:
                    last[j] = 1.0 if postures[row, j] > before[j] else -1.0
        np.testing.assert_array_equal(found[row], last)
        before = postures[row]


def test_session_time_runs_from_minus_to_plus_a_half() -> None:
    for order, time in (([10.0, 20.0, 15.0], [-0.5, 0.5, 0.0]), ([3.0], [0.0])):
        rows = Measurements(Q[: len(order)], X[: len(order)], order=np.array(order))
        np.testing.assert_allclose(rows.conditions.time, time)


Q = np.random.default_rng(5).uniform(-2.0, 2.0, (20, 4))
X = np.ones((20, 2))


def changed(values: np.ndarray, row: int, value: float) -> np.ndarray:
    copy = np.array(values, dtype=float)
    copy[row] = value
    return copy


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"positions": X[:1]}, "measurements.positions: shape (1, 2) for 20 postures of 4 joints, allowed: (20, 2)"),
        ({"positions": "data.csv"}, "measurements.positions: not an array of numbers, allowed: real numbers"),
        ({"positions": changed(X, 6, np.nan)}, "measurements.positions: row 7 has [nan, nan], allowed: finite"),
        ({"postures": Q[:0], "positions": X[:0]}, "measurements.postures: shape (0, 4), allowed: (m, n) with m >= 1"),
        ({"postures": np.zeros((20, 13))}, "measurements.postures: shape (20, 13), allowed: (m, n)"),
        ({"order": np.arange(19)}, "measurements.order: shape (19,) for 20 postures of 4 joints, allowed: (20,)"),
        ({"payload": changed(np.ones(20), 0, -1.0)}, "measurements.payload: row 1 has -1.0, allowed: a number >= 0"),
        ({"temperature": 20.0}, "measurements.temperature: shape () for"),
        ({"temperature": np.full(20, -300.0)}, "measurements.temperature: row 1 has -300.0, allowed: a number >= -273"),
        ({"directions": changed(np.ones((20, 4)), 4, 0.0)}, "measurements.directions: row 5 has [0.0, 0.0, 0.0, 0.0]"),
        ({"sigma": np.zeros(20)}, "measurements.sigma: row 1 has 0.0, allowed: a number > 0 [mm]"),
        ({"session": ["a", ""] * 10}, "measurements.session: row 2 has '', allowed: a name"),
        ({"repeats": np.full(20, 0.5)}, "measurements.repeats: row 1 has 0.5, allowed: a whole number"),
    ],
)
def test_what_no_session_can_be_is_one_line(given: dict, sentence: str) -> None:
    refused(lambda: Measurements(**{"postures": Q, "positions": X, **given}), names=[sentence])


def test_lists_are_measurements_too_and_nothing_can_be_written_to() -> None:
    measured = Measurements([[0.1, 0.2]], [[1, 2]], sigma=[0.1], directions=[[1, -1]], repeats=[3])
    assert measured.repeats.dtype == np.int64
    for name in ("postures", "positions", "sigma", "directions", "repeats"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(measured, name)[0] = 1


def test_each_session_has_its_own_time_and_directions() -> None:
    """Rows of two sessions in any order, the order counted anew in each, give what each session gives alone."""
    generator = np.random.default_rng(11)
    q, session = generator.normal(size=(12, 3)), np.array(["b", "a", "a", "b"] * 3)
    order = np.empty(12)
    for name in "ab":
        order[session == name] = generator.permutation(6)
    data = Measurements(q, np.ones((12, 2)), order, session=session)
    assert data.sessions == ("b", "a")
    for name, rows in zip(data.sessions, data.session_rows, strict=True):
        alone = Measurements(q[session == name], np.ones((6, 2)), order[session == name])
        np.testing.assert_array_equal(data.conditions.time[rows], alone.conditions.time)
        np.testing.assert_array_equal(data.conditions.directions[rows], alone.conditions.directions)
        assert data.rows(rows).sessions == (name,)
    assert data.session[data.sequence].tolist() == ["b"] * 6 + ["a"] * 6
    np.testing.assert_array_equal(order[data.sequence], [*range(6), *range(6)])


def test_what_an_encoder_reads_of_a_joint_that_stays_is_no_motion() -> None:
    """Repeats of three postures, read to 0.001 degrees, come from the side that the first of them did, as do those of a
    slide of 628 mm, read to 0.02 mm; a slow scan moves."""
    generator = np.random.default_rng(12)
    q = np.repeat([[0.3, -0.2], [0.8, -0.9], [0.1, -0.9]], 20, axis=0)
    read = q + generator.uniform(-2e-5, 2e-5, q.shape)
    for scale in (1.0, 100.0 * 2.0 * np.pi / 0.7):
        found = Measurements(scale * read, np.zeros((60, 2)))
        np.testing.assert_array_equal(found.conditions.directions, np.repeat([[1, 1], [1, -1], [-1, -1]], 20, axis=0))
        assert found.posture_numbers.tolist() == np.repeat([0, 1, 2], 20).tolist()
    assert directions_from_order(-2e-4 * np.arange(20.0)[:, None])[3:].max() == -1.0


def test_origin_says_where_a_calibration_may_be_used() -> None:
    q = np.radians([[10.0, -20.0], [-30.0, 40.0]])
    origin = Measurements(q, np.ones((2, 2)), temperature=[20.0, 23.0], provenance={"file": "a.csv"}).origin
    assert len(origin.pop("digests_of_rows")) == 2 * 8  # six bytes a row, as text
    assert origin == {"file": "a.csv", "rows": 2, "mean_temperature_C": 21.5}


def stop(angles: np.ndarray, width: float) -> np.ndarray:
    """State of Prandtl's stop with all of the history, from 0 at the first angle."""
    state = np.zeros(len(angles))
    for i in range(1, len(angles)):
        state[i] = np.clip(state[i - 1] + angles[i] - angles[i - 1], -width, width)
    return state


@pytest.mark.parametrize("width", [0.05, 0.3, 1.0, 2.5])
def test_turning_points_are_all_that_hysteresis_remembers(width: float) -> None:
    """The state from the turning points is that of the whole history, for random postures and for small steps."""
    rng = np.random.default_rng(6)
    for angles in (rng.uniform(-3.0, 3.0, 25), np.cumsum(rng.normal(0.0, 0.2, 40))):
        past = past_from_order(angles[:, None])
        assert past.shape == (len(angles), 1, REMEMBERED)
        np.testing.assert_array_equal(past[1:, 0, -1], angles[:-1])  # the posture before
        np.testing.assert_array_equal(past[0, 0], angles[0])
        state = np.zeros(len(angles))
        swings = np.diff(np.column_stack([past[:, 0], angles]), axis=1)
        for swing in swings.T:
            state = np.clip(state + swing, -width, width)
        np.testing.assert_allclose(state, stop(angles, width), atol=1e-12)


def test_the_past_follows_the_order_and_stays_with_its_rows() -> None:
    q = np.array([[0.1], [0.5], [0.2], [0.9]])
    data = Measurements(q, np.zeros((4, 2)), order=np.array([3.0, 1.0, 4.0, 2.0]))  # measured: 0.5, 0.9, 0.1, 0.2
    past = np.asarray(data.conditions.past)
    np.testing.assert_array_equal(past[:, 0, -1], [0.9, 0.5, 0.1, 0.5])
    some = data.rows([0, 2])
    np.testing.assert_array_equal(np.asarray(some.conditions.past), past[[0, 2]])
    np.testing.assert_array_equal(np.asarray(some.rows([1]).conditions.past), past[[2]])


def test_conditions_travel_and_compare_by_their_numbers() -> None:
    conditions = (data := Measurements(Q, X)).rows(slice(None, None, 2)).conditions
    wide = conditions.table(condition_columns(4, {"past"}), Q[::2], 1.0)
    np.testing.assert_array_equal(wide[:, 8:], past_from_order(Q)[::2].reshape(10, -1))
    assert conditions == data.rows(np.arange(0, 20, 2)).conditions
    assert conditions != data.rows(np.arange(1, 20, 2)).conditions
    assert pickle.loads(pickle.dumps(conditions)) == conditions


# -- postures and repeats ----------------------------------------------------------------------------------------------
def test_reflectors_of_one_posture_share_it_and_are_no_repeats() -> None:
    """Three reflectors at each of 982 random postures, read one after the other or in three rounds: no repeats. Read
    twice, rows of equal posture and reflector are repeats, in each session and with each payload its own."""
    generator = np.random.default_rng(41)
    q = generator.uniform(-2.5, 2.5, (982, 6))
    for posture in (np.repeat(np.arange(982), 3), np.tile(np.arange(982), 3)):
        marker = np.array(["a", "b", "c"])[np.arange(3 * 982) % 3 if posture[1] == 0 else np.arange(3 * 982) // 982]
        data = Measurements(q[posture], np.ones((3 * 982, 3)), marker=marker)
        assert np.array_equal(same(data.posture_numbers), same(posture))
        assert len(np.unique(data.repeat_numbers)) == 3 * 982
    twice, marker = np.tile(posture, 2), np.tile(marker, 2)
    read = q[twice] + np.radians(0.005) * generator.uniform(-1.0, 1.0, (len(twice), 6))
    data = Measurements(read, np.ones((len(twice), 3)), marker=marker)
    assert np.array_equal(same(data.posture_numbers), same(twice))
    assert np.array_equal(np.bincount(data.repeat_numbers), np.full(3 * 982, 2))
    days = replace(data, session=np.repeat(["first", "second"], 3 * 982))
    loads = replace(data, payload=np.repeat([0.0, 5.0], 3 * 982))
    for apart in (days, loads):
        assert np.array_equal(same(apart.posture_numbers), same(twice))
        assert len(np.unique(apart.repeat_numbers)) == len(twice)


def same(numbers: np.ndarray) -> np.ndarray:
    """(m,) the first row of each row's number: equal for equal groupings."""
    return np.unique(numbers, return_index=True)[1][np.unique(numbers, return_inverse=True)[1]]


@pytest.mark.parametrize("step", [0.002, 0.028])
def test_a_slow_scan_repeats_nothing(step: float) -> None:
    """A joint that is read every few thousandths of a degree; every row is another posture, unless its angles are equal
    to another's, as of two reflectors."""
    q = np.zeros((100, 3))
    q[:, 1] = np.radians(step * np.arange(100))
    assert len(np.unique(Measurements(q, np.ones((100, 2))).posture_numbers)) == 100
    two = Measurements(np.repeat(q, 2, axis=0), np.ones((200, 3)), marker=np.tile(["a", "b"], 100))
    assert np.array_equal(same(two.posture_numbers), np.repeat(np.arange(0, 200, 2), 2))
    assert len(np.unique(two.repeat_numbers)) == 200


@given(st.integers(0, 2**32), st.integers(1, 12), st.integers(1, 5))
@settings(max_examples=40)
def test_rows_that_an_arm_came_back_to_are_one_posture_in_any_order(seed: int, postures: int, times: int) -> None:
    generator = np.random.default_rng(seed)
    number = generator.permutation(np.repeat(np.arange(postures), times))
    q = 0.1 * generator.permutation(postures)[:, None] * np.ones(4)
    read = q[number] + np.radians(0.01) * generator.uniform(-1.0, 1.0, (len(number), 4))
    assert np.array_equal(same(Measurements(read, np.ones((len(number), 2))).posture_numbers), same(number))


# -- rows of two sets --------------------------------------------------------------------------------------------------
POSTURES, POSITIONS = np.random.default_rng(1).uniform(-3.0, 3.0, (12_000, 9)).round(6), 3
ROWS = POSTURES[:, :6], 1000.0 * POSTURES[:, 6:]


def digests(postures: np.ndarray, positions: np.ndarray) -> str:
    """Their text."""
    return digests_text(row_digests(postures, positions))


def of(rows: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
    return ROWS[0][rows], ROWS[1][rows]


@given(st.integers(0, 2**32), st.integers(1, 40), st.integers(0, 40), st.integers(0, 40))
@settings(max_examples=40)
def test_shares_of_few_rows_are_exact(seed: int, both: int, first: int, second: int) -> None:
    """In any order, with rows repeated, and after rounding of the last bits."""
    generator = np.random.default_rng(seed)
    rows = generator.permutation(12_000)[: both + first + second]
    one, other = rows[: both + first], generator.permutation(np.r_[rows[:both], rows[both + first :], rows[:both]])
    q, x = of(other)
    shares = Measurements(np.radians(np.degrees(q)), x / 1000.0 * 1000.0).shared_rows(digests(*of(one)))
    assert shares == pytest.approx((both / (both + second), both / (both + first)))


@pytest.mark.parametrize("decimals", [3, 4, 5])
def test_rows_written_with_fewer_digits_are_known(decimals: int) -> None:
    """Angles in degrees; of what is at half a step, rounding decides by itself."""
    q, x = (np.random.default_rng(2).normal(0.0, size, (1000, 3)) for size in (60.0, 600.0))
    written = Measurements(np.radians(q.round(decimals)), x.round(decimals))
    assert min(written.shared_rows(digests(np.radians(q), x.round(5)))) > 0.8
    again = x + np.random.default_rng(3).normal(0.0, 0.01, x.shape)
    assert max(Measurements(np.radians(q), again).shared_rows(digests(np.radians(q), x))) < 0.01


def test_many_rows_take_bounded_space_and_show_a_part_of_them() -> None:
    text = digests(*of(slice(0, 9000)))
    assert len(text) == 4 * KEPT * BYTES // 3
    for rows, share in ((slice(0, 9000), 1.0), (slice(4000, 4100), 1.0), (slice(9000, 12_000), 0.0)):
        assert Measurements(*of(rows)).shared_rows(text)[0] == share
    half, of_its = Measurements(*of(slice(6000, 12_000))).shared_rows(text)
    # binomial: of 6,000 rows 1,333 are among the digests' range, of 2,000 digests 667 are of these rows
    assert half == pytest.approx(0.5, abs=4.0 * 0.5 / np.sqrt(1333))
    assert of_its == pytest.approx(1.0 / 3.0, abs=4.0 * 0.5 / np.sqrt(2000))


def test_a_union_is_that_of_the_rows() -> None:
    parts = [digests(*of(slice(a, b))) for a, b in ((0, 3000), (2000, 7000), (7000, 7010))]
    assert digests_text(set().union(*map(digests_in, parts))) == digests(*of(slice(0, 7010)))


@pytest.mark.parametrize("text", ["", "no digests", "AAAA", "\u00e9"])
def test_a_text_that_no_program_wrote_has_no_rows(text: str) -> None:
    assert Measurements(*of(slice(0, 5))).shared_rows(text) == (0.0, 0.0)
