"""General shapes beside sets of effects."""

from __future__ import annotations

import numpy as np
import pytest

from identification.gap.search import HypothesisSearch
from identification.gap.unmodelled_survey import Sample, adjusted, surveyed
from identification.gap.whitening import Rows
from identification.measurements import Measurements
from tests.identification.gap.test_search import LIBRARY, searched


def test_a_shape_lowers_bic_as_a_fit_with_it_does() -> None:
    """Against least squares with the Jacobian and the shape's own columns, written out."""
    search, _ = searched()
    found = search.fit(())
    survey = surveyed(search, [()], None)[0]
    k = survey.listed.index(("joint:2", "wave of 2 per turn"))
    lever = found.model.joint_levers(search.rows.postures, found.values)[:, :, 1, None]
    angle = 2.0 * search.rows.postures[:, 1, None, None]
    wave = (lever * np.concatenate([np.cos(angle), np.sin(angle)], axis=2)).reshape(240, 2)
    both = np.hstack([found.jacobian / np.linalg.norm(found.jacobian, axis=0), wave / np.linalg.norm(wave, axis=0)])
    left = np.linalg.lstsq(both, found.residual, rcond=None)[1][0]
    expected = 240 * np.log(left / found.squares) + 2.0 * np.log(240)
    assert survey.changes[k] == pytest.approx(expected, rel=1e-6)
    places = {place for place, _ in survey.listed}
    assert places == {"joint:1", "joint:2", "joint:3", "time", "workspace"}
    assert survey.weights[k] == pytest.approx(1.0 / (5 * survey.counts["joint:2"]))


def test_p_value_on_a_sample_of_the_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """White noise of 700 rows: the p-value from draws on 500 of them is that from draws on all, within what some 400
    draws and the sample leave open."""
    rng = np.random.default_rng(8)
    search, _ = searched()
    q = rng.uniform(-2.5, 2.5, (700, 3))
    data = Measurements(q, search.hypotheses.base.position(q) + 0.05 * rng.normal(size=(700, 2)))
    search = HypothesisSearch(LIBRARY, Rows.of(data))
    p = []
    for most in (500, 700):
        monkeypatch.setattr("identification.gap.unmodelled_survey.SAMPLED", most)
        sample = Sample(700, 2, rng)
        survey = surveyed(search, [()], sample)[0]
        assert len(sample.rows) == most
        p.append(adjusted(search, survey, sample, rng))
    assert p[0] == pytest.approx(p[1], abs=0.15)
