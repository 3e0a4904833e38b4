"""`armcal report` as a user runs it: whatever files are given, and one line where they cannot be."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import polars as pl
import pytest

from identification import campaign_document, load_arm
from identification.document import in_a_sentence
from tests.doe.cli.conftest import Folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    """With data, a calibration, other measurements, and a diagnosis."""
    with pytest.MonkeyPatch.context() as patch:
        folder = Folder(tmp_path_factory.mktemp("campaign"))
        patch.chdir(folder.path)
        folder.simulated()
        folder.write("ident.json", folder.armcal("identify arm.toml data.csv --out cal.toml --json").out)
        folder.simulated("other.csv", seed=5)
        folder.said("diagnose arm.toml data.csv --holdout other.csv --out extended.toml --report gap.html")
    return folder


@pytest.fixture
def campaign(made: Folder, monkeypatch: pytest.MonkeyPatch) -> Folder:
    monkeypatch.chdir(made.path)
    return made


def test_a_page_of_everything(campaign: Folder) -> None:
    names = "arm.toml cal.toml plan.csv data.csv other.csv"
    found = campaign.said(f"report {names} --out page.html --seed 3 --force")
    kinds = {entry["file"]: entry["kind"] for entry in found["files"]}
    assert list(kinds) == names.split()
    assert kinds["cal.toml"] == "arm with a calibration"
    assert (kinds["plan.csv"], kinds["other.csv"]) == ("plan", "measurements")
    assert len(found["verdict"]) == 3  # unseen rows, those of the fit, of the plan
    text = campaign.read("page.html")
    for entry in found["files"]:
        content = (campaign.path / entry["file"]).read_bytes()
        assert (entry["bytes"], entry["sha256"]) == (len(content), hashlib.sha256(content).hexdigest())
        assert entry["sha256"] in text
    assert "armcal report arm.toml cal.toml plan.csv" in text
    assert "length of link 1" in text
    row = next(row for row in json.loads(campaign.read("ident.json"))["corrected_values"] if row["nominal"] == 260.0)
    assert f">{row['corrected']:.4f}</td>" in text


def test_a_plan_of_seatings_is_no_measurement(folder: Folder) -> None:
    """Both have postures and cups and no reading."""
    folder.said("init --dh 3 --instrument socket --force")
    folder.write("plan.csv", "run,q1_deg,q2_deg,q3_deg,cup\n1,10,20,30,A\n2,40,50,60,B\n")
    folder.write("data.csv", "q1_deg,q2_deg,q3_deg,cup\n10,20,30,A\n40,50,60,B\n")
    found = folder.said("report arm.toml plan.csv data.csv --out page.html")
    assert [entry["kind"] for entry in found["files"]] == ["arm", "plan", "measurements"]


def test_a_page_of_a_diagnosis_names_its_data(campaign: Folder) -> None:
    calibration = load_arm(campaign.path / "extended.toml").calibration
    assert calibration is not None
    assert calibration.provenance["sha256"] == hashlib.sha256((campaign.path / "data.csv").read_bytes()).hexdigest()
    assert calibration.provenance["sha256"] in campaign.read("gap.html")


def test_the_headline_is_the_error_on_rows_that_no_fit_has_seen(campaign: Folder) -> None:
    by_rows = campaign.said("validate cal.toml other.csv")["rms_mm"]
    names = [Path(name) for name in ("arm.toml", "cal.toml", "data.csv", "other.csv")]
    headline, *rest = campaign_document(names)[0].verdict
    assert f"to {in_a_sentence(by_rows)} mm" in headline
    assert headline not in rest
    alone = campaign_document(names[:3])[0].verdict[0]
    assert "On 12 rows of data.csv" in alone


def test_every_calibration_is_shown_and_the_one_that_is_used_is_said(folder: Folder) -> None:
    """Fitted to few rows with noise and to many: on others the second is nearer to the arm that they come from."""
    folder.simulated()
    rows, left = pl.read_csv(folder.path / "data.csv"), {}
    for name, some in (("other", rows[8:]), ("many", rows[:8]), ("few", rows[:5])):
        some.write_csv(folder.path / f"{name}.csv")
    for name in ("many", "few"):
        folder.said(f"identify arm.toml {name}.csv --out {name}.toml")
        left[name] = folder.said(f"validate {name}.toml other.csv")["rms_mm"]
    best, rest = sorted(left, key=left.__getitem__)
    found = folder.said("report arm.toml many.toml few.toml other.csv --out page.html")
    assert f"the next steps use {best}.toml" in " ".join(found["verdict"])
    text = folder.read("page.html")
    for name, figure in left.items():
        assert re.search(f">{name}.toml</td><td[^>]*>{figure:.4f}</td>", text)
    assert text.index(f">Corrected values: {best}.toml<") < text.index(f">Corrected values: {rest}.toml<")
    assert f"armcal compensate {best}.toml" in text
