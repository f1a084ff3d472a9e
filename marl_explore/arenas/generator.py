"""The base class of generators: random numbers from hashes, obstacles first, then start cells."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from itertools import cycle

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_explore.arenas.starts import START_RULES
from marl_explore.config.arena import ArenaConfig
from marl_explore.core.hashing import combine

Generator = Callable[[int, Tensor, Tensor], tuple[Tensor, Tensor]]
Draw = Callable[[], int]
"""The next random number of one arena."""
Board = NDArray[np.bool_]
"""Obstacles of one arena, bool [H, W]."""

MAX_ATTEMPTS = 1000
OBSTACLES, STARTS = 0, 1  # the two streams of random numbers of one arena


@dataclass(frozen=True)
class ArenaGenerator(ABC):
    """Draws arenas of one kind: a pure function of seed, arena index and episode number.

    Args:
        config: size of the arena and number of robots.
        starts: "scattered" over the free cells, or "clustered" around one of them.

    Raises:
        ValueError: for an unknown start rule.
    """

    config: ArenaConfig
    starts: str = "scattered"

    def __post_init__(self) -> None:
        """Check the start rule."""
        if self.starts not in START_RULES:
            raise ValueError(f"starts={self.starts!r} is unknown: use one of {[*START_RULES]}")

    def __call__(self, seed: int, arenas: Tensor, episodes: Tensor) -> tuple[Tensor, Tensor]:
        """Obstacles bool [A, H, W] and starts int64 [A, N, 2] of arenas and episodes [A].

        Raises:
            ValueError: when the robots do not fit into an arena.
        """
        keys = combine(seed, arenas, episodes)
        obstacles = self.obstacles(keys)
        return obstacles, self.positions(keys, obstacles)

    @abstractmethod
    def obstacles(self, keys: Tensor) -> Tensor:
        """Obstacles bool [A, H, W] of arenas with the hashes ``keys``, int64 [A]."""

    def positions(self, keys: Tensor, obstacles: Tensor) -> Tensor:
        """Start cells int64 [A, N, 2] in arenas bool [A, H, W] with connected free cells."""
        return self.place(keys, ~obstacles)

    def place(self, keys: Tensor, free: Tensor) -> Tensor:
        """Start cells int64 [A, N, 2] among connected free cells bool [A, H, W]."""
        robots, fewest = self.config.num_agents, int(free.flatten(-2).sum(-1).min())
        if robots > fewest:
            raise ValueError(
                f"num_agents={robots} is not allowed: an arena has only {fewest} free cells"
            )
        order = numbers(keys, STARTS, count=self.config.num_cells)
        return START_RULES[self.starts](order, free, robots)


def numbers(keys: Tensor, *stream: int, count: int) -> Tensor:
    """Random numbers int64 [A, count] of one stream of the arenas with the hashes ``keys`` [A]."""
    return combine(keys.unsqueeze(-1), *stream, torch.arange(count, device=keys.device))


def one_by_one(draw_board: Callable[[Draw], Board], keys: Tensor, count: int) -> Tensor:
    """Obstacles bool [A, H, W] of arenas that are drawn one by one.

    Args:
        draw_board: makes one arena from the random numbers that it draws.
        keys: hashes of the arenas, int64 [A].
        count: random numbers per arena; after them the same ones repeat.
    """
    rows = numbers(keys, OBSTACLES, count=count).tolist()
    boards = np.stack([draw_board(cycle(row).__next__) for row in rows])
    return torch.from_numpy(boards).to(keys.device)


def redraw(
    config: ArenaConfig,
    keys: Tensor,
    draw: Callable[[Tensor, int], Tensor],
    accept: Callable[[Tensor], Tensor],
    failure: str,
) -> Tensor:
    """Obstacles bool [A, H, W]; every arena is redrawn until it is accepted.

    Args:
        config: size of the arenas.
        keys: hashes of the arenas, int64 [A].
        draw: from hashes and the number of the attempt to obstacles.
        accept: whether obstacles [A, H, W] are accepted, bool [A].
        failure: error message when all attempts have failed.

    Raises:
        ValueError: when an arena is rejected MAX_ATTEMPTS times.
    """
    size = (len(keys), config.height, config.width)
    obstacles = torch.zeros(size, dtype=torch.bool, device=keys.device)
    rejected = torch.arange(len(keys), device=keys.device)
    for attempt in range(MAX_ATTEMPTS):
        obstacles[rejected] = draw(keys[rejected], attempt)
        rejected = rejected[~accept(obstacles[rejected])]
        if not len(rejected):
            return obstacles
    raise ValueError(
        f"{failure}: no arena of {config.height} x {config.width} cells was accepted in "
        f"{MAX_ATTEMPTS} attempts"
    )
