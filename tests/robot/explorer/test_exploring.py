"""Explorers in a simulated world, from their first map until they say that they are done."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, label

from marl_explore.robot.explorer import ExplorerCore, ExplorerSettings, OccupancyMap, Place
from tests.helpers.slam import Rover, Trial, World

TWO_ROOMS = """
########################################
#..............#.......................#
#..............#.......................#
#..............#.......................#
#.....1........a...........##..........#
#.....2........a...........##..........#
#..............a.......................#
#..............a.......................#
#..............#.......................#
####...###########...#########...#######
#.............#.............#..........#
#.............#.............#..........#
#.............#.............#..........#
#...........................#..........#
#...........................#..........#
#...........................#..........#
#.............#.............#..........#
########################################
"""
NARROW = """
####################################
#...........#......................#
#...........#......................#
#...........#......................#
#...1..............................#
#...2..............................#
#...........#......................#
#...........########################
#...........#
#...........#
#...........#
#############
"""
CORRIDOR = """
################################
#..1...........................#
#...2..........................#
#..............................#
#..............................#
################################
"""
DEAD_END = """
############################
#..........#...............#
#..........#...............#
#..........#...............#
#....1.....a...............#
#....2.....a...............#
#..........a...............#
#..........#...............#
#..........#...............#
############################
"""


def trial(plan=TWO_ROOMS, robots=1, settings=None, frames=None, told=None, rover=None, **options):
    """A team whose map frames are at ``frames`` in the world, and told to be at ``told``."""
    world = World(plan)
    names = [f"robot_{number + 1}" for number in range(robots)]
    frames = frames or [Place(0.0, 0.0)] * robots
    told = told or frames
    cores, rovers = {}, {}
    for name, frame, own in zip(names, frames, told, strict=True):
        mates = {
            mate: own.relative(other)
            for mate, other in zip(names, told, strict=True)
            if mate != name
        }
        cores[name] = ExplorerCore(settings, name, mates)
        rovers[name] = Rover(world, world.starts[name[-1]], frame, **(rover or {}))
    return Trial(world, cores, rovers, **options)


def is_done(run, name="robot_1"):
    return run.state(name) in ("complete", "stuck")


def explored(run, name="robot_1"):
    return run.rovers[name].explored(~run.world.wall)


def status(run, name="robot_1"):
    return run.outputs[name].status


# ---------------------------------------------------------------- one robot


@pytest.mark.parametrize("resolution", [0.03, 0.05, 0.07, 0.1])
def test_a_robot_explores_everything_at_any_resolution_and_returns(resolution):
    run = trial(rover={"resolution": resolution})
    run.world.open("a")
    run.until(lambda: is_done(run), 300)
    assert run.states["robot_1"] == ["exploring", "returning", "complete"]
    assert explored(run) > 0.93
    assert run.rovers["robot_1"].at.distance(run.world.starts["1"]) <= 0.5
    assert status(run).given_up == 0
    floor = (~run.world.wall).sum() * 0.05**2
    assert floor < status(run).known < 1.4 * floor  # also walls


@pytest.mark.parametrize("frame", [Place(3.333, -1.777), Place(2.0, 1.0, 0.6), Place(-5, 2, -2.5)])
def test_the_origin_of_the_map_and_its_yaw_do_not_matter(frame):
    run = trial(frames=[frame])
    run.until(lambda: is_done(run), 300)
    assert status(run).state == "complete"
    assert explored(run) > 0.93


def test_the_map_grows_and_changes_its_origin_meanwhile():
    mirrored = "\n".join(line[::-1] for line in TWO_ROOMS.strip().split("\n")[::-1])
    run = trial(mirrored, rover={"reach": 2.5})
    sizes, origins = set(), set()

    def grown():
        grid = run.cores["robot_1"].map
        if grid is not None:
            sizes.add(grid.percent.shape)
            origins.add(grid.origin[:2])
        return is_done(run)

    run.until(grown, 300)
    assert len(sizes) > 5
    assert len(origins) > 2


def test_poses_that_come_every_half_metre_are_enough():
    run = trial(poses_every=0.5, maps_every=5.0)
    run.until(lambda: is_done(run), 400)
    assert status(run).state == "complete"
    assert explored(run) > 0.93


@pytest.mark.parametrize(("seconds", "states"), [(20, 2), (150, 4)])
def test_a_robot_returns_when_the_way_back_opens(seconds, states):
    run = trial(DEAD_END)
    run.world.open("a")
    run.until(lambda: run.state("robot_1") == "returning", 300)
    assert run.rovers["robot_1"].at.x > 3.5  # behind the door
    run.world.close("a")
    run.run(seconds)
    run.rovers["robot_1"].goal = None  # as Nav2 drops what it cannot reach
    run.world.open("a")
    run.until(lambda: run.rovers["robot_1"].at.distance(run.world.starts["1"]) <= 0.5, 100)
    run.until(lambda: is_done(run), 20)
    assert len(run.states["robot_1"]) == 1 + states
    assert run.states["robot_1"][-2:] == ["returning", "complete"]


def test_a_teammate_that_stays_in_the_door_is_not_waited_for_forever():
    run = trial(DEAD_END, 2)
    run.world.open("a")
    run.until(lambda: run.state("robot_1") == "returning", 300)
    run.wheels = lambda name: name == "robot_1"
    run.rovers["robot_1"].at, run.rovers["robot_2"].at = Place(5.0, 1.1), Place(2.875, 1.125)
    run.until(lambda: is_done(run), 400)
    assert status(run).state == "complete"
    assert "the robot cannot return to its start" in status(run).sentence


@pytest.mark.parametrize("x", [5.2, 5.3, 5.5])
def test_a_robot_whose_wheels_stop_near_a_stage_of_its_way_back_says_so(x):
    """At a stage it has arrived, which must not count as a way that goes on."""
    run = trial(CORRIDOR, 2)
    run.until(lambda: run.state("robot_1") == "returning", 300)
    run.wheels = lambda name: False
    run.rovers["robot_2"].at, run.rovers["robot_1"].at = Place(4.0, 0.75), Place(x, 0.75)
    run.until(lambda: is_done(run), 500)


def test_counts_are_those_of_the_view_that_was_decided_on():
    """A frontier behind an obstacle where a robot has been is tried, given up and counted."""
    run = trial(DEAD_END, settings=ExplorerSettings(return_to_start=False))
    run.world.open("a")
    rover = run.rovers["robot_1"]
    run.until(lambda: rover.at.x > 3.2, 300)
    run.world.close("a")
    rover.at = Place(1.4, 1.1)  # put back
    run.until(lambda: is_done(run), 300)
    said = status(run)
    assert said.state == "stuck"
    assert said.given_up > 0
    assert said.frontiers >= said.given_up


def test_what_a_map_still_has_of_a_robot_that_has_left_is_no_wall():
    """The robot's own map shows an obstacle where it came in, and nobody is there any more."""
    run = trial(DEAD_END)
    run.world.open("a")
    rover = run.rovers["robot_1"]
    run.until(lambda: rover.at.x > 5, 300)
    rows, columns = rover._cells(np.full(20, 2.9), np.linspace(0.3, 2.2, 20))
    rover.score[rows, columns] = 6  # the door's cells
    run.until(lambda: is_done(run), 300)
    assert run.states["robot_1"] == ["exploring", "returning", "complete"]
    assert rover.at.distance(run.world.starts["1"]) <= 0.5


