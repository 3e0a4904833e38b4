"""Some parameters anew against least squares with the other columns deleted; an earlier calibration as the prior
against the joint fit of both data sets, written with numpy for models that are linear."""

from dataclasses import replace

import numpy as np
import pytest

from identification import Arm, Calibration, DHRow, EffectSpec, InputError, Measurements, Model, chain_of, estimate
from identification.estimation.problem import Prior
from identification.reuse import earlier, only, with_base_doubt, with_held

LENGTHS, SIGMA = np.array([260.0, 180.0, 120.0]), 0.1
OFFSETS = np.array([0.01, -0.02, 0.015])
FIXED = Calibration.of(np.zeros(3), OFFSETS)
ARM = Arm(LENGTHS, sigma=SIGMA, calibration=FIXED, effects=(EffectSpec("base_offset"),))
HALF = np.pi / 2.0
CHAIN = chain_of([DHRow(0.0, HALF, 300.0), DHRow(-400.0, 0.0, 0.0), DHRow(80.0, -HALF, 90.0), DHRow(60.0, 0.3, 50.0)])


def columns(q: np.ndarray) -> np.ndarray:
    """(2 m, 3) derivatives of the tip by the lengths."""
    theta = np.cumsum(q + OFFSETS, axis=1)
    return np.stack([np.cos(theta), np.sin(theta)], axis=1).reshape(-1, 3)


def session(seed: int, m: int, shift: tuple[float, float]) -> tuple[Measurements, np.ndarray]:
    """Measurements of an arm that stands elsewhere, and what they have beyond the drawing (2 m,)."""
    generator = np.random.default_rng(seed)
    q = generator.uniform(-2.0, 2.0, (m, 3))
    beyond = columns(q) @ [0.4, -0.3, 0.2] + np.tile(shift, m) + SIGMA * generator.standard_normal(2 * m)
    return Measurements(q, (columns(q) @ LENGTHS + beyond).reshape(m, 2)), beyond


def test_only_is_least_squares_without_the_other_columns() -> None:
    data, beyond = session(1, 20, (0.0, 0.0))
    found = estimate(only(ARM, ["lengths"]), data, sigma="given")
    design = columns(data.postures)
    expected = np.linalg.lstsq(design, beyond, rcond=None)[0]
    assert found.names == ("length_error:1", "length_error:2", "length_error:3")
    np.testing.assert_allclose(found.parameters, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.covariance, SIGMA**2 * np.linalg.inv(design.T @ design), rtol=1e-6)
    np.testing.assert_allclose(found.joint_offsets, OFFSETS)
    two = estimate(only(ARM, ["length_error:1", "base_offset"]), data, sigma="given")
    design = np.column_stack([design[:, 0], np.tile(np.eye(2), (20, 1))])
    np.testing.assert_allclose(two.parameters, np.linalg.lstsq(design, beyond, rcond=None)[0], rtol=0, atol=1e-9)


def test_what_is_held_may_be_off() -> None:
    """Length 1 held with a deviation of 0.3 mm moves the others by what its column is of theirs, as new data would."""
    data, _ = session(1, 20, (0.0, 0.0))
    before = Calibration({**FIXED.values, "length_error:1": 0.4}, ("length_error:1",), np.array([[0.09]]))
    found = estimate(only(replace(ARM, calibration=before), ["length_error:2", "length_error:3"]), data, sigma="given")
    whole, design = with_held(found, before, data), columns(data.postures)
    spread = np.r_[1.0, -np.linalg.pinv(design[:, 1:]) @ design[:, 0]]
    expected = 0.09 * np.outer(spread, spread)
    expected[1:, 1:] += SIGMA**2 * np.linalg.inv(design[:, 1:].T @ design[:, 1:])
    assert whole.names == ("length_error:1", "length_error:2", "length_error:3")
    np.testing.assert_allclose(whole.covariance, expected, rtol=1e-6)
    np.testing.assert_array_equal(whole.parameters, [0.4, *found.parameters])
    assert with_held(found, FIXED, data) is found


