"""The loop inside `diagnose`: very many rows."""

from __future__ import annotations

import numpy as np
import pytest

from identification.gap.workflow import investigate_some
from tests.identification.gap.test_search import LIBRARY, NAMES, searched


def test_of_very_many_rows_some_are_searched_and_all_are_screened(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = searched()[0].rows
    monkeypatch.setattr("identification.gap.workflow.MOST_ROWS", 80)
    found = investigate_some(LIBRARY, rows, 399, np.random.default_rng(1))
    assert {h.label for h in found.unknown.chosen} == set(NAMES)
    assert len(found.search.rows) == found.used.sum() == 80 - found.outlier[found.sampled].sum()
    assert len(found.outlier) == len(rows) == 120
