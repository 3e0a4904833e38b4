"""The cell in three dimensions: the script has the model's kinematics; a reader steps, plays, strikes out, prints."""

import io
import re
from base64 import b64decode
from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

from doe.report.figures import WHOLE, error_arrows, scene, shape, simplified
from doe.report.page import page
from doe.report.plan import plan_section
from identification import Arm, Calibration, Measurements, Model, Plan, design_model
from identification.document import Document
from identification.instruments import Distance
from identification.kinematics.chain import Joint, KinematicChain
from identification.kinematics.frames import pose
from identification.validate import Validation
from identification.workspace import Body, Cell, LineOfSight
from tests.doe.report.conftest import Watched
from tests.doe.six_axis import SIX_AXIS

RANDOM = np.random.default_rng(31)
ELBOW = Body("upper arm", 2, np.array([[0.0, 0.0, 150.0, -612.0, 0.0, 150.0, 60.0]]))
TABLE = Body("table", 0, boxes=np.array([[0.0, 0.0, -100.0, *np.eye(3).ravel(), 400.0, 400.0, 90.0]]))
ARM = replace(
    SIX_AXIS,
    constraints=(LineOfSight((2000.0, 800.0, 600.0), 0.9, (0.0, 0.0, 500.0)),),
    cell=Cell((ELBOW, TABLE), floor=-190.0),
)
POSTURES = RANDOM.uniform(-1.2, 1.2, (14, 6)) * [1.0, 0.3, 1.0, 1.0, 1.0, 1.0] - [0.0, np.pi / 2.0, 0.0, 0.0, 0.0, 0.0]
POSTURES[13, 1] = 0.5  # the upper arm in the table


def round_body(around: int) -> np.ndarray:
    """(t, 3, 3) triangles of a sphere of unit radius."""
    theta, phi = np.linspace(0.0, np.pi, around), np.linspace(0.0, 2.0 * np.pi, 2 * around)
    grid = np.stack([np.outer(np.sin(theta), f(phi)) for f in (np.cos, np.sin)] + [np.outer(np.cos(theta), phi**0)], -1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack(each, -2).reshape(-1, 3, 3) for each in ((a, b, c), (a, c, d))])


def test_three_js_is_small_licensed_and_asks_for_nothing() -> None:
    text = files("doe.report").joinpath("three.min.js").read_text("utf-8")
    assert len(text) <= 700_000
    assert "The MIT License" in text.partition("*/")[0]
    assert set(re.findall(r"https?://[\w.]+", text)) <= {"http://www.w3.org"}  # names of formats


# -- data --------------------------------------------------------------------------------------------------------------
def test_a_body_keeps_its_shape_with_few_triangles() -> None:
    vertices, faces = simplified(round_body(200), 6000)
    assert 3000 < len(faces) <= 6000
    corners = vertices[faces.astype(int)]
    assert np.abs(np.linalg.norm(corners.mean(axis=1), axis=1) - 1.0).max() < 0.02
    assert np.abs(np.linalg.det(corners).sum()) / 6.0 == pytest.approx(4.0 / 3.0 * np.pi, rel=0.01)
    cube = round_body(5)
    vertices, faces = simplified(cube, 3000)  # few enough: none is lost but those that are lines
    area = np.linalg.norm(np.cross(cube[:, 1] - cube[:, 0], cube[:, 2] - cube[:, 0]), axis=1)
    assert len(faces) == np.count_nonzero(area > 1e-12)
    assert {tuple(corner) for corner in vertices.round(9)} == {tuple(c) for c in cube.reshape(-1, 3).round(9) + 0.0}


def test_triangles_are_read_as_they_were_written() -> None:
    triangles = 100.0 * round_body(6) + [3.0, -70.0, 800.0]
    said = shape(triangles, 1000)
    whole, faces = (np.frombuffer(b64decode(said[key]), "<u2").reshape(-1, 3) for key in ("vertices", "faces"))
    corners = (said["low"] + said["step"] * whole)[faces]
    assert said["step"] == pytest.approx(200.0 / WHOLE, rel=1e-6)
    middle = np.sort(triangles[np.linalg.norm(np.ptp(triangles, axis=1), axis=1) > 0].mean(axis=1).sum(axis=1))
    assert set(corners.mean(axis=1).sum(axis=1).round(1)) <= {
        x for v in middle for x in (v.round(1), (v + 0.05).round(1), (v - 0.05).round(1))
    }


