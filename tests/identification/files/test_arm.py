"""Arm files (identification/files/README.md, "Arm file"): what is read, exact round trips, comments kept."""

import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from identification import InputError, Model, readonly
from identification.arm import Arm, Calibration, EffectSpec, ErrorCurve, Gravity, Machining
from identification.files.arm import arm_from_tables, load_arm, with_effects
from identification.files.urdf import read_urdf
from identification.instruments import Distance, Instrument, PlanarDistance, Plane, Sphere
from identification.kinematics.chain import BASE, TOOL, DHRow
from identification.kinematics.frames import pose
from identification.workspace import KeepOut, LineOfSight, WorkspaceBox
from tests.identification.kinematics.test_spatial import printed

DATA = Path(__file__).parents[2] / "data"
URDF = DATA / "spatial" / "six_axis.urdf"
NAMES = ("paper", "six", "table", "planar_cell", "spatial_cell")
FULL, BY_URDF, BY_TABLE, PLANAR_CELL, CELL = ((DATA / f"arms/{name}.toml").read_text() for name in NAMES)
PLAIN = "links_mm = [260.0, 180.0]\n"
PLANAR = PLAIN + "[gravity]\nacceleration_m_s2 = [0, -9.81]\nlink_masses_kg = [1, 1]\n"
LENGTHS = "links_mm = [300.0, 200.0]\n"
CALIBRATION = "[calibration]\nlength_errors_mm = [0, 0]\njoint_offsets_deg = [0, 0]\n"
HEAD = 'kind = "spatial"\n[[dh]]\na_mm = 300.0\nalpha_deg = 0.0\nd_mm = 10.0\n'
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
FILES = {
    "planar": "link_width_mm = 30.0\n"
    + FULL.replace("# what was found", f"{CURVE}{JOINTS}{PLANAR_CELL}\n# what was found"),
    "urdf": f"{BY_URDF}\n{CELL}",
    "rows": f"{BY_TABLE}{PLACED}",
    "probe": f"{BY_TABLE}{PLANE}",
    "ball": f'{BY_TABLE}[instrument]\nkind = "sphere"\nradius_mm = 10.0\n',
    "cups": f'{BY_TABLE}[instrument]\nkind = "socket"\ndistances_mm = [["A", "B", 9]]\ncups = {{A = [1, 2, 3]}}\n',
}


def load(folder: Path, text: str) -> Arm:
    """The arm of a file beside its URDF file."""
    shutil.copy(URDF, folder)
    (folder / "arm.toml").write_text(text)
    return load_arm(folder / "arm.toml")


def same(a: object, b: object) -> None:
    """Equal plain data, numbers to 1e-12."""
    if hasattr(a, "__dataclass_fields__"):
        assert type(a) is type(b)
        for key, value in vars(a).items():
            same(value, vars(b)[key])
    elif hasattr(a, "items"):
        assert set(a) == set(b)
        for key in a:
            same(a[key], b[key])
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            same(x, y)
    elif isinstance(a, float | np.ndarray):
        np.testing.assert_allclose(b, a, rtol=1e-12, atol=1e-11 if np.ndim(a) > 1 else 1e-14)
    else:
        assert a == b


# -- reading -----------------------------------------------------------------------------------------------------------
def test_every_documented_key_is_read(tmp_path: Path) -> None:
    deg = np.pi / 180.0
    expected = Arm(
        chain=[260.0, 180.0, 120.0, 100.0],
        lower=deg * np.array([-180.0, -120.0, -100.0, -90.0]),
        upper=deg * np.array([180.0, 120.0, 60.0, 90.0]),
        sigma=0.1,
        name="paper-4-link",
        gravity=Gravity(readonly([0, -9.81]), readonly([12, 8, 5, 3]), readonly([0.5, 0.4, 0.5, 0.5]), 10.0),
        constraints=(
            WorkspaceBox((-400.0, 600.0), (0.0, 650.0)),
            KeepOut((350.0, 200.0), 60.0),
            LineOfSight((1500.0, 300.0), 25.0 * deg, (0.0, 200.0)),
        ),
        effects=(EffectSpec("base_offset"), EffectSpec("encoder_eccentricity", 2, {"a": 0.03 * deg, "b": -0.01 * deg})),
        calibration=Calibration.of(
            length_errors=readonly([1.5, -0.6, -0.4, 0.7]),
            joint_offsets=deg * np.array([0.5, -0.5, 0.7, -0.3]),
            effects={"base_offset.x0": 2.5},
            parameter_names=("length_error:1", "joint_offset:2", "base_offset.x0"),
            covariance=np.array([[1, 0.5 * deg, 0], [0.5 * deg, 4 * deg**2, 0], [0, 0, 9]]),
            provenance={"file": "data.csv", "rms_after_mm": 0.1},
        ),
    )
    same(expected, load(tmp_path, FULL))


