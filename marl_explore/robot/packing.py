"""Evidence as bytes, compressed; unpacking takes no more memory than the stated size needs."""

from __future__ import annotations

import zlib

import numpy as np

from marl_explore.robot.evidence import NEVER_SEEN, Evidence

MOST_CELLS = 2**20
"""Of a map that robots share."""
OLDEST = 2**16 - 1
_MOST_TICKS = 2**61
_AHEAD = 255  # ranks are at most so far ahead of the tick
_WORTH = 8  # of a look: without it cells seen at one tick have the same age, which packs better


def pack(evidence: Evidence, tick: int) -> bytes:
    """Looks of all cells, then the age of each known one in ticks, at most ``OLDEST``."""
    known = evidence.looks != 0
    worth = _WORTH * np.abs(evidence.looks[known]).astype(np.int64)
    age = np.clip(tick + _AHEAD - evidence.rank[known] + worth, 0, OLDEST)
    low, high = (age & 255).astype(np.uint8), (age >> 8).astype(np.uint8)
    return zlib.compress(evidence.looks.tobytes() + low.tobytes() + high.tobytes(), 9)


def unpack(data: bytes, height: int, width: int, tick: int) -> Evidence:
    """The evidence that was packed at a tick.

    Raises:
        ValueError: for a map that is too large, before anything is unpacked, or whatever is not
            the evidence for a map of that size.
    """
    cells = height * width
    if cells > MOST_CELLS:
        raise ValueError(f"a map of {height} x {width} cells is too large: at most {MOST_CELLS}")
    if tick > _MOST_TICKS:
        raise ValueError(f"tick={tick} is not allowed: at most {_MOST_TICKS}")
    raw = _inflated(data, 3 * cells)
    looks = np.frombuffer(raw[:cells], np.int8)
    known = looks != 0
    needed = cells + 2 * int(known.sum())
    if len(raw) != needed or len(looks) != cells:
        raise ValueError(
            f"a map of {height} x {width} cells has {needed} bytes unpacked, not {len(raw)}"
        )
    low, high = np.frombuffer(raw[cells:], np.uint8).reshape(2, -1).astype(np.int64)
    rank = np.full(cells, NEVER_SEEN, np.int64)
    rank[known] = tick + _AHEAD - (low | high << 8) + _WORTH * np.abs(looks[known]).astype(np.int64)
    evidence = Evidence(looks.reshape(height, width), rank.reshape(height, width))
    evidence.check()
    return evidence


def _inflated(data: bytes, most: int) -> bytes:
    """What was compressed, if it is complete and has at most so many bytes."""
    inflater = zlib.decompressobj()
    try:
        raw = inflater.decompress(data, most + 1)
    except zlib.error as error:
        raise ValueError(f"{len(data)} bytes that cannot be unpacked: {error}") from error
    if len(raw) > most or not inflater.eof or inflater.unused_data:
        raise ValueError(f"{len(data)} bytes that are not one packed map of at most {most} bytes")
    return raw
