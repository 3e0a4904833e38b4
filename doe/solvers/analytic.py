"""D-optimal plans from theory: characters of a finite group, where the joint limits and the number of runs allow.

Number the m runs by the elements of a group G = Z_2^t x Z_(m / 2^t). A joint moves in one of two ways.

- *Turning*: q_j = phase + angle of a character g_j of G: k equally spaced angles, k the order of g_j, in a range of
  (1 - 1/k) 2 pi at least. A character other than 1 has mean zero over G.
- *Two levels*: range below pi; q_j at its lower or upper limit, chosen by a character s_j of order two:
  exp(i q_j) = exp(i middle) (cos h + i s_j sin h), 2 h the range.

The bound (`doe.closed_form`) is attained when every E exp(i (q_(j+1) + ... + q_k)) is the product of its factors'
means. Multiplied out, that is a sum of characters, each the turning joints' product times a subset of the s_j; all of
them but the empty one must differ from 1. Let R be the characters that occur in the sums ending at joint j, and 1
itself. A turning joint needs -g_j outside R, a two-level joint s_j outside R; then R becomes (R + g_j) + {0}, or
R + (R + s_j).

With no limits this gives theta_j = 2 pi i f_j / m with distinct random frequencies f_j and random phases: any columns
of the DFT matrix (THEORY.md section 3), in shuffled order, since the plan f_j = j hides missing effects (GAP.md). With
all ranges below pi it gives the two-level factorial, 2^(joints) runs or a multiple.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import gcd, lcm

import numpy as np
from numpy.typing import NDArray

from doe.closed_form import applies, chain_joints
from doe.problem import DesignProblem
from doe.solvers.base import Budget, Offer, free_values
from identification.arm import Array

Character = tuple[int, ...]
ROUNDING = 1e-9  # [rad] by which a range may fall short of what a character needs


@dataclass(frozen=True)
class Analytic:
    """Random plans that attain the closed-form bound; none where the limits or the number of runs do not allow any."""

    tries: int = 100
    name: str = "analytic"

    def starts_for(self, problem: DesignProblem) -> int:
        """One: any such plan is optimal."""
        return 1

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """One plan per start, as long as any is found."""
        if not applies(problem) or problem.constraints:
            return
        while (plan := self._plan(problem, runs, generator)) is not None:
            yield Offer(plan, 1)

    def _plan(self, problem: DesignProblem, runs: int, generator: np.random.Generator) -> Array | None:
        groups = [Group(moduli) for moduli in moduli_of(runs)]
        for _ in range(self.tries):
            group = groups[generator.integers(len(groups))]
            angles = chain(problem, group, generator)
            if angles is not None:
                plan = np.tile(free_values(problem), (runs, 1))
                plan[:, list(chain_joints(problem))] = angles
                return generator.permutation(plan)
        return None


def moduli_of(runs: int) -> list[Character]:
    """The groups Z_2^t x Z_(m / 2^t) of m elements, as lists of moduli."""
    groups: list[Character] = [(runs,)]
    twos = 0
    while runs % 2 ** (twos + 1) == 0:
        twos += 1
        groups.append((2,) * twos + (runs // 2**twos,))
    return groups


class Group:
    """A finite abelian group, its elements and its characters, both as tuples of residues."""

    def __init__(self, moduli: Character) -> None:
        self.moduli = moduli
        self.elements = np.indices(moduli).reshape(len(moduli), -1).T
        self.zero: Character = (0,) * len(moduli)

    @property
    def characters(self) -> list[Character]:
        """All characters but 1."""
        return [c for c in map(tuple, self.elements.tolist()) if c != self.zero]

    def order(self, character: Character) -> int:
        """Number of different values of a character."""
        return lcm(*(m // gcd(c, m) for c, m in zip(character, self.moduli, strict=True)))

    def add(self, a: Character, b: Character) -> Character:
        """Product of two characters."""
        return tuple((x + y) % m for x, y, m in zip(a, b, self.moduli, strict=True))

    def minus(self, a: Character) -> Character:
        """Inverse of a character."""
        return tuple(-x % m for x, m in zip(a, self.moduli, strict=True))

    def steps(self, character: Character) -> NDArray[np.int64]:
        """(m,) whole numbers r in 0..k-1: the character's angle at every element is 2 pi r / k."""
        k = self.order(character)
        turns = np.array(character) * k // np.array(self.moduli)  # whole numbers, by the definition of the order k
        return np.asarray(self.elements @ turns % k)


def chain(problem: DesignProblem, group: Group, generator: np.random.Generator) -> Array | None:
    """(m, joints) angles of one random choice of characters, or None where it runs into a dead end."""
    reached = {group.zero}
    columns = []
    for joint in chain_joints(problem):
        lower, upper = problem.lower[joint], problem.upper[joint]
        if upper - lower < np.pi - ROUNDING:
            free = [c for c in group.characters if group.order(c) == 2 and c not in reached]
        else:
            free = [
                c
                for c in group.characters
                if group.minus(c) not in reached and room(upper - lower, group.order(c)) >= -ROUNDING
            ]
        if not free:
            return None
        chosen = free[generator.integers(len(free))]
        moved = {group.add(c, chosen) for c in reached}
        if upper - lower < np.pi - ROUNDING:
            columns.append(np.where(group.steps(chosen) == 1, upper, lower))
            reached |= moved
        else:
            columns.append(turning(lower, upper, group, chosen, generator))
            reached = moved | {group.zero}
    return np.array(columns).T


def room(width: float, order: int) -> float:
    """What `order` equally spaced angles leave of a range of this width [rad]."""
    return width - (1.0 - 1.0 / order) * 2.0 * np.pi


def turning(lower: float, upper: float, group: Group, character: Character, generator: np.random.Generator) -> Array:
    """(m,) angles of a turning joint, phase and direction random."""
    order = group.order(character)
    phase = lower + generator.uniform(0.0, max(room(upper - lower, order), 0.0))
    return np.minimum(phase + 2.0 * np.pi * group.steps(character) / order, upper)
