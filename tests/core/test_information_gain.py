"""What directions offer a robot of a team: against slow loops on real episodes, and by hand."""

from __future__ import annotations

from functools import partial

import torch
from hypothesis import given

from marl_explore.config.shapes import Sight
from marl_explore.core.frontier import paths
from marl_explore.core.information_gain import step_gains, territory_table
from marl_explore.core.links import within_range
from marl_explore.core.sensing import unknown_around
from marl_explore.core.world import advance, start
from tests.helpers import oracle, world_oracle
from tests.helpers.boards import known_map
from tests.helpers.strategies import repeatable, scenarios
from tests.helpers.wide_worlds import wide_scenarios


def unknown_in_square(map_, cell, radius):
    """Unknown cells of the arena in the square around a cell."""
    square = [
        (cell[0] + row, cell[1] + column)
        for row in range(-radius, radius + 1)
        for column in range(-radius, radius + 1)
    ]
    return sum(oracle.inside(map_, c) and map_[c[0]][c[1]] == oracle.UNKNOWN for c in square)


def share_of_square(map_, cell, radius):
    """Those cells as a share of the square."""
    return unknown_in_square(map_, cell, radius) / (2 * radius + 1) ** 2


def grids(map_):
    """Where paths may go, and what closes a diagonal."""
    free = [[value == oracle.FREE for value in row] for row in map_]
    return free, [[value == oracle.OCCUPIED for value in row] for row in map_]


def slow_gains(map_, position, gain):
    free, occupied = grids(map_)
    return [
        gain(map_, oracle.shifted(position, direction))
        if oracle.may_move(free, occupied, position, direction)
        else 0
        for direction in oracle.COMPASS
    ]


def slow_territory(map_, positions, robot, near, share):
    """The table of one robot, [8][5]; ``share`` is the expected gain of a cell."""
    free, occupied = grids(map_)
    own = tuple(positions[robot])
    others = []
    for other, position in enumerate(positions):
        if other != robot and near[other]:
            others.append(oracle.distances(free, occupied, tuple(position)))
    cells = [cell for cell in oracle.frontiers(map_) if cell != own]
    reachable = oracle.distances(free, occupied, own)
    moves = dict(
        zip((c for c in cells if c in reachable), oracle.trajectories(map_, own), strict=True)
    )
    mine = {
        cell: (first, length)
        for cell, (first, length) in moves.items()
        if all(distance.get(cell, 999) >= length for distance in others)
    }
    number, nearness, value = [0] * 8, [0.0] * 8, [0.0] * 8
    for cell, (first, length) in (mine or moves).items():
        number[first] += 1
        nearness[first] = max(nearness[first], 1 / length)
        value[first] = max(value[first], share(map_, cell) / length)
    columns = [
        [n / (n + 8) for n in number],
        nearness,
        value,
        [entry / (max(nearness) or 1) for entry in nearness],
        [entry / (max(value) or 1) for entry in value],
    ]
    return [*zip(*columns, strict=True)]


@repeatable(max_examples=40)
@given(scenario=scenarios())
def test_gains_and_territories_of_real_episodes_agree_with_slow_loops(scenario):
    state = start(scenario.config, scenario.obstacles, scenario.positions)
    for action in scenario.actions:
        state, _ = advance(scenario.config, state, action)
    radius = scenario.config.fov_radius
    reach = within_range(state.position, scenario.config.communication_cells)
    gains = step_gains(state.map, state.position, Sight.square(radius)).tolist()
    tables = territory_table(state.map, state.position, reach, Sight.square(radius))
    for b, (maps, positions) in enumerate(
        zip(state.map.tolist(), state.position.tolist(), strict=True)
    ):
        for i, map_ in enumerate(maps):
            gain = partial(unknown_in_square, radius=radius)
            assert gains[b][i] == slow_gains(map_, tuple(positions[i]), gain)
            share = partial(share_of_square, radius=radius)
            expected = slow_territory(map_, positions, i, reach[b, i].tolist(), share)
            torch.testing.assert_close(tables[b, i], torch.tensor(expected))


