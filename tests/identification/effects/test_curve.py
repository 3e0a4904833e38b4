"""Smooth functions of a joint's angle, and the error curve in a model: positions, Jacobians, files, every use."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BSpline

from identification import Arm, Calibration, EffectSpec, InputError, Measurements, Model, estimate, planar_chain
from identification.arm import ErrorCurve
from identification.compensate import compensate
from identification.effects import build
from identification.files.arm import load_arm, with_effects
from identification.kinematics.frames import from_angles, pose
from identification.simulate import simulate
from identification.validate import validate
from tests.identification.exponentials import drawing
from tests.refusals import refused

VALUES = 1e-3 * np.random.default_rng(3).normal(size=12)
SMOOTH = ErrorCurve(-0.5, 1.7, VALUES)


def test_agrees_with_scipy_and_is_zero_beyond_two_nodes() -> None:
    """scipy's B-splines on the same nodes, whose values at the nodes are solved for densely."""
    h = 2.2 / 11
    knots = -0.5 + h * np.arange(-2, 15)  # of the 12 B-splines centered on the nodes, and of one beyond
    nodes = np.linspace(-0.5, 1.7, 12)
    design = np.column_stack([BSpline.basis_element(knots[k : k + 5], extrapolate=False)(nodes) for k in range(12)])
    coefficients = np.linalg.solve(np.nan_to_num(design), VALUES)
    q = np.linspace(-1.5, 2.7, 999)
    each = [BSpline.basis_element(knots[k : k + 5], extrapolate=False)(q) for k in range(12)]
    np.testing.assert_allclose(SMOOTH.at(q), np.nan_to_num(np.array(each)).T @ coefficients, atol=1e-15)
    assert np.all(SMOOTH.at(q[(q < -0.5 - 2 * h) | (q > 1.7 + 2 * h)]) == 0.0)
    np.testing.assert_allclose(SMOOTH.at(nodes), VALUES, atol=1e-16)


def test_whole_turns_away_it_is_the_same() -> None:
    """Also for angles that lie a turn from where they were measured; between the ends and there it is zero."""
    curve = ErrorCurve(-1.0, 1.5, np.random.default_rng(2).standard_normal(20))
    angles = np.linspace(-1.0, 1.5, 33)
    for turns in (-2, 1):
        np.testing.assert_allclose(curve.at(angles + 2.0 * np.pi * turns), curve.at(angles), atol=1e-12)
    np.testing.assert_array_equal(curve.at([2.5, -2.5, 2.5 + 2.0 * np.pi]), 0.0)


def test_holds_between_its_ends_and_not_beyond() -> None:
    h = 2.2 / 11
    assert SMOOTH.holds([-0.5, 0.3, 1.7, 0.3 + 2.0 * np.pi, 1.7 - 4.0 * np.pi]) == pytest.approx(1.0)
    assert SMOOTH.holds([-0.5 - 2.0 * h, 1.7 + 2.0 * h, 3.0, 3.0 - 2.0 * np.pi]) == pytest.approx(0.0)
    assert SMOOTH.holds([-0.5 - h, 1.7 + h]) == pytest.approx(0.5)  # halfway
    q = np.linspace(1.7, 1.7 + 2.0 * h, 2001)
    assert np.abs(np.diff(SMOOTH.holds(q), 2)).max() < 2e-6  # no bend: 6 / 2000^2 at most
    assert ErrorCurve(-4.0, 4.0, VALUES).holds(np.linspace(-9.0, 9.0, 50)) == pytest.approx(1.0)


LENGTHS = [300.0, 200.0, 150.0]
DEGREES = np.round(0.02 * np.sin(np.linspace(0.0, 9.0, 25)), 7)
CURVE = ErrorCurve(np.radians(-60.0), np.radians(90.0), np.radians(DEGREES))
SPEC = EffectSpec("joint_error_curve", 2, curve=CURVE)
ARM = Arm(LENGTHS, sigma=0.01, effects=(SPEC, EffectSpec("base_offset")))
FLAT = "values_deg = [0.0, 0.0, 0.0, 0.0]"
Q = np.random.default_rng(5).uniform(-2.5, 2.5, (60, 3))


