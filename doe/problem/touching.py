"""Postures at which a probe touches its surface: what plans for contacts are chosen from.

A contact ties the posture: the measured point is on a sphere or a plane. Such postures form a surface in the space of
joints, on which no solver for free postures can move; so random postures are led onto it by Newton's method (the
shortest step that closes the gap, over and over), and plans are chosen from those, as from any list. Links and stylus
stay outside.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from doe.problem.constraints import nearest_on_segment
from identification.arrays import Array
from identification.conditions import Conditions
from identification.errors import InputError
from identification.model import Model

if TYPE_CHECKING:
    from doe.problem.problem import DesignProblem

CHOICES = 2000  # postures to choose from, as for robust designs
BATCH, BATCHES = 4000, 10  # effort: random postures that are led to the surface at once, and how often
STEPS = 30  # effort: Newton's method doubles the digits once it is near
LONGEST = 0.5  # [rad] of a step; of a prismatic joint that share of its range / (2 pi)
TOUCHES = 1e-6  # [mm] how near is on the surface
FEWEST = 100  # with fewer a plan has no choice


def touches(model: object) -> bool:
    """Whether a model is that of an arm whose probe touches a surface."""
    chain = model.arm.chain if isinstance(model, Model) else None
    return chain is not None and chain.instrument.contact


def touching_postures(model: Model, problem: DesignProblem) -> Array:
    """(N, n) random postures at which the measured point is on the surface and all else of the arm outside, within the
    problem's joint limits [rad, mm] and constraints.

    Raises `InputError` where there are hardly any, and for a sphere whose radius nobody knows. Warns (`UserWarning`) of
    what plans and bounds are of.
    """
    chain = model.arm.chain
    if unknown := [p for p in chain.instrument.parameters if model.best_known.get(p.name, 0.0) <= 0.0]:
        reason = f"{unknown[0].toml_key} is not known: where the {chain.instrument.kind} is touched depends on it"
        raise InputError(f"instrument: {reason}, allowed for plans: with {unknown[0].toml_key}, or a calibrated arm")
    generator, kept = np.random.default_rng(0), np.zeros((0, len(chain)))
    for _ in range(BATCHES):
        anywhere = generator.uniform(problem.lower, problem.upper, (BATCH, len(chain)))
        q = on_surface(model, anywhere, problem.joint_units)
        within = np.all((q >= problem.lower) & (q <= problem.upper), axis=1)
        q = q[within & (np.abs(heights(model, q)) < TOUCHES)]
        q = q[clear_of_surface(model, q)]
        kept = np.concatenate([kept, q[problem.feasible(q)]])[:CHOICES]
        if len(kept) == CHOICES:
            break
    if len(kept) < FEWEST:
        reason = f"touched within limits and constraints at {len(kept)} of {BATCH * BATCHES} random postures led to it"
        raise InputError(f"instrument: the {chain.instrument.kind} is {reason}, allowed: one within reach")
    what = f"{len(kept)} random postures that touch the {chain.instrument.kind} as the arm is best known"
    warnings.warn(f"instrument: plans are chosen from {what}, and bounds are over these", stacklevel=2)
    return kept


def heights(model: Model, postures: Array) -> Array:
    """(m,) how far the measured point is above the surface [mm] at postures (m, n)."""
    return np.asarray(model.position(postures)[:, 0] - model.arm.chain.instrument.touched)


def on_surface(model: Model, postures: Array, units: Array) -> Array:
    """Postures (m, n) led to the surface by the shortest steps, most of them; limits apart."""
    q, touched = np.array(postures), model.arm.chain.instrument.touched
    conditions = Conditions()
    for _ in range(STEPS):
        distance, slopes = model.expressions.posture_jacobian(
            q, model.condition_table(q, conditions), model.values[None]
        )
        slope = slopes[:, 0] * units
        steps = -slope * ((distance[:, 0, 0] - touched) / np.maximum(np.sum(slope**2, axis=1), 1e-300))[:, None]
        longest = np.maximum(np.linalg.norm(steps, axis=1, keepdims=True) / LONGEST, 1.0)
        q = q + steps / longest * units
    return q


def clear_of_surface(model: Model, postures: Array) -> NDArray[np.bool_]:
    """(m,) True where links and stylus, straight from joint to joint and to the measured point, are outside the surface
    that the point touches."""
    chain = model.arm.chain
    points, instrument = model.points(postures) @ chain.base[:3, :3].T + chain.base[:3, 3], chain.instrument
    # of a segment the nearest point to a sphere is that to its center, to a plane an end
    points = np.concatenate([points, nearest_on_segment(np.zeros(3), points[:, :-1], points[:, 1:])], axis=1)
    own = np.array([model.best_known[p.name] for p in instrument.parameters])
    above = instrument.linearized(points, own, np.zeros(1))[0][..., 0] - instrument.touched
    return np.asarray(np.all(above > -2.0 * TOUCHES, axis=1))
