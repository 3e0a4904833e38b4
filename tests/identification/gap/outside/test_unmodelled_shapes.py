"""General shapes of what no effect explains: what they are made of, in a plane and in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from identification.gap.fits.whitening import Rows
from identification.gap.outside.unmodelled_shapes import general_shapes, rotations
from identification.measurements import Conditions

RNG = np.random.default_rng(12)


@dataclass
class FakeModel:
    """All that shapes need of a model: positions and levers."""

    positions: np.ndarray
    levers: np.ndarray

    def position(self, *_: object) -> np.ndarray:
        return self.positions

    def joint_levers(self, *_: object) -> np.ndarray:
        return self.levers


@dataclass
class FakeFit:
    model: FakeModel
    values: None = None


def shapes(d: int, m: int = 40, n: int = 2) -> tuple[Rows, FakeModel, dict]:
    q, model = RNG.uniform(-2.0, 2.0, (m, n)), FakeModel(RNG.normal(size=(m, d)), RNG.normal(size=(m, d, n)))
    rows = Rows(q, model.positions, Conditions(time=np.linspace(-0.5, 0.5, m)), np.arange(m, dtype=float))
    listed = {}
    for place in general_shapes(FakeFit(model), rows):  # type: ignore[arg-type]
        parts = np.split(place.columns, np.cumsum(place.sizes)[:-1], axis=2)
        listed |= {(place.place, shape): part for shape, part in zip(place.shapes, parts, strict=True)}
    return rows, model, listed


@pytest.mark.parametrize("d", [2, 3])
def test_an_unknown_function_of_a_joint_acts_through_its_lever(d: int) -> None:
    rows, model, listed = shapes(d)
    expected = model.levers[:, :, 1] * (rows.postures[:, 1] ** 2)[:, None]
    np.testing.assert_allclose(listed["joint:2", "square"][:, :, 0], expected, rtol=1e-14)
    wave = listed["joint:1", "wave of 2.5 per turn"]
    np.testing.assert_allclose(wave[:, :, 1], model.levers[:, :, 0] * np.sin(2.5 * rows.postures[:, :1]), rtol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_shapes_in_time_and_in_the_workspace_have_all_coordinates(d: int) -> None:
    rows, model, listed = shapes(d)
    time = rows.conditions.time
    assert time is not None
    np.testing.assert_allclose(listed["time", "power 2"], (time**2)[:, None, None] * np.eye(d), rtol=1e-14)
    assert listed["time", "rotation power 2"].shape == (40, d, {2: 1, 3: 3}[d])
    wave = listed["time", "wave of 1 per session"]  # cosine and sine of every coordinate: rank 2 d
    assert np.linalg.matrix_rank(wave.reshape(-1, 2 * d)) == 2 * d
    along = "xyz"[:d]
    assert all(("workspace", f"wave of 1 reach along {axis}") in listed for axis in along)
    scaled = model.positions / np.sqrt(np.mean(model.positions**2))
    name = " ".join(f"{axis}^{k}" for axis, k in zip(along, (1, 2, 0), strict=False))
    np.testing.assert_allclose(listed["workspace", name][:, 0, 0], scaled[:, 0] * scaled[:, 1] ** 2, rtol=1e-12)
    # monomials of degree 2 and 3 in d variables: C(d + 1, 2) + C(d + 2, 3) = 7 in the plane, 16 in space
    assert sum("^" in shape for place, shape in listed if place == "workspace") == {2: 7, 3: 16}[d]


def test_rotations_are_cross_products() -> None:
    """About z in the plane; about z, -y, x in space."""
    p = RNG.normal(size=(5, 3))
    np.testing.assert_allclose(rotations(p[:, :2])[:, :, 0], np.column_stack([-p[:, 1], p[:, 0]]), rtol=0)
    for k, axis in enumerate(([0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0])):
        np.testing.assert_allclose(rotations(p)[:, :, k], np.cross(axis, p), rtol=1e-15)
