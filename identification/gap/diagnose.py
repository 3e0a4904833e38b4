"""`diagnose`: find out which effect is missing in a model (identification/README.md, "Gap workflow")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm
from identification.arrays import rows_in_words
from identification.documents.diagnosis import untested
from identification.errors import InputError
from identification.estimation.doubts import another_frame, copied_rows, far_off, flipped, misread, outside_limits
from identification.estimation.problem import check_measurements
from identification.estimation.uncertainty import outlying, together
from identification.gap.average import PredictingModel, averaged
from identification.gap.blocks import REST
from identification.gap.confirmation import (
    Gap,
    check_same_arm,
    confirmed_on,
    cross_validation,
    other_set_up,
)
from identification.gap.curve import Curve
from identification.gap.detectability import Beside, assess, look_alikes, order_ranges, require_spare
from identification.gap.fit import Fit, Rows, fit
from identification.gap.hypotheses import hypotheses
from identification.gap.noise import misfit, noise_floor, repeat_finding
from identification.gap.posterior import MOST_ROWS, NOISES, PASSES, Explanation, Posterior, posterior_of
from identification.gap.replication import curve_columns, replications
from identification.gap.result import Candidate, Diagnosis, Residuals, as_calibration, candidate_of, trials
from identification.gap.scatter import Finding
from identification.gap.verdict import Probabilities, likeliest_with, probabilities
from identification.inspection.readings import gap_notes
from identification.measurements import Measurements, distances, rms_distance
from identification.model import Model
from identification.model.minimal import practical
from identification.progress import Progress, silent
from identification.sessions import of_these_sessions, with_base, with_sessions, without_sessions
from identification.status import Status
from identification.threads import single_thread

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
    copies, numbers = copied_rows(measurements), np.unique(measurements.originals)
    measurements = measurements.without_copies() if copies else measurements
    holdout = None if holdout is None else of_these_sessions(holdout, measurements)
    given = practical(arm, measurements)
    arm, rows, generator = with_sessions(given, measurements), Rows.of(measurements), np.random.default_rng(seed)
    if not Model(arm).names:
        raise InputError("measurements: no parameter of the arm follows from these rows, allowed: data that show one")
    optional = {name: getattr(measurements, name) for name in ("temperature", "payload", "order")}
    varying = frozenset(name for name, values in optional.items() if values is not None and np.ptp(values) > 0.0)
    library = hypotheses(arm, varying, rows)
    progress(0.0, 1.0, "step 1 of 3: base model")
    base = fit(library.base, rows)
    require_spare(base.freedom, len(rows))
    if holdout is not None:
        check_same_arm(base, measurements, holdout)
    shares = iter(np.linspace(0.1, 0.7, PASSES + NOISES + 1, endpoint=False).tolist())
    posterior = posterior_of(
        library, rows, generator, lambda message: progress(next(shares), 1.0, f"step 2 of 3: {message}")
    )
    progress(0.7, 1.0, "step 3 of 3: fits, tests on other rows")
    result = diagnosis_of(posterior, measurements, holdout, generator, numbers + 1)
    result = replace(result, warnings=(*result.warnings, *copies))
    progress(1.0, 1.0, result.sentence)
    if arm is given:
        return result
    named, predicting, *candidates = (  # of several sessions, with the base of the first one only
        replace(one, calibration=without_sessions(one.calibration))
        for one in (result.named, result.predicting, *result.candidates)
    )
    arm = with_base(given)
    return replace(result, arm=arm, candidates=tuple(candidates), named=named, predicting=predicting)


def check_input(arm: object, measurements: Measurements, holdout: Measurements | None) -> None:
    """Raise `InputError` for what is no arm, data that do not fit the arm or lack what its effects need, and a hold-out
    of another arm or one that contains rows of the data."""
    if not isinstance(arm, Arm):
        chain = "whose chain says where effects act, which no other model does"
        raise InputError(f"arm: {type(arm).__name__}, allowed: an Arm, {chain}")
    check_measurements(Model(arm), measurements)
    touching = arm.chain.instrument.contact  # contacts have no positions
    for name, table in (("posture", measurements.postures), ("position", measurements.positions)):
        if not (touching and name == "position") and np.all(np.ptp(table, axis=0) == 0.0):
            raise InputError(f"measurements: the same {name} in all {len(table)} rows, allowed: several {name}s")
    if holdout is None:
        return
    from scipy.spatial import KDTree  # deferred: only a hold-out pays for the import

    if arm.chain.instrument.own_targets and (new := {*holdout.marker_names} - {*measurements.marker_names}):
        what, names = arm.chain.instrument.target, ", ".join(measurements.marker_names)
        raise InputError(f"holdout: found {what} {min(new)!r}, allowed: {names}, as in the data; or armcal validate")
    if holdout.links != measurements.links:
        raise InputError(f"holdout: {holdout.links} joints, allowed: {measurements.links} as in the data")
    if holdout.dimension != measurements.dimension:
        other, needed = holdout.dimension, measurements.dimension
        raise InputError(f"holdout: positions of {other} coordinates, allowed: {needed} as in the data")
    data, rows = (np.column_stack([d.postures / 1e-5, d.positions / 1e-3]) for d in (measurements, holdout))
    distance = KDTree(data).query(rows, p=np.inf)[0]
    shared, near = int(np.sum(distance == 0.0)), int(np.sum(distance <= 1.0))
    if shared or 2 * near > len(holdout):  # a few repeats may agree by chance, most rows only in a rounded copy
        copied = f"{max(shared, near)} of {len(holdout)} rows are also in the data"
        raise InputError(f"holdout: {copied}, allowed: rows not used before")


def diagnosis_of(
    posterior: Posterior,
    measurements: Measurements,
    holdout: Measurements | None,
    generator: np.random.Generator,
    numbers: NDArray[np.int64],
) -> Diagnosis:
    """Everything that is read off the posterior;  numbers : (m,) of the rows in the table that was given, from 1"""
    library, conditions, rows = posterior.library, measurements.conditions, posterior.rows
    kept = np.ones(len(rows), dtype=bool)
    kept[list(posterior.best.wrong)] = False
    base = fit(library.base, rows.pick(kept))
    beside = Beside(
        posterior.whole, [posterior.whole.numbers[block.label] for block in posterior.best.blocks if block.row]
    )

    # what predicts best, and what it leaves
    predicting = averaged(posterior, int(kept.sum()) * rows.dimension)
    after = predicting.position_residuals(measurements, conditions)
    rank = after[kept].size - predicting.freedom
    repeats = repeat_finding(after, rank, measurements, kept)
    over_sigma = misfit(after, rank, measurements, library.arm.sigma, kept)
    if over_sigma is not None and over_sigma.significant:  # what nothing explains is an error of the model elsewhere
        scale = rows.dimension * predicting.sigma**2
        predicting = predicting.allowing(scale * (1.0 - over_sigma.ratio**-2))

    # the verdict, and the sets that it speaks of, each fitted once more
    likely = probabilities(posterior)
    trusted = [] if measurements.sigma is None or over_sigma is None else [over_sigma.p_value]
    # convention: p-value of what is left, below which the noise cannot be all, by a trusted sigma or by repeats
    if (p := min([1.0, *trusted, *(finding.p for finding in repeats)])) < 1e-3:
        likely = likely.not_none(p)
    unknown, something = likely.verdict == "unknown", likely.verdict != "none"
    sets = [likeliest_with(posterior, names) for names in likely.rivals]
    sets = sets or [likeliest_with(posterior, (), outside=unknown and likely.place is not None)]
    fits = [
        fit(library.model(one.effects), posterior.noises[one.noise].rows.pick(kept), posterior.at.by_name)
        for one in sets
    ]
    shown, fitted = sets[0], fits[0]
    candidates = [candidate_in(posterior, likely, beside, *pair) for pair in zip(sets, fits, strict=True)]
    named = candidates[0]

    # tests on other rows
    tests = cross_validation(posterior, measurements, kept, generator, something)
    if tests[0].shrinks is False and tests[0].after > tests[0].before:
        predicting = geometry(base)
        after = predicting.position_residuals(measurements, conditions)
    confirmation = None
    if holdout is not None:
        confirmation = confirmed_on(holdout, base, predicting, measurements, kept, something)

    # what these rows show
    before = base.position_residuals(measurements, conditions)
    floor = noise_floor(after, measurements, kept, library.arm.sigma)
    sees = assess(library, beside, posterior.noises[0].rows, predicting.sigma)
    place = likely.place if unknown and likely.place != REST else None
    joints = {b.basis.joint + 1 for b in shown.outside if b.basis is not None}
    curves = tuple(curve for curve in predicting.curves if curve.joint in joints)
    error = rows.whiten(fitted.position_residuals(rows, conditions)).reshape(before.shape)
    jacobian = fitted.model.jacobian(rows.postures, fitted.values, conditions) / fitted.model.scales
    far = kept & together(outlying(error, rows.whiten(jacobian)), rows.postures, rows.posture_numbers)
    freedom = np.full(len(predicting.values), float(predicting.freedom))
    average = as_calibration(
        predicting.model, predicting.values, predicting.covariance, freedom, predicting.sigma, base.rows.postures
    )
    result = Diagnosis(
        arm=library.arm,
        verdict=likely.verdict,
        candidates=tuple(candidates) if likely.rivals or (unknown and named.effects) else (),
        named=named,
        predicting=replace(named, specs=predicting.specs, calibration=average, freedom=tuple(freedom.tolist())),
        aliases=look_alikes(posterior.whole, sees, {label for one in candidates for label in one.effects}),
        where=place,
        shape=shape_of(place, curves, shown),
        scatter=noise_findings(posterior, repeats),
        outlier_rows=tuple(numbers[~kept].tolist()),
        unexplained_rows=tuple(numbers[far].tolist()),
        gap=Gap.of(rms_distance(before[kept]), rms_distance(after[kept]), floor, confirmation),
        trials=trials(posterior, beside),
        detectability=sees,
        residuals=Residuals.of(library.arm, measurements, before, after),
        sigma=fitted.sigma,
        probabilities=likely,
        data=MappingProxyType({k: v for k, v in measurements.origin.items() if k != "rows"}),
        misfit=over_sigma,
        confirmation=confirmation,
        cross_validation=tests,
        warnings=(
            *misread(library.arm, measurements)[0],
            *far_off(after[kept], fitted.model),
            *flipped(fitted.model, fitted.values, np.ones(len(fitted.values), dtype=bool)),
            *another_frame(library.arm, measurements),
            *outside_limits(library.arm, measurements),
            *other_set_up(confirmation),
        ),
        shapes=order_ranges(fitted, named.effects),
        replication=replications(
            fitted, measurements.session_names, named.effects, curve_columns(posterior, shown, fitted, curves)
        ),
        curves=curves,
    )
    return replace(result, notes=tuple(notes(result, posterior, measurements, fitted, holdout, numbers)))


def candidate_in(
    posterior: Posterior, likely: Probabilities, beside: Beside, one: Explanation, fitted: Fit
) -> Candidate:
    """A fitted explanation with its probability."""
    numbers, noise = [posterior.whole.numbers[h.label] for h in one.effects], posterior.noises[one.noise].name
    candidate = candidate_of(fitted, len(numbers), posterior.library.arm.sigma, doubtful=bool(noise))
    candidate = replace(candidate, f=beside.f_test(numbers)[0])
    if likely.verdict == "unknown":
        return candidate
    p, best = (max(likely.of(names), 1e-300) for names in ([h.key for h in one.effects], likely.best))
    return replace(candidate, probability=p, delta_bic=2.0 * float(np.log(best / p)) if likely.rivals else 0.0)


def noise_findings(posterior: Posterior, repeats: Sequence[Finding]) -> tuple[Finding, ...]:
    """Properties of the noise that are likelier than not, and what repeats say that is none of them."""
    shares: dict[str, float] = {}
    sizes: dict[str, float] = {}
    for one in posterior.explanations:
        noise = posterior.noises[one.noise]
        shares[noise.name] = shares.get(noise.name, 0.0) + one.probability
        sizes.setdefault(noise.name, noise.size)
    findings = [Finding(name, 1.0 - p, sizes[name]) for name, p in shares.items() if name and p >= 0.5]
    return (*findings, *(finding for finding in repeats if finding.name not in {f.name for f in findings}))


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


def notes(
    result: Diagnosis,
    posterior: Posterior,
    measurements: Measurements,
    best: Fit,
    holdout: Measurements | None,
    numbers: NDArray[np.int64],
) -> list[str]:
    """Sentences to read before the verdict is trusted;  best : fit of the likeliest set;  numbers : of the rows"""
    listed = []
    for effect in result.effects:
        waves = [(like, share) for key, like, share in result.aliases if key == effect and "[" in like]
        if waves:
            same = waves[0][1] > 0.9999  # the odds stay below 20 up to lambda = 173
            word = "cannot be distinguished from" if same else "is hard to distinguish from"
            rest = f" and {len(waves) - 3} more" if len(waves) > 3 else ""
            likes = f"{', '.join(like for like, _ in waves[:3])}{rest}"
            listed.append(f"at these postures {effect} {word} {likes}; to decide, measure at other joint angles")
    if result.curves:
        spans = [np.degrees([curve.angles[0], curve.angles[-1]]) for curve in result.curves]
        ranges = [f"joint {c.joint} {a:.0f} to {b:.0f} deg" for c, (a, b) in zip(result.curves, spans, strict=True)]
        beyond = "where a joint is beyond them, the model is without curves, with the geometry that was fitted alone"
        listed.append(f"the error curves hold for the angles measured ({', '.join(ranges)}); {beyond}")
    if any(test.shrinks is False and test.after > test.before for test in result.cross_validation[:1]):
        listed.append("other rows are predicted better by the geometry alone: that is what --out writes")
    listed += untested(posterior.library.skipped)
    if len(measurements) > MOST_ROWS:
        searched = f"{MOST_ROWS} of the {len(measurements)} rows, taken at random"
        listed.append(f"effects were looked for in {searched}; what was found is fitted to all")
    if best.status is not Status.converged:
        listed.append(f"the fit of the best model did not converge: {best.status.value}")
    if measurements.directions is None:
        listed += ["directions of approach were derived from the order of measurement", *gap_notes(measurements)]
    for j in np.flatnonzero(np.ptp(measurements.postures, axis=0) == 0.0).tolist():
        first = "its offset cannot be separated from the orientation of the base"
        link = f"the parameters of link {j + 1} cannot be separated from those of link {j}" if j else first
        listed.append(f"joint {j + 1} does not move in these data: {link}")
    if result.misfit is not None and measurements.sigma is None and not 0.67 < result.misfit.ratio < 1.5:
        of_file = f"{result.misfit.ratio:.3g} times the sigma_mm of the arm file"
        listed.append(f"the residual scatter is {of_file}; the tests use the scatter, not sigma_mm")
    after, predicted = result.gap.held_out_after, result.gap.predicted
    if after is not None and predicted is not None and after > 3.0 * predicted:
        times = f"{after / predicted:.2g} times larger than predicted"
        listed.append(f"the held-out residuals are {times}: other postures or set-up?")
    if once := [h.key for h in posterior.best.effects if h.effect.once]:
        which = f"{', '.join(once)}: of this session only; the extended model has what is left of it at the end, as"
        listed.append(f"{which} validate and compensate take it")
    if holdout is not None and any("drift" in h.key for h in posterior.best.effects):
        listed.append("a drift of one session does not carry over to another; confirm it on held-out rows of this one")
    if result.unexplained_rows:
        far = distances(result.residuals.after)[np.isin(numbers, result.unexplained_rows)].max()
        far = f"up to {far:.3g} mm off"
        which = rows_in_words(np.isin(np.arange(numbers[-1]) + 1, result.unexplained_rows))
        listed.append(f"{which} are not explained ({far}); they stay in, as whole postures or neighbors")
    return listed
