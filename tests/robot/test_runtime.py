"""What a robot does when things go wrong: old data, lost messages, dead and late robots."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from marl_explore import ArenaConfig
from marl_explore.robot import BarrierClock, Envelope, PeriodClock, Pose, RobotCore, RobotSettings
from marl_explore.robot.driving import ZERO
from marl_explore.robot.evidence import Evidence, EvidenceModel
from marl_explore.robot.geometry import Frame, Mount
from marl_explore.robot.mapper import sight
from marl_explore.robot.messages import MOST_AHEAD, Done, Intent, Share
from marl_explore.robot.planners import Nearest
from tests.helpers.boards import ACTIONS, arena
from tests.helpers.robot_world import PATIENT, RADIUS, World, scan_of, scripted

STAY, TALK = ACTIONS.index("stay"), ACTIONS.index("talk")


def world_of(board, scripts, **options):
    obstacles, cells = arena(board)
    config = ArenaConfig(*obstacles.shape, 0.0, num_agents=len(cells))
    policies = [scripted([ACTIONS.index(name) for name in script.split()]) for script in scripts]
    options = {"settings": PATIENT} | options
    return World(config, obstacles.numpy(), cells.tolist(), policies, **options)


def cells(world):
    return [world.frame.cell(pose.x, pose.y) for pose in world.poses]


OPEN = """
    ......
    .0..1.
    ......
    ......
"""


def test_a_team_drives_to_the_cells_it_meant():
    world = world_of(OPEN, ["S NE stay", "SW stay S"])
    world.run(3)
    assert cells(world) == [(1, 2), (3, 3)]


def test_moves_to_one_cell_are_refused():
    world = world_of(OPEN, ["S E", "SW W"])
    world.run(2)
    assert cells(world) == [(2, 1), (2, 3)]


# ---------------------------------------------------------------- old poses and scans


def driving_robot(**ages):
    """A robot alone, under way east at time 1."""
    obstacles, positions = arena("....\n.0..\n....")
    config = ArenaConfig(3, 4, 0.0, num_agents=1)
    settings = RobotSettings(max_pose_age=0.5, max_scan_age=1.0)
    core = RobotCore(0, config, scripted([2]), BarrierClock([0]), settings=settings)
    pose = Pose(1.0, 0, *core.frame.centre(tuple(positions[0].tolist())), 0.0)
    core.advance(1.0)
    core.receive(pose, 1.0)
    core.receive(scan_of(obstacles.numpy(), core.frame, pose), 1.0)
    assert core.advance(1.0).velocity.forward > 0
    return core, pose


def test_an_old_pose_stops_a_robot_until_a_new_one_comes():
    core, pose = driving_robot()
    assert core.advance(1.5).velocity.forward > 0
    assert core.advance(1.51).velocity == ZERO
    core.receive(replace(pose, stamp=1.6), 1.6)
    assert core.advance(1.6).velocity.forward > 0


def test_an_old_scan_stops_a_robot_until_a_new_one_comes():
    core, pose = driving_robot()
    for now in (1.9, 2.0, 2.01):
        core.receive(replace(pose, stamp=now), now)
        assert (core.advance(now).velocity == ZERO) is (now > 2.0)
    core.receive(replace(core.sensors.scan, stamp=2.1), 2.1)
    core.receive(replace(pose, stamp=2.1), 2.1)
    assert core.advance(2.1).velocity.forward > 0


def test_a_pose_that_was_overtaken_is_dropped():
    core, pose = driving_robot()
    core.receive(replace(pose, stamp=1.2, x=0.7), 1.2)
    core.receive(replace(pose, stamp=1.1, x=-9.0), 1.2)
    assert core.sensors.pose.x == 0.7


def stamped(core, pose, stamp):
    """That pose and the robot's scan, both with another stamp."""
    return replace(pose, stamp=stamp), replace(core.sensors.scan, stamp=stamp)


