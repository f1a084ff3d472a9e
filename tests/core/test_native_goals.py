"""Candidate goals in C: equal in every entry to those of ``core.goals``, which is the reference."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch

from marl_explore.config.shapes import Sight
from marl_explore.core import goals, native
from marl_explore.core.goals import GoalTable, Situation
from marl_explore.core.grid import compass
from marl_explore.core.memory import NOT_SEEN, Sightings, TeamMemory
from marl_explore.core.native import goals as operator
from marl_explore.robot import goals as robot
from marl_explore.robot.plain_goals import plain_goal_table

reason = native.missing("goals")
needs_kernel = pytest.mark.skipif(reason is not None, reason=str(reason))

THIRDS = (1, 1, 1)
"""Shares of unknown, free and occupied cells; paths are short."""
MOSTLY_FREE = (0.03, 0.75, 0.22)
HALF_UNKNOWN = (0.5, 0.45, 0.05)

SQUARE = Sight.square(1)
SENSORS = {
    "3 x 3": lambda team: SQUARE,
    "5 x 5": lambda team: Sight.square(2),
    "7 x 7": lambda team: Sight.square(3),
    "discs": lambda team: Sight("disc", (7.0,)),
    "discs among walls": lambda team: Sight("disc", (7.0,), line_of_sight=True),
    "squares among walls": lambda team: Sight("square", (4.95,), line_of_sight=True),
    "mixed squares": lambda team: Sight("square", (2.2, 3.6, 4.95, 2.2, 5.0, 2.2, 8.0, 6.4)[:team]),
    "mixed discs among walls": lambda team: Sight(
        "disc", (3.0, 8.0, 1.5, 8.0, 3.0, 2.0, 5.5, 8.0)[:team], line_of_sight=True
    ),
}
"""Sights of a team of at most eight."""


class Draw:
    """Random entries of all kinds."""

    def __init__(self, seed):
        self.generator = torch.Generator().manual_seed(seed)

    def below(self, high, *shape):
        return torch.randint(0, high, shape, generator=self.generator)

    def some(self, chance, *shape):
        return torch.rand(*shape, generator=self.generator) < chance

    def cells(self, height, width, *shape):
        return torch.stack((self.below(height, *shape), self.below(width, *shape)), -1)

    def maps(self, shares, *shape):
        shares = torch.tensor(shares, dtype=torch.float32)
        number = torch.Size(shape).numel()
        code = torch.multinomial(shares, number, replacement=True, generator=self.generator)
        return (code - 1).to(torch.int8).view(shape)


def situation(grid, draw, covered=0.3):
    """What robots with maps [*B, N, H, W] could know, drawn at random."""
    *robots, height, width = grid.shape
    team = robots[-1]
    position = draw.cells(height, width, *robots)
    target = position.unsqueeze(-2) + compass(grid.device)
    inside = ((target >= 0) & (target < torch.tensor([height, width]))).all(-1)
    place = draw.cells(height, width, *robots, team)
    step = draw.below(50, *robots, team).masked_fill(draw.some(0.3, *robots, team), NOT_SEEN)
    step.diagonal(dim1=-2, dim2=-1).fill_(NOT_SEEN)
    goal = draw.cells(height, width, *robots)
    memory = TeamMemory(
        seen=Sightings(step, place, draw.some(0.5, *robots, team)),
        known_by=draw.some(0.5, *robots, team, height, width),
        covered=draw.some(covered, *robots, height, width),
        stuck=draw.below(8, *robots),
        known=draw.below(height * width, *robots),
        stalled=draw.below(60, *robots),
        position=position,
        heading=draw.below(9, *robots) - 1,
        goal=goal.masked_fill(draw.some(0.3, *robots, 1), -1),
    )
    taken = draw.some(0.15, *robots, 8) & inside
    return Situation(grid, position, taken, draw.some(0.6, *robots, 8), memory)


def alone_at(cell, grid):
    """A robot of a team of one in a map [H, W]."""
    known = situation(grid.view(1, *grid.shape), Draw(0), covered=0)
    position = torch.tensor([cell])
    nothing = torch.zeros_like(known.taken)
    return Situation(known.grid, position, nothing, ~nothing, known.memory)


def assert_equal(found, expected):
    for name, entry, other in zip(GoalTable._fields, found, expected, strict=True):
        assert entry.dtype == other.dtype, name
        assert entry.equal(other), name


def by_robot(known, sight, find=robot.goal_table):
    """The tables from the arrays of each robot."""
    memory, start = known.memory, known.grid.ndim - 2
    entries = (*known[:4], *memory.seen[:2], memory.known_by, memory.covered, memory.heading)
    flat = [x.flatten(0, start - 1).numpy() for x in (*entries, memory.goal)]
    team = known.grid.shape[-3]
    tables = [
        find(robot.Situation(*row), sight.of(number % team))
        for number, row in enumerate(zip(*flat, strict=True))
    ]
    batch = known.grid.shape[:-2]
    stacked = (torch.from_numpy(np.stack(entry)) for entry in zip(*tables, strict=True))
    return GoalTable(*(entry.view(*batch, *entry.shape[1:]) for entry in stacked))


@pytest.mark.skipif(shutil.which("cc") is None, reason="the kernel is built where there is a cc")
def test_the_kernel_is_built():
    assert native.missing("goals") is None


# ------------------------------------------------------------------------- equality


@needs_kernel
@pytest.mark.parametrize("team", [1, 2, 3, 4, 8])
@pytest.mark.parametrize("sensors", SENSORS)
@pytest.mark.parametrize("shares", [THIRDS, MOSTLY_FREE, HALF_UNKNOWN])
def test_random_situations_agree_with_torch(team, sensors, shares):
    sight = SENSORS[sensors](team)
    draw = Draw(team + 10 * sight.radius)
    for height, width, covered in ((12, 12, 0.3), (9, 13, 0), (7, 30, 0.9), (3, 5, 0.5)):
        known = situation(draw.maps(shares, 4, team, height, width), draw, covered)
        expected = goals.goal_table(known, sight)
        assert_equal(operator.goal_table(known, sight), expected)
        assert_equal(by_robot(known, sight), expected)
        assert_equal(by_robot(known, sight, plain_goal_table), expected)


@needs_kernel
@pytest.mark.parametrize("radius", [1, 2, 3])
@pytest.mark.parametrize(
    "size", [(33, 17), (64, 64), (20, 65), (9, 127), (5, 128), (1, 300), (300, 1), (1, 1), (2, 2)]
)
def test_sizes_agree_with_torch(size, radius):
    """Rows that fill a word of 64 cells, less than one, and more."""
    draw, sight = Draw(radius), Sight.square(radius)
    for shares in (MOSTLY_FREE, (0.1, 0.85, 0.05), (0.01, 0.99, 0)):
        known = situation(draw.maps(shares, 3, *size), draw, covered=0.2)
        assert_equal(operator.goal_table(known, sight), goals.goal_table(known, sight))


@needs_kernel
def test_large_maps_agree_with_torch():
    draw = Draw(0)
    known = situation(draw.maps(MOSTLY_FREE, 2, 128, 128), draw)
    table = operator.goal_table(known, Sight.square(2))
    assert (table.frontiers[..., 4] > 0).all()
    assert_equal(table, goals.goal_table(known, Sight.square(2)))
    assert_equal(by_robot(known, Sight.square(2)), table)
    assert_equal(by_robot(known, Sight.square(2), plain_goal_table), table)


@needs_kernel
@pytest.mark.parametrize(("height", "width"), [(31, 31), (9, 70)])
def test_long_paths_agree_with_torch(height, width):
    grid = torch.zeros(height, width, dtype=torch.int8)
    grid[:, 1::2] = 1
    grid[-1, 1::4], grid[0, 3::4] = 0, 0
    grid[height // 2, -1] = -1
    draw = Draw(0)
    known = situation(grid.expand(3, height, width).contiguous(), draw, covered=0)
    known.position[:], known.taken[:] = 0, False
    expected = goals.goal_table(known, SQUARE)
    assert expected.frontiers[..., 2].max() > 255
    assert_equal(operator.goal_table(known, SQUARE), expected)
    assert_equal(by_robot(known, SQUARE, plain_goal_table), expected)


@needs_kernel
@pytest.mark.parametrize("length", [1, 62, 63, 64, 65, 66, 127, 128, 300])
def test_pockets_agree_with_torch(length):
    """A corridor of unseen cells beside many candidates, of about the size that is large."""
    grid = torch.zeros(3, 320, dtype=torch.int8)
    grid[1, :length] = -1
    known = alone_at((0, 0), grid)
    table = operator.goal_table(known, SQUARE)
    assert table.frontiers[..., 8].max() == min(length, 64)
    assert_equal(table, goals.goal_table(known, SQUARE))


@needs_kernel
def test_all_covered_agrees_with_torch():
    draw = Draw(1)
    known = situation(draw.maps((0.1, 0.8, 0.1), 40, 3, 6, 6), draw, covered=0.97)
    table = operator.goal_table(known, SQUARE)
    assert table.all_covered.any()
    assert not table.all_covered.all()
    assert_equal(table, goals.goal_table(known, SQUARE))


@needs_kernel
def test_a_teammate_may_have_been_seen_on_an_obstacle():
    """Its paths begin there as anywhere else: docs/goals.md."""
    grid = torch.tensor([[1, 0], [0, -1]], dtype=torch.int8).expand(1, 2, 2, 2)
    known = situation(grid, Draw(0), covered=0)
    known.position[:] = torch.tensor([1, 0])
    known.taken[:] = False
    step = torch.tensor([[[NOT_SEEN, 0], [0, NOT_SEEN]]])
    seen = known.memory.seen._replace(step=step, cell=torch.zeros_like(known.memory.seen.cell))
    known = known._replace(grid=grid, memory=known.memory._replace(seen=seen))
    table = operator.goal_table(known, SQUARE)
    assert table.frontiers[0, 0, 0, :3].tolist() == [0, 1, 1]
    assert table.rivals[0, 0, 0, :, 0].tolist() == [-1, 1]
    known.position[:] = torch.tensor([0, 1])
    table = operator.goal_table(known, SQUARE)
    assert table.frontiers[0, 0, 0, :3].tolist() == [1, 0, 1]
    assert table.rivals[0, 0, 0, :, 0].tolist() == [-1, 1]
    assert_equal(by_robot(known, SQUARE, plain_goal_table), table)


# ------------------------------------------------------------------------- operator


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@needs_kernel
@pytest.mark.parametrize("number", [2, 3])
def test_threads_share_the_robots(threads, number):
    draw = Draw(0)
    known = situation(draw.maps(THIRDS, operator.ROBOTS_PER_THREAD * 3 + 1, 1, 6, 7), draw)
    threads(1)
    expected = operator.goal_table(known, SQUARE)
    threads(number)
    assert_equal(operator.goal_table(known, SQUARE), expected)
    assert_equal(expected, goals.goal_table(known, SQUARE))


def flat(known):
    """The operator's inputs."""
    memory = known.memory
    rest = (memory.known_by, memory.covered, memory.heading, memory.goal)
    return [*known[:4], *memory.seen[:2], *rest]


