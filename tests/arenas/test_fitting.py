"""Cells chosen for a map: doors stay open, and what a reading loses or opens is measured."""

from __future__ import annotations

import numpy as np
import pytest

from marl_explore.arenas.fitting import drivable, fit_cells, grid_fit


def two_rooms(door, offset=0, side=60, wall=2):
    """Rooms side by side with a door of some pixels between them."""
    occupied = np.zeros((side, 2 * side), bool)
    occupied[:, side : side + wall] = True
    occupied[20 + offset : 20 + offset + door, side : side + wall] = False
    return occupied


@pytest.mark.parametrize("door", [6, 9, 14])
@pytest.mark.parametrize("offset", range(5))
def test_the_chosen_grid_keeps_the_door_and_no_coarser_one_does(door, offset):
    occupied = two_rooms(door, offset)
    found = fit_cells(occupied, radius_pixels=1.5)
    assert found.lost <= 0.005
    assert 3 <= found.pixels_per_cell <= door
    reach = drivable(occupied, 1.5)
    for coarser in range(int(found.pixels_per_cell) + 1, door + 1):
        assert grid_fit(occupied, reach, coarser).lost > 0.3


def test_a_door_that_cells_close_cuts_half_of_the_map_off():
    occupied = two_rooms(door=6, offset=3)
    cut = grid_fit(occupied, drivable(occupied, 1.5), 10)
    assert 0.4 < cut.lost < 0.6
    assert cut.opened == 0


def test_a_wall_that_a_reading_opens_is_seen():
    occupied = two_rooms(door=0)
    reach = drivable(occupied, 1.5)
    assert reach[:, :60].any() != reach[:, 62:].any()
    opened = grid_fit(occupied, reach, 10, max_occupied=0.3)
    assert 0.4 < opened.opened < 0.6
    assert grid_fit(occupied, reach, 10).opened == 0


def test_a_robot_that_is_wider_than_the_door_needs_no_grid_that_keeps_it():
    found = fit_cells(two_rooms(door=6), radius_pixels=5)
    assert found.lost <= 0.005
    assert found.pixels_per_cell >= 10


def test_a_robot_that_fits_nowhere_is_refused():
    with pytest.raises(ValueError, match="fits nowhere"):
        fit_cells(np.ones((9, 9), bool), 1.0)
    with pytest.raises(ValueError, match="fits nowhere"):
        fit_cells(two_rooms(4), 40.0)
