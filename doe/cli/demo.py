"""`armcal demo`: the whole loop, in a folder of files to look at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from doe.cli.plans import with_collisions
from doe.cli.verb import interruptible
from identification import InputError, Progress
from identification.document import Answer, Document
from identification.files.io import write_together
from identification.workflow import VERBS, Folder


@VERBS.declare("armcal demo --spatial --out my-demo")
def demo_files(
    *,
    spatial: bool = False,
    out: Folder = Folder(Path("armcal-demo")),  # noqa: B008
    force: bool = False,
    seed: int = 0,
    progress: Progress = Progress(),
    page: Callable[[Document, Sequence[Path]], str],
) -> Answer:
    """Run the whole loop on a simulated arm.

    The paper's 4-link arm, or one of six axes: from a plan to the missing effect, commands for the real arm, in space a
    corrected URDF file, and a report.html.

    spatial : Six axes and a laser tracker instead of the paper's 4-link arm.
    out : Directory for the files.
    """
    from doe.demo.run import demo_document, overview_figure, planar, run_demo
    from doe.demo.run import spatial as six_axes

    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()) and not force:
            raise InputError(f"{out}: exists and is not empty, allowed: a new directory, or --force")
    except OSError as error:  # a file, a name that is too long, links that lead in a circle, no right to write
        raise InputError(f"{out}: cannot be created ({error.strerror}), allowed: a writable place") from None
    with interruptible(f"the files in {out} are whole, but not all there"):
        demo = run_demo(out, six_axes() if spatial else planar(), seed, progress, force)
        document, picture = demo_document(demo), overview_figure(demo)
        text = page(document, [out / name for name in demo.data["files"]])
        write_together({out / "overview.png": picture, out / "report.html": text}, force=True)
        files = ", ".join(demo.data["files"])
        look = f"Look at {out / 'report.html'} in a browser, and at the files beside it: {files}"
        answer = Answer(demo.data, document.plus(look))
        return with_collisions(answer, demo.design.problem, demo.design.plan.postures)
