"""One way to read the columns of a measurement file, and the better ways that were found, in words."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from identification.arrays import Array
from identification.kinematics.counting import Counting

UPRIGHT, QUARTER = np.radians(20.0), np.radians(45.0)  # a base is this near to the frame's axes; or to a half turn


@lru_cache
def alone(joints: int) -> tuple[tuple[int, ...], ...]:
    """(n, n) `Reading.sums` of joints that are each counted from the link before."""
    return tuple(tuple(int(i == j) for i in range(joints)) for j in range(joints))


@dataclass(frozen=True)
class Reading:
    """One way to read the columns.

    order : joint j is in column order[j];  signs : +1 or -1 of each joint
    quarters : quarter turns to add to each joint, whole ones or a zero of any angle
    sums : (n, n) how often column j has the angle of joint i in it: 1 on the diagonal, and 1 or -1 of joints before j
        where j is counted from farther back than from the link before
    mirrored : the positions are those of a mirror image: their last axis is read the other way
    turn : of the base [rad] that then explains the positions best, in the plane; None: it says nothing
    rms : distance [mm] that the drawing leaves
    """

    order: tuple[int, ...]
    signs: tuple[int, ...]
    quarters: tuple[float, ...]
    mirrored: bool = False
    sums: tuple[tuple[int, ...], ...] = ()
    turn: float | None = None
    rms: float = np.inf

    def __post_init__(self) -> None:
        if not self.sums:
            object.__setattr__(self, "sums", alone(len(self.order)))

    @classmethod
    def as_written(cls, joints: int) -> Reading:
        """As the columns say."""
        return cls(tuple(range(joints)), (1,) * joints, (0,) * joints)

    @property
    def changes(self) -> int:
        """How many things are read differently."""
        swapped = sum(a != b for a, b in enumerate(self.order)) // 2
        zeros, absolute = sum(k != 0 for k in self.quarters), self.sums != alone(len(self.order))
        return swapped + sum(s < 0 for s in self.signs) + zeros + self.mirrored + absolute

    def postures(self, given: Array) -> Array:
        """(m, n) what the arm's joints are, of columns (m, n)."""
        read = given[:, list(self.order)] * np.array(self.signs) + 0.5 * np.pi * np.array(self.quarters)
        return read if self.sums == alone(len(self.order)) else np.linalg.solve(np.array(self.sums), read.T).T

    def positions(self, given: Array) -> Array:
        """(m, d) what the positions are in axes of the right hand."""
        return given * np.r_[np.ones(given.shape[1] - 1), -1.0] if self.mirrored else given

    @property
    def words(self) -> tuple[str, ...]:
        """What is different, each in a sentence; joints and columns from 1."""
        swaps = sorted({tuple(sorted((a, b))) for a, b in enumerate(self.order) if a != b})
        said = [f"columns of joints {a + 1} and {b + 1} are swapped" for a, b in swaps]
        said += [f"joint {j} turns the other way" for j, sign in enumerate(self.signs, start=1) if sign < 0]
        zeros = ((j, np.degrees(x)) for j, x in enumerate(self.zeros, start=1) if x)
        said += [f"joint {j} has another zero than the drawing: add {x:.3g} deg to it" for j, x in zeros]
        return (*said, *self._absolute, *([self._mirror] if self.mirrored else []))

    @property
    def _absolute(self) -> list[str]:
        """Joints that are counted from farther back, each with what to take off its column."""
        said = []
        for j, row in enumerate(self.sums):
            if more := [i for i in range(j) if row[i]]:
                where = f"link {more[0]}" if more[0] else "the base"
                angle = " ".join(f"{'-' if row[i] > 0 else '+'} q{i + 1}" for i in more)
                said.append(f"joint {j + 1} is counted from {where}, not from link {j} (its angle: column {angle})")
        return said

    @property
    def zeros(self) -> tuple[float, ...]:
        """(n) what to add to each joint [rad], by the shorter way."""
        return tuple(float(np.radians(180.0 - (180.0 - 90.0 * k) % 360.0)) for k in self.quarters)

    def counting(self, before: Counting | None) -> Counting | None:
        """How the controller counts, where this is what its columns say to an arm whose file says `before`; None where
        columns are swapped, or a joint is coupled to several."""
        n = len(self.order)
        if self.order != tuple(range(n)):
            return None
        plain = before or Counting((1,) * n, (0,) * n, (0.0,) * n)
        # signs (sums q - zeros) are the joints as read so far, from which follow the columns
        through = plain.matrix * np.array(self.signs)
        zero = (plain.zero - through @ self.zeros + np.pi) % (2.0 * np.pi) - np.pi
        return Counting.of_matrix(through @ np.array(self.sums), np.where(np.isclose(zero, -np.pi), np.pi, zero))

    @property
    def moved_zeros(self) -> bool:
        """Nothing but zeros of joints that are off by no whole quarter turns: a fit takes them for what they are."""
        as_written = Reading.as_written(len(self.order))
        same = replace(self, quarters=as_written.quarters, turn=None, rms=np.inf) == as_written
        return same and any(k % 1.0 for k in self.quarters)

    @property
    def _mirror(self) -> str:
        """What makes a mirror image: with x and y swapped the last axis turned gives back the drawing a quarter turn
        away, with an axis turned it stands as drawn or half a turn away."""
        flipped, swapped = "an axis of the positions points the other way", "x_mm and y_mm are swapped"
        if self.turn is None:
            return f"two of x_mm, y_mm, z_mm are swapped, or {flipped}"
        if abs(np.sin(2.0 * self.turn)) > np.sin(2.0 * UPRIGHT):
            return f"{swapped}, or {flipped}"
        return flipped if abs(np.cos(self.turn)) > np.cos(QUARTER) else swapped


@dataclass(frozen=True)
class Readings:
    """What was found.

    written : as the columns say;  better : one that explains the positions clearly better, or None
    alike : others as simple that explain them as well: at a wrist whose axes meet, joint 5 reversed and joint 4 half
        a turn away are the same
    explained : the better one leaves no more than a drawing may be off by
    counting : as the better one says, where the arm file can say it; None: it cannot, or it explains nothing
    """

    written: Reading
    better: Reading | None
    alike: tuple[Reading, ...] = ()
    explained: bool = True
    counting: Counting | None = None

    @property
    def sentences(self) -> list[str]:
        """What looks wrong, in a sentence; none where nothing does."""
        if self.better is None:
            return []
        ways = ", or, equally well, ".join(", and ".join(reading.words) for reading in (self.better, *self.alike))
        gain = f"{self.better.rms:.3g} mm instead of {self.written.rms:.4g}"
        if self.explained:
            return [f"it looks as if {ways}: the drawing then leaves {gain}"]
        found = "no one or two signs, zeros, swapped columns or mirrored axes explain the positions"
        return [f"{found}: several faults at once, or another arm? Closest: {ways}, which leaves {gain}"]

    def to_json(self) -> dict[str, Any] | None:
        """`better_reading` of `check` (identification/files/README.md, "JSON keys")."""
        if (better := self.better) is None:
            return None
        also = [reading.words for reading in self.alike]
        toml = None if self.counting is None else self.counting.toml
        return {
            "changes": better.words,
            "arm_file": toml,
            "rms_mm": better.rms,
            "explains": self.explained,
            "equally_good": also,
        }
