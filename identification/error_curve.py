"""A smooth function of one joint angle, by its values at equally spaced nodes: a cubic spline that ends at zero.

It is a sum of cubic B-splines, one centered on each node (C. de Boor, "A Practical Guide to Splines", 1978). Beyond the
first and the last node nothing is known: there the function goes smoothly to zero within two node spacings. A joint
that was turned once around is where it was: encoder and gear repeat themselves there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arrays import Array, ByValue, readonly
from identification.errors import InputError

FEWEST = 4  # nodes


@dataclass(frozen=True, eq=False)
class ErrorCurve(ByValue):
    """start, stop : angle [rad] of the first and the last node;  values : (K,) of the function at the nodes [rad]
    geometry : parameter name -> the part of its value [mm, rad] that belongs to the curve, fitted together with it;
        shifts of the base along its own axes. Empty: not known
    """

    start: float
    stop: float
    values: Array
    geometry: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", readonly(self.values, -1))
        object.__setattr__(self, "geometry", MappingProxyType(dict(self.geometry)))
        if not -np.inf < self.start < self.stop < np.inf:
            problem = f"{np.degrees(self.start):g} to {np.degrees(self.stop):g}"
            raise InputError(f"from_deg, to_deg: found {problem}, allowed: finite angles, the lower one first")
        if len(self.values) < FEWEST or not np.all(np.isfinite(self.values)):
            problem = f"{len(self.values)} values"
            raise InputError(f"values_deg: found {problem}, allowed: {FEWEST} or more finite numbers")

    @classmethod
    def through(
        cls, start: float, stop: float, angles: Array, values: Array, count: int, geometry: Mapping[str, float]
    ) -> ErrorCurve:
        """The curve with so many nodes through values (a,) at angles (a,) [rad]; where none are near, the one whose
        steps from node to node are smallest, as those of a random walk are."""
        # numerical: a thousandth of the weight of a value; less than that changes no wave of eight nodes or more
        steps = np.sqrt(1e-3) * np.diff(np.eye(count), axis=0)
        target = np.concatenate([values, np.zeros(count - 1)])
        coefficients = np.linalg.lstsq(np.concatenate([spline_table(angles, start, stop, count), steps]), target)[0]
        padded = np.pad(coefficients, 1)
        at_nodes = (padded[:-2] + 4.0 * padded[1:-1] + padded[2:]) / 6.0
        return cls(start, stop, np.radians(np.round(np.degrees(at_nodes), 7)), geometry)

    @property
    def spacing(self) -> float:
        """Angle from node to node [rad]."""
        return (self.stop - self.start) / (len(self.values) - 1)

    @cached_property
    def coefficients(self) -> Array:
        """(K,) of the B-splines: the values are (c_(k-1) + 4 c_k + c_(k+1)) / 6, with zeros beyond the ends."""
        from scipy.linalg import solve_banded

        count = len(self.values)
        bands = np.repeat([[1.0 / 6.0], [4.0 / 6.0], [1.0 / 6.0]], count, axis=1)
        return readonly(solve_banded((1, 1), bands, self.values))

    def at(self, angles: ArrayLike) -> Array:
        """The function at angles [rad] of any shape; an angle beyond the ends is looked up whole turns away."""
        q = np.asarray(angles, dtype=float)
        edge = 2.0 * self.spacing  # within which the function goes to zero
        beyond = (q < self.start - edge) | (q > self.stop + edge)
        q = np.where(beyond, self.start + np.mod(q - self.start, 2.0 * np.pi), q)
        place, parts = local_splines(q.ravel(), self.start, self.stop, len(self.values))
        padded = np.pad(self.coefficients, 3)  # splines beyond the ends have no coefficient
        return np.einsum("mk,mk->m", parts, padded[place + 3]).reshape(q.shape)

    def holds(self, angles: ArrayLike) -> Array:
        """1 at angles [rad] between the ends, whole turns aside, and 0 beyond; smooth within two node spacings."""
        q, turn = np.asarray(angles, dtype=float), 2.0 * np.pi
        above, below = np.mod(q - self.stop, turn), np.mod(self.start - q, turn)
        inside = np.mod(q - self.start, turn) <= self.stop - self.start
        beyond = np.where(inside | (self.stop - self.start >= turn), 0.0, np.minimum(above, below))
        left = 1.0 - np.minimum(beyond / (2.0 * self.spacing), 1.0)
        return np.asarray(left**2 * (3.0 - 2.0 * left))


def local_splines(angles: Array, start: float, stop: float, count: int) -> tuple[NDArray[np.int64], Array]:
    """(m, 4) numbers of the splines that are not zero at angles (m,), and (m, 4) their values there.

    Numbers from -3 to count + 2: those outside 0 to count - 1 do not exist; where all four do not, they are repeated.
    """
    x = np.clip((angles - start) * (count - 1) / (stop - start), -2.0, count + 1.0)
    first = np.clip(np.floor(x).astype(int) - 1, -3, count - 1)
    place = first[:, None] + np.arange(4)
    t = np.abs(x[:, None] - place)  # from the middle of the spline, in nodes
    return place, (np.maximum(2.0 - t, 0.0) ** 3 - 4.0 * np.maximum(1.0 - t, 0.0) ** 3) / 6.0


def spline_table(angles: Array, start: float, stop: float, count: int) -> Array:
    """(m, count) values at angles (m,) of the splines that exist."""
    place, parts = local_splines(angles, start, stop, count)
    table = np.zeros((len(angles), count + 6))
    np.put_along_axis(table, place + 3, parts, axis=1)
    return table[:, 3:-3]
