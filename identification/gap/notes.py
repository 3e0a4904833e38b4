"""Notes of a diagnosis: aliases of the named effects in these data, and caveats about the data."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, rows_in_words
from identification.gap.candidate import Candidate
from identification.gap.confirmation import Gap
from identification.gap.curves.curve import Curve
from identification.gap.fit import Fit
from identification.gap.hypotheses.detectability import EXACT, NEAR, Detectability
from identification.gap.noise.misfit import Misfit
from identification.gap.posterior import MOST_ROWS, Posterior
from identification.inspection.data_checks import gap_notes
from identification.measurements import Measurements, distances
from identification.status import Status


def untested(skipped: Mapping[str, str]) -> list[str]:
    """One sentence for each reason why effects were not tested;  skipped : effect -> reason."""
    words = {"needs gravity": "needs [gravity] in the arm file", "needs temperature": "needs temperature_C that varies"}
    return [
        f"not tested, {words.get(why, why)}: {', '.join(key for key, reason in skipped.items() if reason == why)}"
        for why in dict.fromkeys(skipped.values())
    ]


def alias_list(before: Detectability, candidates: tuple[Candidate, ...]) -> tuple[tuple[str, str, float], ...]:
    """Near and exact aliases of the candidates' effects in these data, and effects that no data can show."""
    named = {key for c in candidates for key in c.effects}
    pairs = [pair for pair in before.pairs(NEAR) if pair[0] in named]
    return (*pairs, *((name, like, 1.0) for name, like in before.aliases.items()))


def hidden_orders(found: Posterior) -> tuple[tuple[str, str, float], ...]:
    """Gear ripples not distinguishable at these postures from an effect of the best set at the same joint.

    Returns triples (effect, ripple, likeness). On a grid of angles a ripple of 15 periods per turn can have the same
    column as an eccentric encoder; the diagnosis then names the more probable one.
    """
    products, blocks, listed = found.whole.products, found.whole.blocks, []
    for b, mine in enumerate(blocks):
        if mine.member is None or mine.member not in found.best.effects:
            continue
        for k, other in enumerate(blocks):
            if other.member is not None and other.member.scanned and k != b and other.place == mine.place:
                across = products.gram[np.ix_(products.places([b]), products.places([k]))]
                # columns have orthonormal directions, over the root of their number
                likeness = float(np.sqrt(np.sum(across**2) * across.shape[1]))
                if likeness >= NEAR:
                    listed.append((mine.label, other.label, min(likeness, 1.0)))
    return tuple(sorted(listed, key=lambda row: -round(row[2], 4)))


def order_notes(hidden: tuple[tuple[str, str, float], ...]) -> list[str]:
    """One sentence for each named effect with such ripples, from the triples of `hidden_orders`."""
    said = []
    for key in dict.fromkeys(key for key, _, _ in hidden):
        likes = [(other, likeness) for own, other, likeness in hidden if own == key]
        word = "cannot be distinguished from" if likes[0][1] >= EXACT else "is hard to distinguish from"
        more = f" and {len(likes) - 3} more" if len(likes) > 3 else ""
        listed = ", ".join(other for other, _ in likes[:3])
        said.append(f"at these postures {key} {word} {listed}{more}; to decide, measure at other joint angles")
    return said


def curve_notes(curves: tuple[Curve, ...]) -> list[str]:
    """A sentence with the ranges of joint angles in which the error curves hold."""
    if not curves:
        return []
    ranges = (np.degrees([curve.angles[0], curve.angles[-1]]) for curve in curves)
    said = ", ".join(
        f"joint {c.joint} {low:.0f} to {high:.0f} deg" for c, (low, high) in zip(curves, ranges, strict=True)
    )
    beyond = "where a joint is beyond them, the model is without curves, with the geometry that was fitted alone"
    return [f"the error curves hold for the angles measured ({said}); {beyond}"]


def unexplained_note(residual: Array, unexplained: NDArray[np.bool_]) -> list[str]:
    """A sentence about rows (m,) that nothing explains and that come together;  residual : (m, d) [mm]"""
    if not unexplained.any():
        return []
    far = f"up to {distances(residual)[unexplained].max():.3g} mm off"
    return [f"{rows_in_words(unexplained)} are not explained ({far}); they stay in, as whole postures or neighbors"]


def inseparable(joint: int) -> str:
    """The parameters that cannot be separated if a joint (from 0) does not move, in words."""
    if joint == 0:
        return "its offset cannot be separated from the orientation of the base"
    return f"the parameters of link {joint + 1} cannot be separated from those of link {joint}"


def notes(
    found: Posterior,
    measurements: Measurements,
    best: Fit,
    holdout: Measurements | None,
    gap: Gap,
    misfit: Misfit | None,
) -> list[str]:
    """Sentences to read before the verdict is trusted."""
    arm = found.library.arm
    said = untested(found.library.skipped)
    if len(measurements) > MOST_ROWS:
        searched = f"{MOST_ROWS} of the {len(measurements)} rows, taken at random"
        said.append(f"effects were looked for in {searched}; what was found is fitted to all")
    if best.status is not Status.converged:
        said.append(f"the fit of the best model did not converge: {best.status.value}")
    if measurements.directions is None:
        said += ["directions of approach were derived from the order of measurement", *gap_notes(measurements)]
    said += [
        f"joint {j + 1} does not move in these data: {inseparable(j)}"
        for j in range(arm.links)
        if np.ptp(measurements.postures[:, j]) == 0.0
    ]
    if misfit is not None and measurements.sigma is None and not 0.67 < misfit.ratio < 1.5:
        of_file = f"{misfit.ratio:.3g} times the sigma_mm of the arm file"
        said.append(f"the residual scatter is {of_file}; the tests use the scatter, not sigma_mm")
    if gap.held_out_after is not None and gap.predicted is not None and gap.held_out_after > 3.0 * gap.predicted:
        times = gap.held_out_after / gap.predicted
        said.append(f"the held-out residuals are {times:.2g} times larger than predicted: other postures or set-up?")
    if once := [h.key for h in found.best.effects if h.effect.once]:
        which = f"{', '.join(once)}: of this session only; the extended model has what is left of it at the end, as"
        said.append(f"{which} validate and compensate take it")
    if holdout is not None and any("drift" in h.key for h in found.best.effects):
        said.append("a drift of one session does not carry over to another; confirm it on held-out rows of this one")
    return said
