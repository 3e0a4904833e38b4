"""Fits that are no results: links that flip, data in another frame; and postures outside the joint limits.

Search against scipy for models with effects, and from a poor start.
"""

from dataclasses import replace

import numpy as np
import pytest

from identification import Arm, DHRow, EffectSpec, Measurements, Model, Status, chain_of, estimate
from identification.arm import Machining
from identification.estimation.doubts import FAR, another_frame, far_rows, flipped, outside_limits, payload_of_several
from identification.inspection.inspection import inspect
from identification.instruments import Tracker
from identification.model.placed import with_sessions
from tests.identification.estimation.cases import LENGTHS, SIGMA, TRUTH, arm, data, plan, scipy_fit
from tests.identification.inspection.test_inspection import points
from tests.small_arm import drawn_arm


def moved(measurements: Measurements, shift: tuple[float, float], turn: float = 0.0) -> Measurements:
    """The same positions in a frame that is shifted [mm] and turned [rad]."""
    turned = measurements.positions @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return replace(measurements, positions=turned + np.array(shift))


def test_data_in_the_frame_of_a_tracker_are_offered_a_base_offset() -> None:
    measured = moved(data(Model(arm()), plan(30)), (2500.0, -800.0), 1.2)
    found = estimate(Model(arm()), measured)
    assert found.status is Status.implausible
    assert found.doubts[0].startswith("implausible: the fit leaves ")
    assert 'add [[effects]] name = "base_offset"' in " ".join(found.doubts)
    assert str(found).startswith("implausible: ")
    assert not str(found).endswith("Converged.")
    taken = estimate(Model(arm(EffectSpec("base_offset"))), measured)
    assert (taken.status, taken.doubts) == (Status.converged, ())
    np.testing.assert_allclose(taken.parameters[8:], [2500.0, -800.0], atol=0.3)
    # any rotation is the offset of joint 1
    assert abs(taken.joint_offsets[0] - (TRUTH[4] + 1.2)) < 0.002


def test_residuals_that_the_given_noise_explains_are_not_doubted() -> None:
    """A tenth of the reach: no doubt if that is the noise of the arm file, another arm if that is smaller."""
    sigma = 0.1 * float(np.sum(LENGTHS))
    measured = data(Model(arm()), plan(50))
    noise = sigma * np.random.default_rng(3).standard_normal(measured.positions.shape)
    noisy = replace(measured, positions=measured.positions + noise)
    words = {s: " ".join(estimate(Model(replace(arm(), sigma=s)), noisy).doubts) for s in (sigma, 0.1 * sigma)}
    assert ["implausible: the fit leaves" in said for said in words.values()] == [False, True]


def test_a_small_offset_of_the_base_and_chance_are_no_other_frame() -> None:
    """The RMS must fall to half, significantly; an offset of the size of the noise does less. With 4 degrees of freedom
    left two more parameters often halve the residuals of pure noise."""
    assert another_frame(Model(arm()), moved(data(Model(arm()), plan(60)), (0.08, 0.08))) == []
    found = [another_frame(Model(arm()), data(Model(arm()), plan(7, seed), seed)) for seed in range(100)]
    assert sum(map(bool, found)) < 5  # 1 % of 100, with Poisson's error
    one = data(Model(arm()), plan(1)).rows(np.zeros(30, dtype=int))  # one row again and again: what is left is rounding
    assert another_frame(Model(arm()), one) == []


def test_what_a_known_effect_does_is_no_other_frame() -> None:
    """Everything moves 1 mm/K along x, 3 K above the mean temperature of the identification: by 3 mm."""
    moves = arm(EffectSpec("temperature_shift", None, {"v1": 1.0, "v2": 0.0, "v3": 0.0}))
    shifted = moved(replace(data(Model(arm()), plan(30)), temperature=np.full(30, 23.0), reference=20.0), (3.0, 0.0))
    assert another_frame(Model(arm()), shifted) != []
    assert another_frame(Model(moves), shifted) == []
    assert another_frame(Model(moves), moved(shifted, (3.0, 0.0))) != []


