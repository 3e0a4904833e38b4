"""Data sets: sizes, numbers and places of what is hidden, what the arm file is wrong about, and noise, each against an
independent oracle. Sizes are those of the program's model at the true values, off its own Jacobian by least squares.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from doe.studies.blind import cells, simulator
from doe.studies.blind.cells import (
    CELLS,
    COUNTS,
    EXPLAINED,
    PHYSICS,
    SPACE_OUTSIDE,
    DataSet,
    data_set,
    library_columns,
    physics_effect,
    place_of,
    random_effect,
    random_truth,
)
from doe.studies.blind.simulator import (
    RowConditions,
    TrueArm,
    angle_error,
    base_jacobian,
    column,
    off,
    position,
    relays,
    session,
)
from identification import Arm, Array, Calibration, EffectSpec, Gravity, Model, fitted_arm
from identification.effects import build_all
from identification.model.placed import practical

NUMBERS, IN_SPACE = range(900, 903), range(900, 903)
GRAVITY = {"joint_compliance", "gravity_backlash", "link_bending"}


def left_over(columns: Array, moved: Array) -> Array:
    """What a fit by least squares of the columns (N, p) leaves of (N,)."""
    length = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(length > 0.0, length, 1.0)
    return moved - scaled @ np.linalg.lstsq(scaled, moved, rcond=1e-10)[0]


def sizes(data: DataSet) -> list[float]:
    """Of each hidden effect, the others left out: RSS off the geometry in units of sigma."""
    arm, rows = practical(data.arm, data.measurements), data.measurements
    base, found = Model(arm), []
    geometry = {name: value for name, value in data.values.items() if name in base.names}
    at, jacobian = base.linearize(rows.postures, base.parameters.vector(geometry), rows.conditions)
    for spec in data.specs:
        model = Model(arm.with_effects(spec))
        values = {name: value for name, value in data.values.items() if name in model.names}
        moved = model.position(rows.postures, model.parameters.vector(values), rows.conditions) - at
        found.append(float(np.linalg.norm(left_over(jacobian.reshape(at.size, -1), moved.ravel())) / data.arm.sigma))
    return found


@pytest.mark.parametrize(
    ("cell", "limits", "counts"),
    [
        ("many small effects, m=100", (1.5, 12.0), (14, 22)),
        ("six to nine effects, m=100", (5.0, 40.0), (6, 9)),
        ("space, many small effects, m=50", (1.5, 12.0), (14, 22)),
        ("space, lambda 8, m=60", (8.0, 8.0), (1, 1)),
    ],
)
def test_effects_are_of_the_sizes_and_number_asked_for(
    cell: str, limits: tuple[float, float], counts: tuple[int, int]
) -> None:
    """Every size within the limits, evenly on a logarithmic scale: the mean of n is off by 3 of its deviations once in
    370 cases. Effects of an arm's true size turn their own columns a little: 2 % of room; in space, where the drawing
    is 2 mrad and 0.5 mm off, and the base is not known to it, 7 %."""
    logs, numbers, space = [], set(), cell.startswith("space")
    for number in IN_SPACE[-1:] if "many" in cell and space else NUMBERS:
        data = data_set(cell, number)
        numbers.add(len(data.effects))
        assert len(set(data.effects)) == len(data.specs) == len(data.effects)
        assert sum(key.partition(":")[0] in GRAVITY for key in data.effects) <= 1
        if "small" in cell:
            joints = {int(key.partition(":")[2]) for key in data.effects if ":" in key}
            assert joints == set(range(1, data.arm.links + 1))
        logs += np.log(sizes(data)).tolist()
    (low, high), room = np.log(limits), 0.07 if space else 0.02
    assert low - room <= min(logs) <= max(logs) <= high + room
    spread = 3.0 * (high - low) / np.sqrt(12.0 * len(logs))
    assert np.mean(logs) == pytest.approx((low + high) / 2.0, abs=max(spread, room))
    assert counts[0] <= min(numbers) <= max(numbers) <= counts[1]
    assert space or len(numbers) > 1


def library_of(truth: TrueArm) -> list[EffectSpec]:
    """Effects that look most like others: of each joint and of the whole arm."""
    names = ("encoder_eccentricity", "encoder_second_harmonic", "gear_ratio", "joint_coupling", "backlash")
    specs = [EffectSpec(name, j) for name in names for j in range(1 + (name == "joint_coupling"), truth.n + 1)]
    for j in range(1, truth.n + 1):
        width = np.degrees(truth.upper[j - 1] - truth.lower[j - 1])
        specs += [EffectSpec("transmission_ripple", j, {"k": 3.0}), EffectSpec("joint_step", j, {"at": 0.0})]
        specs += [EffectSpec("joint_hysteresis", j, {"width_deg": 0.2 * width}), EffectSpec("gravity_backlash", j)]
    whole = ("base_offset", "base_drift", "base_rotation_drift", "axes_skew", "thermal_growth", "link_bending")
    specs += [EffectSpec(name) for name in whole] + [EffectSpec("thermal_transient", None, {"tau": 0.1})]
    return [*specs, EffectSpec("base_step", None, {"at": 0.0, "side": 1.0}), EffectSpec("joint_compliance")]


@pytest.mark.parametrize("name", PHYSICS)
def test_what_is_outside_the_library_is_mostly_outside_it(name: str) -> None:
    """Of the size asked for, and none of the program's own effects explains more than half of its square."""
    rng = np.random.default_rng([20261130, PHYSICS.index(name)])
    drawn, zero = random_truth(rng, 3), np.zeros(3)
    rest = {name: getattr(drawn, name) for name in ("masses", "payload", "lower", "upper", "sigma")}
    truth = TrueArm.planar(drawn.lengths, zero, zero, **rest)
    run = simulator.session(truth, rng.uniform(truth.lower, truth.upper, (80, 3)), rng)
    if name == "payload_swap":
        truth = replace(truth, modelled=[("joint_compliance", None, {"c": np.full(3, 1e-5)})])
    effect = physics_effect(truth, run, name, 20.0, rng)
    gravity = Gravity(np.array([0.0, -simulator.G]), truth.masses, np.full(3, truth.center), truth.payload)
    model = Model(Arm(truth.lengths, gravity=gravity, effects=tuple(library_of(truth))))
    conditions = simulator.recorded(truth, run, np.zeros((80, 2))).conditions
    jacobian = model.jacobian(run.q, np.zeros(len(model.names)), conditions).reshape(160, -1)
    owner = np.array([name.rpartition(".")[0] for name in model.names])
    base = jacobian[:, owner == ""]
    hidden = simulator.position(replace(truth, effects=[effect]), run) - simulator.position(truth, run)
    moved = left_over(base, hidden.ravel())
    assert np.linalg.norm(moved) == pytest.approx(20.0 * truth.sigma, rel=0.02)  # to second order in the effect
    for one in sorted({*owner} - {""}):
        share = 1.0 - np.sum(left_over(np.hstack([base, jacobian[:, owner == one]]), moved) ** 2) / (moved @ moved)
        assert share <= EXPLAINED + 0.02, one
    assert len({*owner}) > 30
    assert (place_of(effect) is None) == (name == "gripper_play")
    assert effect[1] is None or f"joint:{effect[1]}" in str(place_of(effect)).split(" or ")


