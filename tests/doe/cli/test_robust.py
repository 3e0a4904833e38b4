"""`--robust` on the command line: plans, weights, scores, and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from doe.cli.main import main

ARM = """name = "two"
links_mm = [300.0, 200.0]
[joint_limits_deg]
lower = [-170.0, -100.0]
upper = [170.0, 100.0]
[measurement]
sigma_mm = 0.1
"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "arm.toml"
    path.write_text(ARM)
    return path


def armcal(*words: object) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


def answer(*words: object) -> dict:  # type: ignore[type-arg]
    result = armcal(*words, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_design_score_and_relax_agree(arm: Path, tmp_path: Path) -> None:
    plan, few = tmp_path / "plan.csv", "gear_ratio,encoder_eccentricity"
    designed = answer("design", arm, "--runs", 6, "--robust", "--missing", few, "--out", plan)
    assert (designed["criterion"], designed["runs"], designed["bound"]["scope"]) == ("I", 6, "all postures")
    assert (designed["bound"]["proof"], designed["bound"]["rigorous"]) == ("numerical", False)
    assert designed["value"] <= designed["bound"]["value"]
    assert 0.0 < designed["efficiency"] <= 1.0
    scored = answer("score", arm, plan, "--robust", "--missing", few)
    assert scored["value"] == pytest.approx(designed["value"], rel=1e-6)
    relaxed = answer("relax", arm, "--robust", "--missing", few, "--runs", 6, "--no-check")
    assert (relaxed["bound"]["scope"], relaxed["bound"]["proof"]) == ("list", "proven")
    assert relaxed["bound"]["value"] <= designed["bound"]["value"]  # of fewer postures


def test_weights_on_a_grid_are_checked_by_a_plan_from_a_list(arm: Path) -> None:
    """As `design` chooses one: a search over all postures took 17 s of twelve joints before its first step."""
    few = ("--robust", "--missing", "gear_ratio", "--runs", 6, "--grid", 5, "--seconds", 1)
    rows = {row["space"]: row for row in answer("relax", arm, *few)["cross_check"]}
    assert rows["6 runs"]["method"].startswith("exact plan, fedorov")
    assert rows["6 runs"]["value"] <= rows["6 runs"]["bound"]


def test_every_plan_says_what_it_promises_beside_random_ones(arm: Path) -> None:
    """By the fit that the plan asks for, in words and in JSON; of a robust plan it is the criterion's own figure."""
    few = ("--robust", "--missing", "gear_ratio,encoder_eccentricity")
    for words, fit in (((), None), (few, f"library-prior --missing {few[2]}")):
        found = answer("design", arm, "--runs", 6, *words, "--seed", 1)
        tip, shown = found["expected_tip"], flat(armcal("design", arm, "--runs", 6, *words, "--seed", 1).output)
        assert (tip["fit"], tip["random_plans"]) == (fit, 50)
        assert f"{tip['plan_mm']:.3g} mm by this plan, {tip['random_median_mm']:.3g} mm by the median of 50" in shown
        if fit is not None:
            assert tip["plan_mm"] == pytest.approx(found["expected_error_mm"]["plan"], rel=1e-6)
    arm.write_text(ARM.replace("[measurement]\nsigma_mm = 0.1\n", ""))
    assert answer("design", arm, "--runs", 6)["expected_tip"] is None


TRUTH = '[[effects]]\nname = "encoder_eccentricity"\njoint = 2\na_deg = 0.05\nb_deg = 0.03\n'


def test_a_plan_carries_how_it_is_to_be_fitted_and_identify_follows(arm: Path, tmp_path: Path) -> None:
    """From `design --robust` by `simulate` to `identify`, which fits as if --library-prior had been given."""
    plan, data, truth, bare = (tmp_path / name for name in ("plan.csv", "data.csv", "truth.toml", "bare.csv"))
    truth.write_text(ARM + TRUTH)
    few = ("--missing", "gear_ratio,encoder_eccentricity")
    shown = armcal("design", arm, "--runs", 9, "--robust", *few, "--out", plan, "--order", "random")
    asked = "library-prior --missing gear_ratio,encoder_eccentricity"
    assert f"armcal identify {arm} DATA --{asked} --out calibrated.toml" in flat(shown.output)
    assert plan.read_text().startswith(f"# fit: {asked}\nrun,q1_deg")
    answer("simulate", arm, plan, "--truth", truth, "--out", data)
    assert data.read_text().startswith(f"# fit: {asked}\n")
    bare.write_text(data.read_text().partition("\n")[2])
    followed, plain = answer("identify", arm, data), answer("identify", arm, bare)
    explicit = answer("identify", arm, bare, "--library-prior", *few)
    assert followed["fit"] == {"asked": asked, "followed": True, "against": None}
    assert followed["parameters"] == explicit["parameters"] != plain["parameters"]
    assert followed["prior"] == explicit["prior"]
    assert "fit" not in plain
    assert "fit" not in explicit
    refused = answer("identify", arm, data, "--no-library-prior")
    assert refused["parameters"] == plain["parameters"]
    assert refused["fit"] == {"asked": asked, "followed": False, "against": "--no-library-prior"}
    assert answer("identify", arm, data, "--method", "linear")["fit"]["against"] == "--method linear"


def test_every_reader_takes_the_comment(arm: Path, tmp_path: Path) -> None:
    """Plans and measurements with one, also as a spreadsheet hands them back, and with comments of any other kind."""
    rows = "".join(f"{k + 1};{67 * k % 330 - 165};{37 * k % 190 - 95}\n" for k in range(12))
    plan, data, truth, page = (tmp_path / name for name in ("plan.csv", "data.csv", "truth.toml", "page.html"))
    plan.write_text('"# fit: library-prior";;\n# measured on Monday;;\nrun;q1_deg;q2_deg\n' + rows)
    truth.write_text(ARM + TRUTH)
    assert answer("score", arm, plan)["fit"] == "library-prior"
    answer("simulate", arm, plan, "--truth", truth, "--out", data)
    assert data.read_text().startswith("# fit: library-prior\nq1_deg")
    for words in (
        ("design", arm, "--runs", 4, "--keep", data), ("design", arm, "--runs", 4, "--candidates", plan),
        ("design", arm, "--runs", 4, "--criterion", "I", "--test-poses", plan), ("check", arm, data),
        ("relax", arm, "--candidates", plan, "--no-check"),
    ):  # fmt: skip
        answer(*words)
    answer("report", arm, plan, "--out", page)
    assert "data.csv --library-prior --out calibrated.toml" in page.read_text()


def flat(text: str) -> str:
    return " ".join(text.split())


def test_advise_says_what_missing_effects_cost(arm: Path) -> None:
    row = answer("advise", arm, "--runs", "6:6")["rows"][0]["tip_error_mm"]
    assert row["model_right"] < row["effects_missing_prior"] < row["effects_missing"]


@pytest.mark.parametrize("words", [["design", "--runs", "5", "--robust"], ["advise", "--target-mm", "0.1"]])
def test_without_a_scatter_it_is_said_what_to_add(arm: Path, words: list[str]) -> None:
    """In one line, and what it says to add is what the command then accepts."""
    table = "[measurement]\nsigma_mm = 0.1\n"
    arm.write_text(ARM.replace(table, ""))
    result = armcal(words[0], arm, *words[1:])
    (line,) = result.stderr.splitlines()
    assert result.exit_code == 2
    assert line.startswith(f"armcal: {words[-1] if words[-1] == '--robust' else '--target-mm'} needs the instrument's")
    added = re.search(r"the line (\[.*\]) and below it (sigma_mm = [\d.]+)", line)
    assert added is not None
    arm.write_text(arm.read_text() + "\n".join(added.groups()))
    assert armcal(words[0], arm, *words[1:], *("--missing", "gear_ratio")[: 2 * (words[0] == "design")]).exit_code == 0


def test_advise_of_some_parameters(arm: Path) -> None:
    found = answer("advise", arm, "--only", "base,joint_offset:2", "--runs", "2:2")
    assert (found["only"], found["fewest_runs"]) == (["base", "joint_offset:2"], 2)
    assert found["rows"][0]["largest_length_std_mm"] == 0.0


def test_a_budget_of_the_bound_cuts_it_and_says_so(arm: Path, tmp_path: Path) -> None:
    """A cut bound is above that of the whole search, and the value of the plan is the same."""
    plan, few = tmp_path / "plan.csv", ("--robust", "--missing", "gear_ratio,encoder_eccentricity")
    answer("design", arm, "--runs", 6, *few, "--out", plan)
    whole = answer("score", arm, plan, *few)
    cut = answer("score", arm, plan, *few, "--seconds", 1e-3)
    assert cut["bound"]["cut"]
    assert "cut" not in whole["bound"]
    assert cut["bound"]["value"] >= whole["bound"]["value"]
    assert cut["value"] == whole["value"]
    relaxed = answer("relax", arm, "--runs", 6, *few, "--seconds", 1e-3)
    assert relaxed["status"] == "time_limit"
    assert relaxed["bound"]["value"] >= whole["bound"]["value"]
