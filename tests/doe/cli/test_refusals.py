"""Whatever cannot be done ends in exit code 2 and one line that names the place; nothing is written."""

import os
import re
from pathlib import Path
from typing import Any

import click
import numpy as np
import polars as pl
import pytest

from doe.cli import main
from doe.cli.verb import LONGEST_LINE, in_one_line, seconds_above_zero, whole_numbers
from identification import InputError
from identification.files.csv import read_table
from tests.doe.cli.conftest import ARM, CALIBRATION, Folder

HEADER = "q1_deg,q2_deg,q3_deg,q4_deg,x_mm,y_mm\n"
PLAN = "run,q1_deg,q2_deg,q3_deg,q4_deg\n"
URDF = str(Path(__file__).parents[2] / "data/spatial/six_axis.urdf")
SPATIAL = 'kind = "spatial"\n' + "[[dh]]\na_mm = 300.0\nalpha_deg = 90.0\nd_mm = 50.0\n" * 4
STUDY = 'arms = ["arm.toml"]\n'
LONG = "a" * 300
DESIGN = "design bad.toml --runs 8 --out out.file"
SIMULATE = "simulate arm.toml plan.csv --truth bad.toml --out out.file"
FIT, SCORE = "identify bad.toml data.csv", "score arm.toml bad.csv"
BARE = ARM.partition("[measurement]")[0]
ONE_POSTURE = "".join(f"10,20,-30,{40 + 1e-6 * k:.7f},{300 + 0.1 * (k % 7)},{90 - 0.1 * (k % 5)}\n" for k in range(60))
COMMANDS = "q1_deg,q2_deg,q3_deg,q4_deg,x_mm,y_mm,error_mm,reachable\n1,2,3,4,5,x,0.1,1\n"
Case = tuple[str | list[str], list[str], dict[str, str]]


def case(words: str | list[str], named: str = "", *more: str, **files: str) -> Case:
    """A command, what its line names ("; " in between), and the files that are wrong, by their kind or name."""
    names = {"toml": "bad.toml", "csv": "bad.csv", "study": "study.toml"}
    return words, [*named.split("; "), *more], {names.get(k, k.replace("_", ".")): text for k, text in files.items()}


def changed(old: str, new: str) -> str:
    """The arm file with a part replaced."""
    assert old in ARM
    return ARM.replace(old, new, 1)


