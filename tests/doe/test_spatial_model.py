"""`doe` on a small arm in space: d = 3, p = 12 or 29, one joint that slides.

Every figure is checked against a chain in plain numpy with finite differences, brute force, or a theorem. Of the axis
of a revolute joint positions can tell a translation and a rotation along the two directions across it, of a prismatic
joint a rotation across it, of the tip a translation (Everett, Driels and Mooring 1987: 4 R + 2 P + 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

from doe.bounds.certificate import ApproximateDesign
from doe.bounds.column_generation import continuous_design, relax
from doe.bounds.planar_theorem import closed_form_bound
from doe.plan.spacing import too_near
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from identification.arm import Arm
from identification.arrays import Array
from identification.kinematics.chain import BASE, Joint, KinematicChain
from identification.kinematics.frames import pose
from identification.model import Model

RUNS = 8
STEP = 1e-5  # [mm, rad] of central differences: error of order STEP^2 = 1e-10 relative, rounding 1e-16 / STEP
DIFFERENCES = 1e-7  # so of a chain of 1 m
TIP = np.array([120.0, 35.0, 50.0])
# axis, place [mm] after the joint before, limits [deg, of x in mm]
SMALL_CHAIN = (
    *(("z", (0.0, 0.0, 300.0), -150.0, 150.0), ("y", (0.0, 40.0, 0.0), -70.0, 80.0)),
    *(("x", (200.0, 0.0, 0.0), 0.0, 400.0), ("z", (150.0, 0.0, 30.0), -120.0, 110.0)),
)
LARGE_CHAIN = (
    *(("z", (0.0, 0.0, 300.0), -170.0, 170.0), ("y", (60.0, 0.0, 0.0), -100.0, 100.0)),
    *(("y", (0.0, 0.0, 350.0), -140.0, 60.0), ("x", (120.0, 0.0, 0.0), 0.0, 250.0)),
    *(("z", (180.0, 0.0, 20.0), -180.0, 180.0), ("y", (90.0, 0.0, 0.0), -110.0, 110.0)),
    ("z", (70.0, 0.0, 0.0), -150.0, 150.0),
)
SMALL = (
    *("translation_x:2", "translation_z:2", "rotation_x:2", "rotation_z:2", "rotation_y:3", "rotation_z:3"),
    *("translation_x:4", "translation_y:4", "rotation_x:4", "rotation_y:4", "tool[1].x", "tool[1].z"),
)
LARGE = [
    f"{kind}_{across}:{j}"
    for j, (axis, *_) in enumerate(LARGE_CHAIN, start=1)
    for kind in ("translation", "rotation")
    for across in "xyz"
    if across != axis and (axis, kind) != ("x", "translation")
]
LARGE += [f"tool[1].{axis}" for axis in "xyz"]


def small_or_large(chain: tuple, names: Sequence[str]) -> Model:
    """The arm with its base known and no other errors than these."""
    joints = []
    for k, (axis, place, low, high) in enumerate(chain):
        unit, kind = (1.0, "prismatic") if axis == "x" else (np.pi / 180.0, "revolute")
        joints.append(Joint(f"j{k}", pose(place), np.eye(3)["xyz".index(axis)], kind, low * unit, high * unit))
    whole = KinematicChain(tuple(joints), np.eye(4), np.eye(4), {"1": TIP}, settled=frozenset({BASE}))
    fixed = frozenset(whole.parameters().names) - set(names)
    settled = KinematicChain(tuple(joints), np.eye(4), np.eye(4), {"1": TIP}, settled=frozenset({BASE}), fixed=fixed)
    return Model(Arm(settled, sigma=0.1))


@cache
def models() -> dict[str, tuple[tuple, Model]]:
    """Chain and model."""
    chains = {"small": (SMALL_CHAIN, SMALL), "large": (LARGE_CHAIN, LARGE)}
    return {name: (chain, small_or_large(chain, names)) for name, (chain, names) in chains.items()}


def spatial(name: str = "small", **changes: object) -> DesignProblem:
    return DesignProblem.of(models()[name][1], deviations={}, **changes)


def random_postures(count: int, seed: int, name: str = "small") -> Array:
    """(count, n) uniform within the limits."""
    arm = models()[name][1].arm
    return np.random.default_rng(seed).uniform(arm.lower, arm.upper, (count, arm.links))


# -- the oracle: the same chain in numpy, derivatives by finite differences --------------------------------------------
def turn(axis: str, angles: Array | float) -> Array:
    """(..., 3, 3) rotations about an axis by angles (...): Rodrigues' formula."""
    cross = np.cross(np.eye(3), np.eye(3)["xyz".index(axis)])
    sine, cosine = np.sin(angles)[..., None, None], np.cos(angles)[..., None, None]
    return np.eye(3) + sine * cross + (1.0 - cosine) * cross @ cross


