"""Explore maps: floor plans as images, ROS maps, MovingAI maps or drawings, from file to picture.

marl-explore explore plan.png --robots 4

marl-explore explore maps/ --policy nearest-timer --free 195-255 --occupied 0-127 --out explored

Every map of a folder is explored once, in the order of their names. Where they are not given, the
resolution and the size of the cells are chosen from each map: the coarsest grid that keeps every
way that a robot can drive. Robots sense and communicate as far as on the paper's arenas, in cells.
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tqdm import tqdm

from marl_explore.cli.common import parse_options
from marl_explore.config.arena import COMMUNICATION_RANGE_M, SENSING_RANGE_M, ArenaConfig
from marl_explore.config.checks import require_integer, require_positive

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from marl_explore.arenas.fitting import CellFit
    from marl_explore.arenas.maps import MapArenas
    from marl_explore.evaluation.episodes import Actor

STEPS_PER_CELL = 2
"""Most steps of an exploration, per free cell of the map."""
COLUMNS = {
    "map": "map",
    "cells": "cells",
    "cell_size_m": "cell (m)",
    "steps": "steps",
    "coverage": "coverage",
    "distance_m": "way (m)",
    "communication_share": "communicate",
    "seconds": "seconds",
}
"""What is told of every map, and its column."""


@dataclass(frozen=True)
class Arguments:
    """Which maps, by which team."""

    maps: Annotated[Path, tyro.conf.Positional]
    """Map file, or folder of map files."""
    robots: int = 4
    """Robots of the team."""
    policy: str = "best"
    """Bundled policy, run folder, policy file, planner, or package.module:attribute."""
    out: Path = Path("explored")
    """New folder for the figure and the page of every map, and results.csv."""
    starts: str = "clustered"
    """clustered, scattered, marked, or pixels row,column;row,column;... for all maps."""
    resolution: float | None = None
    """Side of a pixel (metres); default: what the file says, else 0.05 for an image."""
    cell_size: float | None = None
    """Side of a cell (metres); default: chosen from the map."""
    robot_radius: float = 0.2
    """Radius of a robot, for which cells are chosen (metres)."""
    free: str | None = None
    """Grey values of free pixels, such as 195-255 or 50-80,195-255."""
    occupied: str | None = None
    """Grey values of obstacles, such as 0-127."""
    threshold: float | None = None
    """Darkness at which obstacles begin, in place of grey values."""
    start_value: int | None = None
    """Grey value of the pixels where robots start."""
    max_occupied: float = 0.0
    """Share of a free cell that may be occupied."""
    steps: int | None = None
    """Most steps; default: two for every free cell."""
    seed: int = 0
    """Seed of starts and of sampled actions."""

    def __post_init__(self) -> None:
        """Check the settings."""
        require_integer("robots", self.robots, 1)
        require_integer("seed", self.seed, 0)
        require_positive("robot_radius", self.robot_radius, "metres")
        for name in ("resolution", "cell_size"):
            if getattr(self, name) is not None:
                require_positive(name, getattr(self, name), "metres")
        if self.steps is not None:
            require_integer("steps", self.steps, 1)


def parse(words: Sequence[str], prog: str = "marl-explore explore") -> Arguments:
    """Read a command line."""
    return parse_options(Arguments, words, prog, __doc__)


def run(arguments: Arguments) -> None:
    """Explore every map; print a table, write figures, pages and a CSV."""
    from marl_explore.arenas.sources import map_files
    from marl_explore.utils import records, tables

    if not arguments.maps.exists():
        raise ValueError(f"maps={str(arguments.maps)!r} is not allowed: it does not exist")
    paths = map_files(arguments.maps)
    records.require_new(arguments.out)
    how = records.provenance()
    prepared = [(path, *_prepare(path, arguments)) for path in paths]  # refused before any is run
    folder = records.new_folder(arguments.out)
    rows: list[dict[str, Any]] = []
    quiet = len(prepared) == 1 or not sys.stderr.isatty()
    for path, config, arenas in tqdm(prepared, unit="map", disable=quiet):
        rows.append(_explore(path, config, arenas, arguments, folder, how["command"]))
        _write_csv(folder / "results.csv", rows)
    shown = [[_shown(row[key]) for key in COLUMNS] for row in rows]
    print(tables.text([*COLUMNS.values()], shown))
    print(f"a figure and a page for every map, and results.csv: {folder}")


def _prepare(path: Path, arguments: Arguments) -> tuple[ArenaConfig, MapArenas]:
    """Settings and arenas of one map; says what was chosen, and what the reading loses."""
    from marl_explore.arenas import fitting
    from marl_explore.arenas.maps import Reading
    from marl_explore.arenas.sources import MapSource
    from marl_explore.evaluation.registry import find_policy

    reading = Reading(
        arguments.resolution,
        arguments.max_occupied,
        arguments.threshold,
        arguments.free,
        arguments.occupied,
        arguments.start_value,
    )
    source = MapSource((path,), reading, arguments.starts)
    file = source.file(path)
    side, cell = file.resolution, arguments.cell_size
    if side is None:
        cell = cell or ArenaConfig.cell_size
        print(f"{path.name}: a pixel is a cell of {cell:g} m")
    else:
        radius, most = arguments.robot_radius / side, arguments.max_occupied
        if cell is None:
            found = fitting.fit_cells(file.occupied, radius, most)
        else:
            reach = fitting.drivable(file.occupied, radius)
            found = fitting.grid_fit(file.occupied, reach, cell / side, most)
        chosen = "" if cell else ", chosen"
        cell = found.pixels_per_cell * side
        print(f"{path.name}: pixels of {side:g} m, cells of {cell:g} m{chosen}")
        _warn(path, found, file.occupied, side, arguments)
    scale = cell / ArenaConfig.cell_size
    (loaded,) = source.load(cell)
    height, width = loaded.obstacles.shape
    config = ArenaConfig(
        height,
        width,
        obstacle_density=0.0,
        num_agents=arguments.robots,
        cell_size=cell,
        sensing_range=SENSING_RANGE_M * scale,
        communication_range=COMMUNICATION_RANGE_M * scale,
    )
    find_policy(arguments.policy, config)
    return config, source.arenas(config, in_order=True)


def _warn(path: Path, found: CellFit, occupied: Any, side: float, arguments: Arguments) -> None:
    """Say what a reading cuts off or opens, and what would fit."""
    from marl_explore.arenas import fitting

    if max(found.lost, found.opened) <= fitting.WARNING:
        return
    better = fitting.fit_cells(occupied, arguments.robot_radius / side)
    advice = "no cells as wide as the robot keep it"
    if better.lost <= fitting.WARNING:
        advice = f"--cell-size {better.pixels_per_cell * side:g} --max-occupied 0 keeps it"
    shares = {
        "is cut off from the rest": found.lost,
        "lies behind walls that the reading opens": found.opened,
    }
    for what, share in shares.items():
        if share > fitting.WARNING:
            print(f"  warning: {share:.0%} of the area of {path.name} {what}; {advice}")


def _explore(
    path: Path, config: ArenaConfig, arenas: MapArenas, arguments: Arguments, out: Path, about: str
) -> dict[str, Any]:
    """Explore one map, draw it, and measure it."""
    from marl_explore.evaluation import metrics, plots
    from marl_explore.evaluation.episodes import measure_steps, watch
    from marl_explore.evaluation.registry import find_policy
    from marl_explore.evaluation.replay import write_replay

    free = int((~arenas.maps).sum())
    start = time.perf_counter()
    policy = find_policy(arguments.policy, config)
    most = arguments.steps or max(300, STEPS_PER_CELL * free)
    with tqdm(desc=path.name, unit=" steps", leave=False, disable=None, delay=1) as bar:
        watched = _Counted(policy, bar)
        steps = watch(watched, config, steps=most, seed=arguments.seed, arenas=arenas)
    seconds = time.perf_counter() - start
    episodes = measure_steps(steps, config)
    known = metrics.coverage(episodes)["largest"][0]
    plots.episode_figure(steps, out / f"{path.stem}.png")
    page = out / f"{path.stem}.html"
    write_replay({arguments.policy: steps}, page, config=config, about=about)
    return {
        "map": path.name,
        "cells": f"{config.height} x {config.width}",
        "cell_size_m": config.cell_size,
        "steps": len(steps) - 1,
        "coverage": float(known[-1]),
        "distance_m": float(metrics.distance_travelled(episodes)[0]),
        "communication_share": metrics.communication_share(episodes).pooled,
        "seconds": seconds,
    }


class _Counted:
    """A policy whose steps a progress bar shows."""

    def __init__(self, policy: Actor, bar: tqdm[Any]) -> None:
        self.policy, self.bar = policy, bar
        self.shares_maps = getattr(policy, "shares_maps", False)

    def __call__(self, observation: TensorDictBase) -> TensorDictBase:
        self.bar.update()
        return self.policy(observation)


def _write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    from marl_explore.utils.files import atomic_write

    with atomic_write(path) as unfinished, unfinished.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*COLUMNS])
        writer.writeheader()
        writer.writerows(rows)


def _shown(value: object) -> str:
    from marl_explore.utils import tables

    return tables.number(value) if isinstance(value, float) else str(value)
