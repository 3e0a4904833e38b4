"""Whether an effect is the same in every session: one of the robot returns, one of a set-up does not.

All sessions share one fit, each with its own base. Of one effect with the values t in one session and o in the others
there are four explanations, beside everything else that is named:

    same        t = o (1 + SAME e),  e ~ N(0, 1)        own         t and o independent
    elsewhere   t = 0                                   here        o = 0

Beforehand they are equally likely; how likely the data are under each says `evidence`, the effect's columns times the
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
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax

from identification.arrays import Array
from identification.gap.columns import Where
from identification.gap.curve import Curve
from identification.gap.evidence import SIZES, Products
from identification.gap.fit import Fit, Rows
from identification.gap.posterior import Explanation, Posterior
from identification.gap.verdict import CREDIBLE
from identification.information import VISIBLE, column_space, column_space_of
from identification.kinematics.parameters import Parameter

SAME = 0.1  # relative difference of values that are the same; convention: temperature and load differ by session


class CurveColumns(NamedTuple):
    """Of the error curve of a joint (from 1): its (m, d, K) columns in the rows of a fit, and its number in `SIZES`."""

    joint: int
    columns: Array
    size: int


@dataclass(frozen=True)
class InSession:
    """An effect in one session.

    values, deviations : in this session, if it is independent of the others, with standard deviations [unit of files]
    probability : that they are the same as in the others;  replicates : None: undecided
    """

    session: str
    values: tuple[float, ...]
    deviations: tuple[float, ...]
    probability: float
    replicates: bool | None


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

    def __str__(self) -> str:
        says = {True: "replicates", False: "does not replicate", None: "is open"}[self.replicates]
        parts = "; ".join(f"{s.session}: {self.figures(s)}" for s in self.sessions)
        return f"{self.effect} {says} across sessions ({parts})"

    def figures(self, there: InSession) -> str:
        """Its values in a session, as text."""
        shown = self.parameters if there.values else ()
        figures = zip(shown, there.values, there.deviations, strict=True)
        listed = [f"{p.name.rpartition('.')[2]} = {v:.3g} +- {d:.1g} {p.file_unit}" for p, v, d in figures]
        return ", ".join(listed) if 0 < len(listed) <= 3 else f"the same with probability {there.probability:.2f}"

    def to_json(self) -> dict[str, Any]:
        """An entry of `replication` (identification/files/README.md, "JSON keys")."""
        return {
            "effect": self.effect,
            "replicates": self.replicates,
            "sessions": [
                {
                    "session": s.session,
                    "replicates": s.replicates,
                    "probability": s.probability,
                    "parameters": [
                        {"name": p.name, "unit": p.file_unit, "value": v, "std": d}
                        for p, v, d in zip(self.parameters if s.values else (), s.values, s.deviations, strict=True)
                    ],
                }
                for s in self.sessions
            ],
        }


def curve_columns(found: Posterior, one: Explanation, fitted: Fit, curves: Sequence[Curve]) -> dict[str, CurveColumns]:
    """Key of each of these curves -> its columns in the rows of a fit;  one : the explanation that has them"""
    where = Where(fitted.model, fitted.values, fitted.rows.postures, fitted.rows.conditions)
    keys, listed = {curve.joint: curve.key for curve in curves}, {}
    for block, number, size in zip(one.blocks, one.weighed.blocks, one.weighed.sizes, strict=True):
        if block.basis is not None and block.columns is not None and (joint := block.basis.joint + 1) in keys:
            columns = block.columns(where) @ found.problems[one.noise].roots[number]
            listed[keys[joint]] = CurveColumns(joint, columns, size)
    return listed


def replications(
    fitted: Fit,
    names: Sequence[str],
    labels: Sequence[str],
    curves: Mapping[str, CurveColumns] = MappingProxyType({}),
) -> tuple[Replication, ...]:
    """Replication of the named effects and of error curves across sessions; empty for a single session.

    fitted : with the named effects, without curves;  names : of the sessions in the order of their numbers
    labels : of the named effects;  curves : by their keys
    """
    rows, model = fitted.rows, fitted.model
    session = rows.conditions.session
    if session is None or np.ptp(session) == 0.0:
        return ()
    jacobian = model.jacobian(rows.postures, fitted.values, rows.conditions) / model.scales
    scaled, target = fitted.values * model.scales, fitted.left[:, :, None]
    effects = [effect for effect in model.effects if effect.label in labels]
    parameters = [tuple(p for p in effect.parameters if p.name in model.names) for effect in effects]
    places = [[model.names.index(p.name) for p in own] for own in parameters]
    there: dict[str, list[InSession]] = {label: [] for label in (*(effect.label for effect in effects), *curves)}
    for number in np.unique(session).astype(int).tolist():
        here = (session == number)[:, None, None]
        count, (left, every, alone, beside) = _white(rows, [target, jacobian, jacobian * here], [*curves.values()])
        for effect, own, at in zip(effects, parameters, places, strict=True):
            units = np.array([p.to_file for p in own]) / model.scales[at]
            response, rest = left[:, 0] + every[:, at] @ scaled[at], np.hstack([np.delete(every, at, axis=1), beside])
            asked = _in_session(names[number], count, response, rest, every[:, at], alone[:, at], units)
            there[effect.label].append(asked)
        for key, curve in curves.items():
            common = _common(rows.postures[:, curve.joint - 1], here)
            tables = [target * common, jacobian * common, curve.columns * common, curve.columns * (common & here)]
            others = [other._replace(columns=other.columns * common) for other in curves.values() if other is not curve]
            count, (left, every, columns, alone, beside) = _white(rows, tables, others)
            count -= rows.dimension * int(np.sum(~common))
            rest = np.hstack([every, beside])
            there[key].append(_in_session(names[number], count, left[:, 0], rest, columns, alone))
    found = [Replication(e.label, own, tuple(there[e.label])) for e, own in zip(effects, parameters, strict=True)]
    return (*found, *(Replication(key, (), tuple(there[key])) for key in curves))


def _white(rows: Rows, tables: Sequence[Array], beside: Sequence[CurveColumns]) -> tuple[int, list[Array]]:
    """Tables (m, d, k), whitened, and curves: as (n, k) that have the same products, with the prior of the curves as
    further rows; and how many rows they have without such a reduction."""
    every = [*tables, np.concatenate([np.zeros((*tables[0].shape[:2], 0)), *(c.columns for c in beside)], axis=2)]
    ends = np.cumsum([table.shape[2] for table in every])
    white = rows.whiten(np.concatenate(every, axis=2))
    precision = [np.full(curve.columns.shape[2], 1.0 / SIZES[curve.size]) for curve in beside]
    prior = np.diag(np.concatenate([np.zeros(ends[-2]), *precision]))[ends[-2] :]
    reduced = np.concatenate([np.linalg.qr(white, mode="r"), prior])
    return len(white) + len(prior), np.split(reduced, ends[:-1], axis=1)


def _common(angles: Array, here: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(m, 1, 1) which angles (m,) are within those both of the rows `here` (m, 1, 1) and of the others."""
    parts = angles[here[:, 0, 0]], angles[~here[:, 0, 0]]
    common = (angles >= max(part.min() for part in parts)) & (angles <= min(part.max() for part in parts))
    return np.asarray(common[:, None, None])


