"""Maps heal: what changes in the arena changes in the map, and robots do not stay as walls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from marl_explore import ArenaConfig
from marl_explore.config.constants import FREE, OCCUPIED, UNKNOWN
from marl_explore.robot import Pose
from marl_explore.robot.evidence import Evidence
from marl_explore.robot.geometry import Frame
from marl_explore.robot.knowledge import Knowledge
from marl_explore.robot.messages import Share
from marl_explore.robot.observation import complete, observe
from tests.helpers.boards import ACTIONS, arena, known_map
from tests.helpers.robot_world import PATIENT, World, scripted

LOOKS = PATIENT.evidence.limit


def world_of(board, scripts, **settings):
    obstacles, cells = arena(board)
    config = ArenaConfig(*obstacles.shape, 0.0, num_agents=len(cells))
    policies = [scripted([ACTIONS.index(name) for name in script.split()]) for script in scripts]
    settings = replace(PATIENT, **settings)
    return World(config, obstacles.numpy(), cells.tolist(), policies, settings=settings)


def run_on(world, ticks):
    world.run(world.cores[0].tick + ticks)


ROOM = """
    .....
    .0.#.
    ..#..
    .....
"""


def test_a_door_that_closes_is_closed_and_a_box_that_is_taken_away_is_gone():
    world = world_of(ROOM, ["stay"])
    world.run(20)
    knowledge = world.cores[0].knowledge
    for door, box in (((0, 1), (2, 2)), ((2, 2), (0, 1))):
        world.obstacles[door], world.obstacles[box] = True, False
        run_on(world, LOOKS)
        assert (knowledge.map[door], knowledge.map[box]) == (OCCUPIED, FREE)
        assert np.array_equal(knowledge.map[:3, :3], world.obstacles[:3, :3])
    assert knowledge.changes == 9 + 4
    assert not knowledge.refusals


def test_what_changed_is_told_to_others_and_counted():
    world = world_of("......\n.0..1.\n......\n......", ["talk " + "stay " * 4 + "talk"] * 2)
    world.run(1)
    world.obstacles[3, 0] = True  # nobody sees it
    world.obstacles[1, 0] = True  # robot 0 sees it
    world.run(5)
    assert [core.knowledge.unshared.tolist() for core in world.cores] == [[0, 1], [0, 0]]
    assert [core.knowledge.map[1, 0] for core in world.cores] == [OCCUPIED, FREE]
    world.run(6)
    assert [core.knowledge.map[1, 0] for core in world.cores] == [OCCUPIED, OCCUPIED]
    assert world.cores[0].knowledge.unshared.tolist() == [0, 0]


# ---------------------------------------------------------------- teammates


PAIR = """
    ......
    .0....
    ....1.
    ......
