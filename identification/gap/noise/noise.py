"""Screen residuals for outliers, heteroscedastic noise and serial correlation, and model that noise.

Effects on the mean are handled by `select`. Here the residuals of a fitted model are tested, and a noise model is
returned under which they are white, so that the tests of the mean can be repeated at their nominal level.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimation.outlying import outlying, together
from identification.estimation.shown import p_value_in_words
from identification.gap.fits.fit import Fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.omnibus_test import MANY
from identification.gap.noise.posture_neighbors import lag_of
from identification.gap.noise.quadratic_forms import BlockForm, Form, ratio, ratio_moments, ratios
from identification.information import column_space

# reasons: identification/README.md, "Constants"
LEVEL = 0.01  # convention: of any finding on white noise, after Holm's correction
DRAWS = 999  # the smallest p-value times the number of tests must reach LEVEL; raised for many joints
HINT = 0.2  # tuned: adjusted p-value above which the noise counts as the same everywhere
CORRELATIONS = np.linspace(0.0, 0.95, 20)  # of one row with the next
CLEAR = 1e-10  # eigenvalues of a normal matrix, of the largest
GRID = np.geomspace(0.05, 50.0, 31)  # variance ratios; the likelihood is flat over a step of 26 %


@dataclass(frozen=True)
class Finding:
    """A significant property of the noise.

    name : `joint_noise:j`, `reach_noise`, `time_noise`, `serial_correlation`, `repeats`;  p : Holm-adjusted p-value
    size : ratio of the additional to the common variance (at the mean posture), or the correlation
    """

    name: str
    p: float
    size: float

    def __str__(self) -> str:
        kind, _, joint = self.name.partition(":")
        what = {
            "joint_noise": f"larger the farther joint {joint} moves the point, by a relative variance of",
            "reach_noise": "larger far from the base, by a relative variance of",
            "time_noise": f"larger {'early' if self.size < 0.0 else 'late'} in the session, by a relative variance of",
            "serial_correlation": "rows measured one after the other err alike, lag-1 correlation",
            "repeats": "misfit larger than what repeats scatter, by the variance ratio",
        }[kind]
        return f"{self.name} ({what} {abs(self.size):.2g}, {p_value_in_words(self.p)})"


def outliers(found: Fit, everything: Rows) -> NDArray[np.bool_]:
    """(m,) True for outliers by the rules of `outlying` and `together`.

    found : a fit to these rows or to some of them;  everything : all rows
    """
    unexplained = unexplained_rows(found, everything)
    return unexplained & ~together(unexplained, everything.postures, everything.posture_numbers)


def unexplained_rows(found: Fit, everything: Rows) -> NDArray[np.bool_]:
    """(m,) True for rows that a fit does not explain, outliers or not; arguments as of `outliers`."""
    plain = replace(everything, correlation=0.0)  # a posture is judged on its own
    predicted, jacobian = found.model.linearize(everything.postures, found.values, everything.conditions)
    residual = plain.whiten(everything.positions - predicted).reshape(predicted.shape)
    return outlying(residual, plain.whiten(jacobian / found.model.scales))


def screen(found: Fit, rows: Rows, generator: np.random.Generator) -> tuple[Finding, ...]:
    """Significant properties of the noise in the residuals of a fitted model.

    rows : weighted by the sigma of the data only, without a noise model
    """
    tests = scatter_tests(found, rows, generator)
    return (*_variance_finding(tests), *_correlation_finding(tests, found, rows))


@dataclass(frozen=True)
class ScatterTests:
    """Tests of each kind of structure in the noise, by the names of `Finding`.

    adjusted : p-values after Holm's correction
    values : (1 + B,) statistic of the residuals, then of B draws of white noise
    forms : (m, d, d) shapes of the additional covariance, see `variance_forms`
    residual : (m d,) whitened, with RMS 1
    correlation : lag-1 correlation net of what posture explains, see `posture_neighbors.Lag`; None: posture explains
        nothing
    """

    adjusted: dict[str, float]
    values: dict[str, Array]
    forms: dict[str, Array]
    residual: Array
    correlation: float | None


def scatter_tests(found: Fit, rows: Rows, generator: np.random.Generator) -> ScatterTests:
    """Test the residuals of a fitted model for every kind of structure.

    Each statistic is a quadratic form of the residuals divided by their sum of squares. Its distribution under white
    Gaussian noise is simulated with the same projection off the Jacobian, so it is exact for any degrees of freedom.
    """
    position, jacobian = found.model.linearize(rows.postures, found.values, rows.conditions)
    residual, columns = rows.whiten(rows.positions - position), rows.whiten(jacobian)
    q = column_space(columns, found.model.scales)
    forms = variance_forms(rows, position, found.model.joint_levers(rows.postures, found.values, rows.conditions))
    # Holm multiplies the smallest p-value, 1 / (draws + 1), by the number of tests: the level must be within reach
    draws = max(DRAWS, int(np.ceil((len(forms) + 1) / LEVEL - 1e-9)) - 1)
    residual -= q @ (q.T @ residual)
    residual /= np.sqrt(np.mean(residual**2))
    tested = {name: BlockForm(form - np.eye(rows.dimension)) for name, form in forms.items()}
    lag = lag_of(rows, residual)
    values = _values(tested | {"serial_correlation": lag.form}, residual, q, draws, generator)
    values["time_noise"] = np.abs(values["time_noise"])
    p = {name: (1.0 + np.sum(v[1:] >= v[0])) / (draws + 1.0) for name, v in values.items()}
    return ScatterTests(holm(p), values, forms, residual, lag.size)


def homoscedastic(found: Fit, rows: Rows, generator: np.random.Generator) -> bool:
    """True if no test suggests that the noise is larger at some postures (adjusted p-values above `HINT`)."""
    return min(scatter_tests(found, rows, generator).adjusted.values()) > HINT


def variance_forms(rows: Rows, position: Array, levers: Array) -> dict[str, Array]:
    """Name of a finding -> (m, d, d) shape of the additional covariance, with mean trace d.

    Joint noise moves the tip along the joint's lever; reach noise increases with the distance from the base, time noise
    with the time in the session. A joint that does not move the tip is left out.

    position : (m, d) computed [mm];  levers : (m, d, n) of `Model.joint_levers` [mm/rad]
    """
    d, forms = rows.dimension, {}
    for j, lever in enumerate(np.moveaxis(levers, 2, 0), start=1):
        forms[f"joint_noise:{j}"] = lever[:, :, None] * lever[:, None, :]
    forms["reach_noise"] = np.sum(position**2, axis=1)[:, None, None] * np.eye(d)
    time = rows.conditions.time if rows.conditions.time is not None else np.zeros(len(rows))
    forms["time_noise"] = (time - time.min() + 1e-9)[:, None, None] * np.eye(d)
    traces = {name: float(np.einsum("mii->", form)) for name, form in forms.items()}
    return {name: form * (d * len(form) / traces[name]) for name, form in forms.items() if traces[name] > 0.0}


def _values(
    tested: Mapping[str, Form], residual: Array, basis: Array, draws: int, generator: np.random.Generator
) -> dict[str, Array]:
    """(1 + B,) `ratio` of the residual (N,), then of B draws of white noise projected off a model.

    basis : (N, r) orthonormal, of the model's Jacobian

    From `MANY` rows on, ratios are drawn from the normal distribution with their exact mean and variance.
    """
    observed = ratios(tested, residual[:, None])
    if len(residual) < 2 * MANY:
        drawn = generator.standard_normal((len(residual), draws))
        drawn -= basis @ (basis.T @ drawn)
        white = ratios(tested, drawn)
        return {name: np.concatenate([observed[name], white[name]]) for name in tested}
    values = {}
    for name, form in tested.items():
        mean, deviation = ratio_moments(form, basis)
        values[name] = np.concatenate([observed[name], mean + deviation * generator.standard_normal(draws)])
    return values


def _variance_finding(tests: ScatterTests) -> tuple[Finding, ...]:
    """The strongest significant finding about the variance: these compete for one explanation."""
    values, significant = tests.values, [name for name in tests.forms if tests.adjusted[name] <= LEVEL]
    if not significant:
        return ()
    # standardized, so that findings can be ranked whose p-values are all the smallest possible
    strength = {n: (values[n][0] - values[n][1:].mean()) / values[n][1:].std() for n in significant}
    name = max(significant, key=lambda n: strength[n])
    falling = name == "time_noise" and _falls(tests.forms[name], tests.residual)
    ratio = _variance_ratio(_oriented(tests.forms[name], falling), tests.residual)
    return (Finding(name, tests.adjusted[name], -ratio if falling else ratio),)


def _correlation_finding(tests: ScatterTests, found: Fit, rows: Rows, level: float = LEVEL) -> tuple[Finding, ...]:
    """Serial correlation if significant at `level`, with its size net of what posture explains."""
    p = tests.adjusted["serial_correlation"]
    if p > level:
        return ()
    size = likely_correlation(found, rows) if tests.correlation is None else tests.correlation
    return (Finding("serial_correlation", p, float(np.clip(size, 0.0, CORRELATIONS[-1]))),)


def memory(found: Fit, rows: Rows, generator: np.random.Generator) -> tuple[Finding, ...]:
    """Serial correlation that the residuals of a fitted model suggest at the weaker level `HINT`."""
    return _correlation_finding(scatter_tests(found, rows, generator), found, rows, HINT)


def likely_correlation(found: Fit, rows: Rows) -> float:
    """Lag-1 correlation that maximizes the restricted likelihood, which accounts for the fitted parameters.

    H. D. Patterson, R. Thompson, "Recovery of inter-block information when block sizes are unequal", 1971.
    """
    position, jacobian = found.model.linearize(rows.postures, found.values, rows.conditions)
    left, columns = rows.positions - position, jacobian / found.model.scales
    costs = [_restricted_cost(replace(rows, correlation=float(rho)), left, columns) for rho in CORRELATIONS]
    return float(CORRELATIONS[int(np.argmin(costs))])


def _restricted_cost(rows: Rows, left: Array, columns: Array) -> float:
    """-2 log of the restricted likelihood of a noise model."""
    residual, basis = rows.whiten(left), rows.whiten(columns)
    values, turn = np.linalg.eigh(basis.T @ basis)
    seen = values > CLEAR * values.max(initial=0.0)
    scores = turn[:, seen].T @ (basis.T @ residual)
    squares = float(residual @ residual - np.sum(scores**2 / values[seen]))
    freedom = len(residual) - int(seen.sum())
    return freedom * np.log(max(squares, 1e-300)) + rows.log_determinant + float(np.sum(np.log(values[seen])))


def whitened(rows: Rows, found: Fit, findings: tuple[Finding, ...]) -> Rows:
    """Rows with the noise model of these findings, which holds for any rows of the data."""
    for finding in findings:
        if finding.name == "serial_correlation":
            rows = replace(rows, correlation=finding.size)
            continue
        position = found.model.position(rows.postures, found.values, rows.conditions)
        levers = found.model.joint_levers(rows.postures, found.values, rows.conditions)
        form = _oriented(variance_forms(rows, position, levers)[finding.name], finding.size < 0.0)
        values, vectors = np.linalg.eigh(form)
        deviations = np.sqrt(1.0 + abs(finding.size) * np.maximum(values, 0.0))
        spread = vectors * deviations[:, None, :] @ vectors.transpose(0, 2, 1)
        rows = replace(rows, spread=spread if rows.spread is None else rows.spread @ spread)
    return rows


def _falls(form: Array, residual: Array) -> bool:
    """True if the residuals are smaller where the form is large."""
    return bool(ratio(BlockForm(form - np.eye(form.shape[1])), residual[:, None])[0] < 0.0)


def _oriented(form: Array, falling: bool) -> Array:
    """Shape of a variance that increases with the form, or that decreases with it if `falling`."""
    return form.max() * np.eye(form.shape[1]) - form if falling else form


def _variance_ratio(form: Array, residual: Array) -> float:
    """Variance ratio g in I + g W that maximizes the profile likelihood on `GRID`."""
    values, vectors = np.linalg.eigh(form)
    turned = np.einsum("mij,mi->mj", vectors, residual.reshape(values.shape))
    variances = 1.0 + GRID[:, None, None] * np.maximum(values, 0.0)
    costs = residual.size * np.log(np.mean(turned**2 / variances, axis=(1, 2))) + np.log(variances).sum(axis=(1, 2))
    return float(GRID[np.argmin(costs)])


def holm(p: dict[str, float]) -> dict[str, float]:
    """Adjusted p-values by Holm's step-down method (S. Holm, 1979)."""
    adjusted: dict[str, float] = {}
    running = 0.0
    for rank, name in enumerate(sorted(p, key=lambda k: p[k])):
        running = max(running, min(1.0, (len(p) - rank) * p[name]))
        adjusted[name] = running
    return adjusted
