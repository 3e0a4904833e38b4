"""A laser tracker, a camera system, a coordinate measuring machine: what is read is where the measured point is, of one
or several reflectors, or the pose of a measured frame (identification/kinematics/frames.py)."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from identification.instruments.base import Coordinate, Instrument
from identification.instruments.registration import placed, registered
from identification.instruments.search import Placement, Unplaced


@dataclass(frozen=True)
class Tracker(Instrument):
    """Positions in the frame of the instrument; in the plane the first two."""

    coordinates = (Coordinate("x"), Coordinate("y"), Coordinate("z"))
    reads_positions = True

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return point

    def place(self, rows: Unplaced) -> Placement:
        """In closed form, whatever is `hopeless`."""
        frames, readings, reach, base, tool, _ = rows
        if base is not None:
            if tool is None:  # that explains the measured points best, each in the frame of its tip
                local = (readings - base[:3, 3]) @ base[:3, :3]  # in the base's frame
                tool = np.einsum("mji,mj->i", frames[:, :3, :3], local - frames[:, :3, 3]) / len(frames)
        elif tool is not None:
            base = registered(frames[:, :3, 3] + frames[:, :3, :3] @ tool, readings)
        else:
            return placed(frames, readings, reach)
        points = (frames[:, :3, 3] + frames[:, :3, :3] @ tool) @ base[:3, :3].T + base[:3, 3]
        left = readings - points[:, : readings.shape[1]]
        return Placement(base, tool, float(np.sqrt(np.mean(np.sum(left**2, axis=1)))))


TRACKER = Tracker()
