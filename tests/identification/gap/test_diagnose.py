"""The workflow as a whole: verdicts, JSON keys, bad input."""

import sys
import tomllib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

from doe.studies.blind import cells, simulator
from identification import Arm, EffectSpec, Gravity, InputError, Measurements, Model, diagnose
from identification.documents.pictures import kept_rows
from identification.estimation import estimate as identify
from identification.files.arm import load_arm, with_effects
from identification.gap.average import PredictingModel, averaged
from identification.gap.fit import Rows, determined, fit, fitted_arm
from identification.gap.result import Candidate, Diagnosis
from identification.gap.search import Posterior
from identification.model.placed import practical
from tests.small_arm import OTHERS, drawn_arm, random_postures, small_arm
from tests.small_arm import measured as measured_three

TRUTH = replace(cells.random_truth(np.random.default_rng(11), 3), sigma=0.05)
UP = np.array([0.0, -simulator.G])
ARM = Arm(TRUTH.lengths, sigma=0.05, gravity=Gravity(UP, TRUTH.masses, np.full(3, TRUTH.center), TRUTH.payload))
RIPPLE = "transmission_ripple"


ARM_FILE = f"""
links_mm = {TRUTH.lengths.tolist()}
measurement = {{ sigma_mm = 0.05 }}
[gravity]
acceleration_m_s2 = [0.0, {-simulator.G}]
link_masses_kg = {TRUTH.masses.tolist()}
center_of_mass = {[TRUTH.center] * 3}
payload_kg = {TRUTH.payload}
"""


def simulated(
    effects: list[simulator.Drawn], rng: np.random.Generator, m: int = 60, low: object = -np.pi, high: object = np.pi
) -> Measurements:
    """A session of random postures with white noise, in the order of measurement."""
    run = simulator.session(TRUTH, rng.uniform(low, high, (m, 3)), rng)
    truth = replace(TRUTH, effects=effects)
    return simulator.recorded(truth, run, simulator.noise(truth, run, rng))


@cache
def measured(name: str | None, seed: int = 1, m: int = 60) -> Measurements:
    """Data with one clear effect (lambda = 25) in a random direction, at joint 2 if it is one of a joint, or none."""
    rng = np.random.default_rng(seed)
    run, effects = simulator.session(TRUTH, rng.uniform(-np.pi, np.pi, (m, 3)), rng), []
    if name:
        joint = None if name in cells.OF_ARM else 2
        drawn = name, joint, cells.directions(TRUTH, name, joint, np.random.default_rng(7))
        others = cells.library_columns(TRUTH, run) if name in cells.OUTSIDE else None
        effects = [cells.sized(TRUTH, run, drawn, 25.0, others)]
    truth = replace(TRUTH, effects=effects)
    return simulator.recorded(truth, run, simulator.noise(truth, run, rng))


@cache
def diagnosed(name: str | None) -> Diagnosis:
    return diagnose(ARM, measured(name))


CLEAR = [n for n in (*cells.LIBRARY_JOINT, *cells.LIBRARY_WHOLE) if not n.startswith("joint_compliance")]


@pytest.mark.parametrize("name", CLEAR)
def test_names_a_clear_effect_and_the_extended_arm_has_it(name: str) -> None:
    named, data = diagnosed(name), measured(name)
    settings = "[k=45]" if name == RIPPLE else ""  # as drawn in `measured`
    assert named.effects == (name if name in cells.LIBRARY_WHOLE else f"{name}:2{settings}",)
    assert named.gap.rms_after < named.gap.rms_before
    refitted = identify(Model(named.extended_arm(named.named)), data)
    assert refitted.rms_before == pytest.approx(refitted.rms_after, rel=1e-6)  # what is named is the best fit
    said = named.extended_arm(named.named).provenance  # nothing that is known of the predicting model alone
    assert (said["rms_after_mm"], "better_than_geometry" in said) == (pytest.approx(refitted.rms_after), False)
    left = data.positions - Model(named.extended_arm()).position(data.postures, None, data.conditions)
    assert np.sqrt(np.mean(np.sum(left**2, axis=1))) == pytest.approx(named.gap.rms_after, rel=1e-6)  # nothing is lost
    if name == "link_bending":
        assert diagnose(named.extended_arm(), data).verdict == "none"


