"""`armcal check` and `armcal identify`: what is said first, priors, what stays as it was, rows that are left out."""

import re
import tomllib

import numpy as np
import polars as pl
import pytest

from tests.doe.cli.conftest import ARM, CALIBRATION, Folder

ECCENTRIC = '\n[[effects]]\nname = "encoder_eccentricity"\njoint = 2\na_deg = 0.2\nb_deg = 0.1\n'
IDENTIFY = "identify arm.toml data.csv"


def some(folder: Folder, **files: list[int]) -> None:
    """Write some rows of data.csv, NAME -> numbers from 0."""
    frame = pl.read_csv(folder.path / "data.csv")
    for name, rows in files.items():
        frame[rows].write_csv(folder.path / f"{name}.csv")


# -- check -------------------------------------------------------------------------------------------------------------
def test_simulated_data_are_fine(folder: Folder) -> None:
    folder.simulated()
    found = folder.said("check arm.toml data.csv")
    assert set(found) >= {"rows", "postures", "rms_drawing_mm", "rms_fitted_mm", "better_reading", "notes"}
    assert (found["problems"], found["ok"]) == ([], True)
    assert [joint["limit_high"] for joint in found["joints"]] == pytest.approx([180.0, 120.0, 60.0, 90.0])
    text = folder.armcal("check arm.toml data.csv").out
    assert "No problems found in these data." in text
    limits = [line.split()[3:5] for line in text.splitlines() if line.split()[5:6] == ["deg"]]
    assert limits == [["none", "none"], ["-120.00", "120.00"], ["-100.00", "60.00"], ["-90.00", "90.00"]]
    assert "armcal identify arm.toml data.csv --out" in text
    folder.write("wide.toml", ARM.replace("links_mm", "link_width_mm = 150.0\nlinks_mm", 1))
    said = folder.armcal("check wide.toml data.csv").out
    assert "No problems found in these data besides the collisions below" in said
    # repeats that are read back with other digits are no further postures
    frame = pl.read_csv(folder.path / "data.csv")
    again = pl.concat([frame, frame.with_columns(pl.col("q2_deg") + 0.002, pl.col("order") + len(frame))])
    again.write_csv(folder.path / "again.csv")
    postures = found["postures"]
    words = folder.armcal("check wide.toml again.csv").flat
    assert f"{2 * len(frame)} rows, {postures} postures" in words
    assert f"of {postures} postures bodies are too close" in words


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
    plain = folder.said(IDENTIFY)
    pl.read_csv(folder.path / "data.csv").with_columns(**columns).write_csv(folder.path / "data.csv")
    found = folder.said("check arm.toml data.csv")
    assert not found["ok"]
    assert found["better_reading"]["arm_file"].splitlines() == ["[joints]", *lines]
    printed = [line.strip() for line in folder.armcal("check arm.toml data.csv").out.splitlines()]
    assert printed[printed.index("[joints]") + 1] == lines[0]
    folder.write("wide.toml", ARM.replace("links_mm", "link_width_mm = 20.0\nlinks_mm", 1))
    assert "misread" in folder.armcal("check wide.toml data.csv").out.splitlines()[-1]  # and no list of collisions
    head, _, rest = ARM.partition("[joint_limits_deg]")  # these are the controller's then: of another column here
    folder.write("arm.toml", "\n".join([head, "[joints]", *lines, rest[rest.index("\n[") :]]))
    assert folder.said("check arm.toml data.csv")["ok"]
    values, usual = ([row["value"] for row in run["parameters"]] for run in (folder.said(IDENTIFY), plain))
    assert values == pytest.approx(usual, abs=1e-6)


# -- identify ----------------------------------------------------------------------------------------------------------
def test_misfit_is_the_first_line_a_warning_and_in_json(folder: Folder) -> None:
    folder.write("truth.toml", ARM + ECCENTRIC + CALIBRATION)
    folder.simulated()
    done = folder.armcal(IDENTIFY)
    assert (done.code, done.err) == (0, "")  # said once
    assert done.out.startswith("misfit: the residuals scatter ")
    with_json = folder.armcal(f"{IDENTIFY} --json")
    assert "armcal: warning: misfit: " in with_json.err
    assert with_json.data["intervals"] in ("sandwich", "scatter")
    assert with_json.data["warnings"][0].startswith("misfit: ")


def test_an_implausible_fit_is_not_written(folder: Folder) -> None:
    folder.simulated()
    pl.read_csv(folder.path / "data.csv").with_columns(pl.col("x_mm") + 2500.0).write_csv(folder.path / "data.csv")
    done = folder.armcal(f"{IDENTIFY} --out calibrated.toml")
    assert done.code == 1
    assert "calibrated.toml was not written: the fit is implausible" in done.out
    assert not (folder.path / "calibrated.toml").exists()


