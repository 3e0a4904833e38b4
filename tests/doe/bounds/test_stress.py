"""Plans and weights far from any real arm. `--hypothesis-profile stress` tries thousands.

Oracle: with E = exp(i(q_1 + .. + q_j)) of the postures and G = E^H W E, log det M' = 2 log det G whatever the lengths,
since M' = [[Re G, -Im G], [Im G, Re G]] in lengths and orientations.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe import DesignProblem, score, solve
from doe.bounds.column_generation import relax
from identification import Arm, ArmcalError, JobError, Model

FEW = settings(max_examples=max(settings.default.max_examples // 10, 10))  # type: ignore[union-attr]
WIDTHS = st.sampled_from([1e-6, 1e-3, 0.1, 10.0, 90.0, 360.0])
CONDITION = 1e-12  # smallest eigenvalue of G / m from which a determinant keeps digits in double precision


def problem_of(lengths: np.ndarray, width: float) -> DesignProblem:
    """width : of every joint's limits [deg]"""
    half = np.full(len(lengths), np.radians(width) / 2.0)
    return DesignProblem.of(Model(Arm(tuple(lengths), lower=-half, upper=half, sigma=0.1)))


def falling(n: int, generator: np.random.Generator) -> np.ndarray:
    """Links from 1e6 to 1e-3 mm, the longest at the base; behind a long link short ones are as certain as ever."""
    return np.sort(10.0 ** np.r_[6.0, generator.uniform(-3.0, 6.0, n - 1)])[::-1]


def oracle(postures: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """log det M', and the smallest eigenvalue of G."""
    columns = np.exp(1j * np.cumsum(postures, axis=1))
    gram = (columns.conj().T * weights) @ columns
    return 2.0 * np.linalg.slogdet(gram)[1], float(np.linalg.eigvalsh(gram)[0])


@given(n=st.sampled_from([1, 2, 3]), width=WIDTHS, wild=st.booleans(), seed=st.integers(0, 2**32))
@FEW
def test_weights_are_what_they_say_or_nothing_is_said(n: int, width: float, wild: bool, seed: int) -> None:
    lengths = falling(n, np.random.default_rng(seed)) if wild else np.full(n, 100.0)
    try:
        found = relax(problem_of(lengths, width), 5)
    except JobError as error:
        found, said = None, str(error)
    if found is None:
        assert "identif" in said
        assert width < 1e-2
        return
    expected, smallest = oracle(found.plan.postures, found.plan.shares)
    if smallest > CONDITION:  # each eigenvalue is rounded by that of the largest, 1
        assert found.value == pytest.approx(expected, abs=1e-9 + 100.0 * n * np.finfo(float).eps / smallest)
    if found.bound is not None:
        assert found.bound.value >= found.value - 1e-8
        assert found.bound.value <= 1e-8  # no weights are better than orthogonal columns
        assert 0.0 <= found.efficiency_lower_bound <= 1.0 + 1e-8


@given(n=st.sampled_from([1, 2, 3, 12]), width=WIDTHS, runs=st.integers(1, 40), seed=st.integers(0, 2**32))
@FEW
def test_a_plan_is_what_it_says_whatever_the_lengths(n: int, width: float, runs: int, seed: int) -> None:
    problem = problem_of(falling(n, np.random.default_rng(seed)), width)
    try:
        found = solve(problem, runs, seed=seed, starts=1, seconds=2.0)
    except ArmcalError:
        found = None
    if found is None:  # too few, or no room for postures a degree apart
        assert runs <= n or width < 2.0 * runs
        return
    expected, _ = oracle(found.plan.postures, np.full(runs, 1.0 / runs))
    assert found.value == pytest.approx(expected, abs=1e-9)
    assert found.value <= found.bound.value + 1e-9
    assert score(problem_of(np.full(n, 100.0), width), found.plan).value == pytest.approx(found.value, abs=1e-9)


def test_a_thousand_runs_of_twelve_links() -> None:
    found = solve(problem_of(falling(12, np.random.default_rng(1)), 360.0), 1000)
    assert found.value == pytest.approx(0.0, abs=1e-9)
    assert found.certified_optimal
