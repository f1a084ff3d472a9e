"""A slow, plain reading of docs/goals.md: the oracle for tests of the memory and of the goals.

Nothing here is clever on purpose. Everything is about one robot, which is given what it observes
and nothing else, beside the sensors of its team (``world_oracle.Settings``). Cells are
(row, column) tuples, directions are 0 to 7, sets of cells are sets.
"""

from __future__ import annotations

from dataclasses import dataclass

from tests.helpers.oracle import (
    COMPASS,
    FOUR,
    FREE,
    OCCUPIED,
    UNKNOWN,
    distances,
    may_move,
    shifted,
)
from tests.helpers.world_oracle import expected_discovery, radius, seen_cells

NEVER_SEEN = -1_000_000
PATIENCE = 8
CANDIDATES = 24
MOST_POCKET = 64
MOST_ISOLATION = 20
DETOUR = 4
NO_GOAL = (-1, -1)
NO_DIRECTION = -1


# ---------------------------------------------------------------- memory


@dataclass
class Memory:
    """What one robot remembers; lists have an entry for every robot of the team."""

    seen_step: list[int]
    seen_cell: list[tuple[int, int] | None]  # None: never seen
    waited: list[bool]
    known_by: list[set[tuple[int, int]]]
    covered: set[tuple[int, int]]
    stuck: int
    known: int
    stalled: int
    position: tuple[int, int]
    heading: int
    goal: tuple[int, int]


def blank(robots, position) -> Memory:
    """Before an episode's first observation."""
    return Memory(
        seen_step=[NEVER_SEEN] * robots,
        seen_cell=[None] * robots,
        waited=[False] * robots,
        known_by=[set() for _ in range(robots)],
        covered=set(),
        stuck=0,
        known=0,
        stalled=0,
        position=position,
        heading=NO_DIRECTION,
        goal=NO_GOAL,
    )


def remember(
    before, now, map_, position, linked, merged, all_covered, team, patience=PATIENCE
) -> Memory:
    """The memory after an observation.

    Args:
        before: the memory until now.
        now: step of the episode.
        map_: the robot's own map after the step.
        position: its own cell.
        linked: {teammate: its cell} of the teammates that are linked now.
        merged: the teammates with which it merged maps in the last step.
        all_covered: whether all its frontiers were covered in the observation before.
        team: the sensors of all robots.
        patience: steps in a row of ``all_covered`` after which it forgets what is covered.
    """
    robots = range(len(before.seen_step))
    seen_step, seen_cell = list(before.seen_step), list(before.seen_cell)
    waited = [False for _ in robots]
    known_by = [set(before.known_by[j]) for j in robots]
    covered, heading = set(before.covered), before.heading

    stuck = before.stuck + 1 if all_covered else 0
    if stuck == patience:
        covered, stuck = set(), 0

    known = sum(value(map_, c) != UNKNOWN for c in all_cells(map_))
    stalled = 0 if known > before.known else before.stalled + 1

    for j, cell in linked.items():
        waited[j] = before.seen_step[j] == now - 1 and before.seen_cell[j] == cell
        seen_step[j], seen_cell[j] = now, cell

    for j, cell in linked.items():
        view = surely_seen(team, j, map_, cell)
        covered |= view
        known_by[j] |= view

    for j in merged:
        known_by[j] |= {c for c in all_cells(map_) if value(map_, c) != UNKNOWN}

    for direction, offset in enumerate(COMPASS):
        if shifted(before.position, offset) == position:
            heading = direction

    return Memory(
        seen_step,
        seen_cell,
        waited,
        known_by,
        covered,
        stuck,
        known,
        stalled,
        position,
        heading,
        before.goal,
    )


def surely_seen(team, mate, map_, cell) -> set[tuple[int, int]]:
    """What a teammate senses from a cell even if all that the own map does not know is obstacles.

    More obstacles never bring more into sight. Its own cell is free: it stands there.
    """
    may_hide = [[value != FREE for value in row] for row in map_]
    may_hide[cell[0]][cell[1]] = False
    return seen_cells(team, mate, may_hide, cell)


# ---------------------------------------------------------------- cells and paths


def all_cells(map_) -> list[tuple[int, int]]:
    """All cells of the arena, row by row."""
    return [(r, c) for r, row in enumerate(map_) for c, _ in enumerate(row)]


def value(map_, cell) -> int:
    """What the map holds in a cell."""
    return map_[cell[0]][cell[1]]


