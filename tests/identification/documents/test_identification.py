"""What a person reads of fits, validations and commands: nothing is lost, and what is not known is said."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from identification import Arm, DHRow, chain_of
from identification.compensate import Compensation
from identification.document import Sheet
from identification.documents.identification import (
    AMONG,
    BEYOND,
    FITTED,
    ZEROS,
    corrected_section,
    identification_actions,
    identification_verdict,
    refitted_in_words,
    validation_actions,
    validation_verdict,
)
from identification.documents.pictures import AFTER, BEFORE, dots, joint_errors, signed_figures, workspace_arrows
from identification.estimation.result import CorrectedValue
from tests.identification.estimation.cases import tip


def test_hundreds_of_effects_without_intervals_are_counted_and_not_listed() -> None:
    length = CorrectedValue("length of link 1", None, 500.0, 501.079512, 0.0123, 501.05, 501.11, "mm", "")
    names = [f"transmission_ripple:1[k={k}].a" for k in range(1, 26)]
    held = [CorrectedValue(n, n, 0.0, 0.01, None, None, None, "deg", "") for n in names]
    for many, listed in ((25, 1), (24, 25)):
        table, *lines = corrected_section("Corrected values", [length, *held[:many]]).parts
        assert isinstance(table, Sheet)
        assert len(table.rows) == listed
        assert any("25 more parameters of effects" in str(line) for line in lines) == (many == 25)


def test_intervals_of_a_fit_that_holds_what_it_does_not_list_say_so() -> None:
    """Beside the errors that are left as drawn a zero may be off by much more than its interval: not with a prior."""
    for prior_std in (None, 0.5):
        row = CorrectedValue("joint 3 x", None, 0.0, 1.0, 0.1, 0.8, 1.2, "mm", "", prior_std)
        _, *lines = corrected_section("Corrected values", [row]).parts
        assert any("Numbers not listed stay as drawn" in str(line) for line in lines) is (prior_std is None)


def test_a_fit_and_a_validation_in_a_sentence_each() -> None:
    fit = {"rms_before_mm": 3.0, "rms_after_mm": 0.25}
    drawing = "from 1.00 mm (drawing, placed as well as it can be) to"
    assert "from 3.00 to 0.250 mm" in identification_verdict(fit)
    assert f"{drawing} 0.250 mm" in identification_verdict(fit | {"rms_drawing_mm": 1.0})
    assert f"{drawing[:10]}px" in identification_verdict(fit | {"rms_drawing_mm": 1.0, "reading_unit": "px"})
    figures = {"rows": 7, "rms_mm": 0.1, "p95_mm": 0.2, "rms_nominal_mm": 1.0, "refit_nominal": "base", "notes": []}
    figures["refit"] = "base"
    said = validation_verdict(figures | {"notes": [FITTED]}, "c.toml", "d.csv")
    assert said.startswith(f"On 7 rows of d.csv, which it was fitted to, c.toml takes the RMS error {drawing} 0.100 mm")
    assert "this says nothing about others" in said
    assert "removed" not in said
    assert "more than 99.9 % of the error is removed" in validation_verdict(figures | {"rms_mm": 1e-5})
    said = validation_verdict(figures | {"notes": [f"60 % are {AMONG}", f"0.1 mm is {BEYOND}"]})
    assert said.startswith("On 7 rows of measurements that are in part the model's own, ")
    assert "90 % of the error is removed, and what is left is more than the file promises" in said
    left_out = identification_verdict(fit | {"cross_validated_mm": 2.0})
    assert left_out.endswith("to 0.250 mm; for postures left out of the fit it is 2.00 mm (noise included).")


def test_a_value_that_no_controller_tells_from_the_drawing_is_left_out() -> None:
    """The product of two small turns, say: 0.00000 +- 0.00001 deg."""
    figures = {"pitch": (1e-6, 1e-5), "yaw": (0.002, 1e-5), "roll": (0.0, 0.001)}
    rows = [CorrectedValue(n, None, 0.0, x, s, x - 2 * s, x + 2 * s, "deg", "") for n, (x, s) in figures.items()]
    rows.append(CorrectedValue("held", None, 0.0, 1e-9, None, None, None, "deg", ""))
    table, *_ = corrected_section("Corrected values", rows).parts
    assert isinstance(table, Sheet)
    assert [row[0] for row in table.rows] == ["yaw", "roll"]


def test_what_follows_from_a_validation_and_from_a_fit() -> None:
    refit = "armcal validate m.toml d.csv --refit offsets"
    again = "armcal identify m.toml d.csv --only joint_offsets,base"
    use = "armcal compensate m.toml targets.csv --out commands.csv"
    elsewhere, more = (False, "none", ["armcal validate m.toml d.csv"]), (False, "base", [refit, again])
    for better, how, expected in ((True, "base", [use]), elsewhere, more, (False, "offsets", [again])):
        data = {"rms_mm": 1.0, "rms_nominal_mm": 2.0 if better else 1.0, "refit": how, "notes": [], "refitted": []}
        actions = validation_actions(data, "m.toml", "d.csv")
        assert [action.command for action in actions] == expected
    good, look = {**data, "rms_nominal_mm": 2.0}, "armcal diagnose m.toml d.csv --report gap.html"
    for how in ("base", "offsets", "none"):  # zeros that are in no file come before commands from the file
        for notes, expected in (([f"1 mm is {BEYOND}; 0.1 mm {ZEROS}"], [again]), ([f"1 mm is {BEYOND}"], [look, use])):
            actions = validation_actions(good | {"refit": how, "notes": notes}, "m.toml", "d.csv")
            assert [action.command for action in actions] == expected
    in_cups = data | {"refitted": [{"name": "tool[1].x"}, {"name": "cup[A].x"}]}  # where no row places the base
    assert validation_actions(in_cups, "m.toml", "d.csv")[-1].command == f"{again},tool"
    first = identification_actions({"warnings": []}, "a.toml", "d.csv", None, diagnosed=False)
    assert first[0].text.endswith("add --out calibrated.toml to this command.")
    assert first[1].command.startswith("armcal diagnose a.toml d.csv")
    kept = identification_actions({"warnings": []}, "a.toml", "d.csv", Path("mine.toml"), diagnosed=True)
    assert [action.command.split()[1:3] for action in kept] == [["validate", "mine.toml"], ["compensate", "mine.toml"]]


@pytest.mark.parametrize(
    ("refit", "names", "words"),
    [
        ("base", "base_offset.x0 base_offset.y0 joint_offset:1", "position and rotation of the base"),
        ("base", "base.x base.rz tool[A].x", "position and rotation of the base, measured points"),
        ("base", "base.x base.y tool[1].z", "position of the base, measured points"),  # distances show no rotation
        ("base", "tool[1].x cup[A].x cup[B].z", "measured points, cups"),
        ("offsets", "base_offset.x0 joint_offset:1 joint_offset:2", "joint offsets, position of the base"),
        ("none", "", ""),
    ],
)
def test_what_was_refitted_in_words(refit: str, names: str, words: str) -> None:
    assert refitted_in_words({"refit": refit, "refitted": [{"name": name} for name in names.split()]}) == words


def test_a_prior_that_may_help_is_not_advised_against() -> None:
    """Better by a quarter, but not beyond chance: that the geometry predicts as well would not be so."""
    for rms, file in ((0.26, "geometry.toml"), (0.36, "calibrated.toml")):
        offered = {"better": False, "rms_mm": rms, "rms_geometry_mm": 0.35}
        data = {"warnings": [], "prior": {}, "offered": offered}
        first, *_ = identification_actions(data, "a.toml", "d.csv", Path("mine.toml"), diagnosed=False)
        assert first.command == f"armcal identify a.toml d.csv --no-library-prior --out {file}"
        assert ("no worse" in first.text) is (rms > 0.35)


def test_counts_of_targets_without_a_command() -> None:
    """One joint turned by 0.5 rad for every target: row 2 is out of reach, row 3 barred; both lack angles, and a
    sentence says how many and why."""
    errors, barred = np.array([0.0, 3.0, 0.0]), ("", "", "constraint 1 (box) is missed by 2 mm")
    found = Compensation(Arm([100.0]), np.zeros((3, 2)), np.full((3, 1), 0.5), errors, barred=barred)
    assert np.isnan(found.safe_commands).tolist() == [[False], [True], [True]]
    document = found.document()
    why = "2 have no command (angles left empty): 1 out of reach, 1 blocked by a constraint (rows 2, 3)."
    assert document.verdict == [f"1 of 3 targets reached by the calibrated model. {why}"]
    table, *reasons = document.parts
    assert isinstance(table, Sheet)
    assert [row[3:] for row in table.rows] == [["28.648", "< 1e-6"], ["-", "3.0000"], ["-", "-"]]
    assert len(reasons) == 2


# -- pictures ----------------------------------------------------------------------------------------------------------
LENGTHS = np.array([300.0, 200.0])


def test_a_joint_that_turns_too_far_has_a_positive_error_of_that_size() -> None:
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (40, 2))
    ends = [tip(q + step, LENGTHS) - tip(q - step, LENGTHS) for step in 1e-6 * np.eye(2)]
    levers = np.stack(ends, axis=2) / 2e-6
    wrong = 1e-4 * np.sin(q[:, 1])
    measured = tip(q + wrong[:, None] * [0.0, 1.0], LENGTHS)  # the real joint 2 is turned farther than is read
    # the second link's lever is always 200 mm long; the tip moves along the arc by error * 200 to first order
    np.testing.assert_allclose(joint_errors(levers, measured - tip(q, LENGTHS))[:, 1], wrong, atol=1e-8)
    short = np.zeros((1, 2, 1))
    np.testing.assert_array_equal(joint_errors(np.concatenate([short, np.ones((1, 2, 1))]), np.ones((2, 2)))[0], 0.0)


def test_a_picture_of_each_joint_has_what_both_models_leave() -> None:
    """Of the rows of a gear ripple in joint 2 the earlier model lacks it, the later one has it."""
    q = np.random.default_rng(7).uniform(-1.5, 1.5, (40, 2))
    wave = 1e-6 * np.sin(9.0 * q[:, 1])
    left = tip(q + wave[:, None] * [0.0, 1.0], LENGTHS) - tip(q, LENGTHS)
    read, *figures = signed_figures(Arm(LENGTHS), q, [(left, "the drawing"), (np.zeros_like(left), "the model")], None)
    assert str(read).endswith("Red: the drawing. Blue: the model.")
    first, second = (figure.axes[0] for figure in figures if isinstance(figure, Figure))
    assert (first.get_xlabel(), second.get_xlabel()) == ("joint 1 [deg]", "joint 2 [deg]")
    red, blue = (
        next(line for line in second.lines if line.get_color() == color and line.get_marker() == ".").get_xydata()
        for color in (BEFORE, AFTER)
    )
    np.testing.assert_allclose(red, np.degrees(np.column_stack([q[:, 1], wave])), atol=1e-9)
    np.testing.assert_allclose(blue[:, 1], 0.0, atol=1e-12)
    slides = Arm(chain_of([DHRow(0.0, 0.0, 0.0, 0.0, "prismatic", (-1e3, 1e3)), DHRow(200.0, 0.0, 0.0)]))
    _, *figures = signed_figures(slides, q, 2 * [(np.zeros((40, 3)), "a model")], None)
    assert [figure.axes[0].get_title() for figure in figures if isinstance(figure, Figure)] == ["", ""]


def test_errors_at_one_position_are_drawn_as_they_are() -> None:
    """Contacts always read zero: the numbers beside the axes are those of the errors."""
    left = np.array([[0.3, -0.4], [0.1, 0.2]])
    axes = workspace_arrows(Arm(LENGTHS), np.zeros((2, 2)), [(left, "before"), (left / 2.0, "after")]).axes[0]
    assert axes.get_title().endswith(", arrows x 1")
    (arrows,) = axes.collections
    assert isinstance(arrows, Quiver)
    np.testing.assert_array_equal(np.column_stack([arrows.U, arrows.V]), left)


def test_no_label_leaves_a_small_picture() -> None:
    """The numbers beside the ticks decide how much room these have, and so how many there are; whatever the scale."""
    for size in (0.02, 0.05, 0.09):
        figure = Figure(figsize=(3.7, 2.5), layout="constrained")
        axes = figure.subplots()
        dots(axes, np.linspace(0.0, 100.0, 30), [(np.full(30, size), "before"), (np.full(30, -size), "after")])
        axes.set_ylabel("error [deg]")
        figure.draw_without_rendering()
        label = axes.yaxis.label.get_window_extent(FigureCanvasAgg(figure).get_renderer())
        assert label.x0 > -2.0  # pixels of the font's own margin
