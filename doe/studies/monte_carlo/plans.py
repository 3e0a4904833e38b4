"""The plans of a study: made by a solver (as tasks), the paper's own, random ones, or given."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np
import polars as pl

from doe.jobs.row_table import Key, Row, short_hash
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from doe.studies.monte_carlo.spatial import in_api_units, in_file_units
from doe.studies.monte_carlo.specification import DFT, RANDOM, Study
from identification.arm import Arm
from identification.files.arm import arm_from_tables
from identification.files.arm_text import dump_arm
from identification.model import Model


def plan_keys(study: Study) -> Iterator[Key]:
    """One key per plan that a solver has to make."""
    solvers = [plan for plan in study.plans if isinstance(plan, str) and plan not in (DFT, RANDOM)]
    for arm, plan, runs in product(study.arms, solvers, study.runs):
        yield {
            "arm": arm.name,
            "plan": plan,
            "runs": runs,
            "limit_s": study.solver_seconds,
            "inputs": short_hash(dump_arm(arm)),
        }


def make_plan(key: dict[str, Any], seed: np.random.SeedSequence, text: str) -> list[Row]:
    """The plan of a key as one row, for the arm of an arm file's text."""
    problem = DesignProblem.of(Model(arm_from_tables(tomllib.loads(text))))
    number = int(seed.generate_state(1)[0])
    design = solve(problem, key["runs"], key["plan"], seed=number, seconds=key["limit_s"])
    postures = in_file_units(design.plan.postures, problem.model.joint_types)
    return [{"postures_deg": postures.tolist(), "efficiency": design.efficiency}]


def dft_postures(links: int, runs: int) -> np.ndarray:
    """(m, n) theta_j = 2 pi i j / m, so every q_j = 2 pi i / m, in (-pi, pi] (doe/README.md, "Information matrix")."""
    turn = 2.0 * np.pi * np.arange(runs) / runs
    return np.tile(np.where(turn > np.pi, turn - 2.0 * np.pi, turn)[:, None], (1, links))


def _dft(arm: Arm, runs: int) -> np.ndarray | str:
    if arm.chain is not None:
        return f"plan dft: arm {arm.name} is spatial, allowed: planar arms"
    postures = dft_postures(arm.links, runs)
    if runs < arm.links:
        return f"plan dft: {runs} runs are too few for {arm.links} links, allowed: at least {arm.links}"
    outside = np.flatnonzero(np.any((postures < arm.lower) | (postures > arm.upper), axis=0))
    if outside.size:
        return f"plan dft: joint {outside[0] + 1} would leave its limits"
    outside = np.flatnonzero(~DesignProblem.of(Model(arm)).feasible(postures))
    return f"plan dft: posture {outside[0] + 1} would violate a constraint" if outside.size else postures


def made_postures(study: Study, plans: pl.DataFrame) -> dict[tuple[str, str, int], np.ndarray | str]:
    """Arm, plan and runs -> postures (m, n) [rad], or why there are none."""
    types = {arm.name: arm.joint_types for arm in study.arms}
    return {
        (row["arm"], row["plan"], row["runs"]): (
            in_api_units(np.array(row["postures_deg"]), types[row["arm"]])
            if row["status"] == "done"
            else f"no plan: {row['error']}"
        )
        for row in plans.iter_rows(named=True)
    }


def plans_of(
    study: Study, arm: Arm, made: Mapping[Any, np.ndarray | str]
) -> Iterator[tuple[str, int, np.ndarray | str | None]]:
    """Name, number of runs and postures (None: random, a text: why there is none) of an arm's plans."""
    for plan in study.plans:
        if not isinstance(plan, str):
            yield plan[0], len(plan[1]), plan[1].postures
            continue
        for runs in study.runs:
            if plan == RANDOM:
                yield plan, runs, None
            else:
                yield plan, runs, _dft(arm, runs) if plan == DFT else made[arm.name, plan, runs]
