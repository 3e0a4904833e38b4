"""Instruments: what is measured of an arm, one class each.

`KINDS` maps the words of arm files to classes (identification/README.md, "How to add an instrument").
"""

from identification.instruments.base import KINDS, Coordinate, Guide, Instrument, OwnValue, register_instrument
from identification.instruments.distance import Distance
from identification.instruments.plane import Plane
from identification.instruments.search import Placement
from identification.instruments.socket import Socket
from identification.instruments.sphere import Sphere
from identification.instruments.tracker import TRACKER, Tracker

__all__ = [
    "KINDS",
    "TRACKER",
    "Coordinate",
    "Distance",
    "Guide",
    "Instrument",
    "OwnValue",
    "Placement",
    "Plane",
    "Socket",
    "Sphere",
    "Tracker",
    "register_instrument",
]
