"""The benchmarks: which maps, which robots in which world, how many steps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from marl_explore.arenas import MapSource
from marl_explore.arenas.map_sets import DUNGEONS, MapSet
from marl_explore.arenas.sources import MAP_STEPS, MapSuite, suite_of
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require, require_integer, require_positive
from marl_explore.utils.files import file_digest

SEED = 0
"""Of the starts, of what happens in the world, and of sampled actions."""
LIDAR = {
    "sensing_range": 5.0,
    "sensing_shape": "disc",
    "line_of_sight": True,
    "communication_range": 5.0,
    "wall_loss_db": math.inf,
}
WORLDS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    "lidar": LIDAR,
    "lidar-lossy": {**LIDAR, "message_loss": 0.1},
}
"""What differs from the paper's world, in cells of 0.5 m (lengths in metres)."""
FEW = 40
"""Maps of a known set on which smaller and larger teams are measured."""


class Prepared(NamedTuple):
    """A benchmark with the maps of a user."""

    benchmark: Benchmark
    suite: MapSuite
    maps: dict[str, str]
    """SHA-256 of every map's file by its name, in the order in which the maps are taken."""


@dataclass(frozen=True)
class Benchmark:
    """One table: maps, a team and its world."""

    name: str
    map_set: MapSet | None
    """The set whose maps it takes; None: whatever maps a user has."""
    robots: int = 4
    world: str = "paper"
    num_maps: int | None = None
    """The first maps only; None: all."""
    steps: int = MAP_STEPS

    def config(self, cell_size: float) -> ArenaConfig:
        """The robots, whose ranges are the same number of cells in cells of any size (metres)."""
        config = ArenaConfig(num_agents=self.robots, **WORLDS[self.world])
        scale = cell_size / config.cell_size
        lengths = {n: scale * getattr(config, n) for n in ("sensing_range", "communication_range")}
        return replace(config, cell_size=cell_size, **lengths)

    def prepare(
        self, text: str, cell_size: float | None = None, num_maps: int | None = None
    ) -> Prepared:
        """The benchmark on a user's maps.

        Args:
            text: of a known set its folder, or a clone that has it; else a file or folder with
                options, as ``arenas`` takes them.
            cell_size: side of a cell (metres) of maps that are no known set; None: 0.5.
            num_maps: the first ones only, to try something; None: all of the benchmark.

        Raises:
            ValueError: for maps that are not those of the set, or cannot be read.
        """
        if self.map_set is None:
            source = MapSource.parse(text)
        else:
            fixed = f"{self.name} has cells of its own"
            require(cell_size is None, "cell_size", cell_size, fixed)
            source = self.map_set.source(text)
        if num_maps is not None:
            require_integer("num_maps", num_maps, 1, self.num_maps or len(source.paths))
        source = replace(source, paths=source.paths[: num_maps or self.num_maps])
        side = ArenaConfig.cell_size if cell_size is None else cell_size
        require_positive("cell_size", side, "metres")
        suite = suite_of(source, self.name, self.config(side), self.steps)
        return Prepared(self, suite, {path.name: file_digest(path) for path in source.paths})


def _tables(prefix: str, map_set: MapSet | None) -> list[Benchmark]:
    """The five tables of a set: three worlds, and smaller and larger teams in the paper's."""
    few = None if map_set is None else FEW
    return [
        Benchmark(f"{prefix}-4", map_set),
        Benchmark(f"{prefix}-4-lidar", map_set, world="lidar"),
        Benchmark(f"{prefix}-4-lidar-lossy", map_set, world="lidar-lossy"),
        Benchmark(f"{prefix}-2", map_set, robots=2, num_maps=few),
        Benchmark(f"{prefix}-8", map_set, robots=8, num_maps=few),
    ]


BENCHMARKS = {
    benchmark.name: benchmark
    for benchmark in (*_tables(DUNGEONS.name, DUNGEONS), *_tables("maps", None))
}
"""By name; "maps-..." take whatever maps a user has."""


def find_benchmark(name: object) -> Benchmark:
    """The benchmark with this name.

    Raises:
        ValueError: listing the known ones.
    """
    known = isinstance(name, str) and name in BENCHMARKS
    require(known, "benchmark", name, f"use one of {', '.join(BENCHMARKS)}")
    return BENCHMARKS[str(name)]
