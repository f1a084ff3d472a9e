"""Robots stop before what they see, give up moves that get nowhere, and leave room for others."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from marl_explore import ArenaConfig
from marl_explore.config.constants import COMMUNICATE
from marl_explore.robot import BarrierClock, Envelope, Pose, RobotCore, RobotSettings
from marl_explore.robot.driving import Drive
from marl_explore.robot.evidence import Evidence
from marl_explore.robot.geometry import Disc
from marl_explore.robot.guard import Guard
from marl_explore.robot.mailbox import KEPT_TICKS
from marl_explore.robot.mapper import BeamModel
from marl_explore.robot.messages import Done, Share
from marl_explore.robot.planners import Nearest, RobotPlanner
from marl_explore.robot.status import Reason
from tests.helpers.boards import arena
from tests.helpers.faulty_world import MIXES, Faults, FaultyWorld, explore
from tests.helpers.robot_world import PATIENT, RADIUS, World, scan_of, scripted


class Mute(Nearest):
    """Never communicates."""

    def __call__(self, observed):
        return RobotPlanner.__call__(self, observed)


def world_of(board, *policies, **options):
    obstacles, positions = arena(board)
    config = ArenaConfig(*obstacles.shape, 0.0, num_agents=len(positions))
    policies = policies or [Mute(robot, config) for robot in range(len(positions))]
    arguments = config, obstacles.numpy(), positions.tolist(), policies
    return FaultyWorld(Faults(), np.random.default_rng(0), *arguments, **options)


def steps(world, seconds):
    for _ in range(round(seconds / world.STEP)):
        world.step()
        yield


def cell_of(world, robot):
    return world.frame.cell(world.poses[robot].x, world.poses[robot].y)


CORRIDOR = """
    #######
    #0.....
    #######
"""
WAY_AROUND = """
    #######
    #0....#
    #.....#
    #######
