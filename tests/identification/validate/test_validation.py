"""Validation: exact transfer to another set-up, and the closed form of a rigid motion of the drawing as oracle.

A model that is offered beside the geometry alone: figures of `validate`, and what no effect gains.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from identification import (
    PRISMATIC,
    REVOLUTE,
    DHRow,
    Identification,
    InputError,
    Model,
    Status,
    chain_of,
    diagnose,
    estimate,
)
from identification.arm import Arm, Calibration, EffectSpec, ErrorCurve
from identification.compensate import compensate
from identification.documents.identification import BEYOND, ZEROS
from identification.estimation.doubts import left_out_residuals
from identification.estimation.uncertainty import chance_of_gain
from identification.gap.library_prior import library_prior
from identification.inspection.readings import read_differently
from identification.kinematics.chain import KinematicChain
from identification.kinematics.counting import joint_range
from identification.kinematics.frames import from_angles, pose
from identification.measurements import Measurements, distances, pooled_sessions, rms_distance
from identification.model.placed import with_sessions
from identification.validate import Figures, beside_geometry, drawing_residuals, judged, prior_judged, validate
from tests.doe.six_axis import CHAIN, REFLECTOR
from tests.identification.kinematics.test_spatial import tip_by_exponentials
from tests.small_arm import drawn_arm, measured, random_postures, small_arm

LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])
ERRORS, OFFSETS = np.array([1.5, -0.6, -0.4, 0.7]), np.radians([0.5, -0.5, 0.7, -0.3])
A, B = 0.002, -0.001  # [rad] of an eccentric encoder at joint 2


def tip(q: np.ndarray, turn: float = 0.0, shift: complex = 0.0) -> np.ndarray:
    """The real arm, standing turned and shifted in the frame of the measurements."""
    angles = q + OFFSETS
    angles[:, 1] += A * np.cos(q[:, 1]) + B * np.sin(q[:, 1])
    z = ((LENGTHS + ERRORS) * np.exp(1j * np.cumsum(angles, axis=1))).sum(axis=1)
    z = np.exp(1j * turn) * z + shift
    return np.column_stack([z.real, z.imag])


def postures(m: int, seed: int, width: float = 1.5) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-width, width, (m, 4))


def calibrated(*effects: EffectSpec) -> Arm:
    calibration = Calibration.of(ERRORS, OFFSETS, {"encoder_eccentricity:2.a": A, "encoder_eccentricity:2.b": B})
    return Arm(LENGTHS, effects=(EffectSpec("encoder_eccentricity", 2), *effects), calibration=calibration)


def rigid(computed: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """(m,) distances left by the best rotation and shift of computed points: the angle has a closed form."""
    one, two = (values @ [1.0, 1.0j] for values in (computed, measured))
    one, two = one - one.mean(), two - two.mean()
    along = np.sum(np.conj(one) * two)
    return np.abs(two - along / abs(along) * one)


@pytest.mark.parametrize("effects", [(), (EffectSpec("base_offset"),)])
def test_a_right_model_predicts_another_set_up(effects: tuple[EffectSpec, ...]) -> None:
    """Turned by 150 degrees and a metre away: the file's model needs no base offset of its own for it."""
    q = postures(40, 0)
    found = validate(calibrated(*effects), Measurements(q, tip(q, np.radians(150.0), 800.0 - 600.0j)))
    assert found.model.max < 1e-9
    values = {entry["name"]: entry["value"] for entry in found.to_json()["refitted"]}
    placed = [values[name] for name in ("base_offset.x0", "base_offset.y0", "joint_offset:1")]
    assert placed == pytest.approx([800.0, -600.0, 150.5], abs=1e-9)


def test_a_row_beside_all_others_is_named() -> None:
    """It moves the base that is fitted, too, and with it the RMS of a model that is right."""
    q, off = postures(40, 0), 50.0 * (np.arange(40) == 6)[:, None]
    found = validate(calibrated(), Measurements(q, tip(q) + off))
    assert [note.partition(",")[0] for note in found.notes if "contact" in note] == [
        f"row 7: up to {found.model.max:.4g} mm off"
    ]


