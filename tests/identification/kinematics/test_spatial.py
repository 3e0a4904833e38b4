"""Chains against products of exponentials, complex numbers, printed tables and pinocchio; sets of their parameters."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from identification import PRISMATIC, Array, InputError, Parameter, ParameterSet, vectorize
from identification.files.urdf import read_urdf
from identification.instruments import Tracker
from identification.kinematics.chain import (
    MODIFIED,
    STANDARD,
    DHRow,
    Joint,
    KinematicChain,
    chain_of,
    drawn_links,
    planar_chain,
)
from identification.kinematics.frames import (
    from_angles,
    from_quaternions,
    from_roll_pitch_yaw,
    pose,
    roll_pitch_yaw,
    rotation_about,
    rotation_vector,
    to_angles,
)

URDF = Path(__file__).parents[2] / "data" / "spatial" / "six_axis.urdf"


def twist(motion: Array) -> Array:
    """(4, 4) generator of a screw motion: (3,) translation, then (3,) rotation vector."""
    x, y, z = motion[3:]
    found = np.zeros((4, 4))
    found[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    found[:3, 3] = motion[:3]
    return found


@cache
def moved(size: float, *screw: float) -> Array:
    """(4, 4) exponential of so much of a screw motion, of which differences of places ask for the same many times."""
    return np.asarray(expm(size * twist(np.array(screw))))


def tip_by_exponentials(chain: KinematicChain, q: Array, values: dict[str, float], tool: Array) -> Array:
    """(3,) the measured point."""
    error = np.array([values.get(f"tool[1].{axis}", 0.0) for axis in "xyz"])
    return np.asarray((places_by_exponentials(chain, q, values)[-1] @ np.r_[tool + error, 1.0])[:3])


def places_by_exponentials(chain: KinematicChain, q: Array, values: dict[str, float]) -> list[Array]:
    """n + 2 poses (4, 4) of base, joints after they moved, and tip, by matrix exponentials of elementary twists."""
    shift, turn = ([values.get(f"base.{r}{axis}", 0.0) for axis in "xyz"] for r in ("", "r"))
    place = pose(shift) @ chain.base
    for k in range(3):
        place = place @ moved(turn[k], *np.eye(6)[3 + k]) if turn[k] else place
    found = [place]
    for j, (joint, angle) in enumerate(zip(chain.joints, q, strict=True), start=1):
        place = place @ joint.origin
        for k, name in enumerate(f"{kind}_{axis}:{j}" for kind in ("translation", "rotation") for axis in "xyz"):
            place = place @ moved(values[name], *np.eye(6)[k]) if values.get(name) else place
        screw = (*joint.axis, 0.0, 0.0, 0.0) if joint.type == PRISMATIC else (0.0, 0.0, 0.0, *joint.axis)
        place = place @ moved(angle + values.get(f"joint_offset:{j}", 0.0), *screw)
        found.append(place)
    return [*found, place @ chain.end]


@pytest.fixture(scope="module")
def chain() -> KinematicChain:
    found = read_urdf(URDF).chain("world", "tool0")
    base = pose((100.0, -50.0, 20.0), expm(twist(np.array([0, 0, 0, 0.4, -1.0, 2.0])))[:3, :3])
    return KinematicChain(found.joints, found.end, base, {"1": np.array([10.0, -20.0, 30.0])})


def postures(chain: KinematicChain, count: int) -> Array:
    low, high = (np.array([getattr(joint, side) for joint in chain.joints]) for side in ("lower", "upper"))
    return np.random.default_rng(5).uniform(low, high, (count, len(chain)))


def test_what_there_is_to_find() -> None:
    """Two joints that turn about z and one that slides along z: of each the errors across and about its own axis that
    its offset does not make, of the first none beside the base that moves it, nor where a point is that none turns."""
    turning = Joint("turning", pose((0.0, 0.0, 100.0), np.eye(3)), np.array([0.0, 0.0, 1.0]))
    joints = (turning, turning, replace(turning, type=PRISMATIC))
    arm = KinematicChain(joints, np.eye(4), np.eye(4), {"1": np.array([1.0, 2.0, 3.0])})
    kinds = {p.name: p.kind for p in arm.parameters()}
    errors = {f"{kind}_error": [f"{kind}_{axis}" for axis in "xyz"] for kind in ("translation", "rotation")}
    expected = {f"base.{axis}": "base" for axis in ("x", "y", "z", "rx", "ry", "rz")}
    expected |= {f"tool[1].{axis}": "tool" for axis in "xyz"}
    expected |= {f"{name}:{j}": kind for kind, names in errors.items() for name in names for j in (2, 3)}
    expected |= {f"joint_offset:{j}": "joint_offset" for j in (2, 3)}
    assert kinds == {n: kind for n, kind in expected.items() if n not in ("rotation_z:2", "translation_z:3")}
    placed = {p.name: p.kind for p in replace(arm, settled=frozenset({"base", "tool"})).parameters()}
    still = {name: kind for name, kind in kinds.items() if kind not in ("base", "tool")}
    assert placed == still | {n.replace(":2", ":1"): kind for n, kind in still.items() if n.endswith(":2")}
    gantry = replace(arm, joints=(joints[2],) * 3, tools={"1": np.eye(4), "2": np.eye(4)})
    assert [p.name for p in gantry.parameters() if p.kind == "tool"] == ["tool[2].x", "tool[2].y", "tool[2].z"]


def test_frames_points_and_orientation_against_exponentials(chain: KinematicChain) -> None:
    """Of one chain with errors: `points` begins at the base, whose own pose it leaves out."""
    generator = np.random.default_rng(8)
    posed = replace(chain, instrument=Tracker(500.0))
    names = posed.every_parameter.names
    assert len(names) == 6 + 6 + 7 * len(chain)
    values = dict(zip(names, generator.uniform(-0.3, 0.3, len(names)), strict=True))
    for q in postures(posed, 3):
        places = places_by_exponentials(posed, q, values)
        for frame, place in zip(posed.frames(ca.DM(q), values), places, strict=True):
            np.testing.assert_allclose(ca.evalf(frame.origin).full()[:, 0], place[:3, 3], atol=1e-9)
            np.testing.assert_allclose(ca.evalf(frame.axes).full(), place[:3, :3], atol=1e-12)
        measured = places[-1][:3, :3]
        for k, axis in enumerate("xyz"):
            measured = measured @ expm(values[f"tool[1].r{axis}"] * twist(np.eye(6)[3 + k]))[:3, :3]
        seen = ca.evalf(posed.measured(posed.frames(ca.DM(q), values)[-1], values).axes).full().reshape(3, 3, order="F")
        np.testing.assert_allclose(seen, measured, atol=1e-12)
        from_base = np.linalg.inv(places[0])
        tip = tip_by_exponentials(posed, q, values, posed.tools["1"][:3, 3])
        expected = [*(place[:3, 3] for place in places[:-1]), tip]
        found = posed.points(q, values)
        np.testing.assert_allclose(found, [(from_base @ np.r_[point, 1.0])[:3] for point in expected], atol=1e-9)


def test_pinocchio_agrees() -> None:
    """Positions, and derivatives by the six errors of each joint's frame: its kinematic regressor."""
    pinocchio = pytest.importorskip("pinocchio", reason="pinocchio is not installed: pip install 'armcal[oracle]'")
    chain = read_urdf(URDF).chain("world", "tool0")
    model, names = pinocchio.buildModelFromUrdf(str(URDF)), chain.every_parameter.names
    data, frame = model.createData(), model.getFrameId("tool0")
    scale = np.repeat([1.0, 1000.0], 3)  # [mm/mm] of [m/m], [mm/rad] of [m/rad]
    symbols, p = ca.SX.sym("q", len(chain)), ca.SX.sym("p", len(names))
    named = {name: p[k] for k, name in enumerate(names)}
    tip = chain.measured(chain.frames(symbols, named)[-1], named).origin
    read = vectorize(ca.Function("tip", [symbols, p], [tip, ca.jacobian(tip, p)]))
    for q in postures(chain, 20):
        placed = np.where([joint.type == PRISMATIC for joint in chain.joints], q / 1000.0, q).tolist()  # a slide in m
        pan = [joint.name for joint in chain.joints].index("pan")  # continuous: a point on the unit circle
        placed[pan : pan + 1] = np.cos(q[pan]), np.sin(q[pan])
        pinocchio.framesForwardKinematics(model, data, np.array(placed))
        position, jacobian = read(q, np.zeros(len(names)))
        np.testing.assert_allclose(position[..., 0], 1000.0 * data.oMf[frame].translation, atol=1e-9)
        axes = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        regressor = pinocchio.computeFrameKinematicRegressor(model, data, frame, axes)[:3]
        for j, joint in enumerate(chain.joints, start=1):
            first = 6 * (model.getJointId(joint.name) - 1)
            errors = [f"{kind}_{axis}:{j}" for kind in ("translation", "rotation") for axis in "xyz"]
            columns = jacobian[:, [names.index(name) for name in errors]]
            np.testing.assert_allclose(columns, regressor[:, first : first + 6] * scale, atol=1e-9)


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


LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])


def test_offsets_are_scaled_by_the_best_known_lengths() -> None:
    """Also where an error turns a link around; the drawing's length where nothing of the link is left."""
    best = {"length_error:1": 5.0, "length_error:2": -200.0, "length_error:3": -120.0}
    scales = planar_chain(LENGTHS).parameters(best).scales
    np.testing.assert_array_equal(scales, [1.0, 1.0, 1.0, 1.0, 265.0, 20.0, 120.0, 100.0])


ROWS = (
    DHRow(10.0, 1.2, 127.3, 0.4),
    DHRow(-612.0, 0.0, 5.0, -0.7),
    DHRow(30.0, -0.9, 100.0, 0.2, "prismatic", (-50.0, 250.0)),
    DHRow(0.0, 0.3, 115.7),
)
Q = np.array([0.3, -1.1, 120.0, 2.2])


def printed(row: DHRow, q: float, convention: str = STANDARD) -> Array:
    """(4, 4) A_j written out, as in textbooks."""
    slides = row.type == "prismatic"
    theta, d, a = row.offset + (0.0 if slides else q), row.d + (q if slides else 0.0), row.a
    ct, st, ca_, sa = np.cos(theta), np.sin(theta), np.cos(row.alpha), np.sin(row.alpha)
    if convention == STANDARD:
        rows = [[ct, -st * ca_, st * sa, a * ct], [st, ct * ca_, -ct * sa, a * st], [0, sa, ca_, d], [0, 0, 0, 1]]
    else:
        rows = [[ct, -st, 0, a], [st * ca_, ct * ca_, -sa, -sa * d], [st * sa, ct * sa, ca_, ca_ * d], [0, 0, 0, 1]]
    return np.array(rows, dtype=float)


