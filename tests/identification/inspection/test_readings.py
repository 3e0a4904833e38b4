"""Ways to read the columns: what was changed in data on purpose is found, and nothing is said of data as they are."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given

from identification import Arm, DHRow, InputError, Measurements, Model, chain_of, load_arm, load_measurements
from identification.arm import Machining
from identification.inspection.inspection import inspect
from identification.inspection.readings import Reading, data_warnings, parallel_joints, read_differently
from identification.instruments import PlanarDistance
from identification.kinematics.counting import Counting
from identification.kinematics.frames import from_angles, pose
from tests.identification.exponentials import drawing
from tests.identification.inspection.test_inspection import points
from tests.identification.kinematics.test_counting import countings

DATA = Path(__file__).parents[2] / "data"
PLANAR = Arm(np.array([612.0, 572.3, 115.7]))
Change = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def six_axis() -> tuple[Arm, Measurements]:
    arm = load_arm(DATA / "ur10/ur10.toml")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return arm, load_measurements(DATA / "ur10/series_A.csv", arm).rows(slice(None, None, 4))


@pytest.fixture(scope="module")
def planar() -> Measurements:
    return load_measurements(DATA / "ur10_planar/measurements.csv", 3)


def words(arm: Arm, data: Measurements, change: Change) -> tuple[str, ...]:
    better = read_differently(arm, replace(data, postures=change(data.postures))).better
    return () if better is None else better.words


MIRRORED = "two coordinates of the positions are swapped, or an axis points the other way"
BACK = "is counted from"
FROM_BASE = f"joint 2 {BACK} the base, not from link 1 (its angle: column - q1)"


CASES: list[tuple[Change, tuple[str, ...]]] = [
    (lambda q: q, ()),
    (lambda q: q * [1, -1, 1], ("joint 2 turns the other way",)),
    (lambda q: -q, (MIRRORED,)),
    (lambda q: q[:, [1, 0, 2]], ("columns of joints 1 and 2 are swapped",)),
    (lambda q: q[:, [0, 2, 1]] * [1, 1, -1], ("columns of joints 2 and 3 are swapped", "joint 2 turns the other way")),
    (lambda q: q - [0, np.pi, 0], ("joint 2 has another zero than the drawing: add 180 deg to it",)),
    (lambda q: q - [0, 0, np.pi / 2], ("joint 3 has another zero than the drawing: add 90 deg to it",)),
    (lambda q: q - [0, np.radians(20), 0], ("joint 2 has another zero than the drawing: add 20 deg to it",)),
    (lambda q: q.cumsum(1), (FROM_BASE, f"joint 3 {BACK} the base, not from link 2 (its angle: column - q1 - q2)")),
    (lambda q: np.column_stack([q[:, 0], q[:, 0] + q[:, 1], q[:, 2]]), (FROM_BASE,)),
    (
        lambda q: np.column_stack([q[:, :2], q[:, 1] + q[:, 2]]),
        (f"joint 3 {BACK} link 1, not from link 2 (its angle: column - q2)",),
    ),
]


@pytest.mark.parametrize(("change", "said"), CASES)
def test_a_planar_arm(planar: Measurements, change: Change, said: tuple[str, ...]) -> None:
    assert words(PLANAR, planar, change) == said


def test_six_axes(six_axis: tuple[Arm, Measurements]) -> None:
    """The reflector is on the last axis, so that nothing shows which way joint 6 turns."""
    for change, said in (
        (lambda q: q, ()),
        (lambda q: q * [-1, 1, -1, 1, 1, -1], ("joint 1 turns the other way", "joint 3 turns the other way")),
        (lambda q: q[:, [0, 1, 2, 4, 3, 5]], ("columns of joints 4 and 5 are swapped",)),
        (
            lambda q: q + np.outer(q[:, 1] + q[:, 2], np.eye(6)[3]),  # as of motors in the base
            (f"joint 4 {BACK} link 1, not from link 3 (its angle: column - q2 - q3)",),
        ),
    ):
        assert words(*six_axis, change) == said


def test_a_zero_of_any_angle_is_found_and_no_reversed_joints(six_axis: tuple[Arm, Measurements]) -> None:
    """To a tenth of a degree and what the arm itself is off by, 0.3 deg; a fit takes it up, so it is no misreading."""
    arm, data = six_axis
    better = read_differently(arm, replace(data, postures=data.postures + np.radians([0, 0, 63.0, 0, 0, 0]))).better
    assert (better.moved_zeros, better.signs, better.order) == (True, (1,) * 6, tuple(range(6)))
    assert 90.0 * better.quarters[2] % 360.0 == pytest.approx(297.0, abs=0.4)
    assert better.words == ("joint 3 has another zero than the drawing: add -63 deg to it",)


def test_two_reversed_joints_of_a_planar_arm_have_two_explanations(planar: Measurements) -> None:
    """Joints 1 and 3 reversed are joint 2 reversed in a mirror: conj(exp(i(a + b + c))) = exp(i(-a - b - c))."""
    found = read_differently(PLANAR, replace(planar, postures=planar.postures * [-1.0, 1.0, -1.0]))
    both = {found.better.words, *(reading.words for reading in found.alike)}
    mirrored = ("joint 2 turns the other way", MIRRORED)
    assert both == {mirrored, ("joint 1 turns the other way", "joint 3 turns the other way")}
    assert ", or, equally well, " in found.sentences[0]


@pytest.mark.parametrize("seed", range(4))
def test_three_faults_at_once_are_undone(planar: Measurements, seed: int) -> None:
    """A swap, a sign and a zero off by quarter turns, or a mirrored frame: what is left is the arm's own error."""
    generator = np.random.default_rng(seed)
    order, joint = generator.permutation(3)[:2], int(generator.integers(3))
    columns = planar.postures.copy()
    columns[:, order] = columns[:, order[::-1]]
    columns[:, joint] *= -1.0
    columns[:, 1 + seed % 2] += 0.5 * np.pi * generator.integers(4)
    mirror = [1.0, (-1.0) ** seed]
    found = read_differently(PLANAR, replace(planar, postures=columns, positions=planar.positions * mirror))
    assert found.better.rms < 1.0


