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
    assert len(done.data["verdict"]) == 4  # unseen rows, those of the fit, of the plan
    text = campaign.read("page.html")
    for entry in done.data["files"]:
        content = (campaign.path / entry["file"]).read_bytes()
        assert (entry["bytes"], entry["sha256"]) == (len(content), hashlib.sha256(content).hexdigest())
        assert entry["sha256"] in text
    assert "armcal report arm.toml cal.toml plan.csv" in text
    assert "length of link 1" in text
    row = next(row for row in json.loads(campaign.read("ident.json"))["corrected_values"] if row["nominal"] == 260.0)
    assert f">{row['corrected']:.4f}</td>" in text


def test_a_plan_of_seatings_is_no_measurement(folder: Folder) -> None:
    """Both have postures and cups and no reading."""
    assert folder.armcal("init", "--dh", "3", "--instrument", "socket", "--force").code == 0
    folder.write("plan.csv", "run,q1_deg,q2_deg,q3_deg,cup\n1,10,20,30,A\n2,40,50,60,B\n")
    folder.write("data.csv", "q1_deg,q2_deg,q3_deg,cup\n10,20,30,A\n40,50,60,B\n")
    done = folder.armcal("report", "arm.toml", "plan.csv", "data.csv", "--out", "page.html", "--json")
    assert done.code == 0, done.err
    assert [entry["kind"] for entry in done.data["files"]] == ["arm", "plan", "measurements"]


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
        assert f">{done.data['gap']['rms_before_mm']:.4f}</td>" in campaign.read(page)
    assert calibration.provenance["sha256"] in campaign.read("gap.html")


def test_the_next_step_names_the_file_that_was_diagnosed(campaign: Folder) -> None:
    """Which other files are given beside the JSON object or not."""
    campaign.write("diag.json", campaign.armcal("diagnose", "arm.toml", "other.csv", "--json").out)
    for names in (["diag.json"], ["arm.toml", "data.csv", "diag.json"]):
        done = campaign.armcal("report", *names, "--out", "page.html", "--force")
        assert done.code == 0, done.err
        assert "armcal identify arm.toml other.csv --out calibrated.toml" in campaign.read("page.html")
        assert "armcal identify arm.toml data.csv" not in campaign.read("page.html")


def test_commands_are_shown_with_what_has_none(campaign: Folder) -> None:
    campaign.write("targets.csv", "x_mm,y_mm\n400,100\n300,-50\n9000,0\n")
    made = campaign.armcal("compensate", "cal.toml", "targets.csv", "--out", "commands.csv", "--json").data
    done = campaign.armcal("report", "arm.toml", "cal.toml", "commands.csv", "--out", "page.html", "--json")
    assert done.code == 0, done.err
    assert done.data["files"][-1]["kind"] == "joint commands"
    text = campaign.read("page.html")
    for angle in made["commands_deg"][0]:
        assert f">{angle:.3f}</td>" in text
    assert made["commands"][2]["message"] in text


def test_the_headline_is_the_error_on_rows_that_no_fit_has_seen(campaign: Folder) -> None:
    """Whichever file says it: other measurements, what `validate` said of them, or a diagnosis with rows held out."""
    words = "diagnose", "arm.toml", "data.csv", "--holdout", "other.csv", "--json"
    campaign.write("diag.json", campaign.armcal(*words).out)
    valid, diagnosis = (json.loads(campaign.read(name)) for name in ("valid.json", "diag.json"))
    by_rows, by_diagnosis = valid["rms_mm"], diagnosis["confirmation"]["after_mm"]
    for names, figure in (
        (["other.csv"], by_rows), (["valid.json"], by_rows), (["diag.json"], by_diagnosis),
        (["diag.json", "other.csv"], by_rows), (["ident.json"], None),
    ):  # fmt: skip
        words = "report", "arm.toml", "cal.toml", "data.csv", *names, "--out", "page.html", "--force", "--json"
        headline, *rest = campaign.armcal(*words).data["verdict"]
        assert ("On 12 rows of data.csv" in headline) is (figure is None)
        assert figure is None or f"to {in_a_sentence(figure)} mm" in headline
        assert headline not in rest


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
    assert f"the next steps use {best}.toml" in " ".join(done.data["verdict"])
    text = folder.read("page.html")
    for name, figure in left.items():
        assert re.search(f">{name}.toml</td><td[^>]*>{figure:.4f}</td>", text)
    assert text.index(f">Corrected values: {best}.toml<") < text.index(f">Corrected values: {rest}.toml<")
    assert f"armcal compensate {best}.toml" in text


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
        said = "identify again: most rows of right.csv are beyond the angles that left.toml has seen."
        assert (said in campaign.read("page.html")) == expected
        assert ("armcal validate left.toml other.csv" in campaign.read("page.html")) != expected
