"""Optimal design of calibration experiments: criteria, solvers, certificates (imported on first use)."""

from importlib import import_module
from types import MappingProxyType
from typing import Any

_PLACES = {
    "D": "doe.criteria",
    "Design": "doe.design",
    "DesignProblem": "doe.problem.problem",
    "Plan": "identification",
    "score": "doe.design",
    "score_plan": "doe.design",
    "solve": "doe.solvers",
}
__all__ = sorted(_PLACES)
# what the environment of a new process says for one thread
SINGLE_THREAD = MappingProxyType(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return __all__
