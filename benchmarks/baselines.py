"""What others would write in plain Python: frontier features with the standard library."""

from __future__ import annotations

import heapq
import math
from collections import deque

COMPASS = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))


def frontiers(grid):
    """Known-free cells with an unknown 4-neighbour."""
    height, width = len(grid), len(grid[0])
    found = []
    for r in range(height):
        for c in range(width):
            if grid[r][c] == 0 and any(
                0 <= r + dr < height and 0 <= c + dc < width and grid[r + dr][c + dc] == -1
                for dr, dc in COMPASS[::2]
            ):
                found.append((r, c))
    return found


def neighbours(grid, cell):
    """(direction, cell) of the free cells one move away."""
    height, width = len(grid), len(grid[0])
    r, c = cell
    for d, (dr, dc) in enumerate(COMPASS):
        row, column = r + dr, c + dc
        if not (0 <= row < height and 0 <= column < width) or grid[row][column] != 0:
            continue
        if dr and dc and grid[row][c] == 1 and grid[r][column] == 1:
            continue
        yield d, (row, column)


def astar(grid, start, goal):
    """(first direction, length) of a shortest path, or None: Chebyshev heuristic, binary heap."""
    queue = [(max(abs(start[0] - goal[0]), abs(start[1] - goal[1])), 0, start, -1)]
    best = {start: 0}
    while queue:
        _, cost, cell, first = heapq.heappop(queue)
        if cell == goal:
            return first, cost
        if cost > best[cell]:
            continue
        for d, following in neighbours(grid, cell):
            if cost + 1 < best.get(following, math.inf):
                best[following] = cost + 1
                ahead = max(abs(following[0] - goal[0]), abs(following[1] - goal[1]))
                heapq.heappush(
                    queue, (cost + 1 + ahead, cost + 1, following, d if first < 0 else first)
                )
    return None


def table(paths):
    """Number, mean and deviation of path lengths per first direction."""
    lengths = [[] for _ in COMPASS]
    for first, length in paths:
        lengths[first].append(length)
    rows = []
    for values in lengths:
        n = len(values)
        mean = sum(values) / n if n else 0.0
        rows.append((n, mean, math.sqrt(sum((v - mean) ** 2 for v in values) / n) if n else 0.0))
    return rows


def astar_table(grid, position):
    """The feature table by one A* per frontier, as the paper's Algorithm 1 reads."""
    goals = [cell for cell in frontiers(grid) if cell != position]
    return table([path for goal in goals if (path := astar(grid, position, goal))])


def bfs_table(grid, position):
    """The feature table by one breadth-first search per robot."""
    found = {position: (-1, 0)}
    queue = deque([position])
    while queue:
        cell = queue.popleft()
        first, length = found[cell]
        for d, following in neighbours(grid, cell):
            if following not in found:
                found[following] = (d if first < 0 else first, length + 1)
                queue.append(following)
    return table([found[cell] for cell in frontiers(grid) if cell in found and cell != position])
