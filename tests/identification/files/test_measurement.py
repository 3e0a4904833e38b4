"""Measurement files (identification/files/README.md, "Measurement file"): exact round trips, contradicted units."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from identification.arm import Arm
from identification.errors import InputError
from identification.files.measurement import measurement_text
from identification.inspection.readings import data_warnings
from identification.measurements import Measurements, load_measurements

UR10 = Path(__file__).parents[4] / "shared/data/ur10_planar/measurements.csv"
PLAIN = "q1_deg,q2_deg,x_mm,y_mm\n30,-60,1.5,2.5\n90,0,-3,4\n"


def load(tmp_path: Path, text: str, links: int | None = None) -> Measurements:
    (tmp_path / "data.csv").write_text(text)
    return load_measurements(tmp_path / "data.csv", links)


def with_columns(**columns: tuple[object, object]) -> str:
    """`PLAIN` with more columns."""
    lines = PLAIN.splitlines()
    for name, (first, second) in columns.items():
        lines = [f"{line},{cell}" for line, cell in zip(lines, (name, first, second), strict=True)]
    return "\n".join(lines) + "\n"


# -- reading -----------------------------------------------------------------------------------------------------------
def test_required_columns(tmp_path: Path) -> None:
    data = load(tmp_path, PLAIN, links=2)
    np.testing.assert_allclose(data.postures, np.radians([[30, -60], [90, 0]]))
    np.testing.assert_array_equal(data.positions, [[1.5, 2.5], [-3, 4]])
    assert data.optional_columns == frozenset()
    assert data.provenance == {"file": "data.csv", "sha256": hashlib.sha256(PLAIN.encode()).hexdigest()}


def test_optional_columns(tmp_path: Path) -> None:
    text = with_columns(
        order=(2, 1),
        temperature_C=(20.5, 21),
        payload_kg=(0, 5),
        direction2=(-1, "+1"),
        direction1=(1, -1.0),
        posture=(7, 7),
        session=("monday", " 2 "),
        sigma_mm=(0.1, 0.2),
        run=(1, 2),
    )
    data = load(tmp_path, text)
    assert data.order.tolist() == [2, 1]
    assert data.temperature.tolist() == [20.5, 21]
    assert data.payload.tolist() == [0, 5]
    assert data.directions.tolist() == [[1, -1], [-1, 1]]
    assert data.repeats.tolist() == [7, 7]
    assert data.repeats.dtype == np.int64
    assert data.sigma.tolist() == [0.1, 0.2]
    assert data.session.tolist() == ["monday", "2"]
    (tmp_path / "again.csv").write_text(measurement_text(data))
    assert load_measurements(tmp_path / "again.csv").session.tolist() == ["monday", "2"]


def test_radians_and_metres_are_converted(tmp_path: Path) -> None:
    data = load(tmp_path, "y_m,x_m,q2_rad,q1_deg,sigma_m\n0.25,0.5,1.5,180,0.001\n")
    np.testing.assert_allclose(data.postures, [[np.pi, 1.5]])
    np.testing.assert_allclose(data.positions, [[500, 250]])
    np.testing.assert_allclose(data.sigma, [1.0])


def test_time_is_the_order(tmp_path: Path) -> None:
    assert load(tmp_path, with_columns(time_s=(10.5, 2))).order.tolist() == [10.5, 2]
    assert load(tmp_path, with_columns(order=(2, 1), time_s=(10.5, 2))).order.tolist() == [10.5, 2]


def test_unknown_columns_are_named_once(tmp_path: Path) -> None:
    text = with_columns(temprature_C=(1, 2), operator=("Ann", ""))
    with pytest.warns(UserWarning, match="not used") as caught:
        assert load(tmp_path, text).optional_columns == frozenset()
    message = str(caught[0].message)
    assert len(caught) == 1
    assert "data.csv: columns are not used: 'temprature_C' (did you mean 'temperature_C'?), 'operator'" in message


BAD = [
    ("q1_deg,q2_deg,x_mm,y_mm\n", ["no rows"]),
    ("x_mm,y_mm\n1,2\n", ["'q1_deg' is missing"]),
    ("q1,q2,x_mm,y_mm\n1,2,3,4\n", ["'q1_deg' is missing", "did you mean to rename 'q1'?", "allowed"]),
    ("q1_deg,q3_deg,x_mm,y_mm\n1,2,3,4\n", ["'q2_deg' is missing"]),
    ("q1_deg,q2_deg,x_mm,y\n1,2,3,4\n", ["'y_mm' is missing", "q2_deg, x_mm, y; did you mean to rename 'y'? allowed"]),
    ("q1_deg,q1_rad,x_mm,y_mm\n1,2,3,4\n", ["both q1_deg and q1_rad", "allowed: one"]),
    ("q1_deg,x_m,x_mm,y_mm\n1,2,3,4\n", ["both x_mm and x_m", "allowed: one"]),
    (with_columns(sigma_mm=(1, 1), sigma_m=(1, 1)), ["both sigma_mm and sigma_m", "allowed: one"]),
    (",".join(f"q{j}_deg" for j in range(1, 14)) + "\n" + "0," * 12 + "0\n", ["q13_deg", "allowed: q1_deg to q12_deg"]),
    (PLAIN.replace("-3", "nan"), ["row 2 (line 3), column x_mm", "found 'nan'", "allowed: a finite length"]),
    (with_columns(payload_kg=(0, -1)), ["row 2 (line 3), column payload_kg", "found '-1'", "allowed: a number >= 0"]),
    (with_columns(sigma_mm=(0.1, 0)), ["row 2 (line 3), column sigma_mm", "found '0'", "allowed: a number > 0"]),
    (with_columns(temperature_C=(-300, 0)), ["column temperature_C", "found '-300'", "allowed: a number >= -273.15"]),
    (with_columns(direction1=(1, 1), direction2=(1, 0)), ["row 2 (line 3), column direction2", "'0'", "+1 or -1"]),
    (
        with_columns(direction1=(1, 1)),
        ["'direction2' is missing", "direction1; allowed: a column of that name"],
    ),
    (
        with_columns(direction1=(1, 1), direction2=(1, 1), direction3=(1, 1)),
        ["direction3", "allowed: direction1 to direction2"],
    ),
    ("PK\x03\x04\x14", ["found a spreadsheet", "save it as CSV"]),
    (with_columns(posture=(1, 1.5)), ["row 2 (line 3), column posture", "found '1.5'", "allowed: a whole number"]),
    (with_columns(order=(1, 2), time_s=(5, 4)), ["column time_s", "different orders", "allowed"]),
]


@pytest.mark.parametrize(("text", "parts"), BAD, ids=[" ".join(parts)[:50] for _, parts in BAD])
def test_bad_input_gets_one_line(tmp_path: Path, text: str, parts: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert "\n" not in message
    missing = [part for part in ["data.csv: ", *parts] if part not in message]
    assert not missing, f"{missing} not in {message!r}"


EVERY = with_columns(
    order=(1, 2),
    time_s=(0, 9),
    temperature_C=(20, 21),
    payload_kg=(0, 5),
    direction1=(1, -1),
    direction2=(1, 1),
    posture=(1, 2),
    session=("monday", "friday"),
    sigma_mm=(0.1, 0.1),
)


@pytest.mark.parametrize("column", EVERY.split("\n", 1)[0].split(","))
def test_a_cell_that_cannot_be_names_row_line_and_column(tmp_path: Path, column: str) -> None:
    """A word where a number belongs, nothing where something does; a direction may be unknown."""
    header, first, second = (line.split(",") for line in EVERY.splitlines())
    place = header.index(column)
    for wrong, shown in (("left", "found 'left'"), ("inf", "found 'inf'"), ("", "found an empty cell")):
        if (column == "session" and wrong) or (column.startswith("direction") and not wrong):
            continue
        cells = [*second[:place], wrong, *second[place + 1 :]]
        with pytest.raises(InputError) as caught:
            load(tmp_path, "\n".join(",".join(row) for row in (header, first, cells)) + "\n")
        message = str(caught.value)
        assert f"data.csv: row 2 (line 3), column {column}: {shown}, allowed: " in message
        assert "\n" not in message


# -- writing -----------------------------------------------------------------------------------------------------------
def test_text_is_tidy() -> None:
    data = Measurements(np.radians([[30.0, -0.0]]), [[1.5, 2]], order=[3], directions=[[1, -1]], sigma=[0.1])
    assert measurement_text(data) == (
        "q1_deg,q2_deg,x_mm,y_mm,order,direction1,direction2,sigma_mm\n30.0,0.0,1.5,2.0,3,1,-1,0.1\n"
    )


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
        sigma=maybe(st.floats(1e-9, 10)),
        repeats=maybe(st.integers(-100, 2**52), dtype=np.int64),
    )


@given(measured())
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, data: Measurements) -> None:
    path = tmp_path_factory.mktemp("data") / "data.csv"
    path.write_text(measurement_text(data))
    again = load_measurements(path, data.links)
    np.testing.assert_allclose(again.postures, data.postures, rtol=0, atol=1e-13)
    assert again.optional_columns == data.optional_columns
    for name in ("positions", *data.optional_columns):
        np.testing.assert_array_equal(getattr(again, name), getattr(data, name))


@pytest.mark.skipif(not UR10.exists(), reason="the data set is not part of the repository")
def test_real_measurements() -> None:
    data = load_measurements(UR10, 3)
    assert len(data) == 2773
    assert data.optional_columns == {"order", "temperature"}
    assert data_warnings(data, Arm([612.0, 572.3, 115.7])) == []
