"""Every figure that README.md and identification/README.md quote of two sessions of a real robot, a UR10.

Run it with -s; the planar part takes a few minutes of one core, the diagnoses in space (`-k space`) a few more. Series
A and C, whole, are looked for in ../shared/data beside the checkout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec
from identification.estimation import Identification, estimate, estimate_with_prior
from identification.files.arm import load_arm
from identification.gap.confirmation import split
from identification.gap.diagnose import diagnose
from identification.gap.library_prior import given_by, library_prior
from identification.measurements import Measurements, load_measurements
from identification.model import Model
from identification.model.placed import placed_model
from identification.validate import validate

SHARED = Path(__file__).parents[3] / "shared/data"
PLANAR = {"A": SHARED / "ur10_planar/series_A.csv", "C": SHARED / "ur10_planar/measurements.csv"}
SPATIAL = {name: SHARED / f"ur10/series_{name}.csv" for name in "AC"}
LENGTHS = np.array([612.0, 572.3, 115.7])
ARM = Arm(LENGTHS, effects=(EffectSpec("base_offset"),), name="ur10")
SPACE = Path(__file__).parents[1] / "data/ur10/ur10.toml"
BOTH = pytest.mark.parametrize("series", ["A", "C"])
ACROSS = pytest.mark.parametrize(("series", "other"), [("A", "C"), ("C", "A")])

pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.filterwarnings("ignore"),  # columns that are not used
    pytest.mark.skipif(not PLANAR["A"].exists(), reason="the UR10 measurements are not in ../shared/data"),
]


def rms(model: Model, parameters: np.ndarray, rows: Measurements) -> float:
    """RMS distance [mm] between positions measured and computed."""
    missed = rows.positions - model.position(rows.postures, parameters, rows.conditions)
    return float(np.sqrt(np.mean(np.sum(missed**2, axis=1))))


def without_parts(arm: Arm) -> Arm:
    """With the geometry everywhere as it was fitted beside curves, which end one by one."""
    bare = (replace(s, curve=replace(s.curve, geometry={})) if s.curve else s for s in arm.effects)
    return arm.with_effects(*bare)


def halves(data: Measurements) -> tuple[Measurements, Measurements]:
    """Random halves of the postures, each with all rows of its postures."""
    return split(data, 0.5, np.random.default_rng(0))


def first_half(data: Measurements) -> tuple[Measurements, Measurements]:
    """By the order of measurement."""
    early = np.zeros(len(data), dtype=bool)
    early[data.sequence[: len(data) // 2]] = True
    return data.rows(early), data.rows(~early)


def shown_diagnosis(name: str, arm: Arm, parts: tuple[Measurements, Measurements]) -> float:
    """RMS [mm] on the second part of what `diagnose` finds in the first."""
    found = diagnose(arm, parts[0], parts[1])
    gap, names = found.gap, ", ".join(found.effects) or "none"
    assert gap.held_out_after is not None
    assert gap.predicted is not None
    print(f"\n{name}: {gap.held_out_before:.3f} -> {gap.held_out_after:.3f} mm, predicted {gap.predicted:.3f}", end="")
    print(f", confirmed: {found.confirmed}; verdict {found.verdict}, named {names}, curves {len(found.curves)}")
    return gap.held_out_after


@BOTH
@pytest.mark.parametrize("parted", [halves, first_half])
def test_plane_held_out(series: str, parted: Callable[[Measurements], tuple[Measurements, Measurements]]) -> None:
    """Geometry with and without base offset, and with what `diagnose` finds."""
    parts = parted(load_measurements(PLANAR[series], 3))
    for arm in (Arm(LENGTHS), ARM):
        fit = estimate(Model(arm), parts[0])
        left = rms(fit.model, fit.parameters, parts[1])
        print(f"\nplane, {series}, {parted.__name__}, {len(arm.effects)} base offset: {left:.3f} mm", end="")
    assert shown_diagnosis(f"plane, {series}, {parted.__name__}, diagnose", ARM, parts) < left


@ACROSS
def test_plane_to_the_other_session(series: str, other: str) -> None:
    """As `armcal diagnose --out` and `armcal validate --refit base`."""
    data, there = (load_measurements(PLANAR[name], 3) for name in (series, other))
    geometry = validate(estimate(Model(ARM), data).calibrated_arm(), there)
    with_effects = validate(diagnose(ARM, data).extended_arm(), there)
    own = estimate(Model(ARM), there)
    print(
        f"\nplane, {series} -> {other}: drawing {geometry.nominal.rms:.3f}, geometry {geometry.model.rms:.3f}", end=""
    )
    fitted = rms(own.model, own.parameters, there)
    prior = validate(library_fit(ARM, data).calibrated_arm(), there).model.rms
    print(f", with what diagnose found {with_effects.model.rms:.3f}, library as a prior {prior:.3f}", end="")
    print(f"; geometry fitted there {fitted:.3f} mm")
    assert with_effects.model.rms < geometry.model.rms


@BOTH
def test_space_held_out(series: str) -> None:
    """Geometry held by the prior of its machining; the drawing with base and reflector alone."""
    arm = load_arm(SPACE)
    data, rest = halves(load_measurements(SPATIAL[series], arm))
    fit = estimate(Model(arm), data)
    drawing = validate(fit.calibrated_arm(), rest).nominal.rms
    left = rms(fit.model, fit.parameters, rest)
    print(f"\nspace, {series}, halves: geometry {left:.3f}, drawing with base and reflector {drawing:.3f} mm", end="")
    assert left < 0.6 * drawing


@BOTH
def test_space_poses_held_out(series: str, tmp_path: Path) -> None:
    """Orientations beside points: RMS angle of the geometry, and of the drawing with base and reflector's frame."""
    file = tmp_path / "poses.toml"
    file.write_text(SPACE.read_text() + "\n[measurement]\nsigma_mm = 0.05\nsigma_deg = 0.01\n")
    arm = load_arm(file)
    assert arm.chain is not None
    assert arm.chain.angle_scale is not None
    data, rest = halves(load_measurements(SPATIAL[series], arm))
    found = validate(estimate(Model(arm), data).calibrated_arm(), rest)
    for name, residuals in (("geometry", found.residuals), ("drawing", found.nominal_residuals)):
        points, turns = np.sqrt(np.mean(np.sum(residuals.reshape(-1, 2, 3) ** 2, axis=2), axis=0))
        degrees = np.degrees(turns / arm.chain.angle_scale)
        print(f"\nspace, {series}, poses, {name}: {points:.3f} mm, {degrees:.3f} deg", end="")


