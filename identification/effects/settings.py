"""Settings of effects: numbers that are chosen rather than estimated, and the values that a scan tries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.measurements import Conditions

SESSION = 1.1  # from one session to the next on the clock of steps, a gap of 0.1 between them
DIGITS = 6  # of a value, significant: labels and files hold it exactly


@dataclass(frozen=True)
class Scope:
    """Information from which the values of a setting may be computed: the arm, the joint (from 1), and the data.

    postures : (m, n) [rad], None without data;  conditions : of these rows
    """

    arm: Arm
    joint: int | None = None
    postures: Array | None = None
    conditions: Conditions = field(default_factory=Conditions)


Values = Sequence[float] | Callable[[Scope], Sequence[float]]


@dataclass(frozen=True)
class Setting:
    """A number that is chosen rather than estimated: the order of a wave, the time of a step, a time constant.

    low, high : range allowed in an arm file
    values : to try in `diagnose`, a list or a function of `Scope`; None: all whole numbers from low to high
    whole : whole numbers only
    symbolic : True if the effect's formula accepts a CasADi symbol, so that one function serves all values; False if it
        needs the number itself, as in `range(k)`
    """

    low: float
    high: float
    values: Values | None = None
    whole: bool = False
    symbolic: bool = True

    @classmethod
    def of(cls, setting: Setting | tuple[int, int]) -> Setting:
        """A setting unchanged; a pair (low, high) as the setting of all whole numbers in between."""
        return setting if isinstance(setting, cls) else cls(*setting, whole=True, symbolic=False)  # type: ignore[misc]

    def scan(self, scope: Scope) -> list[float]:
        """The distinct values to try, ascending, rounded as in labels and files."""
        if self.values is None:
            return [float(k) for k in range(int(self.low), int(self.high) + 1)]
        values = self.values(scope) if callable(self.values) else self.values
        kept = {float(f"{value:.{DIGITS}g}") for value in values if self.allows(value)}
        return sorted(kept)

    def allows(self, value: float) -> bool:
        """Whether this value is allowed in an arm file."""
        return self.low <= value <= self.high and not (self.whole and value != np.round(value))

    @property
    def allowed(self) -> str:
        """The allowed range in words, for error messages."""
        return f"a {'whole ' if self.whole else ''}number {self.low:g} to {self.high:g}"


def clock(time: Any, session: Any) -> Any:
    """Common time of all sessions: -0.5 to 0.5 in the first, 1.1 later in each further one.

    time, session : numbers, arrays or CasADi symbols
    """
    return time + SESSION * session


def step_times(scope: Scope) -> list[float]:
    """Times to try for a step: between rows, evenly spaced, and between sessions."""
    time = scope.conditions.time
    if time is None or np.ptp(time) == 0.0:
        return list(np.linspace(-0.5, 0.5, 40)[2:-2])
    sessions = np.zeros(len(time)) if scope.conditions.session is None else scope.conditions.session
    values = np.unique(clock(time, sessions))
    between = 0.5 * (values[1:] + values[:-1])
    first = int(np.ceil(0.05 * len(between)))  # at either end a step would be a few rows
    inner = between[first : len(between) - first] if 2 * first < len(between) else between
    count = 100 if len(between) <= 400 else 40  # effort: of many rows fewer
    spread = inner[np.unique(np.linspace(0, len(inner) - 1, count).round().astype(int))]
    return [*spread, *((np.unique(sessions)[1:] - 0.5) * SESSION)]
