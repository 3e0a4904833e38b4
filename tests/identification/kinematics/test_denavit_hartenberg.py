"""Tables as chains against the products of matrices that the conventions print."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.chain import MODIFIED, STANDARD, DHRow, chain_of

ROWS = (
    DHRow(10.0, 1.2, 127.3, 0.4),
    DHRow(-612.0, 0.0, 5.0, -0.7),
    DHRow(30.0, -0.9, 100.0, 0.2, "prismatic", (-50.0, 250.0)),
    DHRow(0.0, 0.3, 115.7),
)
Q = np.array([0.3, -1.1, 120.0, 2.2])


def printed(row: DHRow, q: float, convention: str = STANDARD) -> Array:
    """(4, 4) A_j written out, as in textbooks."""
    slides = row.type == "prismatic"
    theta, d, a = row.offset + (0.0 if slides else q), row.d + (q if slides else 0.0), row.a
    ct, st, ca_, sa = np.cos(theta), np.sin(theta), np.cos(row.alpha), np.sin(row.alpha)
    if convention == STANDARD:
        rows = [[ct, -st * ca_, st * sa, a * ct], [st, ct * ca_, -ct * sa, a * st], [0, sa, ca_, d], [0, 0, 0, 1]]
    else:
        rows = [[ct, -st, 0, a], [st * ca_, ct * ca_, -sa, -sa * d], [st * sa, ct * sa, ca_, ca_ * d], [0, 0, 0, 1]]
    return np.array(rows, dtype=float)


@pytest.mark.parametrize("convention", [STANDARD, MODIFIED])
def test_chain_is_the_product(convention: str) -> None:
    chain = chain_of(ROWS, convention)
    q = ca.SX.sym("q", 4)
    frame = chain.frames(q, {})[-1]
    origin, axes = (part.full() for part in ca.Function("tip", [q], [frame.origin, frame.axes])(Q))
    expected = np.linalg.multi_dot([printed(row, angle, convention) for row, angle in zip(ROWS, Q, strict=True)])
    np.testing.assert_allclose(origin.ravel(), expected[:3, 3], atol=1e-9)
    np.testing.assert_allclose(axes, expected[:3, :3], atol=1e-12)
    assert (chain.joints[2].lower, chain.joints[2].upper) == (-50.0, 250.0)


def test_bad_tables_are_one_line() -> None:
    with pytest.raises(InputError, match=r"dh: convention 'craig', allowed: standard or modified"):
        chain_of(ROWS, "craig")
    with pytest.raises(InputError, match=r"dh: no rows, allowed: one for each joint"):
        chain_of(())
    with pytest.raises(InputError, match=r"dh\[1\]: a prismatic joint without limits"):
        chain_of((DHRow(0.0, 0.0, 0.0, type="prismatic"),))
