"""What a design needs of a model, and what a model may offer besides. Nothing else of any model is known in `doe`.

A model is a function of a posture and of p parameters that gives d measured coordinates. `DesignModel` is all that
`solve`, `relax`, `score` and `advise` ask for; tests/doe/problem/test_model.py has one of ten lines that is no robot.
`Offers` are members that only some questions need. The model of an arm has them all (`identification.for_design`).

n joints, m postures; mm and rad, or whatever units the parameters say.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification import Array, InputError, ParameterSet


class DesignModel(Protocol):
    """Nine members, of any dimension and in any units."""

    @property
    def parameters(self) -> ParameterSet:
        """The p parameters to identify: names, units, and scales, by which the columns of the Jacobian are divided; and
        kinds, `effect` for what may be missing in the model and anything else for its geometry."""
        ...

    @property
    def values(self) -> Array:
        """(p,) their best known values, at which the Jacobian is taken."""
        ...

    @property
    def dimension(self) -> int:
        """d, measured coordinates per posture, whose errors are independent and of one size."""
        ...

    @property
    def joint_types(self) -> tuple[str, ...]:
        """(n) `revolute`, position in rad, or `prismatic`, in mm."""
        ...

    @property
    def lower(self) -> Array:
        """(n,) smallest joint positions."""
        ...

    @property
    def upper(self) -> Array:
        """(n,) largest joint positions."""
        ...

    @property
    def sigma(self) -> float | None:
        """Standard deviation of a measured coordinate [its unit], None: not known."""
        ...

    @property
    def prior(self) -> Mapping[str, float]:
        """Parameter name -> standard deviation of what is known of it beforehand [its unit]; of the others nothing."""
        ...

    def symbolic_position(self, q: ca.SX, p: ca.SX) -> ca.SX:
        """(d,) the coordinates at a posture q (n,) and parameters p (p,), twice differentiable almost everywhere."""
        ...


class Offers(Protocol):
    """What a model may offer besides, each by itself."""

    # -- geometry, for constraints -------------------------------------------------------------------------------------
    constraints: Sequence[Any]  # of `identification.workspace`
    joint_types: tuple[str, ...]  # as of `DesignModel`
    space: int  # coordinates of a point, 2 or 3
    reach: float  # [mm]

    def symbolic_points(self, q: ca.SX) -> list[ca.SX]:
        """k points (space,), base, joints and tip [mm], at one posture q (n,)."""
        ...

    def with_tip_moved(self, offset: Array) -> Any:
        """The model whose tip is moved by (3,) [mm] in its own frame: where a reflector looks."""
        ...

    # -- what is settled before a plan is made -------------------------------------------------------------------------
    def placed(self) -> Any:
        """The model as plans are made for it: what it leaves open is assumed, with a warning."""
        ...

    tied: bool  # whether some postures only can be measured, as those where a probe touches a surface

    def tied_postures(
        self, lower: Array, upper: Array, units: Array, feasible: Callable[[Array], NDArray[Any]]
    ) -> Array:
        """(N, n) of these, to choose from, within limits (n,) and `feasible`;  units : (n,) that count as a radian."""
        ...

    def plan_columns(self, postures: Array) -> Mapping[str, Sequence[str]]:
        """Columns of names that a plan file has besides postures (m, n)."""
        ...

    # -- accuracy where the arm will work ------------------------------------------------------------------------------
    def tip_jacobian(self, postures: ArrayLike) -> Array:
        """(k, P, c, p) derivative of the positions of P points [mm], their x, y and z first; else what is measured."""
        ...

    # -- designs for models that may be wrong --------------------------------------------------------------------------
    covariance: Array | None  # (p, p) of the values, None: not known
    machining: tuple[float, float, float]  # usual errors of lengths [mm] and angles [rad], and a usual lever [mm]
    complete: bool  # whether nothing is missing in the model

    def missing_effects(self, names: Sequence[str] | None, fastest: float) -> Any:
        """What the model may lack; what that is, is between this and `with_effects`."""
        ...

    def with_effects(self, missing: Any) -> tuple[Any, Mapping[str, float], Callable[[Array], float]]:
        """The model with it, (name -> standard deviation) of its parameters, and the mean square of the tip's distance
        at postures (k, n) [mm^2] that no plan can lower."""
        ...

    def rival_effects(self) -> tuple[Any, ...]:
        """The fields of `doe.discrimination.misidentification.EffectLibrary`."""
        ...

    # -- theory --------------------------------------------------------------------------------------------------------
    planar: bool  # a chain of links in a plane: Table I of the paper
    theorem_joints: tuple[int, ...] | None  # joints (from 0) in the planar theorem, None: it does not hold


REQUIRED = tuple(name for name in vars(DesignModel) if not name.startswith("_"))


def check_model(model: Any) -> None:
    """Raises `InputError`, which names the first member of `DesignModel` that a model lacks, or whose size is wrong."""
    for name in REQUIRED:
        if not hasattr(model, name):
            allowed = f"one with {name} and all of doe.problem.model.DesignModel, such as Model(arm)"
            raise InputError(f"model: {type(model).__name__}, allowed: {allowed}")
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
