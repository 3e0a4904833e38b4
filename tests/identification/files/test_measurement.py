"""Files of measurements, plans and targets (identification/files/README.md): exact round trips, what the order says,
instruments that read no positions, and one line for what cannot be."""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from identification import Arm, DHRow, Measurements, Plan, chain_of, load_measurements
from identification.files.csv import read_table
from identification.files.measurement import angle_columns, load_targets, measurement_text, read_orientations
from identification.gap.library_prior import library_prior
from identification.inspection.readings import gap_notes
from identification.instruments import Distance, PlanarDistance, Plane, Sphere
from identification.kinematics.frames import from_angles
from identification.measurements import pooled_sessions
from tests.refusals import refused

PLAIN = "q1_deg,q2_deg,x_mm,y_mm\n30,-60,1.5,2.5\n90,0,-3,4\n"
SLIDING = "q1_deg,q2_mm,x_mm,y_mm,z_mm,marker\n30,50,1,2,3,top\n-90,7.5,4,5,6,side\n"
SPATIAL = Arm(chain_of([DHRow(300.0, 0.0, 10.0), DHRow(0.0, 0.0, 0.0, type="prismatic", limits=(0.0, 100.0))]))
CHAIN = chain_of([DHRow(300.0, 0.0, 10.0), DHRow(200.0, 1.0, 0.0)])
BAR, BALL, FACE = (Arm(replace(CHAIN, instrument=one)) for one in (Distance(), Sphere(12.5), Plane()))
IN_PLANE = Arm([300.0, 200.0])
IN_PLANE = replace(IN_PLANE, chain=replace(IN_PLANE.chain, instrument=PlanarDistance((("1", (400.0, 100.0)),))))


@pytest.fixture
def load(tmp_path: Path) -> Callable[..., Measurements]:
    """The measurements of a text in a file `data.csv`."""

    def loaded(text: str, arm: int | Arm | None = None) -> Measurements:
        (tmp_path / "data.csv").write_text(text)
        return load_measurements(tmp_path / "data.csv", arm)

    return loaded


Load = Callable[..., Measurements]


def with_columns(**columns: tuple[object, object]) -> str:
    """`PLAIN` with more columns."""
    lines = PLAIN.splitlines()
    for name, (first, second) in columns.items():
        lines = [f"{line},{cell}" for line, cell in zip(lines, (name, first, second), strict=True)]
    return "\n".join(lines) + "\n"


# -- reading -----------------------------------------------------------------------------------------------------------
def test_columns_are_read(load: Load) -> None:
    data = load(PLAIN, 2)
    np.testing.assert_allclose(data.postures, np.radians([[30, -60], [90, 0]]))
    np.testing.assert_array_equal(data.positions, [[1.5, 2.5], [-3, 4]])
    assert data.optional_columns == frozenset()
    assert data.provenance == {"file": "data.csv", "sha256": hashlib.sha256(PLAIN.encode()).hexdigest()}
    optional = {"temperature_C": (20.5, 21), "payload_kg": (0, 5), "posture": (7, 7), "session": ("monday", " 2 ")}
    optional |= {"order": (2, 1), "direction2": (-1, "+1"), "direction1": (1, -1.0), "sigma_mm": (0.1, 0.2)}
    data = load(with_columns(**optional, run=(1, 2)))
    expected = {"order": [2, 1], "temperature": [20.5, 21], "payload": [0, 5], "directions": [[1, -1], [-1, 1]]}
    expected |= {"repeats": [7, 7], "sigma": [0.1, 0.2], "session": ["monday", "2"]}
    assert {name: getattr(data, name).tolist() for name in expected} == expected
    assert load(measurement_text(data)).session.tolist() == ["monday", "2"]


def test_other_units_are_converted(load: Load) -> None:
    data = load("y_m,x_m,q2_rad,q1_deg,sigma_m\n0.25,0.5,1.5,180,0.001\n")
    for read, expected in ((data.postures, [[np.pi, 1.5]]), (data.positions, [[500, 250]]), (data.sigma, [1.0])):
        np.testing.assert_allclose(read, expected)
    assert load("q1_deg,q2_deg,distance_m\n30,50,0.4125\n", BAR).positions[0, 0] == pytest.approx(412.5)
    for more in ({}, {"order": (2, 1)}):  # time is the order
        assert load(with_columns(time_s=(10.5, 2), **more)).order.tolist() == [10.5, 2]


