"""Every key of an arm file, spoilt in every way: one line that names it, says what was found and what is allowed."""

from __future__ import annotations

import copy
import datetime
import json
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification.errors import InputError
from identification.files.arm import arm_from_tables, dump_arm
from identification.files.schema import ArmFile, json_schema
from tests.identification.files.test_arm import FULL, same
from tests.identification.files.test_arm_spatial import BY_TABLE, BY_URDF, URDF

JOINTS = "[joints]\nsign = [1, -1, 1, 1]\ncoupled_to = [0, 0, 2, 0]\nzero_deg = [0.0, 5.0, 0.0, 0.0]\n"
CURVE = (
    '[[effects]]\nname = "joint_error_curve"\njoint = 1\nfrom_deg = -90.0\nto_deg = 90.0\n'
    'values_deg = [0.0, 0.1, 0.0, 0.1]\ngeometry = {"length_error:1" = 0.2}\n'
)
PLANE = '[instrument]\nkind = "plane"\ncenter_mm = [1.0, 2.0, 3.0]\nnormal = [0.0, 0.0, 1.0]\n'
PLACED = (
    '[calibration]\nparameters = ["joint_offset:2"]\ncovariance = [[1.0]]\n'
    '[calibration.values]\n"joint_offset:2" = 0.1\n'
    "[calibration.base]\nx_mm = 1.0\n[calibration.tools.1]\nz_mm = 2.0\n"
)
BODIES = """
[cell]
floor_z_mm = -10.0
clearance_mm = 5.0
bodies_of_urdf = true
apart = [["wall", "sphere 3"]]

[[cell.bodies]]
kind = "box"
name = "wall"
size_mm = [20.0, 300.0, 10.0]
x_mm = 400.0
rz_deg = 30.0

[[cell.bodies]]
kind = "cylinder"
joint = 2
start_mm = [180.0, 0.0, 0.0]
end_mm = [200.0, 10.0, 0.0]
radius_mm = 8.0

[[cell.bodies]]
kind = "sphere"
center_mm = [210.0, 0.0, 1.0]
radius_mm = 9.0

[[cell.bodies]]
kind = "mesh"
file = "part.stl"
unit = "m"
"""
PLANAR_BODIES = """
[cell]

[[cell.bodies]]
kind = "capsule"
joint = 2
start_mm = [180.0, 0.0]
end_mm = [200.0, 10.0]
radius_mm = 8.0
"""
FILES = {
    "planar": "link_width_mm = 30.0\n"
    + FULL.replace("# what was found", f"{CURVE}{JOINTS}{PLANAR_BODIES}\n# what was found"),
    "urdf": BY_URDF + BODIES,
    "rows": f"{BY_TABLE}{PLACED}",
    "probe": f"{BY_TABLE}{PLANE}",
    "ball": f'{BY_TABLE}[instrument]\nkind = "sphere"\nradius_mm = 10.0\n',
}
NAMED = [("tool",), ("tools",), ("values",), ("effects",), ("geometry",)]  # tables whose keys are names
Path_ = tuple[int | str, ...]


@pytest.fixture(params=FILES)
def tables(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, Any]:
    """Those of a file that is read as it stands, beside its URDF file."""
    shutil.copy(URDF, tmp_path / "six_axis.urdf")
    found = tomllib.loads(FILES[request.param])
    arm_from_tables(found, tmp_path)
    return found


def places(node: Any, path: Path_ = ()) -> Iterator[Path_]:
    """Where values and tables stand, but for the provenance, in which anything goes."""
    if path:
        yield path
    for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        if key != "provenance":
            yield from places(value, (*path, key))


def at(node: Any, path: Path_) -> Any:
    for key in path:
        node = node[key]
    return node


def dotted(path: Path_) -> str:
    return "".join(f"[{key + 1}]" if isinstance(key, int) else f".{key}" for key in path)[1:]


def refused(tables: dict[str, Any], folder: Path, path: Path_, value: Any, key: str = "") -> str:
    """The one-line message for the tables with another value at a place, or the same one under another key."""
    spoilt = copy.deepcopy(tables)
    node = at(spoilt, path[:-1])
    node[key or path[-1]] = node.pop(path[-1]) if key else value
    with pytest.raises(InputError) as caught:
        arm_from_tables(spoilt, folder)
    message = str(caught.value)
    assert "\n" not in message
    assert "allowed" in message, message
    return message


