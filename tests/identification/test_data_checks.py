"""Units, markers and lost beams of spatial measurements, on a small arm with errors of a millimetre."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from identification.arm import Arm
from identification.data_checks import data_warnings
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from identification.kinematics.frames import from_own_axes, pose
from identification.measurements import Measurements
from identification.model import Model

QUARTER = np.pi / 2.0
CHAIN = chain_of([DHRow(0.0, QUARTER, 350.0), DHRow(-400.0, 0.0, 0.0), DHRow(-300.0, QUARTER, 0.0, limits=(-2.0, 2.0))])
ARM = Arm.of_chain(CHAIN)
TOOLS = {"left": np.array([90.0, 20.0, 50.0]), "right": np.array([-80.0, 10.0, 40.0])}


def measured(rows: int = 60) -> Measurements:
    """Both points in turn, of an arm that stands elsewhere."""
    generator = np.random.default_rng(3)
    chain = replace(CHAIN, base=pose((2000.0, -500.0, 700.0), from_own_axes(0.1, -0.4, 2.0)), tools=TOOLS)
    postures = generator.uniform(-2.0, 2.0, (rows, 3))
    data = Measurements(postures, np.zeros((rows, 3)), marker=np.array(list(TOOLS))[np.arange(rows) % 2])
    model = Model(Arm.of_chain(chain))
    return replace(data, positions=model.position(postures, generator.normal(0.0, 1.0 / model.scales), data.conditions))


def test_good_data_are_not_doubted() -> None:
    assert data_warnings(measured(), ARM) == []
    assert data_warnings(measured(8), ARM) == []  # too few to tell


def test_radians_and_metres() -> None:
    data = measured()
    radians = replace(data, postures=np.radians(data.postures))  # as a file with q1_deg is read
    assert data_warnings(radians, ARM) == [
        "the joint angles look like radians: name the columns q1_rad.. instead of q1_deg.."
    ]
    metres = replace(data, positions=data.positions / 1000.0)
    assert data_warnings(metres, ARM) == [
        "the positions look like metres: name the columns x_m, y_m, z_m instead of x_mm, y_mm, z_mm"
    ]
    assert len(data_warnings(replace(radians, positions=metres.positions), ARM)) == 2


def test_swapped_markers_and_lost_beams_are_named() -> None:
    data = measured()
    markers = data.marker.copy()
    markers[[10, 11]] = markers[[11, 10]]
    positions = data.positions.copy()
    positions[20] += (0.0, 400.0, 0.0)
    first, second = data_warnings(replace(data, marker=markers, positions=positions), ARM)
    assert first.startswith("markers look swapped in rows 11, 12: ")
    assert second.startswith("a lost beam or another posture in row 21: up to ")
