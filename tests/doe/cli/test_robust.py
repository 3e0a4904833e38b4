"""`--robust` on the command line: plans, weights, scores, and what is refused."""

import re

import pytest

from tests.doe.cli.conftest import Folder

ARM = """name = "two"
links_mm = [300.0, 200.0]
[joint_limits_deg]
lower = [-170.0, -100.0]
upper = [170.0, 100.0]
[measurement]
sigma_mm = 0.1
"""
TRUTH = '[[effects]]\nname = "encoder_eccentricity"\njoint = 2\na_deg = 0.05\nb_deg = 0.03\n'
MISSING = "--missing gear_ratio,encoder_eccentricity"
FEW, ASKED = f"--robust {MISSING}", f"library-prior {MISSING}"


@pytest.fixture
def two(folder: Folder) -> Folder:
    folder.write("arm.toml", ARM)
    return folder


def test_design_score_and_relax_agree(two: Folder) -> None:
    designed = two.said(f"design arm.toml --runs 6 {FEW} --starts 2 --out best.csv")
    assert (designed["criterion"], designed["runs"], designed["bound"]["scope"]) == ("I", 6, "all postures")
    assert (designed["bound"]["proof"], designed["bound"]["rigorous"]) == ("numerical", False)
    assert designed["value"] <= designed["bound"]["value"]
    assert 0.0 < designed["efficiency"] <= 1.0
    scored = two.said(f"score arm.toml best.csv {FEW}")
    assert scored["value"] == pytest.approx(designed["value"], rel=1e-6)
    relaxed = two.said(f"relax arm.toml --runs 6 {FEW} --no-check")
    assert (relaxed["bound"]["scope"], relaxed["bound"]["proof"]) == ("list", "proven")
    assert relaxed["bound"]["value"] <= designed["bound"]["value"]  # of fewer postures
    # a budget of the bound cuts it and says so
    cut = two.said(f"score arm.toml best.csv {FEW} --seconds 1e-3")
    assert (cut["bound"]["cut"], "cut" in scored["bound"], cut["value"]) == (True, False, scored["value"])
    assert cut["bound"]["value"] >= scored["bound"]["value"]
    relaxed = two.said(f"relax arm.toml --runs 6 {FEW} --seconds 1e-3")
    assert relaxed["status"] == "time_limit"
    assert relaxed["bound"]["value"] >= scored["bound"]["value"]


def test_weights_on_a_grid_are_checked_by_a_plan_from_a_list(two: Folder) -> None:
    """As `design` chooses one: a search over all postures took 17 s of twelve joints before its first step."""
    found = two.said("relax arm.toml --robust --missing gear_ratio --runs 6 --grid 5 --seconds 1")
    (row,) = (row for row in found["cross_check"] if row["space"] == "6 runs")
    assert row["method"].startswith("exact plan, exchange")
    assert row["value"] <= row["bound"]


def test_every_plan_says_what_it_promises_beside_random_ones(two: Folder) -> None:
    """By the fit that the plan asks for, in words and in JSON; of a robust plan it is the criterion's own figure."""
    for words, fit in (("", None), (FEW, ASKED)):
        line = f"design arm.toml --runs 6 {words} --starts 1 --seed 1"
        tip = (found := two.said(line))["expected_tip"]
        assert (tip["fit"], tip["random_plans"]) == (fit, 50)
        if fit is None:
            text = f"{tip['plan_mm']:.3g} mm for this plan, {tip['random_median_mm']:.3g} mm for the median of 50"
            text += f" random plans; better than {100.0 * tip['better_than']:.0f} % of them"
            assert text in two.armcal(line).flat
        else:
            assert tip["plan_mm"] == pytest.approx(found["expected_error_mm"]["plan"], rel=1e-6)
    two.write("arm.toml", ARM.partition("[measurement]")[0])
    assert two.said("design arm.toml --runs 6")["expected_tip"] is None


def test_a_plan_carries_how_it_is_to_be_fitted_and_identify_follows(two: Folder) -> None:
    """From `design --robust` by `simulate` to `identify`, which fits as if --library-prior had been given."""
    two.write("truth.toml", ARM + TRUTH)
    shown = two.armcal(f"design arm.toml --runs 9 {FEW} --starts 1 --out best.csv --order random")
    assert f"armcal identify arm.toml DATA --{ASKED} --out calibrated.toml" in shown.flat
    assert two.read("best.csv").startswith(f"# fit: {ASKED}\nrun,q1_deg")
    two.simulated(plan="best.csv")
    assert two.read("data.csv").startswith(f"# fit: {ASKED}\n")
    two.write("bare.csv", two.read("data.csv").partition("\n")[2])
    followed, plain, explicit, refused, partial = (
        two.said(f"identify arm.toml {words}")
        for words in (
            "data.csv",
            "bare.csv",
            f"bare.csv --{ASKED}",
            "data.csv --no-library-prior",
            "data.csv --only joint_offsets",
        )
    )
    assert followed["fit"] == {"asked": ASKED, "followed": True, "against": None}
    assert followed["parameters"] == explicit["parameters"] != plain["parameters"]
    assert followed["prior"] == explicit["prior"]
    assert "fit" not in plain | explicit
    assert refused["parameters"] == plain["parameters"]
    assert refused["fit"] == {"asked": ASKED, "followed": False, "against": "--no-library-prior"}
    assert partial["fit"]["against"] == "--only"


@pytest.mark.parametrize(
    ("line", "option"),
    [("design arm.toml --runs 5 --robust", "--robust"), ("advise arm.toml --target-mm 0.1", "--target-mm")],
)
def test_without_a_scatter_it_is_said_what_to_add(two: Folder, line: str, option: str) -> None:
    """In one line, and what it says to add is what the command then accepts."""
    bare = two.write("arm.toml", ARM.partition("[measurement]")[0])
    two.refused(line, f"armcal: {option} needs the instrument's")
    added = re.search(r"the line (\[.*\]) to the arm file and below it (sigma_mm = [\d.]+)", two.armcal(line).err)
    assert added is not None
    bare.write_text(bare.read_text() + "\n".join(added.groups()))
    assert two.armcal(line + {"--robust": " --missing gear_ratio --starts 1"}.get(option, " --runs 4:6")).code == 0


def test_what_a_robust_plan_does_not_count_is_said(two: Folder) -> None:
    done = two.armcal("design arm.toml --runs 6 --robust --missing gear_ratio,backlash --starts 1")
    assert "--missing: the plan does not allow for backlash:1 (needs directions)" in done.err
    assert "no plan of 6 runs from all postures can be below" in done.flat
    assert "if the arm has effects of --missing that its file does not name" in done.flat
    allowed = "which also allows for effects of the order of the rows"  # of the fit, not of the plan
    assert allowed not in done.flat
    assert allowed in two.armcal("design arm.toml --runs 6 --robust --starts 1").flat