CASES: list[Case] = [
    # arm files and measurements: what each reader says of them is tested beside it
    case(DESIGN, "bad.toml; joint 2; 120; lower < upper", toml=changed("-120.0, -100.0", "120.0, -100.0")),
    case("discriminate arm.toml data.csv --runs 2 --payloads 0,5", "--payloads; [gravity]"),
    case("relax arm.toml --grid 3 --candidates plan.csv", "--grid; without --candidates"),
    case("design arm.toml --runs 8 --keep bad.csv", "weights", csv="q1_deg,q2_deg,q3_deg,q4_deg,weight\n1,2,3,4,1\n"),
    case("advise arm.toml --target-mm -1", "--target-mm; found -1; allowed: > 0"),
    case("diagnose arm.toml Cal.TOML", "Cal.TOML; arm file", Cal_TOML=ARM + CALIBRATION),
    case("discriminate arm.toml bad.csv --runs 1", "60 rows of 1 posture; at least 4", csv=HEADER + ONE_POSTURE),
    # arms and measurements in space
    case("identify arm.toml data.csv --urdf x.urdf", "--urdf; planar"),
    case(FIT, "'z_mm'", toml=SPATIAL),
    case(
        "simulate bad.toml plan.csv --truth arm.toml --out out.file",
        "arm.toml; planar; spatial",
        toml=SPATIAL + "[measurement]\nsigma_mm = 0.1\n",
    ),
    # plans and truths
    case(SCORE, "bad.csv; runs: found 2; at least 4", csv=PLAN + "1,0,10,20,30\n2,0,40,50,60\n"),
    case(SIMULATE, "bad.toml: effects", "size", toml=ARM + '[[effects]]\nname = "outliers"\nshare = 0.1\n'),
    case(SIMULATE.replace("arm.toml", "bad.toml"), "bad.toml; measurement.sigma_mm", toml=BARE),
    case(SIMULATE, "temperature_C", toml=ARM + '[[effects]]\nname = "thermal_growth"\na_per_K = 0.001\n'),
    case(SIMULATE, "up to 1e+09", toml=changed("[260.0, 180.0, 120.0, 100.0]", "[9e8, 9e8, 9e8, 9e8]")),
    case(
        "simulate arm.toml bad.csv --truth arm.toml --out out.file",
        "payload_kg",
        csv=PLAN.replace("\n", ",payload_kg\n") + "1,0,1,2,3,5e300\n" * 4,
    ),
    # options that do not fit
    *(
        case(f"design arm.toml --out out.file --runs {words}", named)
        for words, named in (
            ("8 --discriminating --criterion A", "criterion; A; discriminating; D"),
            ("8 --test-poses plan.csv", "--test-poses; criterion D; criterion I"),
            ("8 --criterion Ds --subset lenth_error:1", "--subset; unknown parameter 'lenth_error:1'; length_error:1"),
            ("8 --subset length_error:1", "--subset; criterion D; criterion Ds"),
            ("8 --criterion Ds", "--subset; none; one parameter or more"),
            ("8 --candidates far.csv", "far.csv; 0 of 1"),
            ("5 --missing backlash", "--missing; --robust"),
            ("5 --robust --discriminating", "--discriminating; --robust"),
            ("8 --picture p.gif", "p.gif; .png, .svg, .pdf"),
        )
    ),
    *(
        case(["advise", "arm.toml", "--runs", text], "--runs; A:B or A")
        for text in ("²:5", "4:²", "9" * 5000, "4:" + "9" * 12)
    ),
    case("relax arm.toml --robust", "--robust; --runs"),
    case("relax arm.toml --runs 5", "--runs; --robust"),
    case("relax arm.toml --solver clarabel --seconds 1"),
    *(case(f"relax arm.toml --grid {n}", "grid", n, "allowed: 2 to 256") for n in ("513", "9999999", "9" * 20)),
    case("identify arm.toml data.csv --only length", "'lengths'"),
    case("validate arm.toml data.csv", "calibration"),
    case("program arm.toml plan.csv --out out.file", "'--robot'. Choose from: ur, abb"),
    case("compare arm.toml --runs 8 --criterion I", "compare does not offer 'I'; Dstar"),
    # studies
    case("study none.toml", "armcal: none.toml: no such file"),
    case("study study.toml --cell none", "--cell; blind and blind-spatial"),
    case(["study", "blind", "--cell", "none, Student t4"], "'none, Student t3'"),
    case(["study", "blind-spatial", "--cell", "none m=20"], "--cell; space, none, m=60"),
    # new arm files
    *(
        case(f"init --out new {words}", named)
        for words, named in (
            ("--links 0", "--links; '0'; 1 to 12"),
            ("--links nan", "links_mm[1]; nan"),
            ("--links 3,-1", "links_mm[2]; -1.0"),
            ("--links 3 --dh 6", "--dh; --links"),
            ("--instrument distance", "--instrument; --dh or --urdf"),
            ("--tip-link tool0", "--tip-link; --urdf"),
            ("--urdf none.urdf", "none.urdf"),
            (f"--urdf {URDF} --tip-link tool1", "'tool0'"),
        )
    ),
    case("init --out arm.toml", "--out; arm.toml"),
    case("init --out .", "arm.toml; exists"),
    # pages
    case("report plan.csv --out page.html", "plan.csv; arm"),
    case("report arm.toml arm.toml --out page.html", "arm.toml; twice"),
    case("report arm.toml bad.json --out page.html", "bad.json; .json; arm files", bad_json="{"),
    case("report arm.toml bad.toml --out page.html --force", "of one arm", toml="links_mm = [300.0, 210.0]\n"),
    case("report arm.toml bad.csv --out page.html", "bad.csv: row 1 (line 2); y_mm; 'x'", csv=COMMANDS),
    # names of files
    case("design arm.toml --runs 8 --out plan.csv", "plan.csv; --force"),
    case("report arm.toml --out page.html", "page.html; --force", page_html="mine"),
    case(f"design arm.toml --runs 8 --out {LONG}", "cannot be written"),
    case(f"design {LONG} --runs 8", "cannot be read"),
    case(
        f"study study.toml --workers 1 --out {LONG}", "File name too long", study=f'{STUDY}plans=["random"]\nruns=[6]'
    ),
    case("design arm.toml --runs 8 --out arm.toml/plan.csv", "'arm.toml'; folder"),
    case("design one --runs 8", "one"),
    case("diagnose arm.toml data.csv data.csv", "data.csv; 2 times"),
    # words that may be meant
    *(
        case(words, f"'{meant}'")
        for words, meant in (
            ("idenitfy", "identify"),
            ("help format", "formats"),
            ("design arm.toml --run 8", "--runs"),
            ("effects joint_hysteresys", "joint_hysteresis"),
        )
    ),
]


