"""A six-axis arm as lines in space, in plain numpy: the independent simulator of the spatial demo.

At home each joint's axis is a line. The measured point is turned about the last one, then about the one before, and so
on down to the first (a product of exponentials), and seen by a tracker. Its errors are those of the lines; the model
that is fitted has frames and local corrections instead, and nothing of it is used here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array


@dataclass(frozen=True)
class LinesInSpace:
    """The real arm.

    points, axes : (n, 3) a point [mm] and the direction of each axis at home;  offsets : (n,) of the joints [rad]
    reflector : (3,) at home [mm];  origin, orientation : (3,) [mm] and (3, 3) of the base in the tracker's frame
    eccentric : joint, from 0, whose encoder sits off centre;  wave : its error's cosine and sine [rad]
    """

    points: Array
    axes: Array
    offsets: Array
    reflector: Array
    origin: Array
    orientation: Array
    eccentric: int
    wave: tuple[float, float]

    def positions(self, postures: Array) -> Array:
        """(m, 3) places of the reflector [mm] that the tracker sees at (m, n) angles that the encoders show [rad]."""
        shown = postures[:, self.eccentric]
        real = postures + self.offsets
        real[:, self.eccentric] += self.wave[0] * np.cos(shown) + self.wave[1] * np.sin(shown)
        places = np.tile(self.reflector, (len(postures), 1))
        for point, axis, angles in zip(self.points[::-1], self.axes[::-1], real.T[::-1], strict=True):
            places = point + rotated_about(places - point, axis / np.linalg.norm(axis), angles)
        return np.asarray(self.origin + places @ self.orientation.T)


def rotated_about(vectors: Array, axis: Array, angles: Array) -> Array:
    """(m, 3) vectors turned about a unit axis by (m,) angles: the formula of Rodrigues."""
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    along = (vectors @ axis)[:, None] * axis
    return np.asarray(cosine * (vectors - along) + sine * np.cross(axis, vectors) + along)


def displaced_lines(
    points: Array, axes: Array, generator: np.random.Generator, shift: float, lean: float
) -> tuple[Array, Array]:
    """Lines a little off those drawn: points by `shift` [mm] and unit axes by `lean` [rad], per coordinate."""
    return points + shift * generator.standard_normal(points.shape), axes + lean * generator.standard_normal(axes.shape)
