"""`armcal report` as a user runs it: whatever files are given, and one line where they cannot be."""

from __future__ import annotations

import hashlib
import json
import re

import pytest

from identification.document import in_a_sentence
from identification.files.arm import load_arm
from tests.doe.cli.conftest import Folder


@pytest.fixture
def campaign(folder: Folder) -> Folder:
    """With data, a calibration, other measurements, and what commands said."""
    folder.simulated()
    folder.write("ident.json", folder.armcal("identify", "arm.toml", "data.csv", "--out", "cal.toml", "--json").out)
    words = "simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--seed", "5", "--out", "other.csv"
    assert folder.armcal(*words).code == 0
    folder.write("valid.json", folder.armcal("validate", "cal.toml", "other.csv", "--json").out)
    return folder


def test_a_page_of_everything(campaign: Folder) -> None:
    names = ["arm.toml", "cal.toml", "plan.csv", "data.csv", "other.csv", "ident.json", "valid.json"]
    done = campaign.armcal("report", *names, "--out", "page.html", "--seed", "3", "--json")
    assert done.code == 0, done.err
    kinds = {entry["file"]: entry["kind"] for entry in done.data["files"]}
    assert list(kinds) == names
    assert kinds["cal.toml"] == "arm with a calibration"
    assert (kinds["plan.csv"], kinds["other.csv"]) == ("plan", "measurements")
    assert kinds["valid.json"] == "armcal validate --json"
    said = json.loads(campaign.read("valid.json"))
    unseen, fitted, own, plan = done.data["verdict"]
    drawing = f"{in_a_sentence(said['rms_nominal_mm'])} mm (drawing, after fitting where the arm stands)"
    figures = f"from {drawing} to {in_a_sentence(said['rms_mm'])} mm"
    assert unseen.startswith(f"On 12 rows of other.csv, cal.toml takes the RMS error {figures}")
    assert "data.csv, which it was fitted to" in fitted
    assert own.startswith("On its own data")
    assert plan == "The plan plan.csv has 12 runs."
    text = campaign.read("page.html")
    for entry in done.data["files"]:
        content = (campaign.path / entry["file"]).read_bytes()
        assert (entry["bytes"], entry["sha256"]) == (len(content), hashlib.sha256(content).hexdigest())
        assert entry["sha256"] in text
    assert "armcal report arm.toml cal.toml plan.csv" in text
    assert "length of link 1" in text
    row = next(row for row in json.loads(campaign.read("ident.json"))["corrected_values"] if row["nominal"] == 260.0)
    assert f">{row['corrected']:.4f}</td>" in text


def test_a_subset_says_what_to_do_next(campaign: Folder) -> None:
    for words, expected in (
        (["arm.toml", "plan.csv"], "armcal check arm.toml data.csv"),
        (["arm.toml", "data.csv"], "armcal identify arm.toml data.csv --out calibrated.toml"),
        (["cal.toml"], "armcal compensate cal.toml targets.csv"),
        (["ident.json"], "length of link 1"),
        (["valid.json"], "quarter 1"),
    ):
        done = campaign.armcal("report", *words, "--out", "page.html", "--force")
        assert done.code == 0, done.err
        assert expected in campaign.read("page.html")


def test_a_model_that_is_no_better_than_the_drawing_is_not_recommended(campaign: Folder) -> None:
    text = campaign.read("cal.toml")
    worse = text.replace("length_errors_mm = [", "length_errors_mm = [30.0, -20.0, 25.0, -30.0] # [")
    campaign.write("worse.toml", worse)
    done = campaign.armcal("report", "arm.toml", "worse.toml", "other.csv", "--out", "page.html")
    assert done.code == 0, done.err
    page = campaign.read("page.html")
    assert "Do not use worse.toml as it is: on other.csv it is no better than the drawing" in page
    assert "armcal compensate" not in page


