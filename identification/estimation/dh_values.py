"""The corrected Denavit-Hartenberg table with intervals: a complete set of values, none of which is arbitrary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.estimation.corrected_values import STEP, CorrectedValue
from identification.estimation.intervals import freedom_of, quantile_95
from identification.kinematics.corrected import corrected
from identification.kinematics.corrected_dh import Link, corrected_links, drawn_links
from identification.kinematics.corrected_geometry import CorrectedGeometry
from identification.kinematics.denavit_hartenberg import STANDARD, DHRow
from identification.kinematics.spatial import SpatialChain
from identification.model import Model

if TYPE_CHECKING:
    from identification.estimation.result import Identification

UNITS = {"theta": "deg", "d": "mm", "a": "mm", "alpha": "deg", "beta": "deg"}
MEANING = {
    "theta": "offset: what joint {j} adds to its reading, in the table",
    "d": "along the axis of joint {j}",
    "a": "between the axes of joints {j} and {k}",
    "alpha": "between the axes of joints {j} and {k}",
    "beta": "turn about the new y axis after alpha (Hayati), as axes {j} and {k} are nearly parallel; d stays as drawn",
}


class Calibrated(NamedTuple):
    """A geometry that was found: `names` (p,) with covariance (p, p) and degrees of freedom (p,), units by name."""

    geometry: CorrectedGeometry
    names: Sequence[str]
    covariance: Array
    freedom: Array
    units: Mapping[str, str]

    @classmethod
    def of(cls, fit: Identification) -> Calibrated:
        """As a fit in space found it."""
        assert fit.geometry is not None
        units = {p.name: p.unit for p in fit.model.geometry_parameters}
        return cls(fit.geometry, fit.names, fit.covariance, fit.uncertainty.freedom, units)

    @classmethod
    def of_arm(cls, arm: Arm) -> Calibrated | None:
        """As a spatial arm's file has it; None without a calibration and its covariance."""
        if (calibration := arm.calibration) is None or arm.chain.planar or calibration.covariance is None:
            return None
        model = Model(arm)
        geometry = CorrectedGeometry(arm.chain, {**model.fixed, **calibration.values})
        units = {p.name: p.unit for p in model.geometry_parameters}
        return cls(geometry, calibration.parameter_names, calibration.covariance, freedom_of(calibration), units)


def dh_values(calibrated: Calibrated, rows: Sequence[DHRow], convention: str = STANDARD) -> tuple[CorrectedValue, ...]:
    """Nominal and corrected numbers of the links between the axes, those as drawn by definition left out.

    rows, convention : of the arm's drawing. Standard deviations by first derivatives of the covariance; a and alpha of
    the modified convention stand in the row of the next joint. Raises `InputError` as `drawn_links`.
    """
    geometry, drawn = calibrated.geometry, drawn_links(rows, convention)
    start, names = dict(geometry.values), calibrated.names
    numbers, nominal = _numbers(geometry.chain, start, drawn), _flat(drawn)
    slopes = np.zeros((len(names), len(numbers)))
    # effects, hundreds with the library, are not in the table
    for row, name in ((row, name) for row, name in enumerate(names) if name in calibrated.units):
        step = STEP.get(calibrated.units[name], 1e-6)
        up, down = (_numbers(geometry.chain, {**start, name: start[name] + s * step}, drawn) for s in (1.0, -1.0))
        slopes[row] = [(up[key] - down[key]) / (2.0 * step) for key in numbers]
    deviations = np.sqrt(np.einsum("pk,pq,qk->k", slopes, calibrated.covariance, slopes).clip(min=0.0))
    half = float(np.min(quantile_95(calibrated.freedom))) if len(names) else np.nan
    shown = []
    for (key, value), std in zip(numbers.items(), deviations.tolist(), strict=True):
        joint, name = key
        row_number = joint + (convention != STANDARD and name in ("a", "alpha", "beta"))
        meaning = MEANING[name].format(j=joint, k=joint + 1)
        figures = (nominal[key], value, std, value - half * std, value + half * std)
        shown.append(CorrectedValue(f"row {row_number} {name}", None, *figures, UNITS[name], meaning))
    return tuple(shown)


def dh_places(calibrated: Calibrated, rows: Sequence[DHRow], convention: str = STANDARD) -> list[tuple[str, Array]]:
    """Beside the values of `dh_values`: the pose of the base (4, 4), and places (3,) of the measured points for the
    last frame of the table, by name. With them the table says what the fit does."""
    drawn, real = drawn_links(rows, convention), calibrated.geometry.real
    links, nominal = corrected_links(real, drawn), corrected_links(calibrated.geometry.chain, drawn)
    base = real.base @ links.first @ np.linalg.inv(nominal.first)
    behind = np.linalg.inv(nominal.last) @ links.last
    tools = [(f"tool {name}", behind[:3, :3] @ place + behind[:3, 3]) for name, place in real.tools.items()]
    return [("base", base), *tools]


def _numbers(chain: SpatialChain, values: Mapping[str, float], drawn: Sequence[Link]) -> dict[tuple[int, str], float]:
    """Joint and name -> number of the corrected table [mm, deg]."""
    return _flat(corrected_links(corrected(chain, values), drawn).links)


def _flat(links: Sequence[Link]) -> dict[tuple[int, str], float]:
    """The numbers that are free: of the first joint theta and d belong to the base, of parallel axes d is as drawn."""
    numbers = {}
    for j, link in enumerate(links, start=1):
        names = ["a", "alpha"] if j == 1 else ["theta", "d", "a", "alpha"]
        names = [name for name in names if name != "d" or link.beta is None] + (
            ["beta"] if link.beta is not None else []
        )
        for name in names:
            value = float(getattr(link, name))
            numbers[j, name] = value if UNITS[name] == "mm" else float(np.degrees(value))
    return numbers