def test_what_is_stamped_in_the_future_is_refused_and_overtakes_nothing():
    core, pose = driving_robot()
    for event in stamped(core, pose, 99.0):
        with pytest.raises(ValueError, match=r"stamp=99.0 is not allowed: .* 1.2 s"):
            core.receive(event, 1.2)
    for event in stamped(core, pose, 1.3):
        core.receive(event, 1.2)  # clocks of two computers differ a little
    assert core.advance(1.7).velocity.forward > 0
    assert core.advance(2.0).velocity == ZERO


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["stamp", "x", "y", "yaw"])
def test_a_pose_that_is_not_finite_is_refused_and_changes_nothing(name, value):
    core, pose = driving_robot()
    before = core.advance(1.1)
    with pytest.raises(ValueError, match=f"{name}={value} is not allowed: .*finite"):
        core.receive(replace(pose, **{"stamp": 1.1, name: value}), 1.1)
    assert core.advance(1.1).velocity == before.velocity != ZERO


@pytest.mark.parametrize("name", ["x", "y"])
def test_a_pose_far_from_every_arena_is_refused(name):
    """It used to be taken, and the next ``advance`` failed."""
    core, pose = driving_robot()
    with pytest.raises(ValueError, match=rf"{name}=1e\+308 is not allowed: .* at most 1e\+06 m"):
        core.receive(replace(pose, **{"stamp": 1.1, name: 1e308}), 1.1)
    assert core.advance(1.1).velocity != ZERO


@pytest.mark.parametrize("name", ["stamp", "angle_min", "angle_increment", "range_max"])
def test_a_scan_that_is_not_finite_is_refused_and_changes_nothing(name):
    core, _ = driving_robot()
    before = core.sensors.scan
    with pytest.raises(ValueError, match=f"{name}=nan is not allowed: .*finite"):
        core.receive(replace(before, **{"stamp": 1.1, name: math.nan}), 1.1)
    assert core.sensors.scan is before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"range_min": 3.5}, "range_max=3.5 is not allowed: .* more than range_min=3.5"),
        ({"range_max": 0.1}, "range_max=0.1 is not allowed: .* more than range_min=0.12"),
        ({"mount": Mount(yaw=math.nan)}, "mount=.*nan.* is not allowed: .* finite"),
        ({"mount": Mount(1e7, 0.0)}, "mount=.* x=10000000.0 is not allowed: .* at most 5 metres"),
        ({"mount": Mount(0.0, 1e300)}, "mount=.* y=.* is not allowed: .* at most 5 metres"),
        ({"mount": (1, 2)}, r"mount=\(1, 2\) is not allowed: it must be a Mount"),
        ({"mount": 1.0}, "mount=1.0 is not allowed: it must be a Mount"),
        ({"ranges": np.ones((2, 3))}, r"ranges=float64 of shape \(2, 3\) is not allowed: .* \[R\]"),
        ({"ranges": np.float64(3)}, r"ranges=float64 of shape \(\) is not allowed"),
        ({"ranges": np.full(360, 1 + 2j)}, "ranges=complex128 of shape .* is not allowed"),
        ({"ranges": np.ones(360, bool)}, "ranges=bool of shape .* is not allowed"),
        ({"ranges": np.full(360, "a")}, "ranges=.* of shape .* is not allowed"),
        ({"ranges": None}, "ranges=object of shape .* is not allowed"),
        ({"angle_increment": 0.0}, "angle_increment=0.0 is not allowed: beams need an angle"),
        ({"angle_increment": 1e300}, r"angle_increment=1e\+300 is not allowed: .* at most 6.28"),
        ({"angle_increment": -7.0}, "angle_increment=-7.0 is not allowed: .* at most 6.28"),
        ({"angle_min": 1e308}, r"angle_min=1e\+308 is not allowed: .* at most 12.566"),
        ({"range_min": -0.1}, "range_min=-0.1 is not allowed: it must be at least 0 metres"),
        ({"range_min": -5.0, "range_max": -1.0}, "range_min=-5.0 is not allowed"),
        ({"range_max": None}, "range_max=None is not allowed"),
        ({"stamp": "1"}, "stamp='1' is not allowed"),
    ],
)
def test_a_scan_that_cannot_be_is_refused(changes, message):
    core, _ = driving_robot()
    with pytest.raises(ValueError, match=message):
        core.receive(replace(core.sensors.scan, **{"stamp": 1.1} | changes), 1.1)


