"""identification/files/README.md: its examples are files that load, and every JSON key stands on the page."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from doe.studies.monte_carlo import StudyFile
from identification import load_plan
from identification.files.arm import load_arm
from identification.files.measurement import load_targets
from identification.measurements import load_measurements

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "identification/files/README.md"
EXAMPLES = dict(
    re.findall(r"^## ([^\n]+)\n(?:(?!^## ).)*?^```\w+\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
)


@pytest.fixture
def example(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """The example below a heading, as a file."""
    path = tmp_path / "example"
    path.write_text(EXAMPLES[request.param])
    return path


@pytest.mark.parametrize("example", ["Arm file"], indirect=True)
def test_arm(example: Path) -> None:
    arm = load_arm(example)
    assert arm.links == 4
    assert len(arm.constraints) == 3
    assert [spec.key for spec in arm.effects] == ["base_offset", "encoder_eccentricity:2"]
    assert arm.calibration is not None


@pytest.mark.parametrize("example", ["Truth file"], indirect=True)
def test_truth(example: Path) -> None:
    assert [spec.name for spec in load_arm(example).effects] == ["gear_ratio", "serial_correlation"]


@pytest.mark.parametrize("example", ["Plan file"], indirect=True)
def test_plan(example: Path) -> None:
    np.testing.assert_allclose(load_plan(example).postures[0], np.radians([-90.0, -120.0]))


@pytest.mark.parametrize("example", ["Measurement file"], indirect=True)
def test_measurements(example: Path) -> None:
    data = load_measurements(example)
    assert data.positions.shape == (3, 2)
    assert data.temperature is not None
    assert data.directions is not None


@pytest.mark.parametrize("example", ["Target file"], indirect=True)
def test_targets(example: Path) -> None:
    positions = load_targets(example, 4).positions
    assert positions is not None
    assert positions.shape == (2, 2)


def test_study() -> None:
    assert StudyFile.model_validate(tomllib.loads(EXAMPLES["Study file"])).replications == 10_000


WRITERS = {"to_json", "as_dict", "next_data", "demo_data", "discriminating_data"}  # functions whose keys users read


def written_keys() -> set[str]:
    """Constant keys of the dictionaries in the functions that write JSON."""
    every = (path.read_text() for package in ("doe", "identification") for path in (ROOT / package).rglob("*.py"))
    sources = [source for source in every if any(f"def {name}(" in source for name in WRITERS)]
    functions = [
        node
        for s in sources
        for node in ast.walk(ast.parse(s))
        if isinstance(node, ast.FunctionDef) and node.name in WRITERS
    ]
    tables = [node for function in functions for node in ast.walk(function) if isinstance(node, ast.Dict)]
    return {str(key.value) for table in tables for key in table.keys if isinstance(key, ast.Constant)}


def test_every_json_key_is_documented() -> None:
    page = PAGE.read_text()
    quoted = " ".join(re.findall(r"`([^`]*)`", page[page.index("## JSON keys") :]))
    assert written_keys() - set(re.findall(r"\w+", quoted)) == set()
