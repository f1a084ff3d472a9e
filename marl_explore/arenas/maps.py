"""Arenas from map files: resampling to cells, and a generator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_explore.arenas.components import largest_component
from marl_explore.arenas.generator import OBSTACLES, ArenaGenerator, Board
from marl_explore.arenas.images import Intervals, MapFile, Values, make_values
from marl_explore.arenas.map_files import read_map
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_coverage, require_positive
from marl_explore.config.constants import TOLERANCE
from marl_explore.core.hashing import combine
from marl_explore.core.world import check_starts

MAX_CELLS, MAX_CELLS_SIDE = 4_000_000, 5_000
"""Most cells of an arena from a map, in all and a side."""


def load_map(path: str | Path, cell_size: float = 0.5, **reading: Any) -> Tensor:
    """Obstacles bool [H, W] of a map file, resampled to cells; row 0 is its first row.

    Args:
        path: an image (``.png``, ``.pgm``, ``.jpg``, ``.bmp``, ``.tif``, ``.gif``); ``.yaml`` of
            ROS map_server; ``.map`` of MovingAI; or ``.txt``, a drawing in which ``#`` is an
            obstacle, ``.`` free and a digit the start of a robot.
        cell_size: side of a cell (metres).
        reading: fields of ``Reading``.

    Raises:
        ValueError: naming file, line, what was expected and what was found; or argument, value
            and what is allowed.
        FileNotFoundError: when the file does not exist.
    """
    return Reading(**reading).load(path, cell_size).obstacles


class LoadedMap(NamedTuple):
    """A map in cells."""

    obstacles: Tensor
    """bool [H, W]."""
    marks: Tensor
    """Start cells in the robots' order, int64 [marks, 2]."""
    starts: Tensor | None
    """Cells where robots may start, bool [H, W]; None: the file marks none."""


@dataclass(frozen=True)
class Reading:
    """How map files become cells.

    Raises:
        ValueError: naming argument, value and what is allowed.
    """

    resolution: float | None = None
    """Side of a pixel or drawn symbol (metres); None: what the file says, or a cell."""
    max_occupied: float = 0.0
    """Share in [0, 1) of a free cell's area that may be occupied or unknown."""
    threshold: float | None = None
    """Darkness in (0, 1] at which an image's obstacles begin; None: 0.5, or what a YAML says."""
    free: Intervals | None = None
    """Grey values (0 black, 255 white) that are free, such as 195-255 or 50-80,195-255."""
    occupied: Intervals | None = None
    """Grey values that are obstacles."""
    start_value: int | None = None
    """Grey value of the pixels where robots may start."""

    def __post_init__(self) -> None:
        """Refuse what cannot be read by."""
        if self.resolution is not None:
            require_positive("resolution", self.resolution, "metres")
        require_coverage("threshold", self.threshold)
        if not 0 <= self.max_occupied < 1:
            raise ValueError(
                f"max_occupied={self.max_occupied} is not allowed: it must lie in [0, 1)"
            )
        self._values()

    def _values(self) -> Values:
        return make_values(self.free, self.occupied, self.threshold, self.start_value)

    def read(self, path: str | Path) -> MapFile:
        """The pixels of a file, with the resolution that counts; None: nobody says."""
        file = read_map(Path(path), self._values())
        if self.resolution is None:
            return file
        if file.resolution is not None:
            raise ValueError(
                f"resolution={self.resolution} is not allowed: {path} says {file.resolution}"
            )
        return file._replace(resolution=self.resolution)

    def load(self, path: str | Path, cell_size: float) -> LoadedMap:
        """The cells of a file."""
        require_positive("cell_size", cell_size, "metres")
        return to_cells(path, self.read(path), cell_size, self.max_occupied)


def to_cells(path: str | Path, file: MapFile, cell_size: float, max_occupied: float) -> LoadedMap:
    """A map resampled to cells of ``cell_size`` (metres).

    Raises:
        ValueError: naming file, sizes and limits, when these are too many cells.
    """
    pixels_per_cell = cell_size / (file.resolution or cell_size)
    height, width = (size / pixels_per_cell for size in file.occupied.shape)
    if not (max(height, width) <= MAX_CELLS_SIDE and height * width <= MAX_CELLS):
        raise ValueError(
            f"{path}: {height:.4g} x {width:.4g} cells of {cell_size} m are too many: at most "
            f"{MAX_CELLS_SIDE} a side and {MAX_CELLS / 1e6:g} million in all; choose a larger "
            "cell_size or a smaller resolution"
        )
    obstacles = resample(file.occupied, pixels_per_cell) > max_occupied + TOLERANCE
    starts = None
    if file.starts is not None:
        starts = torch.from_numpy((resample(file.starts, pixels_per_cell) > 0) & ~obstacles)
    centers = torch.tensor(file.marks, dtype=torch.float64).view(-1, 2) + 0.5
    return LoadedMap(torch.from_numpy(obstacles), (centers / pixels_per_cell).long(), starts)


def resample(pixels: Board, pixels_per_cell: float) -> NDArray[np.float64]:
    """Share of every cell's area that is set; at the far edges, of the part inside the map."""
    rows, columns = (_edges(size, pixels_per_cell) for size in pixels.shape)
    bands = np.diff(_at(pixels.cumsum(0, dtype=np.int32), rows), axis=0)
    areas = np.diff(_at(bands.cumsum(1).T, columns), axis=0).T
    shares: NDArray[np.float64] = areas / np.outer(np.diff(rows), np.diff(columns))
    return shares


