"""From weights to whole numbers of runs: efficient apportionment, which loses least in the worst case.

F. Pukelsheim, S. Rieder, "Efficient rounding of approximate designs", Biometrika 79 (1992): start from
ceil((m - k/2) w_i) runs on each of the k support postures; while there are too few, add one where n_i / w_i is
smallest, while too many, take one where (n_i - 1) / w_i is largest. No rounding has a better guaranteed efficiency.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from doe.plan.plan import Plan
from identification.arrays import Array
from identification.errors import InputError

SUM = 1e-6  # by which the weights may miss one


def apportion(weights: Array, runs: int) -> NDArray[np.int64]:
    """(k,) whole numbers that sum to `runs`, near runs * weights; at least one each where runs >= k.

    weights : (k,) positive, summing to one. With fewer runs than postures only the heaviest `runs` get one.
    """
    shares = np.asarray(weights, dtype=float)
    if not np.all(shares > 0.0) or abs(shares.sum() - 1.0) > SUM:
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


def rounded_plan(plan: Plan, runs: int) -> Array:
    """(runs, n) postures of an approximate design, each as often as its weight asks for."""
    carried = plan.shares > 0.0
    numbers = apportion(plan.shares[carried] / plan.shares[carried].sum(), runs)
    return np.repeat(plan.postures[carried], numbers, axis=0)
