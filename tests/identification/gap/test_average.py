"""The averaged model against draws from the posterior, in which every explanation is a dense regression of all rows;
and names of curves."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification import Arm, Array, EffectSpec, Gravity, Measurements, Model
from identification.arm import ErrorCurve
from identification.gap.average import averaged, shape_and_waves
from identification.gap.blocks import around, hypotheses, measured_range
from identification.gap.fit import Rows, fit
from identification.gap.likelihood import SIZES, Key
from identification.gap.search import Explanation, Posterior, posterior_of
from identification.information import conditional_covariance

ARM = Arm([300.0, 200.0], sigma=0.05)
SETS = (("encoder_eccentricity:2",), ("gear_ratio:2", "curve:1"), ("encoder_eccentricity:2", "curve:2"))
SHARES = (0.6, 0.25, 0.15)


def three_sets() -> Posterior:
    """Three sets of blocks, two of which have one that an arm file cannot have or that is a curve; white noise."""
    rng = np.random.default_rng(3)
    model, q = Model(ARM.with_effects(EffectSpec("encoder_eccentricity", 2))), rng.uniform(-2.0, 2.0, (50, 2))
    exact = model.position(q, np.r_[np.zeros(4), 8e-4, 8e-4])
    rows = Rows.of(Measurements(q, exact + 0.05 * rng.normal(size=(50, 2))))
    return in_sets(posterior_of(hypotheses(ARM, frozenset(), rows), rows, rng), SETS, SHARES)


def in_sets(walked: Posterior, sets: Sequence[tuple[str, ...]], shares: Sequence[float]) -> Posterior:
    """These sets of blocks alone, the first of which are the smallest, in white noise."""
    problem, explanations, draws = walked.whole, [], Counter[Key]()
    for labels, share in zip(sets, shares, strict=True):
        blocks = sorted(problem.numbers[label] for label in labels)
        key = tuple((b, 2 + k) for k, b in enumerate(blocks))
        explanations.append(Explanation(tuple(problem.blocks[b] for b in blocks), key, 0, share))
        draws[key] = round(100 * share)
    alone = {"problems": (problem,), "noises": walked.noises[:1], "draws": (draws,)}
    return replace(walked, explanations=tuple(explanations), **alone)


def test_beside_an_unknown_all_is_named_that_is_likelier_than_not() -> None:
    """By sums over sets of random probabilities, of those alone with a curve; here the settings of one ripple exclude
    each other. The likeliest set, of which this once was all and nothing else, is one of thousands on a real robot."""
    walked, rng = three_sets(), np.random.default_rng(5)
    tones = [label for label in walked.whole.numbers if label.startswith("transmission_ripple:1[")][:2]
    plain = ((), ("encoder_eccentricity:2",), ("gear_ratio:2",), ("encoder_eccentricity:2", "gear_ratio:2"))
    known = [(*some, *tone) for some in plain for tone in ((), tones[:1], tones[1:])]
    assert in_sets(walked, known, [1.0 / 12.0] * 12).beside_unknown is None
    sets = [*known, *((*some, "curve:1") for some in known)]
    for _ in range(50):
        shares = rng.dirichlet(np.full(24, 0.3)).tolist()
        chance = {
            label: sum(p for one, p in zip(sets[12:], shares[12:], strict=True) if label in one)
            for label in sum(sets, ())
        }
        half = 0.5 * chance["curve:1"]
        expected = {label for label, p in chance.items() if p > half and label not in tones}
        if sum(chance[tone] for tone in tones) > half:
            expected.add(max(tones, key=chance.__getitem__))
        found = in_sets(walked, sets, shares).beside_unknown
        assert found is not None
        assert {b.label for b in found.blocks} == expected


def regressed(given: Posterior, one: Explanation, base: Array, target: Array) -> tuple[Array, Array, list[Array]]:
    """Mean and covariance of base parameters and blocks' parameters under one explanation, by dense algebra."""
    problem, b = given.whole, [k for k, _ in one.key]
    roots = [problem.roots[k] for k in b]
    columns = [given.at.rows.whiten(problem.columns[k]) @ root for k, root in zip(b, roots, strict=True)]
    sizes = np.repeat(SIZES[[size for _, size in one.key]], [root.shape[1] for root in roots])
    wide, g = np.concatenate([base, *columns], axis=1), base.shape[1]
    inverse = np.linalg.inv(wide.T @ wide + np.diag(np.concatenate([np.zeros(g), sizes**-2.0])))
    mean = inverse @ (wide.T @ target)
    penalty = float(np.sum((mean[g:] / sizes) ** 2))
    return mean, inverse * ((float(np.sum((target - wide @ mean) ** 2)) + penalty) / (len(target) - g)), roots


