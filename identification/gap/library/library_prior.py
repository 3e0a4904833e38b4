"""A normal prior on all effects of the library, with typical sizes as standard deviations.

Which effects are missing in the model of a real arm is unknown, but their typical sizes are not
(identification/README.md, "Typical sizes"). Each parameter is normal with zero mean and its typical size as standard
deviation. An effect with an unknown setting (the order of a ripple) is represented by K effects, one for each setting,
with 1/K of the variance each: the mean and covariance of the tip are those of one effect with a random setting.
Likewise the variance of an effect that few arms have is multiplied by its `Effect.prior`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from identification.arm import Arm, EffectSpec
from identification.conditions import BY_ORDER, FOLLOWING
from identification.effects import Effect, library, unknown_effect
from identification.errors import InputError
from identification.estimation.prior import Prior
from identification.gap.hypotheses import Hypothesis, HypothesisSet, hypotheses
from identification.measurements import Measurements
from identification.model import Model


@dataclass(frozen=True)
class LibraryPrior:
    """An arm with the effects of the library added to its own, and the prior of their parameters.

    arm : with all effects, those `added` last;  prior : of the parameters of `added`
    left_out : effect -> why it was not added
    together : how many settings of an effect the fit took to be there at once
    """

    arm: Arm
    added: tuple[EffectSpec, ...]
    prior: Prior
    left_out: Mapping[str, str]
    together: float = 1.0

    @property
    def model(self) -> Model:
        """The arm's model with all effects."""
        return Model(self.arm)

    @property
    def effects(self) -> list[str]:
        """Keys of the added effects, `name` or `name:joint`."""
        return list(dict.fromkeys(spec.key for spec in self.added))

    @property
    def sentence(self) -> str:
        """Description of the prior for people."""
        kinds = dict.fromkeys(spec.name for spec in self.added)
        found = f"with a prior of typical sizes: {len(self.prior.deviations)} parameters of {', '.join(kinds)}"
        if self.together == 1.0:
            return found
        several = dict.fromkeys(key.partition(".")[0].partition(":")[0] for key in self.prior.alternatives)
        return f"{found}; as of {self.together:g} waves at once in each joint ({', '.join(several)}), likelier than one"

    def to_json(self) -> dict[str, Any]:
        """Key `prior` of `identify` (identification/files/README.md, "JSON keys")."""
        found = {"parameters": len(self.prior.deviations), "effects": self.effects, "left_out": dict(self.left_out)}
        return found | {"together": self.together}


def library_prior(
    arm: Arm,
    given: frozenset[str] = frozenset(),
    names: Sequence[str] | None = None,
    most_settings: int | None = None,
) -> LibraryPrior:
    """A prior on all effects of the library that the arm may have and that rows with the data `given` can show.

    given : those of `time`, `directions`, `past`, `temperature` that the rows have;  names : of effects, None: all
    most_settings : maximum number of settings of one effect at one joint, taken evenly from a longer scan; None: all

    Raises `InputError` for names that are not in the library, or if no effect remains.
    """
    for name in names or ():
        if name not in library():
            raise unknown_effect(name)
    known = hypotheses(arm, given)
    left_out = {key: why for key, why in known.skipped.items() if names is None or key.partition(":")[0] in names}
    curved = _curved(known)
    chosen: list[Hypothesis] = []
    for hypothesis in _once(known.members):
        if hypothesis.effect.prior < 1.0 if names is None else hypothesis.effect.name not in names:
            continue  # the rare ones only by name
        if reason := _why_not(hypothesis.effect, given) or curved.get(hypothesis.key):
            left_out[hypothesis.key] = reason
        else:
            chosen.append(hypothesis)
    if not chosen:
        raise InputError("effects: none of the library's is left for the prior, allowed: at least one")
    kept = _thinned(chosen, most_settings)
    wide = _extended(arm, kept)
    prior, added = _prior(Model(wide).effects, kept), tuple(h.spec for h in kept)
    return LibraryPrior(wide, added, prior, MappingProxyType(left_out))


