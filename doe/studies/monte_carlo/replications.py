"""One block of replications: simulate, fit all data sets at once, and keep a few numbers per parameter.

A spatial arm's errors can be distinguished only in part. A minimal set of them is fitted, without a prior, and compared
with the values of this set that put the measured points where all of the simulated errors together do. Every measured
point, or frame, is measured at every posture.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from doe.jobs.row_table import Row
from doe.problem.postures import random_postures
from doe.problem.problem import DesignProblem
from doe.studies.monte_carlo.specification import points
from identification.arrays import Array
from identification.errors import JobError
from identification.estimation import estimate_batch, estimate_each
from identification.estimation.batch import sessions
from identification.files.arm import arm_from_tables
from identification.for_design import without_prior
from identification.information import covariance, covariances
from identification.kinematics.counting import in_columns, in_joints
from identification.kinematics.parameters import JOINT_OFFSET, PRISMATIC, REVOLUTE, orientation_transform
from identification.measurements import Conditions, Measurements
from identification.model import Model

Z_95 = 1.959963984540054  # two-sided 95 % of the normal distribution
CHUNK = 20_000  # rows of random plans at a time: their arrays stay in the processor's cache
SPACE = 3  # coordinates of a point
MOST_ROWS = 4_000_000  # of one plan at a time: 64 MB of positions
POSTURES = 100  # where two geometries are compared: three equations each for some forty parameters


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
    if truth.arm.chain.angle_scale is None:
        return rows, conditions
    return rows, replace(conditions, orientation=truth.orientations(rows, conditions))


def plan_of(truth: Model, postures: Array) -> Measurements:
    """A plan (m, n) as measurements without positions: rows of `rows_of`."""
    rows, conditions = rows_of(truth, postures)
    chain, named = truth.arm.chain, {}
    if conditions.marker is not None:
        names = tuple(chain.tools)
        named = {"marker": np.array(names)[conditions.marker], "marker_names": names}
    return Measurements(rows, np.zeros((len(rows), truth.dimension)), orientations=conditions.orientation, **named)


def true_values(model: Model, truth: Model) -> Array:
    """(p,) values of the fitted parameters that are true: those of the truth, zero for those that it does not have;
    of a spatial arm's geometry those that mean the same."""
    values = model.parameters.mapping(model.parameters.vector(truth.best_known))
    if not model.arm.chain.planar:
        drawn, real = (Model(replace(each.arm, effects=())) for each in (model, truth))
        postures = np.random.default_rng(0).uniform(model.arm.lower, model.arm.upper, (POSTURES, model.joints))
        plan = plan_of(real, postures)
        same = estimate_batch(drawn, plan, real.position(plan.postures, conditions=plan.conditions)[None])
        values |= drawn.parameters.mapping(same.parameters[0])
    return model.parameters.vector(values)


class Cell(NamedTuple):
    """What a block of replications needs, in plain types that travel to workers.

    arm, truth : texts of arm files: as the fit knows it, and as it really is
    postures_deg : (m, n) the plan, of prismatic joints in mm; None: a new random plan for each replication
    """

    arm: str
    truth: str
    postures_deg: tuple[tuple[float, ...], ...] | None
    runs: int
    sigma: float


@lru_cache(maxsize=4)
def prepared(arm: str, truth: str) -> tuple[Model, Model, Array, Array]:
    """What is fitted (of a spatial arm a minimal set of parameters), what is simulated, (p,) true values of the fitted
    parameters, and (p + n, p) from them to those that are reported: themselves, and in the plane the orientation
    offsets. Kept, so that all blocks of a cell on one worker use one model."""
    fitted, simulated = (arm_from_tables(tomllib.loads(text)) for text in (arm, truth))
    model, true_model = Model(without_prior(fitted)), Model(simulated)
    transform = np.eye(len(model.names))
    if model.arm.chain.planar:
        transform = np.vstack([transform, orientation_transform(model.parameters)])
    return model, true_model, true_values(model, true_model), transform