def test_loops_and_slips_by_hand() -> None:
    """A relay about 0 with thresholds of 1 rad, at 0.5 and 1.5 rad two more: what was passed last counts between them,
    and nothing outside. Short moves stop short of where they go, long ones slip past."""
    angles = np.array([2.0, 0.7, 0.2, -0.7, 0.2, -2.0, 0.2])
    # thresholds 0.5: up, up (out), up inside, down (out), down inside ..; 1.0: up inside until -2; 1.5 as well
    np.testing.assert_allclose(relays(angles, 0.0, 1.0), np.array([0.0, 2.0, 3.0, 2.0, 1.0, 0.0, -3.0]) / 3.0)
    q, s = np.array([[0.0], [0.1], [3.1]]), np.ones((3, 1))
    run = RowConditions(q, np.zeros(3), np.zeros(3), s, np.zeros(3), np.zeros(3, dtype=int))
    slip = angle_error(run, "stick_slip", 1, {"b": 2e-3, "width": 1.0}, np.zeros((3, 1)))
    np.testing.assert_allclose(slip, 2e-3 * (1.0 - 2.0 * np.array([0.0, np.exp(-0.1), np.exp(-3.0)])))


def test_reads_of_a_posture_share_its_error() -> None:
    """Variance within postures sigma^2, of their means 4 sigma^2 + sigma^2 / 3, each within 3 standard errors."""
    within, means = [], []
    for number in NUMBERS:
        data = data_set("three reads, none", number)
        rows, arm = data.measurements, replace(data.arm, calibration=Calibration(data.values))
        left = (rows.positions - Model(arm).position(rows.postures, None, rows.conditions)).reshape(-1, 3, 2)
        left = left / data.arm.sigma
        assert np.array_equal(rows.posture_numbers, np.repeat(np.arange(60), 3))
        within.append(left - left.mean(axis=1, keepdims=True))
        means.append(left.mean(axis=1))
        assert data.holdout is not None
        assert len(set(data.holdout.posture_numbers)) == len(data.holdout)
        scatter = np.mean((data.holdout.positions - data.exact) ** 2) / data.arm.sigma**2
        assert scatter == pytest.approx(5.0, abs=3.0 * 5.0 * np.sqrt(2.0 / 400))
    count = 2 * 60 * len(NUMBERS)
    assert np.sum(np.square(within)) / (2 * count) == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / (2 * count)))
    between = 4.0 + 1.0 / 3.0
    assert np.mean(np.square(means)) == pytest.approx(between, abs=3.0 * between * np.sqrt(2.0 / count))


