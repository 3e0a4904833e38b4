"""The first command of the README: it must work for a stranger, and its page must show what it says."""

import numpy as np
import pytest

from identification.workflow import VERBS
from tests.doe.cli.conftest import Folder
from tests.identification.test_document import Texts


def test_demo_runs_the_whole_loop(folder: Folder) -> None:
    done = folder.armcal("demo --out d --json")
    assert done.code == 0, done.err
    assert done.data["directory"] == "d"
    for name in ("arm.toml", "plan.csv", "data.csv", "calibrated.toml", "extended.toml", "report.html", "overview.png"):
        assert (folder.path / "d" / name).stat().st_size > 0
    assert done.data["design"]["certified_optimal"] is True
    gap, hidden = done.data["fresh_gap_mm"], done.data["hidden"]
    assert gap["noise"] == pytest.approx(0.1 * np.sqrt(2.0))  # sigma 0.1 mm on two axes
    assert gap["drawing"] > gap["identified"] > gap["extended"]
    # 200 fresh rows: RMS of 400 normal values has a relative deviation of 1 / sqrt(800) = 3.5 %; the fit of 10
    # parameters to 40 equations adds up to some 13 %
    assert gap["extended"] < 1.3 * gap["noise"]
    assert done.data["diagnose"]["effects"] == ["encoder_eccentricity:1"]  # what truth.toml hides
    assert len(hidden["parameters"]) == 8 + 2
    assert all(abs(row["value"] - row["hidden"]) < 4.0 * row["std"] for row in hidden["parameters"])
    # the noise in 40 equations for 10 parameters, and twice the 20 % by which such a sum scatters
    allowed = 1.4 * gap["noise"] * np.sqrt(10.0 / 40.0)
    assert hidden["model_error_mm"] < allowed
    assert hidden["targets_corrected_mm"] < allowed < hidden["targets_as_drawn_mm"]
    outline, page = Texts(), folder.read("d/report.html")
    outline.feed(page)
    assert outline.open == []
    assert (page.count("<section") >= 6, page.count("<svg") >= 5) == (True, True)
    assert not any(fetched in page for fetched in ('src="http', 'href="http'))  # the page needs no network


@pytest.mark.parametrize(
    ("words", "step", "directory"),
    [("--json", "diagnose", "armcal-demo"), ("--out half", "diagnose", "half"), ("--spatial --out s", "solve", "s")],
)
def test_ctrl_c_says_which_files_are_left(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, words: str, step: str, directory: str
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    place, value = ("VERBS", {**VERBS, step: (stopped, "")}) if step in VERBS else (step, stopped)
    monkeypatch.setattr(f"doe.demo.run.{place}", value)
    (folder.path / "armcal-demo").mkdir()
    done = folder.armcal(f"demo {words}")
    assert (done.code, f"the files in {directory}" in done.err) == (1, True)
    assert (folder.path / directory / "data.csv").exists() == (step == "diagnose")
    assert not (folder.path / directory / "report.html").exists()
    assert ('kind = "spatial"' in folder.read(f"{directory}/arm.toml")) == (directory == "s")
    assert folder.armcal(f"demo --out {directory}").code == 2  # without --force
