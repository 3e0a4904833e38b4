# ruff: noqa: F401 - what type checkers read
"""From measurements to parameters, and to the effect that is missing: the table of contents, imported on first use."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

_CONTENTS = {  # module -> names; `simulate` and `compensate` are modules: from identification.simulate import simulate
    # an arm, its model, its measurements
    "arm": "Arm Calibration EffectSpec Gravity",
    "model": "Model",
    "effects": "library",
    "measurements": "Conditions Measurements load_measurements rms_distance",
    "kinematics.parameters": "EFFECT GEOMETRY JOINT_OFFSET LENGTH_ERROR PRISMATIC REVOLUTE Parameter ParameterSet",
    "kinematics.counting": "turned_into",
    "kinematics.chain": "DHRow chain_of planar_chain",
    "files.arm": "dump_arm load_arm with_effects",
    "files": "formats",
    "files.measurement": "Plan load_plan",
    "workflow": "load_sessions",
    "campaign": "Campaign",
    # what data say
    "estimation": "Identification estimate estimate_batch estimate_each",
    "gap.diagnose": "diagnose",
    "gap.fit": "fitted_arm",
    "validate": "predicted_95",
    "documents.pictures": "Compared",
    "replications": "Replications StudyFile",
    "gap.result": "Diagnosis",
    "gap.detectability": "Detectability detectability",
    # what designs need
    "for_design": "ArmModel design_model with_points without_prior",
    "information": "log_determinants spectrum",
    # errors, progress, arrays
    "errors": "ArmcalError InputError JobError nearest",
    "vectorized": "vectorize",
    "newton": "newton_ascent",
    "running": "Progress Status additions silent",
    "arrays": "Array readonly",
}
_PLACES = {name: f"identification.{module}" for module, names in _CONTENTS.items() for name in names.split()}
__all__ = sorted(_PLACES)

if TYPE_CHECKING:  # the same for type checkers
    from identification.arm import Arm, Calibration, EffectSpec, Gravity
    from identification.arrays import Array, readonly
    from identification.campaign import Campaign
    from identification.documents.pictures import Compared
    from identification.effects import library
    from identification.errors import ArmcalError, InputError, JobError, nearest
    from identification.estimation import Identification, estimate, estimate_batch, estimate_each
    from identification.files import formats
    from identification.files.arm import dump_arm, load_arm, with_effects
    from identification.files.measurement import Plan, load_plan
    from identification.for_design import (
        ArmModel,
        design_model,
        with_points,
        without_prior,
    )
    from identification.gap.detectability import Detectability, detectability
    from identification.gap.diagnose import diagnose
    from identification.gap.fit import fitted_arm
    from identification.gap.result import Diagnosis
    from identification.information import log_determinants, spectrum
    from identification.kinematics.chain import DHRow, chain_of, planar_chain
    from identification.kinematics.counting import turned_into
    from identification.kinematics.parameters import (
        EFFECT,
        GEOMETRY,
        JOINT_OFFSET,
        LENGTH_ERROR,
        PRISMATIC,
        REVOLUTE,
        Parameter,
        ParameterSet,
    )
    from identification.measurements import Conditions, Measurements, load_measurements, rms_distance
    from identification.model import Model
    from identification.newton import newton_ascent
    from identification.replications import Replications, StudyFile
    from identification.running import Progress, Status, additions, silent
    from identification.validate import predicted_95
    from identification.vectorized import vectorize
    from identification.workflow import load_sessions


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return __all__
