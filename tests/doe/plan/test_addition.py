"""One posture more never takes information away: every criterion of the whole information, from complex numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe.criteria import criterion
from doe.plan.spacing import with_additions
from identification.arrays import Array
from tests.doe.arms import FOUR, problem, random_box

NAMES = ("D", "A", "E", "I", "Ds", "Dstar")


def whole_information(lengths: Array, postures: Array) -> Array:
    """(2n, 2n) sum of B^T B: a link moves the tip by exp(i theta), a joint all links from it on across themselves."""
    links = np.exp(1j * np.cumsum(postures, axis=1))
    levers = 1j * np.cumsum((links * lengths)[:, ::-1], axis=1)[:, ::-1] / lengths
    columns = np.concatenate([links, levers], axis=1)
    return (columns.conj().T @ columns).real


@pytest.mark.parametrize("seed", range(5))
def test_no_criterion_of_the_whole_information_falls(seed: int) -> None:
    generator = np.random.default_rng(seed)
    arm = random_box(generator, 3)
    q = generator.uniform(arm.lower, arm.upper, (9, 3))
    units, poses = ["mm"] * 3 + ["rad"] * 3, problem(arm).scaled_jacobians(q)
    for name in NAMES:
        wanted = criterion(name, units=units, subset=[0, 4], test_jacobians=poses)
        values = [float(wanted.value(whole_information(np.array(arm.lengths), q[:m]))) for m in range(4, 10)]
        assert np.all(np.diff(values) >= -1e-9 * np.abs(values[1:])), name


def test_the_posture_that_adds_most() -> None:
    """log det gains log det(I + B M^-1 B^T): no posture of a fine grid gains more."""
    case = problem(FOUR)
    generator = np.random.default_rng(1)
    plan = generator.uniform(FOUR.lower, FOUR.upper, (6, 4))
    longer = with_additions(case, plan, 1, generator)
    assert longer is not None
    assert np.array_equal(longer[:6], plan)
    grid = np.stack(np.meshgrid(*(np.linspace(a, b, 25) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True))))
    places = np.column_stack([np.zeros(25**3), grid.reshape(3, -1).T])
    now = np.linalg.slogdet(whole_information(np.array(FOUR.lengths), longer))[1]
    best = max(
        np.linalg.slogdet(whole_information(np.array(FOUR.lengths), np.vstack([plan, one])))[1] for one in places[::3]
    )
    assert now >= best - 1e-3


def test_of_a_list_each_posture_once() -> None:
    choices = np.random.default_rng(2).uniform(FOUR.lower, FOUR.upper, (8, 4))
    case = problem(FOUR, choices=choices)
    generator = np.random.default_rng(0)
    longer = with_additions(case, choices[:6], 2, generator)
    assert longer is not None
    assert len(np.unique(longer, axis=0)) == 8
    assert with_additions(case, choices[:6], 3, generator) is None
    assert with_additions(replace(case, minimum_distance=0.0), choices[:6], 3, generator) is not None