"""


def test_a_robot_stops_before_a_box_that_was_not_there_when_it_decided():
    world = world_of(CORRIDOR, scripted([2] * 99))
    boxed, told = False, set()
    for _ in steps(world, 40):
        if not boxed and world.cores[0].tick == 0 and world.poses[0].x > -0.98:
            world.put((1, 2))  # while it is on its way there
            boxed, at = True, world.time
        if boxed and world.time < at + 4.9:
            told.add(world.cores[0].status)
    assert boxed
    blocked = Reason.OBSTACLE, "something stands in its way to cell (1, 2)"
    assert blocked in told  # at once, before it gives up
    assert world.gap > 0
    assert world.cores[0].wheels.obstacles >= 1
    assert world.cores[0].status.reason is Reason.COMPLETE  # no fault that never ends
    assert cell_of(world, 0) == (1, 1)


def test_it_plans_around_what_stands_in_its_way():
    world = world_of(WAY_AROUND)
    boxed = False
    for _ in steps(world, 150):
        if not boxed and world.poses[0].x > -0.98:
            world.put((1, 2))
            boxed = True
    core = world.cores[0]
    assert boxed
    assert core.is_complete
    assert core.knowledge.map[1, 2] == 1
    assert world.wrong_cells(0) == 0
    assert world.gap > 0


def test_it_gives_up_a_move_whose_wheels_do_not_turn_and_goes_on_later():
    world = world_of(CORRIDOR, scripted([2] * 500), settings=RobotSettings(shut_seconds=10.0))
    turns, held = world._moved, [True]
    world._moved = lambda pose, forward, turn: pose if held else turns(pose, forward, turn)
    for _ in steps(world, 12):
        pass
    core = world.cores[0]
    assert core.wheels.stalls >= 1
    assert core.status.reason is Reason.WHEELS
    assert "do not turn" in core.status.text
    assert core.tick >= 1  # it does not keep the team waiting for the longest time of a move
    held.clear()
    for _ in steps(world, 40):
        pass
    assert core.status.reason is not Reason.WHEELS
    assert cell_of(world, 0) != (1, 1)


def test_standing_still_for_another_robot_is_no_fault():
    world = world_of("#######\n#01...#\n#######", scripted([2] * 50), scripted([8] * 50))
    for _ in steps(world, 30):
        pass
    assert [core.wheels.stalls + core.wheels.obstacles for core in world.cores] == [0, 0]


def test_a_robot_ahead_that_stays_there_is_waited_for_and_no_fault():
    world = world_of("......\n.0.1..\n......", scripted([2]), scripted([]), settings=PATIENT)
    world.poses[1] = replace(world.poses[1], x=world.poses[1].x - 0.22)
    world.dead.add(1)
    told = set()
    for _ in steps(world, 30):
        told.add(world.cores[0].status)
    assert (Reason.WAITING, "waiting for robot 1 ahead") in told
    assert world.cores[0].wheels.stalls + world.cores[0].wheels.obstacles == 0
    assert not any(status.is_fault for status in told)


# ---------------------------------------------------------------- progress of noisy poses


class Noisy(FaultyWorld):
    noise, lost_from = 0.0, np.inf

    def give_poses(self, core):
        if self.lost_from <= self.time < self.lost_from + 8.0:
            return
        for pose in self.poses:
            east, north = self.chance.normal(0.0, self.noise, 2)
            self.give(core, replace(pose, x=pose.x + east, y=pose.y + north))


def noisy(policy, **options):
    config = ArenaConfig(5, 5, 0.0, num_agents=1)
    arguments = config, np.zeros((5, 5), bool), [(2, 2)], [policy]
    return Noisy(Faults(), np.random.default_rng(0), *arguments, **options)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.02])
def test_wheels_that_do_not_turn_are_noticed_in_noise(noise):
    world = noisy(scripted([2]))
    world.noise, world._moved = noise, lambda pose, forward, turn: pose
    for _ in steps(world, 25):
        pass
    assert world.cores[0].wheels.stalls == 1
    assert world.cores[0].tick > 0


def test_a_robot_that_cannot_go_back_either_ends_its_move():
    world = noisy(scripted([2]))
    turns, middle = world._moved, world.frame.centre((2, 2))[0]
    world._moved = lambda pose, *v: pose if pose.x > middle + 0.1 else turns(pose, *v)
    for _ in steps(world, 25):
        pass
    assert world.poses[0].x > middle + 0.1
    assert world.cores[0].tick > 0


def test_time_without_a_pose_is_no_fault_of_the_wheels():
    world = noisy(scripted([2]))
    while world.cores[0]._phase != world.cores[0]._drive:
        world.step()
    world.lost_from = world.time + 0.2
    for _ in steps(world, 20):
        pass
    assert world.cores[0].wheels.stalls == 0
    assert cell_of(world, 0) == (2, 3)


def test_a_person_who_steps_aside_at_the_last_moment_is_no_fault_of_the_wheels():
    world = noisy(scripted([2]))
    while world.poses[0].x < 0.05:
        world.step()
    world.put((2, 3))
    for _ in steps(world, 4.5):
        pass
    world.put((2, 3), code=False)
    for _ in steps(world, 10):
        pass
    assert world.cores[0].wheels.stalls + world.cores[0].wheels.obstacles == 0
    assert cell_of(world, 0) == (2, 3)


def test_a_cell_that_could_not_be_reached_makes_no_map_complete():
    world = world_of("0......", settings=RobotSettings(shut_seconds=20.0))
    while world.cores[0].tick < 1 or world.cores[0]._phase != world.cores[0]._drive:
        world.step()
    world._moved = lambda pose, forward, turn: pose
    for _ in steps(world, 20):
        assert not world.cores[0].is_complete
    assert world.cores[0].wheels.stalls


def test_a_robot_that_was_taken_away_holds_no_cell_for_ever():
    world = world_of("0...1....", settings=RobotSettings(mate_patience=8.0))
    for _ in steps(world, 1):
        pass
    world.dead.add(1)
    world.poses[1] = replace(world.poses[1], x=100.0)
    world.give_poses = lambda core: world.give(core, world.poses[0])
    for _ in steps(world, 120):
        pass
    assert world.cores[0].knowledge.known == 9


# ---------------------------------------------------------------- what a scan shows


def guard_of(board, ahead=(), others=(), yaw=0.0):
    """A robot's guard after a scan, its pose and frame; ``ahead`` are discs (x, y, radius)."""
    obstacles, positions = arena(board)
    config = ArenaConfig(*obstacles.shape, 0.0, num_agents=1)
    core = RobotCore(0, config, scripted([]), BarrierClock([0]))
    pose = Pose(0.0, 0, *core.frame.centre(tuple(positions[0].tolist())), yaw)
    scan = scan_of(obstacles.numpy(), core.frame, pose, others=others, poles=ahead)
    core.guard.look(scan, pose, ())
    return core.guard, pose, core.frame


