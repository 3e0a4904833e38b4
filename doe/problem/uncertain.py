"""Designs for an arm whose parameters are not known yet, and for one whose model may lack something.

*Several arms* (doe/README.md, "Prior information"): K parameter vectors are drawn and K arms imagined that are measured
together, a model like any other whose Jacobians and information are block-diagonal.

*Missing effects* ("Robust designs"): the parameters are those of the model and of all effects of the library, error
curves among them; the latter have a normal prior of zero mean, and each posture has an error of its own, which is noise
to all others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from doe.criteria import Average, I, Worst
from doe.problem.model import NEEDS_SIGMA, DesignModel, offered, offers
from doe.problem.postures import half_at_limits, listed_candidates, random_postures
from doe.problem.problem import DesignProblem
from identification import Array, InputError, ParameterSet, design_model, nearest, readonly

KINDS = {"average": Average, "worst": Worst}


# -- several arms ------------------------------------------------------------------------------------------------------
class EnsembleModel:
    """K arms measured at the same postures: a `DesignModel` with K d coordinates and K p parameters, the number of the
    draw in their names. draws : (K, p) parameter vectors [mm, rad]."""

    def __init__(self, model: Any, draws: Array) -> None:
        self.model: DesignModel = design_model(model)
        self.draws, p = readonly(np.atleast_2d(draws)), len(self.model.parameters)
        if self.draws.shape[1] != p or not np.all(np.isfinite(self.draws)):
            raise InputError(f"draws: shape {self.draws.shape}, allowed: (K, {p}) finite numbers")
        self.joint_types, self.sigma = self.model.joint_types, self.model.sigma
        self.lower, self.upper = self.model.lower, self.model.upper
        self.parameters = ParameterSet(
            replace(one, name=f"{one.name} [draw {k}]") for k in self._numbers for one in self.model.parameters
        )
        self.dimension, self.values = self.model.dimension * len(self.draws), self.draws.ravel()
        self.prior: Mapping[str, float] = self.of_draws(self.model.prior)

    @property
    def _numbers(self) -> range:
        return range(1, len(self.draws) + 1)

    def of_draws(self, deviations: Mapping[str, float]) -> dict[str, float]:
        """Standard deviations of the model's parameters as those of every draw."""
        return {f"{name} [draw {k}]": size for k in self._numbers for name, size in deviations.items()}

    def symbolic_position(self, q: ca.SX, p: ca.SX) -> ca.SX:
        """(K d) positions of the K arms."""
        each = ca.vertsplit(p, self.draws.shape[1])
        return ca.vertcat(*(self.model.symbolic_position(q, part) for part in each))


def prior_draws(model: Any, count: int, generator: Generator) -> Array:
    """(count, p) parameter vectors around the best known values of an arm.

    With a calibration that has a covariance of the same parameters, from it; else independent normal deviations of the
    sizes of its machining, within physical bounds: of lengths, of angles, and of everything else such that it moves the
    tip as an angle does at the end of a lever, where an angle of unknown place turns a link of mean length.
    """
    model = design_model(model)
    if (covariance := offered(model, "covariance", "uncertain")) is not None:
        return generator.multivariate_normal(model.values, covariance, count, method="eigh")
    length, angle, arm = offered(model, "machining", "uncertain")  # [mm], [rad], [mm]
    by_unit = {"mm": length, "rad": angle}
    deviations = np.array([by_unit.get(p.unit, angle * arm / p.scale) for p in model.parameters])
    drawn = model.values + deviations * generator.standard_normal((count, len(deviations)))
    return np.clip(drawn, model.parameters.lower, model.parameters.upper)


