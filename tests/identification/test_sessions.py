"""Several sessions: pooled tables, and a base for each session, against complex numbers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification import (
    Arm,
    DHRow,
    EffectSpec,
    InputError,
    Measurements,
    Model,
    chain_of,
    estimate,
    rms_distance,
    without_prior,
)
from identification.inspection.readings import data_warnings
from identification.instruments import Tracker
from identification.kinematics.frames import pose, rotation_about
from identification.measurements import pooled_sessions
from identification.model.placed import minimal, placed_model, with_sessions, without_sessions
from identification.replications import ModelTable, Replications, StudyFile, TruthTable, true_values
from identification.validate import drawing_residuals
from tests.identification.estimation.cases import tip

LENGTHS = np.array([300.0, 200.0, 150.0])
ERRORS, OFFSETS = np.array([1.0, -0.5, 0.3]), np.radians([0.4, -0.6, 0.2])
BASES = [(0.02, 3.0 - 2.0j), (2.5, -400.0 + 900.0j), (-1.2, 80.0 + 10.0j)]  # turn [rad] and shift [mm]


def session(number: int, m: int = 20, **columns: object) -> Measurements:
    """Exact, of an arm that stands elsewhere: the base turned is joint 1 turned."""
    q, (turn, shift) = np.random.default_rng(number).uniform(-1.5, 1.5, (m, 3)), BASES[number]
    there = tip(q + OFFSETS + turn * np.eye(3)[0], LENGTHS + ERRORS) + np.array([shift.real, shift.imag])
    return Measurements(q, there, **columns)


def test_each_session_has_a_base_of_its_own() -> None:
    """Bases are recovered by any angle: relative to the first, rotation and shift of the tip in its frame."""
    data = pooled_sessions({f"day {k}": session(k) for k in range(3)})
    found = estimate(Model(with_sessions(Arm(LENGTHS), data)), data)
    assert found.rms_after < 1e-8
    values = dict(zip(found.names, found.parameters, strict=True))
    first = BASES[0]
    np.testing.assert_allclose(found.length_errors, ERRORS, atol=1e-8)
    np.testing.assert_allclose(found.joint_offsets, OFFSETS + np.array([first[0], 0, 0]), atol=1e-10)
    for number in (2, 3):
        turn, shift = BASES[number - 1]
        expected = [turn - first[0], (shift - first[1]).real, (shift - first[1]).imag]
        got = [values[f"session_base.{short}{number}"] for short in "wxy"]
        np.testing.assert_allclose(got, expected, atol=1e-8)


def test_the_calibration_that_is_kept_is_that_of_the_first_session() -> None:
    data = pooled_sessions({"a": session(0), "b": session(1)})
    kept = without_sessions(estimate(Model(with_sessions(Arm(LENGTHS), data)), data).calibration())
    assert not [name for name in (*kept.values, *kept.parameter_names) if name.startswith("session_base")]
    assert kept.covariance.shape == (8, 8)
    arm = Arm(LENGTHS, effects=(EffectSpec("base_offset"),), calibration=kept)
    np.testing.assert_allclose(Model(arm).position(session(0).postures), session(0).positions, atol=1e-8)


def test_one_session_changes_nothing() -> None:
    arm = Arm(LENGTHS)
    assert with_sessions(arm, session(0)) is arm
    assert with_sessions(arm, pooled_sessions({"only": session(0)})) is arm


def test_a_known_base_stays_known() -> None:
    """Where the arm file says where the base stands, that holds in the first session."""
    shift = BASES[0][1]
    arm = Arm(LENGTHS, effects=(EffectSpec("base_offset", values={"x0": shift.real, "y0": shift.imag}),))
    data = pooled_sessions({"a": session(0), "b": session(1)})
    found = estimate(Model(with_sessions(arm, data)), data)
    assert found.rms_after < 1e-8
    assert "base_offset.x0" not in found.names


def test_a_hold_out_has_the_sessions_of_the_data() -> None:
    data = pooled_sessions({"a": session(0), "b": session(1)})
    later = replace(session(1, 5), session=np.full(5, "b"))
    np.testing.assert_array_equal(later.of_sessions(data).conditions.session, 1.0)
    for other, found in ((session(1), "no column session"), (replace(later, session=np.full(5, "c")), "session 'c'")):
        with pytest.raises(InputError, match=f"holdout: found {found}, allowed: a, b, as in the data"):
            replace(other, session_names=()).of_sessions(data)
    assert later.of_sessions(session(0)).session is None


def test_pooled_tables() -> None:
    one = session(0, 3, repeats=[5, 5, 7], order=[1, 2, 3], sigma=[0.1, 0.1, 0.2])
    two = session(1, 2, repeats=[0, 5], order=[1, 2])
    with pytest.warns(UserWarning, match="left out: sigma"):
        data = pooled_sessions({"a": one, "b": two})
    assert (data.session.tolist(), data.repeats[0]) == (["a"] * 3 + ["b"] * 2, data.repeats[1])
    assert len(set(data.repeats.tolist())) == 4  # 5 in one table is not 5 in the other
    np.testing.assert_array_equal(data.conditions.time, [-0.5, 0.0, 0.5, -0.5, 0.5])
    given, plain = session(0, 3, order=[3, 1, 2], directions=-np.ones((3, 3))), session(1, 2)
    both = pooled_sessions({"a": given, "b": plain}).conditions  # nothing is lost where one table does not say it
    for name in ("time", "directions"):
        alone = [getattr(one.conditions, name) for one in (given, plain)]
        np.testing.assert_array_equal(getattr(both, name), np.concatenate(alone))
    named = replace(session(2, 2), session=np.array(["x", "y"]))
    known = {name: replace(session(0, 1), provenance={"file": f"{name}.csv", "sha256": name * 64}) for name in "ab"}
    assert dict(pooled_sessions(known).provenance) == {"file": "a.csv, b.csv", "sha256": ["a" * 64, "b" * 64]}
    assert dict(data.provenance) == {}
    assert pooled_sessions({"a": session(0, 1), "c": named}).session.tolist() == ["a", "c/x", "c/y"]
    with pytest.raises(InputError, match=r"^b: found 2 joints and 2 coordinates, allowed: 3 and 2"):
        pooled_sessions({"a": session(0), "b": Measurements(np.zeros((2, 2)), np.ones((2, 2)))})


# -- in space ----------------------------------------------------------------------------------------------------------
QUARTER = np.pi / 2.0
ROWS = [(0.0, QUARTER, 350.0), (-400.0, 0.0, 0.0), (-350.0, QUARTER, 0.0), (0.0, -QUARTER, 90.0), (0.0, 0.0, 80.0)]
CHAIN = chain_of([DHRow(*row) for row in ROWS])
STANDS = [(0.0, 0.0, 0.3), (0.2, -0.1, 2.4), (-0.3, 0.1, -1.9)]  # rotation vectors
PLACES = np.array([[900.0, -200.0, 50.0], [-1500.0, 400.0, 300.0], [100.0, 1200.0, -80.0]])
SCARA = chain_of([DHRow(*row) for row in ((300, 0, 200), (250, 0, 0), (0, 0, 0, 0, "prismatic", (0, 200)))])
REFLECTORS = {"top": np.array([60.0, 20.0, 50.0]), "side": np.array([-70.0, 10.0, 40.0])}
SLIPS = {"joint_offset:2": 0.004, "translation_x:3": 0.6, "rotation_x:4": -0.003, "translation_y:5": -0.4}


def in_space(number: int, reflector: str) -> Measurements:
    """One session of poses by frames multiplied in numpy, exact."""
    q = np.random.default_rng(10 + number).uniform(-2.0, 2.0, (30, 5))
    stands, frames = Rotation.from_rotvec(STANDS[number]).as_matrix(), []
    for row in q:
        frame = pose(PLACES[number], stands)
        for j, ((a, alpha, d), angle) in enumerate(zip(ROWS, row, strict=True), start=1):
            shift = [SLIPS.get(f"translation_{axis}:{j}", 0.0) for axis in "xyz"]
            turn = angle + SLIPS.get(f"joint_offset:{j}", 0.0)
            frame = frame @ pose(shift, rotation_about([1, 0, 0], SLIPS.get(f"rotation_x:{j}", 0.0)))
            frame = frame @ pose(rotation=rotation_about([0, 0, 1], turn)) @ pose((0.0, 0.0, d)) @ pose((a, 0.0, 0.0))
            frame = frame @ pose(rotation=rotation_about([1, 0, 0], alpha))
        frames.append(frame @ pose(REFLECTORS[reflector], rotation_about([0, 1, 0], 0.5)))
    at = np.array(frames)
    return Measurements(q, at[:, :3, 3], marker=[reflector] * 30, orientations=at[:, :3, :3])


def test_sessions_of_a_spatial_arm() -> None:
    """Three set-ups of base and instrument, the third with another reflector: one geometry explains all, and the bases
    stand to one another as they were put. Without noise all of it is exact but for the prior's pull."""
    parts = {"a": in_space(0, "top"), "b": in_space(1, "top"), "c": in_space(2, "side")}
    data = pooled_sessions(parts)
    arm = Arm(replace(CHAIN, instrument=Tracker(300.0)), sigma=1e-4)
    assert data_warnings(data, arm) == []
    found = estimate(minimal(placed_model(Model(with_sessions(arm, data)), data)), data)
    assert found.rms_after < 1e-6 < 0.1 < rms_distance(drawing_residuals(arm, data)[:, :3])  # of slips of 0.6 mm
    assert len(found.names) == 4 * 5 + 6 * 2 + 2 * 6  # axes, two tools, two bases more
    values = found.model.best_known | found.model.parameters.mapping(found.parameters)
    for number in (2, 3):
        shift = [values[f"session_base.{axis}{number}"] for axis in "xyz"]
        turn = Rotation.from_euler("XYZ", [values[f"session_base.w{axis}{number}"] for axis in "xyz"])
        first = found.geometry.real.base
        later = pose(first[:3, 3] + shift, first[:3, :3] @ turn.as_matrix())
        true = [pose(place, Rotation.from_rotvec(v).as_matrix()) for place, v in zip(PLACES, STANDS, strict=True)]
        # where the base's frame is along and about joint 1's axis is a choice, the same in each session
        np.testing.assert_allclose(later @ np.linalg.inv(first), true[number - 1] @ np.linalg.inv(true[0]), atol=1e-5)
    stands = Model(replace(arm, chain=found.model.arm.chain, calibration=without_sessions(found.calibration())))
    left = parts["a"].positions - stands.position(parts["a"].postures, conditions=parts["a"].conditions)
    assert np.abs(left).max() < 1e-5
    points = replace(parts["b"], positions=parts["b"].positions[:, :3], orientations=None)
    with pytest.warns(UserWarning, match="left out: orientations"):
        mixed = pooled_sessions({"a": parts["a"], "b": points})
    assert mixed.dimension == 3


