"""Arms identified by armcal and by what people use instead, from the same rows.

SPACE: one data set of a six-axis arm. Every tool gets the nominal table; those that find base and reflector themselves
start from nothing, the others from `placed`, which is not timed. Each answers with the axes of the joints as lines in
space at q = 0, and the measured point there: whoever judges them needs nothing else (arms.Screws).
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from tests.benchmarks.peers.arms import TABLE, Screws, dh_matrix, rotations, ur10
from tests.benchmarks.peers.table import Answer, Tool, processor_seconds

ARM_FILE = Path(__file__).parents[2] / "data/ur10/ur10.toml"
REPEATED = 5.0  # [s] below which a fit is made again, in the same process
CALLS = 10  # of a solver that stops at the first step that makes it worse, and goes on where it is called again
X, Z = np.eye(3)[0], np.eye(3)[2]


def spatial(rows: str, fit: Callable[[np.ndarray, np.ndarray], Answer]) -> Answer:
    """A fit of the rows `q` [rad] and `x` [mm] of a file, with its processor time, less what it says is not its own."""
    with np.load(rows) as data:
        q, x = data["q"], data["x"]
    times: list[float] = []
    while not times or (len(times) == 1 and times[0] < REPEATED):
        began = processor_seconds()
        answer = fit(q, x)
        times.append(answer.pop("seconds", processor_seconds() - began))
    return answer | {"first": times[0], "seconds": times[-1]}


def placed(q: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Base (4, 4) and reflector (3,) that fit the nominal arm: x = B p + (B x t) R + b is linear in B, B x t and b."""
    frames = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for row, angles in zip(TABLE, q.T, strict=True):
        turn = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
        turn[:, :3, :3] = rotations(Z, angles)
        frames = frames @ turn @ dh_matrix(*row)
    turned, places = frames[:, :3, :3], frames[:, :3, 3]
    columns = np.hstack([places, turned.reshape(len(q), 9), np.ones((len(q), 1))])
    moments, base = np.linalg.lstsq(columns, x, rcond=None)[0][:3].T, np.eye(4)
    for step in range(21):  # after the first alternately, as each is linear or a Procrustes problem
        if step:
            design = np.concatenate([base[:3, :3] @ turned, np.broadcast_to(np.eye(3), turned.shape)], axis=2)
            solution = np.linalg.lstsq(design.reshape(-1, 6), (x - places @ base[:3, :3].T).ravel(), rcond=None)[0]
            tool, base[:3, 3] = solution[:3], solution[3:]
            points = places + turned @ tool
            moments = (x - x.mean(axis=0)).T @ (points - points.mean(axis=0))
        left, _, right = np.linalg.svd(moments)
        base[:3, :3] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return base, tool


def lines(frames: np.ndarray, tool: np.ndarray) -> Answer:
    """From frames (n, 4, 4) of joints that turn about their z axes, the reflector (3,) in the last."""
    tip = frames[-1, :3, :3] @ tool + frames[-1, :3, 3]
    return {"axes": frames[:, :3, 2], "points": frames[:, :3, 3], "tip": tip}


def armcal(q: np.ndarray, x: np.ndarray) -> Answer:
    """`estimate` with the prior of machining that the arm file has."""
    import casadi as ca

    from identification import Measurements, Model, estimate
    from identification.files.arm import load_arm

    fit = estimate(Model(load_arm(ARM_FILE)), Measurements(q, x))
    chain, values = fit.model.arm.chain, dict(zip(fit.model.names, fit.parameters, strict=True))
    frames = chain.frames(ca.SX.zeros(6), values)
    pairs = list(zip(frames[1:], chain.joints, strict=False))
    axes = [np.array(ca.evalf(frame.axes)) @ joint.axis for frame, joint in pairs]
    points = [np.array(ca.evalf(frame.origin)).ravel() for frame, _ in pairs]
    tip = np.array(ca.evalf(chain.measured(frames[-1], values).origin)).ravel()
    return {"axes": np.array(axes), "points": np.array(points), "tip": tip}


