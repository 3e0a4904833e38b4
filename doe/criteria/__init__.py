"""Criteria of optimality: one small protocol, one criterion per file."""

from doe.criteria.base import Criterion
from doe.criteria.d import D

__all__ = ["Criterion", "D"]