@needs_kernel
def test_inputs_need_not_be_contiguous():
    draw = Draw(0)
    known = situation(draw.maps(MOSTLY_FREE, 3, 2, 6, 7), draw)
    strided = [x.repeat_interleave(2, -1)[..., ::2] for x in flat(known)]
    assert not any(x.is_contiguous() for x in strided)
    seen = known.memory.seen._replace(step=strided[4], cell=strided[5])
    names = ("known_by", "covered", "heading", "goal")
    memory = known.memory._replace(seen=seen, **dict(zip(names, strided[6:], strict=True)))
    expected = operator.goal_table(known, Sight.square(2))
    assert_equal(operator.goal_table(Situation(*strided[:4], memory), Sight.square(2)), expected)


@needs_kernel
def test_any_number_of_batch_dimensions():
    draw = Draw(0)
    maps = torch.zeros(0, 3, 6, 7, dtype=torch.int8)
    assert operator.goal_table(situation(maps, draw), SQUARE).frontiers.shape == (0, 3, 24, 14)
    known = situation(draw.maps(MOSTLY_FREE, 2, 5, 3, 6, 7), draw)
    table = operator.goal_table(known, SQUARE)
    assert table.rivals.shape == (2, 5, 3, 24, 3, 2)
    assert_equal(table, goals.goal_table(known, SQUARE))


