"""Arm files (identification/files/README.md, "Arm file"): exact round trips, comments kept, bad input in one line."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from identification.arm import Arm, Calibration, EffectSpec, Gravity
from identification.arrays import readonly
from identification.errors import InputError
from identification.files.arm import arm_from_tables, dump_arm, load_arm, with_calibration, with_effects
from identification.workspace import KeepOutCircle, LineOfSight, WorkspaceBox

FULL = """\
# the arm in the cellar
name = "paper-4-link"
links_mm = [260.0, 180.0, 120.0, 100.0]  # measured by Ann

[joint_limits_deg]
lower = [-180.0, -120.0, -100.0, -90.0]
upper = [ 180.0,  120.0,   60.0,  90.0]

[measurement]
sigma_mm = 0.1

[gravity]                               # it hangs
acceleration_m_s2 = [0.0, -9.81]
link_masses_kg = [12.0, 8.0, 5.0, 3.0]
center_of_mass = [0.5, 0.4, 0.5, 0.5]
payload_kg = 10.0

[[constraints]]
kind = "workspace_box"
x_mm = [-400.0, 600.0]
y_mm = [0.0, 650.0]

[[constraints]]
kind = "keep_out_circle"
center_mm = [350.0, 200.0]
radius_mm = 60.0

[[constraints]]
kind = "line_of_sight"
tracker_mm = [1500.0, 300.0]
half_angle_deg = 25.0
toward_mm = [0.0, 200.0]

[[effects]]
name = "base_offset"

[[effects]]
name = "encoder_eccentricity"
joint = 2
a_deg = 0.03
b_deg = -0.01

# what was found
[calibration]
length_errors_mm = [1.5, -0.6, -0.4, 0.7]
joint_offsets_deg = [0.5, -0.5, 0.7, -0.3]
parameters = ["length_error:1", "joint_offset:2", "base_offset.x0_mm"]
covariance = [[1.0, 0.5, 0.0], [0.5, 4.0, 0.0], [0.0, 0.0, 9.0]]

[calibration.effects]
"base_offset.x0_mm" = 2.5

