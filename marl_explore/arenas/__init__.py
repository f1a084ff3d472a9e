"""Arenas: suites by name, generators for any size, and maps from files.

A generator draws arenas as a pure function:
``generate(seed, arenas, episodes) -> (obstacles, positions)`` with int64 [A] arena indices and
episode numbers, bool [A, H, W] obstacles and int64 [A, N, 2] start cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from marl_explore.arenas.caves import Caves
from marl_explore.arenas.corridors import Corridors
from marl_explore.arenas.generator import ArenaGenerator, Generator
from marl_explore.arenas.maps import MapArenas, load_map
from marl_explore.arenas.mazes import Mazes
from marl_explore.arenas.mixed import Mixed
from marl_explore.arenas.rooms import Rooms
from marl_explore.arenas.sources import MAP_STEPS, MapSource, is_source, map_suite
from marl_explore.arenas.suites import Suite, list_suites, suite
from marl_explore.arenas.uniform import Uniform
from marl_explore.arenas.uniform_v2 import UniformV2
from marl_explore.config.arena import ANY_SIZE, ArenaConfig
from marl_explore.core.world import check_starts

__all__ = [
    "ArenaGenerator",
    "Caves",
    "Corridors",
    "Generator",
    "MapArenas",
    "MapSource",
    "Mazes",
    "Mixed",
    "Rooms",
    "Suite",
    "Uniform",
    "UniformV2",
    "default_config",
    "default_number",
    "default_steps",
    "fit",
    "full_name",
    "in_order",
    "is_source",
    "list_suites",
    "load_map",
    "map_suite",
    "resolve",
    "suite",
]


@dataclass(frozen=True)
class Checked:
    """A user's generator, with a check that its arenas fit the configuration."""

    generate: Generator
    config: ArenaConfig

    def __call__(self, seed: int, arenas: Tensor, episodes: Tensor) -> tuple[Tensor, Tensor]:
        """The arenas from ``generate``.

        Raises:
            ValueError: for a wrong dtype or shape, or start cells that are not allowed.
        """
        obstacles, positions = self.generate(seed, arenas, episodes)
        config, count = self.config, len(arenas)
        expected = {
            "obstacles": (obstacles, torch.bool, (count, config.height, config.width)),
            "positions": (positions, torch.int64, (count, config.num_agents, 2)),
        }
        for name, (drawn, dtype, shape) in expected.items():
            if drawn.dtype != dtype or drawn.shape != shape:
                raise ValueError(
                    f"arenas must return {name} {dtype} of shape {shape}, got {drawn.dtype} of "
                    f"shape {tuple(drawn.shape)}"
                )
        check_starts(obstacles, positions)
        return obstacles, positions


def resolve(arenas: str | Generator, config: ArenaConfig) -> Generator:
    """The generator of a suite by name, or the callable itself.

    Raises:
        ValueError: for an unknown name, listing the known suites, or for a ``config`` that differs
            from the suite, naming the field.
    """
    if callable(arenas):
        return Checked(arenas, config)
    if is_source(arenas):
        return MapSource.parse(arenas).arenas(config)
    kinds = {"uniform": Uniform, "uniform-v2": UniformV2, "mixed": Mixed}
    return kinds[arenas](config) if arenas in kinds else suite(arenas).generator(config)


def default_config(arenas: str | Generator) -> ArenaConfig:
    """The default configuration for arenas: a suite's, a generator's, or the paper's.

    A generator has one when its attribute ``config`` is an ``ArenaConfig``.
    """
    own = getattr(arenas, "config", None)
    if isinstance(own, ArenaConfig):
        return own
    if callable(arenas) or arenas in ANY_SIZE:
        return ArenaConfig()
    return fit(ArenaConfig(), arenas)


def default_steps(arenas: str | Generator) -> int:
    """Length of an evaluation on arenas: a suite's own, or the paper's 300 steps."""
    if is_source(arenas):
        return MAP_STEPS
    return 300 if callable(arenas) or arenas in ANY_SIZE else suite(arenas).steps


def default_number(arenas: str | Generator) -> int:
    """Arenas of an evaluation: every map of a folder once, a suite's own number, or 200."""
    if isinstance(arenas, MapArenas):
        return len(arenas.maps)
    if is_source(arenas):
        return len(MapSource.parse(str(arenas)).paths)
    own = None if callable(arenas) or arenas in ANY_SIZE else suite(arenas).num_arenas
    return own or 200


def full_name(arenas: str) -> str:
    """A suite's name with its version.

    Raises:
        ValueError: for an unknown name, listing the known suites.
    """
    return arenas if arenas in ANY_SIZE or is_source(arenas) else suite(arenas).id


def fit(config: ArenaConfig, arenas: str) -> ArenaConfig:
    """The robots of ``config`` in arenas of the size that a suite or map files bring.

    A suite that brings its robots too, such as "lidar-32", replaces them.

    Raises:
        ValueError: naming the known suites, for an unknown name.
    """
    if arenas in ANY_SIZE:
        return config
    return MapSource.parse(arenas).fit(config) if is_source(arenas) else suite(arenas).fit(config)


def in_order(arenas: str | Generator, config: ArenaConfig) -> str | Generator:
    """Arenas for an evaluation: of map files every one in turn, others as they are."""
    if isinstance(arenas, MapArenas):
        return replace(arenas, in_order=True)
    if is_source(arenas):
        return MapSource.parse(str(arenas)).arenas(config, in_order=True)
    return arenas
