"""Many simulated calibrations: what a study's file asks for, and data sets that are simulated and fitted all at once.

A spatial arm's errors can be distinguished only in part. A minimal set of them is fitted, without a prior, and compared
with the values of this set that put the measured points where all of the simulated errors together do. Every measured
point, or frame, is measured at every posture.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field

from identification.arm import Arm, Calibration
from identification.arrays import Array
from identification.conditions import Conditions
from identification.effects import library
from identification.errors import InputError
from identification.estimation import estimate_batch, estimate_each
from identification.files.arm import arm_from_tables, dump_arm, load_arm
from identification.files.io import named_file, read_toml
from identification.files.measurement import Plan, load_plan
from identification.files.schema import StrictTable, validated
from identification.for_design import with_points, without_prior
from identification.information import covariances, spectrum
from identification.measurements import Measurements
from identification.model import Model

MOST_ROWS = 4_000_000  # of one plan at a time: 64 MB of positions


# -- what is asked for -------------------------------------------------------------------------------------------------
class ModelTable(StrictTable):
    """`[[models]]`: what the fit estimates besides the geometry."""

    name: str
    effects: list[dict[str, Any]] | None = None  # as [[effects]] of an arm file; left out: the arm's own

    def of(self, arm: Arm) -> Arm:
        """The arm as the fit knows it: nominal, with its measured points in place."""
        return replace(self._described(arm, None), calibration=None)

    def model(self, arm: Arm) -> Model:
        """What is fitted of an arm. Raises `InputError` where it cannot have the entry, or it cannot be simulated."""
        described = self.of(arm)
        model = Model(without_prior(described))
        _ = model.symbols  # raises for an effect that needs what the arm does not have
        for spec in described.effects if isinstance(self, TruthTable) else ():
            if library()[spec.name].scatter and (self.effects is not None or spec.values):
                raise InputError(f"{spec.key}, which changes the scatter, is not simulated, allowed: other effects")
        if "temperature" in model.needs:
            raise InputError("needs temperatures, allowed: effects without them")
        return model

    def _described(self, arm: Arm, calibration: dict[str, Any] | None) -> Arm:
        """The arm with these effects and this calibration, as its file would say it."""
        arm = replace(arm, chain=with_points(arm.chain))
        bare = replace(arm, effects=arm.effects if self.effects is None else (), calibration=None)
        more = {"effects": self.effects, "calibration": calibration}
        tables = tomllib.loads(dump_arm(bare)) | {key: value for key, value in more.items() if value is not None}
        described = arm_from_tables(tables)
        return replace(arm, effects=described.effects, calibration=described.calibration)


class TruthTable(ModelTable):
    """`[[truths]]`: what is really there; what is left out is as in the arm's own calibration and effects."""

    length_errors_mm: list[float] | None = None
    joint_offsets_deg: list[float] | None = None
    values: dict[str, float] | None = None  # as calibration.values of a spatial arm

    def of(self, arm: Arm) -> Arm:
        """The true arm. Raises `InputError` for errors and effects that the arm cannot have."""
        own = tomllib.loads(dump_arm(arm)).get("calibration", {})
        errors: dict[str, Any] = {"values": {}}
        if arm.chain.planar:
            errors = {"length_errors_mm": [0.0] * arm.links, "joint_offsets_deg": [0.0] * arm.links}
        kept = ("base", "tools", *errors, *(("effects",) if self.effects is None else ()))
        given = self.model_dump(exclude={"name", "effects"}, exclude_none=True)
        true = self._described(arm, errors | {key: own[key] for key in kept if key in own} | given)
        assert true.calibration is not None
        return replace(true, calibration=Calibration(true.calibration.values))


NotEmpty = Field(min_length=1)


class StudyFile(StrictTable):
    """The file of a Monte Carlo study: names of arm files; names of solvers, "dft", "random" or plan files; runs and
    sigma, left out: of the plan files, and of the arms; replications of a cell, `block` of them in a task."""

    arms: Annotated[list[str], NotEmpty]
    plans: Annotated[list[str], NotEmpty]
    runs: list[Annotated[int, Field(ge=1, le=100_000)]] = Field(default=[])
    sigma_mm: Annotated[list[Annotated[float, Field(gt=0)]], NotEmpty] | None = None
    replications: Annotated[int, Field(ge=1, le=1_000_000_000)] = 10_000
    block: Annotated[int, Field(ge=1, le=1_000_000)] = 10_000
    solver_seconds: Annotated[float, Field(gt=0)] = 60.0
    truths: list[TruthTable] = Field(default=[TruthTable(name="arm")], min_length=1)
    models: list[ModelTable] = Field(default=[ModelTable(name="arm")], min_length=1)

    @classmethod
    def of(cls, arms: Iterable[Arm], plans: Iterable[str], **others: Any) -> Self:
        """That of these arms and names of plans;  others : as in a file. Raises `InputError` for other keys or values,
        and for a name that is given twice."""
        file = validated(cls, {"arms": [arm.name for arm in arms], "plans": [*plans], **others})
        for what in ("arms", "truths", "models"):
            names = [getattr(entry, "name", entry) for entry in getattr(file, what)]
            if len(set(names)) < len(names):
                raise InputError(f"{what}: name {max(names, key=names.count)!r} is given twice, allowed: once")
        return file

    @classmethod
    def read(
        cls, path: Path | str, replications: int | None = None
    ) -> tuple[list[Arm], Mapping[str, Plan | None], dict[str, Any]]:
        """Arms and plans that a file names, which are beside it, and what else it says, for `of`.

        replications : instead of the file's. A plan that is no file is None
        Raises `InputError`, the place in the file, what was found and what is allowed.
        """
        content = read_toml(path) | ({} if replications is None else {"replications": replications})
        file = validated(cls, content)

        def beside(name: str, key: str) -> Path:
            return named_file(Path(path).parent, name, key, whose="the study file")

        arms = [load_arm(beside(name, "arms")) for name in file.arms]
        given = [name for name in file.plans if name.endswith(".csv")]
        if given and any(arm.counting != arms[0].counting for arm in arms):
            raise InputError("plans: found files for arms with different [joints], allowed: the same in all arms")
        kinds = arms[0].joint_types if arms[0].counting is not None else None
        plans = {name: load_plan(beside(name, "plans"), kinds) if name in given else None for name in file.plans}
        return arms, plans, {key: value for key, value in content.items() if key not in ("arms", "plans")}


