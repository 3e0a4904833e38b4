"""The loop inside `diagnose`: very many rows."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import f as fdist
from scipy.stats import ncf

from doe.studies.blind.cells import data_set
from identification.gap.diagnose import diagnose
from identification.gap.outside.unmodelled import Unknown
from identification.gap.selection.search import LEVEL_FACTOR
from identification.gap.selection.selection import ALPHA_NEXT, LEAST_GAIN
from identification.gap.workflow import CREDIT, MOST_ROWS, Workflow, _credit
from tests.identification.gap.selection.test_search import LIBRARY, NAMES, searched


def test_of_very_many_rows_some_are_searched_and_all_are_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the estimates the sum of squares of all rows has no gradient."""
    rows = searched()[0].rows
    monkeypatch.setattr("identification.gap.workflow.MOST_ROWS", 80)
    told: list[str] = []
    found = Workflow(LIBRARY, 399, np.random.default_rng(1), told.append).findings(rows)
    assert f"pass 1, {len(NAMES)} effects" in told
    assert max(Counter(told).values()) <= 2  # what is told goes on
    assert {h.label for h in found.unknown.chosen} == set(NAMES)
    assert len(found.outlier) == len(rows) == 120
    assert len(found.search.rows) <= 80
    fitted = found.fits.fit(found.unknown.chosen)
    assert len(fitted.rows) == np.sum(~found.outlier)
    kept = rows.pick(~found.outlier)
    left = (kept.positions - fitted.model.position(kept.postures, fitted.values, kept.conditions)).ravel()
    jacobian = fitted.model.jacobian(kept.postures, fitted.values, kept.conditions).reshape(left.size, -1)
    assert found.scatter == ()
    assert np.all(np.abs(left @ jacobian) < 1e-6 * np.linalg.norm(left) * np.linalg.norm(jacobian, axis=0))


def test_the_rows_searched_show_what_is_worth_a_round() -> None:
    """In 99 of 100 cases at the strictest level, by the noncentral F distribution."""
    n = 2 * MOST_ROWS
    weight = min(h.weight for h in LIBRARY.members if h.size == 2)
    limit = float(fdist.isf(ALPHA_NEXT * LEVEL_FACTOR * weight, 2, n - 10))
    power = [float(ncf.sf(limit, 2, rows - 10, rows * LEAST_GAIN / (1.0 - LEAST_GAIN))) for rows in (n, n - 100)]
    assert power[0] == pytest.approx(0.99, abs=0.001)
    assert power[1] < power[0]


def test_a_wave_of_a_joint_is_not_taken_for_noise_of_that_joint() -> None:
    """37.3 per turn in joint 1, on 50 postures of two links: noise of joint 1 would leave nothing missing."""
    data = data_set("wave 37.3, lambda 8", 36)
    found = diagnose(data.arm, data.measurements, draws=499, seed=36)
    assert found.effects == ("transmission_ripple:1[k=37.375]",)


def test_only_a_cause_in_place_of_uneven_scatter_needs_no_credit() -> None:
    generator = np.random.default_rng(1)
    nothing = Workflow(LIBRARY, 399, generator).findings(searched()[0].rows)
    nothing = replace(nothing, unknown=Unknown(1.0, None, None, (), 0.0))
    named = replace(nothing, unknown=Unknown(1.0, None, None, LIBRARY.members[:1], 0.0))
    elsewhere = replace(nothing, unknown=Unknown(0.0, "joint:1", "cube", (), 0.0))
    fewer = replace(nothing, outlier=~nothing.outlier)
    assert [_credit(nothing, other) for other in (named, elsewhere, fewer)] == [0.0, 0.0, CREDIT]
    assert [_credit(found, nothing) for found in (named, elsewhere)] == [CREDIT, CREDIT]
