"""Parameters of the base that no reading of an instrument shows, and bases of later sessions."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification import (
    Arm,
    Calibration,
    EffectSpec,
    Identification,
    Measurements,
    Model,
    Status,
    diagnose,
    estimate,
    planar_chain,
    spectrum,
)
from identification.document import in_a_sentence
from identification.documents.pictures import gap_figure
from identification.instruments import TRACKER, Coordinate, Distance, Instrument, PlanarDistance, Plane, Sphere
from identification.instruments.base import Unplaced, registered
from identification.kinematics.frames import AXES, from_angles, pose
from identification.model.placed import with_sessions
from identification.simulate import simulate
from identification.validate import validate
from tests.doe.six_axis import CHAIN
from tests.identification.exponentials import Exponentials, drawing


def test_turns_about_a_normal_are_hidden() -> None:
    """The base's axis that is nearest to the normal, which is the last row of the base's pose."""
    level, upright = np.eye(4), pose(rotation=np.array([[0, 0, 1.0], [1.0, 0, 0], [0, 1.0, 0]]))
    assert Plane().hidden(level) == {"base.x", "base.y", "base.rz"}
    assert Plane().hidden(upright) == {"base.x", "base.y", "base.ry"}


@pytest.mark.parametrize("normal", [[0, 0, 1.0], [1.0, 0, 0], [0, 1.0, 0], [0.0, -1.0, 0.0], [0.6, 0.0, 0.8]])
def test_bases_of_later_planes(normal: list[float]) -> None:
    """The shift and the rotations lead to a base with the same normal and height, and the two that are left tilt the
    normal in both directions, wherever it points."""
    first = pose([10.0, 20.0, 30.0], from_angles((0.2, -0.1, 0.7)))
    across = np.linalg.svd(np.array([normal]))[2][1:]
    base = pose([1.0, 2.0, 300.0], np.array([across[0], np.cross(normal, across[0]), normal]))
    found, hidden = Plane().between(first, base)
    turn = [found[f"w{axis}"] for axis in AXES]
    np.testing.assert_allclose((first[:3, :3] @ from_angles(turn))[2], normal, atol=1e-12)
    assert 30.0 + found["z"] == pytest.approx(300.0)
    assert {"x", "y"} < hidden
    assert len(hidden) == 3
    free = [k for k, axis in enumerate(AXES) if f"w{axis}" not in hidden]
    tilts = [first[2, :3] @ (from_angles(turn + 1e-6 * np.eye(3)[k]) - from_angles(turn)) / 1e-6 for k in free]
    assert np.linalg.svd(tilts, compute_uv=False)[-1] > 0.5


TOOL, REACH = np.array([60.0, -40.0, 120.0]), 1500.0  # [mm]
BASE = pose([500.0, -300.0, 800.0], Rotation.from_rotvec([0.3, -0.8, 1.1]).as_matrix())  # above the plane
GENERATOR = np.random.default_rng(0)
FRAMES = Exponentials(GENERATOR, np.eye(4)).poses(GENERATOR.uniform(-2.0, 2.0, (80, 6)))


def read(instrument: Instrument, frames: np.ndarray, base: np.ndarray, tool: np.ndarray) -> np.ndarray:
    points = frames[:, :3, 3] + frames[:, :3, :3] @ tool
    return instrument.readings(points @ base[:3, :3].T + base[:3, 3], np.zeros(0))


@pytest.mark.parametrize("tool", [None, TOOL], ids=["", "the point is known"])
@pytest.mark.parametrize("base", [None, BASE], ids=["", "the base is known"])
@pytest.mark.parametrize("instrument", [TRACKER, Distance(), Plane()], ids=lambda instrument: type(instrument).__name__)
def test_base_and_point_come_back(instrument: Instrument, base: np.ndarray | None, tool: np.ndarray | None) -> None:
    """And of other postures the same is read."""
    placed = instrument.place(Unplaced(FRAMES[:40], read(instrument, FRAMES[:40], BASE, TOOL), REACH, base, tool))
    np.testing.assert_allclose(placed.tool, TOOL, atol=1e-6)
    np.testing.assert_allclose(placed.base[:3, :3] @ placed.base[:3, :3].T, np.eye(3), atol=1e-12)
    others = (read(instrument, FRAMES[40:], *each) for each in ((BASE, TOOL), placed[:2]))
    np.testing.assert_allclose(*others, atol=1e-5)
    assert placed.rms < 1e-7
    if instrument == Plane():  # the arm stands above it
        np.testing.assert_allclose(placed.base[2], BASE[2], atol=1e-6)


@pytest.mark.parametrize("radius", [3.0, 40.0, 300.0])
def test_a_ball(radius: float) -> None:
    center, generator = BASE[:3, 3], np.random.default_rng(2)
    frames = np.tile(np.eye(4), (40, 1, 1))
    frames[:, :3, :3] = Rotation.random(40, random_state=3).as_matrix()
    normals = generator.standard_normal((40, 3))
    places = center + radius * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    frames[:, :3, 3] = places - frames[:, :3, :3] @ TOOL
    placed = Sphere(radius).place(Unplaced(frames, np.zeros((40, 1)), REACH))
    np.testing.assert_allclose(placed.base[:3, 3], -center, atol=1e-6)
    np.testing.assert_allclose(placed.tool, TOOL, atol=1e-6)
    assert placed.rms < 1e-7
    by_base = Sphere(radius).place(Unplaced(frames, np.zeros((40, 1)), REACH, base=placed.base))
    np.testing.assert_allclose(by_base.tool, TOOL, atol=1e-6)


@pytest.mark.parametrize("instrument", [Distance(), Sphere(30.0)], ids=["distance", "ball"])
def test_a_center_off_the_plane_of_all_points(instrument: Instrument) -> None:
    """As of a single joint: half way between both sides, in the plane, no step leads to either."""
    frames, angles = np.tile(np.eye(4), (20, 1, 1)), np.linspace(-2.0, 2.0, 20)
    frames[:, :3, 3] = np.column_stack([400.0 * np.cos(angles), 400.0 * np.sin(angles), np.full(20, 100.0)])
    readings = read(instrument, frames, BASE, np.zeros(3))
    assert instrument.place(Unplaced(frames, readings, REACH, tool=np.zeros(3))).rms < 1e-7


def test_contacts_that_an_arm_makes_whatever_it_does() -> None:
    """Axes that are parallel turn the point in a plane: no row tells anything, and none is an outlier."""
    chain = replace(drawing(((400.0, 0.0, 300.0), (350.0, 0.0, 0.0))), instrument=Plane())
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (40, 2))
    fit = estimate(Model(Arm(chain, sigma=0.05)), Measurements(q, np.zeros((40, 1))))
    assert any("contacts that do not depend on the joints" in said for said in fit.doubts)
    assert (fit.outlier_rows, fit.unexplained_rows) == ((), ())


def test_a_ball_touched_from_one_side() -> None:
    """A dozen times within 20 degrees: the surface is reached, not some other minimum; of a point far off the flange,
    about where a calibration had it."""
    far = 5000.0 * TOOL / np.linalg.norm(TOOL)
    for seed, tool, near in (*((seed, TOOL, np.zeros(3)) for seed in range(12, 20)), (18, far, far + 1.0)):
        generator = np.random.default_rng(seed)
        frames, normals = np.tile(np.eye(4), (12, 1, 1)), generator.standard_normal((12, 3))
        frames[:, :3, :3] = Rotation.from_rotvec(0.2 * generator.standard_normal((12, 3))).as_matrix()
        places = BASE[:3, 3] + 15.0 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
        frames[:, :3, 3] = places - frames[:, :3, :3] @ tool
        assert Sphere(15.0).place(Unplaced(frames, np.zeros((12, 1)), REACH, near=near)).rms < 1e-6


def test_registration_is_no_mirror() -> None:
    """Points in a plane fit a mirrored base as well: a rotation must come out."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [3.0, 1.0, 0.0]])
    np.testing.assert_allclose(registered(points, points @ BASE[:3, :3].T + BASE[:3, 3]), BASE, atol=1e-12)


