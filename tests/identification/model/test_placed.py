"""Base and measured points of spatial arms from nothing, minimal sets of parameters, positions of arms with lengths."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification import PRISMATIC, Arm, Conditions, InputError, Measurements, Model
from identification.instruments import Distance, Tracker
from identification.instruments.base import registered
from identification.kinematics.chain import DHRow, KinematicChain, chain_of
from identification.kinematics.frames import pose
from identification.model.placed import minimal, of_positions, placed_model, practical, tip_jacobian
from tests.doe.six_axis import CHAIN as DRAWN

QUARTER = np.pi / 2.0
ROWS = [(0.0, QUARTER, 350.0), (-400.0, 0.0, 0.0), (-350.0, 0.0, 0.0), (0.0, QUARTER, 110.0), (0.0, -QUARTER, 90.0)]
CHAIN = chain_of([DHRow(a, alpha, d) for a, alpha, d in [*ROWS, (0.0, 0.0, 80.0)]])
BASE = pose((1500.0, -700.0, 300.0), Rotation.from_euler("xyz", (0.3, -1.2, 2.5)).as_matrix())
TOOLS = {"left": np.array([60.0, 20.0, 50.0]), "right": np.array([-70.0, 10.0, 40.0])}
TRUE = replace(CHAIN, base=BASE, tools=TOOLS)


def measured(chain: KinematicChain, rows: int = 60) -> Measurements:
    """Exact positions of both points in turn."""
    postures = np.random.default_rng(4).uniform(-2.5, 2.5, (rows, 6))
    data = Measurements(postures, np.zeros((rows, 3)), marker=np.array(list(TOOLS))[np.arange(rows) % 2])
    return replace(data, positions=Model(Arm(chain)).position(postures, conditions=data.conditions))


@pytest.mark.parametrize("known", [(), ("base",), ("tool",)], ids=" ".join)
def test_found_from_nothing(known: tuple[str, ...]) -> None:
    """Without errors of the geometry the closed form is exact to where its rounds end: 1e-6 of the squares."""
    given = {"base": {"base": BASE}, "tool": {"tools": TOOLS}}
    start = replace(CHAIN, tools=dict.fromkeys(TOOLS, np.zeros(3)), settled=frozenset(known))
    for name in known:
        start = replace(start, **given[name])  # type: ignore[arg-type]
    model = placed_model(Model(Arm(start)), measured(TRUE))
    chain = model.arm.chain
    assert chain is not None
    np.testing.assert_allclose(chain.base, BASE, atol=0.5)
    for name, place in TOOLS.items():
        np.testing.assert_allclose(chain.tools[name][:3, 3], place, atol=0.5)
    data = measured(TRUE)
    left = data.positions - model.position(data.postures, conditions=data.conditions)
    assert np.linalg.norm(left, axis=1).max() < 0.5


BAR = Arm(replace(DRAWN, instrument=Distance(), base=pose([-700.0, 200.0, -300.0])), sigma=0.01)
POSTURES = np.random.default_rng(0).uniform(-2.0, 2.0, (30, 6))


def test_the_same_parameters() -> None:
    model = Model(BAR)
    whole = of_positions(model)
    assert whole.names == model.names
    distances = np.linalg.norm(whole.position(POSTURES), axis=1)
    np.testing.assert_allclose(distances, model.position(POSTURES)[:, 0], rtol=1e-14)
    assert of_positions(whole) is whole


def test_what_is_left_after_registration() -> None:
    """Of a small change of each parameter: the RMS that the best rigid motion of the points leaves, found by Kabsch."""
    model = Model(BAR)
    found, whole = tip_jacobian(model, POSTURES), of_positions(model)
    before, step = whole.position(POSTURES), 1e-3
    for k, scale in enumerate(model.scales):
        change = np.zeros(len(model.names))
        change[k] = step / scale
        after = whole.position(POSTURES, change)
        motion = registered(before, after)
        left = after - before @ motion[:3, :3].T - motion[:3, 3]
        expected = np.sqrt(np.mean(np.sum(left**2, axis=1))) / change[k]
        assert np.sqrt(np.mean(np.sum(found[..., k] ** 2, axis=1))) == pytest.approx(expected, abs=1e-5 * scale)
    with pytest.raises(InputError, match="3 for the error of the tip from lengths, allowed: at least 4"):
        tip_jacobian(model, POSTURES[:3])


SIX = replace(DRAWN, tools={"1": np.zeros(3)})
OFF_AXIS, ON_AXIS = {"1": np.array([60.0, 20.0, 30.0])}, {"1": np.array([0.0, 0.0, 30.0])}
THREE = {
    name: np.array(place) for name, place in zip("abc", ([60.0, 20, 30], [-40.0, 50, 30], [0.0, -70, 90]), strict=True)
}
SLIDING = replace(DHRow(0.0, QUARTER, 0.0), type=PRISMATIC, limits=(100.0, 600.0))


@pytest.mark.parametrize(
    ("chain", "count"),
    [
        (replace(SIX, tools=OFF_AXIS), 27),
        (replace(SIX, tools=ON_AXIS), 25),  # the last joint's offset and one more turn the point about itself
        (replace(SIX, tools=THREE), 33),
        (replace(SIX, tools=OFF_AXIS, instrument=Tracker(300.0)), 30),  # 4 for each axis, 6 of the frame
        (chain_of([DHRow(0.0, QUARTER, 300.0), SLIDING, DHRow(80.0, 0.3, 50.0), DHRow(0.0, 0.0, 90.0)]), None),
        (chain_of([DHRow(0.0, QUARTER, 0.0), DHRow(0.0, 0.0, 0.0)]), None),
    ],
    ids=["reflector", "on the last axis", "three reflectors", "a pose", "a sliding joint", "axes that meet"],
)
def test_as_many_as_can_be_told_apart(chain: KinematicChain, count: int | None) -> None:
    """The rank of all parameters' Jacobian, by singular values, is that of the minimal set; nothing is lost."""
    model = Model(Arm(chain))
    found = minimal(model)
    postures = np.random.default_rng(5).uniform(model.arm.lower, model.arm.upper, (200, len(chain)))
    marker = Conditions(marker=np.arange(200.0) % len(chain.tools))
    everything, kept = (
        (m.jacobian(postures, None, marker) / m.scales).reshape(-1, len(m.names)) for m in (model, found)
    )
    every_value, kept_value = (np.linalg.svd(rows, compute_uv=False) for rows in (everything, kept))
    rank = int(np.sum(every_value > 1e-9 * every_value[0]))
    assert len(found.names) == rank == int(np.sum(kept_value > 1e-9 * kept_value[0]))
    assert count is None or rank == count
    assert found.prior == {}


