"""A tracker, which reads where points are."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from identification.instruments.base import Coordinate, Instrument, Placement, Unplaced, registered
from identification.kinematics.frames import nearest_rotation
from identification.kinematics.parameters import AXES

ENOUGH = 1e-6  # relative fall of the sum of squares in a round, below which a least-squares fit goes on from here


@dataclass(frozen=True)
class Tracker(Instrument):
    """A laser tracker, a camera system, a coordinate measuring machine: positions of one or several reflectors in the
    frame of the instrument, in the plane the first two coordinates, or the pose of a measured frame.

    angle_scale : [mm/rad] that a radian of a measured orientation counts as; None: only points are measured
    """

    angle_scale: float | None = None  # type: ignore[misc]  # of the class, where it is none
    coordinates = tuple(Coordinate(axis) for axis in AXES)
    reads_positions = True

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return point

    def place(self, rows: Unplaced) -> Placement:
        """Base and tool that explain measured points best, whatever is `hopeless`; both by turns from each start.

        All that a turn needs of the rows are means, of positions p and rotations R of the tip and measured points y,
        each less its mean: so a turn costs the same for any number of them.
        """
        frames, measured, _, base, tool, *_ = rows
        if tool is None and base is not None:  # that explains the measured points best, each in the frame of its tip
            local = (measured - base[:3, 3]) @ base[:3, :3]  # in the base's frame
            tool = np.einsum("mji,mj->i", frames[:, :3, :3], local - frames[:, :3, 3]) / len(frames)
        elif tool is None:
            p, turn, y = (a - a.mean(axis=0) for a in (frames[:, :3, 3], frames[:, :3, :3], measured))
            m, tools = len(p), rows.tools[:7]
            points, turns = y.T @ p / m, np.einsum("mk,mij->kij", y, turn) / m  # of y p^T (3, 3), of y_k R (3, 3, 3)
            # of R^T p, of R^T R
            along, gram = np.einsum("mji,mj->i", turn, p) / m, np.einsum("mji,mjk->ik", turn, turn) / m
            values, axes = np.linalg.eigh(gram)
            # what moves a point 1 mm from the flange's center by less than 0.01 mm (RMS) is lost in a drawing's errors
            inverse = (axes * np.divide(1.0, values, out=np.zeros(3), where=values > 0.01**2)) @ axes.T
            squared, before = float(np.sum(p**2 + y**2)) / m, np.full(len(tools), np.inf)
            for _ in range(200):  # effort: turns of each start
                rotations = nearest_rotation(points + np.einsum("kij,sj->ski", turns, tools))  # (s, 3, 3) of the base
                crossed = np.einsum("ski,kij->sj", rotations, turns)
                tools = (crossed - along) @ inverse
                # (s,) mean squared distances left [mm^2]
                squares = 2.0 * tools @ along + np.einsum("si,ij,sj->s", tools, gram, tools)
                squares += squared - 2.0 * (np.einsum("ski,ki->s", rotations, points) + np.sum(crossed * tools, axis=1))
                if np.all(squares > before * (1.0 - ENOUGH)):
                    break
                before = squares
            tool = tools[np.argmin(squares)]
        points = frames[:, :3, 3] + frames[:, :3, :3] @ tool
        base = registered(points, measured) if base is None else base
        left = measured - (points @ base[:3, :3].T + base[:3, 3])[:, : measured.shape[1]]
        return Placement(base, tool, float(np.sqrt(np.mean(np.sum(left**2, axis=1)))))


TRACKER = Tracker()