def test_commands_beside_readings(folder: Folder) -> None:
    """A controller that leaves a joint 0.02 deg beside its command: said, kept in the file, taken off the commands."""
    folder.write("arm.toml", ARM + "[joints]\nsign = [1, -1, 1, 1]\n")  # columns and commands
    folder.write("truth.toml", ARM + CALIBRATION + '[[effects]]\nname = "servo_error"\njoint = 2\nb_deg = 0.02\n')
    folder.simulated()
    found = folder.said(f"{IDENTIFY} --out calibrated.toml")
    assert [error["offset"] for error in found["servo_error"]] == pytest.approx([0.0, 0.02, 0.0, 0.0], abs=1e-9)
    assert "read minus commanded, as the drawing counts: offset" in folder.armcal(IDENTIFY).flat
    folder.write("targets.csv", "x_mm,y_mm\n300,150\n")
    commands = folder.said("compensate calibrated.toml targets.csv")["commands_deg"]
    text, count = re.subn(r"(?m)^b_deg = 0.0(1999|2)\d*", "b_deg = 0.05", folder.read("calibrated.toml"))
    assert (count, text.count("servo_error")) == (1, 1)
    folder.write("calibrated.toml", text)
    others = folder.said("compensate calibrated.toml targets.csv")["commands_deg"]
    np.testing.assert_allclose(np.subtract(others, commands), [[0.0, 0.03, 0.0, 0.0]], atol=1e-6)


def test_what_stays_keeps_its_angles_and_its_data(folder: Folder) -> None:
    """The range of two files is that of all their rows, a joint read a whole turn away included, also where one is the
    prior of the other; with nothing kept it is that of the new rows. `validate` then knows the old rows, and finds none
    of them outside."""
    folder.simulated()
    folder.said(f"{IDENTIFY} --out calibrated.toml")
    frame = pl.read_csv(folder.path / "data.csv")
    frame[:6].with_columns(pl.col("q1_deg") + 360.0).write_csv(folder.path / "few.csv")
    old = frame["q1_deg"].to_numpy()
    for words, kept in (("--only joint_offset:2", True), ("--prior-from calibrated.toml", True), ("", False)):
        folder.armcal(f"identify calibrated.toml few.csv {words} --out again.toml --force")
        found = tomllib.loads(folder.read("again.toml"))["calibration"]["provenance"]
        assert (found["file"], found["rows"]) == ("few.csv", 6)
        expected = [old.min(), old.max()] if kept else [old[:6].min() + 360.0, old[:6].max() + 360.0]
        np.testing.assert_allclose(found["joint_range_deg"][0], expected, atol=1e-6)
        assert ("held_from" in found) is kept
        if kept:
            assert found["held_from"]["data.csv"]["rows"] == len(old)
            (note,) = folder.said("validate again.toml data.csv")["notes"]
            assert note.startswith("the model was identified from these measurements:")


def test_a_prior_is_the_library_and_a_file(folder: Folder) -> None:
    folder.simulated()
    folder.said(f"{IDENTIFY} --out calibrated.toml")
    flag = folder.said("identify arm.toml data.csv --library-prior --missing backlash")
    assert flag["prior"]["effects"] == [f"backlash:{j}" for j in (1, 2, 3, 4)]
    assert flag["offered"]["better"] is False  # no effect is there, and four more can only harm
    folder.simulated("again.csv", seed=2)
    again = "arm.toml again.csv"
    named = f"identify {again} --prior-from calibrated.toml"
    found = folder.said(named)
    assert found["prior_from"]["file"] == "calibrated.toml"
    assert (len(found["prior_from"]["parameters"]), found["prior_from"]["contradicted"]) == (8, [])
    alone = folder.said(f"identify {again}")
    for with_prior, without in zip(found["parameters"], alone["parameters"], strict=True):
        assert with_prior["std"] == pytest.approx(without["std"] / np.sqrt(2.0), rel=0.1)  # the same plan, twice
    both = folder.said(f"{named} --library-prior --missing backlash")
    assert (both["prior"]["parameters"], both["prior_from"]["anew"]) == (4, [])
    assert "found no covariance" in folder.armcal(named.replace("calibrated", "arm")).err


def test_rows_that_the_prior_comes_from_do_not_count_twice(folder: Folder) -> None:
    """The same file, some of its rows in another order, and by way of a second calibration."""
    folder.simulated()
    folder.simulated("again.csv", seed=1)
    folder.said(f"{IDENTIFY} --out calibrated.toml")
    some(folder, some=np.random.default_rng(3).permutation(12).tolist()[:5])
    for name in ("data", "some"):
        line = f"identify arm.toml {name}.csv --prior-from calibrated.toml --out twice.toml"
        folder.refused(line, "calibrated.toml: prior: ", "count twice, allowed: new measurements")
    assert folder.armcal("identify arm.toml again.csv --prior-from calibrated.toml --out both.toml").err == ""
    for name in ("some", "again"):
        folder.refused(f"identify arm.toml {name}.csv --prior-from both.toml")


def test_lost_beams_are_named_and_left_out(folder: Folder) -> None:
    """The same as without their lines; rows keep their numbers."""
    folder.plan(24, 4)
    folder.simulated()
    number = pl.int_range(1, 25)
    far = pl.when(number.is_in([3, 8])).then(pl.col("x_mm") + 7.0).otherwise(pl.col("x_mm"))
    pl.read_csv(folder.path / "data.csv").with_columns(x_mm=far).write_csv(folder.path / "far.csv")
    some(folder, without=[k for k in range(24) if k + 1 not in (3, 8)])
    said = folder.said("identify arm.toml far.csv")
    assert said["outlier_rows"] == [3, 8]
    left, expected = (folder.said(f"identify arm.toml {name}.csv --without-outliers") for name in ("far", "without"))
    assert (left.pop("left_out"), expected.pop("left_out")) == ([3, 8], [])
    assert left["parameters"] == expected["parameters"]
    before = ("rms_drawing_mm", "cross_validated_mm")  # of the same rows as what is left after the fit
    assert [left[key] for key in before] == [expected[key] for key in before]
    assert left["rms_drawing_mm"] < 0.9 * said["rms_drawing_mm"]