def test_what_measurements_hardly_tell_is_left_out() -> None:
    """A reflector 0.2 mm off the last axis tells that axis's own errors by a few micrometres: as on the axis."""
    nearly = replace(SIX, tools={"1": np.array([0.2, 0.0, 30.0])})
    data = Measurements(np.random.default_rng(1).uniform(-2.0, 2.0, (80, 6)), np.zeros((80, 3)))
    data = replace(data, positions=Model(Arm(nearly)).position(data.postures))
    found = practical(Arm(SIX), data)
    assert (len(Model(found).names), len(minimal(placed_model(Model(Arm(SIX)), data)).names)) == (25, 27)
    assert practical(found, data) is found
    planar = Arm([300.0, 200.0])
    assert practical(planar, data) is planar


def test_joints_that_stand_still_stay_as_drawn() -> None:
    """With its wrist at rest an arm is one of three axes, four numbers each and three of the reflector. Once the other
    twelve were free, and frames of a real robot came out 23 m from the drawing."""
    q = np.random.default_rng(2).uniform(-1.5, 1.5, (60, 6))
    q[:, 3:] = [0.5, -0.7, 0.3]
    names = Model(practical(Arm(SIX), Measurements(q, Model(Arm(replace(SIX, tools=OFF_AXIS))).position(q)))).names
    assert len(names) == 15
    assert not {name.rpartition(":")[2] for name in names} & {"5", "6"}