@pytest.fixture
def loop(folder: Folder) -> Folder:
    """With measurements, a plan of one posture that no joint reaches, and two links that lead to each other."""
    folder.write("data.csv", HEADER + "".join(f"{10 * k},{7 * k * k},{-9 * k},{5 * k},660,{k}\n" for k in range(8)))
    folder.write("far.csv", PLAN + "1,0,170,0,0\n")
    (folder.path / "one").symlink_to("two")
    (folder.path / "two").symlink_to("one")
    return folder


@pytest.mark.parametrize(("words", "named", "files"), CASES, ids=[re.sub(r"\W+", "_", f"{w}"[:60]) for w, *_ in CASES])
def test_what_cannot_be_done_is_one_line(
    loop: Folder, words: str | list[str], named: list[str], files: dict[str, str]
) -> None:
    for name, text in files.items():
        loop.write(name, text)
    loop.refused(words.split() if isinstance(words, str) else words, *named)


@pytest.mark.parametrize("verb", main.commands)
def test_what_no_option_takes(folder: Folder, verb: str) -> None:
    """A word where a number or a choice belongs, numbers beyond all ranges, an option that is none."""
    options = [p for p in main.commands[verb].params if isinstance(p, click.Option) and not p.is_flag]
    for option in options:
        number = getattr(option.type, "func", None) in (seconds_above_zero, whole_numbers)
        if number or isinstance(option.type, click.Choice | click.IntRange | click.FloatRange):
            for wrong in ("nothing", "nan", "-99999999999999999999"):
                folder.refused([verb, f"{option.opts[0]}={wrong}"], option.opts[0], wrong)
    folder.refused([verb, "--colour", "red"], "--colour")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("diagnose arm.toml data.csv --out out.file --report ./out.file", "--report out.file"),
        ("design arm.toml --runs 8 --keep plan.csv --out plan.csv", "--keep plan.csv"),
        ("design arm.toml --runs 8 --candidates plan.csv --picture ./plan.csv", "--candidates plan.csv"),
        ("identify arm.toml data.csv --out data.csv", "DATA data.csv"),
        ("design arm.toml --runs 8 --out link.toml", "ARM link.toml"),
        ("simulate arm.toml plan.csv --truth truth.toml --out truth.toml", "--truth truth.toml"),
        ("compare arm.toml rows.parquet --runs 8 --out rows.parquet", "ARM rows.parquet"),
    ],
)
def test_an_output_that_is_another_file_of_the_call(loop: Folder, words: str, named: str) -> None:
    (loop.path / "link.toml").symlink_to("arm.toml")
    for force in ("", " --force"):
        loop.refused(words + force, *named.split())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such devices here")
def test_a_device_that_never_ends(folder: Folder) -> None:
    for device in ("/dev/full", "/dev/zero", "/dev/null"):
        folder.refused(f"simulate arm.toml plan.csv --truth {device} --out out.file", device)


def test_a_pipe_is_read_as_a_file(folder: Folder) -> None:
    """As `<(zcat plan.csv.gz)` of a shell: a device is refused, a pipe is not."""
    reading, writing = os.pipe()
    os.write(writing, folder.read("plan.csv").encode())
    os.close(writing)
    assert len(read_table(f"/dev/fd/{reading}")) == 12
    os.close(reading)


@pytest.mark.parametrize(("columns", "factor", "unit"), [("xy", 1e-3, "metres"), ("q", np.pi / 180.0, "radians")])
def test_measurements_in_other_units(folder: Folder, columns: str, factor: float, unit: str) -> None:
    """No word helps against them; `armcal check` says what to do."""
    folder.simulated()
    frame = pl.read_csv(folder.path / "data.csv")
    wrong = [pl.col(name) * factor for name in frame.columns if name[0] in columns and name.endswith(("_mm", "_deg"))]
    frame.with_columns(wrong).write_csv(folder.path / "data.csv")
    folder.refused("identify arm.toml data.csv --out o", "data.csv", unit)
    (problem,) = folder.said("check arm.toml data.csv")["problems"]
    assert unit in problem