def test_a_value_of_no_type_that_any_key_has(tables: dict[str, Any], tmp_path: Path) -> None:
    date = datetime.date(2026, 11, 24)
    for path in places(tables):
        message = refused(tables, tmp_path, path, date)
        if path[0] == "tool":  # by the name of a marker, or a key of the only one
            assert message.startswith("tool")
        else:
            assert message.startswith(dotted(path))
            assert "found datetime.date(2026, 11, 24)" in message or "found '2026-11-24'" in message


def test_a_number_that_is_none_or_text_or_true(tables: dict[str, Any], tmp_path: Path) -> None:
    numbers = [path for path in places(tables) if type(at(tables, path)) in (int, float)]
    assert len(numbers) > 5
    for path in numbers:
        for wrong, shown in ((float("nan"), "nan"), (float("-inf"), "-inf"), ("1", "'1'"), (True, "true")):
            message = refused(tables, tmp_path, path, wrong)
            assert message.startswith(f"{dotted(path)}: found {shown}, allowed: "), message


FREE = {"effects", "values", "covariance", "length_errors_mm", "joint_offsets_deg", "provenance"}  # of parameters


def test_a_number_that_nothing_is(tables: dict[str, Any], tmp_path: Path) -> None:
    """Far below or above all that there is."""
    for path in places(tables):
        kind = type(at(tables, path))
        if kind in (int, float) and not FREE & {*path}:
            for wrong in (kind(-1e12), kind(1e300)):
                message = refused(tables, tmp_path, path, wrong)
                assert message.startswith(dotted(path)) or path[0] == "joints", message


def test_a_misspelt_key(tables: dict[str, Any], tmp_path: Path) -> None:
    for path in places(tables):
        if isinstance(path[-1], str) and path[-2:-1] not in NAMED and path[0::2] != ("effects", "joint"):
            message = refused(tables, tmp_path, path, None, f"{path[-1]}x")
            assert message.startswith((f"{dotted(path)}x: ", f"{dotted(path)}: is missing")), message
            hinted = f"did you mean '{path[-1]}'" in message
            assert hinted or "is missing" in message or path[0] == "effects", message


def test_a_list_that_is_too_long(tables: dict[str, Any], tmp_path: Path) -> None:
    lists = [path for path in places(tables) if isinstance(at(tables, path), list) and type(path[-1]) is str]
    for path in lists:
        if path[-1] not in ("dh", "constraints", "bodies", "apart", "effects", "values_deg", "links_mm", "parameters"):
            message = refused(tables, tmp_path, path, [*at(tables, path), at(tables, path)[-1]])
            assert message.startswith(f"{dotted(path)}: found "), message


def test_what_is_read_is_written_and_read_again(tables: dict[str, Any], tmp_path: Path) -> None:
    """But for bodies, which are written as they are covered, and what a drawing in a URDF file says otherwise."""
    arm = replace(arm_from_tables(tables, tmp_path), cell=None)
    again = arm_from_tables(tomllib.loads(dump_arm(arm)))
    for one, other in zip(arm.chain.joints, again.chain.joints, strict=True):
        np.testing.assert_allclose(other.origin, one.origin, rtol=1e-12, atol=1e-11)
    if arm.calibration is None:  # where the frame of an instrument is, it is written under [calibration]
        again = replace(again, calibration=None)
    same(replace(arm, chain=again.chain), again)
    same((arm.chain.settled, arm.chain.angle_scale), (again.chain.settled, again.chain.angle_scale))
    assert again.chain.instrument == arm.chain.instrument
    np.testing.assert_allclose(again.chain.base, arm.chain.base, rtol=1e-12, atol=1e-11)


def test_editors_accept_what_is_read_and_no_key_of_another_kind_of_arm(tables: dict[str, Any]) -> None:
    import jsonschema  # type: ignore[import-untyped]  # deferred: it takes more than a second to load

    kind = tables.get("kind", "planar")
    schema = json_schema(kind)
    validator = jsonschema.validators.validator_for(schema)(schema)
    validator.validate(tables)
    other = set(json_schema("planar" if kind == "spatial" else "spatial")["properties"])
    assert set(ArmFile.model_fields) == other | set(schema["properties"])
    for key in other - set(schema["properties"]):
        assert not validator.is_valid({**tables, key: "x"})
    assert not validator.is_valid({**tables, "constraints": [{"kind": "keep_out_cone"}]})
    assert '"of"' not in json.dumps(schema)
