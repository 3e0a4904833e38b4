"""Chains in space against products of exponentials in plain numpy, finite differences, and (if installed) pinocchio."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from identification.arrays import Array
from identification.errors import InputError
from identification.files.urdf import read_urdf
from identification.kinematics.chain import Joint, KinematicChain
from identification.kinematics.frames import pose
from identification.kinematics.parameters import PRISMATIC
from identification.vectorize import vectorize

URDF = Path(__file__).parents[2] / "data" / "spatial" / "six_axis.urdf"
STEP = 1e-6  # [mm, rad] of central differences of positions of some 1e3 mm: rounding 1e3 * 1e-16 / 1e-6 = 1e-7


def twist(motion: Array) -> Array:
    """(4, 4) generator of a screw motion: (3,) translation, then (3,) rotation vector."""
    x, y, z = motion[3:]
    found = np.zeros((4, 4))
    found[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    found[:3, 3] = motion[:3]
    return found


def tip_by_exponentials(chain: KinematicChain, q: Array, values: dict[str, float], tool: Array) -> Array:
    """(3,) the measured point."""
    error = np.array([values.get(f"tool[1].{axis}", 0.0) for axis in "xyz"])
    return np.asarray((places_by_exponentials(chain, q, values)[-1] @ np.r_[tool + error, 1.0])[:3])


def places_by_exponentials(chain: KinematicChain, q: Array, values: dict[str, float]) -> list[Array]:
    """n + 2 poses (4, 4) of base, joints after they moved, and tip, by matrix exponentials of elementary twists."""

    def elementary(name: str, k: int) -> Array:
        size = values.get(name, 0.0)
        return np.asarray(expm(size * twist(np.eye(6)[k]))) if size else np.eye(4)

    def six(first: str, second: str, suffix: str) -> Array:
        found = np.eye(4)
        for k, axis in enumerate("xyz"):
            found = found @ elementary(f"{first}{axis}{suffix}", k)
        for k, axis in enumerate("xyz"):
            found = found @ elementary(f"{second}{axis}{suffix}", 3 + k)
        return found

    shift, turn = ([values.get(f"base.{r}{axis}", 0.0) for axis in "xyz"] for r in ("", "r"))
    place = pose(shift) @ chain.base
    for k in range(3):
        place = place @ expm(turn[k] * twist(np.eye(6)[3 + k])) if turn[k] else place
    found = [place]
    for j, (joint, angle) in enumerate(zip(chain.joints, q, strict=True), start=1):
        place = place @ joint.origin @ six("translation_", "rotation_", f":{j}")
        along = joint.type == PRISMATIC
        screw = np.r_[joint.axis, np.zeros(3)] if along else np.r_[np.zeros(3), joint.axis]
        place = place @ expm((angle + values.get(f"joint_offset:{j}", 0.0)) * twist(screw))
        found.append(place)
    return [*found, place @ chain.end]


@pytest.fixture(scope="module")
def chain() -> KinematicChain:
    found = read_urdf(URDF).chain("world", "tool0")
    base = pose((100.0, -50.0, 20.0), expm(twist(np.array([0, 0, 0, 0.4, -1.0, 2.0])))[:3, :3])
    return KinematicChain(found.joints, found.end, base, {"1": np.array([10.0, -20.0, 30.0])})


def position_and_jacobian(chain: KinematicChain, q: Array, values: Array) -> tuple[Array, Array]:
    symbols, p = ca.SX.sym("q", len(chain)), ca.SX.sym("p", len(chain.every_parameter))
    named = {name: p[k] for k, name in enumerate(chain.every_parameter.names)}
    tip = chain.tool(chain.frames(symbols, named)[-1], "1", named)
    found = vectorize(ca.Function("tip", [symbols, p], [tip, ca.jacobian(tip, p)]))(q, values)
    return found[0][..., 0], found[1]


def postures(chain: KinematicChain, count: int) -> Array:
    low, high = (np.array([getattr(joint, side) for joint in chain.joints]) for side in ("lower", "upper"))
    return np.random.default_rng(5).uniform(low, high, (count, len(chain)))


def test_what_there_is_to_find() -> None:
    """Two joints that turn about z and one that slides along z: of each the errors across and about its own axis that
    its offset does not make, of the first none beside the base that moves it."""
    turning = Joint("turning", pose((0.0, 0.0, 100.0), np.eye(3)), np.array([0.0, 0.0, 1.0]))
    joints = (turning, turning, replace(turning, type=PRISMATIC))
    arm = KinematicChain(joints, np.eye(4), np.eye(4), {"1": np.array([1.0, 2.0, 3.0])})
    kinds = {p.name: p.kind for p in arm.parameters()}
    errors = {f"{kind}_error": [f"{kind}_{axis}" for axis in "xyz"] for kind in ("translation", "rotation")}
    own = {"rotation_z:2", "translation_z:3"}
    expected = {f"base.{axis}": "base" for axis in ("x", "y", "z", "rx", "ry", "rz")}
    expected |= {f"tool[1].{axis}": "tool" for axis in "xyz"}
    expected |= {f"{name}:{j}": kind for kind, names in errors.items() for name in names for j in (2, 3)}
    expected |= {f"joint_offset:{j}": "joint_offset" for j in (2, 3)}
    assert kinds == {name: kind for name, kind in expected.items() if name not in own}
    placed = {p.name: p.kind for p in replace(arm, settled=frozenset({"base", "tool"})).parameters()}
    first = {f"{name}:1": kind for kind, names in errors.items() for name in names} | {"joint_offset:1": "joint_offset"}
    still = {name: kind for name, kind in kinds.items() if kind not in ("base", "tool")}
    assert placed == still | {name: kind for name, kind in first.items() if name != "rotation_z:1"}


def test_every_error_against_exponentials(chain: KinematicChain) -> None:
    generator = np.random.default_rng(6)
    names = chain.every_parameter.names
    assert len(names) == 6 + 3 + 7 * len(chain)
    for q in postures(chain, 5):
        values = generator.uniform(-0.3, 0.3, len(names))
        expected = tip_by_exponentials(chain, q, dict(zip(names, values, strict=True)), chain.tools["1"])
        np.testing.assert_allclose(position_and_jacobian(chain, q, values)[0], expected, atol=1e-9)


def test_jacobian_against_differences(chain: KinematicChain) -> None:
    names = chain.every_parameter.names
    values = np.random.default_rng(7).uniform(-0.1, 0.1, len(names))
    q = postures(chain, 1)[0]
    found = position_and_jacobian(chain, q, values)[1]
    for k, _ in enumerate(names):
        ends = [
            tip_by_exponentials(
                chain, q, dict(zip(names, values + s * STEP * np.eye(len(names))[k], strict=True)), chain.tools["1"]
            )
            for s in (1.0, -1.0)
        ]
        np.testing.assert_allclose(found[:, k], (ends[0] - ends[1]) / (2.0 * STEP), atol=2e-5)


def test_frames_points_and_orientation_against_exponentials(chain: KinematicChain) -> None:
    """Of one chain with errors: `points` begins at the base, whose own pose it leaves out."""
    generator = np.random.default_rng(8)
    posed = replace(chain, angle_scale=500.0)
    names = posed.parameters().names
    values = dict(zip(names, generator.uniform(-0.3, 0.3, len(names)), strict=True))
    for q in postures(posed, 3):
        places = places_by_exponentials(posed, q, values)
        for frame, place in zip(posed.frames(ca.DM(q), values), places, strict=True):
            np.testing.assert_allclose(ca.evalf(frame.origin).full()[:, 0], place[:3, 3], atol=1e-9)
            np.testing.assert_allclose(ca.evalf(frame.axes).full(), place[:3, :3], atol=1e-12)
        measured = places[-1][:3, :3]
        for k, axis in enumerate("xyz"):
            measured = measured @ expm(values[f"tool[1].r{axis}"] * twist(np.eye(6)[3 + k]))[:3, :3]
        seen = ca.evalf(posed.orientation(ca.DM(q), values)).full().reshape(3, 3, order="F")
        np.testing.assert_allclose(seen, measured, atol=1e-12)
        from_base = np.linalg.inv(places[0])
        tip = tip_by_exponentials(posed, q, values, posed.tools["1"])
        expected = [*(place[:3, 3] for place in places[:-1]), tip]
        found = posed.points(q, np.array([values[name] for name in names]))
        np.testing.assert_allclose(found, [(from_base @ np.r_[point, 1.0])[:3] for point in expected], atol=1e-9)


def test_points_of_many_postures_and_one_measured_point(chain: KinematicChain) -> None:
    zeros = np.zeros(len(chain.parameters()))
    q = postures(chain, 6)
    every = chain.points(q.reshape(2, 3, -1), zeros)
    assert every.shape == (2, 3, len(chain) + 2, 3)
    np.testing.assert_array_equal(every.reshape(6, len(chain) + 2, 3)[4], chain.points(q[4], zeros))
    point, turn = chain.tip(ca.DM(q[0]), ca.DM(zeros), {"tool": ca.DM.zeros(3)})
    assert (point.shape, turn.shape) == ((3, 1), (0, 1))


def test_links_grow_along_themselves(chain: KinematicChain) -> None:
    """The origin of every frame behind a link moves by the link's growth along the line to the next joint."""
    q = postures(chain, 1)[0]
    lengths = ca.evalf(chain.link_lengths(ca.SX(0, 1))).full()[:, 0]
    steps = [matrix[:3, 3] for matrix in (*(joint.origin for joint in chain.joints[1:]), chain.end)]
    np.testing.assert_allclose(lengths, [np.linalg.norm(step) for step in steps], rtol=1e-15)
    before = [ca.evalf(frame.origin).full()[:, 0] for frame in chain.frames(ca.DM(q), {})]
    axes = [ca.evalf(frame.axes).full() for frame in chain.frames(ca.DM(q), {})]
    for j, step in enumerate(steps, start=1):
        growth = np.where(np.arange(len(chain)) == j - 1, 0.7, 0.0)
        after = [
            ca.evalf(f.origin).full()[:, 0] for f in chain.frames(ca.DM(q), {}, {"extensions": ca.SX(ca.DM(growth))})
        ]
        shift = 0.7 * axes[j] @ step / np.linalg.norm(step) if step.any() else np.zeros(3)
        for k, (one, other) in enumerate(zip(before, after, strict=True)):
            np.testing.assert_allclose(other - one, shift if k > j else np.zeros(3), atol=1e-9)


