"""`diagnose`: the eight steps of the gap workflow in order (identification/README.md, "Gap workflow")."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from identification.arm import Arm, Calibration
from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.estimation.intervals import limits_95
from identification.gap.detectability import EXACT, NEAR, Detectability, assess, require_spare
from identification.gap.fit import Fit
from identification.gap.holdout import Gap, check_holdout, check_same_arm, confirm, residuals
from identification.gap.hypotheses import Hypothesis, HypothesisSet, hypotheses
from identification.gap.noise import repeat_finding
from identification.gap.result import Candidate, Diagnosis, Estimate, Residuals, Trial
from identification.gap.selection import ALPHA_NEXT, LEVEL_FACTOR, Choice, HypothesisSearch, trial_of
from identification.gap.whitening import Rows
from identification.gap.workflow import Findings, investigate
from identification.measurements import Measurements
from identification.model import Model
from identification.progress import Progress, silent

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
    holdout : measurements of the same arm that are used for nothing but the confirmation
    seed : of the bootstrap; the same seed gives the same diagnosis
    draws : bootstrap draws, at least 399

    Raises `InputError` for data of another arm, effects without the data they need, fewer than 4 spare degrees of
    freedom, one posture or one position only, a hold-out of another arm or one that shares rows with the data.
    """
    if draws < FEWEST_DRAWS:
        raise InputError(f"draws: {draws}, allowed: at least {FEWEST_DRAWS}, or no effect can pass the strictest test")
    check_input(arm, measurements, holdout)
    library = hypotheses(arm, varying(measurements))
    rows = Rows.of(measurements)
    first = HypothesisSearch(library, rows).fit(())
    require_spare(first.freedom, len(rows))
    if holdout is not None:
        check_same_arm(first, measurements, holdout)
    generator = np.random.default_rng(seed)
    progress(1, STEPS, "base model fitted")
    found = investigate(library, rows, draws, generator, lambda message: progress(2, STEPS, message))
    progress(6, STEPS, "assessing the plan and the sizes excluded")
    before = assess_data(library, found)
    chosen = found.unknown.chosen
    candidates = candidate_list(found, draws, generator)
    named = next((c for c in candidates if c.specs == tuple(h.spec for h in chosen)), None)
    named = named or describe(found.search, chosen, 0.0, trial_of(found.search, chosen, draws, generator))
    hidden = hidden_orders(found.search, dict(zip(named.effects, chosen, strict=True)))
    progress(7, STEPS, "confirming on held-out data")
    gap = confirm(found.search.fit(()), found.search.fit(chosen), measurements, ~found.outlier, holdout)
    result = Diagnosis(
        arm=arm,
        verdict=verdict_of(found),
        candidates=candidates,
        named=named,
        classes=named.classes,
        aliases=(*hidden, *alias_list(before, candidates)),
        where=found.unknown.place,
        shape=found.unknown.shape,
        p_unknown=found.unknown.p,
        scatter=(*found.scatter, *repeat_finding(measurements, found.search.fit(chosen), ~found.outlier)),
        outlier_rows=tuple(int(k) + 1 for k in np.flatnonzero(found.outlier)),
        excluded=before.detectable,
        gap=gap,
        trials=trial_list(found),
        detectability=before,
        residuals=show_residuals(arm, measurements, found.search.fit(()), found.search.fit(chosen)),
        sigma=found.search.fit(chosen).sigma,
        notes=(*order_notes(hidden), *notes(arm, measurements, found, holdout, gap)),
    )
    progress(STEPS, STEPS, result.sentence)
    return result


def check_input(arm: Arm, measurements: Measurements, holdout: Measurements | None) -> None:
    """Raise `InputError` for data that do not belong to the arm or lack what its effects need."""
    if measurements.links != arm.links:
        raise InputError(f"measurements: {measurements.links} joints, allowed: {arm.links} as in the arm file")
    model = Model(arm)
    if measurements.dimension != model.dimension:
        found = f"positions of {measurements.dimension} coordinates"
        raise InputError(f"measurements: {found}, allowed: {model.dimension} as the model has")
    for name, table in (("posture", measurements.postures), ("position", measurements.positions)):
        if np.all(np.ptp(table, axis=0) == 0.0):
            raise InputError(f"measurements: the same {name} in all {len(table)} rows, allowed: several {name}s")
    if "temperature" in model.needs and measurements.temperature is None:
        raise InputError("temperature_C: an effect in the arm file needs it, the measurements have no such column")
    if "gravity" in model.needs and arm.gravity is None:
        raise InputError(
            "gravity: an effect in the arm file needs gravity torques, the arm file has no [gravity] table"
        )
    if holdout is not None:
        check_holdout(measurements, holdout)


