"""Test general shapes beside a set of effects, and adjust the p-value of the best for all that were tried."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.gap.fits.fit import Fit
from identification.gap.hypotheses.f_tests import Columns, Dictionary, dictionary
from identification.gap.hypotheses.omnibus_test import leverage_corrected, smallest_drawn, wild_draws
from identification.gap.outside.unmodelled_shapes import PlaceShapes, general_shapes
from identification.gap.selection.search import Choice, HypothesisSearch, bic_change
from identification.information import column_space
from identification.progress import Tell, say_nothing, within

# reasons: identification/README.md, "Constants"
LEVEL = 0.001  # tuned: `unknown` takes names back
LEVEL_FIRST = 0.008  # where nothing is named: Bonferroni's, of which white noise reaches 0.6, the rest of 0.05 in all
BOOTSTRAP_LEVEL = 0.05  # tuned: the wild bootstrap has a veto only
DRAWS = 399  # of the wild bootstrap
SAMPLED = 500  # rows that the draws are made on: correlations of the shapes are then known to 0.04
FRACTION = 0.02  # of a shape's norm that must survive projection: less is nearly in the model


@dataclass
class Survey:
    """Tests of S general shapes beside a set of effects.

    fit : of the set;  listed : (place, shape) of each;  sizes : number of columns of each
    reductions, changes : of the sum of squares and of BIC by each;  p : p-value of each by itself
    counts : place -> number of shapes tried, which determines the prior weights; `changes` and `p` are without them
    tried : for each listed shape that of its place
    """

    fit: Fit
    listed: list[tuple[str, str]] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    reductions: list[float] = field(default_factory=list)
    changes: list[float] = field(default_factory=list)
    p: list[float] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    tried: list[int] = field(default_factory=list)

    def add(self, place: PlaceShapes, columns: Columns, basis: Array, inside: Array, raw: Array) -> None:
        """Test the shapes at one place.

        basis : (N, r) orthonormal, of the fit's Jacobian;  inside : (r, C) its products with the columns
        raw : (C,) products of the columns with the fit's residual
        """
        against, kept = visible(basis, columns, inside=inside)
        explained = basis.T @ self.fit.residual
        reductions = against.reductions_of(against.scores(raw[:, None], explained[:, None]))
        squares = self.fit.squares - float(explained @ explained)
        self.sizes += against.sizes.tolist()
        self.reductions += reductions[:, 0].tolist()
        self.changes += bic_change(reductions[:, 0], against, len(basis), self.fit.squares).tolist()
        self.p += against.p_values(reductions, np.array([squares]))[:, 0].tolist()
        self.listed += [(place.place, place.shapes[k]) for k in kept]
        self.counts[place.place] = len(columns.sizes)
        self.tried += [len(columns.sizes)] * len(kept)

    @property
    def weights(self) -> Array:
        """(S,) prior weights: equal for all places, and divided equally among the shapes of a place."""
        return np.asarray(1.0 / (np.array(self.tried) * len(self.counts)))

    @property
    def bic_changes(self) -> Array:
        """(S,) change of BIC by each shape, with the prior weights."""
        return np.array(self.changes) - 2.0 * np.log(self.weights)

    @property
    def smallest(self) -> float:
        """Smallest ratio of p-value to prior weight."""
        return float(np.min(np.array(self.p) / self.weights))


def visible(
    basis: Array, columns: Columns, weights: Array | None = None, inside: Array | None = None
) -> tuple[Dictionary, NDArray[np.int64]]:
    """Shapes projected off a model, without those that nearly vanish, and the indices of the others.

    basis : (N, r) orthonormal, of the model;  inside : (r, C) its products with the columns, None: computed here
    """
    weights = np.ones(len(columns.sizes)) if weights is None else weights
    full = dictionary(basis, columns, np.zeros(len(weights), dtype=bool), weights, inside)
    kept = np.flatnonzero((full.sizes > 0) & (full.norm_fractions > FRACTION))
    return full.subset(kept), kept


def survey_all(search: HypothesisSearch, sets: list[Choice], tell: Tell = say_nothing) -> list[Survey]:
    """Test the shapes beside each of several sets, the largest first; a `linear` search shares its columns."""
    groups = [sets] if search.linear else [[chosen] for chosen in sets]
    found = []
    for k, group in enumerate(groups, start=1):
        part = f"{k} of {len(groups)}, " if len(groups) > 1 else ""
        found += surveyed(search, group, within(part, tell))
    search.surveys |= {frozenset(h.label for h in chosen): one for chosen, one in zip(sets, found, strict=True)}
    return found


def shapes_beside(search: HypothesisSearch, chosen: Choice) -> Survey:
    """Test the shapes beside one set, or return the cached result."""
    known = search.surveys.get(frozenset(h.label for h in chosen))
    return surveyed(search, [chosen])[0] if known is None else known


def surveyed(search: HypothesisSearch, sets: list[Choice], tell: Tell = say_nothing) -> list[Survey]:
    """Test the shapes beside several sets, of which the first contains all others, with columns and Jacobian at its
    fit."""
    first, found = search.fit(sets[0]), [Survey(search.fit(chosen)) for chosen in sets]
    basis, triangle = np.linalg.qr(first.jacobian)
    turns = [_turn(triangle, first, sets[0], chosen) for chosen in sets]
    bases = [basis @ turn for turn in turns]
    stacked = np.column_stack([basis, *(one.fit.residual for one in found)])
    for place, columns in shape_columns(first):
        tell(place.place.replace(":", " "))
        products = stacked.T @ columns.matrix
        inside, raw = products[: -len(found)], products[-len(found) :]
        for one, model, turn, own in zip(found, bases, turns, raw, strict=True):
            one.add(place, columns, model, turn.T @ inside, own)
    return found


def _turn(triangle: Array, first: Fit, members: Choice, chosen: Choice) -> Array:
    """(p, r) orthonormal basis of the triangle of the first fit's Jacobian without the columns of members that are not
    chosen."""
    left_out = {h.effect.label for h in members} - {h.effect.label for h in chosen}
    own = {p.name for e in first.model.effects if e.label in left_out for p in e.parameters}
    kept = [name not in own for name in first.model.names]
    return column_space(triangle[:, kept], first.model.scales[kept])


def shape_columns(at: Fit) -> Iterator[tuple[PlaceShapes, Columns]]:
    """The shapes at a fit with their whitened columns, one place at a time, without shapes of too many columns."""
    for place in general_shapes(at, at.rows):
        few = place.sizes < at.freedom - 1
        if few.any():
            shown = place.columns if few.all() else place.columns[:, :, np.repeat(few, place.sizes)]
            columns = at.rows.whiten(shown)
            shapes = tuple(compress(place.shapes, few))
            yield replace(place, shapes=shapes, sizes=place.sizes[few]), Columns(columns, place.sizes[few])


def adjusted(shapes: Survey, level: float, generator: np.random.Generator) -> float:
    """p-value of the best shape for a test at `level`: Bonferroni's under white Gaussian noise (the weights sum to 1),
    or the scaled one of the wild bootstrap if that is larger.

    The wild bootstrap alone has no power against a shape that acts at a few postures only (their signs often agree);
    Gaussian noise alone mistakes heteroscedastic noise for waves. The bootstrap is therefore applied at the weaker
    `BOOTSTRAP_LEVEL`, and to `SAMPLED` rows: the null distribution of the smallest p-value depends on the correlations
    of the shapes, not on the number of rows.
    """
    if shapes.smallest > level:
        return min(shapes.smallest, 1.0)
    dimension, basis = shapes.fit.rows.dimension, shapes.fit.basis
    rows = np.sort(generator.permutation(len(shapes.fit.rows))[:SAMPLED])
    corrected = leverage_corrected(shapes.fit.residual, basis, dimension)[rows]
    found, state = np.full(DRAWS, np.inf), generator.bit_generator.state
    for against in against_at(shapes.fit, basis, (rows[:, None] * dimension + np.arange(dimension)).ravel()):
        generator.bit_generator.state = state  # the same signs for each place
        found = np.minimum(found, smallest_drawn(against, wild_draws(corrected, against, DRAWS, generator)))
    scatter = (1.0 + np.sum(found * len(shapes.counts) <= shapes.smallest)) / (1.0 + DRAWS)
    return float(max(shapes.smallest, scatter * level / BOOTSTRAP_LEVEL))


def against_at(fit: Fit, basis: Array, index: NDArray[np.int64]) -> Iterator[Dictionary]:
    """The shapes at some coordinates, one place at a time, projected off a model with this basis (N, r) over all
    coordinates; their weights are those within the place."""
    some = np.asarray(np.linalg.qr(basis[index])[0])
    for _, c in shape_columns(fit):
        yield visible(some, Columns(c.matrix[index], c.sizes), np.full(len(c.sizes), 1.0 / len(c.sizes)))[0]
