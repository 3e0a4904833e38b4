"""Fits with a prior: against ridge regression and the marginal likelihood of all rows; a prior that data contradict.

Restricted likelihood of noise and sizes against dense matrices and SciPy.
"""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.optimize import least_squares, minimize_scalar

from identification import (
    Arm,
    Array,
    Calibration,
    DHRow,
    Identification,
    InputError,
    Measurements,
    Model,
    Status,
    chain_of,
    estimate,
)
from identification.arm import EffectSpec
from identification.estimation.problem import Prior, Problem, contradicted, likeliest, likeliest_noise, released_drops
from identification.gap.library_prior import library_prior
from identification.inspection.inspection import inspect
from tests import small_arm

ARM = Arm([300.0, 200.0], sigma=0.1)
LIBRARY = library_prior(ARM, names=["encoder_eccentricity", "gear_ratio"])
MODEL, PRIOR = Model(LIBRARY.arm), LIBRARY.prior
SIZES = MODEL.parameters.vector(PRIOR.deviations)


def measured(generator: np.random.Generator, rows: int, noise: float) -> tuple[Measurements, Array]:
    """Rows of an arm with small errors and effects of the prior, and its parameters."""
    truth = SIZES * generator.standard_normal(len(SIZES))
    truth[:4] = [0.05, -0.02, 1e-4, 2e-4]  # small: linear theory is the oracle
    postures = generator.uniform(-np.pi, np.pi, (rows, 2))
    positions = MODEL.position(postures, truth)
    return Measurements(postures, positions + noise * generator.standard_normal(positions.shape)), truth


def linear(data: Measurements) -> tuple[Array, Array]:
    """(N,) residuals of the nominal arm and (N, p) Jacobian there."""
    zero = np.zeros(len(SIZES))
    return (data.positions - MODEL.position(data.postures, zero)).ravel(), MODEL.jacobian(data.postures, zero).reshape(
        -1, len(SIZES)
    )


@pytest.mark.parametrize("sigma", [1e-5, 1e-7, 1e-9])
def test_what_the_prior_holds_is_determined_beside_rows_without_noise(sigma: float) -> None:
    """The prior of 1 mm and 0.5 deg counts as 1 where such rows count as 1e9: a share of the largest is no measure of
    what is determined. The truth is far within the prior, so that the arm is found where the rows determine it."""
    generator = np.random.default_rng(0)
    chain = chain_of(
        [DHRow(0.0, np.pi / 2, 400.0), DHRow(-600.0, 0.0, 0.0), DHRow(-500.0, 0.0, 0.0), DHRow(120.0, np.pi / 2, 150.0)]
    )
    model = Model(Arm(chain, sigma=sigma))
    q, fresh = generator.uniform(-2.0, 2.0, (60, 4)), generator.uniform(-2.0, 2.0, (20, 4))
    truth = 0.3 * model.parameters.vector(model.prior, 0.0) * generator.standard_normal(len(model.names))
    found = estimate(model, Measurements(q, model.position(q, truth)))
    assert found.not_identifiable == ()
    assert found.status is Status.converged
    np.testing.assert_allclose(found.model.position(fresh, found.parameters), model.position(fresh, truth), atol=1e-6)


def test_what_neither_rows_nor_prior_determine_stays_undetermined() -> None:
    """One joint that turns about z: how high base and tool are is a sum, and nothing holds either."""
    model = Model(Arm(chain_of([DHRow(300.0, 0.0, 0.0)]), sigma=1e-9))
    q = np.linspace(-2.0, 2.0, 30)[:, None]
    found = estimate(model, Measurements(q, model.position(q)))
    assert found.status is Status.not_identifiable
    assert any("base" in combination for combination in found.not_identifiable)


def test_joints_about_which_gravity_has_no_moment_are_no_reason_to_refuse() -> None:
    """The first axis of an upright arm: the file keeps no covariance of its compliance, so that it can be a prior."""
    rng = np.random.default_rng(6)
    truth = small_arm.small_arm(rng, compliance=np.array([0.0, 2e-4, 1e-4, 0.0, 0.0, 0.0]))
    data = small_arm.measured(truth, small_arm.random_postures(40, rng), rng)
    found = estimate(Model(small_arm.drawn_arm().with_effects(EffectSpec("joint_compliance"))), data)
    assert (found.status, found.not_identifiable) == (Status.converged, ())
    assert {*found.names} - {*found.calibration().parameter_names} == {"joint_compliance.c1"}
    without = replace(found, identifiable=found.identifiable & (np.arange(len(found.names)) > 0))  # of base.x
    before, after = ({row.name: row.prior_std for row in fit.corrected_values} for fit in (found, without))
    assert before.items() >= after.items()
    assert before["zero of joint 3"] == pytest.approx(np.degrees(found.prior.deviations["joint_offset:3"]))
    seen = inspect(found.calibrated_arm(), data)
    assert any("joint_compliance" in words for words in seen.data["identifiable"]), seen