def test_the_report_of_a_diagnosis_stands_in_the_page_too(campaign: Folder) -> None:
    words = "diagnose", "arm.toml", "data.csv", "--out", "extended.toml"
    done = campaign.armcal(*words, "--report", "gap.html", "--json")
    assert done.code == 0, done.err
    calibration = load_arm(campaign.path / "extended.toml").calibration
    assert calibration is not None
    assert calibration.provenance["sha256"] == hashlib.sha256((campaign.path / "data.csv").read_bytes()).hexdigest()
    campaign.write("diag.json", done.out)
    assert campaign.armcal("report", "diag.json", "--out", "page.html").code == 0
    for page in ("gap.html", "page.html"):
        text = campaign.read(page)
        assert "Nothing is missing from the model" in text
        assert f">{done.data['gap']['rms_before_mm']:.4f}</td>" in text
    own = campaign.read("gap.html")
    assert "mm RMS, after fitting where the arm stands" in own
    assert "Signed error against each joint" in own
    assert "Nothing is named: before and after are nearly one model." in own
    assert hashlib.sha256((campaign.path / "data.csv").read_bytes()).hexdigest() in own


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["plan.csv"], ["plan.csv", "without its arm"]),
        (["arm.toml", "notes.doc"], ["notes.doc", "'.doc'", "allowed"]),
        (["arm.toml", "arm.toml"], ["arm.toml", "given twice"]),
        (["arm.toml", "bad.json"], ["bad.json", "not valid JSON"]),
        (["list.json"], ["list.json", "no command that is known"]),
        (["short.json"], ["short.json", "not as the command writes it"]),
        (["arm.toml", "none.csv"], ["none.csv", "no such file"]),
        (["arm.toml", "arm.html"], ["arm.html", "allowed"]),
    ],
)
def test_what_cannot_be_shown_is_one_line(folder: Folder, words: list[str], expected: list[str]) -> None:
    folder.write("notes.doc", "# notes")
    folder.write("bad.json", "{")
    folder.write("list.json", "[1, 2]")
    folder.write("short.json", '{"criterion": 1, "runs": {}, "efficiency": "x", "certified_optimal": []}')
    done = folder.armcal("report", *words, "--out", "page.html")
    assert done.code == 2
    assert len(done.err.strip().splitlines()) == 1
    assert all(part in done.err for part in expected), done.err
    assert not (folder.path / "page.html").exists()


def test_commands_are_shown_with_what_has_none(campaign: Folder) -> None:
    campaign.write("targets.csv", "x_mm,y_mm\n400,100\n300,-50\n9000,0\n")
    made = campaign.armcal("compensate", "cal.toml", "targets.csv", "--out", "commands.csv", "--json").data
    done = campaign.armcal("report", "arm.toml", "cal.toml", "commands.csv", "--out", "page.html", "--json")
    assert done.code == 0, done.err
    assert done.data["files"][-1]["kind"] == "joint commands"
    assert done.data["verdict"][-1] == "commands.csv has commands for 2 of 3 targets; row 3 has none."
    text = campaign.read("page.html")
    assert ">Joint commands: commands.csv<" in text
    for angle in made["commands_deg"][0]:
        assert f">{angle:.3f}</td>" in text
    assert made["commands"][2]["message"] in text
    assert "armcal compensate" in text  # where nothing but the arm says what is next, as before


def test_commands_whose_numbers_are_none_are_one_line(campaign: Folder) -> None:
    campaign.write("commands.csv", "q1_deg,q2_deg,q3_deg,q4_deg,x_mm,y_mm,error_mm,reachable\n1,2,3,4,5,x,0.1,1\n")
    done = campaign.armcal("report", "arm.toml", "commands.csv", "--out", "page.html")
    assert done.code == 2
    assert "commands.csv: row 1 (line 2), column y_mm: found 'x', allowed: a finite number" in done.err


def test_the_headline_is_the_error_on_rows_that_no_fit_has_seen(campaign: Folder) -> None:
    """Whichever file says it: other measurements, what `validate` said of them, or a diagnosis with rows held out."""
    words = "diagnose", "arm.toml", "data.csv", "--holdout", "other.csv", "--json"
    campaign.write("diag.json", campaign.armcal(*words).out)
    valid, diagnosis = (json.loads(campaign.read(name)) for name in ("valid.json", "diag.json"))
    by_rows = f"to {in_a_sentence(valid['rms_mm'])} mm"
    by_diagnosis = f"to {in_a_sentence(diagnosis['confirmation']['after_mm'])} mm"
    for names, start, figure in (
        (["data.csv", "other.csv"], "On 12 rows of other.csv, cal.toml takes the RMS error from", by_rows),
        (["data.csv", "valid.json"], "On 12 rows of other measurements, the model takes the RMS error from", by_rows),
        (["data.csv", "diag.json"], "On 12 rows that no fit has seen the RMS error goes from", by_diagnosis),
        (["data.csv", "diag.json", "other.csv"], "On 12 rows of other.csv, cal.toml takes the RMS", by_rows),
        (["data.csv", "ident.json"], "On 12 rows of data.csv, which it was fitted to", ""),
    ):
        done = campaign.armcal("report", "arm.toml", "cal.toml", *names, "--out", "page.html", "--force", "--json")
        assert done.code == 0, done.err
        headline = done.data["verdict"][0]
        assert headline.startswith(start), headline
        assert figure in headline
        assert len(set(done.data["verdict"])) == len(done.data["verdict"])


