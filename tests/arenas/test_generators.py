"""Rooms, mazes, caves and corridors: pure, connected, and what their names promise."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from marl_explore.arenas import Caves, Corridors, Mazes, Mixed, Rooms, Uniform, UniformV2
from marl_explore.config.arena import ArenaConfig
from tests.helpers import oracle
from tests.helpers.drawing import cells, drawn

KINDS = (Uniform, UniformV2, Rooms, Mazes, Caves, Corridors)


def config(height, width=None, robots=4):
    return ArenaConfig(height=height, width=width or height, num_agents=robots)


@settings(max_examples=60, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    starts=st.sampled_from(["scattered", "clustered"]),
    height=st.integers(8, 26),
    width=st.integers(8, 26),
    seed=st.integers(0, 10**6),
)
def test_arenas_of_any_size_are_connected_with_robots_on_distinct_free_cells(
    kind, starts, height, width, seed
):
    generate = kind(config(height, width), starts=starts)
    for arena, positions in zip(*drawn(generate, 2, seed), strict=True):
        assert arena.shape == (height, width)
        assert oracle.connected(arena.tolist())
        assert len(cells(positions)) == 4
        assert not any(arena[cell] for cell in cells(positions))


@pytest.mark.parametrize("starts", ["scattered", "clustered"])
@pytest.mark.parametrize("kind", KINDS)
def test_an_arena_is_a_function_of_seed_index_and_episode_alone(kind, starts):
    generate = kind(config(24), starts=starts)
    arenas, episodes = torch.arange(30) + 5, torch.arange(30) % 4
    together = generate(7, arenas, episodes)
    order = torch.arange(29, -1, -1)
    parts = [generate(7, arenas[some], episodes[some]) for some in order.split((1, 12, 17))]
    for whole, part in zip(together, map(torch.cat, zip(*parts, strict=True)), strict=True):
        assert torch.equal(part, whole[order])
    again = pickle.loads(pickle.dumps(generate))(7, arenas, episodes)
    assert torch.equal(again[0], together[0])
    for change in ((8, arenas, episodes), (7, arenas + 30, episodes), (7, arenas, episodes + 4)):
        assert (generate(*change)[0] != together[0]).flatten(1).any(1).all()


@pytest.mark.parametrize("kind", KINDS)
def test_obstacles_depend_neither_on_robots_nor_on_starts(kind):
    few = drawn(kind(config(24, robots=1)))[0]
    many = drawn(kind(config(24, robots=9), starts="clustered"))[0]
    assert torch.equal(few, many)


@pytest.mark.parametrize("kind", [Rooms, Mazes])
@pytest.mark.parametrize("size", [(17, 32), (23, 20)])
def test_two_robots_can_pass_each_other_everywhere(kind, size):
    """Every free cell lies in a free square of 2 x 2 cells."""
    obstacles, _ = drawn(kind(config(*size)), 40)
    free = ~obstacles.numpy()
    square = np.zeros((1, 2, 2)) + 1
    assert np.array_equal(ndimage.binary_opening(free, square), free)


def test_rooms_are_rectangles_of_5_to_10_cells_a_side(monkeypatch):
    monkeypatch.setattr("marl_explore.arenas.rooms._open_doors", lambda *_: None)
    monkeypatch.setattr("marl_explore.arenas.rooms.Rooms.positions", lambda *_: None)
    obstacles, _ = drawn(Rooms(config(32)), 50)
    counts = []
    for arena in obstacles.numpy():
        rooms, count = ndimage.label(~arena)
        counts.append(count)
        for number, place in enumerate(ndimage.find_objects(rooms), 1):
            assert (rooms[place] == number).all()
            assert all(5 <= side <= 10 for side in rooms[place].shape)
    assert 9 <= min(counts) < max(counts) <= 25


def test_mazes_are_trees_with_some_loops():
    obstacles, _ = drawn(Mazes(config(32)), 100)
    free = ~obstacles
    assert free[:, ::3, ::3].all()  # a cell of the maze every three cells
    assert not free[:, 2::3, 2::3].any()  # posts between them
    doors = free[:, 2::3, ::3].sum((1, 2)) + free[:, ::3, 2::3].sum((1, 2))
    cells_of_maze, walls = 11 * 11, 2 * 10 * 11
    loops = doors - (cells_of_maze - 1)
    assert loops.min() > 0
    assert loops.float().mean() == pytest.approx((walls - cells_of_maze + 1) / 8, rel=0.1)


def test_mazes_wind():
    """Depth-first mazes have long ways: far longer than the straight one."""
    obstacles, _ = drawn(Mazes(config(32)), 10)
    longest = []
    for arena in obstacles.tolist():
        free = oracle.free_cells(arena)
        longest.append(max(oracle.distances(free, arena, (0, 0)).values()))
    assert np.mean(longest) > 60


def test_caves_are_large_and_smooth():
    obstacles, _ = drawn(Caves(config(48)), 50)
    assert (~obstacles).float().mean((1, 2)).min() >= 0.35
    same = (obstacles[:, 1:] == obstacles[:, :-1]).float().mean()
    assert same > 0.85  # two cells out of three differ in noise of this density
    assert obstacles.float().mean((1, 2)).std() > 0.02


def test_caves_that_cannot_be_are_named(monkeypatch):
    monkeypatch.setattr("marl_explore.arenas.generator.MAX_ATTEMPTS", 3)
    with pytest.raises(ValueError, match=r"35 % free: no arena of 3 x 3 cells .* 3 attempts"):
        drawn(Caves(config(3, robots=1)))


def test_corridors_run_from_side_to_side():
    obstacles, _ = drawn(Corridors(config(24)), 60)
    upright = 0
    for arena in obstacles:
        rows, columns = ((~arena).all(side) for side in (1, 0))
        pairs = [(line[1:] & line[:-1]).sum() for line in (rows, columns)]
        assert max(pairs) >= 3  # three corridors, two cells wide
        upright += int(pairs[1] > pairs[0])
    assert 15 < upright < 45


def test_more_robots_than_free_cells_are_refused():
    with pytest.raises(ValueError, match=r"num_agents=500 .* only 4\d\d free cells"):
        drawn(Mazes(config(24, robots=500)))


def test_unknown_rules_of_starts_are_refused():
    with pytest.raises(ValueError, match="starts='near' is unknown.*clustered"):
        Rooms(ArenaConfig(), starts="near")


def test_mixed_arenas_are_of_every_kind_in_turn():
    task = config(24)
    obstacles, positions = drawn(Mixed(task), 12)
    alone = (
        Uniform(task),
        Rooms(task, "clustered"),
        None,
        Mazes(task, "clustered"),
        Corridors(task),
        Caves(task, "clustered"),
    )
    for number, kind in enumerate(alone):
        if kind is not None:
            of_kind = (obstacles[number::6], positions[number::6])
            for mixed, whole in zip(of_kind, drawn(kind, 12), strict=True):
                assert torch.equal(mixed, whole[number::6])


@pytest.mark.parametrize("size", [(24, 24), (13, 8)])
def test_the_third_of_the_mixed_arenas_lies_in_a_corner(size):
    obstacles, positions = drawn(Mixed(config(*size)), 20)
    height, width = (-(-side // 2) for side in size)
    corner = ArenaConfig(height=height, width=width)
    for arena, robots in zip(obstacles[2::6], positions[2::6], strict=True):
        assert arena[height:].all()
        assert arena[:, width:].all()
        assert arena[:height, :width].sum() == corner.num_obstacles
        assert oracle.connected(arena[:height, :width].tolist())
        assert len(cells(robots)) == 4
        assert not any(arena[cell] for cell in cells(robots))
