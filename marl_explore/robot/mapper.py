"""From a scan to the cells around a robot: an inverse sensor model, beam by beam."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.checks import (
    require_integer,
    require_not_negative,
    require_positive,
)
from marl_explore.config.constants import FREE, OCCUPIED, UNKNOWN
from marl_explore.config.fields import check_types
from marl_explore.robot.driving import LARGEST
from marl_explore.robot.geometry import Disc, Frame, GridCell, Mount
from marl_explore.robot.messages import Pose, Scan

Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class BeamModel:
    """How beams vote for cells."""

    tolerance: float = 0.12
    """Returns this near to another cell that may have caused them do not vote (metres)."""
    margin: float = 0.08
    """Beams that only touch the rim of a cell do not vote on it; the rim's width (metres)."""
    robot_radius: float = 0.16
    """Returns closer than this to a known robot are its body (metres)."""
    votes: int = 3
    """Minimum number of votes to decide a cell."""
    zero_is_no_return: bool = False
    """Whether a range of 0 means that nothing came back, as from a TurtleBot3's LDS-01."""
    lidar_x: float = 0.0
    """Position of the lidar, ahead of the middle of the robot (metres)."""
    lidar_y: float = 0.0
    """Position of the lidar, left of the middle of the robot (metres)."""
    lidar_yaw: float = 0.0
    """Heading of the lidar, 0 ahead, counter-clockwise (radians)."""

    def __post_init__(self) -> None:
        """Check the settings."""
        check_types(self)
        require_positive("tolerance", self.tolerance, "metres", LARGEST)
        for name in ("margin", "robot_radius"):
            require_not_negative(name, getattr(self, name), "metres", LARGEST)
        require_integer("votes", self.votes, 1)
        self.mount.check("lidar_")

    @property
    def mount(self) -> Mount:
        """Where the lidar is on the robot."""
        return Mount(self.lidar_x, self.lidar_y, self.lidar_yaw)


class _Beams(NamedTuple):
    """The beams that say something, as seen from the lidar."""

    heading: Floats
    """[R, 2]."""
    length: Floats
    """[R] (metres)."""
    returned: Mask
    """Whether something came back, other than a robot's body [R]."""