@pytest.mark.parametrize(
    ("words", "place"),
    [
        ("design arm.toml --runs 8 --out p.csv --picture p.svg", "doe.plan.accuracy.tip_beside_random"),
        ("identify arm.toml data.csv --out o.toml", "identification.reuse.with_data_of"),
        ("compare arm.toml --runs 8 --cluster tcp://127.0.0.1:9 --out folder", "doe.jobs.cluster"),
    ],
)
def test_an_answer_that_cannot_be_given_leaves_nothing(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, words: str, place: str
) -> None:
    """Refused late, when the rest is done: as constraints that leave no posture for the criterion I."""

    def refuse(*_: Any, **__: Any) -> None:
        raise InputError("no posture, allowed: some")

    folder.simulated()
    monkeypatch.setattr(place, refuse)
    folder.refused(words, "no posture, allowed: some")
    assert not (folder.path / "folder").exists()


def test_a_study_without_a_result_leaves_nothing(folder: Folder) -> None:
    folder.write("same.csv", PLAN + "1,0,1,2,3\n" * 4)
    folder.write("study.toml", STUDY + 'plans = ["same.csv"]\nreplications = 4\n')
    (folder.path / "there").mkdir()
    before = sorted(folder.path.rglob("*"))
    for more in ("", " --resume", " --out there", " --resume --out there"):
        folder.refused(f"study study.toml --workers 1{more}", code=1)
        assert sorted(folder.path.rglob("*")) == before


def test_control_characters_are_not_repeated(folder: Folder) -> None:
    for char in ("\n", "\r", "\x1b[31m", "\x07", "\u2028", "\u202e"):
        for words in (["score", f"arm{char}.toml", "plan.csv"], [f"sco{char}re"], ["score", "arm.toml", f"--{char}"]):
            folder.refused(words)


def test_names_in_files_do_not_reach_the_terminal_as_they_are(folder: Folder) -> None:
    folder.write("arm.toml", folder.read("arm.toml").replace("paper-4-link", "\\u001b[31mred\\u0007"))
    folder.write("data.csv", HEADER.replace("q1_deg", '"\x1b]0;title\x07",q1_deg') + "x,0,0,0,0,660,0\n" * 4)
    for words in ("simulate arm.toml plan.csv --truth truth.toml --out o.csv", "check arm.toml data.csv"):
        done = folder.armcal(words)
        assert not {"\x1b", "\x07"} & {*done.out, *done.err}


def test_a_very_long_name_is_cut(folder: Folder) -> None:
    name = "a" * 100_000
    for words in ([name], ["score", name, "plan.csv"], ["design", "arm.toml", "--runs", "8", "--solver", name]):
        done = folder.armcal(*words)
        assert (done.code, len(done.err) < LONGEST_LINE + 100) == (2, True)
    end = "no such file, allowed: an existing one"
    assert in_one_line(f"{name}: {end}").endswith(end)


def test_a_robust_plan_of_an_arm_that_hardly_moves(folder: Folder) -> None:
    """Information that is singular to rounding: an answer without a bound, or a reason."""
    limits = "[joint_limits_deg]\nlower = [0.0, 0.0]\nupper = [1e-9, 1e-9]\n"
    folder.write("arm.toml", f"links_mm = [300.0, 200.0]\n{limits}[measurement]\nsigma_mm = 0.1\n")
    folder.write("plan.csv", "run,q1_deg,q2_deg\n" + "1,0,0\n" * 12)
    for words in ("score arm.toml plan.csv --robust", "relax arm.toml --criterion A --grid 2"):
        done = folder.armcal(f"{words} --quiet")
        assert done.code in (0, 1), done.err
        assert done.code == 0 or done.err.startswith("armcal: ")


def test_a_truth_that_is_none_warns(folder: Folder) -> None:
    """An effect without any value does nothing; with one here or in the calibration it does."""
    effect = '\n[[effects]]\nname = "encoder_eccentricity"\njoint = 2\n'
    values = CALIBRATION + '\n[calibration.effects]\n"encoder_eccentricity:2.a_deg" = 0.1\n'
    for name, text in (("none", effect), ("value", effect + "a_deg = 0.1\n"), ("calibrated", effect + values)):
        folder.write(f"{name}.toml", ARM + text)
        done = folder.armcal(f"simulate arm.toml plan.csv --truth {name}.toml --out {name}.csv")
        assert done.code == 0
        assert ("encoder_eccentricity:2" in done.err) == (name == "none"), done.err