def test_a_scan_at_its_bounds_is_taken():
    core, pose = driving_robot()
    scan = core.sensors.scan
    for number, changes in enumerate(
        (
            {"angle_increment": -scan.angle_increment, "angle_min": 4 * math.pi},
            {"angle_increment": 2 * math.pi, "angle_min": -4 * math.pi, "range_min": 0.0},
            {"mount": Mount(-5.0, 5.0, math.pi), "ranges": scan.ranges.astype(np.float32)},
        )
    ):
        now = 1.1 + number / 10
        core.receive(replace(scan, stamp=now, **changes), now)
        core.receive(replace(pose, stamp=now), now)
        assert core.sensors.scan.stamp == now
        core.advance(now)


def test_a_scan_may_turn_clockwise():
    obstacles = np.zeros((3, 3), bool)
    obstacles[0, 1] = True
    frame = Frame(3, 3, 0.5)
    scan = scan_of(obstacles, frame, Pose(1.0, 0, 0.0, 0.0, 0.3))
    clockwise = replace(scan, ranges=scan.ranges[::-1], angle_increment=-scan.angle_increment)
    clockwise = replace(clockwise, angle_min=-scan.angle_increment)
    for read in (scan, clockwise):
        read.check()
        seen = sight(read, Pose(1.0, 0, 0.0, 0.0, 0.3), [], frame, 1)
        assert np.array_equal(seen == 1, obstacles)


@pytest.mark.parametrize("robot", [1.5, True, None, "1", math.nan])
def test_the_number_of_a_robot_is_an_integer(robot):
    """1.5 used to be taken, and the next ``advance`` failed."""
    core, pose = driving_robot()
    with pytest.raises(ValueError, match=f"a pose of robot {robot!r} is not allowed: 0 to 0"):
        core.receive(replace(pose, stamp=1.1, robot=robot), 1.1)
    assert core.advance(1.1).velocity != ZERO


@pytest.mark.parametrize("name", ["stamp", "x", "y", "yaw"])
@pytest.mark.parametrize("value", [None, "a", True, 1j, np.zeros(1)])
def test_a_pose_of_other_types_is_refused(name, value):
    core, pose = driving_robot()
    with pytest.raises(ValueError, match=f"{name}=.* is not allowed: it must be a finite number"):
        core.receive(replace(pose, **{"stamp": 1.1, name: value}), 1.1)
    assert core.advance(1.1).velocity != ZERO


@pytest.mark.parametrize("yaw", [1e300, -1e7])
def test_a_heading_beyond_all_turns_is_refused(yaw):
    core, pose = driving_robot()
    with pytest.raises(ValueError, match=r"yaw=.* is not allowed: it must be at most 10000 rad"):
        core.receive(replace(pose, stamp=1.1, yaw=yaw), 1.1)
    core.receive(replace(pose, stamp=1.1, yaw=20 * math.pi), 1.1)  # it counts its turns
    assert core.advance(1.1).velocity.forward > 0


@pytest.mark.parametrize("now", [math.nan, math.inf, -math.inf, 1e300, None, "1"])
def test_times_that_are_none_are_refused(now):
    core, pose = driving_robot()
    for use in (core.advance, lambda now: core.receive(pose, now), BarrierClock([0]).tick):
        with pytest.raises(ValueError, match="now=.* is not allowed: .* seconds"):
            use(now)
    with pytest.raises(ValueError, match="now=.* is not allowed: .* seconds"):
        PeriodClock(1.0).tick(now)
    assert core.advance(1.1).velocity != ZERO


@pytest.mark.parametrize("event", [None, "x", Done(1, 2)])
def test_other_events_are_refused(event):
    core, _ = driving_robot()
    with pytest.raises(ValueError, match="event=.* must be a Scan, a Pose or an Envelope"):
        core.receive(event, 1.1)


@pytest.mark.parametrize("off", [0.0, math.nan])
def test_a_lidar_that_is_off_stops_a_robot(off):
    core, pose = driving_robot()
    broken = replace(core.sensors.scan, stamp=2.1, ranges=np.full(360, off))
    core.receive(replace(pose, stamp=2.1), 2.1)
    with pytest.raises(ValueError, match=r"no range is above range_min=0.12"):
        core.receive(broken, 2.1)
    assert core.advance(2.1).velocity == ZERO