@pytest.mark.parametrize(
    ("arm", "text", "said"),
    [
        (
            None,
            with_columns(temprature_C=(1, 2), operator=("Ann", "")),
            r"data.csv: columns are not used: 'temprature_C' \(did you mean 'temperature_C'\?\), 'operator'$",
        ),
        (BAR, "q1_deg,q2_deg,distance_mm,surface\n1,2,3,top\n", "column is not used: 'surface'"),
        *(
            (
                arm,
                "q1_deg,q2_deg,distance_mm,x_mm,y_mm,z_mm\n30,50,412.5,1,2,3\n",
                rf"'x_mm'.*; \[instrument\] {arm.chain.instrument.kind} of the arm file reads no positions; for a tr",
            )
            for arm in (BAR, BALL, FACE)
        ),
        # a plan has the joints that it asks for: as contacts they fit what it was made with, to rounding
        (BALL, "run,q1_deg,q2_deg\n1,30,50\n2,-90,7\n", "has the column run and no order, like a plan; "),
    ],
)
def test_columns_that_mean_nothing_are_named_once(load: Load, arm: Arm | None, text: str, said: str) -> None:
    with pytest.warns(UserWarning, match=said) as caught:
        load(text, arm)
    assert len(caught) == 1
    load("run,order,q1_deg,q2_deg\n1,1,30,50\n2,2,-90,7\n", BALL)  # warnings are errors


BAD = [  # arm, text, what is named
    *(
        (None, text, parts)
        for text, parts in (
            ("x_mm,y_mm\n1,2\n", ["'q1_deg' is missing"]),
            ("q1,q2,x_mm,y_mm\n1,2,3,4\n", ["'q1_deg' is missing", "did you mean to rename 'q1'?", "allowed"]),
            ("q1_deg,q2_deg,x_mm,y\n1,2,3,4\n", ["'y_mm' is missing", "q2_deg, x_mm, y; did you mean to rename 'y'?"]),
            ("q1_deg,q1_rad,x_mm,y_mm\n1,2,3,4\n", ["both q1_deg and q1_rad", "allowed: one"]),
            (",".join(f"q{j}_deg" for j in range(1, 14)) + "\n" + "0," * 12 + "0\n", ["q13_deg", "q1_deg to q12_deg"]),
            (PLAIN.replace("-3", "1e200"), ["row 2 (line 3), column x_mm", "found '1e200'"]),
            (PLAIN.replace("-60", "1e300"), ["row 1 (line 2), column q2_deg", "found '1e300'"]),
            (with_columns(payload_kg=(0, -1)), ["row 2 (line 3), column payload_kg", "found '-1'", "a number >= 0"]),
            (with_columns(sigma_mm=(0.1, 0)), ["row 2 (line 3), column sigma_mm", "found '0'", "a number > 0"]),
            (with_columns(temperature_C=(-300, 0)), ["column temperature_C", "found '-300'", "a number >= -273.15"]),
            (with_columns(direction1=(1, 1), direction2=(1, 0)), ["row 2 (line 3), column direction2", "'0'", "+1 or"]),
            (with_columns(direction1=(1, 1)), ["'direction2' is missing", "direction1; allowed: a column"]),
            (with_columns(commanded1_deg=(1, 1)), ["'commanded2_deg' is missing"]),
            (
                with_columns(direction1=(1, 1), direction2=(1, 1), direction3=(1, 1)),
                ["direction3", "allowed: direction1 to direction2"],
            ),
            (with_columns(posture=(1, 1.5)), ["row 2 (line 3), column posture", "found '1.5'", "a whole number"]),
            (with_columns(order=(1, 2), time_s=(5, 4)), ["column time_s", "different orders", "allowed"]),
        )
    ),
    *(
        (SPATIAL, SLIDING.replace(old, new), [part])
        for old, new, part in (
            ("q2_mm", "q2_deg", "column 'q2_mm' is missing"),
            ("marker", "q3_deg", "found column q3_deg, allowed: q1_deg to q2_mm"),
            ("marker", "q2_m", "found both q2_mm and q2_m, allowed: one of them"),
            ("side", "", "row 2 (line 3), column marker: found an empty cell, allowed: a name"),
        )
    ),
    (BAR, "q1_deg,q2_deg,distance_mm\n1,2,-3\n", ["(line 2), column distance_mm: found '-3', allowed: a number > 0"]),
    (FACE, "q1_deg,q2_deg,surface\n1,2,\n", ["column surface: found an empty cell, allowed: a name"]),
]


@pytest.mark.parametrize(("arm", "text", "parts"), BAD, ids=[" ".join(parts)[:50] for *_, parts in BAD])
def test_bad_input_gets_one_line(load: Load, arm: Arm | None, text: str, parts: list[str]) -> None:
    refused(load, text, arm, names=["data.csv: ", *parts])