def ensemble_problem(problem: DesignProblem, draws: Array, kind: str = "average") -> DesignProblem:
    """The same design space for an uncertain arm: D-optimal on `average`, or at `worst`, over the draws (K, p).

    Raises `InputError` for another kind, a problem whose criterion is not D, draws of the wrong shape.
    """
    if kind not in KINDS:
        raise InputError(f"uncertain: unknown kind {kind!r}, {nearest(kind, KINDS)}")
    if problem.criterion.name != "D":
        raise InputError(f"criterion: {problem.criterion.name} for an uncertain arm, allowed: D")
    if isinstance(problem.model, EnsembleModel):
        raise InputError("uncertain: the model is one of several arms already, allowed: the model of one arm")
    model = EnsembleModel(problem.model, draws)
    deviations = model.of_draws(problem.deviations)
    return replace(problem, model=model, criterion=KINDS[kind](len(model.draws)), deviations=deviations)


# -- one arm that may have more effects --------------------------------------------------------------------------------
def missing_effects(problem: DesignProblem, names: Sequence[str] | None = None) -> Any:
    """What a problem's model may lack of what postures can show; what order, time and temperature show is left out.

    names : of effects, None: all. Raises `InputError` for a model that does not know, unknown names, no sigma.
    """
    missing = offered(problem.model, "missing_effects", "robust")
    if problem.model.sigma is None:
        raise InputError(f"--robust {NEEDS_SIGMA}")
    # the order of the fastest wave of an error curve that a plan is to show (doe/README.md, "Robust designs")
    return missing(names, 24.0)


def robust_problem(problem: DesignProblem, missing: Any = None, poses: Array | None = None) -> DesignProblem:
    """The same design space for an arm that may have these effects too, with criterion I: the mean squared error of the
    tip over `poses`, with the estimated effects in the model.

    missing : None: all that postures can show, `missing_effects`
    poses : (k, n) where the tip is needed, None: the `workspace`
    """
    added = missing_effects(problem) if missing is None else missing
    model, deviations, beyond = offered(problem.model, "with_effects", "robust")(added)
    # what its criterion promises is of a fit with `armcal identify --library-prior`
    wide = replace(problem, model=model, deviations={**problem.deviations, **deviations}, fit="library-prior")
    poses = workspace(wide) if poses is None else poses
    wide = replace(wide, beyond=beyond(poses))
    return replace(wide, criterion=average_error(wide, poses))


def with_choices(problem: DesignProblem, also: Array | None = None) -> DesignProblem:
    """The problem with a list to choose from, its own or one of random allowed postures, half of them at limits.

    also : (k, n) postures that are among them too

    Fast waves give a criterion thousands of local optima over all postures, none much better than the next: a list has
    enough of them to choose from. No proof over a random list says anything of all postures: it is `sampled`.
    """
    listed, sampled = problem.choices, problem.sampled
    if listed is None:
        generator, sampled = np.random.default_rng(0), True
        anywhere, others = (random_postures(problem, 1000, generator) for _ in range(2))
        listed = half_at_limits(problem, anywhere, others, generator)
    return replace(problem, choices=listed if also is None else np.concatenate([listed, also]), sampled=sampled)


def average_error(problem: DesignProblem, poses: ArrayLike | None = None) -> I:
    """Criterion I at test poses (k, n) [rad]; None: over the `workspace`."""
    return I(tip_jacobians(problem, workspace(problem) if poses is None else poses))


def tip_jacobians(problem: DesignProblem, poses: ArrayLike) -> Array:
    """(k, P, c, p) scaled Jacobians of the positions of P measured points at poses (k, n), whatever is read of them; of
    a model that knows no tip what is measured, as of one point."""
    if not offers(problem.model, "tip_jacobian"):
        return problem.scaled_jacobians(poses)[:, None]
    return np.asarray(offered(problem.model, "tip_jacobian", "tip")(poses) / problem.model.parameters.scales)


def workspace(problem: DesignProblem) -> Array:
    """(k, n) postures where the arm will work: all that may be chosen, or random ones within limits and constraints, as
    where a probe is to touch something."""
    if problem.choices is not None and not getattr(problem.model, "tied", False):
        return listed_candidates(problem, problem.choices)
    return random_postures(problem, 1000, np.random.default_rng(0))