def test_a_body_without_triangles_looks_like_its_pieces() -> None:
    """Volume and area of a capsule and of a box that is turned; a sphere is a segment of no length."""
    start, end, radius = np.array([10.0, -20.0, 5.0]), np.array([310.0, 380.0, 5.0]), 60.0
    turn, half = Rotation.random(random_state=1).as_matrix(), np.array([400.0, 90.0, 50.0])
    rod, ball = np.array([[*start, *end, radius]]), np.array([[*start, *start, radius]])
    brick = np.array([[100.0, 0.0, -100.0, *turn.ravel(), *half]])
    sphere = 4.0 / 3.0 * np.pi * radius**3
    for body, volume, error in (
        (Body("rod", 2, rod), sphere + np.pi * radius**2 * 500.0, 0.03),
        (Body("ball", 2, ball), sphere, 0.03),
        (Body("brick", 0, boxes=brick), 8.0 * half.prod(), 1e-12),
    ):
        triangles = body.looks()
        outward = np.linalg.det(triangles - triangles.mean(axis=(0, 1)))  # counterclockwise from outside
        assert (outward > -1e-6).all()
        assert outward.sum() / 6.0 == pytest.approx(volume, rel=error)
    np.testing.assert_allclose(np.linalg.norm(Body("ball", 2, ball).looks() - start, axis=-1), radius)
    local = np.abs((Body("brick", 0, boxes=brick).looks() - brick[0, :3]) @ turn)
    np.testing.assert_allclose(local, np.broadcast_to(half, local.shape))


@pytest.mark.parametrize("sessions", [1, 2])
def test_arrows_are_turned_into_the_frame_of_the_base(sessions: int) -> None:
    """Positions in the frame of an instrument that stands anywhere, in each session elsewhere; errors of known size."""
    m = len(POSTURES)
    tips = design_model(Model(ARM)).joint_frames(POSTURES)[:, -1, :3, 3]
    errors, number = RANDOM.normal(size=(2, m, 3)), np.arange(m) % sessions
    turns = Rotation.random(sessions, random_state=3).as_matrix()[number]
    seen = np.einsum("mij,mj->mi", turns, tips) + np.array([[2000.0, -500.0, 90.0], [0.0, 0.0, 7.0]])[number]
    residuals = tuple(np.einsum("mij,mj->mi", turns, each) for each in errors)
    names = None if sessions == 1 else np.array(["a", "b"])[number]
    measured = Measurements(POSTURES, seen, session=names, session_names=() if names is None else ("a", "b"))
    (said,) = error_arrows("data.csv", Validation(ARM, measured, "base", (), residuals[1], residuals[0], "base"))
    np.testing.assert_allclose(said["at"], tips, atol=0.006)
    for model, expected in zip(said["models"], errors, strict=True):
        np.testing.assert_allclose(model["arrows"], expected, atol=1e-4)
        assert model["rms"] == pytest.approx(np.sqrt(np.mean(np.sum(expected**2, axis=1))))


def test_readings_that_are_no_positions_have_no_arrows() -> None:
    """Lengths; and what has as many columns as a position."""
    bar = replace(ARM, chain=replace(ARM.chain, instrument=Distance()))
    for arm, columns in ((ARM, 1), (bar, 3)):
        measured, left = Measurements(POSTURES, np.full((len(POSTURES), columns), 900.0)), np.ones((14, columns))
        assert error_arrows("data.csv", Validation(arm, measured, "base", (), left, left, "base")) == []


