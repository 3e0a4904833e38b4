"""What is left against the sigma that was given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from identification.gap.noise.misfit import misfit
from identification.measurements import Measurements

RNG = np.random.default_rng(4)
DATA = Measurements(RNG.uniform(-3.0, 3.0, (50, 3)), np.zeros((50, 2)))
LEFT = 0.14 * RNG.normal(size=(50, 2))
KEPT = np.arange(50) > 3


def test_chi_square_of_what_is_left() -> None:
    found = misfit(LEFT, 6, DATA, 0.1, KEPT)
    assert found is not None
    chi2 = np.sum((LEFT[4:] / 0.1) ** 2)
    assert (found.chi2, found.dof) == (pytest.approx(chi2), 86)
    assert found.p_value == pytest.approx(stats.chi2(86).sf(chi2))
    assert found.ratio == pytest.approx(1.4, abs=0.2)
    assert found.significant
    assert not misfit(LEFT, 6, DATA, 0.14, KEPT).significant  # type: ignore[union-attr]


def test_sigma_of_the_rows_counts_before_that_of_the_arm() -> None:
    rows = replace(DATA, sigma=np.linspace(0.1, 0.2, 50))
    found = misfit(LEFT, 6, rows, 5.0, KEPT)
    assert found is not None
    assert found.chi2 == pytest.approx(np.sum((LEFT / np.linspace(0.1, 0.2, 50)[:, None])[4:] ** 2))


def test_without_a_sigma_nothing_is_said() -> None:
    assert misfit(LEFT, 6, DATA, None, KEPT) is None
