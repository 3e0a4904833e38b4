"""One block of replications: simulate, fit all data sets at once, and keep a few numbers per parameter."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from doe.rows import Row
from identification.arm import Array
from identification.arm_file import arm_from_tables
from identification.errors import JobError
from identification.estimation import estimate_batch
from identification.estimation.linear import as_complex, design, parameters_of
from identification.information import covariance, orientation_transform
from identification.measurements import Measurements
from identification.model import Model

Z_95 = 1.959963984540054  # two-sided 95 % of the normal distribution
CHUNK = 2_000  # random plans at a time


@dataclass(frozen=True)
class Cell:
    """What a block of replications needs, in plain types that travel to workers.

    arm, truth : texts of arm files: as the fit knows it, and as it really is
    postures_deg : (m, n) the plan, None: a new random plan for each replication
    """

    arm: str
    truth: str
    postures_deg: tuple[tuple[float, ...], ...] | None
    runs: int
    sigma: float

    @cached_property
    def model(self) -> Model:
        """What is fitted."""
        return Model(arm_from_tables(tomllib.loads(self.arm)))

    @cached_property
    def true_model(self) -> Model:
        """What is simulated."""
        return Model(arm_from_tables(tomllib.loads(self.truth)))

    @cached_property
    def plan(self) -> Measurements:
        """The plan as measurements without positions: postures and the conditions of their order."""
        assert self.postures_deg is not None
        return as_plan(np.radians(self.postures_deg))

    @cached_property
    def exact(self) -> Array:
        """(m, 2) true positions at the plan [mm]."""
        return self.true_model.position(self.plan.postures, conditions=self.plan.conditions)

    @cached_property
    def true_values(self) -> Array:
        """(p,) true values of the fitted parameters, zero for those that the truth does not have."""
        model = self.true_model
        known = dict(model.fixed) | dict(zip(model.names, model.values.tolist(), strict=True))
        return np.array([known.get(name, 0.0) for name in self.model.names])

    @cached_property
    def transform(self) -> Array:
        """(p + n, p) from the parameters to those that are reported: themselves, and the orientation offsets."""
        return np.vstack([np.eye(len(self.model.names)), orientation_transform(self.model.names)])

    @cached_property
    def reported(self) -> list[tuple[str, str, float]]:
        """Name, unit and factor to it of the p + n reported parameters."""
        own = [(p.name, p.file_unit, p.to_file) for p in self.model.parameters]
        orientations = range(1, len(self.transform) - len(own) + 1)
        return own + [(f"orientation_offset:{j}", "deg", 180.0 / np.pi) for j in orientations]

    @cached_property
    def expected_std(self) -> Array | None:
        """(p + n,) deviations by eq. 16 at the true values, API units; None for random plans."""
        if self.postures_deg is None:
            return None
        jacobian = self.model.jacobian(self.plan.postures, self.true_values, self.plan.conditions)
        matrix = covariance(jacobian, self.model.scales, self.sigma)
        return np.sqrt(np.einsum("ij,jk,ik->i", self.transform, matrix, self.transform))


@lru_cache(maxsize=4)
def prepared(cell: Cell) -> Cell:
    """The same cell, kept, so that all blocks of a cell on one worker share its model."""
    return cell


def as_plan(postures: Array) -> Measurements:
    """Postures [rad] in the order of measurement, nothing measured yet."""
    return Measurements(postures, np.zeros((len(postures), 2)))


def block(key: dict[str, Any], seed: np.random.SeedSequence, cell: Cell | str) -> list[Row]:
    """Rows of one block: per reported parameter the number of fits, mean error, sum of squares about it, RMS, coverage.

    cell : what to do; a text is the reason why it cannot be done (its plan could not be made)
    """
    if isinstance(cell, str):
        raise JobError(cell)
    cell = prepared(cell)
    generator = np.random.default_rng(seed)
    fit = _random_plans if cell.postures_deg is None else _one_plan
    parameters, rss = fit(cell, generator, key["replications"])
    good = np.isfinite(parameters).all(axis=1)
    return _rows(cell, parameters[good], rss[good], int(np.sum(~good)))


def _one_plan(cell: Cell, generator: np.random.Generator, count: int) -> tuple[Array, Array]:
    """(K, p) parameters and (K,) sums of squares [mm^2] of K data sets on the cell's plan."""
    positions = cell.sigma * generator.standard_normal((count, cell.runs, 2))
    positions += cell.exact
    found = estimate_batch(cell.model, cell.plan, positions)
    return np.where(found.converged[:, None], found.parameters, np.nan), np.array(found.rss)