LENGTHS = np.array([300.0, 250.0, 150.0])
ERRORS, OFFSETS = np.array([1.2, -0.7, 0.4]), np.array([0.0, 4e-3, -6e-3])
CENTERS = np.array([400.0 + 300.0j, -350.0 + 420.0j])
SIGMA = 0.02
BLANK = Arm(replace(planar_chain(LENGTHS), instrument=PlanarDistance()), sigma=SIGMA)


def data(count: int, noise: float, seed: int, turn: float = 0.0) -> Measurements:
    """Of two centers in turns; the whole cell turned about joint 1, which no distance shows."""
    generator = np.random.default_rng(seed)
    q, number = generator.uniform(-2.5, 2.5, (count, 3)), np.arange(count) % 2
    tips = np.exp(1j * np.cumsum(q + OFFSETS, axis=1)) @ (LENGTHS + ERRORS)
    read = np.abs(tips - CENTERS[number]) + noise * generator.standard_normal(count)
    q[:, 0] += turn
    return Measurements(q, read[:, None], session=np.array(["left", "right"])[number])


def fitted(rows: Measurements) -> Identification:
    return estimate(Model(with_sessions(BLANK, rows)), rows)


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_without_noise_all_comes_back(turn: float) -> None:
    """Lengths and zeros, and the centers but for the turn."""
    fit = fitted(data(40, 0.0, 1, turn))
    assert fit.status is Status.converged
    np.testing.assert_allclose(fit.length_errors, ERRORS, atol=1e-8)
    np.testing.assert_allclose(fit.joint_offsets, OFFSETS, atol=1e-10)
    values = fit.model.parameters.mapping(fit.parameters)
    assert {row.name: row.corrected for row in fit.corrected_values}["center left x"] == values["center[left].x"]
    for name, center in zip(("left", "right"), CENTERS * np.exp(1j * turn), strict=True):
        assert complex(values[f"center[{name}].x"], values[f"center[{name}].y"]) == pytest.approx(center, abs=1e-7)


