"""The memory of the team: against the oracle on random observations, and by hand."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.config.shapes import Sight
from marl_explore.core.memory import (
    NOT_SEEN,
    PATIENCE_STEPS,
    Observation,
    blank_memory,
    remember,
    surely_seen,
)
from marl_explore.core.world import NEVER
from tests.helpers import goal_oracle
from tests.helpers.boards import map_cells
from tests.helpers.goal_implementations import Chance, next_robot_memory, robot_memory
from tests.helpers.strategies import repeatable, sights

NOW = 20
SQUARE = Sight.square(1)


def random_observation(chance, teams, robots, height, width, position):
    """Any observation; links and merges need not even be mutual."""
    pairs = (teams, robots, robots)
    since = torch.where(chance.flags(0.3, *pairs), 0, chance.integers(1, 30, *pairs))
    since[chance.flags(0.3, *pairs)] = NEVER
    return Observation(
        now=torch.full((teams, 1), NOW),
        grid=chance.integers(-1, 1, teams, robots, height, width).to(torch.int8),
        position=position,
        linked=chance.flags(0.5, *pairs) | torch.eye(robots).bool(),
        since=since.masked_fill(torch.eye(robots).bool(), 0),
    )


@st.composite
def observed_teams(draw):
    """A memory, an observation, flags of frontiers that are all covered, and the team's sight."""
    height, width = draw(st.integers(1, 12)), draw(st.integers(1, 12))
    teams, robots = draw(st.integers(1, 3)), draw(st.integers(1, 6))
    chance = Chance(draw(st.integers(0, 2**32 - 1)))
    position = chance.cells(height, width, teams, robots)
    before = chance.memory(position, height, width, NOW)
    # most robots make a move at most, as in an episode; some appear anywhere
    moved = position + chance.integers(-1, 1, teams, robots, 2)
    moved = torch.minimum(moved.clamp_min(0), torch.tensor([height, width]) - 1)
    anywhere = chance.flags(0.1, teams, robots)
    moved[anywhere] = chance.cells(height, width, teams, robots)[anywhere]
    # some teammates are where they were seen
    waiting = chance.flags(0.5, teams, robots)
    for robot in range(robots):
        last = before.seen.cell[:, 0, robot]
        moved[:, robot] = torch.where(waiting[:, robot, None], last, moved[:, robot])
    observed = random_observation(chance, teams, robots, height, width, moved)
    squares = st.integers(1, 3).map(Sight.square)
    return before, observed, chance.flags(0.7, teams, robots), draw(squares | sights(robots))


def robots_of(memory):
    """Indices of arena and robot."""
    teams, robots = memory.stuck.shape
    return [(team, robot) for team in range(teams) for robot in range(robots)]


# ---------------------------------------------------------------- against the oracle


@repeatable(max_examples=300)
@given(team=observed_teams())
def test_any_observation_is_remembered_as_the_reference_does(team):
    before, observed, all_covered, sight = team
    after = remember(before, observed, all_covered, sight)
    for index in robots_of(after):
        expected = next_robot_memory(
            robot_memory(before, *index), observed, *index, all_covered[index].item(), sight
        )
        assert robot_memory(after, *index) == expected


@repeatable(max_examples=30)
@given(team=observed_teams())
def test_a_blank_memory_is_that_of_the_reference(team):
    _, observed, _, _ = team
    blank = blank_memory(observed.grid, observed.position)
    for arena, robot in robots_of(blank):
        position = tuple(observed.position[arena, robot].tolist())
        expected = goal_oracle.blank(observed.position.shape[1], position)
        assert robot_memory(blank, arena, robot) == expected


def test_dtypes_and_shapes_stay_the_same_from_the_blank_memory_on():
    chance = Chance(0)
    position = chance.cells(5, 7, 2, 3)
    observed = random_observation(chance, 2, 3, 5, 7, position)
    blank = blank_memory(observed.grid, position)
    after = remember(blank, observed, chance.flags(0.5, 2, 3), SQUARE)
    for memory in (blank, after):
        assert described(memory.seen) == {
            "step": (torch.int64, (2, 3, 3)),
            "cell": (torch.int64, (2, 3, 3, 2)),
            "waited": (torch.bool, (2, 3, 3)),
        }
        assert described(memory._replace(seen=torch.zeros(0))) == {
            "seen": (torch.float32, (0,)),
            "known_by": (torch.bool, (2, 3, 3, 5, 7)),
            "covered": (torch.bool, (2, 3, 5, 7)),
            "stuck": (torch.int64, (2, 3)),
            "known": (torch.int64, (2, 3)),
            "stalled": (torch.int64, (2, 3)),
            "position": (torch.int64, (2, 3, 2)),
            "heading": (torch.int64, (2, 3)),
            "goal": (torch.int64, (2, 3, 2)),
        }


def described(tensors):
    return {name: (tensor.dtype, tuple(tensor.shape)) for name, tensor in tensors._asdict().items()}


def flat(memory):
    """All tensors of a memory by name."""
    entries = memory._asdict()
    return {**entries.pop("seen")._asdict(), **entries}


