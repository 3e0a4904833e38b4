"""A tracker, which reads where points are."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from identification.instruments.base import Coordinate, Instrument, Placement, Unplaced, placed
from identification.kinematics.parameters import AXES


@dataclass(frozen=True)
class Tracker(Instrument):
    """A laser tracker, a camera system, a coordinate measuring machine: positions of one or several reflectors in the
    frame of the instrument, in the plane the first two coordinates, or the pose of a measured frame."""

    coordinates = tuple(Coordinate(axis) for axis in AXES)
    reads_positions = True

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return point

    def place(self, rows: Unplaced) -> Placement:
        return placed(rows)


TRACKER = Tracker()
