"""`armcal diagnose`: find the missing effect."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from doe.cli.common import Answer, CommonOptions, origin, read_measurements, read_sessions, say, verb, warn_beside_json
from doe.cli.options import File, FileOrShare, OutFile
from identification.errors import InputError

if TYPE_CHECKING:
    from identification.arm import Arm
    from identification.gap.result import Diagnosis
    from identification.measurements import Measurements


@verb("armcal diagnose arm.toml data.csv --holdout more.csv --report gap.html")
def command(
    common: CommonOptions,
    arm: File,
    data: tuple[File, ...],
    *,
    holdout: Annotated[Path | float | None, FileOrShare("file|share")] = None,
    report: OutFile | None = None,
    curves: OutFile | None = None,
    named_only: bool = False,
    out: OutFile | None = None,
    force: bool = False,
) -> Answer:
    """Find and name the effect that the model lacks.

    Find where model and measurements disagree, name the missing effect, and show the gap shrink. Several files DATA
    are sessions of one arm, as are the rows that a column session tells apart: each gets a base of its own, and
    each named effect is compared between them.

    holdout : Measurements used for nothing but the confirmation; or a share of DATA (0.3): random postures are held
        out.
    report : Write an HTML page with pictures.
    curves : Write the error curves of joints as a table (CSV).
    named_only : Write what is named alone, without what is less likely and curves.
    out : Write the arm file of the model that predicts best; --force also where it is not confirmed.
    force : Overwrite an existing file.
    """
    from doe.report.page import page
    from identification.documents.diagnosis import diagnosis_document
    from identification.files.arm import load_arm
    from identification.gap.curve import curves_text
    from identification.gap.diagnose import diagnose
    from identification.measurements import rms_distance
    from identification.servo import with_servo_errors
    from identification.validate import drawing_residuals
    from identification.validate.validation import judged

    loaded = load_arm(arm)
    if models := [path for path in data if path.suffix.lower() == ".toml"]:
        raise InputError(f"{models[0]}: found an arm file among the data, allowed: files of measurements")
    measurements, held_out = parts(data, holdout, loaded, common.seed)
    loaded = with_servo_errors(loaded, measurements)
    diagnosis = diagnose(loaded, measurements, held_out, common.seed, common.report)
    diagnosis = judged(diagnosis, loaded, measurements, held_out)
    refuted = [f"not confirmed: {diagnosis.confirmation}"] if diagnosis.confirmed is False else []
    warn_beside_json([*diagnosis.warnings, *refuted])
    if curves is not None and loaded.counting is not None:
        meaning = "angles and corrections are those of the model's joints, from the link before, not of [joints]"
        warnings.warn(f"{curves}: {meaning}; armcal compensate writes commands as the controller counts", stacklevel=2)
    answer = Answer(diagnosis.to_json())
    about = answer.data, diagnosis, [*map(str, (arm, *data))], out
    document, text = diagnosis_document(*about), ""
    try:
        read = [arm, *data, *([holdout] if isinstance(holdout, Path) else [])]
        if report is not None:
            nominal = rms_distance(drawing_residuals(diagnosis.arm, measurements))
            text = page(diagnosis_document(*about, nominal), origin(common.seed, read))
        texts = {curves: curves_text(diagnosis.curves), report: text}
        lines = write_diagnosis(diagnosis, arm, out, texts, force=force, named_only=named_only)
        answer.shown = [document.plus(*lines)]
    except InputError as error:  # the diagnosis is shown all the same
        say(str(error))
        answer.shown, answer.exit_code = [replace(document, actions=())], error.exit_code
    return answer


def parts(
    data: tuple[Path, ...], holdout: Path | float | None, arm: Arm, seed: int
) -> tuple[Measurements, Measurements | None]:
    """The measurements to diagnose, and those held out."""
    import numpy as np

    from identification.gap.confirmation import split

    measurements = read_sessions(data, arm)
    if isinstance(holdout, float):
        return split(measurements, holdout, np.random.default_rng(seed))
    return measurements, None if holdout is None else read_measurements(holdout, arm)


def write_diagnosis(
    diagnosis: Diagnosis,
    arm: Path,
    out: Path | None,
    texts: Mapping[Path | None, str],
    *,
    force: bool,
    named_only: bool,
) -> list[str]:
    """Write the requested files, all or none, and return the lines that report them.

    texts : name -> content of the report and the curves; None: not requested
    named_only : what is named, without what is less likely
    """
    from identification.files.arm_text import urdf_beside, with_calibration, with_effects
    from identification.files.io import PathLike, read_text, write_together

    files: dict[PathLike, str | bytes] = {}
    if out is not None and diagnosis.confirmed is False and not force:
        warnings.warn(f"{out} was not written: not confirmed; --force writes it all the same", stacklevel=2)
    elif out is not None:
        model = diagnosis.extended_arm(diagnosis.named if named_only else None)
        extended = with_effects(read_text(arm), model.effects, arm.parent)
        assert model.calibration is not None  # a diagnosis has one
        files[out] = with_calibration(extended, model.calibration, arm.parent)
        files |= urdf_beside(arm, out)
    files |= {path: text for path, text in texts.items() if path is not None}
    write_together(files, force=force)
    return [f"written: {path}" for path in files]
