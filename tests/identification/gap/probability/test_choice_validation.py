"""Choosing again without a part of the rows: against fits by hand, and what it says of right and of wrong names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe.studies.blind import cells
from identification.gap.diagnose import varying
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.probability.choice_validation import FOLDS, MOST_ROWS, _predicted, disagreement, validate_choice
from identification.gap.probability.probabilities import probabilities
from identification.gap.workflow import Findings, Workflow
from identification.measurements import Measurements


def found_in(cell: str, number: int) -> tuple[Findings, Measurements, Measurements | None]:
    data = cells.data_set(cell, number)
    rows = Rows.of(data.measurements)
    library = hypotheses(data.arm, varying(data.measurements), rows)
    return Workflow(library, 399, np.random.default_rng(0)).findings(rows), data.measurements, data.holdout


def test_rows_left_out_are_predicted_by_the_others() -> None:
    rng = np.random.default_rng(1)
    model, data = rng.standard_normal((20, 3)) * [1.0, 1e3, 1e-3], rng.standard_normal(20)
    out = np.repeat(np.arange(10) % 5 == 2, 2)
    squares, expected = _predicted(model, data, out, 2)
    values, left, _, _ = np.linalg.lstsq(model[~out], data[~out])
    np.testing.assert_allclose(squares, ((data - model @ values)[out] ** 2).reshape(-1, 2).sum(axis=1), rtol=1e-9)
    covariance = left[0] / (16 - 3) * np.linalg.inv(model[~out].T @ model[~out])
    spread = np.einsum("ip,pq,iq->i", model[out], covariance, model[out])
    np.testing.assert_allclose(expected, spread.reshape(-1, 2).sum(axis=1), rtol=1e-8)


def test_a_clear_effect_is_chosen_again_and_predicts_as_well_as_it_fits() -> None:
    found, measurements, holdout = found_in("one, lambda 20, m=50", 3_000_003)
    result = validate_choice(found, measurements, np.random.default_rng(0))
    assert result is not None
    assert result.again >= 0.9
    noise = 2.0 * found.search.fit(found.selection.chosen).sigma ** 2  # of a row
    assert result.excess < 0.3 * noise  # of 50 rows a mean square is known to 14 %
    assert holdout is not None
    assert disagreement(found, probabilities(found), holdout, holdout.conditions) < 0.1 * noise


def test_the_candidates_disagree_as_much_as_they_are_likely() -> None:
    found, _, holdout = found_in("one, lambda 20, m=50", 3_000_003)
    assert holdout is not None
    likely = replace(probabilities(found), none=0.25, sets={})
    chosen, base = found.search.fit(found.selection.chosen), found.search.fit(())
    apart = chosen.position_residuals(holdout, holdout.conditions) - base.position_residuals(
        holdout, holdout.conditions
    )
    expected = 0.25 * np.mean(np.square(apart).sum(axis=1))
    assert disagreement(found, likely, holdout, holdout.conditions) == pytest.approx(expected, rel=1e-12)


def test_nothing_chosen_is_not_validated() -> None:
    found, measurements, _ = found_in("none m=20", 3_000_001)
    assert validate_choice(found, measurements, np.random.default_rng(0)) is None
    assert 2 * FOLDS < MOST_ROWS