@repeatable(max_examples=30)
@given(team=observed_teams())
def test_remembering_leaves_its_inputs_as_they_were(team):
    before, observed, all_covered, sight = team
    inputs = [*flat(before).values(), *observed, all_covered]
    copies = [tensor.clone() for tensor in inputs]
    remember(before, observed, all_covered, sight)
    assert all(tensor.equal(copy) for tensor, copy in zip(inputs, copies, strict=True))


@repeatable(max_examples=30)
@given(team=observed_teams(), seed=st.integers(0, 2**32 - 1))
def test_a_robot_remembers_nothing_that_it_does_not_observe(team, seed):
    """Everything else may be different: other maps, unlinked robots, and what others remember."""
    before, observed, all_covered, sight = team
    chance = Chance(seed)
    teams, robots, height, width = observed.grid.shape
    other = chance.memory(chance.cells(height, width, teams, robots), height, width, NOW)
    elsewhere = random_observation(
        chance, teams, robots, height, width, chance.cells(height, width, teams, robots)
    )
    after = remember(before, observed, all_covered, sight)
    for robot in range(robots):

        def only_own(own, others, robot=robot):
            return others.index_copy(1, torch.tensor([robot]), own[:, robot : robot + 1])

        observes = observed.linked[:, robot].clone()
        observes[:, robot] = True
        changed = observed._replace(
            grid=only_own(observed.grid, elsewhere.grid),
            position=torch.where(observes[..., None], observed.position, elsewhere.position),
            linked=only_own(observed.linked, elsewhere.linked),
            since=only_own(observed.since, elsewhere.since),
        )
        mixed = mixed_memory(before, other, only_own)
        flags = only_own(all_covered, ~all_covered)
        changed_after = remember(mixed, changed, flags, sight)
        for arena in range(teams):
            expected = robot_memory(after, arena, robot)
            assert robot_memory(changed_after, arena, robot) == expected


def mixed_memory(memory, other, choose):
    """A memory with every tensor chosen from two."""
    chosen = {
        name: choose(getattr(memory, name), getattr(other, name)) for name in memory._fields[1:]
    }
    seen = [choose(*pair) for pair in zip(memory.seen, other.seen, strict=True)]
    return memory._replace(seen=memory.seen._make(seen), **chosen)


# ---------------------------------------------------------------- by hand


class Team:
    """Two robots on a row of nine cells, seen from robot 0; its map is drawn."""

    def __init__(self, board="........."):
        self.grid = map_cells(board).expand(1, 2, 1, 9)
        self.memory = blank_memory(self.grid, torch.tensor([[[0, 0], [0, 8]]]))

    def observe(self, now, own, mate, linked, all_covered=False, since=NEVER):
        """Robot 0's memory after it observed the columns of both robots."""
        observed = Observation(
            now=torch.tensor([[now]]),
            grid=self.grid,
            position=torch.tensor([[[0, own], [0, mate]]]),
            linked=torch.tensor([[[True, linked], [linked, True]]]),
            since=torch.tensor([[[0, since], [since, 0]]]),
        )
        self.memory = remember(self.memory, observed, torch.tensor([[all_covered] * 2]), SQUARE)
        return robot_memory(self.memory, 0, 0)


def columns(cells):
    return sorted(column for _, column in cells)


def test_the_constants_are_those_of_the_page():
    assert (NOT_SEEN, PATIENCE_STEPS) == (-1_000_000, 8)


def test_sightings_keep_the_last_step_in_which_a_teammate_was_linked_and_its_cell():
    team = Team()
    memory = team.observe(0, own=0, mate=8, linked=False)
    assert memory.seen_step == [NOT_SEEN, NOT_SEEN]
    memory = team.observe(1, own=0, mate=6, linked=True)
    assert (memory.seen_step, memory.seen_cell[1]) == ([NOT_SEEN, 1], (0, 6))
    memory = team.observe(2, own=0, mate=7, linked=False)
    assert (memory.seen_step, memory.seen_cell[1]) == ([NOT_SEEN, 1], (0, 6))


def test_a_teammate_waits_if_it_is_linked_in_the_same_cell_in_two_steps_in_a_row():
    team = Team()
    waited = [
        team.observe(now, own=0, mate=mate, linked=linked).waited[1]
        for now, (mate, linked) in enumerate(
            [(4, True), (4, True), (4, True), (5, True), (5, False), (5, True), (5, True)]
        )
    ]
    #        first, waits, waits, moved, not linked, not linked one step ago, waits
    assert waited == [False, True, True, False, False, False, True]


def test_cells_in_view_of_a_linked_teammate_are_covered_and_known_by_it():
    team = Team()
    memory = team.observe(0, own=0, mate=5, linked=True)
    assert columns(memory.covered) == columns(memory.known_by[1]) == [4, 5, 6]
    memory = team.observe(1, own=0, mate=6, linked=False)
    assert columns(memory.covered) == [4, 5, 6]
    memory = team.observe(2, own=0, mate=8, linked=True)
    assert columns(memory.covered) == columns(memory.known_by[1]) == [4, 5, 6, 7, 8]
    assert memory.known_by[0] == set(), "the own cells are in the own map"


