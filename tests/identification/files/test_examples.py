"""identification/files/README.md: its examples are files that load, and every JSON key stands on the page."""

import ast
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from doe.studies.monte_carlo import StudyFile
from identification import Plan, load_arm, load_measurements
from identification.kinematics.chain import BASE
from identification.kinematics.counting import Counting

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "identification/files/README.md"
EXAMPLES = dict(
    re.findall(r"^## ([^\n]+)\n(?:(?!^## ).)*?^```\w+\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
)


READ = {  # heading of the example -> what is read of it
    "Arm file": lambda path: (load_arm(path).links, len(load_arm(path).constraints), load_arm(path).effects[1].key),
    "Plan file": lambda path: np.degrees(Plan.load(path).postures[0]).tolist(),
    "Measurement file": lambda path: load_measurements(path).positions.shape,
    "Study file": lambda path: StudyFile.model_validate(tomllib.loads(path.read_text())).replications,
}


@pytest.mark.parametrize(
    ("heading", "expected"),
    [
        ("Arm file", (4, 2, "encoder_eccentricity:2")),
        ("Plan file", pytest.approx([-90.0, -120.0])),
        ("Measurement file", (3, 2)),
        ("Study file", 10_000),
    ],
)
def test_the_example_below_a_heading_is_a_file_that_loads(tmp_path: Path, heading: str, expected: object) -> None:
    (tmp_path / "example").write_text(EXAMPLES[heading])
    assert READ[heading](tmp_path / "example") == expected


def test_examples_of_arms_in_space_load(tmp_path: Path) -> None:
    by_urdf, by_table, cell, lengths, joints = re.findall(
        r"^```toml\n(.*?)^```",
        PAGE.read_text().split("### Spatial arms")[1].split("\n## ")[0],
        re.DOTALL | re.MULTILINE,
    )
    (tmp_path / "robot.urdf").write_text((ROOT / "tests/data/spatial/six_axis.urdf").read_text())
    (tmp_path / "robot.srdf").write_text('<robot name="six"/>')
    arms = []
    for text in (by_urdf, by_table, f"links_mm = [4, 3, 2, 1]\n{joints}", by_urdf + cell, by_urdf + lengths):
        (tmp_path / "arm.toml").write_text(text)
        arms.append(load_arm(tmp_path / "arm.toml"))
    first, table, counted, crowded, bar = arms
    assert (first.links, len(first.constraints), list(first.chain.tools)) == (6, 2, ["top"])
    assert (table.links, table.chain.settled, bar.chain.coordinates) == (2, {BASE}, 1)
    assert counted.counting != Counting.usual(counted.links)
    assert crowded.cell is not None


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
