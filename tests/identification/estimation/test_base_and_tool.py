"""A flange that keeps one orientation, or turns about one axis: base and measured point cannot be told apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification import Arm, Identification, Measurements, Model, Status, estimate
from identification.estimation.doubts import TOGETHER, flange_turns
from identification.kinematics.chain import DHRow, KinematicChain, chain_of
from identification.kinematics.frames import from_angles, pose

QUARTER = np.pi / 2.0
FOREARM = [(0.0, -QUARTER, 550.0), (0.0, QUARTER, 0.0), (0.0, 0.0, 90.0)]
TABLE = [(0.0, QUARTER, 350.0), (600.0, 0.0, 0.0), (50.0, QUARTER, 0.0), *FOREARM]  # a, alpha, d
CHAIN = chain_of([DHRow(*row) for row in TABLE])
ARM = Arm(CHAIN, sigma=0.05)
SCARA = chain_of([DHRow(400.0, 0.0, 300.0), DHRow(300.0, 0.0, 0.0), DHRow(0.0, 0.0, -80.0)])
POINT = np.array([30.0, 20.0, 80.0])


def turns_of(q: np.ndarray) -> Rotation:
    """Of links, by Rz(q) Rx(alpha)."""
    found = Rotation.identity(len(q))
    for angle, (_, alpha, _) in zip(q.T, TABLE, strict=False):
        found = found * Rotation.from_euler("z", angle[:, None]) * Rotation.from_euler("x", alpha)
    return found


def kept(rows: int, wobble: float, about: tuple[float, float, float] | None = None, seed: int = 4) -> np.ndarray:
    """(m, 6) postures whose flange keeps one orientation but for a wobble [rad], and any turn about an axis of it."""
    generator = np.random.default_rng(seed)
    first = generator.uniform([-1.0, 0.5, -0.5], [1.0, 1.4, 0.5], (rows, 3))
    wanted = Rotation.from_rotvec([2.6, 0.6, 0.3]) * Rotation.from_rotvec(wobble * generator.standard_normal((rows, 3)))
    if about is not None:
        wanted = wanted * Rotation.from_rotvec(generator.uniform(-1.5, 1.5, (rows, 1)) * np.array(about))
    wrist = turns_of(first).inv() * wanted  # Rz(q4) Ry(q5) Rz(q6), as Rx(-90) turns z to y
    q4, q5, q6 = wrist.as_euler("ZYZ").T
    return np.column_stack([first, q4, q5, q6])


def measured(postures: np.ndarray, chain: KinematicChain = CHAIN) -> Measurements:
    generator = np.random.default_rng(2)
    stands = pose((2000.0, -500.0, 700.0), from_angles((0.1, -0.4, 2.0)))
    model = Model(Arm(replace(chain, base=stands, tools={"1": POINT})))
    exact = model.position(postures, generator.normal(0.0, 0.3 / model.scales))
    return Measurements(postures, exact + generator.normal(0.0, 0.05, exact.shape))


def fitted(postures: np.ndarray) -> Identification:
    return estimate(Model(ARM), measured(postures))


def sentences(found: Identification) -> list[str]:
    return [said for said in found.warnings if said.startswith(TOGETHER)]


def test_what_orientations_tell() -> None:
    """A point at t moves by (R_i - mean R) t where the base follows it: root mean squares, by hand."""
    for wobble, about in ((0.01, None), (0.01, (0.0, 0.6, 0.8)), (1.0, None)):
        q = kept(50, wobble, about)
        turns = turns_of(q).as_matrix()
        apart = turns - turns.mean(axis=0)
        squares = np.linalg.eigvalsh(np.einsum("mji,mjk->ik", apart, apart) / len(q))
        np.testing.assert_allclose(flange_turns(CHAIN, Measurements(q, np.zeros((50, 3)))), np.sqrt(squares), atol=1e-9)


@pytest.mark.parametrize(("wobble", "turned"), [(0.0, "0"), (2e-4, "0.021")])
def test_one_orientation_is_the_cause(wobble: float, turned: str) -> None:
    """Never turned, or by 0.02 deg, only errors of the arm determine the point, and not to 10 mm, and the fit is right
    all the same: no more rows of the kind help, but a few that turn the flange do."""
    q = kept(200, wobble)
    found = fitted(q)
    assert found.rms_after < 1.05 * np.sqrt(3.0) * 0.05
    tools = [k for k, name in enumerate(found.names) if name.startswith("tool")]
    assert found.model.arm.chain is not None
    apart = found.parameters[tools] + found.model.arm.chain.tools["1"] - POINT
    # of the linear model about the end of a curved valley: 4.0 in the first, where a search cut short ends before it
    assert np.all(np.abs(apart) < 5.0 * found.std[tools])
    assert found.status is Status.converged
    assert np.all(found.std[tools] > 10.0)
    (said,) = sentences(found)
    assert said.startswith(f"{TOGETHER}: the flange kept one orientation, turned by {turned} deg (RMS). ")
    assert said.endswith("Measure postures that turn it about two axes by 45 deg and more, or give [tool]")
    assert not any("too few measurements" in warning for warning in found.warnings)
    if wobble:
        return
    generator = np.random.default_rng(6)
    turned = np.concatenate([q, generator.uniform(-1.2, 1.2, (15, 6))])
    better = fitted(turned)
    assert sentences(better) == []
    assert better.expected_tip_measured is not None
    assert better.expected_tip_measured < 0.5


def test_one_axis_is_the_cause() -> None:
    found = fitted(kept(200, 0.0, (0.0, 0.6, 0.8)))
    (said,) = sentences(found)
    assert "the flange turned about one axis only, about others by " in said
    assert said.endswith("Measure postures that turn it about another axis, too, by 45 deg and more, or give [tool]")


def test_what_is_not_the_cause() -> None:
    """Few rows of turned flanges, a tool that is given, and an arm that can turn its flange about one axis only."""
    few = estimate(Model(replace(ARM, sigma=None)), measured(np.random.default_rng(6).uniform(-1.2, 1.2, (9, 6))))
    assert sentences(few) == []
    given = Arm(replace(CHAIN, tools={"1": POINT}, settled=frozenset({"tool"})), sigma=0.05)
    assert sentences(estimate(Model(given), measured(kept(200, 0.0)))) == []
    planes = np.random.default_rng(6).uniform(-2.0, 2.0, (60, 3))
    assert sentences(estimate(Model(Arm(SCARA, sigma=0.05)), measured(planes, SCARA))) == []
