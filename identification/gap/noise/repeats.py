"""Repeated postures: the noise floor, known without a model, and the test of lack of fit against pure error, of a
diagnosis and of an identification."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from identification.arrays import Array
from identification.estimation import Identification
from identification.estimation.plausibility import only_rounding
from identification.estimation.shown import MISFIT
from identification.gap.scatter import Finding
from identification.measurements import POINT, Measurements

# reasons: identification/README.md, "Constants"
LEVEL = 0.01  # convention: of lack of fit that is said
FAR = 0.1  # of the session, between two rows that share no slow error
FEWEST = 4  # degrees of freedom below which a standard deviation is not reported

Groups = NDArray[np.int64]


@dataclass(frozen=True)
class PureError:
    """Scatter of repeats about the mean of their posture.

    squares : sum of squares [mm^2] over all d coordinates;  freedom : its degrees of freedom;  dimension : d
    """

    squares: float
    freedom: int
    dimension: int

    @property
    def rms(self) -> float | None:
        """RMS distance [mm] of one row due to noise alone; None with fewer than `FEWEST` degrees of freedom."""
        return float(np.sqrt(self.dimension * self.squares / self.freedom)) if self.freedom >= FEWEST else None


@dataclass(frozen=True)
class NoiseFloor:
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
        return next((name for name, value in vars(self).items() if value is not None), None)

    @property
    def value(self) -> float | None:
        """The noise floor [mm] from `source`."""
        return None if self.source is None else float(getattr(self, self.source))

    def __str__(self) -> str:
        if self.source is None:
            return "noise floor unknown (no repeats, no sigma_mm)"
        where = {"repeats": "repeats far apart in time", "close_repeats": "repeats close in time", "sigma": "sigma_mm"}
        return f"noise floor {self.value:.4g} mm ({where[self.source]})"

    def to_json(self) -> dict[str, float | str | None]:
        """Keys of `gap` (identification/files/README.md, "JSON keys")."""
        return {
            "noise_floor_mm": self.value,
            "noise_floor_from": self.source,
            "repeats_mm": self.repeats,
            "close_repeats_mm": self.close_repeats,
        }


NOTHING_KNOWN = NoiseFloor()


def far_apart(groups: Groups, time: Array) -> NDArray[np.bool_]:
    """(m,) rows that remain when each repeat within `FAR` of the session after the last kept one is removed.

    groups : (m,) equal numbers mark repeats;  time : (m,) from 0 to 1 over the session
    """
    kept = np.zeros(len(groups), dtype=bool)
    last: dict[int, float] = {}
    for row in np.argsort(time, kind="stable"):
        group, now = int(groups[row]), float(time[row])
        if now - last.get(group, -np.inf) >= FAR:
            kept[row], last[group] = True, now
    return kept


def pure_error(residual: Array, groups: Groups) -> PureError:
    """Pure error of residuals (m, d) [mm] about the means of their groups (m,)."""
    numbers = np.unique(groups, return_inverse=True)[1]
    counts = np.bincount(numbers)
    means = np.stack([np.bincount(numbers, column) for column in residual.T], axis=1) / counts[:, None]
    m, d = residual.shape
    return PureError(float(np.sum((residual - means[numbers]) ** 2)), d * (m - len(counts)), d)


def noise_floor(
    residual: Array, measurements: Measurements, kept: NDArray[np.bool_], sigma: float | None
) -> NoiseFloor:
    """Noise floor from repeats and from the instrument.

    residual : (m, d) [mm] of a fitted model, which removes the effect of small differences between repeated postures
    kept : (m,) rows that are no outliers;  sigma : of the arm file [mm], None: unknown
    """
    groups, time = repeats_in_time(measurements, kept)
    far, points = far_apart(groups, time), residual[kept, POINT]
    stretch = np.floor(time / FAR).astype(np.int64)
    if measurements.sigma is not None:
        sigma = float(np.sqrt(np.mean(measurements.sigma[kept] ** 2)))
    return NoiseFloor(
        pure_error(points[far], groups[far]).rms,
        pure_error(points, groups * (stretch.max() + 1) + stretch).rms,
        None if sigma is None else sigma * float(np.sqrt(points.shape[1])),
    )


def repeats_in_time(measurements: Measurements, kept: NDArray[np.bool_]) -> tuple[Groups, Array]:
    """`repeat_numbers` of the kept rows (m,), and the time from 0 to 1 over the session."""
    time = measurements.conditions.time
    assert time is not None  # measurements know it
    return measurements.repeat_numbers[kept], time[kept] + 0.5


def repeat_finding(
    residual: Array, rank: int, measurements: Measurements, kept: NDArray[np.bool_]
) -> tuple[Finding, ...]:
    """F test of lack of fit against pure error, where postures were repeated: a fast ripple resembles noise, but it
    repeats.

    F = (lack of fit / its degrees of freedom) / (scatter of the repeats about their means / its degrees of freedom),
    over repeats far apart in time if there are enough. Empty if not significant at `LEVEL`.

    residual : (m, d) [mm] of a fitted model of this rank;  kept : (m,) rows that are no outliers
    """
    groups, time = repeats_in_time(measurements, kept)
    far = far_apart(groups, time)
    if pure_error(residual[kept][far], groups[far]).rms is None:
        far[:] = True
    left, groups = residual[kept][far], groups[far]
    pure = pure_error(left, groups)
    fit_freedom = left.size - pure.freedom - rank
    if pure.rms is None or fit_freedom < 1 or pure.squares == 0.0:
        return ()
    excess = (float(np.sum(left**2)) - pure.squares) / fit_freedom / (pure.squares / pure.freedom)
    p = float(fdtrc(fit_freedom, pure.freedom, excess))
    return (Finding("repeats", p, excess),) if p <= LEVEL else ()


def beyond_repeats(found: Identification, measurements: Measurements) -> str | None:
    """That residuals of a fit to these rows scatter more than repeats of one posture, in a sentence; None where they do
    not, where nothing is repeated, and where chi2 says it already or the data have no noise."""
    left = found.residuals_after
    if found.misfit is not None or found.dof <= 0 or only_rounding(left, measurements):
        return None
    kept = ~np.isin(np.arange(len(left)) + 1, found.outlier_rows)
    if not repeat_finding(left, left.size - found.dof, measurements, kept):
        return None
    floor = noise_floor(left, measurements, kept, None)
    if floor.value is None or found.scatter is None:
        return None
    repeats = floor.value / float(np.sqrt(left[:, POINT].shape[1]))
    times, figures = found.scatter / repeats, f"{found.scatter:.3g} mm per axis, not {repeats:.3g} mm"
    scatter = f"{MISFIT} {times:.2g} times as much as repeats of one posture ({figures})"
    hidden = "what that does to the parameters is not in their intervals"
    return f"{scatter}: the model misses an effect, and {hidden}; armcal diagnose looks for it"


def with_repeats_doubted(found: Identification, measurements: Measurements) -> Identification:
    """The same fit, `beyond_repeats` the first of its doubts."""
    said = beyond_repeats(found, measurements)
    return found if said is None else replace(found, doubts=(said, *found.doubts))
