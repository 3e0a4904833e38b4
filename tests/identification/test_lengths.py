"""Arms measured by lengths, a ball bar's distances and contacts with spheres and planes: what these show, and fits.

What is lost is counted by hand. A reflector on six axes shows 27 parameters (the literature: 4 for each axis, 3 of the
point); of the six that place the arm, distances from one center show where that is, contacts with a plane its height
and two tilts: 24. On a plane nothing has a length: an arm twice as large, twice as far away, touches at the same
postures: 23.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification import (
    Arm,
    Array,
    Calibration,
    Identification,
    Measurements,
    Model,
    Status,
    diagnose,
    estimate,
    load_measurements,
    spectrum,
)
from identification.files.arm import load_arm, with_effects
from identification.files.measurement import measurement_text
from identification.inspection.readings import data_warnings
from identification.instruments import Distance, Instrument, Plane, Sphere, Tracker
from identification.kinematics.chain import CorrectedGeometry
from identification.kinematics.frames import pose
from identification.model.placed import minimal, placed_model, practical, with_sessions
from identification.simulate import simulate
from identification.validate import validate
from tests.doe.six_axis import CHAIN, REFLECTOR
from tests.identification.exponentials import TABLE, Exponentials, drawing, plane, sphere, touching
from tests.identification.kinematics.test_spatial import tip_by_exponentials

BAR = Distance()
CENTER = np.array([700.0, -200.0, 300.0])
BASE = pose(-CENTER)
STEP = 1e-5  # [mm, rad] of central differences of some 1e3 mm: rounding 1e3 * 1e-16 / 1e-5 = 1e-8, error of order 1e-10


@pytest.mark.parametrize("instrument", [BAR, Plane(), Sphere(30.0)], ids=["distance", "plane", "ball"])
def test_jacobian(instrument: Instrument) -> None:
    """Against differences of products of exponentials."""
    chain, radius = replace(CHAIN, base=BASE), 30.0 if instrument.kind == "sphere" else 0.0
    model = Model(Arm(replace(chain, instrument=instrument)))
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (4, 6))
    read, jacobian = model.linearize(q)

    def by_hand(posture: Array, name: str = "", step: float = 0.0) -> float:
        point = tip_by_exponentials(chain, posture, {name: step}, REFLECTOR)
        return float((point[2] if instrument.kind == "plane" else np.linalg.norm(point)) - radius)

    for row, posture in enumerate(q):
        assert read[row, 0] == pytest.approx(by_hand(posture))
        for k, name in enumerate(model.names):
            slope = (by_hand(posture, name, STEP) - by_hand(posture, name, -STEP)) / (2.0 * STEP)
            assert jacobian[row, 0, k] == pytest.approx(slope, abs=1e-6 * model.scales[k])
    np.testing.assert_array_equal(model.position(q), read)


def test_distances_show_24_parameters() -> None:
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (200, 6))
    model = Model(Arm(replace(CHAIN, instrument=BAR, base=BASE), sigma=0.01))
    assert model.dimension == 1
    assert not {"base.rx", "base.ry", "base.rz", "joint_offset:1"} & set(model.names)
    assert spectrum(model.jacobian(q), model.scales).rank == len(minimal(model).names) == 24


def fit(arm: Arm, q: Array, lengths: Array, session: Array | None = None) -> Identification:
    data = Measurements(q, lengths[:, None], session=session)
    return estimate(Model(with_sessions(arm, data)), data)


def test_a_bar_in_two_sockets() -> None:
    """Each session has a center of its own; what is left is the noise, and another session is predicted as well."""
    generator = np.random.default_rng(4)
    truth, q = Exponentials(generator), generator.uniform(-2.0, 2.0, (240, 6))
    centers = np.array([[600.0, 300.0, 200.0], [-300.0, 700.0, 500.0], [500.0, -500.0, 100.0]])
    number = np.arange(240) // 80
    places = truth.base[:3, 3] + centers[number] @ truth.base[:3, :3].T
    read = np.linalg.norm(truth.poses(q)[:, :3, 3] - places, axis=1) + 0.01 * generator.standard_normal(240)
    arm = Arm(replace(drawing(), instrument=BAR), sigma=0.01)
    session, first = np.array(["a", "b", "c"])[number], number < 2
    found = fit(arm, q[first], read[first], session[first])
    assert found.status is Status.converged
    assert "session_base.x2" in found.names
    assert "session_base.wx2" not in found.names
    assert found.chi2 == pytest.approx(found.dof, abs=4.0 * np.sqrt(2.0 * found.dof))
    geometry = CorrectedGeometry(found.model.arm.chain, found.model.parameters.mapping(found.parameters))
    np.testing.assert_array_equal(geometry.real.base[:3, :3], np.eye(3))
    again = validate(found.calibrated_arm(), Measurements(q[~first], read[~first, None]))
    assert again.model.rms < 0.015 < 0.5 < again.nominal.rms


def test_contacts_with_planes() -> None:
    """Three planes of unknown place, one of them level and one upright: what is left is the noise, and the size of the
    arm stays open: 23 parameters of one plane, and 3 more of each other."""
    generator = np.random.default_rng(6)
    truth, qs = Exponentials(generator), []
    for normal, height in (((0.1, 0.05, 1.0), 200.0), ((1.0, 0.02, -0.03), 500.0), ((0.0, 1.0, 0.0), 400.0)):
        qs.append(touching(truth, plane(np.array(normal), height), 60, generator))
    q, session = np.concatenate(qs), np.repeat(["floor", "wall", "side"], 60)
    arm = Arm(replace(drawing(), instrument=Plane()), sigma=0.01)
    found = fit(arm, q, 0.01 * generator.standard_normal(180), session)
    assert found.status is Status.converged
    assert found.rms_after < 0.012 < 0.5 < found.rms_before
    assert sum(name.startswith("session_base") for name in found.names) == 6
    exact = fit(arm, qs[0], np.zeros(60))
    fixed = exact.model.jacobian(qs[0], exact.parameters)
    # the postures touch to 1e-8 mm of 1e3 mm, and so does the fit: the size shows by no more than that
    assert spectrum(fixed, exact.model.scales, 1e-7).rank == 23


def test_a_minimal_set_of_contacts_is_what_the_surfaces_show() -> None:
    """At the postures that touch them: elsewhere a plane would show the arm's size, too. The longest step is none of
    them: where readings do not fit, an arm next to nothing would fit better."""
    generator = np.random.default_rng(7)
    truth, surface = Exponentials(generator), plane(np.array([0.1, 0.2, 1.0]), 200.0)
    other = touching(truth, plane(np.array([1.0, 0.0, 0.0]), 500.0), 30, generator)
    q = np.concatenate([other, touching(truth, surface, 80, generator)])
    data = Measurements(q, np.zeros((110, 1)), session=np.repeat(["a", "b"], [30, 80]))
    names = Model(practical(Arm(replace(drawing(), instrument=Plane()), sigma=0.01), data)).names
    assert len(names) == 23
    assert "translation_x:3" not in names


@pytest.mark.parametrize("error", [0.0, 1e-3])
def test_planes_do_not_shrink_the_arm(error: float) -> None:
    """With nothing hidden, and with an error of joint 3 by the angle of joint 2, which has no name."""
    generator = np.random.default_rng(1)
    truth, qs = Exponentials(generator), []
    for normal, height in (((0.0, 0.0, 1.0), 100.0), ((1.0, 0.02, -0.03), 500.0), ((0.0, 1.0, 0.0), 400.0)):
        qs.append(touching(truth, plane(np.array(normal), height), 50, generator))
    q, session = np.concatenate(qs), np.repeat(["a", "b", "c"], 50)
    q[:, 2] += error * np.cos(q[:, 1]) * np.cos(q[:, 2])
    arm = Arm(replace(drawing(), instrument=Plane()), sigma=0.02)
    found = diagnose(arm, Measurements(q, 0.02 * generator.standard_normal((150, 1)), session=session))
    assert found.verdict == ("unknown" if error else "none")
    assert found.misfit is not None
    assert found.misfit.ratio < 5.0
    assert found.gap.to_json()["rms_after_mm"] < 0.06


def test_an_effect_is_named_by_contacts_alone() -> None:
    """Joint 3 reads what an encoder off center does. A contact has no position, and none is asked for."""
    generator = np.random.default_rng(8)
    q = touching(Exponentials(generator), sphere(np.array([600.0, -200.0, 300.0]), 30.0), 90, generator)
    q[:, 2] += 8e-4 * np.cos(q[:, 2]) + 3e-4 * np.sin(q[:, 2])
    arm = Arm(replace(drawing(), instrument=Sphere(30.0)), sigma=0.01)
    found = diagnose(arm, Measurements(q, 0.01 * generator.standard_normal((90, 1))))
    assert found.named.effects == ("encoder_eccentricity:3",)


# -- poses -------------------------------------------------------------------------------------------------------------
SIGMA, SIGMA_DEG = 0.05, 0.01
SCALE = SIGMA / np.radians(SIGMA_DEG)
SIX = Arm(replace(drawing(), instrument=Tracker(SCALE)), sigma=SIGMA)
HIDDEN = {"base.x": 1500.0, "base.rx": 0.3, "base.rz": 2.0, "tool[1].x": 40.0, "tool[1].z": 50.0, "tool[1].ry": 0.7}


def measured(arm: Exponentials, count: int, generator: np.random.Generator, noise: float = 1.0) -> Measurements:
    q = generator.uniform(-2.5, 2.5, (count, 6))
    poses, errors = arm.poses(q), noise * generator.standard_normal((2, count, 3))
    turns = Rotation.from_rotvec(np.radians(SIGMA_DEG) * errors[1]).as_matrix()
    return Measurements(q, poses[:, :3, 3] + SIGMA * errors[0], orientations=turns @ poses[:, :3, :3])


def test_an_arm_of_another_parametrization() -> None:
    """Points and orientations of fresh postures to the noise of 30 parameters from 40 poses."""
    generator = np.random.default_rng(2)
    arm = Exponentials(generator)
    data, fresh = measured(arm, 40, generator), measured(arm, 100, generator, 0.0)
    assert data_warnings(data, SIX) == []
    found = estimate(minimal(placed_model(Model(SIX), data)), data)
    assert len(found.names) == 30  # four for each of six axes, six of the frame
    assert found.dof == 6 * 40 - 30
    assert found.p_value > 0.01
    left = fresh.positions - found.model.position(fresh.postures, found.parameters, fresh.conditions)
    expected = SIGMA * np.sqrt(3.0 * 30 / (6 * 40))  # of three coordinates, for a plan as good as random ones
    assert np.sqrt(np.mean(np.sum(left[:, :3] ** 2, axis=1))) < 2.0 * expected
    assert np.sqrt(np.mean(np.sum(left[:, 3:] ** 2, axis=1))) < 2.0 * expected
    assert found.rms_angles is not None
    assert found.to_json()["rms_after_deg"] == pytest.approx(np.sqrt(3.0) * SIGMA_DEG, rel=0.2)
    tight = estimate(Model(replace(SIX, chain=replace(SIX.chain, instrument=Tracker(4.0 * SCALE)))), data).misfit
    assert re.search(r"of positions [01]\.\d+ times, of orientations [34]\.\d+ times sigma_deg", tight or "")
    inverted = estimate(Model(SIX), replace(data, orientations=np.swapaxes(data.orientations, 1, 2)))
    assert inverted.status is Status.implausible  # no file is written, though points may be near
    assert f"orientations {inverted.to_json()['rms_after_deg']:.3g} deg off" in inverted.warnings[0]


def test_residuals_are_rotation_vectors() -> None:
    """Against scipy's logarithm of computed times measured."""
    generator = np.random.default_rng(3)
    data = measured(Exponentials(generator), 5, generator, 100.0)
    model = placed_model(Model(SIX), data)
    values = 1e-3 * generator.standard_normal(len(model.names)) / model.scales * 300.0
    position = model.position(data.postures, values, data.conditions)
    truth = replace(model.arm, calibration=Calibration(model.parameters.mapping(values)))
    computed = Model(truth).orientations(data.postures)
    turns = Rotation.from_matrix(computed @ np.swapaxes(data.orientations, 1, 2)).as_rotvec()
    np.testing.assert_allclose(position[:, 3:], SCALE * turns, atol=1e-9)


