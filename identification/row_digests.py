"""Which rows a calibration comes from, in little space: to tell later whether measurements are among them.

Each row's angles and position have a digest; of more than `KEPT` rows those with the smallest digests are kept: a
random sample that is the same whatever the order, and the smallest of a union are among the smallest of its parts
(A. Z. Broder, "On the resemblance and containment of documents", 1997).
"""

from __future__ import annotations

import binascii
from base64 import b64decode, b64encode
from hashlib import blake2b
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

ROW_DIGESTS = "digests_of_rows"  # key of a calibration's provenance
KEPT = 2000  # digests: of 12,000 rows one in six, so that 30 of them are missed once in 240 times; 16 kB of text
BYTES = 6  # of a digest: two of a million rows share one with a probability of 0.002 for each of a thousand others
STEP = 1e-3  # [rad, mm] numbers to the nearest: those written with three digits are still the same
BETWEEN = 0.5 + 1e-6  # of a step is added: what lies half way goes up, whatever its last bits are


class Shared(NamedTuple):
    """Estimated from the digests: the share of the measurements that the calibration comes from, and the share of what
    it comes from that is among the measurements."""

    measurements: float
    calibration: float


def digests(postures: Array, positions: Array) -> str:
    """Text of the digests of rows: postures (m, n) [rad, mm] and positions (m, d) [mm]."""
    return _text(_numbers(postures, positions))


def union(texts: list[str]) -> str:
    """Text of the digests of all rows of several texts."""
    return _text(np.concatenate([_read(text) for text in texts]))


def rows_shared(text: str, postures: Array, positions: Array) -> Shared:
    """How many rows two sets share: one of digests, and postures (m, n) with positions (m, d)."""
    kept, numbers = _read(text), np.unique(_numbers(postures, positions))
    if len(kept) >= KEPT:  # of these rows alone it can be told
        numbers = numbers[numbers <= kept[-1]]
    shared = np.count_nonzero(np.isin(numbers, kept))
    return Shared(shared / max(len(numbers), 1), shared / max(len(kept), 1))


def _numbers(postures: Array, positions: Array) -> NDArray[np.uint64]:
    """(m,) digests."""
    whole = np.floor(np.column_stack([postures, positions]) / STEP + BETWEEN).astype("<i8")
    hashed = [int.from_bytes(blake2b(row.tobytes(), digest_size=BYTES).digest(), "big") for row in whole]
    return np.array(hashed, dtype=np.uint64)


def _text(numbers: NDArray[np.uint64]) -> str:
    """Base 64 of the smallest numbers, in ascending order."""
    kept = np.unique(numbers)[:KEPT]
    return b64encode(b"".join(int(number).to_bytes(BYTES, "big") for number in kept)).decode()


def _read(text: str) -> NDArray[np.uint64]:
    """(k,) numbers, ascending; none of a text that no program wrote."""
    try:
        read = b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        read = b""
    numbers = [int.from_bytes(read[k : k + BYTES], "big") for k in range(0, len(read) - BYTES + 1, BYTES)]
    return np.unique(np.array(numbers, dtype=np.uint64))
