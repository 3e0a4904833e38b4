"""Designs for an arm whose model may lack effects: those of the library enter with a prior of typical sizes.

The parameters are those of the model and of all effects of the library; the latter have a normal prior of zero mean
(`identification.gap.library.library_prior`). With K its information the posterior of a plan is (sum B^T B + K)^-1
sigma^2, and every criterion of it is concave as before (doe/README.md, "Prior information").
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
from doe.problem.spatial import of_one_arm, whole
from doe.problem.touching import touches
from identification.arrays import Array
from identification.errors import InputError
from identification.gap.library.library_prior import LibraryPrior, library_prior
from identification.model.positions import of_positions, tip_jacobian

# reasons: doe/README.md, "Robust designs"
SETTINGS = 4  # orders that stand for all orders of a ripple
POSES = 1000  # random postures that stand for the workspace
LIBRARY = "library-prior"  # what its criterion promises is of a fit with `armcal identify --library-prior`
CHOICES = 2000  # postures to choose from where none are listed


def missing_effects(problem: DesignProblem, names: Sequence[str] | None = None) -> LibraryPrior:
    """What a problem's model may lack of what postures can show; what order, time and temperature show is left out.

    names : of effects, None: all. Raises `InputError` for another model than an arm's, unknown names, no sigma.
    """
    if (model := of_one_arm(problem.model)) is None:
        raise InputError(f"robust: {type(problem.model).__name__}, allowed: the model of one arm")
    if model.sigma is None:
        raise InputError(f"--robust {NEEDS_SIGMA}")
    return library_prior(model.arm, names=names, most_settings=SETTINGS)


def robust_problem(
    problem: DesignProblem, missing: LibraryPrior | None = None, criterion: Criterion | None = None
) -> DesignProblem:
    """The same design space for an arm that may have these effects too.

    missing : None: all that postures can show, `missing_effects`
    criterion : None: I, the mean squared error of the tip over `workspace`, with the estimated effects in the model
    """
    added = missing_effects(problem) if missing is None else missing
    own = of_one_arm(problem.model)
    model = whole(replace(added.model, known=None if own is None else own.known))
    wide = replace(problem, model=model, deviations={**problem.deviations, **added.prior.deviations}, fit=LIBRARY)
    return replace(wide, criterion=average_error(wide) if criterion is None else criterion)


def with_choices(problem: DesignProblem, also: Array | None = None) -> DesignProblem:
    """The problem with a list to choose from, its own or one of random allowed postures, half of them at limits.

    also : (k, n) postures that are among them too

    Fast waves give a criterion thousands of local optima over all postures, none much better than the next: a list has
    enough of them to choose from. No proof over a random list says anything of all postures: it is `sampled`.
    """
    if problem.choices is not None:
        return problem if also is None else replace(problem, choices=np.concatenate([problem.choices, also]))
    generator = np.random.default_rng(0)
    anywhere = random_postures(problem, CHOICES // 2, generator)
    more = [] if also is None else [also]
    return replace(problem, choices=np.concatenate([anywhere, _at_limits(problem, generator), *more]), sampled=True)


def _at_limits(problem: DesignProblem, generator: np.random.Generator) -> Array:
    """(k, n) random allowed postures of which each joint is at its nearer limit with probability one half."""
    postures = random_postures(problem, CHOICES // 2, generator)
    nearer = np.where(postures < 0.5 * (problem.lower + problem.upper), problem.lower, problem.upper)
    postures = np.where(generator.random(postures.shape) < 0.5, nearer, postures)
    return postures[problem.feasible(postures)]


def average_error(problem: DesignProblem, poses: ArrayLike | None = None) -> I:
    """Criterion I at test poses (k, n) [rad]; None: over the `workspace`."""
    return I(tip_jacobians(problem, workspace(problem) if poses is None else poses))


def tip_jacobians(problem: DesignProblem, poses: ArrayLike) -> Array:
    """(k, d, p) scaled Jacobians of the measured points' positions at poses (k, n), whatever is read of them."""
    if (model := of_one_arm(problem.model)) is None or of_positions(model) is model:
        return problem.scaled_jacobians(poses)
    return tip_jacobian(model, poses) / model.scales


def workspace(problem: DesignProblem) -> Array:
    """(k, n) postures where the arm will work: all that may be chosen, or random ones within limits and constraints, as
    where a probe is to touch something."""
    if problem.choices is not None and not touches(of_one_arm(problem.model)):
        return listed_candidates(problem, problem.choices).postures
    return random_postures(problem, POSES, np.random.default_rng(0))
