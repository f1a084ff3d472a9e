"""Scans become cells: known answers for one robot in the middle of its cell."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_explore.robot import Pose, Scan
from marl_explore.robot.geometry import Frame
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


def seen(board, robot=0, yaw=0.3, known=True, change=lambda ranges: ranges, offset=(0.0, 0.0)):
    """What a robot of a drawn arena sees: rows of ?, . and #."""
    obstacles, positions = arena(board)
    frame = Frame(*obstacles.shape, 0.5)
    poses = [
        Pose(0.0, i, *np.add(frame.centre(tuple(cell)), offset), yaw)
        for i, cell in enumerate(positions.tolist())
    ]
    others = [pose for pose in poses if pose.robot != robot]
    scan = scan_of(obstacles.numpy(), frame, poses[robot], others)
    scan = Scan(0.0, change(scan.ranges))
    codes = sight(scan, poses[robot], others if known else [], frame, 1)
    return ["".join("?.#"[code + 1] for code in row) for row in codes.tolist()]


@pytest.mark.parametrize("yaw", [0.0, 0.3, math.pi / 4, -2.0])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.03, -0.03), (-0.03, 0.02)])
def test_obstacles_and_free_cells_whatever_the_heading(yaw, offset):
    assert seen(BOARD, yaw=yaw, offset=offset) == [".#.", "...", "#.."]


@pytest.mark.parametrize("behind", [0.032, 0.064])
def test_a_lidar_behind_the_middle_sees_the_same(behind):
    """Of a TurtleBot3 Burger and a Waffle, in every heading."""
    obstacles, positions = arena(BOARD)
    frame = Frame(*obstacles.shape, 0.5)
    places = [frame.centre(tuple(cell)) for cell in positions.tolist()]
    for yaw in np.linspace(-math.pi, math.pi, 25):
        pose, other = (Pose(0.0, robot, *place, yaw) for robot, place in enumerate(places))
        scan = scan_of(obstacles.numpy(), frame, pose.ahead(-behind), [other])
        codes = sight(scan, pose, [other], frame, 1, BeamModel(lidar_ahead=-behind))
        assert codes.tolist() == [[0, 1, 0], [0, 0, 0], [1, 0, 0]]


def test_ahead_is_where_a_robot_heads():
    pose = Pose(1.0, 2, 0.5, -0.5, math.pi / 2).ahead(0.25)
    assert (pose.x, pose.y) == (pytest.approx(0.5), -0.25)


def test_a_known_robot_is_no_obstacle_and_an_unknown_one_is_not_free_space():
    assert seen(BOARD, known=True)[1] == "..."
    assert seen(BOARD.replace("1", "."))[1] == "..."
    assert seen(BOARD, known=False)[1] != "..#."


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


@pytest.mark.parametrize("nothing", [0.0, math.inf, math.nan, 3.5, 9.0])
def test_no_return_means_nothing_there(nothing):
    assert seen("...\n.0.\n...", change=lambda r: with_one_return(r, nothing)) == ["..."] * 3


@pytest.mark.parametrize("nothing", [math.inf, 3.5, 9.0])
def test_a_turn_beyond_the_range_means_nothing_there(nothing):
    assert seen("...\n.0.\n...", change=lambda r: np.full_like(r, nothing)) == ["..."] * 3


@pytest.mark.parametrize("off", [0.0, math.nan, 0.12])
def test_a_lidar_that_is_off_or_covered_sees_nothing(off):
    def switched_off(ranges):
        ranges[:] = off
        ranges[::2] = 0.0
        return ranges

    assert seen(BOARD, change=switched_off) == ["???", "?..", "???"]  # a robot stands east


@pytest.mark.parametrize("broken", [0.05, -1.0, -math.inf])
def test_ranges_below_the_least_say_nothing(broken):
    assert seen("...\n.0.\n...", change=lambda r: np.full_like(r, broken)) == ["???", "?.?", "???"]


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
    rows = ["".join("?.#"[code + 1] for code in row) for row in codes.tolist()]
    assert rows == [".???.", "..#..", ".....", "....#", "#...."]
