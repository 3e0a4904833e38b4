"""What an instrument reads of a measured point: where it is, how far from a fixed center, how high above a plane.

The frame of the instrument has its origin at the center, or its z axis normal to the plane: then a length is
|p| or p_z, and what nobody knows of center or plane is where the base of the arm stands in that frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.kinematics.frames import AXES, from_own_axes, own_axes_angles, pose, rotation_about

POSITION, DISTANCE, SPHERE, PLANE = "position", "distance", "sphere", "plane"
RADIUS = "sphere.radius"  # [mm] the parameter, where the arm file does not say it
CONTACTS = (SPHERE, PLANE)  # nothing is read but the joints: a surface is touched
SPINS = np.arange(0.0, np.pi, np.pi / 6.0)  # [rad] turns about a plane's normal that are tried
STEP = 1e-5  # [rad] of a difference quotient
TINY = 1e-9  # [mm] a point this near to the center has no direction from there


@dataclass(frozen=True)
class Instrument:
    """kind : `position` [mm], `distance` from a center, contact with a `sphere` or a `plane`

    radius : [mm] of the sphere on which the measured point then is; None: a parameter, `RADIUS`
    read : whether it reads; if not, positions in its frame are what is asked for
    """

    kind: str = POSITION
    radius: float | None = None
    read: bool = True

    @property
    def whole(self) -> bool:
        """Whether it reads positions."""
        return self.kind == POSITION or not self.read

    @property
    def free_radius(self) -> bool:
        """Whether it touches a sphere whose radius is to be found."""
        return self.kind == SPHERE and self.radius is None

    @property
    def shows_size(self) -> bool:
        """Whether an arm twice as large would read otherwise: not on a plane, nor on a sphere that may be, too."""
        return self.kind != PLANE and not self.free_radius

    @property
    def unread(self) -> Instrument:
        """Positions in its frame, with the same parameters."""
        return replace(self, read=False) if self.free_radius else WHOLE

    @property
    def contact(self) -> bool:
        """Whether it reads nothing: a surface is touched."""
        return self.kind in CONTACTS

    @property
    def distances(self) -> bool:
        """Whether it reads how far the center is."""
        return self.kind == DISTANCE

    def symbolic(self, point: ca.SX, values: ca.SX) -> ca.SX:
        """What it reads [mm] of a point (3,) in its frame, in CasADi; of a sphere of unknown radius the height above.

        values : of the geometry's parameters, the radius last
        """
        if self.whole:
            return point
        length = point[2] if self.kind == PLANE else ca.sqrt(ca.sumsqr(point) + TINY**2)
        return length - values[-1] if self.free_radius else length

    def linearized(self, points: Array) -> tuple[Array, Array]:
        """(..., 1) lengths that it reads of points (..., 3) in its frame, and their derivatives (..., 1, 3)."""
        if self.kind == PLANE:
            return points[..., 2:], np.broadcast_to(np.eye(3)[2:], (*points.shape[:-1], 1, 3))
        length = np.sqrt(np.sum(points**2, axis=-1, keepdims=True) + TINY**2)
        return length, (points / length)[..., None, :]

    def hidden(self, base: Array) -> frozenset[str]:
        """Parameters that move arm and instrument together, or turn the frame of the instrument about what it reads: no
        reading depends on them. The offset of joint 1 moves all that lies beyond, as the base does.

        base : (4, 4) about where the base stands in the frame of the instrument
        """
        if self.whole:
            return frozenset()
        if self.kind == PLANE:  # the base turned about the axis that is nearest to the normal
            about = AXES[int(np.argmax(np.abs(base[2, :3])))]
            return frozenset({"base.x", "base.y", f"base.r{about}", "joint_offset:1"})
        return frozenset({*(f"base.r{axis}" for axis in AXES), "joint_offset:1"})

    def between(self, first: Array, base: Array) -> tuple[dict[str, float], frozenset[str]]:
        """What brings a base (4, 4) to where it stands in a later session, `x y z wx wy wz` [mm, rad] (`session_base`),
        and those of them on which no reading depends.

        A plane does not show how the base is turned about the normal: of such turns that is taken which lets two of the
        three rotations tilt the normal best.
        """
        if self.kind != PLANE:
            turns = frozenset(f"w{axis}" for axis in AXES)
            return _relative(first, base), frozenset() if self.whole else turns
        spun = (pose(rotation=rotation_about([0.0, 0.0, 1.0], angle)) @ base for angle in SPINS)
        best = max(
            ((_relative(first, one), about) for one in spun for about in AXES), key=lambda f: _tilting(first, *f)
        )
        return best[0], frozenset({"x", "y", f"w{best[1]}"})


def _relative(first: Array, base: Array) -> dict[str, float]:
    """Shift along the axes of the instrument and rotations about the own axes from a base (4, 4) to another."""
    shift, turn = base[:3, 3] - first[:3, 3], own_axes_angles(first[:3, :3].T @ base[:3, :3])
    return {name: float(x) for name, x in zip((*AXES, *(f"w{axis}" for axis in AXES)), (*shift, *turn), strict=True)}


def _tilting(first: Array, rotation: Mapping[str, float], held: str) -> float:
    """How far two of the rotations, without that about the axis held, tilt a normal in the direction they tilt it least
    [1]."""
    turn, steps = np.array([rotation[f"w{axis}"] for axis in AXES]), STEP * np.eye(3)
    free = [k for k in range(3) if AXES[k] != held]
    ends = [[first[2, :3] @ from_own_axes(*(turn + sign * steps[k])) for sign in (1.0, -1.0)] for k in free]
    return float(np.linalg.svd([(up - down) / (2.0 * STEP) for up, down in ends], compute_uv=False)[-1])


WHOLE = Instrument()  # of positions, as a laser tracker