def straight(cell, other) -> int:
    """The straight distance of two cells."""
    return max(abs(cell[0] - other[0]), abs(cell[1] - other[1]))


def neighbour(cell, direction) -> tuple[int, int]:
    """The cell that a move leads to."""
    return shifted(cell, COMPASS[direction])


def beside(cell) -> list[tuple[int, int]]:
    """The 4-neighbours of a cell, those outside the arena too."""
    return [shifted(cell, offset) for offset in FOUR]


def blocked_beside(fov, map_, position) -> set[tuple[int, int]]:
    """The taken cells: neighbours that a field of view shows as blocked and the map has free."""
    k = len(fov) // 2
    found = set()
    for dr, dc in COMPASS:
        cell = shifted(position, (dr, dc))
        if cell in all_cells(map_) and value(map_, cell) == FREE and fov[k + dr][k + dc] == 1:
            found.add(cell)
    return found


class Surroundings:
    """What a robot's candidates are made of: its unseen cells, and its paths.

    Args:
        map_: its map.
        position: its cell.
        taken: the taken cells beside it.
        allowed: for every direction, whether the move is allowed.
        memory: what it remembers.
        team: the sensors of all robots.
        robot: its number.
    """

    def __init__(self, map_, position, taken, allowed, memory, team, robot):
        self.position, self.allowed, self.memory = position, allowed, memory
        self.team, self.robot, self.k = team, robot, radius(team, robot)
        self.left = [  # the map without what is covered
            [FREE if (r, c) in memory.covered and v == UNKNOWN else v for c, v in enumerate(row)]
            for r, row in enumerate(map_)
        ]
        self.unknown = {c for c in all_cells(map_) if value(map_, c) == UNKNOWN}
        self.unseen = self.unknown - memory.covered
        self.regions = regions(self.unseen)
        self.near_gains = {}  # of the cells that were asked for
        self.free = [[cell == FREE for cell in row] for row in map_]
        self.walls = [[cell == OCCUPIED for cell in row] for row in map_]
        self.passable = [
            [self.free[r][c] and (r, c) not in taken for c in range(len(row))]
            for r, row in enumerate(map_)
        ]
        self.moves_to = distances(self.passable, self.walls, position)  # nearest cells first
        self.firsts = self._first_moves()

    def _first_moves(self) -> dict[tuple[int, int], set[int]]:
        """For every cell, the first moves of all shortest paths: L."""
        firsts = {cell: set() for cell in self.moves_to}
        for cell in self.moves_to:
            for direction, offset in enumerate(COMPASS):
                target = shifted(cell, offset)
                is_next = self.moves_to.get(target) == self.moves_to[cell] + 1
                if is_next and may_move(self.passable, self.walls, cell, offset):
                    firsts[target] |= {direction} if cell == self.position else firsts[cell]
        return firsts

    def gain(self, cell, radius) -> int:
        """Unseen cells in a square."""
        return sum(1 for c in self.unseen if straight(c, cell) <= radius)

    def near_gain(self, cell) -> int:
        """Unseen cells that the robot would see from a cell if unknown cells were free."""
        if cell not in self.near_gains:
            gain = expected_discovery(self.team, self.robot, self.left, cell)
            self.near_gains[cell] = gain
        return self.near_gains[cell]

    def move_gain(self, direction) -> int:
        """The same after a move."""
        return self.near_gain(neighbour(self.position, direction))

    def move(self, cell) -> int:
        """The first move to a cell that has one."""

        def preference(direction):
            return (not self.allowed[direction], -self.move_gain(direction), direction)

        return min(self.firsts[cell], key=preference)

    def frontiers(self) -> list[tuple[int, int]]:
        """The frontiers, in the order of d, row and column."""
        found = [
            cell
            for cell, moves in self.moves_to.items()
            if moves >= 1 and any(c in self.unknown for c in beside(cell))
        ]
        return sorted(found, key=lambda cell: (self.moves_to[cell], cell))

    def open_frontiers(self) -> list[tuple[int, int]]:
        """Those that have an unseen neighbour, in the same order."""
        return [f for f in self.frontiers() if any(c in self.unseen for c in beside(f))]

    def thinned(self) -> dict[tuple[int, int], int]:
        """The candidates in their order, and for how many cells each one stands."""
        chosen = {}
        for cell in self.open_frontiers():
            absorbing = [a for a in chosen if self._absorbs(a, cell)]
            if absorbing:
                chosen[absorbing[0]] += 1
            elif len(chosen) < CANDIDATES:
                chosen[cell] = 1
        return chosen

    def _absorbs(self, candidate, cell) -> bool:
        k, moves = self.k, self.moves_to[cell]
        if moves <= 2 * k:
            radius = 0
        elif moves <= 6 * k:
            radius = k
        else:
            radius = 2 * k
        return self.moves_to[candidate] > 2 * k and straight(candidate, cell) <= radius

    def pocket(self, cell) -> int:
        """Cells of the largest region of unseen cells that touches a cell, at most 64."""
        touching = [region for region in self.regions if any(c in region for c in beside(cell))]
        return min(MOST_POCKET, max(len(region) for region in touching))


