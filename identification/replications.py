"""Many simulated calibrations: what a study's file asks for, and data sets that are simulated and fitted all at once.

A spatial arm's errors can be distinguished only in part. A minimal set of them is fitted, without a prior, and compared
with the values of this set that put the measured points where all of the simulated errors together do. Every measured
point, or frame, is measured at every posture.
"""

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field

from identification.arm import Arm, Calibration
from identification.arrays import Array
from identification.effects import library
from identification.errors import InputError, require
from identification.estimation import estimate_batch
from identification.files.arm import described, load_arm
from identification.files.io import named_file, read_toml
from identification.files.measurement import Plan
from identification.files.schema import StrictTable, validated
from identification.for_design import with_points, without_prior
from identification.information import spectrum
from identification.kinematics.parameters import GEOMETRY
from identification.measurements import Measurements
from identification.model import Model


# -- what is asked for -------------------------------------------------------------------------------------------------
class ModelTable(StrictTable):
    """`[[models]]`: what the fit estimates besides the geometry."""

    name: str
    effects: list[dict[str, Any]] | None = None  # as [[effects]] of an arm file; left out: the arm's own

    def of(self, arm: Arm) -> Arm:
        """The arm as the fit knows it: nominal, with its measured points in place."""
        return described(replace(arm, chain=with_points(arm.chain)), self.effects)

    def model(self, arm: Arm) -> Model:
        """What is fitted of an arm. Raises `InputError` where it cannot have the entry, or it cannot be simulated."""
        described = self.of(arm)
        model = Model(without_prior(described))
        _ = model.symbols  # raises for an effect that needs what the arm does not have
        for spec in described.effects if isinstance(self, TruthTable) else ():
            if library()[spec.name].scatter and (self.effects is not None or spec.values):
                raise InputError(f"{spec.key}, which changes the scatter, is not simulated, allowed: other effects")
        require("temperature" not in model.needs, "needs temperatures, allowed: effects without them")
        return model


class TruthTable(ModelTable):
    """`[[truths]]`: what is really there; what is left out is as in the arm's own calibration and effects."""

    length_errors_mm: list[float] | None = None
    joint_offsets_deg: list[float] | None = None
    values: dict[str, float] | None = None  # as calibration.values of a spatial arm

    def of(self, arm: Arm) -> Arm:
        """The true arm. Raises `InputError` for errors and effects that the arm cannot have."""
        lists = arm.chain.lists
        table: dict[str, Any] = {key: [0.0] * arm.links for key in lists.values()} or {"values": {}}
        table |= self.model_dump(exclude={"name", "effects"}, exclude_none=True)
        true = described(replace(arm, chain=with_points(arm.chain)), self.effects, table)
        values = {} if true.calibration is None else dict(true.calibration.values)
        for name, value in ({} if arm.calibration is None else arm.calibration.values).items():
            key = lists.get(name.partition(":")[0], "values") if GEOMETRY.fullmatch(name) else "effects"
            values |= {name: value} if getattr(self, key) is None else {}
        return replace(true, calibration=Calibration(values))


NotEmpty = Field(min_length=1)


class StudyFile(StrictTable):
    """The file of a Monte Carlo study: names of arm files; names of solvers, "dft", "random" or plan files; runs and
    sigma, left out: of the plan files, and of the arms; data sets of each cell."""

    arms: Annotated[list[str], NotEmpty]
    plans: Annotated[list[str], NotEmpty]
    runs: list[Annotated[int, Field(ge=1, le=100_000)]] = Field(default=[])
    sigma_mm: Annotated[list[Annotated[float, Field(gt=0)]], NotEmpty] | None = None
    replications: Annotated[int, Field(ge=1, le=10_000_000)] = 10_000
    solver_seconds: Annotated[float, Field(gt=0)] = 60.0
    truths: list[TruthTable] = Field(default=[TruthTable(name="arm")], min_length=1)
    models: list[ModelTable] = Field(default=[ModelTable(name="arm")], min_length=1)

    @classmethod
    def of(cls, tables: dict[str, Any]) -> Self:
        """That of parsed TOML. Raises `InputError` for other keys or values, and for a name that is given twice."""
        file = validated(cls, tables)
        for what in ("arms", "truths", "models"):
            names = [getattr(entry, "name", entry) for entry in getattr(file, what)]
            if len(set(names)) < len(names):
                raise InputError(f"{what}: name {max(names, key=names.count)!r} is given twice, allowed: once")
        return file

    @classmethod
    def read(
        cls, path: Path | str, replications: int | None = None
    ) -> tuple[list[Arm], dict[str, Plan | None], dict[str, Any]]:
        """Arms and plans that a file names, which are beside it (None: a plan that is no file), and what else it says.

        replications : instead of the file's
        Raises `InputError`, the place in the file, what was found and what is allowed.
        """
        content = read_toml(path) | ({} if replications is None else {"replications": replications})
        file, beside = cls.of(content), partial(named_file, Path(path).parent, whose="the study file")
        arms = [load_arm(beside(name, "arms")) for name in file.arms]
        plans = dict[str, Plan | None].fromkeys(file.plans)
        for name in (name for name in plans if name.endswith(".csv")):
            if any(arm.counting != arms[0].counting for arm in arms):
                state = "found files for arms of different joints"
                raise InputError(f"plans: {state}, allowed: as many, and the same [joints], in all arms")
            plans[name] = Plan.load(beside(name, "plans"), arms[0].joint_types)
        return arms, plans, {key: value for key, value in content.items() if key not in ("arms", "plans")}


