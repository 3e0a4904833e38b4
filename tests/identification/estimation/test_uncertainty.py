"""What intervals rely on: a sigma that holds, the scatter, a sandwich; and what is taken as independent.

The clustered sandwich against textbook formulas, dense matrices from the definition, and exact expectations. Rows that
a model does not explain: found whatever holds its parameters.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import sqrtm

from identification import DHRow, InputError, Measurements, Model, chain_of, estimate, spectrum
from identification.arm import Arm, Machining
from identification.estimation.doubts import copied_rows, left_out_residuals
from identification.estimation.uncertainty import (
    WhiteRows,
    lack_of_fit,
    outlying,
    quantile_95,
    sandwich,
    studentised,
    together,
    uncertainty,
)
from identification.inspection.inspection import inspect
from tests.identification.estimation.cases import SIGMA, TRUTH, arm, data, plan
from tests.small_arm import OTHERS, drawn_arm, measured, random_postures, small_arm


def fitted(columns: np.ndarray, values: np.ndarray, postures: np.ndarray | None = None) -> tuple[WhiteRows, np.ndarray]:
    """Rows (m, p) of one coordinate, fitted to values (m,), and (p, rank) root of the covariance."""
    residual = values - columns @ np.linalg.lstsq(columns, values)[0]
    m, p = columns.shape
    numbers = np.arange(m) if postures is None else postures
    decomposed = spectrum(columns, np.ones(p))
    rows = WhiteRows(columns[:, None, :], residual[:, None], decomposed, p, np.arange(m), numbers, numbers)
    return rows, decomposed.root


def test_reflectors_of_one_posture_count_as_what_they_show_together() -> None:
    """A posture shows two numbers in six rows, mixed in the same way each time: of new postures the fit is off by
    E tr(Z B Z^T), Z (6, p), which rows counted one by one make less than half; the leverages do not. With equal
    leverages it is 1 - p / N, however often each row is repeated."""
    rng, mixed, shown, one_by_one = np.random.default_rng(8), np.random.default_rng(7).normal(size=(6, 2)), [], []
    for _ in range(200):
        columns, fresh = (np.einsum("rk,gkp->grp", mixed, rng.normal(size=(g, 2, 8))) for g in (10, 200))
        rows, root = fitted(columns.reshape(60, 8), np.zeros(60), np.repeat(np.arange(10), 6))
        out = np.sum((fresh @ root) ** 2) / 200
        shown.append(8 / 10 / rows.inside / out)
        one_by_one.append(8 / 10 / (1.0 - 8 / 60) / out)
    assert np.mean(shown) == pytest.approx(1.0, abs=0.2)
    assert np.mean(one_by_one) < 0.5
    orthogonal = np.linalg.qr(np.exp(2j * np.pi * np.outer(np.arange(8), [0, 1, 3]) / 8))[0]
    columns = np.concatenate([orthogonal.real, -orthogonal.imag], axis=1)
    for times in (1, 3):
        numbers = np.repeat(np.arange(8), 2 * times)
        stacked = np.stack([columns, np.concatenate([orthogonal.imag, orthogonal.real], axis=1)], axis=1)
        rows, _ = fitted(np.repeat(stacked, times, axis=0).reshape(-1, 6), np.zeros(16 * times), numbers)
        assert rows.inside == pytest.approx(1.0 - 6 / 16)


# -- which one is used -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("factor", "rows", "kind", "said"),
    [
        (1.0, 30, "given", False),  # what chi2 does not reject
        (0.25, 30, "sandwich", True),
        (4.0, 30, "scatter", False),  # too large is no misfit
        (0.01, 5, "scatter", True),  # of 5 postures with 8 parameters each determines much by itself
    ],
)
def test_what_is_relied_upon(factor: float, rows: int, kind: str, said: bool) -> None:
    model, measurements = Model(arm(sigma=factor * SIGMA)), data(Model(arm()), plan(rows))
    found, free, given = (estimate(model, measurements, sigma=sigma) for sigma in (None, "estimated", "given"))
    assert (found.uncertainty.kind, free.uncertainty.kind, given.uncertainty.kind) == (kind, "scatter", "given")
    assert (found.misfit is not None) is (given.misfit is not None and "too narrow" in given.misfit) is said
    assert free.misfit is None
    assert found.warnings[: int(said)] == ((found.misfit,) if said else ())
    assert found.to_json()["clusters"] == ({"kind": "rows", "count": rows} if kind == "sandwich" else None)
    assert found.sigma == factor * SIGMA  # as given
    assert found.scatter == pytest.approx(free.sigma)
    np.testing.assert_array_equal(given.intervals, estimate(model, measurements, sigma=factor * SIGMA).intervals)
    if kind == "sandwich":  # of the same size as from the scatter: the model is complete
        assert np.all((found.std / free.std > 0.5) & (found.std / free.std < 2.0))
        width = 2.0 * quantile_95(found.uncertainty.freedom) * found.std
        np.testing.assert_allclose(np.diff(found.intervals, axis=1)[:, 0], width)
        assert str(found).startswith("misfit: the residuals scatter ")
    with pytest.raises(InputError, match="sigma: 'given', but none is given"):
        estimate(Model(arm()), measurements, sigma="given")


@pytest.mark.parametrize(("factor", "ripple"), [(1.0, 0.0), (0.3, 0.0), (1.0, 2e-3)])
def test_intervals_hold_whatever_sigma_is_and_with_a_ripple_that_is_not_modelled(factor: float, ripple: float) -> None:
    """Coverage of 8 parameters in 80 sets of 20 postures; 3.5 standard errors, sets counting as independent."""
    rng, model, held = np.random.default_rng(8), Model(arm(sigma=factor * SIGMA)), []
    for _ in range(80):
        q = rng.uniform(-np.pi, np.pi, (20, 4))
        real = q + ripple * np.cos(17.0 * q)
        measured = Measurements(q, model.position(real, TRUTH) + SIGMA * rng.standard_normal((20, 2)))
        low, high = estimate(model, measured).intervals.T
        held.append(np.mean((low <= TRUTH) & (high >= TRUTH)))
    assert abs(np.mean(held) - 0.95) < 3.5 * np.std(held) / np.sqrt(len(held)) + 0.005


# -- what is independent -----------------------------------------------------------------------------------------------
def test_repeats_of_one_posture_are_taken_together() -> None:
    """What is left unexplained is the same in each repeat: as many facts as postures, not as rows."""
    rng, model = np.random.default_rng(9), Model(arm(sigma=SIGMA / 10.0))
    q, times = rng.uniform(-np.pi, np.pi, (30, 4)), np.tile(np.arange(30), 5)
    error = SIGMA * rng.standard_normal((30, 2))
    exact = model.position(q, TRUTH)
    noise = SIGMA / 10.0 * rng.standard_normal((150, 2))
    found = estimate(model, Measurements(q[times], (exact + error)[times] + noise))
    assert found.to_json()["clusters"] == {"kind": "postures", "count": 30}
    once = estimate(model, Measurements(q, exact + error), sigma="estimated")
    assert np.all((found.std / once.std > 0.5) & (found.std / once.std < 2.0))
    unaware = estimate(Model(arm()), Measurements(q[times], (exact + error)[times] + noise))
    assert unaware.uncertainty.kind == "sandwich"  # lack of fit against the repeats, without any sigma


def autoregression(rng: np.random.Generator, m: int, rho: float) -> np.ndarray:
    """Stationary, of variance one."""
    noise = rng.standard_normal(m)
    for k in range(1, m):
        noise[k] = rho * noise[k - 1] + np.sqrt(1.0 - rho**2) * noise[k]
    return noise


def test_rows_that_are_correlated_in_time_are_taken_in_stretches() -> None:
    """A mean and a slope: the exact variance of the estimates under an autoregression, from its covariance matrix."""
    m, rho = 800, 0.8
    columns = np.column_stack([np.ones(m), np.linspace(-1.0, 1.0, m)])
    bread = np.linalg.inv(columns.T @ columns)
    exact = bread @ columns.T @ rho ** np.abs(np.subtract.outer(np.arange(m), np.arange(m))) @ columns @ bread
    rng, variances = np.random.default_rng(10), []
    for _ in range(30):
        rows, _ = fitted(columns, autoregression(rng, m, rho))
        found = uncertainty(rows, sigma_given=False)
        assert (found.kind, found.clusters) == ("sandwich", "stretches")
        assert found.count == m // rows.correlated
        variances.append(np.diag(found.covariance))
    # stretches of finite length miss the correlation across their ends: some tenth of it
    np.testing.assert_allclose(np.mean(variances, axis=0), np.diag(exact), rtol=0.25)
    assert np.all(np.diag(exact) > 8.0 * np.diag(bread))


def test_white_noise_is_seldom_taken_for_correlated() -> None:
    rng, columns = np.random.default_rng(11), np.column_stack([np.ones(60), np.linspace(-1.0, 1.0, 60)])
    sets = (fitted(columns, rng.standard_normal(60)) for _ in range(400))
    assert np.mean([rows.correlated > 1 for rows, _ in sets]) < 0.03


def test_lack_of_fit_is_the_f_test_of_the_analysis_of_variance() -> None:
    """A constant fitted to 4 samples: Fisher's one-way analysis of variance."""
    rng = np.random.default_rng(14)
    samples = [rng.standard_normal(size) + shift for size, shift in ((3, 0.0), (5, 0.6), (2, -0.4), (6, 0.1))]
    numbers = np.repeat(np.arange(4), [3, 5, 2, 6])
    rows, _ = fitted(np.ones((16, 1)), np.concatenate(samples), numbers)
    assert lack_of_fit(rows.residual, numbers, 1.0) == pytest.approx([*stats.f_oneway(*samples)])
    assert lack_of_fit(rows.residual, np.arange(16), 1.0) == (0.0, 1.0)


