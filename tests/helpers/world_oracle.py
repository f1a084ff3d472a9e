"""A slow, plain reading of the wider world: limited sight, weak radio, failing robots, walkers.

The rules of the paper's world are in ``tests.helpers.oracle``, and what is unchanged is taken from
there. Docstrings quote the sentence of the specification that a function follows; where it leaves
a choice, they say which reading is taken. Only the standard library is used, and nothing of the
package under test: cells are (row, column) tuples, a grid is a list of rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from tests.helpers.oracle import (
    COMMUNICATE,
    COMPASS,
    FOUR,
    FREE,
    NEVER,
    OCCUPIED,
    STAY,
    TOLERANCE,
    UNKNOWN,
    complete,
    contended,
    copied,
    distances,
    free_cells,
    inside,
    known_cells,
    known_targets,
    networks,
    shifted,
    squeezes,
    target_cells,
    union,
    visible_danger,
)

WALKER_MOVES = [(0, 0), (-1, 0), (0, 1), (1, 0), (0, -1)]  # stay, N, E, S, W

Cell = tuple[int, int]
Grid = list[list[bool]]
Map = list[list[int]]  # -1 unknown, 0 free, 1 occupied


@dataclass(frozen=True)
class Settings:
    """The arena, its robots, their sensors and radios; metres and decibels.

    A tuple has one entry per robot.
    """

    height: int = 12
    width: int = 12
    num_agents: int = 4
    cell_size: float = 0.5
    sensing_range: float | tuple[float, ...] = 1.1
    sensing_shape: str = "square"
    line_of_sight: bool = False
    communication_range: float | tuple[float, ...] = 3.2
    wall_loss_db: float = 0.0
    path_loss_exponent: float = 2.0
    shadowing_db: float = 0.0
    message_loss: float = 0.0
    move_period: int | tuple[int, ...] = 1
    failure_rate: float = 0.0
    num_walkers: int = 0
    terminate_at_coverage: float | None = None


@dataclass
class State:
    """One arena at one time: all that its future depends on."""

    obstacles: Grid
    positions: list[Cell]
    maps: list[Map]
    unshared: list[list[int]]  # q_ij; diagonal 0
    steps_since_merge: list[list[int]]  # diagonal 0, NEVER before the first merge
    step_count: int
    alive: list[bool]
    walkers: list[Cell]
    linked: Grid  # True on the diagonal; as published after the failures of the last step
    targets: Grid
    draw_key: int


@dataclass
class Events:
    """What a step did, one entry per robot; rewards of each kind under its name."""

    dangerous: list[bool]
    merged: list[bool]
    discovered: list[int]
    received: list[int]
    rewards: dict[str, list[float]]


@dataclass
class Frame:
    """All that is known of an arena after its start, or after a step."""

    positions: list[Cell]
    maps: list[Map]
    fov: list[Map]
    linked: Grid
    alive: list[bool]
    walkers: list[Cell]
    masks: Grid
    dangerous: list[bool]
    merged: list[bool]
    discovered: list[int]
    received: list[int]
    unshared: list[list[int]]
    steps_since_merge: list[list[int]]
    rewards: dict[str, list[float]]  # of each robot; empty at the start
    team_rewards: dict[str, float]
    terminated: bool
    coverages: dict[str, float]  # largest, union, mean, smallest
    some_complete: bool
    every_complete: bool
    finishable: bool


class World:
    """Plays one arena: ``frame`` is its present, ``step`` goes on."""

    def __init__(self, settings, obstacles, positions, draw_key, *, alive=None, walkers=None):
        self.settings = settings
        self.state = start(settings, obstacles, positions, draw_key, alive=alive, walkers=walkers)
        self.frame = frame(settings, self.state, None)

    def step(self, actions) -> Frame:
        """The frame after all robots acted at once."""
        self.state, events = step(self.settings, self.state, actions)
        self.frame = frame(self.settings, self.state, events)
        return self.frame


def per_robot(settings, name) -> list:
    """A setting of each robot: "a number, or one per robot"."""
    value = getattr(settings, name)
    if not isinstance(value, tuple):
        return [value] * settings.num_agents
    if len(value) != settings.num_agents:
        raise ValueError(f"{name}={value!r} needs {settings.num_agents} entries")
    return list(value)


# ---------------------------------------------------------------- draws

MASK = 2**64 - 1


def mixed(value) -> int:
    """The next number of splitmix64 from a state, without a sign."""
    value = (value + 0x9E3779B97F4A7C15) & MASK
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & MASK
    return value ^ (value >> 31)


def signed(value) -> int:
    """The int64 with the bits of an unsigned 64-bit number."""
    return value - 2**64 if value >= 2**63 else value


def combine(*parts) -> int:
    """One int64 hash of several integers, in order."""
    result = 0
    for part in parts:
        result = mixed(result ^ (part & MASK))
    return signed(result)


def name_key(name) -> int:
    """The number of a name: the hash of its bytes."""
    return combine(*name.encode())


def draw_key(stream, seed, arena, episode) -> int:
    """The key of an episode: "combine(stream seed, arena, episode)"."""
    return combine(combine(name_key(stream), seed), arena, episode)


def uniform(key, name, *indices) -> float:
    """u: "(combine(...) logically shifted right by 11) / 2^53", so 0 <= u < 1."""
    return ((combine(key, name_key(name), *indices) & MASK) >> 11) / 2**53


def happens(probability, key, name, *indices) -> bool:
    """Whether an event comes about: "of probability p happens iff u < p"."""
    return uniform(key, name, *indices) < probability


def standard_normal(u0, u1) -> float:
    """A normal number by Box and Muller: "sqrt(-2 ln(1 - u0)) cos(2 pi u1)"."""
    return math.sqrt(-2 * math.log(1 - u0)) * math.cos(2 * math.pi * u1)


def shadowing(settings, key, i, j) -> float:
    """X of a pair: "drawn once per pair and episode, the same both ways" (dB)."""
    pair = min(i, j), max(i, j)
    u0, u1 = (uniform(key, "shadow", *pair, part) for part in (0, 1))
    return settings.shadowing_db * standard_normal(u0, u1)


# ---------------------------------------------------------------- shapes of sensors


def square_radius(range_cells) -> int:
    """k of a square: "the largest integer with (k + 1/2) sqrt(2) D <= r_d", compared in cells."""
    k = 0
    while (k + 1 + 0.5) * math.sqrt(2) <= range_cells + TOLERANCE:
        k += 1
    return k


def radius(settings, robot) -> int:
    """The k of one robot; of a disc "k = floor(range/D + 1e-9)"."""
    range_cells = per_robot(settings, "sensing_range")[robot] / settings.cell_size
    if settings.sensing_shape == "square":
        return square_radius(range_cells)
    return math.floor(range_cells + TOLERANCE)


def shape(settings, robot) -> list[Cell]:
    """Offsets that a robot may sense: "every cell with r^2 + c^2 <= (range/D + 1e-9)^2"."""
    offsets = square_offsets(radius(settings, robot))
    if settings.sensing_shape == "square":
        return offsets
    range_cells = per_robot(settings, "sensing_range")[robot] / settings.cell_size
    return [(r, c) for r, c in offsets if r * r + c * c <= (range_cells + TOLERANCE) ** 2]


def square_offsets(k) -> list[Cell]:
    """The offsets of a (2k+1) x (2k+1) window, row by row."""
    return [(r, c) for r in range(-k, k + 1) for c in range(-k, k + 1)]


def window_radius(settings) -> int:
    """k of the window that all robots share: "that of the robot with the longest range"."""
    return max(radius(settings, robot) for robot in range(settings.num_agents))


def max_discovery(settings, robot) -> int:
    """Its e_max: "the most cells of its own shape that one of the eight moves brings in"."""
    here = set(shape(settings, robot))
    return max(len({shifted(offset, move) for offset in here} - here) for move in COMPASS)


# ---------------------------------------------------------------- sight


def nearest_integers(numerator, denominator) -> list[int]:
    """The integer nearest to a fraction, or both if it lies halfway between two."""
    below, rest = divmod(numerator, denominator)
    if 2 * rest == denominator:
        return [below, below + 1]
    return [below if 2 * rest < denominator else below + 1]


def parents(offset) -> list[Cell]:
    """Parents: "the cells of ring m - 1 nearest to the exact point (r (m-1)/m, c (m-1)/m)"."""
    m = max(abs(offset[0]), abs(offset[1]))
    rows = nearest_integers(offset[0] * (m - 1), m)
    columns = nearest_integers(offset[1] * (m - 1), m)
    return [(r, c) for r in rows for c in columns]


def lets_through(obstacles, parent, cell) -> bool:
    """Whether a parent "is no obstacle, and, when the step from [it] is diagonal, not both ..."."""
    direction = (cell[0] - parent[0], cell[1] - parent[1])
    return not obstacles[parent[0]][parent[1]] and not squeezes(obstacles, parent, direction)


def in_sight(obstacles, center, k) -> set[Cell]:
    """The cells within k that obstacles leave in sight: "seen iff some parent is seen ...".

    The centre is seen even where it is an obstacle, which then hides all the rest.
    """
    seen = {center}
    rings = sorted(square_offsets(k), key=lambda offset: max(abs(offset[0]), abs(offset[1])))
    for offset in rings[1:]:  # from the inside out, so that parents come first
        cell = shifted(center, offset)
        if inside(obstacles, cell):
            before = [shifted(center, parent) for parent in parents(offset)]
            if any(p in seen and lets_through(obstacles, p, cell) for p in before):
                seen.add(cell)
    return seen


def seen_cells(settings, robot, obstacles, center) -> set[Cell]:
    """The cells of the arena that a robot at a centre senses.

    "Robots and walkers hide nothing": only obstacles end sight.
    """
    cells = {shifted(center, offset) for offset in shape(settings, robot)}
    if settings.line_of_sight:
        return cells & in_sight(obstacles, center, radius(settings, robot))
    return {cell for cell in cells if inside(obstacles, cell)}


def sensed(settings, robot, obstacles, position, map_) -> Map:
    """The map with what a robot senses written in: "unseen cells ... stay unknown in the map".

    Robots and walkers are "free in maps".
    """
    result = copied(map_)
    for r, c in seen_cells(settings, robot, obstacles, position):
        result[r][c] = OCCUPIED if obstacles[r][c] else FREE
    return result


def field_of_view(settings, state, robot) -> Map:
    """The FOV of a robot: "unseen cells read 1 in the FOV"; "outside reads 1".

    A walker is "1 in the FOV of who senses it", and so is a robot, alive or not. Of a failed robot
    "its FOV is 1 but for its own cell".
    """
    own = state.positions[robot]
    k = window_radius(settings)
    seen = seen_cells(settings, robot, state.obstacles, own) if state.alive[robot] else {own}
    taken = {p for other, p in enumerate(state.positions) if other != robot}
    taken.update(state.walkers)

    def value(cell) -> int:
        if cell not in seen or cell in taken:
            return 1
        return 1 if state.obstacles[cell[0]][cell[1]] else 0

    return [[value((own[0] + r, own[1] + c)) for c in range(-k, k + 1)] for r in range(-k, k + 1)]


def expected_discovery(settings, robot, map_, cell) -> int:
    """Unknown cells that a robot would see from a cell "if unknown cells were free".

    "Per robot, on its own map, for its own shape"; "cells outside count nowhere".
    """
    occupied = [[value == OCCUPIED for value in row] for row in map_]
    seen = seen_cells(settings, robot, occupied, cell)
    return sum(map_[r][c] == UNKNOWN for r, c in seen)


def expected_gain(settings, robot, map_, cell) -> float:
    """The same as a share: "shares divide by the number of cells of the shape".

    The whole shape divides, its cells outside the arena included, as with the square of today.
    """
    return expected_discovery(settings, robot, map_, cell) / len(shape(settings, robot))


# ---------------------------------------------------------------- links


def walls_between(obstacles, start, end) -> int:
    """Obstacles on the line, w: "for t = 1 .. m-1 the point i + t (dr, dc)/m".

    "A point halfway between two cells counts only if both are obstacles".
    """
    dr, dc = end[0] - start[0], end[1] - start[1]
    m = max(abs(dr), abs(dc))
    walls = 0
    for t in range(1, m):
        rows = nearest_integers(start[0] * m + t * dr, m)
        columns = nearest_integers(start[1] * m + t * dc, m)
        walls += all(obstacles[r][c] for r in rows for c in columns)
    return walls


def power_of_ten(exponent) -> float:
    """10 to a power, infinite where Python would complain of a number that is too large."""
    return math.inf if exponent > 308 else 10.0**exponent


def reach_squared(settings, i, j, walls, loss) -> float:
    """The bound on d^2, floor((R 10^(-(L w + X)/(10 n)) + 1e-9)^2) or infinity; ``loss`` is X.

    "L w is 0 for w = 0; with L = inf and w > 0 the pair is never linked, even at infinite range;
    R = 0 links nobody; R = inf with finite L links all."
    """
    ranges = per_robot(settings, "communication_range")
    shorter = min(ranges[i], ranges[j]) / settings.cell_size
    wall_loss = settings.wall_loss_db * walls if walls > 0 else 0.0
    if shorter == 0 or (walls > 0 and settings.wall_loss_db == math.inf):
        return 0
    if shorter == math.inf:
        return math.inf
    exponent = -(wall_loss + loss) / (10 * settings.path_loss_exponent)
    reach = shorter * power_of_ten(exponent) + TOLERANCE
    return math.floor(reach * reach) if math.isfinite(reach * reach) else math.inf


def can_link(settings, obstacles, positions, key, i, j) -> bool:
    """Whether two living robots are linked: "the integer d^2 <= floor((right side)^2)"."""
    (r0, c0), (r1, c1) = positions[i], positions[j]
    walls = walls_between(obstacles, (r0, c0), (r1, c1))
    reach = reach_squared(settings, i, j, walls, shadowing(settings, key, i, j))
    return (r0 - r1) ** 2 + (c0 - c1) ** 2 <= reach


def links(settings, obstacles, positions, alive, key) -> Grid:
    """Who is linked: "True on the diagonal always; all else False for dead robots"."""
    robots = range(settings.num_agents)
    return [
        [
            i == j
            or (alive[i] and alive[j] and can_link(settings, obstacles, positions, key, i, j))
            for j in robots
        ]
        for i in robots
    ]


def carrying(settings, linked, key, t) -> Grid:
    """The links that carry maps at time t: "message loss removes single links"."""
    robots = range(settings.num_agents)
    return [
        [
            linked[i][j]
            and not (
                i != j and happens(settings.message_loss, key, "message", min(i, j), max(i, j), t)
            )
            for j in robots
        ]
        for i in robots
    ]


def without(linked, alive) -> Grid:
    """The published links: "less the pairs with a robot that failed in this step"."""
    robots = range(len(alive))
    return [[i == j or (linked[i][j] and alive[i] and alive[j]) for j in robots] for i in robots]


# ---------------------------------------------------------------- moves


def may_act(settings, state, robot) -> bool:
    """Whether a robot lives and is in turn: it "may move only at times t with t mod period = 0"."""
    period = per_robot(settings, "move_period")[robot]
    return state.alive[robot] and state.step_count % period == 0


def in_turn(settings, state, actions) -> list[int]:
    """What the actions come to: a move of a robot dead or "outside its period, is a stay"."""
    return [
        STAY if action < STAY and not may_act(settings, state, robot) else action
        for robot, action in enumerate(actions)
    ]


def blocked(state, robot, action) -> bool:
    """The dangers that are visible at time t; "a walker blocks its cell at time t like a robot"."""
    target = shifted(state.positions[robot], COMPASS[action])
    return visible_danger(state, robot, action) or target in state.walkers


def dangers(state, actions) -> list[bool]:
    """Which robots chose a dangerous move; ``actions`` are those in turn."""
    return [
        action < STAY and (blocked(state, robot, action) or contended(state, actions, robot))
        for robot, action in enumerate(actions)
    ]


def action_mask(settings, state) -> Grid:
    """Allowed actions: out of turn "its mask allows no moves"; "a dead one may stay alone"."""
    masks = []
    for robot in range(settings.num_agents):
        may = may_act(settings, state, robot)
        moves = [may and not blocked(state, robot, action) for action in range(STAY)]
        neighbor = any(near for j, near in enumerate(state.linked[robot]) if j != robot)
        masks.append([*moves, True, neighbor])
    return masks


# ---------------------------------------------------------------- walkers


def walker_starts(settings, obstacles, positions, key) -> list[Cell]:
    """Where walkers start: "the free robot-less cells with the smallest keys of their own stream".

    Keys are compared as the signed int64 that they are, as those of the robots' starts.
    """
    free = [
        (r, c)
        for r in range(settings.height)
        for c in range(settings.width)
        if not obstacles[r][c] and (r, c) not in positions
    ]
    if len(free) < settings.num_walkers:
        raise ValueError(f"num_walkers={settings.num_walkers}, but only {len(free)} cells are left")
    stream = name_key("walker-start")
    free.sort(key=lambda cell: combine(key, stream, cell[0] * settings.width + cell[1]))
    return free[: settings.num_walkers]


def walkers_moved(state, positions) -> list[Cell]:
    """Where walkers are after robots moved to ``positions``: "all walkers draw at once".

    "One goes if its cell is inside, no obstacle, holds no robot after the move and no walker before
    it, and no other walker drew it."
    """
    choices = [
        WALKER_MOVES[math.floor(5 * uniform(state.draw_key, "walker", w, state.step_count))]
        for w in range(len(state.walkers))
    ]
    drawn = [shifted(cell, move) for cell, move in zip(state.walkers, choices, strict=True)]
    return [
        target
        if inside(state.obstacles, target)
        and not state.obstacles[target[0]][target[1]]
        and target not in positions
        and target not in state.walkers
        and drawn.count(target) == 1
        else cell
        for cell, target in zip(state.walkers, drawn, strict=True)
    ]


# ---------------------------------------------------------------- start and step


def start(settings, obstacles, positions, draw_key, *, alive=None, walkers=None) -> State:
    """The arena at step 0, every living robot having sensed once.

    A robot that is given as failed has sensed nothing. "Targets are those of the start (all robots,
    none and no walker blocking)", so failed ones count here.
    """
    robots = range(settings.num_agents)
    positions = [tuple(position) for position in positions]
    alive = [True for _ in robots] if alive is None else list(alive)
    if walkers is None:
        walkers = walker_starts(settings, obstacles, positions, draw_key)
    blank = [[UNKNOWN] * settings.width for _ in range(settings.height)]
    maps = [
        sensed(settings, i, obstacles, positions[i], blank) if alive[i] else copied(blank)
        for i in robots
    ]
    return State(
        obstacles=copied(obstacles),
        positions=positions,
        maps=maps,
        unshared=[[0 if i == j else known_cells(maps[i]) for j in robots] for i in robots],
        steps_since_merge=[[0 if i == j else NEVER for j in robots] for i in robots],
        step_count=0,
        alive=alive,
        walkers=[tuple(walker) for walker in walkers],
        linked=links(settings, obstacles, positions, alive, draw_key),
        targets=target_cells(obstacles, positions),
        draw_key=draw_key,
    )


def step(settings, state, actions) -> tuple[State, Events]:
    """One step, in the order of the specification.

    "Dangers and moves from time t; walkers; links; sensing; message loss; merging; failures; then
    rewards, ends, linked, masks and FOV, all over the robots alive after the failures."

    A robot that fails in a step has moved, sensed and merged in it, and its ``dangerous``,
    ``merged``, ``discovered`` and ``received`` tell so; from the next step on they are 0.
    """
    robots = range(settings.num_agents)
    t, key = state.step_count, state.draw_key
    moves = in_turn(settings, state, actions)
    dangerous = dangers(state, moves)
    positions = [
        shifted(state.positions[i], COMPASS[moves[i]])
        if moves[i] < STAY and not dangerous[i]
        else state.positions[i]
        for i in robots
    ]
    walkers = walkers_moved(state, positions)
    linked = links(settings, state.obstacles, positions, state.alive, key)

    maps = [
        sensed(settings, i, state.obstacles, positions[i], state.maps[i])
        if state.alive[i]
        else copied(state.maps[i])
        for i in robots
    ]
    discovered = [known_cells(maps[i]) - known_cells(state.maps[i]) for i in robots]
    unshared = copied(state.unshared)
    since = copied(state.steps_since_merge)
    for i in robots:
        for j in robots:
            if i != j:
                unshared[i][j] += discovered[i]
                since[i][j] = min(NEVER, since[i][j] + 1)

    received = [0 for _ in robots]
    peers = [[] for _ in robots]  # the other members of the robot's network
    for members in networks(carrying(settings, linked, key, t), actions):
        shared = union([maps[i] for i in members])
        for i in members:
            received[i] = known_cells(shared) - known_cells(maps[i])
            maps[i] = copied(shared)
            peers[i] = [j for j in members if j != i]

    alive = [
        state.alive[i] and not happens(settings.failure_rate, key, "failure", i, t) for i in robots
    ]
    after = State(
        obstacles=copied(state.obstacles),
        positions=positions,
        maps=maps,
        unshared=unshared,
        steps_since_merge=since,
        step_count=t + 1,
        alive=alive,
        walkers=walkers,
        linked=without(linked, alive),
        targets=state.targets,
        draw_key=key,
    )
    judged = rewards(settings, state, after, actions, dangerous, peers)
    for i in robots:
        for j in peers[i]:
            unshared[i][j] = 0
            since[i][j] = 0
    merged = [len(peers[i]) > 0 for i in robots]
    return after, Events(dangerous, merged, discovered, received, judged)


# ---------------------------------------------------------------- rewards


def living(state) -> list[int]:
    """The robots that have not failed."""
    return [robot for robot, lives in enumerate(state.alive) if lives]


def rewards(settings, before, after, actions, dangerous, peers) -> dict[str, list[float]]:
    """The rewards of every robot by kind: "a failed robot's own reward is 0".

    ``after`` still holds q as it was before the merges of this step.
    """
    kinds = {
        "case1": lambda i: case1(before, after, i, dangerous),
        "case2": lambda i: case2(settings, before, after, i, actions, dangerous, peers, False),
        "case2-lone-idle": lambda i: case2(
            settings, before, after, i, actions, dangerous, peers, True
        ),
        "team": lambda i: team(before, after, dangerous),
        "progress": lambda i: progress(before, after, dangerous),
        "union": lambda i: union_reward(before, after, dangerous),
    }
    robots = range(settings.num_agents)
    return {
        name: [reward(i) if after.alive[i] else 0.0 for i in robots]
        for name, reward in kinds.items()
    }


def gain(before, after, i) -> int:
    """|M_i^t| - |M_i^(t-1)|, by own sensing and by merging."""
    return known_cells(after.maps[i]) - known_cells(before.maps[i])


def case1(before, after, i, dangerous) -> float:
    """The paper's first reward: "-100 if dangerous", else the growth of the own map."""
    return -100.0 if dangerous[i] else float(gain(before, after, i))


