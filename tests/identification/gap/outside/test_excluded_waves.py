"""Sizes of waves of any order that `none` excludes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import f, ncf

from identification.arm import Arm
from identification.gap.diagnose import diagnose
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.outside.excluded_waves import excluded_waves
from identification.gap.outside.unmodelled_survey import LEVEL_FIRST, surveyed
from identification.gap.selection.search import HypothesisSearch
from identification.measurements import Measurements

LENGTHS, SIGMA, TURN = np.array([300.0, 200.0]), 0.05, 2.0 * np.pi
ARM = Arm(LENGTHS, sigma=SIGMA)


def measured(q: np.ndarray) -> Measurements:
    """Positions of the nominal arm with white noise, in plain numpy."""
    links = LENGTHS * np.exp(1j * np.cumsum(q, axis=1))
    noise = np.random.default_rng(2).normal(size=(len(q), 2))
    return Measurements(q, np.column_stack([links.sum(axis=1).real, links.sum(axis=1).imag]) + SIGMA * noise)


def columns(q: np.ndarray, joint: int, order: float) -> tuple[np.ndarray, np.ndarray]:
    """(2m, 4) of the lengths and offsets, and (2m, 2) of a wave, at the nominal arm."""
    links = LENGTHS * np.exp(1j * np.cumsum(q, axis=1))
    beyond = np.cumsum(1j * links[:, ::-1], axis=1)[:, ::-1]
    base = np.hstack([links / LENGTHS, beyond])
    wave = beyond[:, [joint - 1]] * np.column_stack([np.cos(order * q[:, joint - 1]), np.sin(order * q[:, joint - 1])])
    return (np.stack([c.real, c.imag], axis=1).reshape(2 * len(q), -1) for c in (base, wave))  # type: ignore[return-value]


def searched(q: np.ndarray) -> HypothesisSearch:
    rows = Rows.of(measured(q))
    return HypothesisSearch(hypotheses(ARM, frozenset(), rows), rows)


def test_a_wave_of_the_size_stated_is_found_in_nine_cases_of_ten() -> None:
    """At the order hardest to see the F test has a power of 0.9, at every other one more: noncentral F, at the level of
    one shape among those of its place and all places."""
    q = np.random.default_rng(1).uniform(-np.pi, np.pi, (40, 2))
    search = searched(q)
    stated = excluded_waves(search, SIGMA)
    counts = surveyed(search, [()])[0].counts
    level = LEVEL_FIRST / len(counts) / counts["joint:2"]
    size = stated["transmission_ripple:2[any k]"]
    assert size.unit == "mm"
    assert size.value is not None
    assert stated["transmission_ripple:1[any k]"].unit == "mm"
    limit, lengths = f.isf(level, 2, 74), []
    for order in np.arange(3.0, 256.25, 0.25):
        base, wave = columns(q, 2, order)
        amplitude = size.value * np.sqrt(40.0) / np.sqrt(0.5 * np.sum(wave**2))
        left = wave - base @ np.linalg.lstsq(base, wave, rcond=None)[0]
        lengths.append(amplitude * np.linalg.svd(left, compute_uv=False)[-1] / SIGMA)
    assert ncf.sf(limit, 2, 74, min(lengths) ** 2) == pytest.approx(0.9, abs=0.003)  # the fit moves the arm a little


def test_a_grid_hides_the_wave_of_its_spacing() -> None:
    """At multiples of 45 degrees a wave of 8 per turn is an offset: no size is excluded, and the verdict says so."""
    first, second = np.meshgrid(np.arange(8) * TURN / 8.0, np.random.default_rng(4).uniform(-3.0, 3.0, 5))
    found = diagnose(ARM, measured(np.column_stack([first.ravel(), second.ravel()])), draws=399)
    assert found.verdict == "none"
    assert found.excluded["transmission_ripple:1[any k]"].value is None
    assert "a wave of unknown order at a joint, of any size, is not excluded" in found.sentence
