"""`armcal diagnose`: what is confirmed, what is not, and what is written."""

from __future__ import annotations

import json

import numpy as np
import pytest

from identification.errors import InputError
from identification.files import arm as arm_files
from identification.files.arm import load_arm
from tests.doe.cli.conftest import ARM, CALIBRATION, Folder

ECCENTRIC = '\n[[effects]]\nname = "encoder_eccentricity"\njoint = 2\na_deg = 0.06\nb_deg = -0.05\n'
WORDS = ("diagnose", "arm.toml", "data.csv")


def postures(rows: int, seed: int) -> str:
    drawn = np.random.default_rng(seed).uniform([-180, -120, -100, -90], [180, 120, 60, 90], (rows, 4))
    return "\n".join(
        ["run,q1_deg,q2_deg,q3_deg,q4_deg", *(f"{k},{','.join(map(str, q))}" for k, q in enumerate(drawn))]
    )


@pytest.fixture
def sessions(folder: Folder) -> Folder:
    """data.csv: 60 rows of an arm with an eccentric encoder; same.csv: 150 more; without.csv: 150 rows without it."""
    truth, plain = (
        folder.write("truth.toml", ARM + ECCENTRIC + CALIBRATION),
        folder.write("plain.toml", ARM + CALIBRATION),
    )
    for name, rows, seed, file in (("data", 60, 1, truth), ("same", 150, 2, truth), ("without", 150, 3, plain)):
        folder.write("plan.csv", postures(rows, seed) + "\n")
        words = ("simulate", "arm.toml", "plan.csv", "--truth", str(file), "--out", f"{name}.csv", "--seed", str(seed))
        assert folder.armcal(*words).code == 0
    return folder


def test_what_is_not_confirmed_is_said_and_not_written(sessions: Folder) -> None:
    words = (*WORDS, "--holdout", "without.csv", "--out", "extended.toml")
    done = sessions.armcal(*words)
    assert done.code == 0
    assert sum("extended.toml was not written" in line and "--force" in line for line in done.err.splitlines()) == 1
    assert not (sessions.path / "extended.toml").exists()
    forced = sessions.armcal(*words, "--force", "--json")
    assert "armcal: warning: not confirmed: " in forced.err
    assert forced.data["confirmed"] is False
    assert forced.data["confirmation"]["shrinks"] is False
    kept = load_arm(sessions.path / "extended.toml").calibration
    assert kept is not None
    assert kept.provenance["confirmed"] is False
    assert kept.provenance["verdict"] == "named"
    assert kept.provenance["better_than_geometry"] is False
    offered = forced.data["offered"]
    assert offered["better"] is False
    validated = sessions.armcal("validate", "extended.toml", "without.csv", "--json").data
    assert (validated["rms_mm"], validated["max_mm"]) == pytest.approx((offered["rms_mm"], offered["max_mm"]), rel=1e-6)
    sessions.armcal("identify", "arm.toml", "data.csv", "--out", "geometry.toml")
    geometry = sessions.armcal("validate", "geometry.toml", "without.csv", "--json").data
    expected = offered["rms_geometry_mm"], offered["max_geometry_mm"]
    assert (geometry["rms_mm"], geometry["max_mm"]) == pytest.approx(expected, rel=1e-6)


def test_what_is_confirmed_is_written(sessions: Folder) -> None:
    done = sessions.armcal(*WORDS, "--holdout", "same.csv", "--out", "extended.toml", "--json")
    assert done.data["confirmed"] is True
    assert "not confirmed" not in done.err
    fitted = sessions.armcal("identify", "arm.toml", "data.csv", "--json").data
    assert done.data["gap"]["rms_before_mm"] == pytest.approx(fitted["rms_after_mm"], rel=1e-9)
    again = sessions.armcal("identify", "extended.toml", "same.csv", "--json").data
    assert again["rms_before_mm"] == pytest.approx(done.data["gap"]["held_out_after_mm"], rel=1e-9)


