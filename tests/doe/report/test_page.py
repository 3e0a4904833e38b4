"""Pages in a real browser: they need no network, fit a phone, and a plan can be stepped through and edited in them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doe import DesignProblem, score
from doe.report.page import PlanSteps, page
from identification import Model, Plan, load_arm
from identification.document import Action, Document, Section, Sheet
from tests.doe.cli.conftest import Folder, table
from tests.doe.report.conftest import Watched

NASTY = """</script><script>document.title = "broken"</script><img src=x onerror="document.title='broken'">"""
CALIBRATED = "cal$x_$<i>--!>.toml"  # stands over pictures, where $ could begin a formula
SPATIAL = """\
kind = "spatial"
[measurement]
sigma_mm = 0.05
[tool.1]
x_mm = 60.0
y_mm = 40.0
z_mm = 100.0
"""
ROWS = ((0, 90, 127.3), (-612, 0, 0), (-572.3, 0, 0), (0, 90, 163.9), (0, -90, 115.7), (0, 0, 92.2))


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Folder]:
    """A folder with two pages: of a planar arm with a wicked name and all its files, of a spatial arm and a plan."""
    with pytest.MonkeyPatch.context() as patch:
        folder = Folder(tmp_path_factory.mktemp("pages"))
        patch.chdir(folder.path)
        folder.write("arm.toml", folder.read("arm.toml").replace('"paper-4-link"', f"'''{NASTY}'''"))
        folder.simulated()
        assert folder.armcal("identify", "arm.toml", "data.csv", "--out", CALIBRATED).code == 0
        done = folder.armcal("report", "arm.toml", CALIBRATED, "plan.csv", "data.csv", "--out", "page.html")
        assert done.code == 0, done.err
        dh = "".join(f"[[dh]]\na_mm = {a}\nalpha_deg = {alpha}\nd_mm = {d}\n" for a, alpha, d in ROWS)
        folder.write("six.toml", SPATIAL.replace('"spatial"\n', f'"spatial"\n{dh}', 1))
        postures = np.random.default_rng(3).uniform(-90.0, 90.0, (14, 6)).round(2)
        angles = {f"q{j}_deg": q for j, q in enumerate(postures.T, start=1)}
        folder.write("six.csv", table({"run": range(1, 15), **angles}))
        folder.said("report six.toml six.csv --out six.html")
        yield folder


def test_everything_is_escaped_and_nothing_is_fetched(pages: Folder) -> None:
    text = pages.read("page.html")
    assert len(text) < 6_000_000
    assert text.count("<script>") == 1  # nothing that draws in three dimensions
    assert "<i>" not in text
    assert 'onerror="' not in text
    assert "http" not in text.replace("http-equiv", "").replace("http://www.w3.org/", "").lower()
    parts = [NASTY, Sheet([NASTY], [[NASTY]], NASTY), PlanSteps(lambda: [NASTY], {"x": NASTY})]
    bare = page(Document(NASTY, [NASTY], [Section(NASTY, parts)], [Action(NASTY, NASTY)], [NASTY]))
    assert NASTY not in bare
    assert bare.count("<script>") == 1


def shown_at_any_width(seen: Watched) -> None:
    """In dark and light, with all that can be opened, and as PDF."""
    for width, scheme in ((1200, "dark"), (390, "light")):
        seen.page.set_viewport_size({"width": width, "height": 800})
        seen.page.emulate_media(color_scheme=scheme)
        seen.page.evaluate("for (const one of document.querySelectorAll('details')) one.open = true")
        root = seen.page.evaluate(
            "[document.documentElement.scrollWidth, innerWidth, getComputedStyle(document.body).backgroundColor]"
        )
        assert root[0] <= width == root[1]
        assert (sum(map(int, root[2].strip("rgb()").split(","))) < 3 * 128) == (scheme == "dark")
    assert len(seen.page.pdf()) > 10_000


@pytest.mark.parametrize(("name", "arm", "plan"), [("page", "arm.toml", "plan.csv"), ("six", "six.toml", "six.csv")])
def test_a_plan_is_stepped_edited_and_scored(pages: Folder, opened: Any, name: str, arm: str, plan: str) -> None:
    whole = scored(pages, arm, plan)
    address = (pages.path / f"{name}.html").as_uri()
    seen = Watched(opened, address)
    assert seen.page.title() == f"Calibration report: {NASTY if name == 'page' else 'arm'}"
    assert float(seen.facts()["log det M'"]) == pytest.approx(whole["log_det"], abs=1e-7)
    edit(seen)
    facts, without = seen.facts(), seen.page.locator(".plan tbody tr:not(.struck) td:last-child").all_inner_texts()
    with seen.page.expect_download() as download:
        seen.page.get_by_role("button", name="Download the edited plan").click()
    download.value.save_as(pages.path / "edited.csv")
    shown_at_any_width(seen)
    seen.close(address)
    edited = scored(pages, arm, "edited.csv")
    order = [1, 0, *range(3, whole["runs"])]  # counted from 0: run 2 is first now, run 3 is struck out
    assert edited["postures_deg"] == [whole["postures_deg"][k] for k in order]
    assert float(facts["log det M'"]) == pytest.approx(edited["log_det"], abs=1e-7)
    travel = np.abs(np.diff(edited["postures_deg"], axis=0)).max(axis=1).sum()
    assert float(facts["joint travel"].removesuffix(" deg")) == pytest.approx(travel, abs=0.051)
    left, *each = efficiencies(pages.path / arm, np.radians(whole["postures_deg"]), order)
    assert float(facts["D-efficiency against the whole plan"]) == pytest.approx(left, abs=5.1e-5)
    lost = -np.log(left) * len(load_problem(pages.path / arm).model.parameters)
    assert float(facts["log det lost, all runs together"]) == pytest.approx(lost, abs=1e-6)
    assert [float(text) for text in without] == pytest.approx(each, abs=5.1e-4)


def scored(folder: Folder, arm: str, plan: str) -> dict[str, Any]:
    """What `armcal score` says; of the spatial arm without its bound, which takes seconds."""
    if arm == "arm.toml":
        return folder.armcal("score", arm, plan, "--json").data
    return score(load_problem(folder.path / arm), Plan.load(folder.path / plan)).to_json()


def load_problem(arm: Path) -> DesignProblem:
    """The design problem of an arm file."""
    return DesignProblem.of(Model(load_arm(arm)))


def edit(seen: Watched) -> None:
    """Run 1 one place later, run 3 struck out: with the keyboard alone."""
    keys, focused = seen.page.keyboard, seen.page.locator(".plan tbody tr:focus")
    struck = seen.page.locator(".plan tr.struck")
    seen.page.get_by_role("button", name="Step").focus()
    keys.press("Enter")
    assert "place 2 of" in seen.page.locator(".plan").inner_text()
    keys.press("Delete")  # the button has the focus, not the table
    assert struck.count() == 0
    for _ in range(12):
        keys.press("Tab")  # from the buttons until a row has the focus; the table has one tab stop
        if focused.count():
            break
    assert seen.page.locator(".plan .runs [tabindex='0']").count() == 1
    assert seen.page.locator(".plan tr[aria-selected='true']:focus").count() == 1
    assert focused.locator("td").nth(1).inner_text() == "2"
    for key in ("End", "Home", "Alt+ArrowDown", "ArrowDown"):
        keys.press(key)
    for count in (1, 0, 1):
        keys.press("Delete")
        assert struck.count() == count
        assert [focused.locator("td").nth(k).inner_text() for k in (0, 1)] == ["3", "3"]
    keys.press("Tab")  # the next stop is behind the table
    assert focused.count() == 0
    seen.page.get_by_role("button", name="Put back").click()
    seen.page.get_by_role("button", name="Strike out").click()


def efficiencies(arm: Path, postures: np.ndarray, order: list[int]) -> list[float]:
    """(det / det of the whole plan)^(1/p) of the information of some runs, then without each of them."""
    problem = load_problem(arm)
    jacobians, known = problem.scaled_jacobians(postures), np.diag(problem.precisions)

    def log_det(runs: list[int]) -> float:
        total = known + sum((jacobians[k].T @ jacobians[k] for k in runs), np.zeros_like(known))
        return float(np.linalg.slogdet(total)[1])

    every = log_det(list(range(len(postures))))
    parts = [order, *([other for other in order if other != run] for run in order)]
    return [float(np.exp((log_det(part) - every) / problem.parameters)) for part in parts]
