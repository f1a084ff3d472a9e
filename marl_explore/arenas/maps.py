"""Arenas from maps that a user has: files resampled to cells, and a generator that draws them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_explore.arenas.components import largest_component
from marl_explore.arenas.generator import OBSTACLES, ArenaGenerator, Board
from marl_explore.arenas.map_files import read_map
from marl_explore.config.arena import TOLERANCE, ArenaConfig
from marl_explore.config.checks import require_coverage, require_positive
from marl_explore.core.hashing import combine
from marl_explore.core.world import check_starts


def load_map(
    path: str | Path,
    cell_size: float = 0.5,
    resolution: float | None = None,
    threshold: float | None = None,
    max_occupied: float = 0.0,
) -> Tensor:
    """Obstacles bool [H, W] of a map file, resampled to cells; row 0 is its first row.

    Args:
        path: ``.png``, ``.pgm``, ``.jpg``; ``.yaml`` of ROS map_server; ``.map`` of MovingAI; or
            ``.txt``, a drawing in which ``#`` is an obstacle, ``.`` free and a digit the start of
            a robot.
        cell_size: side of a cell (metres).
        resolution: side of a pixel or drawn symbol (metres); None: it is a cell, or what the
            YAML says.
        threshold: darkness in (0, 1] at which an image's obstacles begin; None: 0.5, or what the
            YAML says.
        max_occupied: share in [0, 1) of a cell's area that may be occupied or unknown in a free
            cell.

    Raises:
        ValueError: naming file, line, what was expected and what came; or argument, value and
            what is allowed.
        FileNotFoundError: when the file does not exist.
    """
    return _load(path, cell_size, resolution, threshold, max_occupied)[0]


def _load(
    path: str | Path,
    cell_size: float,
    resolution: float | None = None,
    threshold: float | None = None,
    max_occupied: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Obstacles bool [H, W] and marked start cells int64 [marks, 2]."""
    path = Path(path)
    require_positive("cell_size", cell_size, "metres")
    require_coverage("threshold", threshold)
    if not 0 <= max_occupied < 1:
        raise ValueError(f"max_occupied={max_occupied} is not allowed: it must lie in [0, 1)")
    file = read_map(path, threshold)
    if resolution is None:
        resolution = file.resolution or cell_size
    elif file.resolution is not None:
        raise ValueError(f"resolution={resolution} is not allowed: {path} says {file.resolution}")
    require_positive("resolution", resolution, "metres")
    obstacles = _resample(file.occupied, cell_size / resolution, max_occupied)
    centers = torch.tensor(file.marks, dtype=torch.float64).view(-1, 2) + 0.5
    return torch.from_numpy(obstacles), (centers * (resolution / cell_size)).long()


def _resample(occupied: Board, pixels_per_cell: float, max_occupied: float) -> Board:
    """Cells of which more than a share is occupied; at the far edges, of the part on the map."""
    down, right = (_overlaps(size, pixels_per_cell) for size in occupied.shape)
    share = down @ occupied @ right.T
    return share > max_occupied + TOLERANCE


def _overlaps(pixels: int, pixels_per_cell: float) -> NDArray[np.float64]:
    """Share of every cell's length that lies in every pixel, [cells, pixels]."""
    cells = int(np.ceil(pixels / pixels_per_cell - TOLERANCE))
    edges = np.minimum(np.arange(cells + 1) * pixels_per_cell, pixels)[:, None]
    pixel = np.arange(pixels)
    overlap = np.minimum(edges[1:], pixel + 1) - np.maximum(edges[:-1], pixel)
    overlap[overlap < TOLERANCE] = 0
    return overlap / overlap.sum(1, keepdims=True)


@dataclass(frozen=True, eq=False)
class MapArenas(ArenaGenerator):
    """Draws every arena from given maps; robots start in the largest connected part of a map.

    Args:
        config: size of all maps and number of robots.
        starts: "scattered", "clustered", or "marked": always in the cells that the maps mark.
        maps: obstacles, bool [K, H, W].
        marks: start cells for "marked", int64 [K, N, 2].

    Raises:
        ValueError: when the maps have another size than ``config``, or no room for its robots.
    """

    maps: Tensor = field(kw_only=True)
    marks: Tensor | None = field(kw_only=True, default=None)

    def __post_init__(self) -> None:
        """Refuse maps that cannot be arenas of the configuration."""
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
        room = largest_component(~maps).flatten(-2).sum(-1)
        if config.num_agents > int(room.min()):
            raise ValueError(
                f"num_agents={config.num_agents} is not allowed: the largest connected part of "
                f"map {int(room.argmin())} has {int(room.min())} free cells"
            )

    def _check_marks(self) -> None:
        shape = (len(self.maps), self.config.num_agents, 2)
        if self.marks is None or self.marks.dtype != torch.int64 or self.marks.shape != shape:
            raise ValueError(f"starts='marked' needs marks, torch.int64 of shape {shape}")
        check_starts(self.maps, self.marks)

    @classmethod
    def load(
        cls,
        config: ArenaConfig,
        paths: Sequence[str | Path],
        starts: str = "scattered",
        **reading: Any,
    ) -> MapArenas:
        """Arenas from files, resampled to ``config.cell_size``.

        Args:
            config: size of all maps, side of the cells, and number of robots.
            paths: files of the formats of ``load_map``.
            starts: as above; robot i starts at the digit i of an ASCII map if "marked".
            reading: further arguments of ``load_map``, for all files.

        Raises:
            ValueError: for a broken file, or one of another size than ``config``.
        """
        if not paths:
            raise ValueError("paths=[] is not allowed: it needs at least one file")
        loaded = [_load(path, config.cell_size, **reading) for path in paths]
        size = config.height, config.width
        for path, (obstacles, marks) in zip(paths, loaded, strict=True):
            if obstacles.shape != size:
                raise ValueError(
                    f"{path} has {tuple(obstacles.shape)} cells of {config.cell_size} m, expected "
                    f"config's {size}"
                )
            if starts == "marked" and len(marks) < config.num_agents:
                raise ValueError(
                    f"{path} marks {len(marks)} starts, expected num_agents={config.num_agents}"
                )
        maps, marked = zip(*loaded, strict=True)
        given = [marks[: config.num_agents] for marks in marked]
        return cls(
            config,
            starts,
            maps=torch.stack(maps),
            marks=torch.stack(given) if starts == "marked" else None,
        )

    def obstacles(self, keys: Tensor) -> Tensor:
        """Obstacles bool [A, H, W] of the maps that the hashes choose."""
        return self.maps.to(keys.device)[self._choice(keys)]

    def positions(self, keys: Tensor, obstacles: Tensor) -> Tensor:
        """Start cells int64 [A, N, 2]: the marked ones, or some of the largest connected part."""
        if self.starts == "marked" and self.marks is not None:
            return self.marks.to(keys.device)[self._choice(keys)]
        return self.place(keys, largest_component(~obstacles))

    def _choice(self, keys: Tensor) -> Tensor:
        """Numbers of the maps, int64 [A]."""
        return combine(keys, OBSTACLES) % len(self.maps)
