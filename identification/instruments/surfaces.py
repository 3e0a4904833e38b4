"""Where center or plane of an instrument of lengths is, and the measured point on the arm: the start of a fit.

    |p_i + R_i t - c| = d_i,    n . (p_i + R_i t) - h = z_i

For a given measured point t the sphere about c is linear in c and |c|^2 (algebraic fit), and the plane in n and h
(total least squares); Gauss-Newton steps then move both. The starts of t lie around the tip.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from identification.arrays import Array
from identification.information import PRODUCT_TOLERANCE, RANK_TOLERANCE
from identification.instruments.search import ENOUGH, Placement, Unplaced, starts_of_tool
from identification.kinematics.frames import pose

FIRST = 3  # steps, after which the best start of 99 of 100 wrong readings leaves at most 1.5 times what its end leaves
RADII = np.array([0.003, 0.01, 0.03, 0.1, 0.3])  # of the reach: balls of a few millimetres to those of a metre


def placed_by_lengths(surface: type[CenterStarts], rows: Unplaced) -> Placement:
    """Base and tool that explain lengths (m, 1) best; what they leave open of the base is along the arm's own axes.

    surface : what the lengths are from
    """
    frames, readings, reach, base, tool, hopeless = rows
    lengths = readings[:, 0]
    tools = starts_of_tool(reach) if tool is None else tool[None]
    state = surface.started(frames, lengths, reach, tools, base, tool is None, hopeless)
    best = _settled(state, base is None, tool is None, hopeless)
    rms = float(np.sqrt(state.squares()[best] / len(lengths)))
    return Placement(state.base(best) if base is None else base, state.tools[best], rms)


def _settled(state: CenterStarts, base: bool, tool: bool, hopeless: float, rounds: int = 50) -> int:
    """Number of the start that ends with the least squares after Gauss-Newton steps of base and tool, or of one."""
    least, kept = np.full(len(state.tools), np.inf), (state.surface, state.tools)
    for done in range(rounds):
        linear = state.linear()
        squares = np.sum(linear.residual**2, axis=1)
        better = squares < least * (1.0 - ENOUGH)
        kept = np.where(better[:, None], state.surface, kept[0]), np.where(better[:, None], state.tools, kept[1])
        least = np.minimum(squares, least)
        if not better.any() or (done >= FIRST and np.min(least) > len(state.places) * hopeless**2):
            break
        state.step(linear, base, tool)
    state.surface, state.tools = kept
    return int(np.argmin(state.squares()))


class _Linear(NamedTuple):
    """(s, m) residuals, and (s, m, k) derivatives of the lengths by centers or planes, and by the tools."""

    residual: Array
    of_surface: Array
    of_tool: Array


class CenterStarts:
    """Centers of spheres (s, 3) for tools (s, 3) in the frame of the base; lengths (m,), or (s, 1) of each start."""

    def __init__(self, frames: Array, lengths: Array, reach: float, tools: Array, base: Array | None) -> None:
        self.places, self.turns, self.lengths = frames[:, :3, 3], frames[:, :3, :3], lengths
        self.reach, self.tools = reach, tools
        self.surface = self._found() if base is None else np.tile(self._known(base), (len(tools), 1))

    @classmethod
    def started(
        cls, frames: Array, lengths: Array, reach: float, tools: Array, base: Array | None, tool: bool, hopeless: float
    ) -> Self:
        """Where Gauss-Newton steps start;  tool : whether it is to be found;  `hopeless` as of `placed_by_lengths`."""
        return cls(frames, lengths, reach, tools, base)

    def points(self) -> Array:
        """(s, m, 3) measured points in the base."""
        return self.places + np.tensordot(self.tools, self.turns, (1, 2))

    def squares(self) -> Array:
        """(s,) sums of squared residuals [mm^2]."""
        return np.asarray(np.sum(self.linear().residual ** 2, axis=1))

    def step(self, linear: _Linear, base: bool, tool: bool) -> None:
        """A Gauss-Newton step of base and tool, or of one of them."""
        residual, of_surface, of_tool = linear
        columns = np.concatenate([of_surface] * base + [of_tool] * tool, axis=2)
        across = np.swapaxes(columns, 1, 2)
        inverse = np.linalg.pinv(across @ columns, rcond=PRODUCT_TOLERANCE, hermitian=True)
        change = (inverse @ across @ residual[..., None])[..., 0]
        if tool:
            self.tools = self.tools + change[:, -3:]
        if base:
            self._move(change[:, : of_surface.shape[2]])

    def base(self, k: int) -> Array:
        """(4, 4) pose of the base in the frame of the instrument, of start k."""
        return pose(-self.surface[k])

    def _known(self, base: Array) -> Array:
        return np.asarray(-base[:3, :3].T @ base[:3, 3])

    def _found(self) -> Array:
        """(s, 3) algebraic fits: |a|^2 - d^2 = 2 a . c - (|c|^2), about the mean of the points."""
        points = self.points()
        middle = points.mean(axis=1, keepdims=True)
        around = (points - middle) / self.reach
        columns = np.concatenate([2.0 * around, np.ones((*around.shape[:2], 1))], axis=2)
        target = np.sum(around**2, axis=2) - (self.lengths / self.reach) ** 2
        solved = [np.linalg.lstsq(a, b, rcond=RANK_TOLERANCE)[0] for a, b in zip(columns, target, strict=True)]
        return np.asarray(middle[:, 0] + self.reach * np.array(solved)[:, :3])

    def linear(self) -> _Linear:
        """About where each start is."""
        across = self.points() - self.surface[:, None]
        far = np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-9)
        toward = across / far
        of_tool = np.swapaxes(np.swapaxes(toward, 0, 1) @ self.turns, 0, 1)
        return _Linear(self.lengths - far[..., 0], -toward, of_tool)

    def _move(self, change: Array) -> None:
        self.surface = self.surface + change


class FreeSphereStarts(CenterStarts):
    """Centers of spheres of a radius that is the mean distance at each step (variable projection: G. H. Golub, V.
    Pereyra, 1973; the radius is linear).

    From far away it would grow without end, with a tool as long: the starts are fits of some known radii.
    """

    @classmethod
    def started(
        cls, frames: Array, lengths: Array, reach: float, tools: Array, base: Array | None, tool: bool, hopeless: float
    ) -> Self:
        """The best of each of `RADII`; lengths that are all the same say nothing."""
        radii = np.repeat(RADII * reach, len(tools))[:, None]
        held = CenterStarts(
            frames, np.zeros(len(frames)), reach, tools, base
        )  # the algebraic fits are those of any radius
        held.lengths = radii
        held.surface, held.tools = (np.tile(each, (len(RADII), 1)) for each in (held.surface, held.tools))
        _settled(held, base is None, tool, hopeless, rounds=10)  # effort: the radius is not right
        of_radius = np.arange(len(radii)).reshape(len(RADII), -1)
        best = of_radius[np.arange(len(RADII)), np.argmin(held.squares()[of_radius], axis=1)]
        sphere = cls(frames, np.zeros(len(frames)), reach, held.tools[best], base)
        sphere.surface = held.surface[best]
        return sphere

    def linear(self) -> _Linear:
        return _Linear._make(each - each.mean(axis=1, keepdims=True) for each in super().linear())


class PlaneStarts(CenterStarts):
    """Normals and heights of planes (s, 4), n . a = h."""

    def base(self, k: int) -> Array:
        """(4, 4) its z axis the normal, its origin in the middle of the points, its x axis near one of the arm's."""
        normal, height = self.surface[k, :3], self.surface[k, 3]
        if height > 0.0:
            normal, height = -normal, -height  # the arm stands above
        along = np.eye(3)[int(np.argmin(np.abs(normal)))]
        along = along - normal * (normal @ along)
        along /= np.linalg.norm(along)
        axes = np.array([along, np.cross(normal, along), normal])
        middle = axes @ self.points()[k].mean(axis=0)
        return pose([-middle[0], -middle[1], -height], axes)

    def _known(self, base: Array) -> Array:
        return np.r_[base[2, :3], -base[2, 3]]

    def _found(self) -> Array:
        points = self.points()
        middle = points.mean(axis=1)
        about = points - middle[:, None]
        normal = np.linalg.eigh(np.swapaxes(about, 1, 2) @ about)[1][:, :, 0]  # of the least scatter; of few points any
        return np.column_stack([normal, np.sum(normal * middle, axis=1)])

    def linear(self) -> _Linear:
        """As above; derivatives by a rotation of the normal, times the reach, and by the height."""
        points, normal = self.points(), self.surface[:, :3]
        residual = self.lengths - (points @ normal[:, :, None])[..., 0] + self.surface[:, 3:]
        turned = points @ np.cross(normal[:, None], np.eye(3)) / self.reach
        of_surface = np.concatenate([turned, -np.ones((*residual.shape, 1))], axis=2)
        return _Linear(residual, of_surface, np.swapaxes(normal @ self.turns, 0, 1))

    def _move(self, change: Array) -> None:
        normal = self.surface[:, :3] + np.cross(change[:, :3] / self.reach, self.surface[:, :3])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        self.surface = np.column_stack([normal, self.surface[:, 3] + change[:, 3]])
