"""A calibration in use, as documents: what it leaves of other measurements, and the commands made with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from identification.arrays import Array
from identification.document import Action, Document, Section, Sheet, in_a_sentence, number
from identification.documents.identification import correct, drawing_in_words, identify_command
from identification.kinematics.parameters import REVOLUTE

if TYPE_CHECKING:
    from identification.compensate import Compensation

Data = Mapping[str, Any]  # what a command says with --json

FITTED = "these are the measurements that the model was identified from: this says nothing about others"
BY_CHANCE = "may be chance"  # said of a gain within what the rows scatter by


# -- armcal validate ---------------------------------------------------------------------------------------------------
def validation_actions(better: bool, refit: str, model: str, rows: str, *, beyond: bool = False) -> list[Action]:
    """What to do with a model that predicts other measurements, or does not;  beyond : as for the document"""
    why = "Most rows are at angles that the calibration has not seen. A fit that reaches farther from its data:"
    far = [Action(why, identify_command("arm.toml", "data.csv", "library-prior"))] if beyond else []
    if better:
        return [*far, correct(model)]
    zeros = Action("Find the zeros of the joints again:", f"armcal identify {model} {rows} --only joint_offsets,base")
    if refit == "offsets":
        return [*far, zeros]
    asked = f"armcal validate {model} {rows} --refit offsets"
    return [
        *far,
        Action("See whether the zeros of the joints have moved, and what refitting them gains:", asked),
        zeros,
    ]


def validation_verdict(data: Mapping[str, Any], model: str = "the model", rows: str = "", *, seen: bool = False) -> str:
    """What a calibrated model does to the error on other measurements, compared with the drawing, and whether that is
    better;  model, rows : names of files;  seen : it was fitted to these rows"""
    rows = rows or ("the model's own measurements" if FITTED in data.get("notes", ()) else "other measurements")
    which = ", which it was fitted to" if seen else ""
    figures = f"from {drawing_in_words(data['rms_nominal_mm'], data['refit'])} to {in_a_sentence(data['rms_mm'])} mm"
    most = f"95 % of the errors are below {in_a_sentence(data['p95_mm'])} mm"
    gain = 1.0 - data["rms_mm"] / data["rms_nominal_mm"] if data["rms_nominal_mm"] else 0.0
    worth = "no better than the drawing" if gain <= 0.0 else f"{100.0 * gain:.0f} % of the error is removed"
    worth += f", which {BY_CHANCE}" if gain > 0.0 and not is_better(data) else ""
    return f"On {data['rows']} rows of {rows}{which}, {model} takes the RMS error {figures}: {worth}; {most}."


def is_better(data: Mapping[str, Any]) -> bool:
    """Whether the model is better than the drawing, by more than the rows scatter."""
    return data["rms_mm"] < data["rms_nominal_mm"] and not any(BY_CHANCE in note for note in data["notes"])


def validation_sections(data: Mapping[str, Any], points: str = "") -> list[Section]:
    """Drawing and model over all rows, and block by block;  points : what is refitted of a spatial arm beside"""
    keys, refitted = ("rms", "mean", "p95", "max"), {one["session"] for one in data["refitted"]}
    what = {"base": "position and rotation of the base", "offsets": "joint offsets, position of the base"}
    summary = f"{data['rows']} rows, nothing refitted"
    if data["refit"] != "none":
        sessions = f" in each of {len(refitted)} sessions" if len(refitted) > 1 else ""
        summary = (
            f"{data['rows']} rows, refitted{sessions}: {what[data['refit']]}{points}; everything else as in the file"
        )
    figures = ("RMS", "mean", "95 %\nbelow", "largest")
    rows = [["drawing", *(number(data[f"{key}_nominal_mm"]) for key in keys)]]
    rows.append(["model", *(number(data[f"{key}_mm"]) for key in keys)])
    blocks = [
        [b["kind"], b["name"], str(b["rows"]), number(b["rms_nominal_mm"]), *(number(b[f"{key}_mm"]) for key in keys)]
        for b in data["blocks"]
    ]
    headings = ("block", "which", "rows", "RMS\ndrawing", *figures)
    shown = [Section("Validation, distances in mm", [Sheet(("", *figures), rows), summary])]
    return shown + ([Section("Validation, block by block, in mm", [Sheet(headings, blocks)])] if blocks else [])


# -- armcal compensate -------------------------------------------------------------------------------------------------
def compensation_document(result: Compensation) -> Document:
    """How many targets are reached and which are not, then joint commands for the first ones."""
    reached = f"{np.count_nonzero(result.reached)} of {len(result.targets)} targets reached by the calibrated model"
    if result.model_rms is not None:
        reached += f" (RMS {result.model_rms:.4g} mm on its own measurements)"
    if result.angles is not None and result.reached.any():
        reached += (
            f"; orientations are those wanted to {miss_text(result.to_json()['max_error_deg'])} deg, by the same model"
        )
    reasons = [f"target {k} ! {message}" for k, message in enumerate(result.messages, start=1) if message]
    rest = [f"... and {len(reasons) - 24} more without a command; --out writes all"] if len(reasons) > 24 else []
    types = result.joint_types or (REVOLUTE,) * result.commands.shape[1]
    digits = 3 if len(types) + result.targets.shape[1] <= 6 else 2  # of more joints and axes than 80 columns have room
    joints = [f"q{j}" if kind == REVOLUTE else f"q{j} [mm]" for j, kind in enumerate(types, start=1)]
    commands = np.where(np.isnan(result.safe_commands), np.nan, result.commands_in_file_units)
    rows = command_rows(result.targets, commands, result.left, digits)
    headings = ["row", *"xyz"[: result.targets.shape[1]], *joints, "miss"]
    table = Sheet(headings, rows, "Targets and miss [mm], commands [deg]", 24)
    rounded = [] if digits == 3 else ["Rounded to 0.01 deg here; --out and --json give every digit."]
    verdict = " ".join([f"{reached}.", *without_command(result)])
    return Document("Commands", [verdict], [table, *rounded, *reasons[:24], *rest], warnings=result.warnings)


def without_command(result: Compensation) -> list[str]:
    """How many targets have no command, and why; in one sentence, none where every target is reached."""
    rows = (np.flatnonzero(~result.reached) + 1).tolist()
    counts = {"out of reach": ~result.near, "barred by a constraint": result.near & ~result.reached}
    why = {reason: int(np.count_nonzero(which)) for reason, which in counts.items() if which.any()}
    counted = ", ".join(f"{count} {reason}" if len(why) > 1 else reason for reason, count in why.items())
    have = "have" if len(rows) > 1 else "has"
    return [f"{len(rows)} {have} no command (angles left empty): {counted} ({rows_listed(rows)})."] if rows else []


def rows_listed(rows: Sequence[int]) -> str:
    """`row 3`, `rows 1, 5`; of many the first eight."""
    return f"row{'s' * (len(rows) > 1)} {', '.join(map(str, rows[:8]))}{', ...' if len(rows) > 8 else ''}"


def command_rows(targets: Array, commands: Array, miss: Array, digits: int = 3) -> list[list[str]]:
    """A row of text for each target: its number, (k, d) targets [mm], (k, n) commands [file units], (k,) miss [mm].

    digits : decimals of commands, two more than of targets
    """
    return [
        [
            str(row),
            *(f"{value:.{digits - 2}f}" for value in target),
            *("-" if np.isnan(value) else f"{value:.{digits}f}" for value in command),
            miss_text(error),
        ]
        for row, (target, command, error) in enumerate(zip(targets, commands, miss, strict=True), start=1)
    ]


def miss_text(error: float) -> str:
    """Distance of the calibrated model's tip from its target [mm], not to be read as the robot's accuracy; a dash for
    NaN."""
    if np.isnan(error):
        return "-"
    return "< 1e-6" if error < 1e-6 else number(error) if error < 100.0 else f"{error:.0f}"