def test_two_ripples_of_one_joint_are_named_beside_a_third() -> None:
    """Plain waves of some 0.05 deg in noise of 0.05 mm."""
    waves = {(2, 20): (9e-4, 0.0), (1, 12): (4e-4, 4e-4), (2, 29): (0.0, -8e-4)}
    drawn = [(RIPPLE, j, {"k": k, "a": a, "b": b}) for (j, k), (a, b) in waves.items()]
    named = diagnose(ARM, simulated(drawn, np.random.default_rng(21), 120))
    assert named.verdict == "named"
    assert set(named.effects) == {f"{RIPPLE}:{j}[k={k}]" for j, k in waves}
    truth = {f"{RIPPLE}:2[k=20].a": 9e-4, f"{RIPPLE}:2[k=29].b": -8e-4, f"{RIPPLE}:1.a": 4e-4, f"{RIPPLE}:1.b": 4e-4}
    for estimate in named.named.parameters:
        assert abs(estimate.value - np.degrees(truth.get(estimate.name, 0.0))) < 4.0 * estimate.std
    assert [f"{spec.key}[k={spec.values['k']:g}]" for spec in named.named.specs] == list(named.effects)  # same order
    assert named.extended_arm(named.named).effects == named.named.specs
    settings = {f"{RIPPLE}:1.k": 12.0, f"{RIPPLE}:2[k=20].k": 20.0, f"{RIPPLE}:2[k=29].k": 29.0}
    assert named.to_json()["candidates"][0]["settings"] == settings


def test_nothing_missing_gives_the_sizes_excluded_and_what_is_unknown_its_place() -> None:
    nothing = diagnosed(None)
    assert nothing.effects == ()
    assert nothing.sigma == pytest.approx(0.05, rel=0.3)  # 114 degrees of freedom: standard error 0.066
    excluded = nothing.excluded["encoder_eccentricity:2"]
    assert (excluded.unit, excluded.value > 0.0) == ("deg", True)
    assert (diagnosed("bump").verdict, diagnosed("bump").where) == ("unknown", "joint:2")


def test_a_curve_is_as_sure_as_it_is_beside_the_geometry_that_goes_with_it() -> None:
    """Over few angles geometry and curve can make up for each other, by five times what the shape is unsure of."""
    data = simulated([], np.random.default_rng(4), 120, [-0.5, 0.3, -np.pi], [0.5, 0.9, np.pi])
    error = 2e-3 * np.tanh((data.postures[:, 1] - 0.6) / 0.05)
    lever = Model(ARM).joint_levers(data.postures, None, data.conditions)[:, :, 1]
    (curve,) = diagnose(ARM, replace(data, positions=data.positions + lever * error[:, None])).curves
    assert curve.joint == 2
    assert np.sqrt(np.mean(curve.std**2)) < 0.1 * np.sqrt(np.mean(curve.error**2))


@pytest.mark.parametrize(("name", "effect"), [("free_ripple", f"{RIPPLE}:2"), ("step_drift", "base_step")])
def test_waves_of_any_order_and_steps_in_time_are_named(name: str, effect: str) -> None:
    named = diagnosed(name)
    assert (named.verdict, [spec.key for spec in named.named.specs]) == ("named", [effect])


def eccentric(m: int, seed: int) -> tuple[Measurements, float]:
    """A session of m rows of an arm whose encoder 2 is off centre by 5e-4 rad, and the RMS [mm] of its noise."""
    rng = np.random.default_rng(seed)
    truth = replace(TRUTH, effects=[("encoder_eccentricity", 2, {"a": 4e-4, "b": -3e-4})])
    run = simulator.session(truth, rng.uniform(-np.pi, np.pi, (m, 3)), rng)
    error = simulator.noise(truth, run, rng)
    return simulator.recorded(truth, run, error), float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def left_by(x: np.ndarray, data: Measurements) -> np.ndarray:
    """(2m,) residuals of p = sum_k u_k exp(i theta_k), theta_2 and theta_3 with a cos q_2 + b sin q_2; x: real and
    imaginary parts of u, then, of an arm that has them, a and b."""
    q, (a, b) = data.postures.copy(), x[6:] if len(x) == 8 else (0.0, 0.0)
    q[:, 1] += a * np.cos(q[:, 1]) + b * np.sin(q[:, 1])
    missing = data.positions @ [1.0, 1.0j] - np.exp(1j * np.cumsum(q, axis=1)) @ (x[:3] + 1j * x[3:6])
    return np.concatenate([missing.real, missing.imag])


