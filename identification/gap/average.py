"""The model that predicts best: the average over the posterior, in the form of an arm file."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from identification.arm import SESSIONS, EffectSpec, ErrorCurve
from identification.arrays import Array
from identification.estimation.uncertainty import LEVEL_95 as LEVEL
from identification.gap.blocks import WAVES, Block, around, curve_waves, slope_by_angle
from identification.gap.fit import Fitted
from identification.gap.likelihood import Index, Key, mixed
from identification.gap.search import PASSES, Posterior
from identification.information import VISIBLE, conditional_covariance
from identification.measurements import rms_distance
from identification.model import Model

BENT = 0.5  # numerical: of the noise of a coordinate, by which distances from linear positions may be larger
FAITHFUL = 0.01  # numerical: of an error curve, by which its table may miss it in the root mean square


@dataclass(frozen=True, eq=False)
class PredictingModel(Fitted):
    """The predicting model, and the rows that it was made from.

    covariance : (p, p) of its parameters;  specs : entries of the arm file beyond the base's;  curves : among them
    sigma : of one coordinate [mm];  freedom : residual degrees of freedom
    spread : (p, p) covariance as of noise, with a mean square distance of 1 mm^2 at the postures measured
    """

    covariance: Array = field()  # these three instead of those of a least-squares fit
    sigma: float = field()
    freedom: int = field()
    spread: Array
    specs: tuple[EffectSpec, ...] = ()
    curves: tuple[Curve, ...] = ()

    def allowing(self, square: float) -> PredictingModel:
        """With a further mean square distance [mm^2] in the covariance, as if there were so much more noise."""
        return replace(self, covariance=self.covariance + max(square, 0.0) * self.spread)


def as_fitted(fit: Fitted, specs: Sequence[EffectSpec] = ()) -> PredictingModel:
    """A least-squares fit as a predicting model;  specs : its effects beyond the base's"""
    covariance, columns, freedom = fit.covariance, fit.linearized[1], max(fit.freedom, 1)
    spread = covariance / max(float(np.sum((columns @ covariance) * columns)) / len(columns), 1e-300)
    return PredictingModel(fit.model, fit.values, fit.rows, covariance, fit.sigma, freedom, spread, tuple(specs))


def averaged(posterior: Posterior, coordinates: int) -> tuple[PredictingModel, Array, Posterior]:
    """The posterior's average as a model, by how much its positions (m, d) [mm] differ from linear ones, and the
    posterior that it is of: where that is much, and as long as residuals fall, it is linearized again at its average.
    coordinates : number of those that it is fitted to"""
    best, bend, mean = as_model(posterior, coordinates)
    for _ in range(PASSES):
        if rms_distance(bend) <= BENT * best.sigma:
            break
        nearer = posterior.about(mean)
        better, less, mean = as_model(nearer, coordinates)
        if rms_distance(better.errors) >= rms_distance(best.errors):
            break
        posterior, best, bend = nearer, better, less
    return best, bend, posterior