def fits_of(cell: Cell, generator: np.random.Generator, total: int) -> tuple[Array, Array, Array]:
    """Parameters (K, p) of fits of K data sets, not numbers where one failed, sums of squares (K,) [mm^2], and
    deviations (K, p + n) by eq. 16 at the true values, of one plan (1, p + n), API units."""
    model, truth, values, transform = prepared(cell.arm, cell.truth)

    def deviations(matrices: Array) -> Array:
        return np.asarray(np.sqrt(np.sum((transform @ matrices) * transform, axis=-1)))

    rows = cell.runs * points(model)
    parts: list[Any] = []
    if cell.postures_deg is not None:
        plan = plan_of(truth, in_api_units(np.array(cell.postures_deg), model.joint_types))
        exact = truth.position(plan.postures, conditions=plan.conditions)
        jacobian = model.jacobian(plan.postures, values, plan.conditions)
        expected = deviations(covariance(jacobian, model.scales, cell.sigma))[None]
        for count in _sizes(total, MOST_ROWS // rows):
            positions = cell.sigma * generator.standard_normal((count, rows, model.dimension))
            positions += exact
            fits = estimate_batch(model, plan, positions)
            parts.append((np.where(fits.converged[:, None], fits.parameters, np.nan), np.array(fits.rss)))
        parameters, rss = map(np.concatenate, zip(*parts, strict=True))
        return parameters, rss, expected
    problem = DesignProblem.of(model)
    for count in _sizes(total, CHUNK // rows):
        postures = random_postures(problem, count * cell.runs, generator).reshape(count, cell.runs, -1)
        noise = cell.sigma * generator.standard_normal((count, rows, model.dimension))
        every, conditions = rows_of(truth, postures, model.remembers)
        each = estimate_each(model, every, truth.position(every, conditions=conditions) + noise, conditions)
        matrices = covariances(model.jacobian(every, values, conditions), model.scales, cell.sigma)
        parts.append((each.parameters, each.rss, deviations(matrices)))
    parameters, rss, expected = map(np.concatenate, zip(*parts, strict=True))
    return parameters, rss, expected


def _sizes(total: int, most: int) -> Iterator[int]:
    """Numbers of data sets that go through memory together."""
    size = max(1, most)
    yield from (min(size, total - start) for start in range(0, total, size))


def replicate(key: dict[str, Any], seed: np.random.SeedSequence, cell: Cell | str) -> list[Row]:
    """Rows of one block: per reported parameter the number of fits, mean error, sum of squares about it, coverage, in
    file units (mm and degrees).

    cell : what to simulate, or the reason why it cannot be simulated (no plan was found)
    """
    if isinstance(cell, str):
        raise JobError(cell)
    model, _, values, transform = prepared(cell.arm, cell.truth)
    unknowns, rows = len(values), cell.runs * points(model)
    if (equations := model.dimension * rows) < unknowns:
        raise JobError(f"{cell.runs} runs are {equations} equations, allowed: at least {unknowns}, one per unknown")
    parameters, rss, stds = fits_of(cell, np.random.default_rng(seed), key["replications"])
    good = np.isfinite(np.c_[parameters, rss]).all(axis=1) & np.isfinite(stds).all(axis=1)
    errors = (parameters[good] - values) @ transform.T
    turns = [*model.parameters.indices(JOINT_OFFSET).tolist(), *range(unknowns, len(transform))]
    errors[:, turns] = (errors[:, turns] + np.pi) % (2.0 * np.pi) - np.pi  # known up to a whole turn
    stds = stds if len(stds) == 1 else stds[good]
    distances = model.dimension <= SPACE  # the residuals of orientations are none
    rms = float(np.sqrt(np.mean(rss[good]) / rows)) if len(errors) and distances else None
    fits = {"fits": len(errors), "failed": int(np.sum(~good)), "rms_mm": rms}
    reported = [(p.name, p.file_unit, p.to_file) for p in model.parameters]
    orientations = range(1, len(transform) - unknowns + 1)
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
