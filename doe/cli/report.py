"""`armcal report`: one page of what the other commands wrote."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from doe.cli.common import verb
from identification.document import Answer, Document
from identification.workflow import Written


@verb("armcal report arm.toml calibrated.toml plan.csv data.csv --out page.html")
def command(
    files: tuple[Path, ...],
    *,
    out: Written,
    force: bool = False,
    page: Callable[[Document, Sequence[Path]], str],
) -> Answer:
    """One page of a campaign's files.

    Arm files (nominal, calibrated, extended), plans, measurements, joint commands (of compensate), and what design,
    score, identify, diagnose or validate said with --json. The page has the verdict (first the error on rows that no
    fit has seen), what to do next, corrected values, errors with their sign, and plans that can be stepped through and
    edited; it is one file that needs no network.

    out : Write the page.
    force : Overwrite an existing file.
    """
    from doe.report.campaign import PlannedCampaign
    from doe.report.page import hashes
    from identification.files.io import write_together

    campaign = PlannedCampaign.of(files)
    write_together({out: page(campaign.document(), files)}, force=force)
    listed = [
        {"file": name, "kind": campaign.kinds[name], "bytes": size, "sha256": digest}
        for name, size, digest in hashes(files)
    ]
    data = {"page": out, "verdict": campaign.verdict, "files": listed}
    return Answer(data, [*campaign.verdict, f"page written to {out}"])
