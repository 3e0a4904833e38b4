"""Values to type in: planar ones against the parameters that they are made of, frames against scipy's rotations.

The corrected Denavit-Hartenberg table of a fit: it computes what the fit does, with deviations of its covariance.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from identification import Arm, Calibration, DHRow, EffectSpec, Identification, Measurements, Model, chain_of, estimate
from identification.documents.identification import corrected_section, corrected_table
from identification.estimation.problem import Prior
from identification.estimation.result import CorrectedValue, corrected_values, dh_lines, dh_table
from identification.files.arm import load_arm, with_effects
from identification.instruments import Tracker
from identification.kinematics.chain import drawn_links
from identification.kinematics.frames import pose
from tests.identification.estimation.cases import LENGTHS, arm, data, plan
from tests.identification.kinematics.test_spatial import UR10, row_of_table

HALF = np.pi / 2.0
CHAIN = chain_of([DHRow(0.0, HALF, 127.3), DHRow(-612.0, 0.0, 0.0), DHRow(0.0, -HALF, 90.0, offset=np.pi)])
FREE = ("translation_x:2", "translation_y:2", "translation_z:2", "rotation_x:2", "rotation_y:2")


def by_name(rows: tuple[CorrectedValue, ...]) -> dict[str, CorrectedValue]:
    return {row.name: row for row in rows}


def test_planar_values_are_the_drawing_with_its_errors() -> None:
    model = Model(arm(EffectSpec("encoder_eccentricity", 2)))
    found = estimate(model, data(model, plan(30)))
    rows, errors = by_name(found.corrected_values), dict(zip(found.names, found.parameters, strict=True))
    for j, length in enumerate(LENGTHS, start=1):
        row = rows[f"length of link {j}"]
        assert (row.nominal, row.unit, row.parameter) == (length, "mm", f"length_error:{j}")
        assert row.corrected == pytest.approx(length + errors[f"length_error:{j}"], abs=1e-12)
        assert rows[f"zero of joint {j}"].corrected == pytest.approx(np.degrees(errors[f"joint_offset:{j}"]))
        assert f"add to the zero of joint {j}" in rows[f"zero of joint {j}"].convention
    for row, listed in zip(found.corrected_values, found.to_json()["parameters"], strict=True):
        assert row.parameter == listed["name"]
        assert row.corrected is not None
        assert row.low_95 == pytest.approx(listed["low_95"] + row.corrected - listed["value"])
        assert row.high_95 == pytest.approx(listed["high_95"] + row.corrected - listed["value"])


def test_what_is_not_estimable_has_no_value_and_what_is_held_no_interval() -> None:
    at_zero = replace(data(Model(arm()), plan(30)), postures=np.zeros((30, 4)))
    rows = by_name(estimate(Model(arm(), {"length_error:1": 1.5, "length_error:2": 0.0}), at_zero).corrected_values)
    held, lost = rows["length of link 1"], rows["length of link 3"]
    assert (held.corrected, held.std, held.low_95) == (LENGTHS[0] + 1.5, None, None)
    assert (lost.corrected, lost.std, lost.high_95) == (None, None, None)
    assert "length of link 2" not in rows  # as drawn


def test_frames_in_space_by_scipy() -> None:
    """Place and angles of a frame, and their standard deviations by finite differences, with scipy's rotations."""
    generator, factors = np.random.default_rng(3), np.array([1.0, 1.0, 1.0, 0.01, 0.01])
    root = generator.standard_normal((5, 5)) * factors[:, None]
    values = generator.standard_normal(5) * factors
    found = Calibration(dict(zip(FREE, values.tolist(), strict=True)), FREE, root @ root.T)
    rows = by_name(corrected_values(Arm(CHAIN), found))
    origin = CHAIN.joints[1].origin
    drawn = Rotation.from_matrix(origin[:3, :3])

    def numbers(x: np.ndarray) -> np.ndarray:
        turn = drawn * Rotation.from_euler("XYZ", [x[3], x[4], 0.0])
        return np.r_[origin[:3, 3] + drawn.apply(x[:3]), turn.as_euler("xyz", degrees=True)]

    slopes = np.column_stack([(numbers(values + h) - numbers(values - h)) / 2e-5 for h in 1e-5 * np.eye(5)])
    deviations = np.sqrt(np.diag(slopes @ root @ root.T @ slopes.T))
    keys = [f"joint 2 {axis}" for axis in ("x", "y", "z", "roll", "pitch", "yaw")]
    assert [rows[key].corrected for key in keys] == pytest.approx(numbers(values), abs=1e-9)
    assert [rows[key].nominal for key in keys] == pytest.approx(numbers(np.zeros(5)), abs=1e-9)
    printed = {cells[0]: float(cells[2]) for cells in corrected_table([*rows.values()]).rows}
    assert [printed[key] for key in keys] == pytest.approx(numbers(values), abs=6e-6)  # however uncertain each is
    upright = replace(rows[keys[0]], name="base ry", corrected=-89.0)
    assert "only known together" in str(corrected_section("", [upright]).parts)
    assert [rows[key].std for key in keys] == pytest.approx(deviations, rel=1e-6)
    assert [rows[key].high_95 - rows[key].corrected for key in keys] == pytest.approx(1.959963985 * deviations)  # type: ignore[operator]


