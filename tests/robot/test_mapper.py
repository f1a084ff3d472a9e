"""Scans become cells: known answers for one robot in the middle of its cell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from marl_explore.robot import Pose, Scan
from marl_explore.robot.geometry import Disc, Frame, Mount
from marl_explore.robot.mapper import BeamModel, sight
from tests.helpers.boards import arena
from tests.helpers.robot_world import scan_of

BOARD = """
    ......
    ..#...
    ..01..
    .#....
    ......
"""


def drawn(codes):
    """Rows of ?, . and #."""
    return ["".join("?.#"[code + 1] for code in row) for row in codes.tolist()]


def seen(board, robot=0, yaw=0.3, known=True, change=None, offset=(0.0, 0.0), **model):
    """What a robot of a drawn arena sees, drawn."""
    obstacles, positions = arena(board)
    frame = Frame(*obstacles.shape, 0.5)
    poses = [
        Pose(0.0, i, *np.add(frame.centre(tuple(cell)), offset), yaw)
        for i, cell in enumerate(positions.tolist())
    ]
    others = [pose for pose in poses if pose.robot != robot]
    scan = scan_of(obstacles.numpy(), frame, poses[robot], others)
    scan = Scan(0.0, change(scan.ranges) if change else scan.ranges)
    return drawn(sight(scan, poses[robot], others * known, frame, 1, BeamModel(**model)))


@pytest.mark.parametrize("yaw", [0.0, 0.3, math.pi / 4, -2.0])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.03, -0.03), (-0.03, 0.02)])
def test_obstacles_and_free_cells_whatever_the_heading(yaw, offset):
    assert seen(BOARD, yaw=yaw, offset=offset) == [".#.", "...", "#.."]


HEADINGS = np.linspace(-math.pi, math.pi, 25)
MOUNTS = [
    (-0.032, 0.0, 0.0),  # of a TurtleBot3 Burger
    (-0.064, 0.0, 0.0),  # and of a Waffle
    (0.0, 0.07, math.pi / 2),
    (0.05, -0.06, math.pi),
    (-0.08, 0.03, -2.0),
]


@pytest.mark.parametrize("mount", MOUNTS)
def test_wherever_a_lidar_is_mounted_it_sees_the_same(mount):
    """By the settings, or by the scan, which then knows better."""
    obstacles, positions = arena(BOARD)
    frame = Frame(*obstacles.shape, 0.5)
    places = [frame.centre(tuple(cell)) for cell in positions.tolist()]
    by_settings = BeamModel(**dict(zip(("lidar_x", "lidar_y", "lidar_yaw"), mount, strict=True)))
    for yaw in HEADINGS:
        pose, other = (Pose(0.0, robot, *place, yaw) for robot, place in enumerate(places))
        scan = scan_of(obstacles.numpy(), frame, pose, [other], mount=Mount(*mount))
        said = replace(scan, mount=Mount(*mount))
        for taken, model in ((scan, by_settings), (said, None), (said, BeamModel(lidar_yaw=1.0))):
            codes = sight(taken, pose, [other], frame, 1, model)
            assert drawn(codes) == [".#.", "...", "#.."], (mount, yaw)


def test_a_sensor_is_ahead_and_left_of_where_its_robot_heads():
    pose = Pose(1.0, 2, 0.5, -0.5, math.pi / 2).of_sensor(Mount(0.25, 0.125, 0.5))
    assert (pose.x, pose.y) == (pytest.approx(0.375), pytest.approx(-0.25))
    assert pose.yaw == math.pi / 2 + 0.5


def test_a_known_robot_is_no_obstacle_and_an_unknown_one_is_not_free_space():
    assert seen(BOARD, known=True)[1] == "..."
    assert seen(BOARD.replace("1", "."))[1] == "..."
    assert seen(BOARD, known=False)[1] == "..#"


@pytest.mark.parametrize(
    ("board", "expected"),
    [
        (".#.\n#0.\n...", ["?#.", "#..", "..."]),
        ("##.\n#0.\n...", ["?#.", "#..", "..."]),
        ("###\n#0#\n###", ["?#?", "#.#", "?#?"]),
        ("#.#\n.0.\n#.#", ["#.#", "...", "#.#"]),
    ],
)
def test_behind_two_obstacles_it_stays_unknown(board, expected):
    assert seen(board) == expected


