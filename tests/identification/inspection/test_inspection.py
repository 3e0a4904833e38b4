"""What `inspect` says of data: each fault on purpose has its sentence, and good data have none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from identification import Arm, DHRow, Measurements, Model, chain_of, estimate
from identification.inspection.inspection import inspect, other_frame
from identification.inspection.readings import read_differently
from identification.kinematics.chain import BASE
from identification.kinematics.frames import rotation_about
from identification.validate import validate
from tests.identification.exponentials import Exponentials, drawing

LENGTHS = np.array([500.0, 400.0, 200.0])
ARM = Arm(LENGTHS, lower=np.full(3, -2.5), upper=np.full(3, 2.5))


def data(m: int = 40, base: complex = 0.0, zero: float = 0.0, still: bool = False) -> Measurements:
    """Measurements of an arm with errors of drawing and noise, written with complex numbers."""
    generator = np.random.default_rng(21)
    q = generator.uniform(-2.4, 2.4, (m, 3))
    q[:, 2] = 0.3 if still else q[:, 2]
    theta = np.cumsum(q + np.array([0.0, 0.004 + zero, -0.003]), axis=1)
    z = np.exp(1j * theta) @ (LENGTHS + np.array([0.5, -0.4, 0.3])) + base
    z += 0.05 * (generator.standard_normal(m) + 1j * generator.standard_normal(m))
    return Measurements(q, np.column_stack([z.real, z.imag]))


def test_good_data_have_no_problem() -> None:
    found = inspect(ARM, data())
    read = found.to_json()
    assert (found.problems, read["rows"], read["postures"]) == ((), 40, 40)
    assert 1.0 < read["rms_drawing_mm"] < 5.0
    assert read["rms_fitted_mm"] == pytest.approx(0.05 * np.sqrt(2.0 * (1.0 - 6.0 / 80.0)), rel=0.3)
    assert any("no posture is repeated" in note for note in found.notes)


@pytest.mark.parametrize("unit", [np.radians(1.0), 1.0])
def test_repeats_scatter_in_millimetres_or_are_not_said(unit: float) -> None:
    """Noise of 0.05 mm per coordinate is 0.07 mm at a point; what is in other units, or too few rows, say nothing."""
    whole = data()
    rows = whole.rows(np.tile(np.arange(10), 4))
    z = 0.05 * np.random.default_rng(5).standard_normal(rows.positions.shape)
    found = inspect(ARM, replace(rows, postures=unit * rows.postures, positions=rows.positions + z)).to_json()
    assert found["repeats_mm"] == (pytest.approx(0.05 * np.sqrt(2.0), rel=0.25) if unit == 1.0 else None)
    few = inspect(ARM, rows.rows(np.repeat([0, 1], 5))).to_json()
    assert few["close_repeats_mm"] is None


def test_each_fault_has_its_sentence() -> None:
    good, turned = data(), data().postures
    beyond = np.flatnonzero(turned[:, 1] < -2.0)
    turned = turned + 2.0 * np.pi * np.isin(np.arange(40), (3, 4, 5))[:, None] * [0, 0, 1]
    said = f"{len(beyond)} of 40 postures lie outside the joint limits, the first in row {beyond[0] + 1}: joint 2 at "
    for arm, rows, start, end in (
        (ARM, replace(good, postures=good.postures * [1, 1, -1]), "it looks as if joint 3 turns the other way: ", ""),
        (ARM, data(zero=0.5), "zeros differ from the drawing's: 28.9 deg at joint 2", ""),  # 0.004 and 0.5 rad
        (replace(ARM, lower=np.array([-2.5, -2.0, -2.5])), good, said, "allowed -114.592 to 143.239"),
        (
            ARM,
            replace(good, postures=turned),
            "3 of 40 postures lie outside the joint limits, the first in row 4: joint 3",
            "; joint 3 would be within them whole turns (360 deg) away: count these readings from the drawing's zero",
        ),
        (ARM, replace(good, postures=np.radians(good.postures)), "it looks as if the joint angles are in radians", ""),
        (
            ARM,
            good.rows([*range(40), 5]),
            "1 row is an exact copy of another (of 41 rows): the first row 41 of row 6",
            "",
        ),
        (replace(ARM, chain=np.array([500.0, 100.0, 200.0])), good, "the drawing is", ""),
    ):
        (sentence,) = inspect(arm, rows).problems
        assert sentence.startswith(start)
        assert sentence.endswith(end)


def test_few_readings_whole_turns_away_are_noted() -> None:
    """Where the limits allow both; not of a joint that turns several times, nor where the limits say it already."""
    free, good = Arm(LENGTHS, lower=np.full(3, -7.0), upper=np.full(3, 7.0)), data()
    near = np.column_stack([good.postures[:, :2], 0.04 + 0.3 * good.postures[:, 2]])
    turns = np.zeros((40, 3))
    turns[6, 2] = -1.0
    notes = {}
    for name, arm, q in (
        ("once", free, near + 2.0 * np.pi * turns),
        ("limited", ARM, near + 2.0 * np.pi * turns),
        ("several", free, 2.6 * good.postures),
        ("half", free, near + 2.0 * np.pi * (np.arange(40) % 2)[:, None]),
    ):
        theta = np.cumsum(q, axis=1)
        tips = np.stack([np.cos(theta) @ LENGTHS, np.sin(theta) @ LENGTHS], axis=1)
        found = inspect(arm, Measurements(q, tips + 0.05 * np.random.default_rng(1).standard_normal(tips.shape)))
        notes[name] = [note for note in found.notes if "whole turns" in note]
    degrees = np.degrees(near[6, 2]) - 360.0
    (note,) = notes.pop("once")
    assert note.startswith(f"joint 3 reads {degrees:.4g} deg in row 7, whole turns away from the other rows (")
    assert not any(notes.values())


def test_what_the_data_cannot_say() -> None:
    found, rows = inspect(ARM, data(still=True)), data()
    both = inspect(ARM, replace(rows, postures=rows.postures * [1.0, 0.01, 0.01]))
    assert "joint 3 hardly moves: its own errors cannot be seen" in found.notes
    assert "joints 2, 3 hardly move: their own errors cannot be seen" in both.notes
    assert any(note.startswith("not estimable separately: ") for note in found.notes)
    few = inspect(ARM, data(m=2))
    assert few.fit is None
    assert "too few rows for a fit of the geometry" in few.problems


ROWS = ((0.0, np.pi / 2.0, 350.0), (-400.0, 0.0, 0.0), (-300.0, np.pi / 2.0, 0.0))  # a, alpha, d


def points(q: np.ndarray, tool: np.ndarray, rows: Sequence[tuple[float, float, float]] = ROWS) -> np.ndarray:
    """(m, 3) of a three-axis arm, by 4 x 4 matrices."""
    found = np.empty((len(q), 3))
    for row, angles in enumerate(q):
        pose = np.eye(4)
        for (a, alpha, d), t in zip(rows, angles, strict=True):
            ct, st, ca, sa = np.cos(t), np.sin(t), np.cos(alpha), np.sin(alpha)
            top = [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0.0, sa, ca, d]]
            pose = pose @ np.array([*top, [0.0, 0.0, 0.0, 1.0]])
        found[row] = (pose @ [*tool, 1.0])[:3]
    return found


def test_the_drawing_leaves_the_same_in_check_identify_and_validate() -> None:
    """Base and measured point fitted to all rows in least squares, by SciPy on a chain of its own; more rows than the
    start of a fit looks at."""
    generator = np.random.default_rng(31)
    q, tool = generator.uniform(-2.0, 2.0, (900, 3)), np.array([60.0, 20.0, 40.0])
    turn = Rotation.from_rotvec([0.1, -0.4, 2.0])
    seen = turn.apply(points(q + np.array([0.0, 0.004, -0.006]), tool)) + np.array([2000.0, -500.0, 700.0])
    rows = Measurements(q, seen + generator.normal(0.0, 0.3, seen.shape))
    without, along = points(q, np.zeros(3)), [points(q, axis) for axis in np.eye(3)]

    def left(p: np.ndarray) -> np.ndarray:
        there = without + sum(x * (one - without) for x, one in zip(p[6:], along, strict=True))
        return (rows.positions - Rotation.from_rotvec(p[:3]).apply(there) - p[3:6]).ravel()

    best = least_squares(left, [0.1, -0.4, 2.0, 2000.0, -500.0, 700.0, *tool], xtol=1e-14, ftol=1e-14)
    of_drawing = pytest.approx(np.sqrt(2.0 * best.cost / len(q)), rel=1e-7)
    arm = Arm(chain_of([DHRow(*row) for row in ROWS]))
    fitted = estimate(Model(arm), rows)
    assert inspect(arm, rows).data["rms_drawing_mm"] == of_drawing
    assert fitted.rms_before == of_drawing
    assert validate(fitted.calibrated_arm(), rows).nominal.rms == of_drawing


def test_two_reflectors_changed_for_half_of_the_rows() -> None:
    """Swapped, each row is half of their distance off, however the geometry is fitted: 15 mm of 30 mm."""
    generator = np.random.default_rng(43)
    q, marker = generator.uniform(-2.0, 2.0, (80, 3)), np.array(["a", "b"])[np.arange(80) % 2]
    one, two = (points(q, np.array(tool)) for tool in ([60.0, 15.0, 40.0], [60.0, -15.0, 40.0]))
    seen = np.where((marker == "b")[:, None], two, one) + generator.normal(0.0, 0.05, (80, 3))
    arm = Arm(chain_of([DHRow(*row) for row in ROWS]))
    assert inspect(arm, Measurements(q, seen, marker=marker)).problems == ()
    swapped = np.where(np.arange(80) < 40, marker, np.where(marker == "a", "b", "a"))
    found = inspect(arm, Measurements(q, seen, marker=swapped))
    assert 14.0 < found.fit.rms_after < 16.0
    (said,) = found.problems
    assert "no geometry explains these rows: look for columns, units or markers that changed" in said
    loose = replace(arm, sigma=15.0)  # an instrument as bad as that
    assert not any(
        "no geometry" in problem for problem in inspect(loose, Measurements(q, seen, marker=swapped)).problems
    )


def test_a_base_that_stands_elsewhere() -> None:
    """Known to stand somewhere, found 60 degrees and 500 mm from there; a base that is left out is nowhere wrong."""
    generator = np.random.default_rng(2)
    truth, q = Exponentials(generator), generator.uniform(-2.0, 2.0, (60, 6))
    data = Measurements(q, truth.poses(q)[:, :3, 3] + 0.05 * generator.standard_normal((60, 3)))
    away = truth.base.copy()
    away[:3, :3] = rotation_about([0.0, 1.0, 0.0], np.radians(60.0)) @ away[:3, :3]
    away[2, 3] += 500.0
    chain = replace(drawing(), base=away, settled=frozenset({BASE}))

    def noted(arm: Arm) -> list[str]:
        return other_frame(arm, read_differently(arm, data).written)

    (said,) = noted(Arm(chain))
    assert "another frame than [base] says: turned by " in said
    turn, shift = (float(said.split(word)[1].split()[0]) for word in ("turned by ", "deg and "))
    assert turn == pytest.approx(60.0, abs=0.5)
    assert shift == pytest.approx(500.0, abs=5.0)
    assert "zero of joint 1" not in said
    assert noted(Arm(replace(chain, base=truth.base))) == noted(Arm(drawing())) == []
