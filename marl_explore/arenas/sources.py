"""Map files as arenas by name: a file or folder, and how it is read, "plans?starts=marked"."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from marl_explore.arenas.fitting import WARNING, drivable, grid_fit, pixel_side
from marl_explore.arenas.images import MapFile
from marl_explore.arenas.map_files import ENDINGS, read_yaml_image
from marl_explore.arenas.maps import LoadedMap, MapArenas, Reading, to_cells
from marl_explore.arenas.suites import Suite
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_positive

STARTS = ("clustered", "scattered", "marked")
"""How robots start where nothing else is asked for: together, in the largest connected part."""
ROBOT_RADIUS = 0.2
"""Radius of the robots for which a reading is judged (metres)."""
MAP_STEPS = 1500
"""Length of an evaluation on map files."""
_NUMBERS = ("resolution", "max_occupied", "threshold")


@dataclass(frozen=True)
class MapSource:
    """Map files in the order of their names, and how they are read.

    Raises:
        ValueError: naming what is wrong: no file, an unknown option, a rule of starts.
    """

    paths: tuple[Path, ...]
    reading: Reading = field(default_factory=Reading)
    starts: str = "clustered"
    """"clustered", "scattered", "marked", or pixels "row,column;row,column;..." for all maps."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        if not self.paths:
            raise ValueError("paths=() is not allowed: it needs at least one map file")
        if self.starts not in STARTS:
            parse_pixels(self.starts)

    @classmethod
    def parse(cls, text: str) -> MapSource:
        """The source that a name gives: a file or folder, and options after a question mark."""
        place, _, words = text.partition("?")
        options: dict[str, Any] = {}
        for word in filter(None, words.split("&")):
            name, _, value = word.partition("=")
            options[name] = value
        starts = options.pop("starts", "clustered")
        known = [option.name for option in fields(Reading)]
        for name, value in options.items():
            if name not in known:
                raise ValueError(f"arenas={text!r}: unknown option {name!r}, use {known} or starts")
            try:
                if name in _NUMBERS:
                    options[name] = float(value)
                elif name == "start_value":
                    options[name] = int(value)
            except ValueError as error:
                raise ValueError(f"arenas={text!r}: {name} must be a number") from error
        return cls(map_files(Path(place)), Reading(**options), starts)

    def load(self, cell_size: float) -> tuple[LoadedMap, ...]:
        """All maps in cells of this size (metres); read once while nothing changes."""
        return _load(self, cell_size)

    def fit(self, config: ArenaConfig) -> ArenaConfig:
        """The robots of ``config`` in an arena that holds every map."""
        maps = self.load(config.cell_size)
        height, width = (max(m.obstacles.shape[axis] for m in maps) for axis in (0, 1))
        return replace(config, height=height, width=width, obstacle_density=0.0)

    def arenas(self, config: ArenaConfig, in_order: bool = False) -> MapArenas:
        """The maps as arenas; smaller ones are padded with obstacles to the right and below.

        Args:
            config: size, robots, and side of the cells.
            in_order: whether arena i is map i; else a hash chooses among them.

        Raises:
            ValueError: for another size than ``fit`` gives, or starts that cannot be.
        """
        fitted = self.fit(config)
        size = fitted.height, fitted.width
        if (config.height, config.width) != size:
            raise ValueError(
                f"height={config.height} and width={config.width} are not allowed: the maps have "
                f"{size[0]} x {size[1]} cells of {config.cell_size} m"
            )
        maps = self.load(config.cell_size)
        obstacles = torch.stack([_padded(m.obstacles, size, True) for m in maps])
        if self.starts in STARTS[:2] and not any(m.starts is not None for m in maps):
            return MapArenas(config, self.starts, maps=obstacles, in_order=in_order)
        if self.starts in STARTS[:2]:
            places = [
                ~m.obstacles if m.starts is None else _around(m, config.num_agents) for m in maps
            ]
            room = torch.stack([_padded(place, size, False) for place in places])
            return MapArenas(config, "scattered", maps=obstacles, places=room, in_order=in_order)
        marks = [self._marks(m, path, config) for m, path in zip(maps, self.paths, strict=True)]
        return MapArenas(
            config, "marked", maps=obstacles, marks=torch.stack(marks), in_order=in_order
        )

    def _marks(self, loaded: LoadedMap, path: Path, config: ArenaConfig) -> Tensor:
        """Start cells of one map, int64 [N, 2]."""
        marks = loaded.marks
        if self.starts not in STARTS:
            resolution = self.file(path).resolution or config.cell_size
            pixels = torch.tensor(parse_pixels(self.starts), dtype=torch.float64) + 0.5
            marks = (pixels * (resolution / config.cell_size)).long()
        if len(marks) < config.num_agents:
            raise ValueError(
                f"{path} marks {len(marks)} starts, expected num_agents={config.num_agents}"
            )
        return marks[: config.num_agents]

    def file(self, path: Path) -> MapFile:
        """The pixels of one map; those of an image without a resolution get the usual one."""
        file = self.reading.read(path)
        return file._replace(resolution=pixel_side(path, file))

    def losses(
        self, cell_size: float, radius: float = ROBOT_RADIUS
    ) -> dict[str, tuple[float, float]]:
        """Maps of which a reading in cells of this size cuts off or opens much, by name.

        Args:
            cell_size: side of a cell (metres).
            radius: of a robot (metres).

        Returns:
            ``CellFit.lost`` and ``CellFit.opened`` of maps where one is above ``fitting.WARNING``.
        """
        found: dict[str, tuple[float, float]] = {}
        for path in self.paths:
            file = self.file(path)
            if file.resolution is None:
                continue  # a symbol is a cell
            reach = drivable(file.occupied, radius / file.resolution)
            most = self.reading.max_occupied
            fit = grid_fit(file.occupied, reach, cell_size / file.resolution, most)
            if reach.any() and max(fit.lost, fit.opened) > WARNING:
                found[path.name] = fit.lost, fit.opened
        return found