[calibration.provenance]
file = "data.csv"
rms_after_mm = 0.1
"""
PLAIN = "links_mm = [260.0, 180.0]\n"
PLANAR = PLAIN + "[gravity]\nacceleration_m_s2 = [0, -9.81]\nlink_masses_kg = [1, 1]\n"


def load(tmp_path: Path, text: str) -> Arm:
    (tmp_path / "arm.toml").write_text(text)
    return load_arm(tmp_path / "arm.toml")


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
        np.testing.assert_allclose(b, a, rtol=1e-12, atol=1e-14)
    else:
        assert a == b


# -- reading -----------------------------------------------------------------------------------------------------------
def test_every_documented_key_is_read(tmp_path: Path) -> None:
    arm = load(tmp_path, FULL)
    degree = np.pi / 180.0
    expected = Arm(
        chain=[260.0, 180.0, 120.0, 100.0],
        lower=degree * np.array([-180.0, -120.0, -100.0, -90.0]),
        upper=degree * np.array([180.0, 120.0, 60.0, 90.0]),
        sigma=0.1,
        name="paper-4-link",
        gravity=Gravity(readonly([0, -9.81]), readonly([12, 8, 5, 3]), readonly([0.5, 0.4, 0.5, 0.5]), 10.0),
        constraints=(
            WorkspaceBox((-400.0, 600.0), (0.0, 650.0)),
            KeepOutCircle((350.0, 200.0), 60.0),
            LineOfSight((1500.0, 300.0), 25.0 * degree, (0.0, 200.0)),
        ),
        effects=(
            EffectSpec("base_offset"),
            EffectSpec("encoder_eccentricity", 2, {"a": 0.03 * degree, "b": -0.01 * degree}),
        ),
        calibration=Calibration.of(
            length_errors=readonly([1.5, -0.6, -0.4, 0.7]),
            joint_offsets=degree * np.array([0.5, -0.5, 0.7, -0.3]),
            effects={"base_offset.x0": 2.5},
            parameter_names=("length_error:1", "joint_offset:2", "base_offset.x0"),
            covariance=np.array([[1, 0.5 * degree, 0], [0.5 * degree, 4 * degree**2, 0], [0, 0, 9]]),
            provenance={"file": "data.csv", "rms_after_mm": 0.1},
        ),
    )
    same(expected, arm)


def test_what_is_left_out_has_its_default(tmp_path: Path) -> None:
    same(Arm([260.0, 180.0]), load(tmp_path, PLAIN))
    gravity = load(tmp_path, PLANAR).gravity
    assert (gravity.center_of_mass.tolist(), gravity.payload) == ([0.5, 0.5], 0.0)


def test_limits_that_look_like_radians_warn(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"arm.toml: joint_limits_deg: .* look like radians; write them in degrees"):
        load(tmp_path, PLAIN + "[joint_limits_deg]\nlower = [-3.14, -2]\nupper = [3.14, 6.2832]\n")


# -- bad input ---------------------------------------------------------------------------------------------------------
def refused(path: Path, *named: str) -> None:
    """In one line that begins with the file and names all of this."""
    with pytest.raises(InputError) as caught:
        load_arm(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    assert [part for part in named if part not in message] == [], message


LIMITS = PLAIN + "[joint_limits_deg]\n"
SIGHT = PLAIN + '[[constraints]]\nkind = "line_of_sight"\ntracker_mm = [1, 0]\n'
BASE = '[[effects]]\nname = "base_offset"\n'
BACKLASH = PLAIN + '[[effects]]\nname = "backlash"\n'
CALIBRATION = "[calibration]\nlength_errors_mm = [0, 0]\njoint_offsets_deg = [0, 0]\n"
TWO = CALIBRATION + 'parameters = ["length_error:1", "joint_offset:2"]\n'
THREE = (
    TWO.replace('", "', '", "length_error:2", "') + "covariance = [[1, -0.6, -0.6], [-0.6, 1, -0.6], [-0.6, -0.6, 1]]"
)
ORIGIN = PLAIN + CALIBRATION + "[calibration.provenance]\n"
BAD = [  # values that are of the right type
    # keys that stand elsewhere, or have another name
    ("sigma_mm = 0.1\n" + PLAIN, "[measurement]"),
    ("lengths_mm = [1.0]\n" + PLAIN, "'links_mm'"),
    ("description = 'x'\n" + PLAIN, "description: "),
    (PLAIN + "[base]", "spatial"),
    (PLAIN + "[limits]", "'joint_limits_deg'"),
    (LIMITS + "min = [0, 0]\nupper = [90, 90]", "'lower'"),
    (PLANAR.replace("acceleration_m_s2", "g"), "'acceleration_m_s2'"),
    (LIMITS + "lower = [0, 0]\nupper = [90, -90]", "joint 2"),
    (PLAIN + "[joints]\nsign = [1, 0]", "joints.sign: found 0 for joint 2"),
    (PLAIN + "[joints]\ncoupled_to = [2, 1]", "joints.coupled_to: found"),
    (PLAIN + '[[constraints]]\nkind = "box"', "constraints[1].kind: found 'box'"),
    (
        PLAIN + '[[constraints]]\nkind = "workspace_box"\nx_mm = [1, 0]\ny_mm = [0, 1]',
        "constraints[1].x_mm: found [1, 0]",
    ),
    (SIGHT + "half_angle_deg = 20\ntoward_mm = [1, 0]", "constraints[1].toward_mm: found [1.0, 0.0]"),
    (BACKLASH, "backlash needs a joint"),
    (PLAIN + BASE + BASE, "base_offset"),
    (PLAIN + '[[effects]]\nname = "transmission_ripple"\njoint = 1\nk = 0', "transmission_ripple:1"),
    (PLAIN + '[[effects]]\nname = "gravity_backlash"\njoint = 1\nb_deg = -1', "effects[1].b_deg: found -1"),
    (PLAIN + CALIBRATION.replace("[0, 0]", "[0, -180]", 1), "calibration.length_errors_mm: found -180"),
    (PLAIN + CALIBRATION + "covariance = [[1]]", "calibration.parameters: is missing"),
    (PLAIN + TWO + "covariance = [[1, 0]]", "calibration.covariance: found 1 rows"),
    (PLAIN + TWO + "covariance = [[1], [2]]", "calibration.covariance: found 1 values"),
    (PLAIN + TWO + "covariance = [[1, 0], [0, -2]]", "found -2 and -2 of joint_offset:2"),
    (PLAIN + TWO + "covariance = [[4, 1], [0, 1]]", "found 1 and 0 of length_error:1"),
    (PLAIN + TWO + "covariance = [[1, 2], [2, 1]]", "found 2 and 2 of length_error:1"),
    (PLAIN + TWO + "covariance = [[1, 1], [1, 0]]", "found 1 and 1 of length_error:1"),
    # correlations -0.6 of each two of three: the sum has variance 3 - 6 * 0.6 = -0.6, a third of it per unit vector
    (PLAIN + THREE, "eigenvalue -0.2"),
    (PLAIN + CALIBRATION + 'parameters = ["lenght_error:1"]', "'length_error:1'"),
    (PLAIN + CALIBRATION + '[calibration.effects]\n"base_offset.x0_mm" = 1', "'base_offset.x0_mm'"),
    (PLAIN + BASE + CALIBRATION + '[calibration.effects]\n"base_offset.x0" = 1', "'base_offset.x0_mm'"),
    # of what is kept of a fit, what the program itself reads again
    (f"{ORIGIN}rows = 0", "rows: found 0"),
    (ORIGIN + "joint_range_deg = [[0.0, 90.0], [90.0, -90.0]]", "joint_range_deg[2]: found [90.0, -90.0]"),
    (ORIGIN + "joint_range_mm = [[nan, 1.0]]", "joint_range_mm[1]: found [nan, 1.0]"),
]


@pytest.mark.parametrize(("text", "named"), BAD, ids=[named[:50] for _, named in BAD])
def test_bad_input_gets_one_line(tmp_path: Path, text: str, named: str) -> None:
    (tmp_path / "arm.toml").write_text(text)
    refused(tmp_path / "arm.toml", named)


# -- writing -----------------------------------------------------------------------------------------------------------
def test_calibration_is_replaced_where_it_stands_and_the_rest_stays(tmp_path: Path) -> None:
    found = Calibration.of(readonly([1, 2, 3, 4.5]), np.radians([30.0, 0, 0, -0.1]), provenance={"file": "new.csv"})
    text = FULL.replace("# what was found\n", "").replace("[measurement]\n", "# tracker\n[measurement]\n")
    start, end = text.index("[calibration]"), len(text)
    moved = text[: text.index("# tracker")] + text[start:end] + "\n" + text[text.index("# tracker") : start]
    written = with_calibration(moved, found)
    new = (
        "[calibration]\nlength_errors_mm = [1.0, 2.0, 3.0, 4.5]\njoint_offsets_deg = [30.0, 0.0, 0.0, -0.1]\n\n"
        '[calibration.provenance]\nfile = "new.csv"\n'
    )
    assert written == moved.replace(text[start:end], new)
    assert with_calibration(written, found) == written
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
    (tmp_path / "arm.toml").write_bytes(with_calibration(text, found).encode())
    same(found, load_arm(tmp_path / "arm.toml").calibration)


def test_provenance_leaves_out_what_toml_cannot_say() -> None:
    provenance = {"p_value": None, "rms": float("nan"), "fit": {"chi2": np.float64(2.0), "rows": (1, 2)}}
    written = with_calibration(PLAIN, Calibration.of(readonly([1, 2]), readonly([0, 0]), provenance=provenance))
    assert tomllib.loads(written)["calibration"]["provenance"] == {"fit": {"chi2": 2.0, "rows": [1, 2]}}


def test_calibrations_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match=r"length_errors_mm: found 3 values for 2 joints"):
        with_calibration(PLAIN, Calibration.of(readonly([1, 2, 3]), readonly([0, 0, 0])))
    with pytest.raises(
        InputError, match=r"calibration: found 3 length errors and 2 joint offsets, allowed: one of each"
    ):
        Calibration.of([1, 2, 3], [0, 0])
    with pytest.raises(InputError, match=r"unknown parameter 'base_offset.x0'"):
        with_calibration(PLAIN, Calibration.of(readonly([1, 2]), readonly([0, 0]), {"base_offset.x0": 1.0}))


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
def arms(draw: st.DrawFn) -> Arm:
    """Any arm that a file can describe."""
    n = draw(st.integers(1, 4))
    lengths = draw(arrays(float, n, elements=st.floats(1e-3, 1e4)))
    lower = draw(arrays(float, n, elements=angles))
    names = [*(f"length_error:{j + 1}" for j in range(n)), *(f"joint_offset:{j + 1}" for j in range(n))]
    effects = (
        EffectSpec("axes_skew", None, draw(st.dictionaries(st.sampled_from("ab"), numbers))),
        EffectSpec("encoder_eccentricity", n, {"a": draw(angles)}),
    )
    names.append(f"encoder_eccentricity:{n}.b")
    steps = st.integers(-1000, 1000).map(lambda step: 0.01 * step)
    root = draw(arrays(float, (2 * n + 1, 2), elements=steps))  # singular: parameters may be tied
    calibration = Calibration.of(
        length_errors=lengths * draw(arrays(float, n, elements=st.floats(-0.9, 10.0))),
        joint_offsets=draw(arrays(float, n, elements=angles)),
        effects={f"encoder_eccentricity:{n}.b": draw(angles)},
        parameter_names=tuple(names),
        covariance=root @ root.T,
        provenance={"file": draw(st.text(st.characters(codec="utf-8"))), "rms_mm": draw(numbers)},
    )
    masses, center = (draw(arrays(float, n, elements=st.floats(0, 1))) for _ in range(2))
    return Arm(
        chain=lengths,
        lower=lower,
        upper=lower + draw(arrays(float, n, elements=st.floats(0.1, 7.0))),
        sigma=draw(st.none() | st.floats(1e-6, 10)),
        name=draw(st.text(st.characters(codec="utf-8"))),
        gravity=draw(st.none() | st.just(Gravity(readonly([0.1, -9.81]), masses, center, 1.0))),
        constraints=(LineOfSight((draw(numbers), 2e3), draw(st.floats(1e-3, 3.0)), (draw(numbers), 0.0)),),
        effects=effects,
        calibration=draw(st.none() | st.just(calibration)),
    )


def test_a_rounded_covariance_is_read(tmp_path: Path) -> None:
    text = PLAIN + TWO + "covariance = [[0.333333, 0.577350], [0.577351, 1.0]]\n"  # of 1/3 and 1, correlation 1
    assert load(tmp_path, text).calibration.covariance.shape == (2, 2)


@given(arms())
@settings(max_examples=20)
def test_round_trip(arm: Arm) -> None:
    same(arm, arm_from_tables(tomllib.loads(dump_arm(arm))))


def test_numbers_are_tidy_as_a_person_writes_them(tmp_path: Path) -> None:
    assert "upper = [180.0, 120.0, 60.0, 90.0]" in dump_arm(load(tmp_path, FULL))