def test_a_clock_that_is_set_back_stops_a_robot_until_new_data_come():
    core, pose = driving_robot()
    for event in stamped(core, pose, 40.0):
        core.receive(event, 40.0)
    assert core.advance(40.0).velocity.forward > 0
    assert core.advance(20.0).velocity == ZERO
    for event in stamped(core, pose, 20.1):
        assert core.advance(20.1).velocity == ZERO
        core.receive(event, 20.1)
    assert core.advance(20.1).velocity.forward > 0


def test_a_clock_that_is_set_back_stops_no_sensing():
    world = world_of(OPEN, ["stay"] * 2)
    world.now = 100.0
    world.run(3)
    world.now = 0.0
    world.run(world.cores[0].tick + 2, most_steps=10)


def test_a_scan_is_read_with_the_pose_of_its_time():
    obstacles, positions = arena("....\n.0..\n....")
    config = ArenaConfig(3, 4, 0.0, num_agents=1)
    core = RobotCore(0, config, scripted([]), BarrierClock([0]))
    core.advance(0.0)
    right = Pose(1.0, 0, *core.frame.centre(tuple(positions[0].tolist())), 0.5)
    core.receive(right, 1.4)
    core.receive(replace(right, stamp=1.4, yaw=2.0), 1.4)
    core.receive(scan_of(obstacles.numpy(), core.frame, right), 1.4)
    core.advance(1.4)
    assert core.knowledge.known == 9
    assert (core.knowledge.map != 1).all()


def test_without_a_pose_near_the_scan_nothing_is_sensed():
    core = RobotCore(0, ArenaConfig(3, 3, 0.0, num_agents=1), scripted([]), BarrierClock([0]))
    core.advance(0.0)
    pose = Pose(1.0, 0, 0.0, 0.0, 0.0)
    core.receive(pose, 1.0)
    core.receive(scan_of(np.zeros((3, 3), bool), core.frame, pose, stamp=1.6), 1.6)
    core.advance(1.6)
    assert core.observation is None


# ---------------------------------------------------------------- messages


def test_maps_are_merged_after_a_communication_and_bytes_are_counted():
    world = world_of(OPEN, ["talk", "talk"])
    world.run(1)
    assert [core.knowledge.known for core in world.cores] == [18, 18]
    core = world.cores[0]
    assert core.mail.sent["share"] == 1
    assert 10 < core.mail.sent_bytes["share"] < 60
    assert core.mail.sent_bytes["intent"] == 21 * core.mail.sent["intent"]


def test_maps_travel_along_chains():
    """Robots 0 and 2 are out of each other's range (6.4 cells)."""
    world = world_of("." * 16 + "\n.0....1....2....\n" + "." * 16, ["talk"] * 3)
    world.run(1)
    assert [core.knowledge.known for core in world.cores] == [27] * 3
    assert world.cores[0].knowledge.steps_since_merge.tolist() == [0, 0, 0]


def test_intents_and_maps_stay_within_range():
    sent = []
    world = world_of(
        "." * 16 + "\n.0....1....2....\n" + "." * 16,
        ["talk"] * 3,
        lost=lambda envelope: sent.append(envelope),
    )
    for _ in range(3):
        world.step()
    pairs = {(e.sender, to) for e in sent if not isinstance(e.message, Done) for to in e.to}
    assert pairs == {(0, 1), (1, 0), (1, 2), (2, 1)}


def test_who_does_not_communicate_gets_no_map():
    world = world_of(OPEN, ["talk", "stay"])
    world.run(1)
    assert [core.knowledge.known for core in world.cores] == [9, 9]
    assert world.cores[0].mail.sent["share"] == 0


def test_an_obstacle_of_others_in_a_cell_that_the_robot_drove_through_was_the_robot():
    world = world_of("....\n....\n0..1", ["NE", "stay"])
    corner, later = (1, 0), 60
    world.run(2)
    mover, other = world.cores
    assert cells(world)[0] == (1, 1)
    seen = np.full((3, 4), -1, np.int8)
    seen[corner] = 1  # on its diagonal it passed there, and was seen for long
    for tick in range(later, later + 5):
        taken = other.knowledge.evidence.looked(seen, tick, EvidenceModel(), (2, 3))
    mover.knowledge.merge({1: taken}, later)
    assert mover.knowledge.map[corner] == 0


