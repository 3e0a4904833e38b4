"""What an arm offers to designs: points by an independent chain, postures that touch, nothing of the arm inside."""

from dataclasses import replace

import numpy as np
import pytest

from doe import DesignProblem
from doe.plan.accuracy import workspace
from identification import Arm, ArmModel, InputError, Model, Plan, for_design
from identification.instruments import Plane, Sphere
from identification.kinematics.chain import BASE, TOOL
from identification.kinematics.frames import pose, rotation_to_z
from tests.doe.arms import FOUR
from tests.doe.six_axis import CHAIN, REFLECTOR
from tests.identification.kinematics.test_spatial import tip_by_exponentials

CENTER, BALL = np.array([550.0, -250.0, 400.0]), 40.0
NORMAL = np.array([0.1, 0.2, 1.0]) / np.linalg.norm([0.1, 0.2, 1.0])
LOW = np.array([0.0, 0.0, -150.0])  # a point of the plane
pytestmark = pytest.mark.filterwarnings("ignore:instrument. plans are chosen")


def arm_of(kind: str, **changes: object) -> Arm:
    """Its limits are 2 rad; the surface where `center_mm` and `normal` say."""
    axes = rotation_to_z(NORMAL).T if kind == "plane" else np.eye(3)
    base = pose(-axes @ (LOW if kind == "plane" else CENTER), axes)
    instrument = Sphere(BALL) if kind == "sphere" else Plane()
    chain = replace(CHAIN, instrument=instrument, base=base, tools={"1": REFLECTOR}, settled=frozenset({TOOL}))
    joints = tuple(replace(joint, lower=-2.0, upper=2.0) for joint in chain.joints)
    return Arm(replace(chain, joints=joints), sigma=0.01, **changes)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(for_design, "CHOICES", 150)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("kind", ["sphere", "plane"])
def test_choices_touch_and_nothing_is_inside(kind: str) -> None:
    problem = DesignProblem.of(Model(arm_of(kind)))
    assert len(problem.choices) == 150
    assert np.abs(problem.choices).max() <= 2.0
    for q in problem.choices[:20]:
        tip = tip_by_exponentials(replace(CHAIN, base=np.eye(4)), q, {}, REFLECTOR)
        height = (tip - LOW) @ NORMAL if kind == "plane" else np.linalg.norm(tip - CENTER) - BALL
        assert height == pytest.approx(0.0, abs=1e-6)
        points = Model(arm_of(kind)).points(q[None])[0]
        for share in np.linspace(0.0, 1.0, 21):
            between = points[:-1] + share * np.diff(points, axis=0)
            above = (between - LOW) @ NORMAL if kind == "plane" else np.linalg.norm(between - CENTER, axis=1) - BALL
            assert above.min() > -1e-5
    # the stylus comes from outside at all of them, and at half of those that would touch if it could pass through
    assert len(workspace(problem)) == 1000  # targets are anywhere


@pytest.mark.usefixtures("few")
def test_a_stylus_that_passes_through_does_not_touch() -> None:
    arm = arm_of("plane")
    model, q = ArmModel(arm), DesignProblem.of(Model(arm)).choices
    assert model.clear_of_surface(q).all()
    assert np.linalg.norm(model.position(q), axis=1).max() < 1e-6
    over = replace(arm.chain, base=pose(rotation=np.diag([1.0, -1.0, -1.0])) @ arm.chain.base)  # from below
    assert not ArmModel(replace(arm, chain=over)).clear_of_surface(q).any()
    with pytest.raises(InputError, match="its normal on the side of the arm"):
        _ = DesignProblem.of(Model(replace(arm, chain=over))).choices


def test_what_no_plan_can_be_made_for() -> None:
    arm = arm_of("sphere")
    nowhere = replace(arm.chain, base=np.eye(4))
    with pytest.raises(InputError, match="kind sphere without center_mm: the place of contact is not known"):
        DesignProblem.of(Model(replace(arm, chain=nowhere)))
    far = replace(arm.chain, base=pose(-20.0 * CENTER), settled=frozenset({BASE, TOOL}))
    with pytest.raises(InputError, match="sphere is reached within limits and constraints from 0 of 40000 random"):
        DesignProblem.of(Model(replace(arm, chain=far)))


def test_weights_of_a_plan_are_runs_of_what_it_could_show() -> None:
    """A posture of weight 4 / 12 is seen as one that is measured four times, and one of weight 0 not at all."""
    model, postures = ArmModel(FOUR), np.random.default_rng(1).uniform(FOUR.lower, FOUR.upper, (10, 4))
    weighted = model.detectability(Plan(postures, np.array([4, 1, 1, 1, 1, 1, 1, 1, 1, 0]) / 12.0))
    repeated = model.detectability(Plan(postures[[0, 0, 0, *range(9)]]))
    drift = [name.endswith("drift") for name in repeated.names]  # is of the order, which weights do not have
    np.testing.assert_allclose(weighted.norm_fractions[np.invert(drift)], repeated.norm_fractions[np.invert(drift)])
    assert weighted.freedom == repeated.freedom - 6
    size, larger = (each.detectable["gear_ratio:2"].value for each in (repeated, weighted))
    assert larger > size * np.sqrt(12.0 / 10.0)  # as many runs as rows, and fewer degrees of freedom
