"""General shapes of what no effect explains: what they are made of, in a plane and in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from doe.studies.blind.hidden_effects import off
from doe.studies.blind.spatial_hidden_effects import column
from doe.studies.blind.spatial_simulator import position
from identification.arm import Arm
from identification.gap.fits.whitening import Rows
from identification.gap.outside.unmodelled_shapes import general_shapes, rotations
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from identification.kinematics.parameters import PRISMATIC
from identification.measurements import Conditions
from identification.model import Model
from tests.doe.studies.blind.test_spatial_simulator import model_of, truth_and_session

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
    model: FakeModel | Model
    values: np.ndarray | None = None


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


def test_a_wobbling_axis_is_among_the_shapes() -> None:
    """The derivative by its amplitude, of an arm as lines in space, is in the span of the waves twice a turn, and that
    of an axis that runs out in the span of the shifts: for the frame before the joint it turns backwards, once a turn,
    for that which the joint moves twice. Neither is in that of another joint's shapes."""
    truth, run = truth_and_session()
    rows = Rows(run.q, position(truth, run), Conditions(temperature=run.warm, time=run.t), np.arange(30.0))
    model = model_of(truth)
    places = {place.place: place for place in general_shapes(FakeFit(model, model.values), rows)}  # type: ignore[arg-type]
    for effect, shape in (
        (("axis_wobble", 3, {"c": 1.0}), "tilt across the axis, 2 per turn"),
        (("axis_runout", 3, {"a": 0.6, "b": 0.8}), "shift across the axis, 2 per turn"),
    ):
        moved = column(truth, run, None, effect)
        for joint in (2, 3):
            found = places[f"joint:{joint}"]
            parts = np.split(found.columns, np.cumsum(found.sizes)[:-1], axis=2)
            own = parts[found.shapes.index(shape)].reshape(90, 4)
            left = np.linalg.norm(off(own, moved)) / np.linalg.norm(moved)
            assert left < 1e-6 if joint == 3 else left > 0.1  # of differences


def test_no_wobble_of_a_joint_that_slides() -> None:
    chain = chain_of([DHRow(0.0, 1.0, 300.0), DHRow(0.0, 0.5, 100.0, type=PRISMATIC, limits=(0.0, 200.0))])
    q = np.column_stack([RNG.uniform(-2.0, 2.0, 40), RNG.uniform(0.0, 200.0, 40)])
    model = Model(Arm.of_chain(chain))
    rows = Rows(q, model.position(q), Conditions(time=np.linspace(-0.5, 0.5, 40)), np.arange(40.0))
    shapes = {place.place: place.shapes for place in general_shapes(FakeFit(model, model.values), rows)}  # type: ignore[arg-type]
    assert [shape for shape in shapes["joint:1"] if "across" in shape] == list(shapes["joint:1"][-8:])
    assert not [shape for shape in shapes["joint:2"] if "across" in shape]


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