def test_without_measurements_the_jacobian_is_the_angular_velocity() -> None:
    """Of the arm as best known, in which the instrument's axes turn; the noise is the same in all directions."""
    model = Model(replace(SIX, calibration=Calibration(HIDDEN)))
    q = np.random.default_rng(4).uniform(-2.0, 2.0, (4, 6))
    np.testing.assert_allclose(model.position(q)[:, 3:], 0.0, atol=1e-12)
    start = model.orientations(q)
    for k in range(0, len(model.names), 9):
        name = model.names[k]
        step = 1e-6 if name.startswith(("base.r", "tool[1].r", "rotation", "joint")) else 1e-3
        moved = Model(replace(SIX, calibration=Calibration({**HIDDEN, name: HIDDEN.get(name, 0.0) + step})))
        vectors = Rotation.from_matrix(moved.orientations(q) @ np.swapaxes(start, 1, 2)).as_rotvec()
        np.testing.assert_allclose(model.jacobian(q)[:, 3:, k], SCALE * vectors / step, atol=2e-3)  # SCALE 1e-6


# -- files -------------------------------------------------------------------------------------------------------------
ROWS = "".join(f"[[dh]]\na_mm = {a}\nalpha_deg = {np.degrees(alpha):.12g}\nd_mm = {d}\n" for a, alpha, d in TABLE[:5])
TEXT = f'kind = "spatial"\n{ROWS}[measurement]\nsigma_mm = 0.05\nsigma_deg = 0.01\n'


