"""Joint commands that bring the real arm to its targets."""

from identification.compensate.commands import compensate

__all__ = ["compensate"]
