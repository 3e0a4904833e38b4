"""A six-axis arm identified by armcal and by what people use instead, from the same rows.

Every tool gets the nominal table; those that find base and reflector themselves start from nothing, the others from
`placed`, which is not timed. Each answers with the axes of the joints as lines in space at q = 0, and the measured
point there: whoever judges them needs nothing else (geometry.Screws).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.benchmarks.peers.figaroh_arm import figaroh, urdf
from tests.benchmarks.peers.geometry import TABLE, Screws, dh_matrix, rotations, ur10
from tests.benchmarks.peers.tool import Answer, Tool, processor_seconds

ARM_FILE = Path(__file__).parents[2] / "data/ur10/ur10.toml"
FREE = (True, True, True)
FIGAROH = ("figaroh.calibration.base_calibration", "pinocchio")
REPEATED = 5.0  # [s] below which a fit is made again, in the same process
CALLS = 10  # of a solver that stops at the first step that makes it worse, and goes on where it is called again


def flange(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (m, 3, 3) and places (m, 3) [mm] of the nominal flange in the arm's base."""
    found = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for row, angles in zip(TABLE, q.T, strict=True):
        turn = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
        turn[:, :3, :3] = rotations(np.array([0.0, 0.0, 1.0]), angles)
        found = found @ turn @ dh_matrix(*row)
    return found[:, :3, :3], found[:, :3, 3]


