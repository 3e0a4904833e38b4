"""A set-up other than the fit assumes: a measured point that was mounted elsewhere between two sessions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import fdtrc

from identification.arrays import Array
from identification.errors import InputError
from identification.estimation import Identification
from identification.estimation.plausibility import SPARE
from identification.estimation.uncertainty import LEVEL
from identification.kinematics.corrected import composed_tools
from identification.kinematics.spatial import TOOL
from identification.measurements import Measurements

HARDLY = 0.1  # of how far a point is moved: a standard deviation that adds hardly anything to it
GAIN = 1.25  # of the sum of squares: a tenth of the RMS error; less is not worth another set of parameters


def renamed_by_session(measurements: Measurements, names: tuple[str, ...]) -> tuple[Measurements, dict[str, str]]:
    """Measurements whose points have names of their own in every session after the first that sees them; and of each
    new name the one that the point has in the data.

    names : of the arm's points, of which the first is measured where the data have no column marker
    """
    marker = measurements.marker
    names_read = np.full(len(measurements), names[0]) if marker is None else np.asarray(marker)
    renamed, old, seen = names_read.astype(object), dict[str, str](), set[str]()
    for session, rows in zip(measurements.sessions, measurements.session_rows, strict=True):
        for name in (here := sorted({*names_read[rows].tolist()} & seen)):
            old[f"{name} of {session}"] = name
            renamed[rows[names_read[rows] == name]] = f"{name} of {session}"
        seen |= {*names_read[rows].tolist()} - {*here}
    return replace(measurements, marker=renamed.astype(str), marker_names=()), old


def with_mounting_doubt(
    together: Identification, measurements: Measurements, fit: Callable[[Measurements], Identification]
) -> Identification:
    """A fit to several sessions, with a doubt where measured points that the sessions share are mounted elsewhere in
    some of them: squares fall significantly, and by more than `GAIN`, where each session has points of its own.

    fit : the same for other measurements
    """
    chain = together.model.arm.chain if hasattr(together.model, "arm") else None
    if chain is None or chain.planar or len(measurements.sessions) < 2:
        return together
    renamed, old = renamed_by_session(measurements, tuple(chain.tools))
    if not old:
        return together
    try:
        apart = fit(renamed)
    except InputError:  # the points are given, or too few rows
        return together
    held, free = (float(np.sum(each.residuals_after**2)) for each in (together, apart))
    freed = len(apart.names) - len(together.names)
    if freed <= 0 or apart.dof < SPARE or not held > GAIN * free:
        return together
    if fdtrc(freed, apart.dof, (held - free) / freed / max(free / apart.dof, np.finfo(float).tiny)) > LEVEL:
        return together
    if not (moved := _moved(apart, old)):
        return together
    which = "; ".join(f"{new.replace(' of ', ' in session ', 1)}: {size} mm away" for new, size in moved.items())
    fall = f"the RMS falls from {together.rms_after:.4g} to {apart.rms_after:.4g} mm where each has a name of its own"
    doubt = f"reflectors are mounted elsewhere than in the session before ({which}): {fall}"
    return replace(together, doubts=(f"{doubt}; name them otherwise there, in the column marker", *together.doubts))


def _moved(apart: Identification, old: dict[str, str]) -> dict[str, str]:
    """How far each point that is moved significantly is from where the session before has it [mm], along the directions
    in which it is: the heights of a SCARA's reflectors, say, are hardly known."""
    chain = apart.model.arm.chain
    places: dict[str, Array] = composed_tools(chain, apart.model.parameters.mapping(apart.parameters))
    index = {name: k for k, name in enumerate(apart.names)}
    distances: dict[str, str] = {}
    for new, name in old.items():
        names = [f"{TOOL}[{each}].{axis}" for each in (new, name) for axis in "xyz"]
        if not {*names} <= {*index}:  # of a minimal set of parameters
            continue
        columns = np.array([index[each] for each in names])
        difference = np.kron([[1.0, -1.0]], np.eye(3))
        covariance = difference @ apart.covariance[np.ix_(columns, columns)] @ difference.T
        variances, axes = np.linalg.eigh(covariance)
        along = axes.T @ (places[new] - places[name])
        statistics = along**2 / np.maximum(variances, np.finfo(float).tiny)
        told = fdtrc(1, apart.dof, statistics) <= LEVEL / (3 * len(old))
        if told.any():
            told |= variances < HARDLY**2 * np.sum(along[told] ** 2)
            distances[new] = f"{'' if told.all() else 'at least '}{np.linalg.norm(along[told]):.3g}"
    return distances