def test_noise_of_other_kinds() -> None:
    """Student's t with variance 1, by its quantiles: shares of 40,000 within 3 standard errors. A display shows
    multiples of sigma; the rounding adds a twelfth to the variance (W. F. Sheppard, 1898)."""
    rng = np.random.default_rng(20261131)
    truth = random_truth(rng, 3)
    run = session(truth, rng.uniform(truth.lower, truth.upper, (20_000, 3)), rng)
    error = np.abs(simulator.noise(truth, run, rng, "t3").ravel()) / truth.sigma
    for beyond in (0.5, 0.05, 0.005):
        limit = student.ppf(1.0 - beyond / 2.0, 3) / np.sqrt(3.0)
        assert np.mean(error > limit) == pytest.approx(beyond, abs=3.0 * np.sqrt(beyond * (1.0 - beyond) / 40_000))
    error = simulator.noise(truth, run, rng, "quantized")
    shown = simulator.recorded(truth, run, error).positions / truth.sigma
    np.testing.assert_allclose(shown, np.round(shown), atol=1e-6)
    variance = np.mean((error / truth.sigma) ** 2)
    assert variance == pytest.approx(13.0 / 12.0, abs=3.0 * 13.0 / 12.0 * np.sqrt(2.0 / 40_000))


def test_a_random_walk_is_of_one_sigma_about_its_mean() -> None:
    """The mean square of sets of 50 rows about their means: 1 of the walk, and white noise of 49 / 50."""
    rng = np.random.default_rng(20261132)
    truth = random_truth(rng, 2)
    run = simulator.session(truth, rng.uniform(truth.lower, truth.upper, (50, 2)), rng)
    errors = np.array([simulator.noise(truth, run, rng, "walk") for _ in range(2_000)]) / truth.sigma
    squares = np.var(errors, axis=1).ravel()
    assert np.mean(squares) == pytest.approx(1.0 + 49.0 / 50.0, abs=3.0 * np.std(squares) / np.sqrt(len(squares)))
    data = data_set("none, random walk", 900)
    assert (data.outside, data.place, data.effects, data.holdout) == ("walk", "time", (), None)


