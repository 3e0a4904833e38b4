"""What `armcal identify` says first: misfit, another frame, postures outside the limits; and `--sigma`."""

from __future__ import annotations

import csv
import re
import tomllib

import numpy as np
import pytest

from tests.doe.cli.conftest import ARM, CALIBRATION, Folder

ECCENTRIC = '\n[[effects]]\nname = "encoder_eccentricity"\njoint = 2\na_deg = 0.2\nb_deg = 0.1\n'


def moved(folder: Folder) -> None:
    """Write tracker.csv: data.csv in a frame that is turned by 70 degrees and shifted."""
    with (folder.path / "data.csv").open() as file:
        rows = list(csv.DictReader(file))
    turn, shift = np.exp(1j * np.radians(70.0)), 2500.0 - 800.0j
    for row in rows:
        place = turn * complex(float(row["x_mm"]), float(row["y_mm"])) + shift
        row["x_mm"], row["y_mm"] = f"{place.real:.4f}", f"{place.imag:.4f}"
    lines = [",".join(rows[0]), *(",".join(row.values()) for row in rows)]
    folder.write("tracker.csv", "\n".join(lines) + "\n")


def test_misfit_is_the_first_line_a_warning_and_in_json(folder: Folder) -> None:
    folder.write("truth.toml", ARM + ECCENTRIC + CALIBRATION)
    folder.simulated()
    done = folder.armcal("identify", "arm.toml", "data.csv")
    assert done.code == 0
    assert done.out.startswith("misfit: the residuals scatter ")
    assert done.err == ""  # said once
    with_json = folder.armcal("identify", "arm.toml", "data.csv", "--json")
    assert "armcal: warning: misfit: " in with_json.err
    found = with_json.data
    assert found["intervals"] in ("sandwich", "scatter")
    assert found["warnings"][0].startswith("misfit: ")
    given = folder.armcal("identify", "arm.toml", "data.csv", "--sigma", "given", "--json").data
    assert (given["intervals"], given["sigma_mm"], given["clusters"]) == ("given", 0.1, None)
    free = folder.armcal("identify", "arm.toml", "data.csv", "--sigma", "estimated", "--json").data
    assert (free["intervals"], free["chi2"], free["warnings"]) == ("scatter", None, [])
    assert free["sigma_mm"] == pytest.approx(given["scatter_mm"])
    widths = [[p["high_95"] - p["low_95"] for p in kind["parameters"]] for kind in (given, free)]
    assert all(narrow < wide for narrow, wide in zip(*widths, strict=True))


def test_data_in_the_frame_of_a_tracker(folder: Folder) -> None:
    folder.simulated()
    moved(folder)
    words = ["identify", "arm.toml", "tracker.csv", "--out", "calibrated.toml"]
    done = folder.armcal(*words)
    assert done.code == 1
    assert done.out.startswith("implausible: the fit leaves ")
    assert 'add [[effects]] name = "base_offset"' in " ".join(done.out.split())
    assert "calibrated.toml was not written: the fit is implausible" in done.out
    assert not (folder.path / "calibrated.toml").exists()
    assert folder.armcal("identify", "arm.toml", "tracker.csv", "--json").data["status"] == "implausible"
    folder.write("arm.toml", ARM + '[[effects]]\nname = "base_offset"\n')
    done = folder.armcal(*words)
    assert (done.code, done.err) == (0, "")


def test_commands_beside_readings(folder: Folder) -> None:
    """A controller that leaves a joint 0.02 deg beside its command: said, kept in the file, taken off the commands."""
    folder.write("truth.toml", ARM + CALIBRATION + '[[effects]]\nname = "servo_error"\njoint = 2\nb_deg = 0.02\n')
    folder.simulated()
    assert "commanded4_deg" in folder.read("data.csv").splitlines()[0]
    done = folder.armcal("identify", "arm.toml", "data.csv", "--json", "--out", "calibrated.toml")
    assert done.code == 0, done.err
    offsets = [error["offset"] for error in done.data["servo_error"]]
    assert offsets == pytest.approx([0.0, 0.02, 0.0, 0.0], abs=1e-9)
    assert "Servo error" in folder.armcal("identify", "arm.toml", "data.csv").out
    folder.write("targets.csv", "x_mm,y_mm\n300,150\n")
    commands = folder.armcal("compensate", "calibrated.toml", "targets.csv", "--json").data["commands_deg"]
    text, count = re.subn(
        r"^b_deg = 0.01999\d*|^b_deg = 0.02\d*", "b_deg = 0.05", folder.read("calibrated.toml"), flags=re.M
    )
    assert (count, text.count("servo_error")) == (1, 1)
    folder.write("calibrated.toml", text)
    others = folder.armcal("compensate", "calibrated.toml", "targets.csv", "--json").data["commands_deg"]
    np.testing.assert_allclose(np.subtract(others, commands), [[0.0, -0.03, 0.0, 0.0]], atol=1e-6)