def test_it_is_ridge_regression_where_the_noise_is_given() -> None:
    data, _ = measured(np.random.default_rng(0), 8, 0.1)
    found = estimate(MODEL, data, prior=replace(PRIOR, factors=(1.0,)), sigma="given")
    residual, jacobian = linear(data)
    precision = jacobian.T @ jacobian / 0.01 + np.diag(np.where(SIZES > 0.0, 1.0 / np.maximum(SIZES, 1e-300), 0.0) ** 2)
    covariance = np.linalg.inv(precision)
    assert np.diag(found.covariance) == pytest.approx(np.diag(covariance), rel=1e-3)
    expected = covariance @ jacobian.T @ residual / 0.01
    assert np.abs(found.parameters - expected).max() <= 1e-2 * np.sqrt(np.diag(covariance)).max()
    assert found.uncertainty.kind == "given"
    assert found.std[4:].max() <= 5e-4  # no less sure than the prior


def test_noise_is_that_of_the_largest_marginal_likelihood() -> None:
    """Of all rows' covariance, the geometry's with a variance that is as good as infinite."""
    data, _ = measured(np.random.default_rng(1), 15, 0.4)
    found = estimate(MODEL, data, prior=PRIOR)
    residual, jacobian = linear(data)
    variances = np.where(SIZES > 0.0, SIZES, 1e3 / MODEL.parameters.scales) ** 2

    def minus_log(noise: float) -> float:
        covariance = jacobian * variances @ jacobian.T + noise**2 * np.eye(len(residual))
        return float(np.linalg.slogdet(covariance)[1] + residual @ np.linalg.solve(covariance, residual))

    expected = minimize_scalar(minus_log, bounds=(0.1, 2.0), method="bounded").x
    assert found.scatter == pytest.approx(expected, rel=1e-2)
    assert found.uncertainty.kind == "scatter"
    posterior = np.linalg.inv(jacobian.T @ jacobian / found.scatter**2 + np.diag(1.0 / variances))
    assert np.diag(found.covariance) == pytest.approx(np.diag(posterior), rel=1e-3)
    left = len(residual) - np.trace(jacobian @ posterior @ jacobian.T) / found.scatter**2
    assert found.uncertainty.freedom == pytest.approx(np.full(len(SIZES), left), abs=0.51)  # rounded
    assert found.sigma == 0.1  # what was given is still said, and that chi2 rejects it
    assert found.p_value is not None
    assert found.p_value < 0.01
    assert estimate(MODEL, data, prior=PRIOR, sigma="estimated").sigma == pytest.approx(expected, rel=1e-2)
    quiet, _ = measured(np.random.default_rng(2), 15, 0.01)
    held = estimate(MODEL, quiet, prior=PRIOR)
    assert held.scatter == 0.1  # no less than what is given, and said is how much less the residuals show
    times = np.sqrt(np.sum(held.residuals_after**2) / held.dof) / 0.1
    assert times < 0.3
    assert f"the residuals scatter {times:.3g} times sigma_mm" in held.document().text()


@pytest.mark.parametrize("deviation", [0.0, -1.0, np.inf, np.nan])
def test_wrong_deviation(deviation: float) -> None:
    with pytest.raises(InputError, match="prior: length_error:1"):
        Prior({"length_error:1": deviation})


def test_fewer_rows_than_parameters_are_enough() -> None:
    data, _ = measured(np.random.default_rng(4), 3, 0.1)
    assert estimate(MODEL, data, prior=PRIOR).identifiable.all()
    with pytest.raises(InputError, match="fewer equations than unknowns: 2 m = 2 < p = 4"):
        estimate(MODEL, measured(np.random.default_rng(4), 1, 0.1)[0], prior=PRIOR)


CHAIN = replace(
    chain_of([DHRow(0, np.pi / 2, 300.0), DHRow(400.0, 0, 0), DHRow(80.0, np.pi / 2, 50.0), DHRow(60.0, 0.0, 90.0)]),
    tools={"1": np.array([60.0, 20.0, 30.0])},
    base=np.eye(4),
)
SPATIAL = Model(Arm(CHAIN))