@pytest.mark.parametrize("seed", [0, 4, 14, 15])
def test_two_robots_that_meet_in_a_narrow_gap_do_not_give_up(seed):
    """A gap for one: whoever is second in the order of names stands aside first."""
    random = np.random.default_rng(seed)
    run = trial(NARROW, 2, frames=[Place(1.1, 1.6), Place(1.1, 2.6)], maps_every=2.0)
    for core in run.cores.values():
        advance, said = core.advance, []

        def late(now, advance=advance, said=said):
            if said and random.random() < 0.5:
                return said[-1]._replace(goal=None)
            said.append(advance(now))
            return said[-1]

        core.advance = late
    run.until(lambda: all(is_done(run, name) for name in run.cores), 100)
    for name, rover in run.rovers.items():
        assert status(run, name).state == "complete"
        assert status(run, name).given_up == 0
        assert rover.at.distance(run.world.starts[name[-1]]) <= 0.6
    assert explored(run) > 0.6


def test_a_robot_that_is_shut_in_says_so():
    run = trial(DEAD_END)
    run.world.open("a")
    run.until(lambda: run.state("robot_1") == "returning", 300)
    run.world.close("a")
    run.until(lambda: is_done(run), 200)
    assert status(run).state == "complete"
    assert "the robot cannot return to its start" in status(run).sentence


