"""The model that predicts best: the average over the posterior, as an arm file has it.

Where something may be missing that an arm file cannot have (functions of time and workspace), the posterior is that of
what it can have alone, so that this describes as much of the data as it can. The parameters of all blocks that are
likely enough have the mean and the covariance of the mixture of all explanations, E[cov] + cov[E]; the base's follow
them.

A curve with standard deviation s(q) at angles q is compared with waves and with a step by weighted least squares beside
a constant. A shape describes the curve if it explains `SHAPED` of its weighted variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from identification.arm import EffectSpec
from identification.arrays import Array
from identification.error_curve import ErrorCurve
from identification.estimation.uncertainty import LEVEL_95 as LEVEL
from identification.gap.blocks import WAVES, Block, Linearized, curve_waves
from identification.gap.fit import At, Fit
from identification.gap.likelihood import Index, mixed
from identification.gap.search import Posterior
from identification.information import VISIBLE
from identification.model import Model
from identification.sessions import SESSIONS

SHAPED = 0.8  # convention: of a curve's variance, that makes a shape its name; nothing else depends on it
MOST_WAVES = 6  # that are listed; derived: each explains at least a sixth of what `SHAPED` allows to lack
COLUMNS = ("angle_deg", "correction_deg", "std_deg", "error_deg")


@dataclass(frozen=True, eq=False)
class PredictingModel(At):
    """The predicting model, and the rows that it was made from.

    covariance : (p, p) of its parameters;  specs : entries of the arm file beyond the base's;  curves : among them
    sigma : of one coordinate [mm];  freedom : residual degrees of freedom
    spread : (p, p) covariance as of noise, with a mean square distance of 1 mm^2 at the postures measured
    """

    covariance: Array
    sigma: float
    freedom: int
    spread: Array
    specs: tuple[EffectSpec, ...] = ()
    curves: tuple[Curve, ...] = ()

    def allowing(self, square: float) -> PredictingModel:
        """With a further mean square distance [mm^2] in the covariance, as if there were so much more noise."""
        return replace(self, covariance=self.covariance + max(square, 0.0) * self.spread)


def geometry(base: Fit) -> PredictingModel:
    """The base model as a predicting model."""
    covariance, columns = base.covariance, base.linearized[1]
    unit = float(np.sum((columns @ covariance) * columns)) / len(columns)
    spread = covariance / max(unit, 1e-300)
    return PredictingModel(base.model, base.values, base.rows, covariance, base.sigma, max(base.freedom, 1), spread)


def averaged(posterior: Posterior, rows: int) -> PredictingModel:
    """The posterior's average as a model;  rows : number of coordinates that it is fitted to"""
    held, library = posterior.writable or posterior, posterior.library
    places, mean, covariance, response, variance, effective = _mixed(held)
    base, arm = held.whole.base, library.arm
    g = len(base)
    mean[:g] += base
    members = [(block, at) for block, at in places.values() if block.spec is not None]
    specs = tuple(block.spec for block, _ in members if block.spec is not None)
    plain = Model(arm.with_effects(*arm.effects, *specs))
    place = {name: k for k, name in enumerate(library.base_names(plain))}
    for (_, at), effect in zip(members, plain.effects[len(plain.effects) - len(members) :], strict=True):
        place |= {p.name: k for p, k in zip(effect.parameters, at.tolist(), strict=True)}
    index = np.array([place[name] for name in plain.names], dtype=np.int64)
    values = np.clip(mean[index], plain.parameters.lower, plain.parameters.upper)

    curves = []
    for block, at in places.values():
        if block.span is None:
            continue
        # beside all else that goes with it: what they exchange makes no difference to any point
        joint, start, stop = block.span
        functions = curve_waves(np.linspace(start, stop, 2 * WAVES + 1), start, stop)
        beside = beside_known(covariance, at, np.setdiff1d(np.arange(len(mean)), at))
        std = np.sqrt(np.maximum(np.sum((functions @ beside) * functions, axis=1), 0.0))
        # the part of the geometry that was fitted together with the curve; shifts of the base along its axes
        parts = zip(library.base.names, (response[:, at] @ mean[at]).tolist(), strict=True)
        shifted = {name: value for name, value in parts if not name.startswith(f"{SESSIONS}.")}
        along = arm.chain.along_base(shifted, plain.parameters.mapping(values), back=True)
        shifted |= {name: float(value) for name, value in along.items() if name in shifted}
        nodes = np.radians(np.round(np.degrees((functions @ mean[at])[::2]), 7))
        curves.append(Curve(joint + 1, ErrorCurve(start, stop, nodes, shifted), std))
    entries = (*specs, *(curve.spec for curve in curves))
    model = Model(arm.with_effects(*arm.effects, *entries))

    of_base, spread = np.flatnonzero(index < g), np.zeros((len(index), len(index)))
    normal = held.problems[held.best.noise].normal
    spread[np.ix_(of_base, of_base)] = normal[np.ix_(index[of_base], index[of_base])]
    # a file's covariance knows parameters only: theirs beside the curves as they are written, and at the postures
    # measured as much more as the curves are uncertain, and what a file cannot have is there
    jacobian = At(model, values, held.at.rows).linearized[1]
    tables = [(b.columns(held.at), at) for b, at in places.values() if b.span is not None and b.columns is not None]
    of_curves = np.concatenate([np.zeros(0, dtype=np.int64), *(at for _, at in tables)])
    whole, every = np.concatenate([jacobian, *(columns for columns, _ in tables)], axis=2), [*index, *of_curves]
    tall = whole.reshape(-1, whole.shape[2])
    gram = tall.T @ tall / len(whole)  # of a covariance C the mean square distance is the sum of gram * C
    inside = gram[: len(index), : len(index)]
    spread /= max(float(np.sum(inside * spread)), 1e-300)
    beside = beside_known(covariance, index, of_curves)
    freedom = max(rows - round(effective + g), 1)
    data = held.at.rows
    written = PredictingModel(
        model, values, data, beside, float(np.sqrt(variance)), freedom, spread, entries, tuple(curves)
    )
    more = float(np.sum(gram * covariance[np.ix_(every, every)]) - np.sum(inside * beside))
    lacking = 0.0 if held is posterior else variance - _noise_variance(posterior)
    return written.allowing(more + jacobian.shape[1] * max(lacking, 0.0))