@needs_kernel
def test_the_operator_fits_torch():
    draw = Draw(0)
    known = situation(draw.maps(MOSTLY_FREE, 2, 3, 6, 7), draw)
    gains = draw.below(9, 2, 3, 8)
    for more in ((None, [1]), (gains, [1, 2, 3])):
        torch.library.opcheck(torch.ops.marl_explore.goal_table, (*flat(known), *more))


@needs_kernel
@pytest.mark.parametrize("sensors", ["3 x 3", "mixed discs among walls"])
def test_vmap(sensors):
    draw, sight = Draw(0), SENSORS[sensors](3)
    known = situation(draw.maps(MOSTLY_FREE, 4, 3, 6, 7), draw)
    expected = operator.goal_table(known, sight)
    assert_equal(torch.vmap(lambda x: operator.goal_table(x, sight))(known), expected)


@needs_kernel
def test_vmap_over_one_entry():
    draw = Draw(0)
    known = situation(draw.maps(MOSTLY_FREE, 4, 3, 6, 7), draw)
    expected = operator.goal_table(known, SQUARE)
    one_goal = torch.vmap(
        lambda goal: operator.goal_table(
            Situation(*(x[0] for x in known[:4]), memory_of(known.memory, 0, goal)), SQUARE
        )
    )(known.memory.goal)
    assert one_goal.frontiers.shape == expected.frontiers.shape
    for row, goal in enumerate(known.memory.goal):
        single = Situation(*(x[0] for x in known[:4]), memory_of(known.memory, 0, goal))
        table = operator.goal_table(single, SQUARE)
        assert_equal(GoalTable(*(entry[row] for entry in one_goal)), table)


