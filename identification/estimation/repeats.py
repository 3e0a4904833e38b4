"""What is known of the noise without a model: the scatter of repeats of one posture, and a sigma that is given."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from identification.arrays import Array
from identification.documents.identification import MISFIT
from identification.estimation.doubts import SPARE, only_rounding
from identification.estimation.result import Identification
from identification.estimation.uncertainty import LEVEL, lack_of_fit, pure_error
from identification.measurements import POINT, Measurements

APART = 0.1  # convention: of the session, between two rows that share no slow error

Kept = NDArray[np.bool_]  # (m,) rows that are no outliers


class Finding(NamedTuple):
    """A property of the noise: its name, and size (`gap.noise.NoiseModel`);  p : probability that it is not there"""

    name: str
    p: float
    size: float


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
    significant : whether they are larger than noise of that sigma explains, at `LEVEL`
    """

    chi2: float
    dof: int
    p_value: float
    ratio: float
    significant: bool


def misfit(residual: Array, rank: int, measurements: Measurements, sigma: float | None, kept: Kept) -> Misfit | None:
    """Test residuals (m, d) [mm] of a model of this rank; None where neither the rows nor the arm file give a sigma.

    sigma : of the arm file [mm]
    """
    given = sigma if measurements.sigma is None else measurements.sigma[kept, None]
    freedom = residual[kept].size - rank
    if given is None or freedom <= 0:
        return None
    chi2 = float(np.sum((residual[kept] / given) ** 2))
    p_value = float(chdtrc(freedom, chi2))
    return Misfit(chi2, freedom, p_value, float(np.sqrt(chi2 / freedom)), p_value <= LEVEL)


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

    It is over repeats far apart in time: in reads without a new approach the arm's own scatter, too, is the same.
    Empty if not significant at `LEVEL`.

    residual : (m, d) [mm] of a fitted model of this rank
    """
    groups, _, far = _repeats_in_time(measurements, kept)
    left, groups = residual[kept][far], groups[far]
    if pure_error(left, groups)[1] < SPARE:
        return ()
    excess, p = lack_of_fit(left, groups, rank)
    return (Finding("repeats", p, excess),) if p <= LEVEL else ()


def with_repeats_doubted(identified: Identification, measurements: Measurements) -> Identification:
    """The fit with a first doubt if its residuals scatter more than repeats of one posture: the same where nothing is
    repeated, and where chi2 says it already or the data have no noise."""
    left, scatter = identified.residuals_after, identified.scatter
    is_exact = bool(only_rounding(left, identified.model, measurements))
    if identified.misfit is not None or identified.dof <= 0 or scatter is None or is_exact:
        return identified
    kept = ~np.isin(np.arange(len(left)) + 1, identified.outlier_rows)
    floor = noise_floor(left, measurements, kept, None).value
    if floor is None or not repeat_finding(left, left.size - identified.dof, measurements, kept):
        return identified
    repeats = floor / float(np.sqrt(left[:, POINT].shape[1]))
    times = f"{scatter / repeats:.2g} times as much as repeats of one posture"
    figures = f"({scatter:.3g} mm per coordinate, not {repeats:.3g} mm)"
    hidden = "its influence on the parameters is not in their intervals"
    doubt = f"{MISFIT} {times} {figures}: the model lacks an effect, and {hidden}; armcal diagnose looks for it"
    return replace(identified, doubts=(doubt, *identified.doubts))
