"""Cross-validate the choice of effects: repeat it without a part of the rows and predict that part.

Residuals of rows that were used to choose an effect are optimistic, and without a fifth of them another effect may be
chosen. `cross_validation` keeps the chosen effects and refits their parameters; here the choice itself is repeated:
as many effects as were named, one at a time by BIC, in the model linearized about the base fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.f_tests import Columns
from identification.gap.hypotheses.hypotheses import projected
from identification.gap.probability.probabilities import Probabilities
from identification.gap.selection.search import Choice, HypothesisSearch, bic_change
from identification.gap.workflow import Findings
from identification.information import column_space
from identification.measurements import POINT, Conditions, Measurements, distances

# reasons: identification/README.md, "Constants"
FOLDS = 5
MOST_ROWS = 500  # effort: of more, a fifth left out hardly changes a choice


@dataclass(frozen=True)
class ChoiceValidation:
    """Result of the cross-validation.

    again : fraction of the folds in which one of the candidates is chosen again, with its settings
    excess : mean square distance [mm^2] of the rows left out, beyond what the named model predicts; >= 0
    """

    again: float
    excess: float


class _Fold(NamedTuple):
    """One part of the rows, k of them, left out.

    labels : effects chosen without it;  squares : (k,) squared distances of its rows [mm^2]
    expected : (k,) the part of them due to the uncertainty of the parameters [mm^2]
    """

    labels: frozenset[str]
    squares: Array
    expected: Array


def validate_choice(
    found: Findings, measurements: Measurements, generator: np.random.Generator
) -> ChoiceValidation | None:
    """Cross-validate the choice; None where nothing was chosen, with fewer than `2 FOLDS` postures or over `MOST_ROWS`
    rows."""
    chosen = found.unknown.chosen
    rows = Rows.of(measurements).pick(~found.outlier)
    if not chosen or len(rows) > MOST_ROWS or len(np.unique(rows.posture_numbers)) < 2 * FOLDS:
        return None
    search = HypothesisSearch(found.search.hypotheses, rows)
    folds = list(_folds(search, len(chosen), generator))
    rivals = {frozenset(h.label for h in rival) for rival, _ in found.selection.rivals}
    rivals.add(frozenset(h.label for h in chosen))
    named = search.fit(chosen)
    left, expected = (np.concatenate([getattr(fold, name) for fold in folds]) for name in ("squares", "expected"))
    own = float(np.sum(named.residual.reshape(len(rows), -1)[:, POINT] ** 2)) * rows.dimension / max(named.freedom, 1)
    again = float(np.mean([fold.labels in rivals for fold in folds]))
    return ChoiceValidation(again, max(0.0, float(np.mean(left - expected)) - own))


def _folds(search: HypothesisSearch, size: int, generator: np.random.Generator) -> Iterator[_Fold]:
    postures = search.rows.posture_numbers
    parts = generator.permutation(np.arange(postures.max() + 1) % FOLDS)[postures]
    base = search.fit(())
    jacobian = base.jacobian
    for part in range(FOLDS):
        out = np.repeat(parts == part, search.rows.dimension)
        yield _without(search, jacobian, base.residual, out, size)


def _without(search: HypothesisSearch, jacobian: Array, residual: Array, out: NDArray[np.bool_], size: int) -> _Fold:
    """Choose `size` effects without the coordinates in `out` (N,), and predict those."""
    columns, members = search.base_columns, search.hypotheses.members
    kept = Columns(columns.matrix[~out], columns.sizes)
    chosen: Choice = ()
    model, scales = jacobian, search.fit(()).model.scales
    for _ in range(size):
        basis = column_space(model[~out], scales)
        left = residual[~out] - basis @ (basis.T @ residual[~out])
        against = projected(basis, members, kept)
        taken = {c.label for c in chosen}
        free = [not h.tied and h.label not in taken for h in members]
        usable = np.flatnonzero((against.sizes > 0) & np.array(free, dtype=bool))
        against = against.subset(usable)
        change = bic_change(against.reductions(left[:, None])[:, 0], against, len(left), float(left @ left))
        k = int(usable[np.argmin(change)])
        chosen = (*chosen, members[k])
        model = np.hstack([model, columns.matrix[:, columns.starts[k] : columns.starts[k] + columns.sizes[k]]])
        scales = np.concatenate([scales, [p.scale for p in members[k].effect.parameters]])
    return _Fold(frozenset(h.label for h in chosen), *_predicted(model, residual, out, search.rows.dimension))


def _predicted(model: Array, residual: Array, out: NDArray[np.bool_], d: int) -> tuple[Array, Array]:
    """(k,) squared distances of the rows left out [mm^2], and the part due to the uncertainty of the parameters."""
    lengths = np.linalg.norm(model[~out], axis=0)
    unit = model / np.where(lengths > 0.0, lengths, 1.0)
    inverse = np.linalg.pinv(unit[~out], rcond=1e-9)
    error = residual[out] - unit[out] @ (inverse @ residual[~out])
    left = residual[~out] - unit[~out] @ (inverse @ residual[~out])
    noise = float(left @ left) / max(len(left) - np.linalg.matrix_rank(inverse), 1)
    spread = noise * np.square(unit[out] @ inverse).sum(axis=1)
    return np.square(error).reshape(-1, d)[:, POINT].sum(axis=1), spread.reshape(-1, d)[:, POINT].sum(axis=1)


def disagreement(found: Findings, likely: Probabilities, rows: Measurements, there: Conditions) -> float:
    """Mean square distance [mm^2] between the named model and its alternatives in other rows.

    The alternatives are the candidates and the base model, weighted by their probabilities.
    """
    search, chosen = found.fits, found.unknown.chosen
    rivals = [((), likely.none), *((rival, likely.of(h.key for h in rival)) for rival, _ in found.selection.rivals)]
    named = search.fit(chosen).position_residuals(rows, there)
    moved = [(p, search.fit(rival).position_residuals(rows, there) - named) for rival, p in rivals]
    return float(sum(p * np.mean(distances(by) ** 2) for p, by in moved))