def test_without_a_return_it_stays():
    run = trial(settings=ExplorerSettings(return_to_start=False))
    run.until(lambda: is_done(run), 300)
    assert run.states["robot_1"] == ["exploring", "complete"]
    assert run.rovers["robot_1"].at.distance(run.world.starts["1"]) > 1


# ---------------------------------------------------------------- complete, and not too early


def test_without_map_or_place_it_waits_however_long():
    core = ExplorerCore()
    for now in range(1, 100):
        output = core.advance(float(now))
        assert (output.status.state, output.goal) == ("waiting", None)
    assert "map" in output.status.sentence
    run = trial()
    run.rovers["robot_1"].scan()
    core.take_map(run.rovers["robot_1"].map())
    output = core.advance(100.0)
    assert output.status.state == "waiting"
    assert "place" in output.status.sentence
    core.take_place(Place(90.0, 0.0))
    for now in range(101, 150):
        output = core.advance(float(now))
        assert (output.status.state, output.goal) == ("waiting", None)
    assert "(90.00, 0.00)" in output.status.sentence
    core.take_place(run.rovers["robot_1"].place)
    assert core.advance(150.0).goal is not None


def test_it_is_complete_only_after_the_settling_time():
    settings = ExplorerSettings(settle=7.0, return_to_start=False)
    core = ExplorerCore(settings)
    core.take_map(closed_room())
    core.take_place(Place(1.0, 1.0))
    states = [core.advance(0.5 * tick).status.state for tick in range(40)]
    assert states[:14] == ["exploring"] * 14
    assert states[-1] == "complete"
    assert states.index("complete") in (14, 15)


def test_a_frontier_that_appears_while_it_settles_is_explored():
    core = ExplorerCore(ExplorerSettings(return_to_start=False))
    core.take_map(closed_room())
    core.take_place(Place(1.0, 1.0))
    for tick in range(12):
        assert core.advance(0.5 * tick).goal is None
    core.take_map(closed_room(door=True))
    goals = [core.advance(6 + 0.5 * tick).goal for tick in range(6)]
    assert sum(goal is not None for goal in goals) == 1


def test_a_frontier_that_comes_and_goes_is_left_alone_in_the_end():
    core = ExplorerCore(ExplorerSettings(return_to_start=False))
    core.take_place(Place(0.5, 1.0))
    goals = []
    for tick in range(2000):
        if tick % 4 == 0:
            core.take_map(closed_room(door=tick % 8 == 0))
        output = core.advance(0.5 * tick)
        goals.append(output.goal)
    assert sum(goal is not None for goal in goals) < 40
    assert not any(goals[-1000:])
    assert output.status.state == "complete"


def closed_room(door=False):
    """2 m x 2 m; the door is 0.8 m wide, in the east."""
    percent = np.zeros((40, 40), np.int8)
    percent[[0, -1]] = percent[:, [0, -1]] = 100
    if door:
        percent[12:28, -1] = 0
    return OccupancyMap(percent, 0.05, Place(0.0, 0.0))


def test_short_frontiers_are_counted_and_ignored():
    output = None
    core = ExplorerCore(ExplorerSettings(min_frontier=1.0))
    core.take_map(closed_room(door=True))
    core.take_place(Place(1.0, 1.0))
    for tick in range(10):
        output = core.advance(float(tick))
    assert (output.status.frontiers, output.status.small) == (0, 1)


