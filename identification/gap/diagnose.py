"""`diagnose`: find out which effect is missing in a model (identification/README.md, "Gap workflow", 8 steps)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from identification.arm import Arm
from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.estimation.checks import check_measurements
from identification.estimation.outlying import together
from identification.gap.candidate import Candidate
from identification.gap.candidates import trial_list
from identification.gap.confirmation.confirmation import HeldOut
from identification.gap.confirmation.cross_validation import cross_validation
from identification.gap.confirmation.holdout import (
    Gap,
    check_holdout,
    check_same_arm,
    confirmation_of,
    gap_of,
    held_out,
    held_out_conditions,
    other_set_up,
)
from identification.gap.explanation import Explanation, Fits, explained_fits
from identification.gap.fits.fit import Fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.detectability import Detectability, assess, require_spare
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.library.library_prior import given_by, library_prior
from identification.gap.noise.misfit import misfit
from identification.gap.noise.noise import unexplained_rows
from identification.gap.noise.repeats import noise_floor, repeat_finding
from identification.gap.notes import (
    alias_list,
    curve_notes,
    hidden_orders,
    notes,
    order_notes,
    prior_note,
    unexplained_note,
)
from identification.gap.outside.excluded_waves import excluded_waves
from identification.gap.probability.agreement import overruled
from identification.gap.probability.choice_validation import ChoiceValidation, disagreement, validate_choice
from identification.gap.probability.probabilities import Probabilities
from identification.gap.result import Diagnosis, Residuals
from identification.gap.selection.certainty import fit_doubts
from identification.gap.selection.order_range import order_ranges
from identification.gap.selection.rounds import rounds_of
from identification.gap.selection.search import LEVEL_FACTOR, HypothesisSearch
from identification.gap.selection.selection import ALPHA_NEXT
from identification.gap.sessions.replicate import replications
from identification.gap.workflow import Findings, Workflow
from identification.measurements import Measurements
from identification.model import Model
from identification.model.minimal import practical
from identification.progress import Progress, Tell, silent
from identification.sessions import of_these_sessions, with_base, with_sessions, without_sessions
from identification.threads import single_thread

# the strictest level must be within reach: p >= 1 / (draws + 1) (identification/README.md, "Constants")
FEWEST_DRAWS = round(1.0 / (ALPHA_NEXT * LEVEL_FACTOR)) - 1
BEGINS = (0.0, 0.0, 0.8, 0.95)  # part of the work that is done when each of the four steps begins


@single_thread()
def diagnose(
    arm: Arm,
    measurements: Measurements,
    holdout: Measurements | None = None,
    seed: int = 0,
    draws: int = 999,
    progress: Progress = silent,
    *,
    prior: bool = False,
    missing: Sequence[str] | None = None,
) -> Diagnosis:
    """Whether model and measurements disagree, which effect is missing, and whether adding it closes the gap.

    arm : its effects are part of the base model; whatever they do not fix is estimated again. A spatial arm is given a
        minimal set of identifiable geometric parameters, without a prior, and the base that the closed form finds
        (`practical`).
    measurements : of one session, or of several distinguished by their column `session`, each with its own base
    holdout : measurements of the same arm, used for the confirmation only
    seed, draws : of the bootstrap; the same seed gives the same diagnosis; at least 399 draws
    prior : once effects are named, fit the best set together with the rest of the library, each effect with a normal
        prior of its typical size;  missing : restrict the prior to these effects

    Raises `InputError` for data of another arm, effects without the data they need, fewer than 4 residual degrees of
    freedom, a single posture or position, a hold-out of another arm or one that shares rows with the data, and unknown
    names in `missing`.
    """
    check_input(arm, measurements, holdout, draws)
    holdout = None if holdout is None else of_these_sessions(holdout, measurements)
    given = practical(arm, measurements)
    arm = with_sessions(given, measurements)
    if prior:
        library_prior(arm, given_by(measurements), missing)
    generator = np.random.default_rng(seed)
    found = findings_of(arm, measurements, holdout, draws, generator, progress)
    explained, fits = explained_fits(found, measurements, draws, generator, prior, missing, step(3, progress))
    step(4, progress)("sizes excluded, tests on other rows")
    result = diagnosis_of(measurements, holdout, explained, fits, generator)
    progress(1, 1, result.sentence)
    return result if arm is given else of_first_session(result, given)


def findings_of(
    arm: Arm,
    measurements: Measurements,
    holdout: Measurements | None,
    draws: int,
    generator: np.random.Generator,
    progress: Progress,
) -> Findings:
    """Steps 1 to 5: which effects are missing. Raises `InputError` for too few rows or a hold-out of another arm."""
    if not Model(arm).names:
        raise InputError("measurements: no parameter of the arm follows from these rows, allowed: data that show one")
    rows = Rows.of(measurements)
    library = hypotheses(arm, varying(measurements), rows)
    first = HypothesisSearch(library, rows).fit(())
    require_spare(first.freedom, len(rows))
    if holdout is not None:
        check_same_arm(first, measurements, holdout)
    step(1, progress)("base model")
    return Workflow(library, draws, generator, step(2, progress)).findings(rows)


def step(number: int, progress: Progress) -> Tell:
    """What is told of a step, and the part of the work that is usually done when it begins."""
    return lambda message: progress(BEGINS[number - 1], 1.0, f"step {number} of 4: {message}")


def of_first_session(result: Diagnosis, arm: Arm) -> Diagnosis:
    """A diagnosis of several sessions with the base of the first session only."""

    def single(found: Candidate) -> Candidate:
        return replace(found, calibration=without_sessions(found.calibration))

    candidates = tuple(map(single, result.candidates))
    return replace(result, arm=with_base(arm), candidates=candidates, named=single(result.named))


def check_input(arm: Arm, measurements: Measurements, holdout: Measurements | None, draws: int) -> None:
    """Raise `InputError` for too few draws and for data that do not fit the arm or lack what its effects need."""
    if draws < FEWEST_DRAWS:
        raise InputError(f"draws: {draws}, allowed: at least {FEWEST_DRAWS}, or no effect can pass the strictest test")
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
    measurements: Measurements,
    holdout: Measurements | None,
    explained: Explanation,
    fits: Fits,
    generator: np.random.Generator,
) -> Diagnosis:
    """Steps 6 to 8: the verdict, the gap before and after, and the tests on rows that were not used for the fits."""
    found, arm, named = explained.found, fits.base.model.arm, bool(explained.named.effects)
    kept = ~found.outlier
    choice = None if explained.smooth else validate_choice(found, measurements, generator)
    there = held_out_rows(explained, fits, choice, measurements, holdout)
    residuals = show_residuals(arm, measurements, fits.base, fits.after)
    before, after = residuals.before[kept], residuals.after[kept]
    gap = gap_of(before, after, there, noise_floor(residuals.after, measurements, kept, arm.sigma))
    estimated = len(fits.after.residual) - fits.after.freedom  # effective number of parameters
    result = named_effects(explained, measurements, residuals, gap, estimated)
    over_sigma = misfit(residuals.after, estimated, measurements, arm.sigma, kept)
    rows = Rows.of(measurements)
    unexplained = together(unexplained_rows(fits.after, rows), rows.postures, rows.posture_numbers) & kept
    confirmation = None
    if holdout is not None and there is not None:
        confirmation = confirmation_of(measurements, holdout, there, named)
    return replace(
        result,
        data=MappingProxyType({k: v for k, v in measurements.origin.items() if k != "rows"}),
        choice=choice,
        replication=replications(explained.fit, measurements, kept, result.effects),
        misfit=over_sigma,
        confirmation=confirmation,
        cross_validation=cross_validation(fits.base, fits.after, measurements, kept, generator, named),
        warnings=(*fit_doubts(arm, measurements, fits.after, after), *other_set_up(there)),
        notes=(
            *result.notes,
            *notes(arm, measurements, found, holdout, gap, over_sigma),
            *unexplained_note(residuals.after, unexplained),
            *prior_note(explained.prior),
        ),
        unexplained_rows=tuple((np.flatnonzero(unexplained) + 1).tolist()),
    )


def named_effects(
    explained: Explanation, measurements: Measurements, residuals: Residuals, gap: Gap, estimated: int
) -> Diagnosis:
    """The verdict with its candidates, aliases and tests.

    estimated : effective number of parameters of the best set
    """
    found, named, unknown = explained.found, explained.named, explained.found.unknown
    curves = explained.smooth.curves if explained.smooth else ()
    hidden = hidden_orders(found.search, {h.label: h for h in explained.chosen})
    detectable = assess_data(found, explained.fit.sigma)
    repeats = repeat_finding(residuals.after, estimated, measurements, ~found.outlier)
    return Diagnosis(
        arm=found.search.hypotheses.base.arm,
        verdict="named" if curves and unknown.place is None else verdict_of(found),
        candidates=explained.candidates,
        named=named,
        aliases=(*hidden, *alias_list(detectable, explained.candidates)),
        where=unknown.place,
        shape=next((c.shape for c in curves if unknown.place == f"joint:{c.joint}"), unknown.shape),
        scatter=(*found.scatter, *repeats),
        outlier_rows=tuple(int(k) + 1 for k in np.flatnonzero(found.outlier)),
        gap=gap,
        trials=trial_list(found),
        detectability=detectable,
        residuals=residuals,
        sigma=explained.fit.sigma,
        rounds=rounds_of(found.search, found.selection.path, explained.fit, named.effects),
        shapes=order_ranges(explained.fit, found.fits.rows, named.effects),
        probabilities=explained.likely,
        curves=curves,
        notes=(*overruled(found, explained.likely), *order_notes(hidden), *curve_notes(curves)),
        prior=explained.prior,
    )


def held_out_rows(
    explained: Explanation,
    fits: Fits,
    validated: ChoiceValidation | None,
    measurements: Measurements,
    holdout: Measurements | None,
) -> HeldOut | None:
    """Squared residuals of both models in the hold-out, with their prediction; None without a hold-out."""
    if holdout is None:
        return None
    smooth, found = explained.smooth, explained.found
    mismatch = smooth.excess if smooth else mismatch_of(found, explained.likely, validated, measurements, holdout)
    return held_out(fits.base, fits.after, measurements, ~found.outlier, holdout, mismatch)


def mismatch_of(
    found: Findings,
    likely: Probabilities,
    validated: ChoiceValidation | None,
    measurements: Measurements,
    holdout: Measurements | None,
) -> float:
    """Mean square distance [mm^2] in the hold-out due to a possibly wrong choice of effects.

    The larger of two estimates: the excess in the cross-validation of the choice, and the disagreement between the
    named model and its alternatives in the hold-out.
    """
    if validated is None or holdout is None:
        return 0.0
    there = held_out_conditions(measurements, holdout)
    return max(validated.excess, disagreement(found, likely, holdout, there))


def verdict_of(found: Findings) -> str:
    """`none`, `named`, `ambiguous` or `unknown`."""
    if found.unknown.place is not None:
        return "unknown"
    if not found.selection.chosen:
        return "none"
    return "ambiguous" if len(found.selection.rivals) > 1 else "named"


def assess_data(found: Findings, sigma: float) -> Detectability:
    """Detectability of every effect in these data, at the noise estimated from them; with waves if nothing is found."""
    search = found.search
    base = search.fit(())
    jacobian = base.model.jacobian(search.rows.postures, base.values, search.rows.conditions)
    level = found.selection.first.omnibus_test.threshold
    effects = assess(search.hypotheses, search.rows, jacobian, base.by_name, sigma, level)
    waves = excluded_waves(search, sigma) if verdict_of(found) == "none" else {}
    return replace(effects, detectable=MappingProxyType({**effects.detectable, **waves}))


def show_residuals(arm: Arm, measurements: Measurements, base: Fit, named: Fit) -> Residuals:
    """Residuals before and after, with the quantities they can be plotted against."""
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
        readonly(named.position_residuals(measurements, conditions)),
        MappingProxyType({name: readonly(values) for name, values in against.items()}),
        measurements.positions,
        conditions,
    )
