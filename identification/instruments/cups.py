"""A ball at the tool in fixed cups: calibration without an instrument."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, Self

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.information import VISIBLE
from identification.instruments.base import AtTargets, OwnValue, Placement, Unplaced, register_instrument
from identification.kinematics.parameters import AXES, Parameter, error_names

TOUCHES = 1e-6  # [mm] by which these are kept


@register_instrument
@dataclass(frozen=True)
class Socket(AtTargets):
    """A ball at the tool that is seated in fixed cups, each in several orientations: nothing is read but the joints.

        p(q_i) = c_k    for all rows i in cup k

    The frame is that of the base, which no row places: so neither a motion of arm and cups together, nor a turn about
    the line through two cups, is a parameter. Where the cups are is found with the arm; distances between them that are
    known (a bar with two cups, a plate) give the arm its size, and tie coordinates of the cups:

        |c_a - c_b| = d

    Of the coordinates, as many as there are independent distances follow from the others, by a few steps of Newton's
    method with the derivative at the start, which is near: each gains two digits or more where cups are found to some
    mm. Read is where the ball is from the cup of the row, nothing as measured.

    distances : pairs of cups and what is known between their centers [mm]
    """

    kind = "socket"
    keys = frozenset({"cups", "distances_mm"})
    target = "cup"
    own_targets = "cup"

    distances: tuple[tuple[str, str, float], ...] = ()

    @property
    def dimension(self) -> int:
        return len(AXES)

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        """From the cup of this number; where there is none from the nearest."""
        if not self.at:
            return point
        beside = [point - cup for cup in self._cups(values)]
        nearest, least = beside[0], ca.sumsqr(beside[0])
        for other in beside[1:]:
            nearest, least = ca.if_else(ca.sumsqr(other) < least, other, nearest), ca.fmin(least, ca.sumsqr(other))
        return self.of_row(beside, target, nearest)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        starts, following = self._tied
        every = zip(super().parameters, starts.tolist(), strict=True)
        return tuple(replace(p, start=x) for k, (p, x) in enumerate(every) if k not in following)

    def own_values(self, values: Mapping[str, float]) -> Iterator[OwnValue]:
        """Where the cups are, and how far apart."""
        if not self.at:
            return
        names = [parameter.name for parameter in self.parameters]
        symbols = ca.SX.sym("v", len(names))
        cups = self._cups(symbols)
        labels = [f"cup {name} {axis}" for name, _ in self.at for axis in AXES]
        labels += [f"cups {a} to {b}" for (a, _), (b, _) in combinations(self.at, 2)]
        table = ca.vertcat(*cups, *(ca.norm_2(one - other) for one, other in combinations(cups, 2)))
        function = ca.Function("cups", [symbols], [table, ca.jacobian(table, symbols)])
        figures, slopes = function([values.get(p.name, p.neutral) for p in self.parameters])
        for label, value, row in zip(labels, np.array(figures).ravel().tolist(), np.array(ca.DM(slopes)), strict=True):
            by_name = {name: float(slope) for name, slope in zip(names, row, strict=True) if slope}
            center = "center in the frame of the base, axis 1 as drawn"
            meaning = "distance between centers" if label.startswith("cups ") else center
            yield OwnValue(label, None, value, by_name, "mm", meaning)

    def released(self) -> tuple[Self, dict[str, float]]:
        names = [name for name, _ in self.at]
        known = {f"cups {names[min(a, b)]} to {names[max(a, b)]}": length for a, b, length in self._pairs}
        return replace(self, distances=()), known

    @property
    def size_is_open(self) -> tuple[str, str]:  # type: ignore[override]
        pairs = self._pairs if self.at else self.distances  # between these cups, of all that are given
        longer = "", "give distances_mm between cups farther apart, which tell the size of the arm better"
        return longer if pairs else ("cups without a distance that is known", "give distances_mm between them")

    def hidden(self, base: Array) -> frozenset[str]:
        return frozenset(error_names("base"))

    # -- where a fit starts --------------------------------------------------------------------------------------------
    def place(self, rows: Unplaced) -> Placement:
        """Of rows in one cup: the point of the tip that moves least, in closed form."""
        positions, turns = (a - a.mean(axis=0) for a in (rows.frames[:, :3, 3], rows.frames[:, :3, :3]))
        tool = rows.tool
        if tool is None:
            tool = -np.linalg.lstsq(turns.reshape(-1, 3), positions.ravel(), rcond=VISIBLE)[0]
        return Placement(np.eye(4), tool, float(np.sqrt(np.mean(np.sum((positions + turns @ tool) ** 2, axis=1)))))

    def target_of(self, points: Array, readings: Array) -> Array:
        """In the middle of the points."""
        return np.asarray(points.mean(axis=0))

    @property
    def targets(self) -> dict[str, Array]:
        return dict(zip((name for name, _ in self.at), self._tied[0].reshape(-1, 3), strict=True))

    # -- cups ----------------------------------------------------------------------------------------------------------
    @cached_property
    def _pairs(self) -> list[tuple[int, int, float]]:
        """Numbers of cups whose distances are known, and these [mm]; of `monday/A` and `monday/B`, too."""
        split = [name.rpartition("/")[::2] for name, _ in self.at]
        return [
            (a, split.index((group, second)), length)
            for first, second, length in self.distances
            for a, (group, name) in enumerate(split)
            if name == first and (group, second) in split
        ]

    @cached_property
    def _tied(self) -> tuple[Array, dict[int, Array]]:
        """(3 C,) coordinates of all cups, nearest to `at` with the distances that are known; and coordinate that
        follows from the others -> by how much it closes each gap (k,), as there."""
        cups, k = np.array([place for _, place in self.at], dtype=float).reshape(-1, 3), len(self._pairs)
        one, other, lengths = np.array(self._pairs, dtype=float).reshape(k, 3).T
        ends, slopes = (one.astype(int), other.astype(int)), np.zeros((k, len(cups), 3))
        for _ in range(100):  # effort: distances that can be true are reached in a few steps
            across = cups[ends[1]] - cups[ends[0]]
            apart = np.linalg.norm(across, axis=1)
            for end, sign in zip(ends, (-1.0, 1.0), strict=True):
                slopes[np.arange(k), end] = sign * across / np.maximum(apart, TOUCHES)[:, None]
            if np.abs(apart - lengths).max(initial=0.0) < TOUCHES:
                break
            cups = cups - (np.linalg.pinv(slopes.reshape(k, -1), rcond=VISIBLE) @ (apart - lengths)).reshape(-1, 3)
        else:
            pairs = ", ".join(f"{self.at[a][0]} to {self.at[b][0]}" for a, b, _ in self._pairs)
            allowed = "allowed: distances that can all be true"
            raise InputError(f"instrument.distances_mm: no cups have all of the distances {pairs}, {allowed}")
        if not k:
            return cups.ravel(), {}
        from scipy.linalg import qr  # only cups with distances pay for the import

        table = slopes.reshape(k, -1)
        _, triangle, order = qr(table, mode="economic", pivoting=True)
        chosen = order[: np.count_nonzero(np.abs(np.diag(triangle)) > VISIBLE)]
        return cups.ravel(), dict(zip(chosen.tolist(), np.linalg.pinv(table[:, chosen], rcond=VISIBLE), strict=True))

    def _cups(self, values: ca.SX) -> list[ca.SX]:
        """Centers (3,) of all cups at values of the parameters."""
        starts, following = self._tied
        places, cups = ca.SX(ca.DM(starts)), [slice(3 * k, 3 * k + 3) for k in range(len(self.at))]
        places[[k for k in range(len(starts)) if k not in following]] = values
        for _ in range(4 if following else 0):  # effort: of Newton's method
            gaps = (ca.norm_2(places[cups[b]] - places[cups[a]]) - length for a, b, length in self._pairs)
            places[[*following]] -= ca.mtimes(ca.DM(np.array([*following.values()])), ca.vertcat(*gaps))
        return [places[cup] for cup in cups]

    # -- files ---------------------------------------------------------------------------------------------------------
    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Self:
        cups = tuple((name, tuple(map(float, place))) for name, place in (table.get("cups") or {}).items())
        return cls(cups, tuple((str(a), str(b), float(d)) for a, b, d in table.get("distances_mm") or ()))
