"""Every key of an arm file, spoilt in every way: one line that names it, says what was found and what is allowed."""

import copy
import datetime
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from identification.files.arm import arm_from_tables
from identification.files.schema import ArmFile
from tests.identification.files.test_arm import (
    BY_TABLE,
    BY_URDF,
    CALIBRATION,
    FILES,
    HEAD,
    LENGTHS,
    PLAIN,
    PLANAR,
    load,
)
from tests.refusals import refused

NAMED = [("tool",), ("tools",), ("values",), ("effects",), ("geometry",), ("cups",)]  # tables whose keys are names
Path_ = tuple[int | str, ...]


@pytest.fixture(params=FILES)
def tables(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, Any]:
    """Those of a file that is read as it stands, beside its URDF file."""
    load(tmp_path, FILES[request.param])
    return tomllib.loads(FILES[request.param])


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


def spoilt_by(tables: dict[str, Any], folder: Path, path: Path_, value: Any, key: str = "") -> str:
    """The one-line message for the tables with another value at a place, or the same one under another key."""
    spoilt = copy.deepcopy(tables)
    node = at(spoilt, path[:-1])
    node[key or path[-1]] = node.pop(path[-1]) if key else value
    return refused(arm_from_tables, spoilt, folder, names=["allowed"])


def test_a_value_of_no_type_that_any_key_has(tables: dict[str, Any], tmp_path: Path) -> None:
    for path in places(tables):
        message = spoilt_by(tables, tmp_path, path, datetime.date(2026, 11, 24))
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
            message = spoilt_by(tables, tmp_path, path, wrong)
            assert message.startswith(f"{dotted(path)}: found {shown}, allowed: "), message


FREE = {"effects", "values", "covariance", "length_errors_mm", "joint_offsets_deg", "provenance"}  # of parameters


def test_a_number_that_nothing_is(tables: dict[str, Any], tmp_path: Path) -> None:
    """Far below or above all that there is."""
    for path in places(tables):
        kind = type(at(tables, path))
        if kind in (int, float) and not FREE & {*path}:
            for wrong in (kind(-1e12), kind(1e300)):
                message = spoilt_by(tables, tmp_path, path, wrong)
                assert message.startswith(dotted(path)) or path[0] == "joints", message


def test_a_misspelt_key(tables: dict[str, Any], tmp_path: Path) -> None:
    for path in places(tables):
        if isinstance(path[-1], str) and path[-2:-1] not in NAMED and path[0::2] != ("effects", "joint"):
            message = spoilt_by(tables, tmp_path, path, None, f"{path[-1]}x")
            assert message.startswith((f"{dotted(path)}x: ", f"{dotted(path)}: is missing")), message
            assert f"did you mean '{path[-1]}'" in message or "is missing" in message or path[0] == "effects", message


def test_a_list_that_is_too_long(tables: dict[str, Any], tmp_path: Path) -> None:
    lists = [path for path in places(tables) if isinstance(at(tables, path), list) and type(path[-1]) is str]
    longer = ("dh", "constraints", "bodies", "apart", "effects", "values_deg", "links_mm", "parameters", "distances_mm")
    for path in lists:
        if path[-1] not in longer:
            message = spoilt_by(tables, tmp_path, path, [*at(tables, path), at(tables, path)[-1]])
            assert message.startswith(f"{dotted(path)}: found "), message


def test_editors_accept_what_is_read(tables: dict[str, Any]) -> None:
    import jsonschema  # type: ignore[import-untyped]  # deferred: it takes more than a second to load

    schema = ArmFile.model_json_schema()
    validator = jsonschema.validators.validator_for(schema)(schema)
    validator.validate(tables)
    assert not validator.is_valid({**tables, "arm": "x"})
    assert not validator.is_valid({**tables, "constraints": [{"kind": "keep_out_cone"}]})


# -- values of the right type ------------------------------------------------------------------------------------------
CENTER = "center_mm = [1.0, 2.0, 3.0]"


def spoilt(text: str, old: str, new: str, named: str) -> tuple[str, str]:
    assert old in text
    return text.replace(old, new, 1), named


