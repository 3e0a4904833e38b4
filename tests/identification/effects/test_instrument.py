"""A constant in all measured distances: its derivative and what it moves by hand, and that fits find it."""

from dataclasses import replace
from itertools import product

import casadi as ca
import numpy as np
import pytest

from identification import (
    PRISMATIC,
    Arm,
    Calibration,
    Conditions,
    EffectSpec,
    Gravity,
    InputError,
    Measurements,
    Model,
    diagnose,
    estimate,
)
from identification.effects import ArmState, Scope, Setting, build
from identification.effects.base import clock
from identification.gap.blocks import hypotheses
from identification.instruments import TRACKER, Distance, Instrument, Sphere, Tracker
from identification.kinematics.chain import DHRow, Joint, KinematicChain, chain_of
from identification.kinematics.frames import pose
from identification.measurements import condition_columns
from identification.model.placed import in_own_frame, tip_jacobian
from identification.simulate import simulate
from tests.doe.six_axis import CHAIN, REFLECTOR
from tests.identification.exponentials import Exponentials, drawing
from tests.identification.kinematics.test_spatial import tip_by_exponentials

OFFSET, C = EffectSpec("length_offset"), "length_offset.c"
BASE = pose([-700.0, 200.0, -300.0])
BAR = Arm(replace(CHAIN, instrument=Distance(), base=BASE), sigma=0.01)
Q = np.random.default_rng(0).uniform(-2.0, 2.0, (40, 6))


@pytest.mark.parametrize("more", [(), (EffectSpec("encoder_eccentricity", 2),)], ids=["alone", "beside another"])
def test_every_distance_is_longer_by_it(more: tuple[EffectSpec, ...]) -> None:
    """d = |p| + c: against products of exponentials, and its derivative is 1."""
    model = Model(BAR.with_effects(OFFSET, *more))
    read, jacobian = model.linearize(Q, model.parameters.vector({C: 2.5}))
    places = [tip_by_exponentials(replace(CHAIN, base=BASE), posture, {}, REFLECTOR) for posture in Q]
    np.testing.assert_allclose(read[:, 0], np.linalg.norm(places, axis=1) + 2.5, rtol=1e-12)
    np.testing.assert_allclose(jacobian[:, 0, model.names.index(C)], 1.0, rtol=1e-12)


def test_no_point_is_moved_by_it() -> None:
    """Neither errors of the tip nor positions in the arm's own frame depend on how a length is read."""
    model = Model(BAR.with_effects(OFFSET))
    moved, plain = tip_jacobian(model, Q, model.parameters.vector({C: 5.0})), tip_jacobian(Model(BAR), Q)
    assert not moved[..., model.names.index(C)].any()
    np.testing.assert_allclose(np.delete(moved, model.names.index(C), axis=-1), plain, rtol=1e-12, atol=1e-9)
    own = Model(in_own_frame(replace(BAR.with_effects(OFFSET), calibration=Calibration({C: 5.0})))).position(Q)
    np.testing.assert_allclose(own, Model(in_own_frame(BAR)).position(Q), rtol=1e-12, atol=1e-9)


def test_it_is_estimated_and_named() -> None:
    """Distances of an independent simulator, all 0.6 mm too long: the estimate is within four of its deviations, with a
    fit that leaves the noise; `diagnose` finds it without being told."""
    generator = np.random.default_rng(5)
    truth, q = Exponentials(generator), generator.uniform(-2.0, 2.0, (80, 6))
    center = truth.base[:3, :3] @ np.array([600.0, -200.0, 300.0]) + truth.base[:3, 3]
    read = np.linalg.norm(truth.poses(q)[:, :3, 3] - center, axis=1) + 0.6 + 0.02 * generator.standard_normal(80)
    data = Measurements(q, read[:, None])
    arm = Arm(replace(drawing(), instrument=Distance()), sigma=0.02)
    found = estimate(Model(arm.with_effects(OFFSET)), data)
    k = found.names.index(C)
    assert abs(found.parameters[k] - 0.6) < 4.0 * float(np.sqrt(found.covariance[k, k])) < 0.2
    assert found.rms_after < 0.022
    assert diagnose(arm, data).named.effects == ("length_offset",)


