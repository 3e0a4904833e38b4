"""`doe` on a small arm in space: d = 3, p = 12, one joint that slides.

Every figure is checked against a chain in plain numpy with finite differences, or a theorem. Of the axis of a revolute
joint positions can tell a translation and a rotation along the two directions across it, of a prismatic joint a
rotation across it, of the tip a translation (Everett, Driels and Mooring 1987: 4 R + 2 P + 3).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from doe import DesignProblem, solve
from doe.bounds.column_generation import continuous_design, relax
from doe.bounds.planar_theorem import closed_form_bound
from doe.plan.spacing import too_near
from identification import Arm, Array, Model
from identification.kinematics.chain import BASE, Joint, KinematicChain
from identification.kinematics.frames import pose

STEP = 1e-5  # [mm, rad] of central differences: error of order STEP^2 = 1e-10 relative, rounding 1e-16 / STEP
TIP = np.array([120.0, 35.0, 50.0])
# axis, place [mm] after the joint before, limits [deg, of x in mm]
CHAIN = (
    *(("z", (0.0, 0.0, 300.0), -150.0, 150.0), ("y", (0.0, 40.0, 0.0), -70.0, 80.0)),
    *(("x", (200.0, 0.0, 0.0), 0.0, 400.0), ("z", (150.0, 0.0, 30.0), -120.0, 110.0)),
)
NAMES = (
    *("translation_x:2", "translation_z:2", "rotation_x:2", "rotation_z:2", "rotation_y:3", "rotation_z:3"),
    *("translation_x:4", "translation_y:4", "rotation_x:4", "rotation_y:4", "tool[1].x", "tool[1].z"),
)


def arm() -> Arm:
    """With its base known and no other errors than these."""
    joints = []
    for k, (axis, place, low, high) in enumerate(CHAIN):
        unit, kind = (1.0, "prismatic") if axis == "x" else (np.pi / 180.0, "revolute")
        joints.append(Joint(f"j{k}", pose(place), np.eye(3)["xyz".index(axis)], kind, low * unit, high * unit))
    chain = KinematicChain(tuple(joints), np.eye(4), np.eye(4), {"1": TIP}, settled=frozenset({BASE}))
    return Arm(replace(chain, fixed=frozenset(chain.parameters().names) - set(NAMES)), sigma=0.1)


MODEL = Model(arm())
PROBLEM = DesignProblem.of(MODEL, deviations={})


def random_postures(count: int, seed: int) -> Array:
    return np.random.default_rng(seed).uniform(PROBLEM.lower, PROBLEM.upper, (count, 4))


def tips(postures: Array, error: dict[str, float]) -> Array:
    """(m, 3) positions of the tip [mm]."""
    place, frame = np.zeros((len(postures), 3)), np.eye(3)
    for j, ((axis, offset, *_), q) in enumerate(zip(CHAIN, postures.T, strict=True), start=1):
        place = place + frame @ (np.array(offset) + [error.get(f"translation_{a}:{j}", 0.0) for a in "xyz"])
        for a in "xyz":
            frame = frame @ Rotation.from_euler(a, error.get(f"rotation_{a}:{j}", 0.0)).as_matrix()
        if axis == "x":
            place = place + q[:, None] * frame[..., 0]
        else:
            frame = frame @ Rotation.from_euler(axis, q[:, None]).as_matrix()
    return place + frame @ (TIP + [error.get(f"tool[1].{a}", 0.0) for a in "xyz"])


def blocks(postures: Array) -> Array:
    """(m, 3, p) scaled, by central differences."""
    ends = [[tips(postures, {key: sign * STEP}) for sign in (1.0, -1.0)] for key in MODEL.names]
    return np.stack([(up - down) / (2.0 * STEP) for up, down in ends], axis=-1) / MODEL.scales


def information(postures: Array, weights: Array | None = None) -> Array:
    """(p, p) scaled information per run of (m, n) postures."""
    shares = np.full(len(postures), 1.0 / len(postures)) if weights is None else weights
    return np.asarray(np.einsum("m,mdp,mdq->pq", shares, blocks(postures), blocks(postures)))


def sensitivities(matrix: Array, postures: Array) -> Array:
    """(m,) tr(M^-1 B^T B) of each posture."""
    return np.einsum("mdp,pq,mdq->m", blocks(postures), np.linalg.inv(matrix), blocks(postures))


def test_information_is_that_of_finite_differences() -> None:
    postures = random_postures(15, 1)
    assert (PROBLEM.parameters, PROBLEM.fewest_runs) == (12, 4)
    expected = information(postures)
    np.testing.assert_allclose(PROBLEM.information(postures), expected, rtol=0.0, atol=1e-7 * expected.max())
    assert np.linalg.matrix_rank(expected) == 12
    assert closed_form_bound(PROBLEM) is None
    # the first joint turns all positions about the base, which is known: no information is gained or lost
    assert PROBLEM.active_joints == (1, 2, 3)


def test_postures_are_kept_apart_in_the_unit_of_each_joint() -> None:
    """One degree is 1/360 of the prismatic joint's range; the same postures are near, or not, by that alone."""
    base = 0.5 * (PROBLEM.lower + PROBLEM.upper)
    for share, near in ((0.9, True), (1.1, False)):
        other = base + share * 400.0 / 360.0 * np.eye(4)[2]
        assert bool(len(too_near(PROBLEM, np.array([base, other])))) is near