def case2(settings, before, after, i, actions, dangerous, peers, lone_idle) -> float:
    """The paper's second reward; a move out of turn is "not idle in case 2".

    After message loss "a robot left alone is a lone communicator". A member of the network that
    fails in this very step counts in the mean of q: it took part in the merge.
    """
    if dangerous[i]:
        return -10.0
    area = settings.height * settings.width
    if peers[i]:
        mean_unshared = sum(after.unshared[i][j] for j in peers[i]) / len(peers[i])
        return (0.8 + mean_unshared / area) * gain(before, after, i) / area
    if actions[i] == COMMUNICATE and not lone_idle:
        return 0.0
    idle = actions[i] in (STAY, COMMUNICATE)  # a lone communicator comes here only if it is idle
    return gain(before, after, i) / max_discovery(settings, i) - (1.0 if idle else 0.0)


def team(before, after, dangerous) -> float:
    """Growth "over these survivors"; of the dangerous share, N "is their number".

    A dangerous move of a robot that fails in this step does not count.
    """
    robots = living(after)
    largest = max(known_cells(after.maps[i]) for i in robots)
    growth = largest - max(known_cells(before.maps[i]) for i in robots)
    done = any(complete(after.maps[i], after.targets) for i in robots)
    refused = sum(dangerous[i] for i in robots)
    return growth / 40 - (0.0 if done else 0.1) - 0.25 * refused / len(robots)


