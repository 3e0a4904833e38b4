"""`diagnose`: find out which effect is missing in a model (identification/README.md, "Gap workflow")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm
from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.estimation.checks import check_measurements
from identification.estimation.outlying import outlying, together
from identification.estimation.plausibility import another_frame, copied_rows, far_off, flipped, misread, outside_limits
from identification.gap.average import PredictingModel, averaged
from identification.gap.blocks import REST
from identification.gap.candidate import Candidate
from identification.gap.candidates import candidate_of, certainty, predicting_candidate, trial_list
from identification.gap.confirmation import (
    Gap,
    check_holdout,
    check_same_arm,
    confirmed_on,
    cross_validation,
    other_set_up,
)
from identification.gap.curves.curve import Curve
from identification.gap.fit import Fit, Rows, fit
from identification.gap.hypotheses.detectability import assess, require_spare
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.noise.misfit import Misfit, misfit
from identification.gap.noise.repeats import noise_floor, repeat_finding
from identification.gap.notes import alias_list, curve_notes, hidden_orders, notes, order_notes, unexplained_note
from identification.gap.order_range import order_ranges
from identification.gap.posterior import Explanation, Posterior, posterior, refit
from identification.gap.replication import curve_columns, replications
from identification.gap.result import Diagnosis, Residuals
from identification.gap.scatter import Finding
from identification.gap.verdict import Names, Probabilities, likeliest_with, probabilities
from identification.measurements import Measurements, rms_distance
from identification.model import Model
from identification.model.minimal import practical
from identification.progress import Progress, Tell, silent
from identification.sessions import of_these_sessions, with_base, with_sessions, without_sessions
from identification.threads import single_thread

BEGINS = (0.0, 0.1, 0.7)  # part of the work that is done when each of the three steps begins
IMPOSSIBLE = 1e-3  # p-value of what is left, below which the noise cannot be all: a trusted sigma, or repeats
KINDS = {
    "time": "smooth in time",
    "workspace": "smooth over the workspace",
    "wobble": "tilt or shift across the axis",
    "shared": "depends on other joints too",
    "history": "depends on the direction of approach",
    REST: "many small effects",
}


@single_thread()
def diagnose(
    arm: Arm,
    measurements: Measurements,
    holdout: Measurements | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Diagnosis:
    """Whether model and measurements disagree, which effect is missing, and whether adding it closes the gap.

    arm : its effects are part of the base model; whatever they do not fix is estimated again. A spatial arm is given a
        minimal set of identifiable geometric parameters, without a prior, and the base that the closed form finds
        (`practical`).
    measurements : of one session, or of several distinguished by their column `session`, each with its own base
    holdout : measurements of the same arm, used for the confirmation only
    seed : the same seed gives the same diagnosis

    Raises `InputError` for data of another arm, effects without the data they need, fewer than 4 residual degrees of
    freedom, a single posture or position, and a hold-out of another arm or one that shares rows with the data.
    """
    check_input(arm, measurements, holdout)
    holdout = None if holdout is None else of_these_sessions(holdout, measurements)
    given = practical(arm, measurements)
    arm = with_sessions(given, measurements)
    generator = np.random.default_rng(seed)
    if not Model(arm).names:
        raise InputError("measurements: no parameter of the arm follows from these rows, allowed: data that show one")
    rows = Rows.of(measurements)
    library = hypotheses(arm, varying(measurements), rows)
    step(1, progress)("base model")
    base = fit(library.base, rows)
    require_spare(base.freedom, len(rows))
    if holdout is not None:
        check_same_arm(base, measurements, holdout)
    found = posterior(library, rows, generator, step(2, progress))
    step(3, progress)("fits, tests on other rows")
    result = diagnosis_of(found, measurements, holdout, generator)
    progress(1, 1, result.sentence)
    return result if arm is given else of_first_session(result, given)


def step(number: int, progress: Progress) -> Tell:
    """What is told of a step, and the part of the work that is usually done when it begins."""
    return lambda message: progress(BEGINS[number - 1], 1.0, f"step {number} of {len(BEGINS)}: {message}")


def of_first_session(result: Diagnosis, arm: Arm) -> Diagnosis:
    """A diagnosis of several sessions with the base of the first session only."""

    def single(found: Candidate) -> Candidate:
        return replace(found, calibration=without_sessions(found.calibration))

    candidates, models = tuple(map(single, result.candidates)), map(single, (result.named, result.predicting))
    named, predicting = models
    return replace(result, arm=with_base(arm), candidates=candidates, named=named, predicting=predicting)


def check_input(arm: Arm, measurements: Measurements, holdout: Measurements | None) -> None:
    """Raise `InputError` for data that do not fit the arm or lack what its effects need."""
    check_measurements(Model(arm), measurements)
    touching = arm.chain is not None and arm.chain.instrument.contact  # contacts have no positions
    for name, table in (("posture", measurements.postures), ("position", measurements.positions)):
        if not (touching and name == "position") and np.all(np.ptp(table, axis=0) == 0.0):
            raise InputError(f"measurements: the same {name} in all {len(table)} rows, allowed: several {name}s")
    if holdout is not None:
        check_holdout(measurements, holdout)


def varying(measurements: Measurements) -> frozenset[str]:
    """Names of the optional columns that are given and not constant."""
    names = ("temperature", "payload", "order")
    given = {name: getattr(measurements, name) for name in names if getattr(measurements, name) is not None}
    return frozenset(name for name, values in given.items() if np.ptp(values) > 0.0)


def diagnosis_of(
    found: Posterior, measurements: Measurements, holdout: Measurements | None, generator: np.random.Generator
) -> Diagnosis:
    """Everything that is read off the posterior."""
    library = found.library
    kept = np.ones(len(found.rows), dtype=bool)
    kept[list(found.best.wrong)] = False
    base = fit(library.base, Rows.of(measurements).pick(kept))
    best = refit(found, found.best)
    predicting = averaged(found, int(kept.sum()) * found.rows.dimension)
    scatter = noise_findings(found)
    left = predicting.position_residuals(measurements, measurements.conditions)
    estimated = int(kept.sum()) * found.rows.dimension - predicting.freedom
    repeats = repeat_finding(left, estimated, measurements, kept)
    over_sigma = misfit(left, estimated, measurements, library.arm.sigma, kept)
    likely = guarded(probabilities(found), repeats, over_sigma, measurements)
    if over_sigma is not None and over_sigma.significant:  # what nothing explains is an error of the model elsewhere
        scale = len(left.T) * predicting.sigma**2
        predicting = predicting.allowing(scale * (1.0 - over_sigma.ratio**-2))
    verdict = likely.verdict
    named, *candidates = models(found, base, likely)
    something = verdict != "none"
    tests = cross_validation(found, measurements, kept, generator, something)
    if tests[0].shrinks is False and tests[0].after > tests[0].before:
        predicting = geometry(base)
        left = predicting.position_residuals(measurements, measurements.conditions)
        worse = ["other rows are predicted better by the geometry alone: that is what --out writes"]
    else:
        worse = []
    confirmation = None
    if holdout is not None:
        confirmation = confirmed_on(holdout, base, predicting, measurements, kept, something)
    residuals = show_residuals(library.arm, measurements, base, left)
    before, after = residuals.before[kept], residuals.after[kept]
    unexplained = kept & unexplained_rows(best, found.rows)
    floor = noise_floor(left, measurements, kept, library.arm.sigma)
    gap = Gap.of(rms_distance(before), rms_distance(after), floor, confirmation)
    shown = likeliest_of(found, likely)
    fitted = fit(library.model(shown.effects), found.noises[found.best.noise].rows.pick(kept), best.by_name)
    at_base = library.base.jacobian(base.rows.postures, base.values, base.rows.conditions)
    detectable = assess(library, base.rows, at_base, base.by_name, predicting.sigma)
    hidden = hidden_orders(found) if named.effects else ()
    place = likely.place if verdict == "unknown" and likely.place != REST else None
    joints = {b.basis.joint + 1 for b in shown.outside if b.basis is not None}
    curves = tuple(curve for curve in predicting.curves if curve.joint in joints)
    return Diagnosis(
        arm=library.arm,
        verdict=verdict,
        candidates=tuple(candidates),
        named=named,
        predicting=predicting_candidate(predicting, named, base.rows.postures),
        aliases=(*hidden, *alias_list(detectable, tuple(candidates))),
        where=place,
        shape=shape_of(place, curves, shown),
        scatter=(*scatter, *(repeats if not any(f.name == "repeats" for f in scatter) else ())),
        outlier_rows=tuple(int(k) + 1 for k in np.flatnonzero(~kept)),
        gap=gap,
        trials=trial_list(found),
        detectability=detectable,
        residuals=residuals,
        sigma=fitted.sigma,
        probabilities=likely,
        data=MappingProxyType({k: v for k, v in measurements.origin.items() if k != "rows"}),
        misfit=over_sigma,
        confirmation=confirmation,
        cross_validation=tests,
        warnings=(*fit_doubts(library.arm, measurements, best, after), *other_set_up(confirmation)),
        notes=(
            *order_notes(hidden),
            *curve_notes(curves),
            *worse,
            *notes(found, measurements, best, holdout, gap, over_sigma),
            *unexplained_note(left, unexplained),
        ),
        unexplained_rows=tuple((np.flatnonzero(unexplained) + 1).tolist()),
        shapes=order_ranges(fitted, fitted.rows, named.effects),
        replication=replications(
            fitted, measurements.session_names, named.effects, curve_columns(found, shown, fitted, curves)
        ),
        curves=curves,
    )


def guarded(
    likely: Probabilities, repeats: tuple[Finding, ...], over_sigma: Misfit | None, measurements: Measurements
) -> Probabilities:
    """The probabilities where the noise may be known: of its rows, or from repeats of one posture. More than it can be
    is left by something."""
    p = min([1.0, *(finding.p for finding in repeats)])
    if measurements.sigma is not None and over_sigma is not None:
        p = min(p, over_sigma.p_value)
    return likely.not_none(p) if p < IMPOSSIBLE else likely


def likeliest_of(found: Posterior, likely: Probabilities) -> Explanation:
    """The likeliest explanation with what is named."""
    if likely.verdict == "unknown" and likely.place is not None:
        return likeliest_with(found, (), outside=True)
    if likely.verdict in ("unknown", "none"):
        return next((e for e in found.explanations if not e.effects and not e.outside), found.best)
    return likeliest_with(found, likely.best)


def models(found: Posterior, base: Fit, likely: Probabilities) -> list[Candidate]:
    """What is named, and the candidates."""
    rivals: list[Names] = likely.rivals
    explanations = [likeliest_with(found, names) for names in rivals] or [likeliest_of(found, likely)]
    candidates = []
    for one in explanations:
        fitted = refit(found, one)
        noise = found.noises[one.noise]
        sure = certainty(fitted, found.library.arm.sigma, doubtful=bool(noise.name))
        plain = fit(found.library.base, fitted.rows, base.by_name) if one.effects else fitted
        size = fitted.rank - plain.rank
        gain = (plain.squares - fitted.squares) / max(size, 1) / max(fitted.sigma**2, 1e-300)
        keys = [h.key for h in one.effects]
        p = likely.of(keys) if likely.verdict != "unknown" else None
        best = max(likely.of(likely.best), 1e-300)
        delta = 2.0 * float(np.log(best / max(p, 1e-300))) if rivals and p is not None else 0.0
        candidates.append(candidate_of(fitted, len(one.effects), sure, max(float(gain), 0.0), p, delta))
    listed = candidates if rivals or (likely.verdict == "unknown" and candidates[0].effects) else []
    return [candidates[0], *listed]


def noise_findings(found: Posterior) -> tuple[Finding, ...]:
    """Properties of the noise that are likelier than not."""
    shares: dict[str, float] = {}
    sizes: dict[str, tuple[float, float]] = {}
    for one in found.explanations:
        noise = found.noises[one.noise]
        shares[noise.name] = shares.get(noise.name, 0.0) + one.probability
        sizes.setdefault(noise.name, (one.probability, noise.size))
    return tuple(Finding(name, 1.0 - p, sizes[name][1]) for name, p in shares.items() if name and p >= 0.5)


def unexplained_rows(found: Fit, rows: Rows) -> NDArray[np.bool_]:
    """(m,) True for rows that a fit does not explain and that come together, so that they are no outliers."""
    predicted, jacobian = found.model.linearize(rows.postures, found.values, rows.conditions)
    residual = rows.whiten(rows.positions - predicted).reshape(predicted.shape)
    far = outlying(residual, rows.whiten(jacobian / found.model.scales))
    return together(far, rows.postures, rows.posture_numbers)


def geometry(base: Fit) -> PredictingModel:
    """The base model as a predicting model."""
    covariance = base.covariance()
    columns = base.model.jacobian(base.rows.postures, base.values, base.rows.conditions)
    unit = float(np.sum((columns @ covariance) * columns)) / len(columns)
    spread = covariance / max(unit, 1e-300)
    return PredictingModel(base.model, base.values, covariance, (), (), base.sigma, max(base.freedom, 1), spread)


def shape_of(place: str | None, curves: Sequence[Curve], one: Explanation) -> str | None:
    """Of what is outside the library, in words;  one : the likeliest explanation with something outside"""
    there = (c.shape for c in curves if place == f"joint:{c.joint}")
    kinds = (KINDS.get(b.label.partition(":")[0].partition("[")[0]) for b in one.outside if b.place == place)
    if place is None:
        return KINDS[REST] if any(b.parts for b in one.outside) else None
    return next(filter(None, kinds), None) or next(there, None)


def show_residuals(arm: Arm, measurements: Measurements, base: Fit, left: Array) -> Residuals:
    """Residuals before and after, with the quantities they can be plotted against;  left : after (m, d) [mm]"""
    conditions = measurements.conditions
    against: dict[str, Array] = {f"joint {j + 1} [rad]": measurements.postures[:, j] for j in range(arm.links)}
    against["time"] = np.zeros(len(measurements)) if conditions.time is None else conditions.time
    if arm.gravity is not None:
        tau = Model(arm).on_chain(lambda chain: chain.torques)(measurements.postures, conditions)
        against |= {f"torque {j + 1} [N m]": tau[:, j] for j in range(arm.links)}
    if measurements.temperature is not None:
        against["temperature [C]"] = measurements.temperature
    return Residuals(
        readonly(base.position_residuals(measurements, conditions)),
        readonly(left),
        MappingProxyType({name: readonly(values) for name, values in against.items()}),
        measurements.positions,
        conditions,
    )


def fit_doubts(arm: Arm, measurements: Measurements, found: Fit, left: Array) -> tuple[str, ...]:
    """Warnings about the data and about a model fitted to them, one sentence each;  left : (m, d) residuals [mm]."""
    estimable: NDArray[np.bool_] = np.ones(len(found.values), dtype=bool)
    bad = [*far_off(left, found.model), *flipped(found.model, found.values, estimable)]
    place = (*another_frame(arm, measurements), *outside_limits(arm, measurements))
    return (*misread(arm, measurements).sentences, *bad, *place, *copied_rows(measurements))
