"""The library effects that a plan could reveal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from doe.problem.problem import InformationModel
from doe.problem.spatial import measuring_every_point, without_prior
from identification.arm import Arm
from identification.arrays import Array
from identification.conditions import BY_ORDER
from identification.gap.detectability import Detectability, detectability
from identification.gap.hypotheses import Hypothesis, hypotheses
from identification.measurements import Conditions, directions_from_order, past_from_order, session_time
from identification.model import Model


@dataclass(frozen=True)
class EffectLibrary:
    """Rival effects: what a plan is to distinguish.

    base : p, parameters of the model that is to be identified; they come first in the models below
    shown_by_postures : the model with every effect that postures alone can show, K parameters more
    bases : per effect (K, s), the combinations of the K scaled parameters that it may take
    weights : (H,) how likely each effect is, in any unit
    jacobian_by_order : postures (m, n) in their order -> (m, d, p + L) scaled sensitivities with the effects that the
        order of measurement shows, as backlash and drift; None: there are none
    preflight : postures (m, n) -> what measuring them could show of every effect; None: not needed
    """

    base: int
    shown_by_postures: InformationModel
    bases: Sequence[Array]
    weights: Array
    jacobian_by_order: Callable[[Array], Array] | None = None
    preflight: Callable[[Array], Detectability] | None = None


def effect_library(arm: Arm) -> EffectLibrary:
    """The effects of the library that an arm can have, besides its own; without the rare ones.

    An effect that acts at every joint alike has one size for all of them: that is what is seen first. A spatial arm has
    a minimal set of parameters, as tests for effects see it.
    """
    arm = without_prior(arm)
    tested = hypotheses(arm, frozenset())
    common = [h for h in tested.unscanned if h.effect.prior == 1.0]
    shown = [h for h in common if not h.effect.needs & BY_ORDER]
    model = Model(arm.with_effects(*arm.effects, *(h.spec for h in shown)))
    base = len(Model(arm).parameters)
    ordered = [h.spec for h in common if h.effect.needs & BY_ORDER]
    return EffectLibrary(
        base,
        measuring_every_point(model),
        tuple(basis_of(model, base, hypothesis) for hypothesis in shown),
        np.array([hypothesis.weight for hypothesis in shown]),
        by_order(Model(arm.with_effects(*arm.effects, *ordered))),
        lambda postures: detectability(arm, postures),
    )


def basis_of(model: Model, base: int, hypothesis: Hypothesis) -> Array:
    """(K, s) the scaled parameters of one effect, all in one column where it acts at every joint alike."""
    columns = [model.parameters.index(parameter.name) - base for parameter in hypothesis.effect.parameters]
    basis = np.zeros((len(model.parameters) - base, len(columns)))
    basis[columns, range(len(columns))] = model.scales[base:][columns]
    return basis.sum(axis=1, keepdims=True) if hypothesis.family else basis


def by_order(model: Model) -> Callable[[Array], Array]:
    """Scaled sensitivities (m, d, p) of a model to postures (m, n) that are measured in their order."""

    def jacobian(postures: Array) -> Array:
        time = session_time(np.arange(len(postures), dtype=float))
        past = past_from_order(postures) if model.remembers else None
        conditions = Conditions(time=time, directions=directions_from_order(postures), past=past)
        points = len(model.arm.chain.tools)
        each = (replace(conditions, marker=np.full(len(postures), k)) for k in range(points))
        return np.concatenate([model.jacobian(postures, conditions=at) for at in each], axis=1) / model.scales

    return jacobian