def test_far_rows_are_told_by_all_that_is_measured_and_by_what_each_row_scatters_by() -> None:
    """By hand: the third of five poses is 0.1 mm off as all are, and 4 mrad, 4 mm at 1 m; its own sigma is half."""
    posed = Arm(replace(chain_of([DHRow(300.0, 0.0, 0.0)]), instrument=Tracker(1000.0)))
    residual, single = np.zeros((5, 6)), np.arange(5) == 2
    residual[:, 0], residual[2, 5] = 0.1, 4.0
    rows = Measurements(np.arange(5.0)[:, None], residual)
    own = 0.1 - 0.05 * single
    for sigma, times in ((None, "40 times the median of"), (own, "80 times the median of the others (relative to the")):
        (said,) = far_rows(residual, replace(rows, sigma=sigma), posed, single, np.zeros(5, dtype=bool))
        assert said.startswith(f"row 3: up to 0.1 mm and 0.2292 deg off, {times}")


def test_where_a_payload_hangs_is_said_where_it_follows_from_the_order_of_the_rows() -> None:
    loaded = drawn_arm().with_effects(EffectSpec("joint_compliance", 2))
    rows, first = Measurements(np.zeros((1, 6)), [[0.0] * 3]), next(iter(loaded.chain.tools))
    (said,) = payload_of_several(Model(loaded), rows)
    assert said.startswith(f"the payload is taken to hang at measured point {first}, the first")
    placed = replace(loaded, gravity=replace(loaded.gravity, payload_at=np.zeros(3)))
    for other in (placed, drawn_arm(), replace(loaded, chain=replace(CHAIN, tools={"1": np.eye(4)}))):
        assert payload_of_several(Model(other), rows) == []


def test_a_link_of_another_length_is_implausible() -> None:
    found = estimate(Model(Arm((260.0, 180.0, 120.0, 30.0))), data(Model(arm()), plan(30)))  # the last is 100 mm long
    assert found.status is Status.implausible
    assert found.doubts == ("implausible: link 4 of 30 mm comes out 100.7 mm long; another arm, frame or unit?",)
    assert found.to_json()["status"] == "implausible"


def test_many_frames_a_little_off_are_plausible_and_one_that_is_far_off_is_not() -> None:
    model = Model(drawn_arm())
    shifts = np.array([p.kind == "translation_error" for p in model.parameters])
    first, length = int(np.argmax(shifts)), f"{0.11 * model.reach:.4g} mm"
    for values in (shifts / np.sqrt(shifts.sum()), np.eye(len(shifts))[first]):
        assert not flipped(model, 0.09 * model.reach * values, shifts)
        (said,) = flipped(model, 0.11 * model.reach * values, shifts)
        assert f"{length} from the drawing, most in " in said
    assert f"{model.names[first]}: {length};" in said


def test_postures_outside_the_joint_limits_are_counted() -> None:
    narrow = Arm(LENGTHS, lower=np.radians([-90, -180, -180, -180]), upper=np.radians([90, 180, 180, 180]), sigma=SIGMA)
    q = np.radians([[10.0, 190.0, 0, 0], [-90.005, 0, 0, 0], [-91.0, 0, 0, 0], [0, 0, 0, 0], [100.0, 0, 0, 0]])
    (sentence,) = outside_limits(narrow, Measurements(q, np.zeros((5, 2))))
    # joint 2 has the limits of an arm file without any
    first = "row 3: joint 1 at -91 deg, allowed -90 to 90"
    assert sentence == f"2 of 5 postures lie outside the joint limits, the first in {first}"
    assert outside_limits(narrow, Measurements(q[:2], np.zeros((2, 2)))) == []


# -- columns that look swapped, which a spatial fit hides in errors of the geometry ------------------------------------
QUARTER = np.pi / 2.0
ELBOW = ((0.0, QUARTER, 300.0), (-500.0, 0.0, 0.0), (-400.0, 0.0, 0.0), (0.0, QUARTER, 150.0), (0.0, -QUARTER, 100.0))
TABLE = (*ELBOW, (0.0, 0.0, 80.0))
CHAIN = chain_of([DHRow(*row) for row in TABLE])


def six_axes(m: int = 40, spread: float = 0.5) -> Measurements:
    """Of an arm as drawn, but for its zeros, written with 4 x 4 matrices; 0.05 mm of noise."""
    generator = np.random.default_rng(17)
    q = generator.uniform(-spread, spread, (m, 6)) + np.array([0.4, -1.0, 1.2, -0.7, 0.9, 0.3])
    seen = points(q + np.radians([0.0, 0.1, -0.1, 0.05, 0.1, -0.1]), np.array([40.0, 30.0, 60.0]), TABLE)
    return Measurements(q, seen + np.array([900.0, -300.0, 200.0]) + generator.normal(0.0, 0.05, (m, 3)))


