"""Random episodes of the wider world, which the rules and the slow oracle both can play."""

from __future__ import annotations

import math
import random
from dataclasses import asdict, dataclass

import torch
from hypothesis import strategies as st
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from tests.helpers import world_oracle as slow

SENSING_RANGES = (1.1, 1.5, 2.0, 3.5)
RADIO_RANGES = (0.0, 1.0, 2.0, 4.0, math.inf)
ACTIONS = 10
COMMUNICATE = 9


@dataclass(frozen=True)
class WideEpisode:
    """One arena at its start, and the actions of every step, [T][N]."""

    obstacles: list[list[bool]]
    positions: list[tuple[int, int]]
    draw_key: int
    alive: list[bool]
    actions: list[list[int]]


@dataclass(frozen=True)
class WideScenario:
    """Equally long episodes of one setting."""

    config: ArenaConfig
    episodes: list[WideEpisode]

    @property
    def settings(self) -> slow.Settings:
        """The same for the oracle."""
        names = slow.Settings.__dataclass_fields__
        values = {name: value for name, value in asdict(self.config).items() if name in names}
        return slow.Settings(**values)

    def start(self) -> dict[str, Tensor]:
        """The arguments of ``core.world.start``."""
        return {
            "obstacles": torch.tensor([episode.obstacles for episode in self.episodes]),
            "position": torch.tensor([episode.positions for episode in self.episodes]),
            "draw_key": torch.tensor([[episode.draw_key] for episode in self.episodes]),
            "alive": torch.tensor([episode.alive for episode in self.episodes]),
        }

    def worlds(self) -> list[slow.World]:
        """The oracle's worlds at the start."""
        return [
            slow.World(self.settings, e.obstacles, e.positions, e.draw_key, alive=list(e.alive))
            for e in self.episodes
        ]

    @property
    def actions(self) -> Tensor:
        """Int64 [T, B, N]."""
        return torch.tensor([episode.actions for episode in self.episodes]).transpose(0, 1)


def each_or_all(draw, entry, robots):
    """A setting for all robots, or one per robot."""
    if draw(st.booleans()):
        return draw(entry)
    return tuple(draw(entry) for _ in range(robots))


@st.composite
def wide_scenarios(draw, max_side: int = 30, max_robots: int = 8, max_steps: int = 12):
    """A batch of episodes of one setting, with every part of the wider world on or off."""
    robots = draw(st.integers(1, max_robots))
    config = ArenaConfig(
        height=draw(st.integers(4, max_side)),
        width=draw(st.integers(4, max_side)),
        obstacle_density=0.0,
        num_agents=robots,
        sensing_range=each_or_all(draw, st.sampled_from(SENSING_RANGES), robots),
        sensing_shape=draw(st.sampled_from(("square", "disc"))),
        line_of_sight=draw(st.booleans()),
        communication_range=each_or_all(draw, st.sampled_from(RADIO_RANGES), robots),
        wall_loss_db=draw(st.sampled_from((0.0, 0.01, 3.0, 6.0, math.inf))),
        path_loss_exponent=draw(st.sampled_from((2.0, 2.5, 4.0))),
        shadowing_db=draw(st.sampled_from((0.0, 0.0, 4.0, 12.0))),
        message_loss=draw(st.sampled_from((0.0, 0.3, 1.0))),
        move_period=each_or_all(draw, st.integers(1, 3), robots),
        failure_rate=draw(st.sampled_from((0.0, 0.05, 0.3, 1.0))),
        num_walkers=draw(st.integers(0, 3)),
    )
    steps = draw(st.integers(1, max_steps))
    episodes = [draw(_episodes(config, steps)) for _ in range(draw(st.integers(1, 3)))]
    return WideScenario(config, episodes)


@st.composite
def _episodes(draw, config: ArenaConfig, steps: int) -> WideEpisode:
    # one seed instead of a draw per cell
    chance = random.Random(draw(st.integers(0, 2**31)))
    density = draw(st.integers(0, 45)) / 100
    cells = [(r, c) for r in range(config.height) for c in range(config.width)]
    middle = chance.choice(cells)
    near = sorted(cells, key=lambda cell: math.dist(cell, middle) + 3 * chance.random())
    order = near if draw(st.booleans()) else chance.sample(cells, len(cells))
    positions = order[: config.num_agents]
    reserved = {*positions, *order[config.num_agents : config.num_agents + config.num_walkers]}
    obstacles = [
        [(r, c) not in reserved and chance.random() < density for c in range(config.width)]
        for r in range(config.height)
    ]
    some_fail = draw(st.integers(0, 3)) == 0
    alive = [not some_fail or chance.random() < 0.7 for _ in positions]
    talks = draw(st.sampled_from((0.1, 0.5, 0.9)))
    actions = [
        [COMMUNICATE if chance.random() < talks else chance.randrange(ACTIONS) for _ in positions]
        for _ in range(steps)
    ]
    return WideEpisode(obstacles, positions, draw(st.integers(-(2**63), 2**63 - 1)), alive, actions)
