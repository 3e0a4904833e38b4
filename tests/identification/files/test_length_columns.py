"""Measurement and arm files of instruments that read no positions: distances, contacts, and what is wrong with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification.arm import Arm
from identification.errors import InputError
from identification.files.arm import dump_arm, load_arm
from identification.files.measurement import measurement_text
from identification.instruments import Distance, PlanarDistance, Plane, Sphere
from identification.kinematics.chain import DHRow, chain_of
from identification.measurements import load_measurements

CHAIN = chain_of([DHRow(300.0, 0.0, 10.0), DHRow(200.0, 1.0, 0.0)])
BAR, BALL, FACE = (Arm(replace(CHAIN, instrument=one)) for one in (Distance(), Sphere(12.5), Plane()))
HEAD = 'kind = "spatial"\n[[dh]]\na_mm = 300.0\nalpha_deg = 0.0\nd_mm = 10.0\n'


def saved(folder: Path, text: str, name: str = "data.csv") -> Path:
    (folder / name).write_text(text)
    return folder / name


def test_distances(tmp_path: Path) -> None:
    data = load_measurements(saved(tmp_path, "q1_deg,q2_deg,distance_mm,session\n30,50,412.5,a\n-90,7,300,b\n"), BAR)
    np.testing.assert_array_equal(data.positions, [[412.5], [300.0]])
    assert data.dimension == 1
    assert data.sessions == ("a", "b")
    again = load_measurements(saved(tmp_path, measurement_text(data)), BAR)
    np.testing.assert_array_equal(again.positions, data.positions)
    metres = load_measurements(saved(tmp_path, "q1_deg,q2_deg,distance_m\n30,50,0.4125\n"), BAR)
    assert metres.positions[0, 0] == pytest.approx(412.5)


def test_a_plan_of_contacts_is_not_taken_for_contacts_without_a_word(tmp_path: Path) -> None:
    """A plan has the joints that it asks for: as contacts they fit what it was made with, to rounding."""
    with pytest.warns(UserWarning, match="has the column run and no order, as a plan does"):
        load_measurements(saved(tmp_path, "run,q1_deg,q2_deg\n1,30,50\n2,-90,7\n"), BALL)
    load_measurements(saved(tmp_path, "run,order,q1_deg,q2_deg\n1,1,30,50\n2,2,-90,7\n"), BALL)  # warnings are errors


@pytest.mark.parametrize(("arm", "length"), [(BALL, 12.5), (FACE, 0.0)], ids=["sphere", "plane"])
def test_contacts(tmp_path: Path, arm: Arm, length: float) -> None:
    """Joints alone; every surface is a session of its own."""
    data = load_measurements(saved(tmp_path, "q1_deg,q2_deg,surface\n30,50,left\n-90,7,top\n"), arm)
    np.testing.assert_array_equal(data.positions, [[length], [length]])
    assert data.sessions == ("left", "top")
    both = load_measurements(saved(tmp_path, "q1_deg,q2_deg,surface,session\n30,50,left,mon\n"), arm)
    assert both.session is not None
    assert both.session.tolist() == ["mon/left"]
    assert load_measurements(saved(tmp_path, "q1_deg,q2_deg\n30,50\n"), arm).session is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("q1_deg,q2_deg,x_mm\n1,2,3\n", "column 'distance_mm' is missing, found: q1_deg, q2_deg, x_mm"),
        (
            "q1_deg,q2_deg,distance_mm\n1,2,-3\n",
            r"row 1 \(line 2\), column distance_mm: found '-3', allowed: a number > 0",
        ),
        ("q1_deg,q2_deg,distance_mm\n1,2,\n", "column distance_mm: found an empty cell"),
        ("q1_deg,q2_deg,distance_mm,distance_m\n1,2,3,4\n", "found both distance_mm and distance_m"),
    ],
)
def test_wrong_distances(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_measurements(saved(tmp_path, text), BAR)


def test_an_empty_surface(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="column surface: found an empty cell, allowed: a name"):
        load_measurements(saved(tmp_path, "q1_deg,q2_deg,surface\n1,2,\n"), FACE)


def test_a_surface_is_no_column_of_others(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="columns are not used: 'surface'|column is not used: 'surface'"):
        load_measurements(saved(tmp_path, "q1_deg,q2_deg,distance_mm,surface\n1,2,3,top\n"), BAR)


def test_arm_files(tmp_path: Path) -> None:
    text = f'{HEAD}[instrument]\nkind = "distance"\ncenter_mm = [700.0, -200.0, 300.0]\n'
    arm = load_arm(saved(tmp_path, text, "arm.toml"))
    assert arm.chain is not None
    assert arm.chain.instrument == Distance()
    np.testing.assert_array_equal(arm.chain.base[:3, 3], [-700.0, 200.0, -300.0])
    assert not arm.chain.settled
    ball = load_arm(saved(tmp_path, f'{HEAD}[instrument]\nkind = "sphere"\nradius_mm = 12.5\n', "arm.toml"))
    unknown = load_arm(saved(tmp_path, f'{HEAD}[instrument]\nkind = "sphere"\n', "arm.toml"))
    assert unknown.chain is not None
    assert unknown.chain.instrument == Sphere()
    for given in (arm, ball, unknown):
        again = load_arm(saved(tmp_path, dump_arm(given), "again.toml"))
        assert again.chain is not None
        assert given.chain is not None
        assert again.chain.instrument == given.chain.instrument
        np.testing.assert_allclose(again.chain.base, given.chain.base)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (
            'kind = "tracker"',
            "instrument.kind: found 'tracker' for a spatial arm, allowed: distance, plane, socket, sphere",
        ),
        ('kind = "distance"\nradius_mm = 3.0', "instrument.radius_mm: found for kind distance, allowed: for sphere"),
        ('kind = "plane"\nradius_mm = 3.0', "instrument.radius_mm: found for kind plane"),
        ('kind = "sphere"\nradius_mm = -3.0', "instrument.radius_mm: found -3.0, allowed: > 0"),
        ('kind = "plane"\ncenter_mm = [1.0, 2.0, 3.0]', "instrument.normal: is missing beside center_mm"),
        ('kind = "sphere"\nnormal = [1.0, 2.0, 3.0]', "instrument.normal: found for kind sphere, allowed: for plane"),
        ('kind = "plane"\nnormal = [1.0, 2.0, 3.0]', "instrument.center_mm: is missing beside normal"),
        (
            'kind = "plane"\ncenter_mm = [1.0, 2.0, 3.0]\nnormal = [0, 0, 0]',
            "instrument.normal: found .0, 0, 0., allowed: a direction",
        ),
        ('kind = "distance"\ncenter_mm = [1.0, 2.0]', "instrument.center_mm: found .1.0, 2.0., allowed: three numbers"),
        ('kind = "distance"\nmiddle_mm = 3.0', "instrument.middle_mm: unknown key"),
        ('kind = "distance"\ncenter_mm = [1.0, 2.0, 3.0]\n[base]\nx_mm = 1.0', "instrument.center_mm: found beside"),
        ('kind = "distance"\n[measurement]\nsigma_mm = 1.0\nsigma_deg = 1.0', "sigma_deg: found beside"),
    ],
)
def test_wrong_arm_files(tmp_path: Path, lines: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_arm(saved(tmp_path, f"{HEAD}[instrument]\n{lines}\n", "arm.toml"))


def test_where_a_plane_is(tmp_path: Path) -> None:
    """Its point is at height zero, and so is what lies beside it across the normal."""
    lines = '[instrument]\nkind = "plane"\ncenter_mm = [100.0, 20.0, -50.0]\nnormal = [0.0, 3.0, 4.0]\n'
    arm = load_arm(saved(tmp_path, HEAD + lines, "arm.toml"))
    assert arm.chain is not None
    base = arm.chain.base
    for point, height in (([100, 20, -50], 0.0), ([300, 24, -53], 0.0), ([100, 23, -46], 5.0)):
        assert base[2, :3] @ point + base[2, 3] == pytest.approx(height, abs=1e-9)
    np.testing.assert_allclose(base[:3, :3] @ base[:3, :3].T, np.eye(3), atol=1e-12)


def test_planar_arms_have_distances_alone(tmp_path: Path) -> None:
    bar = 'links_mm = [300.0, 200.0]\n[instrument]\nkind = "distance"\ncenter_mm = [400.0, 100.0]\n'
    arm = load_arm(saved(tmp_path, bar, "arm.toml"))
    assert arm.chain.instrument == PlanarDistance((("1", (400.0, 100.0)),))
    assert load_arm(saved(tmp_path, dump_arm(arm), "again.toml")).chain == arm.chain
    data = load_measurements(saved(tmp_path, "q1_deg,q2_deg,distance_mm,session\n30,50,412.5,a\n-90,7,300,b\n"), arm)
    np.testing.assert_array_equal(data.positions, [[412.5], [300.0]])
    assert data.marker_names == data.sessions == ("a", "b")  # each with a center of its own
    text = measurement_text(data, instrument=arm.chain.instrument)
    again = load_measurements(saved(tmp_path, text), arm)
    assert replace(again, provenance=data.provenance) == data
    for lines, said in (
        ('kind = "sphere"\n', "instrument.kind: found 'sphere' for a planar arm, allowed: distance"),
        ('kind = "distance"\ncenter_mm = [1.0, 2.0, 3.0]\n', "center_mm: found .1.0, 2.0, 3.0., allowed: two numbers"),
        ('kind = "distance"\n[[effects]]\nname = "base_offset"\n', "base_offset is of measured positions, found an"),
    ):
        with pytest.raises(InputError, match=said):
            load_arm(saved(tmp_path, f"links_mm = [300.0]\n[instrument]\n{lines}", "arm.toml"))


@pytest.mark.parametrize("arm", [BAR, BALL, FACE])
def test_positions_of_a_tracker_are_not_read_by_a_probe(tmp_path: Path, arm: Arm) -> None:
    path = saved(tmp_path, "q1_deg,q2_deg,distance_mm,x_mm,y_mm,z_mm\n30,50,412.5,1,2,3\n")
    kind = arm.chain.instrument.kind
    with pytest.warns(
        UserWarning,
        match=rf"'x_mm'.*; \[instrument\] {kind} of the arm file reads no positions; for a tracker leave it out",
    ):
        load_measurements(path, arm)
