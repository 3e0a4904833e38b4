"""How a search or a fit ended. Every member is its own sentence, saying what to do next."""

from __future__ import annotations

from enum import Enum


class Status(Enum):
    """Outcome of an iterative search or fit; `name` goes into JSON, `value` is the sentence shown to people."""

    bound_reached = "The upper bound is reached: no plan with this many runs can be better."
    starts_finished = "All starts are used up; more of them (--starts) might find a better plan."
    agreed = "Many independent starts ended at the same best value; more starts are unlikely to find a better plan."
    local_optimum = "No single exchange improves the plan; another --seed may lead to a better one."
    time_limit = "The time budget ended; the best plan so far is returned. Raise --seconds to keep searching."
    interrupted = "Stopped by the user (Ctrl-C, SIGTERM); the best plan so far is returned."
    scored = "Plan supplied by the user: evaluated, not optimized."
    converged = "Converged."
    almost_solved = "Stopped near a solution at reduced accuracy; check the optimality gap before relying on it."
    iteration_limit = "The iteration limit was reached before convergence; look at the residuals."
    solver_failed = "The solver failed; its result is not used."
    not_identifiable = (
        "Some parameters are not identifiable; the others hold. Measure more varied postures, or fix one "
        "per combination."
    )
    implausible = "Converged to an arm that cannot be the real one; check arm, frame and units before using it."
    infeasible = "No feasible point was found."

    @property
    def succeeded(self) -> bool:
        """True if a usable result exists (it may still be improvable)."""
        return self not in (Status.solver_failed, Status.infeasible)
