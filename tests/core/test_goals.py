"""Candidate goals: against the oracle in episodes and on random situations, and by hand."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch
from hypothesis import Phase, find, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from marl_explore import ArenaConfig, ExplorationEnv, Rooms
from marl_explore.config.shapes import Sight
from marl_explore.core.goals import GOAL_COLUMNS, MAX_FRONTIERS, Situation, taken_cells
from marl_explore.core.grid import COMMUNICATE, FREE, NUM_DIRECTIONS, OCCUPIED, UNKNOWN
from marl_explore.core.memory import (
    PATIENCE_STEPS,
    Observation,
    Sightings,
    TeamMemory,
    blank_memory,
    remember,
)
from marl_explore.robot import candidates as robot_candidates
from marl_explore.robot.observation import Observation as RobotObservation
from tests.helpers import goal_oracle
from tests.helpers.boards import map_cells
from tests.helpers.goal_implementations import (
    Chance,
    goal_table,
    next_robot_memory,
    of_robot,
    robot_memory,
    robot_table,
)
from tests.helpers.oracle import COMPASS
from tests.helpers.strategies import repeatable, scenarios, sights
from tests.helpers.wide_worlds import wide_scenarios

N, NE, E, SE, S, SW, W, NW = range(8)


# ---------------------------------------------------------------- episodes


def begin(scenario):
    """An env of a scenario's arenas, and its first observation."""
    env = ExplorationEnv(scenario.config, num_envs=len(scenario.episodes))
    start = TensorDict({"obstacles": scenario.obstacles}, env.batch_size)
    start.set(("agents", "position"), scenario.positions)
    return env, env.reset(start, set_state=True)


def observation_of(td):
    agents = td["agents"]
    return Observation(
        now=td["step_count"],
        grid=agents["map"],
        position=agents["position"],
        linked=agents["linked"],
        since=agents["steps_since_merge"],
    )


def situation_of(td, memory, sight):
    agents = td["agents"]
    grid, position = agents["map"], agents["position"]
    return Situation(
        grid=grid,
        position=position,
        taken=taken_cells(agents["observation", "fov"], grid, position, sight),
        allowed=agents["action_mask"][..., :NUM_DIRECTIONS],
        memory=memory,
    )


def chosen_actions(chance, td, table):
    """Allowed actions: towards one of the nearest candidates, to communicate, or any."""
    chosen = []
    for masks, candidates in zip(
        td["agents", "action_mask"].tolist(), table.frontiers.tolist(), strict=True
    ):
        chosen.append([])
        for mask, rows in zip(masks, candidates, strict=True):
            move = chance.choice(rows[:3])[GOAL_COLUMNS.index("move")]
            wanted = chance.choice([move, move, move, COMMUNICATE, chance.randrange(10)])
            allowed = [action for action, is_allowed in enumerate(mask) if is_allowed]
            chosen[-1].append(wanted if mask[wanted] else chance.choice(allowed))
    return torch.tensor(chosen)


def with_goals(chance, memory):
    """The memory after a policy chose goals: here any cells, and sometimes the goal before."""
    goal = memory.goal.clone()
    *_, height, width = memory.covered.shape
    for arena, robot in robots_of(memory.stuck):
        if chance.random() < 0.5:
            cell = chance.randrange(height), chance.randrange(width)
            goal[arena, robot] = torch.tensor(cell)
    return memory._replace(goal=goal)


def robots_of(entry):
    """Indices of arena and robot of a tensor [B, N, ...]."""
    teams, robots, *_ = entry.shape
    return [(team, robot) for team in range(teams) for robot in range(robots)]


def assert_taken_agrees(td, situation, arena, robot):
    position = tuple(situation.position[arena, robot].tolist())
    fov = td["agents", "observation", "fov"][arena, robot].tolist()
    grid = situation.grid[arena, robot].tolist()
    taken = goal_oracle.blocked_beside(fov, grid, position)
    assert situation.taken[arena, robot].tolist() == [
        goal_oracle.neighbour(position, direction) in taken for direction in range(8)
    ]