# -- in space ----------------------------------------------------------------------------------------------------------


def test_every_hidden_effect_is_one_of_the_library() -> None:
    """With the parameters that are said to be true; one in each cell, none outside the library, some of each family."""
    others = set(PHYSICS) - {"two_warm_ups"}  # drawn by the same lines, which takes time
    for cell, spec in CELLS.items():
        if not spec.space or spec.physics in others:
            continue
        data = data_set(cell, 901)
        effects = build_all(data.specs, data.arm.chain)
        assert sorted(effect.key for effect in effects) == sorted(data.effects)
        assert len({*data.effects}) == len(effects)
        expected = 0 if spec.lam is None or spec.outside else spec.effects
        low, high = COUNTS[spec.many] if spec.many else (expected, expected)
        assert low <= len(effects) <= high
        assert len({effect.family for effect in effects}) == len(effects) or spec.many
        assert (data.place is not None) == (data.outside is not None) == (spec.outside or bool(spec.physics))
        assert spec.physics in ("", data.outside)
        assert {p.name for effect in effects for p in effect.parameters} >= set(data.values)


def test_true_values_have_the_names_of_the_library() -> None:
    """Axes by their letters, joints by their numbers; what is no amplitude, as when a step happens, is a setting."""
    step = {"x": 0.1, "y": -0.3, "at": 0.2}
    assert cells.numbered({"v": np.array([1.0, 2.0, 3.0])}) == {"vx": 1.0, "vy": 2.0, "vz": 3.0}
    assert cells.numbered({"c": np.array([4.0, 5.0])}) == {"c1": 4.0, "c2": 5.0}
    assert cells.numbered(step) == {"x": 0.1, "y": -0.3}
    assert cells.settings("base_step", step) == {"at": 0.2, "side": 1.0}


@pytest.mark.parametrize(
    ("number", "names"), [(900, SPACE_OUTSIDE), (901, SPACE_OUTSIDE), (1, ("cross_talk",)), (1, ("warm_offset",))]
)
def test_what_is_outside_the_library_is_of_the_size_asked_for_in_space(number: int, names: tuple[str, ...]) -> None:
    """Off the geometry and all that the simulator draws from the library lambda sigma long."""
    rng = np.random.default_rng(number)
    truth = cells.truth_of(cells.CellSpec(rows=(60,), space=True), rng)
    run = session(truth, rng.uniform(truth.lower, truth.upper, (60, truth.n)), rng)
    library = library_columns(truth, run)
    effect = random_effect(names, truth, run, 10.0, rng, library)
    step = position(replace(truth, effects=[effect]), run) - position(truth, run)
    size = np.linalg.norm(left_over(library, step.ravel()))
    assert size == pytest.approx(10.0 * truth.sigma, rel=1e-2)  # of second order the rest
    assert np.linalg.norm(left_over(base_jacobian(truth, run), step.ravel())) >= size
    assert effect[0] in names
    inside = column(truth, run, ("encoder_eccentricity", 3, {"a": 0.3, "b": -0.4}))
    assert np.linalg.norm(off(library, inside)) < 1e-6 * np.linalg.norm(inside)


def test_outliers_are_15_sigma_away() -> None:
    """Beside the same arm without them, which is the true model fitted to the other rows."""
    data = data_set("space, three outliers, lambda 8", 900)
    rows, model = data.measurements, Model(fitted_arm(data.arm, data.measurements, data.specs, data.wrong_rows))
    missed = np.linalg.norm(rows.positions - model.position(rows.postures, model.values, rows.conditions), axis=1)
    wrong = np.flatnonzero(missed > 10.0 * data.arm.sigma) + 1
    assert (tuple(wrong.tolist()), len(wrong)) == (data.wrong_rows, 3)
    assert missed[wrong - 1] / data.arm.sigma == pytest.approx(15.0, abs=5.0)  # noise of 3 coordinates, and its share
