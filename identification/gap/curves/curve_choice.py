"""Choose the joints with an error curve, and the named effects kept beside them, by the marginal likelihood.

All computations use the Jacobian of the fitted model, the columns of the curves, and the residuals. With more
coordinates than columns these are compressed to as many rows as columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.effects import Effect
from identification.gap.curves.curve_fit import Basis, Evidence, Penalized, bases_of, curve_columns
from identification.gap.curves.lagged_products import LaggedProducts
from identification.gap.fits.fit import Fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.f_tests import CHUNK
from identification.gap.hypotheses.hypotheses import Hypothesis, untested_joints
from identification.information import column_lengths
from identification.model import Model

# reasons: identification/README.md, "Constants"
FOLDS = 5  # of the cross-validation
STRETCHES = 10  # of time
NEGLIGIBLE = 1e-10  # of a column's square
HYPERPARAMETERS = 2  # that the data choose for each curve: size and length
Members = tuple[Hypothesis, ...]


@dataclass(frozen=True)
class CurveChoice:
    """Named effects that are kept, and joints (from 0) with an error curve.

    cost : -2 log(marginal likelihood times prior weight);  logs : log size and length of each curve, see `Penalized`
    """

    kept: Members
    joints: tuple[int, ...]
    cost: float
    logs: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class System:
    """A linearized fit with all named effects free, and the columns of error curves at all joints.

    named : effects in the fit;  base_rank : rank of the base model alone
    known : products over intervals of time, if known from the same rows with another correlation
    """

    found: Fit
    rows: Rows
    named: Members
    base_rank: int
    known: LaggedProducts | None = None

    @cached_property
    def bases(self) -> tuple[Basis, ...]:
        """Bases of the joints that can have a curve: they move, move the measured point, and have none in the file."""
        arm = self.found.model.arm
        taken = {spec.joint for spec in arm.effects if spec.curve is not None}
        unseen = untested_joints(self.found.model, self.rows)
        return bases_of(self.rows.postures, [j for j in range(arm.links) if j + 1 not in {*taken, *unseen}])

    def _columns(self, rows: Rows) -> Array:
        """(N, n) columns of the model, of the curves, and the residual, whitened."""
        at = (rows.postures, self.found.values, rows.conditions)
        position, jacobian = self.found.model.linearize(*at)
        curves = curve_columns(self.bases, rows.postures, self.found.model.joint_levers(*at))
        left = (rows.positions - position)[:, :, None]
        return rows.whiten(np.concatenate([jacobian / self.lengths, curves, left], axis=2))

    def _products(self, fold: NDArray[np.int64]) -> LaggedProducts:
        """Products of the columns over the rows of each fold (m,), computed in parts."""
        rows, d = replace(self.rows, correlation=0.0), self.rows.dimension
        count, n = int(fold.max()) + 1, len(self.lengths) + sum(basis.count for basis in self.bases) + 1
        found = LaggedProducts(*np.zeros((4 if self.rows.correlation else 2, count, n, n)))
        sequence, step = self.rows.sequence, max(CHUNK // n // d, 1)
        before = np.zeros((0, n))
        for k in range(0, len(sequence), step):
            part = sequence[k : k + step]
            columns = np.concatenate([before, self._columns(rows.pick(part))])
            found.add(columns, np.repeat(fold[part], d), d)
            before = columns[-d:]
        return found

    @cached_property
    def _grams(self) -> Array:
        """(FOLDS, n, n) products over the rows of each fold of postures."""
        return self._products(folds(self.rows.posture_numbers)).at(self.rows.correlation)

    @cached_property
    def _in_time(self) -> LaggedProducts:
        """Products over intervals of time."""
        turn = np.empty(len(self.rows), dtype=np.int64)
        turn[self.rows.sequence] = np.arange(len(self.rows))
        return self._products(turn * STRETCHES // len(self.rows))

    @cached_property
    def lengths(self) -> Array:
        """(p,) lengths of the Jacobian's columns."""
        sizes = np.linalg.norm(self.found.triangle, axis=0)
        return column_lengths(sizes, self.found.model.scales)[0]

    @cached_property
    def _compressed(self) -> Array:
        """(min(N, n), n) matrix with the same Gram matrix as the columns over all rows."""
        if len(self.found.residual) <= len(self.lengths) + sum(basis.count for basis in self.bases):
            return self._columns(self.rows)
        products = self._grams if self.known is None else self.known.at(self.rows.correlation)
        values, vectors = np.linalg.eigh(products.sum(axis=0))
        return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T

    def _own(self, members: Sequence[Hypothesis]) -> NDArray[np.bool_]:
        """(p,) True for the parameters of these effects."""
        labels = {h.effect.label for h in members}
        owned = {p.name for e in self.found.model.effects if e.label in labels for p in e.parameters}
        return np.array([name in owned for name in self.found.model.names])

    def _model_part(self, kept: Members) -> tuple[NDArray[np.bool_], Array]:
        """(p,) True for the free columns, and (p,) coefficients to restore to the residual for the others."""
        dropped = self._own([h for h in self.named if h not in kept])
        return ~dropped, np.where(dropped, self.found.values * self.lengths, 0.0)

    def _curve_part(self, joints: Sequence[int]) -> NDArray[np.int64]:
        """Indices of the columns of the curves at these joints (from 0)."""
        ends = len(self.lengths) + np.cumsum([basis.count for basis in self.bases])
        ranges = [np.arange(end - b.count, end) for b, end in zip(self.bases, ends, strict=True) if b.joint in joints]
        return np.concatenate(ranges) if ranges else np.zeros(0, dtype=int)

    def penalized(self, kept: Members, joints: Sequence[int]) -> Penalized:
        """The columns of the curves and the residual, projected off the model with the kept effects."""
        p, columns = len(self.lengths), self._compressed
        free, back = self._model_part(kept)
        left, values, _ = np.linalg.svd(columns[:, :p][:, free], full_matrices=False)
        basis = left[:, values > np.sqrt(NEGLIGIBLE) * values.max(initial=0.0)]
        wanted = np.column_stack([columns[:, self._curve_part(joints)], columns[:, -1] + columns[:, :p] @ back])
        wanted -= basis @ (basis.T @ wanted)
        chosen = tuple(b for b in self.bases if b.joint in joints)
        return Penalized(chosen, wanted[:, :-1], wanted[:, -1], len(self.found.residual) - self.base_rank)

    def explain(self, kept: Members, joints: tuple[int, ...], start: Array | None = None) -> CurveChoice:
        """The cost of a set of named effects and curves.

        Each parameter of a named effect costs log N, as in BIC, and so do the two hyperparameters of each curve.

        start : log sizes and lengths to start the search from
        """
        system = self.penalized(kept, joints)
        n, links = len(self.found.residual), self.found.model.joints
        names = sum(h.size * np.log(n) - 2.0 * np.log(h.weight) for h in kept)
        curves = len(joints) * (HYPERPARAMETERS * np.log(n) + np.log(links))  # prior weight n^-1/2 of one joint of n
        if not joints:
            cost = system.freedom * np.log(system.residual @ system.residual / system.freedom)
            return CurveChoice(kept, joints, float(cost + names))
        logs, found = system.best(start)
        return CurveChoice(kept, joints, float(found.cost + names + curves), logs)

    def evidence(self, chosen: CurveChoice) -> Evidence:
        """Coefficients of the chosen curves with their covariance."""
        return self.penalized(chosen.kept, chosen.joints).evidence(chosen.logs)

    def model_response(self, chosen: CurveChoice) -> Array:
        """(free parameters, K) derivative of the other estimates with respect to each coefficient [API units]."""
        p, columns = len(self.lengths), self._compressed
        free, _ = self._model_part(chosen.kept)
        curves = columns[:, self._curve_part(chosen.joints)]
        found = np.linalg.lstsq(columns[:, :p][:, free], curves, rcond=np.sqrt(NEGLIGIBLE))[0]
        return -found / self.lengths[free, None]

    def cross_validated(self, chosen: CurveChoice) -> float:
        """Sum of squares at postures left out: each fold is predicted from the others, with the same priors."""
        return self._left_out(chosen, self._grams, self._grams)

    def left_in_time(self, chosen: CurveChoice) -> float:
        """Sum of squares, not decorrelated, in intervals of time left out, each predicted from the others."""
        products = self.known or self._in_time
        return self._left_out(chosen, products.at(self.rows.correlation), products.at(0.0))

    def _left_out(self, chosen: CurveChoice, fitted: Array, tested: Array) -> float:
        """Sum of squares over all folds, each predicted from the others.

        fitted, tested : (folds, n, n) products used for the estimates, and for the sum of squares
        """
        p, total = len(self.lengths), fitted.sum(axis=0)
        free, back = self._model_part(chosen.kept)
        use = np.concatenate([np.flatnonzero(free), self._curve_part(chosen.joints)])
        fixed = np.concatenate([back, np.zeros(len(total) - p - 1), [1.0]])
        own = np.diag(total)[use]
        penalty = np.where(own > 0.0, NEGLIGIBLE * own, 1.0)  # what moves nothing stays where it is
        if chosen.joints:
            bases = [b for b in self.bases if b.joint in chosen.joints]
            pairs = zip(bases, np.exp(chosen.logs.reshape(-1, 2)), strict=True)
            penalty[free.sum() :] += 1.0 / np.concatenate([basis.variances(*pair)[0] for basis, pair in pairs])
        error = 0.0
        for fold, test in zip(fitted, tested, strict=True):
            rest, solved = total - fold, fixed.copy()
            solved[use] -= np.linalg.solve(rest[np.ix_(use, use)] + np.diag(penalty), rest[use] @ fixed)
            error += float(solved @ test @ solved)
        return error

    def with_correlation(self, correlation: float) -> System:
        """The same fit with another serial correlation of the noise."""
        rows = replace(self.rows, correlation=correlation)
        position = self.found.model.position(rows.postures, self.found.values, rows.conditions)
        residual = rows.whiten(rows.positions - position)
        found = replace(self.found, rows=rows, residual=residual)
        known = self.known or (self._in_time if self.rows.correlation else None)
        return replace(self, rows=rows, found=found, known=known)