def given_by(measurements: Measurements) -> frozenset[str]:
    """Conditions that the rows have: time, directions and past follow from their order if that has no gaps."""
    given = BY_ORDER if measurements.conditions.follow else BY_ORDER - FOLLOWING
    return given | ({"temperature"} if measurements.temperature is not None else set())


def _once(members: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses, without those at single joints of an effect that is also given for all joints."""
    whole = {h.effect.name for h in members if h.effect.joint is None}
    return [h for h in members if h.effect.joint is None or h.effect.name not in whole]


def _why_not(effect: Effect, given: frozenset[str]) -> str | None:
    missing = sorted((effect.needs - given) & {"time", "directions", "past", "temperature"})
    if missing:
        return f"needs {', '.join(missing)}"
    return "no typical size" if any(p.typical is None for p in effect.parameters) else None


def _curved(known: HypothesisSet) -> dict[str, str]:
    """Key -> reason for effects that are functions of the angle of a joint with an error curve."""
    joints = {spec.joint for spec in known.arm.effects if spec.curve is not None}
    there = {h.key: h.effect for h in known.members if h.effect.joint in joints}
    functions = (key for key, e in there.items() if is_function_of(e, (e.joint or 0) - 1, known.base))
    return dict.fromkeys(functions, "its joint has an error curve")


def is_function_of(effect: Effect, joint: int, model: Model) -> bool:
    """Whether an effect adds to the angle of a joint (from 0) a function of that angle alone."""
    if effect.joint != joint + 1 or type(effect).joint_angles is Effect.joint_angles:
        return False
    q, c, _, _ = model.symbols
    angle = ca.SX(effect.joint_angles(model.expressions.chain(q, c), ca.SX.sym("v", len(effect.parameters))))[joint]
    others = ca.vertcat(*(q[k] for k in range(model.joints) if k != joint), c)
    return bool(ca.depends_on(angle, q[joint])) and not bool(ca.depends_on(angle, others))


def _thinned(members: Sequence[Hypothesis], most: int | None) -> list[Hypothesis]:
    """At most `most` settings of each effect at each joint, evenly spaced within its scan."""
    groups: dict[str, list[Hypothesis]] = {}
    for hypothesis in members:
        groups.setdefault(hypothesis.key, []).append(hypothesis)
    kept: list[Hypothesis] = []
    for group in groups.values():
        count = len(group) if most is None else min(most, len(group))
        kept += [group[int((k + 0.5) * len(group) / count)] for k in range(count)]
    return kept


def _extended(arm: Arm, added: Sequence[Hypothesis]) -> Arm:
    """The arm with these effects added; its calibrated values follow the new names of its parameters."""
    wide = arm.with_effects(*arm.effects, *(h.spec for h in added))
    if arm.calibration is None:
        return wide
    own = [p.name for effect in Model(arm).effects for p in effect.parameters]
    longer = [p.name for effect in Model(wide).effects for p in effect.parameters]
    names = dict(zip(own, longer, strict=False))
    values = {names.get(name, name): value for name, value in arm.calibration.values.items()}
    return replace(wide, calibration=replace(arm.calibration, values=values, parameter_names=(), covariance=None))


def _prior(effects: Sequence[Effect], added: Sequence[Hypothesis]) -> Prior:
    """Standard deviations by parameter [API units]; `effects` end with those `added`."""
    alike = Counter(h.key for h in added)
    pairs = zip(effects[len(effects) - len(added) :], added, strict=True)
    each = [(p, e, alike[h.key]) for e, h in pairs for p in e.parameters if p.typical is not None]
    deviations = {p.name: float((p.typical or 0.0) * np.sqrt(e.prior / k)) for p, e, k in each}
    return Prior(deviations, alternatives={p.name: k for p, _, k in each if k > 1})
