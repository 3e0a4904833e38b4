"""`armcal check` as a user runs it, in the plane and in space."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.doe.cli.conftest import Folder
from tests.small_arm import MASSES, OTHERS, as_csv, measured, random_postures, small_arm, urdf

DATA = Path(__file__).parents[2] / "data/ur10"
KEYS = {"rows", "postures", "joints", "rms_drawing_mm", "rms_fitted_mm", "better_reading", "problems", "notes"}


def test_simulated_data_are_fine(folder: Folder) -> None:
    folder.simulated()
    done = folder.armcal("check", "arm.toml", "data.csv", "--json")
    assert done.code == 0, done.err
    assert set(done.data) >= KEYS
    assert done.data["problems"] == []
    assert done.data["ok"] is True
    assert [joint["limit_high"] for joint in done.data["joints"]] == pytest.approx([180.0, 120.0, 60.0, 90.0])
    text = folder.armcal("check", "arm.toml", "data.csv").out
    assert "No problems found in these data." in text
    limits = [line.split()[3:5] for line in text.splitlines() if line.split()[5:6] == ["deg"]]
    assert limits == [["none", "none"], ["-120.00", "120.00"], ["-100.00", "60.00"], ["-90.00", "90.00"]]
    assert "armcal identify arm.toml data.csv --out" in text


@pytest.mark.parametrize(
    ("columns", "lines"),
    [
        ({"q3_deg": -pl.col("q3_deg")}, ["sign = [1, 1, -1, 1]"]),
        ({"q3_deg": pl.col("q2_deg") + pl.col("q3_deg")}, ["coupled_to = [0, 0, 2, 0]"]),
        ({"q2_deg": pl.col("q2_deg") + 90.0}, ["zero_deg = [0.0, 90.0, 0.0, 0.0]"]),
        (
            {f"q{j}_deg": pl.sum_horizontal(*(f"q{k}_deg" for k in range(1, j + 1))) for j in (2, 3, 4)},
            ["coupled_to = [0, 1, 2, 3]"],
        ),
    ],
)
def test_a_controller_that_counts_otherwise(folder: Folder, columns: dict[str, pl.Expr], lines: list[str]) -> None:
    """What check prints under [joints] makes the same data those of the arm, and the fit to them that of plain data."""
    folder.simulated()
    plain = folder.armcal("identify", "arm.toml", "data.csv", "--json").data
    frame = pl.read_csv(folder.path / "data.csv")
    frame.with_columns(**columns).write_csv(folder.path / "data.csv")
    found = folder.armcal("check", "arm.toml", "data.csv", "--json").data
    assert not found["ok"]
    assert found["better_reading"]["arm_file"].splitlines() == ["[joints]", *lines]
    printed = [line.strip() for line in folder.armcal("check", "arm.toml", "data.csv").out.splitlines()]
    assert printed[printed.index("[joints]") + 1] == lines[0]
    bare = folder.read("arm.toml")
    head, _, rest = bare.partition("[joint_limits_deg]")  # these are the controller's then: of another column here
    folder.write("arm.toml", "\n".join([head, "[joints]", *lines, rest[rest.index("\n[") :]]))
    assert folder.armcal("check", "arm.toml", "data.csv", "--json").data["ok"]
    again = folder.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml", "--json").data
    values, usual = ([row["value"] for row in run["parameters"]] for run in (again, plain))
    assert values == pytest.approx(usual, abs=1e-6)


def test_six_axes(folder: Folder) -> None:
    done = folder.armcal("check", str(DATA / "ur10.toml"), str(DATA / "series_A.csv"), "--json")
    assert done.code == 0, done.err
    assert done.data["rows"] == 596
    assert done.data["problems"] == []
    assert done.data["rms_fitted_mm"] < 0.5 < 0.8 < done.data["rms_drawing_mm"] < 0.9


def test_an_arm_that_sags_is_told_what_to_add(folder: Folder) -> None:
    """The lines printed, appended to the arm file, are what `diagnose` needs; with masses in the URDF file those."""
    rng = np.random.default_rng(11)
    data = measured(small_arm(rng, *OTHERS), random_postures(60, rng), rng)
    folder.write("arm.urdf", urdf())
    folder.write("data.csv", as_csv(data))
    head = 'name = "small"\nkind = "spatial"\nurdf = "arm.urdf"\nbase_link = "base_link"\ntip_link = "tip"\n'
    folder.write("arm.toml", head)
    done = folder.armcal("check", "arm.toml", "data.csv")
    found = folder.armcal("check", "arm.toml", "data.csv", "--json").data["gravity"]
    assert found["recommended"] is True
    assert (found["masses_from"], found["masses_kg"]) == ("urdf", MASSES.tolist())
    assert found["rms_after_mm"] < 0.6 * found["rms_before_mm"]
    assert "\n" + "\n".join(found["lines"]) + "\n" in re.sub(r" +\n", "\n", done.out)
    assert "z of the base is taken to point up" in " ".join(done.out.split())
    folder.write("arm.toml", head + "\n".join(found["lines"]) + "\n")
    again = folder.armcal("check", "arm.toml", "data.csv", "--json").data
    assert again["gravity"] is None
    assert not any("gravity" in note for note in again["notes"])