def varying(measurements: Measurements) -> frozenset[str]:
    """Optional columns that are given and not constant: a constant one cannot show anything."""
    names = ("temperature", "payload", "order")
    given = {name: getattr(measurements, name) for name in names if getattr(measurements, name) is not None}
    return frozenset(name for name, values in given.items() if np.ptp(values) > 0.0)


def verdict_of(found: Findings) -> str:
    """`none`, `named`, `ambiguous` or `unknown`."""
    if found.unknown.place is not None:
        return "unknown"
    if not found.selection.chosen:
        return "none"
    return "ambiguous" if len(found.selection.rivals) > 1 else "named"


def assess_data(library: HypothesisSet, found: Findings) -> Detectability:
    """What these data could show beside the base model, at the noise they really have."""
    search = found.search
    base = search.fit(())
    jacobian = base.model.jacobian(search.rows.postures, base.values, search.rows.conditions)
    sigma = search.fit(found.unknown.chosen).sigma
    return assess(library, search.rows, jacobian, base.by_name, sigma, found.selection.first.omnibus_test.threshold)


def candidate_list(found: Findings, draws: int, generator: np.random.Generator) -> tuple[Candidate, ...]:
    """The ambiguity set as results; with an unknown effect, only what stays named beside it."""
    rivals = found.selection.rivals
    if found.unknown.place is not None:
        rivals = ((found.unknown.chosen, 0.0),) if found.unknown.chosen else ()
    return tuple(
        describe(found.search, chosen, delta, trial_of(found.search, chosen, draws, generator))
        for chosen, delta in rivals
    )


def describe(search: HypothesisSearch, chosen: Choice, delta: float, trial: tuple[float, float]) -> Candidate:
    """A set of effects with its estimates."""
    found = search.fit(chosen)
    covariance = found.covariance(bounded=False)
    deviations = np.sqrt(np.diag(covariance))
    limits = limits_95(found.model.parameters, found.values, deviations, found.freedom)
    effects = found.model.effects[len(found.model.effects) - len(chosen) :]  # their names depend on the others
    added = {p.name for effect in effects for p in effect.parameters}
    estimates = []
    for k, p in enumerate(found.model.parameters):
        if p.name in added:
            figures = np.array([found.values[k], deviations[k], *limits[k]]) * p.to_file
            estimates.append(Estimate(p.name, p.file_unit, *figures.tolist()))
    return Candidate(
        tuple(effect.key for effect in effects),
        tuple(h.spec for h in chosen),
        tuple(sorted({h.family for h in chosen})),
        delta,
        *trial,
        tuple(estimates),
        _calibration(found, covariance),
    )


def _calibration(found: Fit, covariance: Array) -> Calibration:
    return Calibration(found.by_name, found.model.names, covariance, MappingProxyType({"source": "armcal diagnose"}))


def alias_list(before: Detectability, candidates: tuple[Candidate, ...]) -> tuple[tuple[str, str, float], ...]:
    """Near and exact aliases of the candidates' effects on these data, and the effects that can never be seen."""
    named = {key for c in candidates for key in c.effects}
    pairs = [pair for pair in before.pairs(NEAR) if pair[0] in named]
    return (*pairs, *((name, like, 1.0) for name, like in before.aliases.items()))


def hidden_orders(search: HypothesisSearch, named: Mapping[str, Hypothesis]) -> tuple[tuple[str, str, float], ...]:
    """Gear ripples that these postures cannot tell from a named effect of the same joint: effect, ripple, likeness.

    On a grid of angles a ripple of 15 periods per turn may be the very column of an eccentric encoder, and the
    diagnosis names the likelier one.
    """
    listed = []
    for name, member in named.items():
        members, against = search.rivals(tuple(h for h in named.values() if h is not member))
        places = {h.label: i for i, h in enumerate(members)}
        if member.label not in places or member.spec.joint is None:
            continue
        mine = against.block(places[member.label])
        for label, i in places.items():
            other = members[i]
            if label != member.label and other.spec.values and other.spec.joint == member.spec.joint:
                likeness = float(np.linalg.norm(against.block(i).T @ mine) / np.sqrt(mine.shape[1]))
                if likeness >= NEAR:
                    settings = ", ".join(f"{name} = {value:g}" for name, value in other.spec.values.items())
                    listed.append((name, f"{other.key} ({settings})", min(likeness, 1.0)))
    return tuple(sorted(listed, key=lambda row: -round(row[2], 4)))