def test_held_out_gap_shrinks_to_the_noise() -> None:
    """Against scipy's least squares in plain numpy."""
    data, (fresh, noise) = eccentric(60, 1)[0], eccentric(200, 2)
    named = diagnose(ARM, data, fresh)
    gap, scales = named.gap, np.r_[np.ones(6), 1e-3, 1e-3]
    assert named.confirmation is not None
    assert named.confirmation.shrinks is True
    starts = (np.r_[TRUTH.lengths, np.zeros(count)] for count in (3, 5))
    options = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-12}
    before, after = (least_squares(left_by, x, x_scale=scales[: len(x)], args=(data,), **options).x for x in starts)
    rms_before, rms_after = (np.sqrt(np.sum(left_by(x, fresh) ** 2) / 200) for x in (before, after))
    assert gap.held_out_before == pytest.approx(rms_before, rel=1e-6)
    assert gap.held_out_after == pytest.approx(rms_after, rel=0.01)  # the size of the effect has a prior
    assert gap.floor.value == pytest.approx(np.sqrt(2.0) * ARM.sigma)  # no repeats here: the instrument's sigma
    steps = 1e-6 * np.diag(scales)
    here, there = (
        np.transpose([(left_by(after + step, rows) - left_by(after - step, rows)) / 2e-6 for step in steps])
        for rows in (data, fresh)
    )
    variance = np.sum(left_by(after, data) ** 2) / (120 - 8)
    assert variance < ARM.sigma**2  # by chance: these rows promise no less noise than the instrument has
    added = variance * np.sum((there @ np.linalg.inv(here.T @ here)) * there) / len(fresh)
    assert gap.predicted == pytest.approx(np.sqrt(2.0 * ARM.sigma**2 + added), rel=0.02)
    # 8 parameters from 120 numbers add 8/120 of the noise's square, give or take twice that: 3 to 10 % of its RMS
    assert noise * 0.97 < gap.held_out_after < noise * 1.10
    assert gap.held_out_before > 1.5 * noise


def test_exact_copies_of_rows_are_no_measurements() -> None:
    """The same rows as a second session are what they are once, and outliers keep their rows."""
    once = measured("encoder_eccentricity")
    wrong = replace(once, positions=once.positions + 5.0 * (np.arange(60) == 50)[:, None])
    expected = diagnose(ARM, wrong)
    copied = diagnose(ARM, replace(wrong.rows([*range(60), *range(60)]), session=np.repeat(["A", "B"], 60)))
    assert (copied.verdict, copied.effects) == (expected.verdict, expected.effects)
    assert copied.probabilities.best == expected.probabilities.best
    assert copied.gap.rms_after == pytest.approx(expected.gap.rms_after, rel=1e-6)
    assert expected.outlier_rows == copied.outlier_rows == (51,)
    before = diagnose(ARM, wrong.rows([0, 0, *range(60)]))
    assert before.outlier_rows == (53,)
    assert kept_rows(before)[0].tolist() == [*range(50), *range(51, 60)]  # that pictures show
    assert any("exact cop" in warning for warning in copied.warnings)


def test_order_of_rows_does_not_matter_when_conditions_are_given_and_progress_is_told() -> None:
    shuffled, shares = measured("base_drift").rows(np.random.default_rng(3).permutation(60)), []
    assert diagnose(ARM, shuffled, progress=lambda done, *_: shares.append(done)).effects == ("base_drift",)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert all(np.diff(shares) > 0.0)
    assert sum(0.0 < share < 0.7 for share in shares) >= 3  # the long step


