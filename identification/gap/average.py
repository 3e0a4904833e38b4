"""The model that predicts best: the average over the posterior, as an arm file has it.

The parameters of all blocks that are likely enough have the mean and the covariance of the mixture of all
explanations, E[cov] + cov[E]; the base's parameters follow them. Blocks that an arm file cannot have (functions of
time and workspace) are left out, the base stays as it is without them, and what they may be is part of the intervals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from identification.arm import EffectSpec
from identification.arrays import Array
from identification.gap.blocks import WAVES, Block, Linearized, Where
from identification.gap.curve import Curve
from identification.gap.evidence import SIZES, Index
from identification.gap.posterior import Posterior
from identification.kinematics.base_axes import along, planar_axes
from identification.kinematics.parameters import JOINT_OFFSET
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.sessions import SESSIONS

# reasons: identification/README.md, "Constants"
WRITTEN = 0.05  # probability of a block that is part of the model
LIKELY = 0.5  # of the rest of the library, below which the average is over the sets without it
SETS = 150  # effort: explanations that are averaged
TIDY = 7  # decimals of a value in degrees, in files


@dataclass(frozen=True, eq=False)
class Moments:
    """Mixture over explanations of the base's g parameters, and of those of the blocks behind them.

    places : label of each block -> it and the (k,) places of its parameters
    mean : (P,);  covariance : (P, P);  response : (g, P) by which the base gives way to each parameter of a block
    normal : (g, g) covariance of the base's parameters in noise of unit variance
    sigma : of one coordinate [mm];  effective : number of parameters
    """

    places: Mapping[str, tuple[Block, Index]]
    mean: Array
    covariance: Array
    response: Array
    normal: Array
    sigma: float
    effective: float


def mixture_of(found: Posterior) -> Moments:
    """Mean and covariance of the parameters of the base and of the blocks that are likely enough.

    The base's are those beside what an arm file can have: what it cannot have stays with the base.
    """
    rest = sum(one.probability for one in found.explanations if one.rest)
    likely = [one for one in found.explanations if rest >= LIKELY or not one.rest][:SETS]
    total = sum(one.probability for one in likely)
    shares: dict[str, float] = {}
    blocks: dict[str, Block] = {}
    for one in likely:
        inside = {part.label: part for b in one.blocks for part in (b.parts or (b,))}
        blocks |= inside
        for label in inside:
            shares[label] = shares.get(label, 0.0) + one.probability / total
    order = {label: k for k, label in enumerate(found.order)}
    kept = [b for b in blocks.values() if shares[b.label] >= WRITTEN and not b.row]
    kept.sort(key=lambda b: order.get(b.label, len(order)))
    widths = {b.label: c.shape[2] for p in found.problems for b, c in zip(p.blocks, p.columns, strict=True)}
    g = len(found.whole.base)
    ends = g + np.cumsum([0, *(_width(b) or widths[b.label] for b in kept)])
    places = {b.label: (b, np.arange(low, high)) for b, low, high in zip(kept, ends[:-1], ends[1:], strict=True)}
    count, base = int(ends[-1]), found.whole.base
    mean, second, response = np.zeros(count), np.zeros((count, count)), np.zeros((g, count))
    squares = effective = 0.0
    for number, problem in enumerate(found.problems):
        turn, products = _to_parameters(problem, places, g, count), problem.products
        moment, square = np.zeros(len(products.right)), np.zeros((len(products.right), len(products.right)))
        weight = variance = 0.0
        for one in likely:
            if one.noise != number:
                continue
            share, own = one.probability / total, products.places(one.weighed.blocks)
            sizes = SIZES[list(one.weighed.sizes)]
            z, covariance = products.estimates(one.weighed.blocks, sizes)
            left = max(products.squares - float(z @ products.right[own]), 0.0) / max(products.freedom, 1)
            prior = np.repeat(sizes**2, products.widths[list(one.weighed.blocks)]) * max(left, 1e-300)
            effective += share * float(np.sum(1.0 - np.diag(covariance) / prior))
            moment[own] += share * z
            square[np.ix_(own, own)] += share * (covariance + np.outer(z, z))
            weight, variance = weight + share, variance + share * left
        there, moved = turn @ moment, np.zeros(count)
        moved[:g] = problem.base - base
        mean += there + weight * moved
        second += (
            turn @ square @ turn.T + np.outer(there, moved) + np.outer(moved, there) + weight * np.outer(moved, moved)
        )
        second[:g, :g] += variance * problem.normal
        squares += variance
        for b, block in enumerate(problem.blocks):
            if block.label in places:
                given = problem.response[:, products.places([b])] @ np.linalg.pinv(problem.roots[b])
                response[:, places[block.label][1]] = given
    covariance = second - np.outer(mean, mean)
    mean[:g] += base
    best = found.problems[found.best.noise].normal
    return Moments(places, mean, covariance, response, best, float(np.sqrt(squares)), effective + g)


def _width(block: Block) -> int:
    """Number of parameters of what an arm file can have, else 0."""
    return block.member.size if block.member is not None else WAVES if block.basis is not None else 0


def _to_parameters(problem: Linearized, places: Mapping[str, tuple[Block, Index]], g: int, count: int) -> Array:
    """(P, C) from the coefficients of a problem's columns to the base's parameters and those of the blocks."""
    turn = np.zeros((count, len(problem.products.right)))
    for b, block in enumerate(problem.blocks):
        own, parts, row = problem.products.places([b]), block.parts or (block,), 0
        for part in parts:
            width = _width(part) or len(problem.roots[b])
            if part.label in places:
                turn[np.ix_(places[part.label][1], own)] = problem.roots[b][row : row + width]
            row += width
        if block.row or any(part.written and part.label in places for part in parts):
            turn[:g, own] = problem.response[:, own]
    return turn


@dataclass(frozen=True, eq=False)
class PredictingModel:
    """The predicting model: its values and covariance in the order of its parameters.

    specs : entries of the arm file beyond the base's;  curves : among them
    sigma : of one coordinate [mm];  freedom : residual degrees of freedom
    spread : (p, p) covariance as of noise, with a mean square distance of 1 mm^2 at the postures measured
    beside : what its parameters do not hold, and may be there: the error curves' own uncertainty, blocks that an arm
        file cannot have;  response : (p, c) by which the parameters would give way to the latter's c coefficients
    joint : (p + c, p + c) expected products of all errors
    """

    model: Model
    values: Array
    covariance: Array
    specs: tuple[EffectSpec, ...]
    curves: tuple[Curve, ...]
    sigma: float
    freedom: int
    spread: Array
    beside: tuple[Block, ...] = ()
    response: Array | None = None
    joint: Array | None = None

    @property
    def by_name(self) -> dict[str, float]:
        """Parameter name -> value."""
        return self.model.parameters.mapping(self.values)

    def position_residuals(self, measurements: Measurements, conditions: Conditions) -> Array:
        """(m, d) measured less computed positions [mm]."""
        position, _ = self.model.linearize(measurements.postures, self.values, conditions)
        return measurements.positions - position

    def allowing(self, square: float) -> PredictingModel:
        """With a further mean square distance [mm^2] in the covariance, as if there were so much more noise."""
        return replace(self, covariance=self.covariance + max(square, 0.0) * self.spread)

    def uncertain(self, postures: Array, conditions: Conditions) -> tuple[Array, Array]:
        """(m, d, q) derivative of the positions with respect to all that is uncertain, and (q, q) the expected products
        of its errors."""
        jacobian = self.model.jacobian(postures, self.values, conditions)
        if self.joint is None or self.response is None:
            return jacobian, self.covariance
        where = Where.of(self.model, self.values, postures, conditions)
        columns = [block.columns(where) for block in self.beside if block.columns is not None]
        more = np.concatenate([np.zeros((*where.position.shape, 0)), *columns], axis=2)
        return np.concatenate([jacobian, more + jacobian @ self.response], axis=2), self.joint


def averaged(found: Posterior, rows: int) -> PredictingModel:
    """The posterior's average as a model;  rows : number of coordinates that it is fitted to"""
    mixed, library = mixture_of(found), found.library
    g, arm = len(found.whole.base), library.arm
    members = [(b.member, at) for b, at in mixed.places.values() if b.member is not None]
    specs = tuple(member.spec for member, _ in members)
    plain = Model(arm.with_effects(*arm.effects, *specs))
    own = [p.name for e in library.base.effects for p in e.parameters]
    longer = [p.name for e in plain.effects for p in e.parameters]
    renamed = dict(zip(own, longer[: len(own)], strict=True))
    place = {renamed.get(name, name): k for k, name in enumerate(library.base.names)}
    for (_, at), effect in zip(members, plain.effects[len(plain.effects) - len(members) :], strict=True):
        place |= {p.name: k for p, k in zip(effect.parameters, at.tolist(), strict=True)}
    index = np.array([place[name] for name in plain.names], dtype=np.int64)
    values = np.clip(mixed.mean[index], plain.parameters.lower, plain.parameters.upper)
    curves = tuple(_curve(found, mixed, b, at, values, plain) for b, at in mixed.places.values() if b.basis is not None)
    every = (*specs, *(curve.spec for curve in curves))
    model = Model(arm.with_effects(*arm.effects, *every))
    beside = [(b, at) for b, at in mixed.places.values() if b.member is None]
    extra = np.concatenate([np.zeros(0, dtype=np.int64), *(at for _, at in beside)])
    lacking = np.concatenate([np.zeros(0, dtype=bool), *(np.full(len(at), not b.written) for b, at in beside)])
    both = np.concatenate([index, extra])
    joint = mixed.covariance[np.ix_(both, both)]
    off = np.concatenate([np.zeros(len(index)), np.where(lacking, mixed.mean[extra], 0.0)])
    joint += np.outer(off, off)  # the mean of what is not written is an error of the model
    response = np.zeros((len(index), len(extra)))
    of_base = np.flatnonzero(index < g)
    response[np.ix_(of_base, np.flatnonzero(lacking))] = mixed.response[np.ix_(index[of_base], extra[lacking])]
    freedom = max(rows - round(mixed.effective), 1)
    p, blocks = len(index), tuple(b for b, _ in beside)
    spread = np.zeros((p, p))
    spread[np.ix_(of_base, of_base)] = mixed.normal[np.ix_(index[of_base], index[of_base])]
    jacobian = model.jacobian(found.rows.postures, values, found.rows.conditions)
    spread /= max(_mean_trace(jacobian, spread), 1e-300)
    held = joint[:p, :p], every, curves, mixed.sigma, freedom
    whole = PredictingModel(model, values, *held, spread, blocks, response, joint)
    # the file's covariance, which knows parameters only, gives as much at the postures measured as there is
    columns, products = whole.uncertain(found.rows.postures, found.rows.conditions)
    return whole.allowing(_mean_trace(columns, products) - _mean_trace(columns[:, :, :p], joint[:p, :p]))


