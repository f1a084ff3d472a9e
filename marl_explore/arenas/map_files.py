"""Files of maps: images, ROS map_server's YAML, MovingAI's ``.map`` and ASCII drawings."""

from __future__ import annotations

import math
import re
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from marl_explore.arenas.generator import Board

IMAGES = (".png", ".pgm", ".jpg", ".jpeg")
ENDINGS = (*IMAGES, ".yaml", ".yml", ".map", ".txt")
"""Endings of the files that can be read."""

_ASCII = "#.0123456789"
_MOVINGAI_FREE, _MOVINGAI_OBSTACLES = ".GS", "@OTW"
_MOVINGAI_HEADER = (
    ("type <name>", r"type \S+"),
    ("height <rows>", r"height (\d+)"),
    ("width <columns>", r"width (\d+)"),
    ("map", "map"),
)
_ROS_KEYS = ("image", "resolution", "negate", "occupied_thresh", "free_thresh")


class MapFile(NamedTuple):
    """What a file says, pixel by pixel; the first row is north."""

    occupied: Board
    """Obstacles and unknown pixels, bool [rows, columns]."""
    resolution: float | None = None
    """Side of a pixel (metres); None where the file does not say."""
    marks: tuple[tuple[int, int], ...] = ()
    """Pixels (row, column) that are marked as starts, in the robots' order."""


def read_map(path: Path, threshold: float | None) -> MapFile:
    """What a file of any of the formats says.

    Args:
        path: a file with one of ENDINGS.
        threshold: darkness of an image's obstacles (see ``read_image``); None: 0.5.

    Raises:
        ValueError: naming file, line, what was expected and what came.
        FileNotFoundError: when the file does not exist.
    """
    ending = path.suffix.lower()
    if ending in IMAGES:
        return read_image(path, 0.5 if threshold is None else threshold)
    if threshold is not None:
        raise ValueError(f"threshold={threshold} is not allowed: {path} is not a plain image")
    if ending in (".yaml", ".yml"):
        return read_ros(path)
    if ending == ".map":
        return read_movingai(path)
    if ending == ".txt":
        return read_ascii(path)
    raise ValueError(f"{path}: expected a file that ends in one of {ENDINGS}")


def read_image(path: Path, threshold: float, negate: bool = False) -> MapFile:
    """A grey image: dark pixels are obstacles, and so are transparent ones.

    Args:
        path: PNG, PGM or JPEG.
        threshold: darkness from 0 (white) to 1 (black) at which obstacles begin.
        negate: whether bright pixels are the obstacles.
    """
    content = path.read_bytes()
    try:
        with Image.open(BytesIO(content), formats=("PNG", "PPM", "JPEG")) as image:
            lightness, opaque = _lightness(image)
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"{path}: expected a PNG, PGM or JPEG image ({error})") from error
    darkness = lightness if negate else 1 - lightness
    return MapFile((darkness >= threshold) | ~opaque)


def _lightness(image: Image.Image) -> tuple[NDArray[np.float64], Board]:
    """Lightness in [0, 1] and whether a pixel is opaque."""
    if image.mode.startswith("I"):  # 16 bits, which Pillow does not scale down
        lightness = np.asarray(image) / 65535
        return lightness, np.ones_like(lightness, bool)
    pixels = np.asarray(image.convert("LA"))
    return pixels[..., 0] / 255, pixels[..., 1] == 255


def read_ros(path: Path) -> MapFile:
    """A map of ROS map_server: YAML that names an image. Unknown pixels count as obstacles."""
    said = _ros_keys(path)
    resolution = _number(path, said, "resolution", most=math.inf)
    free, _ = (_number(path, said, key, most=1) for key in ("free_thresh", "occupied_thresh"))
    for key, allowed in (("negate", (0, 1)), ("mode", ("trinary", "scale"))):
        if key in said and said[key] not in allowed:
            raise ValueError(f"{path}: expected {key} to be one of {allowed}, got {said[key]!r}")
    # what is not free is occupied or unknown, wherever the border between those two lies
    image = read_image(path.parent / str(said["image"]), free, negate=bool(said["negate"]))
    return image._replace(resolution=resolution)


def _ros_keys(path: Path) -> dict[str, Any]:
    try:
        said = yaml.safe_load(_text(path))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        raise ValueError(
            f"{path}{line}: expected YAML ({getattr(error, 'problem', error)})"
        ) from error
    missing = [key for key in _ROS_KEYS if not isinstance(said, dict) or key not in said]
    if missing:
        raise ValueError(f"{path}: expected the keys {_ROS_KEYS}, missing: {missing}")
    return said


def _number(path: Path, said: dict[str, Any], key: str, most: float) -> float:
    value = said[key]
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not (number and math.isfinite(value) and 0 < value <= most):
        bound = "positive" if most == math.inf else f"in (0, {most}]"
        raise ValueError(f"{path}: expected a number {key}, {bound}, got {value!r}")
    return float(value)


def read_movingai(path: Path) -> MapFile:
    """A map of the MovingAI benchmarks: ``.``, ``G`` and ``S`` are free."""
    lines = _text(path).rstrip().splitlines()
    sizes: list[int] = []
    for number, (expected, pattern) in enumerate(_MOVINGAI_HEADER):
        line = lines[number].strip() if number < len(lines) else ""
        match = re.fullmatch(pattern, line)
        if not match:
            raise ValueError(f"{path}, line {number + 1}: expected {expected!r}, got {line!r}")
        sizes += map(int, match.groups())
    height, width = sizes
    first = len(_MOVINGAI_HEADER)
    rows = lines[first:]
    if len(rows) != height:
        raise ValueError(f"{path}: expected {height} rows after line {first}, got {len(rows)}")
    cells = _cells(path, rows, first + 1, width, _MOVINGAI_FREE + _MOVINGAI_OBSTACLES)
    return MapFile(~np.isin(cells, [*_MOVINGAI_FREE]))


def read_ascii(path: Path) -> MapFile:
    """A drawing: ``#`` is an obstacle, ``.`` is free, and robot i may start at the digit i."""
    rows = [line.rstrip() for line in _text(path).rstrip().splitlines()]
    cells = _cells(path, rows, 1, len(rows[0]) if rows else 0, _ASCII)
    places = np.argwhere(np.char.isdigit(cells)).tolist()
    marks = sorted((cells[row, column].item(), (row, column)) for row, column in places)
    robots = [robot for robot, _ in marks]
    if robots != [str(robot) for robot in range(len(robots))]:
        raise ValueError(f"{path}: expected robots 0, 1, 2 ... once each, got {robots}")
    return MapFile(cells == "#", marks=tuple(place for _, place in marks))


def _text(path: Path) -> str:
    # what is no text shows up as a symbol that was not expected, with its line
    return path.read_text(encoding="utf-8", errors="replace")


def _cells(path: Path, rows: list[str], first: int, width: int, allowed: str) -> NDArray[np.str_]:
    """Symbols [rows, width] of drawn rows, the first of which is line ``first`` of the file."""
    if not rows or not width:
        raise ValueError(f"{path}, line {first}: expected rows of cells, got none")
    for line, row in enumerate(rows, first):
        if len(row) != width:
            raise ValueError(f"{path}, line {line}: expected {width} cells, got {len(row)}")
        for column, symbol in enumerate(row, 1):
            if symbol not in allowed:
                raise ValueError(
                    f"{path}, line {line}, column {column}: expected one of {allowed!r}, "
                    f"got {symbol!r}"
                )
    return np.array([[*row] for row in rows])