def test_a_cell_that_cannot_be_names_row_line_and_column(load: Load) -> None:
    """A word where a number belongs, nothing where something does; a direction may be unknown."""
    pairs = dict.fromkeys(("temperature_C", "payload_kg", "posture", "session", "sigma_mm"), (1, 2))
    text = with_columns(order=(1, 2), time_s=(0, 9), direction1=(1, -1), direction2=(1, 1), **pairs)
    header, first, second = (line.split(",") for line in text.splitlines())
    for place, column in enumerate(header):
        for wrong, shown in (("left", "found 'left'"), ("inf", "found 'inf'"), ("", "found an empty cell")):
            if not (column == "session" and wrong) and not (column.startswith("direction") and not wrong):
                cells = [*second[:place], wrong, *second[place + 1 :]]
                spoilt = "\n".join(",".join(row) for row in (header, first, cells)) + "\n"
                refused(load, spoilt, names=[f"data.csv: row 2 (line 3), column {column}: {shown}, allowed: "])


# -- writing -----------------------------------------------------------------------------------------------------------
def test_text_is_tidy() -> None:
    data = Measurements(np.radians([[30.0, -0.0]]), [[1.5, 2]], order=[3], directions=[[1, -1]], sigma=[0.1])
    header = "q1_deg,q2_deg,x_mm,y_mm,order,direction1,direction2,sigma_mm"
    assert measurement_text(data) == f"{header}\n30.0,0.0,1.5,2.0,3,1,-1,0.1\n"


numbers = st.floats(-1e6, 1e6)


@st.composite
def measured(draw: st.DrawFn) -> Measurements:
    """Any measurements that a file can hold."""
    m, n = draw(st.integers(1, 5)), draw(st.integers(1, 3))

    def maybe(elements: st.SearchStrategy, *shape: int, dtype: type = float):
        return draw(st.none() | arrays(dtype, (m, *shape), elements=elements))

    return Measurements(
        postures=draw(arrays(float, (m, n), elements=st.floats(-10, 10))),
        positions=draw(arrays(float, (m, 2), elements=numbers)),
        order=maybe(numbers),
        payload=maybe(st.floats(0, 1e3)),
        temperature=maybe(st.floats(-200, 1e3)),
        directions=maybe(st.sampled_from([-1.0, 1.0]), n),
        commanded=maybe(st.floats(-10, 10), n),
        sigma=maybe(st.floats(1e-9, 10)),
        repeats=maybe(st.integers(-100, 2**52), dtype=np.int64),
        session=draw(st.none() | st.lists(st.sampled_from(["monday", "2", "a b"]), min_size=m, max_size=m)),
    )


def assert_same(again: Measurements, data: Measurements) -> None:
    assert again.optional_columns == data.optional_columns
    for name in ("postures", *data.optional_columns & {"commanded"}):
        np.testing.assert_allclose(getattr(again, name), getattr(data, name), rtol=0, atol=1e-13)
    for name in ("positions", *data.optional_columns - {"commanded"}):
        np.testing.assert_array_equal(getattr(again, name), getattr(data, name))


@given(measured())
@settings(max_examples=20)
def test_files_go_round(tmp_path_factory: pytest.TempPathFactory, data: Measurements) -> None:
    path = tmp_path_factory.mktemp("data") / "data.csv"
    path.write_text(measurement_text(data))
    assert_same(load_measurements(path, data.links), data)


