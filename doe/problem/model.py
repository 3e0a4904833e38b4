"""What a design needs of a model, and what a model may offer besides. Nothing else of any model is known in `doe`.

A model is a function of a posture and of p parameters that gives d measured coordinates. `DesignModel` is all that
`solve`, `relax`, `score` and `advise` ask for; tests/doe/problem/test_problem.py has one of ten lines that is no robot.
`Offers` are members that only some questions need. The model of an arm has them all (`identification.for_design`).

n joints, m postures; mm and rad, or whatever units the parameters say.
"""

from collections.abc import Mapping
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification import Array, InputError, ParameterSet, require


class DesignModel(Protocol):
    """Nine members, of any dimension and in any units.

    parameters : the p to identify: names, units, and scales, by which the columns of the Jacobian are divided; and
        kinds, `effect` for what may be missing in the model and anything else for its geometry
    values : (p,) their best known values, at which the Jacobian is taken
    dimension : d, measured coordinates per posture, whose errors are independent and of one size
    joint_types : (n) `revolute`, position in rad, or `prismatic`, in mm;  lower, upper : (n,) joint positions
    sigma : standard deviation of a measured coordinate [its unit], None: not known
    prior : parameter name -> standard deviation of what is known of it beforehand [its unit]; of the others nothing
    """

    parameters: ParameterSet
    values: Array
    dimension: int
    joint_types: tuple[str, ...]
    lower: Array
    upper: Array
    sigma: float | None
    prior: Mapping[str, float]

    def symbolic_position(self, q: ca.SX, p: ca.SX) -> ca.SX:
        """(d,) the coordinates at a posture q (n,) and parameters p (p,), twice differentiable almost everywhere."""
        ...


class Offers(Protocol):
    """What a model may offer besides, each by itself.

    Geometry, for constraints
        constraints : of `identification.workspace`;  space : coordinates of a point, 2 or 3;  reach : [mm]
        symbolic_points : q (n,) -> points (space,) of base and joints [mm], those that are measured, of which the first
            is the tip, and the axes (3, 3) of the tip
        cell : `identification.workspace.Cell`, None: no body is known;  joint_axes : (n, 3) each in its frame
        joint_frames : (m, n) -> (m, n + 2, 4, 4) of base, joints and measured point [mm], in that of the base
        other_points : (k, 3) [mm] from the tip to other points that are measured at each posture, in the same frame
    What is settled before a plan is made
        placed : -> the model as plans are made for it: what it leaves open is assumed, with a warning
        tied : whether some postures only can be measured, as those where a probe touches a surface
        tied_postures : limits (n,) twice, (n,) what counts as a radian, which (m, n) are feasible -> (N, n) of these
        plan_columns : (m, n) -> columns of names that a plan file has besides its postures
    Accuracy where the arm will work
        tip_jacobian : (k, n) -> (k, P, c, p) derivative of the positions of P points [mm]; else what is measured
    Models that may be wrong
        complete : whether nothing is missing in the model
        missing_effects : names or None, order of the fastest wave -> what the model may lack, for `with_effects`
        with_effects : that -> the model with it, (name -> standard deviation) of its parameters, and a function: the
            mean square of the tip's distance at postures (k, n) that no plan can lower [mm^2]
        rival_effects : -> the fields of `doe.discrimination.design.EffectLibrary`
    Theory
        planar : a chain of links in a plane: Table I of the paper
        theorem_joints : joints (from 0) in the planar theorem, all but the first, which a base offset adds; None: it
            does not hold
    """

    def __getattr__(self, name: str) -> Any: ...


PRISMATIC = "prismatic"  # the joint type whose position is a length
NEEDS_SIGMA = (  # the end of a sentence
    "needs the instrument's scatter: add the line [measurement] to the arm file and below it sigma_mm = 0.05, "
    "or whatever the standard deviation of one coordinate is [mm]"
)
REQUIRED = (*DesignModel.__annotations__, "symbolic_position")


def turns(model: DesignModel) -> NDArray[np.bool_]:
    """(n,) True for joints that turn: their positions are angles [rad], of the others lengths [mm]."""
    return np.array([kind != PRISMATIC for kind in model.joint_types])


def joint_units(model: DesignModel) -> Array:
    """(n,) what counts as one radian of each joint, where joints are compared: distances, steps, tolerances.

    1 rad of a revolute joint; of a prismatic one [mm] such that its range counts as one turn.
    """
    return np.where(turns(model), 1.0, (model.upper - model.lower) / (2.0 * np.pi))


def check_model(model: Any) -> None:
    """Raises `InputError`, which names the first member of `DesignModel` that a model lacks, or whose size is wrong."""
    for name in REQUIRED:
        allowed = f"one with {name} and all of doe.problem.model.DesignModel, such as Model(arm)"
        require(hasattr(model, name), f"model: {type(model).__name__}, allowed: {allowed}")
    n, p = len(model.joint_types), len(model.parameters)
    for name, size in {"values": p, "lower": n, "upper": n}.items():
        array = np.asarray(getattr(model, name), dtype=float)
        if array.shape != (size,) or not np.all(np.isfinite(array)):
            wrong = "not finite" if array.shape == (size,) else f"shape {array.shape}"
            raise InputError(f"model: {name} is {wrong}, allowed: ({size},) finite numbers")


def offers(model: object, name: str) -> bool:
    """Whether a model has a member of `Offers`, and one that is not None."""
    return getattr(model, name, None) is not None


def offered(model: object, name: str, question: str) -> Any:
    """A member of `Offers` that a question needs, which is the first word of the message. Raises `InputError`."""
    if not hasattr(model, name):
        raise InputError(f"{question}: {type(model).__name__} has no {name}, allowed: a model with it, as of an arm")
    return getattr(model, name)
