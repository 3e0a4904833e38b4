"""`HypothesisSearch`: fits and tests of sets of effects on the same rows, each computed once and cached."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.gap.fits.fit import Fit, fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.f_tests import Columns, Dictionary
from identification.gap.hypotheses.hypotheses import Hypothesis, HypothesisSet, Slopes
from identification.gap.hypotheses.omnibus_test import OmnibusTest, Scatter, omnibus_test
from identification.gap.noise.noise import homoscedastic
from identification.gap.selection.order_range import order_of
from identification.information import RANK_TOLERANCE

# reasons: identification/README.md, "Constants"
LEVEL_FACTOR = 0.5  # tuned: factor on the levels where the noise model was estimated from the same data
SAME_COLUMNS = 250  # effort: rows from which all columns are those at the base fit
TIES = 6  # decimals of a BIC: rounding must not choose between effects that are the same in other words
WAVES = 3  # of one joint: encoder, its second harmonic, a gear; more are the series of an unknown function
INDEPENDENT = 1e-4  # smallest eigenvalue from which products of unit columns alone give a basis to twelve digits
Choice = tuple[Hypothesis, ...]


def series_joints(chosen: Choice) -> set[int | None]:
    """Joints with `WAVES` named waves: further waves would be terms in the Fourier series of some other function."""
    joints = [h.spec.joint for h in chosen if order_of(h.effect) is not None]
    return {joint for joint in joints if joints.count(joint) >= WAVES}


@dataclass(frozen=True)
class State:
    """A set of effects and the hypotheses that can be added to it.

    residual : (N,) whitened, of the set;  members : hypotheses that can be added;  against : their projected columns
    products : (C,) products of all columns with the residual, None: not computed yet
    """

    residual: Array
    members: list[Hypothesis]
    against: Dictionary
    products: Array | None = None

    @cached_property
    def squares(self) -> float:
        """Sum of squared residuals."""
        return float(self.residual @ self.residual)

    @cached_property
    def reductions(self) -> Array:
        """(H,) reduction of the sum of squares by each hypothesis in the linearized fit."""
        if self.products is None:
            return self.against.reductions(self.residual[:, None])[:, 0]
        outside = np.zeros((self.against.model_basis.shape[1], 1))  # the residual is orthogonal to the model
        return self.against.reductions_of(self.against.scores(self.products[:, None], outside))[:, 0]

    @cached_property
    def change(self) -> Array:
        """(H,) change of BIC with each hypothesis added, in the linearized fit."""
        return bic_change(self.reductions, self.against, len(self.residual), self.squares)

    @property
    def strongest(self) -> Hypothesis:
        """The hypothesis with the smallest ratio of p-value to prior weight."""
        p = self.against.p_values(self.reductions[:, None], np.array([self.squares]))[:, 0]
        return self.members[int(np.argmin(p / self.against.weights))]


def _turn(gram: Array, own: Array, projected: Callable[[], Array]) -> Array:
    """(k, r) combinations of k columns, projected off a basis, that are orthonormal.

    gram : (k, k) products of the columns;  own : products of the basis with them;  projected : the columns themselves
    """
    lengths = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh((gram - own.T @ own) / np.outer(lengths, lengths))
    if values.min(initial=1.0) <= INDEPENDENT:  # these products hold half the digits
        singular, rows = np.linalg.svd(projected() / lengths, full_matrices=False)[1:]
        seen = singular > RANK_TOLERANCE
        values, vectors = singular[seen] ** 2, rows[seen].T
    return np.asarray(vectors / np.sqrt(values) / lengths[:, None])


def bic_change(reductions: Array, against: Dictionary, n: int, squares: float) -> Array:
    """(H,) change of BIC with each hypothesis added.

    reductions : (H,) of the sum of squares in the linearized fit;  n : number of coordinates;  squares : without any
    """
    left = np.maximum(1.0 - reductions / squares, 1e-12)
    return np.round(n * np.log(left) + against.sizes * np.log(n) - 2.0 * np.log(against.weights), TIES)


@dataclass(frozen=True)
class HypothesisTest:
    """Omnibus test of all H hypotheses that can be added to a set;  change : (H,) of BIC in the linearized fit."""

    members: list[Hypothesis]
    omnibus_test: OmnibusTest
    change: Array


@dataclass
class HypothesisSearch:
    """Fits and tests of sets of effects on the same rows, cached by the labels of the effects.

    noise_estimated : the noise model of the rows was estimated from the same data, so that all levels are multiplied
        by `LEVEL_FACTOR`
    """

    hypotheses: HypothesisSet
    rows: Rows
    noise_estimated: bool = False
    fits: dict[frozenset[str], Fit] = field(default_factory=dict)
    tests: dict[frozenset[str], HypothesisTest] = field(default_factory=dict)
    surveys: dict[frozenset[str], Any] = field(default_factory=dict)  # of `unmodelled_survey`, for whoever asks again
    _crosses: dict[str, Array] = field(default_factory=dict)
    _products: dict[frozenset[str], Array] = field(default_factory=dict)
    _changes: dict[frozenset[str], Array] = field(default_factory=dict)

    @property
    def linear(self) -> bool:
        """True if all columns are taken at the base fit: with many rows, and in space, where setting up a model takes
        longer than its fit."""
        return len(self.rows) >= SAME_COLUMNS or self.rows.dimension != 2

    @cached_property
    def slopes(self) -> Slopes:
        """The part of all columns that does not depend on a fit, see `HypothesisSet.slopes`."""
        return self.hypotheses.slopes(self.rows)

    @property
    def level_factor(self) -> float:
        """Factor on all levels of significance."""
        return LEVEL_FACTOR if self.noise_estimated else 1.0

    def fit(self, chosen: Choice) -> Fit:
        """The base model with these effects added, refitted."""
        key = frozenset(h.label for h in chosen)
        if key not in self.fits:
            model = self.hypotheses.model(chosen)
            start = model.parameters.mapping(model.values) | self.fit(()).by_name if chosen else None
            ties = [[p.name for p in h.effect.parameters] for h in chosen if h.tied]
            self.fits[key] = fit(model, self.rows, start, ties)
        return self.fits[key]

    def bic(self, chosen: Choice) -> float:
        """BIC of a set; with a family, the lower BIC of free and of equal parameters."""
        forms = [self._bic(chosen)]
        equal = {h.key: h for h in self.hypotheses.members if h.tied}
        if any(h.key in equal and not h.tied for h in chosen):
            forms.append(self._bic(tuple(equal.get(h.key, h) for h in chosen)))
        return round(min(forms), TIES)

    def _bic(self, chosen: Choice) -> float:
        """N log(RSS / N) + p log N - 2 log(prior weight), which includes the cost of scanning a setting."""
        found = self.fit(chosen)
        n = len(found.residual)
        prior = -2.0 * sum(np.log(h.weight) for h in chosen)
        return float(n * np.log(max(found.squares, 1e-300) / n) + found.count * np.log(n) + prior)

    def tested(self, chosen: Choice, draws: int, generator: np.random.Generator) -> HypothesisTest:
        """Omnibus test, and change of BIC, of every hypothesis that can be added to a set."""
        key = frozenset(h.label for h in chosen)
        if key not in self.tests:
            state = self.state(chosen)
            scatter = self.scatter(chosen, state, generator)
            result = omnibus_test(state.residual, state.against, self.rows.dimension, draws, generator, scatter)
            self.tests[key] = HypothesisTest(state.members, result, state.change)
        return self.tests[key]

    def scatter(self, chosen: Choice, state: State, generator: np.random.Generator) -> Scatter | None:
        """Residual and basis of the fit with the strongest hypothesis added, if that noise is homoscedastic; else None.

        A missing effect makes the residuals larger where it is strong, and a bootstrap of these residuals attributes
        that to chance. Where the noise itself may be larger at some postures, the bootstrap is right to do so.
        """
        if self.noise_estimated or not state.members:
            return None
        best = self.fit((*chosen, state.strongest))
        return (best.residual, best.basis) if homoscedastic(best, self.rows, generator) else None

    def state(self, chosen: Choice) -> State:
        """Residual of a set of effects, and the hypotheses that can be added to it.

        All columns are those at the fit of the set; if the search is `linear`, those at the base fit, but for members
        that some effect of the set changes, or that show through it only (`HypothesisSet.changing`).
        """
        found = self.fit(chosen)
        if self.linear:
            return self.linear_state(chosen, found.residual, self.moments(chosen), self._changed(chosen))
        matrix = self.hypotheses.matrix
        columns = matrix(self.rows, found.by_name, self.slopes, found.model) if chosen else self.base_columns
        return self._state(chosen, found.residual, found.basis, columns)

    def state_without(self, chosen: Choice, member: Hypothesis) -> State:
        """`state` of a set less one member; in a `linear` search without a fit of its own, unless the member changes
        columns of others."""
        rest = tuple(h for h in chosen if h is not member)
        known = frozenset(h.label for h in rest) in self.fits
        if not self.linear or known or self.hypotheses.shows_more((member,)):
            return self.state(rest)
        found = self.fit(chosen)
        effect = next(e for e in found.model.effects if e.label == member.label)
        values = np.array([found.by_name[p.name] for p in effect.parameters])
        put_back = self.base_columns.matrix[:, self._places(member)] @ values
        moments = self.moments(chosen) + values @ self._cross(member)
        return self.linear_state(rest, found.residual + put_back, moments, self._changed(chosen))

    def _changed(self, chosen: Choice) -> Array | None:
        """`HypothesisSet.changed_columns` at the fit of a set, None where they are those at the base fit."""
        if not self.hypotheses.shows_more(chosen):
            return None
        key = frozenset(h.label for h in chosen)
        if key not in self._changes:
            self._changes[key] = self.hypotheses.changed_columns(self.rows, self.fit(chosen))
        return self._changes[key]

    @cached_property
    def repeated(self) -> int:
        """Number of coordinates measured at postures that had been measured before."""
        distinct = len(np.unique(np.round(self.rows.postures, 9), axis=0))
        return self.rows.dimension * (len(self.rows) - distinct)

    def linear_bic_without(self, chosen: Choice, member: Hypothesis) -> float:
        """BIC of a set less one member in the linearized model, up to a constant common to all members."""
        state = self.state_without(chosen, member)
        n = len(state.residual)
        return float(n * np.log(state.squares / n) - member.size * np.log(n) + 2.0 * np.log(member.weight))

    def rivals(self, chosen: Choice) -> tuple[list[Hypothesis], Dictionary]:
        """Hypotheses that can be added to a set, and their columns projected off its fit."""
        state = self.state(chosen)
        return state.members, state.against

    @cached_property
    def base_columns(self) -> Columns:
        """Columns of all hypotheses at the base fit."""
        return self.hypotheses.matrix(self.rows, self.fit(()).by_name, self.slopes, self.fit(()).model)

    def _places(self, member: Hypothesis) -> NDArray[np.int64]:
        """(size,) indices of the columns of a hypothesis."""
        k = self.hypotheses.place(member)
        return np.asarray(self.base_columns.starts[k] + np.arange(self.base_columns.sizes[k]))

    @cached_property
    def _base_space(self) -> tuple[Array, Array]:
        """(N, r) orthonormal basis of the Jacobian of the base fit, and its products (r, C) with all columns."""
        basis = self.fit(()).basis
        return basis, np.asarray(basis.T @ self.base_columns.matrix)

    def _cross(self, member: Hypothesis) -> Array:
        """(size, C) products of the columns of a hypothesis with all columns."""
        if member.label not in self._crosses:  # a family and its members tied together have other columns
            matrix = self.base_columns.matrix
            self._crosses[member.label] = matrix[:, self._places(member)].T @ matrix
        return self._crosses[member.label]

    def moments(self, chosen: Choice) -> Array:
        """(C,) products of all columns with the residual of the fit of a set."""
        key = frozenset(h.label for h in chosen)
        if key not in self._products:
            self._products[key] = self.base_columns.matrix.T @ self.fit(chosen).residual
        return self._products[key]

    def linear_state(self, chosen: Choice, residual: Array, moments: Array, changed: Array | None = None) -> State:
        """`state` with the columns at the base fit.

        residual : (N,) of the set, not yet projected off its columns;  moments : (C,) products of all columns with it
        changed : (N, r) columns in place of those of the members `HypothesisSet.changing`, None: those at the base fit
        """
        (known, within), columns = self._base_space, self.base_columns
        places = np.concatenate([np.zeros(0, dtype=np.int64), *(self._places(h) for h in chosen)])
        cross = np.concatenate([np.zeros((0, columns.matrix.shape[1])), *(self._cross(h) for h in chosen)])
        if changed is not None:
            at = np.concatenate([self._places(self.hypotheses.members[k]) for k in self.hypotheses.changing])
            columns, within, moments = columns.changed(at, changed), within.copy(), moments.copy()
            within[:, at], moments[at] = known.T @ changed, changed.T @ residual
            other, own = np.isin(places, at), columns.matrix[:, places]
            cross[:, at], cross[other] = own.T @ changed, own[:, other].T @ columns.matrix
        matrix = columns.matrix
        own = within[:, places]
        turn = _turn(cross[:, places], own, lambda: matrix[:, places] - known @ own)
        basis = np.hstack([known, matrix[:, places] @ turn - known @ (own @ turn)])
        inside = np.concatenate([within, turn.T @ (cross - own.T @ within)])
        explained = basis.T @ residual
        return self._state(chosen, residual - basis @ explained, basis, columns, inside, moments - explained @ inside)

    def _state(
        self,
        chosen: Choice,
        residual: Array,
        basis: Array,
        columns: Columns,
        inside: Array | None = None,
        moments: Array | None = None,
    ) -> State:
        members = self.hypotheses.members
        full = self.hypotheses.projected(basis, columns, inside)
        freedom = len(residual) - basis.shape[1]
        usable = (full.sizes > 0) & (self.hypotheses.sizes < freedom)  # others are not estimable
        usable[self.hypotheses.places_of(chosen)] = False
        for joint in series_joints(chosen):
            usable[self._waves == joint] = False
        keep = np.flatnonzero(usable)
        return State(residual, [members[k] for k in keep], full.subset(keep), moments)

    @cached_property
    def _waves(self) -> NDArray[np.int64]:
        """(H,) joint (from 1) of the members that are waves of its angle, 0 for all others."""
        waves = (h.spec.joint if order_of(h.effect) is not None else 0 for h in self.hypotheses.members)
        return np.array([joint or 0 for joint in waves])