def _noise_variance(posterior: Posterior) -> float:
    """Expected variance of a whitened coordinate's noise [mm^2]."""
    variance = 0.0
    for number, (problem, draws) in enumerate(zip(posterior.problems, posterior.draws, strict=True)):
        share = sum(e.probability for e in posterior.explanations if e.noise == number) / draws.total()
        variance += share * sum(n * problem.products.state(key).variance for key, n in draws.items())
    return variance


def _mixed(posterior: Posterior) -> tuple[dict[str, tuple[Block, Index]], Array, Array, Array, float, float]:
    """The mixture over explanations, with the rest of the library, dozens of effects, only where it is likelier than
    not: of changes of the base's g parameters, and of the parameters of the blocks that are likely enough behind them.

    Returns label of each block -> it and the (k,) places of its parameters; their mean (P,) and covariance (P, P); (g,
    P) by which the base gives way to each parameter of a block; the variance of the noise [mm^2], and the number of
    parameters beside the base's. The base's parameters are those beside what an arm file can have: what it cannot have
    stays with the base.
    """
    rest = sum(e.probability for e in posterior.explanations if any(b.parts for b in e.blocks)) >= 0.5
    likely = [e for e in posterior.explanations if rest or not any(b.parts for b in e.blocks)]
    total = sum(one.probability for one in likely)
    shares, blocks = dict[str, float](), dict[str, Block]()
    for one in likely:
        inside = {part.label: part for b in one.blocks for part in (b.parts or (b,))}
        blocks |= inside
        shares |= {label: shares.get(label, 0.0) + one.probability / total for label in inside}
    order = {block.label: k for k, block in enumerate(posterior.whole.blocks)}
    kept = [b for b in blocks.values() if shares[b.label] >= LEVEL and b.row is None]
    kept.sort(key=lambda b: order.get(b.label, len(order)))
    widths = {b.label: c.shape[2] for p in posterior.problems for b, c in zip(p.blocks, p.columns, strict=True)}
    base = posterior.whole.base
    g = len(base)
    ends = g + np.cumsum([0, *(_width(b) or widths[b.label] for b in kept)])
    places = {b.label: (b, np.arange(*ends[k : k + 2])) for k, b in enumerate(kept)}
    count = int(ends[-1])
    mean, second, response = np.zeros(count), np.zeros((count, count)), np.zeros((g, count))
    variance = effective = 0.0
    for number, (problem, drawn) in enumerate(zip(posterior.problems, posterior.draws, strict=True)):
        weight = sum(one.probability for one in likely if one.noise == number) / total
        without = {k for k, b in enumerate(problem.blocks) if b.parts and not rest}
        draws = {key: n for key, n in drawn.items() if not without & {b for b, _ in key}}
        if not draws or weight == 0.0:
            continue
        products, turn = problem.products, _to_parameters(problem, places, g, count)
        states, counts = [products.state(key) for key in draws], np.array([*draws.values()])
        first, of_two, noise = mixed(states, counts / counts.sum())
        used = [float(np.sum(1.0 - np.diag(state.covariance) / np.square(state.sizes))) for state in states]
        effective += weight * float(np.average(used, weights=counts))
        moved = np.concatenate([problem.base - base, np.zeros(count - g)])
        across = np.outer(turn @ first, moved)
        mean += weight * (turn @ first + moved)
        second += weight * (turn @ of_two @ turn.T + across + across.T + np.outer(moved, moved))
        second[:g, :g] += weight * noise * problem.normal
        variance += weight * noise
        for b, block in enumerate(problem.blocks):
            if block.label in places:
                given = problem.response[:, products.places([b])] @ np.linalg.pinv(problem.roots[b])
                response[:, places[block.label][1]] = given
    covariance = second - np.outer(mean, mean)
    return places, mean, (covariance + covariance.T) / 2.0, response, variance, effective


