"""Instruments: what is measured of an arm, one class each.

`KINDS` maps the words of arm files to classes (identification/README.md, "How to add an instrument").
"""

from identification.instruments.base import (
    IN_PLANE,
    KINDS,
    Coordinate,
    Guide,
    Instrument,
    OwnValue,
    kinds,
    register_instrument,
)
from identification.instruments.library import (
    TRACKER,
    Distance,
    PlanarDistance,
    Plane,
    Socket,
    Sphere,
    Tracker,
    distance_to_center,
)
from identification.instruments.search import Placement, Unplaced

__all__ = [
    "IN_PLANE",
    "KINDS",
    "TRACKER",
    "Coordinate",
    "Distance",
    "Guide",
    "Instrument",
    "OwnValue",
    "Placement",
    "PlanarDistance",
    "Plane",
    "Socket",
    "Sphere",
    "Tracker",
    "Unplaced",
    "distance_to_center",
    "kinds",
    "register_instrument",
]
