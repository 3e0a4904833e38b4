"""A tracker, which reads where points are."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.instruments.base import Coordinate, Instrument, Placement, Unplaced, registered
from identification.kinematics.frames import OF_QUATERNION
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
            m = len(p)
            # means of y p^T (9,), of y_k R (9, 3), of R^T p (3,) and of R^T R (3, 3)
            points, turns = (y.T @ p).ravel() / m, np.einsum("mk,mij->kij", y, turn).reshape(9, 3) / m
            along, gram = np.einsum("mji,mj->i", turn, p) / m, np.einsum("mji,mjk->ik", turn, turn) / m
            values, axes = np.linalg.eigh(gram)
            # what moves a point 1 mm from the flange's center by less than 0.01 mm (RMS) is lost in a drawing's errors
            inverse = (axes * np.divide(1.0, values, out=np.zeros(3), where=values > 0.01**2)) @ axes.T
            # with the best tool for a base's rotation, of the products w (16) of a unit quaternion's entries, the mean
            # square is c - 2 b w - w A w, A positive: each turn takes the w best for the slope b + A w, an eigenvector
            best, mixed = points - turns @ inverse @ along, turns @ inverse @ turns.T
            b, a = best @ OF_QUATERNION, OF_QUATERNION.T @ mixed @ OF_QUATERNION
            constant = float(np.sum(p**2 + y**2)) / m - along @ inverse @ along

            def best_for(slopes: Array) -> Array:
                quaternions = np.linalg.eigh(slopes.reshape(-1, 4, 4))[1][..., -1]
                return (quaternions[:, :, None] * quaternions[:, None]).reshape(-1, 16)

            w = best_for((points + rows.tools[:7] @ turns.T) @ OF_QUATERNION)
            for _ in range(200):  # effort: turns of each start
                slopes = b + w @ a
                step = best_for(slopes) - w
                w, change = w + step, step @ a
                # (s,) mean squares [mm^2], and their falls, which as differences would be lost in rounding
                squares = constant - np.sum((slopes + change + b) * w, axis=1)
                falls = np.sum((2.0 * slopes + change) * step, axis=1)
                if np.all(falls <= ENOUGH * squares.clip(min=1e-24 * constant)):
                    break
            tool = inverse @ (turns.T @ OF_QUATERNION @ w[np.argmin(squares)] - along)
        points = frames[:, :3, 3] + frames[:, :3, :3] @ tool
        base = registered(points, measured) if base is None else base
        left = measured - (points @ base[:3, :3].T + base[:3, 3])[:, : measured.shape[1]]
        return Placement(base, tool, float(np.sqrt(np.mean(np.sum(left**2, axis=1)))))


TRACKER = Tracker()