def test_what_is_left_out_has_its_default(tmp_path: Path) -> None:
    same(Arm([260.0, 180.0]), load(tmp_path, PLAIN))
    gravity = load(tmp_path, PLANAR).gravity
    assert (gravity.center_of_mass.tolist(), gravity.payload) == ([0.5, 0.5], 0.0)


def test_units_that_look_wrong_warn(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"arm.toml: the arm reaches 0.44 mm, which looks like metres; write millimet"):
        load(tmp_path, "links_mm = [0.26, 0.18]\n")
    with pytest.warns(UserWarning, match=r"arm.toml: joint_limits_deg: .* look like radians; write them in degrees"):
        load(tmp_path, PLAIN + "[joint_limits_deg]\nlower = [-3.14, -2]\nupper = [3.14, 6.2832]\n")


def test_arm_of_a_urdf_file(tmp_path: Path) -> None:
    arm = load(tmp_path, BY_URDF)
    nominal, chain = read_urdf(URDF).chain("world", "tool0"), arm.chain
    for joint, other in zip(chain.joints, nominal.joints, strict=True):
        assert joint.name == other.name
        np.testing.assert_array_equal(joint.origin, other.origin)
    assert (arm.name, arm.links, arm.dimension, arm.sigma) == ("six", 6, 3, 0.05)
    assert (arm.lower[0], arm.upper[0]) == (-300.0, 500.0)
    np.testing.assert_array_equal(arm.upper[1:], [joint.upper for joint in nominal.joints[1:]])
    turn = Rotation.from_euler("XYZ", (10.0, -20.0, 130.0), degrees=True).as_matrix()  # capitals: own axes
    np.testing.assert_allclose(chain.base, pose((1000.0, -200.0, 50.0), turn), atol=1e-12)
    assert chain.settled == {BASE, TOOL}
    places = {name: at[:3, 3].tolist() for name, at in chain.tools.items()}
    assert places == {"left": [60.0, 20.0, 50.0], "right": [-70.0, 0.0, 0.0]}
    assert (arm.machining, arm.gear_ratios[5]) == (Machining(1.0, np.radians(0.2)), 0.0)
    assert arm.gravity.acceleration.tolist() == [0.0, 0.0, -9.81]
    assert (arm.gravity.payload_at.tolist(), arm.effects[0].values) == ([10.0, -20.0, 80.0], {"e": 0.0005})
    sight = (np.radians(25.0), (0.0, 200.0, 500.0), (500.0, 5000.0), (0.0, 0.0, 1.0), np.radians(30.0))
    assert arm.constraints == (
        WorkspaceBox((-400.0, 600.0), (0.0, 650.0), (100.0, 2000.0)),
        KeepOut((350.0, 200.0, 100.0), 60.0),
        KeepOut((350.0, 200.0, 0.0), 60.0, (350.0, 200.0, 900.0)),
        LineOfSight((1500.0, 300.0, 1000.0), *sight),
    )


def test_limits_of_the_arm_file_stand_in_for_those_of_the_urdf(tmp_path: Path) -> None:
    load(tmp_path, BY_URDF)
    path = tmp_path / "arm.toml"
    (tmp_path / "six_axis.urdf").write_text(re.sub(r'lower="-0.4" upper="0.6"', "", URDF.read_text()))
    assert load_arm(path).upper[0] == 500.0
    path.write_text(re.sub(r"\[joint_limits_mm\]\nlower.*\nupper.*\n", "", BY_URDF))
    with pytest.raises(InputError, match=r"joint 'slide': limit, lower or upper is missing, allowed: both"):
        load_arm(path)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_arm_of_a_table(tmp_path: Path, convention: str) -> None:
    """The tip is the product of the matrices as the convention prints them."""
    arm = load(tmp_path, BY_TABLE.replace("d_mm = 127.3", f'd_mm = 127.3\nconvention = "{convention}"'))
    rows = [
        DHRow(10.0, np.pi / 2, 127.3),
        DHRow(-612.0, 0.0, 0.0, np.radians(30.0)),
        DHRow(0.0, np.pi / 2, 160.0, type="prismatic"),
    ]
    q = np.array([0.3, -1.1, 70.0])
    tip = np.linalg.multi_dot([printed(row, x, convention) for row, x in zip(rows, q, strict=True)])
    np.testing.assert_allclose(Model(arm).position(q[None])[0], tip[:3, 3], atol=1e-10)
    assert (arm.lower[2], arm.upper[2], arm.upper[0]) == (-50.0, 150.0, np.pi)
    assert arm.chain.settled == frozenset()


