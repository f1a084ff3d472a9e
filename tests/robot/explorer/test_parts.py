"""Ways, frontiers, prices, progress, skipped goals, places and time."""

from __future__ import annotations

import math
from dataclasses import fields
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import lil_matrix
from scipy.sparse.csgraph import dijkstra

from marl_explore.config.constants import FREE, UNKNOWN
from marl_explore.robot.explorer import ExplorerCore, ExplorerSettings, OccupancyMap, Place
from marl_explore.robot.explorer.choice import Rival, price
from marl_explore.robot.explorer.frontiers import (
    Candidate,
    border,
    candidates,
    cells_of,
    clusters,
    long_clusters,
)
from marl_explore.robot.explorer.grids import CoarseGrid
from marl_explore.robot.explorer.places import LivedTime, Trail
from marl_explore.robot.explorer.progress import Attempt
from marl_explore.robot.explorer.skips import MOST_CHANGES, SkipList
from marl_explore.robot.explorer.wavefront import NO_WAY, path, ways

METRES = st.floats(-50, 50)
ANGLES = st.floats(-3, 3)


def picture(text):
    """``?`` unknown, ``.`` free, ``#`` occupied; row 0 first."""
    return np.array([[{"?": -1, ".": 0, "#": 1}[c] for c in row] for row in text.split()], np.int8)


# ---------------------------------------------------------------- ways


def lengths_by_dijkstra(free, start):
    """The same lengths, from a graph."""
    height, width = free.shape
    graph = lil_matrix((free.size, free.size))
    for row, column in product(range(height), range(width)):
        for up, side in product((-1, 0, 1), (-1, 0, 1)):
            r, c = row + up, column + side
            if not (up or side) or not (0 <= r < height and 0 <= c < width) or not free[r, c]:
                continue
            graph[row * width + column, r * width + c] = 3 if up and side else 2
    found = dijkstra(graph.tocsr(), True, start[0] * width + start[1])
    return np.where(np.isfinite(found), found, NO_WAY).reshape(free.shape)


@pytest.mark.parametrize("seed", range(10))
def test_ways_are_shortest_and_paths_have_their_length(seed):
    chance = np.random.default_rng(seed)
    free = chance.random((12, 15)) < 0.65
    start = tuple(chance.integers((12, 15)).tolist())
    lengths = ways(free, start)
    expected = lengths_by_dijkstra(free, start)
    expected[start] = 0
    assert np.array_equal(lengths, expected)
    for cell in zip(*(lengths >= 0).nonzero(), strict=True):
        cells = path(lengths, cell)
        assert (cells[0], cells[-1]) == (start, cell)
        steps = np.abs(np.diff(cells, axis=0))
        assert np.where(steps.sum(1) == 2, 3, 2).sum() == lengths[cell]
    near = ways(free, start, most=8)
    assert np.array_equal(near, np.where(expected <= 8, expected, NO_WAY))


# ---------------------------------------------------------------- frontiers

HALLS = picture("""
    ?????????
    ?.......?
    ?.......?
    ?###.####
    ????.????
    ????.????
    ?????????
""")


def test_frontiers_are_unknown_cells_beside_free_ones_also_at_the_edge():
    edge = border(HALLS, HALLS == FREE)
    assert edge[0, 1:8].all()
    assert edge[1:3, 0].all()
    assert edge[4, 3]
    assert not edge[0, 0]
    assert not (edge & (HALLS != UNKNOWN)).any()
    assert len(clusters(edge)) == 2
    long, short = long_clusters(edge, 0.2, 1.0)
    assert ([len(cluster) for cluster in long], short) == ([11, 5], 0)
    assert long_clusters(edge, 0.2, 1.2)[1] == 1
    assert np.array_equal(cells_of(clusters(edge), edge.shape), edge)


def test_goals_are_the_nearest_places_and_some_further_ones():
    free = HALLS == FREE
    lengths = ways(free, (1, 1))
    grid = CoarseGrid(HALLS, (0, 0), 0.5)
    found = candidates(grid, lengths, clusters(border(HALLS, free)), spread=1.5, view=0.5)
    first, *others = found
    assert (first.cell, first.way) == ((1, 1), 0.0)
    assert first.gain == pytest.approx(5 / 9)
    for one, other in product(found, found):
        apart = math.dist(one.cell, other.cell) * 0.5
        assert one is other or apart >= 1.5 or lengths[one.cell] != lengths[other.cell]
    assert {c.cell for c in others} >= {(5, 4)} or any(c.cell[0] > 3 for c in others)
    for option in found:
        assert HALLS[option.cell] == FREE
        assert HALLS[option.faces] == UNKNOWN
        assert math.dist(option.cell, option.faces) == 1


