"""Tables and picture of a validation show the figures of the validation."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
from rich.console import Console

from doe.report.validation import better, predicted_in_words, validation_figure, validation_tables
from identification.arm import Arm, Calibration
from identification.measurements import Measurements
from identification.validate import HARDLY, validate

ARM = Arm([300.0, 200.0], calibration=Calibration.of([1.0, -2.0], [0.01, -0.02]))


def test_tables_and_picture() -> None:
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (16, 2))
    z = (np.array([301.0, 198.0]) * np.exp(1j * np.cumsum(q + np.array([0.01, -0.02]), axis=1))).sum(axis=1)
    measured = np.column_stack([z.real, z.imag]) + np.random.default_rng(1).normal(0.0, 0.1, (16, 2))
    session = np.repeat(["monday", "friday"], 8)
    found = validate(ARM, Measurements(q, measured, session=session))
    console = Console(file=io.StringIO(), width=120)
    for part in validation_tables(found):
        console.print(part)
    text = console.file.getvalue()
    assert (
        "16 rows, refitted in each of 2 sessions: position and rotation of the base; everything else as in the file"
        in text
    )
    for figure in (*vars(found.model).values(), *vars(found.nominal).values()):
        assert f"{figure:.4f}" in text
    assert "monday" in text
    assert "no better than the drawing" not in text
    kept = found.model.rms / found.nominal.rms
    said = f"The calibration removes {100.0 * (1.0 - kept):.0f} % of the error."
    predicted = f"The model predicts these 16 positions to {found.model.rms:.3f} mm RMS; drawing: "
    assert text.startswith(predicted)
    assert f"{found.nominal.rms:.2f} mm RMS, after fitting where the arm stands. " in " ".join(text.split())
    assert said in " ".join(text.split())
    swapped = replace(found, residuals=found.nominal_residuals, nominal_residuals=found.residuals)
    assert predicted_in_words(swapped).startswith("The model predicts these 16 positions no better than the drawing: ")
    doubtful = replace(found, notes=(f"{HARDLY} ...",))
    assert predicted_in_words(doubtful).startswith(f"The model predicts these 16 positions {HARDLY} than the drawing: ")
    assert [better(one) for one in (found, swapped, doubtful)] == [True, False, False]
    figure = validation_figure(found)
    assert figure.axes[1].get_title().startswith(f"drawing: RMS {found.nominal.rms:.4g} mm")
