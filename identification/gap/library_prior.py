"""What may be missing in the model of any arm, as normal blocks: effects, error curves, the posture's own error.

Which effects are missing in the model of a real arm is unknown, but their typical sizes are not
(identification/README.md, "Typical sizes"). Each parameter is normal with zero mean and its typical size as standard
deviation, times the root of the share of arms that have the effect (`Effect.prior`). An effect with an unknown setting
is represented by its K settings, with 1/K of the variance each: the mean and covariance of the tip are those of one
effect with a random setting.

Beyond what has a name every joint has an error curve, a Gaussian process of its angle: waves of all orders k with
standard deviations that fall as 1/k, as those of a random walk do. With a ripple of unknown order this is one process,
whose covariance at two angles is the sum over orders of v_k cos(k (q - q')): the waves of the ripple carry both. And a
posture has an error of its own, that no other posture tells anything about.
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
from identification.arrays import Array
from identification.conditions import BY_ORDER, FOLLOWING
from identification.effects import Effect, library, unknown_effect
from identification.effects.chain import contribution
from identification.errors import InputError
from identification.estimation.problem import Prior
from identification.gap.hypotheses import EFFECT, ORDER, Hypothesis, hypotheses
from identification.measurements import Measurements
from identification.model import Model


@dataclass(frozen=True)
class LibraryPrior:
    """An arm with the effects of the library added to its own, and the prior of their parameters.

    arm : with all effects, those `added` last;  prior : of the parameters of `added`
    left_out : effect -> why it was not added
    faster : (n,) variance of each joint's angle [rad^2] by waves above the fastest that is added
    """

    arm: Arm
    added: tuple[EffectSpec, ...]
    prior: Prior
    left_out: Mapping[str, str]
    faster: Array

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
        return f"with a prior of typical sizes: {len(self.prior.deviations)} parameters of {', '.join(kinds)}"

    def to_json(self) -> dict[str, Any]:
        """Key `prior` of `identify` (identification/files/README.md, "JSON keys")."""
        return {
            "parameters": len(self.prior.deviations),
            "effects": self.effects,
            "left_out": dict(self.left_out),
        }


def library_prior(
    arm: Arm,
    given: frozenset[str] = frozenset(),
    names: Sequence[str] | None = None,
    fastest: float = np.inf,
) -> LibraryPrior:
    """A prior on all effects of the library that the arm may have and that rows with the data `given` can show.

    given : those of `time`, `directions`, `past`, `temperature` that the rows have
    names : of effects, of which alone the arm may have some; None: all, error curves, and the posture's own error
    fastest : order of the fastest wave that is added

    Raises `InputError` for names that are not in the library, or if no effect remains.
    """
    for name in names or ():
        if name not in library():
            raise unknown_effect(name)
    every = hypotheses(arm, given)
    left_out = {key: why for key, why in every.skipped.items() if names is None or key.partition(":")[0] in names}
    with_curve = {spec.joint for spec in arm.effects if spec.curve is not None}
    whole = {h.effect.name for h in every.members if h.effect.joint is None}  # then not at single joints besides
    chosen: list[Hypothesis] = []
    for hypothesis in every.members:
        effect = hypothesis.effect
        if effect.joint is not None and effect.name in whole:
            continue
        if effect.prior < 1.0 if names is None else effect.name not in names:
            continue  # the rare ones only by name
        if missing := sorted((effect.needs - given) & {"time", "directions", "past", "temperature"}):
            left_out[hypothesis.key] = f"needs {', '.join(missing)}"
        elif any(p.typical is None for p in effect.parameters):
            left_out[hypothesis.key] = "no typical size"
        elif effect.joint in with_curve and is_function_of(effect, (effect.joint or 0) - 1, every.base):
            left_out[hypothesis.key] = "its joint has an error curve"
        else:
            chosen.append(hypothesis)
    if not chosen:
        raise InputError("effects: none of the library's is left for the prior, allowed: at least one")
    settings = Counter(h.key for h in chosen)

    def deviation(hypothesis: Hypothesis, typical: float) -> float:
        curve = 0.0
        if names is None and hypothesis.effect.name == EFFECT:
            # [rad] of an error curve's wave once per turn, as `a` and `b`: a typical compliance under 100 N m
            curve = 1e-3 / hypothesis.effect.chosen[ORDER]
        return float(np.hypot(typical * np.sqrt(hypothesis.effect.prior / settings[hypothesis.key]), curve))

    added, faster = [], np.zeros(arm.links)
    for hypothesis in chosen:
        effect = hypothesis.effect
        if effect.name == EFFECT and effect.chosen[ORDER] > fastest:
            faster[(effect.joint or 0) - 1] += deviation(hypothesis, effect.parameters[0].typical or 0.0) ** 2
        else:
            added.append(hypothesis)
    wide = arm.with_effects(*arm.effects, *(h.spec for h in added))
    if arm.calibration is not None:  # its values follow the new names of its parameters
        before, after = ([p.name for effect in Model(one).effects for p in effect.parameters] for one in (arm, wide))
        renamed = dict(zip(before, after, strict=False))
        values = {renamed.get(name, name): value for name, value in arm.calibration.values.items()}
        calibration = replace(arm.calibration, values=values, parameter_names=(), covariance=None)
        wide = replace(wide, calibration=calibration)
    effects = Model(wide).effects[-len(added) :]
    pairs = [(p, h) for e, h in zip(effects, added, strict=True) for p in e.parameters]
    deviations = {p.name: deviation(h, p.typical or 0.0) for p, h in pairs}
    # a posture's own error, in one coordinate; calibrated robots keep 1e-4 of the reach in three coordinates
    prior = Prior(deviations, own_error=6e-5 * arm.reach if names is None else 0.0)
    return LibraryPrior(wide, tuple(h.spec for h in added), prior, MappingProxyType(left_out), faster)


def given_by(measurements: Measurements) -> frozenset[str]:
    """Conditions that the rows have: time, directions and past follow from their order if that has no gaps."""
    given = BY_ORDER if measurements.conditions.follow else BY_ORDER - FOLLOWING
    return given | ({"temperature"} if measurements.temperature is not None else set())


def is_function_of(effect: Effect, joint: int, model: Model) -> bool:
    """Whether an effect adds to the angle of a joint (from 0) a function of that angle alone."""
    if effect.joint != joint + 1 or not hasattr(effect, "joint_angles"):
        return False
    q, c, _, _ = model.symbols
    values = ca.SX.sym("v", len(effect.parameters))
    angle = contribution(effect, "joint_angles", model.chain_at(q, c), values)[joint]
    others = ca.vertcat(*(q[k] for k in range(model.joints) if k != joint), c)
    return bool(ca.depends_on(angle, q[joint])) and not bool(ca.depends_on(angle, others))
