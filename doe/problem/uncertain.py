"""Designs for an arm whose model may lack something (doe/README.md, "Robust designs").

The parameters are those of the model and of all effects of the library, error curves among them; the latter have a
normal prior of zero mean, and each posture has an error of its own, which is noise to all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from doe.criteria import I
from doe.problem.model import NEEDS_SIGMA, offered, offers
from doe.problem.postures import connected, half_at_limits, listed_candidates, random_postures
from doe.problem.problem import DesignProblem
from identification import Array, InputError


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
        count = 10**6 // len(workspace(problem))  # of which 1,000 are `connected`
        anywhere, others = (random_postures(problem, count, generator) for _ in range(2))
        listed = connected(problem, half_at_limits(problem, anywhere, others, generator))
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
    """(k, n) postures where the arm will work: all that may be chosen, or random ones within limits and constraints,
    `connected`, as where a probe is to touch something."""
    if problem.choices is not None and not getattr(problem.model, "tied", False):
        return listed_candidates(problem, problem.choices)
    return connected(problem, random_postures(problem, 1000, np.random.default_rng(0)))
