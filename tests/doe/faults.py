"""What tests of faults share: which processes still run."""

from __future__ import annotations

from pathlib import Path


def running(process: int) -> bool:
    """Whether the process of this number works; one that has ended and waits to be collected does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False
