"""A fit shared by several sessions, linearized: one effect's values carried over from the other sessions to one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from identification.arrays import Array
from identification.effects import Effect
from identification.gap.confirmation.confirmation import Groups
from identification.gap.fit import Fit
from identification.kinematics.parameters import JOINT_OFFSET
from identification.sessions import BASE, SESSIONS

Index = NDArray[np.int64]
SINGULAR = 1e-10  # of the largest eigenvalue of columns of unit length

FEWEST = 8  # rows needed to test a curve: one for each group


class SessionRows(NamedTuple):
    """Indices of the rows of a session, and groups of these rows that count as independent, by time first."""

    name: str
    rows: Index
    groups: tuple[Groups, ...]


@dataclass(frozen=True, eq=False)
class Carried:
    """The values of the other sessions carried over to one session.

    part : indices, among the session's rows, of the m rows tested
    values, deviations : (size,) estimates from this session alone and their standard deviations [API units]
    gains : (m,) reduction of the whitened squares by the carried-over values;  expected : their mean if those are right
    explained : `gains` as a fraction of the sum of squares;  unsure : the other sessions do not determine the values
    """

    part: Index
    values: Array
    deviations: Array
    gains: Array
    expected: float
    explained: float
    unsure: bool


@dataclass(frozen=True, eq=False)
class SharedFit:
    """A fit linearized at its solution, in whitened coordinates; coefficients of error curves are columns with a prior.

    jacobian : (m, d, P) columns of unit length;  response : (m, d) residual plus Jacobian times values
    lengths : (P,) of the original columns;  penalty : (P,) prior precision of each column's coefficient
    curves : joint (from 1) -> indices of the columns of its error curve
    """

    found: Fit
    jacobian: Array
    response: Array
    lengths: Array
    penalty: Array
    curves: dict[int, Index]
    sessions: tuple[SessionRows, ...]

    @classmethod
    def of(
        cls, found: Fit, sessions: tuple[SessionRows, ...], shapes: Mapping[int, Array] = MappingProxyType({})
    ) -> SharedFit:
        """Linearize a fit.

        sessions : of the rows of the fit
        shapes : joint (from 1) -> (m, d, K) whitened columns of its error curve, each with the prior variance of the
            noise; the fit is without
        """
        rows = found.rows
        shape = len(rows), rows.dimension, -1
        ends = np.cumsum([len(found.values), *(columns.shape[2] for columns in shapes.values())])
        curves = {j: np.arange(*ends[k : k + 2]) for k, j in enumerate(shapes)}
        jacobian = np.concatenate([found.jacobian.reshape(shape), *shapes.values()], axis=2)
        known = np.concatenate([found.values, np.zeros(ends[-1] - len(found.values))])
        lengths = np.sqrt(np.einsum("mdp,mdp->p", jacobian, jacobian))
        lengths = np.where(lengths > 0.0, lengths, 1.0)
        response = found.residual.reshape(shape[:2]) + jacobian @ known
        penalty = np.where(np.arange(len(lengths)) < len(found.values), 0.0, lengths**-2.0)
        return cls(found, jacobian / lengths, response, lengths, penalty, curves, sessions)

    def columns_of(self, effect: Effect) -> Index:
        """Indices of the columns of an effect's parameters, or of its error curve."""
        names = self.found.model.names
        own = [names.index(p.name) for p in effect.parameters if p.name in names]
        return np.array(own) if own else self.curves[effect.joint or 0]

    def white(self, expected: float, rows: int) -> float:
        """Variance of a mean gain over `rows` due to white noise alone."""
        return 4.0 * self.found.sigma**2 * expected / rows

    @cached_property
    def grams(self) -> list[Array]:
        """J^T J (P, P) of each session."""
        return [gram(self.jacobian[s.rows]) for s in self.sessions]

    @cached_property
    def moments(self) -> list[Array]:
        """J^T y (P,) of each session."""
        return [np.einsum("mdp,md->p", self.jacobian[s.rows], self.response[s.rows]) for s in self.sessions]

    def carried(self, k: int, own: Index, joint: int | None = None) -> Carried:
        """Carry the values of columns `own` over from the other sessions to session k (from 0).

        joint : of an error curve (from 1), which is undefined beyond the angles of the other sessions, and whose level
            is not tested
        """
        split, part = Split(self, own, k), self._rows_in_range(k, joint)
        rows = self.sessions[k].rows[part]
        columns, rest = self._adapted(rows, joint, self.jacobian[rows][:, :, own], split.rest(rows))
        there = columns @ split.there
        gains = np.sum(rest**2 - (rest - there) ** 2, axis=1)
        uncertain = np.einsum("ij,ji->", gram(columns), split.covariance_there)
        return Carried(
            part=part,
            values=split.here / self.lengths[own],
            deviations=np.sqrt(np.maximum(np.diag(split.covariance_here), 0.0)) / self.lengths[own],
            gains=gains,
            expected=float(np.sum(there**2) / max(len(rows), 1)),
            explained=float(np.sum(gains) / max(np.sum(rest**2), 1e-300)),
            unsure=bool(len(rows) < FEWEST or uncertain > 0.5 * np.sum(there**2)),
        )

    def _rows_in_range(self, k: int, joint: int | None) -> Index:
        """Indices of the rows of session k within the range of a joint (from 1) in the other sessions; None: all."""
        rows = self.sessions[k].rows
        if joint is None:
            return np.arange(len(rows))
        angles = self.found.rows.postures[:, joint - 1]
        others = np.concatenate([angles[s.rows] for number, s in enumerate(self.sessions) if number != k])
        return np.flatnonzero((angles[rows] >= others.min()) & (angles[rows] <= others.max()))

    def _adapted(self, rows: Index, joint: int | None, columns: Array, rest: Array) -> tuple[Array, Array]:
        """Columns (m, d, size) and residuals (m, d) of rows of a session, projected off the columns of its base and,
        for a curve, of the offset of its joint."""
        names = self.found.model.names
        offset = f"{JOINT_OFFSET}:{joint}"
        bases = ("base.", f"{SESSIONS}.")
        free = [j for j, n in enumerate(names) if n in BASE or n == offset or n.startswith(bases)]
        flat = self.jacobian[rows][:, :, free].reshape(rest.size, len(free))
        both = np.concatenate([columns.reshape(rest.size, columns.shape[2]), rest.reshape(-1, 1)], axis=1)
        left = both - flat @ np.linalg.lstsq(flat, both, rcond=None)[0]
        return left[:, :-1].reshape(columns.shape), left[:, -1].reshape(rest.shape)

    def p_equal(self, own: Index) -> float:
        """p-value of the F test of equal values (columns `own`) in all sessions against separate values in each."""
        p, count = len(self.lengths), len(self.sessions)
        wide = p + (count - 1) * len(own)
        whole, moment = np.zeros((wide, wide)), np.zeros(wide)
        for k in range(count):
            slots = np.arange(p)
            if k:
                slots[own] = p + (k - 1) * len(own) + np.arange(len(own))
            whole[np.ix_(slots, slots)] += self.grams[k]
            moment[slots] += self.moments[k]
        whole[np.arange(p), np.arange(p)] += self.penalty
        shared, moments = np.sum(self.grams, axis=0) + np.diag(self.penalty), np.sum(self.moments, axis=0)
        separate = inverse(whole) @ moment
        gained = float(moment @ separate - moments @ (inverse(shared) @ moments))
        size = int(np.linalg.matrix_rank(whole, hermitian=True) - np.linalg.matrix_rank(shared, hermitian=True))
        freedom = self.response.size - wide
        left = float(np.sum(self.response**2) - moment @ separate)
        return float(fdtrc(size, freedom, max(gained, 0.0) / size / (left / freedom))) if size and left > 0.0 else 1.0


