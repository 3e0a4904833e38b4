"""What a plan could show of missing effects, before anything is measured: for the terminal."""

from __future__ import annotations

from typing import Any

from rich.text import Text

from doe.discrimination.design import MOST_SEEN, DiscriminationDesign
from doe.discrimination.misidentification import LAMBDA
from doe.report.terminal import table
from identification.gap.detectability import Detectability
from identification.gap.words import untested

HIDDEN = 0.01


def preflight_tables(sees: Detectability) -> list[Any]:
    """Visible fraction, smallest size and look-alikes of every effect."""
    pairs = sees.pairs()

    def row(name: str, visible: float) -> list[str]:
        alike = [f"{other} ({likeness:.2f})" for one, other, likeness in pairs if one == name]
        more = f" and {len(alike) - 2} more" if len(alike) > 2 else ""
        return [name, f"{visible:.2f}", str(sees.detectable[name]), ",\n".join(alike[:2]) + more]

    headings = ("effect", "visible", "smallest found", "looks like")
    title = "What this plan can show of missing effects (smallest: with 90 % power)"
    rows, text = map(row, sees.names, sees.norm_fractions), ("effect", "looks like")
    shown = table(headings, rows, title, left=text, no_wrap=headings[:3], padding=0)
    skipped = [Text(sentence) for sentence in untested(sees.skipped)]
    never = [Text(f"never identifiable: {key}: equivalent to {why}") for key, why in sees.aliases.items()]
    return [shown, Text(f"{sees.freedom} residual degrees of freedom"), *skipped, *never]


def discriminating_tables(found: DiscriminationDesign) -> list[Any]:
    """The efficiency that the plan gives up, and what it can detect in return."""
    lines = [
        f"D-efficiency relative to the best plan found: {found.relative_efficiency:.4f}",
        f"probability that a missing effect gets a wrong name: at most {found.wrong:.3f} "
        f"(the best plan: {found.best_wrong:.3f}, random postures: {found.random_wrong:.3f})",
        f"  for effects whose total shift (root sum of squares) at as many random postures is {LAMBDA:g} sigma; "
        "gear ripple, backlash and drift are left out",
    ]
    if found.sees is None or found.best_sees is None:
        if len(found.design.plan) > MOST_SEEN:
            lines.append(f"what a plan of more than {MOST_SEEN:,} runs can detect is not worked out")
        return [Text(line) for line in lines]
    blind, clear = nearly_invisible(found.best_sees), nearly_invisible(found.sees)
    lines.append(f"effects it cannot see: {', '.join(clear) or 'none'} (the best plan: {', '.join(blind) or 'none'})")
    return [*(Text(line) for line in lines), *preflight_tables(found.sees)]


def discriminating_data(found: DiscriminationDesign) -> dict[str, Any]:
    """The JSON keys that `--discriminating` adds."""
    return {
        "relative_efficiency": found.relative_efficiency,
        "wrong_name_at_most": {
            "plan": found.wrong,
            "best_plan": found.best_wrong,
            "random_postures": found.random_wrong,
        },
        "preflight": None if found.sees is None else found.sees.to_json(),
        "not_visible": nearly_invisible(found.sees),
        "not_visible_in_best_plan": nearly_invisible(found.best_sees),
    }


def nearly_invisible(sees: Detectability | None) -> list[str]:
    """Effects of which less than a hundredth of a column's norm is left for the tests to see."""
    if sees is None:
        return []
    return [name for name, left in zip(sees.names, sees.norm_fractions, strict=True) if left < HIDDEN]