def test_sigma_of_the_data_sheet_does_not_decide() -> None:
    for sigma in (None, 0.005):
        nothing = diagnose(replace(ARM, sigma=sigma), measured(None))
        assert nothing.verdict == "none"
    assert any("times the sigma_mm" in note for note in nothing.notes)


def test_a_sigma_that_is_too_small_makes_the_promise_for_held_out_rows_no_larger() -> None:
    """Of a kind with the rows they leave as much, whatever sigma says of it: 800 numbers, which scatter by 4 %."""
    data, more = (measured(None, seed, 200) for seed in (1, 2))
    for sigma in (0.05, 0.02):
        gap = diagnose(replace(ARM, sigma=sigma), data, more).gap
        assert gap.predicted == pytest.approx(gap.held_out_after, rel=0.12)


def test_a_sigma_of_the_rows_decides_that_something_is_missing() -> None:
    """Four times as much as it is left, which no set explains: nothing is missing at most with chi-square's p."""
    stated = diagnose(ARM, replace(measured(None), sigma=np.full(60, 0.005)))
    assert (stated.verdict, stated.where, stated.effects) == ("unknown", None, ())
    assert stated.misfit is not None
    assert stated.probabilities.of(()) <= stated.misfit.p_value < 1e-3


def test_outliers_are_listed_and_left_out_and_many_far_rows_are_structure() -> None:
    """A fifth of the rows; and 40 sigma of each of the first twelve: the tracker was bumped after them."""
    data, rng = measured("backlash"), np.random.default_rng(4)
    rows = np.sort(rng.choice(60, 12, replace=False))
    positions = data.positions.copy()
    positions[rows] += 80.0 * rng.normal(size=(12, 2))
    named = diagnose(ARM, replace(data, positions=positions))
    assert (named.outlier_rows, named.effects) == (tuple(rows + 1), ("backlash:2",))
    data = measured(None)
    bumped = diagnose(ARM, replace(data, positions=data.positions + 2.0 * (np.arange(60) < 12)[:, None]))
    assert (bumped.verdict, [spec.key for spec in bumped.named.specs]) == ("named", ["base_step"])
    assert bumped.named.specs[0].values["at"] == pytest.approx(11.5 / 59 - 0.5, abs=1e-6)
    assert bumped.outlier_rows == ()


@pytest.mark.parametrize(("rows", "off"), [([28], 1.1), ([30], 1.1), ([*range(40, 49)], 200.0)])
def test_rows_that_stand_out_beside_a_step_are_outliers_and_nothing_else(rows: list[int], off: float) -> None:
    """The base jumps by 40 sigma after row 30. Two more steps, or noise that lasts, would explain these rows, too."""
    positions = measured(None).positions + 2.0 * (np.arange(60) > 30)[:, None]
    positions[rows] += off * np.column_stack([np.cos(rows), np.sin(rows)])
    named = diagnose(ARM, replace(measured(None), positions=positions))
    keys = [spec.key for spec in named.named.specs]
    assert (keys, named.scatter, named.outlier_rows) == (["base_step"], (), tuple(row + 1 for row in rows))


def test_an_average_far_from_linear_gives_way_to_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """To that by least squares of `identify`, of the named effects and of none."""

    def bent(posterior: Posterior, coordinates: int) -> tuple[PredictingModel, np.ndarray, Posterior]:
        best, bend, at = averaged(posterior, coordinates)
        return replace(best, values=best.values + 1.0), bend + 100.0, at

    monkeypatch.setattr(sys.modules["identification.gap.diagnose"], "averaged", bent)
    for name, specs in ((None, ()), ("backlash", (EffectSpec("backlash", 2),))):
        found, fitted = diagnose(ARM, measured(name)), identify(Model(ARM.with_effects(*specs)), measured(name))
        assert [spec.key for spec in found.predicting.specs] == [spec.key for spec in specs]
        assert found.gap.rms_after == pytest.approx(fitted.rms_after, rel=1e-6)


