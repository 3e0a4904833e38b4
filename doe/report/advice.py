"""How many runs: the curve and the table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text

from doe.advise import Advice
from doe.design import Design
from doe.report.terminal import in_a_sentence, number, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NONE = "None of these plans is within 0.1 % of the bound."
ENOUGH = 0.999  # of the bound
MOST = 12  # rows of the table
# figure of `TipError` -> heading
TIP_ERRORS = {
    "right": "model\nright\n[mm]",
    "worst": "worst\npose\n[mm]",
    "missing": "effects\nmissing\n[mm]",
    "with_prior": "library\nprior\n[mm]",
}
RIGHT = (
    "Expected errors of the tip where nothing was measured (RMS over the workspace): if the model is right, and then "
    "at the worst pose."
)
DIAGNOSED = (
    "The model has the effects that its diagnosis found, at the sizes measured; others are not counted: armcal "
    "diagnose says which sizes its data rule out. armcal validate compares it with new measurements."
)
MISSING = (
    "The last two columns: if effects of typical size are missing, and if these are allowed for by identify "
    "--library-prior. They may rise with the runs: more runs do not help against a missing effect; the fit hides it in "
    "wrong lengths and zeros. Where effects may be missing, choose the postures "
    "with armcal design --robust."
)


def advice_figure(advice: Advice) -> Figure:
    """Efficiency and expected accuracy against the number of runs."""
    from matplotlib.figure import Figure  # deferred: tables need no pictures

    from doe.report.pictures import AFTER, BEFORE

    accuracies = [advice.accuracy(design) for design in advice.designs]
    known = all(accuracy is not None for accuracy in accuracies)
    figure = Figure(figsize=(10.0, 3.6) if known else (6.0, 3.6), layout="constrained")
    axes = figure.subplots(1, 2 if known else 1, squeeze=False)[0]
    good = set(advice.efficient_runs())
    efficiencies = [design.efficiency or float("nan") for design in advice.designs]
    axes[0].plot(advice.runs, efficiencies, color=AFTER, lw=1)
    colors = [AFTER if m in good else "white" for m in advice.runs]
    axes[0].scatter(advice.runs, efficiencies, c=colors, edgecolors=AFTER, s=30, zorder=3)
    axes[0].set(xlabel="runs m", ylabel="D-efficiency", title="filled: within 0.1 % of the bound")
    if known:
        axes[1].plot(advice.runs, accuracies, "o-", color=AFTER, ms=4, lw=1)
        if advice.target is not None:
            axes[1].axhline(advice.target, color=BEFORE, ls="--", lw=1)
        what = "expected error of the tip, model right [mm]" if advice.of_tip else "largest std of a length [mm]"
        axes[1].set(xlabel="runs m", ylabel=what, ylim=(0, None))
    return figure


def advice_tables(advice: Advice) -> list[Any]:
    """The answer in one sentence, a row for some of the numbers of runs, and what the figures do not promise."""
    known = [design.deviations for design in advice.designs]
    columns: dict[str, Iterable[str]] = {
        "runs": map(str, advice.runs),
        "efficiency": (efficiency(design) for design in advice.designs),
    }
    if not advice.of_tip and any(known):
        columns["length\nstd\n[mm]"] = [number(None if d is None else d.largest_length, 5) for d in known]
        columns["angle\nstd\n[deg]"] = [number(None if d is None else np.degrees(d.largest_angle), 5) for d in known]
    for key, heading in [*TIP_ERRORS.items()][: 4 if counts_missing(advice) else 2] if advice.tip_errors else ():
        columns[heading] = [number(getattr(error, key), 4) for error in advice.tip_errors]
    every, wanted = list(zip(*columns.values(), strict=True)), set(shown_runs(advice))
    rows = [row for m, row in zip(advice.runs, every, strict=True) if m in wanted]
    shown: list[Any] = [Text(advice_sentence(advice), style="bold"), table(list(columns), rows)]
    lines = ["* within 0.1 % of the bound."] if advice.efficient_runs() else []
    lines += (
        [] if len(rows) == len(every) else [f"{len(rows)} of {len(every)} numbers of runs; --json has all of them."]
    )
    tip = [RIGHT, MISSING if counts_missing(advice) else DIAGNOSED] if advice.tip_errors else []
    return [*shown, *lines, *map(Text, tip)]


def counts_missing(advice: Advice) -> bool:
    """Whether effects may be missing, as in a model that was not diagnosed."""
    return any(np.isfinite(error.missing) for error in advice.tip_errors)


def efficiency(design: Design) -> str:
    """Its share of the bound, with a star where the bound shows that little can be gained."""
    found = number(design.efficiency, 5)
    return f"{found} *" if design.efficiency is not None and design.efficiency >= ENOUGH else f"{found}  "


def shown_runs(advice: Advice) -> list[int]:
    """The numbers of runs that a table shows: the smallest for the target, and about `MOST` of the others, spread so
    that each is the same factor above the one before."""
    runs = sorted(set(advice.runs))
    spread = np.geomspace(runs[0], runs[-1], MOST)
    nearest = {min(runs, key=lambda m: abs(np.log(m / wanted))) for wanted in spread}
    found = set(runs) if len(runs) <= MOST else nearest
    return sorted(found | ({len(advice.smallest.plan)} if advice.smallest else set()))


def advice_sentence(advice: Advice) -> str:
    """What to do, in one line."""
    good = ", ".join(spans(advice.efficient_runs()))
    efficient = f"Plans within 0.1 % of the bound exist for m = {good}." if good else NONE
    if advice.target is None:
        return efficient
    smallest = advice.smallest
    if smallest is None:
        return f"No number of runs up to {max(advice.runs)} reaches {advice.target:g} mm. {efficient}"
    of = "at the tip" if advice.of_tip else "in each length"
    errors = (e for design, e in zip(advice.designs, advice.tip_errors, strict=False) if design is smallest)
    lacks = (e.missing for e in errors if np.isfinite(e.missing))
    missing = "".join(
        f"; at the tip {in_a_sentence(error)} mm if effects of typical size are missing" for error in lacks
    )
    suffice = f"{len(smallest.plan)} runs suffice for {advice.target:g} mm {of}, if the model is right{missing}."
    return f"{suffice} {efficient}"


def spans(runs: Sequence[int]) -> list[str]:
    """`4`, `6 to 40`: stretches of rising whole numbers, each said once."""
    found: list[list[int]] = []
    for m in sorted(runs):
        if found and m - found[-1][-1] == 1:
            found[-1].append(m)
        else:
            found.append([m])
    return [str(part[0]) if len(part) == 1 else f"{part[0]} to {part[-1]}" for part in found]
