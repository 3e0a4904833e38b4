"""Few convex pieces that together contain a body: capsules, or boxes.

A piece takes whole faces, all corners of which it contains; as it is convex, it contains the faces. Faces that no piece
contains are cut, so that no piece need reach farther than it must.

Capsules are fitted: with d(x) the distance from their union, negative inside, of points x_i of the surface and points
y_j around it,

    weight * mean(max(d(x_i), 0)^2) + s^0.5 mean(max(-d(y_j), 0)^1.5) -> min,    s = 10 mm,

by L-BFGS with a growing weight. One more capsule takes a part of what the worst one covers. Then those points of the
surface are added that stick out most, and in the end radii grow until every face is contained; of the best few covers,
with fewer and with more capsules, the one that then covers least around the body is taken.

Boxes are those of a grid: the one that contains the body is cut where that leaves out most, again and again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt
from scipy.optimize import minimize

from identification.arrays import Array

Index = NDArray[np.intp]
Grid = NDArray[np.bool_]


# -- faces -------------------------------------------------------------------------------------------------------------
def _halved(faces: Array) -> Array:
    """(2 t, 3, 3): each face cut in the middle of its longest edge."""
    rows = np.arange(len(faces))
    longest = _edges(faces).argmax(axis=1)
    a, b, c = (faces[rows, (longest + k) % 3] for k in range(3))
    middle = 0.5 * (a + b)
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def _edges(faces: Array) -> Array:
    """(t, 3) lengths."""
    return np.asarray(np.linalg.norm(faces - np.roll(faces, -1, axis=1), axis=2))


def _cut(faces: Array, longest: float) -> Array:
    """The same surface in faces without a longer edge."""
    done = []
    while len(faces):
        large = _edges(faces).max(axis=1) > longest
        done.append(faces[~large])
        faces = _halved(faces[large])
    return np.concatenate(done)


def _dots(one: Array, other: Array) -> Array:
    """(m,) of vectors (m, 3)."""
    return np.asarray(np.einsum("ij,ij->i", one, other))


# -- capsules ----------------------------------------------------------------------------------------------------------
def from_capsules(capsules: Array, points: Array) -> tuple[Array, Array]:
    """(m, k) signed distances of points (m, 3) from capsules (k, 7), and where on each axis, 0 to 1, they are from."""
    start, along, radius = capsules[:, :3], capsules[:, 3:6] - capsules[:, :3], capsules[:, 6]
    squared = np.maximum(_dots(along, along), 1e-9)
    offset = points @ along.T - _dots(start, along)
    at = np.clip(offset / squared, 0.0, 1.0)
    to_start = _dots(points, points)[:, None] - 2.0 * points @ start.T + _dots(start, start)
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


def capsules_around(triangles: Array, most: int = 8) -> Array:
    """(k, 7) ends and radii of at most `most` capsules that contain triangles (t, 3, 3)."""
    size = np.ptp(triangles, axis=(0, 1))
    longest = max(float(size.max()), 1.0)
    cell = max(float(np.prod(np.maximum(size, longest / 20))) ** (1 / 3), longest / 6) / 16  # 24 along a cube as large
    surface, around, inside = _points(triangles, cell)
    parts, found = [inside], list[tuple[float, Array]]()
    while True:
        capsules = np.array([_like(part) for part in parts])
        for weight in (3.0, 100.0):
            value, capsules = fitted(capsules, surface, around, weight)
        found.append((value, capsules))
        tight = -from_capsules(capsules, around)[0].min(initial=0.0) < max(0.3 * cell, 3.0)
        if tight or len(parts) >= most:
            break
        parts = parted(parts, min(2 * len(parts), most))
    capsules = min(found, key=lambda each: each[0])[1]
    for weight in (1000.0, 10000.0):
        faces, _, lacking = _sticking_out(capsules, _spread(triangles, 5000), 0.5 * cell)
        surface = np.concatenate([surface, faces[np.argsort(-lacking)[:100]].reshape(-1, 3)])
        capsules = fitted(capsules, surface, around, weight)[1]
    _, best, lacking = _sticking_out(capsules, triangles, 0.5 * cell)
    np.maximum.at(grown := np.zeros(len(capsules)), best, lacking)
    capsules[:, 6] += grown + 1e-6
    return capsules


def fitted(capsules: Array, surface: Array, around: Array, weight: float) -> tuple[float, Array]:
    """The objective, and capsules (k, 7) after some steps."""
    data, options = (surface, around, weight), {"maxiter": 30}
    fit = minimize(objective, capsules.ravel(), data, jac=True, method="L-BFGS-B", options=options)
    better = fit.x.reshape(-1, 7)
    better[:, 6] = np.abs(better[:, 6])
    return float(fit.fun), better


def _like(points: Array) -> Array:
    """(7,) a capsule about as long and wide as points (m, 3) that fill a body."""
    middle = points.mean(axis=0)
    squares, axes = np.linalg.eigh((points - middle).T @ (points - middle) / len(points))
    narrow, wide, long = np.sqrt(np.maximum(squares, 1e-9))
    radius = 2.0 * np.sqrt(narrow * wide)
    half = max(np.sqrt(3.0) * long - 0.7 * radius, 0.1 * radius) * axes[:, 2]
    return np.r_[middle - half, middle + half, radius]


def parted(parts: list[Array], count: int) -> list[Array]:
    """So many parts: those that vary most are cut in two across where they do."""
    parts = list(parts)
    while len(parts) < count:
        spread = [len(part) * np.var(part, axis=0).sum() * (len(part) > 8) for part in parts]
        part = parts.pop(int(np.argmax(spread)))
        middle = part.mean(axis=0)
        along = (part - middle) @ np.linalg.eigh((part - middle).T @ (part - middle))[1][:, 2]
        parts += [part[along < 0.0], part[along >= 0.0]] if 0 < np.sum(along < 0.0) < len(part) else [part, part]
    return parts


def _spread(points: Array, most: int) -> Array:
    """At most so many of the points, at equal steps of their order."""
    return points[np.linspace(0, len(points) - 1, min(len(points), most)).astype(int)]


def _points(triangles: Array, cell: float, most: int = 800) -> tuple[Array, Array, Array]:
    """Points of the surface, points around it, and centers of the cells of a grid that the body fills.

    A cell is filled where the surface is in it, or on both sides along at least two of the three axes: the inside of an
    open surface, and of a bore.
    """
    faces, farthest = _cut(triangles, 0.5 * cell), 6
    low = faces.min(axis=(0, 1)) - (farthest + 1) * cell
    shape = (np.ceil(np.ptp(faces, axis=(0, 1)) / cell) + 2 * farthest + 3).astype(int)
    filled = np.zeros(shape, dtype=bool)

    def at(points: Array) -> tuple[Index, ...]:
        return tuple(((points - low) / cell).astype(int).T)

    filled[at(faces.reshape(-1, 3))] = True
    one_of_each_cell = np.unique(np.ravel_multi_index(at(faces[:, 0]), tuple(shape)), return_index=True)[1]
    chosen = _spread(faces[one_of_each_cell], most)
    sides = [
        np.logical_or.accumulate(filled, axis) & np.flip(np.logical_or.accumulate(np.flip(filled, axis), axis), axis)
        for axis in range(3)
    ]
    filled |= np.sum(sides, axis=0) >= 2
    normal = np.cross(chosen[:, 1] - chosen[:, 0], chosen[:, 2] - chosen[:, 0])
    normal *= cell / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
    middles, around = chosen.mean(axis=1), []
    for side in (normal, -normal):  # points close to the surface, on the side where it is not filled
        around.append((middles + 0.2 * side)[~filled[at(middles + 1.8 * side)]])
    away = distance_transform_edt(~filled)
    far = np.argwhere((away >= 1.8) & (away <= farthest))
    around.append(_spread(low + (far + 0.5) * cell, most // 2))
    return chosen[:, 0], np.concatenate(around), low + (np.argwhere(filled) + 0.5) * cell


def _sticking_out(capsules: Array, faces: Array, finest: float) -> tuple[Array, Index, Array]:
    """Faces that no capsule contains, cut as long as that may help; for each the capsule that lacks least, and how
    much."""
    found = [(np.empty((0, 3, 3)), np.empty(0, dtype=np.intp), np.empty(0))]
    while len(faces):
        lacking = from_capsules(capsules, faces.reshape(-1, 3))[0].reshape(len(faces), 3, -1).max(axis=1)
        best = lacking.argmin(axis=1)
        least = lacking[np.arange(len(faces)), best]
        small = _edges(faces).max(axis=1) <= finest
        found.append(tuple(each[small & (least > 0.0)] for each in (faces, best, least)))
        faces = _halved(faces[~small & (least > 0.0)])
    faces, best, least = (np.concatenate(each) for each in zip(*found, strict=True))
    return faces, best, least


# -- boxes -------------------------------------------------------------------------------------------------------------
def boxes_around(triangles: Array, place: Array | None = None, most: int = 32) -> Array:
    """(k, 15) centers, rotation matrices and half sizes of at most `most` boxes, along the axes of the triangles, that
    contain the triangles (t, 3, 3) and what they enclose.

    place : (4, 4) pose of the frame of the triangles in that of the boxes; None: the same
    """
    low, size = triangles.min(axis=(0, 1)), np.ptp(triangles, axis=(0, 1))
    cell = max(float(size.max()), 1.0) / 64
    faces = _cut(triangles, 0.5 * cell)
    shape = np.maximum(np.ceil(size / cell - 1e-6), 1.0).astype(int)
    first, last = (
        np.minimum(((ends - low) / cell).astype(int), shape - 1) for ends in (faces.min(axis=1), faces.max(axis=1))
    )
    filled = np.zeros(shape, dtype=bool)
    for corner in np.ndindex(2, 2, 2):  # a face has no part in cells but those of the box around it, of two a side
        filled[tuple(np.where(corner, last, first).T)] = True
    filled = binary_fill_holes(filled)
    ranges = [_shrunk(filled, np.array([[0, 0, 0], shape]))]
    cuts = [_best_cut(filled, ranges[0])]
    while len(ranges) < most:
        k = max(range(len(cuts)), key=lambda k: cuts[k][0])
        saved, halves = cuts[k]
        if saved < 0.01 * sum(np.prod(b - a) for a, b in ranges):
            break
        ranges[k : k + 1], cuts[k : k + 1] = halves, [_best_cut(filled, half) for half in halves]
    turn, origin = (np.eye(3), np.zeros(3)) if place is None else (place[:3, :3], place[:3, 3])
    ends = faces.min(axis=1), faces.max(axis=1)
    boxes = []
    for cells in ranges:
        start, end = low + cells[0] * cell, low + cells[1] * cell
        within = np.all((first < cells[1]) & (last >= cells[0]), axis=1)
        # to the body, not the grid, but where it goes on in another box
        closed = [_goes_on(filled, cells, side) for side in (0, 1)]
        start = np.where(closed[0], start, np.maximum(start, ends[0][within].min(axis=0)))
        end = np.where(closed[1], end, np.minimum(end, ends[1][within].max(axis=0)))
        middle, half = 0.5 * (start + end), np.maximum(0.5 * (end - start), 1e-3)
        boxes.append(np.r_[turn @ middle + origin, turn.ravel(), half])
    return np.array(boxes)


def _goes_on(filled: Grid, cells: Index, side: int) -> list[bool]:
    """Whether what is filled in a range goes on beyond its lower (0) or upper (1) end along each axis."""
    goes_on = []
    for axis in range(3):
        last = int(cells[side, axis]) - side
        beyond = last - 1 if side == 0 else last + 1
        others = [slice(int(a), int(b)) for a, b in np.delete(cells, axis, axis=1).T]
        layers = np.moveaxis(filled, axis, 0)[:, others[0], others[1]]
        goes_on.append(0 <= beyond < len(layers) and bool(np.any(layers[beyond] & layers[last])))
    return goes_on


def _shrunk(filled: Grid, cells: Index) -> Index:
    """The first and the last but one cell (2, 3) of what is filled within such a range."""
    (x, y, z), (u, v, w) = cells
    at = np.argwhere(filled[x:u, y:v, z:w])
    return np.stack([at.min(axis=0), at.max(axis=0) + 1]) + cells[0]


def _best_cut(filled: Grid, cells: Index) -> tuple[int, list[Index]]:
    """Cells that the best cut of a shrunk range in two leaves out, and the two."""
    block = filled[tuple(slice(a, b) for a, b in zip(*cells.tolist(), strict=True))]
    best, axis, at = -1, 0, 0
    for k in range(3):
        if block.shape[k] > 1:
            layers = np.moveaxis(block, k, 0)
            kept = _volumes(layers)[:-1] + _volumes(layers[::-1])[-2::-1]
            if (saved := block.size - int(kept.min())) > best:
                best, axis, at = saved, k, int(kept.argmin()) + 1
    halves = [cells.copy(), cells.copy()]
    halves[0][1, axis] = halves[1][0, axis] = cells[0, axis] + at
    return best, [_shrunk(filled, each) for each in halves] if best > 0 else []


def _volumes(layers: Grid) -> Index:
    """(n,) cells of the smallest range that contains what is filled in the first 1 .. n layers."""
    volumes = np.maximum.accumulate(np.where(layers.any(axis=(1, 2)), np.arange(1, len(layers) + 1), 0))
    for other in (1, 2):
        lines: Grid = np.any(layers, axis=3 - other)
        some, length = lines.any(axis=1), lines.shape[1]
        first = np.where(some, lines.argmax(axis=1), length)
        end = np.where(some, length - lines[:, ::-1].argmax(axis=1), 0)
        volumes = volumes * (np.maximum.accumulate(end) - np.minimum.accumulate(first))
    return np.maximum(volumes, 0)