def test_the_drawing_has_no_choice_of_parameters() -> None:
    """Of an arm whose base is given: that of joint 1 is none of the drawing, which may stand anywhere."""
    arm = Arm(replace(SCARA, settled=frozenset({"base", "tool"})), sigma=0.1)
    q = np.random.default_rng(3).uniform(arm.lower, arm.upper, (12, 3))
    data = Measurements(q, Model(arm).position(q))
    chosen = minimal(Model(arm)).arm
    assert "translation_z:1" in chosen.chain.fixed
    np.testing.assert_allclose(drawing_residuals(chosen, data), 0.0, atol=1e-6)


# -- replications ------------------------------------------------------------------------------------------------------
TABLE_ROWS = [DHRow(0.0, np.pi / 2.0, 300.0), DHRow(400.0, 0.1, 20.0), DHRow(350.0, -1.0, 10.0)]
DRAWN = replace(chain_of(TABLE_ROWS), tools={"1": np.array([40.0, 30.0, 20.0])})
ELBOW = Arm(DRAWN, sigma=0.05, name="elbow")
SIZES = {"translation_x:2": 0.4, "translation_y:3": -0.3, "rotation_y:3": 0.1, "base.x": 2.0}
PLANAR = Arm([300.0, 200.0], sigma=0.1)
OFF = TruthTable(name="off", length_errors_mm=[1.0, -0.5], joint_offsets_deg=[0.2, -0.1])


