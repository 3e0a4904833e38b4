"""Fits of spatial arms far from any real one: the right answer or a clear statement, as `test_stress` in the plane.

Oracle: positions by products of rotations in numpy, derivatives of them by complex steps. Where a fit ends, the step
that is left, (J^T J)^-1 J^T r, is nothing beside the deviations, which are the roots of sigma^2 diag (J^T J)^-1.
"""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import Arm, Measurements, Model, estimate
from identification.kinematics.chain import Joint, KinematicChain
from identification.kinematics.frames import AXES, pose
from identification.model.minimal import practical
from tests.identification.estimation.test_stress import DIGITS, EPS, SIGMAS, lengths_of

FEW = settings(max_examples=max(settings.default.max_examples // 16, 6))  # type: ignore[union-attr]
STEP = 1e-30  # of complex steps, which lose no digits
UP = np.array([0.0, 0.0, 1.0])


def chain_with(lengths: np.ndarray, generator: np.random.Generator) -> KinematicChain:
    """Joints at these distances [mm], turned anyhow; the measured point is off the last axis."""
    turns = [np.linalg.qr(generator.standard_normal((3, 3)))[0] for _ in lengths]
    steps = [length * turn[:, 1] for length, turn in zip(lengths, turns, strict=True)]
    origins = [pose(rotation=turns[0] * np.linalg.det(turns[0]))]
    origins += [pose(s, t * np.linalg.det(t)) for s, t in zip(steps[:-1], turns[1:], strict=True)]
    joints = tuple(Joint(f"j{k}", origin, UP, lower=-10.0, upper=10.0) for k, origin in enumerate(origins, start=1))
    return KinematicChain(joints, pose(steps[-1]), tools={"1": 0.3 * lengths[-1] * np.array([0.6, 0.5, 0.6])})


def turned(place: np.ndarray, k: int, angle: object) -> np.ndarray:
    """(m, 4, 4) poses after turns about their own axis k, by one angle or (m,)."""
    first, second = [(1, 2), (2, 0), (0, 1)][k]
    cos, sin = (np.reshape(f(angle), (-1, 1)) for f in (np.cos, np.sin))
    found = place.copy()
    found[:, :, first] = cos * place[:, :, first] + sin * place[:, :, second]
    found[:, :, second] = cos * place[:, :, second] - sin * place[:, :, first]
    return found


def tips(chain: KinematicChain, q: np.ndarray, values: dict[str, complex]) -> np.ndarray:
    """(m, 3) measured points [mm] at postures (m, n) [rad], for errors that may be complex."""
    place = np.tile(np.eye(4, dtype=complex), (len(q), 1, 1))
    place[:, :3, 3] = [values.get(f"base.{axis}", 0.0) for axis in AXES]
    place = place @ chain.base
    for k, axis in enumerate(AXES):
        place = turned(place, k, values.get(f"base.r{axis}", 0.0))
    for j, joint in enumerate(chain.joints, start=1):
        place = place @ joint.origin
        shift = np.array([values.get(f"translation_{axis}:{j}", 0.0) for axis in AXES])
        place[:, :3, 3] += place[:, :3, :3] @ shift
        for k, axis in enumerate(AXES):
            place = turned(place, k, values.get(f"rotation_{axis}:{j}", 0.0))
        place = turned(place, 2, q[:, j - 1] + values.get(f"joint_offset:{j}", 0.0))
    error = np.array([values.get(f"tool[1].{axis}", 0.0) for axis in AXES])
    return (place @ chain.end @ np.r_[chain.tools["1"] + error, 1.0])[:, :3]


def linearized(chain: KinematicChain, q: np.ndarray, names: tuple[str, ...], values: np.ndarray) -> tuple:
    """(3 m,) positions and (3 m, p) derivatives."""
    columns = []
    for k in range(len(names)):
        moved = values + 1j * STEP * np.eye(len(names))[k]
        columns.append(tips(chain, q, dict(zip(names, moved, strict=True))).imag.ravel() / STEP)
    return tips(chain, q, dict(zip(names, values, strict=True))).real.ravel(), np.column_stack(columns)


def case(n: int, lengths: np.ndarray, sigma: float, m: int, generator: np.random.Generator) -> tuple:
    """A model with a minimal set of parameters, and measurements of an arm that is not as drawn: by three sigma, at
    most 1 % of the links, and by 1e-3 rad."""
    drawn = Arm(chain_with(lengths, generator), sigma=sigma)
    q = generator.uniform(-np.pi, np.pi, (m, n))
    model = Model(practical(drawn, Measurements(q, tips(drawn.chain, q, {}).real)))
    sizes = [1e-3 if p.unit == "rad" else min(3.0 * sigma, 0.01 * lengths.min()) for p in model.parameters]
    true = np.array(sizes) * generator.standard_normal(len(sizes))
    exact = tips(model.arm.chain, q, dict(zip(model.names, true, strict=True))).real
    return model, Measurements(q, exact + sigma * generator.standard_normal((m, 3)))


@given(
    n=st.sampled_from([1, 2, 3, 6]),
    sigma=SIGMAS,
    wild=st.booleans(),
    long=st.booleans(),
    turns=st.booleans(),
    seed=st.integers(0, 2**32),
)
@FEW
def test_a_fit_is_the_maximum_of_the_likelihood_or_says_why_not(
    n: int, sigma: float, wild: bool, long: bool, turns: bool, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    lengths = lengths_of(n, generator) if wild else generator.uniform(100.0, 500.0, n)
    model, data = case(n, lengths, sigma, 120 if long else 3 * n + 12, generator)
    q = data.postures + turns * 2.0 * np.pi * generator.integers(-4, 5, data.postures.shape)
    found = estimate(model, Measurements(q, data.positions), sigma="given")
    position, jacobian = linearized(found.model.arm.chain, q, found.names, found.parameters)  # its base is placed
    residual = data.positions.ravel() - position
    sizes = np.linalg.norm(jacobian, axis=0)
    left, values, right = np.linalg.svd(jacobian / sizes, full_matrices=False)
    deviations = sigma * np.linalg.norm(right.T / values, axis=1) / sizes
    rounding = 10.0 * n * np.sqrt(len(q)) * EPS * model.arm.reach
    if found.not_identifiable or found.status.name != "converged":
        # an angle or a combination that noise leaves open, or a link lost beside a far longer one
        angles = [k for k, p in enumerate(model.parameters) if p.unit == "rad"]
        open_angle = np.max(deviations[angles]) * max(1.0, rounding / sigma) > 1e-2
        open_combination = max(sigma, rounding) / (values[-1] * np.sqrt(len(q))) > 0.5 * 0.1 * model.arm.reach
        assert open_angle or open_combination or lengths.min() < 1e-7 * lengths.sum()
        return
    # what the gradient's tolerance and rounding may leave, amplified by how alike the columns are
    step = right.T @ ((left.T @ residual) / values) / sizes
    allowed = (DIGITS * np.linalg.norm(residual) + rounding) * np.sqrt(len(sizes)) / values[-1]
    assert np.max(np.abs(step) / deviations) <= allowed / sigma
    if rounding < 0.1 * sigma:  # else the scatter is that of rounding
        np.testing.assert_allclose(found.std, deviations, rtol=1e-6)