"""


def hide(world, robot, offset=None):
    """Its poses never arrive, or are wrong by an offset (metres)."""
    for core in world.alive():
        if core.robot != robot:
            core.receive = hiding(core.receive, robot, offset)


def hiding(receive, robot, offset):
    def take(event, now):
        if isinstance(event, Pose) and event.robot == robot:
            if offset is None:
                return
            event = replace(event, x=event.x + offset[0], y=event.y + offset[1])
        receive(event, now)

    return take


def put(world, robot, cell):
    x, y = world.frame.centre(cell)
    world.poses[robot] = replace(world.poses[robot], x=x, y=y)


def test_a_robot_whose_pose_was_late_does_not_stay_as_a_wall():
    """Robot 1 is east of robot 0, which hears that it is still where it was, further on."""
    world = world_of(PAIR, ["stay", "stay"])
    world.run(3)
    put(world, 1, (1, 2))
    take = [core.receive for core in world.cores]
    hide(world, 1, offset=(1.0, -0.5))
    run_on(world, LOOKS)
    assert world.cores[0].knowledge.map[1, 2] == OCCUPIED
    for core, receive in zip(world.cores, take, strict=True):
        core.receive = receive
    run_on(world, LOOKS)
    assert world.cores[0].knowledge.map[1, 2] == FREE


def silent(world, since):
    """Robot 1 drives on without a word until it is east of robot 0."""
    world.run(2)
    hide(world, 1)
    world.now += since
    put(world, 1, (1, 2))


def test_a_robot_that_is_not_heard_is_no_wall_where_it_can_be():
    world = world_of(PAIR, ["stay", "stay"])
    silent(world, 10.0)
    run_on(world, 20)
    assert (world.cores[0].knowledge.map[:3, :3] == FREE).all()


def test_a_robot_that_is_not_heard_hides_nothing_that_is_further_than_it_can_be():
    """It was 1 m away a second ago, and a box is put beside robot 0."""
    world = world_of(PAIR, ["stay", "stay"])
    world.run(2)
    hide(world, 1)
    world.now += 1.0
    world.obstacles[1, 2] = True
    run_on(world, LOOKS)
    assert world.cores[0].knowledge.map[1, 2] == OCCUPIED


def test_a_robot_that_is_not_heard_for_long_is_an_obstacle_like_any_other():
    world = world_of(PAIR, ["stay", "stay"], mate_patience=60.0)
    silent(world, 61.0)
    run_on(world, LOOKS)
    assert world.cores[0].knowledge.map[1, 2] == OCCUPIED


def test_a_robot_that_is_heard_again_is_no_obstacle():
    world = world_of(PAIR, ["stay", "stay"])
    take = world.cores[0].receive
    silent(world, 61.0)
    run_on(world, LOOKS)
    world.cores[0].receive = take
    run_on(world, LOOKS)
    assert world.cores[0].knowledge.map[1, 2] == FREE


# ---------------------------------------------------------------- the last frontier


@pytest.mark.parametrize(
    ("board", "is_complete"),
    [
        ("...\n.@.\n...", True),
        ("...\n.@?\n...", False),
        ("?..\n.@.\n...", False),  # the cells beside it border it
        ("?#.\n#@.\n...", True),  # nobody can see it
        ("?#.\n.@.\n...", False),
        ("#?#\n#@#\n###", False),
        ("###\n#@#\n#?#", False),
        ("###\n#@#\n###", True),
        (".#.\n#@#\n?#.", True),  # all around it is out of reach
        ("@..", True),
        ("@?.", False),
        (".?@", False),
    ],
)
def test_a_map_is_complete_when_no_cell_in_reach_borders_an_unknown_one(board, is_complete):
    grid, cell = (part.numpy() for part in known_map(board))
    knowledge = Knowledge(0, 1, Frame(*grid.shape, 0.5))
    knowledge.map = grid
    config = ArenaConfig(*grid.shape, 0.0, num_agents=1)
    observed = observe(knowledge, {0: tuple(cell.tolist())}, config, "relative")
    assert complete(observed.map, observed.position) is is_complete


# ---------------------------------------------------------------- merging


def test_a_robot_whose_frame_is_moved_is_refused_by_all():
    """Robot 1 believed to be one cell further west than it was, until now."""
    board = """
        #.....#.
        .#.#.#..
        .0.#..1.
        .#..#.#.
        #..#.#..
        ...##.#.
    """
    world = world_of(board, ["talk", "talk"])
    true = world.obstacles.astype(np.int8)
    wrong = np.roll(true, -1, 1)
    wrong[:, -1] = UNKNOWN
    for core, codes in zip(world.cores, (true, wrong), strict=True):
        known = Evidence.none(6, 8).looked(codes, 0, PATIENT.evidence, (0, 2))
        core.knowledge.merge({core.robot: known}, 0)
    world.run(1)
    for core, other, east in zip(world.cores, (1, 0), (1, -1), strict=True):
        (refusal,) = core.knowledge.refusals
        assert (refusal.robot, refusal.cause) == (other, (0, east, 0))
        assert refusal.fit.contradictions > 10
        assert core.knowledge.refused == {other: 1}
        assert core.knowledge.steps_since_merge[other] > 0


def test_a_message_is_no_view_of_a_map_that_still_changes():
    world = world_of(PAIR, ["stay", "stay"])
    world.run(1)
    knowledge = world.cores[0].knowledge
    share = Share(0, 1, knowledge.evidence)
    before = share.map.copy()
    world.obstacles[0, 0] = True
    run_on(world, LOOKS)
    assert knowledge.map[0, 0] == OCCUPIED
    assert np.array_equal(share.map, before)
