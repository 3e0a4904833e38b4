"""Intervals of a diagnosis are those that `identify` gives for the extended arm; data in another frame are said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec
from identification.estimation import estimate
from identification.gap.diagnose import diagnose
from identification.gap.fits.fit import fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.selection.certainty import certainty
from identification.gap.selection.selection import HypothesisSearch
from identification.measurements import Measurements
from identification.model import Model
from tests.identification.estimation.cases import LENGTHS, SIGMA, TRUTH, plan

ARM = Arm(LENGTHS, sigma=SIGMA)
TURNED = EffectSpec("base_offset")


def measured(m: int = 60, repeats: int = 1, noise: float = SIGMA) -> Measurements:
    """An arm with a base offset and an encoder off centre, which is left out here."""
    model = Model(Arm(LENGTHS, effects=(TURNED, EffectSpec("encoder_eccentricity", 2))))
    q = np.tile(plan(m), (repeats, 1))
    values = np.r_[TRUTH, 0.8, -0.5, 2e-3, 1e-3]
    return Measurements(q, model.position(q, values) + noise * np.random.default_rng(3).standard_normal((len(q), 2)))


@pytest.mark.parametrize(
    ("sigma", "per_row", "kind"),
    [(SIGMA, False, "sandwich"), (None, True, "given"), (None, False, "scatter"), (9.0, False, "scatter")],
)
def test_the_same_figures_as_identify(sigma: float | None, per_row: bool, kind: str) -> None:
    arm, data = replace(ARM, sigma=sigma), measured()
    if per_row:  # large enough for what is left out
        scatter = estimate(Model(arm.with_effects(TURNED)), data, sigma="estimated").scatter
        data = replace(data, sigma=scatter * np.linspace(0.95, 1.05, 60))
    search = HypothesisSearch(hypotheses(arm, frozenset()), Rows.of(data))
    chosen = tuple(h for h in search.hypotheses.members if h.key == "base_offset")
    found = search.fit(chosen)
    sure = certainty(search, found)
    said = estimate(Model(arm.with_effects(TURNED)), data)
    assert (sure.kind, said.uncertainty.kind) == (kind, kind)
    np.testing.assert_allclose(found.values, said.parameters, atol=1e-7)
    np.testing.assert_allclose(np.sqrt(np.diag(sure.covariance)), said.std, rtol=1e-4)
    np.testing.assert_allclose(sure.freedom, said.uncertainty.freedom, rtol=1e-4)


def test_repeats_are_known_to_the_diagnosis() -> None:
    data = measured(30, repeats=4, noise=SIGMA / 5.0)
    search = HypothesisSearch(hypotheses(ARM, frozenset()), Rows.of(data).pick(np.arange(120) != 7))
    sure = certainty(search, search.fit(()))
    assert (sure.kind, sure.clusters, sure.count) == ("sandwich", "postures", 30)


def test_a_noise_model_from_the_residuals_does_not_rely_on_sigma() -> None:
    rows = Rows.of(measured())
    search = HypothesisSearch(hypotheses(replace(ARM, sigma=0.2), frozenset()), rows, noise_estimated=True)
    assert certainty(search, search.fit(())).kind == "sandwich"


def test_data_in_the_frame_of_a_tracker_are_diagnosed_without_flipped_links() -> None:
    turn = np.array([[np.cos(1.2), np.sin(1.2)], [-np.sin(1.2), np.cos(1.2)]])
    data = measured()
    data = replace(data, positions=data.positions @ turn + [2500.0, -800.0])
    found = diagnose(ARM, data, draws=399)
    assert {"base_offset", "encoder_eccentricity:2"} <= set(found.effects)
    assert np.all(np.abs(found.named.calibration.length_errors) < 5.0)
    (offer,) = found.warnings
    assert 'add [[effects]] name = "base_offset"' in offer
    assert offer in str(found)
    assert found.to_json()["warnings"] == [offer]
    assert diagnose(ARM.with_effects(TURNED), data, draws=399).warnings == ()


def test_a_start_far_off_is_replaced_by_the_closed_form() -> None:
    model, data = Model(ARM.with_effects(TURNED)), measured()
    data = replace(data, positions=data.positions + np.array([900.0, 4000.0]))
    found = fit(model, Rows.of(data), start={"joint_offset:1": 3.0})
    expected = estimate(model, data).parameters
    np.testing.assert_allclose(found.values, expected, atol=1e-6)
