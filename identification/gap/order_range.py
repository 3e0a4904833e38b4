"""Find named waves whose order the range of their joint does not determine: a shape, not a cause.

Over a range of W rad two waves whose orders differ by less than 2 pi / W drift apart by less than one period, and
beside other waves they cannot be separated. Where even the next whole order has nearly the same columns, the named
order is one of many that fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array
from identification.effects import Effect
from identification.gap.fit import Fit, Rows
from identification.gap.hypotheses.detectability import NEAR, VISIBLE
from identification.information import column_space

FIXED_ORDERS = {"encoder_eccentricity": 1.0, "encoder_second_harmonic": 2.0}
ORDER = "k"  # the setting that says the order of every other wave


@dataclass(frozen=True)
class OrderRange:
    """A named wave with an undetermined order.

    low, high : range of the joint's angle [rad];  lowest, highest : range of the whole orders that fit [per turn]
    """

    effect: str
    joint: int
    low: float
    high: float
    lowest: int
    highest: int

    def __str__(self) -> str:
        return f"{self.effect} (orders {self.lowest} to {self.highest} fit)"

    def to_json(self) -> dict[str, object]:
        """An entry of `shapes` (identification/files/README.md, "JSON keys")."""
        return {
            "effect": self.effect,
            "joint": self.joint,
            "range_deg": [float(np.degrees(self.low)), float(np.degrees(self.high))],
            "orders": [self.lowest, self.highest],
        }


def order_of(effect: Effect) -> float | None:
    """Periods per turn of a wave at a joint; None for any other effect."""
    order = effect.chosen.get(ORDER, FIXED_ORDERS.get(effect.name))
    return None if effect.joint is None or order is None else float(order)


def order_ranges(found: Fit, rows: Rows, labels: tuple[str, ...]) -> tuple[OrderRange, ...]:
    """The named waves of a fit to these rows whose order the measured angles do not determine.

    labels : of the named effects

    The order is undetermined if a neighboring whole order has a likeness of at least `NEAR` after projection off the
    rest of the model.
    """
    waves = [(e, order) for e in found.model.effects if e.label in labels and (order := order_of(e)) is not None]
    return tuple(_range(rows, effect, order) for effect, order in waves if _like_neighbor(found, rows, effect, order))


def _range(rows: Rows, effect: Effect, order: float) -> OrderRange:
    angles = rows.postures[:, effect.joint_index]
    width = np.sqrt(12.0) * np.std(angles)  # of even angles with the same standard deviation
    apart = 2.0 * np.pi / width
    lowest, highest = max(1, int(np.ceil(order - apart))), int(np.floor(order + apart))
    return OrderRange(effect.label, effect.joint_index + 1, float(angles.min()), float(angles.max()), lowest, highest)


def _like_neighbor(found: Fit, rows: Rows, effect: Effect, order: float) -> bool:
    model, own = found.model, {p.name for p in effect.parameters}
    others = [k for k, name in enumerate(model.names) if name not in own]
    jacobian = rows.whiten(model.jacobian(rows.postures, found.values, rows.conditions)[:, :, others])
    basis = column_space(jacobian, model.scales[others])
    levers = model.joint_levers(rows.postures, found.values, rows.conditions)[:, :, effect.joint_index]
    angles = rows.postures[:, effect.joint_index]
    mine, *neighbors = (
        _visible(basis, rows.whiten(levers[:, :, None] * _wave(angles, k)[:, None, :]))
        for k in (order, order - 1.0, order + 1.0)
        if k > 0.0
    )
    return any(np.linalg.norm(n.T @ mine) >= NEAR * np.sqrt(max(mine.shape[1], 1)) for n in neighbors)


def _wave(angles: Array, order: float) -> Array:
    """(m, 2) cos k q, sin k q."""
    return np.column_stack([np.cos(order * angles), np.sin(order * angles)])


def _visible(basis: Array, columns: Array) -> Array:
    """(N, r) orthonormal basis of columns (N, 2) projected off an orthonormal basis (N, s), r <= 2."""
    left = columns - basis @ (basis.T @ columns)
    u, s, _ = np.linalg.svd(left, full_matrices=False)
    return u[:, s > VISIBLE * np.linalg.norm(columns, axis=0).max()]


def order_clauses(shapes: tuple[OrderRange, ...]) -> list[str]:
    """One clause of the verdict for each joint."""
    said = []
    for joint in sorted({shape.joint for shape in shapes}):
        there = [shape for shape in shapes if shape.joint == joint]
        turn = np.degrees(there[0].high - there[0].low)
        what = "is a shape, not a cause" if len(there) == 1 else "are shapes, not causes"
        said.append(f"over the {turn:.0f} deg that joint {joint} moved, {' and '.join(map(str, there))} {what}")
    return said
