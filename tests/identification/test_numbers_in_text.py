"""Numbers as tables have them: no digits that mean nothing, no minus before a zero."""

from __future__ import annotations

import math

import pytest

from identification.document import (
    as_sentence,
    estimate_text,
    in_a_sentence,
    number,
    to_significant_digits,
    unit_or_dash,
)


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


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.10953, "0.110"), (1.4236, "1.42"), (34.04, "34.0"), (1829.0, "1829"), (0.0, "0"), (None, "-")],
)
def test_figures_in_sentences_have_three_digits(value: float | None, text: str) -> None:
    assert in_a_sentence(value) == text


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [(0.0, None, "mm", "0"), (1.23456789, 1e-6, "mm", "1.23457"), (1.23456789e-7, 1e-9, "1", "1.23e-07")],
)
def test_estimates_in_mm_and_deg_have_at_most_five_decimals(value: float, std: float, unit: str, text: str) -> None:
    assert estimate_text(value, std, unit) == text


def test_a_number_without_a_unit_has_a_dash_for_one_and_a_clause_becomes_a_sentence() -> None:
    assert [unit_or_dash(unit) for unit in ("mm", "1", "1/K")] == ["mm", "–", "1/K"]
    assert [as_sentence(clause) for clause in ("two [mm]", "Done.", "")] == ["Two [mm].", "Done.", "."]
