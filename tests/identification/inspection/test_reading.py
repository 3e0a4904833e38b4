"""A reading in words, and what it makes of columns."""

from __future__ import annotations

import numpy as np

from identification.inspection.reading import Reading, Readings

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


def test_one_two_or_no_explanations() -> None:
    assert Readings(PLAIN, None).sentences == []
    assert Readings(PLAIN, None).to_json() is None
    way = "joint 1 turns the other way"
    both = Readings(PLAIN, REVERSED, (SWAPPED,))
    assert both.sentences[0].startswith(
        f"it looks as if {way}, or, equally well, columns of joints 1 and 2 are swapped"
    )
    assert both.to_json() == {
        "changes": (way,), "rms_mm": 0.91, "explains": True, "equally_good": [SWAPPED.words]
    }  # fmt: skip
    (said,) = Readings(PLAIN, REVERSED, explained=False).sentences
    assert said.endswith(f"Closest: {way}, which leaves 0.91 mm instead of 300")
