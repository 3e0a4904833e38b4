"""Prior against data: the released drops are squared z-scores of two independent fits, written with numpy; false alarms
are as rare as said; a moved zero is named with what the data alone say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from identification import Arm, Calibration, Identification, Measurements, Model, estimate
from identification.estimation.problem import Prior, Problem, contradicted, released_drops

LENGTHS, SIGMA = np.array([400.0, 300.0, 150.0]), 0.05
MODEL = Model(Arm(LENGTHS, sigma=SIGMA))
TRUTH = np.array([1.3, -0.8, 0.45, 0.002, -0.006, 0.009])


def measured(generator: np.random.Generator, rows: int, truth: np.ndarray, sigma: float = SIGMA) -> Measurements:
    """Rows written with complex numbers."""
    q = generator.uniform(-2.0, 2.0, (rows, 3))
    tip = np.exp(1j * np.cumsum(q + truth[3:], axis=1)) @ (LENGTHS + truth[:3])
    return Measurements(q, np.column_stack([tip.real, tip.imag]) + sigma * generator.standard_normal((rows, 2)))


def before(generator: np.random.Generator) -> Calibration:
    """A calibration from 12 rows."""
    found = estimate(MODEL, measured(generator, 12, TRUTH), sigma="given")
    return found.calibration()


def means(earlier: Calibration) -> np.ndarray:
    return np.array([earlier.values[name] for name in MODEL.names])


def with_prior(earlier: Calibration, data: Measurements, sigma: str | None = None) -> Identification:
    return estimate(MODEL, data, prior=Prior({}, earlier), sigma=sigma)  # type: ignore[arg-type]


def test_the_drop_is_the_squared_distance_in_combined_deviations() -> None:
    """Of the fit of data and the others' prior, independent of what the prior says of one given the others."""
    generator = np.random.default_rng(1)
    earlier, data = before(generator), measured(generator, 9, TRUTH + np.array([0.0, 0.1, 0.0, 0.0, 3e-4, 0.0]))
    problem = Problem.of(MODEL, data, "given", prior=Prior({}, earlier))
    x = TRUTH
    jacobian = MODEL.jacobian(data.postures, x).reshape(-1, 6) / SIGMA
    residual = (data.positions - MODEL.position(data.postures, x)).ravel() / SIGMA

    drops = released_drops(problem, x)
    information = jacobian.T @ jacobian
    alone = x + np.linalg.solve(information, jacobian.T @ residual)
    for k, name in enumerate(MODEL.names):
        others = np.delete(np.arange(6), k)
        precision = np.zeros((6, 6))
        precision[np.ix_(others, others)] = np.linalg.inv(earlier.covariance[np.ix_(others, others)])
        center = np.where(np.arange(6) == k, 0.0, means(earlier))
        mixed = np.linalg.inv(information + precision)
        at = mixed @ (information @ alone + precision @ center)
        given = earlier.covariance[k, others] @ np.linalg.inv(earlier.covariance[np.ix_(others, others)])
        slope = np.zeros(6)
        slope[k], slope[others] = 1.0, -given  # the prior of k given the others: slope @ (x - m) has this variance
        variance = earlier.covariance[k, k] - given @ earlier.covariance[others, k]
        z2 = (slope @ (at - means(earlier))) ** 2 / (slope @ mixed @ slope + variance)
        assert drops[name] == pytest.approx(z2, rel=1e-5)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_data_that_agree_are_rarely_accused(factor: float) -> None:
    """The level is 1 % of data sets: of 40, more than 3 have probability 7e-4. Also where sigma is three times too
    small."""
    accused = 0
    for seed in range(40):
        generator = np.random.default_rng(100 + seed)
        earlier, data = before(generator), measured(generator, 10, TRUTH, factor * SIGMA)
        accused += contradicted(Problem.of(MODEL, data, prior=(prior := Prior({}, earlier))), prior, TRUTH) is not None
    assert accused <= 3


