"""The test that confirms or refutes a named model by rows that were not used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from identification.gap.confirmation.confirmation import (
    GROUPS,
    Confirmation,
    HeldOut,
    Mean,
    confirm,
    groupings,
    mean_of,
    regions,
    shrinks,
)

SIGMA = 0.1  # per coordinate


def test_group_means_are_compared_by_students_t() -> None:
    values = np.random.default_rng(0).normal(0.3, 1.0, 80)
    groups = np.arange(80) % 8
    found = mean_of(values, (groups, np.arange(80) // 40))
    assert found.freedom == 1.0  # two groups are less sure here
    found = mean_of(values, (groups,))
    expected = stats.ttest_1samp([values[groups == g].mean() for g in range(8)], 0.0, alternative="greater")
    assert found.p_above() == pytest.approx(expected.pvalue, rel=1e-12)
    other = np.random.default_rng(1).normal(0.0, 3.0, 40)
    difference = found - mean_of(other, (np.arange(40) % 5,))
    welch = stats.ttest_ind(
        [values[groups == g].mean() for g in range(8)],
        [other[np.arange(40) % 5 == g].mean() for g in range(5)],
        equal_var=False,
        alternative="greater",
    )
    assert difference.p_above() == pytest.approx(welch.pvalue, rel=1e-12)


def test_one_group_tells_nothing() -> None:
    alone = mean_of(np.ones(3), (np.zeros(3, dtype=np.int64),))
    assert alone.p_above() == 1.0
    assert not alone.detects(1e9)
    assert (Mean(1.0, 0.1, 5.0) - alone).p_above() == 1.0


def test_without_noise_any_two_models_differ_for_sure() -> None:
    """Eight rows where nothing is gained: refuted if the models differ there at all, else the rows do not tell."""
    gained, zero, one = Mean(0.0, 1.0, 7.0), np.zeros(8), np.ones(8)
    for moved, sigma, expected in ((one, 0.0, False), (zero, 0.0, None), (zero, 1.0, None), (one, 0.1, False)):
        assert shrinks(gained, HeldOut(one, one, gained, moved, sigma, 2), 0.05) is expected
    assert shrinks(gained, HeldOut(one, one, gained, one, 10.0, 2), 0.05) is None


def test_groups_keep_repeats_together_and_are_of_equal_size() -> None:
    rng = np.random.default_rng(3)
    number = np.repeat(np.arange(40), 3)
    postures = rng.uniform(-1.0, 1.0, (40, 4))[number]
    time = rng.permutation(120).astype(float)
    stretches, places = groupings(postures, number, time)
    assert np.bincount(stretches).tolist() == [15] * GROUPS
    assert np.bincount(places).tolist() == [15] * GROUPS
    assert all(np.ptp(time[stretches == g]) == 14.0 for g in range(GROUPS))
    assert all(len(set(places[number == k])) == 1 for k in range(40))


def test_a_stretch_of_time_ends_with_a_posture() -> None:
    """Three reflectors of 41 postures one after the other: no stretch begins between two of them."""
    rng, number = np.random.default_rng(4), np.repeat(np.arange(41), 3)
    stretches, _ = groupings(rng.uniform(-1.0, 1.0, (41, 4))[number], number, np.arange(123.0))
    assert all(len(set(stretches[number == k])) == 1 for k in range(41))
    assert np.bincount(stretches).tolist() == [18, 15, 15, 15, 15, 15, 15, 15]


def test_regions_are_cut_at_the_median_of_the_joint_that_moves_most() -> None:
    postures = np.column_stack([np.arange(16.0), 0.1 * np.arange(16.0) % 0.4])
    assert regions(postures).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7]
    assert regions(postures[:1]).tolist() == [0]
    assert regions(postures[:3]).max() == 1


def held_out(rng: np.random.Generator, m: int, size: float, present: float = 1.0, noise: float = 1.0) -> Confirmation:
    """m fresh rows; the named model moves the tip by `size` sigma (RMS) where the truth moves it by `present` as much.

    noise : of the hold-out over what it was in the data
    """
    error = noise * SIGMA * rng.normal(size=(m, 2))
    move = rng.normal(size=(m, 2)) * size * SIGMA / np.sqrt(2.0)
    before, after = error + present * move, error + (present - 1.0) * move
    # from 100 coordinates of the data, with parameters that add 8 %
    variance = SIGMA**2 * rng.chisquare(100) / 100
    after = after + SIGMA * np.sqrt(0.08) * rng.normal(size=2)
    predicted = Mean(2.0 * 1.08 * variance, (2.0 * variance) ** 2 * 2.0 / 100, 7.0)
    squares = (np.square(a).sum(axis=1) for a in (before, after, move))
    b, a, moved = squares
    rows = HeldOut(b, a, predicted, moved, float(np.sqrt(variance)), 2)
    return confirm(rows, groupings(rng.uniform(size=(m, 3)), np.arange(m), np.arange(m)), "other postures")


def share(answer: bool | None, sets: int = 200, **drawn: float) -> float:
    rng = np.random.default_rng(20)
    return float(np.mean([held_out(rng, **drawn).confirmed is answer for _ in range(sets)]))  # type: ignore[arg-type]


def test_a_right_name_is_confirmed_and_rarely_refuted() -> None:
    # refuted at 2.5 % on either side of two questions; 200 sets: fail beyond 0.05 + 2.5 standard errors
    assert share(False, m=200, size=1.0) <= 0.09
    assert share(True, m=200, size=1.0) >= 0.9
    assert share(False, m=20, size=1.0) <= 0.09


def test_a_name_that_does_not_carry_over_is_refuted() -> None:
    assert share(False, m=200, size=1.0, present=0.0) >= 0.95
    assert share(False, m=200, size=1.0, noise=1.5) >= 0.9  # something else is there as well
    assert share(True, m=200, size=1.0, present=0.0) == 0.0


def test_few_rows_neither_confirm_nor_refute() -> None:
    assert share(None, m=6, size=0.5) >= 0.9
    assert share(None, m=1, size=3.0) >= 0.9
    assert share(None, m=3, size=0.0) >= 0.9  # nothing named: three rows cannot show that nothing is missing either


def test_errors_shared_by_a_stretch_of_time_do_not_refute() -> None:
    """Eight stretches with an error each, known to be there: noise of 160 rows in groups of 20 counts as 8."""
    rng, refuted, naive = np.random.default_rng(5), 0, 0
    for _ in range(200):
        shared = np.repeat(SIGMA * rng.normal(size=(8, 2)), 20, axis=0)
        squares = np.square(shared).sum(axis=1)
        rows = HeldOut(squares, squares, Mean(2.0 * SIGMA**2, 0.0, 7.0), np.zeros(160), SIGMA, 2)
        found = confirm(rows, groupings(rng.uniform(size=(160, 3)), np.arange(160), np.arange(160)), "other postures")
        refuted += found.confirmed is False
        naive += stats.ttest_1samp(squares, 2.0 * SIGMA**2, alternative="greater").pvalue <= 0.025
    assert refuted <= 12  # 2.5 % of 200 and 3 standard errors
    assert naive >= 40


def test_says_what_was_tested_and_what_failed() -> None:
    rng = np.random.default_rng(6)
    wrong = held_out(rng, 200, 2.0, present=0.0)
    assert str(wrong).startswith("does not hold for other postures, the gap does not shrink and the gap exceeds")
    assert wrong.to_json()["shrinks"] is False
    assert str(held_out(rng, 200, 2.0)).startswith("holds for other postures: ")
    assert str(held_out(rng, 1, 2.0)).startswith("too few rows to say whether it holds for other postures")


def test_a_gap_that_shrinks_while_the_prediction_stays_open_is_said_so() -> None:
    """Twice the predicted square is left, in stretches of time that differ so much that it may be chance."""
    left = np.repeat([0.2, 0.2, 6.0, 0.2, 0.3, 0.2, 8.0, 0.9], 20)
    rows = HeldOut(left + 30.0, left, Mean(1.0, 1e-4, 100.0), np.full(160, 30.0), 0.7, 2)
    found = confirm(
        rows, groupings(np.random.default_rng(7).uniform(size=(160, 3)), np.arange(160), np.arange(160)), "a later time"
    )
    assert (found.confirmed, found.shrinks, found.as_predicted) == (True, True, None)
    few = "too few independent rows to say whether by as much as expected"
    assert found.answer == f"the error shrinks for a later time; {few}"
    assert replace(found, file="more.csv").answer == f"the error shrinks for more.csv; {few}"
