"""Strategies of what measures lengths instead of positions: the arm file's table, and the columns of measurements."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st

from tests.fuzz.texts import one_in

Positions = Callable[[np.ndarray], np.ndarray]  # (m, n) [deg, mm] -> (m, 3) [mm]

BARS = (
    'kind = "distance"\ncenter_mm = [700.0, -200.0, 300.0]',
    'kind = "distance"',
    'kind = "distance"\ncenter_mm = [0.0, 0.0, 0.0]',
    'kind = "distance"\ncenter_mm = [1e9, 0.0, 0.0]',
)
CONTACTS = ('kind = "sphere"\nradius_mm = 30.0', 'kind = "sphere"\nradius_mm = 1e-6', 'kind = "plane"')
CONTACTS += ('kind = "sphere"', 'kind = "sphere"\nradius_mm = 30.0\ncenter_mm = [700.0, -200.0, 300.0]')
ODD = ('kind = "plane"\nradius_mm = 5.0', 'kind = "distance"\nradius_mm = 5.0', 'kind = "none"')
ODD += ('kind = "plane"\ncenter_mm = [1.0, 2.0, 3.0]', 'kind = "sphere"\nradius_mm = -1.0')
CENTER = np.array([700.0, -200.0, 300.0])
STEPS, STEP, LONGEST = 12, 1e-4, 20.0  # Newton steps; of a difference, and the longest [deg, mm]


@st.composite
def instruments(draw: st.DrawFn) -> str:
    """The table; seldom one that is refused."""
    return "[instrument]\n" + draw(st.sampled_from(ODD if one_in(draw, 12) else (BARS + CONTACTS)))


def gaps(kind: str, places: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """(m,) how far places (m, 3) are outside of the surface of number (m,) [mm]."""
    if kind == "plane":
        return places[:, 2] - 250.0 - 100.0 * surface
    return np.linalg.norm(places - CENTER * np.where(surface, -1.0, 1.0)[:, None], axis=1) - 30.0


def touching(kind: str, positions: Positions, postures: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """(m, n) postures moved to where most of them touch the surface of number (m,)."""
    for _ in range(STEPS):
        ends = [
            [gaps(kind, positions(postures + sign * step), surface) for sign in (1.0, -1.0)]
            for step in STEP * np.eye(postures.shape[1])
        ]
        slopes = np.stack([(up - down) / (2.0 * STEP) for up, down in ends], axis=1)
        wanted = -slopes * gaps(kind, positions(postures), surface)[:, None]
        wanted /= np.maximum(np.sum(slopes**2, axis=1), 1e-9)[:, None]
        postures = postures + np.clip(wanted, -LONGEST, LONGEST)
    return postures


def lengths(draw: st.DrawFn, places: np.ndarray) -> dict[str, np.ndarray]:
    """The column of distances from a center, in metres now and then."""
    found = np.linalg.norm(places - CENTER, axis=1)
    return {"distance_m": found / 1000.0} if one_in(draw, 12) else {"distance_mm": found}
