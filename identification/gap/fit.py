"""Weighted nonlinear least squares of a model to rows, with physical bounds: Gauss-Newton with step halving."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from identification.arm import Array
from identification.gap.linear import basis
from identification.gap.whitening import Rows
from identification.model import Model

ITERATIONS = 40
TOLERANCE = 1e-10  # relative decrease of the sum of squares that ends the iteration


@dataclass(frozen=True)
class Fit:
    """A fitted model, in whitened coordinates (N = 2m).

    values : (p,) parameters;  residual : (N,);  jacobian : (N, p);  free : (p,) not held at a bound
    """

    model: Model
    values: Array
    residual: Array
    jacobian: Array
    free: np.ndarray

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

    def covariance(self) -> Array:
        """(p, p) of the estimates; rows and columns of parameters at a bound are zero."""
        scaled = self.jacobian[:, self.free] / self.model.scales[self.free]
        inverse = np.linalg.pinv(scaled.T @ scaled) * self.sigma**2
        full = np.zeros((len(self.values), len(self.values)))
        full[np.ix_(self.free, self.free)] = inverse / np.outer(self.model.scales[self.free], self.model.scales[self.free])
        return full


def links_start(model: Model, rows: Rows) -> dict[str, float]:
    """Start values from the closed form position_i = sum_j exp(i theta_j) u_j + offset (THEORY.md, section 2)."""
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


def fit(model: Model, rows: Rows, start: dict[str, float]) -> Fit:
    """Least squares from `start` (parameter name -> value, zero where missing) within the parameters' bounds."""
    lower = np.array([p.lower for p in model.parameters])
    upper = np.array([p.upper for p in model.parameters])
    values = np.clip([start.get(name, 0.0) for name in model.names], lower, upper)
    residual, jacobian = _linearise(model, rows, values)
    for _ in range(ITERATIONS):
        step, free = _step(residual, jacobian / model.scales, values * model.scales, lower, upper, model.scales)
        accepted = _descend(model, rows, values, step / model.scales, residual, lower, upper)
        if accepted is None:
            break
        before = residual @ residual
        values = accepted
        residual, jacobian = _linearise(model, rows, values)
        if before - residual @ residual <= TOLERANCE * before:
            break
    free = _step(residual, jacobian / model.scales, values * model.scales, lower, upper, model.scales)[1]
    return Fit(model, values, residual, jacobian, free)


def _linearise(model: Model, rows: Rows, values: Array) -> tuple[Array, Array]:
    position, jacobian = model.linearise(rows.postures, values, rows.conditions)
    return rows.whiten(rows.positions - position), rows.whiten(jacobian)


def _step(
    residual: Array, scaled: Array, at: Array, lower: Array, upper: Array, scales: Array
) -> tuple[Array, np.ndarray]:
    """Gauss-Newton step in scaled parameters with the bounds respected, and which parameters are free in it."""
    free = np.ones(len(at), dtype=bool)
    step = np.zeros(len(at))
    low, high = lower * scales - at, upper * scales - at
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
    model: Model, rows: Rows, values: Array, step: Array, residual: Array, lower: Array, upper: Array
) -> Array | None:
    """The longest of the step, its half, ... that lowers the sum of squares; None if none does."""
    squares = residual @ residual
    factor = 1.0
    for _ in range(12):
        trial = np.clip(values + factor * step, lower, upper)
        change = rows.whiten(rows.positions - model.position(rows.postures, trial, rows.conditions))
        if change @ change < squares:
            return np.asarray(trial)
        factor *= 0.5
    return None