def test_it_is_refused_where_no_distances_are_measured() -> None:
    for instrument, width in ((Sphere(30.0), 1), (TRACKER, 3)):
        arm = Arm(replace(CHAIN, instrument=instrument), effects=(OFFSET,))
        with pytest.raises(InputError, match="length_offset needs measured distances, allowed: an arm file with"):
            estimate(Model(arm), Measurements(Q, np.ones((40, width))))
    with pytest.raises(InputError, match="length_offset is of spatial arms"):
        _ = Model(Arm(np.array([300.0, 200.0]), effects=(OFFSET,))).effects


# -- scatter -----------------------------------------------------------------------------------------------------------
ARM = Arm([300.0, 200.0, 150.0], sigma=0.1)
POSTURES = np.random.default_rng(1).uniform(-np.pi, np.pi, (4000, 3))
EXACT = Model(ARM).position(POSTURES)


def errors(name: str = "", joint: int | None = None, sigma: float | None = None, **values: float) -> np.ndarray:
    """(m, 2) of an arm with this effect, or none."""
    arm = ARM.with_effects(*([EffectSpec(name, joint, values)] if name else []))
    np.testing.assert_array_equal(Model(arm).position(POSTURES), EXACT)  # the model ignores it
    assert Model(arm).names == Model(ARM).names
    return simulate(arm, POSTURES, np.random.default_rng(2), sigma=sigma).positions - EXACT


def test_joint_noise_moves_the_tip_about_its_joint() -> None:
    moved = errors("joint_noise", 2, sigma=0.0, std=1e-3)
    arm = EXACT - 300.0 * np.column_stack([np.cos(POSTURES[:, 0]), np.sin(POSTURES[:, 0])])
    across = (moved[:, 1] * arm[:, 0] - moved[:, 0] * arm[:, 1]) / np.sum(arm**2, axis=1)
    # 4000 draws: relative standard error of a deviation 1.1 %
    assert np.std(across) == pytest.approx(1e-3, rel=0.05)
    np.testing.assert_allclose(np.sum(moved * arm, axis=1), 0.0, atol=1e-6)


def test_reach_and_time_noise_scale_the_errors() -> None:
    reach = np.linalg.norm(EXACT, axis=1)[:, None] / 650.0
    np.testing.assert_allclose(errors("reach_noise", g=3.0), errors() * np.sqrt(1 + 9 * reach**2), atol=1e-10)
    growth = np.exp(1.5 * np.linspace(-0.5, 0.5, 4000))[:, None]
    np.testing.assert_allclose(errors("time_noise", g=1.5), errors() * growth, atol=1e-10)


def test_serial_correlation_keeps_the_variance() -> None:
    rows = errors("serial_correlation", rho=0.7)
    # 8000 numbers: standard error of the correlation 0.008, of the deviation (effective number 2700) 1.4 %
    assert np.sum(rows[1:] * rows[:-1]) / np.sum(rows**2) == pytest.approx(0.7, abs=0.04)
    assert np.std(rows) == pytest.approx(0.1, rel=0.06)


ELBOW = (
    Joint("j1", pose((0.0, 0.0, 400.0)), np.array([0.0, 0.0, 1.0])),
    Joint("j2", pose((100.0, 0.0, 0.0)), np.array([0.0, 1.0, 0.0]), PRISMATIC, 0.0, 300.0),
    Joint("j3", pose((0.0, 0.0, 200.0)), np.array([0.0, 1.0, 0.0])),
)
ONE, TWO = {"1": np.array([60.0, 0.0, 50.0])}, {"1": np.zeros(3), "2": np.array([0.0, 700.0, 0.0])}
SETTINGS = np.random.default_rng(4).uniform([-3.0, 0.0, -1.0], [3.0, 300.0, 1.0], (1000, 3))


