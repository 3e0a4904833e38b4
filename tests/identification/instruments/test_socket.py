"""A ball seated in cups: calibration without a tracker, judged by cups that the fit has not seen.

Arms are products of exponentials; postures are led to the cups by differences, with the noise of each seating.
"""

from dataclasses import replace
from functools import cache
from itertools import combinations

import casadi as ca
import numpy as np
import pytest

from identification import Arm, Array, Identification, InputError, Measurements, Status, diagnose, estimate, spectrum
from identification.estimation.problem import Problem
from identification.gap.fit import fitted_arm
from identification.inspection import readings
from identification.inspection.inspection import inspect
from identification.inspection.readings import read_differently
from identification.instruments import Socket
from identification.kinematics.chain import DHRow, chain_of
from identification.measurements import Conditions
from identification.model import Model
from identification.model.placed import of_positions, placed_model, practical, with_sessions
from tests.identification.exponentials import HALF, SEVEN, TABLE, Exponentials, drawing, seated

NOISE = 0.05  # [mm] of each coordinate of a seating
CUPS = {
    "A": [450.0, -200.0, 100.0],
    "B": [500.0, 250.0, 150.0],
    "C": [200.0, 450.0, 350.0],
    "D": [350.0, -350.0, 400.0],
}
UNSEEN = {"E": [550.0, 0.0, 250.0], "F": [250.0, -450.0, 200.0], "G": [400.0, 300.0, 350.0]}
SEEDS = 2
ONE_BAR = (("A", "B"),)


def apart(cups: dict[str, list[float]], first: str, second: str) -> float:
    return float(np.linalg.norm(np.subtract(cups[first], cups[second])))


def rows(
    truth: Exponentials,
    cups: dict[str, list[float]],
    each: int,
    noise: float,
    generator: np.random.Generator,
    one_by_one: bool = False,
) -> Measurements:
    """As many orientations of each cup, in random order or one cup after the other."""
    order = np.repeat([*cups], each)
    order = order if one_by_one else generator.permutation(order)
    q = seated(truth, np.array([cups[name] for name in order]), noise, generator)
    return Measurements(q, np.zeros((len(q), 3)), marker=order)


@cache
def fitted(
    table: tuple[tuple[float, float, float], ...], seed: int, known: tuple[tuple[str, str], ...]
) -> tuple[Exponentials, Identification]:
    """60 rows in four cups, with distances between some."""
    generator = np.random.default_rng(seed)
    truth = Exponentials(generator, table=table)
    instrument = Socket(distances=tuple((a, b, apart(CUPS, a, b)) for a, b in known))
    arm = Arm(replace(drawing(table), instrument=instrument), sigma=NOISE)
    data = rows(truth, CUPS, 15, NOISE, generator)
    return truth, estimate(Model(with_sessions(arm, data)), data)


def unseen_distances(truth: Exponentials, fit: Identification, seed: int) -> tuple[Array, Array]:
    """(k,) by how much distances between cups that the fit has not seen are off [mm], and the deviations it says."""
    data = rows(truth, UNSEEN, 5, 0.0, np.random.default_rng(1000 + seed))
    model = of_positions(fit.model)
    chosen = [fit.names.index(name) for name in model.names]
    points, slopes = model.linearize(data.postures, fit.parameters[chosen])
    covariance, errors, deviations = fit.covariance[np.ix_(chosen, chosen)], [], []
    for a, b in combinations(UNSEEN, 2):
        one, other = (data.marker == name for name in (a, b))
        across = points[one].mean(axis=0) - points[other].mean(axis=0)
        slope = across / np.linalg.norm(across) @ (slopes[one].mean(axis=0) - slopes[other].mean(axis=0))
        errors.append(np.linalg.norm(across) - apart(UNSEEN, a, b))
        deviations.append(np.sqrt(slope @ covariance @ slope))
    return np.array(errors), np.array(deviations)


@pytest.mark.parametrize(
    ("table", "known"), [(TABLE, ONE_BAR), (SEVEN, (*ONE_BAR, ("C", "D")))], ids=["6R, one bar", "7R, two bars"]
)
def test_distances_between_unseen_cups(
    table: tuple[tuple[float, float, float], ...], known: tuple[tuple[str, str], ...]
) -> None:
    """To twice the noise of a seating; the deviations that the fit says hold them, as standardized ones of some 3 to 6
    independent errors (chi2 below 20 of 6: p = .003)."""
    errors, deviations = zip(
        *(unseen_distances(*fitted(table, seed, known), seed) for seed in range(SEEDS)), strict=True
    )
    assert np.sqrt(np.mean(np.square(errors))) < 2.0 * NOISE
    assert np.sum(np.square(np.ravel(errors) / np.ravel(deviations))) < 20.0


