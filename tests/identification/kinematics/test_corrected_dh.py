"""Tables of corrected chains put the tip where the chain does, with links multiplied out here."""

from __future__ import annotations

import numpy as np
import pytest

from identification import PRISMATIC, InputError
from identification.kinematics.chain import MODIFIED, STANDARD, DHRow, chain_of
from identification.kinematics.corrected import corrected, corrected_links, drawn_links
from tests.identification.kinematics.test_spatial import places_by_exponentials

HALF = np.pi / 2.0
CRAIG = [
    DHRow(0.0, 0.0, 127.3),
    DHRow(0.0, HALF, 0.0),
    DHRow(-612.0, 0.0, 0.0, 0.2),
    DHRow(-572.3, 0.0, 163.941),
    DHRow(0.0, HALF, 115.7, -0.3),
    DHRow(0.0, -HALF, 92.2),
]
UR10 = [
    DHRow(0.0, HALF, 127.3),
    DHRow(-612.0, 0.0, 0.0),
    DHRow(-572.3, 0.0, 0.0, 0.2),
    DHRow(0.0, HALF, 163.941),
    DHRow(0.0, -HALF, 115.7, -0.3),
    DHRow(0.0, 0.0, 92.2),
]


def elementary(axis: str, value: float) -> np.ndarray:
    c, s, found = np.cos(value), np.sin(value), np.eye(4)
    if axis == "x":
        found[1:3, 1:3] = [[c, -s], [s, c]]
    elif axis == "y":
        found[0, 0], found[0, 2], found[2, 0], found[2, 2] = c, s, -s, c
    elif axis == "z":
        found[:2, :2] = [[c, -s], [s, c]]
    else:
        found["XYZ".index(axis), 3] = value
    return found


def row_of_table(theta: float, d: float, a: float, alpha: float, beta: float = 0.0) -> np.ndarray:
    """Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)."""
    return np.linalg.multi_dot([*map(elementary, "zZXxy", (theta, d, a, alpha, beta))])


@pytest.mark.parametrize(("rows", "convention"), [(UR10, STANDARD), (CRAIG, MODIFIED)])
def test_the_table_puts_the_tip_where_the_chain_does(rows: list[DHRow], convention: str) -> None:
    generator = np.random.default_rng(3)
    chain, drawn = chain_of(rows, convention), drawn_links(rows, convention)
    kinds = [(f"{kind}_{axis}", size) for kind, size in (("translation", 1.0), ("rotation", 5e-3)) for axis in "xyz"]
    errors = {f"{kind}:{j}": size * generator.standard_normal() for kind, size in kinds for j in range(1, 7)}
    real = corrected(chain, errors | {f"joint_offset:{j}": 0.01 * j for j in range(2, 6)})
    links, first, last = corrected_links(real, drawn)
    for q in generator.uniform(-3.0, 3.0, (5, 6)):
        at = first @ elementary("z", q[0])
        for link, angle in zip(links, q[1:], strict=True):
            at = at @ row_of_table(*link[:4], link.beta or 0.0) @ elementary("z", angle)
        np.testing.assert_allclose(at @ last, places_by_exponentials(real, q, {})[-1], rtol=0, atol=1e-9)
    # errors of machining size move no number by more than a few of them: nothing explodes
    for link, nominal in zip(links, drawn, strict=True):
        assert abs(link.d - nominal.d) < 15.0
        assert abs(link.a - nominal.a) < 15.0
        assert max(abs(link.theta - nominal.theta), abs(link.alpha - nominal.alpha), abs(link.beta or 0.0)) < 0.1


def test_without_errors_it_is_the_table_as_drawn() -> None:
    for rows, convention in ((UR10, STANDARD), (CRAIG, MODIFIED)):
        drawn = drawn_links(rows, convention)
        found = corrected_links(chain_of(rows, convention), drawn)[0]
        for one, other in zip(found, drawn, strict=True):
            numbers = [[link.theta, link.d, link.a, link.alpha, link.beta or 0.0] for link in (one, other)]
            np.testing.assert_allclose(*numbers, rtol=0, atol=1e-9)
        assert [link.beta is None for link in found] == [True, False, False, True, True]


def test_axes_of_prismatic_joints_have_no_place() -> None:
    with pytest.raises(InputError, match="prismatic"):
        drawn_links([*UR10, DHRow(0.0, 0.0, 10.0, 0.0, PRISMATIC, (0.0, 1.0))])
    with pytest.raises(InputError, match="one axis"):
        drawn_links([*UR10, DHRow(0.0, 0.0, 10.0)])
