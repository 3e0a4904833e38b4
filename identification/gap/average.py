"""The model that predicts best: the average over the posterior, as an arm file has it.

Where something may be missing that an arm file cannot have (functions of time and workspace), the posterior is that of
what it can have alone, so that this describes as much of the data as it can. The parameters of all blocks that are
likely enough have the mean and the covariance of the mixture of all explanations, E[cov] + cov[E]; the base's follow
them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from identification.arm import EffectSpec
from identification.arrays import Array
from identification.gap.blocks import Linearized
from identification.gap.columns import WAVES, Where
from identification.gap.curve import Curve
from identification.gap.detectability import LEVEL
from identification.gap.evidence import Index
from identification.gap.hypotheses import Block
from identification.gap.posterior import Posterior
from identification.information import VISIBLE
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.sessions import SESSIONS


@dataclass(frozen=True, eq=False)
class Mixture:
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


def mixture_of(posterior: Posterior) -> Mixture:
    """Mean and covariance of the parameters of the base and of the blocks that are likely enough.

    The base's are those beside what an arm file can have: what it cannot have stays with the base.
    """
    # with the rest of the library, dozens of effects, only where it is likelier than not
    rest = sum(one.probability for one in posterior.explanations if one.rest) >= 0.5
    likely = [one for one in posterior.explanations if rest or not one.rest]
    total = sum(one.probability for one in likely)
    shares: dict[str, float] = {}
    blocks: dict[str, Block] = {}
    for one in likely:
        inside = {part.label: part for b in one.blocks for part in (b.parts or (b,))}
        blocks |= inside
        for label in inside:
            shares[label] = shares.get(label, 0.0) + one.probability / total
    order = {label: k for k, label in enumerate(posterior.order)}
    kept = [b for b in blocks.values() if shares[b.label] >= LEVEL and not b.row]
    kept.sort(key=lambda b: order.get(b.label, len(order)))
    widths = {b.label: c.shape[2] for p in posterior.problems for b, c in zip(p.blocks, p.columns, strict=True)}
    g = len(posterior.whole.base)
    ends = g + np.cumsum([0, *(_width(b) or widths[b.label] for b in kept)])
    places = {b.label: (b, np.arange(low, high)) for b, low, high in zip(kept, ends[:-1], ends[1:], strict=True)}
    count, base = int(ends[-1]), posterior.whole.base
    mean, second, response = np.zeros(count), np.zeros((count, count)), np.zeros((g, count))
    squares = effective = 0.0
    for number, problem in enumerate(posterior.problems):
        weight = sum(one.probability for one in likely if one.noise == number) / total
        drawn = [m for m in posterior.moments[number][: 1 + rest] if m.count]
        if not drawn or weight == 0.0:
            continue
        turn, draws = _to_parameters(problem, places, g, count), sum(m.count for m in drawn)
        standing, moved = turn @ sum(m.first for m in drawn) / draws, np.zeros(count)
        moved[:g] = problem.base - base
        mean += weight * (standing + moved)
        across = np.outer(standing, moved)
        products = turn @ sum(m.second for m in drawn) @ turn.T / draws
        second += weight * (products + across + across.T + np.outer(moved, moved))
        variance = sum(m.variance for m in drawn) / draws
        second[:g, :g] += weight * variance * problem.normal
        squares += weight * variance
        effective += weight * sum(m.effective for m in drawn) / draws
        for b, block in enumerate(problem.blocks):
            if block.label in places:
                given = problem.response[:, problem.products.places([b])] @ np.linalg.pinv(problem.roots[b])
                response[:, places[block.label][1]] = given
    covariance = second - np.outer(mean, mean)
    covariance = (covariance + covariance.T) / 2.0
    mean[:g] += base
    best = posterior.problems[posterior.best.noise].normal
    return Mixture(places, mean, covariance, response, best, float(np.sqrt(squares)), effective + g)


def _width(block: Block) -> int:
    """Number of parameters of what an arm file can have, else 0."""
    return block.member.size if block.member is not None else WAVES if block.basis is not None else 0


def _to_parameters(problem: Linearized, places: Mapping[str, tuple[Block, Index]], g: int, count: int) -> Array:
    """(P, C) from the coefficients of a problem's columns to the base's parameters and those of the blocks."""
    turn = np.zeros((count, int(problem.products.starts[-1])))
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
    """

    model: Model
    values: Array
    covariance: Array
    specs: tuple[EffectSpec, ...]
    curves: tuple[Curve, ...]
    sigma: float
    freedom: int
    spread: Array

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
        """(m, d, p) derivative of the positions with respect to the parameters, and their (p, p) covariance."""
        return self.model.jacobian(postures, self.values, conditions), self.covariance