def test_lost_maps_cost_time_and_nothing_else():
    world = world_of(
        OPEN, ["talk S", "talk S"], lost=lambda envelope: isinstance(envelope.message, Share)
    )
    world.run(2)
    assert cells(world) == [(2, 1), (2, 4)]
    assert [core.knowledge.known for core in world.cores] == [12, 12]


def both_know_all(world):
    return [core.knowledge.known for core in world.cores] == [18, 18]


def test_a_lost_intent_keeps_no_map_back():
    """Robot 0 decides before robot 1 in every tick, so that an intent is always awaited."""
    world = world_of(OPEN, ["talk " * 4] * 2)
    world.lost = lambda e: isinstance(e.message, Intent) and (e.sender, e.message.tick) == (1, 0)
    world.run(1)
    assert both_know_all(world)


def test_who_was_not_heard_for_three_ticks_and_more_merges_when_it_is_back():
    world = world_of(
        OPEN, ["talk " * 99] * 2, make_clock=lambda: BarrierClock(range(2), patience=5)
    )
    world.lost = lambda envelope: envelope.sender == 1
    world.run(3)
    assert world.cores[0].knowledge.known == 9
    world.lost = lambda envelope: False
    world.run(world.cores[0].tick + 30)  # it stays, and so goes through 20 while robot 1 waits
    assert both_know_all(world)


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_lost_messages_stop_nobody_and_nobody_touches(share):
    chance = np.random.default_rng(1)

    def lost(envelope):
        return chance.random() < share

    drawn = np.random.default_rng(2)
    names = [" ".join(ACTIONS[a] for a in drawn.integers(0, 10, 8)) for _ in range(4)]
    world = world_of(
        "......\n.0.1..\n......\n..2.3.\n......",
        names,
        lost=lost,
        make_clock=lambda: BarrierClock(range(4), patience=15),
    )
    world.run(8)
    assert world.closest > 2 * RADIUS


# ---------------------------------------------------------------- robots that die or come late


def test_a_robot_that_dies_does_not_stop_the_others():
    world = world_of(
        OPEN,
        ["S E stay stay", "S stay stay"],
        make_clock=lambda: BarrierClock(range(2), patience=5),
    )
    world.run(1)
    world.dead.add(1)
    world.run(4)
    assert cells(world) == [(2, 2), (2, 4)]
    assert world.now < 30


def test_a_held_cell_is_waited_for_no_longer_than_a_lock_lasts():
    """Robot 1 dies in the cell that robot 0 needs for its diagonal."""
    board = "...\n.1.\n.0#"
    world = world_of(board, ["NE", "N"], make_clock=lambda: BarrierClock(range(2), patience=60))
    world.run(0)
    world.dead.add(1)
    while (
        world.cores[0].tick == 0 and world.now < 50 and world.cores[0]._phase.__name__ != "_begin"
    ):
        world.step()
    assert PATIENT.lock_expiry < world.now < PATIENT.lock_expiry + 2
    assert cells(world) == [(2, 1), (1, 1)]
    assert world.closest > 2 * RADIUS


def gap_to(world, box, robot=0):
    """From the rim of a robot to a box (metres)."""
    (x, y), pose = world.frame.centre(box), world.poses[robot]
    half = world.frame.cell_size / 2
    return math.hypot(max(abs(pose.x - x) - half, 0), max(abs(pose.y - y) - half, 0)) - RADIUS


@pytest.mark.parametrize("stuck_at", [-0.2, -0.05, 0.15])
def test_a_move_that_is_given_up_goes_back_the_way_it_came(stuck_at):
    """Robot 0 goes north-east by the east, and cannot go on when it is so far north (metres)."""
    world = world_of("#..\n0..", ["NE"], settings=replace(PATIENT, move_expiry=20.0))
    north, start = world.frame.centre((0, 1))[1], world.poses[0]
    moved, gaps = world._moved, []

    def held(pose, forward, turn):
        after = moved(pose, forward, turn)
        return moved(pose, 0.0, turn) if after.y > max(pose.y, north + stuck_at - 0.25) else after

    world._moved = held
    for _ in range(500):
        world.step()
        gaps.append(gap_to(world, (0, 0)))
    assert max(abs(world.poses[0].x - start.x), abs(world.poses[0].y - start.y)) < 0.03
    assert world.cores[0].tick > 0
    assert min(gaps) > 0.1


