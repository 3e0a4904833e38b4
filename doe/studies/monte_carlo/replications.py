"""One block of replications: simulate, fit all data sets at once, and keep a few numbers per parameter."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from doe.jobs.row_table import Row
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from doe.studies.monte_carlo.spatial import fitted_model, in_api_units, plan_of, points, rows_of, true_values
from identification.arrays import Array
from identification.errors import JobError
from identification.estimation import estimate_batch, estimate_each
from identification.files.arm import arm_from_tables
from identification.information import covariance, covariances
from identification.kinematics.parameters import JOINT_OFFSET
from identification.kinematics.planar import orientation_transform
from identification.measurements import Measurements
from identification.model import Model

Z_95 = 1.959963984540054  # two-sided 95 % of the normal distribution
CHUNK = 20_000  # rows of random plans at a time: their arrays stay in the processor's cache
SPACE = 3  # coordinates of a point
MOST_ROWS = 4_000_000  # of one plan at a time: 64 MB of positions


@dataclass(frozen=True)
class Cell:
    """What a block of replications needs, in plain types that travel to workers.

    arm, truth : texts of arm files: as the fit knows it, and as it really is
    postures_deg : (m, n) the plan, of prismatic joints in mm; None: a new random plan for each replication
    """

    arm: str
    truth: str
    postures_deg: tuple[tuple[float, ...], ...] | None
    runs: int
    sigma: float

    @cached_property
    def model(self) -> Model:
        """What is fitted."""
        return fitted_model(arm_from_tables(tomllib.loads(self.arm)))

    @cached_property
    def problem(self) -> DesignProblem:
        """Where random postures may lie: joint limits and constraints."""
        return DesignProblem.of(self.model)

    @cached_property
    def true_model(self) -> Model:
        """What is simulated."""
        return Model(arm_from_tables(tomllib.loads(self.truth)))

    @cached_property
    def plan(self) -> Measurements:
        """The plan as measurements without positions: postures and the conditions of their order."""
        assert self.postures_deg is not None
        return plan_of(self.true_model, in_api_units(np.array(self.postures_deg), self.model.joint_types))

    @property
    def rows(self) -> int:
        """m times the number of measured points."""
        return self.runs * points(self.model)

    @cached_property
    def exact(self) -> Array:
        """(m, d) true positions at the plan [mm]."""
        return self.true_model.position(self.plan.postures, conditions=self.plan.conditions)

    @cached_property
    def true_values(self) -> Array:
        """(p,) true values of the fitted parameters."""
        return true_values(self.model, self.true_model)

    @cached_property
    def transform(self) -> Array:
        """(p + n, p) from the parameters to those that are reported: themselves, and in the plane the orientation
        offsets."""
        own = np.eye(len(self.model.names))
        return (
            own if self.model.arm.chain is not None else np.vstack([own, orientation_transform(self.model.parameters)])
        )

    @cached_property
    def reported(self) -> list[tuple[str, str, float]]:
        """Name, unit and factor to it of the p + n reported parameters."""
        own = [(p.name, p.file_unit, p.to_file) for p in self.model.parameters]
        orientations = range(1, len(self.transform) - len(own) + 1)
        return own + [(f"orientation_offset:{j}", "deg", 180.0 / np.pi) for j in orientations]

    @cached_property
    def expected_std(self) -> Array:
        """(p + n,) deviations by eq. 16 at the true values, of the cell's plan, API units."""
        jacobian = self.model.jacobian(self.plan.postures, self.true_values, self.plan.conditions)
        return self.deviations(covariance(jacobian, self.model.scales, self.sigma))

    def deviations(self, matrices: Array) -> Array:
        """(..., p + n) of what is reported, from covariances (..., p, p) of the parameters."""
        return np.sqrt(np.sum((self.transform @ matrices) * self.transform, axis=-1))


@lru_cache(maxsize=4)
def prepared(cell: Cell) -> Cell:
    """The same cell, cached, so that all blocks of a cell on one worker use one model."""
    return cell


def check_equations(cell: Cell) -> None:
    """Raise `JobError` where the runs are too few for the unknowns."""
    unknowns = len(cell.model.names)
    if (equations := cell.model.dimension * cell.rows) < unknowns:
        raise JobError(f"{cell.runs} runs are {equations} equations, allowed: at least {unknowns}, one per unknown")