angle = st.floats(-np.pi, np.pi)
small = st.floats(-0.02, 0.02)


@settings(max_examples=30, deadline=None)
@given(st.tuples(angle, angle | st.sampled_from([HALF, -HALF, HALF - 1e-9, 1.57]), angle), st.tuples(small, small))
@example((-HALF, HALF, 0.0), (0.0, 0.005))  # once said: roll -90 -> -180, yaw 0 -> 90
@example((0.0, HALF, 0.0), (0.005, 0.003))
def test_corrected_angles_are_near_the_drawing_and_make_the_rotation(
    drawn: tuple[float, float, float], errors: tuple[float, float]
) -> None:
    """However a frame is drawn: errors of a degree are rows of a few degrees, with an interval, and of nothing else.

    Within 5 deg of gimbal lock 1 deg may be 1 / sin 5 deg = 11.5 deg of roll: from there on the rows are turns from
    the drawing.
    """
    turned = CHAIN.joints[1].origin.copy()
    turned[:3, :3] = Rotation.from_euler("xyz", drawn).as_matrix()
    joints = (CHAIN.joints[0], replace(CHAIN.joints[1], origin=turned), CHAIN.joints[2])
    found = Calibration(dict(zip(FREE[3:], errors, strict=True)), FREE[3:], np.diag([1e-8, 1e-8]))
    rows = by_name(corrected_values(Arm(replace(CHAIN, joints=joints)), found))
    real = turned[:3, :3] @ Rotation.from_euler("XYZ", [*errors, 0.0]).as_matrix()
    upright = abs(np.degrees(np.arcsin(np.clip(turned[2, 0], -1.0, 1.0)))) > 85.0
    keys = ("rx", "ry", "rz") if upright else ("roll", "pitch", "yaw")
    at = np.array([rows[key].corrected if (key := f"joint 2 {axis}") in rows else 0.0 for axis in keys], dtype=float)
    nominal = np.array([rows[key].nominal if (key := f"joint 2 {axis}") in rows else 0.0 for axis in keys], dtype=float)
    missing = [axis for axis in keys if f"joint 2 {axis}" not in rows]  # as drawn, and known to be so
    made = Rotation.from_euler("XYZ" if upright else "xyz", at, degrees=True).as_matrix()
    made = turned[:3, :3] @ made if upright else made
    if upright or not missing:
        np.testing.assert_allclose(made, real, atol=1e-12)
    assert np.max(np.abs(at - nominal)) <= np.degrees(np.linalg.norm(errors)) * (1.05 if upright else 13.0) + 1e-9
    assert all(rows[f"joint 2 {axis}"].std is not None for axis in keys if axis not in missing)
    notes = str(corrected_section("", [*rows.values()]).parts)
    assert ("rotation of its frame from the drawing" in notes) == (upright and len(missing) < 3)


@pytest.mark.parametrize("deviation", [0.1, 0.547, 0.549, 1.0])
def test_values_that_only_the_prior_holds_are_marked(deviation: float) -> None:
    """Of one link, m rows measure the length along it: the variance falls from s^2 to 1 / (1 / s^2 + m / sigma^2), to
    more than a quarter where m s^2 < 3 sigma^2."""
    m, model = 10, Model(Arm([300.0], sigma=1.0))
    q = np.linspace(-3.0, 3.0, m)[:, None]
    noise = np.random.default_rng(3).normal(0.0, 1.0, (m, 2))
    rows = Measurements(q, 300.0 * np.column_stack([np.cos(q), np.sin(q)]) + noise)
    found = estimate(model, rows, prior=Prior({"length_error:1": deviation}), sigma="given")
    length = by_name(found.corrected_values)["length of link 1"]
    assert length.prior_std == pytest.approx(deviation)
    assert length.std == pytest.approx((deviation**-2.0 + m) ** -0.5, rel=1e-9)
    assert length.weak is (weak := m * deviation**2 < 3.0)
    assert by_name(found.corrected_values)["zero of joint 1"].prior_std is None
    section = corrected_section("", found.corrected_values)
    shown = corrected_table(found.corrected_values).rows[0][0], str(section.parts)
    assert ("*" in shown[0], "* 1 of 2 are weakly determined" in shown[1]) == (weak, weak)