def memory_of(memory, row, goal):
    """One row of a batch of memories, with another goal."""
    seen = Sightings(*(x[row] for x in memory.seen))
    return TeamMemory(seen, *(x[row] for x in memory[1:]))._replace(goal=goal)


def test_fake_tensors_have_the_shapes():
    from torch._subclasses.fake_tensor import FakeTensorMode

    draw = Draw(0)
    known = situation(draw.maps(MOSTLY_FREE, 5, 3, 6, 7), draw)
    with FakeTensorMode() as mode:
        fake = [mode.from_tensor(x) for x in flat(known)]
        tables = torch.ops.marl_explore.goal_table(*fake, None, [1])
    shapes = [tuple(table.shape) for table in tables]
    assert shapes == [(5, 3, 24, 14), (5, 3, 24, 3, 2), (5, 3, 3, 2), (5, 3)]
    assert [table.dtype for table in tables] == [torch.int32] * 3 + [torch.bool]


# --------------------------------------------------------------------------- errors


def small():
    draw = Draw(0)
    return situation(draw.maps(MOSTLY_FREE, 2, 3, 6, 7), draw)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("grid", torch.zeros(2, 3, 6, 7), r"grid must be torch.int8 of shape \(2, 3, 6, 7\)"),
        (
            "position",
            torch.zeros(2, 3).long(),
            r"position .* of shape \(2, 3, 2\).* got .*\(2, 3\)",
        ),
        ("taken", torch.zeros(2, 3, 8), "taken must be torch.bool"),
        ("allowed", torch.zeros(2, 3, 10).bool(), r"allowed .* got torch.bool of shape \(2, 3, 10"),
        ("allowed", torch.zeros(2, 3, 8, device="meta").bool(), "on the CPU, got .* on meta"),
    ],
)
def test_other_inputs_are_refused(name, value, message):
    with pytest.raises(ValueError, match=message):
        operator.goal_table(small()._replace(**{name: value}), SQUARE)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("known_by", torch.zeros(2, 3, 6, 7).bool(), r"known_by .* of shape \(2, 3, 3, 6, 7\)"),
        ("covered", torch.zeros(2, 3, 6, 7), "covered must be torch.bool"),
        ("heading", torch.zeros(2, 3).int(), "heading must be torch.int64"),
        ("goal", torch.zeros(2, 2).long(), "goal must be torch.int64"),
        ("seen", Sightings(torch.zeros(2), *[torch.zeros(2)] * 2), "seen.step must be torch.int64"),
    ],
)
def test_another_memory_is_refused(name, value, message):
    known = small()
    with pytest.raises(ValueError, match=message):
        operator.goal_table(known._replace(memory=known.memory._replace(**{name: value})), SQUARE)