def test_outside_of_the_arena_nothing_is_seen():
    assert seen("0..\n.#.\n...") == ["???", "?..", "?.#"]


def with_one_return(ranges, value):
    """That value everywhere but for one beam, which tells that the lidar is on."""
    return np.concatenate((np.full_like(ranges[1:], value), [3.0]))


EMPTY = "...\n.0.\n..."
NOTHING_SEEN = ["???", "?.?", "???"]


@pytest.mark.parametrize("turn", [with_one_return, np.full_like])
@pytest.mark.parametrize("nothing", [math.inf, 3.5, 9.0])
def test_no_return_means_nothing_there(nothing, turn):
    assert seen(EMPTY, change=lambda ranges: turn(ranges, nothing)) == ["..."] * 3


@pytest.mark.parametrize("nothing", [0.0, math.nan, 0.05, 0.12, -1.0, -math.inf])
def test_ranges_that_are_invalid_or_too_short_say_nothing(nothing):
    assert seen(EMPTY, change=lambda r: with_one_return(r, nothing)) == NOTHING_SEEN


def test_a_range_of_zero_is_no_return_for_lidars_that_say_so():
    def zeros(ranges):
        return with_one_return(ranges, 0.0)

    assert seen(EMPTY, change=zeros, zero_is_no_return=True) == ["..."] * 3
    assert seen(EMPTY, change=np.zeros_like, zero_is_no_return=True) == NOTHING_SEEN  # it is off


@pytest.mark.parametrize("off", [0.0, math.nan, 0.12])
def test_a_lidar_that_is_off_or_covered_sees_nothing(off):
    def switched_off(ranges):
        ranges[:] = off
        ranges[::2] = 0.0
        return ranges

    assert seen(BOARD, change=switched_off) == ["???", "?..", "???"]  # a robot stands east


def test_few_beams_decide_nothing():
    def almost_all_broken(ranges):
        ranges[2:] = 0.01
        return ranges

    assert seen(BOARD, change=almost_all_broken) == ["???", "?..", "???"]  # a robot stands east


def test_noise_of_five_percent_changes_no_cell():
    chance = np.random.default_rng(0)
    for _ in range(50):
        noisy = seen(BOARD, change=lambda r: r * (1 + 0.05 * chance.standard_normal(r.shape)))
        assert noisy == [".#.", "...", "#.."]


def test_a_wider_field_of_view_sees_no_cell_behind_an_obstacle():
    obstacles, positions = arena(".....\n..#..\n..0..\n....#\n#....")
    frame = Frame(5, 5, 0.5)
    pose = Pose(0.0, 0, *frame.centre(tuple(positions[0].tolist())), 1.0)
    codes = sight(scan_of(obstacles.numpy(), frame, pose), pose, [], frame, 2)
    assert drawn(codes) == [".???.", "..#..", ".....", "....#", "#...."]


# ---------------------------------------------------------------- parts of a turn

FRAME = Frame(7, 7, 0.5)
MIDDLE = np.s_[2:5, 2:5]
"""What a robot in the middle of that sees around it."""


def blinded(scan, first, last):
    """As if the beams from first on, before last, could not measure."""
    ranges = scan.ranges.copy()
    ranges[first:last] = math.nan
    return replace(scan, ranges=ranges)


def narrowed(scan, first, last):
    """As from a lidar without those beams."""
    turn = np.roll(scan.ranges, -last)[: len(scan.ranges) - last + first]
    return replace(scan, ranges=turn, angle_min=scan.angle_increment * (last - len(scan.ranges)))


def test_nan_says_nothing_about_what_is_behind_a_robot():
    obstacles = np.zeros((7, 7), bool)
    obstacles[3, 2] = True  # behind a robot that heads east
    pose = Pose(0.0, 0, 0.0, 0.0, 0.0)
    scan = scan_of(obstacles, FRAME, pose)
    assert drawn(sight(scan, pose, [], FRAME, 1)) == ["...", "#..", "..."]
    scan.ranges[46:315] = math.nan
    assert drawn(sight(scan, pose, [], FRAME, 1)) == ["??.", "?..", "??."]


