"""Data sets in space: sizes of hidden effects against the program's model, and what the arm file is wrong about."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe.studies.blind import spatial_cells
from doe.studies.blind.cells import DataSet
from doe.studies.blind.spatial_cells import CELLS, data_set
from identification.arm import Arm, EffectSpec
from identification.effects import build_all
from identification.gap.fits.fit import fit
from identification.gap.fits.whitening import Rows
from identification.model import Model
from identification.model.minimal import practical

NUMBERS = range(900, 903)


def base_fit(data: DataSet, arm: Arm | None = None) -> float:
    """Sum of squares in units of sigma that the geometry leaves."""
    found = fit(Model(practical(arm or data.arm, data.measurements)), Rows.of(data.measurements))
    assert data.arm.sigma is not None
    return found.squares / data.arm.sigma**2


@pytest.mark.parametrize("number", NUMBERS)
def test_the_effect_is_of_the_size_asked_for(number: int) -> None:
    """What the geometry leaves is noise and lambda^2: chi-square of 153 or so, whose deviation is 17.5, plus 64."""
    data = data_set("space, lambda 8, m=60", number)
    nothing = replace(data.measurements, positions=data.measurements.positions - missing(data))
    assert base_fit(data) - base_fit(replace(data, measurements=nothing)) == pytest.approx(64.0, abs=40.0)


def missing(data: DataSet) -> np.ndarray:
    """(m, 3) what the hidden effect does, by the program's model at the true values."""
    arm = practical(data.arm, data.measurements)
    with_it = Model(arm.with_effects(*arm.effects, *data.specs))
    values = with_it.parameters.vector(dict(data.values))
    rows = data.measurements
    return with_it.position(rows.postures, values, rows.conditions) - Model(arm).position(
        rows.postures, np.zeros(len(Model(arm).names)), rows.conditions
    )


def test_every_hidden_effect_is_one_of_the_library() -> None:
    """With the parameters that are said to be true."""
    for cell, spec in CELLS.items():
        data = data_set(cell, 901)
        effects = build_all(data.specs, data.arm.links, data.arm.lengths, 3)
        assert tuple(effect.key for effect in effects) == data.effects
        assert len(effects) == (0 if spec.lam is None else 2 if spec.gravity == "place" else 1)
        assert {p.name for effect in effects for p in effect.parameters} >= set(data.values)


def test_what_the_arm_file_is_wrong_about() -> None:
    spec, rng = CELLS["space, gravity, lambda 8"], np.random.default_rng(7)
    truth = spatial_cells.random_truth(spec, rng)
    arms = {kind: spatial_cells.arm_of(replace(spec, gravity=kind), truth, rng) for kind in ("known", "masses", "tool")}
    loads = {kind: arm.gravity for kind, arm in arms.items()}
    assert loads["known"] is not None and loads["masses"] is not None and loads["tool"] is not None  # noqa: PT018
    np.testing.assert_array_equal(loads["known"].link_masses, truth.masses)
    ratios = loads["masses"].link_masses / truth.masses
    assert 0.7 <= ratios.min() < 0.99
    assert ratios.max() <= 1.3
    assert (loads["known"].payload, loads["tool"].payload) == (truth.payload, 0.0)
    assert [effect.name for effect in arms["tool"].effects] == ["tool_mass"]
    lean = spatial_cells.leaning(truth, rng).gravity
    assert np.linalg.norm(lean) == pytest.approx(9.81)
    assert 1.0 <= np.degrees(np.arccos(-lean[2] / 9.81)) <= 3.0


def test_reflectors_take_turns() -> None:
    data = data_set("space, none, two reflectors", 900).measurements
    assert data.marker is not None
    assert data.marker.tolist() == ["1", "2"] * 30
    np.testing.assert_array_equal(data.postures[::2], data.postures[1::2])
    assert not np.allclose(data.positions[::2], data.positions[1::2])


def test_a_load_elsewhere_is_of_the_size_asked_for() -> None:
    """Beside compliances fitted with the load at the reflector, its place lowers chi-square by 64, give or take; and
    the program's model at the true values is the simulator's arm."""
    changes = []
    for number in NUMBERS:
        data = data_set("space, gravity, load elsewhere", number)
        squares = [
            base_fit(data, data.arm.with_effects(*(EffectSpec(name) for name in names)))
            for names in (("joint_compliance",), ("joint_compliance", "payload_place"))
        ]
        changes.append(squares[0] - squares[1])
    assert np.mean(changes) == pytest.approx(64.0 + 3.0, abs=3.0 * 17.0 / np.sqrt(len(changes)))
