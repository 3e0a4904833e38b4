"""Every figure that the READMEs quote of two sessions of a real robot, a UR10: `pytest -m benchmark -s` with this file.

Some minutes of one core each. Series A and C, whole, are looked for in ../shared/data beside the checkout.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from doe import DesignProblem, solve
from doe.bounds.certificate import Bound
from doe.plan.accuracy import robust_problem, tip_beside_random
from identification import Arm, Array, EffectSpec, Identification, Model, diagnose, estimate, load_arm
from identification.files.measurement import load_measurements
from identification.gap.library_prior import library_prior
from identification.measurements import Measurements
from identification.validate import validate

SHARED = Path(__file__).parents[3] / "shared/data"
PLANAR = {"A": SHARED / "ur10_planar/series_A.csv", "C": SHARED / "ur10_planar/measurements.csv"}
SPATIAL = {name: SHARED / f"ur10/series_{name}.csv" for name in "AC"}
ARM = Arm(np.array([612.0, 572.3, 115.7]), effects=(EffectSpec("base_offset"),), name="ur10")
SPACE = Path(__file__).parents[1] / "data/ur10/ur10.toml"
BOTH = pytest.mark.parametrize("series", ["A", "C"])

pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.filterwarnings("ignore"),  # columns that are not used
    pytest.mark.skipif(not PLANAR["A"].exists(), reason="the UR10 measurements are not in ../shared/data"),
]


def rms(missed: Array) -> float:
    """RMS distance [mm] of (N, d)."""
    return float(np.sqrt(np.mean(np.sum(missed**2, axis=1))))


def left(fit: Identification, rows: Measurements) -> float:
    """RMS distance [mm] between positions measured and computed."""
    return rms(rows.positions - fit.model.position(rows.postures, fit.parameters, rows.conditions))


def library_fit(arm: Arm, rows: Measurements) -> Identification:
    """As `armcal identify --library-prior`."""
    library = library_prior(arm, rows)
    return estimate(Model(library.arm), rows, prior=library.prior)


def halves(data: Measurements) -> tuple[Measurements, Measurements]:
    """Random halves of the postures, each with all rows of its postures."""
    numbers = data.posture_numbers
    counts = np.bincount(numbers)
    order = np.random.default_rng(0).permutation(len(counts))
    held_out = np.isin(numbers, order[: np.searchsorted(np.cumsum(counts[order]), 0.5 * len(numbers)) + 1])
    if data.order is None:  # the halves know when in the session they were measured
        data = replace(data, order=np.arange(len(numbers), dtype=float))
    return data.rows(~held_out), data.rows(held_out)


def first_half(data: Measurements) -> tuple[Measurements, Measurements]:
    """By the order of measurement."""
    early = np.zeros(len(data), dtype=bool)
    early[data.sequence[: len(data) // 2]] = True
    return data.rows(early), data.rows(~early)


def shown_diagnosis(arm: Arm, parts: tuple[Measurements, Measurements]) -> float:
    """RMS [mm] on the second part of what `diagnose` finds in the first."""
    diagnosis = diagnose(arm, *parts)
    gap, names = diagnosis.gap, ", ".join(diagnosis.effects) or "none"
    print(f"\ndiagnose: {gap.held_out_before:.3f} -> {gap.held_out_after:.3f} mm, expected {gap.predicted:.3f}", end="")
    print(f", confirmed: {diagnosis.confirmed}; {diagnosis.verdict}, {names}, {len(diagnosis.curves)} curves", end="")
    return float(gap.held_out_after or np.inf)


# -- held-out rows, and the other session ------------------------------------------------------------------------------
@BOTH
@pytest.mark.parametrize("parted", [halves, first_half])
def test_plane_held_out(series: str, parted: Callable[[Measurements], tuple[Measurements, Measurements]]) -> None:
    """Geometry with and without base offset, and with what `diagnose` finds."""
    parts = parted(load_measurements(PLANAR[series], 3))
    plain, offset = (left(estimate(Model(arm), parts[0]), parts[1]) for arm in (ARM.with_effects(), ARM))
    print(f"\nplane, {series}, {parted.__name__}: geometry {plain:.3f}, with base offset {offset:.3f} mm", end="")
    assert shown_diagnosis(ARM, parts) < offset


@BOTH
def test_space_held_out(series: str, tmp_path: Path) -> None:
    """Geometry held by the prior of its machining, the drawing with base and reflector alone, and what `diagnose`
    finds; with orientations beside points the RMS angle of both."""
    arm = load_arm(SPACE)
    parts = halves(load_measurements(SPATIAL[series], arm))
    fit = estimate(Model(arm), parts[0])
    drawing, geometry = validate(fit.calibrated_arm(), parts[1]).nominal.rms, left(fit, parts[1])
    print(f"\nspace, {series}, halves: geometry {geometry:.3f}, drawing, base and reflector {drawing:.3f} mm", end="")
    assert geometry < 0.6 * drawing
    assert shown_diagnosis(arm, parts) < 0.2
    file = tmp_path / "poses.toml"
    file.write_text(SPACE.read_text() + "\n[measurement]\nsigma_mm = 0.05\nsigma_deg = 0.01\n")
    arm = load_arm(file)
    parts = halves(load_measurements(SPATIAL[series], arm))
    poses = validate(estimate(Model(arm), parts[0]).calibrated_arm(), parts[1])
    for name, residuals in (("geometry", poses.residuals), ("drawing", poses.nominal_residuals)):
        points, turns = (rms(part) for part in residuals.reshape(-1, 2, 3).transpose(1, 0, 2))
        degrees = np.degrees(turns / arm.chain.angle_scale)
        print(f"\nspace, {series}, poses, {name}: {points:.3f} mm, {degrees:.3f} deg", end="")


@pytest.mark.parametrize("where", [PLANAR, SPATIAL], ids=["plane", "space"])
@pytest.mark.parametrize(("series", "other"), [("A", "C"), ("C", "A")])
def test_to_the_other_session(where: dict[str, Path], series: str, other: str) -> None:
    """As `armcal identify` or `diagnose --out` and `armcal validate`: only base and reflector are found anew."""
    arm = ARM if where is PLANAR else load_arm(SPACE)
    data, there = (load_measurements(where[name], arm if where is SPATIAL else 3) for name in (series, other))
    geometry, extended = estimate(Model(arm), data).calibrated_arm(), diagnose(arm, data).extended_arm()
    bare = (replace(s, curve=replace(s.curve, geometry={})) if s.curve else s for s in extended.effects)
    library = library_fit(arm, data).calibrated_arm()
    arms = {"geometry": geometry, "with what diagnose found": extended, "library as a prior": library}
    arms["with the geometry as it was fitted"] = extended.with_effects(*bare)
    errors = {name: validate(each, there).model.rms for name, each in arms.items()}
    errors["drawing"] = drawing = validate(geometry, there).nominal.rms
    errors["geometry fitted there"] = left(estimate(Model(arm), there), there)
    print(f"\n{series} -> {other} [mm]: {', '.join(f'{name} {error:.3f}' for name, error in errors.items())}", end="")
    assert where is PLANAR or max(errors["geometry"], errors["library as a prior"]) < drawing
    if errors["with what diagnose found"] >= errors["geometry"]:
        pytest.xfail("asked, and not so between these sessions (README.md, Limitations)")


def rows_of(data: Measurements, postures: Array) -> Array:
    """The rows with these postures."""
    distance = np.abs(data.postures[:, None] - postures).max(axis=-1)
    rows = distance.argmin(axis=0)
    assert distance.min(axis=0).max() < 1e-9  # it chose from the list
    assert len(set(rows.tolist())) == len(postures)
    return rows


SHEET = replace(ARM, sigma=0.1)  # [mm], the repeatability of its data sheet


class LinearFits:
    """Fits of some rows, linear about the fit of all rows without effects: positions = J (free, effects) + noise.

    residual : (N, 2) of that fit [mm];  rows : (N, 2, p + e) Jacobian, effects times their sizes;  free : p
    """

    noises = np.geomspace(1.0, 30.0, 300) * 0.1  # [mm] tried: the data sheet's repeatability and more

    def __init__(self, data: Measurements, *, prior: bool = True) -> None:
        plain, library = estimate(Model(SHEET), data), library_prior(SHEET, data)
        model = Model(library.arm)
        sizes = model.parameters.vector(library.prior.deviations)
        values = model.parameters.vector(plain.model.parameters.mapping(plain.parameters))
        jacobian = model.jacobian(data.postures, values, data.conditions)
        free, effects = jacobian[..., sizes == 0.0], (jacobian * sizes)[..., sizes > 0.0]
        self.residual, self.free = plain.residuals_after, free.shape[2]
        self.rows = np.concatenate([free, effects] if prior else [free], axis=2)

    def fitted(self, chosen: Array) -> Array:
        """(p + e,) the mode of the posterior with the noise of the largest marginal likelihood (restricted, REML)."""
        y, rows = self.residual[chosen].ravel(), self.rows[chosen].reshape(2 * len(chosen), -1)
        x, z = rows[:, : self.free], rows[:, self.free :]
        if not z.shape[1]:
            return np.linalg.lstsq(x, y, rcond=None)[0]
        beside = np.linalg.svd(x)[0][:, self.free :]  # what the free parameters cannot explain
        values, vectors = np.linalg.eigh(beside.T @ z @ z.T @ beside)
        variance = np.maximum(values, 0.0) + self.noises[:, None] ** 2
        best = np.argmin(np.sum(np.log(variance) + (vectors.T @ beside.T @ y) ** 2 / variance, axis=1))
        covariance = z @ z.T + self.noises[best] ** 2 * np.eye(len(y))
        whitened = np.linalg.solve(covariance, x)
        free = np.linalg.solve(x.T @ whitened, whitened.T @ y)
        return np.r_[free, z.T @ np.linalg.solve(covariance, y - x @ free)]

    def error(self, chosen: Array) -> float:
        """RMS distance on the rows that are not chosen [mm]."""
        return rms(np.delete(self.residual - self.rows @ self.fitted(chosen), chosen, axis=0))


def test_linear_fits_are_those_of_identify() -> None:
    """`estimate` with a prior on three random choices: the same error on the other rows to a thousandth."""
    data, generator = load_measurements(PLANAR["C"], 3), np.random.default_rng(0)
    fits = LinearFits(data)
    for _ in range(3):
        chosen = generator.choice(len(data), 20, replace=False)
        fit = library_fit(SHEET, data.rows(chosen))
        missed = data.positions - fit.model.position(data.postures, fit.parameters, data.conditions)
        assert rms(np.delete(missed, chosen, axis=0)) == pytest.approx(fits.error(chosen), rel=1e-3)


@pytest.mark.parametrize("runs", [20, 30, 50])
@BOTH
def test_chosen_with_the_library_in_mind(series: str, runs: int) -> None:
    """Do postures chosen for what a model may lack predict the others better than random ones? Of 1,387 of the 2,773
    postures of C, or 1,500 of the 11,911 of A, against 100 random choices of all, each fitted in the same way: geometry
    and base offset free, all effects of the library with their prior, the noise estimated. Plans of six starts each, as
    plans of nearly the same criterion differ on one robot. Table in doe/README.md, "Robust designs"."""
    data = load_measurements(PLANAR[series], 3)
    offered = data.postures[np.sort(np.random.default_rng(4).permutation(len(data))[:3000])[::2]]
    generator, fits = np.random.default_rng(0), (LinearFits(data), LinearFits(data, prior=False))
    random = [generator.choice(len(data), runs, replace=False) for _ in range(100)]
    errors = [np.array([fit.error(rows) for rows in random]) for fit in fits]
    held, least = (np.median(each) for each in errors)
    print(f"\n{series}, {runs} of {len(data)}: random with the prior {held:.3f}, least squares {least:.3f} mm", end="")
    plain = DesignProblem.of(Model(SHEET), choices=offered)
    for name, case in (("robust", robust_problem(plain)), ("D", plain)):
        way, nothing = (0 if case.fit else 1), Bound(np.inf, "continuous")  # none is computed
        plans = [solve(case, runs, seed=seed, starts=1, bound=nothing).plan.postures for seed in range(6)]
        promised = [said["plan_mm"] for plan in plans if (said := tip_beside_random(case, plan)[0])]
        reached = [fits[way].error(rows_of(data, plan)) for plan in plans]
        better = [np.mean(errors[way] > error) for error in reached]
        print(f"; {name} {np.mean(reached):.3f} mm, better than {np.mean(better):.2f}", end="")
        print(f" ({min(better):.2f} to {max(better):.2f}), promised {np.mean(promised):.3f}", end="")
        assert name == "D" or np.mean(better) > 0.5
