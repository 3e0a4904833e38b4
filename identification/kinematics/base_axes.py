"""Shifts of the base along its own axes and along those of the instrument, in numbers or CasADi symbols."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

SHIFTS = (("base.x", "base.y", "base.z"), ("base_offset.x0", "base_offset.y0"))  # in space, in the plane


def along(axes: Any, values: Mapping[str, float]) -> dict[str, Any]:
    """The shift among named values, turned by axes (d, d); empty where there is none."""
    names = next((names for names in SHIFTS if set(names) & set(values)), ())
    if not names:
        return {}
    turned = ca.mtimes(axes, ca.DM([values.get(name, 0.0) for name in names]))
    return {name: turned[k] for k, name in enumerate(names)}


def planar_axes(angle: Any) -> Any:
    """(2, 2) axes of a planar base that is turned by an angle [rad]: the offset of joint 1."""
    cos, sin = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(cos, -sin), ca.horzcat(sin, cos))