def test_a_share_of_the_data_is_held_out_by_posture(sessions: Folder) -> None:
    header, *rows = postures(60, 1).splitlines()
    sessions.write("plan.csv", "\n".join([header, *(row for row in rows for _ in range(2))]) + "\n")  # each twice
    words = ("simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--out", "data.csv", "--force")
    assert sessions.armcal(*words).code == 0
    found = sessions.armcal(*WORDS, "--holdout", "0.3", "--json").data
    assert found["confirmation"]["rows"] == pytest.approx(36, abs=2)
    assert found["confirmation"]["rows"] % 2 == 0  # both rows of a posture
    assert found["confirmation"]["transfer"] == "other postures"
    assert sessions.armcal(*WORDS, "--holdout", "0.3", "--json", "--seed", "4").data["gap"] != found["gap"]


def test_rivals_and_their_probabilities_are_kept_in_the_file(sessions: Folder) -> None:
    sessions.armcal(*WORDS, "--out", "extended.toml")
    said = sessions.armcal(*WORDS, "--json").data
    kept = load_arm(sessions.path / "extended.toml").calibration
    assert kept is not None
    chances = kept.provenance["probability"]
    assert sum(chances.values()) == pytest.approx(1.0)
    assert {"none", "unknown", *(" + ".join(c["effects"]) for c in said["candidates"])} == set(chances) - {"other sets"}
    assert kept.provenance["delta_bic"] == {" + ".join(c["effects"]): c["delta_bic"] for c in said["candidates"]}
    json.dumps(dict(kept.provenance))
    # of the posterior, within the standard error of a fit by least squares: all that `advise` needs
    rows = len(sessions.read("data.csv").splitlines()) - 1
    free = 2 * rows - len(kept.parameter_names)
    scatter = said["gap"]["rms_after_mm"] * np.sqrt(rows / free)
    assert kept.provenance["scatter_mm"] == pytest.approx(scatter, rel=1.0 / np.sqrt(2.0 * free))
    assert sessions.armcal("advise", "extended.toml", "--only", "base", "--runs", "3").code == 0


def test_the_diagnosis_is_shown_where_the_file_cannot_be_written(
    sessions: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> str:
        raise InputError("length_errors_mm: found -231.6 for link 3, allowed: a positive length")

    monkeypatch.setattr(arm_files, "with_calibration", refuse)
    done = sessions.armcal(*WORDS, "--out", "extended.toml")
    assert done.code == 2
    assert "(encoder_eccentricity:2)" in done.out.splitlines()[0]
    assert "next:" not in done.out
    assert "armcal: length_errors_mm: found -231.6 for link 3" in done.err


def test_a_hold_out_of_another_frame_is_judged_where_it_stands(sessions: Folder) -> None:
    """The instrument moved by 300 mm: the base is refitted to these rows, and the verdict is as if it had not."""
    rows = (sessions.path / "same.csv").read_text().splitlines()
    column = rows[0].split(",").index("x_mm")
    cells = [row.split(",") for row in rows[1:]]
    moved = [",".join([*row[:column], str(float(row[column]) + 300.0), *row[column + 1 :]]) for row in cells]
    sessions.write("moved.csv", "\n".join([rows[0], *moved]) + "\n")
    still, there = (sessions.armcal(*WORDS, "--holdout", name, "--json").data for name in ("same.csv", "moved.csv"))
    assert still["confirmation"]["refitted"] == []
    assert there["confirmation"]["refitted"] == ["base"]
    assert there["confirmed"] is True
    for key in ("held_out_before_mm", "held_out_after_mm"):
        assert there["gap"][key] == pytest.approx(still["gap"][key], rel=0.05)
    said = "the hold-out is of another set-up: base refitted to its rows, for both models"
    assert said in there["warnings"]
    assert said in " ".join(sessions.armcal(*WORDS, "--holdout", "moved.csv").out.split())
    other = [",".join([*row[:column], str(2.0 * float(row[column])), *row[column + 1 :]]) for row in cells]
    sessions.write("scaled.csv", "\n".join([rows[0], *other]) + "\n")
    refused = sessions.armcal(*WORDS, "--holdout", "scaled.csv")
    assert refused.code == 2
    assert "another arm or unit?" in refused.err