def tips(chain: tuple, postures: Array, error: dict[str, float]) -> Array:
    """(m, 3) positions of the tip [mm]."""
    place, frame = np.zeros((len(postures), 3)), np.eye(3)
    for j, ((axis, offset, *_), q) in enumerate(zip(chain, postures.T, strict=True), start=1):
        place = place + frame @ (np.array(offset) + [error.get(f"translation_{a}:{j}", 0.0) for a in "xyz"])
        for a in "xyz":
            frame = frame @ turn(a, error.get(f"rotation_{a}:{j}", 0.0))
        if axis == "x":
            place = place + q[:, None] * frame[..., 0]
        else:
            frame = frame @ turn(axis, q)
    return place + frame @ (TIP + [error.get(f"tool[1].{a}", 0.0) for a in "xyz"])


def difference_jacobian(postures: Array, name: str = "small") -> Array:
    """(m, 3, p) scaled, by central differences."""
    chain, model = models()[name]
    ends = [[tips(chain, postures, {key: sign * STEP}) for sign in (1.0, -1.0)] for key in model.names]
    return np.stack([(up - down) / (2.0 * STEP) for up, down in ends], axis=-1) / model.scales


def difference_information(postures: Array, weights: Array | None = None, name: str = "small") -> Array:
    """(p, p) scaled information per run of (m, n) postures."""
    blocks = difference_jacobian(postures, name)
    shares = np.full(len(postures), 1.0 / len(postures)) if weights is None else weights
    return np.asarray(np.einsum("m,mdp,mdq->pq", shares, blocks, blocks))


def log_det(information: Array) -> float:
    return float(np.linalg.slogdet(information)[1])


def sensitivities(information: Array, postures: Array, name: str = "small") -> Array:
    """(m,) tr(M^-1 B^T B) of each posture."""
    blocks = difference_jacobian(postures, name)
    return np.einsum("mdp,pq,mdq->m", blocks, np.linalg.inv(information), blocks)


@cache
def continuous() -> ApproximateDesign:
    """The best weights over the whole design space, which bound every plan."""
    return continuous_design(spatial())


@cache
def candidates() -> Array:
    return random_postures(40, 3)


