"""The loop of commands as a user's script runs it, with the JSON keys it reads."""

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from doe.cli import main
from identification import campaign_document, load_arm
from identification.document import in_a_sentence
from identification.documents.identification import DRAWN
from tests.doe.cli.conftest import ARM, LOWER, UPPER, Folder, table

KEYS = {
    "design": "criterion runs links log_det bound efficiency certified_optimal postures_deg table_1_max_residual std "
    "solver status starts seconds",
    "identify": "parameters not_identifiable sigma_mm chi2 dof p_value rms_before_mm rms_after_mm max_before_mm "
    "max_after_mm method",
    "validate": "rows refit rms_mm mean_mm p95_mm max_mm rms_nominal_mm blocks refitted notes",
}
LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])


def test_design_reaches_the_bound_and_writes_the_plan(folder: Folder) -> None:
    found = folder.said("design arm.toml --runs 8 --out plan8.csv")
    assert set(found) >= {*KEYS["design"].split()}
    assert not {"moves", "travel_deg"} & set(found)
    # doe/README.md, "Planar theorem": 4 sum_(j>=2) log sin(min(Delta_j / 2, 90 deg)), Delta = 240, 160, 180 deg
    assert found["bound"]["value"] == pytest.approx(4 * np.log(np.sin(np.radians(80.0))), abs=1e-12)
    assert found["certified_optimal"] is True
    postures = np.array(found["postures_deg"])
    assert postures.shape == (8, 4)
    assert np.all((postures >= LOWER) & (postures <= UPPER))
    written = pl.read_csv(folder.path / "plan8.csv")
    assert written.columns == ["run", "q1_deg", "q2_deg", "q3_deg", "q4_deg"]
    np.testing.assert_allclose(written.drop("run").to_numpy(), postures, atol=1e-9)
    assert folder.said("score arm.toml plan8.csv")["log_det"] == pytest.approx(found["log_det"], abs=1e-9)


def test_simulate_identify_round(folder: Folder) -> None:
    folder.simulated()
    found = folder.said("identify arm.toml data.csv --out calibrated.toml")
    assert set(found) >= {*KEYS["identify"].split()}
    for parameter, true in zip(found["parameters"], [1.5, -0.6, -0.4, 0.7, 0.5, -0.5, 0.7, -0.3], strict=True):
        assert abs(parameter["value"] - true) < 5 * parameter["std"]  # a 5-sigma event has probability 6e-7
        assert parameter["low_95"] < parameter["value"] < parameter["high_95"]
    again = folder.said("identify calibrated.toml data.csv")
    assert again["rms_before_mm"] == pytest.approx(found["rms_after_mm"], abs=1e-9)
    for one, two in zip(again["parameters"], found["parameters"], strict=True):
        assert one["value"] == pytest.approx(two["value"], abs=1e-7)
    first = folder.read("data.csv")
    for seed, same in ((0, True), (1, False)):
        folder.simulated(seed=seed)
        assert (folder.read("data.csv") == first) is same


def test_not_identifiable_is_named_and_exits_1(folder: Folder) -> None:
    folder.simulated()
    folder.write("arm.toml", ARM + '\n[[effects]]\nname = "base_rotation"\n')
    done = folder.armcal("identify arm.toml data.csv --json --out calibrated.toml")
    assert done.code == 1
    assert not (folder.path / "calibrated.toml").exists()
    assert any("joint_offset:1" in c and "base_rotation" in c for c in done.data["not_identifiable"])
    assert all(parameter["std"] is None or parameter["std"] < 10.0 for parameter in done.data["parameters"])


def test_conditions_in_the_plan_reach_the_measurements(folder: Folder) -> None:
    plan = pl.read_csv(folder.path / "plan.csv")
    plan.with_columns(temperature_C=20.0 + 0.5 * pl.int_range(12)).write_csv(folder.path / "warm.csv")
    growth = '\n[[effects]]\nname = "thermal_growth"\na_per_K = 0.001\n'
    folder.write("truth.toml", ARM.replace("sigma_mm = 0.1", "sigma_mm = 1e-9") + growth)
    folder.simulated(plan="warm.csv")
    data = pl.read_csv(folder.path / "data.csv")
    theta = np.cumsum(np.radians(data.select("q1_deg", "q2_deg", "q3_deg", "q4_deg").to_numpy()), axis=1)
    warmer = data["temperature_C"].to_numpy() - data["temperature_C"].mean()
    tip = (LENGTHS * np.exp(1j * theta)).sum(axis=1) * (1.0 + 0.001 * warmer)
    np.testing.assert_allclose(data["x_mm"].to_numpy(), tip.real, atol=1e-6)


def test_targets_beyond_the_identified_angles_are_said(folder: Folder) -> None:
    folder.simulated()
    folder.said("identify arm.toml data.csv --out calibrated.toml")
    folder.write("targets.csv", table({f"q{j}_deg": [10.0 * j, 10.0 * j + 169.99 * (j == 1)] for j in range(1, 5)}))
    said = "1 of 2 targets are outside the angles that the model was identified on (joint 1 in 1)"
    assert said in folder.armcal("compensate calibrated.toml targets.csv --json").err
    shown = folder.armcal("compensate calibrated.toml targets.csv")
    assert (said in shown.flat, shown.err) == (True, "")  # once