def as_model(posterior: Posterior, coordinates: int) -> tuple[PredictingModel, Array, Fitted]:
    """As `averaged`, of a posterior as it is linearized, and its average with effects alone, without error curves."""
    whole, library, rows, g = posterior.whole, posterior.library, posterior.at.rows, len(posterior.whole.base)
    arm = library.arm
    chances = defaultdict[str, float](float)
    for one in posterior.explanations:
        for block in one.blocks:
            chances[block.label] += one.probability

    # the base's parameters, and those of all blocks that are likely enough; the base gives way to rows left out, too
    kept = [b for b in whole.blocks if not b.rows and chances[b.label] >= LEVEL]
    ends = g + np.cumsum([0, *(whole.columns[whole.numbers[b.label]].shape[2] for b in kept)])
    numbers_of = {b.label: np.arange(*ends[k : k + 2]) for k, b in enumerate(kept)}
    geometry_of, used = defaultdict[str, Array](lambda: np.zeros(g)), 0.0
    means, covariances, noises = list[Array](), list[Array](), list[float]()
    for problem, draws, share in zip(posterior.problems, posterior.draws, posterior.shares.tolist(), strict=True):
        # each set without the blocks that are left out, of which the others take on what they can
        writable = {k for k, b in enumerate(problem.blocks) if b.rows or b.label in numbers_of}
        counts = Counter[Key]()
        for key, count in draws.items():
            counts[tuple(pair for pair in key if pair[0] in writable)] += count
        states, drawn = [problem.products.state(key) for key in counts], np.array([*counts.values()]) / draws.total()
        first, covariance, of_noise = mixed(states, drawn)
        taken = [len(state.sizes) - np.diag(state.covariance) @ state.sizes**-2.0 for state in states]
        used += share * float(drawn @ taken)
        turn = np.zeros((int(ends[-1]), len(first)))
        for b in writable:
            columns, label = problem.products.columns_of([b]), problem.blocks[b].label
            turn[:g, columns] = problem.response[:, columns]
            if label in numbers_of:
                turn[np.ix_(numbers_of[label], columns)] = problem.roots[b]
                geometry_of[label] += share * problem.response[:, columns] @ first[columns]
        means.append(turn @ first)
        covariances.append(turn @ covariance @ turn.T)
        means[-1][:g] += problem.base
        covariances[-1][:g, :g] += of_noise * problem.normal
        noises.append(of_noise)
    mean, variance = posterior.shares @ np.array(means), float(posterior.shares @ noises)
    apart = np.array(means) - mean
    covariance = np.tensordot(posterior.shares, covariances, 1) + (apart.T * posterior.shares) @ apart
    freedom = max(coordinates - round(used) - g, 1)
    # what physics bounds is held at its bounds where it is beyond, and all else gives way
    lower, upper = np.full(len(mean), -np.inf), np.full(len(mean), np.inf)
    bounded = dict(enumerate(library.base.parameters))
    for effect in (b.effect for b in kept if b.effect is not None):
        bounded |= zip(numbers_of[effect.label].tolist(), effect.parameters, strict=True)
    for k, parameter in bounded.items():
        lower[k], upper[k] = parameter.lower, parameter.upper
    free, held = mean, np.zeros(len(mean), dtype=bool)
    while np.any(beyond := (mean < lower) | (mean > upper)):
        held, ends = held | beyond, np.clip(mean, lower, upper)
        share = np.linalg.pinv(covariance[np.ix_(held, held)], hermitian=True) @ (ends - free)[held]
        mean = np.where(held, ends, free + covariance[:, held] @ share)

    def of_effects(blocks: Sequence[Block]) -> tuple[Model, Index]:
        """The model with these effects, and the numbers of its parameters among all."""
        wider = library.model(blocks)
        renamed = library.renamed(wider)
        place = {renamed.get(name, name): k for k, name in enumerate(library.base.names)}
        for block, effect in zip(blocks, wider.effects[len(wider.effects) - len(blocks) :], strict=True):
            place |= {p.name: k for p, k in zip(effect.parameters, numbers_of[block.label].tolist(), strict=True)}
        return wider, np.array([place[name] for name in wider.names], dtype=np.int64)

    # an error curve takes up all else that depends on its joint's angle alone: within the angles measured they may
    # cancel, and beyond them, where a curve does not hold, their sum is worth no more
    of_curves = list[tuple[tuple[int, float, float], dict[str, Callable[[Array], Array]]]]()
    for joint, start, stop in (b.span for b in kept if b.span is not None):
        slopes = {b.label: slope_by_angle(b.effect, joint, library.base) for b in kept if b.effect is not None}
        functions = {label: slope for label, slope in slopes.items() if slope is not None}
        waves = {f"curve:{joint + 1}": partial(curve_waves, start=start, stop=stop)}
        of_curves.append(((joint, start, stop), waves | functions))
    absorbed = [label for _, functions in of_curves for label in functions]
    members = [b for b in kept if b.listed and b.label not in absorbed]
    unlisted = [b.effect for b in kept if b.effect and b.effect.unlisted]
    plain, index = of_effects(members)
    values = mean[index]

    curves = list[Curve]()
    beside_curves = [effect.label for effect in unlisted if effect.joint]  # off with the first
    for (joint, start, stop), functions in of_curves:
        at = np.concatenate([numbers_of[label] for label in functions])
        beside = conditional_covariance(covariance, at, np.setdiff1d(np.arange(len(mean)), at))
        # the part of the geometry that was fitted together with the curve, but for what only these sessions or targets
        # have; shifts of the base along its axes
        together = [*functions, *(beside_curves if not curves else ())]
        parts = np.sum([geometry_of[label] for label in together], axis=0).tolist()
        named = zip(library.base.names, parts, strict=True)
        of_others = f"{SESSIONS}.", f"{arm.chain.instrument.own_targets}["
        shifted = {name: value for name, value in named if not name.startswith(of_others)}
        along = arm.chain.along_base(shifted, plain.parameters.mapping(values), back=True)
        shifted |= {name: float(value) for name, value in along.items() if name in shifted}
        # the table goes through their sum at the angles measured, and as a random walk does where there are none: there
        # they, too, may add up that cancel elsewhere
        commanded = rows.postures[:, joint]
        q = around(commanded, start, stop)
        for steps in (WAVES * 2**k for k in range(5)):  # eight a period of the fastest waves, as a rule
            angles = np.linspace(start, stop, 2 * steps + 1)
            numbers, rows_there = np.unique(np.rint((q - start) / (angles[1] - start)).astype(int), return_index=True)
            nearest = rows_there[np.abs(np.arange(len(angles))[:, None] - numbers).argmin(axis=1)]
            # as commanded: a wave of broken order is no function of the angle on the circle
            turned = angles + (commanded - q)[nearest]
            values_at = np.column_stack([function(turned) for function in functions.values()])
            error = values_at @ mean[at]
            table = ErrorCurve.through(start, stop, angles[numbers], error[numbers], steps + 1, shifted)
            missed, size = (float(np.sqrt(np.mean(np.square(x[numbers])))) for x in (table.at(angles) - error, error))
            if missed <= FAITHFUL * max(size, 1e-6):  # a microradian is none
                break
        # beside all else that goes with it: what they exchange makes no difference to any point
        std = np.sqrt(np.maximum(np.sum((values_at @ beside) * values_at, axis=1), 0.0))
        curves.append(Curve(joint + 1, table, std))
    # errors of any form keep their values, as curves do: no fit without their prior should change them
    entries = [b.effect.spec for b in members if b.effect]
    for effect in unlisted:
        fixed = zip((p.short for p in effect.parameters), mean[numbers_of[effect.label]].tolist(), strict=True)
        entries.append(replace(effect.spec, values={**effect.spec.values, **dict(fixed)}))
    entries += [EffectSpec("joint_error_curve", curve.joint, curve=curve.table) for curve in curves]
    model = Model(arm.with_effects(*arm.effects, *entries))

    # a file stores the covariance of parameters, not of curves: it is taken beside the curves as they are written, then
    # raised so that the mean square error of the tip at the postures measured is that of the whole posterior
    of_base, spread = np.flatnonzero(index < g), np.zeros((len(index), len(index)))
    normal = posterior.problems[posterior.best.noise].normal
    spread[np.ix_(of_base, of_base)] = normal[np.ix_(index[of_base], index[of_base])]
    position, jacobian = Fitted(model, values, rows).linearized
    left, own = library.as_base(posterior.at)
    parts = [whole.columns[whole.numbers[label]] @ mean[numbers] for label, numbers in numbers_of.items()]
    parts.append(posterior.at.linearized[1][:, :, own] @ (mean[:g] - posterior.at.values[own]))
    bend = position - (rows.positions - left + sum(parts))
    tabulated = [*absorbed, *(effect.label for effect in unlisted)]
    conditioned = np.concatenate([index[:0], *(numbers_of[label] for label in tabulated)])
    columns = np.concatenate([jacobian, *(whole.columns[whole.numbers[label]] for label in tabulated)], axis=2)
    tall, every = columns.reshape(-1, columns.shape[2]), [*index, *conditioned]
    gram = tall.T @ tall / len(columns)  # of a covariance C the mean square distance is the sum of gram * C
    inside, beside = gram[: len(index), : len(index)], conditional_covariance(covariance, index, conditioned)
    spread /= max(float(np.sum(inside * spread)), 1e-300)
    square = float(np.sum(gram * covariance[np.ix_(every, every)]) - np.sum(inside * beside))
    sigma, specs = float(np.sqrt(variance)), tuple(entries)
    wide, numbers = of_effects([b for b in kept if b.effect is not None])
    predicting = PredictingModel(model, values, rows, beside, sigma, freedom, spread, specs, tuple(curves))
    return predicting.allowing(square + rms_distance(bend) ** 2), bend, Fitted(wide, mean[numbers], rows)


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

    # (a,) every half node, and values of the function there [rad]
    angles = property(lambda self: np.linspace(self.table.start, self.table.stop, len(self.std)))
    error = property(lambda self: self.table.at(self.angles))
    described = cached_property(lambda self: shape_and_waves(self.angles, self.error, self.std))

    def to_json(self) -> dict[str, Any]:
        """An entry of `curves` (identification/files/README.md, "JSON keys"): at every half node the correction that,
        added to the command, brings the joint to the angle."""
        correction, (shape, waves) = -self.error, self.described
        for _ in range(3):  # the error at the corrected command; slopes are far below one
            correction = -self.table.at(self.angles + correction)
        start, stop, length = np.degrees([self.table.start, self.table.stop, self.table.spacing]).tolist()
        head = {"joint": self.joint, "from_deg": start, "to_deg": stop, "length_deg": length, "shape": shape}
        columns = {"angle_deg": self.angles, "correction_deg": correction, "std_deg": self.std, "error_deg": self.error}
        table = {name: np.degrees(column).round(7).tolist() for name, column in columns.items()}
        return {**head, "waves": waves, **table}