@pytest.mark.parametrize("table", [TABLE, SEVEN])
def test_radians_of_an_arm_that_then_hardly_moves(table: tuple[tuple[float, float, float], ...]) -> None:
    """Read as degrees they leave any point where it is; with one joint in radians a point on its axis stays, too."""
    arm = Arm(replace(drawing(table), instrument=Socket()), sigma=NOISE)
    for generator in map(np.random.default_rng, range(4)):
        data = rows(Exponentials(generator, table=table), {"A": CUPS["A"]}, 31, NOISE, generator)
        (said,) = read_differently(arm, replace(data, postures=np.radians(data.postures)), search=False).sentences
        assert said.startswith("it looks as if the joint angles are in radians")


def test_swapped_columns_that_two_zeros_come_near(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search goes on where two zeros leave what may be the drawing's and the better one of them alone does not."""
    monkeypatch.setattr(readings, "DRAWN", 0.1)
    arm = Arm(replace(drawing(SEVEN), instrument=Socket()), sigma=NOISE)
    for generator in map(np.random.default_rng, (0, 1, 4)):
        data = rows(Exponentials(generator, table=SEVEN), {"A": CUPS["A"]}, 11, NOISE, generator)
        (said,) = read_differently(arm, replace(data, postures=data.postures[:, [0, 1, 2, 3, 4, 6, 5]])).sentences
        assert said.startswith("it looks as if columns of joints 6 and 7 are swapped")


def test_without_a_distance_the_size_is_open() -> None:
    """Only the drawing tells it, to a millimetre a link: that is what the fit promises, and it keeps it."""
    truth, fit = fitted(TABLE, 1, ())
    errors, deviations = unseen_distances(truth, fit, 1)
    assert np.all(np.abs(errors) < 3.0 * deviations)
    assert np.all(deviations > 0.2)
    assert fit.expected_tip is not None
    assert fit.expected_tip > 0.5
    # the size apart, distances are as good as with a bar
    lengths = np.array([apart(UNSEEN, a, b) for a, b in combinations(UNSEEN, 2)])
    assert np.std(errors / lengths) * lengths.mean() < 2.0 * NOISE


@pytest.mark.parametrize("one_by_one", [False, True])
def test_nothing_is_missing_where_a_smaller_arm_fits_better(one_by_one: bool) -> None:
    """Where the size is open axes that may shift make a smaller arm; where the cups of a bar are taken one after the
    other, a step in between that takes the place of their distance."""
    generator = np.random.default_rng(1)
    cups = {"A": CUPS["A"], "B": [450.0, -150.0, 100.0]} if one_by_one else CUPS
    data = rows(Exponentials(generator), cups, 80 // len(cups), NOISE, generator, one_by_one)
    known = (("A", "B", apart(cups, "A", "B")),) if one_by_one else ()
    assert diagnose(Arm(replace(drawing(), instrument=Socket(distances=known)), sigma=NOISE), data).verdict == "none"


def test_rough_rows_leave_the_arm_about_as_drawn() -> None:
    """What five seatings of 2 mm in each of three cups say less of than machining does, the geometry of a diagnosis has
    as drawn: it predicts the cups to half as much again as with a prior, where all free it is off by 1.8 times that."""
    squares = np.zeros(2)
    for generator in map(np.random.default_rng, range(6)):
        truth, cups = Exponentials(generator, table=SEVEN), {name: CUPS[name] for name in "ABC"}
        arm = Arm(replace(drawing(SEVEN), instrument=Socket()))
        data, fresh = (rows(truth, cups, each, noise, generator) for each, noise in ((5, 2.0), (20, 0.0)))
        fit, model = estimate(Model(with_sessions(arm, data)), data), Model(with_sessions(fitted_arm(arm, data), data))
        touched = Conditions(marker=np.array([data.marker_names.index(name) for name in fresh.marker], dtype=float))
        found = ((fit.model, fit.parameters), (model, model.values))
        squares += [np.mean(np.square(each.position(fresh.postures, x, touched))) for each, x in found]
    assert squares[1] < 1.5**2 * squares[0]


def test_a_row_beside_its_cup_is_named_before_the_zeros_that_a_fit_makes_of_it() -> None:
    generator = np.random.default_rng(0)
    data = rows(Exponentials(generator), {"A": CUPS["A"], "B": [450.0, -150.0, 100.0]}, 15, NOISE, generator)
    postures = data.postures.copy()
    postures[7] += 0.3 * generator.normal(size=postures.shape[1])
    arm = Arm(replace(drawing(), instrument=Socket(distances=(("A", "B", 50.0),))), sigma=NOISE)
    found = inspect(arm, Measurements(postures, data.positions, marker=data.marker))
    assert [sentence[:6] for sentence in found.data["problems"]] == ["row 8:"]


def test_a_holdout_in_cups_that_were_moved_is_told_from_another_arm() -> None:
    generator = np.random.default_rng(2)
    truth, moved = Exponentials(generator), {name: [x, y, z + 200.0] for name, (x, y, z) in CUPS.items()}
    data, holdout = (rows(truth, cups, 10, NOISE, generator) for cups in (CUPS, moved))
    with pytest.raises(InputError, match=r"another arm or unit, or a cup that was moved \(armcal validate finds it"):
        diagnose(Arm(replace(drawing(), instrument=Socket()), sigma=NOISE), data, holdout)


def test_an_error_curve_leaves_each_cup_its_place() -> None:
    """Cups of other rows are others: no curve of a joint shifts them, and an arm file takes what is written."""
    generator = np.random.default_rng(1)
    data = rows(Exponentials(generator), CUPS, 30, NOISE, generator)
    read = data.postures - 2e-3 * np.clip(2.0 * data.postures, -1.0, 1.0) * (np.arange(6) == 2)
    instrument = Socket(distances=(("A", "B", apart(CUPS, "A", "B")),))
    found = diagnose(Arm(replace(drawing(), instrument=instrument)), replace(data, postures=read))
    (curve,) = [spec.curve for spec in found.predicting.specs if spec.curve]
    assert any(name.startswith("tool") for name in curve.geometry)
    assert not any(name.startswith("cup") for name in curve.geometry)


def test_distances_that_the_rows_contradict() -> None:
    """Of two bars the one that is 30 mm off is named; where all are half as long so is the arm, which is none."""
    generator = np.random.default_rng(2)
    data = rows(Exponentials(generator), CUPS, 20, NOISE, generator, one_by_one=True)
    true = (("A", "B", apart(CUPS, "A", "B")), ("C", "D", apart(CUPS, "C", "D")))

    def arm(first: float, second: float) -> Arm:
        known = tuple((*pair, times * length) for (*pair, length), times in zip(true, (first, second), strict=True))
        return Arm(replace(drawing(), instrument=Socket(distances=known)))  # type: ignore[arg-type]

    assert not inspect(arm(1.0, 1.0), data).problems
    unmarked = replace(data, marker=None, marker_names=())
    said, *_ = inspect(Arm(replace(drawing(), instrument=Socket())), unmarked).problems
    assert said.endswith("several cups without a column cup, or a cup that was moved without a new name")
    assert inspect(arm(1.0, 1.0), unmarked.rows(range(20))).problems[0].endswith("than the data (none is named)")
    (said,) = inspect(arm(1.0 + 30.0 / true[0][2], 1.0), data).problems
    assert said.startswith("these rows contradict distances_mm: cups A to B 45")  # of which 4 deviations are 3 mm
    assert "C to D" not in said
    half = arm(0.5, 0.5)
    assert estimate(Model(with_sessions(half, data)), data).status is Status.implausible
    assert inspect(half, data).problems[0].count("cups ") == 2
    # a short bar in metres, which an arm of next to no size fits best
    rough = rows(Exponentials(generator), {"A": CUPS["A"], "B": [450.0, -150.0, 100.0]}, 20, 1.0, generator)
    (said,) = inspect(Arm(replace(drawing(), instrument=Socket(distances=(("A", "B", 0.05),)))), rough).problems
    assert said.startswith("these rows contradict distances_mm: cups ")


def test_rounding_is_that_of_an_arm_although_nothing_is_read() -> None:
    """Postures a turn away are the same: residuals differ by rounding, and by no more than a search allows for."""
    generator = np.random.default_rng(3)
    data = rows(Exponentials(generator), CUPS, 15, NOISE, generator)
    model = placed_model(Model(with_sessions(Arm(replace(drawing(), instrument=Socket())), data)), data)
    here, away = (Problem.of(model, replace(data, postures=data.postures + k)) for k in (0.0, 2.0 * np.pi))
    assert 0.0 < np.linalg.norm(here.residuals(here.start) - away.residuals(here.start)) < here.rounding[0] < 1e-9


def test_a_slide_across_an_axis_tells_the_size() -> None:
    """One along all axes does not: a flat arm twice as wide lifts as high."""
    turn, slide = DHRow(300.0, 0.0, 0.0), DHRow(0.0, 0.0, 0.0, type="prismatic", limits=(0.0, 100.0))
    across = DHRow(0.0, HALF, 0.0, type="prismatic", limits=(0.0, 100.0))
    for rows_of, is_open in (((turn, turn, slide), True), ((across, turn, turn), False), ((turn, turn), True)):
        assert bool(replace(chain_of(rows_of), instrument=Socket()).size_is_open[0]) is is_open


def test_no_motion_of_arm_and_cups_together_is_a_parameter() -> None:
    """Six joints have 27 parameters with one measured point; of the six that place the arm none is left, and the cups
    have three each. A distance ties one; without one the size is that of the drawing."""
    generator = np.random.default_rng(3)
    data = rows(Exponentials(generator), CUPS, 15, 0.0, generator)
    for pairs, count in (([("A", "B")], 21 + 11), (list(combinations("ABC", 2)), 21 + 9), ([], 21 + 12 - 1)):
        instrument = Socket(distances=tuple((a, b, apart(CUPS, a, b)) for a, b in pairs))
        arm = Arm(replace(drawing(), instrument=instrument), sigma=NOISE)
        assert not [name for name in Model(arm).names if name.startswith("base")]
        kept = Model(practical(arm, data))
        fit = estimate(kept, data)
        assert fit.rms_after < 1e-9  # without a distance of an arm whose longest step is as drawn
        jacobian = fit.model.jacobian(data.postures, fit.parameters, data.conditions)
        assert spectrum(jacobian, fit.model.scales, 1e-7).rank == len(kept.names) == count


def test_cups_keep_distances_that_are_known() -> None:
    """Wherever the free coordinates are, near to the start; all six distances of a plate, too."""
    every = tuple((a, b, apart(CUPS, a, b)) for a, b in combinations(CUPS, 2))
    for known in (every[:1], (every[0], every[-1]), every[:4], every):
        socket = Socket(tuple((name, tuple(place)) for name, place in CUPS.items()), known)
        assert len(socket.parameters) == 12 - len(known)
        values = ca.SX.sym("v", len(socket.parameters))
        places = ca.Function("places", [values], [ca.vertcat(*socket._cups(values))])
        moved = np.array([p.neutral for p in socket.parameters]) + np.random.default_rng(0).uniform(
            -2.0, 2.0, len(socket.parameters)
        )
        for where in (socket._tied[0], np.array(places(moved)).ravel()):
            found = dict(zip(CUPS, where.reshape(-1, 3), strict=True))
            for a, b, length in known:
                assert np.linalg.norm(found[a] - found[b]) == pytest.approx(length, abs=1e-6)


def test_distances_of_cups() -> None:
    """Cups of two days are others: the bar was moved, its length is the same. A distance between cups that no row
    names, of a name that is misspelt, say, tells no size; some distances no cups have."""
    on_x = {name: (100.0 * k, 0.0, 0.0) for k, name in enumerate("ABCD")}
    monday = ("monday/A", on_x["A"]), ("monday/B", on_x["D"])
    socket = Socket((*monday, ("tuesday/A", on_x["B"]), ("tuesday/B", (0.0, 400.0, 0.0))), (("A", "B", 301.0),))
    assert len(socket.parameters) == 10
    assert len(replace(socket, at=(monday[0], ("tuesday/B", on_x["D"]))).parameters) == 6
    cups, wrong, right = (("A", on_x["A"]), ("B", on_x["D"])), (("A", "b", 300.0),), (("A", "B", 300.0),)
    assert Socket(cups, wrong).size_is_open[0]
    assert Socket(distances=wrong).size_is_open[0] == "" == Socket(cups, right).size_is_open[0]
    socket = Socket(tuple(on_x.items())[:3], (("A", "B", 10.0), ("B", "C", 10.0), ("A", "C", 300.0)))
    with pytest.raises(InputError, match="distances_mm: no cups have all of the distances A to B, B to C, A to C"):
        _ = socket.parameters
