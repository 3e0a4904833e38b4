"""The test that confirms or refutes a named model by rows that were not used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from identification.arm import Arm
from identification.errors import InputError
from identification.estimation.uncertainty import GROUPS, Mean, groupings, mean_of
from identification.gap.confirmation import Confirmation, confirm, predicted_from_others, split
from identification.gap.fit import Rows
from identification.gap.hypotheses import hypotheses
from identification.gap.posterior import posterior_of
from identification.measurements import Measurements

SIGMA = 0.1  # per coordinate
RNG = np.random.default_rng(1)
NUMBER = np.repeat(np.arange(50), 2)
DATA = Measurements(
    RNG.uniform(-3.0, 3.0, (50, 3))[NUMBER],
    RNG.normal(size=(100, 2)),
    np.arange(100.0),
    temperature=20.0 + RNG.random(100),
)


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


@pytest.mark.parametrize(
    ("move", "sigma", "expected"), [(1.0, 0.0, False), (1.0, 0.1, False), (1.0, 10.0, None), (0.0, 0.0, None)]
)
def test_without_noise_any_two_models_differ_for_sure(move: float, sigma: float, expected: bool | None) -> None:
    """Eight rows where nothing is gained: refuted if the models differ there at all, else the rows do not tell."""
    before, after = np.tile([1.0, 0.0], (8, 1)), np.tile([np.cos(move), np.sin(move)], (8, 1))
    after *= np.array([0.5, 1.5] * 4)[:, None] / np.sqrt(1.25)  # more and less, on average the same
    found = confirm(before, after if move else before, Mean(1.0, 1.0, 7.0), sigma, (np.arange(8),), "other postures")
    assert found.shrinks is expected


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
    of_all, of_one, of_three = (groupings(postures[:m], np.arange(m), np.arange(m))[1] for m in (16, 1, 3))
    assert of_all.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7]
    assert (of_one.tolist(), of_three.max()) == ([0], 1)


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
    groups = groupings(rng.uniform(size=(m, 3)), np.arange(m), np.arange(m))
    return confirm(before, after, predicted, float(np.sqrt(variance)), groups, "other postures")


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
        groups = groupings(rng.uniform(size=(160, 3)), np.arange(160), np.arange(160))
        found = confirm(shared, shared, Mean(2.0 * SIGMA**2, 0.0, 7.0), SIGMA, groups, "other postures")
        refuted += found.confirmed is False
        naive += stats.ttest_1samp(squares, 2.0 * SIGMA**2, alternative="greater").pvalue <= 0.025
    assert refuted <= 12  # 2.5 % of 200 and 3 standard errors
    assert naive >= 40


def test_a_gap_that_shrinks_while_the_prediction_stays_open_is_said_so() -> None:
    """Twice the predicted square is left, in stretches of time that differ so much that it may be chance."""
    left = np.sqrt(np.repeat([0.2, 0.2, 6.0, 0.2, 0.3, 0.2, 8.0, 0.9], 20))
    after, before = np.column_stack([left, np.zeros(160)]), np.column_stack([left, np.full(160, np.sqrt(30.0))])
    groups = groupings(np.random.default_rng(7).uniform(size=(160, 3)), np.arange(160), np.arange(160))
    found = confirm(before, after, Mean(1.0, 1e-4, 100.0), 0.7, groups, "a later time")
    assert (found.confirmed, found.shrinks, found.as_predicted) == (True, True, None)
    few = "too few independent rows to say whether by as much as expected"
    assert found.answer == f"the error shrinks for a later time; {few}"
    assert replace(found, file="more.csv").answer == f"the error shrinks for more.csv; {few}"


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


def simulated(seed: int, sigma: np.ndarray, given: bool = False, ripple: float = 0.0) -> Measurements:
    """Rows of two links in complex numbers, with noise of these sizes (m,) [mm] and a wave in joint 2 [rad]."""
    generator, m = np.random.default_rng(seed), len(sigma)
    q = generator.uniform(-np.pi, np.pi, (m, 2))
    bent = q + np.column_stack([np.zeros(m), ripple * np.cos(5.0 * q[:, 1])])
    z = np.exp(1j * np.cumsum(bent, axis=1)) @ np.array([300.4, 199.7])
    noise = sigma[:, None] * generator.standard_normal((m, 2))
    return Measurements(q, np.column_stack([z.real, z.imag]) + noise, sigma=sigma if given else None)


def left_by_others(data: Measurements, folds: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    rows = Rows.of(data)
    found = posterior_of(hypotheses(Arm([300.0, 200.0]), frozenset(), rows), rows, np.random.default_rng(0))
    return predicted_from_others(found, np.ones(len(data), dtype=bool), folds)


def test_each_part_is_predicted_by_a_fit_to_the_others() -> None:
    """Positions are linear in the links as complex numbers, so least squares of some rows needs no start."""
    folds = np.arange(60) % 8
    data = simulated(1, np.full(60, SIGMA), ripple=0.001)
    links, measured = np.exp(1j * np.cumsum(data.postures, axis=1)), data.positions @ [1.0, 1.0j]
    base = np.hstack([links, 1j * links])
    before, after, _ = left_by_others(data, folds)
    lever = 1j * links[:, 1:]  # of the wave: a cos + b sin of the angle, times the lever of the joint
    wave = np.hstack([lever * np.cos(5.0 * data.postures[:, 1:]), lever * np.sin(5.0 * data.postures[:, 1:])])
    for columns, found, near in ((base, before, 1e-3), (np.hstack([base, wave]), after, 0.2)):
        real = np.concatenate([columns.real, columns.imag])
        target = np.concatenate([measured.real, measured.imag])
        for fold in range(8):
            test = np.tile(folds == fold, 2)
            left = target - real @ np.linalg.lstsq(real[~test], target[~test], rcond=None)[0]
            difference = found[folds == fold].T.ravel() - left[test]
            assert np.sqrt(np.mean(difference**2)) < near * SIGMA  # of the wave shrunk, and not the only explanation


@pytest.mark.parametrize("given", [False, True])
def test_what_is_left_is_what_was_expected(given: bool) -> None:
    """Noise that is alike, and noise that differs from row to row as `sigma_mm` says; 800 squares scatter by 5 %."""
    sigma = SIGMA * (np.exp(np.random.default_rng(2).normal(0.0, 0.8, 400)) if given else np.ones(400))
    _, after, expected = left_by_others(simulated(3, sigma, given), np.arange(400) % 8)
    assert expected == pytest.approx(2.0 * np.mean(sigma**2), rel=0.1)
    assert np.mean(np.sum(after**2, axis=1)) == pytest.approx(expected, rel=0.3 if given else 0.15)


def test_says_what_was_tested_and_what_failed() -> None:
    rng = np.random.default_rng(6)
    wrong = held_out(rng, 200, 2.0, present=0.0)
    assert str(wrong).startswith("does not hold for other postures, the gap does not shrink and the gap exceeds")
    assert wrong.to_json()["shrinks"] is False
    assert str(held_out(rng, 200, 2.0)).startswith("holds for other postures: ")
    assert str(held_out(rng, 1, 2.0)).startswith("too few rows to say whether it holds for other postures")


@pytest.mark.parametrize("share", [0.0, 1.0, -0.2, float("nan")])
def test_a_share_is_between_none_and_all(share: float) -> None:
    with pytest.raises(InputError, match="allowed: a share of the rows between 0 and 1"):
        split(DATA, share, np.random.default_rng(0))


def test_rows_of_one_posture_cannot_be_split() -> None:
    with pytest.raises(InputError, match="of one posture"):
        split(DATA.rows(NUMBER == 3), 0.5, np.random.default_rng(0))
