# ruff: noqa: F401 - what type checkers read
"""From measurements to parameters, and to the effect that is missing: the table of contents, imported on first use."""

import ast
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

# `simulate` and `compensate` are modules: from identification.simulate import simulate
if TYPE_CHECKING:  # isort: off
    # an arm, its model, its measurements
    from identification.arm import Arm, Calibration, EffectSpec, Gravity
    from identification.model import Model
    from identification.effects import library
    from identification.measurements import Conditions, Measurements, rms_distance
    from identification.kinematics.parameters import PRISMATIC, REVOLUTE, Parameter, ParameterSet
    from identification.kinematics.counting import turned_into
    from identification.kinematics.chain import DHRow, chain_of, planar_chain
    from identification.instruments.base import Coordinate, Instrument, register_instrument
    from identification.files.arm import load_arm, with_effects
    from identification.files.measurement import Plan, load_measurements
    from identification.workflow import load_sessions
    from identification.campaign import campaign_document

    # what data say
    from identification.estimation import Identification, estimate, estimate_batch
    from identification.gap.detectability import detectability
    from identification.gap.diagnose import diagnose
    from identification.gap.fit import fitted_arm
    from identification.gap.result import Diagnosis
    from identification.replications import Replications, StudyFile

    # what designs need
    from identification.for_design import ArmModel, design_model, with_points, without_prior
    from identification.information import log_determinants, spectrum

    # errors, progress, arrays
    from identification.errors import ArmcalError, InputError, JobError, nearest, require
    from identification.vectorized import vectorize
    from identification.levenberg_marquardt import newton_ascent
    from identification.running import Progress, Status, additions
    from identification.arrays import Array, readonly

_IMPORTS = (node for node in ast.walk(ast.parse(Path(__file__).read_text())) if isinstance(node, ast.ImportFrom))
_PLACES = {each.name: node.module for node in _IMPORTS if "." in str(node.module) for each in node.names}
__all__ = [*_PLACES]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(str(_PLACES[name])), name)


def __dir__() -> list[str]:
    return __all__
