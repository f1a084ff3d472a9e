"""Images as maps: which grey values are free, obstacles, or places to start."""

from __future__ import annotations

import re
import reprlib
import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from marl_explore.arenas.generator import Board

MAX_PIXELS = 25_000_000
"""Most pixels, or symbols, of a map: 5000 x 5000."""
MAX_SIDE = 20_000
"""Most pixels, or symbols, of a row or a column."""
_LIMITS = (
    f"at most {MAX_SIDE} a side and {MAX_PIXELS / 1e6:g} million in all; make it smaller first"
)
Interval = tuple[int, int]
Intervals = str | Sequence[Interval]
"""Grey values from 0 (black) to 255 (white), such as "195-255" or "50-80,195-255", or pairs."""

_FORMATS = ("PNG", "PPM", "JPEG", "BMP", "TIFF", "GIF")


class Values(NamedTuple):
    """Which grey values of an image mean what.

    Pixels in none of the given intervals are unknown, which counts as occupied; where only one
    kind is given, all others are of the other kind.
    """

    free: tuple[Interval, ...] | None = None
    occupied: tuple[Interval, ...] | None = None
    threshold: float | None = None
    """Darkness in (0, 1] at which obstacles begin, in place of intervals; None: 0.5."""
    start: int | None = None
    """Free pixels of this value are those where robots may start."""


class MapFile(NamedTuple):
    """The contents of a file, pixel by pixel; the first row is north."""

    occupied: Board
    """Obstacles and unknown pixels, bool [rows, columns]."""
    resolution: float | None = None
    """Side of a pixel (metres); None if the file does not give it."""
    marks: tuple[tuple[int, int], ...] = ()
    """Pixels (row, column) that are marked as starts, in the robots' order."""
    starts: Board | None = None
    """Pixels where robots may start, bool [rows, columns]; None: the file marks none."""


def parse_intervals(name: str, value: Intervals | None) -> tuple[Interval, ...] | None:
    """Intervals of grey values, in words or pairs.

    Raises:
        ValueError: naming what is no interval in 0 to 255.
    """
    if value is None:
        return None
    pairs: list[Any] = [*value]
    if isinstance(value, str):
        found = [re.fullmatch(r"\s*(\d{1,3})(?:\s*-\s*(\d{1,3}))?\s*", w) for w in value.split(",")]
        pairs = [(m[1], m[2] or m[1]) if m else None for m in found]
    try:
        intervals = tuple((int(low), int(high)) for low, high in pairs)
    except (TypeError, ValueError):
        intervals = ()
    if not intervals or any(not 0 <= low <= high <= 255 for low, high in intervals):
        raise ValueError(
            f"{name}={reprlib.repr(value)} is not allowed: use grey values from 0 to 255, such as "
            "195-255 or 50-80,195-255"
        )
    return intervals


def make_values(
    free: Intervals | None = None,
    occupied: Intervals | None = None,
    threshold: float | None = None,
    start: int | None = None,
) -> Values:
    """What grey values mean.

    Raises:
        ValueError: for a threshold beside intervals, free and occupied values that overlap, or a
            start value that is none.
    """
    values = Values(
        parse_intervals("free", free), parse_intervals("occupied", occupied), threshold, start
    )
    if threshold is not None and (free or occupied):
        raise ValueError(f"threshold={threshold} is not allowed beside intervals of grey values")
    for low, high in values.free or ():
        for other_low, other_high in values.occupied or ():
            if low <= other_high and other_low <= high:
                raise ValueError(
                    f"free={reprlib.repr(free)} and occupied={reprlib.repr(occupied)} overlap at "
                    f"{max(low, other_low)}"
                )
    if start is not None and not 0 <= start <= 255:
        raise ValueError(f"start_value={start} is not allowed: it must lie in 0 to 255")
    return values


def read_image(path: Path, values: Values, negate: bool = False) -> MapFile:
    """An image, read as grey: by intervals of its values, or dark pixels as obstacles.

    Transparent pixels are obstacles.

    Args:
        path: PNG, PGM, JPEG, BMP, TIFF or GIF (its first picture).
        values: what grey values mean.
        negate: whether bright pixels are the obstacles; for a threshold alone.
    """
    content = path.read_bytes()
    lightness, opaque = _pixels(path, content)
    grey = np.rint(lightness * 255).astype(np.uint8)
    if values.free is None and values.occupied is None:
        threshold = 0.5 if values.threshold is None else values.threshold
        darkness = lightness if negate else 1 - lightness
        occupied = darkness >= max(threshold, 1 / 510)  # what is not dark at all is free
    else:
        blocked, free = _within(grey, values.occupied), _within(grey, values.free)
        occupied = ~free if blocked is None else blocked if free is None else blocked | ~free
    if values.start is None:
        return MapFile(occupied | ~opaque)
    starts = (grey == values.start) & opaque
    if not starts.any():
        raise ValueError(
            f"{path}: expected pixels of start_value={values.start}, got none; most have the "
            f"values {_most_frequent(grey)}"
        )
    return MapFile((occupied & ~starts) | ~opaque, starts=starts)


def _most_frequent(grey: NDArray[np.uint8], number: int = 6) -> str:
    """The most frequent grey values in words, in their order."""
    found, counts = np.unique(grey, return_counts=True)
    return ", ".join(map(str, sorted(found[np.argsort(-counts)[:number]].tolist())))


def _pixels(path: Path, content: bytes) -> tuple[NDArray[np.float32], Board]:
    """Lightness in [0, 1], and whether a pixel is opaque."""
    expected = f"{path}: expected a PNG, PGM, JPEG, BMP, TIFF or GIF image"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of tags that are damaged, and of sizes refused below
        try:
            image = Image.open(BytesIO(content), formats=_FORMATS)
        except Image.DecompressionBombError as error:
            raise ValueError(f"{path}: its pixels are too many: {_LIMITS}") from error
        except (OSError, SyntaxError, ValueError, TypeError, OverflowError) as error:
            raise ValueError(f"{expected} ({error})") from error
        require_size(path, image.height, image.width)
        try:
            return _lightness(image)
        except (OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError) as error:
            raise ValueError(f"{expected} ({error})") from error


def _within(grey: NDArray[np.uint8], intervals: Sequence[Interval] | None) -> Any:
    """Whether grey values lie in some interval; None without intervals."""
    if intervals is None:
        return None
    table = np.zeros(256, bool)
    for low, high in intervals:
        table[low : high + 1] = True
    return table[grey]


def require_size(path: Path, height: int, width: int) -> None:
    """Refuse a map that would take too much memory, before any is taken.

    Raises:
        ValueError: naming the file, its size and the limits.
    """
    if max(height, width) > MAX_SIDE or height * width > MAX_PIXELS:
        raise ValueError(f"{path}: {height} x {width} pixels are too many: {_LIMITS}")


def _lightness(image: Image.Image) -> tuple[NDArray[np.float32], Board]:
    """Lightness in [0, 1] and whether a pixel is opaque."""
    if image.mode.startswith("I"):  # 16 bits, which Pillow does not scale down
        lightness = np.asarray(image, np.float32) / np.float32(65535)
        return lightness, np.ones_like(lightness, bool)
    pixels = np.asarray(image.convert("LA"))
    return pixels[..., 0].astype(np.float32) / np.float32(255), pixels[..., 1] == 255