def test_where_a_plane_is(tmp_path: Path) -> None:
    """Its point is at height zero, and so is what lies beside it across the normal."""
    arm = load(
        tmp_path, f'{HEAD}[instrument]\nkind = "plane"\ncenter_mm = [100.0, 20.0, -50.0]\nnormal = [0.0, 3.0, 4.0]\n'
    )
    base = arm.chain.base
    for point, height in (([100, 20, -50], 0.0), ([300, 24, -53], 0.0), ([100, 23, -46], 5.0)):
        assert base[2, :3] @ point + base[2, 3] == pytest.approx(height, abs=1e-9)
    np.testing.assert_allclose(base[:3, :3] @ base[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("head", "lines", "instrument", "base"),
    [
        (HEAD, 'kind = "distance"\ncenter_mm = [700.0, -200.0, 300.0]', Distance(), [-700.0, 200.0, -300.0]),
        (HEAD, 'kind = "sphere"\nradius_mm = 12.5', Sphere(12.5), [0.0, 0.0, 0.0]),
        (HEAD, 'kind = "plane"', Plane(), [0.0, 0.0, 0.0]),
        (LENGTHS, 'kind = "distance"\ncenter_mm = [4.0, 1.0]', PlanarDistance((("1", (4.0, 1.0)),)), [0.0, 0.0, 0.0]),
    ],
)
def test_instruments(tmp_path: Path, head: str, lines: str, instrument: Instrument, base: list[float]) -> None:
    arm = load(tmp_path, f"{head}[instrument]\n{lines}\n")
    assert arm.chain.instrument == instrument
    np.testing.assert_allclose(arm.chain.base[:3, 3], base)
    assert head == LENGTHS or not arm.chain.settled


# -- writing -----------------------------------------------------------------------------------------------------------
def test_calibration_is_replaced_where_it_stands_and_the_rest_stays(tmp_path: Path) -> None:
    found = Calibration.of(readonly([1, 2, 3, 4.5]), np.radians([30.0, 0, 0, -0.1]), provenance={"file": "new.csv"})
    text = FULL.replace("# what was found\n", "").replace("[measurement]\n", "# tracker\n[measurement]\n")
    start, end = text.index("[calibration]"), len(text)
    moved = text[: text.index("# tracker")] + text[start:end] + "\n" + text[text.index("# tracker") : start]
    written = with_effects(moved, calibration=found)
    new = (
        "[calibration]\nlength_errors_mm = [1.0, 2.0, 3.0, 4.5]\njoint_offsets_deg = [30.0, 0.0, 0.0, -0.1]\n\n"
        '[calibration.provenance]\nfile = "new.csv"\n'
    )
    assert written == moved.replace(text[start:end], new)
    assert with_effects(written, calibration=found) == written
    same(found, load(tmp_path, written).calibration)


@pytest.mark.parametrize(
    "text",
    [
        PLAIN + "calibration = {length_errors_mm = [0, 0], joint_offsets_deg = [0, 0]}\n[measurement]\nsigma_mm = 1\n",
        PLAIN + CALIBRATION + "[measurement]\nsigma_mm = 1\n[calibration.provenance]\nfile = 'a'\n",
        "calibration.length_errors_mm = [0, 0]\ncalibration.joint_offsets_deg = [0, 0]\n" + PLAIN,
        "\ufeff" + (PLAIN + CALIBRATION).replace("\n", "\r\n"),
    ],
)
def test_calibration_in_unusual_layouts(tmp_path: Path, text: str) -> None:
    found = Calibration.of(readonly([1, 2]), readonly([0.1, 0.2]), provenance={"file": "b", "fit": {"rms_mm": 0.1}})
    (tmp_path / "arm.toml").write_bytes(with_effects(text, calibration=found).encode())
    same(found, load_arm(tmp_path / "arm.toml").calibration)


def test_provenance_leaves_out_what_toml_cannot_say() -> None:
    provenance = {"p_value": None, "rms": float("nan"), "fit": {"chi2": np.float64(2.0), "rows": (1, 2)}}
    written = with_effects(PLAIN, calibration=Calibration.of(readonly([1, 2]), readonly([0, 0]), provenance=provenance))
    assert tomllib.loads(written)["calibration"]["provenance"] == {"fit": {"chi2": 2.0, "rows": [1, 2]}}


def test_calibrations_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match=r"calibration: unknown parameter 'length_error:3'"):
        with_effects(PLAIN, calibration=Calibration.of(readonly([1, 2, 3]), readonly([0, 0, 0])))
    with pytest.raises(
        InputError, match=r"calibration: found 3 length errors and 2 joint offsets, allowed: one of each"
    ):
        Calibration.of([1, 2, 3], [0, 0])
    with pytest.raises(InputError, match=r"unknown parameter 'base_offset.x0'"):
        with_effects(PLAIN, calibration=Calibration.of(readonly([1, 2]), readonly([0, 0]), {"base_offset.x0": 1.0}))


