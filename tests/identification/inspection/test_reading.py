"""A reading in words, and what it makes of columns."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given

from identification.inspection.reading import Reading, Readings
from identification.kinematics.counting import Counting
from tests.identification.kinematics.test_counting import countings

PLAIN = Reading((0, 1, 2), (1, 1, 1), (0, 0, 0), rms=300.0)
SWAPPED = Reading((1, 0, 2), (1, 1, -1), (0, 3, 0), mirrored=True, turn=0.1, rms=0.9)
REVERSED = Reading((0, 1, 2), (-1, 1, 1), (0, 0, 0), rms=0.91)


def test_columns_are_read_and_named() -> None:
    assert SWAPPED.changes == 4
    assert SWAPPED.words == (
        "columns of joints 1 and 2 are swapped",
        "joint 3 turns the other way",
        "joint 2 has another zero than the drawing: add -90 deg to it",
        "an axis of the positions points the other way",
    )
    assert np.allclose(SWAPPED.postures(np.array([[0.1, 0.2, 0.3]])), [[0.2, 0.1 + 1.5 * np.pi, -0.3]])
    assert np.allclose(SWAPPED.positions(np.array([[5.0, 6.0]])), [[5.0, -6.0]])


def test_joints_counted_from_farther_back() -> None:
    """Columns a = q1, b = q1 + q2 and c = q3 - q2, whose axis points the other way."""
    found = Reading((0, 1, 2), (1, 1, 1), (0, 0, 0), sums=((1, 0, 0), (1, 1, 0), (0, -1, 1)))
    assert found.words == (
        "joint 2 is counted from the base, not from link 1 (its angle: column - q1)",
        "joint 3 is counted from link 1, not from link 2 (its angle: column + q2)",
    )
    assert (found.changes, found.moved_zeros) == (1, False)
    q = np.array([[0.1, 0.2, 0.3], [1.0, -2.0, 0.5]])
    columns = np.column_stack([q[:, 0], q[:, 0] + q[:, 1], q[:, 2] - q[:, 1]])
    assert np.allclose(found.postures(columns), q)


@given(countings(joints=4), countings(joints=4))
def test_how_a_controller_counts(before: Counting, true: Counting) -> None:
    """Columns of one controller, read as the arm file says of another: the reading that makes them the joints' says the
    first, whatever the file said, where signs and sums of the joints so far say it."""
    q = np.random.default_rng(3).uniform(-1.0, 1.0, (6, 4))
    read = before.joints(true.columns(q))
    # read = matrix q + zero, to be signs * sums and zeros
    matrix = before.inverse @ true.matrix
    signs = np.sign(np.diag(matrix)).astype(int)
    assume(np.all(np.abs(np.diag(matrix)) == 1.0))
    sums = signs[:, None] * matrix
    zeros = -signs * (before.inverse @ (np.array(true.zero) - before.zero))
    rows = tuple(tuple(int(x) for x in row) for row in sums)
    reading = Reading((0, 1, 2, 3), tuple(signs.tolist()), tuple((zeros / (0.5 * np.pi)).tolist()), sums=rows)
    np.testing.assert_allclose(reading.postures(read), q, atol=1e-9)
    found = reading.counting(before)
    assert found is not None
    turns = (found.columns(q) - true.columns(q)) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns[0]) * np.ones((6, 1)), atol=1e-9)  # zeros by the shorter way


def test_what_no_arm_file_says() -> None:
    assert SWAPPED.counting(None) is None
    found = REVERSED.counting(None)
    assert found is not None
    assert found.toml == "[joints]\nsign = [-1, 1, 1]"
    every = Reading((0, 1, 2), (1, 1, 1), (0, 0, 0), sums=((1, 0, 0), (0, 1, 0), (1, 1, 1)))
    assert every.counting(None) is None


def test_one_two_or_no_explanations() -> None:
    assert Readings(PLAIN, None).sentences == []
    assert Readings(PLAIN, None).to_json() is None
    way = "joint 1 turns the other way"
    both = Readings(PLAIN, REVERSED, (SWAPPED,))
    assert both.sentences[0].startswith(
        f"it looks as if {way}, or, equally well, columns of joints 1 and 2 are swapped"
    )
    assert both.to_json() == {
        "changes": (way,), "arm_file": None, "rms_mm": 0.91, "explains": True, "equally_good": [SWAPPED.words]
    }  # fmt: skip
    (said,) = Readings(PLAIN, REVERSED, explained=False).sentences
    assert said.endswith(f"Closest: {way}, which leaves 0.91 mm instead of 300")
