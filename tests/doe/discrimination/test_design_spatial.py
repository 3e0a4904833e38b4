"""Discriminating plans in space: every plan of a small list, by least squares on central differences."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from doe.discrimination.design import CLOUD, EffectLibrary, discrimination_design, off_the_limits, pool_of, turning
from doe.problem.problem import DesignProblem
from identification.arm import Arm, Gravity
from identification.arrays import Array
from identification.kinematics.chain import DHRow, chain_of
from identification.measurements import Conditions
from identification.model import Model
from tests.doe.discrimination.test_misidentification import brute_force

ROWS = [DHRow(0.0, np.pi / 2.0, 300.0), DHRow(400.0, 0.1, 20.0), DHRow(350.0, -1.0, 10.0)]
TOOLS = {"a": np.array([40.0, 30.0, 20.0]), "b": np.array([-50.0, 10.0, 60.0])}
GRAVITY = Gravity([0.0, 0.0, -9.81], [7.0, 5.0, 4.0], [0.5, 0.5, 0.5], 2.0)
LOSS, RUNS = 0.1, 9


def spatial(points: int) -> Arm:
    chain = replace(chain_of(ROWS), tools=dict(list(TOOLS.items())[:points]))
    limits = {"lower": np.radians([-170.0, -100.0, -120.0]), "upper": np.radians([170.0, 100.0, 120.0])}
    return Arm(chain, sigma=0.05, gravity=GRAVITY, **limits)


def columns(model: Model, postures: Array, points: int) -> Array:
    """(points, m, 3, p) scaled derivatives of every point's positions by central differences, at zero."""
    steps = 1e-4 * np.diag(1.0 / model.scales)
    each = []
    for k in range(points):
        at = Conditions(marker=np.full(len(postures), k))
        moved = [model.position(postures, step, at) - model.position(postures, -step, at) for step in steps]
        each.append(np.moveaxis(moved, 0, -1) / 2e-4)
    return np.array(each)


def stacked(derivatives: Array) -> Array:
    """(N, p) one row per number measured."""
    return derivatives.reshape(-1, derivatives.shape[-1])


@pytest.mark.parametrize("points", [1, 2])
def test_the_best_of_all_plans_of_a_small_list(points: int) -> None:
    arm = spatial(points)
    choices = np.random.default_rng(points).uniform(arm.lower, arm.upper, (10, 3))
    problem = DesignProblem.of(Model(arm), choices=choices)
    found = discrimination_design(problem, arm, RUNS, loss=LOSS)
    library = EffectLibrary.of(arm)
    inner = library.shown_by_postures.model  # type: ignore[attr-defined]
    cloud = stacked(columns(inner, pool_of(problem, CLOUD, np.random.default_rng(0)), points))
    of_choices = columns(inner, choices, points)
    scale = np.sqrt(len(cloud) / (3.0 * points) / 10.0)  # all of the list stand for random postures
    assert scale == pytest.approx(1.0)
    best, every = found.best.value, {}
    for rows in combinations(range(10), RUNS):
        if problem.objective(choices[list(rows)]) >= best - problem.parameters * -np.log1p(-LOSS):
            plan = stacked(of_choices[:, list(rows)])
            every[rows] = brute_force(plan, cloud, library.bases, library.weights, library.base)
    assert found.relative_efficiency >= 1.0 - LOSS
    assert len(every) > 1
    assert found.wrong == pytest.approx(min(1.0, *every.values()), rel=1e-3)
    assert found.wrong <= found.best_wrong
    assert found.sees is not None


def test_a_slide_is_moved_off_its_limits_and_never_goes_round() -> None:
    rows = [*ROWS[:2], DHRow(0.0, 0.0, 100.0, 0.0, "prismatic", (0.0, 500.0))]
    arm = Arm(replace(chain_of(rows), tools={"a": TOOLS["a"]}), sigma=0.05)
    problem = DesignProblem.of(Model(arm))
    assert turning(problem).tolist() == [True, True, False]
    corners = np.column_stack([np.zeros((12, 2)), np.tile([0.0, 500.0], 6)])
    moved = off_the_limits(problem, corners, -np.inf, np.random.default_rng(1))[:, 2]
    assert np.all((moved >= 0.0) & (moved <= 500.0))
    assert np.abs(moved - corners[:, 2]).max() > 20.0  # some of 30 degrees of a range that counts as a turn
