"""The loop of commands as a user's script runs it, with the JSON keys it reads."""

from __future__ import annotations

import numpy as np
import pytest

from doe.cli import main
from identification.validate import REFITS
from tests.doe.cli.conftest import ARM, CALIBRATION, Folder

DESIGN_KEYS = {
    "criterion", "runs", "links", "log_det", "bound", "efficiency", "certified_optimal", "postures_deg",
    "table_1_max_residual", "std", "solver", "status", "starts", "seconds",
}  # fmt: skip
IDENTIFY_KEYS = {
    "parameters", "not_identifiable", "sigma_mm", "chi2", "dof", "p_value", "rms_before_mm", "rms_after_mm",
    "max_before_mm", "max_after_mm", "method",
}  # fmt: skip
VALIDATE_KEYS = {
    "rows", "refit", "rms_mm", "mean_mm", "p95_mm", "max_mm", "rms_nominal_mm", "blocks", "refitted", "notes",
}  # fmt: skip


def test_design_reaches_the_bound_and_writes_the_plan(folder: Folder) -> None:
    done = folder.armcal("design", "arm.toml", "--runs", "8", "--json", "--out", "plan8.csv")
    assert done.code == 0, done.err
    assert set(done.data) >= DESIGN_KEYS
    # doe/README.md, "Planar theorem": 4 sum_(j>=2) log sin(min(Delta_j / 2, 90 deg)), Delta = 240, 160, 180 deg
    assert done.data["bound"]["value"] == pytest.approx(4 * np.log(np.sin(np.radians(80.0))), abs=1e-12)
    assert done.data["certified_optimal"] is True
    postures = np.array(done.data["postures_deg"])
    assert postures.shape == (8, 4)
    assert np.all(postures >= [-180, -120, -100, -90])
    assert np.all(postures <= [180, 120, 60, 90])
    header, *rows = folder.read("plan8.csv").splitlines()
    assert header == "run,q1_deg,q2_deg,q3_deg,q4_deg"
    written = np.array([[float(cell) for cell in row.split(",")[1:]] for row in rows])
    np.testing.assert_allclose(written, postures, atol=1e-9)
    scored = folder.armcal("score", "arm.toml", "plan8.csv", "--json").data
    assert scored["log_det"] == pytest.approx(done.data["log_det"], abs=1e-9)


def test_simulate_identify_round(folder: Folder) -> None:
    folder.simulated()
    done = folder.armcal("identify", "arm.toml", "data.csv", "--json", "--out", "calibrated.toml")
    assert done.code == 0, done.err
    assert set(done.data) >= IDENTIFY_KEYS
    truth = [1.5, -0.6, -0.4, 0.7, 0.5, -0.5, 0.7, -0.3]
    for parameter, true in zip(done.data["parameters"], truth, strict=True):
        assert abs(parameter["value"] - true) < 5 * parameter["std"]  # a 5-sigma event has probability 6e-7
        assert parameter["low_95"] < parameter["value"] < parameter["high_95"]
    again = folder.armcal("identify", "calibrated.toml", "data.csv", "--json")
    assert again.data["rms_before_mm"] == pytest.approx(done.data["rms_after_mm"], abs=1e-9)
    for one, two in zip(again.data["parameters"], done.data["parameters"], strict=True):
        assert one["value"] == pytest.approx(two["value"], abs=1e-7)


def test_same_seed_same_data(folder: Folder) -> None:
    folder.simulated()
    first = folder.read("data.csv")
    words = ["simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--out", "data.csv", "--force"]
    folder.armcal(*words)
    assert folder.read("data.csv") == first
    folder.armcal(*words, "--seed", "1")
    assert folder.read("data.csv") != first


def test_not_identifiable_is_named_and_exits_1(folder: Folder) -> None:
    folder.simulated()
    folder.write("arm.toml", ARM + '\n[[effects]]\nname = "base_rotation"\n')
    done = folder.armcal("identify", "arm.toml", "data.csv", "--json", "--out", "calibrated.toml")
    assert done.code == 1
    assert not (folder.path / "calibrated.toml").exists()
    assert any("joint_offset:1" in c and "base_rotation" in c for c in done.data["not_identifiable"])
    for parameter in done.data["parameters"]:
        assert parameter["std"] is None or parameter["std"] < 10.0