def progress(before, after, dangerous) -> float:
    """As team, half of the growth being that of the survivors' mean map."""
    robots = living(after)
    largest = max(known_cells(after.maps[i]) for i in robots)
    largest -= max(known_cells(before.maps[i]) for i in robots)
    mean = sum(known_cells(after.maps[i]) for i in robots)
    mean -= sum(known_cells(before.maps[i]) for i in robots)
    mean /= len(robots)
    return team(before, after, dangerous) + (mean - largest) / 80


def union_reward(before, after, dangerous) -> float:
    """As team, half of the growth being that of the union of the survivors' maps."""
    robots = living(after)
    largest = max(known_cells(after.maps[i]) for i in robots)
    largest -= max(known_cells(before.maps[i]) for i in robots)
    whole = known_cells(union([after.maps[i] for i in robots]))
    whole -= known_cells(union([before.maps[i] for i in robots]))
    return team(before, after, dangerous) + (whole - largest) / 80


def team_reward(after, individual) -> float:
    """The mean of the robots' rewards: "over survivors, 0 with none"."""
    robots = living(after)
    return sum(individual[i] for i in robots) / len(robots) if robots else 0.0


# ---------------------------------------------------------------- coverage and ends


def coverages(state) -> dict[str, float]:
    """Shares of the targets: "largest, mean and smallest map, union ... count the living".

    "With none left ... all coverages read 0."
    """
    robots = living(state)
    if not robots:
        return {"largest": 0.0, "union": 0.0, "mean": 0.0, "smallest": 0.0}
    targets = sum(row.count(True) for row in state.targets)
    known = [known_targets(state.maps[i], state.targets) for i in robots]
    together = known_targets(union([state.maps[i] for i in robots]), state.targets)
    return {
        "largest": max(known) / targets,
        "union": together / targets,
        "mean": sum(known) / (targets * len(robots)),
        "smallest": min(known) / targets,
    }


