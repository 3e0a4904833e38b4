"""Plans of five robots judged by pinocchio and coal on their collision meshes: `pytest -m benchmark -s` with this file.

Needs pin and example-robot-data (`pip install pin coal trimesh example-robot-data`). Plans
of 30 postures are made by `armcal design` from each robot's URDF, five seeds each (`SEEDS=2`: two); every posture,
and every straight joint move at 400 places, is looked at for collisions of links that no joint connects.
"""

import csv
import json
import math
import os
import resource
import shutil
import subprocess
import sys
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doe import DesignProblem
from identification import Model, load_arm
from identification.files.urdf import MOVING, read_urdf

pytestmark = [pytest.mark.benchmark, pytest.mark.filterwarnings("ignore")]  # of pinocchio

pinocchio: Any = pytest.importorskip("pinocchio")
coal: Any = pytest.importorskip("coal")
trimesh: Any = pytest.importorskip("trimesh")
ROBOTS = {  # URDF, its ends
    "UR10": ("ur_description/urdf/ur10_robot.urdf", "base_link", "ee_link"),
    "UR5": ("ur_description/urdf/ur5_robot.urdf", "base_link", "ee_link"),
    "xArm7": ("xarm_description/urdf/xarm7.urdf", "link_base", "link7"),
    "Panda": ("panda_description/urdf/panda.urdf", "panda_link0", "panda_hand"),
    "Z1": ("z1_description/urdf/z1.urdf", "link00", "link06"),
}
SEEDS, RUNS, PLACES = range(int(os.environ.get("SEEDS", "5"))), 30, 400
TOOL = 40.0, 30.0, 80.0  # [mm]
BASE = "[measurement]\nsigma_mm = 0.05\n\n[tool]\nx_mm = {}\ny_mm = {}\nz_mm = {}\n".format(*TOOL)
FLOOR = "\n[cell]\nfloor_z_mm = 0.0\nclearance_mm = 20.0\n"
TRACKER = 2500.0, 600.0, 900.0  # [mm]
VIEW = """
[[constraints]]
kind = "line_of_sight"
tracker_mm = [2500.0, 600.0, 900.0]
half_angle_deg = 40.0
toward_mm = [0.0, 0.0, 500.0]
facing = [0.0, 0.0, 1.0]
acceptance_deg = 45.0
"""


def data() -> Path:
    """The folder in which `package://example-robot-data` is."""
    return Path(pinocchio.__file__).parents[4] / "share"


def triangles(drawn: Any) -> np.ndarray:
    """(t, 3, 3) of a mesh, or a shape [m]."""
    shape, made = drawn.geometry, trimesh.creation
    if isinstance(shape, coal.Box):
        return np.array(made.box(2.0 * shape.halfSide).triangles)
    if isinstance(shape, coal.Cylinder):
        return np.array(made.cylinder(shape.radius, 2.0 * shape.halfLength).triangles)
    return np.array(trimesh.load(drawn.meshPath, force="mesh").triangles * drawn.meshScale)