def test_a_teammate_that_is_nearer_or_has_chosen_makes_a_goal_dearer():
    settings = ExplorerSettings()
    grid = CoarseGrid(np.zeros((3, 60), np.int8), (0, 0), 0.2)
    free = grid.codes == FREE
    option = Candidate((1, 40), (2, 40), way=6.0, gain=0.5)
    alone = price(option, grid, [], "b", settings)
    assert alone == pytest.approx(6.0 - 2.0 * 0.5)

    def with_mate(column, goal=None, name="a"):
        place = Place(*grid.middle((1, column)))
        rival = Rival(name, place, ways(free, (1, column)), goal)
        return price(option, grid, [rival], "b", settings)

    assert with_mate(55) > alone + 9  # nearer
    assert with_mate(0) < alone + 2  # further
    at = Place(*grid.middle(option.cell))
    assert with_mate(55, at) == pytest.approx(with_mate(55) + 10)
    assert with_mate(0, at) == with_mate(0)  # further away, so the goal is this robot's
    assert with_mate(10, at) == pytest.approx(with_mate(10) + 10)  # as near, and a before b
    assert with_mate(10, at, "c") == pytest.approx(with_mate(10))
    cut = [Rival("a", at, np.full((3, 60), NO_WAY, np.int32), at)]
    assert price(option, grid, cut, "b", settings) == alone


# ---------------------------------------------------------------- progress

SETTINGS = ExplorerSettings(arrival=0.5, refusal=10, no_progress=20, slowest=0.05)


def judged(places, goal=Place(5.0, 0.0)):  # noqa: B008
    """The last verdict on an attempt, with a place every second, and when it was."""
    attempt = Attempt(goal, (5.2, 0.0), True, 5.0, places[0], 0.0, SETTINGS)
    for time, place in enumerate(places):
        verdict = attempt.judge(place, place.distance(goal), float(time))
        if verdict != "going":
            break
    return verdict, time


def test_verdicts():
    still = [Place(0.0, 0.0)] * 200
    drives = [Place(0.2 * time, 0.0) for time in range(200)]
    assert judged(drives) == ("arrived", 23)
    assert judged(still) == ("refused", 11)
    assert judged(drives[:10] + [drives[10]] * 100)[0] == "no progress"
    circles = [Place(math.cos(t / 3), math.sin(t / 3)) for t in range(400)]
    assert judged(circles) == ("too late", 121)
    near = drives[:22] + [Place(4.2, 0.0)] * 100  # poses may be half a metre old
    assert judged(near)[0] == "arrived"
    turns = [Place(0.0, 0.0, 0.1 * time) for time in range(200)]
    assert judged(turns)[0] == "refused"


def test_a_goal_is_sent_once_more_while_the_robot_has_not_started():
    attempt = Attempt(Place(5.0, 0.0), None, True, 5.0, Place(0.0, 0.0), 0.0, SETTINGS)
    attempt.judge(Place(0.0, 0.0), 5.0, 1.0)
    assert [time for time in range(10) if attempt.send_again(float(time))] == [6]


# ---------------------------------------------------------------- skipped goals


def grid_of(codes):
    return CoarseGrid(codes, (0, 0), 0.2)


def test_skipped_goals_are_counted_and_cover_what_is_near():
    codes = np.zeros((30, 30), np.int8)
    grid, skips = grid_of(codes), SkipList()
    edge = np.ones(codes.shape, bool)
    skips.add((3.0, 3.0), 1.0, "refused", grid)
    assert skips.count(grid, edge) == (1, 0, 0)
    assert skips.covered(grid, 1)[grid.cell((3.5, 3.5))]
    assert not skips.covered(grid, 1)[grid.cell((3.9, 3.9))]
    assert not skips.covered(grid, 2).any()
    skips.add((3.3, 3.0), 1.0, "no progress", grid)  # the same goal
    assert skips.count(grid, edge) == (0, 1, 0)
    assert skips.given_up() == ["(3.0, 3.0) no progress"]
    assert skips.covered(grid, 2).any()
    assert skips.count(grid, np.zeros_like(edge)) == (0, 0, 0)  # its frontier is gone
    skips.add_in_vain([(1.0, 1.0), (1.1, 1.0)], 0.5, grid)
    assert skips.count(grid, edge) == (1, 1, 0)
    skips.add_in_vain([(1.0, 1.0)], 0.5, grid)
    assert skips.count(grid, edge) == (0, 1, 1)
    assert len(skips.points()) == 2


