"""The test that confirms or refutes a named model by rows that were not used."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from identification import Arm, Measurements, Model
from identification.documents.diagnosis import holds_in_words
from identification.effects import EffectSpec
from identification.estimation.uncertainty import GROUPS, Mean, groups_of, mean_of
from identification.gap.average import as_fitted
from identification.gap.blocks import hypotheses
from identification.gap.confirmation import Confirmation, HeldOut, confirm, predicted_from_others
from identification.gap.fit import Fitted, Rows, fit
from identification.gap.search import posterior_of
from identification.kinematics.chain import KinematicChain
from identification.validate import placed
from tests.doe.six_axis import CHAIN, REFLECTOR

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
    values, other = np.random.default_rng(0).normal(0.3, 1.0, 80), np.random.default_rng(1).normal(0.0, 3.0, 40)
    groups, means = np.arange(80) % 8, values.reshape(10, 8).mean(axis=0)
    assert mean_of(values, (groups, np.arange(80) // 40)).freedom == 1.0  # two groups are less sure here
    mean = mean_of(values, (groups,))
    expected = stats.ttest_1samp(means, 0.0, alternative="greater")
    assert mean.p_above() == pytest.approx(expected.pvalue, rel=1e-12)
    welch = stats.ttest_ind(means, other.reshape(8, 5).mean(axis=0), equal_var=False, alternative="greater")
    assert (mean - mean_of(other, (np.arange(40) % 5,))).p_above() == pytest.approx(welch.pvalue, rel=1e-12)


@pytest.mark.parametrize(("move", "sigma", "expected"), [(1.0, 0.0, False), (1.0, 10.0, None), (0.0, 0.0, None)])
def test_without_noise_any_two_models_differ_for_sure(move: float, sigma: float, expected: bool | None) -> None:
    """Eight rows where nothing is gained: refuted if the models differ there at all, else the rows do not tell."""
    before, after = np.tile([1.0, 0.0], (8, 1)), np.tile([np.cos(move), np.sin(move)], (8, 1))
    after *= np.array([0.5, 1.5] * 4)[:, None] / np.sqrt(1.25)  # more and less, on average the same
    found = confirm(before, after if move else before, Mean(1.0, 1.0, 7.0), sigma, (np.arange(8),), "other postures")
    assert found.shrinks is expected


def test_groups_keep_repeats_together_and_are_of_equal_size() -> None:
    """In time and in space; of three reflectors of 41 postures one after the other no stretch begins between two."""
    rng, number = np.random.default_rng(3), np.repeat(np.arange(40), 3)
    time = rng.permutation(120).astype(float)
    postures = rng.uniform(-1.0, 1.0, (40, 4))[number]
    stretches, places = groups_of(Measurements(postures, np.zeros((120, 2)), repeats=number, order=time))
    assert np.bincount(stretches).tolist() == np.bincount(places).tolist() == [15] * GROUPS
    assert all(np.ptp(time[stretches == g]) == 14.0 for g in range(GROUPS))
    assert all(len(set(places[number == k])) == 1 for k in range(40))
    number = np.repeat(np.arange(41), 3)
    postures = rng.uniform(-1.0, 1.0, (41, 4))[number]
    stretches, _ = groups_of(Measurements(postures, np.zeros((123, 2)), repeats=number, order=np.arange(123.0)))
    assert all(len(set(stretches[number == k])) == 1 for k in range(41))
    assert np.bincount(stretches).tolist() == [18, 15, 15, 15, 15, 15, 15, 15]


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
    groups = groups_of(Measurements(rng.uniform(size=(m, 3)), np.zeros((m, 2))))
    return confirm(before, after, predicted, float(np.sqrt(variance)), groups, "other postures")


@pytest.mark.parametrize(
    ("answer", "least", "most", "drawn"),
    [  # refuted at 2.5 % on either side of two questions; 200 sets: fail beyond 0.05 + 2.5 standard errors
        (False, 0.0, 0.09, {"m": 200, "size": 1.0}),
        (True, 0.9, 1.0, {"m": 200, "size": 1.0}),
        (False, 0.0, 0.09, {"m": 20, "size": 1.0}),
        # it does not carry over
        (False, 0.95, 1.0, {"m": 200, "size": 1.0, "present": 0.0}),
        (True, 0.0, 0.0, {"m": 200, "size": 1.0, "present": 0.0}),
        (False, 0.9, 1.0, {"m": 200, "size": 1.0, "noise": 1.5}),  # something else is there as well
        # few rows neither confirm nor refute, even where nothing is named: they cannot show that nothing is missing
        (None, 0.9, 1.0, {"m": 6, "size": 0.5}),
        (None, 0.9, 1.0, {"m": 3, "size": 0.0}),
    ],
)
def test_a_right_name_is_confirmed_and_a_wrong_one_refuted(
    answer: bool | None, least: float, most: float, drawn: dict[str, float]
) -> None:
    rng = np.random.default_rng(20)
    assert least <= np.mean([held_out(rng, **drawn).confirmed is answer for _ in range(200)]) <= most  # type: ignore[arg-type]


def test_errors_shared_by_a_stretch_of_time_do_not_refute() -> None:
    """Eight stretches with an error each, known to be there: noise of 160 rows in groups of 20 counts as 8."""
    rng, refuted, naive = np.random.default_rng(5), 0, 0
    for _ in range(200):
        shared = np.repeat(SIGMA * rng.normal(size=(8, 2)), 20, axis=0)
        squares = np.square(shared).sum(axis=1)
        groups = groups_of(Measurements(rng.uniform(size=(160, 3)), np.zeros((160, 2))))
        found = confirm(shared, shared, Mean(2.0 * SIGMA**2, 0.0, 7.0), SIGMA, groups, "other postures")
        refuted += found.confirmed is False
        naive += stats.ttest_1samp(squares, 2.0 * SIGMA**2, alternative="greater").pvalue <= 0.025
    assert refuted <= 12  # 2.5 % of 200 and 3 standard errors
    assert naive >= 40


def test_a_gap_that_shrinks_while_the_prediction_stays_open_is_said_so() -> None:
    """Twice the predicted square is left, in stretches of time that differ so much that it may be chance."""
    left = np.sqrt(np.repeat([0.2, 0.2, 6.0, 0.2, 0.3, 0.2, 8.0, 0.9], 20))
    after, before = np.column_stack([left, np.zeros(160)]), np.column_stack([left, np.full(160, np.sqrt(30.0))])
    groups = groups_of(Measurements(np.random.default_rng(7).uniform(size=(160, 3)), np.zeros((160, 2))))
    found = confirm(before, after, Mean(1.0, 1e-4, 100.0), 0.7, groups, "a later time")
    assert (found.confirmed, found.shrinks, found.as_predicted) == (True, True, None)
    assert holds_in_words(found.to_json())[0] == "shrinks"


def simulated(seed: int, sigma: np.ndarray, given: bool = False, ripple: float = 0.0) -> Measurements:
    """Rows of two links in complex numbers, with noise of these sizes (m,) [mm] and a wave in joint 2 [rad]."""
    generator, m = np.random.default_rng(seed), len(sigma)
    q = generator.uniform(-np.pi, np.pi, (m, 2))
    bent = q + np.column_stack([np.zeros(m), ripple * np.cos(5.0 * q[:, 1])])
    z = np.exp(1j * np.cumsum(bent, axis=1)) @ np.array([300.4, 199.7])
    noise = sigma[:, None] * generator.standard_normal((m, 2))
    return Measurements(q, np.column_stack([z.real, z.imag]) + noise, sigma=sigma if given else None)


def left_by_others(data: Measurements, folds: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """With waves alone in the library: nothing else of it, such as a transient in the first rows, is an explanation."""
    rows = Rows.of(data)
    library = hypotheses(Arm([300.0, 200.0]), frozenset(), rows)
    waves = tuple(block for block in library.members if block.label.startswith("transmission_ripple"))
    found = posterior_of(replace(library, members=waves), rows, np.random.default_rng(0))
    return next(predicted_from_others(found, np.ones(len(data), dtype=bool), [folds]))


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


# -- another set-up: points moved in plain numpy -----------------------------------------------------------------------
NOISE, TURNS = 0.1, [Rotation.from_euler("z", 2.0), Rotation.from_rotvec([0.2, -1.1, 0.5])]
CELL, SHIFT = replace(CHAIN, tools={"A": np.zeros(3), "B": REFLECTOR}), np.array([300.0, -80.0, 40.0])
OTHER = np.array([25.0, -60.0, 10.0])  # from one point to the other, in the tip's frame


def set_up(seed: int, moved: str, chain: KinematicChain, rows: int = 60) -> Measurements:
    """Rows of points A and B in turns, measured from another place, and these points moved."""
    generator, d = np.random.default_rng(seed), chain.dimension
    q, markers = generator.uniform(-2.0, 2.0, (rows, len(chain))), np.tile(["A", "B"], rows // 2)
    tips, points = chain.tip_frames(q), np.zeros((rows, 3))
    if d == 3:
        points = np.array([chain.tools[name][:3, 3] + OTHER * (name in moved) for name in markers.tolist()])
    at = tips[:, :3, 3] + np.einsum("mij,mj->mi", tips[:, :3, :3], points)
    measured = TURNS[d - 2].apply(at)[:, :d] + SHIFT[:d] + NOISE * generator.standard_normal((rows, d))
    return Measurements(q, measured, **({"marker": markers} if d == 3 else {}))


def left_again(data: Measurements, chain: KinematicChain) -> tuple[np.ndarray, tuple[str, ...]]:
    """(m, d) residuals of the arm as drawn, and what was fitted."""
    model = Model(Arm(chain))
    seen, one = HeldOut(data, data.conditions, "other rows", True), Fitted(model, model.values, Rows.of(data))
    return seen.residuals(one, one)[1:]


@pytest.mark.parametrize(
    ("moved", "chain", "count"), [("", CELL, 12), ("AB", CELL, 12), ("B", CELL, 12), ("", Arm([200.0, 100.0]).chain, 3)]
)
def test_nothing_but_noise_is_left_of_another_set_up(moved: str, chain: KinematicChain, count: int) -> None:
    data = set_up(1, moved, chain)
    left, words = left_again(data, chain)
    # of 120 coordinates or more: 6 % is the standard deviation of such an estimate; the values fitted cost nothing
    assert np.sqrt(np.mean(left**2)) == pytest.approx(NOISE, rel=0.15)
    assert words == ("base", "reflector A", "reflector B")[: 3 if chain is CELL else 1]
    assert placed(Arm(chain), data, data.conditions)[3] == count


def test_residuals_do_not_shrink_by_what_is_fitted() -> None:
    """Fits of 6 + 6 values to 72 coordinates take a part of the noise, which is given back: on average over 40 sets
    the mean square is that of the noise, to 3 of its standard deviations, half of what the shrinking would take."""
    means = [float(np.mean(left_again(set_up(seed, "A", CELL, 24), CELL)[0] ** 2)) for seed in range(40)]
    assert np.mean(means) == pytest.approx(NOISE**2, abs=3.0 * NOISE**2 * np.sqrt(2.0 / (72 - 12) / 40))


def test_held_out_rows_are_tested_against_the_given_sigma() -> None:
    """Errors of the parameters, of twelve rows, add a sixth to the square of the noise. Of 200 sets those in which more
    is seen, at 5 %, stay within 3 standard errors (without that sixth a third is); noise of 1.6 sigma always is."""
    arm, every, beyond = Arm([200.0, 100.0], sigma=SIGMA), np.ones(12, dtype=bool), list[bool]()
    for seed in range(220):
        rng = np.random.default_rng(seed)
        q, noise = rng.uniform(-3.0, 3.0, (162, 2)), SIGMA * rng.normal(size=(162, 2))
        noise[12:] *= 1.0 if seed < 200 else 1.6
        rows = Measurements(q, Model(arm).position(q) + noise)
        data, fresh = rows.rows(np.arange(12)), rows.rows(np.arange(12, 162))
        base = as_fitted(fit(Model(arm), Rows.of(data)))
        beyond.append(HeldOut.of(fresh, data).test(base, base, data, every, False, 1.0).beyond_sigma)
    assert np.mean(beyond[:200]) < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / 200)
    assert all(beyond[200:])


@pytest.mark.parametrize("times", [0.4, 3.0])
def test_held_out_rows_of_another_sigma_are_predicted_with_it(times: float) -> None:
    """Of 40 sets of 60 rows and 150: the mean scatters by 3 %; data that are below their sigma by chance cost 5 %."""
    arm, ratios, refuted = Arm([200.0, 100.0], sigma=SIGMA), list[float](), 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        q, noise = rng.uniform(-3.0, 3.0, (210, 2)), SIGMA * rng.normal(size=(210, 2))
        noise[60:] *= times
        rows = Measurements(q, Model(arm).position(q) + noise)
        data, fresh = (
            rows.rows(np.arange(60)),
            replace(rows.rows(np.arange(60, 210)), sigma=np.full(150, times * SIGMA)),
        )
        base = as_fitted(fit(Model(arm), Rows.of(data)))
        tested = HeldOut.of(fresh, data).test(base, base, data, np.ones(60, dtype=bool), False, 1.0)
        ratios.append((tested.after_mm / tested.predicted_mm) ** 2)
        refuted += tested.as_predicted is False
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)
    assert refuted <= 4  # of 40 at 2.5 %: more than four with probability 0.003


def test_points_have_the_numbers_of_the_data() -> None:
    q = np.random.default_rng(4).uniform(-1.0, 1.0, (4, 6))

    def of(*names: str) -> Measurements:
        return Measurements(q, q[:, :3], marker=np.array(names) if names else None)

    several, one = of("A", "B", "C", "A"), of(*"AAAA")
    for held, data, numbers in ((of("C", "D", "B", "C"), several, [2.0, 0.0, 1.0, 2.0]), (of(*"DDDD"), one, [0.0] * 4)):
        seen = HeldOut.of(held, data)
        assert (seen.conditions.marker.tolist(), seen.elsewhere) == (numbers, True)
    assert HeldOut.of(of(), several).conditions.marker.tolist() == [0.0] * 4


def test_the_order_of_measurement_says_what_is_tested() -> None:
    """Time goes on within a session and starts again in another; temperatures are on the scale of the data."""
    first, second, numbers = DATA.rows(np.arange(51)), DATA.rows(np.arange(51, 100)), np.arange(100)
    for rows, data, transfer in (
        (second, first, "a later time"),
        (first, second, "an earlier time"),
        (DATA.rows(numbers[1::2]), DATA.rows(numbers[::2]), "other postures"),
        (first, first, "another session"),  # numbers start again
        (replace(second, order=second.order + 100.0), first, "another session"),  # a long pause
        (replace(second, order=None), first, "other rows"),
        (replace(second, session=np.full(49, "b")), first, "another session"),  # so it is called
    ):
        assert HeldOut.of(rows, data).transfer == transfer
    later = HeldOut.of(second, first).conditions
    np.testing.assert_allclose(later.time, np.arange(51, 100) / 50.0 - 0.5)
    np.testing.assert_allclose(later.temperature, second.temperature - first.temperature.mean())
    apart = HeldOut.of(replace(second, order=np.arange(49.0)), first).conditions.time
    np.testing.assert_allclose(apart, np.linspace(-0.5, 0.5, 49))


def test_what_happened_once_is_over_in_another_session() -> None:
    """A zero that jumps in the middle of the data stays where it is then, whatever the times of other rows are."""
    arm = Arm([200.0, 100.0], effects=(EffectSpec("joint_step", 1, {"at": 0.0, "b": 0.02}),))
    q = np.random.default_rng(5).uniform(-3.0, 3.0, (60, 2))
    model = Model(replace(arm, effects=(EffectSpec("joint_step", 1, {"at": 0.0}),)))
    every = Measurements(q, Model(arm).position(q, None, Measurements(q, q).conditions), np.arange(60.0))
    data, rows = every.rows(np.arange(0, 60, 2)), every.rows(np.arange(1, 60, 2))
    base = fit(model, Rows.of(data))
    later = replace(rows, positions=Model(arm).position(rows.postures, None, rows.conditions.afterwards(30)))
    called = replace(later, session=np.full(30, "b"))
    for held in (rows, every, called, replace(later, order=later.order + 200.0)):  # of `every` numbers start again
        seen = HeldOut.of(held, data)
        assert np.abs(seen.residuals(base, base)[1]).max() < 1e-6, seen.transfer
    for held in (replace(rows, order=None), replace(later, order=None), replace(later, order=data.order)):
        tested = HeldOut.of(held, data).test(base, as_fitted(base), data, np.ones(30, dtype=bool), False, 1.0)
        assert tested.after_mm < 1e-6, tested.transfer
