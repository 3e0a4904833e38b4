"""Every fault that a fuzz of the commands has found, by its name: each must end as the contract says."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import pytest

from doe.cli import main
from doe.cli.progress import lines
from doe.report.studies import cell_table
from identification.errors import LONGEST_LINE, InputError, in_one_line
from identification.files.csv import read_table
from tests.doe.cli.conftest import Folder
from tests.doe.cli.test_bad_input import HEADER, refused

LONG = "a" * 300


def test_runs_of_a_digit_that_is_none(folder: Folder) -> None:
    for text in ("²:5", "4:²", "9" * 5000, "4:" + "9" * 12):
        refused(folder, ["advise", "arm.toml", "--runs", text], "--runs", "allowed: A:B or A")


def test_words_with_a_null_character(folder: Folder) -> None:
    """From a program that calls the verbs; no shell can pass one on."""
    for words in (["identify", "a\0b", "data.csv"], ["design", "arm.toml", "--runs", "8", "--out", "\0"]):
        refused(folder, words, "null character, allowed: text")


def test_an_output_that_is_a_circle_of_links(folder: Folder) -> None:
    (folder.path / "one").symlink_to("two")
    (folder.path / "two").symlink_to("one")
    refused(folder, ["design", "arm.toml", "--runs", "8", "--out", "one"], "one: cannot be written", "allowed: another")
    refused(folder, ["design", "one", "--runs", "8"], "one: cannot be read")


def test_an_output_with_too_long_a_name(folder: Folder) -> None:
    refused(folder, ["design", "arm.toml", "--runs", "8", "--out", LONG], "cannot be written", "allowed: another")
    refused(folder, ["design", LONG, "--runs", "8"], "cannot be read")
    refused(folder, ["demo", "--out", LONG], "cannot be created")
    folder.write("study.toml", 'arms = ["arm.toml"]\nplans = ["random"]\nruns = [6]\nreplications = 2\n')
    refused(folder, ["study", "study.toml", "--workers", "1", "--out", LONG], "cannot be made")
    refused(folder, ["design", "arm.toml", "--runs", "8", "--out", "arm.toml/plan.csv"], "'arm.toml' is no folder")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such devices here")
@pytest.mark.parametrize("device", ["/dev/full", "/dev/zero", "/dev/null"])
def test_a_device_that_never_ends(folder: Folder, device: str) -> None:
    words = ["simulate", "arm.toml", "plan.csv", "--truth", device, "--out", "out.file"]
    refused(folder, words, f"{device}: is a device, allowed: a file")


def test_a_pipe_is_read_as_a_file(folder: Folder) -> None:
    """As `<(zcat plan.csv.gz)` of a shell: a device is refused, a pipe is not."""
    reading, writing = os.pipe()
    os.write(writing, folder.read("plan.csv").encode())
    os.close(writing)
    assert len(read_table(f"/dev/fd/{reading}")) == 12
    os.close(reading)


@pytest.mark.parametrize("levels", ["513", "9999999", "99999999999999999999"])
def test_a_grid_larger_than_memory(folder: Folder, levels: str) -> None:
    refused(folder, ["relax", "arm.toml", "--grid", levels], "grid", levels, "allowed: 2 to 512")


@pytest.mark.parametrize("verb", [["compare", "arm.toml", "--runs", "8"], ["study", "study.toml"]])
def test_more_workers_than_a_machine_has(folder: Folder, verb: list[str]) -> None:
    refused(folder, [*verb, "--workers", "99999999999999999999"], "--workers", "99999999999999999999", "1<=x<=4096")


def test_a_payload_heavier_than_any(folder: Folder) -> None:
    """Its squares overflow: `advise` ended with eigenvalues that did not converge."""
    folder.simulated()
    table = "[gravity]\nacceleration_m_s2 = [0.0, {}]\nlink_masses_kg = [1.0, 1.0, 1.0, 1.0]\npayload_kg = {}\n"
    for acceleration, payload, key in (("-9.81", "5e300", "payload_kg"), ("1e300", "5.0", "acceleration_m_s2")):
        folder.write("heavy.toml", folder.read("arm.toml") + table.format(acceleration, payload))
        refused(folder, ["advise", "heavy.toml", "--runs", "12"], key, "allowed: ")
    folder.write("heavy.csv", folder.read("plan.csv").replace("\n", ",5e300\n").replace(",5e300", ",payload_kg", 1))
    refused(folder, ["simulate", "arm.toml", "heavy.csv", "--truth", "arm.toml", "--out", "out.file"], "payload_kg")


def test_a_planar_truth_of_a_spatial_arm(folder: Folder) -> None:
    """It wrote measurements without `z_mm`, which the arm's own reader refuses."""
    rows = "[[dh]]\na_mm = 300.0\nalpha_deg = 90.0\nd_mm = 50.0\n" * 4
    folder.write("space.toml", f'kind = "spatial"\n{rows}[measurement]\nsigma_mm = 0.1\n')
    words = ["simulate", "space.toml", "plan.csv", "--truth", "arm.toml", "--out", "out.file"]
    refused(folder, words, "arm.toml: found an arm that is planar", "allowed: spatial, revolute")


