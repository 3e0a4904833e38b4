"""How a controller counts its joints: what stands in its columns, against the joint angles of the model.

    c_j = s_j a_j + z_j,    a_j = q_j            (coupled_to[j] = 0)
                            a_j = q_j + a_k      (coupled_to[j] = k: joint j is counted from where joint k is)
                            a_j = q_j - a_k      (coupled_to[j] = -k: the same, and the two axes point opposite ways)

q : angle of the model's joint, from the link before;  c : column, command and limit of the controller
s : `sign`;  z : `zero`, what the controller shows where the drawing has its zero

So a joint 3 that is counted from the horizontal, behind a joint 2 that is, has coupled_to = 2: a_3 = q_3 + q_2. Files
and commands are the controller's, all else is the model's; this is the only place where one becomes the other.

Beside it: whole turns of revolute joints, where an angle beyond a limit may be one within the limits, read a turn away;
and the range of each joint over some postures, as a calibration keeps it.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np

from identification.arrays import Array
from identification.errors import require
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS, PRISMATIC, REVOLUTE

TURN = 2.0 * np.pi
KEYS: Mapping[str, str] = {REVOLUTE: "joint_range_deg", PRISMATIC: "joint_range_mm"}


@dataclass(frozen=True)
class Counting:
    """Of n joints; see above.

    sign : (n) +1 or -1;  coupled_to : (n) joint from 1, negative: against its sense, 0: none;  zero : (n) [rad, mm]

    Raises `InputError` for other values, other numbers of them, and joints that are coupled in a circle.
    """

    sign: tuple[int, ...]
    coupled_to: tuple[int, ...]
    zero: tuple[float, ...]

    def __post_init__(self) -> None:
        n = len(self.sign)
        for name, values in (("coupled_to", self.coupled_to), ("zero_deg", self.zero)):
            require(len(values) == n, f"joints.{name}: found {len(values)} values, allowed: {n}")
        for j, (sign, other) in enumerate(zip(self.sign, self.coupled_to, strict=True), start=1):
            require(sign in (1, -1), f"joints.sign: found {sign} for joint {j}, allowed: 1 or -1")
            fits = abs(other) <= n and abs(other) != j
            require(fits, f"joints.coupled_to: found {other} for joint {j}, allowed: another joint, 1 to {n}, or 0")
        for j in range(1, n + 1):
            passed, at = {j}, j
            while at := abs(self.coupled_to[at - 1]):
                circle = f"found a circle through joint {at}"
                require(at not in passed, f"joints.coupled_to: {circle}, allowed: joints that lead to one with 0")
                passed.add(at)

    def check(self, kinds: Sequence[str]) -> None:
        """Raises `InputError` for another number of joints, turning joints coupled to sliding ones, zeros of these."""
        n, signs = len(kinds), len(self.sign)
        require(signs == n, f"joints.sign: found {signs} values, allowed: {n}, one for each joint")
        for j, (kind, other, zero) in enumerate(zip(kinds, self.coupled_to, self.zero, strict=True), start=1):
            alike, which = not other or kinds[abs(other) - 1] == kind, f"joint {j}, which is {kind}"
            require(alike, f"joints.coupled_to: found {other} for {which}, allowed: a joint of its kind")
            held = kind != PRISMATIC or zero == 0.0
            require(held, f"joints.zero_deg: found {np.degrees(zero):g} for {which}, allowed: 0")

    @classmethod
    @lru_cache(maxsize=16)
    def usual(cls, n: int) -> Self:
        """Of n joints that are counted as they are drawn."""
        return cls((1,) * n, (0,) * n, (0.0,) * n)

    @classmethod
    def of_matrix(cls, matrix: Array, zero: Iterable[float]) -> Self | None:
        """That of columns `matrix` q + `zero`, with integers (n, n); None where coupling of one joint to one other does
        not say it."""
        signs = np.sign(np.diag(matrix)).astype(int)
        sums, n = signs[:, None] * matrix, len(matrix)
        others, coupled = sums - np.eye(n), []
        for j in range(n):
            ways = (k * s for k in range(1, n + 1) for s in (1, -1) if np.array_equal(others[j], s * sums[k - 1]))
            coupled.append(next(ways, None if others[j].any() else 0))
        if None in coupled or not np.all(np.diag(sums) == 1):
            return None
        return cls(tuple(signs.tolist()), tuple(int(k or 0) for k in coupled), tuple(map(float, zero)))

    @cached_property
    def matrix(self) -> Array:
        """(n, n) of c = matrix q + zero."""
        n = len(self.sign)
        parents = np.zeros((n, n))
        for j, other in enumerate(self.coupled_to):
            if other:
                parents[j, abs(other) - 1] = np.sign(other)
        return np.asarray(np.array(self.sign)[:, None] * np.round(np.linalg.inv(np.eye(n) - parents)), float)

    @cached_property
    def inverse(self) -> Array:
        """(n, n) of q = inverse (c - zero)."""
        return np.asarray(np.round(np.linalg.inv(self.matrix)), float)

    # joints (from 0) in whose column the angle of another is
    coupled = property(lambda self: tuple(j for j, other in enumerate(self.coupled_to) if other))

    @property
    def toml(self) -> str:
        """As an arm file has it, without what is as usual; zeros to 0.01 degrees."""
        zeros = [round(float(np.degrees(z)), 2) + 0.0 for z in self.zero]
        lines = {"sign": min(self.sign) < 0, "coupled_to": bool(self.coupled), "zero_deg": any(zeros)}
        values = {"sign": [*self.sign], "coupled_to": [*self.coupled_to], "zero_deg": zeros}
        return "\n".join(["[joints]", *(f"{key} = {values[key]}" for key, unusual in lines.items() if unusual)])

    def columns(self, joints: Array) -> Array:
        """(..., n) what the controller shows at joint angles (..., n) [rad, mm]."""
        return np.asarray(joints @ self.matrix.T + self.zero)

    def joints(self, columns: Array) -> Array:
        """(..., n) joint angles [rad, mm] of what the controller shows (..., n)."""
        return np.asarray((columns - np.array(self.zero)) @ self.inverse.T)

    def signs_of_columns(self, directions: Array, back: bool = False) -> Array:
        """(m, n) signs of the motions of columns, of those of joints (m, n), or `back`; NaN where coupled ones leave it
        open."""
        terms = self.inverse if back else self.matrix
        terms = np.where(terms == 0.0, 0.0, terms * directions[:, None, :])
        forward, backward = np.any(terms > 0.0, axis=2), np.any(terms < 0.0, axis=2)
        is_open = np.any(np.isnan(terms), axis=2) | (forward & backward)
        return np.where(is_open, np.nan, forward.astype(float) - backward)

    def joint_limits(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """(n,) least and largest joint angles [rad, mm] within limits (n,) of the columns; of coupled ones, which tie
        joints together, the box around what they allow."""
        ends = np.stack([lower, upper]) - np.array(self.zero)
        towards = self.inverse[:, None] * ends.T[None].swapaxes(1, 2)  # (n, 2, n)
        return towards.min(axis=1).sum(axis=1), towards.max(axis=1).sum(axis=1)


class JointKinds(tuple[str, ...]):
    """(n) `revolute` or `prismatic`, and how a controller counts these joints, None: as those kinds say, or are drawn.

    Whatever reads or writes angles of a file needs to know of each joint whether these are degrees or millimetres: the
    counting goes with that.
    """

    counting: Counting

    def __new__(cls, kinds: Iterable[str], counting: Counting | None = None) -> Self:
        joint_kinds = super().__new__(cls, tuple(kinds))
        joint_kinds.counting = counting or getattr(kinds, "counting", None) or Counting.usual(len(joint_kinds))
        return joint_kinds


def turned_into(postures: Array, lower: Array, upper: Array, joint_types: Sequence[str], slack: float = 0.0) -> Array:
    """(m, n) postures whose revolute joints beyond (n,) limits, by more than a slack [rad], are moved by whole turns to
    where the limits allow them."""
    lower, upper = lower - slack, upper + slack
    turned = lower + np.mod(postures - lower, TURN)
    revolute, beyond = np.array(joint_types) == REVOLUTE, (postures < lower) | (postures > upper)
    return np.where(revolute & beyond & (turned <= upper), turned, postures)


def joint_range(postures: Array, joint_types: Sequence[str]) -> dict[str, list[list[float]]]:
    """Smallest and largest position of each joint, [deg] and [mm], of postures (m, n) [rad, mm]; no key without such
    joints."""
    limits = np.stack([np.min(postures, axis=0), np.max(postures, axis=0)], axis=1)
    ranges: dict[str, list[list[float]]] = {}
    for kind, pair in zip(joint_types, limits, strict=True):
        in_file = pair * FILE_UNITS[JOINT_UNITS[kind]][1]
        ranges.setdefault(KEYS[kind], []).append([float(f"{end:.9g}") for end in in_file])
    return ranges


def range_of(provenance: Mapping[str, Any], joint_types: Sequence[str]) -> Array | None:
    """(2, n) least and largest positions [rad, mm] that `joint_range` wrote; None where they are not there."""
    limits = {kind: [*provenance.get(KEYS[kind], [])] for kind in joint_types}
    if any(len(pairs) != [*joint_types].count(kind) for kind, pairs in limits.items()):
        return None
    factors = [FILE_UNITS[JOINT_UNITS[kind]][1] for kind in joint_types]
    return np.array([limits[kind].pop(0) for kind in joint_types]).T / factors
