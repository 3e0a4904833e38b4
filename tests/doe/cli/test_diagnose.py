"""`armcal diagnose`: what is confirmed, what is not, what is written; and several sessions of one arm."""

import json
from typing import Any

import numpy as np
import polars as pl
import pytest

from identification import Diagnosis, load_arm
from identification.gap import diagnose
from tests.doe.cli.conftest import ARM, CALIBRATION, Folder

ECCENTRIC = '\n[[effects]]\nname = "encoder_eccentricity"\njoint = 2\na_deg = 0.06\nb_deg = -0.05\n'
RIPPLE = '\n[[effects]]\nname = "transmission_ripple"\njoint = 2\nk = 5\na_deg = 0.08\nb_deg = 0.05\n'
DIAGNOSE = "diagnose arm.toml data.csv"


@pytest.fixture
def sessions(folder: Folder) -> Folder:
    """data.csv: 60 rows of an arm with an eccentric encoder; same.csv: 150 more; without.csv: 150 rows without it."""
    folder.write("plain.toml", ARM + CALIBRATION)
    folder.write("truth.toml", ARM + ECCENTRIC + CALIBRATION)
    for name, rows, seed, truth in (("data", 60, 1, "truth"), ("same", 150, 2, "truth"), ("without", 150, 3, "plain")):
        folder.plan(rows, seed)
        folder.simulated(f"{name}.csv", seed, f"{truth}.toml")
    return folder


@pytest.fixture
def once(monkeypatch: pytest.MonkeyPatch) -> None:
    """One diagnosis serves all commands of a test."""
    real, made = diagnose.diagnose, list[Diagnosis]()

    def remembered(*given: Any, **named: Any) -> Diagnosis:
        made.append(made[0] if made else real(*given, **named))
        return made[0]

    monkeypatch.setattr(diagnose, "diagnose", remembered)


@pytest.mark.usefixtures("once")
def test_what_is_not_confirmed_is_said_and_not_written(sessions: Folder) -> None:
    line = f"{DIAGNOSE} --holdout without.csv --out extended.toml"
    done = sessions.armcal(line)
    assert done.code == 0
    assert sum("extended.toml was not written" in one and "--force" in one for one in done.err.splitlines()) == 1
    assert not (sessions.path / "extended.toml").exists()
    forced = sessions.armcal(f"{line} --force --json")
    assert "armcal: warning: not confirmed: " in forced.err
    assert (forced.data["confirmed"], forced.data["confirmation"]["shrinks"]) == (False, False)
    kept = load_arm(sessions.path / "extended.toml").calibration
    assert kept is not None
    assert [kept.provenance[key] for key in ("confirmed", "verdict", "better_than_geometry")] == [False, "named", False]
    offered = forced.data["offered"]
    assert offered["better"] is False
    sessions.said("identify arm.toml data.csv --out geometry.toml")
    for model, of in (("extended", ""), ("geometry", "_geometry")):
        validated = sessions.said(f"validate {model}.toml without.csv")
        expected = offered[f"rms{of}_mm"], offered[f"max{of}_mm"]
        assert (validated["rms_mm"], validated["max_mm"]) == pytest.approx(expected, rel=1e-6)


def test_what_is_confirmed_is_written(sessions: Folder) -> None:
    done = sessions.armcal(f"{DIAGNOSE} --holdout same.csv --out extended.toml --json")
    assert done.data["confirmed"] is True
    assert "not confirmed" not in done.err
    fitted = sessions.said("identify arm.toml data.csv")
    assert done.data["gap"]["rms_before_mm"] == pytest.approx(fitted["rms_after_mm"], rel=1e-9)
    again = sessions.said("identify extended.toml same.csv")
    assert again["rms_before_mm"] == pytest.approx(done.data["gap"]["held_out_after_mm"], rel=1e-9)
    # rivals and their probabilities are in the file, too
    said = done.data
    kept = load_arm(sessions.path / "extended.toml").calibration
    assert kept is not None
    chances = kept.provenance["probability"]
    assert sum(chances.values()) == pytest.approx(1.0)
    assert {"none", "unknown", *(" + ".join(c["effects"]) for c in said["candidates"])} == set(chances) - {"other sets"}
    assert kept.provenance["delta_bic"] == {" + ".join(c["effects"]): c["delta_bic"] for c in said["candidates"]}
    json.dumps(dict(kept.provenance))
    # of the posterior, within the standard error of a fit by least squares
    free = 2 * 60 - len(kept.parameter_names)
    scatter = said["gap"]["rms_after_mm"] * np.sqrt(60 / free)
    assert kept.provenance["scatter_mm"] == pytest.approx(scatter, rel=1.0 / np.sqrt(2.0 * free))


# -- several sessions --------------------------------------------------------------------------------------------------
@pytest.fixture
def days(folder: Folder) -> Folder:
    """monday.csv and friday.csv of an arm with a ripple, set up anew in between; both.csv has them in one file."""
    folder.write("real.toml", folder.read("truth.toml") + RIPPLE)
    frames = []
    for seed, (name, turn, shift) in enumerate((("monday", 0.0, 0.0), ("friday", 0.4, 150.0 - 80.0j))):
        folder.plan(45, 20 + seed)
        folder.simulated("one.csv", seed, "real.toml")
        frame = pl.read_csv(folder.path / "one.csv")
        z = np.exp(1j * turn) * (frame["x_mm"].to_numpy() + 1j * frame["y_mm"].to_numpy()) + shift
        frame = frame.with_columns(x_mm=pl.Series(z.real), y_mm=pl.Series(z.imag))
        frame.write_csv(folder.path / f"{name}.csv")
        frames.append(frame.with_columns(session=pl.lit(name)))
    pl.concat(frames).write_csv(folder.path / "both.csv")
    return folder


@pytest.mark.usefixtures("once")
def test_files_are_sessions(days: Folder) -> None:
    found = days.said("diagnose arm.toml monday.csv friday.csv --out extended.toml")
    assert found["effects"] == ["transmission_ripple:2[k=5]"]
    (effect,) = found["replication"]
    assert effect["replicates"] is True
    assert [there["session"] for there in effect["sessions"]] == ["monday", "friday"]
    for there in effect["sessions"]:
        for parameter, true in zip(there["parameters"], (0.08, 0.05), strict=True):
            assert abs(parameter["value"] - true) < 5 * parameter["std"]
    written = days.read("extended.toml")
    assert ("base_offset" in written, "session_base" in written) == (True, False)
    # the arm as it stands in the first session predicts both, the base of the second refitted
    for name in ("monday", "friday", "both"):
        checked = days.said(f"validate extended.toml {name}.csv")
        assert checked["rms_mm"] < 0.2
        assert checked["notes"] or name == "both"  # these are the measurements of the identification
    # `discriminate` reads what `diagnose` reads, as its next step is given with the same files
    done = days.armcal("discriminate arm.toml monday.csv friday.csv --runs 2 --out next.csv")
    assert done.code == 0, done.err
    assert "next.csv was not written: there are no next postures" in done.flat
    assert "gear ripple, k times per turn (transmission_ripple:2[k=5])" in done.flat
    settled = days.said("discriminate arm.toml monday.csv friday.csv --runs 2")
    assert (settled["candidates"][0], settled["pairs"]) == (["transmission_ripple:2[k=5]"], [])
    assert [settled[key] for key in ("payload_kg", "directions", "chance", "status")] == [None] * 4