def test_validate_on_another_session_and_on_the_own_data(folder: Folder) -> None:
    folder.simulated()
    folder.said("identify arm.toml data.csv --out calibrated.toml")
    folder.simulated("other.csv", seed=1)
    found = folder.said("validate calibrated.toml other.csv")
    assert set(found) >= {*KEYS["validate"].split()}
    assert found["rows"] == 12
    assert found["rms_mm"] < 0.5 < 1.0 < found["rms_nominal_mm"]  # noise of 0.1 mm against errors of 0.5 deg
    own = folder.armcal("validate calibrated.toml data.csv --json")
    (note,) = own.data["notes"]
    assert f"warning: data.csv: {note}" in own.err
    shown = folder.armcal("validate calibrated.toml data.csv")
    assert (shown.flat.count("this says nothing about others"), shown.err) == (1, "")
    (refit,) = (parameter for parameter in main.commands["validate"].params if parameter.name == "refit")
    assert tuple(refit.type.choices) == tuple(DRAWN)


def test_a_plan_is_scored_by_its_weights_and_with_what_is_measured_already(folder: Folder) -> None:
    folder.said("relax arm.toml --grid 4 --no-check --out weights.csv")
    scored = folder.said("score arm.toml weights.csv")
    assert "runs distributed by the weights" in folder.armcal("score arm.toml weights.csv").flat
    assert scored["criteria"]["D"] == pytest.approx(scored["log_det"], abs=1e-9)
    assert scored["observability"]["o1"] == pytest.approx(np.exp(scored["log_det"] / 16), abs=1e-9)  # p = 8
    seven = folder.said("design arm.toml --runs 7 --starts 5 --out seven.csv")
    three = folder.said("design arm.toml --runs 3 --starts 5 --keep seven.csv")
    angles = np.radians([*three["postures_deg"], *seven["postures_deg"]])
    sums = [angles[:, j + 1 : k + 1].sum(axis=1) for j in range(4) for k in range(j + 1, 4)]
    largest = max(abs(np.mean(np.exp(1j * each))) for each in sums)
    assert three["table_1_max_residual"] == pytest.approx(largest, abs=1e-9)
    # seven rows that scatter 100 times as far tell next to nothing, and four runs no length better than sigma / sqrt(4)
    cells = enumerate(folder.read("seven.csv").splitlines())
    folder.write("poor.csv", "\n".join(line + (",10" if row else ",sigma_mm") for row, line in cells))
    four = folder.said("design arm.toml --runs 4 --starts 5 --keep poor.csv")
    assert min(four["std"]["length_mm"]) > 0.9999 * 0.1 / np.sqrt(4)
    printed = folder.armcal("design arm.toml --runs 3 --starts 5 --keep seven.csv").flat
    assert "these runs and the 7 measured already" in printed


def test_backlash_is_invisible_where_every_joint_comes_from_the_same_side(folder: Folder) -> None:
    same = folder.said("design arm.toml --runs 12 --discriminating --seconds 2 --approach positive --out same.csv")
    assert {f"backlash:{j}" for j in range(1, 5)} <= {*same["not_visible"]}  # as it is driven, not as it was found
    folder.said("design arm.toml --runs 12 --starts 2 --approach alternate --out both.csv")
    seen = {name: folder.said(f"score arm.toml {name}.csv --seconds 0.1")["preflight"] for name in ("same", "both")}
    sizes = {
        name: [each["detectable"] for each in one["effects"] if each["effect"].startswith("backlash")]
        for name, one in seen.items()
    }
    assert sizes["same"] == [None] * 4
    assert sizes["both"][1] is not None
    folder.write("play.toml", folder.read("arm.toml") + '\n[[effects]]\nname = "backlash"\njoint = 2\n')
    printed = folder.armcal("score play.toml both.csv --seconds 0.1").flat  # its log det is of joints that come alike
    assert "backlash:2.b, at one payload, temperature, time and approach direction" in printed
    assert "temperatures and directions of the plan; the figures above do not" in printed


# -- pages -------------------------------------------------------------------------------------------------------------
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
    assert (list(kinds), kinds["cal.toml"]) == (names.split(), "arm with a calibration")
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
    assert "On 12 rows of data.csv" in campaign_document(names[:3])[0].verdict[0]


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
    assert f"The next steps use the calibration {best}.toml" in " ".join(found["verdict"])
    text = folder.read("page.html")
    for name, figure in left.items():
        assert re.search(f">{name}.toml</td><td[^>]*>{figure:.4f}</td>", text)
    assert text.index(f">Corrected values: {best}.toml<") < text.index(f">Corrected values: {rest}.toml<")
    assert f"armcal compensate {best}.toml" in text