def test_effects_are_appended_and_comments_stay(tmp_path: Path) -> None:
    specs = [EffectSpec("base_offset"), EffectSpec("backlash", 3), EffectSpec("transmission_ripple", 1, {"k": 6})]
    written = with_effects(FULL, specs)
    added = (
        '\n[[effects]]\nname = "backlash"\njoint = 3\n\n[[effects]]\nname = "transmission_ripple"\njoint = 1\nk = 6\n'
    )
    assert written == FULL.replace("b_deg = -0.01\n", "b_deg = -0.01\n" + added)
    assert [spec.key for spec in load(tmp_path, written).effects][2:] == ["backlash:3", "transmission_ripple:1"]
    assert with_effects(written, specs) == written


@pytest.mark.parametrize("text", [PLAIN, "effects = []\n" + PLAIN, "effects = [{name = 'axes_skew'}]\n" + PLAIN])
def test_effects_in_other_layouts(tmp_path: Path, text: str) -> None:
    spec = EffectSpec("backlash", 2, {"b": 1e-5})
    same(spec, load(tmp_path, with_effects(text, [spec])).effects[-1])


numbers = st.floats(-1e3, 1e3, allow_subnormal=False)
angles = st.floats(-7.0, 7.0, allow_subnormal=False)


@st.composite
def found_of_arms(draw: st.DrawFn) -> tuple[list[float], list[EffectSpec], Calibration]:
    """Lengths of any planar arm, effects and a calibration of it."""
    n = draw(st.integers(1, 4))
    lengths = draw(arrays(float, n, elements=st.floats(1e-3, 1e4)))
    names = [*(f"length_error:{j + 1}" for j in range(n)), *(f"joint_offset:{j + 1}" for j in range(n))]
    effects = [
        EffectSpec("axes_skew", None, draw(st.dictionaries(st.sampled_from("ab"), numbers))),
        EffectSpec("encoder_eccentricity", n, {"a": draw(angles)}),
        EffectSpec("servo_error", n, {"b": draw(angles), "h": draw(angles)}),
        *(EffectSpec("transmission_ripple", n, {"k": k}) for k in draw(st.sets(st.integers(3, 64), min_size=2))),
        EffectSpec("joint_error_curve", n, curve=ErrorCurve(-1.0, 1.5, draw(arrays(float, 9, elements=angles)))),
    ]
    ripples = [f"transmission_ripple:{n}[k={spec.values['k']}].a" for spec in effects[3:-1]]
    names += [f"encoder_eccentricity:{n}.b", *ripples]
    steps = st.integers(-1000, 1000).map(lambda step: 0.01 * step)
    root = draw(arrays(float, (len(names), 2), elements=steps))  # singular: parameters may be tied
    calibration = Calibration.of(
        length_errors=lengths * draw(arrays(float, n, elements=st.floats(-0.9, 10.0))),
        joint_offsets=draw(arrays(float, n, elements=angles)),
        effects={name: draw(angles) for name in names[2 * n :]},
        parameter_names=tuple(names),
        covariance=root @ root.T,
        provenance={"file": draw(st.text(st.characters(codec="utf-8"))), "rms_mm": draw(numbers)},
    )
    return lengths.tolist(), effects, calibration


@given(found_of_arms())
@settings(max_examples=20)
def test_what_is_found_goes_round(found: tuple[list[float], list[EffectSpec], Calibration]) -> None:
    lengths, effects, calibration = found
    again = arm_from_tables(tomllib.loads(with_effects(f"links_mm = {lengths}\n", effects, calibration=calibration)))
    same(tuple(effects), again.effects)
    same(calibration, again.calibration)


def test_a_calibration_in_space_goes_round(tmp_path: Path) -> None:
    """With base, measured points and covariance."""
    arm = load(tmp_path, BY_TABLE + PLACED)
    again = load(tmp_path, with_effects(BY_TABLE, calibration=arm.calibration))
    same(arm.calibration, again.calibration)
    same(arm.chain.base, again.chain.base)
    same(arm.chain.tools, again.chain.tools)


def test_of_a_plane_those_turns_go_round_that_were_fitted(tmp_path: Path) -> None:
    """All but that about the axis of the base which is nearest to the normal: x before the fit, z after it."""
    text, names = f'{HEAD}[instrument]\nkind = "plane"\n', ("base.z", "base.ry", "base.rz")
    after = pose((0.0, 0.0, -400.0), Rotation.from_euler("y", -43.0, degrees=True).as_matrix())
    found = Calibration({"base.z": 2.0, "base.ry": np.radians(3.0), "base.rz": 0.0}, names, np.eye(3), base=after)
    again = load(tmp_path, with_effects(text, calibration=found))
    same(found, again.calibration)
    assert set(names) <= set(Model(again).names)