def _edges(pixels: int, pixels_per_cell: float) -> NDArray[np.float64]:
    """Where cells begin and end (pixels), [cells + 1]."""
    cells = int(np.ceil(pixels / pixels_per_cell - TOLERANCE))
    edges = np.minimum(np.arange(cells + 1) * pixels_per_cell, pixels)
    whole = np.rint(edges)  # no sliver of a pixel by rounding
    return np.where(np.abs(edges - whole) < TOLERANCE * max(1, pixels), whole, edges)


def _at(sums: NDArray[Any], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of all rows above each edge, of running sums [rows, ...] over rows: [edges, ...]."""
    last = len(sums) - 1
    whole = np.minimum(edges.astype(np.int64), last + 1)
    below = np.where((whole > 0)[:, None], sums[np.maximum(whole - 1, 0)], 0).astype(np.float64)
    row = sums[np.minimum(whole, last)] - below
    part = (edges - whole)[:, None]
    return below + np.where(part > 0, row, 0) * part


@dataclass(frozen=True, eq=False)
class MapArenas(ArenaGenerator):
    """Chooses each arena from given maps; robots start in the largest connected part of a map.

    Args:
        config: size of all maps and number of robots.
        starts: "scattered", "clustered", or "marked": in the cells that are marked in the maps.
        maps: obstacles, bool [K, H, W].
        marks: start cells for "marked", int64 [K, N, 2].
        places: cells where robots may start, bool [K, H, W]; None: the largest connected part.
        in_order: whether arena i is map i modulo K, as evaluations want it; else a hash chooses.

    Raises:
        ValueError: when the maps have another size than ``config``, or too few free cells.
    """

    maps: Tensor = field(kw_only=True)
    marks: Tensor | None = field(kw_only=True, default=None)
    places: Tensor | None = field(kw_only=True, default=None)
    in_order: bool = field(kw_only=True, default=False)

    def __post_init__(self) -> None:
        """Check that the maps can be arenas of the configuration."""
        config, maps = self.config, self.maps
        if maps.dtype != torch.bool or maps.shape[1:] != (config.height, config.width):
            raise ValueError(
                f"maps must be torch.bool of shape [K, {config.height}, {config.width}], got "
                f"{maps.dtype} of shape {tuple(maps.shape)}"
            )
        if self.starts == "marked":
            self._check_marks()
            return
        super().__post_init__()
        room = self._places().flatten(-2).sum(-1)
        if config.num_agents > int(room.min()):
            where = "the largest connected part" if self.places is None else "the place to start"
            raise ValueError(
                f"num_agents={config.num_agents} is not allowed: {where} of "
                f"map {int(room.argmin())} has {int(room.min())} free cells"
            )

    def _places(self) -> Tensor:
        """Cells where robots may start, bool [K, H, W]."""
        return largest_component(~self.maps) if self.places is None else self.places & ~self.maps

    def _check_marks(self) -> None:
        shape = (len(self.maps), self.config.num_agents, 2)
        if self.marks is None or self.marks.dtype != torch.int64 or self.marks.shape != shape:
            raise ValueError(f"starts='marked' needs marks, torch.int64 of shape {shape}")
        check_starts(self.maps, self.marks)

    @classmethod
    def load(
        cls,
        config: ArenaConfig,
        paths: Sequence[str | Path] | str | Path,
        starts: str = "scattered",
        **reading: Any,
    ) -> MapArenas:
        """Arenas from files, resampled to ``config.cell_size``.

        Args:
            config: size of all maps, side of the cells, and number of robots.
            paths: files of the formats of ``load_map``.
            starts: as above; with "marked", robot i starts at digit i of a text map.
            reading: further arguments of ``load_map``, for all files.

        Raises:
            ValueError: for a broken file, or one of another size than ``config``.
        """
        if not paths:
            raise ValueError("paths=[] is not allowed: it needs at least one file")
        paths = [paths] if isinstance(paths, (str, Path)) else list(paths)
        how = Reading(**reading)
        loaded = [how.load(path, config.cell_size) for path in paths]
        size = config.height, config.width
        for path, (obstacles, marks, _) in zip(paths, loaded, strict=True):
            if obstacles.shape != size:
                raise ValueError(
                    f"{path} has {tuple(obstacles.shape)} cells of {config.cell_size} m, expected "
                    f"config's {size}"
                )
            if starts == "marked" and len(marks) < config.num_agents:
                raise ValueError(
                    f"{path} marks {len(marks)} starts, expected num_agents={config.num_agents}"
                )
        maps, marked, _ = zip(*loaded, strict=True)
        given = [marks[: config.num_agents] for marks in marked]
        return cls(
            config,
            starts,
            maps=torch.stack(maps),
            marks=torch.stack(given) if starts == "marked" else None,
        )

    def __call__(self, seed: int, arenas: Tensor, episodes: Tensor) -> tuple[Tensor, Tensor]:
        """Obstacles bool [A, H, W] and starts int64 [A, N, 2] of arenas and episodes [A]."""
        keys = combine(seed, arenas, episodes)
        which = arenas % len(self.maps) if self.in_order else self._choice(keys)
        maps = self.maps.to(keys.device)[which]
        if self.starts == "marked" and self.marks is not None:
            return maps, self.marks.to(keys.device)[which]
        return maps, self.place(keys, self._places().to(keys.device)[which])

    def obstacles(self, keys: Tensor) -> Tensor:
        """Obstacles bool [A, H, W] of the maps that the hashes choose."""
        return self.maps.to(keys.device)[self._choice(keys)]

    def _choice(self, keys: Tensor) -> Tensor:
        """Indices of the maps, int64 [A]."""
        return combine(keys, OBSTACLES) % len(self.maps)