def test_a_million_poses_need_no_axis_to_be_x_y_or_z(chain: KinematicChain) -> None:
    """A tilted axis turns as Rodrigues' formula says: covered by `tilted` above; here its inverse turns back."""
    tilted = next(joint for joint in chain.joints if joint.name == "tilted")
    q = ca.SX.sym("q")
    from identification.kinematics.frames import Frame

    there = tilted.moved(tilted.moved(Frame.world(), q), -q)
    axes = ca.Function("axes", [q], [there.axes])(0.7).full()
    np.testing.assert_allclose(axes, np.eye(3), atol=1e-12)


def test_pinocchio_agrees() -> None:
    """Positions, and derivatives by the six errors of each joint's frame: its kinematic regressor."""
    pinocchio = pytest.importorskip("pinocchio", reason="pinocchio is not installed: pip install 'armcal[oracle]'")
    chain = read_urdf(URDF).chain("world", "tool0")
    model, names = pinocchio.buildModelFromUrdf(str(URDF)), chain.every_parameter.names
    data, frame = model.createData(), model.getFrameId("tool0")
    scale = np.repeat([1.0, 1000.0], 3)  # [mm/mm] of [m/m], [mm/rad] of [m/rad]
    for q in postures(chain, 20):
        placed = [value for joint, angle in zip(chain.joints, q, strict=True) for value in _pinocchio(joint, angle)]
        pinocchio.framesForwardKinematics(model, data, np.array(placed))
        position, jacobian = position_and_jacobian(chain, q, np.zeros(len(names)))
        np.testing.assert_allclose(position, 1000.0 * data.oMf[frame].translation, atol=1e-9)
        axes = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        regressor = pinocchio.computeFrameKinematicRegressor(model, data, frame, axes)[:3]
        for j, joint in enumerate(chain.joints, start=1):
            first = 6 * (model.getJointId(joint.name) - 1)
            errors = [f"{kind}_{axis}:{j}" for kind in ("translation", "rotation") for axis in "xyz"]
            columns = jacobian[:, [names.index(name) for name in errors]]
            np.testing.assert_allclose(columns, regressor[:, first : first + 6] * scale, atol=1e-9)


