"""The closed form (identification/README.md, "Closed form"): the paper says there is none, but eq. 1 is linear in u_j.

With u_j = (l_j + dl_j) exp(i dtheta_j) the tip is sum_j exp(i theta_j) u_j (+ x0 + i y0): a complex linear
least-squares problem. Its solution is the exact global minimiser of eq. 3, then dl_j = |u_j| - l_j and
dtheta_j = arg u_j. Where postures lose a combination, the solution nearest to the nominal arm is taken.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import InputError
from identification.estimation.problem import Fit, Problem
from identification.model import Model
from identification.status import Status

Complex = NDArray[np.complex128]


def linear(problem: Problem) -> Fit:
    """Exact global minimiser of a model that is linear in its links. Raises `InputError` for any other model."""
    model = problem.model
    if not model.linear_in_links:
        allowed = "lengths and offsets, nothing known, and no effect but base_offset; use gauss_newton"
        raise InputError(f"method: linear does not fit this model, allowed: {allowed}")
    columns, nominal = design(model, problem.measurements.postures)
    measured = as_complex(problem.measurements.positions)
    root = problem.root_weights
    rest = root[:, 0] * (measured - columns @ nominal)
    change = np.linalg.lstsq(root * columns, rest, rcond=problem.tolerance)[0]
    return Fit(parameters_of(model, nominal + change), Status.converged, 1)


def as_complex(positions: Array) -> Complex:
    """(..., 2) coordinates as (...) complex numbers x + iy, without a copy where memory allows."""
    return np.ascontiguousarray(positions, dtype=float).view(np.complex128)[..., 0]


def design(model: Model, postures: Array) -> tuple[Complex, Complex]:
    """(m, n) columns exp(i theta_j), with a column of ones for a base offset, and the nominal unknowns (l_j, 0)."""
    columns = np.exp(1j * np.cumsum(np.atleast_2d(postures), axis=1))
    nominal = model.arm.lengths.astype(complex)
    if model.effects:
        columns = np.column_stack([columns, np.ones(len(columns))])
        nominal = np.r_[nominal, 0.0]
    return columns, nominal


def parameters_of(model: Model, unknowns: Complex) -> Array:
    """(..., p) parameters dl_j, dq_j and base offset of the unknowns (..., n or n + 1); dq_j in (-pi, pi]."""
    n = model.arm.links
    u = unknowns[..., :n]
    # dq_j = arg u_j - arg u_(j-1) as one argument, so that it needs no wrapping
    turned = u.copy()
    turned[..., 1:] *= np.conj(u[..., :-1])
    parts = [np.abs(u) - model.arm.lengths, np.angle(turned)]
    if unknowns.shape[-1] > n:
        parts += [unknowns[..., n:].real, unknowns[..., n:].imag]
    return np.concatenate(parts, axis=-1)
