"""The workflow as a whole: verdicts, JSON keys, bad input."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

from doe.studies.blind import cells as hidden_effects
from doe.studies.blind import simulator
from doe.studies.blind.cells import random_truth
from identification import Arm, EffectSpec, Gravity, InputError, Measurements, Model, diagnose
from identification.estimation import estimate as identify
from identification.files.arm import load_arm, with_calibration, with_effects
from identification.gap.fit import Rows, fit, fitted_arm
from identification.gap.result import Candidate, Diagnosis
from identification.model.minimal import practical
from tests.small_arm import OTHERS, drawn_arm, random_postures, small_arm
from tests.small_arm import measured as measured_three

RNG = np.random.default_rng(11)
TRUTH = replace(random_truth(RNG, 3), sigma=0.05)
ARM = Arm(
    TRUTH.lengths,
    sigma=0.05,
    gravity=Gravity(np.array([0.0, -simulator.G]), TRUTH.masses, np.full(3, TRUTH.center), TRUTH.payload),
)


ARM_FILE = f"""
links_mm = {TRUTH.lengths.tolist()}
measurement = {{ sigma_mm = 0.05 }}
[gravity]
acceleration_m_s2 = [0.0, {-simulator.G}]
link_masses_kg = {TRUTH.masses.tolist()}
center_of_mass = {[TRUTH.center] * 3}
payload_kg = {TRUTH.payload}
"""


def direction(name: str) -> simulator.Drawn:
    """An effect in a random direction, at joint 2 if it is one of a joint."""
    joint = None if name in hidden_effects.OF_ARM else 2
    return name, joint, hidden_effects.directions(TRUTH, name, joint, np.random.default_rng(7))


@cache
def measured(name: str | None, seed: int = 1, m: int = 60, **changes: object) -> Measurements:
    """Data with one clear effect (lambda = 25) at joint 2, or none."""
    rng = np.random.default_rng(seed)
    run = simulator.session(TRUTH, rng.uniform(-np.pi, np.pi, (m, 3)), rng)
    effects = []
    if name:
        others = hidden_effects.library_columns(TRUTH, run) if name in hidden_effects.OUTSIDE else None
        effects = [hidden_effects.sized(TRUTH, run, direction(name), 25.0, others)]
    return simulator.measure(replace(TRUTH, effects=effects), run, rng, "white")


@cache
def diagnosed(name: str | None) -> Diagnosis:
    return diagnose(ARM, measured(name))


CLEAR = [
    n
    for n in (*hidden_effects.LIBRARY_JOINT, *hidden_effects.LIBRARY_WHOLE)
    if n not in ("joint_compliance*", "joint_compliance")
]


@pytest.mark.parametrize("name", CLEAR)
def test_names_a_clear_effect_and_the_extended_arm_has_it(name: str) -> None:
    found = diagnosed(name)
    joint = None if name in hidden_effects.LIBRARY_WHOLE else 2
    settings = "[k=45]" if name == "transmission_ripple" else ""  # as drawn in `measured`
    assert found.effects == (name if joint is None else f"{name}:2{settings}",)
    assert found.gap.rms_after < found.gap.rms_before
    refitted = identify(Model(found.extended_arm(found.named)), measured(name))
    assert refitted.rms_before == pytest.approx(refitted.rms_after, rel=1e-6)  # what is named is the best fit
    predicting = Model(found.extended_arm())
    left = measured(name).positions - predicting.position(measured(name).postures, None, measured(name).conditions)
    assert np.sqrt(np.mean(np.sum(left**2, axis=1))) == pytest.approx(found.gap.rms_after, rel=1e-6)  # nothing is lost


def test_the_extended_arm_has_nothing_missing() -> None:
    assert diagnose(diagnosed("link_bending").extended_arm(), measured("link_bending")).verdict == "none"


def rippled(m: int = 120) -> Measurements:
    """Two ripples at joint 2 and one at joint 1, plain waves of some 0.05 deg in noise of 0.05 mm."""
    rng = np.random.default_rng(21)
    run = simulator.session(TRUTH, rng.uniform(-np.pi, np.pi, (m, 3)), rng)
    waves = [(2, 20, 9e-4, 0.0), (1, 12, 4e-4, 4e-4), (2, 29, 0.0, -8e-4)]
    effects = [("transmission_ripple", j, {"k": k, "a": a, "b": b}) for j, k, a, b in waves]
    return simulator.measure(replace(TRUTH, effects=effects), run, rng, "white")


def test_two_ripples_of_one_joint_are_named_beside_a_third() -> None:
    found = diagnose(ARM, rippled())
    ripple = "transmission_ripple"
    assert found.verdict == "named"
    assert set(found.effects) == {f"{ripple}:1[k=12]", f"{ripple}:2[k=20]", f"{ripple}:2[k=29]"}
    truth = {f"{ripple}:2[k=20].a": 9e-4, f"{ripple}:2[k=29].b": -8e-4, f"{ripple}:1.a": 4e-4, f"{ripple}:1.b": 4e-4}
    for estimate in found.named.parameters:
        assert abs(estimate.value - np.degrees(truth.get(estimate.name, 0.0))) < 4.0 * estimate.std
    said = found.to_json()["candidates"][0]
    assert [f"{spec.key}[k={spec.values['k']:g}]" for spec in found.named.specs] == list(found.effects)  # same order
    assert found.extended_arm(found.named).effects == found.named.specs
    assert said["settings"] == {f"{ripple}:1.k": 12.0, f"{ripple}:2[k=20].k": 20.0, f"{ripple}:2[k=29].k": 29.0}


def test_nothing_missing_gives_the_sizes_excluded_and_what_is_unknown_its_place() -> None:
    found = diagnosed(None)
    assert found.effects == ()
    assert found.sigma == pytest.approx(0.05, rel=0.3)  # 114 degrees of freedom: standard error 0.066
    assert found.excluded["encoder_eccentricity:2"].unit == "deg"
    assert found.excluded["encoder_eccentricity:2"].value > 0.0
    assert (diagnosed("bump").verdict, diagnosed("bump").where) == ("unknown", "joint:2")


def test_a_curve_is_as_sure_as_it_is_beside_the_geometry_that_goes_with_it() -> None:
    """Over few angles geometry and curve can make up for each other, by five times what the shape is unsure of."""
    rng = np.random.default_rng(4)
    low, high = [-0.5, 0.3, -np.pi], [0.5, 0.9, np.pi]
    run = simulator.session(TRUTH, rng.uniform(low, high, (120, 3)), rng)
    data = simulator.measure(TRUTH, run, rng, "white")
    error = 2e-3 * np.tanh((data.postures[:, 1] - 0.6) / 0.05)
    lever = Model(ARM).joint_levers(data.postures, None, data.conditions)[:, :, 1]
    (curve,) = diagnose(ARM, replace(data, positions=data.positions + lever * error[:, None])).curves
    assert curve.joint == 2
    assert np.sqrt(np.mean(curve.std**2)) < 0.1 * np.sqrt(np.mean(curve.error**2))


@pytest.mark.parametrize(("name", "effect"), [("free_ripple", "transmission_ripple:2"), ("step_drift", "base_step")])
def test_waves_of_any_order_and_steps_in_time_are_named(name: str, effect: str) -> None:
    found = diagnosed(name)
    assert (found.verdict, [spec.key for spec in found.named.specs]) == ("named", [effect])


def eccentric(m: int, seed: int) -> tuple[Measurements, float]:
    """A session of m rows of an arm whose encoder 2 is off centre by 5e-4 rad, and the RMS [mm] of its noise."""
    rng = np.random.default_rng(seed)
    truth = replace(TRUTH, effects=[("encoder_eccentricity", 2, {"a": 4e-4, "b": -3e-4})])
    run = simulator.session(truth, rng.uniform(-np.pi, np.pi, (m, 3)), rng)
    error = simulator.noise(truth, run, rng)
    return simulator.recorded(truth, run, error), float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


class PlainFit:
    """p = sum_k u_k exp(i theta_k), theta_2 and theta_3 with a cos q_2 + b sin q_2, by Gauss-Newton in plain numpy.

    Six or eight real numbers: real and imaginary parts of u, then a and b.
    """

    def __init__(self, data: Measurements, eccentric: bool) -> None:
        self.values, self.free = np.concatenate([TRUTH.lengths, np.zeros(5)]), 8 if eccentric else 6
        for _ in range(5):
            columns, left = self.columns(data), self.left(data)
            self.values[: self.free] += np.linalg.lstsq(columns, left, rcond=None)[0]
        self.variance = float(np.sum(self.left(data) ** 2)) / (2 * len(data) - self.free)
        self.covariance = self.variance * np.linalg.inv(columns.T @ columns)

    def links(self, data: Measurements) -> np.ndarray:
        """(m, 3) complex exp(i theta_k)."""
        q = data.postures.copy()
        q[:, 1] += self.values[6] * np.cos(q[:, 1]) + self.values[7] * np.sin(q[:, 1])
        return np.exp(1j * np.cumsum(q, axis=1))

    def left(self, data: Measurements) -> np.ndarray:
        """(2m,) real, then imaginary parts of what the fit leaves."""
        missing = data.positions @ [1.0, 1.0j] - self.links(data) @ (self.values[:3] + 1j * self.values[3:6])
        return np.concatenate([missing.real, missing.imag])

    def columns(self, data: Measurements) -> np.ndarray:
        e, q = self.links(data), data.postures[:, 1]
        lever = 1j * e[:, 1:] @ (self.values[1:3] + 1j * self.values[4:6])
        every = np.column_stack([e, 1j * e, lever * np.cos(q), lever * np.sin(q)])[:, : self.free]
        return np.concatenate([every.real, every.imag])

    def rms(self, data: Measurements) -> float:
        return float(np.sqrt(np.sum(self.left(data) ** 2) / len(data)))


def test_held_out_gap_shrinks_to_the_noise() -> None:
    data, (fresh, noise) = eccentric(60, 1)[0], eccentric(200, 2)
    found = diagnose(ARM, data, fresh)
    gap = found.gap
    assert found.confirmation is not None
    assert found.confirmation.shrinks is True
    before, after = PlainFit(data, eccentric=False), PlainFit(data, eccentric=True)
    assert gap.held_out_before == pytest.approx(before.rms(fresh), rel=1e-6)
    assert gap.held_out_after == pytest.approx(after.rms(fresh), rel=0.01)  # the size of the effect has a prior
    assert gap.floor.value == pytest.approx(np.sqrt(2.0) * ARM.sigma)  # no repeats here: the instrument's sigma
    columns = after.columns(fresh)
    added = np.sum((columns @ after.covariance) * columns) / len(fresh)
    assert after.variance < ARM.sigma**2  # by chance: these rows promise no less noise than the instrument has
    assert gap.predicted == pytest.approx(np.sqrt(2.0 * ARM.sigma**2 + added), rel=0.02)
    # 8 parameters from 120 numbers add 8/120 of the noise's square, give or take twice that: 3 to 10 % of its RMS
    assert noise * 0.97 < gap.held_out_after < noise * 1.10
    assert gap.held_out_before > 1.5 * noise


def test_exact_copies_of_rows_are_no_measurements() -> None:
    """The same rows as a second session are what they are once, and outliers keep their rows."""
    once = measured("encoder_eccentricity")
    wrong = replace(once, positions=once.positions + 5.0 * (np.arange(60) == 50)[:, None])
    twice = [*range(60), *range(60)]
    expected = diagnose(ARM, wrong)
    assert expected.outlier_rows == (51,)
    found = diagnose(ARM, replace(wrong.rows(twice), session=np.repeat(["A", "B"], 60)))
    assert (found.verdict, found.effects) == (expected.verdict, expected.effects)
    assert found.probabilities.best == expected.probabilities.best
    assert found.gap.rms_after == pytest.approx(expected.gap.rms_after, rel=1e-6)
    assert found.outlier_rows == (51,)
    assert any("exact cop" in warning for warning in found.warnings)


def test_order_of_rows_does_not_matter_when_conditions_are_given_and_progress_is_told() -> None:
    shuffled, shares = measured("base_drift").rows(np.random.default_rng(3).permutation(60)), []
    found = diagnose(ARM, shuffled, progress=lambda done, total, message: shares.append(done))
    assert found.effects == ("base_drift",)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert all(np.diff(shares) > 0.0)
    assert sum(0.0 < share < 0.7 for share in shares) >= 3  # the long step


def test_sigma_of_the_data_sheet_does_not_decide() -> None:
    for sigma in (None, 0.005):
        found = diagnose(replace(ARM, sigma=sigma), measured(None))
        assert found.verdict == "none"
    assert any("times the sigma_mm" in note for note in found.notes)


def test_outliers_are_listed_and_left_out() -> None:
    """A fifth of the rows."""
    data, rng = measured("backlash"), np.random.default_rng(4)
    rows = np.sort(rng.choice(60, 12, replace=False))
    positions = data.positions.copy()
    positions[rows] += 80.0 * rng.normal(size=(12, 2))
    found = diagnose(ARM, replace(data, positions=positions))
    assert found.outlier_rows == tuple(rows + 1)
    assert found.effects == ("backlash:2",)


def test_many_far_rows_are_structure_not_outliers() -> None:
    data = measured(None)
    positions = data.positions.copy()
    positions[:12] += 2.0  # 40 sigma: the tracker was bumped after the twelfth row
    found = diagnose(ARM, replace(data, positions=positions))
    assert (found.verdict, [spec.key for spec in found.named.specs]) == ("named", ["base_step"])
    assert found.named.specs[0].values["at"] == pytest.approx(11.5 / 59 - 0.5, abs=1e-6)
    assert found.outlier_rows == ()


def test_bad_input() -> None:
    data = measured(None)
    in_space = replace(data, positions=np.zeros((len(data), 3)))
    warm = ARM.with_effects(EffectSpec("thermal_growth"))
    bending = replace(ARM, gravity=None).with_effects(EffectSpec("link_bending"))
    two_joints = Measurements(data.postures[:, :2], data.positions)
    rounded = replace(data, positions=np.round(data.positions, 3))
    for said, *given in (
        ("3 joints for an arm of 2 links, allowed: 2", Arm([200.0, 100.0]), data),
        ("degrees of freedom", ARM, data.rows(slice(0, 4))),
        ("are also in the data", ARM, data, data),
        ("are also in the data", ARM, data, data.rows(slice(0, 3))),
        ("60 of 60 rows are also in the data", ARM, data, rounded),
        ("holdout: 2 joints", ARM, data, two_joints),
        ("positions of 3 coordinates, allowed: 2", ARM, replace(in_space, positions=np.arange(180.0).reshape(-1, 3))),
        ("holdout: positions of 3 coordinates, allowed: 2", ARM, data, in_space),
        ("temperature_C", warm, replace(data, temperature=None)),
        ("gravity", bending, data),
        ("the same posture in all 60 rows", ARM, replace(data, postures=np.tile(data.postures[:1], (60, 1)))),
        ("the same position in all 60 rows", ARM, replace(data, positions=np.tile(data.positions[:1], (60, 1)))),
    ):
        with pytest.raises(InputError, match=said):
            diagnose(*given)


def test_a_holdout_of_another_arm_is_refused() -> None:
    data, fresh = measured("encoder_eccentricity"), measured("encoder_eccentricity", seed=2, m=30)
    with pytest.raises(InputError, match="another arm"):
        diagnose(ARM, data, replace(fresh, positions=1.2 * fresh.positions))
    turn = np.array([[0.985, 0.174], [-0.174, 0.985]])
    turned = diagnose(ARM, data, replace(fresh, positions=fresh.positions @ turn))  # by 10 deg, of the base
    assert turned.confirmation is not None
    assert turned.confirmation.refitted == ("base",)
    bumped = fresh.positions.copy()
    bumped[:5] += 50.0  # a few outliers are not another arm
    assert diagnose(ARM, data, replace(fresh, positions=bumped)).confirmed is False


def test_an_estimate_at_its_bound_has_an_interval() -> None:
    # one link that rises under its load instead of sagging: p = l exp(i (q + c tau)), c < 0, so the estimate is 0.
    # Columns dp/d(l, offset, c) = e, i l e, i l tau e with e = exp(iq): the variance of c without its bound follows
    # from tau less its mean alone, var = sigma^2 / (l^2 sum (tau - mean)^2)
    rng = np.random.default_rng(5)
    arm = Arm([300.0], gravity=Gravity(np.array([0.0, -9.81]), np.array([10.0]), np.array([0.5]), 5.0))
    q = rng.uniform(-3.0, 3.0, (60, 1))
    tau = -9.81 * (10.0 * 0.15 + 5.0 * 0.3) * np.cos(q[:, 0])
    p = 300.0 * np.exp(1j * (q[:, 0] - 2e-5 * tau)) + 0.02 * rng.normal(size=(60, 2)) @ [1, 1j]
    rows = Rows.of(Measurements(q, np.column_stack([p.real, p.imag])))
    fitted = fit(Model(arm.with_effects(EffectSpec("joint_compliance", 1))), rows)
    (estimate,) = Candidate.of(fitted, 1).parameters
    std = fitted.sigma / (300.0 * np.sqrt(np.sum((tau - tau.mean()) ** 2)))
    assert estimate.value == estimate.low_95 == 0.0
    assert estimate.std == pytest.approx(std, rel=1e-3)  # the link is 300 mm to 1e-4
    assert estimate.high_95 == pytest.approx(stats.t(2 * 60 - 3).ppf(0.975) * std, rel=1e-3)


def test_what_the_rows_do_not_determine_has_no_interval() -> None:
    # under a vertical axis gravity has no moment about it, whatever the joint's compliance is
    rng = np.random.default_rng(1)
    data = measured_three(small_arm(rng), random_postures(30, rng), rng)
    arm = practical(drawn_arm(), data)
    fitted = fit(Model(arm.with_effects(EffectSpec("joint_compliance"))), Rows.of(data))
    first, second, *_ = Candidate.of(fitted, 1).parameters
    assert np.all(np.isnan([first.value, first.std, first.low_95, first.high_95]))
    assert 0.0 < second.low_95 < second.high_95


def test_poor_data_do_not_crash() -> None:
    data = measured(None)
    still = data.postures.copy()
    still[:, 1] = 0.3
    run = simulator.session(TRUTH, still, np.random.default_rng(0))
    p = simulator.position(TRUTH, run) + 0.05 * np.random.default_rng(1).normal(size=(60, 2))
    found = diagnose(ARM, Measurements(still, p))
    assert found.verdict == "none"
    massless = replace(ARM, gravity=Gravity(np.array([0.0, -9.81]), np.zeros(3), np.full(3, 0.5), 0.0))
    assert diagnose(massless, data).excluded["link_bending"].value is None
    constant = replace(data, temperature=np.full(60, 21.0), directions=np.ones((60, 3)))
    assert diagnose(ARM, constant).verdict == "none"
    repeated = data.rows(np.repeat(np.arange(5), 4))
    assert diagnose(ARM, repeated).detectability.freedom == 2 * 5 - 6  # copies of five rows


def test_on_a_grid_the_ripples_that_an_effect_imitates_are_told() -> None:
    """On steps of 10 degrees k and 36 - k periods have the same cosine and opposite sines: one column space."""
    rng = np.random.default_rng(3)
    q = np.radians(10.0) * rng.integers(-18, 18, (60, 3))
    run = simulator.session(TRUTH, q, rng)
    truth = replace(TRUTH, effects=[("transmission_ripple", 2, {"k": 35, "a": 8e-4, "b": 6e-4})])
    found = diagnose(ARM, simulator.measure(truth, run, rng, "white"))
    assert found.effects == ("encoder_eccentricity:2",)
    like = {other: alike for own, other, alike in found.aliases if own == "encoder_eccentricity:2"}
    assert like["transmission_ripple:2[k=35]"] == pytest.approx(1.0)
    assert like["transmission_ripple:2[k=37]"] == pytest.approx(1.0)
    assert any("cannot be distinguished from transmission_ripple:2[k=35]" in note for note in found.notes)
    assert not any("cannot be distinguished from" in note for note in diagnosed("encoder_eccentricity").notes)


LENS = {
    "lens": lambda p, reach: p * np.abs(p) ** 2 / reach**2,
    "wave along y": lambda p, reach: 1j * np.cos(2.0 * np.pi * p.imag / (0.6 * reach) + 1.0),
    "rings": lambda p, reach: p / np.abs(p) * np.sin(2.0 * np.pi * np.abs(p) / (0.55 * reach)),
}


@pytest.mark.parametrize("name", LENS)
def test_a_bent_instrument_is_unknown_in_the_workspace(name: str) -> None:
    data = measured(None)
    p = data.positions @ np.array([1.0, 1.0j])
    bent = LENS[name](p, TRUTH.lengths.sum())
    p = p + bent * 0.2 / np.sqrt(np.mean(np.abs(bent) ** 2))
    found = diagnose(ARM, replace(data, positions=np.column_stack([p.real, p.imag])))
    assert (found.verdict, found.where) == ("unknown", "workspace")


@pytest.mark.parametrize(
    ("name", "place"),
    [("cross_talk", "joint"), ("stick_slip", "joint"), ("warm_offset", "temperature"), ("refraction", "workspace")],
)
def test_an_error_of_any_form_is_written_at_its_place_and_predicts_other_rows(name: str, place: str) -> None:
    """Physics that the library does not have, 40 standard deviations of the noise: the file that is written, read
    again, has little more than half of the error of a fit of the geometry at other postures, as asked in the median."""
    rng = np.random.default_rng(8)
    run, fresh = (simulator.session(TRUTH, rng.uniform(-np.pi, np.pi, (120, 3)), rng) for _ in range(2))
    truth = replace(TRUTH, effects=[hidden_effects.physics_effect(TRUTH, run, name, 40.0, rng)])
    data, other = simulator.measure(truth, run, rng), simulator.recorded(truth, fresh, np.zeros((120, 2)))
    found = diagnose(ARM, data)
    assert found.verdict == "unknown"
    assert str(found.where).startswith(place)
    written = found.extended_arm()
    text = with_calibration(with_effects(ARM_FILE, written.effects), written.calibration)
    left = [
        other.positions - Model(arm).position(other.postures, None, other.conditions)
        for arm in (fitted_arm(ARM, data), written, load_arm(tomllib.loads(text)))
    ]
    before, after, again = (float(np.sqrt(np.mean(np.square(each)))) for each in left)
    assert after < 0.55 * before
    assert again == pytest.approx(after, rel=1e-6)


def test_effects_of_an_arm_that_sags_with_three_reflectors_at_each_posture() -> None:
    """Compliance, two encoders and play beside 0.02 mm of noise of each row and 0.03 mm of each posture."""
    rng = np.random.default_rng(5)
    data = measured_three(small_arm(rng, *OTHERS), random_postures(100, rng), rng)
    found = diagnose(drawn_arm(), data)
    hidden = {"joint_compliance", *(f"{name}:{joint}" for name, joint, _ in OTHERS)}
    assert set(found.named.keys) == hidden
    assert found.verdict == "named"
    assert [finding.name for finding in found.scatter] == ["repeats"]
    # three reads of a posture tell its error from that of a row: 0.03^2 / 0.02^2 = 2.25 on a grid of factors of 4
    assert 0.5 < found.scatter[0].size < 9.0
