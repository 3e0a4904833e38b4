"""What few rows can say: counted by hand, and the error of the tip against the covariance written with matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification import Arm, DHRow, Measurements, Model, chain_of, estimate
from identification.gap.library_prior import library_prior
from identification.gap.noise import NoiseFloor
from identification.inspection.inspection import inspect, sufficiency

LENGTHS = np.array([500.0, 400.0])
NOISE = 0.05
# two links, a length and a zero for each: 4 unknowns
ARM = Arm(LENGTHS, lower=np.full(2, -2.0), upper=np.full(2, 2.0))


def rows(m: int) -> Measurements:
    generator = np.random.default_rng(31)
    q = generator.uniform(-2.0, 2.0, (m, 2))
    z = np.exp(1j * np.cumsum(q, axis=1)) @ (LENGTHS + 0.3)
    z += NOISE * (generator.standard_normal(m) + 1j * generator.standard_normal(m))
    return Measurements(q, np.column_stack([z.real, z.imag]))


def expected(measured: Measurements, sigma: float) -> float:
    """[mm] RMS over the joint limits: with the links as complex unknowns the tip is linear in them."""
    columns, poses = (
        np.exp(1j * np.cumsum(q, axis=1))
        for q in (measured.postures, np.random.default_rng(2).uniform(-2.0, 2.0, (20000, 2)))
    )
    covariance = 2.0 * sigma**2 * np.linalg.inv(columns.conj().T @ columns)  # of the complex unknowns
    return float(np.sqrt(np.mean(np.einsum("mi,ij,mj->m", poses, covariance, poses.conj()).real)))


def test_with_few_rows_the_noise_is_the_one_given_or_that_of_repeats() -> None:
    """3 rows leave 2 numbers, which say next to nothing of the noise; 60 rows say it by their residuals."""
    measured, many = rows(3), rows(60)
    known, unknown = (estimate(Model(replace(ARM, sigma=sigma)), measured) for sigma in (NOISE, None))
    given, words, few = sufficiency(known, measured, NoiseFloor())
    assert (given["numbers"], given["parameters"], given["spare_numbers"], few) == (6, 4, 2, True)
    assert words[0][1] == "6 numbers for 4 parameters: 2 left to judge the fit"
    assert given["identifiable"] == ("length of links 1 and 2", "zero of joints 1 and 2")
    repeats = sufficiency(unknown, measured, NoiseFloor(repeats=0.2 * np.sqrt(2.0)))[0]
    fit = estimate(Model(ARM), many)
    left, _, few = sufficiency(fit, many, NoiseFloor())
    assert (left["spare_numbers"], few) == (116, False)
    for keys, source, data, sigma in (
        (given, "sigma", measured, NOISE),
        (repeats, "repeats", measured, 0.2),
        (left, "residuals", many, fit.scatter),
    ):
        assert keys["expected_tip_from"] == source
        assert keys["expected_tip_mm"] == pytest.approx(expected(data, sigma), rel=0.03)  # by 1000 poses, not 20000
    nothing, words, _ = sufficiency(unknown, measured, NoiseFloor())
    assert (nothing["expected_tip_mm"], nothing["expected_tip_from"]) == (None, None)
    assert str(dict(words)["accuracy"]).startswith("not known: needs sigma_mm")


def test_what_is_not_determined_is_listed() -> None:
    """Joint 2 at rest: both links are one stick, whose parts nothing tells."""
    measured = rows(6)
    still = replace(measured, postures=measured.postures * [1.0, 0.0])
    found, words, _ = sufficiency(estimate(Model(replace(ARM, sigma=NOISE)), still), still, NoiseFloor())
    assert (found["identifiable"], found["expected_tip_mm"]) == ((), None)
    assert dict(words)["accuracy"] == "not known: something is not determined"
    assert len(str(dict(words)["does not"]).split("; ")) == 2


def test_what_only_tilts_tell_apart_is_determined_weakly() -> None:
    """All axes upright: the heights of base and reflector move the tip alike. Their sum is known but for the heights of
    joints 2 and 3 between them, 1 mm each by [machining]; each alone is not known at all."""
    chain = chain_of([DHRow(325.0, 0.0, 300.0), DHRow(275.0, 0.0, 0.0), DHRow(0.0, 0.0, 50.0)])
    generator = np.random.default_rng(4)
    q = generator.uniform(-2.0, 2.0, (40, 3))
    flat = np.exp(1j * np.cumsum(q, axis=1)) @ np.array([325.0, 275.0, 40.0 + 10.0j])
    positions = np.column_stack([flat.real, flat.imag, np.full(40, 410.0)]) + NOISE * generator.standard_normal((40, 3))
    measured = Measurements(q, positions)
    found = estimate(Model(Arm(chain, sigma=NOISE)), measured)
    seen = sufficiency(found, measured, NoiseFloor())[0]
    assert [row["name"] for row in seen["weakly_determined"]] == ["base.z", "tool[1].z"]
    assert seen["identifiable"][:2] == ("base (x, y, rx, ry, rz)", "tool[1] (x, y)")
    rows = seen["weakly_determined"]
    heights = [found.names.index(row["name"]) for row in rows]
    assert [(row["std"], row["unit"]) for row in rows] == [(pytest.approx(found.std[k]), "mm") for k in heights]
    assert min(row["std"] for row in rows) > 100.0
    together = np.sqrt(found.covariance[np.ix_(heights, heights)].sum())
    assert together < 2.0 * np.sqrt(2.0)


def test_what_a_prior_held_is_left_out() -> None:
    """A file of `identify --library-prior` has values of more effects than few rows determine: the drawing's fit."""
    arm, measured = replace(ARM, sigma=NOISE), rows(8)
    library = library_prior(arm)
    fit = estimate(Model(library.arm), measured, prior=library.prior)
    assert len(fit.names) > measured.positions.size
    kept = fit.calibration().about(set(fit.names) - set(library.prior.deviations))
    seen = inspect(replace(library.arm, calibration=kept), measured).to_json()
    alone = inspect(arm, measured).to_json()
    assert seen["problems"] == alone["problems"] == ()
    count = f"{len(library.prior.deviations)} values of effects, which a prior held where they were identified"
    assert any(note.startswith(count) for note in seen["notes"])
    assert seen["rms_fitted_mm"] == pytest.approx(alone["rms_fitted_mm"], rel=1e-6)
