"""`diagnose` with a prior: against linear Bayes computed here, and against a fit of everything with the curve moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.optimize import minimize_scalar

from identification.arm import Arm, Calibration, EffectSpec
from identification.arrays import Array
from identification.errors import InputError
from identification.estimation.prior import effective_count
from identification.gap.curves.curve_fit import Basis, Evidence, Posterior
from identification.gap.curves.curves import CurveFit
from identification.gap.diagnose import diagnose
from identification.gap.fits.fit import fit
from identification.gap.fits.whitening import Rows
from identification.gap.library.library_prior import library_prior
from identification.gap.library.prior_fits import held
from identification.gap.result import Diagnosis
from identification.measurements import Measurements
from identification.model import Model

ARM = Arm([300.0, 200.0])
NAMED = EffectSpec("encoder_eccentricity", 2)
SMALL = {"encoder_eccentricity:2.a": 4e-4, "encoder_eccentricity:2.b": -3e-4, "gear_ratio:1.e": 8e-6}
FEW = ["gear_ratio", "encoder_second_harmonic"]


def measured(seed: int, rows: int, effects: bool = True) -> Measurements:
    """Rows of an arm with a small eccentricity at joint 2 and a gear ratio that is not found; sigma 0.01 mm."""
    specs = (NAMED, EffectSpec("gear_ratio", 1)) if effects else ()
    truth = ARM.with_effects(*specs)
    truth = replace(truth, calibration=Calibration.of([0.02, -0.01], [1e-5, 2e-5], SMALL if effects else {}))
    generator = np.random.default_rng(seed)
    postures = generator.uniform(-3.0, 3.0, (rows, 2))
    positions = Model(truth).position(postures, Model(truth).values)
    return Measurements(postures, positions + 0.01 * generator.standard_normal(positions.shape))


DATA, FRESH = measured(0, 30), measured(1, 150)


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    return diagnose(ARM, DATA, FRESH, draws=399, prior=True, missing=FEW)


def likeliest(target: Array, jacobian: Array, deviations: Array) -> tuple[float, float]:
    """Size of all effects, in steps of sqrt(2) up to 1, and noise, of the largest likelihood of residuals (N,) whose
    components along the columns without a deviation are left out."""
    free = deviations == 0.0
    outside = null_space(jacobian[:, free].T)
    left, columns = outside.T @ target, outside.T @ (jacobian * deviations)

    def minus_log(noise: float, size: float) -> float:
        covariance = size**2 * columns @ columns.T + noise**2 * np.eye(len(left))
        return float(np.linalg.slogdet(covariance)[1] + left @ np.linalg.solve(covariance, left))

    noises = {
        2.0 ** (-k / 2.0): minimize_scalar(minus_log, (), (1e-3, 0.1), (2.0 ** (-k / 2.0),), method="bounded")
        for k in range(17)
    }
    best = min(noises, key=lambda size: noises[size].fun)
    return best, noises[best].x


def test_estimates_gap_and_prediction_are_those_of_linear_bayes(found: Diagnosis) -> None:
    """Normal priors at typical sizes, flat ones for the geometry and what is named; all errors small, so linear."""
    assert found.verdict == "named"
    assert found.effects == ("encoder_eccentricity:2",)
    library = library_prior(ARM.with_effects(NAMED), names=FEW)
    model, deviations = library.model, library.prior.deviations
    zero = np.zeros(len(model.names))
    jacobian = model.jacobian(DATA.postures, zero).reshape(-1, len(zero))
    target = (DATA.positions - model.position(DATA.postures, zero)).ravel()
    size, noise = likeliest(target, jacobian, np.array([deviations.get(name, 0.0) for name in model.names]))
    assert found.prior is not None
    assert found.prior.size == pytest.approx(size)
    ratio = noise / size
    precision = np.diag([(ratio / deviations[name]) ** 2 if name in deviations else 0.0 for name in model.names])
    inverse = np.linalg.inv(jacobian.T @ jacobian + precision)
    values = inverse @ jacobian.T @ target
    left = target - jacobian @ values
    freedom = len(left) - np.trace(jacobian @ inverse @ jacobian.T)
    covariance = left @ left / freedom * inverse
    place = [model.names.index(p.name) for p in found.named.parameters]
    units = np.array([model.parameters[k].to_file for k in place])
    assert [p.value for p in found.named.parameters] == pytest.approx(values[place] * units, rel=5e-3)
    assert [p.std for p in found.named.parameters] == pytest.approx(
        np.sqrt(np.diag(covariance))[place] * units, rel=5e-3
    )
    assert found.gap.rms_after == pytest.approx(np.sqrt(left @ left / len(DATA)), rel=5e-3)
    there = model.jacobian(FRESH.postures, zero).reshape(-1, len(zero))
    away = (FRESH.positions - model.position(FRESH.postures, zero)).ravel() - there @ values
    assert found.gap.held_out_after == pytest.approx(np.sqrt(away @ away / len(FRESH)), rel=5e-3)
    uncertain = np.trace(there @ covariance @ there.T) / len(FRESH)
    expected = np.sqrt(2.0 * left @ left / round(freedom) + uncertain)
    assert found.gap.predicted == pytest.approx(expected, rel=2e-2)  # and what the choice made again adds
    plain = diagnose(ARM, DATA, FRESH, draws=399)
    assert found.gap.rms_before == plain.gap.rms_before
    assert found.probability == plain.probability


def test_the_extended_arm_has_everything_and_intervals_of_what_is_named(found: Diagnosis) -> None:
    wide = found.extended_arm()
    assert {spec.name for spec in wide.effects} == {"encoder_eccentricity", *FEW}
    computed = Model(wide).position(FRESH.postures, Model(wide).values)
    assert np.sqrt(np.mean(np.sum((FRESH.positions - computed) ** 2, axis=1))) == found.gap.held_out_after
    own = found.calibration.parameter_names
    assert [name for name in own if ":" in name and "." in name] == list(SMALL)[:2]
    assert len(found.named.freedom) == len(own)
    assert {name.partition(":")[0] for name in found.to_json()["prior"]["effects"]} == set(FEW)


def test_nothing_named_has_nothing_to_shrink() -> None:
    found = diagnose(ARM, measured(2, 20, effects=False), measured(3, 60, effects=False), draws=399, prior=True)
    assert found.verdict == "none"
    assert found.confirmation is not None
    assert not found.confirmation.named
    assert found.confirmed is not False


def test_no_room_for_more_changes_nothing() -> None:
    """Of data without any effect the likeliest size is 0, or small; then files and figures are those without."""
    sizes = []
    for seed in (200, 201, 202, 203):
        rows = measured(seed, 20, effects=False)
        plain = fit(Model(ARM), Rows.of(rows))
        wide, library = held(plain, rows, ["encoder_eccentricity"])
        sizes.append(library.size)
        if library.size == 0.0:
            assert wide is plain
            assert not library.added
    assert 0.0 in sizes
    assert max(sizes) < 0.1


def test_names_are_checked_before_the_search() -> None:
    with pytest.raises(InputError, match="unknown name 'gear'"):
        diagnose(ARM, DATA, draws=399, prior=True, missing=["gear"])


def test_a_curve_keeps_its_values_and_moves_the_rest() -> None:
    """Derivative of all other estimates by the curve: against a fit beside a curve that is a tenth larger."""
    basis = Basis.of(DATA.postures[:, 0], 0, 1.0)
    coefficients = np.random.default_rng(0).normal(size=basis.count) * 1e-4

    def curve(size: float) -> EffectSpec:
        return EffectSpec("joint_error_curve", 1, curve=basis.curve(size * coefficients))

    rows = Rows.of(DATA)
    plain = fit(Model(ARM.with_effects(curve(1.0))), rows)
    posterior = Posterior(coefficients, np.full(basis.count, 1e-12), 1.0, np.zeros((1, basis.count)), 0.0)
    evidence = Evidence(0.0, np.zeros(2), posterior, np.ones(basis.count), 1.5, 0.0)
    response = np.zeros((len(plain.values), basis.count))
    wide, library = held(CurveFit.of(plain, (basis,), evidence, response), DATA)
    assert isinstance(wide, CurveFit)
    assert library.left_out["encoder_eccentricity:1"] == "its joint has an error curve"
    assert "encoder_eccentricity:2" in library.effects
    first = next(name for name in wide.model.names if name in library.prior.deviations)
    assert wide.prior_rows is not None
    noise = wide.prior_rows[0, wide.model.names.index(first)] * library.prior.deviations[first]
    larger = Model(ARM.with_effects(curve(1.1), *library.added))
    moved = fit(larger, rows, wide.by_name, prior=library.prior, noise=noise).values - wide.values
    expected = wide.response @ (0.1 * coefficients)
    assert np.abs(moved - expected).max() <= 0.02 * np.abs(expected).max()
    assert wide.effective == pytest.approx(effective_count(wide.triangle, wide.prior_rows) + 1.5)