@pytest.mark.parametrize("kind", ["given", "scatter", "sandwich"])
def test_a_calibrated_file_has_the_intervals_of_its_fit(kind: str, tmp_path: Path) -> None:
    """Whatever they rely on: Student's t of 12 rows is 12 % wider than the normal distribution."""
    model, generator = Model(Arm([260.0, 180.0, 120.0], sigma=0.1)), np.random.default_rng(8)
    q = generator.uniform(-2.0, 2.0, (8, 3))[np.arange(24) % 8]
    bent = 0.4 * np.sin(3.0 * q[:, :2]) if kind == "sandwich" else 0.0
    rows = Measurements(q, model.position(q) + bent + 0.1 * generator.standard_normal((24, 2)))
    found = estimate(model, rows, sigma={"scatter": "estimated", "given": "given"}.get(kind))
    assert found.uncertainty.kind == kind
    text = "links_mm = [260.0, 180.0, 120.0]\n[measurement]\nsigma_mm = 0.1\n"
    (tmp_path / "arm.toml").write_text(with_effects(text, calibration=found.calibration()))
    for row, kept in zip(found.corrected_values, corrected_values(load_arm(tmp_path / "arm.toml")), strict=True):
        assert (kept.low_95, kept.high_95) == pytest.approx((row.low_95, row.high_95), rel=1e-5, abs=1e-9)


@cache
def fitted() -> Identification:
    model, generator = Model(Arm(chain_of(UR10), sigma=0.05)), np.random.default_rng(4)
    parameters = model.parameters
    truth = 0.3 * parameters.vector(model.prior, default=0.0) * generator.standard_normal(len(parameters))
    truth[[parameters.index(f"tool[1].{axis}") for axis in "xyz"]] = [60.0, 30.0, 80.0]
    q = generator.uniform(-2.5, 2.5, (40, 6))
    return estimate(model, Measurements(q, model.position(q, truth) + generator.normal(0.0, 0.05, (40, 3))))


def test_table_base_and_tool_say_what_the_fit_does() -> None:
    found, arm = fitted(), fitted().calibrated_arm()
    arm = replace(arm, chain=replace(arm.chain, instrument=Tracker(300.0)))
    values, lines, frames = dh_lines(arm, ())
    rows = {row.name: row.corrected for row in values}
    numbers = [[*map(float, line.partition(": ")[2].replace(",", "").split()[2::3])] for line in lines]
    np.testing.assert_allclose([[*at.values()] for at in frames.values()], numbers, rtol=0.0, atol=6e-6)
    base, tool = (pose(x[:3], Rotation.from_euler("XYZ", x[3:], degrees=True).as_matrix()) for x in numbers)
    for posture in np.random.default_rng(5).uniform(-2.0, 2.0, (4, 6)):
        at = base
        for j, (row, q) in enumerate(zip(UR10, posture, strict=True), start=1):
            drawn = {"theta": np.degrees(row.offset), "d": row.d, "a": row.a, "alpha": np.degrees(row.alpha), "beta": 0}
            number = {name: rows.get(f"row {j} {name}", value) for name, value in drawn.items()}
            theta, alpha, beta = np.radians([number[name] for name in ("theta", "alpha", "beta")])
            at = at @ row_of_table(q + theta, number["d"], number["a"], alpha, beta)
        at, off = at @ tool, 3 * 0.5e-5 * np.radians(1.0)  # rounding of three angles, at most 1.5 m away
        np.testing.assert_allclose(at[:3, 3], found.model.position(posture[None], found.parameters)[0], 0, 1600.0 * off)
        np.testing.assert_allclose(at[:3, :3], Model(arm).orientations(posture[None])[0], rtol=0, atol=2.0 * off)


def test_deviations_are_the_covariance_through_central_differences() -> None:
    """Along its principal axes, a tenth of their deviations to both sides: of the third order of that is 1e-3 left."""
    found, drawn = fitted(), drawn_links(UR10)
    assert found.geometry is not None
    squares, axes = np.linalg.eigh(found.covariance)
    moved = []
    for step in 0.1 * (axes * np.sqrt(np.maximum(squares, 0.0))).T:
        for values in (found.parameters + step, found.parameters - step):
            named = {**found.geometry.values, **dict(zip(found.names, values, strict=True))}
            links = found.geometry.chain.corrected(named).corrected_links(drawn)[0]
            moved.append([links[1].a, np.degrees(links[1].beta or 0.0), links[3].d, np.degrees(links[4].theta)])
    rows = {row.name: row for row in dh_table(found.calibrated_arm())[0]}
    stds = [rows[name].std for name in ("row 2 a", "row 2 beta", "row 4 d", "row 5 theta")]
    expected = np.linalg.norm(np.subtract(moved[::2], moved[1::2]), axis=0) / 0.2
    assert stds == pytest.approx(expected.tolist(), rel=1e-2)