@ACROSS
def test_space_to_the_other_session(series: str, other: str) -> None:
    """As `armcal identify` or `diagnose --out` and `armcal validate`: only base and reflector are found anew."""
    arm = load_arm(SPACE)
    data, there = (load_measurements(SPATIAL[name], arm) for name in (series, other))
    found = validate(estimate(Model(arm), data).calibrated_arm(), there)
    extended = diagnose(arm, data).extended_arm()
    with_curves, as_fitted = (validate(each, there).model.rms for each in (extended, without_parts(extended)))
    print(f"\nspace, {series} -> {other}: geometry {found.model.rms:.3f}, drawing {found.nominal.rms:.3f}", end="")
    print(f", with what diagnose found {with_curves:.3f}, with the geometry as it was fitted {as_fitted:.3f} mm")
    assert with_curves < found.model.rms < found.nominal.rms


@BOTH
def test_space_held_out_with_diagnose(series: str) -> None:
    arm = load_arm(SPACE)
    parts = halves(load_measurements(SPATIAL[series], arm))
    assert shown_diagnosis(f"space, {series}, halves, diagnose", arm, parts) < 0.2


def linearized(arm: Arm, data: Measurements) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N,) residuals of the drawing and (N, g) columns of the joints' errors, per row, both less what base and
    reflector explain, and (g,) the machining's sizes."""
    model = placed_model(Model(arm), data)
    zero, names = np.zeros(len(model.names)), np.array(model.names)
    own = ~np.char.startswith(names, "base") & ~np.char.startswith(names, "tool")
    jacobian = model.jacobian(data.postures, zero).reshape(-1, len(names)) / np.sqrt(len(data))
    residual = (data.positions - model.position(data.postures, zero)).ravel() / np.sqrt(len(data))
    place = np.linalg.qr(jacobian[:, ~own])[0]
    off = (each - place @ (place.T @ each) for each in (residual, jacobian[:, own]))
    return *off, model.parameters.vector(model.prior, 0.0)[own]


