"""Plans of few runs that attain the closed-form bound by themselves: orthogonal columns built from group characters.

Number the b runs of such a plan by the elements of a group Z_2^t x Z_(b / 2^t), and write z_j in C^b for the column of
exp(i theta_j). The planar theorem (doe/README.md) says when the bound is attained: every new column, less
its projection on its neighbor, is orthogonal to all columns so far. Going from any link to the left or to the right,

- *wide* joint (range pi or more): the new column itself is orthogonal. It is tried as a character times any earlier
  column, and taken where the angles it asks of the joint fit into the range; their common phase stays free.
- *narrow* joint: always at one of its limits, exp(i q_j) = exp(i middle) (cos h + i s sin h), 2 h the range, with the
  signs s a character of order two such that s times the neighbor is orthogonal.

A phase of a wide joint changes no |H_jk| and leaves H_jk = 0 across that joint. So plans of any sizes and phases can
be put together: the mean of their matrices H is optimal again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

Columns = NDArray[np.complex128]
ROUNDING = 1e-9  # [rad] by which a range may fall short; and of a mean product of columns that counts as zero
ALL, SAMPLE = 64, 32  # runs up to which all characters are tried; number tried of a larger group
TURN = 2.0 * np.pi


@dataclass(frozen=True)
class CharacterPlan:
    """Runs that attain the bound. angles : (b, J) above the lower limits [rad];  room : (J,) free phase [rad]."""

    angles: Array
    free_phase: Array

    def placed(self, lower: Array, upper: Array, generator: np.random.Generator) -> Array:
        """(b, J) joint angles with random phases."""
        placed: Array = np.minimum(lower + self.angles + generator.uniform(0.0, self.free_phase), upper)
        return placed


def character_plans(widths: Array, size: int, tries: int, generator: np.random.Generator) -> Iterator[CharacterPlan]:
    """Those of a number of random constructions that come to their end; widths (J,) of the joints' ranges [rad]."""
    moduli = moduli_of(size)
    room = 2 ** (len(moduli) - 1) if np.all(widths < np.pi - ROUNDING) else size  # dimension that columns may have
    if room <= len(widths) or (halves(widths) and size % 2):  # as many orthogonal columns as links
        return
    for k in range(tries):
        found = Construction(widths, moduli[k % len(moduli)], generator).run()
        if found is not None:
            yield found


def halves(widths: Array) -> bool:
    """True if half the runs must stand at each limit of some joint: their number is even."""
    return bool(np.any(widths < np.pi - ROUNDING))


def moduli_of(size: int) -> list[tuple[int, ...]]:
    """The groups Z_2^t x Z_(b / 2^t) of b elements, as lists of moduli."""
    groups: list[tuple[int, ...]] = [(size,)]
    twos = 0
    while size % 2 ** (twos + 1) == 0:
        twos += 1
        groups.append((2,) * twos + (size // 2**twos,))
    return groups


class Construction:
    """One random choice of directions and characters."""

    def __init__(self, widths: Array, moduli: tuple[int, ...], generator: np.random.Generator) -> None:
        self.widths, self.generator = widths, generator
        self.moduli = np.array(moduli)
        self.elements = np.indices(moduli).reshape(len(moduli), -1).T
        self.angles = np.empty((len(self.elements), len(widths)))
        self.free_phase = np.zeros(len(widths))

    def run(self) -> CharacterPlan | None:
        """The plan, None in a dead end."""
        joints = len(self.widths)
        left = right = int(self.generator.integers(joints + 1))
        columns = np.ones((len(self.elements), 1), dtype=complex)  # of links left..right
        while right - left < joints:
            to_right = left == 0 or (right < joints and self.generator.random() < 0.5)
            new = self._next(columns, right if to_right else left - 1, to_right=to_right)
            if new is None:
                return None
            columns = np.column_stack([columns, new] if to_right else [new, columns])
            left, right = (left, right + 1) if to_right else (left - 1, right)
        return CharacterPlan(self.angles, self.free_phase)

    def _next(self, columns: Columns, joint: int, *, to_right: bool) -> Columns | None:
        """The column beyond a joint, whose angles are noted."""
        neighbor = columns[:, -1 if to_right else 0]
        if self.widths[joint] < np.pi - ROUNDING:
            return self._two_levels(columns, neighbor, joint, to_right=to_right)
        offered = (self._characters()[:, :, None] * columns[:, None, :]).reshape(len(columns), -1)
        for k in self._orthogonal(columns, offered):
            new = offered[:, k]
            angles, needed = arc(np.angle(new / neighbor if to_right else neighbor / new))
            if needed <= self.widths[joint] + ROUNDING:
                self.angles[:, joint] = angles
                self.free_phase[joint] = max(self.widths[joint] - needed, 0.0)
                return np.asarray(new)
        return None

    def _two_levels(self, columns: Columns, neighbor: Columns, joint: int, *, to_right: bool) -> Columns | None:
        signs = self._signs()
        found = self._orthogonal(columns, signs * neighbor[:, None])
        if not len(found):
            return None
        sign, half = signs[:, found[0]], self.widths[joint] / 2.0
        self.angles[:, joint] = np.where((sign > 0) == to_right, self.widths[joint], 0.0)
        return np.asarray(neighbor * np.exp(1j * half * sign))

    def _orthogonal(self, columns: Columns, offered: Columns) -> NDArray[np.intp]:
        """Offered columns that are orthogonal to all so far, in random order."""
        products = np.abs(columns.conj().T @ offered).max(axis=0)
        return self.generator.permutation(np.flatnonzero(products < ROUNDING * len(columns)))

    def _characters(self) -> Columns:
        """(b, k) characters of the group: all of a small one, else a random choice."""
        chosen = self.elements
        if len(chosen) > ALL:
            chosen = chosen[self.generator.integers(len(chosen), size=SAMPLE)]
        return np.exp(TURN * 1j * (self.elements @ (chosen / self.moduli).T % 1.0))

    def _signs(self) -> Array:
        """(b, k) characters of order two: +1 and -1."""
        even = self.moduli % 2 == 0
        bits = np.arange(1, min(2 ** int(even.sum()), SAMPLE * ALL))
        chosen = (bits[:, None] >> np.arange(int(even.sum()))) & 1
        return 1.0 - 2.0 * (self.elements[:, even] @ chosen.T % 2)


def arc(angles: Array) -> tuple[Array, float]:
    """Angles counted from the start of the shortest arc that holds them, and its length [rad]."""
    turned = np.sort(np.mod(angles, TURN))
    gaps = np.concatenate([turned[1:], turned[:1] + TURN]) - turned
    last = int(np.argmax(gaps))
    start = turned[(last + 1) % len(turned)]
    above = np.mod(angles, TURN) - start
    return np.where(above < 0.0, above + TURN, above), float(TURN - gaps[last])