@lru_cache(maxsize=8)
def _load(source: MapSource, cell_size: float) -> tuple[LoadedMap, ...]:
    require_positive("cell_size", cell_size, "metres")
    most = source.reading.max_occupied
    return tuple(to_cells(path, source.file(path), cell_size, most) for path in source.paths)


def _padded(cells: Tensor, size: tuple[int, int], value: bool) -> Tensor:
    """Cells bool [h, w] in the corner of an arena of this size."""
    whole = torch.full(size, value)
    whole[: cells.shape[0], : cells.shape[1]] = cells
    return whole


def _around(loaded: LoadedMap, robots: int) -> Tensor:
    """The marked start cells, with as many rings of free cells as the robots need, bool [H, W]."""
    assert loaded.starts is not None
    place, free = loaded.starts, ~loaded.obstacles
    while int(place.sum()) < robots:
        grown = torch.nn.functional.max_pool2d(place[None].float(), 3, 1, 1)[0].bool() & free
        if grown.equal(place):
            break  # the arena says that there are too few
        place = grown
    return place


@dataclass(frozen=True)
class MapSuite(Suite):
    """Map files as a suite: every map once, in the order of their names."""

    @property
    def id(self) -> str:
        """The name of the file or folder, and the beginning of the fingerprint."""
        return f"{self.name}-{self.digest[:8]}"

    @property
    def arenas(self) -> MapArenas:
        """The maps."""
        arenas = self.generator(self.config)
        assert isinstance(arenas, MapArenas)
        return arenas


def map_suite(text: str, num_agents: int = ArenaConfig.num_agents) -> MapSuite:
    """The suite of the maps that a name gives, for the paper's robots."""
    source = MapSource.parse(text)
    return suite_of(source, Path(text.partition("?")[0]).name, ArenaConfig(num_agents=num_agents))


def suite_of(source: MapSource, name: str, config: ArenaConfig, steps: int = MAP_STEPS) -> MapSuite:
    """Maps as a suite.

    Args:
        source: the files, and how they are read.
        name: of the suite.
        config: robots, and side of the cells.
        steps: length of an evaluation.
    """
    config = source.fit(config)
    arenas = source.arenas(config, in_order=True)
    content = hashlib.sha256(f"{tuple(arenas.maps.shape)} {source.starts}".encode())
    content.update(arenas.maps.numpy().tobytes())
    if arenas.places is not None:
        content.update(arenas.places.numpy().tobytes())
    return MapSuite(
        name=name,
        version=0,
        config=config,
        make=partial(source.arenas, in_order=True),
        digest=content.hexdigest(),
        steps=steps,
        num_arenas=len(arenas.maps),
    )


def is_source(arenas: object) -> bool:
    """Whether a name of arenas is that of a file or folder that exists."""
    place = arenas.partition("?")[0] if isinstance(arenas, str) else ""
    return bool(place) and Path(place).exists()


def map_files(place: Path) -> tuple[Path, ...]:
    """The map file of a path, or all those of a folder in the order of their names.

    An image that a YAML file of the folder names is read by that file alone.

    Raises:
        ValueError: for a folder without map files.
    """
    if not place.is_dir():
        return (place,)
    found = sorted(
        (path for path in place.iterdir() if path.suffix.lower() in ENDINGS), key=lambda p: p.name
    )
    named = {read_yaml_image(path) for path in found if path.suffix.lower() in (".yaml", ".yml")}
    found = [path for path in found if path not in named]
    if not found:
        raise ValueError(f"{place} holds no map file: they end in one of {ENDINGS}")
    return tuple(found)


def parse_pixels(text: str) -> Sequence[tuple[int, int]]:
    """Pixels (row, column) in words, such as "120,80;60,40".

    Raises:
        ValueError: for anything else.
    """
    try:
        pairs = [tuple(map(int, pair.split(","))) for pair in text.split(";")]
    except ValueError:
        pairs = []
    if not pairs or any(len(pair) != 2 or min(pair) < 0 for pair in pairs):
        raise ValueError(
            f"starts={text!r} is not allowed: use one of {STARTS}, or pixels row,column;row,column"
        )
    return [(row, column) for row, column in pairs]
