"""Frames, bases and lengths that are not as the arm file says: each with its size, and nothing of data that are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.estimation import estimate
from identification.inspection.inspection import constant_length, other_base, turned_frame
from identification.inspection.readings import read_differently
from identification.instruments import Distance
from identification.kinematics.chain import BASE
from identification.kinematics.frames import rotation_about
from identification.measurements import Measurements
from identification.model import Model
from tests.identification.exponentials import Exponentials, drawing

LENGTHS = np.array([500.0, 400.0, 200.0])
PLANAR = Arm(LENGTHS)


def in_the_plane(turn: float, place: complex = 0.0) -> Measurements:
    """Positions of an arm a little off its drawing, in a frame that is turned [deg], with complex numbers."""
    generator = np.random.default_rng(1)
    q = generator.uniform(-2.4, 2.4, (40, 3))
    z = (
        np.exp(1j * np.cumsum(q + np.array([0.0, 0.004, -0.003]), axis=1)) @ (LENGTHS + np.array([0.5, -0.4, 0.3]))
        + place
    )
    z = z * np.exp(1j * np.radians(turn)) + 0.05 * (generator.standard_normal(40) + 1j * generator.standard_normal(40))
    return Measurements(q, np.column_stack([z.real, z.imag]))


def frame_note(arm: Arm, data: Measurements) -> list[str]:
    return turned_frame(arm, read_differently(arm, data, search=False).written)


@pytest.mark.parametrize("place", [0.0, 300.0 + 50.0j])
@pytest.mark.parametrize("turn", [40.0, -90.0])
def test_a_turned_frame_in_the_plane(turn: float, place: complex) -> None:
    (said,) = frame_note(PLANAR, in_the_plane(turn, place))
    assert float(said.split("turned by ")[1].split()[0]) == pytest.approx(
        turn, abs=0.3
    )  # zeros of 0.004 rad turn it, too


def test_a_base_that_stands_elsewhere() -> None:
    """Known to stand somewhere, found 60 degrees and 500 mm from there; a base that is left out is nowhere wrong."""
    generator = np.random.default_rng(2)
    truth, q = Exponentials(generator), generator.uniform(-2.0, 2.0, (60, 6))
    data = Measurements(q, truth.poses(q)[:, :3, 3] + 0.05 * generator.standard_normal((60, 3)))
    away = truth.base.copy()
    away[:3, :3] = rotation_about([0.0, 1.0, 0.0], np.radians(60.0)) @ away[:3, :3]
    away[2, 3] += 500.0
    chain = replace(drawing(), base=away, settled=frozenset({BASE}))
    (said,) = other_base(Arm(chain), data)
    assert "another frame than [base] says: turned by " in said
    turn, shift = (float(said.split(word)[1].split()[0]) for word in ("turned by ", "deg and "))
    assert turn == pytest.approx(60.0, abs=0.5)
    assert shift == pytest.approx(500.0, abs=5.0)
    assert "zero of joint 1" not in said
    assert other_base(Arm(replace(chain, base=truth.base)), data) == []
    assert other_base(Arm(drawing()), data) == []


def bar_readings(offset: float, q: Array, generator: np.random.Generator) -> Measurements:
    """Distances of the lines of an independent simulator from a center, all longer by the offset [mm]."""
    truth = Exponentials(generator)
    center = truth.base[:3, :3] @ np.array([600.0, -200.0, 300.0]) + truth.base[:3, 3]
    read = np.linalg.norm(truth.poses(q)[:, :3, 3] - center, axis=1) + offset + 0.05 * generator.standard_normal(len(q))
    return Measurements(q, read[:, None])


@pytest.mark.parametrize("offset", [0.0, 0.8, -4.0])
def test_a_constant_in_all_distances(offset: float) -> None:
    generator = np.random.default_rng(4)
    data = bar_readings(offset, generator.uniform(-2.0, 2.0, (100, 6)), generator)
    arm = Arm(replace(drawing(), instrument=Distance()), sigma=0.05)
    found = constant_length(arm, data, estimate(Model(arm), data))
    if not offset:
        assert found == []
        return
    (said,) = found
    assert 'add [[effects]] name = "length_offset"' in said
    size = float(said.split("look ")[1].split()[0])
    assert size == pytest.approx(abs(offset), abs=0.2)  # some four standard deviations of 0.04 mm
    assert f"mm too {'long' if offset > 0.0 else 'short'}" in said
    assert constant_length(arm, data, None) == []
    there = arm.with_effects(EffectSpec("length_offset"))
    assert constant_length(there, data, estimate(Model(arm), data)) == []