# -- the model and its information -------------------------------------------------------------------------------------
@pytest.mark.parametrize(("name", "parameters"), [("small", 12), ("large", 29)])
def test_information_is_that_of_finite_differences(name: str, parameters: int) -> None:
    postures, problem = random_postures(15, 1, name), spatial(name)
    assert problem.parameters == parameters
    expected = difference_information(postures, name=name)
    np.testing.assert_allclose(problem.information(postures), expected, rtol=0.0, atol=DIFFERENCES * expected.max())
    assert problem.objective(postures) == pytest.approx(log_det(expected), abs=1e-5)
    assert np.linalg.matrix_rank(expected) == parameters
    assert problem.fewest_runs == -(-parameters // 3)
    assert closed_form_bound(problem) is None
    # the first joint turns all positions about the base, which is known: no information is gained or lost
    assert problem.active_joints == ((1, 2, 3) if name == "small" else tuple(range(7)))


# -- exact plans -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("solver", ["exchange", "exchange_ipopt", "ipopt", "random"])
def test_solvers(solver: str) -> None:
    problem = spatial()
    design = solve(problem, RUNS, solver, starts=3, seed=1, bound=continuous().bound)
    q = design.plan.postures
    assert q.shape == (RUNS, 4)
    assert np.all((q >= problem.lower) & (q <= problem.upper))
    assert design.value == pytest.approx(log_det(difference_information(q)), abs=1e-5)
    assert design.bound.source == "continuous"
    assert design.efficiency <= 1.0
    assert not len(too_near(problem, q))
    assert design.table_1_max_residual is None
    if solver == "random":
        return
    assert design.value > max(problem.objective(random_postures(RUNS, seed)) for seed in range(100))
    if solver == "exchange_ipopt":  # the gradient of the oracle's log det is zero but where a limit holds a joint
        for run in range(RUNS):
            for joint in problem.active_joints:
                step = 1e-4 * problem.joint_units[joint] * np.eye(4)[joint]
                ends = [np.vstack([q[:run], q[run] + sign * step, q[run + 1 :]]) for sign in (1.0, -1.0)]
                slope = np.subtract(*(log_det(difference_information(plan)) for plan in ends)) / 2e-4
                assert slope > -1e-4 or q[run, joint] <= problem.lower[joint]
                assert slope < 1e-4 or q[run, joint] >= problem.upper[joint]


def test_postures_are_kept_apart_in_the_unit_of_each_joint() -> None:
    """One degree is 1/360 of the prismatic joint's range; the same postures are near, or not, by that alone."""
    everywhere = spatial("large")
    base = 0.5 * (everywhere.lower + everywhere.upper)
    for share, near in ((0.9, True), (1.1, False)):
        other = base + share * 250.0 / 360.0 * np.eye(7)[3]
        assert bool(len(too_near(everywhere, np.array([base, other])))) is near
    problem = spatial(minimum_distance=np.radians(1.0))
    np.testing.assert_allclose(problem.comparable(problem.upper - problem.lower)[2], 2.0 * np.pi)


# -- approximate designs: the equivalence theorem of Kiefer and Wolfowitz ----------------------------------------------
@pytest.mark.parametrize("solver", ["clarabel", "column_generation"])
def test_relaxation_over_a_list(solver: str) -> None:
    relaxed = relax(spatial(), candidates(), solver)
    plan = relaxed.plan
    information = difference_information(plan.postures, plan.shares)
    assert relaxed.value == pytest.approx(log_det(information), abs=1e-5)
    assert sensitivities(information, candidates()).max() <= 12.0 + 1e-3
    np.testing.assert_allclose(sensitivities(information, plan.postures)[plan.shares > 1e-3], 12.0, atol=0.02)
    assert relaxed.value <= relaxed.bound.value <= relaxed.value + 1e-3
    for seed in range(20):  # no other weights are better
        weights = np.random.default_rng(seed).dirichlet(np.ones(len(candidates())))
        assert log_det(difference_information(candidates(), weights)) < relaxed.value


def test_continuous_optimum_and_bound() -> None:
    plan = continuous().plan
    information = difference_information(plan.postures, plan.shares)
    assert continuous().value == pytest.approx(log_det(information), abs=1e-5)
    np.testing.assert_allclose(sensitivities(information, plan.postures), 12.0, atol=1e-3)
    assert sensitivities(information, random_postures(400, 7)).max() <= 12.0 + 1e-4
    assert not continuous().bound.rigorous  # a sliding joint's positions are no trigonometric polynomial
    assert continuous().bound.value == pytest.approx(continuous().value, abs=1e-6)
    assert relax(spatial(), 3).value < continuous().value


# -- what to measure, and how often ------------------------------------------------------------------------------------


def test_many_parameters() -> None:
    choices = random_postures(150, 4, "large")
    problem = spatial("large", choices=choices)
    design = solve(problem, 20, starts=3)
    expected = log_det(difference_information(design.plan.postures, name="large"))
    assert design.value == pytest.approx(expected, abs=1e-4)
    assert design.bound.rigorous
    assert 0.9 < design.efficiency <= 1.0
    relaxed = relax(problem, choices)
    information = difference_information(relaxed.plan.postures, relaxed.plan.shares, "large")
    assert sensitivities(information, choices, "large").max() <= 29.0 + 1e-3
