"""Postures worth adding, out of ALL postures within limits and constraints: multistart Newton ascent of d(q) = tr(G F(q)).

Every start climbs at the same time, on exact first and second derivatives of the blocks (CasADi, vectorised). Joints at a
limit that would leave the box stay there. What is found is a numerical maximum; `doe.interval` makes it a theorem where
the model allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import casadi as ca
import numpy as np

from doe.approximate import Mixture
from doe.candidates import satisfied
from doe.problem import DesignProblem
from identification.arm import Array
from identification.tape import vectorise

STEPS = 60
LONGEST = 0.7  # [rad] of a Newton step
LANDMARKS = 2187  # 3^7: limits and middle of seven joints
SAMPLES = 2000  # random postures beside the landmarks
CLIMBERS = 64
THOROUGH = 20_000  # random postures of a thorough search
TRIES = 50  # rounds of rejection sampling under constraints
SAME = 1e-7  # [rad] postures nearer than this are one


@dataclass(frozen=True)
class ContinuousSet:
    """All postures within the limits (and constraints) of a problem, as something whose best postures can be found."""

    problem: DesignProblem
    mixture: Mixture

    @cached_property
    def _derivatives(self) -> Callable[..., tuple[np.ndarray, ...]]:
        """(m, n) -> blocks as (m, dp, 1), first (m, dp, n) and second (m, dp n, n) derivatives by the joint angles."""
        q = ca.SX.sym("q", self.problem.joints)
        blocks = ca.vec(self.problem.block_function(q).T)  # row by row, as numpy has it
        first = ca.jacobian(blocks, q)
        second = ca.jacobian(ca.vec(first.T), q)
        outputs = [ca.densify(blocks), ca.densify(first), ca.densify(second)]
        return vectorise(ca.Function("derivatives", [q], ca.cse(outputs)))

    def sensitivities(self, postures: Array, gradient: Array) -> Array:
        """(m,) tr(G F(q))."""
        return self.mixture.sensitivities(self.problem.blocks(postures), gradient)

    def slopes(self, postures: Array, gradient: Array) -> tuple[Array, Array]:
        """(m, n) gradient and (m, n, n) Hessian of tr(G F(q)) by the joint angles."""
        m, n = postures.shape
        d, p = self.problem.model.dimension, self.problem.parameters
        flat, first, second = self._derivatives(postures)
        blocks = flat.reshape(m, d, p)
        first = first.reshape(m, d, p, n)
        weighted = blocks @ gradient
        slope = 2.0 * np.einsum("mda,mdai->mi", weighted, first, optimize=True)
        turned = np.einsum("ab,mdbi->mdai", gradient, first, optimize=True).reshape(m, d * p, n)
        hessian = np.swapaxes(first.reshape(m, d * p, n), 1, 2) @ turned
        hessian += np.einsum("ma,maij->mij", weighted.reshape(m, -1), second.reshape(m, d * p, n, n), optimize=True)
        return self.mixture.share * slope, 2.0 * self.mixture.share * hessian

    # -- where to start ----------------------------------------------------------------------------------------------
    @cached_property
    def starts(self) -> Array:
        """(k, n) limits and middles of the joints that matter, and random postures, those that are feasible."""
        generator = np.random.default_rng(0)
        landmarks = self._landmarks(generator)
        allowed = landmarks[satisfied(self.problem, landmarks)]
        return np.concatenate([allowed, self.random(generator, SAMPLES)])

    def random(self, generator: np.random.Generator, count: int) -> Array:
        """(count, n) feasible random postures; fewer, or none, where constraints leave very little room."""
        found: list[Array] = []
        for _ in range(TRIES):
            postures = generator.uniform(self.problem.lower, self.problem.upper, (count, self.problem.joints))
            found.append(postures[satisfied(self.problem, postures)])
            if sum(map(len, found)) >= count:
                break
        return np.concatenate(found)[:count]

    def _landmarks(self, generator: np.random.Generator) -> Array:
        problem = self.problem
        active = list(problem.active_joints)
        middle = 0.5 * (problem.lower + problem.upper)
        levels = np.stack([problem.lower, problem.upper, middle])  # (3, n)
        if 3 ** len(active) <= LANDMARKS:
            places = np.array(list(product(range(3), repeat=len(active)))).reshape(-1, len(active))
        else:
            places = generator.integers(0, 3, (LANDMARKS, len(active)))
        postures = np.tile(middle, (len(places), 1))
        postures[:, active] = levels[places, active]
        return postures

    # -- the climb ---------------------------------------------------------------------------------------------------
    def best(self, gradient: Array, near: Array, generator: np.random.Generator | None = None) -> tuple[Array, Array]:
        """Local maxima (k, n) of tr(G F(q)) and their values (k,), best first.

        Starts are `near` (j, n) and the best of the landmarks; with a generator, a search as thorough as is affordable:
        the best of many fresh random postures, and others whatever they are worth, for a high maximum may be narrow.
        """
        if generator is None:
            values = self.sensitivities(self.starts, gradient)
            top = self.starts[np.argsort(-values)[:CLIMBERS]]
        else:
            fresh = self.random(generator, THOROUGH)
            values = self.sensitivities(fresh, gradient)
            top = np.concatenate([fresh[np.argsort(-values)[: 4 * CLIMBERS]], fresh[: 4 * CLIMBERS]])
        postures = self.climb(np.concatenate([near, top]), gradient)
        values = self.sensitivities(postures, gradient)
        order = np.argsort(-values)
        order = order[distinct(postures[order])]
        return postures[order], values[order]

    def climb(self, postures: Array, gradient: Array) -> Array:
        """Every posture moved uphill to a local maximum, within the limits; a step that breaks a constraint is not taken."""
        q = self.problem.clip(postures)
        values = self.sensitivities(q, gradient)
        reach = np.full(len(q), LONGEST)
        moving = np.arange(len(q))
        for _ in range(STEPS):
            slope, hessian = self.slopes(q[moving], gradient)
            step = self._newton_step(q[moving], slope, hessian)
            length = np.abs(step).max(axis=1)
            step *= np.minimum(1.0, reach[moving] / np.maximum(length, 1e-300))[:, None]
            trial = self.problem.clip(q[moving] + step)
            trial_values = self.sensitivities(trial, gradient)
            gain = trial_values - values[moving]
            better = (gain > 0.0) & satisfied(self.problem, trial)
            accepted = moving[better]
            q[accepted], values[accepted] = trial[better], trial_values[better]
            reach[moving] = np.where(
                better, np.minimum(2.0 * reach[moving], LONGEST), 0.25 * np.minimum(reach[moving], length)
            )
            arrived = better & (gain <= 1e-14 * np.abs(trial_values))
            moving = moving[(reach[moving] > 1e-9) & (length > 1e-10) & ~arrived]
            if not len(moving):
                break
        return q

    def _newton_step(self, q: Array, slope: Array, hessian: Array) -> Array:
        """(m, n) ascent directions: |eigenvalues| of the Hessian, joints held at a limit left out."""
        span = self.problem.upper - self.problem.lower
        held = ((q >= self.problem.upper - 1e-12 * span) & (slope > 0)) | (
            (q <= self.problem.lower + 1e-12 * span) & (slope < 0)
        )
        free = (~held).astype(float)
        n = q.shape[1]
        masked = hessian * free[:, :, None] * free[:, None, :] + np.eye(n) * held[:, :, None]
        values, vectors = np.linalg.eigh(masked)
        floor = 1e-6 * np.abs(values).max(axis=1, keepdims=True) + 1e-12
        along = np.einsum("mij,mi->mj", vectors, slope * free) / np.maximum(np.abs(values), floor)
        return np.einsum("mij,mj->mi", vectors, along) * free


def distinct(postures: Array, tolerance: float = SAME) -> Array:
    """Indices of postures of which no earlier one is within `tolerance` [rad] in every joint."""
    kept: list[int] = []
    for k, posture in enumerate(postures):
        if not kept or np.abs(postures[kept] - posture).max(axis=1).min() > tolerance:
            kept.append(k)
    return np.array(kept, dtype=int)
