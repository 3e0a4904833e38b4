"""The noise floor and the lack of fit that repeats of one posture tell, and what is left against a given sigma."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from identification import Arm, Measurements, Model, estimate
from identification.documents.identification import fit_facts
from identification.estimation.repeats import NoiseFloor, misfit, noise_floor, repeat_finding, with_repeats_doubted

ARM = Arm([300.0, 200.0, 150.0])


def repeated(times: int, blocks: bool = False, seed: int = 1) -> tuple[Measurements, np.ndarray]:
    """50 postures, each several times, in rounds or in blocks; and residuals of noise 0.1 mm per coordinate with a slow
    error of 0.2 mm per coordinate that changes from round to round."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-3.0, 3.0, (50, 3))
    number = np.repeat(np.arange(50), times) if blocks else np.tile(np.arange(50), times)
    slow = 0.2 * rng.normal(size=(times, 2))[np.arange(50 * times) // 50]
    residual = 0.1 * rng.normal(size=(50 * times, 2)) + slow
    encoder = np.radians(0.005) * rng.uniform(-1.0, 1.0, (50 * times, 3))
    return Measurements(q[number] + encoder, np.arange(100.0 * times).reshape(-1, 2)), residual


def test_repeats_far_apart_hold_the_slow_errors_and_close_ones_do_not() -> None:
    data, residual = repeated(8)
    every = np.ones(len(data), dtype=bool)
    number = np.tile(np.arange(50), 8)
    assert len(set(zip(number, data.posture_numbers, strict=True))) == 50 == data.posture_numbers.max() + 1
    # eight rounds are an eighth of the session apart, which is far: the classical pooled variance
    rounds = residual.reshape(8, 50, 2)
    expected = np.sqrt(np.sum((rounds - rounds.mean(axis=0)) ** 2) / (50 * 7))
    found = noise_floor(residual, data, every, 0.1)
    assert found.repeats == pytest.approx(expected, rel=1e-12)
    assert found.value == found.repeats
    assert found.close_repeats is None
    assert found.sigma == pytest.approx(0.1 * np.sqrt(2.0))
    # in blocks of three all repeats are close, and the only ones
    data, residual = repeated(3, blocks=True)
    blocks = residual.reshape(50, 3, 2)
    expected = np.sqrt(np.sum((blocks - blocks.mean(axis=1, keepdims=True)) ** 2) / (50 * 2))
    found = noise_floor(residual, data, np.ones(150, dtype=bool), None)
    assert found.repeats is None
    assert found.close_repeats == pytest.approx(expected, rel=0.1)  # but for ten blocks, cut where a tenth ends
    assert found.source == "close_repeats"
    # reads of one approach share also what the arm itself scatters by, which is nothing that the model misses
    approach = np.repeat(np.random.default_rng(3).standard_normal((50, 2)), 3, axis=0)
    assert repeat_finding(residual + approach, 6, data, np.ones(150, dtype=bool)) == ()


def test_without_repeats_the_floor_is_the_instrument_or_unknown() -> None:
    rng = np.random.default_rng(2)
    data = Measurements(rng.uniform(-3.0, 3.0, (40, 3)), rng.normal(size=(40, 2)))
    every = np.ones(40, dtype=bool)
    assert noise_floor(data.positions, data, every, None) == NoiseFloor(None, None, None)
    assert noise_floor(data.positions, data, every, 0.05).value == pytest.approx(0.05 * np.sqrt(2.0))
    assert noise_floor(data.positions, data, every, np.repeat([0.1, 0.7], 20)).value == pytest.approx(np.sqrt(0.5))
    by_row = replace(data, sigma=np.full(40, 0.2))
    assert noise_floor(data.positions, by_row, every, None).value is None  # what repeats scatter by, and there are none


def test_three_reflectors_of_one_posture_say_nothing_of_the_noise() -> None:
    """They differ by what the model leaves of each. Read twice, only the two reads of a reflector scatter by noise."""
    rng, marker = np.random.default_rng(6), np.tile(["a", "b", "c"], 40)
    q = np.repeat(rng.uniform(-3.0, 3.0, (40, 3)), 3, axis=0)
    residual = rng.standard_normal((120, 3))
    data = Measurements(q, residual, marker=marker)
    assert noise_floor(residual, data, np.ones(120, dtype=bool), None) == NoiseFloor(None, None, None)
    assert repeat_finding(residual, 20, data, np.ones(120, dtype=bool)) == ()
    twice = Measurements(np.tile(q, (2, 1)), np.tile(residual, (2, 1)), marker=np.tile(marker, 2))
    left = np.tile(residual, (2, 1)) + 0.05 * rng.standard_normal((240, 3))
    floor = noise_floor(left, twice, np.ones(240, dtype=bool), None)
    assert floor.repeats == pytest.approx(np.sqrt(np.sum((left[:120] - left[120:]) ** 2) / 2.0 / 120.0), rel=1e-9)


@pytest.mark.parametrize(("sigma", "ripple"), [(None, 0.0), (None, 0.5), (0.05, 0.5), (0.5, 0.5)])
def test_an_identification_compares_its_residuals_with_repeats(sigma: float | None, ripple: float) -> None:
    """30 postures in two rounds; an error that returns with its posture is no noise. A sigma that chi2 rejects is said
    already, one that is too large hides nothing."""
    rng = np.random.default_rng(8)
    q = np.tile(rng.uniform(-3.0, 3.0, (30, 3)), (2, 1))
    model = Model(replace(ARM, sigma=sigma))
    shared = np.tile(ripple * rng.standard_normal((30, 2)), (2, 1))
    measurements = Measurements(q, model.position(q) + shared + 0.05 * rng.standard_normal((60, 2)))
    plain = estimate(model, measurements)
    found = with_repeats_doubted(plain, measurements)
    if ripple == 0.0 or sigma == 0.05:
        assert found is plain
        assert any("times sigma_mm" in said for said in found.warnings) is (sigma is not None)
        return
    left = plain.residuals_after.reshape(2, 30, 2)
    repeats = np.sqrt(np.sum((left[0] - left[1]) ** 2 / 2.0) / 60.0)
    scatter = np.sqrt(np.sum(left**2) / (120.0 - 6.0))
    expected = f"misfit: the residuals scatter {scatter / repeats:.2g} times as much as repeats of one posture "
    assert found.warnings[0].startswith(f"{expected}({scatter:.3g} mm per coordinate, not {repeats:.3g} mm)")
    np.testing.assert_array_equal(found.covariance, plain.covariance)
    assert "if the model is right; but repeats say that it is not" in str(fit_facts(found)["expected error"])


def test_chi_square_of_what_is_left_by_sigma_of_the_rows_then_of_the_arm() -> None:
    rng, kept, each = np.random.default_rng(4), np.arange(50) > 3, np.linspace(0.1, 0.2, 50)
    data, left = Measurements(rng.uniform(-3.0, 3.0, (50, 3)), np.zeros((50, 2))), 0.14 * rng.normal(size=(50, 2))
    for rows, sigma, scatter, significant in (
        (data, 0.1, 0.1, True),
        (data, 0.14, 0.14, False),
        (replace(data, sigma=each), 5.0, each, None),
    ):
        result, chi2 = misfit(left, 6, rows, sigma, kept), np.sum(((left.T / scatter).T)[4:] ** 2)
        assert result is not None
        assert (result.chi2, result.dof) == (pytest.approx(chi2), 86)
        assert result.p_value == pytest.approx(stats.chi2(86).sf(chi2))
        assert significant is None or result.significant is significant
    assert misfit(left, 6, data, None, kept) is None
