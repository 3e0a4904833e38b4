"""A plan: the postures to measure, in the order of measurement, or an approximate design with weights; its file; whole
numbers of runs for weights; and the order of measurement.

*Whole numbers.* F. Pukelsheim, S. Rieder, "Efficient rounding of approximate designs", Biometrika 79 (1992): start from
ceil((m - k/2) w_i) runs on each of the k support postures; while there are too few, add one where n_i / w_i is
smallest, while too many, take one where (n_i - 1) / w_i is largest. No rounding has a better guaranteed efficiency.

*Order.* It changes no information, but travel time and what drift can hide. The shortest joint travel is a travelling
salesman's open path: an edge i-k costs the time that the slowest joint needs, max_j |q_ij - q_kj| / speed_j. It is
solved as an integer program by HiGHS (in scipy): two edges at every posture (a dummy posture at no cost joins the
ends), and a cut for every closed loop that appears (Dantzig, Fulkerson, Johnson 1954). Long plans get a locally best
path instead: no two edges can be exchanged with gain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification import (
    Array,
    ByValue,
    InputError,
    frame_of_columns,
    nearest,
    plan_file_text,
    posture_columns,
    read_plan,
    readonly,
)

ORDERS = ("given", "random", "travel")
Path = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Plan(ByValue):
    """m postures of an n-link arm.

    postures : (m, n) joint angles [rad], of prismatic joints positions [mm]
    weights : (m,) shares of the measurements, summing to one, None: an exact plan, every row is one measurement
    joint_types : (n) `revolute` or `prismatic`, empty: all revolute; `JointKinds` say how files count them
    fit : how its measurements are to be fitted, as options of `armcal identify`; empty: by the model of the arm file
    """

    postures: Array
    weights: Array | None = None
    joint_types: tuple[str, ...] = ()
    fit: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "postures", readonly(np.atleast_2d(self.postures)))
        if self.weights is not None:
            object.__setattr__(self, "weights", readonly(self.weights))

    def __len__(self) -> int:
        return len(self.postures)

    @property
    def links(self) -> int:
        """n, the number of joints."""
        return int(self.postures.shape[1])

    @property
    def shares(self) -> Array:
        """(m,) weight of every posture; 1/m for an exact plan."""
        return np.full(len(self), 1.0 / len(self)) if self.weights is None else self.weights

    @property
    def columns(self) -> dict[str, Any]:
        """Name, with the unit in which it is shown, -> (m,) positions of each joint, as the controller counts."""
        return posture_columns(self.postures, self.joint_types or None)

    @property
    def units(self) -> tuple[str, ...]:
        """(n) units in which joints are shown: deg, or mm."""
        return tuple(name.partition("_")[2] for name in self.columns)

    @property
    def displayed(self) -> Array:
        """(m, n) postures in `units`, as the controller counts."""
        return readonly(np.column_stack([*self.columns.values()]))

    def to_frame(self, kind: str = "polars") -> Any:
        """A row for each posture, as in a plan file; polars or pandas."""
        columns = {"run": range(1, len(self) + 1)} | self.columns
        return frame_of_columns(columns if self.weights is None else columns | {"weight": self.weights}, kind)

    def to_html(self, caption: object) -> str:
        """A caption and the postures, for notebooks."""
        return f"<pre>{escape(str(caption))}</pre>\n{self._repr_html_()}"

    def _repr_html_(self) -> str:
        from polars import Config

        with Config(tbl_rows=-1, tbl_cols=-1, tbl_hide_column_data_types=True):
            return str(self.to_frame()._repr_html_())


# -- files: CSV in degrees ---------------------------------------------------------------------------------------------
def load_plan(path: str | PathLike[str], joints: int | Sequence[str] | None = None) -> Plan:
    """The plan of a CSV file `run,q1_deg,...,qn_deg[,weight]`, rows in the order of measurement, `# fit: ...` above.

    joints : how many the arm has, or the type of each: a prismatic one has a column `q1_mm`

    Raises `InputError`, one line naming file, row and column, what was found and what is allowed. Warns (`UserWarning`)
    once about columns that are not used.
    """
    file = read_plan(path, joints)
    return Plan(file.postures, file.weights, fit=file.fit)


def plan_text(
    plan: Plan, joint_types: int | Sequence[str] | None = None, columns: Mapping[str, Sequence[str]] | None = None
) -> str:
    """The text of a plan file; `load_plan` reads the same from it, to rounding (1e-14 rad).

    columns : of names, (m,) each, that are written besides
    """
    return plan_file_text(plan.postures, plan.weights, plan.fit, joint_types, columns)


# -- from weights to whole numbers of runs -----------------------------------------------------------------------------
def apportion(weights: Array, runs: int) -> NDArray[np.int64]:
    """(k,) whole numbers that sum to `runs`, near runs * weights; at least one each where runs >= k.

    weights : (k,) positive, summing to one. With fewer runs than postures only the heaviest `runs` get one.
    """
    shares = np.asarray(weights, dtype=float)
    if not np.all(shares > 0.0) or abs(shares.sum() - 1.0) > 1e-6:  # more than rounding of a file
        raise InputError(f"weights: sum {shares.sum():g}, smallest {shares.min():g}, allowed: positive, sum one")
    if runs <= len(shares):
        heaviest = np.argsort(-shares, kind="stable")[:runs]
        return np.isin(np.arange(len(shares)), heaviest).astype(np.int64)
    numbers = np.ceil((runs - len(shares) / 2.0) * shares).astype(np.int64)
    while numbers.sum() < runs:
        numbers[np.argmin(numbers / shares)] += 1
    while numbers.sum() > runs:
        numbers[np.argmax((numbers - 1) / shares)] -= 1
    return numbers


# -- order of measurement ----------------------------------------------------------------------------------------------
def check_order(order: str | None) -> None:
    """Raises `InputError` with the nearest name for an unknown order."""
    if order is not None and order not in ORDERS:
        raise InputError(f"order: unknown {order!r}, {nearest(order, ORDERS)}")


def ordered(plan: Plan, order: str = "travel", *, seed: int = 0, speeds: Array | None = None) -> Plan:
    """The plan in another order: `given`, `random`, or `travel` (shortest).

    speeds : (n,) joint speeds [rad/s], None: all the same. Raises `InputError` for an unknown order.
    """
    check_order(order)
    rows = np.arange(len(plan))
    if order == "random":
        rows = np.random.default_rng(seed).permutation(rows)
    elif order == "travel" and len(plan) > 1:
        rows = shortest_path(plan.postures, speeds)
    weights = None if plan.weights is None else plan.weights[rows]
    return replace(plan, postures=plan.postures[rows], weights=weights)


def travel(postures: Array, speeds: Array | None = None) -> float:
    """Time [s] to go through the postures (m, n) [rad] in their order; largest joint travel [rad] without speeds."""
    moves = np.abs(np.diff(postures if speeds is None else postures / speeds, axis=0))
    return float(moves.max(axis=1).sum())


def shortest_path(postures: Array, speeds: Array | None = None) -> Path:
    """(m,) rows in the order of the shortest open path; never longer than the order given."""
    scaled, m = postures if speeds is None else postures / speeds, len(postures)
    cost = np.abs(scaled[:, None] - scaled).max(axis=-1)
    padded = np.pad(cost, (0, 1))  # the last row is the dummy posture that joins the ends
    starts = [np.arange(m)]
    for first in range(0, m, max(1, m // 20)):  # always on to the nearest posture not yet visited
        left, path = np.ones(m, dtype=bool), [first]
        left[first] = False
        while left.any():
            path.append(int(np.argmin(np.where(left, cost[path[-1]], np.inf))))
            left[path[-1]] = False
        starts.append(np.array(path))
    paths = [_two_opt(padded, start) for start in starts]
    if 3 < m <= 40 and (proven := _exact_path(padded)) is not None:  # up to where proof takes a fraction of a second
        paths.append(proven)
    return min(paths, key=lambda path: float(cost[path[:-1], path[1:]].sum()))


def _two_opt(padded: Array, path: Path) -> Path:
    """2-opt on an open path: stretches are reversed as long as that shortens it."""
    tour = np.append(path, len(path))
    while True:
        a, b = tour, np.roll(tour, -1)
        gain = padded[a, b][:, None] + padded[a, b] - padded[np.ix_(a, a)] - padded[np.ix_(b, b)]
        i, k = np.unravel_index(np.argmax(np.triu(gain, 1)), gain.shape)
        if gain[i, k] <= 1e-12 * (1.0 + padded.max()) or i >= k:
            break
        tour[i + 1 : k + 1] = tour[i + 1 : k + 1][::-1]
    end = int(np.flatnonzero(tour == len(path))[0])
    return np.concatenate([tour[end + 1 :], tour[:end]])


def _exact_path(padded: Array) -> Path | None:
    """The shortest open path with proof of optimality; None if HiGHS or the rounds of cuts do not finish."""
    from scipy.optimize import LinearConstraint, milp
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, depth_first_order

    m = len(padded) - 1
    first, second = np.triu_indices(m + 1, 1)
    incidence = (first == np.arange(m + 1)[:, None]) | (second == np.arange(m + 1)[:, None])
    constraints = [LinearConstraint(incidence.astype(float), 2.0, 2.0)]
    whole, effort = np.ones(first.size), {"node_limit": 2000}
    for _ in range(60):  # of cuts
        solved = milp(padded[first, second], constraints=constraints, integrality=whole, bounds=(0, 1), options=effort)
        if solved.x is None or solved.status != 0:
            return None
        edges = solved.x > 0.5
        graph = coo_array((np.ones(int(edges.sum())), (first[edges], second[edges])), shape=padded.shape)
        loops, labels = connected_components(graph, directed=False)
        if loops == 1:
            return depth_first_order(graph, m, directed=False)[0][1:]
        for loop in range(loops):
            inside = ((labels[first] == loop) & (labels[second] == loop)).astype(float)
            constraints.append(LinearConstraint(inside[None], -np.inf, float(np.sum(labels == loop)) - 1.0))
    return None
