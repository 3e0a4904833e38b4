"""Postures at targets: from nominal ones, or near the middle of familiar angles and where possible within these."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from identification.arrays import Array
from identification.compensate.inverse_kinematics import TOLERANCE, Constraints, inverse_kinematics, violations
from identification.compensate.seeds import best_of_seeds, ranked
from identification.kinematics.turns import turned_into
from identification.measurements import Conditions
from identification.model import Model

STILL = 1e-9  # [rad] a joint that did not move has so much room


def reaching(
    model: Model,
    goals: Array,
    nominal: Array,
    conditions: Conditions,
    constraints: Constraints,
    enough: float = TOLERANCE,
) -> Array:
    """(k, n) postures from nominal ones (k, n); from many seeds where that ends short of the target, or where the arm
    may not stand. What ends so near as `enough` [mm] is left only for what gets there exactly: another branch of the
    arm that is nearer by less than anybody knows is none to go to. Goals (k, d) [mm], of poses three more."""
    nominal = turned_into(nominal, model.arm.lower, model.arm.upper, model.joint_types)
    commands, errors = inverse_kinematics(model, goals, nominal, conditions)
    missed = violations(constraints, commands).sum(axis=1)
    short = np.flatnonzero((errors > TOLERANCE) | (missed > 0.0))
    if short.size:
        again, left = best_of_seeds(model, goals[short], nominal[short], conditions.rows(short), constraints)
        now = ranked(np.zeros(len(short)), left, violations(constraints, again).sum(axis=1))
        better = now < ranked(np.zeros(len(short)), errors[short], missed[short])
        better &= (errors[short] > enough) | (missed[short] > 0.0) | (left <= TOLERANCE)
        commands[short[better]] = again[better]
    return commands


def within_or_near(
    model: Model, familiar: tuple[Array, Array], goals: Array, conditions: Conditions, constraints: Constraints
) -> Array:
    """(k, n) postures for goals (k, d) nearest to the middle of familiar angles, and where possible within them; the
    best found where no posture gets there."""
    lower, upper = familiar
    near = np.tile((lower + upper) / 2.0, (len(goals), 1))
    reached = best_of_seeds(model, goals, near, conditions, constraints)[0]
    out = np.flatnonzero(np.any((reached < lower) | (reached > upper), axis=1))
    if not out.size or np.any(lower >= upper):
        return reached
    inside = Model(replace(model.arm, lower=lower, upper=upper))
    for starts in (np.clip(reached, lower, upper), near):
        if not out.size:
            break
        postures, left = inverse_kinematics(inside, goals[out], starts[out], conditions.rows(out))
        better = (left <= TOLERANCE) & ~violations(constraints, postures).any(axis=1)
        reached[out[better]] = postures[better]
        out = out[~better]
    return reached


def near_or_within(
    model: Model,
    familiar: tuple[Array, Array],
    goals: Array,
    reached: Array,
    where: Conditions,
    constraints: Constraints,
    enough: float = TOLERANCE,
) -> Array:
    """(k, n) postures that were found for goals (k, d); for those out of reach, farther than `enough` [mm], where they
    are outside familiar angles, the nearest within them."""
    lower, upper = familiar
    left = np.linalg.norm(goals - model.position(reached, conditions=where), axis=1)
    out = np.flatnonzero((left > enough) & np.any((reached < lower) | (reached > upper), axis=1))
    if out.size:
        inside = Model(replace(model.arm, lower=lower, upper=np.maximum(upper, lower + STILL)))
        starts = np.clip(reached[out], lower, upper)
        reached[out] = best_of_seeds(inside, goals[out], starts, where.rows(out), constraints)[0]
    return reached