def scipy(q: np.ndarray, x: np.ndarray) -> Answer:
    """`least_squares` over 27 numbers of a chain of screws written for it, differences for the Jacobian."""
    from scipy.optimize import least_squares

    base, tool = placed(q, x)
    nominal = ur10(tool, base)

    def moved(values: np.ndarray) -> Screws:
        axes, points = [], []
        for axis, point, four in zip(nominal.axes, nominal.points, values[:24].reshape(6, 4), strict=True):
            first, second = np.linalg.svd(axis[None])[2][1:]
            turned = axis + (four[2] * first + four[3] * second) / 600.0
            axes.append(turned / np.linalg.norm(turned))
            points.append(point + four[0] * first + four[1] * second)
        return Screws(np.array(axes), np.array(points), nominal.tip + values[24:], nominal.lower, nominal.upper)

    began = processor_seconds()
    solution = least_squares(lambda values: (moved(values).positions(q) - x).ravel(), np.zeros(27), method="lm")
    arm, spent = moved(solution.x), processor_seconds() - began
    return {"axes": arm.axes, "points": arm.points, "tip": arm.tip, "seconds": spent}


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
    handler = OptimizationHandler(robot, True, [True, True, True, False, False, False], True)
    began = processor_seconds()
    solution = least_squares(optimize_accuracy, handler.generate_optimization_vector(), args=(handler, q, x))
    handler.apply_optimization_vector(solution.x)
    spent = processor_seconds() - began
    frames = [handler.robot.world_frame]
    for alpha, a, theta, d in handler.robot.kinematic_chain.matrix.reshape(-1, 4):  # Rx(alpha) Tx(a) Rz(theta) Tz(d)
        frame, twist = np.eye(4), rotations(X, np.array([alpha]))[0]
        frame[:3, :3] = twist @ rotations(Z, np.array([theta]))[0]
        frame[:3, 3] = np.array([a, 0.0, 0.0]) + twist @ np.array([0.0, 0.0, d])
        frames.append(frames[-1] @ frame)
    return lines(np.array(frames[1:]), handler.robot.tool.matrix[:3, 3]) | {"seconds": spent}


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
    fit = next((fit for fit in (calibration.solve() for _ in range(CALLS)) if fit.has_converged), None)
    fit = fit or calibration.solve()
    spent = processor_seconds() - began
    screws = np.array(fit.get_screw_axes())
    feet, tip = 1000.0 * np.cross(screws[:, 3:], screws[:, :3]), 1000.0 * fit.get_zero_conf_EE_pose().t
    turn, shift = base[:3, :3], base[:3, 3]
    return {
        "axes": screws[:, 3:] @ turn.T,
        "points": feet @ turn.T + shift,
        "tip": turn @ tip + shift,
        "seconds": spent,
    }


NAMES = [f"joint_{j}" for j in range(1, 7)]
CONFIGURATION = """
schema_version: "2.0"
robot: {{name: ur10}}
tasks:
  calibration:
    enabled: true
    type: kinematic_calibration
    kinematics: {{base_frame: base_link, tool_frame: tool0}}
    parameters: {{calibration_level: full_params}}
    measurements:
      markers: [{{measurable_dof: [true, true, true, false, false, false]}}]
    data: {{source_file: {rows}, number_of_samples: {count}}}
"""


def urdf(tool: np.ndarray) -> str:
    """The nominal arm [m]: joint j's origin is row j - 1 of the table; `tool0` is the reflector (3,) [mm]."""
    limits = '<axis xyz="0 0 1"/><limit lower="-7" upper="7" effort="1" velocity="1"/>'
    links = ["base_link", *(f"link_{j}" for j in range(1, 7)), "flange", "tool0"]
    origins = [(np.zeros(3), 0.0), *((dh_matrix(*row)[:3, 3], row[1]) for row in TABLE), (tool, 0.0)]
    text = ['<robot name="ur10">', *(f'<link name="{link}"/>' for link in links)]
    for k, (place, twist) in enumerate(origins):
        name, kind, rest = (NAMES[k], "revolute", limits) if k < 6 else (f"fixed_{k}", "fixed", "")
        ends = f'<parent link="{links[k]}"/><child link="{links[k + 1]}"/>'
        origin = f'<origin xyz="{" ".join(map(repr, (place / 1000.0).tolist()))}" rpy="{np.radians(twist)!s} 0 0"/>'
        text.append(f'<joint name="{name}" type="{kind}">{ends}{origin}{rest}</joint>')
    return "\n".join([*text, "</robot>"])


