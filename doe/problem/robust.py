"""Designs for an arm whose model may lack something: what it may lack enters with its prior.

The parameters are those of the model and of all effects of the library, error curves among them; the latter have a
normal prior of zero mean, and each posture has an error of its own, which is noise to all others
(`identification.gap.library.library_prior`). With K the information of the prior the posterior of a plan is
(sum B^T B + K)^-1 sigma^2, and every criterion of it is concave as before (doe/README.md, "Prior information").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from doe.criteria import Criterion, I
from doe.problem.model import offered, offers
from doe.problem.postures import listed_candidates, random_and_at_limits, random_postures
from doe.problem.problem import NEEDS_SIGMA, DesignProblem
from identification.arrays import Array
from identification.errors import InputError

# reasons: doe/README.md, "Robust designs"
FASTEST = 24.0  # order of the fastest wave of an error curve that a plan is to show
POSES = 1000  # random postures that stand for the workspace
LIBRARY = "library-prior"  # what its criterion promises is of a fit with `armcal identify --library-prior`
CHOICES = 2000  # postures to choose from where none are listed


def missing_effects(problem: DesignProblem, names: Sequence[str] | None = None) -> Any:
    """What a problem's model may lack of what postures can show; what order, time and temperature show is left out.

    names : of effects, None: all. Raises `InputError` for a model that does not know, unknown names, no sigma.
    """
    missing = offered(problem.model, "missing_effects", "robust")
    if problem.model.sigma is None:
        raise InputError(f"--robust {NEEDS_SIGMA}")
    return missing(names, FASTEST)


def robust_problem(
    problem: DesignProblem, missing: Any = None, criterion: Criterion | None = None, poses: Array | None = None
) -> DesignProblem:
    """The same design space for an arm that may have these effects too.

    missing : None: all that postures can show, `missing_effects`
    criterion : None: I, the mean squared error of the tip over `poses`, with the estimated effects in the model
    poses : (k, n) where the tip is needed, None: the `workspace`
    """
    added = missing_effects(problem) if missing is None else missing
    model, deviations, beyond = offered(problem.model, "with_effects", "robust")(added)
    wide = replace(problem, model=model, deviations={**problem.deviations, **deviations}, fit=LIBRARY)
    poses = workspace(wide) if poses is None else poses
    wide = replace(wide, beyond=beyond(poses))
    return replace(wide, criterion=average_error(wide, poses) if criterion is None else criterion)


def with_choices(problem: DesignProblem, also: Array | None = None) -> DesignProblem:
    """The problem with a list to choose from, its own or one of random allowed postures, half of them at limits.

    also : (k, n) postures that are among them too

    Fast waves give a criterion thousands of local optima over all postures, none much better than the next: a list has
    enough of them to choose from. No proof over a random list says anything of all postures: it is `sampled`.
    """
    sampled = problem.choices is None
    choices = random_and_at_limits(problem, CHOICES, np.random.default_rng(0)) if sampled else problem.choices
    assert choices is not None
    listed = choices if also is None else np.concatenate([choices, also])
    return replace(problem, choices=listed, sampled=sampled or problem.sampled)


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
        return listed_candidates(problem, problem.choices).postures
    return random_postures(problem, POSES, np.random.default_rng(0))
