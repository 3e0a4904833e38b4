"""`diagnose`: the eight steps of the gap workflow in order (identification/README.md, "Gap workflow")."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from identification.arm import Arm
from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.estimation.estimate import check
from identification.gap.candidates import candidate, candidate_list, trial_list
from identification.gap.certainty import fit_doubts
from identification.gap.choice_validation import ChoiceValidation, disagreement, validate_choice
from identification.gap.cross_validation import cross_validation
from identification.gap.curves import curve_candidate, find_curves
from identification.gap.detectability import Detectability, assess, require_spare
from identification.gap.fit import Fit, fit
from identification.gap.holdout import (
    check_holdout,
    check_same_arm,
    confirmation_of,
    gap_of,
    held_out,
    held_out_conditions,
)
from identification.gap.hypotheses import hypotheses
from identification.gap.misfit import misfit
from identification.gap.notes import alias_list, hidden_orders, notes, order_notes
from identification.gap.order_range import order_ranges
from identification.gap.probabilities import Probabilities, probabilities
from identification.gap.repeats import noise_floor, repeat_finding
from identification.gap.replicate import replications
from identification.gap.result import Candidate, Diagnosis, Residuals
from identification.gap.rounds import rounds_of
from identification.gap.search import LEVEL_FACTOR, HypothesisSearch
from identification.gap.selection import ALPHA_NEXT
from identification.gap.whitening import Rows
from identification.gap.workflow import Findings, investigate_some
from identification.measurements import Measurements
from identification.model import Model
from identification.progress import Progress, silent
from identification.sessions import of_these_sessions, with_base, with_sessions, without_sessions

STEPS = 8  # of the progress bar
# the strictest level must be within reach: p >= 1 / (draws + 1) (identification/README.md, "Constants")
FEWEST_DRAWS = round(1.0 / (ALPHA_NEXT * LEVEL_FACTOR)) - 1


def diagnose(
    arm: Arm,
    measurements: Measurements,
    holdout: Measurements | None = None,
    seed: int = 0,
    draws: int = 999,
    progress: Progress = silent,
) -> Diagnosis:
    """Whether model and measurements disagree, which effect is missing, and whether adding it closes the gap.

    arm : effects in it are part of the base model, everything they do not fix is estimated again
    measurements : of one session, or of several that their column `session` names, each with a base of its own
    holdout : measurements of the same arm that are used for nothing but the confirmation
    seed : of the bootstrap; the same seed gives the same diagnosis
    draws : bootstrap draws, at least 399

    Raises `InputError` for data of another arm, effects without the data they need, fewer than 4 residual degrees of
    freedom, one posture or one position only, a hold-out of another arm or one that shares rows with the data.
    """
    if draws < FEWEST_DRAWS:
        raise InputError(f"draws: {draws}, allowed: at least {FEWEST_DRAWS}, or no effect can pass the strictest test")
    check_input(arm, measurements, holdout)
    holdout = None if holdout is None else of_these_sessions(holdout, measurements)
    given, arm = arm, with_sessions(arm, measurements)
    rows = Rows.of(measurements)
    library = hypotheses(arm, varying(measurements), rows)
    first = HypothesisSearch(library, rows).fit(())
    require_spare(first.freedom, len(rows))
    if holdout is not None:
        check_same_arm(first, measurements, holdout)
    generator = np.random.default_rng(seed)
    progress(1, STEPS, "base model fitted")
    found = investigate_some(library, rows, draws, generator, lambda message: progress(2, STEPS, message))
    progress(6, STEPS, "assessing the plan, the sizes excluded, and the held-out data")
    result = diagnosis_of(arm, measurements, holdout, found, draws, generator)
    progress(STEPS, STEPS, result.sentence)
    return result if arm is given else of_first_session(result, given)


def of_first_session(result: Diagnosis, arm: Arm) -> Diagnosis:
    """A diagnosis of several sessions without the bases of the later ones: the arm stands as in the first."""

    def single(found: Candidate) -> Candidate:
        return replace(found, calibration=without_sessions(found.calibration))

    candidates = tuple(map(single, result.candidates))
    return replace(result, arm=with_base(arm), candidates=candidates, named=single(result.named))


def check_input(arm: Arm, measurements: Measurements, holdout: Measurements | None) -> None:
    """Raise `InputError` for data that do not belong to the arm or lack what its effects need."""
    check(Model(arm), measurements)
    for name, table in (("posture", measurements.postures), ("position", measurements.positions)):
        if np.all(np.ptp(table, axis=0) == 0.0):
            raise InputError(f"measurements: the same {name} in all {len(table)} rows, allowed: several {name}s")
    if holdout is not None:
        check_holdout(measurements, holdout)


def varying(measurements: Measurements) -> frozenset[str]:
    """Optional columns that are given and not constant: a constant one cannot show anything."""
    names = ("temperature", "payload", "order")
    given = {name: getattr(measurements, name) for name in names if getattr(measurements, name) is not None}
    return frozenset(name for name, values in given.items() if np.ptp(values) > 0.0)


def diagnosis_of(
    arm: Arm,
    measurements: Measurements,
    holdout: Measurements | None,
    found: Findings,
    draws: int,
    generator: np.random.Generator,
) -> Diagnosis:
    """What was found, with its candidates, aliases, the gap before and after, and notes."""
    chosen, kept = found.unknown.chosen, ~found.outlier
    fitted = found.search.fit(chosen)
    likely = probabilities(found)
    candidates = candidate_list(found, draws, generator)
    named = next((c for c in candidates if set(c.effects) == {h.label for h in chosen}), None)
    named = named or candidate(found.search, chosen, 0.0, draws, generator)
    if (smooth := find_curves(found, measurements)) is not None:
        fitted, found, chosen = smooth.fit, replace(found, scatter=smooth.scatter), smooth.kept
        named = curve_candidate(smooth)
        # the curve of an unknown function is no name for it
        known = named.keys if found.unknown.place is None else None
        candidates, likely = (named,), likely.with_odds(known, smooth.gain / 2.0)
    candidates = tuple(replace(c, probability=likely.of(c.keys)) for c in candidates)
    curves = smooth.curves if smooth else ()
    hidden = hidden_orders(found.search, {h.label: h for h in chosen})
    detectable = assess_data(found, fitted.sigma)
    base = fit(Model(arm), Rows.of(measurements).pick(kept))  # as `identify` fits it
    of_used = base if found.sampled is None else fit(Model(arm), Rows.of(measurements).pick(found.used), base.by_name)
    after = fitted if chosen or curves else of_used
    validated = None if curves else validate_choice(found, measurements, generator)
    mismatch = smooth.excess if smooth else mismatch_of(found, likely, validated, measurements, holdout)
    there = None if holdout is None else held_out(base, after, measurements, kept, holdout, mismatch)
    residuals = show_residuals(arm, measurements, base, after)
    estimated = len(after.residual) - after.freedom  # parameters, less what a prior knows of them
    floor = noise_floor(residuals.after, measurements, kept, arm.sigma)
    gap = gap_of(residuals.before[kept], residuals.after[kept], there, floor)
    return Diagnosis(
        arm=arm,
        verdict="named" if curves and found.unknown.place is None else verdict_of(found),
        candidates=candidates,
        named=replace(named, probability=likely.of(named.keys)),
        aliases=(*hidden, *alias_list(detectable, candidates)),
        where=found.unknown.place,
        shape=next((c.shape for c in curves if found.unknown.place == f"joint:{c.joint}"), found.unknown.shape),
        scatter=(*found.scatter, *repeat_finding(residuals.after, estimated, measurements, kept)),
        outlier_rows=tuple(int(k) + 1 for k in np.flatnonzero(found.outlier)),
        gap=gap,
        trials=trial_list(found),
        detectability=detectable,
        residuals=residuals,
        sigma=fitted.sigma,
        rounds=rounds_of(found.search, (*found.selection.path, chosen)),
        shapes=order_ranges(fitted, found.search.rows, named.effects),
        probabilities=likely,
        choice=validated,
        replication=replications(fitted, measurements, kept, named.effects),
        misfit=misfit(residuals.after, estimated, measurements, arm.sigma, kept),
        confirmation=None if holdout is None or there is None else confirmation_of(measurements, holdout, there),
        cross_validation=cross_validation(of_used, after, measurements, found.used, generator),
        warnings=fit_doubts(arm, measurements, after, residuals.after[kept]),
        curves=curves,
        notes=(*order_notes(hidden), *notes(arm, measurements, found, holdout, gap)),
    )


def mismatch_of(
    found: Findings,
    likely: Probabilities,
    validated: ChoiceValidation | None,
    measurements: Measurements,
    holdout: Measurements | None,
) -> float:
    """Mean square distance [mm^2] that the choice of the named model adds in the hold-out: what cross-validation of
    the choice shows, or what other explanations predict there, whichever is more."""
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
    """What these data could show beside the base model, at the noise they really have."""
    search = found.search
    base = search.fit(())
    jacobian = base.model.jacobian(search.rows.postures, base.values, search.rows.conditions)
    return assess(
        search.hypotheses, search.rows, jacobian, base.by_name, sigma, found.selection.first.omnibus_test.threshold
    )


def show_residuals(arm: Arm, measurements: Measurements, base: Fit, named: Fit) -> Residuals:
    """Residuals before and after with what they can be drawn against."""
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
    )
