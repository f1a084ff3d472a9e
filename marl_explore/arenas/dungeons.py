"""Dungeons drawn as the field draws them: coarse grids of rooms and corridors, as large images.

For tests and tutorials: maps in the format of the sets that exploration is evaluated on, whose own
images do not come with the package.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle, pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from marl_explore.arenas.generator import Board, Draw, numbers
from marl_explore.config.checks import require_integer
from marl_explore.core.hashing import combine, text_key
from marl_explore.utils.files import atomic_write

ROWS, COLUMNS, PIXELS = 30, 40, 16
"""Coarse cells of a dungeon, and pixels of each of them a side."""
WALL, FREE, START = 0, 1, 2
COLORS = ((127, 127, 127), (195, 195, 194), (255, 216, 0))
"""Of walls, free cells and the start, whose grey values are 127, 195 and 203."""
FEWEST_ROOMS, MORE_ROOMS = 6, 4
SMALLEST_ROOM, LARGER = 3, 5
"""A dungeon has 6 to 9 rooms with sides of 3 to 7 coarse cells."""
FEWEST_CELLS = SMALLEST_ROOM + 2


def draw_dungeon(seed: int, rows: int = ROWS, columns: int = COLUMNS) -> NDArray[np.uint8]:
    """A dungeon: rooms joined by corridors one coarse cell wide, all free cells connected.

    Args:
        seed: the same dungeon for the same seed and size.
        rows: coarse cells from north to south, at least 5, as all around it is wall.
        columns: from west to east.

    Returns:
        WALL, FREE, or START in one cell, uint8 [rows, columns].
    """
    keys = combine(text_key("dungeon"), torch.tensor([seed]))
    draw = cycle(numbers(keys, count=8 * (FEWEST_ROOMS + MORE_ROOMS))[0].tolist()).__next__
    wall = np.ones((rows, columns), bool)
    centres = [_open_room(wall, draw) for _ in range(FEWEST_ROOMS + draw() % MORE_ROOMS)]
    loop = centres[draw() % len(centres)]
    for start, end in pairwise([*centres, loop]):
        _open_corridor(wall, start, end, row_first=bool(draw() % 2))
    cells = np.where(wall, WALL, FREE).astype(np.uint8)
    cells[centres[0]] = START
    return cells


def _open_room(wall: Board, draw: Draw) -> tuple[int, int]:
    """Open a room inside the outer wall; returns its middle."""
    sides = []
    for size in wall.shape:
        side = min(SMALLEST_ROOM + draw() % LARGER, size - 2)
        first = 1 + draw() % (size - 1 - side)
        sides.append((first, first + side))
    (top, bottom), (left, right) = sides
    wall[top:bottom, left:right] = False
    return (top + bottom) // 2, (left + right) // 2


def _open_corridor(
    wall: Board, start: tuple[int, int], end: tuple[int, int], row_first: bool
) -> None:
    """Open a way with one bend, one coarse cell wide, between two cells."""
    bend = (start[0], end[1]) if row_first else (end[0], start[1])
    for one, other in ((start, bend), (bend, end)):
        (top, bottom), (left, right) = (sorted(pair) for pair in zip(one, other, strict=True))
        wall[top : bottom + 1, left : right + 1] = False


def write_dungeons(
    folder: str | Path,
    number: int,
    seed: int = 0,
    rows: int = ROWS,
    columns: int = COLUMNS,
    pixels: int = PIXELS,
) -> list[Path]:
    """Draw dungeons into a folder, as ``dungeon_0.png``, ``dungeon_1.png``, ...

    Args:
        folder: created if it does not exist; earlier files of these names are replaced.
        number: of dungeons; they have the seeds from ``seed`` on.
        seed: of the first one.
        rows, columns: coarse cells.
        pixels: of a coarse cell a side.

    Raises:
        ValueError: for fewer than 5 x 5 coarse cells, or less than one dungeon or pixel.
    """
    for name, value, least in (
        ("number", number, 1),
        ("seed", seed, 0),
        ("rows", rows, FEWEST_CELLS),
        ("columns", columns, FEWEST_CELLS),
        ("pixels", pixels, 1),
    ):
        require_integer(name, value, least)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    return list(_written(folder, range(seed, seed + number), (rows, columns), pixels))


def _written(folder: Path, seeds: range, size: tuple[int, int], pixels: int) -> Iterator[Path]:
    colors = np.array(COLORS, np.uint8)
    for seed in seeds:
        cells = draw_dungeon(seed, *size).repeat(pixels, 0).repeat(pixels, 1)
        path = folder / f"dungeon_{seed}.png"
        with atomic_write(path) as unfinished:
            Image.fromarray(colors[cells]).save(unfinished, format="PNG")
        yield path
