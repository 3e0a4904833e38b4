"""General shapes of effects outside the library: functions of a joint's angle, of time, and of the position.

An unknown effect at a joint is some function of that joint (or of its neighbors), acting through the joint's lever, or
in space by tilting or shifting what lies beyond across the joint's axis, as a bearing that wobbles does; one in time is
a step, a power or a wave of the base; one in the workspace is a smooth warp or a local dent of the measured positions.
Each shape has few columns; an unknown effect is located where the best shape explains the residuals, after correction
for all shapes at all places.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.effects.places import OF_FRAME, widths
from identification.gap.fits.fit import Fit
from identification.gap.fits.whitening import Rows
from identification.kinematics.parameters import REVOLUTE
from identification.kinematics.spatial import SpatialChain

# reasons: identification/README.md, "Constants"
FREE_ORDERS = np.arange(0.25, 256.25, 0.25)  # periods per turn: every wave between has a likeness of 0.97 with one
TOGETHER = 32  # effort: waves that differ from these by one wave are computed together
WAVES = {f"wave of {k:g} per turn": float(k) for k in FREE_ORDERS}  # shape -> periods per turn
SMOOTH_ORDERS = np.arange(1, 6)  # of a smooth curve
WOBBLES = (1, 2, 3, 4)  # periods per turn of an axis that wobbles
CENTRES, WIDTHS = 24, (0.2, 0.3, 0.45, 0.7, 1.0)  # of bumps [rad]: a likeness of 0.9 with every bump between
PERIODS = (2.0, 1.5, 1.0, 0.75, 0.5, 0.35)  # of waves over the workspace, in units of the reach; a sketch
DENTS = (-1.5, -0.75, 0.0, 0.75, 1.5)  # centres along each axis, in root mean square coordinates; a sketch
STEPS = 100  # effort: steps in time at every row up to this many
NamedColumns = tuple[Sequence[str], Array]  # S shapes over one joint: for people, and (m, S k) with k columns of each


@dataclass(frozen=True)
class GeneralShape:
    """place : `joint:j`, `time`, `workspace`;  shape : its description;  columns : (m, d, k) for d coordinates"""

    place: str
    shape: str
    columns: Array


@dataclass(frozen=True)
class PlaceShapes:
    """All S shapes at one place.

    shapes : descriptions;  sizes : (S,) number of columns of each;  columns : (m, d, K) side by side
    """

    place: str
    shapes: tuple[str, ...]
    sizes: NDArray[np.int64]
    columns: Array

    @classmethod
    def of(cls, place: str, listed: list[GeneralShape]) -> PlaceShapes:
        """Stack shapes at one place."""
        columns = np.concatenate([a.columns for a in listed], axis=2)
        return cls(place, tuple(a.shape for a in listed), np.array([a.columns.shape[2] for a in listed]), columns)

    @classmethod
    def at_joint(
        cls, place: str, listed: list[NamedColumns], lever: Array, others: Sequence[GeneralShape] = ()
    ) -> PlaceShapes:
        """Stack functions of a joint's angle, acting through the joint's lever (m, d) [mm/rad], and other shapes."""
        values = np.concatenate([v for _, v in listed], axis=1)
        sizes = [np.full(len(names), v.shape[1] // len(names)) for names, v in listed]
        sizes.append(np.array([one.columns.shape[2] for one in others], dtype=np.int64))
        every = *(name for names, _ in listed for name in names), *(one.shape for one in others)
        columns = np.empty((*lever.shape, sum(int(some.sum()) for some in sizes)))  # once: it may be most of the memory
        np.multiply(lever[:, :, None], values[:, None, :], out=columns[:, :, : values.shape[1]])
        if others:
            columns[:, :, values.shape[1] :] = np.concatenate([one.columns for one in others], axis=2)
        return cls(place, every, np.concatenate(sizes), columns)


def general_shapes(found: Fit, rows: Rows) -> Iterator[PlaceShapes]:
    """The shapes at a fitted model, one place at a time, as together they have thousands of columns."""
    at = (rows.postures, found.values, rows.conditions)
    position, levers = found.model.position(*at), found.model.joint_levers(*at)
    chain = getattr(getattr(found.model, "arm", None), "chain", None)  # other models have none
    across = {} if chain is None else _across_levers(chain, *found.model.place_levers(*at))
    for j, lever in enumerate(np.moveaxis(levers, 2, 0)):
        place = f"joint:{j + 1}"
        wobbling = _wobbles(place, rows.postures[:, j], across[j]) if j in across else []
        yield PlaceShapes.at_joint(place, _joint_shapes(rows.postures, j), lever, wobbling)
    time = rows.conditions.time
    if time is not None and np.ptp(time) > 0.0:
        yield PlaceShapes.of("time", _time_shapes(time, position))
    if chain is None or not chain.instrument.contact:  # whose only place is the surface
        yield PlaceShapes.of("workspace", _workspace_shapes(position))


def _joint_shapes(postures: Array, j: int) -> list[NamedColumns]:
    q = postures[:, j]
    return [(tuple(WAVES), _free_waves(q)), *_local_shapes(q), *_smooth_shapes(q), *_shared_shapes(postures, j)]


def _across_levers(chain: SpatialChain, levers: Array, _: Array) -> dict[int, dict[str, Array]]:
    """Of each revolute joint from 0 the (m, d, 2) derivatives by tilts and by shifts of what it moves, along two
    directions across its axis.

    levers : (m, d, P) by what is added at each place
    """
    sizes, n = widths(len(chain), chain.dimension), len(chain)
    ends = dict(zip(sizes, np.cumsum([*sizes.values()]).tolist(), strict=True))
    found: dict[int, dict[str, Array]] = {}
    for j, joint in enumerate(chain.joints):
        if joint.type == REVOLUTE:
            plane = np.linalg.svd(joint.axis[None])[2][1:].T
            first = {kind: ends[kind] - 3 * n + 3 * j for kind in OF_FRAME}
            found[j] = {kind: levers[:, :, at : at + 3] @ plane for kind, at in first.items()}
    return found


def _wobbles(place: str, q: Array, across: Mapping[str, Array]) -> list[GeneralShape]:
    """Waves of tilts and of shifts across the axis of a joint, for the frame that it moves, with four columns each."""
    words, listed = {"joint_turns": "tilt", "joint_shifts": "shift"}, []
    for kind, levers in across.items():
        for k in WOBBLES:
            waves = np.stack([np.cos(k * q), np.sin(k * q)], axis=1)
            columns = (levers[:, :, :, None] * waves[:, None, None, :]).reshape(*levers.shape[:2], 4)
            listed.append(GeneralShape(place, f"{words[kind]} across the axis, {k} per turn", columns))
    return listed


def _free_waves(q: Array) -> Array:
    """(m, 2 K) cosine and sine of each of `FREE_ORDERS`, from few: exp(i (a + b) q) = exp(i a q) exp(i b q)."""
    slow, fast = FREE_ORDERS[:TOGETHER], FREE_ORDERS[TOGETHER - 1 :: TOGETHER] - FREE_ORDERS[TOGETHER - 1]
    slow, fast = (np.exp(1j * np.multiply.outer(q, orders)) for orders in (slow, fast))
    return (fast[:, :, None] * slow[:, None, :]).reshape(len(q), -1).view(float)


def _local_shapes(q: Array) -> list[NamedColumns]:
    found: list[NamedColumns] = []
    for centre in np.quantile(q, (np.arange(CENTRES) + 0.5) / CENTRES):
        gap = np.angle(np.exp(1j * (q - centre)))
        at = f"at {np.degrees(centre):.0f} deg"
        bumps = [np.exp(-0.5 * (gap / width) ** 2) for width in WIDTHS]
        names = [*(f"bump {at}" for _ in WIDTHS), f"step {at}", f"bend {at}"]
        found.append((names, np.column_stack([*bumps, np.sign(q - centre), np.maximum(q - centre, 0.0)])))
    return found


def _smooth_shapes(q: Array) -> list[NamedColumns]:
    waves = np.concatenate([[np.cos(k * q), np.sin(k * q)] for k in SMOOTH_ORDERS]).T
    powers = q[:, None] ** np.array([1, 2, 3])
    return [(["square", "cube"], powers[:, 1:]), (["powers 1 to 3"], powers), (["smooth function"], waves)]


def _shared_shapes(postures: Array, j: int) -> list[NamedColumns]:
    found: list[NamedColumns] = []
    for k in range(postures.shape[1]):
        if k != j:
            other = postures[:, k]
            found.append(([f"product with joint {k + 1}"], (postures[:, j] * other)[:, None]))
            found.append(([f"wave over joint {k + 1}"], np.column_stack([np.cos(other), np.sin(other)])))
    return found


def _time_shapes(time: Array, position: Array) -> list[GeneralShape]:
    d, turns = position.shape[1], rotations(position)
    edges = np.quantile(time, np.linspace(0.0, 1.0, min(STEPS, len(time) - 1) + 1)[1:-1])
    shapes = [(f"step at {edge:+.2f}", np.greater(time, edge) * 1.0) for edge in edges]
    shapes += [(f"power {k}", time**k) for k in (2, 3)]
    listed = []
    for shape, values in shapes:
        listed.append(GeneralShape("time", shape, values[:, None, None] * np.eye(d)))
        if d > 1:
            listed.append(GeneralShape("time", f"rotation {shape}", values[:, None, None] * turns))
    return listed + [GeneralShape("time", f"wave of {k} per session", _vector_waves(k * time, d)) for k in (1, 2, 3)]


def rotations(position: Array) -> Array:
    """(m, d, d (d - 1) / 2) displacement of positions (m, d) per rotation about the base in each coordinate plane.

    In the plane of coordinates a < b, coordinate a changes by -b and b by a.
    """
    d = position.shape[1]
    planes = list(combinations(range(d), 2))
    turns = np.zeros((len(position), d, len(planes)))
    for k, (a, b) in enumerate(planes):
        turns[:, a, k], turns[:, b, k] = -position[:, b], position[:, a]
    return turns


def _workspace_shapes(position: Array) -> list[GeneralShape]:
    d = position.shape[1]
    scaled = position / np.sqrt(np.mean(position**2))
    powers = [p for p in product(range(4), repeat=d) if 2 <= sum(p) <= 3]
    shapes = [
        (" ".join(f"{x}^{k}" for x, k in zip("xyz", p, strict=False)), np.prod(scaled**p, axis=1)) for p in powers
    ]
    for centre in product(DENTS, repeat=d):
        dent = np.exp(-0.5 * np.sum((scaled - centre) ** 2, axis=1) / 0.5**2)
        if np.sum(dent > 0.3) >= 3:
            shapes.append((f"dent near ({', '.join(f'{c:g}' for c in centre)}) rms reach", dent))
    listed = [GeneralShape("workspace", shape, values[:, None, None] * np.eye(d)) for shape, values in shapes]
    return listed + _instrument_shapes(position)


def _instrument_shapes(position: Array) -> list[GeneralShape]:
    """Distortions of an instrument: the cubic distortion of a lens, waves along an axis or along the radius."""
    radius = np.linalg.norm(position, axis=1)
    reach = max(float(radius.max()), 1e-300)
    listed = [GeneralShape("workspace", "lens distortion", (position * radius[:, None] ** 2)[:, :, None])]
    outward = position / np.maximum(radius, 1e-12 * reach)[:, None]
    for period in PERIODS:
        for name, values in zip("xyz", position.T, strict=False):
            columns = _vector_waves(values / reach / period, position.shape[1])
            listed.append(GeneralShape("workspace", f"wave of {period:g} reach along {name}", columns))
        columns = outward[:, :, None] * _waves(radius / reach / period)[:, None, :]
        listed.append(GeneralShape("workspace", f"wave of {period:g} reach along the radius", columns))
    return listed


def _waves(turns: Array) -> Array:
    """(m, 2) cosine and sine of numbers of turns (m,)."""
    return np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)


def _vector_waves(turns: Array, dimension: int) -> Array:
    """(m, d, 2 d) cosine and sine of numbers of turns (m,), for each coordinate."""
    waves = np.eye(dimension)[None, :, :, None] * _waves(turns)[:, None, None, :]
    return waves.reshape(len(turns), dimension, 2 * dimension)