@pytest.mark.parametrize(
    ("tools", "instrument"),
    [(ONE, TRACKER), (TWO, TRACKER), (ONE, Tracker(500.0)), (TWO, Tracker(500.0)), (ONE, Distance())],
    ids=["a point", "two points", "a pose", "two poses", "a length"],
)
def test_outliers_have_their_size_and_share_and_point_anywhere(
    tools: dict[str, np.ndarray], instrument: Instrument
) -> None:
    """Of the arm that slides: `size` standard deviations each, the mean of their directions zero and of the squares of
    each coordinate 1/3; orientations are not moved; a length is too long or too short."""
    arm = Arm(KinematicChain(ELBOW, np.eye(4), tools=tools, instrument=instrument), sigma=0.1)
    noisy = arm.with_effects(EffectSpec("outliers", None, {"share": 0.5, "size": 20.0}))
    exact, far = (simulate(one, SETTINGS, np.random.default_rng(5), sigma=0.1) for one in (arm, noisy))
    width = 3 if instrument.reads_positions else 1
    moved_by = (far.positions - exact.positions)[:, :width]
    off = (size := np.linalg.norm(moved_by, axis=1)) > 1e-9
    assert off.sum() == len(size) // 2
    np.testing.assert_allclose(size[off], 2.0, rtol=1e-9)
    # 500 directions or more: standard errors of a mean .026 (of a sign .045), of a mean square .013
    np.testing.assert_allclose(moved_by[off].mean(axis=0) / 2.0, 0.0, atol=0.1 if width == 3 else 0.18)
    np.testing.assert_allclose((moved_by[off] ** 2).mean(axis=0) / 4.0, 1.0 / width, atol=0.05)
    if instrument.angle_scale is not None:
        np.testing.assert_array_equal(far.orientations, exact.orientations)


# -- along the chain ---------------------------------------------------------------------------------------------------
LENGTHS, MASSES, CENTERS = np.array([400.0, 300.0]), np.array([5.0, 3.0]), np.array([0.5, 0.4])
HEAVY = Arm(LENGTHS, gravity=Gravity([2.0, -9.0], MASSES, CENTERS))
POSTURE, PAYLOAD = np.array([0.7, -1.9]), 4.0


def chain(arm: Arm = HEAVY) -> ArmState:
    return ArmState.of(arm, ca.SX(POSTURE), ca.SX([PAYLOAD, 1.5, -0.25, 2.0, 1.0, -1.0]), condition_columns(2))


def number(expression: ca.SX) -> np.ndarray:
    return np.array(ca.DM(expression)).ravel()


def test_loads_beyond_a_link() -> None:
    """In the axes of the first link: what hangs on the second, and nothing beyond it."""
    pull = (3.0 + PAYLOAD) * (2.0 - 9.0j) * np.exp(-1j * POSTURE[0])
    np.testing.assert_allclose(number(chain().weight(1, 0)), [pull.real, pull.imag, 0.0], atol=1e-13)
    np.testing.assert_allclose(number(chain().weight(2, 0)), [0.0, 0.0, 0.0])
    # moment about joint 2 of the link's mass, at 0.4 of it, and the payload at the tip
    along = np.array([np.cos(POSTURE.sum()), np.sin(POSTURE.sum())])  # of the second link, 0.3 m long
    lever = 0.3 * (0.4 * 3.0 + PAYLOAD) * along
    np.testing.assert_allclose(number(chain().moment(1)), [0.0, 0.0, lever[0] * -9.0 - lever[1] * 2.0], atol=1e-13)


def test_without_gravity_there_are_no_torques() -> None:
    with pytest.raises(InputError, match=r"needs gravity torques, add a \[gravity\] table"):
        _ = chain(Arm(LENGTHS)).torques


