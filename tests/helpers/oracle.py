"""A slow, plain reading of docs/environment.md: the oracle for tests of the fast environment.

Nothing here is clever on purpose. Cells are (row, col) tuples, row 0 is north, and a grid is a
list of rows. Only the standard library is used, and nothing of the package under test.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

NEVER = 1_000_000  # steps_since_merge before the first merge; the counter saturates there
TOLERANCE = 1e-9

UNKNOWN, FREE, OCCUPIED = -1, 0, 1
STAY, COMMUNICATE, NUM_ACTIONS = 8, 9, 10

COMPASS = [(-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1)]  # N NE E ... NW
FOUR = [(-1, 0), (0, 1), (1, 0), (0, -1)]


@dataclass(frozen=True)
class Rules:
    """The numbers that define the task (Arena, Sensing and Communication)."""

    height: int
    width: int
    num_agents: int
    fov_radius: int = 1  # k
    communication_cells: float = 6.4  # r_c / D
    occlusion: bool = False


@dataclass
class State:
    """One arena at one time (Sensing and Communication)."""

    obstacles: list[list[bool]]
    positions: list[tuple[int, int]]
    maps: list[list[list[int]]]  # per robot, -1 unknown 0 free 1 occupied
    unshared: list[list[int]]  # q_ij; diagonal 0
    steps_since_merge: list[list[int]]  # diagonal 0, NEVER before the first merge
    step_count: int


@dataclass
class Step:
    """What a step did, one entry per robot (Actions, Communication and Rewards)."""

    dangerous: list[bool]
    merged: list[bool]  # was a member of a network in this step
    discovered: list[int]  # cells new to the own map by own sensing this step
    received: list[int]  # cells the merge added to the own map, after sensing
    rewards: dict[str, list[float]]


# ---------------------------------------------------------------- cells and paths


def inside(grid, cell) -> bool:
    """Whether the cell lies in the H x W grid (Arena)."""
    return 0 <= cell[0] < len(grid) and 0 <= cell[1] < len(grid[0])


def shifted(cell, direction) -> tuple[int, int]:
    """The cell one move further in a (dr, dc) direction (Actions)."""
    return (cell[0] + direction[0], cell[1] + direction[1])


def squeezes(blocked, cell, direction) -> bool:
    """Whether a diagonal move has both side cells blocked: the diagonal rule (Actions)."""
    dr, dc = direction
    if dr == 0 or dc == 0:
        return False
    sides = [(cell[0] + dr, cell[1]), (cell[0], cell[1] + dc)]
    return all(inside(blocked, side) and blocked[side[0]][side[1]] for side in sides)


def may_move(passable, blocked, cell, direction) -> bool:
    """Whether one move ends in the grid on a passable cell by the diagonal rule (Arena)."""
    target = shifted(cell, direction)
    if not inside(passable, target) or not passable[target[0]][target[1]]:
        return False
    return not squeezes(blocked, cell, direction)


def distances(passable, blocked, start, avoid=None) -> dict[tuple[int, int], int]:
    """Breadth-first lengths of shortest 8-connected paths from start (Arena and FPR)."""
    found = {start: 0}
    queue = deque([start])
    while queue:
        cell = queue.popleft()
        for direction in COMPASS:
            target = shifted(cell, direction)
            if target in found or target == avoid:
                continue
            if may_move(passable, blocked, cell, direction):
                found[target] = found[cell] + 1
                queue.append(target)
    return found


def free_cells(obstacles) -> list[list[bool]]:
    """The grid of cells that are no static obstacles (Arena)."""
    return [[not obstacle for obstacle in row] for row in obstacles]


def connected(obstacles) -> bool:
    """Whether every free cell can be reached from every other (Arena)."""
    free = free_cells(obstacles)
    cells = [(r, c) for r, row in enumerate(free) for c, is_free in enumerate(row) if is_free]
    if len(cells) <= 1:
        return True
    return len(distances(free, obstacles, cells[0])) == len(cells)


# ---------------------------------------------------------------- sensing


def fov_radius(sensing_range, cell_size) -> int:
    """The largest k whose square lies in the sensing disc, 0 if none does (Sensing)."""
    k = 0
    while (k + 1 + 0.5) * math.sqrt(2) * cell_size <= sensing_range + TOLERANCE:
        k += 1
    return k


def hidden(rules, obstacles, position, offset) -> bool:
    """Whether occlusion hides the diagonal neighbour at this offset (Sensing)."""
    is_diagonal_neighbour = abs(offset[0]) == 1 and abs(offset[1]) == 1
    return rules.occlusion and is_diagonal_neighbour and squeezes(obstacles, position, offset)


def view_offsets(rules) -> list[tuple[int, int]]:
    """The (dr, dc) offsets of the square field of view, row by row (Sensing)."""
    span = range(-rules.fov_radius, rules.fov_radius + 1)
    return [(dr, dc) for dr in span for dc in span]


def field_of_view(rules, state, robot) -> list[list[int]]:
    """What the robot sees now: 1 obstacle, other robot, outside or hidden (Sensing)."""
    size = 2 * rules.fov_radius + 1
    position = state.positions[robot]
    others = [p for other, p in enumerate(state.positions) if other != robot]
    values = []
    for offset in view_offsets(rules):
        cell = shifted(position, offset)
        if not inside(state.obstacles, cell) or hidden(rules, state.obstacles, position, offset):
            values.append(1)
        elif offset == (0, 0):
            values.append(0)
        else:
            values.append(1 if state.obstacles[cell[0]][cell[1]] or cell in others else 0)
    return [values[row * size : (row + 1) * size] for row in range(size)]


def sensed(rules, obstacles, position, map_) -> list[list[int]]:
    """A copy of the map with what is sensed from the position written in (Sensing)."""
    result = copied(map_)
    for offset in view_offsets(rules):
        cell = shifted(position, offset)
        if inside(obstacles, cell) and not hidden(rules, obstacles, position, offset):
            result[cell[0]][cell[1]] = OCCUPIED if obstacles[cell[0]][cell[1]] else FREE
    return result


def copied(grid) -> list:
    """A copy of a list of lists, so that nothing is shared between states ."""
    return [list(row) for row in grid]


def known_cells(map_) -> int:
    """|M|, the number of known cells of a map (Rewards)."""
    return sum(1 for row in map_ for value in row if value != UNKNOWN)


# ---------------------------------------------------------------- coverage


def target_cells(obstacles, positions) -> list[list[bool]]:
    """Free cells some robot can reach, and their 4-neighbours inside (Coverage)."""
    free = free_cells(obstacles)
    targets = [[False for _ in row] for row in obstacles]
    for position in positions:
        for cell in distances(free, obstacles, tuple(position)):
            for direction in [(0, 0), *FOUR]:
                near = shifted(cell, direction)
                if inside(targets, near):
                    targets[near[0]][near[1]] = True
    return targets


def known_targets(map_, targets) -> int:
    """The number of target cells that the map knows (Coverage)."""
    cells = [(r, c) for r, row in enumerate(targets) for c, target in enumerate(row) if target]
    return sum(1 for r, c in cells if map_[r][c] != UNKNOWN)


def complete(map_, targets) -> bool:
    """Whether the map knows every target cell (Coverage)."""
    return known_targets(map_, targets) == sum(row.count(True) for row in targets)


# ---------------------------------------------------------------- moves and networks


def visible_danger(state, robot, action) -> bool:
    """Whether a move is outside, into an obstacle or robot, or squeezes (Actions)."""
    position = state.positions[robot]
    target = shifted(position, COMPASS[action])
    if not may_move(free_cells(state.obstacles), state.obstacles, position, COMPASS[action]):
        return True
    return any(p == target for other, p in enumerate(state.positions) if other != robot)


def contended(state, actions, robot) -> bool:
    """Whether another chosen move has the same target or the same midpoint (Actions)."""
    start = state.positions[robot]
    target = shifted(start, COMPASS[actions[robot]])
    for other, action in enumerate(actions):
        if other != robot and action < STAY:
            other_start = state.positions[other]
            other_target = shifted(other_start, COMPASS[action])
            same_midpoint = shifted(start, target) == shifted(other_start, other_target)  # doubled
            if other_target == target or same_midpoint:
                return True
    return False


def dangers(state, actions) -> list[bool]:
    """Which robots chose a dangerous move, all judged at time t (Actions)."""
    return [
        action < STAY and (visible_danger(state, robot, action) or contended(state, actions, robot))
        for robot, action in enumerate(actions)
    ]


def in_range(rules, state) -> list[list[bool]]:
    """NET, which robots are within r_c of which, itself included (NET)."""
    return [
        [math.dist(p, q) <= rules.communication_cells + TOLERANCE for q in state.positions]
        for p in state.positions
    ]


def action_mask(rules, state) -> list[list[bool]]:
    """a_AVAIL, True where the action is allowed (Actions)."""
    near = in_range(rules, state)
    robots = range(len(state.positions))
    mask = []
    for robot in robots:
        row = [not visible_danger(state, robot, action) for action in range(STAY)]
        row.append(True)  # stay
        row.append(any(near[robot][other] for other in robots if other != robot))  # communicate
        mask.append(row)
    return mask


def networks(near, actions) -> list[list[int]]:
    """The connected components of two or more communicators (Communication)."""
    nodes = [robot for robot, action in enumerate(actions) if action == COMMUNICATE]
    found = []
    placed = set()
    for node in nodes:
        if node in placed:
            continue
        members = [node]
        for member in members:  # grows while it is walked over
            for other in nodes:
                if near[member][other] and other not in members:
                    members.append(other)
        placed.update(members)
        if len(members) >= 2:
            found.append(sorted(members))
    return found


def union(maps) -> list[list[int]]:
    """The map that knows whatever one of the maps knows (Communication)."""
    result = copied(maps[0])
    for map_ in maps:
        for r, row in enumerate(map_):
            for c, value in enumerate(row):
                if value != UNKNOWN:
                    result[r][c] = value
    return result


# ---------------------------------------------------------------- reset and step


def reset(rules, obstacles, positions) -> State:
    """The arena at step 0, every robot having sensed once (Sensing)."""
    positions = [tuple(position) for position in positions]
    robots = range(rules.num_agents)
    blank = [[UNKNOWN] * rules.width for _ in range(rules.height)]
    maps = [sensed(rules, obstacles, position, blank) for position in positions]
    first = [known_cells(map_) for map_ in maps]
    return State(
        obstacles=copied(obstacles),
        positions=positions,
        maps=maps,
        unshared=[[0 if i == j else first[i] for j in robots] for i in robots],
        steps_since_merge=[[0 if i == j else NEVER for j in robots] for i in robots],
        step_count=0,
    )


def step(rules, state, actions) -> tuple[State, Step]:
    """Moves, then sensing, then merging, then rewards, then counters (Actions to Rewards)."""
    robots = range(rules.num_agents)
    dangerous = dangers(state, actions)

    new = State(
        obstacles=copied(state.obstacles),
        positions=list(state.positions),
        maps=[],
        unshared=copied(state.unshared),
        steps_since_merge=copied(state.steps_since_merge),
        step_count=state.step_count + 1,
    )
    for i in robots:
        if actions[i] < STAY and not dangerous[i]:
            new.positions[i] = shifted(state.positions[i], COMPASS[actions[i]])

    new.maps = [sensed(rules, state.obstacles, new.positions[i], state.maps[i]) for i in robots]
    discovered = [known_cells(new.maps[i]) - known_cells(state.maps[i]) for i in robots]
    for i in robots:
        for j in robots:
            if i != j:
                new.unshared[i][j] += discovered[i]
                new.steps_since_merge[i][j] = min(NEVER, new.steps_since_merge[i][j] + 1)

    received = [0 for _ in robots]
    peers = [[] for _ in robots]  # the other members of the robot's network
    for members in networks(in_range(rules, new), actions):
        merged_map = union([new.maps[i] for i in members])
        for i in members:
            received[i] = known_cells(merged_map) - known_cells(new.maps[i])
            new.maps[i] = copied(merged_map)
            peers[i] = [j for j in members if j != i]

    rewards = {
        "case1": [case1(state, new, i, dangerous) for i in robots],
        "case2": [case2(rules, state, new, i, actions, dangerous, peers, False) for i in robots],
        "case2-lone-idle": [
            case2(rules, state, new, i, actions, dangerous, peers, True) for i in robots
        ],
        "team": [team(state, new, dangerous) for _ in robots],
        "progress": [progress(state, new, dangerous) for _ in robots],
        "union": [union_reward(state, new, dangerous) for _ in robots],
    }

    for i in robots:
        for j in peers[i]:
            new.unshared[i][j] = 0
            new.steps_since_merge[i][j] = 0
    merged = [len(peers[i]) > 0 for i in robots]
    return new, Step(dangerous, merged, discovered, received, rewards)


# ---------------------------------------------------------------- rewards


def case1(before, after, i, dangerous) -> float:
    """The first reward of robot i; a merged map is its map after the step (Rewards)."""
    if dangerous[i]:
        return -100.0
    return float(known_cells(after.maps[i]) - known_cells(before.maps[i]))


def case2(rules, before, after, i, actions, dangerous, peers, lone_idle) -> float:
    """The second reward of robot i, `after` still holding q before its reset (Rewards)."""
    if dangerous[i]:
        return -10.0
    area = rules.height * rules.width
    gain = known_cells(after.maps[i]) - known_cells(before.maps[i])
    if peers[i]:
        mean_unshared = sum(after.unshared[i][j] for j in peers[i]) / len(peers[i])
        return (0.8 + mean_unshared / area) * gain / area
    if actions[i] == COMMUNICATE and not lone_idle:
        return 0.0
    e_max = 4 * rules.fov_radius + 1
    idle = actions[i] in (STAY, COMMUNICATE)  # a lone communicator comes here only if it is idle
    return gain / e_max - (1.0 if idle else 0.0)


def team(before, after, dangerous) -> float:
    """Our reward, the same number for every robot (Rewards)."""
    targets = target_cells(before.obstacles, before.positions)
    growth = max(known_cells(m) for m in after.maps) - max(known_cells(m) for m in before.maps)
    done = any(complete(map_, targets) for map_ in after.maps)
    return growth / 40 - (0.0 if done else 0.1) - 0.25 * sum(dangerous) / len(dangerous)


def progress(before, after, dangerous) -> float:
    """As team, half of the growth being that of the robots' mean map (Rewards)."""
    largest = max(map(known_cells, after.maps)) - max(map(known_cells, before.maps))
    mean = sum(map(known_cells, after.maps)) - sum(map(known_cells, before.maps))
    mean /= len(after.maps)
    return team(before, after, dangerous) + (mean - largest) / 80


