"""Optimal design of calibration experiments: criteria, solvers, certificates (imported on first use)."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PLACES = {
    "D": "doe.criteria",
    "Design": "doe.design",
    "DesignProblem": "doe.problem.problem",
    "Plan": "identification",
    "load_plan": "identification",
    "score": "doe.design",
    "score_plan": "doe.design",
    "solve": "doe.solvers",
}
__all__ = sorted(_PLACES)


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return __all__
