"""Where a spatial arm stands and where its measured points are, as far as the arm does not say: the start of a fit."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.kinematics.placement import placed, placed_tool, registered
from identification.kinematics.spatial import BASE, TOOL, SpatialChain
from identification.measurements import Measurements
from identification.model import Model
from identification.vectorize import vectorize

ENOUGH = 500  # rows: a start is good to far less than the errors of the geometry that it leaves out


def placed_model(model: Model, measurements: Measurements) -> Model:
    """The model with base and measured points from a closed form on the nominal chain; planar arms stay as they are."""
    chain = model.arm.chain if isinstance(model, Model) else None
    if chain is None or chain.known >= {BASE, TOOL}:
        return model
    some = np.unique(np.linspace(0, len(measurements) - 1, ENOUGH).astype(int))
    rows = measurements.rows(some)
    markers = np.zeros(len(rows), dtype=np.int64) if rows.marker_numbers is None else rows.marker_numbers
    found = placed_chain(chain, rows.postures, rows.positions, markers)
    return replace(model, arm=replace(model.arm, chain=found))


def placed_chain(chain: SpatialChain, postures: Array, positions: Array, markers: NDArray[np.int64]) -> SpatialChain:
    """The chain with base and tools that explain (m, 3) positions [mm] at (m, n) postures best.

    markers : (m,) number of each row's measured point
    """
    names, frames = list(chain.tools), tip_frames(chain, postures)
    base, tools = chain.base, {name: np.array(place) for name, place in chain.tools.items()}
    first = int(np.bincount(markers).argmax())
    own = markers == first
    if BASE not in chain.known and TOOL not in chain.known:
        found = placed(frames[own], positions[own], chain.reach)
        base, tools[names[first]] = found.base, found.tool
    elif BASE not in chain.known:
        places = np.array([tools[name] for name in names])[markers]
        base = registered(frames[:, :3, 3] + np.einsum("mij,mj->mi", frames[:, :3, :3], places), positions)
    for number, name in enumerate(names if TOOL not in chain.known else ()):
        if (own := markers == number).any():
            tools[name] = placed_tool(frames[own], positions[own], base)
    return replace(chain, base=base, tools=tools)


def tip_frames(chain: SpatialChain, postures: Array) -> Array:
    """(m, 4, 4) nominal poses of the tip in the base at postures (m, n)."""
    q = ca.SX.sym("q", len(chain))
    tip = replace(chain, base=np.eye(4)).frames(q, {})[-1]
    origin, axes = vectorize(ca.Function("tip", [q], [ca.densify(tip.origin), ca.densify(tip.axes)]))(postures)
    frames = np.tile(np.eye(4), (len(postures), 1, 1))
    frames[:, :3, 3], frames[:, :3, :3] = origin[..., 0], axes
    return frames
