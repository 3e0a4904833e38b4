"""From command-line options to a design problem, in one place for all verbs that design."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from doe.problem.problem import DesignProblem
    from identification.arm import Arm


def problem_of(
    arm: Arm,
    criterion_name: str = "D",
    *,
    test_poses: Path | None = None,
    subset: str | None = None,
    keep: Path | None = None,
    candidates: Path | None = None,
    repeats: bool = False,
    minimum_distance_deg: float | None = None,
    uncertain: str | None = None,
    draws: int = 5,
    seed: int = 0,
) -> DesignProblem:
    """The problem that the options describe. Raises `InputError` for files and names that do not fit."""
    import numpy as np

    from doe.criteria import criterion
    from doe.plan.file import load_plan
    from doe.problem.problem import DesignProblem
    from identification.model import Model

    check_needed(criterion_name, test_poses=test_poses, subset=subset)
    model = Model(arm)
    options: dict[str, Any] = {}
    if keep is not None:
        options["kept"] = measured_postures(keep, arm)
    if candidates is not None:
        options["choices"] = allowed_postures(candidates, arm)
    if repeats or minimum_distance_deg is not None:
        options["minimum_distance"] = 0.0 if repeats else float(np.radians(minimum_distance_deg or 0.0))
    plain = DesignProblem.of(model, **options)
    chosen = criterion(
        criterion_name,
        units=[parameter.unit for parameter in model.parameters],
        subset=None if subset is None else indices(subset, model.names),
        test_blocks=None if test_poses is None else plain.blocks(load_plan(test_poses, arm.links).postures),
    )
    problem = DesignProblem.of(model, criterion=chosen, **options)
    if uncertain is None:
        return problem
    from doe.problem.bayesian import ensemble_problem as over_prior
    from doe.problem.bayesian import prior_draws

    return over_prior(problem, prior_draws(model, draws, np.random.default_rng(seed)), uncertain)


def check_needed(criterion_name: str, *, test_poses: Path | None, subset: str | None) -> None:
    """Raises `InputError` for an option that the criterion would ignore."""
    from doe.criteria import NAMES
    from identification.errors import InputError

    for option, given, needed in (("--test-poses", test_poses, "I"), ("--subset", subset, "Ds")):
        if given is not None and criterion_name in NAMES and criterion_name != needed:
            raise InputError(
                f"{option}: criterion {criterion_name} has no use for it, allowed: with criterion {needed}"
            )


def allowed_postures(path: Path, arm: Arm) -> Any:
    """(N, n) postures of a candidate file. Raises `InputError` if none is within limits and constraints."""
    from doe.plan.file import load_plan
    from doe.problem.candidates import listed
    from doe.problem.problem import DesignProblem
    from identification.errors import InputError
    from identification.model import Model

    postures = load_plan(path, arm.links).postures
    try:
        listed(DesignProblem.of(Model(arm)), postures)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return postures


def measured_postures(path: Path, arm: Arm) -> Any:
    """(k, n) postures of a measurement file, or of a plan that is carried out already."""
    from identification.files.csv import read_table
    from identification.files.measurement import read_postures

    return read_postures(read_table(path), arm.links)


def indices(text: str, names: tuple[str, ...]) -> list[int]:
    """Parameter names, separated by commas, as indices; raises `InputError` with the nearest name."""
    from identification.errors import InputError, nearest

    wanted = [word.strip() for word in text.split(",")]
    for word in wanted:
        if word not in names:
            raise InputError(f"--subset: unknown parameter {word!r}, {nearest(word, names)}")
    return [names.index(word) for word in wanted]
