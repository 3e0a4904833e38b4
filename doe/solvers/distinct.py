"""Repeats only when asked for: postures of a plan that are too near each other are moved apart, at the least loss."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from doe.criteria.base import quick, values_after_adding
from doe.problem import DesignProblem
from doe.solvers.base import distance_to_keep
from identification.arm import Array
from identification.information import information_matrix

ROUNDING = 1.0 + 1e-9
REACH = 3  # multiples of the minimum distance that a posture may be moved by, in each of a few joints


def gaps(postures: Array, others: Array) -> Array:
    """(m, k) largest joint difference [rad] between postures (m, n) and others (k, n)."""
    return np.abs(postures[:, None] - others).max(axis=-1, initial=0.0)


def too_near(problem: DesignProblem, postures: Array) -> NDArray[np.intp]:
    """Rows that come within the minimum distance of an earlier row or of a posture measured already."""
    distance = distance_to_keep(problem, len(postures)) / ROUNDING
    if distance <= 0.0:
        return np.empty(0, dtype=np.intp)
    near = np.tril(gaps(postures, postures) < distance, k=-1).any(axis=1)
    if problem.kept is not None and len(problem.kept):
        near |= (gaps(postures, problem.kept) < distance).any(axis=1)
    return np.flatnonzero(near)


def separated(problem: DesignProblem, postures: Array) -> Array:
    """The same plan with every repeat moved to the best free place around it; unchanged where there is none."""
    plan = np.array(postures)
    for row in too_near(problem, plan):
        others = np.delete(plan, row, axis=0)
        if problem.kept is not None:
            others = np.vstack([others, problem.kept])
        places = around(problem, plan[row])
        places = places[(gaps(places, others) >= problem.minimum_distance / ROUNDING).all(axis=1)]
        places = places[problem.feasible(places)] if len(places) else places
        if len(places):
            information = information_matrix(problem.blocks(others)) / len(others)
            blocks = problem.blocks(places) / np.sqrt(len(others))
            values = values_after_adding(quick(problem.criterion), information[None], blocks[None])[0]
            plan[row] = places[np.argmax(values)]
    return plan


def around(problem: DesignProblem, posture: Array) -> Array:
    """(k, n) postures within the limits that differ by multiples of the minimum distance in up to two joints."""
    step = problem.minimum_distance * ROUNDING
    sizes = step * np.array([s for s in range(-REACH, REACH + 1) if s])
    moves = []
    for joint in problem.searched_joints:
        for size in sizes:
            move = np.zeros(problem.joints)
            move[joint] = size
            moves.append(move)
    pairs = [a + b for a, b in product(moves, moves) if np.count_nonzero(a + b) == 2]
    places = posture + np.array(moves + pairs)
    return places[np.all((places >= problem.lower) & (places <= problem.upper), axis=1)]