def shape_and_waves(angles: Array, error: Array, std: Array) -> tuple[str, list[dict[str, Any]]]:
    """Description of a curve in words, and the waves that make up most of it, strongest first: added one by one, all
    refitted after each, by weighted least squares beside a constant.

    The wave amplitude cos(order q - phase), an entry of `waves` (identification/files/README.md, "JSON keys"), has the
    lowest and highest orders [per turn] not distinguishable from its own within the measured range, and the share of
    the curve's weighted variance that it explains beside the waves before it. They describe the curve if they explain
    0.8 of it.

    angles, error, std : (a,) of the curve [rad]
    Whole numbers of periods per turn are tried, up to the Nyquist limit of nodes at every other angle.
    Orders that differ by less than one period over the range are not distinguished.
    """
    half = np.pi / float(np.ptp(angles))  # orders that differ by less part by less than half a period over the range
    tried = np.arange(max(1.0, np.ceil(half)), half * (len(angles) - 1) / 2.0)
    weights = 1.0 / np.maximum(std, 1e-3 * float(np.max(std)) + 1e-150)

    def fitted(orders: Sequence[float]) -> tuple[float, Array]:
        """Weighted squares that waves leave, and their coefficients."""
        columns = [wave(k * angles) for k in orders for wave in (np.cos, np.sin)]
        table = np.column_stack([np.ones(len(error)), *columns]) * weights[:, None]
        values = np.linalg.lstsq(table, error * weights, rcond=VISIBLE)[0]
        return float(np.sum((error * weights - table @ values) ** 2)), np.asarray(values[1:], float)

    chosen, left, most = list[float](), [fitted(())[0]], 6
    while left[0] > 0.0 and len(tried) and len(chosen) < most:
        trials = [fitted((*chosen, k))[0] for k in tried]
        best = int(np.argmin(trials))
        if left[-1] - trials[best] < 0.2 / most * left[0]:
            break
        chosen.append(float(tried[best]))
        left.append(trials[best])
        tried = tried[np.abs(tried - chosen[-1]) >= 2.0 * half]
    waves, listed = list[dict[str, Any]](), list[str]()
    for k, (a, b), gain in zip(chosen, fitted(chosen)[1].reshape(-1, 2), -np.diff(left), strict=True):
        amplitude, phase = np.degrees([np.hypot(a, b), np.arctan2(b, a)]).tolist()
        size, orders = {"amplitude_deg": amplitude, "phase_deg": phase}, (max(k - half, 0.0), k + half)
        waves.append({"order": k, "orders": orders, **size, "share": float(gain / left[0])})
        between = " ({:.3g} to {:.3g})".format(*orders) if half >= 0.25 else ""
        listed.append(f"{k:g}{between} per turn, {amplitude:.2g} deg")
    where, share = "over {:.0f} to {:.0f} deg".format(*np.degrees(angles[[0, -1]])), sum(w["share"] for w in waves)
    kind = "waves" if share >= 0.8 else "in part waves"
    return f"{kind}: {'; '.join(listed)} ({100.0 * share:.0f} %) {where}" if waves else f"smooth curve {where}", waves
