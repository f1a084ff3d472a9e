"""Cells that fit a map: the coarsest grid that keeps every way a robot can drive."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from marl_explore.arenas.generator import Board
from marl_explore.arenas.images import MapFile
from marl_explore.arenas.map_files import IMAGES
from marl_explore.arenas.maps import resample
from marl_explore.config.constants import TOLERANCE

PIXEL_M = 0.05
"""Side of a pixel where neither file nor user gives one (metres): that of most robots' maps."""
DRAWN_SIDE = 128
"""An image of at most so many pixels a side is a drawing: a pixel is a cell."""
JOINED = 0.9
"""Share of the places with room for a robot that counts as most of them."""
KEPT = 0.005
"""Share of the drivable area that a grid may lose and still counts as keeping all of it."""
WARNING = 0.02
"""Share of the area from which on a reading is warned of."""


class CellFit(NamedTuple):
    """How well a grid of cells keeps what a robot can drive on."""

    pixels_per_cell: float
    lost: float
    """Share of the drivable area that no connected part of the grid leads to."""
    opened: float
    """Share of that part's cells that lie behind walls which the reading opened."""


def pixel_side(path: Path, file: MapFile) -> float | None:
    """Side of a pixel (metres); None: a pixel is a cell."""
    drawn = path.suffix.lower() not in IMAGES or max(file.occupied.shape) <= DRAWN_SIDE
    return file.resolution or (None if drawn else PIXEL_M)


def drivable(occupied: Board, radius_pixels: float) -> Board:
    """Pixels that the middle of a round robot can reach, the largest connected part, [h, w]."""
    return _reached(_clearance(occupied), radius_pixels)


def _clearance(occupied: Board) -> NDArray[np.float64]:
    """Distance of every pixel to what is occupied, or beyond the map (pixels)."""
    room: NDArray[np.float64] = ndimage.distance_transform_edt(np.pad(~occupied, 1))[1:-1, 1:-1]
    return room


def _reached(room: NDArray[np.float64], radius_pixels: float) -> Board:
    return _largest(room > max(radius_pixels, 0.5))


def _narrowest(room: NDArray[np.float64], radius_pixels: float) -> float:
    """Width of the narrowest way that joins most of what a robot can drive on (pixels)."""
    low, high = max(radius_pixels, 0.5), float(room.max())
    while high - low > 0.5:  # the widest robot that still reaches most places with room for it
        middle = (low + high) / 2
        fits = room > middle
        joined = _largest(fits).sum() >= JOINED * fits.sum()
        low, high = (middle, high) if joined else (low, middle)
    return 2 * high


def grid_fit(
    occupied: Board, reach: Board, pixels_per_cell: float, max_occupied: float = 0.0
) -> CellFit:
    """What a grid keeps of the pixels ``reach`` that a robot can drive on, bool [h, w] both."""
    connected = _component_of(~occupied, reach)
    return _grid_fit(occupied, reach, connected, pixels_per_cell, max_occupied)


def _grid_fit(
    occupied: Board, reach: Board, connected: Board, pixels_per_cell: float, max_occupied: float
) -> CellFit:
    """As ``grid_fit``, given the free pixels that are connected with ``reach``."""
    free = resample(occupied, pixels_per_cell) <= max_occupied + TOLERANCE
    area = resample(reach, pixels_per_cell)
    labels, count = ndimage.label(free)
    if not count:
        return CellFit(pixels_per_cell, 1.0, 0.0)
    best = 1 + int(np.argmax(ndimage.sum_labels(area, labels, range(1, count + 1))))
    part = labels == best
    around = ndimage.binary_dilation(part, np.ones((3, 3)))
    lost = float(area[~around].sum() / max(area.sum(), TOLERANCE))
    behind = part & (resample(connected, pixels_per_cell) <= 0)
    return CellFit(pixels_per_cell, lost, float(behind.sum() / part.sum()))


def fit_cells(occupied: Board, radius_pixels: float, max_occupied: float = 0.0) -> CellFit:
    """The coarsest grid of cells at least as wide as a robot that keeps where it can drive.

    Where none keeps it, the one that loses least.

    Args:
        occupied: pixels, bool [h, w].
        radius_pixels: of the robot (pixels).
        max_occupied: share of a free cell that may be occupied.

    Raises:
        ValueError: when the robot fits nowhere.
    """
    room = _clearance(occupied)
    reach = _reached(room, radius_pixels)
    if not reach.any():
        raise ValueError(
            f"a robot with a radius of {radius_pixels:.3g} pixels fits nowhere on the map"
        )
    connected = _component_of(~occupied, reach)
    least = max(1, int(np.ceil(2 * radius_pixels)))
    # a cell of a door lies between its posts
    widest = max(least, min(int(_narrowest(room, radius_pixels)) + 1, *occupied.shape))
    best: CellFit | None = None
    for pixels in range(widest, least - 1, -1):
        found = _grid_fit(occupied, reach, connected, pixels, max_occupied)
        if found.lost <= KEPT and found.opened <= WARNING:
            return found
        if best is None or found.lost < best.lost:
            best = found
    assert best is not None  # the range holds at least one size
    return best


def _largest(cells: Board) -> Board:
    labels, count = ndimage.label(cells)
    if not count:
        return np.zeros_like(cells)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    found: NDArray[np.bool_] = labels == sizes.argmax()
    return found


def _component_of(free: Board, some: Board) -> Board:
    """The connected part of the free pixels that holds some others."""
    labels, _ = ndimage.label(free)
    inside = labels[some]
    chosen = np.bincount(inside[inside > 0]).argmax() if (inside > 0).any() else -1
    found: NDArray[np.bool_] = labels == chosen
    return found