def folds(postures: NDArray[np.int64]) -> NDArray[np.int64]:
    """(m,) fold of each row; postures : (m,) number of each row's posture, from 0, whose rows are in the same fold."""
    return np.random.default_rng(0).permutation(int(postures.max()) + 1)[postures] % FOLDS


def choose_curves(system: System, margin: float) -> CurveChoice:
    """Add curves one by one while the cost decreases by more than `margin`, then remove effects not needed."""
    best = system.explain(system.named, ())
    while left := [b.joint for b in system.bases if b.joint not in best.joints]:
        trials = [_with_curve(system, best, j) for j in left]
        trial = min(trials, key=lambda e: e.cost)
        if trial.cost >= best.cost - margin:
            break
        best = trial
    while best.joints and best.kept:
        shorter = [tuple(h for h in best.kept if h is not one) for one in best.kept]
        trial = min((system.explain(kept, best.joints, best.logs) for kept in shorter), key=lambda e: e.cost)
        if trial.cost >= best.cost:
            break
        best = trial
    return best


def _with_curve(system: System, before: CurveChoice, joint: int) -> CurveChoice:
    """Add a curve at one more joint (from 0); it replaces named effects that are functions of that joint's angle."""
    joints = tuple(sorted((*before.joints, joint)))
    kept = tuple(h for h in before.kept if not is_function_of(h.effect, joint, system.found.model))
    start = None
    if before.joints:
        first = system.penalized(kept, (joint,))
        known = dict(zip(before.joints, before.logs.reshape(-1, 2), strict=True))
        start = np.ravel([known.get(j, first.guess[0]) for j in joints])
    return system.explain(kept, joints, start)


def is_function_of(effect: Effect, joint: int, model: Model) -> bool:
    """Whether an effect adds to the angle of a joint (from 0) a function of that angle alone."""
    if effect.joint != joint + 1 or type(effect).joint_angles is Effect.joint_angles:
        return False
    q, c, _, _ = model.symbols
    angle = ca.SX(effect.joint_angles(model.expressions.chain(q, c), ca.SX.sym("v", len(effect.parameters))))[joint]
    others = ca.vertcat(*(q[k] for k in range(model.joints) if k != joint), c)
    return bool(ca.depends_on(angle, q[joint])) and not bool(ca.depends_on(angle, others))