def test_a_page_is_replaced_by_force_only(folder: Folder) -> None:
    folder.write("page.html", "mine")
    refused = folder.armcal("report", "arm.toml", "--out", "page.html")
    assert refused.code == 2
    assert folder.read("page.html") == "mine"
    assert folder.armcal("report", "arm.toml", "--out", "page.html", "--force").code == 0


def test_files_of_two_arms_are_no_campaign(folder: Folder) -> None:
    for name, links in (("one", [300.0, 200.0]), ("other", [300.0, 210.0])):
        folder.write(f"{name}.toml", f'name = "{name}"\nlinks_mm = {links}\n')
    done = folder.armcal("report", "one.toml", "other.toml", "--out", "page.html")
    assert done.code == 2
    assert "other.toml: another arm than that of one.toml, allowed: files of one arm" in done.err


def test_every_calibration_is_shown_and_the_one_that_is_used_is_said(folder: Folder) -> None:
    """Fitted to few rows with noise and to many: on others the second is nearer to the arm that they come from."""
    folder.simulated()
    lines = folder.read("data.csv").splitlines()
    for name, rows in (("few", lines[1:6]), ("many", lines[1:9]), ("other", lines[9:])):
        folder.write(f"{name}.csv", "\n".join([lines[0], *rows]) + "\n")
    for name in ("many", "few"):
        assert folder.armcal("identify", "arm.toml", f"{name}.csv", "--out", f"{name}.toml").code == 0
    words = ["report", "arm.toml", "many.toml", "few.toml", "other.csv", "--out", "page.html", "--json"]
    done = folder.armcal(*words)
    assert done.code == 0, done.err
    left = {
        name: folder.armcal("validate", f"{name}.toml", "other.csv", "--json").data["rms_mm"]
        for name in ("many", "few")
    }
    best, rest = sorted(left, key=left.__getitem__)
    said = " ".join(done.data["verdict"])
    assert (
        f"the next steps use {best}.toml: it leaves the smallest error on other.csv. {rest}.toml is shown beside it."
        in said
    )
    assert f"{best}.toml takes the RMS error from" in said
    assert f"{rest}.toml takes" not in said  # the table has it
    text = folder.read("page.html")
    for name, figure in left.items():
        assert re.search(f">{name}.toml</td><td[^>]*>{figure:.4f}</td>", text)
    assert text.index(f">Corrected values: {best}.toml<") < text.index(f">Corrected values: {rest}.toml<")
    assert f"armcal compensate {best}.toml" in text


def test_each_calibration_is_said_to_be_fitted_to_its_own_rows(campaign: Folder) -> None:
    assert campaign.armcal("identify", "arm.toml", "other.csv", "--out", "cal2.toml").code == 0
    names = ("arm.toml", "cal.toml", "cal2.toml", "data.csv", "other.csv")
    done = campaign.armcal("report", *names, "--out", "two.html", "--json")
    assert done.code == 0, done.err
    own = {sentence for sentence in done.data["verdict"] if "which it was fitted to" in sentence}
    assert len(own) == 1
    assert all(("data.csv" in said) == ("cal.toml" in said) for said in own)
    assert "Fitted to these rows: cal.toml." in campaign.read("two.html")
    assert "Fitted to these rows: cal2.toml." in campaign.read("two.html")
    assert "armcal diagnose arm.toml other.csv" in campaign.read("two.html")  # the data of the one that is used


def test_rows_beyond_the_angles_of_the_identification_are_the_first_thing_to_mend(campaign: Folder) -> None:
    """Half of the data has joint 1 on one side, and the model is fitted to that half."""
    lines = campaign.read("data.csv").splitlines()
    first = lines[0].split(",").index("q1_deg")
    rows = sorted(lines[1:], key=lambda row: float(row.split(",")[first]))
    for name, some in (("left", rows[:6]), ("right", rows[6:])):
        campaign.write(f"{name}.csv", "\n".join([lines[0], *some]) + "\n")
    assert campaign.armcal("identify", "arm.toml", "left.csv", "--out", "left.toml").code == 0
    for other, expected in (("right.csv", True), ("left.csv", False)):
        done = campaign.armcal("report", "arm.toml", "left.toml", other, "--out", "page.html", "--force")
        assert done.code == 0, done.err
        said = "identify again: 100 % of the rows of right.csv are beyond the angles that left.toml has seen."
        assert (said in campaign.read("page.html")) == expected
        assert ("armcal validate left.toml other.csv" in campaign.read("page.html")) != expected
