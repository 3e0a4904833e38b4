"""Rows that are in both of two sets, from the digests of one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.measurements import BYTES, KEPT, Measurements, digests_in, digests_text, row_digests, shared_rows

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
    shares = shared_rows(digests(*of(one)), Measurements(np.radians(np.degrees(q)), x / 1000.0 * 1000.0))
    assert shares == pytest.approx((both / (both + second), both / (both + first)))


@pytest.mark.parametrize("decimals", [3, 4, 5])
def test_rows_written_with_fewer_digits_are_known(decimals: int) -> None:
    """Angles in degrees; of what is at half a step, rounding decides by itself."""
    q, x = (np.random.default_rng(2).normal(0.0, size, (1000, 3)) for size in (60.0, 600.0))
    written = Measurements(np.radians(q.round(decimals)), x.round(decimals))
    assert min(shared_rows(digests(np.radians(q), x.round(5)), written)) > 0.8
    again = x + np.random.default_rng(3).normal(0.0, 0.01, x.shape)
    assert max(shared_rows(digests(np.radians(q), x), Measurements(np.radians(q), again))) < 0.01


def test_many_rows_take_bounded_space_and_show_a_part_of_them() -> None:
    text = digests(*of(slice(0, 9000)))
    assert len(text) == 4 * KEPT * BYTES // 3
    for rows, share in ((slice(0, 9000), 1.0), (slice(4000, 4100), 1.0), (slice(9000, 12_000), 0.0)):
        assert shared_rows(text, Measurements(*of(rows)))[0] == share
    half, of_its = shared_rows(text, Measurements(*of(slice(6000, 12_000))))
    # binomial: of 6,000 rows 1,333 are among the digests' range, of 2,000 digests 667 are of these rows
    assert half == pytest.approx(0.5, abs=4.0 * 0.5 / np.sqrt(1333))
    assert of_its == pytest.approx(1.0 / 3.0, abs=4.0 * 0.5 / np.sqrt(2000))


def test_a_union_is_that_of_the_rows() -> None:
    parts = [digests(*of(slice(a, b))) for a, b in ((0, 3000), (2000, 7000), (7000, 7010))]
    assert digests_text(set().union(*map(digests_in, parts))) == digests(*of(slice(0, 7010)))


@pytest.mark.parametrize("text", ["", "no digests", "AAAA", "\u00e9"])
def test_a_text_that_no_program_wrote_has_no_rows(text: str) -> None:
    assert shared_rows(text, Measurements(*of(slice(0, 5)))) == (0.0, 0.0)