def test_a_gain_within_what_the_rows_scatter_by_is_said() -> None:
    """Noise far above the errors hides what the model gains; a tenth of them does not."""
    q = postures(40, 0)
    for sigma, by_chance in ((8.0, True), (0.02, False)):
        measured = tip(q, 0.0, 0.0) + np.random.default_rng(3).normal(0.0, sigma, (40, 2))
        found = validate(calibrated(), Measurements(q, measured))
        after, before = (float(np.sum(r**2)) for r in (found.residuals, found.nominal_residuals))
        said = [note for note in found.notes if "may be chance" in note]
        assert bool(said) == by_chance
        assert ("% of the error is removed, which may be chance" in str(found)) == by_chance
        assert all(f"{100.0 * (after / before) ** 0.5:.0f} % of the RMS error of the drawing" in note for note in said)
        assert after < before


def test_figures_of_the_drawing_are_those_of_a_rigid_motion() -> None:
    q = postures(60, 1)
    measured = tip(q, 0.3, 20.0j) + np.random.default_rng(2).normal(0.0, 0.1, (60, 2))
    drawn = (LENGTHS * np.exp(1j * np.cumsum(q, axis=1))).sum(axis=1)
    left = rigid(np.column_stack([drawn.real, drawn.imag]), measured)
    data = validate(calibrated(), Measurements(q, measured)).to_json()
    assert (data["rows"], data["refit"]) == (60, "base")
    plain = validate(calibrated(), Measurements(q, tip(q) + np.array([0.3, 0.4])), "none")  # nothing is refitted
    assert plain.model == Figures(*[pytest.approx(0.5)] * 4)
    assert plain.to_json()["refitted"] == []
    assert [note.partition(" refitted")[0] for note in plain.notes] == ["with the base"]
    at_rest = Measurements(q, tip(q) + np.random.default_rng(2).normal(0.0, 0.1, (60, 2)))
    assert not validate(calibrated(), at_rest, "none").notes
    assert data["rms_nominal_mm"] == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-9)
    assert data["mean_nominal_mm"] == pytest.approx(np.mean(left), rel=1e-6)  # flat in the parameters to first order
    after = rigid(tip(q), measured)
    assert data["rms_mm"] == pytest.approx(np.sqrt(np.mean(after**2)), rel=1e-9)
    assert (data["p95_mm"], data["max_mm"]) == pytest.approx((np.percentile(after, 95), np.max(after)), rel=1e-6)
    figures = [np.sqrt(np.mean(after**2)), np.mean(after), np.percentile(after, 95), np.max(after)]
    row = re.sub(r" data-heading=\"[^\"]*\"", "", validate(calibrated(), Measurements(q, measured))._repr_html_())
    assert "<td>model</td>" + "".join(f"<td>{value:.4f}</td>" for value in figures) in row


def test_offsets_refit_every_joint_offset() -> None:
    q = postures(50, 3)
    noise = np.random.default_rng(4).normal(0.0, 0.1, (50, 2))
    measured = tip(q + np.array([0.1, -0.02, 0.03, 0.01]), shift=5.0) + noise

    def residuals(p: np.ndarray) -> np.ndarray:
        angles = q + p[:4]
        angles[:, 1] += A * np.cos(q[:, 1]) + B * np.sin(q[:, 1])
        z = ((LENGTHS + ERRORS) * np.exp(1j * np.cumsum(angles, axis=1))).sum(axis=1) + p[4] + 1j * p[5]
        return (measured - np.column_stack([z.real, z.imag])).ravel()

    oracle = least_squares(residuals, np.r_[OFFSETS, 0.0, 0.0], xtol=1e-14, ftol=1e-14)
    found = validate(calibrated(), Measurements(q, measured), "offsets")
    assert found.model.rms == pytest.approx(np.sqrt(2.0 * oracle.cost / 50), rel=1e-9)


