"""The bound on wrong names, against least squares on the stacked columns and against simulated measurements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import norm

from doe.discrimination.design import LAMBDA, MisidentificationBound

OWN, EFFECTS, RUNS = 3, 7, 12
BASES = (  # two effects of one parameter, one of two, one that takes the sum of two, one of three
    np.eye(EFFECTS)[:, [0]],
    np.eye(EFFECTS)[:, [1]],
    np.eye(EFFECTS)[:, [2, 3]],
    np.eye(EFFECTS)[:, [0]] + 2.0 * np.eye(EFFECTS)[:, [1]],
    np.eye(EFFECTS)[:, [4, 5, 6]],
)
WEIGHTS = np.array([1.0, 0.5, 1.0, 1.0, 0.25])


def columns(seed: int, rows: int = 2 * RUNS) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, OWN + EFFECTS))


def made(reference: np.ndarray) -> MisidentificationBound:
    return MisidentificationBound(OWN, BASES, WEIGHTS, reference.T @ reference / (len(reference) / 2))


def left_of(targets: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Length of what least squares leaves of each column of targets."""
    return np.asarray(np.linalg.norm(targets - others @ np.linalg.lstsq(others, targets, rcond=None)[0], axis=0))


def mixed(size: int) -> np.ndarray:
    """(size, D) unit vectors along each axis, and along the sum and the difference of every two."""
    pairs = [(i, j, sign) for i in range(size) for j in range(i) for sign in (1.0, -1.0)]
    mixes = np.zeros((size, len(pairs)))
    for column, (i, j, sign) in enumerate(pairs):
        mixes[[i, j], column] = np.sqrt(0.5) * np.array([1.0, sign])
    return np.hstack([np.eye(size), mixes])


def brute_force(
    plan: np.ndarray,
    reference: np.ndarray,
    bases: Sequence[np.ndarray] = BASES,
    weights: np.ndarray = WEIGHTS,
    own: int = OWN,
) -> float:
    """Every direction of every effect against nothing and every other effect, by least squares."""
    drawn = np.hstack([basis @ mixed(basis.shape[1]) for basis in bases])
    owner = np.repeat(np.arange(len(bases)), [mixed(basis.shape[1]).shape[1] for basis in bases])
    random = reference[:, own:] @ drawn
    lengths = left_of(random, reference[:, :own])
    # what random postures do not show beside the base model is no rival
    shown = lengths > 1e-5 * np.linalg.norm(random, axis=0)
    drawn, owner, lengths = drawn[:, shown], owner[shown], lengths[shown]
    # LAMBDA long with as many random runs as the plan has
    seen = plan[:, own:] @ drawn * (LAMBDA / (lengths * np.sqrt(len(plan) / len(reference))))
    wrong = norm.cdf(-left_of(seen, plan[:, :own]) / 2.0)
    for g in np.unique(owner):
        beside = left_of(seen, np.hstack([plan[:, :own], plan[:, own:] @ bases[g]]))
        wrong += (owner != g) * norm.cdf(-beside / 2.0)
    return float(np.average(wrong, weights=weights[owner] / np.bincount(owner)[owner]))


@pytest.mark.parametrize("seed", range(4))
def test_by_least_squares(seed: int) -> None:
    plan, reference = columns(seed), columns(100 + seed, 60)
    misidentification = made(reference)
    expected = brute_force(plan, reference)
    assert float(misidentification.wrong(plan.T @ plan / RUNS)) == pytest.approx(expected, rel=1e-9)


def test_many_matrices_at_once_and_a_singular_one() -> None:
    misidentification = made(columns(9, 60))
    plans = [columns(seed) for seed in range(3)]
    informations = np.array([plan.T @ plan / RUNS for plan in plans])
    informations[2, :, 0] = informations[2, 0, :] = 0.0  # a base parameter that the plan does not show
    found = misidentification.wrong(informations)
    assert found.shape == (3,)
    assert found[:2] == pytest.approx([float(misidentification.wrong(one)) for one in informations[:2]])
    assert found[2] == np.inf


def test_an_effect_that_the_plan_hides_and_two_that_are_the_same() -> None:
    reference, plan = columns(9, 60), columns(1)
    plan[:, OWN + 1] = plan[:, OWN]  # the first two effects are one and the same column
    plan[:, OWN + 4] = 0.0
    wrong = float(made(reference).wrong(plan.T @ plan / RUNS))
    assert np.isfinite(wrong)
    assert wrong == pytest.approx(brute_force(plan, reference), rel=1e-4)  # lstsq's rank cut against the ridge
    assert np.all(np.isfinite(made(reference).gradient(plan.T @ plan / RUNS)))


def test_an_effect_that_the_base_model_explains_plays_no_part() -> None:
    """As the compliance of one joint where that of all joints is in the model: the same figures with and without."""
    reference, plan = columns(9, 60), columns(1)
    for data in (reference, plan):
        data[:, OWN + 1] = data[:, :OWN] @ [0.5, -2.0, 1.0]
    information = plan.T @ plan / RUNS
    mean = reference.T @ reference / (len(reference) / 2)
    everything = MisidentificationBound(OWN, BASES[:3], WEIGHTS[:3], mean)
    without = MisidentificationBound(OWN, (BASES[0], BASES[2]), WEIGHTS[[0, 2]], mean)
    assert len(everything.directions) == 5
    assert float(everything.wrong(information)) == pytest.approx(float(without.wrong(information)), rel=1e-12)
    np.testing.assert_allclose(everything.gradient(information), without.gradient(information), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_gradient_by_finite_differences(seed: int) -> None:
    generator = np.random.default_rng(seed)
    misidentification, plan = made(columns(50 + seed, 60)), columns(seed)
    information = plan.T @ plan / RUNS
    gradient = misidentification.gradient(information)
    for _ in range(5):
        step = generator.normal(size=information.shape)
        step = step + step.T
        ends = [-np.log(float(misidentification.wrong(information + t * step))) for t in (-1e-6, 1e-6)]
        assert (ends[1] - ends[0]) / 2e-6 == pytest.approx(float(np.sum(gradient * step)), rel=1e-5, abs=1e-7)


def test_the_bound_holds_for_simulated_measurements() -> None:
    """Two effects of one parameter, hidden with either sign, named by least squares: wrong at most as often."""
    generator = np.random.default_rng(7)
    reference, plan = columns(9, 600), columns(1)
    plan[:, OWN + 1] = plan[:, OWN] + 0.25 * plan[:, OWN + 1]  # much alike
    bases = BASES[:2]
    misidentification = MisidentificationBound(OWN, bases, np.ones(2), reference.T @ reference / 300)
    bound = float(misidentification.wrong(plan.T @ plan / RUNS))
    basis = np.linalg.qr(plan[:, :OWN])[0]
    seen = [column - basis @ (basis.T @ column) for column in plan[:, OWN : OWN + 2].T]
    scale = [LAMBDA / left_of(reference[:, OWN + h], reference[:, :OWN]) * np.sqrt(300 / RUNS) for h in (0, 1)]
    count, wrong = 4000, 0
    for number in range(count):
        h = number % 2
        data = seen[h] * scale[h] + generator.normal(size=len(plan))
        falls = [(data @ column) ** 2 / (column @ column) for column in seen]
        wrong += falls[h] < falls[1 - h]
    assert 0.02 < bound < 0.5
    error = np.sqrt(bound / count)
    assert wrong / count < bound + 3.0 * error
    assert wrong / count > 0.3 * bound - 3.0 * error  # the pair's own part of it, the rest is `nothing`
