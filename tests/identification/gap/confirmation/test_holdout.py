"""Holding out postures, and what a hold-out tests."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from identification.errors import InputError
from identification.gap.confirmation.confirmation import HeldOut, Mean
from identification.gap.confirmation.holdout import confirmation_of, held_out_conditions, split, transfer_of
from identification.measurements import Measurements

RNG = np.random.default_rng(1)
NUMBER = np.repeat(np.arange(50), 2)
DATA = Measurements(
    RNG.uniform(-3.0, 3.0, (50, 3))[NUMBER],
    RNG.normal(size=(100, 2)),
    np.arange(100.0),
    temperature=20.0 + RNG.random(100),
)


def test_postures_are_held_out_with_their_repeats() -> None:
    data, held = split(DATA, 0.3, np.random.default_rng(0))
    assert (len(data), len(held)) == (70, 30)
    own, other = (set(map(tuple, rows.postures)) for rows in (data, held))
    assert len(own) == 35
    assert not own & other
    again = split(DATA, 0.3, np.random.default_rng(0))[1]
    assert np.array_equal(again.postures, held.postures)
    assert len(split(DATA, 1e-9, np.random.default_rng(0))[1]) == 2  # at least one posture
    assert len(split(DATA, 0.9999, np.random.default_rng(0))[0]) == 2


@pytest.mark.parametrize("share", [0.0, 1.0, -0.2, float("nan")])
def test_a_share_is_between_none_and_all(share: float) -> None:
    with pytest.raises(InputError, match="allowed: a share of the rows between 0 and 1"):
        split(DATA, share, np.random.default_rng(0))


def test_rows_of_one_posture_cannot_be_split() -> None:
    with pytest.raises(InputError, match="of one posture"):
        split(DATA.rows(NUMBER == 3), 0.5, np.random.default_rng(0))


def test_the_order_of_measurement_says_what_is_tested() -> None:
    first, second = DATA.rows(np.arange(60)), DATA.rows(np.arange(60, 100))
    assert transfer_of(first, second) == "a later time"
    assert transfer_of(second, first) == "an earlier time"
    assert transfer_of(*split(DATA, 0.4, np.random.default_rng(0))) == "other postures"
    assert transfer_of(first, first) == "another session"  # numbers start again
    assert transfer_of(first, replace(second, order=second.order + 100.0)) == "another session"  # a long pause
    assert transfer_of(first, replace(second, order=None)) == "other rows"


def test_a_file_taken_for_another_session_is_called_by_its_name() -> None:
    """Only its order numbers, which start again, tell that it is one; what follows in the order needs no name."""
    same, nothing = np.ones(40), np.zeros(40)
    there = HeldOut(same, same, Mean(1.0, 0.0, np.inf), nothing, 0.7, 2)
    first, fresh = DATA.rows(np.arange(60)), MappingProxyType({"file": "fresh.csv"})
    for rows, where in (np.arange(40), "fresh.csv"), (np.arange(60, 100), "a later time"):
        given = replace(DATA.rows(rows), provenance=fresh)
        assert confirmation_of(first, given, there, named=False).where == where
    unnamed = confirmation_of(first, DATA.rows(np.arange(40)), there, named=False)
    assert (unnamed.where, unnamed.to_json()["file"]) == ("another session", None)


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
