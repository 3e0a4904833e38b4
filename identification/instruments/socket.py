"""A ball at the tool that is seated in fixed cups, each in several orientations: nothing is read but the joints.

    p(q_i) = c_k    for all rows i in cup k

The frame is that of the base, which no row places: so neither a motion of arm and cups together, nor a turn about the
line through two cups, is a parameter. Where the cups are is found with the arm; distances between them that are known
(a bar with two cups, a plate) give the arm its size, and tie coordinates of the cups:

    |c_a - c_b| = d

Of the coordinates, as many as there are independent distances follow from the others, by a few steps of Newton's method
with the derivative at the start, which is near: each gains two digits or more where cups are found to some mm.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import InputError
from identification.instruments.base import PLACE, Guide, Instrument, OwnValue, register_instrument
from identification.instruments.search import Placement, Unplaced
from identification.kinematics.parameters import AXES, Parameter, error_names

STEPS = 4  # effort: of Newton's method for coordinates that follow from distances
TOUCHES = 1e-6  # [mm] by which these are kept
DISTINCT = 1e-6  # share of the largest derivative below which a distance says nothing new


@register_instrument
@dataclass(frozen=True)
class Socket(Instrument):
    """Read is where the ball is from the cup of the row, nothing as measured.

    cups : names and places (3,) [mm] in the frame of the base, about, where fits start; empty: not known yet
    distances : pairs of cups and what is known between their centers [mm]
    numbers : of the cups, by which rows name them, from 0; empty: in order
    """

    kind = "socket"
    keys = frozenset({"cups", "distances_mm"})
    target = "cup"
    own_targets = "cup"
    unsaid = -1.0
    hides = frozenset(error_names(PLACE))
    guide = Guide(
        about="a ball at the tool, seated in cups that stand anywhere",
        table='kind = "socket"\n'
        'distances_mm = [["A", "B", 300.0]]  # EXAMPLE: between centers; left out: only [machining] tells the size\n'
        "\n[instrument.cups]  # EXAMPLE: about where, in the frame of the base: plans are made for them\n"
        "A = [600.0, -150.0, 100.0]\nB = [600.0, 150.0, 100.0]",
        reads="seating",
        stands="cup",
        labels="cup in which the ball is seated, a new one wherever it is moved",
        touches="three cups or more, each in five\norientations or more",
    )

    cups: tuple[tuple[str, tuple[float, float, float]], ...] = ()
    distances: tuple[tuple[str, str, float], ...] = ()
    numbers: tuple[int, ...] = ()

    @property
    def dimension(self) -> int:
        return len(AXES)

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        """From the cup of this number; where there is none from the nearest."""
        if not self.cups:
            return point
        places = ca.reshape(self._places(values), 3, -1)
        beside = [point - places[:, k] for k in range(len(self.cups))]
        chosen, least = beside[0], ca.sumsqr(beside[0])
        for other in beside[1:]:
            chosen, least = ca.if_else(ca.sumsqr(other) < least, other, chosen), ca.fmin(least, ca.sumsqr(other))
        for number, one in zip(self._numbers, beside, strict=True):
            chosen = ca.if_else(target == number, one, chosen)
        return chosen

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"cup[{name}].{axis}", "mm", kind=PLACE, start=float(self._starts[3 * k + i]))
            for k, (name, _) in enumerate(self.cups)
            for i, axis in enumerate(AXES)
            if 3 * k + i not in self._following
        )

    def own_values(self, values: Mapping[str, float]) -> Iterator[OwnValue]:
        """Where the cups are, and how far apart."""
        if not self.cups:
            return
        names = [parameter.name for parameter in self.parameters]
        symbols = ca.SX.sym("v", len(names))
        places = self._places(symbols)
        centers = [places[3 * k : 3 * k + 3] for k in range(len(self.cups))]
        labels = [f"cup {name} {axis}" for name, _ in self.cups for axis in AXES]
        labels += [f"cups {a} to {b}" for (a, _), (b, _) in combinations(self.cups, 2)]
        lengths = (ca.norm_2(one - other) for one, other in combinations(centers, 2))
        table = ca.vertcat(places, *lengths)
        function = ca.Function("cups", [symbols], [table, ca.jacobian(table, symbols)])
        found, slopes = function([values.get(p.name, p.neutral) for p in self.parameters])
        for label, value, row in zip(labels, np.array(found).ravel().tolist(), np.array(ca.DM(slopes)), strict=True):
            by_name = {name: float(slope) for name, slope in zip(names, row, strict=True) if slope}
            yield OwnValue(label, None, value, by_name, "mm", "center of the ball in the cup, in the frame of the base")

    @property
    def size_is_open(self) -> tuple[str, str]:
        known = self._pairs[0] if self.cups else self.distances  # between these cups, of all that are given
        return ("", "") if known else ("cups without a distance that is known", "give distances_mm between them")

    def clear(self, points: Array, values: Array, near: float) -> NDArray[np.bool_]:
        """Of a cup nothing is known but its center."""
        return np.ones(len(points), dtype=bool)

    # -- where a fit starts --------------------------------------------------------------------------------------------
    def place(self, rows: Unplaced) -> Placement:
        """Of rows in one cup: the point of the tip that moves least, in closed form."""
        frames, tool = rows.frames, rows.tool
        positions, turns = frames[:, :3, 3] - frames[:, :3, 3].mean(axis=0), frames[:, :3, :3]
        turns = turns - turns.mean(axis=0)
        if tool is None:
            tool = -np.linalg.lstsq(turns.reshape(-1, 3), positions.ravel(), rcond=1e-6)[0]
        moved = positions + turns @ tool
        return Placement(np.eye(4), tool, float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))))

    def with_targets(self, points: Array, readings: Array, numbers: NDArray[np.int64], names: Sequence[str]) -> Socket:
        """With a cup in the middle of the points of each."""
        touched = np.unique(numbers).tolist()
        cups = tuple((names[k], _triple(points[numbers == k].mean(axis=0))) for k in touched)
        return replace(self, cups=cups, numbers=tuple(touched))

    @property
    def targets(self) -> dict[str, Array]:
        return {name: self._starts[3 * k : 3 * k + 3] for k, (name, _) in enumerate(self.cups)}

    # -- cups ----------------------------------------------------------------------------------------------------------
    @property
    def _numbers(self) -> tuple[int, ...]:
        return self.numbers or tuple(range(len(self.cups)))

    @cached_property
    def _pairs(self) -> tuple[list[tuple[int, int]], Array]:
        """Numbers of cups whose distances are known, and these (k,) [mm]; of `monday/A` and `monday/B`, too."""
        split = [name.rpartition("/")[::2] for name, _ in self.cups]
        pairs, lengths = [], []
        for first, second, length in self.distances:
            for a, (group, name) in enumerate(split):
                if name == first and (group, second) in split:
                    pairs.append((a, split.index((group, second))))
                    lengths.append(length)
        return pairs, np.array(lengths)

    def _gaps(self, places: Array) -> tuple[Array, Array]:
        """(k,) by which pairs are too far apart, and the derivative (k, 3 C) by all coordinates of the cups."""
        pairs, lengths = self._pairs
        apart, slopes = np.empty(len(pairs)), np.zeros((len(pairs), places.size))
        for row, (a, b) in enumerate(pairs):
            across = places[3 * b : 3 * b + 3] - places[3 * a : 3 * a + 3]
            apart[row] = np.linalg.norm(across)
            slopes[row, 3 * b : 3 * b + 3] = across / max(apart[row], TOUCHES)
            slopes[row, 3 * a : 3 * a + 3] = -slopes[row, 3 * b : 3 * b + 3]
        return apart - lengths, slopes

    @cached_property
    def _starts(self) -> Array:
        """(3 C,) coordinates of all cups, nearest to `cups` with the distances that are known."""
        places = np.array([place for _, place in self.cups], dtype=float).ravel()
        for _ in range(100):  # effort: distances that can be true are reached in a few steps
            gaps, slopes = self._gaps(places)
            if np.abs(gaps).max(initial=0.0) < TOUCHES:
                return places
            places = places - np.linalg.pinv(slopes, rcond=DISTINCT) @ gaps
        pairs = ", ".join(f"{self.cups[a][0]} to {self.cups[b][0]}" for a, b in self._pairs[0])
        raise InputError(
            f"instrument.distances_mm: no cups are as far apart as {pairs}, allowed: distances that can all be true"
        )

    @cached_property
    def _following(self) -> dict[int, Array]:
        """Coordinate that follows from the others -> by how much it closes each gap (k,), as at the start."""
        slopes = self._gaps(self._starts)[1]
        left, chosen = slopes.copy(), list[int]()
        while left.size and (sizes := np.linalg.norm(left, axis=0)).max() > DISTINCT:
            chosen.append(int(np.argmax(sizes)))
            direction = left[:, chosen[-1]] / sizes.max()
            left = left - np.outer(direction, direction @ left)
        return dict(zip(chosen, np.linalg.pinv(slopes[:, chosen], rcond=DISTINCT), strict=True))

    def _places(self, values: ca.SX) -> ca.SX:
        """(3 C,) coordinates of all cups at values of the parameters."""
        free, following = iter(range(values.numel())), self._following
        places = [ca.SX(float(x)) if k in following else values[next(free)] for k, x in enumerate(self._starts)]
        pairs, lengths = self._pairs
        for _ in range(STEPS if pairs else 0):
            cups = [ca.vertcat(*places[3 * k : 3 * k + 3]) for k in range(len(self.cups))]
            apart = ca.vertcat(*(ca.norm_2(cups[b] - cups[a]) for a, b in pairs))
            for k, closing in following.items():
                places[k] = places[k] - ca.dot(ca.DM(closing), apart - ca.DM(lengths))
        return ca.vertcat(*places)

    # -- files ---------------------------------------------------------------------------------------------------------
    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Socket:
        cups = tuple((name, _triple(place)) for name, place in (table.get("cups") or {}).items())
        distances = tuple((str(a), str(b), float(d)) for a, b, d in table.get("distances_mm") or ())
        return cls(cups, distances)

    def table(self) -> dict[str, Any]:
        cups = {name: [float(x) for x in place] for name, place in self.cups}
        distances = [list(entry) for entry in self.distances]
        more = {"distances_mm": distances, "cups": cups}
        return super().table() | {key: value for key, value in more.items() if value}


def _triple(place: Sequence[float] | Array) -> tuple[float, float, float]:
    x, y, z = (float(coordinate) for coordinate in place)
    return x, y, z
