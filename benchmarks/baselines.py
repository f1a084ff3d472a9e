"""What others would write in plain Python: frontier features with the standard library."""

from __future__ import annotations

import heapq
import math
import random
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


class PythonExploration:
    """A single arena as dictionaries and lists: what a first PettingZoo environment looks like.

    Four robots on 12 x 12 cells take random moves, sense 3 x 3 cells, and get the frontier table by
    one A* per frontier.
    """

    def __init__(self, seed: int, side: int = 12, robots: int = 4, obstacles: int = 14) -> None:
        self.random = random.Random(seed)
        self.side, self.robots, self.num_obstacles = side, robots, obstacles
        self.reset()

    def reset(self):
        """Another arena, and maps that know nothing but what is in sight."""
        side, robots = self.side, self.robots
        cells = [(r, c) for r in range(side) for c in range(side)]
        drawn = self.random.sample(cells, self.num_obstacles + robots)
        self.obstacles, self.positions = set(drawn[robots:]), drawn[:robots]
        self.maps = [[[-1] * side for _ in range(side)] for _ in range(robots)]
        self.sense()

    def inside(self, cell) -> bool:
        return 0 <= cell[0] < self.side and 0 <= cell[1] < self.side

    def sense(self):
        for grid, (r, c) in zip(self.maps, self.positions, strict=True):
            for cell in ((r + dr, c + dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1)):
                if self.inside(cell):
                    grid[cell[0]][cell[1]] = int(cell in self.obstacles)

    def step(self):
        """Random moves; the observations of all robots."""
        for robot, (r, c) in enumerate(self.positions):
            dr, dc = self.random.choice(COMPASS)
            target = (r + dr, c + dc)
            if (
                self.inside(target)
                and target not in self.obstacles
                and target not in self.positions
            ):
                self.positions[robot] = target
        self.sense()
        return {
            f"robot_{i}": astar_table(grid, position)
            for i, (grid, position) in enumerate(zip(self.maps, self.positions, strict=True))
        }
