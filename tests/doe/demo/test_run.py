"""The loop of the spatial demo on what it hides."""

from pathlib import Path

import numpy as np
import pytest

from doe.demo.run import Demo, demo_document, overview_figure, run_demo
from doe.plan.moves import room_of
from identification import Plan, load_arm
from identification.files.urdf import read_urdf
from tests.doe.plan.test_plan import sampled


def test_the_hidden_effect_is_named_the_gap_closes_and_all_is_shown(tmp_path: Path) -> None:
    """With random postures: the search for better ones takes a quarter of a minute."""
    with pytest.warns(UserWarning, match="the measured point is not known"):
        demo: Demo = run_demo(tmp_path, spatial=True, solver="random", starts=1)
    gaps, hidden, diagnosis = demo.data["fresh_gap_mm"], demo.data["hidden"], demo.diagnosed.result
    problem, way = demo.design.problem, Plan.load(tmp_path / "plan.csv").postures
    assert sampled(room_of(problem.model, problem.constraints), way, 300) > 0.0  # of every move
    assert diagnosis.effects == ("encoder_eccentricity:2",)
    assert diagnosis.confirmed is True
    assert gaps["drawing"] > 2.0 > 4.0 * gaps["identified"] > 4.0 * gaps["extended"]
    # 27 combinations of geometry and 2 parameters of the effect, from 108 equations at postures of this efficiency
    share = 29.0 / 108.0 / (demo.design.efficiency or np.nan)
    spread = 1.0 + 3.0 / np.sqrt(2.0 * 29.0)  # three standard deviations of the root of 29 squares
    allowed = gaps["noise"] * np.sqrt(share) * spread
    assert hidden["model_error_mm"] < allowed
    assert gaps["extended"] < gaps["noise"] * np.sqrt(1.0 + share * spread**2) * (1.0 + 3.0 / np.sqrt(1200.0))
    assert hidden["targets_corrected_mm"] < allowed < 2.0 < hidden["targets_as_drawn_mm"]
    assert hidden["targets_reached"] == 50
    assert [row["name"] for row in hidden["parameters"]] == ["encoder_eccentricity:2.a", "encoder_eccentricity:2.b"]
    assert all(abs(row["value"] - row["hidden"]) < 4.0 * row["std"] for row in hidden["parameters"])
    assert "corrected.urdf" in demo.data["files"]
    assert all((tmp_path / name).stat().st_size for name in demo.data["files"])
    written = read_urdf(tmp_path / "corrected.urdf").chain("base_link", "flange")
    assert demo.identified.result.geometry is not None
    for joint, real in zip(written.joints, demo.identified.result.geometry.real.joints, strict=True):
        np.testing.assert_allclose(joint.origin, real.origin, atol=1e-9)
    assert len(load_arm(tmp_path / "extended.toml").effects) == 1
    with pytest.warns(UserWarning, match="beside the last axis is assumed"):  # of the plan
        assert "with encoder_eccentricity:2" in str(demo_document(demo))
    assert [axes.name for axes in overview_figure(demo).axes] == ["3d", "rectilinear", "rectilinear"]
