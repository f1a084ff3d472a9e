"""Map files: images, ROS map_server's YAML, MovingAI's ``.map`` and text maps."""

from __future__ import annotations

import math
import re
import reprlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from marl_explore.arenas.images import (
    MAX_PIXELS,
    MapFile,
    Values,
    read_image,
    require_size,
)

IMAGES = (".png", ".pgm", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".gif")
ENDINGS = (*IMAGES, ".yaml", ".yml", ".map", ".txt")
"""File name extensions that can be read."""
MAX_YAML_BYTES, MAX_YAML_VALUES = 100_000, 20
"""Most bytes of a YAML file, and most lists and mappings in it."""

_OBSTACLE, _FREE = "#", ".0123456789$"
_STARTS = "@!"
"""Free symbols of POGEMA's maps at which robots may start."""
_MOVINGAI_FREE, _MOVINGAI_OBSTACLES = ".GS", "@OTW"
_ROS_KEYS = ("image", "resolution", "negate", "occupied_thresh", "free_thresh")


def read_map(path: Path, values: Values) -> MapFile:
    """Read a file in any of the formats.

    Args:
        path: a file with one of ENDINGS.
        values: what the grey values of an image mean.

    Raises:
        ValueError: naming file, line, what was expected and what was found.
        FileNotFoundError: when the file, or the image of a YAML file, does not exist.
    """
    ending = path.suffix.lower()
    if ending in IMAGES:
        return read_image(path, values)
    for name in ("threshold", "free", "occupied"):
        value = getattr(values, name)
        if value is not None:
            raise ValueError(f"{name}={value} is not allowed: {path} is not a plain image")
    if ending in (".yaml", ".yml"):
        return read_ros(path, values.start)
    if values.start is not None:
        raise ValueError(f"start_value={values.start} is not allowed: {path} is not an image")
    if ending == ".map":
        return read_movingai(path)
    if ending == ".txt":
        return read_ascii(path)
    raise ValueError(f"{path}: expected a file that ends in one of {ENDINGS}")


def read_ros(path: Path, start: int | None = None) -> MapFile:
    """A map of ROS map_server: YAML that names an image. Unknown pixels count as obstacles."""
    said = _ros_keys(path)
    resolution = _number(path, said, "resolution", least=None, most=math.inf)
    free, _ = (_number(path, said, key, 0, 1) for key in ("free_thresh", "occupied_thresh"))
    for key, allowed in (("negate", (0, 1)), ("mode", ("trinary", "scale"))):
        if key in said and said[key] not in allowed:
            got = reprlib.repr(said[key])
            raise ValueError(f"{path}: expected {key} to be one of {allowed}, got {got}")
    _require_upright(path, said.get("origin"))
    if not isinstance(said["image"], str):
        got = reprlib.repr(said["image"])
        raise ValueError(f"{path}: expected image to be a file name, got {got}")
    picture = path.parent / said["image"]
    if not picture.is_file():
        raise FileNotFoundError(f"{path}: the image that it names, {picture}, does not exist")
    # what is not free is occupied or unknown, wherever the border between those two lies
    image = read_image(picture, Values(threshold=free, start=start), negate=bool(said["negate"]))
    return image._replace(resolution=resolution)


def read_yaml_image(path: Path) -> Path:
    """The image that a YAML file of map_server names."""
    return path.parent / str(_ros_keys(path)["image"])


def _require_upright(path: Path, origin: object) -> None:
    """Refuse a map whose origin is rotated."""
    if origin is None:
        return
    numbers = isinstance(origin, list) and all(
        isinstance(x, (int, float)) and math.isfinite(x) for x in origin
    )
    if not numbers or len(origin) not in (2, 3):  # type: ignore[arg-type]
        got = reprlib.repr(origin)
        raise ValueError(f"{path}: expected origin to be [x, y, yaw], got {got}")
    yaw = float([*origin, 0.0][2])  # type: ignore[misc]
    if abs(math.remainder(yaw, 2 * math.pi)) > 1e-6:
        raise ValueError(
            f"{path}: expected an origin that is not rotated, got a yaw of {yaw} rad: rotate the "
            "image instead"
        )


def _ros_keys(path: Path) -> dict[str, Any]:
    size = path.stat().st_size
    if size > MAX_YAML_BYTES:
        raise ValueError(f"{path}: expected at most {MAX_YAML_BYTES} bytes of YAML, got {size}")
    text = _text(path)
    try:
        _require_plain(path, text)
        said = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or error
        raise ValueError(f"{path}{line}: expected YAML ({problem})") from error
    missing = [key for key in _ROS_KEYS if not isinstance(said, dict) or key not in said]
    if missing:
        raise ValueError(f"{path}: expected the keys {_ROS_KEYS}, missing: {missing}")
    return said