def test_goals_are_new_when_the_map_around_them_changes_but_not_forever():
    codes = np.zeros((30, 30), np.int8)
    skips = SkipList()
    for change in range(MOST_CHANGES + 2):
        skips.add((3.0, 3.0), 1.0, "refused", grid_of(codes))
        skips.add((3.0, 3.0), 1.0, "refused", grid_of(codes))
        codes = codes.copy()
        codes[14, 14] ^= 1
        skips.renew(grid_of(codes))  # a single cell may flicker
        assert skips.entries[0].tries >= 2
        codes[13:16, 13:16] ^= 1
        skips.renew(grid_of(codes))
        assert (skips.entries[0].tries == 0) == (change < MOST_CHANGES)


# ---------------------------------------------------------------- places and time


@given(METRES, METRES, ANGLES, METRES, METRES, ANGLES)
def test_frames_are_undone(x, y, yaw, u, v, turn):
    frame, inner = Place(x, y, yaw), Place(u, v, turn)
    assert frame.relative(frame.then(inner)) == pytest.approx(inner, abs=1e-9)
    assert frame.within(frame.then(inner)[:2]) == pytest.approx((u, v), abs=1e-9)


def test_lived_time_does_not_jump():
    time = LivedTime()
    shown = [100.0, 100.5, 101.0, 5.0, 5.5, 9000.0, 9000.5]
    assert [time.pass_to(now) for now in shown] == [0.0, 0.5, 1.0, 1.0, 1.5, 3.5, 4.0]


def test_trails_are_forgotten():
    trail = Trail(0.1, 10.0)
    for time in range(20):
        trail.add(Place(0.05 * time, 0.0), float(time))
    places = [x for x, _ in trail.points(19.0)]
    assert 0.35 <= min(places) <= 0.45
    assert 0.85 <= max(places) <= 0.95
    assert 0.1 <= np.diff(places).min() <= np.diff(places).max() <= 0.15 + 1e-9
    assert trail.points(40.0) == []


def test_trails_keep_their_cells_and_join_near_poses():
    trail = Trail(0.1, 10.0)
    trail.add(Place(0.05, 0.05), 0.0)
    trail.add(Place(0.55, 0.05), 1.0)
    trail.add(Place(5.05, -0.05), 2.0)  # put elsewhere
    trail.points(100.0)
    assert trail.cells == {*((0, column) for column in range(6)), (-1, 50)}


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("radius", 0.0),
        ("settle", -1.0),
        ("most_conflicts", 1.5),
        ("view", math.inf),
        ("radius", 0.003),
        ("radius", 1_000_000.0),
    ],
)
def test_settings_are_checked(name, value):
    with pytest.raises(ValueError, match=f"{name}={value} is not allowed"):
        ExplorerSettings(**{name: value})


@pytest.mark.parametrize("value", [1e300, math.inf, -1e300, math.nan])
def test_settings_have_bounds_on_both_sides(value):
    for field in fields(ExplorerSettings):
        if field.name != "return_to_start":
            with pytest.raises(ValueError, match=f"{field.name}=.* is not allowed"):
                ExplorerSettings(**{field.name: value})


def test_settings_at_their_bounds_are_taken():
    assert ExplorerSettings(radius=0.03).radius == 0.03
    assert ExplorerSettings(radius=5.0, view=10.0, settle=0.0, body_time=0.0).radius == 5.0
    with pytest.raises(ValueError, match="view=10.5 is not allowed: it must be at most 10 metres"):
        ExplorerSettings(view=10.5)
    with pytest.raises(ValueError, match="radius=0.02 .*: it must be from 0.03 to 5 metres"):
        ExplorerSettings(radius=0.02)


def test_what_an_explorer_cannot_take():
    core = ExplorerCore(name="a", mates={"b": Place(0.0, 0.0)})
    grid = OccupancyMap(np.zeros((2, 2), np.int8), 0.05, Place(0.0, 0.0))
    for take, what, message in (
        (core.take_map, (grid, "c"), "mate='c' is not allowed"),
        (core.take_place, (Place(0.0, 0.0), "a"), "mate='a' is not allowed"),
        (core.take_place, (Place(math.nan, 0.0),), "x=nan is not allowed"),
        (core.take_goal, (Place(0.0, 0.0, math.inf), "b"), "yaw=inf is not allowed"),
        (core.take_place, (Place(None, 0.0),), "x=None is not allowed"),
        (core.take_place, (Place(0.0, "a"), "b"), "y='a' is not allowed"),
        (core.take_place, ((1.0, 1.0),), "place=.* must be a Place"),
        (core.take_goal, (None, "b"), "goal=None is not allowed"),
    ):
        with pytest.raises(ValueError, match=message):
            take(*what)
    with pytest.raises(ValueError, match="name='a' is not allowed"):
        ExplorerCore(name="a", mates={"a": Place(0.0, 0.0)})


