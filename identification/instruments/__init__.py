# ruff: noqa: F401 - the names of this package
"""Instruments: what is measured of an arm, one class each.

`KINDS` maps axes of arms, then words of arm files to classes (identification/README.md, "How to add an instrument").
"""

from identification.instruments.base import KINDS, Coordinate, Guide, Instrument, OwnValue, register_instrument
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
