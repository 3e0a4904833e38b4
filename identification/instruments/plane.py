"""A touch probe on planes: the measured point is on a plane, or always off it by the same."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.instruments.base import Guide, Instrument, register_instrument, relative
from identification.instruments.search import Placement, Unplaced
from identification.instruments.surfaces import PlaneStarts, placed_by_lengths
from identification.kinematics.frames import AXES, from_own_axes, pose, rotation_about

STEP = 1e-5  # [rad] of a difference quotient


@register_instrument
@dataclass(frozen=True)
class Plane(Instrument):
    """The z axis of its frame is the normal of the plane: read is the height above; shifts along the plane and turns
    about its normal no contact shows."""

    kind = "plane"
    keys = frozenset({"center_mm", "normal"})
    target = "surface"
    guide = Guide(
        about="a touch probe: the measured point is on a plane, wherever that lies",
        table='kind = "plane"',
        reads="touch",
        stands="plane",
        labels="plane that is touched",
        touches="three planes or more\nthat lean differently",
    )

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return point[2]

    def hidden(self, base: Array) -> frozenset[str]:
        """The turn about that axis of the base that is nearest to the normal stands for the turn about the normal."""
        return frozenset({"base.x", "base.y", f"base.r{AXES[int(np.argmax(np.abs(base[2, :3])))]}"})

    def between(self, first: Array, base: Array) -> tuple[dict[str, float], frozenset[str]]:
        """A plane does not show how the base is turned about the normal: of such turns that is taken which lets two of
        the three rotations tilt the normal best."""

        def tilting(choice: tuple[dict[str, float], str]) -> float:
            """How far two of the rotations, without that about the axis held, tilt a normal in the direction they tilt
            it least [1]."""
            rotation, held = choice
            turn, steps = np.array([rotation[f"w{axis}"] for axis in AXES]), STEP * np.eye(3)
            free = [k for k in range(3) if AXES[k] != held]
            ends = [[first[2, :3] @ from_own_axes(*(turn + sign * steps[k])) for sign in (1.0, -1.0)] for k in free]
            return float(np.linalg.svd([(up - down) / (2.0 * STEP) for up, down in ends], compute_uv=False)[-1])

        angles = np.arange(0.0, np.pi, np.pi / 6.0)
        spun = (pose(rotation=rotation_about([0.0, 0.0, 1.0], angle)) @ base for angle in angles)
        movement, about = max(((relative(first, one), about) for one in spun for about in AXES), key=tilting)
        return movement, frozenset({"x", "y", f"w{about}"})

    @property
    def size_is_open(self) -> tuple[str, str]:
        return "contacts with planes", "only [machining] tells"

    def place(self, rows: Unplaced) -> Placement:
        return placed_by_lengths(PlaneStarts, rows)
