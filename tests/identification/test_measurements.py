"""Directions and time that follow from the order of measurement."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.measurements import directions_from_order, session_time


@given(st.integers(0, 2**32), st.integers(1, 15), st.booleans())
@settings(max_examples=60, deadline=None, derandomize=True)
def test_directions_are_the_last_motion(seed: int, m: int, shuffled: bool) -> None:
    """Row by row as GAP.md says: first row +1, then the sign of the change, no change: as before."""
    generator = np.random.default_rng(seed)
    postures = generator.integers(0, 3, (m, 3)).astype(float)  # few values, so that joints often rest
    order = generator.permutation(m).astype(float) * 7.0 if shuffled else None
    found = directions_from_order(postures, order)
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
    np.testing.assert_allclose(session_time(np.array([10.0, 20.0, 15.0])), [-0.5, 0.5, 0.0])
    np.testing.assert_array_equal(session_time(np.array([3.0, 3.0])), [0.0, 0.0])
