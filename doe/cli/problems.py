"""From command-line options to a design problem, in one place for all verbs that design."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from doe.cli.options import Names, words
from identification import InputError, nearest

if TYPE_CHECKING:
    from doe.criteria import Criterion
    from doe.problem.problem import DesignProblem
    from identification import Arm


@dataclass(frozen=True)
class CriterionOptions:
    """The criterion, and whether the model may lack effects.

    criterion : D, A, E, I, Ds or Dstar; left out: D, with --robust I.
    test_poses : CSV of postures that matter, for criterion I.
    subset : Parameters that matter, for Ds: length_error:1,joint_offset:2
    robust : The arm may have effects of the library that its file does not name.
    missing : Only these effects, for --robust: backlash,gear_ratio
    """

    criterion: str | None = None
    test_poses: Path | None = None
    subset: str | None = None
    robust: bool = False
    missing: Names | None = None

    @property
    def name(self) -> str:
        """Name of the criterion: the one given, else D, or I if effects may be missing."""
        return self.criterion or ("I" if self.robust else "D")

    @property
    def fit(self) -> str:
        """How measurements of a plan are to be fitted, see `Plan`."""
        names = "" if self.effects is None else f" --missing {','.join(self.effects)}"
        return f"library-prior{names}" if self.robust else ""

    @property
    def effects(self) -> list[str] | None:
        """Names of the effects that may be missing, None: all of the library. Raises `InputError` without --robust."""
        if self.missing is None:
            return None
        if not self.robust:
            raise InputError("--missing: found without --robust, allowed: with --robust")
        return words(self.missing)


@dataclass(frozen=True)
class PostureOptions:
    """Which postures may be chosen, and for which arms.

    keep : Postures already measured; the plan complements them.
    candidates : CSV of allowed postures to choose from.
    repeats : A posture may be measured more than once.
    minimum_distance_deg : Postures differ by this in some joint (1 deg).
    uncertain : average or worst: a plan for an arm known only by a prior (default) or by its calibration covariance.
    draws : Arms drawn for --uncertain.
    """

    keep: Path | None = None
    candidates: Path | None = None
    repeats: bool = False
    minimum_distance_deg: float | None = None
    uncertain: str | None = None
    draws: Annotated[int, click.IntRange(1, 50)] = 5


def design_problem(
    arm: Arm, wanted: CriterionOptions, postures: PostureOptions | None = None, seed: int = 0
) -> DesignProblem:
    """The problem that the options describe. Raises `InputError` for files and names that do not fit."""
    import numpy as np

    from doe.criteria import NAMES
    from doe.plan.plan import load_plan
    from doe.problem.postures import listed_candidates
    from doe.problem.problem import DesignProblem
    from doe.problem.uncertain import ensemble_problem, missing_effects, prior_draws, robust_problem
    from identification import Model, read_plan

    name, missing = wanted.name, wanted.effects
    for option, value, needed in (("--test-poses", wanted.test_poses, "I"), ("--subset", wanted.subset, "Ds")):
        if value is not None and name in NAMES and name != needed:
            raise InputError(f"{option}: criterion {name} does not use it, allowed: with criterion {needed}")
    postures, model, restrictions = postures or PostureOptions(), Model(arm), dict[str, Any]()
    if postures.keep is not None:  # measurements, or a plan carried out
        restrictions["kept"] = read_plan(postures.keep, arm.joint_types, carried_out=True).postures
    if postures.candidates is not None:
        choices = restrictions["choices"] = load_plan(postures.candidates, arm.joint_types).postures
        try:
            listed_candidates(DesignProblem.of(model, choices=choices), choices)
        except InputError as error:  # none is within limits and constraints
            raise InputError(f"{postures.candidates}: {error}") from None
    if postures.repeats or postures.minimum_distance_deg is not None:
        degrees = 0.0 if postures.repeats else postures.minimum_distance_deg or 0.0
        restrictions["minimum_distance"] = float(np.radians(degrees))
    problem = DesignProblem.of(model, **restrictions)
    if wanted.robust:
        if postures.uncertain is not None:
            raise InputError("--uncertain: found with --robust, allowed: one of them")
        problem = replace(robust_problem(problem, missing_effects(problem, missing)), fit=wanted.fit)
    if not wanted.robust or name != "I" or wanted.test_poses is not None:
        problem = replace(problem, criterion=_criterion(wanted, problem))
    if postures.uncertain is None:
        return problem
    arms = prior_draws(model, postures.draws, np.random.default_rng(seed))
    return ensemble_problem(problem, arms, postures.uncertain)


def _criterion(wanted: CriterionOptions, problem: DesignProblem) -> Criterion:
    from doe.criteria import criterion
    from doe.plan.plan import load_plan
    from doe.problem.uncertain import tip_jacobians

    poses = None if wanted.test_poses is None else load_plan(wanted.test_poses, problem.model.joint_types).postures
    names = problem.model.parameters.names
    subset = None if wanted.subset is None else words(wanted.subset)
    for word in subset or ():
        if word not in names:
            raise InputError(f"--subset: unknown parameter {word!r}, {nearest(word, names)}")
    return criterion(
        wanted.name,
        units=list(problem.model.parameters.units),
        subset=None if subset is None else [names.index(word) for word in subset],
        test_jacobians=None if poses is None else tip_jacobians(problem, poses),
    )