def test_bad_input() -> None:
    data = measured(None)
    in_space = replace(data, positions=np.arange(180.0).reshape(-1, 3))
    warm = ARM.with_effects(EffectSpec("thermal_growth"))
    bending = replace(ARM, gravity=None).with_effects(EffectSpec("link_bending"))
    for complaint, *given in (
        ("3 joints for an arm of 2 links, allowed: 2", Arm([200.0, 100.0]), data),
        ("degrees of freedom", ARM, data.rows(slice(0, 4))),
        ("are also in the data", ARM, data, data),
        ("are also in the data", ARM, data, data.rows(slice(0, 3))),
        ("60 of 60 rows are also in the data", ARM, data, replace(data, positions=np.round(data.positions, 3))),
        ("holdout: 2 joints", ARM, data, Measurements(data.postures[:, :2], data.positions)),
        ("positions of 3 coordinates, allowed: 2", ARM, in_space),
        ("holdout: positions of 3 coordinates, allowed: 2", ARM, data, in_space),
        ("temperature_C", warm, replace(data, temperature=None)),
        ("gravity", bending, data),
        ("the same posture in all 60 rows", ARM, replace(data, postures=np.tile(data.postures[:1], (60, 1)))),
        ("the same position in all 60 rows", ARM, replace(data, positions=np.tile(data.positions[:1], (60, 1)))),
    ):
        with pytest.raises(InputError, match=complaint):
            diagnose(*given)


def test_a_holdout_of_another_arm_is_refused() -> None:
    data, fresh = measured("encoder_eccentricity"), measured("encoder_eccentricity", seed=2, m=30)
    with pytest.raises(InputError, match="another arm"):
        diagnose(ARM, data, replace(fresh, positions=1.2 * fresh.positions))
    turn = np.array([[0.985, 0.174], [-0.174, 0.985]])
    turned = diagnose(ARM, data, replace(fresh, positions=fresh.positions @ turn))  # by 10 deg, of the base
    assert turned.confirmation is not None
    assert turned.confirmation.refitted == ("base",)
    bumped = fresh.positions + 50.0 * (np.arange(30) < 5)[:, None]  # a few outliers are not another arm
    refuted = diagnose(ARM, data, replace(fresh, positions=bumped))
    assert (refuted.confirmed, replace(refuted, confirmation=None).confirmed) == (False, None)


def test_an_estimate_at_its_bound_has_an_interval() -> None:
    """One link that rises under its load instead of sagging: p = l exp(i (q + c tau)), c < 0, so the estimate is 0.
    Columns dp/d(l, offset, c) = e, i l e, i l tau e with e = exp(iq): the variance of c without its bound follows
    from tau less its mean alone, var = sigma^2 / (l^2 sum (tau - mean)^2)."""
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
    assert fitted.free.tolist() == [True, True, False]
    assert estimate.std == pytest.approx(std, rel=1e-3)  # the link is 300 mm to 1e-4
    assert estimate.high_95 == pytest.approx(stats.t(2 * 60 - 3).ppf(0.975) * std, rel=1e-3)


def test_gravity_that_points_the_wrong_way_shows_no_compliance() -> None:
    found = diagnose(replace(ARM, gravity=replace(ARM.gravity, acceleration=-UP)), measured("joint_compliance"))
    assert (found.verdict, found.named.effects) == ("unknown", ())
    assert any("would have to be negative (does [gravity] point" in note for note in found.notes)


def test_what_the_rows_do_not_determine_has_no_interval() -> None:
    """Under a vertical axis gravity has no moment about it, whatever the joint's compliance is."""
    rng = np.random.default_rng(1)
    data = measured_three(small_arm(rng), random_postures(30, rng), rng)
    arm = practical(drawn_arm(), data)
    fitted = fit(Model(arm.with_effects(EffectSpec("joint_compliance"))), Rows.of(data))
    first, second, *_ = Candidate.of(fitted, 1).parameters
    assert np.all(np.isnan([first.value, first.std, first.low_95, first.high_95]))
    assert 0.0 < second.low_95 < second.high_95