STUDY = 'arms = ["arm.toml"]\nplans = ["same.csv"]\nreplications = 4\n'
SAME = "run,q1_deg,q2_deg,q3_deg,q4_deg\n" + "1,0,1,2,3\n" * 4


def test_a_study_without_a_result_leaves_nothing(folder: Folder) -> None:
    folder.write("same.csv", SAME)
    folder.write("study.toml", STUDY)
    before = sorted(folder.path.iterdir())
    done = folder.armcal("study", "study.toml", "--workers", "1")
    assert done.code == 1
    assert done.err.startswith("armcal: no cell could be done: the plan does not identify: ")
    assert sorted(folder.path.iterdir()) == before
    (folder.path / "there").mkdir()
    assert folder.armcal("study", "study.toml", "--workers", "1", "--out", "there").code == 1
    assert list((folder.path / "there").iterdir()) == []


def test_a_picture_that_is_refused_leaves_no_plan(folder: Folder) -> None:
    before = sorted(folder.path.iterdir())
    words = ["--picture", "p.gif", "--out", "out.file"]
    refused(folder, ["design", "arm.toml", "--runs", "8", *words], "p.gif: ending '.gif', allowed: .png, .svg, .pdf")
    refused(folder, ["score", "arm.toml", "plan.csv", "--picture", "p.png", "--aliases", "a"], "a: ending '', allowed")
    assert sorted(folder.path.iterdir()) == before


