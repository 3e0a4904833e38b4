"""Designs for an arm whose model may lack something: what it may lack enters with its prior.

The parameters are those of the model and of all effects of the library, error curves among them; the latter have a
normal prior of zero mean, and each posture has an error of its own, which is noise to all others
(`identification.gap.library.library_prior`). With K the information of the prior the posterior of a plan is
(sum B^T B + K)^-1 sigma^2, and every criterion of it is concave as before (doe/README.md, "Prior information").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from doe.criteria import Criterion, I
from doe.problem.candidates import listed_candidates
from doe.problem.feasible import random_postures
from doe.problem.prior import NEEDS_SIGMA
from doe.problem.problem import DesignProblem
from doe.problem.spatial import arm_model_of, measuring_every_point
from doe.problem.touching import touches
from identification.arrays import Array
from identification.errors import InputError
from identification.gap.library.library_prior import LibraryPrior, library_prior
from identification.model import Model
from identification.model.positions import of_positions, tip_jacobian

# reasons: doe/README.md, "Robust designs"
FASTEST = 24.0  # order of the fastest wave of an error curve that a plan is to show
POSES = 1000  # random postures that stand for the workspace
LIBRARY = "library-prior"  # what its criterion promises is of a fit with `armcal identify --library-prior`
CHOICES = 2000  # postures to choose from where none are listed


def missing_effects(problem: DesignProblem, names: Sequence[str] | None = None) -> LibraryPrior:
    """What a problem's model may lack of what postures can show; what order, time and temperature show is left out.

    names : of effects, None: all. Raises `InputError` for another model than an arm's, unknown names, no sigma.
    """
    if (model := arm_model_of(problem.model)) is None:
        raise InputError(f"robust: {type(problem.model).__name__}, allowed: the model of one arm")
    if model.sigma is None:
        raise InputError(f"--robust {NEEDS_SIGMA}")
    return library_prior(model.arm, names=names, fastest=FASTEST)


def robust_problem(
    problem: DesignProblem,
    missing: LibraryPrior | None = None,
    criterion: Criterion | None = None,
    poses: Array | None = None,
) -> DesignProblem:
    """The same design space for an arm that may have these effects too.

    missing : None: all that postures can show, `missing_effects`
    criterion : None: I, the mean squared error of the tip over `poses`, with the estimated effects in the model
    poses : (k, n) where the tip is needed, None: the `workspace`
    """
    added = missing_effects(problem) if missing is None else missing
    arm_model = arm_model_of(problem.model)
    noise = float(np.hypot(problem.model.sigma or 0.0, added.prior.own_error))
    model = replace(Model(replace(added.arm, sigma=noise)), known=None if arm_model is None else arm_model.known)
    deviations = {**problem.deviations, **added.prior.deviations}
    wide = replace(problem, model=measuring_every_point(model), deviations=deviations, fit=LIBRARY)
    poses = workspace(wide) if poses is None else poses
    levers = of_positions(model).joint_levers(poses)
    waves = float(np.mean(np.einsum("kdj,j->k", levers**2, added.faster)))
    wide = replace(wide, beyond=waves + levers.shape[1] * added.prior.own_error**2)
    return replace(wide, criterion=average_error(wide, poses) if criterion is None else criterion)


def with_choices(problem: DesignProblem, also: Array | None = None) -> DesignProblem:
    """The problem with a list to choose from, its own or one of random allowed postures, half of them at limits.

    also : (k, n) postures that are among them too

    Fast waves give a criterion thousands of local optima over all postures, none much better than the next: a list has
    enough of them to choose from. No proof over a random list says anything of all postures: it is `sampled`.
    """
    if problem.choices is not None:
        return problem if also is None else replace(problem, choices=np.concatenate([problem.choices, also]))
    generator = np.random.default_rng(0)
    anywhere, others = (random_postures(problem, CHOICES // 2, generator) for _ in range(2))
    nearer = np.where(others < 0.5 * (problem.lower + problem.upper), problem.lower, problem.upper)
    at_limits = np.where(generator.random(others.shape) < 0.5, nearer, others)
    parts = [anywhere, at_limits[problem.feasible(at_limits)], *([] if also is None else [also])]
    return replace(problem, choices=np.concatenate(parts), sampled=True)


def average_error(problem: DesignProblem, poses: ArrayLike | None = None) -> I:
    """Criterion I at test poses (k, n) [rad]; None: over the `workspace`."""
    return I(tip_jacobians(problem, workspace(problem) if poses is None else poses))


def tip_jacobians(problem: DesignProblem, poses: ArrayLike) -> Array:
    """(k, d, p) scaled Jacobians of the measured points' positions at poses (k, n), whatever is read of them."""
    if (model := arm_model_of(problem.model)) is None or of_positions(model) is model:
        return problem.scaled_jacobians(poses)
    return tip_jacobian(model, poses) / model.scales


def workspace(problem: DesignProblem) -> Array:
    """(k, n) postures where the arm will work: all that may be chosen, or random ones within limits and constraints, as
    where a probe is to touch something."""
    if problem.choices is not None and not touches(arm_model_of(problem.model)):
        return listed_candidates(problem, problem.choices).postures
    return random_postures(problem, POSES, np.random.default_rng(0))