def test_zeros_that_moved_leave_more_than_the_file_promises() -> None:
    """After a motor was changed, the base as it was; not where other rows are as good, or noisier by half."""
    q, noise = postures(120, 5), np.random.default_rng(8).normal(0.0, 0.1, (120, 2))
    arm = estimate(Model(calibrated()), Measurements(q[:80], (tip(q) + noise)[:80])).calibrated_arm()
    for moved, times in ((0.0, 1.0), (0.0, 1.5), (0.005, 1.0), (0.0, 4.0)):
        rows = Measurements(q[80:], (tip(q + moved * np.eye(4)[2]) + times * noise)[80:])
        for refit in ("base", "offsets", "none"):
            found = validate(arm, rows, refit)
            said = [note for note in found.notes if BEYOND in note]
            assert len(said) == (moved > 0.0 or times > 2.0)
            assert any(ZEROS in note for note in said) is (moved > 0.0)
            assert 0.14 < found.promised < 0.2  # of two coordinates, each with 0.1 mm


def test_each_session_has_its_own_base() -> None:
    q, session = postures(40, 6), np.array(["first"] * 15 + ["second"] * 25)
    measured = np.concatenate([tip(q[:15], 0.2, 100.0), tip(q[15:], -1.0, -50.0j)])
    found = validate(calibrated(), Measurements(q, measured, session=session))
    assert found.model.max < 1e-9
    assert validate(calibrated(), Measurements(q, measured)).model.rms > 10.0
    blocks = {(b["kind"], b["name"]): b["rows"] for b in found.to_json()["blocks"]}
    assert (blocks["session", "first"], blocks["session", "second"]) == (15, 25)
    entries = found.to_json()["refitted"]
    assert {(e["session"], e["name"]): e["value"] for e in entries}["second", "base_offset.y0"] == pytest.approx(-50.0)


def test_rows_outside_the_identified_range_are_said() -> None:
    q = postures(30, 9, 0.5)
    arm = estimate(Model(Arm(LENGTHS)), Measurements(q, tip(q))).calibrated_arm()
    other = q.copy()
    other[4, 2] = 1.5
    found = validate(arm, Measurements(other, tip(other)))
    assert any("1 of 30 rows are outside the angles" in note and "joint 3 in 1" in note for note in found.notes)
    blocks = {b["name"]: b["rows"] for b in found.to_json()["blocks"] if b["kind"] == "range"}
    assert blocks == {"inside": 29, "outside": 1}
    assert not validate(arm, Measurements(q, tip(q, 0.1))).notes
    # the rows of the identification, whatever file they are in, and some of them among others
    for count, said in ((30, "says nothing about others"), (18, "about 60 %"), (9, "about 30 %")):
        assert said in str(validate(arm, Measurements(q, tip(q, 0.1 * (np.arange(30) >= count)))).notes)


def test_missing_columns_and_the_same_file_are_said() -> None:
    q, growth = postures(30, 10), EffectSpec("thermal_growth")
    arm = calibrated(growth)
    known = replace(arm.calibration, values={**arm.calibration.values, "thermal_growth.a": 1e-5})
    arm = replace(arm, calibration=replace(known, provenance={"sha256": "same"}))
    notes = validate(arm, Measurements(q, tip(q), provenance={"sha256": "same"})).notes
    assert any("identified from" in note for note in notes)
    assert any("thermal_growth needs the column temperature_C" in note for note in notes)


def test_temperature_counts_from_the_mean_of_the_identification() -> None:
    """One file at 20 degrees, another at 25: the arm is longer by 5 K in every row of the second."""
    q, growth = postures(20, 11), 1e-4
    arm = calibrated(EffectSpec("thermal_growth"))
    values = {**arm.calibration.values, "thermal_growth.a": growth}
    arm = replace(arm, calibration=Calibration(values, provenance={"mean_temperature_C": 20.0}))
    found = validate(arm, Measurements(q, tip(q) * (1.0 + 5.0 * growth), temperature=np.full(20, 25.0)), "none")
    assert found.model.max < 1e-9