@pytest.mark.parametrize("yaw", [0.0, 0.7, 2.0])
@pytest.mark.parametrize(
    ("goal", "blocked"), [((1, 2), False), ((1, 0), True), ((0, 1), True), ((2, 1), True)]
)
def test_boxes_block_the_way_to_their_cell_only(goal, blocked, yaw):
    guard, pose, frame = guard_of("###\n#0.\n###", yaw=yaw)
    assert guard.is_blocked(pose, frame.centre(goal)) is blocked


@pytest.mark.parametrize(("aside", "blocked"), [(0.0, True), (0.1, True), (0.17, False)])
def test_a_thin_pole_in_the_way_blocks_it(aside, blocked):
    guard, pose, frame = guard_of("...\n.0.\n...", ahead=[(0.3, aside, 0.025)])
    assert guard.is_blocked(pose, frame.centre((1, 2))) is blocked
    assert not guard.is_blocked(pose, frame.centre((1, 0)))


@pytest.mark.parametrize(("range_min", "mate"), [(0.12, 0.2), (0.0, 0.1)])
def test_what_is_too_near_to_measure_is_in_the_way(range_min, mate):
    """REP 117: -inf. What is there may be a teammate, whose pose says so."""
    obstacles, _ = arena("...\n.0.\n...")
    core = RobotCore(0, ArenaConfig(3, 3, 0.0, num_agents=1), scripted([]), BarrierClock([0]))
    pose = Pose(0.0, 0, 0.0, 0.0, 0.0)
    scan = scan_of(obstacles.numpy(), core.frame, pose)
    scan = replace(scan, ranges=scan.ranges.copy(), range_min=range_min)
    scan.ranges[[0, 1, 359]] = -math.inf
    for robots, blocked in (((), True), ([Disc(mate, 0.0, 0.0)], False)):
        guard = Guard(Drive(), BeamModel())
        guard.look(scan, pose, robots)
        assert guard.is_blocked(pose, core.frame.centre((1, 2))) is blocked
    assert not guard.is_blocked(pose, core.frame.centre((1, 0)))


def test_a_single_return_is_noise():
    obstacles, _ = arena("...\n.0.\n...")
    core = RobotCore(0, ArenaConfig(3, 3, 0.0, num_agents=1), scripted([]), BarrierClock([0]))
    pose = Pose(0.0, 0, 0.0, 0.0, 0.0)
    scan = scan_of(obstacles.numpy(), core.frame, pose)
    scan.ranges[0] = 0.3
    guard = Guard(Drive(), BeamModel())
    guard.look(scan, pose, ())
    assert not guard.is_blocked(pose, (0.5, 0.0))
    other = replace(scan, ranges=scan.ranges.copy())
    other.ranges[[0, 1]] = 0.3
    guard.look(other, pose, ())
    assert guard.is_blocked(pose, (0.5, 0.0))
    assert not guard.is_blocked(pose, (0.0, 0.0))


# ---------------------------------------------------------------- room for others


def tell_all(world, robot):
    """Write the whole world into a robot's map."""
    truth = world.obstacles.astype(np.int8)
    looks = np.where(truth == 1, 3, -3).astype(np.int8)
    knowledge = world.cores[robot].knowledge
    knowledge._become(Evidence(looks, np.full(truth.shape, 5, np.int64)))


def test_a_robot_that_is_done_leaves_the_only_way():
    """Robot 0 knows everything and stands in the door through which robot 1 has to go."""
    board = """
        #######
        #..#..#
        #.1.0.#
        #..#..#
        #######
    """.replace(".0.", "0..")
    world = world_of(board, settings=RobotSettings(mate_patience=5.0))
    tell_all(world, 0)
    assert cell_of(world, 0) == (2, 3)
    for _ in steps(world, 120):
        if world.cores[1].is_complete:
            break
    assert world.cores[1].is_complete
    assert cell_of(world, 0) != (2, 3)
    assert world.closest > 2 * RADIUS


