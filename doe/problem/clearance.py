"""Clearance: how far the bodies of an arm stay from each other, from its cell and from a tracker's line of sight.

A body is a union of capsules and boxes (`identification.workspace`). The signed distance of two capsules with axes A
and B and radii r and s is |a - b| - r - s, where a and b, the witness points, are the nearest points of the axes. The
distance of two bodies is the smallest one of their pieces. To first order, moving the witness points along the axes
does not change the distance, so its derivative with respect to joint j is

    n . (da/dq_j - db/dq_j),     n = (a - b) / |a - b|,
    n . da/dq_j = z_j . (a x n) + (o_j x z_j) . n  for a joint that turns about z_j through o_j,  z_j . n if it slides,

with the points fixed to their bodies, and zero for a joint that does not move the body: the line of the joint and the
force along n in Pluecker coordinates (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 2). Second
derivatives are finite differences of these.

The pieces contain the real surfaces, so clear pieces mean clear bodies; the converse need not hold. Pairs connected by
a joint are not checked (`Cell.apart`), nor are pairs whose pieces touch at nearly all random postures. A pair that is
always close, such as both neighbours of a short link, must keep at most a quarter of its largest distance.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from doe.problem.model import turns
from identification import Array

ROUNDING = 1e-3  # [mm] by which a plan that was written and read again may miss what it keeps
TINY = 1e-12  # [mm], [mm^2] below which a length, or its square, has no direction
CROSSING = 1e-6  # [mm] between axes that cross: no direction leads away
DEEP = 1e5  # [mm] half sizes of the box that the floor is the top of


class Clearance:
    """The condition on a posture that bodies keep their distance: a constraint, as `doe.problem.constraints` has them.

    pairs : (k) names of both bodies;  asked : (k,) [mm] how far they are to keep apart, `usual` or less
    touching : pairs that are not checked, since their pieces overlap at nearly all postures
    unseen, bare : links whose meshes were not found, and joints whose links have no bodies
    """

    kind = "clearance"

    def __init__(self, model: Any, trackers: Sequence[Array] = ()) -> None:
        """Of a model that offers `cell`, `joint_frames` and `joint_axes`.

        trackers : (3,) [mm] in the frame of the base, from which the measured point must be seen
        """
        self.model, cell, tip = model, model.cell, len(model.joint_types) + 1
        self.usual = max(cell.clearance, 1.0)  # [mm] of a posture in touch no move is proven to be free
        # what stands still comes first; lines of sight are capsules from the base to the measured points
        bodies = sorted(([b.name, b.joint, b.capsules, b.boxes] for b in cell.bodies), key=lambda body: body[1])
        if cell.floor is not None:
            ground = np.r_[0.0, 0.0, cell.floor - DEEP, np.eye(3).ravel(), np.full(3, DEEP)]
            bodies.insert(0, [cell.FLOOR, 0, np.empty((0, 7)), ground[None]])
        points = [np.zeros(3), *getattr(model, "other_points", ())]
        sights = [np.array([np.r_[place, point, 0.0] for point in points]) for place in trackers]
        bodies += [[cell.SIGHT, tip, each, np.empty((0, 15))] for each in sights]
        names, joints, *parts = zip(*bodies, strict=True)
        # pieces are capsules, then boxes
        owner = np.concatenate([np.repeat(range(len(names)), [*map(len, each)]) for each in parts])
        capsules, self._boxes = map(np.concatenate, parts)
        self._capsules, centers = len(capsules), self._boxes[:, :3]
        self._ends = np.stack([np.concatenate([capsules[:, k : k + 3], centers]) for k in (0, 3)])
        self._radii, joint = np.r_[capsules[:, 6], np.zeros(len(centers))], np.array(joints)[owner]
        self._frames = np.stack([np.where(joint == tip, 0, joint), joint])  # of both ends
        pairs, pieces, always = list[tuple[str, str]](), list[tuple[int, int, int]](), list[bool]()
        unasked = cell.apart | {frozenset((cell.FLOOR, cell.SIGHT))}
        for one, other in zip(*np.tril_indices(len(names), -1), strict=True):
            first, second = (np.flatnonzero(owner == body).tolist() for body in (one, other))
            pair = names[one], names[other]
            if joints[one] != joints[other] and first and second and frozenset(pair) not in unasked:
                pieces += [(len(pairs), a, b) for a in first for b in second]
                pairs.append(pair)
                always.append(names[one] == cell.SIGHT and not joints[other])
        self._pieces, self.pairs = np.array(pieces, dtype=int).reshape(-1, 3), tuple(pairs)
        self._last: tuple[Any, ...] = (np.empty(0),)
        # of all pairs those that are looked at, by random postures: not those that always touch
        drawn = np.random.default_rng(0).uniform(model.lower, model.upper, (1000, len(model.lower)))
        largest = np.quantile(self.distance(drawn), 0.98, axis=0)  # seldom postures aside
        # and what hides the arm wherever it stands, but for what a tracker is in: of its lines of sight the first end
        at_rest = np.moveaxis(self._ends, 2, 1)[:, :, None]
        at_rest = np.where(self._frames[0] == self._frames[1], at_rest, at_rest[0])
        every = np.arange(len(self._pieces))
        within = self._pieces[self._witness(at_rest, 0 * every, every)[0] <= 0.0, 0]
        kept = (largest > 0.0) | (np.array(always, dtype=bool) & ~np.isin(np.arange(len(pairs)), within))
        self.touching, self.pairs = (tuple(pairs[k] for k in np.flatnonzero(each)) for each in (~kept, kept))
        lengths = np.linalg.norm(np.diff(model.joint_frames(drawn[:1])[0, 1:, :3, 3], axis=0), axis=1)
        self.beyond = float(lengths[-1] + np.linalg.norm(points, axis=1).max())  # [mm] from the last joint
        bare = [f"joint {j}" for j in (np.flatnonzero(lengths > ROUNDING) + 1).tolist() if j not in joints]
        self.unseen, self.bare = getattr(cell.bodies, "unseen", ()), bare
        self.asked = np.minimum(self.usual, np.where(largest > 0.0, 0.25 * largest, np.inf))[kept]
        self._pieces = self._pieces[kept[self._pieces[:, 0]]]
        self._pieces[:, 0] = np.unique(self._pieces[:, 0], return_inverse=True)[1]
        self.count, self._last = len(self.pairs), (np.empty(0),)
        self.of_sight = np.array([cell.SIGHT in pair for pair in self.pairs], dtype=bool)  # (k,)

    def levers(self) -> Array:
        """(k, n) how much at most the distance of each pair changes by a unit of each joint [mm/rad, 1].

        For a joint between two bodies it is the length of the stretched arm from there to the farthest point of the
        outer one; a joint that moves both or neither changes nothing. Lines of sight, which no move keeps, have none.
        """
        origins = self.model.joint_frames(np.stack([self.model.lower, self.model.upper]))[:, 1:, :3, 3]
        steps = np.linalg.norm(np.diff(origins, axis=1), axis=2).max(axis=0)  # constant but for sliding joints
        along, joints = np.r_[0.0, 0.0, np.cumsum(steps)], np.arange(1, len(steps) + 1)  # from joint 1 to each frame
        far = np.max(along[self._frames] + np.linalg.norm(self._ends, axis=2) + self._radii, axis=0)
        lengths = np.where(turns(self.model), np.maximum(far[:, None] - along[1:-1], 0.0), 1.0)
        (_, first), (_, second) = self._frames[:, self._pieces[:, 1:].T].swapaxes(0, 1)
        between = (joints > second[:, None]) & (joints <= first[:, None])
        starts = np.flatnonzero(np.diff(self._pieces[:, 0], prepend=-1))
        return np.asarray(np.maximum.reduceat(between * lengths[self._pieces[:, 1]], starts, axis=0))

    # -- distances -----------------------------------------------------------------------------------------------------
    def margin(self, postures: Array) -> Array:
        """(m, k) [mm] by how much pairs are farther apart than is asked, at postures (m, n)."""
        return self.distance(postures) - self.asked

    def distance(self, postures: Array) -> Array:
        """(m, k) [mm] signed distances of the pairs at postures (m, n)."""
        rows = np.atleast_2d(np.asarray(postures, dtype=float))
        size = 1 + 2**17 // (1 + len(self._pieces))  # at once: 1 MB an array
        parts = [self._seen(rows[k : k + size])[0] for k in range(0, len(rows), size)]
        return np.concatenate([np.empty((0, len(self.pairs))), *parts])

    def too_near(self, postures: Array) -> list[dict[str, Any]]:
        """Key `collisions`: run from 1, bodies, and distance wherever a pair is nearer than is asked."""
        apart = self.distance(postures)
        near = np.argwhere(apart < self.asked - ROUNDING).tolist()
        return [{"run": run + 1, "bodies": [*self.pairs[k]], "distance_mm": float(apart[run, k])} for run, k in near]

    def _seen(self, postures: Array) -> tuple[Array, NDArray[np.intp]]:
        """(m, k) distances of the pairs at postures (m, n), and numbers of the pairs of pieces that have them; kept for
        the next question about the same ones, as of second derivatives.

        The middle of an axis tells how far it is at most, and less half its length at least, which of most pairs of
        pieces tells that another is nearer.
        """
        if np.array_equal(self._last[0], postures):
            return self._last[1], self._last[2]
        m, placed, (pair, first, second) = len(postures), self._placed(postures)[1], self._pieces.T
        nearest, starts = np.empty((m, len(self.pairs)), dtype=np.intp), np.flatnonzero(np.diff(pair, prepend=-1))
        middle, half = 0.5 * (placed[0] + placed[1]), 0.5 * length(placed[1] - placed[0])
        walls, most = second >= self._capsules, length(middle[..., first] - middle[..., second])
        box = second[walls] - self._capsules
        most[:, walls] = from_box(self._in_box(middle[..., first[walls]], box), self._boxes[box, 12:].T[:, None])
        most -= self._radii[first] + self._radii[second]
        bound, exact = np.minimum.reduceat(most, starts, axis=1) + ROUNDING, np.full_like(most, np.inf)
        run, piece = np.nonzero(most - half[:, first] - half[:, second] <= bound[:, pair])
        exact[run, piece] = self._witness(placed, run, piece)[0]
        distance = np.minimum.reduceat(exact, starts, axis=1)
        run, piece = np.nonzero(exact == distance[:, pair])
        nearest[run, pair[piece]] = piece
        self._last = postures.copy(), distance, nearest
        return distance, nearest

    def _placed(self, postures: Array) -> tuple[Array, Array]:
        """Frames (m, n + 2, 4, 4) of base, joints and measured point at postures, and ends (2, 3, m, K) of the axes of
        all capsules in that of the base."""
        frames = self.model.joint_frames(postures)
        moved, ones = frames[:, self._frames, :3], np.ones((*self._frames.shape, 1))
        return frames, np.einsum("mekij,ekj->eimk", moved, np.dstack([self._ends, ones]))

    def _in_box(self, points: Array, box: NDArray[np.intp]) -> Array:
        """(3, ..., W) points (3, ..., W) along the axes of boxes (W,), from their centers."""
        centers, turned, ones = self._boxes[box, :3].T, self._boxes[box, 3:12].T, np.ones(points.ndim - 2, dtype=int)
        shifted = points - centers.reshape(3, *ones, -1)
        return dot(turned.reshape(3, 3, *ones, -1), shifted)  # einsum takes 8 times as long

    def _witness(self, placed: Array, run: NDArray[np.intp], piece: NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """(N,) distances of N pairs of pieces, each at one of the postures, (N,) shares of the way along the axis of
        the first to its nearest point, and (3, N) the directions in which it gets away."""
        first, second = self._pieces[piece, 1:].T
        a, b = placed[:, :, run, first]
        share, _, between = shortest(a, b, *placed[:, :, run, second])
        distance = length(between)
        away = between / np.maximum(distance, CROSSING)
        if len(walls := np.flatnonzero(second >= self._capsules)):
            box = second[walls] - self._capsules
            start, end, half = self._in_box(a[:, walls], box), self._in_box(b[:, walls], box), self._boxes[box, 12:].T
            share[walls], along_sides = nearest_to_box(start, end, half)
            distance[walls] = from_box(start + share[walls] * (end - start), half)
            away[:, walls] = dot(self._boxes[box, 3:12].reshape(-1, 3, 3).T, along_sides)
        return distance - self._radii[first] - self._radii[second], share, away

    # -- derivatives, as `doe.problem.constraints.Derivatives` has those of expressions --------------------------------
    def first(self, postures: Array) -> tuple[Array, Array]:
        """(m, k) margins and their derivatives (m, n, k) by the joints."""
        distance, nearest = self._seen(postures)
        return distance - self.asked, self._slopes(postures, nearest)

    def bend(self, postures: Array, weights: Array) -> Array:
        """(m, n, n) Hessians of the sums with weights (m, k): differences of the gradients of the same pieces."""
        steps, nearest = 1e-4 * np.eye(postures.shape[1]), self._seen(postures)[1]
        slopes = np.stack([self._slopes(postures + step, nearest) for step in (*steps, *-steps)], axis=1)
        ahead, behind = np.split(slopes, 2, axis=1)
        bend = ((ahead - behind) @ weights[:, None, :, None])[..., 0] / 2e-4
        return np.asarray(0.5 * (bend + np.swapaxes(bend, 1, 2)))

    def _slopes(self, postures: Array, pieces: NDArray[np.intp]) -> Array:
        """(m, n, k) how the distances of pairs of pieces (m, k) change with the joints [mm/rad, 1]."""
        run, piece = np.repeat(np.arange(len(pieces)), pieces.shape[1]), pieces.ravel()
        frames, placed = self._placed(postures)
        _, share, away = self._witness(placed, run, piece)
        # (m, n, 3) twice: z_j and o_j x z_j of joints that turn, 0 and z_j of those that slide
        axes, turning = np.squeeze(frames[:, 1:-1, :3, :3] @ self.model.joint_axes[:, :, None], -1), turns(self.model)
        moment = np.where(turning[:, None], axes, 0.0)
        force = np.where(turning[:, None], np.cross(frames[:, 1:-1, :3, 3], axes), axes)
        slopes, joints = np.zeros((len(run), len(turning))), np.arange(1, len(turning) + 1)
        first, second = self._pieces[piece, 1:].T
        # a witness point moves as both ends of its axis do, each by its share; joints that move both bodies do nothing
        for end, weight in enumerate((1.0 - share, share)):
            lever = np.cross(placed[end][:, run, first], away, axis=0).T[:, :, None]
            rates = (moment[run] @ lever + force[run] @ away.T[:, :, None])[..., 0]
            moved = np.subtract(*(joints <= self._frames[end, side, None] for side in (first, second)), dtype=float)
            slopes += weight[:, None] * moved * rates
        return np.swapaxes(slopes.reshape(*pieces.shape, len(turning)), 1, 2)


# -- geometry: vectors run along the first axis of arrays --------------------------------------------------------------
def dot(a: Array, b: Array) -> Array:
    """(...) a . b of (3, ...) vectors."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def length(a: Array) -> Array:
    """(...) |a| of (3, ...) vectors."""
    return np.sqrt(dot(a, a))