@repeatable(max_examples=60)
@given(scenario=wide_scenarios(max_side=16, max_steps=6))
def test_gains_follow_the_shape_and_the_sight_of_each_robot(scenario):
    config, settings = scenario.config, scenario.settings
    state = start(config, **scenario.start())
    for action in scenario.actions:
        state, _ = advance(config, state, action)
    gains = step_gains(state.map, state.position, config.sight).tolist()
    tables = territory_table(state.map, state.position, state.linked, config.sight)
    for b, (maps, positions, alive) in enumerate(
        zip(state.map.tolist(), state.position.tolist(), state.alive.tolist(), strict=True)
    ):
        for i, map_ in enumerate(maps):
            if not alive[i]:
                continue
            gain = partial(world_oracle.expected_discovery, settings, i)
            assert gains[b][i] == slow_gains(map_, tuple(positions[i]), gain)
            share = partial(world_oracle.expected_gain, settings, i)
            near = state.linked[b, i].tolist()
            expected = slow_territory(map_, positions, i, near, share)
            torch.testing.assert_close(tables[b, i], torch.tensor(expected))


def test_unknown_cells_around_are_those_of_the_arena():
    grid = torch.tensor([[-1, -1, 0], [-1, 0, 1]], dtype=torch.int8)
    assert unknown_around(grid, 1).tolist() == [[3, 3, 1], [3, 3, 1]]
    assert (unknown_around(grid, 3) == 3).all()


def territory(board, *others, reach=True):
    """Table [8, 5] of the robot ``@`` on a drawn map, beside robots at these cells."""
    grid, own = known_map(board)
    position = torch.stack((own, *map(torch.tensor, others)))
    near = torch.full((len(position), len(position)), reach) | torch.eye(len(position)).bool()
    return territory_table(grid.expand(len(position), -1, -1), position, near, Sight.square(1))[0]


CORRIDOR = "?..@..?"
EAST, WEST = 2, 6


def test_of_two_frontiers_the_other_robot_takes_the_nearer_one():
    alone = territory(CORRIDOR)
    torch.testing.assert_close(alone[EAST], torch.tensor([1 / 9, 1 / 2, 1 / 9 / 2, 1, 1]))
    torch.testing.assert_close(alone[WEST], alone[EAST])
    beside = territory(CORRIDOR, (0, 4))
    assert (beside[EAST] == 0).all()
    assert torch.equal(beside[WEST], alone[WEST])


def test_a_robot_out_of_range_takes_nothing():
    assert torch.equal(territory(CORRIDOR, (0, 4), reach=False), territory(CORRIDOR))


def test_equally_near_robots_both_keep_a_frontier():
    board = "@.?..\n....."  # frontiers in the second, third and fourth columns
    torch.testing.assert_close(territory(board)[:, 0].sum(), torch.tensor(3 / 11))
    torch.testing.assert_close(territory(board, (0, 4))[:, 0].sum(), torch.tensor(2 / 10))


def test_a_robot_where_the_map_knows_nothing_still_counts():
    corridor = "?.@....??"
    assert territory(corridor)[EAST, 0] > 0
    assert (territory(corridor, (0, 7))[EAST] == 0).all()


def test_a_robot_that_is_left_with_no_frontier_looks_at_all():
    corridor = "#@....??"
    assert torch.equal(territory(corridor, (0, 4)), territory(corridor))


def test_directions_are_told_apart_however_far_the_frontiers_are():
    table = territory("?........................@.............................?")
    torch.testing.assert_close(table[WEST, 3:], torch.ones(2))
    torch.testing.assert_close(table[EAST, 3:], torch.full((2,), 24 / 29))


def test_moves_that_are_known_to_be_blocked_gain_nothing():
    grid, position = known_map("?????\n??#.?\n?#@.?\n??..?\n?????")
    gains = dict(enumerate(step_gains(grid, position, Sight.square(1)).tolist()))
    assert gains[7] == 0  # north-west lies unknown behind two occupied cells
    assert gains[0] == gains[6] == 0
    assert gains[1] == 5
    direction, length = paths(grid, position)
    assert length[1, 3] == 1
    assert direction[1, 3] == 1
