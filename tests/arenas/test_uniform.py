"""Uniform arenas: a pure function of (stream, seed, arena, episode)."""

from __future__ import annotations

import pytest
import torch

from marl_explore.arenas.uniform import Uniform
from marl_explore.config.arena import ArenaConfig
from tests.helpers import oracle

MASK = (1 << 64) - 1


def signed(x):
    return x - (1 << 64) if x >> 63 else x


def splitmix(x):
    x = (x + 0x9E3779B97F4A7C15) & MASK
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & MASK
    return x ^ (x >> 31)


def combined(*parts):
    result = 0
    for part in parts:
        result = splitmix(result ^ (part & MASK))
    return result


def drawn_slowly(config, seed, arena, episode):
    """One arena by plain Python: the smallest keys are obstacles, then starts."""
    key = combined(seed, arena, episode)
    cells = range(config.num_cells)
    for attempt in range(1000):
        order = sorted(cells, key=lambda cell: signed(combined(key, 0, attempt, cell)))
        blocked = set(order[: config.num_obstacles])
        obstacles = [
            [row * config.width + column in blocked for column in range(config.width)]
            for row in range(config.height)
        ]
        if oracle.connected(obstacles):
            break
    free = [cell for cell in cells if cell not in blocked]
    starts = sorted(free, key=lambda cell: signed(combined(key, 1, cell)))[: config.num_agents]
    return obstacles, [divmod(cell, config.width) for cell in starts]


@pytest.mark.parametrize(
    "config",
    [ArenaConfig(), ArenaConfig(height=5, width=9, obstacle_density=0.35, num_agents=6)],
    ids=["paper", "dense"],
)
def test_arenas_are_those_of_the_slow_generator(config):
    arenas = torch.arange(40) + 7
    episodes = torch.arange(40) % 3
    obstacles, positions = Uniform(config)(-5, arenas, episodes)
    for row, (arena, episode) in enumerate(zip(arenas.tolist(), episodes.tolist(), strict=True)):
        expected_obstacles, expected_positions = drawn_slowly(config, -5, arena, episode)
        assert obstacles[row].tolist() == expected_obstacles
        assert [tuple(p) for p in positions[row].tolist()] == expected_positions


def test_arenas_have_the_density_and_are_connected_with_robots_on_distinct_free_cells():
    config = ArenaConfig(height=10, width=15, obstacle_density=0.3, num_agents=5)
    obstacles, positions = Uniform(config)(3, torch.arange(64), torch.zeros(64, dtype=torch.int64))
    assert (obstacles.sum((1, 2)) == config.num_obstacles).all()
    for arena, starts in zip(obstacles.tolist(), positions.tolist(), strict=True):
        assert oracle.connected(arena)
        assert len({tuple(p) for p in starts}) == 5
        assert not any(arena[r][c] for r, c in starts)


def test_one_arena_does_not_depend_on_the_others_drawn_with_it():
    generate = Uniform(ArenaConfig(obstacle_density=0.3))
    together = generate(1, torch.arange(100), torch.full((100,), 4))
    alone = generate(1, torch.tensor([57]), torch.tensor([4]))
    assert torch.equal(together[0][57], alone[0][0])
    assert torch.equal(together[1][57], alone[1][0])


def test_obstacles_are_spread_evenly():
    generate = Uniform(ArenaConfig(num_agents=1))
    obstacles, positions = generate(0, torch.arange(4000), torch.zeros(4000, dtype=torch.int64))
    share = obstacles.float().mean(0)
    assert share.mean() == pytest.approx(14 / 144)
    assert (share - 14 / 144).abs().max() < 0.03  # six standard deviations
    starts = torch.bincount(positions[:, 0, 0] * 12 + positions[:, 0, 1], minlength=144)
    assert starts.min() > 5


def test_a_density_without_connected_arenas_is_named():
    config = ArenaConfig(obstacle_density=0.9)
    with pytest.raises(ValueError, match=r"obstacle_density=0.9 .* 1000 attempts"):
        Uniform(config)(0, torch.arange(2), torch.zeros(2, dtype=torch.int64))


def test_the_last_attempt_counts(monkeypatch):
    config = ArenaConfig(obstacle_density=0.25)
    arenas = torch.arange(12)

    def drawn(attempts):
        monkeypatch.setattr("marl_explore.arenas.generator.MAX_ATTEMPTS", attempts)
        found = []
        for arena in arenas:
            try:
                Uniform(config)(0, arena.unsqueeze(0), torch.zeros(1, dtype=torch.int64))
                found.append(int(arena))
            except ValueError:
                pass
        return found

    first = [
        int(arena)
        for arena in arenas
        if oracle.connected(first_attempt(config, 0, int(arena)).tolist())
    ]
    assert first
    assert drawn(attempts=1) == first
    assert len(drawn(attempts=30)) > len(first)


def first_attempt(config, seed, arena):
    """Obstacles before any is rejected, by plain Python."""
    key = combined(seed, arena, 0)
    order = sorted(range(config.num_cells), key=lambda cell: signed(combined(key, 0, 0, cell)))
    obstacles = torch.zeros(config.num_cells, dtype=torch.bool)
    obstacles[order[: config.num_obstacles]] = True
    return obstacles.view(config.height, config.width)
