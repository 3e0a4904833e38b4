"""General shapes beside sets of effects."""

from __future__ import annotations

import numpy as np
import pytest

from identification.gap.fits.whitening import Rows
from identification.gap.outside.unmodelled_survey import BOOTSTRAP_LEVEL, Survey, adjusted, against_at, surveyed
from identification.gap.selection.search import HypothesisSearch
from identification.measurements import Measurements
from tests.identification.gap.selection.test_search import LIBRARY, searched


def test_a_shape_lowers_bic_as_a_fit_with_it_does() -> None:
    """Against least squares with the Jacobian and the shape's own columns, written out."""
    search, _ = searched()
    found = search.fit(())
    survey = surveyed(search, [()])[0]
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


def of_white_noise(m: int) -> Survey:
    """The shapes beside nothing, where nothing is hidden; m rows."""
    rng = np.random.default_rng(8)
    q = rng.uniform(-2.5, 2.5, (m, 3))
    data = Measurements(q, searched()[0].hypotheses.base.position(q) + 0.05 * rng.normal(size=(m, 2)))
    return surveyed(HypothesisSearch(LIBRARY, Rows.of(data)), [()])[0]


def test_white_noise_reaches_the_level_less_often_than_it_says() -> None:
    """Of independent tests Bonferroni's bound is right to second order, of overlapping ones too high: about 0.07 of
    white noise is below 0.1 (600 draws, within three standard errors of 0.07)."""
    search, _ = searched()
    fit, rng = search.fit(()), np.random.default_rng(9)
    places = list(against_at(fit, fit.basis, np.arange(240)))
    noise = rng.normal(size=(240, 600))
    noise -= fit.basis @ (fit.basis.T @ noise)
    smallest = np.full(600, np.inf)
    for against in places:
        scores = against.scores(against.columns.matrix.T @ noise, fit.basis.T @ noise)
        smallest = np.minimum(smallest, against.smallest_weighted(scores, np.square(noise).sum(axis=0)))
    reached = np.mean(smallest * len(places) <= 0.1)
    assert 0.04 < reached < 0.1


def test_noise_is_no_shape_to_the_bootstrap() -> None:
    """What is not significant by itself is not drawn for; what is, is refused where random signs of the residuals give
    it as often."""
    survey = of_white_noise(60)
    draws = np.random.default_rng(3)
    assert adjusted(survey, 0.5 * survey.smallest, draws) == min(survey.smallest, 1.0)
    refused = adjusted(survey, 1.5 * survey.smallest, draws)
    assert refused > 1.5 * survey.smallest


def test_p_value_on_a_sample_of_the_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """White noise of 700 rows: the share of random signs that look as strange is the same for 500 of them and for all,
    within what some 400 draws and the sample leave open."""
    rng, survey = np.random.default_rng(8), of_white_noise(700)
    p = []
    for most in (500, 700):
        monkeypatch.setattr("identification.gap.outside.unmodelled_survey.SAMPLED", most)
        p.append(adjusted(survey, 1.0 + survey.smallest, rng) / (1.0 + survey.smallest))
    assert p[0] == pytest.approx(p[1], abs=0.15 / BOOTSTRAP_LEVEL)