def _width(block: Block) -> int:
    """Number of parameters of what an arm file can have, else 0."""
    return block.size or (WAVES if block.span is not None else 0)


def _to_parameters(problem: Linearized, places: dict[str, tuple[Block, Index]], g: int, count: int) -> Array:
    """(P, C) from the coefficients of a problem's columns to the base's parameters and those of the blocks."""
    turn = np.zeros((count, int(problem.products.starts[-1])))
    for b, block in enumerate(problem.blocks):
        own, parts, row = problem.products.places([b]), block.parts or (block,), 0
        for part in parts:
            width = _width(part) or len(problem.roots[b])
            if part.label in places:
                turn[np.ix_(places[part.label][1], own)] = problem.roots[b][row : row + width]
            row += width
        if block.row is not None or any(_width(part) and part.label in places for part in parts):
            turn[:g, own] = problem.response[:, own]
    return turn


def beside_known(covariance: Array, kept: Index, conditioned: Index) -> Array:
    """Covariance of the parameters `kept` once those `conditioned` have their values.

    Combinations of the known ones that hardly vary are taken as not known: what is there of them is rounding, which
    their inverse would amplify.
    """
    sizes = np.sqrt(np.diag(covariance)[conditioned].clip(min=0.0))
    scale = np.where(sizes > 0.0, sizes, np.inf)
    values, vectors = np.linalg.eigh(covariance[np.ix_(conditioned, conditioned)] / np.outer(scale, scale))
    seen = values > VISIBLE
    across = covariance[np.ix_(kept, conditioned)] / scale @ (vectors[:, seen] / np.sqrt(values[seen]))
    beside = covariance[np.ix_(kept, kept)] - across @ across.T
    # rounding of the difference is no variance: an arm file's covariance is positive semidefinite
    sizes = np.sqrt(np.diag(beside).clip(min=0.0))
    scale = np.where(sizes > 0.0, sizes, np.inf)
    values, vectors = np.linalg.eigh(beside / np.outer(scale, scale))
    root = sizes[:, None] * vectors * np.sqrt(values.clip(min=0.0))
    return np.asarray(root @ root.T)


# -- error curves ------------------------------------------------------------------------------------------------------
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
    def spec(self) -> EffectSpec:
        """The effect as an entry of an arm file."""
        return EffectSpec("joint_error_curve", self.joint, curve=self.table)

    @property
    def key(self) -> str:
        """`joint_error_curve:1`"""
        return self.spec.key

    @cached_property
    def described(self) -> tuple[str, list[dict[str, Any]]]:
        """Description of its shape, and the waves that it consists of, strongest first."""
        return shape_and_waves(self.angles, self.error, self.std)

    def table_rows(self) -> list[tuple[float, ...]]:
        """Rows of `--curves`: joint, then angle, correction, standard deviation and error [deg]; with the correction
        added to the command the joint reaches the angle."""
        correction = -self.error
        for _ in range(3):  # the error at the corrected command; slopes are far below one
            correction = -self.table.at(self.angles + correction)
        columns = np.degrees([self.angles, correction, self.std, self.error])
        return [(self.joint, *(round(float(v), 7) for v in row)) for row in columns.T]

    def to_json(self) -> dict[str, Any]:
        """An entry of `curves` (identification/files/README.md, "JSON keys")."""
        columns, (shape, waves) = list(zip(*self.table_rows(), strict=True))[1:], self.described
        start, stop, length = np.degrees([self.table.start, self.table.stop, self.table.spacing]).tolist()
        head = {"joint": self.joint, "from_deg": start, "to_deg": stop, "length_deg": length, "shape": shape}
        tables = {name: list(column) for name, column in zip(COLUMNS, columns, strict=True)}
        return {**head, "waves": waves, **tables}