@pytest.mark.parametrize(
    ("arm", "m", "refit", "sentence"),
    [
        (calibrated(), 9, "all", "refit: unknown name 'all'"),
        (Arm(LENGTHS), 9, "base", "calibration: the arm has none, allowed: an arm file written by"),
        (calibrated(), 1, "base", "too few for 3 refitted parameters, 1 in all, allowed: at least 2 rows"),
        (Arm(LENGTHS[:2], calibration=Calibration.of([1, 1], [0, 0])), 9, "base", "4 joints .* 2 links, allowed: 2"),
    ],
)
def test_what_cannot_be_validated(arm: Arm, m: int, refit: str, sentence: str) -> None:
    q = postures(m, 12)
    with pytest.raises(InputError, match=sentence):
        validate(arm, Measurements(q, tip(q)), refit)


@pytest.mark.parametrize("at", [0.0, 1.65])
def test_what_happened_in_one_session_is_over_in_the_next(at: float) -> None:
    """A zero that jumped in the middle of the session, or between the second and the third, stays where it is: another
    session sees the arm after the jump, as targets do."""
    step = EffectSpec("joint_step", 2, {"at": at, "b": 2e-3})
    arm = Arm([400.0, 300.0], effects=(EffectSpec("base_offset"), step), calibration=Calibration.of([0, 0], [0, 0]))
    after = Arm([400.0, 300.0], calibration=Calibration.of([0.0, 0.0], [0.0, 2e-3]))
    postures = np.random.default_rng(5).uniform(-2.0, 2.0, (40, 2))
    data = Measurements(postures, Model(after).position(postures))
    assert validate(arm, data, refit="base").model.rms < 1e-6
    reached = Model(after).position(compensate(arm, data.positions, data.postures).commands)
    np.testing.assert_allclose(reached, data.positions, atol=1e-6)
    same = validate(arm, data, refit="none")  # the same session: half of its rows are before the jump
    assert same.model.rms > 0.1
    assert "joint_step:2: these rows are assumed to be that session from beginning to end" in same.notes


# -- curves with the geometry that was fitted with them ---------------------------------------------------------------
ROWS = [DHRow(0.0, np.pi / 2.0, 300.0), DHRow(400.0, 0.1, 20.0), DHRow(350.0, -1.0, 10.0), DHRow(0.0, 1.0, 60.0)]


def test_another_set_up_keeps_the_geometry_of_curves_in_space() -> None:
    """A chain with an error of the size of a joint zero, seen by a tracker that stands elsewhere and calls the
    reflector by another name: inside the curve's angles as it is, beyond them without the curve and what belongs to it,
    by models that have no curve at all. Products of two small errors are left: 1e-3 rad x 1 mm."""
    rng = np.random.default_rng(6)
    chain = replace(chain_of(ROWS), tools={"1": np.array([40.0, 30.0, 20.0])})
    chain = replace(chain, base=pose((900.0, -400.0, 200.0), from_angles((0.4, -0.3, 1.1))))
    names = [p.name for p in chain.parameters()]
    values = {name: (2e-3 if ":" in name and "transl" not in name else 0.5) * rng.normal() for name in names}
    values |= {"joint_offset:2": 0.9, "rotation_x:3": 0.02, "base.rx": 1e-3, "base.ry": 2e-3, "base.rz": -1e-3}
    own = {
        name: (5e-4 if ".r" in name or "offset" in name or "rotat" in name else 0.3) * rng.normal() for name in names
    }
    curve = ErrorCurve(-1.0, 1.0, 5e-4 * rng.normal(size=12), own)
    effects = (EffectSpec("joint_error_curve", 2, curve=curve),)
    arm = Arm(chain, effects=effects, calibration=Calibration(values))
    q = rng.uniform(-1.0, 1.0, (80, 4))
    q[40:, 1] += 2.5  # the curve ends at 1
    axes = np.array(chain.base[:3, :3]) @ [own[f"base.{axis}"] for axis in "xyz"]
    without = {name: values[name] - own[name] for name in names} | {
        f"base.{axis}": values[f"base.{axis}"] - x for axis, x in zip("xyz", axes, strict=True)
    }
    bent = q[:40] + curve.at(q[:40, 1])[:, None] * [0.0, 1.0, 0.0, 0.0]
    places = [
        Model(replace(Arm(chain), calibration=Calibration(v))).position(rows)
        for v, rows in ((values, bent), (without, q[40:]))
    ]
    there = np.concatenate(places)
    np.testing.assert_allclose(Model(arm).position(q), there, atol=1e-9)
    moved = there @ from_angles((-2.0, 0.7, 0.2)).T + [300.0, 50.0, -700.0]
    data = Measurements(q, moved, marker=np.full(80, "ball"))
    assert validate(arm, data).model.max < 5e-3
    assert validate(arm.with_effects(replace(effects[0], curve=replace(curve, geometry={}))), data).model.rms > 0.1