@pytest.mark.parametrize("convention", [STANDARD, MODIFIED])
def test_chain_is_the_product(convention: str) -> None:
    chain = chain_of(ROWS, convention)
    q = ca.SX.sym("q", 4)
    frame = chain.frames(q, {})[-1]
    origin, axes = (part.full() for part in ca.Function("tip", [q], [frame.origin, frame.axes])(Q))
    expected = np.linalg.multi_dot([printed(row, angle, convention) for row, angle in zip(ROWS, Q, strict=True)])
    np.testing.assert_allclose(origin.ravel(), expected[:3, 3], atol=1e-9)
    np.testing.assert_allclose(axes, expected[:3, :3], atol=1e-12)
    assert (chain.joints[2].lower, chain.joints[2].upper) == (-50.0, 250.0)


def test_bad_tables_are_one_line() -> None:
    with pytest.raises(InputError, match=r"dh: convention 'craig', allowed: standard or modified"):
        chain_of(ROWS, "craig")
    with pytest.raises(InputError, match=r"dh: no rows, allowed: one for each joint"):
        chain_of(())
    with pytest.raises(InputError, match=r"dh\[1\]: a prismatic joint without limits"):
        chain_of((DHRow(0.0, 0.0, 0.0, type="prismatic"),))


LENGTH_1, LENGTH_2, OFFSET_1, _ = planar_chain([300.0, 200.0]).parameters()
SET = ParameterSet([LENGTH_1, OFFSET_1, Parameter("backlash:2.b", "rad"), LENGTH_2])


