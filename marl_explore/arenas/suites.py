"""Suites: kinds of arenas with a versioned name and a recorded hash of their arenas."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
import torch

from marl_explore.arenas.caves import Caves
from marl_explore.arenas.corridors import Corridors
from marl_explore.arenas.generator import Generator
from marl_explore.arenas.mazes import Mazes
from marl_explore.arenas.mixed import Kind, Mixed
from marl_explore.arenas.rooms import Rooms
from marl_explore.arenas.uniform import Uniform
from marl_explore.arenas.uniform_v2 import UniformV2
from marl_explore.config.arena import ANY_SIZE, ArenaConfig
from marl_explore.core.hashing import stream_seed

_ARENA_FIELDS = ("height", "width", "obstacle_density")
_ALL_FIELDS = tuple(field.name for field in fields(ArenaConfig))


@dataclass(frozen=True)
class Suite:
    """A kind of arena that never changes under its name and version."""

    name: str
    """Name without version: kind and side of the arena, such as "rooms-32"."""
    version: int
    """To be increased when the arenas, or other settings that belong to the suite, change."""
    config: ArenaConfig
    """Size, mean obstacle density, robots and all their settings."""
    make: Callable[[ArenaConfig], Generator]
    """From a configuration to the generator of its arenas."""
    digest: str
    """The recorded fingerprint of this version's arenas."""
    steps: int
    """Length of an evaluation: the paper's 300 steps, or nearly twice as many as nearest-frontier
    robots that never communicate need."""
    fixed: tuple[str, ...] = _ARENA_FIELDS
    """Fields of ``config`` that belong to the suite; the others may be replaced."""
    num_arenas: int | None = None
    """Arenas of an evaluation; None: 200, and fewer of larger arenas in a leaderboard."""

    @property
    def id(self) -> str:
        """Name and version, such as "rooms-32-v1"."""
        return f"{self.name}-v{self.version}"

    @property
    def arenas(self) -> str | Generator:
        """What ``ExplorationEnv(arenas=...)`` takes."""
        return self.id

    @property
    def brings_robots(self) -> bool:
        """Whether the robots and their settings belong to the suite."""
        return "num_agents" in self.fixed

    def fit(self, config: ArenaConfig) -> ArenaConfig:
        """A configuration with what belongs to the suite: its size and density, or everything."""
        return replace(config, **{name: getattr(self.config, name) for name in self.fixed})

    def generator(self, config: ArenaConfig) -> Generator:
        """The suite's generator for the robots of ``config``.

        Raises:
            ValueError: when a field that belongs to the suite differs, naming it.
        """
        for name in self.fixed:
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


def _open_ground(config: ArenaConfig, starts: str) -> UniformV2:
    return UniformV2(replace(config, obstacle_density=0.1), starts)


_IN_TURN: tuple[Kind, ...] = tuple(
    (kind, "clustered") for kind in (Rooms, Caves, Mazes, _open_ground)
)
_LIDAR = replace(
    _square(32, density=0.24),
    sensing_range=3.5,
    sensing_shape="disc",
    line_of_sight=True,
    communication_range=5.0,
    wall_loss_db=math.inf,
)
_RADIO = replace(
    _LIDAR,
    communication_range=8.0,
    wall_loss_db=6.0,
    path_loss_exponent=2.5,
    shadowing_db=4.0,
    message_loss=0.1,
)
_MIXED_TEAM = replace(
    _LIDAR,
    sensing_range=(1.5, 1.5, 4.0, 4.0),  # two scouts and two mappers
    communication_range=(4.0, 4.0, 8.0, 8.0),
    move_period=(1, 1, 2, 2),
)
_FAULTY = replace(_RADIO, num_agents=6, failure_rate=0.001, num_walkers=4)


def _in_turn(name: str, config: ArenaConfig, digest: str) -> Suite:
    """A suite of rooms, caves, mazes and open ground in turn that brings its robots."""
    return Suite(
        name=name,
        version=1,
        config=config,
        make=partial(Mixed, kinds=_IN_TURN),
        digest=digest,
        steps=1000,
        fixed=_ALL_FIELDS,
        num_arenas=40,
    )


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
    # the same obstacles; a larger team has other starts
    _in_turn(
        "lidar-32",
        _LIDAR,
        digest="5730b519276ca599e928fbace3029a8d60386fe8d838e1fcfd82612cfb065caf",
    ),
    _in_turn(
        "radio-32",
        _RADIO,
        digest="5730b519276ca599e928fbace3029a8d60386fe8d838e1fcfd82612cfb065caf",
    ),
    _in_turn(
        "mixed-team-32",
        _MIXED_TEAM,
        digest="5730b519276ca599e928fbace3029a8d60386fe8d838e1fcfd82612cfb065caf",
    ),
    _in_turn(
        "faulty-32",
        _FAULTY,
        digest="87d0023295ee4182a46f14d6b48ad78af1010beac91aa49e8d0765bd15def662",
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
