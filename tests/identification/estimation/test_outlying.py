"""Rows that a model does not explain: found whatever holds its parameters, and left out where that is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from identification import Arm, Model, estimate
from identification.estimation.uncertainty import outlying, studentised, together
from identification.information import column_space
from identification.simulate import simulate
from tests.small_arm import OTHERS, drawn_arm, measured, random_postures, small_arm


@pytest.mark.parametrize("d", [2, 3])
def test_studentised_squares_are_chi_square_of_all_coordinates(d: int) -> None:
    """Many rows, few columns: the median of chi-square is scaled to its value, the rest of the distribution follows.

    4000 rows: an empirical quantile's standard error is sqrt(p (1 - p) / 4000) = 0.005 in probability at 0.9; fail
    beyond 4 of them.
    """
    rng = np.random.default_rng(9)
    residual, columns = 7.0 * rng.normal(size=(4000, d)), rng.normal(size=(4000 * d, 5))
    blocks = column_space(columns, np.ones(5))[0].reshape(4000, d, -1)
    squares = studentised(residual, blocks, np.ones(4000, dtype=bool), np.zeros((0, 5)), np.zeros(5))
    assert np.median(squares) == pytest.approx(chi2.median(d), rel=1e-9)
    assert np.mean(squares < chi2.ppf(0.9, d)) == pytest.approx(0.9, abs=0.02)
    # a row is off that is as unlikely as 6 standard deviations in a plane
    limit, first = chi2.isf(chi2.sf(6.0**2, 2), d) / squares[0], residual[0].copy()
    for share in (0.9, 1.1):
        residual[0] = np.sqrt(share * limit) * first
        assert outlying(residual, columns)[0] == (share > 1.0)


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
    squares = np.array(expected) * chi2.median(d) / np.median(expected)
    basis = column_space(np.concatenate([columns.reshape(-1, p), held]), np.ones(p))[0]
    blocks, known = basis[: m * d].reshape(m, d, -1), basis[m * d :]
    found = studentised(residual, blocks, np.ones(m, dtype=bool), known, known.T @ left)
    np.testing.assert_allclose(found, squares, rtol=1e-4)  # 1e-6 is added to each covariance


def test_outliers_that_hide_each_other_are_found_and_a_third_of_the_rows_is_structure() -> None:
    """Three of one direction and size, in 30 rows: none stands out beside the other two until one is taken out."""
    rng = np.random.default_rng(1)
    columns, residual = rng.normal(size=(60, 6)), rng.normal(size=(30, 2))
    residual[[3, 4, 20]] += 25.0
    assert np.flatnonzero(outlying(residual, columns)).tolist() == [3, 4, 20]
    residual, columns = rng.normal(size=(30, 2)), rng.normal(size=(60, 1))
    residual[:10] *= 1000.0
    assert not outlying(residual, columns).any()
    residual[5:10] /= 1000.0
    assert np.flatnonzero(outlying(residual, columns)).tolist() == list(range(5))


def test_a_fit_says_which_rows_it_does_not_explain() -> None:
    """A beam lost twice in 40 rows of noise 0.1 mm; the other rows of the same draw are explained."""
    arm, rng = Arm([300.0, 200.0, 150.0], sigma=0.1), np.random.default_rng(5)
    data = simulate(arm, rng.uniform(-3.0, 3.0, (40, 3)), rng)
    assert estimate(Model(arm), data).outlier_rows == ()
    positions = data.positions.copy()
    positions[[7, 30]] += [[2.0, -1.0], [0.0, 3.0]]
    found = estimate(Model(arm), replace(data, positions=positions))
    assert found.outlier_rows == (8, 31)
    assert found.doubts[-1].startswith("rows 8, 31: up to ")
    assert found.to_json()["outlier_rows"] == [8, 31]


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
    whole = [k for k in few if {3 * k + 1, 3 * k + 2, 3 * k + 3} <= set(found.unexplained_rows)]
    assert len(whole) >= 3
    assert any("whole postures" in doubt and "stay in the fit" in doubt for doubt in found.doubts)