def far_off(times: float, generator: np.random.Generator) -> tuple[Measurements, Measurements, Array]:
    """30 rows of noise 0.05 mm, 200 without, and the parameters: so many times the machining's sizes."""
    sizes = SPATIAL.parameters.vector(SPATIAL.prior, 0.0)
    truth = times * sizes * generator.standard_normal(len(sizes))
    fitted, fresh = (generator.uniform(-2.5, 2.5, (m, len(CHAIN))) for m in (30, 200))
    positions = SPATIAL.position(fitted, truth)
    data = Measurements(fitted, positions + 0.05 * generator.standard_normal(positions.shape))
    return data, Measurements(fresh, SPATIAL.position(fresh, truth)), truth


@pytest.mark.parametrize("times", [1.0, 10.0])
def test_an_arm_far_from_its_drawing_is_fitted_as_well_as_one_near_it(times: float) -> None:
    """The points are as near as the noise lets them be, whatever the sizes of the errors: with the 19 parameters that
    four axes and a point have (4 R + 3) and N = 90 coordinates sqrt(19 / 90) = 0.46 of the noise on average; more at
    the edges of the ranges, so that twice the noise is allowed. A prior ten times too narrow leaves millimeters."""
    data, fresh, _ = far_off(times, np.random.default_rng([31, 0]))
    found = estimate(SPATIAL, data)
    error = fresh.positions - found.model.position(fresh.postures, found.parameters)
    assert np.sqrt(np.mean(error**2)) <= 2.0 * 0.05
    assert any("farther from its drawing" in doubt for doubt in found.doubts) == (times > 1.0)


@pytest.mark.parametrize("factors", [(6.0, 1.0), (1.0, 30.0)])
def test_the_widths_are_those_of_the_largest_marginal_likelihood(factors: tuple[float, float]) -> None:
    """Of all rows' covariance at the nominal arm, with the noise given; what has no prior as good as infinite. A width
    other than 1 must lower -2 log by more than 4. Errors and zeros so many times the machining's sizes."""
    data, *_ = far_off(6.0, np.random.default_rng(32))
    zero = np.zeros(len(SPATIAL.names))
    jacobian = SPATIAL.jacobian(data.postures, zero).reshape(-1, len(zero))
    sizes = SPATIAL.parameters.vector(SPATIAL.prior, 0.0)
    offsets = np.array([name.startswith("joint_offset") for name in SPATIAL.names])
    residual = jacobian @ (np.where(offsets, factors[1], 1.0) * factors[0] * sizes * np.sin(np.arange(len(zero)) + 1.0))

    def minus_log(widths: tuple[float, float]) -> float:
        times = np.where(offsets, widths[1], 1.0) * widths[0]
        spread = np.where(sizes > 0.0, times * sizes, 1e3 / SPATIAL.scales)
        covariance = 0.05**2 * np.eye(len(residual)) + (jacobian * spread**2) @ jacobian.T
        left = float(np.linalg.slogdet(covariance)[1] + residual @ np.linalg.solve(covariance, residual))
        return left + 4.0 * sum(width != 1.0 for width in widths)

    problem = Problem.of(SPATIAL, data, 0.05, prior=Prior(SPATIAL.prior))
    expected = min(product(2.0 ** np.arange(6.0), 4.0 ** np.arange(4.0)), key=minus_log)
    assert (expected[0] > 1.0, expected[1] > 1.0) == (factors[0] > 1.0, factors[1] > 1.0)
    assert likeliest(problem, zero, residual / 0.05, jacobian / 0.05) == (1.0, (*expected, 1.0))