def test_score_gives_the_observability_indices(folder: Folder) -> None:
    """Singular values of the chain's Jacobian, lengths in mm and joint offsets times their link's length."""
    scored = folder.armcal("score", "arm.toml", "plan.csv", "--json").data
    lengths = np.array([260.0, 180.0, 120.0, 100.0])
    links = np.exp(1j * np.cumsum(np.radians(scored["postures_deg"]), axis=1))
    levers = 1j * np.cumsum((links * lengths)[:, ::-1], axis=1)[:, ::-1]
    columns = np.hstack([links, levers / lengths])
    s = np.linalg.svd(np.vstack([columns.real, columns.imag]), compute_uv=False)
    expected = [np.prod(s) ** (1 / 8) / np.sqrt(len(links)), s[-1] / s[0], s[-1], s[-1] ** 2 / s[0], 1 / np.sum(1 / s)]
    assert list(scored["observability"]) == ["o1", "o2", "o3", "o4", "o5"]
    assert list(scored["observability"].values()) == pytest.approx(expected)
    assert f"O2 {s[-1] / s[0]:.4g}" in folder.armcal("score", "arm.toml", "plan.csv").out


def test_conditions_in_the_plan_reach_the_measurements(folder: Folder) -> None:
    header, *rows = folder.read("plan.csv").splitlines()
    warm = [f"{row},{20.0 + 0.5 * k}" for k, row in enumerate(rows)]
    folder.write("warm.csv", "\n".join([header + ",temperature_C", *warm]) + "\n")
    growth = '\n[[effects]]\nname = "thermal_growth"\na_per_K = 0.001\n'
    folder.write("truth.toml", ARM.replace("sigma_mm = 0.1", "sigma_mm = 1e-9") + growth)
    words = ["simulate", "arm.toml", "warm.csv", "--truth", "truth.toml", "--out", "data.csv"]
    assert folder.armcal(*words).code == 0
    header, *rows = folder.read("data.csv").splitlines()
    table = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    column = {name: k for k, name in enumerate(header.split(","))}
    theta = np.cumsum(np.radians(table[:, :4]), axis=1)
    deviation = table[:, column["temperature_C"]] - table[:, column["temperature_C"]].mean()
    tip = (np.array([260.0, 180.0, 120.0, 100.0]) * np.exp(1j * theta)).sum(axis=1) * (1.0 + 0.001 * deviation)
    np.testing.assert_allclose(table[:, column["x_mm"]], tip.real, atol=1e-6)
    refused = folder.armcal("simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--out", "cold.csv")
    assert refused.code == 2
    assert "temperature_C" in refused.err