def _in_session(
    name: str, coordinates: int, target: Array, rest: Array, every: Array, alone: Array, units: Array | None = None
) -> InSession:
    """An effect in one session, from whitened tables with a row for each of the coordinates, or any with the same
    products.

    target : (N,) to be explained;  rest : (N, g) of everything else that is fitted
    every : (N, w) of the effect, in all sessions;  alone : (N, w) in this one
    units : (w,) from its parameters to those of files, None: an error curve
    """
    basis = column_space(rest, np.ones(rest.shape[1]))
    freedom = max(coordinates - basis.shape[1], 1)
    if not every.any():  # of a curve, without common angles
        return InSession(name, (), (), 0.25, None)

    def apart(columns: Array) -> Array:
        return np.asarray(columns - basis @ (basis.T @ columns))

    columns, root = apart(every), np.eye(every.shape[1])
    if np.linalg.norm(columns) <= VISIBLE * np.linalg.norm(every):  # nothing that the rest does not have
        return InSession(name, (), (), 0.25, None)
    if units is not None:  # the prior covariance of an effect is the inverse of its information
        root = column_space_of(columns, np.ones(len(root)))[1]
        root = root / np.sqrt(max(root.shape[1], 1))
    both, here = columns @ root, apart(alone) @ root
    blocks, width = np.hstack([here, both - here, both, SAME * here]), root.shape[1]
    starts, signs, limits = np.array([0, 1, 2, 4]) * width, np.zeros(3, dtype=bool), np.full(3, len(SIZES))
    products = Products.of(blocks, apart(target), freedom, starts, signs, limits)
    in_here, in_others, in_both = products.added(products.nothing.without())  # each (sizes,)
    second = [products.added(products.state([(1, size)]).without())[0] for size in range(len(SIZES))]
    double = in_others[:, None] + np.array(second)
    tables = in_both, double, in_others, in_here
    same, own, absent, _ = softmax([logsumexp(table) - np.log(table.size) for table in tables]).tolist()
    answer = True if same >= CREDIBLE else False if own + absent >= CREDIBLE else None
    if units is None:
        return InSession(name, (), (), same, answer)
    elsewhere, inside = np.unravel_index(np.argmax(double), double.shape)
    apiece = products.state([(0, int(inside)), (1, int(elsewhere))])
    mean, covariance = apiece.mean, apiece.covariance * apiece.squares / freedom
    turn = root * units[:, None]
    deviations = np.sqrt(np.diag(turn @ covariance[:width, :width] @ turn.T))
    return InSession(name, tuple((turn @ mean[:width]).tolist()), tuple(deviations.tolist()), same, answer)
