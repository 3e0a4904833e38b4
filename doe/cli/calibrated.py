"""The answer of `armcal identify`, and the files it writes: calibrated arm and corrected URDF, or why they are not."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from doe.cli.common import Answer, warn_beside_json
from identification.status import Status

if TYPE_CHECKING:
    from identification.arm import Calibration
    from identification.estimation import Identification
    from identification.estimation.corrected_values import CorrectedValue
    from identification.gap.library.library_prior import LibraryPrior


def write_calibrated(
    found: Identification,
    path: Path,
    written: tuple[Path | None, Path | None],
    force: bool,
    hidden: frozenset[str],
    before: Calibration | None = None,
    prior: Calibration | None = None,
) -> list[str]:
    """Write the calibrated arm and the corrected URDF file (`written`), all or none; the lines that report them."""
    from identification.files.arm_text import urdf_beside
    from identification.files.io import PathLike, write_together

    out, urdf = written
    files: dict[PathLike, str | bytes] = {}
    if out is not None:
        files[out] = arm_file(found, path, hidden, before, prior)
    if found.geometry is not None:
        from identification.files.arm_chain import corrected_urdf

        files |= urdf_beside(path, out)
        files |= {} if urdf is None else {urdf: corrected_urdf(path, found.geometry.real)}
    write_together(files, force=force)
    what = {out: "calibrated arm", urdf: "corrected URDF file"}
    lines = [f"{what.get(Path(name), 'nominal URDF file')} written to {name}" for name in files]
    if urdf is not None and found.model.effects:
        lines.append(
            f"a URDF file has no effects: {', '.join(effect.label for effect in found.model.effects)} left out"
        )
    return lines


def arm_file(
    found: Identification,
    path: Path,
    hidden: frozenset[str],
    before: Calibration | None = None,
    prior: Calibration | None = None,
) -> str:
    """Text of the arm file with the calibration added, and with effects of the fit that the file lacks.

    hidden : parameters whose covariance is left out;  before, prior : see `fit_answer`
    """
    from identification.files.arm_text import with_calibration, with_effects
    from identification.files.io import read_text
    from identification.sessions import SESSIONS, without_sessions
    from identification.validate.reuse import with_data_of, with_held

    effects = [spec for spec in found.model.arm.effects if spec.name != SESSIONS]
    own = found.calibration().about(set(found.names) - hidden)
    kinds = found.model.arm.joint_types
    kept = with_data_of(with_held(own, before, kinds), prior, kinds)
    text = with_effects(read_text(path), effects, path.parent)
    return with_calibration(text, without_sessions(kept), path.parent)


def no_file(found: Identification, force: bool) -> str | None:
    """The reason why a fit is not written into an arm file, or None if it is."""
    if found.not_identifiable:
        return "not every parameter is estimable from the data"
    if found.status is not Status.implausible:
        return None
    lengths = [] if found.geometry else (found.model.arm.lengths + found.length_errors).tolist()
    if lengths and min(lengths) <= 0.0:
        return f"link {lengths.index(min(lengths)) + 1} would have no positive length"
    return None if force else "the fit is implausible; --force writes it all the same"


def hidden_by(library: LibraryPrior | None) -> frozenset[str]:
    """Parameters of the library's effects, which are not shown."""
    return frozenset(library.prior.deviations if library else ())


def fit_answer(
    found: Identification,
    path: Path,
    written: tuple[Path | None, Path | None],
    force: bool,
    library: LibraryPrior | None = None,
    before: Calibration | None = None,
    prior: Calibration | None = None,
) -> Answer:
    """The answer for a fit; writes the requested files unless the fit is not good enough (`no_file`).

    written : names of the calibrated arm file and of the corrected URDF file
    prior : the earlier calibration that was the prior
    before : the earlier calibration; parameters that were not estimated keep its covariance and its data
    """
    warn_beside_json(found.warnings)
    hidden, data, shown = hidden_by(library), found.to_json(), list[Any]()
    if library is not None:
        data |= {"prior": library.to_json()}
        data["parameters"] = [row for row in data["parameters"] if row["name"] not in hidden]
        shown.append(library.sentence)
    wanted = [name for name in written if name is not None]
    if not wanted:
        return Answer(data, shown, exit_code=1 if found.not_identifiable else 0)
    if (reason := no_file(found, force)) is not None:
        return Answer(data, [*shown, *(f"{name} was not written: {reason}" for name in wanted)], exit_code=1)
    return Answer(data, shown + write_calibrated(found, path, written, force, hidden, before, prior))


def dh_of(found: Identification, arm: Path) -> tuple[tuple[CorrectedValue, ...], list[str]]:
    """The corrected Denavit-Hartenberg table of an arm file that has one, and base, tool and the
    radius of a sphere beside it; else empty."""
    from doe.report.identification import dh_table
    from identification.estimation.dh_values import Calibrated

    if found.geometry is None or found.not_identifiable:
        return (), []
    return dh_table(Calibrated.of(found), found.corrected_values, arm)