def test_no_row_of_a_slide_is_outside_what_it_was_identified_on() -> None:
    """Nine digits of a travel of hundreds of millimetres are fewer decimals than those of an angle."""
    chain = chain_of([DHRow(300.0, 0.0, 100.0), DHRow(0.0, 0.0, 50.0, type=PRISMATIC, limits=(0.0, 1000.0))])
    q = np.column_stack([np.linspace(-1.0, 1.0, 9), np.linspace(102.529714, 977.470693, 9)])
    arm = replace(Arm(chain), calibration=Calibration({}, provenance=joint_range(q, chain.joint_types)))
    assert not arm.outside(q).any()
    np.testing.assert_array_equal(arm.outside(q + np.array([0.0, 0.001]))[:, 1], [False] * 8 + [True])


ARM = Arm([300.0, 200.0, 150.0], effects=(EffectSpec("base_offset"),), sigma=0.05)


def session(drift: float, backlash: float, seed: int = 3, m: int = 80) -> Measurements:
    """80 rows; the base drifts [mm per session], and joint 2 has play [rad]."""
    rng = np.random.default_rng(seed)
    model = Model(ARM.with_effects(*ARM.effects, EffectSpec("base_drift"), EffectSpec("backlash", 2)))
    values = {"base_drift.vx": drift, "base_drift.vy": -drift, "backlash:2.b": backlash, "length_error:1": 0.8}
    q, order = rng.uniform(-2.5, 2.5, (m, 3)), np.arange(m, dtype=float)
    exact = model.position(q, model.parameters.vector(values), Measurements(q, np.zeros((m, 2)), order).conditions)
    return Measurements(q, exact + 0.05 * rng.standard_normal((m, 2)), order)


def parts() -> tuple[Measurements, Measurements]:
    """Two thirds of a session with a drift, and the rows between them."""
    data = session(0.6, 6e-4)
    return data.rows(np.arange(80) % 3 > 0), data.rows(np.arange(80) % 3 == 0)


def test_the_figures_are_those_of_validate_on_rows_of_another_session() -> None:
    """With a drift, which belongs to its session: the file has its end, and both say so."""
    own, held = parts()
    held = replace(held, order=np.arange(len(held)))
    found = judged(diagnose(ARM, own, held), ARM, own, held)
    assert {spec.key for spec in found.named.specs} == {"base_drift", "backlash:2"}
    extended = validate(found.extended_arm(), held)
    assert found.offered is not None
    assert found.offered["rms_mm"] == pytest.approx(extended.model.rms, rel=1e-9)
    assert found.offered["max_mm"] == pytest.approx(extended.model.max, rel=1e-9)
    geometry = validate(replace(ARM, calibration=estimate(Model(ARM), own).calibration()), held)
    assert found.offered["rms_geometry_mm"] == pytest.approx(geometry.model.rms, rel=1e-9)
    assert (found.to_json()["offered"]["rms_mm"], found.offered["refitted"]) == (found.offered["rms_mm"], True)
    assert any("base_drift" in n and "of the session of the identification" in n for n in extended.notes)