# ---------------------------------------------------------------- doors, glass, wheels


def test_a_door_that_closes_cuts_a_goal_off_and_one_that_opens_is_explored():
    run = trial(DEAD_END)
    door_at = run.world.size[0] * 11 / 28

    def heads_for_the_door():
        goal = run.rovers["robot_1"].goal
        return goal is not None and goal.x > door_at - 0.5

    run.until(heads_for_the_door, 60)
    run.world.close("a")
    run.until(lambda: is_done(run), 120)
    assert status(run).state == "complete"
    assert (status(run).given_up, status(run).exhausted) == (0, 0)
    assert run.rovers["robot_1"].at.x < door_at
    run.run(60)
    assert status(run).state == "complete"
    run.world.open("a")
    run.until(lambda: run.state("robot_1") == "exploring", 10)
    run.until(lambda: is_done(run), 200)
    assert explored(run) > 0.93


def test_an_obstacle_that_is_removed_does_not_stay():
    run = trial(DEAD_END)
    box = run.world.add_box(2.9, 1.3, 1.4)
    run.until(lambda: is_done(run), 120)
    assert explored(run) < 0.6
    run.world.wall[box] = False
    run.until(lambda: run.state("robot_1") == "exploring", 20)
    run.until(lambda: is_done(run), 200)
    assert explored(run) > 0.9


def test_goals_behind_glass_are_tried_twice_and_then_given_up():
    run = trial(DEAD_END.replace("a", "="))
    tried, core = [], run.cores["robot_1"]
    add = None

    def note():
        nonlocal add
        if core.mission is not None and add is None:
            add = core.mission.skips.add

            def noted(point, *rest):
                tried.append(point)
                add(point, *rest)

            core.mission.skips.add = noted
        return is_done(run)

    run.until(note, 900)
    assert run.states["robot_1"] == ["exploring", "returning", "stuck"]
    entries = [entry for entry in core.mission.skips.entries if not entry.in_vain]
    assert {entry.tries for entry in entries} == {2}
    assert {entry.reason for entry in entries} <= {"no progress", "refused", "too late"}
    assert len(tried) == 2 * len(entries) + 2 * sum(entry.changes for entry in entries)
    assert status(run).given_up >= 1
    assert "could not be reached in 2 tries" in status(run).sentence
    goals = len(run.rovers["robot_1"].goals)
    run.run(120)
    assert len(run.rovers["robot_1"].goals) == goals


def test_skipped_goals_come_after_all_others_and_once():
    """A corridor with two open ends, and a robot that has moved once."""
    percent = np.zeros((32, 160), np.int8)
    percent[[0, -1]] = 100
    core = ExplorerCore()
    core.take_map(OccupancyMap(percent, 0.05, Place(0.0, 0.0)))
    core.take_place(Place(2.6, 0.8))
    goals, states = [core.advance(0.0).goal], []
    core.take_place(Place(3.0, 0.8))
    for tick in range(400):
        output = core.advance(0.5 * tick)
        states.append(output.status.state)
        if output.goal is not None and output.goal not in goals[-1:]:
            goals.append(output.goal)
    ends = ["west" if goal.x < 4 else "east" for goal in goals]
    assert ends == ["west", "east", "west", "east"]
    assert states[-1] == "stuck"
    assert output.status.given_up == 2
    assert "refused" in output.status.sentence


def test_wheels_that_stand_still_for_a_while_cost_time_only():
    run = trial()
    run.wheels = lambda name: not 10 < run.now < 60
    run.until(lambda: run.outputs and status(run).skipped, 60)
    run.until(lambda: is_done(run), 400)
    assert status(run).state == "complete"
    assert explored(run) > 0.93


def test_a_robot_that_never_moves_asks_for_nav2_and_starts_when_that_does():
    run = trial(wheels=lambda name: False)
    run.run(200)
    assert status(run).state == "stuck"
    assert "Nav2" in status(run).sentence
    goals = run.rovers["robot_1"].goals
    assert len(goals) > 10
    run.wheels = lambda name: True
    run.until(lambda: is_done(run) and run.rovers["robot_1"].driven > 1, 400)
    assert status(run).state == "complete"
    assert explored(run) > 0.93