def complete_maps(state) -> list[bool]:
    """Whether the map of each living robot is complete."""
    return [complete(state.maps[i], state.targets) for i in living(state)]


def every_complete(state) -> bool:
    """Whether all are done: "every robot complete means every living one, at least one"."""
    maps = complete_maps(state)
    return len(maps) > 0 and all(maps)


def terminated(settings, state) -> bool:
    """Whether an episode ends by a rule: "with none left the episode is terminated".

    Otherwise when the largest map of a living robot covers the wanted share of the targets.
    """
    if not living(state):
        return True
    if settings.terminate_at_coverage is None:
        return False
    targets = sum(row.count(True) for row in state.targets)
    largest = max(known_targets(state.maps[i], state.targets) for i in living(state))
    return largest >= settings.terminate_at_coverage * targets - TOLERANCE


def reachable_targets(state) -> set[Cell]:
    """Cells that the living can reach, and the 4-neighbours of these: as targets are defined.

    "Failed robots blocking, walkers not"; a failed robot "closes no diagonals".
    """
    passable = free_cells(state.obstacles)
    for (r, c), lives in zip(state.positions, state.alive, strict=True):
        if not lives:
            passable[r][c] = False
    cells = set()
    for robot in living(state):
        for cell in distances(passable, state.obstacles, state.positions[robot]):
            cells.update(shifted(cell, direction) for direction in [(0, 0), *FOUR])
    return cells


