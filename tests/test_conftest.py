"""The switch `--disturb` changes last digits, and only those, the same way every time."""

from __future__ import annotations

import numpy as np
import pytest

from doe.problem.problem import DesignProblem
from tests.conftest import disturb
from tests.doe.arms import FOUR, problem


def test_disturbed_numbers_differ_in_their_last_digits_and_repeat(monkeypatch: pytest.MonkeyPatch) -> None:
    def drawn() -> tuple[np.ndarray, np.ndarray]:
        postures = np.random.default_rng(1).uniform(FOUR.lower, FOUR.upper, (6, 4))
        return postures, problem(FOUR).scaled_jacobians(np.round(postures, 3))

    before = drawn()
    for owner, name in ((np.random, "default_rng"), (DesignProblem, "scaled_jacobians")):
        monkeypatch.setattr(owner, name, getattr(owner, name))  # put back afterwards
    disturb(1e-10)
    for plain, disturbed, again, size in zip(before, drawn(), drawn(), (1e-9, 1e-11), strict=True):
        np.testing.assert_array_equal(disturbed, again)
        assert np.any(plain != disturbed)
        np.testing.assert_allclose(disturbed, plain, rtol=0, atol=size)
