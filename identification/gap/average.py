"""The model that predicts best: the average over the posterior, as an arm file has it.

The coefficients of all blocks that are likely enough have the mean and the covariance of the mixture of all
explanations, E[cov] + cov[E]; the base's parameters follow them. Blocks that an arm file cannot have (functions of
time and workspace) are left out, and the base follows what is left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from identification.arm import EffectSpec
from identification.arrays import Array
from identification.gap.blocks import Basis, Block
from identification.gap.curves.curve import Curve
from identification.gap.evidence import SIZES
from identification.gap.fits.fit import Fit
from identification.gap.posterior import Posterior
from identification.kinematics.base_axes import along, planar_axes
from identification.kinematics.parameters import JOINT_OFFSET
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.sessions import SESSIONS

# reasons: identification/README.md, "Constants"
WRITTEN = 0.05  # probability of a block that is part of the model
LIKELY = 1e-4  # of an explanation that is averaged
TIDY = 7  # decimals of a value in degrees, in files


@dataclass(frozen=True, eq=False)
class Moments:
    """Mixture over explanations of the parameters of some blocks, with the base's parameters first.

    blocks : with the probability of each;  mean : (g + k,);  covariance : (g + k, g + k)
    response : (g, k) by which the base gives way to each;  sigma : of one coordinate [mm];  effective : number of
    parameters
    """

    blocks: tuple[tuple[Block, float], ...]
    mean: Array
    covariance: Array
    response: Array
    sigma: float
    effective: float


def mixture_of(found: Posterior) -> Moments:
    """Mean and covariance of the blocks that an arm file can have, of those that are likely."""
    shares: dict[str, float] = {}
    known: dict[str, tuple[Block, int]] = {}
    numbers = [{block.label: k for k, block in enumerate(problem.blocks)} for problem in found.problems]
    for one in found.explanations:
        inside: dict[str, int] = {}
        for block, b in zip(one.blocks, one.weighed.blocks, strict=True):
            if block.named or block.basis is not None:
                inside[block.label] = b
            inside |= {label: numbers[one.noise][label] for label in block.parts}
        for label, b in inside.items():
            problem = found.problems[one.noise]
            shares[label] = shares.get(label, 0.0) + one.probability
            known.setdefault(label, (problem.blocks[b], problem.roots[b].shape[0]))
    kept = [label for label in known if shares[label] >= WRITTEN]
    order = {label: k for k, label in enumerate(found.order)}
    kept.sort(key=lambda label: order.get(label, len(order)))
    ends = np.cumsum([0, *(known[label][1] for label in kept)])
    place = {label: np.arange(first, last) for label, first, last in zip(kept, ends[:-1], ends[1:], strict=True)}
    g, k = len(found.problems[0].base), int(ends[-1])
    likely = [one for one in found.explanations if one.probability >= LIKELY]
    total = sum(one.probability for one in likely)
    mean, second, inner = np.zeros(g + k), np.zeros((g + k, g + k)), np.zeros((g + k, g + k))
    squares = effective = 0.0
    response = np.zeros((g, k))
    for one in likely:
        problem, share = found.problems[one.noise], one.probability / total
        blocks = one.weighed.blocks
        own = problem.products.columns(blocks)
        turn = np.zeros((g + k, len(own)))
        variance = problem.products.squares / max(problem.products.freedom, 1)
        z, cov = np.zeros(0), np.zeros((0, 0))
        if len(own):
            sizes = SIZES[list(one.weighed.sizes)]
            z, cov = problem.products.estimates(blocks, sizes)
            variance = max(problem.products.squares - float(z @ problem.products.right[own]), 0.0)
            variance /= max(problem.products.freedom, 1)
            prior = np.repeat(sizes**2, problem.products.widths[list(blocks)]) * max(variance, 1e-300)
            effective += share * float(np.sum(1.0 - np.diag(cov) / prior))
        at = 0
        for block, b in zip(one.blocks, blocks, strict=True):
            width = problem.roots[b].shape[1]
            part = slice(at, at + width)
            if block.label in place:
                turn[g + place[block.label], part] = problem.roots[b]
                turn[:g, part] = problem.response[:, own[part]]
            elif block.row:
                turn[:g, part] = problem.response[:, own[part]]
            elif block.parts:
                first = row = 0
                for label in block.parts:
                    root = problem.roots[numbers[one.noise][label]]
                    if label in place:
                        here = np.arange(at + first, at + first + root.shape[1])
                        rows = slice(row, row + root.shape[0])
                        turn[np.ix_(g + place[label], here)] = problem.roots[b][rows, first : first + root.shape[1]]
                        turn[:g, here] = problem.response[:, own[here]]
                    first, row = first + root.shape[1], row + root.shape[0]
            at += width
        there = turn @ z
        there[:g] += problem.base
        mean += share * there
        second += share * np.outer(there, there)
        inner += share * turn @ cov @ turn.T
        inner[:g, :g] += share * variance * problem.normal
        squares += share * variance
    best = found.problems[found.best.noise]
    for b, block in enumerate(best.blocks):
        if block.label in place:
            columns = best.products.columns([b])
            response[:, place[block.label]] = best.response[:, columns] @ np.linalg.pinv(best.roots[b])
    covariance = inner + second - np.outer(mean, mean)
    blocks_kept = tuple((known[label][0], shares[label]) for label in kept)
    return Moments(blocks_kept, mean, covariance, response, float(np.sqrt(squares)), effective + g)


@dataclass(frozen=True, eq=False)
class PredictingModel:
    """The predicting model: its values and covariance in the order of its parameters.

    specs : entries of the arm file beyond the base's;  curves : among them
    loading : (p + c, ...) none;  left_over : covariance of the curves' coefficients, with the blocks' bases
    """

    model: Model
    values: Array
    covariance: Array
    specs: tuple[EffectSpec, ...]
    curves: tuple[Curve, ...]
    sigma: float
    freedom: int
    bases: tuple[Basis, ...] = ()
    joint: Array | None = None  # (p + c, p + c) covariance with the coefficients of the curves

    @property
    def by_name(self) -> dict[str, float]:
        """Parameter name -> value."""
        return self.model.parameters.mapping(self.values)

    def position_residuals(self, measurements: Measurements, conditions: Conditions) -> Array:
        """(m, d) measured less computed positions [mm]."""
        position, _ = self.model.linearize(measurements.postures, self.values, conditions)
        return measurements.positions - position

    def uncertain(self, postures: Array, conditions: Conditions) -> tuple[Array, Array]:
        """(m, d, q) derivative of the positions with respect to all estimates, curves last, and their covariance."""
        jacobian = self.model.jacobian(postures, self.values, conditions)
        if self.joint is None:
            return jacobian, self.covariance
        levers = self.model.joint_levers(postures, self.values, conditions)
        parts = [levers[:, :, b.joint, None] * b.at(postures[:, b.joint])[:, None, :] for b in self.bases]
        return np.concatenate([jacobian, *parts], axis=2), self.joint


def averaged(found: Posterior, at: Fit, rows: int) -> PredictingModel:
    """The posterior's average as a model;  at : fit of the best explanation;  rows : number of coordinates"""
    mixed, library = mixture_of(found), found.library
    g = len(found.problems[0].base)
    effects = [(k, b) for k, (b, _) in enumerate(mixed.blocks) if b.member is not None]
    widths = [0 if b.member is None else len(b.member.effect.parameters) for b, _ in mixed.blocks]
    widths = [w if w else b.basis.count for w, (b, _) in zip(widths, mixed.blocks, strict=True)]  # type: ignore[union-attr]
    ends = g + np.cumsum([0, *widths])
    arm = library.arm
    specs = tuple(b.member.spec for _, b in effects if b.member is not None)
    plain = Model(arm.with_effects(*arm.effects, *specs))
    own = [p.name for e in library.base.effects for p in e.parameters]
    longer = [p.name for e in plain.effects for p in e.parameters]
    renamed = dict(zip(own, longer[: len(own)], strict=True))
    place = {renamed.get(name, name): k for k, name in enumerate(library.base.names)}
    for (k, _), effect in zip(effects, plain.effects[len(plain.effects) - len(effects) :], strict=True):
        place |= {p.name: int(ends[k]) + i for i, p in enumerate(effect.parameters)}
    index = np.array([place[name] for name in plain.names], dtype=np.int64)
    low, high = plain.parameters.lower, plain.parameters.upper
    values = np.clip(mixed.mean[index], low, high)
    curved = [(k, b) for k, (b, _) in enumerate(mixed.blocks) if b.basis is not None]
    bases = tuple(b.basis for _, b in curved if b.basis is not None)
    coefficients = np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(ends[k], ends[k + 1]) for k, _ in curved)])
    curves = tuple(_curves(found, mixed, curved, ends, values, plain))
    every = (*specs, *(curve.spec for curve in curves))
    model = Model(arm.with_effects(*arm.effects, *every))
    both = np.concatenate([index, coefficients])
    joint = mixed.covariance[np.ix_(both, both)] if len(curved) else None
    freedom = max(rows - round(mixed.effective), 1)
    covariance = mixed.covariance[np.ix_(index, index)]
    return PredictingModel(model, values, covariance, every, curves, mixed.sigma, freedom, bases, joint)