def _pinocchio(joint: Joint, position: float) -> list[float]:
    """A continuous joint is a unit circle there, a slide in metres."""
    if joint.type == PRISMATIC:
        return [position / 1000.0]
    return [np.cos(position), np.sin(position)] if joint.name == "pan" else [position]


def test_bad_joints_are_one_line() -> None:
    with pytest.raises(InputError, match=r"joint a: type 'ball', allowed: revolute or prismatic"):
        Joint("a", np.eye(4), np.array([0.0, 0.0, 1.0]), "ball")
    for axis, said in (([0.0] * 3, r"\[0.0, 0.0, 0.0\]"), ([0.0, np.nan, 1.0], r"\[0.0, nan, 1.0\]")):
        with pytest.raises(InputError, match=rf"joint a: axis {said}, allowed: not zero"):
            Joint("a", np.eye(4), np.array(axis))


def test_a_shift_along_the_axes_of_the_base_turns_by_them() -> None:
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    chain = KinematicChain((Joint("a", np.eye(4), np.eye(3)[2]),), np.eye(4), base=pose(rotation=turned))
    shift = chain.along_base({"base.x": 1.0, "base.z": 3.0, "base.rx": 0.5}, {})
    assert {name: float(x) for name, x in shift.items()} == {"base.x": 0.0, "base.y": 1.0, "base.z": 3.0}
