"""Constraints: margins against brute-force geometry, derivatives by differences, diagnosis of none."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from doe import DesignProblem
from doe.bounds.planar_theorem import closed_form_bound
from doe.problem.constraints import LINK_RADIUS, Expression, constraints_of
from doe.problem.problem import random_postures
from doe.solvers import Random, solve
from identification import Arm, Calibration, InputError, Model
from identification.workspace import Body, Cell, KeepOut, LineOfSight, WorkspaceBox
from tests.doe.arms import FOUR

BOX = WorkspaceBox((-400.0, 600.0), (0.0, 650.0))
CIRCLE = KeepOut((350.0, 200.0), 60.0)
SIGHT = LineOfSight((900.0, 300.0), np.radians(25.0), (0.0, 200.0))
ARM = replace(FOUR, constraints=(BOX, CIRCLE, SIGHT))
MADE = constraints_of(Model(ARM))
POSTURES = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (3000, 4))


def link_points(posture: np.ndarray, count: int = 400) -> list[np.ndarray]:
    """Per link, points along it; from sums of cosines and sines."""
    start, theta, links = np.zeros(2), 0.0, []
    for length, angle in zip(FOUR.lengths, posture, strict=True):
        theta += angle
        along = length * np.array([np.cos(theta), np.sin(theta)])
        links.append(start + np.linspace(0, 1, count)[:, None] * along)
        start = start + along
    return links


def test_links_without_bodies_are_in_the_way_of_a_sight() -> None:
    """Also where others, or what is around the arm, have some."""
    bodies = [Body(name, joint, np.r_[900.0, 900, 0, 900, 900, 0, 9]) for name, joint in (("post", 0), ("hand", 2))]
    seen = constraints_of(Model(replace(ARM, cell=Cell(bodies))))[2].margin(POSTURES[:300])
    np.testing.assert_array_equal(seen, np.delete(MADE[2].margin(POSTURES[:300]), 2, axis=1))


def test_derivatives() -> None:
    problem = DesignProblem.of(Model(ARM))
    walls, step = problem.walls, 1e-6
    postures = random_postures(problem, 5, np.random.default_rng(1))
    values, slopes = walls.first(postures)
    assert values.shape == (5, 4 + 4 + 4)
    np.testing.assert_array_equal(values, walls.values(postures))
    weights = np.random.default_rng(2).uniform(0.5, 1.5, values.shape)
    bend = walls.bend(postures, weights)
    for joint, move in enumerate(step * np.eye(4)):
        up, down = postures + move, postures - move
        differences = (walls.values(up) - walls.values(down)) / (2 * step)
        np.testing.assert_allclose(slopes[:, joint], differences, rtol=1e-5, atol=1e-4)  # of lengths up to 1000 mm
        ahead, behind = (np.einsum("mk,mak->ma", weights, walls.first(end)[1]) for end in (up, down))
        differences = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(bend[..., joint], differences, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("solver", ["ipopt", "exchange", Random(20)])
def test_every_solver_honours_them(solver: str | Random) -> None:
    problem = DesignProblem.of(Model(ARM))
    design = solve(problem, 8, solver, starts=2, bound=closed_form_bound(problem))  # a loose one, which takes no time
    assert np.isfinite(design.value)
    for posture in design.plan.postures:  # judged by points along the links
        links = link_points(posture)
        assert -400 <= links[-1][-1][0] <= 600
        assert 0 <= links[-1][-1][1] <= 650
        assert min(np.linalg.norm(points - [350, 200], axis=1).min() for points in links) >= 60
        beam = np.linspace(SIGHT.tracker, links[-1][-1], 200)[None]  # from the tracker to the tip; the last may be near
        assert all(np.linalg.norm(at[::4, None] - beam, axis=2).min() >= LINK_RADIUS * 660.0 for at in links[:-1])


def test_users_own_expression() -> None:
    """Elbow up, and the tip above the elbow: only what the user said, in a function of CasADi symbols."""
    above = Expression(lambda q: ca.vertcat(ca.sin(q[0]), 180 * ca.sin(q[0] + q[1])), 4, "elbow")
    problem = DesignProblem.of(Model(FOUR), constraints=(above,))
    q1, q2 = solve(problem, 6, starts=4, bound=closed_form_bound(problem)).plan.postures.T[:2]
    assert np.all(np.sin(q1) >= 0)
    assert np.all(np.sin(q1 + q2) >= 0)
    np.testing.assert_allclose(above.margin(POSTURES[:5])[:, 0], np.sin(POSTURES[:5, 0]))


def test_calibrated_lengths_count() -> None:
    longer = replace(ARM, calibration=Calibration.of(np.array([10.0, 0, 0, 0]), np.zeros(4)))
    assert constraints_of(Model(longer))[0].margin(np.zeros((1, 4)))[0, 0] == pytest.approx(660 + 10 + 400)


@pytest.mark.parametrize(
    ("constraints", "message"),
    [
        ((BOX, KeepOut((0.0, 0.0), 50.0)), r"satisfies constraint 2 \(keep_out_circle\), allowed"),
        (
            (WorkspaceBox((-400.0, -300.0), (0.0, 650.0)), CIRCLE, WorkspaceBox((0.0, 600.0), (0.0, 650.0))),
            r"constraint 1 \(workspace_box\) and constraint 3 \(workspace_box\) together",
        ),
        ((WorkspaceBox((700.0, 800.0), (0.0, 650.0)),), r"constraint 1 \(workspace_box\)"),
    ],
)
def test_says_which_constraints_exclude_everything(constraints: tuple, message: str) -> None:
    arm = replace(FOUR, constraints=constraints)
    with pytest.raises(InputError, match=message):
        solve(DesignProblem.of(Model(arm)), 8)


def test_finds_a_feasible_set_that_random_postures_miss() -> None:
    """The tip within 3 mm of the stretched arm's reach: about one posture in a million."""
    arm = Arm(FOUR.lengths, FOUR.lower, FOUR.upper, constraints=(WorkspaceBox((657.0, 661.0), (-10.0, 10.0)),))
    found = random_postures(DesignProblem.of(Model(arm)), 50, np.random.default_rng(0))
    tips = Model(arm).position(found)
    assert found.shape == (50, 4)
    assert np.all(tips[:, 0] >= 657)
    assert len(np.unique(found, axis=0)) > 10
