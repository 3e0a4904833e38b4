"""What the model of any arm may lack, as blocks with normal priors: effects, error curves, an error of each posture
(identification/README.md, "With a prior"). The waves for a ripple of unknown order stand for the error curve, too.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.effects import effect_named
from identification.errors import InputError
from identification.estimation.problem import Prior
from identification.gap.blocks import RIPPLE, RIPPLE_ORDER, hypotheses, slope_by_angle
from identification.measurements import BY_ORDER, FOLLOWING, Measurements
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
    def sentence(self) -> str:
        """Description of the prior for people."""
        kinds = dict.fromkeys(spec.name for spec in self.added)
        return f"with a prior of typical sizes: {len(self.prior.deviations)} parameters of {', '.join(kinds)}"

    def to_json(self) -> dict[str, Any]:
        """Key `prior` of `identify` (identification/files/README.md, "JSON keys")."""
        return {
            "parameters": len(self.prior.deviations),
            "effects": list(dict.fromkeys(spec.key for spec in self.added)),
            "left_out": dict(self.left_out),
        }


def library_prior(
    arm: Arm, rows: Measurements | None = None, names: Sequence[str] | None = None, fastest: float = np.inf
) -> LibraryPrior:
    """A prior on all effects of the library that the arm may have and that rows can show.

    rows : measurements; None: any without an order and a temperature
    names : of effects, of which alone the arm may have some; None: all, error curves, and the posture's own error
    fastest : order of the fastest wave that is added

    Raises `InputError` for names that are not in the library, or if no effect remains.
    """
    for name in names or ():
        effect_named(name)  # raises for an unknown one
    conditions = frozenset[str]()  # conditions that the rows have
    if rows is not None:  # time, directions and past follow from their order if that has no gaps
        conditions = BY_ORDER if rows.conditions.follow else BY_ORDER - FOLLOWING
        conditions |= {"temperature"} if rows.temperature is not None else set()
    every = hypotheses(arm, conditions)
    left_out = {key: why for key, why in every.skipped.items() if names is None or key.partition(":")[0] in names}
    with_curve = {spec.joint for spec in arm.effects if spec.curve is not None}
    effects = [b.effect for b in every.members if b.effect]
    settings = Counter(effect.spec.key for effect in effects)
    whole = {effect.name for effect in effects if effect.joint is None}  # then not at single joints besides
    stiffer = np.ones(arm.links)
    if arm.gravity is not None:  # gears and bearings are as stiff as what they carry, of the stretched arm, asks for
        masses = np.cumsum([arm.gravity.payload, *arm.gravity.link_masses[::-1]])[:0:-1]  # [kg] beyond each joint
        torques = np.linalg.norm(arm.gravity.acceleration) * masses * arm.chain.levers / 1000.0
        # convention: typical compliances are of joints that carry up to 1,000 N m; an RV gear for 3,000 N m has 3e-7
        # rad/(N m), and what is around it gives way, too
        stiffer = 1000.0 / np.maximum(torques, 1000.0)
    added, deviations, faster = list[EffectSpec](), list[float](), np.zeros(arm.links)
    for effect, key in ((effect, effect.spec.key) for effect in effects):
        wanted = effect.prior == 1.0 if names is None else effect.name in names  # the rare ones only by name
        if not wanted or (effect.joint is not None and effect.name in whole):
            continue
        if missing := sorted((effect.needs - conditions) & {"time", "directions", "past", "temperature"}):
            left_out[key] = f"needs {', '.join(missing)}"
        elif any(p.typical is None for p in effect.parameters):
            left_out[key] = "no typical size"
        elif effect.joint in with_curve and slope_by_angle(effect, (effect.joint or 0) - 1, every.base):
            left_out[key] = "its joint has an error curve"
        else:
            wave = effect.chosen[RIPPLE_ORDER] if effect.name == RIPPLE else 0.0
            # [rad] of an error curve's wave once per turn, as `a` and `b`: a typical compliance under 100 N m
            curve, share = 1e-3 / wave if wave and names is None else 0.0, np.sqrt(effect.prior / settings[key])
            each = [float(np.hypot((p.typical or 0.0) * share, curve)) for p in effect.parameters]
            for k, p in enumerate(effect.parameters, start=1):
                each[k - 1] *= stiffer[(effect.joint or k) - 1] if p.unit == "rad/(N m)" else 1.0
            if wave > fastest:
                faster[effect.joint_index] += each[0] ** 2
            else:
                added.append(effect.spec)
                deviations += each
    if not added and not faster.any():
        reasons = f" ({', '.join(f'{key} {why}' for key, why in left_out.items())})" if left_out else ""
        raise InputError(f"effects: none of the library's is left for the prior{reasons}, allowed: at least one")
    wide = arm.with_effects(*arm.effects, *added)
    if arm.calibration is not None:  # its values follow the new names of its parameters
        renamed = every.renamed(Model(wide))
        values = {renamed.get(name, name): value for name, value in arm.calibration.values.items()}
        wide = replace(wide, calibration=replace(arm.calibration, values=values, parameter_names=(), covariance=None))
    parameters = [p.name for effect in Model(wide).effects[len(every.base.effects) :] for p in effect.parameters]
    # a posture's own error, in one coordinate; calibrated robots keep 1e-4 of the reach in three coordinates
    own_error = 6e-5 * arm.reach if names is None else 0.0
    sizes = dict(zip(parameters, deviations, strict=True))
    prior = Prior(sizes, own_error=own_error, factors=(1.0, 4.0, 2.0, 0.5, 0.25, 0.125))
    return LibraryPrior(wide, tuple(added), prior, MappingProxyType(left_out), faster)
