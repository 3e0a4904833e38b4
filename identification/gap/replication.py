"""Several sessions: does a named effect return in another session with the same size?

All sessions share one fit, each with a base of its own. For one effect and one session, the effect's parameters are
fitted to the other sessions alone (everything else still to all of them) and carried over; only the base of the session
adapts. If that leaves less of the session than no effect at all, the effect returned; the gain is tested over groups of
rows as a hold-out is (`gap.confirmation`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from identification.arrays import Array
from identification.effects import Effect
from identification.gap.confirmation import LEVEL, Groups, Mean, groupings, mean_of
from identification.gap.fit import Fit
from identification.gap.whitening import Rows
from identification.measurements import Measurements
from identification.sessions import BASE, SESSIONS

Index = NDArray[np.int64]


@dataclass(frozen=True)
class InSession:
    """An effect in one session.

    values, deviations : fitted to this session alone, in the unit of files
    explained : share of the squares without the effect that the values of the other sessions explain here
    returns : True, False, or None where it cannot be said
    """

    session: str
    values: tuple[float, ...]
    deviations: tuple[float, ...]
    explained: float
    returns: bool | None


@dataclass(frozen=True)
class Replication:
    """One named effect across sessions.

    names, units : of its parameters;  p_equal : probability of values that differ so much if in truth they are equal
    returns : whether carried-over values explain something, in all sessions together
    """

    effect: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    p_equal: float
    returns: bool | None
    sessions: tuple[InSession, ...]

    @property
    def replicates(self) -> bool | None:
        """False if carried-over values do harm in one session or explain nothing, None: cannot be said."""
        return False if any(session.returns is False for session in self.sessions) else self.returns

    def __str__(self) -> str:
        says = {True: "replicates", False: "does not replicate", None: "is open"}[self.replicates]
        parts = "; ".join(f"{s.session}: {self.figures(s)}" for s in self.sessions)
        return f"{self.effect} {says} across sessions ({parts})"

    def figures(self, there: InSession) -> str:
        """Its values in a session, for people."""
        figures = zip(self.names, there.values, there.deviations, self.units, strict=True)
        listed = [f"{n.rpartition('.')[2]} = {v:.3g} +- {d:.1g} {u}" for n, v, d, u in figures]
        return ", ".join(listed) if len(listed) <= 3 else f"{len(listed)} values"

    def to_json(self) -> dict[str, Any]:
        """An entry of `replication` (identification/files/README.md, "JSON keys")."""
        return {
            "effect": self.effect,
            "replicates": self.replicates,
            "p_equal": self.p_equal,
            "sessions": [
                {
                    "session": s.session,
                    "replicates": s.returns,
                    "explained": s.explained,
                    "parameters": [
                        {"name": n, "unit": u, "value": v, "std": d}
                        for n, u, v, d in zip(self.names, self.units, s.values, s.deviations, strict=True)
                    ],
                }
                for s in self.sessions
            ],
        }


def replications(
    found: Fit, rows: Rows, measurements: Measurements, kept: NDArray[np.bool_], labels: tuple[str, ...]
) -> tuple[Replication, ...]:
    """The named effects (their labels) of a fit to the kept rows across sessions; empty if there is one session."""
    if len(measurements.rows(kept).sessions) < 2:
        return ()
    problem = _Linear.of(found, rows, measurements, kept)
    return tuple(problem.replication(effect) for effect in found.model.effects if effect.label in labels)


@dataclass(frozen=True, eq=False)
class _Carried:
    """The values of the other sessions in one.

    here : (size,) its own values, of columns of unit length, with standard deviations
    gains : (m,) whitened squares that carried-over values explain;  expected : their mean if those were right
    explained : their share of the squares;  unsure : the other sessions do not know the values well
    """

    here: Array
    deviations: Array
    gains: Array
    expected: float
    explained: float
    unsure: bool


@dataclass(frozen=True, eq=False)
class _Linear:
    """The fit as linear least squares at its solution, in whitened coordinates.

    jacobian : (m, d, p) columns, each divided by its length;  response : (m, d) residual plus jacobian times values
    lengths : (p,);  sessions : for each its name, its rows, and groups of these rows
    """

    found: Fit
    jacobian: Array
    response: Array
    lengths: Array
    sessions: tuple[tuple[str, Index, tuple[Groups, ...]], ...]

    @classmethod
    def of(cls, found: Fit, rows: Rows, measurements: Measurements, kept: NDArray[np.bool_]) -> _Linear:
        model, (m, d) = found.model, (len(rows), rows.dimension)
        position, jacobian = model.linearize(rows.postures, found.values, rows.conditions)
        white = rows.whiten(jacobian)
        lengths = np.linalg.norm(white, axis=0)
        lengths = np.where(lengths > 0.0, lengths, 1.0)
        white = white / lengths
        response = rows.whiten(rows.positions - position) + white @ (lengths * found.values)
        data = measurements.rows(kept)
        turn = np.empty(m)
        turn[data.sequence] = np.arange(m)
        sessions = tuple(
            (name, index, groupings(data.postures[index], data.posture_numbers[index], turn[index]))
            for name, index in zip(data.sessions, data.session_rows, strict=True)
        )
        return cls(found, white.reshape(m, d, -1), response.reshape(m, d), lengths, sessions)

    @cached_property
    def grams(self) -> list[Array]:
        """For each session (p, p) J^T J."""
        return [_gram(self.jacobian[index]) for _, index, _ in self.sessions]

    @cached_property
    def moments(self) -> list[Array]:
        """For each session (p,) J^T y."""
        return [np.einsum("mdp,md->p", self.jacobian[i], self.response[i]) for _, i, _ in self.sessions]

    def replication(self, effect: Effect) -> Replication:
        """One effect in every session."""
        names = [p.name for p in effect.parameters if p.name in self.found.model.names]
        own = np.array([self.found.model.names.index(name) for name in names])
        parameters = [self.found.model.parameters[int(k)] for k in own]
        factors = np.array([p.to_file for p in parameters]) / self.lengths[own]
        carried = [self._carried(k, own) for k in range(len(self.sessions))]
        there = tuple(self._in_session(k, c, factors) for k, c in enumerate(carried))
        units = tuple(p.file_unit for p in parameters)
        return Replication(effect.label, tuple(names), units, self._p_equal(own), self._together(carried), there)

    def _together(self, carried: list[_Carried]) -> bool | None:
        """Whether carried-over values explain something in all sessions together."""
        gains = np.concatenate([c.gains for c in carried])
        by_groups = []
        for kind in zip(*(groups for _, _, groups in self.sessions), strict=True):
            starts = np.cumsum([0, *(int(g.max()) + 1 for g in kind)])
            by_groups.append(np.concatenate([g + start for g, start in zip(kind, starts, strict=False)]))
        expected = sum(c.expected * len(c.gains) for c in carried) / len(gains)
        noise = 4.0 * self.found.sigma**2 * expected / len(gains)
        return _returns(mean_of(gains, by_groups, noise), expected, any(c.unsure for c in carried))

    def _in_session(self, k: int, carried: _Carried, factors: Array) -> InSession:
        name, index, by_groups = self.sessions[k]
        noise = 4.0 * self.found.sigma**2 * carried.expected / len(index)
        return InSession(
            name,
            tuple((carried.here * factors).tolist()),
            tuple((carried.deviations * np.abs(factors)).tolist()),
            carried.explained,
            _returns(mean_of(carried.gains, by_groups, noise), carried.expected, carried.unsure),
        )

    def _carried(self, k: int, own: Index) -> _Carried:
        """The effect with the values of the other sessions, in session number k."""
        split = _Split(self, own, k)
        index = self.sessions[k][1]
        columns, rest = self._without_base(k, self.jacobian[index][:, :, own], split.rest[index])
        there = columns @ split.there
        gains = np.sum(rest**2 - (rest - there) ** 2, axis=1)
        return _Carried(
            here=split.here,
            deviations=np.sqrt(np.diag(split.covariance_here)),
            gains=gains,
            expected=float(np.mean(np.sum(there**2, axis=1))),
            explained=float(np.sum(gains) / max(np.sum(rest**2), 1e-300)),
            unsure=bool(np.trace(_gram(columns) @ split.covariance_there) > 0.5 * np.sum(there**2)),
        )

    def _without_base(self, k: int, columns: Array, rest: Array) -> tuple[Array, Array]:
        """Columns (m, d, size) and residuals (m, d) of a session after its base has adapted to them."""
        names, index = self.found.model.names, self.sessions[k][1]
        base = [j for j, name in enumerate(names) if name in BASE or name.startswith(f"{SESSIONS}.")]
        flat = self.jacobian[index][:, :, base].reshape(rest.size, -1)
        both = np.concatenate([columns.reshape(rest.size, -1), rest.reshape(-1, 1)], axis=1)
        left = both - flat @ np.linalg.lstsq(flat, both, rcond=None)[0]
        return left[:, :-1].reshape(columns.shape), left[:, -1].reshape(rest.shape)

    def _p_equal(self, own: Index) -> float:
        """F test of one set of values for all sessions against one for each."""
        p, count = len(self.lengths), len(self.sessions)
        gram, moment = np.zeros((p + (count - 1) * len(own),) * 2), np.zeros(p + (count - 1) * len(own))
        for k in range(count):
            slots = np.arange(p)
            if k:
                slots[own] = p + (k - 1) * len(own) + np.arange(len(own))
            gram[np.ix_(slots, slots)] += self.grams[k]
            moment[slots] += self.moments[k]
        separate = _solve(gram, moment)
        shared, moments = np.sum(self.grams, axis=0), np.sum(self.moments, axis=0)
        gained = float(moment @ separate) - float(moments @ _solve(shared, moments))
        size = int(np.linalg.matrix_rank(gram, hermitian=True) - np.linalg.matrix_rank(shared, hermitian=True))
        freedom = self.response.size - len(moment)
        left = float(np.sum(self.response**2) - moment @ separate)
        return float(fdtrc(size, freedom, max(gained, 0.0) / size / (left / freedom))) if size and left > 0.0 else 1.0


class _Split:
    """Least squares with one effect's values apart for session number k and for the others.

    here, there : (size,) values in the session and in the others, with their covariances (size, size), which hold
        whatever the dependence within groups of rows (sandwich over groups of time);  rest : (m, d) without the effect
    """

    def __init__(self, problem: _Linear, own: Index, k: int) -> None:
        p, size = len(problem.lengths), len(own)
        slots = [np.arange(p) for _ in problem.sessions]
        slots[k][own] = p + np.arange(size)
        gram, moment = np.zeros((p + size, p + size)), np.zeros(p + size)
        for s, own_gram, own_moment in zip(slots, problem.grams, problem.moments, strict=True):
            gram[np.ix_(s, s)] += own_gram
            moment[s] += own_moment
        inverse = np.linalg.pinv(gram, hermitian=True, rcond=1e-10)
        values = inverse @ moment
        covariance = inverse @ _scores(problem, slots, values) @ inverse
        others = np.delete(np.arange(p), own)
        self.here, self.there = values[p:], values[own]
        self.covariance_here, self.covariance_there = covariance[p:, p:], covariance[np.ix_(own, own)]
        self.rest = problem.response - problem.jacobian[:, :, others] @ values[others]


def _scores(problem: _Linear, slots: list[Index], values: Array) -> Array:
    """(p', p') sum over groups of rows of the outer product of their scores."""
    total = np.zeros((len(values), len(values)))
    for (_, index, by_groups), s in zip(problem.sessions, slots, strict=True):
        jacobian = problem.jacobian[index]
        residual = problem.response[index] - jacobian @ values[s]
        each = np.einsum("mdp,md->mp", jacobian, residual)
        stretches = by_groups[0]
        sums = np.array([np.bincount(stretches, column) for column in each.T])  # (p, groups)
        count = sums.shape[1]
        total[np.ix_(s, s)] += sums @ sums.T * (count / max(count - 1, 1))
    return total


def _returns(gain: Mean, expected: float, unsure: bool) -> bool | None:
    """Whether carried-over values explain something.

    gain : mean square explained by them;  expected : if they were right;  unsure : the others do not know them well
    """
    if unsure:  # what is carried over is chance, and so is its sign
        return None
    if gain.p_above() <= LEVEL / 2.0:
        return True
    worse = gain._replace(value=-gain.value).p_above() <= LEVEL / 2.0
    return False if worse or (gain.value <= 0.0 and gain.detects(expected)) else None


def _gram(columns: Array) -> Array:
    """(p, p) of columns (m, d, p)."""
    tall = columns.reshape(-1, columns.shape[-1])
    return np.asarray(tall.T @ tall)


def _solve(gram: Array, moment: Array) -> Array:
    return np.asarray(np.linalg.pinv(gram, hermitian=True, rcond=1e-10) @ moment)


def said(found: tuple[Replication, ...]) -> Iterator[str]:
    """For the verdict: what returns in other sessions and what does not."""
    for answer, words in ((True, "replicates across sessions"), (False, "does not replicate across sessions")):
        if titles := [r.effect for r in found if r.replicates is answer]:
            yield f"{words}: {' + '.join(titles)}"
