"""`armcal init`: the first files of a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click

from doe.cli.common import verb
from doe.cli.options import FilePath, Folder
from identification.document import Answer
from identification.errors import InputError, nearest
from identification.files.io import PathLike, write_together


@verb("armcal init --urdf robot.urdf --out calibration")
def command(
    *,
    links: Annotated[str, "N|LENGTHS"] | None = None,
    robot: Annotated[Path, FilePath(), "--urdf"] | None = None,
    dh: Annotated[int, click.IntRange(1, 12), "N"] | None = None,
    base_link: str | None = None,
    tip_link: str | None = None,
    instrument: Annotated[str, "KIND"] | None = None,
    out: Folder = Path("."),
    force: bool = False,
) -> Answer:
    """Write the first files: arm, measurements, what to do.

    An arm file with comments, the columns of a measurement file, and the steps of a calibration. One of --links, --urdf
    and --dh says which arm; a planar one of three links without any of them.

    links : A planar arm: how many links (a whole number, 1 to 12), or their lengths [mm]: 612,572.3 or, of one, 612.0
    robot : A spatial arm from a URDF file.
    dh : A spatial arm from N Denavit-Hartenberg rows.
    base_link : Of the URDF file; left out: its root.
    tip_link : Of the URDF file; left out: tool0, tcp .. or the end with the most joints.
    instrument : Of a spatial arm without a tracker: distance (ball bar, draw wire), sphere, plane (touch probe).
    out : Folder; made if missing.
    force : Overwrite existing files.
    """
    from doe.report.first_files import ARM, STEPS, dh_files, planar_files, urdf_files
    from identification.instruments import KINDS

    sources = [name for name, value in (("--links", links), ("--urdf", robot), ("--dh", dh)) if value is not None]
    if len(sources) > 1:
        raise InputError(f"{sources[1]}: found with {sources[0]}, allowed: one of them")
    for name, value in (("--base-link", base_link), ("--tip-link", tip_link)):
        if value is not None and robot is None:
            raise InputError(f"{name}: found without --urdf, allowed: with --urdf")
    if instrument is not None and robot is None and dh is None:
        raise InputError("--instrument: found for a planar arm, allowed: with --dh or --urdf")
    if instrument is not None and instrument not in KINDS:
        raise InputError(f"--instrument: found {instrument!r}, {nearest(instrument, KINDS)}")
    if robot is not None:
        files = urdf_files(robot, base_link, tip_link, instrument or "")
    else:
        files = planar_files(links or "3") if dh is None else dh_files(dh, instrument or "")
    new: dict[PathLike, str | bytes] = {out / name: text for name, text in files.items()}
    if robot is not None and (copy := out / robot.name).exists() and copy.samefile(robot):  # it stands there already
        del new[copy]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out: {out} cannot be made ({error.strerror}), allowed: a folder") from None
    write_together(new, force)
    written = list(map(str, new))
    first = ("armcal design", "armcal check")  # of touches there is no plan
    step = next(line for word in first for line in files[STEPS].splitlines() if line.startswith(word))
    made_up = ["replace what is marked EXAMPLE in " + str(out / ARM)] if "EXAMPLE" in files[ARM] else []
    upright = "gravity: the masses of the URDF file, on a base that stands upright; if it does not, change [gravity]"
    made_up += [upright] if "\n[gravity]" in files[ARM] else []
    steps = [f"{out / STEPS} says what to do, step by step", *made_up, f"in {out}: {step.partition('  #')[0].rstrip()}"]
    return Answer({"directory": out, "files": written, "next": steps}, [f"written: {', '.join(written)}", *steps])