def test_what_distances_show() -> None:
    """Three lengths, two zeros and two centers; of two links and one center 5, as counted in tests/identification/
    test_lengths.py. That of joint 1 turns the arm as its center would be turned."""
    rows = data(60, 0.0, 2)
    model = fitted(rows).model
    assert len(model.names) == 3 + 2 + 4
    assert "joint_offset:1" not in model.names
    assert spectrum(model.jacobian(rows.postures, None, rows.conditions), model.scales).rank == 9
    two = replace(planar_chain([300.0, 200.0]), instrument=PlanarDistance((("1", (350.0, 120.0)),)))
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 2))
    assert spectrum(Model(Arm(two)).jacobian(q), Model(Arm(two)).scales).rank == len(Model(Arm(two)).names) == 5


def test_intervals_hold() -> None:
    scores = []
    for seed in range(20):
        fit = fitted(data(40, SIGMA, 100 + seed))
        truth = dict(zip((f"length_error:{j}" for j in (1, 2, 3)), ERRORS, strict=True))
        truth |= {"joint_offset:2": OFFSETS[1], "joint_offset:3": OFFSETS[2]}
        values = zip(fit.names, fit.parameters, np.sqrt(np.diag(fit.covariance)), strict=True)
        scores += [(x - truth[name]) / std for name, x, std in values if name in truth]
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.35  # 100 correlated ones, as if 30 were independent


def test_an_effect_is_named_and_holds_elsewhere() -> None:
    """Joint 2 reads what an encoder off center does; another session has a center of its own."""
    chain = replace(planar_chain(LENGTHS), instrument=PlanarDistance((("1", (400.0, 300.0)),)))
    truth = Arm(chain, sigma=SIGMA, effects=(EffectSpec("encoder_eccentricity", 2, {"a": 6e-4, "b": 3e-4}),))
    generator = np.random.default_rng(5)
    found = diagnose(BLANK, simulate(truth, generator.uniform(-2.5, 2.5, (80, 3)), generator))
    assert found.named.effects == ("encoder_eccentricity:2",)
    assert "center 1" not in str(found)  # which is averaged over, and of which the arm says where fits start
    moved = replace(chain, instrument=PlanarDistance((("1", (-300.0, 500.0)),)))
    fresh = simulate(replace(truth, chain=moved), generator.uniform(-2.5, 2.5, (40, 3)), generator)
    again = validate(found.extended_arm(), fresh)
    assert again.model.rms < 1.5 * SIGMA < 3.0 * SIGMA < again.nominal.rms


# -- a camera ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Camera(Instrument):
    """A pinhole camera, its z axis the line of sight: two coordinates [px] of a point's picture.

    focal : length [px]
    """

    focal: float = 2000.0
    coordinates = (Coordinate("u", "pixel"), Coordinate("v", "pixel"))
    size_is_open = "pictures of one camera", "only [machining] tells"  # of an arm twice as large, twice as far away

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return self.focal * point[:2] / point[2]


CAMERA = pose([100.0, -200.0, 3000.0], from_angles((1.2, -0.4, 2.0)))
PIXELS = 0.1  # [px], some 0.15 mm


def test_a_camera_with_unknown_base() -> None:
    generator = np.random.default_rng(1)
    q = generator.uniform(-2.0, 2.0, (50, 6))
    errors = {f"joint_offset:{j}": 3e-3 for j in range(2, 6)} | {"translation_x:3": 0.8, "rotation_y:4": 2e-3}
    eccentric = EffectSpec("encoder_eccentricity", 3, {"a": 1e-3, "b": 5e-4})
    chain = replace(CHAIN, instrument=Camera(), base=CAMERA)
    data = simulate(Arm(chain, sigma=PIXELS, effects=(eccentric,), calibration=Calibration(errors)), q, generator)
    arm = Arm(replace(CHAIN, instrument=Camera(), base=np.eye(4), tools={"1": np.zeros(3)}), sigma=PIXELS)
    found = estimate(Model(arm.with_effects(EffectSpec("encoder_eccentricity", 3))), data)
    assert found.status is Status.converged
    fitted = f"from {in_a_sentence(found.rms_before)} px (drawing, placed as well as it can be) to"
    assert f"{fitted} {in_a_sentence(found.rms_after)} px" in " ".join(str(found).split())
    assert found.chi2 is not None
    assert abs(found.chi2 - found.dof) < 4.0 * np.sqrt(2.0 * found.dof)
    assert found.warnings == ()  # pixels are not compared with the millimetres of the tip
    diagnosis = diagnose(arm, data)
    assert diagnosis.named.effects == ("encoder_eccentricity:3",)
    assert all(" px" in gap_figure(diagnosis).axes[k].get_title() for k in (0, 1))
    assert "On the data, with the geometry fitted, the RMS error goes from" in (
        text := " ".join(str(diagnosis).split())
    )
    assert f"to {in_a_sentence(diagnosis.gap.rms_after)} px;" in text
    judged = validate(found.calibrated_arm(), data)
    assert f"to {judged.model.rms:.3f} px" in " ".join(str(judged).split())