def shortest(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array]:
    """Of segments a-b and c-d (3, ...) the shares (...) of the way to their nearest points, and (3, ...) from the
    second of these to the first (C. Ericson, "Real-Time Collision Detection", 2005, section 5.1.9)."""
    u, v, w = b - a, d - c, a - c
    uu, vv, uv, uw, vw = dot(u, u), dot(v, v), dot(u, v), dot(u, w), dot(v, w)
    first = np.clip((uv * vw - uw * vv) / np.maximum(uu * vv - uv * uv, TINY), 0.0, 1.0)
    second = np.clip((uv * first + vw) / np.maximum(vv, TINY), 0.0, 1.0)
    first = np.clip((uv * second - uw) / np.maximum(uu, TINY), 0.0, 1.0)
    return first, second, w + first * u - second * v


def from_box(points: Array, half: Array) -> Array:
    """(...) signed distance of points (3, ...) from boxes around the origin of half sizes (3, ...); it is convex."""
    beyond = np.abs(points) - half
    away = np.maximum(beyond, 0.0)
    deepest = np.maximum(np.maximum(beyond[0], beyond[1]), beyond[2])  # thrice as fast as a reduction
    return np.asarray(length(away) + np.minimum(deepest, 0.0))


def nearest_to_box(a: Array, b: Array, half: Array) -> tuple[Array, Array]:
    """Of segments a-b (3, N) the shares (N,) of the way to the point nearest to a box, or deepest in it, and (3, N) the
    directions in which the segments get away from there.

    The distance is convex along the way: its slope is halved in. Inside a box the deepest point is equally deep under
    two faces: the direction is that mixture of both from which the segment does not slide away.
    """

    def out(share: Array) -> Array:  # of the nearest face, edge or corner, of any length
        point = a + share * along
        beyond = np.abs(point) - half
        deepest = np.maximum(np.maximum(beyond[0], beyond[1]), beyond[2])
        return np.copysign(np.where(deepest > 0.0, np.maximum(beyond, 0.0), beyond == deepest), point)

    along, start, end = b - a, np.zeros(a.shape[1]), np.ones(a.shape[1])
    low, high = np.where(dot(out(end), along) < 0.0, end, start), np.where(dot(out(start), along) >= 0.0, start, end)
    while np.any(high - low > 1e-6):  # of the way; of most the nearest point is an end
        middle = 0.5 * (low + high)
        low, high = np.where(dot(out(middle), along) >= 0.0, [low, middle], [middle, high])
    back, ahead = (each / np.maximum(length(each), TINY) for each in (out(low), out(high)))
    falling, rising = dot(back, along), dot(ahead, along)
    weight = np.clip(rising / np.maximum(rising - falling, TINY), 0.0, 1.0)
    return high, weight * back + (1.0 - weight) * ahead