def test_space_geometry_of_both_sessions() -> None:
    """One geometry for both fits both; those of each differ from it where the session itself hardly shows it."""
    arm = load_arm(SPACE)
    parts = {name: linearized(arm, load_measurements(SPATIAL[name], arm)) for name in "AC"}

    def fitted(names: str) -> np.ndarray:
        rows = [(1e-3 * np.diag(1.0 / parts["A"][2]), np.zeros(len(parts["A"][2])))]  # far below what the data say
        rows += [(parts[name][1], parts[name][0]) for name in names]
        return np.linalg.lstsq(*(np.concatenate(each) for each in zip(*rows, strict=True)), rcond=None)[0]

    both = fitted("AC")
    for name in "AC":
        residual, columns, _ = parts[name]
        left = [np.linalg.norm(residual - columns @ found) for found in (both, fitted(name))]
        print(f"\nin {name}: geometry of both {left[0]:.3f}, its own {left[1]:.3f} mm", end="")
        moved = {other: np.linalg.norm(columns @ (fitted(other) - both)) for other in "AC"}
        print(f"; less that of both, the one of A moves points here by {moved['A']:.3f}, of C by {moved['C']:.3f} mm")
    assert all(np.linalg.norm(parts[n][0] - parts[n][1] @ both) < 0.6 * np.linalg.norm(parts[n][0]) for n in "AC")


def library_fit(arm: Arm, rows: Measurements) -> Identification:
    """As `armcal identify --library-prior`."""
    library = library_prior(arm, given_by(rows))
    return estimate_with_prior(library.model, rows, library.prior)


@ACROSS
def test_space_with_the_library_as_a_prior(series: str, other: str) -> None:
    """Held-out halves, and the other session with base and reflector found anew."""
    arm = load_arm(SPACE)
    data, there = (load_measurements(SPATIAL[name], arm) for name in (series, other))
    parts = halves(data)
    half, whole = library_fit(arm, parts[0]), library_fit(arm, data)
    assert whole.prior is not None
    print(f"\nspace, {series}, library as a prior", end="")
    print(f": held out {rms(half.model, half.parameters, parts[1]):.3f} mm", end="")
    found = validate(whole.calibrated_arm(), there)
    print(f"; {series} -> {other}: {found.model.rms:.3f}, drawing {found.nominal.rms:.3f} mm")
    assert found.model.rms < found.nominal.rms


@BOTH
def test_space_other_angles_of_one_session(series: str) -> None:
    """A third of 1,500 rows, where joint 1 is low, in the middle or high, and the rest predicted: plain geometry, and
    the library as a prior."""
    arm, ratios = load_arm(SPACE), []
    data = load_measurements(SPATIAL[series], arm)
    data = data.rows(np.sort(np.random.default_rng(0).permutation(len(data))[:1500]))
    order = np.argsort(np.mod(data.postures[:, 0] - (0.0 if series == "C" else np.pi), 2.0 * np.pi))
    for third in np.array_split(order, 3):
        inside = np.isin(np.arange(len(data)), third)
        here, there = data.rows(inside), data.rows(~inside)
        fits = (estimate(Model(arm), here), library_fit(arm, here))
        plain, prior = (validate(fit.calibrated_arm(), there).model.rms for fit in fits)
        ratios.append(prior / plain)
        print(f"\n{series}: geometry {plain:.3f}, library as a prior {prior:.3f} mm", end="")
    print(f"\n{series}: geometric mean {np.exp(np.mean(np.log(ratios))):.2f}, worst {max(ratios):.2f}")
    assert np.mean(np.log(ratios)) < 0.0
