"""Test whether a named effect replicates in other sessions with the same size.

All sessions share one fit, each with its own base. For one effect and one session, the effect's parameters are fitted
to the other sessions only (all others still to all sessions) and carried over; only the base of the session is
adapted. If that reduces the residuals of the session, the effect replicates; the gain is tested over groups of rows
like a hold-out (`gap.confirmation`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.effects import Effect
from identification.gap.confirmation.confirmation import LEVEL, Groups, Mean, groupings, mean_of
from identification.gap.fit import Fit
from identification.gap.sessions.replication import InSession, Replication
from identification.gap.sessions.shared_fit import Carried, SessionRows, SharedFit
from identification.measurements import Measurements


def replications(
    found: Fit,
    measurements: Measurements,
    kept: NDArray[np.bool_],
    labels: tuple[str, ...],
    curves: Sequence[tuple[Effect, Array]] = (),
) -> tuple[Replication, ...]:
    """Replication of the named effects and of error curves across sessions; empty for a single session.

    found : fit to the kept rows;  kept : (m,) rows that are no outliers;  labels : of the named effects
    curves : with their (m, d, K) columns in the kept rows, as of `SharedFit.of`
    """
    data = measurements.rows(kept)
    if len(data.sessions) < 2:
        return ()
    turn = np.empty(len(data))
    turn[data.sequence] = np.arange(len(data))
    sessions = tuple(
        SessionRows(name, rows, groupings(data.postures[rows], data.posture_numbers[rows], turn[rows]))
        for name, rows in zip(data.sessions, data.session_rows, strict=True)
    )
    problem = SharedFit.of(found, sessions, {curve.joint or 0: columns for curve, columns in curves})
    effects = [effect for effect in found.model.effects if effect.label in labels]
    return tuple(_replication(problem, effect) for effect in [*effects, *(curve for curve, _ in curves)])


def _replication(problem: SharedFit, effect: Effect) -> Replication:
    """One effect in every session."""
    own = problem.columns_of(effect)
    parameters = [p for p in effect.parameters if p.name in problem.found.model.names]
    factors = np.array([p.to_file for p in parameters])
    joint = None if parameters else effect.joint
    carried = [problem.carried(k, own, joint) for k in range(len(problem.sessions))]
    there = tuple(_in_session(problem, k, one, factors) for k, one in enumerate(carried))
    names, units = tuple(p.name for p in parameters), tuple(p.file_unit for p in parameters)
    p_equal = problem.p_equal(own) if parameters else None
    return Replication(effect.label, names, units, p_equal, _together(problem, carried), there)


def _in_session(problem: SharedFit, k: int, carried: Carried, factors: Array) -> InSession:
    session = problem.sessions[k]
    values, deviations = (v[: len(factors)] * factors for v in (carried.values, carried.deviations))
    gain = _gain(problem, carried.gains, _groups(session, carried), carried.expected)
    return InSession(
        session.name,
        tuple(values.tolist()),
        tuple(np.abs(deviations).tolist()),
        carried.explained,
        _returns(gain, carried.expected, carried.unsure),
    )


def _together(problem: SharedFit, carried: list[Carried]) -> bool | None:
    """Whether carried-over values reduce the residuals in all sessions together; None: undecided."""
    gains = np.concatenate([c.gains for c in carried])
    by_groups = []
    for kind in zip(*(_groups(session, c) for session, c in zip(problem.sessions, carried, strict=True)), strict=True):
        starts = np.cumsum([0, *(int(g.max(initial=-1)) + 1 for g in kind)])
        by_groups.append(np.concatenate([g + start for g, start in zip(kind, starts, strict=False)]))
    expected = sum(c.expected * len(c.gains) for c in carried) / max(len(gains), 1)
    return _returns(_gain(problem, gains, by_groups, expected), expected, any(c.unsure for c in carried))


def _groups(session: SessionRows, carried: Carried) -> list[Groups]:
    """The groups of the tested rows of a session, renumbered from 0."""
    return [np.unique(groups[carried.part], return_inverse=True)[1] for groups in session.groups]


def _gain(problem: SharedFit, gains: Array, by_groups: Sequence[Groups], expected: float) -> Mean:
    """Mean of the gains of the rows, of infinite variance without rows."""
    if not len(gains):
        return Mean(0.0, np.inf, 1.0)
    return mean_of(gains, by_groups, problem.white(expected, len(gains)))


def _returns(gain: Mean, expected: float, unsure: bool) -> bool | None:
    """Whether carried-over values reduce the residuals; None: undecided.

    gain : mean square that they explain;  expected : its value if they are right
    unsure : the other sessions do not determine them well
    """
    if unsure:  # the carried-over values are mostly noise, and so is their sign
        return None
    if gain.p_above() <= LEVEL / 2.0:
        return True
    worse = gain._replace(value=-gain.value).p_above() <= LEVEL / 2.0
    return False if worse or (gain.value <= 0.0 and gain.detects(expected)) else None