class Judge:
    """A robot's meshes; the pairs of links that a joint connects, or that touch at all of 300 random postures, count
    for nothing."""

    def __init__(self, urdf: Path, joints: list[str]) -> None:
        self.model = model = pinocchio.buildModelFromUrdf(str(urdf))
        self.geometry = pinocchio.buildGeomFromUrdf(model, str(urdf), pinocchio.COLLISION, [str(data())])
        self.places = [(model.idx_qs[k], model.nqs[k]) for k in map(model.getJointId, joints)]
        parents = [each.parentJoint for each in self.geometry.geometryObjects]
        for a, b in combinations(range(len(parents)), 2):
            one, other = parents[a], parents[b]
            if one != other and model.parents[one] != other and model.parents[other] != one:
                self.geometry.addCollisionPair(pinocchio.CollisionPair(b, a))
        limits = np.sort(
            [np.maximum(model.lowerPositionLimit, -3.1), np.minimum(model.upperPositionLimit, 3.1)], axis=0
        )
        low, high = limits[:, [k for k, _ in self.places]]
        postures = np.random.default_rng(0).uniform(low, high, (300, len(joints)))
        self.work, self.results = model.createData(), self.geometry.createData()
        always = np.all([self._pairs(q) for q in postures], axis=0)
        for k in np.flatnonzero(always)[::-1].tolist():
            self.geometry.removeCollisionPair(self.geometry.collisionPairs[k])
        self.results = self.geometry.createData()

    def _pairs(self, q: np.ndarray) -> np.ndarray:
        full = pinocchio.neutral(self.model)
        for (place, size), value in zip(self.places, q.tolist(), strict=True):
            full[place : place + size] = [value] if size == 1 else [math.cos(value), math.sin(value)]
        pinocchio.computeCollisions(self.model, self.work, self.geometry, self.results, full, False)
        return np.array([result.isCollision() for result in self.results.collisionResults], dtype=bool)

    def collides(self, q: np.ndarray) -> bool:
        return bool(self._pairs(q).any())

    def view(self, q: np.ndarray, base: str, tip: str) -> tuple[bool, float]:
        """Whether a ray from the tracker to the reflector misses all triangles of all meshes, and its angle [deg] to
        where the reflector looks."""
        self._pairs(q)
        pinocchio.updateFramePlacements(self.model, self.work)
        at, flange = (self.work.oMf[self.model.getFrameId(name)] for name in (base, tip))
        start, end = at.act(np.array(TRACKER) / 1e3), flange.act(np.array(TOOL) / 1e3)
        ray, blocked = end - start, False
        for each, place in zip(self.geometry.geometryObjects, self.results.oMg, strict=True):
            corners = triangles(each) @ place.rotation.T + place.translation
            a, b, c = np.moveaxis(corners, 1, 0)
            across = np.cross(ray, c - a)
            scale = np.sum((b - a) * across, axis=1)
            scale = np.where(np.abs(scale) > 1e-15, scale, np.inf)  # parallel
            turned = np.cross(start - a, b - a)
            one, other = np.sum((start - a) * across, axis=1) / scale, turned @ ray / scale
            along = np.sum((c - a) * turned, axis=1) / scale
            inside = (one >= 0.0) & (other >= 0.0) & (one + other <= 1.0)
            blocked |= bool(np.any(inside & (along > 0.0) & (along < 1.0)))
        cosine = -flange.rotation[:, 2] @ ray / np.linalg.norm(ray)
        return not blocked, math.degrees(math.acos(cosine))