def _turned(q: np.ndarray) -> np.ndarray:
    """What the joints really do."""
    return q + np.column_stack([np.zeros(len(q)), CURVE.at(q[:, 1]), np.zeros(len(q))])


def test_model_is_the_plain_one_at_the_real_angles() -> None:
    values = np.r_[0.5, -0.3, 0.2, 1e-3, -2e-3, 3e-3, 0.4, -0.1]
    plain, model = Model(ARM.with_effects(EffectSpec("base_offset"))), Model(ARM)
    assert model.names == plain.names
    for with_curve, without in zip(model.linearize(Q, values), plain.linearize(_turned(Q), values), strict=True):
        np.testing.assert_allclose(with_curve, without, rtol=0, atol=1e-10)


def test_geometry_that_belongs_to_the_curve(tmp_path: Path) -> None:
    """In file units; taken off where the curve does not hold, the base's shift along its own axes. Written out."""
    own = {"length_error:1": 0.3, "joint_offset:1": -2e-4, "joint_offset:2": 1e-4, "base_offset.x0": 0.2}
    curve = replace(CURVE, geometry={**own, "base_offset.y0": -0.1})
    arm = ARM.with_effects(replace(SPEC, curve=curve), EffectSpec("base_offset"))
    (path := tmp_path / "arm.toml").write_text(with_effects(f"links_mm = {LENGTHS}\n", arm.effects))
    assert "[effects.geometry]" in path.read_text()
    assert f'"joint_offset:1" = {np.degrees(-2e-4):.8f}'[:-3] in path.read_text()
    assert load_arm(path).effects[0].curve.geometry == pytest.approx(dict(curve.geometry))
    values = np.r_[0.5, -0.3, 0.2, 0.7, -2e-3, 3e-3, 0.4, -0.1]
    far = Q[np.abs(Q[:, 1] - np.radians(15.0)) > np.radians(90.0)]
    shift = (0.2 - 0.1j) * np.exp(0.7j)
    angles = np.cumsum(far + values[3:6] - [-2e-4, 1e-4, 0.0], axis=1)
    expected = (LENGTHS + values[:3] - [0.3, 0.0, 0.0]) @ np.exp(1j * angles.T) + (0.4 - 0.1j) - shift
    found = Model(load_arm(path)).position(far, values)
    np.testing.assert_allclose(found[:, 0] + 1j * found[:, 1], expected, atol=1e-9)
    near = Q[np.abs(Q[:, 1] - np.radians(15.0)) < np.radians(75.0)]
    np.testing.assert_array_equal(Model(arm).position(near, values), Model(ARM).position(near, values))
    step = 1e-6 * np.diag(1.0 / Model(arm).scales)
    slopes = [(Model(arm).position(far, values + s) - Model(arm).position(far, values - s)) / 2e-6 for s in step]
    scaled = Model(arm).jacobian(far, values) / Model(arm).scales
    np.testing.assert_allclose(scaled, np.moveaxis(slopes, 0, -1), atol=1e-6)


def test_every_use() -> None:
    """Simulate, estimate the rest, compensate, validate."""
    truth = Calibration.of([0.5, -0.3, 0.2], [1e-3, -2e-3, 3e-3], {"base_offset.x0": 0.4, "base_offset.y0": -0.1})
    real = Arm(LENGTHS, sigma=0.01, effects=ARM.effects, calibration=truth)
    data = simulate(real, Q, np.random.default_rng(1))
    found = estimate(Model(ARM), data)
    assert found.p_value > 1e-3
    assert estimate(Model(ARM.with_effects(EffectSpec("base_offset"))), data).p_value < 1e-9
    commands = compensate(real, postures=np.clip(Q, -2.0, 2.0))
    assert commands.reached.all()
    reached = Model(Arm(LENGTHS, effects=(EffectSpec("base_offset"),), calibration=truth)).position(
        _turned(commands.commands)
    )
    np.testing.assert_allclose(reached, commands.targets, atol=2e-6)
    elsewhere = Measurements(data.postures, data.positions + np.array([5.0, 3.0]))
    assert validate(found.calibrated_arm(), elsewhere).model.rms < 0.02