def test_an_earlier_calibration_as_prior_is_the_fit_of_both() -> None:
    """Lengths are shared, each session has a base of its own: numpy's fit of all rows at once."""
    (first, one), (second, other) = session(2, 12, (0.5, -0.2)), session(3, 4, (-3.0, 2.0))
    words = ["lengths", "base_offset"]
    calibrated = estimate(only(ARM, words), first, sigma="given").calibrated_arm()
    model = only(ARM, words)
    found = estimate(model, second, prior=Prior({}, earlier(calibrated, model, second)), sigma="given")
    base_1, base_2 = np.zeros((24 + 8, 2)), np.zeros((24 + 8, 2))
    base_1[:24], base_2[24:] = np.tile(np.eye(2), (12, 1)), np.tile(np.eye(2), (4, 1))
    both = np.column_stack([np.concatenate([columns(first.postures), columns(second.postures)]), base_2, base_1])
    expected = np.linalg.lstsq(both, np.r_[one, other], rcond=None)[0]
    covariance = SIGMA**2 * np.linalg.inv(both.T @ both)
    np.testing.assert_allclose(found.parameters, expected[:5], rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.covariance, covariance[:5, :5], rtol=1e-6, atol=1e-12)
    alone = estimate(model, second, sigma="given")
    assert np.all(found.std[:3] < 0.7 * alone.std[:3])  # the prior is worth something


def test_what_is_held_conditions_the_prior() -> None:
    """With length 1 held, the fit of both data sets without its column."""
    (first, one), (second, other) = session(4, 12, (0.0, 0.0)), session(5, 5, (0.0, 0.0))
    calibrated = estimate(only(ARM, ["lengths"]), first, sigma="given").calibrated_arm()
    known = Calibration({**FIXED.values, "length_error:1": 0.7})
    model = only(replace(ARM, calibration=known), ["length_error:2", "length_error:3"])
    found = estimate(model, second, prior=Prior({}, earlier(calibrated, model, second)), sigma="given")
    both = np.concatenate([columns(first.postures), columns(second.postures)])
    expected = np.linalg.lstsq(both[:, 1:], np.r_[one, other] - 0.7 * both[:, 0], rcond=None)[0]
    np.testing.assert_allclose(found.parameters, expected, rtol=0, atol=1e-8)


def test_what_happened_once_is_no_prior_and_is_not_held_in_silence() -> None:
    """A drift of 2 mm in the first session, none in the second, where it comes out as without a calibration."""
    (first, _), (second, _) = session(6, 30, (0.0, 0.0)), session(7, 30, (0.0, 0.0))
    first = replace(first, positions=first.positions + np.outer(np.linspace(-1.0, 1.0, 30), [1.0, 0.0]))
    model = Model(ARM.with_effects(*ARM.effects, EffectSpec("base_drift")))
    calibrated = estimate(model, first).calibrated_arm()
    found = estimate(model, second, prior=Prior({}, earlier(calibrated, model, second)))
    assert found.contradiction is None
    assert found.values["base_drift.vx"] == pytest.approx(0.0, abs=0.3)
    for rows, others in ((first, False), (second, True)):
        said = with_base_doubt(estimate(only(calibrated, ["base"]), rows), calibrated, ["base"], rows).doubts
        assert any(one.startswith("base_drift: held, and so assumed to happen again") for one in said) is others
        assert not any("--only" in one for one in said)  # in these rows it has nothing to estimate


def in_space(shift: float = 0.0, base: float = 0.0) -> tuple[Measurements, Arm]:
    """Exact measurements of a spatial arm with errors, joint 3 off by `shift` more and the base moved [mm]."""
    whole = replace(CHAIN, settled=frozenset({"base", "tool"}), tools={"1": np.array([40.0, 20.0, 30.0])})
    values = {"joint_offset:2": 0.004, "joint_offset:3": -0.003 + shift, "translation_x:3": 0.6}
    q = np.random.default_rng(7).uniform(-2.0, 2.0, (40, 4))
    points = Model(Arm(whole, calibration=Calibration(values))).position(q)
    return Measurements(q, points + base * np.array([1.0, 2.0, -1.0])), Arm(CHAIN, sigma=1e-4)


def test_one_motor_of_a_spatial_arm() -> None:
    """Everything else stays as it was, the place of the base and of the reflector too."""
    before, arm = in_space()
    calibrated = estimate(Model(arm), before).calibrated_arm()
    after, _ = in_space(shift=0.005)
    found = estimate(only(calibrated, ["joint_offset:3"], after), after)
    old = dict(calibrated.calibration.values)  # type: ignore[union-attr]
    assert found.names == ("joint_offset:3",)
    assert found.parameters[0] - old["joint_offset:3"] == pytest.approx(0.005, abs=1e-5)
    assert found.rms_after < 0.01
    whole = with_held(found, calibrated.calibration, after)
    kept = whole.calibration()
    np.testing.assert_allclose(kept.base, calibrated.calibration.base, atol=1e-9)  # type: ignore[union-attr, arg-type]
    assert set(kept.parameter_names) == set(calibrated.calibration.parameter_names)  # type: ignore[union-attr]
    assert [row["name"] for row in whole.to_json()["parameters"]] == ["joint_offset:3"]
    assert whole.expected_tip > found.expected_tip  # type: ignore[operator]
    assert whole.expected_tip == pytest.approx(estimate(Model(arm), before).expected_tip, rel=0.05)


