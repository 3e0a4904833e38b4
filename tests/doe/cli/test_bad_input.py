"""Every kind of bad input: exit 2, one line that says where, what and what is allowed; no output file."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from identification.errors import InputError
from tests.doe.cli.conftest import ARM, Folder

HEADER = "q1_deg,q2_deg,q3_deg,q4_deg,x_mm,y_mm\n"


def refused(folder: Folder, words: list[str], *expected: str) -> None:
    done = folder.armcal(*words)
    assert done.code == 2, (done.code, done.out, done.err)
    lines = [line for line in done.err.splitlines() if not line.startswith("armcal: warning:")]
    assert len(lines) == 1, done.err
    for text in expected:
        assert text in lines[0], lines[0]
    assert done.out == ""
    assert not (folder.path / "out.file").exists()


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("-120.0, -100.0, -90.0]", "120.0, -100.0, -90.0]", ("joint 2", "120", "lower < upper")),
        ("upper = [180.0, 120.0, 60.0, 90.0]", "upper = [180.0, 120.0, 60.0]", ("upper", "3", "4")),
        ("180.0, 120.0, 100.0]", "-180.0, 120.0, 100.0]", ("links_mm", "-180", "> 0")),
        ("sigma_mm = 0.1", "sigma_mm = 0.0", ("sigma_mm", "0", "> 0")),
        ("sigma_mm = 0.1", "sigma_mm = nan", ("sigma_mm", "nan")),
        ("sigma_mm", "sigma_m", ("sigma_m", "did you mean 'sigma_mm'?")),
        ("links_mm", "link_mm", ("link_mm", "links_mm")),
        ("links_mm = [", "links_mm = [[", ("line",)),
    ],
)
def test_arm_file(folder: Folder, old: str, new: str, expected: tuple[str, ...]) -> None:
    assert old in ARM
    folder.write("arm.toml", ARM.replace(old, new, 1))
    refused(folder, ["design", "arm.toml", "--runs", "8", "--out", "out.file"], "arm.toml", *expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ("empty",)),
        (HEADER, ("no rows",)),
        (HEADER + "0,0,0,0,660,0\n1,2,3,4,nan,5\n", ("x_mm", "nan", "row 2")),
        (HEADER + "0,0,0,0,660,0\n1,2,three,4,5,5\n", ("q3_deg", "three", "row 2")),
        (HEADER.replace(",y_mm", "") + "0,0,0,0,660\n", ("y_mm",)),
        (HEADER.replace("q4_deg,", "") + "0,0,0,660,0\n", ("q4_deg",)),
        (HEADER + "0,0,0,0,660,0\n" * 3, ("2 m", "6", "8", "m >= 4")),
    ],
)
def test_measurements(folder: Folder, text: str, expected: tuple[str, ...]) -> None:
    folder.write("data.csv", text)
    refused(folder, ["identify", "arm.toml", "data.csv", "--out", "out.file"], *expected)


@pytest.mark.parametrize(
    ("columns", "factor", "unit"), [("xy", 1e-3, "are in metres ("), ("q", np.pi / 180.0, "look like radians: ")]
)
def test_measurements_in_other_units(folder: Folder, columns: str, factor: float, unit: str) -> None:
    """No word helps against them; `armcal check` says what to do."""
    folder.simulated()
    frame = pl.read_csv(folder.path / "data.csv")
    wrong = [pl.col(name) * factor for name in frame.columns if name[0] in columns and name.endswith(("_mm", "_deg"))]
    frame.with_columns(wrong).write_csv(folder.path / "data.csv")
    expected = ("data.csv: the ", f"{unit}name the columns ", "instead of")
    for verb in ("identify", "diagnose"):
        refused(folder, [verb, "arm.toml", "data.csv", "--out", "out.file", "--force"], *expected)
    refused(folder, ["validate", "truth.toml", "data.csv"], *expected)
    (problem,) = folder.armcal("check", "arm.toml", "data.csv", "--json").data["problems"]
    assert expected[1] in problem


def test_score_of_fewer_runs_than_links(folder: Folder) -> None:
    folder.write("short.csv", "run,q1_deg,q2_deg,q3_deg,q4_deg\n1,0,10,20,30\n2,0,40,50,60\n")
    refused(folder, ["score", "arm.toml", "short.csv"], "short.csv", "2 runs", "at least 4")


def test_aliases_of_too_few_runs(folder: Folder) -> None:
    rows = "".join(f"{k},{10 * k},{7 * k * k},{-9 * k},{5 * k}\n" for k in range(1, 6))
    folder.write("few.csv", "run,q1_deg,q2_deg,q3_deg,q4_deg\n" + rows)  # 10 coordinates, 8 parameters
    words = ["score", "arm.toml", "few.csv", "--aliases", "aliases.png", "--picture", "plan.png"]
    refused(folder, words, "--aliases", "few.csv", "degrees of freedom")
    assert not list(folder.path.glob("*.png"))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--minimum-distance-deg", "-1"], ("minimum distance", "-1 deg", ">= 0")),
        (["--minimum-distance-deg", "nan"], ("minimum distance", "nan", ">= 0")),
        # the joints to choose turn by 240, 160, 180 deg: room for 2 x 1 x 1 postures 200 deg apart
        (["--minimum-distance-deg", "200"], ("runs", "8 postures 200 deg apart", "at most 2")),
        (["--loss", "0.05"], ("--loss", "found without", "allowed: with --discriminating")),
        (["--draws", "3"], ("--draws", "found without", "allowed: with --uncertain")),
        (["--discriminating", "--criterion", "A"], ("criterion", "A", "discriminating", "allowed: D")),
        (["--discriminating", "--uncertain", "average"], ("criterion", "average", "allowed: D")),
        (["--test-poses", "plan.csv"], ("--test-poses", "criterion D", "criterion I")),
        (["--subset", "length_error:1"], ("--subset", "criterion D", "criterion Ds")),
        (["--criterion", "Ds"], ("subset", "none", "at least one")),
        (["--solver", "fedorov"], ("fedorov", "list of postures", "allowed: with --candidates")),
        (["--candidates", "far.csv"], ("far.csv", "0 of 1", "at least one")),
    ],
)
def test_options_that_do_not_fit(folder: Folder, words: list[str], expected: tuple[str, ...]) -> None:
    folder.write("far.csv", "run,q1_deg,q2_deg,q3_deg,q4_deg\n1,0,170,0,0\n")
    folder.write("plan.csv", "run,q1_deg,q2_deg,q3_deg,q4_deg\n1,0,10,0,0\n")
    refused(folder, ["design", "arm.toml", "--runs", "8", "--out", "out.file", *words], *expected)


def test_gravity_is_missed_in_the_file(folder: Folder) -> None:
    folder.write("arm.toml", ARM + '\n[[effects]]\nname = "joint_compliance"\n')
    refused(folder, ["design", "arm.toml", "--runs", "8"], "arm.toml", "joint_compliance", "[gravity]")


def test_more_runs_than_memory(folder: Folder) -> None:
    refused(folder, ["design", "arm.toml", "--runs", "1000000000"], "--runs", "1000000000")


def test_fewer_runs_than_links(folder: Folder) -> None:
    refused(folder, ["design", "arm.toml", "--runs", "3", "--out", "out.file"], "runs", "3", "4")


def test_effect_without_its_data(folder: Folder) -> None:
    folder.simulated()
    folder.write("arm.toml", ARM + '\n[[effects]]\nname = "thermal_growth"\n')
    refused(folder, ["identify", "arm.toml", "data.csv"], "thermal_growth", "temperature_C")
    folder.write("arm.toml", ARM + '\n[[effects]]\nname = "joint_compliance"\n')
    refused(folder, ["identify", "arm.toml", "data.csv"], "joint_compliance", "[gravity]")


CLASHES = [
    ("diagnose arm.toml data.csv --out out.file --report ./out.file", "--report", "out.file"),
    ("score arm.toml plan.csv --picture out.file --aliases out.file", "--aliases", "out.file"),
    ("design arm.toml --runs 8 --picture same.png --out same.png", "--picture", "same.png"),
    ("design arm.toml --runs 8 --keep plan.csv --out plan.csv", "--keep", "plan.csv"),
    ("design arm.toml --runs 8 --candidates plan.csv --picture ./plan.csv", "--candidates", "plan.csv"),
    ("design arm.toml --runs 8 --criterion I --test-poses plan.csv --out plan.csv", "--test-poses", "plan.csv"),
    ("identify arm.toml data.csv --out data.csv", "DATA", "data.csv"),
    ("design arm.toml --runs 8 --out link.toml", "ARM", "link.toml"),
    ("simulate arm.toml plan.csv --truth arm.toml --out plan.csv", "PLAN", "plan.csv"),
    ("simulate arm.toml plan.csv --truth truth.toml --out truth.toml", "--truth", "truth.toml"),
    ("compensate truth.toml plan.csv --out truth.toml", "CALIBRATED", "truth.toml"),
    ("diagnose arm.toml data.csv --holdout plan.csv --report plan.csv", "--holdout", "plan.csv"),
    ("compare arm.toml rows.parquet --runs 8 --out rows.parquet", "ARM", "rows.parquet"),
]


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize(("words", "other", "file"), CLASHES, ids=[words for words, *_ in CLASHES])
def test_an_output_that_is_another_file_of_the_call(
    folder: Folder, words: str, other: str, file: str, force: bool
) -> None:
    (folder.path / "link.toml").symlink_to("arm.toml")
    folder.write("data.csv", HEADER + "0,0,0,0,660,0\n")
    before = {path.name: path.read_bytes() for path in folder.path.iterdir()}
    refused(folder, [*words.split(), *["--force"][:force]], other, file, "allowed: another name")
    assert {path.name: path.read_bytes() for path in folder.path.iterdir()} == before


def test_payloads_without_gravity(folder: Folder) -> None:
    folder.write("data.csv", HEADER + "0,0,0,0,660,0\n")
    words = ["discriminate", "arm.toml", "data.csv", "--runs", "2", "--payloads", "0,5"]
    refused(folder, words, "--payloads", "[gravity]")


def test_unknown_names(folder: Folder) -> None:
    folder.simulated()
    refused(folder, ["design", "arm.toml", "--runs", "8", "--solver", "ipotp"], "ipotp", "ipopt")
    refused(folder, ["identify", "arm.toml", "data.csv", "--method", "linaer"], "linaer", "linear")
    folder.write("arm.toml", ARM + '\n[[effects]]\nname = "base_ofset"\n')
    refused(folder, ["identify", "arm.toml", "data.csv"], "base_ofset", "did you mean 'base_offset'?")


def test_missing_file_and_existing_output(folder: Folder) -> None:
    refused(folder, ["design", "nowhere.toml", "--runs", "8"], "nowhere.toml")
    folder.write("plan2.csv", "mine")
    refused(folder, ["design", "arm.toml", "--runs", "8", "--out", "plan2.csv"], "plan2.csv", "--force")
    assert folder.read("plan2.csv") == "mine"


def test_radians_in_a_degree_column_warn(folder: Folder) -> None:
    import polars as pl

    folder.simulated()
    frame = pl.read_csv("data.csv")
    frame.with_columns(pl.col(f"q{j}_deg").radians() for j in range(1, 5)).write_csv("radians.csv")
    done = folder.armcal("identify", "arm.toml", "radians.csv")
    assert "radians" in done.err
    frame.with_columns(pl.col("x_mm") / 1000, pl.col("y_mm") / 1000).write_csv("metres.csv")
    done = folder.armcal("identify", "arm.toml", "metres.csv")
    assert "metres" in done.err


def test_unknown_verb(folder: Folder) -> None:
    done = folder.armcal("desing")
    assert done.code == 2
    assert "did you mean 'design'?" in done.err


@pytest.mark.parametrize(
    "words",
    [
        ["design", "arm.toml", "--runs", "0"],
        ["design", "arm.toml", "--runs", "ten"],
        ["design", "arm.toml"],
        ["design", "arm.toml", "--runs", "8", "--seed", "-1"],
        ["design", "arm.toml", "--runs", "8", "--seconds", "nan"],
        ["design", "arm.toml", "--runs", "8", "--colour", "red"],
        ["advise", "arm.toml", "--seconds", "nan"],
        ["identify", "arm.toml"],
    ],
    ids=" ".join,
)
def test_usage(folder: Folder, words: list[str]) -> None:
    refused(folder, words)


def test_numbers_that_would_overflow(folder: Folder) -> None:
    row = "0,0,0,0,660,0\n1,2,3,4,5,5\n2,3,4,5,6,7\n3,4,5,6,7,8\n"
    for old, new, column in (("660", "1e200", "x_mm"), ("660", "-1e308", "x_mm"), ("0,0,0,0", "0,1e300,0,0", "q2_deg")):
        folder.write("data.csv", HEADER + row.replace(old, new, 1))
        refused(folder, ["identify", "arm.toml", "data.csv"], "row 1", column, "up to")
    for old, new in (("sigma_mm = 0.1", "sigma_mm = 1e308"), ("100.0]", "1e300]"), ("-120.0", "-1e300")):
        assert old in ARM
        folder.write("arm.toml", ARM.replace(old, new, 1))
        refused(folder, ["design", "arm.toml", "--runs", "8"], "arm.toml", "allowed")


def test_a_calibration_that_turns_a_link_round(folder: Folder) -> None:
    for error in (-180.0, -500.0):
        table = f"length_errors_mm = [0.0, {error}, 0.0, 0.0]\njoint_offsets_deg = [0.0, 0.0, 0.0, 0.0]"
        folder.write("arm.toml", f"{ARM}\n[calibration]\n{table}\n")
        refused(folder, ["design", "arm.toml", "--runs", "8"], "calibration.length_errors_mm", "link 2", "-180")


def test_a_plan_outside_the_limits_warns(folder: Folder) -> None:
    rows = "".join(f"{run},{72 * run},{72 * run},{72 * run},{72 * run}\n" for run in range(5))
    folder.write("fourier.csv", "run,q1_deg,q2_deg,q3_deg,q4_deg\n" + rows)
    done = folder.armcal("score", "arm.toml", "fourier.csv")
    assert done.code == 0
    assert "outside joint limits" in done.err
    assert "no: runs 2, 3, 4, 5 are outside joint limits or constraints" in done.out


@pytest.mark.parametrize(
    ("effect", "missing"),
    [
        ('name = "outliers"', "no value of share, size"),
        ('name = "outliers"\nshare = 0.1', "no value of size"),
        ('name = "joint_noise"\njoint = 2', "no value of std_deg"),
    ],
)
def test_scatter_without_values_is_no_truth(folder: Folder, effect: str, missing: str) -> None:
    folder.write("truth.toml", ARM + f"\n[[effects]]\n{effect}\n")
    words = ["simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--out", "out.file"]
    refused(folder, words, "truth.toml: effects:", missing, "allowed: a number for each")


def test_a_truth_that_is_none_warns(folder: Folder) -> None:
    effect = '\n[[effects]]\nname = "encoder_eccentricity"\njoint = 2\n'
    folder.write("truth.toml", ARM + effect)
    words = ["simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--out"]
    done = folder.armcal(*words, "empty.csv")
    assert done.code == 0
    sentence = "truth.toml: encoder_eccentricity:2 has no value and does nothing; it has a_deg, b_deg"
    assert done.err == f"armcal: warning: {sentence}\n"
    folder.write("truth.toml", ARM + effect + "a_deg = 0.1\n")
    assert folder.armcal(*words, "known.csv").err == ""
    calibrated = "\n[calibration]\nlength_errors_mm = [0, 0, 0, 0.0]\njoint_offsets_deg = [0, 0, 0, 0.0]\n"
    values = '\n[calibration.effects]\n"encoder_eccentricity:2.a_deg" = 0.1\n'
    folder.write("truth.toml", ARM + effect + calibrated + values)
    assert folder.armcal(*words, "calibrated.csv").err == ""


def test_a_truth_without_sigma(folder: Folder) -> None:
    bare = ARM.partition("[measurement]")[0]
    folder.write("arm.toml", bare)
    folder.write("truth.toml", bare)
    words = ["simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--out", "out.file"]
    refused(folder, words, "arm.toml: measurement.sigma_mm is missing, allowed: a number > 0 [mm], here or in truth.to")


def test_a_column_in_capitals_is_known_again(folder: Folder) -> None:
    folder.write("data.csv", HEADER.replace("x_mm", "X_mm") + "0,0,0,0,660,0\n" * 4)
    refused(folder, ["identify", "arm.toml", "data.csv"], "column 'x_mm' is missing", "did you mean to rename 'X_mm'?")


def test_a_dead_cluster_leaves_no_folder(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    def choose(workers: int | None, cluster: str | None) -> None:
        raise InputError(f"--cluster {cluster}: no scheduler answers")

    monkeypatch.setattr("doe.jobs.running.chosen_workers", choose)
    words = ["compare", "arm.toml", "--runs", "8", "--cluster", "tcp://127.0.0.1:9", "--out", "folder"]
    refused(folder, words, "no scheduler answers")
    assert not (folder.path / "folder").exists()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('plans = ["exchange_ipopt"]\nruns = [3]\n', "runs: found 3, allowed: at least 4 for 8 parameters"),
        ('plans = ["randm"]\nruns = [8]\n', "did you mean 'random'? allowed: analytic"),
        ('plans = ["randm"]\nruns = [8]\n', "ipopt, random, relaxation_rounding, or NAME.csv"),
        (
            'plans = ["random"]\nruns = [8]\n[[truths]]\nname = "t"\nlength_errors_mm = [1.0]\n',
            "study.toml: truths: t with arm paper-4-link: length_errors_mm: found 1 values for 4 links, allowed: 4",
        ),
        (
            'plans = ["random"]\nruns = [8]\n[[truths]]\nname = "t"\neffects = [{name = "outliers", share = 0.1}]\n',
            "study.toml: truths: t with arm paper-4-link: outliers, which changes the scatter, is not simulated here",
        ),
    ],
)
def test_studies_that_cannot_be_done(folder: Folder, text: str, expected: str) -> None:
    folder.write("study.toml", 'arms = ["arm.toml"]\n' + text)
    refused(folder, ["study", "study.toml", "--workers", "1", "--out", "folder"], expected)
    assert not (folder.path / "folder").exists()


def test_cells_of_a_study_that_has_none(folder: Folder) -> None:
    refused(folder, ["study", "paper", "--cell", "none m=20"], "--cell", "allowed: of blind and blind-spatial")
    refused(folder, ["study", "blind", "--cell", "none, Student t4"], "did you mean 'none, Student t3'?")
    assert not list(folder.path.glob("*.results"))