# -- arms in space, plans, targets -------------------------------------------------------------------------------------
def test_positions_of_markers(load: Load) -> None:
    data = load(SLIDING, SPATIAL)
    np.testing.assert_allclose(data.postures, [[np.pi / 6.0, 50.0], [-np.pi / 2.0, 7.5]])
    np.testing.assert_array_equal(data.positions, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    assert data.marker_names == ("top", "side")
    assert_same(load(measurement_text(data, SPATIAL.joint_types), SPATIAL), data)


def test_plans_and_targets(tmp_path: Path) -> None:
    path, plan = tmp_path / "plan.csv", Plan([[0.5, 50.0], [-0.5, 20.0]], joint_types=SPATIAL.joint_types)
    path.write_text(text := plan.text())
    assert text.startswith("run,q1_deg,q2_mm\n")
    np.testing.assert_allclose(Plan.load(path, SPATIAL.joint_types).postures, plan.postures)
    positions = np.array([[1.0, 2.0, 3.0]])
    with_posture = "q1_deg,q2_mm,x_mm,y_mm,z_mm,run\n28,50,1,2,3,1\n"
    for content, postures in ((with_posture, True), ("x_m,y_m,z_mm\n0.001,0.002,3\n", False)):
        path.write_text(content)
        found = load_targets(path, SPATIAL)
        np.testing.assert_allclose(found["targets"], positions)
        assert (found["postures"] is not None) is postures


@pytest.mark.parametrize("read", [Plan.load, lambda path: load_targets(path, IN_PLANE)])
def test_degrees_of_plans_that_look_like_radians_are_doubted(tmp_path: Path, read: Callable[[Path], object]) -> None:
    path, within = tmp_path / "plan.csv", "\n3.14,-1.57\n0.5,2\n-2.9,0\n"
    for unit, more in (("deg", "90,0\n"), ("rad", "0.1,0.2\n"), ("deg", "")):  # a few may be near the drawing's zero
        path.write_text(f"q1_{unit},q2_{unit}{within}{more}")
        read(path)  # warnings are errors
    path.write_text(f"q1_deg,q2_deg{within}0.1,0.2\n")
    with pytest.warns(
        UserWarning, match=r"plan.csv: all joint angles are within 6.3 deg and look like radians; name s"
    ):
        read(path)


# -- orientations ------------------------------------------------------------------------------------------------------
ANGLES = np.array([[10.0, -20.0, 30.0], [0.0, 45.0, 170.0]])


def test_orientations(tmp_path: Path) -> None:
    """By angles about own axes, and of a quarter turn about z by a quaternion, to three digits as some trackers do."""

    def read(header: str, *rows: str) -> np.ndarray | None:
        (tmp_path / "data.csv").write_text("\n".join([header, *rows]) + "\n")
        return read_orientations(read_table(tmp_path / "data.csv"))

    for unit, values in (("deg", ANGLES), ("rad", np.radians(ANGLES))):
        found = read(f"rx_{unit},ry_{unit},rz_{unit}", *(",".join(map(repr, row)) for row in values.tolist()))
        np.testing.assert_allclose(found, [from_angles(row) for row in np.radians(ANGLES)], atol=1e-14)
        np.testing.assert_allclose(np.column_stack([*angle_columns(found).values()]), ANGLES, atol=1e-11)
    found = read("qw,qx,qy,qz", "0.707,0,0,0.707")
    np.testing.assert_allclose(found, [[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]], atol=1e-12)
    assert read("x_mm", "1") is None
    for header, row, message in (
        ("rx_deg,ry_deg", "1,2", "column 'rz_deg' is missing"),
        ("rx_deg,ry_rad,rz_deg", "1,2,3", "found rx_deg, ry_rad, rz_deg, allowed: three angles of one unit"),
        ("rx_deg,ry_deg,rz_deg,qw", "1,2,3,1", "allowed: three angles of one unit, or a quaternion"),
        ("qw,qx,qy", "1,0,0", "column 'qz' is missing"),
        ("qw,qx,qy,qz", "2,0,0,0", "row 1 (line 2), column qw..qz: found a quaternion of length 2, allowed: length 1"),
        ("rx_deg,ry_deg,rz_deg", "1,,3", "row 1 (line 2), column ry_deg: found an empty cell, allowed: a finite angle"),
    ):
        refused(read, header, row, names=[message])


# -- instruments that read no positions --------------------------------------------------------------------------------
@pytest.mark.parametrize("arm", [BAR, IN_PLANE], ids=["in space", "in the plane"])
def test_distances(load: Load, arm: Arm) -> None:
    data = load("q1_deg,q2_deg,distance_mm,session\n30,50,412.5,a\n-90,7,300,b\n", arm)
    np.testing.assert_array_equal(data.positions, [[412.5], [300.0]])
    assert data.sessions == ("a", "b")
    assert (
        replace(load(measurement_text(data, instrument=arm.chain.instrument), arm), provenance=data.provenance) == data
    )


@pytest.mark.parametrize("arm", [BALL, FACE], ids=["sphere", "plane"])
def test_contacts(load: Load, arm: Arm) -> None:
    """Joints alone; every surface is a session of its own, but for where joints come from."""
    data = load("q1_deg,q2_deg,surface\n30,50,left\n-90,7,top\n", arm)
    np.testing.assert_array_equal(data.conditions.directions, [[1.0, 1.0], [-1.0, -1.0]])
    np.testing.assert_array_equal(data.positions, [[0.0], [0.0]])
    assert data.sessions == ("left", "top")
    assert load("q1_deg,q2_deg,surface,session\n30,50,left,mon\n", arm).sessions == ("mon/left",)
    assert load("q1_deg,q2_deg\n30,50\n", arm).session is None


# -- rows struck out of a file -----------------------------------------------------------------------------------------
M = 30
Q = np.random.default_rng(41).integers(-4, 5, (M, 3)) * 0.25  # few values, so that joints often rest
WHOLE = Measurements(Q, np.zeros((M, 2)), order=np.arange(1.0, M + 1.0))
OUT = [4, 5, 11, 20]


def struck(load: Load, out: list[int] = OUT) -> Measurements:
    """Without some rows, as a user strikes them out of a file."""
    return load("\n".join(line for k, line in enumerate(measurement_text(WHOLE).splitlines()) if k - 1 not in out))


def test_after_a_gap_directions_are_unknown_and_joints_remember_anew(load: Load) -> None:
    """Sign of each joint's last motion as far as rows that follow each other show it, row after row."""
    assert WHOLE.gaps is None
    data = struck(load)
    assert (np.flatnonzero(data.gaps) + 1).tolist() == [5, 10, 18]  # rows 7, 13 and 22 of the whole
    signs = np.ones((M, 3))
    for k in range(1, M):
        step = np.sign(Q[k] - Q[k - 1])
        signs[k] = 0.0 if k - 1 in OUT else np.where(step != 0.0, step, signs[k - 1])
    found = data.conditions.directions
    np.testing.assert_array_equal(found, np.delete(signs, OUT, axis=0))
    moved = found != 0.0
    assert moved.mean() > 0.8
    np.testing.assert_array_equal(found[moved], np.delete(WHOLE.conditions.directions, OUT, axis=0)[moved])
    past, later = np.asarray(data.conditions.past), data.rows(slice(17, None))
    np.testing.assert_array_equal(past[17:], replace(later, directions=None, past=None).conditions.past)
    np.testing.assert_array_equal(past[17], np.repeat(data.postures[17][:, None], past.shape[2], axis=1))


def test_files_with_gaps_go_round(load: Load) -> None:
    data = struck(load)
    assert "time_s" not in measurement_text(data)
    np.testing.assert_array_equal(load(measurement_text(data)).conditions.directions, data.conditions.directions)
    some = data.rows([3, 5, 9])  # with directions of their own, unknown ones among them
    np.testing.assert_array_equal(load(measurement_text(some)).conditions.directions, some.conditions.directions)
    assert 0.0 in some.conditions.directions
    assert struck(load, [*range(1, M, 2)]).gaps.tolist() == [0.0, *[1.0] * 14]  # of every second row
    stamps = replace(WHOLE, order=np.arange(M) + 30.0 * (np.arange(M) // 3))  # whole seconds, of reads by threes
    assert load(measurement_text(stamps)).gaps is None


def test_gaps_are_those_of_each_session(load: Load) -> None:
    """Each session counts on where another stopped, or from its own beginning: neither is a gap."""
    two = replace(WHOLE, session=np.array(["b"] * 12 + ["a"] * 18))
    for order in (two.order, np.r_[np.arange(12.0), np.arange(18.0)]):
        assert load(measurement_text(replace(two, order=order))).gaps is None
    together = pooled_sessions({"whole": WHOLE, "struck": struck(load)})
    assert (np.flatnonzero(together.gaps) + 1).tolist() == [M + 5, M + 10, M + 18]


def test_effects_that_need_the_row_before_are_not_looked_for_without_it() -> None:
    thinned = replace(WHOLE.rows(slice(None, None, 2)), directions=None, past=None, gaps=np.r_[0.0, np.ones(14)])
    assert not thinned.conditions.follow
    arm, names = Arm([300.0, 200.0, 100.0]), ["backlash", "joint_hysteresis", "gear_ratio"]
    assert not library_prior(arm, WHOLE, names).left_out
    assert {spec.name for spec in library_prior(arm, thinned, names).added} == {"gear_ratio"}
    (note,) = gap_notes(thinned)
    assert note.startswith("column order: numbers are missing before 14 of 15 rows")
    assert gap_notes(WHOLE) == []
    directions = np.ones((M, 3))
    directions[4:, 1] = np.nan
    (note,) = gap_notes(replace(WHOLE, directions=directions))
    assert note.startswith(f"unknown approach directions: joint 2 in {M - 4} of {M} rows")


def test_a_file_may_say_that_a_direction_is_unknown(load: Load) -> None:
    assert load("q1_deg,x_mm,y_mm,direction1\n1,2,3,\n4,5,6,-1\n").conditions.directions.tolist() == [[0.0], [-1.0]]
