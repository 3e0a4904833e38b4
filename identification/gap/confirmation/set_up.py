"""A hold-out of another set-up: base or instrument stand elsewhere, the measured point is another one.

What is predicted of a point y_i with the axes R_i of the tip for the instrument then becomes

    A (y_i + R_i t) + s,    A, s: motion of base or instrument;  t: from the old to the new point, in the tip's frame

These few numbers are found in the hold-out, as `armcal validate` finds them; nothing else of the models is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from identification.arrays import Array
from identification.estimation.plausibility import FALL
from identification.kinematics.placement import placed, placed_tool, registered
from identification.measurements import Measurements

GAIN = 1.25  # of the sum of squares: what more is refitted must save
ROUNDS = 50  # effort; Gauss-Newton steps, of which a few are taken
SMALL = 1e-9  # of the reach: a step that ends them
PLANE = 2


class SetUp(NamedTuple):
    """What is refitted to a hold-out: where base and instrument stand, and measured points by their names."""

    base: bool = False
    points: tuple[str, ...] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """The same in words."""
        return ("base",) * self.base + tuple(f"reflector {name}" if name else "reflector" for name in self.points)


class Predicted(NamedTuple):
    """What a model predicts of the rows of a hold-out.

    points : (m, d) [mm];  axes : (m, 3, 3) of the tip for the instrument, None in a plane and where lengths are read
    measured : (m, d) [mm];  reach : of the arm [mm];  names : (m,) of the measured points, "" where there are none
    """

    points: Array
    axes: Array | None
    measured: Array
    reach: float
    names: NDArray[np.str_]

    def residuals(self, set_up: SetUp) -> Array:
        """(m, d) measured less predicted [mm], with what is refitted; larger by as much as the values fitted to these
        rows make them smaller."""
        if set_up == SetUp():
            return self.measured - self.points
        count = (3 if self.axes is None else 6) * set_up.base + 3 * len(set_up.points)
        left = self._in_plane() if self.axes is None else self._in_space(set_up)
        return np.asarray(left * np.sqrt(left.size / max(left.size - count, 1.0)))

    def _in_plane(self) -> Array:
        own, goal = (a @ np.array([1.0, 1.0j]) for a in (self.points, self.measured))
        center, target = own.mean(), goal.mean()
        turn = np.exp(1.0j * np.angle(np.vdot(own - center, goal - target)))
        left = goal - target - turn * (own - center)
        return np.column_stack([left.real, left.imag])

    def _in_space(self, set_up: SetUp) -> Array:
        assert self.axes is not None
        which = np.array([self.names == name for name in set_up.points]).reshape(len(set_up.points), len(self.points))
        motion, moved = self._start(set_up, which)
        for _ in range(ROUNDS):
            shift = np.einsum("mij,gj,gm->mi", self.axes, moved, which)
            points = (self.points + shift) @ motion[:3, :3].T
            left = self.measured - points - motion[:3, 3]
            columns = [np.einsum("ij,mjk,m->mik", motion[:3, :3], self.axes, own) for own in which]
            center = points.mean(axis=0)
            if set_up.base:  # turned about the middle of the points
                turns = np.swapaxes(np.cross(np.eye(3), (points - center)[:, None, :]), 1, 2)
                columns += [np.tile(np.eye(3), (len(points), 1, 1)), turns]
            table = np.concatenate(columns, axis=2).reshape(left.size, -1)
            step = np.linalg.lstsq(table, left.ravel(), rcond=1e-9)[0].reshape(-1, 3)
            moved = moved + step[: len(moved)]
            if set_up.base:
                turn = Rotation.from_rotvec(step[-1]).as_matrix()
                motion = motion.copy()
                motion[:3, :3] = turn @ motion[:3, :3]
                motion[:3, 3] = motion[:3, 3] + step[-2] + center - turn @ center
            lengths = step * np.array([[1.0]] * (len(step) - 1) + [[self.reach if set_up.base else 1.0]])
            if np.max(np.abs(lengths)) <= SMALL * self.reach:
                break
        return left

    def _start(self, set_up: SetUp, which: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Motion (4, 4) and displacements (g, 3) from which steps lead to the least squares."""
        assert self.axes is not None
        frames = np.tile(np.eye(4), (len(self.points), 1, 1))
        frames[:, :3, :3], frames[:, :3, 3] = self.axes, self.points
        motion, same = np.eye(4), ~which.any(axis=0)
        if set_up.base and np.count_nonzero(same) > PLANE:
            motion = registered(self.points[same], self.measured[same])
        elif set_up.base:
            most = which[int(np.argmax(which.sum(axis=1)))]
            motion = placed(frames[most], self.measured[most], self.reach).base
        moved = [placed_tool(frames[own], self.measured[own], motion) for own in which]
        return motion, np.array(moved).reshape(-1, 3)


def point_names(measurements: Measurements, holdout: Measurements) -> tuple[Array | None, tuple[str, ...]]:
    """(m,) number of each held-out row's point among those of the data, 0 for others; and the names of these others.

    One point of the data is the one of the hold-out, whatever it is called there, as in an arm file.
    """
    names, numbers = measurements.marker_names, holdout.marker_numbers
    if numbers is None or not names:
        return None, ()
    if len(names) == 1 == len(set(holdout.marker.tolist() if holdout.marker is not None else ())):
        return np.zeros(len(holdout)), ()
    number = {name: k for k, name in enumerate(names)}
    own = np.array([number.get(name, 0) for name in holdout.marker_names], dtype=float)
    there = set(holdout.marker.tolist() if holdout.marker is not None else ())
    return own[numbers], tuple(name for name in holdout.marker_names if name in there and name not in number)


def set_up_of(predicted: Predicted, fresh: tuple[str, ...], elsewhere: bool) -> SetUp:
    """The least that has to be refitted: points of names that the data do not have, and where rows may be of another
    set-up (`elsewhere`) what makes the RMS fall by `FALL`."""
    if predicted.axes is None:
        options = [SetUp(), SetUp(base=True)] if predicted.points.shape[1] == PLANE and elsewhere else [SetUp()]
    elif fresh:
        options = [SetUp(points=fresh), SetUp(True, fresh)]
    elif elsewhere:
        every = tuple(dict.fromkeys(predicted.names.tolist()))
        options = [SetUp(), SetUp(points=every), SetUp(base=True), SetUp(True, every)]
    else:
        options = [SetUp()]
    free = [3 * (predicted.points.shape[1] - 1) * one.base + 3 * len(one.points) for one in options]
    options = [one for one, count in zip(options, free, strict=True) if predicted.measured.size > 2 * count]
    if not options:
        return SetUp(points=fresh)
    squares = [float(np.sum(np.square(predicted.residuals(one)))) for one in options]
    if squares[0] <= FALL**2 * squares[-1]:
        return options[0]
    return next(one for one, left in zip(options, squares, strict=True) if left <= GAIN * squares[-1])
