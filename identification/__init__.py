"""From measurements to parameters, and to the effect that is missing (imported on first use)."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PLACES = {  # `simulate` and `compensate` are modules of that name: from identification.simulate import simulate
    "Arm": "identification.arm",
    "Calibration": "identification.arm",
    "Conditions": "identification.measurements",
    "EffectSpec": "identification.arm",
    "Gravity": "identification.arm",
    "Identification": "identification.estimation",
    "Measurements": "identification.measurements",
    "Model": "identification.model",
    "diagnose": "identification.gap.diagnose",
    "estimate": "identification.estimation",
    "load_arm": "identification.files.arm",
    "load_measurements": "identification.files.measurement",
}
__all__ = sorted(_PLACES)


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return __all__