LIMITS = PLAIN + "[joint_limits_deg]\n"
SIGHT = PLAIN + '[[constraints]]\nkind = "line_of_sight"\ntracker_mm = [1, 0]\n'
BOX = '[[constraints]]\nkind = "workspace_box"\n'
SLIDE = "[joint_limits_mm]\nlower = [-50.0]\nupper = [150.0]\n"
MIXED = 'd_mm=1.0\nconvention = "modified"\n[[dh]]\na_mm=1.0\nd_mm=1.0\nalpha_deg=1.0\nconvention = "standard"'
BASE = '[[effects]]\nname = "base_offset"\n'
BACKLASH = PLAIN + '[[effects]]\nname = "backlash"\n'
TWO = CALIBRATION + 'parameters = ["length_error:1", "joint_offset:2"]\n'
ORIGIN = PLAIN + CALIBRATION + "[calibration.provenance]\n"
BAD = [  # values that are of the right type
    # keys that stand elsewhere, or have another name
    ("sigma_mm = 0.1\n" + PLAIN, "[measurement]"),
    ("lengths_mm = [1.0]\n" + PLAIN, "lengths_mm: unknown key, allowed: "),
    ("description = 'x'\n" + PLAIN, "description: "),
    (PLAIN + "[base]", "spatial"),
    (PLAIN + "[limits]", "'joint_limits_deg'"),
    (LIMITS + "min = [0, 0]\nupper = [90, 90]", "joint_limits_deg.min: unknown key, allowed: lower, upper"),
    (PLANAR.replace("acceleration_m_s2", "g"), "gravity.g: unknown key, allowed: acceleration_m_s2, "),
    (LIMITS + "lower = [0, 0]\nupper = [90, -90]", "joint 2"),
    (PLAIN + "[joints]\nsign = [1, 0]", "joints.sign: found 0 for joint 2"),
    (PLAIN + "[joints]\ncoupled_to = [2, 1]", "joints.coupled_to: found"),
    (PLAIN + '[[constraints]]\nkind = "box"', "constraints[1].kind: found 'box'"),
    (PLAIN + BOX + "x_mm = [1, 0]\ny_mm = [0, 1]", "constraints[1].x_mm: found [1, 0]"),
    (SIGHT + "half_angle_deg = 20\ntoward_mm = [1, 0]", "constraints[1].toward_mm: found [1.0, 0.0]"),
    (BACKLASH, "backlash needs a joint"),
    (PLAIN + BASE + BASE, "base_offset"),
    (PLAIN + '[[effects]]\nname = "transmission_ripple"\njoint = 1\nk = 0', "transmission_ripple:1"),
    (PLAIN + '[[effects]]\nname = "gravity_backlash"\njoint = 1\nb_deg = -1', "effects[1].b_deg: found -1"),
    (PLAIN + CALIBRATION.replace("[0, 0]", "[0, -180]", 1), "calibration.length_errors_mm: found -180"),
    (PLAIN + CALIBRATION + "covariance = [[1]]", "calibration.parameters: is missing"),
    (PLAIN + TWO + "covariance = [[1, 0]]", "calibration.covariance: found 1 rows"),
    (PLAIN + TWO + "covariance = [[1], [2]]", "calibration.covariance: found 1 values"),
    (PLAIN + TWO + "covariance = [[1, 0.1], [0.2, 1]]", "calibration.covariance: found 0.1 in row 1, column 2, 0.2 ac"),
    (PLAIN + TWO + "covariance = [[1, 2], [2, 1]]", "calibration.covariance: found an eigenvalue of -1 "),
    (PLAIN + TWO + "covariance = [[1, 0], [0, -1]]", "calibration.covariance: found an eigenvalue of -1 "),
    (PLAIN + CALIBRATION + 'parameters = ["lenght_error:1"]', "'length_error:1'"),
    (PLAIN + CALIBRATION + '[calibration.effects]\n"base_offset.x0_mm" = 1', "'base_offset.x0_mm'"),
    (PLAIN + BASE + CALIBRATION + '[calibration.effects]\n"base_offset.x0" = 1', "'base_offset.x0_mm'"),
    # of what is kept of a fit, what the program itself reads again
    (f"{ORIGIN}rows = 0", "rows: found 0"),
    (ORIGIN + "joint_range_deg = [[0.0, 90.0], [90.0, -90.0]]", "joint_range_deg[2]: found [90.0, -90.0]"),
    (ORIGIN + "joint_range_mm = [[nan, 1.0]]", "joint_range_mm[1]: found [nan, 1.0]"),
    # what stands in another file that is read as it stands: what to replace, and by what
    spoilt(BY_URDF, 'urdf = "six_axis.urdf"\n', "", "urdf, dh: neither is there"),
    spoilt(BY_URDF, '"six_axis.urdf"', '"../six_axis.urdf"', "urdf: '../six_axis.urdf' is outside"),
    spoilt(BY_URDF, '"six_axis.urdf"', '"none.urdf"', "none.urdf: no such file"),
    spoilt(BY_URDF, '"tool0"', '"tool1"', "did you mean 'tool0'?"),
    spoilt(BY_URDF, "[tool.", "[tools.", "tools: found outside of a table, did you mean 'tool'? allowed: under"),
    spoilt(BY_URDF, 'kind = "spatial"', 'kind = "space"', "kind: found 'space'"),
    spoilt(BY_URDF, "lower = [-300.0]", "lower = [900.0]", "joint_limits_mm: joint 1"),
    spoilt(BY_URDF, "z_mm = [100.0, 2000.0]", "", "constraints[1].z_mm: is missing, allowed: a value for it [mm]"),
    spoilt(BY_URDF, '"keep_out_sphere"', '"keep_out_circle"', "constraints[2].kind: found 'keep_out_circle'"),
    spoilt(BY_URDF, "end_mm = [350.0, 200.0, 900.0]", "end_mm = [350.0, 200.0, 0.0]", "constraints[3].end_mm: found"),
    spoilt(BY_URDF, "facing = [0.0, 0.0, 1.0]", "", "constraints[4].acceptance_deg: found without facing"),
    spoilt(BY_URDF, 'name = "gear_ratio"', 'name = "link_thermal"', "'link_thermal'"),
    spoilt(BY_TABLE, SLIDE, "", "dh[3]: a prismatic joint without limits"),
    spoilt(BY_TABLE, "d_mm = 127.3", MIXED, "dh: found conventions modified and standard"),
    spoilt(
        BY_TABLE, SLIDE, f"{SLIDE}[base]\n[calibration.values]\n[calibration.base]", "calibration.base: found beside"
    ),
    # [instrument] behind the arm
    *(
        (f"{head}[instrument]\nkind = {lines}\n", part)
        for head, lines, part in (
            (HEAD, '"tracker"', "instrument.kind: found 'tracker' for a spatial arm, allowed: distance, plane, "),
            (HEAD, '"distance"\nradius_mm = 3.0', "radius_mm: found for kind distance, allowed: for sphere"),
            (HEAD, f'"plane"\n{CENTER}', "instrument.normal: is missing beside center_mm"),
            (HEAD, '"plane"\nnormal = [1.0, 2.0, 3.0]', "instrument.center_mm: is missing beside normal"),
            (HEAD, f'"plane"\n{CENTER}\nnormal = [0, 0, 0]', "normal: found [0, 0, 0], allowed: a direction"),
            (HEAD, '"distance"\ncenter_mm = [1.0, 2.0]', "center_mm: found [1.0, 2.0], allowed: three numbers"),
            (HEAD, f'"distance"\n{CENTER}\n[base]\nx_mm = 1.0', "instrument.center_mm: found beside"),
            (HEAD, '"distance"\n[measurement]\nsigma_mm = 1.0\nsigma_deg = 1.0', "sigma_deg: found beside"),
            (HEAD, f'"socket"\n{CENTER}', "center_mm: found for kind socket, allowed: for distance, plane"),
            (HEAD, '"socket"\ncups = {A = [1.0, 2.0]}', "allowed: three numbers"),
            (HEAD, '"socket"\ndistances_mm = [["A", 3.0]]', "distances_mm[1][2]: found 3.0, allowed: a string"),
            (HEAD, '"socket"\n[base]\nx_mm = 3.0', "base: found with an [instrument] of kind socket, allowed: left"),
            (HEAD, '"sphere"', "instrument.radius_mm: is missing, allowed: of ball and stylus tip together"),
            (LENGTHS, '"sphere"', "instrument.kind: found 'sphere' for a planar arm, allowed: distance"),
            (LENGTHS, f'"distance"\n{CENTER}', "center_mm: found [1.0, 2.0, 3.0], allowed: two numbers"),
            (LENGTHS, f'"distance"\n{BASE}', "base_offset is of measured positions, found"),
        )
    ),
]


@pytest.mark.parametrize(("text", "named"), BAD, ids=[named[:50] for _, named in BAD])
def test_bad_input_is_one_line(tmp_path: Path, text: str, named: str) -> None:
    refused(load, tmp_path, text, names=[f"{tmp_path / 'arm.toml'}: ", named])