@pytest.mark.parametrize(("shift", "names", "said"), [(1.0, "AA", True), (1.0, "AB", False), (0.0, "AA", False)])
def test_a_reflector_that_was_mounted_again_is_to_have_another_name(shift: float, names: str, said: bool) -> None:
    rows, half = six_axes(), 20
    here, there = (points(rows.postures[half:], np.array([x, 30.0, 60.0]), TABLE) for x in (40.0, 40.0 + shift))
    labels = {key: np.repeat([*of], half) for key, of in (("session", "12"), ("marker", names))}
    rows = replace(rows, positions=rows.positions + np.vstack([np.zeros((half, 3)), there - here]), **labels)
    drawn = Arm(CHAIN)
    for sentences in (estimate(Model(with_sessions(drawn, rows)), rows).doubts, inspect(drawn, rows).problems):
        moved_points = [sentence for sentence in sentences if sentence.startswith("measured points moved")]
        assert len(moved_points) == said
    assert not said or all(words in moved_points[0] for words in ("falls by more than half if", "(column marker)"))


def test_swapped_columns_are_said_where_the_fit_hides_them() -> None:
    good, model = six_axes(), Model(Arm(CHAIN))
    hidden = estimate(model, replace(good, postures=good.postures[:, [0, 1, 2, 4, 3, 5]]))
    assert hidden.rms_after < FAR * model.reach  # too little to be implausible by that
    assert hidden.status is Status.implausible
    assert any("columns of joints 4 and 5 are swapped" in said and "armcal check" in said for said in hidden.doubts)


def test_more_postures_are_to_turn_the_flange() -> None:
    """It turned by a twentieth of a degree, whatever the number of rows: base and measured point move together."""
    found = estimate(Model(Arm(CHAIN)), six_axes(60, 1e-3))
    assert any("measure others, which turn the flange about all its axes" in said for said in found.warnings)


def test_machining_decides_how_far_corrections_go() -> None:
    found = estimate(Model(Arm(CHAIN, sigma=0.05, machining=Machining(1e-6, 1e-9))), six_axes(60))
    held = [k for k, name in enumerate(found.names) if name in found.model.prior]
    assert np.abs(found.parameters[held]).max() < 1e-5
    assert Model(Arm(replace(CHAIN, fixed=frozenset({"translation_x:2"})))).prior == {}


# -- closed form and search against scipy ------------------------------------------------------------------------------
MODELS = {
    "eccentricity": (EffectSpec("encoder_eccentricity", 2),),
    "two": (EffectSpec("encoder_second_harmonic", 3), EffectSpec("gear_ratio", 1)),
    "compliance": (EffectSpec("joint_compliance"),),
    "bending": (EffectSpec("link_bending"), EffectSpec("base_offset")),
    "thermal": (EffectSpec("thermal_growth"), EffectSpec("base_drift")),
    "backlash": (EffectSpec("backlash", 2), EffectSpec("axes_skew")),
    "ripple": (EffectSpec("transmission_ripple", 1, {"k": 7.0}), EffectSpec("base_rotation_drift")),
}


def same(model: Model, measurements: Measurements, weights: np.ndarray | None = None) -> None:
    found = estimate(model, measurements, None if weights is None else weights**-0.5)
    other = scipy_fit(model, measurements, weights)
    assert found.status is Status.converged
    # both are stationary to 1e-9 of the residuals; scipy's bounded search stops at about 1e-6 mm from a bound
    np.testing.assert_allclose(found.parameters * model.scales, other.x * model.scales, rtol=0, atol=3e-6)
    assert found.rms_after > 0.01
    w = np.ones(len(measurements)) if weights is None else weights
    assert np.sum(w[:, None] * found.residuals_after**2) <= 2.0 * other.cost * (1.0 + 1e-10)


@pytest.mark.parametrize("name", MODELS)
def test_equals_scipy(name: str) -> None:
    model = Model(arm(*MODELS[name]))
    same(model, data(model, plan(40)))
    if name in ("eccentricity", "compliance"):
        same(model, data(model, plan(40)), np.random.default_rng(5).uniform(0.1, 10.0, 40))


def test_poor_start_without_the_closed_form_is_damped() -> None:
    """With one length known the closed form is no start; offsets of 40 degrees must still be found."""
    model = Model(arm(), held={"length_error:1": 0.0})
    true = np.r_[-0.6, -0.4, 0.7, np.radians([40.0, -40.0, 30.0, -30.0])]
    found = estimate(model, Measurements(plan(20), model.position(plan(20), true)))
    assert (found.status, found.method) == (Status.converged, "levenberg_marquardt")
    np.testing.assert_allclose(found.parameters, true, rtol=0, atol=1e-9)
