"""`armcal report`: one page of what the other commands wrote."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import Answer, CommonOptions, verb
from doe.cli.options import FILE, force_option
from doe.cli.typed import origin


@verb(
    "armcal report arm.toml calibrated.toml plan.csv data.csv --out page.html",
    "One page of a campaign's files.",
)
@click.argument("files", type=FILE, nargs=-1, required=True)
@click.option("--out", type=FILE, metavar="PAGE.html", required=True, help="Write the page.")
@force_option
def command(common: CommonOptions, files: tuple[Path, ...], out: Path, force: bool) -> Answer:
    """Make one page of the FILES of a campaign, whichever there are.

    Arm files (nominal, calibrated, extended), plans, measurements, joint commands (of compensate), and what design,
    score, identify, diagnose or validate said with --json. The page has the verdict (first the error on rows that no
    fit has seen), what to do next, corrected values, errors with their sign, and plans that can be stepped through and
    edited; it is one file that needs no network.
    """
    from doe.report.campaign import Campaign
    from doe.report.page import hashes, page
    from identification.files.io import write_whole

    campaign = Campaign.of(files)
    write_whole(out, page(campaign.document(), origin(common.seed, files)), force=force)
    listed = [
        {"file": name, "kind": campaign.kinds[name], "bytes": size, "sha256": digest}
        for name, size, digest in hashes(files)
    ]
    data = {"page": out, "verdict": campaign.verdict, "files": listed}
    return Answer(data, [*campaign.verdict, f"page written to {out}"])
