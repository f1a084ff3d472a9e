"""Where arenas come from: a registry of suites, each a pure function of numbers.

A suite is made for a configuration and then draws arenas:
``generate(seed, arenas, episodes) -> (obstacles, positions)`` with int64 [A] arena indices and
episode numbers, bool [A, H, W] obstacles and int64 [A, N, 2] start cells.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from marl_explore.arenas.uniform import uniform
from marl_explore.config import ArenaConfig

Generator = Callable[[int, Tensor, Tensor], tuple[Tensor, Tensor]]

SUITES: dict[str, Callable[[ArenaConfig], Generator]] = {"uniform": uniform}


def list_suites() -> list[str]:
    """Names of the arena suites, for ``ExplorationEnv(arenas=...)``."""
    return sorted(SUITES)


def resolve(arenas: str | Generator, config: ArenaConfig) -> Generator:
    """The generator of a suite's name, or the callable itself.

    Raises:
        ValueError: naming the known suites, for an unknown name.
    """
    if callable(arenas):
        return arenas
    if arenas not in SUITES:
        raise ValueError(f"arenas={arenas!r} is unknown: use a callable or one of {list_suites()}")
    return SUITES[arenas](config)
