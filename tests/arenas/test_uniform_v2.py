"""Uniform arenas of any density: the first draw, with the largest part grown to its number."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from marl_explore import ExplorationEnv
from marl_explore.arenas import Uniform, UniformV2, resolve
from marl_explore.arenas.uniform import scatter
from marl_explore.config.arena import ArenaConfig
from tests.arenas.test_uniform import combined, signed
from tests.helpers import oracle
from tests.helpers.drawing import cells, drawn
from tests.helpers.strategies import repeatable


def drawn_slowly(config, seed, arena, episode):
    """Obstacles of one arena by plain Python."""
    key = combined(seed, arena, episode)
    places = [(row, column) for row in range(config.height) for column in range(config.width)]
    number = {cell: signed(combined(key, 0, 0, n)) for n, cell in enumerate(places)}
    by_number = sorted(places, key=number.get, reverse=True)
    free = set(by_number[: config.num_cells - config.num_obstacles])
    size, parts, rest = len(free), [], [cell for cell in places if cell in free]
    while rest:  # the first in row order is the first of its part
        parts.append(part_of(rest[0], free))
        rest = [cell for cell in rest if cell not in parts[-1]]
    part = max(parts, key=len)
    while len(part) < size:
        part.add(next(cell for cell in by_number if cell not in part and beside(cell) & part))
    return [
        [(row, column) not in part for column in range(config.width)]
        for row in range(config.height)
    ]


def beside(cell):
    return {oracle.shifted(cell, direction) for direction in oracle.FOUR}


def part_of(cell, free):
    """The free cells that straight moves join with a cell."""
    found, stack = {cell}, [cell]
    while stack:
        new = (beside(stack.pop()) & free) - found
        found |= new
        stack += new
    return found


@st.composite
def configs(draw):
    """Sizes down to one row, any density, and as many robots as there is room for, or fewer."""
    height, width = draw(st.integers(1, 12)), draw(st.integers(1, 12))
    size = height * width
    obstacles = draw(st.integers(0, size - 1))
    robots = draw(st.sampled_from((1, size - obstacles)) | st.integers(1, size - obstacles))
    return ArenaConfig(
        height=height, width=width, obstacle_density=obstacles / size, num_agents=robots
    )


@repeatable(max_examples=200)
@given(
    config=configs(),
    starts=st.sampled_from(["scattered", "clustered"]),
    seed=st.integers(0, 10**6),
)
def test_arenas_are_those_of_the_slow_generator_and_need_one_draw_at_any_density(
    config, starts, seed
):
    arenas, episodes = torch.arange(3) + 5, torch.arange(3)
    obstacles, positions = UniformV2(config, starts)(seed, arenas, episodes)
    for number, (arena, robots) in enumerate(zip(obstacles.tolist(), positions, strict=True)):
        assert arena == drawn_slowly(config, seed, 5 + number, number)
        assert sum(map(sum, arena)) == config.num_obstacles
        assert oracle.connected(arena)
        assert len(cells(robots)) == config.num_agents
        assert not any(arena[row][column] for row, column in cells(robots))


@repeatable(max_examples=30)
@given(config=configs(), order=st.permutations(range(12)), cut=st.integers(1, 11))
def test_an_arena_does_not_depend_on_those_drawn_with_it(config, order, cut):
    generate, arenas = UniformV2(config), torch.tensor(order)
    whole = drawn(generate, 12)
    parts = [generate(0, some, torch.zeros_like(some)) for some in (arenas[:cut], arenas[cut:])]
    for together, part in zip(whole, map(torch.cat, zip(*parts, strict=True)), strict=True):
        assert torch.equal(part, together[arenas])


def test_where_uniform_needs_one_draw_the_arena_is_the_same():
    config = ArenaConfig(obstacle_density=0.2)
    old, new = drawn(Uniform(config), 400), drawn(UniformV2(config), 400)
    once = [oracle.connected(arena.tolist()) for arena in first_draw(config, 400)]
    same = (old[0] == new[0]).flatten(1).all(1)
    assert same.tolist() == once
    assert 0 < sum(once) < 400
    assert torch.equal(old[1][same], new[1][same])


def first_draw(config, count):
    """Obstacles bool [A, H, W] of the first arenas, connected or not."""
    numbers = [
        [signed(combined(combined(0, arena, 0), 0, 0, cell)) for cell in range(config.num_cells)]
        for arena in range(count)
    ]
    return scatter(torch.tensor(numbers), config)


def test_obstacles_are_spread_evenly_except_in_the_corners():
    obstacles, _ = drawn(UniformV2(ArenaConfig(num_agents=1)), 4000)
    share = obstacles.float().mean(0)
    assert share.mean() == pytest.approx(14 / 144)
    corners = torch.zeros(12, 12, dtype=torch.bool)
    corners[::11, ::11] = True
    assert (share - 14 / 144).abs()[~corners].max() < 0.02  # four standard deviations
    assert 0.1 < share[corners].mean() < 0.115  # a cell that two obstacles cut off is filled


def test_dense_arenas_are_denser_at_the_edge_and_their_free_cells_anywhere():
    obstacles, _ = drawn(UniformV2(ArenaConfig(obstacle_density=0.5, num_agents=1)), 2000)
    share = obstacles.float().mean(0)
    assert share.mean() == pytest.approx(0.5)
    assert share[4:8, 4:8].mean() + 0.1 < share[0].mean() < 0.75
    for turned in (share.flip(0), share.flip(1), share.T):
        assert (share - turned).abs().max() < 0.08  # no side is preferred


@pytest.mark.parametrize("density", [0.1, 0.4, 0.6, 0.95])
def test_large_arenas_of_any_density_have_their_number_of_obstacles(density):
    config = ArenaConfig(height=200, width=170, obstacle_density=density)
    obstacles, _ = drawn(UniformV2(config), 2)
    assert obstacles.sum((1, 2)).tolist() == [config.num_obstacles] * 2
    assert all(map(oracle.connected, obstacles.tolist()))


def test_environments_know_it_by_name_in_any_size():
    config = ArenaConfig(height=9, width=14, obstacle_density=0.45)
    start = ExplorationEnv(config, num_envs=3, arenas="uniform-v2").reset()
    assert start["obstacles"].sum((1, 2)).tolist() == [config.num_obstacles] * 3
    assert isinstance(resolve("uniform-v2", config), UniformV2)


def test_robots_that_have_no_room_are_refused_with_the_bound():
    full = ArenaConfig(height=1, width=7, obstacle_density=3 / 7, num_agents=4)
    (obstacles,), (robots,) = drawn(UniformV2(full), 1)
    assert len(cells(robots)) == int((~obstacles).sum()) == 4
    with pytest.raises(ValueError, match=r"num_agents=5 .* 1 x 7 .* at most 4"):
        replace(full, num_agents=5)
