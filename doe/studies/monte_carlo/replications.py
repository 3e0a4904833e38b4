"""One block of replications: simulate, fit all data sets at once, and keep a few numbers per parameter.

A spatial arm's errors can be distinguished only in part. A minimal set of them is fitted, without a prior, and compared
with the values of this set that put the measured points where all of the simulated errors together do. Every measured
point, or frame, is measured at every posture.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from doe.jobs.row_table import Row
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from doe.problem.spatial import without_prior
from doe.studies.monte_carlo.specification import points
from identification.arrays import Array
from identification.errors import JobError
from identification.estimation import estimate_batch, estimate_each
from identification.estimation.batch import sessions
from identification.files.arm import arm_from_tables
from identification.information import covariance, covariances
from identification.kinematics.counting import in_columns, in_joints
from identification.kinematics.parameters import JOINT_OFFSET, PRISMATIC, REVOLUTE
from identification.kinematics.planar import orientation_transform
from identification.measurements import Conditions, Measurements
from identification.model import Model

Z_95 = 1.959963984540054  # two-sided 95 % of the normal distribution
CHUNK = 20_000  # rows of random plans at a time: their arrays stay in the processor's cache
SPACE = 3  # coordinates of a point
MOST_ROWS = 4_000_000  # of one plan at a time: 64 MB of positions
POSTURES = 100  # where two geometries are compared: three equations each for some forty parameters
Fits = tuple[Array, Array, Array]  # parameters (K, p), RSS (K,) [mm^2], deviations by eq. 16 (K, p + n) or (1, p + n)


def in_file_units(postures: Array, joint_types: tuple[str, ...]) -> Array:
    """Postures [rad, mm] as files have them, in degrees, of prismatic joints in millimetres."""
    columns = in_columns(postures, joint_types)
    return np.where(np.array(joint_types) == REVOLUTE, np.degrees(columns), columns)


def in_api_units(postures: Array, joint_types: tuple[str, ...]) -> Array:
    """The reverse of `in_file_units`."""
    return in_joints(np.where(np.array(joint_types) == PRISMATIC, postures, np.radians(postures)), joint_types)


def rows_of(truth: Model, postures: Array, remembers: bool = False) -> tuple[Array, Conditions]:
    """(..., m P, n) a posture for each row of plans (..., m, n), and conditions of the rows in their order, with the
    orientations of the true arm.

    remembers : with the past of the joints
    """
    count = points(truth)
    rows = np.repeat(postures, count, axis=-2)
    conditions = sessions(rows, remembers or truth.remembers)
    if count > 1:
        conditions = replace(conditions, marker=np.broadcast_to(np.arange(rows.shape[-2]) % count, rows.shape[:-1]))
    if truth.arm.chain is None or truth.arm.chain.angle_scale is None:
        return rows, conditions
    return rows, replace(conditions, orientation=truth.orientations(rows, conditions))


def plan_of(truth: Model, postures: Array) -> Measurements:
    """A plan (m, n) as measurements without positions: rows of `rows_of`."""
    rows, conditions = rows_of(truth, postures)
    chain, named = truth.arm.chain, {}
    if chain is not None and conditions.marker is not None:
        names = tuple(chain.tools)
        named = {"marker": np.array(names)[conditions.marker], "marker_names": names}
    return Measurements(rows, np.zeros((len(rows), truth.dimension)), orientations=conditions.orientation, **named)


def true_values(model: Model, truth: Model) -> Array:
    """(p,) values of the fitted parameters that are true: those of the truth, zero for those that it does not have;
    of a spatial arm's geometry those that mean the same."""
    values = model.parameters.mapping(model.parameters.vector(truth.best_known))
    if model.arm.chain is not None:
        drawn, real = (Model(replace(each.arm, effects=())) for each in (model, truth))
        postures = np.random.default_rng(0).uniform(model.arm.lower, model.arm.upper, (POSTURES, model.joints))
        plan = plan_of(real, postures)
        same = estimate_batch(drawn, plan, real.position(plan.postures, conditions=plan.conditions)[None])
        values |= drawn.parameters.mapping(same.parameters[0])
    return model.parameters.vector(values)


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
        """What is fitted: of a spatial arm with a minimal set of parameters."""
        return Model(without_prior(arm_from_tables(tomllib.loads(self.arm))))

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
        if self.model.arm.chain is not None:
            return own
        return np.vstack([own, orientation_transform(self.model.parameters)])

    @cached_property
    def expected_std(self) -> Array:
        """(p + n,) deviations by eq. 16 at the true values, of the cell's plan, API units."""
        jacobian = self.model.jacobian(self.plan.postures, self.true_values, self.plan.conditions)
        return self.deviations(covariance(jacobian, self.model.scales, self.sigma))

    def deviations(self, matrices: Array) -> Array:
        """(..., p + n) of what is reported, from covariances (..., p, p) of the parameters."""
        return np.sqrt(np.sum((self.transform @ matrices) * self.transform, axis=-1))

    def on_its_plan(self, generator: np.random.Generator, count: int) -> Fits:
        """Of data sets on the cell's plan; parameters are not numbers where a fit failed."""
        positions = self.sigma * generator.standard_normal((count, self.rows, self.model.dimension))
        positions += self.exact
        fits = estimate_batch(self.model, self.plan, positions)
        return np.where(fits.converged[:, None], fits.parameters, np.nan), np.array(fits.rss), self.expected_std[None]

    def on_new_plans(self, generator: np.random.Generator, count: int) -> Fits:
        """Of data sets each on a new plan, uniform over the allowed postures."""
        model, truth = self.model, self.true_model
        postures = random_postures(DesignProblem.of(model), count * self.runs, generator)
        noise = self.sigma * generator.standard_normal((count, self.rows, model.dimension))
        rows, conditions = rows_of(truth, postures.reshape(count, self.runs, -1), model.remembers)
        fits = estimate_each(model, rows, truth.position(rows, conditions=conditions) + noise, conditions)
        jacobians = model.jacobian(rows, self.true_values, conditions)
        return fits.parameters, fits.rss, self.deviations(covariances(jacobians, model.scales, self.sigma))


