"""Reusing a calibration: only some of its parameters are estimated again, or all of them with it as the prior.

Where the base stands elsewhere than the fit assumes, a freer fit says so.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from identification.arm import SESSIONS, Arm, Calibration
from identification.errors import InputError, nearest, require
from identification.estimation import Identification, estimate
from identification.estimation.doubts import FALL, OTHER_FRAME, worth_freeing
from identification.estimation.problem import Problem
from identification.information import product_inverse, spectrum
from identification.kinematics.chain import BASE, ROTATION_ERROR, TOOL, TRANSLATION_ERROR
from identification.kinematics.counting import TURN, joint_range, range_of
from identification.kinematics.parameters import EFFECT, JOINT_OFFSET, LENGTH_ERROR, REVOLUTE
from identification.measurements import MOST, ROW_DIGESTS, Measurements, digests_in, digests_text
from identification.model import Model
from identification.model.placed import with_all_markers, without_prior_effects

# word -> kinds of parameters
KINDS: Mapping[str, tuple[str, ...]] = {
    "lengths": (LENGTH_ERROR, TRANSLATION_ERROR),
    "rotations": (ROTATION_ERROR,),
    "joint_offsets": (JOINT_OFFSET,),
    "base": (BASE,),
    "tool": (TOOL,),
    "effects": (EFFECT,),
}


def only(arm: Arm, words: Sequence[str], measurements: Measurements | None = None) -> Model:
    """The model of an arm of which only these parameters are estimated; the others stay at the arm's best known values.

    words : kinds (`KINDS`), effects (`backlash`, `backlash:2`) or parameters (`joint_offset:2`). `base` of a planar arm
        is its shift and the offset of joint 1; bases of further sessions are always estimated, points that the rows do
        not measure never by `tool`

    Raises `InputError` for words that name no parameter of the arm, and for a base or a measured point that is to be
    held and that nothing says.
    """
    if "base" in words:
        arm = arm.with_base()
    seen: Sequence[str] = ()
    if measurements is not None:
        arm = with_all_markers(arm, measurements)
        seen = () if arm.chain.instrument.own_targets else measurements.marker_names
    unseen = tuple(f"{TOOL}[{name}]." for name in arm.chain.tools if seen and name not in seen)
    model = Model(arm)
    effects, available, chosen = {effect.key: effect for effect in model.effects}, {*model.names}, set[str]()
    for word in words:
        if word in KINDS:
            named = {p.name for p in model.parameters if p.kind in KINDS[word] and not p.name.startswith(unseen)}
            named |= {*arm.chain.standing} if word == "base" else set()
        else:
            named = {name for name in available if name == word or name.rpartition(".")[0].partition(":")[0] == word}
            named |= {p.name for p in effects[word].parameters} if word in effects else set()
        if not named & available:
            kinds = {p.kind for p in model.parameters} | {BASE}
            allowed = [each for each, kinds_of_word in KINDS.items() if kinds & set(kinds_of_word)]
            near = nearest(word, [*allowed, *effects, *model.names])
            raise InputError(f"only: {word!r} is not a parameter of the model, {near}")
        chosen |= named & available
    chosen |= {name for name in model.names if name.startswith(f"{SESSIONS}.")}
    held = {name: value for name, value in model.best_known.items() if name not in chosen}
    kept, several = arm.calibration, measurements is not None and len(measurements.session_names) > 1
    frozen = {name for name in held if name not in model.fixed and not name.startswith(unseen)}
    known = () if kept is None else kept.tools
    lost = [n for n in arm.chain.tools if n not in known and any(p.startswith(f"{TOOL}[{n}].") for p in frozen)]
    for kind, missing, further, what in (
        (BASE, kept is None or kept.base is None, arm.chain.standing, BASE),
        (TOOL, lost, (), f"{TOOL} {', '.join(lost)}" if known and lost else TOOL),
    ):
        to_hold = frozen.intersection([*further, *(p.name for p in model.parameters if p.kind == kind)])
        if to_hold and (several or (missing and kind not in arm.chain.settled)):
            reason = "the data have several sessions" if several else "the arm file does not say where it is"
            raise InputError(f"only: {what} is to be held, but {reason}, allowed: --only with {kind} among the words")
    return replace(model, held=held)


def with_held(fit: Identification, before: Calibration | None, measurements: Measurements) -> Identification:
    """A fit of `only` some parameters with those that it holds at the values of an earlier calibration among its own:
    they stay as they are, with the covariance of that calibration, and what they may be off by moves those estimated
    (S. F. Schmidt, "Application of state-space methods to navigation problems", 1966: considered parameters)."""
    names = [] if before is None else [name for name in fit.model.held or () if name in before.parameter_names]
    if before is None or before.covariance is None or not names or not np.all(np.isfinite(fit.covariance)):
        return fit
    held, model = before.about(names), fit.model
    whole = replace(model, held={name: value for name, value in (model.held or {}).items() if name not in names})
    x, known = whole.parameters.vector(fit.values), before.freedom
    estimated, others = (np.array([whole.names.index(n) for n in each]) for each in (model.names, held.parameter_names))
    problem = Problem.of(whole, measurements)
    jacobian = problem.rows_about(x)[1]
    prior = fit.prior.rows(model.parameters, (fit.scatter or 0.0) / (problem.sigma or 1.0))
    root = spectrum(jacobian[:, estimated], model.scales, prior=prior).root
    moves = np.eye(len(x))[:, [*estimated, *others]]  # by errors of those estimated, and of those held
    moves[estimated, len(estimated) :] = -root @ (root.T @ (jacobian[:, estimated].T @ jacobian[:, others]))
    covariance = moves @ block_diag(fit.covariance, held.covariance) @ moves.T
    identifiable, freedom = np.ones(len(x), dtype=bool), np.empty(len(x))
    identifiable[estimated], freedom[estimated] = fit.identifiable, fit.uncertainty.freedom
    freedom[others] = [known[before.parameter_names.index(name)] for name in held.parameter_names]
    estimates = replace(fit, model=whole, parameters=x, identifiable=identifiable, held=frozenset(names))
    return replace(estimates, uncertainty=replace(fit.uncertainty, covariance=covariance, freedom=freedom))


def with_data_of(calibration: Calibration, before: Calibration | None, kinds: Sequence[str]) -> Calibration:
    """A calibration that had an earlier one as its prior: it knows the angles and the data of both."""
    if before is None:
        return calibration
    provenances, earlier = (calibration.provenance, before.provenance), before.provenance
    data = {key: earlier[key] for key in ("sha256", "rows") if key in earlier}
    held_from = {**earlier.get("held_from", {}), str(earlier.get("file", "data")): data}
    provenance: dict[str, Any] = {**calibration.provenance, "held_from": held_from}
    if kept := [one[ROW_DIGESTS] for one in provenances if isinstance(one.get(ROW_DIGESTS), str)]:
        provenance[ROW_DIGESTS] = digests_text(set().union(*map(digests_in, kept)))
    new, old = (range_of(one, kinds) for one in provenances)
    if new is not None and old is not None:
        # [rad, mm] of both, the new one moved by whole turns next to the old one
        turns = np.where(np.array(kinds) == REVOLUTE, TURN * np.round((old - new).mean(axis=0) / TURN), 0.0)
        both = np.minimum(old[0], new[0] + turns), np.maximum(old[1], new[1] + turns)
        provenance |= joint_range(np.array(both), kinds)
    return replace(calibration, provenance=provenance)


# -- an earlier calibration as the prior -------------------------------------------------------------------------------
def earlier(calibrated: Arm, model: Model, measurements: Measurements) -> Calibration:
    """What a calibrated arm says of a model's parameters, but for where base and measured points are, which are found
    again; given what the model holds.

    Raises `InputError` for another drawing, no covariance, no parameter in common, and measurements that the
    calibration comes from: they would count twice. Warns (`UserWarning`) of some rows that are in both, and where the
    calibration does not say which rows it comes from.
    """
    calibration = calibrated.calibration
    if calibration is None or calibration.covariance is None:
        raise InputError("prior: found no covariance, allowed: a file written by `armcal identify --out`")
    if not calibrated.chain.drawn_as(model.arm.chain):
        raise InputError("prior: a calibration of another drawing, allowed: of the same lengths and frames")
    of_its_model, of_this = ({e.label for e in m.effects} for m in (Model(without_prior_effects(calibrated)), model))
    if lacking := sorted(of_its_model - {*of_this, "base_offset"}):
        beside = f"it was fitted with {', '.join(lacking)}, which the model does not have; give the file as ARM, too"
        warnings.warn(f"prior: {beside}", UserWarning, stacklevel=2)
    shared, of_its = 0.0, 0.0  # of these rows that are among its own, and of its own
    if isinstance(text := calibration.provenance.get(ROW_DIGESTS), str):
        shared, of_its = measurements.shared_rows(text)
    else:
        why = "the calibration does not say which rows it was fitted to, as those of earlier versions"
        warnings.warn(f"prior: {why}; measurements among them would count twice", UserWarning, stacklevel=2)
    share = f"about {100.0 * shared:.0f} % of these rows ({100.0 * of_its:.0f} % of the calibration's own)"
    twice = "are among those it was fitted to, which would count twice, allowed: new measurements"
    require(max(shared, of_its) < MOST, f"prior: {share} {twice}")
    if shared > 0.0:
        warnings.warn(f"prior: {share} are among those it was fitted to, and count twice", UserWarning, stacklevel=2)
    held = {name: value for name, value in model.fixed.items() if name in calibration.parameter_names}
    # where arm and instrument stand; the offset of joint 1 says so beside effects that do
    standing = {*model.arm.chain.standing}
    of_set_up = {p.name for p in model.all_parameters if p.kind in (BASE, TOOL)}
    of_set_up |= standing if standing <= {*model.all_parameters.names} else set()
    of_set_up |= {p.name for effect in model.effects if effect.once for p in effect.parameters}  # in its own session
    of_both = calibration.about((set(model.names) | set(held)) - of_set_up)
    if not set(of_both.parameter_names) - set(held):
        raise InputError("prior: no parameter of the model in the calibration, allowed: one of the same arm")
    # the normal distribution of the others, where those that the model holds have its values
    names, covariance = of_both.parameter_names, np.asarray(of_both.covariance)
    fixed = np.array([name in held for name in names])
    off = [held[name] - of_both.values[name] for name, is_fixed in zip(names, fixed, strict=True) if is_fixed]
    gain = covariance[np.ix_(~fixed, fixed)] @ product_inverse(covariance[np.ix_(fixed, fixed)])
    free = [name for name in names if name not in held]
    moved = [of_both.values[name] for name in free] + gain @ off
    rest = covariance[np.ix_(~fixed, ~fixed)] - gain @ covariance[np.ix_(fixed, ~fixed)]
    return Calibration(dict(zip(free, moved.tolist(), strict=True)), tuple(free), rest)


# -- another set-up ----------------------------------------------------------------------------------------------------
def with_base_doubt(held: Identification, arm: Arm, words: Sequence[str], measurements: Measurements) -> Identification:
    """A fit of `only` these words, with a doubt where what it holds happened once, in another session; and where the
    base is held and the arm stands elsewhere by now: residuals fall as in `doubts.another_frame` where it is estimated,
    too."""
    frozen = set(held.model.held or ())
    once = [e.key for e in held.model.effects if e.once and not frozen.isdisjoint(p.name for p in e.parameters)]
    if once and measurements.share_fitted(arm.provenance) < MOST:
        again = f"{', '.join(once)}: held, and so assumed to happen again from the first of these rows to the last"
        held = replace(held, doubts=(*held.doubts, again))
    try:
        free = estimate(only(arm, ["base", *words], measurements), measurements) if "base" not in words else held
    except InputError:  # the base is given, or too few rows
        return held
    left, left_free = (float(np.sum(fit.residuals_after**2)) for fit in (held, free))
    if not worth_freeing(left, left_free, len(free.names) - len(held.names), free.dof, FALL**2):
        return held
    fall = f"the RMS falls from {held.rms_after:.4g} to {free.rms_after:.4g} mm"
    reason = f"the base pose is not that of the arm file: {fall} if the base is estimated, too"
    others = (doubt for doubt in held.doubts if not doubt.startswith(OTHER_FRAME))
    return replace(held, doubts=(f"{reason}; add it: --only base,{','.join(words)}", *others))
