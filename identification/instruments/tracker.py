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
        return self.place_each(rows._replace(frames=rows.frames[None], readings=rows.readings[None]))[0]

    def place_each(self, rows: Unplaced) -> list[Placement]:
        """Base and tool that explain measured points best, whatever is `hopeless`; both by turns from each start.

        All that a turn needs of the rows are means, of positions p and rotations R of the tip and measured points y,
        each less its mean: so a turn costs the same for any number of them.
        """
        places, rotations, measured = rows.frames[..., :3, 3], rows.frames[..., :3, :3], rows.readings
        k, m, tool = len(measured), measured.shape[1], rows.tool
        if tool is None and rows.base is not None:  # that explains the points best, each in the frame of its tip
            local = (measured - rows.base[:3, 3]) @ rows.base[:3, :3]  # in the base's frame
            tool = np.einsum("kmji,kmj->ki", rotations, local - places) / m
        elif tool is None:
            p, turn, y = (a - a.mean(axis=1, keepdims=True) for a in (places, rotations, measured))
            # means of y p^T (9,), of y_k R (9, 3), of R^T p (3,) and of R^T R (3, 3)
            points, turns = (y.mT @ p).reshape(k, 9) / m, (y.mT @ turn.reshape(k, m, 9)).reshape(k, 9, 3) / m
            along, gram = (np.einsum(f"kmji,kmj{x}->ki{x}", turn, of) / m for x, of in (("", p), ("n", turn)))
            values, axes = np.linalg.eigh(gram)
            # what moves a point 1 mm from the flange's center by less than 0.01 mm (RMS) is lost in a drawing's errors
            inverse = np.divide(1.0, values, out=np.zeros((k, 3)), where=values > 0.01**2)
            inverse = (axes * inverse[:, None]) @ axes.mT
            # with the best tool for a base's rotation, of the products w (16) of a unit quaternion's entries, the mean
            # square is c - 2 b w - w A w, A positive: each turn takes the w best for the slope b + A w, an eigenvector
            least = np.einsum("kij,kj->ki", inverse, along)
            best, mixed = points - np.einsum("kij,kj->ki", turns, least), turns @ inverse @ turns.mT
            b, a = (best @ OF_QUATERNION)[:, None], OF_QUATERNION.T @ mixed @ OF_QUATERNION
            constant = (np.sum(p**2 + y**2, axis=(1, 2)) / m - np.sum(along * least, axis=1))[:, None]

            def best_for(slopes: Array) -> Array:
                quaternions = np.linalg.eigh(slopes.reshape(-1, 4, 4))[1][..., -1]
                return (quaternions[:, :, None] * quaternions[:, None]).reshape(slopes.shape)

            w = best_for((points[:, None] + rows.tools[:7] @ turns.mT) @ OF_QUATERNION)
            going, squares = np.arange(k), np.zeros(w.shape[:2])
            for _ in range(200):  # effort: turns of each start
                slopes = b[going] + w[going] @ a[going]
                step = best_for(slopes) - w[going]
                w[going], change = w[going] + step, step @ a[going]
                # (k, s) mean squares [mm^2], and their falls, which as differences would be lost in rounding
                squares[going] = constant[going] - np.sum((slopes + change + b[going]) * w[going], axis=2)
                falls = np.sum((2.0 * slopes + change) * step, axis=2)
                going = going[np.any(falls > ENOUGH * np.maximum(squares, 1e-24 * constant)[going], axis=1)]
                if not len(going):
                    break
            chosen = w[np.arange(k), np.argmin(squares, axis=1)]
            tool = np.einsum("kij,kj->ki", inverse, np.einsum("kij,ki->kj", turns, chosen @ OF_QUATERNION.T) - along)
        tool = np.broadcast_to(tool, (k, 3))
        points = places + (rotations @ tool[:, None, :, None])[..., 0]
        base = registered(points, measured) if rows.base is None else np.broadcast_to(rows.base, (k, 4, 4))
        left = measured - (points @ base[:, :3, :3].mT + base[:, None, :3, 3])[..., : measured.shape[2]]
        return [*map(Placement, base, tool, np.sqrt(np.mean(np.sum(left**2, axis=2), axis=1)).tolist())]


TRACKER = Tracker()