def test_rows_between_the_data_have_the_drift_of_their_time() -> None:
    """So they say what the model is worth in rows that are measured when the drift is over."""
    own, held = parts()
    found = judged(diagnose(ARM, own, held), ARM, own, held)
    offered, gap = found.offered, found.gap
    assert offered is not None
    assert (offered["by"], offered["refitted"], offered["better"]) == ("holdout", False, True)
    assert (offered["rms_mm"], offered["rms_geometry_mm"]) == (gap.held_out_after, gap.held_out_before)
    geometry = replace(ARM, calibration=estimate(Model(ARM), own).calibration())
    model, alone = (validate(arm, session(0.0, 6e-4, seed=9)).model.rms for arm in (found.extended_arm(), geometry))
    assert model == pytest.approx(offered["rms_mm"], rel=0.3)  # 27 rows: three standard errors
    assert alone > 1.5 * model


def test_without_a_hold_out_other_postures_say_it() -> None:
    data, few = session(0.0, 8e-4), session(0.0, 8e-4, seed=9).rows(np.arange(2))  # which say nothing
    found, two = (judged(diagnose(ARM, data, held), ARM, data, held) for held in (None, few))
    assert two.confirmed is None
    assert two.offered == found.offered
    test = next(test for test in found.cross_validation if test.transfer == "other postures")
    assert found.offered is not None
    assert (found.offered["by"], found.offered["better"]) == ("cross-validation", True)
    assert (found.offered["rms_mm"], found.offered["rms_geometry_mm"]) == (test.after_mm, test.before_mm)
    assert test.max_before_mm > test.before_mm
    assert test.to_json()["max_after_mm"] == test.max_after_mm


def test_a_gain_in_every_row_is_none_by_chance_however_the_rows_differ() -> None:
    """Of eight rows, each a group of its own: shares of what both models leave, by SciPy; and how often of two models
    that are as good one is called better, errors being normal and of sizes that differ from row to row."""
    rng = np.random.default_rng(5)
    data = Measurements(rng.uniform(-2.0, 2.0, (8, 3)), np.zeros((8, 2)))
    before = np.array([0.2, 0.3, 0.25, 0.2, 0.3, 0.2, 3.0, 0.9])
    after = before / np.array([3.0, 8.0, 5.0, 9.0, 2.0, 4.0, 5.0, 12.0])
    saved, both = before**2 - after**2, before**2 + after**2
    assert stats.ttest_1samp(saved, 0.0, alternative="greater").pvalue > 0.1
    shares = stats.ttest_1samp(saved / both, 0.0, alternative="greater")
    assert chance_of_gain(before, after, data) == pytest.approx(shares.pvalue, rel=1e-9)
    assert shares.pvalue < 1e-4
    assert chance_of_gain(before, after, data, 13) == 1.0  # of 16 numbers, which leaves them alike
    sizes = np.exp(rng.normal(size=(1000, 8, 1)))
    one, two = (np.linalg.norm(sizes * rng.normal(size=(1000, 8, 3)), axis=2) for _ in range(2))
    called = np.mean([chance_of_gain(*pair, data) <= 0.025 for pair in zip(one, two, strict=True)])
    assert called == pytest.approx(0.025, abs=0.015)  # three standard errors


def test_geometry_and_largest_error_of_residuals_by_hand() -> None:
    rng = np.random.default_rng(2)
    data, before, after = session(0.0, 0.0), rng.normal(size=(80, 2)), 0.2 * rng.normal(size=(80, 2))
    found = beside_geometry("holdout", before, after, data)
    assert found["better"]
    assert found["rms_mm"] == pytest.approx(np.sqrt(np.mean(np.sum(after**2, axis=1))))
    assert (found["max_mm"], found["max_geometry_mm"]) == (distances(after).max(), distances(before).max())
    assert not beside_geometry("holdout", after, before, data)["better"]
    again = before + 0.01 * rng.normal(size=(80, 2))
    assert not beside_geometry("holdout", before, again, data)["better"]  # within chance