def test_what_is_not_named_stays_and_keeps_its_covariance(folder: Folder) -> None:
    folder.simulated()
    assert folder.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml").code == 0
    words = ["identify", "calibrated.toml", "data.csv", "--only", "joint_offset:2,lengths", "--only", "joint_offset:3"]
    done = folder.armcal(*words, "--out", "again.toml", "--json")
    assert done.data["only"] == ["joint_offset:2", "lengths", "joint_offset:3"]
    names = [f"length_error:{j}" for j in (1, 2, 3, 4)] + ["joint_offset:2", "joint_offset:3"]
    assert [row["name"] for row in done.data["parameters"]] == names
    first, again = (tomllib.loads(folder.read(name))["calibration"] for name in ("calibrated.toml", "again.toml"))
    assert again["joint_offsets_deg"][::3] == pytest.approx(first["joint_offsets_deg"][::3], abs=1e-12)
    assert again["parameters"] == [*names, "joint_offset:1", "joint_offset:4"]
    assert again["covariance"][-1][-1] == pytest.approx(first["covariance"][-1][-1])
    assert "Estimated: joint_offset:2, lengths, joint_offset:3; the others" in folder.armcal(*words).out


def test_what_stays_keeps_its_angles_and_its_data(folder: Folder) -> None:
    """The range of two files is that of all their rows, a joint read a whole turn away included, also where one is the
    prior of the other; with nothing kept it is that of the new rows. `validate` then knows the old rows, and finds none
    of them outside."""
    folder.simulated()
    folder.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml")
    head, *rows = folder.read("data.csv").splitlines()
    column = head.split(",").index("q1_deg")
    old = np.array([float(row.split(",")[column]) for row in rows])
    few = [row.split(",") for row in rows[:6]]
    turned = [[*r[:column], str(float(r[column]) + 360.0), *r[column + 1 :]] for r in few]
    folder.write("few.csv", "\n".join([head, *(",".join(r) for r in turned)]) + "\n")
    prior = ["--prior", "calibrated.toml"]
    for words, kept in ((["--only", "joint_offset:2"], True), (prior, True), ([], False)):
        folder.armcal("identify", "calibrated.toml", "few.csv", *words, "--out", "again.toml", "--force")
        found = tomllib.loads(folder.read("again.toml"))["calibration"]["provenance"]
        assert (found["file"], found["rows"]) == ("few.csv", 6)
        expected = [old.min(), old.max()] if kept else [old[:6].min() + 360.0, old[:6].max() + 360.0]
        np.testing.assert_allclose(found["joint_range_deg"][0], expected, atol=1e-6)
        assert ("held_from" in found) is kept
        if kept:
            assert found["held_from"]["data.csv"]["rows"] == len(rows)
            notes = folder.armcal("validate", "again.toml", "data.csv", "--json").data["notes"]
            assert [note.partition(":")[0] for note in notes] == [
                "these are the measurements that the model was identified from"
            ]