def test_at_an_active_bound_the_robust_interval_is_that_without_it() -> None:
    """A slope that cannot be negative ends at 0; its interval is that of the slope behind the bound."""
    rng, columns = np.random.default_rng(15), np.column_stack([np.ones(40), np.linspace(-1.0, 1.0, 40)])
    values = -5.0 * columns[:, 1] + rng.standard_normal(40)
    free, _ = fitted(columns, values)
    bounded = replace(free, residual=(values - values.mean())[:, None])
    assert bounded.correlated > 1  # what the bound leaves looks like correlation in time
    found, without = (
        uncertainty(rows, sigma_given=True) for rows in (bounded, replace(free, residual=2.0 * free.residual))
    )
    assert found.kind == without.kind == "sandwich"
    np.testing.assert_allclose(4.0 * found.covariance, without.covariance, rtol=1e-10)


# -- rows of one posture -----------------------------------------------------------------------------------------------
def test_rows_that_are_copied_with_their_digits_are_counted_once() -> None:
    """24 rows, and 30 times the same: the same fit, deviations and freedom, with a warning."""
    for sigma in (None, SIGMA):
        model = Model(arm(sigma=sigma))
        once = data(model, plan(24))
        again = once.rows(np.tile(np.arange(24), 30))
        found, copies, seen = estimate(model, once), estimate(model, again), inspect(model.arm, again).data
        np.testing.assert_allclose(copies.parameters, found.parameters, rtol=1e-9)
        np.testing.assert_allclose(copies.covariance, found.covariance, rtol=1e-6)
        assert (copies.dof, copies.uncertainty.kind) == (found.dof, found.uncertainty.kind)
        predicted = left_out_residuals(copies, again)
        np.testing.assert_allclose(predicted, np.tile(left_out_residuals(found, once), (30, 1)), rtol=1e-6, atol=1e-9)
        assert [said for said in copies.warnings if said not in found.warnings] == copied_rows(again)
        assert [seen[key] for key in ("numbers", "repeats_mm", "close_repeats_mm")] == [48, None, None]