@pytest.mark.parametrize("compliant", [True, False])
def test_a_prior_of_further_effects_is_judged_beside_the_geometry(compliant: bool) -> None:
    """Of 24 postures: where the arm sags the library's effects help, where nothing is missing they do not."""
    rng, arm = np.random.default_rng(6), drawn_arm()
    truth = small_arm(rng, compliance=np.array([0.0, 2e-4, 1e-4, 0.0, 0.0, 0.0]) * compliant)
    data = measured(truth, random_postures(24, rng), rng)
    library = library_prior(arm, data, names=["joint_compliance", "backlash"])
    found = estimate(Model(library.arm), data, prior=library.prior)
    offered = prior_judged(lambda: estimate(Model(arm), data), left_out_residuals(found, data), data)
    assert offered is not None
    assert (offered["by"], offered["rows"], offered["better"]) == ("cross-validation", 72, compliant)


def test_on_its_own_rows_a_drift_is_as_it_was_fitted() -> None:
    """What `validate` leaves of them is what the fit left; on other rows the drift has come to its end."""
    q, time = postures(40, 5), np.linspace(-0.5, 0.5, 40)
    positions = tip(q) + np.outer(time, [2.0, -1.0]) + 0.1 * np.random.default_rng(5).standard_normal((40, 2))
    specs = [EffectSpec(name) for name in ("base_offset", "base_drift")]
    rows = Measurements(q, positions)
    fit = estimate(Model(Arm(LENGTHS, effects=(EffectSpec("encoder_eccentricity", 2, {"a": A}), *specs))), rows)
    calibrated_arm = fit.calibrated_arm()
    assert calibrated_arm.calibration.effects["encoder_eccentricity:2.a"] == A  # which was known
    assert validate(calibrated_arm, rows).model.rms == pytest.approx(fit.rms_after, rel=1e-6)
    assert validate(calibrated_arm, replace(rows, positions=positions + 0.01)).model.rms > 2.0 * fit.rms_after


# -- a reflector that was mounted anew ---------------------------------------------------------------------------------
NOISE = 0.02  # [mm]
POINTS = {"A": REFLECTOR, "B": np.array([-90.0, 70.0, 120.0])}
SIX_AXES = Arm(replace(CHAIN, tools={"1": np.zeros(3)}), name="six-axis")
MOVED = np.array([1.0, -0.5, 2.0])
SLIDE = DHRow(275.0, np.pi, 0.0, type="prismatic", limits=(0.0, 200.0))
SCARA = chain_of([DHRow(0.0, 0.0, 300.0), DHRow(325.0, 0.0, 0.0), SLIDE, DHRow(0.0, 0.0, 50.0)], "modified")


def cell(
    sessions: int,
    moved: dict[tuple[int, str], np.ndarray],
    seed: int,
    marked: bool = True,
    chain: KinematicChain = CHAIN,
) -> Measurements:
    """Sessions of 30 postures with one or both of the points, of an arm that is off by some tenths, set up anew each
    time; points moved by (session, name)."""
    generator = np.random.default_rng(seed)
    errors = {f"translation_{axis}:{j}": generator.normal(0.0, 0.2) for j in range(2, len(chain) + 1) for axis in "xz"}
    limits = np.transpose([(-2.0, 2.0) if j.type == REVOLUTE else (j.lower, j.upper) for j in chain.joints])
    tables = {}
    for k in range(sessions):
        turn, shift = Rotation.random(random_state=generator).as_matrix(), generator.uniform(-2e3, 2e3, 3)
        q = np.repeat(generator.uniform(*limits, (30, len(chain))), 2 if marked else 1, axis=0)
        names = np.tile(["A", "B"] if marked else ["A"], 30)
        tools = [POINTS[name] + moved.get((k, name), 0.0) for name in names]
        tips = np.array([tip_by_exponentials(chain, row, errors, tool) for row, tool in zip(q, tools, strict=True)])
        positions = tips @ turn.T + shift + NOISE * generator.standard_normal(tips.shape)
        tables[f"day {k + 1}"] = Measurements(q, positions, marker=names if marked else None)
    return pooled_sessions(tables)