def five_axes(folder: Path) -> tuple[Arm, Measurements]:
    (folder / "arm.toml").write_text(TEXT)
    arm = load_arm(folder / "arm.toml")
    truth = replace(arm, calibration=Calibration({**HIDDEN, "joint_offset:3": 0.002, "translation_x:4": 0.4}))
    generator = np.random.default_rng(7)
    return arm, simulate(truth, generator.uniform(-2.5, 2.5, (40, 5)), generator)


def test_files_round_trip(tmp_path: Path) -> None:
    """Measurements, a calibrated arm with its frame, and what it predicts of other poses."""
    arm, data = five_axes(tmp_path)
    (tmp_path / "data.csv").write_text(measurement_text(data))
    read = load_measurements(tmp_path / "data.csv", arm)
    np.testing.assert_allclose(read.orientations, data.orientations, atol=1e-13)
    found = estimate(Model(arm), read)
    (tmp_path / "out.toml").write_text(with_effects(TEXT, calibration=found.calibration()))
    back = load_arm(tmp_path / "out.toml")
    fresh = np.random.default_rng(8).uniform(-2.0, 2.0, (10, 5))
    one, other = Model(found.calibrated_arm()), Model(back)
    np.testing.assert_allclose(other.position(fresh), one.position(fresh), atol=1e-9)
    np.testing.assert_allclose(other.orientations(fresh), one.orientations(fresh), atol=1e-12)
    for refit in ("base", "none"):
        there = validate(back, data, refit)
        assert there.model.rms == pytest.approx(found.rms_after, rel=0.05)
        assert there.to_json()["rms_deg"] == pytest.approx(found.to_json()["rms_after_deg"], rel=0.05)
        assert there.to_json()["rms_nominal_deg"] > 0.02
    assert there.notes[0].startswith("orientations: RMS 0.01")


