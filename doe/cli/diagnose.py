"""`armcal diagnose`: find the missing effect."""

from __future__ import annotations

import warnings
from pathlib import Path

import click

from doe.cli.common import Answer, Session, read_measurements, verb
from doe.cli.options import FILE, Output, output_options


@verb(
    "armcal diagnose arm.toml data.csv --holdout more.csv --out extended.toml --report gap.html",
    "Find and name the effect that the model lacks.",
)
@click.argument("arm", type=FILE)
@click.argument("data", type=FILE)
@click.option("--holdout", type=FILE, help="Measurements used for nothing but the confirmation.")
@click.option("--draws", type=click.IntRange(min=399), default=999, show_default=True, help="Bootstrap draws.")
@click.option("--report", type=FILE, metavar="FILE", help="Write an HTML page with pictures.")
@output_options(out="Write the arm file extended by the named effect.")
def command(
    session: Session, arm: Path, data: Path, holdout: Path | None, draws: int, report: Path | None, output: Output
) -> Answer:
    """Find where model and measurements disagree, name the missing effect, and show the gap shrink."""
    from doe.report.gap_page import diagnosis_tables, gap_page
    from identification.files.arm import load_arm
    from identification.files.arm_text import with_calibration, with_effects
    from identification.files.io import PathLike, read_text, write_together
    from identification.gap.diagnose import diagnose

    loaded = load_arm(arm)
    measurements = read_measurements(data, loaded)
    held_out = None if holdout is None else read_measurements(holdout, loaded)
    with session.progress("diagnose") as progress:
        found = diagnose(loaded, measurements, held_out, session.seed, draws, progress)
    for sentence in found.warnings:
        warnings.warn(sentence, UserWarning, stacklevel=2)
    files: dict[PathLike, str | bytes] = {}
    if output.out is not None:
        extended = with_effects(read_text(arm), found.named.specs)
        files[output.out] = with_calibration(extended, found.named.calibration)
    if report is not None:
        files[report] = gap_page(found)
    write_together(files, force=output.force)
    return Answer(found.to_json(), [*diagnosis_tables(found), *(f"written: {path}" for path in files)])
