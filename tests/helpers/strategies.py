"""Hypothesis strategies: batches of random episodes that the rules and the oracle both can play."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

import torch
from hypothesis import assume, settings
from hypothesis import strategies as st
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.shapes import Sight
from tests.helpers import oracle
from tests.helpers.boards import arena

SENSING = ((1, False), (1, True), (2, False), (3, False))
"""Radius k of the field of view, and occlusion."""
COMMUNICATION_CELLS = (0.0, 1.5, 2.0, 6.4, math.inf)
MAX_DENSITY_PERCENT = 45


def repeatable(max_examples: int) -> settings:
    """Settings that draw the same examples on every machine and do not time single examples."""
    return settings(deadline=None, derandomize=True, max_examples=max_examples)


SQUARES, DISCS = (2.2, 3.6, 4.95, 7.8), (1.5, 2.0, 3.2, 5.0, 7.0)
"""Ranges of sensors in cells: squares of radii 1 to 4, and discs."""


@st.composite
def sights(draw, robots: int) -> Sight:
    """The sight of a team: a shape, one range or one per robot, and whether obstacles end it."""
    shape, ranges = draw(st.sampled_from((("square", SQUARES), ("disc", DISCS))))
    reach = st.sampled_from(ranges)
    each = draw(st.tuples(reach) | st.tuples(*[reach] * robots))
    return Sight(shape, each, draw(st.booleans()))


class Board(str):
    """A drawing for ``tests.boards``, shown by failing examples so that a test can take it over."""

    def __repr__(self) -> str:
        return f'Board("""\n{self}\n""")'


@dataclass(frozen=True)
class Episode:
    """One arena, and the actions of every step, [T][N]."""

    board: Board
    actions: list[list[int]]


@dataclass(frozen=True)
class Scenario:
    """Equally long episodes of one setting: metres for the package, cells for the oracle."""

    config: ArenaConfig
    rules: oracle.Rules
    episodes: list[Episode]

    @property
    def obstacles(self) -> Tensor:
        """Bool [B, H, W]."""
        return torch.stack([arena(episode.board)[0] for episode in self.episodes])

    @property
    def positions(self) -> Tensor:
        """Int64 [B, N, 2]."""
        return torch.stack([arena(episode.board)[1] for episode in self.episodes])

    @property
    def actions(self) -> Tensor:
        """Int64 [T, B, N]."""
        return torch.tensor([episode.actions for episode in self.episodes]).transpose(0, 1)


@st.composite
def scenarios(
    draw,
    *,
    sensing: tuple[int, bool] | None = None,
    connected: bool = False,
    max_side: int = 20,
    max_steps: int = 25,
    batch: tuple[int, int] = (2, 3),
) -> Scenario:
    """A batch of episodes of one setting.

    Args:
        draw: given by hypothesis.
        sensing: field of view's radius k and occlusion; None: one of ``SENSING``.
        connected: whether legal moves join all free cells, as in the arenas of the package.
        max_side: most rows and columns.
        max_steps: most steps of an episode.
        batch: fewest and most arenas.
    """
    radius, occlusion = sensing or draw(st.sampled_from(SENSING))
    side = st.integers(4, 6) | st.integers(4, max_side)  # small arenas are mapped to the end
    rules = oracle.Rules(
        height=draw(side),
        width=draw(side),
        num_agents=draw(st.integers(1, 6)),
        fov_radius=radius,
        communication_cells=draw(st.sampled_from(COMMUNICATION_CELLS)),
        occlusion=occlusion,
    )
    cell_size = draw(st.sampled_from((0.5, 0.1, 1.0)))
    config = ArenaConfig(
        height=rules.height,
        width=rules.width,
        obstacle_density=0.0,
        num_agents=rules.num_agents,
        cell_size=cell_size,
        sensing_range=(radius + 0.5) * math.sqrt(2) * cell_size * 1.01,
        communication_range=rules.communication_cells * cell_size,
        occlusion=occlusion,
    )
    steps = draw(st.integers(1, max_steps))
    episodes = [
        Episode(draw(_boards(rules, connected)), draw(_actions(rules.num_agents, steps)))
        for _ in range(draw(st.integers(*batch)))
    ]
    return Scenario(config, rules, episodes)


@st.composite
def _boards(draw, rules: oracle.Rules, connected: bool) -> Board:
    """An arena with robots on random free cells, crowded around one of them, or in a chain."""
    # one seed instead of a draw per cell: a 20 x 20 board stays cheap
    chance = random.Random(draw(st.integers(0, 2**32 - 1)))
    cells = [(r, c) for r in range(rules.height) for c in range(rules.width)]
    percent = draw(st.integers(0, MAX_DENSITY_PERCENT))
    walls = set(chance.sample(cells, len(cells) * percent // 100))
    centre = chance.choice([cell for cell in cells if cell not in walls])
    if connected:
        obstacles = [[(r, c) in walls for c in range(rules.width)] for r in range(rules.height)]
        free = oracle.distances(oracle.free_cells(obstacles), obstacles, centre)
        walls = set(cells) - set(free)
    free = [cell for cell in cells if cell not in walls]
    assume(len(free) >= rules.num_agents)
    chance.shuffle(free)
    layout = draw(st.sampled_from(("scattered", "crowded", "chain")))
    if layout == "crowded":
        free.sort(key=lambda cell: math.dist(cell, centre))
    if layout == "chain":
        free = _chain(free, rules.communication_cells)
    robots = {cell: str(robot) for robot, cell in enumerate(free[: rules.num_agents])}
    return _drawn([robots.get(cell, "#" if cell in walls else ".") for cell in cells], rules.width)


def _chain(free: list[tuple[int, int]], reach: float) -> list[tuple[int, int]]:
    """The cells in an order in which each is in range of the one before, away from the first."""
    ordered, rest = free[:1], free[1:]
    while rest:
        near = [cell for cell in rest if math.dist(cell, ordered[-1]) <= reach] or rest
        ordered.append(max(near, key=lambda cell: math.dist(cell, ordered[0])))
        rest.remove(ordered[-1])
    return ordered


def _actions(robots: int, steps: int) -> st.SearchStrategy[list[list[int]]]:
    """Any actions, [T][N], masked ones too; communicating is frequent, alone and all together."""
    one = st.sampled_from((*range(oracle.NUM_ACTIONS), *[oracle.COMMUNICATE] * 3))
    mixed = st.lists(one, min_size=robots, max_size=robots)
    together = st.just([oracle.COMMUNICATE] * robots)
    step = st.integers(0, 5).flatmap(lambda kind: mixed if kind else together)
    return st.lists(step, min_size=steps, max_size=steps)


@st.composite
def island_maps(draw, max_side: int = 20, max_maps: int = 4) -> list[Board]:
    """Equally large maps of known patches with unknown holes, apart or touching anyhow."""
    height, width = draw(st.integers(1, max_side)), draw(st.integers(1, max_side))
    return [draw(_island_map(height, width)) for _ in range(draw(st.integers(1, max_maps)))]


@st.composite
def _island_map(draw, height: int, width: int) -> Board:
    chance = random.Random(draw(st.integers(0, 2**32 - 1)))
    cells = [(r, c) for r in range(height) for c in range(width)]
    symbols = dict.fromkeys(cells, "?")
    wall_share, hole_share = draw(st.integers(0, 45)) / 100, draw(st.integers(0, 30)) / 100
    for _ in range(draw(st.integers(0, 12))):
        (row, column), radius = chance.choice(cells), chance.randint(0, 3)
        for cell in cells:
            if abs(cell[0] - row) <= radius and abs(cell[1] - column) <= radius:
                known = "#" if chance.random() < wall_share else "."
                symbols[cell] = "?" if chance.random() < hole_share else known
    symbols[chance.choice(cells)] = "@"
    return _drawn(list(symbols.values()), width)


def _drawn(symbols: list[str], width: int) -> Board:
    rows = range(0, len(symbols), width)
    return Board("\n".join("".join(symbols[row : row + width]) for row in rows))
