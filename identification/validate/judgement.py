"""Judge a model before it is offered for use: does it predict what it has not seen better than the geometry alone?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from identification.arm import Arm
from identification.errors import InputError
from identification.estimation import Identification, estimate
from identification.estimation.left_out import left_out_residuals
from identification.gap.confirmation import Offered
from identification.gap.result import Diagnosis
from identification.measurements import Measurements
from identification.model import Model
from identification.sessions import with_sessions, without_sessions
from identification.validate.validation import validate


def judged(diagnosis: Diagnosis, arm: Arm, measurements: Measurements, holdout: Measurements | None) -> Diagnosis:
    """The diagnosis with what its extended model is worth beside the geometry (`Diagnosis.offered`).

    Where nothing is missing nothing is offered. On a hold-out both are placed as `validate` places them, so that the
    figures are those that it gives of the files of `diagnose --out` and of `identify --out`; without one, the
    cross-validation over postures says it.

    arm : as it was diagnosed;  measurements, holdout : as for `diagnose`
    """
    if diagnosis.verdict == "none" or not diagnosis.predicting.specs:
        return diagnosis
    if holdout is None:
        tests = [test for test in diagnosis.cross_validation if test.transfer == "other postures"]
        return replace(diagnosis, offered=Offered.of_test(tests[0])) if tests else diagnosis
    kept = measurements.rows([k for k in range(len(measurements)) if k + 1 not in set(diagnosis.outlier_rows)])
    geometry = identified_geometry(arm, kept)
    try:
        alone, extended = (validate(each, holdout).residuals for each in (geometry, diagnosis.extended_arm()))
    except InputError:  # too few rows to place the arm
        return diagnosis
    return replace(diagnosis, offered=Offered.of("holdout", alone, extended, holdout))


def identified_geometry(arm: Arm, measurements: Measurements) -> Arm:
    """The arm as `identify` calibrates it, where it stands in the first session."""
    fit = estimate(Model(with_sessions(arm, measurements)), measurements)
    return replace(arm, calibration=without_sessions(fit.calibration()))


def prior_judged(
    geometry: Callable[[], Identification], fit: Identification, measurements: Measurements
) -> Offered | None:
    """What a fit with a prior of further effects is worth beside the geometry, each posture predicted from the others;
    None where the rows determine the one or the other not."""
    model = left_out_residuals(fit, measurements)
    alone = None if model is None else left_out_residuals(geometry(), measurements)
    return None if model is None or alone is None else Offered.of("cross-validation", alone, model, measurements)