# -- in a browser ------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A page of an arm with bodies, a floor, a tracker, and measured errors."""
    tips = design_model(Model(ARM)).joint_frames(POSTURES)[:, -1, :3, 3]
    left = 0.1 * RANDOM.normal(size=tips.shape), RANDOM.normal(size=tips.shape)
    tests = {"<b>data.csv": Validation(ARM, Measurements(POSTURES, tips), "base", (), *left, "base")}
    section = plan_section(ARM, Plan(POSTURES), tests=tests)
    path: Path = tmp_path_factory.mktemp("scene") / "page.html"
    path.write_text(page(Document("In space", ["A cell."], [section])))
    return path.as_uri()


def sliding_arm() -> Arm:
    """A chain with a slide, axes that are not along a frame's, and what a calibration found."""
    axes = ((0.0, 0.0, -2.0), (1.0, 1.0, 0.5), (0.0, 1.0, 0.0), (0.3, -0.4, 1.0))
    joints = tuple(
        Joint(f"joint_{j}", pose(RANDOM.normal(size=3) * 300.0, Rotation.random(random_state=j).as_matrix()), axis,
              *(("prismatic", -300.0, 300.0) if j in (1, 2) else ("revolute", -3.0, 3.0)))
        for j, axis in enumerate(axes)
    )  # fmt: skip
    arm = Arm(KinematicChain(joints, pose((10.0, 20.0, 130.0)), tools={"1": np.array([30.0, 0.0, 80.0])}), sigma=0.05)
    values = dict(zip(Model(arm).names, RANDOM.normal(size=len(Model(arm).names)) * 0.01, strict=True))
    return replace(arm, calibration=Calibration(values))


@pytest.fixture(scope="module")
def seen(opened: Any, address: str) -> Iterator[Watched]:
    """The page, for tests to which it does not matter where they find it."""
    page = Watched(opened, address)
    yield page
    page.close(address)


def test_the_script_has_the_kinematics_of_the_model(seen: Watched) -> None:
    script = "([chain, q]) => q.map(one => jointFrames(chain, one).slice(1).map(frame => frame.elements))"
    for arm in (ARM, sliding_arm()):
        model = design_model(Model(arm))
        postures = RANDOM.uniform(model.lower, model.upper, (20, model.joints))
        found = np.array(seen.page.evaluate(script, [scene(model, postures, {})["chain"], postures.tolist()]))
        expected = model.joint_frames(postures)[:, 1:]
        assert np.linalg.norm(expected[:, -1, :3, 3], axis=1).min() > 1.0  # [mm]
        np.testing.assert_allclose(np.swapaxes(found.reshape(expected.shape), -1, -2), expected, rtol=0.0, atol=1e-9)