@pytest.mark.parametrize("degrees", [20.0, 110.0])
def test_a_zero_that_is_elsewhere_moves_nothing_but_itself(degrees: float) -> None:
    """Joint 2 read so far off: the fit, the errors of the frames and what it says of fresh postures stay."""
    data, fresh, _ = far_off(1.0, np.random.default_rng(35))
    turn = np.radians([0.0, degrees, 0.0, 0.0])
    near, far = estimate(SPATIAL, data), estimate(SPATIAL, replace(data, postures=data.postures - turn))
    difference = dict(zip(SPATIAL.names, far.parameters - near.parameters, strict=True))
    assert difference.pop("joint_offset:2") == pytest.approx(np.radians(degrees), abs=np.radians(0.2))
    held = [difference[name] / SPATIAL.prior[name] for name in difference if name in SPATIAL.prior]
    assert np.max(np.abs(held)) < 1.0  # of the machining's sizes; a common width of 8 would leave them to the noise
    error = fresh.positions - far.model.position(fresh.postures - turn, far.parameters)
    assert np.sqrt(np.mean(error**2)) <= 2.0 * 0.05  # as in the test above
    zeros = f"{np.degrees(far.parameters[SPATIAL.names.index('joint_offset:2')]):.1f} deg at joint 2"
    assert far.doubts[0] == f"zeros differ from the drawing's: {zeros}"
    assert far.doubts[1].startswith("zeros of joints are farther from the drawing than [machining] says (0.5 deg)")
    assert far.status is Status.converged


def test_a_joint_of_the_wrong_sign_is_no_result() -> None:
    data, *_ = far_off(1.0, np.random.default_rng(33))
    flipped = estimate(SPATIAL, Measurements(data.postures * [1, 1, -1, 1], data.positions))
    assert flipped.status is Status.implausible
    assert any("armcal check" in doubt for doubt in flipped.doubts)


@pytest.mark.parametrize("rows", [9, 40])
def test_rows_that_stand_for_a_share_of_themselves(rows: int) -> None:
    """Directions that the share leaves no equations for are noise alone: -2 log has as many logarithms fewer."""
    generator = np.random.default_rng([3, rows])
    target, free, effects = (generator.standard_normal(shape) for shape in ((rows,), (rows, 2), (rows, 4)))
    outside, spare = null_space(free.T), max(round(0.25 * (rows - 2)), 4)
    left, columns = 0.5 * outside.T @ target, 0.5 * outside.T @ effects
    covariance = columns @ columns.T + 0.7**2 * np.eye(rows - 2)
    expected = np.linalg.slogdet(covariance)[1] + left @ np.linalg.solve(covariance, left)
    expected += (spare - (rows - 2)) * 2.0 * np.log(0.7)
    assert likeliest_noise(left, columns, spare, 0.7, 0.7)[0] == pytest.approx(expected, rel=1e-10)


# -- prior against data ------------------------------------------------------------------------------------------------
LENGTHS, SIGMA = np.array([400.0, 300.0, 150.0]), 0.05
BARE = Model(Arm(LENGTHS, sigma=SIGMA))
TRUTH = np.array([1.3, -0.8, 0.45, 0.002, -0.006, 0.009])


def of_complex(generator: np.random.Generator, rows: int, truth: np.ndarray, sigma: float = SIGMA) -> Measurements:
    """Rows written with complex numbers."""
    q = generator.uniform(-2.0, 2.0, (rows, 3))
    tip = np.exp(1j * np.cumsum(q + truth[3:], axis=1)) @ (LENGTHS + truth[:3])
    return Measurements(q, np.column_stack([tip.real, tip.imag]) + sigma * generator.standard_normal((rows, 2)))


def before(generator: np.random.Generator) -> Calibration:
    """A calibration from 12 rows."""
    return estimate(BARE, of_complex(generator, 12, TRUTH), sigma="given").calibration()


def means(earlier: Calibration) -> np.ndarray:
    return np.array([earlier.values[name] for name in BARE.names])


def with_prior(earlier: Calibration, data: Measurements, sigma: str | None = None) -> Identification:
    return estimate(BARE, data, prior=Prior({}, earlier), sigma=sigma)  # type: ignore[arg-type]


def test_the_drop_is_the_squared_distance_in_combined_deviations() -> None:
    """Of the fit of data and the others' prior, independent of what the prior says of one given the others."""
    generator = np.random.default_rng(1)
    earlier, data = before(generator), of_complex(generator, 9, TRUTH + np.array([0.0, 0.1, 0.0, 0.0, 3e-4, 0.0]))
    problem = Problem.of(BARE, data, "given", prior=Prior({}, earlier))
    x = TRUTH
    jacobian = BARE.jacobian(data.postures, x).reshape(-1, 6) / SIGMA
    residual = (data.positions - BARE.position(data.postures, x)).ravel() / SIGMA

    drops = released_drops(problem, x)
    information = jacobian.T @ jacobian
    alone = x + np.linalg.solve(information, jacobian.T @ residual)
    for k, name in enumerate(BARE.names):
        others = np.delete(np.arange(6), k)
        precision = np.zeros((6, 6))
        precision[np.ix_(others, others)] = np.linalg.inv(earlier.covariance[np.ix_(others, others)])
        mixed = np.linalg.inv(information + precision)
        at = mixed @ (information @ alone + precision @ np.where(np.arange(6) == k, 0.0, means(earlier)))
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
        earlier, data = before(generator), of_complex(generator, 10, TRUTH, factor * SIGMA)
        accused += contradicted(Problem.of(BARE, data, prior=(prior := Prior({}, earlier))), prior, TRUTH) is not None
    assert accused <= 3


