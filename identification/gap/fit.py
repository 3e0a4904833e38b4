"""Weighted nonlinear least squares of a model to rows, with physical bounds: Gauss-Newton with step halving."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from identification.arrays import Array
from identification.gap.f_tests import basis
from identification.gap.whitening import Rows
from identification.model import Model

ITERATIONS = 40
TOLERANCE = 1e-10  # relative decrease of the sum of squares that ends the iteration


@dataclass(frozen=True)
class Fit:
    """A fitted model, in whitened coordinates (N = m d).

    values : (p,) parameters;  residual : (N,);  jacobian : (N, p);  free : (p,) not held at a bound
    count : number of values estimated, fewer than p if some are tied to be equal
    """

    model: Model
    values: Array
    residual: Array
    jacobian: Array
    free: np.ndarray
    count: int

    @property
    def squares(self) -> float:
        """Sum of squared whitened residuals."""
        return float(self.residual @ self.residual)

    @cached_property
    def rank(self) -> int:
        """Number of parameter combinations that the data determine."""
        return int(basis(self.jacobian).shape[1])

    @property
    def freedom(self) -> int:
        """Degrees of freedom left; directions that the data do not determine cost none."""
        return len(self.residual) - self.rank

    @property
    def sigma(self) -> float:
        """Scale of the noise [mm] estimated from the residuals."""
        return float(np.sqrt(self.squares / max(self.freedom, 1)))

    @property
    def by_name(self) -> dict[str, float]:
        """Parameter name -> value."""
        return dict(zip(self.model.names, map(float, self.values), strict=True))

    def covariance(self, held: bool = True) -> Array:
        """(p, p) of the estimates, [unit of row x unit of column].

        held : parameters at a bound count as known, their rows and columns are zero, which suits predictions; False:
        as without bounds, which suits intervals: a bound that was met does not tell the value behind it
        """
        free = self.free if held else np.ones(len(self.values), dtype=bool)
        scaled = self.jacobian[:, free] / self.model.scales[free]
        root = np.linalg.pinv(scaled, rcond=1e-9) * self.sigma  # never a negative variance
        inverse = root @ root.T
        full = np.zeros((len(self.values), len(self.values)))
        full[np.ix_(free, free)] = inverse / np.outer(self.model.scales[free], self.model.scales[free])
        return full


def links_start(model: Model, rows: Rows) -> dict[str, float]:
    """Start values: position_i = sum_j exp(i theta_j) u_j + offset (identification/README.md, "Closed form")."""
    theta = np.cumsum(rows.postures, axis=1)
    columns = np.exp(1j * theta)
    offset = any(name.startswith("base_offset.") for name in model.names)
    if offset:
        columns = np.hstack([columns, np.ones((len(rows), 1))])
    u = np.linalg.lstsq(columns, rows.positions @ np.array([1.0, 1.0j]), rcond=1e-9)[0]
    n = model.arm.links
    lengths, turn = np.abs(u[:n]) - model.arm.lengths, np.angle(u[:n])
    offsets = np.angle(np.exp(1j * np.diff(turn, prepend=0.0)))
    start = {f"length_error:{j + 1}": float(lengths[j]) for j in range(n)}
    start |= {f"joint_offset:{j + 1}": float(offsets[j]) for j in range(n)}
    if offset:
        start |= {"base_offset.x0": float(u[n].real), "base_offset.y0": float(u[n].imag)}
    return start


def fit(model: Model, rows: Rows, start: dict[str, float], ties: Sequence[Sequence[str]] = ()) -> Fit:
    """Least squares from `start` (parameter name -> value, zero where missing) within the parameters' bounds.

    ties : groups of parameters that are equal (and share their bounds)
    """
    spread = _spread(model, ties)  # (p, z): parameters = spread @ z
    first = np.argmax(spread, axis=0)
    lower = np.array([p.lower for p in model.parameters])[first]
    upper = np.array([p.upper for p in model.parameters])[first]
    scales = model.scales[first]
    z = np.clip(np.array([start.get(name, 0.0) for name in model.names])[first], lower, upper)
    residual, jacobian = _linearise(model, rows, spread @ z)
    for _ in range(ITERATIONS):
        step, _ = _step(residual, jacobian @ spread / scales, z * scales, lower * scales, upper * scales)
        accepted = _descend(model, rows, z, step / scales, residual, lower, upper, spread)
        if accepted is None:
            break
        before = residual @ residual
        z = accepted
        residual, jacobian = _linearise(model, rows, spread @ z)
        if before - residual @ residual <= TOLERANCE * before:
            break
    free = _step(residual, jacobian @ spread / scales, z * scales, lower * scales, upper * scales)[1]
    return Fit(model, spread @ z, residual, jacobian, spread @ free > 0.0, len(z))


def _spread(model: Model, ties: Sequence[Sequence[str]]) -> Array:
    """(p, z) zeros and ones: one column per value estimated."""
    leader = {name: group[0] for group in ties for name in group}
    roots = [leader.get(name, name) for name in model.names]
    kept = list(dict.fromkeys(roots))
    spread = np.zeros((len(roots), len(kept)))
    spread[np.arange(len(roots)), [kept.index(root) for root in roots]] = 1.0
    return spread


def _linearise(model: Model, rows: Rows, values: Array) -> tuple[Array, Array]:
    position, jacobian = model.linearize(rows.postures, values, rows.conditions)
    return rows.whiten(rows.positions - position), rows.whiten(jacobian)


def _step(residual: Array, scaled: Array, at: Array, lower: Array, upper: Array) -> tuple[Array, np.ndarray]:
    """Gauss-Newton step in scaled parameters with the bounds respected, and which parameters are free in it."""
    free = np.ones(len(at), dtype=bool)
    step = np.zeros(len(at))
    low, high = lower - at, upper - at
    for _ in range(len(at) + 1):
        fixed = ~free
        target = residual - scaled[:, fixed] @ step[fixed]
        step[free] = np.linalg.lstsq(scaled[:, free], target, rcond=1e-11)[0]
        beyond = np.where(free, np.maximum(low - step, step - high), -np.inf)
        worst = int(np.argmax(beyond))
        if beyond[worst] <= 1e-12:
            break
        step[worst] = np.clip(step[worst], low[worst], high[worst])
        free[worst] = False
    return step, free


def _descend(
    model: Model, rows: Rows, z: Array, step: Array, residual: Array, lower: Array, upper: Array, spread: Array
) -> Array | None:
    """The longest of the step, its half, ... that lowers the sum of squares; None if none does."""
    squares = residual @ residual
    factor = 1.0
    for _ in range(12):
        trial = np.clip(z + factor * step, lower, upper)
        change = rows.whiten(rows.positions - model.position(rows.postures, spread @ trial, rows.conditions))
        if change @ change < squares:
            return np.asarray(trial)
        factor *= 0.5
    return None