def test_two_ripples_of_one_joint_go_round_the_loop(folder: Folder) -> None:
    ripples = "".join(
        f'\n[[effects]]\nname = "transmission_ripple"\njoint = {j}\nk = {k}\na_deg = {a}\nb_deg = {b}\n'
        for j, k, a, b in ((1, 20, 0.06, 0.0), (1, 29, 0.03, 0.05), (2, 18, 0.0, 0.08))
    )
    folder.write("truth.toml", ARM + ripples + CALIBRATION)
    postures = np.random.default_rng(5).uniform([-180, -120, -100, -90], [180, 120, 60, 90], (120, 4))
    rows = [",".join([str(k + 1), *(f"{a:.6f}" for a in posture)]) for k, posture in enumerate(postures)]
    folder.write("plan.csv", "\n".join(["run,q1_deg,q2_deg,q3_deg,q4_deg", *rows]) + "\n")
    folder.simulated()
    words = ["diagnose", "arm.toml", "data.csv", "--json", "--out", "extended.toml"]
    found = folder.armcal(*words).data
    one, other = "transmission_ripple:1[k=20]", "transmission_ripple:1[k=29]"
    assert (found["verdict"], set(found["effects"])) == ("named", {one, other, "transmission_ripple:2[k=18]"})
    done = folder.armcal("identify", "extended.toml", "data.csv", "--json", "--out", "calibrated.toml")
    assert done.code == 0, done.err
    assert f"{one}.a" in folder.armcal("identify", "extended.toml", "data.csv").out  # brackets are no markup
    folder.write("own.toml", (folder.path / "extended.toml").read_text(encoding="utf-8"))
    assert folder.armcal("identify", "own.toml", "data.csv", "--out", "own.toml").code == 2
    assert folder.armcal("identify", "own.toml", "data.csv", "--out", "own.toml", "--force").code == 0
    assert (folder.path / "own.toml").read_bytes() == (folder.path / "calibrated.toml").read_bytes()
    values = {p["name"]: p for p in done.data["parameters"]}
    truth = {f"{one}.a": 0.06, f"{one}.b": 0.0, f"{other}.a": 0.03, f"{other}.b": 0.05, "transmission_ripple:2.b": 0.08}
    for name, true in truth.items():
        assert abs(values[name]["value"] - true) < 5 * values[name]["std"]
    assert folder.armcal("score", "calibrated.toml", "plan.csv", "--seconds", "0.3").code == 0
    folder.write("targets.csv", "x_mm,y_mm\n350,250\n-200,300\n")
    reached = folder.armcal("compensate", "calibrated.toml", "targets.csv", "--json").data
    assert (reached["targets"], reached["reached"]) == (2, 2)


def test_two_ripples_of_one_joint_in_a_design(folder: Folder) -> None:
    ripples = "".join(f'[[effects]]\nname = "transmission_ripple"\njoint = 1\nk = {k}\n' for k in (3, 4))
    folder.write("two.toml", "links_mm = [300, 200]\n" + ripples)
    words = [
        "design",
        "two.toml",
        "--runs",
        "8",
        "--criterion",
        "Ds",
        "--solver",
        "random",
        "--seconds",
        "0.3",
        "--json",
        "--subset",
    ]
    done = folder.armcal(*words, ",".join(f"transmission_ripple:1[k=4].{short}" for short in "ab"))
    assert done.code == 0, done.err
    assert np.shape(done.data["postures_deg"]) == (8, 2)
    assert folder.armcal(*words, "transmission_ripple:1.a").code == 2


def test_targets_beyond_the_identified_angles_are_said(folder: Folder) -> None:
    folder.simulated()
    folder.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml")
    folder.write("targets.csv", "q1_deg,q2_deg,q3_deg,q4_deg\n10,20,30,40\n179.99,20,30,40\n")
    done = folder.armcal("compensate", "calibrated.toml", "targets.csv", "--json")
    said = "1 of 2 targets are outside the angles that the model was identified on (joint 1 in 1)"
    assert said in done.err
    shown = folder.armcal("compensate", "calibrated.toml", "targets.csv")
    assert (said in " ".join(shown.out.split()), shown.err) == (True, "")  # once


def test_validate_on_another_session_and_on_the_own_data(folder: Folder) -> None:
    folder.simulated()
    folder.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml")
    folder.simulated("other.csv", seed=1)
    done = folder.armcal("validate", "calibrated.toml", "other.csv", "--json", "--picture", "picture.png")
    assert done.code == 0, done.err
    assert set(done.data) >= VALIDATE_KEYS
    assert done.data["rows"] == 12
    assert done.data["rms_mm"] < 0.5 < 1.0 < done.data["rms_nominal_mm"]  # noise of 0.1 mm against errors of 0.5 deg
    assert folder.path.joinpath("picture.png").read_bytes()[:4] == b"\x89PNG"
    own = folder.armcal("validate", "calibrated.toml", "data.csv", "--json")
    (note,) = own.data["notes"]
    assert f"warning: data.csv: {note}" in own.err
    shown = folder.armcal("validate", "calibrated.toml", "data.csv")
    assert (note in " ".join(shown.out.split()), note in shown.err) == (True, False)  # once
    (refit,) = (parameter for parameter in main.commands["validate"].params if parameter.name == "refit")
    assert tuple(refit.type.choices) == REFITS
