"""Few convex pieces that together contain the surface of a body: capsules, or boxes.

The surface is cut into small faces. A piece takes whole faces, all corners of which it contains; as it is convex, it
contains the faces. The piece around all of them is parted in two by the plane that leaves out most, again and again.
Pieces may be hollow: what is joined to something outside is not inside without crossing the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from scipy.optimize import minimize

from identification.arrays import Array
from identification.workspace import cut

Cut: TypeAlias = tuple[float, float, list[Array]]  # volume of the piece around a part, what its best cut saves, halves


def parted(whole: Array, best_cut: Callable[[Array], Cut], most: int) -> list[Array]:
    """At most so many parts, as long as a cut saves a hundredth of the volume."""
    parts = [(whole, *best_cut(whole))]
    while len(parts) < most:
        k = max(range(len(parts)), key=lambda k: parts[k][2])
        if parts[k][2] <= 0.01 * sum(volume for _, volume, *_ in parts):
            break
        parts[k : k + 1] = [(half, *best_cut(half)) for half in parts[k][3]]
    return [part for part, *_ in parts]


# -- capsules ----------------------------------------------------------------------------------------------------------
def capsules_around(triangles: Array, most: int = 8) -> Array:
    """(k, 7) ends and radii of at most `most` capsules that contain triangles (t, 3, 3)."""
    capsules = []
    for faces in parted(cut(triangles, max(float(np.ptp(triangles, axis=(0, 1)).max()), 1.0) / 16), best_plane, most):
        points = faces.reshape(-1, 3)
        first = capsule_around(points)
        simplex = first[:6] + np.r_[np.zeros((1, 6)), 0.1 * first[6] * np.eye(6)]
        options = {"initial_simplex": simplex, "maxfev": 150}  # more gain less than 1 % of the volume
        fit = minimize(lambda ends, p=points: volume(about(ends, p)), first[:6], method="Nelder-Mead", options=options)
        capsules.append(about(fit.x, points) + np.r_[np.zeros(6), 1e-6])
    return np.array(capsules)


def best_plane(faces: Array) -> Cut:
    """Of faces (f, 3, 3), across x, y or z in one of seven places; sizes are by a thousand corners."""

    def size(part: Array) -> float:
        points = part.reshape(-1, 3)
        return volume(capsule_around(points[:: 1 + len(points) // 1000]))

    whole, saved, halves = size(faces), 0.0, list[Array]()
    for middles in faces.mean(axis=1).T:
        for place in np.linspace(middles.min(), middles.max(), 9)[1:-1]:
            two = [faces[middles < place], faces[middles >= place]]
            if all(map(len, two)) and (gain := whole - sum(map(size, two))) > saved:
                saved, halves = gain, two
    return whole, saved, halves


def capsule_around(points: Array) -> Array:
    """(7,) a capsule that contains points (m, 3), along the one of their principal axes along which it is smallest."""
    axes, capsules = np.linalg.eigh(np.cov(points.T))[1], []
    x = points @ axes
    middle = 0.5 * (x.min(axis=0) + x.max(axis=0))
    squares = (x - middle) ** 2
    for k in range(3):
        off, ends = squares.sum(axis=1) - squares[:, k], np.tile(middle, (2, 1))
        beyond = np.sqrt(off.max() - off)  # how far beyond an end the ball around it reaches
        low, high = np.min(x[:, k] + beyond), np.max(x[:, k] - beyond)
        ends[:, k] = (low, high) if low < high else 0.5 * (low + high)
        capsules.append(about((ends @ axes.T).ravel(), points))
    return min(capsules, key=volume)


def about(ends: Array, points: Array) -> Array:
    """(7,) the capsule of two ends (6,) that contains points (m, 3)."""
    return np.r_[ends, from_capsules(np.r_[ends, 0.0][None], points).max()]


def volume(capsule: Array) -> float:
    """Of a capsule (7,) [mm^3]."""
    length, radius = np.linalg.norm(capsule[3:6] - capsule[:3]), capsule[6]
    return float(np.pi * radius**2 * (length + 4.0 / 3.0 * radius))


def from_capsules(capsules: Array, points: Array) -> Array:
    """(m, k) signed distances of points (m, 3) from capsules (k, 7)."""
    start, along = capsules[:, :3], capsules[:, 3:6] - capsules[:, :3]
    squares = np.maximum(np.sum(along**2, axis=1), 1e-9)
    offset = points @ along.T - np.sum(start * along, axis=1)
    share = np.clip(offset / squares, 0.0, 1.0)
    from_start = np.einsum("mj,mj->m", points, points)[:, None] - 2.0 * points @ start.T + np.sum(start**2, axis=1)
    return np.sqrt(np.maximum(from_start + share * (share * squares - 2.0 * offset), 0.0)) - capsules[:, 6]


# -- boxes -------------------------------------------------------------------------------------------------------------
def boxes_around(triangles: Array, place: Array | None = None, most: int = 32) -> Array:
    """(k, 15) centers, rotation matrices and half sizes of at most `most` boxes, along the axes of the triangles, that
    contain the triangles (t, 3, 3).

    place : (4, 4) pose of the frame of the triangles in that of the boxes; None: the same
    """
    cell = max(float(np.ptp(triangles, axis=(0, 1)).max()), 1.0) / 64
    faces = cut(triangles, 0.5 * cell)
    grid = np.floor((faces.mean(axis=1) - triangles.min(axis=(0, 1))) / cell).astype(int)
    _, number = np.unique(grid @ [1 << 20, 1 << 10, 1], return_inverse=True)
    ends = np.tile([[[np.inf], [-np.inf]]], (number.max() + 1, 1, 3))  # (f, 2, 3) of boxes around all faces of a cell
    np.minimum.at(ends[:, 0], number, faces.min(axis=1))
    np.maximum.at(ends[:, 1], number, faces.max(axis=1))

    def volumes(ends: Array) -> Array:
        """(f,) of the boxes around the first 1 .. f of boxes, where none counts as thinner than a cell."""
        size = np.maximum.accumulate(ends[:, 1]) - np.minimum.accumulate(ends[:, 0])
        return np.asarray(np.maximum(size, cell).prod(axis=1))

    def best_cut(ends: Array) -> Cut:
        whole, best, halves = volumes(ends)[-1], 0.0, list[Array]()
        for axis in range(3) if len(ends) > 1 else ():
            ordered = ends[np.argsort(ends[:, :, axis].sum(axis=1), kind="stable")]
            saved = whole - volumes(ordered)[:-1] - volumes(ordered[::-1])[-2::-1]
            if saved.max() > best:
                at = int(saved.argmax()) + 1
                best, halves = float(saved.max()), [ordered[:at], ordered[at:]]
        return whole, best, halves

    parts = parted(ends, best_cut, most)
    turn, origin = (np.eye(3), np.zeros(3)) if place is None else (place[:3, :3], place[:3, 3])
    low, high = np.array([[part[:, 0].min(axis=0), part[:, 1].max(axis=0)] for part in parts]).swapaxes(0, 1)
    turns = np.tile(turn.ravel(), (len(parts), 1))
    return np.hstack([0.5 * (low + high) @ turn.T + origin, turns, np.maximum(0.5 * (high - low), 1e-3)])
