"""The verbs of identification as functions of Python: files in, files out, and the result behind the answer; and files
of a campaign as one document, without the plans that another package adds."""

import inspect
import sys
import warnings
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from identification import Arm, Calibration, InputError, Measurements, Model, load_arm, load_sessions
from identification.arm import Gravity
from identification.campaign import campaign_document
from identification.document import Document
from identification.files.measurement import measurement_text
from identification.instruments import PlanarDistance
from identification.model.placed import with_sessions
from identification.running import additions, single_thread
from identification.workflow import VERBS, Written, check_files, compensate_files, identify_files, validate_files
from tests.refusals import refused

LENGTHS = [300.0, 200.0]
REAL = Arm(LENGTHS, calibration=Calibration.of([1.0, -2.0], [0.01, -0.02]))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An arm, and twice 30 exact measurements of another."""
    (tmp_path / "arm.toml").write_text(f"links_mm = {LENGTHS}\n")
    for name, seed in (("data", 1), ("other", 2)):
        q = np.random.default_rng(seed).uniform(-2.0, 2.0, (30, 2))
        (tmp_path / f"{name}.csv").write_text(measurement_text(Measurements(q, Model(REAL).position(q))))
    (tmp_path / "targets.csv").write_text("x_mm,y_mm\n400,100\n")
    return tmp_path


def test_a_calibration_goes_round_in_python(folder: Path) -> None:
    out = Written(folder / "calibrated.toml")
    answer = identify_files(folder / "arm.toml", folder / "data.csv", out=out)
    assert answer.exit_code == 0
    np.testing.assert_allclose(answer.result.length_errors, [1.0, -2.0], atol=1e-9)
    calibration = load_arm(out).calibration
    np.testing.assert_allclose([calibration.values[f"length_error:{j}"] for j in (1, 2)], [1.0, -2.0], atol=1e-9)
    document = answer.document
    assert isinstance(document, Document)
    assert f"calibrated arm written to {out}" in document.parts
    assert validate_files(out, folder / "data.csv").data["rms_mm"] < 1e-6
    commands = compensate_files(out, folder / "targets.csv").result
    np.testing.assert_allclose(Model(REAL).position(commands.commands), [[400.0, 100.0]], atol=1e-5)
    with pytest.raises(InputError, match="exists"):
        identify_files(folder / "arm.toml", folder / "data.csv", out=out)


def test_what_a_fit_with_the_librarys_prior_wrote_is_fitted_with_it_again(folder: Path) -> None:
    """Its effects are those of the prior, and are added anew; with `only` they stay as they are."""
    table = (folder / "data.csv").read_text()
    (folder / "planned.csv").write_text(f"# fit: library-prior --missing gear_ratio\n{table}")
    out = Written(folder / "calibrated.toml")
    first = identify_files(folder / "arm.toml", folder / "planned.csv", out=out).data
    assert first["fit"]["followed"]
    answer = identify_files(out, folder / "planned.csv", only=(["joint_offsets"],))
    assert answer.exit_code == 0
    assert not answer.data["fit"]["followed"]
    assert [row["name"] for row in answer.data["parameters"]] == ["joint_offset:1", "joint_offset:2"]
    again = identify_files(out, folder / "planned.csv").data
    assert again["prior"] == first["prior"]
    np.testing.assert_allclose(
        [row["value"] for row in again["parameters"]], [row["value"] for row in first["parameters"]], atol=1e-9
    )
    whole = identify_files(out, folder / "data.csv").data
    assert whole["fit"] == {"asked": "library-prior", "followed": True, "against": None}
    assert whole["prior"]["parameters"] > first["prior"]["parameters"]
    assert whole["prior"]["share"] == 0.125  # nothing is missing
    assert "prior" not in identify_files(out, folder / "data.csv", prior=False).data


def test_each_file_is_a_session_and_none_is_given_twice(folder: Path) -> None:
    (folder / "friday.csv").write_text((folder / "data.csv").read_text())
    arm, names = load_arm(folder / "arm.toml"), [folder / "data.csv", folder / "friday.csv"]
    assert load_sessions(names, arm).sessions == ("data", "friday")
    names[1].write_text("q1_deg,q2_deg,x_mm,y_mm,payload_kg\n10,20,300,100,7\n")
    heavy = replace(arm, gravity=Gravity(np.array([0.0, -9.81]), np.ones(2), np.full(2, 0.5), payload=3.0))
    assert load_sessions(names, heavy).payload.tolist() == [*[3.0] * 30, 7.0]
    bar = replace(arm, chain=replace(arm.chain, instrument=PlanarDistance()))
    lengths = [folder / f"{day}.csv" for day in ("monday", "tuesday")]
    for path in lengths:
        path.write_text("q1_deg,q2_deg,distance_mm\n10,20,300\n20,50,310\n")
    assert [*with_sessions(bar, load_sessions(lengths, bar)).chain.instrument.targets] == ["monday", "tuesday"]
    with pytest.raises(InputError, match="given 2 times"):
        load_sessions([names[0], names[0]], arm)


def test_zeros_that_moved_are_found_again_before_commands(folder: Path) -> None:
    """By `validate` and by a report on the same files, whatever of the drawing's error the calibration removes."""
    files = folder / "calibrated.toml", folder / "other.csv"
    for moved, last in ((0.0, "compensate"), (0.002, "identify")):
        for seed, path in enumerate((folder / "data.csv", files[1])):
            rng = np.random.default_rng(seed)
            q, noise = rng.uniform(-2.0, 2.0, (30, 2)), rng.normal(0.0, 0.01, (30, 2))
            there = Model(REAL).position(q + seed * moved * np.eye(2)[1]) + noise
            path.write_text(measurement_text(Measurements(q, there)))
        identify_files(folder / "arm.toml", folder / "data.csv", out=Written(files[0]), force=True)
        for document in (validate_files(*files).document, campaign_document(files)[0]):
            assert [action.command.split()[1] for action in document.actions][-1] == last