def test_what_nothing_explains_is_not_said_to_be_found(planar: Measurements) -> None:
    """Three columns moved round and a sign: no pair of columns and no change of signs undoes that."""
    moved = replace(planar, postures=planar.postures[:, [2, 0, 1]] * [1, -1, 1] + [0.0, 0.9, 0.0])
    found = read_differently(PLANAR, moved)
    assert found.better.rms > 0.02 * PLANAR.reach
    (said,) = found.sentences
    assert said.startswith("no reading with a few other signs, ")
    assert " Closest: " in said


def test_a_mirrored_frame_in_space(six_axis: tuple[Arm, Measurements]) -> None:
    arm, data = six_axis
    found = read_differently(arm, replace(data, positions=data.positions * [1.0, -1.0, 1.0]))
    assert found.better.words == (MIRRORED,)  # with a base that may stand anywhere both are the same
    assert found.better.rms < 1.0 < 50.0 < found.written.rms


def test_nothing_is_said_of_arms_with_errors_as_they_are_built() -> None:
    generator = np.random.default_rng(11)
    for n in (2, 3, 4, 6):
        for _ in range(3):
            lengths = generator.uniform(100.0, 600.0, n)
            q = generator.uniform(-2.5, 2.5, (30, n))
            theta = np.cumsum(q + np.radians(generator.normal(0.0, 1.0, n)), axis=1)
            z = np.exp(1j * theta) @ (lengths + generator.normal(0.0, 2.0, n)) * np.exp(0.7j) + 500.0
            assert read_differently(Arm(lengths), Measurements(q, np.column_stack([z.real, z.imag]))).better is None


def test_a_wrist_whose_axes_meet_has_two_explanations() -> None:
    """Half a turn about axis 4 reverses axis 5, and comes out behind it as half a turn that the reflector takes."""
    a, alpha, d = (0, -400, 0, 0, 0, 0), (1, 0, 1, -1, 1, 0), (400, 0, 0, 500, 0, 90)
    rows = list(zip(map(float, a), (0.5 * np.pi * np.array(alpha)).tolist(), map(float, d), strict=True))
    generator = np.random.default_rng(1)
    q, noise = generator.uniform(-2.0, 2.0, (40, 6)), generator.normal(0.0, 0.01, (40, 3))  # more than rounding
    data = Measurements(q * [1, 1, 1, 1, -1, 1], points(q, np.array([60.0, 20.0, 40.0]), rows) + noise)
    arm, turned = Arm(chain_of([DHRow(*row) for row in rows])), data.postures + 0.5 * np.pi * np.eye(6)[1]
    both = "joint 5 turns the other way, or, equally well, joint 4 has another zero than the drawing: add 180 deg to it"
    assert both in read_differently(arm, data).sentences[0]
    assert ", and joint 4 has" in read_differently(arm, replace(data, postures=turned)).sentences[0]  # beside joint 2