def test_the_expected_square_error_is_that_of_draws() -> None:
    """Of the written model at the postures measured: 20,000 draws, and what its file says.

    A mean over 50 postures of mean squares of n draws of nearly normal errors is off by less than five times
    sqrt(2 / n), 5 %.
    """
    given = three_sets()
    rng, problem, rows = np.random.default_rng(1), given.whole, given.at.rows
    (left, own), jacobian = given.library.as_base(given.at), given.at.linearized[1]
    base, target = rows.whiten(jacobian[:, :, own]), rows.whiten(left)
    errors, count = [], 20000
    for one in given.explanations:
        mean, covariance, roots = regressed(given, one, base, target)
        drawn = rng.multivariate_normal(mean, covariance, round(count * one.probability))
        columns = [problem.columns[k] @ root for k, root in zip([k for k, _ in one.key], roots, strict=True)]
        errors.append(drawn @ np.concatenate([jacobian[:, :, own], *columns], axis=2).reshape(100, -1).T)
    true = np.concatenate(errors)  # of the tips, beside the base where it was linearized

    written, _, _ = averaged(given, rows.positions.size)
    drawing = rows.positions - left
    off = (written.model.position(rows.postures, written.values, rows.conditions) - drawing).ravel()
    columns = written.linearized[1]
    expected = float(np.sum((columns @ written.covariance) * columns)) / len(rows)
    assert 2.0 * float(np.mean((true - off) ** 2)) == pytest.approx(expected, rel=0.05)


def test_beyond_the_angles_of_a_curve_the_geometry_holds_that_was_fitted_alone() -> None:
    """Whatever depends on the curve's angle alone is off with it: an eccentricity and a curve that are together small
    at the angles measured, whatever each of them is, would add up elsewhere."""
    given = three_sets()
    one = given.explanations[2]
    assert [block.label for block in one.blocks] == list(SETS[2])
    alone = replace(given, explanations=(replace(one, probability=1.0),), draws=(Counter([one.key]),))
    (written, _, _), plain = averaged(alone, given.at.rows.positions.size), fit(Model(ARM), given.at.rows)
    beyond = np.array([[0.3, 2.9], [-1.0, -3.0], [1.5, 3.1]])
    left = written.model.position(beyond, written.values) - plain.model.position(beyond, plain.values)
    assert float(np.abs(left).max()) < 1e-3  # [mm]; of second order in an eccentricity of 0.3 mm at the tip
    assert [spec.key for spec in written.specs] == ["joint_error_curve:2"]


def test_rounding_in_what_hardly_varies_is_not_amplified() -> None:
    rng, kept = np.random.default_rng(0), np.arange(3)
    root = rng.normal(size=(40, 12))  # 37 known ones that vary in 12 ways
    sizes = 10.0 ** rng.uniform(-6.0, 0.0, 40)
    covariance = (root @ root.T + 1e-12 * rng.normal(size=(40, 40))) * np.outer(sizes, sizes)
    scale = np.outer(sizes[kept], sizes[kept])
    beside = conditional_covariance(covariance, kept, np.arange(3, 40)) / scale
    np.testing.assert_allclose(beside, 0.0, atol=1e-9)  # all are known then
    few, known = (root @ root.T)[:9, :9], np.arange(3, 9)
    expected = few[:3, :3] - few[:3, 3:] @ np.linalg.inv(few[3:, 3:]) @ few[3:, :3]
    np.testing.assert_allclose(conditional_covariance(covariance, kept, known) / scale, expected, rtol=1e-6)
    np.testing.assert_allclose(conditional_covariance(covariance, kept, known[:0]) / scale, few[:3, :3], atol=1e-11)
    # what is left of a parameter that never varies, rounding alone, is neither a variance nor a covariance
    covariance[:2, :2] = [[-1e-29, 2e-24], [2e-24, 1.0]]
    np.testing.assert_array_equal(conditional_covariance(covariance, kept, known[:0])[0], 0.0)


# -- names of curves ---------------------------------------------------------------------------------------------------
ANGLES = np.linspace(-np.pi, np.pi, 361)
BUMP = 1e-4 * np.exp(-0.5 * (ANGLES / 0.1) ** 2)


def test_waves_with_amplitude_and_phase() -> None:
    error, std = 3e-4 * np.cos(17.0 * ANGLES - 0.7) + 1e-4 * np.cos(3.0 * ANGLES + 2.0) + 5e-4, np.full(361, 1e-5)
    text, waves = shape_and_waves(ANGLES, error, std)
    for wave, expected in zip(waves, ((17.0, 3e-4, 0.7), (3.0, 1e-4, -2.0)), strict=True):
        assert (wave["order"], *np.radians([wave["amplitude_deg"], wave["phase_deg"]])) == pytest.approx(expected)
    assert waves[0]["share"] == pytest.approx(0.9, abs=0.01)
    assert text.startswith("waves: 17 (16.5 to 17.5) per turn, 0.017 deg; 3 (")
    # a narrow range says which orders fit
    q = np.radians(np.linspace(0.0, 60.0, 121))
    _, (wave,) = shape_and_waves(q, 1e-4 * np.sin(21.0 * q), std[:121])
    assert (wave["order"], *wave["orders"]) == pytest.approx((21.0, 18.0, 24.0))
    for error, shape in ((np.zeros(361), "smooth curve over -180 to 180 deg"), (BUMP, "in part waves: ")):
        text, waves = shape_and_waves(ANGLES, error, std)
        assert text.startswith(shape)
        assert bool(waves) == bool(error.any())