def test_every_verb_says_what_it_is_for() -> None:
    """What each option does stands in the docstring, which is the help of the command line."""
    for name, (function, example) in VERBS.items():
        if function.__module__ != "identification.workflow":
            continue
        assert example.startswith(f"armcal {name}")
        text = inspect.getdoc(function) or ""
        for parameter in inspect.signature(function).parameters.values():
            if parameter.kind is inspect.Parameter.KEYWORD_ONLY:
                provided = parameter.name in ["seed", "progress", "page", "allowed", "force", "package_dir"]
                assert provided == (f"\n{parameter.name} : " not in text), (name, parameter.name)


def test_a_plan_is_read_and_what_is_no_table_of_the_arm_is_one_line(folder: Path) -> None:
    (folder / "plan.csv").write_text("run,q1_deg,q2_deg,remark\n1,10,20,low\n")
    with pytest.warns(UserWarning, match="not used: 'remark'"):
        assert check_files(folder / "arm.toml", folder / "plan.csv").data["ok"]
    with pytest.warns(UserWarning, match="not used: 'remark'"):
        verdict = campaign_document([folder / "arm.toml", folder / "plan.csv"])[0].verdict[0]
    assert verdict.endswith("plan.csv has 1 run.")
    (folder / "plan.csv").write_text("a,b\n1,10\n")
    refused(campaign_document, [folder / "arm.toml", folder / "plan.csv"], names=["q1_deg"])


# -- progress and memory -----------------------------------------------------------------------------------------------
def install(monkeypatch: pytest.MonkeyPatch, folder: Path, source: str) -> None:
    (folder / "addition_for_test.py").write_text(source)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "addition_for_test", raising=False)
    point = EntryPoint("mine", "addition_for_test:thing", "armcal.effects")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point])


def test_named_before_its_code_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The warning of what runs comes before the one that the code itself gives."""
    install(monkeypatch, tmp_path, "import warnings\nwarnings.warn('running')\nthing = 7\n")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert [(name, found) for name, _, found in additions("armcal.effects")] == [("mine", 7)]
    first = "armcal.effects of installed packages, whose code runs now: mine (of no package)"
    assert [str(one.message) for one in said] == [first, "running"]


@pytest.mark.parametrize("source", ["raise RuntimeError('a\\nb')", "def", ""])
@pytest.mark.filterwarnings("ignore:armcal.effects of installed packages")
def test_one_that_fails_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, source: str) -> None:
    install(monkeypatch, tmp_path, source)
    with pytest.raises(
        InputError, match=r"^entry point armcal.effects: mine = addition_for_test:thing: .*, allowed: ."
    ):
        list(additions("armcal.effects"))


def blas_threads() -> list[int]:
    return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]


def test_one_thread_inside_and_as_before_outside() -> None:
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        with single_thread():
            assert set(blas_threads()) == {1}
        assert blas_threads() == before
