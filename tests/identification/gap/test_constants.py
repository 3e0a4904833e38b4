"""The derived constants of `identification.gap`: identification/README.md, "Constants" says what each must achieve."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, ncf

from identification.estimation import outlying
from identification.gap.diagnose import FEWEST_DRAWS
from identification.gap.hypotheses.detectability import EXACT, NEAR, POWER, SPARE
from identification.gap.noise import noise
from identification.gap.outside import unmodelled, unmodelled_shapes, unmodelled_survey
from identification.gap.selection import search, selection


def power(size: int, freedom: int, length: float, level: float = 0.005) -> float:
    """Of an F test of `size` parameters with `freedom` residual degrees of freedom, `size` of which the effect uses."""
    limit = ncf.isf(level, size, freedom - size, 0.0)
    return float(ncf.sf(limit, size, freedom - size, length**2))


def test_fewer_spare_degrees_of_freedom_show_nothing() -> None:
    assert power(1, SPARE, 11.1) >= POWER
    assert power(2, SPARE, 30.5) >= POWER
    assert power(1, SPARE - 1, 21.0) < POWER
    assert power(2, SPARE - 1, 200.0) < POWER


@pytest.mark.parametrize(("likeness", "length"), [(NEAR, 5.6), (EXACT, 173.0)])
def test_aliases_stay_within_the_window(likeness: float, length: float) -> None:
    """What is left of a unit vector beside another with this cosine is sqrt(1 - c^2) long."""
    assert length**2 * (1.0 - likeness**2) == pytest.approx(selection.WINDOW, rel=0.01)


def test_gaussian_noise_has_no_outliers() -> None:
    """3 of 10,000 expected at most: 5 or more of 1,000 have probability 2e-5. At a limit of 4 there are some 23."""
    rng = np.random.default_rng(17)
    z = np.exp(1j * np.cumsum(rng.uniform(-np.pi, np.pi, (20, 4)), axis=1))
    columns = np.stack([np.hstack([z.real, -z.imag]), np.hstack([z.imag, z.real])], axis=1).reshape(40, 8)
    basis = np.linalg.qr(columns)[0].reshape(20, 2, 8)
    everything = np.ones(20, dtype=bool)
    drawn = rng.standard_normal((1000, 20, 2))
    largest = np.array([outlying.studentised(residual, basis, everything).max() for residual in drawn])
    assert np.sum(largest > outlying.OUTLIER**2) < 5
    assert np.sum(largest > 4.0**2) >= 5


def test_outliers_do_not_spoil_the_robust_scale() -> None:
    """A quarter of huge residuals moves the median of all to the 2/3 quantile of the others (chi-square, 2 degrees)."""
    clean = 1.0 - outlying.MOST_OUTLIERS
    inflation = np.sqrt(chi2.ppf(0.5 / clean, 2) / chi2.ppf(0.5, 2))
    assert inflation == pytest.approx(1.26, abs=0.005)


def test_levels_are_within_reach_of_the_draws() -> None:
    """The smallest p-value of B draws is 1 / (B + 1)."""
    assert 1.0 / (FEWEST_DRAWS + 1.0) <= selection.ALPHA_NEXT * search.LEVEL_FACTOR
    assert 1.0 / (unmodelled_survey.DRAWS + 1.0) <= unmodelled_survey.BOOTSTRAP_LEVEL
    assert 10.0 / (noise.DRAWS + 1.0) <= noise.LEVEL  # 7 joints, reach, time and correlation, after Holm's correction


def test_levels_leave_one_false_alarm_in_twenty() -> None:
    """Of the names, of the scatter, and of shapes beside nothing named, which white noise reaches in 0.6 of its level
    (0.55 to 0.65 of 20,000 draws for arms of 5 and 6 links, by the orders 1/4 apart)."""
    assert selection.ALPHA_FIRST + noise.LEVEL + 0.6 * unmodelled_survey.LEVEL_FIRST <= 0.05


def test_replacing_an_effect_costs_as_much_as_the_window() -> None:
    assert selection.WINDOW == unmodelled.ODDS


def likeness(one: np.ndarray, tried: list[np.ndarray]) -> float:
    """Largest cosine between a shape (m,) and the spans of shapes (m, d)."""
    bases = [np.linalg.qr(columns)[0] for columns in tried]
    return max(float(np.linalg.norm(basis.T @ one)) for basis in bases) / float(np.linalg.norm(one))


def test_no_wave_falls_between_the_orders_tried() -> None:
    """Half-way between two orders the likeness over a full turn is sin(pi/8) / (pi/8) = 0.97."""
    q = np.linspace(-np.pi, np.pi, 4001)[:-1]
    orders = [10.0, 10.25]
    assert set(orders) <= set(unmodelled_shapes.FREE_ORDERS)
    tried = [np.column_stack([np.cos(k * q), np.sin(k * q)]) for k in orders]
    for phase in (0.0, 0.5, 1.0, 1.5):
        assert likeness(np.cos(10.125 * q + phase), tried) == pytest.approx(np.sinc(0.125), abs=0.02)


def test_no_bump_falls_between_the_bumps_tried() -> None:
    """7.5 degrees from the nearest centre the narrowest bump still has the likeness exp(-(0.131 / 0.4)^2) = 0.90."""
    q = np.linspace(-np.pi, np.pi, 4001)[:-1]
    step = 2.0 * np.pi / unmodelled_shapes.CENTRES
    tried = [np.exp(-0.5 * ((q - c) / w) ** 2)[:, None] for c in (0.0, step) for w in unmodelled_shapes.WIDTHS]
    widths = np.array(unmodelled_shapes.WIDTHS)
    for width in (*widths, *np.sqrt(widths[1:] * widths[:-1])):
        assert likeness(np.exp(-0.5 * ((q - step / 2.0) / width) ** 2), tried) >= 0.89
