"""Quadratic forms against their matrices, and the moments of their ratios against sums over eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest

from identification.gap.noise.quadratic_forms import BlockForm, Form, LagForm, ratio, ratio_moments, ratios

RNG = np.random.default_rng(7)
HALF = RNG.normal(size=(9, 2, 2))
FORMS = [BlockForm(HALF + HALF.transpose(0, 2, 1)), LagForm(RNG.permutation(9), 2)]


def matrix_of(form: Form) -> np.ndarray:
    """(18, 18), written out."""
    full = np.zeros((9, 2, 9, 2))
    if isinstance(form, BlockForm):
        for i, block in enumerate(form.blocks):
            full[i, :, i, :] = block
    else:
        for before, after in zip(form.sequence[:-1], form.sequence[1:], strict=True):
            full[before, :, after, :] = full[after, :, before, :] = 0.5 * np.eye(2)
    return full.reshape(18, 18)


@pytest.mark.parametrize("form", FORMS)
def test_products_and_traces(form: Form) -> None:
    matrix, sample = matrix_of(form), RNG.normal(size=(18, 5))
    np.testing.assert_allclose(form.times(sample), matrix @ sample, atol=1e-12)
    assert form.trace == pytest.approx(np.trace(matrix), abs=1e-12)
    assert form.squared_trace == pytest.approx(np.trace(matrix @ matrix))
    expected = [e @ matrix @ e / (e @ e) for e in sample.T]
    np.testing.assert_allclose(ratio(form, sample), expected)
    for forms in ({"one": form}, {"one": form, "other": FORMS[0]}):
        np.testing.assert_allclose(ratios(forms, sample)["one"], expected)


@pytest.mark.parametrize("form", FORMS)
def test_moments_under_white_noise(form: Form) -> None:
    """In the eigenbasis of P A P the ratio is sum l_k w_k with w uniform on the simplex of squares (Dirichlet 1/2)."""
    q = np.linalg.qr(RNG.normal(size=(18, 4)))[0]
    left = np.linalg.svd(np.eye(18) - q @ q.T)[0][:, :14]
    values = np.linalg.eigvalsh(left.T @ matrix_of(form) @ left)
    # Dirichlet(1/2 .. 1/2) of 14 parts: variance (1/14)(13/14)/8, covariance -(1/14)^2/8
    covariance = (np.eye(14) / 14 - 1.0 / 14**2) / 8.0
    mean, deviation = ratio_moments(form, q)
    assert mean == pytest.approx(values.mean())
    assert deviation == pytest.approx(np.sqrt(values @ covariance @ values))