def plan_of(folder: Path, arm: str, seed: int, *more: str) -> tuple[dict[str, Any], np.ndarray, list[str], float]:
    """The answer, all rows of the plan in order (measured and via), their kinds, and the processor time [s]."""
    (folder / "arm.toml").write_text(arm)
    command = ["design", "arm.toml", "--runs", str(RUNS), "--seed", str(seed), "--out", "plan.csv", "--force", "--json"]
    command += ["--package-dir", str(data()), *more] if "urdf" in arm else more
    start = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    done = subprocess.run([sys.executable, "-m", "doe", *command], cwd=folder, capture_output=True, text=True)
    seconds = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - start
    assert done.returncode == 0, done.stderr
    lines = [line for line in (folder / "plan.csv").read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    angles = np.radians([[float(value) for key, value in row.items() if key.startswith("q")] for row in rows])
    return json.loads(done.stdout), angles, [row.get("kind", "measure") for row in rows], seconds


def collisions(judge: Judge, rows: np.ndarray, kinds: list[str]) -> tuple[int, int]:
    """How many of the postures that are measured, and of the moves from row to row, collide."""
    ways = (np.linspace(start, end, PLACES) for start, end in pairwise(rows))
    hits = sum(judge.collides(q) for q, kind in zip(rows, kinds, strict=True) if kind == "measure")
    return hits, sum(any(map(judge.collides, way)) for way in ways)


@pytest.fixture(params=ROBOTS)
def robot(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Judge, str]:
    """Name, its judge, and the tables of its arm file, whose URDF is beside it."""
    urdf, base, tip = ROBOTS[request.param]
    path = data() / "example-robot-data/robots" / urdf
    shutil.copy(path, tmp_path)
    head = f'kind = "spatial"\nurdf = "{path.name}"\nbase_link = "{base}"\ntip_link = "{tip}"\n\n{BASE}'
    joints = [joint.name for joint in read_urdf(path).joints(base, tip) if joint.type in MOVING]
    return request.param, Judge(path, joints), head


@pytest.mark.parametrize(("floor", "least"), [("", 0.985), (FLOOR, 0.95)], ids=["bodies", "floor"])
def test_nothing_collides(robot: tuple[str, Judge, str], floor: str, least: float, tmp_path: Path) -> None:
    name, judge, head = robot
    pairs = len(judge.geometry.collisionPairs)
    print(f"\n{name}: {pairs} pairs of meshes, {'floor, 20 mm' if floor else 'own bodies'}")
    wrong = []
    for seed in SEEDS:
        plan, rows, kinds, seconds = plan_of(tmp_path, head + (floor or "\n[cell]\nclearance_mm = 0.0\n"), seed)
        bare, bare_rows, _, bare_seconds = plan_of(tmp_path, head + "\n[cell]\nbodies_of_urdf = false\n", seed)
        (hits, moves), before = collisions(judge, rows, kinds), sum(map(judge.collides, bare_rows))
        p = DesignProblem.of(Model(load_arm(tmp_path / "arm.toml"))).parameters
        efficiency = math.exp((plan["log_det"] - bare["log_det"]) / p)
        longer = plan["travel_deg"]["after"] / plan["moves"]["shortest_deg"] if plan["moves"] else math.inf
        print(
            f"  seed {seed}: {hits} postures and {moves} moves collide ({before} postures without bodies), "
            f"efficiency {efficiency:.4f}, {kinds.count('via')} via, travel {longer:.2f} times the shortest, "
            f"{seconds:.1f} s of a processor against {bare_seconds:.1f} s"
        )
        if hits or moves or efficiency < least or longer > 1.3:
            wrong.append(seed)
    assert not wrong


@pytest.mark.parametrize("robot", ["UR10"], indirect=True)
def test_robust_plans_are_free_and_short(robot: tuple[str, Judge, str], tmp_path: Path) -> None:
    name, judge, head = robot
    wrong = []
    for seed in SEEDS:
        plan, rows, kinds, seconds = plan_of(tmp_path, head, seed, "--robust")
        hits, moves = collisions(judge, rows, kinds)
        longer = plan["travel_deg"]["after"] / plan["moves"]["shortest_deg"]
        found = f"{hits} postures and {moves} moves collide, {kinds.count('via')} via, travel {longer:.2f} times"
        print(f"\n{name}, --robust, seed {seed}: {found} the shortest, {seconds:.1f} s of a processor")
        wrong += [seed] if hits or moves or longer > 1.3 else []
    assert not wrong


@pytest.mark.parametrize("robot", ["UR10", "Panda"], indirect=True)
def test_the_tracker_sees_the_reflector(robot: tuple[str, Judge, str], tmp_path: Path) -> None:
    """Of the plan without the constraint some postures are hidden, or look away."""
    name, judge, head = robot
    seen = []
    for view in (VIEW, ""):
        _, rows, kinds, _ = plan_of(tmp_path, head + FLOOR + view, 0)
        views = [judge.view(q, *ROBOTS[name][1:]) for q, kind in zip(rows, kinds, strict=True) if kind == "measure"]
        seen.append(sum(free and angle < 45.01 for free, angle in views))
    print(f"\n{name}: {seen[0]} of {RUNS} postures are seen, {seen[1]} without the constraint")
    assert seen[0] == RUNS > seen[1]
