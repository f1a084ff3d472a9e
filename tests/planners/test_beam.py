"""The joint beam search against trying everything."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest
import torch

from marl_explore import ArenaConfig
from marl_explore.config.shapes import Sight
from marl_explore.core import native
from marl_explore.core.grid import STAY, flat_cell
from marl_explore.core.native import BACKENDS
from marl_explore.core.wavefront import path_distances
from marl_explore.planners import BeamSearch
from tests.helpers import oracle, world_oracle
from tests.helpers.boards import map_cells

NEAR = Sight.square(1)
EVERYTHING = 9**4
"""Plans of two robots in two steps, or of one robot in four."""


def best_first_moves(search, unknown, occupied, positions, robots, sees=lambda *_: SQUARE):
    """First moves of all plans of the highest value, by the definition in ``BeamSearch``."""
    blocked = [[bool(cell) for cell in row] for row in occupied.tolist()]
    free = [[not cell for cell in row] for row in blocked]
    cells = [(r, c) for r in range(len(free)) for c in range(len(free[0]))]
    away = {cell: oracle.distances(free, blocked, cell) for cell in cells if free[cell[0]][cell[1]]}
    values = {}
    for plan in product(product(range(9), repeat=robots), repeat=search.horizon):
        value = plan_value(search, unknown, free, blocked, positions, plan, away, sees)
        if value is not None:
            values.setdefault(round(value, 4), set()).add(plan[0])
    return values[max(values)]


SQUARE = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)]


def plan_value(search, unknown, free, blocked, positions, plan, away, sees):
    left = {cell for cell, hidden in cells_of(unknown) if hidden}
    here, seen, weight = [tuple(p) for p in positions], 0.0, 1.0
    for step, moves in enumerate(plan):
        before = list(here)
        for robot, move in enumerate(moves):
            if move == STAY:
                continue
            target = oracle.shifted(here[robot], oracle.COMPASS[move])
            others = [other for other in range(len(here)) if other != robot]
            if not oracle.may_move(free, blocked, here[robot], oracle.COMPASS[move]):
                return None
            if any(target in (here[other], before[other]) for other in others):
                return None
            ways = [middle(before[other], here[other]) for other in others]
            if middle(before[robot], target) in ways:
                return None
            here[robot] = target
            in_view = sees(robot, target)
            new = {cell for cell in left if (cell[0] - target[0], cell[1] - target[1]) in in_view}
            seen += weight * len(new)
            if step == len(plan) - 1 and robot == len(moves) - 1:
                # the last move is valued with the cells it sees one move away
                far = sum(min(away[p].get(cell, 255) for p in here) for cell in left)
                return seen - weight * search.distance_weight * (far - len(new))
            left -= new
        weight *= search.discount
    far = sum(min(away[p].get(cell, 255) for p in here) for cell in left)
    return seen - weight / search.discount * search.distance_weight * far


def middle(a, b):
    return a[0] + b[0], a[1] + b[1]


def cells_of(grid):
    return [((r, c), value) for r, row in enumerate(grid.tolist()) for c, value in enumerate(row)]


BOARDS = [
    "....?\n.##.?\n...??",
    "...??\n.#...\n.#..?",
    "..#??\n.##.?\n.....",
]


@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("positions", [[[0, 0]], [[2, 0]]])
def test_one_robot_finds_the_best_of_all_plans(board, positions):
    search = BeamSearch(width=EVERYTHING, horizon=3)
    grid = map_cells(board)
    unknown, occupied = grid == -1, grid == 1
    best = best_first_moves(search, unknown, occupied, positions, 1)
    first, _ = search.first_moves(
        unknown[None], occupied[None], torch.tensor([positions]), torch.ones(1, 1).bool(), NEAR
    )
    assert tuple(first[0].tolist()) in best


@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("positions", [[[0, 0], [0, 1]], [[2, 0], [1, 3]]])
def test_two_robots_find_the_best_of_all_joint_plans(board, positions):
    search = BeamSearch(width=EVERYTHING, horizon=2)
    grid = map_cells(board)
    unknown, occupied = grid == -1, grid == 1
    best = best_first_moves(search, unknown, occupied, positions, 2)
    first, _ = search.first_moves(
        unknown[None], occupied[None], torch.tensor([positions]), torch.ones(1, 2).bool(), NEAR
    )
    assert tuple(first[0].tolist()) in best


LIDAR = ArenaConfig(
    height=3, width=5, num_agents=2, sensing_range=(1.0, 0.75), sensing_shape="disc"
)


@pytest.mark.parametrize("hides", [False, True])
@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("positions", [[[0, 0], [0, 1]], [[2, 0], [1, 3]]])
def test_plans_count_the_cells_that_each_robot_would_see(board, positions, hides):
    config = replace(LIDAR, line_of_sight=hides)
    settings = world_oracle.Settings(
        num_agents=2,
        sensing_range=config.sensing_range,
        sensing_shape="disc",
        line_of_sight=hides,
        height=3,
        width=5,
    )
    search = BeamSearch(width=EVERYTHING, horizon=2)
    grid = map_cells(board)
    unknown, occupied = grid == -1, grid == 1
    walls = occupied.tolist()

    def sees(robot, place):
        seen = world_oracle.seen_cells(settings, robot, walls, place)
        return {(r - place[0], c - place[1]) for r, c in seen}

    best = best_first_moves(search, unknown, occupied, positions, 2, sees)
    first, _ = search.first_moves(
        unknown[None],
        occupied[None],
        torch.tensor([positions]),
        torch.ones(1, 2).bool(),
        config.sight,
    )
    assert tuple(first[0].tolist()) in best


def test_absent_robots_neither_move_nor_block_nor_see():
    grid = map_cells("....?")
    search = BeamSearch(horizon=3)
    positions = torch.tensor([[[0, 0], [0, 1]], [[0, 0], [0, 4]]])
    present = torch.tensor([[True, False], [True, False]])
    first, fruitful = search.first_moves(
        (grid == -1).expand(2, 1, 5), (grid == 1).expand(2, 1, 5), positions, present, NEAR
    )
    assert first.tolist() == [[2, STAY], [2, STAY]]
    assert fruitful.tolist() == [True, True]


def test_a_plan_that_sees_nothing_says_so():
    grid = map_cells("......?")
    position, team = torch.tensor([[[0, 0]]]), torch.ones(1, 1).bool()
    args = ((grid == -1)[None], (grid == 1)[None], position, team, NEAR)
    assert not BeamSearch(horizon=4).first_moves(*args)[1].any()
    assert BeamSearch(horizon=5).first_moves(*args)[1].all()


SIGHTS = {
    "square": Sight.square(1),
    "disc": Sight("disc", (3.0,)),
    "lidars": Sight("disc", (1.5, 3.0, 2.0, 2.0), line_of_sight=True),
}


@pytest.mark.skipif(native.missing("beam values") is not None, reason="the C kernel was not built")
@pytest.mark.parametrize("sight", SIGHTS.values(), ids=SIGHTS)
@pytest.mark.parametrize("seed", range(3))
def test_backends_make_equal_plans(sight, seed):
    chance = torch.Generator().manual_seed(seed)
    grid = torch.randint(-1, 2, (9, 11, 14), generator=chance)
    grid[torch.rand(grid.shape, generator=chance) < 0.4] = -1
    cells = torch.stack([torch.randperm(154, generator=chance)[:4] for _ in grid])
    present = torch.rand(9, 4, generator=chance) < 0.8
    grid.view(9, -1).scatter_(1, cells, 0)
    given = (grid == -1, grid == 1, torch.stack((cells // 14, cells % 14), -1), present, sight)
    torch_plans, c_plans = (
        BeamSearch(horizon=6, backend=backend).first_moves(*given) for backend in BACKENDS[1:]
    )
    for one, other in zip(torch_plans, c_plans, strict=True):
        assert one.equal(other)


def test_problems_are_solved_alone_as_in_a_batch():
    generator = torch.Generator().manual_seed(0)
    grid = torch.randint(-1, 2, (5, 6, 7), generator=generator)
    position = torch.randint(0, 6, (5, 3, 2), generator=generator)
    rows = torch.arange(5).unsqueeze(-1)
    grid[rows, position[..., 0], position[..., 1]] = 0
    present = torch.rand(5, 3, generator=generator) < 0.8
    search = BeamSearch(width=6, horizon=4)
    first, _ = search.first_moves(grid == -1, grid == 1, position, present, NEAR)
    for i in range(5):
        alone, _ = search.first_moves(
            grid[i : i + 1] == -1,
            grid[i : i + 1] == 1,
            position[i : i + 1],
            present[i : i + 1],
            NEAR,
        )
        assert alone[0].equal(first[i])


def test_path_distances_agree_with_the_reference():
    generator = torch.Generator().manual_seed(3)
    free = torch.rand(6, 5, 7, generator=generator) < 0.7
    cells = torch.stack([torch.randperm(35, generator=generator)[:20] for _ in free])
    distance = path_distances(free, cells)
    for board, targets, found in zip(free, cells, distance, strict=True):
        blocked = (~board).tolist()
        for start, is_free in cells_of(board):
            expected = oracle.distances(board.tolist(), blocked, start) if is_free else {}
            row = found[flat_cell(torch.tensor(start), 7)].tolist()
            places = [divmod(cell, 7) for cell in targets.tolist()]
            assert row == [expected.get(place, 255) for place in places]


def test_long_distances_count_as_the_longest():
    distance = path_distances(
        torch.ones(1, 1, 12, dtype=torch.bool), torch.arange(12)[None], longest=5
    )
    assert distance[0, 0].tolist() == [0, 1, 2, 3, 4, 5, 5, 5, 5, 5, 5, 5]
