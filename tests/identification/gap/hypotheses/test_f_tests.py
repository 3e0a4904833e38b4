"""F statistics of many hypotheses at once against one least-squares fit per hypothesis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from identification.gap.hypotheses.f_tests import Columns, Dictionary, dictionary
from identification.information import column_space

SEEDS = st.integers(0, 10_000)
SIZES = st.lists(st.integers(1, 4), min_size=1, max_size=6)  # columns of each hypothesis


def basis(jacobian: np.ndarray) -> np.ndarray:
    return column_space(jacobian, np.ones(jacobian.shape[1]))


def beside(
    jacobian: np.ndarray, columns: list[np.ndarray], one_sided: Sequence[bool] = (), weights: Sequence[float] = ()
) -> Dictionary:
    """Hypotheses about any sign and of equal weights where nothing else is said."""
    signs = np.array(one_sided or [False] * len(columns))
    return dictionary(
        basis(jacobian), Columns.of(columns, len(jacobian)), signs, np.array(weights or [1.0] * len(columns))
    )


def _problem(seed: int, sizes: list[int]) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    rng = np.random.default_rng(seed)
    jacobian = rng.standard_normal((40, 6)) * 10.0 ** rng.uniform(-3, 3, 6)
    columns = [rng.standard_normal((40, d)) * 10.0 ** rng.uniform(-4, 4) for d in sizes]
    return jacobian, columns, rng.standard_normal(40)


@given(seed=SEEDS, sizes=SIZES)
@settings(max_examples=40)
def test_f_and_p_are_those_of_two_nested_fits(seed: int, sizes: list[int]) -> None:
    jacobian, columns, y = _problem(seed, sizes)
    tested = beside(jacobian, columns)
    q = basis(jacobian)
    residual = (y - q @ (q.T @ y))[:, None]
    reductions = tested.reductions(residual)
    squares = np.square(residual).sum(axis=0)
    for k, added in enumerate(columns):
        scaled = jacobian / np.linalg.norm(jacobian, axis=0)
        without = np.linalg.lstsq(scaled, y, rcond=None)[1][0]
        both = np.hstack([scaled, added / np.linalg.norm(added, axis=0)])
        with_it = np.linalg.lstsq(both, y, rcond=None)[1][0]
        d, rest = added.shape[1], 40 - 6 - added.shape[1]
        f = (without - with_it) / d / (with_it / rest)
        assert tested.f_values(reductions, squares)[k, 0] == pytest.approx(f, rel=1e-6)
        assert tested.p_values(reductions, squares)[k, 0] == pytest.approx(stats.f.sf(f, d, rest), rel=1e-5)


def test_forbidden_sign_is_no_evidence_and_the_allowed_one_is_a_one_sided_t_test() -> None:
    jacobian, columns, _ = _problem(3, [1])
    q = basis(jacobian)
    for sign in (1.0, -1.0):
        y = sign * 2.0 * columns[0][:, 0] / np.linalg.norm(columns[0]) + 0.3 * np.random.default_rng(1).normal(size=40)
        residual = (y - q @ (q.T @ y))[:, None]
        tested = beside(jacobian, columns, [True])
        p = tested.p_values(tested.reductions(residual), np.square(residual).sum(axis=0))[0, 0]
        if sign < 0.0:
            assert p == 1.0
            continue
        both = np.hstack([jacobian, columns[0]])
        inverse = np.linalg.inv(both.T @ both)
        estimate = inverse @ both.T @ y
        left = y - both @ estimate
        t = estimate[-1] / np.sqrt(inverse[-1, -1] * (left @ left) / 33)
        assert p == pytest.approx(stats.t.sf(t, 33), rel=1e-6)


def test_the_fraction_left_is_that_of_the_direction_hidden_most() -> None:
    """One column is the model's own but for a hundredth, its companion is free of it: what is left of both is what is
    left of the first."""
    axes = np.eye(40)
    jacobian = axes[:, :2]
    hidden = np.cos(0.01) * axes[:, 0] + np.sin(0.01) * axes[:, 2]
    tested = beside(jacobian, [np.stack([3.0 * hidden, 70.0 * axes[:, 3]], axis=1), axes[:, 4:6]])
    np.testing.assert_allclose(tested.norm_fractions, [np.sin(0.01), 1.0], rtol=1e-9)


def test_columns_inside_the_model_are_invisible() -> None:
    jacobian, _, _ = _problem(5, [1])
    inside = jacobian @ np.array([[1.0], [2.0], [0.0], [0.0], [0.0], [0.5]])
    half = np.hstack([inside, np.random.default_rng(0).normal(size=(40, 1))])
    tested = beside(jacobian, [inside, half, np.zeros((40, 1))])
    assert tested.sizes.tolist() == [0, 1, 0]


def test_smallest_weighted_p_value_is_the_smallest_over_all() -> None:
    jacobian, columns, _ = _problem(7, [1, 2, 1, 3, 2])
    weights = np.array([1.0, 0.1, 1.0, 1.0, 0.5])
    tested = beside(jacobian, columns, [True, False, False, False, False], weights.tolist())
    q = basis(jacobian)
    drawn = np.random.default_rng(8).normal(size=(40, 30))
    drawn -= q @ (q.T @ drawn)
    reductions, squares = tested.reductions(drawn), np.square(drawn).sum(axis=0)
    scores = tested.scores(tested.columns.matrix.T @ drawn, tested.model_basis.T @ drawn)
    expected = (tested.p_values(reductions, squares) / weights[:, None]).min(axis=0)
    np.testing.assert_allclose(tested.smallest_weighted(scores, squares), expected)


def test_subset_keeps_the_columns_of_its_members() -> None:
    jacobian, columns, y = _problem(9, [2, 1, 3, 1])
    tested = beside(jacobian, columns)
    part = tested.subset(np.array([0, 2]))
    np.testing.assert_allclose(part.reductions(y[:, None]), tested.reductions(y[:, None])[[0, 2]])


@given(seed=SEEDS, sizes=SIZES)
@settings(max_examples=20)
def test_a_block_is_a_basis_of_what_only_its_hypothesis_explains(seed: int, sizes: list[int]) -> None:
    jacobian, columns, _ = _problem(seed, sizes)
    tested = beside(jacobian, columns)
    q = basis(jacobian)
    for k, own in enumerate(columns):
        left = own - q @ (q.T @ own)
        block = tested.block(k)
        np.testing.assert_allclose(block.T @ block, np.eye(own.shape[1]), atol=1e-9)
        np.testing.assert_allclose(block @ (block.T @ left), left, atol=1e-9 * np.abs(left).max())
        place = tested.columns.places(own.shape[1])[0].tolist().index(k)
        before, after = (products[place] for products in tested.products[own.shape[1]])
        np.testing.assert_allclose(before, own.T @ own, rtol=1e-12)
        np.testing.assert_allclose(after, left.T @ left, rtol=1e-8, atol=1e-9 * np.abs(before).max())


def test_columns_in_pieces_are_the_columns() -> None:
    matrix = np.random.default_rng(4).normal(size=(700, 5000))
    columns = Columns(matrix, np.full(2500, 2))
    assert sum(1 for _ in columns.chunks(2)) > 2  # pieces of about a million numbers
    assert all(part.start % 2 == 0 for part in columns.chunks(2))
    np.testing.assert_allclose(columns.products[2][7], matrix[:, 14:16].T @ matrix[:, 14:16], rtol=1e-12)


def test_no_hypothesis_reduces_nothing() -> None:
    jacobian, _, y = _problem(0, [])
    assert beside(jacobian, []).reductions(np.column_stack([y, y, y])).shape == (0, 3)
