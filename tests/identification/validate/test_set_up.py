"""A reflector that was mounted anew between sessions, simulated by the six-axis arm's own kinematics in numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification import REVOLUTE, Arm, Identification, InputError, Measurements, Model, Status, estimate
from identification.inspection.readings import read_differently
from identification.kinematics.chain import DHRow, KinematicChain, chain_of
from identification.sessions import pooled_sessions, with_sessions
from identification.validate import validate
from tests.doe.six_axis import CHAIN, REFLECTOR
from tests.identification.kinematics.test_spatial import tip_by_exponentials

NOISE = 0.02  # [mm]
POINTS = {"A": REFLECTOR, "B": np.array([-90.0, 70.0, 120.0])}
ARM = Arm(replace(CHAIN, tools={"1": np.zeros(3)}), name="six-axis")
MOVED = np.array([1.0, -0.5, 2.0])
SLIDE = DHRow(275.0, np.pi, 0.0, type="prismatic", limits=(0.0, 200.0))
SCARA = chain_of([DHRow(0.0, 0.0, 300.0), DHRow(325.0, 0.0, 0.0), SLIDE, DHRow(0.0, 0.0, 50.0)], "modified")


def cell(
    sessions: int,
    moved: dict[tuple[int, str], np.ndarray],
    seed: int,
    marked: bool = True,
    chain: KinematicChain = CHAIN,
) -> Measurements:
    """Sessions of 30 postures with one or both of the points, of an arm that is off by some tenths, set up anew each
    time; points moved by (session, name)."""
    generator = np.random.default_rng(seed)
    errors = {f"translation_{axis}:{j}": generator.normal(0.0, 0.2) for j in range(2, len(chain) + 1) for axis in "xz"}
    limits = np.transpose([(-2.0, 2.0) if j.type == REVOLUTE else (j.lower, j.upper) for j in chain.joints])
    tables = {}
    for k in range(sessions):
        turn, shift = Rotation.random(random_state=generator).as_matrix(), generator.uniform(-2e3, 2e3, 3)
        q = np.repeat(generator.uniform(*limits, (30, len(chain))), 2 if marked else 1, axis=0)
        names = np.tile(["A", "B"] if marked else ["A"], 30)
        tools = [POINTS[name] + moved.get((k, name), 0.0) for name in names]
        tips = np.array([tip_by_exponentials(chain, row, errors, tool) for row, tool in zip(q, tools, strict=True)])
        positions = tips @ turn.T + shift + NOISE * generator.standard_normal(tips.shape)
        tables[f"day {k + 1}"] = Measurements(q, positions, marker=names if marked else None)
    return pooled_sessions(tables)


def fit(data: Measurements) -> Identification:
    return estimate(Model(with_sessions(ARM, data)), data)


def test_three_sessions_converge() -> None:
    """Two of the reflectors mounted elsewhere in between, which the fit takes for the same points."""
    assert fit(cell(3, {(1, "A"): MOVED, (2, "B"): -MOVED}, seed=3)).status is Status.converged


def test_a_point_that_nothing_holds_stays_near_the_arm() -> None:
    """Two places of a reflector fitted as one: the sum of squares of a SCARA falls with its height, without an end."""
    away = np.random.default_rng(2).uniform(-15.0, 15.0, 3)
    data, arm = cell(2, {(1, "A"): away}, 2, marked=False, chain=SCARA), Arm(SCARA)

    def fit(data: Measurements) -> Identification:
        return estimate(Model(with_sessions(arm, data)), data)

    assert fit(data).status is Status.converged


def test_validation_finds_points_that_the_calibration_does_not_have() -> None:
    """Of two reflectors, calibrated on one day and another day measured by others, or by one that has no name."""
    data = cell(2, {(1, "A"): 30.0 * MOVED, (1, "B"): -20.0 * MOVED}, seed=5)
    first, second = (replace(data.rows(rows), session=None, session_names=()) for rows in data.session_rows)
    found = fit(first)
    arm = replace(found.model.arm, calibration=found.calibration())
    assert second.marker is not None
    renamed = replace(second, marker=np.char.add("new ", second.marker), marker_names=())
    only_a = second.rows(np.flatnonzero(second.marker == "A"))
    unnamed = replace(only_a, marker=None, marker_names=())
    for rows, said in (
        (renamed, "the calibration has no reflector new A, new B: their positions were fitted to these rows"),
        (unnamed, "no column marker: the rows are taken as of one reflector, whose position was fitted to them"),
    ):
        validated = validate(arm, rows)
        # as in the data of the fit, and what its 30 parameters from 180 equations add
        assert validated.model.rms < 1.5 * found.rms_after
        assert any(note.startswith(said) for note in validated.notes)
        with pytest.raises(InputError, match=r"measurements.*marker.*; or --refit base"):
            validate(arm, rows, "none")
    assert not any("reflector" in note for note in validate(arm, second).notes)
    read = read_differently(arm, replace(unnamed, positions=10.0 * unnamed.positions), search=False)
    assert read.certain  # a file is looked at before it is validated
    assert "times those of the arm file" in read.sentences[0]