def averaged(posterior: Posterior, rows: int) -> PredictingModel:
    """The posterior's average as a model;  rows : number of coordinates that it is fitted to"""
    held = posterior.writable
    mixed, library = mixture_of(held), posterior.library
    g, arm = len(posterior.whole.base), library.arm
    members = [(b.member, at) for b, at in mixed.places.values() if b.member is not None]
    specs = tuple(member.spec for member, _ in members)
    plain = Model(arm.with_effects(*arm.effects, *specs))
    names = [p.name for e in library.base.effects for p in e.parameters]
    longer = [p.name for e in plain.effects for p in e.parameters]
    renamed = dict(zip(names, longer[: len(names)], strict=True))
    place = {renamed.get(name, name): k for k, name in enumerate(library.base.names)}
    for (_, at), effect in zip(members, plain.effects[len(plain.effects) - len(members) :], strict=True):
        place |= {p.name: k for p, k in zip(effect.parameters, at.tolist(), strict=True)}
    index = np.array([place[name] for name in plain.names], dtype=np.int64)
    values = np.clip(mixed.mean[index], plain.parameters.lower, plain.parameters.upper)
    curves = tuple(_curve(held, mixed, b, at, values, plain) for b, at in mixed.places.values() if b.basis is not None)
    entries = (*specs, *(curve.spec for curve in curves))
    model = Model(arm.with_effects(*arm.effects, *entries))
    freedom = max(rows - round(mixed.effective), 1)
    of_base, spread = np.flatnonzero(index < g), np.zeros((len(index), len(index)))
    spread[np.ix_(of_base, of_base)] = mixed.normal[np.ix_(index[of_base], index[of_base])]
    # a file's covariance knows parameters only: theirs beside the curves as they are written, and at the postures
    # measured as much more as the curves are uncertain, and what a file cannot have is there
    jacobian = model.jacobian(held.rows.postures, values, held.rows.conditions)
    where = Where(held.at.model, held.at.values, held.rows.postures, held.rows.conditions)
    tables = [
        (b.columns(where), at) for b, at in mixed.places.values() if b.basis is not None and b.columns is not None
    ]
    of_curves = np.concatenate([np.zeros(0, dtype=np.int64), *(at for _, at in tables)])
    whole, every = np.concatenate([jacobian, *(columns for columns, _ in tables)], axis=2), [*index, *of_curves]
    tall = whole.reshape(-1, whole.shape[2])
    gram = tall.T @ tall / len(whole)  # of a covariance C the mean square distance is the sum of gram * C
    inside = gram[: len(index), : len(index)]
    spread /= max(float(np.sum(inside * spread)), 1e-300)
    covariance = beside_known(mixed.covariance, index, of_curves)
    written = PredictingModel(model, values, covariance, entries, curves, mixed.sigma, freedom, spread)
    more = float(np.sum(gram * mixed.covariance[np.ix_(every, every)]) - np.sum(inside * covariance))
    lacking = held.noise_variance - posterior.noise_variance
    return written.allowing(more + jacobian.shape[1] * max(lacking, 0.0))


def beside_known(covariance: Array, kept: Index, conditioned: Index) -> Array:
    """Covariance of the parameters `kept` once those `known` have their values.

    Combinations of the known ones that hardly vary are taken as not known: what is there of them is rounding, which
    their inverse would amplify.
    """
    sizes = np.sqrt(np.diag(covariance)[conditioned].clip(min=0.0))
    scale = np.where(sizes > 0.0, sizes, np.inf)
    values, vectors = np.linalg.eigh(covariance[np.ix_(conditioned, conditioned)] / np.outer(scale, scale))
    seen = values > VISIBLE
    across = covariance[np.ix_(kept, conditioned)] / scale @ (vectors[:, seen] / np.sqrt(values[seen]))
    return covariance[np.ix_(kept, kept)] - across @ across.T


def _curve(posterior: Posterior, mixed: Mixture, block: Block, part: Index, values: Array, model: Model) -> Curve:
    """The error curve of a joint."""
    basis = block.basis
    assert basis is not None
    angles = np.linspace(basis.start, basis.stop, 2 * WAVES + 1)
    functions = basis.at(angles)
    # beside the geometry that goes with it: what the two exchange makes no difference to any point
    base = posterior.library.base.names
    covariance = beside_known(mixed.covariance, part, np.arange(len(base)))
    error, variance = functions @ mixed.mean[part], np.sum((functions @ covariance) * functions, axis=1)
    # the part of the geometry that was fitted together with the curve; shifts of the base along its axes
    response = zip(base, (mixed.response[:, part] @ mixed.mean[part]).tolist(), strict=True)
    geometry = {name: value for name, value in response if not name.startswith(f"{SESSIONS}.")}
    along = model.arm.chain.along_base(geometry, model.parameters.mapping(values), back=True)
    geometry |= {name: float(value) for name, value in along.items() if name in geometry}
    table = basis.table(np.radians(np.round(np.degrees(error[::2]), 7)))
    table = replace(table, geometry=geometry)
    std = np.sqrt(np.maximum(variance, 0.0))
    return Curve(basis.joint + 1, table, std)
