"""Many data sets, on one plan or each on its own, against one fit at a time, which `test_problem` has against scipy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification import EffectSpec, InputError, JobError, Measurements, Model, estimate, estimate_batch
from identification.levenberg_marquardt import Solution
from identification.model.minimal import minimal
from tests.doe.six_axis import CHAIN, SIX_AXIS
from tests.identification.estimation.cases import SIGMA, arm, plan, truth

EFFECTS = {
    "closed form": (),
    "base offset": (EffectSpec("base_offset"),),
    "eccentricity": (EffectSpec("encoder_eccentricity", 2),),
    "two": (EffectSpec("encoder_eccentricity", 2), EffectSpec("gear_ratio", 3)),
    "bounded": (EffectSpec("joint_compliance"),),
    "drift": (EffectSpec("base_drift"), EffectSpec("backlash", 3)),
}


def batch(model: Model, postures: np.ndarray, count: int, spread: float, seed: int = 3) -> np.ndarray:
    """(count, m, 2) measurements of arms that differ by the share `spread` of the truth."""
    generator = np.random.default_rng(seed)
    varied = truth(model) * (1.0 + spread * generator.standard_normal((count, len(model.names))))
    varied = np.maximum(varied, [p.lower for p in model.parameters])
    empty = Measurements(postures, np.zeros((len(postures), 2)))
    exact = model.position(postures, varied, empty.conditions)
    return exact + SIGMA * generator.standard_normal(exact.shape)


def same(model: Model, fits: Solution, rows: dict[int, Measurements]) -> None:
    """Fits of these numbers are those of the rows alone."""
    assert fits.converged.all()
    for k, data in rows.items():
        single = estimate(model, data)
        scaled = fits.parameters[k] * model.scales  # mm; a standard deviation is 0.03
        np.testing.assert_allclose(scaled, single.parameters * model.scales, rtol=0, atol=1e-7)
        left = np.sum(single.residuals_after**2) if single.chi2 is None else single.chi2
        assert fits.rss[k] == pytest.approx(left, rel=1e-10)


@pytest.mark.parametrize(("name", "spread"), [(name, 2.0 * (k % 2)) for k, name in enumerate(EFFECTS)])
def test_equals_single_fits(name: str, spread: float) -> None:
    model, postures = Model(arm(*EFFECTS[name])), plan(30)
    positions = batch(model, postures, 700, spread)  # more than one chunk
    rows = {k: Measurements(postures, positions[k]) for k in (0, 1, 2, 697, 698, 699)}
    same(model, estimate_batch(model, postures, positions), rows)


@pytest.mark.parametrize("held", [True, False], ids=["prior", "minimal"])
def test_spatial_arms_equal_single_fits(held: bool) -> None:
    """Held by the prior of its machining, or a minimal set; where the arm stands is known roughly."""
    chain = replace(CHAIN, settled=frozenset({"base", "tool"}))
    model = Model(replace(SIX_AXIS, chain=chain)) if held else minimal(Model(replace(SIX_AXIS, chain=chain)))
    generator = np.random.default_rng(4)
    postures = generator.uniform(SIX_AXIS.lower, SIX_AXIS.upper, (20, 6))
    varied = 0.3 * generator.standard_normal((30, len(model.names))) / model.scales
    exact = model.position(postures, varied)
    positions = exact + 0.05 * generator.standard_normal(exact.shape)
    fits = estimate_batch(model, postures, positions)
    assert fits.converged.all()
    for k in range(2):
        data = Measurements(postures, positions[k])
        single = estimate(model, data, sigma="given")
        found, expected = fits.parameters[k] * model.scales, single.parameters * single.model.scales
        if single.model == model:
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)  # mm
        at = model.position(postures, fits.parameters[k])
        np.testing.assert_allclose(at, positions[k] - single.residuals_after, rtol=0, atol=1e-7)
        weights = 1.0 if not held else 0.05**-2
        assert fits.rss[k] == pytest.approx(weights * np.sum(single.residuals_after**2), rel=1e-9)


@pytest.mark.parametrize("name", ["base offset", "two"])
def test_sigma_of_rows_and_conditions_are_those_of_single_fits(name: str) -> None:
    model, postures = Model(arm(*EFFECTS[name])), plan(25)
    positions = batch(model, postures, 20, 1.0)
    sigma = np.random.default_rng(0).uniform(0.05, 0.3, 25)
    shared = Measurements(postures, positions[0], sigma=sigma)
    rows = {k: Measurements(postures, positions[k], sigma=sigma) for k in range(5)}
    same(model, estimate_batch(model, shared, positions), rows)


def test_large_offsets_and_known_parameters_take_the_individual_path() -> None:
    model = Model(arm(EffectSpec("encoder_eccentricity", 2)), held={"length_error:1": 1.5})
    postures, generator = plan(20), np.random.default_rng(0)
    true = np.zeros((200, 9))
    true[:, 3:7] = generator.uniform(-0.5, 0.5, (200, 4))  # 30 degrees: no shared linearisation fits all
    positions = model.position(postures, true)
    fits = estimate_batch(model, postures, positions)
    assert fits.converged.all()
    np.testing.assert_allclose(fits.parameters, true, rtol=0, atol=1e-9)


@pytest.mark.parametrize("effects", [(), (EffectSpec("gear_ratio", 2),)], ids=["linear", "effect"])
def test_a_data_set_that_is_not_a_number_stays_alone_and_none_are_no_error(effects: tuple[EffectSpec, ...]) -> None:
    model, postures = Model(arm(*effects)), plan(20)
    positions = batch(model, postures, 10, 0.0)
    positions[3, 4, 1] = np.nan
    assert np.flatnonzero(~estimate_batch(model, postures, positions).converged).tolist() == [3]
    assert estimate_batch(model, plan(20), np.zeros((0, 20, 2))).parameters.shape == (0, len(model.names))


def test_bad_input() -> None:
    model = Model(arm())
    with pytest.raises(InputError, match=r"positions: shape \(20, 2\), allowed: \(K, 20, 2\)"):
        estimate_batch(model, plan(20), np.zeros((20, 2)))
    with pytest.raises(InputError, match="2 m = 6 < p = 8"):
        estimate_batch(model, plan(3), np.zeros((5, 3, 2)))
    with pytest.raises(JobError, match=r"does not identify: joint_offset:1 \+ base_rotation.angle"):
        estimate_batch(Model(arm(EffectSpec("base_rotation"))), plan(20), np.zeros((5, 20, 2)))