def test_vector_and_mapping_are_inverse() -> None:
    vector = SET.vector({"length_error:2": 2.0, "joint_offset:1": 0.1, "of another model": 9.0})
    np.testing.assert_array_equal(vector, [0.0, 0.1, 0.0, 2.0])
    np.testing.assert_array_equal(SET.vector({}, default=np.nan), np.full(4, np.nan))
    expected = {"length_error:1": 0.0, "joint_offset:1": 0.1, "backlash:2.b": 0.0, "length_error:2": 2.0}
    assert SET.mapping(vector) == expected
    with pytest.raises(ValueError, match="shorter"):
        SET.mapping(vector[:3])


# -- rotations ---------------------------------------------------------------------------------------------------------
angles = st.floats(-np.pi, np.pi)


near_lock = st.sampled_from([np.pi / 2.0, -np.pi / 2.0]) | st.floats(1e-16, 1e-3).map(lambda gap: np.pi / 2.0 - gap)


@given(angles, angles | near_lock, angles)
def test_angles_make_their_rotation_to_the_last_digits(roll: float, pitch: float, yaw: float) -> None:
    """Roll and yaw that are each uncertain near gimbal lock belong together."""
    rotation = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()  # lower case: about fixed axes
    np.testing.assert_allclose(from_roll_pitch_yaw(roll, pitch, yaw), rotation, atol=1e-12)
    for near in (None, (roll, pitch, yaw), (1.0, -2.0, 3.0)):
        made = Rotation.from_euler("xyz", roll_pitch_yaw(rotation, near)).as_matrix()
        np.testing.assert_allclose(made, rotation, rtol=0.0, atol=3e-12)


@given(angles, angles | st.sampled_from([np.pi / 2.0, -np.pi / 2.0]), angles, st.tuples(*[st.floats(-1e-3, 1e-3)] * 3))
def test_of_the_equal_angles_the_nearest(
    roll: float, pitch: float, yaw: float, off: tuple[float, float, float]
) -> None:
    """Angles that were near are found again: also beyond 90 deg of pitch and, in gimbal lock, of a whole line of equal
    ones, from which the nearest is at most as far as those that the rotation was made of."""
    asked = np.array([roll, pitch, yaw])
    found = roll_pitch_yaw(from_roll_pitch_yaw(*asked), asked + off)
    assert np.linalg.norm(found - asked - off) <= np.linalg.norm(off) + 1e-6


SYMBOL = ca.SX.sym("r", 3, 3)
VECTOR = rotation_vector(SYMBOL)
FUNCTION = ca.Function("vector", [SYMBOL], [VECTOR, ca.jacobian(VECTOR, ca.vec(SYMBOL))])


def vector(matrix: Array) -> Array:
    return FUNCTION(matrix)[0].full()[:, 0]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.06, 0.0633, 1.0, 3.1])
def test_rotation_vector(angle: float) -> None:
    """Below and above the limit of the series, 2 atan(sqrt(1e-3)) = 0.0632."""
    axis = np.array([0.36, -0.48, 0.8])
    np.testing.assert_allclose(vector(rotation_about(axis, angle)), angle * axis, atol=1e-12)


def test_its_derivative() -> None:
    """By a small rotation from the left, against differences of scipy's logarithm."""
    for angle in (0.0, 0.01, 0.5):
        start = Rotation.from_rotvec(angle * np.array([0.36, -0.48, 0.8]))
        jacobian = FUNCTION(start.as_matrix())[1].full()
        for k, axis in enumerate(np.eye(3)):
            step = Rotation.from_rotvec(1e-6 * axis)
            ends = [(turn * start).as_rotvec() for turn in (step, step.inv())]
            across = np.cross(np.eye(3)[k], start.as_matrix(), axisb=0, axisc=0)  # derivative of the matrix
            found = jacobian @ across.ravel(order="F")
            np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-6, atol=1e-8)


def test_angles_and_quaternions() -> None:
    angles = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))
    matrices = from_angles(angles)
    for row, matrix in zip(angles, matrices, strict=True):
        np.testing.assert_allclose(matrix, from_angles(row), atol=1e-14)
    np.testing.assert_allclose(to_angles(matrices), angles, atol=1e-13)
    half = np.cos(0.35), np.sin(0.35) * np.array([0.36, -0.48, 0.8])
    found = from_quaternions(1.003 * np.r_[half[0], half[1]][None])
    np.testing.assert_allclose(found[0], rotation_about([0.36, -0.48, 0.8], 0.7), atol=1e-14)