def test_a_reading_that_leaves_far_less_is_found_behind_one_that_would_do() -> None:
    """A forearm that keeps its angle when joint 2 turns, and four signs. Other faults leave 1 % of the reach, too: each
    joint turns by itself, joint 3 hardly. With a file that says these a fit is implausible, and check finds the right
    ones."""
    a, alpha, d = (312, 1075, 225, 0, 0, 0), (-1, 0, -1, 1, -1, 0), (0, 0, 0, 1280, 0, 215)
    rows = list(zip(map(float, a), (0.5 * np.pi * np.array(alpha)).tolist(), map(float, d), strict=True))
    true = Counting((1, 1, -1, -1, -1, -1), (0, 0, 2, 0, 0, 0), (0.0,) * 6)
    middle, ranges = np.radians([25, -72, 60, -81, -27, 115]), np.radians([9, 94, 4, 225, 74, 470])
    columns = np.concatenate([middle + np.outer(np.linspace(-0.5, 0.5, 10), x) for x in np.diag(ranges)])
    seen = points(true.joints(columns), np.array([200.0, 50.0, 200.0]), rows)
    seen = seen + np.random.default_rng(2).normal(0.0, 0.05, seen.shape)
    arm = Arm(chain_of([DHRow(*row) for row in rows]))
    assert read_differently(arm, Measurements(columns, seen)).counting == true
    wrong = replace(arm, counting=replace(true, sign=(-1, -1, 1, 1, 1, 1)))
    found = inspect(wrong, Measurements(wrong.counting.joints(columns), seen)).data
    assert found["rms_drawing_mm"] < 0.02 * arm.reach
    assert found["better_reading"]["arm_file"] == true.toml


def test_what_makes_a_drawing_only_a_little_better_is_not_read_into_it() -> None:
    """A point 2 mm beside the last axis, which turns back what joint 4 turns: its sign hardly shows, and of an arm that
    is some 2 mm off its drawing the wrong one leaves less."""
    a, alpha, d = (0, -612, -572, 0, 0, 0), (1, 0, 0, 1, -1, 0), (127, 0, 0, 164, 116, 92)
    rows = np.column_stack([a, 0.5 * np.pi * np.array(alpha), d])
    arm, generator = Arm(chain_of([DHRow(*row) for row in rows])), np.random.default_rng(3)
    q = generator.uniform(-1.2, 1.2, (40, 6))
    q[:, 3] = generator.uniform(0.5, 3.0, 40)
    q[:, 5] = 3.2 - q[:, 3] + 0.1 * generator.normal(size=40)
    seen = points(q, np.array([2.0, 0.0, 90.0]), (rows + generator.normal(size=(6, 3)) * [2.0, 1e-3, 2.0]).tolist())
    right, wrong = (read_differently(arm, Measurements(q * [1, 1, 1, 1, 1, s], seen)).written.rms for s in (1, -1))
    assert right > 1.4 * wrong
    found = read_differently(arm, Measurements(q * [1, 1, -1, 1, 1, 1], seen)).better
    assert found.words == ("joint 3 turns the other way",)


def test_what_a_fit_asks_check_asks() -> None:
    """No other reading is better, and no machining is off by that much."""
    generator = np.random.default_rng(8)
    q = generator.uniform(-2.0, 2.0, (60, 3))
    made = [(1.2, QUARTER + 0.006, 350.0), (-401.2, 0.006, 1.2), (-298.8, QUARTER - 0.006, 1.2)]
    seen = points(q, np.array([60.0, 20.0, 40.0]), made) + generator.normal(0.0, 0.01, (60, 3))
    (asked,) = inspect(replace(ARM, machining=Machining(0.1, np.radians(0.05))), Measurements(q, seen)).problems
    assert asked.startswith("the arm is farther from its drawing than [machining] says (0.1 mm and 0.05 deg); the fit ")
    assert asked.endswith(" times that; are units, order and signs of joints and coordinates right?")


