"""From a scan to the cells around a robot: an inverse sensor model, beam by beam."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.checks import require_integer, require_not_negative, require_positive
from marl_explore.config.constants import FREE, OCCUPIED, UNKNOWN
from marl_explore.config.fields import check_types
from marl_explore.robot.geometry import Frame, GridCell
from marl_explore.robot.messages import Pose, Scan

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class BeamModel:
    """How beams vote for cells."""

    entry_tolerance: float = 0.12
    """Largest distance of a return from where its beam enters the cell it votes for (metres)."""
    margin: float = 0.08
    """Beams that only touch the rim of a cell do not vote on it; the rim's width (metres)."""
    robot_radius: float = 0.16
    """Returns closer than this to a known robot are its body (metres)."""
    votes: int = 3
    """Minimum number of votes to decide a cell."""
    lidar_ahead: float = 0.0
    """Position of the lidar, ahead of the middle of the robot (metres)."""

    def __post_init__(self) -> None:
        """Check the settings."""
        check_types(self)
        require_positive("entry_tolerance", self.entry_tolerance, "metres")
        for name in ("margin", "robot_radius"):
            require_not_negative(name, getattr(self, name), "metres")
        require_integer("votes", self.votes, 1)
        if not math.isfinite(self.lidar_ahead):
            raise ValueError(
                f"lidar_ahead={self.lidar_ahead!r} is not allowed: it must be a finite number of "
                "metres"
            )


def sight(
    scan: Scan,
    pose: Pose,
    others: Iterable[Pose],
    frame: Frame,
    radius: int,
    model: BeamModel | None = None,
) -> NDArray[np.int8]:
    """The cells of the square around a robot, row 0 north.

    Faces of obstacles lie on cell borders, so a return votes for the cell whose border its beam
    enters there, and the beam votes against the cells that it has passed through.

    Args:
        scan: one turn of the lidar.
        pose: of the robot, when the scan was taken.
        others: poses of the other robots at that time.
        frame: the arena's grid.
        radius: half side k of the square (cells).
        model: how beams vote.

    Returns:
        int8 [2k + 1, 2k + 1]: unknown, free (also where a robot stands) or occupied. Cells outside
        the arena, and a diagonal cell behind two obstacles, are unknown.
    """
    model = model or BeamModel()
    others = list(others)
    cells = square(frame.cell(pose.x, pose.y), radius)
    eye = pose.ahead(model.lidar_ahead)
    centres = np.array([frame.centre(cell) for cell in cells]) - (eye.x, eye.y)
    distance, returned, heading = _beams(scan, eye)
    side = 2 * radius + 1
    votes_for, votes_against = _votes(centres, heading, distance, frame.cell_size, model)
    votes_for &= returned & ~_on_robots(distance, heading, eye, others, model.robot_radius)
    hits, misses = votes_for.sum(-1), votes_against.sum(-1)
    seen = np.full(len(cells), UNKNOWN, np.int8)
    seen[(misses >= model.votes) & (misses >= hits)] = FREE
    seen[(hits >= model.votes) & (hits > misses)] = OCCUPIED
    robots = {frame.cell(other.x, other.y) for other in others}
    for index, cell in enumerate(cells):
        if cell in robots:
            seen[index] = FREE
        if not frame.inside(cell):
            seen[index] = UNKNOWN
    seen[len(cells) // 2] = FREE
    return _hide_corners(seen.reshape(side, side))


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


def _beams(scan: Scan, pose: Pose) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """Lengths [R] and headings [R, 2] of valid beams, and which of them returned."""
    ranges = np.asarray(scan.ranges, np.float64)
    nothing = ((ranges == 0) | np.isnan(ranges) | (ranges >= scan.range_max)) & scan.is_on
    angle = pose.yaw + scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    says = nothing | (ranges > scan.range_min)
    length = np.where(nothing, scan.range_max, ranges)[says]
    heading = np.stack((np.cos(angle), np.sin(angle)), -1)[says]
    return length, ~nothing[says], heading


def _on_robots(
    distance: Floats, heading: Floats, pose: Pose, others: list[Pose], radius: float
) -> NDArray[np.bool_]:
    """Beams [R] that end at a known robot."""
    ends = heading * distance[:, None] + (pose.x, pose.y)
    on = np.zeros(len(distance), bool)
    for other in others:
        on |= np.hypot(*(ends - (other.x, other.y)).T) < radius
    return on


def _votes(
    centres: Floats, heading: Floats, distance: Floats, side: float, model: BeamModel
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which beams vote for and against cells, bool [C, R] each."""
    enters, leaves = _crossings(centres, heading, side / 2)
    error = np.abs(distance - enters)
    error[(leaves - enters <= model.margin) | (enters <= 0)] = math.inf
    best = np.zeros(error.shape, bool)
    np.put_along_axis(best, error.argmin(0)[None], True, 0)  # only the cell that fits best
    votes_for = best & (error < model.entry_tolerance)
    enters, leaves = _crossings(centres, heading, side / 2 - model.margin)
    through = (leaves > enters) & (leaves > 0)
    through &= distance > np.maximum(enters, 0) + 2 * model.margin
    return votes_for, through & ~votes_for


def _crossings(centres: Floats, heading: Floats, half: float) -> tuple[Floats, Floats]:
    """Distances along each beam at which the squares around centres begin and end, [C, R] each."""
    slope = np.where(np.abs(heading) < 1e-9, 1e-9, heading)[None]
    low = (centres[:, None] - half) / slope
    high = (centres[:, None] + half) / slope
    return np.minimum(low, high).max(-1), np.maximum(low, high).min(-1)