def test_a_robot_that_comes_late_joins():
    world = world_of(
        OPEN, ["S stay stay stay stay", "S"], make_clock=lambda: BarrierClock(range(2), patience=3)
    )
    world.dead.add(1)
    world.run(3)
    world.dead.clear()
    world.run(80)  # meanwhile robot 0 stays, tick after tick
    assert cells(world) == [(2, 1), (2, 4)]


def left_behind(phase):
    """A team that is at tick 5, robot 0 still in a phase of tick 0, and what robot 0 sent since."""
    world, sent = world_of(OPEN, ["talk"] * 2), []
    world.dead.add(1)
    core = world.cores[0]
    if phase == "_sense":
        core.advance(world.now)
    else:
        world.step()
    if phase == "_exchange":
        core.receive(Envelope(1, (0,), Intent(1, 0, (1, 4), TALK)), world.now)
        core.advance(world.now)
    assert (core.tick, core._phase.__name__) == (0, phase)
    world.lost = lambda envelope: bool(sent.append(envelope.message))
    core.receive(Envelope(1, (0,), Done(1, 5)), world.now)
    return world, sent


@pytest.mark.parametrize("phase", ["_sense", "_agree", "_exchange"])
def test_who_was_left_behind_decides_in_the_tick_of_the_others(phase):
    world, sent = left_behind(phase)
    world.step()
    assert [m.tick for m in sent if isinstance(m, Intent)] == [5]
    assert world.cores[0]._phase.__name__ == "_agree"


def test_ticks_shorter_than_the_patience_do_not_stop_a_robot_for_one_that_is_dead():
    world = world_of(OPEN, ["S S", ""], make_clock=lambda: PeriodClock(2.0))
    world.dead.add(1)
    world.run(6)
    assert cells(world)[0] == (2, 1)


# ---------------------------------------------------------------- clocks, limits, the end


def test_a_period_clock_needs_no_agreement():
    sent = []
    world = world_of(
        OPEN,
        ["S S", "S stay S"],
        make_clock=lambda: PeriodClock(8.0),
        lost=lambda envelope: sent.append(envelope.message),
    )
    world.lost = lambda envelope: bool(sent.append(envelope.message))
    world.run(2)
    assert cells(world) == [(3, 1), (2, 4)]
    assert not any(isinstance(message, Done) for message in sent)


def test_who_is_late_for_a_tick_tells_where_it_ends():
    sent = []
    world = world_of(OPEN, ["S", "stay"], make_clock=lambda: PeriodClock(2.0))
    world.lost = lambda envelope: bool(sent.append(envelope.message))
    world.run(3)
    late = [m for m in sent if isinstance(m, Intent) and (m.robot, m.tick) == (0, 1)]
    assert [(m.cell, m.action) for m in late] == [((2, 1), STAY)]
    assert cells(world)[0] == (2, 1)


def test_with_no_frontier_left_a_robot_moves_no_more():
    moved = world_of("...\n.0.\n...", ["S S"])
    moved.run(1)
    assert cells(moved) == [(2, 1)]
    patient = replace(PATIENT, stop_when_complete=True)
    stopped = world_of("...\n.0.\n...", ["S S"], settings=patient)
    stopped.run(1)
    assert cells(stopped) == [(1, 1)]
    assert stopped.cores[0].is_complete


def test_a_move_that_is_not_allowed_is_not_made():
    world = world_of("...\n#0.\n...", ["W NW"])
    world.run(1)
    assert cells(world) == [(1, 1)]


@pytest.mark.parametrize(
    ("config", "robot", "message"),
    [
        (ArenaConfig(communication_range=1.4), 0, r"communication_range=1.4 .*1\.414 m"),
        (ArenaConfig(), 4, "robot=4 is not allowed: 0 to 3"),
        (ArenaConfig(), -1, "robot=-1 is not allowed: 0 to 3"),
        (ArenaConfig(), 1.0, "robot=1.0 is not allowed: 0 to 3"),
        (ArenaConfig(num_agents=5), 0, "robots=4 is not allowed: the clock is for a team of 5"),
        (ArenaConfig(num_agents=3), 0, "robots=4 is not allowed: the clock is for a team of 3"),
    ],
)
def test_settings_that_cannot_work_are_refused(config, robot, message):
    with pytest.raises(ValueError, match=message):
        RobotCore(robot, config, scripted([]), BarrierClock(range(4)))


