"""`diagnose`: find out which effect is missing in a model (identification/README.md, "Gap workflow")."""

from dataclasses import replace

import numpy as np

from identification.arm import Arm
from identification.arrays import readonly
from identification.documents.diagnosis import remarks
from identification.errors import InputError, require
from identification.estimation.doubts import copied_rows, doubts_of_fit, lacking
from identification.estimation.problem import check_measurements
from identification.estimation.repeats import Finding, misfit, noise_floor, repeat_finding
from identification.estimation.uncertainty import outlying, together
from identification.gap.across_sessions import replications
from identification.gap.average import BENT, as_fitted, averaged
from identification.gap.blocks import hypotheses
from identification.gap.confirmation import Gap, HeldOut, cross_validation
from identification.gap.detectability import assess, look_alikes, require_spare
from identification.gap.fit import Rows, determined, fit
from identification.gap.result import Candidate, Diagnosis, as_calibration, probabilities
from identification.gap.search import MOST_ROWS, PASSES, posterior_of
from identification.information import spectrum
from identification.inspection.readings import gap_notes
from identification.measurements import Measurements, rms_distance
from identification.model import Model
from identification.model.placed import with_sessions
from identification.running import Progress, single_thread


@single_thread()
def diagnose(
    arm: Arm,
    measurements: Measurements,
    holdout: Measurements | None = None,
    seed: int = 0,
    progress: Progress = Progress(),
) -> Diagnosis:
    """Whether model and measurements disagree, which effect is missing, and whether adding it closes the gap.

    arm : its effects are part of the base model; whatever they do not fix is estimated again. A spatial arm is given a
        minimal set of geometric parameters that the data tell better than machining does, without a prior, and the
        base that the closed form finds (`determined`).
    measurements : of one session, or of several distinguished by their column `session`, each with its own base
    holdout : measurements of the same arm, used for the confirmation only
    seed : the same seed gives the same diagnosis

    Raises `InputError` for data of another arm, effects without the data they need, fewer than 4 residual degrees of
    freedom, a single posture or position, and a hold-out of another arm or one that shares rows with the data.
    """
    check_input(arm, measurements, holdout)
    copies, numbers = copied_rows(measurements), np.unique(measurements.originals)
    measurements = measurements.without_copies() if copies else measurements
    one_session, doubtful = determined(arm, measurements)
    arm, rows, generator = with_sessions(one_session, measurements), Rows.of(measurements), np.random.default_rng(seed)
    if not Model(arm).names:
        raise InputError("measurements: no parameter of the arm follows from these rows, allowed: data that show one")
    warm = measurements.temperature is not None and np.ptp(measurements.temperature) > 0.0
    library = hypotheses(arm, frozenset({"temperature"} if warm else ()), rows)
    progress(0.0, 1.0, "step 1 of 3: base model")
    base = fit(library.base, rows)
    require_spare(base.freedom, len(rows))
    held_out = None if holdout is None else HeldOut.of(holdout, measurements)
    if held_out is not None:
        held_out.check_same_arm(as_fitted(base), measurements)
    shares = iter(np.linspace(0.1, 0.7, 3 * PASSES + 1, endpoint=False).tolist())
    posterior = posterior_of(
        library, rows, generator, lambda text: progress(next(shares), 1.0, f"step 2 of 3: {text}"), doubtful
    )
    progress(0.7, 1.0, "step 3 of 3: fits, tests on other rows")
    rows, best, whole, numbers = posterior.at.rows, posterior.best, posterior.whole, numbers + 1
    kept = ~np.isin(np.arange(len(rows)), [k for b in best.blocks for k in b.rows])
    if not kept.all():
        base = fit(library.base, rows.pick(kept))
    shows = whole.beside([whole.numbers[block.label] for block in best.blocks if block.rows])

    # what predicts best, and what it leaves
    start, (predicting, bend, posterior) = posterior.at, averaged(posterior, int(kept.sum()) * rows.dimension)
    before, after = base.residuals(measurements), predicting.residuals(measurements)
    drawn = measurements.positions - base.model.position(measurements.postures, None, measurements.conditions)
    # an average that is too far from linear may be worse in its own rows than the fit of the likeliest set
    weighted = posterior.noises[best.noise].rows.pick(kept)
    likeliest_effects = best.effects if rms_distance(bend) > BENT * predicting.sigma else ()
    plain = fit(library.model(likeliest_effects), weighted, start.by_name) if likeliest_effects else base
    left = plain.residuals(measurements)
    with_all, without = (float(np.linalg.norm(weighted.whiten(each[kept]))) for each in (after, left))
    alone = with_all > without and bool(predicting.specs) and not likeliest_effects
    if with_all > without:
        predicting, after = as_fitted(plain, [b.effect.spec for b in likeliest_effects if b.effect]), left
        bend = bend if alone else np.zeros_like(bend)
    repeats = repeat_finding(after, after[kept].size - predicting.freedom, measurements, kept)
    over_sigma = misfit(after, after[kept].size - predicting.freedom, measurements, library.arm.sigma, kept)
    # residuals that scatter less than the given sigma by chance, as in `estimation.uncertainty`, promise no less noise
    noise_factor = 1.0 if over_sigma is None or over_sigma.p_value > 0.99 else max(1.0, over_sigma.ratio**-2)

    # the verdict, and the sets that it speaks of, each fitted once more
    likely = probabilities(posterior)
    trusted = [] if measurements.sigma is None or over_sigma is None else [over_sigma.p_value]
    # convention: p-value of what is left, below which the noise cannot be all, by a trusted sigma or by repeats
    if (p := min([1.0, *trusted, *(finding.p for finding in repeats)])) < 1e-3:
        likely = likely.not_none(p)
    unknown, something = likely.verdict == "unknown", likely.verdict != "none"
    likeliest = {one.named: one for one in reversed(posterior.explanations)}
    beside = posterior.beside_unknown if unknown else None
    sets = [likeliest[names] for names in likely.rivals] or [beside or likeliest[()]]
    fits, candidates = [], list[Candidate]()
    for one in sets:
        noise = posterior.noises[one.noise]
        fits.append(fit(library.model(one.effects), noise.rows.pick(kept), posterior.at.by_name))
        made = Candidate.of(fits[-1], len(one.effects), library.arm.sigma, doubtful=bool(noise.name))
        if not unknown:
            share, highest = (max(likely.of(keys), 1e-300) for keys in (one.named, likely.best))
            behind = 2.0 * float(np.log(highest / share)) if likely.rivals else 0.0
            made = replace(made, probability=share, delta_bic=behind)
        candidates.append(made)
    shown, fitted, named = sets[0], fits[0], candidates[0]

    # tests on other rows
    tests = cross_validation(posterior, measurements, kept, generator, something, noise_factor, bend)
    if tests[0].shrinks is False and tests[0].after_mm > tests[0].before_mm:  # by more than chance
        alone, predicting, after = True, as_fitted(base), before
        over_sigma = misfit(after, after[kept].size - predicting.freedom, measurements, library.arm.sigma, kept)
    judged = base, predicting, measurements, kept, something, noise_factor
    confirmation = None if held_out is None else held_out.test(*judged)
    figures = () if confirmation is None else (confirmation.before_mm, confirmation.after_mm, confirmation.predicted_mm)
    # what nothing explains counts as noise in measured rows, and as an error of its own in where the tip really is
    if over_sigma is not None and over_sigma.significant:
        predicting = predicting.allowing(rows.dimension * predicting.sigma**2 * (1.0 - over_sigma.ratio**-2))

    # what these rows show
    sigma = library.arm.sigma if measurements.sigma is None else measurements.sigma[kept]
    floor = noise_floor(after, measurements, kept, sigma)
    sees = assess(library, shows, posterior.noises[0].rows, predicting.sigma)
    place = likely.place if unknown else None
    curves = tuple(c for c in predicting.curves if c.joint in {b.span[0] + 1 for b in shown.blocks if b.span})
    forms = (b.effect.summary for b in shown.outside if b.effect is not None and b.place == place)
    shape = next(forms, None) or {f"joint:{c.joint}": c.described[0] for c in curves}.get(place or "")
    # properties of the noise that are likelier than not
    of_noise = zip(posterior.noises, posterior.shares.tolist(), strict=True)
    scatter = [Finding(noise.name, max(1.0 - p, 0.0), noise.size) for noise, p in of_noise if noise.name and p >= 0.5]
    here = fitted.on(rows)
    blocks = (here.jacobian @ spectrum(here.jacobian, fitted.model.scales).root).reshape(*before.shape, -1)
    far = kept & together(outlying(here.residual.reshape(before.shape), blocks), rows.postures, rows.posture_numbers)
    freedom = np.full(len(predicting.values), float(predicting.freedom))
    average = as_calibration(predicting, predicting.covariance, freedom, base.rows.postures)
    result = Diagnosis(
        arm=arm if arm is one_session else one_session.with_base(),
        in_sessions=library.arm,
        measurements=measurements,
        residuals_before=readonly(before),
        residuals_after=readonly(after),
        kept=kept,
        candidates=tuple(candidates) if likely.rivals or (unknown and named.effects) else (),
        named=named,
        predicting=replace(named, specs=predicting.specs, calibration=average),
        aliases=look_alikes(shows, sees, {label for one in candidates for label in one.effects}),
        shape=shape,
        scatter=(*scatter, *(finding for finding in repeats if finding.name not in {f.name for f in scatter})),
        outlier_rows=tuple(numbers[~kept].tolist()),
        unexplained_rows=tuple(numbers[far].tolist()),
        gap=Gap(rms_distance(before[kept]), rms_distance(after[kept]), floor, *figures),
        detectability=sees,
        sigma=fitted.sigma,
        probabilities=likely,
        misfit=over_sigma,
        confirmation=confirmation,
        cross_validation=tests,
        warnings=(
            *doubts_of_fit(base.model, base.values, np.ones(len(base.values), bool), drawn, before, measurements)[0],
            *(f"hold-out: {one}" for one in ([] if held_out is None else lacking(predicting.model, held_out.rows))),
            *copies,
        ),
        replication=tuple(replications(fitted, measurements.session_names, named.effects)),
        curves=curves,
    )
    said = remarks(result, posterior.library.skipped, min(MOST_ROWS, len(measurements)), fitted.status, alone)
    result = replace(result, notes=(*said, *gap_notes(measurements)))
    progress(1.0, 1.0, result.sentence)
    return result