def test_poor_data_do_not_crash() -> None:
    """A joint that stands still, an arm without mass, conditions that do not change, few postures many times."""
    data = measured(None)
    low, high = [-np.pi, 0.3, -np.pi], [np.pi, 0.3, np.pi]
    still = simulated([], np.random.default_rng(0), 60, low, high)
    constant = replace(data, temperature=np.full(60, 21.0), directions=np.ones((60, 3)))
    for each in (Measurements(still.postures, still.positions), constant):
        assert diagnose(ARM, each).verdict == "none"
    massless = replace(ARM, gravity=Gravity(UP, np.zeros(3), np.full(3, 0.5), 0.0))
    assert diagnose(massless, data).excluded["link_bending"].value is None
    repeated = data.rows(np.repeat(np.arange(5), 4))
    assert diagnose(ARM, repeated).detectability.freedom == 2 * 5 - 6  # copies of five rows


def test_on_a_grid_the_ripples_that_an_effect_imitates_are_told() -> None:
    """On steps of 10 degrees k and 36 - k periods have the same cosine and opposite sines: one column space."""
    rng = np.random.default_rng(3)
    run = simulator.session(TRUTH, np.radians(10.0) * rng.integers(-18, 18, (60, 3)), rng)
    truth = replace(TRUTH, effects=[(RIPPLE, 2, {"k": 35, "a": 8e-4, "b": 6e-4})])
    named = diagnose(ARM, simulator.recorded(truth, run, simulator.noise(truth, run, rng)))
    assert named.effects == ("encoder_eccentricity:2",)
    like = {other: alike for effect, other, alike in named.aliases if effect == "encoder_eccentricity:2"}
    assert [like[f"{RIPPLE}:2[k={k}]"] for k in (35, 37)] == pytest.approx([1.0, 1.0])
    assert any(f"cannot be distinguished from {RIPPLE}:2[k=35]" in note for note in named.notes)
    assert not any("cannot be distinguished from" in note for note in diagnosed("encoder_eccentricity").notes)


@pytest.mark.parametrize(("name", "joint"), [("gear_ratio", 1), ("base_rotation_drift", None)])
def test_drifts_are_like_effects_of_the_posture_where_the_rows_are_in_its_order(name: str, joint: int | None) -> None:
    """A base that turns while joint 1 does, a step from row to row, is a gear ratio; in random order it is not."""
    rng, notes = np.random.default_rng(5), []
    q = np.column_stack([np.linspace(-3.0, 3.0, 60), rng.uniform(-3.0, 3.0, (60, 2))])
    for order in (np.arange(60), rng.permutation(60)):
        run = simulator.session(TRUTH, q[order], rng)
        effect = cells.sized(TRUTH, run, (name, joint, cells.directions(TRUTH, name, joint, rng)), 25.0)
        truth = replace(TRUTH, effects=[effect])
        notes.append(" ".join(diagnose(ARM, simulator.recorded(truth, run, simulator.noise(truth, run, rng))).notes))
    assert "in this order" in notes[0]
    assert "to decide, measure in random order" in notes[0]
    assert "in this order" not in notes[1]


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
    unknown = diagnose(ARM, replace(data, positions=np.column_stack([p.real, p.imag])))
    assert (unknown.verdict, unknown.where) == ("unknown", "workspace")


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("cable_pull", "joint"),
        ("cross_talk", "joint"),
        ("stick_slip", "joint"),
        ("warm_offset", "temperature"),
        ("refraction", "workspace"),
    ],
)
def test_an_error_of_any_form_is_written_at_its_place_and_predicts_other_rows(name: str, place: str) -> None:
    """Physics that the library does not have, 40 standard deviations of the noise: the file that is written, read
    again, has little more than half of the error of a fit of the geometry at other postures, as asked in the median."""
    rng = np.random.default_rng(8)
    run, fresh = (simulator.session(TRUTH, rng.uniform(-np.pi, np.pi, (120, 3)), rng) for _ in range(2))
    truth = replace(TRUTH, effects=[cells.physics_effect(TRUTH, run, name, 40.0, rng)])
    data = simulator.recorded(truth, run, simulator.noise(truth, run, rng))
    other = simulator.recorded(truth, fresh, np.zeros((120, 2)))
    found = diagnose(ARM, data)
    assert found.verdict == "unknown"
    assert str(found.where).startswith(place)
    written = found.extended_arm()
    text = with_effects(ARM_FILE, written.effects, calibration=written.calibration)
    left = [
        other.positions - Model(arm).position(other.postures, None, other.conditions)
        for arm in (fitted_arm(ARM, data), written, load_arm(tomllib.loads(text)))
    ]
    before, after, again = (float(np.sqrt(np.mean(np.square(each)))) for each in left)
    assert after < 0.55 * before
    assert again == pytest.approx(after, rel=1e-6)


