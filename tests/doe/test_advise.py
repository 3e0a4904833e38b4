"""How many runs: without joint limits every number of them has an orthogonal plan, so the answer is known."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest

from doe import Design, DesignProblem, solve
from doe.advise import advise, with_scatter
from doe.bounds.column_generation import relax
from doe.cross_check import cross_check
from doe.report.design import BOUND_CUT, advice_document, advice_sentence
from identification import Arm, Calibration, EffectSpec, InputError, Model, Status
from identification.document import Sheet
from identification.reuse import only
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, problem
from tests.doe.plan.test_plan import whole_information

FREE = problem(Arm([260.0, 180.0, 120.0], sigma=0.1))


def test_lengths_are_known_to_sigma_over_the_root_of_the_runs() -> None:
    """M' = I (doe/README.md, "Planar theorem"): a length has the deviation 0.1 mm / sqrt(m), 7 runs for 0.04 mm."""
    found = advise(FREE, range(4, 10), target=0.04)
    assert found.runs == (4, 5, 6, 7, 8, 9)
    for design in found.designs:
        assert found.accuracy(design) == pytest.approx(0.1 / np.sqrt(len(design.plan)), rel=1e-6)
    assert len(found.smallest.plan) == 7
    assert found.efficient_runs() == found.runs
    assert replace(found, target=1e-3).smallest is None
    said = advice_sentence(found)
    assert said.startswith("7 runs suffice for 0.04 mm in each length, if the model is right; at the tip ")
    assert said.endswith(
        f" {found.tip_errors[3]['effects_missing']:.2f} mm if effects of typical size are missing. "
        "Plans within 0.1 % of the bound exist for m = 4 to 9."
    )
    data = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert data["smallest_runs"] == 7
    assert [row["runs"] for row in data["rows"]] == list(found.runs)
    for wrong, problem_given, runs, target in (
        ("sigma", problem(Arm([260.0, 180.0])), [4], 0.04),
        ("runs: 2", FREE, [2, 3], None),
    ):
        with pytest.raises(InputError, match=wrong):
            advise(problem_given, runs, target=target)


def test_one_joint_alone_by_its_lever() -> None:
    """One offset needs one posture: the arm stretched behind the joint, and sigma over that lever."""
    arm = Arm([260.0, 180.0, 120.0, 100.0], sigma=0.1)
    advice = advise(DesignProblem.of(only(arm, ["joint_offset:3"])), [1, 2], target=0.08)
    for design, m in zip(advice.designs, (1, 2), strict=True):
        assert design.certified_optimal
        assert design.deviations.joint_offset[2] == pytest.approx(0.1 / 220.0 / np.sqrt(m))
        assert design.deviations.joint_offset[[0, 1, 3]].tolist() == [0.0, 0.0, 0.0]
    # nothing but joint 3 is uncertain: its lever to the tip, of links 3 and 4, times that
    assert advice.of_tip
    lever = np.hypot(120.0, 100.0)  # root mean square over angles of joint 4
    assert advice.tip_errors[0]["model_right"] == pytest.approx(0.1 / 220.0 * lever, rel=0.02)
    assert advice.tip_errors[0]["model_right_worst"] == pytest.approx(0.1, rel=1e-3)
    assert np.isfinite(advice.tip_errors[0]["effects_missing"])
    assert advice.smallest is advice.designs[0]