def union_reward(before, after, dangerous) -> float:
    """As team, half of the growth being that of the union of all maps (Rewards)."""
    largest = max(map(known_cells, after.maps)) - max(map(known_cells, before.maps))
    whole = known_cells(union(after.maps)) - known_cells(union(before.maps))
    return team(before, after, dangerous) + (whole - largest) / 80


# ---------------------------------------------------------------- FPR


def frontiers(map_) -> list[tuple[int, int]]:
    """Known-free cells with an unknown 4-neighbour inside the arena, row by row (FPR)."""
    result = []
    for r, row in enumerate(map_):
        for c, value in enumerate(row):
            near = [shifted((r, c), direction) for direction in FOUR]
            unknown_near = any(inside(map_, n) and map_[n[0]][n[1]] == UNKNOWN for n in near)
            if value == FREE and unknown_near:
                result.append((r, c))
    return result


def trajectories(map_, position) -> list[tuple[int, int]]:
    """(First direction, length) of the path to each reachable frontier (FPR)."""
    position = tuple(position)
    passable = [[value == FREE for value in row] for row in map_]
    blocked = [[value == OCCUPIED for value in row] for row in map_]
    lengths = distances(passable, blocked, position)
    after_first = {}  # direction index -> distances from the cell that the first move leads to
    for index, direction in enumerate(COMPASS):
        if may_move(passable, blocked, position, direction):
            neighbour = shifted(position, direction)
            after_first[index] = distances(passable, blocked, neighbour, avoid=position)
    result = []
    for frontier in frontiers(map_):
        if frontier == position or frontier not in lengths:
            continue
        length = lengths[frontier]
        firsts = [i for i, rest in after_first.items() if rest.get(frontier) == length - 1]
        result.append((min(firsts), length))
    return result


def feature_table(map_, position, normalize) -> list[list[float]]:
    """The 8 x [n, mu, sigma] table of trajectories per first direction (FPR)."""
    if normalize not in ("relative", "proximity", "absolute", None):
        raise ValueError(f"unknown normalize: {normalize!r}")
    found = trajectories(map_, position)
    table = []
    for index in range(8):
        lengths = [length for first, length in found if first == index]
        n = len(lengths)
        mu = sum(lengths) / n if n else 0.0
        sigma = math.sqrt(sum((length - mu) ** 2 for length in lengths) / n) if n else 0.0
        table.append([float(n), mu, sigma])
    if normalize is None or not found:
        return table
    height, width = len(map_), len(map_[0])
    total = len(found)
    longest = max(length for _, length in found)
    nearest = min(mu for n, mu, _ in table if n > 0)
    result = []
    for n, mu, sigma in table:
        if normalize == "relative":
            result.append([n / total, mu / longest, sigma / longest])
        elif normalize == "proximity":
            result.append([n / total, nearest / mu if n else 0.0, sigma / longest])
        else:
            result.append([n / (height * width), mu / (height + width), sigma / (height + width)])
    return result
