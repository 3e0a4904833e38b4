"""Rank, covariance and the names of what cannot be distinguished."""

import copy
import pickle
from collections.abc import Callable
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe.criteria import information_matrix
from identification import Arm, Calibration, Conditions, EffectSpec, Gravity, Measurements, Model, Plan, estimate
from identification.information import Spectrum, describe, sparse_basis, spectrum
from identification.simulate import simulate
from identification.workspace import WorkspaceBox

LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])


def found(effects: list[str], postures: np.ndarray) -> tuple[Model, Spectrum]:
    model = Model(Arm(LENGTHS, effects=tuple(EffectSpec(name) for name in effects)))
    return model, spectrum(model.jacobian(postures), model.scales)


def postures(m: int = 20, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (m, 4))


SHARES = [f"{x:.2g} length_error:{j + 1}" for j, x in enumerate(LENGTHS / LENGTHS.sum())]  # by hand: dl_j = l_j s
TIED = {
    ("base_offset",): (),
    ("base_rotation",): ("joint_offset:1 + base_rotation.angle",),
    ("tool_offset",): ("length_error:4 + tool_offset.x", "joint_offset:4 + tool_offset.y"),
    ("measurement_scale",): (" + ".join([*SHARES, "measurement_scale.s"]),),
}
TIED["base_rotation", "tool_offset"] = (*TIED["base_rotation",], *TIED["tool_offset",])


@pytest.mark.parametrize("effects", TIED)
def test_what_varied_postures_cannot_tell_apart_is_named(effects: tuple[str, ...]) -> None:
    model, told = found([*effects], postures())
    assert set(told.combinations(model.names, model.scales)) == {*TIED[effects]}
    assert told.rank == len(model.names) - len(TIED[effects])
    lost = {name for name, ok in zip(model.names, told.identifiable, strict=True) if not ok}
    assert lost == {name for name in model.names if any(name in words.split() for words in TIED[effects])}


def test_combinations_are_null_directions() -> None:
    plan = postures(3)
    model, told = found(["measurement_scale", "base_offset"], plan)
    jacobian, basis = model.jacobian(plan).reshape(6, -1), sparse_basis(told.null_space)
    assert basis.shape == (11, 5)
    np.testing.assert_allclose(jacobian / told.lengths @ basis, 0.0, atol=1e-9)
    assert np.linalg.matrix_rank(basis, tol=1e-6) == 5


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_units_do_not_matter(factor: float) -> None:
    model, told = found(["tool_offset"], postures())
    units = np.where(np.arange(10) % 2, factor, 1.0)
    scaled = spectrum(model.jacobian(postures()) * units, model.scales * units)
    assert scaled.combinations(model.names, model.scales * units) == told.combinations(model.names, model.scales)
    # even a scale that is wrong by six orders does not change what is told
    wrong = spectrum(model.jacobian(postures()) * units, model.scales)
    np.testing.assert_array_equal(wrong.identifiable, told.identifiable)


def test_covariance_is_the_inverse_information_and_never_huge() -> None:
    model = Model(Arm(LENGTHS))
    jacobian = model.jacobian(postures())
    expected = 0.01 * np.linalg.inv(information_matrix(jacobian))
    # entries that vanish by symmetry are rounding errors: compare correlations
    deviation = np.sqrt(np.diag(expected))
    correlations = 0.01 * spectrum(jacobian, model.scales).covariance / np.outer(deviation, deviation)
    np.testing.assert_allclose(correlations, expected / np.outer(deviation, deviation), rtol=0, atol=1e-11)
    aliased = Model(Arm(LENGTHS, effects=(EffectSpec("base_rotation"),)))
    lost = 0.01 * spectrum(aliased.jacobian(postures()), aliased.scales).covariance
    # what is told keeps its variance; the rest is shared, not inflated
    np.testing.assert_allclose(lost[:4, :4], expected[:4, :4], rtol=1e-9)
    assert np.max(lost) <= np.max(expected) * (1 + 1e-9)


@given(st.integers(0, 2**32), st.integers(2, 4), st.integers(1, 3))
@settings(max_examples=20)
def test_sparse_basis_finds_disjoint_blocks(seed: int, size: int, blocks: int) -> None:
    """Directions of disjoint support, mixed by a random rotation, come back one by one."""
    generator = np.random.default_rng(seed)
    planted = np.zeros((blocks * size + 2, blocks))
    for k in range(blocks):
        planted[k * size : (k + 1) * size, k] = generator.uniform(0.3, 1.0, size) * generator.choice([-1, 1], size)
    planted /= np.linalg.norm(planted, axis=0)
    basis = sparse_basis(planted @ np.linalg.qr(generator.normal(size=(blocks, blocks)))[0])
    for k in range(blocks):
        assert abs(planted[:, k] @ basis[:, k]) / np.linalg.norm(basis[:, k]) == pytest.approx(1.0, abs=1e-9)


def test_description_rounds_and_signs() -> None:
    names = ("a", "b", "c")
    assert describe(np.array([1.0, 0.001, -1.01]), names) == "a + c"
    assert describe(np.array([-0.3, 0.0, -1.0]), names) == "0.3 a - c"
    assert describe(np.array([0.0, 2.0, 0.0]), names) == "b"
    assert describe(np.array([0.5, -1.0, -0.5]), names) == "0.5 a - b + 0.5 c"


