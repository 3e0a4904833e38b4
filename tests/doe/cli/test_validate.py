"""`armcal validate` as a user runs it: the keys that scripts read, the picture, warnings and bad input."""

from __future__ import annotations

import pytest

from doe.cli import main
from identification.validate import validation
from tests.doe.cli.conftest import Folder

KEYS = {"rows", "refit", "rms_mm", "mean_mm", "p95_mm", "max_mm", "rms_nominal_mm", "blocks", "refitted", "notes"}


def test_another_session_of_the_same_arm(folder: Folder) -> None:
    folder.simulated()
    folder.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml")
    more = ["simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--out", "other.csv", "--seed", "1"]
    folder.armcal(*more)
    done = folder.armcal("validate", "calibrated.toml", "other.csv", "--json", "--picture", "picture.png")
    assert done.code == 0, done.err
    assert set(done.data) >= KEYS
    assert done.data["rows"] == 12
    assert done.data["rms_mm"] < 0.5 < 1.0 < done.data["rms_nominal_mm"]  # noise of 0.1 mm against errors of 0.5 deg
    assert folder.path.joinpath("picture.png").read_bytes()[:4] == b"\x89PNG"
    shown = folder.armcal("validate", "calibrated.toml", "other.csv", "--refit", "none")
    assert "nothing refitted" in shown.out
    assert "drawing" in shown.out


def test_the_data_of_the_identification_are_a_warning(folder: Folder) -> None:
    folder.simulated()
    folder.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml")
    done = folder.armcal("validate", "calibrated.toml", "data.csv")
    assert done.code == 0
    assert done.out.startswith("On 12 rows of the model's own measurements, ")
    said = "these are the measurements that the model was identified from"
    assert (said in " ".join(done.out.split()), said in done.err) == (True, False)  # once
    assert f"warning: data.csv: {said}" in folder.armcal("validate", "calibrated.toml", "data.csv", "--json").err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("arm.toml", "data.csv"), "calibration: the arm has none"),
        (("truth.toml", "nothing.csv"), "nothing.csv"),
        (("truth.toml", "data.csv", "--refit", "all"), "'all' is not one of"),
    ],
)
def test_bad_input(folder: Folder, words: tuple[str, ...], sentence: str) -> None:
    folder.simulated()
    done = folder.armcal("validate", *words)
    assert done.code == 2
    assert sentence in done.err
    assert len(done.err.strip().splitlines()) == 1


def test_the_choices_are_those_of_the_library() -> None:
    (refit,) = (parameter for parameter in main.commands["validate"].params if parameter.name == "refit")
    assert tuple(refit.type.choices) == validation.REFITS
