"""The coarse grid: it keeps every passage into which the robot fits, and no wall leaks."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt, label

from marl_explore.config.constants import FREE, OCCUPIED, UNKNOWN
from marl_explore.robot.explorer.grids import CoarseMap, OccupancyMap, nearer, union
from marl_explore.robot.explorer.merging import fit
from marl_explore.robot.explorer.places import Place
from marl_explore.robot.explorer.wavefront import NO_WAY, ways

RADIUS = 0.2


def room(width, height, resolution, origin=Place(0.0, 0.0), walls=()):  # noqa: B008
    """A free map in metres with walls (x, y, width, height), and a wall of one cell around."""
    percent = np.zeros((round(height / resolution), round(width / resolution)), np.int8)
    percent[[0, -1]] = percent[:, [0, -1]] = 100
    for x, y, w, h in walls:
        rows, columns = (
            slice(
                round(a / resolution), max(round((a + b) / resolution), round(a / resolution) + 1)
            )
            for a, b in ((y, h), (x, w))
        )
        percent[rows, columns] = 100
    return OccupancyMap(percent, resolution, origin)


@pytest.mark.parametrize("reach", [1.5, 2.0, 3.999, 4.0, 4.001, 6.67])
def test_nearer_is_a_distance(reach):
    cells = np.random.default_rng(0).random((40, 50)) < 0.02
    rows, columns = np.indices(cells.shape)
    expected = np.zeros_like(cells)
    for row, column in zip(*cells.nonzero(), strict=True):
        expected |= np.hypot(rows - row, columns - column) < reach
    assert np.array_equal(nearer(cells, reach), expected)


@given(
    st.integers(1, 12),
    st.integers(1, 12),
    st.floats(0.1, 20.0) | st.integers(1, 20).map(float),
    st.floats(0.0, 1.0),
    st.integers(0, 2**32 - 1),
)
def test_nearer_is_a_distance_also_in_grids_smaller_than_the_reach(
    height, width, reach, share, seed
):
    cells = np.random.default_rng(seed).random((height, width)) < share
    rows, columns = np.indices(cells.shape)
    expected = np.zeros_like(cells)
    for row, column in zip(*cells.nonzero(), strict=True):
        expected |= (rows - row) ** 2 + (columns - column) ** 2 < reach**2
    assert np.array_equal(nearer(cells, reach), expected)


@pytest.mark.parametrize(
    ("shape", "resolution", "radius"),
    [
        ((1, 1), 0.05, 0.2),
        ((2, 2), 0.05, 0.2),
        ((3, 3), 0.03, 0.2),
        ((5, 5), 0.02, 0.2),
        ((5, 100), 0.02, 0.2),
        ((100, 5), 0.02, 0.2),
        ((60, 60), 0.05, 5.0),
    ],
)
def test_maps_with_few_rows_have_coarse_cells(shape, resolution, radius):
    """They are as free or closed as the same cells in the middle of a larger unknown map."""
    percent = np.zeros(shape, np.int8)
    percent[0, -1] = 100
    given = OccupancyMap(percent, resolution, Place(0.0, 0.0))
    rim = math.ceil(radius / resolution)
    corner = Place(-rim * resolution, -rim * resolution)
    wide = OccupancyMap(np.pad(percent, rim, constant_values=-1), resolution, corner)
    small, large = CoarseMap(given, radius), CoarseMap(wide, radius)
    fits = large._fits[rim:-rim, rim:-rim]
    assert np.array_equal(small._fits, fits)
    for cell in np.argwhere(small.grid.codes == FREE):
        middle = small.grid.middle(tuple(cell.tolist()))
        assert large.grid.code(large.grid.cell(middle)) == FREE


@pytest.mark.parametrize("seed", range(30))
def test_what_a_robot_reaches_on_fine_cells_it_reaches_on_coarse_ones(seed):
    """In random worlds, at any resolution, origin and yaw of the map."""
    chance = np.random.default_rng(seed)
    resolution = chance.choice([0.03, 0.05, 0.07, 0.1])
    yaw = chance.choice([0.0, chance.uniform(-3, 3)])
    origin = Place(*chance.uniform(-9, 9, 2), yaw)
    percent = np.where(chance.random((60, 80)) < 0.02, 100, 0).astype(np.int8)
    coarse = CoarseMap(OccupancyMap(percent, resolution, origin), RADIUS)
    fine = coarse.fine
    fits = distance_transform_edt(fine.percent < 50) * fine.resolution >= RADIUS - 1e-9
    regions, number = label(fits)
    assert number
    for region in range(1, number + 1):
        rows, columns = (regions == region).nonzero()
        x, y = fine.middles(rows, columns)
        cells = [coarse.grid.cell(point) for point in zip(x, y, strict=True)]
        assert {coarse.grid.code(cell) for cell in cells} == {FREE}
        lengths = ways(coarse.grid.codes == FREE, cells[0])
        assert min(lengths[cell] for cell in cells) > NO_WAY


@pytest.mark.parametrize("resolution", [0.03, 0.05, 0.07, 0.1])
@pytest.mark.parametrize("shift", np.linspace(0, RADIUS, 9))
@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_passages_of_the_robots_width_stay_open_and_walls_stay_closed(resolution, shift, yaw):
    origin = Place(shift - 7.77, 2 * shift + 3.1, yaw)
    gap = math.ceil(2 * RADIUS / resolution + 1.01) * resolution  # for one fine cell, at least
    for closed in (False, True):
        walls = [(2.0, 0.0, 0.0, 1.0), (2.0, 1.0 + gap * (not closed), 0.0, 2.0)]
        coarse = CoarseMap(room(4.0, 3.0, resolution, origin, walls), RADIUS)
        start, end = (coarse.standing(origin.then(Place(x, 1.5)), 0.3) for x in (0.8, 3.2))
        length = ways(coarse.grid.codes == FREE, start)[end]
        assert (length == NO_WAY) == closed


def test_what_lies_behind_a_wall_is_no_frontier():
    grid = CoarseMap(room(2.0, 2.0, 0.05), RADIUS).grid
    codes = union([grid]).codes
    free = codes == FREE
    for up, across in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        assert not (np.roll(free, (up, across), (0, 1)) & (codes == UNKNOWN)).any()


def test_cells_keep_their_place_while_a_map_grows():
    whole = room(4.0, 3.0, 0.05, Place(0.013, -0.027))
    small = OccupancyMap(whole.percent[20:, 30:], 0.05, Place(0.013 + 1.5, -0.027 + 1.0))
    one, other = CoarseMap(whole, RADIUS).grid, CoarseMap(small, RADIUS).grid
    for x in np.arange(1.9, 3.7, 0.1):
        for y in np.arange(1.4, 2.6, 0.1):
            assert one.code(one.cell((x, y))) == other.code(other.cell((x, y))) == FREE
            assert one.middle(one.cell((x, y))) == pytest.approx(other.middle(other.cell((x, y))))


def test_a_turned_map_is_the_same_map():
    plain = room(4.0, 3.0, 0.05, Place(0.4, -0.2), [(1.0, 1.0, 0.5, 0.5)])
    corner = Place(0.4 + 4.0, -0.2, math.pi / 2)
    turned = OccupancyMap(np.rot90(plain.percent), 0.05, corner)
    one, other = CoarseMap(plain, RADIUS).grid, CoarseMap(turned, RADIUS).grid
    assert one.first == other.first
    assert np.array_equal(one.codes, other.codes)


def test_coarse_maps_are_split():
    """Cells wider than the robot; 4 x 4, the middle four free."""
    percent = np.full((4, 4), 100, np.int8)
    percent[1:3, 1:3] = 0
    grid = CoarseMap(OccupancyMap(percent, 0.5, Place(0.0, 0.0)), RADIUS).grid
    assert grid.code(grid.cell((1.0, 1.0))) == FREE
    assert grid.code(grid.cell((0.3, 1.0))) == OCCUPIED


def test_bodies_are_no_obstacles():
    given = room(4.0, 3.0, 0.05, walls=[(2.0, 0.0, 0.0, 1.2), (2.0, 1.9, 0.0, 1.1)])
    rows, columns = np.indices(given.percent.shape)
    x, y = given.middles(rows, columns)
    given.percent[np.hypot(x - 2.0, y - 1.5) < 0.17] = 100  # a robot in the door
    reached = []
    for bodies in ([], [(2.02, 1.51)]):
        coarse = CoarseMap(given, RADIUS, bodies, 0.25)
        start, end = (coarse.standing(Place(x, 1.5), 0.3) for x in (0.8, 3.2))
        reached.append(ways(coarse.grid.codes == FREE, start)[end] != NO_WAY)
    assert reached == [False, True]
    assert (given.percent == 100).any()  # the map itself is not changed


def test_a_robot_near_a_wall_stands_on_its_side_of_it():
    given = room(4.0, 3.0, 0.05, walls=[(2.0, 0.0, 0.0, 3.0)])
    coarse = CoarseMap(given, RADIUS)
    for x in (1.85, 1.95):
        cell = coarse.standing(Place(x, 1.5), 0.6)
        assert coarse.spot(cell)[0] < 1.9
    assert coarse.standing(Place(9.0, 9.0), 0.6) is None
    assert coarse.standing(Place(-900.0, 9.0), 0.6) is None


def test_spots_are_places_into_which_the_robot_fits():
    coarse = CoarseMap(room(3.0, 2.0, 0.05, walls=[(1.0, 1.0, 0.3, 0.3)]), RADIUS)
    clear = distance_transform_edt(coarse.fine.percent < 50) * 0.05
    for cell in zip(*(coarse.grid.codes == FREE).nonzero(), strict=True):
        x, y = coarse.spot(cell)
        assert coarse.grid.cell((x, y)) == cell
        assert clear[int(y / 0.05), int(x / 0.05)] >= RADIUS - 1e-9


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            OccupancyMap(np.zeros((0, 3), np.int8), 0.05, Place(0, 0)),
            r"shape=\(0, 3\) is not allow",
        ),
        (
            OccupancyMap(np.zeros((2, 3), np.int8), 0.0, Place(0, 0)),
            "resolution=0.0 is not allowed",
        ),
        (OccupancyMap(np.zeros((2, 3), np.int8), math.nan, Place(0, 0)), "resolution=nan is not"),
        (OccupancyMap(np.zeros((2, 3), np.int8), 0.05, Place(0, math.inf)), "y=inf is not allowed"),
        (OccupancyMap(np.zeros((2, 3)), 0.05, Place(0, 0)), "percent=.*float64.* array of int8"),
        (OccupancyMap(np.full((2, 3), math.nan), 0.05, Place(0, 0)), "percent=.* array of int8"),
        (OccupancyMap(np.full((2, 3), 200, np.uint8), 0.05, Place(0, 0)), "percent=.*uint8"),
        (OccupancyMap(np.full((2, 3), 200, np.int16), 0.05, Place(0, 0)), "percent=.*int16"),
        (OccupancyMap([[0, 0], [0, 100]], 0.05, Place(0, 0)), "percent=.*list.* array of int8"),
        (OccupancyMap(None, 0.05, Place(0, 0)), "percent=.* array of int8"),
        (OccupancyMap(np.full((2, 3), 101, np.int8), 0.05, Place(0, 0)), "percent=101 is not"),
        (OccupancyMap(np.full((2, 3), -2, np.int8), 0.05, Place(0, 0)), "percent=-2 is not allow"),
        (OccupancyMap(np.zeros((2, 3), np.int8), None, Place(0, 0)), "resolution=None is not allo"),
        (
            OccupancyMap(np.zeros((2, 3), np.int8), "a", Place(0, 0)),
            "resolution='a' is not allowed",
        ),
        (OccupancyMap(np.zeros((2, 3), np.int8), 0.05, (0, 0, 0)), "origin=.* must be a Place"),
        (OccupancyMap(np.zeros((2, 3), np.int8), 0.05, None), "origin=None is not allowed"),
    ],
)
def test_maps_that_are_none_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        given.check()


@pytest.mark.parametrize(
    ("shape", "resolution", "radius", "yaw", "message"),
    [
        ((60, 60), 5.0, 0.2, 0.0, "resolution=5.0 .* radius=0.2 m the 60 x 60 .* 20250000 fine"),
        ((60, 60), 0.05, 0.003, 0.0, "resolution=0.05 .* radius=0.003 m .* 9000000 fine"),
        (
            (3000, 3000),
            0.05,
            0.2,
            0.0,
            "9000000 fine and 22[0-9]* coarse ones, and at most 8000000",
        ),
        ((1, 400_000), 0.05, 0.2, 0.8, "at most 8000000 are allowed"),
        ((60, 60), 0.002, 0.5, 0.0, "resolution=0.002 .* radius=0.5 m it must be at least 0.0025"),
    ],
)
def test_maps_that_take_too_long_are_refused(shape, resolution, radius, yaw, message):
    percent = np.zeros(shape, np.int8)
    given = OccupancyMap(percent, resolution, Place(0.0, 0.0, yaw))
    given.check()
    with pytest.raises(ValueError, match=message):
        given.check_size(radius)


@pytest.mark.parametrize(
    ("shape", "resolution", "radius", "yaw"),
    [
        ((2800, 2800), 0.05, 0.2, 0.0),
        ((1, 400_000), 0.05, 0.2, 0.0),
        ((60, 60), 0.05, 0.03, 0.0),
        ((60, 60), 0.001, 0.2, 0.0),
        ((26, 26), 5.0, 0.2, 0.0),
    ],
)
def test_large_maps_are_taken(shape, resolution, radius, yaw):
    OccupancyMap(np.zeros(shape, np.int8), resolution, Place(0.0, 0.0, yaw)).check_size(radius)


def test_the_size_that_is_checked_is_that_of_the_cells():
    for resolution, yaw in ((0.05, 0.0), (0.11, 0.7), (0.3, 2.0)):
        given = OccupancyMap(np.zeros((40, 90), np.int8), resolution, Place(0.3, 0.2, yaw))
        coarse = CoarseMap(given, RADIUS)
        assert coarse.fine.percent.size == given.percent.size * given._parts(RADIUS) ** 2
        assert coarse.grid.codes.size < 1.2 * given.coarse_cells(RADIUS)


# ---------------------------------------------------------------- unions and contradictions


def test_the_first_map_counts_in_a_union():
    one = CoarseMap(room(2.0, 2.0, 0.05), RADIUS).grid
    other = CoarseMap(room(4.0, 2.0, 0.05, Place(1.0, 1.0)), RADIUS).grid
    both = union([one, other])
    for grid, others in ((one, []), (other, [one])):
        for cell in np.ndindex(grid.codes.shape):
            point = grid.middle(cell)
            first = [g.code(g.cell(point)) for g in others] + [grid.code(cell)]
            known = [code for code in first if code != UNKNOWN]
            assert both.code(both.cell(point)) == (known[0] if known else UNKNOWN)
    border = np.ones(both.codes.shape, bool)
    border[1:-1, 1:-1] = False
    assert (both.codes[border] == UNKNOWN).all()


def test_maps_that_are_off_by_a_cell_fit_and_others_do_not():
    walls = [(1.5, 0.0, 0.1, 2.0), (3.0, 1.2, 0.1, 2.0)]
    own = CoarseMap(room(5.0, 3.0, 0.05, walls=walls), RADIUS).grid

    def off(place, walls=walls):
        return fit(own, CoarseMap(room(5.0, 3.0, 0.05, place, walls), RADIUS).grid)

    assert off(Place(0.0, 0.0)).conflicts == 0
    assert not off(Place(0.1, 0.05, 0.01)).contradicts(0.25)
    assert off(Place(0.9, 0.0)).contradicts(0.25)
    assert off(Place(4.5, 0.5, math.pi / 2)).contradicts(0.25)
    door = off(Place(0.0, 0.0), [*walls, (1.5, 2.0, 0.1, 0.9)])
    assert door.conflicts > 0
    assert not door.contradicts(0.25)
    far = off(Place(20.0, 0.0))
    assert far.is_little
    assert not far.contradicts(0.25)