@pytest.mark.parametrize("part", [blinded, narrowed])
@pytest.mark.parametrize("blind", [(136, 225), (91, 270), (46, 315)])
def test_part_of_a_turn_gets_no_cell_wrong(part, blind):
    """Of 1200 cells around a lidar of 271, 181 and 91 degrees that is somewhere in its cell."""
    chance = np.random.default_rng(0)
    wrong, told = 0, 0
    for _ in range(150):
        obstacles = chance.random((7, 7)) < 0.3
        obstacles[3, 3] = False
        pose = Pose(0.0, 0, *chance.uniform(-0.1, 0.1, 2), chance.uniform(-math.pi, math.pi))
        codes = sight(part(scan_of(obstacles, FRAME, pose), *blind), pose, [], FRAME, 1)
        wrong += ((codes >= 0) & (codes != obstacles[MIDDLE])).sum()
        told += (codes >= 0).sum() - 1
    assert wrong == 0
    assert told > 0.75 * 1200 * (360 - blind[1] + blind[0]) / 360


# ---------------------------------------------------------------- things that fill no cell


def seen_with(poles=(), walls=(), yaw=0.0, noise=None):
    pose = Pose(0.0, 0, 0.0, 0.0, yaw)
    scan = scan_of(np.zeros((7, 7), bool), FRAME, pose, poles=poles, walls=walls)
    ranges = scan.ranges if noise is None else scan.ranges * (1 + noise)
    return sight(replace(scan, ranges=ranges), pose, [], FRAME, 1)


def test_a_cell_with_a_pole_of_5_centimetres_is_not_free():
    """Wherever it stands in its cell, also where its beams enter that cell or leave it."""
    chance = np.random.default_rng(1)
    for _ in range(400):
        x, y = chance.uniform(-0.72, 0.72, 2)
        reached = {
            FRAME.cell(x + right, y + up) for right in (-0.025, 0.025) for up in (-0.025, 0.025)
        }
        codes = seen_with([(x, y, 0.025)], yaw=chance.uniform(-math.pi, math.pi))
        touched = [codes[cell[0] - 2, cell[1] - 2] for cell in reached - {(3, 3)} if on_view(cell)]
        assert (3, 3) in reached or any(code != 0 for code in touched), (x, y)


def on_view(cell):
    return max(abs(cell[0] - 3), abs(cell[1] - 3)) <= 1


def test_a_pole_is_the_only_thing_that_is_not_free():
    assert drawn(seen_with([(0.0, 0.5, 0.025)])) == [".#.", "...", "..."]
    assert drawn(seen_with([(0.45, -0.55, 0.025)])) == ["...", "...", "..#"]


@pytest.mark.parametrize("north", np.arange(0.27, 0.63, 0.03).tolist())
@pytest.mark.parametrize("slope", [0.0, 0.1])
def test_cells_with_a_wall_off_the_grid_are_occupied(north, slope):
    wall = ((-9, north - 9 * slope), (9, north + 9 * slope))
    for yaw in HEADINGS:
        above, level, below = drawn(seen_with(walls=[wall], yaw=yaw))
        assert above[1] == "#"
        assert "." not in above
        assert (level, below) == ("...", "...")


@pytest.mark.parametrize("share", [0.0, 0.02, 0.05])
def test_on_open_ground_noise_makes_no_things(share):
    chance = np.random.default_rng(2)
    for _ in range(30):
        assert drawn(seen_with(noise=share * chance.standard_normal(360))) == ["..."] * 3


# ---------------------------------------------------------------- robots that are not heard


def test_where_a_robot_may_be_that_is_not_heard_returns_do_not_vote():
    """It was east of the other, and may have gone on by 30 cm."""
    obstacles, positions = arena(BOARD)
    frame = Frame(*obstacles.shape, 0.5)
    pose, other = (
        Pose(0.0, i, *frame.centre(tuple(cell)), 0.3) for i, cell in enumerate(positions.tolist())
    )
    scan = scan_of(obstacles.numpy(), frame, pose, [replace(other, y=other.y + 0.3)])
    for north, expected in ((0.0, ".#."), (5.0, ".##")):
        astray = [Disc(other.x, other.y + north, 0.3)]
        assert drawn(sight(scan, pose, [], frame, 1, astray=astray)) == [expected, "...", "#.."]


def test_where_a_robot_may_be_that_is_not_heard_cells_can_be_free():
    assert drawn(sight_beside([Disc(0.5, 0.0, 0.5)])) == ["..."] * 3


def sight_beside(astray):
    pose = Pose(0.0, 0, 0.0, 0.0, 0.0)
    scan = scan_of(np.zeros((7, 7), bool), FRAME, pose)
    return sight(scan, pose, [], FRAME, 1, astray=astray)
