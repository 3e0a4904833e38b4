"""Reusing a calibration: only some of its parameters are estimated again, or all of them with it as the prior.

The tracker moved, a motor was changed, a year went by: most of what was found still holds.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtrc

from identification.arm import Arm, Calibration
from identification.errors import InputError, nearest
from identification.estimation import Identification, estimate
from identification.estimation.plausibility import FALL, OTHER_FRAME, SPARE
from identification.estimation.prior import Earlier
from identification.estimation.uncertainty import LEVEL
from identification.kinematics.joint_range import joint_range, range_of
from identification.kinematics.parameters import EFFECT, JOINT_OFFSET, LENGTH_ERROR, REVOLUTE
from identification.kinematics.spatial import BASE, ROTATION_ERROR, TOOL, TRANSLATION_ERROR
from identification.kinematics.turns import TURN
from identification.measurements import Measurements
from identification.model import Model
from identification.model.placed import with_markers
from identification.row_digests import ROW_DIGESTS, rows_shared, union
from identification.sessions import BASE as PLANAR_BASE
from identification.sessions import SESSIONS, with_base
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
