"""Radio: how far two robots hear each other through walls. ``links`` decides who is linked."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import TOLERANCE
from marl_explore.core.draws import normals

NEVER_LINKED = -1
"""Largest squared distance of a pair that no distance links."""
FARTHEST = 1 << 50
"""Larger than any squared distance of two cells; stands for an infinite range."""


def most_squared(
    range_cells: float, wall_loss_db: float, path_loss_exponent: float, walls: int, loss: float
) -> int:
    """The largest squared distance at which two robots are linked (cells).

    Args:
        range_cells: the shorter of their ranges; may be infinite.
        wall_loss_db: loss per obstacle between them, L; infinite: one cuts the link.
        path_loss_exponent: n.
        walls: obstacles between them, w.
        loss: further loss of the pair (dB), X.
    """
    through = wall_loss_db * walls if walls else 0.0
    if range_cells == 0 or through == math.inf:
        return NEVER_LINKED
    if range_cells == math.inf:
        return FARTHEST
    exponent = -(through + loss) / (10 * path_loss_exponent)
    gain = math.inf if exponent > 308 else 10.0**exponent  # a larger power raises an error
    return most_squared_within(range_cells * gain)


def most_squared_within(range_cells: float) -> int:
    """The largest squared distance of two cells within a range (cells; may be infinite)."""
    reach = min(range_cells + TOLERANCE, float(FARTHEST))  # the square of more might overflow
    return math.floor(min(reach**2, FARTHEST))


def reach_table(
    range_cells: float,
    wall_loss_db: float,
    path_loss_exponent: float,
    loss: float = 0.0,
    most_walls: int = 1 << 16,
) -> tuple[int, ...]:
    """``most_squared`` for 0, 1, 2 ... walls, as far as robots can be linked.

    Robots with w > 0 walls between them are at least w + 1 cells apart, so the table ends, at the
    latest after ``most_walls``; more walls than that never link.
    """
    limits: list[int] = []
    for walls in range(most_walls + 1):
        limit = most_squared(range_cells, wall_loss_db, path_loss_exponent, walls, loss)
        if walls and limit < (walls + 1) ** 2:
            break
        limits.append(limit)
    return tuple(limits)


def _points(ahead: Tensor, most_moves: int) -> tuple[Tensor, Tensor, Tensor]:
    """The points between the ends of straight lines, one per move.

    Args:
        ahead: from start to end, int64 [*B, 2].
        most_moves: lines of more moves than this are followed only so far; T is one less.

    Returns:
        Their cells, int64 [*B, 2, T] twice, which differ where a point is halfway between two, and
        which of them there are, bool [*B, 1, T]; the others are at the start.
    """
    moves = ahead.abs().amax(-1, keepdim=True).unsqueeze(-1)  # m
    step = torch.arange(1, max(most_moves, 1), device=ahead.device)
    moved = step * ahead.unsqueeze(-1)
    length = moves.clamp_min(1)
    below = moved.div(length, rounding_mode="floor")
    rest = 2 * (moved - below * length)
    between = step < moves
    # only one coordinate can lie halfway, so its two cells are those of all low or all high
    low, high = (below + (rest > length)) * between, (below + (rest >= length)) * between
    return low, high, between


def walls_between(obstacles: Tensor, start: Tensor, end: Tensor, most_moves: int) -> Tensor:
    """Obstacles on the straight lines between pairs of cells, int64 [*B, P].

    Of each line the points between the ends count, one per move; one halfway between two cells
    counts only if both are obstacles. The number is the same from both ends.

    Args:
        obstacles: bool [*B, H, W].
        start: int64 [*B, P, 2].
        end: int64 [*B, P, 2].
        most_moves: lines of more moves than this are followed only so far.
    """
    width, flat = obstacles.shape[-1], obstacles.flatten(-2)

    def blocked(offset: Tensor) -> Tensor:
        row, column = (start.unsqueeze(-1) + offset).unbind(-2)
        cell = row * width + column
        return flat.gather(-1, cell.flatten(-2)).view(cell.shape)

    low, high, between = _points(end - start, most_moves)
    return (blocked(low) & blocked(high) & between.squeeze(-2)).sum(-1)


MOST_TABULATED = 64
"""Moves of the longest lines whose points are kept in a table: it then has 17 MB."""


@lru_cache(maxsize=16)
def _lines(most_moves: int, width: int) -> tuple[Tensor, Tensor]:
    """``_points`` of all lines of at most so many moves, as steps in a flattened grid.

    Two int64 [(2 M + 1)^2, M - 1], the lines by row and column ahead, from -M to M.
    """
    steps = torch.arange(-most_moves, most_moves + 1)
    ahead = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), -1).flatten(0, 1)
    low, high, _ = _points(ahead, most_moves)
    return low[:, 0] * width + low[:, 1], high[:, 0] * width + high[:, 1]


def walls_near(obstacles: Tensor, start: Tensor, end: Tensor, near: Tensor) -> Tensor:
    """``walls_between`` of the pairs that are near, int64 [*B, P]; 0 for the others.

    Args:
        obstacles: bool [*B, H, W].
        start: cells of robots, so no obstacles, int64 [*B, P, 2].
        end: int64 [*B, P, 2].
        near: bool [*B, P].
    """
    height, width = obstacles.shape[-2:]
    if near.device.type != "cpu":  # choosing pairs would synchronise the device
        return walls_between(obstacles, start, end, max(height, width)) * near
    chosen = near.flatten().nonzero().squeeze(-1)
    number = torch.zeros(near.shape, dtype=torch.int64)
    if not len(chosen):
        return number
    # all arenas as one tall grid
    tall = obstacles.reshape(-1, width)
    top = torch.stack((chosen // near.shape[-1] * height, torch.zeros_like(chosen)), -1)
    ends = (cell.reshape(-1, 2).index_select(0, chosen) for cell in (start, end))
    start, end = (cell + top for cell in ends)
    ahead = end - start
    most_moves = -(-int(ahead.abs().max()) // 4) * 4  # so that few tables are made
    if most_moves > MOST_TABULATED:
        found = walls_between(tall, start, end, most_moves)
    else:
        line = (ahead[:, 0] + most_moves) * (2 * most_moves + 1) + ahead[:, 1] + most_moves
        own = (start[:, 0] * width + start[:, 1]).unsqueeze(-1)
        low, high = (tall.take(own + table[line]) for table in _lines(most_moves, width))
        found = (low & high).sum(-1)
    number.view(-1)[chosen] = found
    return number


@lru_cache
def pairs(robots: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The first and the second robot of every pair i < j, int64 [P] each."""
    first, second = torch.triu_indices(robots, robots, offset=1, device=device)
    return first, second