def first_robot(known):
    return robot.Situation(*(x[0, 0].numpy() for x in flat(known)))


@pytest.mark.parametrize("name", robot.Situation._fields[1:])
def test_arrays_of_other_shapes_are_refused(name):
    known = first_robot(small())
    wrong = "seen_cell" if name == "seen_step" else name  # which gives the size of the team
    value = np.concatenate([np.atleast_1d(getattr(known, name))] * 2)
    with pytest.raises(ValueError, match=f"{wrong} must have the shape"):
        robot.goal_table(known._replace(**{name: value}), SQUARE)


@needs_kernel
@pytest.mark.parametrize("find", [robot.goal_table, plain_goal_table])
@pytest.mark.parametrize("cell", [(-1, 0), (0, 7), (6, 0), (10**9, -(10**9))])
def test_cells_outside_the_map_are_refused(cell, find):
    known = small()
    known.position[0, 0] = torch.tensor(cell)
    with pytest.raises(ValueError, match="a position is outside its map of 6 x 7 cells"):
        operator.goal_table(known, SQUARE)
    with pytest.raises(ValueError, match="a position is outside its map of 6 x 7 cells"):
        find(first_robot(known), SQUARE)
    known = small()
    known.memory.seen.cell[0, 0, 2] = torch.tensor(cell)
    known.memory.seen.step[0, 0, 2] = NOT_SEEN
    operator.goal_table(known, SQUARE)  # never seen: the cell does not matter
    known.memory.seen.step[0, 0, 2] = 0
    with pytest.raises(ValueError, match="a teammate was seen outside the map of 6 x 7 cells"):
        operator.goal_table(known, SQUARE)
    with pytest.raises(ValueError, match="a teammate was seen outside the map of 6 x 7 cells"):
        find(first_robot(known), SQUARE)


def test_a_radius_below_one_is_refused():
    known = small()
    with pytest.raises(ValueError, match="radius=0 is not at least 1"):
        operator.goal_table(known, Sight.square(0))
    with pytest.raises(ValueError, match="radius=0 is not at least 1"):
        robot.goal_table(first_robot(known), Sight.square(0))


@needs_kernel
def test_ranges_of_another_team_are_refused():
    with pytest.raises(ValueError, match="sight has 2 ranges, and the team 3 robots"):
        operator.goal_table(small(), SENSORS["mixed squares"](2))


def test_without_a_kernel_the_operator_says_why(monkeypatch):
    monkeypatch.setattr(native, "_load", lambda name: OSError("it was not built"))
    assert native.missing("goals") == "it was not built"
    with pytest.raises(RuntimeError, match="native kernel cannot be used: it was not built"):
        operator.goal_table(small(), SQUARE)