WHOLE = Evidence.none(4, 6)


def evidence(looks, rank=5):
    """Of a map of ``OPEN`` in which one cell has these numbers."""
    known = Evidence(WHOLE.looks.copy(), WHOLE.rank.copy())
    known.looks[0, 0], known.rank[0, 0] = looks, rank
    return known


@pytest.mark.parametrize(
    ("letter", "message"),
    [
        (Envelope(2, (0,), Done(1, 5)), "of robot 2 is not allowed: 0 to 1"),
        (Envelope(1, (0,), Done(7, 5)), "of robot 7 is not allowed: 0 to 1"),
        (
            Envelope(1, (0,), Share(1, 0, Evidence.none(2, 3))),
            r"\(2, 3\) is not allowed: .*\(4, 6\)",
        ),
        (Envelope(1, (0,), Done(0, 0)), "Done of robot 0 is not allowed: robot 1 sent it"),
        (Envelope(1, (0,), Intent(0, 0, (1, 1), 0)), "Intent of robot 0 .* robot 1 sent it"),
        (Envelope(1, (0,), Intent(1, 0, (1, 4), 10)), "action=10 is not allowed: 0 to 9"),
        (Envelope(1, (0,), Done(1, 2**60)), "tick=1152921504606846976 is not allowed: 0 to 4398"),
        (Envelope(1, (0,), Done(1, -1)), "tick=-1 is not allowed: 0 to"),
        (Envelope(-1, (0,), Done(-1, 0)), "a message of robot -1 is not allowed: 0 to 1"),
        (Envelope(1, (1, 2), Done(1, 0)), r"to robots \(1, 2\) is not allowed: this is robot 0"),
        (Envelope(0, (0,), Done(0, 0)), "a message of robot 0 to itself is not allowed"),
        (Envelope(1, (0,), Intent(1, 0, (4, 4), 0)), r"cell=\(4, 4\) is not allowed: .*\(4, 6\)"),
        (Envelope(1, (0,), Intent(1, 9, (1, 1), 0)), r"cell=\(1, 1\) of robot 1 .* cell \(1, 4\)"),
        (Envelope(1, (0,), Intent(1, 0, (1, 4), 1.5)), "action=1.5 is not allowed: 0 to 9"),
        (Envelope(1, (0,), Intent(1, 0, (1, 4), True)), "action=True is not allowed: 0 to 9"),
        (Envelope(1, (0,), Intent(1, 0, (1,), 1)), r"cell=\(1,\) is not allowed: \(row, column\)"),
        (Envelope(1, (0,), Intent(1, 0, (1.0, 4), 1)), r"cell=\(1.0, 4\) is not allowed"),
        (Envelope(1, (0,), Intent(1, 0, None, 1)), "cell=None is not allowed"),
        (Envelope(1, (0,), Intent(1, 0, (1, 4), 1, 2)), "upright=2 is not allowed"),
        (Envelope(1, (0,), Done(1, 1.5)), "tick=1.5 is not allowed: 0 to"),
        (Envelope(1, (0,), Done(1, True)), "tick=True is not allowed: 0 to"),
        (Envelope(1, (0,), Done(1, None)), "tick=None is not allowed: 0 to"),
        (Envelope(1.0, (0,), Done(1.0, 1)), "a message of robot 1.0 is not allowed"),
        (Envelope(1, None, Done(1, 1)), "a message to robots None is not allowed"),
        (Envelope(1, (0,), None), "message=None is not allowed: an Intent, a Share or a Done"),
        (Envelope(1, (0,), Share(1, 0, None)), "evidence=None is not allowed"),
        (Envelope(1, (0,), Share(1, 0, evidence(looks=100))), "evidence of more than 7 looks"),
        (Envelope(1, (0,), Share(1, 0, evidence(looks=1, rank=-2))), "before the first tick"),
        (Envelope(1, (0,), Share(1, 0, evidence(looks=1, rank=2**63 - 1))), "a rank that there"),
        (Envelope(1, (0,), Share(1, 0, evidence(looks=0, rank=5))), "a rank that there cannot be"),
        (
            Envelope(1, (0,), Share(1, 0, Evidence(WHOLE.looks, WHOLE.rank[:2]))),
            r"evidence of \(4, 6\) looks and \(2, 6\) ranks",
        ),
        (
            Envelope(1, (0,), Share(1, 0, Evidence(WHOLE.looks.astype(float), WHOLE.rank))),
            r"looks of evidence are not allowed: not int8 \[H, W\]",
        ),
        (
            Envelope(1, (0,), Share(1, 0, Evidence(WHOLE.looks, WHOLE.rank.tolist()))),
            "rank of evidence are not allowed: not int64",
        ),
    ],
)
def test_messages_of_another_team_are_refused_and_change_nothing(letter, message):
    world = world_of(OPEN, ["talk S", "talk S"])
    world.step()
    with pytest.raises(ValueError, match=message):
        world.cores[0].receive(letter, world.now)
    world.run(2)
    assert cells(world) == [(2, 1), (2, 4)]


