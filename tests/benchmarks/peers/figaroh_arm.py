"""figaroh's calibration of a six-axis arm: URDF, configuration and rows in files, as it wants them."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from tests.benchmarks.peers.geometry import TABLE, dh_matrix

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


def urdf(tool: np.ndarray = np.zeros(3)) -> str:  # noqa: B008 - never written to
    """The nominal arm [m]: joint j's origin is row j - 1 of the table; `tool0` is the reflector (3,) [mm]."""
    limits = '<axis xyz="0 0 1"/><limit lower="-7" upper="7" effort="1" velocity="1"/>'
    lines, links = ['<robot name="ur10">'], ["base_link", *(f"link_{j}" for j in range(1, 7)), "flange", "tool0"]
    lines += [f'<link name="{link}"/>' for link in links]
    origins = [(np.zeros(3), 0.0)]
    origins += [(dh_matrix(*row)[:3, 3] / 1000.0, float(np.radians(row[1]))) for row in TABLE]
    origins += [(tool / 1000.0, 0.0)]
    for k, (place, twist) in enumerate(origins):
        name, kind, rest = (NAMES[k], "revolute", limits) if k < 6 else (f"fixed_{k}", "fixed", "")
        lines += [
            f'<joint name="{name}" type="{kind}"><parent link="{links[k]}"/><child link="{links[k + 1]}"/>',
            f'<origin xyz="{" ".join(map(repr, place.tolist()))}" rpy="{twist!r} 0 0"/>{rest}</joint>',
        ]
    return "\n".join([*lines, "</robot>"])


def figaroh(q: np.ndarray, x: np.ndarray, plain: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Frames (6, 4, 4) [mm] of the joints at q = 0 and the reflector (3,) in the last, by its Levenberg-Marquardt.

    plain : differences of positions instead of the residuals of its documentation: cheaper, with the same minimum
    """
    import pinocchio as pin
    from figaroh.calibration.base_calibration import BaseCalibration
    from figaroh.calibration.calibration_tools import calc_updated_fkm

    class Calibration(BaseCalibration):
        def __init__(self, robot, file: str) -> None:
            super().__init__(robot, file)
            self.calib_config |= {"known_baseframe": False, "known_tipframe": False}

        def cost_function(self, var: np.ndarray) -> np.ndarray:
            computed = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
            if plain:
                return self.PEE_measured - computed
            residuals = self._compute_logmap_residuals(self.PEE_measured, computed, position_frame="world")
            return self.apply_measurement_weighting(residuals)

    folder = Path(tempfile.mkdtemp())
    (folder / "ur10.urdf").write_text(urdf())
    rows, header = folder / "rows.csv", ",".join(["x1", "y1", "z1", *NAMES])
    np.savetxt(rows, np.hstack([x / 1000.0, q]), delimiter=",", header=header, comments="", fmt="%.17g")
    (folder / "ur10.yaml").write_text(CONFIGURATION.format(rows=rows, count=len(q)))
    calibration = Calibration(pin.RobotWrapper.BuildFromURDF(str(folder / "ur10.urdf")), str(folder / "ur10.yaml"))
    calibration.initialize()
    result = calibration.solve(enable_logging=False, outlier_threshold=np.inf)
    found = dict(zip(calibration.calib_config["param_name"], result.x, strict=True))
    return frames_of(found)


def frames_of(found: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Its parameters composed as its documentation says: base, then for each joint placement and local error."""
    base = rigid([found.get(f"base_{name}", 0.0) for name in ("px", "py", "pz", "phix", "phiy", "phiz")], fixed=True)
    frames, frame = [], base
    for name, row in zip(NAMES, [(0.0, 0.0, 0.0), *TABLE[:-1]], strict=True):
        nominal = dh_matrix(*row)
        nominal[:3, 3] /= 1000.0
        error = [found.get(f"d_{kind}_{name}", 0.0) for kind in ("px", "py", "pz", "phix", "phiy", "phiz")]
        frame = frame @ nominal @ rigid(error, fixed=False)
        frames.append(frame)
    end = dh_matrix(*TABLE[-1])
    end[:3, 3] /= 1000.0
    tool = end @ [*(found.get(f"pEE{axis}_1", 0.0) for axis in "xyz"), 1.0]
    frames = np.array(frames)
    frames[:, :3, 3] *= 1000.0
    return frames, 1000.0 * tool[:3]


def rigid(six: list[float], fixed: bool) -> np.ndarray:
    """(4, 4) of a shift and three angles: roll, pitch and yaw about fixed axes, or a rotation vector."""
    from scipy.spatial.transform import Rotation

    found = np.eye(4)
    turned = Rotation.from_euler("xyz", six[3:]) if fixed else Rotation.from_rotvec(six[3:])
    found[:3, :3], found[:3, 3] = turned.as_matrix(), six[:3]
    return found