@lru_cache
def pair_reaches(config: ArenaConfig, device: torch.device) -> Tensor:
    """Largest squared distance at which each pair is linked, by the walls between, int64 [P, L].

    The last column is for all larger numbers of walls.
    """
    tables = [_table(config, pair, 0.0) for pair in _ranges_of_pairs(config)]
    return _padded(tables, max(map(len, tables), default=0)).to(device)


def reaches(config: ArenaConfig, draw_key: Tensor) -> Tensor:
    """``pair_reaches`` of episodes in which shadowing weakens each pair, int64 [*B, P, L].

    Args:
        config: has the radios.
        draw_key: int64 [*B, 1].

    Returns:
        [*B, 0, 0] without shadowing: all episodes have the same.
    """
    batch = draw_key.shape[:-1]
    if not config.shadowing_db:
        return draw_key.new_zeros(*batch, 0, 0)
    ranges = _ranges_of_pairs(config)
    strongest = -config.shadowing_db * math.sqrt(-2 * math.log(2.0**-53))
    longest = max((len(_table(config, pair, strongest)) for pair in ranges), default=0)
    keys = draw_key.flatten()
    first, second = (robots.tolist() for robots in pairs(config.num_agents, keys.device))
    tables: list[list[tuple[int, ...]]] = [[] for _ in range(len(keys))]
    for pair, i, j in zip(ranges, first, second, strict=True):
        for table, normal in zip(tables, normals(keys, "shadow", i, j), strict=True):
            table.append(_table(config, pair, config.shadowing_db * normal))
    every = [_padded(table, longest) for table in tables]
    return torch.stack(every).to(keys.device).view(*batch, len(ranges), longest + 1)


def _ranges_of_pairs(config: ArenaConfig) -> list[float]:
    """The shorter range of each pair i < j (cells)."""
    robots = range(config.num_agents)
    return [config.reach_cells(i, j) for i in robots for j in robots if i < j]


def _table(config: ArenaConfig, range_cells: float, loss: float) -> tuple[int, ...]:
    most_walls = max(config.height, config.width) if config.wall_loss_db else 0
    return reach_table(
        range_cells, config.wall_loss_db, config.path_loss_exponent, loss, most_walls
    )


def _padded(tables: list[tuple[int, ...]], longest: int) -> Tensor:
    """Tables with the same number of columns, the last of which links nobody, int64 [P, L + 1]."""
    rows = [(*table, *(NEVER_LINKED,) * (longest + 1 - len(table))) for table in tables]
    return torch.tensor(rows, dtype=torch.int64).view(len(rows), longest + 1)