def follow_the_reference(env, td, steps, seed, patience=PATIENCE_STEPS):
    """Memories and tables of some steps, next to those of the oracle."""
    sight, chance = env.config.sight, random.Random(seed)
    memory = blank_memory(td["agents", "map"], td["agents", "position"])
    all_covered = torch.zeros(memory.stuck.shape, dtype=torch.bool)
    robots = robots_of(memory.stuck)
    expected = {index: robot_memory(memory, *index) for index in robots}
    was_covered = dict.fromkeys(robots, False)
    for _ in range(steps):
        observed = observation_of(td)
        memory = remember(memory, observed, all_covered, sight, patience)
        known = (observed.grid != UNKNOWN).unsqueeze(1)
        assert not (memory.known_by & ~known).any(), "what a robot is sure of is true"
        situation = situation_of(td, memory, sight)
        table = goal_table(situation, sight)
        for index in robots:
            expected[index] = next_robot_memory(
                expected[index], observed, *index, was_covered[index], sight, patience
            )
            assert robot_memory(memory, *index) == expected[index]
            assert_taken_agrees(td, situation, *index)
            judged = robot_table(situation, expected[index], *index, sight)
            assert of_robot(table, *index) == judged
            was_covered[index] = judged["all_covered"]
        all_covered = table.all_covered
        memory = with_goals(chance, memory)
        for arena, robot in robots:
            expected[arena, robot].goal = tuple(memory.goal[arena, robot].tolist())
        action = chosen_actions(chance, td, table)
        td = env.step(td.set(("agents", "action"), action))["next"]
    return memory, table


@repeatable(max_examples=100)
@given(
    scenario=scenarios(max_side=12, max_steps=10),
    patience=st.sampled_from((1, 2, PATIENCE_STEPS)),
    seed=st.integers(0, 2**32 - 1),
)
def test_memories_and_tables_of_whole_episodes_agree_with_the_reference(scenario, patience, seed):
    follow_the_reference(*begin(scenario), len(scenario.actions), seed, patience)


@repeatable(max_examples=30)
@given(
    scenario=wide_scenarios(max_side=14, max_robots=4, max_steps=6),
    seed=st.integers(0, 2**32 - 1),
)
def test_episodes_of_the_wider_world_agree_with_the_reference(scenario, seed):
    start = scenario.start()
    agents = {key: start.pop(key) for key in ("position", "alive")}
    env = ExplorationEnv(scenario.config, num_envs=len(scenario.episodes))
    td = env.reset(TensorDict({**start, "agents": agents}, env.batch_size), set_state=True)
    follow_the_reference(env, td, len(scenario.actions), seed)


DISC = {"sensing_shape": "disc", "sensing_range": 3.5}


@pytest.mark.parametrize(
    "sensors",
    [
        {"sensing_range": 2.5},
        {"sensing_range": 2.5, "line_of_sight": True},
        DISC,
        {**DISC, "line_of_sight": True},
        {**DISC, "line_of_sight": True, "sensing_range": (1.5, 1.5, 4.0, 4.0)},
        {"sensing_range": (1.1, 1.8, 2.5, 1.1)},
    ],
    ids=["k = 3", "k = 3 and walls", "discs", "discs and walls", "mixed team", "mixed squares"],
)
def test_every_kind_of_sensor_follows_the_reference(sensors):
    config = ArenaConfig(16, 20, num_agents=4, **sensors)
    env = ExplorationEnv(config, arenas=Rooms(config))
    memory, table = follow_the_reference(env, env.reset(), 8, seed=0)
    assert memory.covered.any()
    assert (table.frontiers[..., GOAL_COLUMNS.index("near_gain")] > 4).any()


# ---------------------------------------------------------------- random situations


@st.composite
def situations(draw, max_side=12):
    """Any situation of a batch of teams, and their sight."""
    side = st.integers(8, max_side) | st.integers(1, max_side)
    height, width = draw(side), draw(side)
    teams, robots = draw(st.integers(1, 2)), draw(st.integers(1, 4))
    chance = Chance(draw(st.integers(0, 2**32 - 1)))
    shape = (height, width, teams, robots)
    position = chance.cells(*shape)
    memory = chance.memory(position, height, width)
    grid = torch.full((teams, robots, height, width), FREE, dtype=torch.int8)
    if draw(st.booleans()):
        grid[..., serpentine(height, width)] = OCCUPIED
    grid[chance.flags(draw(st.integers(0, 45)) / 100, *grid.shape)] = OCCUPIED
    scattered = chance.flags(0.1, *grid.shape)
    grid[chance.patches(*shape) if draw(st.booleans()) else scattered] = UNKNOWN
    for index in robots_of(position):
        grid[index][tuple(position[index])] = FREE
    taken = chance.flags(0.2, teams, robots, NUM_DIRECTIONS) & free_beside(grid, position)
    allowed = chance.flags(0.7, teams, robots, NUM_DIRECTIONS)
    if draw(st.integers(0, 2)) == 0:
        memory = memory._replace(covered=torch.zeros_like(memory.covered))
    squares = st.integers(1, 3).map(Sight.square)
    return Situation(grid, position, taken, allowed, memory), draw(squares | sights(robots))


def serpentine(height, width):
    """Walls in every second row, with a gap at one end and at the other in turn, bool [H, W]."""
    walls = torch.zeros(height, width, dtype=torch.bool)
    walls[1::2] = True
    walls[1::4, -1] = walls[3::4, 0] = False
    return walls