# -- tables of curves --------------------------------------------------------------------------------------------------
def test_a_table_goes_through_its_values_and_straight_across_a_gap() -> None:
    """Two waves that cancel where the joint was measured, but for 2 %, and add up in a gap of 0.8 rad."""
    q = np.linspace(-2.0, 2.0, 961)
    function = 0.02 * np.cos(11.0 * q) + np.where(np.abs(q) < 0.4, 2.0 * np.cos(3.0 * q), 0.0)
    seen = np.abs(q) >= 0.4
    table = ErrorCurve.through(-2.0, 2.0, q[seen], 1e-3 * function[seen], 121, {})
    off = np.abs(table.at(q[seen]) - 1e-3 * function[seen])
    assert off[24:-24].max() < 2e-7  # a hundredth; within three nodes of the ends a spline that ends at zero bends
    assert off.max() < 2e-6
    assert float(np.abs(table.at(q[~seen])).max()) < 2.1e-5  # straight between the edges of the gap, where 2e-3 add up


@given(st.lists(st.integers(-62, 62).map(lambda k: k / 10.0), min_size=2, max_size=20, unique=True))
def test_measured_angles_are_in_their_range(angles: list[float]) -> None:
    start, stop = measured_range(np.array(angles))
    assert start in angles
    assert np.all(around(np.array(angles), start, stop) <= stop + 1e-9)
    assert stop - start <= np.ptp(angles) + 1e-9


def test_a_range_begins_after_the_hole() -> None:
    angles = np.radians([-179.0, -174.0, 3.0, 60.0, 130.0, 179.0])
    np.testing.assert_allclose(np.degrees(measured_range(angles)), [3.0, 186.0])
    # an angle that is the first one but for a turn and rounding is there, and none is taken from end to end
    ends = np.array([angles[2] - 2.0 * np.pi - 4e-16, angles[2] - 4e-16, angles[0], angles[5]])
    np.testing.assert_allclose(around(ends, *measured_range(angles)), np.radians([3.0, 3.0, 181.0, 179.0]))
    np.testing.assert_array_equal(around(np.array([-np.pi, np.pi]), -np.pi, np.pi), [-np.pi, np.pi])
    assert measured_range(angles[:3]) == (angles[0], angles[2])  # the gap outside is wider
    assert measured_range(np.array([np.nextafter(-0.3, 0.0), -0.3, 1.0])) == (-0.3, 1.0)  # alike around the circle


def test_what_physics_bounds_is_held_there_and_all_else_gives_way() -> None:
    """A joint that the rows would have stiffer than rigid, against the dense regression without it."""
    arm = replace(ARM, gravity=Gravity((0.0, -9.81), [2.0, 1.0], [0.5, 0.5]))
    rng, both = np.random.default_rng(0), (EffectSpec("joint_compliance", 1), EffectSpec("encoder_eccentricity", 2))
    q = rng.uniform(-2.0, 2.0, (50, 2))
    exact = Model(arm.with_effects(*both)).position(q, np.r_[np.zeros(4), -1e-4, 8e-4, 8e-4])
    rows = Rows.of(Measurements(q, exact + 0.05 * rng.normal(size=(50, 2))))
    labels = "joint_compliance:1", "encoder_eccentricity:2"
    given = in_sets(posterior_of(hypotheses(arm, frozenset(), rows), rows, rng), [labels], [1.0])
    (one,), number = given.explanations, given.whole.numbers[labels[1]]
    written, _, _ = averaged(given, rows.positions.size)
    (left, own), jacobian = given.library.as_base(given.at), given.at.linearized[1]
    base, target = rows.whiten(jacobian[:, :, own]), rows.whiten(left)
    less = replace(one, key=tuple(pair for pair in one.key if pair[0] == number))
    mean, _, (root,) = regressed(given, less, base, target)
    off = np.concatenate([jacobian[:, :, own], given.whole.columns[number] @ root], axis=2) @ mean
    assert written.by_name["joint_compliance:1.c"] == 0.0
    np.testing.assert_allclose(written.errors, left - off, rtol=0.0, atol=2e-3)  # second order: 500 mm (2e-3 rad)^2


def test_an_average_far_from_the_fit_is_linearized_again() -> None:
    given = three_sets()
    near, _, _ = averaged(given, given.at.rows.positions.size)
    values = given.at.values.copy()
    values[given.library.as_base(given.at)[1]] += [30.0, -20.0, 0.05, -0.1]  # [mm], [rad]
    far, bend, _ = averaged(given.about(replace(given.at, values=values)), given.at.rows.positions.size)
    assert float(np.abs(bend).max()) < 0.01
    np.testing.assert_allclose(far.errors, near.errors, rtol=0.0, atol=0.01)  # a fifth of the noise