def regions(cells) -> list[set[tuple[int, int]]]:
    """The 4-connected regions of a set of cells."""
    found, rest = [], set(cells)
    while rest:
        region = [rest.pop()]
        for member in region:  # grows while it is walked over
            region += [c for c in beside(member) if c in rest]
            rest -= set(region)
        found.append(set(region))
    return found


# ---------------------------------------------------------------- the table


def goal_table(robot, map_, position, taken, allowed, memory, team) -> dict:
    """Everything about the candidate goals of one robot, by the names of the page."""
    around = Surroundings(map_, position, taken, allowed, memory, team, robot)
    chosen = around.thinned()
    return {
        "frontiers": frontier_rows(around, chosen),
        "rivals": rival_rows(around, chosen, robot),
        "ways": way_rows(around, robot),
        "all_covered": bool(around.frontiers()) and not around.open_frontiers(),
    }


def frontier_rows(around, chosen) -> list[list[int]]:
    """`frontiers` of one robot, 24 rows of 14 columns."""
    k, heading, goal = around.k, around.memory.heading, around.memory.goal
    rows = []
    for cell, merged in chosen.items():
        move = around.move(cell)
        apart = [straight(cell, a) for a in chosen if straight(cell, a) > k]
        eighths = abs(move - heading)
        row = {
            "row": cell[0],
            "column": cell[1],
            "moves": around.moves_to[cell],
            "move": move,
            "merged_cells": merged,
            "near_gain": around.near_gain(cell),
            "middle_gain": around.gain(cell, 2 * k),
            "far_gain": around.gain(cell, 4 * k),
            "pocket": around.pocket(cell),
            "isolation": min([*apart, MOST_ISOLATION]),
            "move_gain": around.move_gain(move),
            "move_allowed": int(around.allowed[move]),
            "turn": -1 if heading == NO_DIRECTION else min(eighths, 8 - eighths),
            "from_last_goal": -1 if goal == NO_GOAL else straight(cell, goal),
        }
        rows.append(list(row.values()))
    return rows + [[0] * 14] * (CANDIDATES - len(rows))


def rival_rows(around, chosen, robot) -> list[list[list[int]]]:
    """`rivals` of one robot, 24 rows with two columns for every robot."""
    memory = around.memory
    robots = range(len(memory.seen_step))
    rows = [[[0, 0] for _ in robots] for _ in range(CANDIDATES)]
    for j in robots:
        seen = was_seen(memory, robot, j)
        paths = distances(around.free, around.walls, memory.seen_cell[j]) if seen else {}
        for row, cell in zip(rows, chosen, strict=False):
            if not seen:
                row[j] = [-1, 0]
            else:
                moves = paths.get(cell, straight(memory.seen_cell[j], cell) + DETOUR)
                row[j] = [moves, int(cell in memory.known_by[j])]
    return rows


def way_rows(around, robot) -> list[list[int]]:
    """`ways` of one robot, two columns for every robot."""
    memory = around.memory
    rows = []
    for j in range(len(memory.seen_step)):
        row = [0, NO_DIRECTION]
        if was_seen(memory, robot, j):
            goal = memory.seen_cell[j]
            _, moves, nearest = min((straight(c, goal), d, c) for c, d in around.moves_to.items())
            if nearest != around.position:
                row = [moves + straight(nearest, goal), around.move(nearest)]
        rows.append(row)
    return rows


def was_seen(memory, robot, other) -> bool:
    """Whether a teammate was ever seen; a robot is no teammate of itself."""
    return other != robot and memory.seen_step[other] != NEVER_SEEN
