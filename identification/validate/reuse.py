"""Reusing a calibration: only some of its parameters are estimated again, or all of them with it as the prior.

The tracker moved, a motor was changed, a year went by: most of what was found still holds.

A calibrated arm placed for other measurements: the base refitted, the rest unchanged.

The calibrated geometry of a spatial arm is composed into its chain, so that base and measured points are found by the
closed form on it and then, with the effects of the arm, by least squares.

A set-up other than the fit assumes: a measured point that was mounted elsewhere between two sessions.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtrc

from identification.arm import Arm, Calibration, EffectSpec
from identification.arrays import Array
from identification.errors import InputError, nearest
from identification.estimation import Identification, estimate
from identification.estimation.doubts import FALL, OTHER_FRAME, SPARE
from identification.estimation.prior import Earlier
from identification.estimation.uncertainty import LEVEL
from identification.kinematics.corrected import composed_axes, composed_base, composed_tools, corrected, errors_between
from identification.kinematics.frames import own_axes_angles
from identification.kinematics.joint_range import joint_range, range_of
from identification.kinematics.parameters import EFFECT, JOINT_OFFSET, LENGTH_ERROR, REVOLUTE, ParameterSet, of_effects
from identification.kinematics.spatial import BASE, ROTATION_ERROR, TOOL, TRANSLATION_ERROR, SpatialChain
from identification.kinematics.turns import TURN
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.model.placed import one_unnamed, placed_model, with_markers
from identification.row_digests import ROW_DIGESTS, rows_shared, union
from identification.sessions import BASE as PLANAR_BASE
from identification.sessions import SESSIONS, start_at_bases, with_base, with_base_offset
from identification.validate.row_groups import data_hashes, identified

MOSTLY = 0.5  # of the rows; coarse readings of postures that are commanded again may agree by chance
HELD_FROM = "held_from"  # key of a calibration's provenance
# word -> kinds of parameters
KINDS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "lengths": (LENGTH_ERROR, TRANSLATION_ERROR),
        "rotations": (ROTATION_ERROR,),
        "joint_offsets": (JOINT_OFFSET,),
        "base": (BASE,),
        "tool": (TOOL,),
        "effects": (EFFECT,),
    }
)


def words_of(texts: Iterable[str]) -> list[str]:
    """The words of `lengths,base`, given once or several times."""
    return [word.strip() for text in texts for word in text.split(",") if word.strip()]


def only(arm: Arm, words: Sequence[str], measurements: Measurements | None = None) -> Model:
    """The model of an arm of which only these parameters are estimated; the others stay at the arm's best known values.

    words : kinds (`KINDS`), effects (`backlash`, `backlash:2`) or parameters (`joint_offset:2`). `base` of a planar arm
        is its shift and the offset of joint 1; bases of further sessions are always estimated

    Raises `InputError` for words that name no parameter of the arm, and for a base or a measured point that is to be
    held and that nothing says.
    """
    if "base" in words:
        arm = with_base(arm)
    if not arm.chain.planar and measurements is not None:
        arm = replace(arm, chain=with_markers(arm.chain, measurements))
    model = Model(arm)
    chosen = {name for word in words for name in _named(word, model)}
    chosen |= {name for name in model.names if name.startswith(f"{SESSIONS}.")}
    held = {name: value for name, value in model.best_known.items() if name not in chosen}
    _check_places(arm, model, set(held) - set(model.fixed), measurements)
    return replace(model, known=held)


def _named(word: str, model: Model) -> set[str]:
    """Names of the parameters that a word means."""
    effects = {effect.key: effect for effect in model.effects}
    if word == "base" and model.arm.chain.planar:
        named = {p.name for p in model.parameters if p.name in PLANAR_BASE}
    elif word in KINDS:
        named = {p.name for p in model.parameters if p.kind in KINDS[word]}
    else:
        named = {name for name in model.names if name == word or name.rpartition(".")[0].partition(":")[0] == word}
        named |= {p.name for key, effect in effects.items() if key == word for p in effect.parameters}
    if named & set(model.names):
        return named & set(model.names)
    kinds = {p.kind for p in model.parameters} | {BASE}
    allowed = [word for word, kinds_of_word in KINDS.items() if kinds & set(kinds_of_word)]
    names = [*allowed, *effects, *model.names]
    raise InputError(f"only: {word!r} is no parameter of the model, {nearest(word, names)}")


def at_reference(measurements: Measurements, calibrated: Arm) -> Measurements:
    """Temperatures counted from where the calibration counts them, where it says so: what it says of lengths and of
    their growth is right there."""
    reference = identified(calibrated).get("mean_temperature_C")
    return measurements if reference is None else replace(measurements, reference=float(reference))


def with_base_doubt(
    held_fit: Identification, arm: Arm, words: Sequence[str], measurements: Measurements
) -> Identification:
    """A fit of `only` these words, with a doubt where the base is held and the arm stands elsewhere by now: residuals
    fall as in `plausibility.another_frame` where it is estimated, too."""
    try:
        model = only(arm, ["base", *words], measurements)
        refitted = estimate(model, measurements) if "base" not in words else held_fit
    except InputError:  # the base is given, or too few rows
        return held_fit
    freed, (held, free) = (
        len(refitted.names) - len(held_fit.names),
        (float(np.sum(fit.residuals_after**2)) for fit in (held_fit, refitted)),
    )
    if freed <= 0 or refitted.dof < SPARE or not held > FALL**2 * free:
        return held_fit
    if fdtrc(freed, refitted.dof, (held - free) / freed / max(free / refitted.dof, np.finfo(float).tiny)) > LEVEL:
        return held_fit
    fall = (
        f"the RMS falls from {held_fit.rms_after:.4g} to {refitted.rms_after:.4g} mm where the base is estimated, too"
    )
    reason = f"the arm does not stand where the arm file says: {fall}; add it: --only base,{','.join(words)}"
    return replace(
        held_fit, doubts=(reason, *(doubt for doubt in held_fit.doubts if not doubt.startswith(OTHER_FRAME)))
    )


def _check_places(arm: Arm, model: Model, held: set[str], measurements: Measurements | None) -> None:
    """Raises `InputError` for base or measured points that are held without being known."""
    several = measurements is not None and len(measurements.session_names) > 1
    kept = arm.calibration
    missing = {BASE: kept is None or kept.base is None, TOOL: kept is None or not kept.tools}
    for kind in (BASE, TOOL) if not arm.chain.planar else ():
        if (missing[kind] or several) and any(p.kind == kind and p.name in held for p in model.parameters):
            reason = "the data have several sessions" if several else "the arm file does not say where it is"
            raise InputError(f"only: {kind} is to be held, but {reason}, allowed: --only with {kind} among the words")
    if several and arm.chain.planar and set(PLANAR_BASE) & held:
        raise InputError("only: base is to be held, but the data have several sessions, allowed: --only with base")


def with_held(calibration: Calibration, before: Calibration | None, kinds: Sequence[str]) -> Calibration:
    """A calibration with what parameters had before that it does not estimate: their covariance, as independent of its
    own, the angles that they were found on, and the data that they come from (`held_from` of the provenance).

    kinds : types of the joints
    """
    if before is None or not (
        names := set(before.parameter_names) & set(calibration.values) - set(calibration.parameter_names)
    ):
        return calibration
    calibration = with_data_of(calibration, before, kinds)
    if before.covariance is None or calibration.covariance is None:
        return calibration
    held = before.about(names)
    covariance = block_diag(calibration.covariance, held.covariance)
    return replace(
        calibration, parameter_names=(*calibration.parameter_names, *held.parameter_names), covariance=covariance
    )


def with_data_of(calibration: Calibration, before: Calibration | None, kinds: Sequence[str]) -> Calibration:
    """A calibration that had an earlier one as its prior: it knows the angles and the data of both."""
    if before is None:
        return calibration
    return replace(calibration, provenance=MappingProxyType(_of_both(calibration.provenance, before.provenance, kinds)))


def _of_both(new_provenance: Mapping[str, Any], before: Mapping[str, Any], kinds: Sequence[str]) -> dict[str, Any]:
    """Provenance of a calibration that keeps what an earlier one knew."""
    data = {key: before[key] for key in ("sha256", "rows") if key in before}
    provenance = {**new_provenance, HELD_FROM: {**before.get(HELD_FROM, {}), str(before.get("file", "data")): data}}
    if kept := [one[ROW_DIGESTS] for one in (new_provenance, before) if isinstance(one.get(ROW_DIGESTS), str)]:
        provenance[ROW_DIGESTS] = union(kept)
    new, old = (range_of(one, kinds) for one in (new_provenance, before))
    if new is not None and old is not None:
        widest = []  # [rad, mm] of both: of a revolute joint by the whole turns that leave it the narrowest
        for joint, before_joint, kind in zip(new.T, old.T, kinds, strict=True):
            away = round((before_joint.mean() - joint.mean()) / TURN) + np.arange(-1, 2)
            turns = TURN * away if kind == REVOLUTE else [0.0]
            hulls = [[min(before_joint[0], joint[0] + s), max(before_joint[1], joint[1] + s)] for s in turns]
            widest.append(min(hulls, key=np.ptp))
        provenance |= joint_range(np.transpose(widest), kinds)
    return provenance


# -- an earlier calibration as the prior ------------------------------------------------------------------------------
def earlier(calibrated: Arm, model: Model, measurements: Measurements) -> Earlier:
    """What a calibrated arm says of a model's parameters, but for where base and measured points are, which are found
    again; given what the model holds.

    measurements : that it is to be the prior of

    Raises `InputError` for another drawing, no covariance, no parameter in common, and measurements that the
    calibration comes from: they would count twice. Warns (`UserWarning`) of some rows that are in both, and where the
    calibration does not say which rows it comes from.
    """
    calibration = calibrated.calibration
    if calibration is None or calibration.covariance is None:
        raise InputError("prior: found no covariance, allowed: a file written by `armcal identify --out`")
    if not same_drawing(calibrated, model.arm):
        raise InputError("prior: a calibration of another drawing, allowed: of the same lengths and frames")
    _check_other_rows(calibration.provenance, measurements)
    values = np.array([calibration.values[name] for name in calibration.parameter_names])
    whole = Earlier(calibration.parameter_names, values, calibration.covariance)
    held = {name: value for name, value in model.fixed.items() if name in calibration.parameter_names}
    # where arm and instrument stand; of a planar arm with a base offset that and the offset of joint 1
    planar = PLANAR_BASE if PLANAR_BASE[0] in model.all_parameters.names else ()
    of_set_up = {
        p.name for p in model.all_parameters if (p.name in planar if model.arm.chain.planar else p.kind in (BASE, TOOL))
    }
    of_both = whole.about((set(model.names) | set(held)) - of_set_up)
    if not set(of_both.names) - set(held):
        raise InputError("prior: no parameter of the model in the calibration, allowed: one of the same arm")
    return of_both.conditioned_on({name: value for name, value in held.items() if name not in of_set_up})


def _check_other_rows(origin: Mapping[str, Any], measurements: Measurements) -> None:
    """Raises `InputError` for measurements that a calibration of this provenance comes from, in any order, for most of
    them and for measurements that have most of its own."""
    hashes = {sha for one in (origin, *origin.get(HELD_FROM, {}).values()) for sha in data_hashes(one)}
    if not hashes.isdisjoint(data_hashes(measurements.provenance)):
        reason = "the calibration was fitted to these very measurements, which would count twice"
        raise InputError(f"prior: {reason}, allowed: new measurements")
    if not isinstance(text := origin.get(ROW_DIGESTS), str):
        why = "the calibration does not say which rows it comes from, as of an earlier version"
        warnings.warn(f"prior: {why}; measurements that are among them would count twice", UserWarning, stacklevel=3)
        return
    shared = rows_shared(text, measurements.postures, measurements.positions)
    share, of_its = (100.0 * part for part in shared)
    rows = (
        f"about {share:.0f} % of these rows ({of_its:.0f} % of the calibration's own) are among those it was fitted to"
    )
    if max(shared) >= MOSTLY:
        raise InputError(f"prior: {rows}, which would count twice, allowed: new measurements")
    if shared.measurements > 0.0:
        warnings.warn(f"prior: {rows}, and count twice", UserWarning, stacklevel=3)


def same_drawing(calibrated: Arm, arm: Arm) -> bool:
    """Whether the errors of two arms mean the same things: equal lengths, joints and frames."""
    same = calibrated.links == arm.links and (calibrated.chain.planar) == (arm.chain.planar)
    same = same and calibrated.joint_types == arm.joint_types and np.allclose(calibrated.lengths, arm.lengths)
    if same and not calibrated.chain.planar and not arm.chain.planar:
        pairs = zip(calibrated.chain.joints, arm.chain.joints, strict=True)
        same = all(np.allclose(a.origin, b.origin) and np.allclose(a.axis, b.axis) for a, b in pairs)
    return bool(same)


def as_calibrated(arm: Arm) -> Arm:
    """The arm with its calibrated geometry as the nominal one; values of effects stay."""
    values = {} if arm.calibration is None else arm.calibration.values
    bare: dict[str, Any] = {"values": of_effects(values), "base": None, "tools": {}, "tool_axes": {}}
    kept = None if arm.calibration is None else replace(arm.calibration, **bare)
    effects = (_composed(spec, arm.chain, values) for spec in arm.effects)
    return replace(arm, chain=corrected(arm.chain, values), calibration=kept).with_effects(*effects)


def _composed(spec: EffectSpec, chain: SpatialChain, values: Mapping[str, float]) -> EffectSpec:
    """An effect whose curve says its geometry as errors of the corrected chain."""
    if spec.curve is None or not spec.curve.geometry:
        return spec
    of_curve = dict(spec.curve.geometry)
    of_curve |= {name: float(x) for name, x in chain.along_base(of_curve, values).items()}
    without = {name: values.get(name, 0.0) - of_curve.get(name, 0.0) for name in {*values, *of_curve}}
    errors = errors_between(corrected(chain, values), corrected(chain, without))
    geometry = {name: -error for name, error in errors.items()} | of_effects(of_curve)
    return replace(spec, curve=replace(spec.curve, geometry=geometry))


def refit_parameters(arm: Arm, measurements: Measurements) -> ParameterSet:
    """Those that a refit may estimate, among others."""
    if arm.chain.planar:
        return Model(with_base_offset(arm)).all_parameters
    chain = with_markers(one_unnamed(arm.chain, measurements), measurements)
    if chain.instrument.own_targets:
        chain = placed_model(Model(replace(arm, chain=chain)), measurements).arm.chain
    return chain.every_parameter


def check_names(chain: SpatialChain, measurements: Measurements) -> None:
    """Raise `InputError` for measured points that a chain does not have, where they are not to be estimated."""
    if chain.instrument.own_targets or len(chain.tools) == 1 == len(measurements.marker_names):
        return  # one point is the one that is measured, whatever the data call it
    fault = "no column marker, and the arm has several measured points" if not measurements.marker_names else ""
    fresh = [repr(name) for name in measurements.marker_names if name not in chain.tools]
    fault = f"unknown name {', '.join(fresh)}" if fresh else fault if len(chain.tools) > 1 else ""
    if fault:
        allowed = f"allowed: {', '.join(chain.tools)}; or --refit base, which finds where they are"
        raise InputError(f"measurements.marker: {fault}, {allowed}")


def fresh_points(chain: SpatialChain, measurements: Measurements) -> list[str]:
    """What is said of measured points that the calibration does not have: they are fitted to these measurements."""
    names = () if chain.instrument.own_targets else measurements.marker_names
    if not names and len(chain.tools) > 1:
        several = "where they are of several, name them in the column marker"
        return [
            f"no column marker: the rows are taken as of one reflector, whose position was fitted to them; {several}"
        ]
    if len(chain.tools) == 1 == len(names) or not (fresh := [name for name in names if name not in chain.tools]):
        return []
    its = "its position was" if len(fresh) == 1 else "their positions were"
    return [f"the calibration has no reflector {', '.join(fresh)}: {its} fitted to these rows"]


def refit_model(arm: Arm, measurements: Measurements, conditions: Conditions, refit: str) -> tuple[Model, Array]:
    """The calibrated arm of which only what is refitted is free (`validate`), and (p,) where it starts."""
    if not arm.chain.planar:
        model = _spatial(arm, measurements, refit)
        return model, model.values
    if refit == "none":
        return Model(arm), np.zeros(0)
    offsets = [f"{JOINT_OFFSET}:{j}" for j in range(2, arm.links + 1)] if refit == "offsets" else []
    values = Model(arm).best_known
    model = Model(with_base_offset(arm), {k: value for k, value in values.items() if k not in (*PLANAR_BASE, *offsets)})
    start = model.parameters.vector(values)
    computed = model.position(measurements.postures, start, conditions)
    return model, start_at_bases(start, model, computed, measurements.positions)


def _spatial(arm: Arm, measurements: Measurements, refit: str) -> Model:
    """Starts at the closed form.

    refit : `base`: base and measured points; `offsets`: those and the offsets of the joints between the first and the
        last, which base and points stand for; `none`: nothing
    """
    arm = as_calibrated(arm)
    if refit == "none":
        check_names(arm.chain, measurements)
        model = Model(replace(arm, chain=with_markers(arm.chain, measurements)))
        free: set[str] = set()
    else:
        chain = replace(one_unnamed(arm.chain, measurements), known=frozenset())
        model = placed_model(Model(replace(arm, chain=chain)), measurements)
        model = replace(model, arm=_of_points(model.arm, chain))
        free = {p.name for p in model.geometry_parameters if p.kind in (BASE, TOOL)}
    if refit == "offsets":
        free |= {f"{JOINT_OFFSET}:{j}" for j in range(2, arm.links)}
    best = model.best_known
    return replace(model, known={name: value for name, value in best.items() if name not in free})


def _of_points(arm: Arm, before: SpatialChain) -> Arm:
    """The arm with the geometry of its curves for the one measured point that data call by another name."""
    if len(arm.chain.tools) != 1 or len(before.tools) != 1:
        return arm
    (old,), (new,) = before.tools, arm.chain.tools
    effects = []
    for spec in arm.effects:
        if spec.curve is not None:
            geometry = {k.replace(f"{TOOL}[{old}]", f"{TOOL}[{new}]"): v for k, v in spec.curve.geometry.items()}
            spec = replace(spec, curve=replace(spec.curve, geometry=geometry))
        effects.append(spec)
    return arm.with_effects(*effects)


def placed_values(chain: SpatialChain, values: Mapping[str, float]) -> dict[str, float]:
    """Where base and measured points are, by the names of their parameters [mm, rad]; other values as they are.

    values : corrections of base and points
    """
    base: Array = composed_base(chain, values)
    placed = dict(zip([f"base.{axis}" for axis in "xyz"], base[:3, 3].tolist(), strict=True))
    placed |= dict(zip([f"base.r{axis}" for axis in "xyz"], own_axes_angles(base[:3, :3]).tolist(), strict=True))
    for name, place in composed_tools(chain, values).items():
        placed |= {f"{TOOL}[{name}].{axis}": float(x) for axis, x in zip("xyz", np.asarray(place), strict=True)}
    for name, axes in composed_axes(chain, values).items():
        placed |= {f"{TOOL}[{name}].r{axis}": float(x) for axis, x in zip("xyz", own_axes_angles(axes), strict=True)}
    return {name: placed.get(name, value) for name, value in values.items()}


HARDLY = 0.1  # of how far a point is moved: a standard deviation that adds hardly anything to it
GAIN = 1.25  # of the sum of squares: a tenth of the RMS error; less is not worth another set of parameters


def renamed_by_session(measurements: Measurements, names: tuple[str, ...]) -> tuple[Measurements, dict[str, str]]:
    """Measurements whose points have names of their own in every session after the first that sees them; and of each
    new name the one that the point has in the data.

    names : of the arm's points, of which the first is measured where the data have no column marker
    """
    marker = measurements.marker
    names_read = np.full(len(measurements), names[0]) if marker is None else np.asarray(marker)
    renamed, old, seen = names_read.astype(object), dict[str, str](), set[str]()
    for session, rows in zip(measurements.sessions, measurements.session_rows, strict=True):
        for name in (here := sorted({*names_read[rows].tolist()} & seen)):
            old[f"{name} of {session}"] = name
            renamed[rows[names_read[rows] == name]] = f"{name} of {session}"
        seen |= {*names_read[rows].tolist()} - {*here}
    return replace(measurements, marker=renamed.astype(str), marker_names=()), old


def with_mounting_doubt(
    together: Identification, measurements: Measurements, fit: Callable[[Measurements], Identification]
) -> Identification:
    """A fit to several sessions, with a doubt where measured points that the sessions share are mounted elsewhere in
    some of them: squares fall significantly, and by more than `GAIN`, where each session has points of its own.

    fit : the same for other measurements
    """
    chain = together.model.arm.chain if hasattr(together.model, "arm") else None
    if chain is None or chain.planar or len(measurements.sessions) < 2:
        return together
    renamed, old = renamed_by_session(measurements, tuple(chain.tools))
    if not old:
        return together
    try:
        apart = fit(renamed)
    except InputError:  # the points are given, or too few rows
        return together
    held, free = (float(np.sum(each.residuals_after**2)) for each in (together, apart))
    freed = len(apart.names) - len(together.names)
    if freed <= 0 or apart.dof < SPARE or not held > GAIN * free:
        return together
    if fdtrc(freed, apart.dof, (held - free) / freed / max(free / apart.dof, np.finfo(float).tiny)) > LEVEL:
        return together
    if not (moved := _moved(apart, old)):
        return together
    which = "; ".join(f"{new.replace(' of ', ' in session ', 1)}: {size} mm away" for new, size in moved.items())
    fall = f"the RMS falls from {together.rms_after:.4g} to {apart.rms_after:.4g} mm where each has a name of its own"
    doubt = f"reflectors are mounted elsewhere than in the session before ({which}): {fall}"
    return replace(together, doubts=(f"{doubt}; name them otherwise there, in the column marker", *together.doubts))


def _moved(apart: Identification, old: dict[str, str]) -> dict[str, str]:
    """How far each point that is moved significantly is from where the session before has it [mm], along the directions
    in which it is: the heights of a SCARA's reflectors, say, are hardly known."""
    chain = apart.model.arm.chain
    places: dict[str, Array] = composed_tools(chain, apart.model.parameters.mapping(apart.parameters))
    index = {name: k for k, name in enumerate(apart.names)}
    distances: dict[str, str] = {}
    for new, name in old.items():
        names = [f"{TOOL}[{each}].{axis}" for each in (new, name) for axis in "xyz"]
        if not {*names} <= {*index}:  # of a minimal set of parameters
            continue
        columns = np.array([index[each] for each in names])
        difference = np.kron([[1.0, -1.0]], np.eye(3))
        covariance = difference @ apart.covariance[np.ix_(columns, columns)] @ difference.T
        variances, axes = np.linalg.eigh(covariance)
        along = axes.T @ (places[new] - places[name])
        statistics = along**2 / np.maximum(variances, np.finfo(float).tiny)
        told = fdtrc(1, apart.dof, statistics) <= LEVEL / (3 * len(old))
        if told.any():
            told |= variances < HARDLY**2 * np.sum(along[told] ** 2)
            distances[new] = f"{'' if told.all() else 'at least '}{np.linalg.norm(along[told]):.3g}"
    return distances
