"""Whether an effect is the same in every session: one of the robot returns, one of a set-up does not.

Of one effect with the values t in one session and o in the others there are four explanations, equally likely
beforehand, beside everything else that is named; the effect's columns times the indicator of the session, and of the
others, are blocks of `likelihood`:

    same        t = o (1 + SAME e),  e ~ N(0, 1)        apart       t and o independent
    elsewhere   t = 0                                   here        o = 0
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import logsumexp, softmax

from identification.arrays import Array
from identification.gap.fit import Fitted
from identification.gap.likelihood import SIZES, Index, Products, orthonormal
from identification.gap.search import CREDIBLE
from identification.information import PRODUCT_TOLERANCE, VISIBLE
from identification.kinematics.parameters import Parameter

SAME = 0.1  # relative difference of values that are the same; convention: temperature and load differ by session


class InSession(NamedTuple):
    """An effect in one session.

    values, deviations : in this session, if it is independent of the others, with standard deviations [unit of files]
    probability : that they are the same as in the others;  replicates : None: undecided
    """

    session: str
    values: tuple[float, ...] = ()
    deviations: tuple[float, ...] = ()
    probability: float = 0.25
    replicates: bool | None = None


@dataclass(frozen=True)
class Replication:
    """One named effect across sessions."""

    effect: str
    parameters: tuple[Parameter, ...]
    sessions: tuple[InSession, ...]

    @property
    def replicates(self) -> bool | None:
        """False if the effect fails to replicate in one session, True if it does in each; None: undecided."""
        answers = {session.replicates for session in self.sessions}
        return False if False in answers else True if answers == {True} else None

    def to_json(self) -> dict[str, Any]:
        """An entry of `replication` (identification/files/README.md, "JSON keys")."""
        sessions = []
        for s in self.sessions:
            figures = zip(self.parameters, s.values, s.deviations, strict=False)
            listed = [{"name": p.name, "unit": p.file_unit, "value": v, "std": d} for p, v, d in figures]
            said = {"session": s.session, "replicates": s.replicates, "probability": s.probability}
            sessions.append({**said, "parameters": listed})
        return {"effect": self.effect, "replicates": self.replicates, "sessions": sessions}


def replications(fitted: Fitted, names: Sequence[str], labels: Sequence[str]) -> tuple[Replication, ...]:
    """Replication of named effects across sessions; empty for a single session.

    fitted : with these effects;  names : of the sessions in the order of their numbers;  labels : of the effects
    """
    rows, model = fitted.rows, fitted.model
    session = rows.conditions.session
    if session is None or np.ptp(session) == 0.0:
        return ()
    jacobian, scaled = fitted.linearized[1] / model.scales, fitted.values * model.scales
    table = np.concatenate([jacobian, fitted.errors[:, :, None]], axis=2)
    grams = []
    for number in np.unique(session):
        white = rows.whiten(np.concatenate([table, table * (session == number)[:, None, None]], axis=2))
        grams.append(white.T @ white)
    replicated = []
    for effect in (e for e in model.effects if e.label in labels):
        parameters = tuple(x for x in effect.parameters if x.name in model.names)
        own = np.array([model.names.index(x.name) for x in parameters], dtype=np.int64)
        target = np.zeros(len(grams[0]))  # what is to be explained: the fit has the effect
        target[[*own, jacobian.shape[2]]] = [*scaled[own], 1.0]
        units = np.array([x.to_file for x in parameters]) / model.scales[own]
        sessions = [in_session(name, gram, target, own, units, fitted) for name, gram in zip(names, grams, strict=True)]
        replicated.append(Replication(effect.label, parameters, tuple(sessions)))
    return tuple(replicated)


def in_session(name: str, gram: Array, target: Array, own: Index, units: Array, fitted: Fitted) -> InSession:
    """An effect in one session, from the products (2 n, 2 n) of n whitened columns and of their parts in the session.

    target : (2 n,) combination to be explained;  own : of the effect among the n, before the last, the residuals
    units : (w,) from its parameters to those of files
    """
    width, n = len(own), len(gram) // 2
    asked = np.zeros((len(gram), 1 + 2 * width))  # what is to be explained, the effect, its part in the session
    asked[:, 0] = target
    asked[[*own, *(own + n)], np.arange(1, 1 + 2 * width)] = 1.0
    rest = np.setdiff1d(np.arange(n - 1), own)
    basis = orthonormal(gram[np.ix_(rest, rest)], PRODUCT_TOLERANCE)
    across = asked.T @ gram[:, rest] @ basis
    left = asked.T @ gram @ asked - across @ across.T
    both, here = np.split(np.eye(1 + 2 * width)[:, 1:], 2, axis=1)
    if np.trace(both.T @ left @ both) <= VISIBLE * np.trace(gram[np.ix_(own, own)]):  # nothing that the rest has not
        return InSession(name)
    root = orthonormal(both.T @ left @ both)  # the prior covariance of an effect is the inverse of its information
    width = root.shape[1]
    root = root / np.sqrt(max(width, 1))
    both, here = both @ root, here @ root
    blocks = np.hstack([here, both - here, both, SAME * here])
    freedom, starts = max(len(fitted.residual) - basis.shape[1], 1), np.array([0, 1, 2, 4]) * width
    signs = np.zeros(3, dtype=bool)
    products = Products(blocks.T @ left @ blocks, left[0] @ blocks, float(left[0, 0]), freedom, starts, signs)
    in_here, in_others, in_both = products.added(products.state())  # each (sizes,)
    double = in_others[:, None] + np.array([products.added(products.state([(1, s)]))[0] for s in range(len(SIZES))])
    evidence = [logsumexp(odds) - np.log(odds.size) for odds in (in_both, double, in_others, in_here)]
    same, apart, absent, _ = softmax(evidence).tolist()
    answer = True if same >= CREDIBLE else False if apart + absent >= CREDIBLE else None
    elsewhere, inside = np.unravel_index(np.argmax(double), double.shape)
    apiece = products.state([(0, int(inside)), (1, int(elsewhere))])
    turn = root * units[:, None]
    deviations = np.sqrt(np.diag(turn @ apiece.covariance[:width, :width] @ turn.T) * apiece.variance)
    return InSession(name, tuple((turn @ apiece.mean[:width]).tolist()), tuple(deviations.tolist()), same, answer)