SHORT = ((0.0, np.pi / 2.0, 300.0), (-420.0, 0.0, 0.0), (-390.0, 0.0, 60.0))  # a [mm], alpha [rad], d [mm]
REFLECTORS = {
    "a": np.array([60.0, 40.0, 100.0]),
    "b": np.array([-80.0, 30.0, 60.0]),
    "c": np.array([10.0, -90.0, 80.0]),
}


@cache
def short_arm(sigma: float | None) -> Model:
    """Made so well that its positions are linear in the errors, to 0.001 mm."""
    chain = replace(chain_of([DHRow(*row) for row in SHORT]), tools=REFLECTORS)
    return Model(replace(Arm(chain, sigma=sigma), machining=Machining(0.2, np.radians(0.1))))


def reflectors(
    generator: np.random.Generator, kind: str, size: float, sigma: float | None, postures: int = 30
) -> tuple[Model, Measurements, np.ndarray]:
    """An arm in space, its rows, and the errors of its geometry: three reflectors at each posture, twice; noise of
    0.05 mm, and errors that all six rows of a posture share.

    kind : `settling`, of joints that are not where they are read; `tip`, that is elsewhere; `wave`, one in each joint
    size : of the tip's errors [mm], about
    """
    model, angle = short_arm(sigma), size / 800.0
    errors = model.parameters.vector(model.prior, 0.0) * generator.standard_normal(len(model.names))
    q = generator.uniform(-2.5, 2.5, (postures, len(SHORT)))
    real, moved = q, size * generator.standard_normal((postures, 3)) if kind == "tip" else np.zeros((postures, 3))
    if kind == "settling":
        real = q + angle * generator.standard_normal(q.shape)
    if kind == "wave":
        order, phase = generator.integers(9, 30, q.shape[1]), generator.uniform(0.0, 2.0 * np.pi, q.shape[1])
        real = q + np.sqrt(2.0) * angle * np.cos(order * q + phase)
    posture = np.tile(np.repeat(np.arange(postures), 3), 2)
    rows = Measurements(q[posture], np.zeros((len(posture), 3)), marker=np.tile(list(REFLECTORS), 2 * postures))
    exact = model.position(real[posture], model.values + errors, rows.conditions) + moved[posture]
    return model, replace(rows, positions=exact + 0.05 * generator.standard_normal(exact.shape)), errors


