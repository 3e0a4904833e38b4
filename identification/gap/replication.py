"""Whether an effect is the same in every session: one of the robot returns, one of a set-up does not.

All sessions share one fit, each with its own base. Of one effect with the values t in one session and o in the others
there are four explanations, beside everything else that is named:

    same        t = o (1 + SAME e),  e ~ N(0, 1)        own         t and o independent
    elsewhere   t = 0                                   here        o = 0

Beforehand they are equally likely; how likely the data are under each says `likelihood`, the effect's columns times the
indicator of the session, and of the others, being blocks. The effect *replicates* in the session where `same` has the
probability `CREDIBLE`, and does not where `own` and `elsewhere` have it together. Else it is open: as where the session
can say little, or where the others know nothing of the effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.special import logsumexp, softmax

from identification.arrays import Array
from identification.gap.fit import Fit
from identification.gap.likelihood import SIZES, Index, Products, orthonormal
from identification.gap.search import CREDIBLE
from identification.information import PRODUCT_TOLERANCE, VISIBLE
from identification.kinematics.parameters import Parameter

SAME = 0.1  # relative difference of values that are the same; convention: temperature and load differ by session

Columns = tuple[int, Array, int]  # of the error curve of a joint (from 1): (m, d, K), and its number in `SIZES`


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
    """One named effect, or an error curve, across sessions;  parameters : none of a curve"""

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


def replications(
    fitted: Fit,
    names: Sequence[str],
    labels: Sequence[str],
    curves: Mapping[str, Columns] = MappingProxyType({}),
) -> tuple[Replication, ...]:
    """Replication of the named effects and of error curves across sessions; empty for a single session.

    fitted : with the named effects, without curves;  names : of the sessions in the order of their numbers
    labels : of the named effects;  curves : by their keys
    """
    rows, model = fitted.rows, fitted.model
    session = rows.conditions.session
    if session is None or np.ptp(session) == 0.0:
        return ()
    jacobian, scaled = fitted.linearized[1] / model.scales, fitted.values * model.scales
    table = np.concatenate([fitted.left[:, :, None], jacobian, *(columns for _, columns, _ in curves.values())], axis=2)
    ends = np.cumsum([1 + jacobian.shape[2], *(columns.shape[2] for _, columns, _ in curves.values())])
    size, p = table.shape[2], int(ends[0])
    # columns of the table, standard deviations of an error curve's, and parameters of each effect or curve
    own: dict[str, tuple[Index, tuple[Parameter, ...]]] = {}
    for effect in (e for e in model.effects if e.label in labels):
        parameters = tuple(x for x in effect.parameters if x.name in model.names)
        own[effect.label] = np.array([1 + model.names.index(x.name) for x in parameters], dtype=np.int64), parameters
    of_curves = {key: np.arange(*ends[k : k + 2]) for k, key in enumerate(curves)}
    there: dict[str, list[InSession]] = {label: [] for label in (*own, *curves)}
    for number in np.unique(session).astype(int).tolist():
        here = session == number
        for keys, joint in ([*own], 0), *(([key], joint) for key, (joint, _, _) in curves.items()):
            common = np.ones(len(here), dtype=bool)
            if joint:  # a curve is compared at the angles that both have
                angles = rows.postures[:, joint - 1]
                parts = angles[here], angles[~here]
                common = (angles >= max(x.min() for x in parts)) & (angles <= min(x.max() for x in parts))
            masks = common[:, None, None], (common & here)[:, None, None]
            white = rows.whiten(np.concatenate([table * mask for mask in masks], axis=2))
            gram = white.T @ white
            for key in keys:
                at, parameters = (of_curves[key], ()) if joint else own[key]
                beside = [(k, curves[name][2]) for name, ks in of_curves.items() if name != key for k in ks.tolist()]
                prior = gram.copy()
                prior[[k for k, _ in beside], [k for k, _ in beside]] += [SIZES[s] ** -2.0 for _, s in beside]
                target = np.zeros(2 * size)
                target[0] = 1.0
                target[at] = 0.0 if joint else scaled[at - 1]  # the fit has the effect, but not the curve
                rest = np.concatenate([np.setdiff1d(np.arange(1, p), at), np.array([k for k, _ in beside], dtype=int)])
                coordinates = rows.dimension * int(common.sum()) + len(beside)
                units = None if joint else np.array([x.to_file for x in parameters]) / model.scales[at - 1]
                there[key].append(InSession(names[number], *_in_session(prior, target, rest, at, coordinates, units)))
    return tuple(Replication(key, own[key][1] if key in own else (), tuple(asked)) for key, asked in there.items())


def _in_session(
    gram: Array, target: Array, rest: Index, every: Index, coordinates: int, units: Array | None
) -> tuple[Any, ...]:
    """Fields of `InSession` behind its name, from the products (2 n, 2 n) of n whitened columns and of their parts in
    the session.

    target : (2 n,) combination to be explained;  rest, every : of everything else, and of the effect, among the n
    units : (w,) from its parameters to those of files, None: an error curve
    """
    asked = np.zeros((len(gram), 1 + 2 * len(every)))  # what is to be explained, the effect, its part in the session
    asked[:, 0], width = target, len(every)
    asked[[*every, *(every + len(gram) // 2)], np.arange(1, 1 + 2 * width)] = 1.0
    basis = orthonormal(gram[np.ix_(rest, rest)], PRODUCT_TOLERANCE)
    across = asked.T @ gram[:, rest] @ basis
    left = asked.T @ gram @ asked - across @ across.T
    both, here = np.eye(1 + 2 * width)[:, 1 : 1 + width], np.eye(1 + 2 * width)[:, 1 + width :]
    seen = np.trace(both.T @ left @ both)
    if seen <= VISIBLE * np.trace(gram[np.ix_(every, every)]):  # nothing that the rest does not have, or no such rows
        return ()
    root = np.eye(width)
    if units is not None:  # the prior covariance of an effect is the inverse of its information
        root = orthonormal(both.T @ left @ both)
        root = root / np.sqrt(max(root.shape[1], 1))
    both, here, width = both @ root, here @ root, root.shape[1]
    blocks = np.hstack([here, both - here, both, SAME * here])
    starts, signs, limits = np.array([0, 1, 2, 4]) * width, np.zeros(3, dtype=bool), np.full(3, len(SIZES))
    freedom, squares = max(coordinates - basis.shape[1], 1), float(left[0, 0])
    products = Products(blocks.T @ left @ blocks, left[0] @ blocks, squares, freedom, starts, signs, limits)
    in_here, in_others, in_both = products.added(products.state())  # each (sizes,)
    double = in_others[:, None] + np.array([products.added(products.state([(1, s)]))[0] for s in range(len(SIZES))])
    tables = in_both, double, in_others, in_here
    same, own, absent, _ = softmax([logsumexp(table) - np.log(table.size) for table in tables]).tolist()
    answer = True if same >= CREDIBLE else False if own + absent >= CREDIBLE else None
    if units is None:
        return (), (), same, answer
    elsewhere, inside = np.unravel_index(np.argmax(double), double.shape)
    apiece = products.state([(0, int(inside)), (1, int(elsewhere))])
    turn = root * units[:, None]
    deviations = np.sqrt(np.diag(turn @ apiece.covariance[:width, :width] @ turn.T) * apiece.variance)
    return tuple((turn @ apiece.mean[:width]).tolist()), tuple(deviations.tolist()), same, answer
