"""Bound on the probability that the wrong effect is named: the objective of discriminating plans.

Two effects are distinguished by what the base model and one of them leave of the other. With d the length of that in
standard deviations of the measurement, the likelihood ratio of the two, sizes known, names the wrong one with
probability Phi(-d / 2), and the sum over all rivals (one of them: nothing at all) bounds the probability of any wrong
name. The squared length is a Schur complement, so everything follows from the information matrix M of the plan:

    d^2 = (v - w)^T S (v - w),   S = M_ee - M_eb M_bb^-1 M_be,   w = B (B^T S B)^-1 B^T S v

with b the base parameters, e those of all effects, v a combination of one effect's parameters and B a basis of the
rival's. v is scaled such that a random plan of as many runs shows it with a length of `LAMBDA`: effects much larger are
distinguished by any plan, much smaller ones by none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, groupby
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from doe.criteria import log_determinants
from doe.problem.model import offered
from identification import Array, Model, design_model

if TYPE_CHECKING:
    from doe.problem.model import DesignModel
    from identification import Arm

# length on random postures; any plan tells much larger effects apart, none much smaller ones
LAMBDA = 8.0
# effects with as many parameters: their bases (K, G, s); (D, G) False where a direction belongs to the rival itself;
# (G,) what is added to the diagonal of B^T S B
Rivals = tuple[Array, NDArray[np.bool_], Array]


@dataclass(frozen=True)
class EffectLibrary:
    """Rival effects: what a plan is to distinguish.

    base : p, parameters of the model that is to be identified; they come first in the models below
    shown_by_postures : the model with every effect that postures alone can show, K parameters more
    bases : per effect (K, s), the combinations of the K scaled parameters that it may take
    weights : (H,) how likely each effect is, in any unit
    jacobian_by_order : postures (m, n) in their order -> (m, d, p + L) scaled sensitivities with the effects that the
        order of measurement shows, as backlash and drift; None: there are none
    preflight : postures (m, n) -> what measuring them could show of every effect; None: not needed
    """

    base: int
    shown_by_postures: DesignModel
    bases: Sequence[Array]
    weights: Array
    jacobian_by_order: Callable[[Array], Array] | None = None
    preflight: Callable[[Array], Any] | None = None

    @classmethod
    def of(cls, arm: Arm) -> EffectLibrary:
        """The effects of the library that an arm can have, besides its own; without the rare ones."""
        return cls(*offered(design_model(Model(arm)), "rival_effects", "discriminating")())


@dataclass(frozen=True)
class MisidentificationBound:
    """The bound on the mean probability of a wrong name, of a plan's information matrix. -log of it is maximised.

    No criterion of optimality: it is no concave function of M, so there is no certificate for it.

    base : p, the base model's parameters, which come first
    bases : per effect (K, s), the combinations of the K parameters of effects that it may take
    weights : (H,) how likely each effect is, in any unit
    reference : (p + K, p + K) information per run of random postures
    """

    base: int
    bases: Sequence[Array]
    weights: Array
    reference: Array

    def wrong(self, information: Array) -> Array:
        """(...) bound on the mean probability of a wrong name; infinite where the base model's part is singular."""
        p = self.base
        usable = np.isfinite(log_determinants(information[..., :p, :p]))
        schur = self._off_base(np.where(usable[..., None, None], information, self.reference))[0]
        seen = self.directions @ schur
        lengths = np.sum(seen * self.directions, axis=-1)
        total = np.sum(self._probabilities * ndtr(-0.5 * np.sqrt(np.maximum(lengths, 0.0))), axis=-1)
        for rivals in self._rivals:
            explained = np.sum(np.multiply(*_fit(rivals, schur, seen)), axis=-1)
            d = np.sqrt(np.maximum(lengths[..., None] - explained, 0.0))
            total = total + np.sum(self._probabilities[:, None] * rivals[1] * ndtr(-0.5 * d), axis=(-2, -1))
        return np.where(usable, total, np.inf)

    def gradient(self, information: Array) -> Array:
        """(p + K, p + K) derivative of -log of `wrong`: each pair adds its residual's u u^T (envelope theorem)."""
        schur, base = self._off_base(information)
        rows, probabilities = [self.directions], [self._probabilities]
        for rivals in self._rivals:
            fitted = _fit(rivals, schur, self.directions @ schur)[1]
            beside = self.directions[:, None] - np.einsum("dgs,kgs->dgk", fitted, rivals[0])
            rows.append(beside.reshape(-1, beside.shape[-1]))
            probabilities.append((self._probabilities[:, None] * rivals[1]).ravel())
        u = np.vstack(rows)
        # numerical: the gradient is infinite where two effects are the same, d = 0; the value itself is exact
        d = np.maximum(np.sqrt(np.maximum(np.sum((u @ schur) * u, axis=1), 0.0)), 0.05)
        slopes = np.concatenate(probabilities) * np.exp(-(d**2) / 8.0) / (4.0 * d * np.sqrt(2.0 * np.pi))
        lift = np.vstack([base, np.eye(len(schur))])
        return np.asarray(lift @ ((u * slopes[:, None]).T @ u) @ lift.T / self.wrong(information))

    def _off_base(self, information: Array) -> tuple[Array, Array]:
        """S (..., K, K), and (..., p, K) what the base parameters must do to leave that."""
        p = self.base
        cross = information[..., :p, p:]
        base = -np.linalg.solve(information[..., :p, :p], cross)
        return np.asarray(information[..., p:, p:] + np.swapaxes(cross, -1, -2) @ base), np.asarray(base)

    @cached_property
    def _drawn(self) -> tuple[Array, NDArray[np.intp], Array]:
        """(D, K) directions, (D,) the effect of each and (D,) its probability."""
        schur, whole = self._off_base(self.reference)[0], np.diag(self.reference)[self.base :]
        rows, owners, probabilities = [], [], []
        for number, basis in enumerate(self.bases):
            axes = np.eye(basis.shape[1])  # unit vectors, and along the sum and the difference of every two
            mixes = [*axes, *((a + sign * b) / np.sqrt(2.0) for a, b in combinations(axes, 2) for sign in (1.0, -1.0))]
            lengths = ((v, float(v @ schur @ v)) for v in (basis @ mix for mix in mixes))
            # numerical: no plan is judged by a direction that hardly leaves the base model
            shown = [v * (LAMBDA / np.sqrt(length)) for v, length in lengths if length > 1e-9 * float(v**2 @ whole)]
            rows += shown
            owners += [number] * len(shown)
            probabilities += [float(self.weights[number]) / len(shown) for _ in shown]
        weights = np.array(probabilities)
        return np.array(rows), np.array(owners, dtype=np.intp), weights / weights.sum()

    @property
    def directions(self) -> Array:
        """(D, K) effects, each `LAMBDA` long on random postures, in the scaled parameters."""
        return self._drawn[0]

    @property
    def _probabilities(self) -> Array:
        return self._drawn[2]

    @cached_property
    def _rivals(self) -> tuple[Rivals, ...]:
        """Those with as many parameters together; none that the base model explains on any plan."""
        schur, owners = self._off_base(self.reference)[0], self._drawn[1]

        def size(number: int) -> int:
            return self.bases[number].shape[1]

        groups = []
        for _, numbers in groupby(sorted(np.unique(owners).tolist(), key=size), key=size):
            chosen = list(numbers)
            columns = np.stack([self.bases[number] for number in chosen], axis=1)
            lengths = np.einsum("kgs,kl,lgs->g", columns, schur, columns)
            # numerical: the ridge keeps the inverse of a rival that a plan hides
            groups.append((columns, owners[:, None] != chosen, 1e-12 * np.maximum(lengths, 1e-300)))
        return tuple(groups)


def _fit(rivals: Rivals, schur: Array, seen: Array) -> tuple[Array, Array]:
    """(..., D, G, s) B^T S v, and the parameters of the rivals that come nearest to each direction."""
    columns, _, ridge = rivals
    k, g, s = columns.shape
    flat = columns.reshape(k, g * s)
    shown = (seen @ flat).reshape(*seen.shape[:-1], g, s)
    halves = np.moveaxis((schur @ flat).reshape(*schur.shape[:-1], g, s), -3, -1)  # (..., G, s, K)
    gram = halves @ np.moveaxis(columns, 1, 0) + ridge[:, None, None] * np.eye(s)
    inverse = np.linalg.inv(gram)[..., None, :, :, :]
    return shown, (shown[..., None, :] @ inverse)[..., 0, :]