def free_beside(grid, position):
    """Whether the cell in every direction is free in the map, bool [B, N, 8]."""
    inside = torch.nn.functional.pad(grid == FREE, (1, 1, 1, 1))
    free = torch.zeros((*position.shape[:2], NUM_DIRECTIONS), dtype=torch.bool)
    for index in robots_of(position):
        row, column = (position[index] + 1).tolist()
        free[index] = torch.stack([inside[index][row + r, column + c] for r, c in COMPASS])
    return free


@repeatable(max_examples=400)
@given(drawn=situations())
def test_tables_of_any_situation_agree_with_the_reference(drawn):
    situation, sight = drawn
    table = goal_table(situation, sight)
    for index in robots_of(table.all_covered):
        judged = robot_table(situation, robot_memory(situation.memory, *index), *index, sight)
        assert of_robot(table, *index) == judged


def column(table, name):
    """One column of the candidates, [X]."""
    is_candidate = table.frontiers[..., GOAL_COLUMNS.index("merged_cells")] > 0
    return table.frontiers[..., GOAL_COLUMNS.index(name)][is_candidate]


def rivals_of(table, situation, entry):
    """One entry of ``rivals`` for candidates and teammates that were seen, [X]."""
    is_candidate = table.frontiers[..., GOAL_COLUMNS.index("merged_cells")] > 0
    seen = situation.memory.seen.step >= 0
    return table.rivals[..., entry][is_candidate.unsqueeze(-1) & seen.unsqueeze(-2)]


EVENTS = {
    "a full list": lambda s, t: (t.frontiers[:, :, -1, 4] > 0).any(),
    "a list that is not full": lambda s, t: (t.frontiers[:, :, 5, 4] > 0).any(),
    "no candidate": lambda s, t: (t.frontiers[:, :, 0, 4] == 0).any(),
    "absorbed cells": lambda s, t: (column(t, "merged_cells") > 2).any(),
    "a large pocket": lambda s, t: (column(t, "pocket") == 64).any(),
    "an isolated candidate": lambda s, t: (column(t, "isolation") > 6).any(),
    "a far candidate": lambda s, t: (column(t, "moves") > 12).any(),
    "a move that is not allowed": lambda s, t: (column(t, "move_allowed") == 0).any(),
    "turning round": lambda s, t: (column(t, "turn") == 4).any(),
    "a last goal": lambda s, t: (column(t, "from_last_goal") >= 0).any(),
    "a rival that knows": lambda s, t: (rivals_of(t, s, 1) == 1).any(),
    "a near rival": lambda s, t: (rivals_of(t, s, 0) < 3).any(),
    "a far rival": lambda s, t: (rivals_of(t, s, 0) > 15).any(),
    "a way": lambda s, t: (t.ways[..., 0] > 8).any(),
    "all covered": lambda s, t: t.all_covered.any(),
    "a taken cell": lambda s, t: s.taken.any(),
}


@pytest.mark.parametrize("event", EVENTS)
def test_random_situations_hold_every_event(event):
    """Agreement with the oracle would prove little if full lists or rivals never came up."""

    def happens(drawn):
        situation, sight = drawn
        return bool(EVENTS[event](situation, goal_table(situation, sight)))

    # raises NoSuchExample if none is found
    find(situations(), happens, settings=settings(repeatable(250), phases=[Phase.generate]))


@repeatable(max_examples=30)
@given(drawn=situations())
def test_a_table_leaves_its_inputs_as_they_were(drawn):
    situation, sight = drawn
    (seen, *remembered), rest = situation.memory, situation[:-1]
    inputs = [*seen, *remembered, *rest]
    copies = [tensor.clone() for tensor in inputs]
    goal_table(situation, sight)
    assert all(tensor.equal(copy) for tensor, copy in zip(inputs, copies, strict=True))


@repeatable(max_examples=30)
@given(drawn=situations())
def test_every_table_holds_integers_of_its_shape(drawn):
    situation, sight = drawn
    table = goal_table(situation, sight)
    teams, robots = situation.position.shape[:2]
    described = {name: (t.dtype, tuple(t.shape)) for name, t in table._asdict().items()}
    assert described == {
        "frontiers": (torch.int32, (teams, robots, 24, 14)),
        "rivals": (torch.int32, (teams, robots, 24, robots, 2)),
        "ways": (torch.int32, (teams, robots, robots, 2)),
        "all_covered": (torch.bool, (teams, robots)),
    }
    assert situation.taken.dtype == torch.bool


# ---------------------------------------------------------------- what a robot does not observe


