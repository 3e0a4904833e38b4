"""Commands killed, short of disk, or not alone: a few of each; many: tests/benchmarks/test_faults.py."""

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from click.testing import CliRunner

from doe.cli import main
from doe.design import Design
from doe.plan.accuracy import tip_beside_random
from doe.plan.moves import route
from doe.plan.spacing import separated
from identification import Plan
from tests.doe.cli.conftest import Folder, without_progress
from tests.doe.faults import COMMANDS, ROOT, Command, Reference, content, prepare, verdict

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are counted in /proc")
STUDY_COMMAND = COMMANDS[0]
LONG_DESIGN = COMMANDS[2]._replace(words=COMMANDS[2].words.replace("--starts 12", "--starts 3000"))  # many seconds
SCORE = "score arm.toml plan.csv"
SERIAL = Command("study", "study study.toml --workers 1", "--resume", ("study.results",))


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """The study to its end, in this process; what is killed has two workers and takes 1.2 s where nothing else runs."""
    folder = prepare(tmp_path_factory.mktemp("reference") / "study")
    finished(SERIAL.words, folder)
    return Reference(STUDY_COMMAND, content(SERIAL, folder), 1.2)


def finished(words: str, folder: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = CliRunner().invoke(main, words.split(), catch_exceptions=False)
    assert done.exit_code == 0, done.output


def test_a_killed_study_resumes_to_the_same_bits(reference: Reference, tmp_path: Path) -> None:
    assert verdict(reference, tmp_path / "killed", signal.SIGKILL, 0.7) == []


def test_a_design_that_is_stopped_leaves_no_process_and_no_half_file(tmp_path: Path) -> None:
    made = Reference(LONG_DESIGN, {"plan.csv": b"\n" * 8}, 1.5)  # headings, and seven postures: the best so far
    assert verdict(made, tmp_path / "killed", signal.SIGINT, 1.0, again=False) == []


def test_a_search_that_is_stopped_answers_with_its_best(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal comes while a plan is judged, in no library; after a second one nothing is written."""

    def interrupted(function: Callable[..., Any], call: int) -> Callable[..., Any]:
        calls = count(1)

        def run(*arguments: Any) -> Any:
            if next(calls) == call:
                signal.raise_signal(signal.SIGINT)
            return function(*arguments)

        return run

    monkeypatch.setattr("doe.solvers.solving.separated", interrupted(separated, 2))
    data = folder.said("design arm.toml --runs 5 --solver exchange --out new.csv")
    assert (data["status"], folder.read("new.csv").count("\n")) == ("interrupted", 6)
    monkeypatch.setattr("doe.plan.moves.route", interrupted(route, 1))  # while it is ordered, too
    assert folder.said("design arm.toml --runs 5 --order travel --out ordered.csv")["travel_deg"]["order"] == "travel"
    assert folder.read("ordered.csv").count("\n") == 6
    monkeypatch.setattr("doe.plan.accuracy.tip_beside_random", interrupted(tip_beside_random, 1))
    data = folder.said("design arm.toml --runs 5 --out compared.csv")
    assert (data["status"], data["expected_tip"], folder.read("compared.csv").count("\n")) == ("interrupted", None, 6)
    monkeypatch.setattr(Design, "document", interrupted(Design.document, 1))
    folder.refused("design arm.toml --runs 5 --solver exchange --out other.csv", "nothing was written", code=1)
    assert not (folder.path / "other.csv").exists()


def test_a_full_disk_and_the_way_on(reference: Reference, tmp_path: Path) -> None:
    """No file above 3 kB: the tables cannot be written."""
    folder = prepare(tmp_path / "full")
    limit = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({3000}, {resource.RLIM_INFINITY}))"
    code = f"{limit}; import sys; sys.argv[0] = 'armcal'; from doe.__main__ import run; run()"
    words = [sys.executable, "-c", code, *SERIAL.words.split()]
    whole = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}  # else modules that were not compiled yet are cut off, too
    done = subprocess.run(words, cwd=folder, env=whole, capture_output=True, text=True, check=False)
    assert done.returncode in (1, 2)
    said = without_progress(done.stderr)
    assert said.startswith("armcal: ")
    assert "cannot be written (File too large)" in said
    assert said.count("\n") == 1
    finished(f"{SERIAL.words} --resume", folder)
    assert content(SERIAL, folder) == reference.files


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "not enough memory"),
        (ImportError("libx.so: no"), "library cannot be loaded"),
        (FileNotFoundError("No usable temporary directory found"), "the system refuses: No usable temporary"),
    ],
)
def test_what_the_system_refuses_is_one_line(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, error: BaseException, said: str
) -> None:
    monkeypatch.setattr("identification.files.arm.load_arm", Mock(side_effect=error))
    folder.refused(SCORE, said, code=1)


@pytest.mark.parametrize("caught", [False, True])
@pytest.mark.parametrize(("number", "name"), [(signal.SIGINT, "Ctrl-C"), (signal.SIGTERM, "SIGTERM")])
def test_a_signal_while_a_library_loads(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, name: str, caught: bool
) -> None:
    """Some turn it into an ImportError of their own."""

    def load(*_: object) -> None:
        with suppress(*[KeyboardInterrupt] if caught else []):
            signal.raise_signal(number)
        raise ImportError("initialization failed")

    before = signal.getsignal(number)
    monkeypatch.setattr("identification.files.arm.load_arm", load)
    done = folder.armcal(SCORE)
    assert (done.code, done.err) == (1, f"armcal: stopped by {name}, nothing was written\n")
    assert signal.getsignal(number) is before


# -- other processors --------------------------------------------------------------------------------------------------
SAME_COMMANDS = ("design arm.toml --runs 5 --starts 4", "identify arm.toml data.csv", "identify six.toml measured.csv")
ELBOW = ((0, 90, 400), (-600, 0, 0), (-500, 0, 0), (0, 90, 150), (0, -90, 120), (0, 0, 90))
CODE = """
import sys
from click.testing import CliRunner
from doe.cli import main
for words in sys.argv[1:]:
    print(CliRunner().invoke(main, [*words.split(), "--json", "--quiet"]).stdout.strip())
"""


def prepare_six(folder: Path) -> Path:
    """An arm of six axes, a plan of 30 postures, and what another truth measures there."""
    rows = "".join(f"[[dh]]\na_mm = {a}.0\nalpha_deg = {alpha}.0\nd_mm = {d}.0\n" for a, alpha, d in ELBOW)
    tool = "[tool]\nx_mm = 60.0\ny_mm = 20.0\nz_mm = 30.0\n"
    arm = f'kind = "spatial"\n{rows}{tool}[measurement]\nsigma_mm = 0.05\n'
    (folder / "six.toml").write_text(arm)
    true = '[calibration]\nvalues = {"joint_offset:2" = 0.3, "joint_offset:5" = -0.2, "translation_x:4" = 0.4}\n'
    (folder / "truth.toml").write_text(arm + true)
    postures = np.random.default_rng(4).uniform(-150.0, 150.0, (30, 6))
    (folder / "plan.csv").write_text(Plan(np.radians(postures)).text())
    arm, plan, truth, out = (str(folder / name) for name in ("six.toml", "plan.csv", "truth.toml", "measured.csv"))
    done = CliRunner().invoke(main, ["simulate", arm, plan, "--truth", truth, "--out", out], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return folder


def test_the_same_answer_on_an_older_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same verdict and status, plan values to 1e-6, parameters to 1e-9 of their deviation, in the plane and with
    six axes; another process only for the other kernel: to start one takes longer than to work."""
    folder = prepare_six(prepare(tmp_path / "work"))
    monkeypatch.chdir(folder)
    here = [CliRunner().invoke(main, [*words.split(), "--json", "--quiet"]).stdout for words in SAME_COMMANDS]
    system = {"OPENBLAS_NUM_THREADS": "2", "PYTHONHASHSEED": "7", "OPENBLAS_CORETYPE": "Prescott"}
    environment = {**os.environ, **system, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", CODE, *SAME_COMMANDS]
    other = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    for one, two in zip(map(json.loads, here), map(json.loads, other.stdout.splitlines()), strict=True):
        assert one.keys() == two.keys()
        for key in ("verdict", "effects", "status", "certified_optimal", "confirmed", "method"):
            assert one.get(key) == two.get(key), key
        for key in ("value", "log_det"):
            assert one.get(key) == pytest.approx(two.get(key), abs=1e-6)
        for row, same in zip(one.get("parameters", []), two.get("parameters", []), strict=True):
            assert row["name"] == same["name"]
            assert abs(row["value"] - same["value"]) <= 1e-9 * row["std"]
            assert row["std"] == pytest.approx(same["std"], rel=1e-9)