def test_points_alone_will_do(tmp_path: Path) -> None:
    """An arm file with sigma_deg, measurements without orientations: as without sigma_deg."""
    arm, data = five_axes(tmp_path)
    points = replace(data, positions=data.positions[:, :3], orientations=None)
    plain = replace(arm, chain=replace(arm.chain, instrument=Tracker()))
    np.testing.assert_array_equal(estimate(Model(arm), points).parameters, estimate(Model(plain), points).parameters)
    (tmp_path / "data.csv").write_text(measurement_text(data))
    with pytest.warns(UserWarning, match="orientations are used where the arm file gives measurement.sigma_mm and"):
        assert load_measurements(tmp_path / "data.csv", plain).dimension == 3
    (tmp_path / "arm.toml").write_text(TEXT.replace("sigma_mm = 0.05\n", ""))
    with pytest.warns(UserWarning, match=r"measurement.sigma_deg: found without sigma_mm: orientations are not used"):
        load_arm(tmp_path / "arm.toml")


def test_another_convention_is_said() -> None:
    generator = np.random.default_rng(9)
    data = measured(Exponentials(generator), 60, generator)
    turns = Rotation.from_matrix(data.orientations)
    columns = {  # rx, ry, rz, by conventions of controllers
        "angles about fixed axes": turns.as_euler("xyz"),
        "angles about z, then y, then x": turns.as_euler("ZYX"),
        "rotation vectors": turns.as_rotvec(),
        "angles in radians": np.radians(turns.as_euler("XYZ")),
        "rotation vectors in radians": np.radians(turns.as_rotvec()),
        "the instrument in the frame of the tool": turns.inv().as_euler("XYZ"),
        "the instrument in the frame of the tool, by rotation vectors": turns.inv().as_rotvec(),
    }
    read = {words: Rotation.from_euler("XYZ", angles) for words, angles in columns.items()}
    # what is read as x, y, z, w where qw, qx, qy, qz hold x, y, z, w
    read["quaternions in the order x, y, z, w"] = Rotation.from_quat(turns.as_quat()[:, [1, 2, 3, 0]])
    for words, as_read in read.items():
        said = data_warnings(replace(data, orientations=as_read.as_matrix()), SIX)
        assert f"they look like {words};" in said[0]
    assert data_warnings(data, SIX) == []
