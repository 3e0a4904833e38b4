"""Measurement, plan and target files of spatial arms: three coordinates, markers, prismatic joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from doe.plan.plan import Plan, load_plan, plan_text
from identification.arm import Arm
from identification.errors import InputError
from identification.files.measurement import commands_text, load_targets, measurement_text
from identification.kinematics.chain import DHRow, chain_of
from identification.measurements import load_measurements

ARM = Arm(chain_of([DHRow(300.0, 0.0, 10.0), DHRow(0.0, 0.0, 0.0, type="prismatic", limits=(0.0, 100.0))]))
PLAIN = "q1_deg,q2_mm,x_mm,y_mm,z_mm,marker\n30,50,1,2,3,top\n-90,7.5,4,5,6,side\n"


def saved(folder: Path, text: str) -> Path:
    (folder / "data.csv").write_text(text)
    return folder / "data.csv"


def test_round_trip(tmp_path: Path) -> None:
    data = load_measurements(saved(tmp_path, PLAIN), ARM)
    np.testing.assert_allclose(data.postures, [[np.pi / 6.0, 50.0], [-np.pi / 2.0, 7.5]])
    np.testing.assert_array_equal(data.positions, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    assert data.marker_names == ("top", "side")
    again = load_measurements(saved(tmp_path, measurement_text(data, ARM.joint_types)), ARM)
    np.testing.assert_allclose(again.postures, data.postures, rtol=1e-14)
    np.testing.assert_array_equal(again.positions, data.positions)
    assert again.marker is not None
    assert again.marker.tolist() == ["top", "side"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("z_mm", "height_mm", "column 'z_mm' is missing, found: q1_deg, q2_mm, x_mm, y_mm, height_mm, marker"),
        ("q2_mm", "q2_deg", "column 'q2_mm' is missing"),
        ("q2_mm,", "", "column 'q2_mm' is missing"),
        ("marker", "q3_deg", "found column q3_deg, but the arm has 2 links, allowed: q1_deg to q2_mm"),
        ("marker", "q2_m", "found both q2_mm and q2_m, allowed: one of them"),
        ("marker", "z_m", "found both z_mm and z_m, allowed: one of them"),
        ("side", "", "row 2 (line 3), column marker: found an empty cell, allowed: a name"),
        (",6,", ",,", "row 2 (line 3), column z_mm: found an empty cell"),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = PLAIN.replace(old, new)
    rows = [line.split(",")[: text.split("\n")[0].count(",") + 1] for line in text.splitlines()]
    with pytest.raises(InputError) as error:
        load_measurements(saved(tmp_path, "\n".join(map(",".join, rows)).replace("top", "1") + "\n"), ARM)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_plans_and_targets(tmp_path: Path) -> None:
    plan = Plan(np.array([[0.5, 50.0], [-0.5, 20.0]]))
    text = plan_text(plan, ARM.joint_types)
    assert text.startswith("run,q1_deg,q2_mm\n")
    np.testing.assert_allclose(load_plan(saved(tmp_path, text), ARM.joint_types).postures, plan.postures)
    positions = np.array([[1.0, 2.0, 3.0]])
    text = commands_text(plan.postures[:1], positions, np.zeros(1), ARM.joint_types)
    assert text.startswith("q1_deg,q2_mm,x_mm,y_mm,z_mm,error_mm\n")
    found = load_targets(saved(tmp_path, text.replace("error_mm", "run")), ARM)
    assert found.positions is not None
    assert found.postures is not None
    np.testing.assert_allclose(found.positions, positions)
    np.testing.assert_allclose(found.postures, plan.postures[:1])
    in_metres = load_targets(saved(tmp_path, "x_m,y_m,z_mm\n0.001,0.002,3\n"), ARM)
    assert in_metres.positions is not None
    np.testing.assert_allclose(in_metres.positions, positions)