def test_true_values_put_the_point_where_the_truth_does() -> None:
    """Without noise the fitted set, which is smaller than that of the errors, ends at the positions of all of them."""
    model, truth = Model(without_prior(ELBOW)), Model(TruthTable(name="machined", values=SIZES).of(ELBOW))
    assert len(model.names) < len(truth.names)
    postures = np.random.default_rng(5).uniform(-3.0, 3.0, (30, 3))
    found = model.position(postures, true_values(model, truth))
    np.testing.assert_allclose(found, truth.position(postures), atol=1e-5)


def test_fits_are_those_of_every_data_set_by_itself() -> None:
    """With the same noise: `estimate` of each; deviations by eq. 16 at the true values."""
    data_sets = Replications.of(ModelTable(name="geometry").of(PLANAR), OFF.of(PLANAR))
    postures = np.random.default_rng(1).uniform(-3.0, 3.0, (7, 2))
    errors, rss, deviations = data_sets.fits(postures, 0.1, np.random.default_rng(2), 4)
    noise, model = 0.1 * np.random.default_rng(2).standard_normal((4, 7, 2)), data_sets.model
    for k in range(4):
        fit = estimate(model, Measurements(postures, data_sets.truth.position(postures) + noise[k]))
        np.testing.assert_allclose(errors[k, :4], fit.parameters - data_sets.values, rtol=0.0, atol=1e-9)
        assert rss[k] == pytest.approx(float(np.sum(fit.residuals_after**2)))
    jacobian = model.jacobian(postures, data_sets.values).reshape(-1, 4)
    covariance = data_sets.transform @ (0.01 * np.linalg.inv(jacobian.T @ jacobian)) @ data_sets.transform.T
    np.testing.assert_allclose(deviations**2, np.diag(covariance), rtol=1e-7)
    assert [name for name, _, _ in data_sets.reported][4:] == ["orientation_offset:1", "orientation_offset:2"]


def test_a_name_stands_once() -> None:
    with pytest.raises(InputError, match="models: name 'a' is given twice, allowed: once"):
        StudyFile.of({"arms": ["a"], "plans": ["dft"], "models": [{"name": "a"}, {"name": "a"}]})