def sight(
    scan: Scan,
    pose: Pose,
    others: Iterable[Pose],
    frame: Frame,
    radius: int,
    model: BeamModel | None = None,
    astray: Iterable[Disc] = (),
) -> NDArray[np.int8]:
    """The cells of the square around a robot, row 0 north.

    A beam votes against the cells whose core it has crossed. A return votes for the cell that holds
    the point just behind it, unless it is near another cell that may have caused it: one that this
    scan does not find free.

    Args:
        scan: one turn of the lidar.
        pose: of the robot, when the scan was taken.
        others: poses of the other robots at that time.
        frame: the arena's grid.
        radius: half side k of the square (cells).
        model: how beams vote.
        astray: where robots may be whose poses are not known then; returns there do not vote.

    Returns:
        int8 [2k + 1, 2k + 1]: unknown, free (also where a robot stands) or occupied. Cells outside
        the arena, and a diagonal cell behind two obstacles, are unknown.
    """
    model = model or BeamModel()
    others = list(others)
    cells = square(frame.cell(pose.x, pose.y), radius + 1)  # what is behind may have returned too
    eye = pose.of_sensor(scan.mount or model.mount)
    bodies = [Disc(other.x, other.y, 0.0) for other in others] + list(astray)
    beams = _beams(scan, eye, bodies, model)
    centres = np.array([frame.centre(cell) for cell in cells]) - (eye.x, eye.y)
    stood_in = {frame.cell(robot.x, robot.y) for robot in (pose, *others)}
    robots = np.array([cell in stood_in for cell in cells])
    seen = _decide(centres, beams, robots, frame.cell_size, model)
    seen[robots] = FREE
    seen[[not frame.inside(cell) for cell in cells]] = UNKNOWN
    seen[len(cells) // 2] = FREE
    return _hide_corners(seen.reshape(2 * radius + 3, -1)[1:-1, 1:-1])


def returns(scan: Scan, pose: Pose, robots: Iterable[Disc], model: BeamModel) -> Floats:
    """Where beams ended, in the arena's frame [P, 2] (metres); not those that met a robot.

    Something too close to measure (-inf, REP 117) is as near as the lidar can measure.

    Args:
        scan: one turn of the lidar.
        pose: of the robot, when the scan was taken.
        robots: where others were, or may have been.
        model: how beams vote.
    """
    eye = pose.of_sensor(scan.mount or model.mount)
    ranges = np.asarray(scan.ranges, np.float64)
    nearest = np.nextafter(scan.range_min, np.inf)
    scan = replace(scan, ranges=np.where(np.isneginf(ranges), nearest, ranges))
    beams = _beams(scan, eye, robots, model)
    ends: Floats = (beams.heading * beams.length[:, None])[beams.returned] + (eye.x, eye.y)
    return ends


def square(cell: GridCell, radius: int) -> list[GridCell]:
    """The cells of the square around a cell, row by row."""
    steps = range(-radius, radius + 1)
    return [(cell[0] + row, cell[1] + column) for row in steps for column in steps]


def hidden_corners(occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Diagonal neighbours of the middle behind two occupied cells, bool like ``occupied``."""
    hidden = np.zeros_like(occupied)
    middle = len(occupied) // 2
    for row in (-1, 1):
        for column in (-1, 1):
            beside = occupied[middle + row, middle] & occupied[middle, middle + column]
            hidden[middle + row, middle + column] = beside
    return hidden


def _hide_corners(seen: NDArray[np.int8]) -> NDArray[np.int8]:
    seen[hidden_corners(seen == OCCUPIED)] = UNKNOWN
    return seen


def _beams(scan: Scan, eye: Pose, bodies: Iterable[Disc], model: BeamModel) -> _Beams:
    ranges = np.asarray(scan.ranges, np.float64)
    nothing = ranges >= scan.range_max
    if model.zero_is_no_return and scan.is_on:
        nothing |= ranges == 0
    says = nothing | (ranges > scan.range_min)  # not NaN
    angle = eye.yaw + scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    heading = np.stack((np.cos(angle), np.sin(angle)), -1)[says]
    length = np.where(nothing, scan.range_max, ranges)[says]
    ends = heading * length[:, None] + (eye.x, eye.y)
    returned = ~nothing[says]
    for body in bodies:
        returned &= np.hypot(*(ends - body[:2]).T) >= model.robot_radius + body.radius
    return _Beams(heading, length, returned)


def _decide(
    centres: Floats, beams: _Beams, robots: Mask, side: float, model: BeamModel
) -> NDArray[np.int8]:
    """Unknown, free or occupied by the votes of all beams, int8 [C].

    Args:
        centres: middles of the square's cells, as seen from the lidar [C, 2] (metres).
        beams: of the scan.
        robots: cells in which a robot stands [C].
        side: of a cell (metres).
        model: how beams vote.
    """
    half = side / 2
    ends = beams.heading * beams.length[:, None]
    outside = np.where(beams.returned, _outside(centres, ends, half), np.inf)
    behind = _outside(centres, ends + beams.heading * model.margin, half)
    holds = (behind < 0) & beams.returned
    crossed = _crossed(centres, beams, half - model.margin).sum(-1)
    free = robots | ((crossed >= model.votes) & (crossed >= holds.sum(-1)))
    clear = ~((outside < model.tolerance) & ~holds & ~free[:, None]).any(0)
    in_the_open = (holds & free[:, None]).any(0)  # no box, so it may be in both cells
    hits = ((holds | ((outside < 0) & in_the_open)) & clear).sum(-1)
    deep = (outside < -model.margin).any(-1)  # a thin pole may return a single beam
    seen = np.full(len(centres), UNKNOWN, np.int8)
    seen[free & (2 * hits < model.votes) & ~deep] = FREE
    seen[hits >= model.votes] = OCCUPIED
    return seen


def _outside(centres: Floats, points: Floats, half: float) -> Floats:
    """How far points [P, 2] are outside the squares around centres [C, 2], negative inside [C, P].

    The larger of the distances along x and y counts (metres).
    """
    return np.abs(centres[:, None] - points).max(-1) - half


def _crossed(centres: Floats, beams: _Beams, half: float) -> Mask:
    """Which beams have crossed the squares around centres, [C, R]."""
    slope = np.where(np.abs(beams.heading) < 1e-9, 1e-9, beams.heading)[None]
    low = (centres[:, None] - half) / slope
    high = (centres[:, None] + half) / slope
    enters, leaves = np.minimum(low, high).max(-1), np.maximum(low, high).min(-1)
    return (leaves > np.maximum(enters, 0)) & (beams.length > leaves)
