"""Assumptions of a design for a spatial arm: which parameters it is for, and where the measured points are.

More errors are possible in a chain than measurements distinguish. With a sigma each is held by the prior of its
machining, as `identify` holds it, and the criterion is that of the posterior; without one the design is for a minimal
set. A measured point that the arm does not know is assumed beside the last axis, since on it the last joint shows
nothing. The base stays where the arm has it, at the origin where it is not known: no criterion that a change of frame
does not matter to depends on it.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from doe.problem.derived_model import DerivedModel
from doe.problem.spatial_constraints import circle_across
from identification.arm import Arm
from identification.conditions import Conditions
from identification.errors import InputError
from identification.kinematics.frames import pose
from identification.kinematics.parameters import ParameterSet
from identification.kinematics.spatial import BASE, TOOL, SpatialChain
from identification.model import Model
from identification.model.minimal import PRACTICAL, minimal

if TYPE_CHECKING:
    from doe.problem.problem import InformationModel

# every plan in space says this, in words and as the key `collisions_checked`, until collisions are looked at
COLLISIONS = (
    "Collisions were not looked at, neither of the arm with itself nor with what is around it: try each posture "
    "slowly, or let armcal design --candidates FILE choose from postures that you allow."
)
AHEAD = 0.5  # of the reach: where the center of measured distances is assumed
OFF_AXIS = 100.0  # [mm] of a measured point that is not known: beside the flange of most arms


@dataclass(frozen=True)
class EveryPoint(DerivedModel):
    """All measured points of a spatial arm at every posture: d is three times their number."""

    model: Model

    @property
    def parameters(self) -> ParameterSet:
        """The parameters of the model."""
        return self.model.parameters

    @property
    def points(self) -> int:
        """Number of measured points."""
        chain = self.model.arm.chain
        return len(chain.tools)

    @property
    def dimension(self) -> int:
        """d, three for each point."""
        return self.model.dimension * self.points

    @cached_property
    def jacobian_function(self) -> ca.Function:
        """CasADi (q, c, p) -> positions (d) and Jacobian (d, p), point by point."""
        inner = self.model.jacobian_function
        q, c, p = (ca.SX.sym(name, inner.size1_in(k)) for k, name in enumerate("qcp"))
        place, each = Conditions.columns(self.model.joints, self.model.remembers), []
        for point in range(self.points):
            conditions = ca.SX(c)
            conditions[place] = point
            each.append(inner(q, conditions, p))
        outputs = [ca.vertcat(*parts) for parts in zip(*each, strict=True)]
        return ca.Function("every_point", [q, c, p], ca.cse(outputs))


def designed(model: Model) -> tuple[Model, InformationModel, Mapping[str, float]]:
    """The model with its measured points in place, the same with all of them, and what is known of its parameters.

    Planar models stay as they are. Raises `InputError` for contacts with a surface whose place is not known. Warns
    (`UserWarning`) of points that are assumed.
    """
    if model.arm.chain.planar:
        return model, model, {}
    placed = replace(model, arm=replace(model.arm, chain=with_points(model.arm.chain, contacts=True)))
    if model.sigma is None and model.prior:
        placed = minimal(placed)
    return placed, measuring_every_point(placed), placed.prior


def measuring_every_point(model: Model) -> InformationModel:
    """The model of an arm with all of its measured points at every posture."""
    several = len(model.arm.chain.tools) > 1
    return EveryPoint(model) if several else model


def arm_model_of(model: InformationModel) -> Model | None:
    """The reverse of `measuring_every_point`; None for a model of anything but one arm."""
    inner = model.model if isinstance(model, EveryPoint) else model
    return inner if isinstance(inner, Model) else None


def without_prior(arm: Arm) -> Arm:
    """An arm with its measured points in place and a minimal set of parameters, as tests for effects see it."""
    if arm.chain.planar:
        return arm
    return minimal(Model(replace(arm, chain=with_points(arm.chain))), PRACTICAL).arm


def refuse_contacts(chain: SpatialChain | None) -> None:
    """Raises `InputError` for a chain whose probe touches a surface, where postures have to be free."""
    if chain is not None and chain.instrument.contact:
        reason = f"kind {chain.instrument.kind}: where a surface is touched follows from the arm"
        raise InputError(f"instrument: found {reason}, allowed here: distance, or no [instrument]")


def with_center(chain: SpatialChain, contacts: bool = False) -> SpatialChain:
    """The chain with the center of measured distances where the arm says, or before it; any other chain as it is.

    contacts : whether they can be planned, at postures that touch. Raises `InputError` where not, and where the surface
    has no place.
    """
    if chain.instrument.reads_positions:
        return chain
    stands = BASE in chain.known or not np.array_equal(chain.base, np.eye(4))
    if not contacts:
        refuse_contacts(chain)
    if chain.instrument.contact and not stands:
        reason = f"kind {chain.instrument.kind} without center_mm: where it is touched is not known"
        how = " and ".join(sorted(chain.instrument.keys & {"center_mm", "normal"}))
        raise InputError(f"instrument: found {reason}, allowed for plans: with {how}, or a calibrated arm")
    if stands:
        return chain
    away = AHEAD * chain.reach
    assumed = f"{away:.0f} mm before the base, on its x axis, is assumed; give instrument.center_mm"
    warnings.warn(f"instrument: the center is not known, {assumed}", stacklevel=2)
    return replace(chain, base=pose([-away, 0.0, 0.0]))


def with_points(chain: SpatialChain, contacts: bool = False) -> SpatialChain:
    """The chain with the measured points that it does not know beside the last axis, evenly around it, and a center of
    distances `with_center`."""
    chain = with_center(chain, contacts)
    names = [name for name, place in chain.tools.items() if not np.any(place)]
    if TOOL in chain.known or not names:
        return chain
    beside = ", ".join(names) if len(chain.tools) > 1 else "the measured point"
    warnings.warn(f"tool: {beside} is not known, {OFF_AXIS:g} mm beside the last axis is assumed", stacklevel=2)
    axis = chain.end[:3, :3].T @ chain.joints[-1].axis
    across, other = circle_across(axis)
    turns = 2.0 * np.pi * np.arange(len(names)) / len(names)
    places = OFF_AXIS * (np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * other)
    return replace(chain, tools={**chain.tools, **dict(zip(names, places, strict=True))})