def check_input(arm: object, measurements: Measurements, holdout: Measurements | None) -> None:
    """Raise `InputError` for what is no arm, data that do not fit the arm or lack what its effects need, and a hold-out
    of another arm or one that contains rows of the data."""
    if not isinstance(arm, Arm):
        chain = "whose chain says where effects act, which no other model does"
        raise InputError(f"arm: {type(arm).__name__}, allowed: an Arm, {chain}")
    check_measurements(Model(arm), measurements)
    instrument = arm.chain.instrument
    for name, table in (("posture", measurements.postures), ("position", measurements.positions)):
        if not (instrument.contact and name == "position") and np.all(np.ptp(table, axis=0) == 0.0):
            raise InputError(f"measurements: the same {name} in all {len(table)} rows, allowed: several {name}s")
    if holdout is None:
        return
    from scipy.spatial import KDTree  # deferred: only a hold-out pays for the import

    if instrument.own_targets and (new := {*holdout.marker_names} - {*measurements.marker_names}):
        what, names = instrument.target, ", ".join(measurements.marker_names)
        raise InputError(f"holdout: found {what} {min(new)!r}, allowed: {names}, as in the data; or armcal validate")
    if holdout.links != measurements.links:
        raise InputError(f"holdout: {holdout.links} joints, allowed: {measurements.links} as in the data")
    other, needed = holdout.dimension, measurements.dimension
    require(other == needed, f"holdout: positions of {other} coordinates, allowed: {needed} as in the data")
    data, rows = (np.column_stack([d.postures / 1e-5, d.positions / 1e-3]) for d in (measurements, holdout))
    distance = KDTree(data).query(rows, p=np.inf)[0]
    shared, near = int(np.sum(distance == 0.0)), int(np.sum(distance <= 1.0))
    if shared or 2 * near > len(holdout):  # a few repeats may agree by chance, most rows only in a rounded copy
        copied = f"{max(shared, near)} of {len(holdout)} rows are also in the data"
        raise InputError(f"holdout: {copied}, allowed: rows not used before")