def test_what_is_held_counts_from_the_old_temperature(folder: Folder) -> None:
    """Links that grow by 1e-4 per K, measured at some 20 deg, and at some 29 after a motor was changed: the lengths and
    their growth stay right, whether they are held or the prior; anew, everything counts from the new mean."""
    lengths, zeros = np.array([261.5, 179.4, 119.6, 100.7]), np.radians([0.5, -0.5, 0.7, -0.3])
    generator = np.random.default_rng(12)
    for name, rows, middle, moved in (("cold.csv", 40, 20.0, 0.0), ("warm.csv", 12, 29.0, np.radians(0.4))):
        q = generator.uniform(-1.5, 1.5, (rows, 4))
        warm = middle + generator.uniform(-3.0, 3.0, rows)
        turned = np.cumsum(q + zeros + moved * np.eye(4)[1], axis=1)
        tip = (1.0 + 1e-4 * (warm - 20.0)) * (np.exp(1j * turned) @ lengths)
        tip += 0.01 * (generator.standard_normal((2, rows)).T @ [1.0, 1.0j])
        lines = np.column_stack([np.degrees(q), tip.real, tip.imag, warm])
        head = "q1_deg,q2_deg,q3_deg,q4_deg,x_mm,y_mm,temperature_C\n"
        folder.write(name, head + "".join(",".join(f"{x:.6f}" for x in line) + "\n" for line in lines))
    sure = ARM.replace("sigma_mm = 0.1", "sigma_mm = 0.01")
    folder.write("arm.toml", sure + '\n[[effects]]\nname = "thermal_growth"\n')
    folder.armcal("identify", "arm.toml", "cold.csv", "--out", "calibrated.toml")
    origin = tomllib.loads(folder.read("calibrated.toml"))["calibration"]["provenance"]
    words = ["identify", "calibrated.toml", "warm.csv", "--only", "joint_offset:2"]
    only = folder.armcal(*words, "--out", "only.toml", "--json").data
    (zero,) = only["parameters"]
    assert zero["value"] == pytest.approx(-0.1, abs=0.005)
    assert only["rms_after_mm"] < 0.03  # 0.4 mm where temperatures count from the new mean
    kept = tomllib.loads(folder.read("only.toml"))["calibration"]["provenance"]
    assert kept["mean_temperature_C"] == origin["mean_temperature_C"]
    prior = folder.armcal("identify", "arm.toml", "warm.csv", "--prior", "calibrated.toml", "--json").data
    assert [one["name"] for one in prior["prior_from"]["contradicted"]] == ["joint_offset:2"]
    folder.armcal("identify", "arm.toml", "warm.csv", "--out", "anew.toml")
    anew = tomllib.loads(folder.read("anew.toml"))["calibration"]["provenance"]
    assert anew["mean_temperature_C"] == pytest.approx(29.0, abs=1.0)


def test_prior_is_the_library_or_a_file(folder: Folder) -> None:
    """`--prior` alone means the library, wherever it stands; before a file an earlier calibration."""
    folder.simulated()
    folder.armcal("identify", "arm.toml", "data.csv", "--sigma", "given", "--out", "calibrated.toml")
    flag = folder.armcal("identify", "--prior", "arm.toml", "data.csv", "--missing", "backlash", "--json").data
    assert flag["prior"]["effects"] == [f"backlash:{j}" for j in (1, 2, 3, 4)]
    folder.simulated("again.csv", seed=1)
    last = ["identify", "arm.toml", "again.csv", "--json", "--prior", "calibrated.toml"]
    first = ["identify", "--prior=calibrated.toml", "arm.toml", "again.csv", "--json"]
    named = ["identify", "arm.toml", "again.csv", "--json", "--prior-from", "calibrated.toml"]
    found = [folder.armcal(*words, "--sigma", "given").data for words in (last, first, named)]
    assert found[0] == found[1] == found[2]
    assert found[0]["prior_from"]["file"] == "calibrated.toml"
    assert len(found[0]["prior_from"]["parameters"]) == 8
    assert found[0]["prior_from"]["contradicted"] == []
    alone = folder.armcal("identify", "arm.toml", "again.csv", "--sigma", "given", "--json").data
    for with_prior, without in zip(found[0]["parameters"], alone["parameters"], strict=True):
        assert with_prior["std"] == pytest.approx(without["std"] / np.sqrt(2.0), rel=0.1)  # the same plan, twice
    alias = folder.armcal("identify", "--library-prior", "arm.toml", "data.csv", "--missing", "backlash", "--json").data
    assert alias == flag
    assert flag["offered"]["better"] is False  # no effect is there, and four more can only harm
    both = folder.armcal(*named, "--prior", "--missing", "backlash").data
    assert both["prior"]["parameters"] == 4
    assert both["prior_from"]["anew"] == []
    assert "found no covariance" in folder.armcal(*last[:-1], "arm.toml").err


