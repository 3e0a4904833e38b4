"""Few convex pieces that together contain the surface of a body: capsules, or boxes.

The surface is cut into small faces. A piece takes whole faces, all corners of which it contains; as it is convex, it
contains the faces.

Capsules are fitted: with d(x) the distance from their union, negative inside, of points x_i of the surface and points
y_j around it,

    weight * mean(max(d(x_i), 0)^2) + s^0.5 mean(max(-d(y_j), 0)^1.5) -> min,    s = 10 mm,

by L-BFGS with a growing weight, from one capsule for each of 1, 2, 4 .. parts of the body; the fewest stay that are
nearly as good as any. Then those points of the surface are added that stick out most, and in the end radii grow until
every face is contained.

The box around the surface is parted in two where that leaves out most, again and again. Boxes may be hollow: what is
joined to something outside is not inside without crossing the surface.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.optimize import minimize

from identification.arrays import Array
from identification.workspace import cut

Index = NDArray[np.intp]
STILL = np.eye(4)  # the pose of a frame in itself


# -- capsules ----------------------------------------------------------------------------------------------------------
def capsules_around(triangles: Array, most: int = 8) -> Array:
    """(k, 7) ends and radii of at most `most` capsules that contain triangles (t, 3, 3)."""
    size = np.ptp(triangles, axis=(0, 1))
    longest = max(float(size.max()), 1.0)
    cell = max(float(np.prod(np.maximum(size, longest / 20))) ** (1 / 3), longest / 6) / 16  # 16 along a cube as large
    faces = cut(triangles, 0.5 * cell)
    surface, around, inside = points_about(faces, cell)
    parts, found = [inside], list[tuple[float, Array]]()
    for many in (min(2**k, most) for k in range(most.bit_length() + 1)):
        while len(parts) < many:  # the one that varies most is cut in two across where it does
            part = parts.pop(int(np.argmax([len(each) * np.var(each, axis=0).sum() for each in parts])))
            middle = part.mean(axis=0)
            along = (part - middle) @ np.linalg.eigh((part - middle).T @ (part - middle))[1][:, 2]
            halves = [part[along < 0.0], part[along >= 0.0]]
            parts += halves if min(map(len, halves)) else [part, part]
        found.append(fitted(np.array([like(part) for part in parts]), surface, around, 3.0, 100.0))
        if -from_capsules(found[-1][1], around)[0].min(initial=0.0) < max(0.3 * cell, 3.0) or many == most:
            break
    best = min(value for value, _ in found)
    capsules = next(each for value, each in found if value <= 1.35 * best)  # fewer, if they are nearly as good
    for weight in (1000.0, 10000.0):
        some = spread(faces, 5000)
        lacking = sticking_out(capsules, some)[0]
        surface = np.concatenate([surface, some[np.argsort(-lacking)[:100]].reshape(-1, 3)])
        capsules = fitted(capsules, surface, around, weight)[1]
    lacking, own = sticking_out(capsules, faces)
    np.maximum.at(grown := np.zeros(len(capsules)), own, lacking)
    capsules[:, 6] += grown + 1e-6
    return capsules


def from_capsules(capsules: Array, points: Array) -> tuple[Array, Array]:
    """(m, k) signed distances of points (m, 3) from capsules (k, 7), and where on each axis, 0 to 1, they are from."""
    start, along, radius = capsules[:, :3], capsules[:, 3:6] - capsules[:, :3], capsules[:, 6]
    squared = np.maximum(np.vecdot(along, along), 1e-9)
    offset = points @ along.T - np.vecdot(start, along)
    at = np.clip(offset / squared, 0.0, 1.0)
    to_start = np.vecdot(points, points)[:, None] - 2.0 * points @ start.T + np.vecdot(start, start)
    return np.sqrt(np.maximum(to_start + at * (at * squared - 2.0 * offset), 0.0)) - radius, at


def objective(flat: Array, surface: Array, around: Array, weight: float) -> tuple[float, Array]:
    """As above, and its gradient."""
    capsules = flat.reshape(-1, 7)
    value, gradient = 0.0, np.zeros_like(capsules)
    for points, sign, factor in ((surface, 1.0, weight / len(surface)), (around, -1.0, 1.0 / max(len(around), 1))):
        from_each, at = from_capsules(capsules, points)
        own = from_each.argmin(axis=1)
        d = from_each[np.arange(len(points)), own]
        rows = np.flatnonzero(sign * d > 0.0)
        d, own = d[rows], own[rows]
        slope = 2.0 * d if sign > 0.0 else -1.5 * np.sqrt(-10.0 * d)
        value += factor * float(slope @ d) / (2.0 if sign > 0.0 else 1.5)
        ends, at = capsules[own], at[rows, own][:, None]
        away = points[rows] - ends[:, :3] - at * (ends[:, 3:6] - ends[:, :3])
        away /= np.maximum(d + ends[:, 6], 1e-9)[:, None]
        slopes = np.zeros((len(capsules), len(rows)))
        slopes[own, np.arange(len(rows))] = factor * slope
        gradient -= np.concatenate([slopes @ ((1.0 - at) * away), slopes @ (at * away), slopes.sum(axis=1)[:, None]], 1)
    return value, gradient.ravel()


def fitted(capsules: Array, surface: Array, around: Array, *weights: float) -> tuple[float, Array]:
    """The objective, and capsules (k, 7), after some steps with each weight."""
    for weight in weights:
        data = surface, around, weight
        fit = minimize(objective, capsules.ravel(), data, jac=True, method="L-BFGS-B", options={"maxiter": 30})
        capsules = fit.x.reshape(-1, 7)
        capsules[:, 6] = np.abs(capsules[:, 6])
    return float(fit.fun), capsules


def sticking_out(capsules: Array, faces: Array) -> tuple[Array, Index]:
    """(f,) how much the capsule that lacks least lacks of each face (f, 3, 3) [mm], 0: nothing, and its number."""
    lacking = from_capsules(capsules, faces.reshape(-1, 3))[0].reshape(len(faces), 3, -1).max(axis=1)
    best = lacking.argmin(axis=1)
    return np.maximum(lacking[np.arange(len(faces)), best], 0.0), best


def like(points: Array) -> Array:
    """(7,) a capsule about as long and wide as points (m, 3) that fill a body."""
    middle = points.mean(axis=0)
    squares, axes = np.linalg.eigh((points - middle).T @ (points - middle) / len(points))
    narrow, wide, long = np.sqrt(np.maximum(squares, 1e-9))
    radius = 2.0 * np.sqrt(narrow * wide)
    half = max(np.sqrt(3.0) * long - 0.7 * radius, 0.1 * radius) * axes[:, 2]
    return np.r_[middle - half, middle + half, radius]


def spread(points: Array, most: int) -> Array:
    """At most so many of the points, at equal steps of their order."""
    return points[np.linspace(0, len(points) - 1, min(len(points), most)).astype(int)]


def points_about(faces: Array, cell: float, most: int = 800) -> tuple[Array, Array, Array]:
    """Points of the surface, points around it, and centers of the cells of a grid that the body fills. A cell is filled
    where the surface is in it, or on both sides along at least two of the three axes: the inside of an open surface,
    and of a bore."""
    farthest = 6  # cells
    low = faces.min(axis=(0, 1)) - (farthest + 1) * cell
    shape = (np.ceil(np.ptp(faces, axis=(0, 1)) / cell) + 2 * farthest + 3).astype(int)
    filled = np.zeros(shape, dtype=bool)

    def at(points: Array) -> tuple[Index, ...]:
        return tuple(((points - low) / cell).astype(int).T)

    filled[at(faces.reshape(-1, 3))] = True
    one_of_each_cell = np.unique(np.ravel_multi_index(at(faces[:, 0]), tuple(shape)), return_index=True)[1]
    chosen = spread(faces[one_of_each_cell], most)
    so_far = [(filled.cumsum(axis), filled.sum(axis, keepdims=True)) for axis in range(3)]  # along it, and of all
    filled |= np.sum([(some > 0) & (some < whole) for some, whole in so_far], axis=0) >= 2
    normal = np.cross(chosen[:, 1] - chosen[:, 0], chosen[:, 2] - chosen[:, 0])
    normal *= cell / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
    middles, away = chosen.mean(axis=1), distance_transform_edt(~filled)
    # close to the surface, where its other side is not filled
    near = [(middles + 0.2 * side)[~filled[at(middles + 1.8 * side)]] for side in (normal, -normal)]
    far, inside = (low + (np.argwhere(some) + 0.5) * cell for some in ((away >= 1.8) & (away <= farthest), filled))
    return chosen[:, 0], np.concatenate([*near, spread(far, most // 2)]), inside


# -- boxes -------------------------------------------------------------------------------------------------------------
def boxes_around(triangles: Array, place: Array = STILL, most: int = 32) -> Array:
    """(k, 15) centers, rotation matrices and half sizes of at most `most` boxes, along the axes of the triangles, that
    contain the triangles (t, 3, 3);  place : (4, 4) pose of the frame of the triangles in that of the boxes"""
    cell = max(float(np.ptp(triangles, axis=(0, 1)).max()), 1.0) / 64
    faces = cut(triangles, 0.5 * cell)
    grid = np.floor((faces.mean(axis=1) - triangles.min(axis=(0, 1))) / cell).astype(int)
    _, number = np.unique(grid @ [1 << 20, 1 << 10, 1], return_inverse=True)
    ends = np.tile([[[np.inf], [-np.inf]]], (number.max() + 1, 1, 3))  # (f, 2, 3) of boxes around all faces of a cell
    np.minimum.at(ends[:, 0], number, faces.min(axis=1))
    np.maximum.at(ends[:, 1], number, faces.max(axis=1))
    parts, cuts = [ends], [best_cut(ends, cell)]
    while len(parts) < most:
        k = max(range(len(cuts)), key=lambda k: cuts[k][0])
        saved, halves = cuts[k]
        if saved < 0.01 * sum(volumes(part, cell)[-1] for part in parts):
            break
        parts[k : k + 1], cuts[k : k + 1] = halves, [best_cut(half, cell) for half in halves]
    turn, origin = place[:3, :3], place[:3, 3]
    low, high = np.array([[part[:, 0].min(axis=0), part[:, 1].max(axis=0)] for part in parts]).swapaxes(0, 1)
    turns = np.tile(turn.ravel(), (len(parts), 1))
    return np.hstack([0.5 * (low + high) @ turn.T + origin, turns, np.maximum(0.5 * (high - low), 1e-3)])


def volumes(ends: Array, thinnest: float) -> Array:
    """(f,) volumes of the boxes around the first 1 .. f of boxes with ends (f, 2, 3), where none counts as thinner."""
    size = np.maximum.accumulate(ends[:, 1]) - np.minimum.accumulate(ends[:, 0])
    return np.asarray(np.maximum(size, thinnest).prod(axis=1))


def best_cut(ends: Array, thinnest: float) -> tuple[float, list[Array]]:
    """The volume that the best cut of boxes with ends (f, 2, 3) in two saves, and the two."""
    whole, best, halves = volumes(ends, thinnest)[-1], 0.0, list[Array]()
    for axis in range(3) if len(ends) > 1 else ():
        ordered = ends[np.argsort(ends[:, :, axis].sum(axis=1), kind="stable")]
        saved = whole - volumes(ordered, thinnest)[:-1] - volumes(ordered[::-1], thinnest)[-2::-1]
        if saved.max() > best:
            at = int(saved.argmax()) + 1
            best, halves = float(saved.max()), [ordered[:at], ordered[at:]]
    return best, halves
