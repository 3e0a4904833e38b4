"""What a solver is: a small frozen settings object whose one method offers plans. `solve` does everything else."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple, Protocol

from numpy.random import Generator

from doe.problem.problem import DesignProblem
from identification import Array

LONG_PLAN = 100  # runs above which a search has a time limit of its own
LONG_PLAN_SECONDS = 30.0


class Offer(NamedTuple):
    """A plan that a solver offers.

    postures : (m, n) [rad];  starts : how many starts have come to their end with this offer
    independent : True for the end of a local search that knew nothing of the others; many that agree end the job
    """

    postures: Array
    starts: int = 0
    independent: bool = False


@dataclass(frozen=True)
class Budget:
    """How long to search.

    starts : number of starts, at most;  deadline : value of `perf_counter` at which to stop
    tell : called whenever it is asked: a step of an arm with bodies takes seconds, and a start minutes
    """

    starts: int
    deadline: float = math.inf
    tell: Callable[[], object] = lambda: None

    def ended(self) -> bool:
        """True once the time is up."""
        self.tell()
        return perf_counter() >= self.deadline


class Solver(Protocol):
    """Settings, a name, and one method that offers plans, better and better or not; `solve` keeps the best.

    A solver need not clip, certify, count or watch for Ctrl-C. It should look at `budget.ended()` between steps of
    more than a few milliseconds, and yield whenever it has a plan that may be the best. It must be deterministic given
    the generator, as long as the time limit does not bind.
    """

    @property
    def name(self) -> str: ...

    def starts_for(self, problem: DesignProblem) -> int:
        """Default number of starts."""
        ...

    def offers(self, problem: DesignProblem, runs: int, generator: Generator, budget: Budget) -> Iterator[Offer]: ...