def replicate(key: dict[str, Any], seed: np.random.SeedSequence, cell: Cell | str) -> list[Row]:
    """Rows of one block: per reported parameter the number of fits, mean error, sum of squares about it, coverage.

    cell : what to simulate, or the reason why it cannot be simulated (no plan was found)
    """
    if isinstance(cell, str):
        raise JobError(cell)
    check_equations(cell := prepared(cell))
    generator = np.random.default_rng(seed)
    shared = cell.postures_deg is not None
    fit, count = _one_plan if shared else _new_plans, key["replications"]
    size = max(1, (MOST_ROWS if shared else CHUNK) // cell.rows)
    parts = [fit(cell, generator, min(size, count - start)) for start in range(0, count, size)]
    return _rows(cell, joined(parts, shared))


@dataclass(frozen=True)
class FittedReplications:
    """Fits of K data sets.

    parameters : (K, p), not numbers where a fit failed;  rss : (K,) sums of squares [mm^2]
    expected_std : (K, p + n) or (1, p + n) deviations by eq. 16, of each plan or of the one plan
    """

    parameters: Array
    rss: Array
    expected_std: Array


def joined(parts: Sequence[FittedReplications], shared: bool) -> FittedReplications:
    """The fits of all parts, on one plan (`shared`) or each on a plan of its own."""
    expected = [part.expected_std for part in parts]
    return FittedReplications(
        np.concatenate([part.parameters for part in parts]),
        np.concatenate([part.rss for part in parts]),
        expected[0] if shared else np.concatenate(expected),
    )


def _one_plan(cell: Cell, generator: np.random.Generator, count: int) -> FittedReplications:
    """Data sets on the cell's plan."""
    positions = cell.sigma * generator.standard_normal((count, cell.rows, cell.model.dimension))
    positions += cell.exact
    found = estimate_batch(cell.model, cell.plan, positions)
    parameters = np.where(found.converged[:, None], found.parameters, np.nan)
    return FittedReplications(parameters, np.array(found.rss), cell.expected_std[None])


def _new_plans(cell: Cell, generator: np.random.Generator, count: int) -> FittedReplications:
    """Data sets each on a new plan, uniform over the allowed postures."""
    model = cell.model
    postures = random_postures(cell.problem, count * cell.runs, generator).reshape(count, cell.runs, -1)
    noise = cell.sigma * generator.standard_normal((count, cell.rows, cell.model.dimension))
    postures, conditions = rows_of(cell.true_model, postures, model.remembers)
    positions = cell.true_model.position(postures, conditions=conditions) + noise
    found = estimate_each(model, postures, positions, conditions)
    jacobians = model.jacobian(postures, cell.true_values, conditions)
    return FittedReplications(
        found.parameters, found.rss, cell.deviations(covariances(jacobians, model.scales, cell.sigma))
    )


def _rows(cell: Cell, fits: FittedReplications) -> list[Row]:
    """The block's numbers, in file units (mm and degrees)."""
    good = np.isfinite(np.c_[fits.parameters, fits.rss]).all(axis=1)
    good &= np.isfinite(fits.expected_std).all(axis=1)
    errors = (fits.parameters[good] - cell.true_values) @ cell.transform.T
    parameters = cell.model.parameters
    turns = [*parameters.indices(JOINT_OFFSET).tolist(), *range(len(parameters), len(cell.transform))]
    errors[:, turns] = (errors[:, turns] + np.pi) % (2.0 * np.pi) - np.pi  # known up to a whole turn
    stds = fits.expected_std if len(fits.expected_std) == 1 else fits.expected_std[good]
    distances = cell.model.dimension <= SPACE  # the residuals of orientations are none
    rms = float(np.sqrt(np.mean(fits.rss[good]) / cell.rows)) if len(errors) and distances else None
    fit = {"fits": len(errors), "failed": int(np.sum(~good)), "rms_mm": rms}
    return [
        {"parameter": name, "unit": unit, **fit, **_figures(errors[:, k] * factor, stds[:, k] * factor)}
        for k, (name, unit, factor) in enumerate(cell.reported)
    ]


def _figures(error: Array, std: Array) -> Row:
    """What a block keeps of the errors (K,) of one parameter and their expected deviations (K,) or (1,)."""
    if error.size == 0:
        return {"mean_error": None, "squares": None, "covered": 0, "expected_std": None}
    mean = float(np.mean(error))
    return {
        "mean_error": mean,
        "squares": float(np.sum((error - mean) ** 2)),
        "covered": int(np.sum(np.abs(error) <= Z_95 * std)),
        "expected_std": float(std[0]) if std.size == 1 else float(np.sqrt(np.mean(std**2))),
    }
