"""Arenas of all kinds side by side, to train one policy for all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from marl_explore.arenas.caves import Caves
from marl_explore.arenas.corridors import Corridors
from marl_explore.arenas.generator import ArenaGenerator
from marl_explore.arenas.mazes import Mazes
from marl_explore.arenas.rooms import Rooms
from marl_explore.arenas.uniform import Uniform
from marl_explore.config.arena import ArenaConfig


@dataclass(frozen=True)
class Quarter(ArenaGenerator):
    """A uniform arena of half the height and width in one corner; the rest is obstacles."""

    def obstacles(self, keys: Tensor) -> Tensor:
        """Obstacles bool [A, H, W], free cells connected."""
        height, width = -(-self.config.height // 2), -(-self.config.width // 2)
        part = Uniform(replace(self.config, height=height, width=width)).obstacles(keys)
        pad = (0, self.config.width - width, 0, self.config.height - height)
        return torch.nn.functional.pad(part, pad, value=True)


Kind = tuple[Callable[[ArenaConfig, str], ArenaGenerator], str]
"""From a configuration and a rule of starts to a generator, and that rule."""

KINDS: tuple[Kind, ...] = (
    (Uniform, "scattered"),
    (Rooms, "clustered"),
    (Quarter, "scattered"),
    (Mazes, "clustered"),
    (Corridors, "scattered"),
    (Caves, "clustered"),
)


@dataclass(frozen=True)
class Mixed:
    """Draws arenas of several kinds in any size: arena i is of kind i modulo their number.

    By default of the suites' kinds, in this order: uniform, rooms, uniform in a corner of half the
    height and width, mazes, corridors, caves. Robots start as in the suites. A row of an
    environment keeps its kind, so the number of rows should be a multiple of that of the kinds.

    Args:
        config: size of the arenas, number of robots, and density of the uniform ones.
        kinds: what makes the generator of each kind, and how robots start there.
    """

    config: ArenaConfig
    kinds: tuple[Kind, ...] = KINDS

    def __call__(self, seed: int, arenas: Tensor, episodes: Tensor) -> tuple[Tensor, Tensor]:
        """Obstacles bool [A, H, W] and starts int64 [A, N, 2] of arenas and episodes [A]."""
        size = (len(arenas), self.config.height, self.config.width)
        obstacles = torch.zeros(size, dtype=torch.bool, device=arenas.device)
        positions = arenas.new_zeros(len(arenas), self.config.num_agents, 2)
        for number, (kind, starts) in enumerate(self.kinds):
            rows = (arenas % len(self.kinds) == number).nonzero().squeeze(-1)
            if len(rows):
                generate = kind(self.config, starts)
                obstacles[rows], positions[rows] = generate(seed, arenas[rows], episodes[rows])
        return obstacles, positions
