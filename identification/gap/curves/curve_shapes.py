"""Describe the shape of an error curve: a few waves, a sawtooth, a step, or just a smooth curve.

A curve with standard deviation s(q) at angles q is compared with each shape by weighted least squares beside a
constant. A shape describes the curve if it explains most of its weighted variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from identification.arrays import Array

# reasons: identification/README.md, "Constants"
MOST_WAVES, SAID = 6, 3  # number of waves listed, and of those in the text
LEAST_SHARE = 0.03  # of the curve's variance, of each
NAMED_SHARE = 0.8  # of the variance, that makes a shape the curve's name
HARMONICS = 0.35  # deviation of a sawtooth's harmonics from 1, 1/2, 1/3


@dataclass(frozen=True)
class Wave:
    """The wave amplitude cos(order q - phase).

    order : periods per turn;  lowest, highest : orders not distinguishable from it within the measured range
    amplitude, phase : [rad];  share : fraction of the curve's weighted variance explained beside the waves before it
    """

    order: float
    lowest: float
    highest: float
    amplitude: float
    phase: float
    share: float

    def __str__(self) -> str:
        span = f" ({self.lowest:.3g} to {self.highest:.3g})" if self.highest - self.lowest >= 0.5 else ""
        return f"{self.order:g}{span} per turn, {np.degrees(self.amplitude):.2g} deg"

    def to_json(self) -> dict[str, Any]:
        """An entry of `waves` (identification/files/README.md, "JSON keys")."""
        return {
            "order": self.order,
            "orders": [self.lowest, self.highest],
            "amplitude_deg": float(np.degrees(self.amplitude)),
            "phase_deg": float(np.degrees(self.phase)),
            "share": self.share,
        }


def waves(angles: Array, error: Array, std: Array) -> tuple[Wave, ...]:
    """The waves that make up most of a curve, strongest first: added one by one, all refitted after each.

    angles, error, std : (a,) of the curve [rad]

    Whole numbers of periods per turn are tried, up to the Nyquist limit of nodes at every other angle.
    Orders that differ by less than one period over the range are not distinguished.
    """
    weights = 1.0 / np.maximum(std, 1e-3 * float(np.max(std)) + 1e-300)
    width = float(np.ptp(angles))
    half = np.pi / width  # orders that differ by less part by less than half a period over the range
    tried = np.arange(max(1.0, np.ceil(half)), half * (len(angles) - 1) / 2.0)
    total = _left(angles, error, weights, ())
    chosen: list[float] = []
    lefts = [total]
    while len(chosen) < MOST_WAVES and total > 0.0:
        apart = [all(abs(k - other) >= 2.0 * half for other in chosen) for k in tried]
        if not any(apart):
            break
        tried = tried[apart]
        trials = [_left(angles, error, weights, (*chosen, k)) for k in tried]
        best = int(np.argmin(trials))
        if (lefts[-1] - trials[best]) / total < LEAST_SHARE:
            break
        chosen.append(float(tried[best]))
        lefts.append(trials[best])
    shares = -np.diff(lefts) / total if total > 0.0 else np.zeros(0)
    coefficients = _solved(angles, error, weights, chosen)[1:].reshape(-1, 2)
    return tuple(
        Wave(k, max(k - half, 0.0), k + half, float(np.hypot(a, b)), float(np.arctan2(b, a)), float(share))
        for k, (a, b), share in zip(chosen, coefficients, shares, strict=True)
    )


def shape_text(angles: Array, error: Array, std: Array, found: Sequence[Wave]) -> str:
    """Description of a curve in words, by name or by its waves."""
    where = f"over {np.degrees(angles[0]):.0f} to {np.degrees(angles[-1]):.0f} deg"
    step = _step(angles, error, std)
    share = sum(wave.share for wave in found)
    if step is not None and step[1] >= max(NAMED_SHARE, share):
        return f"step of {np.degrees(step[2]):.2g} deg at {np.degrees(step[0]):.0f} deg {where}"
    if not found:
        return f"smooth curve {where}"
    if (period := _sawtooth(found)) is not None and share >= NAMED_SHARE:
        return f"sawtooth, {period:g} per turn, {where}"
    rest = f" and {len(found) - SAID} more" if len(found) > SAID else ""
    listed = "; ".join(str(wave) for wave in found[:SAID]) + rest
    return f"{'waves' if share >= NAMED_SHARE else 'in part waves'}: {listed} ({100.0 * share:.0f} %) {where}"


def _sawtooth(found: Sequence[Wave]) -> float | None:
    """Fundamental order k if waves of orders k, 2k, 3k have amplitudes in the ratio 1, 1/2, 1/3; else None."""
    by_order = {wave.order: wave.amplitude for wave in found}
    first = min(by_order)
    wanted = [first * n for n in (1, 2, 3)]
    if not all(order in by_order for order in wanted):
        return None
    ratios = [by_order[order] * n / by_order[first] for n, order in enumerate(wanted, start=1)]
    return first if all(abs(ratio - 1.0) <= HARMONICS for ratio in ratios) else None


def _step(angles: Array, error: Array, std: Array) -> tuple[float, float, float] | None:
    """Angle of the best step, fraction of the variance that it explains, and its size; None without variance."""
    weights = 1.0 / np.maximum(std, 1e-3 * float(np.max(std)) + 1e-300) ** 2
    mean = np.average(error, weights=weights)
    total = float(np.sum(weights * (error - mean) ** 2))
    if total == 0.0:
        return None
    below, sums = np.cumsum(weights)[:-1], np.cumsum(weights * (error - mean))[:-1]
    above = weights.sum() - below
    explained = sums**2 * (1.0 / below + 1.0 / above)
    k = int(np.argmax(explained))
    size = -sums[k] * (1.0 / below[k] + 1.0 / above[k])
    return float((angles[k] + angles[k + 1]) / 2.0), float(explained[k] / total), float(size)


def _columns(angles: Array, orders: Sequence[float]) -> Array:
    waves_of = [wave(k * angles) for k in orders for wave in (np.cos, np.sin)]
    return np.column_stack([np.ones(len(angles)), *waves_of])


def _solved(angles: Array, error: Array, weights: Array, orders: Sequence[float]) -> Array:
    columns = _columns(angles, orders)
    return np.asarray(np.linalg.lstsq(columns * weights[:, None], error * weights, rcond=1e-6)[0])


def _left(angles: Array, error: Array, weights: Array, orders: Sequence[float]) -> float:
    """Residual weighted sum of squares of waves of these orders beside a constant."""
    rest = error - _columns(angles, orders) @ _solved(angles, error, weights, orders)
    return float(np.sum((rest * weights) ** 2))