# -- a reading in words, and what it makes of columns ------------------------------------------------------------------
SWAPPED = Reading((1, 0, 2), (1, 1, -1), (0, 3, 0), mirrored=True, rms=0.9)
REVERSED = Reading((0, 1, 2), (-1, 1, 1), (0, 0, 0), rms=0.91)


def test_columns_are_read_and_named() -> None:
    assert SWAPPED.changes == 4
    assert SWAPPED.words == (
        "columns of joints 1 and 2 are swapped",
        "joint 3 turns the other way",
        "joint 2 has another zero than the drawing: add -90 deg to it",
        MIRRORED,
    )
    assert np.allclose(SWAPPED.postures(np.array([[0.1, 0.2, 0.3]])), [[0.2, 0.1 + 1.5 * np.pi, -0.3]])


@given(countings(joints=4), countings(joints=4))
def test_how_a_controller_counts(before: Counting, true: Counting) -> None:
    """Columns of one controller, read as the arm file says of another: the reading that makes them the joints' says the
    first, whatever the file said, where signs and sums of the joints so far say it."""
    q = np.random.default_rng(3).uniform(-1.0, 1.0, (6, 4))
    read = before.joints(true.columns(q))
    # read = matrix q + zero, to be signs * sums and zeros
    matrix = before.inverse @ true.matrix
    signs = np.sign(np.diag(matrix)).astype(int)
    assume(np.all(np.abs(np.diag(matrix)) == 1.0))
    sums = signs[:, None] * matrix
    zeros = -signs * (before.inverse @ (np.array(true.zero) - before.zero))
    rows = tuple(tuple(int(x) for x in row) for row in sums)
    reading = Reading((0, 1, 2, 3), tuple(signs.tolist()), tuple((zeros / (0.5 * np.pi)).tolist()), sums=rows)
    np.testing.assert_allclose(reading.postures(read), q, atol=1e-9)
    found = reading.counting(before)
    assert found is not None
    turns = (found.columns(q) - true.columns(q)) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns[0]) * np.ones((6, 1)), atol=1e-9)  # zeros by the shorter way


def test_what_no_arm_file_says() -> None:
    usual = Counting.usual(3)
    assert SWAPPED.counting(usual) is None
    found = REVERSED.counting(usual)
    assert found is not None
    assert found.toml == "[joints]\nsign = [-1, 1, 1]"
    assert Reading((0, 1, 2), (1, 1, 1), (0, 0, 0), sums=((1, 0, 0), (0, 1, 0), (1, 1, 1))).counting(usual) is None
    assert replace(REVERSED, mirrored=True).counting(usual) is None  # no counting of joints mirrors the frame


TURNED = [DHRow(300.0, np.pi, 0.0), DHRow(200.0, np.pi / 2.0, 0.0), DHRow(100.0, 0.0, 0.0), DHRow(100.0, 0.0, 0.0)]
SLIDE = DHRow(0.0, 0.0, 0.0, type="prismatic", limits=(0.0, 300.0))


@pytest.mark.parametrize(
    ("arm", "runs"),
    [
        (Arm(drawing()), [(1, (1, 1, 1))]),  # of an elbow arm joints two to four
        (Arm([300.0, 200.0, 100.0]), [(0, (1, 1, 1))]),
        (Arm([300.0]), []),
        (Arm(chain_of(TURNED)), [(0, (1, -1)), (2, (1, 1))]),  # half a turn behind joint 1, a quarter behind joint 2
        (Arm(chain_of([DHRow(300.0, 0.0, 0.0), DHRow(200.0, 0.0, 0.0), SLIDE, DHRow(9.0, 0.0, 0.0)])), [(0, (1, 1))]),
    ],
)
def test_runs_of_parallel_axes_counted_by_hand(arm: Arm, runs: list[tuple[int, tuple[int, ...]]]) -> None:
    assert parallel_joints(arm.chain) == runs


# -- doubts before a fit -----------------------------------------------------------------------------------------------
QUARTER = np.pi / 2.0
ROWS = [DHRow(0.0, QUARTER, 350.0), DHRow(-400.0, 0.0, 0.0), DHRow(-300.0, QUARTER, 0.0, limits=(-2.0, 2.0))]
CHAIN = chain_of(ROWS)
INCH = 25.4
ARM = Arm(CHAIN)
TOOLS = {"left": np.array([90.0, 20.0, 50.0]), "right": np.array([-80.0, 10.0, 40.0])}


