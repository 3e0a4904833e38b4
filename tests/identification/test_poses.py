"""Measured poses, d = 6, against products of exponentials in numpy, finite differences and hidden parameters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification import Arm, Calibration, Measurements, Model, estimate, load_measurements
from identification.files.arm import load_arm, with_calibration
from identification.files.measurement import measurement_text
from identification.inspection.readings import data_warnings
from identification.model.minimal import minimal
from identification.model.placed import placed_model
from identification.running import Status
from identification.simulate import simulate
from identification.validate import validate
from tests.identification.exponentials import TABLE, Exponentials, drawing

SIGMA, SIGMA_DEG = 0.05, 0.01
SCALE = SIGMA / np.radians(SIGMA_DEG)
SIX = Arm(replace(drawing(), angle_scale=SCALE), sigma=SIGMA)
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
    inverted = estimate(Model(SIX), replace(data, orientations=np.swapaxes(data.orientations, 1, 2)))
    assert inverted.status is Status.implausible  # no file is written, though points may be near
    assert f"orientations {inverted.to_json()['rms_after_deg']:.3g} deg off" in inverted.warnings[0]


def test_residuals_are_rotation_vectors() -> None:
    """Against scipy's logarithm of computed times measured."""
    generator = np.random.default_rng(3)
    arm = Exponentials(generator)
    data = measured(arm, 5, generator, 100.0)
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
    (tmp_path / "out.toml").write_text(with_calibration(TEXT, found.calibration()))
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
    plain = replace(arm, chain=replace(arm.chain, angle_scale=None))
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
    angles = Rotation.from_matrix(data.orientations).as_euler("xyz")  # about fixed axes
    fixed = replace(data, orientations=Rotation.from_euler("XYZ", angles).as_matrix())
    assert "look like angles about fixed axes" in data_warnings(fixed, SIX)[0]
    inverse = replace(data, orientations=np.swapaxes(data.orientations, 1, 2))
    assert "look like the instrument in the frame of the tool;" in data_warnings(inverse, SIX)[0]
