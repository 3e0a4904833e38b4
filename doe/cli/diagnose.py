"""`armcal diagnose`: find the missing effect."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import FILE, Answer, Session, force_option, out_option, read_measurements, verb


@verb("armcal diagnose arm.toml data.csv --holdout more.csv --out extended.toml --report gap.html")
@click.argument("arm", type=FILE)
@click.argument("data", type=FILE)
@click.option("--holdout", type=FILE, help="Measurements used for nothing but the confirmation.")
@click.option("--draws", type=click.IntRange(min=399), default=999, show_default=True, help="Bootstrap draws.")
@click.option("--report", type=FILE, metavar="FILE", help="Write an HTML page with pictures.")
@out_option
@force_option
def command(
    session: Session,
    arm: Path,
    data: Path,
    holdout: Path | None,
    draws: int,
    report: Path | None,
    out: Path | None,
    force: bool,
) -> Answer:
    """Find where model and measurements disagree, name the missing effect, and show the gap shrink."""
    from doe.report.gap_page import diagnosis_tables, gap_page
    from identification.files.arm import load_arm, with_calibration, with_effects
    from identification.files.io import PathLike, check_writable, read_text, write_together
    from identification.gap.diagnose import diagnose

    loaded = load_arm(arm)
    check_writable(out, force)
    check_writable(report, force)
    measurements = read_measurements(data, loaded)
    held_out = None if holdout is None else read_measurements(holdout, loaded)
    with session.progress("diagnose") as progress:
        found = diagnose(loaded, measurements, held_out, session.seed, draws, progress)
    files: dict[PathLike, str | bytes] = {}
    if out is not None:
        extended = with_effects(read_text(arm), found.named.specs)
        files[out] = with_calibration(extended, found.named.calibration)
    if report is not None:
        files[report] = gap_page(found)
    write_together(files, force=force)
    return Answer(found.to_json(), [*diagnosis_tables(found), *(f"written: {path}" for path in files)])