@pytest.mark.parametrize(
    ("resolution", "origin", "message"),
    [
        (1e3, Place(0.0, 0.0), "area=4000000.0 is not allowed: it must be at most 100000 m2"),
        (1e-9, Place(0.0, 0.0), "resolution=1e-09 is not allowed: it must be at least 0.001 m"),
        (0.05, Place(500_000.0, 4.6e6), "x=500000.0 is not allowed: it must be at most 100000"),
        (0.05, Place(0.0, 1e300), "y=1e[+]300 is not allowed"),
    ],
)
@pytest.mark.parametrize("mate", [None, "b"])
def test_maps_that_would_take_all_memory_are_refused(resolution, origin, message, mate):
    core = ExplorerCore(name="a", mates={"b": Place(0.0, 0.0)})
    given = OccupancyMap(np.zeros((2, 2), np.int8), resolution, origin)
    with pytest.raises(ValueError, match=message):
        core.take_map(given, mate)
    with pytest.raises(ValueError, match="x=1e[+]308 is not allowed"):
        core.take_place(Place(1e308, 0.0), mate)


@pytest.mark.parametrize("mate", [None, "b"])
def test_maps_that_would_take_minutes_are_refused(mate):
    core = ExplorerCore(name="a", mates={"b": Place(0.0, 0.0, 0.8)})
    coarse = OccupancyMap(np.zeros((60, 60), np.int8), 5.0, Place(0.0, 0.0))
    long = OccupancyMap(np.zeros((1, 400_000), np.int8), 0.05, Place(0.0, 0.0, 0.8))
    for large in (coarse, long):
        with pytest.raises(ValueError, match="resolution=.* radius=0.2 m .* at most 8000000"):
            core.take_map(large, mate)
    assert core.advance(1.0).status.team == ("b: not heard yet",)


def test_maps_that_are_too_large_together_are_not_merged():
    """Two corridors of 500 m that cross: together they would have 25 million coarse cells."""
    core = ExplorerCore(name="a", mates={"b": Place(0.0, 0.0)})
    long = np.zeros((40, 10_000), np.int8)
    core.take_map(OccupancyMap(long, 0.05, Place(0.0, 0.0)))
    core.take_map(OccupancyMap(long.T, 0.05, Place(0.0, 0.0)), "b")
    core.take_place(Place(1.0, 1.0))
    core.take_place(Place(1.0, 1.5), "b")
    output = core.advance(1.0)
    assert output.status.state == "exploring"
    (said,) = output.status.team
    assert said == "b: map refused, its places do not count: over 16000000 cells together"


@pytest.mark.parametrize("now", [math.nan, math.inf, -math.inf, None, "1"])
def test_times_that_are_none_are_refused(now):
    core = ExplorerCore()
    with pytest.raises(ValueError, match="now=.* is not allowed: .* seconds"):
        core.advance(now)
    assert core.advance(1.0).status.sentence == "waiting for a map"


@pytest.mark.parametrize("size", [1, 2, 3, 5, 12])
@pytest.mark.parametrize("resolution", [0.02, 0.05])
def test_small_maps_are_looked_at_the_own_one_and_a_teammates(size, resolution):
    room = np.full((80, 80), 100, np.int8)
    room[10:70, 10:70] = 0
    large = OccupancyMap(room, 0.05, Place(0.0, 0.0))
    small = OccupancyMap(np.zeros((size, size), np.int8), resolution, Place(1.5, 1.5))
    for own, other in ((small, large), (large, small)):
        core = ExplorerCore(name="a", mates={"b": Place(0.0, 0.0)})
        core.take_map(own)
        core.take_map(other, "b")
        core.take_place(Place(1.51, 1.51))
        for now in (1.0, 1.5, 3.0):
            assert core.advance(now).status.state == "exploring"


def test_a_map_far_from_the_own_one_is_not_merged_and_takes_no_memory():
    core = ExplorerCore(name="a", mates={"b": Place(0.0, 0.0)})
    room = np.full((80, 80), 100, np.int8)
    room[10:70, 10:70] = 0
    core.take_map(OccupancyMap(room, 0.05, Place(0.0, 0.0)))
    core.take_map(OccupancyMap(room, 0.05, Place(90_000.0, -90_000.0)), "b")
    core.take_place(Place(2.0, 2.0))
    output = core.advance(1.0)
    assert any(
        "map not merged yet, only 0.0 m2 are in both maps" in said for said in output.status.team
    )