class Split:
    """Least squares with separate values of one effect for session k and for the others.

    here, there : (size,) values in the session and in the others, with covariances (size, size) that hold for any
        dependence within groups of rows (sandwich over intervals of time)
    """

    def __init__(self, problem: SharedFit, own: Index, k: int) -> None:
        p, size = len(problem.lengths), len(own)
        slots = [np.arange(p) for _ in problem.sessions]
        slots[k][own] = p + np.arange(size)
        normal, moment = np.diag(np.r_[problem.penalty, problem.penalty[own]]), np.zeros(p + size)
        for s, own_gram, own_moment in zip(slots, problem.grams, problem.moments, strict=True):
            normal[np.ix_(s, s)] += own_gram
            moment[s] += own_moment
        back = inverse(normal)
        values = back @ moment
        both = np.r_[p + np.arange(size), own]
        root = back[both] @ scores(problem, slots, values)
        covariance = root @ root.T
        self.here, self.there = values[p:], values[own]
        self.covariance_here, self.covariance_there = covariance[:size, :size], covariance[size:, size:]
        self._problem, self._others = problem, np.delete(np.arange(p), own)
        self._values = values

    def rest(self, rows: Index) -> Array:
        """(m, d) response of these rows less the contribution of all other columns."""
        columns = self._problem.jacobian[rows][:, :, self._others]
        return np.asarray(self._problem.response[rows] - columns @ self._values[self._others])


def scores(problem: SharedFit, slots: list[Index], values: Array) -> Array:
    """(p', groups) sum of J^T residual over each interval of time, corrected for the small number of intervals."""
    found = []
    for session, s in zip(problem.sessions, slots, strict=True):
        jacobian, stretches = problem.jacobian[session.rows], session.groups[0]
        each = np.einsum("mdp,md->mp", jacobian, problem.response[session.rows] - jacobian @ values[s])
        count = int(stretches.max()) + 1
        part, sums = np.zeros((count, len(s))), np.zeros((len(values), count))
        np.add.at(part, stretches, each)
        sums[s] = part.T * np.sqrt(count / max(count - 1, 1))
        found.append(sums)
    return np.hstack(found)


def gram(columns: Array) -> Array:
    """(p, p) Gram matrix of columns (m, d, p)."""
    tall = columns.reshape(-1, columns.shape[-1])
    return np.asarray(tall.T @ tall)


def inverse(normal: Array) -> Array:
    """Pseudo-inverse of a normal matrix; combinations that the data do not determine are left out."""
    return np.asarray(np.linalg.pinv(normal, hermitian=True, rcond=SINGULAR))
