"""Suites: kinds of arenas with a versioned name and a recorded hash of their arenas."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from marl_explore.arenas.caves import Caves
from marl_explore.arenas.corridors import Corridors
from marl_explore.arenas.generator import Generator
from marl_explore.arenas.mazes import Mazes
from marl_explore.arenas.rooms import Rooms
from marl_explore.arenas.uniform import Uniform
from marl_explore.config.arena import ANY_SIZE, ArenaConfig
from marl_explore.core.hashing import stream_seed

_ARENA_FIELDS = ("height", "width", "obstacle_density")


@dataclass(frozen=True)
class Suite:
    """A kind of arena that never changes under its name and version."""

    name: str
    """Name without version: kind and side of the arena, such as "rooms-32"."""
    version: int
    """To be increased when the arenas change."""
    config: ArenaConfig
    """Size and mean obstacle density, which are fixed; robots and ranges may be replaced."""
    make: Callable[[ArenaConfig], Generator]
    """From a configuration to the generator of its arenas."""
    digest: str
    """The recorded fingerprint of this version's arenas."""
    steps: int
    """Length of an evaluation: the paper's 300 steps, or nearly twice as many as nearest-frontier
    robots that never communicate need."""

    @property
    def id(self) -> str:
        """Name and version, such as "rooms-32-v1"."""
        return f"{self.name}-v{self.version}"

    @property
    def arenas(self) -> str:
        """What ``ExplorationEnv(arenas=...)`` knows it by."""
        return self.id

    def fit(self, config: ArenaConfig) -> ArenaConfig:
        """The robots and ranges of ``config`` in arenas of the suite's size and density."""
        return replace(config, **{name: getattr(self.config, name) for name in _ARENA_FIELDS})

    def generator(self, config: ArenaConfig) -> Generator:
        """The suite's generator for the robots of ``config``.

        Raises:
            ValueError: when size or density differ from the suite's.
        """
        for name in _ARENA_FIELDS:
            value, own = getattr(config, name), getattr(self.config, name)
            if value != own:
                raise ValueError(
                    f"{name}={value} is not allowed: arenas={self.id!r} has {own}; leave {name} "
                    "to the suite"
                )
        return self.make(config)

    def fingerprint(self, num_arenas: int = 200) -> str:
        """SHA-256 of the first arenas of stream "test", seed 0, episode 0, with the suite's robots.

        The bytes are those of all obstacles (uint8), then of all positions (int64, little endian).
        """
        arenas = torch.arange(num_arenas)
        drawn = self.make(self.config)(stream_seed("test", 0), arenas, torch.zeros_like(arenas))
        obstacles, positions = (part.numpy() for part in drawn)
        content = obstacles.astype(np.uint8).tobytes() + positions.astype("<i8").tobytes()
        return hashlib.sha256(content).hexdigest()


def _square(side: int, density: float) -> ArenaConfig:
    return ArenaConfig(height=side, width=side, obstacle_density=density)


SUITES = (
    Suite(
        name="paper-12",
        version=1,
        config=ArenaConfig(),
        make=Uniform,
        digest="244b534f290772c6bad2d8b5edb413cd00f4a9fc4566b84f334adb1ae141db48",
        steps=300,
    ),
    Suite(
        name="open-24",
        version=1,
        config=_square(24, density=0.1),
        make=Uniform,
        digest="6273fdd9915be7c28d867a1c27c343aa63d15f2deb48c32fdb90ca12836ca290",
        steps=500,
    ),
    Suite(
        name="rooms-32",
        version=1,
        config=_square(32, density=0.15),
        make=partial(Rooms, starts="clustered"),
        digest="1502783d7207bee0b71cb41904240ecb57115d025bb99e9d3b1afa33a7d72b32",
        steps=1000,
    ),
    Suite(
        name="maze-32",
        version=1,
        config=_square(32, density=0.27),
        make=partial(Mazes, starts="clustered"),
        digest="b4a90f784ced8683179a3eb55b4b1cbfa39bd9abac3bbd1fcb5bedf839b40322",
        steps=1000,
    ),
    Suite(
        name="cave-48",
        version=1,
        config=_square(48, density=0.4),
        make=partial(Caves, starts="clustered"),
        digest="3d0c35450a796be2c44f9ab9c1ec7c2dbef5a682bf923475cd57a929e932af4d",
        steps=1500,
    ),
    Suite(
        name="corridor-24",
        version=1,
        config=_square(24, density=0.51),
        make=Corridors,
        digest="38c12395ed21e760856c96c21ecebc3986c1aa9e080728d1da404fdb81b2c761",
        steps=500,
    ),
)


def list_suites() -> list[str]:
    """Names for ``ExplorationEnv(arenas=...)``; those of ``ANY_SIZE`` take any size."""
    return [*ANY_SIZE, *(entry.id for entry in SUITES)]


def suite(name: str) -> Suite:
    """The suite with this name; the newest if it has no version.

    Raises:
        ValueError: for an unknown name, listing the known suites.
    """
    found = [entry for entry in SUITES if name in (entry.id, entry.name)]
    if not found:
        known = [entry.id for entry in SUITES]
        raise ValueError(
            f"arenas={name!r} is not a suite: use one of {known}; {[*ANY_SIZE]} are not suites"
        )
    return max(found, key=lambda entry: entry.version)