def figaroh(q: np.ndarray, x: np.ndarray) -> Answer:
    """Its Levenberg-Marquardt; URDF, configuration and rows in files, as it wants them."""
    import pinocchio as pin
    from figaroh.calibration.base_calibration import BaseCalibration
    from figaroh.calibration.calibration_tools import calc_updated_fkm
    from scipy.spatial.transform import Rotation

    class Calibration(BaseCalibration):
        def __init__(self, robot, file: str) -> None:
            super().__init__(robot, file)
            self.calib_config |= {"known_baseframe": False, "known_tipframe": False}

        def cost_function(self, var: np.ndarray) -> np.ndarray:
            computed = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
            residuals = self._compute_logmap_residuals(self.PEE_measured, computed, position_frame="world")
            return self.apply_measurement_weighting(residuals)

    folder = Path(tempfile.mkdtemp())
    (folder / "ur10.urdf").write_text(urdf(np.zeros(3)))
    rows, header = folder / "rows.csv", ",".join(["x1", "y1", "z1", *NAMES])
    np.savetxt(rows, np.hstack([x / 1000.0, q]), delimiter=",", header=header, comments="", fmt="%.17g")
    (folder / "ur10.yaml").write_text(CONFIGURATION.format(rows=rows, count=len(q)))
    calibration = Calibration(pin.RobotWrapper.BuildFromURDF(str(folder / "ur10.urdf")), str(folder / "ur10.yaml"))
    calibration.initialize()
    result = calibration.solve(enable_logging=False, outlier_threshold=np.inf)
    values = dict(zip(calibration.calib_config["param_name"], result.x, strict=True))

    def rigid(name: str, fixed: bool) -> np.ndarray:
        """(4, 4) [mm] of a shift and three angles: roll, pitch and yaw about fixed axes, or a rotation vector."""
        six = [values.get(name.format(part), 0.0) for part in ("px", "py", "pz", "phix", "phiy", "phiz")]
        frame = np.eye(4)
        turned = Rotation.from_euler("xyz", six[3:]) if fixed else Rotation.from_rotvec(six[3:])
        frame[:3, :3], frame[:3, 3] = turned.as_matrix(), 1000.0 * np.array(six[:3])
        return frame

    # composed as its documentation says: base, then for each joint placement and local error
    frames = [rigid("base_{}", fixed=True)]
    for name, row in zip(NAMES, [(0.0, 0.0, 0.0), *TABLE[:-1]], strict=True):
        frames.append(frames[-1] @ dh_matrix(*row) @ rigid(f"d_{{}}_{name}", fixed=False))
    tool = dh_matrix(*TABLE[-1]) @ [*(1000.0 * values.get(f"pEE{axis}_1", 0.0) for axis in "xyz"), 1.0]
    return lines(np.array(frames[1:]), tool[:3])


SPACE = {
    "armcal": Tool(partial(spatial, fit=armcal), ("identification.files.arm", "casadi")),
    "SciPy least_squares": Tool(partial(spatial, fit=scipy), ("scipy.optimize",)),
    "pybotics": Tool(partial(spatial, fit=pybotics), ("pybotics.optimization", "pybotics.kinematic_chain")),
    "robotkinecal": Tool(partial(spatial, fit=robotkinecal), ("robotkinecal", "roboticstoolbox")),
    "figaroh": Tool(partial(spatial, fit=figaroh), ("figaroh.calibration.base_calibration", "pinocchio")),
}
