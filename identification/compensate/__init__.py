"""Joint commands that bring the real arm to its targets."""

from identification.compensate.compensation import compensate

__all__ = ["compensate"]
