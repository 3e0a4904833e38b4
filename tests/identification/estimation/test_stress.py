"""Fits far from any real arm: the right answer or a clear statement. `--hypothesis-profile stress` tries thousands.

Oracle: tip = sum_j c_j exp(i(q_1 + .. + q_j)) with c_j = (l_j + dl_j) exp(i theta_j) is linear in the complex c_j, so
the maximum-likelihood estimate is a linear least-squares solution, refined here with residuals in long double.

In space: where a fit ends, the step that is left, (J^T J)^-1 J^T r, is nothing beside the deviations, which are the
roots of sigma^2 diag (J^T J)^-1.
"""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import Arm, EffectSpec, Measurements, Model, estimate
from identification.kinematics.chain import Joint, KinematicChain
from identification.kinematics.frames import pose
from identification.model.placed import practical

EPS = float(np.finfo(float).eps)
DIGITS = 1e-9  # standard deviations
FEW = settings(max_examples=max(settings.default.max_examples // 8, 12))  # type: ignore[union-attr]
FEWER = settings(max_examples=max(settings.default.max_examples // 16, 6))  # type: ignore[union-attr]
SIGMAS = st.sampled_from([1e-9, 1e-6, 1e-3, 0.1, 10.0, 1e3])
LINKS = st.sampled_from([1, 2, 3, 6, 12])


def lengths_of(n: int, generator: np.random.Generator) -> np.ndarray:
    """Links from 1e-3 to 1e6 mm in one arm, in any order."""
    return 10.0 ** np.r_[6.0, generator.uniform(-3.0, 6.0, n - 1)][generator.permutation(n)]


def measured(lengths: np.ndarray, q: np.ndarray, sigma: float, generator: np.random.Generator) -> Measurements:
    """Postures (m, n) [rad] measured on an arm that is not as drawn: by three sigma, 1 % of the links at most."""
    n, noise = len(lengths), sigma * generator.standard_normal((len(q), 2))
    errors = generator.standard_normal(n) * np.minimum(3.0 * sigma, 0.01 * lengths)
    tip = np.exp(1j * np.cumsum(q + 1e-3 * generator.standard_normal(n), axis=1)) @ (lengths + errors)
    return Measurements(q, np.column_stack([tip.real, tip.imag]) + noise)


def oracle(lengths: np.ndarray, data: Measurements) -> tuple[np.ndarray, np.ndarray]:
    """(2 n) length errors [mm] and joint offsets [rad], and (n,) deviations of c_j for sigma = 1."""
    columns = np.exp(1j * np.cumsum(data.postures, axis=1))
    q, r = np.linalg.qr(columns)
    wide, found = columns.astype(np.clongdouble), np.zeros(len(lengths), np.clongdouble)
    target = data.positions.astype(np.longdouble) @ np.array([1.0, 1j], np.clongdouble)
    for _ in range(4):
        found = found + np.linalg.solve(r, q.conj().T @ (target - wide @ found).astype(complex))
    turned = np.diff(np.r_[0.0, np.angle(found.astype(complex))])
    errors = (np.abs(found) - lengths).astype(float)
    return np.r_[errors, np.angle(np.exp(1j * turned))], np.linalg.norm(np.linalg.inv(r), axis=1)


@given(n=LINKS, sigma=SIGMAS, long=st.booleans(), turns=st.booleans(), seed=st.integers(0, 2**32))
@FEW
def test_a_fit_is_the_maximum_of_the_likelihood_or_says_why_not(
    n: int, sigma: float, long: bool, turns: bool, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    lengths, m = lengths_of(n, generator), 1000 if long else n + 4
    q = generator.uniform(-np.pi, np.pi, (m, n)) + turns * 2.0 * np.pi * generator.integers(-4, 5, (m, n))
    data = measured(lengths, q, sigma, generator)
    found = estimate(Model(Arm(tuple(lengths), sigma=sigma)), data)
    expected, deviations = oracle(lengths, data)
    rounding = 10.0 * n * np.sqrt(m) * EPS * lengths.sum()
    if found.not_identifiable or found.status.name != "converged":
        # an angle less certain than a hundredth of a radian, or a link lost beside a far longer one
        uncertain = np.max(deviations * max(sigma, rounding) / lengths)
        assert uncertain > 1e-2 or lengths.min() < 1e-7 * lengths.sum()
        return
    assert np.max(np.abs((found.parameters - expected) / found.std)) <= DIGITS + rounding / sigma


@given(n=st.integers(1, 6), seed=st.integers(0, 2**32), scale=st.sampled_from([2.0**-20, 2.0**20]))
@FEW
def test_rows_turns_and_size_do_not_matter(n: int, seed: int, scale: float) -> None:
    """Rows in another order, whole turns of joints, and an arm of another size with measurements of that size."""
    generator = np.random.default_rng(seed)
    lengths, sigma = generator.uniform(50.0, 500.0, n), 0.1
    data = measured(lengths, generator.uniform(-3.0, 3.0, (2 * n + 6, n)), sigma, generator)
    order = generator.permutation(len(data))
    turned = data.postures + 2.0 * np.pi * generator.integers(-2, 3, data.postures.shape)
    first = estimate(Model(Arm(tuple(lengths), sigma=sigma)), data)
    for other, size in (
        (Measurements(data.postures[order], data.positions[order]), 1.0),
        (Measurements(turned, data.positions), 1.0),
        (Measurements(data.postures, scale * data.positions), scale),
    ):
        found = estimate(Model(Arm(tuple(size * lengths), sigma=size * sigma)), other)
        units = np.r_[np.full(n, size), np.ones(n)]
        np.testing.assert_allclose((found.parameters / units - first.parameters) / first.std, 0.0, atol=DIGITS)
        np.testing.assert_allclose(found.std / units, first.std, rtol=1e-9)
        assert found.status is first.status


def test_data_without_noise_are_fitted_exactly_and_said_to_be_so() -> None:
    """Offsets of any size, even half a turn, lengths 30 % off, a base elsewhere: there is no start to be poor."""
    generator = np.random.default_rng(5)
    for n in (1, 3, 12):
        lengths, q = np.full(n, 100.0), generator.uniform(-3.0, 3.0, (n + 4, n))
        errors, offsets, base = (generator.uniform(-size, size, k) for size, k in ((30.0, n), (3.1, n), (500.0, 2)))
        tip = np.exp(1j * np.cumsum(q + offsets, axis=1)) @ (lengths + errors) + base @ [1.0, 1.0j]
        exact = Measurements(q, np.column_stack([tip.real, tip.imag]))
        for sigma in (None, 0.1):
            found = estimate(Model(Arm(tuple(lengths), sigma=sigma, effects=(EffectSpec("base_offset"),))), exact)
            np.testing.assert_allclose(found.parameters, [*errors, *offsets, *base], rtol=0.0, atol=1e-10)
            assert any("data without noise" in said for said in found.warnings)
        few = measured(lengths, q[:n], 0.1, generator)  # as many equations as parameters leave nothing either
        found = estimate(Model(Arm(tuple(lengths), sigma=0.1)), few)
        assert not any("without noise" in said for said in found.warnings)


# -- in space ----------------------------------------------------------------------------------------------------------
UP = np.array([0.0, 0.0, 1.0])


def chain_with(lengths: np.ndarray, generator: np.random.Generator) -> KinematicChain:
    """Joints at these distances [mm], turned anyhow; the measured point is off the last axis."""
    turns = [np.linalg.qr(generator.standard_normal((3, 3)))[0] for _ in lengths]
    steps = [length * turn[:, 1] for length, turn in zip(lengths, turns, strict=True)]
    origins = [pose(rotation=turns[0] * np.linalg.det(turns[0]))]
    origins += [pose(s, t * np.linalg.det(t)) for s, t in zip(steps[:-1], turns[1:], strict=True)]
    joints = tuple(Joint(f"j{k}", origin, UP, lower=-10.0, upper=10.0) for k, origin in enumerate(origins, start=1))
    return KinematicChain(joints, pose(steps[-1]), tools={"1": 0.3 * lengths[-1] * np.array([0.6, 0.5, 0.6])})


def case(n: int, lengths: np.ndarray, sigma: float, m: int, generator: np.random.Generator) -> tuple:
    """A model with a minimal set of parameters, and measurements of an arm that is not as drawn: by three sigma, at
    most 1 % of the links, and by 1e-3 rad."""
    drawn = Arm(chain_with(lengths, generator), sigma=sigma)
    q = generator.uniform(-np.pi, np.pi, (m, n))
    model = Model(practical(drawn, Measurements(q, Model(drawn).position(q))))
    sizes = [1e-3 if p.unit == "rad" else min(3.0 * sigma, 0.01 * lengths.min()) for p in model.parameters]
    true = np.array(sizes) * generator.standard_normal(len(sizes))
    return model, Measurements(q, model.position(q, true) + sigma * generator.standard_normal((m, 3)))


@given(
    n=st.sampled_from([1, 2, 3, 6]),
    sigma=SIGMAS,
    wild=st.booleans(),
    long=st.booleans(),
    turns=st.booleans(),
    seed=st.integers(0, 2**32),
)
@FEWER
def test_a_fit_in_space_is_the_maximum_of_the_likelihood_or_says_why_not(
    n: int, sigma: float, wild: bool, long: bool, turns: bool, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    lengths = lengths_of(n, generator) if wild else generator.uniform(100.0, 500.0, n)
    model, data = case(n, lengths, sigma, 120 if long else 3 * n + 12, generator)
    q = data.postures + turns * 2.0 * np.pi * generator.integers(-4, 5, data.postures.shape)
    found = estimate(model, Measurements(q, data.positions), sigma="given")
    position, jacobian = found.model.linearize(q, found.parameters)
    residual, jacobian = (data.positions - position).ravel(), jacobian.reshape(-1, len(found.names))
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