HEAD = '"joint_error_curve"\njoint = 1\nfrom_deg = '


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (f"{HEAD}0.0\nto_deg = 9.0", "values_deg: is missing"),
        (f"{HEAD}9.0\nto_deg = 0.0\n{FLAT}", "found 9 to 0, allowed: finite angles, the lower one first"),
        (
            f'{HEAD}0.0\nto_deg = 9.0\n{FLAT}\ngeometry = {{"joint_offset:3" = 0.1}}',
            "unknown parameter 'joint_offset:3'",
        ),
        ('"gear_ratio"\njoint = 1\nfrom_deg = 0.0', "from_deg: unknown key of gear_ratio"),
        (
            '"gear_ratio"\njoint = 1\ngeometry = {"joint_offset:1" = 0.1}',
            "geometry: unknown key of gear_ratio, allowed: for joint_error_curve only",
        ),
    ],
)
def test_bad_files(tmp_path: Path, entry: str, message: str) -> None:
    (path := tmp_path / "arm.toml").write_text(f"links_mm = [300.0, 200.0]\n\n[[effects]]\nname = {entry}\n")
    refused(load_arm, path, names=[f"{path}: effects[1].", message])
    for name, curve, fault in (("joint_error_curve", None, "no"), ("gear_ratio", CURVE, "a")):
        with pytest.raises(InputError, match=f"{name}:1 has {fault} table of values"):
            build(EffectSpec(name, 1, curve=curve), planar_chain(np.ones(2)))


def test_errors_of_any_form_at_joints_hold_where_all_curves_do() -> None:
    """Of another joint, at joint 2: added where joint 1 is within the angles of its curve, and not beyond them."""
    values = {"other": 3.0} | {f"v{k}": 1e-3 * k for k in range(1, 7)}
    curve = EffectSpec("joint_error_curve", 1, curve=ErrorCurve(-0.5, 1.7, VALUES, {"length_error:1": 0.1}))
    of_both = EffectSpec("two_joint_error", 2, values)
    with_it, without = (Model(Arm(LENGTHS, effects=(curve, *more))) for more in ((of_both,), ()))
    postures = np.array([[0.3, 0.4, 0.5], [1.7, -1.0, 2.0], [2.5, 0.4, 0.5], [-1.5, -1.0, 2.0]])
    moved = np.linalg.norm(with_it.position(postures) - without.position(postures), axis=1)
    assert np.all(moved[:2] > 0.01)
    np.testing.assert_array_equal(moved[2:], 0.0)


@pytest.mark.parametrize("name", ["workspace_smooth", "workspace_axes", "workspace_squares", "workspace_radius"])
def test_errors_over_the_workspace_move_with_the_base(name: str) -> None:
    """What a tracker sees of an arm that stands elsewhere, turned, is the same moved: the errors are the arm's."""
    there = pose([300.0, -200.0, 100.0], from_angles(np.array([0.4, -0.7, 1.1])))
    chains = [replace(drawing(), base=base) for base in (np.eye(4), there)]
    count = len(build(EffectSpec(name), chains[0]).parameters)
    values = dict(zip((f"v{k + 1}" for k in range(count)), np.sin(np.arange(count)).tolist(), strict=True))
    postures = np.random.default_rng(0).uniform(-2.0, 2.0, (9, 6))
    here, moved = (Model(Arm(chain, effects=(EffectSpec(name, None, values),))).position(postures) for chain in chains)
    np.testing.assert_allclose(moved, here @ there[:3, :3].T + there[:3, 3], atol=1e-9)
