"""What `estimate` states: sigma, weights, covariance, intervals, what is not told; and what it refuses.

Any fit repeated without its outliers: the rows left out, and the fit to the others. Many data sets, on one plan or each
on its own, against one fit at a time.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from doe.criteria import information_matrix
from identification import Arm, EffectSpec, InputError, JobError, Measurements, Model, Status
from identification.estimation import estimate, estimate_batch, without_outliers
from identification.levenberg_marquardt import Solution
from identification.model.placed import minimal
from tests.doe.six_axis import CHAIN, SIX_AXIS
from tests.identification.estimation.cases import SIGMA, TRUTH, arm, data, plan, scipy_fit, truth


# -- sigma, weights, covariance --------------------------------------------------------------------------------------
def test_covariance_is_the_inverse_information_at_the_estimate() -> None:
    model = Model(arm(EffectSpec("encoder_eccentricity", 2)))
    measurements = data(model, plan(20))
    found = estimate(model, measurements, sigma=0.2)
    expected = 0.04 * np.linalg.inv(information_matrix(model.jacobian(plan(20), found.parameters) / model.scales))
    scaled = found.covariance * np.outer(model.scales, model.scales)
    np.testing.assert_allclose(scaled, expected, rtol=0, atol=1e-10 * np.max(expected))
    free = estimate(model, measurements)
    estimated = np.sum(free.residuals_after**2) / (40 - 10)
    assert free.sigma == pytest.approx(np.sqrt(estimated), rel=1e-12)
    np.testing.assert_allclose(free.covariance, found.covariance * estimated / 0.04, rtol=1e-9)


@pytest.mark.parametrize("effects", [(), (EffectSpec("gear_ratio", 2),)], ids=["linear", "effect"])
def test_weights_are_replicated_rows(effects: tuple[EffectSpec, ...]) -> None:
    model = Model(arm(*effects))
    measurements = data(model, plan(15))
    counts = np.random.default_rng(0).integers(0, 4, 15)
    rows = np.repeat(np.arange(15), counts)
    several = measurements.rows(rows)  # some last digits apart, since exact copies count once
    several = replace(several, positions=several.positions + 1e-12 * np.arange(len(rows))[:, None])
    repeated = estimate(model, several, sigma=SIGMA)
    per_row = np.where(counts > 0, SIGMA / np.sqrt(np.maximum(counts, 1)), 1e6)
    weighted = estimate(model, replace(measurements, sigma=per_row))
    np.testing.assert_allclose(weighted.parameters, repeated.parameters, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.diag(weighted.covariance), np.diag(repeated.covariance), rtol=1e-6)
    # the scatter within repeats is none, so chi2 agrees
    assert weighted.chi2 == pytest.approx(repeated.chi2, rel=1e-6)  # the digits that set the copies apart


def test_which_sigma_holds() -> None:
    rows = replace(data(Model(arm()), plan(10)), sigma=np.full(10, 0.3))
    model = Model(arm(sigma=0.2))
    assert estimate(model, rows, sigma=0.1).sigma == pytest.approx(0.1)
    assert estimate(model, rows).sigma == pytest.approx(0.3)
    assert estimate(model, replace(rows, sigma=None)).sigma == pytest.approx(0.2)
    forced = estimate(model, rows, sigma="estimated")
    assert forced.sigma == pytest.approx(estimate(Model(arm()), replace(rows, sigma=None)).sigma)
    assert not forced.sigma_known
    assert forced.chi2 is None
    assert forced.p_value is None


def test_quantiles_of_the_intervals_and_p_value() -> None:
    model, measurements = Model(arm()), data(Model(arm()), plan(6))
    known, free = estimate(model, measurements, sigma=SIGMA), estimate(model, measurements)
    for found, quantile in ((known, stats.norm.ppf(0.975)), (free, stats.t(4).ppf(0.975))):
        np.testing.assert_allclose(found.intervals[:, 1] - found.parameters, quantile * found.std, rtol=1e-6)
        np.testing.assert_allclose(found.intervals.mean(axis=1), found.parameters, rtol=0, atol=1e-12)
    assert (known.dof, free.p_value) == (4, None)
    assert known.chi2 == pytest.approx(np.sum(known.residuals_after**2) / SIGMA**2)
    assert known.p_value == pytest.approx(stats.chi2.sf(known.chi2, 4))


# -- what is not told ------------------------------------------------------------------------------------------------
def test_alias_is_named_and_the_rest_stays_honest() -> None:
    whole, aliased = Model(arm()), Model(arm(EffectSpec("base_rotation")))
    measurements = data(whole, plan(20))
    expected, found = (estimate(model, measurements) for model in (whole, aliased))
    assert found.not_identifiable == ("joint_offset:1 + base_rotation.angle",)
    assert found.status is Status.not_identifiable
    told = np.r_[0:4, 5:8]
    np.testing.assert_allclose(found.parameters[told], expected.parameters[told], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.std[told], expected.std[told], rtol=1e-6)
    assert found.dof == expected.dof
    assert np.isnan(found.std[[4, 8]]).all()
    # the sum is told
    assert found.parameters[4] + found.parameters[8] == pytest.approx(expected.parameters[4], abs=1e-9)
    rows = {row["name"]: row for row in found.to_json()["parameters"]}
    assert all(rows["joint_offset:1"][key] is None for key in ("value", "std", "low_95", "high_95"))
    assert rows["length_error:1"]["value"] == pytest.approx(expected.parameters[0], abs=1e-9)


@pytest.mark.parametrize("wobble", [0.0, 1e-6])
def test_a_joint_that_hardly_moves_gives_no_huge_numbers(wobble: float) -> None:
    postures = plan(20)
    postures[:, 2] = 0.3 + wobble * np.random.default_rng(0).standard_normal(20)
    model = Model(arm())
    found = estimate(model, data(model, postures))
    assert len(found.not_identifiable) == 2
    assert found.identifiable.tolist() == [True, False, False, True, True, False, False, False]
    assert np.max(np.abs(found.parameters * model.scales)) < 5.0  # the truth is about 1.5 mm
    assert np.nanmax(found.std * model.scales) < 0.1
    np.testing.assert_allclose(found.parameters[[0, 3]], TRUTH[[0, 3]], rtol=0, atol=5 * 0.03)
    assert found.rms_after < 2 * SIGMA


def test_exactly_determined_data_leave_sigma_unknown() -> None:
    found = estimate(Model(arm()), data(Model(arm()), plan(4)))
    figures = found.to_json()
    assert found.dof == 0
    assert figures["sigma_mm"] is None
    assert figures["parameters"][0]["value"] is not None
    assert figures["parameters"][0]["std"] is None
    assert found.calibration().covariance is None
    json.dumps(figures, allow_nan=False)
    known = estimate(Model(arm()), data(Model(arm()), plan(4)), sigma=SIGMA)
    assert known.p_value is None
    assert np.all(np.isfinite(known.intervals))


# -- the result ------------------------------------------------------------------------------------------------------
def test_units_and_errors_of_json() -> None:
    model = Model(arm(EffectSpec("encoder_eccentricity", 2), EffectSpec("base_offset")))
    measurements = data(model, plan(20))
    found = estimate(model, measurements, sigma=SIGMA)
    figures = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert [(row["name"], row["unit"]) for row in figures["parameters"]] == [
        *((f"length_error:{j}", "mm") for j in (1, 2, 3, 4)),
        *((f"joint_offset:{j}", "deg") for j in (1, 2, 3, 4)),
        *((f"encoder_eccentricity:2.{short}", "deg") for short in "ab"),
        *((f"base_offset.{short}", "mm") for short in ("x0", "y0")),
    ]
    assert figures["parameters"][4]["value"] == pytest.approx(np.degrees(found.parameters[4]))
    for when, values in (("before", np.zeros(12)), ("after", found.parameters)):
        distance = np.linalg.norm(measurements.positions - model.position(plan(20), values), axis=1)
        assert figures[f"rms_{when}_mm"] == pytest.approx(np.sqrt(np.mean(distance**2)))
        assert figures[f"max_{when}_mm"] == pytest.approx(distance.max())


# -- refusals --------------------------------------------------------------------------------------------------------
def test_bad_arguments() -> None:
    model, measurements = Model(arm()), data(Model(arm()), plan(10))
    with pytest.raises(InputError, match=r"2 m = 6 < p = 8, allowed: m >= 4"):
        estimate(model, data(model, plan(3)))
    with pytest.raises(InputError, match="4 joints for an arm of 2 links, allowed: 2"):
        estimate(Model(Arm([100.0, 100.0])), measurements)
    with pytest.raises(InputError, match="positions of 3 coordinates, allowed: 2"):
        estimate(model, Measurements(plan(10), np.zeros((10, 3))))
    for sigma, shown in ((0.0, "0"), (-1.0, "-1"), (np.nan, "nan"), (np.ones(3), r"shape \(3,\)")):
        with pytest.raises(InputError, match=f"sigma_mm: {shown}, allowed"):
            estimate(model, measurements, sigma=sigma)
    positions = measurements.positions.copy()
    positions[6, 1] = np.inf
    with pytest.raises(InputError, match=r"positions: row 7 has .*inf.*, allowed: finite"):
        estimate(model, replace(measurements, positions=positions))
    with pytest.raises(InputError, match=r"model: found Arm"):
        estimate(arm(), measurements)
    with pytest.raises(InputError, match=r"measurements: found str"):
        estimate(model, "data.csv")


# -- without outliers ------------------------------------------------------------------------------------------------
def test_rows_are_numbered_as_given_and_the_fit_is_that_of_the_others() -> None:
    """Lost beams in rows 3 and 9 and a larger one in row 6 that hides them; oracle: SciPy on the rows without them."""
    model = Model(arm(sigma=0.1))
    measured = data(model, plan(40))
    positions = measured.positions.copy()
    positions[[2, 8]] += [1.0, -0.8]
    positions[5] += [400.0, 0.0]
    calls = []

    def fit(rows: Measurements):
        calls.append(len(rows))
        return estimate(model, rows)

    found, left_out = without_outliers(fit, Measurements(measured.postures, positions))
    assert left_out == (3, 6, 9)
    assert calls == sorted(calls, reverse=True)
    assert calls[-1] == 37
    expected = scipy_fit(model, measured.rows(np.delete(np.arange(40), [2, 5, 8])))
    np.testing.assert_allclose(found.parameters, expected.x, atol=1e-7)


# -- many data sets ----------------------------------------------------------------------------------------------------
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
    exact = model.position(postures, varied, Measurements(postures, np.zeros((len(postures), 2))).conditions)
    return exact + SIGMA * generator.standard_normal(exact.shape)


def same(model: Model, fits: Solution, rows: dict[int, Measurements]) -> None:
    """Fits of these numbers are those of the rows alone."""
    assert fits.converged.all()
    for k, alone in rows.items():
        single = estimate(model, alone)
        scaled = fits.parameters[k] * model.scales  # mm; a standard deviation is 0.03
        np.testing.assert_allclose(scaled, single.parameters * model.scales, rtol=0, atol=1e-7)
        left = np.sum(single.residuals_after**2) if single.chi2 is None else single.chi2
        assert fits.rss[k] == pytest.approx(left, rel=1e-10)


@pytest.mark.parametrize(("name", "spread"), [(name, 2.0 * (k % 2)) for k, name in enumerate(EFFECTS)])
def test_equals_single_fits(name: str, spread: float) -> None:
    model, postures = Model(arm(*EFFECTS[name])), plan(30)
    postures[15:] = postures[:15]  # each is measured twice: no row is a copy of another
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
    exact = model.position(postures, 0.3 * generator.standard_normal((30, len(model.names))) / model.scales)
    positions = exact + 0.05 * generator.standard_normal(exact.shape)
    fits = estimate_batch(model, postures, positions)
    assert fits.converged.all()
    for k in range(2):
        single = estimate(model, Measurements(postures, positions[k]), sigma="given")
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
    rows = {k: Measurements(postures, positions[k], sigma=sigma) for k in range(5)}
    same(model, estimate_batch(model, Measurements(postures, positions[0], sigma=sigma), positions), rows)


def test_large_offsets_and_known_parameters_take_the_individual_path() -> None:
    model = Model(arm(EffectSpec("encoder_eccentricity", 2)), held={"length_error:1": 1.5})
    postures, generator = plan(20), np.random.default_rng(0)
    true = np.zeros((200, 9))
    true[:, 3:7] = generator.uniform(-0.5, 0.5, (200, 4))  # 30 degrees: no shared linearisation fits all
    fits = estimate_batch(model, postures, model.position(postures, true))
    assert fits.converged.all()
    np.testing.assert_allclose(fits.parameters, true, rtol=0, atol=1e-9)


@pytest.mark.parametrize("effects", [(), (EffectSpec("gear_ratio", 2),)], ids=["linear", "effect"])
def test_a_data_set_that_is_not_a_number_stays_alone_and_none_are_no_error(effects: tuple[EffectSpec, ...]) -> None:
    model, postures = Model(arm(*effects)), plan(20)
    positions = batch(model, postures, 10, 0.0)
    positions[3, 4, 1] = np.nan
    assert np.flatnonzero(~estimate_batch(model, postures, positions).converged).tolist() == [3]
    assert estimate_batch(model, plan(20), np.zeros((0, 20, 2))).parameters.shape == (0, len(model.names))


def test_bad_batches() -> None:
    model = Model(arm())
    with pytest.raises(InputError, match=r"positions: shape \(20, 2\), allowed: \(K, 20, 2\)"):
        estimate_batch(model, plan(20), np.zeros((20, 2)))
    with pytest.raises(InputError, match="2 m = 6 < p = 8"):
        estimate_batch(model, plan(3), np.zeros((5, 3, 2)))
    with pytest.raises(JobError, match=r"does not identify: joint_offset:1 \+ base_rotation.angle"):
        estimate_batch(Model(arm(EffectSpec("base_rotation"))), plan(20), np.zeros((5, 20, 2)))