def curves_text(curves: Sequence[Curve]) -> str:
    """The CSV table of `armcal diagnose --curves`: the correction of the commanded angle at every half node."""
    rows = [row for curve in curves for row in curve.table_rows()]
    return "".join(",".join(map(str, line)) + "\n" for line in (("joint", *COLUMNS), *rows))


def shape_and_waves(angles: Array, error: Array, std: Array) -> tuple[str, list[dict[str, Any]]]:
    """Description of a curve in words, by name or by its waves; and the waves that make up most of it, strongest first:
    added one by one, all refitted after each.

    The wave amplitude cos(order q - phase), an entry of `waves` (identification/files/README.md, "JSON keys"), has the
    lowest and highest orders [per turn] not distinguishable from its own within the measured range, and the share of
    the curve's weighted variance that it explains beside the waves before it.

    angles, error, std : (a,) of the curve [rad]

    Whole numbers of periods per turn are tried, up to the Nyquist limit of nodes at every other angle.
    Orders that differ by less than one period over the range are not distinguished.
    """
    half = np.pi / float(np.ptp(angles))  # orders that differ by less part by less than half a period over the range
    tried = np.arange(max(1.0, np.ceil(half)), half * (len(angles) - 1) / 2.0)
    weights = 1.0 / np.maximum(std, 1e-3 * float(np.max(std)) + 1e-150)

    def fitted(columns: Sequence[Array]) -> tuple[float, Array]:
        """Weighted squares that a fit of functions (a,) beside a constant leaves, and their coefficients."""
        table = np.column_stack([np.ones(len(error)), *columns]) * weights[:, None]
        values = np.linalg.lstsq(table, error * weights, rcond=VISIBLE)[0]
        return float(np.sum((error * weights - table @ values) ** 2)), np.asarray(values[1:])

    def of_orders(orders: Sequence[float]) -> tuple[float, Array]:
        return fitted([wave(k * angles) for k in orders for wave in (np.cos, np.sin)])

    chosen, left = list[float](), [fitted(())[0]]
    while left[0] > 0.0 and len(tried) and len(chosen) < MOST_WAVES:
        trials = [of_orders((*chosen, k))[0] for k in tried]
        best = int(np.argmin(trials))
        if left[-1] - trials[best] < (1.0 - SHAPED) / MOST_WAVES * left[0]:
            break
        chosen.append(float(tried[best]))
        left.append(trials[best])
        tried = tried[np.abs(tried - chosen[-1]) >= 2.0 * half]
    waves = []
    for k, (a, b), gain in zip(chosen, of_orders(chosen)[1].reshape(-1, 2), -np.diff(left), strict=True):
        amplitude, phase = np.degrees([np.hypot(a, b), np.arctan2(b, a)]).tolist()
        wave = {"order": k, "orders": (max(k - half, 0.0), k + half), "amplitude_deg": amplitude, "phase_deg": phase}
        waves.append({**wave, "share": float(gain / left[0])})

    where, share = (
        f"over {np.degrees(angles[0]):.0f} to {np.degrees(angles[-1]):.0f} deg",
        sum(w["share"] for w in waves),
    )
    steps = [fitted([np.sign(angles - at)]) for at in (angles[1:] + angles[:-1]) / 2.0]
    best = min(range(len(steps)), key=lambda k: steps[k][0])
    shape = f"smooth curve {where}"
    if left[0] > 0.0 and 1.0 - steps[best][0] / left[0] >= max(SHAPED, share):
        at, size = np.degrees([angles[best : best + 2].mean(), 2.0 * steps[best][1][0]])
        shape = f"step of {size:.2g} deg at {at:.0f} deg {where}"
    elif waves:
        amplitudes = {wave["order"]: wave["amplitude_deg"] for wave in waves}
        first = min(amplitudes)  # a sawtooth has waves of orders k, 2k, 3k with amplitudes as 1, 1/2, 1/3
        ratios = [amplitudes.get(n * first, 0.0) * n / amplitudes[first] for n in (2, 3)]
        listed = []
        for order, (low, high), amplitude, *_ in (wave.values() for wave in waves):
            between = f" ({low:.3g} to {high:.3g})" if high - low >= 0.5 else ""
            listed.append(f"{order:g}{between} per turn, {amplitude:.2g} deg")
        kind = "waves" if share >= SHAPED else "in part waves"
        shape = f"{kind}: {'; '.join(listed)} ({100.0 * share:.0f} %) {where}"
        if share >= SHAPED and np.allclose(ratios, 1.0, atol=1.0 / 3.0):
            shape = f"sawtooth, {first:g} per turn, {where}"
    return shape, waves