# -- data sets and their fits ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Replications:
    """Data sets of a true arm, and the model that is fitted to them.

    values : (p,) true values of the fitted parameters
    transform : (r, p) from them to those that are reported: themselves, and in the plane the orientation offsets
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
        if model.parameters.by_link:  # orientations, too: sums of joint offsets (the paper's sigma_q, eq. 25)
            offsets = model.parameters.joint_offsets
            transform = np.vstack([transform, np.tri(len(offsets)) @ transform[offsets]])
        return cls(model, truth, true_values(model, truth), transform)

    @property
    def reported(self) -> list[tuple[str, str, float]]:
        """Names, units of a file, and factors to them, of the r parameters that are reported."""
        own = [(p.name, p.file_unit, p.to_file) for p in self.model.parameters]
        turned = range(1, len(self.transform) - len(own) + 1)
        return own + [(f"orientation_offset:{j}", "deg", 180.0 / np.pi) for j in turned]

    points = property(lambda self: len(self.model.arm.chain.tools))  # number of them, each a row at every posture

    def fits(self, postures: Array, sigma: float, rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
        """Errors (K, r) of fits of K = `count` data sets of one plan (m, n), not numbers where one failed; sums of
        squares (K,) [mm^2]; deviations (r,) by eq. 16 at the true values. API units. Raises `JobError` for a plan that
        does not identify the model."""
        plan = plan_of(self.truth, postures)
        positions = sigma * rng.standard_normal((count, len(plan), self.truth.dimension))
        positions += self.truth.position(plan.postures, conditions=plan.conditions)
        batch = estimate_batch(self.model, plan, positions)
        errors = (np.where(batch.converged[:, None], batch.parameters, np.nan) - self.values) @ self.transform.T
        turns = [*self.model.parameters.joint_offsets.tolist(), *range(len(self.values), len(self.transform))]
        errors[:, turns] = (errors[:, turns] + np.pi) % (2.0 * np.pi) - np.pi  # known up to a whole turn
        jacobian = self.model.jacobian(plan.postures, self.values, plan.conditions)
        covariance = sigma**2 * spectrum(jacobian, self.model.scales).covariance
        return errors, np.array(batch.rss), np.sqrt(np.sum((self.transform @ covariance) * self.transform, axis=1))


def plan_of(truth: Model, postures: Array) -> Measurements:
    """A plan (m, n) as measurements without positions: every measured point at each posture, turned as the truth."""
    names = tuple(truth.arm.chain.tools)
    named: dict[str, Any] = {}
    if len(names) > 1:
        named = {"marker": np.tile(names, len(postures)), "marker_names": names}
    rows = np.repeat(postures, len(names), axis=0)
    plan = Measurements(rows, np.zeros((len(rows), truth.dimension)), **named)
    if truth.arm.chain.angle_scale is None:
        return plan
    return replace(plan, orientations=truth.orientations(rows, plan.conditions))


def true_values(model: Model, truth: Model) -> Array:
    """(p,) values of the fitted parameters that are true: those of the truth, zero for those that it does not have;
    of a geometry with other parameters those that mean the same."""
    values = model.parameters.mapping(model.parameters.vector(truth.best_known))
    drawn, real = (Model(replace(each.arm, effects=())) for each in (model, truth))
    if drawn.names != real.names:
        # three equations of each for some forty parameters
        plan = plan_of(real, np.random.default_rng(0).uniform(model.arm.lower, model.arm.upper, (100, model.joints)))
        same = estimate_batch(drawn, plan, real.position(plan.postures, conditions=plan.conditions)[None])
        values |= drawn.parameters.mapping(same.parameters[0])
    return model.parameters.vector(values)