def test_the_best_weights_and_a_plan_below_their_bound() -> None:
    """The equivalence theorem of Kiefer and Wolfowitz over all postures; the slope of a plan that was climbed is zero
    but where a limit holds a joint."""
    best = continuous_design(PROBLEM)
    plan = best.plan
    matrix = information(plan.postures, plan.shares)
    assert best.value == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-5)
    np.testing.assert_allclose(sensitivities(matrix, plan.postures), 12.0, atol=1e-3)
    assert sensitivities(matrix, random_postures(400, 7)).max() <= 12.0 + 1e-4
    assert not best.bound.rigorous  # a sliding joint's positions are no trigonometric polynomial
    assert best.bound.value == pytest.approx(best.value, abs=1e-6)
    design = solve(PROBLEM, 8, "exchange", starts=3, seed=1, bound=best.bound)
    q = design.plan.postures
    assert np.all((q >= PROBLEM.lower) & (q <= PROBLEM.upper))
    assert not len(too_near(PROBLEM, q))
    assert design.value == pytest.approx(np.linalg.slogdet(information(q))[1], abs=1e-5)
    assert max(PROBLEM.objective(random_postures(8, seed)) for seed in range(100)) < design.value < best.bound.value
    for run in range(8):
        for joint in PROBLEM.active_joints:
            step = 1e-4 * PROBLEM.joint_units[joint] * np.eye(4)[joint]
            ends = [np.vstack([q[:run], q[run] + sign * step, q[run + 1 :]]) for sign in (1.0, -1.0)]
            slope = np.subtract(*(np.linalg.slogdet(information(end))[1] for end in ends)) / 2e-4
            assert slope > -1e-4 or q[run, joint] <= PROBLEM.lower[joint]
            assert slope < 1e-4 or q[run, joint] >= PROBLEM.upper[joint]


@pytest.mark.parametrize("solver", ["clarabel", "column_generation"])
def test_relaxation_over_a_list(solver: str) -> None:
    listed = random_postures(40, 3)
    relaxed = relax(PROBLEM, listed, solver)
    matrix = information(relaxed.plan.postures, relaxed.plan.shares)
    assert relaxed.value == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-5)
    assert sensitivities(matrix, listed).max() <= 12.0 + 1e-3
    assert relaxed.value <= relaxed.bound.value <= relaxed.value + 1e-3