def picture(seen: Watched) -> np.ndarray:
    """What the canvas shows, as (height, width, 3)."""
    seen.page.evaluate("new Promise(drawn => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    return np.asarray(imread(io.BytesIO(seen.page.locator(".scene canvas").screenshot())))[..., :3]


def test_a_cell_is_stepped_through_with_keys(opened: Any, address: str) -> None:
    seen = Watched(opened, address)
    assert not seen.page.locator("svg.still").is_visible()
    canvas, keys, where = seen.page.locator(".scene canvas"), seen.page.keyboard, seen.page.locator(".where")
    assert canvas.get_attribute("aria-label")
    canvas.focus()
    assert canvas.evaluate("one => getComputedStyle(one).outlineStyle") == "solid"  # by keys its focus is seen
    seen.page.add_style_tag(content="canvas { outline: none !important }")  # and is not looked at below
    first = picture(seen)
    assert len(np.unique((first * 255).astype(int).reshape(-1, 3), axis=0)) > 200  # shaded, not blank
    script = "plans[0].cell.seen.map(one => [...one.toArray(), ...one.clone().project(plans[0].cell.camera).toArray()])"
    at_first = np.array(seen.page.evaluate(script))
    assert np.abs(at_first[:, 3:5]).max() < 1.0
    assert [-400.0, 400.0, -190.0] in at_first[:, :3].round().tolist()  # a corner of the table
    keys.press("ArrowRight")
    assert where.inner_text() == "Run 2, place 2 of 14"
    second = picture(seen)
    assert changed(first, second) > 0.005
    keys.press("Delete")
    assert reddish(picture(seen)) > reddish(second) + 0.003
    keys.press("ArrowLeft")
    assert changed(picture(seen), first) > 1e-4  # the run that was struck out is not among the others any more
    seen.page.get_by_role("button", name="Undo all").click()
    canvas.focus()
    keys.press("End")
    assert "upper arm and table overlap by" in where.inner_text()
    assert seen.facts()["runs with bodies too close"] == "1"
    assert reddish(picture(seen)) > reddish(first) + 0.003
    keys.press("Home")
    before = picture(seen)
    assert changed(before, first) == 0.0
    for key in ("Shift+ArrowLeft", "w", "+"):
        keys.press(key)
        turned = picture(seen)
        assert changed(before, turned) > 0.01, key
        before = turned
    keys.press("0")
    before = picture(seen)
    assert changed(before, first) == 0.0
    script = "plans[0].cell.runs[4].at(-1).clone().project(plans[0].cell.camera).toArray()"
    (x, y, _), size = seen.page.evaluate(script), canvas.bounding_box()
    canvas.click(position={"x": (x + 1.0) / 2.0 * size["width"] + 3, "y": (1.0 - y) / 2.0 * size["height"]})
    assert where.inner_text() == "Run 5, place 5 of 14"  # whose reflector was clicked
    before, said = picture(seen), [seen.page.locator("fieldset").inner_text()]
    for box in seen.page.locator("fieldset input").all():
        box.uncheck()
        canvas.focus()
        without = picture(seen)
        assert changed(before, without) > 1e-4  # arrows go
        before = without
        said.append(seen.page.locator("fieldset").inner_text())
    both, after, _ = (float(re.findall(r"Arrows: (\d+) times as long", each)[0]) for each in said)
    assert after > 5.0 * both  # of a tenth the size
    seen.close(address)


def changed(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the pixels that differ."""
    return float(np.mean(np.abs(one - other).max(axis=-1) > 0.02))


def reddish(image: np.ndarray) -> float:
    """Share of the pixels that are red."""
    return float(np.mean(image[..., 0] > 1.5 * image[..., 1]))


def test_moves_are_played_and_paused(seen: Watched) -> None:
    seen.page.evaluate("SPEED.revolute = 1e3")
    where, play = seen.page.locator(".where"), seen.page.get_by_role("button", name="Play")
    seen.page.get_by_role("button", name="Undo all").click()
    play.click()
    where.filter(has_text="place 3").wait_for(timeout=10_000)
    seen.page.locator(".scene canvas").focus()
    seen.page.keyboard.press(" ")
    assert play.is_visible()
    place = where.inner_text()
    seen.page.wait_for_timeout(700)
    assert where.inner_text() == place


def test_a_finger_turns_the_view_or_scrolls_the_page(opened: Any, address: str) -> None:
    seen = Watched(opened, address, has_touch=True, is_mobile=True)
    seen.page.locator(".scene").evaluate("one => one.scrollIntoView()")
    fingers = seen.context.new_cdp_session(seen.page)

    def swipe(across: float, down: float) -> tuple[np.ndarray, float]:
        """How far the camera [mm] and the page [px] moved."""
        state = "[...plans[0].cell.camera.position.toArray(), scrollY]"
        box, before = seen.page.locator(".scene canvas").bounding_box(), seen.page.evaluate(state)
        x, y = box["x"] + 150.0, box["y"] + 200.0
        for part in np.linspace(0.0, 1.0, 11):
            point = {"x": x + part * across, "y": y + part * down}
            kind = "touchMove" if part else "touchStart"
            fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [point]})
            seen.page.wait_for_timeout(16)
        fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        seen.page.wait_for_timeout(200)
        *moved, scrolled = np.subtract(seen.page.evaluate(state), before)
        return np.array(moved), scrolled

    turned, scrolled = swipe(80.0, 0.0)
    assert np.linalg.norm(turned) > 500.0
    assert scrolled == 0.0
    turned, scrolled = swipe(0.0, -80.0)
    assert scrolled > 40.0
    assert np.linalg.norm(turned) < 1e-6
    seen.close(address)


def test_way_points_are_passed_and_stay_with_their_move(opened: Any, tmp_path: Path) -> None:
    """Run 1 is reached by one, run 3 by two of them; they are in the edited file as long as run 2 is measured before
    run 3, as is how its joints come to it."""
    q = np.degrees(POSTURES[:6]).round(3)
    kinds = ["via", "measure", "measure", "via", "via", "measure"]
    signs = ["+1" if kind == "measure" else "" for kind in kinds]
    rows = [",".join([kinds[k], *map(str, q[k]), *6 * [signs[k]]]) for k in range(6)]
    names = ",".join(["kind", *(f"q{j}_deg" for j in range(1, 7)), *(f"direction{j}" for j in range(1, 7))])
    (tmp_path / "plan.csv").write_text("\n".join([names, *rows]) + "\n")
    plan = Plan.load(tmp_path / "plan.csv", ARM.joint_types, vias=True)
    (tmp_path / "page.html").write_text(page(Document("Via", [""], [plan_section(ARM, plan)])))
    seen = Watched(opened, (tmp_path / "page.html").as_uri())
    assert seen.page.locator(".plan tbody tr").count() == 3
    seen.page.get_by_role("button", name="Step").click()
    np.testing.assert_allclose(np.degrees(seen.page.evaluate("plans[0].way")), q[2:], atol=1e-6)
    travel = float(np.abs(np.diff(q, axis=0)).max(axis=1).sum())
    assert float(seen.facts()["joint travel"].removesuffix(" deg")) == pytest.approx(travel, abs=0.051)
    saved = []
    for button in ("Earlier", "Undo all", "Step"):
        with seen.page.expect_download() as download:
            seen.page.get_by_role("button", name="Download").click()
        download.value.save_as(tmp_path / f"{len(saved)}.csv")
        saved.append(Plan.load(tmp_path / f"{len(saved)}.csv", ARM.joint_types, vias=True))
        assert seen.facts().get("new moves, not checked", "0") == ("0" if len(saved) != 2 else "2")  # 2 1 3
        seen.page.get_by_role("button", name=button).click()
    seen.close((tmp_path / "page.html").as_uri())
    for file, order in zip(saved, ([*range(6)], [2, 1, 5], [*range(6)]), strict=True):
        np.testing.assert_allclose(np.degrees(file.postures), q[order], atol=1e-9)
        assert file.cells["kind"] == [kinds[k] for k in order]
        assert [file.cells[f"direction{j}"] for j in range(1, 7)] == 6 * [signs if len(order) > 3 else 3 * [""]]


def test_the_drawing_stands_in_in_print_and_no_other_script_runs(seen: Watched) -> None:
    """Three scripts of the page run, each known by its hash."""
    policy = seen.page.locator("meta[http-equiv]").get_attribute("content")
    assert policy.count("'sha256-") == 3
    assert "unsafe" not in policy.split("script-src")[1]
    text = "const one = document.createElement('script'); one.textContent = 'document.title = 1'"
    seen.page.evaluate(f"() => {{ {text}; document.body.append(one); }}")
    assert seen.page.title() == "In space"
    assert "Content Security Policy" in seen.said.pop()
    seen.page.emulate_media(media="print")
    assert seen.page.locator("svg.still").is_visible()
    assert not seen.page.locator("canvas").is_visible()
    assert len(seen.page.pdf()) > 10_000
    seen.page.emulate_media(media="screen")


def test_without_webgl_the_drawing_stands_in(opened: Any, address: str) -> None:
    seen = Watched(opened, address, "HTMLCanvasElement.prototype.getContext = () => null")
    assert seen.page.locator("svg.still").is_visible()
    assert seen.page.locator("canvas").count() == 0
    assert seen.page.get_by_role("button", name="Play").count() == 0
    seen.page.get_by_role("button", name="Step").click()
    assert seen.page.locator(".where").inner_text() == "Run 2, place 2 of 14"
    seen.close(address)