@pytest.mark.parametrize("name", ["max_pose_age", "max_scan_age", "lock_expiry"])
def test_times_must_be_positive(name):
    with pytest.raises(ValueError, match=f"{name}=0"):
        RobotSettings(**{name: 0})


@pytest.mark.parametrize("answer", [10, -1, 1.7, math.nan, None, "a", True, np.zeros(10)])
def test_an_action_that_is_none_is_refused(answer):
    world = world_of(OPEN, ["stay", "stay"])
    world.cores[1].policy = lambda observation: answer
    with pytest.raises(ValueError, match="the policy's action .* is not one of 0 to 9"):
        world.run(1)
    assert math.isfinite(world.now)


@pytest.mark.parametrize("answer", [np.int64(4), np.array(4), np.uint8(4)])
def test_an_action_may_be_an_integer_of_numpy(answer):
    world = world_of(OPEN, ["stay", "stay"])
    world.cores[1].policy = lambda observation: answer
    world.run(1)
    assert world.cores[1].action == 4


# ---------------------------------------------------------------- ticks far ahead


def test_who_joins_the_farthest_tick_is_understood_by_the_others():
    """A tick at the limit used to be taken, and what the team sent afterwards was refused."""
    world = world_of(OPEN, ["stay"] * 2)
    for core in world.cores:
        other = 1 - core.robot
        core.receive(Envelope(other, (core.robot,), Done(other, MOST_AHEAD - 1)), world.now)
    world.run(MOST_AHEAD + 3, most_steps=20)


def test_intents_of_many_ticks_do_not_pile_up():
    world = world_of(OPEN, ["stay"] * 2)
    world.step()
    for tick in range(1000, 2000):
        world.cores[0].receive(Envelope(1, (0,), Intent(1, tick, (1, 4), STAY)), world.now)
    assert len(world.cores[0].mail._intents) <= 64
    world.run(3)


# ---------------------------------------------------------------- whose policy it is


def test_a_policy_brings_its_normalisation():
    config = ArenaConfig(num_agents=1)
    policy = scripted([])
    cores = [RobotCore(0, config, policy, BarrierClock([0]))]
    named = Named()
    cores += [RobotCore(0, config, named, BarrierClock([0]), **o) for o in ({}, {"fpr": None})]
    assert [core.fpr for core in cores] == ["relative", "absolute", None]


class Named:
    fpr = "absolute"


@pytest.mark.parametrize(
    ("robot", "team", "message"),
    [
        (0, ArenaConfig(7, 7, num_agents=4), "the planner is for num_agents=2 .* not for 4"),
        (0, ArenaConfig(7, 7, num_agents=2, sensing_range=2.0), "3 x 3 cells in view, not for 2"),
        (1, ArenaConfig(7, 7, num_agents=2), "robot=1 is not allowed: .* that of robot 0"),
    ],
)
def test_the_planner_of_another_robot_or_team_is_refused(robot, team, message):
    planner = Nearest(0, ArenaConfig(7, 7, num_agents=2))
    with pytest.raises(ValueError, match=message):
        RobotCore(robot, team, planner, BarrierClock(range(team.num_agents)))