def measured(rows: int = 30) -> Measurements:
    """Both points in turn, of an arm that stands elsewhere."""
    generator = np.random.default_rng(3)
    postures = generator.uniform(-2.0, 2.0, (rows, 3))
    data = Measurements(postures, np.zeros((rows, 3)), marker=np.array(list(TOOLS))[np.arange(rows) % 2])
    model = Model(Arm(replace(CHAIN, base=pose((2000.0, -500.0, 700.0), from_angles((0.1, -0.4, 2.0))), tools=TOOLS)))
    return replace(data, positions=model.position(postures, generator.normal(0.0, 1.0 / model.scales), data.conditions))


def test_good_data_are_not_doubted() -> None:
    assert data_warnings(measured(), ARM) == []
    for beside, said in ((0.01, []), ([0.8, 0.0, 0.8], ["joints 1, 3: are the units right?"])):
        commanded = replace(measured(), commanded=measured().postures + beside)
        assert [sentence[-len(said[0]) :] for sentence in data_warnings(commanded, ARM)] == said
    assert data_warnings(measured(8), ARM) == []  # too few to tell
    for rows, said in ((np.arange(30), []), (np.arange(30) % 29, ["row 30 has the number of row 1 in the column"])):
        assert [each[: len(said[0])] for each in data_warnings(replace(measured(), repeats=rows), ARM)] == said


def ratio(said: str) -> float:
    """The measured factor that a sentence states."""
    return float(said.partition(" times ")[0].rpartition(" ")[2])


UNITS = {"centimetres": 10.0, "inches": INCH, "decimetres": 100.0, "feet": 304.8, "metres": 1000.0}


@pytest.mark.parametrize(("unit", "factor"), [*UNITS.items(), ("", 14.0), ("", 10.4), ("", 0.3), ("", 1.0 / 27.0)])
def test_a_unit_is_named_where_the_measured_factor_fits_it(unit: str, factor: float) -> None:
    """Positions in another unit, and an arm file in another unit: either makes them agree, and which of them is wrong
    nothing tells. Errors of 1 mm in some 800 leave the factor within 0.5 %; 10.4 is 4 % from centimetres and 27 is 6 %
    from inches."""
    for arm, good in ((ARM, measured()), (FLAT, simulated(3.0))):
        (small,) = data_warnings(replace(good, positions=good.positions / factor), arm)
        (large,) = data_warnings(replace(good, positions=(good.positions + 7e3) * factor), arm)  # the base elsewhere
        for said, whose, larger in (
            (small, "positions", "arm file"),
            (large, "lengths of the arm file", "measurements"),
        ):
            assert ratio(said) == pytest.approx(max(factor, 1.0 / factor), rel=0.005)
            assert (f"as if the {whose} are in {unit}" if unit else "the factor of no unit") in said
            assert factor < 1.0 or f"the lengths of the {larger} are " in said


def test_rows_of_swapped_markers_and_lost_beams_are_named() -> None:
    data = measured(60)
    markers, far, farther = data.marker.copy(), data.positions.copy(), data.positions.copy()
    markers[[10, 11]] = markers[[11, 10]]
    far[20] += (0.0, 400.0, 0.0)
    farther[20] += (0.0, 5000.0, 0.0)
    for rows, start, cause in (
        (replace(data, marker=markers), "rows 11, 12: up to ", ""),
        (replace(data, positions=far), "row 21: up to ", "a lost beam"),
        (replace(data, positions=farther), "row 21: up to ", "a lost beam"),
    ):
        (said,) = inspect(ARM, rows).problems
        assert said.startswith(start)
        assert cause in said


# -- units of planar measurements --------------------------------------------------------------------------------------
FLAT = Arm([260.0, 180.0])


def simulated(span: float, *, angles: float = 1.0, lengths: float = 1.0) -> Measurements:
    """Measurements of `FLAT` whose numbers were multiplied by factors, as a wrong unit does."""
    generator = np.random.default_rng(2)
    q = generator.uniform(-span, span, (30, 2))
    theta = np.cumsum(q, axis=1)
    tip = np.column_stack([np.cos(theta) @ FLAT.lengths, np.sin(theta) @ FLAT.lengths])
    return Measurements(q * angles, (tip + generator.normal(0.0, 1.0, tip.shape)) * lengths)


