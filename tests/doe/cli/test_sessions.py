"""Several sessions of one arm on the command line: files or a column, identified and diagnosed together."""

from __future__ import annotations

import numpy as np
import pytest

from tests.doe.cli.conftest import Folder

RIPPLE = '\n[[effects]]\nname = "transmission_ripple"\njoint = 2\nk = 5\na_deg = 0.08\nb_deg = 0.05\n'
BASES = ((0.0, 0.0), (0.4, 150.0 - 80.0j))


@pytest.fixture
def sessions(folder: Folder) -> Folder:
    """monday.csv and friday.csv of an arm with a ripple, set up anew in between; both.csv has them in one file."""
    generator = np.random.default_rng(0)
    folder.write("real.toml", folder.read("truth.toml") + RIPPLE)
    texts = []
    for seed, (name, (turn, shift)) in enumerate(zip(("monday", "friday"), BASES, strict=True)):
        q = generator.uniform([-180, -120, -100, -90], [180, 120, 60, 90], (45, 4))
        rows = [",".join([str(k + 1), *(f"{a:.6f}" for a in posture)]) for k, posture in enumerate(q)]
        folder.write("run.csv", "\n".join(["run,q1_deg,q2_deg,q3_deg,q4_deg", *rows]) + "\n")
        words = ["simulate", "arm.toml", "run.csv", "--truth", "real.toml", "--out", "one.csv", "--force"]
        assert folder.armcal(*words, "--seed", str(seed)).code == 0
        header, *lines = folder.read("one.csv").splitlines()
        columns = header.split(",")
        x, y = columns.index("x_mm"), columns.index("y_mm")
        moved = []
        for line in lines:
            cells = line.split(",")
            z = np.exp(1j * turn) * complex(float(cells[x]), float(cells[y])) + shift
            cells[x], cells[y] = f"{z.real:.6f}", f"{z.imag:.6f}"
            moved.append(",".join(cells))
        folder.write(f"{name}.csv", "\n".join([header, *moved]) + "\n")
        texts += [f"{line},{name}" for line in moved]
    folder.write("both.csv", "\n".join([f"{header},session", *texts]) + "\n")
    return folder


def test_files_are_sessions(sessions: Folder) -> None:
    words = ["diagnose", "arm.toml", "monday.csv", "friday.csv", "--json", "--out", "extended.toml"]
    done = sessions.armcal(*words)
    assert done.code == 0, done.err
    assert done.data["effects"] == ["transmission_ripple:2[k=5]"]
    (effect,) = done.data["replication"]
    assert effect["replicates"] is True
    assert [there["session"] for there in effect["sessions"]] == ["monday", "friday"]
    for there in effect["sessions"]:
        for parameter, true in zip(there["parameters"], (0.08, 0.05), strict=True):
            assert abs(parameter["value"] - true) < 5 * parameter["std"]
    written = sessions.read("extended.toml")
    assert "base_offset" in written
    assert "session_base" not in written
    # the arm as it stands in the first session predicts both, the base of the second refitted
    for name in ("monday", "friday"):
        checked = sessions.armcal("validate", "extended.toml", f"{name}.csv", "--json").data
        assert checked["rms_mm"] < 0.2
        assert checked["notes"]  # these are the measurements of the identification
    assert sessions.armcal("validate", "extended.toml", "both.csv", "--json").data["rms_mm"] < 0.2


def test_a_column_names_sessions(sessions: Folder) -> None:
    done = sessions.armcal("identify", "real.toml", "both.csv", "--json", "--out", "calibrated.toml")
    assert done.code == 0, done.err
    values = {p["name"]: p["value"] for p in done.data["parameters"]}
    assert values["session_base.w2"] == pytest.approx(np.degrees(0.4), abs=0.02)
    assert values["session_base.x2"] == pytest.approx(150.0, abs=0.5)
    assert "session_base" not in sessions.read("calibrated.toml")
    alone = sessions.armcal("validate", "calibrated.toml", "monday.csv", "--refit", "none", "--json").data
    assert alone["rms_mm"] < 0.2


def test_next_postures_for_several_files(sessions: Folder) -> None:
    """`discriminate` reads what `diagnose` reads, as its next step is given with the same files."""
    done = sessions.armcal("discriminate", "arm.toml", "monday.csv", "friday.csv", "--runs", "2")
    assert done.code == 0, done.err
    assert "gear ripple, k times per turn (transmission_ripple:2[k=5])" in " ".join(done.out.split())