# -- corrected tables --------------------------------------------------------------------------------------------------
HALF = np.pi / 2.0
CRAIG = [
    DHRow(0.0, 0.0, 127.3),
    DHRow(0.0, HALF, 0.0),
    DHRow(-612.0, 0.0, 0.0, 0.2),
    DHRow(-572.3, 0.0, 163.941),
    DHRow(0.0, HALF, 115.7, -0.3),
    DHRow(0.0, -HALF, 92.2),
]
UR10 = [
    DHRow(0.0, HALF, 127.3),
    DHRow(-612.0, 0.0, 0.0),
    DHRow(-572.3, 0.0, 0.0, 0.2),
    DHRow(0.0, HALF, 163.941),
    DHRow(0.0, -HALF, 115.7, -0.3),
    DHRow(0.0, 0.0, 92.2),
]


def elementary(axis: str, value: float) -> np.ndarray:
    c, s, found = np.cos(value), np.sin(value), np.eye(4)
    if axis == "x":
        found[1:3, 1:3] = [[c, -s], [s, c]]
    elif axis == "y":
        found[0, 0], found[0, 2], found[2, 0], found[2, 2] = c, s, -s, c
    elif axis == "z":
        found[:2, :2] = [[c, -s], [s, c]]
    else:
        found["XYZ".index(axis), 3] = value
    return found


def row_of_table(theta: float, d: float, a: float, alpha: float, beta: float = 0.0) -> np.ndarray:
    """Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)."""
    return np.linalg.multi_dot([*map(elementary, "zZXxy", (theta, d, a, alpha, beta))])


@pytest.mark.parametrize(("rows", "convention"), [(UR10, STANDARD), (CRAIG, MODIFIED)])
def test_the_table_puts_the_tip_where_the_chain_does(rows: list[DHRow], convention: str) -> None:
    generator = np.random.default_rng(3)
    chain, drawn = chain_of(rows, convention), drawn_links(rows, convention)
    kinds = [(f"{kind}_{axis}", size) for kind, size in (("translation", 1.0), ("rotation", 5e-3)) for axis in "xyz"]
    errors = {f"{kind}:{j}": size * generator.standard_normal() for kind, size in kinds for j in range(1, 7)}
    real = chain.corrected(errors | {f"joint_offset:{j}": 0.01 * j for j in range(2, 6)})
    links, first, last = real.corrected_links(drawn)
    for q in generator.uniform(-3.0, 3.0, (5, 6)):
        at = first @ elementary("z", q[0])
        for link, angle in zip(links, q[1:], strict=True):
            at = at @ row_of_table(*link[:4], link.beta or 0.0) @ elementary("z", angle)
        np.testing.assert_allclose(at @ last, places_by_exponentials(real, q, {})[-1], rtol=0, atol=1e-9)
    # errors of machining size move no number by more than a few of them: nothing explodes
    for link, nominal in zip(links, drawn, strict=True):
        assert abs(link.d - nominal.d) < 15.0
        assert abs(link.a - nominal.a) < 15.0
        assert max(abs(link.theta - nominal.theta), abs(link.alpha - nominal.alpha), abs(link.beta or 0.0)) < 0.1


def test_without_errors_it_is_the_table_as_drawn() -> None:
    for rows, convention in ((UR10, STANDARD), (CRAIG, MODIFIED)):
        drawn = drawn_links(rows, convention)
        found = chain_of(rows, convention).corrected_links(drawn)[0]
        for one, other in zip(found, drawn, strict=True):
            numbers = [[link.theta, link.d, link.a, link.alpha, link.beta or 0.0] for link in (one, other)]
            np.testing.assert_allclose(*numbers, rtol=0, atol=1e-9)
        assert [link.beta is None for link in found] == [True, False, False, True, True]


def test_axes_of_prismatic_joints_have_no_place() -> None:
    with pytest.raises(InputError, match="prismatic"):
        drawn_links([*UR10, DHRow(0.0, 0.0, 10.0, 0.0, PRISMATIC, (0.0, 1.0))])
    with pytest.raises(InputError, match="one axis"):
        drawn_links([*UR10, DHRow(0.0, 0.0, 10.0)])
