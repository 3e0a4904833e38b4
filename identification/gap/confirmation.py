"""Whether rows that were not used for a model confirm it: does the gap shrink, and as far as predicted?

Where base or instrument of a hold-out stand elsewhere, or the measured point is another one, both models are placed
again in its rows, as `validate` places them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtri, softmax, stdtrit

from identification.arm import Calibration
from identification.arrays import Array
from identification.errors import InputError
from identification.estimation.doubts import FALL
from identification.estimation.repeats import NoiseFloor
from identification.estimation.uncertainty import GROUPS, Groups, Mean, groups_of, mean_of
from identification.estimation.uncertainty import LEVEL_95 as LEVEL
from identification.gap.average import PredictingModel
from identification.gap.detectability import POWER
from identification.gap.fit import Fitted
from identification.gap.likelihood import mixed
from identification.gap.search import MOST, Posterior
from identification.information import ALONE, spectrum
from identification.measurements import POINT, Conditions, Measurements, distances
from identification.validate import placed

SESSION, OTHER_ROWS, LATER = "another session", "other rows", "a later time"


# -- the test ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Confirmation:
    """Result of the test of a model on rows that were not used for the fit.

    transfer : origin of these rows: `other postures`, `a later time`, `another session` ..
    by : `holdout` or `cross-validation`;  rows, groups : number of rows and of independent groups
    p_shrinks, p_exceeds : one-sided p-values of "the gap does not shrink", None where no effect was named, so that it
        does not have to, and of "the gap is as predicted"
    shrinks, as_predicted : conclusions; None where the rows are too few
    file : that the rows come from, where only its order numbers tell that they are another session; else None
    before_mm, after_mm : RMS distance of base and tested model in these rows;  predicted_mm : expected `after_mm`
    max_before_mm, max_after_mm : distances of the row that is farthest off
    refitted : what was fitted to these rows first, since they are of another set-up: `base`, `reflector C`
    beyond_sigma : whether in held-out rows more is left than the given sigma explains, at `LEVEL`
    """

    transfer: str
    by: str
    rows: int
    groups: int
    p_shrinks: float | None
    p_exceeds: float
    shrinks: bool | None
    as_predicted: bool | None
    file: str | None
    before_mm: float
    after_mm: float
    predicted_mm: float
    max_before_mm: float
    max_after_mm: float
    refitted: tuple[str, ...]
    beyond_sigma: bool = False

    @property
    def confirmed(self) -> bool | None:
        """Overall conclusion; None where the rows are too few."""
        if self.shrinks is False or self.as_predicted is False:
            return False
        return self.as_predicted if self.p_shrinks is None else self.shrinks

    def to_json(self) -> dict[str, object]:
        """Key `confirmation`, and an entry of `cross_validation` (identification/files/README.md, "JSON keys")."""
        return vars(self) | {"confirmed": self.confirmed, "refitted": [*self.refitted]}


def confirm(
    before: Array,
    after: Array,
    predicted: Mean,
    sigma: float,
    by_groups: Sequence[Groups],
    transfer: str,
    by: str = "holdout",
    level: float = LEVEL,
    named: bool = True,
    file: str | None = None,
    refitted: tuple[str, ...] = (),
) -> Confirmation:
    """Test whether the gap shrinks and whether it exceeds the prediction, each one-sided at half of `level`.

    before, after : (m, d) residuals [mm] of base and tested model;  predicted : expected mean square of the latter
    sigma : noise of one coordinate [mm];  by_groups : groupings of the rows, (m,) each;  others : see `Confirmation`

    If the model is right, the mean gain of m rows is normal with mean R = mean square distance between the models and
    variance 4 sigma^2 R / m. The absence of any gain then has probability Phi(-sqrt(m R) / 2 sigma); where that is
    below the level, a gain that is not positive refutes the model.
    """
    m, d = after.shape
    squares, left = np.square(before).sum(axis=1), np.square(after).sum(axis=1)
    moved = float(np.sum(np.square(before - after)))  # m R
    gain = mean_of(squares - left, by_groups, 4.0 * sigma**2 * moved / m**2)
    excess = mean_of(left, by_groups, 2.0 * d * sigma**4 / m) - predicted
    named, shrinks = named and moved > 0.0, None
    if named and gain.p_above() <= level / 2.0:
        shrinks = True
    elif named:
        sure = gain.value <= 0.0 and np.sqrt(moved) > -2.0 * sigma * ndtri(level / 2.0)
        shrinks = False if sure or gain._replace(value=-gain.value).p_above() <= level / 2.0 else None
    # whether a test at `LEVEL` would detect a true mean of the size predicted with power `POWER`
    quantiles = stdtrit(excess.freedom, 1.0 - LEVEL / 2.0) + stdtrit(excess.freedom, POWER)
    detects = excess.variance < np.inf and predicted.value >= quantiles * np.sqrt(excess.variance)
    exceeds, groups = excess.p_above(), min(int(groups.max()) + 1 for groups in by_groups)
    answers: dict[str, Any] = {"p_shrinks": gain.p_above() if named else None, "p_exceeds": exceeds, "shrinks": shrinks}
    answers["as_predicted"] = False if exceeds <= level / 2.0 else True if detects else None
    squared = {"before": np.mean(squares), "after": np.mean(left), "predicted": predicted.value}
    squared |= {"max_before": squares.max(), "max_after": left.max()}
    answers |= {f"{name}_mm": float(np.sqrt(square)) for name, square in squared.items()}
    return Confirmation(transfer, by, m, groups, **answers, file=file, refitted=refitted)


class Gap(NamedTuple):
    """RMS distances between model and measurement [mm]; None where not available.

    rms_before, rms_after : of the base model, and of the predicting model; both without outliers
    held_out_before, held_out_after : of the same two models on the held-out data;  predicted : expected held-out value
    floor : noise floor, which no model can go below
    """

    rms_before: float
    rms_after: float
    floor: NoiseFloor = NoiseFloor()
    held_out_before: float | None = None
    held_out_after: float | None = None
    predicted: float | None = None

    def to_json(self) -> dict[str, float | str | None]:
        """Keys of `gap` (identification/files/README.md, "JSON keys")."""
        return {f"{name}_mm": value for name, value in self._asdict().items() if name != "floor"} | self.floor.to_json()


# -- rows held out -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class HeldOut:
    """Rows that were not used for a model, and how they differ from its data.

    conditions : temperatures count from where those of the data do, time is on their scale if both are of one session,
        and points that the data do not have are the first
    transfer : kind of transfer that they test;  elsewhere : whether base and points may be elsewhere
    over : whether the session of the data was over, and a drift or a step in it at its end
    """

    rows: Measurements
    conditions: Conditions
    transfer: str
    elsewhere: bool
    over: bool = False

    @classmethod
    def of(cls, rows: Measurements, data: Measurements) -> HeldOut:
        """Of rows beside the data: a name that these lack, order numbers that occur in both, or a pause between them
        that is longer than the data, mean two sessions; where numbers start again, drifts may, too. One point of the
        data is the one of the rows, whatever it is called there, as in an arm file."""
        another, rows = bool({*rows.sessions} - {*data.sessions}), rows.of_sessions(data)
        changes, transfer = dict[str, Array | None](marker=np.zeros(len(rows))), SESSION if another else OTHER_ROWS
        if data.temperature is not None and rows.temperature is not None:
            changes["temperature"] = rows.temperature - data.reference_temperature
        if not another and data.order is not None and rows.order is not None:
            first, last, span = data.order.min(), data.order.max(), np.ptp(data.order)
            later, earlier = rows.order.min() - last, first - rows.order.max()
            another = later > span
            if another or earlier > span or len(np.intersect1d(data.order, rows.order)):
                transfer = SESSION
            else:
                transfer = LATER if later > 0.0 else "an earlier time" if earlier > 0.0 else "other postures"
                changes["time"] = (rows.order - first) / span - 0.5 if span else rows.conditions.time
        if rows.marker is not None and data.marker_names:
            number = {name: k for k, name in enumerate(data.marker_names)}
            changes["marker"] = np.array([number.get(name, 0) for name in rows.marker.tolist()], dtype=float)
        elsewhere = transfer in (SESSION, OTHER_ROWS) or not {*rows.marker_names} <= {*data.marker_names}
        return cls(rows, replace(rows.conditions, **changes), transfer, elsewhere, another)

    def conditions_of(self, one: Fitted) -> Conditions:
        """Those for a model of the data."""
        return one.model.afterwards(self.conditions, len(self.rows)) if self.over else self.conditions

    def residuals(self, base: Fitted, model: Fitted) -> tuple[Array, Array, tuple[str, ...]]:
        """(m, d) residuals [mm] of both models, and in words what was fitted to the rows for both of them first: base
        and points, where that makes the RMS of the second fall by `FALL`; larger then by as much as these values make
        them smaller."""
        before, after = (one.residuals(self.rows, self.conditions_of(one))[:, POINT] for one in (base, model))
        chain, marker = base.model.arm.chain, self.rows.conditions.marker
        if not (self.elsewhere and chain.instrument.reads_positions):
            return before, after, ()
        calibrated = (
            (one, replace(one.model.arm, calibration=Calibration(one.model.best_known | one.by_name)))
            for one in dict.fromkeys((base, model))  # often one and the same
        )
        try:
            fits = [placed(arm, self.rows, replace(self.conditions_of(one), marker=marker)) for one, arm in calibrated]
        except InputError:  # too few rows
            return before, after, ()
        again = [left[:, POINT] * np.sqrt(left.size / max(left.size - count, 1)) for _, _, left, count in fits]
        if after.size <= 2 * fits[-1][3] or np.linalg.norm(after) <= FALL * np.linalg.norm(again[-1]):
            return before, after, ()
        points = [f"reflector {name}".strip() for name in self.rows.marker_names or ("",)] if chain.point_column else []
        return again[0], again[-1], ("base", *points)

    def parameter_part(self, model: PredictingModel) -> Mean:
        """Mean square distance [mm^2] due to errors of the parameters, tr(G C) with the variance 2 tr(G C G C),
        G = mean of J_i^T J_i over the rows and C the covariance."""
        columns = model.model.jacobian(self.rows.postures, model.values, self.conditions_of(model))
        tall = columns[:, POINT].reshape(-1, columns.shape[-1])
        product = tall.T @ tall / len(columns) @ model.covariance
        return Mean(float(np.trace(product)), 2.0 * float(np.trace(product @ product)), np.inf)

    def check_same_arm(self, base: PredictingModel, data: Measurements) -> None:
        """Raise `InputError` for residuals that are larger than any missing effect could make them: ten times those
        expected, and a hundredth of the reach."""
        expected = np.mean(distances(base.residuals(data)) ** 2) + self.parameter_part(base).value
        limit = max(10.0 * float(np.sqrt(expected)), 0.01 * base.model.reach)
        residuals, _, words = self.residuals(base, base)
        missed = float(np.median(distances(residuals)))  # a few outliers do not make it another arm
        if missed > limit:
            refitted = f", {' and '.join(words)} refitted to these rows" if words else ""
            target = base.model.arm.chain.instrument.own_targets
            moved = f", or a {target} that was moved (armcal validate finds it again)" if target else ""
            moved += "" if self.elsewhere else ", or another set-up (say so in a column session)"
            raise InputError(
                f"holdout: median residual {missed:.3g} mm with the arm calibrated on the data{refitted}, allowed: up "
                f"to {limit:.3g} mm; another arm or unit{moved}? armcal check tells what the columns look like"
            )

    def test(
        self,
        base: Fitted,
        model: PredictingModel,
        data: Measurements,
        kept: NDArray[np.bool_],
        named: bool,
        noise_factor: float,
    ) -> Confirmation:
        """Test a model.

        base, model : fitted to the kept rows (m,) of the data;  named : False if nothing was named
        noise_factor : noise to expect, in units of the variance that the residuals have

        Expected is the mean square that the model leaves in its own rows, larger by as much as its parameters were
        fitted to them, and what the errors of the parameters add in the new rows.
        """
        # whether what happened in the session of the data goes on, happens in another, too, or was over: as fits better
        later = [self, replace(self, over=True)] if self.transfer in (SESSION, OTHER_ROWS, LATER) else [self]
        tried = [(one, *one.residuals(base, model)) for one in later]
        held_out, before, after, refitted = min(tried, key=lambda each: float(np.linalg.norm(each[2])))
        squares = np.square(model.residuals(data)[kept, POINT]).sum(axis=1)
        # the variance that white Gaussian noise gives
        white = 2.0 * float(np.mean(squares)) ** 2 / max(model.freedom, 1)
        left, added = mean_of(squares, groups_of(data, kept), white), held_out.parameter_part(model)
        scale, d = noise_factor * len(squares) * model.model.dimension / max(model.freedom, 1), after.shape[1]
        given = model.model.arm.sigma if data.sigma is None else data.sigma[kept]
        here = model.model.arm.sigma if self.rows.sigma is None else self.rows.sigma
        if given is not None and here is not None:  # what the data's sigma says is noise is other noise here
            noise, other = (d * float(np.mean(np.square(sigma))) for sigma in (given, here))
            scale += min(scale, noise / max(left.value, 1e-300)) * (other / noise - 1.0)
        predicted = Mean(scale * left.value + added.value, scale**2 * left.variance + added.variance, left.freedom)
        sigma = float(np.sqrt(scale * left.value / d))
        file, groups = self.rows.provenance.get("file") if self.transfer == SESSION else None, groups_of(self.rows)
        test = confirm(before, after, predicted, sigma, groups, self.transfer, "holdout", LEVEL, named, file, refitted)
        if here is None:
            return test
        # noise of this sigma, and the parameters' errors: scaled chi-square (F. E. Satterthwaite, 1946)
        m, noise = len(after), np.square(here)
        expected = d * float(np.mean(noise)) + added.value
        variance = (2.0 * d * float(np.mean(noise**2)) + 4.0 * float(np.mean(noise)) * added.value) / m
        freedom = 2.0 * expected**2 / (variance + added.variance)
        return replace(test, beyond_sigma=bool(chdtrc(freedom, freedom * test.after_mm**2 / expected) <= LEVEL))


# -- each part of the rows predicted from the others -------------------------------------------------------------------
def cross_validation(
    posterior: Posterior,
    measurements: Measurements,
    kept: NDArray[np.bool_],
    generator: np.random.Generator,
    named: bool,
    noise_factor: float,
    bend: Array,
) -> tuple[Confirmation, ...]:
    """Test whether the average holds for other postures, and for another interval of time; as the sets were found with
    all rows, this can refute a model but not confirm it.

    kept : (m,) rows that are no outliers;  named : False if nothing was named;  noise_factor : as in `HeldOut.test`
    bend : (m, d) [mm] what the average computes beside what is linear, as in `averaged`
    """
    by_groups = groups_of(measurements, kept)
    postures = np.unique(measurements.posture_numbers[kept], return_inverse=True)[1]
    count = int(postures.max()) + 1
    parts = {
        "other postures": (generator.permutation(count) * min(GROUPS, count) // count)[postures],
        "another stretch of time": by_groups[0],
    }
    tests, level = list[Confirmation](), LEVEL / len(parts)  # Bonferroni
    predicted_rows = predicted_from_others(posterior, kept, [*parts.values()], noise_factor)
    for transfer, (before, after, expected) in zip(parts, predicted_rows, strict=True):
        more = bend[kept, POINT]
        after, expected = after - more, expected + float(np.mean(distances(more) ** 2))
        predicted, sigma = Mean(expected, 0.0, np.inf), float(np.sqrt(expected / after.shape[1]))
        tests.append(confirm(before, after, predicted, sigma, by_groups, transfer, "cross-validation", level, named))
    return tuple(tests)


def predicted_from_others(
    posterior: Posterior, kept: NDArray[np.bool_], partitions: Sequence[Groups], noise_factor: float = 1.0
) -> Iterator[tuple[Array, Array, float]]:
    """Each part of the kept rows predicted from the others, for partitions that have the number of each row's part.

    The likeliest sets of the posterior are weighed again by their likelihood on the other rows alone, at the sizes that
    they have, and their predictions averaged. Yields (m, d) residuals [mm] of the base model and of the average, and
    the mean square distance [mm^2] that the latter expects.
    """
    number = posterior.best.noise
    problem, rows = posterior.problems[number], posterior.noises[number].rows.pick(kept)
    at = posterior.at.on(rows)
    y, base = posterior.library.as_base(at)
    sets = [one for one in posterior.explanations if one.noise == number][:MOST]
    blocks = sorted({b for one in sets for b, _ in one.key if not problem.blocks[b].rows})
    part, local = problem.of(blocks), {b: k for k, b in enumerate(blocks)}
    pairs = [[(local[b], size) for b, size in one.key if b in local] for one in sets]
    # the prior of a set is what its odds have beyond its likelihood with all rows
    whole = [problem.products.state(one.key) for one in sets]
    priors = [np.log(one.probability) - state.ratio - state.signed for one, state in zip(sets, whole, strict=True)]
    # (m d, ..) the base's columns, orthonormal when white, the others, and y: in mm, and white
    back, (m, d) = spectrum(at.jacobian[:, base], at.model.scales[base]).root, y.shape
    columns = [c[kept].reshape(m * d, -1) @ root for c, root in zip(part.columns, part.roots, strict=True)]
    base_columns, rank = at.linearized[1][:, :, base].reshape(m * d, -1) @ back, back.shape[1]
    table = np.concatenate([base_columns, *columns, y.reshape(m * d, 1)], axis=1)
    white, points = rows.whiten(table.reshape(m, d, -1)), np.zeros((m, d), dtype=bool)
    points[:, POINT] = True
    # expected square of the noise of a row, for unit sigma
    spread = np.eye(d)[None] if rows.spread is None else rows.spread
    noise = float(np.sum(np.square(spread[:, POINT]))) / len(spread) * (1.0 + rows.shared)
    for folds in partitions:
        before, after, expected = np.empty((m, d)), np.empty((m, d)), 0.0
        tests = [folds == fold for fold in range(folds.max() + 1)]
        grams = np.array([tall.T @ tall for tall in (white[np.repeat(test, d)] for test in tests)])
        for test, others in zip(tests, np.sum(grams, axis=0) - grams, strict=True):
            values, vectors = np.linalg.eigh(others[:rank, :rank])
            seen = values > ALONE
            turn = vectors[:, seen] / np.sqrt(values[seen])
            inside = turn.T @ others[:rank, rank:]
            rest = others[rank:, rank:] - inside.T @ inside
            freedom = max(d * np.count_nonzero(~test) - turn.shape[1], 1)
            parts = {"gram": rest[:-1, :-1], "right": rest[:-1, -1], "squares": float(rest[-1, -1]), "freedom": freedom}
            states = [replace(part.products, **parts).state(set_pairs) for set_pairs in pairs]
            shares = softmax([prior + state.ratio + state.signed for prior, state in zip(priors, states, strict=True)])
            mean, covariance, variance = mixed(states, shares)
            left_out, of_point = table[np.repeat(test, d)], points[test].ravel()
            turned = left_out[:, :rank] @ turn
            moved = left_out[:, rank:] - turned @ inside
            before[test] = moved[:, -1].reshape(-1, d)
            after[test] = before[test] - (moved[:, :-1] @ mean).reshape(-1, d)
            shown, of_base = moved[of_point, :-1], float(np.sum(np.square(turned[of_point])))
            expected += float(np.sum((shown.T @ shown) * covariance))
            expected += noise_factor * variance * (of_base + noise * np.count_nonzero(test))
        yield before[:, POINT], after[:, POINT], expected / m