@pytest.mark.parametrize("arm", [FOUR, replace(FIVE, sigma=0.1)], ids=["four", "five"])
def test_more_runs_never_tell_less(arm: Arm) -> None:
    """Whole information and its inverse from complex numbers; no posture added to a plan beats the plan of one more."""
    lengths, n = np.array(arm.lengths), arm.links
    plans = [d.plan.postures for d in advise(problem(arm), range(n, n + 3), seconds=0.4).designs]
    corners = np.array(list(product(*zip(arm.lower, arm.upper, strict=True))))
    places = np.concatenate([corners, np.random.default_rng(0).uniform(arm.lower, arm.upper, (300, n))])
    for fewer, more in pairwise(plans):
        after, before = whole_information(lengths, more), whole_information(lengths, fewer)
        added = max(np.linalg.slogdet(before + whole_information(lengths, q[None]))[1] for q in places)
        assert np.linalg.slogdet(after)[1] >= added - 1e-9
        now, then = (np.sqrt(np.diag(np.linalg.inv(each))) for each in (after, before))
        assert now[:n].max() <= then[:n].max() * (1.0 + 1e-8)  # largest deviation of a length
        assert (now[n:] / lengths).max() <= (then[n:] / lengths).max() * (1.0 + 1e-8)  # and of an angle
    hasty = advise(problem(arm), range(n + 1, n + 4), seconds=1e-6)  # no time at all
    accuracies = [hasty.accuracy(design) or np.inf for design in hasty.designs]
    assert accuracies == sorted(accuracies, reverse=True)


def test_without_a_sigma_the_scatter_of_the_calibration_stands_in() -> None:
    arm = Arm([260.0, 180.0, 120.0])
    assert with_scatter(replace(arm, sigma=0.1)) == (replace(arm, sigma=0.1), "")
    same, said = with_scatter(arm)
    assert same.sigma is None
    assert "add to the arm file the line [measurement] and below it sigma_mm = " in said
    lengths = {f"length_error:{k}": 0.0 for k in (1, 2, 3)}
    found, said = with_scatter(replace(arm, calibration=Calibration(lengths, provenance={"scatter_mm": 0.254})))
    assert found.sigma == 0.254
    assert "sigma_mm = 0.254, the scatter" in said
    shown = advice_document(advise(problem(arm), [4]))
    assert not any(isinstance(part, Sheet) and len(part.headings) != 2 for part in shown.parts)


def test_a_bound_that_time_cut_is_said_to_be() -> None:
    advice = advise(FREE, range(4, 6))
    assert BOUND_CUT not in advice_document(advice).parts
    cut = replace(advice, designs=tuple(replace(d, bound=replace(d.bound, cut=True)) for d in advice.designs))
    assert BOUND_CUT in advice_document(cut).parts


def test_ctrl_c_in_the_search_for_a_plan_ends_the_rest_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*args: Any, **options: Any) -> Design:
        return replace(solve(*args, **options), status=Status.interrupted)

    monkeypatch.setattr("doe.advise.solve", stopped)
    advice = advise(FREE, range(4, 7))
    assert advice.runs == (4,)
    assert Status.interrupted.value in advice_document(advice).parts


# -- three answers -----------------------------------------------------------------------------------------------------
# doe/README.md, "Planar theorem": only joint 3 with 160 deg is too narrow, 2 log(sin 80 deg) for each of its two links
EXPECTED = 4.0 * np.log(np.sin(np.radians(80.0)))


def test_three_answers_agree() -> None:
    lower, upper = np.radians([-180, -120, -100, -90]), np.radians([180, 120, 60, 90])
    case = DesignProblem.of(Model(Arm([260.0, 180.0, 120.0, 100.0], lower=lower, upper=upper)))
    relaxed = relax(case, 5, "clarabel")
    found = cross_check(case, relaxed, 8)
    methods = ["relaxation, clarabel", "column generation, column_generation", "exact plan, exchange", "closed form"]
    assert [row["method"] for row in found] == methods
    for row, tolerance in zip(found, (1e-4, 1e-8, 1e-7, 1e-12), strict=True):
        assert row["value"] == pytest.approx(EXPECTED, abs=tolerance)


def test_what_time_cut_is_said_to_be() -> None:
    """Bounds as well as plans."""
    case = problem(FIVE, ECCENTRICITY, EffectSpec("gear_ratio", 3))
    found = cross_check(case, relax(case, 3, stop=lambda: True), 12, seconds=0.05)
    assert all(", bound cut" in row["method"] for row in found)
