"""Postures of the largest sensitivity within limits and constraints: multistart Newton ascent of d(q) = tr(G F(q)).

All starts climb together (`identification.newton_ascent`), on exact first and second derivatives
(`doe.problem.problem`). Constraints are kept by a logarithmic barrier, lowered step by step, so that a climb can
follow a wall. What it ends at is a numerical maximum; `doe.bounds.branch_and_bound` makes it a theorem where the model
allows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from doe.problem.postures import random_postures
from doe.problem.problem import Derivatives, DesignProblem, PriorInformation, Stop, never
from identification import Array
from identification.newton_ascent import newton_ascent

CLIMBERS = 64
# heights of the barrier, relative to the largest sensitivity: a low one first keeps a start near its own walls, where
# the narrow maxima are, a high one lets it leave a dead end; every second start climbs with the other
BARRIERS = np.array([(1e-3, 1e-6, 1e-9), (1e-5, 1e-7, 1e-9)])
SAME = 1e-7  # [rad] postures nearer than this are one


@dataclass(frozen=True)
class ContinuousSet:
    """All postures within the limits (and constraints) of a problem, as something whose best postures can be found.

    also : (k, n) starts beside the landmarks and random ones
    """

    problem: DesignProblem
    prior: PriorInformation
    also: Array | None = None

    @cached_property
    def _derivatives(self) -> Derivatives:
        return self.problem.jacobian_derivatives(range(self.problem.joints))

    @cached_property
    def _walls(self) -> Derivatives:
        return self.problem.wall_derivatives(range(self.problem.joints))

    def sensitivities(self, postures: Array, gradient: Array) -> Array:
        """(m,) tr(G F(q))."""
        return self.prior.sensitivities(self.problem.scaled_jacobians(postures), gradient)

    def slopes(self, postures: Array, gradient: Array) -> tuple[Array, Array]:
        """(m, n) gradient and (m, n, n) Hessian of tr(G F(q)) with respect to the joint angles."""
        jacobians, first = self._derivatives.first(postures)
        weighted, flat = jacobians @ gradient, first.reshape(*first.shape[:2], -1)
        slope = 2.0 * np.einsum("mx,max->ma", weighted.reshape(len(first), -1), flat)
        hessian = (first @ gradient).reshape(flat.shape) @ np.swapaxes(flat, 1, 2)
        hessian += self._derivatives.bend(postures, weighted)
        return slope / (1.0 + self.prior.runs), 2.0 * hessian / (1.0 + self.prior.runs)

    @cached_property
    def starts(self) -> Array:
        """(k, n) limits and middles of the joints that matter, and random postures, those that are feasible."""
        problem, generator = self.problem, np.random.default_rng(0)
        active, middle = list(problem.active_joints), 0.5 * (problem.lower + problem.upper)
        most = 3**7  # limits and middle of seven joints
        if 3 ** len(active) <= most:
            places = np.array(list(product(range(3), repeat=len(active))), dtype=int)
        else:
            places = generator.integers(0, 3, (most, len(active)))
        landmarks = np.tile(middle, (len(places), 1))
        landmarks[:, active] = np.stack([problem.lower, problem.upper, middle])[places, active]
        also = [] if self.also is None else [np.atleast_2d(self.also)]
        anywhere = random_postures(problem, 2000, generator)  # beside the landmarks
        return np.concatenate([landmarks[problem.feasible(landmarks)], *also, anywhere])

    def best(
        self, gradient: Array, near: Array, generator: np.random.Generator | None = None, stop: Stop = never
    ) -> tuple[Array, Array]:
        """Local maxima (k, n) of tr(G F(q)) and their values (k,), best first.

        Starts are `near` (j, n) and the best of the landmarks; with a generator, a search as thorough as is affordable:
        the best of many fresh random postures, and others whatever their value, for a high maximum may be narrow.
        `stop` ends the climb on its way.
        """
        pool = self.starts if generator is None else random_postures(self.problem, 20_000, generator)
        order = np.argsort(-self.sensitivities(pool, gradient))
        promising = (
            [pool[order[:CLIMBERS]]] if generator is None else [pool[order[: 4 * CLIMBERS]], pool[: 4 * CLIMBERS]]
        )
        postures = self.climb(np.concatenate([near, *promising]), gradient, stop)
        values = self.sensitivities(postures, gradient)
        order = np.argsort(-values)
        order = order[distinct(self.problem.comparable(postures[order]))]
        return postures[order], values[order]

    def climb(self, postures: Array, gradient: Array, stop: Stop = never) -> Array:
        """Every posture moved uphill to a local maximum, within limits and constraints."""
        q = self.problem.clip(postures)
        if not self.problem.constraints:
            return self._ascend(q, gradient, np.zeros(len(q)), stop)
        scale = float(np.abs(self.sensitivities(q, gradient)).max(initial=0.0))
        kind = np.arange(len(q)) % len(BARRIERS)
        for barriers in scale * BARRIERS.T:
            q = self._ascend(q, gradient, barriers[kind], stop)
            # most starts share a maximum; of those within 1e-6 rad that came by the same barriers one climbs on
            apart = distinct(np.column_stack([self.problem.comparable(q), kind]), 1e-6)
            q, kind = q[apart], kind[apart]
        return q

    def _ascend(self, q: Array, gradient: Array, barrier: Array, stop: Stop) -> Array:
        """The climb of tr(G F(q)) + barrier * sum of log margins: (m,) barriers, all 0 without constraints."""

        def height(postures: Array, rows: NDArray[np.intp]) -> Array:
            values = self.sensitivities(postures, gradient)
            if not barrier.any():
                return values
            margins = self._walls.values(postures)
            inside = np.all(margins > 0.0, axis=1) & self.problem.feasible(postures)
            logarithms = np.log(np.where(inside[:, None], margins, 1.0)).sum(axis=1)
            return np.where(inside, values + barrier[rows] * logarithms, -np.inf)

        def slopes(postures: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
            slope, hessian = self.slopes(postures, gradient)
            if not barrier.any():
                return slope, hessian
            margins, first = self._walls.first(postures)
            relative = first / margins[:, None]
            bend = self._walls.bend(postures, 1.0 / margins) - relative @ np.swapaxes(relative, 1, 2)
            each = barrier[rows, None]
            return slope + each * relative.sum(axis=2), hessian + each[..., None] * bend

        limits = self.problem.lower, self.problem.upper
        return newton_ascent(q, height, slopes, limits, self.problem.joint_units, 1e-3 * barrier, stop)


def distinct(postures: Array, tolerance: float = SAME) -> NDArray[np.intp]:
    """Indices of postures of which no earlier one is within `tolerance` [rad] in every joint."""
    first = np.ones(len(postures), dtype=bool)
    for k, posture in enumerate(postures):
        if first[k]:
            first[k + 1 :] &= np.abs(postures[k + 1 :] - posture).max(axis=1) > tolerance
    return np.flatnonzero(first)