# -- data sets and their fits ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Replications:
    """Data sets of a true arm, and the model that is fitted to them.

    values : (p,) true values of the fitted parameters
    transform : (p + n, p) from them to those that are reported: themselves, and in the plane the orientation offsets
    """

    model: Model
    truth: Model
    values: Array
    transform: Array

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, fitted: Arm, true: Arm) -> Self:
        """Of an arm as the fit knows it, and as it is. Kept, so that all blocks of a cell use one model."""
        model, truth = Model(without_prior(fitted)), Model(true)
        transform = np.eye(len(model.names))
        if model.parameters.by_link:
            transform = np.vstack([transform, model.parameters.to_orientations])
        return cls(model, truth, true_values(model, truth), transform)

    @property
    def points(self) -> int:
        """Number of measured points, each a row at every posture."""
        return len(self.model.arm.chain.tools)

    def fits(
        self, plans: Array, sigma: float, generator: np.random.Generator, count: int = 1
    ) -> tuple[Array, Array, Array]:
        """Parameters (K, p) of fits of K data sets, not numbers where one failed; sums of squares (K,) [mm^2]; and
        deviations (K, p + n) by eq. 16 at the true values, of one plan (1, p + n). API units.

        plans : (m, n) one, measured `count` = K times, or (K, m, n)
        """
        if plans.ndim == 3:
            every, conditions = rows_of(self.truth, plans, self.model.remembers)
            exact = self.truth.position(every, conditions=conditions)
            fits = estimate_each(self.model, every, exact + sigma * generator.standard_normal(exact.shape), conditions)
            jacobian = self.model.jacobian(every, self.values, conditions)
            return fits.parameters, fits.rss, self._deviations(covariances(jacobian, self.model.scales, sigma))
        plan, parts = plan_of(self.truth, plans), list[tuple[Array, Array]]()
        exact = self.truth.position(plan.postures, conditions=plan.conditions)
        size = max(1, MOST_ROWS // len(plan))
        for number in (min(size, count - start) for start in range(0, count, size)):
            positions = sigma * generator.standard_normal((number, *exact.shape))
            positions += exact
            batch = estimate_batch(self.model, plan, positions)
            parts.append((np.where(batch.converged[:, None], batch.parameters, np.nan), np.array(batch.rss)))
        parameters, rss = map(np.concatenate, zip(*parts, strict=True))
        jacobian = self.model.jacobian(plan.postures, self.values, plan.conditions)
        matrices = sigma**2 * spectrum(jacobian, self.model.scales).covariance[None]
        return parameters, rss, self._deviations(matrices)

    def _deviations(self, covariance: Array) -> Array:
        """(K, p + n) of the reported parameters, from (K, p, p)."""
        return np.asarray(np.sqrt(np.sum((self.transform @ covariance) * self.transform, axis=-1)))


def rows_of(truth: Model, postures: Array, remembers: bool = False) -> tuple[Array, Conditions]:
    """(..., m P, n) a posture for each row of plans (..., m, n), and conditions of the rows in their order, with the
    orientations of the true arm.

    remembers : with the past of the joints
    """
    count = len(truth.arm.chain.tools)
    rows = np.repeat(postures, count, axis=-2)
    conditions = Conditions.in_order(rows, remembers or truth.remembers)
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
    if model.arm.chain.frame_kinds:
        drawn, real = (Model(replace(each.arm, effects=())) for each in (model, truth))
        # three equations of each for some forty parameters
        postures = np.random.default_rng(0).uniform(model.arm.lower, model.arm.upper, (100, model.joints))
        plan = plan_of(real, postures)
        same = estimate_batch(drawn, plan, real.position(plan.postures, conditions=plan.conditions)[None])
        values |= drawn.parameters.mapping(same.parameters[0])
    return model.parameters.vector(values)