def test_effects_of_an_arm_that_sags_with_three_reflectors_at_each_posture() -> None:
    """Compliance, encoders, play, noise of rows and of postures; two misread joints, two reflectors swapped."""
    rng = np.random.default_rng(5)
    data = measured_three(small_arm(rng, *OTHERS), random_postures(100, rng), rng)
    misread = np.zeros((300, 6))
    misread[120:123, 3], misread[210:213, 1] = np.radians(0.3), np.radians(-0.5)
    swapped = data.positions[[*range(30), 31, 30, *range(32, 300)]]
    named = diagnose(drawn_arm(), replace(data, postures=data.postures + misread, positions=swapped))
    assert named.outlier_rows == (31, 32, 121, 122, 123, 211, 212, 213)
    few = replace(data, positions=swapped).rows(np.arange(60))  # they take no number from what the others determine
    assert determined(drawn_arm(), few)[0].chain.fixed == determined(drawn_arm(), data)[0].chain.fixed
    assert set(named.named.keys) == {"joint_compliance", *(f"{name}:{joint}" for name, joint, _ in OTHERS)}
    assert named.verdict == "named"
    assert [finding.name for finding in named.scatter] == ["repeats"]
    # three reads of a posture tell its error from that of a row: 0.03^2 / 0.02^2 = 2.25 on a grid of factors of 4
    assert 0.5 < named.scatter[0].size < 9.0


def test_rows_that_err_alike_are_weighed_as_such() -> None:
    """First-order autoregression, correlation 0.95: least squares has smaller residuals on its own rows, and twice the
    error of what weighs the rows rightly and is written."""
    rng = np.random.default_rng(4)
    exact = replace(TRUTH, sigma=1e-9)
    run = simulator.session(exact, rng.uniform(-np.pi, np.pi, (60, 3)), rng)
    data, noise = simulator.recorded(exact, run, simulator.noise(exact, run, rng)), 0.1 * rng.normal(size=(60, 2))
    for k in range(1, 60):
        noise[k] = 0.95 * noise[k - 1] + np.sqrt(1.0 - 0.95**2) * noise[k]
    noisy = replace(data, positions=data.positions + noise)
    arm = replace(ARM, sigma=None)
    result, plain = diagnose(arm, noisy), identify(Model(arm), noisy)
    assert result.verdict == "none"
    assert not any("geometry alone" in note for note in result.notes)
    weighed, simple = (
        np.linalg.norm(Model(each).position(data.postures) - data.positions)
        for each in (result.extended_arm(), replace(arm, calibration=plain.calibration()))
    )
    assert weighed < 0.5 * simple


def test_a_holdout_without_the_temperature_is_told() -> None:
    rng = np.random.default_rng(5)
    data, fresh = measured(None), measured(None, seed=2, m=30)
    warm, other = rng.uniform(18.0, 24.0, 60), rng.uniform(18.0, 24.0, 30)
    moved = (
        replace(each, positions=each.positions + np.outer(kelvin - warm.mean(), [0.2, 0.1]))
        for each, kelvin in ((data, warm), (fresh, other))
    )
    shifted, holdout = (replace(each, temperature=kelvin) for each, kelvin in zip(moved, (warm, other), strict=True))
    given, missing = (diagnose(ARM, shifted, rows) for rows in (holdout, replace(holdout, temperature=None)))
    assert given.where == "temperature"
    assert not any("temperature_C" in note for note in given.warnings)
    assert any(note.startswith("hold-out: temperature_shift needs the column") for note in missing.warnings)