@pytest.mark.parametrize(("smallest", "rank"), [(0.1, 6), (1e-3, 6), (1e-6, 6), (1e-12, 5)])
def test_columns_times_the_root_are_orthonormal(smallest: float, rank: int) -> None:
    """Singular values of 1 and `smallest`; beyond the tolerance of ranks that direction is left out."""
    generator = np.random.default_rng(3)
    left, right = (np.linalg.qr(generator.normal(size=(rows, 6)))[0] for rows in (40, 6))
    columns = left * np.array([1.0, 1.0, 1.0, 1.0, 1.0, smallest]) @ right.T
    basis = columns @ spectrum(columns, np.ones(6)).root
    assert basis.shape == (40, rank)
    np.testing.assert_allclose(basis.T @ basis, np.eye(rank), atol=1e-14 / max(smallest, 1e-6))
    np.testing.assert_allclose(basis @ (basis.T @ columns), columns, atol=1e-11)


def test_count_of_what_is_determined_without_data_of_a_parameter() -> None:
    """One parameter known by the prior only, one by both equally, one by the data only: 0 + 1/2 + 1."""
    jacobian = np.diag([0.0, 2.0, 3.0])
    rows = np.array([[5.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    assert spectrum(jacobian, np.ones(3), prior=rows).determined(jacobian) == pytest.approx(1.5)


# -- arrays ------------------------------------------------------------------------------------------------------------
EFFECT = EffectSpec("encoder_eccentricity", 2, MappingProxyType({"a": 0.001, "b": 0.0}))


def gravity(payload: float = 0.0) -> Gravity:
    return Gravity([0.0, -9.81], [3.0, 2.0], [0.5, 0.5], payload)


def calibration(error: float = 0.3) -> Calibration:
    others = {"parameter_names": ("length_error:1",), "covariance": [[0.5]], "provenance": {"by": ["me"]}}
    return Calibration.of([error, 0.1], [0.01, 0.02], {"base_offset.x": 1.0}, **others)


def arm(lower: float = -2.0) -> Arm:
    box = WorkspaceBox((0.0, 1.0), (0.0, 1.0))
    return Arm([200.0, 100.0], [lower, -1.0], [2.0, 1.0], 0.1, "two", gravity(), (box,), (EFFECT,), calibration())


CASES: list[tuple[Callable[..., Any], Any]] = [
    (gravity, 1.0),
    (calibration, 0.4),
    (arm, -1.5),
    (lambda x=1.0: Measurements([[0.1, 0.2], [0.3, 0.4]], [[x, 2.0], [3.0, 4.0]], sigma=[0.1, 0.2]), 2.0),
    (lambda t=0.0: Conditions(time=np.array([t, 1.0])), 0.5),
    (lambda q=0.1: Plan([[q, 0.2]]), 0.3),
    (lambda w=0.5: Plan([[0.1, 0.2], [0.3, 0.4]], [w, 1.0 - w]), 0.4),
    (lambda lower=-2.0: Model(arm(lower)), -1.5),
]


@pytest.mark.parametrize(("make", "other"), CASES)
def test_equal_by_value(make: Callable[..., Any], other: Any) -> None:
    assert (make(), hash(make())) == (make(), hash(make()))
    assert make() != make(other)
    assert len({make(), make(), make(other)}) == 2
    assert make() != "text"


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda item: pickle.loads(pickle.dumps(item))])
def test_copies_and_pickles(again: Callable[[Any], Any]) -> None:
    for make, _ in CASES:
        assert again(make()) == make()
    truth = Arm([200.0, 100.0], sigma=0.1)
    assert str(truth) == "Arm(arm, 2 joints, reach 300 mm)"
    data = simulate(truth, np.random.default_rng(1).uniform(-2.0, 2.0, (9, 2)), np.random.default_rng(2))
    found = estimate(Model(truth), data)
    copied = again(found)
    np.testing.assert_array_equal(copied.parameters, found.parameters)
    np.testing.assert_array_equal(copied.covariance, found.covariance)
    assert copied.model == found.model
    np.testing.assert_array_equal(copied.model.position(data.postures), found.model.position(data.postures))
    assert str(copied) == str(found)


def test_limits_that_look_like_degrees_warn() -> None:
    with pytest.warns(UserWarning, match=r"limit 180 of joint 1 is 29 turns and looks like degrees.*radians") as caught:
        Arm([200.0, 100.0], lower=[-180.0, -90.0], upper=[180.0, 90.0])
    assert caught[0].filename == __file__
    with pytest.warns(UserWarning, match=r"limit -90 of joint 2"):
        Arm([200.0, 100.0], lower=[-3.0, -90.0])
    Arm([200.0], lower=[-10.0 * np.pi], upper=[10.0 * np.pi])  # five turns either way: no warning


def test_a_plan_and_an_arm_in_a_notebook() -> None:
    found = Plan(np.radians([[10.0, 20.0], [30.0, 40.0]]), np.array([0.5, 0.5]))
    assert "<tr><td>2</td><td>30</td><td>40</td><td>0.5</td></tr>" in found._repr_html_()
    shown = Arm([260.0, 180.0], name="a<b", sigma=0.1, effects=(EffectSpec("backlash", 2),))._repr_html_()
    assert "a&lt;b" in shown
    assert shown.count("<tr>") == 3
    assert "-180 deg" in shown
