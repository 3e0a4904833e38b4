"""Files of a campaign as one document, without the plans that another package adds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from identification import Arm, Calibration, InputError, Measurements, Model, campaign_document
from identification.workflow import Written, identify_files

LENGTHS = [300.0, 200.0]
REAL = Arm(LENGTHS, calibration=Calibration.of([1.0, -2.0], [0.01, -0.02]))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An arm, exact measurements of another, its calibration by them, and rows that it has not seen."""
    (tmp_path / "arm.toml").write_text(f"links_mm = {LENGTHS}\n")
    for name, seed in (("data", 1), ("other", 2)):
        q = np.random.default_rng(seed).uniform(-2.0, 2.0, (30, 2))
        (tmp_path / f"{name}.csv").write_text(Measurements(q, Model(REAL).position(q)).to_frame().write_csv())
    identify_files(tmp_path / "arm.toml", tmp_path / "data.csv", out=Written(tmp_path / "calibrated.toml"))
    return tmp_path


def test_what_a_calibration_leaves_of_other_rows_is_said_first(folder: Path) -> None:
    names = [folder / name for name in ("arm.toml", "calibrated.toml", "data.csv", "other.csv")]
    document, kinds = campaign_document(names)
    assert [*kinds.values()] == ["arm", "arm with a calibration", "measurements", "measurements"]
    assert document.verdict[0].startswith(f"On 30 rows of {folder / 'other.csv'}, {folder / 'calibrated.toml'} takes")
    assert "more than 99.9 % of the error is removed" in document.verdict[0]
    assert any("compensate" in action.command for action in document.actions)
    assert "length of link 1" in str(document)


def test_a_plan_is_read_and_what_is_no_table_of_the_arm_is_one_line(folder: Path) -> None:
    (folder / "plan.csv").write_text("run,q1_deg,q2_deg\n1,10,20\n")
    assert campaign_document([folder / "arm.toml", folder / "plan.csv"])[0].verdict[0].endswith("plan.csv has 1 runs.")
    (folder / "plan.csv").write_text("a,b\n1,10\n")
    with pytest.raises(InputError, match="q1_deg") as refused:
        campaign_document([folder / "arm.toml", folder / "plan.csv"])
    assert "\n" not in str(refused.value)