def test_a_goal_that_is_lost_is_sent_again():
    run = trial()
    core, lost = run.cores["robot_1"], []
    advance = core.advance

    def first_lost(now):
        output = advance(now)
        if output.goal is not None and not lost:
            lost.append(output.goal)
            output = output._replace(goal=None)
        return output

    core.advance = first_lost
    run.run(8)
    assert run.rovers["robot_1"].goals == lost
    assert status(run).skipped == 0


@pytest.mark.parametrize("jump", [-1000.0, 5000.0])
def test_a_clock_that_jumps_changes_nothing(jump):
    plain, jumping = trial(), trial()
    jumping.clock = lambda: 2000 + jumping.now + jump * (jumping.now > 10)
    for run in (plain, jumping):
        run.until(lambda run=run: is_done(run), 300)
    assert status(jumping).state == "complete"
    assert (status(jumping).skipped, status(jumping).given_up) == (0, 0)
    assert abs(jumping.now - plain.now) < 10


# ---------------------------------------------------------------- teams

FAR = """
################################################
#..............#...............................#
#..............#...............................#
#..............#...............................#
#..............................................#
#..............................................#
#..............#...............................#
#..............###############...###############
#..............................................#
#.......12.....................................#
#..............................................#
#..............###############...###############
#..............#...............................#
#..............................................#
#..............................................#
#..............#...............................#
#..............#...............................#
################################################
"""


def test_two_robots_share_the_work():
    alone, pair = trial(FAR), trial(FAR, 2)
    for run in (alone, pair):
        names = list(run.cores)
        run.until(lambda run=run, names=names: all(is_done(run, name) for name in names), 400)
    assert pair.now < 0.85 * alone.now
    union = sum(run_explored(pair, name) for name in pair.cores) > 0
    assert union[~pair.world.wall].mean() > 0.93
    driven = [rover.driven for rover in pair.rovers.values()]
    assert min(driven) > 0.4 * max(driven)


def run_explored(run, name):
    """Which true cells a robot has seen itself, bool [H, W]."""
    rover, wall = run.rovers[name], run.world.wall
    rows, columns = np.indices(wall.shape)
    side = run.world.resolution
    return rover.score[rover._cells((columns + 0.5) * side, (rows + 0.5) * side)] < 0


def test_maps_in_other_frames_are_merged_where_they_are():
    frames = [Place(1.0, 0.5, 0.3), Place(-2.0, 1.0, -1.2)]
    run = trial(FAR, 2, frames=frames)
    run.until(lambda: all(is_done(run, name) for name in run.cores), 400)
    for name in run.cores:
        assert status(run, name).state == "complete"
        assert "map merged" in status(run, name).team[0]


def test_robots_that_start_together_do_not_choose_the_same_goal_for_long():
    run = trial(FAR, 2)
    near = many = 0
    for _ in range(60):
        run.step()
        one, other = (rover.goal for rover in run.rovers.values())
        several = status(run).frontiers > 2 and one is not None and other is not None
        many += several
        near += several and one.distance(other) < 1.0
    assert many > 20
    assert near <= 4


def test_a_late_joiner_is_simply_heard():
    run = trial(FAR, 2)
    run.dead.add("robot_2")
    run.run(30)
    assert status(run).team == ("robot_2: not heard yet",)
    run.dead.clear()
    run.until(lambda: all(is_done(run, name) for name in run.cores), 400)
    assert run.rovers["robot_2"].driven > 3
    assert "map merged" in status(run).team[0]
    assert {status(run, name).state for name in run.cores} == {"complete"}