def _random_plans(cell: Cell, generator: np.random.Generator, count: int) -> tuple[Array, Array]:
    """As `_one_plan`, with a plan of its own for each data set, uniform within the joint limits."""
    parts = []
    for start in range(0, count, CHUNK):
        size = min(CHUNK, count - start)
        arm = cell.model.arm
        postures = generator.uniform(arm.lower, arm.upper, (size, cell.runs, arm.links))
        noise = cell.sigma * generator.standard_normal((size, cell.runs, 2))
        if cell.model.linear_in_links and not cell.true_model.needs:
            flat = cell.true_model.position(postures.reshape(-1, arm.links))
            parts.append(linear_fits(cell.model, postures, flat.reshape(noise.shape) + noise))
        else:
            parts.append(_single_fits(cell, postures, noise))
    return np.concatenate([p for p, _ in parts]), np.concatenate([r for _, r in parts])


def linear_fits(model: Model, postures: Array, positions: Array) -> tuple[Array, Array]:
    """(K, p) closed-form parameters (THEORY.md section 2) and (K,) sums of squares, each data set on its own plan.

    postures : (K, m, n) [rad];  positions : (K, m, 2) [mm]
    Raises `JobError` for fewer postures than unknowns.
    """
    columns, nominal = _designs(model, postures)
    m, unknowns = columns.shape[1:]
    if m < unknowns:
        raise JobError(f"{m} runs cannot tell {unknowns} complex unknowns apart, allowed: at least {unknowns}")
    rest = as_complex(positions)[..., None] - (columns @ nominal)[..., None]
    change = np.linalg.pinv(columns, rcond=1e-13) @ rest
    residuals = rest - columns @ change
    return parameters_of(model, nominal + change[..., 0]), np.sum(np.abs(residuals[..., 0]) ** 2, axis=1)


def _designs(model: Model, postures: Array) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    count, m, n = postures.shape
    columns, nominal = design(model, postures.reshape(-1, n))
    return columns.reshape(count, m, -1), nominal


def _single_fits(cell: Cell, postures: Array, noise: Array) -> tuple[Array, Array]:
    """One `estimate_batch` per plan; not a number where a plan cannot tell all parameters apart."""
    parameters, rss = np.full((len(noise), len(cell.model.names)), np.nan), np.full(len(noise), np.nan)
    for k, plan in enumerate(map(as_plan, postures)):
        exact = cell.true_model.position(plan.postures, conditions=plan.conditions)
        try:
            found = estimate_batch(cell.model, plan, (exact + noise[k])[None])
        except JobError:
            continue
        if found.converged[0]:
            parameters[k], rss[k] = found.parameters[0], found.rss[0]
    return parameters, rss


def _rows(cell: Cell, parameters: Array, rss: Array, failed: int) -> list[Row]:
    """The block's numbers, in file units (mm and degrees)."""
    errors = (parameters - cell.true_values) @ cell.transform.T
    turns = [k for k, (name, _, _) in enumerate(cell.reported) if name.startswith(("joint_", "orientation_"))]
    errors[:, turns] = (errors[:, turns] + np.pi) % (2.0 * np.pi) - np.pi  # known up to a whole turn
    fit = {"failed": failed, "rms_mm": float(np.sqrt(np.mean(rss) / cell.runs)) if len(rss) else None}
    rows = []
    for k, (name, unit, factor) in enumerate(cell.reported):
        error = errors[:, k] * factor
        std = None if cell.expected_std is None else float(cell.expected_std[k]) * factor
        mean = float(np.mean(error)) if len(error) else None
        rows.append(
            {
                "parameter": name,
                "unit": unit,
                "fits": len(error),
                "mean_error": mean,
                "squares": float(np.sum((error - mean) ** 2)) if mean is not None else None,
                "covered": None if std is None else int(np.sum(np.abs(error) <= Z_95 * std)),
                "expected_std": std,
                **fit,
            }
        )
    return rows
