# ruff: noqa: F401 - the names of this package
"""Instruments: what is measured of an arm, one file each.

`KINDS` maps axes of arms, then words of arm files to classes (identification/README.md, "How to add an instrument").
"""

from identification.instruments.base import KINDS, Coordinate, Instrument, Placement, Unplaced, register_instrument
from identification.instruments.cups import Socket
from identification.instruments.distance import Distance, PlanarDistance, distance_to_center
from identification.instruments.probe import Plane, Sphere
from identification.instruments.tracker import TRACKER, Tracker