def seen_on_a_row(board, sight, places, robot=0, mate=1):
    """Columns that a robot is sure that a linked teammate sees; all have the same map of a row."""
    grid = map_cells(board).expand(1, len(places), 1, -1)
    position = torch.tensor([[[0, column] for column in places]])
    linked = torch.ones(1, len(places), len(places), dtype=torch.bool)
    cells = surely_seen(grid, position, linked, sight)[0, robot, mate, 0]
    return cells.nonzero().flatten().tolist()


@pytest.mark.parametrize(
    ("board", "line_of_sight", "seen"),
    [
        (".........", True, [1, 2, 3, 4, 5, 6, 7]),
        ("..#...#..", True, [2, 3, 4, 5, 6]),
        ("..?...?..", True, [2, 3, 4, 5, 6]),  # there may be obstacles, which it would see
        ("...???...", True, [3, 4, 5]),  # but none where it stands
        ("..#?.?#..", False, [1, 2, 3, 4, 5, 6, 7]),
    ],
)
def test_a_robot_is_sure_of_what_no_unknown_obstacle_could_hide_from_a_teammate(
    board, line_of_sight, seen
):
    sight = Sight("disc", (3.0,), line_of_sight)
    assert seen_on_a_row(board, sight, places=(0, 4)) == seen


@pytest.mark.parametrize(("robot", "mate", "seen"), [(0, 1, [1, 2, 3, 4, 5]), (1, 0, [0, 1])])
def test_teammates_see_with_their_own_sensors(robot, mate, seen):
    sight = Sight("disc", (1.5, 2.0))
    assert seen_on_a_row(".........", sight, (0, 3), robot, mate) == seen


@pytest.mark.parametrize(("since", "known"), [(0, [0, 1, 4]), (1, []), (NEVER, [])])
def test_after_a_merge_the_teammate_knows_the_own_map_and_covers_nothing_more(since, known):
    """In a relay the teammate need not be linked."""
    memory = Team("..??#????").observe(3, own=0, mate=8, linked=False, since=since)
    assert columns(memory.known_by[1]) == known
    assert memory.covered == set()


def test_the_heading_is_that_of_the_last_move_that_was_made():
    team = Team()
    own = [0, 1, 1, 0, 5, 5, 6]  # the fifth is no move
    headings = [team.observe(now, c, 8, linked=False).heading for now, c in enumerate(own)]
    assert headings == [-1, 2, 2, 6, 6, 6, 2]


@pytest.mark.parametrize(("direction", "offset"), [*enumerate(goal_oracle.COMPASS)])
def test_every_direction_is_a_heading(direction, offset):
    grid = torch.zeros(1, 1, 3, 3, dtype=torch.int8)
    start = torch.tensor([[[1, 1]]])
    observed = Observation(
        now=torch.tensor([[1]]),
        grid=grid,
        position=start + torch.tensor(offset),
        linked=torch.ones(1, 1, 1, dtype=torch.bool),
        since=torch.zeros(1, 1, 1, dtype=torch.int64),
    )
    after = remember(blank_memory(grid, start), observed, torch.zeros(1, 1).bool(), SQUARE)
    assert after.heading.tolist() == [[direction]]
    assert after.position.equal(observed.position)


def test_covered_cells_are_forgotten_after_eight_steps_in_which_all_frontiers_were_covered():
    team = Team()
    team.observe(0, own=0, mate=5, linked=True)
    for now in range(1, 8):
        memory = team.observe(now, 0, 8, linked=False, all_covered=True)
        assert (memory.stuck, columns(memory.covered)) == (now, [4, 5, 6])
    memory = team.observe(8, 0, 8, linked=False, all_covered=True)
    assert (memory.stuck, memory.covered) == (0, set())
    assert columns(memory.known_by[1]) == [4, 5, 6], "the teammate still knows them"
    memory = team.observe(9, 0, 8, linked=False, all_covered=True)
    assert memory.stuck == 1


def test_what_a_teammate_sees_now_is_covered_though_the_rest_is_forgotten():
    team = Team()
    team.observe(0, own=0, mate=3, linked=True)
    for now in range(1, 8):
        team.observe(now, 0, 8, linked=False, all_covered=True)
    memory = team.observe(8, 0, 7, linked=True, all_covered=True)
    assert (memory.stuck, columns(memory.covered)) == (0, [6, 7, 8])


def test_one_step_with_an_open_frontier_starts_the_count_anew():
    team = Team()
    flags = [False] + [True] * 7 + [False] + [True] * 7
    stuck = [team.observe(now, 0, 8, False, flag).stuck for now, flag in enumerate(flags)]
    assert stuck == [0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7]


def test_the_goal_stays_until_another_is_chosen():
    team = Team()
    assert team.observe(0, own=0, mate=8, linked=True).goal == (-1, -1)
    team.memory = team.memory._replace(goal=torch.tensor([[[0, 3], [0, 4]]]))
    assert team.observe(1, own=1, mate=8, linked=True).goal == (0, 3)