def certain(data: Measurements, arm: Arm) -> str:
    """What is said of units that are beyond doubt."""
    readings = read_differently(arm, data, search=False)
    assert readings.sentences == data_warnings(data, arm)
    return readings.sentences[0] if readings.certain else ""


def test_angles_in_another_unit() -> None:
    for arm, good in ((FLAT, simulated(3.0)), (ARM, measured(20))):
        for unit, factor in (
            ("degrees (name the columns q1_deg..", 180.0),
            ("radians (name the columns q1_rad..", 3.14),
        ):
            wrong = replace(good, postures=good.postures * (factor / np.pi if factor > 4 else np.pi / 180.0))
            assert certain(wrong, arm).startswith(f"it looks as if the joint angles are in {unit})")
    gantry = Arm(chain_of([replace(SLIDE, alpha=QUARTER), replace(SLIDE, alpha=-QUARTER), DHRow(200.0, 0.0, 0.0)]))
    q = np.random.default_rng(4).uniform(0.0, 300.0, (30, 3)) * [1.0, 1.0, 0.01]
    slid = Measurements(q, np.c_[200.0 * np.cos(q[:, 2]), 200.0 * np.sin(q[:, 2]) - q[:, 1], q[:, 0]])
    for arm, rows, factors, said in (
        (ARM, measured(20), [1.0, np.pi / 180.0, 1.0], "joint 2 is in radians (name its column q2_rad)"),
        (gantry, slid, [1e-3, 1e-3, 1.0], "the sliding joints are in metres (name the columns q1_m..)"),
        (gantry, slid, [1e3, 1.0, 1.0], "joint 1 is in millimetres (name its column q1_mm)"),
    ):
        assert certain(rows, arm) == ""
        assert certain(replace(rows, postures=rows.postures * factors), arm).startswith(f"it looks as if {said}")
    whole_turns = simulated(3.0)  # an axis that counts on
    assert data_warnings(replace(whole_turns, postures=whole_turns.postures + 20.0 * np.pi), FLAT) == []


def test_there_is_no_doubt_where_the_drawing_explains_the_rows_in_other_units() -> None:
    """Errors are 1 mm in each coordinate: 1.41 mm RMS. Metres of an arm whose second link is half as long: suspected,
    since nearer to the drawing, but not certain."""
    for angles, lengths in ((np.pi / 180.0, 1.0), (1.0, 1e-3), (np.pi / 180.0, 1e-3), (1.0, INCH)):
        rms = certain(simulated(3.0, angles=angles, lengths=lengths), FLAT).partition(" the drawing then leaves ")[2]
        assert float(rms.partition(" mm")[0]) == pytest.approx(1.41, rel=0.2)
    metres = simulated(3.0, lengths=1e-3)
    q = metres.postures
    z = 260.0 * np.exp(1j * q[:, 0]) + 90.0 * np.exp(1j * q.sum(axis=1))
    other = replace(metres, positions=1e-3 * np.column_stack([z.real, z.imag]))
    assert len(data_warnings(other, FLAT)) == 1
    for data, arm in ((other, FLAT), (simulated(3.0), FLAT), (measured(), ARM)):
        assert certain(data, arm) == ""


def test_another_number_of_links() -> None:
    for look in (lambda rows, arm: inspect(arm, rows), data_warnings):
        with pytest.raises(InputError, match="found 2 joints, allowed: 3"):
            look(simulated(1.0), Arm([1.0, 1.0, 1.0]))


def test_rows_that_are_wild_hide_no_unit() -> None:
    """Metres in `_mm` columns, and three of twenty rows anywhere within this many."""
    wild = 5e3
    planar, center = simulated(3.0).rows(slice(20)), (400.0, 100.0)
    bar = replace(FLAT, chain=replace(FLAT.chain, instrument=PlanarDistance((("1", center),))))
    lengths = replace(planar, positions=np.linalg.norm(planar.positions - center, axis=1)[:, None])
    for arm, good in ((ARM, measured(20)), (FLAT, planar), (bar, lengths)):
        lost = np.abs(np.random.default_rng(5).uniform(-wild, wild, (3, good.dimension)))
        metres = good.positions / 1000.0
        metres[[2, 9, 16]] = lost
        (said,) = read_differently(arm, replace(good, positions=metres), search=False).sentences
        assert "as if the positions are in metres, whose columns end in _m" in said
        assert ratio(said) == pytest.approx(1000.0, rel=0.01)
