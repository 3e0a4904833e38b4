"""What a person reads of fits, validations and commands: nothing is lost, and what is not known is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from identification.arm import Arm, Calibration
from identification.compensate import Compensation
from identification.document import Sheet, as_text
from identification.documents.identification import (
    BY_CHANCE,
    compensation_document,
    corrected_section,
    dh_sections,
    identification_actions,
    identification_verdict,
    in_short,
    is_better,
    validation_actions,
    validation_verdict,
)
from identification.documents.pictures import validation_figure
from identification.estimation.result import CorrectedValue
from identification.measurements import Measurements
from identification.validate import validate

ARM = Arm([300.0, 200.0], calibration=Calibration.of([1.0, -2.0], [0.01, -0.02]))


def row(name: str, nominal: float | None, value: float, std: float, prior: float | None, unit: str) -> CorrectedValue:
    return CorrectedValue(name, None, nominal, value, std, value - 2 * std, value + 2 * std, unit, "", prior)


ROWS = (
    row("zero of joint 2", 0.0, -0.08, 0.05, 0.5, "deg"),
    row("zero of joint 5", 0.0, 0.04, 0.35, 0.5, "deg"),
    row("zero of joint 6", 0.0, 0.0, 0.5, 0.5, "deg"),
    row("joint 3 x", 610.0, 609.5, 0.04, 1.0, "mm"),
    row("joint 3 y", -130.0, -129.8, 0.87, 1.0, "mm"),
    row("joint 3 z", 0.0, 0.06, 0.97, 1.0, "mm"),
    row("joint 4 yaw", 0.0, 1e-5, 2e-5, 1e-3, "deg"),  # of second order
    row("base x", None, 2574.14, 0.05, None, "mm"),
    row("base rz", None, 159.65, 0.3, None, "deg"),
)


def test_well_determined_values_are_shown_and_the_others_said() -> None:
    text = as_text(in_short(ROWS, minimal=True), 80)
    assert max(map(len, text.splitlines())) <= 80
    table, _, rest = text.partition("Weakly determined")
    assert "Well determined: 2 of 7 corrected values" in table
    assert [name in table for name in ("zero of joint 2", "joint 3 x", "joint 3 y", "zero of joint 5", "base")] == [
        True,
        True,
        False,
        False,
        False,
    ]
    said = " ".join(rest.split())
    assert "zero of joint 5, 6; joint 3 y, z." in said
    assert "As drawn to three decimals: 1 more." in said
    assert "base [mm]: x 2574.140 +- 0.050, rz 159.650 +- 0.300 deg" in said
    assert "--parameters minimal gives a complete set" in said
    assert "minimal" not in as_text(in_short(ROWS, minimal=False))


def test_the_note_on_beta_stands_beside_a_beta_only() -> None:
    plain, hayati = row("row 1 a", 0.0, 0.1, 0.01, None, "mm"), row("row 2 beta", 0.0, 0.1, 0.01, None, "deg")
    noted = ["Hayati" in as_text(dh_sections(rows, [])[0]) for rows in ([plain], [plain, hayati])]
    assert noted == [False, True]


def test_corrected_values_have_three_significant_digits_of_the_standard_deviation() -> None:
    row = CorrectedValue("length of link 1", None, 500.0, 501.079512, 0.0123, 501.05, 501.11, "mm", "")
    table = corrected_section("Corrected values", [row], spatial=False).parts[0]
    assert isinstance(table, Sheet)
    assert list(table.headings) == ["", "nominal", "corrected", "std", "low 95 %", "high 95 %", "unit"]
    assert table.rows == [["length of link 1", "500.0000", "501.0795", "0.0123", "501.0500", "501.1100", "mm"]]


def test_a_fit_and_a_validation_in_a_sentence_each() -> None:
    assert "3.00 to 0.250 mm" in identification_verdict({"rms_before_mm": 3.0, "rms_after_mm": 0.25})
    figures = {"rows": 7, "rms_mm": 0.1, "p95_mm": 0.2, "rms_nominal_mm": 1.0, "refit": "base", "notes": []}
    assert validation_verdict(figures, "c.toml", "d.csv", seen=True).startswith(
        "On 7 rows of d.csv, which it was fitted to, c.toml takes the RMS error from 1.00 mm (drawing, after "
        "fitting where the arm stands) to 0.100 mm"
    )
    said = identification_verdict({"rms_before_mm": 3.0, "rms_after_mm": 0.25, "rms_drawing_mm": 1.0})
    assert "from 1.00 mm (drawing, after fitting where the arm stands) to 0.250 mm" in said


def test_tables_and_picture() -> None:
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (16, 2))
    z = (np.array([301.0, 198.0]) * np.exp(1j * np.cumsum(q + np.array([0.01, -0.02]), axis=1))).sum(axis=1)
    measured = np.column_stack([z.real, z.imag]) + np.random.default_rng(1).normal(0.0, 0.1, (16, 2))
    session = np.repeat(["monday", "friday"], 8)
    found = validate(ARM, Measurements(q, measured, session=session))
    text = as_text(found.document(), 120)
    assert (
        "16 rows, refitted in each of 2 sessions: position and rotation of the base; everything else as in the file"
        in text
    )
    for figure in (*found.model, *found.nominal):
        assert f"{figure:.4f}" in text
    assert "monday" in text
    assert "no better than the drawing" not in text
    kept = found.model.rms / found.nominal.rms
    said = f" to {found.model.rms:.3f} mm: {100.0 * (1.0 - kept):.0f} % of the error is removed; "
    predicted = (
        f"On 16 rows of other measurements, the model takes the RMS error from {found.nominal.rms:.2f} mm (drawing"
    )
    assert text.startswith(predicted)
    assert "mm (drawing, after fitting where the arm stands) to " in " ".join(text.split())
    assert said in " ".join(text.split())
    swapped = replace(found, residuals=found.nominal_residuals, nominal_residuals=found.residuals)
    doubtful = replace(found, notes=(f"{BY_CHANCE} ...",))
    removed = f"{100.0 * (1.0 - kept):.0f} % of the error is removed, which {BY_CHANCE}"
    for worse, words in ((swapped, "no better than the drawing"), (doubtful, removed)):
        assert f" mm: {words}; " in " ".join(str(worse).split())
        assert not is_better(worse.to_json())
    assert is_better(found.to_json())
    figure = validation_figure(found)
    assert figure.axes[1].get_title().startswith(f"drawing: RMS {found.nominal.rms:.4g} mm")


def test_after_a_validation() -> None:
    good, poor, refitted = (
        validation_actions(*case, "m.toml", "d.csv") for case in ((True, "base"), (False, "base"), (False, "offsets"))
    )
    assert [action.command for action in good] == ["armcal compensate m.toml targets.csv --out commands.csv"]
    assert [action.command for action in poor] == [
        "armcal validate m.toml d.csv --refit offsets",
        "armcal identify m.toml d.csv --only joint_offsets,base",
    ]
    assert refitted == poor[1:]
    for case, others in (((True, "base"), good), ((False, "base"), poor), ((False, "offsets"), refitted)):
        first, *rest = validation_actions(*case, "m.toml", "d.csv", beyond=True)
        assert "--library-prior" in first.command
        assert rest == others


def test_after_an_identification() -> None:
    first = identification_actions("a.toml", "d.csv", None, diagnosed=False)
    assert first[0].text.endswith("add --out calibrated.toml to this command.")
    assert first[1].command.startswith("armcal diagnose a.toml d.csv")
    kept = identification_actions("a.toml", "d.csv", Path("mine.toml"), diagnosed=True)
    assert [action.command.split()[:3] for action in kept] == [
        ["armcal", "validate", "mine.toml"],
        ["armcal", "compensate", "mine.toml"],
    ]


def commands(errors: list[float], missed: list[float]) -> Compensation:
    """One joint turned by 0.5 rad for every target."""
    k = len(errors)
    angles, targets = np.full((k, 1), 0.5), np.zeros((k, 2))
    return Compensation(targets, angles, angles, np.array(errors), (), None, None, ("box",), np.array(missed)[:, None])


def test_counts_of_targets_without_a_command() -> None:
    """Row 2 is out of reach, row 3 barred; both lack angles, and a sentence says how many and why."""
    found = commands([0.0, 3.0, 0.0], [-1.0, -1.0, 2.0])
    assert np.isnan(found.safe_commands).tolist() == [[False], [True], [True]]
    document = compensation_document(found)
    why = "2 have no command (angles left empty): 1 out of reach, 1 barred by a constraint (rows 2, 3)."
    assert document.verdict == [f"1 of 3 targets reached by the calibrated model. {why}"]
    table, *reasons = document.parts
    assert isinstance(table, Sheet)
    assert [row[3:] for row in table.rows] == [["28.648", "< 1e-6"], ["-", "3.0000"], ["-", "-"]]
    assert len(reasons) == 2


def test_where_every_target_is_reached_and_where_none_is() -> None:
    every, none = (compensation_document(commands([e] * 20, [-1.0] * 20)).verdict[0] for e in (1e-9, 1.0))
    assert every == "20 of 20 targets reached by the calibrated model."
    assert none.endswith("20 have no command (angles left empty): out of reach (rows 1, 2, 3, 4, 5, 6, 7, 8, ...).")