@repeatable(max_examples=25)
@given(
    scenario=scenarios(max_side=12, max_steps=8),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_robots_goals_depend_on_nothing_that_it_does_not_observe(scenario, seed):
    """The arena beyond its map and the rest of the team are others, its memory and goals are not.

    The other episode has other obstacles wherever the robot's map is unknown, the robots that it
    neither sees nor is linked to stand elsewhere, and all of them know and remember other things.
    """
    sight, chance = scenario.config.sight, random.Random(seed)
    env, td = begin(scenario)
    memory = blank_memory(td["agents", "map"], td["agents", "position"])
    all_covered = torch.zeros(memory.stuck.shape, dtype=torch.bool)
    for _ in scenario.actions:
        before = memory
        memory = remember(before, observation_of(td), all_covered, sight)
        table = goal_table(situation_of(td, memory, sight), sight)
        robot = chance.randrange(scenario.rules.num_agents)
        other_env = ExplorationEnv(scenario.config, num_envs=env.num_envs)
        changed = other_env.reset(another_world(chance, td, robot, scenario.rules), set_state=True)
        *_, height, width = memory.covered.shape
        any_memory = Chance(chance.randrange(2**32)).memory(memory.position, height, width)
        other = remember(
            with_own_row(robot, before, any_memory),
            observation_of(changed),
            with_own_row(robot, all_covered, ~all_covered),
            sight,
        )
        other_table = goal_table(situation_of(changed, other, sight), sight)
        for arena in range(env.num_envs):
            assert robot_memory(other, arena, robot) == robot_memory(memory, arena, robot)
            assert of_robot(other_table, arena, robot) == of_robot(table, arena, robot)
        all_covered = table.all_covered
        td = env.step(td.set(("agents", "action"), chosen_actions(chance, td, table)))["next"]


def with_own_row(robot, own, others):
    """Entries [B, N, ...], or a memory of them: of one robot's own, of the rest the others'."""
    if isinstance(own, (TeamMemory, Sightings)):
        pairs = zip(own, others, strict=True)
        return type(own)(*(with_own_row(robot, mine, theirs) for mine, theirs in pairs))
    mixed = others.clone()
    mixed[:, robot] = own[:, robot]
    return mixed


def another_world(chance, td, robot, rules):
    """A state of episodes in progress in which one robot observes the same."""
    state = td.select(
        "obstacles",
        "step_count",
        ("agents", "map"),
        ("agents", "position"),
        ("agents", "unshared"),
        ("agents", "steps_since_merge"),
    ).clone()
    agents = state["agents"]
    for arena, known in enumerate(agents["map"][:, robot]):
        own = agents["position"][arena, robot].tolist()
        linked = td["agents", "linked"][arena, robot].tolist()

        def observed(cell, own=own):
            near = max(abs(cell[0] - own[0]), abs(cell[1] - own[1])) <= rules.fov_radius
            distance = ((cell[0] - own[0]) ** 2 + (cell[1] - own[1]) ** 2) ** 0.5
            return near or distance <= rules.communication_cells + 1e-9

        cells = goal_oracle.all_cells(known.tolist())
        obstacles = {c for c in cells if known[c] == OCCUPIED}
        obstacles |= {c for c in cells if known[c] == UNKNOWN and chance.random() < 0.3}
        kept = {
            j: tuple(agents["position"][arena, j].tolist())
            for j in range(rules.num_agents)
            if linked[j] or observed(agents["position"][arena, j].tolist())
        }
        obstacles -= set(kept.values())
        hidden = [c for c in cells if not observed(c)]
        chance.shuffle(hidden)
        for j in range(rules.num_agents):
            if j not in kept:
                # a cell that the robot's map has occupied cannot hold another robot
                kept[j] = next(c for c in hidden if known[c] != OCCUPIED)
                hidden.remove(kept[j])
        obstacles -= set(kept.values())
        for cell in cells:
            state["obstacles"][(arena, *cell)] = cell in obstacles
        for j, cell in kept.items():
            agents["position"][arena, j] = torch.tensor(cell)
            if j != robot:
                truth = state["obstacles"][arena].to(torch.int8)
                hides = torch.tensor([[chance.random() < 0.5 for _ in row] for row in known])
                agents["map"][arena, j] = truth.masked_fill(hides, UNKNOWN)
                agents["map"][(arena, j, *cell)] = FREE
                agents["steps_since_merge"][arena, j] = chance.randrange(3)
                agents["unshared"][arena, j] = chance.randrange(3)
    return state


# ---------------------------------------------------------------- by hand


class Drawn:
    """The goals of robot 0 on a drawn map.

    ``@`` is its cell, ``~`` an unknown cell that is covered, and ``R`` a free one that is taken.

    Args:
        board: the drawing.
        radius: half side of the square that it sees (cells).
        seen: {teammate: the cell where it was last seen}.
        knows: {teammate: cells that it surely knows}.
        blocked: moves that are not allowed.
        heading: direction of the last move.
        goal: the last goal.
        robots: of the team.
        sight: of the team, instead of that square.
    """

    def __init__(
        self,
        board,
        radius=1,
        seen=(),
        knows=(),
        blocked=(),
        heading=-1,
        goal=(-1, -1),
        robots=2,
        sight=None,
    ):
        seen, knows = dict(seen), dict(knows)
        lines = board.split()
        cells = {(r, c): symbol for r, line in enumerate(lines) for c, symbol in enumerate(line)}
        own = next(cell for cell, symbol in cells.items() if symbol == "@")
        plain = board.translate(str.maketrans("@~R", ".?."))
        grid = map_cells(plain).expand(1, robots, -1, -1)
        position = torch.tensor(own).expand(1, robots, 2)
        memory = blank_memory(grid, position)
        for cell, symbol in cells.items():
            memory.covered[(0, 0, *cell)] = symbol == "~"
        for j, cell in seen.items():
            memory.seen.step[0, 0, j] = 5
            memory.seen.cell[0, 0, j] = torch.tensor(cell)
        for j, known in knows.items():
            for cell in known:
                memory.known_by[(0, 0, j, *cell)] = True
        memory.heading[0, 0] = heading
        memory.goal[0, 0] = torch.tensor(goal)
        around = [goal_oracle.neighbour(own, direction) for direction in range(8)]
        situation = Situation(
            grid=grid,
            position=position,
            taken=torch.tensor([cells.get(c) == "R" for c in around]).expand(1, robots, 8),
            allowed=torch.tensor([d not in blocked for d in range(8)]).expand(1, robots, 8),
            memory=memory,
        )
        sight = Sight.square(radius) if sight is None else sight
        table = of_robot(goal_table(situation, sight), 0, 0)
        filled = [row for row in table["frontiers"] if row[GOAL_COLUMNS.index("merged_cells")] > 0]
        self.candidates = [dict(zip(GOAL_COLUMNS, row, strict=True)) for row in filled]
        self.rivals = table["rivals"][: len(filled)]
        self.ways = table["ways"]
        self.all_covered = table["all_covered"]
        self.empty_rows = table["frontiers"][len(filled) :], table["rivals"][len(filled) :]
        judged = robot_table(situation, robot_memory(memory, 0, 0), 0, 0, sight)
        assert table == judged

    def of_each(self, *names):
        """Some columns of all candidates."""
        return [tuple(row[name] for name in names) for row in self.candidates]


def test_the_columns_are_those_of_the_page():
    assert GOAL_COLUMNS == (
        "row",
        "column",
        "moves",
        "move",
        "merged_cells",
        "near_gain",
        "middle_gain",
        "far_gain",
        "pocket",
        "isolation",
        "move_gain",
        "move_allowed",
        "turn",
        "from_last_goal",
    )
    assert MAX_FRONTIERS == 24


def test_the_only_candidate_of_a_corridor():
    drawn = Drawn("#@..?#", heading=S, goal=(0, 0))
    expected = [0, 3, 2, E, 1, 1, 1, 1, 1, 20, 0, 1, 2, 3]
    assert drawn.of_each(*GOAL_COLUMNS) == [tuple(expected)]
    assert drawn.empty_rows == ([[0] * 14] * 23, [[[0, 0]] * 2] * 23)


RING = """
    ?????
    ?...?
    ?.@.?
    ?...?
    ?????
"""


def test_candidates_come_in_the_order_of_moves_row_and_column():
    ring = Drawn(RING)
    cells = [(1, 1), (1, 2), (1, 3), (2, 1), (2, 3), (3, 1), (3, 2), (3, 3)]
    assert ring.of_each("row", "column") == cells, "the robot's own cell is none"
    moves = [(1, NW), (1, N), (1, NE), (1, W), (1, E), (1, SW), (1, S), (1, SE)]
    assert ring.of_each("moves", "move") == moves


def test_gains_are_unseen_cells_in_three_squares():
    gains = Drawn(RING).of_each("near_gain", "middle_gain", "far_gain", "move_gain")
    corner, edge = (5, 7, 16, 5), (3, 11, 16, 3)
    assert gains == [corner, edge, corner, edge, edge, corner, edge, corner]


def test_squares_of_gains_end_at_the_arena_and_leave_out_covered_cells():
    drawn = Drawn("""
        @.~
        ??~
    """)
    assert drawn.of_each("column", "near_gain", "far_gain", "pocket") == [(1, 2, 2, 2)]


@pytest.mark.parametrize(("line_of_sight", "gains"), [(False, (3, 4, 4)), (True, (2, 4, 4))])
def test_walls_hide_unseen_cells_from_the_sensor_and_not_from_the_larger_squares(
    line_of_sight, gains
):
    """Of the cells 3, 4, 6 and 8 the sensor reaches to 6, with a wall before it."""
    sight = Sight("disc", (4.0,), line_of_sight)
    drawn = Drawn("@..??#?.?", sight=sight)
    assert drawn.of_each("column", "near_gain", "middle_gain", "far_gain") == [(2, *gains)]
    assert drawn.of_each("move_gain") == [(2,)], "from column 1 it reaches to 5"


def test_a_disc_counts_the_unseen_cells_of_its_shape():
    wide = Drawn(RING, sight=Sight("disc", (2.0,))).of_each("near_gain", "middle_gain")
    assert wide == [(5, 16)] * 8  # a square of the same radius has 7 in the corners, 11 elsewhere


@pytest.mark.parametrize(
    ("heading", "turns"),
    [
        (-1, [-1] * 8),
        (N, [1, 0, 1, 2, 2, 3, 4, 3]),  # NW N NE W E SW S SE
        (NW, [0, 1, 2, 1, 3, 2, 3, 4]),
    ],
)
def test_a_turn_counts_eighths_of_a_circle_the_short_way_round(heading, turns):
    assert Drawn(RING, heading=heading).of_each("turn") == [(turn,) for turn in turns]


@pytest.mark.parametrize(
    ("goal", "distances"), [((-1, -1), [-1] * 8), ((4, 4), [3, 3, 3, 3, 2, 3, 2, 1])]
)
def test_distances_from_the_last_goal_are_straight(goal, distances):
    assert Drawn(RING, goal=goal).of_each("from_last_goal") == [(d,) for d in distances]


# ---------------------------------------------------------------- thinning


def shore(width):
    """A free row along an unknown one: the cell in column c is a frontier c moves away."""
    return "@" + "." * (width - 1) + "\n" + "?" * width


@pytest.mark.parametrize(
    ("radius", "width", "merged"),
    [
        # 3: 4.   5: 6 and, because farther than six moves, 7.   8: 9, 10
        (1, 12, {1: 1, 2: 1, 3: 2, 5: 3, 8: 3, 11: 1}),
        # 5: 6, 7.   8: 9, 10.   11: 12 and, because farther than twelve moves, 13, 14, 15
        (2, 17, {1: 1, 2: 1, 3: 1, 4: 1, 5: 3, 8: 3, 11: 5, 16: 1}),
        # the list is full at 54. 21: 22-31.   32: 33-42.   43: 44-53, 61-63 though 54 is nearer.
        # 54: 55-60, 64-74.   75-79 are dropped
        (10, 80, {**dict.fromkeys(range(1, 21), 1), 21: 11, 32: 11, 43: 14, 54: 18}),
    ],
)
def test_far_cells_are_absorbed_by_the_first_candidate_in_reach(radius, width, merged):
    found = Drawn(shore(width), radius).of_each("row", "column", "merged_cells")
    assert found == [(0, column, cells) for column, cells in merged.items()]


def test_near_cells_absorb_nothing_and_more_than_24_of_them_are_dropped():
    found = Drawn(shore(30), radius=15).of_each("column", "merged_cells")
    assert found == [(column, 1) for column in range(1, 25)]


def test_of_two_candidates_in_reach_the_first_absorbs():
    drawn = Drawn("""
        .@.
        .#.
        .#.
        .#.
        .#.
        ?.?
    """)
    found = drawn.of_each("row", "column", "moves", "merged_cells")
    assert found == [(4, 0, 4, 2), (4, 2, 4, 1)]  # (5, 1) is five moves away, beside both


def test_isolation_is_the_distance_to_the_nearest_candidate_out_of_view():
    found = Drawn(shore(12)).of_each("column", "isolation")
    assert found == [(1, 2), (2, 3), (3, 2), (5, 2), (8, 3), (11, 3)]


@pytest.mark.parametrize(("apart", "isolation"), [(1, 20), (2, 2), (19, 19), (20, 20), (21, 20)])
def test_isolation_is_at_most_20(apart, isolation):
    """Two frontiers on both sides of the robot; side by side they are in view of each other."""
    if apart == 1:
        board = """
            ?.@
            ?.#
        """
    else:
        board = "?.@" + "." * (apart - 1) + "?"
    assert Drawn(board).of_each("isolation") == [(isolation,)] * 2


# ---------------------------------------------------------------- pockets


@pytest.mark.parametrize(
    ("board", "pocket"),
    [
        ("#?### @.??? ##?##", 4),  # above 1, right 4: they only touch at a corner
        ("#?### @.?~? ##?##", 2),
        ("#?### @.~?? ##?##", 1),
        ("??### @.### ??###", 2),
    ],
)
def test_a_pocket_is_the_largest_unseen_region_beside_the_cell(board, pocket):
    assert Drawn(board).of_each("row", "column", "pocket") == [(1, 1, pocket)]


@pytest.mark.parametrize("cells", [1, 63, 64, 65, 200])
def test_a_pocket_counts_at_most_64_cells(cells):
    assert Drawn("@." + "?" * cells).of_each("pocket") == [(min(cells, 64),)]


# ---------------------------------------------------------------- moves


@pytest.mark.parametrize(
    ("blocked", "move", "gain", "is_allowed"),
    [
        ((), SE, 1, 1),
        ((NE, E), SE, 1, 1),
        ((SE,), NE, 0, 1),
        ((SE, NE), E, 0, 1),
        ((NE, E, SE), SE, 1, 0),
        ((N, S, W, NW, SW), SE, 1, 1),
    ],
)
def test_a_first_move_is_allowed_before_it_gains_before_it_is_the_lowest(
    blocked, move, gain, is_allowed
):
    board = """
        ......
        ......
        ..@..?
        ......
        ....?.
    """
    drawn = Drawn(board, blocked=blocked, seen={1: (2, 4)})
    columns = ("row", "column", "moves", "move", "move_gain", "move_allowed")
    assert drawn.of_each(*columns)[0] == (2, 4, 2, move, gain, is_allowed)
    assert drawn.ways[1] == [2, move], "the way there begins by the same rule"


def test_a_robot_in_the_way_closes_its_cell_but_no_diagonal():
    drawn = Drawn("""
        #.?
        @R.
    """)
    assert drawn.of_each("row", "column", "moves", "move") == [(0, 1, 1, NE), (1, 2, 2, NE)]


@pytest.mark.parametrize("board", ["#.? @#.", "@R?", "@#.?"])
def test_places_without_a_path_are_no_candidates(board):
    drawn = Drawn(board)
    assert (drawn.candidates, drawn.all_covered) == ([], False)


def test_an_unknown_cell_closes_no_diagonal():
    drawn = Drawn("""
        #.
        @?
    """)
    assert drawn.of_each("row", "column", "moves", "move") == [(0, 1, 1, NE)]


@pytest.mark.parametrize("border", [0, 1, 2])
def test_taken_cells_look_blocked_and_are_free_in_the_map(border):
    grid = map_cells("""
        ...
        #?.
    """)
    fov = torch.tensor([[1.0, 1, 1], [1, 0, 0], [1, 1, 1]])  # beyond the upper edge all is 1
    fov = torch.nn.functional.pad(fov, (border,) * 4, value=1.0)
    place, sight = torch.tensor([[0, 1]]), Sight.square(1 + border)
    taken = taken_cells(fov.unsqueeze(0), grid.unsqueeze(0), place, sight)
    assert taken.dtype == torch.bool
    assert taken.squeeze(0).nonzero().flatten().tolist() == [SE, W]


@pytest.mark.parametrize(
    ("sight", "seen"),
    [
        (Sight("square", Sight.square(1).ranges_cells, False), True),
        (Sight("square", Sight.square(1).ranges_cells, True), False),  # it is behind a corner
        (Sight("disc", (1.5,), True), False),
    ],
)
def test_a_neighbour_behind_a_corner_is_not_taken(sight, seen):
    """A frontier there would be no candidate, and a robot with no other would stay for ever."""
    grid = map_cells("""
        .#..
        #.??
    """)
    fov = torch.zeros(3, 3)
    fov[0], fov[:, 0], fov[1, 2], fov[2, 1], fov[2, 2] = 1, 1, 1, 1, 1
    cell = torch.tensor([[0, 0]])
    taken = taken_cells(fov[None], grid[None], cell, sight)
    assert taken.squeeze(0).nonzero().flatten().tolist() == [SE] * seen
    rest = np.zeros(10), np.ones(10, bool), grid.numpy(), (0, 0), np.zeros(1), np.zeros(1)
    observed = RobotObservation(fov.numpy(), np.zeros((8, 3)), *rest)
    assert robot_candidates.taken_cells(observed, sight).tolist() == taken.squeeze(0).tolist()


# ---------------------------------------------------------------- teammates


@pytest.mark.parametrize(
    ("board", "all_covered"),
    [
        ("@.~", True),
        ("~.@.~", True),
        ("@.?", False),
        ("~.@.?", False),
        ("@..", False),
        ("@~", False),  # the robot's own cell is no frontier
        ("@#.~", False),
        ("@R~", False),
    ],
)
def test_all_is_covered_if_there_are_frontiers_and_none_is_open(board, all_covered):
    assert Drawn(board).all_covered == all_covered


def test_a_rival_needs_its_path_or_without_one_four_moves_more_than_in_a_straight_line():
    drawn = Drawn(
        "@..?..",
        robots=6,
        seen={1: (0, 5), 2: (0, 0), 3: (0, 3), 4: (0, 2)},
        knows={0: [(0, 2)], 1: [(0, 5)], 2: [(0, 2)], 5: [(0, 2)]},
    )
    assert drawn.of_each("column") == [(2,)]
    assert drawn.rivals == [
        [
            [-1, 0],  # the robot itself
            [3 + 4, 0],  # there is an unknown cell in its way
            [2, 1],
            [1, 0],  # it stood in an unknown cell
            [0, 0],
            [-1, 0],  # they merged maps in a relay, but it was never seen
        ]
    ]


def test_rivals_pass_through_robots_but_not_between_obstacles():
    assert Drawn(".R@.?", seen={1: (0, 0)}).rivals == [[[-1, 0], [3, 0]]]
    between = Drawn(
        """
        #.?
        .#@
        """,
        seen={1: (1, 0)},
    )
    assert between.of_each("row", "column", "moves") == [(0, 1, 1)]
    assert between.rivals == [[[-1, 0], [1 + 4, 0]]]


def test_a_rivals_first_cell_may_be_occupied_in_the_map():
    board = """
        @.?
        ##?
    """
    assert Drawn(board, seen={1: (1, 1)}).rivals == [[[-1, 0], [1, 0]]]


@pytest.mark.parametrize(
    ("seen", "way"),
    [
        ((0, 2), [2, E]),
        ((0, 5), [2 + 3, E]),  # cannot be reached: to the nearest cell, then straight
        ((0, 3), [2 + 1, E]),
        ((0, 0), [0, -1]),
        (None, [0, -1]),
    ],
)
def test_ways_lead_to_the_nearest_cell_that_can_be_reached(seen, way):
    drawn = Drawn("@..#..", seen={1: seen} if seen else {})
    assert drawn.ways == [[0, -1], way]


def test_of_equally_near_cells_a_way_leads_to_the_one_with_fewest_moves_then_the_first():
    walled_off = {1: (1, 4)}  # two cells straight from all of column 2
    first = Drawn("...#. ...#. @..#.", seen=walled_off, blocked=[NE])
    assert first.ways[1] == [2 + 2, NE], "to (0, 2), not to (1, 2) or (2, 2) by E"
    fewest = Drawn("...#. ...#. .@.#.", seen=walled_off, blocked=[NE])
    assert fewest.ways[1] == [1 + 2, NE], "to (1, 2), before (2, 2) by its row"
    here = Drawn("...#. ...#. ..@#.", seen=walled_off)
    assert here.ways[1] == [0, -1], "no cell is nearer than the robot's own"


def test_the_longest_path_of_a_maze():
    """Longer than a byte counts: 17 corridors of 20 cells."""
    rows = [["#" if wall else "." for wall in row] for row in serpentine(33, 20).tolist()]
    rows[0][0], rows[32][19] = "@", "?"
    board = "\n".join("".join(row) for row in rows)
    drawn = Drawn(board, seen={1: (0, 0), 2: (32, 19)}, robots=3)
    # 18 moves east, and 2 diagonal ones round each of 16 corners, and 17 along each other corridor
    moves = 18 + 16 * 2 + 16 * 17
    assert drawn.of_each("row", "column", "moves", "move") == [(32, 18, moves, E)]
    assert drawn.rivals == [[[-1, 0], [moves, 0], [1, 0]]]
    assert drawn.ways == [[0, -1], [0, -1], [moves + 1, E]]


def test_cells_that_nobody_comes_back_with_are_a_goal_again_after_eight_steps():
    """Robot 1 was linked once, in front of the only frontier of robot 0, and never again."""
    grid = torch.stack((map_cells("..???...."), map_cells("........."))).unsqueeze(0)
    position = torch.tensor([[[0, 0], [0, 3]]])
    memory = blank_memory(grid, position)
    all_covered = torch.zeros(1, 2, dtype=torch.bool)
    flags, candidates = [], []
    for now in range(11):
        linked = torch.eye(2, dtype=torch.bool) | (now == 0)
        observed = Observation(
            now=torch.tensor([[now]]),
            grid=grid,
            position=position,
            linked=linked.unsqueeze(0),
            since=torch.tensor([[[0, 50], [50, 0]]]),
        )
        memory = remember(memory, observed, all_covered, Sight.square(1))
        every = torch.ones(1, 2, 8, dtype=torch.bool)
        table = goal_table(Situation(grid, position, ~every, every, memory), Sight.square(1))
        all_covered = table.all_covered
        flags.append(all_covered[0, 0].item())
        candidates.append(table.frontiers[0, 0, :, GOAL_COLUMNS.index("merged_cells")].sum().item())
    assert flags == [True] * 8 + [False] * 3
    assert candidates == [0] * 8 + [1] * 3
