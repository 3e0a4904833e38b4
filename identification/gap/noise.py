"""The noise: its components, each with a marginal likelihood, and what is known of it without a model.

A sigma from a data sheet may be too small, so that only a sigma of the rows and repeats have a say in the verdict.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import chdtrc

from identification.arrays import Array
from identification.documents.identification import MISFIT
from identification.estimation import Identification
from identification.estimation.doubts import only_rounding
from identification.estimation.uncertainty import LEVEL, lack_of_fit, pure_error
from identification.gap.fit import Fitted, Rows
from identification.gap.likelihood import orthonormal
from identification.measurements import POINT, Measurements

UNEVEN = 0.05  # prior probability of each kind of noise that is not white
LASTING = 5e-4  # the same where it lasts as a drift does; with less, such noise is called a drift now and then
RATIOS = (0.5, 2.0, 8.0, 32.0)  # of the further variance to the white one; numerical: likelihoods are flat over a step
CORRELATIONS = (0.2, 0.4, 0.6, 0.8, 0.95)  # of one row with the next; numerical, as `RATIOS`
APART = 0.1  # convention: of the session, between two rows that share no slow error
# derived: degrees of freedom below which nothing is tested, and no standard deviation reported, since it would be
# uncertain by more than 35 %. At the level 0.005 an effect of one parameter needs lambda = 11 with 4, 22 with 3
SPARE = 4

Kept = NDArray[np.bool_]  # (m,) rows that are no outliers


# -- components --------------------------------------------------------------------------------------------------------
class NoiseModel(NamedTuple):
    """A covariance of the rows.

    name : `joint_noise:j`, `reach_noise`, `time_noise`, `serial_correlation`, `repeats`, empty: white
    size : ratio of the additional to the common variance (at the mean posture), negative where it falls with time; or
        the correlation
    prior : log probability
    """

    name: str
    size: float
    rows: Rows
    prior: float


class Finding(NamedTuple):
    """A property of the noise, as of `NoiseModel`;  p : probability that it is not there"""

    name: str
    p: float
    size: float


def noises(at: Fitted) -> Iterator[NoiseModel]:
    """White noise, and every other that these rows can have, at a fitted model."""
    rows, (position, _) = at.rows, at.linearized
    m, d = position.shape
    # name -> (m, d, d) shape of the additional covariance, with mean trace d
    levers = enumerate(np.moveaxis(at.levers, 2, 0), start=1)
    shapes = {f"joint_noise:{j}": lever[:, :, None] * lever[:, None, :] for j, lever in levers}
    if not at.model.arm.chain.instrument.contact:  # else nothing says how far away the point is
        shapes["reach_noise"] = np.sum(position**2, axis=1)[:, None, None] * np.eye(d)
    time = rows.conditions.time if rows.conditions.time is not None else np.zeros(m)
    shapes["time_noise"] = (time - time.min() + 1e-9)[:, None, None] * np.eye(d)
    traces = {name: float(np.einsum("mii->", shape)) for name, shape in shapes.items()}
    forms = {name: shape * (d * m / traces[name]) for name, shape in shapes.items() if traces[name] > 0.0}
    joints = sum(name.startswith("joint") for name in forms)
    yield NoiseModel("", 0.0, rows, 0.0)
    for name, form in forms.items():
        signs = (1.0, -1.0) if name == "time_noise" else (1.0,)
        kinds = (joints if name.startswith("joint") else 1) * len(RATIOS) * len(signs)
        for sign in signs:
            values, vectors = np.linalg.eigh(form if sign > 0.0 else form.max() * np.eye(d) - form)
            for ratio in RATIOS:
                deviations = np.sqrt(1.0 + ratio * np.maximum(values, 0.0))
                spread = vectors * deviations[:, None, :] @ vectors.transpose(0, 2, 1)
                more = replace(rows, spread=spread if rows.spread is None else rows.spread @ spread)
                yield NoiseModel(name, sign * ratio, more, float(np.log(UNEVEN / kinds)))
    for rho in CORRELATIONS:
        # errors that stay alike for a fifth of the session are likelier a drift, which is a block of time
        prior = float(np.log((UNEVEN if (1.0 - rho) * m >= 5.0 else LASTING) / len(CORRELATIONS)))
        yield NoiseModel("serial_correlation", rho, replace(rows, correlation=rho), prior)
    if rows.posture_numbers.max() + 1 < m:
        for ratio in RATIOS:
            yield NoiseModel("repeats", ratio, replace(rows, shared=ratio), float(np.log(0.5 / len(RATIOS))))


def log_likelihoods(models: Sequence[NoiseModel], left: Array, base: Array, columns: Array, sizes: Array) -> Array:
    """(K,) of covariances, up to a constant: restricted ones (H. D. Patterson, R. Thompson, 1971), in which columns
    have normal coefficients.

    left : (m, d) residuals [mm];  base : (m, d, g) columns of free parameters;  columns : (m, d, p);  sizes : (p,) of
    them, standard deviations of their coefficients in units of the noise
    """
    tall = base.reshape(left.size, -1)
    free = (tall @ orthonormal(tall.T @ tall)).reshape(*left.shape, -1)
    table = np.concatenate([free, columns, left[:, :, None]], axis=2)
    precision = np.concatenate([np.zeros(free.shape[2]), sizes**-2.0])
    costs = []
    for model in models:
        white = model.rows.whiten(table)
        root = np.linalg.cholesky(white[:, :-1].T @ white[:, :-1] + np.diag(precision))
        scores = solve_triangular(root, white[:, :-1].T @ white[:, -1], lower=True)
        squares = max(float(white[:, -1] @ white[:, -1] - scores @ scores), 1e-300)
        volume = model.rows.log_determinant + 2.0 * float(np.sum(np.log(np.diag(root))))
        costs.append((len(white) - free.shape[2]) * np.log(squares) + volume)
    return -0.5 * np.array(costs)


# -- without a model ---------------------------------------------------------------------------------------------------
class NoiseFloor(NamedTuple):
    """RMS distances [mm] that no model of the mean can go below; None where not available.

    repeats : from repeats far apart in time;  close_repeats : from repeats close in time, which share slow errors
    sigma : from the given noise of the instrument, for all coordinates together
    """

    repeats: float | None = None
    close_repeats: float | None = None
    sigma: float | None = None

    @property
    def source(self) -> str | None:
        """Source of the floor: the most reliable one available, None without any."""
        return next((name for name, value in self._asdict().items() if value is not None), None)

    @property
    def value(self) -> float | None:
        """The noise floor [mm] from `source`."""
        return next((value for value in self if value is not None), None)

    def to_json(self) -> dict[str, float | str | None]:
        """Keys of `gap` (identification/files/README.md, "JSON keys")."""
        repeats = {"repeats_mm": self.repeats, "close_repeats_mm": self.close_repeats}
        return {"noise_floor_mm": self.value, "noise_floor_from": self.source, **repeats}


class Misfit(NamedTuple):
    """Chi-square test of residuals against a given sigma (entry `misfit` of identification/files/README.md, "JSON
    keys").

    chi2 : sum of squares in units of that sigma;  dof : its degrees of freedom
    p_value : of a chi2 at least this large if model and sigma are right
    ratio : of the residuals' standard deviation to the sigma
    """

    chi2: float
    dof: int
    p_value: float
    ratio: float

    @property
    def significant(self) -> bool:
        """True if the residuals are larger than noise of the given sigma explains, at `LEVEL`."""
        return self.p_value <= LEVEL


def misfit(residual: Array, rank: int, measurements: Measurements, sigma: float | None, kept: Kept) -> Misfit | None:
    """Test residuals (m, d) [mm] of a model of this rank; None where neither the rows nor the arm file give a sigma.

    sigma : of the arm file [mm]
    """
    given = sigma if measurements.sigma is None else measurements.sigma[kept, None]
    freedom = residual[kept].size - rank
    if given is None or freedom <= 0:
        return None
    chi2 = float(np.sum((residual[kept] / given) ** 2))
    return Misfit(chi2, freedom, float(chdtrc(freedom, chi2)), float(np.sqrt(chi2 / freedom)))


def noise_floor(residual: Array, measurements: Measurements, kept: Kept, sigma: float | Array | None) -> NoiseFloor:
    """Noise floor from repeats and from the instrument.

    residual : (m, d) [mm] of a fitted model, which removes the effect of small differences between repeated postures
    sigma : of all rows or of each that is kept [mm], None: repeats alone
    """
    groups, time, far = _repeats_in_time(measurements, kept)
    points, stretch = residual[kept, POINT], np.floor(time / APART).astype(np.int64)
    floors: list[float | None] = []
    for left, repeats in (points[far], groups[far]), (points, groups * (stretch.max() + 1) + stretch):
        squares, freedom = pure_error(left, repeats)
        floors.append(float(np.sqrt(left.shape[1] * squares / freedom)) if freedom >= SPARE else None)
    instrument = None if sigma is None else float(np.sqrt(points.shape[1] * np.mean(np.square(sigma))))
    return NoiseFloor(floors[0], floors[1], instrument)


def _repeats_in_time(measurements: Measurements, kept: Kept) -> tuple[NDArray[np.int64], Array, Kept]:
    """Of the kept rows (m,) their `repeat_numbers`, the time from 0 to 1 over the session, and which of them remain
    when each repeat within `APART` of the last one that remains is removed."""
    assert measurements.conditions.time is not None  # measurements know it
    groups, time = measurements.repeat_numbers[kept], measurements.conditions.time[kept] + 0.5
    far, last = np.zeros(len(groups), dtype=bool), dict[int, float]()
    for row in np.argsort(time, kind="stable").tolist():
        if time[row] - last.get(groups[row], -np.inf) >= APART:
            far[row], last[groups[row]] = True, time[row]
    return groups, time, far


def repeat_finding(residual: Array, rank: int, measurements: Measurements, kept: Kept) -> tuple[Finding, ...]:
    """F test of lack of fit against the scatter of repeats: a fast ripple resembles noise, but it repeats.

    It is over repeats far apart in time if there are enough. Empty if not significant at `LEVEL`.

    residual : (m, d) [mm] of a fitted model of this rank
    """
    groups, _, far = _repeats_in_time(measurements, kept)
    left = residual[kept]
    for rows in (far, np.ones_like(far)):
        if pure_error(left[rows], groups[rows])[1] >= SPARE:
            excess, p = lack_of_fit(left[rows], groups[rows], rank)
            return (Finding("repeats", p, excess),) if p <= LEVEL else ()
    return ()


def with_repeats_doubted(identified: Identification, measurements: Measurements) -> Identification:
    """The fit with a first doubt if its residuals scatter more than repeats of one posture: the same where nothing is
    repeated, and where chi2 says it already or the data have no noise."""
    left, known = identified.residuals_after, identified.scatter
    is_exact = bool(only_rounding(left, identified.model, measurements))
    if identified.misfit is not None or identified.dof <= 0 or known is None or is_exact:
        return identified
    kept = ~np.isin(np.arange(len(left)) + 1, identified.outlier_rows)
    floor = noise_floor(left, measurements, kept, None).value
    if floor is None or not repeat_finding(left, left.size - identified.dof, measurements, kept):
        return identified
    repeats = floor / float(np.sqrt(left[:, POINT].shape[1]))
    scatter = f"{MISFIT} {known / repeats:.2g} times as much as repeats of one posture ({known:.3g} mm per coordinate, "
    hidden = "what that does to the parameters is not in their intervals"
    doubt = f"{scatter}not {repeats:.3g} mm): the model misses an effect, and {hidden}; armcal diagnose looks for it"
    return replace(identified, doubts=(doubt, *identified.doubts))
