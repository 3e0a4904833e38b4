"""What the page says of rows that no fit has seen."""

from __future__ import annotations

import pytest

from doe.report.gap_sections import corrected_section, said
from identification.estimation.corrected_values import CorrectedValue

TEST = {"transfer": "another session", "file": "more.csv", "by": "holdout", "rows": 25, "groups": 8}


@pytest.mark.parametrize(
    ("shrinks", "as_predicted", "confirmed", "sentence"),
    [
        (True, True, True, "The model holds for more.csv (25 rows in 8 independent groups): the gap shrinks."),
        (
            True,
            None,
            True,
            "The error shrinks on rows not fitted (more.csv); 25 rows in 8 independent groups are too few to say "
            "whether by as much as expected.",
        ),
        (
            True,
            False,
            False,
            "For more.csv (25 rows in 8 independent groups) the gap shrinks, but by less than predicted.",
        ),
    ],
)
def test_rows_that_no_fit_has_seen(
    shrinks: bool | None, as_predicted: bool | None, confirmed: bool, sentence: str
) -> None:
    test = TEST | {"shrinks": shrinks, "as_predicted": as_predicted, "confirmed": confirmed}
    assert said(test) == sentence
    other = said(test | {"file": None, "by": "cross-validation"})
    assert "another session" in other
    assert "cross-validated" in other


def test_corrected_values_are_said_as_the_terminal_says_them() -> None:
    """Three significant digits of the standard deviation, which stands beside them."""
    row = CorrectedValue("length of link 1", None, 500.0, 501.079512, 0.0123, 501.05, 501.11, "mm", "")
    (sheet,) = corrected_section([row], spatial=False).sheets
    assert list(sheet.headings) == ["", "nominal", "corrected", "std", "low 95 %", "high 95 %", "unit"]
    assert sheet.rows == [["length of link 1", "500.0000", "501.0795", "0.0123", "501.0500", "501.1100", "mm"]]