def test_rows_that_the_prior_comes_from_do_not_count_twice(folder: Folder) -> None:
    """The same file, its rows in another order, some of them, with as many others, and by way of a second calibration;
    a calibration of an earlier version knows only its file."""
    folder.simulated()
    folder.simulated("again.csv", seed=1)
    folder.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml")
    head, *rows = folder.read("data.csv").splitlines()
    others = folder.read("again.csv").splitlines()[1:]
    mixed = [rows[k] for k in np.random.default_rng(3).permutation(len(rows))]
    files = {
        "data.csv": [head, *rows],
        "mixed.csv": [head, *mixed],
        "some.csv": [head, *mixed[:5]],
        "more.csv": [head, *others, *mixed],
    }
    for name, lines in files.items():
        folder.write(name, "\n".join(lines) + "\n")
        done = folder.armcal("identify", "arm.toml", name, "--prior-from", "calibrated.toml", "--out", "twice.toml")
        assert (done.code, done.out, done.err.count("\n")) == (2, "", 1), name
        assert "calibrated.toml: prior: " in done.err
        assert "count twice, allowed: new measurements" in done.err
    words = ["identify", "arm.toml", "again.csv", "--prior-from", "calibrated.toml"]
    assert folder.armcal(*words, "--out", "both.toml").err == ""
    for name in ("some.csv", "data.csv", "again.csv"):
        assert folder.armcal("identify", "arm.toml", name, "--prior-from", "both.toml").code == 2
    folder.write("few.csv", "\n".join([head, *others, *mixed[:2]]) + "\n")
    few = folder.armcal("identify", "arm.toml", "few.csv", "--prior-from", "calibrated.toml")
    assert (few.code, "about 14 % of these rows (17 % of the calibration's own)" in few.err) == (0, True)
    old = re.sub(r"digests_of_rows = .*\n", "", folder.read("calibrated.toml"))
    folder.write("old.toml", old)
    words = ["identify", "arm.toml", "data.csv", "--prior-from", "old.toml"]
    assert folder.armcal(*words).code == 2
    unknown = folder.armcal(*[word.replace("data", "again") for word in words])
    assert (unknown.code, "does not say which rows it comes from" in unknown.err) == (0, True)


def test_lost_beams_are_named_and_left_out(folder: Folder) -> None:
    """The same as without their lines; rows keep their numbers."""
    postures = np.random.default_rng(4).uniform(-90.0, 60.0, (24, 4))
    rows = [f"{k},{','.join(f'{q:.3f}' for q in row)}" for k, row in enumerate(postures, start=1)]
    heading = ",".join(["run", *(f"q{j}_deg" for j in range(1, 5))])
    folder.write("plan.csv", "\n".join([heading, *rows]) + "\n")
    folder.simulated()
    lines = (folder.path / "data.csv").read_text().splitlines()
    head, far = lines[0].split(","), lines.copy()
    for number in (3, 8):
        cells = lines[number].split(",")
        cells[head.index("x_mm")] = f"{float(cells[head.index('x_mm')]) + 7.0:.4f}"
        far[number] = ",".join(cells)
    folder.write("far.csv", "\n".join(far) + "\n")
    folder.write("without.csv", "\n".join(line for k, line in enumerate(lines) if k not in (3, 8)) + "\n")
    said = folder.armcal("identify", "arm.toml", "far.csv", "--json").data
    assert said["outlier_rows"] == [3, 8]
    left = folder.armcal("identify", "arm.toml", "far.csv", "--without-outliers", "--json").data
    expected = folder.armcal("identify", "arm.toml", "without.csv", "--without-outliers", "--json").data
    assert (left.pop("left_out"), expected.pop("left_out")) == ([3, 8], [])
    assert left["parameters"] == expected["parameters"]
    before = ("rms_drawing_mm", "cross_validated_mm")  # of the same rows as what is left after the fit
    assert [left[key] for key in before] == [expected[key] for key in before]
    assert left["rms_drawing_mm"] < 0.9 * said["rms_drawing_mm"]
