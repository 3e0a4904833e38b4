"""What a study asks for: a grid of arms x plans x runs x sigma x truths x models; each combination is a cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from doe.plan.plan import Plan
from doe.solvers import SOLVERS
from identification.arm import Arm, Calibration, EffectSpec
from identification.arrays import readonly
from identification.effects import library
from identification.errors import InputError, nearest
from identification.for_design import with_points, without_prior
from identification.kinematics.parameters import GEOMETRY
from identification.model import Model

CELL = ("arm", "plan", "runs", "sigma_mm", "truth", "model")  # the columns that identify a cell
DFT, RANDOM = "dft", "random"
MOST_RUNS, MOST_REPLICATIONS, MOST_BLOCK = 100_000, 1_000_000_000, 1_000_000  # of a cell, a cell, and a task
MOST_TASKS = 100_000  # of a cell: each is a row of a table


def simulated(arm: Arm) -> Arm:
    """The arm with its measured points in place; a planar arm as it is."""
    return arm if arm.chain.planar else replace(arm, chain=with_points(arm.chain))


def points(model: Model) -> int:
    """Number of measured points, each a row at every posture."""
    return len(model.arm.chain.tools)


@dataclass(frozen=True)
class Truth:
    """What is really there. None: as in the arm's own calibration and effects.

    length_errors : (n,) [mm];  joint_offsets : (n,) [rad], of planar arms
    values : parameter name -> error [API units], of spatial arms;  effects : with values
    """

    name: str = "arm"
    length_errors: Sequence[float] | None = None
    joint_offsets: Sequence[float] | None = None
    effects: tuple[EffectSpec, ...] | None = None
    values: Mapping[str, float] | None = None

    def of(self, arm: Arm) -> Arm:
        """The true arm. Raises `InputError` for errors that the arm does not have, and if they are not one for each
        link."""
        calibration = self._planar(arm) if arm.chain.planar else self._spatial(arm)
        if self.effects is None:
            effects = {} if arm.calibration is None else arm.calibration.effects
            return replace(arm, calibration=replace(calibration, values={**calibration.values, **effects}))
        return replace(arm, effects=self.effects, calibration=calibration)

    def _planar(self, arm: Arm) -> Calibration:
        if self.values is not None:
            raise InputError("values: found for a planar arm, allowed: length_errors_mm and joint_offsets_deg")
        before = arm.calibration or Calibration.of(np.zeros(arm.links), np.zeros(arm.links))
        lengths = before.length_errors if self.length_errors is None else readonly(self.length_errors)
        offsets = before.joint_offsets if self.joint_offsets is None else readonly(self.joint_offsets)
        for name, values in (("length_errors_mm", lengths), ("joint_offsets_deg", offsets)):
            if values.size != arm.links:
                raise InputError(f"{name}: found {values.size} values for {arm.links} links, allowed: {arm.links}")
        return Calibration.of(lengths, offsets)

    def _spatial(self, arm: Arm) -> Calibration:
        for name, errors in (("length_errors_mm", self.length_errors), ("joint_offsets_deg", self.joint_offsets)):
            if errors is not None:
                raise InputError(f'{name}: found for a spatial arm, allowed: values = {{"translation_x:2" = 0.5}}')
        before = {} if arm.calibration is None else arm.calibration.values
        geometry = {name: value for name, value in before.items() if GEOMETRY.fullmatch(name)}
        values = geometry if self.values is None else self.values
        allowed = arm.chain.parameters().names if not arm.chain.planar else ()
        for name in values:
            if name not in allowed:
                raise InputError(f"values: unknown parameter {name!r}, {nearest(name, allowed)}")
        return Calibration(values)


@dataclass(frozen=True)
class Fitted:
    """What the fit estimates besides the geometry. None: the arm's own effects."""

    name: str = "arm"
    effects: tuple[EffectSpec, ...] | None = None

    def of(self, arm: Arm) -> Arm:
        """The arm as the fit knows it: nominal."""
        return replace(arm, effects=arm.effects if self.effects is None else self.effects, calibration=None)


