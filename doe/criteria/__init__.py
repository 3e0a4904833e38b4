"""Criteria of optimality: one small protocol, one file for each family of criteria."""

from __future__ import annotations

from collections.abc import Sequence

from doe.criteria.criterion import Criterion
from doe.criteria.log_determinants import D, Ds, DStar
from doe.criteria.variances import A, E, I, PowerMean
from identification import Array, InputError, nearest

__all__ = ["NAMES", "A", "Criterion", "D", "DStar", "Ds", "E", "I", "PowerMean", "criterion"]

NAMES = ("D", "A", "E", "I", "Ds", "Dstar")


def criterion(
    name: str,
    *,
    units: Sequence[str] = (),
    subset: Sequence[int] | None = None,
    test_jacobians: Array | None = None,
) -> Criterion:
    """The criterion of a name as in `--criterion`.

    units : of the p parameters, for Dstar;  subset : indices (from 0) of the parameters that matter, for Ds
    test_jacobians : (k, d, p) `DesignProblem.scaled_jacobians` at the test poses, for I
    Raises `InputError` for an unknown name, and where what the criterion needs is missing.
    """
    if name not in NAMES:
        raise InputError(f"criterion: unknown name {name!r}, {nearest(name, NAMES)}")
    if name == "I":
        if test_jacobians is None or not len(test_jacobians):
            raise InputError("criterion: I needs test poses, none are given, allowed: at least one posture")
        return I(test_jacobians)
    if name == "Ds":
        if not subset or not set(subset) <= set(range(len(units) or max(subset) + 1)):
            chosen = list(subset) if subset else "none"
            raise InputError(f"criterion: Ds needs a subset of the parameters, found {chosen}, allowed: at least one")
        return Ds(tuple(subset))
    if name == "Dstar":
        return DStar.by_unit(units)
    plain: dict[str, Criterion] = {"D": D(), "A": A(), "E": E()}
    return plain[name]
