"""From command-line options to a design problem, in one place for all verbs that design."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from doe.cli.options import File, Names, words
from identification.errors import InputError, nearest

if TYPE_CHECKING:
    from doe.criteria import Criterion
    from doe.problem.problem import DesignProblem
    from identification.arm import Arm


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
    test_poses: File | None = None
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

    keep: File | None = None
    candidates: File | None = None
    repeats: bool = False
    minimum_distance_deg: float | None = None
    uncertain: str | None = None
    draws: Annotated[int, click.IntRange(1, 50)] = 5


def design_problem(
    arm: Arm, wanted: CriterionOptions, postures: PostureOptions | None = None, seed: int = 0
) -> DesignProblem:
    """The problem that the options describe. Raises `InputError` for files and names that do not fit."""
    import numpy as np

    from doe.problem.bayesian import ensemble_problem, prior_draws
    from doe.problem.problem import DesignProblem
    from identification.model import Model

    check_needed(wanted)
    postures = postures or PostureOptions()
    model = Model(arm)
    restricted = DesignProblem.of(model, **_restrictions(arm, postures))
    if wanted.robust:
        if postures.uncertain is not None:
            raise InputError("--uncertain: found with --robust, allowed: one of them")
        return _robust(wanted, restricted)
    problem = replace(restricted, criterion=_criterion(wanted, restricted))
    if postures.uncertain is None:
        return problem
    return ensemble_problem(
        problem, prior_draws(model, postures.draws, np.random.default_rng(seed)), postures.uncertain
    )


def _robust(wanted: CriterionOptions, problem: DesignProblem) -> DesignProblem:
    """The problem with the library's effects as a prior."""
    from doe.problem.robust import missing_effects, robust_problem

    wide = replace(robust_problem(problem, missing_effects(problem, wanted.effects)), fit=wanted.fit)
    if wanted.name == "I" and wanted.test_poses is None:
        return wide
    return replace(wide, criterion=_criterion(wanted, wide))


def _restrictions(arm: Arm, postures: PostureOptions) -> dict[str, Any]:
    """Arguments of `DesignProblem.of`, without those that were not given."""
    import numpy as np

    from identification.files.csv import read_table
    from identification.files.measurement_columns import read_postures

    options: dict[str, Any] = {}
    if postures.keep is not None:
        kept = read_table(postures.keep)  # measurements, or a plan carried out
        options["kept"] = read_postures(kept, arm.joint_types)
    if postures.candidates is not None:
        options["choices"] = allowed_postures(postures.candidates, arm)
    if postures.repeats or postures.minimum_distance_deg is not None:
        degrees = 0.0 if postures.repeats else postures.minimum_distance_deg or 0.0
        options["minimum_distance"] = float(np.radians(degrees))
    return options


def _criterion(wanted: CriterionOptions, problem: DesignProblem) -> Criterion:
    from doe.criteria import criterion
    from doe.plan.file import load_plan
    from doe.problem.robust import tip_jacobians

    poses = None if wanted.test_poses is None else load_plan(wanted.test_poses, problem.model.joint_types).postures
    parameters = problem.model.parameters
    return criterion(
        wanted.name,
        units=list(parameters.units),
        subset=None if wanted.subset is None else indices(wanted.subset, parameters.names),
        test_jacobians=None if poses is None else tip_jacobians(problem, poses),
    )


def check_needed(wanted: CriterionOptions) -> None:
    """Raises `InputError` for an option that the criterion would ignore."""
    from doe.criteria import NAMES

    name = wanted.name
    _ = wanted.effects  # raises without --robust
    for option, given, needed in (("--test-poses", wanted.test_poses, "I"), ("--subset", wanted.subset, "Ds")):
        if given is not None and name in NAMES and name != needed:
            raise InputError(f"{option}: criterion {name} does not use it, allowed: with criterion {needed}")


def allowed_postures(path: Path, arm: Arm) -> Any:
    """(N, n) postures of a candidate file. Raises `InputError` if none is within limits and constraints."""
    from doe.plan.file import load_plan
    from doe.problem.candidates import listed_candidates
    from doe.problem.problem import DesignProblem
    from identification.model import Model

    postures = load_plan(path, arm.joint_types).postures
    try:
        listed_candidates(DesignProblem.of(Model(arm), choices=postures), postures)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return postures


def indices(text: str, names: tuple[str, ...]) -> list[int]:
    """Parameter names, separated by commas, as indices; raises `InputError` with the nearest name."""
    wanted = words(text)
    for word in wanted:
        if word not in names:
            raise InputError(f"--subset: unknown parameter {word!r}, {nearest(word, names)}")
    return [names.index(word) for word in wanted]
