"""Where arenas come from: suites by name, generators for any size, and maps from files.

A generator draws arenas as a pure function of numbers:
``generate(seed, arenas, episodes) -> (obstacles, positions)`` with int64 [A] arena indices and
episode numbers, bool [A, H, W] obstacles and int64 [A, N, 2] start cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from marl_explore.arenas.caves import Caves
from marl_explore.arenas.corridors import Corridors
from marl_explore.arenas.generator import ArenaGenerator, Generator
from marl_explore.arenas.maps import MapArenas, load_map
from marl_explore.arenas.mazes import Mazes
from marl_explore.arenas.mixed import Mixed
from marl_explore.arenas.rooms import Rooms
from marl_explore.arenas.suites import Suite, list_suites, suite
from marl_explore.arenas.uniform import Uniform
from marl_explore.config.arena import ANY_SIZE, ArenaConfig
from marl_explore.core.world import check_starts

__all__ = [
    "ArenaGenerator",
    "Caves",
    "Corridors",
    "Generator",
    "MapArenas",
    "Mazes",
    "Mixed",
    "Rooms",
    "Suite",
    "Uniform",
    "default_config",
    "default_steps",
    "full_name",
    "list_suites",
    "load_map",
    "resolve",
    "suite",
]


@dataclass(frozen=True)
class Checked:
    """A user's generator, refused when what it draws is no arena of the configuration."""

    generate: Generator
    config: ArenaConfig

    def __call__(self, seed: int, arenas: Tensor, episodes: Tensor) -> tuple[Tensor, Tensor]:
        """What ``generate`` draws.

        Raises:
            ValueError: for another dtype or shape, or start cells that cannot be.
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
    """The generator of a suite's name, or the callable itself.

    Raises:
        ValueError: naming the known suites, for an unknown name; or the field of ``config`` in
            which it differs from the suite.
    """
    if callable(arenas):
        return Checked(arenas, config)
    kinds = {"uniform": Uniform, "mixed": Mixed}
    return kinds[arenas](config) if arenas in kinds else suite(arenas).generator(config)


def default_config(arenas: str | Generator) -> ArenaConfig:
    """The configuration that arenas bring with them: a suite's, a generator's, or the paper's.

    A generator has one when its attribute ``config`` is an ``ArenaConfig``.
    """
    own = getattr(arenas, "config", None)
    if isinstance(own, ArenaConfig):
        return own
    return ArenaConfig() if callable(arenas) or arenas in ANY_SIZE else suite(arenas).config


def default_steps(arenas: str | Generator) -> int:
    """Length of an evaluation on arenas: a suite's own, or the paper's 300 steps."""
    return 300 if callable(arenas) or arenas in ANY_SIZE else suite(arenas).steps


def full_name(arenas: str) -> str:
    """A suite's name with its version.

    Raises:
        ValueError: naming the known suites, for an unknown name.
    """
    return arenas if arenas in ANY_SIZE else suite(arenas).id