@dataclass(frozen=True)
class Study:
    """A Monte Carlo study.

    arms : nominal arms;  runs : numbers of measurements m
    plans : solver names, "dft" (theta_j = 2 pi i j / m), "random" (a new plan for each replication, uniform
        over the allowed postures), or given plans, whose number of runs is fixed
    sigma : standard deviations of the measurement [mm], empty: each arm's own
    truths, models : what is simulated, and what is fitted
    replications : simulated data sets of each cell, done `block` at a time
    solver_seconds : time limit of a solver [s]
    """

    arms: Sequence[Arm]
    plans: Sequence[str | tuple[str, Plan]]
    runs: Sequence[int] = ()
    sigma: Sequence[float] = ()
    truths: Sequence[Truth] = (Truth(),)
    models: Sequence[Fitted] = (Fitted(),)
    replications: int = 10_000
    block: int = 10_000
    solver_seconds: float = 60.0

    def __post_init__(self) -> None:
        """The same limits as in a file, for those who write Python, and all that can be said before work starts."""
        object.__setattr__(self, "arms", [simulated(arm) for arm in self.arms])
        self._check_plans()
        for what, entries in (("truths", self.truths), ("models", self.models), ("arms", self.arms)):
            names = [entry.name for entry in entries]
            if len(set(names)) < len(names):
                raise InputError(f"{what}: name {max(names, key=names.count)!r} is given twice, allowed: once")
        counts = [("replications", self.replications, MOST_REPLICATIONS), ("block", self.block, MOST_BLOCK)]
        for name, value, most in [*counts, *(("runs", runs, MOST_RUNS) for runs in self.runs)]:
            if not (isinstance(value, int | np.integer) and 1 <= value <= most):
                raise InputError(f"{name}: found {value!r}, allowed: a whole number >= 1, at most {most:,}")
        for sigma in self.sigma:
            if not 0.0 < sigma < np.inf:
                raise InputError(f"sigma_mm: found {sigma!r}, allowed: numbers > 0 [mm]")
        if self.replications / self.block > MOST_TASKS:
            least = f"at least {-(-self.replications // MOST_TASKS)} for {self.replications} replications"
            raise InputError(f"block: found {self.block}, allowed: {least}")
        for arm in self.arms:
            if arm.sigma is None and not self.sigma:
                raise InputError(f"sigma_mm: is missing, allowed: numbers > 0 [mm], as arm {arm.name} has none")
            for truth in self.truths:
                _check_entry("truths", truth, arm)
            for fitted in self.models:
                _check_entry("models", fitted, arm)
            for plan in self.plans:
                if not isinstance(plan, str) and plan[1].links != arm.links:
                    allowed = f"{arm.links} as arm {arm.name}"
                    raise InputError(f"plans: {plan[0]} has {plan[1].links} joints, allowed: {allowed}")
        self._check_runs()

    def _check_plans(self) -> None:
        allowed = {*SOLVERS, DFT, RANDOM}
        for plan in self.plans:
            if isinstance(plan, str) and plan not in allowed:
                raise InputError(f"plans: unknown {plan!r}, {nearest(plan, allowed)}, or NAME.csv")
            if isinstance(plan, str) and not self.runs:
                raise InputError(f"runs: is missing, allowed: whole numbers >= 1, as plan {plan!r} needs them")

    def _check_runs(self) -> None:
        """One cell must have as many equations as unknowns; the others are rows that say why there is nothing."""
        sizes = [size for plan in self.plans for size in (self.runs if isinstance(plan, str) else [len(plan[1])])]
        fitted = [Model(without_prior(entry.of(arm))) for arm in self.arms for entry in self.models]
        needs = [(len(model.names), model.dimension * points(model)) for model in fitted]
        unknowns, each = min(needs, key=lambda pair: pair[0] / pair[1], default=(0, 1))
        if sizes and each * max(sizes) < unknowns:
            allowed = f"at least {-(-unknowns // each)} for {unknowns} parameters"
            raise InputError(f"runs: found {max(sizes)}, allowed: {allowed}")


def _check_entry(what: str, entry: Truth | Fitted, arm: Arm) -> None:
    """Whether this arm can have a truth or a model. Raises `InputError`."""
    place = f"{what}: {entry.name} with arm {arm.name}"
    try:
        model = Model(entry.of(arm))
        _ = model.symbols  # raises for an effect that needs what the arm does not have
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    asked = [spec for spec in model.arm.effects if entry.effects is not None or spec.values]  # those without: not there
    scatters = next((spec for spec in asked if library()[spec.name].scatter), None)
    if what == "truths" and scatters is not None:
        no = f"{scatters.key}, which changes the scatter, is not simulated here"
        raise InputError(f"{place}: {no}, allowed: other effects")
    if "temperature" in model.needs:
        raise InputError(f"{what}: {entry.name} needs temperatures, allowed: effects without them")