def test_robots_that_are_done_do_not_refuse_each_other_for_ever():
    """Both want to leave by the same cell."""
    world = world_of(".0.\n.1#\n#.#")
    for robot in range(2):
        tell_all(world, robot)
    told = set()
    for _ in steps(world, 30):
        told.update(core.status.text for core in world.cores)
    assert all(core.is_complete for core in world.cores)
    assert (0, 1) not in {cell_of(world, robot) for robot in range(2)}
    assert any("its move to cell (0, 0) was refused because of robot" in text for text in told)


# ---------------------------------------------------------------- messages that come late


def test_a_map_that_comes_long_after_the_patience_is_still_merged():
    late = []

    def lost(envelope):
        is_map = isinstance(envelope.message, Share)
        if is_map:
            late.append(envelope)
        return is_map

    obstacles, positions = arena("............\n.0....1.....\n............")
    config = ArenaConfig(3, 12, 0.0, num_agents=2)
    policies = [scripted([COMMUNICATE]) for _ in range(2)]
    arguments = config, obstacles.numpy(), positions.tolist(), policies
    world = World(*arguments, settings=PATIENT, lost=lost)
    world.run(30)
    assert [core.knowledge.known for core in world.cores] == [9, 9]
    for letter in late:
        for receiver in letter.to:
            world.cores[receiver].receive(letter, world.now)
    world.run(32)
    assert [core.knowledge.known for core in world.cores] == [18, 18]


@pytest.mark.parametrize(
    ("planner", "robots", "side", "seed"),
    [("nearest-timer", 2, 6, 3), ("goal-utility", 2, 6, 3), ("nearest-timer", 3, 7, 4)],
)
def test_robots_explore_though_no_message_comes_within_the_patience(planner, robots, side, seed):
    """Three also when one is done, which others wait for as long as they lack its map."""
    late = Faults(delay=3.0, least_delay=3.0)
    found = explore(late, seed, planner, side, robots, most_seconds=400.0)
    assert found.finished


def test_a_map_is_answered_once_by_a_robot_that_does_not_communicate():
    config = ArenaConfig(3, 9, 0.0, num_agents=2)
    obstacles, positions = arena(".........\n.0....1..\n.........")
    policies = [scripted([]) for _ in range(2)]
    world = World(config, obstacles.numpy(), positions.tolist(), policies, settings=PATIENT)
    world.run(2)
    robot, other = world.cores

    def answers(ticks):
        before = robot.mail.sent["share"]
        late = Share(1, robot.tick, other.knowledge.evidence)
        robot.receive(Envelope(1, (0,), late), world.now)
        world.run(robot.tick + ticks)
        return robot.mail.sent["share"] - before

    assert [answers(2), answers(2)] == [1, 0]
    assert answers(KEPT_TICKS) == 0  # its own has only just gone
    assert answers(2) == 1
    assert other.knowledge.known == robot.knowledge.known == 18


def test_a_robot_that_was_alone_for_hours_finds_back():
    """Its ticks went on without the others: they join it."""
    config = ArenaConfig(num_agents=2)
    clocks = [BarrierClock(range(2), patience=5.0) for _ in range(2)]
    cores = [RobotCore(robot, config, scripted([]), clocks[robot]) for robot in range(2)]
    far = 360_000  # ten scans a second for ten hours
    assert clocks[0].tick(0.0) == clocks[1].tick(0.0) == 0
    letter = Envelope(1, (0,), Done(1, far))
    cores[0].receive(Envelope.decode(letter.encode(), 0), 1.0)
    cores[0].advance(1.0)
    assert cores[0].tick == far


# ---------------------------------------------------------------- the fault campaign, in short


@pytest.mark.parametrize("mix", MIXES)
def test_a_team_explores_whatever_goes_wrong(mix):
    faults = MIXES[mix]
    found = explore(replace(faults, isolated=min(faults.isolated, 120.0)), seed=3)
    assert found.finished
    assert found.wrong_cells == 0
    assert found.closest > 0
    assert found.gap > 0