def test_a_score_that_cannot_be_finished_leaves_no_picture(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    """As that of the arm of a spatial fuzz, whose constraints left no posture for the criterion I."""

    def refuse(*_: object) -> None:
        raise InputError("constraints: no posture, allowed: constraints that leave some")

    monkeypatch.setattr("doe.plan.accuracy.criterion_values", refuse)
    before = sorted(folder.path.iterdir())
    refused(folder, ["score", "arm.toml", "plan.csv", "--picture", "p.svg"], "no posture, allowed")
    assert sorted(folder.path.iterdir()) == before


@pytest.mark.parametrize(
    ("words", "tables"),
    [
        (["validate", "calibrated.toml", "data.csv"], "identification.validation_actions"),
        (["advise", "arm.toml", "--runs", "4"], "design.advice_document"),
    ],
)
def test_an_answer_that_cannot_be_given_leaves_no_picture(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, words: list[str], tables: str
) -> None:
    """As that of data with a marker that the calibrated arm does not have."""

    def refuse(*_: object, **__: object) -> None:
        raise InputError("measurements.marker: unknown name '2', allowed: 1")

    folder.simulated()
    folder.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml")
    monkeypatch.setattr(f"doe.report.{tables}", refuse)
    before = sorted(folder.path.iterdir())
    refused(folder, [*words, "--picture", "p.svg"], "unknown name '2', allowed: 1")
    assert sorted(folder.path.iterdir()) == before


@pytest.mark.parametrize("char", ["\n", "\r", "\x1b[31m", "\x07", "\u2028", "\u202e"])
def test_control_characters_are_not_repeated(folder: Folder, char: str) -> None:
    for words in (["score", f"arm{char}.toml", "plan.csv"], [f"sco{char}re"], ["score", "arm.toml", f"--{char}"]):
        done = folder.armcal(*words)
        assert done.code == 2
        assert done.err.count("\n") == 1
        assert done.err.strip().isprintable()


@pytest.mark.parametrize("name", main.commands)
def test_help_is_text(folder: Folder, name: str) -> None:
    done = folder.armcal(name, "--help")
    assert done.code == 0
    assert all(char.isprintable() or char == "\n" for char in done.out)


def test_names_in_files_do_not_reach_the_terminal_as_they_are(folder: Folder) -> None:
    arm = folder.read("arm.toml").replace("paper-4-link", "\\u001b[31mred\\u0007")
    folder.write("arm.toml", arm)
    data = HEADER.replace("q1_deg", '"\x1b]0;title\x07",q1_deg') + "x,0,0,0,0,660,0\n" * 4
    folder.write("data.csv", data)
    for words in (["score", "arm.toml", "plan.csv"], ["check", "arm.toml", "data.csv"]):
        done = folder.armcal(*words)
        assert "\x1b" not in done.out + done.err
        assert "\x07" not in done.out + done.err


def test_a_very_long_name_is_cut(folder: Folder) -> None:
    name = "a" * 100_000
    for words in ([name], ["score", name, "plan.csv"], ["design", "arm.toml", "--runs", "8", "--solver", name]):
        done = folder.armcal(*words)
        assert done.code == 2
        assert len(done.err) < LONGEST_LINE + 100
    assert in_one_line(f"{name}: no such file, allowed: an existing one").endswith(
        "no such file, allowed: an existing one"
    )


@pytest.mark.parametrize(
    ("row", "found"),
    [
        ('1,2,3,4,5,"6\n1,2,3,4,5,6\n', "row 1 (from line 2): unexpected end of data"),
        ('1,2,3,4,5,6\n1,2,3,4,5,"6"x\n', "row 2 (from line 3): ',' expected after '\"'"),
        (f'1,2,3,4,5,"{"6" * 200_000}\n', "row 1 (from line 2): field larger"),
    ],
)
def test_quotation_marks_that_do_not_match(folder: Folder, row: str, found: str) -> None:
    folder.write("data.csv", HEADER + row)
    refused(
        folder, ["identify", "arm.toml", "data.csv"], f"data.csv: {found}", "allowed: cells without quotation marks"
    )


def test_a_header_that_is_no_header(folder: Folder) -> None:
    for line in ('"q1_deg,q2_deg\n', f"{'q' * 200_000}\n"):
        folder.write("data.csv", line + "1,2\n")
        with pytest.raises(
            InputError, match=r"data.csv: (line 1: .*allowed: the names of the columns|column 'q1_deg')"
        ):
            read_table("data.csv").require(["q1_deg"])


def test_targets_that_would_overflow(folder: Folder) -> None:
    folder.write("targets.csv", "x_mm,y_mm\n1e302,0\n")
    refused(folder, ["compensate", "truth.toml", "targets.csv"], "row 1", "column x_mm", "allowed: a finite length")


def test_a_simulation_that_could_not_be_read_again(folder: Folder) -> None:
    """The tip is further away than a measurement file may say."""
    text = folder.read("truth.toml").replace("[260.0, 180.0, 120.0, 100.0]", "[9e8, 9e8, 9e8, 9e8]")
    folder.write("truth.toml", text)
    words = ["simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--out", "out.file"]
    refused(folder, words, "found a position of ", "allowed: up to 1e+09")


def test_every_verb_says_that_it_is_at_work(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those that have no steps to tell: here with a line at once instead of every ten seconds."""
    monkeypatch.setattr("doe.cli.progress.lines", partial(lines, interval=1e-4))
    folder.simulated()
    for words in (["score", "arm.toml", "plan.csv"], ["check", "arm.toml", "data.csv"]):
        assert f"armcal {words[0]}: 0 s" in folder.armcal(*words).err
    assert folder.armcal("score", "arm.toml", "plan.csv", "--quiet").err == ""


def test_a_cell_of_a_study_without_figures(folder: Folder) -> None:
    """No fit succeeded, so there is no residual to show."""
    row = dict.fromkeys(("mean_error", "std", "expected_std", "coverage", "rms_mm"))
    row |= {"fits": 0, "failed": 3, "parameter": "length_error:1", "unit": "mm"}
    table = cell_table("arm, plan", [row])
    assert table.title.endswith("0 fits, 3 failed, RMS - mm")


def test_a_robust_plan_of_an_arm_that_hardly_moves(folder: Folder) -> None:
    """Information that is singular to rounding: an answer without a bound, or a reason."""
    limits = "[joint_limits_deg]\nlower = [0.0, 0.0]\nupper = [1e-9, 1e-9]\n"
    folder.write("arm.toml", f"links_mm = [300.0, 200.0]\n{limits}[measurement]\nsigma_mm = 0.1\n")
    folder.write("plan.csv", "run,q1_deg,q2_deg\n" + "1,0,0\n" * 12)
    for words in (
        ["score", "arm.toml", "plan.csv", "--robust"],
        ["relax", "arm.toml", "--criterion", "A", "--grid", "2"],
    ):
        done = folder.armcal(*words, "--quiet")
        assert done.code in (0, 1), done.err
        assert done.code == 0 or done.err.startswith("armcal: ")


def test_a_working_directory_that_is_gone(folder: Folder) -> None:
    (folder.path / "gone").mkdir()
    os.chdir(folder.path / "gone")
    (folder.path / "gone").rmdir()
    done = folder.armcal("effects")
    assert (done.code, done.err) == (1, "armcal: the working directory is no longer there; change into another one\n")


def test_a_resumed_study_without_a_result_leaves_nothing(folder: Folder) -> None:
    folder.write("same.csv", SAME)
    folder.write("study.toml", STUDY)
    before = sorted(folder.path.iterdir())
    assert folder.armcal("study", "study.toml", "--workers", "1", "--resume").code == 1
    assert sorted(folder.path.iterdir()) == before


def test_a_machining_error_larger_than_any_arm(folder: Folder) -> None:
    row = "[[dh]]\na_mm = 300.0\nalpha_deg = 90.0\nd_mm = 100.0\n"
    for key in ("translation_mm", "rotation_deg"):
        folder.write("arm.toml", f'kind = "spatial"\n{row * 3}[machining]\n{key} = 1e300\n')
        refused(
            folder, ["advise", "arm.toml"], f"arm.toml: machining.{key}: found 1e+300", "allowed: a number > 0", "up to"
        )


def test_commands_of_a_redundant_arm_without_constraints(folder: Folder) -> None:
    """Postures that miss the joint limits are not led away from constraints that are not there."""
    limits = "[-100.0, -100.0, -100.0, -100.0]", "[100.0, 100.0, 100.0, 100.0]"
    arm = folder.read("truth.toml").replace("[-180.0, -120.0, -100.0, -90.0]", limits[0])
    folder.write("truth.toml", arm.replace("[180.0, 120.0, 60.0, 90.0]", limits[1]))
    assert folder.armcal("compensate", "truth.toml", "plan.csv").code == 0