def _curves(
    found: Posterior,
    mixed: Moments,
    curved: list[tuple[int, Block]],
    ends: Array,
    values: Array,
    model: Model,
) -> list[Curve]:
    """The error curve of each joint that has one: the sum over correlation lengths."""
    curves, g = [], len(found.problems[0].base)
    for joint in sorted({b.basis.joint for _, b in curved if b.basis is not None}):
        there = [(k, b.basis) for k, b in curved if b.basis is not None and b.basis.joint == joint]
        finest = max((basis for _, basis in there), key=lambda basis: basis.count)
        at = np.concatenate([np.arange(ends[k], ends[k + 1]) for k, _ in there])
        angles = np.linspace(finest.start, finest.stop, 2 * finest.count - 1)
        functions = np.concatenate([basis.at(angles) for _, basis in there], axis=1)
        error = functions @ mixed.mean[at]
        variance = np.einsum("ak,kl,al->a", functions, mixed.covariance[np.ix_(at, at)], functions, optimize=True)
        geometry = mixed.response[:, at - g] @ mixed.mean[at]
        table = finest.table(np.radians(np.round(np.degrees(error[::2]), TIDY)))
        table = replace(
            table, geometry=_tied(model, dict(zip(found.library.base.names, geometry, strict=True)), values)
        )
        length = sum(basis.length for _, basis in there) / len(there)
        curves.append(Curve(joint + 1, table, angles, table.at(angles), np.sqrt(np.maximum(variance, 0.0)), length))
    return curves


def _tied(model: Model, geometry: Mapping[str, float], values: Array) -> dict[str, float]:
    """The part of the geometry that was fitted together with a curve; shifts of the base along its axes."""
    by_name, chain = model.parameters.mapping(values), model.arm.chain
    kept = {name: float(value) for name, value in geometry.items() if not name.startswith(f"{SESSIONS}.")}
    axes = np.array(ca.DM(planar_axes(by_name[f"{JOINT_OFFSET}:1"]))) if chain is None else chain.base[:3, :3]
    own = {name: float(value) for name, value in along(axes.T, kept).items() if name in kept}
    return {**kept, **own}