@lru_cache(maxsize=4)
def prepared(cell: Cell) -> Cell:
    """The same cell, cached, so that all blocks of a cell on one worker use one model."""
    return cell


def replicate(key: dict[str, Any], seed: np.random.SeedSequence, cell: Cell | str) -> list[Row]:
    """Rows of one block: per reported parameter the number of fits, mean error, sum of squares about it, coverage, in
    file units (mm and degrees).

    cell : what to simulate, or the reason why it cannot be simulated (no plan was found)
    """
    if isinstance(cell, str):
        raise JobError(cell)
    cell = prepared(cell)
    model, count = cell.model, key["replications"]
    unknowns = len(model.names)
    if (equations := model.dimension * cell.rows) < unknowns:
        raise JobError(f"{cell.runs} runs are {equations} equations, allowed: at least {unknowns}, one per unknown")
    fit, most = (cell.on_new_plans, CHUNK) if cell.postures_deg is None else (cell.on_its_plan, MOST_ROWS)
    generator, size = np.random.default_rng(seed), max(1, most // cell.rows)
    parts = [fit(generator, min(size, count - start)) for start in range(0, count, size)]
    parameters, rss, stds = (np.concatenate(part) for part in zip(*parts, strict=True))
    good = np.isfinite(np.c_[parameters, rss]).all(axis=1)
    if cell.postures_deg is None:
        good &= np.isfinite(stds).all(axis=1)
    errors = (parameters[good] - cell.true_values) @ cell.transform.T
    turns = [*model.parameters.indices(JOINT_OFFSET).tolist(), *range(unknowns, len(cell.transform))]
    errors[:, turns] = (errors[:, turns] + np.pi) % (2.0 * np.pi) - np.pi  # known up to a whole turn
    stds = stds[good] if cell.postures_deg is None else stds[:1]
    distances = model.dimension <= SPACE  # the residuals of orientations are none
    rms = float(np.sqrt(np.mean(rss[good]) / cell.rows)) if len(errors) and distances else None
    fits = {"fits": len(errors), "failed": int(np.sum(~good)), "rms_mm": rms}
    reported = [(p.name, p.file_unit, p.to_file) for p in model.parameters]
    orientations = range(1, len(cell.transform) - unknowns + 1)
    reported += [(f"orientation_offset:{j}", "deg", 180.0 / np.pi) for j in orientations]
    return [
        {"parameter": name, "unit": unit, **fits, **_figures(errors[:, k] * factor, stds[:, k] * factor)}
        for k, (name, unit, factor) in enumerate(reported)
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