def test_what_a_sliding_joint_is_off_by_is_a_length() -> None:
    """Newtons bend it by millimetres; of the turning joint beside it torques and angles are as ever."""
    rows = [DHRow(300.0, np.pi / 2, 0.0), replace(DHRow(0.0, 0.0, 100.0), type=PRISMATIC, limits=(0.0, 200.0))]
    slider = chain_of(rows)
    each = [EffectSpec(*at) for at in product(("joint_compliance", "backlash"), (1, 2))] + [
        EffectSpec("joint_coupling", 2)
    ]
    sizes = {p.toml_key: p.typical for spec in each for p in build(spec, slider).parameters}
    turning, as_far = {"c_rad_per_N_m": 1e-5, "b_deg": 1.5e-4}, {"c_mm_per_N": 1e-5, "b_mm": 1.5e-4, "c": 1e-4}
    assert sizes == pytest.approx(turning | {key: size * slider.levers[1] for key, size in as_far.items()})
    every = build(EffectSpec("joint_compliance"), slider).parameters
    assert [p.file_unit for p in every] == ["rad/(N m)", "mm/N"]
    mixed = chain_of([*rows, rows[0], rows[0]])  # c q_(j-1): what a radian or millimetre of the joint before adds
    coupled = [build(EffectSpec("joint_coupling", j), mixed).parameters[0].file_unit for j in (2, 3, 4)]
    assert coupled == ["mm/rad", "rad/mm", "1"]
    for name in ("encoder_eccentricity", "transmission_ripple", "joint_error_curve", "axis_runout"):
        with pytest.raises(InputError, match=f"{name} at joint 2, which slides, allowed: at joints that turn"):
            build(EffectSpec(name, 2), slider)
    assert "gear_ratio:2" in {b.label for b in hypotheses(Arm(slider, sigma=0.05), frozenset()).members}
    # those of all joints are in the model
    bent = hypotheses(HEAVY.with_effects(EffectSpec("joint_compliance")), frozenset()).members
    assert not [b.label for b in bent if b.label.startswith("joint_compliance")]


SCOPE = Scope(Arm([300.0, 200.0]), 2, np.zeros((3, 2)), Conditions(time=np.array([-0.5, 0.1234567, 0.5])))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((0.3, 0.1, 0.3, 9.0), [0.1, 0.3]),  # in order, each once, none that is not allowed
        (lambda scope: scope.conditions.time, [-0.5, 0.123457, 0.5]),  # as labels and files hold them
        (lambda scope: scope.arm.lengths / 1000.0 + scope.joint / 10.0, [0.4, 0.5]),
    ],
)
def test_values_are_listed_or_computed(values: object, expected: list[float]) -> None:
    assert Setting(-0.5, 0.5, values).scan(SCOPE) == expected  # type: ignore[arg-type]
    assert Setting(1, 3, whole=True).scan(SCOPE) == [1.0, 2.0, 3.0]
    assert Setting(1, 3, (0.0, 2.0, 2.5), whole=True).scan(SCOPE) == [2.0]


def test_steps_are_tried_between_rows_and_between_sessions() -> None:
    time, rows = np.linspace(-0.5, 0.5, 9), np.arange(18.0)[:, None] * np.ones(2)
    one, reads = (Scope(SCOPE.arm, 1, q, Conditions(time=time)).step_times() for q in (rows[:9], rows[:9] // 3.0))
    np.testing.assert_allclose(reads, time[[2, 5]] + 0.0625)  # not within the reads of a posture
    np.testing.assert_allclose(one, time[1:-2] + 0.0625)  # between rows, but for the first and the last
    scope = Scope(SCOPE.arm, 1, rows, Conditions(time=np.tile(time, 2), session=np.repeat([0.0, 1.0], 9)))
    both = scope.step_times()
    assert both[-1] == pytest.approx(0.55)
    assert {*both} - {*scope.step_times_within()} == {at for at in both if 0.5 < at < 0.6}  # the base's own are none
    assert max(both) == pytest.approx(1.1 + 0.5 - 0.1875)
    assert clock(0.5, 0) < 0.55 < clock(-0.5, 1)