def finishable(state) -> bool:
    """Whether "the living can still finish", at least one.

    They can if every target is known to one of them or can still be reached as targets are. That
    they might see a target past a failed robot, or never meet to share, is not considered.
    """
    if not living(state):
        return False
    known = union([state.maps[i] for i in living(state)])
    reachable = reachable_targets(state)
    return all(
        known[r][c] != UNKNOWN or (r, c) in reachable
        for r, row in enumerate(state.targets)
        for c, target in enumerate(row)
        if target
    )


def frame(settings, state, events) -> Frame:
    """All that is published of a state; ``events`` of the step before, None at the start.

    At the start the first sensing counts as discovered, and nothing is terminated.
    """
    robots = range(settings.num_agents)
    first = events is None
    no, none = [False for _ in robots], [0 for _ in robots]
    own = {} if first else events.rewards
    return Frame(
        positions=list(state.positions),
        maps=[copied(map_) for map_ in state.maps],
        fov=[field_of_view(settings, state, robot) for robot in robots],
        linked=copied(state.linked),
        alive=list(state.alive),
        walkers=list(state.walkers),
        masks=action_mask(settings, state),
        dangerous=no if first else events.dangerous,
        merged=list(no) if first else events.merged,
        discovered=[known_cells(map_) for map_ in state.maps] if first else events.discovered,
        received=none if first else events.received,
        unshared=copied(state.unshared),
        steps_since_merge=copied(state.steps_since_merge),
        rewards=own,
        team_rewards={name: team_reward(state, values) for name, values in own.items()},
        terminated=not first and terminated(settings, state),
        coverages=coverages(state),
        some_complete=any(complete_maps(state)),
        every_complete=every_complete(state),
        finishable=finishable(state),
    )