def _require_plain(path: Path, text: str) -> None:
    """Refuse YAML whose values could be far larger than its text."""
    opened = 0
    starts = (yaml.FlowSequenceStartToken, yaml.FlowMappingStartToken, yaml.BlockMappingStartToken)
    for token in yaml.scan(text):
        opened += isinstance(token, starts)
        if isinstance(token, yaml.AliasToken) or opened > MAX_YAML_VALUES:
            line = token.start_mark.line + 1
            raise ValueError(
                f"{path}, line {line}: expected plain YAML, without aliases or nesting"
            )


def _number(path: Path, said: dict[str, Any], key: str, least: float | None, most: float) -> float:
    """A number of at least ``least``, or above 0, and at most ``most``."""
    value = said[key]
    if isinstance(value, str):  # YAML 1.1 takes 5e-2 for a word, 1.2 for a number
        with suppress(ValueError):
            value = float(value)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    above = number and (value > 0 if least is None else value >= least)
    if not (above and math.isfinite(value) and value <= most):
        bound = "positive" if most == math.inf else f"in [{least}, {most}]"
        got = reprlib.repr(said[key])
        raise ValueError(f"{path}: expected a number {key}, {bound}, got {got}")
    return float(value)


def read_movingai(path: Path) -> MapFile:
    """A map of the MovingAI benchmarks: ``.``, ``G`` and ``S`` are free."""
    lines = _text(path).rstrip().splitlines()
    said = [line.split() for line in lines[:4]] + [[]] * 4

    def expect(number: int, expected: str, ok: bool) -> None:
        if not ok:
            got = lines[number].strip()[:60] if number < len(lines) else ""
            raise ValueError(f"{path}, line {number + 1}: expected {expected!r}, got {got!r}")

    expect(0, "type <name>", said[0][:1] == ["type"] and len(said[0]) == 2)
    sizes: dict[str, int] = {}
    left = {"height": "height <rows>", "width": "width <columns>"}
    for number in (1, 2):
        name = said[number][0] if said[number][:1] and said[number][0] in left else next(iter(left))
        words = said[number]
        digits = len(words) == 2 and words[0] == name and re.fullmatch(r"\d{1,6}", words[1])
        expect(number, left.pop(name), bool(digits))
        sizes[name] = int(words[1])
    expect(3, "map", said[3] == ["map"])
    height, width = sizes["height"], sizes["width"]
    require_size(path, height, width)
    rows = [line.rstrip() for line in lines[4:]]
    if len(rows) != height:
        raise ValueError(f"{path}: expected {height} rows after line 4, got {len(rows)}")
    cells = _cells(path, rows, 5, width, _MOVINGAI_FREE + _MOVINGAI_OBSTACLES)
    return MapFile(~np.isin(cells, [*_MOVINGAI_FREE]))


def read_ascii(path: Path) -> MapFile:
    """A drawing: ``#`` is an obstacle, ``.`` is free, and robot i may start at the digit i.

    POGEMA's ``@`` and ``!`` are free cells where robots may start, and its ``$`` is free.
    """
    rows = [line.rstrip() for line in _text(path).rstrip().splitlines()]
    cells = _cells(path, rows, 1, len(rows[0]) if rows else 0, _OBSTACLE + _FREE + _STARTS)
    places = np.argwhere(np.char.isdigit(cells)).tolist()
    marks = sorted((cells[row, column].item(), (row, column)) for row, column in places)
    robots = [robot for robot, _ in marks]
    if robots != [str(robot) for robot in range(len(robots))]:
        raise ValueError(
            f"{path}: expected robots 0, 1, 2 ... once each, got {reprlib.repr(robots)}"
        )
    starts = np.isin(cells, [*_STARTS])
    return MapFile(
        cells == _OBSTACLE,
        marks=tuple(place for _, place in marks),
        starts=starts if starts.any() else None,
    )


def _text(path: Path) -> str:
    size, most = path.stat().st_size, 4 * MAX_PIXELS
    if size > most:
        raise ValueError(f"{path}: {size} bytes are too many for a text: at most {most}")
    # what is no text shows up as a symbol that was not expected, with its line
    return path.read_text(encoding="utf-8-sig", errors="replace")


def _cells(path: Path, rows: list[str], first: int, width: int, allowed: str) -> NDArray[np.str_]:
    """Symbols [rows, width] of drawn rows, the first of which is line ``first`` of the file."""
    if not rows or not width:
        raise ValueError(f"{path}, line {first}: expected rows of cells, got none")
    require_size(path, len(rows), width)
    for line, row in enumerate(rows, first):
        if len(row) != width:
            raise ValueError(f"{path}, line {line}: expected {width} cells, got {len(row)}")
        other = row.strip(allowed)  # nothing, unless a symbol that is not allowed stands in it
        if other:
            column = row.index(other[0]) + 1
            raise ValueError(
                f"{path}, line {line}, column {column}: expected one of {allowed!r}, "
                f"got {other[0]!r}"
            )
    return np.array(rows).view("U1").reshape(len(rows), width)