def test_a_lost_teammate_reserves_nothing_and_its_map_stays():
    run = trial(FAR, 2)
    run.run(25)
    reserved = run.rovers["robot_2"].goal
    run.dead.add("robot_2")
    run.rovers["robot_2"].at = Place(-50.0, -50.0)  # carried away
    run.until(lambda: is_done(run), 500)
    assert "lost, last heard" in status(run).team[0]
    assert status(run).state == "complete"
    core = run.cores["robot_1"]
    assert core.view.grid.code(core.view.grid.cell(reserved)) == 0
    assert core.view.rivals == ()


@pytest.mark.parametrize("wrong", [Place(4.0, 0.0, math.pi / 2), Place(1.2, 0.9), Place(0, 0, 0.4)])
def test_a_map_that_contradicts_is_refused_with_numbers(wrong):
    run = trial(TWO_ROOMS, 2, told=[Place(0.0, 0.0), wrong])
    run.until(lambda: is_done(run), 400)
    said = status(run).team[0]
    assert "map refused" in said
    assert "of walls contradict" in said
    assert explored(run) > 0.9  # itself
    assert run.cores["robot_1"].view.rivals == ()


def test_a_closed_door_alone_is_no_contradiction():
    run = trial(DEAD_END, 2, settings=ExplorerSettings(return_to_start=False))
    run.until(lambda: run.rovers["robot_1"].at.x > 3.2 or run.rovers["robot_2"].at.x > 3.2, 100)
    run.world.close("a")
    run.run(60)
    for name in run.cores:
        assert "map merged" in status(run, name).team[0]


def test_a_teammate_in_a_door_is_no_wall_until_it_is_lost():
    run = trial(DEAD_END, 2)
    run.wheels = lambda name: False
    run.rovers["robot_2"].at = at = Place(2.875, 1.125)  # in the door

    def passes():
        view = run.cores["robot_1"].view
        return view.nearest_reached(Place(4.5, 1.125)) is not None

    run.run(3)
    seen = run.rovers["robot_1"].map()
    window, distance = seen.around((at.x, at.y), 0.25)
    assert (seen.percent[window][distance < 0.25] == 100).any()  # it is in the map
    assert passes()
    run.run(60)  # however long it stands there
    assert passes()
    run.dead.add("robot_2")
    run.run(70)
    assert not passes()


# ---------------------------------------------------------------- random worlds


def random_plan(chance, robots):
    """Walls with two doors each, across and along, and robots in the open."""
    height, width = chance.integers(14, 24), chance.integers(20, 40)
    plan = np.full((height, width), ".")
    for _ in range(4):
        for across in (plan, plan.T):
            wall = across[chance.integers(3, len(across) - 3)]
            wall[:] = "#"
            for door in chance.integers(2, len(wall) - 6, 2):
                wall[door : door + 4] = "."
    plan[[0, -1]] = plan[:, [0, -1]] = "#"
    open_ = [
        cell
        for cell in np.ndindex(plan.shape)
        if (plan[max(cell[0] - 1, 0) : cell[0] + 2, max(cell[1] - 1, 0) : cell[1] + 2] == ".").all()
    ]
    for robot, index in enumerate(chance.permutation(len(open_))[:robots]):
        plan[open_[index]] = str(robot + 1)
    return "\n".join("".join(row) for row in plan)


@pytest.mark.parametrize("seed", range(6))
def test_teams_of_any_size_come_to_an_end_in_random_worlds(seed):
    chance = np.random.default_rng(seed)
    robots = 1 + seed % 3
    frames = [Place(*chance.uniform(-2, 2, 2), chance.uniform(-3, 3)) for _ in range(robots)]
    options = {"resolution": chance.choice([0.03, 0.05, 0.1])}
    run = trial(random_plan(chance, robots), robots, frames=frames, rover=options, maps_every=2.0)
    run.until(lambda: all(is_done(run, name) for name in run.cores), 900)
    side = run.world.resolution
    fits, _ = label(distance_transform_edt(~run.world.wall) * side > 0.22)
    for name in run.cores:
        at = run.world.starts[name[-1]]
        rooms = fits == fits[int(at.y / side), int(at.x / side)]
        seen = sum(run_explored(run, mate).astype(int) for mate in run.cores) > 0
        assert seen[rooms].mean() > 0.93, status(run, name)