@pytest.mark.parametrize("sigma", [None, "given", "estimated"])
def test_a_moved_zero_is_named_with_what_the_data_say(sigma: str | None) -> None:
    """By 0.8 deg. The new zero is the old one and its change, from least squares with the prior of the others."""
    generator = np.random.default_rng(7)
    earlier, moved = before(generator), TRUTH + np.radians(0.8) * np.eye(6)[4]
    data = measured(generator, 20, moved)
    found = with_prior(earlier, data, sigma)
    one = found.contradiction
    assert one is not None
    assert (one.name, one.instead) == ("joint_offset:2", ())
    assert one.prior == pytest.approx(np.degrees(means(earlier)[4]))
    precision = np.linalg.inv(earlier.covariance)[4]
    assert one.prior_std == pytest.approx(np.degrees(precision[4] ** -0.5))  # given the others
    if sigma == "given":
        others = np.delete(np.arange(6), 4)
        root = np.linalg.inv(np.linalg.cholesky(earlier.covariance[np.ix_(others, others)]))

        def residuals(x: np.ndarray) -> np.ndarray:
            rows = (data.positions - MODEL.position(data.postures, x)).ravel() / SIGMA
            return np.r_[rows, root @ (x - means(earlier))[others]]

        oracle = least_squares(residuals, moved, x_scale=np.abs(means(earlier)), xtol=1e-14)
        change = precision / precision[4]
        value, information = means(earlier)[4] + change @ (oracle.x - means(earlier)), oracle.jac.T @ oracle.jac
        assert one.value == pytest.approx(np.degrees(value), abs=1e-3 * one.std)
        assert one.std == pytest.approx(np.degrees((change @ np.linalg.inv(information) @ change) ** 0.5), rel=1e-3)
    assert found.warnings[0].startswith("the measurements contradict the prior: joint_offset:2 is ")
    assert "--only joint_offset:2" in found.warnings[0]
    assert with_prior(earlier, measured(generator, 20, TRUTH), sigma).contradiction is None


def test_a_zero_that_moved_is_told_from_what_the_earlier_data_left_open() -> None:
    """Two zeros of which their sum is known to 1e-5 rad and each to 1e-2: that of the one moved, with the other as
    there, to 1e-5; of a length and a zero that explain it as well, the zero is named."""
    generator, difference = np.random.default_rng(4), np.array([0.0, 0.0, 0.0, 1.0, -1.0, 0.0])
    covariance = np.diag([1e-2, 1e-2, 1e-2, 1e-10, 1e-10, 1e-10]) + 1e-4 * np.outer(difference, difference)
    earlier = Calibration(dict(zip(MODEL.names, TRUTH.tolist(), strict=True)), MODEL.names, covariance)
    one = with_prior(earlier, measured(generator, 20, TRUTH + 0.01 * np.eye(6)[4]), "given").contradiction
    assert one is not None
    assert one.name.startswith("joint_offset")
    assert one.prior_std < 1e-3 < one.value - one.prior - 3.0 * one.std


def test_too_few_rows_to_tell() -> None:
    """Two rows without a sigma: six unknowns and four equations; nothing is said."""
    generator = np.random.default_rng(8)
    earlier, data = before(generator), measured(generator, 2, TRUTH + 0.01 * np.eye(6)[4])
    assert with_prior(earlier, data, "estimated").contradiction is None
    one = with_prior(earlier, data, "given").contradiction
    assert one is not None
    assert "joint_offset:2" in {one.name, *one.instead}  # which of them is for more rows to tell


def test_an_error_of_degrees_accuses_no_length() -> None:
    """The tip of a zero 3 deg off moves on an arc, by 0.5 mm from its tangent, which looks like another length."""
    for seed in range(12):
        generator = np.random.default_rng([5, seed])
        earlier, moved = before(generator), TRUTH + np.radians(3.0) * np.eye(6)[3 + seed % 3]
        one = with_prior(earlier, measured(generator, 10, moved)).contradiction
        assert one is not None
        assert one.name == f"joint_offset:{1 + seed % 3}"