@pytest.mark.parametrize("sigma", [None, "given", "estimated"])
def test_a_moved_zero_is_named_with_what_the_data_say(sigma: str | None) -> None:
    """By 0.8 deg. The new zero is the old one and its change, from least squares with the prior of the others."""
    generator = np.random.default_rng(7)
    earlier, moved = before(generator), TRUTH + np.radians(0.8) * np.eye(6)[4]
    data = of_complex(generator, 20, moved)
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
            rows = (data.positions - BARE.position(data.postures, x)).ravel() / SIGMA
            return np.r_[rows, root @ (x - means(earlier))[others]]

        oracle = least_squares(residuals, moved, x_scale=np.abs(means(earlier)), xtol=1e-14)
        change = precision / precision[4]
        value, information = means(earlier)[4] + change @ (oracle.x - means(earlier)), oracle.jac.T @ oracle.jac
        assert one.value == pytest.approx(np.degrees(value), abs=1e-3 * one.std)
        assert one.std == pytest.approx(np.degrees((change @ np.linalg.inv(information) @ change) ** 0.5), rel=1e-3)
    assert found.warnings[0].startswith("the measurements contradict the prior: joint_offset:2 is ")
    assert "--only joint_offset:2" in found.warnings[0]
    assert with_prior(earlier, of_complex(generator, 20, TRUTH), sigma).contradiction is None


def test_a_zero_that_moved_is_told_from_what_the_earlier_data_left_open() -> None:
    """Two zeros of which their sum is known to 1e-5 rad and each to 1e-2: that of the one moved, with the other as
    there, to 1e-5; of a length and a zero that explain it as well, the zero is named."""
    generator, difference = np.random.default_rng(4), np.array([0.0, 0.0, 0.0, 1.0, -1.0, 0.0])
    covariance = np.diag([1e-2, 1e-2, 1e-2, 1e-10, 1e-10, 1e-10]) + 1e-4 * np.outer(difference, difference)
    earlier = Calibration(dict(zip(BARE.names, TRUTH.tolist(), strict=True)), BARE.names, covariance)
    one = with_prior(earlier, of_complex(generator, 20, TRUTH + 0.01 * np.eye(6)[4]), "given").contradiction
    assert one is not None
    assert one.name.startswith("joint_offset")
    assert one.prior_std < 1e-3 < one.value - one.prior - 3.0 * one.std


def test_too_few_rows_to_tell() -> None:
    """Two rows without a sigma: six unknowns and four equations; nothing is said."""
    generator = np.random.default_rng(8)
    earlier, data = before(generator), of_complex(generator, 2, TRUTH + 0.01 * np.eye(6)[4])
    assert with_prior(earlier, data, "estimated").contradiction is None
    one = with_prior(earlier, data, "given").contradiction
    assert one is not None
    assert "joint_offset:2" in {one.name, *one.instead}  # which of them is for more rows to tell


def test_an_error_of_degrees_accuses_no_length() -> None:
    """The tip of a zero 3 deg off moves on an arc, by 0.5 mm from its tangent, which looks like another length."""
    for seed in range(12):
        generator = np.random.default_rng([5, seed])
        earlier, moved = before(generator), TRUTH + np.radians(3.0) * np.eye(6)[3 + seed % 3]
        one = with_prior(earlier, of_complex(generator, 10, moved)).contradiction
        assert one is not None
        assert one.name == f"joint_offset:{1 + seed % 3}"


def test_few_rows_with_their_sigma_accuse_a_zero_that_moved() -> None:
    """By 0.15 deg; four rows, which by chance scatter by more than sigma in some of the sets."""
    for seed in range(24):
        generator = np.random.default_rng([5, seed])
        earlier, moved = before(generator), TRUTH + np.radians(0.15) * np.eye(6)[3 + seed % 3]
        assert with_prior(earlier, of_complex(generator, 4, moved)).contradiction is not None