@pytest.mark.parametrize(
    ("kind", "size", "sigma", "sets"),
    [
        ("tip", 0.1, None, 10),
        pytest.param("settling", 0.1, None, 250, marks=pytest.mark.slow),
        pytest.param("tip", 0.1, None, 250, marks=pytest.mark.slow),
        pytest.param("wave", 0.1, 0.05, 250, marks=pytest.mark.slow),
        pytest.param("tip", 0.0, 0.05, 250, marks=pytest.mark.slow),
    ],
)
def test_intervals_hold_where_postures_have_several_rows(
    kind: str, size: float, sigma: float | None, sets: int
) -> None:
    """The values of the geometry, drawn from its prior: 95 % intervals hold 0.93 to 0.97 of them (4 kinds of 250 sets:
    `pytest -m slow`); few sets are allowed 3.5 standard errors more. Rows taken as independent hold 0.8 of them."""
    held = []
    for k in range(sets):
        model, rows, errors = reflectors(np.random.default_rng([16, k]), kind, size, sigma)
        found = estimate(model, rows)
        truth, kept = errors[[name in model.prior for name in model.names]], [n in model.prior for n in found.names]
        low, high = found.intervals[kept].T
        held.append((low <= truth) & (high >= truth))
    shares = np.mean(held, axis=1)
    assert 0.93 - (error := 3.5 * np.std(shares) / np.sqrt(sets)) < np.mean(shares) < 0.97 + error


GROUPS = np.array([0, 0, 0, 1, 2, 2, 3, 3, 3, 3, 4, 4, 5, 5, 6, 7])  # of 16 rows, of different sizes


