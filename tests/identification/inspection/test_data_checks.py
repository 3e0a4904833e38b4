"""Units, markers and lost beams of measurements, on small arms with errors of a millimetre."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification import Arm, DHRow, InputError, Measurements, Model, chain_of
from identification.inspection.inspection import inspect
from identification.inspection.readings import data_warnings, read_differently
from identification.instruments import PlanarDistance
from identification.kinematics.frames import from_angles, pose

QUARTER = np.pi / 2.0
ROWS = [DHRow(0.0, QUARTER, 350.0), DHRow(-400.0, 0.0, 0.0), DHRow(-300.0, QUARTER, 0.0, limits=(-2.0, 2.0))]
CHAIN = chain_of(ROWS)
INCH = 25.4
ARM = Arm(CHAIN)
TOOLS = {"left": np.array([90.0, 20.0, 50.0]), "right": np.array([-80.0, 10.0, 40.0])}


def measured(rows: int = 30) -> Measurements:
    """Both points in turn, of an arm that stands elsewhere."""
    generator = np.random.default_rng(3)
    chain = replace(CHAIN, base=pose((2000.0, -500.0, 700.0), from_angles((0.1, -0.4, 2.0))), tools=TOOLS)
    postures = generator.uniform(-2.0, 2.0, (rows, 3))
    data = Measurements(postures, np.zeros((rows, 3)), marker=np.array(list(TOOLS))[np.arange(rows) % 2])
    model = Model(Arm(chain))
    return replace(data, positions=model.position(postures, generator.normal(0.0, 1.0 / model.scales), data.conditions))


def test_good_data_are_not_doubted() -> None:
    assert data_warnings(measured(), ARM) == []
    assert data_warnings(measured(8), ARM) == []  # too few to tell


def ratio(said: str) -> float:
    """The measured factor that a sentence states."""
    return float(said.partition(" times ")[0].rpartition(" ")[2])


UNITS = {"centimetres": 10.0, "inches": INCH, "decimetres": 100.0, "feet": 304.8, "metres": 1000.0}


@pytest.mark.parametrize(("unit", "factor"), [*UNITS.items(), ("", 14.0), ("", 10.4), ("", 0.3), ("", 1.0 / 27.0)])
def test_a_unit_is_named_where_the_measured_factor_fits_it(unit: str, factor: float) -> None:
    """Positions in another unit, and an arm file in another unit: either makes them agree, and which of them is wrong
    nothing tells. Errors of 1 mm in some 800 leave the factor within 0.5 %; 10.4 is 4 % from centimetres and 27 is 6 %
    from inches."""
    for arm, good in ((ARM, measured()), (PLANAR, simulated(3.0))):
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
PLANAR = Arm([260.0, 180.0])


def simulated(span: float, *, angles: float = 1.0, lengths: float = 1.0) -> Measurements:
    """Measurements of `PLANAR` whose numbers were multiplied by factors, as a wrong unit does."""
    generator = np.random.default_rng(2)
    q = generator.uniform(-span, span, (30, 2))
    theta = np.cumsum(q, axis=1)
    tip = np.column_stack([np.cos(theta) @ PLANAR.lengths, np.sin(theta) @ PLANAR.lengths])
    return Measurements(q * angles, (tip + generator.normal(0.0, 1.0, tip.shape)) * lengths)


def certain(data: Measurements, arm: Arm) -> str:
    """What is said of units that are beyond doubt."""
    readings = read_differently(arm, data, search=False)
    assert readings.other_units == data_warnings(data, arm)
    return readings.sentences[0] if readings.certain else ""


def test_angles_in_another_unit() -> None:
    for arm, good in ((PLANAR, simulated(3.0)), (ARM, measured(20))):
        for unit, factor in (
            ("degrees (name the columns q1_deg..", 180.0),
            ("radians (name the columns q1_rad..", 3.14),
        ):
            wrong = replace(good, postures=good.postures * (factor / np.pi if factor > 4 else np.pi / 180.0))
            assert certain(wrong, arm).startswith(f"it looks as if the joint angles are in {unit})")
    whole_turns = simulated(3.0)  # an axis that counts on
    assert data_warnings(replace(whole_turns, postures=whole_turns.postures + 20.0 * np.pi), PLANAR) == []


def test_there_is_no_doubt_where_the_drawing_explains_the_rows_in_other_units() -> None:
    """Errors are 1 mm in each coordinate: 1.41 mm RMS. Metres of an arm whose second link is half as long: suspected,
    since nearer to the drawing, but not certain."""
    for angles, lengths in ((np.pi / 180.0, 1.0), (1.0, 1e-3), (np.pi / 180.0, 1e-3), (1.0, INCH)):
        rms = certain(simulated(3.0, angles=angles, lengths=lengths), PLANAR).partition(" the drawing then leaves ")[2]
        assert float(rms.partition(" mm")[0]) == pytest.approx(1.41, rel=0.2)
    metres = simulated(3.0, lengths=1e-3)
    q = metres.postures
    z = 260.0 * np.exp(1j * q[:, 0]) + 90.0 * np.exp(1j * q.sum(axis=1))
    other = replace(metres, positions=1e-3 * np.column_stack([z.real, z.imag]))
    assert len(data_warnings(other, PLANAR)) == 1
    for data, arm in ((other, PLANAR), (simulated(3.0), PLANAR), (measured(), ARM)):
        assert certain(data, arm) == ""


def test_another_number_of_links() -> None:
    for look in (lambda rows, arm: inspect(arm, rows), data_warnings):
        with pytest.raises(InputError, match="found 2 joints, allowed: 3"):
            look(simulated(1.0), Arm([1.0, 1.0, 1.0]))


def test_rows_that_are_wild_hide_no_unit() -> None:
    """Metres in `_mm` columns, and three of twenty rows anywhere within this many."""
    wild = 5e3
    planar, center = simulated(3.0).rows(slice(20)), (400.0, 100.0)
    bar = replace(PLANAR, chain=replace(PLANAR.chain, instrument=PlanarDistance((("1", center),))))
    lengths = replace(planar, positions=np.linalg.norm(planar.positions - center, axis=1)[:, None])
    for arm, good in ((ARM, measured(20)), (PLANAR, planar), (bar, lengths)):
        lost = np.abs(np.random.default_rng(5).uniform(-wild, wild, (3, good.dimension)))
        metres = good.positions / 1000.0
        metres[[2, 9, 16]] = lost
        (said,) = read_differently(arm, replace(good, positions=metres), search=False).sentences
        assert "as if the positions are in metres, whose columns end in _m" in said
        assert ratio(said) == pytest.approx(1000.0, rel=0.01)
