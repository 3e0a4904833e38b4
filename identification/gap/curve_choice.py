"""Which joints get an error curve, and which named effects stay beside them: by the marginal likelihood.

Everything is linear here: the fitted model's Jacobian, the columns of the curves, and the residuals, compressed to as
many rows as there are columns where there are more measurements.
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
from identification.gap.curve_fit import Basis, Evidence, Penalized, bases_of, curve_columns
from identification.gap.f_tests import CHUNK
from identification.gap.fit import Fit
from identification.gap.hypotheses import Hypothesis, unseen_joints
from identification.gap.lagged_products import LaggedProducts
from identification.gap.whitening import Rows
from identification.information import column_lengths
from identification.model import Model

# reasons: identification/README.md, "Constants"
FOLDS = 5  # of the cross-validation
STRETCHES = 10  # of time
SAME = 1e-3  # [rad] angles that differ by less are one posture
NEGLIGIBLE = 1e-10  # of a column's square
HYPERPARAMETERS = 2  # that the data choose for each curve: size and length
Members = tuple[Hypothesis, ...]


@dataclass(frozen=True)
class Explanation:
    """Named effects that stay, and curves at joints (from 0).

    cost : -2 log of the marginal likelihood and of the prior weights;  logs : of the curves' priors, see `Penalized`
    """

    kept: Members
    joints: tuple[int, ...]
    cost: float
    logs: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class System:
    """A fit in which everything named is free, linearized, with the columns of the curves of all joints.

    named : members of the fit;  base_rank : rank of the base model alone
    known : products over stretches of time, where they are known from the same rows with another correlation
    """

    found: Fit
    rows: Rows
    named: Members
    base_rank: int
    known: LaggedProducts | None = None

    @cached_property
    def bases(self) -> tuple[Basis, ...]:
        """Of the joints that move, move the measured point, and have no curve in the arm's file yet."""
        arm = self.found.model.arm
        taken = {spec.joint for spec in arm.effects if spec.curve is not None}
        unseen = unseen_joints(self.found.model, self.rows)
        return bases_of(self.rows.postures, [j for j in range(arm.links) if j + 1 not in {*taken, *unseen}])

    def _columns(self, rows: Rows) -> Array:
        """(N, n) model, curves and residual, whitened as these rows are."""
        at = (rows.postures, self.found.values, rows.conditions)
        position, jacobian = self.found.model.linearize(*at)
        curves = curve_columns(self.bases, rows.postures, self.found.model.joint_levers(*at))
        left = (rows.positions - position)[:, :, None]
        return rows.whiten(np.concatenate([jacobian / self.lengths, curves, left], axis=2))

    def _products(self, fold: NDArray[np.int64]) -> LaggedProducts:
        """Of the columns over the rows of each fold (m,), a few rows at a time."""
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
        return self._products(folds(self.rows.postures)).at(self.rows.correlation)

    @cached_property
    def _in_time(self) -> LaggedProducts:
        """Products over stretches of time."""
        turn = np.empty(len(self.rows), dtype=np.int64)
        turn[self.rows.sequence] = np.arange(len(self.rows))
        return self._products(turn * STRETCHES // len(self.rows))

    @cached_property
    def lengths(self) -> Array:
        """(p,) of the Jacobian's columns."""
        sizes = np.linalg.norm(self.found.triangle, axis=0)
        return column_lengths(sizes, self.found.model.scales)[0]

    @cached_property
    def _compressed(self) -> Array:
        """(min(N, n), n) columns with the same products as all rows have."""
        if len(self.found.residual) <= len(self.lengths) + sum(basis.count for basis in self.bases):
            return self._columns(self.rows)
        products = self._grams if self.known is None else self.known.at(self.rows.correlation)
        values, vectors = np.linalg.eigh(products.sum(axis=0))
        return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T

    def _own(self, members: Sequence[Hypothesis]) -> NDArray[np.bool_]:
        """(p,) which parameters of the model belong to these members."""
        labels = {h.effect.label for h in members}
        owned = {p.name for e in self.found.model.effects if e.label in labels for p in e.parameters}
        return np.array([name in owned for name in self.found.model.names])

    def _model_part(self, kept: Members) -> tuple[NDArray[np.bool_], Array]:
        """(p,) which columns are free, and (p,) what is put back into the residual of those that are not."""
        dropped = self._own([h for h in self.named if h not in kept])
        return ~dropped, np.where(dropped, self.found.values * self.lengths, 0.0)

    def _curve_part(self, joints: Sequence[int]) -> NDArray[np.int64]:
        """Columns of the curves at some joints."""
        ends = len(self.lengths) + np.cumsum([basis.count for basis in self.bases])
        ranges = [np.arange(end - b.count, end) for b, end in zip(self.bases, ends, strict=True) if b.joint in joints]
        return np.concatenate(ranges) if ranges else np.zeros(0, dtype=int)

    def penalized(self, kept: Members, joints: Sequence[int]) -> Penalized:
        """The curves' columns beside what is named."""
        p, columns = len(self.lengths), self._compressed
        free, back = self._model_part(kept)
        left, values, _ = np.linalg.svd(columns[:, :p][:, free], full_matrices=False)
        basis = left[:, values > np.sqrt(NEGLIGIBLE) * values.max(initial=0.0)]
        wanted = np.column_stack([columns[:, self._curve_part(joints)], columns[:, -1] + columns[:, :p] @ back])
        wanted -= basis @ (basis.T @ wanted)
        chosen = tuple(b for b in self.bases if b.joint in joints)
        return Penalized(chosen, wanted[:, :-1], wanted[:, -1], len(self.found.residual) - self.base_rank)

    def explain(self, kept: Members, joints: tuple[int, ...], start: Array | None = None) -> Explanation:
        """The cost of a set of names and curves.

        A named parameter costs log N, as in BIC; so do the two numbers that the data choose for each curve's prior.
        """
        system = self.penalized(kept, joints)
        n, links = len(self.found.residual), self.found.model.joints
        names = sum(h.size * np.log(n) - 2.0 * np.log(h.weight) for h in kept)
        curves = len(joints) * (HYPERPARAMETERS * np.log(n) + np.log(links))  # prior weight n^-1/2 of one joint of n
        if not joints:
            cost = system.freedom * np.log(system.residual @ system.residual / system.freedom)
            return Explanation(kept, joints, float(cost + names))
        logs, found = system.best(start)
        return Explanation(kept, joints, float(found.cost + names + curves), logs)

    def evidence(self, chosen: Explanation) -> Evidence:
        """Coefficients and their covariance at what was chosen."""
        return self.penalized(chosen.kept, chosen.joints).evidence(chosen.logs)

    def model_response(self, chosen: Explanation) -> Array:
        """(free parameters, K) what a unit of each coefficient changes in the other estimates [API units]."""
        p, columns = len(self.lengths), self._compressed
        free, _ = self._model_part(chosen.kept)
        curves = columns[:, self._curve_part(chosen.joints)]
        found = np.linalg.lstsq(columns[:, :p][:, free], curves, rcond=np.sqrt(NEGLIGIBLE))[0]
        return -found / self.lengths[free, None]

    def cross_validated(self, chosen: Explanation) -> float:
        """Sum of squares on postures left out, at the same priors: each fold predicted from the others."""
        return self._left_out(chosen, self._grams, self._grams)

    def left_in_time(self, chosen: Explanation) -> float:
        """Sum of squares on stretches of time left out, each predicted from the others; not decorrelated."""
        products = self.known or self._in_time
        return self._left_out(chosen, products.at(self.rows.correlation), products.at(0.0))

    def _left_out(self, chosen: Explanation, fitted: Array, tested: Array) -> float:
        """Sum of squares that products (folds, n, n) of one kind give, of what those of the other kind estimate."""
        p, total = len(self.lengths), fitted.sum(axis=0)
        free, back = self._model_part(chosen.kept)
        use = np.concatenate([np.flatnonzero(free), self._curve_part(chosen.joints)])
        fixed = np.concatenate([back, np.zeros(len(total) - p - 1), [1.0]])
        penalty = NEGLIGIBLE * np.diag(total)[use]
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
        """The same fit seen with another correlation from row to row."""
        rows = replace(self.rows, correlation=correlation)
        position = self.found.model.position(rows.postures, self.found.values, rows.conditions)
        residual = rows.whiten(rows.positions - position)
        found = replace(self.found, rows=rows, residual=residual)
        known = self.known or (self._in_time if self.rows.correlation else None)
        return replace(self, rows=rows, found=found, known=known)


def folds(postures: Array) -> NDArray[np.int64]:
    """(m,) fold of each row; postures that are the same within `SAME` rad share one."""
    _, group = np.unique(np.round(postures / SAME), axis=0, return_inverse=True)
    order = np.random.default_rng(0).permutation(int(group.max()) + 1)
    return order[group.ravel()] % FOLDS


def choose(system: System, margin: float) -> Explanation:
    """Curves joint by joint as long as each lowers the cost by more than `margin`, then names that are not needed."""
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


def _with_curve(system: System, before: Explanation, joint: int) -> Explanation:
    """A curve at one more joint, in the place of the named functions of that joint's angle."""
    joints = tuple(sorted((*before.joints, joint)))
    kept = tuple(h for h in before.kept if not is_function_of(h.effect, joint, system.found.model))
    start = None
    if before.joints:
        first = system.penalized(kept, (joint,))
        known = dict(zip(before.joints, before.logs.reshape(-1, 2), strict=True))
        start = np.ravel([known.get(j, first.guess[0]) for j in joints])
    return system.explain(kept, joints, start)


def is_function_of(effect: Effect, joint: int, model: Model) -> bool:
    """Whether an effect adds to the angle of a joint (from 0) a function of that angle and of nothing else."""
    if effect.joint != joint + 1 or type(effect).joint_angles is Effect.joint_angles:
        return False
    q, c, _, _ = model.symbols
    angle = ca.SX(effect.joint_angles(model.expressions.chain(q, c), ca.SX.sym("v", len(effect.parameters))))[joint]
    others = ca.vertcat(*(q[k] for k in range(model.joints) if k != joint), c)
    return bool(ca.depends_on(angle, q[joint])) and not bool(ca.depends_on(angle, others))