def fit(data: Measurements, arm: Arm = SIX_AXES) -> Identification:
    return estimate(Model(with_sessions(arm, data)), data)


def test_a_point_that_nothing_holds_stays_near_the_arm() -> None:
    """Two places of a reflector fitted as one: the sum of squares of a SCARA falls with its height, without an end."""
    away = np.random.default_rng(2).uniform(-15.0, 15.0, 3)
    assert fit(cell(2, {(1, "A"): away}, 2, marked=False, chain=SCARA), Arm(SCARA)).status is Status.converged


def test_validation_finds_points_that_the_calibration_does_not_have() -> None:
    """Of two reflectors, calibrated on one day and another day measured by others, or by one that has no name."""
    data = cell(2, {(1, "A"): 30.0 * MOVED, (1, "B"): -20.0 * MOVED}, seed=5)
    first, second = (replace(data.rows(rows), session=None, session_names=()) for rows in data.session_rows)
    found = fit(first)
    arm = replace(found.model.arm, calibration=found.calibration())
    assert second.marker is not None
    renamed = replace(second, marker=np.char.add("new ", second.marker), marker_names=())
    only_a = second.rows(np.flatnonzero(second.marker == "A"))
    unnamed = replace(only_a, marker=None, marker_names=())
    for rows, said in (
        (renamed, "the calibration has no reflector new A, new B: their positions were fitted to these rows"),
        (unnamed, "no column marker: the rows are assumed to be of one reflector; its position was fitted to them"),
    ):
        validated = validate(arm, rows)
        # as in the data of the fit, and what its 30 parameters from 180 equations add
        assert validated.model.rms < 1.5 * found.rms_after
        assert any(note.startswith(said) for note in validated.notes)
        with pytest.raises(InputError, match=r"measurements.*marker.*; or --refit base"):
            validate(arm, rows, "none")
    assert not any("reflector" in note for note in validate(arm, second).notes)
    # the drawing stands nowhere: it is placed, wherever a second fit began
    again = fit(first, arm).calibrated_arm()
    drawn = [validate(each, first, refit).nominal.rms for each in (arm, again) for refit in ("base", "none")]
    assert drawn == pytest.approx([drawn[0]] * 4, rel=1e-6)
    of_one = validate(arm, only_a)  # of the other, which these rows have not, nothing is refitted
    assert {row["name"].partition(".")[0] for row in of_one.refitted} == {"base", "tool[A]"}
    assert not any("what is refitted" in note or "leave open" in note for note in of_one.notes)
    read = read_differently(arm, replace(unnamed, positions=10.0 * unnamed.positions), search=False)
    assert read.certain  # a file is looked at before it is validated
    assert "times those of the arm file" in read.sentences[0]


def test_points_that_are_given_stay_where_they_are() -> None:
    """The drawing is placed as a fit places the arm: with points given 7 mm beside those measured, none of both follows
    them, and the fit is nearer to its rows."""
    data, tools = cell(1, {}, seed=6), {name: at + 3.0 * MOVED for name, at in POINTS.items()}
    arm = Arm(replace(CHAIN, tools=tools, settled=frozenset({"tool"})))
    found = fit(data, arm)
    validated = validate(replace(arm, calibration=found.calibration()), data)
    assert validated.model.rms == pytest.approx(found.rms_after, rel=1e-3)
    assert validated.nominal.rms == pytest.approx(rms_distance(drawing_residuals(arm, data)))
    assert found.rms_after < validated.nominal.rms
