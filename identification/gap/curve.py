"""`Curve`: the error curve of a joint, where no name fits: the function, its uncertainty, and its shape in words.

A curve with standard deviation s(q) at angles q is compared with waves and with a step by weighted least squares beside
a constant. A shape describes the curve if it explains `SHAPED` of its weighted variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from identification.arm import EffectSpec
from identification.arrays import Array
from identification.error_curve import ErrorCurve
from identification.information import VISIBLE

SHAPED = 0.8  # convention: of a curve's variance, that makes a shape its name; nothing else depends on it
MOST_WAVES = 6  # that are listed; derived: each explains at least a sixth of what `SHAPED` allows to lack
COLUMNS = ("angle_deg", "correction_deg", "std_deg", "error_deg")


class Wave(NamedTuple):
    """The wave amplitude cos(order q - phase), an entry of `waves` (identification/files/README.md, "JSON keys").

    order : periods per turn;  orders : lowest and highest not distinguishable from it within the measured range
    share : fraction of the curve's weighted variance explained beside the waves before it
    """

    order: float
    orders: tuple[float, float]
    amplitude_deg: float
    phase_deg: float
    share: float

    def __str__(self) -> str:
        lowest, highest = self.orders
        span = f" ({lowest:.3g} to {highest:.3g})" if highest - lowest >= 0.5 else ""
        return f"{self.order:g}{span} per turn, {self.amplitude_deg:.2g} deg"


@dataclass(frozen=True)
class Curve:
    """The error of a joint, real less commanded angle, over the range of the measured angles.

    joint : from 1;  table : the function;  std : (a,) standard deviations of its values at `angles` [rad], beside the
        geometry that is written with it
    """

    joint: int
    table: ErrorCurve
    std: Array

    @property
    def angles(self) -> Array:
        """(a,) every half node [rad]."""
        return np.linspace(self.table.start, self.table.stop, len(self.std))

    @property
    def error(self) -> Array:
        """(a,) values of the function [rad]."""
        return self.table.at(self.angles)

    @property
    def key(self) -> str:
        """`joint_error_curve:1`"""
        return self.spec.key

    @property
    def spec(self) -> EffectSpec:
        """The effect as an entry of an arm file."""
        return EffectSpec("joint_error_curve", self.joint, curve=self.table)

    @property
    def correction(self) -> Array:
        """(a,) correction to be added to the command so that the joint reaches `angles` [rad]."""
        added = -self.error
        for _ in range(3):  # the error at the corrected command; slopes are far below one
            added = -self.table.at(self.angles + added)
        return added

    @cached_property
    def waves(self) -> tuple[Wave, ...]:
        """The waves that it consists of, strongest first."""
        return waves(self.angles, self.error, self.std)

    @property
    def shape(self) -> str:
        """Description of its shape."""
        return shape_text(self.angles, self.error, self.std, self.waves)

    def table_rows(self) -> list[tuple[float, ...]]:
        """Rows of `--curves`: joint, then angle, correction, standard deviation and error [deg]."""
        columns = np.degrees([self.angles, self.correction, self.std, self.error])
        return [(self.joint, *(round(float(v), 7) for v in row)) for row in columns.T]

    def to_json(self) -> dict[str, Any]:
        """An entry of `curves` (identification/files/README.md, "JSON keys")."""
        columns = list(zip(*self.table_rows(), strict=True))[1:]
        return {
            "joint": self.joint,
            "from_deg": float(np.degrees(self.table.start)),
            "to_deg": float(np.degrees(self.table.stop)),
            "length_deg": float(np.degrees(self.table.spacing)),
            "shape": self.shape,
            "waves": [wave._asdict() for wave in self.waves],
            **{name: list(column) for name, column in zip(COLUMNS, columns, strict=True)},
        }


def curves_text(curves: Sequence[Curve]) -> str:
    """The CSV table of `armcal diagnose --curves`: the correction of the commanded angle at every half node."""
    rows = [row for curve in curves for row in curve.table_rows()]
    return "".join(",".join(map(str, line)) + "\n" for line in (("joint", *COLUMNS), *rows))


def waves(angles: Array, error: Array, std: Array) -> tuple[Wave, ...]:
    """The waves that make up most of a curve, strongest first: added one by one, all refitted after each.

    angles, error, std : (a,) of the curve [rad]

    Whole numbers of periods per turn are tried, up to the Nyquist limit of nodes at every other angle.
    Orders that differ by less than one period over the range are not distinguished.
    """
    half = np.pi / float(np.ptp(angles))  # orders that differ by less part by less than half a period over the range
    tried = np.arange(max(1.0, np.ceil(half)), half * (len(angles) - 1) / 2.0)

    def fitted(orders: Sequence[float]) -> tuple[float, Array]:
        return _fitted([wave(k * angles) for k in orders for wave in (np.cos, np.sin)], error, std)

    chosen: list[float] = []
    left = [fitted(())[0]]
    while left[0] > 0.0 and len(tried) and len(chosen) < MOST_WAVES:
        trials = [fitted((*chosen, k))[0] for k in tried]
        best = int(np.argmin(trials))
        if left[-1] - trials[best] < (1.0 - SHAPED) / MOST_WAVES * left[0]:
            break
        chosen.append(float(tried[best]))
        left.append(trials[best])
        tried = tried[np.abs(tried - chosen[-1]) >= 2.0 * half]
    listed = []
    for k, (a, b), gain in zip(chosen, fitted(chosen)[1].reshape(-1, 2), -np.diff(left), strict=True):
        amplitude, phase = np.degrees([np.hypot(a, b), np.arctan2(b, a)]).tolist()
        listed.append(Wave(k, (max(k - half, 0.0), k + half), amplitude, phase, float(gain / left[0])))
    return tuple(listed)


def shape_text(angles: Array, error: Array, std: Array, parts: Sequence[Wave]) -> str:
    """Description of a curve in words, by name or by its waves."""
    where = f"over {np.degrees(angles[0]):.0f} to {np.degrees(angles[-1]):.0f} deg"
    share, whole = sum(wave.share for wave in parts), _fitted([], error, std)[0]
    steps = [_fitted([np.sign(angles - at)], error, std) for at in (angles[1:] + angles[:-1]) / 2.0]
    best = min(range(len(steps)), key=lambda k: steps[k][0])
    if whole > 0.0 and 1.0 - steps[best][0] / whole >= max(SHAPED, share):
        at, size = np.degrees([angles[best : best + 2].mean(), 2.0 * steps[best][1][0]])
        return f"step of {size:.2g} deg at {at:.0f} deg {where}"
    if not parts:
        return f"smooth curve {where}"
    amplitudes = {wave.order: wave.amplitude_deg for wave in parts}
    first = min(amplitudes)  # a sawtooth has waves of orders k, 2k, 3k with amplitudes as 1, 1/2, 1/3
    ratios = [amplitudes.get(n * first, 0.0) * n / amplitudes[first] for n in (2, 3)]
    if share >= SHAPED and np.allclose(ratios, 1.0, atol=1.0 / 3.0):
        return f"sawtooth, {first:g} per turn, {where}"
    listed = "; ".join(map(str, parts))
    return f"{'waves' if share >= SHAPED else 'in part waves'}: {listed} ({100.0 * share:.0f} %) {where}"


def _fitted(columns: Sequence[Array], error: Array, std: Array) -> tuple[float, Array]:
    """Weighted squares that a fit of functions (a,) beside a constant leaves of a curve, and their coefficients."""
    weights = 1.0 / np.maximum(std, 1e-3 * float(np.max(std)) + 1e-150)
    table = np.column_stack([np.ones(len(error)), *columns]) * weights[:, None]
    values = np.linalg.lstsq(table, error * weights, rcond=VISIBLE)[0]
    return float(np.sum((error * weights - table @ values) ** 2)), np.asarray(values[1:])
