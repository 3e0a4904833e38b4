"""Numbers as tables have them: no digits that mean nothing, no minus before a zero."""

from __future__ import annotations

import math

import pytest

from identification.numbers_in_text import number, to_significant_digits


@pytest.mark.parametrize(
    ("value", "text"), [(None, "-"), (math.nan, "-"), (math.inf, "-"), (1.23456, "1.2346"), (-1e-9, "0.0000")]
)
def test_number(value: float | None, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (1.23456789, 0.0123, "1.2346"),
        (1.23456789, 12.3, "1.2"),
        (None, 1.0, "-"),
        (2e7, 1.0, "2e+07"),
        (0.5, None, "0.5"),
        (-1e-5, 0.1, "0.000"),
    ],
)
def test_significant_digits_are_three_of_the_standard_deviation(
    value: float | None, std: float | None, text: str
) -> None:
    assert to_significant_digits(value, std) == text
