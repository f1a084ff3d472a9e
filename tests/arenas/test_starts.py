"""Start cells: scattered over the arena, or the nearest ones around a cell."""

from __future__ import annotations

import pytest
import torch

from marl_explore.arenas import Mazes
from marl_explore.arenas.components import largest_component
from marl_explore.arenas.starts import clustered, scattered
from marl_explore.config.arena import ArenaConfig
from marl_explore.core.hashing import combine
from tests.helpers import boards, oracle
from tests.helpers.drawing import cells, drawn


def order(numbers):
    return torch.tensor([numbers])


def free(board):
    return ~boards.arena(board)[0].unsqueeze(0)


def test_scattered_takes_the_free_cells_with_the_smallest_numbers():
    numbers = order([5, 1, -3, 9, 2, 4])
    assert scattered(numbers, free(".#. ..."), 3).tolist() == [[[0, 2], [1, 1], [1, 2]]]


def test_clustered_takes_the_cells_around_the_smallest_number():
    numbers = order([7, 6, 5, 0, 4, 3, 1])
    assert cells(clustered(numbers, free("......."), 3)[0]) == {(0, 2), (0, 3), (0, 4)}


def test_clustered_breaks_ties_by_number():
    numbers = order([7, 6, 9, 0, 8, 3, 1])
    assert cells(clustered(numbers, free("......."), 2)[0]) == {(0, 3), (0, 4)}


def test_clustered_counts_the_way_and_not_the_distance():
    board = """
        0#...
        .#.#.
        .#.#.
        ...#.
    """
    numbers = torch.arange(20).unsqueeze(0)  # the smallest is the corner at the top left
    assert cells(clustered(numbers, free(board), 5)[0]) == {(0, 0), (1, 0), (2, 0), (3, 0), (3, 1)}


@pytest.mark.parametrize("robots", [1, 2, 7])
def test_clustered_starts_are_the_cells_nearest_to_one_of_them(robots):
    config = ArenaConfig(height=20, width=20, num_agents=robots)
    obstacles, positions = drawn(Mazes(config, starts="clustered"), 30)
    for arena, starts in zip(obstacles.tolist(), positions, strict=True):
        team = cells(starts)
        assert len(team) == robots
        assert any(nearest(arena, center, team) for center in team)


def nearest(arena, center, team):
    """Whether no cell outside the team is nearer to the center than one inside."""
    distance = oracle.distances(oracle.free_cells(arena), arena, center)
    outside = [steps for cell, steps in distance.items() if cell not in team]
    return max(distance[cell] for cell in team) <= min(outside)


def test_any_robot_may_start_in_the_middle_of_a_cluster():
    numbers = combine(torch.arange(300).unsqueeze(-1), torch.arange(7))
    positions = clustered(numbers, free(".......").expand(300, 1, 7), 3)
    middle = numbers.argmin(-1, keepdim=True)
    robot = (positions[..., 1] == middle).long().argmax(-1)
    assert torch.bincount(robot).tolist() == pytest.approx([100, 100, 100], abs=30)


def test_legal_moves_join_what_the_largest_component_joins():
    board = """
        ..#.
        .#..
        #...
    """
    parts = largest_component(free(board))
    assert parts.int().tolist() == [[[0, 0, 0, 1], [0, 0, 1, 1], [0, 1, 1, 1]]]


def test_components_do_not_reach_into_other_arenas_and_the_first_of_equals_counts():
    both = torch.cat((free("..#. ####"), free("#### .#.#"), free("#### ####")))
    parts = largest_component(both).int().tolist()
    assert parts == [
        [[1, 1, 0, 0], [0, 0, 0, 0]],
        [[0, 0, 0, 0], [1, 0, 0, 0]],
        [[0, 0, 0, 0], [0, 0, 0, 0]],
    ]
