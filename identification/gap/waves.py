"""Gear ripples of further orders, looked up where the residuals show one.

Gears cause waves with hundreds of periods per turn and of orders that are not whole numbers. All of them are
hypotheses, with the weight of one order among all; only those that explain most at each joint are added to the
dictionary, as the others have no probability to speak of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from identification.arm import EffectSpec
from identification.arrays import Array
from identification.effects import build
from identification.gap.fit import Fit, Rows
from identification.gap.hypotheses.hypotheses import Hypothesis, HypothesisSet, untested_joints
from identification.information import column_space

# reasons: identification/README.md, "Constants"
EFFECT, ORDER = "transmission_ripple", "k"
ORDERS = np.arange(3.0, 256.25, 0.25)  # periods per turn: every wave between has a likeness of 0.97 with one
BESIDE = (-0.125, 0.0, 0.125)  # of an order, beside the best: likeness 0.99 with every one between
WEIGHT = 0.2  # prior of all further orders together, beside those that are scanned
CLEAR = 8.0  # log likelihood ratio below which a wave of further order is not added


def with_further_orders(library: HypothesisSet, rows: Rows, at: Fit, chosen: Sequence[Hypothesis]) -> HypothesisSet:
    """The library with the ripple of further order that explains most at each joint, and its neighbors, if it is clear.

    at : fit of the chosen effects;  rows : with any noise model
    """
    arm, known = library.arm, {h.label for h in library.members}
    if not any(h.effect.name == EFFECT for h in library.members):
        return library
    position, jacobian = at.model.linearize(rows.postures, at.values, rows.conditions)
    levers = at.model.joint_levers(rows.postures, at.values, rows.conditions)
    unseen, added = untested_joints(at.model, rows), []
    owners = {p.name: e for e in at.model.effects for p in e.parameters}
    labels = {h.label for h in chosen}
    for j in range(arm.links):
        q = rows.postures[:, j]
        if np.ptp(q) == 0.0 or j + 1 in unseen:
            continue
        # what is named at this joint may be there instead of the wave
        own = [
            k
            for k, n in enumerate(at.model.names)
            if n in owners and owners[n].label in labels and owners[n].joint == j + 1
        ]
        rest = np.setdiff1d(np.arange(len(at.values)), own)
        y = rows.whiten(rows.positions - position + jacobian[:, :, own] @ at.values[own])
        basis = column_space(rows.whiten(jacobian[:, :, rest]), at.model.scales[rest])
        y = y - basis @ (basis.T @ y)
        gains = np.concatenate([_gains(rows, basis, y, levers[:, :, j], q, some) for some in np.array_split(ORDERS, 8)])
        best = int(np.argmax(np.round(gains, 12)))
        freedom = len(y) - basis.shape[1]
        if freedom < 3 or -0.5 * freedom * np.log1p(-min(gains[best], 1.0 - 1e-12)) < CLEAR:
            continue
        for order in (float(ORDERS[best]) + beside for beside in BESIDE):
            spec = EffectSpec(EFFECT, j + 1, {ORDER: order})
            weight = WEIGHT / (np.sqrt(arm.links) * len(ORDERS))
            one = Hypothesis(build(spec, arm.links, arm.lengths, dimension=arm.dimension), spec, weight)
            if one.label not in known:
                added.append(one)
    return replace(library, members=(*library.members, *added)) if added else library


def _gains(rows: Rows, basis: Array, y: Array, lever: Array, q: Array, orders: Array) -> Array:
    """(K,) share of y^T y that a wave of each order explains, projected off a basis."""
    angles = q[:, None] * orders
    waves = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(q), -1)
    x = rows.whiten(lever[:, :, None] * waves[:, None, :])
    x -= basis @ (basis.T @ x)
    x = x.reshape(len(x), -1, 2)
    gram, scores = np.einsum("nki,nkj->kij", x, x), np.einsum("nki,n->ki", x, y)
    gram += 1e-9 * np.einsum("kii->k", gram)[:, None, None] * np.eye(2) + 1e-300 * np.eye(2)
    return np.asarray(
        np.einsum("ki,ki->k", scores, np.linalg.solve(gram, scores[:, :, None])[:, :, 0]) / max(y @ y, 1e-300)
    )