def _mean_trace(columns: Array, covariance: Array) -> float:
    """Mean over rows of tr(L C L^T)."""
    return float(np.sum((columns @ covariance) * columns)) / len(columns)


def _curve(found: Posterior, mixed: Moments, block: Block, part: Index, values: Array, model: Model) -> Curve:
    """The error curve of a joint."""
    basis = block.basis
    assert basis is not None
    angles = np.linspace(basis.start, basis.stop, 2 * WAVES + 1)
    functions = basis.at(angles)
    error, variance = (
        functions @ mixed.mean[part],
        np.sum((functions @ mixed.covariance[np.ix_(part, part)]) * functions, axis=1),
    )
    geometry = dict(zip(found.library.base.names, mixed.response[:, part] @ mixed.mean[part], strict=True))
    table = basis.table(np.radians(np.round(np.degrees(error[::2]), TIDY)))
    table = replace(table, geometry=_tied(model, geometry, values))
    std = np.sqrt(np.maximum(variance, 0.0))
    return Curve(basis.joint + 1, table, std)


def _tied(model: Model, geometry: Mapping[str, float], values: Array) -> dict[str, float]:
    """The part of the geometry that was fitted together with a curve; shifts of the base along its axes."""
    by_name, chain = model.parameters.mapping(values), model.arm.chain
    kept = {name: float(value) for name, value in geometry.items() if not name.startswith(f"{SESSIONS}.")}
    axes = np.array(ca.DM(planar_axes(by_name[f"{JOINT_OFFSET}:1"]))) if chain is None else chain.base[:3, :3]
    own = {name: float(value) for name, value in along(axes.T, kept).items() if name in kept}
    return {**kept, **own}