def order_notes(hidden: tuple[tuple[str, str, float], ...]) -> list[str]:
    """One line per named effect that a ripple imitates on these postures."""
    said = []
    for key in dict.fromkeys(key for key, _, _ in hidden):
        likes = [(other, likeness) for own, other, likeness in hidden if own == key]
        word = "is the same as" if likes[0][1] >= EXACT else "is much like"
        more = f" and {len(likes) - 3} more" if len(likes) > 3 else ""
        listed = ", ".join(other for other, _ in likes[:3])
        said.append(f"on these postures {key} {word} {listed}{more}: measure at other angles to tell")
    return said


def trial_list(found: Findings) -> tuple[Trial, ...]:
    """Every effect against the base model, strongest first; of a scanned setting the best."""
    test = found.selection.first
    best: dict[str, Trial] = {}
    for k, h in enumerate(test.members):
        trial = Trial(
            h.key,
            float(test.omnibus_test.f[k]),
            float(test.omnibus_test.p[k]),
            float(test.omnibus_test.adjusted[k]),
            float(test.change[k]),
        )
        if h.key not in best or trial.delta_bic < best[h.key].delta_bic:
            best[h.key] = trial
    return tuple(sorted(best.values(), key=lambda t: t.delta_bic))


def show_residuals(arm: Arm, measurements: Measurements, base: Fit, named: Fit) -> Residuals:
    """Residuals before and after with what they can be drawn against."""
    conditions = measurements.conditions
    against: dict[str, Array] = {f"joint {j + 1} [rad]": measurements.postures[:, j] for j in range(arm.links)}
    against["time"] = np.zeros(len(measurements)) if conditions.time is None else conditions.time
    if arm.gravity is not None:
        tau = torques(arm, measurements)
        against |= {f"torque {j + 1} [N m]": tau[:, j] for j in range(arm.links)}
    if measurements.temperature is not None:
        against["temperature [C]"] = measurements.temperature
    return Residuals(
        readonly(residuals(base, measurements, conditions)),
        readonly(residuals(named, measurements, conditions)),
        MappingProxyType({name: readonly(values) for name, values in against.items()}),
        measurements.positions,
    )


def torques(arm: Arm, measurements: Measurements) -> Array:
    """(m, n) gravity torques [N m] at the nominal pose."""
    return Model(arm).on_chain(lambda chain: chain.torques)(measurements.postures, measurements.conditions)


def notes(arm: Arm, measurements: Measurements, found: Findings, holdout: Measurements | None, gap: Gap) -> list[str]:
    """What a person should know before trusting the verdict."""
    said = [f"{key} was not tried: {why}" for key, why in found.search.hypotheses.skipped.items()]
    if measurements.directions is None:
        said.append("directions of approach follow from the order of measurement")
    said += [
        f"joint {j + 1} never moves: its link cannot be told from the one before"
        for j in range(arm.links)
        if np.ptp(measurements.postures[:, j]) == 0.0
    ]
    if arm.sigma is not None:
        ratio = found.search.fit(found.unknown.chosen).sigma / arm.sigma
        if measurements.sigma is None and not 0.67 < ratio < 1.5:
            said.append(f"the scatter is {ratio:.2f} times the sigma_mm of the arm file; the tests use the scatter")
    if gap.held_out_after is not None and gap.predicted is not None and gap.held_out_after > 3.0 * gap.predicted:
        times = gap.held_out_after / gap.predicted
        said.append(f"the held-out rows are {times:.2g} times farther off than predicted: another range or set-up?")
    drifts = any("drift" in effect for effect in (h.key for h in found.unknown.chosen))
    if drifts and holdout is not None:
        said.append("a drift of one session says nothing of another: judge it by a hold-out from the same session")
    return said
