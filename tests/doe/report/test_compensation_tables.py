"""Commands in a terminal: those that miss their target are counted and left out."""

import numpy as np

from doe.report.compensation_tables import compensation_tables, without_command
from identification.compensate.compensation import Compensation


def commands(errors: list[float], missed: list[float]) -> Compensation:
    """One joint turned by 0.5 rad for every target."""
    k = len(errors)
    angles, targets = np.full((k, 1), 0.5), np.zeros((k, 2))
    return Compensation(targets, angles, angles, np.array(errors), (), None, None, ("box",), np.array(missed)[:, None])


def test_counts_of_targets_without_a_command() -> None:
    """Row 2 is out of reach, row 3 barred; both lack angles, and a sentence says how many and why."""
    found = commands([0.0, 3.0, 0.0], [-1.0, -1.0, 2.0])
    assert without_command(found) == [
        "2 have no command (angles left empty): 1 out of reach, 1 barred by a constraint (rows 2, 3)."
    ]
    assert np.isnan(found.safe_commands).tolist() == [[False], [True], [True]]
    first, shown, *reasons = compensation_tables(found)
    assert first.plain.startswith("1 of 3 targets reached")
    assert [cell.plain for cell in shown.columns[3].cells] == ["28.648", "-", "-"]
    assert [cell.plain for cell in shown.columns[4].cells] == ["< 1e-6", "3.0000", "-"]
    assert len(reasons) == 2


def test_nothing_is_said_where_every_target_is_reached() -> None:
    assert without_command(commands([0.0, 1e-9], [-1.0, -1.0])) == []


def test_long_lists_of_rows_are_cut() -> None:
    assert without_command(commands([1.0] * 20, [-1.0] * 20)) == [
        "20 have no command (angles left empty): out of reach (rows 1, 2, 3, 4, 5, 6, 7, 8, ...)."
    ]