def test_the_tracker_moved() -> None:
    before, arm = in_space()
    calibrated = estimate(Model(arm), before).calibrated_arm()
    after, _ = in_space(base=500.0)
    for words in (["base"], ["base", "tool"]):
        found = estimate(only(calibrated, words, after), after)
        assert found.rms_after < 0.01
        moved = found.calibration().base[:3, 3] - calibrated.calibration.base[:3, 3]  # type: ignore[index, union-attr]
        np.testing.assert_allclose(moved, [500.0, 1000.0, -500.0], atol=0.01)
        assert found.rms_before == pytest.approx(found.rms_after, rel=1e-6)  # its place is fitted, as the sentence says
    few, noise = after.rows(slice(0, 4)), np.random.default_rng(9).normal(0.0, 1.0, (4, 3))
    noisy = replace(few, positions=few.positions + noise)
    found = with_held(
        estimate(only(calibrated, ["base", "tool"], few), noisy, sigma=1.0), calibrated.calibration, noisy
    )
    (said,) = (said for said in found.warnings if said.startswith("too few measurements: "))
    assert "before the fit" not in said  # its place is found


def test_words_that_name_nothing() -> None:
    with pytest.raises(InputError, match=r"only: 'lenghts' is not a parameter of the model, did you mean 'lengths'"):
        only(ARM, ["lenghts"])
    with pytest.raises(InputError, match="only: base is to be held, but the arm file does not say where it is"):
        only(Arm(CHAIN), ["joint_offsets", "tool"])
    assert only(Arm(LENGTHS), ["base"]).names == ("joint_offset:1", "base_offset.x0", "base_offset.y0")


def test_priors_that_do_not_fit() -> None:
    with pytest.raises(InputError, match="prior: found no covariance"):
        earlier(ARM, Model(ARM), session(1, 5, (0.0, 0.0))[0])
    other = replace(ARM, chain=LENGTHS + 1.0, calibration=replace(FIXED, covariance=np.eye(1)))
    with pytest.raises(InputError, match="prior: a calibration of another drawing"):
        earlier(other, Model(ARM), session(1, 5, (0.0, 0.0))[0])
    played = Model(ARM.with_effects(*ARM.effects, EffectSpec("gear_ratio", 2)))
    calibrated = estimate(played, session(1, 12, (0.0, 0.0))[0], sigma="given").calibrated_arm()
    with pytest.warns(UserWarning, match="prior: it was fitted with gear_ratio:2, which the model does not have"):
        earlier(calibrated, Model(ARM), session(2, 5, (0.0, 0.0))[0])


def test_a_held_base_that_stands_elsewhere_is_said() -> None:
    """In space and in the plane; nothing is said where the base stands as it did, or is among the words."""
    before, arm = in_space()
    calibrated = estimate(Model(arm), before).calibrated_arm()
    for base, moved in ((0.0, False), (500.0, True)):
        after, _ = in_space(shift=0.005, base=base)
        found = estimate(only(calibrated, ["joint_offset:3"], after), after)
        said = with_base_doubt(found, calibrated, ["joint_offset:3"], after).doubts
        assert any(one.startswith("the base pose is not that of the arm file: the RMS falls") for one in said) is moved
        assert any("--only base,joint_offset:3" in one for one in said) is moved
    words = ["base", "joint_offset:3"]
    free = estimate(only(calibrated, words, after), after)
    assert with_base_doubt(free, calibrated, words, after) is free
    drawn = replace(ARM, effects=())
    for shift, expected in (((0.0, 0.0), 0), ((10.0, -5.0), 1)):
        data, _ = session(11, 20, shift)
        found = estimate(only(drawn, ["lengths"]), data)
        doubts = with_base_doubt(found, drawn, ["lengths"], data).doubts
        assert len(doubts) == expected  # once: not also as another frame
        assert all("--only base,lengths" in one for one in doubts)
