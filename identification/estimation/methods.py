"""The methods of estimation by name: closed form, damped Gauss-Newton, and the paper's own steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.estimation.levenberg_marquardt import Index, Solution, levenberg_marquardt, outcomes
from identification.estimation.paper_steps import paper_steps
from identification.estimation.problem import Problem
from identification.instruments import Instrument
from identification.model import Model
from identification.status import Status


def linear(problem: Problem) -> Solution:
    """Exact global minimiser of a model with a closed form. Raises `InputError` for any other model."""
    form = problem.exact_form
    if form is None:
        allowed = "lengths and offsets, nothing known, and no effect but base_offset; use gauss_newton"
        raise InputError(f"method: linear does not fit this model, allowed: {allowed}")
    parameters, squares = form.solver(problem.postures, problem.weights, problem.tolerance)(problem.positions)
    status = outcomes(np.isfinite(squares), Status.converged, Status.solver_failed)
    return Solution(parameters, squares, np.zeros(parameters.shape, dtype=bool), status, np.ones(len(squares), int))


def damped_gauss_newton(problem: Problem) -> Solution:
    """A stationary point within the bounds, by damped Gauss-Newton steps (Levenberg-Marquardt) from `starts`."""
    return levenberg_marquardt(problem.least_squares, starts(problem))


METHODS: Mapping[str, Callable[[Problem], Solution]] = {
    "linear": linear,
    "gauss_newton": damped_gauss_newton,
    "paper_steps": paper_steps,
}


def starts(problem: Problem) -> Array:
    """(K, p) the closed form of the model without its effects, or the best known values where those fit better.

    The closed form makes any size of joint offset harmless: it is the global minimiser of the model without effects.
    """
    best_known = np.tile(problem.start, (len(problem.positions), 1))
    chain = problem.model.arm.chain if isinstance(problem.model, Model) else None
    if chain is not None:
        own = {parameter.name for parameter in chain.instrument.parameters}
        if numbers := [k for k, name in enumerate(problem.model.names) if name in own]:
            return _with_instrument(problem, best_known, chain.instrument, numbers)
    form = problem.model.closed_form
    if form is None:
        return best_known
    solved = best_known.copy()
    solved[:, form.indices] = form.solver(problem.postures, problem.weights, problem.tolerance)(problem.positions)[0]
    if not np.any(problem.start):
        return solved  # nothing is known that the closed form does not know
    return np.where((problem.squares(best_known) < problem.squares(solved))[:, None], best_known, solved)


def _with_instrument(problem: Problem, starts: Array, instrument: Instrument, own: list[int]) -> Array:
    """(K, p) starts (K, p) with the parameters of the instrument, whose numbers are `own`, as they explain the readings
    best, and all others as they fit best with those of them that the instrument holds first."""
    least = problem.least_squares
    starts, held = instrument.settled(starts, problem.residuals, own)

    def linearize(parameters: Array, index: Index) -> tuple[Array, Array]:
        residuals, jacobian = least.linearize(parameters, index)
        jacobian[..., held] = 0.0
        return residuals, jacobian

    return levenberg_marquardt(replace(least, linearize=linearize), starts).parameters if held else starts