def placed(q: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Base (4, 4) and reflector (3,) that fit the nominal arm: x = B p + (B x t) R + b is linear in B, B x t and b."""
    turned, places = flange(q)
    columns = np.hstack([places, turned.reshape(len(q), 9), np.ones((len(q), 1))])
    solution = np.linalg.lstsq(columns, x, rcond=None)[0]
    left, _, right = np.linalg.svd(solution[:3].T)
    base = np.eye(4)
    base[:3, :3] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    for _ in range(20):  # alternately, as each is linear or a Procrustes problem
        design = np.concatenate([base[:3, :3] @ turned, np.broadcast_to(np.eye(3), turned.shape)], axis=2)
        rest = (x - places @ base[:3, :3].T).ravel()
        found = np.linalg.lstsq(design.reshape(-1, 6), rest, rcond=None)[0]
        tool, base[:3, 3] = found[:3], found[3:]
        points = places + turned @ tool
        left, _, right = np.linalg.svd((x - x.mean(axis=0)).T @ (points - points.mean(axis=0)))
        base[:3, :3] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return base, tool


def answer(axes: np.ndarray, points: np.ndarray, tip: np.ndarray) -> Answer:
    """Arrays of `Screws` without limits."""
    return {"axes": np.array(axes), "points": np.array(points), "tip": np.array(tip)}


def armcal(q: np.ndarray, x: np.ndarray) -> Answer:
    """`estimate` with the prior of machining that the arm file has."""
    import casadi as ca

    from identification import Measurements, Model, estimate
    from identification.files.arm import load_arm

    fit = estimate(Model(load_arm(ARM_FILE)), Measurements(q, x))
    chain, values = fit.model.arm.chain, dict(zip(fit.model.names, fit.parameters, strict=True))
    frames = chain.frames(ca.SX.zeros(6), values)
    joints = [(np.array(ca.evalf(f.axes)) @ j.axis, f.origin) for f, j in zip(frames[1:], chain.joints, strict=False)]
    tip = ca.evalf(chain.tool(frames[-1], "1", values))
    return answer([a for a, _ in joints], [np.array(ca.evalf(o)).ravel() for _, o in joints], np.array(tip).ravel())


def scipy(q: np.ndarray, x: np.ndarray) -> Answer:
    """`least_squares` over 27 numbers of a chain of screws written for it, differences for the Jacobian."""
    from scipy.optimize import least_squares

    nominal = started(q, x)

    def moved(values: np.ndarray) -> Screws:
        axes, points = [], []
        for axis, point, four in zip(nominal.axes, nominal.points, values[:24].reshape(6, 4), strict=True):
            first, second = np.linalg.svd(axis[None])[2][1:]
            turned = axis + (four[2] * first + four[3] * second) / 600.0
            axes.append(turned / np.linalg.norm(turned))
            points.append(point + four[0] * first + four[1] * second)
        return Screws(np.array(axes), np.array(points), nominal.tip + values[24:], nominal.lower, nominal.upper)

    began = processor_seconds()
    found = least_squares(lambda values: (moved(values).positions(q) - x).ravel(), np.zeros(27), method="lm")
    arm = moved(found.x)
    return answer(arm.axes, arm.points, arm.tip) | {"seconds": processor_seconds() - began}


def started(q: np.ndarray, x: np.ndarray) -> Screws:
    """The nominal arm where `placed` puts it."""
    base, tool = placed(q, x)
    return ur10(tool, base)


def pybotics(q: np.ndarray, x: np.ndarray) -> Answer:
    """`optimize_accuracy`, as its example has it, over all modified D-H parameters, base and reflector."""
    from pybotics.kinematic_chain import MDHKinematicChain
    from pybotics.optimization import OptimizationHandler, optimize_accuracy
    from pybotics.robot import Robot
    from pybotics.tool import Tool as Flange
    from scipy.optimize import least_squares

    base, tool = placed(q, x)
    before = [(0.0, 0.0), *((a, np.radians(alpha)) for a, alpha, _ in TABLE)]
    links = [[alpha, a, 0.0, d] for (a, alpha), (_, _, d) in zip(before, TABLE, strict=False)]
    end = np.eye(4)
    end[:3, 3] = tool  # the last row of the table has neither length nor twist
    robot = Robot(MDHKinematicChain.from_parameters(np.array(links)), Flange(end), base)
    handler = OptimizationHandler(robot, True, [*FREE, False, False, False], True)
    began = processor_seconds()
    start = handler.generate_optimization_vector()
    found = least_squares(optimize_accuracy, start, args=(handler, q, x))
    handler.apply_optimization_vector(found.x)
    spent = processor_seconds() - began
    frames = [handler.robot.world_frame]
    for link in handler.robot.kinematic_chain.matrix.reshape(-1, 4):
        frames.append(frames[-1] @ modified_dh(*link))
    return screws_of(np.array(frames[1:]), handler.robot.tool.matrix[:3, 3]) | {"seconds": spent}


def modified_dh(alpha: float, a: float, theta: float, d: float) -> np.ndarray:
    """(4, 4) Rx(alpha) Tx(a) Rz(theta) Tz(d)."""
    found = np.eye(4)
    turn = rotations(np.array([1.0, 0.0, 0.0]), np.array([alpha]))[0]
    found[:3, :3] = turn @ rotations(np.array([0.0, 0.0, 1.0]), np.array([theta]))[0]
    found[:3, 3] = np.array([a, 0.0, 0.0]) + turn @ np.array([0.0, 0.0, d])
    return found


def screws_of(frames: np.ndarray, tool: np.ndarray) -> Answer:
    """From frames (n, 4, 4) of joints that turn about their z axes, the reflector (3,) in the last."""
    return answer(frames[:, :3, 2], frames[:, :3, 3], frames[-1, :3, :3] @ tool + frames[-1, :3, 3])


def robotkinecal(q: np.ndarray, x: np.ndarray) -> Answer:
    """`SerialRobotKineCal` from a URDF file [m], as its example has it, and rows in the frame of the nominal base."""
    import roboticstoolbox as rtb
    from robotkinecal import SerialRobotKineCal

    base, tool = placed(q, x)
    file = Path(tempfile.mkdtemp()) / "ur10.urdf"
    file.write_text(urdf(tool))
    robot = rtb.ERobot.URDF(str(file))
    points = (x - base[:3, 3]) @ base[:3, :3] / 1000.0
    began = processor_seconds()
    calibration = SerialRobotKineCal(robot, "tool0")
    calibration.set_observations(list(q), list(points))
    np.random.seed(0)  # noqa: NPY002 - it has no generator
    found = next((f for f in (calibration.solve() for _ in range(CALLS)) if f.has_converged), None)
    found = found or calibration.solve()
    spent = processor_seconds() - began
    axes = np.array([screw[3:] for screw in found.get_screw_axes()])
    feet = np.array([1000.0 * np.cross(screw[3:], screw[:3]) for screw in found.get_screw_axes()])
    tip = 1000.0 * found.get_zero_conf_EE_pose().t
    turn, shift = base[:3, :3], base[:3, 3]
    state = {"seconds": spent, "converged": found.has_converged}
    return answer(axes @ turn.T, feet @ turn.T + shift, turn @ tip + shift) | state


def timed(fit: Callable[[np.ndarray, np.ndarray], Answer], q: np.ndarray, x: np.ndarray) -> tuple[Answer, float]:
    """A fit and its processor time [s], without what it says is not its own."""
    began = processor_seconds()
    found = fit(q, x)
    return found, found.pop("seconds", processor_seconds() - began)


def job(fit: Callable[[np.ndarray, np.ndarray], Answer], *modules: str) -> Tool:
    """A tool of this file; the rows are `q` [rad] and `x` [mm] of a file."""

    def run(rows: str) -> Answer:
        with np.load(rows) as data:
            q, x = data["q"], data["x"]
        (first, once), (again, twice) = timed(fit, q, x), (None, 0.0)
        if once < REPEATED:
            again, twice = timed(fit, q, x)
        return (again or first) | {"first": once, "seconds": twice or once}

    return Tool(run, modules)


TOOLS = {
    "armcal": job(armcal, "identification.files.arm", "casadi"),
    "SciPy least_squares": job(scipy, "scipy.optimize"),
    "pybotics": job(pybotics, "pybotics.optimization", "pybotics.kinematic_chain"),
    "robotkinecal": job(robotkinecal, "robotkinecal", "roboticstoolbox"),
    "figaroh": job(lambda q, x: screws_of(*figaroh(q, x)), *FIGAROH),
    "figaroh, plain residuals": job(lambda q, x: screws_of(*figaroh(q, x, plain=True)), *FIGAROH),
}