def problem(seed: int = 0, d: int = 2, p: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(m, d, p) Jacobian, (m, d) residuals of a fit and (p, p) root of the covariance (not triangular, any will do)."""
    rng = np.random.default_rng(seed)
    jacobian = rng.standard_normal((len(GROUPS), d, p))
    flat = jacobian.reshape(-1, p)
    residual = (np.eye(len(flat)) - flat @ np.linalg.pinv(flat)) @ rng.standard_normal(len(flat))
    return jacobian, residual.reshape(-1, d), np.linalg.cholesky(np.linalg.inv(flat.T @ flat))


def added(jacobian: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """(p, N + r, G) what errors of the N data and r rows of a prior add to the estimates through the residuals of each
    group, from the definition, with matrices of all rows."""
    d, flat = jacobian.shape[1], np.concatenate([jacobian.reshape(-1, jacobian.shape[2]), prior])
    bread = np.linalg.inv(flat.T @ flat)
    rest, parts = np.eye(len(flat)) - flat @ bread @ flat.T, []
    for g in range(GROUPS.max() + 1):
        own = np.flatnonzero(np.repeat(GROUPS, d) == g)
        half = np.linalg.inv(np.real(sqrtm(rest[np.ix_(own, own)])))
        parts.append((rest[:, own] @ half @ flat[own] @ bread).T)
    return np.stack(parts, axis=2)


def freedom_of(of_parameter: np.ndarray, fixed: float = 0.0) -> float:
    """Satterthwaite's, of the quadratic form of (N + r, G) and a part that is no estimate."""
    values = np.linalg.eigvalsh(of_parameter.T @ of_parameter)
    return float((values.sum() + fixed) ** 2 / np.sum(values**2))


def test_what_two_of_many_groups_share_moves_no_interval_by_a_thousandth() -> None:
    """More than a thousand rows: what is left out of the degrees of freedom, against their definition."""
    rng, m = np.random.default_rng(1), 1001
    j, residual = rng.standard_normal((m, 2)), rng.standard_normal((m, 1))
    bread = np.linalg.inv(j.T @ j)
    found = sandwich(j[:, None], residual, np.linalg.cholesky(bread), np.arange(m))
    assert found is not None
    rest = np.eye(m) - j @ bread @ j.T
    for weights, freedom in zip((j @ bread / np.sqrt(np.diag(rest))[:, None]).T, found[1], strict=True):
        inner = weights[:, None] * rest * weights  # P P^T, as the projection `rest` is its own square
        exact = np.trace(inner) ** 2 / np.sum(inner**2)
        assert freedom != pytest.approx(exact, rel=1e-9)
        assert quantile_95(freedom) == pytest.approx(quantile_95(exact), rel=1e-3)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_equals_the_definition(d: int) -> None:
    jacobian, residual, root = problem(d, d)
    found = sandwich(jacobian, residual, root, GROUPS)
    assert found is not None
    parts = added(jacobian, np.zeros((0, 3)))
    scores = np.einsum("png,n->pg", parts, residual.ravel())
    np.testing.assert_allclose(found[0], scores @ scores.T, rtol=1e-9)
    np.testing.assert_allclose(found[1], [freedom_of(part) for part in parts], rtol=1e-9)


def test_with_a_prior_it_is_the_covariance_of_the_errors_if_the_model_is_complete() -> None:
    """The mean over white noise and over values drawn from the prior, exactly, is the posterior covariance, of whatever
    size the noise is; and the degrees of freedom are those of the matrix of the quadratic form."""
    jacobian, rows = problem(8)[0], np.random.default_rng(9).standard_normal((2, 3)) * 3.0
    flat, (m, d, p) = np.concatenate([jacobian.reshape(-1, 3), rows]), jacobian.shape
    bread = np.linalg.inv(flat.T @ flat)
    root = np.linalg.cholesky(bread)
    rest, total = np.eye(len(flat)) - flat @ bread @ flat.T, np.zeros((p, p))
    fixed = bread @ rows.T @ rows @ bread  # what the prior's own errors add
    for column in rest.T:  # residuals of the data after a fit to one error of one, of the data or of the prior
        found = sandwich(jacobian, 0.2 * column[: m * d].reshape(-1, d), root, GROUPS, 0.04)
        assert found is not None
        total += found[0] - 0.04 * fixed
    np.testing.assert_allclose(total + 0.04 * fixed, 0.04 * bread, rtol=1e-9)
    for k, part in enumerate(added(jacobian, rows)):
        assert found[1][k] == pytest.approx(freedom_of(part, fixed[k, k]), rel=1e-9)


def test_a_group_that_alone_determines_a_parameter_gives_none() -> None:
    jacobian = np.concatenate([np.ones((5, 1, 1)), np.zeros((5, 1, 1))], axis=2)
    jacobian[0, 0, 1] = 1.0
    root = np.linalg.cholesky(np.linalg.inv(jacobian[:, 0].T @ jacobian[:, 0]))
    assert sandwich(jacobian, np.zeros((5, 1)), root, np.arange(5)) is None


# -- rows that the model does not explain ------------------------------------------------------------------------------
@pytest.mark.parametrize("d", [2, 3])
def test_studentised_squares_are_chi_square_of_all_coordinates(d: int) -> None:
    """Many rows, few columns: the median of chi-square is scaled to its value, the rest of the distribution follows.

    4000 rows: an empirical quantile's standard error is sqrt(p (1 - p) / 4000) = 0.005 in probability at 0.9; fail
    beyond 4 of them.
    """
    rng = np.random.default_rng(9)
    residual, columns = 7.0 * rng.normal(size=(4000, d)), rng.normal(size=(4000 * d, 5))
    blocks = np.linalg.qr(columns)[0].reshape(4000, d, -1)
    squares = next(studentised(residual, blocks))
    assert np.median(squares) == pytest.approx(stats.chi2.median(d), rel=1e-9)
    assert np.mean(squares < stats.chi2.ppf(0.9, d)) == pytest.approx(0.9, abs=0.02)
    # a row is off that is as unlikely as 6 standard deviations in a plane
    limit, first = stats.chi2.isf(stats.chi2.sf(6.0**2, 2), d) / squares[0], residual[0].copy()
    for share in (0.9, 1.1):
        residual[0] = np.sqrt(share * limit) * first
        assert outlying(residual, blocks)[0] == (share > 1.0)


def test_with_a_prior_the_squares_are_those_of_the_prediction_without_the_row() -> None:
    """What a fit to the other rows says of a row, over the covariance of that difference, is the studentised square.

    Oracle: ridge regression without each row in turn. 12 rows of 3 coordinates, 30 parameters, which the prior holds.
    """
    rng = np.random.default_rng(3)
    m, d, p = 12, 3, 30
    columns, held, residual = rng.normal(size=(m, d, p)), np.diag(rng.uniform(0.5, 2.0, p)), rng.normal(size=(m, d))
    left = rng.normal(size=p)
    expected = []
    for i in range(m):
        others = np.arange(m) != i
        jacobian = np.concatenate([columns[others].reshape(-1, p), held])
        inverse = np.linalg.inv(jacobian.T @ jacobian)
        step = inverse @ jacobian.T @ np.concatenate([residual[others].ravel(), left])
        off, covariance = residual[i] - columns[i] @ step, np.eye(d) + columns[i] @ inverse @ columns[i].T
        expected.append(off @ np.linalg.solve(covariance, off))
    squares = np.array(expected) * stats.chi2.median(d) / np.median(expected)
    of_data, of_prior = np.split(np.linalg.qr(np.concatenate([columns.reshape(-1, p), held]))[0], [m * d])
    found = next(studentised(residual, of_data.reshape(m, d, -1), of_prior.T @ left))
    np.testing.assert_allclose(found, squares, rtol=1e-4)  # 1e-6 is added to each covariance


def test_without_the_row_that_alone_determines_a_column_the_fit_is_that_of_the_other_columns() -> None:
    rng = np.random.default_rng(2)
    columns, residual = rng.normal(size=(20, 4)), rng.normal(size=(20, 1))
    columns[1:, 3] = 0.0
    fits = studentised(residual, np.linalg.qr(columns)[0][:, None])
    next(fits)
    expected = next(studentised(residual[1:], np.linalg.qr(columns[1:, :3])[0][:, None]))
    np.testing.assert_allclose(fits.send(np.array([0])), [0.0, *expected], rtol=1e-9)


def test_outliers_that_hide_each_other_are_found_and_a_third_of_the_rows_is_structure() -> None:
    """Three of one direction and size, in 30 rows: none stands out beside the other two until one is taken out."""
    rng = np.random.default_rng(1)
    blocks, residual = np.linalg.qr(rng.normal(size=(60, 6)))[0].reshape(30, 2, 6), rng.normal(size=(30, 2))
    residual[[3, 4, 20]] += 25.0
    assert np.flatnonzero(outlying(residual, blocks)).tolist() == [3, 4, 20]
    residual, blocks = rng.normal(size=(30, 2)), np.linalg.qr(rng.normal(size=(60, 1)))[0].reshape(30, 2, 1)
    residual[:10] *= 1000.0
    assert not outlying(residual, blocks).any()
    residual[5:10] /= 1000.0
    assert np.flatnonzero(outlying(residual, blocks)).tolist() == list(range(5))


@pytest.mark.parametrize(("postures", "rows", "wrong"), [(50, 1, 3), (50, 1, 12), (30, 2, 3), (20, 3, 3), (30, 5, 20)])
def test_rows_that_are_wrong_independently_of_each_other_stay_outliers(postures: int, rows: int, wrong: int) -> None:
    """The chance is 1 in 1000: of 200 sets 3 or more would be beyond it with probability 0.001."""
    rng, kept = np.random.default_rng(postures + wrong), 0
    for _ in range(200):
        q, numbers = np.repeat(rng.uniform(-3, 3, (postures, 4)), rows, axis=0), np.repeat(np.arange(postures), rows)
        outlier = np.isin(np.arange(postures * rows), rng.choice(postures * rows, wrong, replace=False))
        kept += together(outlier, q, numbers).any()
    assert kept < 3


def test_whole_postures_and_a_stretch_of_one_joint_are_structure() -> None:
    """Nine of 491 postures with all three reflectors, and three rows alone; 12 of 300 rows where joint 2 is largest."""
    rng = np.random.default_rng(4)
    postures = rng.choice(491, 12, replace=False)
    outlier = np.zeros((491, 3), dtype=bool)
    outlier[postures[:9]] = True
    outlier[postures[9:], 1] = True
    q, numbers = np.repeat(rng.uniform(-3, 3, (491, 6)), 3, axis=0), np.repeat(np.arange(491), 3)
    found = together(outlier.ravel(), q, numbers).reshape(491, 3)
    assert sorted(postures[:9]) == np.flatnonzero(found.all(axis=1)).tolist()
    assert found.sum() == 27
    outlier = np.isin(numbers, postures[:1])  # a joint that was misread once is wrong in all rows of its posture
    assert not together(outlier, q, numbers).any()
    q = rng.uniform(-3.0, 3.0, (300, 6))
    largest = np.argsort(q[:, 1])[-12:]
    outlier = np.isin(np.arange(300), [*largest, *rng.choice(300, 3, replace=False)])
    assert set(largest) <= set(np.flatnonzero(together(outlier, q, np.arange(300))))


def test_postures_that_gravity_explains_are_no_outliers() -> None:
    """A small arm on three reflectors whose second joint has play: in four postures gravity pushes it the other way.

    Without gravity in the model their rows are the ones that stand out; three lost beams elsewhere are outliers still.
    """
    rng = np.random.default_rng(5)
    truth = small_arm(rng, *OTHERS, ("gravity_backlash", 2, {"b": 1e-3}))
    q, few = random_postures(150, rng), np.array([17, 51, 90, 133])
    q[:, 1] = rng.uniform(np.radians(-80.0), np.radians(-20.0), 150)
    q[few, 1] = np.radians(-110.0)
    data = measured(truth, q, rng)
    positions, wrong = data.positions.copy(), [10, 200, 330]
    positions[wrong] += [0.0, 4.0, -4.0]
    found = estimate(Model(drawn_arm(gravity=False)), replace(data, positions=positions))
    assert found.outlier_rows == (11, 201, 331)
    assert len([k for k in few if {3 * k + 1, 3 * k + 2, 3 * k + 3} <= set(found.unexplained_rows)]) >= 3
    assert any("whole postures" in doubt and "stay in the fit" in doubt for doubt in found.doubts)
